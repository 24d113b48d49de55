"""Commands that are killed at random moments and begun again end with the same bytes as undisturbed ones.

``python tests/kill_and_resume.py SECONDS [SEED] [COMMAND ...]`` takes each command in turn: once undisturbed, and then
until the seconds are over from the start, interrupted by SIGINT, SIGTERM and SIGKILL until it has ended. What it writes
must be equal, but for lines that tell times, and nothing unfinished be left.

``python tests/kill_and_resume.py --moments COUNT [COMMAND ...]`` kills each by SIGKILL at so many moments of its
writing instead, spread over all: before a file is opened, moved or removed, and when half is written. Each time the
same command is run again to its end.
"""

import collections
import os
import random
import re
import shutil
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
    "evaluate": (
        ("evaluate", ENVIRONMENT, "--policy", "imm", "--policy", "adaptive", "--episodes", "16", "--out", "out",
         "--json", "records.json"),
        ("out/records.csv", "out/records.json", "out/results.json", "records.json"),
    ),
    "export": (("export", ENVIRONMENT, "imm", "--to", "c", "--out", "out"), ("out/imm.c", "out/imm.h")),
    "advise": (("advise", "log.nc", "--out", "mine.filter.json"), ("mine.filter.json",)),
    "train": (
        ("train", ENVIRONMENT, "--algo", "bptt", "--steps", "24000", "--validate-every", "3000", "--seeds", "3",
         "--no-compare", "--out", "run"),
        ("run-3/best/agent.safetensors",),
    ),
}  # fmt: skip
"""Words of a command, and the files in which it ends."""
TIMES = re.compile(r"second|nanosecond|\bmade\b|\bdate\b|\btime|\bns\b|\d s\b|created|elapsed|steps/s")
"""Of lines that say how long something took, or when."""


HOOK = """
import os, pathlib, signal, sys
moment, steps, folder = int(sys.argv.pop(1)), 0, os.getcwd() + os.sep
def step():
    global steps
    steps += 1
    if steps == moment:
        os.kill(os.getpid(), signal.SIGKILL)
def hook(event, given):
    writes = event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir")
    writes = writes or event == "open" and (given[2] or 0) & (os.O_WRONLY | os.O_RDWR)
    if writes and isinstance(given[0], (str, os.PathLike)) and os.path.abspath(given[0]).startswith(folder):
        step()
def halves(write):
    def half(path, content, **keywords):
        write(path, content[: len(content) // 2], **keywords)
        step()
        return write(path, content, **keywords)
    return half
sys.addaudithook(hook)
for name in ("write_text", "write_bytes"):
    setattr(pathlib.Path, name, halves(getattr(pathlib.Path, name)))
from filtergym.__main__ import main
try:
    main()
finally:
    moment or print("steps", steps, file=sys.stderr)
"""
"""Runs a command that is killed at a step of its writing, or counts the steps if that is zero."""


def content(path: Path) -> list[str]:
    """Lines of a file without those that tell times."""
    lines = path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    return [line for line in lines if not TIMES.search(line)]


def run(
    words: tuple[str, ...],
    folder: Path,
    after: float | None = None,
    number: int = 0,
    moment: int | None = None,
) -> int:
    """Run a command in a folder, and kill it after some seconds or at a step of its writing; returns its exit code."""
    how = ["-m", "filtergym"] if moment is None else ["-c", HOOK, str(moment)]
    with folder.with_suffix(".out").open("w") as output:
        process = subprocess.Popen([sys.executable, *how, *words], cwd=folder, stdout=output, stderr=output)
        try:
            return process.wait(after)
        except subprocess.TimeoutExpired:
            process.send_signal(number)
            return process.wait(60)


def prepare(folder: Path, name: str) -> None:
    """Make a folder with what a command reads."""
    folder.mkdir()
    if name == "advise":
        import filtergym

        filtergym.record(ENVIRONMENT, "paper", 1).write(folder / "log.nc")


