"""The IMM over two alpha-beta filters (Bakulev, Sychev, Nguyen): figures 2 to 5, the gain grid, the claims.

The paper shows curves and prints no numbers, so its claims are tested on root-mean-square errors (RMS) along
x, as in its figure 4, over episodes and scans of the windows of scenario ``paper``. Every run faces the same
noise; standard errors and intervals come from one bootstrap over episodes, so comparisons are paired.

Reading: the paper calls the improvement substantial without a number; here the RMS over the manoeuvre section
(the turn and the seven scans after it) must be at least ``SUBSTANTIAL`` smaller.
Reading: it gives no criterion for the best gains; here the RMS over the whole run.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...envs.catalogue import make_task
from ...envs.maneuvering_target.task import ManeuveringTarget
from ...evaluation.bootstrap import Bootstrap, Estimate
from ...evaluation.figures import styles
from ..names import evaluate
from ..reproduction import Claim, Grid, Reproduction, Verdict, episode_count
from .gain_schedules import Flight, best_schedule, maneuver_flight, mean_square_errors, ramp_schedule
from .imm_readings import Likelihood, Reading, Recording, interacting_multiple_model, recorded

TITLE = "Tracking a manoeuvring target with an IMM algorithm over two alpha-beta filters"
EPISODES = 5000
GRID_EPISODES = 2000
SEED = 0
RESAMPLES = 500

SUBSTANTIAL = 0.1
NEAR_MINIMUM = 0.03
"""Cells of the gain grid within 3 % of the smallest error count as good."""
CERTAIN = 0.95
"""Share of bootstrap samples in which a finding must hold."""

LOW_GAINS = (0.2, 0.25, 0.3, 0.35, 0.4, 0.45)
HIGH_GAINS = (0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
LOW_BOX, HIGH_BOX = (0.3, 0.45), (0.7, 0.95)
"""Gains that the paper recommends."""

WINDOWS = {**ManeuveringTarget.scenarios["paper"].windows, "all": (1, 100)}
SECTION = (WINDOWS["turn"][0], WINDOWS["recovery"][1])

LIKELIHOODS: dict[Likelihood, str] = {
    "gains used": "canonical: covariance of the gains used, mixed with spread",
    "no spread": "mixed without the spread of the means",
    "R/(1-alpha)": "S = R / (1 - alpha)",
    "steady": "S = R (1 + steady prediction variance)",
    "Kalman": "covariance of the optimal gain, Q = 0",
}
STAYS = (0.7, 0.8, 0.95, 0.98)
BOX_PAIRS = ((0.3, 0.85), (0.4, 0.85))
LATER = 1
"""Scans by which the turn begins later in the other reading of its start."""

MAIN = ("imm", "adaptive", "adaptive-rearm", "kalman-imm", "known-turn", "known-input-bound")
COMPARED = ("imm", "adaptive", "adaptive-rearm")
STEPS = (
    len(MAIN)
    + len(BOX_PAIRS) * len(COMPARED)
    + 2 * len(COMPARED)
    + len(LIKELIHOODS)  # the canonical one is in MAIN; one IMM for each axis takes its place
    + len(STAYS)
    + len(LIKELIHOODS) * len(LOW_GAINS)
)

NAMES = {
    "imm": "IMM, 0.3 / 0.7",
    "adaptive": "adaptive filter",
    "adaptive-rearm": "adaptive filter, re-arming",
    "kalman-imm": "IMM over two Kalman filters (acceleration 0 and 2.775 m/s^2)",
    "known-turn": "Kalman filter told the turn's scans",
    "known-input-bound": "Cramer-Rao bound, acceleration known",
}


# --- errors and their uncertainty


class Curves(NamedTuple):
    """Mean square error along x in each scan; the first row is the data's, the others bootstrap samples."""

    position: numpy.ndarray
    """m^2, ``(1 + resamples, K)``; one row where it is exact."""
    velocity: numpy.ndarray
    """(m/s)^2."""


COMPONENTS = (("position", "m"), ("velocity", "m/s"))


def curves_of(error: numpy.ndarray, bootstrap: Bootstrap) -> Curves:
    """Mean squares of errors ``(episodes, K, 4)`` of x, y, vx, vy."""
    return Curves(bootstrap.means(error[:, :, 0] ** 2), bootstrap.means(error[:, :, 2] ** 2))


def rms(mean_square: numpy.ndarray, window: tuple[int, int]) -> numpy.ndarray:
    """Root of the mean over a window of scans, first and last included, for every row."""
    return numpy.sqrt(mean_square[:, window[0] - 1 : window[1]].mean(axis=1))


def relative_change(
    ours: numpy.ndarray, theirs: numpy.ndarray, window: tuple[int, int], bootstrap: Bootstrap
) -> Estimate:
    """``ours / theirs - 1`` of the RMS over a window, paired."""
    return bootstrap.interval(rms(ours, window) / rms(theirs, window) - 1.0)


def with_error(samples: numpy.ndarray, digits: int) -> str:
    """Value and bootstrap standard error, or the value alone where it is exact."""
    value = f"{samples[0]:.{digits}f}"
    return value if len(samples) == 1 else f"{value} ± {samples[1:].std():.{digits + 1}f}"


def percent(estimate: Estimate, digits: int = 1) -> str:
    """Relative change with its interval: ``-25.1 % [-25.6, -24.6]``."""
    low, high = 100 * estimate.low, 100 * estimate.high
    return f"{100 * estimate.value:+.{digits}f} % [{low:+.{digits}f}, {high:+.{digits}f}]"


def pair(curves: Curves, window: tuple[int, int]) -> str:
    """Position and velocity RMS of a window: ``135.7 ± 0.31 / 27.12 ± 0.02``."""
    return f"{with_error(rms(curves.position, window), 1)} / {with_error(rms(curves.velocity, window), 2)}"


