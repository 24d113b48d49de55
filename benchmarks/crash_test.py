"""Crash tests of all shipped competitors, as tables for the pages: docs/records/stress/ENVIRONMENT.json.

    python benchmarks/crash_test.py [--environment ID] [--policy NAME ...] [--episodes N] [--steps N] [--record]

One row for each policy, estimator, tuned one and agent: how many alterations it passed, and under which it is degraded
or failed. References and bounds, which need the truth, and smoothers, which answer afterwards, are left out. With
``--policy`` the rows of these are put into the record that is there.
"""

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

from filtergym.agents.named_policies import ranked_names
from filtergym.baselines.problem import Problem, problem_of
from filtergym.envs.engine.catalogue import bare_name, catalogue
from filtergym.evaluation.stress.alterations import ALTERATIONS
from filtergym.evaluation.stress.crash_test import CrashTest, Finding

from filtergym.names import find_competitor

FOLDER = Path(__file__).parent.parent / "docs" / "records" / "stress"
LIBRARIES = ("filtergym", "numpy", "scipy", "gymnasium", "llvmlite")
COLUMNS = ["", "passed", "degraded", "failed", "degraded under", "failed under"]


def row(name: str, findings: Sequence[Finding]) -> list[str]:
    """Row of the table."""
    by_verdict = {
        verdict: [one.alteration for one in findings if one.verdict == verdict]
        for verdict in ("passed", "degraded", "failed")
    }
    counts = [str(len(own)) for own in by_verdict.values()]
    return [name, *counts, *(", ".join(by_verdict[verdict]) or "-" for verdict in ("degraded", "failed"))]


def write_record(problem: Problem, rows: Sequence[Sequence[str]], options: Any) -> None:
    """Write the record; see ``docs/make/records.py``."""
    FOLDER.mkdir(exist_ok=True)
    path, known = FOLDER / f"{bare_name(problem.id)}.json", {row[0]: list(row) for row in rows}
    if options.policy and path.exists():
        record = json.loads(path.read_text(encoding="utf-8"))
        table = {row[0]: row for row in record["data"]["rows"]} | known
        record["data"]["rows"] = [table[name] for name in ranked_names(problem) if name in table]
        today = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
        record["note"] += f" Rows of {', '.join(options.policy)} are of {today}."
        path.write_text(json.dumps(record, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
        return
    versions = {"Python": platform.python_version()}
    versions |= {name: importlib.metadata.version(name) for name in LIBRARIES}
    record: dict[str, Any] = {
        "command": shlex.join(["python", "benchmarks/crash_test.py", *sys.argv[1:]]),
        "made": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "versions": versions,
        "note": f"{options.episodes} tracks, long runs of {options.steps:,} measurements; {len(ALTERATIONS)} "
        "alterations, of which some do not apply.",
        "data": {"columns": COLUMNS, "rows": list(known.values())},
    }
    path.write_text(json.dumps(record, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Test everybody, print the tables and write them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--environment", choices=sorted(catalogue()), help="default: all of them")
    parser.add_argument("--policy", action="append", help="only this competitor; repeatable")
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--steps", type=int, default=10_000, help="of the long run")
    parser.add_argument("--record", action="store_true", help="write the records")
    parser.add_argument("--json", type=Path, help="file for all findings")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    everything: list[Finding] = []
    for id in catalogue():
        if options.environment not in (None, id):
            continue
        problem = problem_of(id)
        paper = problem.baselines.score_paper
        experiment = problem.experiment(None, options.episodes)
        test = CrashTest(experiment, options.steps, (paper, find_competitor(problem, paper)))
        rows = []
        for name in options.policy or ranked_names(problem):
            findings = list(test.findings(name, find_competitor(problem, name)))
            everything += findings
            rows.append(row(name, findings))
            print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
            if options.json is not None:
                options.json.write_text(json.dumps([one._asdict() for one in everything]), encoding="utf-8")
        if options.record:
            write_record(problem, rows, options)


if __name__ == "__main__":
    main()
