"""Banks of RadarEsmTracking: a Kalman filter for each class, weighted by radar and ESM (electronic support measures).

Equation numbers are those of ``filters/class_fusion.py``.
"""

import functools
import math
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import class_fusion, imm
from ...filters.class_fusion import Channels
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ..contract.controls import bank_action_space, bank_probabilities
from ..contract.filter import Bank
from ..contract.observation import (
    BOUNDED_LOG,
    SHARE,
    Array,
    Block,
    average_block,
    average_log_squared_block,
    innovation_block,
    last_weight_block,
    limited,
    linear_scale,
    log_squared_block,
    relative_likelihood_block,
)
from .parameters import RadarEsmTrackingParameters
from .problem import RadarEsmProblem
from .world import Measurement, Start

TIME_UNIT = 60.0
"""Unit of the clock in the observation, s."""
COUNT_UNIT = 10.0
"""Unit of the counts in the observation, decisions."""


class Filters(NamedTuple):
    """State of M Kalman filters, one for each class, and of the ESM decisions so far."""

    mean: Array
    """Means after the radar update (and mixing), ``(3, M, N)``."""
    covariance: Array
    """Covariances after the radar update (and mixing), ``(3, 3, M, N)``."""
    log_predicted: Array
    """Log-probability of the classes given the radar, before the ESM, up to a constant, ``(M, N)``."""
    innovation: Array
    """Whitened innovations of range and range rate, ``(2, M, N)``."""
    log_squared: Array
    """log(1 + normalised innovation squared), ``(M, N)``."""
    log_likelihood: Array
    """Log-likelihood of this scan's radar measurement, ``(M, N)``."""
    average_innovation: Array
    """Exponential average of the innovations, ``(2, M, N)``."""
    average_log_squared: Array
    """Exponential average of ``log_squared``, ``(M, N)``."""
    accumulated: Array
    """Sum of the log-likelihoods since the start, ``(M, N)``."""
    used: Array
    """Whether there is an ESM decision within the gate (6) at this scan, booleans ``(N,)``."""
    used_counts: Array
    """Number of decisions for each type within the gate so far, ``(J, N)``."""
    refused_counts: Array
    """Number of decisions for each type outside the gate so far, ``(J, N)``."""
    probabilities: Array
    """Weights of the classes after the last action, ``(M, N)``."""
    posterior: Array
    """Probabilities of the classes before the next scan's transition, ``(M, N)``: under ``evidence`` those of Bayes'
    rule alone, otherwise the weights."""
    expected: Array
    """Probabilities of the classes at the start of this scan, ``(M, N)``."""


@functools.lru_cache(8)  # an evaluation makes the same bank for every competitor, on numbers and on symbols
def _design_channels(content: Sequence[tuple[tuple[int, ...], bytes]], scans: int) -> class_fusion.Channels:
    *models, start = (numpy.frombuffer(numbers).reshape(shape) for shape, numbers in content)
    return class_fusion.design_channels(class_fusion.Models(*models), start, scans)


def bearing_gate(p: RadarEsmTrackingParameters) -> float:
    """Return the gate on the difference of radar and ESM bearings, degrees, equations (6) and (7)."""
    return class_fusion.bearing_gate(p.radar_bearing_sigma, p.esm_bearing_sigma, p.association_error)


def decision_blocks(task: RadarEsmProblem) -> tuple[Block, Block]:
    """Return the observation blocks of the ESM's type decision and of its bearing difference."""
    none = task.types
    return (
        Block(
            "decision", lambda f, measurement: one_hot(measurement.decision, none + 1, task.xp),
            "1 where the ESM decides for this emitter type; none: for nothing at this scan",
            (*(str(j) for j in range(none)), "none"), SHARE, over_interval="mean",
        ),
        Block(
            "bearing_difference", lambda f, measurement: measurement.bearing_difference,
            "radar minus ESM bearing over the gate", over_interval="mean",
            compression=linear_scale(1.0 / bearing_gate(task.parameters), limits=(-180.0, 180.0)),
        ),
    )  # fmt: skip


def clock_block(task: RadarEsmProblem) -> Block:
    """Return the observation block of the time since the start of the track."""
    xp, factor = task.xp, task.parameters.sampling_interval / TIME_UNIT
    return Block(
        "time", lambda f, measurement: xp.astype(measurement.scan, xp.float64) * factor,
        f"time since the start of the track over {TIME_UNIT:g} s",
        compression=limited(0.0, (task.parameters.horizon + 1) * factor),
    )  # fmt: skip


