"""Plots and tracks: every association written out for one episode at a time, and its mixture's moments."""

import math

import numpy as np
import pytest
from naive import positive_definite
from scipy.stats import multivariate_normal

from filtergym.filters import data_association

DETECTION, BATCH, PLOTS, STATES = 0.9, 5, 3, 4


def scan(seed):
    """Prediction, plots and variances of a batch; the last plot is NaN where there is none."""
    rng = np.random.default_rng(seed)
    mean, covariance = rng.normal(size=(STATES, BATCH)), positive_definite(rng, STATES, BATCH)
    plots = mean[:2, None] + 2.0 * rng.normal(size=(2, PLOTS, BATCH))
    variances = rng.uniform(0.2, 2.0, (2, PLOTS, BATCH))
    available = (rng.random((PLOTS, BATCH)) < 0.7).astype(float)
    available[:, 0] = 0.0
    plots[:, available == 0.0] = math.nan
    density = rng.uniform(0.02, 0.5, BATCH)
    return mean, covariance, plots, variances, available, density


@pytest.mark.parametrize("seed", range(5))
def test_update_has_the_moments_of_the_mixture_of_all_associations(seed):
    mean, covariance, plots, variances, available, density = scan(seed)
    found = data_association.update_position(
        mean, covariance, data_association.Plots(plots, variances, available), DETECTION, density
    )
    H = np.eye(2, STATES)
    for b in range(BATCH):
        x, P = mean[:, b], covariance[..., b]
        weights, means, covariances, distances = [1.0 - DETECTION], [x], [P], [0.0]
        for i in np.flatnonzero(available[:, b]):
            S = H @ P @ H.T + np.diag(variances[:, i, b])
            K = P @ H.T @ np.linalg.inv(S)
            nu = plots[:, i, b] - H @ x
            weights.append(DETECTION / density[b] * multivariate_normal.pdf(nu, cov=S))
            means.append(x + K @ nu)
            covariances.append((np.eye(STATES) - K @ H) @ P)
            distances.append(nu @ np.linalg.solve(S, nu))
        beta = np.array(weights) / sum(weights)
        expected = beta @ means
        spread = sum(
            w * (C + np.outer(m - expected, m - expected))
            for w, m, C in zip(beta, means, covariances, strict=True)
        )
        np.testing.assert_allclose(found.mean[:, b], expected, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(found.covariance[..., b], spread, rtol=1e-9, atol=1e-12)
        assert found.log_likelihood[b] == pytest.approx(math.log(sum(weights)), rel=1e-10)
        assert found.squared_distance[b] == pytest.approx(beta @ distances, rel=1e-10)


def test_distances_and_the_nearest_plot_in_the_gate():
    mean, covariance, plots, variances, available, _ = scan(3)
    plots = np.nan_to_num(plots)
    distances = data_association.squared_distances(mean[:2], covariance[:2, :2], plots, variances)
    present = available > 0.0
    gate = float(np.median(distances[present]))
    picked, inside = data_association.nearest_neighbour(distances, available, gate)
    for b in range(BATCH):
        expected, own = np.zeros(PLOTS), {}
        for i in np.flatnonzero(present[:, b]):
            S = covariance[:2, :2, b] + np.diag(variances[:, i, b])
            nu = plots[:, i, b] - mean[:2, b]
            own[i] = nu @ np.linalg.solve(S, nu)
            assert distances[i, b] == pytest.approx(own[i], rel=1e-10)
        if own and min(own.values()) < gate:
            expected[min(own, key=own.get)] = 1.0
        np.testing.assert_array_equal(picked[:, b], expected)
        assert inside[b] == expected.any()
    assert 0 < inside.sum() < BATCH


def test_of_plots_equally_near_the_first_is_taken_and_none_on_the_gate():
    distances = np.array([[2.0, 4.0, 1.0], [2.0, 4.0, 0.5]])
    available = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 0.0]])
    picked, inside = data_association.nearest_neighbour(distances, available, 4.0)
    np.testing.assert_array_equal(picked, [[1.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(inside, [True, False, True])
