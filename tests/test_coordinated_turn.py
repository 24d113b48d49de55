"""The nearly coordinated turn against matrix exponentials, their derivatives and naive matrices."""

import numpy as np
import pytest
from scipy.linalg import expm, expm_frechet

from filtergym.filters import coordinated_turn, kalman

T = 6.0
RATES = np.array([0.0, 1e-300, -1e-12, 1e-7, -1e-3, 0.0166, -0.01668, 0.1, -0.3, 0.6, 3.0])
"""rad/s; 0.1 / T, where the series ends, is between two of them."""


def states():
    rng = np.random.default_rng(0)
    scale = np.array([2e4, 2e4, 200.0, 200.0])[:, None]
    return np.concatenate([scale * rng.normal(size=(4, len(RATES))), RATES[None]])


def rotation(rate):
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2:, 2:] = [[0.0, -rate], [rate, 0.0]]
    return A


def test_turn_solves_its_differential_equation():
    before = states()
    after = coordinated_turn.propagate(before, T)
    for b, rate in enumerate(RATES):
        # The exponential rounds, too.
        np.testing.assert_allclose(
            after[:4, b], expm(rotation(rate) * T) @ before[:4, b], rtol=1e-13, atol=1e-10
        )
    np.testing.assert_array_equal(after[4], RATES)


def test_jacobian_is_the_derivative_of_the_exponential():
    before = states()
    F = coordinated_turn.jacobian(before, T)
    for b, rate in enumerate(RATES):
        exponential, derivative = expm_frechet(rotation(rate) * T, (rotation(1.0) - rotation(0.0)) * T)
        np.testing.assert_allclose(F[:4, :4, b], exponential, rtol=1e-13, atol=1e-13)
        expected = derivative @ before[:4, b]
        np.testing.assert_allclose(F[:4, 4, b], expected, rtol=1e-13, atol=1e-13 * abs(expected).max())
        np.testing.assert_array_equal(F[4, :, b], [0.0, 0.0, 0.0, 0.0, 1.0])


def test_no_turn_is_constant_velocity():
    F, Q = (np.array(matrix) for matrix in kalman.white_acceleration(T, 0.7, axes=2))
    straight = coordinated_turn.jacobian(np.array([[1.0], [2.0], [3.0], [4.0], [0.0]]), T)[:, :, 0]
    np.testing.assert_array_equal(straight[:4, :4], F)
    noise = np.array(coordinated_turn.process_noise(T, 0.7, 0.01))
    np.testing.assert_array_equal(noise[:4, :4], Q)
    assert noise[4, 4] == pytest.approx(0.06**2, rel=1e-15)
    assert not noise[4, :4].any()
    assert not noise[:4, 4].any()


def test_prediction_of_the_covariance_equals_naive_matrices():
    mean = states()
    root = np.random.default_rng(1).normal(size=(5, 5, len(RATES)))
    covariance = np.einsum("ijb,kjb->ikb", root, root)
    Q = np.diag([1.0, 2.0, 3.0, 4.0, 5.0])
    moved, P = coordinated_turn.predict(mean, covariance, T, Q[:, :, None])
    np.testing.assert_array_equal(moved, coordinated_turn.propagate(mean, T))
    F = coordinated_turn.jacobian(mean, T)
    for b in range(len(RATES)):
        expected = F[..., b] @ covariance[..., b] @ F[..., b].T + Q
        np.testing.assert_allclose(P[..., b], expected, rtol=1e-11, atol=1e-13 * abs(expected).max())


def test_augmented_state_knows_nothing_of_its_turn():
    mean, covariance = np.arange(8.0).reshape(4, 2), np.arange(32.0).reshape(4, 4, 2)
    mean5, covariance5 = coordinated_turn.augment_turn_rate(mean, covariance, 0.25)
    for b in range(2):
        np.testing.assert_array_equal(mean5[:, b], [*mean[:, b], 0.0])
        expected = np.zeros((5, 5))
        expected[:4, :4], expected[4, 4] = covariance[:, :, b], 0.25
        np.testing.assert_array_equal(covariance5[:, :, b], expected)
