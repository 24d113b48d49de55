"""The paper's claims and open questions with verdicts, and the tables of the report."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ..grid import Grid
from ..quantities import Quantity, mean, means, quantity
from ..reproduction import Statement, Verdict, verdict_of
from .experiment import (
    BOX_PAIRS,
    COMPARED_POLICIES,
    COMPONENTS,
    HIGH_GAINS,
    LATER,
    LIKELIHOODS,
    LOW_GAINS,
    NAMES,
    SECTION,
    WINDOWS,
    Results,
    rms,
)  # fmt: skip
from .imm_readings import Likelihood

SUBSTANTIAL = 0.1
NEAR_MINIMUM = 0.03
"""Cells of the gain grid within 3 % of the smallest error count as good."""
CERTAIN = 0.95
"""Share of bootstrap samples in which the smallest error must lie in the box."""
LOW_BOX, HIGH_BOX = (0.3, 0.45), (0.7, 0.95)
"""Gains that the paper recommends."""
SPAN = f"{SECTION[0]}-{SECTION[1]}"


def improvement_verdict(section: Sequence[Quantity], parts: Sequence[Quantity]) -> Verdict:
    """Return the verdict on claim C1, "substantially smaller error on the manoeuvre section".

    "Reproduced" if every change over the section lies below minus ``SUBSTANTIAL`` with its interval and no part is
    certainly worse; "not reproduced" if no change over the section is certainly below zero.
    """
    worse_somewhere = any(change.low > 0.0 for change in parts)
    if all(change.high < -SUBSTANTIAL for change in section) and not worse_somewhere:
        return "reproduced"
    return "reproduced in part" if any(change.high < 0.0 for change in section) else "not reproduced"


class Comparison(NamedTuple):
    """Relative changes of the IMM's RMS against a comparator's, position then velocity."""

    section: Sequence[Quantity]
    turn: Sequence[Quantity]
    recovery: Sequence[Quantity]
    peak: Sequence[Quantity]

    @property
    def verdict(self) -> Verdict:
        """Verdict on claim C1 against this comparator."""
        return improvement_verdict(self.section, [*self.turn, *self.recovery])

    def __str__(self) -> str:
        names = (f"scans {SPAN}", "turn", "recovery", "peak")
        return "; ".join(
            f"{name}: position {position:+.1%}, velocity {velocity:+.1%}"
            for name, (position, velocity) in zip(names, self, strict=True)
        )


def changes(ours: numpy.ndarray, theirs: numpy.ndarray, window: tuple[int, int] | None) -> Sequence[Quantity]:
    """Return ``ours / theirs - 1`` of the RMS over a window (None: of the peak), for position and velocity."""
    return [quantity(change) for change in (rms(ours, window) / rms(theirs, window) - 1.0).T]


def compare_sections(ours: numpy.ndarray, theirs: numpy.ndarray, later: int = 0) -> Comparison:
    """Return the IMM's RMS against an adaptive filter's on the manoeuvre section, moved by ``later`` scans."""
    windows = (SECTION, WINDOWS["turn"], WINDOWS["recovery"])
    section, turn, recovery = (
        changes(ours, theirs, (first + later, last + later)) for first, last in windows
    )
    return Comparison(section, turn, recovery, changes(ours, theirs, None))


def comparisons(r: Results) -> dict[str, Comparison]:
    """Return every comparison of the IMM with an adaptive filter, in all experiments, by name."""
    canonical = {name: r.main[name].squares for name in COMPARED_POLICIES}
    experiments: dict[str, Mapping[str, numpy.ndarray]] = {"canonical, 0.3 / 0.7": canonical}
    experiments |= {f"gains {a:g} / {b:g}": curves for (a, b), curves in r.boxed.items()}
    experiments |= {"polar measurements": r.polar, f"turn {LATER} scan later": r.later}
    experiments |= {name: canonical | {"imm": squares} for name, squares in r.readings.items()}
    return {
        f"{name}; against {NAMES[other]}": compare_sections(e["imm"], e[other], LATER if e is r.later else 0)
        for name, e in experiments.items()
        for other in COMPARED_POLICIES[1:]
    }


class GridFinding(NamedTuple):
    """Minimum of the RMS error on the gain grid, and its place relative to the recommended box."""

    minimum: float
    gains: tuple[float, float]
    share_inside: float
    """Share of bootstrap samples whose smallest cell lies in the recommended box."""
    near: int
    """Cells within ``NEAR_MINIMUM`` of the smallest."""
    near_inside: int
    """Cells within ``NEAR_MINIMUM`` of the smallest that are in the box."""
    inside_excess: Quantity
    """Smallest error in the box over the smallest anywhere, minus one."""


def box_mask() -> numpy.ndarray:
    """Return a boolean mask ``(6, 8)`` of the grid's cells within the recommended gains."""
    low, high = numpy.array(LOW_GAINS), numpy.array(HIGH_GAINS)
    inside_low = (low >= LOW_BOX[0] - 1e-9) & (low <= LOW_BOX[1] + 1e-9)
    inside_high = (high >= HIGH_BOX[0] - 1e-9) & (high <= HIGH_BOX[1] + 1e-9)
    return inside_low[:, None] & inside_high


