"""The optimised Kalman filter (OKF) on the problems of public_problems.py.

    pip install Optimized-Kalman-Filter seaborn
    git clone https://github.com/KalmanNet/KalmanNet_TSP
    python benchmarks/optimised_kalman.py --kalmannet KalmanNet_TSP

Greenberg, Yannay and Mannor, "Optimization or Architecture: How to Hack Kalman Filtering", NeurIPS 2023. Their package
fits all entries of Q and R, through Cholesky factors, by descent on the squared error of tracks with truth. Where the
model is not linear, a subclass linearises it as the extended Kalman filter does.

It is trained on simulated episodes of the training split. The resulting Q and R are judged in our Kalman filter, on the
episodes of all other filters; a check compares the estimates with those of the package's filter. The record is
``public_optimised``.
"""

import argparse
import datetime
import importlib.metadata
import json
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy
import okf
import public_problems as public
import torch

import filtergym
from filtergym.evaluation.storage.files import write_text

SEEDS = 3
"""Default number of training runs."""
TRACKS, LENGTH = 200, 100
"""Simulated tracks of a training run, of which the package validates on 15 %, and measurements of each."""
RATE = 0.1
"""Learning rate. Each track is used once and a step takes ten, the package's defaults; its rate is 0.01."""
CHECKED, AGREE = 3, 1e-9
"""Tracks on which both filters are compared, and the largest difference of their errors."""
NAME = "public_optimised"


class Problem(NamedTuple):
    """A problem of the comparison: model of OKF's filter, prior, and whether its test set is stored."""

    name: str
    id: str
    f: numpy.ndarray | int
    """Transition matrix, or the order of KalmanNet's Taylor series."""
    h: numpy.ndarray
    start: float
    """Value of every entry of the initial mean."""
    certainty: float
    """Value of every variance of the initial mean's error."""
    stored: bool = False
    """Whether it is evaluated on KalmanNet's stored test set."""


F, H = public.F, public.H
PROBLEMS = (
    Problem("linear, F rotated", public.LinearRotatedF.id, F @ public.TURN, H, 0.0, 0.0, True),
    Problem("linear, H rotated", public.LinearRotatedH.id, F, H @ public.TURN, 0.0, 0.0, True),
    Problem("Lorenz, J = 2", public.LorenzOrderTwo.id, 2, numpy.eye(3), 1.0, 0.0),
    Problem("Lorenz, decimated", public.LorenzDecimated.id, 5, numpy.eye(3), 1.0, 1.0),
)


class ExtendedOptimised(okf.OKF):  # type: ignore[misc]
    """OKF's filter for KalmanNet's Taylor series of the Lorenz attractor, linearised at the estimate."""

    def __init__(self, order: int, *args: Any, **keywords: Any) -> None:
        super().__init__(*args, **keywords)
        self.order = order

    def predict(self) -> None:
        """Predict mean and covariance over a time step by the series and its Jacobian."""
        x = self.x
        zero, one = torch.zeros((), dtype=x.dtype), torch.ones((), dtype=x.dtype)
        A = torch.stack([-10 * one, 10 * one, zero, 28 - x[2], -one, zero, x[1], zero, -8 / 3 * one]).reshape(
            3, 3
        )
        term, slope = x, torch.eye(3, dtype=x.dtype)
        self.x, F = term, slope
        for j in range(1, self.order + 1):
            # A term is A(x) times the one before; the entries of A depend on x, too.
            by_entries = torch.stack([*5 * [zero], -term[0], zero, term[0], zero]).reshape(3, 3)
            slope = (public.INTERVAL / j) * (A @ slope + by_entries)
            term = (public.INTERVAL / j) * (A @ term)
            self.x, F = self.x + term, F + slope
        self.P = F @ self.P @ F.T + okf.OKF.get_SPD(self.Q_D, self.Q_L)

    def estimate_noise(self, X: list[numpy.ndarray], Z: list[numpy.ndarray]) -> None:
        """Set Q and R to the covariances of the model's residuals over tracks X and measurements Z."""
        left = [x[1:] - numpy.stack(public.taylor(x[:-1].T, self.order), axis=1) for x in X]
        noises = (
            numpy.cov(numpy.concatenate(left).T),
            numpy.cov((numpy.concatenate(Z) - numpy.concatenate(X)).T),
        )
        with torch.no_grad():
            for names, noise in zip((("Q_D", "Q_L"), ("R_D", "R_L")), noises, strict=True):
                for name, part in zip(names, okf.OKF.encode_SPD(torch.tensor(noise)), strict=True):
                    getattr(self, name).copy_(part)


