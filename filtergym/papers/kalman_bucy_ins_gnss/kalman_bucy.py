r"""The continuous Kalman-Bucy filter: its Riccati equation, its moments, and its sampled counterpart.

    process      dX/dt = A X + U + B xi,    Z = C X + H zeta                                (1), (2)
    filter       dXh/dt = A Xh + U + K (Z - C Xh)                                               (3)
    gain         K = R C^T Q^-1,    Q = H N H^T                                                 (4)
    covariance   dR/dt = A R + R A^T - R C^T Q^-1 C R + B G B^T,    R(0) = R0                   (5)
    moments      dm/dt = A m + U,    dT/dt = A T + T A^T + B G B^T                              (6)

Numbers in brackets are those of the paper by Benkafo and Lobaty. ``G`` and ``N`` are intensities of white
noises, so a measurement averaged over one step has the variance ``Rd = Q / step``. The filter follows the
random process X and not the reference motion m: ``M[(X - Xh)(Xh - m)^T] = 0``, hence
``Var(Xh - m) = T - R``.

Reading: (3) is printed without U, which would bias the estimate by ``-U / (K - A)``; U is added.
Reading: (4) is damaged; ``Q^-1`` is the only exponent that makes (5) the Riccati equation.
Reading: the paper refers to an equation (7) that does not exist; (6) is meant.

:func:`~filtergym.filters.linear_systems.steady_kalman_bucy` computes the steady state of (5). A random
constant has no steady filter: its variance falls for ever, like 1/t, and its gain goes to zero; use the
time-varying (5).

These functions use NumPy and SciPy for one model, without a batch axis.
"""

from typing import NamedTuple

import numpy
from numpy.typing import ArrayLike

from ...filters.linear_systems import Matrix, intensity_matrix, square_matrix, van_loan


def _times(times: ArrayLike) -> Matrix:
    """Return times as an array; raise ValueError unless they are not negative and ascend."""
    array = numpy.atleast_1d(numpy.asarray(times, float))
    if (
        array.ndim != 1
        or not numpy.isfinite(array).all()
        or (array < 0).any()
        or (numpy.diff(array) < 0).any()
    ):
        raise ValueError(f"times must be in ascending order from zero on, in seconds, got {times!r}")
    return array


def _information(C: ArrayLike, Q: ArrayLike, size: int) -> Matrix:
    """Return ``C^T Q^-1 C``, the information of a measurement in one second."""
    rows = numpy.atleast_2d(numpy.asarray(C, float))
    if rows.ndim != 2 or rows.shape[1] != size:
        raise ValueError(f"C must have {size} columns, got {C!r}")
    weighted = numpy.linalg.solve(intensity_matrix("Q", Q, len(rows), definite=True), rows)
    return numpy.asarray(rows.T @ weighted, float)


def riccati_scalar(a: float, w: float, s: float, R0: float, times: ArrayLike) -> Matrix:
    """Return the solution of the Riccati equation (5) of a scalar model, in closed form.

    With ``gamma = sqrt(a^2 + w s)`` and ``u = tanh(gamma t) / gamma`` (``t`` where gamma is zero),
    ``R = (R0 (1 + a u) + w u) / (1 + (s R0 - a) u)``. It equals the usual form
    ``(r+ - r- rho) / (1 - rho)``, ``r+- = (a +- gamma) / s``, and stays defined where gamma or s is zero.

    Args:
        a: coefficient A, 1/s.
        w: intensity ``b^2 G``, unit^2/s.
        s: information rate ``c^2 / Q``, 1/(unit^2 s).
        R0: variance at time zero, unit^2.
        times: instants, s, ``(k,)``.

    Returns:
        Variances, ``(k,)``, unit^2.

    Raises:
        ValueError: a negative intensity, information rate or variance; instants not in ascending order.
    """
    for name, value in (("w", w), ("s", s), ("R0", R0)):
        if not value >= 0:
            raise ValueError(f"{name} must not be negative, got {value!r}")
    t = _times(times)
    gamma = numpy.sqrt(a * a + w * s)
    u = numpy.tanh(gamma * t) / gamma if gamma > 0 else t
    return (R0 * (1 + a * u) + w * u) / (1 + (s * R0 - a) * u)


