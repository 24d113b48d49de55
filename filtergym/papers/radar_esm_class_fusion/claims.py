"""The paper's claims and open questions with verdicts, and the tables of the report."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy

from ...baselines.radar_esm_tracking.metrics import SURE
from ...filters import class_fusion
from ..grid import Grid
from ..quantities import Quantity, means, quantity
from ..reproduction import Statement, Verdict, verdict_if, verdict_of
from .experiment import (
    CLASSES,
    COMPONENTS,
    LATE,
    VARIANTS,
    WINDOWS,
    Results,
    exact_mean_squares,
    information_per_decision,
    parameters,
    rms,
)

CLOSE = 0.01
"""Relative excess over the ideal filter's error that counts as equal (our choice)."""
RECOGNITION_PROBABILITY = 0.99
"""Mean P(true class) after 30 s that counts as recognition within a limited time (our choice)."""
RARE = 0.05
"""Largest share of runs that end with a wrong class (our choice)."""
TYPES = ("advanced fighter", "fighter", "early warning", "missile")
SECONDS = (2, 5, 10, 20, 30, 60)


def recognition_verdict(at_30: Sequence[Quantity]) -> Verdict:
    """Return the verdict on D1: mean P(true class) at 30 s reaches ``RECOGNITION_PROBABILITY``."""
    return verdict_of(m.low >= RECOGNITION_PROBABILITY for m in at_30)


def approach_verdict(excess: Sequence[Sequence[Quantity]]) -> Verdict:
    """Return the verdict on D2: the error comes within ``CLOSE`` of the ideal filter's.

    ``excess`` is the relative excess of the RMSE of each class, at 10-30 s and after 30 s.
    """
    if all(abs(late.value) < CLOSE for _, late in excess):
        return "reproduced"
    return "reproduced in part" if any(soon.value < CLOSE for soon, _ in excess) else "not reproduced"


class Variant(NamedTuple):
    """Recognition times and error ratios in a variant of the experiment, for targets of one class."""

    recognised: float
    """Median time of the first P >= 0.9, s."""
    radar_alone: float
    gain: Quantity
    """RMSE of the acceleration at 30-60 s, non-adaptive over adaptive."""
    excess: Quantity
    """RMSE of the acceleration at 30-60 s, adaptive over ideal, minus one."""
    radar_sure: float
    """Share of runs in which the radar alone ever reaches P >= 0.9 for the true class."""


def variant(r: Results, name: str, s: int) -> Variant:
    """Return recognition time and error ratios in a variant of the experiment, for targets of one class."""
    fused, radar = r.variants[name]
    of = fused.true_class == s
    if not of.any():
        nothing = Quantity(*[math.nan] * 3)
        return Variant(math.nan, math.nan, nothing, nothing, math.nan)
    p = parameters(name)
    error = numpy.sqrt(fused.mean_square(2, LATE, of))
    fixed, ideal = (rms(exact_mean_squares(p, s, c)[2], LATE) for c in (2, s))
    return Variant(
        fused.recognition(0.5, of),
        radar.recognition(0.5, of),
        quantity(fixed / error),
        quantity(error / ideal - 1.0),
        float((radar.true_probability[of] >= SURE).any(axis=1).mean()),
    )


def _seconds(time: float) -> str:
    return f"{time:g}" if math.isfinite(time) else "later than 60"


