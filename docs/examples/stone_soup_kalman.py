"""Stone Soup's Kalman filter for ManeuveringTarget.

filtergym evaluate filtergym/ManeuveringTarget-v0 --policy stone_soup_kalman:Kalman --policy imm
"""

from filtergym.adapters import StoneSoupEstimator
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.updater.kalman import KalmanUpdater


class Kalman(StoneSoupEstimator):
    """Constant velocity in each axis, white acceleration of density 24 m^2/s^3."""

    state = ("position_x", "velocity_x", "position_y", "velocity_y")

    def __init__(self, task):
        super().__init__(task)
        self.predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(24.0)] * 2))
        self.updater = KalmanUpdater()
