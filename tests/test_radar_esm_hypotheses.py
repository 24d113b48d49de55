"""Control hypotheses of RadarEsmTracking: zero is the estimator, and what each factor does to Bayes' rule."""

import copy
import math

import numpy as np
import pytest
from models import act, assert_no_action_is_the_estimator, make_model, watch_hypotheses

import filtergym  # noqa: F401  # registers the environments
from filtergym.envs.contract.filter import FilterInput
from filtergym.envs.radar_esm_tracking.exact_bayes import ExactBayes
from filtergym.filters import packed_covariance

ID = "filtergym/RadarEsmTracking-v0"
NO_ACTION = np.zeros(7)


@pytest.fixture(scope="module")
def steered():
    """The bank, for every scan its state as predicted and the measurement, and the estimator's results."""
    model = make_model(ID, "hypotheses", "random", horizon=60, decision_interval=1)
    return model.filter, *watch_hypotheses(model, ExactBayes(model.task), "bearing_difference", NO_ACTION)


def quiet(bank, scans):
    """Scans at which no class changes."""
    return [scan for scan in scans if (scan[1].scan % bank.own.spacing != 0).all()]


def test_zero_hypotheses_is_the_estimator_bit_for_bit(steered):
    assert_no_action_is_the_estimator(*steered, NO_ACTION)


def test_hypotheses_multiplies_odds(steered):
    bank, scans, _ = steered
    action = np.array([0.7, -0.4, 0.2, 0.9, 0.0, 0.0, 0.0])
    expected = (1.15 ** action[:3])[:, None, None] * np.array([1.0, 1.3**0.9, 1.3**0.9, 1.3**0.9])[:, None]
    for state, measurement in quiet(bank, scans)[::7]:
        before = act(bank, state, measurement, NO_ACTION).own.tracks.weights
        after = act(bank, state, measurement, action).own.tracks.weights
        product = expected * before
        np.testing.assert_allclose(after, product / product.sum(axis=(0, 1)), rtol=1e-9, atol=1e-15)


def test_hypotheses_multiplies_the_odds_of_a_second_emitter(steered):
    bank, scans, _ = steered

    for state, measurement in quiet(bank, scans)[::7]:
        before, after = (
            bank.add_observed(state, bank.own.update(state.own, bank_input(measurement, action)), measurement)
            for action in (None, np.eye(7)[4] * math.log(2.0))
        )
        p = before.second_emitter
        np.testing.assert_allclose(after.second_emitter, 2.0 * p / (1.0 + p), rtol=1e-10)


def bank_input(measurement, logarithms):
    """A measurement for the filter itself, with the logarithms of factors."""
    return FilterInput(measurement, None, None if logarithms is None else logarithms[:, None])


def test_hypotheses_scales_noises(steered):
    """As if the process noise and the radar's were others."""
    bank, scans, _ = steered
    other = copy.copy(bank.own)
    other.Q, other.variance = 2.0**0.8 * bank.own.Q, 1.35**-0.6 * bank.own.variance
    for state, measurement in scans[::9]:
        found = act(bank, state, measurement, [0.0] * 5 + [0.8, -0.6]).own
        expected = other.update(state.own, bank_input(measurement, None))
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-9)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-7)
        np.testing.assert_allclose(found.tracks.weights, expected.tracks.weights, rtol=1e-7, atol=1e-15)


def test_innovations_and_class_estimates_are_those_of_the_mixture(steered):
    bank, scans, _ = steered
    own, n, b = bank.own, bank.own.states, 2
    F, Q = own.F[..., 0, 0], own.Q[..., 0, 0]
    for state, measurement in scans[::11]:
        tracks = state.own.tracks
        P = packed_covariance.unpack(tracks.covariance, n)[..., b]
        pairs = [(s, h) for s in range(3) for h in range(tracks.weights.shape[1])]
        w = np.array([tracks.weights[s, h, b] for s, h in pairs])
        means = [F[..., s] @ tracks.mean[:, s, h, b] for s, h in pairs]
        spreads = [F[..., s] @ P[:, :, s, h] @ F[..., s].T + Q[..., s] for s, h in pairs]
        x = sum(p * m for p, m in zip(w, means, strict=True))
        total = sum(p * (V + np.outer(m - x, m - x)) for p, m, V in zip(w, means, spreads, strict=True))[
            :2, :2
        ]
        R = own.variance[:, 0, 0, 0]
        expected = np.linalg.solve(np.linalg.cholesky(total + np.diag(R)), measurement.radar[:, b] - x[:2])
        np.testing.assert_allclose(state.innovation[:, b], expected, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(state.prior[:, b], 0.5 * np.log(np.diag(total) / R), rtol=1e-7, atol=1e-9)
        for s in range(3):
            share = tracks.weights[s, :, b]
            assert state.probabilities[s, b] == pytest.approx(share.sum(), rel=1e-12)
            estimate = tracks.mean[:3, s, :, b] @ share / share.sum()
            np.testing.assert_allclose(state.mean[:, s, b], estimate, rtol=1e-10)


def test_probabilities_of_groups_sum_to_one(steered):
    bank, scans, _ = steered
    for state, measurement in scans:
        np.testing.assert_allclose(state.predicted.sum(axis=0), 1.0, rtol=1e-8)
        np.testing.assert_allclose(state.probability.sum(axis=0), 1.0, rtol=1e-12)
        assert ((state.second_emitter >= 0.0) & (state.second_emitter <= 1.0)).all()
        assert ((state.entropy >= -1e-12) & (state.entropy <= 1.0 + 1e-12)).all()
        assert (state.used == (measurement.decision < bank.task.types)).all()
