"""Metrics of RadarEsmTracking: errors by class, recognition of the class, calibration."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy

from ...evaluation.running.metrics import squared_errors
from ...evaluation.running.own_metrics import Arrays, Measure, MetricInputs, OwnMetrics
from ...evaluation.statistics.bootstrap import Bootstrap, IntervalEstimate
from ...evaluation.storage.dataset import slices_of, windows_of

if TYPE_CHECKING:
    import xarray

CLASSES = 3
SURE = 0.9
"""Probability from which a class counts as recognised."""
LEAST = 1e-6
"""Smallest probability of the true class in the logarithmic score."""
TIMES = (2.0, 5.0, 10.0, 20.0, 30.0, 60.0)
"""Seconds at which the probability of the true class is reported."""


def _ratio(means: numpy.ndarray, shares: numpy.ndarray) -> numpy.ndarray:
    """Return ``means / shares``, ``(1 + resamples,)``; NaN where a share is zero."""
    with numpy.errstate(divide="ignore", invalid="ignore"):
        return means / shares


def time_quantile(
    bootstrap: Bootstrap,
    first: numpy.ndarray,
    is_counted: numpy.ndarray,
    seconds: numpy.ndarray,
    share: float,
) -> IntervalEstimate:
    """Return the time by which a share of the counted episodes reaches a condition; infinite where too few
    do.

    Args:
        bootstrap: resamples of the episodes.
        first: index of the first time with the condition, or the number of times, ``(episodes,)``.
        is_counted: whether an episode counts, ``(episodes,)`` booleans.
        seconds: times, s, ``(T,)``.
        share: share of the episodes.
    """
    times = numpy.append(seconds, math.inf)[first]
    return bootstrap.interval(bootstrap.quantiles(times, share, is_counted))


def _first(condition: numpy.ndarray) -> numpy.ndarray:
    """Return the index of the first true entry along time, or the number of times, ``(episodes,)``."""
    return numpy.where(condition.any(axis=1), condition.argmax(axis=1), condition.shape[1])


def _recognition(
    name: str, bootstrap: Bootstrap, first: numpy.ndarray, chosen: numpy.ndarray, seconds: numpy.ndarray,
    component: str,
) -> Iterator[Measure]:  # fmt: skip
    for suffix, share in (("median", 0.5), ("90_quantile", 0.9)):
        value = time_quantile(bootstrap, first, chosen, seconds, share)
        yield Measure(f"{name}_{suffix}", component, "all", value, "s")
    never = ((first == len(seconds)) & chosen).astype(float)
    means = bootstrap.means(numpy.stack([never, chosen], axis=1))
    censored = bootstrap.interval(_ratio(means[:, 0], means[:, 1]))
    yield Measure(f"{name}_censored", component, "all", censored, "1")


def _missing(run: "xarray.Dataset", name: str) -> bool:
    return name not in run or bool(numpy.isnan(run[name].values).any())


def _of_class(true_class: numpy.ndarray) -> numpy.ndarray:
    return numpy.asarray(true_class[..., None] == numpy.arange(CLASSES))


def _group_masks(true_class: numpy.ndarray) -> numpy.ndarray:
    """Return masks ``(..., 1 + classes)``: all targets, then those of each true class."""
    return numpy.concatenate([numpy.ones((*true_class.shape, 1), bool), _of_class(true_class)], axis=-1)


def gather(run: "xarray.Dataset") -> MetricInputs:
    """Return each episode's numbers from which the metrics follow, by name; none for a bound, fewer for a
    reference.
    """
    if _missing(run, "true_class"):
        return MetricInputs()
    true_class = run["true_class"].values.astype(int)
    of_class, slices = _of_class(true_class), slices_of(run).values()
    squares, by_class, variance = [], [], []
    for component in run["component"].values.tolist():
        square = squared_errors(run, component, {})
        squares.append([square[:, times].mean(axis=1) for times in slices])
        by_class.append(
            [[(square * of_class[..., s])[:, t].mean(axis=1) for s in range(CLASSES)] for t in slices]
        )
        variance.append([run[f"variance_{component}"].values[:, times].mean(axis=1) for times in slices])
    share = [[of_class[:, times, s].mean(axis=1) for s in range(CLASSES)] for times in slices]
    means = {"squares": squares, "squares_by_class": by_class, "variance": variance, "share": share}
    found = MetricInputs(
        {}, {key: numpy.moveaxis(numpy.array(values), -1, 0) for key, values in means.items()}
    )
    return found if _missing(run, "mode_probability") else _with_beliefs(run, found)


def _with_beliefs(run: "xarray.Dataset", errors: MetricInputs) -> MetricInputs:
    true_class, seconds = run["true_class"].values.astype(int), run["seconds"].values[0]
    true_probability, probability = run["true_class_probability"].values, run["mode_probability"].values
    moments = _moments(seconds)
    sure, same = true_probability >= SURE, true_class == true_class[:, :1]
    change = _first(~same)
    waited = _first(sure & (numpy.arange(len(seconds)) >= change[:, None]))
    last = _last(seconds)
    wrong = (probability[:, last] >= SURE) & (numpy.arange(probability.shape[2]) != true_class[:, last, None])
    right = probability.argmax(axis=2) == true_class
    excess = probability.max(axis=2) - right
    stays = numpy.logical_and.accumulate(right[:, ::-1], axis=1)[:, ::-1]
    detected = _first(stays & (numpy.arange(len(seconds)) >= change[:, None]))
    false = right[:, :-1] & ~right[:, 1:] & (true_class[:, 1:] == true_class[:, :-1])
    score = numpy.log(numpy.maximum(true_probability, LEAST))
    at_moments, at_last = (
        _group_masks(true_class[:, list(moments.values())]),
        _group_masks(true_class[:, last]),
    )
    averaged = {
        "probability": true_probability[:, list(moments.values()), None] * at_moments,
        "share_at_moments": at_moments,
        "wrong": wrong.any(axis=1)[:, None] & at_last,
        "share_at_last": at_last,
        "false_changes": false.sum(axis=1, keepdims=True).astype(float),
        **{
            name: numpy.stack([values[:, times].mean(axis=1) for times in slices_of(run).values()], axis=1)
            for name, values in (("excess", excess), ("right", right), ("log_score", score))
        },
    }
    each = {
        "first_class": true_class[:, 0],
        "recognised": _first(sure & same),
        "change": change,
        "detected": numpy.where(detected < len(seconds), detected - change, len(seconds)),
        "recognised_again": numpy.where(waited < len(seconds), waited - change, len(seconds)),
    }
    return MetricInputs(each, {**errors.averaged, **averaged}, {"seconds": seconds})


def _moments(seconds: numpy.ndarray) -> dict[float, int]:
    """Return the index of each of :data:`TIMES` among the measurements, by its time, s."""
    found = {moment: numpy.flatnonzero(numpy.isclose(seconds, moment)) for moment in TIMES}
    return {moment: int(at[0]) for moment, at in found.items() if len(at)}


def _last(seconds: numpy.ndarray) -> int:
    return _moments(seconds).get(TIMES[-1], len(seconds) - 1)


def measures(gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset") -> list[Measure]:
    """Return the metrics of all episodes with intervals: errors by true class, recognition, and calibration.

    ``rmse_by_class`` (by the class at each measurement); ``mean_true_class_probability`` at stated times;
    ``time_to_recognise_median``, ``_90_quantile`` (first P(true class) >= 0.9) and ``_censored``, the share of
    runs in which that never comes while the first class lasts; ``time_to_recognise_change_...`` the same
    after a change, counted from it; ``sure_and_wrong``, the share of runs with P >= 0.9 for a wrong class at
    60 s (or the end); ``calibration_ratio``, mean square error over mean reported variance;
    ``confidence_excess``, mean probability of the most probable class minus how often it is the true one;
    ``time_to_detect_change_...``, from a change of class until the most probable class is the true one and stays so;
    ``false_class_changes``, how often in an episode the most probable class leaves the true one that has not changed;
    ``right_class``, the share of scans at which it is the true one; ``class_log_score``, the mean logarithm of the true
    class's probability (at least 1e-6).
    A reference has no class probabilities, so that only errors and calibration are computed.
    """
    if not gathered.averaged:
        return []
    errors = list(_errors(gathered.averaged, bootstrap, evaluation))
    return [*errors, *_beliefs(gathered, bootstrap, evaluation)] if gathered.each else errors


GROUPS = ("", *(f"S{s}" for s in range(CLASSES)))
"""Names of the group of all targets, and of the groups of each class."""


def _errors(means: Arrays, bootstrap: Bootstrap, evaluation: "xarray.Dataset") -> Iterator[Measure]:
    names, units = evaluation["component"].values.tolist(), evaluation["unit"].values.tolist()
    for i, (component, unit) in enumerate(zip(names, units, strict=True)):
        for j, window in enumerate(windows_of(evaluation)):
            for s in range(CLASSES):
                share = means["share"][:, j, s]
                if share[0] > 0.0:
                    ratio = _ratio(means["squares_by_class"][:, i, j, s], share)
                    value = bootstrap.interval(numpy.sqrt(ratio))
                    yield Measure("rmse_by_class", f"{component} S{s}", window, value, unit)
            ratio = _ratio(means["squares"][:, i, j], means["variance"][:, i, j])
            yield Measure("calibration_ratio", component, window, bootstrap.interval(ratio), "1")


def _beliefs(gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset") -> Iterator[Measure]:
    each, means, seconds = gathered.each, gathered.averaged, gathered.common["seconds"]
    for k, moment in enumerate(_moments(seconds)):
        shares, probability = means["share_at_moments"][:, k], means["probability"][:, k]
        for i in numpy.flatnonzero(shares[0]):
            value = bootstrap.interval(_ratio(probability[:, i], shares[:, i]))
            yield Measure("mean_true_class_probability", GROUPS[i], f"{moment:g} s", value, "1")
    for mode, chosen in zip(GROUPS, _group_masks(each["first_class"]).T, strict=True):
        if chosen.any():
            yield from _recognition("time_to_recognise", bootstrap, each["recognised"], chosen, seconds, mode)
    changed = each["change"] < len(seconds)
    if changed.any():
        name, again = "time_to_recognise_change", each["recognised_again"]
        yield from _recognition(name, bootstrap, again, changed, seconds - seconds[0], "")
        name, detected = "time_to_detect_change", each["detected"]
        yield from _recognition(name, bootstrap, detected, changed, seconds - seconds[0], "")
    for i in numpy.flatnonzero(means["share_at_last"][0]):
        ratio = _ratio(means["wrong"][:, i], means["share_at_last"][:, i])
        window = f"{seconds[_last(seconds)]:g} s"
        yield Measure("sure_and_wrong", GROUPS[i], window, bootstrap.interval(ratio), "1")
    false = bootstrap.interval(means["false_changes"][:, 0])
    yield Measure("false_class_changes", "", "all", false, "1")
    for j, window in enumerate(windows_of(evaluation)):
        for name, key, unit in (
            ("confidence_excess", "excess", "1"),
            ("right_class", "right", "1"),
            ("class_log_score", "log_score", "nats"),
        ):
            yield Measure(name, "", window, bootstrap.interval(means[key][:, j]), unit)


METRICS = OwnMetrics(gather, measures)
