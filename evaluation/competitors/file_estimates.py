"""Estimates in a file as a competitor: those of another program on the same measurements.

A row of the file belongs to a measurement by its track and its time. A measurement without a row counts as
missing and has the estimate of the last row, or the initial one. Soon after a track's last row the episode is
lost.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy

from ...envs.contract.filter import Filter, FilterInput, ReportedParts
from ...envs.contract.observation import Array
from ...envs.contract.task import Task
from ...envs.logs.flight_tables import clock_seconds, describe_time
from ..storage.dataset import NO_ROW
from ..storage.estimate_tables import EstimateTable, read_estimates
from .kinds import Competitor

SAME_TIME = 1e-3
"""Largest difference of the times of a row and its measurement, s; no more than a quarter of the sampling interval."""
ENDED = 10
"""Number of sampling intervals after the last row of a track, after which it is lost: some programs estimate less
often.
"""
LEAST_SHARE = 0.5
"""Least share of measurements with a row; with fewer the times must belong to another clock or another log."""
SINCE_FIRST = "since its first measurement"
"""Name of the clock that starts with the first measurement of a log, in error messages."""
SHOWN = 5
"""Maximal number of track names in an error message."""


class FileEstimates:
    """Maker of a competitor from a file of estimates, see :mod:`..storage.estimate_tables`."""

    kind = "estimator"

    def __init__(self, path: Path) -> None:
        self.path = path

    def of_tracks(self, task: Task, tracks: Mapping[int, str]) -> "TrackEstimates":
        """Read the file; return its estimates for the tracks of an evaluation.

        Args:
            task: task of the evaluation, on NumPy arrays.
            tracks: name of each track, by the seed of its episode.

        Raises:
            ValueError: for a file that cannot be read, or does not match the evaluation.
        """
        name = str(self.path)
        table = read_estimates(self.path, [component.name for component in task.components])
        held, known = sorted({*table.track.tolist()}), {*tracks.values()}
        if held == [""] and len(known) > 1:
            raise ValueError(f"{name} names no tracks in a column track, and there are {len(known)}")
        if held != [""] and not known & {*held}:
            raise ValueError(
                f"{name} has the tracks {', '.join(held[:SHOWN])}{', ...' * (len(held) > SHOWN)}, and those of the "
                f"evaluation are {', '.join([*tracks.values()][:SHOWN])}{', ...' * (len(known) > SHOWN)}"
            )
        nothing = numpy.where(table.known, 0.0, numpy.nan)[:, None] + numpy.zeros(8)
        if task.has_truth and not numpy.isfinite(task.world.error_cost(nothing)).all():
            missing = [c.name for c, there in zip(task.components, table.known, strict=True) if not there]
            raise ValueError(f"{name} lacks {', '.join(missing)}, which the cost of {task.id} needs")
        return TrackEstimates(table, dict(tracks), _recorded_times(task, table, name))


class TrackEstimates(NamedTuple):
    """Estimates of a file for the tracks of an evaluation, as plain data for any process."""

    table: EstimateTable
    tracks: Mapping[int, str]
    times: Mapping[str, numpy.ndarray] | None
    """Times of a recording's measurements by track, s by the clock of the file; None for a simulation."""
    kind: str = "estimator"

    def of_episodes(self, task: Task, seeds: Sequence[int]) -> "FileTrack":
        """Return a filter whose estimates are the file's rows, for the episodes with these seeds."""
        return FileTrack(task, self, [self.tracks[seed] for seed in seeds])


