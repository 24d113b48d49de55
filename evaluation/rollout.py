"""Episodes from their seeds to their end, with whatever competes in the loop."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium
import numpy

from ..compiler.functions import padded_width
from ..envs.compiled import Report
from ..envs.lanes import Lanes, whole_episode
from ..envs.model import Episode, Model
from ..envs.observation import Array
from .competitors import Kind, check_competitor, kind_of, made
from .dataset import FAULTS
from .filters import put_in_loop
from .smoothers import Smoothed, check_open_loop, run_forward
from .stepping import SteppingPolicy

Progress = Callable[[int], None]
"""Called with the number of measurements just done."""


def start_lanes(model: Model, seeds: Sequence[int], begun: Callable[[Episode], None] | None = None) -> Lanes:
    """Return one episode for each seed, side by side, with its first measurement made.

    Args:
        model: task with a bank.
        seeds: of the episodes.
        begun: called with the episodes at the start of the track.
    """
    lanes = Lanes(model, len(seeds), begun=begun)
    for lane, seed in enumerate(seeds):
        lanes.seed(lane, numpy.random.default_rng(seed))
    lanes.restart()
    return lanes


def rollout(
    model: Model,
    competitor: Any,
    seeds: Sequence[int],
    report: Report = whole_episode,
    *,
    kind: Kind | None = None,
    name: str = "competitor",
) -> Iterator[tuple[Any, Array]]:
    """Run whatever competes over one episode for each seed, measurement by measurement.

    Args:
        model: task with a bank; of a policy, that of its control.
        competitor: policy, estimator, smoother, reference or bound, or a class or function that makes it. A smoother
            runs over the episodes twice, the second time with what it says when all is measured.
        seeds: of the episodes, all run side by side.
        report: function of the model and the state after the measurement was taken in; default: the state itself.
        kind: what the competitor is; default: what it says.
        name: of it, in errors.

    Yields:
        For every measurement the report, arrays ``(..., N)`` whose lanes beyond ``len(seeds)`` are padding, and the
        action applied to it, batch first.
    """
    kind = kind or kind_of(competitor)
    if kind == "smoother":
        check_open_loop(model, name)
        competitor, kind = Smoothed(*_smoothed_estimates(model, competitor, seeds, name)), "estimator"
    if kind != "policy":
        model = put_in_loop(model, competitor, kind, name, len(seeds))
        lanes, action = start_lanes(model, seeds), numpy.zeros(len(seeds), dtype=numpy.int64)
        for _ in range(lanes.decisions_per_episode):
            for found, _ in lanes.decide(action, report):
                yield found, action
        return
    lanes = start_lanes(model, seeds)
    policy = SteppingPolicy(model, check_competitor(name, made(competitor, model), kind))
    memory = policy.begin(seeds)
    for _ in range(lanes.decisions_per_episode):
        action, memory = policy.predict(lanes.observe(), memory)
        for found, _ in lanes.decide(action, report):
            yield found, action


def _smoothed_estimates(
    model: Model, competitor: Any, seeds: Sequence[int], name: str
) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return means ``(C, K, N)`` and covariances ``(C, C, K, N)`` of a smoother, N a multiple of eight.

    Episodes of one length are smoothed together, from their last measurement on; beyond it that estimate is held.
    """
    task = model.task
    noise = [numpy.random.default_rng(seed).random((task.noise.uniforms, 1)) for seed in seeds]
    lengths = task.lengths(numpy.concatenate(noise, axis=1))
    K, C, width = task.horizon, len(task.components), padded_width(len(seeds))
    means, covariances = numpy.empty((C, K, width)), numpy.empty((C, C, K, width))
    for length in numpy.unique(lengths).tolist():
        lanes = numpy.flatnonzero(lengths == length)
        own = [seeds[lane] for lane in lanes.tolist()]
        looped = put_in_loop(model, competitor, "smoother", name, len(own))
        found = run_forward(looped, start_lanes(looped, own), length, name)
        for kept, answered in zip((means, covariances), found, strict=True):
            kept[..., :length, lanes] = answered[..., : len(own)]
            kept[..., length:, lanes] = answered[..., -1:, : len(own)]
    last = numpy.minimum(numpy.arange(width), len(seeds) - 1)
    return means[..., last], covariances[..., last]


def run_competitor(
    model: Model,
    competitor: Any,
    kind: Kind,
    seeds: Sequence[int],
    report: Report,
    tick: Progress = lambda measurements: None,
    name: str = "competitor",
    first_episode: int = 0,
    actions: bool = False,
    only: Mapping[str, int] | None = None,
    strict: bool = False,
) -> dict[str, numpy.ndarray]:
    """Run whatever competes over one episode for each seed, and return what is reported of every measurement.

    Args:
        model: as in :func:`rollout`, likewise what follows.
        competitor: likewise.
        kind: likewise.
        seeds: likewise.
        report: of arrays ``(..., N)`` by name.
        tick: called with the number of measurements just done.
        name: of the competitor, in errors.
        first_episode: number of the first episode, in errors.
        actions: of a policy whose action is a box, report too what was applied: ``action``, ``(episodes, time, A)``,
            within the limits of the box, as every bank takes it.
        only: beginning of names -> of how many of the first episodes these are kept.
        strict: raise where an estimator would lose an episode, see :class:`.filters.EstimatorFilter`.

    Returns:
        Arrays ``(episodes, time, ...)`` by name.
    """
    series: dict[str, list[numpy.ndarray]] = {}
    fewer, space = dict(only or {}), model.action_space
    counts: dict[str, int] = {}

    def keep(name: str, values: numpy.ndarray) -> None:
        if name not in series:
            most = [count for beginning, count in fewer.items() if name.startswith(beginning)]
            counts[name], series[name] = min(len(seeds), *most) if most else len(seeds), []
        kept = values[..., : counts[name]]
        # A view of a few episodes would keep the numbers of all.
        series[name].append(numpy.moveaxis(kept.copy() if counts[name] < len(seeds) else kept, -1, 0))

    boxed = actions and kind == "policy" and isinstance(space, gymnasium.spaces.Box)
    reserved = {"action", "lost"} if kind == "policy" and actions else set()
    for step, (found, action) in enumerate(
        rollout(model, competitor, seeds, report, kind=kind, name=name), 1
    ):
        for taken in reserved & found.keys():
            raise ValueError(
                f"{model.task.id} records something under the name {taken!r}, under which an evaluation keeps "
                "which actions were applied or episodes lost: call it something else"
            )
        if strict and "lost" in found:
            _refuse_losses(found["lost"][: len(seeds)], name, first_episode, step)
        for each, values in found.items():
            keep(each, values)
        if boxed:
            bounded = numpy.clip(numpy.asarray(action, dtype=numpy.float64), space.low, space.high)  # type: ignore
            keep("action", bounded.reshape(len(seeds), -1).T)
        tick(len(seeds))
    if kind in ("estimator", "smoother", "reference"):  # few say how likely a measurement was
        for each in ("log_likelihood", "nis", "nis_degrees"):
            if each in series and all(numpy.isnan(values).all() for values in series[each]):
                del series[each]
    return {each: numpy.stack(values, axis=1) for each, values in series.items()}


def _refuse_losses(faults: numpy.ndarray, name: str, first_episode: int, step: int) -> None:
    """Raise ValueError if an episode is lost."""
    if faults.any():
        i = int(numpy.argmax(faults > 0.0))
        raise ValueError(
            f"estimator {name!r}: {FAULTS[int(faults[i]) - 1]} in episode {first_episode + i} at measurement {step}"
        )
