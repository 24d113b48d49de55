"""The reference estimator and the bound of LooselyCoupledNavigation.

Given the draw of the episode (every noise level, and time and strength of every receiver fault), INS error and receiver
error are linear and Gaussian, and the Kalman filter has the least mean square error of all estimators that take the
motion from the INS:

    X - (Z - pull) = delta - e - sigma n,        pull = rate (t - onset) while the receiver is spoofed, otherwise 0,

with the INS error (delta, beta, eta), the coloured error e of the receiver, and the deviation sigma of this
measurement, changed, jammed or an outlier. The errors themselves and the motion stay unknown.

Reading: no model of the motion is used.
"""

from types import ModuleType
from typing import NamedTuple

import numpy

from ...envs.contract.draws import is_within
from ...envs.contract.filter import Initial, Likelihood
from ...envs.contract.observation import Array
from ...envs.loosely_coupled_navigation.task import LooselyCoupledNavigation
from ...envs.loosely_coupled_navigation.world import Measurement, Truth
from ...filters import loosely_coupled as ins_gnss
from ...filters import receiver_faults
from ...filters.loosely_coupled import Sampling
from .estimators import likelihood_of_fix


class ErrorState(NamedTuple):
    """State of the reference filter, the INS error and the receiver's coloured error."""

    delta: Array
    """Estimate of the INS error, m, ``(A, N)``."""
    drift: Array
    """Estimate of beta, m/s, ``(A, N)``."""
    coloured: Array
    """Estimate of eta, m/s, ``(A, N)``."""
    receiver: Array
    """Estimate of the receiver's coloured error, m, ``(A, N)``."""
    covariance: receiver_faults.FaultCovariance
    """Covariance entries, ``(N,)`` each, the same for every axis."""


class _Matched:
    """Kalman filter that knows the draw of the episode; errors are then Gaussian, and the filter is optimal."""

    traceable = True
    knows = (
        "the true intensities of all noises, every change of the receiver's, each outlier, and onset, end and rate of "
        "the spoofing"
    )
    disturbances: tuple[str, ...] = ("coloured", "outage", "jamming", "spoofing", "noise_changes", "outliers")

    def __init__(self, task: LooselyCoupledNavigation) -> None:
        self.xp: ModuleType = task.xp
        self.sampling: Sampling = task.parameters.sampling
        self.eye: Array = task.constant(numpy.eye(task.parameters.axes))[:, :, None]

    def start(self, initial: Initial, truth: Truth) -> ErrorState:
        """Return the state at the start: zero INS error with the true prior of all errors."""
        xp, still, zero = self.xp, 0.0 * initial.mean, 0.0 * truth.number
        drift, coloured = truth.drift_deviation, truth.coloured_step / self.sampling.coloured
        P = ins_gnss.AugmentedCovariance(zero, zero, zero, drift * drift, zero, coloured * coloured)
        decay, kick = truth.disturbances["coloured"].process
        lost = 1.0 - decay * decay
        wandering = xp.where(lost > 0.0, kick * kick / xp.where(lost > 0.0, lost, 1.0), 0.0)
        covariance = receiver_faults.FaultCovariance(
            P, xp.stack([zero[None]] * 3), (zero + wandering)[None, None]
        )
        return ErrorState(still, still, still, still, covariance)

    def predict_and_update(
        self, measurement: Measurement, truth: Truth, memory: ErrorState
    ) -> tuple[ErrorState, Likelihood]:
        """Predict with the true noise levels, update with the fix less its spoofing; return state and
        likelihood.
        """
        xp, s = self.xp, self.sampling
        delta = memory.delta + s.step * memory.drift + s.drive * memory.coloured
        coloured = s.decay * memory.coloured
        decay, kick = truth.disturbances["coloured"].process
        receiver = decay * memory.receiver
        P = receiver_faults.predict_fault(
            memory.covariance,
            s,
            truth.coloured_step**2,
            truth.white_step**2,
            decay[None],
            (kick * kick)[None],
        )
        spoofing = truth.disturbances["spoofing"]
        since = s.step * (truth.number - spoofing.window[0] + 1.0)
        pull = xp.where(is_within(truth.number, spoofing.window), spoofing.strength * since, 0.0)
        available = measurement.available
        innovation = available * ((measurement.ins - (measurement.fix - pull)) - (delta - receiver))
        along = receiver_faults.measured_direction(P, xp.ones((1, 1)))
        R = truth.deviation**2
        likelihood = likelihood_of_fix(innovation, along.variance + R, available, xp)
        weight = available / (along.variance + R)
        step = weight * innovation
        state = ErrorState(
            delta + along.position * step,
            memory.drift + along.drift * step,
            coloured + along.coloured * step,
            receiver + along.faults[0] * step,
            receiver_faults.update_fault(P, along, weight),
        )
        return state, likelihood


class Matched(_Matched):
    """The Kalman filter that knows the draw of the episode: the estimate of least mean square error."""

    kind = "reference"

    def update(
        self, memory: ErrorState, measurement: Measurement, truth: Truth
    ) -> tuple[Array, Array, ErrorState, Likelihood]:
        """Return mean and covariance of the position (INS less its estimated error), memory, and likelihood."""
        memory, likelihood = self.predict_and_update(measurement, truth, memory)
        return measurement.ins - memory.delta, self.eye * memory.covariance.ins.position, memory, likelihood


class MatchedCovariance(_Matched):
    """The variance of ``matched``: least mean square error of an estimator that takes the motion from the INS."""

    kind = "bound"

    def update(self, memory: ErrorState, measurement: Measurement, truth: Truth) -> tuple[Array, ErrorState]:
        """Predict and update with the true noise levels; return error variances, m^2, ``(A, N)``."""
        memory, _ = self.predict_and_update(measurement, truth, memory)
        return memory.covariance.ins.position + 0.0 * memory.delta, memory
