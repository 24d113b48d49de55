"""Curves of an evaluation over time, by competitor: the data of all its figures.

Bands of ``rmse``, mode and true-class probabilities are 95 % percentile bootstraps over episodes (Efron and
Tibshirani: An Introduction to the Bootstrap, 1993, 13.3), or over flights where episodes fly several.
"""

import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy
import xarray

from ..competitors.kinds import RANKED
from ..statistics.bootstrap import block_of, percentile_interval, ratio
from ..statistics.statistic import ALL, Key, Statistic, reduce_run
from ..storage.dataset import groups_of, windows_of, with_windows
from .metrics import (
    bootstrap_of_episodes,
    chi_square_band,
    components_and_groups,
    consistency_degrees,
    consistency_metrics,
    mean_over_time,
    squared_errors,
    sums_of_present,
)
from .threads import one_thread
from .times import COORDINATES

SHARES = numpy.geomspace(1e-4, 1.0, 121)
"""Shares of the measurements at which the distribution of errors is computed: thirty to a decade."""
BAND_RESAMPLES = 200
"""Number of bootstrap resamples for bands of curves, which need fewer than intervals of single numbers."""
DISTRIBUTION_LIMIT = 2**21
"""Maximal number of measurements in the distribution of errors: all are stored, and more do not change a figure."""
PERCENTILES = (10.0, 90.0)
"""Percentiles of actions and gains over episodes."""

MOST_STRETCHES = 100
"""Maximal number of stretches of an episode in the comparison of mean costs over time."""

ENDINGS = ("", "_low", "_high")
"""Endings of the variable names of a curve and of the lower and upper ends of its band."""

Curve = dict[str, numpy.ndarray]
"""Values of a curve and the ends of its band, by the ending of the variable name."""
Series = tuple[tuple[str, ...], numpy.ndarray]
"""Dimensions and values of a dataset variable."""


@one_thread()
def curves_of(dataset: xarray.Dataset, resamples: int = BAND_RESAMPLES) -> xarray.Dataset:
    """Return the data of an evaluation's figures, such as errors and consistency over time, and costs by
    stretch.

    Args:
        dataset: evaluation, in memory or read from a file; also with some of its policies only.
        resamples: number of bootstrap resamples.

    Returns:
        Variables over policy and time; NaN where a competitor has none, absent where no competitor has:

        * ``rmse`` (policy, quantity, time), in the unit of the quantity, with ``rmse_low`` and ``rmse_high``: root of
          the mean square error over episodes;
        * ``error_exceeded`` (policy, quantity, share), in the unit of the quantity: size of error that this share of
          measurements reaches or exceeds; none of bounds, nor where there are too few measurements for a share;
        * ``anees`` and ``anis`` (policy, time): mean NEES and NIS over their dimension, with the 95 % chi-square band
          of that mean, ``anees_low`` and so on, (time);
        * ``mode_probability`` (policy, mode, time) and ``true_class_probability`` (policy, time): means over episodes,
          with ``_low`` and ``_high``;
        * ``action`` (policy, action_name, time): mean over episodes of the actions applied, with their 10 and 90 %
          percentiles, ``_low`` and ``_high``, of policies whose action is a box; ``gain`` (policy, gain_name, time), of
          gains that a bank records, with the same percentiles;
        * ``mean_cost`` (policy): mean over episodes;
        * ``cost_minus_paper`` and ``cost_minus_best`` (policy, stretch): mean cost over stretches of the episode less
          that of the paper's algorithm and of the best ranked competitor, paired, with ``_low`` and ``_high``.

        Exceeded errors, actions and gains are those of the first ``DISTRIBUTION_LIMIT`` measurements, or of the first
        256 episodes, whichever are more. Coordinates ``kind`` and ``control`` of every policy, ``nanoseconds`` and
        ``compiled`` if the evaluation was timed, ``unit`` of every quantity (the groups of components where there are
        any, else the first three components), ``elapsed`` (s) of every measurement, where they come regularly, and
        windows as the dataset has them. Attributes environment, scenario, split, seed, episodes, paper, reference,
        cost, truth and recorded.
    """
    bootstrap = bootstrap_of_episodes(dataset, resamples)
    declare = functools.partial(curve_statistics, episodes=bootstrap.episodes, resamples=resamples)
    runs = (dataset.sel(policy=name) for name in dataset["policy"].values.tolist())
    found = [competitor_curves(reduce_run(run, declare, bootstrap).results()) for run in runs]
    return stack_curves(found, dataset, bootstrap.episodes)


