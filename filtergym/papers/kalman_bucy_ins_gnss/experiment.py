"""Example (a), a first-order process; example (b), INS and GNSS; the Riccati equation solved three ways."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy

from ...baselines.problem import problem_of
from ...envs.contract.model import Episode, Model
from ...envs.engine.backend import make_model
from ...envs.loosely_coupled_navigation.task import LooselyCoupledNavigation
from ...evaluation.running.parallel import Workers
from ...evaluation.running.seeds import episode_seeds
from ...filters import loosely_coupled as ins_gnss
from ...filters.linear_systems import steady_kalman_bucy, van_loan
from ..quantities import evaluate_policy, means, record_run
from ..reproduction import Progress, compute_units, later
from . import kalman_bucy

EPISODES = 4000
SEED = 0
LATE = slice(249, 500)
"""Measurements of the second half of a run, 2.5 to 5 s."""

# Example (a); all ours.
A, U, INTENSITY, RECEIVER = -0.5, 1.0, 1.0, 0.01
"""Constants of example (a): A, 1/s; U, unit/s; intensities of process, unit^2/s, and measurement, unit^2 s."""
STEP, STEPS_A = 0.005, 1000

NAMES = {
    "ins-only": "INS alone",
    "gnss-only": "GNSS alone",
    "plain-white": "plain, Ge = 0.04, settled gain",
    "time-varying-white": "plain, Ge = 0.04, Riccati gain",
    "plain-reduced": "plain, Ge = 0.36, settled gain",
    "time-varying": "plain, Ge = 0.36, Riccati gain",
    "best-constant": "plain, best constant gain",
    "augmented-gain": "plain, gain steered by an augmented filter",
    "augmented": "augmented",
    "matched": "augmented, given the noise levels (reference)",
}
DRIFTING = ("plain-white", "plain-reduced", "best-constant", "augmented")
EXAMPLE_POLICIES = ("plain-white", "plain-reduced", "augmented")
DRIFT = 1.0
"""Constant rate error of the example run and of the attenuation experiment, m/s."""
LONG = 2000
"""Measurements of the attenuation experiment: 20 s, so that the prior of the drift is forgotten."""
STEPS = 1 + len(NAMES) + len(DRIFTING) + 1

PARAMETERS = LooselyCoupledNavigation.Parameters()
LEVELS = (PARAMETERS.drift, PARAMETERS.coloured, PARAMETERS.correlation_time, PARAMETERS.white_intensity)
GAINS = {
    name: math.sqrt(intensity / PARAMETERS.receiver_intensity)
    for name, intensity in zip(
        ("plain-white", "plain-reduced"), PARAMETERS.equivalent_intensities, strict=True
    )
} | {"best-constant": ins_gnss.best_constant_gain(*LEVELS, PARAMETERS.receiver_intensity)}
"""Settled gains K of the plain scheme, 1/s."""


# --- example (a)


class FirstOrder(NamedTuple):
    """Results of example (a): paths of one run, mean squares of all runs, and exact ones."""

    time: numpy.ndarray
    path: Mapping[str, numpy.ndarray]
    """Reference, process and estimate of the first run, ``(steps,)``."""
    squares: Mapping[str, numpy.ndarray]
    """Late mean of each squared difference and of the product of the orthogonality identity, ``(runs,)``."""
    theory: Mapping[str, float]
    """Exact late means of the same, for the sampled filter."""


def first_order(runs: int) -> FirstOrder:
    """Simulate process, measurement and filter of example (a), and return paths and late mean squares."""
    rng = numpy.random.default_rng(SEED)
    phi, qd = (float(x[0, 0]) for x in van_loan(A, INTENSITY, STEP))
    push = U * (phi - 1.0) / A
    R = RECEIVER / STEP
    sampled = kalman_bucy.sampled_covariance(A, INTENSITY, 1, RECEIVER, 0, STEP, STEPS_A * STEP)
    X, estimate, reference = numpy.zeros(runs), numpy.zeros(runs), 0.0
    path = numpy.empty((3, STEPS_A))
    half = STEPS_A // 2
    sums = numpy.zeros((4, runs))
    for k in range(STEPS_A):
        X = phi * X + push + math.sqrt(qd) * rng.standard_normal(runs)
        reference = phi * reference + push
        predicted = phi * estimate + push
        innovation = X + math.sqrt(R) * rng.standard_normal(runs) - predicted
        estimate = predicted + sampled.gain[k, 0, 0] * innovation
        path[:, k] = reference, X[0], estimate[0]
        if k >= half:
            left, away, departure = X - estimate, estimate - reference, X - reference
            sums += left**2, away**2, departure**2, left * away
    time = STEP * numpy.arange(1, STEPS_A + 1)
    theta = kalman_bucy.moments(A, U, INTENSITY, 0, 0, time[half:]).covariance[:, 0, 0]
    P = sampled.updated[half:, 0, 0]
    exact = (float(P.mean()), float((theta - P).mean()), float(theta.mean()), 0.0)
    names = ("process", "reference", "departure", "product")
    return FirstOrder(
        time,
        dict(zip(("reference", "process", "estimate"), path, strict=True)),
        dict(zip(names, sums / half, strict=True)),
        dict(zip(names, exact, strict=True)),
    )


# --- example (b)


def example_run(name: str) -> dict[str, numpy.ndarray]:
    """Run a policy over one episode with the drift ``DRIFT``; return its curves, m, ``(500,)``, by name."""
    maker = problem_of(LooselyCoupledNavigation.id).competitor(name)
    model = make_model(LooselyCoupledNavigation, maker.control, "paper", fixed_drift=DRIFT)

    def fields(model: Model, episode: Episode) -> dict[str, numpy.ndarray]:
        measurement = episode.measurement
        shown = (episode.truth.reference, measurement.ins, measurement.fix, model.mean(episode))
        return dict(zip(("reference", "ins", "measurement", "estimate"), (x[0] for x in shown), strict=True))

    series = record_run(model, maker(model), episode_seeds("test", SEED, 1), fields)
    return {field: values[0] for field, values in series.items()}


def _model() -> tuple[Any, Any, Any, Any, Any]:
    """Return the matrices A, Q, C, R, and the initial covariance, of example (b)'s augmented model."""
    dynamics, growth, start = ins_gnss.error_model(*LEVELS)
    return dynamics, growth, [[1.0, 0.0, 0.0]], [[PARAMETERS.receiver_intensity]], start


