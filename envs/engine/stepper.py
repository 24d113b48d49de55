"""Stepper of compiled episodes, whose memory is bound to native code once."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy

from ...compiler.block import LANES
from ...compiler.functions import (
    DTYPES,
    Call,
    Leaf,
    Specialised,
    copy_arrays,
    empty_lanes,
    leaves,
    map_arrays,
    memory_of,
)
from ...compiler.sequence import TILE, CallSequence, Moving, moving_array
from ...filters.ordered_sums import ordered_sum
from ..contract.model import Episode
from ..contract.observation import Array, DecisionMeans
from .episode_noise import EpisodeNoise
from .programs import Report


def mean_reward(rewards: Sequence[Any]) -> Any:
    """Return the mean of the rewards at the measurements of one decision."""
    return ordered_sum(rewards) / len(rewards) if len(rewards) > 1 else rewards[0]


MANY = 64
"""Lanes from which on observations are written into memory that the caller may keep, instead of being copied."""
WIDE = 1024
"""Lanes beyond which the numbers of a tile of them lie side by side: more leave the cache between two steps, and memory
is read faster in one piece than row by row."""


class Stepper:
    """Stepper of a compiled model's episodes in fixed memory, by native code.

    Args:
        report: function of the model and its episodes after the action.
        width: lanes, a multiple of eight.
        world_of: stepper of the same task, both filters in an open loop, whose world is shared. Call it first.

    Attributes:
        action: applied at every step, ``(..., width)``.
    """

    def __init__(self, model: Any, report: Report, width: int, world_of: "Stepper | None" = None) -> None:
        update, advance, predict, episode = model.programs.later
        report_code = model.programs.report_program(report)
        truths, measured, states = (len(leaves(part)) for part in episode)
        self._threads, self._model, self._report = model.threads, model, report
        self.width = width
        self._world_of, self._shared = world_of, 0 if world_of is None else truths + measured
        count = itertools.count()
        self._template = map_arrays(lambda _: next(count), episode)
        self._kinds = [array.dtype.kind for array in leaves(episode)]
        self._report_template, self._report_kinds = (
            report_code.template,
            [leaf.kind for leaf in report_code.outputs],
        )

        self.action: numpy.ndarray = empty_lanes(update.inputs[-1].shape, width)
        self.action[...] = 0.0
        self._first_action = self.action[..., 0]
        fields = predict.outputs[-1].shape[0] if world_of is None else 0
        # A width without a divisor of that order stays in rows.
        tiles = range(4 * TILE, TILE - 1, -LANES) if width > WIDE else ()
        self._tile = next((tile for tile in tiles if width % tile == 0), width)
        self._together = self._tile if self._tile < width else TILE
        """Lanes that go through a decision together."""
        self._shown, self._given = numpy.empty((width, fields)), False
        self._first_shown = self._shown[0]
        self._reported = memory_of(report_code.outputs, width)
        knows = bool(model.filter.knows)
        # Episodes alternate between two copies, which share the arrays that do not change. Of the filter they share
        # the arrays not read any more when the prediction is written: all but the results of the update.
        outputs = [*advance.outputs, *predict.outputs[:-1]][self._shared :]
        ahead_of_filter = truths if knows else 0
        handed_on = [ahead_of_filter + i in update.same for i in range(states)]
        stays = [*(same is not None for same in advance.same), *(not handed for handed in handed_on)]
        stays = stays[self._shared :]
        stay, go = ([o for o, s in zip(outputs, stays, strict=True) if s is which] for which in (True, False))
        self._staying, staying = _side_by_side(stay, width, self._tile)
        self._going: list[numpy.ndarray] = []
        """Numbers of all arrays of each copy that are not shared, ``(numbers, tiles, tile)``."""
        self._copies: list[list[numpy.ndarray]] = []
        for world in ([], []) if world_of is None else world_of._copies:
            numbers, going = _side_by_side(go, width, self._tile)
            self._going.append(numbers)
            kept, own = iter(staying), iter(going)
            self._copies.append([*world[: self._shared], *(next(kept if s else own) for s in stays)])
        first, second = ([array[..., 0, :] for array in copy] for copy in self._copies)
        tiled = [*self._copies[0], *self._copies[1]] if self._tile < width else []
        self._apart = [
            (part, array.strides[-2]) for part, array in zip([*first, *second], tiled, strict=False)
        ]
        """Arrays of the first tile of lanes, and the bytes from them to those of the next one."""
        written = self._written = memory_of(update.outputs, width)
        row = empty_lanes((advance.inputs[-1].rows,), width)  # its place is taken by that of the noise
        self._calls, self._begin = [], []
        world, start = model.programs.start
        begun = model.programs.first
        uniforms, normals = world.inputs
        drawn = empty_lanes((normals.rows + uniforms.rows,), width)
        self._start_numbers, self._drawn = drawn, (drawn[normals.rows :], drawn[: normals.rows])
        self._initial: list[numpy.ndarray] = (
            memory_of(world.outputs[truths:], width) if world_of is None else world_of._initial
        )
        for now, then in ((first, second), (second, first)):
            truth, measurement = now[:truths], now[truths : truths + measured]
            given = [*(truth if knows else []), *now[truths + measured :], *measurement, self.action]
            updated = [own if i is None else given[i] for own, i in zip(written, update.same, strict=True)]
            ahead, predicted = then[: truths + measured], then[truths + measured :]
            step = [
                update.bound(given, written),
                report_code.bound([*truth, *measurement, *updated[:states]], self._reported),
            ]
            begin = [start.bound([*self._initial, *(truth if knows else [])], written)]
            came = ahead[truths:]
            if world_of is None:
                step += [
                    advance.bound([*truth, *updated[states:], row], ahead),
                    predict.bound([*updated[:states], *came], [*predicted, self._shown]),
                ]
                begin = [
                    world.bound(self._drawn, [*truth, *self._initial]),
                    *begin,
                    begun.advance.bound([*truth, *written[states:], row], ahead),
                    begun.predict.bound([*written[:states], *came], [*predicted, self._shown]),
                ]
            else:
                at_first, later = model.programs.unseen_predictions
                step.append(later.bound([*updated[:states], *came], predicted))
                begin.append(at_first.bound([*written[:states], *came], predicted))
            self._calls.append(step)
            self._begin.append(begin)
        self._now = 0
        self._interval, self._means = (
            model.task.decision_interval,
            DecisionMeans(model.fields, model.task.decision_interval),
        )
        self._bound: dict[bool, _Bound] = {}
        """Whole decisions (True) and beginnings (False), bound at the first of either."""
        self._passing: numpy.ndarray | None = None
        """Observation at each measurement of a decision, ``(interval, width, fields)``, for means of them."""
        self.reported: list[numpy.ndarray] = []
        """Memory for the reports of a decision, ``(interval, ..., width)`` each."""
        self._first_rewards = numpy.empty(0)
        self._policy_memory: list[numpy.ndarray] | None = None
        """Memory of a policy after the last :meth:`run`; None: before its first action."""
        self._small: dict[int, Stepper] = {}
        """Steppers in which the episodes of a few lanes begin, by their width."""
        self._row_entry = 1 + 2 * (len(advance.inputs) - 1)
        self._action_place, self._report_place = len(update.inputs) - 1, len(report_code.inputs)

    def load(self, episode: Episode, observation: Array = None) -> None:
        """Replace the running episodes and their observation, ``(fields, width)``."""
        own = zip(self._copies[self._now], leaves(episode), strict=True)
        for memory, values in itertools.islice(own, self._shared, None):
            memory[...] = values.reshape(memory.shape)
        self._policy_memory = None
        if observation is not None:
            self._shown[...] = observation.T

    def episode(self) -> Episode:
        """Return the running episodes of all lanes, in arrays that are never changed."""
        arrays = [array.reshape(*array.shape[:-2], self.width) for array in self._copies[self._now]]
        return copy_arrays(self._template, arrays, self._kinds)

    def begin(
        self, identities: numpy.ndarray, noise: EpisodeNoise, others: "Sequence[Stepper]" = ()
    ) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Start new episodes in all lanes up to the first measurement; return the uniform and normal numbers used.

        Args:
            identities: of the episodes, ``(2, lanes)``, see :mod:`.episode_noise`; the other lanes are padding.
            noise: random numbers of the lanes.
            others: steppers of the same task.

        Returns:
            Uniforms ``(uniforms, width)`` and normals ``(initial_normals, width)``, valid until the next start.
        """
        self._policy_memory = None
        noise.set_identities(identities)
        self._run_bound(False, noise, others)
        return self._drawn

    def _bind_beginnings(self, draw: Call, noise: EpisodeNoise, others: "Sequence[Stepper]") -> "_Bound":
        turns = [[noise.start_call(self._start_numbers), draw] for _ in (0, 1)]
        for each in (self, *others):
            for begin, turn in zip(each._begin, turns, strict=True):
                calls = [call.copy() for call in begin]
                if each._world_of is None:
                    calls[-2].table[each._row_entry] = noise.address
                    for place, numbers in enumerate(self._drawn):
                        calls[0].replace(place, numbers)
                turn += calls
        shown = [[turn[1 + len(self._begin[0])]] for turn in turns]
        sequences = [
            CallSequence(turn, passing=self._tiled([turn], others), tile=self._together) for turn in turns
        ]
        return _bound(draw, sequences, shown)

    def _run_bound(self, whole: bool, noise: EpisodeNoise, others: "Sequence[Stepper]") -> None:
        draw = noise.next_measurement_call()
        if self._given:
            self._show_in(numpy.empty_like(self._shown))
        now, bound = self._now, self._bound.get(whole)
        if bound is None or bound.draw is not draw:
            bind = self._bind_decisions if whole else self._bind_beginnings
            bound = self._bound[whole] = bind(draw, noise, others)
        for call in bound.shown[now]:
            if call.arrays[-1] is not self._shown:
                call.replace(len(call.arrays) - 1, self._shown)
        bound.sequences[now].run(self.width, self._threads)
        if not whole or self._interval % 2:
            self._now = 1 - now
            for each in others:
                each._now = self._now

    def begin_some(
        self,
        lanes: numpy.ndarray,
        identities: numpy.ndarray,
        noise: EpisodeNoise,
        others: "Sequence[Stepper]" = (),
    ) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Start new episodes in some lanes up to the first measurement; return the uniform and normal numbers used.

        Lanes are ascending, identities ``(2, lanes)``; ``noise`` is of at least as many lanes.
        """
        steppers = (self, *others)
        for each in steppers:
            if noise.width not in each._small:
                baseline = None if each._world_of is None else self._small[noise.width]
                each._small[noise.width] = Stepper(each._model, each._report, noise.width, baseline)
        small, *smalls = [each._small[noise.width] for each in steppers]
        start = small.begin(identities, noise, smalls)
        for each, begun in zip(steppers, (small, *smalls), strict=True):
            place, source = numpy.divmod(lanes, each._tile), numpy.divmod(range(len(lanes)), begun._tile)
            each._staying[:, *place] = begun._staying[:, *source]
            each._going[each._now][:, *place] = begun._going[begun._now][:, *source]
        if self._given:
            self._show_in(self._shown.copy())
        self._shown[lanes] = small._shown[: len(lanes)]
        return start

    def take(self, action: numpy.ndarray) -> None:
        """Set the action of the next decisions, batch first, for all lanes or for the first ones."""
        self.action[..., : len(action)] = action.T if action.ndim == 2 else action

    def take_alone(self, action: numpy.ndarray) -> None:
        """Set the action of the first lane for the next decisions."""
        self._first_action[...] = action

    def decide(self, noise: EpisodeNoise, others: "Sequence[Stepper]" = ()) -> None:
        """Step all lanes of this and the other steppers through the measurements of one decision.

        One native call runs all of it for a tile of lanes.
        """
        self._run_bound(True, noise, others)
        if self._passing is not None:
            self._shown[...] = self._passing[-1]
            # The first axis is added up row by row, whatever the width, as a sum of the rows would be.
            total = numpy.add.reduce(self._averaged, 0, initial=0.0)
            total /= self._interval
            self._shown[:, self._means.columns] = total[:, self._averages]

    def _bind_decisions(self, draw: Call, noise: EpisodeNoise, others: "Sequence[Stepper]") -> "_Bound":
        columns, interval = self._means.columns, self._interval
        if columns:
            self._passing = numpy.empty((interval, *self._shown.shape))
            self._averaged = self._passing[..., min(columns) : max(columns) + 1]
            self._averages = numpy.array(columns) - min(columns)
        for each in (self, *others):
            each.reported = [
                empty_lanes((interval, *array.shape[:-1]), self.width) for array in each._reported
            ]
            each._first_rewards = each.reported[0].reshape(interval, -1)[:, 0]
        turns: list[list[Call]] = [[draw.copy()], [draw.copy()]]
        moving: list[Moving] = []
        for each in (self, *others):
            for now, turn in enumerate(turns):
                turn += each._bound_copies(now, noise, each.reported, moving)
        passing = self._tiled(turns, others)
        passing += self._bind_temporaries(turns, noise, others) if self.width > self._together else []
        shown = [turn[len(self._calls[0])] for turn in turns]
        if self._passing is not None:
            moving += [moving_array(call, len(call.arrays) - 1, self._passing) for call in shown]
            shown = []
        sequences = [
            CallSequence(even, odd, moving, interval, passing, self._together)
            for even, odd in (turns, turns[::-1])
        ]
        return _bound(draw, sequences, [shown, shown] if interval > 1 else [shown[:1], shown[1:]])

    def _bind_temporaries(
        self, turns: Sequence[Sequence[Call]], noise: EpisodeNoise, others: "Sequence[Stepper]"
    ) -> list[tuple[Call, int, int]]:
        """Bind the temporary values of calls to memory of one tile of lanes; return where they are bound.

        Temporary are the noise, and the filters between update and prediction. The result is ``passing`` of
        :class:`.CallSequence`.
        """
        row = noise.next_measurement_call().arrays[2]
        places = {
            id(array): empty_lanes(array.shape[:-1], self._together)
            for each in (self, *others)
            for array in each._written
        }
        places[id(row)] = empty_lanes(row.shape[:-1], self._together)
        found = []
        for call in (call for turn in turns for call in turn):
            for place, array in enumerate(call.arrays):
                memory = places.get(id(row) if call.table[1 + 2 * place] == noise.address else id(array))
                if memory is not None:
                    call.replace(place, memory)
                    found.append((call, place, 0))
        return found

    def _tiled(
        self, turns: Sequence[Sequence[Call]], others: "Sequence[Stepper]" = ()
    ) -> list[tuple[Call, int, int]]:
        """Return ``passing`` of a :class:`.CallSequence`: the arrays of calls that differ from tile to tile."""
        apart = {id(array): hop for each in (self, *others) for array, hop in each._apart}
        calls = [call for turn in turns for call in turn]
        places = [(call, place, apart.get(id(a), 0)) for call in calls for place, a in enumerate(call.arrays)]
        return [each for each in places if each[-1]]

    def _bound_copies(
        self, now: int, noise: EpisodeNoise, reported: Sequence[numpy.ndarray], moving: list[Moving]
    ) -> list[Call]:
        calls = [call.copy() for call in self._calls[now]]
        if self._world_of is None:
            calls[-2].table[self._row_entry] = noise.address
        moving += [moving_array(calls[1], self._report_place + i, each) for i, each in enumerate(reported)]
        return calls

    def run(self, noise: EpisodeNoise, steps: int, compiled_policy: Specialised | None) -> tuple[Any, Any]:
        """Run many measurements in one native call; return the reports on each, and the policy's actions.

        Args:
            noise: of the measurements.
            steps: how many.
            compiled_policy: function of the observation, lane by lane, and of a memory that begins with zeros. It
                returns action and memory; a second run of the same episodes continues. None: a constant action.

        Returns:
            The report on every measurement, in arrays ``(steps, ..., width)``, and the actions in the same form; None
            where there is no policy.
        """
        if self._given:
            self._show_in(self._shown.copy())
        reported = [empty_lanes((steps, *array.shape[:-1]), self.width) for array in self._reported]
        actions, memories = None, [self._blank_memory(compiled_policy), self._blank_memory(compiled_policy)]
        memories[0] = self._policy_memory or memories[0]
        if compiled_policy is not None:
            actions = empty_lanes((steps, *self.action.shape[:-1]), self.width)
        draw = noise.next_measurement_call()
        turns: list[list[Call]] = []
        moving: list[Moving] = []
        for now in (self._now, 1 - self._now):
            update, report_code, *others = self._bound_copies(now, noise, reported, moving)
            others[-1].replace(len(others[-1].arrays) - 1, self._shown)
            turns.append([update, report_code, draw, *others])
            if compiled_policy is not None and actions is not None:
                steer = compiled_policy.bound([self._shown, *memories[0]], [actions[0], *memories[1]])
                turns[-1].insert(0, steer)
                moving.append(moving_array(steer, 1 + len(memories[0]), actions))
                moving.append(moving_array(update, self._action_place, actions))
                memories.reverse()
        even, odd = turns
        sequence = CallSequence(even, odd, moving, steps, self._tiled(turns), self._together)
        sequence.run_once(self.width, self._threads)
        self._now, self._policy_memory = (self._now + steps) % 2, memories[steps % 2]
        reports = [
            array if kind == "f" else array.astype(DTYPES[kind])
            for array, kind in zip(reported, self._report_kinds, strict=True)
        ]
        return map_arrays(lambda i: reports[i], self._report_template), actions

    def _blank_memory(self, compiled_policy: Specialised | None) -> list[numpy.ndarray]:
        blank = memory_of(compiled_policy.outputs[1:] if compiled_policy else (), self.width)
        for array in blank:
            array[...] = 0.0
        return blank

    def reports(self) -> list[Any]:
        """Return the reports of the last :meth:`decide`, one for each measurement, arrays ``(..., width)``."""
        return [
            copy_arrays(self._report_template, [rows[k] for rows in self.reported], self._report_kinds)
            for k in range(self._interval)
        ]

    def first_reward(self, baseline: "Stepper | None") -> float:
        """Return the first lane's mean reward of the last decision, minus that of a baseline if given."""
        if self._interval == 1:
            own: float = self._first_rewards.item(0)
            return own if baseline is None else own - baseline._first_rewards.item(0)
        rewards = self._first_rewards if baseline is None else self._first_rewards - baseline._first_rewards
        return mean_reward(rewards.tolist())

    @property
    def rewards(self) -> numpy.ndarray:
        """Rewards at the measurements of the last decision, ``(interval, width)``, if the report is a reward.

        Several rows are valid until the next decision.
        """
        return self.reported[0] if self._interval > 1 else self.reported[0].copy()

    def observation_by_field(self) -> numpy.ndarray:
        """Return the observation of all lanes, ``(fields, width)``, valid until the next step."""
        return self._shown.T

    def observation(self, count: int) -> numpy.ndarray:
        """Return the observation of the first ``count`` lanes, batch first, in memory that is not overwritten."""
        if count < MANY:
            return self._shown[:count].copy()
        self._given = True
        return self._shown[:count]

    def observation_of_first(self) -> numpy.ndarray:
        """Return the observation of the first lane, ``(fields,)``, in memory that is not overwritten."""
        return self._first_shown.copy()

    def _show_in(self, memory: numpy.ndarray) -> None:
        self._shown, self._first_shown, self._given = memory, memory[0], False


