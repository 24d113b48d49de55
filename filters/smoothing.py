r"""Smoothing: estimates with later measurements, computed backward from the stored steps of a filter.

**One model.** Rauch, Tung and Striebel, AIAA Journal 3 (1965), 1445-1450; Särkkä, Bayesian Filtering and Smoothing
(2013), theorem 8.2, equations (8.6). With x, P after the update at a scan, x' = F x + b and P' = F P F^T + Q before
that of the next one,

    G = P F^T P'^-1,  x^s = x + G (x^s_next - x'),  P^s = P + G (P^s_next - P') G^T

The covariance is computed as ``(I - G F) P (I - G F)^T + G (P^s_next + Q) G^T``, the same sum of what cannot
become negative. Where P' is singular (no process noise, a component that is known) any solution of
``P' G^T = F P`` gives the same result; the one of the Cholesky factor without its zero columns is taken.

**Several models.** Two filters, one forward and one backward in time, as Helmick, Blair and Hoffman, Fixed-interval
smoothing for Markovian switching systems, IEEE Trans. Information Theory 41 (1995), 1845-1855. The backward one
carries for every mode the likelihood of all later measurements as a function of the state,

    L_i(x) = p(z_next, z_next+1, ... | x, mode i) = sum_j p_ij B_j(x)
    B_j(x) = integral of N(x_next; F_j x + b_j, Q_j) p(z_next | x_next) L_j,next(x_next)

each L_j the exponential of a quadratic form, so that B_j is another one, exactly. With the forward filter's N(x_i, P_i)
and mu_i the smoothed estimate is the mixture of all N(x_i, P_i) B_j with the weights ``mu_i p_ij integral N B_j``: it
needs no further approximation.

Approximations: the forward filter is an IMM, and the sum of B_j is replaced by one quadratic form. Reading:
that one gives the same mean and covariance as the sum where it meets the filtered N(x_i, P_i). Where the sum
would leave an estimate less certain than the filter's, in some direction, later measurements add nothing.
Rauch-Tung-Striebel recursions mode by mode (Kim, Journal of Econometrics 60, 1994; Nadarajah, Tharmarasa,
McDonald and Kirubarajan, IEEE Trans. AES 48, 2012, 2673-2678) are shorter, but correct a mode without noise
by a smoothed state that it could never have reached.

**A fixed lag** is the same recursion begun anew L scans after each: all scans take one step together, L times over.

Shapes: a time axis of K scans stands before the batch, ``(n, K, N)``. A scan that missed the target is prediction only.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy

from . import imm
from .array_namespace import Array, namespace
from .ordered_sums import ordered_sum
from .scans import Step, Track, backward, repeat, take_scans
from .small_matrices import apply, product, transpose


class Gaussian(NamedTuple):
    """Mean and covariance of a Gaussian distribution."""

    mean: Array
    """Mean, ``(n, ...)``."""
    covariance: Array
    """Covariance, ``(n, n, ...)``."""


class Motion(NamedTuple):
    """Linearised motion of the state from one scan to the next."""

    F: Array
    """Transition matrix or Jacobian at the estimate, ``(n, n, ...)``."""
    Q: Array
    """Covariance of the process noise, ``(n, n, ...)``."""
    predicted: Array
    """Predicted mean at the next scan, ``(n, ...)``."""


# --- one model


def rauch_tung_striebel_step(filtered: Gaussian, motion: Motion, later: Gaussian) -> Gaussian:
    """Return the smoothed estimate of one scan from its filtered estimate and the next scan's smoothed one.

    Args:
        filtered: estimate after the update at this scan, ``(n, N)`` and ``(n, n, N)``.
        motion: motion from this scan to the next.
        later: smoothed estimate at the next scan; the filtered one there smooths with one more measurement.
    """
    F, Q = motion.F, motion.Q
    FP = product(F, filtered.covariance)
    gain = transpose(_solve(semidefinite_root(product(FP, transpose(F)) + Q), FP))
    rest = _identity(filtered.mean) - product(gain, F)
    return Gaussian(
        filtered.mean + apply(gain, later.mean - motion.predicted),
        _symmetrize(_congruence(rest, filtered.covariance) + _congruence(gain, later.covariance + Q)),
    )


def smooth(
    filtered: Gaussian, motion: Motion | Callable[[slice], Motion], lag: int | None = None
) -> Gaussian:
    """Return the smoothed estimates of a track, from those of a Kalman or extended Kalman filter.

    Args:
        filtered: estimates after the update at each of K scans, ``(n, K, N)`` and ``(n, n, K, N)``.
        motion: motion from each of the first K - 1 scans to the next, ``(n, n, K - 1, N)`` and ``(n, K - 1, N)``; or a
            function that returns that of a slice of scans, to save memory.
        lag: number of later scans that each estimate uses, fewer at the end of the track; default: all. Zero gives the
            filter's estimates.

    Raises:
        ValueError: for a negative lag.
    """
    smoothed: Gaussian = backward(
        rauch_tung_striebel_step, _track(filtered, motion), functools.partial(take_scans, filtered), lag
    )
    return smoothed


def _track(filtered: Any, motion: Any) -> Track:
    """Return the input of a backward recursion: filtered estimates and the motion of all scans or by slice."""
    K, N = filtered.mean.shape[-2:]
    whole = None if callable(motion) else repeat(motion, (K - 1, N))

    def given(scans: slice) -> tuple[Any, Any]:
        if whole is not None:
            return take_scans(filtered, scans), take_scans(whole, scans)
        return take_scans(filtered, scans), repeat(motion(scans), (scans.stop - scans.start, N))

    return Track(K - 1, N, given)


# --- several models


class GaussianMixture(NamedTuple):
    """Estimates and probabilities of M modes."""

    mean: Array
    """Means, ``(n, M, ...)``."""
    covariance: Array
    """Covariances, ``(n, n, M, ...)``."""
    probabilities: Array
    """Mode probabilities, ``(M, ...)``."""


class Arrival(NamedTuple):
    """Motion of M models from one scan to the next, and the measurement there."""

    motion: Motion
    """Motion of each model, ``(n, n, M, ...)`` and ``(n, M, ...)``, predicted from its mixed mean as in the IMM."""
    H: Array
    """Measurement matrix, ``(m, n, ...)``."""
    precision: Array
    """Inverse covariance of the measurement noise, ``(m, m, ...)``; zero without a measurement."""
    position: Array
    """Measurement, ``(m, ...)``; any finite number without one."""


class QuadraticLikelihood(NamedTuple):
    """Log-likelihood as a quadratic form, ``value + gradient^T d - d^T curvature d / 2`` with ``d = x - centre``."""

    centre: Array
    """Centre of the expansion, ``(n, ...)``."""
    value: Array
    """Log-likelihood at the centre, ``(...)``."""
    gradient: Array
    """Gradient at the centre, ``(n, ...)``."""
    curvature: Array
    """Negative second derivative, positive semidefinite, ``(n, n, ...)``."""


class SmoothedBank(NamedTuple):
    """Smoothed estimates of all modes at a scan, and the likelihood of all later measurements."""

    bank: GaussianMixture
    later: QuadraticLikelihood
    """Likelihood of the later measurements given each mode, about the filtered mean."""


def imm_step(
    filtered: GaussianMixture, arrival: Arrival, next_scan: SmoothedBank, transition: Array
) -> SmoothedBank:
    """Return one scan's smoothed IMM estimates from its filtered ones and the next scan's smoothed ones.

    Args:
        filtered: estimates after the update at this scan.
        arrival: motion to the next scan, and measurement there.
        next_scan: smoothed estimates at the next scan.
        transition: transition matrix of the modes, row = from, column = to, ``(M, M)``.
    """
    xp = namespace(filtered.mean)
    prediction = imm.predict_mode_probabilities(transition, filtered.probabilities)
    mixed, _ = imm.mix(filtered.mean, filtered.covariance, prediction.mixing)
    seen_from_here = _pull_back(_add_measurement(next_scan.later, arrival), arrival.motion, mixed)
    # Pairs [j, i]: mode i at this scan, then mode j. Errors are counted in standard deviations of the filter,
    # x = mean + root e with e ~ N(0, I), in which nothing needs an inverse of the covariance.
    root = semidefinite_root(filtered.covariance)
    pairs = QuadraticLikelihood(*(_insert_axis(part, -2) for part in seen_from_here))
    pairs = _expand_about(pairs, filtered.mean[:, None])
    errors, log_evidence = _posterior(pairs, root[:, :, None])
    log_weights = imm.log_probabilities(transition.T)[:, :, None] + log_evidence
    of_mode = imm.log_mixture_density(0.0 * log_weights, log_weights)
    error = Gaussian(*imm.combine(*errors, xp.exp(log_weights - of_mode)))
    bank = GaussianMixture(
        filtered.mean + apply(root, error.mean),
        _symmetrize(_congruence(root, error.covariance)),
        imm.softmax(imm.log_probabilities(filtered.probabilities) + of_mode),
    )
    return SmoothedBank(bank, _likelihood_from_moments(filtered.mean, root, error, of_mode))


def smooth_imm(
    filtered: GaussianMixture,
    arrival: Arrival | Callable[[slice], Arrival],
    transition: Array,
    lag: int | None = None,
    keep: Callable[[GaussianMixture], Any] = lambda bank: bank,
) -> Any:
    """Return the smoothed estimates of each mode of a track, from those of an IMM.

    :func:`.imm.combine` merges those of each scan.

    Args:
        filtered: estimates after the update at K scans, ``(n, M, K, N)``, ``(n, n, M, K, N)`` and ``(M, K, N)``.
        arrival: motion to and measurement at the K - 1 later scans; or a function that returns those of a slice.
        transition: transition matrix of the modes, row = from, column = to, ``(M, M)``.
        lag: number of later scans that each estimate uses; default: all.
        keep: function that selects the stored part of the smoothed estimates of some scans; default: all of them.

    Returns:
        The smoothed estimates of each mode and the smoothed mode probabilities, in the same shapes, or the stored part
        of them.

    Raises:
        ValueError: for a negative lag.
    """

    def nothing_later(scans: slice) -> SmoothedBank:
        bank = take_scans(filtered, scans)
        nothing = QuadraticLikelihood(
            bank.mean, 0.0 * bank.probabilities, 0.0 * bank.mean, 0.0 * bank.covariance
        )
        return SmoothedBank(bank, nothing)

    return backward(
        _imm_step_of(transition),
        _track(filtered, arrival),
        nothing_later,
        lag,
        lambda found: keep(found.bank),
    )


def _imm_step_of(transition: Array) -> Step:
    """Return :func:`imm_step` for a transition matrix, cached by the matrix's numbers."""
    if isinstance(transition, numpy.ndarray):
        return _imm_step_of_numbers(transition.tobytes(), len(transition))
    return functools.partial(imm_step, transition=transition)


