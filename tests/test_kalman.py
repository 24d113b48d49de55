"""The discrete Kalman filter against matrices of one episode at a time."""

import numpy as np
import pytest
from naive import positive_definite
from scipy.stats import multivariate_normal

from filtergym.filters import kalman


def system(seed, n, m, batch):
    rng = np.random.default_rng(seed)
    return {
        "mean": rng.normal(size=(n, batch)),
        "covariance": positive_definite(rng, n, batch),
        "F": rng.normal(size=(n, n, batch)),
        "Q": positive_definite(rng, n, batch),
        "H": rng.normal(size=(m, n, batch)),
        "R": positive_definite(rng, m, batch),
        "z": rng.normal(size=(m, batch)),
        "offset": rng.normal(size=(n, batch)),
    }


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 1), (4, 2), (5, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_prediction_and_update_equal_naive_matrices(n, m, seed):
    s = system(seed, n, m, 4)
    mean, covariance = kalman.predict(s["mean"], s["covariance"], s["F"], s["Q"], s["offset"])
    result = kalman.update(mean, covariance, s["z"], s["H"], s["R"])
    for b in range(4):
        F, H, R = s["F"][..., b], s["H"][..., b], s["R"][..., b]
        x = F @ s["mean"][:, b] + s["offset"][:, b]
        P = F @ s["covariance"][..., b] @ F.T + s["Q"][..., b]
        np.testing.assert_allclose(mean[:, b], x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(covariance[..., b], P, rtol=1e-12, atol=1e-12)
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        innovation = s["z"][:, b] - H @ x
        np.testing.assert_allclose(result.mean[:, b], x + K @ innovation, rtol=1e-9, atol=1e-9)
        # With Kalman's own gain the short form is the Joseph form.
        np.testing.assert_allclose(result.covariance[..., b], (np.eye(n) - K @ H) @ P, rtol=1e-8, atol=1e-9)
        log_likelihood = multivariate_normal.logpdf(innovation, cov=S)
        assert result.log_likelihood[b] == pytest.approx(log_likelihood, rel=1e-10, abs=1e-10)
        distance = innovation @ np.linalg.solve(S, innovation)
        assert result.squared_distance[b] == pytest.approx(distance, rel=1e-9)


def test_matrices_shared_by_the_batch_equal_repeated_ones():
    s = system(0, 3, 2, 1)
    rng = np.random.default_rng(1)
    mean, covariance, z = rng.normal(size=(3, 5)), positive_definite(rng, 3, 5), rng.normal(size=(2, 5))
    shared = {k: s[k][..., 0] for k in "FQHR"}
    wide = {k: np.repeat(s[k], 5, axis=-1) for k in "FQHR"}
    predicted = kalman.predict(mean, covariance, shared["F"], shared["Q"])
    for one, other in zip(predicted, kalman.predict(mean, covariance, wide["F"], wide["Q"]), strict=True):
        np.testing.assert_array_equal(one, other)
    updated = kalman.update(*predicted, z, shared["H"], shared["R"])
    for one, other in zip(updated, kalman.update(*predicted, z, wide["H"], wide["R"]), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_white_acceleration_is_the_paper_model(axes):
    T, sigma = 6.0, 2.775
    F, Q = map(np.array, kalman.white_acceleration(T, sigma, axes))
    eye = np.eye(axes)
    np.testing.assert_array_equal(F, np.kron([[1.0, T], [0.0, 1.0]], eye))
    B = np.kron([[T**2 / 2], [T]], eye)
    np.testing.assert_allclose(Q, sigma**2 * B @ B.T, rtol=1e-15)
