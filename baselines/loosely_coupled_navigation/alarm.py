"""Alarm of LooselyCoupledNavigation: INS or receiver are not as modelled."""

import numpy

from ...envs.contract.model import Model
from ...envs.contract.observation import Reader, symlog
from ..alarm import Alarm, innovation_evidence

SYMLOG_VARIANCE = 0.38684360137
"""Variance of the signed logarithm of a standard normal number."""


class FusionAlarm(Alarm):
    """Alarm for innovations of the augmented filter that are larger, smaller or to one side.

    Under ``noise`` they are the steered filter's, over the deviation by the receiver's reported noise, under
    ``mode`` and ``weights`` those of an augmented filter in the bank, under ``gain`` those of the plain
    scheme.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.innovation: Reader = model.reader("innovation_over_sigma")
        self.available: Reader = model.reader("available")
        self.axes: int = self.task.parameters.axes

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratios of faulty innovations of each axis, ``(N, kinds)``."""
        innovation, available = self.innovation(observation)[:, -self.axes :], self.available(observation)
        # The observation contains the mean over a decision's measurements of the compressed value.
        measurements = self.measurements(before)
        count = numpy.maximum(available * measurements, 1.0)
        mean = symlog(innovation, numpy) * measurements / numpy.sqrt(count * SYMLOG_VARIANCE)
        normalised = numpy.where(measurements > 1, mean, innovation)
        return innovation_evidence(normalised, numpy.broadcast_to(available > 0.0, normalised.shape))
