"""Faults of sensors that more than one environment has."""

from types import ModuleType
from typing import NamedTuple

from .observation import Array


class Outliers(NamedTuple):
    """Measurements whose errors are larger than stated, each one on its own, as by glint; nobody says so."""

    probability: float
    factor: float
    """Standard deviation of their errors over that of the others."""

    @property
    def row_uniforms(self) -> int:
        """Uniform numbers that a measurement takes: one, or none where there are no outliers."""
        return 1 if self.probability else 0

    def amplify(self, deviation: Array, uniforms: Array, xp: ModuleType) -> Array:
        """Return standard deviations, or errors, multiplied by the factor where a measurement is an outlier.

        Args:
            deviation: ``(..., N)``.
            uniforms: ``(row_uniforms, N)``.
            xp: array namespace.
        """
        if not self.probability:
            return deviation
        return xp.where(uniforms[0] < self.probability, self.factor, xp.ones_like(uniforms[0])) * deviation


class GaussMarkov(NamedTuple):
    """Coloured error of a sensor, ``e_k = psi e_{k-1} + sigma sqrt(1 - psi^2) n`` (first-order Gauss-Markov):
    multipath, the atmosphere, a reference that wanders. It is stationary from the start.
    """

    decay: Array
    """psi, what is left of the error from one measurement to the next, ``(N,)``."""
    kick: Array
    """Standard deviation of what it gains, ``sigma sqrt(1 - psi^2)``, ``(N,)``."""

    @classmethod
    def sampled(
        cls, deviation: Array, correlation_time: Array, interval: float, xp: ModuleType
    ) -> "GaussMarkov":
        """Return the error of a stationary deviation, sampled exactly.

        Args:
            deviation: sigma, ``(N,)``.
            correlation_time: s, ``(N,)``.
            interval: from one measurement to the next, s.
            xp: array namespace.
        """
        decay = xp.exp(-interval / correlation_time)
        return cls(decay, deviation * xp.sqrt(1.0 - decay * decay))

    def advance(self, error: Array, normals: Array) -> Array:
        """Return the errors of the next measurement, ``(..., N)``."""
        return self.decay * error + self.kick * normals
