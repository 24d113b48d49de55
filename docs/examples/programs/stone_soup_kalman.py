"""Stone Soup's Kalman filter for ManeuveringTarget as a program: white acceleration of density 24 m^2/s^3.

filtergym evaluate filtergym/ManeuveringTarget-v0 --policy "exec:python stone_soup_kalman.py" --policy kalman-imm
"""

from datetime import datetime, timedelta

import numpy
from client import serve
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater

ORDER = [0, 2, 1, 3]
"""Stone Soup's state is x, vx, y, vy, and ours x, y, vx, vy: each is the other's with the middle two exchanged."""
predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(24.0)] * 2))
updater = KalmanUpdater()


def begin(hello, initial):
    """Begin a track."""
    mean, covariance = numpy.array(initial["mean"]), numpy.array(initial["covariance"])
    state = GaussianState(mean[ORDER, None], covariance[ORDER][:, ORDER], timestamp=datetime(2000, 1, 1))

    def update(measurement):
        """Predict to a measurement and take it in."""
        nonlocal state
        time = state.timestamp + timedelta(seconds=measurement["interval"])
        state = predictor.predict(state, timestamp=time)
        if measurement["available"]:
            R = numpy.diag(measurement["variance"])
            model = LinearGaussian(ndim_state=4, mapping=[0, 2], noise_covar=R)
            position = numpy.array(measurement["position"])[:, None]
            detection = Detection(position, timestamp=time, measurement_model=model)
            state = updater.update(SingleHypothesis(state, detection))
        return numpy.asarray(state.mean)[ORDER, 0], numpy.asarray(state.covar)[ORDER][:, ORDER]

    return update


serve(begin)
