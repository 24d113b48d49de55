"""Cost of a first use: commands with an empty cache of compiled code, and again with a full one.

    python benchmarks/cold.py [--quick] [--only WORD] [--record]

Every command runs twice in a folder of its own that is the user's home and contains the code cache: cold, where both
are empty, then warm. A figure is of the whole process with its children: processor seconds, and seconds that pass
(wall). Other processes affect the second and, through caches, slightly the first: use ratios.

Two policies are evaluated over 500 episodes, and the benchmark is the quick one in one process. ``--quick`` leaves
out the benchmark and all evaluations but that of ManeuveringTarget; ``--only`` runs those whose name contains the word;
``--record`` replaces these rows of ``docs/records/cold.json``.
"""

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

RECORD = Path(__file__).resolve().parent.parent / "docs" / "records" / "cold.json"
COLUMNS = ["", "cold, s", "warm, s", "cold / warm", "cold, wall s", "warm, wall s"]
LIBRARIES = ("filtergym", "numpy", "scipy", "gymnasium", "llvmlite")
TIGHTLY = "filtergym/TightlyCoupledNavigation-v0"
FIRST_STEP = """
import gymnasium, filtergym
env = gymnasium.make({id!r})
env.reset(seed=0)
env.step(env.action_space.sample())
"""
POLICIES = {
    "LooselyCoupledNavigation": ("augmented", "innovation-adaptive"),
    "ManeuveringTarget": ("imm", "adaptive"),
    "RadarEsmTracking": ("quasi-optimal", "joint-type"),
    "UavAutopilot": ("kalman", "innovation-adaptive"),
    "TightlyCoupledNavigation": ("multi-hypothesis", "nis-adaptive"),
}
"""Two policies of each environment."""
SHORT = "ManeuveringTarget"
"""Environment of the evaluation with ``--quick``."""
LIMIT_S = 1200
"""Time limit of one command, s."""


class Cost(NamedTuple):
    """Processor and wall time of a process, s."""

    processor: float
    """Processor time, s."""
    wall: float
    """Elapsed time, s."""


def commands(quick: bool) -> dict[str, list[str]]:
    """Return each measured command as a list of words, by its name in the table."""
    front_door = [sys.executable, "-m", "filtergym"]
    found = {
        "make and first step, TightlyCoupledNavigation": [
            sys.executable,
            "-c",
            FIRST_STEP.format(id=TIGHTLY),
        ],
        "export to C, TightlyCoupledNavigation": [
            *front_door,
            *("export", TIGHTLY, "multi-hypothesis", "--to", "c", "--out", "exported"),
        ],
    }
    for name, policies in POLICIES.items():
        if not quick or name == SHORT:
            given = [word for policy in policies for word in ("--policy", policy)]
            given += ["--episodes", "500"]
            found[f"evaluate, {name}"] = [*front_door, "evaluate", f"filtergym/{name}-v0", *given]
    if not quick:
        found["benchmark"] = [*front_door, "benchmark", "--jobs", "1"]
    return found


def measure(command: Sequence[str], home: Path) -> Cost:
    """Run a command with a folder as the user's home, and return its times; a failure raises RuntimeError."""
    environment = {
        **os.environ,
        "HOME": str(home),
        "XDG_CACHE_HOME": str(home / ".cache"),
        "FILTERGYM_COMPILER_CACHE": str(home / "compiled"),
        "OMP_NUM_THREADS": "1",
    }
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        command, cwd=home, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT_S
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall = time.perf_counter() - start
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed: {(done.stderr or done.stdout).strip()[-500:]}")
    return Cost(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall)


def row(name: str, cold: Cost, warm: Cost) -> list[str]:
    seconds = [f"{value:.1f}" for value in (cold.processor, warm.processor)]
    wall = [f"{value:.1f}" for value in (cold.wall, warm.wall)]
    return [name, *seconds, f"{cold.processor / warm.processor:.2f}", *wall]


def write_record(rows: Sequence[Sequence[str]]) -> None:
    """Replace the rows of measured commands in the record file, in the order of :func:`commands`."""
    known = json.loads(RECORD.read_text(encoding="utf-8"))["data"]["rows"] if RECORD.exists() else []
    by_name = {each[0]: list(each) for each in [*known, *rows]}
    versions = {"Python": platform.python_version()}
    versions |= {name: importlib.metadata.version(name) for name in LIBRARIES}
    record: dict[str, Any] = {
        "command": "python benchmarks/cold.py --record",
        "made": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "versions": versions,
        "note": "One process on one of two shared cores; processor seconds, with those of its children, and wall time.",
        "data": {"columns": COLUMNS, "rows": [by_name[name] for name in commands(False) if name in by_name]},
    }
    RECORD.write_text(json.dumps(record, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="only commands that take less than a minute")
    parser.add_argument(
        "--only", metavar="WORD", default="", help="only commands whose name contains it: benchmark, evaluate"
    )
    parser.add_argument("--record", action="store_true", help="put the rows into docs/records/cold.json")
    options = parser.parse_args()
    rows = []
    for name, command in commands(options.quick).items():
        if options.only not in name:
            continue
        with tempfile.TemporaryDirectory(prefix="cold-") as home:
            rows.append(row(name, measure(command, Path(home)), measure(command, Path(home))))
        print(" ".join(rows[-1]), file=sys.stderr, flush=True)
    table = Table()
    for i, column in enumerate(COLUMNS):
        table.add_column(column, justify="right" if i else "left")
    for each in rows:
        table.add_row(*each)
    Console().print(table)
    if options.record:
        write_record(rows)


if __name__ == "__main__":
    main()
