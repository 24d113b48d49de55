"""Reproduction of the Kalman filter in the control loop of an unmanned aircraft.

The paper prints the transition matrix, two kinds of input and the list of observed nodes; every other number
of the experiment is ours, so its curves can be compared in kind only. What can be checked exactly is checked
against the Lyapunov and Riccati equations.

Nodes: 1 the plant's input (control, command and white noise), 2 the observation z, 3 the estimate, 4 the
innovation; all of the output coordinate. Energy spectrum: ``|DFT|^2 T / n`` averaged over runs, two-sided.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy

from ...envs.catalogue import make_task
from ...envs.uav_autopilot.task import UavAutopilot
from ...evaluation.figures import COLOURS
from ...evaluation.rollout import run_policy, run_reference
from ...evaluation.seeds import episode_seeds
from ...filters import linear_systems
from ..names import evaluate
from ..reproduction import Claim, Grid, Reproduction, episode_count
from .policies import Kalman, RawSensors
from .references import TrueState
from .theory import stationary

TITLE = "Stochastic simulation of a UAV autopilot with the optimal Kalman filter (Gridnev, Rusetski, Rak)"
EPISODES = 600
HORIZON = 600
SETTLED = slice(200, HORIZON)
"""Measurements after the burn-in."""
TWO_MINUTES = 6000
"""Measurements of plant U."""
AFTER_STEP = slice(300, HORIZON)
STEP_TIME = 200
SCALES = (0.01, 1.0, 100.0)
_CASES: dict[str, dict[str, Any]] = {
    "P, H = I": {"plant": "P"},
    "P, H = [1 0]": {"plant": "P", "sensors": ("position",)},
    "U": {"plant": "U"},
}
_LOOPS = ("true-state", "kalman", "raw-sensors")
_RUNS = (len(_LOOPS) + 1) * len(_CASES) - 1 + 2 * 2
STEPS = _RUNS * EPISODES * HORIZON

Progress = Callable[[int], None]


@dataclass
class Signals:
    """One loop over all runs, ``(runs, time)`` each."""

    task: UavAutopilot
    output: numpy.ndarray
    control: numpy.ndarray
    cost: numpy.ndarray
    """In the units of the weights."""
    observation: numpy.ndarray
    estimate: numpy.ndarray
    innovation: numpy.ndarray
    """In units of the output; exact once the filter's covariance has settled. NaN without a filter."""
    nees: numpy.ndarray
    """Normalised estimation error squared per coordinate."""
    nis: numpy.ndarray
    plant_input: numpy.ndarray
    """Control plus white noise, plant P; control, plant U."""


def _run(keywords: dict[str, Any], scenario: str, loop: str, episodes: int, progress: Progress) -> Signals:
    control = "mode" if loop == "raw-sensors" else "gain"
    more: dict[str, Any] = {"step_time": STEP_TIME} if scenario == "paper-step" else {}
    task = make_task("UavAutopilot", control, scenario, **{"horizon": HORIZON, **more, **keywords})
    assert isinstance(task, UavAutopilot)
    shown = task.measured.index(task.output)
    kept: dict[str, list[numpy.ndarray]] = {}
    truths: list[numpy.ndarray] = []
    judge = task.estimated_outside() if loop == "true-state" else task

    def record(state: Any) -> None:
        error = judge.error(state)[:, :episodes]
        covariance = numpy.moveaxis(judge.covariance(state)[..., :episodes], -1, 0)
        told = judge.records(state)
        silent = numpy.full_like(told["output"], numpy.nan)
        whitened = numpy.linalg.solve(covariance, error.T[:, :, None])[:, :, 0]
        values = {
            "output": told["output"],
            "control": told["control_signal"],
            "cost": judge.cost(state) * task.cost_unit,
            "observation": state.measurement.reading[shown],
            "estimate": judge.mean(state)[task.output],
            "innovation": told.get("innovation", silent),
            "nis": told.get("nis", silent),
        }
        for name, value in values.items():
            kept.setdefault(name, []).append(value[:episodes])
        kept.setdefault("nees", []).append((whitened * error.T).sum(axis=1) / len(error))
        truths.append(state.truth.state[:, :episodes])

    seeds = episode_seeds("test", 0, episodes)
    if loop == "true-state":
        run_reference(task, TrueState(task), seeds, record, progress)
    else:
        policy = Kalman(task) if loop == "kalman" else RawSensors(task)
        run_policy(task, policy, seeds, record, progress)
    series = {name: numpy.stack(values, axis=1) for name, values in kept.items()}
    d = task.design
    S = d.H @ d.steady.predicted @ d.H.T + d.R
    series["innovation"] = series["innovation"] * math.sqrt(S[shown, shown])
    plant_input = series["control"].copy()
    if task.parameters.plant == "P":
        truth = numpy.stack(truths, axis=-1)
        driven = truth[..., 1:] - numpy.einsum("ij,jnk->ink", d.model.F, truth[..., :-1])
        plant_input = numpy.concatenate(
            [
                (numpy.linalg.pinv(d.model.B) @ driven.reshape(2, -1)).reshape(driven.shape[1:]),
                plant_input[:, -1:],
            ],
            axis=1,
        )
    return Signals(task=task, plant_input=plant_input, **series)


