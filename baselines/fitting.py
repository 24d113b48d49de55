"""Maximum-likelihood fits of the parameters of a filter to a recording.

The likelihood of a filter's one-step predictions is that of the recording under its model (Schweppe, IEEE
Trans. IT 11, 1965). It is maximised by L-BFGS-B within the limits of the parameters from several starts. The
intervals are profile likelihood's: a value lies inside where the likelihood, the other parameters adapted, is
at most half the chi-square quantile below its maximum (Venzon and Moolgavkar, Applied Statistics 37, 1988).

Measurements may come from a mixture: most have the stated deviations, a fitted share has ``WIDE`` times as large ones
(Huber, Annals of Mathematical Statistics 35, 1964). The filter computes both updates and uses the likelier one.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ..envs.contract.filter import Filter, FilterInput, Likelihood
from ..envs.contract.observation import Array
from ..envs.contract.task import Task
from ..evaluation.competitors.filters import as_filter
from ..evaluation.competitors.likelihood import WindowLikelihood
from ..filters.array_namespace import select_nested
from .table import Tunable

STARTS = 3
"""Number of starts of a fit: the values in force without it, and points inside the limits."""
DROP = 1.9207
"""Half the 95 % quantile of chi-square with one degree of freedom."""
NOISE_SCALE = "log10_noise_scale"
"""Name of the parameter that multiplies the stated deviations of the measurements, as its decimal logarithm."""
NOISE_LIMITS = (-1.5, 0.0, 1.5)
OUTLIER_SHARE = "log10_outlier_share"
"""Name of the parameter that is the share of outliers among the measurements, as its decimal logarithm."""
SHARE_LIMITS = (-4.0, -1.7, -0.5)
WIDE = 20.0
"""Ratio of the deviation of an outlier to that of the other measurements."""
SCREENED = 24
"""Number of random points inside the limits, of which the likeliest are starts of a fit."""
HIGHER = 0.1
"""Nats by which a point of a profile must be likelier than the fit for the fit to start again from there."""
MOST_RESTARTS = 6
STEPS = 0.5, 1.0, 1.5, 2.0, 2.5, 3.5, 6.0, 12.0
"""Distances from the maximum at which a profile is computed, in units of the parameter's deviation at the maximum."""
NEWTON_STEPS = 8
"""Largest number of Newton steps of a search for the other parameters at a step of a profile."""
LEAST_GAIN = 1e-4
"""Smallest gain, nats, for another step of it."""
STEEP = 1.5
"""Largest ratio of the fall of a likelihood to that of a quadratic one; where it falls more a second search starts
elsewhere.
"""
IDENTIFIABLE = 100.0
"""Largest ratio of the ends of an interval of a positive parameter; a wider interval carries no information."""


class Interval(NamedTuple):
    """95 % confidence interval of a parameter, in the units of the search."""

    low: float
    high: float
    open_low: bool
    """Whether the likelihood is still high at the lower limit of the search."""
    open_high: bool
    """Whether the likelihood is still high at the upper limit of the search."""


class Profile(NamedTuple):
    """Profile likelihood of one parameter: the others are adapted to each of its values."""

    values: numpy.ndarray
    """Values of the parameter in the units of the search, in ascending order."""
    drops: numpy.ndarray
    """Distance of the log-likelihood from its maximum at each, nats."""
    interval: Interval


class Fit(NamedTuple):
    """Fitted parameters of a filter, with the log-likelihood of the recording."""

    values: dict[str, float]
    """Values of the parameters in the units of the search."""
    log_likelihood: float
    """Log-likelihood of the measurements of the fit, nats."""
    measurements: int
    """Number of measurements of the fit."""
    spread: float
    """Difference between the best and the worst maximum found from the starts, nats."""
    at_limit: tuple[str, ...]
    """Parameters that ended at a limit of the search."""


