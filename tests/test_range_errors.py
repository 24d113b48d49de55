"""Range errors that last, beside dense matrices and mixtures written out."""

import math

import numpy
import pytest
from scipy.stats import norm

from filtergym.filters import gnss_ins, range_errors
from filtergym.filters.extended_kalman import JacobianRow

S, SIZE = 4, gnss_ins.SIZE + 4


def covariance_of(generator, lanes):
    root = generator.normal(size=(SIZE, SIZE, lanes))
    return numpy.einsum("ikn,jkn->ijn", root, root)


def test_prediction_is_the_dense_product():
    generator = numpy.random.default_rng(1)
    common = gnss_ins.common_model(0.01, 0.009, 0.036, 1e-4, 3e-4, 100.0)
    models = gnss_ins.constant_velocity_model(0.01, 0.02, 0.05), gnss_ins.singer_model(0.01, 0.05, 18.0)
    Q = numpy.zeros((SIZE, SIZE, 2, 1))
    for i, model in enumerate(models):
        Q[:17, :17, i, 0] = gnss_ins.process_noise(model, common)
    axis = numpy.stack([m.transition for m in models], axis=-1)[..., None]
    mean, P = generator.normal(size=(SIZE, 2, 3)), numpy.stack([covariance_of(generator, 3)] * 2, axis=2)
    kept, gained = numpy.array([1.0, 0.9, 0.5]), numpy.array([0.0, 0.3, 2.0])
    found, spread = range_errors.predict(mean, P, axis, 0.01, common.decay, Q, kept, gained)
    for i in range(2):
        F = numpy.zeros((SIZE, SIZE))
        F[:17, :17] = gnss_ins.advance(numpy.eye(17)[:, :, None, None], axis[:, :, [i]], 0.01, common.decay)[
            ..., 0, 0
        ]
        for lane in range(3):
            F[17:, 17:] = kept[lane] * numpy.eye(S)
            own = numpy.diag([0.0] * 17 + [gained[lane]] * S)
            # The same products in another order.
            numpy.testing.assert_allclose(found[:, i, lane], F @ mean[:, i, lane], rtol=1e-13, atol=1e-13)
            dense = F @ P[:, :, i, lane] @ F.T + Q[:, :, i, 0] + own
            numpy.testing.assert_allclose(spread[:, :, i, lane], dense, rtol=1e-12, atol=1e-12)


def test_a_reading_with_levels_has_the_moments_of_the_mixture():
    generator = numpy.random.default_rng(2)
    P, row = covariance_of(generator, 5), JacobianRow((0, 4, 18), (0.3, -0.8, 1.0))
    h = numpy.zeros(SIZE)
    h[list(row.columns)] = row.values
    residual, levels, q = 8.0 * generator.normal(size=5), numpy.array([0.5, 4.0, 90.0]), [0.7, 0.2, 0.1]
    state, shares = range_errors.take_reading(
        range_errors.begin(numpy.zeros((SIZE, 5)), P),
        residual,
        row,
        levels[:, None],
        numpy.array(q)[:, None],
        numpy.ones(5),
    )
    for lane in range(5):
        variance = h @ P[:, :, lane] @ h + levels
        terms = q * norm.pdf(residual[lane], scale=numpy.sqrt(variance))
        weights = terms / terms.sum()
        gains = [P[:, :, lane] @ h / s for s in variance]
        means = [gain * residual[lane] for gain in gains]
        mean = sum(w * m for w, m in zip(weights, means, strict=True))
        spread = sum(
            w * (P[:, :, lane] - numpy.outer(g, g) * s + numpy.outer(m - mean, m - mean))
            for w, g, s, m in zip(weights, gains, variance, means, strict=True)
        )
        # Sums of squares of some tens: the short form rounds relative to the covariance before the update.
        numpy.testing.assert_allclose(state.shift[:, lane], mean, rtol=1e-10, atol=1e-12)
        numpy.testing.assert_allclose(state.covariance[:, :, lane], spread, rtol=1e-9, atol=1e-10)
        numpy.testing.assert_allclose(shares[:, lane], weights, rtol=1e-10)
        assert state.log_likelihood[lane] == pytest.approx(math.log(terms.sum()), rel=1e-12)


