"""The multi-hypothesis measurer of an inertial-satellite system (Moroz): figures 1 and 2, the claims.

The paper shows two figures and prints few numbers; it gives neither the step nor any noise. Its text is read
in two ways (see the task's module): ``increment``, scenario ``paper``, where the velocity grows while the
accelerometers show nothing, and ``kinematic``, where they feel the acceleration. Every filter of one
experiment faces the same noise; intervals are bootstraps over runs.

Reading: "spherical error" is the three-dimensional root-mean-square error.
Reading: "loss of track" is not defined; here the first of ten steps in a row on which a pseudorange rate is
further from the combined prediction than a frequency discriminator sees (9.36 m/s), with tracking loops that
are steered by that prediction (``aperture``).
Reading: "without rates", "pseudoranges only": the standard deviation of what is left out is 10^6 of its unit.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy

from ...envs.catalogue import make_task
from ...envs.task import Task
from ...envs.tightly_coupled_navigation.parameters import HYPOTHESES, LINE, REST, SINGER
from ...envs.tightly_coupled_navigation.task import TightlyCoupledNavigation
from ...filters import gnss_ins, imm
from ..bootstrap import Bootstrap, Estimate
from ..figures import styles
from ..policy import Policy
from ..reproduction import Claim, Grid, Reproduction, Verdict, episode_count
from ..rollout import run_policy, run_reference
from ..seeds import episode_seeds
from .metrics import lasting, switches
from .policies import chain
from .references import KnownMode

TITLE = "Adaptive multi-hypothesis algorithm of an inertial-satellite navigation system"
EPISODES = 100
FEW = 40
"""Runs of the comparators."""
SCATTER = 32
"""Runs at each setting of the sensitivity study."""
SEED = 0
RESAMPLES = 400
T = 0.01
NOTHING = 1e6
"""Standard deviation of a sensor that is left out, in its unit."""

ADAPTIVE = "adaptive"
FILTERS: dict[str, int | None] = {
    ADAPTIVE: None,
    "rest": REST,
    "constant velocity": LINE,
    "Singer": SINGER,
}
WINDOWS = TightlyCoupledNavigation.scenarios["paper"].windows
MOTION = 1001
"""First step that carries the motion of leg 2."""
JUMP = 2000
"""Step on which leg 3 begins."""
SHORT_LEG = 300
"""Length of leg 1 where only what follows matters; the filters are steady by then."""
SHORTEST_LEG = 150

BAND = (0.5, 1.0)
"""Loss time in the paper, s."""
ADAPTATION = (0.01, 0.45)
"""Adaptation time in the paper, s."""
COORDINATE_LOSS = 0.10
"""Largest loss against the matched filter in the paper."""

MATCHED: dict[str, dict[str, Any]] = {
    "all sensors": {},
    "no accelerometers": {"accelerometer_sigma": NOTHING},
    "pseudoranges only, stay 0.9998": {"transition": chain(0.9998)},
    "pseudoranges only, stay 0.998": {},
    "pseudoranges only, stay 0.98": {"transition": chain(0.98)},
}
for _name, _keywords in MATCHED.items():
    if _name.startswith("pseudoranges"):
        _keywords |= {"rate_sigma": NOTHING, "accelerometer_sigma": NOTHING}
CANONICAL_PSEUDORANGES = "pseudoranges only, stay 0.998"
MATCHED_STEPS = 1200
MATCHED_WINDOW = (200, MATCHED_STEPS)

LEAST = 0.01
"""Weight, %, as which smaller ones are drawn."""

WAITS: dict[str, dict[str, Any]] = {
    "rates, 0.1 m/s": {},
    "rates, 0.3 m/s": {"rate_sigma": 0.3},
    "rates, 1 m/s": {"rate_sigma": 1.0},
    "no rates": {"rate_sigma": NOTHING},
}

SETTINGS: dict[str, dict[str, Any]] = {
    "as in the experiment": {},
    "aperture 5 m/s": {"rate_aperture": 5.0},
    "aperture 12 m/s": {"rate_aperture": 12.0},
    "aperture 15 m/s": {"rate_aperture": 15.0},
    "accelerometer 0.03 m/s²": {"accelerometer_sigma": 0.03},
    "accelerometer 0.1 m/s²": {"accelerometer_sigma": 0.1},
    "accelerometer 0.2 m/s²": {"accelerometer_sigma": 0.2},
    "manoeuvre 2 m/s²": {"singer_sigma": 2.0},
    "manoeuvre 9 m/s²": {"singer_sigma": 9.0},
    "manoeuvre 36 m/s²": {"singer_sigma": 36.0},
    "rate 0.05 m/s": {"rate_sigma": 0.05},
    "rate 0.3 m/s": {"rate_sigma": 0.3},
    "rate 1 m/s": {"rate_sigma": 1.0},
}

STEPS = 4 + len(MATCHED) + len(WAITS) + 4 + len(SETTINGS)


# --- experiments


class Run(NamedTuple):
    """One filter over E runs of K steps."""

    squares: numpy.ndarray
    """Squared spherical errors of position, velocity, acceleration, attitude, and squared errors of clock
    bias and drift, ``(6, E, K)``."""
    variance: numpy.ndarray
    """Of the position, as reported, ``(E, K)``, m^2."""
    probability: numpy.ndarray
    """``(E, K, 3)``."""
    true_mode: numpy.ndarray
    """``(E, K)``."""
    outside: numpy.ndarray
    """Whether a rate is outside its aperture, ``(E, K)``."""
    nis: numpy.ndarray
    """Over its degrees of freedom, ``(E, K)``."""


COMPONENTS = (
    ("position", "m"), ("velocity", "m/s"), ("acceleration", "m/s²"), ("attitude", "rad"), ("clock bias", "m"),
    ("clock drift", "m/s"),
)  # fmt: skip
PARTS = (
    gnss_ins.POSITION, gnss_ins.VELOCITY, gnss_ins.ACCELERATION, gnss_ins.ATTITUDE_ERROR,
    slice(gnss_ins.CLOCK_BIAS, gnss_ins.CLOCK_BIAS + 1), slice(gnss_ins.CLOCK_DRIFT, gnss_ins.CLOCK_DRIFT + 1),
)  # fmt: skip


class _SideBySide(Policy):
    """Several filters in one batch: the paper's probabilities in some lanes, one hypothesis in others."""

    control = "weights"

    def __init__(self, task: Task, lanes: Sequence[int | None]) -> None:
        super().__init__(task)
        self.log_likelihood, self.log_predicted = task.reader("log_likelihood"), task.reader("log_predicted")
        self.fixed = numpy.array([lane is not None for lane in lanes])
        self.weights = numpy.array([numpy.eye(len(HYPOTHESES))[lane or 0] for lane in lanes])

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """State posterior probabilities, or certainty."""
        posterior = imm.mode_posterior(
            self.log_predicted(observation).T, self.log_likelihood(observation).T
        ).T
        return numpy.where(self.fixed[:, None], self.weights, posterior), None


