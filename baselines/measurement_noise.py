"""Models of a sensor's noise variance: as stated, or estimated from the innovations.

Equation numbers are those of ``filters/noise_adaptation.py``.
"""

from collections.abc import Mapping
from typing import Any

from ..filters import noise_adaptation as adaptation
from ..filters.array_namespace import Array

LEAST = 0.1
"""Smallest estimate over the stated variance; ours: a third of the stated deviation, below which there is no gain."""


class MeasurementNoise:
    """Model of a sensor's noise: its variance as stated; subclasses estimate it from innovations."""

    def start(self, stated: Array) -> Any:
        """Return the memory at the start of a track, from the stated variance ``(N,)``; empty here."""
        return ()

    def update(
        self, memory: Any, innovation: Array, P: Array, stated: Array, available: Array
    ) -> tuple[Array, Any]:
        """Return a measurement's noise variance, ``(N,)``, and the memory updated with its innovation.

        Args:
            memory: memory after the last measurement.
            innovation: measurement less prediction, ``(N,)``; of several channels their root mean square.
            P: variance of the predicted measurement without its noise, ``(N,)``.
            stated: stated variance, ``(N,)``.
            available: one where there is a measurement, ``(N,)``.
        """
        return stated, memory


class Mehra(MeasurementNoise):
    """Noise variance estimated by the mean square of the last innovations.

    Args:
        window: number of innovations in the mean.
    """

    def __init__(self, window: float) -> None:
        self.window: int = max(round(window), 1)

    def start(self, stated: Array) -> Array:
        """Return the memory at the start: a window filled with the stated variance."""
        return adaptation.start_window(stated, self.window)

    def update(
        self, memory: Array, innovation: Array, P: Array, stated: Array, available: Array
    ) -> tuple[Array, Array]:
        """Return the noise variance by equation (5) of ``filters/noise_adaptation.py``, and the window."""
        return adaptation.mehra(memory, innovation, P, LEAST * stated, available)


class FadingNoise(MeasurementNoise):
    """Base of noise models that estimate the variance with a fading memory.

    Args:
        memory: effective number of measurements, ``1 / (1 - b)``.
        trust: number of measurements to which the stated variance is equivalent; default: that of the memory.
    """

    def __init__(self, memory: float, trust: float | None = None) -> None:
        self.forgetting: float = 1.0 - 1.0 / memory
        self.trust: float = memory if trust is None else trust


class SageHusaMeasurementNoise(FadingNoise):
    """Noise variance estimated by the fading mean square of the innovations; arguments of :class:`FadingNoise`."""

    def start(self, stated: Array) -> adaptation.Level:
        """Return the memory at the start: a fading mean at the stated variance."""
        return adaptation.Level(stated, self.trust + 0.0 * stated)

    def update(
        self, memory: adaptation.Level, innovation: Array, P: Array, stated: Array, available: Array
    ) -> tuple[Array, adaptation.Level]:
        """Return the noise variance by equation (1) of ``filters/noise_adaptation.py``, and the fading mean."""
        level = adaptation.sage_husa(memory, innovation, P, self.forgetting, LEAST * stated, available)
        return level.value, level


class VariationalBayesMeasurementNoise(FadingNoise):
    """Noise variance estimated as an inverse-gamma distribution; arguments of :class:`FadingNoise`, ``rho`` for
    ``b``.
    """

    iterations = 2

    def start(self, stated: Array) -> adaptation.InverseGamma:
        """Return the memory at the start: an inverse-gamma distribution about the stated variance."""
        shape = 0.5 * self.trust + 0.0 * stated
        return adaptation.InverseGamma(shape, shape * stated)

    def update(
        self, memory: adaptation.InverseGamma, innovation: Array, P: Array, stated: Array, available: Array
    ) -> tuple[Array, adaptation.InverseGamma]:
        """Return the noise variance by (6) and (7) of ``filters/noise_adaptation.py``, and the distribution."""

        def update(R: Array) -> tuple[Array, Array, Array]:
            rest = R / (P + R)
            return rest * innovation, rest * P, R

        noise = adaptation.forget(memory, self.forgetting, available)
        noise, R = adaptation.variational_bayes(noise, update, self.iterations, available)
        return R, noise


RULES: Mapping[str, tuple[type[MeasurementNoise], str]] = {
    "mehra": (Mehra, "by the mean square of the last innovations (Mehra 1972)"),
    "sage-husa": (
        SageHusaMeasurementNoise,
        "by the fading mean square of the innovations (Sage and Husa 1969)",
    ),
    "variational-bayes": (
        VariationalBayesMeasurementNoise,
        "by variational Bayes (Särkkä and Nummenmaa 2009)",
    ),
}
"""Classes of the noise models by their names in tables, with descriptions."""
