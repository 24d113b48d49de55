"""Alarm of TightlyCoupledNavigation: a sensor is noisy or stuck."""

import numpy

from ...envs.contract.model import Model
from ...envs.contract.observation import Reader
from ..alarm import LARGER, Alarm, fault_evidence, scale_ratio


class SensorAlarm(Alarm):
    """Alarm for sensors: too large innovations under every hypothesis, or accelerometers that repeat a
    reading.
    """

    window = 20

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.nis: Reader = model.reader("nis")
        self.repeat: Reader = model.reader("accelerometers_repeat")
        self.available = model.reader("pseudorange_available"), model.reader("rate_available")
        self.others = [sensor.readings.stop - sensor.readings.start for sensor in self.task.sensors[2:]]

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratios of a noisy or stuck sensor of every group, ``(N, kinds)``."""
        count = len(observation)
        here = [read(observation).sum(axis=1) for read in self.available]
        here += [numpy.full(count, float(readings)) for readings in self.others]
        # The observation contains the mean over the readings and measurements of a decision.
        measurements = self.measurements(before)
        degrees = measurements * numpy.stack(here, axis=1)
        mean = self.nis(observation).reshape(count, len(here), -1).min(axis=2)
        stuck = self.repeat(observation)[:, 0] > 0.0
        return numpy.concatenate(
            [scale_ratio(degrees * mean, degrees, LARGER), fault_evidence(stuck)], axis=1
        )
