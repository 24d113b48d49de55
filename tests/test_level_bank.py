"""Control hypotheses of UavAutopilot: zero is the estimator, and what each factor does to the bank over levels."""

import math

import numpy as np
import pytest
from models import act, assert_no_action_is_the_estimator, make_model, watch_hypotheses

import filtergym  # noqa: F401  # registers the environments
from filtergym.envs.uav_autopilot.level_bank import LevelBank, grid
from filtergym.filters import noise_levels, packed_covariance

ID = "filtergym/UavAutopilot-v0"


def no_action(bank):
    return np.zeros(bank.action_space.shape)


@pytest.fixture(scope="module", params=["U", "P"])
def steered(request):
    """The bank, for every measurement its state as predicted and the measurement, and the estimator's answers."""
    model = make_model(ID, "hypotheses", "random", plant=request.param, horizon=80, dropout_period=20)
    bank = model.filter
    scans, answers = watch_hypotheses(model, LevelBank(model.task), "reading", no_action(model.filter))
    # Of single sensors or of all.
    assert 0.5 < np.mean([measurement.available for _, measurement in scans]) < 1.0
    return bank, scans, answers


def test_zero_hypotheses_is_the_estimator_bit_for_bit(steered):
    assert_no_action_is_the_estimator(*steered, no_action(steered[0]))


def test_hypotheses_multiplies_odds(steered):
    bank, scans, _ = steered
    prior, action = bank.own.prior, np.array([0.7, -0.4, *no_action(bank)[2:]])
    heights = np.log(grid(prior.gusts, prior.gust_points))
    expected = np.array([1.25**-0.4, *1.1 ** (0.7 * heights / heights[-1])])[:, None]
    for state, measurement in scans[::7]:
        before = act(bank, state, measurement, no_action(bank)).own.hypotheses.probability
        after = act(bank, state, measurement, action).own.hypotheses.probability
        product = np.where((measurement.available > 0.0).any(axis=0), expected, 1.0) * before
        np.testing.assert_allclose(after, product / product.sum(axis=0), rtol=1e-9, atol=1e-15)


def test_hypotheses_scales_noises(steered):
    """As if every hypothesis had been predicted with another process noise, and the sensors were others."""
    bank, scans, _ = steered
    inner, process = bank.own, 2.0**0.8
    sensors = [0.5, -0.7, 0.9][: len(inner.rows)]
    factors = 1.5 ** np.array(sensors)
    chosen = [k for k in range(1, len(scans)) if (scans[k][1].available > 0.0).any(axis=0).all()]
    assert len(chosen) > 20
    for k in chosen[::6]:
        state, measurement = scans[k]
        before = inner.switch(act(bank, *scans[k - 1], no_action(bank)).own.hypotheses)
        mean, covariance = inner.propagate(before, measurement)
        covariance = covariance + (process - 1.0) * inner.process
        for i, rows in enumerate(inner.rows):
            noise = noise_levels.SensorNoise(factors[i] * inner.variances[i], before.sensors[i])
            step = noise_levels.update_sensor(
                mean, covariance, measurement.reading[i], rows, noise, measurement.available[i]
            )
            mean, covariance = step.mean, step.covariance
        found = act(bank, state, measurement, [0.0, 0.0, 0.8, *sensors]).own.hypotheses
        np.testing.assert_allclose(found.mean, mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.covariance, covariance, rtol=1e-7, atol=1e-9)


def test_innovations_are_those_of_the_mixture(steered):
    """Of its moments, and of the noise that the hypotheses expect."""
    bank, scans, _ = steered
    inner, n = bank.own, len(bank.task.components)
    for state, measurement in scans[::9]:
        h, b = state.own.hypotheses, 3
        p = h.probability[:, b] / h.probability[:, b].sum()
        P = packed_covariance.unpack(h.covariance, inner.size)[..., b]
        x = h.mean[..., b] @ p
        spread = sum(
            w * (P[..., j] + np.outer(h.mean[:, j, b] - x, h.mean[:, j, b] - x)) for j, w in enumerate(p)
        )
        for i, rows in enumerate(inner.rows):
            H = np.isin(np.arange(inner.size), rows).astype(float)
            R = ((h.sensors[i][..., b] * inner.variances[i][..., 0]).sum(axis=0) * p).sum()
            expected = (measurement.reading[i, b] - H @ x) / math.sqrt(H @ spread @ H + R)
            expected *= measurement.available[i, b]
            np.testing.assert_allclose(state.innovation[i, b], expected, rtol=1e-8, atol=1e-10)
        weights = bank.trace_weights[:, 0]
        assert state.log_trace[b] == pytest.approx(math.log(weights @ np.diag(spread)[:n]), rel=1e-9)
