"""Models in continuous time: a drift and a diffusion become the motion and the process noise of an interval."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy

from .compiler import namespace
from .compiler.vector_functions import VectorFunction
from .filters.discretisation import choose_series, constant_matrix_noise, discretise, runge_kutta

LONGEST = 1e4
"""Sampling intervals over which linear models are exact to rounding."""


class Discretised(NamedTuple):
    """A discrete-time model for any interval: motion and covariance of the process noise."""

    motion: Callable[[Any, Any, Any], Any]
    """State ``(n,)`` after the interval, from state, interval and inputs ``(p,)``."""
    noise: Callable[[Any, Any, Any], Any]
    """Covariance of the process noise ``(n, n)``, from the predicted state, interval and inputs."""


def discretise_drift(
    drift: VectorFunction, diffusion: numpy.ndarray, interval: float, steps: int
) -> Discretised:
    """Return the discrete-time model of a drift and a diffusion, see :mod:`.filters.discretisation`.

    Args:
        drift: function from state and inputs, ``(n + p,)``, to the derivative of the state, ``(n,)``.
        diffusion: spectral density of the noise, ``(n, n)``.
        interval: typical time between measurements, s.
        steps: number of steps of the Runge-Kutta method in an interval.
    """
    n = drift.size
    if drift.matrix is None:

        def slope(x: Any, u: Any) -> Any:
            return drift.value(namespace.concat([x, u])[:, None], namespace)[:, 0]

        def held(x: Any, dt: Any, u: Any) -> Any:
            A = drift.jacobian(namespace.concat([x, u])[:, None], namespace)[:, :n, 0]
            return constant_matrix_noise(A, diffusion, dt)

        return Discretised(lambda x, dt, u: runge_kutta(lambda y: slope(y, u), x, dt, steps), held)
    A = drift.matrix[:, :n]
    # Inputs and constants are states without a drift, the last of them 1.
    whole = numpy.zeros((drift.matrix.shape[1] + 1,) * 2)
    whole[:n, :-1], whole[:n, -1] = drift.matrix, drift.offset
    still = numpy.zeros_like(whole)
    series = choose_series(whole, LONGEST * interval), choose_series(A, LONGEST * interval)

    def motion(x: Any, dt: Any, u: Any) -> Any:
        E = discretise(whole, still, dt, series[0])[0][:n]
        moved = x + E[:, :n] @ x + E[:, -1]
        return moved + E[:, n:-1] @ u if len(whole) > n + 1 else moved

    return Discretised(motion, lambda x, dt, u: discretise(A, diffusion, dt, series[1])[1])
