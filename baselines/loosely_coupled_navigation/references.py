"""The reference estimator and the bound of LooselyCoupledNavigation."""

from typing import NamedTuple

import numpy

from ...envs.filter import Initial
from ...envs.loosely_coupled_navigation.task import LooselyCoupledNavigation
from ...envs.loosely_coupled_navigation.world import Measurement, Truth
from ...envs.observation import Array
from ...envs.schedules import within
from ...evaluation.competitors import Likelihood
from ...filters import loosely_coupled as ins_gnss
from .estimators import likelihood_of_fix


class ErrorState(NamedTuple):
    """Memory of the filter that is told the true noise levels."""

    delta: Array
    """Estimate of the INS error, m, ``(A, N)``."""
    drift: Array
    """Of beta, m/s, ``(A, N)``."""
    coloured: Array
    """Of eta, m/s, ``(A, N)``."""
    covariance: ins_gnss.AugmentedCovariance
    """``(N,)`` each, the same for every axis."""


class Matched:
    """The augmented filter told the true noise levels, sample by sample, and which samples are spoofed.

    The noise of every episode is Gaussian once its levels are known, so this is the filter of least mean
    square error. Spoofed measurements it leaves out, like those of an outage.
    """

    kind = "reference"
    traceable = True
    knows = (
        "the true intensities of all noises, every change of the receiver's, and which samples are spoofed"
    )

    def __init__(self, task: LooselyCoupledNavigation) -> None:
        self.xp, self.sampling = task.xp, task.parameters.sampling
        self.eye = task.constant(numpy.eye(task.parameters.axes))[:, :, None]

    def start(self, initial: Initial, truth: Truth) -> ErrorState:
        """Start where INS and reference agree, with the true prior of the rate errors."""
        still, zero = 0.0 * initial.mean, 0.0 * truth.number
        drift, coloured = truth.drift_deviation, truth.coloured_step / self.sampling.coloured
        P = ins_gnss.AugmentedCovariance(zero, zero, zero, drift * drift, zero, coloured * coloured)
        return ErrorState(still, still, still, P)

    def predict_and_update(
        self, measurement: Measurement, truth: Truth, memory: ErrorState
    ) -> tuple[ErrorState, Likelihood]:
        """Predict with the true noise levels and update with the true variance of the measurement."""
        xp, s = self.xp, self.sampling
        delta = memory.delta + s.step * memory.drift + s.drive * memory.coloured
        coloured = s.decay * memory.coloured
        P = ins_gnss.predict_augmented(memory.covariance, s, truth.coloured_step**2, truth.white_step**2)
        used = xp.where(within(truth.number, truth.spoofing), 0.0, measurement.available)
        innovation = used * ((measurement.ins - measurement.fix) - delta)
        likelihood = likelihood_of_fix(innovation, P.position + truth.deviation**2, used, xp)
        gain, P = ins_gnss.update_augmented(P, truth.deviation**2, used)
        state = ErrorState(
            delta + gain.position * innovation,
            memory.drift + gain.drift * innovation,
            coloured + gain.coloured * innovation,
            P,
        )
        return state, likelihood

    def update(
        self, measurement: Measurement, truth: Truth, memory: ErrorState
    ) -> tuple[Array, Array, ErrorState, Likelihood]:
        """Report the INS less its estimated error."""
        memory, likelihood = self.predict_and_update(measurement, truth, memory)
        return measurement.ins - memory.delta, self.eye * memory.covariance.position, memory, likelihood


class MatchedCovariance(Matched):
    """The variance of ``matched``: least mean square error of an estimator with the data it uses."""

    kind = "bound"

    def update(  # type: ignore[override]  # a bound gives mean squares in place of an estimate
        self, measurement: Measurement, truth: Truth, memory: ErrorState
    ) -> tuple[Array, ErrorState]:
        """Variance of every axis, ``(A, N)``."""
        memory, _ = self.predict_and_update(measurement, truth, memory)
        return memory.covariance.position + 0.0 * memory.delta, memory
