"""Recordings made from the simulation: what the sensors say in episodes of a scenario, with the truth."""

from collections.abc import Sequence
from typing import Any

import numpy

from ..envs.backend import make_model
from ..envs.catalogue import find_scenario, import_task, make_task, read_files
from ..envs.filter import Filter, Initial, Input
from ..envs.model import Episode, Model
from ..envs.recording import MOST_NUMBERS, Recording, measure_once
from ..envs.recording_files import differing
from ..envs.task import Task, named_arrays
from .rollout import Progress, start_lanes
from .seeds import episode_seeds

CHUNK = 256
"""Episodes recorded side by side."""


class NoFilter(Filter[Task, Any, Initial]):
    """In place of a filter where nobody estimates: the initial estimate stands."""

    def start(self, initial: Any) -> Initial:
        """Report the initial estimate."""
        return Initial(initial.mean, initial.covariance)

    def update(self, state: Initial, given: Input) -> Initial:
        """Learn nothing."""
        return state


def _no_filter(model: Model) -> NoFilter:
    return NoFilter(model.task)


def record(
    env: str,
    scenario: Any = None,
    episodes: int = 10,
    seed: int = 0,
    split: str = "test",
    progress: Progress | None = None,
    *,
    backend: str = "auto",
    **keywords: Any,
) -> Recording:
    """Record what the sensors say in episodes of the simulation, and the truth.

    They are the episodes that an evaluation of the same scenario, seed and split flies. Replayed on the same backend,
    observations, estimates and costs are the same, bit for bit.

    Args:
        env: environment id, such as ``"filtergym/ManeuveringTarget-v0"``.
        scenario: name of a scenario, a trajectory, or flights; default: the environment's training distribution.
        episodes: how many.
        seed: number of the experiment.
        split: "test" (default), "validation" or "train".
        progress: called with the number of measurements done, now and then.
        backend: what computes the steps, "auto", "compiled" or "numpy".
        **keywords: parameters of the task.

    Raises:
        ValueError: for unknown names, a closed loop, or more measurements than a recording may hold.
    """
    cls = import_task(env)
    seeds = episode_seeds(split, seed, episodes)
    chosen = find_scenario(cls, read_files(cls, scenario), keywords)
    plain = make_task(cls, chosen, **keywords)
    if chosen.recording is not None:
        raise ValueError(f"{chosen.name!r} is a recording already: name a scenario of the simulation")
    arrays = dict(named_arrays(measure_once(plain)[1]))
    row = sum(int(numpy.prod(values.shape[:-1])) for values in arrays.values()) + len(plain.components) + 1
    if row * episodes * (plain.horizon + 1) > MOST_NUMBERS:
        raise ValueError(
            f"{episodes:,} episodes of {plain.horizon:,} measurements are more than the {MOST_NUMBERS:,} numbers "
            "that a recording may hold: record fewer"
        )
    model = make_model(cls, scenario=chosen, backend=backend, **keywords).with_filter(_no_filter)
    chunks = [
        _record(model, seeds[i : i + CHUNK], progress or (lambda _: None)) for i in range(0, episodes, CHUNK)
    ]
    joined = [
        {name: numpy.concatenate([part[name] for part in parts]) for name in parts[0]}
        for parts in zip(*chunks, strict=True)
    ]
    measurements, initial_arrays = joined
    truth, lengths = measurements.pop("truth"), initial_arrays.pop("length")
    if "interval" in measurements:
        times = numpy.cumsum(measurements["interval"], axis=1)
    else:
        times = getattr(plain.parameters, "sampling_interval", 1.0) * numpy.arange(1, truth.shape[1] + 1)
    there = times_there(lengths, truth.shape[1])
    parameters = differing(plain.parameters)
    for name in cls.World.own_parameters:
        parameters.pop(name, None)
    names = [str(i) for i in range(episodes)]
    if plain.flights:
        names = [f"{chosen.flights[number]} {i}" for i, number in enumerate(initial_arrays.pop("flight"))]
    return Recording(
        environment=cls.id,
        measurements=measurements,
        initial=initial_arrays,
        seconds=numpy.where(there, times, numpy.nan),
        lengths=lengths,
        truth=truth,
        names=tuple(names),
        parameters=parameters,
        name=f"{chosen.name} recorded",
        source=f"filtergym record {cls.id}, scenario {chosen.name}, {split} split, seed {seed}",
    )


def times_there(lengths: numpy.ndarray, rows: int) -> numpy.ndarray:
    """Measurements that are recorded: those acted on, and the one that the last observation shows, ``(E, rows)``."""
    return numpy.arange(rows) <= lengths[:, None]


def _record(
    model: Model, seeds: Sequence[int], tick: Progress
) -> tuple[dict[str, numpy.ndarray], dict[str, numpy.ndarray]]:
    """Measurements and truth, ``(E, T, ...)``, and what was told of the start, ``(E, ...)``."""
    initial: dict[str, numpy.ndarray] = {}
    series: dict[str, list[numpy.ndarray]] = {}
    count = len(seeds)

    def first(values: numpy.ndarray) -> numpy.ndarray:
        return numpy.moveaxis(values[..., :count], -1, 0).copy()

    def keep_start(episode: Episode) -> None:
        initial.update({name: first(values) for name, values in named_arrays(episode.measurement)})

    def keep(episode: Episode) -> None:
        for name, values in named_arrays(episode.measurement):
            series.setdefault(name, []).append(first(values))
        series.setdefault("truth", []).append(first(model.task.world.state(episode.truth)))

    lanes, nothing = start_lanes(model, seeds, keep_start), numpy.zeros(count, dtype=numpy.int64)
    for _ in range(lanes.decisions_per_episode):
        for episode, _ in lanes.decide(nothing):
            keep(episode)
        tick(count * model.task.decision_interval)
    keep(lanes.state)
    uniforms = numpy.stack(
        [numpy.random.default_rng(s).random(model.task.noise.uniforms) for s in seeds], axis=1
    )
    initial["length"] = model.task.lengths(uniforms)
    if model.task.flights:
        initial["flight"] = model.task.flight_of(uniforms)
    return {name: numpy.stack(values, axis=1) for name, values in series.items()}, initial
