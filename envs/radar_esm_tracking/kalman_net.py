r"""The learned estimator ``kalman-net`` of RadarEsmTracking: a recurrent network sets noises and gains of the filters.

This is the paper's algorithm with two covariances for the Kalman filter of each class: P of the errors, and M, from
which the gain is computed. At every scan the network returns numbers in [-1, 1]: evidence of every class as under
control ``evidence``, then a_0 for the acceleration and a_i for the radar's range and range rate, then b_0 and b_i like
them. They are the same for all classes:

    noise    Q(s) = noise_range^(2 a_0) Q(s),  R_i = noise_range^(2 a_i) R_i,  P' = Phi P Phi^T + Q(s)
    gain     M' = Phi M Phi^T + caution^(2 b_0) Q(s),  K = M' H^T (H M' H^T + diag(caution^(2 b_i) R_i))^-1,
             M = (I - K H) M'
    update   x = x' + K Delta,  P = (I - K H) P' (I - K H)^T + K R K^T                              (Joseph form)

The likelihoods of the classes use P' and R of the previous scan's output. All zero is the paper's algorithm.
References and reading are in ``maneuvering_target/kalman_net.py``.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import class_fusion, imm, packed_covariance
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ...filters.small_matrices import apply, cholesky
from ..contract.controls import bank_probabilities
from ..contract.observation import STORED_AS_LOG, Array, Block, last_action_block
from .banks import ClassBank
from .problem import RadarEsmProblem
from .world import Measurement, Start

EVIDENCE = 12.0
"""Nats that an output of one adds to the log-probability of a class; larger than for policies, which explore."""
NOISE_RANGE = 3.0
"""Largest factor and divisor of the deviations of accelerations and radar errors."""
CAUTION = 3.0
"""Largest factor and divisor of these deviations in the gain alone."""
MEASURED = (0, 1)
"""Names of the measured components: range and range rate."""
NOISES = ("acceleration", "range", "range_rate")


class NetFilters(NamedTuple):
    """State of the bank: :class:`~.banks.Filters`, covariances packed, the gain's covariance, the last output."""

    mean: Array
    """Means, ``(3, M, N)``; between :meth:`KalmanNetBank.predict` and the action predicted."""
    covariance: Array
    """Packed covariances, ``(6, M, N)``; between ``predict`` and the action predicted without process noise."""
    log_predicted: Array
    innovation: Array
    log_squared: Array
    log_likelihood: Array
    average_innovation: Array
    average_log_squared: Array
    accumulated: Array
    used: Array
    used_counts: Array
    refused_counts: Array
    probabilities: Array
    posterior: Array
    expected: Array
    gain_covariance: Array
    """M after an action, ``(6, M, N)``."""
    action: Array
    """Last output of the network, ``(A, N)``."""


