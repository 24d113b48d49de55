"""Metrics of TightlyCoupledNavigation in addition to those of every environment."""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy

from ...envs.tightly_coupled_navigation.parameters import HYPOTHESES
from ...evaluation.running.metrics import chi_square_quantile, squared_errors
from ...evaluation.running.own_metrics import Arrays, Measure, MetricInputs, OwnMetrics
from ...evaluation.statistics.bootstrap import Bootstrap, IntervalEstimate
from ...evaluation.storage.dataset import groups_of

if TYPE_CHECKING:
    import xarray

UNITS = {"position": "m", "velocity": "m/s"}
RISK = 1e-3
"""Integrity risk of an estimate, and probability of a false alarm of the innovation test at one step."""
TESTED = 20
"""Steps over which the innovation test sums."""
LASTING = 10
"""Steps for which a hypothesis must stay most probable, or a rate outside its aperture, to count."""


def _ratio(bootstrap: Bootstrap, values: numpy.ndarray, counts: numpy.ndarray) -> IntervalEstimate:
    """Return ``mean(values) / mean(counts)`` over episodes with its interval."""
    with numpy.errstate(divide="ignore", invalid="ignore"):
        return bootstrap.interval(bootstrap.means(values) / bootstrap.means(counts))


def find_lasting(condition: numpy.ndarray, steps: int = LASTING) -> numpy.ndarray:
    """Return a mask of the times from which on a condition holds for ``steps`` steps in a row."""
    sums = numpy.cumsum(numpy.pad(condition, ((0, 0), (1, 0))), axis=1)
    held = numpy.zeros_like(condition)
    if condition.shape[1] >= steps:
        held[:, : condition.shape[1] - steps + 1] = sums[:, steps:] - sums[:, :-steps] == steps
    return held


class Switch(NamedTuple):
    """One change of the true hypothesis, with the bank's delay in following it."""

    episode: int
    before: int
    after: int
    wait: float
    """Steps until the probability of the new hypothesis exceeds one half, the first one counted; infinite: never."""


def switches(true_mode: numpy.ndarray, probability: numpy.ndarray) -> list[Switch]:
    """Find every change of the true hypothesis, and the bank's delay in following it.

    The delay ends at the first step from which the probability of the new hypothesis exceeds one half for
    ``LASTING`` steps or until the next change.

    Args:
        true_mode: ``(episodes, time)`` integers.
        probability: ``(episodes, time, M)``.
    """
    found = []
    length = true_mode.shape[1]
    for episode, at in zip(*numpy.nonzero(numpy.diff(true_mode, axis=1)), strict=True):
        first = int(at) + 1
        before, after = int(true_mode[episode, at]), int(true_mode[episode, first])
        others = numpy.flatnonzero(true_mode[episode, first:] != after)
        last = first + int(others[0]) if len(others) else length
        believed = probability[episode, first:last, after] > 0.5
        held = find_lasting(believed[None], min(LASTING, last - first))[0]
        wait = float(held.argmax()) + 1.0 if held.any() else math.inf
        found.append(Switch(int(episode), before, after, wait))
    return found


def gather(run: "xarray.Dataset") -> MetricInputs:
    """Return each episode's numbers from which the metrics follow, by name; empty for a bound."""
    if str(run["kind"].values) == "bound":
        return MetricInputs()
    true_mode = run["true_mode"].values.astype(int)
    there = [true_mode == i for i in range(len(HYPOTHESES))]
    squares = [
        [(square * of_mode).mean(axis=1) for of_mode in there]
        for square in (squared_errors(run, component, groups_of(run)) for component in UNITS)
    ]
    each = {
        "squares": numpy.moveaxis(numpy.array(squares), -1, 0),
        "share": numpy.stack([of_mode.mean(axis=1) for of_mode in there], axis=1),
        "cost": run["cost"].values.mean(axis=1),
    }
    each |= _integrity(run)
    if "mode_probability" not in run or numpy.isnan(run["mode_probability"].values).all():
        return MetricInputs(each)
    step = float(run["seconds"].values[0, 0])
    moved = true_mode != true_mode[:, :1]
    begin = numpy.where(moved.any(axis=1), moved.argmax(axis=1), 0)
    in_motion = numpy.arange(true_mode.shape[1]) >= begin[:, None]
    outside = find_lasting((run["rate_outside_aperture"].values > 0.0) & in_motion)
    each |= {
        "switches": _count_changes(switches(true_mode, run["mode_probability"].values), len(true_mode), step),
        "lost": numpy.asarray(outside.any(axis=1)),
        "lost_after": (outside.argmax(axis=1) - begin + 1.0) * step,
    }
    return MetricInputs(each)


