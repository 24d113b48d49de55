"""The measurer and its rivals on both readings of the course, on Singer's motion, and with other settings."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ...baselines.tightly_coupled_navigation.metrics import find_lasting, switches
from ...baselines.tightly_coupled_navigation.policies import chain
from ...baselines.tightly_coupled_navigation.references import KnownMode
from ...envs.contract.model import Episode, Model
from ...envs.engine.backend import make_model
from ...envs.tightly_coupled_navigation.parameters import HYPOTHESES, LINE, REST, SINGER
from ...envs.tightly_coupled_navigation.task import TightlyCoupledNavigation
from ...evaluation.competitors.kinds import Policy
from ...evaluation.running.parallel import Workers
from ...evaluation.running.seeds import episode_seeds
from ...filters import gnss_ins, imm
from ..quantities import Quantity, means, quantity, record_run
from ..reproduction import Progress, compute_units, later

EPISODES = 100
FEW = 40
"""Runs of the comparators."""
SCATTER = 32
"""Runs at each setting of the sensitivity study."""
SEED = 0
T = 0.01
NOTHING = 1e6
"""Standard deviation of a sensor that is left out, in its unit."""

ADAPTIVE = "adaptive"
FILTERS: dict[str, int | None] = {ADAPTIVE: None, "rest": REST, "constant velocity": LINE, "Singer": SINGER}
COURSES = {"increment": "paper", "kinematic": "kinematic"}
"""Scenario of each reading."""
WINDOWS = TightlyCoupledNavigation.scenarios["paper"].windows
MOTION = 1001
"""First step that carries the motion of leg 2."""
JUMP = 2000
"""Step on which leg 3 begins."""
SHORT_LEG = 300
"""Length of leg 1 where only what follows matters; the filters are steady by then."""
SHORTEST_LEG = 150

PSEUDORANGES = {"rate_sigma": NOTHING, "accelerometer_sigma": NOTHING}
CANONICAL_PSEUDORANGES = "pseudoranges only, stay 0.998"
MATCHED_PARAMETERS: dict[str, dict[str, Any]] = {
    "all sensors": {},
    "no accelerometers": {"accelerometer_sigma": NOTHING},
    "pseudoranges only, stay 0.9998": PSEUDORANGES | {"transition": chain(0.9998)},
    CANONICAL_PSEUDORANGES: PSEUDORANGES,
    "pseudoranges only, stay 0.98": PSEUDORANGES | {"transition": chain(0.98)},
}
MATCHED_WINDOW = (200, 1200)
WAITS: dict[str, dict[str, Any]] = {
    "rates, 0.1 m/s": {},
    "rates, 0.3 m/s": {"rate_sigma": 0.3},
    "rates, 1 m/s": {"rate_sigma": 1.0},
    "no rates": {"rate_sigma": NOTHING},
}
SETTINGS: dict[str, dict[str, Any]] = {"as in the experiment": {}}
for _name, _parameter, _unit, _values in (
    ("aperture", "rate_aperture", "m/s", (5.0, 12.0, 15.0)),
    ("accelerometer", "accelerometer_sigma", "m/s²", (0.03, 0.1, 0.2)),
    ("manoeuvre", "singer_sigma", "m/s²", (2.0, 9.0, 36.0)),
    ("rate", "rate_sigma", "m/s", (0.05, 0.3, 1.0)),
):
    SETTINGS |= {f"{_name} {value:g} {_unit}": {_parameter: value} for value in _values}

STEPS = 4 + len(MATCHED_PARAMETERS) + len(WAITS) + 4 + len(SETTINGS)

COMPONENTS = (
    ("position", "m"), ("velocity", "m/s"), ("acceleration", "m/s²"), ("attitude", "rad"), ("clock bias", "m"),
    ("clock drift", "m/s"),
)  # fmt: skip
PARTS = (
    gnss_ins.POSITION, gnss_ins.VELOCITY, gnss_ins.ACCELERATION, gnss_ins.ATTITUDE_ERROR,
    slice(gnss_ins.CLOCK_BIAS, gnss_ins.CLOCK_BIAS + 1), slice(gnss_ins.CLOCK_DRIFT, gnss_ins.CLOCK_DRIFT + 1),
)  # fmt: skip


# --- runs


class Run(NamedTuple):
    """Results of one filter over E runs of K steps: squared errors, mode probabilities, NIS."""

    squares: numpy.ndarray
    """Squared spherical errors of position, velocity, acceleration, attitude, and squared errors of clock
    bias and drift, ``(E, K, 6)``.
    """
    variance: numpy.ndarray
    """Reported variance of the position, ``(E, K)``, m^2."""
    probability: numpy.ndarray
    """Probability of each hypothesis, ``(E, K, 3)``."""
    true_mode: numpy.ndarray
    """Index of the true hypothesis, ``(E, K)``."""
    outside: numpy.ndarray
    """Whether a rate is outside its aperture, ``(E, K)``."""
    nis: numpy.ndarray
    """Normalised innovation squared over its degrees of freedom, ``(E, K)``."""

    def slice_runs(self, first: int, end: int) -> "Run":
        """Return the results of the runs ``first`` to ``end``, without the last."""
        return Run(*(series[first:end] for series in self))

    def rms(self, component: int, window: tuple[int, int]) -> numpy.ndarray:
        """Return the root of the mean square over runs and the steps of a window, ``(1 + resamples,)``."""
        return numpy.sqrt(means(self.squares[:, window[0] - 1 : window[1], component].mean(axis=1)))

    @property
    def other_weight(self) -> float:
        """Mean probability of the two wrong hypotheses where the motion is Singer's."""
        return float(1.0 - self.probability[:, MATCHED_WINDOW[0] - 1 :, SINGER].mean())