def evenly_spaced(count: int, most: int) -> numpy.ndarray:
    """Return at most ``most`` evenly spaced indices below ``count``, including the first and the last."""
    return numpy.unique(numpy.linspace(0, count - 1, min(count, most)).round().astype(int))


class CompetitorCurves(NamedTuple):
    """Curves of one competitor over time by name, and the names of its actions and gains."""

    curves: dict[str, numpy.ndarray]
    actions: list[str]
    gains: list[str]
    costs: numpy.ndarray | None = None
    """Mean over episodes of the cost in each stretch, in the data and every resample, ``(1 + resamples, stretches)``;
    None for bounds, and without truth."""

    def at_measurements(self, indices: numpy.ndarray, times: int) -> "CompetitorCurves":
        """Select some of ``times`` measurements in all curves over time."""
        over_time = {key for key, own in self.curves.items() if own.shape[-1:] == (times,)}
        fewer = {key: own[..., indices] if key in over_time else own for key, own in self.curves.items()}
        return self._replace(curves=fewer)


def competitor_curves(results: Mapping[Key, Any]) -> CompetitorCurves:
    """Return the curves of one competitor, from the results of :func:`curve_statistics` over all its episodes."""
    curves = {"mean_cost": numpy.array(results["cost",].mean())} if ("cost",) in results else {}
    labels: dict[str, list[str]] = {}
    for (kind, *words), endings in results.items():
        if kind == "curve":
            name, *labels[name] = words
            curves |= {name + ending: values for ending, values in endings.items()}
    return CompetitorCurves(
        curves, labels.get("action", []), labels.get("gain", []), results.get(("stretches",))
    )


def select_quantities(dataset: xarray.Dataset) -> list[str]:
    """Return the quantities with known truth: groups of components, or else the first three components."""
    reported = list(components_and_groups(dataset))
    return [name for name in groups_of(dataset) if name in reported] or reported[:3]


