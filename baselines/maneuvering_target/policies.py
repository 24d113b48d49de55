"""Policies, reference estimators and the bound of ManeuveringTarget.

Equation numbers and readings are those of the task's paper (Bakulev, Sychev, Nguyen).
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy

from ...envs.controls import signed_exponential
from ...envs.maneuvering_target.task import ManeuveringTarget, Outside, State
from ...envs.task import Array, Task
from ...filters import bounds, imm, kalman, polar
from ..policy import Baselines, ConstantPolicy, Policy, RandomPolicy, Tunable


class InteractingMultipleModel(Policy):
    """The paper's algorithm: weights by Bayes' rule, equations (12)-(14)."""

    control = "weights"

    def __init__(self, task: ManeuveringTarget) -> None:
        super().__init__(task)
        self.log_likelihood = task.columns([f"log_likelihood_{m + 1}" for m in range(len(task.modes))])
        self.log_predicted = task.columns([f"log_predicted_{m + 1}" for m in range(len(task.modes))])

    def probabilities(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Posterior mode probabilities, ``(N, M)``."""
        log_likelihood = signed_exponential(observation[:, self.log_likelihood], numpy)
        log_predicted = signed_exponential(observation[:, self.log_predicted], numpy)
        return imm.mode_posterior(log_predicted.T, log_likelihood.T).T

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """State the posterior probabilities as weights."""
        return self.probabilities(observation), None


class HardInteractingMultipleModel(InteractingMultipleModel):
    """Believe the most probable mode only.

    With all weight on one mode the bank mixes every filter into the same state with the same covariance, so
    both modes explain the next measurement equally well and the transition probabilities decide: the first
    mode is believed for ever. On this bank of process-noise-free filters it *is* ``fixed-low``.
    """

    control = "mode"

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Name the mode of largest posterior probability."""
        return numpy.argmax(self.probabilities(observation), axis=1), None


class ZeroEvidence(ConstantPolicy):
    """Nothing added to Bayes' rule: the paper's IMM, inside the task."""

    control = "evidence"

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.action = task.paper_policy.action


class FixedGain(ConstantPolicy):
    """One alpha-beta filter of constant gain ``alpha``."""

    control = "gain"

    def __init__(self, task: ManeuveringTarget, alpha: float) -> None:
        super().__init__(task)
        self.action = (task.action_for_alpha(alpha),)


class FixedLow(FixedGain):
    """The smallest of the bank's gains, never changed."""

    def __init__(self, task: ManeuveringTarget) -> None:
        super().__init__(task, min(task.parameters.gains))


class FixedHigh(FixedGain):
    """The largest of the bank's gains, never changed."""

    def __init__(self, task: ManeuveringTarget) -> None:
        super().__init__(task, max(task.parameters.gains))


class FixedBest(FixedGain):
    """The constant gain of least whole-run error on the paper's flight, exact: alpha = 0.65."""

    def __init__(self, task: ManeuveringTarget, alpha: float = 0.65) -> None:
        super().__init__(task, alpha)


