"""Kalman-Bucy filters in orientation and navigation (Benkafo, Lobaty): figures 2, 4 and 5, and the claims.

The paper prints no numbers ("hypothetical conditions") and curves without ordinates. The examples below are
ours, chosen so that its figures look as described: (a) a first-order process, which the filter follows
although the reference goes elsewhere; (b) fusion of INS and GNSS, scenario ``paper`` of the environment.

Reading: "the systematic errors are compensated" is tested twice, as attenuation (smaller than in the INS) and
as removal (no mean error left).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...envs.catalogue import make_task
from ...envs.loosely_coupled_navigation.task import LooselyCoupledNavigation
from ...envs.task import Episode
from ...filters import kalman_bucy
from ...filters import loosely_coupled as ins_gnss
from ...filters.linear_systems import steady_kalman_bucy, van_loan
from ..bootstrap import Bootstrap, Estimate
from ..evaluation import evaluate, load_policy
from ..figures import styles
from ..reproduction import Claim, Grid, Reproduction, episode_count
from ..rollout import run_policy
from ..seeds import episode_seeds

TITLE = "Kalman-Bucy filters in orientation and navigation complexes: what they follow, and INS/GNSS fusion"
ENV = LooselyCoupledNavigation.id
EPISODES = 4000
SEED = 0
LATE = (250, 500)
"""Measurements of the second half of a run, 2.5 to 5 s."""

# Example (a); all ours.
A, U, INTENSITY, RECEIVER = -0.5, 1.0, 1.0, 0.01
"""1/s, unit/s, unit^2/s, unit^2 s."""
STEP, STEPS_A = 0.005, 1000

TABLE = (
    "ins-only", "gnss-only", "plain-white", "time-varying-white", "plain-reduced", "time-varying", "best-constant",
    "augmented-gain", "augmented", "matched",
)  # fmt: skip
NAMES = {
    "ins-only": "INS alone",
    "gnss-only": "GNSS alone",
    "plain-white": "plain, Ge = 0.04, settled gain",
    "time-varying-white": "plain, Ge = 0.04, Riccati gain",
    "plain-reduced": "plain, Ge = 0.36, settled gain",
    "time-varying": "plain, Ge = 0.36, Riccati gain",
    "best-constant": "plain, best constant gain",
    "augmented-gain": "plain, gain steered by an augmented filter",
    "augmented": "augmented",
    "matched": "augmented, told the noise levels (reference)",
}
DRIFTING = ("plain-white", "plain-reduced", "best-constant", "augmented")
DRIFT = 1.0
"""Constant rate error of the example run and of the attenuation experiment, m/s."""
LONG = 2000
"""Measurements of the attenuation experiment: 20 s, so that the prior of the drift is forgotten."""
STEPS = 1 + len(TABLE) + len(DRIFTING) + 1


def text(estimate: Estimate, digits: int = 4) -> str:
    """Value and interval: ``0.3053 [0.3044, 0.3062]``."""
    return f"{estimate.value:.{digits}f} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


# --- example (a)


class FirstOrder(NamedTuple):
    """Runs of example (a)."""

    time: numpy.ndarray
    path: Mapping[str, numpy.ndarray]
    """Reference, process and estimate of the first run, ``(steps,)``."""
    squares: Mapping[str, numpy.ndarray]
    """Late mean of each squared difference and of the product of the orthogonality identity, ``(runs,)``."""
    theory: Mapping[str, float]
    """Exact late means of the same, for the sampled filter."""
    sampled: kalman_bucy.SampledCovariance


def first_order(runs: int) -> FirstOrder:
    """Simulate process, measurement and filter of example (a)."""
    rng = numpy.random.default_rng(SEED)
    phi, qd = (float(x[0, 0]) for x in van_loan(A, INTENSITY, STEP))
    push = U * (phi - 1.0) / A
    R = RECEIVER / STEP
    sampled = kalman_bucy.sampled_covariance(A, INTENSITY, 1, RECEIVER, 0, STEP, STEPS_A * STEP)
    X, estimate, reference = numpy.zeros(runs), numpy.zeros(runs), 0.0
    path: dict[str, list[float]] = {"reference": [], "process": [], "estimate": []}
    half = STEPS_A // 2
    sums = {name: numpy.zeros(runs) for name in ("process", "reference", "departure", "product")}
    for k in range(STEPS_A):
        X = phi * X + push + math.sqrt(qd) * rng.standard_normal(runs)
        reference = phi * reference + push
        predicted = phi * estimate + push
        innovation = X + math.sqrt(R) * rng.standard_normal(runs) - predicted
        estimate = predicted + sampled.gain[k, 0, 0] * innovation
        for name, value in (("reference", reference), ("process", X[0]), ("estimate", estimate[0])):
            path[name].append(float(value))
        if k >= half:
            sums["process"] += (estimate - X) ** 2
            sums["reference"] += (estimate - reference) ** 2
            sums["departure"] += (X - reference) ** 2
            sums["product"] += (X - estimate) * (estimate - reference)
    time = STEP * numpy.arange(1, STEPS_A + 1)
    theta = kalman_bucy.moments(A, U, INTENSITY, 0, 0, time[half:]).covariance[:, 0, 0]
    P = sampled.updated[half:, 0, 0]
    theory = {
        "process": float(P.mean()),
        "reference": float((theta - P).mean()),
        "departure": float(theta.mean()),
        "product": 0.0,
    }
    return FirstOrder(
        time,
        {name: numpy.array(values) for name, values in path.items()},
        {name: total / half for name, total in sums.items()},
        theory,
        sampled,
    )


# --- example (b)


def late_mean_squares(policies: Sequence[str], episodes: int, tick: Callable[[], None]) -> dict[str, Any]:
    """Mean squared error from 2.5 to 5 s of every policy on ``paper``, per episode, on common noise."""
    found = {}
    for name in policies:
        dataset = evaluate(ENV, [name], "paper", episodes, SEED)
        error = dataset["error"].values[0, :, LATE[0] - 1 : LATE[1], 0]
        found[name] = (error**2).mean(axis=1)
        tick()
    return found


def mean_error_over_time(name: str, episodes: int) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Mean of the error over the episodes with the drift ``DRIFT``, and its standard error, ``(LONG,)``."""
    # A policy is tuned to the model; the drift of this experiment is one value of that model's prior.
    error = evaluate(ENV, [name], "paper", episodes, SEED, fixed_drift=DRIFT, horizon=LONG)["error"]
    values = error.values[0, :, :, 0]
    return values.mean(axis=0), values.std(axis=0) / math.sqrt(len(values))