def simulate(scenario: str, filters: Mapping[str, int], **keywords: Any) -> dict[str, Run]:
    """Run several filters side by side on the same noise.

    Args:
        scenario: of the environment.
        filters: names of ``FILTERS``, or "known mode", which runs alone, and how many runs each has.
        **keywords: parameters of the task.
    """
    task: Any = make_task(TightlyCoupledNavigation.id, "weights", scenario, **keywords)
    seeds = [seed for count in filters.values() for seed in episode_seeds("test", SEED, count)]
    known = _Watched(task)
    judge = task.estimated_outside() if "known mode" in filters else task
    kept: list[tuple[numpy.ndarray, ...]] = []

    def record(episode: Any) -> None:
        squares = judge.error(episode)[:, : len(seeds)] ** 2
        P = judge.covariance(episode)
        records = judge.records(episode)
        true_mode = records["true_mode"]
        if judge is not task:
            # It believes the truth; nothing but apertures takes a rate away here.
            available = episode.measurement.available
            records["mode_probability"] = numpy.eye(len(HYPOTHESES))[true_mode].T
            records["rate_outside_aperture"] = 1.0 - available[task.sensors[1].readings].min(axis=0)
            records["nis"], records["nis_degrees"] = known.nis, available.sum(axis=0)
        kept.append(
            (
                numpy.stack([squares[part].sum(axis=0) for part in PARTS]),
                (P[0, 0] + P[1, 1] + P[2, 2])[: len(seeds)],
                records["mode_probability"][:, : len(seeds)],
                true_mode[: len(seeds)],
                records["rate_outside_aperture"][: len(seeds)] > 0.0,
                (records["nis"] / records["nis_degrees"])[: len(seeds)],
            )
        )

    if judge is not task:
        run_reference(task, known, seeds, record, lambda _: None)
    else:
        lanes = [FILTERS[name] for name, count in filters.items() for _ in range(count)]
        run_policy(task, _SideBySide(task, lanes), seeds, record, lambda _: None)
    # The runs come last in every record; here they stand before time.
    series = [numpy.stack(values, axis=-1) for values in zip(*kept, strict=True)]
    series[2] = numpy.moveaxis(series[2], 0, -1)
    runs, first = {}, 0
    for name, count in filters.items():
        lanes_of = slice(first, first + count)
        squares, *others = series
        runs[name] = Run(squares[:, lanes_of], *(s[lanes_of] for s in others))
        first += count
    return runs


