"""Whether an agent is shown what it was trained on.

A network answers whatever it is asked. Its envelope is what it saw of each field in its training: an exported agent
carries it in its file; of others some hundred episodes of the training distribution are flown again. What an agent is
shown now is held against that, field by field.
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
"""Of the training distribution that are flown: of few, an episode of the same distribution would often lie outside."""
EPISODES_NOW = 16
"""Of what is evaluated."""
MOST_DECISIONS = 400
"""Of an episode that are looked at."""
TOLERATED = 0.1
"""Share of a field's values outside of what was seen in training that is not spoken of."""


USUAL = 1e-3
"""Share of a field's values that lie outside of what was seen, in training itself."""
OFTEN = 0.5
"""The same where an agent is shown what it was not trained on."""
WINDOW = 50.0
"""Decisions over which a running filter judges what it is shown."""


class TrainingRange(NamedTuple):
    """What an agent has seen of each field in its training."""

    fields: tuple[str, ...]
    """That it takes."""
    low: numpy.ndarray
    """Smallest value, ``(fields,)``."""
    high: numpy.ndarray
    """Largest value, likewise."""

    def is_outside(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Which values of observations ``(n, fields)`` were not seen in training."""
        # What is no number was not seen either.
        return numpy.logical_not((observation >= self.low) & (observation <= self.high))


class EnvelopeAlarm(Alarm):
    """Speaks where what an agent is shown leaves what it saw in its training.

    In training a value of a field lies outside once in ``1 / USUAL`` decisions or less, outside of it half of them do:
    the sum of log-likelihood ratios of each field is an alarm like any other.

    Args:
        model: whose observations are shown.
        range: of the training.
    """

    def __init__(self, model: Model, range: TrainingRange) -> None:
        super().__init__(model)
        self.range = range
        self.columns: list[int] = model.columns(range.fields)

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Weigh every field for itself."""
        outside = self.range.is_outside(observation[:, self.columns])
        return numpy.where(outside, math.log(OFTEN / USUAL), math.log((1.0 - OFTEN) / (1.0 - USUAL)))


class NetworkWatch:
    """How much of what a network is shown was not seen in its training.

    Args:
        model: whose observations it is shown.
        range: of its training.
        observe: as of :class:`~.online_state.Watch`.

    Attributes:
        memory: share of each field's values outside, over the last decisions, ``(tracks, fields)``; None before the
            first.
    """

    def __init__(self, model: Model, range: TrainingRange, observe: Report | None = None) -> None:
        self.range = range
        self.columns: list[int] = model.columns(range.fields)
        self.observe = observe
        self.memory: numpy.ndarray | None = None

    def look(self, observation: numpy.ndarray, start: numpy.ndarray) -> None:
        """Look at what is shown."""
        outside = self.range.is_outside(observation[:, self.columns])
        before = 0.0 * outside if self.memory is None else self.memory
        if start.any():
            before = numpy.where(start[:, None], 0.0, before)
        self.memory = before + (outside - before) / WINDOW

    def describe(self) -> list[str]:
        """Say for each track which field is outside too often; empty where none is."""
        if self.memory is None:
            return []
        most, share = self.memory.argmax(axis=1), self.memory.max(axis=1)
        return [
            f"{100.0 * much:.0f} % of the last values of {self.range.fields[field]} lie outside of all that it saw in "
            "training"
            if much > TOLERATED
            else ""
            for field, much in zip(most, share, strict=True)
        ]


def training_range(cls: type[Task], maker: Any) -> TrainingRange | None:
    """Return what an agent carries of its training, or fly some episodes of it again; None where nobody knows how it
    was trained, or on a mixture of scenarios.

    Args:
        cls: the task.
        maker: as of :func:`departure`.
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
    """Return what was loaded of a learned policy or estimator; None where its training is not known."""
    for inside in ("maker", "policy"):  # of a gate, of an estimator
        maker = getattr(maker, inside, maker)
    return maker if getattr(maker, "header", None) is not None else None


def _own_parameters(cls: type[Task], run: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters of the task that an agent was trained under."""
    known = parameter_names(cls)
    given = run.get("hyperparameters", {}).get("env_kwargs", {})
    return {name: value for name, value in given.items() if name in known}


class Departure(NamedTuple):
    """How far what an agent is to act in is from what it was trained on."""

    share: float
    """Share of the values of one field outside of all that was seen in training: of the field where it is largest."""
    field: str
    """Its name; empty where none is outside often."""
    parameters: Mapping[str, tuple[Any, Any]]
    """Parameters that were set otherwise: value in training, value now."""

    def __str__(self) -> str:
        said = [
            f"trained with {name} {one!r}, not {other!r}" for name, (one, other) in self.parameters.items()
        ]
        if self.field:
            said.append(
                f"{100.0 * self.share:.0f} % of {self.field} lie outside of all that it saw in training"
            )
        return "; ".join(said)


def departure(cls: type[Task], maker: Any, scenario: Any, keywords: Mapping[str, Any]) -> Departure | None:
    """Say how far an agent is from its training; None where it is within, or nobody knows how it was trained.

    Args:
        cls: the task.
        maker: of a learned policy or estimator, as :func:`.learned_policy.load_policy` returns it.
        scenario: that it is to act in.
        keywords: parameters of the task there.
    """
    stored = _stored(maker)
    if stored is None or find_mixture(cls, stored.header["run"].get("scenario")) is not None:
        return None
    header, run = stored.header, stored.header["run"]
    own = _own_parameters(cls, run)
    keywords = {**stored.task_keywords, **keywords}  # what it acts with wherever it acts
    trained = make_task(cls, run.get("scenario"), **own).parameters
    differing = {name: (getattr(trained, name), value) for name, value in keywords.items()}
    # How long an episode is, is no other problem.
    differing = {n: (a, b) for n, (a, b) in differing.items() if a != freeze(b) and n != "horizon"}
    now, then = (cls.default_scenario if one is None else one for one in (scenario, run.get("scenario")))
    if isinstance(now, str) and now == then and not (own.keys() - stored.task_keywords or differing):
        return None  # it is what it was trained on, and need not be flown
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
    """Return the fields that an agent takes, of all decisions of some episodes that it flies, ``(n, fields)``."""
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
    """Report what the network of a learned estimator in a loop is shown of a measurement that has come."""
    own, received = model.filter.own, fill_missing(model.task.world.mask_missing(episode.measurement))
    return own.model.observe(Episode(None, received, episode.filter.own.bank))


def watch_live(model: Model, maker: Any, kind: Kind) -> NetworkWatch | None:
    """Return what compares the observations of an agent that runs live with those of its training; None of others."""
    seen = training_range(type(model.task), maker)
    if seen is None:
        return None
    if kind == "estimator":
        return NetworkWatch(maker(model.task).model, seen, observe_network)
    return NetworkWatch(model, seen)