def _recorded_times(task: Task, table: EstimateTable, name: str) -> dict[str, numpy.ndarray] | None:
    """Return a recording's measurement times by track, s by the estimates' clock; None in a simulation."""
    import pandas

    recording = task.recording
    if recording is None:
        if table.clock != "seconds":
            raise ValueError(f"the times of {name} are {table.clock}, but those of a simulation are seconds")
        _check_simulated(task, table, name)
        return None
    log_clock, clocks = "seconds", {}
    if recording.log_time is not None:
        found = [
            (track, *clock_seconds(pandas.Series(written[:rows])))
            for track, rows, written in zip(recording.names, recording.rows, recording.log_time, strict=True)
        ]
        log_clock = found[0][1]
        clocks["by the log"] = {track: time for track, _, time in found}
    if table.clock in ("seconds", "log"):
        # For a log in seconds both clocks are possible; a column with the name of the log's time decides for the log's
        # clock.
        since = recording.seconds + recording.started[:, None]
        elapsed = zip(recording.names, since, recording.rows, strict=True)
        clocks = {
            SINCE_FIRST: {track: time[:rows] for track, time, rows in elapsed},
            **(clocks if log_clock == "seconds" else {}),
        }
        if table.clock == "log":
            clocks = dict(reversed(clocks.items()))
    elif log_clock != table.clock:
        raise ValueError(f"the times of {name} are {table.clock}, and those of the log {log_clock}")
    tolerance = _time_tolerance(task)
    shares = {which: _share_found(table, times, tolerance) for which, times in clocks.items()}
    best = max(shares, key=lambda which: shares[which])
    if shares[best] < LEAST_SHARE:
        spans = (f"{_span([*times.values()], table.clock)} {which}" for which, times in clocks.items())
        raise ValueError(
            f"{100.0 * shares[best]:.0f} % of the measurements have a row in {name} within {tolerance:.3g} s, "
            f"but {100.0 * LEAST_SHARE:.0f} % must have one: its times are from {_span([table.time], table.clock)}, "
            f"those of the log from {', or from '.join(spans)}"
        )
    return clocks[best]


def _time_tolerance(task: Task) -> float:
    return min(SAME_TIME, 0.25 * _usual_interval(task))


def _usual_interval(task: Task) -> float:
    return getattr(task.parameters, "sampling_interval", None) or task.interval or 1.0


def _check_simulated(task: Task, table: EstimateTable, name: str) -> None:
    """Raise ValueError if most times of the file are not within twice the length of a simulated episode."""
    end = (task.horizon + 1) * _usual_interval(task)
    if numpy.mean((table.time >= 0.0) & (table.time <= 2.0 * end)) < LEAST_SHARE:
        raise ValueError(
            f"the times of {name} are from {_span([table.time], 'seconds')}, those of an episode from 0 to {end:g} s"
        )


def _span(times: Sequence[numpy.ndarray], clock: str) -> str:
    return " to ".join(
        describe_time(clock, time) for time in (min(t.min() for t in times), max(t.max() for t in times))
    )


def _share_found(table: EstimateTable, times: Mapping[str, numpy.ndarray], tolerance: float) -> float:
    """Return the share of a recording's measurements that have a row of the file."""
    found = total = 0
    for track, time in times.items():
        rows = numpy.sort(table.time if {*table.track} == {""} else table.time[table.track == track])
        at = numpy.searchsorted(rows, time + tolerance, side="right") - 1
        found += int(((at >= 0) & (rows[numpy.maximum(at, 0)] >= time - tolerance)).sum()) if len(rows) else 0
        total += len(time)
    return found / max(total, 1)


class FileState(NamedTuple):
    """State of a :class:`FileTrack`: the present row of the file for each episode."""

    measurements: int
    """Number of measurements so far."""
    seconds: numpy.ndarray
    """Time of the last measurement, s, ``(N,)``."""
    row: numpy.ndarray
    """Index of the row with the present estimate, ``(N,)``; -1 before the first."""
    missing: numpy.ndarray
    """One where the file has no row for this measurement, ``(N,)``."""
    over: numpy.ndarray
    """One where the file has no more rows of this track, ``(N,)``."""
    initial: Any


