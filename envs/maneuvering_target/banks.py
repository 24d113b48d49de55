"""Filters of ManeuveringTarget that an action steers: one alpha-beta filter, or a bank of them.

The equations are in ``filters/alpha_beta.py`` and ``filters/imm.py``. In a scan that missed the target there is only a
prediction, whatever the action: means and covariances remain as predicted, the weights become the predicted mode
probabilities (13), averages and gains do not change.
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
    SHARE,
    STORED_AS_LOG,
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
"""Number of scans at which the observed time saturates: a filter has settled after about ten scans."""
PERIODS_SHOWN = (0.01, 100.0)
"""Limits of the observed time since the last measurement, scan periods."""

LARGEST_SHARE = 1e8
"""Largest covariance due to an unmodelled acceleration, over that which follows from the gains."""


LEAST_INTERVAL = 0.1
"""Smallest interval between measurements, as a share of the sampling interval, for which the gains are valid.

The speed is beta over the interval times the position noise, which is ten times too large here."""
SHORTEST = 0.05
"""Smallest interval by which beta is divided, as a share of the sampling interval; simulated scans are never closer."""


class AlphaBeta(NamedTuple):
    """State of one alpha-beta filter, with the covariance that follows from the gains used."""

    mean: Array
    """Estimate of x, y (m), vx, vy (m/s), ``(4, N)``."""
    predicted: Array
    """Position predicted to the measurement, m, ``(2, N)``."""
    covariance: alpha_beta.Covariance
    """Covariance of position and velocity for each coordinate, ``(2, N)`` each; x and y are uncorrelated."""
    innovation: Array
    """Innovation, m, ``(2, N)``."""
    innovation_variance: Array
    """Variance of the innovation, m^2, ``(2, N)``."""
    average_excess: Array
    """Exponential average of the squared innovations minus their variance, m^2, ``(2, N)``."""
    average_innovation: Array
    """Exponential average of the normalised innovations, ``(2, N)``."""
    log_squared: Array
    """log(1 + normalised innovation squared), ``(N,)``."""
    average_log_squared: Array
    """Exponential average of ``log_squared``, ``(N,)``."""
    alpha: Array
    """Position gain of the last update, ``(N,)``."""
    grown: Array = None
    """Time over which the innovation of the last update had grown, s, ``(N,)``; None if that is the scan period."""
    since: Array = None
    """Time since that update, s, ``(N,)``; None for zero."""


class Filters(NamedTuple):
    """State of M alpha-beta filters with fixed gains, which are mixed before every prediction (IMM)."""

    mean: Array
    """Estimates of x, y (m), vx, vy (m/s) by each filter, ``(4, M, N)``."""
    covariance: Array
    """Covariance of each filter, ``(4, 4, M, N)``."""
    probabilities: Array
    """Weights of the filters, ``(M, N)``."""
    log_predicted: Array
    """Logarithm of the predicted mode probabilities (13), ``(M, N)``."""
    innovation: Array
    """Innovation of each filter, m, ``(2, M, N)``."""
    innovation_covariance: Array
    """Innovation covariance of each filter, m^2, ``(2, 2, M, N)``."""
    log_likelihood: Array
    """Log-likelihood of each filter, equation (11), ``(M, N)``."""
    average_innovation: Array
    """Exponential average of the normalised innovations, ``(2, M, N)``."""
    log_squared: Array
    """log(1 + normalised innovation squared) of each filter, ``(M, N)``."""
    average_log_squared: Array
    """Exponential average of ``log_squared``, ``(M, N)``."""
    alpha: Array
    """Position gains of the last update, ``(M, N)``."""


class RadarBank(Bank[TargetProblem, Measurement, Any]):
    """Base class of the banks on radar scans: averages, intervals, observation blocks of the measurement."""

    parameters: ManeuveringTargetParameters

    def __init__(self, task: TargetProblem, control: str) -> None:
        super().__init__(task, control)
        self.T = self.parameters.sampling_interval
        self.regular: bool = task.regular
        self.forgetting: float = math.exp(-1.0 / self.parameters.averaging_measurements)
        self.average: str = f"exponential average over {self.parameters.averaging_measurements:g} scans"

    def exponential_average(self, measurement: Measurement, old: Array, new: Array) -> Array:
        """Return an exponential average, updated with a new value where the scan saw the target."""
        return self.where_detected(measurement, self.forgetting * old + (1.0 - self.forgetting) * new, old)

    def interval(self, measurement: Measurement) -> float | Array:
        """Return the time since the previous scan, s; one number where scans are regular."""
        return self.T if self.regular else measurement.interval

    def time_since_last(self, measurement: Measurement) -> float | Array:
        """Return the time since the last scan that saw the target, s; at least :data:`SHORTEST` in magnitude.

        It is negative for a delayed measurement.
        """
        if self.regular:
            return self.T
        least = SHORTEST * self.T
        return self.xp.where(self.xp.abs(measurement.elapsed) < least, least, measurement.elapsed)

    def where_detected(self, measurement: Measurement, then: Any, otherwise: Any) -> Any:
        """Return ``then`` where the scan saw the target, else ``otherwise``: arrays, or tuples of them."""
        if self.regular or then is otherwise:
            return then
        if isinstance(then, tuple):
            parts = [self.where_detected(measurement, *pair) for pair in zip(then, otherwise, strict=True)]
            return type(then)(*parts) if hasattr(then, "_fields") else tuple(parts)
        return self.xp.where(measurement.available > 0.0, then, otherwise)

    def surroundings(self) -> tuple[Block, ...]:
        """Return the observation blocks of the measurement: its variance, detection and times."""
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
                STORED_AS_LOG,
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
                compression=STORED_AS_LOG,
            ),
        )


class GainBank(RadarBank):
    """Bank of the control ``gain``: one alpha-beta filter, whose position gain the action sets."""

    action_space: gymnasium.Space[Any] = gymnasium.spaces.Box(-1.0, 1.0, (1,), numpy.float32)
    least_interval = LEAST_INTERVAL

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks: innovations, their averages, the prediction's share, the gain, detection and times."""
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
        """Innovation and its predicted standard deviation, m, computed from the observation."""
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
        """Return the filter's state at the start of the track, equation (24)."""
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
        """Return the filter's state predicted to the scan, with innovation statistics."""
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
        """Return the position gain that an action in [-1, 1] sets, linear over ``alpha_range``, ``(N,)``."""
        low, high = self.parameters.alpha_range
        return 0.5 * (low + high) + (0.5 * (high - low)) * self.xp.clip(action[0], -1.0, 1.0)

    def action_for_alpha(self, alpha: Any) -> Any:
        """Return the action that sets a position gain within ``alpha_range``."""
        low, high = self.parameters.alpha_range
        return (alpha - 0.5 * (low + high)) / (0.5 * (high - low))

    def act(self, state: AlphaBeta, measurement: Measurement, action: Array) -> AlphaBeta:
        """Return the state updated with the position gain of the action and the velocity gain that follows."""
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
        """Return the covariance under the gains used, plus that of an unmodelled acceleration, ``(4, 4, N)``.

        The acceleration is the usual one, or the one that the last innovations indicate, since the measurement before
        the last.
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
        """Return NIS, log-likelihood (NaN without a measurement) and gain to record at a scan, by name."""
        nis, S = self.xp.expm1(state.log_squared), state.innovation_variance
        density = -0.5 * (nis + self.xp.log(S[0]) + self.xp.log(S[1])) - math.log(2.0 * math.pi)
        return {
            "nis": self.where_detected(measurement, nis, math.nan),
            "nis_degrees": 2.0 * measurement.available,
            "log_likelihood": self.where_detected(measurement, density, math.nan),
            "alpha": state.alpha,
        }


class FilterBank(RadarBank):
    """Bank of the controls ``mode``, ``weights`` and ``evidence``: an IMM of fixed-gain filters."""

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
        """Gymnasium space of the selected hypothesis, or of a number for each."""
        return bank_action_space(self.control, self.count)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks: innovations of each filter, likelihoods, probabilities, detection and times."""
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
        """Return the filters' state at the start of the track, equation (24)."""
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
        """Return the filters mixed and predicted to the scan, with the likelihood of the measurement in each."""
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
        """Return the filters updated with their fixed gains, and the weights that follow from the action."""
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
        elapsed = self.time_since_last(measurement)
        updated = alpha_beta.update(state.mean[:2], state.mean[2:], state.innovation, alpha, beta, elapsed)
        covariance = alpha_beta.update_joint_covariance(
            state.covariance, measurement.variance[:, None], alpha, beta, elapsed
        )
        return state._replace(mean=self.xp.concat(updated), covariance=covariance)

    def _in_force(self, state: Filters, measurement: Measurement, after: Filters) -> Filters:
        """Return the updated filters; where the scan missed the target, the predicted ones with probabilities (13)."""
        if self.regular:
            return after
        predicted = imm.softmax(state.log_predicted)
        return self.where_detected(measurement, after, state._replace(probabilities=predicted))

    def mean(self, state: Filters) -> Array:
        """Return the combined mean of the filters, equation (15), ``(4, N)``."""
        return weighted_sum(state.probabilities, state.mean)

    def covariance(self, state: Filters) -> Array:
        """Return the covariance of the combined mean, equation (16), ``(4, 4, N)``."""
        return imm.combine(state.mean, state.covariance, state.probabilities)[1]

    def records(self, state: Filters, measurement: Measurement) -> dict[str, Array]:
        """Return NIS, log-likelihood (NaN without a measurement) and weights to record at a scan, by name."""
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
    """Bank of the control ``gains``: the paper's IMM, whose position gains the action moves."""

    def __init__(self, task: TargetProblem, control: str) -> None:
        super().__init__(task, control)
        self.logit: Array = self.xp.log(self.gain_alpha / (1.0 - self.gain_alpha))

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium box with one number for each filter, which moves its position gain."""
        return gymnasium.spaces.Box(-1.0, 1.0, (self.count,), numpy.float32)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of the other banks, and the gains."""
        each = tuple(str(j + 1) for j in range(self.count))
        return (
            *super().blocks,
            Block("last_alpha", lambda f, _: f.alpha, "position gain used last", each, SHARE),
        )

    def act(self, state: Filters, measurement: Measurement, action: Array) -> Filters:
        """Return the filters updated with ``logit alpha = logit gain + gain_logits a``, weighted by Bayes' rule."""
        xp = self.xp
        moved = self.logit + self.parameters.gain_logits * xp.clip(action, -1.0, 1.0)
        alpha = 1.0 / (1.0 + xp.exp(-moved))
        beta = alpha_beta.benedict_bordner_beta(alpha)
        probabilities = imm.mode_posterior(state.log_predicted, state.log_likelihood)
        after = self._update_filters(state, measurement, alpha, beta)
        return self._in_force(state, measurement, after._replace(probabilities=probabilities, alpha=alpha))