@functools.lru_cache(16)
def _imm_step_of_numbers(numbers: bytes, modes: int) -> Step:
    return functools.partial(imm_step, transition=numpy.frombuffer(numbers).reshape(modes, modes))


# --- likelihoods as quadratic forms


def _expand_about(likelihood: QuadraticLikelihood, centre: Array) -> QuadraticLikelihood:
    """Expand a quadratic log-likelihood about another centre."""
    step = centre - likelihood.centre
    bent = apply(likelihood.curvature, step)
    value = likelihood.value + _dot(likelihood.gradient - 0.5 * bent, step)
    return QuadraticLikelihood(centre, value, likelihood.gradient - bent, likelihood.curvature)


def _add_measurement(later: QuadraticLikelihood, arrival: Arrival) -> QuadraticLikelihood:
    """Return the likelihood of a scan's measurement and the later ones, about the predicted means."""
    likelihood = _expand_about(later, arrival.motion.predicted)
    H, precision = (_insert_axis(matrix, -2) for matrix in (arrival.H, arrival.precision))
    weighted = product(transpose(H), precision)
    residual = _insert_axis(arrival.position, -2) - apply(H, likelihood.centre)
    return likelihood._replace(
        value=likelihood.value - 0.5 * _dot(residual, apply(precision, residual)),
        gradient=likelihood.gradient + apply(weighted, residual),
        curvature=likelihood.curvature + product(weighted, H),
    )


