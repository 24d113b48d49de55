"""The bank over levels of UavAutopilot as an estimator.

The filters stand in ``envs/uav_autopilot/level_bank.py``, because an action may steer them, too.
"""

from ...envs.contract.filter import Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.uav_autopilot.level_bank import LevelFilter
from ...envs.uav_autopilot.world import Measurement
from ...filters.noise_levels import Hypotheses
from .estimators import likelihood_of


class LevelBank(LevelFilter):
    """Gaussian sum over levels of gusts and sensors that switch at unknown times, merged like an IMM.

    Args:
        task: the problem.
        prior: what it expects.
        **changed: fields of the prior that differ.
    """

    kind = "estimator"
    traceable = True

    def start(self, initial: Initial, N: int) -> Hypotheses:
        """Start all where everyone starts."""
        return self.start_bank(initial)

    def update(
        self, measurement: Measurement, memory: Hypotheses
    ) -> tuple[Array, Array, Hypotheses, Likelihood]:
        """Switch, predict, update, and report the moments of all."""
        found = self.update_bank(self.predict_bank(memory, measurement), measurement)
        likelihood = likelihood_of(measurement, found.log_likelihood, found.nis, self.xp)
        return found.mean, found.covariance, found.memory, likelihood
