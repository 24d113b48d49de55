"""The Kalman-Bucy schemes of LooselyCoupledNavigation that are steered: one by its noises or its gain, or three by
weights.

Equations stand in ``filters/loosely_coupled.py``; (3) is ``Xh' = Xh + dX, nu = Z - Xh', Xh = Xh' + gain nu``.
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
    KEPT_AS_LOG,
    KEPT_AS_LOG1P,
    SHARE,
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
"""The bank under ``mode`` and ``weights``."""
KEPT_AS_DEVIATION_LOG = Compression(
    "half the log of ", None, lambda shown: numpy.exp(2.0 * shown), KEPT_AS_LOG.limits
)
"""The block's function returns the logarithm of a standard deviation; reading gives the variance."""


class Innovations(NamedTuple):
    """Innovations and their averages, of one filter ``(A, N)`` or of three ``(3, A, N)``."""

    innovation: Array
    """nu, zero where there is no measurement, m."""
    normalised: Array
    """The last one that there was, over its standard deviation."""
    average: Array
    """Exponential average of the normalised innovation."""
    average_square: Array
    """Of its square."""
    average_product: Array
    """Of its product with the one before."""
    deviation: Array
    """Standard deviation that is predicted for the innovation at hand, m."""


class GainState(NamedTuple):
    """The plain scheme with the gain of the action."""

    position: Array
    """Xh, predicted to the measurement or updated by it, m, ``(A, N)``."""
    variance: ins_gnss.PlainVariance
    """Of its error with the gains used, m^2, ``(A, N)`` each. ``assumed``, with the coloured noise reduced to white
    and no drift, is the scale of the innovations that are shown; ``modelled`` is reported."""
    seen: Innovations
    action: Array
    """Last action, ``(A, N)``."""
    gain: Array
    """Gain in force, zero without a measurement, ``(A, N)``."""


class Augmented(NamedTuple):
    """The augmented filter with the noises of the action."""

    position: Array
    """Xh, predicted to the measurement or updated by it, m, ``(A, N)``."""
    drift: Array
    """Estimate of beta, ``(A, N)``, m/s."""
    coloured: Array
    """Estimate of eta, ``(A, N)``, m/s."""
    covariance: ins_gnss.AugmentedCovariance
    """After the last measurement that was acted on, the same for all axes, ``(N,)`` each."""
    deviation: Array
    """Standard deviation of the position predicted with the noises of the last action, m, ``(N,)``."""
    seen: Innovations
    action: Array
    """Last action, ``(3, N)``."""


class Schemes(NamedTuple):
    """Three filters side by side, each with its own Kalman gain, and the weights of their estimates."""

    position: Array
    """Xh of each filter, ``(3, A, N)``, m."""
    plain_variance: Array
    """Of the two plain schemes, the same for all axes, ``(2, 1, N)``, m^2."""
    drift: Array
    """Estimate of beta by the augmented filter, ``(A, N)``, m/s."""
    coloured: Array
    """Estimate of eta, ``(A, N)``, m/s."""
    covariance: ins_gnss.AugmentedCovariance
    """Of the augmented filter, the same for all axes, ``(N,)`` each."""
    seen: Innovations
    weights: Array
    """In force, ``(3, N)``."""


