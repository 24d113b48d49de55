"""The paper's claims and what it does not mention, with verdicts, and the tables of the report."""

import math

import numpy

from ...baselines.uav_autopilot.theory import stationary
from ...filters import linear_systems
from ..grid import Grid
from ..measured import means, measured
from ..reproduction import Claim
from .experiment import (
    AFTER_STEP,
    CASES,
    HORIZON,
    SETTLED,
    Results,
    covariance_curves,
    flatness,
    innovation_variance,
    loop_theory,
    matrices,
    settles_without_command,
)

SCALES = (0.01, 1.0, 100.0)


def _excess(datasets: dict) -> str:
    """Cost of the paper's filter above that of the filter told the noise, and its consistency."""
    ours, best = (datasets[name]["cost"].values.mean(axis=1) for name in ("kalman", "matched"))
    nees = datasets["kalman"]["nees"].values.mean() / datasets["kalman"].sizes["component"]
    return f"{measured(means(ours) / means(best) - 1.0):.0%}, NEES {nees:.1f} per coordinate"


def claims(r: Results) -> list[Claim]:
    """The paper's claims, and what it does not mention."""
    P, U = r.noise["P, H = I"]["kalman"], r.noise["U"]["kalman"]
    raw = (r.noise["P, H = I"]["raw-sensors"], r.noise["U"]["raw-sensors"])
    steps = (r.step["P, H = I"], r.step["U"])
    defects, flat = [], []
    for case, loops in r.noise.items():
        F, B, H, L, K, _, _ = matrices(loops["kalman"].task)
        defects.append(f"{case}: {linear_systems.separation_defect(F, B, H, L, K):.0e}")
        flat.append(f"{case} {flatness(loops['kalman'].innovation[:, SETTLED]):.3f}")
    settled, alone, blind, gusts = covariance_curves(U.task).values()
    theory = [[loop_theory(s.task, scale) for scale in SCALES] for s in (P, U)]
    percent = [[f"{100 * (t[0] / plant[1][0] - 1):.0f} %" for t in plant] for plant in theory]
    after = [settles_without_command(s.task) for s in (P, U)]
    (over_p, _, settling_p), (over_u, _, settling_u) = r.transient("P, H = I"), r.transient("U")
    cost = [a.cost[:, SETTLED].mean() / b.cost[:, SETTLED].mean() for a, b in zip(raw, (P, U), strict=True)]
    squares = [[float(numpy.mean(s.output[:, SETTLED] ** 2)) for s in both] for both in (raw, (P, U))]
    return [
        Claim(
            "1",
            "The model works correctly even with strongly noisy signals.",
            f"P: noise 0 dB at node 2 is {P.decibel:.1f} dB weaker at node 3 (U: {U.decibel:.1f} dB). Mean output "
            f"after a unit step: P {steps[0].text('output', 3, AFTER_STEP)}, U "
            f"{steps[1].text('output', 3, AFTER_STEP)}. NEES per coordinate {P.text('nees', 3)} and "
            f"{U.text('nees', 3)}.",
            f"{r.episodes} runs of {HORIZON} measurements, burn-in 200 (300 after the step)",
            "reproduced",
        ),
        Claim(
            "2",
            "If A - BL is asymptotically stable, the loop with the filter is too (separation).",
            "largest distance of a pole of the loop from the union of the separate designs: "
            + ", ".join(defects),
            "eigenvalues of the loop written in state and estimate, matched with those of F - BL and (I - KH)F",
            "reproduced",
        ),
        Claim(
            "3",
            "The correcting term of the Riccati equation limits the growth of the covariance.",
            f"U, sigma of pitch in 2 min: {settled[0, -1]:.3f} deg with all sensors, {alone[0, -1]:.1f} deg without "
            f"measurements; but {blind[0, -1]:.1f} deg, growing, when no sensor detects pitch. With gusts as the only "
            "noise the covariance stays bounded, but the gain on the pitch integrator, which gusts do not reach, falls "
            f"as 1/t and the filter goes to sleep: {gusts[1, 599]:.1e} after 12 s, {gusts[1, -1]:.1e} after 2 min.",
            "recursion (12); the condition is detectability, and for a steady filter that is stable also noise on "
            "every integrating mode",
            "reproduced in part",
        ),
        Claim(
            "4",
            "The model serves to study white and coloured noise, stability, convergence of the filter.",
            f"node 4 is white: spectral flatness {', '.join(flat)}; the spectra of all nodes follow the transfer "
            "functions of the loop (figures)",
            "periodograms averaged over runs; flatness of an average over M runs of white noise is about 1 - 1/(2M) = "
            f"{1 - 0.5 / r.episodes:.4f}",
            "reproduced",
        ),
        Claim(
            "5",
            "Command: equations (6), (10) print none.",
            f"taken literally a unit command settles at {after[0]:.3f} (P) and {after[1]:.3f} (U) in place of 1; with "
            f"the command in the prediction overshoot and settling are {100 * over_p:.2f} %, {settling_p:.2f} s (P), "
            f"{100 * over_u:.2f} %, {settling_u:.2f} s (U)",
            "fixed point of the loop; response as difference of runs with and without step on the same noise",
        ),
        Claim(
            "6",
            "What is the filter worth to the loop?",
            f"cost with raw sensors over cost with the filter: P {cost[0]:.1f}, U {cost[1]:.1f}. The output itself "
            f"gains less: its variance is {squares[0][0] / squares[1][0]:.2f} (P) and "
            f"{squares[0][1] / squares[1][1]:.2f} (U) times as large without it. With position alone and no filter the "
            "loop is unstable (P).",
            f"{r.episodes} runs, same noise",
        ),
        Claim(
            "7",
            "How wrong may the filter's process noise be?",
            f"cost of the loop above the optimum with Q times 0.01 / 100: P {percent[0][0]} / {percent[0][2]}, U "
            f"{percent[1][0]} / {percent[1][2]}. Smallest cost is not smallest output variance: U with Q times 100 has "
            f"{theory[1][2][1]:.4f} deg² against {theory[1][1][1]:.4f}, for {theory[1][2][2] / theory[1][1][2]:.1f} "
            "times the control variance.",
            "Lyapunov equation of the loop with the mistuned steady filter",
        ),
        Claim(
            "8",
            "What happens when the noise is not constant and not known, as the paper assumes?",
            "cost of the paper's filter above that of the filter told the noise: "
            + "; ".join(f"{plant}: {_excess(datasets)}" for plant, datasets in r.random.items()),
            f"scenario random, {r.episodes} episodes, same noise; a consistent filter has NEES 1 per coordinate",
        ),
    ]


def tables(r: Results) -> list[Grid]:
    """Tables of the report."""
    rows = []
    for case, loops in r.noise.items():
        for name, s in loops.items():
            theory = stationary(s.task, name)
            assert theory is not None
            output, control = (
                f"{measured(means((values[:, SETTLED] ** 2).mean(axis=1))):.5f}"
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
    innovation, observation = s.innovation[:, SETTLED], s.observation[:, SETTLED]
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