def _integrity(run: "xarray.Dataset") -> Arrays:
    """Return each episode's numbers for integrity, innovation correlation and fault detection, by name."""
    limit = chi_square_quantile(1.0 - RISK, run.sizes["component"])
    found: dict[str, numpy.ndarray] = {"misleading": (run["nees"].values > limit).mean(axis=1)}
    if "nis" not in run or numpy.isnan(run["nis"].values).all() or "sensor_fails" not in run:
        return found
    nis: numpy.ndarray = numpy.nan_to_num(run["nis"].values)
    degrees: numpy.ndarray = numpy.nan_to_num(run["nis_degrees"].values)
    # The root limits the innovations of a fault, which would dominate.
    surprise = numpy.sqrt(nis / numpy.maximum(degrees, 1.0))
    apart = surprise - surprise.mean(axis=1, keepdims=True)
    found["innovation_products"] = (apart[:, 1:] * apart[:, :-1]).mean(axis=1)
    found["innovation_squares"] = (apart * apart).mean(axis=1)
    alarm = innovation_alarm(nis, degrees)
    return {
        **found,
        **_detection(alarm, run["sensor_fails"].values > 0.0, float(run["seconds"].values[0, 0])),
    }


def innovation_alarm(nis: numpy.ndarray, degrees: numpy.ndarray) -> numpy.ndarray:
    """Return a mask of the steps at which the NIS, summed over the last ``TESTED`` steps, exceeds its limit."""

    def summed(values: numpy.ndarray) -> numpy.ndarray:
        sums = numpy.cumsum(numpy.pad(values, ((0, 0), (TESTED, 0))), axis=1)
        return sums[:, TESTED:] - sums[:, :-TESTED]

    alarm: numpy.ndarray = summed(nis) > chi_square_quantile(1.0 - RISK, numpy.maximum(summed(degrees), 1.0))
    return alarm


def _detection(alarm: numpy.ndarray, fails: numpy.ndarray, step: float) -> Arrays:
    """Return each episode's number of false alarms, and whether and when its first fault is detected, by
    name.
    """
    fault, first = numpy.logical_or.reduce(fails, axis=1), fails.argmax(axis=1)
    steps, length = numpy.arange(alarm.shape[1]), alarm.shape[1]
    # A fault has effects after its end: only alarms before the first fault are false.
    before = numpy.where(fault, first, length)
    ended = ~fails & (steps > first[:, None])
    last = numpy.where(ended.any(axis=1), ended.argmax(axis=1), length)
    during = alarm & (steps >= first[:, None]) & (steps < last[:, None]) & fault[:, None]
    found = during.any(axis=1)
    return {
        "fault": fault,
        "found": found,
        "found_after": (during.argmax(axis=1) - first + 1.0) * step * found,
        "false_alarms": (alarm & (steps < before[:, None])).sum(axis=1),
        "faultless": before,
    }


def _count_changes(changes: Sequence[Switch], episodes: int, step: float) -> numpy.ndarray:
    """Count changes, missed ones and summed delays, s, from and to each hypothesis, ``(episodes, M, M, 3)``."""
    found = numpy.zeros((episodes, len(HYPOTHESES), len(HYPOTHESES), 3))
    for s in changes:
        seen = math.isfinite(s.wait)
        found[s.episode, s.before, s.after] += (1.0, not seen, s.wait * step if seen else 0.0)
    return found


