"""Policies, reference estimator, bound and metrics of RadarEsmTracking.

Equation numbers and readings are those of the task's paper (Ivanov, Seliverstov).
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy
import xarray

from ...envs.controls import signed_exponential
from ...envs.radar_esm_tracking.task import COUNT_SHOWN, RadarEsmTracking, State
from ...envs.task import Array, Task
from ...evaluation.bootstrap import Bootstrap, Estimate
from ...evaluation.competitors import ConstantPolicy, Policy, RandomPolicy
from ...evaluation.metrics import Measure, squared_errors
from ...filters import bounds, class_fusion, imm, kalman
from ...filters.small_matrices import cholesky
from ..table import Baselines, Tunable

SURE = 0.9
"""Probability from which a class counts as recognised."""
TIMES = (2.0, 5.0, 10.0, 20.0, 30.0, 60.0)
"""Seconds at which the probability of the true class is reported."""


# --- policies


class QuasiOptimal(ConstantPolicy):
    """The paper's algorithm (8)-(12): nothing added to its rule."""

    control = "evidence"

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.action = task.paper_policy.action


class NonAdaptive(Policy):
    """The paper's comparator: the filter of the most agile class, whatever the target."""

    control = "mode"

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Name the last class for every episode."""
        return numpy.full(len(observation), len(self.task.modes) - 1), None


class FixedWeights(ConstantPolicy):
    """One combination of the filters, never changed; uniform unless it is told otherwise."""

    control = "weights"

    def __init__(self, task: Task, weights: tuple[float, ...] | None = None) -> None:
        super().__init__(task)
        self.action = weights or (1.0,) * len(task.modes)


class _Posterior(Policy):
    """Shared reading of the observation: log-likelihoods of the classes, ``(M, N)`` each."""

    control = "weights"

    def __init__(self, task: RadarEsmTracking) -> None:
        super().__init__(task)
        p = task.parameters
        self.accumulated = task.columns([f"accumulated_log_likelihood_{m}" for m in task.modes])
        self.log_likelihood = task.columns([f"log_likelihood_{m}" for m in task.modes])
        self.last_weight = task.columns([f"last_weight_{m}" for m in task.modes])
        types = range(task.types)
        self.used_count = task.columns([f"used_count_{j}" for j in types])
        self.refused_count = task.columns([f"refused_count_{j}" for j in types])
        self.decision = task.columns([f"decision_{j}" for j in types])
        self.decision_refused = task.columns(["decision_refused"])[0]
        self.log_prior = imm.log_probabilities(numpy.array(p.prior))[:, None]
        self.log_recognition = imm.log_probabilities(numpy.array(p.recognition))
        self.log_composition = imm.log_probabilities(numpy.array(p.composition))
        self.log_esm = imm.log_probabilities(
            class_fusion.decision_probabilities(numpy.array(p.recognition), numpy.array(p.composition))
        )

    def radar(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Log-likelihood of all radar measurements so far, up to a constant."""
        return signed_exponential(observation[:, self.accumulated], numpy).T

    def counts(self, observation: numpy.ndarray, refused: float = 0.0) -> numpy.ndarray:
        """How often the ESM decided for each type, refused decisions counting ``refused``, ``(J, N)``."""
        shown = observation[:, self.used_count] + refused * observation[:, self.refused_count]
        return COUNT_SHOWN * shown.T

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Log-probability of the classes, up to a constant."""
        raise NotImplementedError

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """State the probabilities as weights."""
        return imm.normalised_exponential(self.log_posterior(observation)).T, None


class RadarOnly(_Posterior):
    """Class probabilities from the radar's innovations alone."""

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Prior and radar."""
        return self.log_prior + self.radar(observation)


class EsmOnly(_Posterior):
    """Class probabilities from the ESM decisions alone, each taken as new evidence, as in (8)."""

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Prior and ESM."""
        return self.log_prior + self.log_esm @ self.counts(observation)


