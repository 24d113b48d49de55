"""The filters of ManeuveringTarget that are steered: one alpha-beta filter, or a bank of them.

Equations and their numbers stand in ``filters/alpha_beta.py`` and ``filters/imm.py``. A scan that missed the target is
prediction only, whatever the action: means and covariances stay as predicted, the weights become the predicted mode
probabilities (13), averages and gains hold.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import alpha_beta, imm
from ...filters.gaussian import log_density
from ...filters.ordered_sums import weighted_sum
from ..contract.controls import bank_action_space, bank_probabilities
from ..contract.filter import Bank, Initial
from ..contract.observation import (
    KEPT_AS_LOG,
    SHARE,
    Array,
    Block,
    Quantity,
    availability_block,
    average_block,
    average_log_squared_block,
    innovation_block,
    last_weight_block,
    log_predicted_block,
    log_squared_block,
    relative_likelihood_block,
)
from .parameters import ManeuveringTargetParameters
from .problem import TargetProblem
from .world import Measurement

SCANS_SHOWN = 20
"""The clock in the observation saturates here: a filter has settled after about ten scans."""
PERIODS_SHOWN = (0.01, 100.0)
"""Limits of the time since the last measurement, scan periods."""

LARGEST_SHARE = 1e8
"""Of what an acceleration leaves over the covariance that the gains give."""


LEAST_INTERVAL = 0.1
"""Of the sampling interval: beta over the time is what turns position noise into speed, ten times too large here."""
SHORTEST = 0.05
"""Of the sampling interval: measurements that are closer are taken for so far apart, where beta is divided by the time.
No simulated scans are closer."""


class AlphaBeta(NamedTuple):
    """One alpha-beta filter with the covariance that belongs to the gains it used."""

    mean: Array
    """x, y (m), vx, vy (m/s) estimated, ``(4, N)``."""
    predicted: Array
    """Position predicted to the measurement, m, ``(2, N)``."""
    covariance: alpha_beta.Covariance
    """Of each coordinate, ``(2, N)`` each; x and y are uncorrelated."""
    innovation: Array
    """m, ``(2, N)``."""
    innovation_variance: Array
    """m^2, ``(2, N)``."""
    average_excess: Array
    """Exponential average of what the squared innovations have beyond their variance, m^2, ``(2, N)``."""
    average_innovation: Array
    """Exponential average of the normalised innovations, ``(2, N)``."""
    log_squared: Array
    """log(1 + normalised innovation squared), ``(N,)``."""
    average_log_squared: Array
    """Its exponential average, ``(N,)``."""
    alpha: Array
    """Gain used last, ``(N,)``."""
    grown: Array = None
    """s for which the innovation of the last update had grown, ``(N,)``; None where that is the scan period."""
    since: Array = None
    """s since that update, ``(N,)``; None for zero."""


class Filters(NamedTuple):
    """M alpha-beta filters of fixed gains, mixed on their weights before every prediction."""

    mean: Array
    """x, y, vx, vy of each filter, ``(4, M, N)``."""
    covariance: Array
    """``(4, 4, M, N)``."""
    probabilities: Array
    """Weights in force, ``(M, N)``."""
    log_predicted: Array
    """Logarithm of the predicted mode probabilities (13), ``(M, N)``."""
    innovation: Array
    """m, ``(2, M, N)``."""
    innovation_covariance: Array
    """m^2, ``(2, 2, M, N)``."""
    log_likelihood: Array
    """Logarithm of (11), ``(M, N)``."""
    average_innovation: Array
    """``(2, M, N)``."""
    log_squared: Array
    """``(M, N)``."""
    average_log_squared: Array
    """``(M, N)``."""
    alpha: Array
    """Position gains used last, ``(M, N)``."""


class RadarBank(Bank[TargetProblem, Measurement, Any]):
    """Common base of both banks: the averages in the observation, and its end."""

    parameters: ManeuveringTargetParameters

    def __init__(self, task: TargetProblem, control: str) -> None:
        super().__init__(task, control)
        self.T = self.parameters.sampling_interval
        self.regular: bool = task.regular
        self.forgetting: float = math.exp(-1.0 / self.parameters.averaging_measurements)
        self.average: str = f"exponential average over {self.parameters.averaging_measurements:g} scans"

    def exponential_average(self, measurement: Measurement, old: Array, new: Array) -> Array:
        """Return the exponential average with a new value taken in, if there is one."""
        return self.where_detected(measurement, self.forgetting * old + (1.0 - self.forgetting) * new, old)

    def interval(self, measurement: Measurement) -> float | Array:
        """Return the seconds since the scan before."""
        return self.T if self.regular else measurement.interval

    def time_since_last(self, measurement: Measurement) -> float | Array:
        """Return the seconds since the last measurement, no fewer than :data:`SHORTEST`; a late one comes after
        negative ones.
        """
        if self.regular:
            return self.T
        least = SHORTEST * self.T
        return self.xp.where(self.xp.abs(measurement.elapsed) < least, least, measurement.elapsed)

    def where_detected(self, measurement: Measurement, then: Any, otherwise: Any) -> Any:
        """Return one of two where the scan saw the target, the other where it missed it: arrays, or tuples of them."""
        if self.regular or then is otherwise:
            return then
        if isinstance(then, tuple):
            parts = [self.where_detected(measurement, *pair) for pair in zip(then, otherwise, strict=True)]
            return type(then)(*parts) if hasattr(then, "_fields") else tuple(parts)
        return self.xp.where(measurement.available > 0.0, then, otherwise)

    def surroundings(self) -> tuple[Block, ...]:
        """Return the blocks of the measurement itself."""
        xp, unit = self.xp, self.parameters.range_sigma**2

        def log_elapsed(state: Any, measurement: Measurement) -> Array:
            if self.regular:
                return xp.zeros_like(measurement.elapsed)
            return xp.log(xp.clip(measurement.elapsed * (1.0 / self.T), *PERIODS_SHOWN))

        return (
            Block(
                "log_measurement_sigma",
                lambda state, measurement: 0.5 * xp.log(measurement.variance / unit),
                "the measurement's sigma over range_sigma",
                "xy",
                KEPT_AS_LOG,
            ),
            Block(
                "scan",
                lambda state, measurement: xp.clip(measurement.scan * (1.0 / SCANS_SHOWN), None, 1.0),
                f"scans since the start over {SCANS_SHOWN}, saturating at 1",
                compression=SHARE,
            ),
            availability_block("1 if the scan saw the target, 0 if not: no action has an effect then"),
            Block(
                "elapsed",
                log_elapsed,
                "the time since the last measurement over sampling_interval, within {:g} and {:g}".format(
                    *PERIODS_SHOWN
                ),
                compression=KEPT_AS_LOG,
            ),
        )


class GainBank(RadarBank):
    """Control ``gain``: one filter, whose position gain the action sets."""

    action_space: gymnasium.Space[Any] = gymnasium.spaces.Box(-1.0, 1.0, (1,), numpy.float32)
    least_interval = LEAST_INTERVAL

    @property
    def blocks(self) -> Sequence[Block]:
        """Innovations, their averages, gain, and clock."""
        xp = self.xp
        return (
            innovation_block("xy", value=lambda f, _: f.innovation / xp.sqrt(f.innovation_variance)),
            log_squared_block(),
            average_block(
                "average_innovation", lambda f, _: f.average_innovation, f"its {self.average}", "xy"
            ),
            average_log_squared_block(self.average),
            Block(
                "prior_share",
                lambda f, measurement: 1.0 - measurement.variance / f.innovation_variance,
                "1 - R/S: the filter's share of the innovation",
                "xy",
                SHARE,
            ),
            Block("last_alpha", lambda f, _: f.alpha, "position gain used last", compression=SHARE),
            *self.surroundings(),
        )

    @property
    def quantities(self) -> Sequence[Quantity]:
        """The innovation as it is."""
        sigma = self.parameters.range_sigma
        return (
            Quantity(
                "innovation_sigma",
                "m",
                "standard deviation that the filter predicts for its innovation, x and y",
                lambda read: sigma * read("log_measurement_sigma") / numpy.sqrt(1.0 - read("prior_share")),
            ),
            Quantity(
                "innovation_in_metres",
                "m",
                "measured minus predicted position, x and y",
                lambda read: read("innovation") * read("innovation_sigma"),
            ),
        )

    def start(self, initial: Initial) -> AlphaBeta:
        """Start from the track's start, equation (24)."""
        xp, P = self.xp, initial.covariance
        variance, velocity_variance = xp.stack([P[0, 0], P[1, 1]]), xp.stack([P[2, 2], P[3, 3]])
        zero = 0.0 * variance
        alpha = sum(self.parameters.alpha_range) / 2.0 * (zero[0] + 1.0)
        return AlphaBeta(
            mean=initial.mean,
            predicted=initial.mean[:2],
            covariance=alpha_beta.Covariance(variance, zero, velocity_variance),
            innovation=zero,
            innovation_variance=variance,
            average_excess=zero,
            average_innovation=zero,
            log_squared=zero[0],
            average_log_squared=zero[0],
            alpha=alpha,
            grown=None if self.regular else self.T + zero[0],
            since=None if self.regular else zero[0],
        )

    def predict(self, state: AlphaBeta, measurement: Measurement) -> AlphaBeta:
        """Predict to the scan."""
        xp, f, interval = self.xp, state, self.interval(measurement)
        predicted = alpha_beta.predict(f.mean[:2], f.mean[2:], interval)
        covariance = alpha_beta.predict_covariance(f.covariance, interval)
        innovation = self.where_detected(measurement, measurement.position - predicted, 0.0)
        S = covariance.position + measurement.variance
        normalised = innovation / xp.sqrt(S)
        squares = normalised * normalised
        log_squared = xp.log1p(squares[0] + squares[1])
        return f._replace(
            predicted=predicted,
            covariance=covariance,
            innovation=innovation,
            innovation_variance=S,
            average_excess=self.exponential_average(
                measurement, f.average_excess, innovation * innovation - S
            ),
            average_innovation=self.exponential_average(measurement, f.average_innovation, normalised),
            log_squared=log_squared,
            average_log_squared=self.exponential_average(measurement, f.average_log_squared, log_squared),
        )

    def alpha(self, action: Array) -> Array:
        """Return the position gain that an action sets, linear over ``alpha_range``, ``(N,)``."""
        low, high = self.parameters.alpha_range
        return 0.5 * (low + high) + (0.5 * (high - low)) * self.xp.clip(action[0], -1.0, 1.0)

    def action_for_alpha(self, alpha: Any) -> Any:
        """Return the action that sets a position gain; the gain must lie within ``alpha_range``."""
        low, high = self.parameters.alpha_range
        return (alpha - 0.5 * (low + high)) / (0.5 * (high - low))

    def act(self, state: AlphaBeta, measurement: Measurement, action: Array) -> AlphaBeta:
        """Update with the gain of the action and the beta that belongs to it."""
        xp, f, alpha, elapsed = self.xp, state, self.alpha(action), self.time_since_last(measurement)
        beta = alpha_beta.benedict_bordner_beta(alpha)
        updated = alpha_beta.update(f.predicted, f.mean[2:], f.innovation, alpha, beta, elapsed)
        covariance = alpha_beta.update_covariance(f.covariance, measurement.variance, alpha, beta, elapsed)
        after = f._replace(mean=xp.concat(updated), covariance=covariance, alpha=alpha)
        if self.regular:
            return after
        after = after._replace(grown=elapsed, since=xp.zeros_like(measurement.elapsed))
        missed = f._replace(mean=xp.concat([f.predicted, f.mean[2:]]), since=measurement.elapsed)
        return self.where_detected(measurement, after, missed)

    def covariance(self, state: AlphaBeta) -> Array:
        """Return the covariance that belongs to the gains used, and what an acceleration since the measurement
        before the last would leave of which these know nothing: one as large as usual, and as the last
        innovations say.
        """
        xp, f = self.xp, state
        T, since = (self.T, 0.0) if self.regular else (f.grown, f.since)
        usual = (0.5 * T**2 * self.parameters.unmodelled_acceleration) ** 2
        beta = alpha_beta.benedict_bordner_beta(f.alpha)
        extra_variance = usual + xp.clip(f.average_excess, 0.0, None)
        # Of one direction; beyond this the sum would be singular to rounding.
        largest = LARGEST_SHARE * xp.minimum(f.covariance.position, T**2 * f.covariance.velocity)
        extra_variance = xp.minimum(extra_variance, largest / (1.0 + since / T) ** 4)
        P = alpha_beta.add_acceleration_error(f.covariance, extra_variance, f.alpha, beta, T, since)
        zero = 0.0 * P.cross[0]
        entries = ((P.position, P.cross), (P.cross, P.velocity))
        return xp.stack(
            [
                xp.stack([entries[i // 2][j // 2][i % 2] if i % 2 == j % 2 else zero for j in range(4)])
                for i in range(4)
            ]
        )

    def records(self, state: AlphaBeta, measurement: Measurement) -> dict[str, Array]:
        """Return the normalised innovation squared and log-density of the measurement as predicted (NaN where there
        is none), and the gain.
        """
        nis, S = self.xp.expm1(state.log_squared), state.innovation_variance
        density = -0.5 * (nis + self.xp.log(S[0]) + self.xp.log(S[1])) - math.log(2.0 * math.pi)
        return {
            "nis": self.where_detected(measurement, nis, math.nan),
            "nis_degrees": 2.0 * measurement.available,
            "log_likelihood": self.where_detected(measurement, density, math.nan),
            "alpha": state.alpha,
        }


class FilterBank(RadarBank):
    """Controls ``mode``, ``weights`` and ``evidence``: filters of fixed gains that mix on their weights."""

    least_interval = LEAST_INTERVAL

    def __init__(self, task: TargetProblem, control: str) -> None:
        super().__init__(task, control)
        p = self.parameters
        self.count: int = len(p.gains)
        self.gain_alpha: Array = task.constant(p.gains)[:, None]
        self.gain_beta: Array = alpha_beta.benedict_bordner_beta(self.gain_alpha)
        self.transition: Array = task.constant(p.transition)

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """One hypothesis, or a number for each."""
        return bank_action_space(self.control, self.count)

    @property
    def blocks(self) -> Sequence[Block]:
        """The same for each filter, likelihoods, probabilities, and clock."""
        xp = self.xp
        each = tuple(str(j + 1) for j in range(self.count))

        def innovation_in_sigmas(i: int) -> Any:
            return lambda f, _: f.innovation[i] / xp.sqrt(f.innovation_covariance[i, i])

        over_sigma = "the filter's innovation over its predicted sigma"
        return (
            innovation_block(each, value=innovation_in_sigmas(0), text=over_sigma, name="innovation_x"),
            innovation_block(each, value=innovation_in_sigmas(1), text=over_sigma, name="innovation_y"),
            log_squared_block(each),
            average_block(
                "average_innovation_x",
                lambda f, _: f.average_innovation[0],
                f"{self.average} of innovation_x",
                each,
            ),
            average_block(
                "average_innovation_y",
                lambda f, _: f.average_innovation[1],
                f"{self.average} of innovation_y",
                each,
            ),
            average_log_squared_block(self.average, each),
            relative_likelihood_block(xp, each),
            log_predicted_block(each, text="the logarithm of the predicted mode probability"),
            last_weight_block(each),
            *self.surroundings(),
        )

    def start(self, initial: Initial) -> Filters:
        """Start all filters from the track's start, equation (24)."""
        xp, m = self.xp, self.count
        zeros = xp.stack([0.0 * initial.mean[:2]] * m, axis=1)
        probabilities = self.task.constant(self.parameters.initial_probabilities)[:, None] + zeros[0]
        return Filters(
            mean=xp.stack([initial.mean] * m, axis=1),
            covariance=xp.stack([initial.covariance] * m, axis=2),
            probabilities=probabilities,
            log_predicted=imm.log_probabilities(probabilities),
            innovation=zeros,
            innovation_covariance=xp.stack([initial.covariance[:2, :2]] * m, axis=2),
            log_likelihood=zeros[0],
            average_innovation=zeros,
            log_squared=zeros[0],
            average_log_squared=zeros[0],
            alpha=self.gain_alpha + zeros[0],
        )

    def predict(self, state: Filters, measurement: Measurement) -> Filters:
        """Mix, predict to the scan, and ask how likely the measurement is."""
        xp, bank, interval = self.xp, state, self.interval(measurement)
        prediction = imm.predict_mode_probabilities(self.transition, bank.probabilities)
        mean, covariance = imm.mix(bank.mean, bank.covariance, prediction.mixing)
        mean = xp.concat([alpha_beta.predict(mean[:2], mean[2:], interval), mean[2:]])
        covariance = alpha_beta.predict_joint_covariance(covariance, interval)
        innovation = self.where_detected(measurement, measurement.position[:, None] - mean[:2], 0.0)
        identity = xp.eye(2, dtype=mean.dtype, device=mean.device)[:, :, None, None]
        if self.parameters.likelihood_covariance == "carried":
            S = covariance[:2, :2] + identity * measurement.variance[:, None]
        else:
            S = identity * (measurement.variance[:, None] / (1.0 - bank.alpha))
        log_likelihood, squared = log_density(innovation, S)
        normalised = innovation / xp.sqrt(xp.stack([S[0, 0], S[1, 1]]))
        log_squared = xp.log1p(squared)
        return Filters(
            mean,
            covariance,
            bank.probabilities,
            imm.log_probabilities(prediction.probabilities),
            innovation,
            S,
            self.where_detected(measurement, log_likelihood, 0.0),
            self.exponential_average(measurement, bank.average_innovation, normalised),
            log_squared,
            self.exponential_average(measurement, bank.average_log_squared, log_squared),
            bank.alpha,
        )

    def act(self, state: Filters, measurement: Measurement, action: Array) -> Filters:
        """Update every filter and put the weights of the action in force."""
        probabilities = bank_probabilities(
            self.control,
            action,
            state.log_predicted,
            state.log_likelihood,
            self.parameters.evidence_scale,
            self.xp,
        )
        after = self._update_filters(state, measurement, self.gain_alpha, self.gain_beta)
        return self._in_force(state, measurement, after._replace(probabilities=probabilities))

    def _update_filters(self, state: Filters, measurement: Measurement, alpha: Array, beta: Array) -> Filters:
        """Update every filter by its gains."""
        elapsed = self.time_since_last(measurement)
        updated = alpha_beta.update(state.mean[:2], state.mean[2:], state.innovation, alpha, beta, elapsed)
        covariance = alpha_beta.update_joint_covariance(
            state.covariance, measurement.variance[:, None], alpha, beta, elapsed
        )
        return state._replace(mean=self.xp.concat(updated), covariance=covariance)

    def _in_force(self, state: Filters, measurement: Measurement, after: Filters) -> Filters:
        """Return the filters after an update, or where the scan missed the target as predicted, with the
        probabilities (13).
        """
        if self.regular:
            return after
        predicted = imm.softmax(state.log_predicted)
        return self.where_detected(measurement, after, state._replace(probabilities=predicted))

    def mean(self, state: Filters) -> Array:
        """Return the combination of the filters (15), ``(4, N)``."""
        return weighted_sum(state.probabilities, state.mean)

    def covariance(self, state: Filters) -> Array:
        """Return the covariance of the combination (16)."""
        return imm.combine(state.mean, state.covariance, state.probabilities)[1]

    def records(self, state: Filters, measurement: Measurement) -> dict[str, Array]:
        """Return the NIS of the combined prediction, log-density of the measurement as the filters predict it (NaN
        where there is none), and the weights.
        """
        predicted = self.xp.exp(state.log_predicted)
        innovation, S = imm.combine(state.innovation, state.innovation_covariance, predicted)
        density = imm.log_mixture_density(state.log_predicted, state.log_likelihood)
        return {
            "nis": self.where_detected(measurement, log_density(innovation, S)[1], math.nan),
            "nis_degrees": 2.0 * measurement.available,
            "log_likelihood": self.where_detected(measurement, density, math.nan),
            "mode_probability": state.probabilities,
        }


class GainsBank(FilterBank):
    """Control ``gains``: the paper's IMM, whose filters have the gains that the action asks for."""

    def __init__(self, task: TargetProblem, control: str) -> None:
        super().__init__(task, control)
        self.logit: Array = self.xp.log(self.gain_alpha / (1.0 - self.gain_alpha))

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """A number for each filter."""
        return gymnasium.spaces.Box(-1.0, 1.0, (self.count,), numpy.float32)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation of every bank, and the gains."""
        each = tuple(str(j + 1) for j in range(self.count))
        return (
            *super().blocks,
            Block("last_alpha", lambda f, _: f.alpha, "position gain used last", each, SHARE),
        )

    def act(self, state: Filters, measurement: Measurement, action: Array) -> Filters:
        """Update every filter with its gain, ``logit alpha = logit gain + gain_logits a``, and weigh by Bayes' rule."""
        xp = self.xp
        moved = self.logit + self.parameters.gain_logits * xp.clip(action, -1.0, 1.0)
        alpha = 1.0 / (1.0 + xp.exp(-moved))
        beta = alpha_beta.benedict_bordner_beta(alpha)
        probabilities = imm.mode_posterior(state.log_predicted, state.log_likelihood)
        after = self._update_filters(state, measurement, alpha, beta)
        return self._in_force(state, measurement, after._replace(probabilities=probabilities, alpha=alpha))
