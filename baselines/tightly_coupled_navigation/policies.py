"""Policies, reference estimator, bound and metrics of TightlyCoupledNavigation.

The paper is Moroz, adaptive multi-hypothesis measurer of an inertial-satellite navigation system; readings are
those of the task.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy
import xarray

from ...envs.task import Array, Task
from ...envs.tightly_coupled_navigation.task import (
    GROUPS,
    HYPOTHESES,
    LINE,
    REST,
    SINGER,
    State,
    TightlyCoupledNavigation,
)
from ...evaluation.bootstrap import Bootstrap, Estimate
from ...evaluation.competitors import ConstantPolicy, Policy, RandomPolicy
from ...evaluation.metrics import Measure, squared_errors
from ...filters import extended_kalman, gnss_ins
from ..table import Baselines, Tunable

LASTING = 10
"""Steps for which a hypothesis must stay believed, or a rate outside its aperture, to count."""


# --- policies


class MultiHypothesis(ConstantPolicy):
    """The paper's algorithm, steps 1 to 8: nothing added to Bayes' rule."""

    control = "evidence"

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.action = task.paper_policy.action


def chain(stay: float) -> tuple[tuple[float, ...], ...]:
    """Transition matrix of the hypotheses that stays with one probability and leaves for all others alike."""
    leave = (1.0 - stay) / (len(HYPOTHESES) - 1)
    return tuple(
        tuple(stay if i == j else leave for j in range(len(HYPOTHESES))) for i in range(len(HYPOTHESES))
    )


class Sticky(MultiHypothesis):
    """The paper's algorithm over a chain that leaves a hypothesis once in 100 s, not once in 5 s.

    The chain belongs to the bank, so an evaluation sets the task's ``transition``; elsewhere set it yourself.
    """

    task_keywords: ClassVar[dict[str, Any]] = {"transition": chain(0.9999)}


class _OneHypothesis(Policy):
    """One filter whose model never changes."""

    control = "mode"
    hypothesis: ClassVar[int]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Name the hypothesis for every episode."""
        return numpy.full(len(observation), self.hypothesis), None


class Rest(_OneHypothesis):
    """Hypothesis 1 alone."""

    hypothesis = REST


class ConstantVelocity(_OneHypothesis):
    """Hypothesis 2 alone."""

    hypothesis = LINE


class Singer(_OneHypothesis):
    """The paper's non-adaptive measurer: Singer's model alone, as in the third filter of the bank."""

    hypothesis = SINGER


class FixedGain(ConstantPolicy):
    """The paper's probabilities over sensors whose noise is taken to be larger or smaller, always.

    Args:
        task: the problem.
        action: of the control "gain"; by default the accelerometers are as good as switched off.
    """

    control = "gain"

    def __init__(self, task: Task, action: tuple[float, ...] = (0.0, 0.0, 0.8, 0.0)) -> None:
        super().__init__(task)
        self.action = action