class Run(NamedTuple):
    """One run of example (b), ``(500,)`` each, m."""

    reference: numpy.ndarray
    ins: numpy.ndarray
    measurement: numpy.ndarray
    estimate: numpy.ndarray


def example_run(name: str) -> Run:
    """Fly one episode with the drift ``DRIFT``."""
    maker = load_policy(ENV, name)
    task: Any = make_task(ENV, maker.control, "paper", fixed_drift=DRIFT)
    rows: list[list[float]] = []

    def record(state: Episode) -> None:
        said = state.measurement
        rows.append([float(x[0, 0]) for x in (state.truth.reference, said.ins, said.fix, task.mean(state))])

    run_policy(task, maker(task), episode_seeds("test", SEED, 1), record, lambda _: None)
    return Run(*numpy.array(rows).T)


def exact_plain(intensity: float, riccati: bool) -> float:
    """Exact root mean square error from 2.5 to 5 s of the plain scheme, m."""
    p = LooselyCoupledNavigation.Parameters()
    T = p.sampling_interval
    dynamics, growth, start = ins_gnss.error_model(p.drift, p.coloured, p.correlation_time, p.white_intensity)
    Phi, Qd = van_loan(dynamics, growth, T)
    R, settled = p.receiver_variance, ins_gnss.settled_gain(intensity * T, p.receiver_variance)
    variance, P, squares = 0.0, start, []
    for _ in range(p.horizon):
        variance += intensity * T
        gain = variance / (variance + R) if riccati else settled
        variance *= 1.0 - gain
        rest = numpy.eye(3) - gain * numpy.diag([1.0, 0.0, 0.0])
        P = rest @ (Phi @ P @ Phi.T + Qd) @ rest.T + numpy.diag([R * gain**2, 0.0, 0.0])
        squares.append(P[0, 0])
    return math.sqrt(numpy.mean(squares[LATE[0] - 1 : LATE[1]]))