def test_a_pseudorange_is_weighed_and_merged_as_stated():
    generator = numpy.random.default_rng(3)
    lanes, place, row = 6, 18, JacobianRow((0, 1, 2, 3, 18), (0.5, -0.4, 0.7, 1.0, 1.0))
    h = numpy.zeros(SIZE)
    h[list(row.columns)] = row.values
    P, shift = covariance_of(generator, lanes), generator.normal(size=(SIZE, lanes))
    predicted, residual = generator.normal(size=lanes), 12.0 * generator.normal(size=lanes)
    renewal = range_errors.Renewal(
        numpy.array([0.0, 0.2, 0.2, 0.5, 1.0, 0.3]), numpy.array(7.0), numpy.array(40.0)
    )
    available = numpy.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    before = range_errors.begin(numpy.zeros((SIZE, lanes)), P)._replace(shift=shift)
    after = range_errors.take_pseudorange(before, predicted, place, residual, row, 9.0, renewal, available)
    for lane in range(lanes):
        p = renewal.probability[lane]
        new_P, new_shift = P[:, :, lane].copy(), shift[:, lane].copy()
        new_P[place] = new_P[:, place] = 0.0
        new_P[place, place], new_shift[place] = 40.0, 7.0 - predicted[lane]
        pairs = (shift[:, lane], P[:, :, lane]), (new_shift, new_P)
        terms = [
            weight * norm.pdf(residual[lane] - h @ x, scale=math.sqrt(h @ C @ h + 9.0))
            for weight, (x, C) in zip((1.0 - p, p), pairs, strict=True)
        ]
        pi = terms[1] / sum(terms) if available[lane] else p
        x = (1.0 - pi) * pairs[0][0] + pi * pairs[1][0]
        C = sum(w * (C + numpy.outer(m - x, m - x)) for w, (m, C) in zip((1.0 - pi, pi), pairs, strict=True))
        if available[lane]:
            s = h @ C @ h + 9.0
            x, C = x + C @ h / s * (residual[lane] - h @ x), C - numpy.outer(C @ h, C @ h) / s
            assert after.log_likelihood[lane] == pytest.approx(math.log(sum(terms)), rel=1e-9)
        else:
            assert after.log_likelihood[lane] == 0.0
        # A probability of one is taken as one minus 1e-12.
        numpy.testing.assert_allclose(after.shift[:, lane], x, rtol=1e-8, atol=1e-9)
        numpy.testing.assert_allclose(after.covariance[:, :, lane], C, rtol=1e-8, atol=1e-8)


def test_start_has_errors_of_zero_that_nothing_correlates():
    mean, P = numpy.arange(34.0).reshape(17, 2), numpy.ones((17, 17, 2))
    found, spread = range_errors.start(mean, P, S, numpy.array([2.0, 3.0]))
    assert (found[:17] == mean).all()
    assert (found[17:] == 0.0).all()
    assert (spread[:17, :17] == P).all()
    assert (spread[17:, :17] == 0.0).all()
    assert (spread[:17, 17:] == 0.0).all()
    assert (spread[17:, 17:, 1] == 3.0 * numpy.eye(S)).all()


def test_observation_has_the_errors_and_their_derivatives():
    generator = numpy.random.default_rng(4)
    state = numpy.concatenate([generator.normal(size=17), generator.normal(size=S)])
    position, velocity = 2e7 * (1.0 + generator.random((3, S))), 3e3 * generator.normal(size=(3, S))
    angles = generator.normal(size=3)
    seen, rows = range_errors.observe(state, position, velocity, angles, 9.81)
    plain, plain_rows = gnss_ins.observe(state[:17], position, velocity, angles, 9.81)
    assert (seen[:S] == plain[:S] + state[17:]).all()
    assert (seen[S:] == plain[S:]).all()
    assert [row.columns[-1] for row in rows[:S]] == [17, 18, 19, 20]
    assert all(row.values[-1] == 1.0 for row in rows[:S])
    assert [row.columns for row in rows[S:]] == [row.columns for row in plain_rows[S:]]
