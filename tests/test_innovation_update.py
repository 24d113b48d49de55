"""Updates with a gain that is given and with sigma points, against matrices of what was received alone."""

import numpy as np
import pytest
from naive import positive_definite
from scipy.stats import multivariate_normal

from filtergym.filters import innovation_update

N, M, BATCH = 4, 3, 6


def system(seed):
    rng = np.random.default_rng(seed)
    available = (rng.random((M, BATCH)) < 0.6).astype(float)
    available[:, 0], available[:, 1] = 1.0, 0.0
    return (
        rng.normal(size=(N, BATCH)),
        positive_definite(rng, N, BATCH),
        rng.normal(size=(M, BATCH)),
        rng.normal(size=(M, N)),
        positive_definite(rng, M, 1)[..., 0],
        available,
    )


def assert_update(found, b, expected):
    mean, covariance, log_likelihood, nis = expected
    np.testing.assert_allclose(found.mean[:, b], mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.covariance[..., b], covariance, rtol=1e-8, atol=1e-10)
    assert found.log_likelihood[b] == pytest.approx(log_likelihood, rel=1e-9, abs=1e-11)
    assert found.squared_distance[b] == pytest.approx(nis, rel=1e-9, abs=1e-12)


def reduced_update(x, P, nu, H, R, K=None):
    """Joseph's form with the rows that were received; without a gain Kalman's own."""
    if not len(nu):
        return x, P, 0.0, 0.0
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S) if K is None else K
    rest = np.eye(len(x)) - K @ H
    covariance = rest @ P @ rest.T + K @ R @ K.T
    return x + K @ nu, covariance, multivariate_normal.logpdf(nu, cov=S), nu @ np.linalg.solve(S, nu)


@pytest.mark.parametrize("seed", range(3))
def test_update_with_any_gain_takes_in_what_was_received_and_nothing_else(seed):
    mean, covariance, nu, H, R, available = system(seed)
    received = innovation_update.keep_received(nu, H, R, available)
    optimal = innovation_update.kalman_gain(covariance, received)
    other = optimal * np.random.default_rng(seed).uniform(0.5, 1.5, optimal.shape)
    for gain in (optimal, other):
        found = innovation_update.update_with_gain(mean, covariance, received, gain)
        for b in range(BATCH):
            rows = available[:, b] > 0.0
            K = None if gain is optimal else gain[:, rows, b]
            own = reduced_update(
                mean[:, b], covariance[..., b], nu[rows, b], H[rows], R[np.ix_(rows, rows)], K
            )
            assert_update(found, b, own)


@pytest.mark.parametrize("seed", range(3))
def test_sigma_points_of_a_linear_measurement_are_kalmans_update(seed):
    mean, covariance, z, H, R, available = system(seed)
    offset = 0.3

    def h(points):
        return np.einsum("mn,nkb->mkb", H, points) + offset

    found = innovation_update.unscented_update(mean, covariance, z, h, R, available)
    for b in range(BATCH):
        rows = available[:, b] > 0.0
        nu = (z[:, b] - H @ mean[:, b] - offset)[rows]
        own = reduced_update(mean[:, b], covariance[..., b], nu, H[rows], R[np.ix_(rows, rows)])
        assert_update(found, b, own)
