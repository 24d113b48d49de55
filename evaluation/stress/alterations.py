"""Alterations of measurements between the sensors and a filter, such as gaps, outliers and wrong clocks.

Each is a pure function of a :class:`.streams.Stream` and a generator of random numbers. It returns another
stream, or None where it does not apply.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy

from ...envs.contract.causes import Causes
from ...filters.smoothing import semidefinite_root
from .streams import Stream

SETTLED = 60
"""Number of measurements before the alteration."""
AFTERWARDS = 100
"""Number of measurements after a temporary alteration."""
LASTING = 200
"""Number of measurements of a stream with a lasting alteration."""
EVERY = 10
"""Period, in measurements, with which one is delivered twice or late."""

Function = Callable[[Stream, numpy.random.Generator], Stream | None]


class Alteration(NamedTuple):
    """One alteration of measurements: name, description and function."""

    name: str
    description: str
    function: Function
    length: int = SETTLED + LASTING
    """Number of measurements that the stream must have."""


def _cut(stream: Stream, begin: int, end: int | None) -> Stream:
    """Cut a stream some measurements after the end of a temporary or the beginning of a lasting alteration."""
    length = LASTING if end is None else end + AFTERWARDS
    return replace(stream.select(numpy.arange(min(length, len(stream)))), begin=begin, end=end)


def _unaltered(stream: Stream, generator: numpy.random.Generator) -> Stream:
    return stream


def _gap(scans: int) -> Function:
    def alter(stream: Stream, generator: numpy.random.Generator) -> Stream | None:
        """Remove measurements of a timed stream, else mark them as not received; None without such a mark."""
        if stream.is_timed:
            seconds = stream.seconds
            kept = numpy.r_[:SETTLED, SETTLED + scans : len(stream)]
            found = stream.select(kept).with_times(seconds[kept])
            return _cut(found.renumber(), SETTLED, SETTLED + 1)
        field = type(stream.task.world).received_field
        if not field:
            return None
        here = numpy.zeros(len(stream), dtype=bool)
        here[SETTLED : SETTLED + scans] = True
        available = stream.measurements.available.copy()
        available[here] = 0
        readings = stream.readings.copy()
        readings[here] = 0.0
        return _cut(stream.with_fields(**{field: readings, "available": available}), SETTLED, SETTLED + scans)

    return alter


def _jitter(stream: Stream, generator: numpy.random.Generator) -> Stream | None:
    if not stream.is_timed:
        return None
    interval = stream.measurements.interval
    shift = generator.uniform(-0.3, 0.3, interval.shape) * interval
    shift[:SETTLED] = 0.0
    return _cut(stream.with_times(stream.seconds + shift), SETTLED, None)


def _reordered(order: Callable[[int], list[int]]) -> Function:
    def alter(stream: Stream, generator: numpy.random.Generator) -> Stream | None:
        if not stream.is_timed:
            return None
        numbers = [*range(SETTLED)]
        for first in range(SETTLED, len(stream) - EVERY, EVERY):
            numbers += order(first)
        return _cut(stream.select(numbers).with_times(stream.seconds[numbers]).renumber(), SETTLED, None)

    return alter


def _stamped(change: Callable[[numpy.ndarray], numpy.ndarray], passes: bool = True) -> Function:
    """Return an alteration of the time stamps; ``change`` takes the times from index ``SETTLED - 1`` on."""

    def alter(stream: Stream, generator: numpy.random.Generator) -> Stream | None:
        if not stream.is_timed:
            return None
        seconds = stream.seconds.copy()
        seconds[SETTLED - 1 :] = change(seconds[SETTLED - 1 :].copy())
        return _cut(stream.with_times(seconds), SETTLED, SETTLED + 2 if passes else None)

    return alter


def _soon_after(seconds: float) -> Callable[[numpy.ndarray], numpy.ndarray]:
    def change(times: numpy.ndarray) -> numpy.ndarray:
        times[1] = times[0] + seconds
        return times

    return change


def _jump(times: numpy.ndarray) -> numpy.ndarray:
    times[1:] += 100.0 * (times[1] - times[0])
    return times


def _drift(times: numpy.ndarray) -> numpy.ndarray:
    return times[0] + 1.01 * (times - times[0])


def _outlier(sigmas: float) -> Function:
    def alter(stream: Stream, generator: numpy.random.Generator) -> Stream:
        readings = stream.readings.copy()
        signs = generator.choice([-1.0, 1.0], readings.shape[1:])
        readings[SETTLED] += sigmas * signs * stream.deviations[SETTLED]
        return _cut(stream.with_readings(readings), SETTLED, SETTLED + 1)

    return alter


def _wrong_noise(factor: float) -> Function:
    def alter(stream: Stream, generator: numpy.random.Generator) -> Stream | None:
        """Scale the noise covariance that measurements state, or else their errors; None where neither can
        be.
        """
        field = type(stream.task.world).stated_field
        if field:
            stated = getattr(stream.measurements, field).copy()
            stated[SETTLED:] *= factor if "variance" in field else factor**0.5
            return _cut(stream.with_fields(**{field: stated}), SETTLED, None)
        if factor > 1.0:
            return None
        readings = stream.readings.copy()
        more = generator.standard_normal(readings.shape) * stream.deviations * (1.0 / factor - 1.0) ** 0.5
        readings[SETTLED:] += more[SETTLED:]
        return _cut(stream.with_readings(readings), SETTLED, None)

    return alter


def _bias(stream: Stream, generator: numpy.random.Generator) -> Stream:
    readings = stream.readings.copy()
    readings[SETTLED:] += 3.0 * stream.deviations[SETTLED:]
    return _cut(stream.with_readings(readings), SETTLED, None)


def _frozen(stream: Stream, generator: numpy.random.Generator) -> Stream:
    readings = stream.readings.copy()
    readings[SETTLED : SETTLED + 20] = readings[SETTLED - 1]
    return _cut(stream.with_readings(readings), SETTLED, SETTLED + 20)


def _not_a_number(stream: Stream, generator: numpy.random.Generator) -> Stream | None:
    """Set one measurement to NaN; None for an environment whose measurements cannot be missing."""
    if not type(stream.task.world).received_field:
        return None
    readings = stream.readings.copy()
    readings[SETTLED] = numpy.nan
    return _cut(stream.with_readings(readings), SETTLED, SETTLED + 1)


def _initial_covariance(factor: float) -> Function:
    def alter(stream: Stream, generator: numpy.random.Generator) -> Stream:
        covariance = factor * stream.initial.covariance
        return _cut(replace(stream, initial=stream.initial._replace(covariance=covariance)), 0, 1)

    return alter


def _restart(stream: Stream, generator: numpy.random.Generator) -> Stream:
    """Start in the middle of a stream, from the truth there with errors of the initial covariance."""
    before, initial = stream.at(SETTLED - 1), stream.initial
    root = semidefinite_root(initial.covariance)
    errors = numpy.einsum("ijn,jn->in", root, generator.standard_normal(initial.mean.shape))
    others = {}
    for name, value in initial._asdict().items():
        if name not in ("mean", "covariance"):
            # The other initial values are the measurement there, or one of its fields.
            others[name] = before if isinstance(value, type(before)) else getattr(before, name, value)
    begun = initial._replace(mean=stream.truth[SETTLED - 1] + errors, **others)
    later = stream.select(numpy.arange(SETTLED, len(stream)))
    return _cut(replace(later, initial=begun).renumber(), Causes.of(stream.task).start, 1)


def _rounded(stream: Stream, generator: numpy.random.Generator) -> Stream:
    def rounded(values: Any) -> Any:
        return values.astype(numpy.float32).astype(float) if values.dtype.kind == "f" else values

    readings = stream.readings.astype(numpy.float32).astype(float)
    initial = stream.initial._replace(
        mean=rounded(stream.initial.mean), covariance=rounded(stream.initial.covariance)
    )
    return _cut(replace(stream.with_readings(readings), initial=initial), 0, None)


ALTERATIONS: tuple[Alteration, ...] = (
    Alteration("as-measured", "nothing is altered", _unaltered),
    *(
        Alteration(
            f"gap-{scans}",
            f"nothing is received for {scans:,} scans",
            _gap(scans),
            SETTLED + scans + AFTERWARDS,
        )
        for scans in (10, 100, 1000)
    ),
    Alteration("jitter", "time stamps are off by up to 30 % of the interval", _jitter),
    Alteration(
        "duplicates",
        f"every {EVERY}th measurement is delivered twice",
        _reordered(lambda i: [i, *range(i, i + EVERY)]),
    ),
    Alteration(
        "out-of-order",
        f"every {EVERY}th measurement is delivered after the next one",
        _reordered(lambda i: [i + 1, i, *range(i + 2, i + EVERY)]),
    ),
    Alteration("zero-interval", "two measurements have the same time", _stamped(_soon_after(0.0))),
    Alteration("tiny-interval", "two measurements are 1 µs apart", _stamped(_soon_after(1e-6))),
    Alteration("clock-jump", "the clock jumps ahead by 100 intervals", _stamped(_jump)),
    Alteration("clock-drift", "the clock runs 1 % fast", _stamped(_drift, passes=False)),
    *(
        Alteration(f"outlier-{sigmas:g}", f"one measurement is off by {sigmas:g} sigma", _outlier(sigmas))
        for sigmas in (5.0, 50.0, 1e6)
    ),
    Alteration("noise-100", "R is 100 times what is stated", _wrong_noise(0.01)),
    Alteration("noise-0.01", "R is a hundredth of what is stated", _wrong_noise(100.0)),
    Alteration("bias", "readings are off by 3 sigma, always", _bias),
    Alteration("frozen", "readings stand still for 20 measurements", _frozen),
    Alteration("nan", "one measurement is NaN", _not_a_number),
    Alteration(
        "tight-start", "the initial covariance is 1e-6 of what it should be", _initial_covariance(1e-6)
    ),
    Alteration(
        "vague-start", "the initial covariance is 1e6 times what it should be", _initial_covariance(1e6)
    ),
    Alteration("restart", "the track begins anew in the middle", _restart),
    Alteration("rounded-readings", "readings and start are rounded to single precision", _rounded),
)
"""All alterations, in the order of the table of results."""