def grid_errors(grid: numpy.ndarray, window: tuple[int, int] | None) -> numpy.ndarray:
    """Return the RMS over a window (None: the peak) in every cell of the gain grid, ``(2, 1 + resamples, 6, 8)``."""
    return numpy.moveaxis(rms(grid, window), (3, 2), (0, 1))


def grid_finding(errors: numpy.ndarray) -> GridFinding:
    """Return the minimum of the RMS errors ``(1 + resamples, 6, 8)`` on the gain grid, and its place."""
    inside = box_mask()
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
        quantity(flat[:, inside.ravel()].min(axis=1) / flat.min(axis=1) - 1.0),
    )


def findings(r: Results, likelihood: Likelihood, window: tuple[int, int] | None) -> list[GridFinding]:
    """Return the least RMS error on the gain grid, of position and of velocity, with its gains."""
    return [grid_finding(errors) for errors in grid_errors(r.grids[likelihood], window)]


def box_verdict(found: Sequence[GridFinding]) -> Verdict:
    """Return the verdict on "the smallest error is in the recommended box", for position and velocity.

    A component holds if its minimum is in the box in ``CERTAIN`` of the bootstrap samples and no cell
    outside comes within ``NEAR_MINIMUM``. All hold: "reproduced"; none has its minimum there for certain:
    "not reproduced".
    """
    certain = verdict_of(f.share_inside >= CERTAIN for f in found)
    alone = all(f.near == f.near_inside for f in found)
    return certain if certain != "reproduced" or alone else "reproduced in part"


def dominance_verdict(straight: Sequence[Quantity], turn: Quantity) -> Verdict:
    """Return the verdict on "mode 1 dominates on the straight legs, mode 2 in the turn"."""
    return verdict_of([mean.low > 0.5 for mean in straight] + [turn.high < 0.5])


def ramp_starts(alpha: numpy.ndarray, high: float) -> numpy.ndarray:
    """Return a boolean mask ``(episodes, K)`` of scans at which the adaptive filter began another ramp of its gain."""
    alarms = numpy.abs(alpha - high) < 1e-9
    alarms[:, 0] = False
    return alarms


def rms_texts(squares: numpy.ndarray, window: tuple[int, int] | None) -> list[str]:
    """Return position and velocity RMS of a window (None: peaks) as texts, such as ``135.68 ± 0.31``."""
    position, velocity = map(quantity, rms(squares, window).T)
    return [f"{position:.2f}", f"{velocity:.3f}"]


# --- claims


