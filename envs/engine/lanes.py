"""The engine: parallel episodes of a model, each determined by its identity.

A *lane* is one episode after another, whose identities one generator draws (:mod:`.episode_noise`). Both Gymnasium
classes and the evaluation use :class:`Lanes`.

**Bit equality.** The batch is padded to a multiple of eight lanes, also for one episode: BLAS chooses its
kernels by the width, and widths that are multiples of eight agree. So lane i of N equals the single
environment with the same seed bit for bit.

**Steppers.** A compiled model whose report can be traced has a :class:`~.stepper.Stepper`, any other a
:class:`ModelStepper`.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import gymnasium
import numpy

from ...compiler.block import LANES
from ...compiler.functions import Specialised, map_arrays, round_up_lanes
from ...filters.array_namespace import host_array, map_nested
from ..contract.model import Episode, Model
from ..contract.observation import Array, DecisionMeans
from ..contract.task import Task
from .compiled import can_step, share_world
from .episode_noise import EpisodeNoise
from .programs import Report
from .reward import REWARD_FUNCTIONS, RewardBaseline
from .stepper import Stepper, mean_reward


def whole_episode(model: Model, episode: Episode) -> Episode:
    """Return the episode unchanged: a report function that reports the whole state."""
    return episode


def _replace_lanes(old: Any, new: Any, lanes: Any) -> Any:
    def replaced(old: Array, new: Array) -> Array:
        # A copy, because states are never changed in place: the old one may still be in use.
        merged = old.astype(new.dtype) if isinstance(old, numpy.ndarray) else old.to(new.dtype, copy=True)
        merged[..., lanes] = new[..., : len(lanes)]
        return merged

    return map_nested(replaced, old, new)


class EpisodeStepper(Protocol):
    """Protocol of the objects that step a model's episodes: :class:`.Stepper` and :class:`ModelStepper`.

    ``others`` are steppers of the same kind, width and task. Each call on the first one also
    applies to them, on the same noise.
    """

    def begin(self, identities: numpy.ndarray, noise: EpisodeNoise, others: Any) -> tuple[Array, Array]:
        """Start new episodes in all lanes up to the first measurement; return the uniform and normal numbers used."""
        ...

    def begin_some(
        self, lanes: numpy.ndarray, identities: numpy.ndarray, noise: EpisodeNoise, others: Any
    ) -> tuple[Array, Array]:
        """Start new episodes in some lanes up to the first measurement; return the uniform and normal numbers used."""
        ...

    def load(self, episode: Episode, observation: Array = None) -> None:
        """Replace the running episodes and their observation, ``(fields, width)``; None: compute it."""
        ...

    def episode(self) -> Episode:
        """Return the running episodes of all lanes, in arrays that are never changed."""
        ...

    def take(self, action: Array) -> None:
        """Set the action of the next decisions, batch first, for all lanes or for the first ones."""
        ...

    def decide(self, noise: EpisodeNoise, others: Any) -> None:
        """Step all lanes through the measurements of one decision, and compute the report on each."""
        ...

    def reports(self) -> list[Any]:
        """Return the reports of the last :meth:`decide`, one for each measurement, arrays ``(..., width)``."""
        ...

    @property
    def rewards(self) -> Any:
        """Rewards at the measurements of the last decision, ``(interval, width)``, if the report is a reward."""
        ...

    def observation_by_field(self) -> Array:
        """Return the observation of all lanes, ``(fields, width)``, valid until the next decision."""
        ...

    def observation(self, count: int) -> Array:
        """Return the observation of the first ``count`` lanes, batch first, in memory that is not overwritten."""
        ...

    def take_alone(self, action: Array) -> None:
        """Set the action of the first lane for the next decisions."""
        ...

    def first_reward(self, baseline: Any) -> float:
        """Return the first lane's mean reward of the last decision, minus that of a baseline if given."""
        ...

    def observation_of_first(self) -> Array:
        """Return the observation of the first lane, ``(fields,)``, in memory that is not overwritten."""
        ...


