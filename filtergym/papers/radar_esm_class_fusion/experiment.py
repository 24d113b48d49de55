"""Experiments with the paper's filter and its rivals on targets of every class, and variants."""

import math
from typing import Any, NamedTuple

import numpy

from ...baselines.radar_esm_tracking.metrics import SURE
from ...envs.engine.scenario_choice import make_task
from ...envs.radar_esm_tracking.parameters import RadarEsmTrackingParameters
from ...envs.radar_esm_tracking.task import RadarEsmTracking
from ...evaluation.running.parallel import Workers
from ...filters import class_fusion
from ..quantities import Quantity, evaluate_policy, mean, means, quantity
from ..reproduction import Progress, compute_units, later

EPISODES = 20000
SEED = 2008
WINDOWS = {"0.5-10 s": (1, 20), "10-30 s": (20, 60), "30-60 s": (60, 120)}
"""First and last scan, both included."""
LATE = WINDOWS["30-60 s"]
COMPONENTS = (("range", "m"), ("range rate", "m/s"), ("acceleration", "m/s²"))
CLASSES = ("S0", "S1", "S2")
INTERVAL = RadarEsmTrackingParameters.sampling_interval
WORTHLESS_RATE = 1e4
"""m/s: a radial velocity with this error is no better than two ranges half a second apart."""


def channel_error_covariance(
    models: class_fusion.Models,
    channels: class_fusion.Channels,
    target: int,
    channel: int,
    start: numpy.ndarray,
) -> numpy.ndarray:
    """Return the exact error covariance ``(n, n, K + 1)`` of the filter of class c on a target of class t.

    Truth and error e = estimate - truth obey one linear recursion of 2 n states,

        x(k) = Phi_t x + xi,   e(k) = (I - K H) (Phi_c e + (Phi_c - Phi_t) x - xi) + K v,

    so the covariance follows without Monte Carlo. The mean of the error is zero when that of x lies where Phi_c and
    Phi_t agree (any mean position and velocity).

    Args:
        models: of the classes.
        channels: design of the filters, for scans 0 to K.
        target: index t of the true class.
        channel: index c of the filter.
        start: joint covariance of (x, e) at scan 0, ``(2 n, 2 n)``.
    """
    n = models.Phi.shape[0]
    Phi_t, Phi_c = models.Phi[..., target], models.Phi[..., channel]
    scans = channels.gain.shape[-1]
    joint = start
    result = numpy.zeros((n, n, scans))
    result[..., 0] = start[n:, n:]
    for k in range(1, scans):
        K = channels.gain[..., channel, k]
        rest = numpy.eye(n) - K @ models.H
        A = numpy.block([[Phi_t, numpy.zeros((n, n))], [rest @ (Phi_c - Phi_t), rest @ Phi_c]])
        B = numpy.concatenate([numpy.eye(n), -rest])
        C = numpy.concatenate([numpy.zeros_like(K), K])
        joint = A @ joint @ A.T + B @ models.Q[..., target] @ B.T + C @ models.R @ C.T
        result[..., k] = joint[n:, n:]
    return result


def information_per_decision(probabilities: numpy.ndarray) -> numpy.ndarray:
    """Return the mean log-likelihood ratio of one ESM decision, nats, ``(M, M)``: row = true class, column = rival.

    It is the Kullback-Leibler divergence of rows of ``decision_probabilities``, which must be positive.
    """
    logarithm = numpy.log(probabilities)
    return numpy.sum(probabilities[:, None] * (logarithm[:, None] - logarithm[None]), axis=-1)


def leaky_transition(probability: float) -> tuple[tuple[float, ...], ...]:
    """Return the class transition matrix with ``probability`` of leaving a class, equally to each other one."""
    return tuple(
        tuple(1.0 - probability if i == j else probability / 2.0 for j in range(3)) for i in range(3)
    )


_SIGMA = RadarEsmTrackingParameters.acceleration_sigma
VARIANTS: dict[str, dict[str, Any]] = {
    "as in the main experiment": {},
    "sigma_a halved": {"acceleration_sigma": tuple(0.5 * s for s in _SIGMA)},
    "sigma_a doubled": {"acceleration_sigma": tuple(2.0 * s for s in _SIGMA)},
    "sigma_a of S1 for all classes": {"acceleration_sigma": (_SIGMA[1],) * 3},
    "alpha in reverse order": {"manoeuvrability": (0.1, 0.033, 0.025)},
    "noise on the acceleration only": {"process_noise": "acceleration"},
    "sigma_D = 300 m": {"range_sigma": 300.0},
    "range without Doppler": {"range_rate_sigma": WORTHLESS_RATE},
    "1 % class leakage, filters mixed": {"class_transition": leaky_transition(0.01)},
    "5 % class leakage, filters mixed": {"class_transition": leaky_transition(0.05)},
}
STEPS = 3 * len(CLASSES) + 2 + 2 + 2 * len(VARIANTS)


