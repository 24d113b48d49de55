"""Attitude filters on the recordings of BROAD: classical ones, VQF, and what was trained on simulated motion.

BROAD (CC BY 4.0) is read where it lies, a copy of https://github.com/dlaidig/broad; trials that lack are left out and
counted. A filter runs over a whole trial, its errors count while the sensor moves, and a trial counts by its root mean
square. Agents are run folders of `filtergym train attitude:broad/Attitude-v0`; several of one name are training seeds,
and count by their mean.

Without BROAD the same competitors are run over simulated episodes of every scenario.

Example: python benchmarks/attitude.py --broad broad --agent bptt=runs/bptt --out docs/data/attitude_broad.csv
         python benchmarks/attitude.py --agent bptt=runs/bptt --out docs/data/attitude_simulated.csv
         python benchmarks/attitude.py --render docs/data/attitude_broad.csv
"""

import argparse
import csv
import itertools
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy
import scipy.io
from filtergym.evaluation.statistics.bootstrap import Bootstrap, Estimate

import filtergym

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"
sys.path.insert(0, str(EXAMPLES))

from attitude import gradient_filters, quaternions  # noqa: E402  (found beside the documentation)
from attitude.broad import read_trial, read_trials  # noqa: E402
from attitude.task import Attitude  # noqa: E402

COMPETITORS = ("madgwick", "madgwick-gated", "mahony", "vqf-basic", "vqf")
EPISODES = 64
"""Of each scenario: 20,000 measurements of each are held in memory."""
PARTS = ("total", "inclination", "heading")
BETAS = numpy.round(numpy.geomspace(0.01, 0.4, 25), 4)
GAINS = tuple(itertools.product(numpy.round(numpy.geomspace(0.1, 2.0, 8), 3), (0.0, 0.001, 0.003)))
"""Of Mahony's filter: proportional, of both vectors, and integral."""
Angles = Mapping[str, numpy.ndarray]
"""Root mean squares of each trial, deg, by their names."""


def group_of(trial: str) -> str:
    """Kind of movement and disturbance: the name of a trial without its number and its last letter or length."""
    return re.sub(r"_([A-D]|\dcm|\d+s)$", "", trial[3:])


def evaluate(competitors: Sequence[Any], scenario: Any, **keywords: Any) -> Angles:
    """Run competitors by the project's own evaluation, and take the mean over them.

    Returns:
        Root mean squares of each episode.
    """
    runs = []
    for competitor in competitors:
        found = filtergym.evaluate(Attitude.id, competitor, scenario=scenario, **keywords)
        squares = {part: numpy.nanmean(found[f"{part}_angle"].values[0] ** 2, axis=1) for part in PARTS}
        runs.append({part: numpy.sqrt(square) for part, square in squares.items()})
        print(f"  {competitor}: {runs[-1]['total'].mean():.3f} deg", flush=True)
    return {part: numpy.mean([run[part] for run in runs], axis=0) for part in PARTS}


def run_grid(
    trials: Sequence[Any], count: int, start: Callable[..., Any], step: Callable[..., Any]
) -> dict[str, numpy.ndarray]:
    """Run one filter with many settings over all trials, all side by side.

    Args:
        trials: recordings of one trial each.
        count: G, settings.
        start: from quaternions to the memory.
        step: from memory, three measurements and T to memory and quaternions, all with trials times G on the last axis.

    Returns:
        Root mean squares, ``(trials, G)``, deg.
    """
    longest = max(len(trial.seconds[0]) for trial in trials)

    def table(values: Sequence[numpy.ndarray]) -> numpy.ndarray:
        return numpy.stack([numpy.pad(v, ((0, longest - len(v)), (0, 0)), "edge") for v in values], axis=-1)

    measured = [
        table([trial.measurements[name][0] for trial in trials]) for name in ("rate", "force", "field")
    ]
    padding = [numpy.full((longest - len(trial.seconds[0]), 9), numpy.nan) for trial in trials]
    truth = numpy.stack(
        [numpy.concatenate([trial.truth[0], end]) for trial, end in zip(trials, padding, strict=True)],
        axis=-1,
    )
    interval = trials[0].parameters["sampling_interval"]
    first = numpy.stack([trial.initial["quaternion"][0] for trial in trials], axis=-1)
    memory = start(numpy.repeat(first, count, axis=-1))
    sums, known = {part: numpy.zeros(len(trials) * count) for part in PARTS}, numpy.zeros(len(trials) * count)
    for k in range(longest):
        memory, attitude = step(
            memory, *(numpy.repeat(part[k], count, axis=-1) for part in measured), interval
        )
        there = numpy.isfinite(truth[k]).all(axis=0)
        if there.any():
            lanes = numpy.repeat(there, count)
            error = (
                quaternions.direction_cosines(attitude[:, lanes])
                - numpy.repeat(truth[k], count, axis=-1)[:, lanes]
            )
            for part, angle in zip(PARTS, quaternions.error_angles(error), strict=True):
                sums[part][lanes] += angle**2
            known += lanes
    return {part: numpy.sqrt(sums[part] / known).reshape(len(trials), count) for part in PARTS}


