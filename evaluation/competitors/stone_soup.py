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

    Subclasses set ``self.predictor`` and ``self.updater``, after ``super().__init__(task)``. Where a
    measurement is more than positions with a covariance they define :meth:`detection`, for a control or hypotheses of
    their own :meth:`step`, for particles :meth:`begin`.

    """

    predictor: Any
    updater: Any

    @property
    def interval(self) -> float:
        """Time between measurements without an interval, s; a subclass must define it where the parameters do not."""
        return self.task.parameters.sampling_interval

    def begin(self, initial: Any) -> Any:
        """Return the Gaussian state of Stone Soup at the initial estimate."""
        return GaussianState(initial.mean[:, None], initial.covariance, timestamp=START)

    def detection(self, measurement: Any, timestamp: datetime) -> Any:
        """Return the detection of the measured position, with its covariance; None if it is missing.

        Args:
            measurement: measurement of this track.
            timestamp: time of the measurement.
        """
        z, R = self.reading(measurement)
        if z is None:
            return None
        places = [self.state.index(name) for name in self.task.groups["position"]]
        model = LinearGaussian(ndim_state=len(self.state), mapping=places, noise_covar=R)
        return Detection(z[:, None], timestamp=timestamp, measurement_model=model)

    def step(self, track: Any, measurement: Any) -> Any:
        """Return the state predicted to the time of a measurement and updated with its detection, if there is one."""
        interval = measurement.interval if hasattr(measurement, "interval") else self.interval
        timestamp = track.timestamp + timedelta(seconds=float(interval))
        prediction = self.predictor.predict(track, timestamp=timestamp)
        detection = self.detection(measurement, timestamp)
        if detection is None:
            return prediction
        return self.updater.update(SingleHypothesis(prediction, detection))

    def estimate(self, track: Any) -> tuple[Array, Array]:
        """Return the mean and the covariance of a state, as arrays."""
        return numpy.asarray(track.mean), numpy.asarray(track.covar)
