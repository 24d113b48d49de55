"""When something is wrong in ManeuveringTarget: the target turns, errors are larger, or scans are missed."""

import numpy

from ...envs.task import Task
from ..alarm import Alarm, certain, innovation_evidence


class RadarAlarm(Alarm):
    """Innovations too large for every filter, or a scan that missed the target or came early."""

    window = 20
    false_alarms = 0.1

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.single = task.control == "gain"
        parts = ["innovation"] if self.single else ["innovation_x", "innovation_y"]
        self.innovation = [task.reader(name) for name in parts]
        self.log_likelihood = None if self.single else task.reader("log_likelihood")
        self.available, self.elapsed = task.reader("available"), task.reader("elapsed")

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Weigh the innovations."""
        available = self.available(observation) > 0.0
        if self.single:
            innovation = self.innovation[0](observation)
            likelihood = numpy.zeros((len(observation), 0))
        else:
            innovation = numpy.stack([read(observation)[:, 0] for read in self.innovation], axis=1)
            likelihood = self.log_likelihood(observation)
            likelihood = likelihood[:, 1:] - likelihood[:, :1]
        weighed = innovation_evidence(innovation, numpy.broadcast_to(available, innovation.shape))
        late = numpy.abs(self.elapsed(observation)[:, 0] - 1.0) > 1e-6
        return numpy.concatenate([weighed, likelihood, certain(late | ~available[:, 0])], axis=1)