def peaks(curves: Curves) -> tuple[str, str]:
    """Largest RMSE over the scans, and where: ``182.8 ± 0.5 @55``."""
    texts = []
    for values, digits in ((curves.position, 1), (curves.velocity, 2)):
        largest = numpy.sqrt(values.max(axis=1))
        texts.append(f"{with_error(largest, digits)} @{int(values[0].argmax()) + 1}")
    return texts[0], texts[1]


# --- verdicts


def improvement_verdict(section: Sequence[Estimate], parts: Sequence[Estimate]) -> Verdict:
    """Verdict on "substantially smaller error on the manoeuvre section".

    Args:
        section: relative change over the whole section, of position and of velocity.
        parts: relative changes over its parts (turn, recovery).

    Returns:
        "reproduced" if every change over the section lies below minus ``SUBSTANTIAL`` with its interval and
        no part is certainly worse; "not reproduced" if no change over the section is certainly below zero.
    """
    worse_somewhere = any(change.low > 0.0 for change in parts)
    if all(change.high < -SUBSTANTIAL for change in section) and not worse_somewhere:
        return "reproduced"
    if not any(change.high < 0.0 for change in section):
        return "not reproduced"
    return "reproduced in part"


class GridFinding(NamedTuple):
    """Where on the gain grid an error is smallest."""

    minimum: float
    gains: tuple[float, float]
    share_inside: float
    """Share of bootstrap samples whose smallest cell lies in the recommended box."""
    near: int
    """Cells within ``NEAR_MINIMUM`` of the smallest."""
    near_inside: int
    """Those of them in the box."""
    inside_excess: Estimate
    """Smallest error in the box over the smallest anywhere, minus one."""


def inside_box() -> numpy.ndarray:
    """Cells of the grid within the recommended gains, ``(6, 8)``."""
    low, high = numpy.array(LOW_GAINS), numpy.array(HIGH_GAINS)
    inside_low = (low >= LOW_BOX[0] - 1e-9) & (low <= LOW_BOX[1] + 1e-9)
    inside_high = (high >= HIGH_BOX[0] - 1e-9) & (high <= HIGH_BOX[1] + 1e-9)
    return inside_low[:, None] & inside_high


def grid_finding(errors: numpy.ndarray, bootstrap: Bootstrap) -> GridFinding:
    """Find the smallest error of a grid ``(1 + resamples, 6, 8)``."""
    inside = inside_box()
    flat = errors.reshape(len(errors), -1)
    best = flat.argmin(axis=1)
    row, column = divmod(int(best[0]), len(HIGH_GAINS))
    near = errors[0] <= (1.0 + NEAR_MINIMUM) * flat[0].min()
    return GridFinding(
        float(flat[0].min()),
        (LOW_GAINS[row], HIGH_GAINS[column]),
        float(inside.ravel()[best[1:]].mean()),
        int(near.sum()),
        int((near & inside).sum()),
        bootstrap.interval(flat[:, inside.ravel()].min(axis=1) / flat.min(axis=1) - 1.0),
    )


def box_verdict(findings: Sequence[GridFinding]) -> Verdict:
    """Verdict on "the smallest error is in the recommended box", for position and velocity.

    A component holds if its minimum is in the box in ``CERTAIN`` of the bootstrap samples and no cell
    outside comes within ``NEAR_MINIMUM``. All hold: "reproduced"; none has its minimum there for certain:
    "not reproduced".
    """
    certain = [f.share_inside >= CERTAIN for f in findings]
    if all(certain) and all(f.near == f.near_inside for f in findings):
        return "reproduced"
    return "reproduced in part" if any(certain) else "not reproduced"


def dominance_verdict(straight: Sequence[Estimate], turn: Estimate) -> Verdict:
    """Verdict on "mode 1 dominates on the straight legs, mode 2 in the turn".

    Args:
        straight: mean probability of mode 1 on each straight window.
        turn: the same in the turn.
    """
    holds = [mean.low > 0.5 for mean in straight] + [turn.high < 0.5]
    return "reproduced" if all(holds) else "reproduced in part" if any(holds) else "not reproduced"


class Comparison(NamedTuple):
    """Relative changes of the IMM's RMS against a comparator's, position then velocity."""

    section: tuple[Estimate, Estimate]
    turn: tuple[Estimate, Estimate]
    recovery: tuple[Estimate, Estimate]
    peak: tuple[Estimate, Estimate]

    @property
    def verdict(self) -> Verdict:
        """Verdict on C1 against this comparator."""
        return improvement_verdict(self.section, [*self.turn, *self.recovery])


def compared(ours: Curves, theirs: Curves, bootstrap: Bootstrap, later: int = 0) -> Comparison:
    """Compare the IMM with an adaptive filter on the manoeuvre section, moved by ``later`` scans."""

    def changes(window: tuple[int, int]) -> tuple[Estimate, Estimate]:
        moved = (window[0] + later, window[1] + later)
        first, second = (relative_change(a, b, moved, bootstrap) for a, b in zip(ours, theirs, strict=True))
        return first, second

    first, second = (
        bootstrap.interval(numpy.sqrt(a.max(axis=1) / b.max(axis=1)) - 1.0)
        for a, b in zip(ours, theirs, strict=True)
    )
    return Comparison(
        changes(SECTION), changes(WINDOWS["turn"]), changes(WINDOWS["recovery"]), (first, second)
    )


# --- runs


class Run(NamedTuple):
    """One policy, reference or bound over all episodes."""

    curves: Curves
    probability: numpy.ndarray | None
    """Of mode 1, ``(episodes, K)``."""
    alpha: numpy.ndarray | None
    """Gain used, ``(episodes, K)``."""
    first: numpy.ndarray
    """Estimate minus truth in the first episode, ``(K, 4)``."""