class AdaptiveGain(Policy):
    """The paper's comparator: a ramp of the gain after every detected manoeuvre.

    alpha falls linearly from the larger gain to the smaller one over seven scans, at the start (scans 1 to
    8) and after every alarm. Reading: the paper does not describe the detector; here the normalised
    innovation squared of one scan, both axes, against the chi-square limit of ``false_alarm_probability``,
    and no alarm while a ramp runs, which is what the one complete ramp of its figure 3 shows.
    """

    control = "gain"
    rearm = False

    def __init__(
        self, task: ManeuveringTarget, false_alarm_probability: float = 1e-3, ramp_scans: float = 7.0
    ) -> None:
        super().__init__(task)
        self.threshold = -2.0 * math.log(false_alarm_probability)
        self.ramp_scans = ramp_scans
        self.low, self.high = min(task.parameters.gains), max(task.parameters.gains)
        self.squared = task.columns(["log_squared_innovation"])[0]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Go down the ramp, or start it again at an alarm."""
        step = numpy.where(start, 0, 0 if state is None else state + 1)
        alarm = numpy.expm1(observation[:, self.squared]) > self.threshold
        may = (step > 0) if self.rearm else (step >= self.ramp_scans)
        step = numpy.where(alarm & may & ~start, 0, step)
        alpha = self.high - (self.high - self.low) * numpy.minimum(step, self.ramp_scans) / self.ramp_scans
        assert isinstance(self.task, ManeuveringTarget)
        return self.task.action_for_alpha(alpha)[:, None], step


class RearmingAdaptiveGain(AdaptiveGain):
    """The same with an alarm during the ramp starting it again: an equally ordinary detector."""

    rearm = True


class _Track(NamedTuple):
    mean: Array
    covariance: Array


def _started(task: ManeuveringTarget, state: State) -> _Track:
    """Estimate that a filter of this task starts from, before the first measurement's update.

    The task's own estimator has just predicted to the first scan; taking that step back gives the start.
    """
    mean, covariance = _before_first_scan(task, state)
    return _Track(mean, covariance)


def _before_first_scan(task: ManeuveringTarget, state: State) -> tuple[Array, Array]:
    estimator: Any = state.estimator
    if hasattr(estimator, "velocity"):
        position, velocity = estimator.position, estimator.velocity
        covariance = task.covariance(state)
    else:
        position, velocity = estimator.mean[:2, 0], estimator.mean[2:, 0]
        covariance = estimator.covariance[:, :, 0]
    xp = task.xp
    back, _ = kalman.white_acceleration(-task.T, 0.0, axes=2)
    F = task.constant(back)[:, :, None]
    mean = xp.concat([position - task.T * velocity, velocity])
    return mean, bounds.predicted_bound(covariance, F)


class _KalmanReference:
    """Shared start of the Kalman references: matrices of the constant-velocity model in x and y."""

    def __init__(self, task: ManeuveringTarget) -> None:
        self.task = task
        F, Q = kalman.white_acceleration(task.T, 1.0, axes=2)
        self.F, self.unit_Q = task.constant(F), task.constant(Q)
        self.H = task.constant([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
        self.identity = task.constant([[1.0, 0.0], [0.0, 1.0]])[:, :, None]

    def noise(self, state: State) -> Array:
        """Covariance of the measurement, evaluated at the measured position, ``(2, 2, N)``."""
        return self.identity * state.variance


class KnownTurn(_KalmanReference):
    """A Kalman filter that is told in which scans the target manoeuvres, not how.

    Inside a manoeuvre its acceleration noise is as large as the manoeuvre's acceleration, elsewhere zero.
    """

    knows = "the scans of every manoeuvre and the size of its acceleration"

    def start(self, state: State) -> _Track:
        """Start where the task's filters start."""
        return _started(self.task, state)

    def acceleration_sigma(self, state: State) -> Array:
        """Size per axis of the acceleration in this scan, zero on straight flight, ``(N,)``."""
        xp, task = self.task.xp, self.task
        if state.maneuvers is None:
            rate = task.table[2:, 1:] - task.table[2:, :-1]
            row = xp.clip(xp.astype(state.scan, xp.int64) - 1, None, rate.shape[1] - 1)
            change = rate[:, row] / task.T
            return xp.sqrt(0.5 * (change[0] ** 2 + change[1] ** 2))
        m = state.maneuvers
        total = 0.0 * state.scan
        for slot in range(task.slots):
            active = xp.astype((state.scan >= m.first[slot]) & (state.scan <= m.last[slot]), total.dtype)
            speed2 = state.velocity[0] ** 2 + state.velocity[1] ** 2
            turn2 = (m.velocity_along[slot] ** 2 + m.velocity_across[slot] ** 2) * speed2 / task.T**2
            thrust2 = m.acceleration[0, slot] ** 2 + m.acceleration[1, slot] ** 2
            total = total + active * 0.5 * (thrust2 + turn2)
        return xp.sqrt(total)

    def update(self, state: State, memory: _Track) -> tuple[State, _Track]:
        """Predict with the noise of this scan and update with its measurement."""
        Q = self.unit_Q[:, :, None] * self.acceleration_sigma(state) ** 2
        mean, covariance = kalman.predict(memory.mean, memory.covariance, self.F, Q)
        result = kalman.update(mean, covariance, state.measurement, self.H, self.noise(state))
        track = _Track(result.mean, result.covariance)
        return state._replace(estimator=Outside(*track)), track


class KalmanBank(NamedTuple):
    """Memory of the IMM over Kalman filters."""

    mean: Array
    covariance: Array
    probabilities: Array


class KalmanInteractingMultipleModel(_KalmanReference):
    """The usual IMM over two Kalman filters: no manoeuvre, and white acceleration of 2.775 m/s^2."""

    knows = "nothing hidden, but its filters are outside what the action can steer"
    sigmas: ClassVar[tuple[float, float]] = (0.0, 2.775)

    def start(self, state: State) -> KalmanBank:
        """Start both filters where the task's filters start."""
        task, xp = self.task, self.task.xp
        track = _started(task, state)
        half = 0.5 + 0.0 * track.mean[:2]
        return KalmanBank(xp.stack([track.mean] * 2, axis=1), xp.stack([track.covariance] * 2, axis=2), half)

    def update(self, state: State, memory: KalmanBank) -> tuple[State, KalmanBank]:
        """One IMM cycle."""
        task, xp = self.task, self.task.xp
        transition = task.constant([[0.9, 0.1], [0.1, 0.9]])
        prediction = imm.predict_mode_probabilities(transition, memory.probabilities)
        mean, covariance = imm.mix(memory.mean, memory.covariance, prediction.mixing)
        results = []
        for j, sigma in enumerate(self.sigmas):
            predicted = kalman.predict(mean[:, j], covariance[:, :, j], self.F, sigma**2 * self.unit_Q)
            results.append(kalman.update(*predicted, state.measurement, self.H, self.noise(state)))
        log_likelihood = xp.stack([r.log_likelihood for r in results])
        probabilities = imm.mode_posterior(imm.log_probabilities(prediction.probabilities), log_likelihood)
        bank = KalmanBank(
            xp.stack([r.mean for r in results], axis=1),
            xp.stack([r.covariance for r in results], axis=2),
            probabilities,
        )
        return state._replace(estimator=Outside(*imm.combine(*bank))), bank