class _Watched(KnownMode):
    """The reference, whose normalised innovation squared can be read from outside."""

    nis: Any = None

    def update(self, measurement: Any, truth: Any, memory: Any) -> tuple[Any, Any, Any]:
        """Keep it."""
        mean, covariance, track = super().update(measurement, truth, memory)
        self.nis = track.nis
        return mean, covariance, track


class Results(NamedTuple):
    """Everything that claims, tables and figures are made of."""

    increment: dict[str, Run]
    """Filters on scenario ``paper``; "Singer, no aperture" and "known mode" too."""
    kinematic: dict[str, Run]
    matched: dict[str, dict[str, Run]]
    waits: dict[str, Run]
    short: dict[tuple[str, str], Run]
    """Course and filter; leg 1 is short."""
    settings: dict[str, Run]


def run_everything(progress: Callable[[float], None], episodes: int) -> Results:
    """All experiments."""
    few, scatter = min(FEW, episodes), min(SCATTER, episodes)

    def done(value: Any) -> Any:
        progress(1)
        return value

    both = {ADAPTIVE: episodes, "Singer": few}
    increment = done(simulate("paper", both))
    kinematic = done(simulate("kinematic", both))
    increment["Singer, no aperture"] = done(simulate("paper", {"Singer": few}, aperture=False))["Singer"]
    increment |= done(simulate("paper", {"known mode": few}))
    matched = {
        name: done(simulate("matched", {ADAPTIVE: few, "Singer": few}, horizon=MATCHED_STEPS, **keywords))
        for name, keywords in MATCHED.items()
    }
    waits = {
        name: done(simulate("paper", {ADAPTIVE: episodes}, horizon=MOTION + 99, **keywords))[ADAPTIVE]
        for name, keywords in WAITS.items()
    }
    short: dict[tuple[str, str], Run] = {}
    legs = {"leg_steps": (SHORT_LEG, SHORT_LEG + 1000), "horizon": SHORT_LEG + 200}
    for course, scenario in (("increment", "paper"), ("kinematic", "kinematic")):
        runs = done(simulate(scenario, {"rest": few, "constant velocity": few}, **legs))
        short |= {(course, name): run for name, run in runs.items()}
        run = done(simulate(scenario, {"Singer": few}, accelerometer_sigma=NOTHING, **legs))["Singer"]
        short[course, "Singer without accelerometers"] = run
    legs = {"leg_steps": (SHORTEST_LEG, SHORTEST_LEG + 1000), "horizon": SHORTEST_LEG + 160}
    settings = {
        name: done(simulate("paper", {"Singer": scatter}, **{**legs, **keywords}))["Singer"]
        for name, keywords in SETTINGS.items()
    }
    return Results(increment, kinematic, matched, waits, short, settings)


# --- statistics


def bootstrap_of(run: Run) -> Bootstrap:
    """Resampling of the runs of a filter."""
    return Bootstrap(run.nis.shape[0], RESAMPLES)


def rms(run: Run, component: int, window: tuple[int, int]) -> numpy.ndarray:
    """Root of the mean square over runs and the steps of a window, and of every resample of the runs."""
    values = run.squares[component][:, window[0] - 1 : window[1]].mean(axis=1)
    return numpy.sqrt(bootstrap_of(run).means(values))


def ratio(ours: Run, theirs: Run, component: int, window: tuple[int, int]) -> Estimate:
    """Ratio of RMS errors, paired."""
    return bootstrap_of(ours).interval(rms(ours, component, window) / rms(theirs, component, window))


class Loss(NamedTuple):
    """How many tracks are lost, and when."""

    rate: float
    median: float
    """Seconds from the first step of the motion, of the tracks lost; NaN where none is."""
    first: float
    last: float


def loss(run: Run, motion: int) -> Loss:
    """Loss of track after the motion that begins on a step."""
    outside = lasting(run.outside[:, motion - 1 :])
    lost = outside.any(axis=1)
    if not lost.any():
        return Loss(0.0, numpy.nan, numpy.nan, numpy.nan)
    time = (outside.argmax(axis=1)[lost] + 1) * T
    return Loss(float(lost.mean()), float(numpy.median(time)), float(time.min()), float(time.max()))


