"""Plausibility checks of tracks in files: units, clocks, and positions that no target can reach.

Flights (:mod:`.flight_cleaning`) and recordings (:func:`check_recording`) use these checks. Impossible values raise an
error with the likely cause; noteworthy ones give a note. No row of a recording is changed or dropped, because a sensor
may have measured it.
"""

import difflib
import itertools
import math
import re
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy

from ..contract.companions import find_companion
from ..contract.log_format import LogFormat

if TYPE_CHECKING:
    from ..contract.task import Task
    from ..data.recording import Recording

LARGEST_ACCELERATION = 100.0
"""Largest acceleration of a target, m/s^2: ten g."""
LARGEST_SCATTER_RATIO = 1e6
"""Largest ratio of the scatter of positions to the stated deviation; motion between fixes gives 1e4 at most."""
FEWEST = 10
"""Smallest number of values from which noise is estimated."""
STANDING = 5.0
"""Stated deviations within which a target counts as standing still; one error in 1e5 is larger."""
MOST_NOTES = 10
"""Largest number of notes of a file; further ones are only counted."""
SPEED_UNITS = {"knots": 1.944, "km/h": 3.6, "feet per second": 3.281, "km/s": 1e-3}
"""Factors from m/s to other units of speed."""
DEVIATIONS = ("sigma", "std", "stddev", "deviation", "variance", "var", "accuracy", "uncertainty", "rms")
"""Words in the names of columns that contain the size of errors."""
NOISE_WORDS = (
    *DEVIATIONS,
    "sd",
    "cov",
    "covariance",
    "dop",
    "hdop",
    "vdop",
    "pdop",
    "gdop",
    "hacc",
    "vacc",
    "sacc",
    "noise",
)
"""Words in the names of columns that state noise in any form."""
NOISE_PARTS = ("sigma", "stddev", "deviation", "variance", "accuracy", "uncertainty", "hdop", "vdop", "pdop")
"""The longest of these words, which may also be parts of a word, as in ``horizontalAccuracy``."""
WARNING_PREFIX = "WARNING: "
"""Prefix of the most important notes."""
WIDE_BEARINGS = 0.5
"""Range of bearings above which bearings within 2 pi may be radians, rad."""


def speeds_of(time: numpy.ndarray, position: numpy.ndarray) -> numpy.ndarray:
    """Return the speed from each position ``(n, k)`` to the next, m/s, ``(n - 1,)``."""
    return numpy.asarray(_length(numpy.diff(position, axis=0)) / numpy.diff(time))


def _length(vectors: numpy.ndarray) -> numpy.ndarray:
    return numpy.asarray(numpy.sqrt(numpy.square(vectors).sum(axis=-1)))


def check_speed(
    time: numpy.ndarray,
    position: numpy.ndarray,
    speeds: tuple[float, float],
    sigma: float = 0.0,
    moving: bool = True,
) -> None:
    """Raise ValueError if positions taken as metres and times as seconds give an impossible speed.

    Args:
        time: s, ``(n,)``, increasing.
        position: m, ``(n, k)``.
        speeds: lowest and highest possible speed, m/s.
        sigma: standard deviation of the error of a position, m, which adds apparent speed.
        moving: whether the lowest speed applies, because the target cannot stand still.

    Raises:
        ValueError: with the likely cause, if the median speed is outside the limits.
    """
    speed = float(numpy.median(speeds_of(time, position)))
    step = float(numpy.median(numpy.diff(time)))
    lowest, highest = speeds
    if moving and speed < lowest:
        inside = position.shape[1] == 2 and any(
            (numpy.abs(position) <= limits).all() for limits in ((360.0, 90.0), (90.0, 360.0))
        )
        if inside and 10.0 <= 111e3 * speed <= 400.0:
            cause = "are x, y degrees? then call them longitude and latitude"
        elif lowest <= 1e3 * speed <= highest:
            cause = "are the times milliseconds?" if step >= 100.0 else "are x, y kilometres?"
        else:
            cause = "does it move at all? else allow lower speeds"
        raise ValueError(f"median speed {speed:.2g} m/s: {cause}")
    if speed - 4.0 * sigma / step > highest:
        factors = {"minutes": 60.0, "hours": 3600.0, "days": 86400.0}
        unit = next((unit for unit, factor in factors.items() if 10.0 <= speed / factor <= 400.0), None)
        over_two, over_eight = (
            float(numpy.median(_length(position[k:] - position[:-k]))) if len(position) > 2 * k else math.inf
            for k in (2, 8)
        )
        if over_two < 0.1 * speed * step:
            raise ValueError(
                f"median speed {speed:.4g} m/s from row to row, and much less from each row to the next but one: are "
                "there two targets? Give each a name in the column recording"
            )
        if over_eight < 2.0 * speed * step:
            raise ValueError(
                f"positions jump by {speed * step:.3g} m from row to row and lead nowhere, where {sigma:.3g} m are "
                "stated: this is noise and no track, or state its deviation"
            )
        cause = (
            f"are the times {unit}?"
            if unit
            else "are x, y metres and the times seconds? else allow higher speeds"
        )
        raise ValueError(f"median speed {speed:.4g} m/s: {cause}")


