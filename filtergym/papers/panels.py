"""Pictures of a reproduction: panels, lines with bands, names and legends in one style."""

from collections.abc import Iterable
from typing import Any

import numpy

from ..evaluation.figures.looks import LINES, styles
from .quantities import band


def panels(rows: int, columns: int, size: tuple[float, float], **keywords: Any) -> tuple[Any, Any]:
    """Return an empty Matplotlib figure of ``size`` inches, and its axes, ``(rows, columns)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **keywords)


def line_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return Matplotlib's colour and dash style of each curve's name."""
    return {
        name: style | {"linestyle": LINES[i % len(LINES)]}
        for i, (name, style) in enumerate(styles(list(names)).items())
    }


def draw(axis: Any, x: numpy.ndarray, samples: numpy.ndarray, alpha: float = 0.3, **style: Any) -> None:
    """Draw a curve over its 95 % band, from its value and bootstrap samples, ``(1 + resamples, len(x))``."""
    axis.plot(x, samples[0], **style)
    if len(samples) > 1:
        axis.fill_between(x, *band(samples), color=style["color"], alpha=alpha, lw=0)


def finish(axis: Any, x: str = "", y: str = "", title: str = "", *, legend: str = "", log: str = "") -> None:
    """Set labels, title, legend and grid of axes; ``log`` lists the logarithmic ones ("x", "y" or "xy")."""
    for name in log:
        getattr(axis, f"set_{name}scale")("log")
        if getattr(axis, f"get_{name}lim")()[0] > 5e-4:  # smaller numbers are shorter as powers of ten
            getattr(axis, f"{name}axis").set_major_formatter("{x:g}")
    if x:
        axis.set_xlabel(x)
    if y:
        axis.set_ylabel(y)
    if title:
        axis.set_title(title, fontsize=9, loc="left")
    axis.grid(alpha=0.25, which="both", lw=0.4)
    axis.margins(x=0.01)
    if legend:
        axis.legend(fontsize=8, frameon=False, loc=legend)


def legend_outside(figure: Any, place: str = "lower center", columns: int = 3, handles: Any = None) -> None:
    """Put the legend of a figure's first axes, or of some handles, beside the panels."""
    handles = figure.axes[0].get_legend_handles_labels()[0] if handles is None else handles
    figure.legend(handles=handles, loc=f"outside {place}", ncols=columns, fontsize=9, frameon=False)


def shade(axis: Any, first: float, last: float, name: str) -> None:
    """Shade a span of the abscissa of axes, and name it along the top."""
    axis.axvspan(first, last, color="0.92", zorder=0, lw=0)
    place = {"transform": axis.get_xaxis_transform(), "ha": "center", "va": "bottom"}
    axis.text((first + last) / 2, 1.01, name, fontsize=8, color="0.35", **place)
