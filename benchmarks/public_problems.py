"""Published problems as environments: KalmanNet's linear and Lorenz problems, and NCLT's drives.

    git clone https://github.com/KalmanNet/KalmanNet_TSP
    git clone https://github.com/SongJgit/filternet
    python benchmarks/public_problems.py --kalmannet KalmanNet_TSP --filternet filternet --runs runs/public

It tunes, trains and evaluates, and writes the records ``public_problems`` and ``public_drives``; agents and tuned
values of an earlier call in ``--runs`` are used unchanged. No code of these repositories is imported, and only figures
of them are stored; tensors are read with ``torch.load(weights_only=True)``.

Tuning and training use simulated episodes of the training split alone (NCLT: the two validation drives). Filters are
evaluated on the stored test sets, or on simulated episodes of the test split.
"""

import argparse
import datetime
import json
import math
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy

import filtergym
from filtergym import Sensor
from filtergym.baselines.problem import problem_of
from filtergym.baselines.state_space import Extended
from filtergym.baselines.table import Variant
from filtergym.baselines.tuned_values import make_tuned_policy
from filtergym.baselines.tuning import Search, tune
from filtergym.envs.data.recording import Recording
from filtergym.envs.engine.catalogue import short_name
from filtergym.evaluation.statistics.bootstrap import Bootstrap

MODULE = Path(__file__).stem
ALGORITHMS = {"kalman-net": (), "bptt": ("--control", "noise"), "ppo": ("--control", "noise")}
"""Learned filters, and further options of their training."""
SEEDS = 3
"""Training runs of each learned filter."""
TEST_EPISODES = 1000
"""Test episodes of simulated problems."""
TUNING_BUDGET = 2_000_000
"""Budget of the search of two scales, in measurements."""

# --- linear, two states: main_linear_canonical.py and its parameters

ROTATION = math.radians(10.0)
COSINE, SINE = math.cos(ROTATION), math.sin(ROTATION)
TURN = numpy.array([[COSINE, -SINE], [SINE, COSINE]])
F, H = numpy.array([[1.0, 1.0], [0.0, 1.0]]), numpy.eye(2)
LINEAR: dict[str, Any] = {
    "f": F,
    "h": H,
    "Q": 0.01 * numpy.eye(2),
    "R": numpy.eye(2),
    "mean": [0.0, 0.0],
    "covariance": numpy.zeros((2, 2)),
    "horizon": 100,
}
"""q^2 / r^2 of -20 dB, r^2 = 1; every track starts at zero."""
Linear = filtergym.state_space("public/Linear-v0", **LINEAR)
LinearRotatedF = filtergym.state_space(
    "public/LinearRotatedF-v0",
    **LINEAR,
    filter_model={"f": F @ TURN},
    hypotheses=[{"Q": numpy.eye(2)}],
    switching=False,
)
LinearRotatedH = filtergym.state_space(
    "public/LinearRotatedH-v0",
    **LINEAR,
    filter_model={"h": H @ TURN},
    hypotheses=[{"Q": numpy.eye(2)}],
    switching=False,
)

# --- Lorenz attractor: main_lor_DT.py, main_lor_decimation.py and their parameters

INTERVAL = 0.02


def taylor(x: Any, order: int) -> list[Any]:
    """Return KalmanNet's Lorenz transition: the Taylor series of ``exp(A(x) T)`` to some order, times the state."""
    answer, term = list(x), list(x)
    for j in range(1, order + 1):
        term = [entry * (INTERVAL / j) for entry in _product(x, term)]
        answer = [a + b for a, b in zip(answer, term, strict=True)]
    return answer


def _product(x: Any, y: Sequence[Any]) -> list[Any]:
    """Return ``A(x) y`` of the Lorenz attractor; with y = x the derivative of the state."""
    return [10.0 * (y[1] - y[0]), 28.0 * y[0] - y[1] - x[2] * y[0], x[1] * y[0] - (8.0 / 3.0) * y[2]]