class ModelStepper:
    """Stepper of episodes by the functions of a model that is not compiled.

    Args:
        width: lanes, a multiple of eight.
        report: function of model and episodes after the action; None makes no report.
    """

    def __init__(self, model: Model, width: int, report: Report | None = None) -> None:
        self.model = model
        self.width = width
        self.report_function = report
        self._episode: Any = None
        self.shown: Array = None
        """Observation, ``(fields, width)``; None until it is computed."""
        self._action: Array = None
        self._reports: list[Any] = []

    def begin(
        self, identities: numpy.ndarray, noise: EpisodeNoise, others: "Sequence[ModelStepper]" = ()
    ) -> tuple[Array, Array]:
        """Start new episodes in all lanes up to the first measurement; return the uniform and normal numbers used."""
        noise.set_identities(identities)
        start = self._start(noise)
        for each in (self, *others):
            each.load(each.model.measure(each.model.begin(*start), noise.row))
        return start

    def _start(self, noise: EpisodeNoise) -> tuple[Array, Array]:
        task = self.model.task
        uniforms, normals = (task.xp.asarray(numbers, device=task.device) for numbers in noise.start())
        return uniforms, normals

    def load(self, episode: Episode, observation: Array = None) -> None:
        """Replace the running episodes and their observation, ``(fields, width)``; None: compute it."""
        self._episode, self.shown = episode, observation

    def begin_some(
        self,
        lanes: numpy.ndarray,
        identities: numpy.ndarray,
        noise: EpisodeNoise,
        others: "Sequence[ModelStepper]" = (),
    ) -> tuple[Array, Array]:
        """Start new episodes in some lanes up to the first measurement; return the uniform and normal numbers used."""
        noise.set_identities(identities)
        start = self._start(noise)
        for each in (self, *others):
            task = each.model.task
            episode = each.model.measure(each.model.begin(*start), noise.row)
            where = lanes if task.xp is numpy else task.xp.asarray(lanes, device=task.device)
            if each.shown is not None:
                each.shown = _replace_lanes(each.shown, each.model.observe(episode), where)
            each._episode = _replace_lanes(each._episode, episode, where)
        return start

    def episode(self) -> Episode:
        """Return the running episodes of all lanes."""
        return self._episode

    def take(self, action: Array) -> None:
        """Set the action of the next decisions, batch first, for all lanes or for the first ones."""
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

    def take_alone(self, action: Array) -> None:
        """Set the action of the first lane for the next decisions."""
        self.take(action[None])

    def decide(self, noise: EpisodeNoise, others: "Sequence[ModelStepper]" = ()) -> None:
        """Step all lanes through the measurements of one decision, and compute the report on each."""
        means = DecisionMeans(self.model.fields, self.model.task.decision_interval)
        total: Any = 0.0
        for each in (self, *others):
            each._reports = []
        for _ in range(means.interval):
            noise.advance()
            for each in (self, *others):
                after = each.model.act(each._episode, each._action)
                if each.report_function is not None:
                    each._reports.append(each.model.run(each.report_function, after))
                each.load(each.model.measure(after, noise.row))
            if means.columns:
                total = means.add(total, self.observation_by_field())
        if means.columns:
            self.shown = means.show(self.observation_by_field(), total, self.model.task.xp)

    def reports(self) -> list[Any]:
        """Return the reports of the last :meth:`decide`, one for each measurement, arrays ``(..., width)``."""
        return self._reports

    @property
    def rewards(self) -> list[Array]:
        """Rewards at the measurements of the last decision, ``(interval, width)``, if the report is a reward."""
        return self._reports

    def first_reward(self, baseline: "ModelStepper | None") -> float:
        """Return the first lane's mean reward of the last decision, minus that of a baseline if given."""
        others = [0.0] * len(self._reports) if baseline is None else baseline._reports
        return float(mean_reward([a - b for a, b in zip(self._reports, others, strict=True)])[0])

    def observation_of_first(self) -> Array:
        """Return the observation of the first lane, ``(fields,)``, in memory that is not overwritten."""
        return self.observation(1)[0]

    def observation_by_field(self) -> Array:
        """Return the observation of all lanes, ``(fields, width)``, valid until the next decision."""
        if self.shown is None:
            self.shown = self.model.observe(self._episode)
        return self.shown

    def observation(self, count: int) -> Array:
        """Return the observation of the first ``count`` lanes, batch first, in memory that is not overwritten."""
        shown = self.observation_by_field()[:, :count].T
        # Contiguous, in memory of its own.
        return shown.copy() if isinstance(shown, numpy.ndarray) else shown.contiguous()


