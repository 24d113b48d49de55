"""Figures 1 to 4 of the paper, errors by class, and targets of one type."""

from typing import Any

import numpy

from ...baselines.radar_esm_tracking.metrics import SURE
from ...evaluation.figures.looks import styles
from ..panels import draw, finish, legend_outside, line_styles, panels
from ..quantities import means
from .experiment import CLASSES, COMPONENTS, INTERVAL, Results

FILTERS = {"non-adaptive": 1.8, "ideal": 3.2, "synthesised": 1.4}
"""Line width of each drawn filter."""


def figures(r: Results) -> dict[str, tuple[Any, str]]:
    """Return each figure and its caption, by file name without suffix."""
    found = {
        "figure_1_probabilities": (draw_probabilities(r), "Figure 1: class probabilities, true class S0.")
    }
    for c, (component, _) in enumerate(COMPONENTS):
        found[f"figure_{c + 2}_{component.replace(' ', '_')}"] = (
            draw_deviation(r, c),
            f"Figure {c + 2}: {component}, true class S0. Solid: what the filters report in the run of figure 1; "
            "dashed: errors really made.",
        )
    return found | {
        "acceleration_by_class": (
            draw_classes(r), f"Acceleration error of the three filters on each class, {r.episodes} runs each."
        ),
        "one_type": (
            draw_fixed_type(r),
            f"Targets that keep one emitter type, {r.episodes} runs, 95 % bands: the printed rule grows sure of a "
            "wrong class, the joint posterior does not.",
        ),
    }  # fmt: skip


def _times(count: int) -> numpy.ndarray:
    return INTERVAL * numpy.arange(1, count + 1)


def draw_probabilities(r: Results) -> Any:
    """Draw figure 1: class probabilities of one run on S0, and their mean over runs."""
    figure, grid = panels(2, 1, (8.0, 5.6), sharex=True)
    probability = r.fused[0].probability
    t = _times(probability.shape[1])
    for s, (name, style) in enumerate(line_styles(CLASSES).items()):
        values = probability[:, :, s]
        grid[0, 0].plot(t, values[0], label=f"P({name})", drawstyle="steps-post", **style)
        grid[1, 0].fill_between(
            t, *numpy.percentile(values, [10, 90], axis=0), color=style["color"], alpha=0.15, lw=0
        )
        grid[1, 0].plot(t, values.mean(axis=0), **style)
    finish(grid[0, 0], "", "probability", "one run", legend="center right")
    finish(grid[1, 0], "t, s", "probability", f"mean and 10-90 % range of {r.episodes} runs")
    for axis in grid[:, 0]:
        axis.set(xlim=(0.0, t[-1]), ylim=(-0.02, 1.02))
    return figure


def draw_deviation(r: Results, component: int) -> Any:
    """Draw one of figures 2 to 4: reported and actual standard deviation of a component on class S0."""
    from matplotlib.lines import Line2D

    figure, grid = panels(1, 1, (8.0, 4.2))
    axis, run = grid[0, 0], r.fused[0]
    t = _times(len(run.variance))
    reported = (r.own[component, 2], r.own[component, 0], run.first_variance[:, component])
    exact = (r.exact[0, 2][component], r.exact[0, 0][component])
    made = (*exact, (run.error[:, :, component] ** 2).mean(axis=0))
    handles = []
    for (name, width), style, *variances in zip(
        FILTERS.items(), styles(list(FILTERS)).values(), reported, made, strict=True
    ):
        for variance, dash in zip(variances, ("-", "--"), strict=True):
            axis.plot(t, numpy.sqrt(variance), color=style["color"], lw=width, ls=dash)
        handles.append(Line2D([], [], color=style["color"], lw=width, label=name))
    label, unit = COMPONENTS[component]
    finish(axis, "t, s", f"std. deviation of {label} error, {unit}", log="" if component == 1 else "y")
    if component == 1:
        axis.set_ylim(bottom=0.0)  # less than a factor of three: no logarithm
    else:
        axis.yaxis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:.0e}"[0] in "25" else "")
    axis.set_xlim(0.0, t[-1])
    for dash, what in (
        ("-", "reported by the filter, run of figure 1"),
        ("--", f"really made (synthesised: {r.episodes} runs; others exact)"),
    ):
        handles.append(Line2D([], [], color="0.3", ls=dash, label=what))
    legend_outside(figure, handles=handles)
    return figure


def draw_classes(r: Results) -> Any:
    """Draw the RMSE of the acceleration of three filters, on targets of each class."""
    figure, grid = panels(1, 3, (11.0, 3.8))
    for s, axis in enumerate(grid[0]):
        squares = (r.exact[s, 2][2], r.exact[s, s][2], (r.fused[s].error[:, :, 2] ** 2).mean(axis=0))
        t = _times(len(squares[0]))
        for (name, width), style, dash, square in zip(
            FILTERS.items(), styles(list(FILTERS)).values(), ("-", "-", "--"), squares, strict=True
        ):
            axis.plot(t, numpy.sqrt(square), color=style["color"], lw=width, ls=dash, label=name)
        axis.set(xlim=(0.0, t[-1]), ylim=(0.0, None))
        finish(
            axis,
            "t, s",
            "" if s else "RMSE of the acceleration, m/s²",
            f"class {CLASSES[s]}",
            legend="" if s else "best",
        )
    return figure


def draw_fixed_type(r: Results) -> Any:
    """Draw the share of runs in which a wrong class has P >= 0.9 over time, for targets of one type each."""
    figure, grid = panels(1, 2, (10.0, 3.9))
    names = {"quasi-optimal": "printed rule (8)", "joint-type": "joint posterior of type and class"}
    for name, style in line_styles(names).items():
        run = r.fixed_type[name]
        wrong = 100.0 * run.wrong()
        fighter = (run.true_class == 2) & (run.true_type == 1)
        for axis, of in zip(grid[0], (run.true_class >= 0, fighter), strict=True):
            if of.any():
                draw(axis, _times(wrong.shape[1]), means(wrong[of]), 0.2, label=names[name], **style)
    for axis, title in zip(grid[0], ("all targets", "ordinary fighters of class S2"), strict=True):
        finish(axis, "t, s", f"P ≥ {SURE} for a wrong class, % of runs", title)
        axis.set_xlim(left=0.0)
        axis.set_ylim(bottom=0.0)
    grid[0, 0].legend(fontsize=8, frameon=False, loc="center right")
    return figure
