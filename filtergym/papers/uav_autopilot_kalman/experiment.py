"""Runs of the loop of aircraft, filter and controller, and its linear theory."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy

from ...baselines.uav_autopilot.policies import BASELINES
from ...envs.contract.model import Episode, Model
from ...envs.engine.backend import make_model
from ...envs.uav_autopilot.task import UavAutopilot
from ...evaluation.running.parallel import Workers
from ...evaluation.running.seeds import episode_seeds
from ...filters import linear_systems
from ..quantities import evaluate_policy, mean, record_run
from ..reproduction import Progress, compute_units, later

EPISODES = 600
HORIZON = 600
STEADY_WINDOW = slice(200, HORIZON)
"""Measurements after the burn-in."""
AFTER_STEP = slice(300, HORIZON)
STEP_TIME = 200
TWO_MINUTES = 6000
"""Measurements of plant U."""
CASES: dict[str, dict[str, Any]] = {
    "P, H = I": {"plant": "P"},
    "P, H = [1 0]": {"plant": "P", "sensors": ("position",)},
    "U": {"plant": "U"},
}
LOOPS = ("true-state", "kalman", "raw-sensors")
RANDOM = ("kalman", "matched")
STEPS = (len(LOOPS) + 1) * len(CASES) - 1 + 2 * len(RANDOM)


# --- runs


@dataclass
class Signals:
    """Signals of one control loop over all runs, ``(runs, time)`` each."""

    task: UavAutopilot
    output: numpy.ndarray
    control: numpy.ndarray
    cost: numpy.ndarray
    """Cost, in the units of the weights."""
    observation: numpy.ndarray
    estimate: numpy.ndarray
    innovation: numpy.ndarray
    """Innovation of the output, in its units; exact once the filter's covariance has settled."""
    nees: numpy.ndarray
    """Normalised estimation error squared per coordinate."""
    nis: numpy.ndarray
    plant_input: numpy.ndarray
    """Input of the plant: control plus white noise (plant P), or control (plant U)."""

    def text(self, name: str, digits: int = 4, times: slice = STEADY_WINDOW) -> str:
        """Return the mean of a signal over runs and time as text, with its standard error."""
        return f"{mean(getattr(self, name)[:, times].mean(axis=1)):.{digits}f}"

    def variance(self, name: str) -> float:
        """Return the mean square difference of a node's signal to the output, after the burn-in."""
        return float(numpy.mean((getattr(self, name) - self.output)[:, STEADY_WINDOW] ** 2))

    @property
    def decibel(self) -> float:
        """Noise power of the observation over that of the estimate, dB."""
        return 10.0 * math.log10(self.variance("observation") / self.variance("estimate"))


def simulate(keywords: dict[str, Any], scenario: str, loop: str, episodes: int) -> Signals:
    """Run one control loop of ``LOOPS`` on test episodes, and return its signals."""
    control = "mode" if loop == "raw-sensors" else "gain"
    model = make_model(UavAutopilot, control, scenario, horizon=HORIZON, **keywords)
    task: Any = model.task
    shown = task.measured.index(task.output)

    def fields(model: Model, episode: Episode) -> dict[str, numpy.ndarray]:
        error, records = model.error(episode), model.records(episode)
        covariance = numpy.moveaxis(model.covariance(episode), -1, 0)
        whitened = numpy.linalg.solve(covariance, error.T[:, :, None])[:, :, 0]
        without_filter = numpy.full_like(records["output"], numpy.nan)
        innovation = records.get("innovation", without_filter)
        return {
            "output": records["output"],
            "control": records["control_signal"],
            "cost": model.cost(episode) * task.cost_unit,
            "observation": episode.measurement.reading[shown],
            "estimate": model.mean(episode)[task.output],
            "innovation": innovation * math.sqrt(innovation_variance(task)),
            "nees": (whitened * error.T).sum(axis=1) / len(error),
            "nis": records["nis"] / records["nis_degrees"] if "nis" in records else without_filter,
            "truth": episode.truth.state,
        }

    actor = {**BASELINES.policies, **BASELINES.references}[loop](
        model if loop in BASELINES.policies else task
    )
    series = record_run(model, actor, episode_seeds("test", 0, episodes), fields)
    truth, plant_input = series.pop("truth"), series["control"].copy()
    if task.parameters.plant == "P":
        # What drives the plant to the next measurement; the last one has no next.
        driven = truth[:, 1:] - truth[:, :-1] @ task.design.model.F.T
        plant_input[:, :-1] = (driven @ numpy.linalg.pinv(task.design.model.B).T)[:, :, 0]
    return Signals(task=task, plant_input=plant_input, **series)