def check_velocity(what: str, time: numpy.ndarray, position: numpy.ndarray, velocity: numpy.ndarray) -> None:
    """Raise ValueError if velocities disagree with the differences of exact positions.

    Args:
        what: names of the velocities, for the error message.
        time: s, ``(n,)``.
        position: m, ``(n, k)``.
        velocity: m/s, ``(n, k)``.

    Raises:
        ValueError: with the likely unit, if they disagree.
    """
    speed = float(numpy.median(speeds_of(time, position)))
    if not speed:
        return
    ratio = float(numpy.median(_length(velocity))) / speed
    if not 0.8 <= ratio <= 1.25:
        unit = next((unit for unit, factor in SPEED_UNITS.items() if abs(ratio / factor - 1.0) < 0.05), None)
        raise ValueError(
            f"{what} are {ratio:.3g} times those of the positions: "
            + (f"are they {unit}?" if unit else "are they m/s, and the positions metres?")
        )


def check_degrees(name: str, values: numpy.ndarray, most: float) -> None:
    """Raise ValueError for angles beyond +-``most`` degrees."""
    largest = float(numpy.nanmax(numpy.abs(values), initial=0.0))
    if largest > most:
        cause = ": is it metres?" if largest > 1000.0 else ""
        raise ValueError(
            f"{name} reaches {largest:g}, and degrees from {-most:g} to {most:g} are expected{cause}"
        )


def check_bearings(name: str, time: numpy.ndarray, values: numpy.ndarray, sigma: float) -> list[str]:
    """Return notes on bearings; raise ValueError if they cannot be degrees.

    Args:
        name: name of the column.
        time: s, ``(n,)``.
        values: bearings, ``(n,)``, NaN where there is none.
        sigma: stated standard deviation, degrees.

    Raises:
        ValueError: for angles beyond a full turn, and for angles with the range and scatter of radians.
    """
    check_degrees(name, values, 360.0)
    there = numpy.isfinite(values)
    if there.sum() < FEWEST or numpy.nanmax(numpy.abs(values)) > 2.0 * math.pi:
        return []
    scatter = float(numpy.median(numpy.abs(_deviations(time[there], values[there, None])))) * 1.4826
    if 0.25 < math.degrees(scatter) / sigma < 4.0:
        raise ValueError(
            f"{name} scatters by {scatter:.2g} degrees where {sigma:g} are stated, and stays within 2 pi: is it "
            "radians? else state its deviation"
        )
    # If the deviation is in radians, too, the scatter agrees with it: only a wide range shows the mistake.
    if numpy.nanmax(values) - numpy.nanmin(values) > WIDE_BEARINGS:
        return [
            f"{name} stays within 2 pi and is taken for degrees, as its deviation: if they are radians, convert both"
        ]
    return []


