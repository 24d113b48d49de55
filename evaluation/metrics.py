"""From an evaluation to numbers: tidy records, every one derived from the dataset and nothing else.

A record is one number with its 95 % bootstrap interval over episodes, or over flights where episodes fly several.
Differences and ratios are paired: numerator and denominator are resampled together.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy
import xarray
from scipy.special import gammaincinv  # scipy.stats has the quantile too, and takes a second to import

from .bootstrap import RESAMPLES, Bootstrap, Estimate
from .competitors import RANKED
from .dataset import groups_of, seed_of, windows_of, with_windows
from .threads import one_thread

NOTHING = Estimate(math.nan, math.nan, math.nan)


class Record(NamedTuple):
    """One number of one policy in one window."""

    environment: str
    control: str
    scenario: str
    policy: str
    kind: str
    """"policy", "estimator", "reference" or "bound"."""
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
        return run["mean_square"].sel(component=parts).sum("component", skipna=False).values
    return (run["error"].sel(component=parts) ** 2).sum("component", skipna=False).values


def reported_components(dataset: xarray.Dataset) -> dict[str, str]:
    """Components and groups of components, with their units."""
    units = dict(zip(dataset["component"].values.tolist(), dataset["unit"].values.tolist(), strict=True))
    return units | {name: units[parts[0]] for name, parts in groups_of(dataset).items()}


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


def bootstrap_of(dataset: xarray.Dataset, resamples: int = RESAMPLES) -> Bootstrap:
    """Resampling of the episodes of an evaluation; of whole flights where they fly several."""
    clusters = dataset["flight"].values.tolist() if "flight" in dataset.coords else None
    return Bootstrap(dataset.sizes["episode"], resamples, clusters=clusters)


def mean_over_time(run: xarray.Dataset, values: numpy.ndarray) -> numpy.ndarray:
    """Mean of each episode, ``(episodes,)``; where flights differ in length, over its own.

    Args:
        run: that the values are of.
        values: ``(episodes, time)``; NaN beyond the end of a flight, or of a window that it does not reach.
    """
    if "flight" not in run.coords:
        return values.mean(axis=1)
    present = ~numpy.isnan(values)
    nothing = numpy.full(len(values), math.nan)
    return numpy.divide(
        numpy.where(present, values, 0.0).sum(axis=1),
        present.sum(axis=1),
        out=nothing,
        where=present.any(axis=1),
    )


def _measures(dataset: xarray.Dataset, name: str, bootstrap: Bootstrap) -> Iterator[Measure]:
    run = dataset.sel(policy=name)
    groups, windows = groups_of(dataset), windows_of(dataset)
    is_bound = str(run["kind"].values) == "bound"
    slices = {w: slice(first - 1, last) for w, (first, last) in windows.items()}
    judged = dataset.attrs.get("truth", True)
    for component, unit in reported_components(dataset).items() if judged else ():
        squares = squared_errors(run, component, groups)
        over_time = numpy.sqrt(bootstrap.means(squares))
        for window, times in slices.items():
            value = bootstrap.estimate(mean_over_time(run, squares[:, times]), numpy.sqrt)
            yield Measure("rmse", component, window, value, unit)
        peak = bootstrap.interval(numpy.fmax.reduce(over_time, axis=1))
        yield Measure("peak_rmse", component, "all", peak, unit)
        if not is_bound and component not in groups:
            signed = run["error"].sel(component=component).values
            for window, times in slices.items():
                value = bootstrap.estimate(mean_over_time(run, signed[:, times]))
                yield Measure("mean_error", component, window, value, unit)
    for metric in ("nees", "nis"):
        if metric in consistency_metrics(run):
            for window, times in slices.items():
                yield from _consistency(run.isel(time=times), metric, window, bootstrap)
    if "mode_probability" in run and not numpy.isnan(run["mode_probability"].values).all():
        for mode in run["mode"].values.tolist():
            probability = run["mode_probability"].sel(mode=mode).values
            for window, times in slices.items():
                value = bootstrap.estimate(mean_over_time(run, probability[:, times]))
                yield Measure("mean_mode_probability", mode, window, value, "1")
    says = "log_likelihood" in run and not numpy.isnan(run["log_likelihood"].values).all()
    if says or not judged:  # there is nothing else of an estimator of one's own then
        for window, times in slices.items():
            value = mean_of_present(run["log_likelihood"].values[:, times], bootstrap) if says else NOTHING
            yield Measure("log_likelihood", "measurement", window, value, "nat")
    if not is_bound and judged:
        cost = run["cost"].values
        for window, times in slices.items():
            value = bootstrap.estimate(mean_over_time(run, cost[:, times]))
            yield Measure("cost", "", window, value, "1")
        charge = run["charge"].values
        total = numpy.nansum(charge, axis=1) if bootstrap.ragged else charge.sum(axis=1)
        yield Measure("return", "", "all", bootstrap.estimate(-total), "1")


def _consistency(run: xarray.Dataset, metric: str, window: str, bootstrap: Bootstrap) -> Iterator[Measure]:
    """Whether errors and innovations are as large as the covariances say: one, and 95 %, where they are.

    The mean over the dimension, and the share of measurements inside the chi-square distribution's two-sided 95 %
    interval (Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking and Navigation, 2001, 5.4).
    """
    component = "state" if metric == "nees" else "measurement"
    values, degrees = run[metric].values, consistency_degrees(run, metric)
    normalised = numpy.where(degrees > 0.0, values / numpy.where(degrees > 0.0, degrees, 1.0), numpy.nan)
    yield Measure(f"a{metric}", component, window, mean_of_present(normalised, bootstrap), "1")
    low, high = chi_square_band(degrees)
    inside = numpy.where(numpy.isnan(normalised), numpy.nan, (values >= low) & (values <= high))
    yield Measure(f"{metric}_inside", component, window, mean_of_present(inside, bootstrap), "1")
    if metric == "nis":
        yield Measure("anis_band", component, window, _band(degrees[~numpy.isnan(normalised)]), "1")


def _band(degrees: numpy.ndarray) -> Estimate:
    """Where the mean of that many chi-square numbers, each over its degrees of freedom, lies with 95 %.

    The chi-square distribution of the same variance; the very one where all degrees are equal.
    """
    if not degrees.size:
        return NOTHING
    total = numpy.array([degrees.size**2 / (1.0 / degrees).sum()])
    low, high = chi_square_band(total)
    return Estimate(1.0, float(low[0] / total[0]), float(high[0] / total[0]))


def consistency_metrics(run: xarray.Dataset) -> list[str]:
    """Which of ``nees`` and ``nis`` there are; the latter needs its dimension beside it, ``nis_degrees``."""
    present = ["nees"] * ("nees" in run) + ["nis"] * ("nis" in run and "nis_degrees" in run)
    return [metric for metric in present if not numpy.isnan(run[metric].values).all()]


def consistency_degrees(run: xarray.Dataset, metric: str) -> numpy.ndarray:
    """Dimension of what ``nees`` or ``nis`` is of, as their arrays are."""
    if metric == "nees":
        return numpy.full(run["nees"].shape, float(run.sizes["component"]))
    return numpy.nan_to_num(run["nis_degrees"].values)


def chi_square_band(degrees: numpy.ndarray, runs: int = 1) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Two-sided 95 % interval of the mean over ``runs`` of chi-square numbers with these degrees of freedom."""
    # Few different ones, and the quantile is dear.
    different, which = numpy.unique(degrees, return_inverse=True)
    low, high = (2.0 * gammaincinv(0.5 * runs * different, p) / runs for p in (0.025, 0.975))
    return low[which].reshape(degrees.shape), high[which].reshape(degrees.shape)


