"""Innovations of recorded measurements for every estimator: measurement minus prediction, in the sensor's units.

The prediction follows from the estimate after the previous measurement, by the log format of the environment.
A filter with the right model has white (uncorrelated) innovations.
"""

from typing import TYPE_CHECKING, Any

import numpy

from ...envs.contract.companions import find_companion
from ...envs.contract.log_format import LogFormat
from ...envs.contract.task import Task

if TYPE_CHECKING:
    import xarray


def with_innovations(dataset: "xarray.Dataset", task: Task) -> "xarray.Dataset":
    """Add the innovations of every competitor to the evaluation of a recording, as ``prediction_error``.

    Its dimensions are policy, episode, time and measured.

    It is NaN for missing measurements, at the first measurement, and for a smoother, which does not predict. Without a
    log format with predictions, or without estimates, the evaluation is returned unchanged.

    Args:
        dataset: evaluation with tracks.
        task: task of the recording.
    """
    log_format = find_companion(task, LogFormat)
    if log_format is None or log_format.predict is None or "estimate" not in dataset:
        return dataset
    innovations = []
    for name in dataset["policy"].values:
        run = dataset.sel(policy=name)
        estimate = run["estimate"].transpose("component", "episode", "time").values
        before = numpy.roll(estimate, 1, axis=2)
        before[:, :, 0] = numpy.nan
        if str(run["kind"].values) == "smoother":
            before[:] = numpy.nan
        predicted, measured = log_format.predict(before, _Measured(run), task.parameters)
        innovations.append(numpy.moveaxis(measured - predicted, 0, -1))
    values = numpy.stack(innovations)
    quantities = log_format.predicted[: values.shape[-1]]
    return dataset.assign(prediction_error=(("policy", "episode", "time", "measured"), values)).assign_coords(
        measured=[quantity.name for quantity in quantities],
        measured_unit=("measured", [quantity.unit for quantity in quantities]),
        measured_group=("measured", [quantity.group for quantity in quantities]),
    )


def measured_quantities(run: "xarray.Dataset", task: Task) -> numpy.ndarray | None:
    """Return the quantities that a log format can predict, ``(m, episodes, time)``, or None."""
    log_format = find_companion(task, LogFormat)
    if log_format is None or log_format.predict is None or "estimate" not in run:
        return None
    estimate = run["estimate"].transpose("component", "episode", "time").values
    found: numpy.ndarray = log_format.predict(estimate, _Measured(run), task.parameters)[1]
    return found


class _Measured:
    """Measurements of one competitor's part of a dataset by attribute, ``(..., episodes, time)``."""

    def __init__(self, run: "xarray.Dataset") -> None:
        self._run = run

    def __getattr__(self, name: str) -> Any:
        key = f"measurement_{name}"
        if name.startswith("_") or key not in self._run:
            raise AttributeError(name)
        array: numpy.ndarray = self._run[key].values
        return numpy.moveaxis(array, -1, 0) if array.ndim > 2 else array