def check_extents(names: tuple[str, str], one: numpy.ndarray, other: numpy.ndarray) -> None:
    """Raise ValueError if one of two series of the same positions is in metres and the other in kilometres."""
    extents = [
        _length(numpy.nanmax(values, axis=0) - numpy.nanmin(values, axis=0)) for values in (one, other)
    ]
    for (name, extent), (against, least) in itertools.permutations(zip(names, extents, strict=True)):
        if 0.5 * extent < 1e3 * least < 2.0 * extent:
            raise ValueError(
                f"{name} extends over {extent:.3g} m and {against} over {least:.3g} m: is {against} kilometres?"
            )


def check_interval(step: float, longest: float) -> None:
    """Raise ValueError if the interval between times is longer than ``longest``, both in s."""
    if step > longest:
        raise ValueError(
            f"times are {step:g} s apart, and at most {longest:g} s are expected: are they milliseconds? else name "
            "sampling_interval"
        )


def find_outliers(
    time: numpy.ndarray, position: numpy.ndarray, reach: Callable[[numpy.ndarray], Any]
) -> numpy.ndarray:
    """Return the mask ``(n,)`` of positions that are too far from both neighbours, which are near each other.

    Args:
        time: s, ``(n,)``.
        position: m, ``(n, k)``.
        reach: function from a time difference, s, to the largest possible distance, m.
    """

    def far(apart: int) -> numpy.ndarray:
        moved = _length(position[apart:] - position[:-apart])
        return numpy.asarray(moved > reach(time[apart:] - time[:-apart]))

    alone = numpy.zeros(len(time), dtype=bool)
    if len(time) > 2:
        alone[1:-1] = far(1)[:-1] & far(1)[1:] & ~far(2)
    return alone


def _deviations(time: numpy.ndarray, values: numpy.ndarray) -> numpy.ndarray:
    """Return the distance of values ``(n, k)`` from the line through their neighbours, ``(n - 2, k)``.

    It is scaled to the variance of the noise of the values.
    """
    before = ((time[2:] - time[1:-1]) / (time[2:] - time[:-2]))[:, None]
    line = before * values[:-2] + (1.0 - before) * values[2:]
    return numpy.asarray((values[1:-1] - line) / numpy.sqrt(1.0 + before**2 + (1.0 - before) ** 2))


def scatter_of(time: numpy.ndarray, values: numpy.ndarray) -> float:
    """Estimate the standard deviation of the noise of values ``(n, k)`` at times ``(n,)``, n at least 3.

    It is estimated from the median distance to the line through the neighbours, and not below the resolution of 64-bit
    numbers of that size.
    """
    scatter = 1.4826 * float(numpy.median(numpy.abs(_deviations(time, values))))
    return max(scatter, 1e-9 * float(numpy.abs(values).max(initial=0.0)), 1e-6)


def unknown_column_notes(names: Iterable[str], known: Iterable[str], noise_hint: str = "") -> list[str]:
    """Return notes on the columns of a table that are not read, warnings first.

    Args:
        names: names of the columns, in lower case.
        known: names that are read.
        noise_hint: advice on the column of noise that is read, for the end of the note.

    Raises:
        ValueError: for a name close to a known one, or of a column with the size of errors: its user expects it read.
    """
    given, known = list(names), list(known)
    ignored = [name for name in given if name not in known]
    for name in ignored:
        close = [k for k in difflib.get_close_matches(name, known, n=3, cutoff=0.75) if k not in given]
        deviations = [k for k in known if "sigma" in k and k not in given]
        if not close and any(word in DEVIATIONS for word in _words(name)):
            close = deviations
        if close:
            raise ValueError(
                f"it has the column {name}, which is not read: did you mean {' or '.join(close)}? else leave it out, "
                f"of a recording by --rename '{name}=-'"
            )
    noisy = [name for name in ignored if _is_noise(name)]
    others = [name for name in ignored if name not in noisy]
    notes = []
    if noisy:
        notes.append(
            f"{WARNING_PREFIX}column{'s' * (len(noisy) > 1)} {', '.join(noisy)} not read, and the name is one of "
            f"noise: every filter takes the noise of its measurements from elsewhere{noise_hint and f'; {noise_hint}'}"
        )
    if others:
        notes.append(f"not read: column{'s' * (len(others) > 1)} {', '.join(others)}")
    return notes


def _words(name: str) -> list[str]:
    return re.split(r"[^a-z0-9]+", name)


