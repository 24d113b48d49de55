"""The bank over faults of LooselyCoupledNavigation as an estimator.

The filters stand in ``envs/loosely_coupled_navigation/fault_bank.py``, because an action may steer them, too.
"""

import math

from ...envs.contract.filter import Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.loosely_coupled_navigation.fault_bank import FaultFilter, Memory
from ...envs.loosely_coupled_navigation.world import Measurement


class FaultBank(FaultFilter):
    """Kalman filters over the noises of INS and receiver and since when the receiver is pulled off.

    Args:
        task: the problem.
        prior: what it expects.
        **changed: fields of the prior.
    """

    kind = "estimator"
    traceable = True

    def start(self, initial: Initial, N: int) -> Memory:
        """Start where INS and reference agree, without a pull."""
        return self.start_bank(initial)

    def update(self, measurement: Measurement, memory: Memory) -> tuple[Array, Array, Memory, Likelihood]:
        """Change hypotheses, predict, update, and report the moments of all."""
        predicted = self.predict_bank(memory, measurement)
        weighing = self.weigh(predicted, measurement)
        found = self.update_bank(predicted, measurement, weighing)
        there = measurement.available > 0.0
        likelihood = Likelihood(
            self.xp.where(there, weighing.log_likelihood, math.nan),
            self.xp.where(there, weighing.nis, math.nan),
            self.parameters.axes * measurement.available,
        )
        return found.mean, found.covariance, found.memory, likelihood