def madgwick_grid(trials: Sequence[Any], scale: float) -> dict[str, numpy.ndarray]:
    """Madgwick's filter with all of BETAS."""
    beta = numpy.tile(BETAS, len(trials))

    def step(q: Any, rate: Any, force: Any, field: Any, interval: float) -> Any:
        q = gradient_filters.madgwick_step(q, rate, force, field, beta, interval, scale)
        return q, q

    return run_grid(trials, len(BETAS), lambda q: q, step)


def mahony_grid(trials: Sequence[Any]) -> dict[str, numpy.ndarray]:
    """Mahony's filter with all of GAINS."""
    proportional, integral = (numpy.tile(part, len(trials)) for part in numpy.array(GAINS).T)

    def step(memory: Any, rate: Any, force: Any, field: Any, interval: float) -> Any:
        gains = (proportional, proportional, integral)
        memory = gradient_filters.mahony_step(*memory, rate, force, field, gains, interval)
        return memory, memory[0]

    return run_grid(trials, len(GAINS), lambda q: (q, 0.0 * q[:3]), step)


def chosen(grid: Mapping[str, numpy.ndarray], best: Any) -> Angles:
    """Take one setting of a grid for each trial."""
    return {part: values[numpy.arange(len(values)), best] for part, values in grid.items()}


def best_per_group(grid: Mapping[str, numpy.ndarray], names: Sequence[str]) -> Angles:
    """Take of a grid the setting that is best for the mean of each group of trials."""
    groups = numpy.array([group_of(name) for name in names])
    best = numpy.zeros(len(names), dtype=int)
    for group in set(groups.tolist()):
        best[groups == group] = grid["total"][groups == group].mean(axis=0).argmin()
    return chosen(grid, best)


class PeerVQF:
    """VQF of its authors, the package `vqf`, as an estimator: starts from the first measurement."""

    kind = "estimator"

    def __init__(self, task: Attitude) -> None:
        self.task = task

    def start(self, initial: Any, N: int) -> Any:
        """One filter for each trial."""
        from vqf import VQF

        return [VQF(self.task.parameters.sampling_interval) for _ in range(N)]

    def update(self, measurement: Any, memory: Any) -> Any:
        """One step of each."""
        found = numpy.empty((4, len(memory)))
        for i, one in enumerate(memory):
            one.update(*(numpy.ascontiguousarray(part[:, i]) for part in measurement))
            found[:, i] = one.getQuat9D()
        half = numpy.sqrt(0.5)
        turned = quaternions.multiply(numpy.array([half, 0.0, 0.0, -half])[:, None] + 0.0 * found, found)
        return quaternions.direction_cosines(turned), self.task.stated_covariance(turned[0]), memory


def published(folder: Path, names: Sequence[str]) -> Iterator[tuple[str, Angles]]:
    """Results that BROAD publishes, with the setting that is best for all of its 39 trials."""
    for algorithm in ("madgwick", "mahony"):
        path = folder / "example_code" / "out" / f"results_{algorithm}.mat"
        if not path.is_file():
            continue
        stored = scipy.io.loadmat(path, squeeze_me=True)
        total = stored["total_rmse_deg"]
        best = numpy.mean([total[name].item().ravel() for name in total.dtype.names], axis=0).argmin()
        yield (
            f"{algorithm}, published",
            {
                part: numpy.array(
                    [stored[f"{part}_rmse_deg"][f"trial_{n}"].item().ravel()[best] for n in names]
                )
                for part in PARTS
            },
        )


def measure(
    folder: Path, agents: Mapping[str, Sequence[str]], peer: bool
) -> Iterator[tuple[str, Sequence[str], Angles]]:
    """Yield name, trials and angles of every competitor, one after the other."""
    paths = sorted((folder / "data_mat").glob("*.mat"))
    if not paths:
        raise SystemExit(f"there is no trial of BROAD in {folder / 'data_mat'}")
    recording, names = read_trials(paths), [path.stem for path in paths]
    for name, angles in published(folder, names):
        yield name, names, angles
    for name in COMPETITORS:
        yield name, names, evaluate([name], recording)
    if peer:
        yield "vqf, its authors' package", names, evaluate([{"peer": PeerVQF}], recording)
    for name, runs in agents.items():
        yield name, names, evaluate(runs, recording)
    trials = [read_trial(path) for path in paths]
    for scale, label in ((1.0, "madgwick"), (0.5, "madgwick, sample code")):
        grid = madgwick_grid(trials, scale)
        best = int(grid["total"].mean(axis=0).argmin())
        yield f"{label}, best beta", names, chosen(grid, best)
        print(f"{label}: best beta {BETAS[best]}")
        if scale == 1.0:
            yield f"{label}, best beta per group", names, best_per_group(grid, names)
    grid = mahony_grid(trials)
    best = int(grid["total"].mean(axis=0).argmin())
    yield "mahony, best gains", names, chosen(grid, best)
    print(f"mahony: best gains {GAINS[best]}")