def evaluated(
    name: str, episodes: int, bootstrap: Bootstrap, progress: Callable[[float], None], **keywords: Any
) -> Run:
    """Run a policy, reference or bound of the environment over the paper's flight; one unit of work."""
    total = episodes * 100
    dataset = evaluate(
        ManeuveringTarget.id,
        [name],
        "paper",
        episodes,
        SEED,
        progress=lambda done: progress(done / total),
        **keywords,
    )
    one = dataset.isel(policy=0)
    if "mean_square" in dataset:
        squares = one["mean_square"].values[:1]
        return Run(Curves(squares[:, :, 0], squares[:, :, 2]), None, None, squares[0])
    error = one["error"].values
    probability = one["mode_probability"].values[:, :, 0] if "mode_probability" in dataset else None
    alpha = one["alpha"].values if "alpha" in dataset else None
    return Run(curves_of(error, bootstrap), probability, alpha, error[0])


def variant(recording: Recording, reading: Reading, bootstrap: Bootstrap) -> Curves:
    """Errors of a plain filter."""
    return curves_of(numpy.moveaxis(interacting_multiple_model(recording, reading), -1, 0), bootstrap)


def gain_grid(
    recording: Recording, likelihood: Likelihood, bootstrap: Bootstrap, progress: Callable[[float], None]
) -> list[list[Curves]]:
    """Errors of every pair of gains; a unit of work for each lower gain."""
    grid = []
    for low in LOW_GAINS:
        row = []
        for high in HIGH_GAINS:
            row.append(variant(recording, Reading(gains=(low, high), likelihood=likelihood), bootstrap))
            progress(1.0 / len(HIGH_GAINS))
        grid.append(row)
    return grid


def grid_errors(grid: list[list[Curves]], component: int, window: tuple[int, int] | None) -> numpy.ndarray:
    """RMS of a window (None: the peak over scans) of every cell, ``(1 + resamples, 6, 8)``."""

    def error(curves: Curves) -> numpy.ndarray:
        squares = curves[component]
        return numpy.sqrt(squares.max(axis=1)) if window is None else rms(squares, window)

    return numpy.stack([numpy.stack([error(c) for c in row], axis=1) for row in grid], axis=1)


class Results(NamedTuple):
    """Everything that claims, tables and figures are made of."""

    episodes: int
    bootstrap: Bootstrap
    grid_bootstrap: Bootstrap
    grid_episodes: int
    main: dict[str, Run]
    exact: dict[str, Curves]
    forced: dict[int, Curves]
    """Adaptive filter with the manoeuvre detected at a given scan, exact."""
    boxed: dict[tuple[float, float], dict[str, Curves]]
    """IMM and comparators with other gains."""
    polar: dict[str, Curves]
    later: dict[str, Curves]
    readings: dict[str, Curves]
    """Variants of the IMM on the episodes of ``main``."""
    grids: dict[Likelihood, list[list[Curves]]]
    recording: Recording
    schedule: numpy.ndarray
    """Best gains of each scan, ``(K,)``."""


def run_everything(progress: Callable[[float], None], episodes: int) -> Results:
    """Run all experiments."""
    bootstrap = Bootstrap(episodes, RESAMPLES)
    grid_episodes = min(episodes, GRID_EPISODES)
    grid_bootstrap = Bootstrap(grid_episodes, RESAMPLES)
    parameters: Any = make_task(ManeuveringTarget.id, "gain", "paper").parameters
    flight: Flight = maneuver_flight(parameters)

    def exactly(alpha: numpy.ndarray) -> Curves:
        squares = mean_square_errors(flight, alpha)
        return Curves(squares.position[None], squares.velocity[None])

    scans = parameters.horizon
    low, high = parameters.gains
    schedule = best_schedule(flight)
    exact = {f"fixed gain {a:g}": exactly(numpy.full(scans, a)) for a in (low, high, 0.65)}
    exact["best gain schedule, flight known"] = exactly(schedule)
    turn = WINDOWS["turn"]
    forced = {k: exactly(ramp_schedule(low, high, scans, k)) for k in range(turn[0], turn[1] + 1)}

    def compared_with(**keywords: Any) -> dict[str, Curves]:
        return {n: evaluated(n, episodes, bootstrap, progress, **keywords).curves for n in COMPARED}

    main = {name: evaluated(name, episodes, bootstrap, progress) for name in MAIN}
    boxed = {gains: compared_with(gains=gains) for gains in BOX_PAIRS}
    polar = compared_with(polar_measurements=True)
    later = compared_with(maneuver_steps=(turn[0] + LATER, turn[1] + LATER))

    recording = recorded(episodes, SEED)
    readings: dict[str, Curves] = {}
    variants = {"one IMM for each axis": Reading(per_axis=True)}
    variants |= {LIKELIHOODS[kind]: Reading(likelihood=kind) for kind in list(LIKELIHOODS)[1:]}
    variants |= {f"stay probability {stay:g}": Reading(stay=stay) for stay in STAYS}
    for name, reading in variants.items():
        readings[name] = variant(recording, reading, bootstrap)
        progress(1.0)

    few = recorded(grid_episodes, SEED)
    grids = {kind: gain_grid(few, kind, grid_bootstrap, progress) for kind in LIKELIHOODS}
    return Results(
        episodes,
        bootstrap,
        grid_bootstrap,
        grid_episodes,
        main,
        exact,
        forced,
        boxed,
        polar,
        later,
        readings,
        grids,
        recording,
        schedule,
    )


# --- what the report is made of