LONGEST_TIME = 0.5
"""s, after which the solution by the Hamiltonian matrix is restarted."""


def riccati_hamiltonian(
    A: ArrayLike,
    BGBt: ArrayLike,
    C: ArrayLike,
    Q: ArrayLike,
    R0: ArrayLike,
    times: ArrayLike,
) -> Matrix:
    """Return the solution of the Riccati equation (5) by the exponential of the Hamiltonian matrix.

    ``d/dt [P1; P2] = [[-A^T, C^T Q^-1 C], [BGB^T, A]] [P1; P2]``, ``P1(0) = I``, ``P2(0) = R0``,
    ``R = P2 P1^-1``. P1 grows without limit and its columns become parallel, so the solution is restarted.

    Args:
        A: ``(n, n)``, 1/s.
        BGBt: intensity of the process noise, ``(n, n)``.
        C: measurement matrix, ``(m, n)``.
        Q: intensity of the measurement noise, ``(m, m)``.
        R0: covariance at time zero, ``(n, n)``.
        times: instants in ascending order, s, ``(k,)``.

    Returns:
        Covariances, ``(k, n, n)``.

    Raises:
        ValueError: an indefinite intensity, a singular ``Q``, instants not in ascending order.
    """
    from scipy.linalg import expm

    A = square_matrix("A", A)
    n = len(A)
    information = _information(C, Q, n)
    hamiltonian = numpy.block([[-A.T, information], [intensity_matrix("BGBt", BGBt, n), A]])
    R = intensity_matrix("R0", R0, n)
    covariances = []
    for duration in numpy.diff(_times(times), prepend=0.0):
        pieces = int(numpy.ceil(duration / LONGEST_TIME))
        if pieces:
            exponential = expm(hamiltonian * (duration / pieces))
        for _ in range(pieces):
            P1 = exponential[:n, :n] + exponential[:n, n:] @ R
            P2 = exponential[n:, :n] + exponential[n:, n:] @ R
            R = numpy.linalg.solve(P1.T, P2.T)
            R = (R + R.T) / 2
        covariances.append(R)
    return numpy.stack(covariances)


def riccati_ode(
    A: ArrayLike, BGBt: ArrayLike, C: ArrayLike, Q: ArrayLike, R0: ArrayLike, times: ArrayLike
) -> Matrix:
    """Return the solution of the Riccati equation (5) by Runge-Kutta steps of order 8, to 1e-11.

    Arguments, result and errors as in :func:`riccati_hamiltonian`.
    """
    A = square_matrix("A", A)
    n = len(A)
    information, BGBt = _information(C, Q, n), intensity_matrix("BGBt", BGBt, n)
    R0, instants = intensity_matrix("R0", R0, n), _times(times)

    def slope(_: float, flat: Matrix) -> Matrix:
        R = flat.reshape(n, n)
        return (A @ R + R @ A.T - R @ information @ R + BGBt).ravel()

    if instants[-1] == 0:
        return numpy.stack([R0] * len(instants))
    from scipy.integrate import solve_ivp

    solution = solve_ivp(
        slope, (0.0, instants[-1]), R0.ravel(), method="DOP853", t_eval=instants, rtol=1e-11, atol=1e-13
    )
    if not solution.success:
        raise ArithmeticError(f"the Riccati equation could not be integrated: {solution.message}")
    return solution.y.T.reshape(-1, n, n)


class Moments(NamedTuple):
    """Mean and covariance of a random process at given instants."""

    mean: Matrix
    """Mean at each instant, ``(k, n)``."""
    covariance: Matrix
    """Covariance at each instant, ``(k, n, n)``."""


