"""Estimators of LooselyCoupledNavigation: the augmented filter with the receiver's noise estimated."""

import math
from typing import Any, NamedTuple

import numpy

from ...envs.contract.filter import Filter, FilterInput, Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.loosely_coupled_navigation.task import LooselyCoupledNavigation
from ...envs.loosely_coupled_navigation.world import Measurement
from ...filters.ordered_sums import ordered_sum
from ..measurement_noise import MeasurementNoise
from .augmented import AugmentedFilter, AugmentedMemory


class Navigator(NamedTuple):
    """State of the augmented filter: position, and memory of its errors."""

    mean: Array
    """Position, ``(A, N)``, m."""
    covariance: Array
    """Covariance of the position, ``(A, A, N)``, m^2."""
    rates: AugmentedMemory
    likelihood: Likelihood


def likelihood_of_fix(innovation: Array, variance: Array, available: Array, xp: Any) -> Likelihood:
    """Return log-likelihood and NIS of a position fix; NaN where there is none."""
    there, axes = available > 0.0, innovation.shape[0]
    S = xp.where(there, variance, 1.0)
    nis = ordered_sum(innovation * innovation) / S
    density = -0.5 * (nis + axes * xp.log(2.0 * math.pi * S))
    return Likelihood(xp.where(there, density, math.nan), xp.where(there, nis, math.nan), axes * available)


class AugmentedEstimator(Filter[LooselyCoupledNavigation, Measurement, Navigator]):
    """The augmented filter, which also estimates the constant and coloured rate errors."""

    def __init__(
        self, task: LooselyCoupledNavigation, rule: type[MeasurementNoise] = MeasurementNoise, **values: float
    ) -> None:
        super().__init__(task)
        self.filter: AugmentedFilter = AugmentedFilter(task.parameters, rule(**values))
        self.eye: Array = task.constant(numpy.eye(task.parameters.axes))[:, :, None]

    def start(self, initial: Initial) -> Navigator:
        """Return the state at the start of the track, with zero INS error."""
        rates = self.filter.start(0.0 * initial.mean)
        return Navigator(initial.mean, initial.covariance, rates, Likelihood.unknown(initial.mean[0]))

    def update(self, state: Navigator, inputs: FilterInput) -> Navigator:
        """Predict by the INS increment, update with the fix if there is one; return the state."""
        measurement = inputs.measurement
        displacement, predicted = self.filter.predict(state.rates)
        position = state.mean + (measurement.increment - displacement)
        innovation = self.xp.where(measurement.available > 0.0, measurement.fix - position, 0.0)
        reported = measurement.reported_deviation * measurement.reported_deviation
        correction, rates = self.filter.update(predicted, innovation, reported, measurement.available)
        position = position + correction
        likelihood = likelihood_of_fix(
            innovation, predicted.covariance.position + rates.variance, measurement.available, self.xp
        )
        return Navigator(position, self.eye * rates.covariance.position, rates, likelihood)