def _pull_back(likelihood: QuadraticLikelihood, motion: Motion, centre: Array) -> QuadraticLikelihood:
    """Return the likelihood as a function of the state one scan before, the process noise integrated out."""
    root = semidefinite_root(motion.Q)
    bent = product(likelihood.curvature, root)
    inner = semidefinite_root(_identity(centre) + product(transpose(root), bent))
    error = apply(transpose(root), likelihood.gradient)
    gain = transpose(_solve(inner, transpose(bent)))
    rest = _identity(centre) - product(gain, transpose(root))
    curvature = _congruence(rest, likelihood.curvature) + product(gain, transpose(gain))
    back = transpose(motion.F)
    return QuadraticLikelihood(
        centre,
        likelihood.value + 0.5 * _dot(error, _solve(inner, error)) - _log_diagonal(inner),
        apply(back, likelihood.gradient - apply(gain, error)),
        _symmetrize(_congruence(back, curvature)),
    )


def _posterior(likelihood: QuadraticLikelihood, root: Array) -> tuple[Gaussian, Array]:
    """Return the posterior mean and covariance of e ~ N(0, I), ``x = centre + root e``, and the log evidence."""
    back = transpose(root)
    inner = semidefinite_root(_identity(likelihood.centre) + _congruence(back, likelihood.curvature))
    pull = apply(back, likelihood.gradient)
    mean = _solve(inner, pull)
    covariance = _solve(inner, _identity(likelihood.centre) + 0.0 * inner)
    evidence = likelihood.value + 0.5 * _dot(pull, mean) - _log_diagonal(inner)
    return Gaussian(mean, _symmetrize(covariance)), evidence


