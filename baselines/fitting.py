"""Parameters of a filter, fitted to a recording by maximum likelihood of the measurements as they were predicted.

The likelihood of a filter's one-step predictions is that of the recording under its model (Schweppe, IEEE Trans. IT 11,
1965). It is maximised by L-BFGS-B within the limits of the parameters from several starts. The intervals are profile
likelihood's: a value lies inside where the likelihood, the other parameters adapted, is at most half the chi-square
quantile below its maximum (Venzon and Moolgavkar, Applied Statistics 37, 1988).
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy

from ..evaluation.likelihood import WindowLikelihood
from .table import Tunable

STARTS = 3
"""From which a fit begins: the values in force without it, and points inside the limits."""
DROP = 1.9207
"""Half the 95 % quantile of chi-square with one degree of freedom."""
NOISE_SCALE = "log10_noise_scale"
"""Name of the parameter that multiplies the stated deviations of the measurements, as its decimal logarithm."""
NOISE_LIMITS = (-1.5, 0.0, 1.5)
STEPS = 0.5, 1.0, 1.5, 2.0, 2.5, 3.5, 6.0, 12.0
"""Distances from the maximum at which a profile is computed, in units of the parameter's deviation at the maximum."""
NEWTON_STEPS = 5
IDENTIFIABLE = 100.0
"""Largest ratio of the ends of an interval of a size; what is wider says nothing."""


class Interval(NamedTuple):
    """Where a parameter lies with 95 % confidence, as it is searched."""

    low: float
    high: float
    open_low: bool
    """Whether the likelihood is still high at the lower limit of the search; likewise the upper one."""
    open_high: bool


class Fit(NamedTuple):
    """A filter fitted to a recording."""

    values: dict[str, float]
    """Of the parameters, as they are searched."""
    log_likelihood: float
    """Of all measurements that counted, nats."""
    count: int
    """Measurements that counted."""
    spread: float
    """Nats between the best and the worst of the starts' ends."""
    at_limit: tuple[str, ...]
    """Parameters that ended at a limit of the search."""


class ScaledNoise:
    """An estimator that takes stated deviations of measurements for larger or smaller by a factor.

    Args:
        own: the estimator.
        scaled: multiplies the deviations stated in a measurement by a factor.
        factor: a number, or ``(N,)``.
    """

    kind = "estimator"

    def __init__(self, own: Any, scaled: Callable[[Any, Any], Any], factor: Any) -> None:
        self.own, self.scaled, self.factor = own, scaled, factor
        self.traceable = getattr(own, "traceable", False)

    def start(self, initial: Any, N: int) -> Any:
        """Start where everyone starts."""
        return self.own.start(initial, N)

    def update(self, measurement: Any, memory: Any) -> Any:
        """Update with the measurement as it is taken."""
        return self.own.update(self.scaled(measurement, self.factor), memory)


def with_noise_scale(tunable: Tunable, scaled: Callable[[Any, Any], Any]) -> Tunable:
    """Return a tunable estimator with the scale of the measurement noise as one more parameter.

    Args:
        tunable: an estimator.
        scaled: multiplies the deviations stated in a measurement by a factor.
    """
    low, start, high = NOISE_LIMITS

    def apply(values: Mapping[str, Any]) -> tuple[dict[str, Any], Callable[[Any], Any]]:
        own = {name: value for name, value in values.items() if name != NOISE_SCALE}
        keywords, make = tunable.apply(own)
        factor = 10.0 ** values[NOISE_SCALE]
        return keywords, lambda task: ScaledNoise(make(task), scaled, factor)

    limits = {**tunable.limits, NOISE_SCALE: (low, high)}
    start_values = {**tunable.start, NOISE_SCALE: start}
    return dataclasses.replace(tunable, limits=limits, start=start_values, apply=apply)


def fit(likelihood: WindowLikelihood, tunable: Tunable, seed: int = 0, starts: int = STARTS) -> Fit:
    """Maximise the likelihood of a recording's measurements.

    Args:
        likelihood: of the tunable's parameters.
        tunable: the estimator, with limits.
        seed: of the starts.
        starts: how many.
    """
    from scipy.optimize import minimize

    limits = list(tunable.limits.values())
    low, high = numpy.array(limits).T
    generator = numpy.random.default_rng(seed)

    def objective(vector: numpy.ndarray) -> tuple[float, numpy.ndarray]:
        value, gradient = likelihood.gradient(vector)
        if not (math.isfinite(value) and numpy.isfinite(gradient).all()):
            return 1e6, numpy.zeros(len(vector))
        return -value / likelihood.count, -gradient / likelihood.count

    ends = []
    for i in range(starts):
        begin = low + (high - low) * generator.uniform(0.15, 0.85, len(low))
        if i == 0:
            begin = numpy.clip([tunable.start[name] for name in tunable.limits], low, high)
        ends.append(
            minimize(
                objective,
                begin,
                jac=True,
                method="L-BFGS-B",
                bounds=limits,
                options={"maxiter": 80, "ftol": 1e-9},
            )
        )
    best = min(ends, key=lambda end: float(end.fun))
    edge = 1e-3 * (high - low)
    at_limit = tuple(
        name
        for name, value, a, b, margin in zip(tunable.limits, best.x, low, high, edge, strict=True)
        if value - a < margin or b - value < margin
    )
    spread = likelihood.count * (max(float(end.fun) for end in ends) - float(best.fun))
    values = dict(zip(tunable.limits, map(float, best.x), strict=True))
    return Fit(values, -likelihood.count * float(best.fun), likelihood.count, spread, at_limit)


