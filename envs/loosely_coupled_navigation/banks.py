"""Kalman-Bucy filters of LooselyCoupledNavigation that an action steers: by noises, by the gain, or by weights.

The equations are in ``filters/loosely_coupled.py``; (3) is ``Xh' = Xh + dX, nu = Z - Xh', Xh = Xh' + gain nu``.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import imm
from ...filters import loosely_coupled as ins_gnss
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ..contract.controls import bank_action_space, bank_probabilities
from ..contract.filter import Bank, Initial
from ..contract.observation import (
    SHARE,
    STORED_AS_LOG,
    STORED_AS_LOG1P,
    Array,
    Block,
    Compression,
    Quantity,
    availability_block,
    average_block,
    innovation_block,
    last_action_block,
    last_weight_block,
)
from ..contract.task import Task
from .parameters import AXES, LooselyCoupledNavigationParameters
from .world import Measurement

SCHEMES = ("plain-white", "plain-reduced", "augmented")
"""Names of the three filters of the bank under ``mode`` and ``weights``."""
STORED_AS_DEVIATION_LOG = Compression(
    "half the log of ", None, lambda shown: numpy.exp(2.0 * shown), STORED_AS_LOG.limits
)
"""Compression of a block whose function returns the log standard deviation; reading gives the variance."""


class Innovations(NamedTuple):
    """Innovations and their averages, of one filter ``(A, N)`` or of three ``(3, A, N)``."""

    innovation: Array
    """Innovation nu, m, zero where there is no measurement."""
    normalised: Array
    """Last innovation of a measurement over its standard deviation."""
    average: Array
    """Exponential average of the normalised innovation."""
    average_square: Array
    """Exponential average of its square."""
    average_product: Array
    """Exponential average of the product of successive normalised innovations."""
    deviation: Array
    """Predicted standard deviation of the innovation, m."""


class GainState(NamedTuple):
    """State of a filter whose gain is the action: position, variance, innovation statistics."""

    position: Array
    """Position estimate Xh, m, ``(A, N)``: predicted to the measurement, or updated by it."""
    variance: ins_gnss.PlainVariance
    """Variances of the position error under the gains used, m^2, ``(A, N)`` each.

    ``assumed``, with the coloured noise reduced to white and no drift, scales the observed innovations; ``modelled`` is
    reported."""
    innovations: Innovations
    action: Array
    """Last action, ``(A, N)``."""
    gain: Array
    """Gain of the last update, zero without a measurement, ``(A, N)``."""


class Augmented(NamedTuple):
    """State of a filter of position and rate errors, whose noises the action scales."""

    position: Array
    """Position estimate Xh, m, ``(A, N)``: predicted to the measurement, or updated by it."""
    drift: Array
    """Estimate of the constant rate error beta, m/s, ``(A, N)``."""
    coloured: Array
    """Estimate of the coloured rate error eta, m/s, ``(A, N)``."""
    covariance: ins_gnss.AugmentedCovariance
    """Covariance after the last update, the same for all axes, ``(N,)`` each."""
    deviation: Array
    """Standard deviation of the position, m, predicted with the noises of the last action, ``(N,)``."""
    innovations: Innovations
    action: Array
    """Last action, ``(3, N)``."""


class Schemes(NamedTuple):
    """State of three parallel filters, each with its own Kalman gain, and the weights of their estimates."""

    position: Array
    """Position estimate Xh of each filter, m, ``(3, A, N)``."""
    plain_variance: Array
    """Variances of the two plain schemes, the same for all axes, m^2, ``(2, 1, N)``."""
    drift: Array
    """Estimate of the constant rate error beta by the augmented filter, m/s, ``(A, N)``."""
    coloured: Array
    """Estimate of the coloured rate error eta by the augmented filter, m/s, ``(A, N)``."""
    covariance: ins_gnss.AugmentedCovariance
    """Covariance of the augmented filter, the same for all axes, ``(N,)`` each."""
    innovations: Innovations
    weights: Array
    """Weights of the filters in the estimate, ``(3, N)``."""


class KalmanBucyBank(Bank[Task, Measurement, Any]):
    """Base class of the Kalman-Bucy filters' banks: innovation statistics and common observation blocks."""

    parameters: LooselyCoupledNavigationParameters
    filters: tuple[str, ...] = ()
    """Names of the filters, if there are several."""

    def __init__(self, task: Task, control: str) -> None:
        super().__init__(task, control)
        p = self.parameters
        self.axes: tuple[str, ...] = AXES[: p.axes] if p.axes > 1 else ()
        self.forgetting: float = -math.expm1(-1.0 / p.averaging_measurements)
        self.eye: Array = task.constant(numpy.eye(p.axes))[:, :, None]

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks: innovations, their averages, the receiver's report, the last action, the time."""
        xp, p = self.xp, self.parameters
        nominal = math.sqrt(p.receiver_variance)
        names = [name.replace("-", "_") for name in self.filters]
        each = [f"{name}_{axis}" for name in names for axis in self.axes] or [*names, *self.axes]

        def time(state: Any, measurement: Measurement) -> Array:
            elapsed = p.sampling_interval * measurement.number
            return elapsed / (elapsed + p.correlation_time)

        return (
            innovation_block(
                each,
                value=lambda f, measurement: measurement.available * f.innovations.normalised,
                text="innovation over its predicted standard deviation",
                name="innovation_over_sigma",
                over_interval="mean",
            ),
            innovation_block(
                each,
                value=lambda f, measurement: f.innovations.innovation / measurement.reported_deviation,
                text="the innovation over the reported noise",
                name="innovation_over_reported",
                over_interval="mean",
            ),
            average_block(
                "average_innovation",
                lambda f, _: f.innovations.average,
                "short average of the innovation over its predicted standard deviation",
                each,
            ),
            Block(
                "average_square",
                lambda f, _: xp.log(1.0 + f.innovations.average_square),
                "the short average of its square",
                each,
                STORED_AS_LOG1P,
            ),
            average_block(
                "average_product",
                lambda f, _: f.innovations.average_product,
                "short average of its product with the one before",
                each,
            ),
            Block(
                "reported_noise",
                lambda _, measurement: xp.log(measurement.reported_deviation / nominal),
                "the reported over the nominal variance of a measurement",
                compression=STORED_AS_DEVIATION_LOG,
            ),
            availability_block("1 with a measurement, 0 without", over_interval="mean"),
            self.last_action(),
            Block(
                "time", time, "t / (t + tau), t since the start, tau the correlation time", compression=SHARE
            ),
        )

    @property
    def quantities(self) -> Sequence[Quantity]:
        """Reported variance, m^2, and innovations, m, computed from the observation."""
        nominal = self.parameters.receiver_variance
        return (
            Quantity(
                "reported_variance",
                "m^2",
                "variance of a measurement as the receiver reports it",
                lambda read: nominal * read("reported_noise"),
            ),
            Quantity(
                "innovation_in_metres",
                "m",
                "innovation of each filter and axis, zero where there is no measurement",
                lambda read: read("innovation_over_reported") * numpy.sqrt(read("reported_variance")),
            ),
        )

    def last_action(self) -> Block:
        """Return the observation block of the previous action; subclasses define it."""
        raise NotImplementedError

    def no_innovations(self, zero: Array) -> Innovations:
        """Return innovation statistics of zero at the start of the track, in the shape of ``zero``."""
        return Innovations(zero, zero, zero, zero + 1.0, zero, zero + 1.0)

    def log_density(self, innovations: Innovations) -> Array:
        """Return the Gaussian log-density of the last innovation on each axis."""
        return -0.5 * innovations.normalised * innovations.normalised - self.xp.log(
            math.sqrt(2.0 * math.pi) * innovations.deviation
        )

    def consistency(self, state: Any, measurement: Measurement) -> dict[str, Array]:
        """Return the records NIS, degrees of freedom and log-likelihood of one filter; NaN without a fix."""
        xp, there = self.xp, measurement.available > 0.0
        nis = ordered_sum(state.innovations.normalised * state.innovations.normalised)
        return {
            "nis": xp.where(there, nis, math.nan),
            "nis_degrees": self.parameters.axes * measurement.available,
            "log_likelihood": xp.where(there, ordered_sum(self.log_density(state.innovations)), math.nan),
        }

    def update_innovations(
        self, before: Innovations, measurement: Measurement, position: Array, variance: Array
    ) -> Innovations:
        """Return the innovation statistics of a measurement; without a fix the averages do not change.

        Args:
            before: those at the previous measurement.
            measurement: INS and receiver.
            position: predicted, m, of the shape of the innovations.
            variance: of its error, m^2, broadcast against it.
        """
        xp, available, reported = self.xp, measurement.available, measurement.reported_deviation
        innovation = available * (measurement.fix - position)
        deviation = xp.sqrt(variance + reported * reported)
        normalised = innovation / deviation
        rate = self.forgetting * available
        square, product = normalised * normalised, normalised * before.normalised
        return Innovations(
            innovation,
            xp.where(available > 0.0, normalised, before.normalised),
            before.average + rate * (normalised - before.average),
            before.average_square + rate * (square - before.average_square),
            before.average_product + rate * (product - before.average_product),
            deviation + 0.0 * innovation,
        )


