"""The interacting multiple model against golden numbers and naive loops."""

import numpy as np
import pytest
from naive import positive_definite

from filtergym.filters import imm

SEEDS = range(5)


def random_bank(seed, n=4, modes=3, batch=6):
    """Means, positive definite covariances, weights and an asymmetric transition matrix."""
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=(n, modes, batch))
    covariance = positive_definite(rng, n, modes, batch)
    weights = rng.dirichlet(np.ones(modes), size=batch).T
    transition = rng.dirichlet(np.ones(modes), size=modes)
    return mean, covariance, weights, transition


@pytest.mark.parametrize("seed", SEEDS)
def test_predicted_probabilities_sum_over_the_first_index(seed):
    _, _, weights, transition = random_bank(seed)
    prediction = imm.predict_mode_probabilities(transition, weights)
    for b in range(weights.shape[1]):
        for j in range(3):
            expected = sum(transition[i, j] * weights[i, b] for i in range(3))
            assert prediction.probabilities[j, b] == pytest.approx(expected, rel=1e-14)
            for i in range(3):
                mixing = transition[i, j] * weights[i, b] / expected
                assert prediction.mixing[i, j, b] == pytest.approx(mixing, rel=1e-14)
    np.testing.assert_allclose(prediction.mixing.sum(axis=0), 1.0, rtol=1e-14)
    np.testing.assert_allclose(prediction.probabilities.sum(axis=0), 1.0, rtol=1e-14)


def test_transition_may_differ_in_the_batch():
    rng = np.random.default_rng(0)
    transitions = rng.dirichlet(np.ones(2), size=(2, 4)).swapaxes(1, 2)  # (from, to, lane)
    weights = rng.dirichlet(np.ones(2), size=4).T
    together = imm.predict_mode_probabilities(transitions, weights)
    for b in range(4):
        alone = imm.predict_mode_probabilities(transitions[:, :, b], weights[:, b : b + 1])
        np.testing.assert_array_equal(together.probabilities[:, b], alone.probabilities[:, 0])
        np.testing.assert_array_equal(together.mixing[:, :, b], alone.mixing[:, :, 0])


@pytest.mark.parametrize("seed", SEEDS)
def test_mixing_equals_naive_sums_with_the_spread_of_means(seed):
    mean, covariance, weights, transition = random_bank(seed)
    mixing = imm.predict_mode_probabilities(transition, weights).mixing
    mixed_mean, mixed_covariance = imm.mix(mean, covariance, mixing)
    for b in range(mean.shape[-1]):
        for j in range(3):
            x = sum(mixing[i, j, b] * mean[:, i, b] for i in range(3))
            P = sum(
                mixing[i, j, b] * (covariance[:, :, i, b] + np.outer(mean[:, i, b] - x, mean[:, i, b] - x))
                for i in range(3)
            )
            np.testing.assert_allclose(mixed_mean[:, j, b], x, rtol=1e-12, atol=1e-13)
            np.testing.assert_allclose(mixed_covariance[:, :, j, b], P, rtol=1e-12, atol=1e-12)
            assert np.linalg.eigvalsh(mixed_covariance[:, :, j, b]).min() > 0


def test_combination_has_the_moments_of_the_mixture():
    # Two one-dimensional Gaussians: mean 1, variance 3 + 0.75 * 1 + 0.25 * 9 = 6 by hand.
    mean, covariance = imm.combine(
        np.array([[[0.0], [4.0]]]), np.full((1, 1, 2, 1), 3.0), np.array([[0.75], [0.25]])
    )
    assert mean[0, 0] == 1.0
    assert covariance[0, 0, 0] == 6.0


def test_impossible_mode_keeps_its_estimate_and_makes_no_nan():
    mean, covariance, _, _ = random_bank(0, modes=2)
    absorbing = np.array([[1.0, 0.0], [1.0, 0.0]])  # no mode leads to mode 2
    weights = np.tile([[1.0], [0.0]], mean.shape[-1])
    prediction = imm.predict_mode_probabilities(absorbing, weights)
    np.testing.assert_array_equal(prediction.probabilities[1], 0.0)
    mixed, mixed_covariance = imm.mix(mean, covariance, prediction.mixing)
    np.testing.assert_allclose(mixed[:, 1], mean[:, 1], rtol=1e-15)
    np.testing.assert_allclose(mixed_covariance[:, :, 1], covariance[:, :, 1], rtol=1e-15)
    # Also when the likelihood of the impossible mode is far larger.
    log_likelihood = np.array([[-600.0], [0.0]]) + np.zeros((2, mean.shape[-1]))
    posterior = imm.mode_posterior(imm.log_probabilities(prediction.probabilities), log_likelihood)
    np.testing.assert_allclose(posterior, weights, rtol=0, atol=1e-30)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_logarithm_of_no_probability_is_that_of_the_floor(dtype):
    logarithm = imm.log_probabilities(np.array([0.0, 1e-30, 0.25, 1.0], dtype=dtype))
    assert logarithm.dtype == dtype
    rounding = 2 * np.finfo(dtype).eps
    np.testing.assert_allclose(logarithm, np.log([1e-300, 1e-30, 0.25, 1.0]), rtol=rounding, atol=0)


def test_posterior_survives_likelihoods_that_underflow():
    # 500 and 510 sigma: both likelihoods are 0 in linear scale, their ratio is exp(-5050).
    log_likelihood = np.array([[-0.5 * 500.0**2], [-0.5 * 510.0**2]])
    assert (np.exp(log_likelihood) == 0.0).all()
    posterior = imm.mode_posterior(np.log([[0.01], [0.99]]), log_likelihood)
    np.testing.assert_array_equal(posterior, [[1.0], [0.0]])
    close = imm.mode_posterior(np.log([[0.5], [0.5]]), log_likelihood[:1] + np.log([[3.0], [1.0]]))
    np.testing.assert_allclose(close, [[0.75], [0.25]], rtol=1e-10)  # 125000 nats leave eleven digits


@pytest.mark.parametrize("seed", SEEDS)
def test_posterior_is_bayes_rule(seed):
    rng = np.random.default_rng(seed)
    prior = rng.dirichlet(np.ones(4), size=7).T
    likelihood = rng.uniform(0.01, 2.0, size=(4, 7))
    posterior = imm.mode_posterior(imm.log_probabilities(prior), np.log(likelihood))
    np.testing.assert_allclose(posterior, prior * likelihood / (prior * likelihood).sum(axis=0), rtol=1e-13)