class ScaledNoise(Filter[Task, Any, Any]):
    """A filter run with scaled deviations of measurements; its state is the inner filter's."""

    def __init__(self, own: Filter[Any, Any, Any], scaled: Callable[[Any, Any], Any], factor: Any) -> None:
        super().__init__(own.task)
        self.own = own
        self.scaled = scaled
        self.factor = factor
        self.in_python: bool = own.in_python

    def start(self, initial: Any) -> Any:
        """Start the inner filter, with the initial covariance times the factor's square; return its state."""
        return self.own.start(initial._replace(covariance=initial.covariance * self.factor**2))

    def predict(self, state: Any, measurement: Any) -> Any:
        """Predict the inner filter to the scaled measurement; return its state."""
        return self.own.predict(state, self.scaled(measurement, self.factor))

    def update(self, state: Any, inputs: FilterInput) -> Any:
        """Update the inner filter with the scaled measurement; return its state."""
        return self.own.update(state, FilterInput(self.scaled(inputs.measurement, self.factor)))

    def mean(self, state: Any) -> Array:
        """Return the mean of the inner filter, ``(C, N)``."""
        return self.own.mean(state)

    def covariance(self, state: Any) -> Array:
        """Return the covariance of the inner filter, ``(C, C, N)``."""
        return self.own.covariance(state)

    def records(self, state: Any, measurement: Any) -> dict[str, Array]:
        """Return the inner filter's statistics of the scaled measurement, by name."""
        return self.own.records(state, self.scaled(measurement, self.factor))


def with_noise_scale(tunable: Tunable, scale: Callable[[Any, Any], Any]) -> Tunable:
    """Return a tunable estimator with log10 of the measurement noise's scale as one more parameter.

    Args:
        tunable: an estimator.
        scale: function of a measurement and a factor that multiplies the stated deviations by it.
    """
    low, start, high = NOISE_LIMITS

    def apply(values: Mapping[str, Any]) -> tuple[dict[str, Any], Callable[[Any], Any]]:
        own = {name: value for name, value in values.items() if name != NOISE_SCALE}
        keywords, make = tunable.apply(own)
        factor = 10.0 ** values[NOISE_SCALE]
        return keywords, lambda task: ScaledNoise(as_filter(task, make(task)), scale, factor)

    limits = {**tunable.limits, NOISE_SCALE: (low, high)}
    start_values = {**tunable.start, NOISE_SCALE: start}
    return dataclasses.replace(tunable, limits=limits, start=start_values, apply=apply)


class RobustState(NamedTuple):
    """State of a filter that models outliers, with the likelihood of the mixture."""

    own: Any
    """State of the inner filter."""
    likelihood: Likelihood
    """Likelihood of the mixture."""


class RobustEstimator(Filter[Task, Any, RobustState]):
    """A filter that treats every measurement either as stated or as an outlier, whichever is likelier."""

    def __init__(self, own: Filter[Any, Any, Any], scaled: Callable[[Any, Any], Any], share: Any) -> None:
        super().__init__(own.task)
        self.own = own
        self.scaled = scaled
        self.share = share
        self.in_python: bool = own.in_python

    def start(self, initial: Any) -> RobustState:
        """Start the inner filter; return the state with unknown likelihood."""
        return RobustState(self.own.start(initial), Likelihood.unknown(initial.mean[0]))

    def update(self, state: RobustState, inputs: FilterInput) -> RobustState:
        """Update with stated or wide deviations, whichever is likelier; return the state with the mixture's
        likelihood.
        """
        (usual, own), (wide, other), is_outlier, log_likelihood = self.compare(inputs.measurement, state.own)
        nis = None if own.nis is None else self.xp.where(is_outlier, other.nis, own.nis)
        likelihood = Likelihood(log_likelihood, nis, own.nis_degrees).fill_unknown(log_likelihood)
        return RobustState(select_nested(is_outlier, wide, usual), likelihood)

    def compare(self, measurement: Any, state: Any) -> tuple[Any, Any, Any, Any]:
        """Return both updates, a mask of where the second one is likelier, and the mixture's log-likelihood
        ``(N,)``.
        """
        xp = self.xp
        usual, wide = (self._step(state, z) for z in (measurement, self.scaled(measurement, WIDE)))
        one = usual[1].log_likelihood + xp.log(1.0 - self.share)
        other = wide[1].log_likelihood + xp.log(self.share)
        # For a measurement that was not received both are NaN: the first update is used.
        is_outlier = other > one
        top = xp.where(is_outlier, other, one)
        return usual, wide, is_outlier, top + xp.log(xp.exp(one - top) + xp.exp(other - top))

    def _step(self, state: Any, measurement: Any) -> tuple[Any, Likelihood]:
        after = self.own.step(state, FilterInput(measurement))
        return after, Likelihood.of_records(self.own.records(after, measurement))

    def mean(self, state: RobustState) -> Array:
        """Return the mean of the inner filter, ``(C, N)``."""
        return self.own.mean(state.own)

    def covariance(self, state: RobustState) -> Array:
        """Return the covariance of the inner filter, ``(C, C, N)``."""
        return self.own.covariance(state.own)