NOISES = ("receiver", "coloured", "white")
"""Names of the noises that the action scales under ``noise``."""


class NoiseBank(KalmanBucyBank):
    """Bank of the control ``noise``: a filter with estimated rate errors, whose noises the action scales."""

    action_space: gymnasium.Space[Any] = gymnasium.spaces.Box(-1.0, 1.0, (len(NOISES),), numpy.float32)

    @property
    def reach(self) -> float:
        """Share of the range of the noise factors, in logarithms, that actions within [-1, 1] use."""
        return self.parameters.noise_reach

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of every bank here, and the predicted standard deviation of the position."""
        nominal = math.sqrt(self.parameters.receiver_variance)
        return (
            *super().blocks,
            Block(
                "predicted_deviation",
                lambda f, _: self.xp.log(f.deviation / nominal),
                "the predicted standard deviation of the position over the nominal one of a measurement",
                compression=STORED_AS_LOG,
            ),
        )

    def last_action(self) -> Block:
        """Return the observation block of the previous action."""
        return last_action_block(NOISES)

    def start(self, initial: Initial) -> Augmented:
        """Return the filter's state at the start of the track, with the modelled prior of the rate errors."""
        zero = 0.0 * initial.mean
        covariance = self.parameters.prior_covariance(zero[0])
        return Augmented(
            position=initial.mean,
            drift=zero,
            coloured=zero,
            covariance=covariance,
            deviation=zero[0],
            innovations=self.no_innovations(zero),
            action=self.xp.stack([zero[0]] * len(NOISES)),
        )

    def predict_covariance(self, state: Augmented, action: Array) -> ins_gnss.AugmentedCovariance:
        """Return the covariance predicted to the measurement with noises that an action scales."""
        p, xp = self.parameters, self.xp
        coloured, white = xp.exp(self.reach * math.log(p.process_scale) * action[1:])
        growth, displacement = p.variance_growth
        residual = p.coloured**2 * p.sampling.residual
        white_growth = coloured * residual + white * (displacement - residual)
        return ins_gnss.predict_augmented(state.covariance, p.sampling, coloured * growth, white_growth)

    def receiver_variance(self, measurement: Measurement, action: Array) -> Array:
        """Return the variance of the receiver's noise scaled by an action, m^2, ``(N,)``."""
        p = self.parameters
        up, down = (self.reach * math.log(most) for most in (p.receiver_scale, p.receiver_reduction))
        scale = self.xp.exp(self.xp.where(action[0] > 0.0, up * action[0], down * action[0]))
        return scale * measurement.reported_deviation * measurement.reported_deviation

    def predict(self, state: Augmented, measurement: Measurement) -> Augmented:
        """Return the state predicted by the INS increment less rate errors, with innovation statistics."""
        s = self.parameters.sampling
        position = state.position + measurement.increment - (s.step * state.drift + s.drive * state.coloured)
        variance = self.predict_covariance(state, state.action).position
        return state._replace(
            position=position,
            coloured=s.decay * state.coloured,
            deviation=self.xp.sqrt(variance),
            innovations=self.update_innovations(state.innovations, measurement, position, variance),
        )

    def act(self, state: Augmented, measurement: Measurement, action: Array) -> Augmented:
        """Return the state updated with the Kalman gain that follows from the noises of the action."""
        innovation = state.innovations.innovation
        action = self.xp.clip(action, -1.0, 1.0)
        R = self.receiver_variance(measurement, action)
        predicted = self.predict_covariance(state, action)
        gain, P = ins_gnss.update_augmented(predicted, R, measurement.available)
        return state._replace(
            position=state.position + gain.position * innovation,
            # The innovation of the position is minus that of the INS error delta.
            drift=state.drift - gain.drift * innovation,
            coloured=state.coloured - gain.coloured * innovation,
            covariance=P,
            action=action,
        )

    def mean(self, state: Augmented) -> Array:
        """Return the position estimate, m, ``(A, N)``."""
        return state.position

    def covariance(self, state: Augmented) -> Array:
        """Return the covariance of the position estimate, m^2, ``(A, A, N)``."""
        return self.eye * state.covariance.position

    def records(self, state: Augmented, measurement: Measurement) -> dict[str, Array]:
        """Return the NIS, its degrees of freedom and log-likelihood to record, by name; NaN without a fix."""
        return self.consistency(state, measurement)


