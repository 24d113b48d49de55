"""Pictures of an evaluation (error over time, distribution, mode probabilities), and of training."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy
import xarray

from .dataset import groups_of, windows_of
from .files import whole_file
from .metrics import (
    bootstrap_of,
    chi_square_band,
    consistency_degrees,
    consistency_metrics,
    reported_components,
    squared_errors,
)

LINES = ("-", "--", "-.", ":")
# Okabe and Ito's palette: distinguishable for colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999933")


def styles(names: list[str]) -> dict[str, dict[str, Any]]:
    """Colour and line style of each policy; two policies never share both."""
    n = len(COLOURS)
    return {
        name: {"color": COLOURS[i % n], "linestyle": LINES[(i // n) % len(LINES)], "linewidth": 1.6}
        for i, name in enumerate(names)
    }


def _axes(rows: int = 1, width: float = 8.0, height: float = 3.6) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, 1, squeeze=False)[:, 0]


def _draw_with_band(
    axis: Any, dataset: xarray.Dataset, series: numpy.ndarray, label: str, style: Any
) -> None:
    """Line of the first of some series over time, and the 95 % band of the others, its resamples."""
    low, high = numpy.percentile(series[1:], [2.5, 97.5], axis=0)
    axis.plot(dataset["time"], series[0], label=label, **style)
    axis.fill_between(dataset["time"], low, high, color=style["color"], alpha=0.18, lw=0)


def _titled(figure: Any, title: str) -> Any:
    """Return the figure with its title, and beside it the legend of its first axes."""
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8, frameon=False)
    return figure


def _logarithmic(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers: decades; 2 and 5 within four; all digits within one."""

    def label(x: float, _: int) -> str:
        low, high = axis.get_view_interval()
        digits = "2345678" if high <= 10.0 * low else "25" if high <= 1e4 * low else ""
        return f"{x:g}" if f"{x:.0e}"[0] in digits else ""

    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(label)


def _shade_windows(axis: Any, dataset: xarray.Dataset) -> None:
    """Name the scenario's windows along the top, except those that span everything."""
    length = dataset.sizes["time"]
    for i, (name, (first, last)) in enumerate(windows_of(dataset).items()):
        if last - first + 1 < 0.85 * length:
            axis.axvspan(first - 0.5, last + 0.5, color="0.93" if i % 2 else "0.96", zorder=0, lw=0)
            axis.text(
                (first + last) / 2,
                1.01,
                name,
                transform=axis.get_xaxis_transform(),
                ha="center",
                va="bottom",
                fontsize=7,
                color="0.35",
            )


def draw_error_over_time(dataset: xarray.Dataset) -> Any:
    """RMSE over time of every group of components (or component), with 95 % bands over episodes."""
    bootstrap = bootstrap_of(dataset, resamples=200)
    units = reported_components(dataset)
    shown = list(groups_of(dataset)) or list(units)[:3]
    figure, axes = _axes(len(shown))
    names = dataset["policy"].values.tolist()
    for axis, component in zip(axes, shown, strict=True):
        _shade_windows(axis, dataset)
        for name, style in styles(names).items():
            run = dataset.sel(policy=name)
            rmse = numpy.sqrt(bootstrap.means(squared_errors(run, component, groups_of(dataset))))
            _draw_with_band(axis, dataset, rmse, name, style)
        axis.set_yscale("log")
        _logarithmic(axis.yaxis)
        axis.set_ylabel(f"RMSE of {component.replace('_', ' ')}, {units[component]}")
        axis.grid(alpha=0.25, which="both", lw=0.4)
        axis.margins(x=0.01)
    axes[-1].set_xlabel("measurement")
    title = f"{dataset.attrs['environment']}, scenario {dataset.attrs['scenario']}"
    return _titled(figure, f"{title}: {dataset.sizes['episode']} episodes, 95 % bands")


