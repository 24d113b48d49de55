"""INS error with an error of the receiver, and noise that is a Gaussian sum, against matrices and naive mixtures."""

import math

import numpy as np
import pytest
from filtergym.filters import loosely_coupled, receiver_faults
from filtergym.filters.linear_systems import van_loan
from filtergym.filters.loosely_coupled import AugmentedCovariance
from filtergym.filters.receiver_faults import FaultCovariance

SAMPLING = loosely_coupled.sampling(1.5, 0.1)


def matrix(P):
    """Covariance as a matrix."""
    (p, pd, pc, d, dc, c), pf, df, cf, f = P
    return np.array([[p, pd, pc, pf], [pd, d, dc, df], [pc, dc, c, cf], [pf, df, cf, f]])


def drawn(rng):
    """A covariance as a matrix and in parts."""
    root = rng.normal(size=(4, 4))
    P = root @ root.T
    ins = AugmentedCovariance(P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2])
    return P, FaultCovariance(ins, P[0, 3], P[1, 3], P[2, 3], P[3, 3])


@pytest.mark.parametrize("seed", range(20))
def test_prediction_and_update_are_those_of_matrices(seed):
    rng = np.random.default_rng(seed)
    P, parts = drawn(rng)
    coloured, white, decay, gained, h, R = *rng.uniform(0.1, 1.0, 5), rng.uniform(0.5, 3.0)
    A, _, _ = loosely_coupled.error_model(0.0, 1.0, 1.5, 0.0)
    F, Q = np.diag([0.0, 0.0, 0.0, decay]), np.zeros((4, 4))
    F[:3, :3] = van_loan(A, np.zeros((3, 3)), 0.1)[0]
    s = SAMPLING
    Q[:3, :3] = coloured * np.outer([s.coupling, 0.0, 1.0], [s.coupling, 0.0, 1.0])
    Q[0, 0] += white
    Q[3, 3] = gained
    predicted = receiver_faults.predict_fault(parts, s, coloured, white, decay, gained)
    expected = F @ P @ F.T + Q
    np.testing.assert_allclose(matrix(predicted), expected, rtol=1e-13, atol=1e-13)
    H = np.array([1.0, 0.0, 0.0, -h])
    along = receiver_faults.measured_direction(predicted, h)
    np.testing.assert_allclose(along[:4], expected @ H, rtol=1e-12, atol=1e-12)
    assert along.variance == pytest.approx(H @ expected @ H, rel=1e-12)
    K = expected @ H / (H @ expected @ H + R)
    joseph = (np.eye(4) - np.outer(K, H)) @ expected @ (np.eye(4) - np.outer(K, H)).T + R * np.outer(K, K)
    updated = receiver_faults.update_fault(predicted, along, 1.0 / (along.variance + R))
    np.testing.assert_allclose(matrix(updated), joseph, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("innovation", [0.3, 4.0, 30.0])
def test_the_score_gives_the_moments_of_the_mixture_of_kalman_updates(seed, innovation):
    rng = np.random.default_rng(seed)
    P, parts = drawn(rng)
    levels, q = np.sort(rng.uniform(0.1, 50.0, 4)), rng.dirichlet(np.ones(4))
    along = receiver_faults.measured_direction(parts, 0.7)
    noise = receiver_faults.weigh_levels(np.array(innovation**2), 1, along.variance, levels, q)
    S = along.variance + levels
    densities = q * np.exp(-0.5 * innovation**2 / S) / np.sqrt(2.0 * math.pi * S)
    assert noise.log_density == pytest.approx(math.log(densities.sum()), rel=1e-12)
    weights = densities / densities.sum()
    np.testing.assert_allclose(noise.responsibilities, weights, rtol=1e-11)
    PH = P @ np.array([1.0, 0.0, 0.0, -0.7])
    means = PH / S[:, None] * innovation
    mean = weights @ means
    spread = sum(w * (P - np.outer(PH, PH) / s + np.outer(m - mean, m - mean))
                 for w, s, m in zip(weights, S, means, strict=True))  # fmt: skip
    np.testing.assert_allclose(np.array(along[:4]) * noise.score * innovation, mean, rtol=1e-11, atol=1e-13)
    weight = noise.score - noise.spread * innovation**2
    # Differences of numbers of the size of P and of the squared correction.
    np.testing.assert_allclose(
        matrix(receiver_faults.update_fault(parts, along, weight)), spread, rtol=1e-9, atol=1e-10
    )


@pytest.mark.parametrize("axes", [2, 3])
def test_axes_share_their_level(axes):
    levels, q, nu = np.array([0.5, 2.0, 20.0]), np.array([0.2, 0.5, 0.3]), np.array([0.4, -2.0, 3.0])[:axes]
    noise = receiver_faults.weigh_levels(np.array((nu**2).sum()), axes, 0.3, levels, q)
    S = 0.3 + levels
    densities = q * np.prod(np.exp(-0.5 * nu[:, None] ** 2 / S) / np.sqrt(2.0 * math.pi * S), axis=0)
    assert noise.log_density == pytest.approx(math.log(densities.sum()), rel=1e-12)
    np.testing.assert_allclose(noise.responsibilities, densities / densities.sum(), rtol=1e-12)


def test_an_innovation_of_ten_thousand_sigma_is_one_of_the_highest_level():
    levels, q = np.array([1.0, 1e3]), np.array([1.0 - 1e-12, 1e-12])
    noise = receiver_faults.weigh_levels(np.array(1e8), 1, 0.1, levels, q)
    assert noise.responsibilities[1] == 1.0
    assert np.isfinite(noise.log_density)
    assert noise.score == pytest.approx(1.0 / 1000.1, rel=1e-12)
    assert noise.spread == pytest.approx(0.0, abs=1e-18)
