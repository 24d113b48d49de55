"""Interquartile means and profiles over training runs, against naive computations on repeated runs."""

import math

import numpy as np
import pytest
from records import ResultRecord
from scipy import stats
from seed_profiles import (
    interquartile_mean,
    interquartile_table,
    performance_profile,
    profile_figure,
    recorded_scores,
    run_weights,
)


def runs_of(counts, seed):
    rng = np.random.default_rng(seed)
    return [rng.normal(loc=m, size=count) for m, count in enumerate(counts)]


@pytest.mark.parametrize("counts", [(1,), (5, 5, 5, 5), (3, 5, 2)])
def test_statistics_against_repeated_runs(counts):
    """Runs that are repeated until environments have the same number, divisible by four, are what scipy trims."""
    scores = runs_of(counts, 0)
    most = math.lcm(*counts)
    repeated = np.concatenate([np.repeat(own, 4 * most // len(own)) for own in scores])
    pooled, weights = np.concatenate(scores), run_weights(counts, 0)
    # Sums of some tens of numbers of about one: a few rounding errors.
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-13)
    [found] = interquartile_mean(pooled, weights)
    assert found == pytest.approx(stats.trim_mean(repeated, 0.25), rel=1e-13, abs=1e-14)
    limits = np.linspace(-2.0, 5.0, 50)
    naive = [sum(score > limit for score in repeated) / len(repeated) for limit in limits]
    np.testing.assert_allclose(performance_profile(pooled, weights, limits)[0], naive, atol=1e-13)


def test_resamples_are_drawn_within_environments():
    counts = (3, 5)
    scores, weights = runs_of(counts, 1), run_weights(counts, 400)
    np.testing.assert_allclose(weights[:, :3].sum(axis=1), 0.5, rtol=1e-13)
    found = interquartile_mean(np.concatenate(scores), weights)
    for resample, own in zip(weights[1:], found[1:], strict=True):
        drawn = np.rint(resample * [6, 6, 6, 10, 10, 10, 10, 10]).astype(int)
        parts = [
            np.repeat(values, times) for values, times in zip(scores, (drawn[:3], drawn[3:]), strict=True)
        ]
        assert [len(part) for part in parts] == [3, 5]
        repeated = np.concatenate([np.repeat(part, 60 // len(part)) for part in parts])
        assert own == pytest.approx(stats.trim_mean(repeated, 0.25), rel=1e-12, abs=1e-13)
    # Environments are drawn independently of each other: of 400 resamples four standard errors.
    both = run_weights((4, 4), 400)[1:]
    assert abs(np.corrcoef(both[:, 0], both[:, 4])[0, 1]) < 4.0 / 20.0


def record_of(environment, reference, scores):
    runs, numbers = [], []
    for algorithm, values in scores.items():
        for seed, value in enumerate(values):
            name = f"{algorithm} seed {seed}"
            runs.append([name, algorithm, seed, 100, "train"])
            numbers.append([name, "run", "paper", "relative_cost_difference", "", -value, None, None])
            numbers.append([name, "run", reference, "score", "", value, None, None])
    numbers.append([reference, "opponent", reference, "score", "", 1.0, 1.0, 1.0])
    data = {"environment": environment, "runs": runs, "scenarios": {"random": numbers, "other": []}}
    return ResultRecord("seeds", "2026-01-01", {}, "", data)


@pytest.fixture
def records():
    return [
        record_of("filtergym/ManeuveringTarget-v0", "known-turn", {"a": [0.1, 0.2], "b": [0.5]}),
        record_of("filtergym/UavAutopilot-v0", "matched", {"a gated": [0.3], "b": [0.4, 0.6], "c": [0.9]}),
    ]


def test_only_environments_that_all_have_are_compared(records):
    scores = recorded_scores(records, ["b", "a"])
    assert {
        name: {own: values.tolist() for own, values in each.items()} for name, each in scores.items()
    } == {
        "b": {"ManeuveringTarget": [0.5], "UavAutopilot": [0.4, 0.6]},
        "a": {"ManeuveringTarget": [0.1, 0.2], "UavAutopilot": [0.3]},
    }
    assert {name: [*own] for name, own in recorded_scores(records).items()} == {
        key: ["UavAutopilot"] for key in "abc"
    }
    with pytest.raises(ValueError, match="no training runs of 'd': there are a, b, c"):
        recorded_scores(records, ["a", "d"])
    other = record_of("filtergym/UavAutopilot-v0", "matched", {"c": [0.9]})
    with pytest.raises(ValueError, match="no environment has training runs of all of a, c"):
        recorded_scores([records[0], other], ["a", "c"])


def test_table_and_figure_show_every_algorithm(records):
    scores = recorded_scores(records, ["a", "b"])
    head, _, best, worst = interquartile_table(scores).splitlines()
    assert "runs in ManeuveringTarget, UavAutopilot" in head
    assert best.startswith("| `b` | 1, 2 | 0.500 [0.450, 0.550]")
    assert worst.startswith("| `a` | 2, 1 | 0.")
    [axis] = profile_figure(scores).axes
    for line, own in zip(axis.lines, scores.values(), strict=True):
        limits, share = line.get_data()
        pooled, weights = np.concatenate([*own.values()]), run_weights([len(v) for v in own.values()], 0)
        np.testing.assert_array_equal(share, performance_profile(pooled, weights, limits)[0])
        assert (np.diff(share) <= 0.0).all()
