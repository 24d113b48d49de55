"""The semi-Markov Gaussian sum of ManeuveringTarget as an estimator.

The filter stands in ``envs/maneuvering_target/semi_markov.py``, because an action may steer it, too.
"""

from ...envs.contract.filter import Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.maneuvering_target.semi_markov import SemiMarkovFilter, SemiMarkovTrack
from ...envs.maneuvering_target.world import Measurement
from .estimators import KalmanModel


class SemiMarkov(KalmanModel, SemiMarkovFilter):
    """Gaussian sum over straight flight, constant thrust and coordinated turns with the time since each began.

    Every hypothesis of kind and age has a Kalman filter, an extended one of the turn, and manoeuvres last as their
    distribution says, not geometrically. Turns to the left and to the right are kinds of their own, and so are gentle
    and steep ones: about a turn rate of zero the extended filter would linearise where no turn is.

    Args:
        task: the problem.
        begin: probability that a manoeuvre begins before a scan.
        turning: share of turns among manoeuvres.
        hazards: probability that a manoeuvre ends after each age in scans; the last one for all ages beyond.
        thrust: standard deviation of the acceleration of thrust along x and y, m/s^2.
        turns: mean acceleration in gentle, steep, ... turns, m/s^2.
        turn_spread: its standard deviation in each, m/s^2.
        noise: standard deviation of what disturbs all flight, an acceleration that changes from scan to scan, m/s^2.
        change: of the change of a manoeuvre's acceleration in a scan period, m/s^2.
        outliers: probability that a measurement is one.
        outlier_factor: standard deviation of its errors over the stated one.
    """

    kind = "estimator"

    def start(self, initial: Initial, N: int) -> SemiMarkovTrack:
        """Start where everyone starts, long in straight flight."""
        return self.start_track(initial)

    def update(
        self, measurement: Measurement, memory: SemiMarkovTrack
    ) -> tuple[Array, Array, SemiMarkovTrack, Likelihood]:
        """One cycle."""
        found = self.update_track(self.predict_track(memory, measurement.interval), measurement)
        likelihood = self.likelihood(measurement, found.log_likelihood, found.nis)
        return found.mean, found.covariance, found.track, likelihood
