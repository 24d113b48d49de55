"""Figures 2, 4 and 5 of the paper, and the mean error under a drift."""

from typing import Any

import numpy

from ...evaluation.figures.looks import styles
from ..panels import draw, finish, panels
from . import kalman_bucy
from .experiment import DRIFT, GAINS, INTENSITY, LONG, NAMES, PARAMETERS, A, Results, U, closed_form


def figures(r: Results) -> dict[str, tuple[Any, str]]:
    """Return each figure and its caption, by file name without suffix."""
    return {
        "figure_2": (
            draw_first_order(r),
            "Fig. 2: one run of example (a), and exact standard deviations; the estimate is near the process and far "
            "from the reference.",
        ),
        "figure_4": (
            draw_instruments(r),
            f"Fig. 4: what INS and GNSS say in one run with a drift of {DRIFT:g} m/s.",
        ),
        "figure_5": (draw_estimates(r), "Fig. 5: estimates of the same run, and their errors."),
        "drift": (
            draw_drift(r),
            f"Mean error with a drift of {DRIFT:g} m/s, 95 % bands; dotted: beta / K.",
        ),
    }


def _times(count: int) -> numpy.ndarray:
    return PARAMETERS.sampling_interval * numpy.arange(1, count + 1)


def draw_first_order(r: Results) -> Any:
    """Draw figure 2: one run's reference, process and estimate, and exact standard deviations over time."""
    figure, axes = panels(2, 1, (8.0, 7.2))
    time = r.example.time
    theta = kalman_bucy.moments(A, U, INTENSITY, 0, 0, time).covariance[:, 0, 0]
    R = closed_form(time)
    labels = {"reference": "reference $X_r$", "process": "process $X$", "estimate": r"estimate $\hat X$"}
    curves = {
        r"$X - X_r$: $\sqrt{\Theta}$": theta,
        r"$\hat X - X_r$: $\sqrt{\Theta - R}$": theta - R,
        r"$\hat X - X$: $\sqrt{R}$": R,
    }
    paths = {label: r.example.path[name] for name, label in labels.items()}
    deviations = {label: numpy.sqrt(values) for label, values in curves.items()}
    for axis, lines, name in zip(
        axes[:, 0], (paths, deviations), ("value, unit", "standard deviation, unit"), strict=True
    ):
        for label, style in styles(list(lines)).items():
            axis.plot(time, lines[label], label=label, **style)
        finish(axis, "time, s", name, legend="best")
    return figure


def draw_instruments(r: Results) -> Any:
    """Draw the positions by INS and receiver in the example run."""
    figure, axes = panels(1, 1, (8.0, 3.6))
    run = r.paths["plain-reduced"]
    time = _times(len(run["ins"]))
    style = styles(["Z", "X"])
    axes[0, 0].plot(
        time, run["measurement"], label="GNSS $Z$", **(style["Z"] | {"linewidth": 0.5, "alpha": 0.6})
    )
    axes[0, 0].plot(time, run["ins"], label="INS $X$", **style["X"])
    axes[0, 0].plot(time, run["reference"], label="reference $X_r$", color="#000000", linewidth=1.6)
    finish(axes[0, 0], "time, s", "position, m", legend="best")
    return figure


def draw_estimates(r: Results) -> Any:
    """Draw the estimates of all policies in the example run, and their errors."""
    figure, axes = panels(2, 1, (8.0, 7.2))
    reference = r.paths["plain-reduced"]["reference"]
    time = _times(len(reference))
    axes[0, 0].plot(time, reference, color="#000000", linewidth=2.2, label="reference $X_r$")
    for name, style in styles(list(r.paths)).items():
        estimate = r.paths[name]["estimate"]
        axes[0, 0].plot(time, estimate, label=NAMES[name], **style)
        axes[1, 0].plot(time, estimate - reference, label=NAMES[name], **style)
    axes[1, 0].axhline(0.0, color="0.3", lw=0.8)
    finish(axes[0, 0], "time, s", "position, m", legend="best")
    finish(axes[1, 0], "time, s", "error of the estimate, m", legend="best")
    return figure


def draw_drift(r: Results) -> Any:
    """Draw the mean errors of all policies under a constant drift of the INS."""
    figure, axes = panels(1, 1, (8.0, 3.6))
    axis = axes[0, 0]
    for name, style in styles(list(r.drift)).items():
        draw(axis, _times(LONG), r.drift[name], 0.2, label=NAMES[name], **style)
        if name in GAINS:
            axis.axhline(DRIFT / GAINS[name], color=style["color"], lw=0.8, ls=":")
    axis.axhline(0.0, color="0.3", lw=0.8)
    finish(axis, "time, s", f"mean error with a drift of {DRIFT:g} m/s, m", legend="best")
    return figure