def parameters(variant: str = "as in the main experiment") -> RadarEsmTrackingParameters:
    """Return the parameters of scenario ``paper``, changed as in a variant of the experiment."""
    return make_task(RadarEsmTracking, "paper", **VARIANTS[variant]).parameters


def exact_mean_squares(p: RadarEsmTrackingParameters, target: int, channel: int) -> numpy.ndarray:
    """Return the exact mean square error of one class's filter on another's target, scans 1 to K, ``(3, K)``."""
    models, start = RadarEsmTracking.design_models(p)
    channels = class_fusion.design_channels(models, start, p.horizon)
    joint = numpy.zeros((6, 6))
    # The first estimate is the measurement with no acceleration: its error there is minus the acceleration.
    joint[2, 2] = joint[5, 5] = p.acceleration_sigma[target] ** 2
    joint[2, 5] = joint[5, 2] = -joint[2, 2]
    joint[3, 3], joint[4, 4] = p.range_sigma**2, p.range_rate_sigma**2
    covariance = channel_error_covariance(models, channels, target, channel, joint)
    return numpy.stack([covariance[i, i, 1:] for i in range(3)])


def rms(mean_square: numpy.ndarray, window: tuple[int, int]) -> float:
    """Return the root of the mean over a window of scans, of a mean square ``(K,)``."""
    return math.sqrt(mean_square[window[0] - 1 : window[1]].mean())


class Run(NamedTuple):
    """Errors, variances and class probabilities of a policy over episodes; ``of`` selects episodes."""

    error: numpy.ndarray
    """Estimate minus truth, ``(episodes, K, 3)``."""
    variance: numpy.ndarray
    """Reported variance, mean over episodes, ``(K, 3)``."""
    first_variance: numpy.ndarray
    """Reported variance in the first episode, ``(K, 3)``."""
    probability: numpy.ndarray
    """Probability of each class, ``(episodes, K, 3)``."""
    true_probability: numpy.ndarray
    """Probability of the true class, ``(episodes, K)``."""
    true_class: numpy.ndarray
    """Index of the true class, ``(episodes,)``."""
    true_type: numpy.ndarray
    """Index of the true type, ``(episodes,)``."""
    cost: numpy.ndarray
    """Mean cost over the scans, ``(episodes,)``."""

    def mean_square(self, component: int, window: tuple[int, int], of: Any = ...) -> numpy.ndarray:
        """Return the mean square error of a component over a window of scans, with bootstrap, ``(1 + resamples,)``."""
        return means((self.error[of][:, window[0] - 1 : window[1], component] ** 2).mean(axis=1))

    def true_at(self, second: float, of: Any = ...) -> Quantity:
        """Return the mean probability of the true class at a time, s."""
        return mean(self.true_probability[of][:, round(second / INTERVAL) - 1])

    def recognition(self, share: float, of: Any = ...) -> float:
        """Return the time, s, by which P(true class) has reached 0.9 in a share of the runs; infinite if never."""
        sure = self.true_probability[of] >= SURE
        return _quantile(numpy.where(sure.any(axis=1), sure.argmax(axis=1), math.inf), share)

    def settling(self, share: float) -> float:
        """Return the time, s, after which P(true class) stays at 0.9 or above in a share of the runs."""
        unsure = self.true_probability < SURE
        last = numpy.where(unsure.any(axis=1), unsure.shape[1] - unsure[:, ::-1].argmax(axis=1), 0)
        return _quantile(numpy.where(last < unsure.shape[1], last, math.inf), share)

    def wrong(self) -> numpy.ndarray:
        """Return a boolean mask ``(episodes, K)`` of the scans at which a wrong class has P >= 0.9."""
        other = numpy.arange(len(CLASSES)) != self.true_class[:, None, None]
        return ((self.probability >= SURE) & other).any(axis=2)

    def sure_and_wrong(self, of: Any = ...) -> Quantity:
        """Return the share of runs that end with P >= 0.9 for a wrong class."""
        return mean(self.wrong()[of][:, -1].astype(float))

    def calibration(self, window: tuple[int, int]) -> list[Quantity]:
        """Return the mean square error over the mean reported variance, of each component in a window."""
        reported = self.variance[window[0] - 1 : window[1]].mean(axis=0)
        return [quantity(self.mean_square(c, window) / reported[c]) for c in range(len(COMPONENTS))]