def with_outliers(tunable: Tunable, scale: Callable[[Any, Any], Any]) -> Tunable:
    """Return a tunable estimator with the share of outliers as one more parameter; see
    :func:`with_noise_scale`.
    """
    low, start, high = SHARE_LIMITS

    def apply(values: Mapping[str, Any]) -> tuple[dict[str, Any], Callable[[Any], Any]]:
        own = {name: value for name, value in values.items() if name != OUTLIER_SHARE}
        keywords, make = tunable.apply(own)
        share = 10.0 ** values[OUTLIER_SHARE]
        return keywords, lambda task: RobustEstimator(as_filter(task, make(task)), scale, share)

    limits = {**tunable.limits, OUTLIER_SHARE: (low, high)}
    return dataclasses.replace(
        tunable, limits=limits, start={**tunable.start, OUTLIER_SHARE: start}, apply=apply
    )


def fit(likelihood: WindowLikelihood, tunable: Tunable, seed: int = 0, starts: int = STARTS) -> Fit:
    """Fit the parameters of an estimator by maximum likelihood, the best of several starts."""
    ends = _find_maxima(likelihood, tunable, seed, starts)
    values = [-likelihood.count * float(end.fun) for end in ends]
    best = int(numpy.argmax(values))
    return _as_fit(tunable, ends[best].x, likelihood.count, values)


def fit_stretches(
    likelihood: WindowLikelihood, tunable: Tunable, whole: WindowLikelihood, seed: int = 0
) -> Fit:
    """Fit parameters to stretches of a long recording; return the search's end that is likeliest on the
    whole.
    """
    ends = _find_maxima(likelihood, tunable, seed, STARTS)
    values = whole(numpy.array([end.x for end in ends]).T).tolist()
    losses = [float(end.fun) for end in ends]
    # Ends that are one maximum on the stretches may be some nats apart on the whole recording.
    spread = whole.count * (max(losses) - min(losses))
    best = int(numpy.argmax(values))
    return _as_fit(tunable, ends[best].x, whole.count, values)._replace(spread=spread)


def _as_fit(tunable: Tunable, best: numpy.ndarray, count: int, values: Sequence[float]) -> Fit:
    """Make the :class:`Fit` at the parameters ``best``; ``values`` are the log-likelihoods that all searches
    found.
    """
    low, high = numpy.array(list(tunable.limits.values())).T
    edge = 1e-3 * (high - low)
    at_limit = tuple(
        name
        for name, value, a, b, margin in zip(tunable.limits, best, low, high, edge, strict=True)
        if value - a < margin or b - value < margin
    )
    found = dict(zip(tunable.limits, map(float, best), strict=True))
    return Fit(found, max(values), count, max(values) - min(values), at_limit)


def _find_maxima(likelihood: WindowLikelihood, tunable: Tunable, seed: int, starts: int) -> list[Any]:
    """Search maxima of the likelihood from several starts; return SciPy's results, in nats per measurement."""
    from scipy.optimize import minimize

    limits = list(tunable.limits.values())
    low, high = numpy.array(limits).T
    generator = numpy.random.default_rng(seed)

    def objective(vector: numpy.ndarray) -> tuple[float, numpy.ndarray]:
        value, gradient = likelihood.gradient(vector)
        if not (math.isfinite(value) and numpy.isfinite(gradient).all()):
            return 1e6, numpy.zeros(len(vector))
        return -value / likelihood.count, -gradient / likelihood.count

    first = numpy.clip([tunable.start[name] for name in tunable.limits], low, high)
    begins = [first]
    if starts > 1:
        inside = low + (high - low) * generator.uniform(0.05, 0.95, (SCREENED, len(low)))
        begins += list(inside[numpy.argsort(-likelihood(inside.T))[: starts - 1]])
    return [
        minimize(
            objective,
            begin,
            jac=True,
            method="L-BFGS-B",
            bounds=limits,
            options={"maxiter": 80, "ftol": 1e-9},
        )
        for begin in begins
    ]


def _hessian(likelihood: WindowLikelihood, at: numpy.ndarray, step: numpy.ndarray) -> numpy.ndarray:
    P, moves = len(at), numpy.diag(step)
    pairs = [(i, j) for i in range(P) for j in range(i, P)]
    signs = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
    points = [at + a * moves[i] + b * moves[j] for i, j in pairs for a, b in signs]
    found = likelihood(numpy.stack(points, axis=1)).reshape(len(pairs), 4)
    H = numpy.zeros((P, P))
    for (i, j), values in zip(pairs, found, strict=True):
        H[i, j] = H[j, i] = (values[0] - values[1] - values[2] + values[3]) / (4.0 * step[i] * step[j])
    return H