def _likelihood_from_moments(
    centre: Array, root: Array, error: Gaussian, log_evidence: Array
) -> QuadraticLikelihood:
    """Return the likelihood with which ``e ~ N(0, I)`` has this posterior; ``x = centre + root e``.

    In a direction in which the variance is not below one it carries no information.
    """
    xp = namespace(centre)
    # LAPACK refuses values that are not finite, for the whole batch; here only the episode's own estimates are lost.
    lost = xp.isnan(ordered_sum([row for matrix in error.covariance for row in matrix]))
    covariance = xp.where(lost, _identity(centre), error.covariance)
    variances, directions = eigenvectors(covariance)
    informed = variances < 1.0
    variances = xp.where(informed, variances, 1.0)
    along = xp.where(informed, apply(transpose(directions), error.mean), 0.0)
    curvature = 1.0 / variances - 1.0
    directions = _solve_upper(root, directions)
    return QuadraticLikelihood(
        centre,
        log_evidence - 0.5 * ordered_sum(along**2 / variances + xp.log(variances)),
        apply(directions, along / variances),
        _symmetrize(product(directions * curvature[None], transpose(directions))),
    )


# --- matrices

SWEEPS = 7
"""Number of sweeps of Jacobi's rotations: each squares the error, and six reach rounding for up to eight rows."""


def eigenvectors(A: Array) -> tuple[Array, Array]:
    """Return eigenvalues ``(n, ...)`` and eigenvectors, columns of ``(n, n, ...)``, of symmetric matrices.

    By LAPACK, or in a trace by Jacobi's rotations (Golub and Van Loan, Matrix Computations (2013), section 8.5).
    """
    xp, n = namespace(A), A.shape[0]
    if hasattr(xp, "linalg"):
        values, vectors = xp.linalg.eigh(xp.moveaxis(A, (0, 1), (-2, -1)))
        return xp.moveaxis(values, -1, 0), xp.moveaxis(vectors, (-2, -1), (0, 1))
    rows = [[A[max(i, j), min(i, j)] for j in range(n)] for i in range(n)]
    columns = [[A[0, 0] * 0.0 + float(i == j) for i in range(n)] for j in range(n)]
    for _ in range(SWEEPS):
        for p in range(n):
            for q in range(p + 1, n):
                _rotate(rows, columns, p, q)
    vectors = xp.stack([xp.stack([columns[j][i] for j in range(n)]) for i in range(n)])
    return xp.stack([rows[i][i] for i in range(n)]), vectors


