"""Pictures of an evaluation: error over time, distribution of errors, mode probabilities."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy
import xarray

from .bootstrap import Bootstrap
from .metrics import reported_components, squared_errors

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


def _logarithmic(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers, every digit where it spans less than a decade."""

    def label(x: float, _: int) -> str:
        low, high = axis.get_view_interval()
        return f"{x:g}" if f"{x:.0e}"[0] in ("25" if high > 10.0 * low else "2345678") else ""

    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(label)


def _shade_windows(axis: Any, dataset: xarray.Dataset) -> None:
    """Name the scenario's windows along the top, except those that span everything."""
    length = dataset.sizes["time"]
    for i, (name, (first, last)) in enumerate(dataset.attrs["windows"].items()):
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
    bootstrap = Bootstrap(dataset.sizes["episode"], resamples=200)
    units = reported_components(dataset)
    shown = list(dataset.attrs["groups"]) or list(units)[:3]
    figure, axes = _axes(len(shown))
    names = dataset["policy"].values.tolist()
    for axis, component in zip(axes, shown, strict=True):
        _shade_windows(axis, dataset)
        for name, style in styles(names).items():
            run = dataset.sel(policy=name)
            rmse = numpy.sqrt(bootstrap.means(squared_errors(run, component, dataset.attrs["groups"])))
            low, high = numpy.percentile(rmse[1:], [2.5, 97.5], axis=0)
            axis.plot(dataset["time"], rmse[0], label=name, **style)
            axis.fill_between(dataset["time"], low, high, color=style["color"], alpha=0.18, lw=0)
        axis.set_yscale("log")
        _logarithmic(axis.yaxis)
        axis.set_ylabel(f"RMSE of {component.replace('_', ' ')}, {units[component]}")
        axis.grid(alpha=0.25, which="both", lw=0.4)
        axis.margins(x=0.01)
    axes[-1].set_xlabel("measurement")
    title = f"{dataset.attrs['environment']}, scenario {dataset.attrs['scenario']}"
    figure.suptitle(
        f"{title}: {dataset.sizes['episode']} episodes, 95 % bands", fontsize=10, x=0.01, ha="left"
    )
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8, frameon=False)
    return figure


def draw_error_distribution(dataset: xarray.Dataset) -> Any:
    """Share of measurements with an error above a given size, every group (or component)."""
    units = reported_components(dataset)
    shown = list(dataset.attrs["groups"]) or list(units)[:3]
    figure, axes = _axes(len(shown))
    names = [
        n for n in dataset["policy"].values.tolist() if str(dataset["kind"].sel(policy=n).values) != "bound"
    ]
    for axis, component in zip(axes, shown, strict=True):
        for name, style in styles(names).items():
            error = numpy.sort(
                numpy.sqrt(squared_errors(dataset.sel(policy=name), component, dataset.attrs["groups"])),
                axis=None,
            )
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
    figure.suptitle(f"{title}: distribution of errors", fontsize=10, x=0.01, ha="left")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8, frameon=False)
    return figure


def draw_mode_probabilities(dataset: xarray.Dataset) -> Any:
    """Mean and 10-90 % range over episodes of the mode probabilities of every policy that has them."""
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
            low, high = numpy.percentile(values, [10, 90], axis=0)
            axis.plot(dataset["time"], values.mean(axis=0), label=mode.replace("_", " "), **style)
            axis.fill_between(dataset["time"], low, high, color=style["color"], alpha=0.15, lw=0)
        axis.set_ylim(-0.02, 1.02)
        axis.set_ylabel(f"probability\n({name})")
        axis.grid(alpha=0.25, lw=0.4)
        axis.margins(x=0.01)
    axes[-1].set_xlabel("measurement")
    figure.suptitle(
        "Mode probabilities: mean and 10-90 % range over episodes", fontsize=10, x=0.01, ha="left"
    )
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8, frameon=False)
    return figure


def draw_true_class_probability(dataset: xarray.Dataset) -> Any:
    """Mean over episodes of the probability of the true class, with 95 % bands."""
    bootstrap = Bootstrap(dataset.sizes["episode"], resamples=200)
    figure, axes = _axes()
    _shade_windows(axes[0], dataset)
    for name, style in styles(dataset["policy"].values.tolist()).items():
        values = dataset["true_class_probability"].sel(policy=name).values
        if numpy.isnan(values).all():
            continue
        means = bootstrap.means(values)
        low, high = numpy.percentile(means[1:], [2.5, 97.5], axis=0)
        axes[0].plot(dataset["time"], means[0], label=name, **style)
        axes[0].fill_between(dataset["time"], low, high, color=style["color"], alpha=0.18, lw=0)
    axes[0].set_ylim(-0.02, 1.02)
    axes[0].set_ylabel("weight of the true class")
    axes[0].set_xlabel("measurement")
    axes[0].grid(alpha=0.25, lw=0.4)
    axes[0].margins(x=0.01)
    title = f"{dataset.attrs['environment']}, scenario {dataset.attrs['scenario']}"
    figure.suptitle(
        f"{title}: {dataset.sizes['episode']} episodes, 95 % bands", fontsize=10, x=0.01, ha="left"
    )
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8, frameon=False)
    return figure


def evaluation_figures(dataset: xarray.Dataset) -> Iterator[tuple[str, Any]]:
    """Every figure of an evaluation with the name of its file."""
    yield "rmse_over_time", draw_error_over_time(dataset)
    yield "error_distribution", draw_error_distribution(dataset)
    if "true_class_probability" in dataset:
        # Where the truth differs from episode to episode, a mean over episodes of each mode says nothing.
        yield "true_class_probability", draw_true_class_probability(dataset)
    elif "mode_probability" in dataset:
        yield "mode_probabilities", draw_mode_probabilities(dataset)


def save(figure: Any, path: Path) -> None:
    """Save a figure as PNG, whole or not at all."""
    partial = path.with_suffix(".partial")
    try:
        figure.savefig(partial, format="png", dpi=130)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
