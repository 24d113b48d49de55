"""Figures of an evaluation from its curves (:mod:`.curves`), in the widths of a paper's columns.

At most six lines of a figure have a colour (:func:`.looks.choose_highlights`); the rest is grey. Policies and
estimators are solid, smoothers dash-dotted, references dashed, bounds dotted, in every figure.
"""

import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy
import xarray

from ..running.curves import stretches_of
from ..running.times import Point
from ..storage.dataset import windows_of, with_windows
from .front_figure import draw_front
from .looks import GREY, distinguish_lines, group_equal_lines, join_names, looks, styles
from .print_layout import (
    add_title,
    direct_labels,
    figure_with_axes,
    in_print,
    logarithmic,
    positive,
    room_for_labels,
    sensible_limits,
    wrap_label,
)


class CurvePanel(NamedTuple):
    """Lines over time for one pair of axes, with their bands."""

    label: str
    """Label of the ordinate."""
    values: xarray.DataArray
    """Values over (policy, time)."""
    low: xarray.DataArray | None = None
    """Lower end of the band about each line, over (policy, time)."""
    high: xarray.DataArray | None = None


def _abscissa(curves: xarray.Dataset) -> numpy.ndarray:
    """Return the values of the time axis: seconds for a constant sampling interval, else measurement numbers."""
    found: numpy.ndarray = curves["elapsed" if "elapsed" in curves.coords else "time"].values
    return found


def _bound_abscissa(axis: Any, x: numpy.ndarray) -> None:
    first, last = float(x[0]), float(x[-1])
    axis.set_xlim(*((first - 0.01 * (last - first), last) if last > first else (0.5 * first, 1.5 * first)))


def _name_abscissa(curves: xarray.Dataset, axes: Sequence[Any]) -> None:
    """Label the time axes: seconds below and measurement numbers above, where the interval is constant."""
    for axis in axes[:-1]:
        axis.tick_params(labelbottom=False)
    if "elapsed" not in curves.coords:
        axes[-1].set_xlabel("measurement")
        for axis in axes:
            axis.xaxis.get_major_locator().set_params(integer=True)
        return
    interval = float(curves["elapsed"].values[0] / curves["time"].values[0])
    above = axes[0].secondary_xaxis("top", functions=(lambda t: t / interval, lambda k: k * interval))
    above.set_xlabel("measurement")
    above.xaxis.get_major_locator().set_params(integer=True)
    axes[-1].set_xlabel("time, s")


def _shade_windows(axis: Any, curves: xarray.Dataset) -> None:
    """Shade the scenario's windows, except those that span the whole episode, and write their names."""
    length, x = curves.sizes["time"], _abscissa(curves)
    step = 0.5 * (x[1] - x[0]) if length > 1 else 0.5
    shown = {name: ends for name, ends in windows_of(curves).items() if ends[1] - ends[0] + 1 < 0.85 * length}
    # Names that are wider than their windows would touch: then every second one is a line lower.
    letters = 72.0 * 0.7 * axis.figure.get_figwidth() / 3.5
    narrow = any(len(name) / letters > (last - first + 1) / length for name, (first, last) in shown.items())
    for i, (name, (first, last)) in enumerate(shown.items()):
        left, right = x[first - 1] - step, x[last - 1] + step
        axis.axvspan(left, right, color="0.92" if i % 2 else "0.955", zorder=0, lw=0)
        axis.annotate(
            name,
            ((left + right) / 2, 1.0),
            (0.0, -8.0 if narrow and i % 2 else -1.5),
            xycoords=axis.get_xaxis_transform(),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=6,
            color="0.4",
            zorder=4.0,
        )


