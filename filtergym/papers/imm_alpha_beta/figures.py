"""Figures 2 to 5 of the paper, and the grid of gains."""

import math
from typing import Any

import numpy

from ...evaluation.figures.looks import styles
from ..panels import draw, finish, legend_outside, line_styles, panels, shade
from ..quantities import means
from .claims import HIGH_BOX, LOW_BOX, NEAR_MINIMUM, grid_errors
from .experiment import COMPARED_POLICIES, COMPONENTS, HIGH_GAINS, LOW_GAINS, NAMES, WINDOWS, Results
from .gain_schedules import ramp_schedule


def figures(r: Results) -> dict[str, tuple[Any, str]]:
    """Return each figure and its caption, by file name without suffix."""
    return {
        "figure_2_trajectory": (
            draw_trajectory(r), "Figure 2: the flight; one episode's measurements and estimate."
        ),
        "figure_3_gain": (
            draw_gain(r),
            "Figure 3: gain of the adaptive filter, with 95 % bands of the means, and the best schedule of one "
            "filter that knows the flight.",
        ),
        "figure_4_errors": (draw_errors(r), f"Figure 4: RMSE along x over {r.episodes} episodes, 95 % bands."),
        "figure_5_probabilities": (
            draw_probabilities(r), f"Figure 5: mode probabilities of the IMM over {r.episodes} episodes."
        ),
        "gain_grid": (
            draw_gain_grid(r),
            f"Whole-run RMS on the gain grid, {r.grid_episodes} episodes a cell on common noise; dashed: the gains "
            "that the paper recommends.",
        ),
    }  # fmt: skip


def _shade_turn(axis: Any) -> None:
    first, last = WINDOWS["turn"]
    shade(axis, first - 0.5, last + 0.5, "turn")


def draw_trajectory(r: Results) -> Any:
    """Draw figure 2: the flight, with measurements and estimate of one episode."""
    figure, grid = panels(1, 2, (10.0, 4.6))
    truth, seen = r.recording.truth[:, :2, 0] / 1e3, r.recording.measurement[:, :, 0] / 1e3
    estimate = truth + r.main["imm"].first[:, :2] / 1e3
    style = line_styles(["true", "estimate", "measured"])
    first, last = WINDOWS["turn"]
    for axis in grid[0]:
        axis.plot(*truth.T, label="true flight", **style["true"])
        axis.plot(*estimate.T, label="IMM estimate, one episode", **style["estimate"])
        axis.plot(*seen.T, ".", ms=4, color=style["measured"]["color"], label="measurements, one episode")
        axis.plot(*truth[[first - 2, last - 1]].T, "k|", ms=14, mew=1.5, label="turn begins and ends")
        axis.plot(0.0, 0.0, "k^", ms=7, label="radar")
        axis.set_aspect("equal")
    finish(grid[0, 0], "x, km", "y, km", legend="lower left")
    finish(grid[0, 1], "x, km", "y, km", "around the turn")
    grid[0, 0].set(xlim=(-11.0, 30.0), ylim=(-30.0, 10.0))
    x, y = truth[first - 2 : last].mean(axis=0)
    grid[0, 1].set(xlim=(x - 2.2, x + 2.2), ylim=(y - 2.2, y + 2.2))
    return figure


def draw_gain(r: Results) -> Any:
    """Draw figure 3: gain of the adaptive filter, as the paper draws it and as its detector sets it."""
    figure, grid = panels(1, 1, (8.0, 3.8))
    axis, detection = grid[0, 0], WINDOWS["turn"][0] + 2
    scans = numpy.arange(1, len(r.schedule) + 1)
    drawn = ramp_schedule(0.3, 0.7, len(scans), detection)
    curves = {
        f"as in the paper's figure 3, detection at scan {detection}": drawn[None],
        "mean over episodes, no re-arming": means(r.main["adaptive"].alpha),
        "mean over episodes, re-arming": means(r.main["adaptive-rearm"].alpha),
        "best schedule, flight known": r.schedule[None],
    }
    _shade_turn(axis)
    for width, (name, style) in zip((2.4, 1.6, 1.6, 1.6), line_styles(curves).items(), strict=True):
        draw(axis, scans, curves[name], label=name, **(style | {"linewidth": width}))
    axis.set_ylim(0.0, 1.0)
    finish(axis, "scan k", "position gain alpha")
    axis.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(0.08, 1.0))
    return figure


