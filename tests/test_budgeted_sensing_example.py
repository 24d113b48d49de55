"""The example of budgeted sensing: its bank against naive filters, its policies' arithmetic, the bound on schedules."""

import math
from pathlib import Path

import numpy as np
import pytest
import scipy
from contract import assert_equals_its_vector
from models import begin, load_module, make_model, next_row

ROOT = Path(__file__).parent.parent
ID = "mine/BudgetedSensing-v0"


@pytest.fixture(scope="module")
def example():
    yield from load_module(ROOT / "docs" / "examples" / "budgeted_sensing.py")


def run(example, steps, episodes, actions=None, **parameters):
    """Truth, measurement, prediction and the bank's state at each of some measurements."""
    model = make_model(ID, "beam", backend="numpy", **parameters)
    rng = np.random.default_rng(0)
    episode, kept = begin(model, rng, episodes), []
    for k in range(steps):
        predicted = model.measure(episode, next_row(model, rng, episodes))
        action = np.full(episodes, k % 4) if actions is None else actions[k]
        episode = model.act(predicted, action)
        kept.append((predicted.truth, predicted.measurement, predicted.filter, episode.filter))
    return model, kept


def test_environment(example):
    assert_equals_its_vector(ID, [k % 4 for k in range(5)], render=False, horizon=5)


def test_targets_that_cannot_manoeuvre_are_followed_by_a_kalman_filter(example):
    """All hypotheses are then one: what merging and ages leave is rounding."""
    _, kept = run(example, 12, 3, agility=(1e-9, 1e-9))
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    for j in range(4):
        for lane in range(3):
            x, P = np.zeros(2), np.diag([2500.0, 900.0])
            for k, (_, m, _, state) in enumerate(kept):
                x, P = F @ x, F @ P @ F.T
                if k % 4 == j:
                    S = P[0, 0] + m.sigma[j, lane] ** 2
                    x, P = x + P[:, 0] * (m.position[j, lane] - x[0]) / S, P - np.outer(P[:, 0], P[0]) / S
                np.testing.assert_allclose(state.mean[:2, j, lane], x, rtol=1e-9, atol=1e-9)
                np.testing.assert_allclose(state.covariance[:2, :2, j, lane], P, rtol=1e-9, atol=1e-9)


def test_what_is_not_looked_at_changes_nothing_and_what_is_beyond_the_beam_neither(example):
    model, kept = run(example, 3, 8, beam=200.0)
    _, measurement, predicted, _ = kept[-1]
    bank, action = example.BeamBank(model.task, "beam"), np.full(8, 2)
    after = bank.act(predicted, measurement, action)
    others = measurement.position + np.array([[1e3], [-1e3], [0.0], [1.0]])
    same = bank.act(predicted, measurement._replace(position=others), action)
    np.testing.assert_array_equal(after.mean, same.mean)
    np.testing.assert_array_equal(after.mean[:, [0, 1, 3]], predicted.mean[:, [0, 1, 3]])
    assert (after.mean[0, 2] != predicted.mean[0, 2]).all()
    np.testing.assert_array_equal(after.waited[2], 0.0)
    beyond = predicted.mean[0] + np.array([[0.0], [0.0], [200.1], [0.0]])
    missed = bank.act(predicted, measurement._replace(position=beyond), action)
    np.testing.assert_array_equal(missed.mean, predicted.mean)


def test_the_expected_cost_is_the_integral(example):
    model = make_model(ID, "beam", backend="numpy", lost=300.0)
    greedy = example.Greedy(model)
    for sigma in (10.0, 200.0, 1000.0):
        P = np.full((3, 3, 1), sigma**2)
        density = lambda e, s=sigma: min(e * e, 300.0**2) * scipy.stats.norm.pdf(e, scale=s)  # noqa: E731
        parts = [scipy.integrate.quad(density, a, b)[0] for a, b in ((0, 300), (300, 20 * sigma + 300))]
        assert greedy.cost(P)[0] == pytest.approx(2.0 * sum(parts), rel=1e-6)


def test_a_look_is_planned_as_by_trying_all(example):
    """The rollout of one problem against loops over pairs of looks."""
    model, kept = run(example, 6, 1)
    _, m, predicted, _ = kept[-1]
    rollout, P, R = example.Rollout(model), predicted.covariance, m.sigma**2
    context, best = {"agility": m.agility}, []
    for first in range(4):
        totals = []
        for second in range(4):
            state, total = P.copy(), 0.0
            for k in range(6):
                gain = rollout.cost(state) - rollout.cost(example.updated(state, R))
                j = (first, second)[k] if k < 2 else int(gain[:, 0].argmax())
                state[..., j, :] = example.updated(state, R)[..., j, :]
                total += rollout.cost(state).sum()
                state = example.later(state, m.agility)
            totals.append(total)
        best.append(-min(totals))
    np.testing.assert_allclose(rollout.index(P, R, context)[:, 0], best, rtol=1e-9)


def test_no_schedule_costs_less_than_the_bound(example):
    """And where targets are alike, one after the other is as good."""
    file = ROOT / "benchmarks" / "budgeted_sensing.py"
    bench = next(load_module(file, "benchmarks_budgeted_sensing"))
    model = make_model(ID, "beam", backend="numpy")
    rng = np.random.default_rng(1)
    agility, sigma = rng.uniform(1.0, 10.0, (4, 2)), rng.uniform(5.0, 50.0, (4, 2))
    agility[:, 0], sigma[:, 0] = 3.0, 15.0
    bound = bench.relaxed_bound(bench.spaced_costs(sigma**2, agility))
    for name in ("round-robin", "greedy"):
        cost = bench.scheduled_costs(example.POLICIES[name](model), sigma**2, agility)
        assert (cost >= bound * (1.0 - 1e-3)).all()
        assert math.isclose(cost[0], bound[0], rel_tol=1e-3)