def _over_time(
    curves: xarray.Dataset,
    panels: Sequence[CurvePanel],
    look: Mapping[str, Mapping[str, Any]],
    title: str,
    columns: int,
    finish: Callable[[Any, CurvePanel], None],
) -> Any:
    """Return a figure of panels one above the other with lines over time; lines without a style are grey."""
    from matplotlib.lines import Line2D

    names = curves["policy"].values.tolist()
    there = [n for n in names if any(not numpy.isnan(panel.values.sel(policy=n)).all() for panel in panels)]
    values = {
        name: numpy.concatenate([panel.values.sel(policy=name).values for panel in panels]) for name in there
    }
    distinct, others = distinguish_lines(look, values)
    beside = room_for_labels(distinct.values(), columns)
    figure, axes = figure_with_axes(len(panels), columns)
    x = _abscissa(curves)
    wide = False
    if columns == 1:
        look = {name: {**style, "linewidth": 0.75 * style["linewidth"]} for name, style in look.items()}
    for axis, panel in zip(axes, panels, strict=True):
        _shade_windows(axis, curves)
        for name in others:
            axis.plot(x, panel.values.sel(policy=name), color=GREY, linewidth=0.6, zorder=1.5)
        ends = {}
        shown = {
            name: line
            for name in distinct
            if not numpy.isnan(line := panel.values.sel(policy=name).values).all()
        }
        here = group_equal_lines(shown, shown)  # lines may be equal in one quantity and differ in others
        for name, same in here.items():
            line = shown[name]
            label = distinct[name] if len(same) == 1 else join_names(same, most=1 if columns == 1 else 2)
            axis.plot(x, line, label=label, **look[name])
            last = int(numpy.flatnonzero(numpy.isfinite(line))[-1])
            ends[label] = (x[last], line[last], look[name]["color"])
        _bound_abscissa(axis, x)
        axis.set_ylabel(panel.label)
        axis.grid(alpha=0.25, which="both", lw=0.4)
        finish(axis, panel)
        wide |= _draw_bands(axis, x, panel, here, look)
        if beside:
            direct_labels(figure, axis, ends, len(panels))
    if wide:
        title += " (none where they fill the axis)"
    _name_abscissa(curves, axes)
    handles = [Line2D([], [], color=GREY, linewidth=0.6, label="others")] if others else []
    if not beside:
        handles = [Line2D([], [], label=label, **look[name]) for name, label in distinct.items()] + handles
    elif others:
        # A single name needs no legend.
        title += "; grey: others"
        handles = []
    return add_title(figure, title, handles)


def _draw_bands(
    axis: Any,
    x: numpy.ndarray,
    panel: CurvePanel,
    distinct: Iterable[str],
    look: Mapping[str, Mapping[str, Any]],
) -> bool:
    """Draw the bands of lines, except those over a third of the axis; return whether some were left out."""
    left_out = False
    if panel.low is None or panel.high is None:
        return left_out
    to_fraction = axis.transData + axis.transAxes.inverted()
    drawn: list[numpy.ndarray] = []
    for name in distinct:
        line = panel.values.sel(policy=name).values
        # Bands of nearly equal lines would add up to a dark one.
        if any(numpy.allclose(line, other, rtol=0.01, atol=0.0, equal_nan=True) for other in drawn):
            continue
        drawn.append(line)
        low, high = (ends.sel(policy=name).values for ends in (panel.low, panel.high))
        there = numpy.isfinite(low) & numpy.isfinite(high)
        if not there.any():
            continue
        # A logarithmic axis has no zero.
        bottom, top = axis.get_ylim()
        low, high = (numpy.clip(ends, bottom, top) for ends in (low, high))
        ends = [
            to_fraction.transform(numpy.stack([x[there], end[there]], axis=1))[:, 1] for end in (low, high)
        ]
        if (ends[1] - ends[0]).mean() > 1.0 / 3.0:
            left_out = True
            continue
        axis.fill_between(x, low, high, color=look[name]["color"], alpha=0.13, lw=0, zorder=1.0)
    return left_out


def _title(curves: xarray.Dataset) -> str:
    attrs = curves.attrs
    plural = "s" if attrs["episodes"] != 1 else ""
    return f"{attrs['environment']}, scenario {attrs['scenario']}: {attrs['episodes']} episode{plural}"