def score(
    cost: numpy.ndarray, paper: numpy.ndarray, reference: numpy.ndarray, bootstrap: Bootstrap
) -> Estimate:
    """(C_paper - C) / (C_paper - C_reference), from means and resampled means of the three costs."""
    room = paper - reference
    # Where the reference is not significantly better than the paper, a ratio to the room says nothing, and where it is
    # worse it would praise what is worse still: "no room".
    return bootstrap.interval((paper - cost) / room) if bootstrap.interval(room).low > 0.0 else NOTHING


def best_of(dataset: xarray.Dataset) -> str:
    """Name of the ranked competitor with the lowest mean cost; empty where none is ranked, or nobody knows costs."""
    ranked = dataset.isel(policy=numpy.isin(dataset["kind"].values, RANKED))
    if "cost" not in dataset or not ranked.sizes["policy"]:
        return ""
    costs = [mean_cost(ranked, name).mean() for name in ranked["policy"].values.tolist()]
    return str(ranked["policy"].values[numpy.argmin(costs)])


def mean_cost(dataset: xarray.Dataset, name: str) -> numpy.ndarray:
    """Mean cost of every episode of one competitor, ``(episodes,)``."""
    return mean_over_time(dataset, dataset["cost"].sel(policy=name).values)


def _behind_best(dataset: xarray.Dataset, name: str, best: str, bootstrap: Bootstrap) -> Iterator[Measure]:
    """Paired relative difference of the cost to the best one's."""
    if not best or str(dataset["kind"].sel(policy=name).values) not in RANKED:
        return
    own, lowest = (bootstrap.means(mean_cost(dataset, p)) for p in (name, best))
    yield Measure("behind_best", best, "all", bootstrap.interval(own / lowest - 1.0), "1")