class _ProfileSide(NamedTuple):
    """One side of a profile: values of a parameter from the best one towards a limit."""

    distances: list[float]
    """Distances from the best value."""
    drops: list[float]
    """Distance of the log-likelihood from its maximum at each, nats."""


def fit_profiles(
    likelihood: WindowLikelihood,
    tunable: Tunable,
    result: Fit,
    tick: Callable[[float], None] = lambda share: None,
) -> tuple[Fit, dict[str, Profile]]:
    """Return the fit at the likelihood's maximum and the profile likelihood of each parameter, from a first
    fit.

    Where a profile finds a likelier point, the fit starts again from there.

    Args:
        likelihood: likelihood of the tunable's parameters.
        tunable: the estimator, with limits.
        result: result of :func:`fit`.
        tick: function called with the share of the work done, which falls where the fit starts again.
    """
    for _ in range(MOST_RESTARTS):
        profiles, higher = _search_profiles(likelihood, tunable, result, tick)
        if higher is None:
            return result, profiles
        start = dict(zip(tunable.limits, map(float, higher), strict=True))
        again = fit(likelihood, dataclasses.replace(tunable, start=start), starts=1)
        result = again._replace(spread=result.spread + again.log_likelihood - result.log_likelihood)
    return result, _search_profiles(likelihood, tunable, result, tick, stop=False)[0]


def _search_profiles(
    likelihood: WindowLikelihood,
    tunable: Tunable,
    found: Fit,
    tick: Callable[[float], None],
    stop: bool = True,
) -> tuple[dict[str, Profile], numpy.ndarray | None]:
    """Compute the profiles; return also the point of higher likelihood at which ``stop`` ended the search, or
    None.
    """
    limits = numpy.array(list(tunable.limits.values())).T
    best = numpy.array([found.values[name] for name in tunable.limits])
    information = _information(likelihood, best, limits)
    deviation = numpy.sqrt(numpy.diag(numpy.linalg.inv(information)))
    around = _Maximum(best, found.log_likelihood, information, limits)
    profiles, count = {}, 2 * len(best)
    for i, name in enumerate(tunable.limits):
        ways = []
        for j, sign in enumerate((-1.0, 1.0)):
            way, point = _walk_profile(likelihood, around, (i, sign * float(deviation[i])), stop)
            if stop and way.drops and way.drops[-1] < -HIGHER:
                return {}, point
            ways.append(way)
            tick((2 * i + j + 1) / count)
        profiles[name] = _profile(best[i], *ways)
    return profiles, None


def _profile(best: float, below: _ProfileSide, above: _ProfileSide) -> Profile:
    """Combine two sides and the best value to a sorted profile with its 95 % interval."""
    (low, open_low), (high, open_high) = _profile_end(below), _profile_end(above)
    values = numpy.array([*(best - d for d in below.distances), *(best + d for d in above.distances), best])
    drops, order = numpy.array([*below.drops, *above.drops, 0.0]), numpy.argsort(values)
    interval = Interval(float(best - low), float(best + high), open_low, open_high)
    return Profile(values[order], drops[order], interval)


class _Maximum(NamedTuple):
    """Maximum of a likelihood: place, value, curvature, and limits of the parameters."""

    at: numpy.ndarray
    log_likelihood: float
    information: numpy.ndarray
    """Information matrix of :func:`_information`."""
    limits: numpy.ndarray
    """Lower and upper limits, ``(2, P)``."""


def _walk_profile(
    likelihood: WindowLikelihood, maximum: _Maximum, first: tuple[int, float], stop: bool
) -> tuple[_ProfileSide, numpy.ndarray]:
    """Compute one side of a profile, up to where the likelihood has fallen enough; return it and its last
    point.

    ``first`` is the number of the parameter, and its standard deviation upward or downward.
    """
    parameter, deviation = first
    best, (low, high) = maximum.at, maximum.limits
    sign = math.copysign(1.0, deviation)
    room = float(sign * (maximum.limits[int(sign > 0.0), parameter] - best[parameter]))
    others = numpy.delete(numpy.arange(len(best)), parameter)
    # Where the likelihood is quadratic, the others follow this one on a straight line.
    inside = maximum.information[numpy.ix_(others, others)]
    slope = -sign * numpy.linalg.solve(inside, maximum.information[others, parameter])
    way, point, reached = _ProfileSide([], []), best.copy(), 0.0
    for distance in [*(d for d in numpy.array(STEPS) * abs(deviation) if d < room), room]:
        before = point.copy()
        before[parameter] = best[parameter] + sign * distance
        start = before.copy()
        start[others] = numpy.clip(start[others] + (distance - reached) * slope, low[others], high[others])
        after, log_likelihood = _maximise_others(likelihood, maximum, start, others)
        expected = 0.5 * (distance / deviation) ** 2
        if maximum.log_likelihood - log_likelihood > STEEP * expected:
            # Not quadratic: the search for the others may have stopped early.
            other, value = _maximise_others(likelihood, maximum, before, others)
            if value > log_likelihood:
                after, log_likelihood = other, value
        if distance > reached:
            slope, reached = (after[others] - point[others]) / (distance - reached), float(distance)
        point = after
        way.distances.append(float(distance))
        way.drops.append(maximum.log_likelihood - log_likelihood)
        if way.drops[-1] > DROP or (stop and way.drops[-1] < -HIGHER):
            break
    return way, point