def measures(gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset") -> list[Measure]:
    """Return the metrics of all episodes with intervals, such as errors by hypothesis, adaptation and loss of
    track.

    ``rmse_by_hypothesis``; ``cost_median`` and ``cost_95_quantile`` over episodes of the episode's mean cost,
    whose mean a few lost tracks dominate; ``adaptation_time`` (mean) from the first step that carries a new motion to
    the first on which its hypothesis has more than one half for ten steps, and ``adaptation_censored``, the share of
    switches without such a step; ``track_loss_rate`` and ``track_loss_time`` (median of the tracks lost) of ten steps
    in a row with a pseudorange rate further than the aperture from the combined prediction, from the first change of
    motion on. Those from ``adaptation_time`` on need the records of a bank: references have none.

    ``misleading_information`` is the share of steps whose error lies outside a region of the reported covariance; with
    a correct covariance it is one in a thousand. ``innovation_correlation``, of the root of the normalised innovation
    squared from one step to the next, is zero where innovations are white. A test of the sum of that square over 20
    steps, at the risk of one in a thousand, gives ``fault_detection_time`` of the first fault of a sensor,
    ``fault_missed``, the share of faults that it does not detect while they last, and ``false_alarm_rate``, the share
    of steps before any fault. A filter that models a fault has no unexpected innovations, and so no alarm.
    """
    if not gathered.each:
        return []
    found = [*_errors(gathered.each, bootstrap), *_measure_integrity(gathered.each, bootstrap)]
    return [*found, *_of_bank(gathered.each, bootstrap)] if "switches" in gathered.each else found


def _errors(each: Arrays, bootstrap: Bootstrap) -> Iterator[Measure]:
    for k, (component, unit) in enumerate(UNITS.items()):
        for i, name in enumerate(HYPOTHESES):
            if each["share"][:, i].any():
                value = _ratio(bootstrap, each["squares"][:, k, i], each["share"][:, i])
                root = IntervalEstimate(*(math.sqrt(v) for v in value))
                yield Measure("rmse_by_hypothesis", f"{component} {name}", "all", root, unit)
    yield Measure("cost_median", "", "all", bootstrap.interval(bootstrap.quantiles(each["cost"])), "1")
    yield Measure(
        "cost_95_quantile", "", "all", bootstrap.interval(bootstrap.quantiles(each["cost"], 0.95)), "1"
    )


def _measure_integrity(each: Arrays, bootstrap: Bootstrap) -> Iterator[Measure]:
    yield Measure("misleading_information", "", "all", bootstrap.estimate(each["misleading"]), "1")
    if "fault" not in each:
        return
    correlation = _ratio(bootstrap, each["innovation_products"], each["innovation_squares"])
    yield Measure("innovation_correlation", "", "all", correlation, "1")
    fault, found = each["fault"].astype(float), each["found"].astype(float)
    if each["faultless"].any():
        rate = _ratio(bootstrap, each["false_alarms"].astype(float), each["faultless"].astype(float))
        yield Measure("false_alarm_rate", "", "all", rate, "1")
    if fault.any():
        yield Measure("fault_missed", "", "all", _ratio(bootstrap, fault - found, fault), "1")
    if found.any():
        yield Measure("fault_detection_time", "", "all", _ratio(bootstrap, each["found_after"], found), "s")


def _of_bank(each: Arrays, bootstrap: Bootstrap) -> Iterator[Measure]:
    for before, after in numpy.argwhere(each["switches"][..., 0].any(axis=0)):
        count, missed, total = numpy.moveaxis(each["switches"][:, before, after], -1, 0)
        name = f"{HYPOTHESES[before]} to {HYPOTHESES[after]}"
        if (missed < count).any():
            yield Measure("adaptation_time", name, "all", _ratio(bootstrap, total, count - missed), "s")
        yield Measure("adaptation_censored", name, "all", _ratio(bootstrap, missed, count), "1")
    lost = each["lost"]
    yield Measure("track_loss_rate", "", "all", bootstrap.estimate(lost.astype(float)), "1")
    if lost.any():
        value = bootstrap.interval(bootstrap.quantiles(each["lost_after"], 0.5, lost))
        yield Measure("track_loss_time", "", "all", value, "s")


METRICS = OwnMetrics(gather, measures)