class KalmanNetBank(ClassBank):
    """Bank of the learned estimator ``kalman-net``: the action sets noises, gains and weights of the filters."""

    def __init__(self, task: RadarEsmProblem, control: str) -> None:
        super().__init__(task, control)
        models, _ = task.design_models(self.parameters)
        classes = range(task.classes)
        propagators = [packed_covariance.propagator(models.Phi[..., s]) for s in classes]
        self.propagator: Array = task.constant(numpy.stack(propagators, axis=-1))[..., None]
        self.process_noise: Array = packed_covariance.pack(task.constant(models.Q)[..., None])
        self.radar_variances: list[float] = [float(variance) for variance in numpy.diagonal(models.R)]
        self.action_names: tuple[str, ...] = (
            *(f"evidence_{name}" for name in task.modes),
            *NOISES,
            *(f"caution_{name}" for name in NOISES),
        )

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium box of evidence, noises, and their factors in the gain alone."""
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self.action_names),), numpy.float32)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks: those of :class:`ClassBank`, the range's predicted deviation, the last output."""
        unit, place = 1.0 / self.radar_variances[0], packed_covariance.position(3, 0, 0)
        return (
            *super().blocks,
            Block(
                "spread",
                lambda f, _: 0.5 * self.xp.log(f.covariance[place] * unit),
                "the predicted deviation of the range over range_sigma",
                self.task.modes,
                STORED_AS_LOG,
            ),
            last_action_block(self.action_names),
        )

    def start(self, initial: Start) -> Any:
        """Return the filters of the paper at the start of the track, as :class:`NetFilters`."""
        fields = super().start(initial)._asdict()
        fields["covariance"] = covariance = packed_covariance.pack(fields["covariance"])
        action = self.xp.stack([0.0 * initial.mean[0]] * len(self.action_names))
        return NetFilters(**fields, gain_covariance=covariance, action=action)

    def noises(self, action: Array) -> tuple[Array, list[Array]]:
        """Return the process noise factor, and the variances of range and range rate under an action, ``(N,)`` each."""
        classes = self.task.classes
        scale = self.xp.exp(2.0 * math.log(NOISE_RANGE) * action[classes : classes + len(NOISES)])
        return scale[0], [scale[1 + i] * variance for i, variance in enumerate(self.radar_variances)]

    def predict(self, state: Any, measurement: Measurement) -> Any:
        """Return the filters predicted by one scan, with innovation statistics of the radar measurement."""
        xp, f = self.xp, state
        mean = apply(self.task.models.Phi[..., None], f.mean)
        covariance = apply(self.propagator, f.covariance)
        process, radar = self.noises(f.action)
        P = packed_covariance.unpack(covariance + process * self.process_noise, 3)
        delta = measurement.radar[:, None] - mean[:2]
        theta = [[P[i, j] + (radar[i] if i == j else 0.0) for j in MEASURED] for i in MEASURED]
        factor = cholesky(xp.stack([xp.stack(row) for row in theta]))
        innovation = class_fusion.whiten(factor, delta)
        squared = ordered_sum(innovation * innovation)
        log_likelihood = -(0.5 * squared + xp.log(factor[0][0] * factor[1][1]) + math.log(2.0 * math.pi))
        log_squared = xp.log1p(squared)
        used, used_counts, refused_counts = self._count_decisions(
            f.used_counts, f.refused_counts, measurement
        )
        return f._replace(
            mean=mean,
            covariance=covariance,
            log_predicted=imm.log_probabilities(f.posterior) + log_likelihood,
            innovation=innovation,
            log_squared=log_squared,
            log_likelihood=log_likelihood,
            average_innovation=self._average(f.average_innovation, innovation),
            average_log_squared=self._average(f.average_log_squared, log_squared),
            accumulated=f.accumulated + log_likelihood,
            used=used,
            used_counts=used_counts,
            refused_counts=refused_counts,
            expected=f.posterior,
        )

    def act(self, state: Any, measurement: Measurement, action: Array) -> Any:
        """Return the filters updated with the action's gains and weighted, after the class transition."""
        xp, classes, f = self.xp, self.task.classes, state
        a = xp.clip(xp.astype(action, xp.float64), -1.0, 1.0)
        process, radar = self.noises(a)
        caution = xp.exp(2.0 * math.log(CAUTION) * a[classes + len(NOISES) :])
        agile = (process * caution[0]) * self.process_noise
        update = packed_covariance.update_coordinates_with_gain(
            f.mean,
            f.covariance + process * self.process_noise,
            measurement.radar,
            MEASURED,
            xp.stack(radar),
            xp.ones_like(measurement.radar),
            packed_covariance.GainModel(
                apply(self.propagator, f.gain_covariance) + agile,
                xp.stack([caution[1 + i] * radar[i] for i in MEASURED]),
            ),
        )
        mean, covariance, gain_covariance = update
        log_predicted = f.log_predicted
        if self.mixes:
            jump = imm.predict_mode_probabilities(self.class_transition, imm.softmax(log_predicted))
            covariance, gain_covariance = (
                packed_covariance.pack(imm.mix(mean, packed_covariance.unpack(part, 3), jump.mixing)[1])
                for part in (covariance, gain_covariance)
            )
            mean, log_predicted = (
                weighted_sum(jump.mixing, mean[:, :, None]),
                imm.log_probabilities(jump.probabilities),
            )
        esm = self._esm_log_likelihood(f.used, measurement)
        return f._replace(
            mean=mean,
            covariance=covariance,
            log_predicted=log_predicted,
            probabilities=bank_probabilities("evidence", a[:classes], log_predicted, esm, EVIDENCE, xp),
            posterior=imm.mode_posterior(log_predicted, esm),
            gain_covariance=gain_covariance,
            action=a,
        )

    def covariance(self, state: Any) -> Array:
        """Return the covariance of the weighted mean, with the spread of the filters (12), ``(3, 3, N)``."""
        each = packed_covariance.unpack(state.covariance, 3)
        return imm.combine(state.mean, each, state.probabilities)[1]
