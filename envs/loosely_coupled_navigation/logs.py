"""Tables of positions by an INS and by a receiver, read as measurements of LooselyCoupledNavigation.

The first row is the start of the track: there the position of the INS is taken for the true one, as in the environment.
Every further row is a measurement.
"""

from collections.abc import Mapping
from typing import Any

import numpy

from ..contract.log_format import Column, LogFormat, PredictedCoordinate, TrackLog, TrackStart
from ..logs.plausibility import check_extents
from ..logs.recorded_tables import Columns
from .parameters import AXES, LooselyCoupledNavigationParameters

COLUMNS = {
    "ins": Column(
        "m, position by the INS alone; with several axes ins_x, ins_y, ins_z",
        live="m, position by the INS alone, one number for each axis",
    ),
    "fix": Column(
        "m, position by the receiver, empty where there is none; with several axes fix_x, fix_y, fix_z",
        live="m, position by the receiver, on one axis; left out where there is none",
    ),
    "sigma": Column(
        "m, standard deviation of each axis of the fix, as reported; optional, default: the parameters'"
    ),
    **{f"{kind}_{axis}": Column("m, on this axis") for kind in ("ins", "fix") for axis in AXES},
}


def measure(
    number: numpy.ndarray,
    ins: numpy.ndarray,
    before: numpy.ndarray,
    fix: numpy.ndarray,
    sigma: numpy.ndarray,
    p: Any,
) -> dict[str, numpy.ndarray]:
    """Return the arrays of a ``Measurement`` by name, from INS positions and fixes of n rows or tracks.

    A fix without all axes counts as missing.

    Args:
        number: number of the measurement, ``(n,)``.
        ins: position by the INS, m, ``(axes, n)``.
        before: the same at the previous measurement.
        fix: position by the receiver, m, ``(axes, n)``; NaN where there is none.
        sigma: reported deviation, m, ``(n,)``; NaN where there is none.
        p: parameters.
    """
    there = numpy.isfinite(fix).all(axis=0)
    return {
        "number": number,
        "ins": ins,
        "increment": ins - before,
        "fix": numpy.where(there, fix, 0.0),
        "available": there.astype(float),
        "reported_deviation": numpy.where(numpy.isfinite(sigma), sigma, p.receiver_variance**0.5),
    }


def start_track(
    measurements: Mapping[str, numpy.ndarray], seconds: numpy.ndarray, parameters: Any
) -> TrackStart:
    """Return the start of every episode of a log: at the INS position before the first increment."""
    mean = measurements["ins"][:, 0] - measurements["increment"][:, 0]
    covariance = numpy.zeros((*mean.shape, mean.shape[-1]))
    return TrackStart(measurements, {"mean": mean, "covariance": covariance}, 0)


def read_log(columns: Columns) -> TrackLog:
    """Return the INS and receiver measurements of one track from the columns of a table."""
    ends = [f"_{axis}" for axis in AXES if columns.has(f"ins_{axis}") or columns.has(f"fix_{axis}")]
    if columns.has("ins") or not ends:
        ends = [""]
    for name in (f"{kind}{end}" for kind in ("ins", "fix") for end in ends):
        if not columns.has(name):
            raise ValueError(f"it lacks the column {name}; it needs ins and fix, or ins_x, fix_x and so on")
    if ends != [""] and ends != [f"_{axis}" for axis in AXES[: len(ends)]]:
        raise ValueError(f"axes must be {', '.join(AXES[: len(ends)])}, got {', '.join(e[1:] for e in ends)}")
    ins = columns.whole(*(f"ins{end}" for end in ends))
    interval = columns.regular("the filters of this environment count measurements, not seconds")
    parameters = {"axes": len(ends), "sampling_interval": interval}
    fix = numpy.stack([columns[f"fix{end}"] for end in ends], axis=1)
    if not numpy.isfinite(fix[1:]).all(axis=1).any():
        raise ValueError("no row has a fix on every axis")
    check_extents(("ins", "fix"), ins, fix)
    given = {
        name: value for name, value in columns.user_parameters.items() if name not in ("axes", "horizon")
    }
    p = LooselyCoupledNavigationParameters(**{**parameters, **given})
    count = len(ins) - 1
    sigma = columns.sigmas("sigma")[1:, 0] if columns.has("sigma") else numpy.full(count, numpy.nan)
    made = measure(numpy.arange(1.0, count + 1.0), ins[1:].T, ins[:-1].T, fix[1:].T, sigma, p)
    measurements = {name: numpy.ascontiguousarray(values.T) for name, values in made.items()}
    return TrackLog(
        measurements,
        {"mean": ins[0], "covariance": numpy.zeros((len(ends), len(ends)))},
        numpy.arange(1, count + 1),
        {n: v for n, v in parameters.items() if n not in columns.user_parameters},
        float(columns.time[0]),
        columns.time[1:],
    )


def predict_fix(mean: Any, measurement: Any, parameters: Any) -> tuple[Any, Any]:
    """Return the position predicted by an estimate and the INS increment, and the fix, m, ``(axes, N)`` each."""
    return mean + measurement.increment, numpy.where(measurement.available > 0.0, measurement.fix, numpy.nan)


LOG_FORMAT = LogFormat(
    COLUMNS,
    read_log,
    start_track,
    predict=predict_fix,
    predicted=tuple(PredictedCoordinate(axis, "m", "position") for axis in AXES),
    longest_interval=5.0,
    decision_interval=1,
    regular_rows=lambda p: {"usual_sigma": p.receiver_variance**0.5},
)