class FileTrack(Filter[Task, Any, FileState]):
    """Filter whose estimates are the rows of a file; ``names`` are the tracks of its episodes."""

    in_python = True

    def __init__(self, task: Task, estimates: TrackEstimates, names: Sequence[str]) -> None:
        super().__init__(task)
        table = estimates.table
        self.estimates = estimates
        self.names: list[str] = list(names)
        self.stated: ReportedParts | None = ReportedParts(table.known, table.deviations)
        held = {name: numpy.flatnonzero(table.track == name) for name in {*names}}
        if {*table.track.tolist()} == {""}:
            held = {name: numpy.arange(len(table.time)) for name in held}
        # All rows in one array, each track in a separate interval of time, so that one search finds all.
        self._begin = float(table.time.min(initial=0.0))
        self._span = float(table.time.max(initial=0.0)) - self._begin + 2.0
        order, keys, self._last = [], [], []
        for number, name in enumerate(self.names):
            rows = held[name][numpy.argsort(table.time[held[name]], kind="stable")]
            order.append(rows)
            keys.append(table.time[rows] - self._begin + number * self._span)
            self._last.append(table.time[rows[-1]] if len(rows) else -numpy.inf)
        self._order, self._keys = numpy.concatenate(order), numpy.concatenate(keys)
        self._first = numpy.cumsum([0, *map(len, order)])[:-1]
        self._interval, self._tolerance = _usual_interval(task), _time_tolerance(task)

    def start(self, initial: Any) -> FileState:
        """Return the state before the first row of the file."""
        width = initial.mean.shape[-1]
        none = numpy.zeros(width)
        return FileState(0, none, numpy.full(width, -1), none, none, initial)

    def update(self, state: FileState, inputs: FilterInput) -> FileState:
        """Select each episode's newest row of the file that is not later than the measurement; return the
        state.
        """
        width = inputs.measurement[0].shape[-1]
        lane = numpy.minimum(numpy.arange(width), len(self.names) - 1)
        seconds = self._times(state, inputs.measurement)
        at = numpy.clip(seconds - self._begin + self._tolerance, 0.0, self._span - 0.5)
        found = numpy.searchsorted(self._keys, at + lane * self._span, side="right") - 1
        there = found >= self._first[lane]
        row = numpy.where(there, self._order[numpy.maximum(found, 0)], -1) if len(self._order) else state.row
        fresh = there & (self.estimates.table.time[row] >= seconds - self._tolerance)
        over = seconds > numpy.array(self._last)[lane] + (ENDED - 0.5) * self._interval
        return FileState(state.measurements + 1, seconds, row, 1.0 - fresh, 1.0 * over, state.initial)

    def _times(self, state: FileState, measurement: Any) -> numpy.ndarray:
        """Return the time of each episode's measurement, s by the clock of the file, ``(N,)``."""
        width = measurement[0].shape[-1]
        if self.estimates.times is None:
            interval = getattr(measurement, "interval", None)
            return state.seconds + (self._interval if interval is None else interval)
        each = [self.estimates.times[name] for name in self.names]
        now = [times[min(state.measurements, len(times) - 1)] for times in each]
        # Beyond the end of a shorter recording its last measurement is repeated.
        now = [
            times[numpy.isfinite(times)][-1] if numpy.isnan(t) else t
            for t, times in zip(now, each, strict=True)
        ]
        return numpy.array(now)[numpy.minimum(numpy.arange(width), len(now) - 1)]

    def mean(self, state: FileState) -> Array:
        """Return the mean in the selected row, ``(C, N)``; before the first row the initial one."""
        unknown = ~numpy.array(self.estimates.table.known)[:, None]
        initial = numpy.where(unknown, numpy.nan, state.initial.mean)
        return numpy.where(state.row >= 0, self.estimates.table.mean[:, state.row], initial)

    def covariance(self, state: FileState) -> Array:
        """Return the covariance in the selected row, ``(C, C, N)``; NaN where the file contains none."""
        unknown = ~numpy.logical_and.outer(*2 * [self.estimates.table.deviations])[:, :, None]
        initial = numpy.where(unknown, numpy.nan, state.initial.covariance)
        return numpy.where(state.row >= 0, self.estimates.table.covariance[..., state.row], initial)

    def records(self, state: FileState, measurement: Any) -> dict[str, Array]:
        """Return the row's likelihood statistics by name, and whether the row is missing or the track has
        ended.
        """
        numbers = {
            name: numpy.where(state.missing > 0.0, numpy.nan, values[state.row])
            for name, values in self.estimates.table.likelihood.items()
        }
        return {**numbers, "missing": state.missing, "lost": state.over * NO_ROW}


def find_estimates(name: str, path: str, problem: Any, find: Any) -> Competitor:
    """Return the competitor for the name ``file:PATH``, with the estimates of that file."""
    return Competitor(name, FileEstimates(Path(path).absolute()))