AGAINST = (
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
"""Comparators of claim C1: additions to its key and to its statement, and the name of the comparison."""


def _verdict_against(i: int, quantities: Any) -> Verdict:
    comparison: Comparison = quantities.against[i]
    return comparison.verdict


CLAIMS = (
    *(
        Statement(
            f"C1{suffix}",
            f"On the manoeuvre section the IMM has substantially smaller RMSE than the adaptive filter{more}.",
            f"{{against[{i}]}}",
            "{r.episodes} episodes on common noise; change of the RMS along x, paired; reproduced if position and "
            f"velocity RMS over scans {SPAN} are certainly at least "
            f"{100 * SUBSTANTIAL:.0f} % smaller and neither turn nor recovery is certainly worse",
            functools.partial(_verdict_against, i),
        )
        for i, (suffix, more, _) in enumerate(AGAINST)
    ),
    Statement(
        "C2",
        f"The smallest RMSE is at alpha_1 = {LOW_BOX[0]:g}..{LOW_BOX[1]:g}, "
        f"alpha_2 = {HIGH_BOX[0]:g}..{HIGH_BOX[1]:g}.",
        "{best_text}. The paper does not print the covariance in the likelihood: this is the reading S = P + R, P that "
        "of the gains used, chosen of five because it reproduces this claim, which is no test of it therefore. Under "
        "S = R / (1 - alpha), of less error on this flight (policy `imm-steady-state`): {stronger_verdict}",
        f"{{r.grid_episodes}} episodes in each of {len(LOW_GAINS)} x {len(HIGH_GAINS)} cells, common noise, RMS "
        f"along x over all scans; reproduced if the minimum is in the box in {100 * CERTAIN:.0f} % of bootstrap "
        f"samples and every cell within {100 * NEAR_MINIMUM:.0f} % of it too, for position and velocity. "
        "The box is half of the grid",
        lambda q: box_verdict(q.best),
    ),
    Statement(
        "C3",
        "Mode 1 dominates on the straight legs, mode 2 during the turn.",
        "mean probability of mode 1: {before:.4f} before the turn, {turn:.4f} in it, {after:.4f} after it; {handover}",
        "{r.episodes} episodes, mean over the windows; reproduced if certainly above "
        "0.5 on both straight windows and below in the turn",
        lambda q: dominance_verdict([q.before, q.after], q.turn),
    ),
    Statement(
        "Straight legs",
        "What does the IMM cost where nothing happens?",
        "{straight}",
        "{r.episodes} episodes, IMM against the adaptive filter without re-arming, paired",
    ),
    Statement(
        "Detection",
        "Would earlier detection help the adaptive filter?",
        "whole-run position RMS when the detection is forced at scan {forced}: its ramp runs out before "
        "the turn is over if it begins early. The detector's first alarm comes at scan {detected} (share of "
        "episodes without an alarm before); false alarms {false_alarms:.4f} per scan",
        "exact for forced detection; {r.episodes} episodes for the detector",
    ),
    Statement(
        "Figures' gains",
        "How good are the gains 0.3 / 0.7 of the figures?",
        "above the smallest whole-run RMS of the grid: position {excess[0]:+.1%}, velocity {excess[1]:+.1%}",
        "{r.grid_episodes} episodes a cell, paired",
    ),
    Statement(
        "Single gain",
        "Does the IMM beat one fixed gain over the whole run?",
        "IMM {imm[0]} / {imm[1]}; best fixed gain 0.65 {fixed[0]:.1f} / {fixed[1]:.2f} (m / m/s)",
        "{r.episodes} episodes; fixed gain exact",
    ),
    Statement(
        "Quiet gains",
        "Which gains are best on the straight leg before the turn?",
        "{quiet}",
        f"{{r.grid_episodes}} episodes a cell, scans {WINDOWS['pre'][0]}-{WINDOWS['pre'][1]}",
    ),
    Statement(
        "C2 in other readings",
        "Which covariance stands in the likelihood? The paper's claim C2 under the other readings:",
        "{readings}",
        "plain filters on the same measurements, {r.grid_episodes} episodes a cell, rule of C2",
    ),
    Statement(
        "C1 in other readings",
        "Does the verdict on C1 depend on what the paper leaves open?",
        "{others}",
        "the rule of C1 for every row of the table of comparisons",
    ),
)
"""The paper's claims, and questions that it leaves open."""


def quantities(r: Results) -> dict[str, Any]:
    """Return the quantities that the claims' texts contain, computed from the results, by name."""
    comparison = comparisons(r)
    imm, adaptive = r.main["imm"].squares, r.main["adaptive"].squares
    best = findings(r, "gains used", WINDOWS["all"])
    probability = r.main["imm"].probability
    windows = {name: slice(first - 1, last) for name, (first, last) in WINDOWS.items()}
    before, turn, after = (mean(probability[:, windows[w]].mean(axis=1)) for w in ("pre", "turn", "post"))
    begins = SECTION[0]
    alarms = ramp_starts(r.main["adaptive"].alpha, 0.7)
    row, column = LOW_GAINS.index(0.3), HIGH_GAINS.index(0.7)
    return {
        "r": r,
        "against": [comparison[name] for _, _, name in AGAINST],
        "best": best,
        "best_text": _grid_text(best),
        "before": before,
        "turn": turn,
        "after": after,
        "handover": _handover(probability.mean(axis=0)),
        "straight": _straight(imm, adaptive),
        "forced": ", ".join(
            f"{k}: {rms(squares, WINDOWS['all'])[0, 0]:.1f} m"
            for k, squares in r.forced.items()
            if k < begins + 5
        ),
        "detected": _detection_shares(alarms, begins),
        "false_alarms": alarms[:, 8 : begins - 1].mean(),
        "excess": [
            quantity(errors[:, row, column] / errors.min(axis=(1, 2)) - 1.0)
            for errors in grid_errors(r.grids["gains used"], WINDOWS["all"])
        ],
        "imm": rms_texts(imm, WINDOWS["all"]),
        "fixed": rms(r.exact["fixed gain 0.65"], WINDOWS["all"])[0],
        "quiet": _grid_text(findings(r, "gains used", WINDOWS["pre"])),
        "readings": _readings(r),
        "stronger_verdict": box_verdict(findings(r, "R/(1-alpha)", WINDOWS["all"])),
        "others": _others(comparison),
    }


def _grid_text(found: Sequence[GridFinding]) -> str:
    return "; ".join(
        f"{name}: minimum {f.minimum:.{digits}f} {unit} at {f.gains[0]:g} / {f.gains[1]:g}, in the box in "
        f"{100 * f.share_inside:.0f} % of bootstrap samples; {f.near_inside} of the {f.near} cells within "
        f"{100 * NEAR_MINIMUM:.0f} % of it are in the box; best in the box {f.inside_excess:+.1%} above the minimum"
        for f, (name, unit), digits in zip(found, COMPONENTS, (1, 2), strict=True)
    )


def _handover(mean: numpy.ndarray) -> str:
    """Return a clause with the scans at which the mean probability of mode 1, ``(K,)``, crosses one half."""
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


def _straight(imm: numpy.ndarray, adaptive: numpy.ndarray) -> str:
    """Return a text with the RMS on both straight legs, IMM against adaptive filter."""
    straight = []
    for window in (WINDOWS["pre"], WINDOWS["post"]):
        rows = zip(
            rms_texts(imm, window), rms_texts(adaptive, window), changes(imm, adaptive, window), strict=True
        )
        parts = [
            f"{name} {ours} against {theirs} {unit} ({change:+.1%})"
            for (ours, theirs, change), (name, unit) in zip(rows, COMPONENTS, strict=True)
        ]
        straight.append(f"scans {window[0]}-{window[1]}: " + ", ".join(parts))
    return "; ".join(straight)


def _detection_shares(alarms: numpy.ndarray, begins: int) -> str:
    """Return a text with the share of episodes by the scan of detection, without those with an earlier alarm."""
    later = alarms[:, begins - 1 :][~alarms[:, : begins - 1].any(axis=1)]
    detected = numpy.where(later.any(axis=1), later.argmax(axis=1) + begins, 0)
    return ", ".join(f"{k}: {(detected == k).mean():.3f}" for k in range(begins, begins + 4))


def _readings(r: Results) -> str:
    """Return a text with the verdict on C2 and the best gains under the other readings of the covariance."""
    return "; ".join(
        f"{LIKELIHOODS[kind]}: {box_verdict(found)} (position minimum at {found[0].gains[0]:g} / "
        f"{found[0].gains[1]:g}, box {found[0].inside_excess:+.1%} above it; velocity at {found[1].gains[0]:g} / "
        f"{found[1].gains[1]:g})"
        for kind in list(LIKELIHOODS)[1:]
        for found in [findings(r, kind, WINDOWS["all"])]
    )


def _others(comparison: Mapping[str, Comparison]) -> str:
    """Return a text that groups the experiments by their verdict on claim C1, for each adaptive filter."""
    others: dict[tuple[str, Verdict], list[str]] = {}
    for name, change in comparison.items():
        experiment, _, opponent = name.partition("; against ")
        others.setdefault((opponent, change.verdict), []).append(experiment)
    return ". ".join(
        f"Against {who}, {verdict}: {'; '.join(names)}" for (who, verdict), names in others.items()
    )


# --- tables


def tables(r: Results) -> list[Grid]:
    """Return the report's tables, such as the RMS along x of all algorithms, in m and m/s."""

    def row(name: str, squares: numpy.ndarray, later: int = 0) -> list[str]:
        last = squares.shape[1]
        moved = [(a + later, min(b + later, last)) for a, b in list(WINDOWS.values())[:-1]]
        scans = squares[0].argmax(axis=0) + 1
        peaks = [f"{peak} @{scan}" for peak, scan in zip(rms_texts(squares, None), scans, strict=True)]
        return [
            name,
            *(" / ".join(rms_texts(squares, window)) for window in (*moved, WINDOWS["all"])),
            *peaks,
        ]

    spans = [f"{name} {first}-{last}" for name, (first, last) in WINDOWS.items()]
    header = ["algorithm", *spans, "peak position", "peak velocity"]
    exact = [row(f"{name}, exact", squares) for name, squares in r.exact.items()]
    simulated = {name: row(NAMES[name], run.squares) for name, run in r.main.items()}
    bound = r.main["known-input-bound"].squares
    sensitivity = {"canonical": r.main["imm"].squares, **r.readings, "polar measurements": r.polar["imm"]}
    boxed = {f"gains {a:g} / {b:g}": squares["imm"] for (a, b), squares in r.boxed.items()}
    unit = "position m / velocity m/s"
    windows = {
        "all": WINDOWS["all"],
        SPAN: SECTION,
        "turn": WINDOWS["turn"],
        "peak over scans": None,
        "pre": WINDOWS["pre"],
    }
    minima = [
        [
            description, name, component, f"{f.minimum:.4g} {unit_of}", f"{f.gains[0]:g} / {f.gains[1]:g}",
            f"{100 * f.share_inside:.0f} %", f"{f.near_inside} of {f.near}", f"{f.inside_excess:+.1%}",
        ]
        for kind, description in LIKELIHOODS.items()
        for name, window in windows.items()
        if kind == "gains used" or name == "all"
        for f, (component, unit_of) in zip(findings(r, kind, window), COMPONENTS, strict=True)
    ]  # fmt: skip
    probability = r.main["imm"].probability
    quantiles = numpy.percentile(probability, [10, 90], axis=0)
    samples = means(probability)
    scans = (1, 2, 5, 10, 16, 20, 30, 40, 49, 50, 51, 52, 53, 54, 55, 56, 57, 58, 60, 62, 65, 66, 70, 80, 100)
    return [
        Grid(
            f"Errors along x on the paper's flight ({unit})",
            header,
            [
                *(simulated[name] for name in COMPARED_POLICIES),
                *exact[:-1],
                simulated["kalman-imm"],
                exact[-1],
                simulated["known-turn"],
                row(f"{NAMES['known-input-bound']}, exact", bound),
            ],
        ),
        Grid(
            "IMM against adaptive filters: relative change of the RMS",
            [
                "experiment",
                *(f"{w} {c}" for w in (SPAN, "turn", "recovery", "peak") for c, _ in COMPONENTS),
                "verdict on C1",
            ],
            [
                [name, *(f"{change:+.1%}" for two in c for change in two), c.verdict]
                for name, c in comparisons(r).items()
            ],
        ),
        Grid(
            "Best gains",
            [
                "reading of the covariance", "window", "component", "minimum", "at alpha_1 / alpha_2",
                "samples with the minimum in the box",
                f"cells within {100 * NEAR_MINIMUM:.0f} % that are in the box", "best in the box above the minimum",
            ],
            minima,
        ),
        Grid(
            f"Whole-run RMS on the gain grid, canonical reading ({unit})",
            ["alpha_1 \\ alpha_2", *(f"{high:g}" for high in HIGH_GAINS)],
            [
                [f"{low:g}", *(" / ".join(rms_texts(squares, WINDOWS["all"])) for squares in cells)]
                for low, cells in zip(LOW_GAINS, r.grids["gains used"], strict=True)
            ],
        ),
        Grid(
            f"Sensitivity of the IMM to what the paper leaves open ({unit})",
            header,
            [
                *(row(name, squares) for name, squares in sensitivity.items()),
                row(f"turn {LATER} scan later (windows too)", r.later["imm"], LATER),
                *(row(name, squares) for name, squares in boxed.items()),
            ],
        ),
        Grid(
            f"Adaptive filter, manoeuvre detected at a given scan, exact ({unit})",
            header,
            [row(f"detected at {k}", squares) for k, squares in r.forced.items()],
        ),
        Grid(
            "Probability of mode 1",
            ["scan", "mean", "10-90 % range over episodes"],
            [
                [str(k), f"{quantity(samples[:, k - 1]):.4f}", "{:.2f} to {:.2f}".format(*quantiles[:, k - 1])]
                for k in scans
            ],
        ),
    ]  # fmt: skip