def _comparisons(r: Results) -> dict[str, Comparison]:
    """Every comparison of the IMM with an adaptive filter on the manoeuvre section."""
    canonical = {name: r.main[name].curves for name in COMPARED}
    experiments: list[tuple[str, Mapping[str, Curves], int]] = [("canonical, 0.3 / 0.7", canonical, 0)]
    experiments += [(f"gains {a:g} / {b:g}", curves, 0) for (a, b), curves in r.boxed.items()]
    experiments.append(("polar measurements", r.polar, 0))
    experiments.append((f"turn {LATER} scan later", r.later, LATER))
    experiments += [(name, canonical | {"imm": curves}, 0) for name, curves in r.readings.items()]
    return {
        f"{name}; against {NAMES[other]}": compared(curves["imm"], curves[other], r.bootstrap, later)
        for name, curves, later in experiments
        for other in COMPARED[1:]
    }


def _findings(r: Results, likelihood: Likelihood, window: tuple[int, int] | None) -> list[GridFinding]:
    """Best gains for position and for velocity."""
    return [grid_finding(grid_errors(r.grids[likelihood], c, window), r.grid_bootstrap) for c in range(2)]


def mean_probability(run: Run, window: tuple[int, int], bootstrap: Bootstrap) -> Estimate:
    """Mean probability of mode 1 over a window."""
    assert run.probability is not None
    return bootstrap.estimate(run.probability[:, window[0] - 1 : window[1]].mean(axis=1))


def ramps_begun(alpha: numpy.ndarray, high: float) -> numpy.ndarray:
    """Scans at which the adaptive filter began a ramp after the first one, ``(episodes, K)`` booleans."""
    alarms = numpy.abs(alpha - high) < 1e-9
    alarms[:, 0] = False
    return alarms


def _bracket(estimate: Estimate, digits: int) -> str:
    return f"{estimate.value:.{digits}f} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def _changes(comparison: Comparison) -> str:
    parts = {
        f"scans {SECTION[0]}-{SECTION[1]}": comparison.section,
        "turn": comparison.turn,
        "recovery": comparison.recovery,
        "peak": comparison.peak,
    }
    return "; ".join(
        f"{name}: position {percent(position)}, velocity {percent(velocity)}"
        for name, (position, velocity) in parts.items()
    )


def _grid_text(findings: Sequence[GridFinding], r: Results) -> str:
    texts = []
    for finding, (name, unit), digits in zip(findings, COMPONENTS, (1, 2), strict=True):
        low, high = finding.gains
        texts.append(
            f"{name}: minimum {finding.minimum:.{digits}f} {unit} at {low:g} / {high:g}, in the box in "
            f"{100 * finding.share_inside:.0f} % of bootstrap samples; {finding.near_inside} of the "
            f"{finding.near} cells within {100 * NEAR_MINIMUM:.0f} % of it are in the box; best in the box "
            f"{percent(finding.inside_excess)} above the minimum"
        )
    return "; ".join(texts)


def claims(r: Results) -> list[Claim]:
    """The paper's claims, and what it does not mention, each with a verdict from the figures."""
    comparisons = _comparisons(r)
    runs = (
        f"{r.episodes} episodes on common noise; change of the RMS along x, 95 % bootstrap intervals of the "
        f"paired ratio"
    )
    rule = (
        f"reproduced if position and velocity RMS over scans {SECTION[0]}-{SECTION[1]} are certainly at "
        f"least {100 * SUBSTANTIAL:.0f} % smaller and neither turn nor recovery is certainly worse"
    )
    statement = "On the manoeuvre section the IMM has substantially smaller RMSE than the adaptive filter"
    result = [
        Claim(
            f"C1{suffix}",
            f"{statement}{condition}.",
            _changes(comparisons[key]),
            f"{runs}; {rule}",
            comparisons[key].verdict,
        )
        for suffix, condition, key in (
            ("", "", f"canonical, 0.3 / 0.7; against {NAMES['adaptive']}"),
            (
                " re-arming",
                ", when an alarm during the ramp starts it again (same gains)",
                f"canonical, 0.3 / 0.7; against {NAMES['adaptive-rearm']}",
            ),
            *(
                (
                    f" re-arming, {a:g} / {b:g}",
                    f", re-arming, both with gains {a:g} / {b:g} of the recommended box",
                    f"gains {a:g} / {b:g}; against {NAMES['adaptive-rearm']}",
                )
                for a, b in BOX_PAIRS
            ),
        )
    ]
    findings = _findings(r, "gains used", WINDOWS["all"])
    grid_runs = (
        f"{r.grid_episodes} episodes in each of {len(LOW_GAINS)} x {len(HIGH_GAINS)} cells, common noise, "
        f"RMS along x over all scans"
    )
    box = f"alpha_1 = {LOW_BOX[0]:g}..{LOW_BOX[1]:g}, alpha_2 = {HIGH_BOX[0]:g}..{HIGH_BOX[1]:g}"
    result.append(
        Claim(
            "C2",
            f"The smallest RMSE is at {box}.",
            _grid_text(findings, r),
            f"{grid_runs}; reproduced if the minimum is in the box in {100 * CERTAIN:.0f} % of bootstrap "
            f"samples and every cell within {100 * NEAR_MINIMUM:.0f} % of it too, for position and velocity. "
            f"The box is half of the grid",
            box_verdict(findings),
        )
    )
    imm = r.main["imm"]
    assert imm.probability is not None
    straight = [mean_probability(imm, WINDOWS[w], r.bootstrap) for w in ("pre", "post")]
    turn = mean_probability(imm, WINDOWS["turn"], r.bootstrap)
    mean = imm.probability.mean(axis=0)
    result.append(
        Claim(
            "C3",
            "Mode 1 dominates on the straight legs, mode 2 during the turn.",
            f"mean probability of mode 1: {_bracket(straight[0], 3)} before the turn, {_bracket(turn, 3)} in "
            f"it, {_bracket(straight[1], 3)} after it; {_handover(mean)}",
            f"{r.episodes} episodes, mean over the windows, 95 % bootstrap intervals; reproduced if "
            f"certainly above 0.5 on both straight windows and below in the turn",
            dominance_verdict(straight, turn),
        )
    )
    return result + _silent(r, comparisons, findings)


