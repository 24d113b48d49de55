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
