"""The paper's claims and open questions with verdicts, and the tables of the report."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy

from ...envs.tightly_coupled_navigation.parameters import HYPOTHESES, LINE, REST, SINGER
from ..grid import Grid
from ..quantities import Quantity, quantity
from ..reproduction import Statement, Verdict, verdict_of
from .experiment import (
    ADAPTIVE,
    CANONICAL_PSEUDORANGES,
    COMPONENTS,
    COURSES,
    MATCHED_WINDOW,
    MOTION,
    SHORT_LEG,
    SHORTEST_LEG,
    WINDOWS,
    Loss,
    Results,
    Run,
    T,
    Wait,
    loss,
    ratio,
    waits_of,
)

BAND = (0.5, 1.0)
"""Loss time in the paper, s."""
ADAPTATION = (0.01, 0.45)
"""Adaptation time in the paper, s."""
COORDINATE_LOSS = 0.10
"""Largest loss against the matched filter in the paper."""


# --- verdicts


def matched_verdict(coordinates: Sequence[Quantity], others: Sequence[Quantity]) -> Verdict:
    """Return the verdict on "at most 10 % in coordinates, the other components close".

    The ratios are of RMS errors, adaptive to matched filter.
    """
    limit = 1.0 + COORDINATE_LOSS
    if any(r.low > limit for r in coordinates):
        return "not reproduced"
    return "reproduced" if all(r.high <= limit for r in (*coordinates, *others)) else "reproduced in part"


def weight_verdict(weights: Sequence[float], ratios: Sequence[Quantity]) -> Verdict:
    """Return the verdict on "the loss comes from the weights of the other channels".

    Reproduced if the loss in coordinates vanishes (less than 0.1 %) where the other channels have less than a
    thousandth of the weight, is certain where they have most, and grows with their weight from setting to setting.
    """
    ordered = [ratios[i] for i in numpy.argsort(weights)]
    quiet = [r for w, r in zip(weights, ratios, strict=True) if w < 1e-3]
    rising = all(later.high >= earlier.low for earlier, later in pairwise(ordered))
    vanishes = bool(quiet) and all(abs(r.value - 1.0) < 1e-3 for r in quiet)
    if ordered[-1].low <= 1.0:
        return "not reproduced"
    return "reproduced" if vanishes and rising else "reproduced in part"


def in_band(found: Loss) -> bool:
    """Return whether the median time to loss of track is in the paper's band, and over 95 % of runs lose it."""
    return found.rate > 0.95 and BAND[0] <= found.median <= BAND[1]


def loss_verdict(increment: Loss, kinematic: Loss) -> Verdict:
    """Return the verdict on "the non-adaptive measurer loses track 0.5 to 1 s after the manoeuvre begins"."""
    return verdict_of([in_band(increment), in_band(kinematic)])


def adaptation_verdict(with_rates: Sequence[Wait], without: Wait) -> Verdict:
    """Return the verdict on "adaptation takes 0.01 to 0.45 s": every mean lies in this band, and they fill it.

    Reproduced if every mean lies within the band and the band is filled: one step at the lower end, and at the
    upper end at least two thirds of 0.45 s, with all sensors in use; in part if without rates only.
    """
    means = [w.mean for w in with_rates]
    inside = all(ADAPTATION[0] - 1e-9 <= mean <= ADAPTATION[1] for mean in means)
    lower = min(w.first for w in with_rates) <= ADAPTATION[0] + 1e-9
    if inside and lower and max(means) >= ADAPTATION[1] / 1.5:
        return "reproduced"
    return (
        "reproduced in part" if inside and lower and without.mean >= ADAPTATION[1] / 1.5 else "not reproduced"
    )


def stability_verdict(found: Sequence[Loss]) -> Verdict:
    """Return the verdict on "the adaptive measurer stays stable"."""
    return "reproduced" if all(f.rate == 0.0 for f in found) else "not reproduced"


# --- claims


def matched_ratios(runs: dict[str, Run]) -> list[Quantity]:
    """Return the RMS of the adaptive measurer over Singer's on Singer's motion: position, velocity, acceleration."""
    return [ratio(runs[ADAPTIVE], runs["Singer"], c, MATCHED_WINDOW) for c in range(3)]