def _handover(mean: numpy.ndarray) -> str:
    """When the mean probability of mode 1, ``(K,)``, falls below one half in the turn, and comes back."""
    first = WINDOWS["turn"][0]
    scans = numpy.arange(1, len(mean) + 1)
    below = scans[(scans >= first) & (mean < 0.5)]
    if not len(below):
        return "it never falls below 0.5 after the turn begins"
    back = scans[(scans > below[0]) & (mean >= 0.5)]
    returns = f"is back above it at scan {back[0]}" if len(back) else "does not come back above it"
    early = int((mean[: first - 1] < 0.5).sum())
    return (
        f"it falls below 0.5 at scan {below[0]} and {returns}; at the start it is below 0.5 for {early} "
        f"scans; it never exceeds {mean.max():.2f}"
    )


def _silent(
    r: Results, comparisons: Mapping[str, Comparison], findings: Sequence[GridFinding]
) -> list[Claim]:
    """What the paper does not mention."""
    silent: Verdict = "paper is silent"
    imm, adaptive = r.main["imm"].curves, r.main["adaptive"].curves
    legs = []
    for window in (WINDOWS["pre"], WINDOWS["post"]):
        parts = []
        for a, b, (name, unit), digits in zip(imm, adaptive, COMPONENTS, (1, 2), strict=True):
            ours, theirs = (with_error(rms(values, window), digits) for values in (a, b))
            change = percent(relative_change(a, b, window, r.bootstrap))
            parts.append(f"{name} {ours} against {theirs} {unit} ({change})")
        legs.append(f"scans {window[0]}-{window[1]}: " + ", ".join(parts))
    straight = "; ".join(legs)
    forced = ", ".join(
        f"{k}: {rms(c.position, WINDOWS['all'])[0]:.1f} m" for k, c in r.forced.items() if k < SECTION[0] + 5
    )
    alpha = r.main["adaptive"].alpha
    assert alpha is not None
    alarms = ramps_begun(alpha, 0.7)
    false_rate = alarms[:, 8 : SECTION[0] - 1].mean()
    quiet = ~alarms[:, : SECTION[0] - 1].any(axis=1)
    later = alarms[:, SECTION[0] - 1 :][quiet]
    detected = numpy.where(later.any(axis=1), later.argmax(axis=1) + SECTION[0], 0)
    shares = ", ".join(f"{k}: {(detected == k).mean():.3f}" for k in range(SECTION[0], SECTION[0] + 4))
    row, column = LOW_GAINS.index(0.3), HIGH_GAINS.index(0.7)
    figure_gains = []
    for c, (name, _) in enumerate(COMPONENTS):
        errors = grid_errors(r.grids["gains used"], c, WINDOWS["all"])
        excess = errors[:, row, column] / errors.reshape(len(errors), -1).min(axis=1) - 1.0
        figure_gains.append(f"{name} {percent(r.grid_bootstrap.interval(excess))}")
    readings = "; ".join(
        f"{LIKELIHOODS[kind]}: {box_verdict(found)} (position minimum at "
        f"{found[0].gains[0]:g} / {found[0].gains[1]:g}, box {percent(found[0].inside_excess)} above it; "
        f"velocity at {found[1].gains[0]:g} / {found[1].gains[1]:g})"
        for kind in list(LIKELIHOODS)[1:]
        for found in [_findings(r, kind, WINDOWS["all"])]
    )
    others: dict[tuple[str, Verdict], list[str]] = {}
    for name, comparison in comparisons.items():
        experiment, _, opponent = name.partition("; against ")
        others.setdefault((opponent, comparison.verdict), []).append(experiment)
    sensitivity = ". ".join(
        f"Against {opponent}, {verdict}: {'; '.join(names)}" for (opponent, verdict), names in others.items()
    )
    fixed = r.exact["fixed gain 0.65"]
    quiet_legs = _findings(r, "gains used", WINDOWS["pre"])
    return [
        Claim(
            "Straight legs",
            "What does the IMM cost where nothing happens?",
            straight,
            f"{r.episodes} episodes, IMM against the adaptive filter without re-arming, paired",
            silent,
        ),
        Claim(
            "Detection",
            "Would earlier detection help the adaptive filter?",
            f"whole-run position RMS when the detection is forced at scan {forced}: its ramp runs out before "
            f"the turn is over if it begins early. The detector's first alarm comes at scan {shares} "
            f"(share of episodes without an alarm before); false alarms {false_rate:.4f} per scan",
            f"exact for forced detection; {r.episodes} episodes for the detector",
            silent,
        ),
        Claim(
            "Figures' gains",
            "How good are the gains 0.3 / 0.7 of the figures?",
            "above the smallest whole-run RMS of the grid: " + ", ".join(figure_gains),
            f"{r.grid_episodes} episodes a cell, paired",
            silent,
        ),
        Claim(
            "Single gain",
            "Does the IMM beat one fixed gain over the whole run?",
            f"IMM {pair(imm, WINDOWS['all'])}; best fixed gain 0.65 "
            f"{rms(fixed.position, WINDOWS['all'])[0]:.1f} / {rms(fixed.velocity, WINDOWS['all'])[0]:.2f} "
            "(m / m/s)",
            f"{r.episodes} episodes; fixed gain exact",
            silent,
        ),
        Claim(
            "Quiet gains",
            "Which gains are best on the straight leg before the turn?",
            _grid_text(quiet_legs, r),
            f"{r.grid_episodes} episodes a cell, scans {WINDOWS['pre'][0]}-{WINDOWS['pre'][1]}",
            silent,
        ),
        Claim(
            "C2 in other readings",
            "Which covariance stands in the likelihood? The paper's claim C2 under the other readings:",
            readings,
            f"plain filters on the same measurements, {r.grid_episodes} episodes a cell, rule of C2",
            silent,
        ),
        Claim(
            "C1 in other readings",
            "Does the verdict on C1 depend on what the paper leaves open?",
            sensitivity,
            "the rule of C1 for every row of the table of comparisons",
            silent,
        ),
    ]


