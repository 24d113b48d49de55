r"""Singer's model: an exponentially correlated acceleration.

The state (position, velocity, acceleration) of one coordinate, in continuous time and over an interval T:

    da/dt = -alpha a + w,  E a^2 = sigma^2,  w white with spectral density 2 alpha sigma^2

    Phi = [[1, T, (alpha T - 1 + exp(-alpha T)) / alpha^2],
           [0, 1, (1 - exp(-alpha T)) / alpha],
           [0, 0, exp(-alpha T)]]
    Q   = 2 alpha sigma^2 int_0^T g(u) g(u)^T du,   g(u) = last column of Phi over the interval u

R. A. Singer, Estimating Optimal Tracking Filter Performance for Manned Maneuvering Targets, IEEE Trans. AES-6
(1970) 473-483. Phi is (1) of the paper by Ivanov and Seliverstov on radar and ESM.

Reading: that paper names its process noise without giving it; Q is Singer's exact one.

The closed forms subtract numbers that agree to (alpha T)^2 (Phi) and (alpha T)^5 (Q); below alpha T = 1 a
series and a quadrature take their place.
"""

import math

import numpy

_SERIES_TERMS = 18
"""Number of terms of the series: 1 / 20! is below the rounding of 1 / 2."""
_NODES, _WEIGHTS = numpy.polynomial.legendre.leggauss(16)
"""Quadrature points and weights, exact to rounding for the integrand of Q up to alpha T = 1."""


def _check(alpha: float, T: float) -> None:
    if not (math.isfinite(alpha) and alpha >= 0.0):
        raise ValueError(f"alpha must be a finite number of at least 0, got {alpha!r}")
    if not (math.isfinite(T) and T >= 0.0):
        raise ValueError(f"T must be a finite number of at least 0, got {T!r}")


def acceleration_response(alpha: float, T: float) -> numpy.ndarray:
    """Return the last column of Phi, ``(3,)``: the state a time T after a unit acceleration.

    Args:
        alpha: inverse correlation time of the acceleration, 1/s; 0 is a constant acceleration.
        T: interval, s.
    """
    _check(alpha, T)
    x = alpha * T
    if x < 1.0:
        # (x - 1 + exp(-x)) / x^2 = sum (-x)^n / (n + 2)!, by Horner.
        position = 0.0
        for n in reversed(range(_SERIES_TERMS)):
            position = 1.0 / math.factorial(n + 2) - x * position
    else:
        position = (x + math.expm1(-x)) / x**2
    velocity = -math.expm1(-x) / x if x > 0.0 else 1.0
    return numpy.array([T * T * position, T * velocity, math.exp(-x)])


def transition(alpha: float, T: float) -> numpy.ndarray:
    """Return the transition matrix Phi over an interval, ``(3, 3)``.

    Args:
        alpha: inverse correlation time of the acceleration, 1/s; 0 is a constant acceleration.
        T: interval, s.

    Raises:
        ValueError: if an argument is negative or not finite.
    """
    response = acceleration_response(alpha, T)
    Phi = numpy.array([[1.0, T, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]], dtype=response.dtype)
    Phi[:, 2] = response
    return Phi


def process_noise(alpha: float, sigma: float, T: float) -> numpy.ndarray:
    """Return the covariance Q of the process noise over an interval, ``(3, 3)``, symmetric.

    Args:
        alpha: inverse correlation time of the acceleration, 1/s.
        sigma: standard deviation of the acceleration, m/s^2.
        T: interval, s.

    Raises:
        ValueError: if an argument is negative or not finite.
    """
    _check(alpha, T)
    if not (math.isfinite(sigma) and sigma >= 0.0):
        raise ValueError(f"sigma must be a finite number of at least 0, got {sigma!r}")
    x = alpha * T
    if x < 1.0:
        times = 0.5 * T * (_NODES + 1.0)
        responses = numpy.stack([acceleration_response(alpha, u) for u in times], axis=1)
        return (alpha * sigma**2 * T) * numpy.einsum("in,jn,n->ij", responses, responses, _WEIGHTS)
    e, ee = math.exp(-x), math.exp(-2.0 * x)
    q = {
        (0, 0): (1.0 - ee + 2.0 * x + 2.0 * x**3 / 3.0 - 2.0 * x**2 - 4.0 * x * e) / alpha**4,
        (0, 1): (ee + 1.0 - 2.0 * e + 2.0 * x * e - 2.0 * x + x**2) / alpha**3,
        (0, 2): (1.0 - ee - 2.0 * x * e) / alpha**2,
        (1, 1): (4.0 * e - 3.0 - ee + 2.0 * x) / alpha**2,
        (1, 2): (ee + 1.0 - 2.0 * e) / alpha,
        (2, 2): 1.0 - ee,
    }
    return sigma**2 * numpy.array([[q[min(i, j), max(i, j)] for j in range(3)] for i in range(3)])


def acceleration_sigma(maximum: float, maximum_probability: float, zero_probability: float) -> float:
    """Return the standard deviation of the acceleration by Singer's rule, in the unit of ``maximum``.

    The acceleration is +-maximum with ``maximum_probability`` each, zero with ``zero_probability``, and
    uniform between otherwise: ``sigma^2 = maximum^2 (1 + 4 P_max - P_0) / 3``.

    Raises:
        ValueError: if a probability is negative or ``2 P_max + P_0`` exceeds 1.
    """
    p, p0 = maximum_probability, zero_probability
    if p < 0.0 or p0 < 0.0 or 2.0 * p + p0 > 1.0:
        raise ValueError(f"2 P_max + P_0 must be at most 1 and neither negative, got P_max {p!r}, P_0 {p0!r}")
    return maximum * math.sqrt((1.0 + 4.0 * p - p0) / 3.0)
