"""Alarm of ManeuveringTarget: the target turns, errors are larger, or scans are missed."""

from typing import ClassVar

import numpy

from ...envs.contract.controls import SettingsBank
from ...envs.contract.model import Model
from ...envs.contract.observation import Reader
from ..alarm import Alarm, fault_evidence, innovation_evidence

ROUNDING = 1e-6
"""Rounding of an interval, scan periods."""


class RadarAlarm(Alarm):
    """Alarm for a manoeuvre: faulty innovations, a better filter of higher gain, or missed and early scans.

    The innovations are those of the filter with the lowest gain. Missed and early scans count for fixed
    gains, which do not model them.
    """

    window = 50
    false_alarms: ClassVar[float] = 0.3

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        bank = self.task.banks.get(model.control)
        self.fixed_gains: bool = bank is not None and not issubclass(bank, SettingsBank)
        self.bank: bool = self.fixed_gains and model.control != "gain"
        names = ("innovation_x", "innovation_y", "log_likelihood") if self.bank else ("innovation",)
        self.read: list[Reader] = [model.reader(name) for name in names]
        self.available: Reader = model.reader("available")
        self.elapsed: Reader | None = model.reader("elapsed") if self.fixed_gains else None

    def evidence(self, observation: numpy.ndarray, before: numpy.ndarray) -> numpy.ndarray:
        """Return the log-likelihood ratios of a manoeuvre, faulty innovations and missed scans, ``(N, kinds)``."""
        there = self.available(observation) > 0.0
        innovation, *likelihood = (read(observation) for read in self.read)
        if self.bank:
            y, log_likelihood = likelihood
            innovation = numpy.stack([innovation[:, 0], y[:, 0]], axis=1)
            likelihood = [log_likelihood[:, 1:] - log_likelihood[:, :1]]
        weighed = innovation_evidence(innovation, numpy.broadcast_to(there, innovation.shape))
        if self.elapsed is None:
            return weighed
        irregular = ~there | (numpy.abs(self.elapsed(observation) - 1.0) > ROUNDING)
        return numpy.concatenate([weighed, *likelihood, fault_evidence(irregular[:, 0])], axis=1)