class Ungated(_Posterior):
    """The paper's rule with every ESM decision, also those that the gate refuses.

    With one emitter in sight a refused decision is as good as any: on ``paper`` this is the exact posterior
    given all that the agent is shown, which nothing can beat. With a second emitter the gate is needed.
    """

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Prior, radar, and all decisions."""
        return self.log_prior + self.radar(observation) + self.log_esm @ self.counts(observation, 1.0)


class MostProbable(_Posterior):
    """The most probable class (8) alone, in place of the combination (11)."""

    control = "mode"

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Prior, radar and ESM, as the paper's algorithm has them."""
        return self.log_prior + self.radar(observation) + self.log_esm @ self.counts(observation)

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Name the class."""
        return numpy.argmax(self.log_posterior(observation), axis=0), None


class JointType(_Posterior):
    """Posterior over type and class together: right where a target has one type.

    Args:
        task: the problem.
        refused: what a decision that the gate refuses counts for, 0 to 1.
        esm: what any decision counts for, 0 to 1.
    """

    def __init__(self, task: RadarEsmTracking, refused: float = 0.0, esm: float = 1.0) -> None:
        super().__init__(task)
        self.refused, self.esm = refused, esm

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Prior, radar, and all decisions as statements about one type."""
        counts = self.esm * self.counts(observation, self.refused)
        esm = class_fusion.fixed_type_log_likelihood(counts, self.log_recognition, self.log_composition)
        return self.log_prior + self.radar(observation) + esm


