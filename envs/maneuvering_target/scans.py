"""Scans of ManeuveringTarget's radar: their times, and whether they see the target."""

from types import ModuleType
from typing import Any, NamedTuple

import numpy

from ..contract.draws import Draws
from ..contract.faults import draw_undisturbed
from ..contract.observation import Array
from ..contract.task import Task
from ..data.recorded_world import Feed
from ..data.recording import Recording
from .courses import Course, Motion
from .parameters import ManeuveringTargetParameters


class Scan(NamedTuple):
    """A scan of the radar: motion at its time, whether it sees the target, times since earlier ones."""

    motion: Motion
    """Motion of the target at the time of the scan."""
    available: Array
    """1 if it saw the target, 0 if not, ``(N,)``."""
    interval: Array
    """Time since the previous scan, s, ``(N,)``."""
    elapsed: Array
    """Time since the last earlier scan that saw the target, s, ``(N,)``."""


class RegularScans:
    """Simulation of radar scans that all come on time and see the target.

    Args:
        task: with the scan period.

    Attributes:
        row_uniforms: uniform numbers that a scan takes.
    """

    row_uniforms = 0
    parameters: ManeuveringTargetParameters

    def __init__(self, task: Task, course: Course) -> None:
        self.parameters = task.parameters
        self.xp: ModuleType = task.xp
        self.course = course

    def begin(self, draws: Draws, motion: Motion) -> Any:
        """Return the random constants of an episode's scans: here None."""
        return None

    def advance(
        self, scans: Any, flight: Any, number: Array, before: Motion, uniforms: Array
    ) -> tuple[Any, Scan]:
        """Move the target to the next scan; return the state of the scans, and the :class:`Scan`.

        ``before`` is the motion at the time of the previous scan.
        """
        always = self.xp.ones_like(number)
        interval = self.parameters.sampling_interval * always
        return None, Scan(self.course.advance(flight, number, before), always, interval, interval)

    def time(self, scans: Any, number: Array) -> Array:
        """Return the time of the current scan in scan periods, ``(N,)``: its number."""
        return number

    def context(self, scans: Any) -> dict[str, Array]:
        """Return the random draws of the scans by name: here none."""
        return {}


class Reliability(NamedTuple):
    """State of radar scans that may miss the target and come early."""

    detection_probability: Array
    """Probability that a scan sees the target, ``(N,)``."""
    jitter: Array
    """Share of the scan period by which scans come early at most, ``(N,)``."""
    early: Array
    """Share of the scan period by which the current scan comes early, ``(N,)``."""
    unseen: Array
    """Time since the last scan that saw the target, s, zero if the current one does, ``(N,)``."""
    position: Array
    """Position when the current scan would have come on time, m, ``(2, N)``; below, the velocity, m/s."""
    velocity: Array


class UnreliableScans(RegularScans):
    """Simulation of radar scans that may miss the target and come early, each independent of the others."""

    row_uniforms = 2

    def begin(self, draws: Draws, motion: Motion) -> Reliability:
        """Draw the detection probability, and the largest share of the period by which scans come early."""
        p, never = self.parameters, 0.0 * motion[0][0]
        seen = draws.uniform("detection_probability", p.detection_probability)
        jitter = draws.uniform("scan_jitter", p.scan_jitter)
        draw_undisturbed(draws, p)  # takes its random number here
        return Reliability(seen, jitter, never, never, *motion)

    def advance(
        self, scans: Reliability, flight: Any, number: Array, before: Motion, uniforms: Array
    ) -> tuple[Reliability, Scan]:
        """Move the target to the next scan; return the state of the scans, and the :class:`Scan`."""
        before = scans.position, scans.velocity
        on_time = self.course.advance(flight, number, before)
        early = scans.jitter * uniforms[1]
        motion = self.course.motion_at_early_scan(flight, number, early, before, on_time)
        available = self.xp.astype(uniforms[0] < scans.detection_probability, number.dtype)
        interval = self.parameters.sampling_interval * (1.0 + (scans.early - early))
        elapsed = scans.unseen + interval
        position, velocity = on_time
        scans = scans._replace(
            early=early, unseen=(1.0 - available) * elapsed, position=position, velocity=velocity
        )
        return scans, Scan(motion, available, interval, elapsed)

    def time(self, scans: Reliability, number: Array) -> Array:
        """Return the time of the current scan in scan periods, ``(N,)``."""
        return number - scans.early

    def context(self, scans: Reliability) -> dict[str, Array]:
        """Return detection probability, and the largest share of the period by which scans come early, by name."""
        return {"detection_probability": scans.detection_probability, "scan_jitter": scans.jitter}


def has_regular_scans(recording: Recording | Feed, p: ManeuveringTargetParameters) -> bool:
    """Return whether every scan of a recording has a plot and comes one sampling interval after the previous."""
    if isinstance(recording, Feed):
        return recording.regular
    there = numpy.isfinite(recording.seconds)
    found = recording.measurements
    return all(
        bool((found[name][there] == value).all())
        for name, value in (
            ("available", 1.0),
            ("interval", p.sampling_interval),
            ("elapsed", p.sampling_interval),
        )
    )