class Results(NamedTuple):
    """Results of all experiments, from which claims, tables and figures are made."""

    episodes: int
    noise: dict[str, dict[str, Signals]]
    """White-noise input, by case and loop."""
    step: dict[str, Signals]
    """Unit step and the same noise, the loop with the filter, by case."""
    random: dict[str, dict[str, Any]]
    """Datasets of the policies of ``RANDOM`` on scenario ``random``, by plant."""

    def response(self, case: str) -> numpy.ndarray:
        """Return the mean response of the output to a unit step of the command, ``(K - STEP_TIME + 1,)``."""
        # Linear loop, same noise: the difference of the runs is the response without noise, exactly.
        return (self.step[case].output - self.noise[case]["kalman"].output).mean(axis=0)[STEP_TIME - 1 :]

    def transient(self, case: str) -> tuple[float, float, float]:
        """Return the step response's overshoot, time to 90 %, and time to stay within 5 %, s."""
        y, T = self.response(case), interval(self.step[case].task)
        outside = numpy.flatnonzero(numpy.abs(y - 1.0) > 0.05)
        return max(float(y.max()) - 1.0, 0.0), float(numpy.argmax(y >= 0.9)) * T, float(outside[-1] + 1) * T


def run_everything(progress: Progress, episodes: int, workers: Workers | None = None) -> Results:
    """Run all experiments of the paper, and return their results; ``STEPS`` units of work."""

    def signals(keywords: dict[str, Any], scenario: str, loop: str) -> Any:
        return later(simulate, keywords, scenario, loop, episodes)

    results = Results(
        episodes,
        {
            # One sensor cannot be fed back alone: the loop is unstable.
            case: {
                loop: signals(keywords, "paper-noise", loop)
                for loop in LOOPS
                if loop != "raw-sensors" or "sensors" not in keywords
            }
            for case, keywords in CASES.items()
        },
        {
            case: signals(keywords | {"step_time": STEP_TIME}, "paper-step", "kalman")
            for case, keywords in CASES.items()
        },
        {
            plant: {
                name: later(evaluate_policy, "UavAutopilot", name, "random", episodes, plant=plant)
                for name in RANDOM
            }
            for plant in "PU"
        },
    )
    done: Results = compute_units(results, progress, workers)
    return done


# --- theory


class Loop(NamedTuple):
    """Matrices of the control loop: plant, sensors, feedback, steady-state filter gain, noise covariances."""

    F: numpy.ndarray
    B: numpy.ndarray
    H: numpy.ndarray
    L: numpy.ndarray
    K: numpy.ndarray
    Q: numpy.ndarray
    R: numpy.ndarray


def matrices(task: UavAutopilot) -> Loop:
    """Return the matrices of a task's control loop."""
    d = task.design
    Q = d.model.scaled_noise + d.model.other_noise
    return Loop(d.model.F, d.model.B, d.H, d.feedback, d.steady.gain, Q, d.R)


def interval(task: UavAutopilot) -> float:
    """Return the sampling interval T of a task, s."""
    return float(task.parameters.value("sampling_interval"))


def innovation_variance(task: UavAutopilot) -> float:
    """Return the steady-state variance of the innovation of the controlled output."""
    d, shown = task.design, task.measured.index(task.output)
    return float((d.H @ d.steady.predicted @ d.H.T + d.R)[shown, shown])


def spectrum(values: numpy.ndarray, T: float) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return frequencies, Hz, and the periodogram averaged over runs, unit^2/Hz, of signals ``(runs, time)``."""
    n = values.shape[1]
    power = (numpy.abs(numpy.fft.rfft(values, axis=1)) ** 2).mean(axis=0) * T / n
    return numpy.fft.rfftfreq(n, T), power


def flatness(values: numpy.ndarray) -> float:
    """Return the spectral flatness: geometric over arithmetic mean of the averaged periodogram, 1 for white noise."""
    power = spectrum(values, 1.0)[1]
    return float(numpy.exp(numpy.log(power).mean()) / power.mean())


def theory_spectra(task: UavAutopilot, frequency: numpy.ndarray) -> dict[str, numpy.ndarray]:
    """Return the theoretical power spectra of the loop's signals under white noise, by name."""
    (F, B, H, L, K, Q, R), T = matrices(task), interval(task)
    n, m = len(F), len(R)
    loop = linear_systems.estimate_feedback_loop(F, B, H, L, K, Q, R)
    entry = numpy.block([[numpy.eye(n), numpy.zeros_like(K)], [numpy.eye(n) - K @ H, -K]])
    noise = numpy.block(
        [
            [linear_systems.noise_factor(Q), numpy.zeros((n, m))],
            [numpy.zeros((m, n)), numpy.linalg.cholesky(R)],
        ]
    )
    sensor = numpy.eye(m)[[task.measured.index(task.output)]]
    coordinate = numpy.eye(n)[[task.output]]
    z = numpy.exp(2j * numpy.pi * frequency * T)[:, None, None]
    # The noise of a measurement acts on the state of that measurement: s(k) = A s(k-1) + entry n(k).
    response = numpy.linalg.solve(numpy.eye(2 * n) - loop.transition / z, entry @ noise + 0.0 * z)

    def power(row: numpy.ndarray, feed: Any = 0.0) -> numpy.ndarray:
        return T * (numpy.abs(row @ response + feed) ** 2).sum(axis=(1, 2))

    # The noise on the control between two measurements belongs to the second one, hence the z.
    driven = numpy.zeros((1, noise.shape[1]))
    if task.parameters.plant == "P":
        driven[0, 0] = task.parameters.acceleration_sigma
    return {
        "output": power(numpy.hstack([coordinate, 0.0 * coordinate])),
        "plant_input": power(-L @ numpy.hstack([numpy.eye(n), -numpy.eye(n)]), z * driven),
        "observation": power(
            numpy.hstack([coordinate, 0.0 * coordinate]), numpy.hstack([numpy.zeros((1, n)), sensor]) @ noise
        ),
        "estimate": power(numpy.hstack([coordinate, -coordinate])),
        "innovation": T * innovation_variance(task) + 0.0 * frequency,
    }


