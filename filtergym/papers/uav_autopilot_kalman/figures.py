"""Figures 3 to 6 of the paper, spectra of plant U, mistuned filters, and covariances."""

from typing import Any

import numpy

from ...baselines.uav_autopilot.theory import stationary
from ...envs.uav_autopilot.task import UavAutopilot
from ...evaluation.figures.looks import COLOURS
from ..panels import finish, legend_outside, line_styles, panels
from .experiment import (
    HORIZON,
    STEADY_WINDOW,
    STEP_TIME,
    TWO_MINUTES,
    Results,
    Signals,
    covariance_curves,
    interval,
    loop_theory,
    spectrum,
    theory_spectra,
)

PLOT_WINDOW = slice(160, 320)
"""Measurements of one run that are drawn."""


def figures(r: Results) -> dict[str, tuple[Any, str]]:
    """Return each figure and its caption, by file name without suffix."""
    P, step, U = r.noise["P, H = I"]["kalman"], r.step["P, H = I"], r.noise["U"]["kalman"]
    found = {
        "figure_3_filter": (
            draw_filter(P, step),
            "Plant P: signal at the input (A) and the output (B) of the filter, one run; the dotted line is the step "
            "of the command.",
        )
    }
    for number, name, unit, title in (
        ("4_node_1", "plant_input", "m/s²", "node 1, plant input: control and white noise"),
        ("4_node_2", "observation", "m", "node 2, observation of position"),
        ("5_node_3", "estimate", "m", "node 3, estimate of position"),
        ("6_node_4", "innovation", "m", "node 4, innovation"),
    ):
        found[f"figure_{number}"] = (
            draw_node(name, unit, f"Plant P, {title}", P, step),
            f"Plant P, {title}: one run above, energy spectrum of the settled loop (left) and from the step on (right) "
            "below. What lies above theory at either end is leakage of the rectangular window.",
        )
    return found | {
        "plant_u_spectra": (
            draw_pitch_spectra(U),
            "Plant U: spectra of pitch at nodes 2 to 4, white-noise input; leakage as above.",
        ),
        "mistuning": (
            draw_mistuning({"plant P": P.task, "plant U": U.task}),
            "What a wrong process noise in the filter costs the loop.",
        ),
        "covariance": (
            draw_covariance(U.task),
            "Where the correcting term of (5) bounds the covariance of plant U, and where it does not (left; with all "
            "sensors the two curves coincide), and where the gain goes to sleep (right).",
        ),
    }


def _times(signals: Signals) -> numpy.ndarray:
    return numpy.arange(1, HORIZON + 1)[PLOT_WINDOW] * interval(signals.task)


def draw_filter(noise: Signals, step: Signals) -> Any:
    """Draw figure 3: input and output of the filter in one run, without and with a step of the command."""
    figure, axes = panels(2, 1, (8.0, 6.0))
    for axis, signals, title in zip(
        axes[:, 0], (noise, step), ("input: white noise", "input: unit step and white noise"), strict=True
    ):
        t = _times(signals)
        axis.plot(
            t, signals.observation[0, PLOT_WINDOW], color=COLOURS[5], lw=0.9, label="A: observation (node 2)"
        )
        axis.plot(t, signals.estimate[0, PLOT_WINDOW], color=COLOURS[0], lw=1.8, label="B: estimate (node 3)")
        axis.plot(t, signals.output[0, PLOT_WINDOW], color=COLOURS[6], lw=1.0, ls="--", label="true position")
        finish(axis, "time, s" if signals is step else "", "position, m", title)
    axes[1, 0].axvline(STEP_TIME * interval(step.task), color="0.5", lw=0.8, ls=":")
    legend_outside(figure, "upper right")
    return figure