def exact_plain(intensity: float, riccati: bool) -> float:
    """Return the exact RMS error, m, of the plain scheme (INS plus filtered difference) over 2.5 to 5 s."""
    p = PARAMETERS
    dynamics, growth, _, _, P = _model()
    Phi, Qd = van_loan(dynamics, growth, p.sampling_interval)
    R, settled = (
        p.receiver_variance,
        ins_gnss.steady_state_gain(intensity * p.sampling_interval, p.receiver_variance),
    )
    variance, squares = 0.0, []
    for _ in range(p.horizon):
        variance += intensity * p.sampling_interval
        gain = variance / (variance + R) if riccati else settled
        variance *= 1.0 - gain
        rest = numpy.eye(3) - gain * numpy.diag([1.0, 0.0, 0.0])
        P = rest @ (Phi @ P @ Phi.T + Qd) @ rest.T + numpy.diag([R * gain**2, 0.0, 0.0])
        squares.append(P[0, 0])
    return math.sqrt(numpy.mean(squares[LATE]))


def exact_root_mean_squares() -> dict[str, float]:
    """Return the exact root mean square error from 2.5 to 5 s, m, of every policy of ``NAMES`` that has a theory."""
    p = PARAMETERS

    def root(gain: list[float] | None) -> float:
        found = kalman_bucy.sampled_covariance(
            *_model(), p.sampling_interval, p.horizon * p.sampling_interval, gain=gain
        )
        return math.sqrt(found.updated[LATE, 0, 0].mean())

    white, reduced = p.equivalent_intensities
    return {
        "ins-only": root([0.0, 0.0, 0.0]),
        "gnss-only": root([1.0, 0.0, 0.0]),
        "plain-white": exact_plain(white, False),
        "time-varying-white": exact_plain(white, True),
        "plain-reduced": exact_plain(reduced, False),
        "time-varying": exact_plain(reduced, True),
        "best-constant": exact_plain(GAINS["best-constant"] ** 2 * p.receiver_intensity, False),
        "augmented": root(None),
        "matched": root(None),
    }