# --- tables


def tables(r: Results) -> list[Grid]:
    """Tables of the report; RMS along x, position in m / velocity in m/s, ± bootstrap standard error."""
    windows = [*WINDOWS]
    spans = [f"{w} {WINDOWS[w][0]}-{WINDOWS[w][1]}" for w in windows]

    def row(name: str, curves: Curves, later: int = 0) -> list[str]:
        last = curves.position.shape[1]
        moved = {
            w: (a + later, min(b + later, last)) if w != "all" else (a, b) for w, (a, b) in WINDOWS.items()
        }
        return [name, *(pair(curves, moved[w]) for w in windows), *peaks(curves)]

    header = ["algorithm", *spans, "peak position", "peak velocity"]
    main = [row(NAMES[n], r.main[n].curves) for n in COMPARED]
    main += [row(f"{name}, exact", curves) for name, curves in r.exact.items() if name.startswith("fixed")]
    main += [row(NAMES["kalman-imm"], r.main["kalman-imm"].curves)]
    main += [row(f"{n}, exact", c) for n, c in r.exact.items() if not n.startswith("fixed")]
    main += [row(NAMES["known-turn"], r.main["known-turn"].curves)]
    main += [row(f"{NAMES['known-input-bound']}, exact", r.main["known-input-bound"].curves)]
    sensitivity = [row("canonical", r.main["imm"].curves)]
    sensitivity += [row(name, curves) for name, curves in r.readings.items()]
    sensitivity.append(row("polar measurements", r.polar["imm"]))
    sensitivity.append(row(f"turn {LATER} scan later (windows too)", r.later["imm"], LATER))
    sensitivity += [row(f"gains {a:g} / {b:g}", c["imm"]) for (a, b), c in r.boxed.items()]
    unit = "position m / velocity m/s, ± standard error"
    comparison_rows = [
        [
            name,
            *(percent(e) for two in (c.section, c.turn, c.recovery, c.peak) for e in two),
            c.verdict,
        ]
        for name, c in _comparisons(r).items()
    ]
    grid_windows: dict[str, tuple[int, int] | None] = {
        "all": WINDOWS["all"],
        f"{SECTION[0]}-{SECTION[1]}": SECTION,
        "turn": WINDOWS["turn"],
        "peak over scans": None,
        "pre": WINDOWS["pre"],
    }
    finding_rows = []
    for kind, description in LIKELIHOODS.items():
        for name, window in grid_windows.items():
            if kind != "gains used" and name != "all":
                continue
            for finding, (component, unit_of) in zip(_findings(r, kind, window), COMPONENTS, strict=True):
                finding_rows.append(
                    [
                        description,
                        name,
                        component,
                        f"{finding.minimum:.4g} {unit_of}",
                        f"{finding.gains[0]:g} / {finding.gains[1]:g}",
                        f"{100 * finding.share_inside:.0f} %",
                        f"{finding.near_inside} of {finding.near}",
                        percent(finding.inside_excess),
                    ]
                )
    cells = [
        [f"{low:g}", *(pair(curves, WINDOWS["all"]) for curves in row_of)]
        for low, row_of in zip(LOW_GAINS, r.grids["gains used"], strict=True)
    ]
    forced = [row(f"detected at {k}", curves) for k, curves in r.forced.items()]
    imm = r.main["imm"]
    assert imm.probability is not None
    samples = r.bootstrap.means(imm.probability)
    quantiles = numpy.percentile(imm.probability, [10, 90], axis=0)
    scans = (1, 2, 5, 10, 16, 20, 30, 40, 49, 50, 51, 52, 53, 54, 55, 56, 57, 58, 60, 62, 65, 66, 70, 80, 100)
    probabilities = [
        [str(k), with_error(samples[:, k - 1], 3), f"{quantiles[0, k - 1]:.2f} to {quantiles[1, k - 1]:.2f}"]
        for k in scans
    ]
    ends = ("position", "velocity")
    return [
        Grid(f"Errors along x on the paper's flight ({unit})", header, main),
        Grid(
            "IMM against adaptive filters: relative change of the RMS, 95 % interval",
            [
                "experiment",
                *(
                    f"{w} {c}"
                    for w in (f"{SECTION[0]}-{SECTION[1]}", "turn", "recovery", "peak")
                    for c in ends
                ),
                "verdict on C1",
            ],
            comparison_rows,
        ),
        Grid(
            "Best gains",
            [
                "reading of the covariance",
                "window",
                "component",
                "minimum",
                "at alpha_1 / alpha_2",
                "samples with the minimum in the box",
                f"cells within {100 * NEAR_MINIMUM:.0f} % that are in the box",
                "best in the box above the minimum",
            ],
            finding_rows,
        ),
        Grid(
            f"Whole-run RMS on the gain grid, canonical reading ({unit})",
            ["alpha_1 \\ alpha_2", *(f"{high:g}" for high in HIGH_GAINS)],
            cells,
        ),
        Grid(f"Sensitivity of the IMM to what the paper leaves open ({unit})", header, sensitivity),
        Grid(
            "Adaptive filter, manoeuvre detected at a given scan, exact (position m / velocity m/s)",
            header,
            forced,
        ),
        Grid(
            "Probability of mode 1",
            ["scan", "mean ± standard error", "10-90 % range over episodes"],
            probabilities,
        ),
    ]


