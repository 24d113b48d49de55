"""Experiments on the paper's flight: the IMM, its rivals, other readings of the paper, a grid of gains."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy

from ...envs.contract.filter import Initial
from ...envs.engine.backend import make_model
from ...envs.engine.scenario_choice import make_task
from ...envs.maneuvering_target.task import ManeuveringTarget
from ...evaluation.running.parallel import Workers
from ...evaluation.running.rollout import start_lanes
from ...evaluation.running.seeds import episode_seeds
from ..quantities import evaluate_policy, means
from ..reproduction import Progress, compute_units, later
from .gain_schedules import best_schedule, maneuver_flight, mean_square_errors, ramp_schedule
from .imm_readings import Likelihood, Reading, Recording, interacting_multiple_model

EPISODES = 5000
GRID_EPISODES = 2000
SEED = 0

LOW_GAINS = (0.2, 0.25, 0.3, 0.35, 0.4, 0.45)
HIGH_GAINS = (0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)

WINDOWS = {**ManeuveringTarget.scenarios["paper"].windows, "all": (1, 100)}
SECTION = (WINDOWS["turn"][0], WINDOWS["recovery"][1])

LIKELIHOODS: dict[Likelihood, str] = {
    "gains used": "canonical: covariance of the gains used, mixed with spread",
    "no spread": "mixed without the spread of the means",
    "R/(1-alpha)": "S = R / (1 - alpha)",
    "steady": "S = R (1 + steady prediction variance)",
    "Kalman": "covariance of the optimal gain, Q = 0",
}
STAYS = (0.7, 0.8, 0.95, 0.98)
BOX_PAIRS = ((0.3, 0.85), (0.4, 0.85))
LATER = 1
"""Scans by which the turn begins later in the other reading of its start."""

VARIANTS = {
    "one IMM for each axis": Reading(per_axis=True),
    **{LIKELIHOODS[kind]: Reading(likelihood=kind) for kind in list(LIKELIHOODS)[1:]},
    **{f"stay probability {stay:g}": Reading(stay=stay) for stay in STAYS},
}
NAMES = {
    "imm": "IMM, 0.3 / 0.7",
    "adaptive": "adaptive filter",
    "adaptive-rearm": "adaptive filter, re-arming",
    "kalman-imm": "IMM over two Kalman filters (acceleration 0 and 2.775 m/s^2)",
    "known-turn": "Kalman filter given the turn's scans",
    "known-input-bound": "Cramer-Rao bound, acceleration known",
}
COMPARED_POLICIES = ("imm", "adaptive", "adaptive-rearm")
COMPONENTS = (("position", "m"), ("velocity", "m/s"))
STEPS = (
    len(NAMES)
    + (len(BOX_PAIRS) + 2) * len(COMPARED_POLICIES)
    + len(VARIANTS)
    + len(LIKELIHOODS) * len(LOW_GAINS)
)


def mean_squares(error: numpy.ndarray) -> numpy.ndarray:
    """Return mean squares of errors ``(episodes, K, 4)`` along x in each scan, ``(1 + resamples, K, 2)``."""
    return means(error[:, :, ::2] ** 2)


def rms(squares: numpy.ndarray, window: tuple[int, int] | None) -> numpy.ndarray:
    """Return the RMS over a window of scans, ends included (None: the peak), of squares ``(..., K, 2)``."""
    if window is None:
        return numpy.sqrt(squares.max(axis=-2))
    return numpy.sqrt(squares[..., window[0] - 1 : window[1], :].mean(axis=-2))


class Run(NamedTuple):
    """Errors of one policy, reference or bound over all episodes, with mode probabilities and gains."""

    squares: numpy.ndarray
    """Mean squares, ``(1 + resamples, K, 2)``, or ``(1, K, 2)`` where they are exact."""
    probability: numpy.ndarray
    """Probability of mode 1, ``(episodes, K)``; empty without modes."""
    alpha: numpy.ndarray
    """Gain used, ``(episodes, K)``; empty where there is none."""
    first: numpy.ndarray
    """Estimate minus truth in the first episode, ``(K, 4)``."""


def run_policy(name: str, episodes: int, **keywords: Any) -> Run:
    """Run a policy, reference or bound over the paper's flight; return its errors, probabilities and gains."""
    one = evaluate_policy(ManeuveringTarget.id, name, "paper", episodes, seed=SEED, **keywords)
    nothing = numpy.empty((0, 0))
    if "mean_square" in one:
        squares = one["mean_square"].values[:1]
        return Run(squares[:, :, ::2], nothing, nothing, squares[0])
    error = one["error"].values
    probability = one["mode_probability"].values[:, :, 0] if "mode_probability" in one else nothing
    return Run(mean_squares(error), probability, one["alpha"].values if "alpha" in one else nothing, error[0])


