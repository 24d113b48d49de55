"""Ranges of the observations in an agent's training, and the comparison of later observations with them.

A network has an output for any input. Its envelope is the range of each field in its training: stored in the file of an
exported agent; for other agents some hundred episodes of the training distribution are simulated again.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ..baselines.alarm import Alarm
from ..envs.contract.model import Episode, Model
from ..envs.contract.observation import Array
from ..envs.contract.parameters import freeze
from ..envs.contract.task import Task
from ..envs.engine.backend import make_model
from ..envs.engine.catalogue import parameter_names
from ..envs.engine.programs import Report
from ..envs.engine.scenario_choice import find_mixture, make_task
from ..evaluation.competitors.kinds import Kind, make_competitor
from ..evaluation.competitors.stepping import SteppingPolicy
from ..evaluation.running.rollout import start_lanes
from ..evaluation.running.seeds import episode_seeds
from .learned_estimator import fill_missing

EPISODES = 512
"""Episodes of the training distribution; with few, an episode of the same distribution would often lie outside."""
EPISODES_NOW = 16
"""Episodes of the evaluated scenario."""
MOST_DECISIONS = 400
"""Largest number of decisions of an episode that are compared."""
TOLERATED = 0.1
"""Largest share of a field's values outside the range of training that is not reported."""


USUAL = 1e-3
"""Share of a field's values outside the range, in the training distribution itself."""
OFTEN = 0.5
"""Share of a field's values outside the range, in other distributions."""
WINDOW = 50.0
"""Decisions over which a running filter averages the share outside the range."""


