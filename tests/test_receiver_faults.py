"""INS error with an error of the receiver, and noise that is a Gaussian sum, against matrices and naive mixtures."""

import math

import numpy as np
import pytest
from contract import assert_properties

from filtergym.filters import loosely_coupled, receiver_faults
from filtergym.filters.linear_systems import van_loan
from filtergym.filters.receiver_faults import matrix

SAMPLING = loosely_coupled.sampling(1.5, 0.1)


def drawn(rng, errors=1):
    """A covariance as a matrix and in parts."""
    root = rng.normal(size=(3 + errors, 3 + errors))
    P = root @ root.T
    return P, receiver_faults.from_matrix(P)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("errors", [1, 2])
def test_prediction_and_update_are_those_of_matrices(seed, errors):
    rng = np.random.default_rng(seed)
    P, parts = drawn(rng, errors)
    coloured, white, R = *rng.uniform(0.1, 1.0, 2), rng.uniform(0.5, 3.0)
    decay, gained, h = rng.uniform(0.1, 1.0, (3, errors))
    np.testing.assert_array_equal(matrix(parts), P)
    A, _, _ = loosely_coupled.error_model(0.0, 1.0, 1.5, 0.0)
    F, Q = np.diag([0.0, 0.0, 0.0, *decay]), np.diag([0.0, 0.0, 0.0, *gained])
    F[:3, :3] = van_loan(A, np.zeros((3, 3)), 0.1)[0]
    s = SAMPLING
    Q[:3, :3] = coloured * np.outer([s.coupling, 0.0, 1.0], [s.coupling, 0.0, 1.0])
    Q[0, 0] += white
    predicted = receiver_faults.predict_fault(parts, s, coloured, white, decay, gained)
    expected = F @ P @ F.T + Q
    np.testing.assert_allclose(matrix(predicted), expected, rtol=1e-13, atol=1e-13)
    H = np.array([1.0, 0.0, 0.0, *-h])
    along = receiver_faults.measured_direction(predicted, h)
    np.testing.assert_allclose([*along[:3], *along.faults], expected @ H, rtol=1e-12, atol=1e-12)
    assert along.variance == pytest.approx(H @ expected @ H, rel=1e-12)
    K = expected @ H / (H @ expected @ H + R)
    I_KH = np.eye(3 + errors) - np.outer(K, H)
    updated = receiver_faults.update_fault(predicted, along, 1.0 / (along.variance + R))
    # Joseph's form is a sum of squares, the other one a difference.
    np.testing.assert_allclose(
        matrix(updated), I_KH @ expected @ I_KH.T + R * np.outer(K, K), rtol=1e-11, atol=1e-11
    )


def test_an_error_that_is_added_is_independent_of_all_others():
    P, parts = drawn(np.random.default_rng(1))
    expected = np.zeros((5, 5))
    expected[:4, :4], expected[4, 4] = P, 7.0
    np.testing.assert_array_equal(matrix(receiver_faults.add_fault(parts, np.array(7.0))), expected)


def test_the_score_gives_the_moments_of_the_mixture_of_kalman_updates():
    draws = [(seed, innovation) for seed in range(5) for innovation in (0.3, 4.0, 30.0)]
    assert_properties(draws, (has_the_moments_of_the_mixture,))


def has_the_moments_of_the_mixture(draw):
    seed, innovation = draw
    rng = np.random.default_rng(seed)
    P, parts = drawn(rng)
    levels, q = np.sort(rng.uniform(0.1, 50.0, 4)), rng.dirichlet(np.ones(4))
    along = receiver_faults.measured_direction(parts, np.array([0.7]))
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
    np.testing.assert_allclose(
        np.array([*along[:3], *along.faults]) * noise.score * innovation, mean, rtol=1e-11, atol=1e-13
    )
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
