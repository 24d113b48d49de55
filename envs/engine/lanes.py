"""The engine: episodes of a model side by side, each fixed by its identity.

A *lane* is one episode after another, whose identities one generator draws (:mod:`.episode_noise`). Both Gymnasium
faces and the evaluation drive this class; it owns the noise and knows nothing of spaces or autoreset.

**Bit equality.** The batch is padded to a multiple of eight lanes, also for one episode: BLAS chooses its
kernels by the width, and widths that are multiples of eight agree. So lane i of N equals the single
environment with the same seed bit for bit.

**What steps them.** A compiled model whose report can be traced moves its episodes in memory of its own
(:class:`~.stepper.Stepper`), any other by the model's functions (:class:`ModelStepper`), both by the same calls.
"""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy

from ...compiler.block import LANES
from ...compiler.functions import Specialised, map_arrays, round_up_lanes
from ...filters.ordered_sums import ordered_sum
from ..contract.model import Episode, Model
from ..contract.observation import Array, DecisionMeans
from .compiled import can_step, share_world
from .episode_noise import EpisodeNoise
from .programs import Report
from .reward import OWN_REWARDS, RewardBaseline
from .stepper import Stepper


def whole_episode(model: Model, episode: Episode) -> Episode:
    """Report the state itself."""
    return episode


def mean_of(rewards: Sequence[Array]) -> Array:
    """Mean over the measurements of one decision."""
    return ordered_sum(rewards) / len(rewards) if len(rewards) > 1 else rewards[0]


def _replace_lanes(old: Any, new: Any, lanes: Any) -> Any:
    """Return ``old`` with its last-axis entries ``lanes`` taken from ``new``, for nested tuples and dictionaries of
    arrays.
    """
    if old is None:
        return None
    if isinstance(old, dict):
        return {name: _replace_lanes(part, new[name], lanes) for name, part in old.items()}
    if isinstance(old, tuple):
        parts = [_replace_lanes(a, b, lanes) for a, b in zip(old, new, strict=True)]
        return type(old)(*parts) if hasattr(old, "_fields") else tuple(parts)
    # A copy, because states are never changed in place: someone may still hold the old one.
    merged = old.astype(new.dtype) if isinstance(old, numpy.ndarray) else old.to(new.dtype, copy=True)
    merged[..., lanes] = new[..., : len(lanes)]
    return merged


class ModelStepper:
    """Episodes stepped by the functions of their model, in arrays that never change.

    Args:
        model: whose episodes they are.
        width: lanes, a multiple of eight.
        report: function of model and episodes after the action; None makes no report.
    """

    def __init__(self, model: Model, width: int, report: Report | None = None) -> None:
        self.model, self.width, self.report_function = model, width, report
        self._episode: Any = None
        self._shown: Array = None
        """What is shown, ``(fields, width)``; None until it is computed."""
        self._action: Array = None
        self._report: Any = None

    def begin(self, uniforms: Array, normals: Array, noise: EpisodeNoise) -> None:
        """Start new episodes everywhere and let their first measurement arrive."""
        self.load(self.model.measure(self.model.begin(uniforms, normals), noise.row))

    def load(self, episode: Episode, shown: Array = None) -> None:
        """Go on from other episodes; what they show is observed from them unless it is given."""
        self._episode, self._shown = episode, shown

    def begin_some(self, lanes: numpy.ndarray, uniforms: Array, normals: Array, noise: EpisodeNoise) -> None:
        """Start new episodes in some lanes and let their first measurement arrive, see :meth:`.Stepper.begin_some`."""
        task = self.model.task
        episode = self.model.measure(self.model.begin(uniforms, normals), noise.row)
        where = lanes if task.xp is numpy else task.xp.asarray(lanes, device=task.device)
        if self._shown is not None:
            self._shown = _replace_lanes(self._shown, self.model.observe(episode), where)
        self._episode = _replace_lanes(self._episode, episode, where)

    def episode(self) -> Episode:
        """Return the episodes."""
        return self._episode

    def take(self, action: Array) -> None:
        """Apply an action from the next step on, batch first, of all lanes or of the first."""
        xp, turned = self.model.task.xp, action.T if action.ndim == 2 else action
        if not isinstance(self.model.action_space, gymnasium.spaces.Discrete):
            turned = xp.astype(turned, xp.float64, copy=False)
        missing = self.width - turned.shape[-1]
        if missing:
            padding = xp.zeros(
                (*turned.shape[:-1], missing), dtype=turned.dtype, device=self.model.task.device
            )
            turned = xp.concat([turned, padding], axis=-1)
        self._action = turned

    def answer(self) -> None:
        """Apply the action to the measurement at hand, and report on it."""
        self._episode = self.model.act(self._episode, self._action)
        if self.report_function is not None:
            self._report = self.model.run(self.report_function, self._episode)

    def arrive(self, noise: Any) -> None:
        """Go on to the next measurement, see :meth:`.Stepper.arrive`."""
        self.load(self.model.measure(self._episode, noise.row))

    def step(self, noise: EpisodeNoise, others: "Sequence[ModelStepper]" = ()) -> None:
        """Answer and go on to the next measurement, and let others do so after it."""
        for each in (self, *others):
            each.answer()
            each.arrive(noise)

    @property
    def filter_state(self) -> Any:
        """State of the filter."""
        return self._episode.filter

    @filter_state.setter
    def filter_state(self, state: Any) -> None:
        before = self._episode or Episode((), None, None)
        self._episode = before._replace(filter=state)

    def report(self) -> Any:
        """Return the last report, in arrays ``(..., width)``."""
        return self._report

    def observation_by_field(self) -> Array:
        """What is shown, ``(fields, width)``."""
        if self._shown is None:
            self._shown = self.model.observe(self._episode)
        return self._shown

    def observation_if_computed(self) -> Array:
        """What is shown where it was computed, else None."""
        return self._shown

    def show_means(self, means: DecisionMeans, total: Array) -> None:
        """Show means over a decision, of which the sums are given."""
        self._shown = means.show(self.observation_by_field(), total, self.model.task.xp)

    def observation(self, count: int) -> Array:
        """Observation of the first lanes, batch first; the caller may keep it."""
        shown = self.observation_by_field()[:, :count].T
        # Contiguous, in memory of its own.
        return shown.copy() if isinstance(shown, numpy.ndarray) else shown.contiguous()


