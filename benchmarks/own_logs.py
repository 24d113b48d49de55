"""Five machines with a log each: our filters fitted to it, and a filter of filterpy with Q and R set by hand.

python benchmarks/own_logs.py

The machines and their models are docs/examples/own_logs. A filter that is fitted to one log is evaluated on ten others.
The limit is our filter with those factors on Q and R that have the least error on these ten.
"""

import argparse
import importlib
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter

from filtergym import read_recording
from filtergym.baselines.fitted_filters import families_of
from filtergym.baselines.fitting import fit
from filtergym.baselines.problem import problem_of
from filtergym.baselines.state_space import Extended
from filtergym.baselines.table import Variant, without_logarithms
from filtergym.envs.contract.filter import FilterInput
from filtergym.envs.engine.backend import make_model
from filtergym.evaluation.competitors.likelihood import Span, WindowLikelihood, cut_windows
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.papers.grid import markdown_table

EXAMPLES = Path(__file__).parent.parent / "docs" / "examples" / "own_logs"
LATE = 0.15
"""Delay of the camera, s."""
COLUMNS = ("machine", "filter", "RMSE", "of filterpy's", "factors", "processor time, s")
CANDIDATES = 40
"""Candidate factors for the limit, refined three times around the best."""


# --- filters of filterpy, which read rows of a log by column


def gps_odometry(log: dict[str, np.ndarray]) -> np.ndarray:
    """Return filterpy's positions from GPS (3 m) and odometry (0.2 m/s); Q by hand: acceleration 2 m/s^2."""
    kf, last = KalmanFilter(4, 2), 0.0
    kf.x, kf.P, found = np.zeros(4), np.diag([100.0, 100, 25, 25]), []
    columns = ("time", "gps_x", "gps_y", "odometry_x", "odometry_y")
    for t, x, y, vx, vy in zip(*(log[name] for name in columns), strict=True):
        dt, last = t - last, t
        kf.F = np.eye(4) + dt * np.eye(4, k=2)
        kf.Q = 4.0 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        kf.predict()
        if np.isfinite(x):
            kf.update([x, y], 9.0 * np.eye(2), np.eye(2, 4))
        if np.isfinite(vx):
            kf.update([vx, vy], 0.04 * np.eye(2), np.eye(2, 4, k=2))
        found.append(kf.x[:2].copy())
    return np.array(found)


def level_gauge(log: dict[str, np.ndarray]) -> np.ndarray:
    """Return filterpy's levels from gauge (2 cm) and stick (1 cm); by hand: rate 0.02 m/h, drift 5 cm a day."""
    kf, last = KalmanFilter(3, 1), 0.0
    kf.x, kf.P, found = np.array([10.0, 0, 0]), np.diag([0.01, 0.0025, 0.0025]), []
    for t, gauge, stick in zip(log["time"] / 3600, log["gauge"], log["stick"], strict=True):
        dt, last = t - last, t
        kf.F = np.array([[1, dt, 0], [0, 1, 0], [0, 0, 1]])
        kf.Q = np.zeros((3, 3))
        kf.Q[:2, :2] = 0.02**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        kf.Q[2, 2] = 0.05**2 / 24 * dt
        kf.predict()
        for z, H, R in ((gauge, [[1, 0, 1]], 0.02**2), (stick, [[1, 0, 0]], 0.01**2)):
            if np.isfinite(z):
                kf.update(z, R, np.array(H, float))
        found.append(kf.x[:1].copy())
    return np.array(found)


def pitch_roll(log: dict[str, np.ndarray]) -> np.ndarray:
    """Return filterpy's roll and pitch; by hand: gyroscope 0.02 rad/s, accelerometer 0.1 rad."""
    kf, last = ExtendedKalmanFilter(4, 2), 0.0
    kf.x, kf.P, found = np.zeros(4), np.diag([0.01, 0.01, 0.0025, 0.0025]), []
    rows = zip(*(log[n] for n in ("time", "gyro_p", "gyro_q", "roll_angle", "pitch_angle")), strict=True)
    for t, p, q, roll, pitch in rows:
        dt, last = t - last, t
        (a, b, c, d), sin, cos = kf.x, np.sin(kf.x[0]), np.cos(kf.x[0])
        kf.F = np.eye(4) + dt * np.array([
            [(q - d) * cos * np.tan(b), (q - d) * sin / np.cos(b) ** 2, -1, -sin * np.tan(b)],
            [-(q - d) * sin, 0, 0, -cos], [0, 0, 0, 0], [0, 0, 0, 0]])  # fmt: skip
        kf.x = np.array([a + dt * (p - c + (q - d) * sin * np.tan(b)), b + dt * (q - d) * cos, c, d])
        kf.P = kf.F @ kf.P @ kf.F.T + np.diag([4e-4 * dt**2 + 1e-4 * dt] * 2 + [1e-5 * dt] * 2)
        wrapped = lambda z, h: (z - h + np.pi) % (2 * np.pi) - np.pi  # noqa: E731
        z = np.array([roll, pitch])
        kf.update(z, lambda _: np.eye(2, 4), lambda s: s[:2], R=0.01 * np.eye(2), residual=wrapped)
        found.append(kf.x[:2].copy())
    return np.array(found)


