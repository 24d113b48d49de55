"""Recording of simulated episodes of a scenario: their measurements and the truth."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy

from ...envs.contract.filter import Filter, FilterInput, Initial
from ...envs.contract.model import Episode, Model
from ...envs.contract.task import Task, named_arrays
from ...envs.data.foreign_files import MOST_NUMBERS
from ...envs.data.recorded_world import measure_once
from ...envs.data.recording import Recording, changed_parameters
from ...envs.engine.backend import make_model
from ...envs.engine.compiled import can_step
from ...envs.engine.episode_noise import uniforms_of_seeds
from ...envs.engine.scenario_choice import find_scenario, make_task, read_files
from .evaluate import Experiment
from .rollout import AT_ONCE, Progress, start_lanes
from .seeds import episode_seeds

CHUNK = 256
"""Number of episodes recorded side by side."""


class NoFilter(Filter[Task, Any, Initial]):
    """Filter whose estimate is always the initial one, for runs without an estimator."""

    def start(self, initial: Any) -> Initial:
        """Return the initial estimate, as the state."""
        return Initial(initial.mean, initial.covariance)

    def update(self, state: Initial, inputs: FilterInput) -> Initial:
        """Return the state, the initial estimate, unchanged."""
        return state


def _no_filter(model: Model) -> NoFilter:
    return NoFilter(model.task)


def record_experiment(experiment: Experiment, progress: Progress | None = None) -> Recording:
    """Simulate the episodes of an experiment; return their measurements and truth as a recording.

    Replayed on the same backend, observations, estimates and costs are those of an evaluation, bit for bit.

    Args:
        experiment: episodes, parameters and backend are used; no policy runs.
        progress: called with the number of measurements done, now and then.

    Raises:
        ValueError: for unknown names, a closed loop, or more measurements than a recording may contain.
    """
    cls, split, seed, episodes = experiment.task, experiment.split, experiment.seed, experiment.episodes
    seeds = episode_seeds(split, seed, episodes)
    chosen = find_scenario(cls, read_files(cls, experiment.scenario), experiment.keywords)
    if chosen.recording is not None:
        raise ValueError(f"{chosen.name!r} is a recording already: name a scenario of the simulation")
    plain = make_task(cls, chosen, **experiment.keywords)
    _check_size(plain, episodes)
    model = make_model(cls, scenario=chosen, backend=experiment.backend, **experiment.keywords)
    model = model.with_filter(_no_filter)
    chunks = [
        _record(model, seeds[i : i + CHUNK], progress or (lambda _: None)) for i in range(0, episodes, CHUNK)
    ]
    measurements, initial = (
        {name: numpy.concatenate([part[name] for part in parts]) for name in parts[0]}
        for parts in zip(*chunks, strict=True)
    )
    truth, lengths = measurements.pop("truth"), initial.pop("length")
    if "interval" in measurements:
        times = numpy.cumsum(measurements["interval"], axis=1)
    else:
        times = getattr(plain.parameters, "sampling_interval", 1.0) * numpy.arange(1, truth.shape[1] + 1)
    # The measurements with an action, and that of the last observation.
    there = numpy.arange(truth.shape[1]) <= lengths[:, None]
    parameters = changed_parameters(plain.parameters)
    for name in cls.World.own_parameters:
        parameters.pop(name, None)
    names = [str(i) for i in range(episodes)]
    if plain.flights:
        names = [f"{chosen.flights[number]} {i}" for i, number in enumerate(initial.pop("flight"))]
    return Recording(
        environment=cls.id,
        measurements=measurements,
        initial=initial,
        seconds=numpy.where(there, times, numpy.nan),
        lengths=lengths,
        truth=truth,
        names=tuple(names),
        parameters=parameters,
        name=f"{chosen.name} recorded",
        source=f"filtergym record {cls.id}, scenario {chosen.name}, {split} split, seed {seed}",
    )


def _check_size(task: Task, episodes: int) -> None:
    """Raise ValueError if the episodes have more numbers than a recording may contain, or for a closed loop."""
    arrays = dict(named_arrays(measure_once(task)[1]))
    row = sum(int(numpy.prod(values.shape[:-1])) for values in arrays.values()) + len(task.components) + 1
    if row * episodes * (task.horizon + 1) > MOST_NUMBERS:
        raise ValueError(
            f"{episodes:,} episodes of {task.horizon:,} measurements are more than the {MOST_NUMBERS:,} numbers "
            "that a recording may contain: record fewer"
        )


def _record(
    model: Model, seeds: Sequence[int], tick: Progress
) -> tuple[dict[str, numpy.ndarray], dict[str, numpy.ndarray]]:
    """Simulate episodes; return measurements and truth by name, ``(E, T, ...)``, and initial values
    ``(E, ...)``.
    """
    initial: dict[str, numpy.ndarray] = {}
    series: dict[str, list[numpy.ndarray]] = {}
    count, interval = len(seeds), model.task.decision_interval

    def keep_start(episode: Episode) -> None:
        initial.update(
            {name: _episodes_first(values, count) for name, values in named_arrays(episode.measurement)}
        )

    def keep(found: Mapping[str, numpy.ndarray]) -> None:
        for name, values in found.items():
            series.setdefault(name, []).append(_episodes_first(values, count))

    is_compiled = can_step(model, _measured)
    lanes = start_lanes(model, seeds, keep_start, _measured if is_compiled else None)
    nothing, decisions = numpy.zeros(count, dtype=numpy.int64), lanes.decisions_per_episode
    most = max(1, AT_ONCE // (lanes.width * interval)) if is_compiled else 1
    for first in range(0, decisions, most):
        some = min(most, decisions - first)
        if is_compiled:
            keep(lanes.run(_measured, None, some * interval)[0])
        else:
            for found, _ in lanes.decide(nothing, _measured):
                keep({name: values[None] for name, values in found.items()})
        tick(count * some * interval)
    keep({name: values[None] for name, values in _measured(model, lanes.state).items()})
    uniforms = uniforms_of_seeds(seeds, model.task.noise)
    initial["length"] = model.task.lengths(uniforms)
    if model.task.flights:
        initial["flight"] = model.task.flight_of(uniforms)
    return {name: numpy.concatenate(values, axis=1) for name, values in series.items()}, initial


def _measured(model: Model, episode: Episode) -> dict[str, Any]:
    return {**dict(named_arrays(episode.measurement)), "truth": model.task.world.state(episode.truth)}


def _episodes_first(values: numpy.ndarray, count: int) -> numpy.ndarray:
    return numpy.moveaxis(values[..., :count], -1, 0).copy()
