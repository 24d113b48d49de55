"""Crash test of all shipped competitors of an environment, as a table in Markdown.

    python benchmarks/crash_test.py ENVIRONMENT [--policy NAME ...] [--episodes N] [--steps N]

One row for each policy, estimator, tuned one and agent: the number of alterations that it passed, and those under which
it degraded or failed. References and bounds, which need the truth, and smoothers, which need later measurements, are
left out.
"""

import argparse
import os
import sys
import warnings
from collections.abc import Sequence

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

from filtergym.baselines.problem import problem_of
from filtergym.evaluation.stress.crash_test import CrashTest, Finding
from filtergym.names import find_competitor, ranked_names
from filtergym.papers.grid import markdown_table

COLUMNS = ["", "passed", "degraded", "failed", "degraded under", "failed under"]


def row(name: str, findings: Sequence[Finding]) -> list[str]:
    by_verdict = {
        verdict: [one.alteration for one in findings if one.verdict == verdict]
        for verdict in ("passed", "degraded", "failed")
    }
    counts = [str(len(own)) for own in by_verdict.values()]
    return [name, *counts, *(", ".join(by_verdict[verdict]) or "-" for verdict in ("degraded", "failed"))]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("environment")
    parser.add_argument("--policy", action="append", help="only this competitor; repeatable")
    parser.add_argument("--episodes", type=int, default=32, help="tracks side by side")
    parser.add_argument("--steps", type=int, default=10_000, help="measurements of the long run")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    problem = problem_of(options.environment)
    paper = problem.baselines.score_paper
    experiment = problem.experiment(None, options.episodes)
    test = CrashTest(experiment, options.steps, (paper, find_competitor(problem, paper).maker))
    rows = []
    for name in options.policy or ranked_names(problem):
        rows.append(row(name, list(test.findings(name, find_competitor(problem, name).maker))))
        print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
    print(*markdown_table(COLUMNS, rows), sep="\n")


if __name__ == "__main__":
    main()
