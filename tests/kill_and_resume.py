"""Commands that are killed at random moments and begun again end with the same bytes as undisturbed ones.

``python tests/kill_and_resume.py SECONDS [SEED] [COMMAND ...]`` takes each command in turn: once undisturbed, then
interrupted by SIGINT, SIGTERM and SIGKILL until it comes to its end by itself. What it writes must be equal, and
nothing unfinished be left. It says how often each was killed, and how many kept parts the last attempt found.
"""

import random
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
        "tuned/ManeuveringTarget-v0.json",
    ),
    "benchmark": (
        ("benchmark", "--environment", ENVIRONMENT, "--jobs", "1", "--out", "out"),
        "out/results.json",
    ),
    "export": (("export", ENVIRONMENT, "imm", "--to", "c", "--out", "out"), "out/imm.c"),
}
"""Words of a command, and the file in which it ends."""
VOLATILE = ("seconds", "nanoseconds", "made", "date", "time")
"""Of lines that say how long something took, or when."""


def content(path: Path) -> list[str]:
    """Lines of a file without those that tell times."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line for line in lines if not any(f'"{word}' in line for word in VOLATILE)]


def run(words: tuple[str, ...], folder: Path, after: float | None = None, number: int = 0) -> int:
    """Run a command in a folder, and kill it after some seconds; returns its exit code."""
    process = subprocess.Popen(
        [str(Path(sys.executable).with_name("filtergym")), *words],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
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


def main(seconds: float, rng: random.Random, names: list[str]) -> int:
    """Kill and resume each command, and return how many ended otherwise."""
    wrong = 0
    for name in names:
        words, result = COMMANDS[name]
        with tempfile.TemporaryDirectory() as place:
            whole, torn = Path(place, "whole"), Path(place, "torn")
            whole.mkdir()
            torn.mkdir()
            began = time.monotonic()
            assert run(words, whole) == 0, f"{name} does not run"
            usual, kills, kept = time.monotonic() - began, dict.fromkeys(SIGNALS, 0), 0
            until = time.monotonic() + seconds
            while True:
                kept = len(list(torn.rglob("*.msgpack")))
                number = rng.choice(SIGNALS)
                last = time.monotonic() > until
                if run(words, torn, None if last else rng.uniform(0.0, usual), number) == 0:
                    break
                kills[number] += 1
            left = [path.name for path in torn.rglob(".*")]
            same = content(whole / result) == content(torn / result)
            wrong += bool(left) or not same
            told = ", ".join(f"{number.name} {count}" for number, count in kills.items())
            print(f"{name}: killed by {told}; {kept} kept parts used; equal {same}; left {left}", flush=True)
            shutil.rmtree(torn)
    return wrong


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    seed, *chosen = sys.argv[2:] or ["0"]
    sys.exit(main(float(sys.argv[1]), random.Random(int(seed)), chosen or [*COMMANDS]))