# --- figures


def _figure(columns: int = 1, rows: int = 1, size: tuple[float, float] = (8.0, 4.0)) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _mark_turn(axis: Any) -> None:
    first, last = WINDOWS["turn"]
    axis.axvspan(first - 0.5, last + 0.5, color="0.92", zorder=0, lw=0)
    axis.text(
        (first + last) / 2,
        1.01,
        "turn",
        transform=axis.get_xaxis_transform(),
        ha="center",
        va="bottom",
        fontsize=8,
        color="0.35",
    )


def draw_trajectory(r: Results) -> Any:
    """Figure 2: the flight, with the measurements and the estimate of one episode."""
    figure, grid = _figure(2, size=(10.0, 4.6))
    truth, measured = r.recording.truth[:, :2, 0] / 1e3, r.recording.measurement[:, :, 0] / 1e3
    estimate = truth + r.main["imm"].first[:, :2] / 1e3
    style = styles(["true", "estimate", "measured"])
    first, last = WINDOWS["turn"]
    for axis in grid[0]:
        axis.plot(*truth.T, label="true flight", **style["true"])
        axis.plot(*estimate.T, label="IMM estimate, one episode", **(style["estimate"] | {"linestyle": "--"}))
        axis.plot(*measured.T, ".", ms=4, color=style["measured"]["color"], label="measurements, one episode")
        axis.plot(*truth[[first - 2, last - 1]].T, "k|", ms=14, mew=1.5, label="turn begins and ends")
        axis.plot(0.0, 0.0, "k^", ms=7, label="radar")
        axis.set_aspect("equal")
        axis.set_xlabel("x, km")
        axis.set_ylabel("y, km")
        axis.grid(alpha=0.25, lw=0.4)
    grid[0, 0].set_xlim(-11.0, 30.0)
    grid[0, 0].set_ylim(-30.0, 10.0)
    centre = truth[first - 2 : last].mean(axis=0)
    grid[0, 1].set_xlim(centre[0] - 2.2, centre[0] + 2.2)
    grid[0, 1].set_ylim(centre[1] - 2.2, centre[1] + 2.2)
    grid[0, 1].set_title("around the turn", fontsize=9)
    grid[0, 0].legend(fontsize=8, frameon=False, loc="lower left")
    return figure


def draw_gain(r: Results) -> Any:
    """Figure 3: gain of the adaptive filter, as the paper draws it and as its detector sets it."""
    figure, grid = _figure(size=(8.0, 3.8))
    axis = grid[0, 0]
    detection = WINDOWS["turn"][0] + 2
    labels = {
        "paper": f"as in the paper's figure 3, detection at scan {detection}",
        "adaptive": "mean over episodes, no re-arming",
        "adaptive-rearm": "mean over episodes, re-arming",
        "best": "best schedule, flight known",
    }
    style = styles(list(labels))
    scans = numpy.arange(1, len(r.schedule) + 1)
    _mark_turn(axis)
    axis.plot(
        scans,
        ramp_schedule(0.3, 0.7, len(scans), detection),
        label=labels["paper"],
        **(style["paper"] | {"linewidth": 2.4}),
    )
    for name, dashes in (("adaptive", "--"), ("adaptive-rearm", "-.")):
        alpha = r.main[name].alpha
        assert alpha is not None
        means = r.bootstrap.means(alpha)
        low, high = numpy.percentile(means[1:], [2.5, 97.5], axis=0)
        axis.plot(scans, means[0], label=labels[name], **(style[name] | {"linestyle": dashes}))
        axis.fill_between(scans, low, high, color=style[name]["color"], alpha=0.3, lw=0)
    axis.plot(scans, r.schedule, label=labels["best"], **(style["best"] | {"linestyle": ":"}))
    axis.set_xlabel("scan k")
    axis.set_ylabel("position gain alpha")
    axis.set_ylim(0.0, 1.0)
    axis.grid(alpha=0.25, lw=0.4)
    axis.margins(x=0.01)
    axis.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(0.08, 1.0))
    return figure


def draw_errors(r: Results) -> Any:
    """Figure 4: RMSE of x position and x velocity in each scan."""
    figure, grid = _figure(rows=2, size=(8.0, 6.4))
    names = (*COMPARED, "known-turn")
    dashes = dict(zip(names, ("-", "--", "-.", ":"), strict=True))
    scans = numpy.arange(1, len(r.schedule) + 1)
    for c, (axis, (component, unit)) in enumerate(zip(grid[:, 0], COMPONENTS, strict=True)):
        _mark_turn(axis)
        for name, style in styles(list(names)).items():
            errors = numpy.sqrt(r.main[name].curves[c])
            low, high = numpy.percentile(errors[1:], [2.5, 97.5], axis=0)
            axis.plot(scans, errors[0], label=NAMES[name], **(style | {"linestyle": dashes[name]}))
            axis.fill_between(scans, low, high, color=style["color"], alpha=0.3, lw=0)
        axis.set_ylabel(f"RMSE of x {component}, {unit}")
        axis.set_ylim(bottom=0.0)
        axis.grid(alpha=0.25, lw=0.4)
        axis.margins(x=0.01)
    grid[0, 0].legend(fontsize=8, frameon=False, loc="upper left")
    grid[1, 0].set_xlabel("scan k")
    return figure


