r"""Controllability and observability of the loop, and its measuring interval, in closed form: nothing is simulated.

    C = [B, F B, ..., F^(n-1) B],   O = [H; H F; ...; H F^(n-1)]       completely controllable, observable: rank n
    T = 1 / (2 dF)                                                     dF: spectral width of the controlled coordinate

Reading: the paper defines no spectral width; here it is the band that contains 99 % of the coordinate's variance in the
settled loop. It lists approximations of a coordinate in one interval without their errors; here these are

    constant   x(k+1) - x(k)
    linear     x(k+1) - x(k) - T x'(k)
    quadratic  x(k+1) - x(k) - T x'(k) - T^2/2 x''

with x'' the mean acceleration in the interval, ``(x'(k+1) - x'(k)) / T``.
"""

from typing import NamedTuple

import numpy

from ...envs.uav_autopilot.task import UavAutopilot
from ...filters import linear_systems
from .experiment import interval, matrices, theory_spectra

CONTAINED = 0.99
"""Share of the variance in the spectral width."""
FREQUENCIES = 1 << 12
"""Of the grid up to 1 / (2 T), on which the width is found."""


def controllability_matrix(F: numpy.ndarray, B: numpy.ndarray) -> numpy.ndarray:
    """Return ``[B, F B, ..., F^(n-1) B]``; of ``(F^T, H^T)`` it is the transposed observability matrix."""
    blocks = [B]
    for _ in range(len(F) - 1):
        blocks.append(F @ blocks[-1])
    return numpy.hstack(blocks)


def unreached_modes(F: numpy.ndarray, B: numpy.ndarray) -> numpy.ndarray:
    """Return the eigenvalues of F outside the subspace that the control reaches (uncontrollable modes)."""
    C = controllability_matrix(F, B)
    rest = numpy.linalg.svd(C)[0][:, numpy.linalg.matrix_rank(C) :]
    return numpy.linalg.eigvals(rest.T @ F @ rest)


def spectral_width(task: UavAutopilot) -> float:
    """Return the output's spectral width dF, Hz: the band with 99 % of its variance in the settled loop."""
    frequency = (numpy.arange(FREQUENCIES) + 0.5) / FREQUENCIES / (2.0 * interval(task))
    share = numpy.cumsum(theory_spectra(task, frequency)["output"])
    return float(frequency[numpy.argmax(share >= CONTAINED * share[-1])])


class Approximation(NamedTuple):
    """RMS errors of three approximations of the output in one interval, relative to its deviation."""

    constant: float
    linear: float
    quadratic: float


def approximation_errors(task: UavAutopilot) -> Approximation:
    """Return the errors of three approximations of the output in one interval, in the settled loop."""
    loop, T = _settled_loop(task), interval(task)
    X = linear_systems.stationary_covariance(*loop)
    coordinates = numpy.eye(len(X))
    x = coordinates[task.output]
    rate = coordinates[[c.name for c in task.components].index("rate")]

    def error(after: numpy.ndarray, before: numpy.ndarray) -> float:
        """Return the standard deviation of ``after s(k+1) - before s(k)``, relative to the output's."""
        carried = after @ loop.transition - before
        return float(numpy.sqrt((carried @ X @ carried + after @ loop.noise @ after) / (x @ X @ x)))

    return Approximation(error(x, x), error(x, x + T * rate), error(x - T / 2 * rate, x + T / 2 * rate))


def _settled_loop(task: UavAutopilot) -> linear_systems.ClosedLoop:
    return linear_systems.estimate_feedback_loop(*matrices(task))
