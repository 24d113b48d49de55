"""The unscented transform against filterpy and exact moments."""

import numpy as np
import pytest

import filtergym
from filtergym import Sensor
from filtergym.filters.unscented import Spread, sigma_points, transform, weights

SPREADS = [Spread(), Spread(0.5, 2.0, 0.0), Spread(1.0, 0.0, -2.0), Spread(1e-3, 2.0, 0.0)]


def gaussian(seed, n=5, batch=4):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n, batch))
    return rng.normal(size=(n, batch)), np.einsum("ijb,kjb->ikb", root, root) + 0.1 * np.eye(n)[..., None]


def curved(x):
    """Three numbers of five, of either library's shape."""
    return np.stack([x[0] * x[1], np.sin(x[2]) + x[3], x[4] ** 2])


@pytest.mark.parametrize("spread", SPREADS)
@pytest.mark.parametrize("seed", range(3))
def test_equals_filterpy(spread, seed):
    filterpy = pytest.importorskip("filterpy.kalman")
    mean, covariance = gaussian(seed)
    points = sigma_points(mean, covariance, spread)
    result = transform(mean, covariance, curved, spread)
    peer = filterpy.MerweScaledSigmaPoints(5, *spread)
    for mine, theirs in zip(weights(5, spread), (peer.Wm, peer.Wc), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9)  # n / alpha^2 - n, in two orders
    for b in range(mean.shape[1]):
        expected = peer.sigma_points(mean[:, b], covariance[..., b])
        # Two orders of alpha^2 (n + kappa), and a root of 1e-6 of the covariance.
        np.testing.assert_allclose(points[..., b].T, expected, rtol=1e-11, atol=1e-13)
        moved = np.stack([curved(point) for point in expected])
        y, P = filterpy.unscented_transform(moved, peer.Wm, peer.Wc)
        # Its mean is a sum of terms as large as 1 / alpha^2.
        tolerance = 1e-13 / spread.alpha**2
        np.testing.assert_allclose(result[0][:, b], y, rtol=tolerance, atol=10 * tolerance)
        np.testing.assert_allclose(result[1][..., b], P, rtol=1e3 * tolerance, atol=1e3 * tolerance)


@pytest.mark.parametrize("spread", SPREADS)
def test_moments_of_linear_and_quadratic_functions_are_exact(spread):
    mean, covariance = gaussian(7)
    A = np.random.default_rng(8).normal(size=(3, 5))
    y, P = transform(mean, covariance, lambda x: np.einsum("ij,j...->i...", A, x), spread)
    # Differences of points alpha apart lose its digits.
    tolerance = 1e-12 / spread.alpha
    np.testing.assert_allclose(y, A @ mean, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(
        P, np.einsum("ij,jkb,lk->ilb", A, covariance, A), rtol=tolerance, atol=tolerance
    )
    squares, _ = transform(mean, covariance, lambda x: x * x, spread)
    variances = np.stack([covariance[i, i] for i in range(5)])
    np.testing.assert_allclose(squares, mean**2 + variances, rtol=1e3 * tolerance)


@pytest.fixture
def updated(make):
    """Update of an unscented filter of n states that stand still by an angle."""

    def update(n, h, mean, covariance, R, z):
        cls = make(
            f=lambda x: [x[i] for i in range(n)],
            Q=(1e-15 * np.eye(n)).tolist(),
            sensors={
                "angle": Sensor(h, R=R, wraps="rad"),
                "curve": Sensor(lambda x: [np.sin(x[n - 1])], R=1.0),
            },
            mean=mean,
            covariance=covariance,
        )
        filter = filtergym.online(cls.id, "unscented")
        filter.start(mean=mean, covariance=covariance)
        return filter.update(angle=z)

    return update


@pytest.mark.parametrize("n", [2, 4, 9])
@pytest.mark.parametrize("variance", [1e-4, 1.0, (np.pi / 2) ** 2, 10.0, 100.0])
def test_a_heading_is_updated_right_at_any_spread(updated, n, variance):
    """Beside the product of prior and likelihood in the turn that is nearest to the prior mean."""
    mean, covariance, R = np.r_[0.5, np.zeros(n - 1)], np.diag([variance, *[0.01] * (n - 1)]), 0.04
    expected = 1.0 / (1.0 / variance + 1.0 / R) * (0.5 / variance + 1.5 / R)
    circle = lambda x: [np.arctan2(np.sin(x[0]), np.cos(x[0]))]  # noqa: E731
    for h in ([[1.0] + [0.0] * (n - 1)], circle):
        for turns in (-2, 0, 1):
            estimate = updated(n, h, mean, covariance, R, 1.5 + turns * 2.0 * np.pi)
            # The process noise adds 1e-15, and sin and cos of a few rad round at 1e-16.
            np.testing.assert_allclose(estimate.mean[0], expected, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(estimate.covariance[0, 0], 1.0 / (1.0 / variance + 1.0 / R), rtol=1e-9)
