"""Estimators of TightlyCoupledNavigation: the paper's bank with updates that no action can ask for."""

import math
from typing import NamedTuple

from ...envs.observation import Array
from ...envs.task import Initial
from ...envs.tightly_coupled_navigation.banks import Filters, HypothesisBank
from ...envs.tightly_coupled_navigation.task import TightlyCoupledNavigation
from ...envs.tightly_coupled_navigation.world import Measurement

EFFICIENT = 1.345
"""Threshold that keeps 95 % of the efficiency where the noise is Gaussian (Huber, Robust Statistics, 1981)."""


class Huber:
    """The paper's bank with Huber's robust update: no reading pulls further than one at the threshold.

    See ``filters/extended_kalman.py``.

    Args:
        task: the problem.
        rates: threshold of the pseudorange rates.
        accelerometers: threshold of the accelerometers; all others have the usual one.
    """

    kind = "estimator"

    def __init__(
        self, task: TightlyCoupledNavigation, rates: float = EFFICIENT, accelerometers: float = EFFICIENT
    ) -> None:
        self.task, self.bank = task, HypothesisBank(task)
        own = {"rates": rates, "accelerometers": accelerometers}
        self.bank.thresholds = [
            own.get(sensor.name, EFFICIENT)
            for sensor in task.sensors
            for _ in range(sensor.readings.start, sensor.readings.stop)
        ]

    def start(self, initial: Initial, N: int) -> Filters:
        """Start every filter where everyone starts."""
        return self.bank.start(initial)

    def update(self, measurement: Measurement, memory: Filters) -> tuple[Array, Array, Filters]:
        """One cycle of the bank."""
        filters = self.bank.predict(memory, measurement)
        filters = self.bank.weigh_by_bayes(filters, memory.last_action)
        return filters.mean, filters.covariance, filters


class Checked(NamedTuple):
    """Memory of the check."""

    filters: Filters
    accelerometers: Array
    """Last readings, ``(3, N)``, m/s^2; NaN before the first."""


class HuberStuckCheck:
    """Huber's robust update, and accelerometers that repeat their last reading exactly are left out at once.

    Noise never repeats itself, so the first repeated reading shows the stuck sensor for certain. Robustness alone
    cannot: a stuck accelerometer agrees with the prediction that it has made, and the outliers are the rates that
    contradict it.

    Args:
        task: the problem.
        **thresholds: of :class:`Huber`.
    """

    kind = "estimator"

    def __init__(self, task: TightlyCoupledNavigation, **thresholds: float) -> None:
        self.task, self.huber = task, Huber(task, **thresholds)

    def start(self, initial: Initial, N: int) -> Checked:
        """Start every filter where everyone starts."""
        return Checked(self.huber.start(initial, N), math.nan * initial.mean[:3])

    def update(self, measurement: Measurement, memory: Checked) -> tuple[Array, Array, Checked]:
        """One cycle of the bank without what repeats itself."""
        xp, forces = self.task.xp, self.task.sensors[2].readings
        available, readings = measurement.available, measurement.readings[forces]
        fresh = xp.any(readings != memory.accelerometers, axis=0)
        kept = available[forces] * xp.astype(fresh, available.dtype)
        available = xp.concat([available[: forces.start], kept, available[forces.stop :]])
        mean, covariance, filters = self.huber.update(
            measurement._replace(available=available), memory.filters
        )
        return mean, covariance, Checked(filters, readings)