class NisAdaptive(Policy):
    """Innovation-based adaptation of the noise, under the paper's probabilities.

    Where the short average of the normalised innovation squared exceeds ``threshold`` under every hypothesis,
    the model and the sensors disagree. An excess of the pseudoranges is put down to these. Rates that disagree
    may be noisy, or right while the accelerometers stick: ``rates`` and ``accelerometers`` say how much of the
    rates' excess goes to either. Accelerometers that disagree may be wrong, or the first to feel a manoeuvre:
    ``own`` says how much of their excess goes to them. With these three at zero it is nearly the constant
    action ``base``.

    Args:
        task: the problem.
        threshold: of the average per observation; 1 is what a consistent filter has.
        rates: power of the rates' excess in their own variance.
        accelerometers: power of the rates' excess in the variance of the accelerometers.
        own: power of the accelerometers' excess in their own variance.
        base: what is always added to the action of the accelerometers.
    """

    control = "gain"

    def __init__(
        self,
        task: TightlyCoupledNavigation,
        threshold: float = 3.0,
        rates: float = 1.0,
        accelerometers: float = 1.0,
        own: float = 1.0,
        base: float = 0.0,
    ) -> None:
        super().__init__(task)
        self.columns = [task.columns([f"average_nis_{group}_{h}" for h in HYPOTHESES]) for group in GROUPS]
        self.nats = 2.0 * math.log(task.parameters.noise_scale)
        self.threshold, self.rates, self.accelerometers = threshold, rates, accelerometers
        self.own, self.base = own, base

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Turn excesses into logarithms of factors."""
        ranges, rates, forces, attitude = (
            numpy.log(numpy.maximum(numpy.expm1(observation[:, c]).min(axis=1) / self.threshold, 1.0))
            / self.nats
            for c in self.columns
        )
        action = [
            ranges,
            self.rates * rates,
            self.base + self.own * forces + self.accelerometers * rates,
            attitude,
        ]
        return numpy.clip(numpy.stack(action, axis=1), -1.0, 1.0), None


class StuckCheck(NisAdaptive):
    """Accelerometers that repeat their last reading exactly are switched off; otherwise as told by the NIS.

    Noise never repeats itself, so a reading held over a whole decision is a stuck sensor for certain; until
    the decision after it sticks the filter trusts it.
    """

    def __init__(self, task: TightlyCoupledNavigation, threshold: float = 3.0, rates: float = 0.0) -> None:
        super().__init__(task, threshold, rates, accelerometers=0.0)
        self.readings = task.columns([f"accelerometer_{axis}" for axis in ("forward", "right", "down")])

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Compare with the readings of the last decision."""
        action, _ = super().act(observation, None, start)
        readings = observation[:, self.readings]
        if state is not None:
            stuck = (readings == state).all(axis=1) & ~start
            action[:, GROUPS.index("accelerometers")] = numpy.where(
                stuck, 1.0, action[:, GROUPS.index("accelerometers")]
            )
        return action, readings


# --- reference estimator and bound


class _Track(NamedTuple):
    mean: Array
    """``(17, N)``."""
    covariance: Array
    """``(17, 17, N)``."""
    mode: Array
    """True hypothesis at the last measurement, ``(N,)``."""


def _replaced(matrix: Array, variance: float, task: TightlyCoupledNavigation, lanes: Array) -> Array:
    """Covariance ``(17, 17, N)`` with an acceleration that has nothing to do with the past in some lanes."""
    xp = task.xp
    part = [1.0 if gnss_ins.ACCELERATION.start <= i < gnss_ins.ACCELERATION.stop else 0.0 for i in range(17)]
    new = task.constant(part)
    keep = 1.0 - new
    fresh = matrix * (keep[:, None] * keep)[:, :, None] + (variance * xp.eye(17) * new)[:, :, None]
    return xp.where(lanes, fresh, matrix)