EACH = "{r.episodes} targets of each class"
ANY = "{r.episodes} targets of any class"
CLAIMS = (
    Statement(
        "D1",
        "The class is recognised correctly within a limited time (figure 1).",
        "{recognition}",
        f"{EACH}, types drawn anew for every decision; all classes reach a mean of {RECOGNITION_PROBABILITY} at 30 s",
        lambda q: recognition_verdict(q.at_30),
    ),
    Statement(
        "D1, one type for each target",
        "The same for targets that keep their emitter type, as real ones do.",
        "sure of a wrong class at 60 s in {wrong[0]:.1%} of all runs, in {wrong[1]:.1%} of those with an ordinary "
        "fighter of class S2; the joint posterior of type and class: {joint[0]:.1%} and {joint[1]:.1%}",
        f"{ANY}, P >= {SURE} for a wrong class; more than {RARE:.0%} of the runs refutes the claim",
        lambda q: verdict_if(not q.wrong[0].low > RARE),
    ),
    Statement(
        "D2",
        "With time the accuracy approaches that of the ideal filter (figures 2-4).",
        "RMSE of the acceleration above the ideal filter's: {above_ideal}",
        f"{EACH} against the exact error of the ideal filter; within {CLOSE:.0%} after 30 s for all classes "
        "(already after 10 s: {close_soon})",
        lambda q: approach_verdict(q.excess),
    ),
    Statement(
        "D3",
        "The advantage over the non-adaptive filter is largest for the acceleration.",
        "RMSE non-adaptive / adaptive at 30-60 s, range, range rate, acceleration: {advantage}. By the filters' own "
        "deviations for S0: {own}",
        f"{EACH}; the non-adaptive filter (S2) is exact",
        lambda q: verdict_if(all(g[2].low > max(g[0].high, g[1].high) for g in q.gains)),
    ),
    Statement(
        "D4",
        "Accuracy improves for S0 and S1, and targets of all classes are tracked without interruption.",
        "improved by more than 1 % in both classes: {better}; not: {same}. Largest range error in {all_runs} runs: "
        "{worst:.1f} sigma of one measurement: no track is lost",
        f"{EACH}, 30-60 s",
        lambda q: verdict_of(q.improved),
    ),
    Statement(
        "S2 pays",
        "What does adaptation cost where the non-adaptive filter is the right one?",
        "RMSE of the adaptive filter above the non-adaptive one's on S2: range rate {price[0]:+.1%}, acceleration "
        "{price[1]:+.1%} (0.5-10 s); acceleration {price[2]:+.1%} (10-30 s)",
        "{r.episodes} targets of S2",
    ),
    Statement(
        "Who recognises",
        "How much of the recognition is the radar's, how much the ESM's?",
        "{sensors}",
        "medians; {r.small} targets of each class for one sensor alone",
    ),
    Statement(
        "Refused decisions",
        "The gate (6) refuses a tenth of the decisions about the one target. What are they worth?",
        "using them changes the mean cost by {ungated:+.2%}: with one emitter in sight the gate only throws evidence "
        "away",
        f"{ANY}, paired",
    ),
    Statement(
        "Calibration",
        "Is the algorithm exactly Bayesian under its own assumptions?",
        "mean square error over mean reported variance, range, range rate, acceleration: {calibration}",
        f"{ANY}; 1 is exact",
    ),
    Statement(
        "Open constants",
        "Do the claims depend on what the paper leaves open?",
        "gain in acceleration on S0, main experiment: {main.gain:.2f}. It needs different manoeuvre noise in the "
        "classes: with one sigma_a for all it is {common.gain:.2f}, and the radar alone reaches P >= 0.9 in "
        "{common_sure:.1f} % of the S0 runs. The alphas in reverse order leave the claims standing with a "
        "smaller gain, {order.gain:.2f}; noise on the acceleration only hardly matters, {noise.gain:.2f}; without "
        "Doppler the gain is {no_doppler.gain:.2f}, with 1 % class leakage {leak.gain:.2f}",
        "{r.small} targets of any class for each row of the table of variants",
    ),
)
"""The paper's claims, and questions that it leaves open."""


def quantities(r: Results) -> dict[str, Any]:
    """Return the quantities that the claims' texts contain, computed from the results, by name."""
    early, middle, _ = WINDOWS.values()
    printed, joint = r.fixed_type["quasi-optimal"], r.fixed_type["joint-type"]
    fighter = (printed.true_class == 2) & (printed.true_type == 1)
    at_30 = [run.true_at(30) for run in r.fused]
    excess = [[r.excess(s, 2, window) for window in (middle, LATE)] for s in range(3)]
    gains = [[r.gain(s, c, LATE) for c in range(3)] for s in (0, 1)]
    improved = [all(gain[c].low > 1.01 for gain in gains) for c in range(3)]
    better, same = (
        ", ".join(n for (n, _), i in zip(COMPONENTS, improved, strict=True) if i == x) for x in (True, False)
    )
    worst = max(float(numpy.abs(run.error[..., 0]).max()) for run in r.fused)
    gated, ungated = r.every_decision
    main, _, _, common, order, noise, _, no_doppler, leak, _ = (variant(r, name, 0) for name in VARIANTS)
    return {
        "r": r,
        "at_30": at_30,
        "recognition": "; ".join(
            f"{name}: mean P(true class) {run.true_at(10):.3f} at 10 s and {late:.3f} at 30 s, P >= 0.9 first "
            f"after {run.recognition(0.5):g} s (median), 90 % by {run.recognition(0.9):g} s"
            for name, run, late in zip(CLASSES, r.fused, at_30, strict=True)
        ),
        "wrong": (printed.sure_and_wrong(), printed.sure_and_wrong(fighter)),
        "joint": (joint.sure_and_wrong(), joint.sure_and_wrong(fighter)),
        "excess": excess,
        "above_ideal": "; ".join(
            f"{name} {soon:+.1%} (10-30 s), {late:+.1%} (30-60 s)"
            for name, (soon, late) in zip(CLASSES, excess, strict=True)
        ),
        "close_soon": ", ".join(n for n, (soon, _) in zip(CLASSES, excess, strict=True) if soon.value < CLOSE)
        or "none",
        "gains": gains,
        "advantage": "; ".join(
            f"{CLASSES[s]} {', '.join(f'{g:.2f}' for g in gain)}" for s, gain in enumerate(gains)
        ),
        "own": ", ".join(f"{math.sqrt(r.own[c, 2, -1] / r.own[c, 0, -1]):.2f}" for c in range(3)),
        "improved": improved,
        "better": better or "nothing",
        "same": same or "nothing",
        "all_runs": 3 * r.episodes,
        "worst": worst / parameters().range_sigma,
        "price": (r.excess(2, 1, early), r.excess(2, 2, early), r.excess(2, 2, middle)),
        "sensors": "; ".join(
            f"{name}: first P >= 0.9 after {_seconds(fused.recognition(0.5))} s together, "
            f"{_seconds(radar.recognition(0.5))} s by radar alone, {_seconds(esm.recognition(0.5))} s by ESM alone"
            for name, fused, radar, esm in zip(CLASSES, r.fused, r.radar, r.esm, strict=True)
        ),
        "ungated": quantity(means(ungated.cost) / means(gated.cost) - 1.0),
        "calibration": "; ".join(
            f"{name} {', '.join(f'{m:.3f}' for m in gated.calibration(window))}"
            for name, window in WINDOWS.items()
        ),
        "main": main,
        "common": common,
        "common_sure": 100 * common.radar_sure,
        "order": order,
        "noise": noise,
        "no_doppler": no_doppler,
        "leak": leak,
    }