def tear(name: str, torn: Path, usual: float, rng: random.Random, until: float) -> list[int]:
    """Kill a command at random moments until it has ended by itself or the time is over, and then let it end.

    Args:
        name: of the command.
        torn: folder that it runs in.
        usual: seconds that it takes undisturbed.
        rng: of moments and signals.
        until: when the time is over, of ``time.monotonic``.

    Returns:
        Signals that killed it.
    """
    kills: list[int] = []
    while True:
        number, last = rng.choice(SIGNALS), time.monotonic() > until
        if run(COMMANDS[name][0], torn, None if last else rng.uniform(0.2, 1.0) * usual, number) == 0:
            return kills
        kills.append(number)
        assert not last, f"{name} does not end: {torn.with_suffix('.out').read_text()[-500:]}"


def kill_at_moments(count: int, names: list[str]) -> int:
    """Kill each command at moments of its writing and run it again; returns how many commands ended otherwise."""
    wrong = 0
    for name in names:
        words, results = COMMANDS[name]
        with tempfile.TemporaryDirectory() as place:
            whole = Path(place, "whole")
            prepare(whole, name)
            assert run(words, whole, moment=0) == 0, whole.with_suffix(".out").read_text()[-500:]
            steps = int(whole.with_suffix(".out").read_text().rpartition("steps ")[2].split()[0])
            moments = sorted({1 + i * (steps - 1) // max(1, count - 1) for i in range(count)})
            killed, bad = 0, []
            for moment in moments:
                torn = Path(place, f"torn{moment}")
                prepare(torn, name)
                killed += run(words, torn, moment=moment) == -signal.SIGKILL
                ended = run(words, torn)
                left = [p.name for p in torn.rglob("*") if p.name.startswith(".") or "partial" in p.name]
                if ended or left or any(content(whole / file) != content(torn / file) for file in results):
                    bad.append((moment, ended, left))
                shutil.rmtree(torn)
            wrong += bool(bad)
            print(
                f"{name}: {steps} steps of writing, killed at {killed} of them; ended otherwise {bad}",
                flush=True,
            )
    return wrong


def main(seconds: float, rng: random.Random, names: list[str]) -> int:
    """Kill and resume each command, again and again, and return how many ended otherwise."""
    wrong = 0
    for name in names:
        words, results = COMMANDS[name]
        with tempfile.TemporaryDirectory() as place:
            whole = Path(place, "whole")
            prepare(whole, name)
            began = time.monotonic()
            assert run(words, whole) == 0, (
                f"{name} does not run: {whole.with_suffix('.out').read_text()[-500:]}"
            )
            usual, until = time.monotonic() - began, time.monotonic() + seconds
            kills, trials = collections.Counter[int](), 0
            left, differing = set[str](), set[str]()
            while not trials or time.monotonic() < until:
                torn = Path(place, f"torn{trials}")
                prepare(torn, name)
                kills.update(tear(name, torn, usual, rng, until))
                trials += 1
                left |= {p.name for p in torn.rglob("*") if p.name.startswith(".") or "partial" in p.name}
                differing |= {file for file in results if content(whole / file) != content(torn / file)}
            wrong += bool(left or differing)
            signals = ", ".join(f"{number.name} {kills[number]}" for number in SIGNALS)
            print(f"{name}: ended {trials} times, killed by {signals}", end="; ")
            print(f"differing {sorted(differing)}; left {sorted(left)}", flush=True)
    return wrong


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    os.environ["COLUMNS"] = "200"
    if sys.argv[1] == "--moments":
        sys.exit(kill_at_moments(int(sys.argv[2]), sys.argv[3:] or ["evaluate", "train", "benchmark"]))
    seed, *chosen = sys.argv[2:] or ["0"]
    sys.exit(main(float(sys.argv[1]), random.Random(int(seed)), chosen or [*COMMANDS]))