class _KnownMode:
    """Models that the true hypothesis chooses step by step, and sensors whose state is known.

    From the step on which a manoeuvre begins, the acceleration has nothing to do with the past. A manoeuvre
    that follows another one, or that the task announces by a jump, takes its new acceleration at the end of a
    step; on the course "kinematic" the first one is there from the beginning of its step.
    """

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        self.task = task
        self.axis = task.axis[..., 0]

    def start(self, state: State) -> _Track:
        """Start from the estimate that the task starts from; no action has touched it yet."""
        return _Track(state.estimate, state.covariance, state.mode)

    def forgotten(self, track: _Track, lanes: Array, variance: float) -> _Track:
        """Track with an unknown acceleration of some variance in some lanes."""
        xp = self.task.xp
        moved = xp.concat(
            [track.mean[:8], xp.where(lanes, 0.0 * track.mean[8:11], track.mean[8:11]), track.mean[11:]]
        )
        return track._replace(mean=moved, covariance=_replaced(track.covariance, variance, self.task, lanes))

    def predicted(self, state: State, track: _Track, noises: Array, variance: float) -> _Track:
        """Prediction to the present measurement.

        Args:
            state: after it arrived.
            track: after the one before.
            noises: covariance of the process noise of every hypothesis, ``(17, 17, M)``.
            variance: of the acceleration with which a manoeuvre begins, (m/s^2)^2 per axis.
        """
        xp, task = self.task.xp, self.task
        jumped = state.jump > 0.0
        at_once = (state.mode == SINGER) & (track.mode != SINGER) & ~jumped
        track = self.forgotten(track, at_once, variance)
        # A jump ends a step that was moved by the hypothesis before it.
        moved_by = xp.where(jumped, track.mode, state.mode)
        axis = xp.take(self.axis, moved_by, axis=-1)[:, :, None]
        noise = xp.take(noises, moved_by, axis=-1)[:, :, None]
        mean, covariance = gnss_ins.predict(
            track.mean[:, None],
            track.covariance[:, :, None],
            axis,
            task.common.T,
            task.common.decay,
            noise,
        )
        track = _Track(mean[:, 0], covariance[:, :, 0], state.mode)
        return self.forgotten(track, jumped, variance)

    def sensors(self, state: State) -> tuple[list[Array], list[Array]]:
        """True variance of every observation, and one where it says something."""
        task, S = self.task, self.task.satellites
        variance = [task.sensor_variance[j] * state.noise_factor[j] ** 2 for j in range(task.observations)]
        available = [state.available[j] for j in range(task.observations)]
        # A reading that is held was already used when it was new.
        for j in range(2 * S, 2 * S + 3):
            available[j] = available[j] * (1.0 - state.stuck)
        return variance, available


class KnownMode(_KnownMode):
    """One extended Kalman filter whose model follows the true hypothesis and whose noise is the true one.

    Rest keeps the bank's small regularising noise, so that the reported covariance stays invertible. On the
    fixed courses, where straight flight has steady increments and no noise, the increment's size is taken as
    its standard deviation.
    """

    kind = "reference"
    knows = (
        "the true hypothesis at every step, when a manoeuvre begins, the true noise of every sensor, when the "
        "accelerometers stick, and multipath errors"
    )

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        super().__init__(task)
        p = task.parameters
        increment = p.true_increment_sigma if p.course == "random" else p.leg_acceleration * p.T
        line = gnss_ins.constant_velocity_model(p.T, increment, p.reset_acceleration_sigma)
        true_line = task.constant(gnss_ins.process_noise(line, task.common))
        noises = [task.process_noise[:, :, i, 0] for i in range(len(HYPOTHESES))]
        noises[LINE] = true_line
        self.noises = task.xp.stack(noises, axis=-1)

    def update(self, state: State, memory: _Track) -> tuple[State, _Track]:
        """Predict under the true hypothesis and update with the sensors that work."""
        xp, task, S = self.task.xp, self.task, self.task.satellites
        track = self.predicted(state, memory, self.noises, task.parameters.singer_sigma**2)
        expected, rows = gnss_ins.observe(
            track.mean, *task.satellites_now(state), state.ins_angles, task.parameters.gravity
        )
        residual = state.measurement - expected
        residual = xp.concat([residual[:S] - state.multipath, residual[S:]])
        update = extended_kalman.update_one_by_one(
            track.mean, track.covariance, residual, rows, *self.sensors(state)
        )
        track = _Track(update.mean, update.covariance, state.mode)
        return self.reported(state, track, update), track

    def reported(self, state: State, track: _Track, update: extended_kalman.Correction) -> State:
        """State that reports this filter, and whose tracking loops are steered by it."""
        xp, task, M = self.task.xp, self.task, len(HYPOTHESES)
        certain = xp.astype(xp.arange(M, device=state.mode.device)[:, None] == state.mode, track.mean.dtype)
        nis = xp.stack([task.total(update.squared_residuals[g]) for g in task.sensor_groups])
        return state._replace(
            estimate=track.mean,
            covariance=track.covariance,
            bank_mean=track.mean[:, None] + xp.zeros_like(state.bank_mean),
            bank_covariance=track.covariance[:, :, None] + xp.zeros_like(state.bank_covariance),
            probabilities=certain,
            nis=nis[:, None] + xp.zeros_like(state.nis),
        )


