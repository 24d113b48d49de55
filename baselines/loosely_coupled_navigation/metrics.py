"""Metrics of LooselyCoupledNavigation in addition to those of every environment: recovery, detection, integrity.

All follow from the error, NEES and NIS that every competitor reports. So the same test of its innovations detects a
fault for policies and estimators: the sum of the NIS of the last ``WINDOW`` fixes beyond the quantile of its chi-square
distribution (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, 5.4). The
protection level bounds the error with the integrity risk ``RISK`` if the reported covariance is right: ``k sigma``,
sigma the reported deviation in the direction of the error, ``k^2`` the quantile of the chi-square distribution of as
many degrees as axes. NEES is ``(error / sigma)^2``, so that error and NEES determine it.
"""

import math
from typing import TYPE_CHECKING

import numpy

from ...envs.engine.scenario_choice import make_task
from ...envs.loosely_coupled_navigation.task import LooselyCoupledNavigation
from ...evaluation.running.metrics import chi_square_quantile, sums_of_present
from ...evaluation.running.own_metrics import Measure, MetricInputs, OwnMetrics
from ...evaluation.statistics.bootstrap import Bootstrap, ratio
from ...evaluation.statistics.cause_split import VARIABLE, active_causes
from ...evaluation.storage.dataset import keywords_of

if TYPE_CHECKING:
    import xarray

RECOVERY_ERROR = 0.25
"""Error over the nominal standard deviation of a measurement, for each axis, below which a run has recovered."""
HOLD_TIME = 0.1
"""Time for which the error must stay below the limit, s: shorter than the memory of any sensible gain, long against
noise.
"""
LONGEST = 1.0
"""Largest recovery time, s; a run that has not recovered by then counts with it."""
WINDOW = 25
"""Fixes whose innovations are tested together: 0.25 s, the time constant of the averages in the observation."""
FALSE_ALARM = 1e-4
"""Probability of an alarm at a measurement of a filter whose covariance is right."""
RISK = 1e-3
"""Integrity risk: tolerated probability of an error beyond the protection level."""
UNITS = {
    "recovery_time": "s",
    "not_recovered": "1",
    "detection_time": "s",
    "missed_spoofing": "1",
    "false_alarms": "1",
    "protection_level": "m",
    "beyond_protection_level": "1",
}
"""Units of the metrics."""


def recovery_times(
    error: numpy.ndarray, available: numpy.ndarray, limit: float, hold: int, longest: int
) -> numpy.ndarray:
    """Return the number of samples from the end of an outage until the error stays small, ``(episodes,)``.

    Args:
        error: size of the error, ``(episodes, time)``.
        available: one where there is a measurement, same shape.
        limit: largest error that counts as small.
        hold: samples for which it must stay small.
        longest: largest number of samples, which is the result for a run that does not recover within it.

    Returns:
        ``(episodes,)``; zero where the error was small at once; NaN without an outage, or fewer than
        ``longest + hold`` samples after it.
    """
    episodes, steps = error.shape
    ends = (available[:, :-1] < 0.5) & (available[:, 1:] > 0.5)
    first = numpy.where(ends.any(axis=1), ends.argmax(axis=1) + 1, steps)
    counted = first + longest + hold <= steps
    window = numpy.arange(longest + hold)
    index = numpy.minimum(first[:, None] + window, steps - 1)
    small = numpy.take_along_axis(error, index, axis=1) < limit
    runs = numpy.cumsum(numpy.concatenate([numpy.zeros((episodes, 1), int), small], axis=1), axis=1)
    holds_from = runs[:, hold:] - runs[:, :-hold] == hold
    found = holds_from[:, :longest]
    time = numpy.where(found.any(axis=1), found.argmax(axis=1), longest)
    return numpy.where(counted, time.astype(float), math.nan)


def alarms(nis: numpy.ndarray, degrees: int) -> numpy.ndarray:
    """Return a mask ``(episodes, time)`` of alarms: the NIS over the last ``WINDOW`` fixes exceeds its limit."""
    sums, fixes = (
        numpy.cumsum(numpy.pad(values, ((0, 0), (WINDOW, 0))), axis=1)
        for values in (numpy.nan_to_num(nis), ~numpy.isnan(nis))
    )
    sums, fixes = (values[:, WINDOW:] - values[:, :-WINDOW] for values in (sums, fixes))
    limits = numpy.array(
        [math.inf, *chi_square_quantile(1.0 - FALSE_ALARM, degrees * numpy.arange(1, WINDOW + 1))]
    )
    return numpy.asarray(sums > limits[fixes])


