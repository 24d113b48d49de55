"""Commands that are killed at random moments and begun again end with the same bytes as undisturbed ones.

``python tests/kill_and_resume.py SECONDS [SEED] [COMMAND ...]`` takes each command in turn: once undisturbed, and then
until the seconds are over from the start, interrupted by SIGINT, SIGTERM and SIGKILL until it has ended. What it prints
and writes must be equal, but for lines that tell times, and nothing unfinished be left. It says how often each was
killed, and how many kept parts the last attempts used; ``advise`` and ``export``, which take seconds, keep none and
begin anew.
"""

import collections
import difflib
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ENVIRONMENT = "filtergym/ManeuveringTarget-v0"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
COMMANDS = {
    "tune": (
        ("tune", ENVIRONMENT, "--policy", "imm", "--budget", "1024000"),
        ("tuned/ManeuveringTarget-v0.json",),
    ),
    "benchmark": (
        ("benchmark", "--environment", ENVIRONMENT, "--jobs", "1", "--out", "out"),
        ("out/results.json",),
    ),
    "export": (("export", ENVIRONMENT, "imm", "--to", "c", "--out", "out"), ("out/imm.c", "out/imm.h")),
    "advise": (
        ("advise", "log.nc", "--out", "mine.filter.json"),
        ("mine.filter.json",),
    ),
    "train": (
        ("train", ENVIRONMENT, "--algo", "bptt", "--steps", "24000", "--validate-every", "3000", "--seeds", "3",
         "--no-compare", "--out", "run"),
        ("run-3/best/agent.safetensors",),
    ),
}  # fmt: skip
"""Words of a command, and the files in which it ends."""
TIMES = re.compile(
    r"second|nanosecond|\bmade\b|\bdate\b|\btime|\bns\b|resum|went on|\d s\b|created|elapsed|steps/s"
)
"""Of lines that say how long something took, when, or that it goes on."""
RUNNER = """
import atexit, os, pathlib, sys
from filtergym.evaluation.storage.store import Store
used, read = [0], Store.read
def count(*given):
    found = read(*given)
    used[0] += found is not None
    return found
Store.read = count
atexit.register(lambda: pathlib.Path(os.environ["USED_PARTS"]).write_text(str(used[0])))
sys.argv[0] = "filtergym"
from filtergym.__main__ import main
main()
"""
"""The command line, which counts the kept parts that it finds."""


def content(path: Path) -> list[str]:
    """Lines of a file without those that tell times."""
    lines = path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    return [line for line in lines if not TIMES.search(line)]


def run(words: tuple[str, ...], folder: Path, after: float | None = None, number: int = 0) -> int:
    """Run a command in a folder, and kill it after some seconds; returns its exit code."""
    with folder.with_suffix(".out").open("w") as out, folder.with_suffix(".err").open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", RUNNER, *words],
            cwd=folder,
            stdout=out,
            stderr=errors,
            env={**os.environ, "USED_PARTS": str(folder.with_suffix(".used")), "COLUMNS": "200"},
        )
        try:
            return process.wait(after)
        except subprocess.TimeoutExpired:
            process.send_signal(number)
            try:
                return process.wait(60)
            except subprocess.TimeoutExpired:
                process.kill()
                raise RuntimeError(f"{words[0]} hangs after signal {number}") from None


def prepare(folder: Path, name: str) -> None:
    """Make a folder with what a command reads."""
    folder.mkdir()
    if name == "advise":
        import filtergym

        filtergym.record(ENVIRONMENT, "paper", 1).write(folder / "log.nc")


def tear(name: str, torn: Path, usual: float, rng: random.Random, until: float) -> tuple[list[int], int]:
    """Kill a command at random moments until it has ended by itself or the time is over, and then let it end.

    Args:
        name: of the command.
        torn: folder that it runs in.
        usual: seconds that it takes undisturbed.
        rng: of moments and signals.
        until: when the time is over, of ``time.monotonic``.

    Returns:
        Signals that killed it, and how many checkpoints its last attempt began with.
    """
    kills: list[int] = []
    while True:
        begun = len([*torn.rglob("checkpoint")])
        number, last = rng.choice(SIGNALS), time.monotonic() > until
        if run(COMMANDS[name][0], torn, None if last else rng.uniform(0.2, 1.0) * usual, number) == 0:
            return kills, begun
        kills.append(number)
        assert not last, f"{name} does not end: {torn.with_suffix('.err').read_text()[-500:]}"


def main(seconds: float, rng: random.Random, names: list[str]) -> int:
    """Kill and resume each command, again and again, and return how many ended otherwise."""
    wrong = 0
    for name in names:
        words, results = COMMANDS[name]
        with tempfile.TemporaryDirectory() as place:
            whole = Path(place, "whole")
            prepare(whole, name)
            began = time.monotonic()
            code = run(words, whole)
            assert code == 0, f"{name} does not run: {whole.with_suffix('.err').read_text()[-500:]}"
            usual, until = time.monotonic() - began, time.monotonic() + seconds
            kills, used, checkpoints, trials = collections.Counter[int](), 0, 0, 0
            left, differing = set[str](), set[str]()
            while not trials or time.monotonic() < until:
                torn = Path(place, f"torn{trials}")
                prepare(torn, name)
                killed, begun = tear(name, torn, usual, rng, until)
                trials, checkpoints = trials + 1, checkpoints + begun
                kills.update(killed)
                used += int(torn.with_suffix(".used").read_text())
                left |= {p.name for p in torn.rglob("*") if p.name.startswith(".") or "partial" in p.name}
                differing |= {file for file in results if content(whole / file) != content(torn / file)}
                printed = [content(folder.with_suffix(".out")) for folder in (whole, torn)]
                if name != "train" and printed[0] != printed[1]:  # which says that it goes on
                    differing.add("what is printed")
                    print(
                        "\n".join(difflib.unified_diff(*printed, "undisturbed", "resumed", n=0, lineterm=""))
                    )
            wrong += bool(left or differing)
            told = ", ".join(f"{number.name} {kills[number]}" for number in SIGNALS)
            print(
                f"{name}: ended {trials} times, killed by {told}; {used} kept parts and {checkpoints} checkpoints "
                f"used; differing {sorted(differing)}; left {sorted(left)}",
                flush=True,
            )
    return wrong


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    seed, *chosen = sys.argv[2:] or ["0"]
    sys.exit(main(float(sys.argv[1]), random.Random(int(seed)), chosen or [*COMMANDS]))