def _comparisons(dataset: xarray.Dataset, name: str, bootstrap: Bootstrap) -> Iterator[Measure]:
    """Score and paired difference to the paper's algorithm, where the dataset holds what they need."""
    paper_name, reference_name = dataset.attrs["paper"], dataset.attrs["reference"]
    present = dataset["policy"].values.tolist()
    if (
        "cost" not in dataset
        or paper_name not in present
        or str(dataset["kind"].sel(policy=name).values) == "bound"
    ):
        return
    each = {p: mean_cost(dataset, p) for p in {name, paper_name, reference_name} & set(present)}
    cost = {p: bootstrap.means(values) for p, values in each.items()}
    paper = cost[paper_name]
    yield Measure("cost_difference", "", "all", bootstrap.interval(cost[name] - paper), "1")
    yield Measure("relative_cost_difference", "", "all", bootstrap.interval(cost[name] / paper - 1.0), "1")
    ratio = each[name] / each[paper_name]
    yield Measure("median_cost_ratio", "", "all", bootstrap.interval(bootstrap.medians(ratio)), "1")
    # A draw is half a win, so that the paper's algorithm wins half against itself; rounding decides nothing.
    draw = numpy.isclose(ratio, 1.0, rtol=0.0, atol=1e-9)
    wins = numpy.where(draw, 0.5, ratio < 1.0)
    yield Measure("win_rate", "", "all", bootstrap.estimate(wins), "1")
    if reference_name in cost:
        yield Measure("score", "", "all", score(cost[name], paper, cost[reference_name], bootstrap), "1")


def flight_records(dataset: xarray.Dataset) -> list[Record]:
    """Cost, errors and difference to the paper's algorithm of every flight, in the order of their names.

    Their scenario is the set's, a colon and the flight's name; their intervals are over the episodes of that flight.

    Args:
        dataset: from an evaluation of a set of flights.
    """
    records = []
    for flight in sorted(set(dataset["flight"].values.tolist())):
        part = dataset.isel(episode=numpy.flatnonzero(dataset["flight"].values == flight))
        part = part.isel(time=slice(int(part["length"].max())))
        windows = {name: (first, part.sizes["time"]) for name, (first, _) in windows_of(part).items()}
        part = with_windows(part.assign_attrs(scenario=f"{dataset.attrs['scenario']}: {flight}"), windows)
        records += [r for r in tidy_records(part) if r.metric in PER_FLIGHT]
    return records


PER_FLIGHT = ("rmse", "cost", "cost_difference", "relative_cost_difference")
"""Metrics that are told of every flight."""


@one_thread()
def tidy_records(
    dataset: xarray.Dataset, metrics: Callable[[xarray.Dataset, Bootstrap], list[Measure]] | None = None
) -> list[Record]:
    """Every metric of every policy with its interval.

    ``rmse`` (root of the mean square over episodes and the window), ``peak_rmse`` (largest over time),
    ``mean_error``; ``anees`` and ``anis`` (mean NEES and NIS over their dimension; one if consistent), ``nees_inside``
    and ``nis_inside`` (share inside the 95 % chi-square interval), ``anis_band`` (where the mean lies with 95 % if all
    is consistent); ``log_likelihood`` (mean log-density of a measurement as it was predicted);
    ``mean_mode_probability``; ``cost`` (uncapped mean), ``return`` (sum of the ``cost`` rewards). Without truth what
    needs it is left out.

    Against the paper's algorithm ``cost_difference`` and ``relative_cost_difference`` (paired), ``median_cost_ratio``
    and ``win_rate`` over episodes, ``score`` = (C_paper - C) / (C_paper - C_reference). Against the best of what is
    ranked ``behind_best`` (paired; the component names the best). And the environment's own metrics.

    Args:
        dataset: from an evaluation.
        metrics: the environment's own, from one policy's part of the dataset; left out for recordings.
    """
    bootstrap, best = bootstrap_of(dataset), best_of(dataset)
    attrs = dataset.attrs

    def finite(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    records = []
    for name in dataset["policy"].values.tolist():
        measures: list[Any] = [*_measures(dataset, name, bootstrap), *_comparisons(dataset, name, bootstrap)]
        measures += _behind_best(dataset, name, best, bootstrap)
        # Of a recording, they would ask for more of the truth than it holds.
        if metrics is not None and not attrs.get("recorded"):
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
                    seed_of(dataset),
                    attrs["split"],
                )
            )
    return records
