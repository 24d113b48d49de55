"""The paper's claims and open questions with verdicts, and the tables of the report."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy

from ...baselines.uav_autopilot.theory import stationary
from ...envs.uav_autopilot.task import UavAutopilot
from ...filters import linear_systems
from ..grid import Grid
from ..quantities import means, quantity
from ..reproduction import Statement, verdict_if
from .experiment import (
    AFTER_STEP,
    CASES,
    HORIZON,
    STEADY_WINDOW,
    Results,
    covariance_curves,
    flatness,
    innovation_variance,
    interval,
    loop_theory,
    matrices,
    settled_output,
)
from .structure import approximation_errors, controllability_matrix, spectral_width, unreached_modes

SCALES = (0.01, 1.0, 100.0)


def _excess(datasets: dict[str, Any]) -> str:
    """Return a text: cost of the paper's filter over that of the filter with known noise, and its ANEES."""
    ours, best = (datasets[name]["cost"].values.mean(axis=1) for name in ("kalman", "matched"))
    nees = datasets["kalman"]["nees"].values.mean() / datasets["kalman"].sizes["component"]
    return f"{quantity(means(ours) / means(best) - 1.0):.0%}, NEES {nees:.1f} per coordinate"


CLAIMS = (
    Statement(
        "1",
        "The model works correctly even with strongly noisy signals.",
        "P: noise 0 dB at node 2 is {P.decibel:.1f} dB weaker at node 3 (U: {U.decibel:.1f} dB). Mean output "
        "after a unit step: P {after_step[0]}, U {after_step[1]}. NEES per coordinate {nees[0]} and {nees[1]}.",
        f"{{r.episodes}} runs of {HORIZON} measurements, burn-in 200 (300 after the step)",
        "reproduced",
    ),
    Statement(
        "2",
        "If A - BL is asymptotically stable, the loop with the filter is too (separation).",
        "largest distance of a pole of the loop from the union of the separate designs: {defects}",
        "eigenvalues of the loop written in state and estimate, matched with those of F - BL and (I - KH)F",
        "reproduced",
    ),
    Statement(
        "3",
        "The correcting term of the Riccati equation limits the growth of the covariance.",
        "U, sigma of pitch in 2 min: {settled:.3f} deg with all sensors, {alone:.1f} deg without "
        "measurements; but {blind:.1f} deg, growing, when no sensor detects pitch. With gusts as the only "
        "noise the covariance stays bounded, but the gain on the pitch integrator, which gusts do not reach, falls "
        "as 1/t and the filter goes to sleep: {asleep[0]:.1e} after 12 s, {asleep[1]:.1e} after 2 min.",
        "recursion (12); the condition is detectability, and for a steady filter that is stable also noise on "
        "every integrating mode",
        "reproduced in part",
    ),
    Statement(
        "4",
        "The model serves to study white and coloured noise, stability, convergence of the filter.",
        "node 4 is white: spectral flatness {flat}; the spectra of all nodes follow the transfer "
        "functions of the loop (figures)",
        "periodograms averaged over runs; flatness of an average over M runs of white noise is about 1 - 1/(2M) = "
        "{white_flatness:.4f}",
        "reproduced",
    ),
    Statement(
        "Controllability",
        "The model serves to study the controllability of a channel; with H = I the state is completely observable.",
        "rank of [B, F B, ..., F^(n-1) B]: {reached[0]} (P, where det [B, F B] = -T³ = {determinant:.6f}), "
        "{reached[1]} (U: the elevator does not reach the gust, whose eigenvalue exp(-V T / L) = {gust:.4f} decays); "
        "of [H; H F; ...]: {seen[0]} (P, H = I), {seen[2]} (P, H = [1 0]), {seen[1]} (U)",
        "singular values; reproduced if both ranks of P are complete",
        lambda q: verdict_if(q.reached[0] == q.seen[0] == "2 of 2"),
    ),
    Statement(
        "Interval",
        "The measuring interval is T = 1 / (2 ΔF), ΔF the spectral width of the controlled coordinate; within it "
        "the coordinate is constant, linear or quadratic.",
        "P: ΔF = {width[0]:.3f} Hz admits {longest[0]:.2f} s, the printed T = {T[0]:g} s suits {suits[0]:g} Hz. "
        "U: {width[1]:.2f} Hz admits {longest[1]:.3f} s, T = {T[1]:g} s suits {suits[1]:g} Hz. After T the constant, "
        "linear and quadratic approximations err by {errors[0]} (P) and {errors[1]} (U) of the coordinate's deviation",
        "ΔF contains 99 % of the coordinate's variance in the settled loop (the paper defines no width), by its "
        "transfer functions; errors by the Lyapunov equation; reproduced if T is at most 1 / (2 ΔF)",
        lambda q: verdict_if(all(most >= T for most, T in zip(q.longest, q.T, strict=True))),
    ),
    Statement(
        "5",
        "Command: equation (6) prints none.",
        "with the feedback alone in the prediction, as (6) is printed, a unit command settles at {literal[0]:.3f} (P) "
        "and {literal[1]:.3f} (U) in place of 1; with the control in force, B U of (8) and (10), at "
        "{predicted[0]:.3f} and {predicted[1]:.3f}, and overshoot and settling are {overshoot[0]:.2f} %, "
        "{settling[0]:.2f} s (P), {overshoot[1]:.2f} %, {settling[1]:.2f} s (U)",
        "fixed point of the loop; response as difference of runs with and without step on the same noise",
    ),
    Statement(
        "6",
        "What is the filter worth to the loop?",
        "cost with raw sensors over cost with the filter: P {cost[0]:.1f}, U {cost[1]:.1f}. The output itself "
        "gains less: its variance is {variance[0]:.2f} (P) and {variance[1]:.2f} (U) times as large without it. With "
        "position alone and no filter the loop is unstable (P).",
        "{r.episodes} runs, same noise",
    ),
    Statement(
        "7",
        "How wrong may the filter's process noise be?",
        "cost of the loop above the optimum with Q times 0.01 / 100: P {above[0][0]} / {above[0][2]}, U "
        "{above[1][0]} / {above[1][2]}. Smallest cost is not smallest output variance: U with Q times 100 has "
        "{loose[1]:.4f} deg² against {tuned[1]:.4f}, for {control:.1f} times the control variance.",
        "Lyapunov equation of the loop with the mistuned steady filter",
    ),
    Statement(
        "8",
        "What happens when the noise is not constant and not known, as the paper assumes?",
        "cost of the paper's filter above that of the filter given the noise: {excess}",
        "scenario random, {r.episodes} episodes, same noise; a consistent filter has NEES 1 per coordinate",
    ),
)
"""The paper's claims, and questions that it leaves open; of pairs of numbers the first is of plant P."""


