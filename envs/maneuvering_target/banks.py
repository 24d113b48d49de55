"""The filters of ManeuveringTarget that are steered: one alpha-beta filter, or a bank of them.

Equations and their numbers stand in ``filters/alpha_beta.py`` and ``filters/imm.py``.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import alpha_beta, imm
from ...filters.gaussian import log_density
from ...filters.ordered_sums import weighted_sum
from ..controls import bank_action_space, bank_probabilities
from ..observation import KEPT_AS_LOG, KEPT_AS_LOG1P, SIGNED_LOG, Array, Block, Quantity
from ..task import Bank, Initial, Task
from .parameters import ManeuveringTargetParameters
from .world import Measurement

SCANS_SHOWN = 20
"""The clock in the observation saturates here: a filter has settled after about ten scans."""


LARGEST_SHARE = 1e8
"""Of what an acceleration leaves over the covariance that the gains give."""


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


class _RadarBank(Bank[Task, Measurement, Any]):
    """What both banks share: the averages that are shown, and the end of the observation."""

    parameters: ManeuveringTargetParameters

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.T = self.parameters.sampling_interval
        self.forgetting = math.exp(-1.0 / self.parameters.averaging_measurements)
        self.average = f"exponential average over {self.parameters.averaging_measurements:g} scans"

    def averaged(self, old: Array, new: Array) -> Array:
        """Exponential average with a new value taken in."""
        return self.forgetting * old + (1.0 - self.forgetting) * new

    def surroundings(self) -> tuple[Block, Block]:
        """Blocks of the measurement itself."""
        xp, unit = self.xp, self.parameters.range_sigma**2
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
            ),
        )


class GainBank(_RadarBank):
    """Control ``gain``: one filter, whose position gain the action sets."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), numpy.float32)

    @property
    def blocks(self) -> Sequence[Block]:
        """Innovations, their averages, gain, and clock."""
        xp = self.xp
        return (
            Block(
                "innovation",
                lambda f, _: f.innovation / xp.sqrt(f.innovation_variance),
                "the innovation over its predicted sigma",
                "xy",
                SIGNED_LOG,
            ),
            Block(
                "log_squared_innovation",
                lambda f, _: f.log_squared,
                "the normalised innovation squared",
                shown=KEPT_AS_LOG1P,
            ),
            Block(
                "average_innovation",
                lambda f, _: f.average_innovation,
                f"its {self.average}",
                "xy",
                SIGNED_LOG,
            ),
            Block(
                "average_log_squared_innovation",
                lambda f, _: f.average_log_squared,
                f"{self.average} of log_squared_innovation",
            ),
            Block(
                "prior_share",
                lambda f, measurement: 1.0 - measurement.variance / f.innovation_variance,
                "1 - R/S: the filter's share of the innovation",
                "xy",
            ),
            Block("last_alpha", lambda f, _: f.alpha, "position gain used last"),
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
        )

    def predict(self, state: AlphaBeta, measurement: Measurement) -> AlphaBeta:
        """Predict by one scan."""
        xp, f = self.xp, state
        predicted = alpha_beta.predict(f.mean[:2], f.mean[2:], self.T)
        covariance = alpha_beta.predict_covariance(f.covariance, self.T)
        innovation = measurement.position - predicted
        S = covariance.position + measurement.variance
        normalised = innovation / xp.sqrt(S)
        squares = normalised * normalised
        log_squared = xp.log1p(squares[0] + squares[1])
        return AlphaBeta(
            f.mean,
            predicted,
            covariance,
            innovation,
            S,
            self.averaged(f.average_excess, innovation * innovation - S),
            self.averaged(f.average_innovation, normalised),
            log_squared,
            self.averaged(f.average_log_squared, log_squared),
            f.alpha,
        )

    def alpha(self, action: Array) -> Array:
        """Position gain that an action sets, linear over ``alpha_range``, ``(N,)``."""
        low, high = self.parameters.alpha_range
        return 0.5 * (low + high) + (0.5 * (high - low)) * self.xp.clip(action[0], -1.0, 1.0)

    def action_for_alpha(self, alpha: Any) -> Any:
        """Action that sets a position gain; the gain must lie within ``alpha_range``."""
        low, high = self.parameters.alpha_range
        return (alpha - 0.5 * (low + high)) / (0.5 * (high - low))

    def act(self, state: AlphaBeta, measurement: Measurement, action: Array) -> AlphaBeta:
        """Update with the gain of the action and the beta that belongs to it."""
        f, alpha = state, self.alpha(action)
        beta = alpha_beta.benedict_bordner_beta(alpha)
        updated = alpha_beta.update(f.predicted, f.mean[2:], f.innovation, alpha, beta, self.T)
        covariance = alpha_beta.update_covariance(f.covariance, measurement.variance, alpha, beta, self.T)
        return f._replace(mean=self.xp.concat(updated), covariance=covariance, alpha=alpha)

    def mean(self, state: AlphaBeta) -> Array:
        """Position and velocity, ``(4, N)``."""
        return state.mean

    def covariance(self, state: AlphaBeta) -> Array:
        """Covariance that belongs to the gains used, and what an acceleration since the last scan would leave of which
        these know nothing: one as large as usual, and as the last innovations say.
        """
        xp, f, T = self.xp, state, self.T
        usual = (0.5 * T**2 * self.parameters.unmodelled_acceleration) ** 2
        beta = alpha_beta.benedict_bordner_beta(f.alpha)
        told = usual + xp.clip(f.average_excess, 0.0, None)
        # Of one direction; beyond this the sum would be singular to rounding.
        told = xp.minimum(
            told, LARGEST_SHARE * xp.minimum(f.covariance.position, T**2 * f.covariance.velocity)
        )
        P = alpha_beta.left_by_acceleration(f.covariance, told, f.alpha, beta, T)
        zero = 0.0 * P.cross[0]
        entries = ((P.position, P.cross), (P.cross, P.velocity))
        return xp.stack(
            [
                xp.stack([entries[i // 2][j // 2][i % 2] if i % 2 == j % 2 else zero for j in range(4)])
                for i in range(4)
            ]
        )

    def records(self, state: AlphaBeta, measurement: Measurement) -> dict[str, Array]:
        """Normalised innovation squared, log-density of the measurement as predicted, and the gain."""
        nis, S = self.xp.expm1(state.log_squared), state.innovation_variance
        return {
            "nis": nis,
            "nis_degrees": 2.0 + 0.0 * state.alpha,
            "log_likelihood": -0.5 * (nis + self.xp.log(S[0]) + self.xp.log(S[1])) - math.log(2.0 * math.pi),
            "alpha": state.alpha,
        }


class FilterBank(_RadarBank):
    """Controls ``mode``, ``weights`` and ``evidence``: filters of fixed gains that mix on their weights."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        p = self.parameters
        self.count = len(p.gains)
        self.gain_alpha = task.constant(p.gains)[:, None]
        self.gain_beta = alpha_beta.benedict_bordner_beta(self.gain_alpha)
        self.transition = task.constant(p.transition)

    @property
    def action_space(self) -> gymnasium.Space:
        """One hypothesis, or a number for each."""
        return bank_action_space(self.task.control, self.count)

    @property
    def blocks(self) -> Sequence[Block]:
        """The same for each filter, likelihoods, probabilities, and clock."""
        xp = self.xp
        each = tuple(str(j + 1) for j in range(self.count))

        def normalised(i: int) -> Any:
            return lambda f, _: f.innovation[i] / xp.sqrt(f.innovation_covariance[i, i])

        over_sigma = "the filter's innovation over its predicted sigma"
        return (
            Block("innovation_x", normalised(0), over_sigma, each, SIGNED_LOG),
            Block("innovation_y", normalised(1), over_sigma, each, SIGNED_LOG),
            Block(
                "log_squared_innovation",
                lambda f, _: f.log_squared,
                "the normalised innovation squared",
                each,
                KEPT_AS_LOG1P,
            ),
            Block(
                "average_innovation_x",
                lambda f, _: f.average_innovation[0],
                f"{self.average} of innovation_x",
                each,
                SIGNED_LOG,
            ),
            Block(
                "average_innovation_y",
                lambda f, _: f.average_innovation[1],
                f"{self.average} of innovation_y",
                each,
                SIGNED_LOG,
            ),
            Block(
                "average_log_squared_innovation",
                lambda f, _: f.average_log_squared,
                f"{self.average} of log_squared_innovation",
                each,
            ),
            Block(
                "log_likelihood",
                lambda f, _: f.log_likelihood - xp.max(f.log_likelihood, axis=0),
                "the log-likelihood minus the largest one, nats",
                each,
                SIGNED_LOG,
            ),
            Block(
                "log_predicted",
                lambda f, _: f.log_predicted,
                "the logarithm of the predicted mode probability",
                each,
                SIGNED_LOG,
            ),
            Block("last_weight", lambda f, _: f.probabilities, "weight in force before this scan", each),
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
        """Mix, predict by one scan, and ask how likely the measurement is."""
        xp, bank = self.xp, state
        prediction = imm.predict_mode_probabilities(self.transition, bank.probabilities)
        mean, covariance = imm.mix(bank.mean, bank.covariance, prediction.mixing)
        mean = xp.concat([alpha_beta.predict(mean[:2], mean[2:], self.T), mean[2:]])
        covariance = alpha_beta.predict_joint_covariance(covariance, self.T)
        innovation = measurement.position[:, None] - mean[:2]
        identity = xp.eye(2, dtype=mean.dtype, device=mean.device)[:, :, None, None]
        S = covariance[:2, :2] + identity * measurement.variance[:, None]
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
            log_likelihood,
            self.averaged(bank.average_innovation, normalised),
            log_squared,
            self.averaged(bank.average_log_squared, log_squared),
            bank.alpha,
        )

    def act(self, state: Filters, measurement: Measurement, action: Array) -> Filters:
        """Update every filter and put the weights of the action in force."""
        probabilities = bank_probabilities(
            self.task.control,
            action,
            state.log_predicted,
            state.log_likelihood,
            self.parameters.evidence_scale,
            self.xp,
        )
        return self._updated(state, measurement, self.gain_alpha, self.gain_beta)._replace(
            probabilities=probabilities
        )

    def _updated(self, state: Filters, measurement: Measurement, alpha: Array, beta: Array) -> Filters:
        """Update every filter by its gains."""
        updated = alpha_beta.update(state.mean[:2], state.mean[2:], state.innovation, alpha, beta, self.T)
        covariance = alpha_beta.update_joint_covariance(
            state.covariance, measurement.variance[:, None], alpha, beta, self.T
        )
        return state._replace(mean=self.xp.concat(updated), covariance=covariance)

    def mean(self, state: Filters) -> Array:
        """Combination of the filters (15), ``(4, N)``."""
        return weighted_sum(state.probabilities, state.mean)

    def covariance(self, state: Filters) -> Array:
        """Covariance of the combination (16)."""
        return imm.combine(state.mean, state.covariance, state.probabilities)[1]

    def records(self, state: Filters, measurement: Measurement) -> dict[str, Array]:
        """NIS of the combined prediction, log-density of the measurement as the filters predict it, and the weights."""
        predicted = self.xp.exp(state.log_predicted)
        innovation, S = imm.combine(state.innovation, state.innovation_covariance, predicted)
        nis = log_density(innovation, S)[1]
        return {
            "nis": nis,
            "nis_degrees": 2.0 + 0.0 * nis,
            "log_likelihood": imm.log_mixture_density(state.log_predicted, state.log_likelihood),
            "mode_probability": state.probabilities,
        }


class SteeredFilterBank(FilterBank):
    """Control ``gains``: the paper's IMM, whose filters have the gains that the action asks for."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.logit = self.xp.log(self.gain_alpha / (1.0 - self.gain_alpha))

    @property
    def action_space(self) -> gymnasium.Space:
        """A number for each filter."""
        return gymnasium.spaces.Box(-1.0, 1.0, (self.count,), numpy.float32)

    @property
    def blocks(self) -> Sequence[Block]:
        """What every bank shows, and the gains."""
        each = tuple(str(j + 1) for j in range(self.count))
        return (*super().blocks, Block("last_alpha", lambda f, _: f.alpha, "position gain used last", each))

    def act(self, state: Filters, measurement: Measurement, action: Array) -> Filters:
        """Update every filter with its gain, ``logit alpha = logit gain + gain_logits a``, and weigh by Bayes' rule."""
        xp = self.xp
        moved = self.logit + self.parameters.gain_logits * xp.clip(action, -1.0, 1.0)
        alpha = 1.0 / (1.0 + xp.exp(-moved))
        beta = alpha_beta.benedict_bordner_beta(alpha)
        probabilities = imm.mode_posterior(state.log_predicted, state.log_likelihood)
        return self._updated(state, measurement, alpha, beta)._replace(
            probabilities=probabilities, alpha=alpha
        )