def flow(x: Any, steps: int = 4) -> list[Any]:
    """Return the Lorenz attractor's state after an interval, by fourth-order Runge-Kutta steps."""
    T, state = INTERVAL / steps, list(x)

    def ahead(slope: Sequence[Any], share: float) -> list[Any]:
        return [s + share * T * k for s, k in zip(state, slope, strict=True)]

    for _ in range(steps):
        k1 = _product(state, state)
        k2 = _product(ahead(k1, 0.5), ahead(k1, 0.5))
        k3 = _product(ahead(k2, 0.5), ahead(k2, 0.5))
        k4 = _product(ahead(k3, 1.0), ahead(k3, 1.0))
        slopes = [(a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)]
        state = ahead(slopes, 1.0)
    return state


def order_five(x: Any) -> list[Any]:
    """Return the state after an interval by the series of order five, as in the simulation."""
    return taylor(x, 5)


def order_two(x: Any) -> list[Any]:
    """Return the state after an interval by the series of order two, a filter's approximation."""
    return taylor(x, 2)


LORENZ: dict[str, Any] = {"h": numpy.eye(3), "names": ["x", "y", "z"], "sampling_interval": INTERVAL}
LorenzOrderTwo = filtergym.state_space(
    "public/LorenzOrderTwo-v0",
    **LORENZ,
    f=order_five,
    Q=0.001 * numpy.eye(3),
    R=0.1 * numpy.eye(3),
    mean=numpy.ones(3),
    covariance=numpy.zeros((3, 3)),
    filter_model={"f": order_two},
    hypotheses=[{"Q": 0.1 * numpy.eye(3)}],
    switching=False,
    horizon=100,
)
"""q^2 / r^2 of -20 dB, r^2 = 0.1, J = 5 in the world and 2 in the filters; every track starts at (1, 1, 1)."""
DECIMATED: dict[str, Any] = {
    "f": flow,
    "Q": 1e-6 * numpy.eye(3),
    "R": numpy.eye(3),
    "mean": numpy.ones(3),
    "covariance": numpy.eye(3),
    "switching": False,
    "horizon": 500,
}
"""r^2 = 1. KalmanNet's world has no process noise; a small one here keeps the reference's covariance definite. The
filters' Q is KalmanNet's, 0.3873^2.
"""
LorenzDecimated = filtergym.state_space(
    "public/LorenzDecimated-v0",
    **LORENZ,
    **DECIMATED,
    filter_model={"f": order_five, "Q": 0.15 * numpy.eye(3)},
)

# --- NCLT

STATES = ("x", "y", "speed", "heading", "rate", "error")
"""North and east (m), speed (m/s), heading (rad), its rate (rad/s), and the offset of the compass from it (rad)."""
WHEEL_SCALE = 1.075
"""Speed by the wheels over that of the truth, in both validation drives."""


def drive(x: Any) -> list[Any]:
    """Return the segway's state after a second of motion along its heading."""
    middle = x[3] + 0.5 * x[4]
    return [
        x[0] + x[2] * numpy.cos(middle),
        x[1] + x[2] * numpy.sin(middle),
        x[2],
        x[3] + x[4],
        x[4],
        x[5],
    ]


Drives = filtergym.state_space(
    "public/Drives-v0",
    f=drive,
    # Deviations in a second: beyond the model 0.1 m; speed and rate may change freely; of the compass 1 mrad.
    Q={
        "slip": numpy.diag([0.1, 0.1, 0.0, 0.0, 0.0, 0.0]) ** 2,
        "motion": numpy.diag([0.0, 0.0, 0.5, 0.01, 0.3, 0.0]) ** 2,
        "magnetism": numpy.diag([0.0, 0.0, 0.0, 0.0, 0.0, 0.001]) ** 2,
    },
    sensors={
        "receiver": Sensor(numpy.eye(2, 6), numpy.eye(2), names=("x", "y")),
        "wheels": Sensor([[0.0, 0.0, WHEEL_SCALE, 0.0, 0.0, 0.0]], 0.1**2, units=("m/s",)),
        "compass": Sensor([[0.0, 0.0, 0.0, 1.0, 0.0, 1.0]], 0.05**2, wraps="rad"),
        "gyroscope": Sensor([[0.0, 0.0, 0.0, 0.0, 1.0, 0.0]], 0.05**2, units=("rad/s",)),
    },
    mean=[76.5, 108.3, 0.0, 0.0, 0.0, 0.0],
    covariance=numpy.diag([1.0, 1.0, 0.01, 0.01, 0.01, 0.01]),
    names=STATES,
    units=["m", "m", "m/s", "rad", "rad/s", "rad"],
    weights=[0.5, 0.5, 0.0, 0.0, 0.0, 0.0],
    horizon=4000,
)
"""Wheels, compass, gyroscope and receiver of a segway, once a second."""
TUNED = ("receiver_noise", "slip_noise", "magnetism_noise", "compass_noise")
"""Factors on R and Q that are tuned."""
STARTS = ([2.0, 0.0, 0.0, 0.6], [3.0, 0.0, 2.0, 2.0])
"""Starts of the search, as decimal logarithms."""


