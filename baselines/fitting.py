"""Parameters of a filter, fitted to a recording by maximum likelihood of the measurements as they were predicted.

The likelihood of a filter's one-step predictions is that of the recording under its model (Schweppe, IEEE Trans. IT 11,
1965). It is maximised by L-BFGS-B within the limits of the parameters from several starts. The intervals are profile
likelihood's: a value lies inside where the likelihood, the other parameters adapted, is at most half the chi-square
quantile below its maximum (Venzon and Moolgavkar, Applied Statistics 37, 1988).
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
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


class Profile(NamedTuple):
    """Likelihood of one parameter, the others adapted to each of its values."""

    values: numpy.ndarray
    """As they are searched, in ascending order."""
    drops: numpy.ndarray
    """Nats below the maximum at each."""
    interval: Interval


class Fit(NamedTuple):
    """A filter fitted to a recording."""

    values: dict[str, float]
    """Of the parameters, as they are searched."""
    log_likelihood: float
    """Of all measurements that counted, nats."""
    measurements: int
    """That counted."""
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
        """Start where everyone starts, as much less sure of it: a track starts from measurements."""
        return self.own.start(initial._replace(covariance=initial.covariance * self.factor**2), N)

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
    P, moves = len(at), numpy.diag(step)
    pairs = [(i, j) for i in range(P) for j in range(i, P)]
    signs = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
    points = [at + a * moves[i] + b * moves[j] for i, j in pairs for a, b in signs]
    found = likelihood(numpy.stack(points, axis=1)).reshape(len(pairs), 4)
    H = numpy.zeros((P, P))
    for (i, j), values in zip(pairs, found, strict=True):
        H[i, j] = H[j, i] = (values[0] - values[1] - values[2] + values[3]) / (4.0 * step[i] * step[j])
    return H


class _Place(NamedTuple):
    """Where a point of a profile lies."""

    parameter: int
    sign: float
    distance: float
    """From the best value of that parameter."""


def profile_intervals(likelihood: WindowLikelihood, tunable: Tunable, found: Fit) -> dict[str, Interval]:
    """Profile-likelihood intervals of all parameters; arguments as of :func:`profile_parameters`."""
    return {name: each.interval for name, each in profile_parameters(likelihood, tunable, found).items()}


def profile_parameters(likelihood: WindowLikelihood, tunable: Tunable, found: Fit) -> dict[str, Profile]:
    """Profile likelihood of all parameters, side by side.

    Every parameter is moved away from its best value, in steps to either limit; the others follow by Newton's method
    with the curvature at the maximum, which only ever raises the likelihood: an interval may be too narrow where the
    curvature changes much, never too wide by it.

    Args:
        likelihood: of the tunable's parameters.
        tunable: the estimator, with limits.
        found: of :func:`fit`.
    """
    names = list(tunable.limits)
    limits = numpy.array(list(tunable.limits.values())).T
    best = numpy.array([found.values[name] for name in names])
    information = _information(likelihood, best, limits)
    points, places = _profile_points(best, information, limits)
    held = numpy.array([place.parameter for place in places])
    value = likelihood(points)
    if len(names) > 1:
        value = _climb(likelihood, points, value, held, information, limits)
    # The maximum may turn out to be none: then the drop is counted from the highest point.
    drops = max(found.log_likelihood, float(value.max())) - value
    at_best = max(found.log_likelihood, float(value.max())) - found.log_likelihood
    profiles = {}
    for i, name in enumerate(names):
        ends = [_profile_end(places, drops, i, sign) for sign in (-1.0, 1.0)]
        (low, open_low), (high, open_high) = ends
        interval = Interval(float(best[i] - low), float(best[i] + high), open_low, open_high)
        mine = [k for k, place in enumerate(places) if place.parameter == i]
        values = numpy.append(points[i, mine], best[i])
        order = numpy.argsort(values)
        profiles[name] = Profile(values[order], numpy.append(drops[mine], at_best)[order], interval)
    return profiles


def _information(likelihood: WindowLikelihood, best: numpy.ndarray, limits: numpy.ndarray) -> numpy.ndarray:
    """Curvature of the likelihood at its maximum; a direction without one is taken for a flat one."""
    low, high = limits
    step = numpy.minimum(0.02, 0.01 * (high - low))
    H = _hessian(likelihood, numpy.clip(best, low + 2.0 * step, high - 2.0 * step), step)
    eigenvalues, vectors = numpy.linalg.eigh(-H)
    floor = 4.0 / (high - low).max() ** 2
    information: numpy.ndarray = (vectors * numpy.clip(eigenvalues, floor, None)) @ vectors.T
    return information


def _profile_points(
    best: numpy.ndarray, information: numpy.ndarray, limits: numpy.ndarray
) -> tuple[numpy.ndarray, list[_Place]]:
    """Points ``(P, n)`` on both sides of every parameter, the others where a quadratic likelihood has its ridge."""
    deviation = numpy.sqrt(numpy.diag(numpy.linalg.inv(information)))
    points, places = [], []
    for i in range(len(best)):
        others = numpy.delete(numpy.arange(len(best)), i)
        follow = numpy.linalg.solve(information[numpy.ix_(others, others)], information[others, i])
        for sign, limit in zip((-1.0, 1.0), limits[:, i], strict=True):
            room = sign * (limit - best[i])
            for distance in [*(d for d in numpy.array(STEPS) * deviation[i] if d < room), room]:
                point = best.copy()
                point[i] += sign * distance
                point[others] -= follow * sign * distance
                points.append(numpy.clip(point, *limits))
                places.append(_Place(i, sign, float(distance)))
    return numpy.stack(points, axis=1), places


def _profile_end(
    places: Sequence[_Place], drops: numpy.ndarray, parameter: int, sign: float
) -> tuple[float, bool]:
    """Distance at which the likelihood has fallen far enough, and whether it has not done so at the limit."""
    mine = [k for k, place in enumerate(places) if (place.parameter, place.sign) == (parameter, sign)]
    distances = [0.0, *(places[k].distance for k in mine)]
    # A drop grows with the square of the distance: it is interpolated in its root.
    roots = [0.0, *numpy.sqrt(numpy.clip(drops[mine], 0.0, None)).tolist()]
    for k in range(1, len(roots)):
        if roots[k] > math.sqrt(DROP):
            share = (math.sqrt(DROP) - roots[k - 1]) / (roots[k] - roots[k - 1])
            return distances[k - 1] + share * (distances[k] - distances[k - 1]), False
    return distances[-1], True


def _climb(
    likelihood: WindowLikelihood,
    state: numpy.ndarray,
    value: numpy.ndarray,
    held: numpy.ndarray,
    information: numpy.ndarray,
    limits: numpy.ndarray,
) -> numpy.ndarray:
    """Raise the likelihood of many points, each with one of its parameters held; return it.

    Args:
        likelihood: that is raised.
        state: points, ``(P, n)``.
        value: their log-likelihood, ``(n,)``.
        held: number of the parameter that each point holds, ``(n,)``.
        information: curvature at the maximum, ``(P, P)``.
        limits: of the parameters, ``(2, P)``.
    """
    P, count = state.shape
    step, scale = 1e-4, numpy.ones(count)
    for _ in range(NEWTON_STEPS):
        moved = [state + step * numpy.eye(P)[:, [i]] for i in range(P)]
        found = likelihood(numpy.concatenate(moved, axis=1)).reshape(P, count)
        with numpy.errstate(invalid="ignore"):
            gradient = numpy.nan_to_num((found - value) / step, posinf=0.0, neginf=0.0)
        direction = numpy.zeros_like(state)
        for i in range(P):
            others, mine = numpy.delete(numpy.arange(P), i), numpy.flatnonzero(held == i)
            direction[numpy.ix_(others, mine)] = numpy.linalg.solve(
                information[numpy.ix_(others, others)], gradient[numpy.ix_(others, mine)]
            )
        trial = numpy.clip(state + scale * direction, limits[0][:, None], limits[1][:, None])
        risen = likelihood(trial)
        better = risen > value
        state, value = numpy.where(better, trial, state), numpy.where(better, risen, value)
        scale = numpy.where(better, numpy.minimum(1.0, 2.0 * scale), 0.25 * scale)
    return value