def draw_consistency(dataset: xarray.Dataset) -> Any:
    """Mean NEES and NIS over their dimensions at every measurement, with the 95 % chi-square band of that mean."""
    shown = consistency_metrics(dataset)
    figure, axes = _axes(len(shown))
    names = dataset["policy"].values.tolist()
    for axis, metric in zip(axes, shown, strict=True):
        _shade_windows(axis, dataset)
        bands = []
        for name, style in styles(names).items():
            run = dataset.sel(policy=name)
            values, degrees = run[metric].values, consistency_degrees(run, metric)
            present = ~numpy.isnan(values)
            if not present.any():
                continue
            total, dimension = numpy.where(present, values, 0.0).sum(axis=0), (degrees * present).sum(axis=0)
            there = dimension > 0.0
            mean = numpy.where(there, total / numpy.where(there, dimension, 1.0), numpy.nan)
            axis.plot(dataset["time"], mean, label=name, **style)
            low, high = chi_square_band(dimension)
            bands.append((numpy.where(there, low, numpy.nan), numpy.where(there, high, numpy.nan), dimension))
        if bands:
            # Where some measurements are missing the bands differ little; the widest is drawn.
            low, high, dimension = min(bands, key=lambda band: band[2].sum())
            wide = numpy.where(dimension > 0.0, dimension, 1.0)
            axis.fill_between(
                dataset["time"], low / wide, high / wide, color="0.6", alpha=0.5, lw=0, zorder=0
            )
        axis.axhspan(0.5, 2.0, color="0.92", lw=0, zorder=-1)
        axis.axhline(1.0, color="0.3", lw=0.8)
        axis.set_yscale("log")
        _logarithmic(axis.yaxis)
        axis.set_ylabel(f"mean {metric.upper()} over its dimension")
        axis.grid(alpha=0.25, which="both", lw=0.4)
        axis.margins(x=0.01)
    axes[-1].set_xlabel("measurement")
    title = f"{dataset.attrs['environment']}, scenario {dataset.attrs['scenario']}"
    return _titled(
        figure,
        f"{title}: {dataset.sizes['episode']} episodes\n"
        "consistent in the dark band (95 %, chi-square); light: a factor of two",
    )


def draw_error_distribution(dataset: xarray.Dataset) -> Any:
    """Share of measurements with an error above a given size, every group (or component)."""
    units = reported_components(dataset)
    shown = list(groups_of(dataset)) or list(units)[:3]
    figure, axes = _axes(len(shown))
    names = [
        n for n in dataset["policy"].values.tolist() if str(dataset["kind"].sel(policy=n).values) != "bound"
    ]
    for axis, component in zip(axes, shown, strict=True):
        for name, style in styles(names).items():
            error = numpy.sort(
                numpy.sqrt(squared_errors(dataset.sel(policy=name), component, groups_of(dataset))),
                axis=None,
            )
            error = error[
                : numpy.isfinite(error).sum()
            ]  # what is missing, beyond the end of a flight, is sorted last
            # A few hundred quantiles draw the same curve as a million points.
            index = numpy.unique(numpy.geomspace(1, len(error), 400).astype(int))
            axis.plot(error[len(error) - index], index / len(error), label=name, **style)
        axis.set_xscale("log")
        _logarithmic(axis.xaxis)
        axis.set_yscale("log")
        axis.set_xlim(left=float(10 ** numpy.floor(numpy.log10(max(numpy.median(error), 1e-9)) - 1)))
        axis.set_ylim(1e-4, 1.0)
        axis.set_xlabel(f"error of {component.replace('_', ' ')}, {units[component]}")
        axis.set_ylabel("share of measurements above")
        axis.grid(alpha=0.25, which="both", lw=0.4)
    title = f"{dataset.attrs['environment']}, scenario {dataset.attrs['scenario']}"
    return _titled(figure, f"{title}: distribution of errors")


