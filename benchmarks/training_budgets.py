"""Costs of ``bptt`` by budget of training, after 100,000, a million and ten million decisions, in Markdown.

    python benchmarks/training_budgets.py --runs runs/budgets

Each is a separate run of ``filtergym train``, whose learning rate falls over its own length; runs in the folder are not
repeated. TightlyCoupledNavigation is left out: its decisions take ten measurements of three filters, and its shipped
runs have 100,000 of them. The best agent of each run is evaluated on the episodes of the test split.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import numpy

import filtergym
from filtergym.baselines.catalogue import baselines_of
from filtergym.papers.grid import markdown_table

ENVIRONMENTS = ("ManeuveringTarget", "UavAutopilot", "RadarEsmTracking", "LooselyCoupledNavigation")
BUDGETS = (100_000, 1_000_000, 10_000_000)


def train(id: str, algo: str, steps: int, seeds: int, run: Path) -> list[str]:
    words = ["train", id, "--algo", algo, "--steps", str(steps), "--seeds", f"0-{seeds - 1}", "--no-compare"]
    command = [sys.executable, "-m", "filtergym", *words, "--out", str(run)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return [f"{run}-{seed}" for seed in range(seeds)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, default=Path("runs/budgets"), help="folder of the runs")
    parser.add_argument("--algo", default="bptt")
    parser.add_argument("--environment", action="append", help="short name; repeatable; default: four")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=1000)
    args = parser.parse_args()
    rows = []
    for name in args.environment or ENVIRONMENTS:
        id, cells = f"filtergym/{name}-v0", []
        paper = baselines_of(id).score_paper
        for steps in BUDGETS:
            runs = train(id, args.algo, steps, args.seeds, args.runs / f"{name}-{args.algo}-{steps}")
            results = filtergym.evaluate(id, [paper, *runs], episodes=args.episodes, seed=0)
            cost = results["cost"].mean(["episode", "time"]).values
            change = 100.0 * (cost[1:] / cost[0] - 1.0)
            cells.append(f"{numpy.mean(change):+.1f} ({change.min():+.1f} to {change.max():+.1f})")
        rows.append([name, *cells])
    header = [f"{args.algo}, {args.seeds} seeds", *(f"{steps:,} decisions" for steps in BUDGETS)]
    print("\n".join(markdown_table(header, rows)))


if __name__ == "__main__":
    main()
