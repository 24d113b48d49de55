"""A ranked competitor as the objects that it runs with, and what it is given."""

from typing import Any, NamedTuple

import numpy

from ..agents.learned_estimator import EstimatorMaker
from ..baselines.table import ConstantMode
from ..envs.contract.model import Model
from ..envs.contract.task import Task
from ..envs.contract.world import World
from ..envs.data.recording import RecordedWorld
from ..envs.engine.scenario_choice import make_task
from ..evaluation.competitors import (
    RANKED,
    ConstantPolicy,
    RandomPolicy,
    check_competitor,
    kind_of,
    make_competitor,
)
from ..evaluation.evaluate import control_of
from ..filters.array_namespace import Array
from .constants import ReadModel
from .request import ExportRequest
from .track import ConstantTrack, EstimatorTrack, NotReceived, SteeredTrack, Track

OF_AN_ESTIMATOR = ("start", "update")
OF_A_BANK = ("start", "predict", "act", "mean", "covariance", "records")
OF_AN_OBSERVATION = ("observe", "fields")


class Parts(NamedTuple):
    """Objects that a filter runs with."""

    track: type[Track]
    """What puts them together."""
    arguments: dict[str, Any]
    """Objects that it is made with, by the names of its arguments."""
    called: tuple[str, ...]
    """Names of the methods of these objects that it calls."""


class Exported(NamedTuple):
    """What is written out."""

    task: Task
    parts: Parts
    measurement: Any
    """One, for the shapes."""
    initial: Any
    """Likewise an initial estimate."""
    model: Model
    """In which it runs."""
    maker: Any
    """Of the competitor."""


def find_exported(request: ExportRequest) -> Exported:
    """Make a competitor for a task, and take it apart.

    Raises:
        ValueError: for what is not ranked, or draws its actions.
    """
    problem, name, maker, scenario, keywords = request
    kind = kind_of(maker)
    if kind not in RANKED:
        raise ValueError(
            f"{name!r} is of kind {kind}: only policies and estimators run on measurements alone"
        )
    task = make_task(problem.task, scenario, **{**getattr(maker, "task_keywords", {}), **keywords})
    if isinstance(maker, EstimatorMaker):  # a bank with a network, whatever it is from outside
        model = ReadModel(task, maker.bank)
        parts = _steered_parts(model, maker.policy(model), 1)
    elif kind == "estimator":
        model = ReadModel(task, control_of(maker, kind, None, problem.task, name))
        own = check_competitor(name, make_competitor(maker, task), kind)
        parts = Parts(EstimatorTrack, {"filter": own, "mask": _mask_of(task.world)}, OF_AN_ESTIMATOR)
    else:
        model = ReadModel(task, control_of(maker, kind, None, problem.task, name))
        policy = check_competitor(name, make_competitor(maker, model), kind)
        if isinstance(policy, RandomPolicy):
            raise ValueError(f"{name!r} draws its actions: there is nothing to write out")
        parts = _steered_parts(model, policy, model.task.decision_interval)
    initial, measurement = _first_measurement(model)
    return Exported(task, parts, measurement, initial, model, maker)


def _mask_of(world: World) -> Any:
    """What puts NaN in place of what was not received; of a recording the task's own world says it."""
    world = world.simulated if isinstance(world, RecordedWorld) else world
    if type(world).mask_missing is World.mask_missing:
        return NotReceived(world.received_field)
    return world.mask_missing


def _steered_parts(model: ReadModel, policy: Any, decision_interval: int) -> Parts:
    """Parts of a bank under a policy; an action that never changes needs no observation.

    Args:
        model: of the bank.
        policy: that steers it.
        decision_interval: measurements for which an action holds; one for a network inside a filter.
    """
    if isinstance(policy, ConstantPolicy):
        action: Array = numpy.array(policy.action, dtype=float)
        return Parts(ConstantTrack, {"filter": model.filter, "action": action}, OF_A_BANK)
    if isinstance(policy, ConstantMode):
        return Parts(ConstantTrack, {"filter": model.filter, "action": policy.mode}, OF_A_BANK)
    arguments = {
        "filter": model.filter,
        "observation": model.observation,
        "policy": policy,
        "decision_interval": decision_interval,
    }
    return Parts(SteeredTrack, arguments, OF_A_BANK + OF_AN_OBSERVATION)


def _first_measurement(model: ReadModel) -> tuple[Any, Any]:
    """Return an initial estimate and a measurement of an average episode, for their shapes."""
    noise = model.task.noise
    episode = model.begin(numpy.full((noise.uniforms, 8), 0.5), numpy.zeros((noise.initial_normals, 8)))
    after = model.measure(episode, numpy.full((noise.normals + noise.row_uniforms, 8), 0.5))
    return episode.measurement, after.measurement


def lane_of(given: Any, lane: int = 0, prefix: str = "") -> dict[str, Any]:
    """Return what one of N filters is given, by the names of the arguments of the written one.

    Args:
        given: a measurement or an initial estimate, arrays ``(..., N)``.
        lane: which of the N.
        prefix: of the names.
    """
    found: dict[str, Any] = {}
    for field, value in given._asdict().items():
        if isinstance(value, tuple):
            found |= lane_of(value, lane, f"{prefix}{field}_")
        elif value is not None:
            found[prefix + field] = value[..., lane]
    return found
