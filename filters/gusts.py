r"""First-order forming filter of the vertical gust: atmospheric turbulence as coloured noise.

The Dryden spectrum of the vertical gust is approximated by one pole,

    d(alpha_g)/dt = -(V / L) alpha_g + w,   intensity of w = 2 (V / L) sigma^2,   sigma = sigma_w / V,

whose stationary standard deviation is that of the Dryden model; alpha_g is the angle by which a gust of
vertical speed ``w_g`` turns the flow, ``w_g / V``. Exact Dryden turbulence needs a second pole and a zero
(MIL-F-8785C, 1980); the one pole keeps its variance and its correlation length.
"""

import math
from typing import NamedTuple


class FormingFilter(NamedTuple):
    """Bandwidth and intensities of a first-order filter that shapes white noise to the gust angle."""

    rate: float
    """Bandwidth V / L, 1/s."""
    sigma: float
    """Stationary standard deviation of the gust angle, degrees."""
    intensity: float
    """Intensity of the white noise at the input, degrees^2 / s."""


def vertical_gust(airspeed: float, length: float, sigma: float) -> FormingFilter:
    """Return bandwidth, deviation and noise intensity of the first-order vertical gust, an angle of attack in degrees.

    Args:
        airspeed: V, m/s.
        length: scale of turbulence L, m.
        sigma: standard deviation of the vertical gust speed, m/s.


    Raises:
        ValueError: if speed or length is not positive, or sigma is negative.
    """
    if not (airspeed > 0.0 and length > 0.0 and sigma >= 0.0):
        raise ValueError(
            "a gust needs a positive airspeed and length and a sigma of at least zero, got "
            f"{airspeed!r} m/s, {length!r} m, {sigma!r} m/s"
        )
    rate = airspeed / length
    angle = math.degrees(sigma / airspeed)
    return FormingFilter(rate, angle, 2.0 * rate * angle**2)