def _mean(values: numpy.ndarray) -> tuple[float, float]:
    """Mean over runs of a time average, and its standard error."""
    runs = values.mean(axis=1)
    return float(runs.mean()), float(runs.std(ddof=1) / math.sqrt(len(runs)))


def _measured(values: numpy.ndarray, digits: int = 4) -> str:
    mean, error = _mean(values)
    return f"{mean:.{digits}f} ± {error:.{digits}f}"


def _decibel(signals: Signals) -> float:
    before = numpy.mean((signals.observation - signals.output)[:, SETTLED] ** 2)
    after = numpy.mean((signals.estimate - signals.output)[:, SETTLED] ** 2)
    return 10.0 * math.log10(before / after)


def _spectrum(values: numpy.ndarray, T: float) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Frequencies, Hz, and averaged periodogram, unit squared per Hz."""
    n = values.shape[1]
    power = (numpy.abs(numpy.fft.rfft(values, axis=1)) ** 2).mean(axis=0) * T / n
    return numpy.fft.rfftfreq(n, T), power


def _flatness(values: numpy.ndarray) -> float:
    """Geometric over arithmetic mean of the averaged periodogram: one for white noise."""
    power = _spectrum(values, 1.0)[1]
    return float(numpy.exp(numpy.log(power).mean()) / power.mean())


def _theory_spectra(task: UavAutopilot, frequency: numpy.ndarray) -> dict[str, numpy.ndarray]:
    """Spectra of the nodes of the settled loop, white-noise input, from its transfer functions."""
    d, T = task.design, task.parameters.value("sampling_interval")
    F, B, H, L, K = d.model.F, d.model.B, d.H, d.feedback, d.steady.gain
    Q, n = d.model.scaled_noise + d.model.other_noise, len(d.model.F)
    shown = task.measured.index(task.output)
    loop = linear_systems.estimate_feedback_loop(F, B, H, L, K, Q, d.R)
    rest = numpy.eye(n) - K @ H
    entry = numpy.block([[numpy.eye(n), numpy.zeros_like(K)], [rest, -K]])
    C = numpy.linalg.cholesky(d.R)
    noise = numpy.block(
        [[linear_systems.noise_factor(Q), numpy.zeros((n, len(C)))], [numpy.zeros((len(C), n)), C]]
    )
    direct = numpy.hstack([numpy.zeros((1, n)), numpy.eye(len(C))[[shown]]]) @ noise
    coordinate = numpy.eye(n)[[task.output]]
    z = numpy.exp(2j * numpy.pi * frequency * T)[:, None, None]
    # The noise of a measurement acts on the state of that measurement: s(k) = A s(k-1) + entry n(k).
    response = numpy.linalg.solve(numpy.eye(2 * n) - loop.transition / z, entry @ noise + 0.0 * z)

    def power(row: numpy.ndarray, feed: Any = 0.0) -> numpy.ndarray:
        return T * (numpy.abs(row @ response + feed) ** 2).sum(axis=(1, 2))

    S = d.H @ d.steady.predicted @ d.H.T + d.R
    # The noise on the control between two measurements belongs to the second one, hence the z.
    driven = numpy.zeros((1, noise.shape[1]))
    if task.parameters.plant == "P":
        driven[0, 0] = task.parameters.acceleration_sigma
    return {
        "plant_input": power(-L @ numpy.hstack([numpy.eye(n), -numpy.eye(n)]), z * driven),
        "observation": power(numpy.hstack([coordinate, 0.0 * coordinate]), direct),
        "estimate": power(numpy.hstack([coordinate, -coordinate])),
        "innovation": T * S[shown, shown] + 0.0 * frequency,
    }


def _without_command_in_prediction(task: UavAutopilot) -> float:
    """Output at which a unit command settles if (6) and (10) are taken as printed."""
    d = task.design
    F, B, H, L, K, n = d.model.F, d.model.B, d.H, d.feedback, d.steady.gain, len(d.model.F)
    rest = numpy.eye(n) - K @ H
    # x = F x + B (N - L y);  y = rest (F - B L) y + K H x
    system = numpy.block([[numpy.eye(n) - F, B @ L], [-K @ H, numpy.eye(n) - rest @ (F - B @ L)]])
    settled = numpy.linalg.solve(system, numpy.concatenate([B[:, 0] * d.feedforward, numpy.zeros(n)]))
    return float(settled[task.output])


def _covariances(task: UavAutopilot, steps: int, **changes: Any) -> numpy.ndarray:
    """Recursion (12): sigma of the output's estimate, gain on the integrating mode, ``(2, steps)``.

    The mode's coordinate is ``w^T x`` with ``w^T F = w^T``, scaled to contain the output once.
    """
    d = task.design
    F, H, R = d.model.F, changes.get("H", d.H), changes.get("R", d.R)
    Q = changes.get("Q", d.model.scaled_noise + d.model.other_noise)
    values, vectors = numpy.linalg.eig(F.T)
    w = numpy.real(vectors[:, numpy.argmin(numpy.abs(values - 1.0))])
    w = w / w[task.output]
    P = numpy.diag(numpy.square(task.parameters.value("initial_sigmas"))).astype(float)
    found = numpy.empty((2, steps))
    for k in range(steps):
        P = F @ P @ F.T + Q
        K = numpy.zeros((len(F), 1))
        if len(H):
            K = P @ H.T @ numpy.linalg.inv(H @ P @ H.T + R)
            rest = numpy.eye(len(F)) - K @ H
            P = rest @ P @ rest.T + K @ R @ K.T
        found[:, k] = math.sqrt(P[task.output, task.output]), float(numpy.linalg.norm(w @ K))
    return found


def _covariance_curves(task: UavAutopilot, steps: int) -> dict[str, numpy.ndarray]:
    """Recursion (12) of plant U where its correcting term bounds the covariance and where it does not."""
    names = [c.name for c in task.components]
    H = numpy.eye(len(names))
    rate, elevator = names.index("rate"), names.index("elevator")
    R = numpy.diag(numpy.square(task.parameters.value("sensor_sigmas")[1:]))
    return {
        "with the correcting term": _covariances(task, steps),
        "without it (no measurement)": _covariances(task, steps, H=H[:0]),
        "no sensor of pitch: not detectable": _covariances(task, steps, H=H[[rate, elevator]], R=R),
        "gusts the only noise": _covariances(task, steps, Q=task.design.model.scaled_noise),
    }


# --- figures


def _figure(rows: int, columns: int, size: tuple[float, float]) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _tidy(figure: Any) -> None:
    for axis in figure.axes:
        axis.grid(alpha=0.25, lw=0.4, which="both")
        axis.margins(x=0.01)


def _draw_filter(noise: Signals, step: Signals) -> Any:
    T = noise.task.parameters.value("sampling_interval")
    figure, axes = _figure(2, 1, (8.0, 6.0))
    times = slice(160, 320)
    t = numpy.arange(1, HORIZON + 1)[times] * T
    for axis, signals, title in (
        (axes[0, 0], noise, "input: white noise"),
        (axes[1, 0], step, "input: unit step and white noise"),
    ):
        axis.plot(t, signals.observation[0, times], color=COLOURS[5], lw=0.9, label="A: observation (node 2)")
        axis.plot(t, signals.estimate[0, times], color=COLOURS[0], lw=1.8, label="B: estimate (node 3)")
        axis.plot(t, signals.output[0, times], color=COLOURS[6], lw=1.0, ls="--", label="true position")
        axis.set_title(title, loc="left", fontsize=9)
        axis.set_ylabel("position, m")
    axes[1, 0].axvline(STEP_TIME * T, color="0.5", lw=0.8, ls=":")
    axes[1, 0].set_xlabel("time, s")
    _tidy(figure)
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3, fontsize=8, frameon=False
    )
    return figure


def _draw_node(name: str, unit: str, title: str, noise: Signals, step: Signals) -> Any:
    T = noise.task.parameters.value("sampling_interval")
    figure, axes = _figure(2, 2, (9.0, 5.6))
    times = slice(160, 320)
    t = numpy.arange(1, HORIZON + 1)[times] * T
    for column, (signals, label) in enumerate(((noise, "white noise"), (step, "unit step and white noise"))):
        values = getattr(signals, name)
        axes[0, column].plot(t, values[0, times], color=COLOURS[0], lw=1.0)
        axes[0, column].set_title(f"input: {label}", loc="left", fontsize=9)
        axes[0, column].set_xlabel("time, s")
        # Without its last value, the one of node 1 that has no successor.
        frequency, power = _spectrum(values[:, STEP_TIME : HORIZON - 2], T)
        axes[1, column].plot(frequency, power, color=COLOURS[0], lw=1.4, label=f"{len(values)} runs")
        fine = numpy.linspace(frequency[1], frequency[-1], 300)
        theory = _theory_spectra(signals.task, fine)[name]
        axes[1, column].plot(fine, theory, color=COLOURS[1], lw=1.2, ls="--", label="theory, noise alone")
        axes[1, column].set_xlabel("frequency, Hz")
        if name == "innovation":
            axes[1, column].set_ylim(0.0, 1.5 * float(theory[0]))
        else:
            axes[1, column].set_yscale("log")
    axes[1, 1].sharey(axes[1, 0])
    axes[0, 1].sharey(axes[0, 0])
    squared = f"({unit})²" if "/" in unit else f"{unit}²"
    axes[0, 0].set_ylabel(f"signal, {unit}")
    axes[1, 0].set_ylabel(f"energy spectrum, {squared}/Hz")
    axes[1, 1].legend(fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    _tidy(figure)
    return figure


def _draw_pitch_spectra(signals: Signals) -> Any:
    figure, axes = _figure(1, 1, (8.0, 3.8))
    axis, T = axes[0, 0], signals.task.parameters.value("sampling_interval")
    nodes = (
        ("observation", "node 2, observation", 5),
        ("estimate", "node 3, estimate", 0),
        ("innovation", "node 4, innovation", 2),
    )
    for name, label, colour in nodes:
        frequency, power = _spectrum(getattr(signals, name)[:, SETTLED], T)
        axis.loglog(frequency[1:], power[1:], color=COLOURS[colour], lw=1.6, label=label)
        fine = numpy.geomspace(frequency[1], frequency[-1], 300)
        axis.loglog(fine, _theory_spectra(signals.task, fine)[name], color="k", lw=0.9, ls="--")
    axis.plot([], [], color="k", lw=0.9, ls="--", label="theory")
    axis.set_xlabel("frequency, Hz")
    axis.set_ylabel("energy spectrum of pitch, deg²/Hz")
    axis.legend(fontsize=8, frameon=False)
    _tidy(figure)
    return figure


def _draw_mistuning(tasks: dict[str, UavAutopilot]) -> Any:
    figure, axes = _figure(1, len(tasks), (9.0, 3.8))
    for axis, (title, task) in zip(axes[0], tasks.items(), strict=True):
        scales = numpy.geomspace(1e-3, 1e3, 61)
        theory = [loop_theory(task, s) for s in scales]
        unit = {"P": "m", "U": "deg"}[task.parameters.plant]
        for i, (label, colour, style) in enumerate(
            (
                ("cost of the loop", COLOURS[6], "-"),
                (f"output variance, {unit}²", COLOURS[0], "--"),
                (
                    "control variance, " + {"P": "(m/s²)²", "U": "deg²"}[task.parameters.plant],
                    COLOURS[1],
                    "-.",
                ),
            )
        ):
            axis.loglog(scales, [t[i] for t in theory], color=colour, ls=style, lw=1.6, label=label)
        raw = stationary(task, "raw-sensors")
        best = stationary(task, "true-state")
        assert raw is not None
        assert best is not None
        for value, name in ((raw.cost, "raw sensors"), (best.cost, "true state")):
            axis.axhline(value * task.cost_unit, color="0.5", lw=0.8, ls=":")
            axis.text(
                1e3, value * task.cost_unit, f"cost with {name}", fontsize=7, ha="right", va="center",
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
            )  # fmt: skip
        axis.axvline(1.0, color="0.7", lw=0.8)
        axis.set_title(title, loc="left", fontsize=9)
        axis.set_xlabel("factor on the process noise that the filter believes")
        axis.legend(fontsize=7, frameon=False, loc="upper center")
        axis.set_ylim(top=axis.get_ylim()[1] * 6)
    axes[0, 0].set_ylabel("stationary value, by the Lyapunov equation")
    _tidy(figure)
    return figure


def loop_theory(task: UavAutopilot, scale: float) -> tuple[float, float, float]:
    """Cost (in the units of the weights), output and control variance with process noise times ``scale``."""
    d = task.design
    F, B, H, L, R = d.model.F, d.model.B, d.H, d.feedback, d.R
    Q, n = d.model.scaled_noise + d.model.other_noise, len(d.model.F)
    K = linear_systems.steady_kalman(F, H, scale * Q, R).gain
    X = linear_systems.stationary_covariance(*linear_systems.estimate_feedback_loop(F, B, H, L, K, Q, R))
    row = numpy.hstack([L, -L])
    control = float((row @ X @ row.T)[0, 0])
    cost = float(numpy.trace(d.weight @ X[:n, :n])) + d.control_weight * control
    return cost, float(X[task.output, task.output]), control


def _draw_covariance(curves: dict[str, numpy.ndarray], T: float) -> Any:
    figure, axes = _figure(1, 2, (9.0, 3.8))
    for (label, values), colour, style in zip(
        curves.items(), (COLOURS[0], COLOURS[1], COLOURS[3], COLOURS[2]), ("-", "--", ":", "-."), strict=True
    ):
        t = numpy.arange(1, values.shape[1] + 1) * T
        axes[0, 0].loglog(t, values[0], color=colour, ls=style, lw=1.6, label=label)
        if values[1].any():
            axes[0, 1].loglog(t, values[1], color=colour, ls=style, lw=1.6, label=label)
    axes[0, 0].set_ylabel("sigma of the pitch estimate, deg")
    axes[0, 1].set_ylabel("size of the gain on the pitch integrator")
    for axis in axes[0]:
        axis.set_xlabel("time, s")
    _tidy(figure)
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=2,
        fontsize=8,
        frameon=False,
    )
    return figure


# --- everything together


def reproduce(progress: Progress = lambda done: None, episodes: int | None = None) -> Reproduction:
    """Run the experiments and judge the claims.

    Args:
        progress: told of measurements done; ``STEPS`` of them by default.
        episodes: Monte Carlo runs.

    Raises:
        ValueError: for fewer than two episodes, which have no interval.
    """
    M = episode_count(episodes, EPISODES)
    unit_of_progress = EPISODES / M
    done = 0.0

    def tick(measurements: int) -> None:
        nonlocal done
        before, done = int(done), done + measurements * unit_of_progress
        progress(int(done) - before)

    noise: dict[str, dict[str, Signals]] = {}
    step: dict[str, Signals] = {}
    for case, keywords in _CASES.items():
        loops = [loop for loop in _LOOPS if not (case == "P, H = [1 0]" and loop == "raw-sensors")]
        noise[case] = {loop: _run(keywords, "paper-noise", loop, M, tick) for loop in loops}
        step[case] = _run(keywords, "paper-step", "kalman", M, tick)
    responses = {}
    for case in _CASES:
        # Linear loop, same noise: the difference of the runs is the response without noise, exactly.
        responses[case] = (step[case].output - noise[case]["kalman"].output).mean(axis=0)[STEP_TIME - 1 :]
    table = _variance_table(noise)
    quantities = _quantity_table(noise, step, responses)
    random = {
        plant: evaluate("UavAutopilot", ["kalman", "matched"], "random", M, progress=tick, plant=plant)
        for plant in "PU"
    }
    P, U = noise["P, H = I"]["kalman"], noise["U"]["kalman"]
    curves = _covariance_curves(U.task, TWO_MINUTES)
    figures, captions = _figures(P, step["P, H = I"], U, curves)
    claims = _claims(noise, step, responses, random, curves, M)
    return Reproduction(TITLE, claims, (table, quantities), figures, captions)


def _variance_table(noise: dict[str, dict[str, Signals]]) -> Grid:
    rows: list[tuple[str, ...]] = []
    for case, loops in noise.items():
        for loop, s in loops.items():
            theory = stationary(s.task, loop)
            assert theory is not None
            rows.append(
                (
                    case,
                    loop,
                    f"{theory.output_variance:.5f}",
                    _measured(s.output[:, SETTLED] ** 2, 5),
                    f"{theory.control_variance:.5f}",
                    _measured(s.control[:, SETTLED] ** 2, 5),
                    f"{theory.cost * s.task.cost_unit:.4f}",
                    _measured(s.cost[:, SETTLED]),
                )
            )
    d = noise["P, H = [1 0]"]["kalman"].task.design
    raw = linear_systems.measurement_feedback_loop(
        d.model.F, d.model.B, d.H, d.feedback, d.model.scaled_noise, d.R
    )
    radius = linear_systems.spectral_radius(raw.transition)
    rows.append(("P, H = [1 0]", "raw-sensors", f"unstable, spectral radius {radius:.4f}", *["-"] * 5))
    return Grid(
        "Variances of the loop with white-noise input, theory (Lyapunov equation) and Monte Carlo ± one "
        "standard error, after a burn-in of 200 measurements",
        ("case", "fed back", "output", "measured", "control", "measured", "cost", "measured"),
        rows,
    )


def _response(y: numpy.ndarray, T: float) -> tuple[float, float, float]:
    """Overshoot, time to 90 % and time to stay within 5 %, s."""
    outside = numpy.flatnonzero(numpy.abs(y - 1.0) > 0.05)
    return max(float(y.max()) - 1.0, 0.0), float(numpy.argmax(y >= 0.9)) * T, float(outside[-1] + 1) * T


def _quantity_table(
    noise: dict[str, dict[str, Signals]], step: dict[str, Signals], responses: dict[str, numpy.ndarray]
) -> Grid:
    rows: list[list[str]] = [
        [name]
        for name in (
            "noise variance, node 2 to node 3",
            "NEES per coordinate",
            "NIS per reading",
            "node 4 rms (theory)",
            "spectral flatness, node 4 / node 2",
            "step: overshoot, time to 90 %, settling to 5 %",
            "mean output after a unit step in noise",
        )
    ]
    for case in _CASES:
        s = noise[case]["kalman"]
        d, shown = s.task.design, s.task.measured.index(s.task.output)
        S = d.H @ d.steady.predicted @ d.H.T + d.R
        before = numpy.mean((s.observation - s.output)[:, SETTLED] ** 2)
        after = numpy.mean((s.estimate - s.output)[:, SETTLED] ** 2)
        over, rise, settling = _response(responses[case], s.task.parameters.value("sampling_interval"))
        rms = math.sqrt(numpy.mean(s.innovation[:, SETTLED] ** 2))
        cells = (
            f"{before:.4g} to {after:.4g} ({_decibel(s):.1f} dB)",
            _measured(s.nees[:, SETTLED], 3),
            _measured(s.nis[:, SETTLED], 3),
            f"{rms:.4f} ({math.sqrt(S[shown, shown]):.4f})",
            f"{_flatness(s.innovation[:, SETTLED]):.3f} / {_flatness(s.observation[:, SETTLED]):.3f}",
            f"{100 * over:.2f} %, {rise:.2f} s, {settling:.2f} s",
            _measured(step[case].output[:, AFTER_STEP], 3),
        )
        for row, cell in zip(rows, cells, strict=True):
            row.append(cell)
    return Grid("Filter and response", ("quantity", *_CASES), rows)


def _figures(
    P: Signals, P_step: Signals, U: Signals, curves: dict[str, numpy.ndarray]
) -> tuple[dict[str, Any], dict[str, str]]:
    T = U.task.parameters.value("sampling_interval")
    figures = {"figure_3_filter": _draw_filter(P, P_step)}
    captions = {
        "figure_3_filter": "Plant P: signal at the input (A) and the output (B) of the filter, one run; "
        "the dotted line is the step of the command.",
        "plant_u_spectra": "Plant U: spectra of pitch at nodes 2 to 4, white-noise input; leakage as above.",
        "mistuning": "What a wrong process noise in the filter costs the loop.",
        "covariance": "Where the correcting term of (5) bounds the covariance of plant U, and where it "
        "does not (left; with all sensors the two curves coincide), and where the gain goes to sleep "
        "(right).",
    }
    for name, unit, title, number in (
        ("plant_input", "m/s²", "node 1, plant input: control and white noise", "4_node_1"),
        ("observation", "m", "node 2, observation of position", "4_node_2"),
        ("estimate", "m", "node 3, estimate of position", "5_node_3"),
        ("innovation", "m", "node 4, innovation", "6_node_4"),
    ):
        key = f"figure_{number}"
        figures[key] = _draw_node(name, unit, f"Plant P, {title}", P, P_step)
        captions[key] = (
            f"Plant P, {title}: one run above, energy spectrum of the settled loop (left) and from the step "
            "on (right) below. What lies above theory at either end is leakage of the rectangular "
            "window."
        )
    figures["plant_u_spectra"] = _draw_pitch_spectra(U)
    figures["mistuning"] = _draw_mistuning({"plant P": P.task, "plant U": U.task})
    figures["covariance"] = _draw_covariance(curves, T)
    return figures, captions


def _claims(
    noise: dict[str, dict[str, Signals]],
    step: dict[str, Signals],
    responses: dict[str, numpy.ndarray],
    random: dict[str, Any],
    curves: dict[str, numpy.ndarray],
    M: int,
) -> list[Claim]:
    P, U = noise["P, H = I"]["kalman"], noise["U"]["kalman"]
    defects = {}
    for case, loops in noise.items():
        d = loops["kalman"].task.design
        defects[case] = linear_systems.separation_defect(d.model.F, d.model.B, d.H, d.feedback, d.steady.gain)
    settled, alone, blind, gusts = curves.values()
    theory = {plant: [loop_theory(s.task, scale) for scale in SCALES] for plant, s in (("P", P), ("U", U))}
    excess = {}
    for plant, dataset in random.items():
        cost = dataset["cost"].mean("time")
        ours, best = cost.sel(policy="kalman").values, cost.sel(policy="matched").values
        nees = dataset["nees"].sel(policy="kalman").values.mean() / dataset.sizes["component"]
        ratio = ours.mean() / best.mean() - 1.0
        error = (ours - (1.0 + ratio) * best).std(ddof=1) / math.sqrt(len(ours)) / best.mean()
        excess[plant] = f"{plant}: {100 * ratio:.0f} ± {100 * error:.0f} %, NEES {nees:.1f} per coordinate"
    flat = {case: f"{_flatness(loops['kalman'].innovation[:, SETTLED]):.3f}" for case, loops in noise.items()}
    percent = [f"{100 * (t[0] / theory['P'][1][0] - 1):.0f} %" for t in theory["P"]]
    percent_u = [f"{100 * (t[0] / theory['U'][1][0] - 1):.0f} %" for t in theory["U"]]
    raw_p, raw_u = noise["P, H = I"]["raw-sensors"], noise["U"]["raw-sensors"]
    return [
        Claim(
            "1",
            "The model works correctly even with strongly noisy signals.",
            f"P: noise 0 dB at node 2 is {_decibel(P):.1f} dB weaker at node 3 (U: {_decibel(U):.1f} dB). "
            f"Mean output after a unit step: P {_measured(step['P, H = I'].output[:, AFTER_STEP], 3)}, U "
            f"{_measured(step['U'].output[:, AFTER_STEP], 3)}. NEES per coordinate "
            f"{_measured(P.nees[:, SETTLED], 3)} and {_measured(U.nees[:, SETTLED], 3)}.",
            f"{M} runs of {HORIZON} measurements, burn-in 200 (300 after the step); ± one standard error",
            "reproduced",
        ),
        Claim(
            "2",
            "If A - BL is asymptotically stable, the loop with the filter is too (separation).",
            "largest distance of a pole of the loop from the union of the separate designs: "
            + ", ".join(f"{case}: {value:.0e}" for case, value in defects.items()),
            "eigenvalues of the loop written in state and estimate, matched with those of F - BL and (I - "
            "KH)F",
            "reproduced",
        ),
        Claim(
            "3",
            "The correcting term of the Riccati equation limits the growth of the covariance.",
            f"U, sigma of pitch in 2 min: {settled[0, -1]:.3f} deg with all sensors, {alone[0, -1]:.1f} deg "
            f"without measurements; but {blind[0, -1]:.1f} deg, growing, when no sensor detects pitch. With "
            "gusts as the only noise the covariance stays bounded, but the gain on the pitch integrator, "
            f"which gusts do not reach, falls as 1/t and the filter goes to sleep: {gusts[1, 599]:.1e} after "
            f"12 s, {gusts[1, -1]:.1e} after 2 min.",
            "recursion (12); the condition is detectability, and for a steady filter that is stable also "
            "noise on every integrating mode",
            "reproduced in part",
        ),
        Claim(
            "4",
            "The model serves to study white and coloured noise, stability, convergence of the filter.",
            "node 4 is white: spectral flatness " + ", ".join(f"{c} {v}" for c, v in flat.items()) + "; the "
            "spectra of all nodes follow the transfer functions of the loop (figures)",
            "periodograms averaged over runs; flatness of an average over M runs of white noise is about "
            f"1 - 1/(2M) = {1 - 0.5 / M:.4f}",
            "reproduced",
        ),
        Claim(
            "5",
            "Command: equations (6), (10) print none.",
            f"taken literally a unit command settles at {_without_command_in_prediction(P.task):.3f} (P) "
            f"and {_without_command_in_prediction(U.task):.3f} (U) in place of 1; with the command in the "
            f"prediction overshoot and settling are {100 * _response(responses['P, H = I'], 0.25)[0]:.2f} "
            f"%, {_response(responses['P, H = I'], 0.25)[2]:.2f} s (P), "
            f"{100 * _response(responses['U'], 0.02)[0]:.2f} %, {_response(responses['U'], 0.02)[2]:.2f} s "
            "(U)",
            "fixed point of the loop; response as difference of runs with and without step on the same noise",
            "paper is silent",
        ),
        Claim(
            "6",
            "What is the filter worth to the loop?",
            f"cost with raw sensors over cost with the filter: P {_ratio(raw_p, P)}, U {_ratio(raw_u, U)}. "
            "The output itself gains less: its variance is "
            f"{numpy.mean(raw_p.output[:, SETTLED] ** 2) / numpy.mean(P.output[:, SETTLED] ** 2):.2f} (P) "
            f"and {numpy.mean(raw_u.output[:, SETTLED] ** 2) / numpy.mean(U.output[:, SETTLED] ** 2):.2f} "
            "(U) times as large without it. With position alone and no filter the loop is unstable (P).",
            f"{M} runs, same noise",
            "paper is silent",
        ),
        Claim(
            "7",
            "How wrong may the filter's process noise be?",
            f"cost of the loop above the optimum with Q times 0.01 / 100: P {percent[0]} / {percent[2]}, U "
            f"{percent_u[0]} / {percent_u[2]}. Smallest cost is not smallest output variance: U with Q "
            f"times 100 has {theory['U'][2][1]:.4f} deg² against {theory['U'][1][1]:.4f}, for "
            f"{theory['U'][2][2] / theory['U'][1][2]:.1f} times the control variance.",
            "Lyapunov equation of the loop with the mistuned steady filter",
            "paper is silent",
        ),
        Claim(
            "8",
            "What happens when the noise is not constant and not known, as the paper assumes?",
            "cost of the paper's filter above that of the filter told the noise: "
            + "; ".join(excess.values()),
            f"scenario random, {M} episodes, same noise; a consistent filter has NEES 1 per coordinate",
            "paper is silent",
        ),
    ]


def _ratio(one: Signals, other: Signals) -> str:
    return f"{one.cost[:, SETTLED].mean() / other.cost[:, SETTLED].mean():.1f}"
