"""From an evaluation to numbers: tidy records, every one derived from the dataset and nothing else.

A record is one number with its 95 % bootstrap interval over episodes. Differences and ratios are paired:
numerator and denominator are resampled together.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy
import xarray

from .bootstrap import Bootstrap, Estimate

NOTHING = Estimate(math.nan, math.nan, math.nan)


class Record(NamedTuple):
    """One number of one policy in one window."""

    environment: str
    control: str
    scenario: str
    policy: str
    kind: str
    """"policy", "reference" or "bound"."""
    metric: str
    component: str
    window: str
    value: float | None
    low: float | None
    """Lower end of the 95 % interval; None where there is none."""
    high: float | None
    unit: str
    episodes: int
    seed: int
    split: str


class Measure(NamedTuple):
    """A record before it is told whose it is; what an environment's own metrics return."""

    metric: str
    component: str
    window: str
    estimate: Estimate
    unit: str


def squared_errors(run: xarray.Dataset, component: str, groups: dict[str, tuple[str, ...]]) -> numpy.ndarray:
    """Squared error of a component or group in one run, ``(episodes, time)``; of a bound its mean."""
    parts = list(groups.get(component, (component,)))
    if "mean_square" in run and not numpy.isnan(run["mean_square"].values[0, 0, 0]):
        return run["mean_square"].sel(component=parts).sum("component").values
    return (run["error"].sel(component=parts) ** 2).sum("component").values


def reported_components(dataset: xarray.Dataset) -> dict[str, str]:
    """Components and groups of components, with their units."""
    units = dict(zip(dataset["component"].values.tolist(), dataset["unit"].values.tolist(), strict=True))
    return units | {name: units[parts[0]] for name, parts in dataset.attrs["groups"].items()}


def mean_of_present(values: numpy.ndarray, bootstrap: Bootstrap) -> Estimate:
    """Mean over episodes and times of what is there: NaN stands for no measurement, or no event.

    A ratio of two sums, so that an episode counts by what it has; NaN where nothing is there at all.

    Args:
        values: ``(episodes, time)``.
        bootstrap: over the episodes.
    """
    present = ~numpy.isnan(values)
    sums = numpy.stack([numpy.where(present, values, 0.0).sum(axis=1), present.sum(axis=1)], axis=1)

    def ratio(means: numpy.ndarray) -> numpy.ndarray:
        nothing = numpy.full(len(means), math.nan)
        return numpy.divide(means[:, 0], means[:, 1], out=nothing, where=means[:, 1] > 0.0)

    return bootstrap.estimate(sums, ratio)


def _measures(dataset: xarray.Dataset, name: str, bootstrap: Bootstrap) -> Iterator[Measure]:
    run = dataset.sel(policy=name)
    groups, windows = dataset.attrs["groups"], dataset.attrs["windows"]
    is_bound = str(run["kind"].values) == "bound"
    slices = {w: slice(first - 1, last) for w, (first, last) in windows.items()}
    for component, unit in reported_components(dataset).items():
        squares = squared_errors(run, component, groups)
        over_time = numpy.sqrt(bootstrap.means(squares))
        for window, times in slices.items():
            value = bootstrap.estimate(squares[:, times].mean(axis=1), numpy.sqrt)
            yield Measure("rmse", component, window, value, unit)
        peak = bootstrap.interval(over_time.max(axis=1))
        yield Measure("peak_rmse", component, "all", peak, unit)
        if not is_bound and component not in groups:
            signed = run["error"].sel(component=component).values
            for window, times in slices.items():
                yield Measure(
                    "mean_error", component, window, bootstrap.estimate(signed[:, times].mean(axis=1)), unit
                )
    for metric in ("nees", "nis"):
        if metric in run and not numpy.isnan(run[metric].values).all():
            for window, times in slices.items():
                yield Measure(
                    metric,
                    "state" if metric == "nees" else "measurement",
                    window,
                    mean_of_present(run[metric].values[:, times], bootstrap),
                    "1",
                )
    if "mode_probability" in run and not numpy.isnan(run["mode_probability"].values).all():
        for mode in run["mode"].values.tolist():
            probability = run["mode_probability"].sel(mode=mode).values
            for window, times in slices.items():
                value = bootstrap.estimate(probability[:, times].mean(axis=1))
                yield Measure("mean_mode_probability", mode, window, value, "1")
    if not is_bound:
        cost, capped = run["cost"].values, run["capped_cost"].values
        for window, times in slices.items():
            yield Measure("cost", "", window, bootstrap.estimate(cost[:, times].mean(axis=1)), "1")
        yield Measure("return", "", "all", bootstrap.estimate(-capped.sum(axis=1)), "1")
        beyond = (cost > dataset.attrs["huber_bound"] ** 2).mean(axis=1)
        yield Measure("beyond_huber_bound", "", "all", bootstrap.estimate(beyond), "1")


