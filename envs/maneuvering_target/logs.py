"""Tables of a user's radar plots, read as measurements of ManeuveringTarget.

x is east and y is north of the radar; an azimuth is counted clockwise from north. Latitude and longitude, of a
receiver, become x and y around the first of them. The track starts from the first two plots, equation (24): the
position of the second, and the difference of both over the time between them, with the covariance that follows.
"""

from collections.abc import Mapping
from typing import Any

import numpy

from ...filters import polar
from ..contract.log_format import (
    NO_DEVIATIONS,
    Column,
    LogFormat,
    PlotRows,
    PredictedCoordinate,
    TrackLog,
    TrackStart,
    deviation_words,
    is_assumed,
)
from ..logs.plausibility import check_bearings, scatter_of
from ..logs.recorded_tables import Columns
from .parameters import ManeuveringTargetParameters

COLUMNS = {
    "x": Column("m, east of the radar"),
    "y": Column("m, north of it"),
    "range": Column("m, in place of x and y"),
    "azimuth": Column("degrees clockwise from north"),
    "latitude": Column("degrees, in place of x and y"),
    "longitude": Column("degrees"),
    "altitude": Column("m above the ellipsoid, beside them; optional"),
    "sigma_x": Column(
        "m, standard deviation of x; optional, default: the parameter range_sigma, else how positions scatter"
    ),
    "sigma_y": Column("m"),
    "range_sigma": Column("m, standard deviation of the range; optional, default: the parameter"),
    "azimuth_sigma": Column("degrees, of the azimuth; default: the parameter bearing_sigma"),
    "odometry_x": Column(
        "m, moved east since the row before, by a second sensor such as wheels and a compass; optional"
    ),
    "odometry_y": Column("m, moved north"),
    "odometry_speed": Column("m/s, in place of both: the speed by that sensor"),
    "odometry_heading": Column("degrees clockwise from north"),
}
FINER = 10.0
"""Ratio of a stated deviation to the resolution of positions above which noise does not repeat a position by chance."""
PAIRS = (
    ("x", "y"),
    ("range", "azimuth"),
    ("sigma_x", "sigma_y"),
    ("range_sigma", "azimuth_sigma"),
    ("odometry_x", "odometry_y"),
    ("odometry_speed", "odometry_heading"),
)
FARTHEST_RANGE = 500e3
"""Largest range, m; a larger one is taken for a wrong unit."""
LARGEST_GAP = 1000
"""Largest number of scans missing between two rows; a larger one is taken for a wrong unit."""


def read_log(columns: Columns) -> TrackLog:
    """Return the measurements of one track from the columns of a table of plots.

    Raises:
        ValueError: for missing or impossible values. Scans without a plot are missing measurements.
    """
    for pair in PAIRS:
        if sum(columns.has(name) for name in pair) == 1:
            lacking = next(name for name in pair if not columns.has(name))
            raise ValueError(f"it lacks the column {lacking}, which belongs to {' and '.join(pair)}")
    position = _positions(columns)
    there = numpy.asarray(numpy.isfinite(position).all(axis=1))
    if numpy.isfinite(position[~there]).any():
        row = int(numpy.flatnonzero(numpy.isfinite(position).any(axis=1) & ~there)[0])
        raise ValueError(f"row {row} has one coordinate of two")
    assumed = _assume_deviation(columns, position[there], columns.time[there])
    variance = _variances(columns, position, there, assumed)
    said_deviations, deviations_from = _deviations_of(columns, there, assumed)
    stale = _find_stale(columns, position, numpy.sqrt(variance))
    there &= ~stale
    farthest = float(numpy.hypot(*position[there].T).max(initial=0.0))
    if farthest > FARTHEST_RANGE:
        raise ValueError(
            f"a plot lies {farthest / 1e3:,.0f} km from the radar, whose range ends at {FARTHEST_RANGE / 1e3:,.0f} km "
            "(positions are metres)"
        )
    plots = numpy.flatnonzero(there)
    if len(plots) < 3:
        raise ValueError(
            f"it has {len(plots)} plot{'s' * (len(plots) != 1)}: the track starts from the first two and needs a third"
        )
    first = plots[1]
    initial = two_plot_start(position[plots[:2]], variance[plots[:2]], numpy.diff(columns.time[plots[:2]]))
    parameters: dict[str, Any] = {}
    interval = columns.interval()
    rows, time = _scans(columns, int(first), interval)
    if "sampling_interval" not in columns.user_parameters:
        parameters["sampling_interval"] = interval
    seen = (rows >= 0) & there[rows]
    nominal = (
        assumed or columns.user_parameters.get("range_sigma", ManeuveringTargetParameters.range_sigma)
    ) ** 2
    found = {
        "scan": numpy.arange(1.0, len(rows) + 1.0),
        "position": numpy.where(seen[:, None], position[rows], 0.0),
        "variance": numpy.where(seen[:, None], variance[rows], nominal),
        "available": seen.astype(float),
        **_clocks(numpy.append(columns.time[first], time), seen),
        **_odometry(columns, rows),
    }
    return TrackLog(
        found,
        initial,
        rows,
        parameters,
        float(columns.time[first]),
        time,
        (
            *_assumption_notes(columns, said_deviations, deviations_from),
            *_stale_notes(stale),
            *_gap_notes(rows),
        ),
        {"range_sigma": said_deviations["sigma_x"]} if assumed else _typical_sigma(columns, there),
        said_deviations,
        deviations_from,
    )