class KnownModeBound(_KnownMode):
    """Posterior Cramér-Rao bound of an estimator that is told the hypothesis and how manoeuvres begin.

    The covariance recursion of the motion that generates the truth, along the true states: no motion noise
    at rest, that of the increments on random straight flight (none on the fixed courses, whose increments are
    known), Singer's in manoeuvres, and the acceleration with which each begins given.
    """

    kind = "bound"
    knows = (
        "the true hypothesis at every step, the acceleration with which a manoeuvre begins, the true noise of "
        "every sensor, when the accelerometers stick, and multipath errors"
    )

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        super().__init__(task)
        p = task.parameters
        increment = p.true_increment_sigma if p.course == "random" else 0.0
        axes = {
            REST: gnss_ins.rest_model(p.T, 0.0, 0.0),
            LINE: gnss_ins.constant_velocity_model(p.T, increment, 0.0),
            SINGER: gnss_ins.singer_model(p.T, p.singer_alpha, p.singer_sigma),
        }
        noises = [gnss_ins.process_noise(axes[i], task.common) for i in range(len(HYPOTHESES))]
        self.noises = task.constant(numpy.stack(noises, axis=-1))

    def update(self, state: State, memory: _Track) -> tuple[Array, _Track]:
        """Bound after this measurement: the diagonal of the covariance."""
        xp, task = self.task.xp, self.task
        track = self.predicted(state, memory, self.noises, 0.0)
        expected, rows = gnss_ins.observe(
            state.truth, *task.satellites_now(state), state.ins_angles, task.parameters.gravity
        )
        update = extended_kalman.update_one_by_one(
            track.mean, track.covariance, xp.zeros_like(expected), rows, *self.sensors(state)
        )
        P = update.covariance
        return xp.stack([P[i, i] for i in range(gnss_ins.SIZE)]), track._replace(covariance=P)


# --- metrics of this environment


def _ratio(bootstrap: Bootstrap, values: numpy.ndarray, counts: numpy.ndarray) -> Estimate:
    """Ratio of means over episodes, with its interval."""
    with numpy.errstate(divide="ignore", invalid="ignore"):
        return bootstrap.interval(bootstrap.means(values) / bootstrap.means(counts))


def quantile(
    bootstrap: Bootstrap, values: numpy.ndarray, share: float, chosen: numpy.ndarray | None = None
) -> Estimate:
    """Quantile over the chosen episodes (default: all), with its interval.

    The smallest value that at least ``share`` of the chosen weight does not exceed.

    Args:
        bootstrap: of the episodes.
        values: ``(episodes,)``.
        share: such as 0.5 for the median.
        chosen: ``(episodes,)`` booleans.
    """
    chosen = numpy.ones(len(values), dtype=bool) if chosen is None else chosen
    order = numpy.argsort(numpy.where(chosen, values, numpy.inf))
    weights = numpy.cumsum((bootstrap.weights * chosen)[:, order], axis=1)
    # Rounding of the sums must not move a share that is met exactly.
    enough = weights >= share * weights[:, -1:] * (1.0 - 1e-9)
    found = numpy.where(weights[:, -1] > 0.0, values[order][enough.argmax(axis=1)], numpy.nan)
    return bootstrap.interval(found)


def lasting(condition: numpy.ndarray, steps: int = LASTING) -> numpy.ndarray:
    """Where a condition begins to hold for some steps in a row; false where the end is too near.

    Args:
        condition: ``(episodes, time)`` booleans.
        steps: how many.
    """
    sums = numpy.cumsum(numpy.pad(condition, ((0, 0), (1, 0))), axis=1)
    held = numpy.zeros_like(condition)
    if condition.shape[1] >= steps:
        held[:, : condition.shape[1] - steps + 1] = sums[:, steps:] - sums[:, :-steps] == steps
    return held


