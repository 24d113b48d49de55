"""Bank of the control ``hypotheses``: the estimator ``fault-hypotheses``, whose settings the action multiplies."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

from ...filters import gnss_ins, imm
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ..contract.controls import SettingsBank, SteerableFilter
from ..contract.filter import Initial, Likelihood
from ..contract.observation import (
    BOUNDED_LOG,
    SHARE,
    STORED_AS_LOG,
    Array,
    Block,
    log_density_block,
    probability_block,
)
from .banks import SatelliteBank
from .fault_hypotheses import FaultHypotheses, FaultState, Posterior
from .parameters import HYPOTHESES
from .world import Measurement


class HypothesesState(NamedTuple):
    """State of the bank over motion and faults, with the values that the agent observes.

    Its four hypotheses are those on the motion, and a manoeuvre that has begun.
    """

    own: FaultState
    """State of the estimator after the last action."""
    likelihood: Likelihood
    """Likelihood of the readings under the estimator's prediction."""
    action: Array
    """Last action, ``(8, N)``."""
    log_predicted: Array
    """Logarithms of the probabilities before the readings, ``(4, N)``."""
    log_likelihood: Array
    """Log-likelihood of the readings under each hypothesis, ``(4, N)``."""
    nis: Array
    """Normalised innovation squared by group of sensors, each conditional on the previous groups, ``(4, 4, N)``."""
    average_nis: Array
    """Short average of the NIS per reading, ``(4, 4, N)``."""
    repeated: Array
    """1 where the accelerometers repeat their previous readings exactly, ``(N,)``."""
    range_innovation: Array
    """Innovations of all hypotheses together: S pseudoranges, m, S rates, m/s; ``(2 S, N)``."""
    expected: Array
    """Probabilities after the readings under action zero, ``(4, N)``."""
    range_error: Array
    """Estimated error of each pseudorange under action zero, m, ``(S, N)``."""
    noisy: Array
    """Probability under action zero that the noise of a rate is above its nominal level, ``(S, N)``."""
    between: Array
    """1 where the C/N0 indicates reception between houses, ``(N,)``."""

    @property
    def probabilities(self) -> Array:
        """Probabilities of rest, constant velocity and manoeuvre after the last action, ``(3, N)``."""
        return self.own.hypotheses.probabilities


class FaultHypothesesBank(SettingsBank, SatelliteBank):
    """Bank of ``hypotheses``: estimator ``fault-hypotheses`` with factors on probabilities and noises."""

    filter_class: ClassVar[type[SteerableFilter[Any, Any, Any]]] = FaultHypotheses
    hypotheses: Sequence[str] = (*HYPOTHESES, "begun")

    @property
    def actions(self) -> Sequence[str]:
        """Names of the settings, one for each component of the action."""
        return tuple(self.own.settings)

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of the paper's bank, and others, such as probabilities of motion and faults."""
        xp, p, task = self.xp, self.parameters, self.task
        slots = [str(slot) for slot in p.satellites]
        units = task.constant([0.5 * math.log(2.0 * math.pi * r) for r in task.sensor_variance])[:, None]
        return (
            *super().blocks,
            log_density_block(
                lambda f, y: f.likelihood.log_likelihood + ordered_sum(y.available * units),
                "the log-density of the readings in units of their nominal sigmas, nats", "log_density", "mean",
            ),
            probability_block(
                xp, self.hypotheses, "probability after the readings if the action is zero", value=lambda f: f.expected,
            ),
            Block(
                "range_error", lambda f, y: f.range_error / task.sensors[0].sigma,
                "error of the pseudorange then over sigma", slots, BOUNDED_LOG,
            ),
            probability_block(
                xp, slots, "probability then that the rate is noisier than nominal", "noisy_rate", lambda f: f.noisy,
            ),
            Block(
                "between_houses", lambda f, y: f.between, "1 where a C/N0 is not that of an open sky",
                compression=SHARE, over_interval="mean",
            ),
            Block(
                "position_sigma", lambda f, y: 0.5 * xp.log(ordered_sum(f.own.covariance[i, i] for i in range(3))),
                "the sigma of the position after the last action, m", compression=STORED_AS_LOG,
            ),
        )  # fmt: skip

    def start(self, initial: Initial) -> HypothesesState:
        """Return the bank's state at the start of the track, from the initial estimate."""
        xp, S, M = self.xp, self.task.satellites, len(self.hypotheses)
        own, none = self.own.start(initial), 0.0 * initial.mean[0]
        probabilities = xp.concat([own.hypotheses.probabilities, none[None]])
        nis = xp.stack([xp.stack([none] * M)] * len(self.task.sensors))
        return HypothesesState(
            own=own,
            likelihood=Likelihood(none, none, none),
            action=xp.stack([none] * len(self.actions)),
            log_predicted=imm.log_probabilities(probabilities),
            log_likelihood=nis[0],
            nis=nis,
            average_nis=nis + 1.0,
            repeated=none,
            range_innovation=xp.stack([none] * (2 * S)),
            expected=probabilities,
            range_error=xp.stack([none] * S),
            noisy=1.0 - own.hypotheses.levels[0],
            between=none,
        )

    def add_observed(
        self, state: HypothesesState, result: Posterior, measurement: Measurement
    ) -> HypothesesState:
        """Return the state with innovation statistics, and probabilities before and after a measurement, filled in."""
        xp, task = self.xp, self.task
        log_predicted = imm.log_probabilities(result.predicted)
        change = result.squares / self._present(measurement) - state.average_nis
        memory = result.after.hypotheses
        return state._replace(
            likelihood=result.after.likelihood,
            log_predicted=log_predicted,
            log_likelihood=result.log_likelihoods,
            nis=result.squares,
            average_nis=state.average_nis + (1.0 / self.parameters.averaging_measurements) * change,
            repeated=xp.astype(result.repeated, xp.float64)
            * measurement.available[task.sensors[2].readings.start],
            range_innovation=weighted_sum(result.predicted, result.residual[task.tracked]),
            expected=imm.mode_posterior(log_predicted, result.log_likelihoods),
            range_error=weighted_sum(memory.probabilities, memory.means[gnss_ins.SIZE :]),
            noisy=1.0 - memory.levels[0],
            between=xp.astype(result.between, xp.float64),
        )

    def records(self, state: HypothesesState, measurement: Measurement) -> dict[str, Array]:
        """Return mode probabilities, log-likelihood, NIS, and whether a rate is outside its aperture, by name."""
        xp, rates = self.xp, self.task.sensors[1]
        beyond = xp.abs(state.range_innovation[rates.readings]) > self.parameters.rate_aperture
        return {
            "mode_probability": state.probabilities,
            **state.likelihood._asdict(),
            "rate_outside_aperture": xp.astype(xp.any(beyond, axis=0), xp.float64),
        }