def _is_noise(name: str) -> bool:
    return any(word in NOISE_WORDS for word in _words(name)) or any(part in name for part in NOISE_PARTS)


# --- recordings


def check_recording(recording: "Recording", task: "Task", speeds: tuple[float, float]) -> list[str]:
    """Return notes on the plausibility of every episode of a recording; ValueError for impossible values.

    ``speeds`` are the lowest and highest possible speed, m/s; the lowest holds where targets always move.
    """
    world: Any = task.world  # a RecordedWorld
    # Latitude and longitude have a known unit, and their receiver may stand still.
    known_unit = "latitude" in recording.columns
    log_format = find_companion(task, LogFormat)
    moving = log_format is not None and log_format.targets_move and not known_unit
    seen, sigma = world.all_observations()
    metres = [i for i, component in enumerate(task.components) if component.unit == "m"]
    measured = [i for i in metres if seen is not None and numpy.isfinite(seen[i]).any()]
    usual = getattr(task.parameters, "sampling_interval", None)
    notes: list[str] = []
    first = 0
    for episode, rows in enumerate(recording.rows.tolist()):
        own, first = slice(first, first + rows), first + rows
        name = f"recording {recording.names[episode]!r}: " if len(recording.names) > 1 else ""
        time = recording.seconds[episode, :rows]
        truth = None if recording.truth is None else recording.truth[episode, :rows]
        try:
            if usual is not None and rows > 1:
                check_interval(float(numpy.median(numpy.diff(time))), 100.0 * usual)
            if seen is not None and measured:
                there = numpy.isfinite(seen[measured, own]).all(axis=0)
                position, deviation = seen[measured, own].T[there], _length(sigma[measured, own].T[there])
            known = len(measured) > 0 and there.sum() >= 3
            if known:
                _check_scale(time[there], position, deviation, speeds, moving, known_unit)
            if truth is not None and rows >= 3:
                _check_truth(time, truth, [component.name for component in task.components])
            if not known:
                continue
            if truth is not None:
                _check_apart(position, truth[there][:, measured], deviation)
            found = _notes(time[there], position, deviation, 1 + numpy.flatnonzero(there), moving)
        except ValueError as error:
            raise ValueError(f"{name}{error}") from error
        notes += [f"{name}{note}" for note in found]
    return limit_notes(notes)


def limit_notes(notes: list[str]) -> list[str]:
    """Return the first ``MOST_NOTES`` notes, and one with the number of the others."""
    more = [f"and {len(notes) - MOST_NOTES:,} more notes"] * (len(notes) > MOST_NOTES)
    return [*notes[:MOST_NOTES], *more]


def _check_truth(time: numpy.ndarray, truth: numpy.ndarray, names: list[str]) -> None:
    pairs = [
        (i, names.index(rate))
        for i, name in enumerate(names)
        for rate in (name.replace("position", "velocity"), f"{name}_rate")
        if rate != name and rate in names
    ]
    if pairs:
        places, rates = map(list, zip(*pairs, strict=True))
        what = ", ".join(f"truth_{names[i]}" for i in rates)
        known = numpy.isfinite(truth[:, [*places, *rates]]).all(axis=1)
        if known.sum() >= 3:
            check_velocity(what, time[known], truth[known][:, places], truth[known][:, rates])


def _check_apart(position: numpy.ndarray, truth: numpy.ndarray, sigma: numpy.ndarray) -> None:
    known = numpy.isfinite(truth).all(axis=1)
    if not known.any():
        return
    position, truth, sigma = position[known], truth[known], sigma[known]
    apart = float(numpy.median(_length(position - truth)))
    if apart > 100.0 * float(numpy.median(sigma)):
        ratio = float(numpy.median(_length(truth)) / numpy.median(_length(position)))
        cause = "kilometres" if 0.5 < 1e3 * ratio < 2.0 else "metres, of the same origin and the same clock"
        raise ValueError(f"truth lies {apart:,.0f} m from the measured positions: is it {cause}?")


