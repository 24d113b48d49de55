r"""Design of linear filters and regulators: discretisation, Riccati and Lyapunov equations, separation principle.

Plant, measurement and feedback of the paper by Gridnev, Rusetski and Rak (numbers in brackets are theirs):

    dx/dt = A x + B U + G W,   z = H x + v,   U = -L x                               (1)-(3)
    dP/dt = A P + P A^T - P H^T R^-1 H P + G Q G^T,   K = P H^T R^-1                 (4), (5)
    x(k+1) = F x(k) + B u(k) + w(k),   z(k) = H x(k) + v(k)                          (8), (9)
    P' = F P F^T + Q,   K = P' H^T (H P' H^T + R)^-1,   P = (I - K H) P'             (12)

Here ``Q`` of a discrete system is the covariance of ``w``, so it holds the paper's ``G Q G^T``.

Reading: (6) writes the estimator without a command; the command enters the prediction like the control.
Reading: the paper's ``+I Q`` in the first line of (12) is ``+ R``; with sampling interval T, ``R = R_c / T``.
Reading: the correcting term of (5) bounds P only when the model is detectable *and* noise reaches every
integrating or unstable mode; :func:`steady_kalman` refuses the rest, with the mode that is to blame.

One model at a time, in plain NumPy and SciPy.
"""

import math
from typing import Any, NamedTuple

import numpy
from numpy.typing import ArrayLike, NDArray

from .stored_solutions import use_stored_solution

Matrix = NDArray[numpy.float64]
_MARGIN = 1e-9
"""Distance from the limit of stability below which an eigenvalue counts as on it, since rounding moves it."""


def square_matrix(name: str, matrix: ArrayLike, size: int | None = None) -> Matrix:
    """Return a square matrix of finite numbers as an array, after a check; a number is a matrix of one row.

    Raises:
        ValueError: for anything else, or a size other than ``size``.
    """
    array = numpy.atleast_2d(numpy.asarray(matrix, float))
    size = len(array) if size is None else size
    if array.shape != (size, size) or not numpy.isfinite(array).all():
        raise ValueError(f"{name} must be a finite {size} x {size} matrix, got {matrix!r}")
    return array


def intensity_matrix(name: str, matrix: ArrayLike, size: int, definite: bool = False) -> Matrix:
    """Return an intensity or covariance matrix as an array, after a check that it is symmetric and semidefinite.

    Raises:
        ValueError: for anything else; with ``definite`` also for an eigenvalue of zero.
    """
    array = square_matrix(name, matrix, size)
    scale = max(float(numpy.abs(array).max()), numpy.finfo(float).tiny)
    lowest = float(numpy.linalg.eigvalsh(array)[0])
    asymmetric = numpy.abs(array - array.T).max() > 1e-9 * scale
    if asymmetric or lowest < -1e-9 * scale or (definite and lowest <= 0):
        kind = "definite" if definite else "semidefinite"
        raise ValueError(f"{name} must be symmetric positive {kind}, got {matrix!r}")
    return array


@use_stored_solution
def zero_order_hold(A: Matrix, B: Matrix, T: float) -> tuple[Matrix, Matrix]:
    """Return F and B of the discrete model of ``dx/dt = A x + B u``, with ``u`` constant in each interval.

    Args:
        A: matrix of the continuous model, ``(n, n)``, 1/s.
        B: its input matrix, ``(n, r)``.
        T: interval, s.

    Returns:
        ``F = exp(A T)`` and ``integral of exp(A s) B ds``, from one exponential of ``[[A, B], [0, 0]] T``.
    """
    from scipy.linalg import expm

    n, r = B.shape
    block = numpy.zeros((n + r, n + r))
    block[:n, :n] = A
    block[:n, n:] = B
    exponential = expm(block * T)
    return exponential[:n, :n], exponential[:n, n:]


