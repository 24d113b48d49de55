"""Parameters fitted to logs of known true parameters: their errors, coverage of intervals, gain of many starts.

Targets move by the family's own model: ``constant-velocity`` by white acceleration, constant in every interval;
``imm-two`` by two sizes of it, between which a Markov chain switches. Every fourth log is clean, has outliers (3 % of
the plots, 20 deviations away), is a third as long, or is irregular (intervals between a half and three halves).

The likelihood of an interacting multiple model is an approximation, which merges the histories of modes. So without
outliers fitted and true values of ``imm-two`` are also compared by the likelihood of the target's own model.

Example: python benchmarks/log_fits.py --logs 40 --measurements 300 --family imm-two --starts 20
"""

import argparse
import dataclasses
import math
import tempfile
from pathlib import Path

import numpy

from filtergym.baselines.advice import FittedLog, fit_all
from filtergym.baselines.fitted_filters import families_of
from filtergym.baselines.problem import problem_of
from filtergym.envs.data.recording import Recording
from filtergym.envs.logs.reading import read_recording

ID = "filtergym/ManeuveringTarget-v0"
SIGMA, STATED, T = 1.0, 0.5, 0.5
TRUE = {
    "constant-velocity": {"acceleration": 0.8},
    "imm-two": {"acceleration_quiet": 0.1, "ratio": 30.0, "leave_quiet": 0.03, "leave_noisy": 0.06},
}
KINDS = "clean", "outliers", "short", "irregular"
SEARCHED = "acceleration_quiet", "ratio", "leave_quiet", "leave_noisy", "noise_scale"
SEQUENCES = 100
"""Number of sequences of modes that remain from one measurement to the next."""


def accelerations(family: str, count: int, rng: numpy.random.Generator) -> numpy.ndarray:
    """Return the standard deviation of the acceleration in every interval, m/s^2, for a family of models."""
    true = TRUE[family]
    if family == "constant-velocity":
        return numpy.full(count, true["acceleration"])
    is_noisy, sizes = False, []
    for draw in rng.uniform(size=count):
        is_noisy ^= bool(draw < true["leave_noisy" if is_noisy else "leave_quiet"])
        sizes.append(true["acceleration_quiet"] * (true["ratio"] if is_noisy else 1.0))
    return numpy.array(sizes)


def simulated_log(folder: Path, family: str, measurements: int, seed: int) -> Recording:
    """Simulate a log of a family of models, write it to a file, and return the recording read from it."""
    rng, kind = numpy.random.default_rng(seed), KINDS[seed % len(KINDS)]
    count = measurements // 3 if kind == "short" else measurements
    steps = T * (rng.uniform(0.5, 1.5, count) if kind == "irregular" else numpy.ones(count))
    position, velocity = numpy.zeros((count, 2)), numpy.zeros((count, 2))
    velocity[0] = 3.0, -1.0
    sizes = accelerations(family, count, rng)
    for k in range(1, count):
        a = sizes[k] * rng.standard_normal(2)
        position[k] = position[k - 1] + steps[k] * velocity[k - 1] + 0.5 * steps[k] ** 2 * a
        velocity[k] = velocity[k - 1] + steps[k] * a
    plots = position + SIGMA * rng.standard_normal(position.shape)
    if kind == "outliers":
        wild = (rng.uniform(size=count) < 0.03) & (numpy.arange(count) > 2)
        plots[wild] += 20.0 * SIGMA * rng.standard_normal((int(wild.sum()), 2))
    time = numpy.cumsum(steps) - steps[0]
    columns = numpy.column_stack([time, plots, numpy.full_like(plots, STATED)])
    path = folder / f"{seed}.csv"
    numpy.savetxt(path, columns, "%.6f", ",", header="time,x,y,sigma_x,sigma_y", comments="")
    return read_recording(path, ID, speeds=(0.001, 1000.0))


