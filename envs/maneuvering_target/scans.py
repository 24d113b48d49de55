"""The scans of ManeuveringTarget's radar: when they come, and whether they see the target."""

from types import ModuleType
from typing import Any, NamedTuple

import numpy

from ..contract.draws import Draws
from ..contract.faults import undisturbed
from ..contract.observation import Array
from ..contract.task import Task
from ..data.recorded_world import Feed
from ..data.recording import Recording
from .courses import Course, Motion
from .parameters import ManeuveringTargetParameters


class Scan(NamedTuple):
    """One scan."""

    motion: Motion
    """Of the target at its time."""
    available: Array
    """1 if it saw the target, 0 if not, ``(N,)``."""
    interval: Array
    """s since the scan before, ``(N,)``."""
    elapsed: Array
    """s since the last scan before that saw the target, ``(N,)``."""


class RegularScans:
    """Every scan comes on time and sees the target.

    Args:
        task: with the scan period.
        course: that the target flies.

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
        """Draw what holds for an episode, whose track begins with a measurement on time: here nothing."""
        return None

    def advance(
        self, scans: Any, flight: Any, number: Array, before: Motion, uniforms: Array
    ) -> tuple[Any, Scan]:
        """Fly on to a scan.

        Args:
            scans: of :meth:`begin`, or the scan before.
            flight: of the course.
            number: of the scan, ``(N,)``.
            before: motion at the time of the scan before.
            uniforms: ``(row_uniforms, N)``.
        """
        always = self.xp.ones_like(number)
        interval = self.parameters.sampling_interval * always
        return None, Scan(self.course.advance(flight, number, before), always, interval, interval)

    def time(self, scans: Any, number: Array) -> Array:
        """Return the time of the current scan in scan periods, ``(N,)``."""
        return number

    def context(self, scans: Any) -> dict[str, Array]:
        """Return the context of the scans: here empty."""
        return {}


class Reliability(NamedTuple):
    """Scans that may miss the target and come early."""

    detection_probability: Array
    """``(N,)``."""
    jitter: Array
    """Share of the scan period by which scans come early at most, ``(N,)``."""
    early: Array
    """That of the current scan, ``(N,)``."""
    unseen: Array
    """s since the last scan that saw the target, zero if the current one does, ``(N,)``."""
    position: Array
    """When the current scan would have come on time, m, ``(2, N)``, and the velocity, m/s."""
    velocity: Array


class UnreliableScans(RegularScans):
    """A scan may miss the target and come early, each one on its own."""

    row_uniforms = 2

    def begin(self, draws: Draws, motion: Motion) -> Reliability:
        """Draw the probability that scans see the target, and by how much they come early at most."""
        p, never = self.parameters, 0.0 * motion[0][0]
        seen = draws.uniform("detection_probability", p.detection_probability)
        jitter = draws.uniform("scan_jitter", p.scan_jitter)
        undisturbed(draws, p)  # takes its random number here
        return Reliability(seen, jitter, never, never, *motion)

    def advance(
        self, scans: Reliability, flight: Any, number: Array, before: Motion, uniforms: Array
    ) -> tuple[Reliability, Scan]:
        """Fly on to a scan, from where the target would have been on time at the one before."""
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
        """Return the probability that scans see the target, and the share of the scan period by which they come
        early at most.
        """
        return {"detection_probability": scans.detection_probability, "scan_jitter": scans.jitter}


def has_regular_scans(recording: Recording | Feed, p: ManeuveringTargetParameters) -> bool:
    """Return whether every scan of a recording has a plot, and all are one sampling interval apart, to the last bit."""
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