@use_stored_solution
def van_loan(A: ArrayLike, intensity: ArrayLike, T: float) -> tuple[Matrix, Matrix]:
    """Return transition matrix F and process noise covariance Q of a continuous model over an interval.

    ``Q = integral over [0, T] of exp(A s) W exp(A^T s) ds`` from one exponential of
    ``[[-A, W], [0, A^T]] T``: Van Loan, IEEE Trans. Automatic Control 23 (1978) 395-404. A long interval is
    halved until ``|A| T`` is at most one, then doubled: ``Q(2 T) = F Q F^T + Q``, ``F(2 T) = F F``.

    Args:
        A: matrix of the continuous model, ``(n, n)``, 1/s.
        intensity: intensity of the white noise on the right-hand side, ``W = G Q G^T`` of (5), ``(n, n)``.
        T: interval, s.

    Returns:
        F and Q, both ``(n, n)``; Q is symmetric to the last bit.

    Raises:
        ValueError: for an interval that is not positive, a matrix of the wrong shape, or an indefinite intensity.
    """
    from scipy.linalg import expm

    A = square_matrix("A", A)
    n = len(A)
    intensity = intensity_matrix("intensity", intensity, n)
    if not (math.isfinite(T) and T > 0):
        raise ValueError(f"T must be a positive number of seconds, got {T!r}")
    halvings = max(0, math.ceil(math.log2(max(T * float(numpy.linalg.norm(A)), 0.5))))
    block = numpy.zeros((2 * n, 2 * n))
    block[:n, :n] = -A
    block[:n, n:] = intensity
    block[n:, n:] = A.T
    exponential = expm(block * (T / 2**halvings))
    F = exponential[n:, n:].T
    Q = F @ exponential[:n, n:]
    for _ in range(halvings):
        Q = F @ Q @ F.T + Q
        F = F @ F
    return F, 0.5 * (Q + Q.T)


def noise_factor(Q: Matrix, negligible: float = 1e-12) -> Matrix:
    """Return the lower triangular matrix C with ``C C^T = Q`` for a semidefinite covariance Q.

    A coordinate whose variance, given those before it, is below ``negligible`` of its own variance gets a
    column of zeros: noise that enters through an integrator is nearly collinear with its source, and the
    rest is rounding.

    Raises:
        ValueError: if Q has a negative direction beyond that.
    """
    n = len(Q)
    C = numpy.zeros((n, n))
    for j in range(n):
        pivot = Q[j, j] - C[j, :j] @ C[j, :j]
        if pivot < -1e-9 * abs(Q[j, j]) or Q[j, j] < 0.0:
            raise ValueError(f"a covariance must be positive semidefinite, got pivot {pivot:.3g} at {j}")
        if pivot > negligible * Q[j, j]:
            C[j, j] = numpy.sqrt(pivot)
            C[j + 1 :, j] = (Q[j + 1 :, j] - C[j + 1 :, :j] @ C[j, :j]) / C[j, j]
    if numpy.max(numpy.abs(C @ C.T - Q), initial=0.0) > 1e-9 * numpy.max(numpy.abs(Q), initial=0.0):
        raise ValueError(f"a covariance must be positive semidefinite, got {Q.tolist()}")
    return C


def spectral_radius(F: Matrix) -> float:
    """Return the largest modulus of the eigenvalues of F; a discrete system is stable below one."""
    return float(numpy.max(numpy.abs(numpy.linalg.eigvals(F))))


def unobservable_modes(F: Matrix, H: Matrix, continuous: bool = False) -> list[complex]:
    """Return the eigenvalues of modes that neither decay nor appear in the measurements.

    Popov-Belevitch-Hautus test: the rank of ``[F - lambda I; H]``. The pair is detectable when the list is
    empty; with ``(F^T, B^T)`` in place of ``(F, H)`` it is stabilisable.
    """
    modes = []
    for value in numpy.linalg.eigvals(F):
        growth = value.real if continuous else abs(value) - 1.0
        if growth > -_MARGIN:
            stacked = numpy.vstack([F - value * numpy.eye(len(F)), H])
            smallest = numpy.linalg.svd(stacked, compute_uv=False)[-1]
            # The square root of the rounding: double eigenvalues are known no better.
            if smallest < 1e-7 * max(1.0, float(numpy.linalg.norm(stacked, 2))):
                modes.append(complex(value))
    return modes