def likelihood_of_sequences(recording: Recording, values: dict[str, float]) -> float:
    """Return the log-likelihood of a log without gaps under the switching model of ``imm-two``, nats.

    Each sequence of modes has a Kalman filter; the ``SEQUENCES`` likeliest stay and none are merged. With a ratio of
    one it is that of one Kalman filter.
    """
    quiet, ratio, leave_quiet, leave_noisy, scale = (10.0 ** values[f"log10_{name}"] for name in SEARCHED)
    sizes = numpy.array([quiet, quiet * ratio])
    transitions = numpy.log([[1.0 - leave_quiet, leave_quiet], [leave_noisy, 1.0 - leave_noisy]])
    measured = {name: values[0] for name, values in recording.measurements.items()}
    # Axes are independent: states (sequence, axis, 2) of position and velocity.
    m = numpy.repeat(recording.initial["mean"].reshape(1, 2, 2).swapaxes(1, 2), 2, axis=0)
    whole = recording.initial["covariance"][0] * scale**2
    P = numpy.stack([[whole[axis::2, axis::2] for axis in range(2)]] * 2)
    mode, weight, total = numpy.arange(2), numpy.log([0.5, 0.5]), 0.0
    for z, variance, interval in zip(
        measured["position"], measured["variance"], measured["interval"], strict=True
    ):
        F, G = numpy.array([[1.0, interval], [0.0, 1.0]]), numpy.array([0.5 * interval**2, interval])
        after = numpy.tile([0, 1], len(mode))
        weight = numpy.repeat(weight, 2) + transitions[numpy.repeat(mode, 2), after]
        m, P = numpy.repeat(m @ F.T, 2, axis=0), numpy.repeat(F @ P @ F.T, 2, axis=0)
        P = P + (sizes[after] ** 2)[:, None, None, None] * numpy.outer(G, G)
        S, residual = P[..., 0, 0] + scale**2 * variance, z - m[..., 0]
        weight = weight - 0.5 * (residual**2 / S + numpy.log(2.0 * math.pi * S)).sum(axis=1)
        total += numpy.logaddexp.reduce(weight)
        K = P[..., 0] / S[..., None]
        m, P = m + K * residual[..., None], P - K[..., None] * P[..., None, 0, :]
        kept = numpy.argsort(-weight)[:SEQUENCES]
        m, P, mode, weight = m[kept], P[kept], after[kept], weight[kept]
        weight = weight - numpy.logaddexp.reduce(weight)  # the dropped ones have nearly the same predictions
    return float(total)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=int, default=20)
    parser.add_argument("--measurements", type=int, default=300)
    parser.add_argument("--family", choices=sorted(TRUE), default="constant-velocity")
    parser.add_argument(
        "--starts", type=int, default=0, help="compare with the best of this number of starts"
    )
    args = parser.parse_args()
    problem = problem_of(ID)
    true = {f"log10_{name}": math.log10(value) for name, value in TRUE[args.family].items()}
    true["log10_noise_scale"] = math.log10(SIGMA / STATED)
    errors, inside, widths = ({name: [] for name in true} for _ in range(3))
    below, likelier = [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(args.logs):
            recording = simulated_log(Path(folder), args.family, args.measurements, seed)
            family = families_of(problem, recording)[args.family]
            _, found, intervals = fit_all(FittedLog(problem, recording), family)
            others = [found.log_likelihood]
            for start in range(1, args.starts):
                rng = numpy.random.default_rng(1000 + start)
                begin = {name: rng.uniform(low, high) for name, (low, high) in family.limits.items()}
                other = dataclasses.replace(family, start=begin)
                others.append(fit_all(FittedLog(problem, recording, seed=start), other)[1].log_likelihood)
            below.append(max(others) - others[0])
            if args.family == "imm-two" and KINDS[seed % len(KINDS)] != "outliers":
                both = (likelihood_of_sequences(recording, values) for values in (true, found.values))
                likelier.append(next(both) - next(both))
            for name, value in true.items():
                errors[name].append(found.values[name] - value)
                inside[name].append(intervals[name].low <= value <= intervals[name].high)
                widths[name].append(10.0 ** (intervals[name].high - intervals[name].low))
    print(
        "| parameter | bias, % | its standard error, % | intervals that hold | median ratio of their ends |"
    )
    print("|---|---|---|---|---|")
    for name, off in errors.items():
        factor = math.log(10.0) * 100.0
        bias, error = factor * numpy.mean(off), factor * numpy.std(off, ddof=1) / math.sqrt(len(off))
        print(
            f"| {name.removeprefix('log10_').replace('_', ' ')} | {bias:+.1f} | {error:.1f} | "
            f"{sum(inside[name])} of {len(off)} | {numpy.median(widths[name]):.2f} |"
        )
    if likelier:
        print(
            f"by the likelihood of sequences the true values are likelier than the fitted ones in "
            f"{sum(nats > 0.0 for nats in likelier)} of {len(likelier)} logs without outliers, by "
            f"{numpy.mean(likelier):.1f} nats in the mean"
        )
    if args.starts:
        most, mean = max(below), numpy.mean(below)
        print(f"nats below the best of {args.starts} starts: {most:.2f} at most, {mean:.2f} in the mean")


if __name__ == "__main__":
    main()
