"""When something is wrong in TightlyCoupledNavigation: a sensor is noisy, stuck or missing."""

import numpy

from ...envs.tightly_coupled_navigation.parameters import HYPOTHESES
from ...envs.tightly_coupled_navigation.task import TightlyCoupledNavigation
from ..alarm import LARGER, Alarm, certain, scale_ratio


class SensorAlarm(Alarm):
    """Innovations of a group of sensors too large under every hypothesis, pseudoranges or rates that are missing, or
    accelerometers that repeat their last reading exactly: noise never does.
    """

    window = 20

    def __init__(self, task: TightlyCoupledNavigation) -> None:
        super().__init__(task)
        self.nis, self.accelerometer = task.reader("nis"), task.reader("accelerometer")
        self.available = task.reader("pseudorange_available"), task.reader("rate_available")
        self.readings = [sensor.readings.stop - sensor.readings.start for sensor in task.sensors[2:]]

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Weigh every group of sensors."""
        count, interval = len(observation), self.task.decision_interval
        tracked = [read(observation) for read in self.available]
        here = [available.sum(axis=1) for available in tracked]
        here += [numpy.full(count, float(readings)) for readings in self.readings]
        degrees = interval * numpy.stack(here, axis=1)
        # A mean over the readings and measurements of a decision.
        mean = self.nis(observation).reshape(count, -1, len(HYPOTHESES)).min(axis=2)
        larger = scale_ratio(degrees * mean, degrees, LARGER)
        stuck = (self.accelerometer(observation) == self.accelerometer(before)).all(axis=1)
        return numpy.concatenate([larger, certain(stuck)], axis=1)