class GainBank(KalmanBucyBank):
    """Bank of the control ``gain``: position corrected by one gain for each axis, which the action sets."""

    def __init__(self, task: Task, control: str) -> None:
        super().__init__(task, control)
        p = self.parameters
        self.error_model = p.sampling, p.plain_growth[1], p.drift, p.coloured, p.white_intensity
        smallest = math.log(p.smallest_gain)
        self.middle: float = min(max(math.log(p.steady_state_gains[1]), 0.9 * smallest), 0.1 * smallest)
        """Logarithm of the gain at action 0: that of the paper, if it leaves room on both sides."""

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium box [-1, 1] with one number for each axis."""
        return gymnasium.spaces.Box(-1.0, 1.0, (self.parameters.axes,), numpy.float32)

    def last_action(self) -> Block:
        """Return the observation block of the previous action."""
        return last_action_block(self.axes)

    def start(self, initial: Initial) -> GainState:
        """Return the filter's state at the start of the track, where INS and reference agree."""
        zero = 0.0 * initial.mean
        variance = ins_gnss.PlainVariance(zero, zero, zero, zero)
        return GainState(initial.mean, variance, self.no_innovations(zero), zero, zero)

    def predict(self, state: GainState, measurement: Measurement) -> GainState:
        """Return the state predicted by the INS increment, with innovation statistics."""
        position = state.position + measurement.increment
        variance = ins_gnss.predict_plain(state.variance, *self.error_model)
        innovations = self.update_innovations(state.innovations, measurement, position, variance.assumed)
        return state._replace(position=position, variance=variance, innovations=innovations)

    def gain(self, action: Array) -> Array:
        """Return the gain that an action in [-1, 1] sets: 0 at -1, the paper's at 0, and 1 at +1.

        Its logarithm is linear in the action on either side of 0, from ``smallest_gain`` just above -1.
        """
        middle, smallest = self.middle, math.log(self.parameters.smallest_gain)
        # Torch would choose between two numbers in float32.
        beyond = self.xp.where(action > 0.0, -middle * action, (middle - smallest) * action)
        return self.xp.where(action <= -1.0, 0.0, self.xp.exp(middle + beyond))

    def action_for_gain(self, gain: Any) -> Any:
        """Return the action for which :meth:`gain` returns gains in [0, 1], a NumPy array.

        Gains up to ``smallest_gain`` give -1, the action of gain zero.
        """
        smallest, middle = self.parameters.smallest_gain, self.middle
        beyond = numpy.log(numpy.maximum(gain, smallest)) - middle
        action = beyond / numpy.where(beyond > 0.0, -middle, middle - math.log(smallest))
        return numpy.where(gain <= smallest, -1.0, action)

    def act(self, state: GainState, measurement: Measurement, action: Array) -> GainState:
        """Return the state updated with the gain that the action sets; without a fix the gain is zero."""
        action = self.xp.clip(action, -1.0, 1.0)
        gain = measurement.available * self.gain(action)
        R = measurement.reported_deviation * measurement.reported_deviation
        return state._replace(
            position=state.position + gain * state.innovations.innovation,
            variance=ins_gnss.update_plain(state.variance, R, gain),
            action=action,
            gain=gain,
        )

    def mean(self, state: GainState) -> Array:
        """Return the position estimate, m, ``(A, N)``."""
        return state.position

    def covariance(self, state: GainState) -> Array:
        """Return the covariance of the position error under the gains used, m^2, ``(A, A, N)``.

        It holds for the modelled noises, and for gains that do not depend on the innovations.
        """
        return self.eye * state.variance.modelled

    def records(self, state: GainState, measurement: Measurement) -> dict[str, Array]:
        """Return NIS, log-likelihood (NaN without a fix), gain and other values to record, by name."""
        found = self.consistency(state, measurement)
        for i, ending in enumerate([f"_{axis}" for axis in self.axes] or [""]):
            found[f"gain{ending}"] = state.gain[i]
            found[f"gain_rate{ending}"] = state.gain[i] / self.parameters.sampling_interval
        return found