def detection(alarm: numpy.ndarray, fault: numpy.ndarray, others: numpy.ndarray) -> dict[str, numpy.ndarray]:
    """Return delay of detection and misses of a fault, and alarms before any fault, by name.

    Args:
        alarm: ``(episodes, time)`` booleans.
        fault: whether the fault is present, same shape.
        others: whether another fault is present, same shape.

    Returns:
        ``delay`` and ``missed`` ``(episodes, 1)``, NaN without a fault, the delay also where it is missed; ``false``
        ``(episodes, time)``, NaN from the first measurement with a fault on.
    """
    found = alarm & fault
    there, hit = fault.any(axis=1), found.any(axis=1)
    delay = numpy.where(hit, found.argmax(axis=1) - fault.argmax(axis=1), math.nan)
    missed = numpy.where(there, ~hit, math.nan)
    calm = ~numpy.logical_or.accumulate(fault | others, axis=1)
    return {
        "delay": delay[:, None],
        "missed": missed[:, None],
        "false": numpy.where(calm, alarm, math.nan),
    }


def gather(run: "xarray.Dataset") -> MetricInputs:
    """Return each episode's sums, and numbers of terms, from which the metrics follow, by name; empty for a
    bound.
    """
    if "available" not in run or numpy.isnan(run["available"].values).all():
        return MetricInputs()
    task = make_task(LooselyCoupledNavigation, run.attrs["scenario"], **keywords_of(run))
    p = task.parameters
    T, nominal = p.sampling_interval, math.sqrt(p.receiver_variance * p.axes)
    size = numpy.sqrt((run["error"].values ** 2).sum(axis=-1))
    hold, longest = (max(round(t / T), 1) for t in (HOLD_TIME, LONGEST))
    times = recovery_times(size, run["available"].values, RECOVERY_ERROR * nominal, hold, longest)
    found = {
        "recovery_time": times[:, None] * T,
        "not_recovered": numpy.where(numpy.isnan(times), math.nan, times == longest)[:, None],
    }
    nees = run["nees"].values
    quantile = float(chi_square_quantile(1.0 - RISK, p.axes))
    usable = nees > 0.0
    deviation = numpy.where(usable, size / numpy.sqrt(numpy.where(usable, nees, 1.0)), math.nan)
    found["protection_level"] = math.sqrt(quantile) * deviation
    found["beyond_protection_level"] = numpy.where(numpy.isnan(nees), math.nan, nees > quantile)
    # A learned estimator reports no innovations.
    if VARIABLE in run and "nis" in run and not numpy.isnan(run["nis"].values).all():
        causes = dict(active_causes(run))
        wrong = [causes[name] for name in run["cause"].values.tolist() if name not in ("spoofing", "outlier")]
        spoofed = detection(
            alarms(run["nis"].values, p.axes), causes["spoofing"], numpy.logical_or.reduce(wrong)
        )
        found["detection_time"] = T * spoofed["delay"]
        found["missed_spoofing"] = spoofed["missed"]
        found["false_alarms"] = spoofed["false"]
    return MetricInputs({}, {name: sums_of_present(values) for name, values in found.items()})


def measures(gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset") -> list[Measure]:
    """Return the metrics of recovery, detection and integrity with intervals.

    ``recovery_time`` after an outage and the share of runs that do not recover within a second (``not_recovered``).
    ``detection_time`` of spoofing that is detected, the share that is not while it lasts (``missed_spoofing``), and
    the share of measurements with an alarm before any fault (``false_alarms``). Mean ``protection_level`` and
    the share of measurements with an error beyond it.
    """
    present = {name: sums for name, sums in gathered.averaged.items() if sums[0, 1]}
    return [
        Measure(name, "position", "all", bootstrap.interval(ratio(present[name])), unit)
        for name, unit in UNITS.items()
        if name in present
    ]


METRICS = OwnMetrics(gather, measures)
"""Metrics of the environment."""