class _Bound(NamedTuple):
    """One native call in two forms: from either of the two copies of the episodes."""

    draw: Call
    """Call that makes the noise of a measurement."""
    sequences: list[CallSequence]
    shown: list[list[Call]]
    """Calls from each copy whose last array is the observation: its memory is inserted before they run."""


def _bound(draw: Call, sequences: list[CallSequence], shown: list[list[Call]]) -> _Bound:
    sequences[1].count_with(sequences[0])
    return _Bound(draw, sequences, shown)


def _side_by_side(arrays: Sequence[Leaf], width: int, tile: int) -> tuple[numpy.ndarray, list[numpy.ndarray]]:
    """Return memory for several arrays, ``(numbers, tiles, tile)``, and views, ``(..., tiles, tile)`` each.

    The numbers of a tile are adjacent.
    """
    starts = numpy.cumsum([0, *(leaf.rows for leaf in arrays)]).tolist()
    if tile == width:
        numbers = empty_lanes((starts[-1], 1), width)
    else:
        tiles = empty_lanes((width // tile,), starts[-1] * tile)
        numbers = tiles.reshape(len(tiles), starts[-1], tile).swapaxes(0, 1)
    parts = zip(arrays, starts, strict=False)
    return numbers, [
        numbers[at : at + leaf.rows].reshape(*leaf.shape, *numbers.shape[1:]) for leaf, at in parts
    ]