class Wait(NamedTuple):
    """Seconds until a change of motion is believed."""

    mean: float
    first: float
    last: float
    never: int
    """Runs in which it is not."""
    samples: numpy.ndarray


def waits_of(run: Run, before: int, after: int) -> Wait:
    """Adaptation times of one kind of switch."""
    found = [
        s.wait * T for s in switches(run.true_mode, run.probability) if (s.before, s.after) == (before, after)
    ]
    finite = numpy.array([w for w in found if numpy.isfinite(w)])
    if not len(finite):
        return Wait(numpy.nan, numpy.nan, numpy.nan, len(found), finite)
    return Wait(
        float(finite.mean()), float(finite.min()), float(finite.max()), len(found) - len(finite), finite
    )


def with_error(samples: numpy.ndarray) -> str:
    """Value and bootstrap standard error: ``0.367 ± 0.014``."""
    error = float(samples[1:].std())
    digits = max(0, 1 - int(numpy.floor(numpy.log10(error)))) if error > 0.0 else 4
    return f"{samples[0]:.{digits}f} ± {error:.{digits}f}"


def loss_text(found: Loss) -> str:
    """Rate, median and range in words."""
    if found.rate == 0.0:
        return "no track lost"
    return (
        f"{100 * found.rate:.0f} % lost, median {found.median:.2f} s ({found.first:.2f} to {found.last:.2f})"
    )


def wait_text(found: Wait) -> str:
    """Mean and range in words."""
    never = f", {found.never} never" if found.never else ""
    if not len(found.samples):
        return f"{found.never} never"
    return f"mean {found.mean:.3f} s ({found.first:.2f} to {found.last:.2f}{never})"


# --- verdicts


def matched_verdict(coordinates: Sequence[Estimate], others: Sequence[Estimate]) -> Verdict:
    """Verdict on "at most 10 % in coordinates, the other components close".

    Args:
        coordinates: ratios of the RMS position error, adaptive to matched.
        others: ratios of other components; close is within the same 10 %.
    """
    limit = 1.0 + COORDINATE_LOSS
    if any(r.low > limit for r in coordinates):
        return "not reproduced"
    if all(r.high <= limit for r in (*coordinates, *others)):
        return "reproduced"
    return "reproduced in part"


def weight_verdict(weights: Sequence[float], ratios: Sequence[Estimate]) -> Verdict:
    """Verdict on "the loss comes from the weights of the other channels".

    Reproduced if the loss in coordinates vanishes (less than 0.1 %) where the other channels have less than a
    thousandth of the weight, is certain where they have most, and the settings come in the same order by
    weight and by loss.
    """
    order = numpy.argsort(weights)
    ordered = [ratios[i] for i in order]
    quiet = [r for w, r in zip(weights, ratios, strict=True) if w < 1e-3]
    rising = all(later.high >= earlier.low for earlier, later in pairwise(ordered))
    vanishes = bool(quiet) and all(abs(r.value - 1.0) < 1e-3 for r in quiet)
    if vanishes and rising and ordered[-1].low > 1.0:
        return "reproduced"
    return "reproduced in part" if ordered[-1].low > 1.0 else "not reproduced"


def loss_verdict(increment: Loss, kinematic: Loss) -> Verdict:
    """Verdict on "the non-adaptive measurer loses track 0.5 to 1 s after the manoeuvre begins"."""
    good = [found.rate > 0.95 and BAND[0] <= found.median <= BAND[1] for found in (increment, kinematic)]
    return "reproduced" if all(good) else "reproduced in part" if any(good) else "not reproduced"


def adaptation_verdict(with_rates: Sequence[Wait], without: Wait) -> Verdict:
    """Verdict on "adaptation takes 0.01 to 0.45 s".

    Reproduced if every mean lies within the band and the band is filled: one step at the lower end, and at the
    upper end at least two thirds of 0.45 s, with all sensors in use.
    """
    means = [w.mean for w in with_rates]
    inside = all(ADAPTATION[0] - 1e-9 <= mean <= ADAPTATION[1] for mean in means)
    lower = min(w.first for w in with_rates) <= ADAPTATION[0] + 1e-9
    upper = max(means) >= ADAPTATION[1] / 1.5
    if inside and lower and upper:
        return "reproduced"
    slow = without.mean >= ADAPTATION[1] / 1.5
    return "reproduced in part" if inside and lower and slow else "not reproduced"