def make_stepper(model: Model, report: Report, width: int) -> Stepper | ModelStepper:
    """Return what steps episodes of a model in its fastest way; arguments as of :class:`ModelStepper`."""
    return Stepper(model, report, width) if can_step(model, report) else ModelStepper(model, width, report)


class Lanes:
    """``count`` episodes of a model side by side.

    Args:
        model: task with a filter; the task's namespace decides where arrays live.
        count: number of lanes.
        beside: what the reward is relative to, run beside it on the same noise.
        on_start: called with new episodes at the start of the track, before their first measurement.
        longest: decisions after which an episode ends at the latest; default: the task's horizon.
        report: that will be made of them, in whose code they then begin; default: not known.

    Attributes:
        decisions: actions taken in each lane's current episode, ``(count,)``.
        noise: random numbers of the episodes.
    """

    def __init__(
        self,
        model: Model,
        count: int,
        beside: RewardBaseline | None = None,
        on_start: Callable[[Episode], None] | None = None,
        longest: int | None = None,
        report: Report | None = None,
    ) -> None:
        self.model = model
        self.task = task = model.task
        self.count = count
        self.width = round_up_lanes(count)
        self.beside = beside
        self._models = [model] if beside is None else [model, beside.model]
        self._on_start, self._report = on_start, report
        self._steppers: dict[Report, list[Stepper]] = {}
        """Those of compiled models, by what they report."""
        self._moving: list[Any] = []
        """Steppers that hold the episodes, of the task and of what runs beside it; none before the first episode."""
        self.noise = EpisodeNoise(task, count)
        self._some: dict[int, EpisodeNoise] = {}
        """Noise of lanes that restart while others fly on, by their number."""
        self.decisions = numpy.zeros(count, dtype=numpy.int64)
        horizon = task.horizon // task.decision_interval
        self.decisions_per_episode = horizon if longest is None else min(horizon, longest)
        self._lengths = numpy.full(count, self.decisions_per_episode)
        """Decisions of each lane's episode."""
        self._means = DecisionMeans(model.fields, task.decision_interval)

    # --- episodes

    def seed(self, lane: int, generator: numpy.random.Generator) -> None:
        """Give a lane the generator that its coming episodes are drawn from."""
        self.noise.seed(lane, generator)

    def restart(self, lanes: Sequence[int] | None = None) -> None:
        """Start new episodes in some lanes (default: all) and let their first measurement arrive."""
        chosen = range(self.count) if lanes is None or len(lanes) == self.count else lanes
        self.begin(self.noise.draw_identities(chosen), chosen)

    def begin(self, identities: numpy.ndarray, lanes: Sequence[int] | None = None) -> None:
        """Start the episodes of these identities and let their first measurement arrive.

        Args:
            identities: ``(2, lanes)``, see :mod:`.episode_noise`.
            lanes: in which, ascending; default: all.
        """
        task = self.task
        everyone = lanes is None or len(lanes) == self.count
        index = numpy.arange(self.count) if lanes is None else numpy.asarray(lanes)
        noise = self.noise if everyone else self._noise_of_some(len(index))
        uniforms, normals = noise.begin(identities)
        self.decisions[index] = 0
        if task.flights:
            lengths = task.lengths(uniforms[:, : len(index)]) // task.decision_interval
            self._lengths[index] = numpy.minimum(lengths, self.decisions_per_episode)
        start = tuple(task.xp.asarray(numbers, device=task.device) for numbers in (uniforms, normals))
        if self._on_start is not None:
            self._on_start(self.model.begin(*start))
        if everyone:
            if not self._moving and self._report is not None:
                self._reporting(self._report)
            self._moving = self._moving or self._by_functions()
            for stepper in self._moving:
                stepper.begin(*start, noise)
            return
        for stepper in self._moving:
            stepper.begin_some(index, *start, noise)
        self.noise.take(noise, index)

    def _noise_of_some(self, count: int) -> EpisodeNoise:
        """Noise of so many lanes that restart, in one of a few sizes."""
        width = LANES
        while width < count:
            width *= 2
        if width not in self._some:
            self._some[width] = EpisodeNoise(self.task, width)
        return self._some[width]

    def step_reward(self, action: Array, kind: str) -> Array:
        """Apply one decision and return its reward, the mean over its measurements, ``(count,)``.

        Args:
            action: batch first, as the action space has it.
            kind: one of :data:`~.reward.REWARDS`.
        """
        answers = self.decide(action, OWN_REWARDS[kind])
        return mean_of([own if other is None else own - other for own, other in answers])[: self.count]

    def decide(self, action: Array, report: Report = whole_episode) -> list[tuple[Any, Any]]:
        """Apply one decision to as many measurements as it holds for, and report on each.

        Args:
            action: batch first, as the action space has it.
            report: function of a model and its episodes after the action; not made anew for each call.

        Returns:
            The reports on every measurement that the decision held for, arrays ``(..., width)``: of the model, and of
            ``beside`` (None without).
        """
        steppers = self._reporting(report)
        own = steppers[0]
        own.take(action)
        answers: list[tuple[Any, Any]] = []
        total: Any = 0.0
        for _ in range(self.task.decision_interval):
            self.noise.advance()
            own.step(self.noise, steppers[1:])
            answers.append((own.report(), steppers[1].report() if self.beside else None))
            if self._means.columns:
                total = self._means.add(total, own.observation_by_field())
        if self._means.columns:
            own.show_means(self._means, total)
        self.decisions += 1
        return answers

    def run(
        self, report: Report, compiled_policy: Specialised | None = None, measurements: int | None = None
    ) -> tuple[Any, Any]:
        """Run episodes on in native code, from where the last call left them, and report on every measurement.

        Args:
            report: that :func:`.compiled.can_step` with, as of :meth:`decide`.
            compiled_policy: as of :meth:`.stepper.Stepper.run`; None: the action is zero.
            measurements: after which they are left, a multiple of the decision interval; default: those of an episode.

        Returns:
            Reports, arrays ``(measurements, ..., width)``, and the actions, likewise, of the policy.
        """
        (stepper,) = self._reporting(report)
        stepper.take(numpy.zeros((self.width, *(self.model.action_space.shape or ()))))
        interval = self.task.decision_interval
        steps = self.decisions_per_episode * interval if measurements is None else measurements
        answer: tuple[Any, Any] = stepper.run(self.noise, steps, compiled_policy)
        self.decisions += steps // interval
        return answer

    def next_row(self) -> Array:
        """Noise of the next measurement, ``(row width, width)`` of episodes that are stepped elsewhere."""
        self.noise.advance()
        return self.noise.row

    # --- what steps them

    def _by_functions(self) -> list[Any]:
        """Steppers by the models' functions, without episodes."""
        steppers = [ModelStepper(model, self.width) for model in self._models]
        if self.beside is not None:
            steppers[1].take(self._beside_action(self.width))
        return steppers

    def _beside_action(self, count: int) -> Array:
        """Action of what runs beside, batch first."""
        assert self.beside is not None
        actions = [self.beside.action] * count
        discrete = isinstance(self.beside.action, int)
        return (
            self.task.xp.asarray(actions, device=self.task.device)
            if discrete
            else self.task.constant(actions)
        )

    def _reporting(self, report: Report) -> list[Any]:
        """Steppers that make a report, which hold the episodes from now on."""
        if self._moving is self._steppers.get(report):
            return self._moving
        if report not in self._steppers and all(can_step(model, report) for model in self._models):
            steppers = self._steppers[report] = [Stepper(self.model, report, self.width)]
            if self.beside is not None:
                world_of = steppers[0] if share_world(*self._models) else None
                steppers.append(Stepper(self.beside.model, report, self.width, world_of))
                steppers[1].take(self._beside_action(self.width))
        before, after = self._moving, self._steppers.get(report)
        if after is None:
            self._settle()
            for stepper in self._moving:
                stepper.report_function = report
            return self._moving
        for i, (old, new) in enumerate(zip(before, after, strict=bool(before))):
            new.load(old.episode(), old.observation_by_field() if i == 0 else None)
        self._moving = after
        return after

    def _settle(self) -> None:
        """Let the models' functions step the episodes, in arrays of their own."""
        if self._moving and not isinstance(self._moving[0], ModelStepper):
            before, self._moving = self._moving, self._by_functions()
            for i, (old, new) in enumerate(zip(before, self._moving, strict=True)):
                averaged = i == 0 and self._means.columns
                new.load(old.episode(), old.observation_by_field().copy() if averaged else None)

    @property
    def has_episodes(self) -> bool:
        """Whether there are episodes."""
        return bool(self._moving)

    @property
    def state(self) -> Any:
        """The episodes after the last measurement, lanes padded to a multiple of eight."""
        return self._moving[0].episode()

    @state.setter
    def state(self, state: Any) -> None:
        self._settle()
        self._moving[0].load(state)

    def __getstate__(self) -> dict[str, Any]:
        """All but what is bound to memory: a copy makes its own."""
        self._settle()
        return {**self.__dict__, "_steppers": {}, "_some": {}}

    def grow(self, count: int) -> None:
        """Make room for more lanes; the new ones fly some episode until they are restarted.

        Args:
            count: a multiple of eight.
        """
        self._settle()
        beyond = numpy.zeros(count - self.width, dtype=numpy.int64)
        index = self.task.xp.asarray(numpy.append(numpy.arange(self.width), beyond), device=self.task.device)
        parts = map_arrays(lambda values: self.task.xp.take(values, index, axis=-1), self._episodes())
        added = count - self.count
        self.decisions = numpy.append(self.decisions, numpy.zeros(added, dtype=numpy.int64))
        self._lengths = numpy.append(self._lengths, numpy.full(added, self.decisions_per_episode))
        self.noise.grow(count, numpy.append(numpy.arange(self.width), beyond))
        self.count = self.width = count
        self._steppers, self._moving = {}, self._by_functions()
        self._load(parts)

    # --- copies, growth, gradients

    def _episodes(self) -> tuple[Any, ...]:
        """Episodes of every task with what is shown of them; the arrays never change."""
        return tuple((stepper.episode(), stepper.observation_if_computed()) for stepper in self._moving)

    def _load(self, episodes: tuple[Any, ...]) -> None:
        for stepper, (episode, shown) in zip(self._moving, episodes, strict=True):
            stepper.load(episode, shown)

    def detach(self) -> None:
        """Cut the gradient: what follows no longer remembers how it came about (torch only)."""
        self._load(map_arrays(lambda tensor: tensor.detach(), self._episodes()))

    def snapshot(self) -> dict[str, Any]:
        """Return all that the coming steps depend on; :meth:`restore` goes back to it, as often as one likes."""
        self._settle()
        kept = {"decisions": self.decisions.copy(), "_lengths": self._lengths.copy()}
        return {"count": self.count, "episodes": self._episodes(), "noise": self.noise.snapshot(), **kept}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot of lanes of the same task.

        Raises:
            ValueError: if their number differs.
        """
        if snapshot["count"] != self.count:
            raise ValueError(f"the snapshot holds {snapshot['count']} environments, not {self.count}")
        self.noise.restore(snapshot["noise"])
        self.decisions, self._lengths = snapshot["decisions"].copy(), snapshot["_lengths"].copy()
        self._moving = self._by_functions() if snapshot["episodes"] else []
        self._load(snapshot["episodes"])

    def shorten(self, lanes: Sequence[int], decisions: numpy.ndarray) -> None:
        """Let the episodes that have just begun in some lanes end so many decisions early, but take one at least."""
        self.decisions[list(lanes)] = numpy.minimum(decisions, self._lengths[list(lanes)] - 1)

    @property
    def done(self) -> numpy.ndarray:
        """Lanes whose episode is over, ``(count,)`` booleans."""
        return self.decisions >= self._lengths

    def observe(self) -> Array:
        """Observation of every lane, batch first: ``(count, len(model.fields))``; the caller may keep it."""
        return self._moving[0].observation(self.count)