def exact_root_mean_squares() -> dict[str, float]:
    """Exact root mean square error from 2.5 to 5 s, m, of every policy in ``TABLE`` that has a theory."""
    p = LooselyCoupledNavigation.Parameters()
    T = p.sampling_interval
    levels = (p.drift, p.coloured, p.correlation_time, p.white_intensity)
    dynamics, growth, start = ins_gnss.error_model(*levels)
    model = (dynamics, growth, [[1.0, 0.0, 0.0]], [[p.receiver_intensity]], start, T, p.horizon * T)
    late = slice(LATE[0] - 1, LATE[1])

    def root(gain: list[float] | None) -> float:
        return math.sqrt(kalman_bucy.sampled_covariance(*model, gain=gain).updated[late, 0, 0].mean())

    white, reduced = p.equivalent_intensities
    best = ins_gnss.best_constant_gain(*levels, p.receiver_intensity) ** 2 * p.receiver_intensity
    return {
        "ins-only": root([0.0, 0.0, 0.0]),
        "gnss-only": root([1.0, 0.0, 0.0]),
        "plain-white": exact_plain(white, False),
        "time-varying-white": exact_plain(white, True),
        "plain-reduced": exact_plain(reduced, False),
        "time-varying": exact_plain(reduced, True),
        "best-constant": exact_plain(best, False),
        "augmented": root(None),
        "matched": root(None),
    }


# --- the Riccati equation


class Agreement(NamedTuple):
    """Largest relative differences between solutions of (5)."""

    hamiltonian: float
    """Exponential of the Hamiltonian matrix against the closed form, example (a)."""
    ode: float
    """Numerical integration against the closed form."""
    matrix: float
    """Exponential against integration, the augmented model."""
    order: float
    """Order at which the sampled filter approaches (5), from halving the step."""
    refusal: str
    """What asking for the steady augmented filter answers."""


def riccati_agreement() -> Agreement:
    """Solve (5) three ways."""
    times = numpy.linspace(0.01, 5.0, 50)
    closed = kalman_bucy.riccati_scalar(A, INTENSITY, 1.0 / RECEIVER, 0.0, times)
    scalar = (A, INTENSITY, 1.0, RECEIVER, 0.0, times)
    p = LooselyCoupledNavigation.Parameters()
    dynamics, growth, start = ins_gnss.error_model(p.drift, p.coloured, p.correlation_time, p.white_intensity)
    C, Q = [[1.0, 0.0, 0.0]], [[p.receiver_intensity]]
    pair = [
        solve(dynamics, growth, C, Q, start, times)
        for solve in (kalman_bucy.riccati_hamiltonian, kalman_bucy.riccati_ode)
    ]
    offsets = []
    for step in (0.01, 0.005):
        updated = kalman_bucy.sampled_covariance(A, INTENSITY, 1, RECEIVER, 0, step, 1.0).updated[-1, 0, 0]
        exact = kalman_bucy.riccati_scalar(A, INTENSITY, 1.0 / RECEIVER, 0.0, [1.0])[0]
        offsets.append(abs(updated / exact - 1.0))
    try:
        steady_kalman_bucy(dynamics, C, growth, Q)
        refusal = "no refusal"
    except ValueError as error:
        refusal = str(error)
    return Agreement(
        float(numpy.abs(kalman_bucy.riccati_hamiltonian(*scalar)[:, 0, 0] / closed - 1.0).max()),
        float(numpy.abs(kalman_bucy.riccati_ode(*scalar)[:, 0, 0] / closed - 1.0).max()),
        float(numpy.abs(pair[0] - pair[1]).max() / numpy.abs(pair[0]).max()),
        math.log2(offsets[0] / offsets[1]),
        refusal,
    )


# --- figures


def _figure(rows: int = 1) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.6 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, 1, squeeze=False)[:, 0]


def _finish(axis: Any, ylabel: str) -> None:
    axis.set_xlabel("time, s")
    axis.set_ylabel(ylabel)
    axis.grid(alpha=0.25, lw=0.4)
    axis.margins(x=0.01)
    axis.legend(fontsize=8, frameon=False, loc="best")


