"""Control hypotheses of TightlyCoupledNavigation: zero is the estimator, and what each factor does to the bank."""

import copy
import math

import numpy as np
import pytest
from models import act, assert_no_action_is_the_estimator, make_model, watch_hypotheses

import filtergym  # noqa: F401  # registers the environments
from filtergym.envs.tightly_coupled_navigation.fault_hypotheses import FaultHypotheses

ID = "filtergym/TightlyCoupledNavigation-v0"
ZERO = np.zeros(8)


@pytest.fixture(scope="module")
def steered():
    """The bank, for every measurement its state as predicted and the measurement, and the estimator's answers."""
    faults = {
        "horizon": 80, "urban_probability": 0.5, "leg_duration": (0.1, 0.4), "stick_probability": 1.0,
        "stick_duration": (0.1, 0.3), "rates_outage_probability": 0.5, "rates_outage_duration": (0.1, 0.3),
    }  # fmt: skip
    model = make_model(ID, "hypotheses", "random", **faults)
    bank = model.filter
    # A leg may end from the start, or no manoeuvre would begin so early.
    bank.own, estimator = (FaultHypotheses(model.task, quiet=0.0) for _ in range(2))
    scans, answers = watch_hypotheses(model, estimator, "readings", ZERO)
    assert max(state.expected[3].max() for state, _ in scans) > 0.1
    assert 0.0 < np.mean([state.between for state, _ in scans]) < 1.0
    assert 0.0 < np.mean([state.repeated for state, _ in scans]) < 1.0
    assert 0.0 < np.mean([measurement.available for _, measurement in scans]) < 1.0
    return bank, scans, answers


def test_zero_hypotheses_is_the_estimator_bit_for_bit(steered):
    bank, scans, answers = steered
    assert_no_action_is_the_estimator(bank, scans, answers, ZERO)
    for (state, measurement), (_, _, memory, _) in zip(scans, answers, strict=True):
        found = bank.records(act(bank, state, measurement, ZERO), measurement)["mode_probability"]
        np.testing.assert_array_equal(found, memory.hypotheses.probabilities)


def test_hypotheses_multiplies_odds_of_a_manoeuvre(steered):
    bank, scans, _ = steered
    factors = np.array([1.0, 1.0, 1.05**-0.4, 4.0**0.7])[:, None]
    for state, measurement in scans[::7]:
        rest, line, manoeuvre, begun = factors * state.expected
        expected = np.stack([rest, line, manoeuvre + begun])
        found = act(bank, state, measurement, [0.7, -0.4, *ZERO[2:]]).probabilities
        np.testing.assert_allclose(found, expected / expected.sum(axis=0), rtol=1e-9, atol=1e-15)


def test_hypotheses_scales_renewals_levels_and_noises(steered):
    """As if the bank expected other renewals, levels, and noises of motion and sensors."""
    bank, scans, _ = steered
    action = [0.0, 0.0, 0.6, -0.8, 0.9, 0.5, -0.7, 0.4]
    renewal, level, motion, pseudoranges, rates, accelerometers = (
        np.array([4.0, 1.5, 2.0, 2.0, 2.0, 4.0]) ** action[2:]
    )
    task, S = copy.copy(bank.task), bank.task.satellites
    scale = [pseudoranges] * S + [rates] * S + [accelerometers] * 3 + [1.0] * 3
    task.sensor_variance = [factor * r for factor, r in zip(scale, task.sensor_variance, strict=True)]
    heights = np.log(bank.own.prior.levels) / math.log(bank.own.prior.levels[-1])

    class Other(FaultHypotheses):
        def _move_levels(self, levels):
            q = (level**heights)[:, None] * super()._move_levels(levels)
            return q / q.sum(axis=0)

    other = Other(task, bank.own.prior)
    other.noise = motion * other.noise
    odds = renewal * other.lost / (1.0 - other.lost)
    other.lost = odds / (1.0 + odds)
    rate = slice(S, 2 * S)
    for state, measurement in scans[::9]:
        expected = other.examine(state.own, measurement).after
        found = act(bank, state, measurement, action).own
        # Pseudoranges of 2e7 m are known to 4e-9 m.
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-8, atol=1e-7)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-7, atol=1e-8)
        found, expected = found.hypotheses, expected.hypotheses
        np.testing.assert_allclose(found.probabilities, expected.probabilities, rtol=1e-7, atol=1e-12)
        there = measurement.available[rate] > 0.0
        levels = np.where(there, expected.levels, 0.0)
        np.testing.assert_allclose(np.where(there, found.levels, 0.0), levels, rtol=1e-7, atol=1e-12)


def test_what_the_bank_believes_are_probabilities(steered):
    bank, scans, _ = steered
    for state, measurement in scans[::9]:
        for weights in (np.exp(state.log_predicted), state.expected):
            np.testing.assert_allclose(weights.sum(axis=0), 1.0, rtol=1e-12)
        rest, line, manoeuvre, begun = state.expected
        after = act(bank, state, measurement, ZERO).probabilities
        np.testing.assert_allclose(after, [rest, line, manoeuvre + begun], rtol=1e-12, atol=1e-300)
        assert ((state.noisy >= 0.0) & (state.noisy <= 1.0)).all()
