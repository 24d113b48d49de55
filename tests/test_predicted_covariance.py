"""The estimated predicted covariance against the paper's inverse-Wishart recursion."""

import numpy as np
import pytest

from filtergym.filters import kalman, predicted_covariance


def system(seed, n=4, m=2, batch=5):
    rng = np.random.default_rng(seed)
    root, noise = rng.normal(size=(n, n, batch)), rng.normal(size=(m, m, batch))
    return (
        rng.normal(size=(n, batch)),
        np.einsum("ijb,kjb->ikb", root, root) + 0.1 * np.eye(n)[..., None],
        3.0 * rng.normal(size=(m, batch)),
        rng.normal(size=(m, n)),
        np.einsum("ijb,kjb->ikb", noise, noise) + 0.1 * np.eye(m)[..., None],
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("tau", [0.3, 4.0])
def test_equals_the_papers_distributions(seed, tau):
    mean, covariance, z, H, R = system(seed)
    result = predicted_covariance.update(mean, covariance, z, H, R, tau, 6)
    n = 4
    for b in range(mean.shape[1]):
        nominal, noise = covariance[..., b], R[..., b]
        freedom = n + tau + 1.0
        scale = tau * nominal
        expected_inverse = np.linalg.inv(nominal)
        for _ in range(6):
            P = np.linalg.inv(expected_inverse)
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + noise)
            x = mean[:, b] + K @ (z[:, b] - H @ mean[:, b])
            after = (np.eye(n) - K @ H) @ P
            A = after + np.outer(x - mean[:, b], x - mean[:, b])
            # The mean of the inverse of an inverse-Wishart variable with one more degree of freedom.
            expected_inverse = (freedom + 1.0 - n - 1.0) * np.linalg.inv(scale + A)
        # Inverses of inverses, six times.
        np.testing.assert_allclose(result.mean[:, b], x, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(result.covariance[..., b], after, rtol=1e-8, atol=1e-10)


def test_one_iteration_is_kalmans_update_and_so_is_a_strong_belief():
    s = system(9)
    expected = kalman.update(*s)
    for one, other in zip(predicted_covariance.update(*s, 1.0, 1), expected, strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(predicted_covariance.update(*s, 1e12, 5), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8)