def score(
    cost: numpy.ndarray, paper: numpy.ndarray, reference: numpy.ndarray, bootstrap: Bootstrap
) -> Estimate:
    """(C_paper - C) / (C_paper - C_reference), from means and resampled means of the three costs."""
    room = paper - reference
    interval = bootstrap.interval(room)
    # Where the room may be nothing, a ratio to it says nothing: "no room".
    has_room = interval.low > 0.0 or interval.high < 0.0
    return bootstrap.interval((paper - cost) / room) if has_room else NOTHING


def _comparisons(dataset: xarray.Dataset, name: str, bootstrap: Bootstrap) -> Iterator[Measure]:
    """Score and paired difference to the paper's algorithm, where the dataset holds what they need."""
    paper_name, reference_name = dataset.attrs["paper"], dataset.attrs["reference"]
    present = dataset["policy"].values.tolist()
    if paper_name not in present or str(dataset["kind"].sel(policy=name).values) == "bound":
        return
    cost = {
        p: bootstrap.means(dataset["cost"].sel(policy=p).values.mean(axis=1))
        for p in {name, paper_name, reference_name} & set(present)
    }
    paper = cost[paper_name]
    yield Measure("cost_difference", "", "all", bootstrap.interval(cost[name] - paper), "1")
    yield Measure("relative_cost_difference", "", "all", bootstrap.interval(cost[name] / paper - 1.0), "1")
    if reference_name in cost:
        yield Measure("score", "", "all", score(cost[name], paper, cost[reference_name], bootstrap), "1")


def tidy_records(
    dataset: xarray.Dataset, metrics: Callable[[xarray.Dataset, Bootstrap], list[Measure]] | None = None
) -> list[Record]:
    """Every metric of every policy with its interval.

    ``rmse`` (root of the mean square over episodes and the window), ``peak_rmse`` (largest over time),
    ``mean_error``, ``nees``, ``nis``, ``mean_mode_probability``, ``cost`` (uncapped mean), ``return`` (of
    the capped reward), ``beyond_huber_bound`` (share of measurements where the cap binds),
    ``cost_difference`` and ``relative_cost_difference`` to the paper's algorithm (paired), ``score``
    = (C_paper - C) / (C_paper - C_reference), and the environment's own metrics.

    Args:
        dataset: from an evaluation.
        metrics: the environment's own, from one policy's part of the dataset.
    """
    bootstrap = Bootstrap(dataset.sizes["episode"])
    attrs = dataset.attrs

    def finite(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    records = []
    for name in dataset["policy"].values.tolist():
        measures: list[Any] = [*_measures(dataset, name, bootstrap), *_comparisons(dataset, name, bootstrap)]
        if metrics is not None:
            measures += metrics(dataset.sel(policy=name), bootstrap)
        for m in measures:
            records.append(
                Record(
                    attrs["environment"],
                    str(dataset["control"].sel(policy=name).values),
                    attrs["scenario"],
                    name,
                    str(dataset["kind"].sel(policy=name).values),
                    m.metric,
                    m.component,
                    m.window,
                    finite(m.estimate.value),
                    finite(m.estimate.low),
                    finite(m.estimate.high),
                    m.unit,
                    dataset.sizes["episode"],
                    attrs["seed"],
                    attrs["split"],
                )
            )
    return records
