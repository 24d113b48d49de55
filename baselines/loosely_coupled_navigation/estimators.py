"""Estimators of LooselyCoupledNavigation: the augmented filter with the receiver's noise estimated."""

from typing import NamedTuple

import numpy

from ...envs.loosely_coupled_navigation.task import LooselyCoupledNavigation
from ...envs.loosely_coupled_navigation.world import Measurement
from ...envs.observation import Array
from ...envs.task import Initial
from ..measurement_noise import MeasurementNoise, Mehra, SageHusa, VariationalBayes
from .augmented import WINDOW, AugmentedFilter, AugmentedMemory


class Navigator(NamedTuple):
    """Memory of the augmented filter."""

    position: Array
    """``(A, N)``, m."""
    rates: AugmentedMemory


class AugmentedEstimator:
    """The augmented filter, which also estimates the constant and coloured rate errors, reported as it is."""

    kind = "estimator"

    def __init__(self, task: LooselyCoupledNavigation, noise: MeasurementNoise | None = None) -> None:
        self.filter = AugmentedFilter(task.parameters, MeasurementNoise() if noise is None else noise)
        self.xp = task.xp
        self.eye = task.constant(numpy.eye(task.parameters.axes))[:, :, None]

    def start(self, initial: Initial, N: int) -> Navigator:
        """Start where INS and reference agree."""
        return Navigator(initial.mean, self.filter.start(0.0 * initial.mean))

    def update(self, measurement: Measurement, memory: Navigator) -> tuple[Array, Array, Navigator]:
        """Predict by the increment of the INS, update by the fix where there is one."""
        displacement, rates = self.filter.predict(memory.rates)
        position = memory.position + (measurement.increment - displacement)
        innovation = self.xp.where(measurement.available > 0.0, measurement.fix - position, 0.0)
        reported = measurement.reported_deviation * measurement.reported_deviation
        correction, rates = self.filter.update(rates, innovation, reported, measurement.available)
        position = position + correction
        return position, self.eye * rates.covariance.position, Navigator(position, rates)


class AugmentedMehra(AugmentedEstimator):
    """The augmented filter, receiver noise by the mean square of the last innovations (Mehra 1972)."""

    def __init__(self, task: LooselyCoupledNavigation, window: float = WINDOW) -> None:
        super().__init__(task, Mehra(window))


class AugmentedSageHusa(AugmentedEstimator):
    """The augmented filter, receiver noise by the fading mean square of the innovations (Sage and Husa 1969)."""

    def __init__(self, task: LooselyCoupledNavigation, memory: float = WINDOW, trust: float = WINDOW) -> None:
        super().__init__(task, SageHusa(memory, trust))


class AugmentedVariationalBayes(AugmentedEstimator):
    """The augmented filter, receiver noise by variational Bayes (Särkkä and Nummenmaa 2009)."""

    def __init__(self, task: LooselyCoupledNavigation, memory: float = WINDOW, trust: float = WINDOW) -> None:
        super().__init__(task, VariationalBayes(memory, trust))
