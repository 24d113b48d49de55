"""When something is wrong in LooselyCoupledNavigation: INS or receiver are not as modelled."""

from typing import Any

import numpy

from ...envs.loosely_coupled_navigation.task import LooselyCoupledNavigation
from ..alarm import Alarm, innovation_evidence


class FusionAlarm(Alarm):
    """Innovations of the augmented filter that are larger, smaller or to one side. An outage is none of these: every
    filter is told of it.

    Under ``noise`` the steered filter's are taken over the deviation that goes with the noise as the receiver reports
    it, whatever the agent takes it to be. Under ``mode`` and ``weights`` there is an augmented filter in the bank,
    which nobody steers. Under ``gain`` there is none, and the plain scheme's innovations are judged as they are.
    """

    def __init__(self, task: LooselyCoupledNavigation) -> None:
        super().__init__(task)
        self.over_sigma = task.reader("innovation_over_sigma")
        self.over_reported = task.reader("innovation_over_reported")
        self.available, self.reported = task.reader("available"), task.reader("reported_noise")
        self.predicted: Any = task.reader("predicted_deviation") if task.control == "noise" else None
        self.axes = task.parameters.axes

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Weigh the innovations."""
        available = self.available(observation)[:, 0]
        if self.predicted is None:
            normalised = self.over_sigma(observation)[:, -self.axes :]
        else:
            reported = self.reported(observation)
            share = reported / (reported + self.predicted(observation) ** 2)
            normalised = self.over_reported(observation) * numpy.sqrt(share)
        there = numpy.broadcast_to(available[:, None] > 0.0, normalised.shape)
        return innovation_evidence(normalised, there)