def _typical_sigma(columns: Columns, there: numpy.ndarray) -> dict[str, float]:
    """Return the median stated deviation as ``range_sigma``; empty if none is stated or it equals the radar's.

    Agents observe deviations relative to it, and errors cost in units of its square.
    """
    names = ["sigma_x", "sigma_y"] if columns.has("sigma_x", "sigma_y") else ["range_sigma"]
    if not columns.has(*names):
        return {}
    median = float(f"{numpy.nanmedian([columns[name][there] for name in names]):.6g}")
    return {} if median == ManeuveringTargetParameters.range_sigma else {"range_sigma": median}


def _find_stale(columns: Columns, position: numpy.ndarray, sigma: numpy.ndarray) -> numpy.ndarray:
    """Return booleans ``(rows,)``: positions that repeat the previous row's and are no new measurement.

    A receiver at rest may report the same numbers again. So they are stale only where noise of the stated size, in the
    resolution of the numbers, would hardly ever repeat both.
    """
    measured = position
    if columns.origin is not None:  # x and y change with altitude, too
        across = 111e3 * numpy.cos(numpy.radians(columns.origin.latitude))
        measured = numpy.stack([across * columns["longitude"], 111e3 * columns["latitude"]], axis=1)
    stale = numpy.zeros(len(position), dtype=bool)
    there = numpy.flatnonzero(numpy.isfinite(position).all(axis=1))
    repeated = (numpy.diff(measured[there], axis=0) == 0.0).all(axis=1)
    if repeated.any():
        # Of two different numbers the nearest: what a column is written in, or finer.
        finest = [numpy.diff(numpy.unique(values)).min(initial=numpy.inf) for values in measured[there].T]
        if (numpy.median(sigma[there], axis=0) >= FINER * numpy.array(finest)).all():
            stale[there[1:]] = repeated
    return stale


def _stale_notes(stale: numpy.ndarray) -> tuple[str, ...]:
    count = int(stale.sum())
    if not count:
        return ()
    what = "row repeats" if count == 1 else "rows repeat"
    return (
        f"{count:,} {what} the position of the row before: left out as measurements, the first is row {stale.argmax()}",
    )


def _gap_notes(rows: numpy.ndarray) -> tuple[str, ...]:
    count = int((rows < 0).sum())
    return (
        (
            f"{count:,} missed measurement{'s' * (count > 1)}: {'these have' if count > 1 else 'it has'} no row",
        )
        if count
        else ()
    )


def two_plot_start(
    position: numpy.ndarray, variance: numpy.ndarray, lasted: numpy.ndarray
) -> dict[str, numpy.ndarray]:
    """Return the initial mean and covariance by name from two plots: the second, and the velocity between both.

    Args:
        position: positions of the two plots, ``(..., 2, 2)``, m.
        variance: of their errors, m^2, same shape.
        lasted: s, ``(..., 1)``.
    """
    before, first = position[..., 0, :], position[..., 1, :]
    covariance = numpy.zeros((*first.shape[:-1], 4, 4))
    shared = variance[..., 1, :] / lasted
    for axis in range(2):
        covariance[..., axis, axis] = variance[..., 1, axis]
        covariance[..., axis, axis + 2] = covariance[..., axis + 2, axis] = shared[..., axis]
        covariance[..., axis + 2, axis + 2] = variance[..., axis].sum(axis=-1) / lasted[..., 0] ** 2
    mean = numpy.concatenate([first, (first - before) / lasted], axis=-1)
    return {"mean": mean, "covariance": covariance}


