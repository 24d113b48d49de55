"""Estimated noise levels against the papers' formulas, one episode at a time, and against the given truth."""

import numpy as np
import pytest

from filtergym.filters import noise_adaptation as adaptation

STEPS, BATCH = 60, 3


def data(seed):
    """Innovations ``(STEPS, 2, BATCH)``, variances, and which are available; nothing special about the first step."""
    rng = np.random.default_rng(seed)
    shape = (STEPS, 2, BATCH)
    return rng.normal(size=shape), rng.uniform(0.1, 0.5, shape), (rng.uniform(size=shape) < 0.7).astype(float)


def fading_weights(count, b):
    """Weights of equation (4), the start first: ``b^age`` over their sum."""
    weights = b ** np.arange(count, -1, -1.0)
    return weights / weights.sum()


@pytest.mark.parametrize("b", [1.0, 0.9])
def test_sage_husa_is_the_weighted_mean_of_the_available_samples(b):
    innovations, variances, available = data(0)
    level = adaptation.Level(np.full((2, BATCH), 1.5), np.ones((2, BATCH)))
    for nu, P, a in zip(innovations, variances, available, strict=True):
        level = adaptation.sage_husa(level, nu, P, b, -100.0, a)
    for i in np.ndindex(2, BATCH):
        there = available[(slice(None), *i)] > 0
        nu, P = innovations[(slice(None), *i)][there], variances[(slice(None), *i)][there]
        samples = [1.5, *(nu**2 - P)]
        # Sums of sixty terms in two orders.
        assert level.value[i] == pytest.approx(fading_weights(there.sum(), b) @ samples, rel=1e-13)


def test_weight_of_a_new_sample_is_that_of_the_paper():
    b, level = 0.95, adaptation.Level(np.zeros(1), np.ones(1))
    for k in range(1, 30):
        level = adaptation.fading_mean(level, np.ones(1), b)
        assert 1.0 / level.weight[0] == pytest.approx((1 - b) / (1 - b ** (k + 1)), rel=1e-14)


def test_unbiased_sage_husa_stays_above_its_floor():
    level = adaptation.Level(np.ones(1), np.ones(1))
    for _ in range(20):
        level = adaptation.sage_husa(level, np.zeros(1), np.ones(1), 0.9, 0.25)
        assert level.value[0] >= 0.25
    assert level.value[0] == 0.25


def test_mehra_is_the_mean_of_the_last_available_samples():
    innovations, variances, available = data(1)
    window = adaptation.start_window(np.full((2, BATCH), 0.8), 7)
    samples = {i: [0.8] * 7 for i in np.ndindex(2, BATCH)}
    for nu, P, a in zip(innovations, variances, available, strict=True):
        variance, window = adaptation.mehra(window, nu, P, 0.2, a)
        for i, seen in samples.items():
            if a[i]:
                seen.append(nu[i] ** 2 - P[i])
            assert variance[i] == pytest.approx(max(np.mean(seen[-7:]), 0.2), rel=1e-13)


def test_scalar_masks_are_those_of_every_element():
    level = adaptation.Level(np.ones(4), np.ones(4))
    one = adaptation.sage_husa(level, np.arange(4.0), np.ones(4), 0.9, 0.1)
    other = adaptation.sage_husa(level, np.arange(4.0), np.ones(4), 0.9, 0.1, np.ones(4))
    np.testing.assert_array_equal(one.value, other.value)
    window = adaptation.start_window(np.ones(4), 3)
    np.testing.assert_array_equal(adaptation.mehra(window, np.ones(4), np.ones(4), 0.1, 0.0)[1], window)


def kalman_step(x, P, R, z, F, Q, H):
    """Predicted and updated mean and covariance of one filter with matrices, and its gain."""
    x, P = F @ x, F @ P @ F.T + Q
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    return x + K @ (z - H @ x), P - K @ S @ K.T, x, P, K


F, Q, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.diag([0.2, 0.1]), np.array([[1.0, 0.0]])


def test_variational_bayes_is_the_table_of_its_paper():
    """One step of the algorithm in section III of Särkkä and Nummenmaa, with matrices, over a run."""
    rng = np.random.default_rng(2)
    x, P, alpha, beta, rho = np.zeros(2), np.eye(2), 1.0, 2.0, 0.97
    noise = adaptation.InverseGamma(np.array([alpha]), np.array([beta]))
    for _ in range(40):
        z = rng.normal(size=1)
        before = x, P

        def update(R, before=before, z=z):
            m, C, *_ = kalman_step(*before, np.diag(R), z, F, Q, H)
            return z - H @ m, np.diag(H @ C @ H.T), (m, C)

        noise, state = adaptation.variational_bayes(adaptation.forget(noise, rho), update, 3)
        # The paper's loop.
        alpha, predicted = 0.5 + rho * alpha, rho * beta
        beta = predicted
        for _ in range(3):
            m, C, *_ = kalman_step(x, P, np.array([[beta / alpha]]), z, F, Q, H)
            beta = predicted + 0.5 * float((z - H @ m)[0] ** 2) + 0.5 * float((H @ C @ H.T)[0, 0])
        x, P = m, C
        assert noise.variance[0] == pytest.approx(beta / alpha, rel=1e-13)
        # The quotient of alpha and beta may differ in the last bit.
        np.testing.assert_allclose(state[0], x, rtol=1e-13)


def test_without_a_measurement_a_distribution_is_what_it_was():
    noise = adaptation.InverseGamma(np.array([3.0]), np.array([2.0]))
    after, _ = adaptation.variational_bayes(
        adaptation.forget(noise, 0.9, 0.0), lambda R: (7.0 + R, R, None), 2, 0.0
    )
    assert (after.shape[0], after.scale[0]) == (3.0, 2.0)


def test_process_noise_factor_has_the_true_mean_and_stands_still_without_a_measurement():
    rng = np.random.default_rng(4)
    lanes, factor, R = 8, 3.0, np.eye(1)
    level = adaptation.Level(np.ones(lanes), np.ones(lanes))
    truth, x = np.zeros((lanes, 2)), np.zeros((lanes, 2))
    P = np.stack([np.eye(2)] * lanes)
    unit = np.diag(Q)
    for _ in range(1200):
        corrections, updated, carried = np.empty((3, 2, lanes))
        for lane in range(lanes):
            truth[lane] = F @ truth[lane] + np.sqrt(factor * unit) * rng.normal(size=2)
            z = H @ truth[lane] + rng.normal(size=1)
            carried[:, lane] = np.diag(F @ P[lane] @ F.T)
            x[lane], P[lane], predicted, *_ = kalman_step(x[lane], P[lane], R, z, F, level.value[lane] * Q, H)
            corrections[:, lane], updated[:, lane] = x[lane] - predicted, np.diag(P[lane])
        sample = adaptation.process_noise_factor(corrections, updated, carried, unit)
        level = adaptation.fading_mean(level, sample, 0.998)
        level = level._replace(value=np.maximum(level.value, 0.05))
    # Eight episodes of five hundred remembered measurements.
    assert level.value.mean() == pytest.approx(factor, rel=0.1)
    predicted = carried + 2.5 * unit[:, None]
    np.testing.assert_allclose(
        adaptation.process_noise_factor(np.zeros((2, lanes)), predicted, carried, unit), 2.5, rtol=1e-12
    )
