"""Estimators of TightlyCoupledNavigation: the paper's bank with robust updates."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ...envs.contract.filter import Filter, FilterInput, Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.tightly_coupled_navigation.banks import EFFICIENT, Filters, HypothesisBank
from ...envs.tightly_coupled_navigation.task import TightlyCoupledNavigation
from ...envs.tightly_coupled_navigation.world import Measurement


class HuberBank(HypothesisBank):
    """The paper's bank with thresholds of the robust update.

    Without accelerometers, where the rates disagree on the average a manoeuvre has begun, which a robust
    update would not follow.

    Args:
        thresholds: threshold of each group of sensors by its name; a group without one has plain updates.
        manoeuvre: limit of the short average of the normalised innovation squared of a rate, under the
            hypothesis with the smallest one; from it on updates without accelerometers are plain.
    """

    def __init__(
        self, task: TightlyCoupledNavigation, thresholds: Mapping[str, float], manoeuvre: float
    ) -> None:
        super().__init__(task, "evidence")
        self.manoeuvre = manoeuvre
        self.of_reading: list[float] = [
            thresholds.get(sensor.name, math.inf)
            for sensor in task.sensors
            for _ in range(sensor.readings.start, sensor.readings.stop)
        ]

    def thresholds(self, state: Filters, measurement: Measurement) -> Sequence[Array]:
        """Return the Huber threshold of every reading, ``(N,)`` each; infinity where updates are plain."""
        xp, forces = self.xp, self.task.sensors[2].readings
        there = xp.all(measurement.available[forces] > 0.0, axis=0)
        robust = there | (xp.min(state.average_nis[1], axis=0) < self.manoeuvre)
        return [xp.where(robust, threshold, math.inf) for threshold in self.of_reading]


class HuberState(NamedTuple):
    """State of the paper's bank with a robust update."""

    filters: Filters
    likelihood: Likelihood


class Huber(Filter[TightlyCoupledNavigation, Measurement, HuberState]):
    """The paper's bank with Huber's robust update of every sensor: outliers pull no further than a threshold.

    See ``filters/extended_kalman.py``.

    Args:
        thresholds: threshold of each group of sensors by its name; default: the usual one for all.
        manoeuvre: see :class:`HuberBank`; by default every update is robust.
    """

    def __init__(
        self,
        task: TightlyCoupledNavigation,
        thresholds: Mapping[str, float] | None = None,
        manoeuvre: float = math.inf,
    ) -> None:
        super().__init__(task)
        everywhere = {sensor.name: EFFICIENT for sensor in task.sensors}
        self.bank: HuberBank = HuberBank(task, everywhere if thresholds is None else thresholds, manoeuvre)

    def start(self, initial: Initial) -> HuberState:
        """Return the state at the start: all filters of the bank at the initial estimate."""
        return HuberState(self.bank.start(initial), Likelihood.unknown(initial.mean[0]))

    def update(self, state: HuberState, inputs: FilterInput) -> HuberState:
        """Predict and update all filters of the bank; return the state."""
        xp, measurement = self.xp, inputs.measurement
        readings = xp.where(xp.isnan(measurement.readings), 0.0, measurement.readings)
        measurement = measurement._replace(readings=readings)  # the bank weighs each by its availability
        filters = self.bank.predict(state.filters, measurement)
        filters = self.bank.weigh_by_bayes(filters, state.filters.action)
        return HuberState(filters, Likelihood.of_records(self.bank.records(filters, measurement)))

    def mean(self, state: HuberState) -> Array:
        """Return the mean of the bank's combined estimate, ``(n, N)``."""
        return self.bank.mean(state.filters)

    def covariance(self, state: HuberState) -> Array:
        """Return the covariance of the bank's combined estimate, ``(n, n, N)``."""
        return self.bank.covariance(state.filters)


class HuberStuckCheck(Huber):
    """Huber's update of ranges and rates, without accelerometers that repeat their last reading.

    The first repeated reading proves that the sensor is stuck. Robustness alone cannot detect it: a stuck
    accelerometer agrees with the prediction from its own readings.

    Args:
        rates: threshold of the pseudorange rates; that of the pseudoranges is the usual one.
        manoeuvre: see :class:`HuberBank`.
    """

    def __init__(
        self, task: TightlyCoupledNavigation, rates: float = EFFICIENT, manoeuvre: float = 4.0
    ) -> None:
        super().__init__(task, {"pseudoranges": EFFICIENT, "rates": rates}, manoeuvre)

    def update(self, state: HuberState, inputs: FilterInput) -> HuberState:
        """Update all filters of the bank without repeated accelerometer readings; return the state."""
        xp, forces, measurement = self.xp, self.task.sensors[2].readings, inputs.measurement
        available = measurement.available
        fresh = xp.any(measurement.readings[forces] != state.filters.accelerometers, axis=0)
        kept = available[forces] * xp.astype(fresh, available.dtype)
        available = xp.concat([available[: forces.start], kept, available[forces.stop :]])
        return super().update(state, FilterInput(measurement._replace(available=available)))