class KalmanBucyBank(Bank[Task, Measurement, Any]):
    """Common base of the banks: the innovations in the observation, and its end."""

    parameters: LooselyCoupledNavigationParameters
    filters: tuple[str, ...] = ()
    """Names of the filters, where there are several."""

    def __init__(self, task: Task, control: str) -> None:
        super().__init__(task, control)
        p = self.parameters
        self.axes: tuple[str, ...] = AXES[: p.axes] if p.axes > 1 else ()
        self.forgetting: float = -math.expm1(-1.0 / p.averaging_measurements)
        self.eye: Array = task.constant(numpy.eye(p.axes))[:, :, None]

    @property
    def blocks(self) -> Sequence[Block]:
        """Innovations, their averages, the receiver's report, the last action, and the clock."""
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
                value=lambda f, measurement: measurement.available * f.seen.normalised,
                text="innovation over its predicted standard deviation",
                name="innovation_over_sigma",
                over_interval="mean",
            ),
            innovation_block(
                each,
                value=lambda f, measurement: f.seen.innovation / measurement.reported_deviation,
                text="the innovation over the reported noise",
                name="innovation_over_reported",
                over_interval="mean",
            ),
            average_block(
                "average_innovation",
                lambda f, _: f.seen.average,
                "short average of the innovation over its predicted standard deviation",
                each,
            ),
            Block(
                "average_square",
                lambda f, _: xp.log(1.0 + f.seen.average_square),
                "the short average of its square",
                each,
                KEPT_AS_LOG1P,
            ),
            average_block(
                "average_product",
                lambda f, _: f.seen.average_product,
                "short average of its product with the one before",
                each,
            ),
            Block(
                "reported_noise",
                lambda _, measurement: xp.log(measurement.reported_deviation / nominal),
                "the reported over the nominal variance of a measurement",
                compression=KEPT_AS_DEVIATION_LOG,
            ),
            availability_block("1 with a measurement, 0 without", over_interval="mean"),
            self.last_action(),
            Block(
                "time", time, "t / (t + tau), t since the start, tau the correlation time", compression=SHARE
            ),
        )

    @property
    def quantities(self) -> Sequence[Quantity]:
        """Reported deviation and innovations, without compression."""
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
        """Block of what was done before."""
        raise NotImplementedError

    def no_innovations(self, zero: Array) -> Innovations:
        """Return the innovations at the start of the track, of the shape of ``zero``."""
        return Innovations(zero, zero, zero, zero + 1.0, zero, zero + 1.0)

    def log_density(self, seen: Innovations) -> Array:
        """Return the log-density of the innovations of each axis."""
        return -0.5 * seen.normalised * seen.normalised - self.xp.log(
            math.sqrt(2.0 * math.pi) * seen.deviation
        )

    def consistency(self, state: Any, measurement: Measurement) -> dict[str, Array]:
        """Return the NIS and log-density of one filter, NaN without a measurement."""
        xp, there = self.xp, measurement.available > 0.0
        nis = ordered_sum(state.seen.normalised * state.seen.normalised)
        return {
            "nis": xp.where(there, nis, math.nan),
            "nis_degrees": self.parameters.axes * measurement.available,
            "log_likelihood": xp.where(there, ordered_sum(self.log_density(state.seen)), math.nan),
        }

    def update_innovations(
        self, before: Innovations, measurement: Measurement, position: Array, variance: Array
    ) -> Innovations:
        """Return the innovations of predicted positions, and their averages; without a measurement these stand still.

        Args:
            before: at the measurement before.
            measurement: that arrives.
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
"""What the action scales under ``noise``."""


class NoiseBank(KalmanBucyBank):
    """Control ``noise``: the augmented filter, with the noises scaled by the action."""

    action_space: gymnasium.Space[Any] = gymnasium.spaces.Box(-1.0, 1.0, (len(NOISES),), numpy.float32)

    @property
    def reach(self) -> float:
        """Share of the logarithms of the largest factors that an action of one has."""
        return self.parameters.noise_reach

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation of every filter, and the deviation that this one predicts."""
        nominal = math.sqrt(self.parameters.receiver_variance)
        return (
            *super().blocks,
            Block(
                "predicted_deviation",
                lambda f, _: self.xp.log(f.deviation / nominal),
                "the predicted standard deviation of the position over the nominal one of a measurement",
                compression=KEPT_AS_LOG,
            ),
        )

    def last_action(self) -> Block:
        """Block of the action applied before."""
        return last_action_block(NOISES)

    def start(self, initial: Initial) -> Augmented:
        """Start where INS and reference agree, with the modelled prior of the rate errors."""
        zero = 0.0 * initial.mean
        covariance = self.parameters.prior_covariance(zero[0])
        return Augmented(
            position=initial.mean,
            drift=zero,
            coloured=zero,
            covariance=covariance,
            deviation=zero[0],
            seen=self.no_innovations(zero),
            action=self.xp.stack([zero[0]] * len(NOISES)),
        )

    def predict_covariance(self, state: Augmented, action: Array) -> ins_gnss.AugmentedCovariance:
        """Return the covariance predicted to the measurement with the noises of an action."""
        p, xp = self.parameters, self.xp
        coloured, white = xp.exp(self.reach * math.log(p.process_scale) * action[1:])
        growth, displacement = p.variance_growth
        residual = p.coloured**2 * p.sampling.residual
        white_growth = coloured * residual + white * (displacement - residual)
        return ins_gnss.predict_augmented(state.covariance, p.sampling, coloured * growth, white_growth)

    def receiver_variance(self, measurement: Measurement, action: Array) -> Array:
        """Return the variance of a measurement by an action, ``(N,)``, m^2."""
        p = self.parameters
        up, down = (self.reach * math.log(most) for most in (p.receiver_scale, p.receiver_reduction))
        scale = self.xp.exp(self.xp.where(action[0] > 0.0, up * action[0], down * action[0]))
        return scale * measurement.reported_deviation * measurement.reported_deviation

    def predict(self, state: Augmented, measurement: Measurement) -> Augmented:
        """Predict by the increment of the INS less the estimated rate errors; show it with the last action's noises."""
        s = self.parameters.sampling
        position = state.position + measurement.increment - (s.step * state.drift + s.drive * state.coloured)
        variance = self.predict_covariance(state, state.action).position
        return state._replace(
            position=position,
            coloured=s.decay * state.coloured,
            deviation=self.xp.sqrt(variance),
            seen=self.update_innovations(state.seen, measurement, position, variance),
        )

    def act(self, state: Augmented, measurement: Measurement, action: Array) -> Augmented:
        """Update by the Kalman gain that follows from the noises of the action."""
        innovation = state.seen.innovation
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
        """Return the position, ``(A, N)``, m."""
        return state.position

    def covariance(self, state: Augmented) -> Array:
        """Return the covariance of the filter, ``(A, A, N)``, m^2."""
        return self.eye * state.covariance.position

    def records(self, state: Augmented, measurement: Measurement) -> dict[str, Array]:
        """Return the NIS and log-density (NaN without a measurement)."""
        return self.consistency(state, measurement)


