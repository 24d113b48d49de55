"""``filters/noise_levels.py`` against the interacting multiple model and Kalman filters written out."""

import math

import numpy
import pytest
from naive import positive_definite

from filtergym.filters import imm, noise_levels, packed_covariance
from filtergym.filters.noise_levels import LevelHypotheses, SensorNoise

n, H, L, N = 3, 4, 5, 6


def normalised(values: numpy.ndarray) -> numpy.ndarray:
    return values / values.sum(axis=0)


def some(seed: int) -> tuple[numpy.random.Generator, LevelHypotheses, numpy.ndarray]:
    """Hypotheses, and their covariances as matrices."""
    rng = numpy.random.default_rng(seed)
    P = positive_definite(rng, n, H, N)
    q = tuple(normalised(rng.random((L, H, N))) for _ in range(2))
    h = LevelHypotheses(
        rng.standard_normal((n, H, N)), packed_covariance.pack(P), normalised(rng.random((H, N))), q
    )
    return rng, h, P


@pytest.mark.parametrize("seed", range(3))
def test_switching_is_the_mixing_of_an_imm_with_that_matrix(seed: int) -> None:
    rng, h, P = some(seed)
    change, prior = rng.random((H, 1)), normalised(rng.random((H, 1)))
    sensor_change, levels = rng.random((H, 1)), normalised(rng.random((L, 1, 1)))
    after = noise_levels.switch(h, change, prior, sensor_change, levels)
    transition = numpy.diag(1.0 - change[:, 0]) + change * prior.T
    numpy.testing.assert_allclose(transition.sum(axis=1), 1.0, rtol=1e-15)
    prediction = imm.predict_mode_probabilities(transition, h.probability)
    mean, covariance = imm.mix(h.mean, P, prediction.mixing)
    # The same moments summed in another order.
    numpy.testing.assert_allclose(after.probability, prediction.probabilities, rtol=1e-14)
    numpy.testing.assert_allclose(after.mean, mean, rtol=0, atol=1e-14)
    numpy.testing.assert_allclose(
        packed_covariance.unpack(after.covariance, n), covariance, rtol=0, atol=1e-13
    )
    for q, found in zip(h.sensors, after.sensors, strict=True):
        mixed = numpy.einsum("lin,ijn->ljn", q, prediction.mixing)
        expected = (1.0 - sensor_change) * mixed + sensor_change * levels
        numpy.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


def test_a_hypothesis_that_was_ruled_out_comes_back() -> None:
    _, h, _ = some(0)
    h = h._replace(probability=numpy.concatenate([0.0 * h.probability[:1], normalised(h.probability[1:])]))
    change = numpy.full((H, 1), 0.01)
    unweighted = numpy.array([[0.0], [0.5], [0.25], [0.25]])
    for prior in (unweighted, unweighted[::-1]):
        after = noise_levels.switch(h, change, prior, change, numpy.full((L, 1, 1), 1.0 / L))
        assert all(numpy.isfinite(part).all() for part in (*after[:3], *after.sensors))
        assert (after.probability > 0.0).all()
    assert (after.probability[0] > 0.002).all()


@pytest.mark.parametrize("outlier", [0.0, 0.1])
@pytest.mark.parametrize("rows", [(1,), (0, 2)])
def test_an_update_is_that_of_a_kalman_filter_for_every_level_merged(
    rows: tuple[int, ...], outlier: float
) -> None:
    rng, h, P = some(1)
    variances = numpy.sort(rng.random((L, H, 1)), axis=0) + 0.01
    q, z = h.sensors[0], 2.0 * rng.standard_normal(N)
    available = numpy.array([1.0, 1.0, 0.0, 1.0, 1.0, 0.0])
    noise = SensorNoise(variances, q, outlier, 9.0)
    found = noise_levels.update_sensor(h.mean, h.covariance, z, rows, noise, available)
    C = numpy.zeros(n)
    C[list(rows)] = 1.0
    for j in range(H):
        for lane in range(N):
            x, S0 = h.mean[:, j, lane], P[:, :, j, lane]
            if not available[lane]:
                numpy.testing.assert_array_equal(found.mean[:, j, lane], x)
                numpy.testing.assert_array_equal(found.levels[:, j, lane], q[:, j, lane])
                assert found.log_density[j, lane] == 0.0 == found.nis[j, lane]
                continue
            R = [*variances[:, j, 0], *[9.0] * bool(outlier)]
            prior = [*((1.0 - outlier) * q[:, j, lane]), *[outlier] * bool(outlier)]
            densities, means, matrices, distances = [], [], [], []
            for r in R:
                S = C @ S0 @ C + r
                K, nu = S0 @ C / S, z[lane] - C @ x
                densities.append(math.exp(-0.5 * nu * nu / S) / math.sqrt(2.0 * math.pi * S))
                means.append(x + K * nu)
                joseph = numpy.eye(n) - numpy.outer(K, C)
                matrices.append(joseph @ S0 @ joseph.T + r * numpy.outer(K, K))
                distances.append(nu * nu / S)
            weights = numpy.array(prior) * densities
            assert found.log_density[j, lane] == pytest.approx(math.log(weights.sum()), rel=1e-12, abs=1e-12)
            weights = weights / weights.sum()
            mean = weights @ numpy.array(means)
            spread = sum(
                w * (M + numpy.outer(m - mean, m - mean))
                for w, M, m in zip(weights, matrices, means, strict=True)
            )
            # Two forms of the covariance of numbers about one.
            numpy.testing.assert_allclose(found.mean[:, j, lane], mean, rtol=0, atol=1e-12)
            numpy.testing.assert_allclose(
                packed_covariance.unpack(found.covariance, n)[:, :, j, lane], spread, rtol=0, atol=1e-12
            )
            levels = weights[:L] + (weights[L] * q[:, j, lane] if outlier else 0.0)
            numpy.testing.assert_allclose(found.levels[:, j, lane], levels, rtol=0, atol=1e-13)
            assert found.nis[j, lane] == pytest.approx(weights @ distances, rel=1e-11)


def test_sums_of_coordinates_are_read_like_single_ones() -> None:
    rng, h, P = some(2)
    rows, R = ((0, 2), (1,)), numpy.array([0.3, 0.7])
    mean, packed, z = h.mean[:, 0], h.covariance[:, 0], rng.standard_normal((2, N))
    found = packed_covariance.update_coordinates(mean, packed, z, rows, R, numpy.ones((2, N)))
    C = numpy.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    for lane in range(N):
        S0 = P[:, :, 0, lane]
        S, nu = C @ S0 @ C.T + numpy.diag(R), z[:, lane] - C @ mean[:, lane]
        K = S0 @ C.T @ numpy.linalg.inv(S)
        numpy.testing.assert_allclose(found.mean[:, lane], mean[:, lane] + K @ nu, rtol=0, atol=1e-12)
        after = packed_covariance.unpack(found.covariance, n)[:, :, lane]
        numpy.testing.assert_allclose(after, S0 - K @ C @ S0, rtol=0, atol=1e-12)
        assert found.squared_distance[lane] == pytest.approx(nu @ numpy.linalg.solve(S, nu), rel=1e-11)
