"""What figures need of an evaluation: one reduction over its episodes, from which every picture is drawn.

Bands of ``rmse``, mode and true-class probabilities are 95 % percentile bootstraps over episodes (Efron and Tibshirani:
An Introduction to the Bootstrap, 1993, 13.3), or over flights where episodes fly several. Beyond the end of shorter
flights what is missing is left out.
"""

from collections.abc import Sequence
from typing import Any

import numpy
import xarray

from .bootstrap import Bootstrap
from .dataset import groups_of, windows_of, with_windows
from .metrics import (
    bootstrap_of,
    chi_square_band,
    consistency_degrees,
    consistency_metrics,
    mean_cost,
    reported_components,
    squared_errors,
)
from .threads import one_thread

SHARES = numpy.geomspace(1e-4, 1.0, 121)
"""At which the distribution of errors is told: thirty to a decade."""
PERCENTILES = (10.0, 90.0)
"""Of actions and gains over episodes."""

Series = tuple[tuple[str, ...], numpy.ndarray]
"""Dimensions and values of a variable."""


@one_thread()
def curves_of(dataset: xarray.Dataset, resamples: int = 200) -> xarray.Dataset:
    """Reduce an evaluation to what its figures show.

    Args:
        dataset: from an evaluation, as it was or read from a file; also some of its policies.
        resamples: of the bootstrap.

    Returns:
        Variables over policy and time, of 64-bit floats; NaN where a competitor has none, and absent where nobody has:

        * ``rmse`` (policy, quantity, time), in the unit of the quantity, with ``rmse_low`` and ``rmse_high``: root of
          the mean square error over episodes;
        * ``error_exceeded`` (policy, quantity, share), likewise: size of error that this share of measurements reaches
          or exceeds; none of bounds, nor where there are too few measurements for a share;
        * ``anees`` and ``anis`` (policy, time): mean NEES and NIS over their dimension, with the 95 % chi-square band
          of that mean, ``anees_low`` and so on, (time);
        * ``mode_probability`` (policy, mode, time) and ``true_class_probability`` (policy, time): means over episodes,
          with ``_low`` and ``_high``;
        * ``action`` (policy, action_name, time): mean over episodes of the actions applied, with their 10 and 90 %
          percentiles, ``_low`` and ``_high``, of policies whose action is a box; ``gain`` (policy, gain_name, time), of
          gains that a bank records, likewise;
        * ``mean_cost`` (policy): over episodes.

        Coordinates ``kind`` and ``control`` of every policy, ``unit`` of every quantity (the groups of components
        where there are any, else the first three components), ``elapsed`` (s) of every measurement, where they come
        regularly, and windows as the dataset has them. Attributes environment, scenario, split, seed, episodes,
        paper, reference, cost, truth and recorded.
    """
    bootstrap = bootstrap_of(dataset, resamples)
    units = reported_components(dataset)
    shown = list(groups_of(dataset)) or list(units)[:3]
    variables: dict[str, Series] = {}
    coords: dict[str, Any] = {
        name: dataset[name]
        for name in ("policy", "kind", "control", "time", "elapsed")
        if name in dataset.coords
    }
    if dataset.attrs["truth"]:
        variables |= _errors(dataset, shown, bootstrap)
        coords |= {"quantity": shown, "unit": ("quantity", [units[name] for name in shown])}
        if "error_exceeded" in variables:
            coords["share"] = SHARES
    variables |= _consistency(dataset)
    for name in ("mode_probability", "true_class_probability"):
        if name in dataset:
            variables |= _probabilities(dataset, name, bootstrap)
    if "mode_probability" in variables:
        coords["mode"] = dataset["mode"]
    if "action" in dataset:
        actions = dataset["action"].transpose("policy", "episode", "action_name", "time").values
        variables |= _spread("action", actions)
        coords["action_name"] = dataset["action_name"]
    gains = gains_of(dataset)
    if gains:
        variables |= _spread("gain", numpy.stack([dataset[name].values for name in gains], axis=2))
        coords["gain_name"] = gains
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
    curves = xarray.Dataset(variables, coords, {**attrs, "episodes": dataset.sizes["episode"]})
    return with_windows(curves, windows_of(dataset))


def gains_of(dataset: xarray.Dataset) -> list[str]:
    """Names of the gains that some bank records: a number for every measurement."""
    names = map(str, dataset.data_vars)
    return [
        name
        for name in names
        if dataset[name].dims == ("policy", "episode", "time")
        # A rate is the same gain over the sampling interval.
        and (name == "alpha" or (name.startswith("gain") and not name.startswith("gain_rate")))
    ]