# --- the Riccati equation


class Agreement(NamedTuple):
    """Largest relative differences between solutions of the Riccati equation (5)."""

    hamiltonian: float
    """Exponential of the Hamiltonian matrix against the closed form, example (a)."""
    ode: float
    """Numerical integration against the closed form."""
    matrix: float
    """Exponential against integration, the augmented model."""
    order: float
    """Order at which the sampled filter approaches (5), from halving the step."""
    refusal: str
    """Error message for the steady augmented filter, which does not exist."""


def closed_form(times: Any) -> numpy.ndarray:
    """Return the Riccati covariance (5) of example (a) at given times, in closed form."""
    return kalman_bucy.riccati_scalar(A, INTENSITY, 1.0 / RECEIVER, 0.0, times)


def riccati_agreement() -> Agreement:
    """Solve the Riccati equation (5) in three ways, and return the largest differences between the solutions."""
    times = numpy.linspace(0.01, 5.0, 50)
    solvers = (kalman_bucy.riccati_hamiltonian, kalman_bucy.riccati_ode)
    scalar = [solve(A, INTENSITY, 1.0, RECEIVER, 0.0, times)[:, 0, 0] for solve in solvers]
    exponential, integrated = (solve(*_model(), times) for solve in solvers)
    hamiltonian, ode = (float(numpy.abs(solution / closed_form(times) - 1.0).max()) for solution in scalar)
    matrix = float(numpy.abs(exponential - integrated).max() / numpy.abs(exponential).max())
    offsets = []
    for step in (0.01, 0.005):
        sampled = kalman_bucy.sampled_covariance(A, INTENSITY, 1, RECEIVER, 0, step, 1.0)
        offsets.append(abs(sampled.updated[-1, 0, 0] / closed_form([1.0])[0] - 1.0))
    dynamics, growth, C, R, _ = _model()
    try:
        steady_kalman_bucy(dynamics, C, growth, R)
        refusal = "no refusal"
    except ValueError as error:
        refusal = str(error)
    return Agreement(hamiltonian, ode, matrix, math.log2(offsets[0] / offsets[1]), refusal)


# --- everything


class Results(NamedTuple):
    """Results of all experiments, from which claims, tables and figures are made."""

    episodes: int
    drifting_episodes: int
    example: FirstOrder
    squares: Mapping[str, numpy.ndarray]
    """Late mean square error of every policy of ``NAMES`` and bootstrap samples, m^2, ``(1 + resamples,)``."""
    drift: Mapping[str, numpy.ndarray]
    """Mean error over time with the drift ``DRIFT``, m, ``(1 + resamples, LONG)``."""
    paths: Mapping[str, Mapping[str, numpy.ndarray]]
    """One run of the policies of ``EXAMPLE_POLICIES``."""


def run_everything(progress: Progress, episodes: int, workers: Workers | None = None) -> Results:
    """Run all experiments of the paper, and return their results; ``STEPS`` units of work."""
    drifting = max(8, episodes // 4)
    results = Results(
        episodes,
        drifting,
        later(first_order, episodes),
        {name: later(_late_squares, name, episodes) for name in NAMES},
        {name: later(_drift, name, drifting) for name in DRIFTING},
        later(_example_runs),
    )
    done: Results = compute_units(results, progress, workers)
    return done


def _errors(name: str, count: int, **keywords: Any) -> numpy.ndarray:
    # A policy is tuned to the model; a fixed drift is one value of that model's prior.
    one = evaluate_policy(LooselyCoupledNavigation.id, name, "paper", count, seed=SEED, **keywords)
    values: numpy.ndarray = one["error"].values[:, :, 0]
    return values


def _late_squares(name: str, count: int) -> numpy.ndarray:
    return means((_errors(name, count)[:, LATE] ** 2).mean(axis=1))


def _drift(name: str, count: int) -> numpy.ndarray:
    return means(_errors(name, count, fixed_drift=DRIFT, horizon=LONG))


def _example_runs() -> dict[str, dict[str, numpy.ndarray]]:
    return {name: example_run(name) for name in EXAMPLE_POLICIES}
