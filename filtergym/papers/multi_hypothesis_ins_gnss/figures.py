"""Figures 1 and 2 of the paper, times of loss of track, and the price of the parallel channels."""

from typing import Any

import numpy

from ...envs.tightly_coupled_navigation.parameters import HYPOTHESES
from ...evaluation.figures.looks import styles
from ..panels import draw, finish, legend_outside, line_styles, panels, shade
from ..quantities import means
from .claims import BAND, COORDINATE_LOSS, matched_ratios
from .experiment import ADAPTIVE, COMPONENTS, JUMP, MOTION, SHORTEST_LEG, Results, loss

LEAST = 0.01
"""Weight, %, as which smaller ones are drawn."""


def figures(r: Results) -> dict[str, tuple[Any, str]]:
    """Return each figure and its caption, by file name without suffix."""
    runs, few = (len(r.courses["increment"][name].nis) for name in (ADAPTIVE, "Singer"))
    return {
        "figure_1_errors": (
            draw_errors(r),
            f"Figure 1: spherical errors over {runs} runs (non-adaptive: {few}), 95 % bands; dotted lines: the motion "
            "begins, and changes.",
        ),
        "figure_2_probabilities": (
            draw_probabilities(r),
            f"Figure 2: mean probabilities over {runs} runs, 95 % bands.",
        ),
        "loss_times": (
            draw_loss_times(r),
            "When Singer's filter loses track in the increment variant, one setting changed at a time, within 1.6 s; "
            "grey: the paper's 0.5 to 1 s.",
        ),
        "matched": (
            draw_matched(r),
            "What the parallel channels cost where Singer's model is right, over the weight that they have: sensors "
            "and stay probability differ from point to point.",
        ),
    }


def draw_errors(r: Results) -> Any:
    """Draw figure 1: spherical errors of coordinates and of velocity against the step."""
    figure, grid = panels(2, 2, (11.0, 6.4), sharex=True, sharey="row")
    names = {
        ADAPTIVE: "adaptive",
        "Singer": "non-adaptive (Singer)",
        "Singer, no aperture": "the same, apertures off",
    }
    dashes = ("-", "--", ":")
    for axes, (title, runs) in zip(grid.T, r.courses.items(), strict=True):
        for c, (axis, (component, unit)) in enumerate(zip(axes, COMPONENTS, strict=False)):
            for (name, label), style, dash in zip(
                names.items(), styles(list(names)).values(), dashes, strict=True
            ):
                if name in runs:
                    errors = numpy.sqrt(means(runs[name].squares[:, :, c]))
                    style |= {"label": label, "linestyle": dash, "linewidth": 1.2}
                    draw(axis, numpy.arange(1, errors.shape[1] + 1), errors, 0.25, **style)
            for step in (MOTION, JUMP):
                axis.axvline(step, color="0.4", lw=0.7, ls=(0, (1, 2)))
            name = f"spherical error of {component}, {unit}" if axis in grid[:, 0] else ""
            finish(axis, "step" if c else "", name, "" if c else title, log="y")
    legend_outside(figure)
    return figure


def draw_probabilities(r: Results) -> Any:
    """Draw figure 2: probabilities of the hypotheses against the step, with close-ups of both changes."""
    figure, grid = panels(2, 3, (11.0, 5.4), sharey=True, width_ratios=(2.0, 1.0, 1.0))
    spans = {
        "whole run": (1, 3000),
        "leg 2 begins": (MOTION - 6, MOTION + 10),
        "leg 3 begins": (JUMP - 6, JUMP + 10),
    }
    for row, (course, runs) in enumerate(r.courses.items()):
        probability = means(runs[ADAPTIVE].probability)
        for column, (axis, (what, (first, last))) in enumerate(zip(grid[row], spans.items(), strict=True)):
            shown = probability[:, first - 1 : last]
            steps = numpy.arange(first, first + shown.shape[1])
            for i, (name, style) in enumerate(line_styles(HYPOTHESES).items()):
                points = {"marker": "o", "markersize": 3.0} if column else {}
                label = name.replace("-", " ").replace("singer", "Singer")
                draw(axis, steps, shown[:, :, i], 0.25, label=label, **style, **points)
            name = "" if column else f"{course}\nmean probability"
            finish(axis, "step" if row else "", name, "" if row else what)
            axis.set(xlim=(first - 0.5, last + 0.5), ylim=(-0.03, 1.03))
    legend_outside(figure)
    return figure


def draw_loss_times(r: Results) -> Any:
    """Draw the loss time of Singer's filter at every setting, with the band of the paper."""
    figure, grid = panels(1, 1, (8.0, 4.6))
    axis = grid[0, 0]
    lost, kept = (style["color"] for style in styles(["lost", "kept"]).values())
    shade(axis, *BAND, "paper")
    for place, run in enumerate(r.settings.values()):
        found = loss(run, SHORTEST_LEG + 1)
        if found.rate == 0.0:
            axis.text(1.58, place, "no track lost", ha="right", va="center", fontsize=8, color=kept)
            continue
        axis.plot([found.first, found.last], [place, place], color=lost, lw=2.0)
        axis.plot([found.median], [place], "o", color=lost, ms=5)
        if found.rate < 1.0:
            axis.text(found.last + 0.02, place, f"{100 * found.rate:.0f} % lost", va="center", fontsize=8)
    axis.set_yticks(range(len(r.settings)), list(r.settings), fontsize=8)
    axis.invert_yaxis()
    finish(axis, "time from the first motion to the loss of track, s: median and range over runs")
    axis.set_xlim(0.0, 1.6)
    axis.grid(visible=False, axis="y")
    return figure


def draw_matched(r: Results) -> Any:
    """Draw the loss in RMS against the matched filter over the mean weight of the other channels."""
    figure, grid = panels(1, 1, (8.0, 4.4))
    axis = grid[0, 0]
    names = [name for name, _ in COMPONENTS[:3]]
    for c, (name, style, marker) in enumerate(zip(names, styles(names).values(), "os^", strict=True)):
        weights = [
            max(100.0 * pair[ADAPTIVE].other_weight, LEAST) * 1.08 ** (c - 1) for pair in r.matched.values()
        ]
        found = [matched_ratios(pair)[c] for pair in r.matched.values()]
        value, low, high = (
            100.0 * (numpy.array(bound) - 1.0) for bound in list(zip(*found, strict=True))[:3]
        )
        axis.errorbar(
            weights,
            value,
            numpy.maximum([value - low, high - value], 0.0),
            color=style["color"],
            marker=marker,
            ms=5,
            capsize=2,
            linestyle="",
            label=name,
        )
    limit = 100.0 * COORDINATE_LOSS
    axis.axhline(limit, color="0.4", lw=0.8, ls="--")
    place = axis.get_yaxis_transform()
    axis.text(0.02, 1.08 * limit, "paper: at most 10 % in position", transform=place, fontsize=8, va="bottom")
    finish(
        axis,
        f"mean weight of the other two channels, % ({LEAST:g} stands for less)",
        log="x",
        legend="upper left",
    )
    axis.margins(x=0.05)
    axis.set_ylabel("RMS above that of the matched filter, %")
    axis.set_yscale("symlog", linthresh=0.1)
    axis.yaxis.set_major_formatter("{x:g}")
    axis.set_ylim(-0.03, 1500.0)
    return figure