def ratio(ours: Run, theirs: Run, component: int, window: tuple[int, int]) -> Quantity:
    """Return the ratio of two filters' RMS errors, paired over the runs."""
    return quantity(ours.rms(component, window) / theirs.rms(component, window))


class _SideBySide(Policy):
    """Policy of lanes (parallel runs) with different filters: the paper's probabilities, or one hypothesis."""

    control = "weights"

    def __init__(self, model: Model, lanes: Sequence[int | None]) -> None:
        super().__init__(model)
        self.log_likelihood, self.log_predicted = (
            model.reader("log_likelihood"),
            model.reader("log_predicted"),
        )
        self.fixed = numpy.array([lane is not None for lane in lanes])
        self.weights = numpy.array([numpy.eye(len(HYPOTHESES))[lane or 0] for lane in lanes])

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return posterior probabilities in adaptive lanes, and probability one in lanes of a single hypothesis."""
        posterior = imm.mode_posterior(
            self.log_predicted(observation).T, self.log_likelihood(observation).T
        ).T
        lanes = numpy.minimum(numpy.arange(len(observation)), len(self.fixed) - 1)  # filled up with the last
        return numpy.where(self.fixed[lanes, None], self.weights[lanes], posterior), None


def simulate(scenario: str, filters: Mapping[str, int], **keywords: Any) -> dict[str, Run]:
    """Run several filters over the same noise, and return their results by name.

    ``filters`` has the number of runs of names of ``FILTERS``, or of "known mode", which runs alone.
    """
    model = make_model(TightlyCoupledNavigation, "weights", scenario, **keywords)
    task: Any = model.task
    seeds = [seed for count in filters.values() for seed in episode_seeds("test", SEED, count)]

    def fields(model: Model, episode: Episode) -> dict[str, numpy.ndarray]:
        squares, records, P = model.error(episode) ** 2, model.records(episode), model.covariance(episode)
        if model.filter.knows:
            # The reference uses the true hypothesis; nothing but apertures takes a rate away here.
            available = episode.measurement.available
            records["mode_probability"] = numpy.eye(len(HYPOTHESES))[records["true_mode"]].T
            records["rate_outside_aperture"] = 1.0 - available[task.sensors[1].readings].min(axis=0)
        return {
            "squares": numpy.stack([squares[part].sum(axis=0) for part in PARTS]),
            "variance": P[0, 0] + P[1, 1] + P[2, 2],
            "probability": records["mode_probability"],
            "true_mode": records["true_mode"],
            "outside": records["rate_outside_aperture"] > 0.0,
            "nis": records["nis"] / records["nis_degrees"],
        }

    lanes = [FILTERS.get(name) for name, count in filters.items() for _ in range(count)]
    actor = KnownMode(task) if "known mode" in filters else _SideBySide(model, lanes)
    run = Run(**record_run(model, actor, seeds, fields))
    ends = numpy.cumsum(list(filters.values()))
    return {
        name: run.slice_runs(end - count, end)
        for (name, count), end in zip(filters.items(), ends, strict=True)
    }


class Results(NamedTuple):
    """Results of all experiments, from which claims, tables and figures are made."""

    courses: dict[str, dict[str, Run]]
    """Adaptive and Singer's filter on both courses; on ``increment`` "Singer, no aperture" and "known mode" too."""
    matched: dict[str, dict[str, Run]]
    waits: dict[str, Run]
    short: dict[str, dict[str, Run]]
    """Runs with a short leg 1, by filter and course."""
    settings: dict[str, Run]


