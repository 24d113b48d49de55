"""Pictures of an evaluation, all drawn from its curves (:mod:`.curves`), and of training; as wide as a paper's columns.

At most six lines of a picture are told apart by colour: the paper's algorithm, the reference, the bound, the best
learned and the best classical competitor, then the others by their cost; the rest stays grey. Policies and estimators
are solid, references dashed, bounds dotted, in every picture.
"""

import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple

import numpy
import xarray

from .competitors import RANKED
from .dataset import windows_of
from .files import whole_file

LINES = ("-", "--", "-.", ":")
# Okabe and Ito's palette: distinguishable for colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999933")
LINES_OF_KINDS = {"policy": "-", "estimator": "-", "reference": "--", "bound": ":"}
GREY = "0.72"
"""Of lines that are not told apart."""
MOST_HIGHLIGHTED = 6
"""Lines that a reader can tell apart."""
MOST_BESIDE = 8
"""Names that fit beside the lowest axes."""
WIDTHS = {1: 3.5, 2: 7.16}
"""Inches, of one and two columns of a paper."""
FONT_SIZES = {1: 7.0, 2: 8.0}
"""Points, which are printed as they are: the figure has the width of its place."""
FORMATS = ("png", "svg", "pdf")
DOTS_PER_INCH = 200