class Switch(NamedTuple):
    """One change of the true hypothesis."""

    episode: int
    before: int
    after: int
    wait: float
    """Steps until the new hypothesis is believed, the first one counted; infinite where it never is."""


def switches(true_mode: numpy.ndarray, probability: numpy.ndarray) -> list[Switch]:
    """Every change of the true hypothesis and how long the bank took to follow it.

    A hypothesis is believed from the first step on which its probability exceeds one half and does so for
    ``LASTING`` steps (or until the next change, if that comes sooner).

    Args:
        true_mode: ``(episodes, time)`` integers.
        probability: ``(episodes, time, M)``.
    """
    found = []
    length = true_mode.shape[1]
    for episode, at in zip(*numpy.nonzero(numpy.diff(true_mode, axis=1)), strict=True):
        first = int(at) + 1
        before, after = int(true_mode[episode, at]), int(true_mode[episode, first])
        others = numpy.flatnonzero(true_mode[episode, first:] != after)
        last = first + int(others[0]) if len(others) else length
        believed = probability[episode, first:last, after] > 0.5
        held = lasting(believed[None], min(LASTING, last - first))[0]
        wait = float(held.argmax()) + 1.0 if held.any() else math.inf
        found.append(Switch(int(episode), before, after, wait))
    return found


def metrics(run: xarray.Dataset, bootstrap: Bootstrap) -> list[Measure]:
    """Errors by true hypothesis, adaptation, loss of track and robust costs of one policy.

    ``rmse_by_hypothesis``; ``cost_median`` and ``cost_95_quantile`` over episodes of the episode's mean cost,
    whose mean a few lost tracks rule; ``nis_per_degree``, mean NIS over the mean number of observations, 1
    for a consistent filter; ``adaptation_time`` (mean) from the first step that carries a new motion to the
    first on which its hypothesis has more than one half and keeps it for ten steps, and
    ``adaptation_censored``, the share of switches where that never comes; ``track_loss_rate`` and
    ``track_loss_time`` (median of the tracks lost) of ten steps in a row with a pseudorange rate further than
    the aperture from the combined prediction, from the first change of motion on.
    """
    if numpy.isnan(run["cost"].values).all():
        return []  # a bound
    return list(_measures(run, bootstrap))


def _measures(run: xarray.Dataset, bootstrap: Bootstrap) -> Iterator[Measure]:
    windows = run.attrs["windows"]
    true_mode = run["true_mode"].values.astype(int)
    step = float(run["seconds"].values[0, 0])
    for component, unit in (("position", "m"), ("velocity", "m/s")):
        squares = squared_errors(run, component, run.attrs["groups"])
        for i, name in enumerate(HYPOTHESES):
            there = true_mode == i
            if there.any():
                value = _ratio(bootstrap, (squares * there).mean(axis=1), there.mean(axis=1))
                root = Estimate(*(math.sqrt(v) for v in value))
                yield Measure("rmse_by_hypothesis", f"{component} {name}", "all", root, unit)
    cost = run["cost"].values.mean(axis=1)
    yield Measure("cost_median", "", "all", quantile(bootstrap, cost, 0.5), "1")
    yield Measure("cost_95_quantile", "", "all", quantile(bootstrap, cost, 0.95), "1")
    for window, (first, last) in windows.items():
        times = slice(first - 1, last)
        nis = run["nis"].values[:, times].mean(axis=1)
        degrees = run["nis_degrees"].values[:, times].mean(axis=1)
        yield Measure("nis_per_degree", "", window, _ratio(bootstrap, nis, degrees), "1")

    episodes = len(true_mode)
    changes = switches(true_mode, run["mode_probability"].values)
    for before, after in sorted({(s.before, s.after) for s in changes}):
        count, missed, total = numpy.zeros(episodes), numpy.zeros(episodes), numpy.zeros(episodes)
        for s in changes:
            if (s.before, s.after) == (before, after):
                count[s.episode] += 1.0
                missed[s.episode] += not math.isfinite(s.wait)
                total[s.episode] += s.wait * step if math.isfinite(s.wait) else 0.0
        name = f"{HYPOTHESES[before]} to {HYPOTHESES[after]}"
        if (missed < count).any():
            yield Measure("adaptation_time", name, "all", _ratio(bootstrap, total, count - missed), "s")
        yield Measure("adaptation_censored", name, "all", _ratio(bootstrap, missed, count), "1")

    moved = true_mode != true_mode[:, :1]
    begin = numpy.where(moved.any(axis=1), moved.argmax(axis=1), 0)
    in_motion = numpy.arange(true_mode.shape[1]) >= begin[:, None]
    outside = lasting((run["rate_outside_aperture"].values > 0.0) & in_motion)
    lost = numpy.asarray(outside.any(axis=1))
    yield Measure("track_loss_rate", "", "all", bootstrap.estimate(lost.astype(float)), "1")
    if lost.any():
        time = (outside.argmax(axis=1) - begin + 1.0) * step
        yield Measure("track_loss_time", "", "all", quantile(bootstrap, time, 0.5, lost), "s")