def figure_2(example: FirstOrder) -> Any:
    """Reference, process and estimate of one run, and root mean square differences over time."""
    figure, axes = _figure(2)
    labels = {"reference": "reference $X_r$", "process": "process $X$", "estimate": r"estimate $\hat X$"}
    for name, style in styles(list(labels)).items():
        axes[0].plot(example.time, example.path[name], label=labels[name], **style)
    _finish(axes[0], "value, unit")
    theta = kalman_bucy.moments(A, U, INTENSITY, 0, 0, example.time).covariance[:, 0, 0]
    R = kalman_bucy.riccati_scalar(A, INTENSITY, 1.0 / RECEIVER, 0.0, example.time)
    curves = {
        r"$X - X_r$: $\sqrt{\Theta}$": theta,
        r"$\hat X - X_r$: $\sqrt{\Theta - R}$": theta - R,
        r"$\hat X - X$: $\sqrt{R}$": R,
    }
    for name, style in styles(list(curves)).items():
        axes[1].plot(example.time, numpy.sqrt(curves[name]), label=name, **style)
    _finish(axes[1], "standard deviation, unit")
    return figure


def figure_4(run: Run, time: numpy.ndarray) -> Any:
    """What the instruments say."""
    figure, axes = _figure()
    style = styles(["Z", "X", "reference"])
    axes[0].plot(time, run.measurement, label="GNSS $Z$", **(style["Z"] | {"linewidth": 0.5, "alpha": 0.6}))
    axes[0].plot(time, run.ins, label="INS $X$", **style["X"])
    axes[0].plot(time, run.reference, label="reference $X_r$", **(style["reference"] | {"color": "#000000"}))
    _finish(axes[0], "position, m")
    return figure


def figure_5(runs: Mapping[str, Run], time: numpy.ndarray) -> Any:
    """Estimates of the same run, and their errors."""
    figure, axes = _figure(2)
    reference = next(iter(runs.values())).reference
    axes[0].plot(time, reference, color="#000000", linewidth=2.2, label="reference $X_r$")
    for name, style in styles(list(runs)).items():
        axes[0].plot(time, runs[name].estimate, label=NAMES[name], **style)
        axes[1].plot(time, runs[name].estimate - reference, label=NAMES[name], **style)
    axes[1].axhline(0.0, color="0.3", lw=0.8)
    _finish(axes[0], "position, m")
    _finish(axes[1], "error of the estimate, m")
    return figure


def figure_drift(
    means: Mapping[str, tuple[numpy.ndarray, numpy.ndarray]], gains: Mapping[str, float], time: numpy.ndarray
) -> Any:
    """Mean error with a constant rate error: attenuated by the plain scheme, removed by the augmented one."""
    figure, axes = _figure()
    for name, style in styles(list(means)).items():
        mean, deviation = means[name]
        axes[0].plot(time, mean, label=NAMES[name], **style)
        band = (mean - 1.96 * deviation, mean + 1.96 * deviation)
        axes[0].fill_between(time, *band, color=style["color"], alpha=0.2, lw=0)
        if name in gains:
            axes[0].axhline(DRIFT / gains[name], color=style["color"], lw=0.8, ls=":")
    axes[0].axhline(0.0, color="0.3", lw=0.8)
    _finish(axes[0], f"mean error with a drift of {DRIFT:g} m/s, m")
    return figure


# --- claims


