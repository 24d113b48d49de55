"""Alpha-beta filters against golden numbers, naive matrices and simulation."""

import numpy as np
import pytest

from filtergym.filters import alpha_beta
from filtergym.filters.alpha_beta import Covariance
from filtergym.papers.imm_alpha_beta.alpha_beta_errors import (
    ErrorMoments,
    propagate_error,
    variance_reduction,
)

GAINS = [0.05, 0.3, 0.5, 0.7, 0.95]


def matrices(alpha, beta, T):
    """F, H and K of one coordinate."""
    return np.array([[1.0, T], [0.0, 1.0]]), np.array([[1.0, 0.0]]), np.array([[alpha], [beta / T]])


def joseph(P, R, alpha, beta, T):
    """Naive Joseph form with matrices."""
    _, H, K = matrices(alpha, beta, T)
    rest = np.eye(2) - K @ H
    return rest @ P @ rest.T + R * K @ K.T


def as_matrix(P):
    return np.array([[P.position, P.cross], [P.cross, P.velocity]])


def test_benedict_bordner_relation():
    assert alpha_beta.benedict_bordner_beta(0.5) == pytest.approx(1 / 6, rel=1e-15)
    assert alpha_beta.benedict_bordner_beta(0.8) == pytest.approx(0.8**2 / 1.2, rel=1e-15)
    assert alpha_beta.benedict_bordner_beta(0.8) == pytest.approx(0.533333, abs=5e-7)  # golden


def test_variance_reduction_golden():
    ratios = variance_reduction(0.5, 1 / 6)
    np.testing.assert_allclose(ratios, [0.4117647, 0.0392157, 0.6470588], rtol=0, atol=5e-8)


@pytest.mark.parametrize("alpha", GAINS)
def test_variance_reduction_is_the_fixed_point_of_the_joseph_recursion(alpha):
    beta, T, R = alpha_beta.benedict_bordner_beta(alpha), 4.0, 9.0
    P = Covariance(R, 0.0, 2 * R / T**2)
    for _ in range(2000):
        P = alpha_beta.update_covariance(alpha_beta.predict_covariance(P, T), R, alpha, beta, T)
    ratios = variance_reduction(alpha, beta)
    assert P.position == pytest.approx(R * ratios.position, rel=1e-10)
    assert P.velocity == pytest.approx(R * ratios.velocity / T**2, rel=1e-10)
    assert alpha_beta.predict_covariance(P, T).position == pytest.approx(R * ratios.prediction, rel=1e-10)


@pytest.mark.parametrize("alpha", GAINS)
def test_acceleration_lag_is_what_a_noiseless_filter_settles_at(alpha):
    beta, T, a = alpha_beta.benedict_bordner_beta(alpha), 2.0, 3.0
    position = velocity = 0.0
    moments = ErrorMoments(0.0, 0.0, Covariance(0.0, 0.0, 0.0))
    steps = 1500
    for k in range(1, steps + 1):
        truth = 0.5 * a * (k * T) ** 2
        predicted = alpha_beta.predict(position, velocity, T)
        position, velocity = alpha_beta.update(predicted, velocity, truth - predicted, alpha, beta, T)
        moments = propagate_error(moments, (a * T**2 / 2, a * T), 0.0, alpha, beta, T)
    assert moments.position == pytest.approx(a * T**2 * (1 - alpha) / beta, rel=1e-12)
    # Positions of 1e7 m leave nine digits behind the point.
    assert truth - position == pytest.approx(a * T**2 * (1 - alpha) / beta, rel=1e-7)


@pytest.mark.parametrize("seed", range(10))
def test_covariances_equal_naive_matrices_and_stay_positive(seed):
    rng = np.random.default_rng(seed)
    T, R = rng.uniform(0.1, 10), rng.uniform(0.1, 1e4)
    root = rng.normal(size=(2, 2)) * np.sqrt(R)
    P = root @ root.T
    mine = Covariance(P[0, 0], P[0, 1], P[1, 1])
    for _ in range(50):
        alpha, beta = rng.uniform(0.01, 0.99), rng.uniform(0.0, 1.0)  # any gains, not Kalman's
        F, _, _ = matrices(alpha, beta, T)
        mine, P = alpha_beta.predict_covariance(mine, T), F @ P @ F.T
        np.testing.assert_allclose(as_matrix(mine), P, rtol=1e-9)
        mine, P = alpha_beta.update_covariance(mine, R, alpha, beta, T), joseph(P, R, alpha, beta, T)
        np.testing.assert_allclose(as_matrix(mine), P, rtol=1e-9, atol=1e-9 * R / T**2)
        assert np.linalg.eigvalsh(as_matrix(mine)).min() > 0


@pytest.mark.parametrize("seed", range(5))
def test_joint_covariance_equals_naive_matrices(seed):
    rng = np.random.default_rng(seed)
    modes, batch, T = 2, 3, 6.0
    root = rng.normal(size=(modes, batch, 4, 4))
    P = root @ root.swapaxes(-1, -2)
    R = rng.uniform(0.5, 2.0, size=(2, 1, batch))
    alpha = np.array([[0.3], [0.7]])
    beta = alpha_beta.benedict_bordner_beta(alpha)
    F = np.kron([[1.0, T], [0.0, 1.0]], np.eye(2))
    mine = alpha_beta.predict_joint_covariance(np.moveaxis(P, (2, 3), (0, 1)), T)
    updated = alpha_beta.update_joint_covariance(mine, R, alpha, beta, T)
    for m in range(modes):
        for b in range(batch):
            predicted = F @ P[m, b] @ F.T
            np.testing.assert_allclose(mine[:, :, m, b], predicted, rtol=1e-12, atol=1e-12)
            K = np.kron([[alpha[m, 0]], [beta[m, 0] / T]], np.eye(2))
            rest = np.eye(4) - K @ np.eye(2, 4)
            expected = rest @ predicted @ rest.T + K @ np.diag(R[:, 0, b]) @ K.T
            np.testing.assert_allclose(updated[:, :, m, b], expected, rtol=1e-11, atol=1e-11)
            assert np.linalg.eigvalsh(updated[:, :, m, b]).min() > 0


@pytest.mark.parametrize("seed", range(3))
def test_propagated_error_equals_naive_matrices(seed):
    rng = np.random.default_rng(seed)
    T, R, alpha = 6.0, 100.0, 0.4
    beta = alpha_beta.benedict_bordner_beta(alpha)
    F, H, K = matrices(alpha, beta, T)
    rest = np.eye(2) - K @ H
    mean, P = np.array([3.0, -1.0]), np.array([[50.0, 2.0], [2.0, 9.0]])
    moments = ErrorMoments(mean[0], mean[1], Covariance(P[0, 0], P[0, 1], P[1, 1]))
    for _ in range(20):
        a = rng.normal()
        push = np.array([a * T**2 / 2, a * T])
        moments = propagate_error(moments, push, R, alpha, beta, T)
        mean = rest @ (F @ mean + push)
        P = rest @ F @ P @ F.T @ rest.T + R * K @ K.T
        np.testing.assert_allclose([moments.position, moments.velocity], mean, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(as_matrix(moments.covariance), P, rtol=1e-11)
