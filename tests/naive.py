"""Naive oracles that several test files share."""

import math

import gymnasium
import numpy
from scipy.stats import multivariate_normal

from filtergym.compiler.counter_numbers import numbers


def dense(rows, like):
    """Full Jacobian ``(m, n, ...)`` of rows given by their non-zero parts; ``like`` is a state ``(n, ...)``."""
    matrix = numpy.zeros((len(rows), *like.shape))
    for row, (columns, values) in zip(matrix, rows, strict=True):
        for column, value in zip(columns, values, strict=True):
            row[column] = value
    return matrix


def episode_numbers(seed, normals, uniforms, row_normals, row_uniforms, rows):
    """Random numbers of the episode of a seed, as the contract names them.

    Returns normals and uniforms of its start, and those of the measurements, ``(rows, ...)`` each.
    """
    identity = gymnasium.utils.seeding.np_random(seed)[0].bit_generator.random_raw(2)[:, None]
    start = numbers(identity, numpy.zeros(1, dtype=int), normals, uniforms)[:, 0]
    later = numbers(identity, numpy.arange(1, rows + 1)[:, None], row_normals, row_uniforms)[..., 0]
    return start[:normals], start[normals:], later[:, :row_normals], later[:, row_normals:]


def positive_definite(rng, n, *batch):
    """Random matrices ``(n, n, *batch)`` with eigenvalues of at least 0.1."""
    root = rng.normal(size=(*batch, n, n))
    return numpy.moveaxis(root @ root.swapaxes(-2, -1) + 0.1 * numpy.eye(n), (-2, -1), (0, 1))


def kalman_update(x, P, nu, H, R):
    """Kalman's update with NumPy's inverse; the innovation is NaN where nothing was received."""
    there = numpy.isfinite(nu)
    H = H[there]
    K = P @ H.T @ numpy.linalg.inv(H @ P @ H.T + R[numpy.ix_(there, there)])
    return x + K @ nu[there], (numpy.eye(len(x)) - K @ H) @ P


# --- the radar and the bank of ManeuveringTarget

T, RANGE_SIGMA, BEARING_SIGMA = 6.0, 100.0, math.radians(0.25)
"""Scan period, s, and standard deviations, m and rad."""


def transition(dt):
    """Of position and velocity over dt seconds."""
    return numpy.kron([[1.0, dt], [0.0, 1.0]], numpy.eye(2))


def variances(x, y):
    """Equations (22), (23)."""
    r, b = math.hypot(x, y), math.atan2(y, x)
    along, across = RANGE_SIGMA**2, (r * BEARING_SIGMA) ** 2
    c, s = math.cos(b) ** 2, math.sin(b) ** 2
    return numpy.array([c * along + s * across, s * along + c * across])


def start_covariance(start):
    """Equation (24)."""
    R = variances(*start[:2])
    return numpy.diag(numpy.concatenate([R, 2 * R / T**2]))


def naive_bank(start, scans, chain, mu, gains):
    """The paper's IMM with prediction over whatever interval, and prediction only where there is no measurement.

    Yields estimate, covariance and mode probabilities of every scan.

    Args:
        start: of the track.
        scans: time, truth and measurement of each.
        chain: transition matrix of the modes.
        mu: their probabilities at the start.
        gains: position gains in every scan, ``(scans, M)``.
    """
    M, H = len(mu), numpy.eye(2, 4)
    x, P, last, measured = [start] * M, [start_covariance(start)] * M, 0.0, 0.0
    for (time, _, z), used in zip(scans, gains, strict=True):
        predicted = numpy.array([sum(chain[i][j] * mu[i] for i in range(M)) for j in range(M)])
        new, log_weights, F = [], numpy.log(predicted), transition(time - last)
        for j in range(M):
            w = [chain[i][j] * mu[i] / predicted[j] for i in range(M)]
            x0 = sum(w[i] * x[i] for i in range(M))
            P0 = sum(w[i] * (P[i] + numpy.outer(x[i] - x0, x[i] - x0)) for i in range(M))
            x0, P0 = F @ x0, F @ P0 @ F.T
            if z is not None:
                R = numpy.diag(variances(*z))
                log_weights[j] += multivariate_normal.logpdf(z, x0[:2], P0[:2, :2] + R)
                K = numpy.kron([[used[j]], [used[j] ** 2 / (2 - used[j]) / (time - measured)]], numpy.eye(2))
                rest = numpy.eye(4) - K @ H
                x0, P0 = x0 + K @ (z - H @ x0), rest @ P0 @ rest.T + K @ R @ K.T
            new.append((x0, P0))
        x, P = zip(*new, strict=True)
        mu = numpy.exp(log_weights - log_weights.max())
        mu = mu / mu.sum()
        last, measured = time, measured if z is None else time
        mean = sum(mu[j] * x[j] for j in range(M))
        spread = sum(mu[j] * (P[j] + numpy.outer(x[j] - mean, x[j] - mean)) for j in range(M))
        yield mean, spread, mu