def draw_mode_probabilities(dataset: xarray.Dataset) -> Any:
    """Mean over episodes of the mode probabilities of every policy that has them, with 95 % bands."""
    bootstrap = bootstrap_of(dataset, resamples=200)
    present = [
        name
        for name in dataset["policy"].values.tolist()
        if not numpy.isnan(dataset["mode_probability"].sel(policy=name).values).all()
    ]
    figure, axes = _axes(len(present), height=2.4)
    modes = dataset["mode"].values.tolist()
    for axis, name in zip(axes, present, strict=True):
        _shade_windows(axis, dataset)
        for mode, style in styles(modes).items():
            values = dataset["mode_probability"].sel(policy=name, mode=mode).values
            _draw_with_band(axis, dataset, bootstrap.means(values), mode.replace("_", " "), style)
        axis.set_ylim(-0.02, 1.02)
        axis.set_ylabel(f"probability\n({name})")
        axis.grid(alpha=0.25, lw=0.4)
        axis.margins(x=0.01)
    axes[-1].set_xlabel("measurement")
    return _titled(figure, "Mode probabilities: mean over episodes, 95 % bands")


def draw_true_class_probability(dataset: xarray.Dataset) -> Any:
    """Mean over episodes of the probability of the true class, with 95 % bands."""
    bootstrap = bootstrap_of(dataset, resamples=200)
    figure, axes = _axes()
    _shade_windows(axes[0], dataset)
    for name, style in styles(dataset["policy"].values.tolist()).items():
        values = dataset["true_class_probability"].sel(policy=name).values
        if numpy.isnan(values).all():
            continue
        _draw_with_band(axes[0], dataset, bootstrap.means(values), name, style)
    axes[0].set_ylim(-0.02, 1.02)
    axes[0].set_ylabel("weight of the true class")
    axes[0].set_xlabel("measurement")
    axes[0].grid(alpha=0.25, lw=0.4)
    axes[0].margins(x=0.01)
    title = f"{dataset.attrs['environment']}, scenario {dataset.attrs['scenario']}"
    return _titled(figure, f"{title}: {dataset.sizes['episode']} episodes, 95 % bands")


def draw_learning_curves(
    curves: Mapping[str, Sequence[tuple[Sequence[float], Sequence[float]]]], title: str, paper: str
) -> Any:
    """Cost of validations against the paper's algorithm over training, one line for each run.

    Args:
        curves: algorithm -> for each of its runs the environment steps, and the relative cost differences there.
        title: of the figure.
        paper: name of the paper's algorithm, whose line is at zero.
    """
    figure, axes = _axes()
    axis = axes[0]
    for (name, runs), style in zip(curves.items(), styles(list(curves)).values(), strict=True):
        for i, (steps, differences) in enumerate(runs):
            plural = "s" if len(runs) > 1 else ""
            label = f"{name}, {len(runs)} run{plural}" if i == 0 else None
            millions, percent = numpy.array(steps) / 1e6, 100.0 * numpy.array(differences)
            axis.plot(millions, percent, label=label, **style | {"linewidth": 1.1})
            best = percent.argmin()
            axis.plot(millions[best], percent[best], "o", ms=4, color=style["color"])
    axis.axhline(0.0, color="0.3", lw=1.0)
    everything = numpy.concatenate([values for runs in curves.values() for _, values in runs])
    if everything.max() > 1.0:
        # An untrained agent can cost a hundred times as much; what is learned is told apart near zero.
        axis.set_yscale("symlog", linthresh=10.0, linscale=1.5)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_ylim(bottom=min(1.2 * 100.0 * everything.min(), -2.0))
    axis.set_xlim(left=0.0)
    axis.set_xlabel("environment steps, millions")
    axis.set_ylabel(f"validation cost against {paper}, %")
    axis.grid(alpha=0.25, lw=0.4)
    return _titled(figure, title)