class Lanes:
    """The engine: ``count`` lanes (parallel episodes) of a model.

    Args:
        model: task with a filter; the task's namespace determines the device of the arrays.
        baseline: baseline of a relative reward, run on the same noise.
        on_start: called with new episodes before their first measurement.
        longest: most decisions of an episode; default: the task's horizon.
        report: function of the later reports; the episodes then start in its code. Default: unknown.

    Attributes:
        decisions: actions taken in each lane's current episode, ``(count,)``.
        noise: random numbers of the episodes.
    """

    def __init__(
        self,
        model: Model,
        count: int,
        baseline: RewardBaseline | None = None,
        on_start: Callable[[Episode], None] | None = None,
        longest: int | None = None,
        report: Report | None = None,
    ) -> None:
        self.model = model
        self.task: Task = model.task
        task = self.task
        self.count: int = count
        self.width: int = round_up_lanes(count)
        self.baseline = baseline
        self._models = [model] if baseline is None else [model, baseline.model]
        self._on_start, self._report = on_start, report
        self._steppers: dict[Report, list[Stepper]] = {}
        """Steppers of compiled models, by report."""
        self._moving: Sequence[EpisodeStepper] = []
        """Steppers with the current episodes, of the task and of the baseline; none before the first episode."""
        self.noise: EpisodeNoise = EpisodeNoise(task, count)
        self._some: dict[int, EpisodeNoise] = {}
        """Noise of lanes that restart while others continue, by their number."""
        self.decisions: numpy.ndarray = numpy.zeros(count, dtype=numpy.int64)
        horizon = task.horizon // task.decision_interval
        self.decisions_per_episode: int = horizon if longest is None else min(horizon, longest)
        self._lengths = numpy.full(count, self.decisions_per_episode)
        """Decisions of each lane's episode."""
        self._means = DecisionMeans(model.fields, task.decision_interval)

    # --- episodes

    def seed(self, lane: int, generator: numpy.random.Generator) -> None:
        """Set the random generator that draws a lane's next episodes."""
        self.noise.seed(lane, generator)

    def restart(self, lanes: Sequence[int] | None = None) -> None:
        """Draw and start new episodes in some lanes (default: all), up to the first measurement."""
        chosen = range(self.count) if lanes is None or len(lanes) == self.count else lanes
        self.begin(self.noise.draw_identities(chosen), chosen)

    def begin(self, identities: numpy.ndarray, lanes: Sequence[int] | None = None) -> None:
        """Start the episodes with these identities in some lanes, up to the first measurement.

        Identities are ``(2, lanes)``, see :mod:`.episode_noise`; the lanes are ascending, by default all.
        """
        task = self.task
        is_whole = lanes is None or len(lanes) == self.count
        index = numpy.arange(self.count) if lanes is None or is_whole else numpy.asarray(lanes)
        if not self._moving and self._report is not None:
            self._reporting(self._report)
        self._moving = self._moving or self._by_functions()
        own, *baseline = self._moving
        if is_whole:
            start = own.begin(identities, self.noise, baseline)
        else:
            noise = self._noise_of_some(len(index))
            start = own.begin_some(index, identities, noise, baseline)
            self.noise.replace_episodes(noise, index)
        self.decisions[index] = 0
        if task.flights:
            lengths = task.lengths(host_array(start[0])[:, : identities.shape[1]]) // task.decision_interval
            self._lengths[index] = numpy.minimum(lengths, self.decisions_per_episode)
        if self._on_start is not None:
            self._on_start(self.model.begin(*start))

    def _noise_of_some(self, count: int) -> EpisodeNoise:
        width = LANES
        while width < count:
            width *= 2
        if width not in self._some:
            self._some[width] = EpisodeNoise(self.task, width)
        return self._some[width]

    def step_reward(self, action: Array, kind: str) -> Array:
        """Apply one action in each lane; return the mean rewards over its measurements, ``(count,)``.

        The action has the batch first; ``kind`` is one of :data:`~.reward.REWARDS`.
        """
        own, *baseline = self._take_and_decide(action, REWARD_FUNCTIONS[kind])
        rewards = (
            own.rewards
            if not baseline
            else [a - b for a, b in zip(own.rewards, baseline[0].rewards, strict=True)]
        )
        return mean_reward(rewards)[: self.count]

    def step_alone(self, action: Array, kind: str) -> tuple[Array, float, bool]:
        """Apply an action in the only lane; return observation, reward, and whether the episode is over.

        The reward, of a kind of :data:`~.reward.REWARDS`, equals that of :meth:`step_reward`.
        """
        steppers, report = self._moving, REWARD_FUNCTIONS[kind]
        if steppers is not self._steppers.get(report):
            steppers = self._reporting(report)
        own, baseline = steppers[0], steppers[1:]
        own.take_alone(action)
        own.decide(self.noise, baseline)
        self.decisions[0] = taken = self.decisions.item(0) + 1
        reward = own.first_reward(baseline[0] if baseline else None)
        return own.observation_of_first(), reward, taken >= self._lengths.item(0)

    def _take_and_decide(self, action: Array, report: Report) -> Sequence[Any]:
        steppers = self._reporting(report)
        steppers[0].take(action)
        steppers[0].decide(self.noise, steppers[1:])
        self.decisions += 1
        return steppers

    def decide(self, action: Array, report: Report = whole_episode) -> list[tuple[Any, Any]]:
        """Apply one action in each lane; return the reports on each of its measurements.

        Args:
            action: batch first, as the action space has it.
            report: function of a model and its episodes after the action; pass the same one each time.

        Returns:
            The reports on every measurement of the decision, arrays ``(..., width)``: of the model, and of
            ``baseline`` (None without).
        """
        own, *baseline = self._take_and_decide(action, report)
        reports = own.reports()
        return list(zip(reports, baseline[0].reports() if baseline else [None] * len(reports), strict=True))

    def run(
        self, report: Report, compiled_policy: Specialised | None = None, measurements: int | None = None
    ) -> tuple[Any, Any]:
        """Run the episodes over many measurements in native code; return the reports on each, and the actions.

        Args:
            report: as of :meth:`decide`; :func:`.compiled.can_step` must be true for it.
            compiled_policy: as of :meth:`.stepper.Stepper.run`; None: the action is zero.
            measurements: how many, a multiple of the decision interval; default: those of an episode.

        Returns:
            Reports, arrays ``(measurements, ..., width)``, and the actions of the policy in the same form.
        """
        (stepper,) = self._reporting(report)
        assert isinstance(stepper, Stepper)
        stepper.take(numpy.zeros((self.width, *(self.model.action_space.shape or ()))))
        interval = self.task.decision_interval
        steps = self.decisions_per_episode * interval if measurements is None else measurements
        answer: tuple[Any, Any] = stepper.run(self.noise, steps, compiled_policy)
        self.decisions += steps // interval
        return answer

    def next_row(self) -> Array:
        """Return the random numbers of the next measurement, ``(row width, width)``, to step episodes elsewhere."""
        self.noise.advance()
        return self.noise.row

    # --- steppers

    def _by_functions(self) -> list[Any]:
        steppers = [ModelStepper(model, self.width) for model in self._models]
        if self.baseline is not None:
            steppers[1].take(self._baseline_action(self.width))
        return steppers

    def _baseline_action(self, count: int) -> Array:
        assert self.baseline is not None
        actions = [self.baseline.action] * count
        discrete = isinstance(self.baseline.action, int)
        return (
            self.task.xp.asarray(actions, device=self.task.device)
            if discrete
            else self.task.constant(actions)
        )

    def _reporting(self, report: Report) -> Sequence[Any]:
        """Return steppers that compute this report, into which the running episodes are moved."""
        if self._moving is self._steppers.get(report):
            return self._moving
        if report not in self._steppers and all(can_step(model, report) for model in self._models):
            steppers = self._steppers[report] = [Stepper(self.model, report, self.width)]
            if self.baseline is not None:
                world_of = steppers[0] if share_world(*self._models) else None
                steppers.append(Stepper(self.baseline.model, report, self.width, world_of))
                steppers[1].take(self._baseline_action(self.width))
        before, after = self._moving, self._steppers.get(report)
        if after is None:
            settled = self._settle()
            for stepper in settled:
                stepper.report_function = report
            return settled
        for i, (old, new) in enumerate(zip(before, after, strict=bool(before))):
            new.load(old.episode(), old.observation_by_field() if i == 0 else None)
        self._moving = after
        return after

    def _settle(self) -> list[ModelStepper]:
        if self._moving and not isinstance(self._moving[0], ModelStepper):
            before, self._moving = self._moving, self._by_functions()
            for i, (old, new) in enumerate(zip(before, self._moving, strict=True)):
                averaged = i == 0 and self._means.columns
                new.load(old.episode(), old.observation_by_field().copy() if averaged else None)
        return [stepper for stepper in self._moving if isinstance(stepper, ModelStepper)]

    @property
    def has_running_episode(self) -> bool:
        """Whether the first lane has an episode that is not over."""
        return bool(self._moving) and self.decisions.item(0) < self._lengths.item(0)

    @property
    def has_episodes(self) -> bool:
        """Whether episodes have been started in the lanes."""
        return bool(self._moving)

    @property
    def state(self) -> Any:
        """The running episodes of all lanes, padded to a multiple of eight."""
        return self._moving[0].episode()

    @state.setter
    def state(self, state: Any) -> None:
        self._settle()
        self._moving[0].load(state)

    def __getstate__(self) -> dict[str, Any]:
        self._settle()
        return {**self.__dict__, "_steppers": {}, "_some": {}}

    def grow(self, count: int) -> None:
        """Enlarge to ``count`` lanes, whose new ones run arbitrary episodes until they are restarted."""
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
        return tuple((stepper.episode(), stepper.shown) for stepper in self._settle())

    def _load(self, episodes: tuple[Any, ...]) -> None:
        for stepper, (episode, shown) in zip(self._moving, episodes, strict=True):
            stepper.load(episode, shown)

    def detach(self) -> None:
        """Detach the running episodes from the autograd graph (torch only)."""
        self._load(map_arrays(lambda tensor: tensor.detach(), self._episodes()))

    def snapshot(self) -> dict[str, Any]:
        """Return a copy of the complete state of the episodes, random numbers included."""
        self._settle()
        kept = {"decisions": self.decisions.copy(), "_lengths": self._lengths.copy()}
        return {"count": self.count, "episodes": self._episodes(), "noise": self.noise.snapshot(), **kept}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Restore the state of a :meth:`snapshot`; ValueError if its number of lanes differs."""
        if snapshot["count"] != self.count:
            raise ValueError(f"the snapshot holds {snapshot['count']} environments, not {self.count}")
        self.noise.restore(snapshot["noise"])
        self.decisions, self._lengths = snapshot["decisions"].copy(), snapshot["_lengths"].copy()
        self._moving = self._by_functions() if snapshot["episodes"] else []
        self._load(snapshot["episodes"])

    def shorten(self, lanes: Sequence[int], decisions: numpy.ndarray) -> None:
        """Shorten the episodes that just began in some lanes by some decisions each, to one at least."""
        self.decisions[list(lanes)] = numpy.minimum(decisions, self._lengths[list(lanes)] - 1)

    @property
    def done(self) -> numpy.ndarray:
        """Whether the episode of each lane is over, booleans ``(count,)``."""
        return self.decisions >= self._lengths

    def observe(self) -> Array:
        """Return the observations of all lanes, ``(count, len(model.fields))``, in memory that is not overwritten."""
        return self._moving[0].observation(self.count)