def make_filter(problem: Problem, folder: str) -> okf.OKF:
    n = len(problem.h)
    options = {
        "H": torch.tensor(problem.h),
        "x0": torch.full((n,), problem.start, dtype=torch.double),
        "P0": problem.certainty * torch.eye(n, dtype=torch.double),
        "model_files_path": folder,
    }
    if isinstance(problem.f, int):
        return ExtendedOptimised(problem.f, n, n, torch.eye(n, dtype=torch.double), **options)
    return okf.OKF(n, n, torch.tensor(problem.f), **options)


def estimates_of(model: okf.OKF, values: numpy.ndarray) -> numpy.ndarray:
    found = numpy.empty((*values.shape[:2], model.dim_x))
    with torch.no_grad():
        for track, row in zip(values, found, strict=True):
            model.init_state()
            for k, z in enumerate(track):
                model.predict()
                model.update(z)
                row[k] = model.x.numpy()
    return found


def optimise(problem: Problem, seed: int) -> dict[str, Any]:
    """Train OKF's filter, and compare it with ours; return Q, R, duration and largest difference by name."""
    torch.manual_seed(seed)
    recording = filtergym.record(problem.id, episodes=TRACKS, seed=seed, split="train", horizon=LENGTH)
    assert recording.truth is not None
    values, truth = recording.measurements["values"][:, :LENGTH], recording.truth[:, :LENGTH]
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        model = make_filter(problem, folder)
        okf.train(model, list(values), list(truth), lr=RATE, verbose=0)
    seconds = time.process_time() - begun
    Q, R = model.get_Q(), model.get_R()
    few = filtergym.record(problem.id, episodes=CHECKED, split="train", horizon=LENGTH)
    dataset = filtergym.evaluate(problem.id, {"okf": public.with_noises(Q, R)}, few)
    ours = dataset.cost.sel(policy="okf").values
    theirs = estimates_of(model, few.measurements["values"][:, :LENGTH]) - few.truth[:, :LENGTH]
    difference = numpy.abs(numpy.sqrt(ours) - numpy.sqrt((theirs**2).mean(axis=2))).max()
    return {"Q": Q.tolist(), "R": R.tolist(), "seconds": seconds, "difference": float(difference)}


def run_file(folder: Path, problem: Problem, seed: int) -> Path:
    return folder / f"{problem.id.replace('/', '.')}.{seed}.json"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kalmannet", type=Path, required=True, help="folder of KalmanNet_TSP")
    parser.add_argument(
        "--runs", type=Path, default=Path("runs/optimised"), help="folder of the results of training runs"
    )
    parser.add_argument("--seeds", type=int, default=SEEDS, help="training runs")
    options = parser.parse_args()
    options.runs.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    # Every problem once, before a second training of any: an incomplete table states its number of runs.
    for seed in range(options.seeds):
        for problem in PROBLEMS:
            file = run_file(options.runs, problem, seed)
            if not file.exists():
                write_text(file, json.dumps(optimise(problem, seed)))
                print(file.name, flush=True)
    rows, runs = [], []
    for problem in PROBLEMS:
        files = [run_file(options.runs, problem, seed) for seed in range(options.seeds)]
        found = [json.loads(file.read_text(encoding="utf-8")) for file in files]
        runs += [{"problem": problem.name, "seed": seed, **run} for seed, run in enumerate(found)]
        worst = max(run["difference"] for run in found)
        if not worst < AGREE:
            raise SystemExit(f"{problem.name}: the package's errors differ from ours by {worst:.1e}")
        competitors = {
            f"OKF/{seed}": public.with_noises(*(numpy.array(run[noise]) for noise in "QR"))
            for seed, run in enumerate(found)
        }
        recording = public.stored_linear(options.kalmannet, problem.id) if problem.stored else None
        rows += public.judge(problem.name, problem.id, competitors, recording)
    figures = {"tracks": TRACKS, "length": LENGTH, "rate": RATE, "rows": [row._asdict() for row in rows]}
    names = ("filtergym", "numpy", "torch", "Optimized-Kalman-Filter")
    record = {
        "command": f"python benchmarks/optimised_kalman.py --kalmannet KalmanNet_TSP --seeds {options.seeds}",
        "made": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "versions": {name: importlib.metadata.version(name) for name in names},
        "note": "",
        "data": {**public.problem_table(figures), "figures": {**figures, "runs": runs}},
    }
    write_text(public.RECORDS / f"{NAME}.json", json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