class WithNoises(Extended):
    """The Kalman filter with constant Q and R in place of the model's."""

    def __init__(self, task: Any, Q: numpy.ndarray, R: numpy.ndarray) -> None:
        super().__init__(task)
        self.Q, self.R = (task.constant(noise)[:, :, None] for noise in (Q, R))

    def process_noise(self, mean: Any, measurement: Any) -> Any:
        """Return the constant Q for any state and measurement."""
        return self.Q

    def sensor_noise(self, mean: Any, measurement: Any) -> Any:
        """Return the constant R for any state and measurement."""
        return self.R


def with_noises(Q: numpy.ndarray, R: numpy.ndarray) -> Any:
    """Return a factory of Kalman filters with constant Q and R."""

    def make(task: Any) -> WithNoises:
        return WithNoises(task, Q, R)

    make.kind, make.traceable = "estimator", True  # type: ignore[attr-defined]
    return make


# --- stored sets


def read_tensors(file: Path) -> Any:
    import torch

    return torch.load(file, weights_only=True, map_location="cpu")


def stored_linear(folder: Path, id: str) -> Recording:
    """Return KalmanNet's stored test set of the linear problem as a recording: 200 tracks of 100 measurements."""
    stored = read_tensors(folder / "Simulations/Linear_canonical/data/2x2_rq020_T100.pt")
    z, truth = (part.double().numpy().swapaxes(1, 2) for part in stored[4:6])
    episodes, times, _ = z.shape
    return Recording(
        environment=id,
        measurements={"values": z, "available": numpy.ones_like(z)},
        initial={"mean": numpy.zeros((episodes, 2)), "covariance": numpy.zeros((episodes, 2, 2))},
        seconds=numpy.tile(numpy.arange(1.0, times + 1.0), (episodes, 1)),
        lengths=numpy.full(episodes, times),
        truth=truth,
        name="2x2_rq020_T100",
        source="https://github.com/KalmanNet/KalmanNet_TSP",
    )


def stored_drives(folder: Path, name: str) -> tuple[Recording, dict[str, float]]:
    """Return the drives of filternet's NCLT problem, and the RMSE a coordinate of the receiver alone.

    Where the receiver has no fix, its last position is used.
    """
    drives = [
        {key: value.numpy() if hasattr(value, "numpy") else value for key, value in one.items()}
        for one in read_tensors(folder / f"data/nclt_fusion/{name}.pt")
    ]
    times = max(len(one["gps"]) for one in drives)
    values, there = (numpy.zeros((len(drives), times, 5)) for _ in range(2))
    truth = numpy.full((len(drives), times, len(STATES)), math.nan)
    seconds = numpy.full((len(drives), times), math.nan)
    means = numpy.zeros((len(drives), 6))
    held = {}
    for i, one in enumerate(drives):
        rows = len(one["gps"])
        # A row contains the readings of wheels, compass and gyroscope at the row before.
        now = numpy.minimum(numpy.arange(rows) + 1, rows - 1)
        left, right, compass, rate = one["wheel"][now].T
        table = numpy.column_stack([one["filtered_gps"], 0.5 * (left + right), compass, rate])
        there[i, :rows] = numpy.isfinite(table)
        values[i, :rows] = numpy.nan_to_num(table)
        truth[i, :rows, :2] = one["ground_truth"]
        seconds[i, :rows] = numpy.arange(1.0, rows + 1.0)
        start = one["initial_state"]
        means[i] = [start[0], start[1], 0.0, start[4], 0.0, 0.0]
        held[one["data_date"]] = float(numpy.sqrt(((one["gps"] - one["ground_truth"]) ** 2).mean()))
    recording = Recording(
        environment=Drives.id,
        measurements={"values": values, "available": there},
        initial={
            "mean": means,
            "covariance": numpy.tile(Drives.definition.covariance, (len(drives), 1, 1)),
        },
        seconds=seconds,
        lengths=numpy.isfinite(seconds).sum(axis=1),
        truth=truth,
        names=tuple(one["data_date"] for one in drives),
        name=f"nclt_{name}",
        source="https://github.com/SongJgit/filternet, from the NCLT data set",
    )
    return recording, held