def _list(modes: list[complex]) -> str:
    texts = [f"{m.real:.6g}" if abs(m.imag) < 1e-9 else f"{m.real:.6g}{m.imag:+.6g}j" for m in modes]
    return ", ".join(dict.fromkeys(texts))


class SteadyFilter(NamedTuple):
    """Steady-state Kalman filter: gain, covariances and poles."""

    gain: Matrix
    """Kalman gain K, ``(n, m)``."""
    predicted: Matrix
    """Covariance before the update, ``(n, n)``; for a continuous filter equal to ``posterior``."""
    posterior: Matrix
    """Covariance after the update, ``(n, n)``."""
    poles: numpy.ndarray
    """Poles of the filter: eigenvalues of ``(I - K H) F`` or of ``A - K H``."""


def _check_filter(F: Matrix, H: Matrix, Q: Matrix, R: Matrix, continuous: bool) -> None:
    """Raise ValueError, with the reason, if the filter's Riccati equation has no stabilising solution."""
    if numpy.min(numpy.linalg.eigvalsh(R)) <= 0.0:
        raise ValueError(f"the measurement noise must be positive definite, got R = {R.tolist()}")
    hidden = unobservable_modes(F, H, continuous)
    if hidden:
        raise ValueError(
            f"the sensors cannot detect the state: the modes with eigenvalues {_list(hidden)} do not decay "
            "and appear in no measurement; add a sensor that sees them"
        )
    limit = 0.0 if continuous else 1.0
    quiet = [
        value
        for value in unobservable_modes(F.T, noise_factor(Q).T, continuous)
        if abs((value.real if continuous else abs(value)) - limit) < 1e-6
    ]
    if quiet:
        raise ValueError(
            f"no noise reaches the integrating modes with eigenvalues {_list(quiet)}: the Riccati equation "
            "has no stabilising solution and the gain on them decays to zero; give them some process noise, "
            "or let the gain vary with time"
        )


