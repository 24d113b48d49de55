r"""Discretisation of a continuous model with white noise: transition matrix and process noise over an interval.

    dx/dt = A x + noise of spectral density D,   x(t + dt) = F x(t) + w,  w ~ N(0, Q)
    F = exp(A dt),   Q = integral from 0 to dt of exp(A s) D exp(A^T s) ds

C. F. Van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Automatic Control 23 (1978), 395-404.
He takes both from one exponential; here they are series with doubling, since dt is not known when a model is traced.
With E = F - I, which keeps its digits where an interval is short, and Q' = A Q + Q A^T + D for its coefficients,

    E(h) = sum A^k h^k / k!,   Q(h) = sum C_k h^k,  C_1 = D,  C_(k+1) = (A C_k + C_k A^T) / (k + 1),   h = dt / 2^s
    E(2h) = 2 E + E E,   Q(2h) = Q + F Q F^T = 2 Q + E Q + Q E^T + E Q E^T

Where drift is not linear: one or more steps of the classical Runge-Kutta method of order 4 for the mean, and for Q the
matrix A at the end of the interval, held, with three points of Gauss-Legendre (exact to the fifth power of s) and the
series of exp(A s) to the third power. Q is then a sum of semidefinite terms for any A.

Arrays are those of any namespace with the operator ``@``: NumPy's, or traced ones.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy

from .array_namespace import Array

SHORT = 0.5
"""Largest norm of A h up to which the series is used."""
TERMS = 14
"""Number of terms of the series: 0.5^15 / 15! is 2e-17."""
GAUSS_LEGENDRE = tuple(zip(*(part.tolist() for part in numpy.polynomial.legendre.leggauss(3)), strict=True))
"""Points of Gauss-Legendre quadrature on [-1, 1] and their weights."""


class Series(NamedTuple):
    """Number of terms of the series, and number of doublings of the interval."""

    terms: int
    doublings: int


def choose_series(A: numpy.ndarray, longest: float) -> Series:
    """Choose the terms and doublings of :func:`discretise`, exact to rounding for intervals up to ``longest``,
    s.
    """
    power = numpy.eye(len(A))
    for k in range(1, len(A) + 1):
        power = power @ A
        if not power.any():
            return Series(2 * k, 0)
    norm = float(numpy.abs(A).sum(axis=0).max())
    return Series(TERMS, max(0, math.ceil(math.log2(norm * longest / SHORT))))


def discretise(A: numpy.ndarray, D: numpy.ndarray, interval: Any, series: Series) -> tuple[Array, Array]:
    """Return the transition matrix minus the identity, and the process noise covariance, both over an
    interval.

    Args:
        A: matrix of the continuous model, ``(n, n)``, 1/s.
        D: spectral density of the noise, ``(n, n)``.
        interval: interval, s, a number.
        series: series from :func:`choose_series`.
    """
    h = interval / 2.0**series.doublings
    moved, noise, power = A, D, 1.0 * h
    E, Q = moved * h, noise * h
    for k in range(2, series.terms + 1):
        moved, noise, power = A @ moved / k, (A @ noise + noise @ A.T) / k, power * h
        E, Q = E + moved * power, Q + noise * power
    for _ in range(series.doublings):
        carried = E @ Q
        Q = 2.0 * Q + carried + carried.T + carried @ E.T
        Q = 0.5 * (Q + Q.T)  # or what rounding leaves between the two halves doubles, too
        E = 2.0 * E + E @ E
    return E, Q


def runge_kutta(drift: Callable[[Array], Array], x: Array, interval: Any, steps: int = 1) -> Array:
    """Return the state of a nonlinear model after an interval, ``(n,)``, by the Runge-Kutta method of order 4.

    Args:
        drift: function from the state to its derivative.
        x: state at the start, ``(n,)``.
        interval: interval, s.
        steps: number of steps of equal length.
    """
    h = interval / float(steps)
    for _ in range(steps):
        first = drift(x)
        second = drift(x + 0.5 * h * first)
        third = drift(x + 0.5 * h * second)
        last = drift(x + h * third)
        x = x + (h / 6.0) * (first + 2.0 * second + 2.0 * third + last)
    return x


def constant_matrix_noise(A: Array, D: numpy.ndarray, interval: Any) -> Array:
    """Return the process noise covariance ``(n, n)`` over an interval for a constant matrix A, by quadrature."""
    square = A @ A
    cube, total = square @ A, 0.0
    for point, weight in GAUSS_LEGENDRE:
        s = 0.5 * (1.0 + point) * interval
        F = numpy.eye(len(D)) + A * s + square * (0.5 * s * s) + cube * (s * s * s / 6.0)
        total = total + (0.5 * weight) * (F @ D @ F.T)
    return total * interval