def styles(names: list[str]) -> dict[str, dict[str, Any]]:
    """Colour and line style of each policy; two policies never share both."""
    n = len(COLOURS)
    return {
        name: {"color": COLOURS[i % n], "linestyle": LINES[(i // n) % len(LINES)], "linewidth": 1.6}
        for i, name in enumerate(names)
    }


def check_columns(columns: int) -> int:
    """Return a number of columns, or raise ValueError if no figure is that wide."""
    if columns not in WIDTHS:
        raise ValueError(f"a figure is 1 or 2 columns wide, got {columns}")
    return columns


def check_formats(formats: Iterable[str]) -> list[str]:
    """Return formats, each once, or raise ValueError for one in which no figure is written."""
    for each in formats:
        if each not in FORMATS:
            raise ValueError(
                f"figures are written as {', '.join(FORMATS[:-1])} or {FORMATS[-1]}, got {each!r}"
            )
    return list(dict.fromkeys(formats))


def _in_print(draw: Callable[..., Any]) -> Callable[..., Any]:
    """Draw with the sizes of print, whatever matplotlib has been told elsewhere."""

    @wraps(draw)
    def drawn(*arguments: Any, columns: int = 2, **keywords: Any) -> Any:
        from matplotlib import rc_context

        size = FONT_SIZES[check_columns(columns)]
        settings: Any = {
            "font.family": "sans-serif",
            "font.size": size,
            "axes.labelsize": size,
            "axes.titlesize": size,
            "figure.titlesize": size,
            "legend.fontsize": size - 0.5,
            "xtick.labelsize": size - 0.5,
            "ytick.labelsize": size - 0.5,
            "axes.linewidth": 0.6,
            "xtick.major.width": 0.6,
            "ytick.major.width": 0.6,
        }
        with rc_context(settings):
            return draw(*arguments, columns=columns, **keywords)

    return drawn


def _axes(rows: int = 1, columns: int = 2, height: float | None = None) -> Any:
    """Return an empty figure and its axes, one above the other, each of a height in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if height is None:
        height = {1: 2.0, 2: 2.5}[columns] if rows < 4 else 1.7
    figure = Figure(figsize=(WIDTHS[columns], height * rows + 0.35), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, 1, squeeze=False)[:, 0]


def _titled(figure: Any, title: str, handles: Sequence[Any] | None = None) -> Any:
    """Return the figure with its title, and a legend, of the first axes or of handles: beside it where there is room,
    else below.
    """
    width = figure.get_figwidth()
    size = FONT_SIZES[1 if width < 5.0 else 2]
    # Letters are half as wide as they are high, and a little.
    letters = int(72.0 * width / (0.55 * size))
    wrapped = "\n".join(line for part in title.split("\n") for line in textwrap.wrap(part, letters))
    figure.suptitle(wrapped, x=0.01, ha="left")
    figure.set_figheight(figure.get_figheight() + 1.2 * size * wrapped.count("\n") / 72.0)
    if handles is None:
        handles = figure.axes[0].get_legend_handles_labels()[0]
    if handles:
        labels = [handle.get_label() for handle in handles]
        longest = max(map(len, labels))
        if width >= 5.0:
            figure.legend(handles, labels, loc="outside right upper", frameon=False)
        else:
            # A sample of the line, and half a letter's height for each letter.
            columns = max(1, min(len(labels), int(72.0 * width / (0.52 * size * longest + 32.0))))
            rows = -(-len(labels) // columns)
            figure.set_figheight(figure.get_figheight() + (1.45 * size * rows + 6.0) / 72.0)
            figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    return figure


def _logarithmic(axis: Any) -> None:
    """Label a logarithmic axis, whose limits are set, with plain numbers: decades; 2 and 5 too within three, 3 within
    one; round ones, a few, within less than half of one.
    """
    from matplotlib.ticker import MaxNLocator, NullLocator

    low, high = axis.get_view_interval()
    axis.set_major_formatter("{x:g}")
    if high <= 4.0 * low:
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axis.set_minor_locator(NullLocator())
        return
    digits = "235" if high <= 10.0 * low else "25" if high <= 1e3 * low else ""
    axis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:.0e}"[0] in digits else "")


# --- who is drawn how


def by_cost(curves: xarray.Dataset) -> list[str]:
    """Names of what is ranked, the lowest mean cost first; without costs by the mean RMSE of the first quantity, and
    without truth as they come.
    """
    names = curves["policy"].values[numpy.isin(curves["kind"].values.astype(str), RANKED)].tolist()
    if "mean_cost" in curves:
        worth = curves["mean_cost"]
    elif "rmse" in curves:
        worth = curves["rmse"].isel(quantity=0).mean("time")
    else:
        return [str(name) for name in names]
    each = {name: float(worth.sel(policy=name)) for name in names}
    return sorted(names, key=lambda name: (numpy.isnan(each[name]), each[name]))


def highlighted(
    curves: xarray.Dataset, highlight: Sequence[str] | None = None, learned: Sequence[str] = ()
) -> list[str]:
    """Names of the lines that are told apart, the most important first; of those that are the same, the first.

    Args:
        curves: of an evaluation.
        highlight: names, in place of those that are found: the paper's algorithm, the reference, the bound, the best
            learned and the best classical competitor, and then by cost.
        learned: names of what has been learned.

    Raises:
        ValueError: for unknown names, or too many.
    """
    present = curves["policy"].values.tolist()
    if highlight is not None:
        for name in highlight:
            if name not in present:
                raise ValueError(f"cannot highlight {name!r}: there are {', '.join(present)}")
        if len(set(highlight)) > MOST_HIGHLIGHTED:
            raise ValueError(f"at most {MOST_HIGHLIGHTED} lines can be told apart, got {len(set(highlight))}")
        return list(dict.fromkeys(highlight))
    ranked = by_cost(curves)
    kinds = dict(zip(present, curves["kind"].values.astype(str).tolist(), strict=True))
    classical = [name for name in ranked if name not in learned and name != curves.attrs["paper"]]
    wanted = [
        *(name for name in (curves.attrs["paper"], curves.attrs["reference"]) if name in present),
        *[name for name in present if kinds[name] == "bound"][:1],
        *[name for name in ranked if name in learned][:1],
        *classical[:1],
        *ranked,
        *present,
    ]
    chosen: list[str] = []
    for name in dict.fromkeys(wanted):
        same = "rmse" in curves and any(
            _same(curves["rmse"].sel(policy=name).values, curves["rmse"].sel(policy=other).values)
            for other in chosen
        )
        if not same:
            chosen.append(name)
    return chosen[:MOST_HIGHLIGHTED]


def _same(one: numpy.ndarray, other: numpy.ndarray) -> bool:
    """Whether two lines lie on each other; what is missing from both says nothing."""
    missing = numpy.isnan(one).all() and numpy.isnan(other).all()
    return not missing and bool(numpy.allclose(one, other, rtol=1e-6, atol=0.0, equal_nan=True))


def looks(
    curves: xarray.Dataset, highlight: Sequence[str] | None = None, learned: Sequence[str] = ()
) -> dict[str, dict[str, Any]]:
    """Colour, line style and width of the lines that are told apart, in the order of the legend.

    Args:
        curves: of an evaluation.
        highlight: as of :func:`highlighted`.
        learned: likewise; their lines are thicker.
    """
    chosen = highlighted(curves, highlight, learned)
    kinds = {name: str(curves["kind"].sel(policy=name).values) for name in chosen}
    colours = {name: COLOURS[6] for name in chosen if kinds[name] not in RANKED}
    if curves.attrs["paper"] in chosen:
        colours[curves.attrs["paper"]] = COLOURS[0]
    free = [colour for colour in COLOURS[1:6] if colour not in colours.values()]
    if curves.attrs["paper"] not in chosen:
        free.insert(0, COLOURS[0])
    rest = iter(free)
    for name in chosen:
        if name not in colours:
            colours[name] = next(rest)
    # A second reference, or bound, is told from the first by its grey.
    for kind in ("reference", "bound"):
        for name, shade in zip(
            [n for n in chosen if kinds[n] == kind], ("#000000", "0.4", "0.6") * 2, strict=False
        ):
            colours[name] = shade
    return {
        name: {
            "color": colours[name],
            "linestyle": LINES_OF_KINDS.get(kinds[name], "-"),
            "linewidth": 1.6 if name in learned else 1.1,
            "zorder": 3.0 - 0.01 * i,
        }
        for i, name in enumerate(chosen)
    }


def merged(names: Iterable[str], values: Mapping[str, numpy.ndarray]) -> dict[str, list[str]]:
    """Names whose lines lie on each other, by the first of them, in the order of ``names``."""
    found: dict[str, list[str]] = {}
    for name in names:
        twin = next((first for first in found if _same(values[first], values[name])), name)
        found.setdefault(twin, []).append(name)
    return found


def joined(names: Sequence[str], most: int = 2) -> str:
    """Name of a line that several share: ``imm = hard-imm``, or of more than ``most`` ``imm = hard-imm = 3 more``."""
    few = len(names) <= most
    return " = ".join(names if few else [*names[:most], f"{len(names) - most} more"])


# --- lines over time


class Panel(NamedTuple):
    """One pair of axes with lines over time."""

    label: str
    """Of the ordinate."""
    values: xarray.DataArray
    """(policy, time)."""
    low: xarray.DataArray | None = None
    """Of the band about each line, likewise."""
    high: xarray.DataArray | None = None


def _abscissa(curves: xarray.Dataset) -> numpy.ndarray:
    """Seconds where measurements come regularly, else their numbers."""
    found: numpy.ndarray = curves["elapsed" if "elapsed" in curves.coords else "time"].values
    return found


def _bound_abscissa(axis: Any, x: numpy.ndarray) -> None:
    """From just before the first measurement to the last; about the only one, if there is no other."""
    first, last = float(x[0]), float(x[-1])
    axis.set_xlim(*((first - 0.01 * (last - first), last) if last > first else (0.5 * first, 1.5 * first)))


def _name_abscissa(curves: xarray.Dataset, axes: Sequence[Any]) -> None:
    """Seconds below and measurements above, where they come regularly; else measurements below."""
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
    """Shade the scenario's windows, and name them at the top, except those that span everything."""
    length, x = curves.sizes["time"], _abscissa(curves)
    step = 0.5 * (x[1] - x[0]) if length > 1 else 0.5
    shown = {name: ends for name, ends in windows_of(curves).items() if ends[1] - ends[0] + 1 < 0.85 * length}
    # Names that are wider than their windows would touch: every second one a line lower then.
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


def sensible_limits(
    lines: Sequence[numpy.ndarray],
    always: Sequence[numpy.ndarray] = (),
    bounds: Sequence[numpy.ndarray] = (),
) -> tuple[float, float]:
    """Limits of a logarithmic axis on which one line, or a transient, cannot squash all others.

    A line takes the room from its 5th percentile, so that it need not begin at zero, to its largest value, but not more
    than a factor of six above what half of the lines take.

    Args:
        lines: positive; NaN where there is none.
        always: lines that are shown whatever they are.
        bounds: lines that may be far below what anybody reaches: they take a factor of six below the others at most.
    """
    ends = numpy.array([numpy.percentile(own, [5.0, 100.0]) for line in lines if len(own := _positive(line))])
    if not len(ends):
        return 0.1, 10.0
    low, high = ends[:, 0].min(), min(ends[:, 1].max(), numpy.median(ends[:, 1]) * 6.0)
    for line in always:
        if len(own := _positive(line)):
            low, high = min(low, numpy.percentile(own, 5.0)), max(high, own.max())
    for line in bounds:
        if len(own := _positive(line)):
            low, high = min(low, max(numpy.percentile(own, 5.0), low / 6.0)), max(high, own.min())
    margin = max((high / low) ** 0.06, 1.02)
    return float(low / margin), float(high * margin)


def _positive(values: numpy.ndarray) -> numpy.ndarray:
    found: numpy.ndarray = values[numpy.isfinite(values) & (values > 0.0)]
    return found


def _spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Places as near to the wanted ones as a gap between them allows, within 0 and 1."""
    order = numpy.argsort(wanted, kind="stable")
    places = numpy.clip(numpy.asarray(wanted, dtype=float)[order], 0.0, 1.0)
    for _ in range(200):
        close = numpy.diff(places) < gap - 1e-9
        if not close.any():
            break
        for i in numpy.flatnonzero(close):
            middle = 0.5 * (places[i] + places[i + 1])
            places[i], places[i + 1] = middle - 0.5 * gap, middle + 0.5 * gap
        places = numpy.clip(
            places, gap * numpy.arange(len(places)), 1.0 - gap * numpy.arange(len(places))[::-1]
        )
    found = numpy.empty(len(places))
    found[order] = places
    return found.tolist()


def _direct_labels(figure: Any, axis: Any, ends: Mapping[str, tuple[float, float, Any]], rows: int) -> None:
    """Name lines at their right end.

    Args:
        figure: that the axes are in.
        axis: whose limits and scales are set.
        ends: label -> where its line ends, and its colour.
        rows: axes above each other in the figure.
    """
    size = FONT_SIZES[1 if figure.get_figwidth() < 5.0 else 2] - 0.5
    height = 72.0 * (figure.get_figheight() - 0.7) / rows * 0.85  # of the axes, points; about
    to_fraction = axis.transData + axis.transAxes.inverted()
    wanted = [float(to_fraction.transform(end[:2])[1]) for end in ends.values()]
    for (label, (_, _, colour)), at, place in zip(
        ends.items(), wanted, _spread(wanted, 1.15 * size / height), strict=True
    ):
        start = min(max(at, 0.0), 1.0)
        axis.plot(
            [1.0, 1.012, 1.02],
            [start, place, place],
            transform=axis.transAxes,
            color=colour,
            lw=0.5,
            clip_on=False,
        )
        axis.text(1.026, place, label, transform=axis.transAxes, va="center", color=colour, fontsize=size)


def _room_for_labels(labels: Iterable[str], columns: int) -> bool:
    """Whether names beside the axes leave most of the width to them, and the lowest axes are high enough for them."""
    labels = list(labels)
    width = 0.5 * (FONT_SIZES[columns] - 0.5) * max(map(len, labels), default=0) / 72.0
    return width <= 0.3 * WIDTHS[columns] and len(labels) <= MOST_BESIDE


def _over_time(
    curves: xarray.Dataset,
    panels: Sequence[Panel],
    look: Mapping[str, Mapping[str, Any]],
    title: str,
    columns: int,
    finish: Callable[[Any, Panel], None],
) -> Any:
    """Draw lines over time, each panel below the other: those of a look in colour, the others grey."""
    from matplotlib.lines import Line2D

    names = curves["policy"].values.tolist()
    there = [n for n in names if any(not numpy.isnan(panel.values.sel(policy=n)).all() for panel in panels)]
    values = {
        name: numpy.concatenate([panel.values.sel(policy=name).values for panel in panels]) for name in there
    }
    # Whoever lies on a line that is told apart is named with it.
    groups = merged([*(n for n in look if n in there), *(n for n in there if n not in look)], values)
    told = {first: joined(same) for first, same in groups.items() if first in look}
    others = [first for first in groups if first not in look]
    beside = _room_for_labels(told.values(), columns)
    figure, axes = _axes(len(panels), columns)
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
            name: line for name in told if not numpy.isnan(line := panel.values.sel(policy=name).values).all()
        }
        here = merged(shown, shown)  # some quantity may be the same for those whose other ones differ
        for name, same in here.items():
            line = shown[name]
            label = told[name] if len(same) == 1 else joined(same, most=1 if columns == 1 else 2)
            axis.plot(x, line, label=label, **look[name])
            last = int(numpy.flatnonzero(numpy.isfinite(line))[-1])
            ends[label] = (x[last], line[last], look[name]["color"])
        _bound_abscissa(axis, x)
        axis.set_ylabel(panel.label)
        axis.grid(alpha=0.25, which="both", lw=0.4)
        finish(axis, panel)
        wide |= _draw_bands(axis, x, panel, here, look)
        if beside:
            _direct_labels(figure, axis, ends, len(panels))
    if wide:
        title += " (none where they fill the axis)"
    _name_abscissa(curves, axes)
    handles = [Line2D([], [], color=GREY, linewidth=0.6, label="others")] if others else []
    if not beside:
        handles = [Line2D([], [], label=label, **look[name]) for name, label in told.items()] + handles
    elif others:
        # One word needs no legend of its own.
        title += "; grey: others"
        handles = []
    return _titled(figure, title, handles)


def _draw_bands(
    axis: Any, x: numpy.ndarray, panel: Panel, told: Iterable[str], look: Mapping[str, Mapping[str, Any]]
) -> bool:
    """Draw the bands about lines, and return whether some were left out: those that on average fill a third of the
    axis, where they hide all lines and say only that there are too few episodes.
    """
    left_out = False
    if panel.low is None or panel.high is None:
        return left_out
    to_fraction = axis.transData + axis.transAxes.inverted()
    drawn: list[numpy.ndarray] = []
    for name in told:
        line = panel.values.sel(policy=name).values
        # Bands of lines that can hardly be told apart would add up to a dark one.
        if any(numpy.allclose(line, other, rtol=0.01, atol=0.0, equal_nan=True) for other in drawn):
            continue
        drawn.append(line)
        low, high = (ends.sel(policy=name).values for ends in (panel.low, panel.high))
        there = numpy.isfinite(low) & numpy.isfinite(high)
        if not there.any():
            continue
        # A logarithmic axis knows no zero.
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


@_in_print
def draw_error_over_time(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """RMSE over time of every quantity, with 95 % bands over episodes.

    Args:
        curves: of an evaluation with truth.
        look: of the lines that are told apart, from :func:`looks`.
        columns: of a paper, as wide as which it is.
    """
    look = looks(curves) if look is None else look
    panels = [
        Panel(
            _wrapped(f"RMSE of {name.replace('_', ' ')}, {unit}", columns),
            *(curves[f"rmse{ending}"].sel(quantity=name) for ending in ("", "_low", "_high")),
        )
        for name, unit in zip(curves["quantity"].values.tolist(), curves["unit"].values.tolist(), strict=True)
    ]

    def finish(axis: Any, panel: Panel) -> None:
        if not len(_positive(panel.values.values)):
            return  # of who is told the truth; a logarithmic axis has no zero
        axis.set_yscale("log")
        kinds = {name: str(curves["kind"].sel(policy=name).values) for name in look}
        bounds = [panel.values.sel(policy=name).values for name in look if kinds[name] == "bound"]
        lines = [panel.values.sel(policy=name).values for name in look if kinds[name] != "bound"]
        paper = [panel.values.sel(policy=n).values for n in [curves.attrs["paper"]] if n in look]
        axis.set_ylim(*sensible_limits(lines or bounds, paper, bounds))
        _logarithmic(axis.yaxis)

    return _over_time(curves, panels, look, f"{_title(curves)}, 95 % bands", columns, finish)


def _wrapped(label: str, columns: int) -> str:
    """Break the name of an ordinate that is longer than a low panel is high."""
    return "\n".join(textwrap.wrap(label, 26 if columns == 1 else 32))


@_in_print
def draw_consistency(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Mean NEES and NIS over their dimensions at every measurement, with the 95 % chi-square band of that mean.

    Arguments as of :func:`draw_error_over_time`.
    """
    look = looks(curves) if look is None else look
    panels = [
        Panel(f"mean {metric.upper()}\nover its dimension", curves[f"a{metric}"])
        for metric in ("nees", "nis")
        if f"a{metric}" in curves
    ]

    def finish(axis: Any, panel: Panel) -> None:
        low, high = (curves[f"{panel.values.name}_{end}"].values for end in ("low", "high"))
        axis.fill_between(_abscissa(curves), low, high, color="0.6", alpha=0.5, lw=0, zorder=0.5)
        axis.axhspan(0.5, 2.0, color="0.6", alpha=0.15, lw=0, zorder=0.3)
        axis.axhline(1.0, color="0.3", lw=0.6, zorder=1.2)
        axis.set_yscale("log")
        axis.set_ylim(*sensible_limits([panel.values.sel(policy=name).values for name in look], [low, high]))
        _logarithmic(axis.yaxis)

    title = f"{_title(curves)}; consistent in the dark band (95 %, chi-square); light: a factor of two"
    return _over_time(curves, panels, look, title, columns, finish)


@_in_print
def draw_error_distribution(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Share of measurements with an error above a given size, of every quantity.

    Arguments as of :func:`draw_error_over_time`.
    """
    from matplotlib.lines import Line2D

    look = looks(curves) if look is None else look
    exceeded, shares = curves["error_exceeded"], curves["share"].values
    there = [n for n in curves["policy"].values.tolist() if not numpy.isnan(exceeded.sel(policy=n)).all()]
    values = {name: exceeded.sel(policy=name).values for name in there}
    groups = merged([*(n for n in look if n in there), *(n for n in there if n not in look)], values)
    told = {first: joined(same) for first, same in groups.items() if first in look}
    figure, axes = _axes(curves.sizes["quantity"], columns)
    units = dict(zip(curves["quantity"].values.tolist(), curves["unit"].values.tolist(), strict=True))
    supported = shares[~numpy.isnan(exceeded.values).all(axis=(0, 1))]
    for axis, (quantity, unit) in zip(axes, units.items(), strict=True):
        for name in groups:
            style = look[name] if name in told else {"color": GREY, "linewidth": 0.6, "zorder": 1.5}
            axis.plot(exceeded.sel(policy=name, quantity=quantity), shares, **style)
        axis.set_yscale("log")
        axis.set_ylim(min(max(float(supported.min()), 1e-4), 0.5), 1.0)
        axis.set_xlabel(f"error of {quantity.replace('_', ' ')}, {unit}")
        axis.set_ylabel("share of\nmeasurements above")
        axis.grid(alpha=0.25, which="both", lw=0.4)
        told_values = exceeded.sel(policy=list(told or there), quantity=quantity).values
        if not len(_positive(told_values)):
            continue
        axis.set_xscale("log")
        # From what nine of ten measurements exceed to the largest errors, of which one line's are not all there is.
        most = int(numpy.argmin(numpy.abs(shares - 0.9)))
        smallest = _positive(told_values[:, most])
        largest = _positive(numpy.nanmax(told_values, axis=1))
        if len(smallest) and len(largest):
            high = min(largest.max(), 10.0 * numpy.median(largest))
            low = numpy.median(smallest) / 2.0
            axis.set_xlim(low, max(high, 4.0 * low) * 1.05)
        _logarithmic(axis.xaxis)
    handles = [Line2D([], [], label=label, **look[name]) for name, label in told.items()]
    if len(groups) > len(told):
        handles.append(Line2D([], [], color=GREY, linewidth=0.6, label="others"))
    return _titled(figure, f"{_title(curves)}, distribution of errors", handles)


def varying_modes(curves: xarray.Dataset, names: Iterable[str]) -> dict[str, list[str]]:
    """Policies whose mode probabilities move by more than 0.02 over time, with those that have the same."""
    probabilities = {name: curves["mode_probability"].sel(policy=name).values for name in names}
    found = {
        name: values
        for name, values in probabilities.items()
        if not numpy.isnan(values).all()
        and (numpy.nanmax(values, axis=-1) - numpy.nanmin(values, axis=-1)).max() > 0.02
    }
    return merged(found, found)


@_in_print
def draw_mode_probabilities(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Mean over episodes of the mode probabilities, with 95 % bands, of what is told apart and where they vary.

    Arguments as of :func:`draw_error_over_time`.
    """
    look = looks(curves) if look is None else look
    groups = varying_modes(curves, look)
    modes = curves["mode"].values.tolist()
    named = {mode: mode.replace("_", " ") for mode in modes}
    figure, axes = _axes(len(groups), columns, 1.5)
    x = _abscissa(curves)
    beside = _room_for_labels(named.values(), columns)
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
        axis.set_ylabel("\n".join(["probability", *textwrap.wrap(joined(same), 24)]))
        axis.grid(alpha=0.25, lw=0.4)
        if beside:
            _direct_labels(figure, axis, ends, len(groups))
    _name_abscissa(curves, axes)
    title = f"{_title(curves)}, mode probabilities, 95 % bands"
    return _titled(figure, title, [] if beside else None)


@_in_print
def draw_true_class_probability(
    curves: xarray.Dataset, look: Mapping[str, Mapping[str, Any]] | None = None, *, columns: int = 2
) -> Any:
    """Mean over episodes of the probability of the true class, with 95 % bands.

    Arguments as of :func:`draw_error_over_time`.
    """
    look = looks(curves) if look is None else look
    endings = ("", "_low", "_high")
    panel = Panel("weight of the true class", *(curves[f"true_class_probability{e}"] for e in endings))

    def finish(axis: Any, panel: Panel) -> None:
        axis.set_ylim(-0.02, 1.02)

    return _over_time(curves, [panel], look, f"{_title(curves)}, 95 % bands", columns, finish)


@_in_print
def draw_learning_curves(
    curves: Mapping[str, Sequence[tuple[Sequence[float], Sequence[float]]]],
    title: str,
    paper: str,
    *,
    columns: int = 2,
) -> Any:
    """Cost of validations against the paper's algorithm over training, one line for each run.

    Args:
        curves: algorithm -> for each of its runs the environment steps, and the relative cost differences there.
        title: of the figure.
        paper: name of the paper's algorithm, whose line is at zero.
        columns: of a paper, as wide as which it is.
    """
    figure, axes = _axes(columns=columns, height={1: 2.4, 2: 3.2}[columns])
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


@_in_print
def draw_differences(
    differences: Mapping[str, Mapping[str, Sequence[float]]],
    names: Sequence[str],
    learned: Sequence[str],
    unranked: Sequence[str],
    title: str,
    paper: str,
    *,
    columns: int = 2,
) -> Any:
    """Dots with intervals: cost of policies against the paper's algorithm, scenario by scenario.

    Args:
        differences: scenario -> policy -> difference in percent, lower and upper end of its interval.
        names: policies in the order of the legend.
        learned: those that are drawn as diamonds.
        unranked: references, which are drawn as grey squares.
        title: of the figure.
        paper: name of the paper's algorithm, whose line is at zero.
        columns: of a paper, as wide as which it is.
    """
    height = 0.8 + len(differences) * (0.25 + 0.07 * len(names))
    figure, axes = _axes(columns=columns, height=height)
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


def evaluation_figures(
    curves: xarray.Dataset,
    columns: int = 2,
    highlight: Sequence[str] | None = None,
    learned: Sequence[str] = (),
) -> Iterator[tuple[str, Any]]:
    """Every figure of an evaluation, with the name of its file; without those in which there is nothing to see.

    Args:
        curves: of an evaluation, from :func:`.curves.curves_of`.
        columns: of a paper, 1 or 2, as wide as which they are.
        highlight: names of the lines that are told apart, at most six; default: see :func:`highlighted`.
        learned: names of what has been learned.

    Raises:
        ValueError: for another number of columns, unknown names, or too many.
    """
    look = looks(curves, highlight, learned)
    if "rmse" in curves:
        yield "rmse_over_time", draw_error_over_time(curves, look, columns=columns)
    if "error_exceeded" in curves:
        yield "error_distribution", draw_error_distribution(curves, look, columns=columns)
    if {"anees", "anis"} & set(curves.data_vars):
        yield "consistency", draw_consistency(curves, look, columns=columns)
    if "true_class_probability" in curves:
        # Where the truth differs from episode to episode, a mean over episodes of each mode says nothing.
        yield "true_class_probability", draw_true_class_probability(curves, look, columns=columns)
    elif "mode_probability" in curves and varying_modes(curves, look):
        yield "mode_probabilities", draw_mode_probabilities(curves, look, columns=columns)


def save(figure: Any, path: Path) -> None:
    """Save a figure as its suffix says, whole or not at all: ``.png``; ``.svg``, whose text stays text; ``.pdf``, which
    holds the fonts it takes. The same figure gives the same file.

    Raises:
        ValueError: for another suffix, or if it cannot be written.
    """
    from matplotlib import rc_context

    written = path.suffix.removeprefix(".").lower()
    check_formats([written])
    # Without the time of writing.
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(written)
    # Type 42: TrueType as it is, which journals take; Type 3, the default, many refuse.
    settings: Any = {"svg.fonttype": "none", "svg.hashsalt": "filtergym", "pdf.fonttype": 42}
    with whole_file(path) as partial, rc_context(settings):
        figure.savefig(partial, format=written, dpi=DOTS_PER_INCH, metadata=metadata)
