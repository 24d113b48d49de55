"""Layout of figures for print: widths, fonts, limits of axes, labels of lines, and files."""

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import numpy

from ..storage.files import whole_file

MOST_BESIDE = 8
"""Maximal number of labels that fit beside the lowest axes."""
WIDTHS = {1: 3.5, 2: 7.16}
"""Widths of one and two columns of a paper, inches."""
FONT_SIZES = {1: 7.0, 2: 8.0}
"""Font sizes in print, points, for figures of one and two columns."""
FORMATS = ("png", "svg", "pdf")
DOTS_PER_INCH = 200


def check_columns(columns: int) -> int:
    """Return the width of a figure in columns unchanged; raise ValueError if it is not 1 or 2."""
    if columns not in WIDTHS:
        raise ValueError(f"a figure is 1 or 2 columns wide, got {columns}")
    return columns


def check_formats(formats: Iterable[str]) -> list[str]:
    """Return the file formats without repetitions; raise ValueError for an unsupported one."""
    for each in formats:
        if each not in FORMATS:
            raise ValueError(
                f"figures are written as {', '.join(FORMATS[:-1])} or {FORMATS[-1]}, got {each!r}"
            )
    return list(dict.fromkeys(formats))


def in_print(draw: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function that draws a figure, so that it uses the fonts and line widths of print."""

    @wraps(draw)
    def draw_in_print(*arguments: Any, columns: int = 2, **keywords: Any) -> Any:
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

    return draw_in_print


def figure_with_axes(rows: int = 1, columns: int = 2, height: float | None = None) -> Any:
    """Return an empty figure and its axes, one above the other; ``height`` is that of each in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if height is None:
        height = {1: 2.0, 2: 2.5}[columns] if rows < 4 else 1.7
    figure = Figure(figsize=(WIDTHS[columns], height * rows + 0.35), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, 1, squeeze=False)[:, 0]


def figure_with_pairs(rows: int, columns: int = 2) -> Any:
    """Return an empty figure and its axes, two in each of some rows, ``(rows, 2)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTHS[columns], {1: 1.6, 2: 2.3}[columns] * rows + 0.35), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, 2, squeeze=False)


def add_title(figure: Any, title: str, handles: Sequence[Any] | None = None) -> Any:
    """Add a title and a legend, beside the title where it fits, else below; return the figure."""
    width = figure.get_figwidth()
    size = FONT_SIZES[1 if width < 5.0 else 2]
    # Letters are a little wider than half their height.
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


def logarithmic(axis: Any) -> None:
    """Set plain numbers as tick labels of a logarithmic axis, whose limits are set."""
    from matplotlib.ticker import MaxNLocator, NullLocator

    low, high = axis.get_view_interval()
    axis.set_major_formatter("{x:g}")
    if high <= 4.0 * low:
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axis.set_minor_locator(NullLocator())
        return
    digits = "235" if high <= 10.0 * low else "25" if high <= 1e3 * low else ""
    axis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:.0e}"[0] in digits else "")


def sensible_limits(
    lines: Sequence[numpy.ndarray],
    always: Sequence[numpy.ndarray] = (),
    bounds: Sequence[numpy.ndarray] = (),
) -> tuple[float, float]:
    """Return the limits of a logarithmic axis that neither one line nor a transient determines.

    A line extends them from its 5th percentile to its largest value, at most six times the median of the
    largest values.

    Args:
        lines: positive values; NaN where there is none.
        always: lines that are completely inside the limits.
        bounds: lines that may be far below all others: they extend the limits by a factor of six at most.
    """
    ends = numpy.array([numpy.percentile(own, [5.0, 100.0]) for line in lines if len(own := positive(line))])
    if not len(ends):
        return 0.1, 10.0
    low, high = ends[:, 0].min(), min(ends[:, 1].max(), numpy.median(ends[:, 1]) * 6.0)
    for line in always:
        if len(own := positive(line)):
            low, high = min(low, numpy.percentile(own, 5.0)), max(high, own.max())
    for line in bounds:
        if len(own := positive(line)):
            low, high = min(low, max(numpy.percentile(own, 5.0), low / 6.0)), max(high, own.min())
    margin = max((high / low) ** 0.06, 1.02)
    return float(low / margin), float(high * margin)


def positive(values: numpy.ndarray) -> numpy.ndarray:
    """Return the finite positive values of an array."""
    found: numpy.ndarray = values[numpy.isfinite(values) & (values > 0.0)]
    return found


def _spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Return places in [0, 1] near the desired ones, at least a gap apart."""
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


def direct_labels(figure: Any, axis: Any, ends: Mapping[str, tuple[float, float, Any]], rows: int) -> None:
    """Write labels of lines beside the axes, at the lines' right ends.

    Args:
        figure: figure of the axes.
        axis: axes with their limits and scales set.
        ends: coordinates of the line's end and its colour, by label.
        rows: number of axes above each other in the figure.
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


def room_for_labels(labels: Iterable[str], columns: int) -> bool:
    """Return whether labels fit beside axes, at their number and length."""
    labels = list(labels)
    width = 0.5 * (FONT_SIZES[columns] - 0.5) * max(map(len, labels), default=0) / 72.0
    return width <= 0.3 * WIDTHS[columns] and len(labels) <= MOST_BESIDE


def wrap_label(label: str, columns: int) -> str:
    """Return an axis label with line breaks, so that it fits the height of a panel."""
    return "\n".join(textwrap.wrap(label, 26 if columns == 1 else 32))


def save(figure: Any, path: Path) -> None:
    """Write a figure to a file atomically, in the format of its suffix.

    Formats are ``.png``, ``.svg`` and ``.pdf``. Equal figures give equal files.
    """
    from matplotlib import rc_context

    written = path.suffix.removeprefix(".").lower()
    check_formats([written])
    # Without the time of writing.
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(written)
    # Type 42: TrueType unchanged, which journals accept; many reject Type 3, the default.
    settings: Any = {"svg.fonttype": "none", "svg.hashsalt": "filtergym", "pdf.fonttype": 42}
    with whole_file(path) as partial, rc_context(settings):
        figure.savefig(partial, format=written, dpi=DOTS_PER_INCH, metadata=metadata)
