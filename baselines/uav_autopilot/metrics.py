"""Metrics of UavAutopilot's control loop, such as output variance and detection of raised noise."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy

from ...envs.engine.scenario_choice import make_task
from ...envs.uav_autopilot.task import UavAutopilot
from ...evaluation.running.own_metrics import Arrays, Measure, MetricInputs, OwnMetrics
from ...evaluation.statistics.bootstrap import Bootstrap, IntervalEstimate
from ...evaluation.statistics.cause_split import active_causes
from ...evaluation.storage.dataset import keywords_of, slices_of
from ..alarm import LARGER, scale_ratio
from .theory import stationary

if TYPE_CHECKING:
    import xarray

FALSE_ALARMS = 0.02
"""Mean number of false alarms in an episode of consistent innovations, which determines the limit of the alarm."""


def _task(evaluation: "xarray.Dataset") -> UavAutopilot:
    attrs = evaluation.attrs
    task = make_task(UavAutopilot, attrs["scenario"], **keywords_of(evaluation))
    assert isinstance(task, UavAutopilot)
    return task


def gather(run: "xarray.Dataset") -> MetricInputs:
    """Return each episode's numbers from which the metrics follow, by name; none for a bound, fewer for a
    reference.
    """
    if "output" not in run or numpy.isnan(run["output"].values).all():
        return MetricInputs()
    task, slices = _task(run), slices_of(run)
    output, control = run["output"].values, run["control_signal"].values
    tracking = output - run["command"].values
    # Variances across episodes are those of the mean square less the squared mean: both are averages.
    averaged = {
        "tracking": tracking,
        "tracking_square": tracking**2,
        "control": control,
        "control_square": control**2,
    }
    if task.parameters.step_size:
        averaged["output"] = output
    squares = [(tracking[:, times] ** 2).mean(axis=1) for times in slices.values()]
    each = {
        "tracking_square": numpy.stack(squares, axis=1),
    }
    if "steady" in slices:
        each["settled"] = output[:, slices["steady"]].mean(axis=1)
    if "innovation" in run and not numpy.isnan(run["innovation"].values).all():
        parts = [_lag_products(run["innovation"].values[:, times]) for times in slices.values()]
        each["innovation"] = numpy.stack(parts, axis=1)
    if "causes" in run and "nis" in run and not numpy.isnan(run["nis"].values).all():
        held = dict(active_causes(run))
        raised = held["disturbance"] | held["sensor noise"]
        each["detection"] = detect_raised_noise(run["nis"].values, run["nis_degrees"].values, raised)
    return MetricInputs(each, averaged)


def detect_raised_noise(nis: numpy.ndarray, degrees: numpy.ndarray, raised: numpy.ndarray) -> numpy.ndarray:
    """Test each episode for raised noise by its innovations; return the results ``(episodes, 6)``.

    The alarm is Page's cumulative sum of the log-likelihood ratio of innovations with ``LARGER`` times their
    variance (E. S. Page, Continuous inspection schemes, Biometrika 41 (1954), 100-115), its limit by G.
    Lorden, Annals of Mathematical Statistics 42 (1971), 1897-1908, as in :mod:`..alarm`.

    Args:
        nis: normalised innovation squared, NaN where no reading was received, ``(episodes, time)``.
        degrees: its degrees of freedom.
        raised: whether noise is raised.

    Returns:
        For each episode whether there is an alarm while noise is not raised yet, whether it begins without raised
        noise, whether no alarm follows the onset, whether there is an onset, measurements from onset to alarm, and
        whether one follows; zeros in an episode that begins with raised noise.
    """
    episodes, times = nis.shape
    limit = math.log(times / FALSE_ALARMS)
    ratio = numpy.nan_to_num(scale_ratio(nis, degrees, LARGER))
    total, alarm = numpy.zeros(episodes), numpy.zeros((episodes, times), bool)
    for t in range(times):
        total = numpy.clip(total + ratio[:, t], 0.0, limit)
        alarm[:, t] = total >= limit
    begins = ~raised[:, 0]
    onset = begins & raised.any(axis=1)
    first = numpy.where(onset, raised.argmax(axis=1), times)
    since = numpy.arange(times) - first[:, None]
    after = alarm & (since >= 0) & onset[:, None]
    detected = after.any(axis=1)
    delay = numpy.where(detected, after.argmax(axis=1) - first, 0)
    false = (alarm & (since < 0)).any(axis=1) & begins
    return numpy.stack([false, begins, onset & ~detected, onset, delay, detected], axis=1).astype(float)


def _lag_products(values: numpy.ndarray) -> numpy.ndarray:
    """Return mean product of successive values, and mean square, ``(episodes, 2)``; NaN without pairs."""
    if values.shape[1] < 2:
        return numpy.full((len(values), 2), math.nan)
    return numpy.stack([(values[:, 1:] * values[:, :-1]).mean(axis=1), (values**2).mean(axis=1)], axis=1)


def measures(gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset") -> list[Measure]:
    """Return the metrics of the control loop with intervals, such as variances of output and control.

    ``output_variance`` (of output minus command) and ``control_variance``: across episodes at each
    measurement, mean over the window. ``tracking_rmse``: root mean square of output minus command.
    ``innovation_autocorrelation``: at lag one, of the output sensor's normalised innovation (node 4); zero
    for a consistent filter. In window "steady" of a stationary linear loop ``*_theory``: the same by the Lyapunov
    equation. With a step command ``overshoot``, ``rise_time`` (to 90 %), ``settling_time`` (to 5 %) of the
    response averaged over episodes, whose noise falls with the root of their number, and ``mean_output``
    when settled; times that are not reached are cut off at the end of the window "transient".

    Of an alarm on the competitor's own innovations (:func:`detect_raised_noise`): ``false_alarms``, share of episodes
    with one before noise is raised, of those that begin without; ``missed_faults``, share of the onsets that no alarm
    follows; ``detection_delay`` of the others. A filter that adapts at once has small innovations again and no
    alarm: then a miss is not a fault of the filter.
    """
    if not gathered.each:
        return []
    each, task, windows = gathered.each, _task(evaluation), slices_of(evaluation)
    name = str(evaluation["policy"].values)
    unit, control_unit = task.components[task.output].unit, {"P": "m/s^2", "U": "deg"}[task.parameters.plant]
    tracking_variance, control_variance = (
        _variance(gathered.averaged, of, bootstrap.episodes) for of in ("tracking", "control")
    )
    theory = stationary(task, name)
    found: list[Measure] = []
    for i, (window, times) in enumerate(windows.items()):

        def add(metric: str, estimate: IntervalEstimate, unit: str, window: str = window) -> None:
            found.append(Measure(metric, "", window, estimate, unit))

        add("output_variance", bootstrap.interval(tracking_variance[:, times].mean(axis=1)), f"({unit})^2")
        add(
            "control_variance",
            bootstrap.interval(control_variance[:, times].mean(axis=1)),
            f"({control_unit})^2",
        )
        add("tracking_rmse", bootstrap.estimate(each["tracking_square"][:, i], numpy.sqrt), unit)
        if theory is not None and window == "steady":
            add("output_variance_theory", _exact(theory.output_variance), f"({unit})^2")
            add("control_variance_theory", _exact(theory.control_variance), f"({control_unit})^2")
            add("cost_theory", _exact(theory.cost), "1")
        if "innovation" in each:
            product, power = numpy.moveaxis(bootstrap.means(each["innovation"][:, i]), -1, 0)
            correlation = bootstrap.interval(product / numpy.maximum(power, 1e-300))
            found.append(Measure("innovation_autocorrelation", "lag 1", window, correlation, "1"))
    if "detection" in each:
        shares = numpy.moveaxis(bootstrap.means(each["detection"]), -1, 0)
        T = task.parameters.value("sampling_interval")
        for metric, i, factor, unit_of in (
            ("false_alarms", 0, 1.0, "1"),
            ("missed_faults", 2, 1.0, "1"),
            ("detection_delay", 4, T, "s"),
        ):
            if each["detection"][:, i + 1].any():
                share = bootstrap.interval(factor * shares[i] / numpy.maximum(shares[i + 1], 1e-300))
                found.append(Measure(metric, "", "all", share, unit_of))
    if task.parameters.step_size:
        found += _step_response(task, gathered, windows, unit, bootstrap)
    return found


def _variance(averaged: Arrays, of: str, episodes: int) -> numpy.ndarray:
    """Return the unbiased variance over episodes at each time, in the data and in every bootstrap resample."""
    biased = averaged[f"{of}_square"] - averaged[of] ** 2
    return numpy.asarray(biased * (episodes / max(episodes - 1, 1)))


def _exact(value: float) -> IntervalEstimate:
    return IntervalEstimate(value, value, value)


def _step_response(
    task: UavAutopilot, gathered: MetricInputs, windows: Mapping[str, slice], unit: str, bootstrap: Bootstrap
) -> list[Measure]:
    p = task.parameters
    T, first = p.value("sampling_interval"), p.step_time - 1
    last = windows["transient"].stop if "transient" in windows else None
    response = gathered.averaged["output"][:, first:last] / p.step_size
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
        settled = bootstrap.estimate(gathered.each["settled"])
        found.append(Measure("mean_output", "", "steady", settled, unit))
    return found


METRICS = OwnMetrics(gather, measures)