def reproduce(progress: Callable[..., None], episodes: int | None = None) -> Reproduction:
    """Run the examples and judge the claims.

    Args:
        progress: called with the units of work done, ``STEPS`` in all.
        episodes: runs of every experiment; default 4000.

    Raises:
        ValueError: for fewer than two episodes, which have no interval.
    """
    runs = episode_count(episodes, EPISODES)
    bootstrap = Bootstrap(runs)
    example = first_order(runs)
    progress(1)
    squares = late_mean_squares(TABLE, runs, lambda: progress(1))
    theory = exact_root_mean_squares()
    drifting_runs = max(8, runs // 4)
    means = {}
    for name in DRIFTING:
        means[name] = mean_error_over_time(name, drifting_runs)
        progress(1)
    agreement = riccati_agreement()
    paths = {name: example_run(name) for name in ("plain-white", "plain-reduced", "augmented")}
    progress(1)

    p = LooselyCoupledNavigation.Parameters()
    white, reduced = (math.sqrt(Ge / p.receiver_intensity) for Ge in p.equivalent_intensities)
    best = ins_gnss.best_constant_gain(
        p.drift, p.coloured, p.correlation_time, p.white_intensity, p.receiver_intensity
    )
    gains = {"plain-white": white, "plain-reduced": reduced, "best-constant": best}
    a = {
        name: bootstrap.estimate(values, numpy.sqrt)
        for name, values in example.squares.items()
        if name != "product"
    }
    product = bootstrap.estimate(example.squares["product"])
    b = {name: bootstrap.estimate(values, numpy.sqrt) for name, values in squares.items()}

    def change(name: str, other: str) -> Estimate:
        """Relative change of the root mean square error, paired."""
        both = numpy.stack([squares[name], squares[other]], axis=1)
        return bootstrap.estimate(both, lambda m: 100.0 * (numpy.sqrt(m[:, 0] / m[:, 1]) - 1.0))

    def settled(name: str) -> str:
        mean, deviation = means[name]
        return f"{mean[-1]:.3f} ± {1.96 * deviation[-1]:.3f} m"

    method_a = f"{runs} runs of example (a), 2.5 to 5 s, bootstrap over runs"
    method_b = f"{runs} episodes of `paper`, common noise, 2.5 to 5 s, bootstrap over episodes"
    method_drift = (
        f"{drifting_runs} episodes of 20 s with a drift of {DRIFT:g} m/s, mean of the last measurement"
    )
    smoothing = bootstrap.estimate(
        numpy.stack([squares["gnss-only"], squares["plain-reduced"]], axis=1),
        lambda m: numpy.sqrt(m[:, 0] / m[:, 1]),
    )
    noise_share = (
        math.sqrt(reduced * p.receiver_intensity / 2.0),
        math.sqrt(p.white_intensity / (2.0 * reduced)),
    )
    riccati_loses = change("time-varying-white", "plain-white")

    follows = a["process"].high < a["reference"].low and product.low <= 0.0 <= product.high
    attenuated = b["plain-reduced"].high < min(b["ins-only"].low, b["gnss-only"].low)
    left = means["plain-reduced"][0][-1] > 4 * means["plain-reduced"][1][-1]
    claims = [
        Claim(
            "1",
            "The estimate follows the random process X and may depart strongly from the reference (Fig. 2).",
            f"RMS to the process {text(a['process'])} unit, to the reference {text(a['reference'])}; "
            f"process to reference {text(a['departure'])}. Orthogonality: mean product "
            f"{text(product)} (0 expected), so the departure is Theta - R: "
            f"{math.sqrt(example.theory['reference']):.4f} in theory",
            method_a,
            "reproduced" if follows else "not reproduced",
        ),
        Claim(
            "2",
            "In a digital complex the filter must be a discrete algorithm.",
            f"a sampled filter approaches the covariance (5) only at order {agreement.order:.2f} in the step: "
            f"at {STEP:g} s its RMS is {math.sqrt(example.theory['process']):.4f} after the update, "
            f"that of (5) is {math.sqrt(kalman_bucy.riccati_scalar(A, INTENSITY, 1 / RECEIVER, 0, [5.0])[0]):.4f}",
            "exact recursions; closed form of (5)",
            "reproduced" if 0.9 < agreement.order < 1.1 else "not reproduced",
        ),
        Claim(
            "3",
            "In fusion the estimate stays near the reference although the INS departs and GNSS is noisy: "
            "systematic INS errors are compensated (Figs. 4, 5).",
            f"RMS: INS {text(b['ins-only'], 3)} m, GNSS {text(b['gnss-only'], 3)} m, plain scheme "
            f"{text(b['plain-reduced'])} m. Of a drift of {DRIFT:g} m/s the plain scheme keeps "
            f"{settled('plain-white')} (Ge = 0.04; beta / K = {DRIFT / white:.3f}) or {settled('plain-reduced')} "
            f"(Ge = 0.36; {DRIFT / reduced:.3f}): attenuated, not removed. The augmented scheme keeps "
            f"{settled('augmented')}",
            f"{method_b}; {method_drift}",
            ("reproduced in part" if left else "reproduced") if attenuated else "not reproduced",
        ),
        Claim(
            "4",
            "The input noises are partly smoothed.",
            f"GNSS error over the error of the plain scheme: {text(smoothing, 2)}. Of the receiver's "
            f"{math.sqrt(p.receiver_variance):.2f} m a sample, {noise_share[0]:.3f} m are left; the white INS "
            f"noise, which alone would grow without limit, is held at {noise_share[1]:.3f} m",
            f"{method_b}; shares from (6)",
            "reproduced" if smoothing.low > 1.0 else "not reproduced",
        ),
        Claim(
            "5",
            "Which gain? The paper gives (4), (5) and no numbers.",
            f"white part only, K = {white:.2f} 1/s: {text(b['plain-white'])} m; coloured part reduced to white, "
            f"K = {reduced:.2f}: {text(b['plain-reduced'])} m; best constant, K = {best:.2f}: "
            f"{text(b['best-constant'])} m. The plain scheme's own covariance knows of no drift",
            method_b,
            "paper is silent",
        ),
        Claim(
            "6",
            "Is the time-varying gain of (5) better than its settled value?",
            f"not where the model leaves the drift out: with Ge = 0.04 the Riccati gain is "
            f"{text(riccati_loses, 2)} % worse ({text(b['time-varying-white'])} m), because it starts low while "
            f"the error already grows; with Ge = 0.36 the change is "
            f"{text(change('time-varying', 'plain-reduced'), 2)} %",
            f"{method_b}, paired",
            "paper is silent",
        ),
        Claim(
            "7",
            "How much does the paper's scheme lose to a filter that estimates the rate errors?",
            f"augmented: {text(b['augmented'])} m, {text(change('augmented', 'plain-reduced'), 1)} % against the "
            f"plain scheme; a gain steered by an augmented filter inside the policy: {text(b['augmented-gain'])} m",
            f"{method_b}, paired",
            "paper is silent",
        ),
        Claim(
            "8",
            "Does the augmented scheme have a steady state?",
            f"no: {agreement.refusal}",
            "condition on the algebraic Riccati equation",
            "paper is silent",
        ),
    ]
    rows_a = [
        (label, text(a[name]), f"{math.sqrt(example.theory[name]):.4f}")
        for name, label in (
            ("process", "estimate - process"),
            ("reference", "estimate - reference"),
            ("departure", "process - reference"),
        )
    ]
    rows_b = [
        (NAMES[name], f"`{name}`", text(b[name]), f"{theory[name]:.4f}" if name in theory else "-")
        for name in TABLE
    ]
    rows_riccati = [
        ("exponential of the Hamiltonian matrix / closed form, example (a)", f"{agreement.hamiltonian:.1e}"),
        ("numerical integration / closed form, example (a)", f"{agreement.ode:.1e}"),
        ("exponential / numerical integration, augmented model", f"{agreement.matrix:.1e}"),
    ]
    time = p.sampling_interval * numpy.arange(1, p.horizon + 1)
    return Reproduction(
        TITLE,
        claims,
        (
            Grid(
                "Example (a): root mean square, 2.5 to 5 s, unit", ("difference", "measured", "exact"), rows_a
            ),
            Grid(
                "Example (b): root mean square error of position, 2.5 to 5 s, m",
                ("algorithm", "policy", "measured", "exact"),
                rows_b,
            ),
            Grid(
                "The Riccati equation (5) three ways", ("pair", "largest relative difference"), rows_riccati
            ),
        ),
        {
            "figure_2": figure_2(example),
            "figure_4": figure_4(paths["plain-reduced"], time),
            "figure_5": figure_5(paths, time),
            "drift": figure_drift(means, gains, p.sampling_interval * numpy.arange(1, LONG + 1)),
        },
        {
            "figure_2": "Fig. 2: one run of example (a), and exact standard deviations; the estimate is near the "
            "process and far from the reference.",
            "figure_4": f"Fig. 4: what INS and GNSS say in one run with a drift of {DRIFT:g} m/s.",
            "figure_5": "Fig. 5: estimates of the same run, and their errors.",
            "drift": f"Mean error with a drift of {DRIFT:g} m/s, 95 % bands; dotted: beta / K.",
        },
    )
