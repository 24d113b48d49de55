"""Supervision of a command in a child process, so that a competitor that crashes loses only its own row.

A user's class runs in the process that simulates the world, and can end that process or never return. So the
command forks (on Linux): the child does the work and reports which competitor's code it runs. Where it ends
in a user's code, or that code takes too long, another child starts again without that competitor.
"""

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress

from .parallel import end_with_parent
from .rollout import Progress

POLLING = 0.5
"""Interval at which the parent process checks that its child runs, s."""
START_SECONDS = 60.0
"""Least time limit of the first measurement, s; it includes compilation of the world's code."""
STEP = 0.1
"""Least interval between two progress reports of a running competitor, s."""
_supervised: frozenset[str] = frozenset()
"""Names of the supervised competitors of this process."""
_reports = -1
"""File handle of the pipe to the parent process."""


def supervise(names: Collection[str], seconds: float) -> dict[str, str]:
    """Continue the program in a child process; repeat that without a competitor whose code has ended the child.

    Args:
        names: names of the competitors whose classes run in this process.
        seconds: time limit of a competitor from one measurement to the next.

    Returns:
        Reasons for excluded competitors by name; in the child, or in this process where none is left.

    Raises:
        SystemExit: in the parent, when its child has done the work, with the child's status.
    """
    global _supervised, _reports
    failures: dict[str, str] = {}
    if sys.platform != "linux" or threading.current_thread() is not threading.main_thread():
        return failures
    try:
        sys.stdout.fileno()
    except (AttributeError, OSError, ValueError):  # a notebook's stream, to which a child cannot write
        return failures
    while left := frozenset(names) - failures.keys():
        sys.stdout.flush()
        sys.stderr.flush()
        parent, (reports, writing) = os.getpid(), os.pipe()
        if (child := os.fork()) == 0:
            os.close(reports)
            _supervised, _reports = left, writing
            end_with_parent(parent)
            return failures
        os.close(writing)
        name, words = _watch(child, reports, seconds)
        os.close(reports)
        failures[name] = f"{name!r} takes no part: {words}"
    return failures


def is_supervised() -> bool:
    """Return whether this process is a supervised child, where a crash of a competitor loses only its own row."""
    return bool(_supervised)


@contextmanager
def report_running(name: str, progress: Progress | None = None, timed: bool = True) -> Iterator[Progress]:
    """Report to the parent process that a competitor's code runs inside the context; yield a progress
    function.
    """
    tick = progress or (lambda measurements: None)
    if name not in _supervised:
        yield tick
        return
    reported = 0.0

    def tick_and_report(measurements: int) -> None:
        nonlocal reported
        if time.monotonic() - reported > STEP:
            _report(".")
            reported = time.monotonic()
        tick(measurements)

    _report(f"{int(timed)}{name}")
    try:
        yield tick_and_report
    finally:
        _report("")


def _report(line: str) -> None:
    with suppress(OSError):
        os.write(_reports, f"{line}\n".encode())


def _watch(child: int, reports: int, seconds: float) -> tuple[str, str]:
    """Wait for a child and exit with its status; if a competitor is late, kill it and return its name and
    why.
    """
    running, unread, heard, status, limit = "", b"", time.monotonic(), 0, seconds
    # Ctrl-C and a termination request are for the child.
    before = {
        signal.SIGINT: signal.signal(signal.SIGINT, signal.SIG_IGN),
        signal.SIGTERM: signal.signal(signal.SIGTERM, lambda number, _: os.kill(child, number)),
    }
    ended = is_late = False
    while not ended:
        if select.select([reports], [], [], POLLING)[0]:
            found = os.read(reports, 1 << 16)
            *lines, unread = (unread + found).split(b"\n")
            for line in lines:
                heard, goes_on = time.monotonic(), line == b"."
                running = running if goes_on else line.decode()
                limit = seconds if goes_on else max(seconds, START_SECONDS)
            ended = not found
        elif running.startswith("1") and time.monotonic() - heard > limit:
            is_late = True
            os.kill(child, signal.SIGKILL)
        else:
            pid, status = os.waitpid(child, os.WNOHANG)
            ended = bool(pid)
            child = -1 if pid else child
    if child > 0:
        status = os.waitpid(child, 0)[1]
    for number, handler in before.items():
        signal.signal(number, handler)
    code = os.waitstatus_to_exitcode(status)
    if not running:
        raise SystemExit(code if code >= 0 else 128 - code)
    if is_late:
        return running[1:], f"it has not responded within {limit:g} s, see --time-limit"
    ending = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit status {code}"
    return running[1:], f"it has ended the process {ending}"