def _rotate(rows: list[list[Array]], columns: list[list[Array]], p: int, q: int) -> None:
    """Apply a Jacobi rotation in place that makes entry (p, q) of a symmetric matrix zero, also to its eigenvectors."""
    xp, between = namespace(rows[p][q]), rows[p][q]
    there = between != 0.0
    ratio = (rows[q][q] - rows[p][p]) / xp.where(there, 2.0 * between, 1.0)
    root = xp.abs(ratio) + xp.sqrt(1.0 + ratio * ratio)
    tangent = xp.where(there, xp.where(ratio < 0.0, -1.0, 1.0) / root, 0.0)
    cosine = 1.0 / xp.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    rows[p][p], rows[q][q] = rows[p][p] - tangent * between, rows[q][q] + tangent * between
    rows[p][q] = rows[q][p] = between * 0.0
    for k in range(len(rows)):
        if k not in (p, q):
            one, other = rows[k][p], rows[k][q]
            rows[k][p] = rows[p][k] = cosine * one - sine * other
            rows[k][q] = rows[q][k] = sine * one + cosine * other
    one_column, other_column = columns[p], columns[q]
    columns[p] = [cosine * a - sine * b for a, b in zip(one_column, other_column, strict=True)]
    columns[q] = [sine * a + cosine * b for a, b in zip(one_column, other_column, strict=True)]


def semidefinite_root(A: Array) -> Array:
    """Return the lower triangular L with ``A = L L^T`` of a semidefinite matrix, zero in columns with a zero
    pivot.

    Args:
        A: symmetric positive semidefinite matrix, ``(n, n, ...)``; a pivot within rounding counts as zero.
    """
    xp = namespace(A)
    n = A.shape[0]
    tolerance = n * xp.finfo(A.dtype).eps
    zero = 0.0 * A[0, 0]
    rows: list[list[Array]] = [[zero] * n for _ in range(n)]
    for j in range(n):
        pivot = A[j, j] - ordered_sum([rows[j][k] ** 2 for k in range(j)] or [zero])
        positive = pivot > tolerance * A[j, j]
        rows[j][j] = xp.where(positive, xp.sqrt(xp.where(positive, pivot, 1.0)), pivot * 0.0)
        for i in range(j + 1, n):
            entry = A[i, j] - ordered_sum([rows[i][k] * rows[j][k] for k in range(j)] or [zero])
            rows[i][j] = xp.where(positive, entry / xp.where(positive, rows[j][j], 1.0), entry * 0.0)
    return xp.stack([xp.stack(row) for row in rows])


def _solve_lower(L: Array, b: Array) -> Array:
    """Return y with ``L y = b``; zero where the pivot is zero."""
    xp = namespace(b)
    y: list[Array] = []
    for i in range(L.shape[0]):
        entry = b[i]
        for j in range(i):
            entry = entry - L[i, j] * y[j]
        y.append(_divide(entry, L[i, i]))
    return xp.stack(y)


def _solve_upper(L: Array, b: Array) -> Array:
    """Return x with ``L^T x = b``; zero where the pivot is zero."""
    n = L.shape[0]
    x: list[Array] = [None] * n
    for i in reversed(range(n)):
        entry = b[i]
        for j in range(i + 1, n):
            entry = entry - L[j, i] * x[j]
        x[i] = _divide(entry, L[i, i])
    return namespace(b).stack(x)


def _divide(entry: Array, pivot: Array) -> Array:
    xp = namespace(entry)
    positive = pivot != 0.0
    return xp.where(positive, entry / xp.where(positive, pivot, 1.0), entry * 0.0)


def _solve(L: Array, b: Array) -> Array:
    """Return x with ``L L^T x = b``, for vectors ``(n, ...)`` or matrices ``(n, p, ...)``."""
    return _solve_upper(L, _solve_lower(L, b))


def _log_diagonal(L: Array) -> Array:
    """Return ``log det L``, half that of ``L L^T``."""
    xp = namespace(L)
    return ordered_sum([xp.log(L[i, i]) for i in range(L.shape[0])])


def _congruence(A: Array, P: Array) -> Array:
    """Return ``A P A^T``."""
    return product(product(A, P), transpose(A))


def _symmetrize(P: Array) -> Array:
    return 0.5 * (P + transpose(P))


def _identity(mean: Array) -> Array:
    """Return the unit matrix ``(n, n, 1, ...)`` for vectors ``(n, ...)``."""
    xp, n = namespace(mean), mean.shape[0]
    unit = xp.eye(n, dtype=mean.dtype, device=mean.device)
    return xp.reshape(unit, (n, n, *(1 for _ in mean.shape[1:])))


def _dot(a: Array, b: Array) -> Array:
    return ordered_sum([a[i] * b[i] for i in range(a.shape[0])])


def _insert_axis(values: Array, axis: int) -> Array:
    return namespace(values).expand_dims(values, axis=axis)
