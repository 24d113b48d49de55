"""Pictures of this project's own pages, as wide as a paper's columns."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy

from filtergym.evaluation.figures.looks import COLOURS, styles
from filtergym.evaluation.figures.print_layout import (
    add_title,
    figure_with_axes,
    figure_with_pairs,
    in_print,
    logarithmic,
)


@in_print
def draw_learning_curves(
    curves: Mapping[str, Sequence[tuple[Sequence[float], Sequence[float]]]],
    title: str,
    paper: str,
    *,
    columns: int = 2,
) -> Any:
    """Draw the cost of validations against the paper's algorithm over training, for each algorithm.

    The line is the median over its runs, the band reaches from the lowest to the highest.

    ``curves`` has for each algorithm and run the environment steps and the relative cost differences there.
    """
    figure, axes = figure_with_axes(columns=columns, height={1: 2.4, 2: 3.2}[columns])
    axis = axes[0]
    for (name, runs), style in zip(curves.items(), styles(list(curves)).values(), strict=True):
        # Runs of one algorithm are validated at the same steps; all are drawn up to the end of the shortest.
        steps = numpy.unique(numpy.concatenate([own for own, _ in runs]))
        steps = steps[(steps >= max(own[0] for own, _ in runs)) & (steps <= min(own[-1] for own, _ in runs))]
        percent = 100.0 * numpy.array([numpy.interp(steps, *own) for own in runs])
        label = f"{name}, {len(runs)} run{'s' if len(runs) > 1 else ''}"
        axis.plot(steps / 1e6, numpy.median(percent, axis=0), label=label, **style | {"linewidth": 1.3})
        ends = percent.min(axis=0), percent.max(axis=0)
        axis.fill_between(steps / 1e6, *ends, color=style["color"], alpha=0.2, lw=0)
    axis.axhline(0.0, color="0.3", lw=1.0)
    everything = numpy.concatenate([values for runs in curves.values() for _, values in runs])
    if everything.max() > 1.0:
        # An untrained agent can cost a hundred times as much; trained ones differ near zero.
        axis.set_yscale("symlog", linthresh=10.0, linscale=1.5)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_ylim(bottom=min(1.2 * 100.0 * everything.min(), -2.0))
    # Budgets differ by factors, and most is learned early.
    axis.set_xscale("log", nonpositive="mask")
    logarithmic(axis.xaxis)
    axis.set_xlabel("environment steps, millions")
    axis.set_ylabel(f"validation cost against {paper}, %")
    axis.grid(alpha=0.25, lw=0.4)
    return add_title(figure, title)


@in_print
def draw_profiles(
    limits: numpy.ndarray, profiles: Mapping[str, numpy.ndarray], title: str, *, columns: int = 2
) -> Any:
    """Draw the share of training runs with a score above each limit, with pointwise 95 % bands.

    ``profiles`` has for each algorithm share, lower and upper end, ``(3, limits)``.
    """
    figure, axes = figure_with_axes(columns=columns, height={1: 2.4, 2: 3.0}[columns])
    axis = axes[0]
    for (name, (share, low, high)), style in zip(
        profiles.items(), styles(list(profiles)).values(), strict=True
    ):
        axis.plot(limits, share, label=name, drawstyle="steps-post", **style | {"linewidth": 1.3})
        axis.fill_between(limits, low, high, step="post", color=style["color"], alpha=0.2, lw=0)
    axis.set_xlim(limits[0], limits[-1])
    axis.set_ylim(0.0, 1.02)
    axis.set_xlabel("score: 0 is the paper's algorithm, 1 the reference")
    axis.set_ylabel("share of runs with a higher score")
    axis.grid(alpha=0.25, lw=0.4)
    return add_title(figure, title)


@in_print
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
    """Draw the cost of policies against the paper's algorithm in each scenario, as dots with intervals.

    ``differences`` has for each scenario and policy the difference in percent, lower and upper end; diamonds
    are ``learned``, grey squares ``unranked``.
    """
    height = 0.8 + len(differences) * (0.25 + 0.07 * len(names))
    figure, axes = figure_with_axes(columns=columns, height=height)
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
    return add_title(figure, title)


PUBLIC_FILTERS = ("extended", "extended, tuned", "kalman-imm, tuned", "OKF", "kalman-net", "known-model")
"""Filters drawn on KalmanNet's problems: the model's own, tuned rivals, the learned one, and the reference."""
LEARNED = "kalman-net", "KalmanNet"


@in_print
def draw_public_problems(
    rows: Sequence[Mapping[str, Any]], drives: Mapping[str, Sequence[float]], *, columns: int = 2
) -> Any:
    """Draw the errors of filters on KalmanNet's problems, as dots with intervals, and on each of NCLT's drives.

    ``drives`` has the RMSE a coordinate of every test drive, m, of each filter.
    """
    [exact] = [row for row in rows if row["problem"] == "linear, exact"]
    panels = list(dict.fromkeys(row["problem"] for row in rows if row is not exact))
    figure, axes = figure_with_pairs(len(panels) // 2 + 1, columns)
    figure.set_figheight(0.7 * figure.get_figheight())
    cells = axes.ravel().tolist()
    for axis, title in zip(cells, panels, strict=False):
        own = {row["name"]: row for row in rows if row["problem"] == title}
        if title.startswith("linear"):  # the same tracks
            own["known-model"] = exact
        shown = [name for name in PUBLIC_FILTERS if name in own]
        for place, name in enumerate(shown):
            value, low, high = (own[name][key] for key in ("mse_db", "low_db", "high_db"))
            axis.errorbar(value, place, xerr=[[value - low], [high - value]], **_look_of(name))
        _name_rows(axis, title, shown, "mean squared error, dB")
    axis = cells[len(panels)]
    for place, (name, errors) in enumerate(drives.items()):
        for error in errors:
            axis.errorbar(error, place, **_look_of(name))
    axis.set_xscale("log")
    logarithmic(axis.xaxis)
    _name_rows(axis, "NCLT, three drives", list(drives), "RMSE, m")
    rest = cells[len(panels) + 1]
    rest.axis("off")
    words = {"extended": "as written, or published", "OKF": "tuned on training data", "kalman-net": "learned"}
    handles = [rest.errorbar([], [], label=text, **_look_of(name)) for name, text in words.items()]
    rest.legend(handles=handles, loc="center", frameon=False)
    return figure


@in_print
def draw_update_times(rows: Sequence[Sequence[str]], *, columns: int = 2) -> Any:
    """Draw bars of the time of an update, the quickest first; other libraries are grey.

    A row has the filter, in quotes where it is ours, and the median time, µs.
    """
    shown = sorted(rows, key=lambda row: float(row[1]))
    median = [float(row[1]) for row in shown]
    figure, axes = figure_with_axes(columns=columns, height={1: 2.6, 2: 3.0}[columns])
    axis = axes[0]
    bars = axis.barh(
        range(len(shown)), median, color=[COLOURS[0] if "`" in row[0] else "0.6" for row in shown]
    )
    axis.bar_label(bars, fmt="{:g}", padding=3)
    axis.margins(x=0.08)
    _name_rows(axis, "", [row[0].replace("`", "") for row in shown], "time of an update, median, µs")
    return figure


def _look_of(name: str) -> dict[str, Any]:
    learned = name.startswith(LEARNED)
    colour = COLOURS[1] if learned else COLOURS[0] if name == "OKF" or "tuned" in name else "0.45"
    return {"fmt": "D" if learned else "o", "ms": 4.0, "color": colour, "elinewidth": 1.2}


def _name_rows(axis: Any, title: str, names: Sequence[str], quantity: str) -> None:
    axis.set_yticks(range(len(names)), names)
    axis.set_ylim(len(names) - 0.5, -0.5)
    axis.set_title(title, loc="left")
    axis.set_xlabel(quantity)
    axis.grid(alpha=0.25, lw=0.4)
