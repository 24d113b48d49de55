"""Parameters fitted to logs whose true parameters are known: how far off they are, and how often their intervals hold.

Targets of white acceleration, constant in every interval, are fitted by a Kalman filter of constant velocity together
with the scale of the stated noise.

Example: python benchmarks/log_fits.py --logs 20 --measurements 300
"""

import argparse
import math
import tempfile
from pathlib import Path

import numpy
from filtergym.baselines.advice import fit_all
from filtergym.baselines.fitted_filters import families_of
from filtergym.baselines.problem import problem_of
from filtergym.envs.data.recording import Recording
from filtergym.envs.engine.scenario_choice import read_recording

ID = "filtergym/ManeuveringTarget-v0"
ACCELERATION, SIGMA, STATED, T = 0.8, 1.0, 0.5, 0.5


def simulated_log(folder: Path, measurements: int, seed: int) -> Recording:
    """Write a log, and read it."""
    rng = numpy.random.default_rng(seed)
    position, velocity = numpy.zeros((measurements, 2)), numpy.zeros((measurements, 2))
    velocity[0] = 3.0, -1.0
    for k in range(1, measurements):
        a = ACCELERATION * rng.standard_normal(2)
        position[k] = position[k - 1] + T * velocity[k - 1] + 0.5 * T**2 * a
        velocity[k] = velocity[k - 1] + T * a
    plots = position + SIGMA * rng.standard_normal(position.shape)
    columns = numpy.column_stack([T * numpy.arange(measurements), plots, numpy.full_like(plots, STATED)])
    path = folder / f"{seed}.csv"
    numpy.savetxt(path, columns, "%.6f", ",", header="time,x,y,sigma_x,sigma_y", comments="")
    return read_recording(path, ID, speeds=(0.001, 1000.0))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=int, default=20)
    parser.add_argument("--measurements", type=int, default=300)
    parser.add_argument("--family", default="constant-velocity")
    asked = parser.parse_args()
    problem = problem_of(ID)
    true = {
        "log10_acceleration": math.log10(ACCELERATION),
        "log10_noise_scale": math.log10(SIGMA / STATED),
    }
    errors, inside, widths = ({name: [] for name in true} for _ in range(3))
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(asked.logs):
            recording = simulated_log(Path(folder), asked.measurements, seed)
            family = families_of(problem, recording)[asked.family]
            _, found, intervals = fit_all(problem, recording, family)
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


if __name__ == "__main__":
    main()