def record_measurements(episodes: int, seed: int, scenario: str = "paper", **keywords: Any) -> Recording:
    """Return measurements and truth of test episodes of ManeuveringTarget, as ``evaluate`` runs them."""
    model = make_model(ManeuveringTarget, "gain", scenario, **keywords)
    task: Any = model.task
    starts: list[Initial] = []
    lanes = start_lanes(
        model, episode_seeds("test", seed, episodes), lambda episode: starts.append(episode.measurement)
    )
    kept = []
    for _ in range(lanes.decisions_per_episode):
        for episode, _ in lanes.decide(numpy.zeros((episodes, 1))):
            measurement, truth = episode.measurement, task.world.state(episode.truth)
            kept.append(
                [values[:, :episodes] for values in (measurement.position, measurement.variance, truth)]
            )
    (initial,) = starts
    start_variance = numpy.stack([initial.covariance[i, i, :episodes] for i in range(2)])
    measurement, variance, truth = (numpy.stack(values) for values in zip(*kept, strict=True))
    interval = task.parameters.sampling_interval
    return Recording(initial.mean[:, :episodes], start_variance, measurement, variance, truth, interval)


def variant(recording: Recording, reading: Reading) -> numpy.ndarray:
    """Return the mean squares ``(1 + resamples, K, 2)`` of an IMM's errors in one reading of the paper."""
    return mean_squares(numpy.moveaxis(interacting_multiple_model(recording, reading), -1, 0))


def grid_row(recording: Recording, likelihood: Likelihood, low: float) -> list[numpy.ndarray]:
    """Return the IMM's mean squares, each ``(1 + resamples, K, 2)``, of a lower gain with every higher one."""
    readings = [Reading(gains=(low, high), likelihood=likelihood) for high in HIGH_GAINS]
    return [variant(recording, reading) for reading in readings]


def squares_of(name: str, episodes: int, **keywords: Any) -> numpy.ndarray:
    """Return the mean squares ``(1 + resamples, K, 2)`` of a policy's errors over the paper's flight."""
    return run_policy(name, episodes, **keywords).squares


class Results(NamedTuple):
    """Results of all experiments, from which claims, tables and figures are made."""

    episodes: int
    grid_episodes: int
    main: Mapping[str, Run]
    exact: Mapping[str, numpy.ndarray]
    """Mean squares of one filter, ``(1, K, 2)``."""
    forced: Mapping[int, numpy.ndarray]
    """Mean squares of the adaptive filter, by the scan at which the manoeuvre is detected."""
    boxed: Mapping[tuple[float, float], Mapping[str, numpy.ndarray]]
    """Mean squares of IMM and comparators with other gains."""
    polar: Mapping[str, numpy.ndarray]
    later: Mapping[str, numpy.ndarray]
    readings: Mapping[str, numpy.ndarray]
    """``VARIANTS`` of the IMM on the episodes of ``main``."""
    grids: Mapping[Likelihood, numpy.ndarray]
    recording: Recording
    schedule: numpy.ndarray
    """Best gains of each scan, ``(K,)``."""


def run_everything(progress: Progress, episodes: int, workers: Workers | None = None) -> Results:
    """Run all experiments of the paper, and return their results; ``STEPS`` units of work."""
    parameters: Any = make_task(ManeuveringTarget, "paper").parameters
    flight, scans, (low, high) = maneuver_flight(parameters), parameters.horizon, parameters.gains

    def exactly(alpha: numpy.ndarray) -> numpy.ndarray:
        return numpy.stack(mean_square_errors(flight, alpha), axis=-1)[None]

    def rivals(**keywords: Any) -> dict[str, Any]:
        return {name: later(squares_of, name, episodes, **keywords) for name in COMPARED_POLICIES}

    schedule = best_schedule(flight)
    exact = {f"fixed gain {a:g}": exactly(numpy.full(scans, a)) for a in (low, high, 0.65)}
    first, last = WINDOWS["turn"]
    recording = record_measurements(episodes, SEED)
    grid_episodes = max(2, math.ceil(GRID_EPISODES * min(1.0, episodes / EPISODES)))
    few = record_measurements(grid_episodes, SEED)
    results = Results(
        episodes,
        grid_episodes,
        main={name: later(run_policy, name, episodes) for name in NAMES},
        exact=exact | {"best gain schedule, flight known": exactly(schedule)},
        forced={k: exactly(ramp_schedule(low, high, scans, k)) for k in range(first, last + 1)},
        boxed={gains: rivals(gains=gains) for gains in BOX_PAIRS},
        polar=rivals(polar_measurements=True),
        later=rivals(maneuver_steps=(first + LATER, last + LATER)),
        readings={name: later(variant, recording, reading) for name, reading in VARIANTS.items()},
        grids={kind: [later(grid_row, few, kind, low) for low in LOW_GAINS] for kind in LIKELIHOODS},  # type: ignore[misc]
        recording=recording,
        schedule=schedule,
    )
    done: Results = compute_units(results, progress, workers)
    return done._replace(grids={kind: numpy.array(rows) for kind, rows in done.grids.items()})