def run_everything(progress: Progress, episodes: int, workers: Workers | None = None) -> Results:
    """Run all experiments of the paper, and return their results; ``STEPS`` units of work."""
    share = min(1.0, episodes / EPISODES)
    few, scatter = (max(2, math.ceil(share * count)) for count in (FEW, SCATTER))

    def run(scenario: str, filters: Mapping[str, int], **keywords: Any) -> Any:
        return later(simulate, scenario, filters, **keywords)

    both = {ADAPTIVE: episodes, "Singer": few}
    short: dict[str, Any] = {"horizon": SHORT_LEG + 200, "leg_steps": (SHORT_LEG, SHORT_LEG + 1000)}
    shortest: dict[str, Any] = {
        "horizon": SHORTEST_LEG + 160,
        "leg_steps": (SHORTEST_LEG, SHORTEST_LEG + 1000),
    }
    blind = {"accelerometer_sigma": NOTHING}
    found = compute_units(
        {
            "courses": {course: run(scenario, both) for course, scenario in COURSES.items()},
            "no aperture": run("paper", {"Singer": few}, aperture=False),
            "known mode": run("paper", {"known mode": few}),
            "blind": {c: run(scenario, {"Singer": few}, **blind, **short) for c, scenario in COURSES.items()},
            "short": {
                c: run(scenario, {"constant velocity": few, "rest": few}, **short)
                for c, scenario in COURSES.items()
            },
            "matched": {
                name: run("matched", {ADAPTIVE: few, "Singer": few}, horizon=MATCHED_WINDOW[1], **keywords)
                for name, keywords in MATCHED_PARAMETERS.items()
            },
            "waits": {
                name: run("paper", {ADAPTIVE: episodes}, horizon=MOTION + 99, **keywords)
                for name, keywords in WAITS.items()
            },
            "settings": {
                name: run("paper", {"Singer": scatter}, **shortest, **keywords)
                for name, keywords in SETTINGS.items()
            },
        },
        progress,
        workers,
    )
    courses = found["courses"]
    courses["increment"] |= {"Singer, no aperture": found["no aperture"]["Singer"], **found["known mode"]}
    of_short: dict[str, dict[str, Run]] = {}
    for course in COURSES:
        of_short.setdefault("Singer without accelerometers", {})[course] = found["blind"][course]["Singer"]
        for name, one in found["short"][course].items():
            of_short.setdefault(name, {})[course] = one
    return Results(
        courses,
        found["matched"],
        {name: one[ADAPTIVE] for name, one in found["waits"].items()},
        of_short,
        {name: one["Singer"] for name, one in found["settings"].items()},
    )


# --- loss of track, and adaptation


class Loss(NamedTuple):
    """Share of runs that lose the track, and times from the manoeuvre to the loss, s."""

    rate: float
    median: float
    """Seconds from the first step of the motion, of the lost tracks; NaN without one."""
    first: float
    last: float

    def __str__(self) -> str:
        if self.rate == 0.0:
            return "no track lost"
        return (
            f"{100 * self.rate:.0f} % lost, median {self.median:.2f} s ({self.first:.2f} to {self.last:.2f})"
        )


def loss(run: Run, motion: int) -> Loss:
    """Return the share of runs that lose the track after a motion begins on step ``motion``, and the times."""
    outside = find_lasting(run.outside[:, motion - 1 :])
    lost = outside.any(axis=1)
    if not lost.any():
        return Loss(0.0, numpy.nan, numpy.nan, numpy.nan)
    time = (outside.argmax(axis=1)[lost] + 1) * T
    return Loss(float(lost.mean()), float(numpy.median(time)), float(time.min()), float(time.max()))


class Wait(NamedTuple):
    """Mean, shortest and longest time, s, until a filter has adapted to a change of motion; NaN: never."""

    mean: float
    first: float
    last: float
    never: int
    """Number of runs in which the filter never adapts."""

    def __str__(self) -> str:
        if numpy.isnan(self.mean):
            return f"{self.never} never"
        never = f", {self.never} never" if self.never else ""
        return f"mean {self.mean:.3f} s ({self.first:.2f} to {self.last:.2f}{never})"


def waits_of(run: Run, before: int, after: int) -> Wait:
    """Return the adaptation times after switches from hypothesis ``before`` to ``after``."""
    found = switches(run.true_mode, run.probability)
    waits = numpy.array([s.wait * T for s in found if (s.before, s.after) == (before, after)])
    finite = waits[numpy.isfinite(waits)]
    if not len(finite):
        return Wait(numpy.nan, numpy.nan, numpy.nan, len(waits))
    return Wait(float(finite.mean()), float(finite.min()), float(finite.max()), len(waits) - len(finite))
