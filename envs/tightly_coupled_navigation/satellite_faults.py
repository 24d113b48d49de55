r"""A bank over faults of one pseudorange: a filter of healthy satellites, and one for a fault of each satellite.

Every member is a whole :class:`.FaultHypotheses`. In member j the error of pseudorange j may jump rarely and then
walks at random, so that a slowly growing fault cannot bias its estimate before it is detected (solution separation: R.
G. Brown and P. W. McBurney, Self-contained GPS integrity check using maximum solution separation, Navigation 35,
1988). At most one pseudorange is wrong. Faults begin at a rate h, of all satellites together, and last. With weights
w0 of no fault and wj of that of satellite j,

    w0' = (1 - h T) w0,    wj' = wj + h T w0 / S,

before the readings weight them by their densities. Between houses, where errors are reflections, none begins.
"""

import math
from typing import Any, NamedTuple

from ...filters import imm, range_errors
from ...filters.ordered_sums import weighted_sum
from ..contract.filter import Filter, FilterInput, Initial, Likelihood
from ..contract.observation import Array
from .fault_hypotheses import TRAINING, FaultHypotheses, FaultPrior, FaultState
from .problem import NavigationProblem
from .world import Measurement


class OneFault(FaultHypotheses):
    """Member of a bank: the error of one pseudorange jumps and walks randomly, the others follow the prior.

    Args:
        prior: prior of motion and faults; its jumps are those of this pseudorange.
        wrong: number of the satellite.
        walk: standard deviation of its error's random walk in a second, m.
    """

    def __init__(self, task: NavigationProblem, prior: FaultPrior, wrong: int, walk: float) -> None:
        super().__init__(task, prior)
        self.wrong = wrong
        self.walk: Array = task.constant(walk**2 * task.common.T)

    def _error_process(self, between: Array) -> tuple[Any, Any]:
        """Return the error process of the prior, with a random walk for the faulty pseudorange."""
        kept, gained = super()._error_process(between)
        places = range(self.task.satellites)
        return [1.0 if j == self.wrong else kept for j in places], [
            self.walk if j == self.wrong else gained for j in places
        ]

    def _renewals(self, measurement: Measurement, between: Array, odds: Array) -> list[range_errors.Renewal]:
        """Return the jump distribution of the faulty pseudorange; under an open sky the others do not jump."""
        found = super()._renewals(measurement, between, odds)
        return [
            one if j == self.wrong else one._replace(probability=self.xp.where(between, one.probability, 0.0))
            for j, one in enumerate(found)
        ]


class SatelliteFaultState(NamedTuple):
    """State of the bank over faulty satellites: its members, their weights, the likelihood."""

    members: tuple[FaultState, ...]
    """States of the members: without a fault, and with one of each satellite."""
    weights: Array
    """Weights of the members, ``(1 + S, N)``."""
    likelihood: Likelihood


class SatelliteFaults(Filter[NavigationProblem, Measurement, SatelliteFaultState]):
    """Estimator by a bank of :class:`FaultHypotheses`: no fault, or a lasting fault of one pseudorange.

    Args:
        begins: expected number of faults per second, of all satellites together.
        walk: standard deviation of the wrong pseudorange's random walk in a second, m.
        **changed: fields of the prior.
    """

    def __init__(
        self,
        task: NavigationProblem,
        prior: FaultPrior = TRAINING,
        begins: float = 0.05,
        walk: float = 3.0,
        **changed: Any,
    ) -> None:
        super().__init__(task)
        prior = prior._replace(**{"jump": 0.5, "jump_sigma": 35.0, **changed})
        healthy = FaultHypotheses(task, prior._replace(jump=0.0))
        faulty = [OneFault(task, prior, j, walk) for j in range(task.satellites)]
        self.members: list[Any] = [healthy, *faulty]
        self.begins: float = 1.0 - math.exp(-begins * task.common.T)

    def start(self, initial: Initial) -> SatelliteFaultState:
        """Return every member at the initial estimate, with all weight on no fault."""
        none = 0.0 * initial.mean[0]
        weights = self.xp.stack([none + 1.0, *[none] * self.task.satellites])
        members = tuple(member.start(initial) for member in self.members)
        return SatelliteFaultState(members, weights, Likelihood.unknown(none))

    def update(self, state: SatelliteFaultState, inputs: FilterInput) -> SatelliteFaultState:
        """Return every member updated with a measurement, and weighted by its likelihood."""
        xp, S, measurement = self.xp, self.task.satellites, inputs.measurement
        between = xp.any(measurement.cn0 != self.task.parameters.clear_cn0, axis=0)
        beginning = xp.where(between, 0.0, self.begins) * state.weights[0]
        predicted = [state.weights[0] - beginning, *(state.weights[1 + j] + beginning / S for j in range(S))]
        members = tuple(
            member.update(own, inputs) for member, own in zip(self.members, state.members, strict=True)
        )
        log_prior = imm.log_probabilities(xp.stack(predicted))
        log_likelihood, nis, degrees = (
            xp.stack([getattr(member.likelihood, name) for member in members])
            for name in ("log_likelihood", "nis", "nis_degrees")
        )
        weights = imm.mode_posterior(log_prior, log_likelihood)
        density = imm.log_mixture_density(log_prior, log_likelihood)
        found = Likelihood(density, weighted_sum(weights, nis), weighted_sum(weights, degrees))
        return SatelliteFaultState(members, weights, found)

    def mean(self, state: SatelliteFaultState) -> Array:
        """Return the weighted mean of all members, ``(17, N)``."""
        return weighted_sum(state.weights, self.xp.stack([member.mean for member in state.members], axis=1))

    def covariance(self, state: SatelliteFaultState) -> Array:
        """Return the covariance of the weighted mean, with the spread of the members, ``(17, 17, N)``."""
        means = self.xp.stack([member.mean for member in state.members], axis=1)
        covariances = self.xp.stack([member.covariance for member in state.members], axis=2)
        found: Array = imm.combine(means, covariances, state.weights)[1]
        return found
