"""Whether an agent is shown what it was trained on.

A network answers whatever it is asked. What it saw in training is flown again, a few episodes of its training
distribution, and what it is shown now is held against that, field by field.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ..envs.backend import make_model
from ..envs.catalogue import find_mixture, make_task, parameter_names
from ..envs.parameters import freeze
from ..envs.task import Task
from ..evaluation.competitors import make_competitor
from ..evaluation.rollout import start_lanes
from ..evaluation.seeds import episode_seeds
from ..evaluation.stepping import SteppingPolicy

EPISODES = 64
"""Of the training distribution that are flown."""
EPISODES_NOW = 16
"""Of what is evaluated."""
MOST_DECISIONS = 400
"""Of an episode that are looked at."""
TOLERATED = 0.1
"""Share of a field's values outside of what was seen in training that is not spoken of."""


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
    stored = getattr(maker, "policy", maker)
    header = getattr(stored, "header", None)
    if header is None or find_mixture(cls, header["run"].get("scenario")) is not None:
        return None
    run = header["run"]
    known = parameter_names(cls)
    given = run.get("hyperparameters", {}).get("env_kwargs", {})
    own = {name: value for name, value in given.items() if name in known}
    trained = make_task(cls, run.get("scenario"), **own).parameters
    differing = {name: (getattr(trained, name), value) for name, value in keywords.items()}
    # How long an episode is, is no other problem.
    differing = {n: (a, b) for n, (a, b) in differing.items() if a != freeze(b) and n != "horizon"}
    now, then = (cls.default_scenario if one is None else one for one in (scenario, run.get("scenario")))
    if isinstance(now, str) and now == then and not (own or differing):
        return None  # it is what it was trained on, and need not be flown
    seen = _observations(cls, stored, run.get("scenario"), own, episode_seeds("validation", 1, EPISODES))
    shown = _observations(cls, stored, scenario, keywords, episode_seeds("test", 0, EPISODES_NOW))
    outside = ((shown < seen.min(axis=0)) | (shown > seen.max(axis=0))).mean(axis=0)
    most = int(outside.argmax())
    often = outside[most] > TOLERATED
    if not often and not differing:
        return None
    return Departure(float(outside[most]), header["fields"][most] if often else "", differing)


def _observations(
    cls: type[Task], stored: Any, scenario: Any, keywords: Mapping[str, Any], seeds: Sequence[int]
) -> numpy.ndarray:
    """Fields that an agent takes, of all decisions of some episodes that it flies, ``(n, fields)``."""
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