CLAIMS = (
    Statement(
        "C1",
        "Where the motion is Singer's throughout, the matched filter is better than the adaptive measurer by at "
        "most 10 % in coordinates; the other components are close.",
        "ratio of RMS errors, adaptive to matched: {ratios}",
        f"scenario matched, {{few}} paired runs, steps {MATCHED_WINDOW[0]}-{MATCHED_WINDOW[1]}",
        lambda q: matched_verdict([m[0] for m in q.shown], [m[c] for m in q.shown for c in (1, 2)]),
    ),
    Statement(
        "C2",
        "That loss comes from the parallel channels, whose weight is near zero but not zero.",
        "mean weight of the other channels and ratio in coordinates: {by_weight}",
        "scenario matched, {few} paired runs at each setting",
        lambda q: weight_verdict(q.weights, q.coordinates),
    ),
    Statement(
        "C3",
        "The non-adaptive measurer loses track 0.5 to 1 s after the manoeuvre begins.",
        "increment: {lost[0]}; kinematic, where the accelerometers feel the manoeuvre: {lost[1]}",
        "Singer's filter as in the third channel, {few} runs, tracking loops with apertures",
        lambda q: loss_verdict(*q.lost),
    ),
    Statement(
        "C4",
        "Adaptation takes 0.01 to 0.45 s.",
        "increment, rest to constant velocity: {waits[0]}; to Singer: {waits[1]}; kinematic, rest to Singer: "
        "{waits[2]}; increment without rates, rest to constant velocity: {slow}",
        "{runs} runs; first step with a probability above one half that holds ten steps",
        lambda q: adaptation_verdict(q.waits, q.slow),
    ),
    Statement(
        "C5",
        "The adaptive measurer stays stable.",
        "{stability}",
        "{runs} runs of 3000 steps",
        lambda q: stability_verdict(q.stable),
    ),
    Statement(
        "Physics of leg 2",
        "Why is there anything to jump at step 2000, when the speed already grows by 30 m/s²?",
        "only if the accelerometers show nothing in leg 2, as if stuck at zero (increment). Where they feel it "
        "(kinematic) Singer's filter follows; RMS in leg 2, adaptive over Singer: position {excess[0]:.4f}, "
        "velocity {excess[1]:.4f}",
        "{few} paired runs",
    ),
    Statement(
        "Loss time",
        "How much does the loss time owe to the settings, of which the paper gives none?",
        "{within} of {settings} settings lose track within 0.5 to 1 s; never: {never}. Without apertures the velocity "
        "error grows to {growth}",
        f"Singer's filter, increment, {{each}} runs each, leg 1 of {SHORTEST_LEG} steps",
    ),
    Statement(
        "Room",
        "How far is the adaptive measurer from a filter that knows the hypothesis?",
        "{room}",
        "increment, {runs} and {few} runs",
    ),
)
"""The paper's claims, and questions that it leaves open."""