# --- what can be tuned


def _fixed_gain(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
    # The other two groups change nothing that can be measured.
    action = tuple(values.get(group, 0.0) for group in GROUPS)
    return {}, lambda task: FixedGain(task, action)


def _sticky(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
    return {"transition": chain(1.0 - 10.0 ** values["log10_leave"])}, MultiHypothesis


def _adaptive(
    cls: type[NisAdaptive],
) -> Callable[[Mapping[str, float]], tuple[dict[str, Any], Callable[[Any], Policy]]]:
    return lambda values: ({}, lambda task: cls(task, **values))


TUNABLE = {
    "fixed-gain": Tunable(
        "gain",
        {"rates": (-0.2, 0.3), "accelerometers": (0.0, 1.0)},
        {"rates": 0.0, "accelerometers": 0.8},
        _fixed_gain,
    ),
    "nis-adaptive": Tunable(
        "gain",
        {
            "threshold": (0.5, 10.0),
            "rates": (0.0, 2.0),
            "accelerometers": (0.0, 4.0),
            "own": (0.0, 2.0),
            "base": (0.0, 1.0),
        },
        {"threshold": 3.0, "rates": 1.0, "accelerometers": 1.0, "own": 1.0, "base": 0.0},
        _adaptive(NisAdaptive),
    ),
    "stuck-check": Tunable(
        "gain",
        {"threshold": (0.5, 10.0), "rates": (0.0, 2.0)},
        {"threshold": 3.0, "rates": 0.0},
        _adaptive(StuckCheck),
    ),
    "sticky": Tunable("evidence", {"log10_leave": (-6.0, -0.5)}, {"log10_leave": -4.0}, _sticky),
}

BASELINES = Baselines(
    environment="filtergym/TightlyCoupledNavigation-v0",
    policies={
        "multi-hypothesis": MultiHypothesis,
        "sticky": Sticky,
        "nis-adaptive": NisAdaptive,
        "stuck-check": StuckCheck,
        "fixed-gain": FixedGain,
        "singer": Singer,
        "constant-velocity": ConstantVelocity,
        "rest": Rest,
        "random": RandomPolicy,
    },
    references={"known-mode": KnownMode},
    bounds={"known-mode-bound": KnownModeBound},
    score_paper="multi-hypothesis",
    score_bound="known-mode",
    tunable=TUNABLE,
    best_constant="fixed-gain",
    # Those that tell most: a policy takes seconds here, and the quick benchmark has two minutes for everything.
    benchmark=("multi-hypothesis", "nis-adaptive", "singer", "known-mode", "known-mode-bound"),
    physical=("rmse", "velocity"),
    measurement_seconds=4e-5,
    metrics=metrics,
)