def start_track(
    measurements: Mapping[str, numpy.ndarray], seconds: numpy.ndarray, parameters: Any
) -> TrackStart:
    """Return the start of every episode of a log, from its first two plots.

    Raises:
        ValueError: if there are fewer.
    """
    if seconds.shape[1] < 3 or not numpy.isfinite(seconds[:, :3]).all():
        raise ValueError("an episode without initial_mean starts from its first two plots, and needs a third")
    if not (measurements["available"][:, :2] > 0.0).all():
        raise ValueError(
            "an episode without initial_mean starts from its first two scans, and one has no plot"
        )
    initial = two_plot_start(
        measurements["position"][:, :2], measurements["variance"][:, :2], numpy.diff(seconds[:, :2])
    )
    later = {name: values[:, 2:] for name, values in measurements.items()}
    later["scan"] = later["scan"] - measurements["scan"][:, 1:2]
    return TrackStart(later, initial, 2)


def _positions(columns: Columns) -> numpy.ndarray:
    """Return x and y of the plots, ``(rows, 2)``, m; NaN where there is no plot."""
    if columns.has("x", "y"):
        return numpy.stack([columns["x"], columns["y"]], axis=1)
    if not columns.has("range", "azimuth"):
        raise ValueError(
            "it needs x and y (m), or range (m) and azimuth (degrees clockwise from north), or latitude and longitude "
            "(degrees)"
        )
    distance, azimuth = columns["range"], numpy.radians(columns["azimuth"])
    if (distance < 0.0).any():
        row = int(numpy.argmax(distance < 0.0))
        raise ValueError(f"range is a distance, and row {row} has {distance[row]:g} m")
    stated = columns.user_parameters.get("bearing_sigma", ManeuveringTargetParameters.bearing_sigma)
    sigma = (
        float(numpy.nanmedian(columns["azimuth_sigma"])) if columns.has("azimuth_sigma") else float(stated)
    )
    columns.notes += check_bearings("azimuth", columns.time, columns["azimuth"], sigma)
    return numpy.ascontiguousarray(east_north(distance, azimuth).T)


def east_north(length: numpy.ndarray, angle: numpy.ndarray) -> numpy.ndarray:
    """Return vectors east and north, ``(2, n)``, of lengths and angles clockwise from north, rad, ``(n,)``."""
    return numpy.stack([length * numpy.sin(angle), length * numpy.cos(angle)])


def _assume_deviation(columns: Columns, position: numpy.ndarray, time: numpy.ndarray) -> float:
    """Return the assumed deviation of x and y, m; zero if a column states it or the plots are polar.

    It is that of ``--set range_sigma``, else the scatter of positions about the line through their neighbours, which
    motion can only increase.
    """
    if not columns.has("x") or columns.has("sigma_x") or columns.has("range_sigma"):
        return 0.0
    if "range_sigma" in columns.user_parameters:
        return float(columns.user_parameters["range_sigma"])
    return float(f"{scatter_of(time, position):.3g}") if len(time) >= 3 else 0.0


def _deviations_of(columns: Columns, there: numpy.ndarray, assumed: float) -> tuple[dict[str, float], str]:
    pairs = ("sigma_x", "sigma_y"), ("range_sigma", "azimuth_sigma")
    for pair in pairs:
        if columns.has(*pair):
            medians = {name: float(f"{numpy.nanmedian(columns[name][there]):.6g}") for name in pair}
            return medians, f"columns {pair[0]} and {pair[1]}"
    if assumed:
        named = "range_sigma" in columns.user_parameters
        who = "as --set range_sigma states" if named else "as positions scatter about their neighbours"
        return dict.fromkeys(pairs[0], assumed), f"{NO_DEVIATIONS} of x and y, assumed {who}"
    names = {"range_sigma": "range_sigma", "azimuth_sigma": "bearing_sigma"}
    values = {
        column: float(columns.user_parameters.get(name, getattr(ManeuveringTargetParameters, name)))
        for column, name in names.items()
    }
    return values, f"{NO_DEVIATIONS}, assumed as of the environment's radar"


def _assumption_notes(columns: Columns, deviations: Mapping[str, float], source: str) -> list[str]:
    if not is_assumed(source) or "range_sigma" in columns.user_parameters:
        return []
    return [f"{source}: {deviation_words(deviations)}"]


def _variances(
    columns: Columns, position: numpy.ndarray, there: numpy.ndarray, assumed: float = 0.0
) -> numpy.ndarray:
    """Return the variances of x and y, ``(rows, 2)``, m^2; NaN without a plot. ``assumed`` is a deviation, m."""
    variance = numpy.full(position.shape, numpy.nan)
    if columns.has("sigma_x", "sigma_y"):
        variance[there] = columns.only(there).sigmas("sigma_x", "sigma_y") ** 2
        return variance
    if assumed:
        variance[there] = assumed**2
        return variance
    if columns.has("range_sigma", "azimuth_sigma"):
        sigmas = columns.only(there).sigmas("range_sigma", "azimuth_sigma").T
    else:
        names = ("range_sigma", "bearing_sigma")
        sigmas = numpy.array(
            [
                float(columns.user_parameters.get(name, getattr(ManeuveringTargetParameters, name)))
                for name in names
            ]
        )
    variance[there] = polar.cartesian_variances(position[there].T, sigmas[0], numpy.radians(sigmas[1])).T
    return variance