@use_stored_solution
def riccati_solution(kind: str, A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Any:
    """Return the stabilising solution of a discrete or continuous algebraic Riccati equation.

    Raises:
        ValueError: if it cannot be computed in float64.
    """
    from scipy import linalg

    try:
        return getattr(linalg, f"solve_{kind}_are")(A, B, Q, R)
    except numpy.linalg.LinAlgError as error:
        raise ValueError(
            "the numbers of the plant must be nearer to each other: the Riccati equation cannot be solved in "
            f"float64, with Q = {Q.tolist()} and R = {R.tolist()} ({error})"
        ) from error


def steady_kalman(F: Matrix, H: Matrix, Q: Matrix, R: Matrix) -> SteadyFilter:
    """Return the steady-state discrete Kalman filter (12), from the algebraic Riccati equation.

    Args:
        F: transition matrix, ``(n, n)``.
        H: measurement matrix, ``(m, n)``.
        Q: covariance of the process noise, ``(n, n)``.
        R: covariance of the measurement noise, ``(m, m)``.

    Raises:
        ValueError: if no stabilising solution exists, with the mode that prevents it.
    """
    _check_filter(F, H, Q, R, continuous=False)
    predicted = riccati_solution("discrete", F.T, H.T, Q, R)
    gain = numpy.linalg.solve(H @ predicted @ H.T + R, H @ predicted).T
    rest = numpy.eye(len(F)) - gain @ H
    posterior = rest @ predicted @ rest.T + gain @ R @ gain.T
    return SteadyFilter(gain, predicted, posterior, numpy.linalg.eigvals(rest @ F))


def steady_kalman_bucy(A: ArrayLike, H: ArrayLike, intensity: ArrayLike, R: ArrayLike) -> SteadyFilter:
    """Return the steady-state continuous Kalman filter (4), (5), from the algebraic Riccati equation.

    A random constant in the state has no steady state: its variance falls like 1/t.

    Args:
        A: matrix of the model, ``(n, n)``, 1/s.
        H: measurement matrix, ``(m, n)``.
        intensity: intensity of the process noise, ``G Q G^T``, ``(n, n)``.
        R: intensity of the measurement noise, ``(m, m)``.

    Raises:
        ValueError: if no stabilising solution exists, with the mode that prevents it.
    """
    A = square_matrix("A", A)
    H = numpy.atleast_2d(numpy.asarray(H, float))
    intensity, R = intensity_matrix("intensity", intensity, len(A)), square_matrix("R", R, len(H))
    _check_filter(A, H, intensity, R, continuous=True)
    P = riccati_solution("continuous", A.T, H.T, intensity, R)
    gain = numpy.linalg.solve(R, H @ P).T
    return SteadyFilter(gain, P, P, numpy.linalg.eigvals(A - gain @ H))


def _check_regulator(F: Matrix, B: Matrix, weight: Matrix, R: Matrix) -> None:
    if numpy.min(numpy.linalg.eigvalsh(R)) <= 0.0:
        raise ValueError(f"the weight of the control must be positive definite, got {R.tolist()}")
    fixed = unobservable_modes(F.T, B.T)
    if fixed:
        raise ValueError(
            f"the control cannot stabilise the plant: the modes with eigenvalues {_list(fixed)} do not decay "
            "and the control does not reach them"
        )
    ignored = [
        value for value in unobservable_modes(F, noise_factor(weight).T) if abs(abs(value) - 1.0) < 1e-6
    ]
    if ignored:
        raise ValueError(
            f"the weights ignore the integrating modes with eigenvalues {_list(ignored)}: the Riccati "
            "equation has no stabilising solution; give their coordinates a weight"
        )


class Regulator(NamedTuple):
    """Gain of a linear-quadratic regulator, and the cost of deviations from its control."""

    feedback: Matrix
    """Gain L of ``u = -L x``, ``(r, n)``."""
    regret: Matrix
    """``R + B^T S B``, ``(r, r)``: a control that differs by d from the optimal one costs ``d^T (R + B^T S B) d`` more
    in all, by completing the square in Bellman's equation with the value ``x^T S x``.
    """


def discrete_regulator(F: Matrix, B: Matrix, weight: Matrix, control_weight: Matrix) -> Regulator:
    """Return the regulator that minimises the sum of ``x^T W x + u^T R u`` (discrete LQR).

    Args:
        F: transition matrix, ``(n, n)``.
        B: input matrix, ``(n, r)``.
        weight: W, weight of the state, ``(n, n)``.
        control_weight: R, weight of the control, ``(r, r)``.

    Raises:
        ValueError: if no stabilising solution exists, with the reason.
    """
    _check_regulator(F, B, weight, control_weight)
    S = riccati_solution("discrete", F, B, weight, control_weight)
    regret = control_weight + B.T @ S @ B
    return Regulator(numpy.linalg.solve(regret, B.T @ S @ F), regret)


def check_stable(F: Matrix) -> None:
    """Raise ValueError if ``x(k+1) = F x(k)`` is not asymptotically stable."""
    radius = spectral_radius(F)
    if radius >= 1.0:
        raise ValueError(f"only a stable loop has stationary variances, got spectral radius {radius:.6g}")


def stationary_covariance(F: Matrix, Q: Matrix) -> Matrix:
    """Return the stationary covariance X of ``x(k+1) = F x(k) + w(k)``, from ``X = F X F^T + Q``.

    Raises:
        ValueError: if F is not asymptotically stable.
    """
    from scipy.linalg import solve_discrete_lyapunov

    check_stable(F)
    X = solve_discrete_lyapunov(F, Q)
    return 0.5 * (X + X.T)


def feedforward_gain(F: Matrix, B: Matrix, output: Matrix, L: Matrix) -> float:
    """Return the gain N of ``u = N r - L x`` for a static gain of one from the command r to ``output x``.

    Args:
        F: transition matrix, ``(n, n)``.
        B: input matrix, ``(n, 1)``.
        output: row of the output matrix, ``(n,)``.
        L: feedback gain, ``(1, n)``.

    Raises:
        ValueError: if a constant command has no effect on the output.
    """
    static = output @ numpy.linalg.solve(numpy.eye(len(F)) - F + B @ L, B[:, 0])
    if abs(static) < 1e-12:
        raise ValueError("the static gain from the command to the output is zero: it cannot be made one")
    return float(1.0 / static)


class ClosedLoop(NamedTuple):
    """Linear recursion ``s(k+1) = transition s(k) + noise`` of a closed control loop."""

    transition: Matrix
    noise: Matrix
    """Covariance of the noise."""


def estimate_feedback_loop(
    F: Matrix, B: Matrix, H: Matrix, L: Matrix, K: Matrix, Q: Matrix, R: Matrix
) -> ClosedLoop:
    """Return the loop closed over a filter, ``u = -L x(k|k)``, in state and error ``e = x - x(k|k)``.

    ``[x; e](k+1) = [[F - B L, B L], [0, (I - K H) F]] [x; e](k) + [[I, 0], [I - K H, -K]] [w; v]``. The zero
    block is the separation principle: the poles are those of ``F - B L`` and those of ``(I - K H) F``.

    Args:
        F: transition matrix, ``(n, n)``.
        B: input matrix, ``(n, r)``.
        H: measurement matrix, ``(m, n)``.
        L: feedback gain, ``(r, n)``.
        K: any constant filter gain, ``(n, m)``.
        Q: covariance of w, ``(n, n)``.
        R: covariance of v, ``(m, m)``.
    """
    n, m = K.shape
    rest = numpy.eye(n) - K @ H
    transition = numpy.block([[F - B @ L, B @ L], [numpy.zeros((n, n)), rest @ F]])
    entry = numpy.block([[numpy.eye(n), numpy.zeros((n, m))], [rest, -K]])
    return ClosedLoop(transition, entry @ _diagonal(Q, R) @ entry.T)


def measurement_feedback_loop(F: Matrix, B: Matrix, H: Matrix, L: Matrix, Q: Matrix, R: Matrix) -> ClosedLoop:
    """Return the loop closed over raw measurements, ``u = -L H^+ z``, in coordinates of the state.

    A coordinate that no sensor measures is fed back as zero. The state holds the plant only: the noise of
    the measurement enters through the control.
    """
    feedback = B @ L @ numpy.linalg.pinv(H)
    return ClosedLoop(F - feedback @ H, Q + feedback @ R @ feedback.T)


def separation_defect(F: Matrix, B: Matrix, H: Matrix, L: Matrix, K: Matrix) -> float:
    """Return the largest distance between closed-loop poles and those of the separate regulator and filter
    designs.

    The loop is written in state and *estimate*; its poles are matched one to one with those of
    ``eig(F - B L)`` and ``eig((I - K H) F)``: rounding, if the principle holds.
    """
    from scipy.optimize import linear_sum_assignment

    n = len(F)
    rest = numpy.eye(n) - K @ H
    # x' = F x - B L y;  y' = rest (F - B L) y + K H (F x - B L y), y the estimate after the update.
    loop = numpy.block([[F, -B @ L], [K @ H @ F, rest @ F - B @ L]])
    separate = numpy.concatenate([numpy.linalg.eigvals(F - B @ L), numpy.linalg.eigvals(rest @ F)])
    distance = numpy.abs(numpy.linalg.eigvals(loop)[:, None] - separate[None])
    return float(distance[linear_sum_assignment(distance)].max())


def _diagonal(Q: Matrix, R: Matrix) -> Matrix:
    n, m = len(Q), len(R)
    return numpy.block([[Q, numpy.zeros((n, m))], [numpy.zeros((m, n)), R]])