def structure(tasks: Sequence[UavAutopilot]) -> dict[str, Any]:
    """Return quantities on controllability, observability and measuring interval, by name.

    The tasks are those of plant P, plant U, and plant P with position alone.
    """
    loops = [matrices(task) for task in tasks]

    def rank(F: numpy.ndarray, B: numpy.ndarray) -> str:
        return f"{numpy.linalg.matrix_rank(controllability_matrix(F, B))} of {len(F)}"

    reached, seen = ([rank(s.F, s.B) for s in loops], [rank(s.F.T, s.H.T) for s in loops])
    widths, T = [spectral_width(task) for task in tasks[:2]], [interval(task) for task in tasks[:2]]
    return {
        "reached": reached,
        "seen": seen,
        "determinant": float(numpy.linalg.det(controllability_matrix(loops[0].F, loops[0].B))),
        "gust": float(unreached_modes(loops[1].F, loops[1].B)[0].real),
        "T": T,
        "suits": [0.5 / each for each in T],
        "width": widths,
        "longest": [0.5 / width for width in widths],
        "errors": [
            ", ".join(f"{100.0 * error:.1f} %" for error in approximation_errors(task)) for task in tasks[:2]
        ],
    }


def quantities(r: Results) -> dict[str, Any]:
    """Return the quantities that the claims' texts contain, computed from the results, by name."""
    plants = ("P, H = I", "U")
    ours = P, U = [r.noise[plant]["kalman"] for plant in plants]
    raw = [r.noise[plant]["raw-sensors"] for plant in plants]
    defects, flat = [], []
    for case, loops in r.noise.items():
        F, B, H, L, K, _, _ = matrices(loops["kalman"].task)
        defects.append(f"{case}: {linear_systems.separation_defect(F, B, H, L, K):.0e}")
        flat.append(f"{case} {flatness(loops['kalman'].innovation[:, STEADY_WINDOW]):.3f}")
    settled, alone, blind, gusts = covariance_curves(U.task).values()
    theory = [[loop_theory(s.task, scale) for scale in SCALES] for s in ours]
    transients = [r.transient(plant) for plant in plants]
    tasks = [r.noise[case]["kalman"].task for case in (*plants, "P, H = [1 0]")]

    def mean_ratio(values: Callable[[Any], numpy.ndarray]) -> list[float]:
        """Return, for both plants, a signal's mean without the filter over its mean with the filter."""
        return [float(values(a).mean() / values(b).mean()) for a, b in zip(raw, ours, strict=True)]

    return {
        "r": r,
        "P": P,
        "U": U,
        "after_step": [r.step[plant].text("output", 3, AFTER_STEP) for plant in plants],
        "nees": [s.text("nees", 3) for s in ours],
        "defects": ", ".join(defects),
        "settled": settled[0, -1],
        "alone": alone[0, -1],
        "blind": blind[0, -1],
        "asleep": (gusts[1, 599], gusts[1, -1]),
        "flat": ", ".join(flat),
        "white_flatness": 1 - 0.5 / r.episodes,
        **structure(tasks),
        "literal": [settled_output(s.task, predicts_command=False) for s in ours],
        "predicted": [settled_output(s.task, predicts_command=True) for s in ours],
        "overshoot": [100 * over for over, _, _ in transients],
        "settling": [settling for _, _, settling in transients],
        "cost": mean_ratio(lambda s: s.cost[:, STEADY_WINDOW]),
        "variance": mean_ratio(lambda s: s.output[:, STEADY_WINDOW] ** 2),
        "above": [[f"{100 * (t[0] / plant[1][0] - 1):.0f} %" for t in plant] for plant in theory],
        "tuned": theory[1][1],
        "loose": theory[1][2],
        "control": theory[1][2][2] / theory[1][1][2],
        "excess": "; ".join(f"{plant}: {_excess(datasets)}" for plant, datasets in r.random.items()),
    }