def draw_errors(r: Results) -> Any:
    """Draw figure 4: RMSE of x position and x velocity in each scan."""
    figure, grid = panels(2, 1, (8.0, 6.4))
    scans = numpy.arange(1, len(r.schedule) + 1)
    for c, (axis, (component, unit)) in enumerate(zip(grid[:, 0], COMPONENTS, strict=True)):
        _shade_turn(axis)
        for name, style in line_styles((*COMPARED_POLICIES, "known-turn")).items():
            draw(axis, scans, numpy.sqrt(r.main[name].squares[:, :, c]), label=NAMES[name], **style)
        axis.set_ylim(bottom=0.0)
        finish(
            axis, "scan k" if c else "", f"RMSE of x {component}, {unit}", legend="" if c else "upper left"
        )
    return figure


def draw_probabilities(r: Results) -> Any:
    """Draw figure 5: mode probabilities of the IMM."""
    figure, grid = panels(2, 1, (8.0, 5.2))
    probability = r.main["imm"].probability
    scans = numpy.arange(1, probability.shape[1] + 1)
    for mode, (axis, style) in enumerate(zip(grid[:, 0], styles(["1", "2"]).values(), strict=True)):
        values = probability if mode == 0 else 1.0 - probability
        inner = numpy.percentile(values, [10, 90], axis=0)
        _shade_turn(axis)
        axis.fill_between(scans, *inner, color=style["color"], alpha=0.15, lw=0, label="10-90 % of episodes")
        draw(axis, scans, means(values), 0.4, label="mean with 95 % band", **style)
        axis.axhline(0.5, color="0.4", lw=0.7)
        axis.set_ylim(0.0, 1.0)
        name = f"probability of mode {mode + 1}\n(gain {(0.3, 0.7)[mode]:g})"
        finish(axis, "scan k" if mode else "", name, legend="upper right" if mode else "lower right")
    return figure


def draw_gain_grid(r: Results) -> Any:
    """Draw the whole-run RMS of every pair of gains, with the recommended box and the cells close to the minimum."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle

    figure, grid = panels(1, 2, (12.0, 4.6))
    half = 0.025
    box = {"color": styles(["a", "b"])["b"]["color"], "lw": 2.5, "ls": "--"}
    errors = grid_errors(r.grids["gains used"], WINDOWS["all"])
    for c, (axis, samples, (component, unit)) in enumerate(zip(grid[0], errors, COMPONENTS, strict=True)):
        shown = samples[0]
        edges = [numpy.append(numpy.array(g) - half, g[-1] + half) for g in (HIGH_GAINS, LOW_GAINS)]
        mesh = axis.pcolormesh(*edges, shown, cmap="cividis_r")
        for (i, j), error in numpy.ndenumerate(shown):
            colour = "white" if error > 0.5 * (shown.max() + shown.min()) else "black"
            place = {"ha": "center", "va": "center", "fontsize": 8, "color": colour}
            axis.text(HIGH_GAINS[j], LOW_GAINS[i], f"{error:.{c + 1}f}", **place)
        _outline(axis, shown <= (1.0 + NEAR_MINIMUM) * shown.min(), half)
        corner, (width, height) = (
            (HIGH_BOX[0] - half, LOW_BOX[0] - half),
            (HIGH_BOX[1] - HIGH_BOX[0], LOW_BOX[1] - LOW_BOX[0]),
        )
        axis.add_patch(
            Rectangle(corner, width + 2 * half, height + 2 * half, fill=False, clip_on=False, **box)
        )
        axis.set_xticks(HIGH_GAINS)
        axis.set_yticks(LOW_GAINS)
        axis.set_xlabel("gain of the manoeuvre filter, alpha_2")
        axis.set_ylabel("gain of the quiet filter, alpha_1")
        spread = math.sqrt(samples[1:].var(axis=0).mean())
        axis.set_title(f"x {component} (± {spread:.2g} {unit} standard error)", fontsize=9)
        figure.colorbar(mesh, ax=axis, label=f"whole-run RMS, {unit}")
    handles = [
        Line2D([], [], label="box of the paper", **box),
        Line2D([], [], color="black", lw=2.0, label=f"within {100 * NEAR_MINIMUM:.0f} % of the minimum"),
    ]
    legend_outside(figure, columns=2, handles=handles)
    return figure


def _outline(axis: Any, chosen: numpy.ndarray, half: float) -> None:
    """Draw the border around a set of cells of the gain grid."""
    padded = numpy.pad(chosen, 1)
    for i, j in numpy.argwhere(chosen):
        low, high = LOW_GAINS[i], HIGH_GAINS[j]
        for side, (di, dj) in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
            if not padded[i + 1 + di, j + 1 + dj]:
                x = (high - half, high + half) if side < 2 else (high + dj * half,) * 2
                y = (low + di * half,) * 2 if side < 2 else (low - half, low + half)
                axis.plot(x, y, color="black", lw=2.0, solid_capstyle="projecting")