class GainBank(KalmanBucyBank):
    """Control ``gain``: the plain scheme, whose gain on every axis the action sets."""

    def __init__(self, task: Task, control: str) -> None:
        super().__init__(task, control)
        p = self.parameters
        self.error_model = p.sampling, p.plain_growth[1], p.drift, p.coloured, p.white_intensity
        smallest = math.log(p.smallest_gain)
        self.middle: float = min(max(math.log(p.steady_state_gains[1]), 0.9 * smallest), 0.1 * smallest)
        """Logarithm of the gain at action 0: of the paper's, where that leaves room on both sides."""

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """A number for each axis."""
        return gymnasium.spaces.Box(-1.0, 1.0, (self.parameters.axes,), numpy.float32)

    def last_action(self) -> Block:
        """Block of the action applied before."""
        return last_action_block(self.axes)

    def start(self, initial: Initial) -> GainState:
        """Start where INS and reference agree."""
        zero = 0.0 * initial.mean
        variance = ins_gnss.PlainVariance(zero, zero, zero, zero)
        return GainState(initial.mean, variance, self.no_innovations(zero), zero, zero)

    def predict(self, state: GainState, measurement: Measurement) -> GainState:
        """Predict by the increment of the INS."""
        position = state.position + measurement.increment
        variance = ins_gnss.predict_plain(state.variance, *self.error_model)
        seen = self.update_innovations(state.seen, measurement, position, variance.assumed)
        return state._replace(position=position, variance=variance, seen=seen)

    def gain(self, action: Array) -> Array:
        """Return the gain that an action sets, logarithmic from the paper's at 0 to 1 at 1 and to the smallest;
        zero at -1.
        """
        middle, smallest = self.middle, math.log(self.parameters.smallest_gain)
        # Torch would choose between two numbers in float32.
        beyond = self.xp.where(action > 0.0, -middle * action, (middle - smallest) * action)
        return self.xp.where(action <= -1.0, 0.0, self.xp.exp(middle + beyond))

    def action_for_gain(self, gain: Any) -> Any:
        """Return the action that sets gains from 0 to 1, NumPy: the inverse of :meth:`gain`; the smallest one and
        less count as zero.
        """
        smallest, middle = self.parameters.smallest_gain, self.middle
        beyond = numpy.log(numpy.maximum(gain, smallest)) - middle
        action = beyond / numpy.where(beyond > 0.0, -middle, middle - math.log(smallest))
        return numpy.where(gain <= smallest, -1.0, action)

    def act(self, state: GainState, measurement: Measurement, action: Array) -> GainState:
        """Update by the gain of the action; without a measurement the gain is zero."""
        action = self.xp.clip(action, -1.0, 1.0)
        gain = measurement.available * self.gain(action)
        R = measurement.reported_deviation * measurement.reported_deviation
        return state._replace(
            position=state.position + gain * state.seen.innovation,
            variance=ins_gnss.update_plain(state.variance, R, gain),
            action=action,
            gain=gain,
        )

    def mean(self, state: GainState) -> Array:
        """Return the position, ``(A, N)``, m."""
        return state.position

    def covariance(self, state: GainState) -> Array:
        """Return the covariance that belongs to the gains used, ``(A, A, N)``, m^2.

        It holds for the modelled noises, and for gains that do not depend on the innovations.
        """
        return self.eye * state.variance.modelled

    def records(self, state: GainState, measurement: Measurement) -> dict[str, Array]:
        """Return the NIS and log-density (NaN without a measurement), gain and K."""
        found = self.consistency(state, measurement)
        for i, ending in enumerate([f"_{axis}" for axis in self.axes] or [""]):
            found[f"gain{ending}"] = state.gain[i]
            found[f"gain_rate{ending}"] = state.gain[i] / self.parameters.sampling_interval
        return found


