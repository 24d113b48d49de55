r"""Known inputs of a state-space model: a current, a commanded thrust, the rates of a gyroscope.

A simulation draws each as a Gauss-Markov process around its mean (Gelb, Applied Optimal Estimation (1974), section
3.6),

    u(k) = mean + a (u(k-1) - mean) + deviation sqrt(1 - a^2) n(k),  a = exp(-dt / correlation_time),  n(k) ~ N(0, 1)

and filters receive ``u(k) + noise e(k)``, e(k) ~ N(0, 1).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from types import ModuleType

from ..contract.observation import Array


@dataclass(frozen=True)
class Input:
    """Known input of a state-space model: its Gauss-Markov process in a simulation, and its reported noise.

    Raises:
        ValueError: for a number that is not finite or out of range.
    """

    mean: float = 0.0
    """Mean, in the unit of the input, as are deviation and noise."""
    deviation: float = 1.0
    """Standard deviation of the input around its mean."""
    correlation_time: float = 10.0
    """Correlation time of the process, s."""
    noise: float = 0.0
    """Standard deviation of the reported input around the one that acts, independent at every measurement."""
    unit: str = "1"
    """Unit of the mean, in tables and pages."""

    def __post_init__(self) -> None:
        for field in fields(self)[:-1]:
            value = getattr(self, field.name)
            least = "above 0" if field.name == "correlation_time" else "at least 0"
            wrong = value <= 0.0 if field.name == "correlation_time" else value < 0.0
            if not math.isfinite(value) or (wrong and field.name != "mean"):
                raise ValueError(f"{field.name} of an input must be finite, {least}, got {value!r}")


class InputProcesses:
    """Gauss-Markov processes of the p inputs of a simulation.

    Attributes:
        initial_normals: number of standard normal numbers at the start, p.
        normals: number of them at each measurement, p for the processes and one for each input with noise.
    """

    def __init__(self, inputs: Sequence[Input], xp: ModuleType) -> None:
        self.inputs: tuple[Input, ...] = tuple(inputs)
        self.xp = xp
        self.noisy: list[int] = [j for j, one in enumerate(inputs) if one.noise > 0.0]
        self.initial_normals: int = len(inputs)
        self.normals: int = len(inputs) + len(self.noisy)

    def begin(self, normals: Array) -> Array | None:
        """Return the initial inputs, ``(p, N)``, drawn from their stationary distribution; None if p is 0."""
        if not self.inputs:
            return None
        each = zip(self.inputs, normals, strict=True)
        return self.xp.stack([one.mean + one.deviation * number for one, number in each])

    def advance(self, inputs: Array, interval: Array, normals: Array) -> Array:
        """Return the inputs that act until the next measurement, ``(p, N)``.

        ``inputs`` are those until the previous measurement, ``interval`` is in s, ``normals`` are ``(normals, N)``.
        """
        xp, after = self.xp, []
        for j, one in enumerate(self.inputs):
            kept = xp.exp(-interval / one.correlation_time)
            fresh = one.deviation * xp.sqrt(1.0 - kept * kept)
            after.append(one.mean + kept * (inputs[j] - one.mean) + fresh * normals[j])
        return xp.stack(after)

    def report(self, inputs: Array, normals: Array) -> Array:
        """Return the inputs with noise, as filters receive them, ``(p, N)``."""
        reported = [inputs[j] for j in range(len(self.inputs))]
        for place, j in enumerate(self.noisy):
            reported[j] = reported[j] + self.inputs[j].noise * normals[len(reported) + place]
        return self.xp.stack(reported)
