"""Progress of a command: a bar in a terminal, and lines where standard error is a file or a pipe."""

import time
from collections.abc import Callable
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

FEWEST_SECONDS, MOST_SECONDS = 10.0, 60.0
"""Least and largest time between two lines, s."""
STEP = 0.05
"""Share of the work after which a line is printed."""


class _Bar(Progress):
    def write_line(self, text: str) -> None:
        """Ignore the line: the bar shows the progress."""


class ProgressLines:
    """Progress of a task as few lines of text with the remaining time; none for tasks of seconds.

    ``clock`` returns the time, s.
    """

    def __init__(self, write: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._write, self._clock = write, clock
        self._begin("", 0.0)

    def _begin(self, description: str, total: float) -> None:
        self._description, self._total = description, total
        self._done = self._reported = 0.0
        self._begun = self._reported_at = self._clock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        pass

    def add_task(self, description: str, *, total: float | None) -> TaskID:
        """Begin to show a task, in place of the one before, and return its id."""
        self._begin(description, total or 0.0)
        return TaskID(0)

    def update(
        self,
        task: TaskID,
        /,
        *,
        advance: float | None = None,
        completed: float | None = None,
        description: str | None = None,
    ) -> None:
        """Set the task's progress and description; write a line when one is due, at once for a new description."""
        self._done = self._done + (advance or 0.0) if completed is None else completed
        if description is not None and description != self._description:
            self._description = description
            self.write_line(description)
        since = self._clock() - self._reported_at
        if self._total <= 0.0 or since < FEWEST_SECONDS or self._done <= self._reported:
            return
        if since >= MOST_SECONDS or self._done - self._reported >= STEP * self._total:
            self._write(f"{self._description}: {self._standing()}")
            self._reported_at, self._reported = self._clock(), self._done

    def write_line(self, text: str) -> None:
        """Write a line of text between the lines of progress."""
        standing = f" ({self._standing()})" if 0.0 < self._done < self._total else ""
        self._write(f"{text}{standing}")
        self._reported_at, self._reported = self._clock(), self._done

    def _standing(self) -> str:
        share = min(self._done / self._total, 1.0)
        passed = self._clock() - self._begun
        text = f"{100.0 * share:.0f} % done after {duration(passed)}"
        return text if share >= 1.0 else f"{text}, {duration(passed * (1.0 - share) / share)} left"


def duration(seconds: float) -> str:
    """Return a duration in seconds as text: ``42 s``, ``3 min 20 s``, ``2 h 5 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def progress_bar() -> "_Bar | ProgressLines":
    """Return the progress display on standard error, so that tables can be piped: a bar in a terminal, else lines."""
    errors = Console(stderr=True, highlight=False, markup=False, emoji=False)
    if not errors.is_terminal:
        return ProgressLines(lambda line: errors.print(line, soft_wrap=True))
    return _Bar(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=errors,
        transient=True,
    )