def stability_verdict(found: Sequence[Loss]) -> Verdict:
    """Verdict on "the adaptive measurer stays stable"."""
    return "reproduced" if all(f.rate == 0.0 for f in found) else "not reproduced"


# --- claims


def claims(r: Results) -> list[Claim]:
    """The paper's claims, and what it is silent about."""
    adaptive, singer = r.increment[ADAPTIVE], r.increment["Singer"]
    runs, few = len(adaptive.nis), len(singer.nis)
    window = MATCHED_WINDOW
    matched = {
        name: [ratio(pair[ADAPTIVE], pair["Singer"], c, window) for c in range(3)]
        for name, pair in r.matched.items()
    }
    weights = {name: other_weight(pair[ADAPTIVE]) for name, pair in r.matched.items()}
    shown = ("all sensors", "no accelerometers", CANONICAL_PSEUDORANGES)
    ratios = "; ".join(
        f"{name}: position {_ratio_text(matched[name][0])}, velocity {_ratio_text(matched[name][1])}, "
        f"acceleration {_ratio_text(matched[name][2])}"
        for name in shown
    )
    by_weight = sorted(MATCHED, key=lambda name: weights[name])
    lost = {"increment": loss(singer, MOTION), "kinematic": loss(r.kinematic["Singer"], MOTION)}
    stable = {
        "increment": loss(adaptive, MOTION),
        "kinematic": loss(r.kinematic[ADAPTIVE], MOTION),
    }
    first, second = waits_of(adaptive, REST, LINE), waits_of(adaptive, LINE, SINGER)
    third = waits_of(r.kinematic[ADAPTIVE], REST, SINGER)
    slow = {name: waits_of(run, REST, LINE) for name, run in r.waits.items()}
    settings = {name: loss(run, SHORTEST_LEG + 1) for name, run in r.settings.items()}
    within = [n for n, s in settings.items() if s.rate > 0.95 and BAND[0] <= s.median <= BAND[1]]
    never = [name for name, found in settings.items() if found.rate == 0.0]
    half, whole = MOTION + 49, MOTION + 99
    free = r.increment["Singer, no aperture"]
    same = r.kinematic[ADAPTIVE]
    same = Run(same.squares[:, :few], *(series[:few] for series in same[1:]))
    excess = [ratio(same, r.kinematic["Singer"], c, WINDOWS["leg2"]) for c in range(2)]
    growth = [f"{rms(free, 1, (k, k))[0]:.1f} m/s after {(k - MOTION + 1) * T:g} s" for k in (half, whole)]
    best = r.increment["known mode"]
    silent: Verdict = "paper is silent"
    return [
        Claim(
            "C1",
            "Where the motion is Singer's throughout, the matched filter is better than the adaptive measurer "
            "by at most 10 % in coordinates; the other components are close.",
            f"ratio of RMS errors, adaptive to matched: {ratios}",
            f"scenario matched, {few} paired runs, steps {window[0]}-{window[1]}",
            matched_verdict([matched[n][0] for n in shown], [matched[n][c] for n in shown for c in (1, 2)]),
        ),
        Claim(
            "C2",
            "That loss comes from the parallel channels, whose weight is near zero but not zero.",
            "mean weight of the other channels and ratio in coordinates: "
            + "; ".join(
                f"{name}: {100 * weights[name]:.2g} %, {_ratio_text(matched[name][0])}" for name in by_weight
            ),
            f"scenario matched, {few} paired runs at each setting",
            weight_verdict([weights[n] for n in MATCHED], [matched[n][0] for n in MATCHED]),
        ),
        Claim(
            "C3",
            "The non-adaptive measurer loses track 0.5 to 1 s after the manoeuvre begins.",
            f"increment: {loss_text(lost['increment'])}; kinematic, where the accelerometers feel the "
            f"manoeuvre: {loss_text(lost['kinematic'])}",
            f"Singer's filter as in the third channel, {few} runs, tracking loops with apertures",
            loss_verdict(lost["increment"], lost["kinematic"]),
        ),
        Claim(
            "C4",
            "Adaptation takes 0.01 to 0.45 s.",
            f"increment, rest to constant velocity: {wait_text(first)}; to Singer: {wait_text(second)}; "
            f"kinematic, rest to Singer: {wait_text(third)}; increment without rates, rest to constant "
            f"velocity: {wait_text(slow['no rates'])}",
            f"{runs} runs; first step with a probability above one half that holds ten steps",
            adaptation_verdict([first, second, third], slow["no rates"]),
        ),
        Claim(
            "C5",
            "The adaptive measurer stays stable.",
            "; ".join(f"{name}: {loss_text(found)}" for name, found in stable.items()),
            f"{runs} runs of 3000 steps",
            stability_verdict(list(stable.values())),
        ),
        Claim(
            "Physics of leg 2",
            "Why is there anything to jump at step 2000, when the speed already grows by 30 m/s²?",
            "only if the accelerometers show nothing in leg 2, as if stuck at zero (increment). Where they feel "
            "it (kinematic) Singer's filter follows; RMS in leg 2, adaptive over Singer: position "
            f"{_ratio_text(excess[0])}, velocity {_ratio_text(excess[1])}",
            f"{few} paired runs",
            silent,
        ),
        Claim(
            "Loss time",
            "How much does the loss time owe to the settings, of which the paper gives none?",
            f"{len(within)} of {len(settings)} settings lose track within 0.5 to 1 s; never: "
            f"{', '.join(never) or 'none'}. Without apertures the velocity error grows to {' and '.join(growth)}",
            f"Singer's filter, increment, {len(next(iter(r.settings.values())).nis)} runs each, leg 1 of "
            f"{SHORTEST_LEG} steps",
            silent,
        ),
        Claim(
            "Room",
            "How far is the adaptive measurer from a filter that knows the hypothesis?",
            "; ".join(
                f"{leg}: position {with_error(rms(adaptive, 0, w))} against {with_error(rms(best, 0, w))} m, "
                f"velocity {with_error(rms(adaptive, 1, w))} against {with_error(rms(best, 1, w))} m/s"
                for leg, w in WINDOWS.items()
            ),
            f"increment, {runs} and {few} runs",
            silent,
        ),
    ]


