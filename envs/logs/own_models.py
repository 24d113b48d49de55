"""Tables of measurements of a state-space model: a column for each number that h returns, and for each input.

An input acted since the previous row; where a cell is empty the last value remains in force. The track starts
with the model's mean and covariance one interval before the first row, as in the simulation.
"""

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy

from ..contract.log_format import Column, LogFormat, PlainRows, PredictedCoordinate, TrackLog, TrackStart
from ..linear.equations import find_invalid_noise
from .recorded_tables import UNEVEN, Columns

if TYPE_CHECKING:
    from ..linear.equations import StateSpaceDefinition

MOST_MISSED = 1000
"""Measurements that may be missing between two rows."""
SIMULATION_PARAMETERS = (
    "horizon",
    "decision_interval",
    "jitter",
    "process_noise",
    "measurement_noise",
    "availability",
    "late",
)
"""Parameters of a simulation only, which do not apply to a log."""


def state_space_log_format(definition: "StateSpaceDefinition", defaults: Mapping[str, Any]) -> LogFormat:
    """Return the :class:`LogFormat` of the tables of a state-space model."""
    one = len(definition.filters) == 1
    columns = {name.lower(): unit for name, unit in definition.measured.items()}
    acting = {name.lower(): given.unit for name, given in definition.inputs.items()}
    interval = None if definition.world[0].timed else float(defaults.get("sampling_interval", 1.0))
    return LogFormat(
        {name: Column(unit) for name, unit in (columns | acting).items()},
        functools.partial(_read, definition, dict(defaults)),
        _start,
        predict=functools.partial(_predict, definition) if one else None,
        predicted=tuple(PredictedCoordinate(name, unit, name) for name, unit in definition.measured.items()),
        plain_rows=PlainRows(
            tuple(definition.measured),
            tuple(definition.inputs),
            definition.mean,
            definition.covariance,
            interval,
        ),
        noise_hint="a sensor takes it from a column that is an input, inputs=['accuracy'] and R=lambda u: u[0] ** 2",
    )


def _read(
    definition: "StateSpaceDefinition",
    defaults: Mapping[str, Any],
    columns: Columns,
) -> TrackLog:
    names, inputs = ([name.lower() for name in part] for part in (definition.measured, definition.inputs))
    lacking = [name for name in (*names, *inputs) if not columns.has(name)]
    if lacking:
        raise ValueError(
            f"it lacks the column {', '.join(lacking)}; it needs time, {', '.join((*names, *inputs))}, empty where "
            f"nothing was received; if it has another name, give --rename 'NAME={lacking[0]}'"
        )
    known = {name: value for name, value in defaults.items() if name not in SIMULATION_PARAMETERS}
    parameters = {name: value for name, value in known.items() if name not in columns.user_parameters}
    timed = definition.world[0].timed
    typical: dict[str, float] = {}
    notes: tuple[str, ...] = ()
    if timed:
        parameters.pop("sampling_interval", None)
        usual = columns.interval()
        typical["sampling_interval"] = usual
        rows, time = numpy.arange(len(columns.time)), columns.time
    else:
        usual = float({"sampling_interval": 1.0, **known, **columns.user_parameters}["sampling_interval"])
        rows, time = _fill_gaps(columns.time, usual)
        missed = int((rows < 0).sum())
        notes = (f"{missed:,} measurements without a row: nothing was received",) * bool(missed)
    values = numpy.stack([columns[name] for name in names], axis=1)
    there = (rows >= 0)[:, None] & numpy.isfinite(values[rows])
    if not there.any():
        raise ValueError(f"no row has a value of {', '.join(names)}")
    start = float(time[0]) - usual
    measurements = {"values": numpy.where(there, values[rows], 0.0), "available": there.astype(float)}
    if timed:
        measurements["interval"] = numpy.diff(time, prepend=start)
    if inputs:
        measurements["inputs"] = numpy.stack([_hold(name, columns[name], rows) for name in inputs], axis=1)
    _check_noise(definition, measurements, rows, usual)
    initial = {"mean": definition.mean, "covariance": definition.covariance}
    return TrackLog(measurements, initial, rows, parameters, start, time, notes, typical)


def _check_noise(
    definition: "StateSpaceDefinition", made: Mapping[str, numpy.ndarray], rows: numpy.ndarray, usual: float
) -> None:
    count = len(rows)
    interval = made.get("interval", numpy.full(count, usual))
    inputs = made.get("inputs", numpy.zeros((count, 0)))
    found = find_invalid_noise(definition, made["available"].T, interval, inputs.T)
    if found is not None:
        values = ", ".join(
            f"{name} is {value:g}" for name, value in zip(definition.inputs, inputs[found.place], strict=True)
        )
        raise ValueError(
            f"R of {found.sensor} must be positive definite, and in row {rows[found.place]}, where {values}, it is "
            f"{found.R}: leave the cells of a sensor empty where its noise is not known"
        )


def _hold(name: str, given: numpy.ndarray, rows: numpy.ndarray) -> numpy.ndarray:
    """Return an input at every measurement, ``(T,)``, with empty cells filled forward, then backward."""
    there = numpy.isfinite(given)
    if not there.any():
        raise ValueError(f"no row has a value of {name}")
    known = (rows >= 0) & there[rows]
    last = numpy.maximum.accumulate(numpy.where(known, numpy.arange(len(rows)), -1))
    return given[rows[numpy.maximum(last, int(known.argmax()))]]


def _fill_gaps(time: numpy.ndarray, interval: float) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return the row of every measurement at a fixed interval, -1 where there is none, and the times, s."""
    steps = numpy.rint(numpy.diff(time) / interval)
    wrong = (numpy.abs(numpy.diff(time) - steps * interval) > UNEVEN * interval) | (steps < 1.0)
    wrong |= steps > MOST_MISSED
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(
            f"the model moves by {interval:g} s from one measurement to the next, and row {row + 1} is "
            f"{time[row + 1] - time[row]:g} s after row {row}: give --set sampling_interval=SECONDS if the model is "
            "made for another one, or write f(x, dt) and Q(dt), which take any time"
        )
    places = numpy.append(0, numpy.cumsum(steps)).astype(int)
    rows = numpy.full(places[-1] + 1, -1)
    rows[places] = numpy.arange(len(time))
    return rows, numpy.interp(numpy.arange(len(rows)), places, time)


def _start(measurements: Mapping[str, numpy.ndarray], seconds: numpy.ndarray, parameters: Any) -> TrackStart:
    """Raise ValueError: a track of a state-space model starts from the model's mean and covariance."""
    raise ValueError(
        "it lacks initial_mean and initial_covariance, and the model does not start from measurements"
    )


def _predict(
    definition: "StateSpaceDefinition", mean: numpy.ndarray, measurement: Any, parameters: Any
) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return the predicted and the received measurement, ``(m, ...)`` each; predicted angles on the nearest turn."""
    model = definition.filters[0]
    rows = [mean]
    rows += [measurement.interval[None]] if model.timed else []
    rows += [measurement.inputs] if definition.inputs else []
    given = numpy.concatenate([numpy.reshape(row, (len(row), -1)) for row in rows])
    moved = model.f.value(given, numpy)
    known = numpy.concatenate([moved, given[len(given) - model.h.given :]])
    predicted = model.h.value(known, numpy).reshape(-1, *mean.shape[1:])
    measured = numpy.where(measurement.available > 0.0, measurement.values, numpy.nan)
    for channel in definition.channels:
        if channel.period is not None:
            turns = numpy.round((measured - predicted)[channel.places] / channel.period)
            measured[channel.places] -= channel.period * turns
    return predicted, measured