def moments(
    A: ArrayLike, U: ArrayLike, BGBt: ArrayLike, m0: ArrayLike, Theta0: ArrayLike, times: ArrayLike
) -> Moments:
    """Return mean and covariance of a linear process by equations (6), exact for constant coefficients and input.

    Args:
        A: ``(n, n)``, 1/s.
        U: constant input, ``(n,)``.
        BGBt: intensity of the process noise, ``(n, n)``.
        m0: mean at time zero, ``(n,)``.
        Theta0: covariance at time zero, ``(n, n)``.
        times: instants in ascending order, s, ``(k,)``.

    Raises:
        ValueError: a wrong shape, an indefinite intensity, instants not in ascending order.
    """
    from scipy.linalg import expm

    A = square_matrix("A", A)
    n = len(A)
    BGBt, covariance = intensity_matrix("BGBt", BGBt, n), intensity_matrix("Theta0", Theta0, n)
    mean = numpy.broadcast_to(numpy.asarray(m0, float), (n,))
    held = numpy.zeros((n + 1, n + 1))
    held[:n, :n], held[:n, n] = A, numpy.broadcast_to(numpy.asarray(U, float), (n,))
    means, covariances = [], []
    for duration in numpy.diff(_times(times), prepend=0.0):
        if duration > 0:
            Phi, Qd = van_loan(A, BGBt, duration)
            mean = Phi @ mean + expm(duration * held)[:n, n]
            covariance = Phi @ covariance @ Phi.T + Qd
        means.append(mean)
        covariances.append(covariance)
    return Moments(numpy.stack(means), numpy.stack(covariances))


class SampledCovariance(NamedTuple):
    """Error covariances and gains of a sampled filter, measurement by measurement."""

    predicted: Matrix
    """Covariance before each measurement, ``(steps, n, n)``."""
    updated: Matrix
    """Covariance after each measurement, ``(steps, n, n)``."""
    gain: Matrix
    """Gain of each measurement, ``(steps, n, m)``; the counterpart of ``K step``."""


def sampled_covariance(
    A: ArrayLike,
    BGBt: ArrayLike,
    C: ArrayLike,
    Q: ArrayLike,
    R0: ArrayLike,
    step: float,
    duration: float,
    gain: ArrayLike | None = None,
) -> SampledCovariance:
    """Return the exact error covariances of the filter that samples every ``step`` seconds.

    The measurement of one step has the variance ``Q / step``. The optimal sampled filter agrees with (5) at
    first order only, ``updated = R (1 - K step / 2)`` and ``predicted = R (1 + K step / 2)`` (scalar C = 1);
    their geometric mean agrees at second order.

    Args:
        A: ``(n, n)``, 1/s.
        BGBt: intensity of the process noise, ``(n, n)``.
        C: measurement matrix, ``(m, n)``.
        Q: intensity of the measurement noise, ``(m, m)``.
        R0: covariance at time zero, ``(n, n)``.
        step: sampling interval, s.
        duration: time of the last measurement, s.
        gain: fixed gain ``(n, m)`` in place of the optimal one; the covariance is that of this filter.

    Raises:
        ValueError: a step longer than the duration, an indefinite intensity, a wrong shape.
    """
    Phi, Qd = van_loan(A, BGBt, step)
    n = len(Phi)
    if not step <= duration:
        raise ValueError(f"step must be at most the duration of {duration!r} s, got {step!r}")
    rows = numpy.atleast_2d(numpy.asarray(C, float))
    _information(rows, Q, n)
    Rd = numpy.atleast_2d(numpy.asarray(Q, float)) / step
    P = intensity_matrix("R0", R0, n)
    fixed = None if gain is None else numpy.asarray(gain, float).reshape(n, len(rows))
    predicted, updated, gains = [], [], []
    for _ in range(round(duration / step)):
        P = Phi @ P @ Phi.T + Qd
        predicted.append(P)
        K = numpy.linalg.solve(rows @ P @ rows.T + Rd, rows @ P).T if fixed is None else fixed
        rest = numpy.eye(n) - K @ rows
        P = rest @ P @ rest.T + K @ Rd @ K.T
        updated.append(P)
        gains.append(K)
    return SampledCovariance(numpy.stack(predicted), numpy.stack(updated), numpy.stack(gains))