def draw_node(name: str, unit: str, title: str, noise: Signals, step: Signals) -> Any:
    """Draw one of figures 4 to 6: one run of a node's signal, and its spectrum with theory."""
    figure, axes = panels(2, 2, (9.0, 5.6), sharey="row")
    for (above, below), signals, label in zip(
        axes.T, (noise, step), ("white noise", "unit step and white noise"), strict=True
    ):
        values, T = getattr(signals, name), interval(signals.task)
        above.plot(_times(signals), values[0, PLOT_WINDOW], color=COLOURS[0], lw=1.0)
        # Without its last value, the one of node 1 that has no successor.
        frequency, power = spectrum(values[:, STEP_TIME : HORIZON - 2], T)
        below.plot(frequency, power, color=COLOURS[0], lw=1.4, label=f"{len(values)} runs")
        fine = numpy.linspace(frequency[1], frequency[-1], 300)
        theory = theory_spectra(signals.task, fine)[name]
        below.plot(fine, theory, color=COLOURS[1], lw=1.2, ls="--", label="theory, noise alone")
        white = name == "innovation"
        if white:
            below.set_ylim(0.0, 1.5 * float(theory[0]))
        finish(above, "time, s", title=f"input: {label}")
        finish(below, "frequency, Hz", legend="best" if signals is step else "", log="" if white else "y")
    squared = f"({unit})²" if "/" in unit else f"{unit}²"
    axes[0, 0].set_ylabel(f"signal, {unit}")
    axes[1, 0].set_ylabel(f"energy spectrum, {squared}/Hz")
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    return figure


def draw_pitch_spectra(signals: Signals) -> Any:
    """Draw the power spectra of the signals in the loop of plant U."""
    figure, axes = panels(1, 1, (8.0, 3.8))
    axis, T = axes[0, 0], interval(signals.task)
    nodes = (("observation", "node 2", 5), ("estimate", "node 3", 0), ("innovation", "node 4", 2))
    for name, node, colour in nodes:
        frequency, power = spectrum(getattr(signals, name)[:, STEADY_WINDOW], T)
        axis.plot(frequency[1:], power[1:], color=COLOURS[colour], lw=1.6, label=f"{node}, {name}")
        fine = numpy.geomspace(frequency[1], frequency[-1], 300)
        axis.plot(fine, theory_spectra(signals.task, fine)[name], color="k", lw=0.9, ls="--")
    axis.plot([], [], color="k", lw=0.9, ls="--", label="theory")
    finish(axis, "frequency, Hz", "energy spectrum of pitch, deg²/Hz", log="xy", legend="best")
    return figure


def draw_mistuning(tasks: dict[str, UavAutopilot]) -> Any:
    """Draw cost and variances of the control loop over the process noise that its filter assumes."""
    figure, axes = panels(1, len(tasks), (9.0, 3.8))
    scales = numpy.geomspace(1e-3, 1e3, 61)
    for axis, (title, task) in zip(axes[0], tasks.items(), strict=True):
        output, control = {"P": ("m²", "(m/s²)²"), "U": ("deg²", "deg²")}[task.parameters.plant]
        theory = zip(*(loop_theory(task, scale) for scale in scales), strict=True)
        labels = ("cost of the loop", f"output variance, {output}", f"control variance, {control}")
        for values, label, colour, dash in zip(theory, labels, (6, 0, 1), ("-", "--", "-."), strict=True):
            axis.plot(scales, values, color=COLOURS[colour], ls=dash, lw=1.6, label=label)
        for loop, name in (("raw-sensors", "raw sensors"), ("true-state", "true state")):
            settled = stationary(task, loop)
            assert settled is not None
            cost = settled.cost * task.cost_unit
            axis.axhline(cost, color="0.5", lw=0.8, ls=":")
            box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
            axis.text(1e3, cost, f"cost with {name}", fontsize=7, ha="right", va="center", bbox=box)
        axis.axvline(1.0, color="0.7", lw=0.8)
        finish(
            axis,
            "factor on the process noise that the filter assumes",
            title=title,
            log="xy",
            legend="upper center",
        )
        axis.set_ylim(top=axis.get_ylim()[1] * 6)
    axes[0, 0].set_ylabel("stationary value, by the Lyapunov equation")
    return figure


def draw_covariance(task: UavAutopilot) -> Any:
    """Draw sigma and gain by the covariance recursion (12) of plant U over two minutes."""
    figure, axes = panels(1, 2, (9.0, 3.8))
    curves = covariance_curves(task)
    t = numpy.arange(1, TWO_MINUTES + 1) * interval(task)
    for (label, values), style in zip(curves.items(), line_styles(curves).values(), strict=True):
        axes[0, 0].plot(t, values[0], label=label, **style)
        if values[1].any():
            axes[0, 1].plot(t, values[1], label=label, **style)
    finish(axes[0, 0], "time, s", "sigma of the pitch estimate, deg", log="xy")
    finish(axes[0, 1], "time, s", "size of the gain on the pitch integrator", log="xy")
    legend_outside(figure, "upper center", columns=2)
    return figure