@in_print
def draw_error_over_time(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Return a figure of the RMSE over time of every quantity, with 95 % bands over episodes.

    Args:
        curves: curves of an evaluation with truth.
        look: style of the coloured lines, from :func:`looks`.
        columns: width of the figure in columns of a paper, 1 or 2.
    """
    look = looks(curves) if look is None else look
    panels = [
        CurvePanel(
            wrap_label(f"RMSE of {name.replace('_', ' ')}, {unit}", columns),
            *(curves[f"rmse{ending}"].sel(quantity=name) for ending in ("", "_low", "_high")),
        )
        for name, unit in zip(curves["quantity"].values.tolist(), curves["unit"].values.tolist(), strict=True)
    ]

    def finish(axis: Any, panel: CurvePanel) -> None:
        if not len(positive(panel.values.values)):
            return  # of a reference that knows the truth; a logarithmic axis has no zero
        axis.set_yscale("log")
        kinds = {name: str(curves["kind"].sel(policy=name).values) for name in look}
        bounds = [panel.values.sel(policy=name).values for name in look if kinds[name] == "bound"]
        lines = [panel.values.sel(policy=name).values for name in look if kinds[name] != "bound"]
        paper = [panel.values.sel(policy=n).values for n in [curves.attrs["paper"]] if n in look]
        axis.set_ylim(*sensible_limits(lines or bounds, paper, bounds))
        logarithmic(axis.yaxis)

    return _over_time(curves, panels, look, f"{_title(curves)}, 95 % bands", columns, finish)


@in_print
def draw_cost_difference(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Return a figure of mean costs minus those of the paper's algorithm and of the best; bands are paired.

    Arguments as of :func:`draw_error_over_time`.
    """
    look = looks(curves) if look is None else look
    length = stretches_of(curves.sizes["time"])[0].stop
    windows = {
        name: tuple(1 + (end - 1) // length for end in ends) for name, ends in windows_of(curves).items()
    }
    renamed = {"stretch": "time", "stretch_elapsed": "elapsed"}
    over = curves.drop_dims(["time", "window"])
    over = with_windows(over.rename({k: v for k, v in renamed.items() if k in over.coords}), windows)
    bases = {"paper": curves.attrs["paper"], "best": curves.attrs.get("best", "")}
    drawn: dict[str, CurvePanel] = {}
    for key, base in bases.items():
        name = f"cost_minus_{key}"
        if name in over:
            bands = (over[f"{name}{ending}"] for ending in ("", "_low", "_high"))
            drawn.setdefault(base, CurvePanel(wrap_label(f"cost less that of {base}", columns), *bands))

    def finish(axis: Any, panel: CurvePanel) -> None:
        axis.axhline(0.0, color="0.3", lw=0.6, zorder=1.2)
        shown = [panel.values.sel(policy=name).values for name in look]
        # One line, or a transient, must not compress all others.
        sizes = numpy.concatenate([numpy.abs(line[numpy.isfinite(line)]) for line in shown])
        reach = 1.5 * float(numpy.quantile(sizes, 0.99)) if len(sizes) else 1.0
        there = numpy.concatenate([line[numpy.isfinite(line)] for line in shown])
        lowest, highest = (float(there.min()), float(there.max())) if len(there) else (0.0, 0.0)
        margin = 0.05 * (highest - lowest) or 1.0
        axis.set_ylim(max(lowest - margin, -reach or -1.0), min(highest + margin, reach or 1.0))

    title = f"{_title(curves)}; below zero is better, 95 % bands, paired"
    return _over_time(over, list(drawn.values()), look, title, columns, finish)


@in_print
def draw_consistency(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Return a figure of ANEES and ANIS over time, with the 95 % chi-square band of a consistent filter.

    Arguments as of :func:`draw_error_over_time`.
    """
    look = looks(curves) if look is None else look
    panels = [
        CurvePanel(f"mean {metric.upper()}\nover its dimension", curves[f"a{metric}"])
        for metric in ("nees", "nis")
        if f"a{metric}" in curves
    ]

    def finish(axis: Any, panel: CurvePanel) -> None:
        low, high = (curves[f"{panel.values.name}_{end}"].values for end in ("low", "high"))
        axis.fill_between(_abscissa(curves), low, high, color="0.6", alpha=0.5, lw=0, zorder=0.5)
        axis.axhspan(0.5, 2.0, color="0.6", alpha=0.15, lw=0, zorder=0.3)
        axis.axhline(1.0, color="0.3", lw=0.6, zorder=1.2)
        axis.set_yscale("log")
        axis.set_ylim(*sensible_limits([panel.values.sel(policy=name).values for name in look], [low, high]))
        logarithmic(axis.yaxis)

    title = f"{_title(curves)}; consistent in the dark band (95 %, chi-square); light: a factor of two"
    return _over_time(curves, panels, look, title, columns, finish)


@in_print
def draw_error_distribution(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Return a figure of the share of measurements whose error exceeds each size, for every quantity.

    Arguments as of :func:`draw_error_over_time`.
    """
    from matplotlib.lines import Line2D

    look = looks(curves) if look is None else look
    exceeded, shares = curves["error_exceeded"], curves["share"].values
    there = [n for n in curves["policy"].values.tolist() if not numpy.isnan(exceeded.sel(policy=n)).all()]
    values = {name: exceeded.sel(policy=name).values for name in there}
    distinct, others = distinguish_lines(look, values)
    figure, axes = figure_with_axes(curves.sizes["quantity"], columns)
    units = dict(zip(curves["quantity"].values.tolist(), curves["unit"].values.tolist(), strict=True))
    supported = shares[~numpy.isnan(exceeded.values).all(axis=(0, 1))]
    for axis, (quantity, unit) in zip(axes, units.items(), strict=True):
        for name in [*distinct, *others]:
            style = look[name] if name in distinct else {"color": GREY, "linewidth": 0.6, "zorder": 1.5}
            axis.plot(exceeded.sel(policy=name, quantity=quantity), shares, **style)
        axis.set_yscale("log")
        axis.set_ylim(min(max(float(supported.min()), 1e-4), 0.5), 1.0)
        axis.set_xlabel(f"error of {quantity.replace('_', ' ')}, {unit}")
        axis.set_ylabel("share of\nmeasurements above")
        axis.grid(alpha=0.25, which="both", lw=0.4)
        distinct_values = exceeded.sel(policy=list(distinct or there), quantity=quantity).values
        if not len(positive(distinct_values)):
            continue
        axis.set_xscale("log")
        # From the size that nine of ten measurements exceed to the largest errors, without letting one line set the
        # limit.
        most = int(numpy.argmin(numpy.abs(shares - 0.9)))
        smallest = positive(distinct_values[:, most])
        largest = positive(numpy.nanmax(distinct_values, axis=1))
        if len(smallest) and len(largest):
            high = min(largest.max(), 10.0 * numpy.median(largest))
            low = numpy.median(smallest) / 2.0
            axis.set_xlim(low, max(high, 4.0 * low) * 1.05)
        logarithmic(axis.xaxis)
    handles = [Line2D([], [], label=label, **look[name]) for name, label in distinct.items()]
    if others:
        handles.append(Line2D([], [], color=GREY, linewidth=0.6, label="others"))
    return add_title(figure, f"{_title(curves)}, distribution of errors", handles)


def varying_modes(curves: xarray.Dataset, names: Iterable[str]) -> dict[str, list[str]]:
    """Return policies whose mode probabilities vary by over 0.02, grouped by equal probabilities."""
    probabilities = {name: curves["mode_probability"].sel(policy=name).values for name in names}
    found = {
        name: values
        for name, values in probabilities.items()
        if not numpy.isnan(values).all()
        and (numpy.nanmax(values, axis=-1) - numpy.nanmin(values, axis=-1)).max() > 0.02
    }
    return group_equal_lines(found, found)


@in_print
def draw_mode_probabilities(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Return a figure of the mode probabilities over time of the highlighted policies, with 95 % bands.

    Arguments as of :func:`draw_error_over_time`.
    """
    look = looks(curves) if look is None else look
    groups = varying_modes(curves, look)
    modes = curves["mode"].values.tolist()
    named = {mode: mode.replace("_", " ") for mode in modes}
    figure, axes = figure_with_axes(len(groups), columns, 1.5)
    x = _abscissa(curves)
    beside = room_for_labels(named.values(), columns)
    for axis, (name, same) in zip(axes, groups.items(), strict=True):
        _shade_windows(axis, curves)
        ends = {}
        for mode, style in styles(modes).items():
            own = curves.sel(policy=name, mode=mode)
            line = own["mode_probability"].values
            axis.plot(x, line, label=named[mode], **style | {"linewidth": 1.2})
            axis.fill_between(
                x,
                own["mode_probability_low"],
                own["mode_probability_high"],
                color=style["color"],
                alpha=0.18,
                lw=0,
            )
            present = numpy.flatnonzero(numpy.isfinite(line))
            if len(present):
                ends[named[mode]] = (x[present[-1]], line[present[-1]], style["color"])
        axis.set_ylim(-0.02, 1.02)
        _bound_abscissa(axis, x)
        axis.set_ylabel("\n".join(["probability", *textwrap.wrap(join_names(same), 24)]))
        axis.grid(alpha=0.25, lw=0.4)
        if beside:
            direct_labels(figure, axis, ends, len(groups))
    _name_abscissa(curves, axes)
    title = f"{_title(curves)}, mode probabilities, 95 % bands"
    return add_title(figure, title, [] if beside else None)


@in_print
def draw_true_class_probability(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Return a figure of the mean probability of the true class over time, with 95 % bands.

    Arguments as of :func:`draw_error_over_time`.
    """
    look = looks(curves) if look is None else look
    endings = ("", "_low", "_high")
    panel = CurvePanel("weight of the true class", *(curves[f"true_class_probability{e}"] for e in endings))

    def finish(axis: Any, panel: CurvePanel) -> None:
        axis.set_ylim(-0.02, 1.02)

    return _over_time(curves, [panel], look, f"{_title(curves)}, 95 % bands", columns, finish)


def evaluation_figures(
    curves: xarray.Dataset,
    columns: int = 2,
    highlight: Sequence[str] | None = None,
    learned: Sequence[str] = (),
    own: Sequence[str] = (),
    points: Sequence[Point] = (),
) -> Iterator[tuple[str, Any]]:
    """Yield the name and the figure of each plot of an evaluation for which there are data.

    Args:
        curves: curves of an evaluation, from :func:`.curves.curves_of`.
        columns: width of the figures in columns of a paper, 1 or 2.
        highlight: names of the coloured lines; default: :func:`choose_highlights`.
        learned: names of learned competitors.
        own: names of the user's competitors.
        points: points of cost and time, see :func:`.times.points_of_records`.

    Raises:
        ValueError: for another number of columns, unknown names, or too many.
    """
    look = looks(curves, highlight, learned, own)
    if "rmse" in curves:
        yield "rmse_over_time", draw_error_over_time(curves, look, columns=columns)
    if "error_exceeded" in curves:
        yield "error_distribution", draw_error_distribution(curves, look, columns=columns)
    if {"cost_minus_paper", "cost_minus_best"} & set(curves.data_vars):
        yield "cost_difference", draw_cost_difference(curves, look, columns=columns)
    if points:
        yield "cost_and_time", draw_front(curves, points, learned, own, columns=columns)
    if {"anees", "anis"} & set(curves.data_vars):
        yield "consistency", draw_consistency(curves, look, columns=columns)
    if "true_class_probability" in curves:
        # Where the true mode differs between episodes, a mean over episodes of each mode is meaningless.
        yield "true_class_probability", draw_true_class_probability(curves, look, columns=columns)
    elif "mode_probability" in curves and varying_modes(curves, look):
        yield "mode_probabilities", draw_mode_probabilities(curves, look, columns=columns)