def quantities(r: Results) -> dict[str, Any]:
    """Return the quantities that the claims' texts contain, computed from the results, by name."""
    increment, kinematic = r.courses.values()
    adaptive, free, best = (increment[name] for name in (ADAPTIVE, "Singer, no aperture", "known mode"))
    few = len(free.nis)
    matched = {name: matched_ratios(pair) for name, pair in r.matched.items()}
    weights = {name: pair[ADAPTIVE].other_weight for name, pair in r.matched.items()}
    shown = {name: matched[name] for name in ("all sensors", "no accelerometers", CANONICAL_PSEUDORANGES)}
    lost, stable = (
        [loss(course[name], MOTION) for course in r.courses.values()] for name in ("Singer", ADAPTIVE)
    )
    settings = {name: loss(run, SHORTEST_LEG + 1) for name, run in r.settings.items()}
    paired = kinematic[ADAPTIVE].slice_runs(0, few)
    room = [
        [quantity(run.rms(c, window)) for c in range(2) for run in (adaptive, best)]
        for window in WINDOWS.values()
    ]
    return {
        "runs": len(adaptive.nis),
        "few": few,
        "each": len(r.settings["as in the experiment"].nis),
        "shown": list(shown.values()),
        "ratios": "; ".join(
            f"{name}: position {position:.4f}, velocity {velocity:.4f}, acceleration {acceleration:.4f}"
            for name, (position, velocity, acceleration) in shown.items()
        ),
        "weights": list(weights.values()),
        "coordinates": [m[0] for m in matched.values()],
        "by_weight": "; ".join(
            f"{name}: {100 * weights[name]:.2g} %, {matched[name][0]:.4f}"
            for name in sorted(matched, key=lambda name: weights[name])
        ),
        "lost": lost,
        "waits": [
            waits_of(course[ADAPTIVE], *switch)
            for course, switch in (
                (increment, (REST, LINE)),
                (increment, (LINE, SINGER)),
                (kinematic, (REST, SINGER)),
            )
        ],
        "slow": waits_of(r.waits["no rates"], REST, LINE),
        "stable": stable,
        "stability": "; ".join(f"{name}: {found}" for name, found in zip(r.courses, stable, strict=True)),
        "excess": [ratio(paired, kinematic["Singer"], c, WINDOWS["leg2"]) for c in range(2)],
        "within": sum(map(in_band, settings.values())),
        "settings": len(settings),
        "never": ", ".join(name for name, found in settings.items() if found.rate == 0.0) or "none",
        "growth": " and ".join(
            f"{free.rms(1, (k, k))[0]:.1f} m/s after {(k - MOTION + 1) * T:g} s"
            for k in (MOTION + 49, MOTION + 99)
        ),
        "room": "; ".join(
            "{}: position {} against {} m, velocity {} against {} m/s".format(leg, *values)
            for leg, values in zip(WINDOWS, room, strict=True)
        ),
    }


def tables(r: Results) -> list[Grid]:
    """Return the report's tables, such as spherical errors, mode probabilities, and times of loss."""
    header = [
        "filter",
        "leg",
        *(f"{name}, {unit}" for name, unit in COMPONENTS),
        "own sigma, m",
        "NIS / degrees",
    ]
    legs = {f"{leg} {first}-{last}": (first, last) for leg, (first, last) in WINDOWS.items()}
    errors = {
        course: [
            [
                name,
                leg,
                *(f"{quantity(run.rms(c, window))}" for c in range(len(COMPONENTS))),
                f"{numpy.sqrt(run.variance[:, window[0] - 1 : window[1]].mean()):.3f}",
                f"{run.nis[:, window[0] - 1 : window[1]].mean():.3f}",
            ]
            for name, run in runs.items()
            for leg, window in legs.items()
        ]
        for course, runs in r.courses.items()
    }
    steps = (1, 2, 5, 10, 100, 1000, 1001, 1002, 1003, 1100, 1999, 2000, 2001, 3000)
    mean = [runs[ADAPTIVE].probability.mean(axis=0) for runs in r.courses.values()]
    lost = {name: [loss(runs[name], MOTION) for runs in r.courses.values()] for name in (ADAPTIVE, "Singer")}
    lost |= {name: [loss(run, SHORT_LEG + 1) for run in runs.values()] for name, runs in r.short.items()}
    return [
        *(Grid(f"Spherical errors, {course}", header, rows) for course, rows in errors.items()),
        Grid(
            "Mean probabilities",
            ["step", *(f"{course}: {h}" for course in COURSES for h in HYPOTHESES)],
            [[str(k), *(f"{p:.4f}" for course in mean for p in course[k - 1])] for k in steps],
        ),
        Grid(
            "Loss of track after step 1001",
            ["filter", *COURSES],
            [[name, *map(str, found)] for name, found in lost.items()],
        ),
        Grid(
            "Matched motion: RMS of the adaptive measurer over that of Singer's filter",
            ["sensors", "mean weight of the other channels", *(name for name, _ in COMPONENTS[:3])],
            [
                [
                    name,
                    f"{100 * pair[ADAPTIVE].other_weight:.3g} %",
                    *(f"{m:.4f}" for m in matched_ratios(pair)),
                ]
                for name, pair in r.matched.items()
            ],
        ),
        Grid(
            "Adaptation from rest to constant velocity, increment",
            ["sensors", "time"],
            [[name, str(waits_of(run, REST, LINE))] for name, run in r.waits.items()],
        ),
        Grid(
            "Loss time of Singer's filter, increment",
            ["changed setting", "loss"],
            [[name, str(loss(run, SHORTEST_LEG + 1))] for name, run in r.settings.items()],
        ),
    ]
