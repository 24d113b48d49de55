"""Episodes from their seeds to their end, with whatever competes in the loop."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy

from ..compiler.functions import round_up_lanes
from ..envs.compiled import Report
from ..envs.episode_noise import identities_of_seeds, uniforms_of_seeds
from ..envs.lanes import Lanes, whole_episode
from ..envs.model import Episode, Model
from ..envs.observation import Array
from .competitors import Kind, check_competitor, kind_of, make_competitor
from .filters import put_in_loop
from .smoothers import SmoothedTrack, check_open_loop, run_forward
from .stepping import SteppingPolicy

Progress = Callable[[int], None]
"""Called with the number of measurements just done."""


def start_lanes(
    model: Model, seeds: Sequence[int], on_start: Callable[[Episode], None] | None = None
) -> Lanes:
    """Return one episode for each seed, side by side, with its first measurement made.

    Args:
        model: task with a bank.
        seeds: of the episodes.
        on_start: called with the episodes at the start of the track.
    """
    lanes = Lanes(model, len(seeds), on_start=on_start)
    lanes.begin(identities_of_seeds(seeds))
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
        competitor, kind = SmoothedTrack(*_smoothed_estimates(model, competitor, seeds, name)), "estimator"
    if kind != "policy":
        model = put_in_loop(model, competitor, kind, name, len(seeds))
        lanes, action = start_lanes(model, seeds), numpy.zeros(len(seeds), dtype=numpy.int64)
        for _ in range(lanes.decisions_per_episode):
            for found, _ in lanes.decide(action, report):
                yield found, action
        return
    lanes = start_lanes(model, seeds)
    policy = SteppingPolicy(model, check_competitor(name, make_competitor(competitor, model), kind))
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
    lengths = task.lengths(uniforms_of_seeds(seeds, task.noise))
    K, C, width = task.horizon, len(task.components), round_up_lanes(len(seeds))
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


class Series:
    """What is kept of every measurement of episodes that run side by side.

    Args:
        episodes: how many run.
        fewer: beginning of names -> of how many of the first episodes these are kept; everything else of all.
    """

    def __init__(self, episodes: int, fewer: Mapping[str, int] | None = None) -> None:
        self.episodes, self.fewer = episodes, fewer or {}
        self._counts: dict[str, int] = {}
        self._values: dict[str, list[numpy.ndarray]] = {}

    def add(self, found: Mapping[str, Any]) -> None:
        """Keep what is there after a measurement, arrays ``(..., N)`` by name, padding beyond the episodes."""
        for name, values in found.items():
            if name not in self._values:
                counts = [count for beginning, count in self.fewer.items() if name.startswith(beginning)]
                self._counts[name], self._values[name] = min([self.episodes, *counts]), []
            count = self._counts[name]
            kept = values[..., :count]
            # A view of a few episodes would keep the numbers of all.
            kept = kept.copy() if count < self.episodes else kept
            self._values[name].append(kept)

    def arrays(self) -> dict[str, numpy.ndarray]:
        """Return what was kept, ``(episodes, time, ...)`` by name."""
        return {name: _by_episodes(values) for name, values in self._values.items()}


def _by_episodes(values: Sequence[numpy.ndarray]) -> numpy.ndarray:
    """Put the arrays ``(..., N)`` of T measurements into one, ``(N, T, ...)``, rows one after the other."""
    first = values[0]
    together = numpy.empty(
        (first.shape[-1], len(values), *first.shape[:-1]), dtype=numpy.result_type(*values[:1])
    )
    numpy.stack(values, out=numpy.moveaxis(together, 0, -1), casting="same_kind")
    return together


def run_competitor(
    model: Model, competitor: Any, kind: Kind, seeds: Sequence[int], report: Report
) -> dict[str, numpy.ndarray]:
    """Run whatever competes over one episode for each seed, and return what is reported of every measurement.

    Args:
        model: as in :func:`rollout`, likewise what follows.
        competitor: likewise.
        kind: likewise.
        seeds: likewise.
        report: of arrays ``(..., N)`` by name.

    Returns:
        Arrays ``(episodes, time, ...)`` by name.
    """
    series = Series(len(seeds))
    for found, _ in rollout(model, competitor, seeds, report, kind=kind):
        series.add(found)
    return series.arrays()
