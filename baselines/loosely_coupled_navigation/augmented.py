"""The augmented filter of LooselyCoupledNavigation with receiver noise as reported, or estimated.

The noise is estimated from the innovations (root of the mean square of all axes), starting from the reported
variance; the estimate restarts when the report changes.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

from ...envs.loosely_coupled_navigation.parameters import LooselyCoupledNavigationParameters
from ...filters import loosely_coupled as ins_gnss
from ...filters.array_namespace import Array, namespace, select_nested
from ...filters.ordered_sums import ordered_sum
from ..measurement_noise import RULES, MeasurementNoise
from ..table import Tunable, Variant, tunable

WINDOW = 25.0
"""Untuned length of a window, measurements: 0.25 s, the time constant of the averages in the observation."""

_FADING = {"memory": (5.0, WINDOW, 200.0), "trust": (1.0, WINDOW, 200.0)}
LIMITS = {"mehra": {"window": (5.0, WINDOW, 150.0)}, "sage-husa": _FADING, "variational-bayes": _FADING}
"""Limits of the arguments of each rule: the smallest, those without tuning, the largest."""


def with_rules(
    host: type, name: str, description: str, rules: Iterable[str] = RULES
) -> tuple[dict[str, Variant], dict[str, Tunable]]:
    """Return a policy's or estimator's variants with each rule for the receiver's noise, and their tuning."""
    variants, tunables = {}, {}
    for rule in rules:
        cls, words = RULES[rule]
        untuned = {value: start for value, (_, start, _) in LIMITS[rule].items()}
        variants[f"{name}-{rule}"] = Variant(host, f"{description} {words}.", rule=cls, **untuned)
        found = tunable(variants[f"{name}-{rule}"], **LIMITS[rule])
        tunables[f"{name}-{rule}"] = replace(found, in_lanes=rule != "mehra")  # the window is an integer
    return variants, tunables


class AugmentedMemory(NamedTuple):
    """State of the augmented filter without the position."""

    drift: Array
    """Estimate of beta, ``(A, N)``, m/s."""
    coloured: Array
    """Estimate of eta, ``(A, N)``, m/s."""
    covariance: ins_gnss.AugmentedCovariance
    """Covariance entries, ``(N,)`` each."""
    reported: Array
    """Variance that the receiver reported last, ``(N,)``, m^2."""
    noise: Any
    """Memory of the estimate of the receiver's noise."""
    variance: Array
    """Variance of the receiver in the last update, ``(N,)``, m^2."""


class AugmentedFilter:
    """Augmented filter of the INS error (position, drift, coloured rate error); the caller stores the
    position.
    """

    def __init__(self, parameters: LooselyCoupledNavigationParameters, noise: MeasurementNoise) -> None:
        self.parameters = parameters
        self.noise = noise

    def start(self, none: Array) -> AugmentedMemory:
        """Return the memory at the start: zero errors, of the shape ``(A, N)`` of ``none``, with the prior
        covariance.
        """
        p, zero = self.parameters, none[0]
        return AugmentedMemory(none, none, p.prior_covariance(zero), zero, self.noise.start(zero), zero)

    def predict(self, memory: AugmentedMemory) -> tuple[Array, AugmentedMemory]:
        """Predict over a step; return the displacement by the estimated rate errors, m, ``(A, N)``, and the
        memory.
        """
        p, s = self.parameters, self.parameters.sampling
        P = ins_gnss.predict_augmented(memory.covariance, s, *p.variance_growth)
        displacement = s.step * memory.drift + s.drive * memory.coloured
        return displacement, memory._replace(coloured=s.decay * memory.coloured, covariance=P)

    def update(
        self, memory: AugmentedMemory, innovation: Array, reported: Array, available: Array
    ) -> tuple[Array, AugmentedMemory]:
        """Update with a measurement; return the correction of the position, m, ``(A, N)``, and the memory.

        Args:
            memory: memory after :meth:`predict`.
            innovation: measurement less predicted position, zero where there is none, m, ``(A, N)``.
            reported: variance that the receiver reports, m^2, ``(N,)``.
            available: one where there is a measurement, ``(N,)``.
        """
        xp = namespace(innovation)
        noise = select_nested(reported != memory.reported, self.noise.start(reported), memory.noise)
        size = xp.sqrt(ordered_sum(innovation * innovation) / innovation.shape[0])
        R, noise = self.noise.update(noise, size, memory.covariance.position, reported, available)
        K, P = ins_gnss.update_augmented(memory.covariance, R, available)
        # The innovation of the position is minus that of the INS error.
        return K.position * innovation, AugmentedMemory(
            memory.drift - K.drift * innovation,
            memory.coloured - K.coloured * innovation,
            P,
            reported,
            noise,
            R,
        )