def _scans(columns: Columns, first: int, interval: float) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return row and time of every scan after the start; scans inserted evenly into gaps have row -1."""
    before, now = columns.time[first:-1], columns.time[first + 1 :]
    scans = numpy.maximum(numpy.rint((now - before) / interval).astype(int), 1)
    if scans.max() > LARGEST_GAP + 1:
        gap = int(numpy.argmax(scans > LARGEST_GAP + 1))
        raise ValueError(
            f"{now[gap] - before[gap]:g} s lie between rows {first + gap} and {first + gap + 1}, {scans[gap] - 1:,} "
            f"intervals of {interval:g} s: cut it"
        )
    step = numpy.repeat(numpy.arange(len(scans)), scans)
    number = numpy.arange(1, len(step) + 1) - (numpy.cumsum(scans) - scans)[step]
    between = before[step] + (now - before)[step] * number / scans[step]
    last = number == scans[step]
    return numpy.where(last, first + 1 + step, -1), numpy.where(last, now[step], between)


def _clocks(time: numpy.ndarray, seen: numpy.ndarray) -> dict[str, numpy.ndarray]:
    import pandas

    last = pandas.Series(numpy.where([True, *seen], time, numpy.nan)).ffill().to_numpy()[:-1]
    return {"interval": numpy.diff(time), "elapsed": time[1:] - last}


def _odometry(columns: Columns, rows: numpy.ndarray) -> dict[str, numpy.ndarray]:
    """Return the displacement between scans by a second sensor, by name; empty if there is none.

    For a scan without a row, -1, the displacement until the next row is divided evenly.
    """
    moved = _displacements(columns)
    if moved is None:
        return {}
    import pandas

    ends = pandas.Series(numpy.where(rows >= 0, rows, numpy.nan)).bfill().to_numpy().astype(int)
    there = numpy.asarray(numpy.isfinite(moved).all(axis=1))
    if not there[ends].any():
        raise ValueError("the columns of the odometry are empty: fill them, or leave them out")
    shares = numpy.where(there[:, None], moved, 0.0)[ends] / numpy.bincount(ends)[ends][:, None]
    return {"odometry_displacement": shares, "odometry_available": there[ends].astype(float)}


def _displacements(columns: Columns) -> numpy.ndarray | None:
    """Return the second sensor's displacement since the previous row, m, ``(rows, 2)``; None if there is no sensor."""
    if columns.has("odometry_x", "odometry_speed"):
        raise ValueError("it has odometry_x and odometry_speed: leave one of them out")
    if columns.has("odometry_x"):
        return numpy.stack([columns["odometry_x"], columns["odometry_y"]], axis=1)
    if not columns.has("odometry_speed"):
        return None
    heading = numpy.radians(columns["odometry_heading"])
    velocity = numpy.ascontiguousarray(east_north(columns["odometry_speed"], heading).T)
    moved = numpy.full_like(velocity, numpy.nan)
    moved[1:] = 0.5 * numpy.diff(columns.time)[:, None] * (velocity[:-1] + velocity[1:])
    return moved


def scale_noise(measurement: Any, factor: Any) -> Any:
    """Return a measurement whose stated standard deviations are multiplied by a factor."""
    return measurement._replace(variance=measurement.variance * factor**2)


def predict_position(mean: Any, measurement: Any, parameters: Any) -> tuple[Any, Any]:
    """Return the position that an estimate predicts at a scan, and the measured one, m, ``(2, N)`` each."""
    predicted = mean[:2] + measurement.interval * mean[2:4]
    return predicted, numpy.where(measurement.available > 0.0, measurement.position, numpy.nan)


LOG_FORMAT = LogFormat(
    COLUMNS,
    read_log,
    start_track,
    targets_move=True,
    scale_noise=scale_noise,
    predict=predict_position,
    predicted=(PredictedCoordinate("x", "m", "position"), PredictedCoordinate("y", "m", "position")),
    plane=("x", "y", "truth_position_x", "truth_position_y"),
    plot_rows=PlotRows(FARTHEST_RANGE, LARGEST_GAP, FINER, ManeuveringTargetParameters.range_sigma),
    longest_interval=60.0,
)
