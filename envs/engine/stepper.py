"""Episodes of a compiled model in memory of their own, bound to its code once and for all."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy

from ...compiler.functions import (
    DTYPES,
    UNCOUNTED,
    Call,
    Leaf,
    Specialised,
    empty_lanes,
    leaves,
    map_arrays,
    run_over,
)
from ...compiler.sequence import CallList, CallSequence, Moving, moving_array
from ..contract.model import Episode
from ..contract.observation import Array, DecisionMeans
from .episode_noise import EpisodeNoise
from .programs import Report

ANSWERING = 2
"""Of the four parts of a step the first ones: update and report; the others let a measurement arrive."""
MANY = 64
"""Lanes from which on observations are written where the caller will keep them, instead of into a copy."""


class Stepper:
    """Episodes of a compiled model in memory of their own, stepped by actions.

    Args:
        model: compiled.
        report: made of every episode after the action.
        width: lanes, a multiple of eight.
        world_of: a stepper of the same task, both filters in an open loop. Its world is this one's too, and nobody
            looks at what this one shows. Whatever is done with both is done with it first.

    Attributes:
        action: applied at every step, ``(..., width)``.
    """

    def __init__(self, model: Any, report: Report, width: int, world_of: "Stepper | None" = None) -> None:
        update, advance, predict, episode = model.programs.later
        tell = model.programs.report_program(report)
        truths, measured, states = (len(leaves(part)) for part in episode)
        self.width, self._threads, self._model, self._report = width, model.threads, model, report
        self._world_of, self._shared = world_of, 0 if world_of is None else truths + measured
        count = itertools.count()
        self._template, self._kinds = map_arrays(lambda _: next(count), episode), _kinds(leaves(episode))
        count = itertools.count()
        self._filter_template = map_arrays(lambda _: next(count), episode.filter)
        self._filter_kinds = self._kinds[truths + measured :]
        self._report_template, self._report_kinds = tell.template, [leaf.kind for leaf in tell.outputs]

        def memory(outputs: Sequence[Leaf]) -> list[numpy.ndarray]:
            return [empty_lanes(leaf.shape, width) for leaf in outputs]

        self.action = empty_lanes(update.inputs[-1].shape, width)
        self.action[...] = 0.0
        fields = predict.outputs[-1].shape[0] if world_of is None else 0
        self._shown, self._given = numpy.empty((width, fields)), False
        self._reported = memory(tell.outputs)
        knows = bool(model.filter.knows)
        # Episodes go to and fro between two copies, which share what stays as it is. Of the filter they share what is
        # not read any more when the prediction is written: all but what the update has handed on.
        outputs = [*advance.outputs, *predict.outputs[:-1]][self._shared :]
        ahead_of_filter = truths if knows else 0
        handed_on = [ahead_of_filter + i in update.same for i in range(states)]
        stays = [*(same is not None for same in advance.same), *(not handed for handed in handed_on)]
        stays = stays[self._shared :]
        self._policy_memory: list[numpy.ndarray] = []
        """After the last :meth:`run`; none before the first one of an episode."""
        self._staying, staying = _side_by_side([o for o, s in zip(outputs, stays, strict=True) if s], width)
        self._going: list[numpy.ndarray] = []
        """Of each copy the numbers of all arrays that are not shared, ``(numbers, width)``."""
        self._copies: list[list[numpy.ndarray]] = []
        for world in ([], []) if world_of is None else world_of._copies:
            numbers, going = _side_by_side([o for o, s in zip(outputs, stays, strict=True) if not s], width)
            self._going.append(numbers)
            kept, own = iter(staying), iter(going)
            self._copies.append([*world[: self._shared], *(next(kept if s else own) for s in stays)])
        first, second = self._copies
        written = self._written = memory(update.outputs)
        row = empty_lanes((advance.inputs[-1].rows,), width)  # its place is taken by that of the noise
        self._calls, self._begin = [], []
        self._updated: list[list[numpy.ndarray]] = []
        """State of the filter after the update, of each copy."""
        self._is_put = False
        """Whether it is not that of the last update, but one that was put in its place."""
        world, start = model.programs.start
        begun = model.programs.first
        self._drawn = memory(world.inputs)
        self._initial: list[numpy.ndarray] = (
            memory(world.outputs[truths:]) if world_of is None else world_of._initial
        )
        for now, then in ((first, second), (second, first)):
            truth, measurement = now[:truths], now[truths : truths + measured]
            given = [*(truth if knows else []), *now[truths + measured :], *measurement, self.action]
            updated = [own if i is None else given[i] for own, i in zip(written, update.same, strict=True)]
            self._updated.append(updated[:states])
            ahead, predicted = then[: truths + measured], then[truths + measured :]
            step = [
                update.bound(given, written),
                tell.bound([*truth, *measurement, *updated[:states]], self._reported),
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
        self._lists: dict[tuple[Call, ...], CallList] = {}
        self._stepped = 0
        """Lanes that steps went over and that no code was told of."""
        self._small: dict[int, Stepper] = {}
        """Steppers in which the episodes of a few lanes begin, by their width."""
        self._row_entry = 1 + 2 * (len(advance.inputs) - 1)
        self._action_place, self._report_place = len(update.inputs) - 1, len(tell.inputs)

    def load(self, episode: Episode, shown: Array = None) -> None:
        """Go on from other episodes, which show what is given, ``(fields, width)``."""
        own = zip(self._copies[self._now], leaves(episode), strict=True)
        for memory, values in itertools.islice(own, self._shared, None):
            memory[...] = values
        if shown is not None:
            self._shown[...] = shown.T

    def episode(self) -> Episode:
        """Return the episodes, in arrays that stay as they are."""
        return _copy_numbers(self._template, self._copies[self._now], self._kinds)

    def begin(self, uniforms: numpy.ndarray, normals: numpy.ndarray, noise: EpisodeNoise) -> None:
        """Start new episodes everywhere and let their first measurement arrive.

        Args:
            uniforms: of the scenario, ``(uniforms, width)``.
            normals: of the start of the track, ``(initial_normals, width)``.
            noise: of the measurements.
        """
        self._policy_memory = []
        for memory, values in zip(self._drawn, (uniforms, normals), strict=True):
            memory[...] = values
        for call in self._begin[self._now]:
            call.expect(self.width)
        self._run(self._begin[self._now], noise)

    def begin_some(
        self, lanes: numpy.ndarray, uniforms: numpy.ndarray, normals: numpy.ndarray, noise: EpisodeNoise
    ) -> None:
        """Start new episodes in some lanes and let their first measurement arrive.

        Args:
            lanes: which.
            uniforms: theirs, padded to the width of ``noise``, likewise what follows.
            normals: as in :meth:`begin`.
            noise: of these episodes.
        """
        small = self._small.get(noise.width)
        if small is None:
            beside = None if self._world_of is None else self._world_of._small[noise.width]
            small = self._small[noise.width] = Stepper(self._model, self._report, noise.width, beside)
        small.begin(uniforms, normals, noise)
        for numbers, begun in (
            (self._staying, small._staying),
            (self._going[self._now], small._going[small._now]),
        ):
            numbers[:, lanes] = begun[:, : len(lanes)]
        if self._given:
            self._show_in(self._shown.copy())
        self._shown[lanes] = small._shown[: len(lanes)]

    def take(self, action: numpy.ndarray) -> None:
        """Apply an action from the next step on, batch first, of all lanes or of the first."""
        self.action[..., : len(action)] = action.T if action.ndim == 2 else action

    def answer(self) -> None:
        """Apply the action to the measurement at hand, and report on it."""
        for call in self._calls[self._now][:ANSWERING]:
            call(0, self.width)

    def arrive(self, noise: Any) -> None:
        """Go on to the next measurement, whose numbers are those of an :class:`EpisodeNoise`, or a
        :class:`.MeasurementRow`.
        """
        calls = self._begin if self._is_put else self._calls
        self._is_put = False
        self._run(calls[self._now][ANSWERING:], noise)

    @property
    def filter_state(self) -> Any:
        """State of the filter after the last :meth:`answer`, in arrays that stay as they are."""
        arrays = self._written if self._is_put else self._updated[self._now]
        return _copy_numbers(self._filter_template, arrays, self._filter_kinds)

    @filter_state.setter
    def filter_state(self, state: Any) -> None:
        for memory, values in zip(self._written, leaves(state), strict=False):
            memory[...] = values
        self._is_put = True

    def step(self, noise: EpisodeNoise, others: "Sequence[Stepper]" = ()) -> None:
        """Answer and go on to the next measurement, and let others do so after it: some lanes after the others through
        all of it.
        """
        calls = self._calls_of_step(noise)
        for each in others:
            calls += each._calls_of_step(noise)
        self._run_calls(calls)

    def _calls_of_step(self, noise: EpisodeNoise) -> tuple[Call, ...]:
        self._stepped += self.width
        if self._stepped > UNCOUNTED:
            for call in itertools.chain(*self._calls):
                call.expect(self._stepped // 2)
            self._stepped = 0
        return self._go_on(self._calls[self._now], noise)

    def _run(self, calls: Sequence[Call], noise: Any) -> None:
        self._run_calls(self._go_on(calls, noise))

    def _go_on(self, calls: Sequence[Call], noise: Any) -> tuple[Call, ...]:
        """What is to be called for the next measurement, whose numbers come first; the other copy is then of now."""
        if self._given:
            self._show_in(numpy.empty_like(self._shown))
        if self._world_of is None:
            calls[-2].table[self._row_entry] = noise.address
        self._now = 1 - self._now
        return (*noise.calls(), *calls)

    def _run_calls(self, calls: tuple[Call, ...]) -> None:
        found = self._lists.get(calls)
        if found is None:
            found = self._lists[calls] = CallList(calls)
        run_over(found, self.width, self._threads)

    def run(self, noise: EpisodeNoise, steps: int, compiled_policy: Specialised | None) -> tuple[Any, Any]:
        """Go through many measurements without going back to Python between them.

        Args:
            noise: of the measurements.
            steps: how many.
            compiled_policy: function of what is shown, read lane by lane, and of a memory that begins with zeros in
                each episode, to an action and the memory. None: the action stays as it is.

        Returns:
            The report on every measurement, in arrays ``(steps, ..., width)``, and the actions, likewise; None where
            there is no policy.
        """
        if self._given:
            self._show_in(self._shown.copy())
        reported = [empty_lanes((steps, *array.shape[:-1]), self.width) for array in self._reported]
        blank = self._blank_memory(compiled_policy)
        actions, memories = None, [self._policy_memory or blank, self._blank_memory(compiled_policy)]
        if compiled_policy is not None:
            actions = empty_lanes((steps, *self.action.shape[:-1]), self.width)
        draw = noise.call_of_each()
        turns: list[list[Call]] = []
        moving: list[Moving] = []
        for now in (self._now, 1 - self._now):
            update, tell, advance, predict = (call.copy() for call in self._calls[now])
            advance.table[self._row_entry] = noise.address
            moving += [moving_array(tell, self._report_place + i, each) for i, each in enumerate(reported)]
            turns.append([update, tell, draw, advance, predict])
            if compiled_policy is not None and actions is not None:
                steer = compiled_policy.bound([self._shown, *memories[0]], [actions[0], *memories[1]])
                turns[-1].insert(0, steer)
                moving.append(moving_array(steer, 1 + len(memories[0]), actions))
                moving.append(moving_array(update, self._action_place, actions))
                memories.reverse()
        CallSequence(turns[0], turns[1], moving).run(steps, self.width, self._threads)
        self._now = (self._now + steps) % 2
        self._policy_memory = memories[steps % 2]
        answers = [
            array if kind == "f" else array.astype(DTYPES[kind])
            for array, kind in zip(reported, self._report_kinds, strict=True)
        ]
        return map_arrays(lambda i: answers[i], self._report_template), actions

    def _blank_memory(self, compiled_policy: Specialised | None) -> list[numpy.ndarray]:
        """Memory of a policy before its first action."""
        blank = (
            [empty_lanes(leaf.shape, self.width) for leaf in compiled_policy.outputs[1:]]
            if compiled_policy
            else []
        )
        for array in blank:
            array[...] = 0.0
        return blank

    def report(self) -> Any:
        """Return the last report, in arrays ``(..., width)`` that stay as they are."""
        return _copy_numbers(self._report_template, self._reported, self._report_kinds)

    def observation_by_field(self) -> numpy.ndarray:
        """What is shown, ``(fields, width)``, until the next step."""
        return self._shown.T

    def show_means(self, means: DecisionMeans, total: numpy.ndarray) -> None:
        """Show means over a decision, of which the sums are given."""
        means.write(self._shown.T, total)

    def observation(self, count: int) -> numpy.ndarray:
        """Observation of the first lanes, batch first; the caller may keep it."""
        if count < MANY:
            return self._shown[:count].copy()
        self._given = True
        return self._shown[:count]

    def _show_in(self, memory: numpy.ndarray) -> None:
        """Write observations into other memory, ``(width, fields)``, from now on."""
        self._shown, self._given = memory, False
        for *_, predict in (*self._calls, *self._begin):
            predict.replace(len(predict.arrays) - 1, memory)


def _side_by_side(arrays: Sequence[Leaf], width: int) -> tuple[numpy.ndarray, list[numpy.ndarray]]:
    """Memory of all numbers of some arrays, ``(numbers, width)``, and the arrays in it, ``(..., width)``."""
    numbers = empty_lanes((sum(leaf.rows for leaf in arrays),), width)
    starts = numpy.cumsum([0, *(leaf.rows for leaf in arrays)]).tolist()
    parts = zip(arrays, starts, strict=False)
    return numbers, [numbers[at : at + leaf.rows].reshape(*leaf.shape, width) for leaf, at in parts]


def _kinds(arrays: Sequence[numpy.ndarray]) -> list[str]:
    return [array.dtype.kind for array in arrays]


def _copy_numbers(template: Any, memory: Sequence[numpy.ndarray], kinds: Sequence[str]) -> Any:
    """Copies of arrays of numbers in their places, in their own types."""

    def copied(i: int) -> numpy.ndarray:
        return memory[i].astype(DTYPES[kinds[i]], order="C")

    return map_arrays(copied, template)
