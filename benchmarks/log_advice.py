"""What is advised on the first half of a log, judged on its second half, beside what one would write oneself.

For each pair of files: who is advised, its error on the second file as saved, the best shipped filter there in
hindsight, and a Kalman filter of constant velocity fitted by maximum likelihood in a few lines, without and with a
gate. The error is of positions where the second file holds the truth, else of predicted measurements. Seconds are of
the processor: until the first verdict, and until the end.

Example: python benchmarks/log_advice.py first.csv:second.csv
"""

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy
from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.advice import FittedLog, advise
from filtergym.baselines.fitted_filters import write_advised
from filtergym.baselines.problem import problem_of
from filtergym.envs.data.recording import Recording
from filtergym.envs.engine.scenario_choice import make_task, read_recording
from filtergym.evaluation.statistics.predictions import Predictions
from scipy.optimize import minimize

from filtergym.commands.advise import update_prices
from filtergym.commands.evaluation import causal_names
from filtergym.names import find_competitor

ID = "filtergym/ManeuveringTarget-v0"
SPEEDS = 0.0, 1000.0
GATE = 25.0
"""Squared innovation over its variance from which on the filter with a gate takes nothing in."""


def measured(recording: Recording) -> tuple[numpy.ndarray, ...]:
    """Times ``(T,)``, positions ``(T, 2)`` (NaN: missed) and their covariances ``(T, 2, 2)`` of the first track."""
    found = {name: values[0] for name, values in recording.measurements.items()}
    position, there = found["position"].copy(), found["available"] > 0.0
    position[~there] = math.nan
    deviation = numpy.sqrt(found["variance"])
    correlation = found.get("correlation", numpy.zeros(len(position)))
    R = deviation[:, :, None] * deviation[:, None, :]
    R[:, 0, 1] *= correlation
    R[:, 1, 0] *= correlation
    return recording.seconds[0], position, R


class OwnFilter:
    """The Kalman filter of constant velocity that one writes in twenty lines, with white acceleration.

    Args:
        gate: squared normalised innovation from which on nothing is taken in.
    """

    def __init__(self, gate: float = math.inf) -> None:
        self.gate = gate

    def run(
        self, log: tuple[numpy.ndarray, ...], q: float, scale: float
    ) -> tuple[float, numpy.ndarray, numpy.ndarray]:
        """Mean log-likelihood, estimated positions ``(T, 2)``, and prediction errors ``(T, 2)``."""
        seconds, z, R = log
        first, second = numpy.flatnonzero(numpy.isfinite(z[:, 0]))[:2]
        T = seconds[second] - seconds[first]
        x = numpy.concatenate([z[second], (z[second] - z[first]) / T])
        a, b = scale**2 * R[first], scale**2 * R[second]
        P = numpy.block([[b, b / T], [b / T, (a + b) / T**2]])
        likelihoods, estimates, errors = [], numpy.full_like(z, math.nan), numpy.full_like(z, math.nan)
        for k in range(second + 1, len(z)):
            T = seconds[k] - seconds[k - 1]
            F = numpy.kron([[1.0, T], [0.0, 1.0]], numpy.eye(2))
            x, P = F @ x, F @ P @ F.T + q**2 * numpy.kron([[T**3 / 3, T**2 / 2], [T**2 / 2, T]], numpy.eye(2))
            if numpy.isfinite(z[k, 0]):
                errors[k], S = z[k] - x[:2], P[:2, :2] + scale**2 * R[k]
                d2 = errors[k] @ numpy.linalg.solve(S, errors[k])
                usual = -0.5 * (d2 + numpy.linalg.slogdet(2.0 * math.pi * S)[1])
                if self.gate < math.inf:
                    wide = -0.5 * (d2 / 400.0 + numpy.linalg.slogdet(2.0 * math.pi * 400.0 * S)[1])
                    usual = numpy.logaddexp(math.log(0.97) + usual, math.log(0.03) + wide)
                likelihoods.append(usual)
                if d2 < self.gate:
                    K = numpy.linalg.solve(S, P[:2]).T
                    x, P = x + K @ errors[k], P - K @ S @ K.T
            estimates[k] = x[:2]
        return float(numpy.mean(likelihoods)), estimates, errors

    def fit(self, log: tuple[numpy.ndarray, ...]) -> numpy.ndarray:
        """Intensity of the acceleration and scale of the noise, by maximum likelihood."""

        def loss(logarithms: numpy.ndarray) -> float:
            value = self.run(log, *numpy.exp(logarithms))[0]
            return -value if math.isfinite(value) else 1e6

        ends = [
            minimize(
                loss,
                [start, 0.0],
                method="Nelder-Mead",
                options={"xatol": 0.02, "fatol": 1e-4, "maxiter": 60},
            )
            for start in (0.0, 2.0)
        ]
        return numpy.exp(min(ends, key=lambda end: float(end.fun)).x)


