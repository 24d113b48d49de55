"""The bank over motion and faults of TightlyCoupledNavigation as an estimator.

The filters stand in ``envs/tightly_coupled_navigation/fault_hypotheses.py``, because an action may steer them, too.
"""

from ...envs.contract.filter import Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.tightly_coupled_navigation.fault_hypotheses import FaultFilter, Hypotheses
from ...envs.tightly_coupled_navigation.world import Measurement


class FaultHypotheses(FaultFilter):
    """Extended Kalman filters over the motion, with errors of pseudoranges and levels of rates.

    Args:
        task: the problem.
        prior: what it expects.
        **changed: fields of the prior.
    """

    kind = "estimator"
    traceable = True

    def start(self, initial: Initial, N: int) -> Hypotheses:
        """Start every filter from what is known of the start."""
        return self.start_bank(initial)

    def update(
        self, measurement: Measurement, memory: Hypotheses
    ) -> tuple[Array, Array, Hypotheses, Likelihood]:
        """Predict, weigh hypotheses, levels and renewals by the readings, and report the moments of all."""
        found = self.update_bank(measurement, memory)
        likelihood = Likelihood(found.log_likelihood, found.nis, found.degrees)
        return found.mean, found.covariance, found.memory, likelihood
