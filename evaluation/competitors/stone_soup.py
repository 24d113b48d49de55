"""Adapter that runs components of Stone Soup as an estimator."""

from datetime import datetime, timedelta
from typing import Any

import numpy
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState

from .adapters import Array, SingleTrackEstimator

START = datetime(2000, 1, 1)
"""Time stamp of the start of each track; Stone Soup requires a date, and any date will do."""


class StoneSoupEstimator(SingleTrackEstimator):
    """Base class of estimators by a predictor and an updater of Stone Soup, with one state for each episode.

    Subclasses set ``self.predictor`` and ``self.updater``, after ``super().__init__(task)``. For other
    measurements than positions they define :meth:`detection`, for a control or hypotheses :meth:`step`, for
    particles :meth:`begin`.
    """

    predictor: Any
    updater: Any

    @property
    def interval(self) -> float:
        """Interval of measurements that contain none, s; a subclass defines it if the task's parameters do
        not.
        """
        return self.task.parameters.sampling_interval

    def begin(self, initial: Any) -> Any:
        """Return Stone Soup's Gaussian state at the initial estimate."""
        return GaussianState(initial.mean[:, None], initial.covariance, timestamp=START)

    def detection(self, measurement: Any, timestamp: datetime) -> Any:
        """Return Stone Soup's detection of the measured position; None if it is missing."""
        z, R = self.reading(measurement)
        if z is None:
            return None
        places = [self.state.index(name) for name in self.task.groups["position"]]
        model = LinearGaussian(ndim_state=len(self.state), mapping=places, noise_covar=R)
        return Detection(z[:, None], timestamp=timestamp, measurement_model=model)

    def step(self, track: Any, measurement: Any) -> Any:
        """Predict a Stone Soup state to the measurement's time and update it with the detection, if there is
        one.
        """
        interval = measurement.interval if hasattr(measurement, "interval") else self.interval
        timestamp = track.timestamp + timedelta(seconds=float(interval))
        prediction = self.predictor.predict(track, timestamp=timestamp)
        detection = self.detection(measurement, timestamp)
        if detection is None:
            return prediction
        return self.updater.update(SingleHypothesis(prediction, detection))

    def estimate(self, track: Any) -> tuple[Array, Array]:
        """Return mean and covariance of a Stone Soup state as arrays."""
        return numpy.asarray(track.mean), numpy.asarray(track.covar)