def other_weight(run: Run) -> float:
    """Mean probability of the two hypotheses that are not Singer's."""
    return float(1.0 - run.probability[:, MATCHED_WINDOW[0] - 1 :, SINGER].mean())


def _ratio_text(found: Estimate) -> str:
    return f"{found.value:.4f} [{found.low:.4f}, {found.high:.4f}]"


# --- tables


def tables(r: Results) -> list[Grid]:
    """Tables of the report; ± is one bootstrap standard error over runs."""
    header = [
        "filter",
        "leg",
        *(f"{name}, {unit}" for name, unit in COMPONENTS),
        "own sigma, m",
        "NIS / degrees",
    ]

    def rows(runs: Mapping[str, Run]) -> list[list[str]]:
        table = []
        for name, run in runs.items():
            for leg, window in WINDOWS.items():
                steps = slice(window[0] - 1, window[1])
                table.append(
                    [
                        name,
                        f"{leg} {window[0]}-{window[1]}",
                        *(with_error(rms(run, c, window)) for c in range(len(COMPONENTS))),
                        f"{numpy.sqrt(run.variance[:, steps].mean()):.3f}",
                        f"{run.nis[:, steps].mean():.3f}",
                    ]
                )
        return table

    steps = (1, 2, 5, 10, 100, 1000, 1001, 1002, 1003, 1100, 1999, 2000, 2001, 3000)
    probabilities = []
    for k in steps:
        cells = [str(k)]
        for run in (r.increment[ADAPTIVE], r.kinematic[ADAPTIVE]):
            cells += [f"{p:.4f}" for p in run.probability[:, k - 1].mean(axis=0)]
        probabilities.append(cells)
    losses = [
        ["adaptive", *(loss_text(loss(runs[ADAPTIVE], MOTION)) for runs in (r.increment, r.kinematic))],
        ["Singer", *(loss_text(loss(runs["Singer"], MOTION)) for runs in (r.increment, r.kinematic))],
    ]
    losses += [
        [
            name,
            *(loss_text(loss(r.short[course, name], SHORT_LEG + 1)) for course in ("increment", "kinematic")),
        ]
        for name in ("Singer without accelerometers", "constant velocity", "rest")
    ]
    matched = [
        [
            name,
            f"{100 * other_weight(pair[ADAPTIVE]):.3g} %",
            *(_ratio_text(ratio(pair[ADAPTIVE], pair["Singer"], c, MATCHED_WINDOW)) for c in range(3)),
        ]
        for name, pair in r.matched.items()
    ]
    waits = [[name, wait_text(waits_of(run, REST, LINE))] for name, run in r.waits.items()]
    settings = [[name, loss_text(loss(run, SHORTEST_LEG + 1))] for name, run in r.settings.items()]
    return [
        Grid("Spherical errors, increment", header, rows(r.increment)),
        Grid("Spherical errors, kinematic", header, rows(r.kinematic)),
        Grid(
            "Mean probabilities",
            ["step", *(f"{course}: {h}" for course in ("increment", "kinematic") for h in HYPOTHESES)],
            probabilities,
        ),
        Grid("Loss of track after step 1001", ["filter", "increment", "kinematic"], losses),
        Grid(
            "Matched motion: RMS of the adaptive measurer over that of Singer's filter, 95 % interval",
            ["sensors", "mean weight of the other channels", *(f"{name}" for name, _ in COMPONENTS[:3])],
            matched,
        ),
        Grid("Adaptation from rest to constant velocity, increment", ["sensors", "time"], waits),
        Grid("Loss time of Singer's filter, increment", ["changed setting", "loss"], settings),
    ]