# --- tables


def tables(r: Results) -> list[Grid]:
    """Return the report's tables, such as RMSE by class, recognition times, and variants."""
    errors = [
        [
            f"{name} {component}, {unit}",
            *(
                f"{quantity(numpy.sqrt(r.fused[s].mean_square(c, w))):.{d}f} / {rms(r.exact[s, 2][c], w):.{d}f} / "
                f"{rms(r.exact[s, s][c], w):.{d}f}"
                for w in WINDOWS.values()
            ),
        ]
        for s, name in enumerate(CLASSES)
        for c, ((component, unit), d) in enumerate(zip(COMPONENTS, (1, 2, 2), strict=True))
    ]
    last = [
        [name, *(", ".join(f"{math.sqrt(r.exact[s, c][i, -1]):.2f}" for c in range(3)) for i in range(3))]
        for s, name in enumerate(CLASSES)
    ]
    recognised = [
        [
            f"{name}, {sensors}",
            *(f"{run.true_at(t):.3f}" for t in SECONDS),
            *map(_seconds, (run.recognition(0.5), run.recognition(0.9), run.settling(0.5))),
        ]
        for name, *runs in zip(CLASSES, r.fused, r.radar, r.esm, strict=True)
        for sensors, run in zip(("both", "radar", "ESM"), runs, strict=True)
    ]
    p = parameters()
    esm = class_fusion.decision_probabilities(numpy.array(p.recognition), numpy.array(p.composition))
    one_type = []
    for s, name in enumerate(CLASSES):
        for j, (kind, share) in enumerate(zip(TYPES, p.composition[s], strict=True)):
            cells = []
            for run in r.fixed_type.values():
                of = (run.true_class == s) & (run.true_type == j)
                found = (
                    [f"{run.sure_and_wrong(of):.1%}", f"{run.true_at(60, of):.3f}"]
                    if of.any()
                    else ["-", "-"]
                )
                cells += found
            one_type.append([name, f"{kind} ({share:.0%} of the class)", *cells])
    variants = []
    for name in VARIANTS:
        cells = []
        for s in range(3):
            v = variant(r, name, s)
            cells += [
                f"{_seconds(v.recognised)} ({_seconds(v.radar_alone)})",
                f"{v.gain:.2f}",
                f"{v.excess:+.1%}",
            ]
        variants.append([name, *cells])
    times = ("first, median, s", "first, 90 % quantile, s", "for good, median, s")
    rules = (
        "printed rule: sure and wrong",
        "mean P(true class)",
        "joint posterior: sure and wrong",
        "mean P(true class)",
    )
    return [
        Grid(
            "RMSE: adaptive / non-adaptive, exact / ideal, exact", ["class and component", *WINDOWS], errors
        ),
        Grid(
            "Exact error at 60 s of the filters for S0, S1, S2",
            ["true class", *(f"{component}, {unit}" for component, unit in COMPONENTS)],
            last,
        ),
        Grid(
            "Recognition: mean P(true class), and times of P(true class) >= 0.9",
            ["class, sensors", *(f"{t} s" for t in SECONDS), *times],
            recognised,
        ),
        Grid(
            "Information of one ESM decision, nats",
            ["true class", *(f"against {name}" for name in CLASSES)],
            [
                [name, *(f"{x:.2f}" for x in row)]
                for name, row in zip(CLASSES, information_per_decision(esm), strict=True)
            ],
        ),
        Grid("One type for each target, at 60 s", ["class", "type", *rules], one_type),
        Grid(
            "Variants: median time of first P(true class) >= 0.9 (radar alone), s; acceleration RMSE at 30-60 s, "
            "non-adaptive / adaptive; adaptive over ideal",
            ["variant", *(f"{name}: {what}" for name in CLASSES for what in ("time", "gain", "excess"))],
            variants,
        ),
    ]