class TrainingRange(NamedTuple):
    """Range of each field of the observation in an agent's training."""

    fields: tuple[str, ...]
    """Names of the fields that the agent reads."""
    low: numpy.ndarray
    """Smallest values, ``(fields,)``."""
    high: numpy.ndarray
    """Largest values, ``(fields,)``."""

    def is_outside(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Return whether each value of observations ``(n, fields)`` is outside the range, or NaN."""
        return numpy.logical_not((observation >= self.low) & (observation <= self.high))


class EnvelopeAlarm(Alarm):
    """Alarm that sounds where the observations leave the range of an agent's training.

    In training a value of a field lies outside once in ``1 / USUAL`` decisions or less; in other distributions half of
    the values do. The alarm sums the log-likelihood ratios of each field.
    """

    def __init__(self, model: Model, range: TrainingRange) -> None:
        super().__init__(model)
        self.range = range
        self.columns: list[int] = model.columns(range.fields)

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratio of each field, other task against training, ``(N, fields)``."""
        outside = self.range.is_outside(observation[:, self.columns])
        return numpy.where(outside, math.log(OFTEN / USUAL), math.log((1.0 - OFTEN) / (1.0 - USUAL)))


class NetworkWatch:
    """Monitor of a live network: share of its recent observations outside the range of its training.

    Args:
        model: the model whose observations are passed.
        range: range of the training.
        observe: report of the observation, see :class:`~.online_state.Watch`.

    Attributes:
        memory: share of each field's values outside, over the last decisions, ``(tracks, fields)``; None before the
            first decision.
    """

    def __init__(self, model: Model, range: TrainingRange, observe: Report | None = None) -> None:
        self.range = range
        self.columns: list[int] = model.columns(range.fields)
        self.observe = observe
        self.memory: numpy.ndarray | None = None

    def look(self, observation: numpy.ndarray, start: numpy.ndarray) -> None:
        """Update the shares of values outside the range with the observations ``(tracks, fields)`` of a decision."""
        outside = self.range.is_outside(observation[:, self.columns])
        before = 0.0 * outside if self.memory is None else self.memory
        if start.any():
            before = numpy.where(start[:, None], 0.0, before)
        self.memory = before + (outside - before) / WINDOW

    def describe(self) -> list[str]:
        """Return a warning for each track on the field that is most often outside; empty where none is too often."""
        if self.memory is None:
            return []
        most, share = self.memory.argmax(axis=1), self.memory.max(axis=1)
        return [
            f"{100.0 * much:.0f} % of the last values of {self.range.fields[field]} lie outside the range of its "
            "training"
            if much > TOLERATED
            else ""
            for field, much in zip(most, share, strict=True)
        ]


def training_range(cls: type[Task], maker: Any) -> TrainingRange | None:
    """Return the range of each observation field in an agent's training, as stored, else from simulated episodes.

    None: unknown training, or a mixture of scenarios without a stored range.
    """
    stored = _stored(maker)
    if stored is None:
        return None
    run = stored.header["run"]
    if stored.envelope is not None:
        return TrainingRange(tuple(stored.header["fields"]), *stored.envelope)
    if find_mixture(cls, run.get("scenario")) is not None:
        return None
    seen = _observations(
        cls, stored, run.get("scenario"), _own_parameters(cls, run), episode_seeds("validation", 1, EPISODES)
    )
    return TrainingRange(tuple(stored.header["fields"]), seen.min(axis=0), seen.max(axis=0))


def _stored(maker: Any) -> Any:
    """Return the stored policy inside an agent's factory; None if its training is unknown."""
    for inside in ("maker", "policy"):  # of a gate, of an estimator
        maker = getattr(maker, inside, maker)
    return maker if getattr(maker, "header", None) is not None else None


def _own_parameters(cls: type[Task], run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the task parameters of an agent's training by name, from its run's record."""
    known = parameter_names(cls)
    given = run.get("hyperparameters", {}).get("env_kwargs", {})
    return {name: value for name, value in given.items() if name in known}


class Departure(NamedTuple):
    """Difference between the task in which an agent acts and its training: values outside, and parameters."""

    share: float
    """Share of the values of one field outside the range of training: the field with the largest share."""
    field: str
    """Name of that field; empty where no field is outside often."""
    parameters: Mapping[str, tuple[Any, Any]]
    """Parameters with other values: value in training, value now."""

    def __str__(self) -> str:
        sentences = [
            f"trained with {name} {one!r}, not {other!r}" for name, (one, other) in self.parameters.items()
        ]
        if self.field:
            sentences.append(
                f"{100.0 * self.share:.0f} % of {self.field} lie outside the range of its training"
            )
        return "; ".join(sentences)


def departure(cls: type[Task], maker: Any, scenario: Any, keywords: Mapping[str, Any]) -> Departure | None:
    """Return how the task in which an agent is to act differs from its training; None: not at all, or unknown."""
    stored = _stored(maker)
    if stored is None or find_mixture(cls, stored.header["run"].get("scenario")) is not None:
        return None
    header, run = stored.header, stored.header["run"]
    own = _own_parameters(cls, run)
    keywords = {**stored.task_keywords, **keywords}  # the agent always acts with its own
    trained = make_task(cls, run.get("scenario"), **own).parameters
    differing = {name: (getattr(trained, name), value) for name, value in keywords.items()}
    # Another length of the episodes does not change the problem.
    differing = {n: (a, b) for n, (a, b) in differing.items() if a != freeze(b) and n != "horizon"}
    now, then = (cls.default_scenario if one is None else one for one in (scenario, run.get("scenario")))
    if isinstance(now, str) and now == then and not (own.keys() - stored.task_keywords or differing):
        return None  # the same task: no episodes are needed
    seen = training_range(cls, maker)
    assert seen is not None
    shown = _observations(cls, stored, scenario, keywords, episode_seeds("test", 0, EPISODES_NOW))
    outside = seen.is_outside(shown).mean(axis=0)
    most = int(outside.argmax())
    often = outside[most] > TOLERATED
    if not often and not differing:
        return None
    return Departure(float(outside[most]), header["fields"][most] if often else "", differing)


def _observations(
    cls: type[Task], stored: Any, scenario: Any, keywords: Mapping[str, Any], seeds: Sequence[int]
) -> numpy.ndarray:
    """Simulate episodes that an agent controls; return its observations at all decisions, ``(n, fields)``."""
    model = make_model(cls, stored.control, scenario, backend="auto", **keywords)
    lanes = start_lanes(model, seeds)
    policy = SteppingPolicy(model, make_competitor(stored, model))
    memory, columns, found = policy.begin(seeds), model.columns(stored.header["fields"]), []
    for _ in range(min(lanes.decisions_per_episode, MOST_DECISIONS)):
        shown = numpy.asarray(lanes.observe())
        found.append(shown[:, columns])
        action, memory = policy.predict(shown, memory)
        lanes.decide(action)
    return numpy.concatenate(found)


def observe_network(model: Model, episode: Episode) -> Array:
    """Return the observation that a learned estimator's network receives after a measurement."""
    own, received = model.filter.own, fill_missing(model.task.world.mask_missing(episode.measurement))
    return own.model.observe(Episode(None, received, episode.filter.own.bank))


def watch_live(model: Model, maker: Any, kind: Kind) -> NetworkWatch | None:
    """Return a monitor of a live agent's observations against its training range; None: unknown range."""
    seen = training_range(type(model.task), maker)
    if seen is None:
        return None
    if kind == "estimator":
        return NetworkWatch(maker(model.task).model, seen, observe_network)
    return NetworkWatch(model, seen)