class Leaky(_Posterior):
    """The paper's rule (8) with class transitions: it never becomes so sure that it cannot turn round.

    Only the weights leak; the filters stay as they are (``class_transition`` would mix them too).

    Args:
        task: the problem.
        leak: probability that the class changes in one scan, shared equally by the others.
        esm: what a decision counts for, 0 to 1.
    """

    def __init__(self, task: RadarEsmTracking, leak: float = 0.01, esm: float = 1.0) -> None:
        super().__init__(task)
        classes = len(task.modes)
        others = (1.0 - numpy.eye(classes)) / (classes - 1)
        self.transition = (1.0 - leak) * numpy.eye(classes) + leak * others
        self.esm = esm

    def log_posterior(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Last weights and this scan's radar measurement, transition, this scan's decision."""
        last = imm.log_probabilities(observation[:, self.last_weight].T)
        this_scan = signed_exponential(observation[:, self.log_likelihood], numpy).T
        predicted = self.transition.T @ imm.mode_posterior(last, this_scan)
        usable = observation[:, self.decision] * (1.0 - observation[:, self.decision_refused, None])
        return imm.log_probabilities(predicted) + self.esm * (self.log_esm @ usable.T)


# --- reference estimator and bound


class _Track(NamedTuple):
    mean: Array
    covariance: Array
    target_class: Array
    """Class that governs the coming motion, ``(N,)``."""


class _KnownClass:
    """Models that the true class chooses scan by scan."""

    def __init__(self, task: RadarEsmTracking) -> None:
        self.task = task
        models, start = task.design_models(task.parameters)
        self.start_covariance = task.constant(start)
        # What the task's first filter expects of scan 1, to take the measurement of scan 0 back from it.
        self.expected = task.constant(
            numpy.linalg.inv(class_fusion.design_channels(models, start, 1).whitening[..., 0, 1])
        )

    def start_of(self, state: State) -> _Track:
        """Estimate at scan 0, from the task's state at scan 1.

        The innovation of any filter, unwhitened, and the measurement of scan 1 give the prediction from the
        first measurement, and so that one.
        """
        xp, task = self.task.xp, self.task
        whitened = state.bank.innovation[:, 0]
        innovation = [
            self.expected[0, 0] * whitened[0],
            self.expected[1, 0] * whitened[0] + self.expected[1, 1] * whitened[1],
        ]
        rate = state.measurement[1] - innovation[1]
        distance = state.measurement[0] - innovation[0] - task.parameters.sampling_interval * rate
        target_class = state.truth.target_class
        return _Track(
            xp.stack([distance, rate, 0.0 * rate]),
            xp.take(self.start_covariance, target_class, axis=-1),
            target_class,
        )

    def of(self, matrices: Array, target_class: Array) -> Array:
        """Matrix of each lane's class, ``(3, 3, N)``."""
        return self.task.xp.take(matrices, target_class, axis=-1)


class Ideal(_KnownClass):
    """The Kalman filter of the true class; where the class changes it switches its model at that scan."""

    kind = "reference"
    knows = "the true class at every scan"

    def start(self, state: State) -> _Track:
        """Start where the task's filters start."""
        return self.start_of(state)

    def update(self, state: State, memory: _Track) -> tuple[State, _Track]:
        """Predict under the class that governed the motion, and update."""
        task, xp = self.task, self.task.xp
        models, governed = task.models, memory.target_class
        mean, covariance = kalman.predict(
            memory.mean, memory.covariance, self.of(models.Phi, governed), self.of(models.Q, governed)
        )
        factor = cholesky(covariance[:2, :2] + models.R[:, :, None])
        whitened = class_fusion.whiten(factor, state.measurement - mean[:2])
        result = kalman.update(mean, covariance, state.measurement, models.H, models.R)
        # What the records show is this filter's: it is sure of the class, and its innovation is the bank's.
        classes = xp.arange(task.classes, device=governed.device)[:, None]
        certain = xp.astype(classes == state.truth.target_class, mean.dtype)
        bank = state.bank._replace(
            probabilities=certain,
            log_predicted=imm.log_probabilities(certain),
            innovation=whitened[:, None] + 0.0 * state.bank.innovation,
        )
        track = _Track(result.mean, result.covariance, state.truth.target_class)
        reported = state._replace(bank=bank, estimate=result.mean, estimate_covariance=result.covariance)
        return reported, track


class KnownClassBound(_KnownClass):
    """Exact mean square error of the ideal filter, by its covariance recursion: no estimator does better."""

    kind = "bound"
    knows = "the true class at every scan"

    def start(self, state: State) -> _Track:
        """Covariance of the start."""
        return self.start_of(state)

    def update(self, state: State, memory: _Track) -> tuple[Array, _Track]:
        """Bound after this scan: the diagonal of the covariance."""
        models, governed = self.task.models, memory.target_class
        P = bounds.predicted_bound(
            memory.covariance, self.of(models.Phi, governed), self.of(models.Q, governed)
        )
        P = bounds.posterior_cramer_rao_bound(P, models.H, models.R)
        mean_square = self.task.xp.stack([P[i, i] for i in range(3)])
        return mean_square, _Track(memory.mean, P, state.truth.target_class)


# --- metrics of this environment


def _ratio(bootstrap: Bootstrap, values: numpy.ndarray, shares: numpy.ndarray) -> numpy.ndarray:
    """Ratio of means over episodes, ``(1 + resamples,)``."""
    with numpy.errstate(divide="ignore", invalid="ignore"):
        return bootstrap.means(values) / bootstrap.means(shares)


def time_quantile(
    bootstrap: Bootstrap, first: numpy.ndarray, chosen: numpy.ndarray, seconds: numpy.ndarray, share: float
) -> Estimate:
    """Time by which a share of the chosen episodes has got there; infinite where too few do.

    Args:
        bootstrap: of the episodes.
        first: index of the first time at which it holds, or the number of times, ``(episodes,)``.
        chosen: which episodes count, ``(episodes,)`` booleans.
        seconds: of each time, ``(T,)``.
        share: such as 0.5 for the median.
    """
    reached = (first[:, None] == numpy.arange(len(seconds))) & chosen[:, None]
    arrived = numpy.cumsum(bootstrap.means(reached.astype(float)), axis=1)
    everyone = bootstrap.means(chosen.astype(float))[:, None]
    # Rounding of the sums must not move a share that is met exactly.
    enough = arrived >= share * everyone * (1.0 - 1e-9)
    times = numpy.where(enough.any(axis=1), seconds[enough.argmax(axis=1)], math.inf)
    return bootstrap.interval(times)


def _first(condition: numpy.ndarray) -> numpy.ndarray:
    """Index of the first true entry along time, or the number of times, ``(episodes,)``."""
    return numpy.where(condition.any(axis=1), condition.argmax(axis=1), condition.shape[1])


def _recognition(
    name: str, bootstrap: Bootstrap, first: numpy.ndarray, chosen: numpy.ndarray, seconds: numpy.ndarray,
    component: str,
) -> Iterator[Measure]:  # fmt: skip
    for suffix, share in (("median", 0.5), ("90_quantile", 0.9)):
        value = time_quantile(bootstrap, first, chosen, seconds, share)
        yield Measure(f"{name}_{suffix}", component, "all", value, "s")
    never = ((first == len(seconds)) & chosen).astype(float)
    censored = bootstrap.interval(_ratio(bootstrap, never, chosen.astype(float)))
    yield Measure(f"{name}_censored", component, "all", censored, "1")


def metrics(run: xarray.Dataset, bootstrap: Bootstrap) -> list[Measure]:
    """Errors by true class, recognition of the class, and calibration, of one policy.

    ``rmse_by_class`` (by the class at each measurement); ``mean_true_class_probability`` at stated times;
    ``time_to_recognise_median``, ``_90_quantile`` (first P(true class) >= 0.9) and ``_censored``, the share of
    runs in which that never comes while the first class lasts; ``time_to_recognise_change_...`` the same
    after a change, counted from it; ``sure_and_wrong``, the share of runs with P >= 0.9 for a wrong class at
    60 s (or the end); ``calibration_ratio``, mean square error over mean reported variance;
    ``confidence_excess``, mean probability of the most probable class minus how often it is the true one.
    """
    if "true_class" not in run or numpy.isnan(run["true_class"].values).any():
        return []  # a bound
    return list(_measures(run, bootstrap))


def _measures(run: xarray.Dataset, bootstrap: Bootstrap) -> Iterator[Measure]:
    windows = run.attrs["windows"]
    slices = {name: slice(first - 1, last) for name, (first, last) in windows.items()}
    units = dict(zip(run["component"].values.tolist(), run["unit"].values.tolist(), strict=True))
    true_class = run["true_class"].values.astype(int)
    true_probability = run["true_class_probability"].values
    probability = run["mode_probability"].values
    seconds = run["seconds"].values[0]
    modes = run["mode"].values.tolist()
    groups = {"": numpy.ones(true_class.shape, dtype=bool)} | {
        mode: true_class == s for s, mode in enumerate(modes) if (true_class == s).any()
    }

    for component, unit in units.items():
        squares = squared_errors(run, component, {})
        variance = run[f"variance_{component}"].values
        for window, times in slices.items():
            means = squares[:, times].mean(axis=1)
            for mode, of_mode in groups.items():
                if mode:
                    share = of_mode[:, times].mean(axis=1)
                    if share.any():
                        ratio = _ratio(bootstrap, (squares * of_mode)[:, times].mean(axis=1), share)
                        value = bootstrap.interval(numpy.sqrt(ratio))
                        yield Measure("rmse_by_class", f"{component} {mode}", window, value, unit)
            ratio = _ratio(bootstrap, means, variance[:, times].mean(axis=1))
            yield Measure("calibration_ratio", component, window, bootstrap.interval(ratio), "1")

    for moment in TIMES:
        at = numpy.flatnonzero(numpy.isclose(seconds, moment))
        for mode, of_mode in groups.items():
            if len(at) and of_mode[:, at[0]].any():
                chosen = of_mode[:, at[0]].astype(float)
                ratio = _ratio(bootstrap, true_probability[:, at[0]] * chosen, chosen)
                value = bootstrap.interval(ratio)
                yield Measure("mean_true_class_probability", mode, f"{moment:g} s", value, "1")

    sure = true_probability >= SURE
    same = true_class == true_class[:, :1]
    for mode, of_mode in groups.items():
        if of_mode[:, 0].any():
            yield from _recognition(
                "time_to_recognise", bootstrap, _first(sure & same), of_mode[:, 0], seconds, mode
            )
    if not same.all():
        change = _first(~same)
        after = numpy.arange(len(seconds)) >= change[:, None]
        waited = _first(sure & after)
        waited = numpy.where(waited < len(seconds), waited - change, len(seconds))
        changed = change < len(seconds)
        yield from _recognition(
            "time_to_recognise_change", bootstrap, waited, changed, seconds - seconds[0], ""
        )

    reached = numpy.flatnonzero(numpy.isclose(seconds, TIMES[-1]))
    last = int(reached[0]) if len(reached) else len(seconds) - 1
    wrong = (probability[:, last] >= SURE) & (numpy.arange(len(modes)) != true_class[:, last, None])
    for mode, of_mode in groups.items():
        chosen = of_mode[:, last].astype(float)
        if chosen.any():
            ratio = _ratio(bootstrap, wrong.any(axis=1) * chosen, chosen)
            yield Measure("sure_and_wrong", mode, f"{seconds[last]:g} s", bootstrap.interval(ratio), "1")

    excess = probability.max(axis=2) - (probability.argmax(axis=2) == true_class)
    for window, times in slices.items():
        value = bootstrap.estimate(excess[:, times].mean(axis=1))
        yield Measure("confidence_excess", "", window, value, "1")


# --- what can be tuned


def _fixed_weights(values: Mapping[str, float]) -> tuple[dict[str, Any], Callable[[Any], Policy]]:
    weights = tuple(values[name] for name in ("S0", "S1", "S2"))
    return {}, lambda task: FixedWeights(task, weights)


TUNABLE = {
    "fixed-weights": Tunable(
        "weights",
        {"S0": (0.0, 1.0), "S1": (0.0, 1.0), "S2": (0.0, 1.0)},
        {"S0": 1.0, "S1": 1.0, "S2": 1.0},
        _fixed_weights,
    ),
    "leaky": Tunable(
        "weights",
        {"log10_leak": (-6.0, -0.5), "esm": (0.0, 1.0)},
        {"log10_leak": -2.0, "esm": 1.0},
        lambda values: ({}, lambda task: Leaky(task, 10.0 ** values["log10_leak"], values["esm"])),
    ),
    "joint-type": Tunable(
        "weights",
        {"refused": (0.0, 1.0), "esm": (0.0, 1.0)},
        {"refused": 0.0, "esm": 1.0},
        lambda values: ({}, lambda task: JointType(task, values["refused"], values["esm"])),
    ),
}

BASELINES = Baselines(
    environment="filtergym/RadarEsmTracking-v0",
    policies={
        "quasi-optimal": QuasiOptimal,
        "joint-type": JointType,
        "leaky": Leaky,
        "ungated": Ungated,
        "most-probable": MostProbable,
        "radar-only": RadarOnly,
        "esm-only": EsmOnly,
        "non-adaptive": NonAdaptive,
        "fixed-weights": FixedWeights,
        "random": RandomPolicy,
    },
    references={"ideal": Ideal},
    bounds={"known-class-bound": KnownClassBound},
    score_paper="quasi-optimal",
    score_bound="ideal",
    tunable=TUNABLE,
    best_constant="fixed-weights",
    physical=("rmse", "acceleration"),
    benchmark=(
        "quasi-optimal",
        "joint-type",
        "leaky",
        "ungated",
        "most-probable",
        "radar-only",
        "esm-only",
        "non-adaptive",
        "random",
        "ideal",
        "known-class-bound",
    ),
    metrics=metrics,
)