def curve_statistics(
    run: xarray.Dataset, episodes: int, resamples: int = BAND_RESAMPLES
) -> Iterator[Statistic]:
    """Yield the statistics of one competitor's curves as declarations, for some of its episodes."""
    times = run.sizes["time"]
    resamples = resamples if episodes > 1 else 0  # one episode has no variation over episodes
    distributed = max(block_of(times), DISTRIBUTION_LIMIT // times)
    if run.attrs["truth"]:
        groups = groups_of(run)
        squares = numpy.stack([squared_errors(run, name, groups) for name in select_quantities(run)], axis=-1)
        yield Statistic(("curve", "rmse"), squares, _rmse, resamples)
        if str(run["kind"].values) != "bound":
            yield Statistic(("curve", "error_exceeded"), squares, _exceedance, sample=distributed)
            yield Statistic(("cost",), mean_over_time(run, run["cost"].values), sample=ALL)
            yield Statistic(("stretches",), cost_in_stretches(run["cost"].values), resamples=resamples)
    for name in ("mode_probability", "true_class_probability"):
        if name in run:
            values = run[name].transpose("episode", ..., "time").values
            yield Statistic(("curve", name), values, _band, resamples)
    for metric in consistency_metrics(run):
        values, degrees = run[metric].values, consistency_degrees(run, metric)
        present = ~numpy.isnan(values)
        sums = numpy.stack([numpy.where(present, values, 0.0), degrees * present], axis=1)
        yield Statistic(
            ("curve", f"a{metric}"), sums, functools.partial(_over_dimension, episodes), 0, optional=True
        )
    if "action" in run:
        values = run["action"].transpose("episode", "action_name", "time").values
        there = ~numpy.isnan(values).all(axis=(0, 2))
        if there.any():
            names = run["action_name"].values[there].tolist()
            yield Statistic(("curve", "action", *names), values[:, there], _spread, sample=distributed)
    gains = [name for name in gains_of(run) if not numpy.isnan(run[name].values).all()]
    if gains:
        values = numpy.stack([run[name].values for name in gains], axis=1)
        yield Statistic(("curve", "gain", *gains), values, _spread, sample=distributed)


DIMENSIONS: dict[str, tuple[str, ...]] = {
    "rmse": ("quantity", "time"),
    "error_exceeded": ("quantity", "share"),
    "mean_cost": (),
    "anees": ("time",),
    "anis": ("time",),
    "mode_probability": ("mode", "time"),
    "true_class_probability": ("time",),
    "action": ("action_name", "time"),
    "gain": ("gain_name", "time"),
}
"""Dimensions of a curve, after the competitor."""


def stack_curves(
    competitors: Sequence[CompetitorCurves], dataset: xarray.Dataset, episodes: int
) -> xarray.Dataset:
    """Combine the curves of several competitors into one dataset, see :func:`curves_of`."""
    units, shown = components_and_groups(dataset), select_quantities(dataset)
    names = {
        "action_name": list(dict.fromkeys(name for each in competitors for name in each.actions)),
        "gain_name": list(dict.fromkeys(name for each in competitors for name in each.gains)),
    }
    variables: dict[str, Series] = {}
    for key, dims in DIMENSIONS.items():
        for ending in ENDINGS:
            own = [each.curves.get(key + ending) for each in competitors]
            shapes = [values.shape for values in own if values is not None]
            if not shapes:
                continue
            listed = names.get(dims[0], []) if dims else []
            shape = (len(listed), *shapes[0][1:]) if listed else shapes[0]
            stacked = numpy.full((len(competitors), *shape), numpy.nan)
            for i, (values, each) in enumerate(zip(own, competitors, strict=True)):
                if values is not None and listed:
                    of = each.actions if key == "action" else each.gains
                    stacked[i, [listed.index(name) for name in of]] = values
                elif values is not None:
                    stacked[i] = values
            if (
                key in variables or not numpy.isnan(stacked).all()
            ):  # a curve without a band has NaN for its ends
                variables[key + ending] = (("policy", *dims), stacked)
    variables |= _consistency_bands(competitors)
    best = _cheapest(competitors, dataset)
    bases = {"paper": dataset.attrs["paper"], "best": best}
    differences = _cost_differences(competitors, dataset["policy"].values.tolist(), bases)
    variables |= differences
    coords: dict[str, Any] = {
        name: dataset[name].variable
        for name in ("policy", "kind", "control", *COORDINATES, "time", "elapsed")
        if name in dataset.coords
    }
    if dataset.attrs["truth"]:
        coords |= {"quantity": shown, "unit": ("quantity", [units[name] for name in shown])}
        if "error_exceeded" in variables:
            coords["share"] = SHARES
    if "mode_probability" in variables:
        coords["mode"] = dataset["mode"].variable
    coords |= {name: listed for name, listed in names.items() if listed}
    if differences:
        coords |= _stretch_coords(dataset)
    attrs = {
        name: dataset.attrs[name]
        for name in (
            "environment",
            "scenario",
            "split",
            "seed",
            "paper",
            "reference",
            "cost",
            "truth",
            "recorded",
        )
    }
    attrs |= {"episodes": episodes} | ({"best": best} if best else {})
    curves = xarray.Dataset(variables, coords, attrs)
    return with_windows(curves, windows_of(dataset))


def stretches_of(times: int) -> list[slice]:
    """Divide an episode of ``times`` measurements into at most ``MOST_STRETCHES`` slices; the last may be
    shorter.
    """
    length = -(-times // MOST_STRETCHES)
    return [slice(first, min(first + length, times)) for first in range(0, times, length)]


def cost_in_stretches(cost: numpy.ndarray) -> numpy.ndarray:
    """Return the mean cost in each stretch of every episode, ``(episodes, stretches)``; NaN where there is
    none.
    """
    means = [ratio(sums_of_present(cost[:, stretch])) for stretch in stretches_of(cost.shape[1])]
    return numpy.stack(means, axis=1)


def _stretch_coords(dataset: xarray.Dataset) -> dict[str, Any]:
    """Return the middle of each stretch as dataset coordinates: measurement number, and seconds if regular."""
    middles = {
        name: [float(dataset[name].values[stretch].mean()) for stretch in stretches_of(dataset.sizes["time"])]
        for name in ("time", "elapsed")
        if name in dataset.coords
    }
    return {
        "stretch": middles["time"],
        **({"stretch_elapsed": ("stretch", middles["elapsed"])} if "elapsed" in middles else {}),
    }


def _cheapest(found: Sequence[CompetitorCurves], dataset: xarray.Dataset) -> str:
    """Return the name of the ranked competitor with the lowest mean cost; empty if none is ranked."""
    named = zip(dataset["policy"].values.tolist(), dataset["kind"].values.tolist(), found, strict=True)
    means = {
        str(name): float(each.curves["mean_cost"])
        for name, kind, each in named
        if kind in RANKED and each.costs is not None
    }
    return min(means, key=means.__getitem__, default="")


def _cost_differences(
    found: Sequence[CompetitorCurves], names: Sequence[str], bases: Mapping[str, str]
) -> dict[str, Series]:
    """Return dataset variables of mean costs over time minus those of other competitors, paired, with bands."""
    variables: dict[str, Series] = {}
    for key, base in bases.items():
        theirs = found[names.index(base)].costs if base in names else None
        if theirs is None or len(names) < 2:
            continue
        bands = numpy.full((3, len(found), theirs.shape[1]), numpy.nan)
        for i, each in enumerate(found):
            if each.costs is not None:
                bands[:, i] = percentile_interval(each.costs - theirs)
        for ending, values in zip(ENDINGS, bands, strict=True):
            variables[f"cost_minus_{key}{ending}"] = (("policy", "stretch"), values)
    return variables


def gains_of(dataset: xarray.Dataset) -> list[str]:
    """Return the names of the dataset's gains of a bank, one number for every measurement."""
    names = map(str, dataset.data_vars)
    return [
        name
        for name in names
        if dataset[name].dims[-2:] == ("episode", "time")
        and dataset[name].dims[:-2] in ((), ("policy",))
        # A rate is the same gain over the sampling interval.
        and (name == "alpha" or (name.startswith("gain") and not name.startswith("gain_rate")))
    ]


def error_exceedance(errors: numpy.ndarray) -> numpy.ndarray:
    """Return the size of error that each share :data:`SHARES` of the errors reaches or exceeds, ``(shares,)``.

    Args:
        errors: non-negative errors of any shape; NaN is left out, and the result for a share of less than one
            error.
    """
    descending = -numpy.sort(-errors, axis=None)  # NaN comes last
    count = int(numpy.isfinite(descending).sum())
    which = numpy.rint(SHARES * count).astype(int)
    found = numpy.full(len(SHARES), numpy.nan)
    supported = SHARES * count >= 1.0 - 1e-9
    found[supported] = descending[which[supported] - 1]
    return found


def _consistency_bands(found: Sequence[CompetitorCurves]) -> dict[str, Series]:
    """Return the 95 % bands of ANEES and ANIS over time for a consistent filter, as dataset variables.

    Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking and Navigation, 2001, 5.4.
    """
    variables: dict[str, Series] = {}
    for key in ("anees", "anis"):
        name = f"{key}_dimension"
        dimensions = [each.curves[name] for each in found if name in each.curves]
        if dimensions:
            # Where some measurements are missing the bands differ little; the widest is stored.
            fewest = min(dimensions, key=lambda dimension: dimension.sum())
            there = fewest > 0.0
            ends = numpy.full((2, len(fewest)), numpy.nan)
            ends[:, there] = numpy.array(chi_square_band(fewest[there])) / fewest[there]
            for ending, end in zip(("_low", "_high"), ends, strict=True):
                variables[key + ending] = (("time",), end)
    return variables


def _spread(values: numpy.ndarray) -> Curve:
    """Return the mean and the 10 and 90 % percentiles over episodes of values ``(episodes, name, time)``."""
    flat = values.reshape(len(values), -1)
    found = numpy.full((3, flat.shape[1]), numpy.nan)
    absent = numpy.isnan(flat)
    whole, some = ~absent.any(axis=0), absent.any(axis=0) & ~absent.all(axis=0)
    # NumPy's functions that leave NaN out are slow, and few columns have any.
    found[0, whole] = flat[:, whole].mean(axis=0)
    found[1:, whole] = numpy.percentile(flat[:, whole], PERCENTILES, axis=0)
    found[0, some] = numpy.nanmean(flat[:, some], axis=0)
    found[1:, some] = numpy.nanpercentile(flat[:, some], PERCENTILES, axis=0)
    return dict(zip(ENDINGS, found.reshape(3, *values.shape[1:]), strict=True))


def _band(means: numpy.ndarray) -> Curve:
    return dict(zip(ENDINGS, percentile_interval(means), strict=True))


def _rmse(means: numpy.ndarray) -> Curve:
    return _band(numpy.moveaxis(numpy.sqrt(means), -1, 1))


def _exceedance(squares: numpy.ndarray) -> Curve:
    errors = numpy.moveaxis(numpy.sqrt(squares), -1, 0)
    return {"": numpy.stack([error_exceedance(each) for each in errors])}


def _over_dimension(episodes: int, means: numpy.ndarray) -> Curve:
    """Return ANEES or ANIS and the sum of dimensions over time, from episode means of both, ``(1, 2, time)``."""
    return {"": ratio(means)[0], "_dimension": episodes * means[0, 1]}