class ClassBank(Bank[RadarEsmProblem, Measurement, Filters]):
    """Bank of ``evidence``, ``mode`` and ``weights``: one Kalman filter for each class of target, weighted."""

    parameters: RadarEsmTrackingParameters

    def __init__(self, task: RadarEsmProblem, control: str) -> None:
        super().__init__(task, control)
        p, constant = self.parameters, task.constant
        self.forgetting: float = math.exp(-1.0 / p.averaging_measurements)
        self.gate = bearing_gate(p)
        self.mixes: bool = not numpy.array_equal(numpy.array(p.class_transition), numpy.eye(task.classes))
        self.class_transition: Array = constant(p.class_transition)
        self.start_covariance: Array = constant(task.design_models(p)[1])[..., None]
        self.last_scan: int = p.horizon + 1
        if not self.mixes:
            models, start = task.design_models(p)
            arrays = [numpy.asarray(part, dtype=float) for part in (*models, start)]
            # One scan beyond the horizon is measured; lanes that wait for their reset stay at the last column.
            channels = _design_channels(tuple((a.shape, a.tobytes()) for a in arrays), p.horizon + 1)
            self.channels: Channels = class_fusion.Channels(*(constant(table) for table in channels))
        esm = class_fusion.decision_probabilities(numpy.array(p.recognition), numpy.array(p.composition))
        silence = numpy.ones((task.classes, 1))
        self.log_esm: Array = imm.log_probabilities(constant(numpy.concatenate([esm, silence], axis=1)))
        self.log_prior: Array = imm.log_probabilities(constant(p.prior))[:, None]

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium space of the selected class, or of a number for each class."""
        return bank_action_space(self.control, self.task.classes)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks, such as each filter's innovations and likelihoods, ESM decisions, last weights."""
        xp, p, classes = self.xp, self.parameters, self.task.modes
        none = self.task.types
        types = tuple(str(j) for j in range(none))
        decision, bearing_difference = decision_blocks(self.task)
        average = f"exponential average over {p.averaging_measurements:g} scans"
        count = f"decisions for this emitter type so far over {COUNT_UNIT:g}"
        counted = limited(0.0, (self.last_scan + 1) / COUNT_UNIT)

        return (
            innovation_block(
                classes, lambda f, _: f.innovation[0], "the whitened innovation of the range", "innovation_range",
            ),
            innovation_block(
                classes, lambda f, _: f.innovation[1],
                "the whitened innovation of the range rate, without what the range explains", "innovation_range_rate",
            ),
            average_block(
                "average_innovation_range", lambda f, _: f.average_innovation[0],
                f"the {average} of innovation_range", classes,
            ),
            average_block(
                "average_innovation_range_rate", lambda f, _: f.average_innovation[1],
                f"the {average} of innovation_range_rate", classes,
            ),
            relative_likelihood_block(
                xp, classes, "the log-likelihood of this scan's radar measurement minus the largest, nats",
            ),
            relative_likelihood_block(
                xp, classes, "the sum of the log-likelihoods since the start minus the largest, nats", BOUNDED_LOG,
                "accumulated_log_likelihood", lambda f: f.accumulated,
            ),
            log_squared_block(classes),
            average_log_squared_block(average, classes),
            decision,
            Block(
                "decision_refused",
                lambda f, measurement: xp.astype((measurement.decision < none) & ~f.used, xp.float64),
                "1 where the bearing gate refuses the decision", compression=SHARE, over_interval="mean",
            ),
            Block("used_count", lambda f, _: f.used_counts * (1.0 / COUNT_UNIT), f"used {count}", types, counted),
            Block(
                "refused_count", lambda f, _: f.refused_counts * (1.0 / COUNT_UNIT), f"refused {count}", types, counted
            ),
            bearing_difference,
            last_weight_block(classes),
            clock_block(self.task),
        )  # fmt: skip

    # --- the clock

    def start(self, initial: Start) -> Filters:
        """Return the filters started on the first radar measurement, weighted by the first ESM decision."""
        xp = self.xp
        mean = xp.stack([initial.mean] * self.task.classes, axis=1)
        zeros = 0.0 * mean[:2]
        zero = zeros[0]
        log_predicted = self.log_prior + zero
        no_counts = xp.stack([zero[0]] * self.task.types)
        used, used_counts, refused_counts = self._count_decisions(no_counts, no_counts, initial.first)
        probabilities = imm.mode_posterior(log_predicted, self._esm_log_likelihood(used, initial.first))
        return Filters(
            mean=mean,
            covariance=self.start_covariance + zero[0],
            log_predicted=log_predicted,
            innovation=zeros,
            log_squared=zero,
            log_likelihood=zero,
            average_innovation=zeros,
            average_log_squared=zero,
            accumulated=zero,
            used=used,
            used_counts=used_counts,
            refused_counts=refused_counts,
            probabilities=probabilities,
            posterior=probabilities,
            expected=probabilities,
        )

    def predict(self, state: Filters, measurement: Measurement) -> Filters:
        """Return the filters predicted by one scan and updated with the radar, and the ESM decision counted."""
        xp, models, f = self.xp, self.task.models, state
        if self.mixes:
            mean, covariance, log_predicted, innovation, log_likelihood = class_fusion.advance(
                f.posterior, f.mean, f.covariance, measurement.radar, models, self.class_transition
            )
        else:
            scan = xp.clip(measurement.scan, 0, self.last_scan)
            channels = class_fusion.Channels(*(xp.take(part, scan, axis=-1) for part in self.channels))
            mean, innovation, log_likelihood = class_fusion.update_channels(
                f.mean, measurement.radar, models, channels
            )
            covariance = channels.covariance
            log_predicted = imm.log_probabilities(f.posterior) + log_likelihood
        log_squared = xp.log1p(ordered_sum(innovation * innovation))
        used, used_counts, refused_counts = self._count_decisions(
            f.used_counts, f.refused_counts, measurement
        )
        return Filters(
            mean,
            covariance,
            log_predicted,
            innovation,
            log_squared,
            log_likelihood,
            self._average(f.average_innovation, innovation),
            self._average(f.average_log_squared, log_squared),
            f.accumulated + log_likelihood,
            used,
            used_counts,
            refused_counts,
            f.probabilities,
            f.posterior,
            f.posterior,
        )

    def _average(self, old: Array, new: Array) -> Array:
        return self.forgetting * old + (1.0 - self.forgetting) * new

    def _count_decisions(
        self, used_counts: Array, refused_counts: Array, measurement: Measurement
    ) -> tuple[Array, Array, Array]:
        """Return whether this scan's ESM decision is within the gate (6), and the counts of decisions."""
        xp, decision = self.xp, measurement.decision
        decided = one_hot(decision, self.task.types, xp)
        used = (decision < self.task.types) & (xp.abs(measurement.bearing_difference) <= self.gate)
        accepted = xp.astype(used, decided.dtype) * decided
        return used, used_counts + accepted, refused_counts + (decided - accepted)

    def _esm_log_likelihood(self, used: Array, measurement: Measurement) -> Array:
        """Return the log-probability of the ESM decision in each class, ``(M, N)``; 0 outside the gate."""
        usable = self.xp.where(used, measurement.decision, self.task.types)
        return self.xp.take(self.log_esm, usable, axis=1)

    def act(self, state: Filters, measurement: Measurement, action: Array) -> Filters:
        """Return the state with the class weights that follow from the action; evidence counts in this scan only."""
        log_predicted, esm = state.log_predicted, self._esm_log_likelihood(state.used, measurement)
        control, scale = self.control, self.parameters.evidence_scale
        probabilities = bank_probabilities(control, action, log_predicted, esm, scale, self.xp)
        posterior = imm.mode_posterior(log_predicted, esm) if control == "evidence" else probabilities
        return state._replace(probabilities=probabilities, posterior=posterior)

    # --- estimates

    def mean(self, state: Filters) -> Array:
        """Return the weighted mean of the filters, equation (11), ``(3, N)``."""
        return weighted_sum(state.probabilities, state.mean)

    def covariance(self, state: Filters) -> Array:
        """Return the covariance of the weighted mean, with the spread of the filters (12), ``(3, 3, N)``."""
        return imm.combine(state.mean, state.covariance, state.probabilities)[1]

    def records(self, state: Filters, measurement: Measurement) -> dict[str, Array]:
        """Return weights, NIS and log-likelihood of the radar measurement to record at a scan, by name.

        The NIS is the mean over the classes by their probability given the radar; if these are calibrated, its
        expectation is 2.
        """
        squared = ordered_sum(state.innovation * state.innovation)
        nis = weighted_sum(imm.softmax(state.log_predicted), squared)
        expected = imm.log_probabilities(state.expected)
        return {
            "mode_probability": state.probabilities,
            "nis": nis,
            "nis_degrees": 2.0 + 0.0 * nis,
            "log_likelihood": imm.log_mixture_density(expected, state.log_likelihood),
        }


def one_hot(index: Array, count: int, xp: ModuleType) -> Array:
    """Return the one-hot encoding ``(count, N)`` of indices ``(N,)``."""
    return xp.astype(xp.arange(count, device=index.device)[:, None] == index, xp.float64)