LEAST_GROWTH = 1e-12
"""Smallest growth of a scheme's variance between two measurements, over that of a measurement.

With less its variance is lost in rounding, and the filter reports certainty."""


class SchemeBank(KalmanBucyBank):
    """Bank of the controls ``mode`` and ``weights``: weighted estimates of three unmixed parallel filters."""

    filters: tuple[str, ...] = SCHEMES

    def __init__(self, task: Task, control: str) -> None:
        super().__init__(task, control)
        least = LEAST_GROWTH * self.parameters.receiver_variance
        growth = [max(each, least) for each in self.parameters.plain_growth]
        self.plain_growth: Array = task.constant(growth)[:, None, None]

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium space of the selected filter (``mode``) or of a weight for each filter."""
        return bank_action_space(self.control, len(SCHEMES))

    def last_action(self) -> Block:
        """Return the observation block of the weights before this measurement."""
        names = [name.replace("-", "_") for name in SCHEMES]
        return last_weight_block(names, value=lambda f: f.weights, text="weight of the last measurement")

    def start(self, initial: Initial) -> Schemes:
        """Return the three filters' state at the start of the track, with the prior of the rate errors."""
        xp, p = self.xp, self.parameters
        zero = 0.0 * initial.mean
        each = xp.stack([zero] * 3)
        return Schemes(
            position=each + initial.mean,
            plain_variance=each[:2, :1],
            drift=zero,
            coloured=zero,
            covariance=p.prior_covariance(zero[0]),
            innovations=self.no_innovations(each),
            weights=each[:, 0],
        )

    def predict(self, state: Schemes, measurement: Measurement) -> Schemes:
        """Return every filter predicted by the INS increment; the augmented one subtracts its rate errors."""
        xp, s = self.xp, self.parameters.sampling
        position = state.position + measurement.increment
        corrected = position[2] - (s.step * state.drift + s.drive * state.coloured)
        position = xp.concat([position[:2], corrected[None]])
        plain = state.plain_variance + self.plain_growth
        P = ins_gnss.predict_augmented(state.covariance, s, *self.parameters.variance_growth)
        variance = xp.concat([plain, P.position[None, None]])
        return state._replace(
            position=position,
            plain_variance=plain,
            coloured=s.decay * state.coloured,
            covariance=P,
            innovations=self.update_innovations(state.innovations, measurement, position, variance),
        )

    def act(self, state: Schemes, measurement: Measurement, action: Array) -> Schemes:
        """Return the state: every filter updated with its own gain, and the weights that the action sets or selects."""
        xp, available, innovation = self.xp, measurement.available, state.innovations.innovation
        R = measurement.reported_deviation * measurement.reported_deviation
        plain = state.plain_variance
        plain_gain = available * plain / (plain + R)
        gain, P = ins_gnss.update_augmented(state.covariance, R, available)
        position = xp.concat(
            [
                state.position[:2] + plain_gain * innovation[:2],
                (state.position[2] + gain.position * innovation[2])[None],
            ]
        )
        # Neither control uses likelihoods, only the shape of the bank.
        no_evidence = xp.zeros_like(innovation[:, 0])
        return state._replace(
            position=position,
            plain_variance=ins_gnss.update_variance(plain, R, plain_gain),
            # The innovation of the position is minus that of the INS error delta.
            drift=state.drift - gain.drift * innovation[2],
            coloured=state.coloured - gain.coloured * innovation[2],
            covariance=P,
            weights=bank_probabilities(self.control, action, no_evidence, no_evidence, 0.0, xp),
        )

    def mean(self, state: Schemes) -> Array:
        """Return the weighted mean of the filters' positions, m, ``(A, N)``."""
        return weighted_sum(state.weights, self.xp.moveaxis(state.position, 0, 1))

    def covariance(self, state: Schemes) -> Array:
        """Return the covariance of the weighted mean with the spread of the filters, m^2, ``(A, A, N)``."""
        xp = self.xp
        variance = xp.concat([state.plain_variance[:, 0], state.covariance.position[None]])
        position = xp.moveaxis(state.position, 0, 1)
        return imm.combine(position, self.eye[..., None] * variance, state.weights)[1]

    def records(self, state: Schemes, measurement: Measurement) -> dict[str, Array]:
        """Return weights, NIS and mixture log-likelihood (both NaN without a fix) to record, by name.

        The NIS is the weighted mean of the filters', or that of the selected filter.
        """
        there = measurement.available > 0.0
        of_each = ordered_sum(self.xp.moveaxis(self.log_density(state.innovations), 1, 0))
        log_likelihood = imm.log_mixture_density(imm.log_probabilities(state.weights), of_each)
        squares = self.xp.moveaxis(state.innovations.normalised * state.innovations.normalised, 1, 0)
        nis = weighted_sum(state.weights, ordered_sum(squares))
        return {
            "nis": self.xp.where(there, nis, math.nan),
            "nis_degrees": self.parameters.axes * measurement.available,
            "log_likelihood": self.xp.where(there, log_likelihood, math.nan),
            "mode_probability": state.weights,
        }
