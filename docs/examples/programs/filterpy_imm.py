"""filterpy's IMM for ManeuveringTarget as a program: no manoeuvre, and white acceleration of 2.775 m/s^2.

filtergym evaluate filtergym/ManeuveringTarget-v0 --policy "exec:python filterpy_imm.py" --policy kalman-imm
"""

import numpy
from client import serve
from filterpy.kalman import IMMEstimator, KalmanFilter


def begin(hello, initial):
    """Begin a track; the state is x, y, vx, vy."""
    models = []
    for _ in range(2):
        model = KalmanFilter(4, 2)
        model.x, model.P, model.H = numpy.array(initial["mean"]), numpy.array(initial["covariance"]), numpy.eye(2, 4)
        models.append(model)
    imm = IMMEstimator(models, (0.5, 0.5), numpy.array([[0.9, 0.1], [0.1, 0.9]]))

    def update(measurement):
        """Predict to a measurement and take it in."""
        T, identity = measurement["interval"], numpy.eye(2)
        G = numpy.vstack([T**2 / 2 * identity, T * identity])
        for model, sigma in zip(imm.filters, (0.0, 2.775)):
            model.F = numpy.block([[identity, T * identity], [0.0 * identity, identity]])
            model.Q, model.R = sigma**2 * G @ G.T, numpy.diag(measurement["variance"])
        imm.predict()
        if measurement["available"]:
            imm.update(numpy.array(measurement["position"]))
        else:  # filterpy takes over the predicted probabilities of its modes in an update only
            imm.mu = imm.cbar.copy()
            imm._compute_mixing_probabilities()
            imm._compute_state_estimate()
        return imm.x, imm.P

    return update


serve(begin)