def _maximise_others(
    likelihood: WindowLikelihood, maximum: _Maximum, point: numpy.ndarray, others: numpy.ndarray
) -> tuple[numpy.ndarray, float]:
    """Maximise the likelihood over the parameters ``others``; return the point, and the log-likelihood there.

    By Newton's steps as long as each gains, then by L-BFGS-B.
    """
    from scipy.optimize import minimize

    low, high = maximum.limits[:, others]

    def objective(values: numpy.ndarray) -> tuple[float, numpy.ndarray]:
        whole = point.copy()
        whole[others] = values
        value, gradient = likelihood.gradient(whole, of=others)
        if not (math.isfinite(value) and numpy.isfinite(gradient).all()):
            return 1e6 * likelihood.count, numpy.zeros(len(others))
        return -value, -gradient

    at, (loss, gradient) = point[others], objective(point[others])
    curvature = maximum.information[numpy.ix_(others, others)]
    for _ in range(NEWTON_STEPS):
        step, gain = _newton_step(curvature, gradient, low - at, high - at)
        if 0.0 <= gain < LEAST_GAIN:
            break
        less, slope = objective(at + step)
        if not less < loss - LEAST_GAIN:  # the likelihood is not quadratic here
            options = {"maxiter": 20, "ftol": 1e-7}
            bounds = list(zip(low, high, strict=True))
            end = minimize(objective, at, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
            at, loss = end.x, float(end.fun)
            break
        at, loss, gradient = numpy.clip(at + step, low, high), less, slope
    found = point.copy()
    found[others] = at
    return found, -loss


def _newton_step(
    curvature: numpy.ndarray, gradient: numpy.ndarray, low: numpy.ndarray, high: numpy.ndarray
) -> tuple[numpy.ndarray, float]:
    """Return the step to the minimum of a quadratic loss within limits, and the decrease of the loss."""
    step, free = numpy.zeros(len(gradient)), numpy.ones(len(gradient), dtype=bool)
    while free.any():
        inside = curvature[numpy.ix_(free, free)]
        step[free] = -numpy.linalg.solve(inside, gradient[free] + curvature[free][:, ~free] @ step[~free])
        beyond = free & ((step < low) | (step > high))
        if not beyond.any():
            break
        step[beyond] = numpy.clip(step, low, high)[beyond]
        free &= ~beyond
    return step, -float(gradient @ step + 0.5 * step @ curvature @ step)


def _information(likelihood: WindowLikelihood, best: numpy.ndarray, limits: numpy.ndarray) -> numpy.ndarray:
    """Return the information matrix at the maximum, with a floor for flat directions."""
    low, high = limits
    step = numpy.minimum(0.02, 0.01 * (high - low))
    H = _hessian(likelihood, numpy.clip(best, low + 2.0 * step, high - 2.0 * step), step)
    eigenvalues, vectors = numpy.linalg.eigh(-H)
    floor = 4.0 / (high - low).max() ** 2
    information: numpy.ndarray = (vectors * numpy.clip(eigenvalues, floor, None)) @ vectors.T
    return information


def _profile_end(way: _ProfileSide) -> tuple[float, bool]:
    """Interpolate the distance at which a profile has fallen by ``DROP``, and whether the limit comes first."""
    distances = [0.0, *way.distances]
    # A drop grows with the square of the distance: it is interpolated in its root.
    roots = [0.0, *numpy.sqrt(numpy.clip(way.drops, 0.0, None)).tolist()]
    for k in range(1, len(roots)):
        if roots[k] > math.sqrt(DROP):
            share = (math.sqrt(DROP) - roots[k - 1]) / (roots[k] - roots[k - 1])
            return distances[k - 1] + share * (distances[k] - distances[k - 1]), False
    return distances[-1], True