# --- figures


def _figure(rows: int, columns: int, size: tuple[float, float], **keywords: Any) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **keywords)


def draw_errors(r: Results) -> Any:
    """Figure 1: spherical errors of coordinates and of velocity against the step."""
    figure, grid = _figure(2, 2, (11.0, 6.4), sharex=True, sharey="row")
    names = {
        ADAPTIVE: "adaptive",
        "Singer": "non-adaptive (Singer)",
        "Singer, no aperture": "the same, apertures off",
    }
    dashes = ("-", "--", ":")
    for column, (title, runs) in enumerate((("increment", r.increment), ("kinematic", r.kinematic))):
        for c, axis in enumerate(grid[:, column]):
            for (name, label), style, dash in zip(
                names.items(), styles(list(names)).values(), dashes, strict=True
            ):
                if name not in runs:
                    continue
                values = numpy.sqrt(bootstrap_of(runs[name]).means(runs[name].squares[c]))
                low, high = numpy.percentile(values[1:], [2.5, 97.5], axis=0)
                k = numpy.arange(1, values.shape[1] + 1)
                axis.plot(k, values[0], label=label, **(style | {"linestyle": dash, "linewidth": 1.2}))
                axis.fill_between(k, low, high, color=style["color"], alpha=0.25, lw=0)
            for step in (MOTION, JUMP):
                axis.axvline(step, color="0.4", lw=0.7, ls=(0, (1, 2)))
            axis.set_yscale("log")
            axis.yaxis.set_major_formatter("{x:g}")
            axis.grid(alpha=0.25, lw=0.4)
            axis.margins(x=0.01)
        grid[0, column].set_title(title, fontsize=10)
        grid[1, column].set_xlabel("step")
    for axis, (component, unit) in zip(grid[:, 0], COMPONENTS[:2], strict=True):
        axis.set_ylabel(f"spherical error of {component}, {unit}")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def draw_probabilities(r: Results) -> Any:
    """Figure 2: probabilities of the hypotheses against the step, with close-ups of both changes."""
    figure, grid = _figure(2, 3, (11.0, 5.4), sharey=True, width_ratios=(2.0, 1.0, 1.0))
    style = styles(list(HYPOTHESES))
    dashes = ("-", "--", "-.")
    spans = ((1, 3000), (MOTION - 6, MOTION + 10), (JUMP - 6, JUMP + 10))
    for row, (title, runs) in enumerate((("increment", r.increment), ("kinematic", r.kinematic))):
        probability = runs[ADAPTIVE].probability
        for i, (name, dash) in enumerate(zip(HYPOTHESES, dashes, strict=True)):
            means = bootstrap_of(runs[ADAPTIVE]).means(probability[:, :, i])
            low, high = numpy.percentile(means[1:], [2.5, 97.5], axis=0)
            k = numpy.arange(1, means.shape[1] + 1)
            for column, (axis, (first, last)) in enumerate(zip(grid[row], spans, strict=True)):
                shown = slice(first - 1, last)
                drawn = style[name] | {"linestyle": dash}
                if column:
                    drawn |= {"marker": "o", "markersize": 3.0}
                axis.plot(
                    k[shown],
                    means[0][shown],
                    label=name.replace("-", " ").replace("singer", "Singer"),
                    **drawn,
                )
                axis.fill_between(k[shown], low[shown], high[shown], color=drawn["color"], alpha=0.25, lw=0)
                axis.set_xlim(first - 0.5, last + 0.5)
                axis.set_ylim(-0.03, 1.03)
                axis.grid(alpha=0.25, lw=0.4)
                axis.set_xlabel("step" if row else "")
        grid[row, 0].set_ylabel(f"{title}\nmean probability")
    for axis, what in zip(grid[0], ("whole run", "leg 2 begins", "leg 3 begins"), strict=True):
        axis.set_title(what, fontsize=10)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def draw_loss_times(r: Results) -> Any:
    """Loss time of Singer's filter at every setting, with the band of the paper."""
    figure, grid = _figure(1, 1, (8.0, 4.6))
    axis = grid[0, 0]
    names = list(r.settings)
    colours = [style["color"] for style in styles(["lost", "kept"]).values()]
    axis.axvspan(*BAND, color="0.92", zorder=0, lw=0)
    axis.text(0.75, 1.01, "paper", transform=axis.get_xaxis_transform(), ha="center", va="bottom", fontsize=8)
    for place, name in enumerate(names):
        found = loss(r.settings[name], SHORTEST_LEG + 1)
        if found.rate == 0.0:
            axis.text(1.58, place, "no track lost", ha="right", va="center", fontsize=8, color=colours[1])
            continue
        axis.plot([found.first, found.last], [place, place], color=colours[0], lw=2.0)
        axis.plot([found.median], [place], "o", color=colours[0], ms=5)
        if found.rate < 1.0:
            axis.text(found.last + 0.02, place, f"{100 * found.rate:.0f} % lost", va="center", fontsize=8)
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlim(0.0, 1.6)
    axis.set_xlabel("time from the first motion to the loss of track, s: median and range over runs")
    axis.grid(alpha=0.25, lw=0.4, axis="x")
    return figure


