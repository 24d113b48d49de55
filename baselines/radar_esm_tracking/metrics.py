"""Metrics of RadarEsmTracking: errors by class, recognition of the class, calibration."""

import math
from collections.abc import Iterator

import numpy
import xarray

from ...evaluation.bootstrap import Bootstrap, Estimate
from ...evaluation.dataset import windows_of
from ...evaluation.metrics import Measure, squared_errors

SURE = 0.9
"""Probability from which a class counts as recognised."""
TIMES = (2.0, 5.0, 10.0, 20.0, 30.0, 60.0)
"""Seconds at which the probability of the true class is reported."""


def _ratio(bootstrap: Bootstrap, values: numpy.ndarray, shares: numpy.ndarray) -> numpy.ndarray:
    """Ratio of means over episodes, ``(1 + resamples,)``."""
    with numpy.errstate(divide="ignore", invalid="ignore"):
        return bootstrap.means(values) / bootstrap.means(shares)


def time_quantile(
    bootstrap: Bootstrap, first: numpy.ndarray, chosen: numpy.ndarray, seconds: numpy.ndarray, share: float
) -> Estimate:
    """Time by which a share of the chosen episodes has got there; infinite where too few do.

    Args:
        bootstrap: of the episodes.
        first: index of the first time at which it holds, or the number of times, ``(episodes,)``.
        chosen: which episodes count, ``(episodes,)`` booleans.
        seconds: of each time, ``(T,)``.
        share: such as 0.5 for the median.
    """
    reached = (first[:, None] == numpy.arange(len(seconds))) & chosen[:, None]
    arrived = numpy.cumsum(bootstrap.means(reached.astype(float)), axis=1)
    everyone = bootstrap.means(chosen.astype(float))[:, None]
    # Rounding of the sums must not move a share that is met exactly.
    enough = arrived >= share * everyone * (1.0 - 1e-9)
    times = numpy.where(enough.any(axis=1), seconds[enough.argmax(axis=1)], math.inf)
    return bootstrap.interval(times)


def _first(condition: numpy.ndarray) -> numpy.ndarray:
    """Index of the first true entry along time, or the number of times, ``(episodes,)``."""
    return numpy.where(condition.any(axis=1), condition.argmax(axis=1), condition.shape[1])


def _recognition(
    name: str, bootstrap: Bootstrap, first: numpy.ndarray, chosen: numpy.ndarray, seconds: numpy.ndarray,
    component: str,
) -> Iterator[Measure]:  # fmt: skip
    for suffix, share in (("median", 0.5), ("90_quantile", 0.9)):
        value = time_quantile(bootstrap, first, chosen, seconds, share)
        yield Measure(f"{name}_{suffix}", component, "all", value, "s")
    never = ((first == len(seconds)) & chosen).astype(float)
    censored = bootstrap.interval(_ratio(bootstrap, never, chosen.astype(float)))
    yield Measure(f"{name}_censored", component, "all", censored, "1")


def metrics(run: xarray.Dataset, bootstrap: Bootstrap) -> list[Measure]:
    """Errors by true class, recognition of the class, and calibration, of one policy.

    ``rmse_by_class`` (by the class at each measurement); ``mean_true_class_probability`` at stated times;
    ``time_to_recognise_median``, ``_90_quantile`` (first P(true class) >= 0.9) and ``_censored``, the share of
    runs in which that never comes while the first class lasts; ``time_to_recognise_change_...`` the same
    after a change, counted from it; ``sure_and_wrong``, the share of runs with P >= 0.9 for a wrong class at
    60 s (or the end); ``calibration_ratio``, mean square error over mean reported variance;
    ``confidence_excess``, mean probability of the most probable class minus how often it is the true one.
    A reference has no class probabilities: of it only errors and calibration.
    """
    if _missing(run, "true_class"):
        return []  # a bound
    errors = list(_errors(run, bootstrap))
    return errors if _missing(run, "mode_probability") else [*errors, *_beliefs(run, bootstrap)]