class KnownInputBound(_KalmanReference):
    """Posterior Cramér-Rao bound of an estimator that is told the whole acceleration: no process noise."""

    knows = "the acceleration in every scan"

    def start(self, state: State) -> Array:
        """Covariance of the start."""
        return _before_first_scan(self.task, state)[1]

    def update(self, state: State, memory: Array) -> tuple[Array, Array]:
        """Bound after this scan: the diagonal of the covariance recursion at the true position."""
        task, p = self.task, self.task.parameters
        P = bounds.predicted_bound(memory, self.F[:, :, None])
        variance = polar.cartesian_variances(state.position, p.range_sigma, task.bearing_sigma)
        P = bounds.posterior_cramer_rao_bound(P, self.H, self.identity * variance)
        return task.xp.stack([P[i, i] for i in range(4)]), P


def _gains(values: Mapping[str, float]) -> tuple[float, float]:
    return min(values["low"], values["high"]), max(values["low"], values["high"])


def _tuned_imm(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
    stay = values["stay_low"], values["stay_high"]
    transition = ((stay[0], 1.0 - stay[0]), (1.0 - stay[1], stay[1]))
    return {"gains": _gains(values), "transition": transition}, InteractingMultipleModel


def _tuned_adaptive(cls: type[AdaptiveGain]) -> Callable[[Mapping[str, float]], Any]:
    def apply(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
        def make(task: ManeuveringTarget) -> Policy:
            return cls(task, 10.0 ** values["log10_false_alarm"], values["ramp_scans"])

        return {"gains": _gains(values)}, make

    return apply


_GAIN_LIMITS = {"low": (0.05, 0.5), "high": (0.4, 0.95)}
_GAIN_START = {"low": 0.3, "high": 0.7}
_RAMP_LIMITS = {"log10_false_alarm": (-5.0, -0.5), "ramp_scans": (1.0, 20.0)}
_RAMP_START = {"log10_false_alarm": -3.0, "ramp_scans": 7.0}

TUNABLE = {
    "imm": Tunable(
        "weights",
        {**_GAIN_LIMITS, "stay_low": (0.5, 0.999), "stay_high": (0.3, 0.999)},
        {**_GAIN_START, "stay_low": 0.9, "stay_high": 0.9},
        _tuned_imm,
    ),
    "adaptive": Tunable(
        "gain",
        {**_GAIN_LIMITS, **_RAMP_LIMITS},
        {**_GAIN_START, **_RAMP_START},
        _tuned_adaptive(AdaptiveGain),
    ),
    "adaptive-rearm": Tunable(
        "gain",
        {**_GAIN_LIMITS, **_RAMP_LIMITS},
        {**_GAIN_START, **_RAMP_START},
        _tuned_adaptive(RearmingAdaptiveGain),
    ),
    "fixed-best": Tunable(
        "gain",
        {"alpha": (0.05, 0.95)},
        {"alpha": 0.65},
        lambda values: ({}, lambda task: FixedBest(task, values["alpha"])),
    ),
}

BASELINES = Baselines(
    policies={
        "imm": InteractingMultipleModel,
        "zero": ZeroEvidence,
        "hard-imm": HardInteractingMultipleModel,
        "adaptive": AdaptiveGain,
        "adaptive-rearm": RearmingAdaptiveGain,
        "fixed-low": FixedLow,
        "fixed-high": FixedHigh,
        "fixed-best": FixedBest,
        "random": RandomPolicy,
    },
    references={"known-turn": KnownTurn, "kalman-imm": KalmanInteractingMultipleModel},
    bounds={"known-input-bound": KnownInputBound},
    score_paper="imm",
    score_bound="known-turn",
    tunable=TUNABLE,
    best_constant="fixed-best",
    benchmark=(
        "imm",
        "adaptive",
        "adaptive-rearm",
        "fixed-low",
        "fixed-high",
        "fixed-best",
        "hard-imm",
        "random",
        "known-turn",
        "kalman-imm",
        "known-input-bound",
    ),
)
