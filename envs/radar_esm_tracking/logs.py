"""Tables of ranges, range rates, bearings and type decisions, read as measurements of RadarEsmTracking.

The first row is scan 0, which starts the track. A decision is the number of an emitter type, empty where the ESM
received nothing. A row with a decision contains both bearings, or their difference.
"""

from collections.abc import Mapping
from typing import Any

import numpy

from ...filters.class_fusion import bearing_difference
from ..contract.log_format import (
    Column,
    LogFormat,
    PredictedCoordinate,
    Readings,
    TrackLog,
    TrackStart,
    optional_column,
)
from ..logs.recorded_tables import Columns
from .parameters import RadarEsmTrackingParameters

COLUMNS = {
    "range": Column("m"),
    "range_rate": Column("m/s, below zero where the target comes nearer"),
    "decision": Column(
        "emitter type that the ESM decides for, counted from 0; empty where it received nothing; optional"
    ),
    "radar_bearing": Column("degrees, of the radar; with every decision"),
    "esm_bearing": Column("degrees, of the ESM, counted as the radar's; with every decision"),
    "bearing_difference": Column("degrees, radar minus ESM; in place of both bearings"),
    "looked": Column(
        "1 where the ESM listened, else 0; optional, default: every esm_period scans, and wherever it decided"
    ),
}


def read_log(columns: Columns) -> TrackLog:
    """Return the radar and ESM measurements of one track from the columns of a table.

    Raises:
        ValueError: if a column is missing or a value is not possible.
    """
    for name in ("range", "range_rate"):
        if not columns.has(name):
            raise ValueError(f"it lacks the column {name}")
    radar = columns.whole("range", "range_rate")
    interval = columns.regular("the filters of this environment are tabulated by scans")
    named = {n: v for n, v in columns.user_parameters.items() if n not in ("horizon", "decision_interval")}
    p = RadarEsmTrackingParameters(**{"sampling_interval": interval, **named})
    scans = numpy.arange(len(radar))
    if columns.has("looked"):
        columns.whole("looked")
    raw = {"scan": scans, "radar": radar, **read_decisions(columns, scans, p)}
    measured = {name: values[None] for name, values in raw.items()}
    later, initial, _ = start_track(measured, columns.time[None], p)
    return TrackLog(
        {name: values[0] for name, values in later.items()},
        {name: values[0] for name, values in initial.items()},
        scans[1:],
        {} if "sampling_interval" in columns.user_parameters else {"sampling_interval": interval},
        float(columns.time[0]),
        columns.time[1:],
    )


def start_track(measurements: Mapping[str, numpy.ndarray], seconds: numpy.ndarray, p: Any) -> TrackStart:
    """Return the start of every episode of a log, on its first measurement.

    Raises:
        ValueError: if there is no second measurement.
    """
    if measurements["radar"].shape[1] < 2:
        raise ValueError("the first measurement starts the track, and a recording needs a second one")
    first = {name: values[:, 0] for name, values in measurements.items()}
    covariance = numpy.diag(_start_variances(p))
    initial = {
        "mean": numpy.pad(first["radar"], ((0, 0), (0, 1))),
        "covariance": numpy.tile(covariance, (len(first["radar"]), 1, 1)),
        **{f"first_{name}": values for name, values in first.items()},
    }
    later = {name: values[:, 1:] for name, values in measurements.items()}
    later["scan"], initial["first_scan"] = later["scan"] - first["scan"][:, None], 0 * first["scan"]
    return TrackStart(later, initial, 1)


def _start_variances(p: Any) -> list[float]:
    """Return the initial variances of range, range rate and acceleration, the last for an unknown class (12)."""
    acceleration = float(numpy.square(p.acceleration_sigma) @ numpy.array(p.prior))
    return [p.range_sigma**2, p.range_rate_sigma**2, acceleration]


def _numbers(p: Any) -> dict[str, float]:
    variances = {f"variance_{i}": variance for i, variance in enumerate(_start_variances(p))}
    return {"types": len(p.recognition), "esm_period": p.esm_period, "horizon": p.horizon, **variances}


def read_decisions(readings: Readings, scans: numpy.ndarray, p: Any) -> dict[str, numpy.ndarray]:
    """Return the arrays of a measurement by name, without ``scan`` and ``radar``, from radar and ESM reports.

    Args:
        readings: n rows of a table, or live values.
        scans: numbers of the scans, ``(n,)``.
        p: parameters.

    Raises:
        ValueError: for a decision that is no emitter type, or lacks a bearing.
    """
    types, count = len(p.recognition), len(scans)
    decision = optional_column(readings, "decision", count)
    decided = numpy.isfinite(decision)
    wrong = decided & ((decision != numpy.round(decision)) | (decision < 0) | (decision >= types))
    if wrong.any():
        number = int(wrong.argmax())
        raise ValueError(
            f"decision is the number of an emitter type from 0 to {types - 1}, and {readings.place(number)} has "
            f"{decision[number]:g}"
        )
    difference = optional_column(readings, "bearing_difference", count)
    radar, esm = (optional_column(readings, name, count) for name in ("radar_bearing", "esm_bearing"))
    apart = numpy.where(numpy.isfinite(difference), difference, radar - esm)
    lacking = decided & ~numpy.isfinite(apart)
    if lacking.any():
        raise ValueError(
            f"{readings.place(int(lacking.argmax()))} has a decision and lacks a bearing: a decision needs "
            "radar_bearing and esm_bearing (degrees), or bearing_difference"
        )
    looked = optional_column(readings, "looked", count)
    listens = scans % p.esm_period == 0
    return {
        "looked": numpy.where(numpy.isfinite(looked), looked > 0.5, listens) | decided,
        "decision": numpy.where(decided, decision, types).astype(numpy.int64),
        "bearing_difference": numpy.where(
            decided, bearing_difference(numpy.where(decided, apart, 0.0), 0.0), 0.0
        ),
    }


def predict_radar(mean: Any, measurement: Any, parameters: Any) -> tuple[Any, Any]:
    """Return the predicted and the measured range and range rate, ``(2, N)`` each."""
    T = parameters.sampling_interval
    distance, rate, acceleration = mean
    predicted = numpy.stack([distance + T * rate + 0.5 * T**2 * acceleration, rate + T * acceleration])
    return predicted, measurement.radar


LOG_FORMAT = LogFormat(
    COLUMNS,
    read_log,
    start_track,
    predict=predict_radar,
    predicted=(
        PredictedCoordinate("range", "m", "range"),
        PredictedCoordinate("range_rate", "m/s", "range rate"),
    ),
    longest_interval=60.0,
    decision_interval=1,
    regular_rows=_numbers,
)