def _missing(run: xarray.Dataset, name: str) -> bool:
    return name not in run or bool(numpy.isnan(run[name].values).any())


def _slices(run: xarray.Dataset) -> dict[str, slice]:
    return {name: slice(first - 1, last) for name, (first, last) in windows_of(run).items()}


def _groups(true_class: numpy.ndarray) -> dict[str, numpy.ndarray]:
    """Everybody, and the targets of each class, ``(episodes, T)`` booleans."""
    by_class = {f"S{s}": true_class == s for s in numpy.unique(true_class)}
    return {"": numpy.ones(true_class.shape, dtype=bool)} | by_class


def _errors(run: xarray.Dataset, bootstrap: Bootstrap) -> Iterator[Measure]:
    slices, groups = _slices(run), _groups(run["true_class"].values.astype(int))
    units = dict(zip(run["component"].values.tolist(), run["unit"].values.tolist(), strict=True))
    for component, unit in units.items():
        squares = squared_errors(run, component, {})
        variance = run[f"variance_{component}"].values
        for window, times in slices.items():
            means = squares[:, times].mean(axis=1)
            for mode, of_mode in groups.items():
                if mode:
                    share = of_mode[:, times].mean(axis=1)
                    if share.any():
                        ratio = _ratio(bootstrap, (squares * of_mode)[:, times].mean(axis=1), share)
                        value = bootstrap.interval(numpy.sqrt(ratio))
                        yield Measure("rmse_by_class", f"{component} {mode}", window, value, unit)
            ratio = _ratio(bootstrap, means, variance[:, times].mean(axis=1))
            yield Measure("calibration_ratio", component, window, bootstrap.interval(ratio), "1")


def _beliefs(run: xarray.Dataset, bootstrap: Bootstrap) -> Iterator[Measure]:
    true_class = run["true_class"].values.astype(int)
    groups = _groups(true_class)
    true_probability = run["true_class_probability"].values
    probability = run["mode_probability"].values
    seconds = run["seconds"].values[0]
    for moment in TIMES:
        at = numpy.flatnonzero(numpy.isclose(seconds, moment))
        for mode, of_mode in groups.items():
            if len(at) and of_mode[:, at[0]].any():
                chosen = of_mode[:, at[0]].astype(float)
                ratio = _ratio(bootstrap, true_probability[:, at[0]] * chosen, chosen)
                value = bootstrap.interval(ratio)
                yield Measure("mean_true_class_probability", mode, f"{moment:g} s", value, "1")

    sure = true_probability >= SURE
    same = true_class == true_class[:, :1]
    for mode, of_mode in groups.items():
        if of_mode[:, 0].any():
            yield from _recognition(
                "time_to_recognise", bootstrap, _first(sure & same), of_mode[:, 0], seconds, mode
            )
    if not same.all():
        change = _first(~same)
        after = numpy.arange(len(seconds)) >= change[:, None]
        waited = _first(sure & after)
        waited = numpy.where(waited < len(seconds), waited - change, len(seconds))
        changed = change < len(seconds)
        yield from _recognition(
            "time_to_recognise_change", bootstrap, waited, changed, seconds - seconds[0], ""
        )

    reached = numpy.flatnonzero(numpy.isclose(seconds, TIMES[-1]))
    last = int(reached[0]) if len(reached) else len(seconds) - 1
    wrong = (probability[:, last] >= SURE) & (numpy.arange(probability.shape[2]) != true_class[:, last, None])
    for mode, of_mode in groups.items():
        chosen = of_mode[:, last].astype(float)
        if chosen.any():
            ratio = _ratio(bootstrap, wrong.any(axis=1) * chosen, chosen)
            yield Measure("sure_and_wrong", mode, f"{seconds[last]:g} s", bootstrap.interval(ratio), "1")

    excess = probability.max(axis=2) - (probability.argmax(axis=2) == true_class)
    for window, times in _slices(run).items():
        value = bootstrap.estimate(excess[:, times].mean(axis=1))
        yield Measure("confidence_excess", "", window, value, "1")