LEAST_GROWTH = 1e-12
"""Of a scheme's variance between two measurements, over that of a measurement: with less its variance is lost in
rounding, and it reports to be certain."""


class SchemeBank(KalmanBucyBank):
    """Controls ``mode`` and ``weights``: three filters run side by side without mixing; the action reports."""

    filters: tuple[str, ...] = SCHEMES

    def __init__(self, task: Task, control: str) -> None:
        super().__init__(task, control)
        least = LEAST_GROWTH * self.parameters.receiver_variance
        growth = [max(each, least) for each in self.parameters.plain_growth]
        self.plain_growth: Array = task.constant(growth)[:, None, None]

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """One filter, or a weight for each."""
        return bank_action_space(self.control, len(SCHEMES))

    def last_action(self) -> Block:
        """Block of the weights in force before."""
        names = [name.replace("-", "_") for name in SCHEMES]
        return last_weight_block(names, value=lambda f: f.weights, text="weight put in force before")

    def start(self, initial: Initial) -> Schemes:
        """Start all filters where INS and reference agree, with the modelled prior of the rate errors."""
        xp, p = self.xp, self.parameters
        zero = 0.0 * initial.mean
        each = xp.stack([zero] * 3)
        return Schemes(
            position=each + initial.mean,
            plain_variance=each[:2, :1],
            drift=zero,
            coloured=zero,
            covariance=p.prior_covariance(zero[0]),
            seen=self.no_innovations(each),
            weights=each[:, 0],
        )

    def predict(self, state: Schemes, measurement: Measurement) -> Schemes:
        """Predict every filter by the increment of the INS, the augmented one less its rate errors."""
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
            seen=self.update_innovations(state.seen, measurement, position, variance),
        )

    def act(self, state: Schemes, measurement: Measurement, action: Array) -> Schemes:
        """Update each filter by its own Kalman gain, and put the weights of the action in force."""
        xp, available, innovation = self.xp, measurement.available, state.seen.innovation
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
        # Neither control asks for likelihoods, only for the shape of the bank.
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
        """Return the combination of the estimates, ``(A, N)``, m."""
        return weighted_sum(state.weights, self.xp.moveaxis(state.position, 0, 1))

    def covariance(self, state: Schemes) -> Array:
        """Return the covariance of the combination, the spread of the estimates included, ``(A, A, N)``, m^2."""
        xp = self.xp
        variance = xp.concat([state.plain_variance[:, 0], state.covariance.position[None]])
        position = xp.moveaxis(state.position, 0, 1)
        return imm.combine(position, self.eye[..., None] * variance, state.weights)[1]

    def records(self, state: Schemes, measurement: Measurement) -> dict[str, Array]:
        """Return the weights, the mean of the filters' NIS by them, of the filter believed, and the log-density of
        their mixture (NaN without a measurement).
        """
        there = measurement.available > 0.0
        of_each = ordered_sum(self.xp.moveaxis(self.log_density(state.seen), 1, 0))
        log_likelihood = imm.log_mixture_density(imm.log_probabilities(state.weights), of_each)
        squares = self.xp.moveaxis(state.seen.normalised * state.seen.normalised, 1, 0)
        nis = weighted_sum(state.weights, ordered_sum(squares))
        return {
            "nis": self.xp.where(there, nis, math.nan),
            "nis_degrees": self.parameters.axes * measurement.available,
            "log_likelihood": self.xp.where(there, log_likelihood, math.nan),
            "mode_probability": state.weights,
        }