def _hessian(likelihood: WindowLikelihood, at: numpy.ndarray, step: numpy.ndarray) -> numpy.ndarray:
    """Second derivatives of the log-likelihood by central differences, ``(P, P)``."""
    P = len(at)
    moves = numpy.diag(step)
    points = [at]
    for i in range(P):
        for j in range(i, P):
            points += [
                at + moves[i] + moves[j],
                at + moves[i] - moves[j],
                at - moves[i] + moves[j],
                at - moves[i] - moves[j],
            ]
    found = iter(likelihood(numpy.stack(points, axis=1)))
    next(found)
    H = numpy.zeros((P, P))
    for i in range(P):
        for j in range(i, P):
            a, b, c, d = (next(found) for _ in range(4))
            H[i, j] = H[j, i] = (a - b - c + d) / (4.0 * step[i] * step[j])
    return H


def profile_intervals(likelihood: WindowLikelihood, tunable: Tunable, found: Fit) -> dict[str, Interval]:
    """Profile-likelihood intervals of all parameters, side by side.

    Every parameter is moved away from its best value, in steps to either limit; the others follow by Newton's method
    with the curvature at the maximum, which only ever raises the likelihood: an interval may be too narrow where the
    curvature changes much, never too wide by it.

    Args:
        likelihood: of the tunable's parameters.
        tunable: the estimator, with limits.
        found: of :func:`fit`.
    """
    names = list(tunable.limits)
    low, high = numpy.array(list(tunable.limits.values())).T
    best = numpy.array([found.values[name] for name in names])
    P = len(names)
    step = numpy.minimum(0.02, 0.01 * (high - low))
    inside = numpy.clip(best, low + 2.0 * step, high - 2.0 * step)
    H = _hessian(likelihood, inside, step)
    # What is no maximum along some direction is taken for a flat one.
    eigenvalues, vectors = numpy.linalg.eigh(-H)
    floor = 4.0 / (high - low).max() ** 2
    information = (vectors * numpy.clip(eigenvalues, floor, None)) @ vectors.T
    deviation = numpy.sqrt(numpy.diag(numpy.linalg.inv(information)))
    points, fixed, places = [], [], []
    for i in range(P):
        for sign, limit in ((-1.0, low[i]), (1.0, high[i])):
            room = sign * (limit - best[i])
            distances = [d for d in numpy.array(STEPS) * deviation[i] if d < room]
            for distance in [*distances, room]:
                point = best.copy()
                others = [j for j in range(P) if j != i]
                if others:
                    follow = numpy.linalg.solve(
                        information[numpy.ix_(others, others)], information[others, i]
                    )
                    point[others] = best[others] - follow * sign * distance
                point[i] = best[i] + sign * distance
                points.append(numpy.clip(point, low, high))
                fixed.append(i)
                places.append((i, sign, distance))
    state, fixed_at = numpy.stack(points, axis=1), numpy.array(fixed)
    value = likelihood(state)
    if P > 1:
        state, value = _climb(likelihood, state, value, fixed_at, information, low, high)
    intervals = {}
    for i, name in enumerate(names):
        ends, opened = [], []
        for sign in (-1.0, 1.0):
            mine = [k for k, place in enumerate(places) if place[0] == i and place[1] == sign]
            # The maximum may turn out to be no maximum: then where the profile is highest counts.
            drops = numpy.array([0.0, *(max(found.log_likelihood, value.max()) - value[k] for k in mine)])
            distances = numpy.array([0.0, *(places[k][2] for k in mine)])
            beyond = numpy.flatnonzero(drops > DROP)
            if not len(beyond):
                ends.append(best[i] + sign * distances[-1])
                opened.append(True)
                continue
            k = int(beyond[0])
            # A drop grows with the square of the distance: interpolated in its root.
            a, b = math.sqrt(max(drops[k - 1], 0.0)), math.sqrt(drops[k])
            share = (math.sqrt(DROP) - a) / (b - a) if b > a else 0.0
            ends.append(best[i] + sign * (distances[k - 1] + share * (distances[k] - distances[k - 1])))
            opened.append(False)
        intervals[name] = Interval(float(ends[0]), float(ends[1]), opened[0], opened[1])
    return intervals


def _climb(
    likelihood: WindowLikelihood,
    state: numpy.ndarray,
    value: numpy.ndarray,
    fixed: numpy.ndarray,
    information: numpy.ndarray,
    low: numpy.ndarray,
    high: numpy.ndarray,
) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Raise the likelihood of many points, each with one of its parameters held."""
    P, count = state.shape
    step, scale = 1e-4, numpy.ones(count)
    for _ in range(NEWTON_STEPS):
        moved = [state + step * numpy.eye(P)[:, [i]] for i in range(P)]
        found = likelihood(numpy.concatenate(moved, axis=1)).reshape(P, count)
        with numpy.errstate(invalid="ignore"):
            gradient = numpy.nan_to_num((found - value) / step, posinf=0.0, neginf=0.0)
        direction = numpy.zeros_like(state)
        for i in range(P):
            chosen = numpy.flatnonzero(fixed == i)
            others = [j for j in range(P) if j != i]
            if len(chosen):
                direction[numpy.ix_(others, chosen)] = numpy.linalg.solve(
                    information[numpy.ix_(others, others)], gradient[numpy.ix_(others, chosen)]
                )
        trial = numpy.clip(state + scale * direction, low[:, None], high[:, None])
        risen = likelihood(trial)
        better = risen > value
        state, value = numpy.where(better, trial, state), numpy.where(better, risen, value)
        scale = numpy.where(better, numpy.minimum(1.0, 2.0 * scale), 0.25 * scale)
    return state, value