def _check_scale(
    time: numpy.ndarray,
    position: numpy.ndarray,
    sigma: numpy.ndarray,
    speeds: tuple[float, float],
    moving: bool,
    known_unit: bool,
) -> None:
    check_speed(time, position, speeds, float(numpy.median(sigma)), moving)
    if len(time) < FEWEST or known_unit:
        return
    # From first to last position: between neighbours the speed may be mostly noise.
    speed = float(_length(position[-1] - position[0]) / (time[-1] - time[0]))
    noise = 1.4826 * float(numpy.median(numpy.abs(_deviations(time, position))))
    stated = float(numpy.median(sigma)) / math.sqrt(position.shape[1])
    if noise > LARGEST_SCATTER_RATIO * stated:
        raise ValueError(
            f"positions scatter by {noise:.3g} m where {stated:.2g} m are stated: are the deviations metres? else "
            "leave them out, and they are fitted"
        )
    if 0.25 < 1e3 * noise / stated < 4.0 and speed < 1.0 <= 1e3 * speed <= speeds[1]:
        raise ValueError(
            f"positions scatter by {noise:.2g} m where {stated:.3g} m are stated, at a speed of {speed:.2g} m/s: "
            "are they kilometres? else state their deviation"
        )


def _notes(
    time: numpy.ndarray, position: numpy.ndarray, sigma: numpy.ndarray, number: numpy.ndarray, moving: bool
) -> list[str]:
    """Return notes on the measured positions of one episode; ValueError if the clock jumped, not the target."""
    moved, steps = _length(numpy.diff(position, axis=0)), numpy.diff(time)
    step, error, notes = float(numpy.median(steps)), float(numpy.median(sigma)), []
    half = len(position) // 2
    extent = float(_length(position - numpy.median(position, axis=0)).max())
    moved_on = float(numpy.linalg.norm(position[half:].mean(axis=0) - position[:half].mean(axis=0)))
    still = extent < STANDING * error and moved_on < STANDING * error * 2.0 / math.sqrt(len(position))
    if moving and len(position) >= FEWEST and extent > 0.0 and still:
        notes.append(
            f"all positions lie within {extent:.3g} m, where errors of {error:.3g} m are stated: the target stands "
            "still, and this log contains no information about its motion"
        )
    for gap in numpy.flatnonzero(steps > max(10.0 * step, 60.0)).tolist():
        where = f"between measurements {number[gap]} and {number[gap + 1]}"
        usual = 3.0 * float(numpy.median(moved)) + 6.0 * error
        if moving and moved[gap] < usual < 0.3 * steps[gap] * float(numpy.median(moved / steps)):
            raise ValueError(
                f"{steps[gap]:,.0f} s pass {where}, in which the target moves {moved[gap]:,.0f} m: did the clock "
                "change, as in daylight saving time? Write times in UTC, or cut it there"
            )
        notes.append(f"nothing was received for {steps[gap]:,.0f} s {where}")
    # Compared with nearby steps, because noise varies along the track.
    around = numpy.pad(moved, (5, 4), mode="edge")
    nearby = numpy.median(numpy.lib.stride_tricks.sliding_window_view(around, 10), axis=1)

    def reach(elapsed: numpy.ndarray) -> numpy.ndarray:
        usual = numpy.maximum(nearby[: len(elapsed)], nearby[-len(elapsed) :])
        return numpy.asarray(
            5.0 * usual * (elapsed / step).clip(1.0) + 20.0 * error + 0.5 * LARGEST_ACCELERATION * elapsed**2
        )

    alone = find_outliers(time, position, reach)
    if alone.any():
        farthest = float(_length(_deviations(time, position)).max())
        notes.append(
            f"{_list_measurements(number[alone])} off the track, by up to {farthest:,.0f} m: an outlier decides every "
            "mean of likelihoods"
        )
    repeated = numpy.append(False, moved == 0.0)
    if repeated.any():
        notes.append(
            f"{_list_measurements(number[repeated])} the same as before: does the sensor repeat its last value?"
        )
    return notes


def _list_measurements(numbers: numpy.ndarray) -> str:
    shown = ", ".join(map(str, numbers[:5].tolist())) + ", ..." * (len(numbers) > 5)
    return f"measurement {shown} is" if len(numbers) == 1 else f"{len(numbers):,} measurements ({shown}) are"