def tables(r: Results) -> list[Grid]:
    """Return the report's tables, such as the variances of the loop by theory and Monte Carlo."""
    rows = []
    for case, loops in r.noise.items():
        for name, s in loops.items():
            theory = stationary(s.task, name)
            assert theory is not None
            output, control = (
                f"{quantity(means((values[:, STEADY_WINDOW] ** 2).mean(axis=1))):.5f}"
                for values in (s.output, s.control)
            )
            rows.append(
                [
                    case, name, f"{theory.output_variance:.5f}", output, f"{theory.control_variance:.5f}", control,
                    f"{theory.cost * s.task.cost_unit:.4f}", s.text("cost"),
                ]
            )  # fmt: skip
    F, B, H, L, _, _, R = matrices(r.noise["P, H = [1 0]"]["kalman"].task)
    Q = r.noise["P, H = [1 0]"]["kalman"].task.design.model.scaled_noise
    radius = linear_systems.spectral_radius(
        linear_systems.measurement_feedback_loop(F, B, H, L, Q, R).transition
    )
    rows.append(["P, H = [1 0]", "raw-sensors", f"unstable, spectral radius {radius:.4f}", *["-"] * 5])
    columns = {case: _quantities(r, case) for case in CASES}
    return [
        Grid(
            "Variances of the loop with white-noise input, theory (Lyapunov equation) and Monte Carlo, after a burn-in "
            "of 200 measurements",
            ("case", "fed back", "output", "measured", "control", "measured", "cost", "measured"),
            rows,
        ),
        Grid(
            "Filter and response",
            ("quantity", *CASES),
            [[name, *(column[name] for column in columns.values())] for name in columns["U"]],
        ),
    ]


def _quantities(r: Results, case: str) -> dict[str, str]:
    s = r.noise[case]["kalman"]
    innovation, observation = s.innovation[:, STEADY_WINDOW], s.observation[:, STEADY_WINDOW]
    over, rise, settling = r.transient(case)
    rms, theory = math.sqrt(numpy.mean(innovation**2)), math.sqrt(innovation_variance(s.task))
    noise = f"{s.variance('observation'):.4g} to {s.variance('estimate'):.4g}"
    return {
        "noise variance, node 2 to node 3": f"{noise} ({s.decibel:.1f} dB)",
        "NEES per coordinate": s.text("nees", 3),
        "NIS per reading": s.text("nis", 3),
        "node 4 rms (theory)": f"{rms:.4f} ({theory:.4f})",
        "spectral flatness, node 4 / node 2": f"{flatness(innovation):.3f} / {flatness(observation):.3f}",
        "step: overshoot, time to 90 %, settling to 5 %": f"{100 * over:.2f} %, {rise:.2f} s, {settling:.2f} s",
        "mean output after a unit step in noise": r.step[case].text("output", 3, AFTER_STEP),
    }