def draw_differences(
    differences: Mapping[str, Mapping[str, Sequence[float]]],
    names: Sequence[str],
    learned: Sequence[str],
    unranked: Sequence[str],
    title: str,
    paper: str,
) -> Any:
    """Dots with intervals: cost of policies against the paper's algorithm, scenario by scenario.

    Args:
        differences: scenario -> policy -> difference in percent, lower and upper end of its interval.
        names: policies in the order of the legend.
        learned: those that are drawn as diamonds.
        unranked: references, which are drawn as grey squares.
        title: of the figure.
        paper: name of the paper's algorithm, whose line is at zero.
    """
    height = 0.8 + len(differences) * (0.25 + 0.07 * len(names))
    figure, axes = _axes(height=height)
    axis = axes[0]
    gap = 0.8 / len(names)
    ranked = styles([name for name in names if name not in unranked])
    for i, name in enumerate(names):
        colour = ranked[name]["color"] if name in ranked else "0.45"
        marker = "s" if name not in ranked else "D" if name in learned else "o"
        for row, found in enumerate(differences.values()):
            if name not in found:
                continue
            value, low, high = found[name]
            axis.errorbar(
                value,
                row + gap * (i - 0.5 * (len(names) - 1)),
                xerr=[[max(value - low, 0.0)], [max(high - value, 0.0)]],
                fmt=marker,
                ms=4.5 if name in learned else 3.5,
                color=colour,
                markerfacecolor="white" if marker == "o" else colour,
                elinewidth=1.2,
                label=name if row == 0 else None,
            )
    for row in range(0, len(differences), 2):
        axis.axhspan(row - 0.5, row + 0.5, color="0.95", zorder=0, lw=0)
    axis.axvline(0.0, color="0.3", lw=1.0)
    ends = [x for found in differences.values() for interval in found.values() for x in interval]
    if ends and (max(ends) > 100.0 or min(ends) < -80.0):
        # Logarithmic in the ratio of the costs: half and twice the paper's are as far from it.
        ratio = (lambda x: numpy.log(numpy.maximum(1.0 + x / 100.0, 1e-9)), lambda y: 100.0 * numpy.expm1(y))
        axis.set_xscale("function", functions=ratio)
        low, high = max(1.0 + min(*ends, 0.0) / 100.0, 1e-6), 1.0 + max(*ends, 0.0) / 100.0
        margin = (high / low) ** 0.04
        axis.set_xlim(100.0 * (low / margin - 1.0), 100.0 * (high * margin - 1.0))
        span = high / low
        digits = (1, 1.5, 2, 3, 5, 7) if span < 10.0 else (1, 2, 5) if span < 200.0 else (1,)
        ticks = [digit * 10.0**power for power in range(-6, 7) for digit in digits]
        axis.set_xticks([100.0 * (x - 1.0) for x in ticks if low / margin <= x <= high * margin])
        axis.xaxis.set_major_formatter("{x:.6g}")
    axis.set_yticks(range(len(differences)), list(differences))
    axis.set_ylim(len(differences) - 0.5, -0.5)
    axis.set_xlabel(f"cost against {paper}, %")
    axis.grid(alpha=0.25, lw=0.4, axis="x")
    return _titled(figure, title)


def evaluation_figures(dataset: xarray.Dataset) -> Iterator[tuple[str, Any]]:
    """Every figure of an evaluation with the name of its file."""
    yield "rmse_over_time", draw_error_over_time(dataset)
    yield "error_distribution", draw_error_distribution(dataset)
    if consistency_metrics(dataset):
        yield "consistency", draw_consistency(dataset)
    if "true_class_probability" in dataset:
        # Where the truth differs from episode to episode, a mean over episodes of each mode says nothing.
        yield "true_class_probability", draw_true_class_probability(dataset)
    elif "mode_probability" in dataset:
        yield "mode_probabilities", draw_mode_probabilities(dataset)


def save(figure: Any, path: Path) -> None:
    """Save a figure as PNG, whole or not at all."""
    with whole_file(path) as partial:
        figure.savefig(partial, format="png", dpi=130)