def settled_output(task: UavAutopilot, predicts_command: bool) -> float:
    """Return the steady-state output of the control loop after a unit command.

    Args:
        task: task with the control loop.
        predicts_command: whether the filter predicts with the control in force, command included, as (10) is printed;
            otherwise with the feedback alone, as (6) is.
    """
    F, B, H, L, K, _, _ = matrices(task)
    one = numpy.eye(len(F))
    # x = F x + B (N - L y);  y = (1 - K H) (F y + B (N - L y)) + K H x, where (6) leaves N out
    system = numpy.block([[one - F, B @ L], [-K @ H, one - (one - K @ H) @ (F - B @ L)]])
    command = B[:, 0] * task.design.feedforward
    predicted = (one - K @ H) @ command * predicts_command
    return float(numpy.linalg.solve(system, numpy.concatenate([command, predicted]))[task.output])


def loop_theory(task: UavAutopilot, scale: float) -> tuple[float, float, float]:
    """Return the loop's exact cost and variances of output and control; ``scale`` is on the filter's Q."""
    F, B, H, L, _, Q, R = matrices(task)
    n, d = len(F), task.design
    K = linear_systems.steady_kalman(F, H, scale * Q, R).gain
    X = linear_systems.stationary_covariance(*linear_systems.estimate_feedback_loop(F, B, H, L, K, Q, R))
    row = numpy.hstack([L, -L])
    control = float((row @ X @ row.T)[0, 0])
    cost = float(numpy.trace(d.weight @ X[:n, :n])) + d.control_weight * control
    return cost, float(X[task.output, task.output]), control


def covariances(task: UavAutopilot, **changes: Any) -> numpy.ndarray:
    """Return the estimate's sigma and the gain on the integrating mode by (12), ``(2, TWO_MINUTES)``.

    The mode's coordinate is ``w^T x`` with ``w^T F = w^T``, scaled to contain the output once.
    """
    F, _, H, _, _, Q, R = matrices(task)._replace(**changes)
    values, vectors = numpy.linalg.eig(F.T)
    w = numpy.real(vectors[:, numpy.argmin(numpy.abs(values - 1.0))])
    w = w / w[task.output]
    P = numpy.diag(numpy.square(task.parameters.value("initial_sigmas"))).astype(float)
    found = numpy.empty((2, TWO_MINUTES))
    for k in range(TWO_MINUTES):
        P = F @ P @ F.T + Q
        K = numpy.zeros((len(F), 1))
        if len(H):
            K = P @ H.T @ numpy.linalg.inv(H @ P @ H.T + R)
            rest = numpy.eye(len(F)) - K @ H
            P = rest @ P @ rest.T + K @ R @ K.T
        found[:, k] = math.sqrt(P[task.output, task.output]), float(numpy.linalg.norm(w @ K))
    return found


def covariance_curves(task: UavAutopilot) -> dict[str, numpy.ndarray]:
    """Return :func:`covariances` of plant U by (12), and in cases such as without measurements, by case."""
    names = [c.name for c in task.components]
    H = numpy.eye(len(names))
    rate, elevator = names.index("rate"), names.index("elevator")
    R = numpy.diag(numpy.square(task.parameters.value("sensor_sigmas")[1:]))
    return {
        "with the correcting term": covariances(task),
        "without it (no measurement)": covariances(task, H=H[:0]),
        "no sensor of pitch: not detectable": covariances(task, H=H[[rate, elevator]], R=R),
        "gusts the only noise": covariances(task, Q=task.design.model.scaled_noise),
    }