def draw_matched(r: Results) -> Any:
    """Loss against the matched filter over the mean weight of the other channels."""
    figure, grid = _figure(1, 1, (8.0, 4.4))
    axis = grid[0, 0]
    names = [name for name, _ in COMPONENTS[:3]]
    for c, (name, style, marker) in enumerate(zip(names, styles(names).values(), "os^", strict=True)):
        for j, pair in enumerate(r.matched.values()):
            found = ratio(pair[ADAPTIVE], pair["Singer"], c, MATCHED_WINDOW)
            value, low, high = (100.0 * (x - 1.0) for x in found)
            axis.errorbar(
                max(100.0 * other_weight(pair[ADAPTIVE]), LEAST) * 1.08 ** (c - 1),
                value,
                [[max(value - low, 0.0)], [max(high - value, 0.0)]],
                color=style["color"],
                marker=marker,
                ms=5,
                capsize=2,
                linestyle="",
                label=name if j == 0 else None,
            )
    axis.axhline(100.0 * COORDINATE_LOSS, color="0.4", lw=0.8, ls="--")
    axis.text(
        0.02,
        108.0 * COORDINATE_LOSS,
        "paper: at most 10 % in position",
        transform=axis.get_yaxis_transform(),
        fontsize=8,
        va="bottom",
    )
    axis.set_xscale("log")
    axis.set_yscale("symlog", linthresh=0.1)
    axis.set_ylim(-0.03, 1500.0)
    axis.yaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.set_xlabel(f"mean weight of the other two channels, % ({LEAST:g} stands for less)")
    axis.set_ylabel("RMS above that of the matched filter, %")
    axis.grid(alpha=0.25, lw=0.4)
    axis.legend(fontsize=9, frameon=False, loc="upper left")
    return figure


def reproduce(progress: Callable[[float], None], episodes: int | None = None) -> Reproduction:
    """Run the paper's experiment and give a verdict on each of its claims.

    Args:
        progress: called with the units of work done, ``STEPS`` in all.
        episodes: Monte Carlo runs of the adaptive measurer; default: ``EPISODES``. Comparators have at most
            ``FEW``, settings of the sensitivity study at most ``SCATTER``.

    Raises:
        ValueError: for fewer than two episodes, which have no interval.
    """
    count = episode_count(episodes, EPISODES)
    r = run_everything(progress, count)
    figures = {
        "figure_1_errors": draw_errors(r),
        "figure_2_probabilities": draw_probabilities(r),
        "loss_times": draw_loss_times(r),
        "matched": draw_matched(r),
    }
    captions = {
        "figure_1_errors": f"Figure 1: spherical errors over {count} runs (non-adaptive: {min(FEW, count)}), 95 % "
        "bands; dotted lines: the motion begins, and changes.",
        "figure_2_probabilities": f"Figure 2: mean probabilities over {count} runs, 95 % bands.",
        "loss_times": "When Singer's filter loses track in the increment variant, one setting changed at a time, "
        "within 1.6 s; grey: the paper's 0.5 to 1 s.",
        "matched": "What the parallel channels cost where Singer's model is right, over the weight that they "
        "have: sensors and stay probability differ from point to point.",
    }
    return Reproduction(TITLE, claims(r), tables(r), figures, captions)