def own_error(gate: float, first: Recording, second: Recording) -> float:
    """Root mean square error of one's own filter on the second log, fitted to the first."""
    own, log = OwnFilter(gate), measured(second)
    values = own.fit(measured(first))
    _, estimates, errors = own.run(log, *values)
    if second.truth is not None:
        errors = estimates - second.truth[0, :, :2]
    return math.sqrt(float(numpy.nanmean((errors**2).sum(axis=1))))


def judge(first: Recording, second: Recording, folder: Path) -> list[str]:
    """Row of the table for one log."""
    problem = problem_of(ID)
    shipped = {name: find_competitor(problem, name) for name in causal_names(problem, first)}
    learned = pretrained_agents(problem.id)  # which the command compares only if it is asked to
    rivals = {name: maker for name, maker in shipped.items() if name not in learned}
    begun, verdict = time.process_time(), [math.nan]

    def progress(what: str, share: float) -> None:
        if what.startswith("First verdict"):
            verdict[0] = time.process_time() - begun

    advice = advise(
        FittedLog(problem, first), rivals, progress=progress, price_of=update_prices(problem, first)
    )
    used, name = time.process_time() - begun, advice.advised.name
    path = folder / "advised.filter.json"
    fitted = advice.fits[name] if advice.advised.fitted else None
    write_advised(path, problem, name, first, fitted, advice.intervals if fitted else {}, "")
    found = problem.evaluate({**shipped, "advised": find_competitor(problem, str(path))}, second, tracks=True)
    predictions = Predictions(found, make_task(problem.task, second))

    def error(each: str) -> float:
        if predictions.has_truth:
            squares = predictions.squared_error(each)
        else:
            errors = predictions.prediction_error(each)
            squares = numpy.full(1, math.nan) if errors is None else (errors**2).sum(axis=0)
        return math.sqrt(float(numpy.nanmean(squares)))

    best = min(shipped, key=lambda each: (math.isnan(error(each)), error(each)))
    return [
        f"{name}{' (fitted)' if fitted else ''}",
        f"{error('advised'):.4g}",
        f"{best} {error(best):.4g}",
        f"{own_error(math.inf, first, second):.4g}",
        f"{own_error(GATE, first, second):.4g}",
        "estimates" if predictions.has_truth else "predictions",
        f"{verdict[0]:.1f}",
        f"{used:.1f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="+", metavar="FIRST:SECOND")
    titles = (
        "log",
        "advised",
        "RMSE",
        "best shipped, in hindsight",
        "own",
        "own, gated",
        "of",
        "verdict, s",
        "end, s",
    )
    print("| " + " | ".join(titles) + " |")
    print("|" + "---|" * len(titles))
    for log in parser.parse_args().logs:
        first, second = (read_recording(path, ID, speeds=SPEEDS) for path in log.split(":"))
        with tempfile.TemporaryDirectory() as folder:
            cells = judge(first, second, Path(folder))
        print("| " + " | ".join([first.name, *cells]) + " |", flush=True)


if __name__ == "__main__":
    main()