def interval_text(found: Any) -> str:
    """Value and interval."""
    return f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]"


def simulate(agents: Mapping[str, Sequence[str]]) -> Iterator[list[Any]]:
    """Yield competitor, scenario, and the mean over episodes of the root mean square of the total angle."""
    bootstrap = Bootstrap(EPISODES)
    competitors = {**{name: [name] for name in (*COMPETITORS, "undisturbed")}, **agents}
    for scenario in Attitude.scenarios:
        for name, runs in competitors.items():
            angle = evaluate(runs, scenario, episodes=EPISODES)["total"]
            estimate = bootstrap.interval(bootstrap.means(angle))
            print(f"{scenario}, {name}: {interval_text(estimate)}", flush=True)
            yield [name, scenario, *(f"{value:.4f}" for value in estimate)]


def read_results(path: Path) -> list[dict[str, str]]:
    """Rows of a file of results."""
    with path.open(newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def render(path: Path) -> str:
    """Table of a file of results, in Markdown."""
    rows = read_results(path)
    return _simulated_table(rows) if "scenario" in rows[0] else _broad_table(rows)


def _broad_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Means over the trials, with intervals over them, sorted by the total angle."""
    names = list(dict.fromkeys(row["competitor"] for row in rows))
    values = {
        name: {part: numpy.array([float(r[part]) for r in rows if r["competitor"] == name]) for part in PARTS}
        for name in names
    }
    trials = len(values[names[0]]["total"])
    bootstrap = Bootstrap(trials)
    lines = [
        f"| competitor, {trials} trials | total, deg | inclination | heading | total less that of `vqf` |",
        "|---|---|---|---|---|",
    ]
    for name in sorted(names, key=lambda name: values[name]["total"].mean()):
        own = values[name]
        columns = [interval_text(bootstrap.interval(bootstrap.means(own[part]))) for part in PARTS]
        paired = bootstrap.interval(bootstrap.means(own["total"] - values["vqf"]["total"]))
        difference = "-" if name == "vqf" else interval_text(paired)
        lines.append(f"| {name} | {' | '.join(columns)} | {difference} |")
    return "\n".join(lines)


def _simulated_table(rows: Sequence[Mapping[str, str]]) -> str:
    """One row for each competitor, one column for each scenario, sorted by the first."""
    scenarios = list(dict.fromkeys(row["scenario"] for row in rows))
    cells = {
        (row["competitor"], row["scenario"]): Estimate(*(float(row[key]) for key in Estimate._fields))
        for row in rows
    }
    names = dict.fromkeys(row["competitor"] for row in rows)
    lines = [f"| competitor | {' | '.join(scenarios)} |", "|---" * (1 + len(scenarios)) + "|"]
    for name in sorted(names, key=lambda name: cells[name, scenarios[0]].value):
        lines.append(f"| {name} | {' | '.join(interval_text(cells[name, s]) for s in scenarios)} |")
    return "\n".join(lines)


def write_results(
    path: Path, agents: Mapping[str, Sequence[str]], columns: Sequence[str], rows: Sequence[Any]
) -> None:
    """Write a file of results, with the command that makes it in its first line."""
    broad = "" if "scenario" in columns else "--broad BROAD "
    words = " ".join(f'--agent "{name}=RUN"' for name, runs in agents.items() for _ in runs)
    with path.open("w", newline="") as file:
        file.write(f"# python benchmarks/attitude.py {broad}{words}\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def main() -> None:
    """Measure, or render what was measured."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--broad", type=Path, help="folder of BROAD; without it episodes are simulated")
    parser.add_argument(
        "--agent", action="append", default=[], metavar="NAME=RUN", help="agent; may be repeated"
    )
    parser.add_argument("--no-peer", action="store_true", help="without the package vqf")
    parser.add_argument("--out", type=Path, help="file of results, CSV")
    parser.add_argument("--render", type=Path, help="print the table of a file of results")
    asked = parser.parse_args()
    if asked.render is not None:
        print(render(asked.render))
        return
    agents: dict[str, list[str]] = {}
    for agent in asked.agent:
        name, _, run = agent.partition("=")
        agents.setdefault(name, []).append(run)
    if asked.broad is None:
        columns, rows = ["competitor", "scenario", *Estimate._fields], list(simulate(agents))
    else:
        columns, rows = ["competitor", "trial", *PARTS], []
        for name, trials, angles in measure(asked.broad, agents, not asked.no_peer):
            print(f"{name}: {angles['total'].mean():.3f} deg", flush=True)
            for i, trial in enumerate(trials):
                rows.append([name, trial, *(f"{angles[part][i]:.4f}" for part in PARTS)])
    if asked.out is not None:
        write_results(asked.out, agents, columns, rows)


if __name__ == "__main__":
    main()