def _errors(dataset: xarray.Dataset, shown: Sequence[str], bootstrap: Bootstrap) -> dict[str, Series]:
    groups, names = groups_of(dataset), dataset["policy"].values.tolist()
    shape = (len(names), len(shown))
    rmse = numpy.full((3, *shape, dataset.sizes["time"]), numpy.nan)
    exceeded = numpy.full((*shape, len(SHARES)), numpy.nan)
    costs = numpy.full(len(names), numpy.nan)
    for i, name in enumerate(names):
        run = dataset.sel(policy=name)
        bound = str(run["kind"].values) == "bound"
        for j, quantity in enumerate(shown):
            squares = squared_errors(run, quantity, groups)
            rmse[:, i, j] = _band(numpy.sqrt(bootstrap.means(squares)))
            if not bound:
                exceeded[i, j] = exceeded_errors(numpy.sqrt(squares))
        if not bound:
            costs[i] = mean_cost(dataset, name).mean()
    dims = ("policy", "quantity", "time")
    return {
        **_named("rmse", dims, rmse),
        **_present("error_exceeded", ("policy", "quantity", "share"), exceeded),
        **_present("mean_cost", ("policy",), costs),
    }


def exceeded_errors(errors: numpy.ndarray) -> numpy.ndarray:
    """Size that a share of errors reaches or exceeds, for each of :data:`SHARES`.

    Args:
        errors: of any shape, not below zero; NaN: none.

    Returns:
        ``(shares,)``; NaN where the share is less than one error.
    """
    descending = -numpy.sort(-errors, axis=None)  # what is missing comes last
    count = int(numpy.isfinite(descending).sum())
    which = numpy.rint(SHARES * count).astype(int)
    found = numpy.full(len(SHARES), numpy.nan)
    supported = SHARES * count >= 1.0 - 1e-9
    found[supported] = descending[which[supported] - 1]
    return found


def _consistency(dataset: xarray.Dataset) -> dict[str, Series]:
    """Mean NEES and NIS over their dimension, and where that mean lies with 95 % if the filter is consistent.

    A sum of independent chi-square numbers is one, of the sum of their degrees (Bar-Shalom, Li, Kirubarajan: Estimation
    with Applications to Tracking and Navigation, 2001, 5.4).
    """
    names, length = dataset["policy"].values.tolist(), dataset.sizes["time"]
    variables: dict[str, Series] = {}
    for metric in consistency_metrics(dataset):
        means = numpy.full((len(names), length), numpy.nan)
        dimensions = []
        for i, name in enumerate(names):
            run = dataset.sel(policy=name)
            values, degrees = run[metric].values, consistency_degrees(run, metric)
            present = ~numpy.isnan(values)
            if present.any():
                total = numpy.where(present, values, 0.0).sum(axis=0)
                dimension = (degrees * present).sum(axis=0)
                numpy.divide(total, dimension, out=means[i], where=dimension > 0.0)
                dimensions.append(dimension)
        # Where some measurements are missing the bands differ little; the widest is told.
        fewest = min(dimensions, key=lambda dimension: dimension.sum())
        there = fewest > 0.0
        ends = numpy.full((2, length), numpy.nan)
        ends[:, there] = numpy.array(chi_square_band(fewest[there])) / fewest[there]
        variables[f"a{metric}"] = (("policy", "time"), means)
        variables[f"a{metric}_low"], variables[f"a{metric}_high"] = ((("time",), end) for end in ends)
    return variables


def _probabilities(dataset: xarray.Dataset, name: str, bootstrap: Bootstrap) -> dict[str, Series]:
    values = dataset[name].transpose("policy", "episode", ..., "time").values
    bands = numpy.stack([_band(bootstrap.means(own)) for own in values], axis=1)
    dims = ("policy", *(["mode"] if values.ndim == 4 else []), "time")
    return _named(name, dims, bands)


def _spread(name: str, values: numpy.ndarray) -> dict[str, Series]:
    """Mean and percentiles over the episodes of ``(policy, episode, name, time)``."""
    flat = numpy.moveaxis(values, 1, 0).reshape(values.shape[1], -1)
    found = numpy.full((3, flat.shape[1]), numpy.nan)
    absent = numpy.isnan(flat)
    whole, some = ~absent.any(axis=0), absent.any(axis=0) & ~absent.all(axis=0)
    # NumPy's functions that leave NaN out are slow, and few columns have any.
    found[0, whole] = flat[:, whole].mean(axis=0)
    found[1:, whole] = numpy.percentile(flat[:, whole], PERCENTILES, axis=0)
    found[0, some] = numpy.nanmean(flat[:, some], axis=0)
    found[1:, some] = numpy.nanpercentile(flat[:, some], PERCENTILES, axis=0)
    shape = (3, values.shape[0], *values.shape[2:])
    return _named(name, ("policy", f"{name}_name", "time"), found.reshape(shape))


def _band(series: numpy.ndarray) -> numpy.ndarray:
    """Return the first of some series, and the 95 % interval of the others, its resamples: ``(3, ...)``."""
    return numpy.stack([series[0], *numpy.percentile(series[1:], [2.5, 97.5], axis=0)])


def _named(name: str, dims: tuple[str, ...], bands: numpy.ndarray) -> dict[str, Series]:
    """Variables of a line and both ends of its band, ``(3, ...)``; none where there is no number."""
    return dict(
        entry
        for ending, values in zip(("", "_low", "_high"), bands, strict=True)
        for entry in _present(name + ending, dims, values).items()
    )


def _present(name: str, dims: tuple[str, ...], values: numpy.ndarray) -> dict[str, Series]:
    return {} if numpy.isnan(values).all() else {name: (dims, values)}