# --- tuning, training, judging


class Row(NamedTuple):
    """Result of a filter on a problem: mean squared error, ANEES and time."""

    problem: str
    name: str
    kind: str
    mse_db: float
    low_db: float
    high_db: float
    """Ends of the 95 % bootstrap interval over episodes; NaN of a few drives."""
    anees: float
    nanoseconds: float
    seeds: int
    """Number of training runs; one for an untrained filter."""
    spread_db: float
    """Difference from the best run to the worst, dB."""


def decibels(values: Any) -> Any:
    return 10.0 * numpy.log10(values)


def tune_scales(id: str, name: str, runs: Path) -> Any:
    """Return an estimator with scales of Q and R tuned on training episodes, or stored in ``runs``."""
    problem, file = problem_of(id), runs / f"{short_name(id)}.{name}.tuned.json"
    if not file.exists():
        found = tune(problem, name, Search(TUNING_BUDGET, episodes=128))
        file.write_text(json.dumps(found.values), encoding="utf-8")
        print(f"{id} {name}: {found.untuned_cost:.4g} -> {found.cost:.4g}, {found.values}", flush=True)
    values = json.loads(file.read_text(encoding="utf-8"))
    return make_tuned_policy(f"{id} {name}", problem.baselines.tunable[name], values)


def train(id: str, algorithm: str, steps: int, seed: int, runs: Path) -> str:
    folder = runs / f"{short_name(id)}.{algorithm}.{seed}"
    if not (folder / "best").exists():
        words = ["train", f"{MODULE}:{id}", "--algo", algorithm, "--steps", str(steps), "--seed", str(seed)]
        words += ["--out", str(folder.absolute()), "--no-compare", *ALGORITHMS[algorithm]]
        done = subprocess.run(
            [sys.executable, "-m", "filtergym", *words],
            cwd=Path(__file__).parent,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise SystemExit(f"{' '.join(words)}\n{done.stderr}")
        print(f"trained {folder.name}", flush=True)
    return str(folder.absolute())


def judge(
    problem: str, id: str, competitors: Mapping[str, Any], scenario: Any = None, timed: bool = True
) -> list[Row]:
    """Run filters over the test episodes or a recording, and return a row of results for each.

    Training runs called NAME/SEED share a row.
    """
    dataset = filtergym.evaluate(id, dict(competitors), scenario, episodes=TEST_EPISODES, timed=timed)
    cost = dataset.cost.mean("time")
    bootstrap = Bootstrap(dataset.sizes["episode"])
    rows = []
    groups: dict[str, list[str]] = {}
    for name in competitors:
        groups.setdefault(name.partition("/")[0], []).append(name)
    degrees = float(len(dataset.component))
    for group, names in groups.items():
        each = cost.sel(policy=names)
        # Runs share their episodes: the mean over runs is resampled by episode.
        interval = bootstrap.estimate(each.mean("policy").values, decibels)
        runs = decibels(each.mean("episode").values)
        first = dataset.sel(policy=names[0])
        anees = float(dataset.nees.sel(policy=names).mean()) / degrees
        time = float(dataset.nanoseconds.sel(policy=names).mean()) if timed else math.nan
        numbers = [*interval, anees, time]
        numbers = [round(float(number), 4) for number in numbers]
        rows.append(
            Row(
                problem, group, str(first.kind.item()), *numbers, len(names), round(float(numpy.ptp(runs)), 4)
            )
        )
        print(rows[-1], flush=True)
    return rows


class Problem(NamedTuple):
    """A problem of a state-space model: scales of Q to try, and its stored test set, if any."""

    name: str
    id: str
    scales: tuple[float, ...] = ()
    """Factors on Q that are shown in addition to the tuned ones."""
    recording: Recording | None = None
    """A stored test set; None: simulated test episodes."""


def competitors_of(problem: Problem, agents: Mapping[str, Sequence[str]], runs: Path) -> dict[str, Any]:
    """Return the filters of a problem by name: the model's own, tuned and trained."""
    known = problem_of(problem.id).baselines
    untuned = ["extended", *(name for name in ("unscented", "kalman-imm") if name in known.estimators)]
    competitors: dict[str, Any] = {name: name for name in (*untuned, "covariance-matching")}
    for scale in problem.scales:
        competitors[f"extended, Q x {scale:g}"] = Variant(Extended, process_noise=scale)
    competitors |= {f"{name}, tuned": tune_scales(problem.id, name, runs) for name in untuned}
    for algorithm, folders in agents.items():
        competitors |= {f"{algorithm}/{seed}": Path(folder) for seed, folder in enumerate(folders)}
    return competitors if problem.recording else {**competitors, "known-model": "known-model"}


def tune_drives(recording: Recording) -> dict[str, float]:
    from scipy.optimize import minimize

    def cost(logarithms: numpy.ndarray) -> float:
        factors = dict(zip(TUNED, (10.0**logarithms).tolist(), strict=True))
        found = filtergym.evaluate(Drives.id, {"candidate": Variant(Extended, **factors)}, recording)
        return math.log(float(found.cost.mean("time").mean()))

    best = min(
        (
            minimize(cost, start, method="Nelder-Mead", options={"maxfev": 120, "xatol": 0.02, "fatol": 1e-3})
            for start in STARTS
        ),
        key=lambda found: found.fun,
    )
    return {name: float(f"{10.0**value:.4g}") for name, value in zip(TUNED, best.x, strict=True)}


def judge_drives(folder: Path, runs: Path) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Return the RMSE a coordinate of every test drive by receiver and filters, and the tuned factors."""
    recording, held = stored_drives(folder, "test")
    file = runs / "drives.tuned.json"
    if not file.exists():
        file.write_text(json.dumps(tune_drives(stored_drives(folder, "val")[0])), encoding="utf-8")
    values = json.loads(file.read_text(encoding="utf-8"))
    competitors = {"extended": "extended", "extended, tuned": Variant(Extended, **values)}
    dataset = filtergym.evaluate(Drives.id, competitors, recording, timed=True)
    drives = [str(name) for name in dataset.flight.values]
    rows: list[dict[str, Any]] = [{"name": "receiver alone", "rmse": held}]
    for name in dataset.policy.values.tolist():
        one = dataset.sel(policy=name)
        rmse = numpy.sqrt(one.cost.mean("time").values).tolist()
        anees = (one.nees / one.nees_degrees).mean("time").values.tolist()
        rows.append(
            {
                "name": name,
                "rmse": dict(zip(drives, rmse, strict=True)),
                "anees": dict(zip(drives, anees, strict=True)),
                "nanoseconds": round(float(one.nanoseconds), 1),
            }
        )
    return rows, values


# --- records and page

RECORDS = Path(__file__).parent.parent / "docs" / "records"
PROBLEMS, DRIVES = "public_problems", "public_drives"
"""Names of the records."""
DATES = ("2012-11-04", "2012-11-16", "2013-04-05")
PUBLISHED = {
    "receiver alone": (46.141, 19.500, 34.538),
    "wheels alone, extended, of filternet": (117.76, 81.61, 83.99),
    "extended, of filternet": (18.76, 12.29, 8.94),
    "KalmanNet, architecture 1, of filternet": (15.520, 7.806, 7.087),
}
"""RMSE a coordinate that filternet's README prints, m, by date."""


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if abs(value) < 1000.0 else f"{value:.0f}"


def problem_table(figures: Mapping[str, Any]) -> dict[str, Any]:
    rows = []
    if "noise_floor_db" in figures:
        floor = _text(figures["noise_floor_db"], 3)
        rows.append(["linear, stored set", "measurement as it is", floor, "", "", ""])
    for row in figures["rows"]:
        suffix = " (reference)" if row["kind"] == "reference" else ""
        runs = f"{row['seeds']}, {row['spread_db']:.2f} dB apart" if row["seeds"] > 1 else ""
        mse = f"{row['mse_db']:.3f} [{row['low_db']:.2f}, {row['high_db']:.2f}]"
        rows.append(
            [
                row["problem"],
                row["name"] + suffix,
                mse,
                _text(row["anees"], 2),
                _text(row["nanoseconds"], 0),
                runs,
            ]
        )
    return {"columns": ["problem", "filter", "MSE, dB", "ANEES", "ns", "training runs"], "rows": rows}


def drive_table(figures: Mapping[str, Any]) -> dict[str, Any]:
    rows = [["published", name, *(_text(v, 2) for v in values), "", ""] for name, values in PUBLISHED.items()]
    for one in figures["drives"]:
        anees = ", ".join(_text(one["anees"][date], 1) for date in DATES) if "anees" in one else ""
        time = _text(one["nanoseconds"], 0) if "nanoseconds" in one else ""
        rows.append(["ours", one["name"], *(_text(one["rmse"][date], 3) for date in DATES), anees, time])
    return {"columns": ["by", "filter", *DATES, "ANEES", "ns"], "rows": rows}


def write_records(figures: Mapping[str, Any], command: str, folder: Path = RECORDS) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    parts = {
        PROBLEMS: (problem_table, "noise_floor_db", "rows"),
        DRIVES: (drive_table, "drives", "drives_tuned"),
    }
    for name, (table, *kept) in parts.items():
        if all(key in figures for key in kept):
            data = {**table(figures), "figures": {key: figures[key] for key in kept}}
            versions = {"filtergym": filtergym.__version__, "numpy": numpy.__version__}
            made = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
            record = {"command": command, "made": made, "versions": versions, "note": "", "data": data}
            (folder / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kalmannet", type=Path, help="folder of KalmanNet_TSP")
    parser.add_argument("--filternet", type=Path, help="folder of filternet")
    parser.add_argument("--runs", type=Path, default=Path("runs/public"), help="tuned values and agents")
    parser.add_argument("--jobs", type=int, default=2, help="trainings side by side")
    parser.add_argument("--only", choices=(PROBLEMS, DRIVES), help="write only one record")
    parser.add_argument("--steps", type=int, default=200_000, help="measurements of a training")
    options = parser.parse_args()
    if options.only == DRIVES and not options.filternet:
        parser.error(f"{DRIVES} needs --filternet")
    # Agents store the module of the environment of their training.
    sys.modules[MODULE] = sys.modules["__main__"]
    options.runs.mkdir(parents=True, exist_ok=True)
    command = "python benchmarks/public_problems.py"
    if options.only == DRIVES:
        drives, values = judge_drives(options.filternet, options.runs)
        write_records(
            {"drives": drives, "drives_tuned": values}, f"{command} --only {DRIVES} --filternet filternet"
        )
        return
    rows: list[Row] = []
    figures: dict[str, Any] = {}
    problems = [Problem("Lorenz, J = 2", LorenzOrderTwo.id), Problem("Lorenz, decimated", LorenzDecimated.id)]
    if options.kalmannet:
        exact, rotated_f, rotated_h = (
            stored_linear(options.kalmannet, cls.id) for cls in (Linear, LinearRotatedF, LinearRotatedH)
        )
        figures["noise_floor_db"] = round(
            float(decibels(((exact.measurements["values"] - exact.truth) ** 2).mean())), 4
        )
        rows += judge("linear, exact", Linear.id, {"extended": "extended"}, exact)
        problems = [
            Problem("linear, F rotated", LinearRotatedF.id, (1e3,), rotated_f),
            Problem("linear, H rotated", LinearRotatedH.id, (0.1,), rotated_h),
            *problems,
        ]
    with ThreadPoolExecutor(options.jobs) as pool:
        training = {
            (problem.id, algorithm): [
                pool.submit(train, problem.id, algorithm, options.steps, seed, options.runs)
                for seed in range(SEEDS)
            ]
            for problem in problems
            for algorithm in ALGORITHMS
        }
        for problem in problems:
            agents = {name: [job.result() for job in training[problem.id, name]] for name in ALGORITHMS}
            rows += judge(
                problem.name, problem.id, competitors_of(problem, agents, options.runs), problem.recording
            )
    figures |= {"steps": options.steps, "episodes": TEST_EPISODES, "rows": [row._asdict() for row in rows]}
    if options.filternet and options.only is None:
        figures["drives"], figures["drives_tuned"] = judge_drives(options.filternet, options.runs)
    write_records(
        figures, f"{command} --kalmannet KalmanNet_TSP --filternet filternet --steps {options.steps}"
    )


if __name__ == "__main__":
    main()