def battery(log: dict[str, np.ndarray]) -> np.ndarray:
    """Return filterpy's charge from current (50 mA) and voltage (10 mV); Q by hand: 0.1 % and 1 mV a minute."""
    kf, last = ExtendedKalmanFilter(2, 1), 0.0
    kf.x, kf.P, found = np.array([0.8, 0]), np.diag([0.01, 1e-4]), []
    slope = lambda s: np.array([[0.9 - 1.2 * s[0] + 1.65 * s[0] ** 2, -1.0]])  # noqa: E731
    curve = lambda s, u: np.array([3.3 + 0.9 * s[0] - 0.6 * s[0] ** 2 + 0.55 * s[0] ** 3 - s[1] - 0.02 * u])  # noqa: E731
    for t, current, voltage in zip(log["time"], log["current"], log["voltage"], strict=True):
        dt, last = t - last, t
        kept = np.exp(-dt / 40)
        kf.F, G = np.diag([1, kept]), np.array([-dt / 9000, 0.025 * (1 - kept)])
        kf.x = kf.F @ kf.x + G * current
        kf.P = kf.F @ kf.P @ kf.F.T + 0.05**2 * np.outer(G, G) + np.diag([1e-6, 1e-6]) * dt / 60
        kf.update(np.array([voltage]), slope, curve, R=np.array([[1e-4]]), hx_args=(current,))
        found.append(kf.x[:1].copy())
    return np.array(found)


def late_vision(log: dict[str, np.ndarray]) -> np.ndarray:
    """Return filterpy's position from a camera (2 cm) and an accelerometer (0.1 m/s^2).

    A late fix is moved on by the velocity times its delay.
    """
    kf, dt, late = KalmanFilter(3, 1, 1), 0.01, round(LATE / 0.01)
    kf.x, kf.P, found = np.zeros(3), np.diag([0.01, 0.1, 0.04]), []
    kf.F, kf.B = np.array([[1, dt, -(dt**2) / 2], [0, 1, -dt], [0, 0, 1]]), np.array([dt**2 / 2, dt, 0])
    kf.Q, kf.R, kf.H = np.diag([0, 2e-4, 1e-5]), np.array([[4e-4]]), np.array([[1.0, 0, 0]])
    camera = np.concatenate([np.full(late, np.nan), log["camera"][:-late]])
    for acceleration, fix in zip(log["acceleration"], camera, strict=True):
        kf.x = kf.F @ kf.x + kf.B * acceleration
        kf.P = kf.F @ kf.P @ kf.F.T + kf.Q
        if np.isfinite(fix):
            kf.update(fix + LATE * kf.x[1])
        found.append(kf.x[:1].copy())
    return np.array(found)


BY_HAND = {one.__name__: one for one in (gps_odometry, level_gauge, pitch_roll, battery, late_vision)}


# --- ours


def errors(task: Any, recording: Any, factors: dict[str, np.ndarray]) -> np.ndarray:
    """Return our filter's RMSE for every candidate of the factors on Q and R, and every episode, ``(C, E)``."""
    episodes = len(recording.rows)
    spans = [Span(number, 0, int(rows)) for number, rows in enumerate(recording.rows)]
    windows = cut_windows(recording, task, spans, 0)
    count = len(next(iter(factors.values())))
    lanes = lambda array: np.repeat(array[..., None, :], count, -2).reshape(*array.shape[:-1], -1)  # noqa: E731
    tile = lambda part: type(part)(*(None if a is None else lanes(a) for a in part))  # noqa: E731
    own = Extended(task, **{name: np.repeat(values, episodes) for name, values in factors.items()})
    state, total = own.start(tile(windows.initial)), 0.0
    counts = [i for i, weight in enumerate(task.definition.weights) if weight]
    for k in range(len(windows.counts)):
        state = own.update(state, FilterInput(tile(windows.measurement(k))))
        truth = recording.truth[:, min(k, recording.truth.shape[1] - 1), counts].T
        squares = ((own.mean(state)[counts] - lanes(truth)) ** 2).sum(axis=0)
        total = total + np.where(k < np.tile(recording.rows, count), squares, 0.0)
    return np.sqrt(total.reshape(count, episodes) / recording.rows)


def least_error_factors(task: Any, recording: Any, names: list[str]) -> dict[str, float]:
    """Return the factors on Q and R of least error on a recording, by random search, by name."""
    rng, best, width = np.random.default_rng(0), np.zeros(len(names)), 2.0
    for _ in range(3):
        tried = best + width * rng.uniform(-1.0, 1.0, (CANDIDATES, len(names)))
        factors = {name: 10.0**column for name, column in zip(names, tried.T, strict=True)}
        best, width = tried[np.log(errors(task, recording, factors)).mean(axis=1).argmin()], width / 3.0
    return dict(zip(names, (10.0**best).tolist(), strict=True))


