"""Base class of both Gymnasium environments: lanes of one task or of several, observations, and the reward."""

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy
from gymnasium.envs.registration import EnvSpec

from ..contract.model import Model
from ..contract.observation import Array, Field
from ..contract.task import Task
from ..engine.catalogue import check_names, nearest, task_class
from ..engine.lanes import Lanes
from ..engine.reward import REWARDS
from ..engine.scenario_choice import find_mixture, find_scenario
from ..engine.stepper import mean_reward
from .fleet import EpisodeDistribution, Fleet, check_alike
from .privileged import context_shapes, in_sigmas
from .requests import EnvOptions
from .specification import with_episode_length
from .step_report import step_report

FRAMES_PER_SECOND = 10


def _no_truth(distribution: EpisodeDistribution) -> str:
    known = any(model.task.has_truth for model in distribution.models)
    lacks = "lacks some of the truth, so the reward" if known else "has no truth, so the cost"
    return f"recording {distribution.names[0]!r} {lacks} of an estimate is not known"


class EnvBase:
    """Base class of both Gymnasium environments: lanes (parallel episodes) of tasks, spaces, reward."""

    model: Model
    """Model of the episode; with a mixture of scenarios in a vector environment, of the first scenario."""
    fleet: Fleet
    options: EnvOptions
    reward_kind: str
    last_decision: int
    """Number of actions after which an episode is truncated; of scenarios that differ in length, the largest."""
    reset_options: ClassVar[tuple[str, ...]] = ("scenario", "parameters")
    """Names allowed in the ``options`` of a reset."""
    _spec: EnvSpec | None = None

    @property
    def task(self) -> Task:
        """Task of the current model."""
        return self.model.task

    def _set_options(self, task: str, options: EnvOptions, names: Iterable[str]) -> None:
        self._class = task_class(task)
        check_names(self._class, names, inspect.signature(type(self)).parameters)
        self.options = options
        self.reward_kind = self._class.reward.kind if options.reward is None else options.reward
        if self.reward_kind not in REWARDS:
            raise nearest("reward", self.reward_kind, REWARDS)
        self._rewards_only = not (options.detailed_info or options.privileged)
        self._plain = self._rewards_only and not options.context and options.dtype == "float64"
        """Whether a step returns observation and reward without further processing."""
        if self.privileged:
            self.metadata: dict[str, Any] = {**self.metadata, "privileged": True}

    @property
    def privileged(self) -> bool:
        """Whether observations contain privileged values."""
        return self.options.privileged

    def _open(
        self,
        make: Callable[..., Model],
        scenario: Any,
        keywords: Mapping[str, Any],
        count: int,
        longest: int | None,
    ) -> None:
        self._make, self._keywords = make, dict(keywords)
        distribution = self._distribution(scenario, {})
        if not all(model.task.has_whole_truth for model in distribution.models):
            self._disable_reward(distribution)
        self.model, self._first_distribution = distribution.models[0], distribution
        self.fleet = Fleet(count, distribution, self.reward_kind, longest)
        self.last_decision = self.fleet.decisions_per_episode
        self._scaled_errors: Array = None
        """Errors after the last action, in sigmas, ``(count, components)``; for privileged observations only."""
        if self.privileged:
            self._scaled_errors = self.task.constant(numpy.zeros((count, len(self.task.components))))

    def _disable_reward(self, distribution: EpisodeDistribution) -> None:
        """Set the reward to zero, for scenarios without truth.

        ValueError if the user has chosen a reward, or privileged observations.
        """
        wanted = f"reward={self.reward_kind!r}" if self.options.reward is not None else ""
        wanted = "observation='asymmetric'" if self.privileged else wanted
        if wanted:
            raise ValueError(f"{_no_truth(distribution)}: leave out {wanted}; rewards are zero")
        self.reward_kind = "none"

    # --- scenarios

    def _distribution(self, scenario: Any, parameters: Mapping[str, Any]) -> EpisodeDistribution:
        keywords = {**self._keywords, **parameters}
        mixture = find_mixture(self._class, scenario)
        choices = [scenario] if mixture is None else list(mixture)
        found = [find_scenario(self._class, choice, keywords) for choice in choices]
        models = tuple(self._make(one, **keywords) for one in found)
        names = tuple(one.name for one in found)
        distribution = EpisodeDistribution(
            scenario,
            dict(parameters),
            models,
            names,
            (1.0,) if mixture is None else tuple(mixture.values()),
        )
        if (
            hasattr(self, "model")
            and self.reward_kind != "none"
            and not all(t.task.has_whole_truth for t in models)
        ):
            raise ValueError(
                f"{_no_truth(distribution)}, and this environment gives rewards: make another environment for it"
            )
        first = getattr(self, "model", models[0])
        for model, name in zip(models, names, strict=True):
            check_alike(first, model, name)
            if self.privileged and context_shapes(model.task) != context_shapes(first.task):
                raise ValueError(
                    f"scenario {name!r} has a context of another shape than this environment shows its critics: leave "
                    "it out, or make the environment without observation='asymmetric'"
                )
        return distribution

    def _apply_reset_options(self, wanted: Mapping[str, Any], chosen: Sequence[int]) -> None:
        if not {"scenario", "parameters"} & wanted.keys():
            return
        parameters = wanted.get("parameters")
        if parameters is not None and not (
            isinstance(parameters, Mapping) and all(isinstance(name, str) for name in parameters)
        ):
            raise ValueError(f"options['parameters'] maps names of parameters to values, got {parameters!r}")
        known = [self._first_distribution, *self.fleet.distributions()]
        distributions = []
        for lane in chosen:
            now = self.fleet.distribution_of(lane)
            choice = now.scenario, now.parameters
            if "scenario" in wanted:
                scenario = wanted["scenario"]
                choice = (self._first_distribution.scenario if scenario is None else scenario), choice[1]
            if "parameters" in wanted:
                choice = choice[0], dict(parameters or {})
            found = next((distribution for distribution in known if distribution.is_of(*choice)), None)
            if found is None:
                found = self._distribution(*choice)
                known.append(found)
            distributions.append(found)
        for lane, distribution in zip(chosen, distributions, strict=True):
            self.fleet.set_distribution(lane, distribution)
        self.last_decision = self.fleet.decisions_per_episode

    # --- observations

    def _observation_space(self) -> gymnasium.Space[Any]:
        dtype = numpy.dtype(self.options.dtype).type
        low, high = (limits.astype(dtype) for limits in self.model.observation_limits)
        measured = gymnasium.spaces.Box(low, high, dtype=dtype)
        if not self.privileged:
            return measured
        context = sum(math.prod(shape) for shape in context_shapes(self.task).values())
        return gymnasium.spaces.Dict(
            {
                "observation": measured,
                "privileged": gymnasium.spaces.Box(
                    -numpy.inf, numpy.inf, (context + len(self.task.components),), dtype
                ),
            }
        )

    def _to_dtype(self, values: Array) -> Array:
        if self.options.dtype == "float64":
            return values
        return self.task.xp.astype(values, self.task.xp.float32)

    def _observations(self) -> Any:
        shown = self._to_dtype(self.fleet.observe())
        if not self.privileged:
            return shown
        xp, count = self.task.xp, self.fleet.count
        flat = [xp.reshape(values, (count, -1)) for values in self._context()[0].values()]
        return {
            "observation": shown,
            "privileged": self._to_dtype(xp.concat([*flat, self._scaled_errors], axis=1)),
        }

    def _context(self) -> tuple[dict[str, Array], dict[str, numpy.ndarray]]:
        found = []
        for (part,) in self.fleet.parts():
            context, xp = part.model.context(part.state), part.task.xp
            found.append({name: xp.moveaxis(v[..., : part.count], -1, 0) for name, v in context.items()})
        return self._gather_reports(found)

    def _gather_reports(
        self, found: Sequence[Mapping[str, Array]]
    ) -> tuple[dict[str, Array], dict[str, numpy.ndarray]]:
        """Return the reports on all lanes by name, NaN where missing, and masks of the lanes with each part."""
        xp, values, present = self.task.xp, {}, {}
        counts = [part.count for (part,) in self.fleet.parts()]
        for name in dict.fromkeys(name for one in found for name in one):
            shapes = [tuple(one[name].shape[1:]) for one in found if name in one]
            largest = tuple(map(max, zip(*shapes, strict=True)))
            padded = []
            for one, count in zip(found, counts, strict=True):
                full = self.task.constant(numpy.full((count, *largest), numpy.nan))
                if name in one:
                    if tuple(one[name].shape[1:]) == largest:
                        full = one[name]
                    else:
                        full[tuple(slice(size) for size in one[name].shape)] = xp.astype(
                            one[name], xp.float64
                        )
                padded.append(full)
            values[name] = self.fleet.gather(padded)
            has = [numpy.full(count, name in one) for one, count in zip(found, counts, strict=True)]
            present[name] = self.fleet.gather(has)
        return values, present

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium specification of the environment, with the length of an episode in decisions."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = None if spec is None else with_episode_length(spec, self.last_decision)

    @property
    def backend(self) -> str:
        """Name of the backend that computes the steps: "compiled", "numpy" or "torch"."""
        return self.model.backend

    # --- a step

    def _step_lanes(
        self, action: Array, info: dict[str, Array], watch: Callable[[Any], None] | None = None
    ) -> Array:
        """Apply an action in all lanes; return the mean rewards over its measurements, ``(count,)``.

        ``watch`` is called with the state after the action, once for each measurement.
        """
        if self._rewards_only and watch is None:
            return self.fleet.step_reward(action, self.reward_kind)
        infos: list[dict[str, Array]] = []
        results = []
        for part, own in self.fleet.parts(action):
            infos.append({})
            results.append(self._step_part(part, own, infos[-1], watch))
        if self.privileged:
            self._scaled_errors = self.fleet.gather([scaled for _, scaled in results])
        info.update(self._gather_reports(infos)[0])
        return self.fleet.gather([reward for reward, _ in results])

    def _step_part(
        self, lanes: Lanes, action: Array, info: dict[str, Array], watch: Callable[[Any], None] | None
    ) -> tuple[Array, Array]:
        task, count = lanes.task, lanes.count
        report = step_report(self.reward_kind, self.privileged, self.options.detailed_info, watch is not None)
        results = lanes.decide(action, report)
        if watch is not None:
            for own, _ in results:
                watch(own.episode)
        last = results[-1][0]
        for name, values in (last.details or {}).items():
            info[name] = task.xp.moveaxis(values[..., :count], -1, 0)
        rewards = [own.reward if other is None else own.reward - other.reward for own, other in results]
        scaled = in_sigmas(last.error, last.covariance, count, task.xp) if self.privileged else None
        return mean_reward(rewards)[:count], scaled

    def _forget_errors(self, lanes: Sequence[int]) -> None:
        if self.privileged:
            keep = numpy.ones((self.fleet.count, 1))
            keep[list(lanes)] = 0.0
            self._scaled_errors = self.task.xp.where(self.task.constant(keep) > 0.0, self._scaled_errors, 0.0)

    @property
    def observation_fields(self) -> tuple[Field, ...]:
        """Name, unit and scale of every component of the observation."""
        return self.model.fields
