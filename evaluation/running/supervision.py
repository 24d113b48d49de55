"""A command in a process of its own, so that a competitor which ends that process costs its own row alone.

A user's class runs in the process that simulates the world: its processor time is measured as that of all others, and
nothing is sent anywhere. It can end that process, or never return. So the command forks (on Linux): the child does all
of the work and reports whose code it runs, and its parent waits. Where the child ends in the code of a user's
competitor, or hears nothing from it for too long, another child begins again without that one.
"""

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress

from .parallel import end_with
from .rollout import Progress

POLLING = 0.5
"""s after which the parent looks whether its child is still there."""
START_SECONDS = 60.0
"""s at least that the first measurement may take: what steps the world is compiled before it."""
STEP = 0.1
"""s between two reports of a competitor that goes on."""
_supervised: frozenset[str] = frozenset()
"""Names of the competitors of this process that are reported."""
_reports = -1
"""Pipe to the parent."""


def supervise(names: Collection[str], seconds: float) -> dict[str, str]:
    """Go on in a child process, and in another one whenever a competitor has ended it.

    Args:
        names: of competitors whose classes run in this process.
        seconds: that one of them may take from one measurement to the next.

    Returns:
        Why some of them take no part, by their names: in the child, or in this process where none is left.

    Raises:
        SystemExit: in the parent, when its child has done the work, with the child's status.
    """
    global _supervised, _reports
    failures: dict[str, str] = {}
    if sys.platform != "linux" or threading.current_thread() is not threading.main_thread():
        return failures
    try:
        sys.stdout.fileno()
    except (AttributeError, OSError, ValueError):  # a notebook's, which a child cannot write to
        return failures
    while left := frozenset(names) - failures.keys():
        sys.stdout.flush()
        sys.stderr.flush()
        parent, (reports, writing) = os.getpid(), os.pipe()
        if (child := os.fork()) == 0:
            os.close(reports)
            _supervised, _reports = left, writing
            end_with(parent)
            return failures
        os.close(writing)
        name, words = _watch(child, reports, seconds)
        os.close(reports)
        failures[name] = f"{name!r} takes no part: {words}"
    return failures


def is_supervised() -> bool:
    """Whether a competitor that ends this process costs its own row alone."""
    return bool(_supervised)


@contextmanager
def running(name: str, progress: Progress | None = None, timed: bool = True) -> Iterator[Progress]:
    """Return the report that the code of a competitor runs; gives the progress that is to be called while it does.

    Args:
        name: of the competitor.
        progress: that is called, too.
        timed: whether it is ended where the progress is not called for too long.
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
    """Wait for the end of a child, and end it where a competitor is late; return in whose code it ended, and how.

    Raises:
        SystemExit: if it ended elsewhere, with its status.
    """
    running, unread, heard, status, limit = "", b"", time.monotonic(), 0, seconds
    # Ctrl-C is for the child, and so is a request to end.
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
        return running[1:], f"it has not answered within {limit:g} s, see --time-limit"
    ending = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit status {code}"
    return running[1:], f"it has ended the process {ending}"