def follow_late(module: Any, logs: list[dict[str, np.ndarray]], factors: dict[str, float]) -> np.ndarray:
    """Return our filter's RMSE on each log, ``(E,)``, where fixes come late."""
    found = []
    for log in logs:
        seen = np.isfinite(log["camera"])
        fixes = zip(log["time"][seen], log["time"][seen] + LATE - 1e-6, log["camera"][seen], strict=True)
        imu = zip(log["time"], log["acceleration"], strict=True)
        mean = module.follow(Variant(Extended, "", **factors), imu, fixes)
        found.append(np.sqrt(np.mean((mean[:, 0] - log["truth_position"]) ** 2)))
    return np.array(found)


def processor_time(name: str, folder: Path) -> float:
    """Return the processor seconds of fit, evaluation and export of a filter for one of the machines."""
    machine, filter, before = f"{name}:{problem_id(name)}", folder / "fitted.filter.json", children_time()
    for words in (
        ["advise", folder / f"{name}.csv", "--environment", machine, "--out", filter],
        [
            "evaluate",
            machine,
            "--recording",
            folder / f"{name}_judged.csv",
            "--policy",
            filter,
            "--policy",
            "kalman",
        ],
        ["export", machine, filter, "--to", "c", "--out", folder / f"{name}_c"],
    ):
        command = [sys.executable, "-m", "filtergym", *map(str, words)]
        subprocess.run(
            command, cwd=EXAMPLES, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=True, capture_output=True
        )
    return children_time() - before


def children_time() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def problem_id(name: str) -> str:
    module = importlib.import_module(name)
    return next(cls.id for cls in vars(module).values() if hasattr(cls, "definition"))


def read_logs(file: Path) -> list[dict[str, np.ndarray]]:
    table = np.genfromtxt(file, delimiter=",", names=True)
    return [
        {name: table[name][table["recording"] == number] for name in table.dtype.names}
        for number in np.unique(table["recording"])
    ]


def compare(name: str, folder: Path) -> list[list[str]]:
    module = importlib.import_module(name)
    problem = problem_of(problem_id(name))
    log, judged = (read_recording(folder / f"{name}{part}.csv", problem.id) for part in ("", "_judged"))
    tunable = families_of(problem, log)["extended"]
    own = make_model(problem.task, backend="numpy", **log.parameters).task
    windows = cut_windows(log, own, [Span(0, 0, int(log.rows[0]))], 0)
    likelihood = WindowLikelihood(own, windows, tunable.start, tunable.apply, tunable.in_lanes)
    fitted = without_logarithms(fit(likelihood, tunable, starts=1).values)
    names = [each.removeprefix("log10_") for each in tunable.limits]
    task = make_model(problem.task, backend="numpy", **judged.parameters).task
    logs = read_logs(folder / f"{name}_judged.csv")
    counts = [i for i, weight in enumerate(task.definition.weights) if weight]
    truth = [f"truth_{task.components[i].name.lower()}" for i in counts]
    by_hand = [BY_HAND[name](one) - np.stack([one[column] for column in truth], axis=1) for one in logs]
    found = {"filterpy, set by hand": np.sqrt([(each**2).sum(axis=1).mean() for each in by_hand])}
    several = {
        "as written": dict.fromkeys(names, 1.0),
        "fitted": fitted,
        "limit": least_error_factors(task, judged, names),
    }
    for who, factors in several.items():
        if name == "late_vision":
            found[who] = follow_late(module, logs, factors)
        else:
            found[who] = errors(task, judged, {key: np.array([value]) for key, value in factors.items()})[0]
    rows, rival = [], np.log(found["filterpy, set by hand"])
    for who, each in found.items():
        bootstrap = Bootstrap(len(each))
        ratio = bootstrap.interval(np.exp(bootstrap.means((np.log(each) - rival)[:, None])[:, 0]))
        less = "" if who.startswith("filterpy") else f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"
        shown = several.get(who, {})
        noises = ", ".join(f"{key.removesuffix('_noise')} {value:.3g}" for key, value in shown.items())
        time = f"{processor_time(name, folder):.0f}" if who == "fitted" else ""
        rows.append([name.replace("_", " "), who, f"{np.sqrt(np.mean(each**2)):.4g}", less, noises, time])
        print(" ".join(rows[-1]), file=sys.stderr, flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=sorted(BY_HAND))
    options = parser.parse_args()
    sys.path.insert(0, str(EXAMPLES))
    make_logs = importlib.import_module("make_logs")
    with tempfile.TemporaryDirectory() as folder:
        names = [options.only] if options.only else list(BY_HAND)
        make_logs.write_logs(Path(folder), names)
        rows = [row for name in names for row in compare(name, Path(folder))]
    print("\n".join(markdown_table(COLUMNS, rows)))


if __name__ == "__main__":
    main()