def _quantile(scan: numpy.ndarray, share: float) -> float:
    return INTERVAL * (float(numpy.sort(scan)[math.ceil(share * len(scan)) - 1]) + 1.0)


def run_policy(name: str, scenario: str, episodes: int, **keywords: Any) -> Run:
    """Run a policy over test episodes of a scenario, as one unit of work; return errors and probabilities."""
    one = evaluate_policy(RadarEsmTracking.id, name, scenario, episodes, seed=SEED, **keywords)
    variance = [one[f"variance_{c.name}"].values for c in RadarEsmTracking.components]
    return Run(
        one["error"].values,
        numpy.stack([v.mean(axis=0) for v in variance], axis=-1),
        numpy.stack([v[0] for v in variance], axis=-1),
        one["mode_probability"].values,
        one["true_class_probability"].values,
        one["true_class"].values[:, 0].astype(int),
        one["true_type"].values[:, 0].astype(int),
        one["cost"].values.mean(axis=1),
    )


class Results(NamedTuple):
    """Results of all experiments, from which claims, tables and figures are made."""

    episodes: int
    small: int
    """Episodes of every run beside the main one."""
    exact: dict[tuple[int, int], numpy.ndarray]
    """Mean squares by (target, filter), ``(3, K)``."""
    own: numpy.ndarray
    """Variances that the filters of the classes report, ``(3, classes, K)``."""
    fused: list[Run]
    """The paper's algorithm on each class."""
    radar: list[Run]
    esm: list[Run]
    every_decision: list[Run]
    """The paper's algorithm without and with reports of rejected decisions, on the same episodes."""
    fixed_type: dict[str, Run]
    """The printed rule and the joint posterior on targets of one type."""
    variants: dict[str, list[Run]]
    """Adaptive filter and radar alone, by name of the variant."""

    def excess(self, s: int, component: int, window: tuple[int, int]) -> Quantity:
        """Return the RMSE of the adaptive filter over the ideal filter's on targets of class s, minus one."""
        ideal = rms(self.exact[s, s][component], window)
        return quantity(numpy.sqrt(self.fused[s].mean_square(component, window)) / ideal - 1.0)

    def gain(self, s: int, component: int, window: tuple[int, int]) -> Quantity:
        """Return the RMSE of the non-adaptive filter over the adaptive filter's on targets of class s."""
        fixed = rms(self.exact[s, 2][component], window)
        return quantity(fixed / numpy.sqrt(self.fused[s].mean_square(component, window)))


def run_everything(progress: Progress, episodes: int, workers: Workers | None = None) -> Results:
    """Run all experiments of the paper, and return their results; ``STEPS`` units of work.

    Side experiments have a quarter of the episodes.
    """
    small = max(episodes // 4, 2)
    p = parameters()
    models, start = RadarEsmTracking.design_models(p)
    channels = class_fusion.design_channels(models, start, p.horizon)

    def by_class(name: str, count: int) -> list[Any]:
        return [later(run_policy, name, "paper", count, true_class=s) for s in CLASSES]

    def both(one: str, other: str, count: int, **keywords: Any) -> list[Any]:
        return [later(run_policy, name, "paper", count, **keywords) for name in (one, other)]

    results = Results(
        episodes,
        small,
        {(t, c): exact_mean_squares(p, t, c) for t in range(3) for c in range(3)},
        numpy.stack([channels.covariance[i, i, :, 1:] for i in range(3)]),
        by_class("quasi-optimal", episodes),
        by_class("radar-only", small),
        by_class("esm-only", small),
        both("quasi-optimal", "ungated", episodes),
        {name: later(run_policy, name, "fixed-type", episodes) for name in ("quasi-optimal", "joint-type")},
        {name: both("quasi-optimal", "radar-only", small, **keywords) for name, keywords in VARIANTS.items()},
    )
    done: Results = compute_units(results, progress, workers)
    return done
