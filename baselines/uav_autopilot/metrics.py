"""Metrics of the loop of UavAutopilot, beside those of the estimate."""

import math
from collections.abc import Mapping
from typing import Any

import numpy

from ...envs.catalogue import make_task
from ...envs.uav_autopilot.task import UavAutopilot
from ...evaluation.bootstrap import Bootstrap, Estimate
from ...evaluation.dataset import keywords_of, windows_of
from ...evaluation.metrics import Measure
from .theory import stationary

LOST_SIGMAS = 100.0
"""Tracking error, over the nominal sigma of the output's sensor, beyond which a loop counts as lost."""


def metrics(run: Any, bootstrap: Bootstrap) -> list[Measure]:
    """Measures of the loop, beside those of the estimate.

    ``output_variance`` (of output minus command) and ``control_variance``: across episodes at each
    measurement, mean over the window. ``tracking_rmse``: root mean square of output minus command.
    ``innovation_autocorrelation``: at lag one, of the output sensor's normalised innovation (node 4); zero
    for a consistent filter. ``lost_loops``: share of episodes whose tracking error ever exceeds
    ``LOST_SIGMAS``. In window "steady" of a stationary linear loop ``*_theory``: the same by the Lyapunov
    equation. With a step command ``overshoot``, ``rise_time`` (to 90 %), ``settling_time`` (to 5 %) of the
    response averaged over episodes, whose noise falls with the root of their number, and ``mean_output``
    when settled; times that are not reached are cut off at the end of the window "transient".
    """
    if "output" not in run or numpy.isnan(run["output"].values).all():
        return []
    attrs = run.attrs
    task = make_task(attrs["environment"], "gain", attrs["scenario"], **keywords_of(run))
    assert isinstance(task, UavAutopilot)
    name = str(run["policy"].values)
    unit, control_unit = task.components[task.output].unit, {"P": "m/s^2", "U": "deg"}[task.parameters.plant]
    output, control = run["output"].values, run["control_signal"].values
    tracking = output - run["command"].values
    windows = {w: slice(first - 1, last) for w, (first, last) in windows_of(run).items()}
    tracking_variance, control_variance = _variances(tracking, bootstrap), _variances(control, bootstrap)
    theory = stationary(task, name)
    # References estimate outside the task and tell of no innovation.
    told = "innovation" in run and not numpy.isnan(run["innovation"].values).all()
    found: list[Measure] = []
    for window, times in windows.items():

        def add(metric: str, estimate: Estimate, unit: str, window: str = window) -> None:
            found.append(Measure(metric, "", window, estimate, unit))

        add("output_variance", bootstrap.interval(tracking_variance[:, times].mean(axis=1)), f"({unit})^2")
        add(
            "control_variance",
            bootstrap.interval(control_variance[:, times].mean(axis=1)),
            f"({control_unit})^2",
        )
        add("tracking_rmse", bootstrap.estimate((tracking[:, times] ** 2).mean(axis=1), numpy.sqrt), unit)
        if theory is not None and window == "steady":
            add("output_variance_theory", _exact(theory.output_variance), f"({unit})^2")
            add("control_variance_theory", _exact(theory.control_variance), f"({control_unit})^2")
            add("cost_theory", _exact(theory.cost), "1")
        if told:
            correlation = _correlation(run["innovation"].values[:, times], bootstrap)
            found.append(Measure("innovation_autocorrelation", "lag 1", window, correlation, "1"))
    far = (numpy.abs(tracking) > LOST_SIGMAS * math.sqrt(task.cost_unit)).any(axis=1)
    found.append(Measure("lost_loops", "", "all", bootstrap.estimate(far.astype(float)), "1"))
    if task.parameters.step_size:
        found += _step_response(task, output, windows, unit, bootstrap)
    return found


def _exact(value: float) -> Estimate:
    return Estimate(value, value, value)


def _variances(values: numpy.ndarray, bootstrap: Bootstrap) -> numpy.ndarray:
    """Unbiased variance across episodes at each time, of the data and of every resample."""
    episodes = len(values)
    mean = values.mean(axis=0)
    around = values - mean
    biased = bootstrap.means(around**2) - bootstrap.means(around) ** 2
    return biased * (episodes / max(episodes - 1, 1))


def _correlation(values: numpy.ndarray, bootstrap: Bootstrap) -> Estimate:
    """Autocorrelation at lag one, pooled over episodes."""
    if values.shape[1] < 2:
        return Estimate(math.nan, math.nan, math.nan)
    product = bootstrap.means((values[:, 1:] * values[:, :-1]).mean(axis=1))
    power = bootstrap.means((values**2).mean(axis=1))
    return bootstrap.interval(product / numpy.maximum(power, 1e-300))


def _step_response(
    task: UavAutopilot, output: numpy.ndarray, windows: Mapping[str, slice], unit: str, bootstrap: Bootstrap
) -> list[Measure]:
    p = task.parameters
    T, first = p.value("sampling_interval"), p.step_time - 1
    last = windows["transient"].stop if "transient" in windows else output.shape[1]
    response = bootstrap.means(output[:, first:last]) / p.step_size
    length = response.shape[1]
    if length < 2:
        return []
    reached = response >= 0.9
    rise = numpy.where(reached.any(axis=1), reached.argmax(axis=1), length)
    outside = numpy.abs(response - 1.0) > 0.05
    settling = numpy.where(outside.any(axis=1), length - outside[:, ::-1].argmax(axis=1), 0)
    over = numpy.maximum(response.max(axis=1) - 1.0, 0.0)
    found = [
        Measure("overshoot", "", "transient", bootstrap.interval(over), "1"),
        Measure("rise_time", "", "transient", bootstrap.interval(rise * T), "s"),
        Measure("settling_time", "", "transient", bootstrap.interval(settling * T), "s"),
    ]
    if "steady" in windows:
        settled = bootstrap.estimate(output[:, windows["steady"]].mean(axis=1))
        found.append(Measure("mean_output", "", "steady", settled, unit))
    return found