def draw_probabilities(r: Results) -> Any:
    """Figure 5: mode probabilities of the IMM."""
    figure, grid = _figure(rows=2, size=(8.0, 5.2))
    probability = r.main["imm"].probability
    assert probability is not None
    scans = numpy.arange(1, probability.shape[1] + 1)
    for mode, (axis, style) in enumerate(zip(grid[:, 0], styles(["1", "2"]).values(), strict=True)):
        values = probability if mode == 0 else 1.0 - probability
        means = r.bootstrap.means(values)
        low, high = numpy.percentile(means[1:], [2.5, 97.5], axis=0)
        inner = numpy.percentile(values, [10, 90], axis=0)
        _mark_turn(axis)
        axis.fill_between(scans, *inner, color=style["color"], alpha=0.15, lw=0, label="10-90 % of episodes")
        axis.fill_between(scans, low, high, color=style["color"], alpha=0.4, lw=0)
        axis.plot(scans, means[0], label="mean with 95 % band", **style)
        axis.axhline(0.5, color="0.4", lw=0.7)
        axis.set_ylim(0.0, 1.0)
        axis.set_ylabel(f"probability of mode {mode + 1}\n(gain {(0.3, 0.7)[mode]:g})")
        axis.grid(alpha=0.25, lw=0.4)
        axis.margins(x=0.01)
        axis.legend(fontsize=8, frameon=False, loc="upper right" if mode else "lower right")
    grid[1, 0].set_xlabel("scan k")
    return figure


def draw_gain_grid(r: Results) -> Any:
    """Whole-run RMS of every pair of gains, with the recommended box and the cells close to the minimum."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle

    figure, grid = _figure(2, size=(12.0, 4.6))
    half = 0.025
    for c, (axis, (component, unit)) in enumerate(zip(grid[0], COMPONENTS, strict=True)):
        errors = grid_errors(r.grids["gains used"], c, WINDOWS["all"])
        best = errors[0].min()
        edges = [numpy.append(numpy.array(g) - half, g[-1] + half) for g in (HIGH_GAINS, LOW_GAINS)]
        mesh = axis.pcolormesh(*edges, errors[0], cmap="cividis_r")
        middle = 0.5 * (errors[0].max() + best)
        for i, low in enumerate(LOW_GAINS):
            for j, high in enumerate(HIGH_GAINS):
                axis.text(
                    high,
                    low,
                    f"{errors[0, i, j]:.{c + 1}f}",
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="white" if errors[0, i, j] > middle else "black",
                )
        near = errors[0] <= (1.0 + NEAR_MINIMUM) * best
        _outline(axis, near, half)
        axis.add_patch(
            Rectangle(
                (HIGH_BOX[0] - half, LOW_BOX[0] - half),
                HIGH_BOX[1] - HIGH_BOX[0] + 2 * half,
                LOW_BOX[1] - LOW_BOX[0] + 2 * half,
                fill=False,
                ec=styles(["a", "b"])["b"]["color"],
                lw=2.5,
                ls="--",
                clip_on=False,
            )
        )
        axis.set_xticks(HIGH_GAINS)
        axis.set_yticks(LOW_GAINS)
        axis.set_xlabel("gain of the manoeuvre filter, alpha_2")
        axis.set_ylabel("gain of the quiet filter, alpha_1")
        spread = math.sqrt(numpy.mean([numpy.var(errors[1:, i, j]) for i, j in numpy.ndindex(near.shape)]))
        axis.set_title(f"x {component} (± {spread:.2g} {unit} standard error)", fontsize=9)
        figure.colorbar(mesh, ax=axis, label=f"whole-run RMS, {unit}")
    handles = [
        Line2D([], [], color=styles(["a", "b"])["b"]["color"], lw=2.5, ls="--", label="box of the paper"),
        Line2D([], [], color="black", lw=2.0, label=f"within {100 * NEAR_MINIMUM:.0f} % of the minimum"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure


def _outline(axis: Any, chosen: numpy.ndarray, half: float) -> None:
    """Draw the border of a set of cells of the gain grid."""
    padded = numpy.pad(chosen, 1)
    for i, low in enumerate(LOW_GAINS):
        for j, high in enumerate(HIGH_GAINS):
            if not chosen[i, j]:
                continue
            for side, (di, dj) in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
                if not padded[i + 1 + di, j + 1 + dj]:
                    x = (high - half, high + half) if side < 2 else (high + dj * half,) * 2
                    y = (low + di * half,) * 2 if side < 2 else (low - half, low + half)
                    axis.plot(x, y, color="black", lw=2.0, solid_capstyle="projecting")


def reproduce(progress: Callable[[float], None], episodes: int | None = None) -> Reproduction:
    """Run the paper's experiment and give a verdict on each of its claims.

    Args:
        progress: called with the units of work done, ``STEPS`` in all.
        episodes: Monte Carlo runs; default: ``EPISODES``, and ``GRID_EPISODES`` in each cell of the grids.

    Raises:
        ValueError: for fewer than two episodes, which have no interval.
    """
    count = episode_count(episodes, EPISODES)
    r = run_everything(progress, count)
    figures = {
        "figure_2_trajectory": draw_trajectory(r),
        "figure_3_gain": draw_gain(r),
        "figure_4_errors": draw_errors(r),
        "figure_5_probabilities": draw_probabilities(r),
        "gain_grid": draw_gain_grid(r),
    }
    captions = {
        "figure_2_trajectory": "Figure 2: the flight; one episode's measurements and estimate.",
        "figure_3_gain": "Figure 3: gain of the adaptive filter, with 95 % bands of the means, and the best "
        "schedule of one filter that knows the flight.",
        "figure_4_errors": f"Figure 4: RMSE along x over {count} episodes, 95 % bands.",
        "figure_5_probabilities": f"Figure 5: mode probabilities of the IMM over {count} episodes.",
        "gain_grid": f"Whole-run RMS on the gain grid, {r.grid_episodes} episodes a cell on common noise; "
        "dashed: the gains that the paper recommends.",
    }
    return Reproduction(TITLE, claims(r), tables(r), figures, captions)
