"""Intervals of one episode over time: against naive code, and for what they promise."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from filtergym import evaluate, tidy_records
from filtergym.evaluation.running.metrics import bootstrap_of
from filtergym.evaluation.statistics import time_blocks
from filtergym.evaluation.statistics.time_blocks import FEWEST_BLOCKS, BlockBootstrap, TimeUnits, block_length
from filtergym.evaluation.storage.dataset import groups_of

ENV = "filtergym/ManeuveringTarget-v0"


def autoregressive(generator, correlation, number):
    """Errors of a filter whose errors are correlated in time."""
    return lfilter([1.0], [1.0, -correlation], generator.normal(size=number + 300))[300:]


def over_time(series, *settings):
    """The resampling of one series, and what its units contribute to the mean."""
    units = TimeUnits(len(series))
    sums = units.sums_of_present(series[None])
    return BlockBootstrap(units, [sums], *settings), sums


def naive_length(series):
    """Politis and White (2004) with the correction of 2009, lag by lag."""
    n, x = len(series), series - series.mean()
    quiet = max(5, math.ceil(math.sqrt(math.log10(n))))
    most = math.ceil(math.sqrt(n)) + quiet
    R = [sum(x[i] * x[i + k] for i in range(n - k)) / n for k in range(most + 1)]
    small = [abs(R[k] / R[0]) < 2.0 * math.sqrt(math.log10(n) / n) for k in range(most + 1)]
    m = next(m for m in range(most) if all(small[m + 1 : m + 1 + quiet]))
    M = min(2 * max(m, 1), most)
    taper = [1.0 if k <= M / 2 else 2.0 * (1.0 - k / M) for k in range(M + 1)]
    G = 2.0 * sum(taper[k] * k * R[k] for k in range(1, M + 1))
    g = R[0] + 2.0 * sum(taper[k] * R[k] for k in range(1, M + 1))
    return math.ceil((2.0 * G**2 / (4.0 / 3.0 * g**2)) ** (1 / 3) * n ** (1 / 3))


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_blocks_have_the_length_of_the_rule(correlation):
    series = autoregressive(np.random.default_rng(3), correlation, 600)
    assert block_length(series) == naive_length(series)
    assert block_length(np.ones(50)) == 1
    assert block_length(np.full(50, np.nan)) == 1


def test_resamples_are_blocks_that_go_on_at_the_start():
    generator = np.random.default_rng(0)
    series = autoregressive(generator, 0.5, 800)
    series[generator.random(800) < 0.1] = np.nan
    bootstrap, sums = over_time(series, 30, 7)
    assert bootstrap.block > 3
    begins = np.random.default_rng(7).integers(800, size=(30, math.ceil(800 / bootstrap.block)))
    wrapped = np.concatenate([series, series])
    expected = [np.nanmean(np.concatenate([wrapped[i : i + bootstrap.block] for i in own])) for own in begins]
    found = bootstrap.resample(np.array([np.nanmean(series)]), sums)
    # Sums in another order.
    np.testing.assert_allclose(found, [np.nanmean(series), *expected], rtol=1e-12, atol=1e-14)


CORRELATED = {
    0.0: (1.0, 1.0, 1.0), 0.5: (0.9, 1.0, 1.0), 0.95: (0.0, 0.0, 1.0), 0.99: (0.0, 0.0, 0.0),
}  # fmt: skip
"""Of a process with this correlation, shares of 200, 1,000 and 10,000 measurements of which there is an interval."""


@pytest.mark.parametrize(("correlation", "known"), CORRELATED.items())
def test_interval_of_a_correlated_error_has_its_coverage_or_is_missing(correlation, known):
    """The mean square of an error with AR(1); with intervals for all, those of 200 at 0.99 would cover a third."""
    generator, truth, trials = np.random.default_rng(1), 1.0 / (1.0 - correlation**2), 120
    for number, share in zip((200, 1000, 10_000), known, strict=True):
        found = []
        for _ in range(trials if number < 10_000 else 40):
            squares = autoregressive(generator, correlation, number) ** 2
            bootstrap, sums = over_time(squares, 100)
            assert (bootstrap.blocks >= FEWEST_BLOCKS) == ("are over time" in bootstrap.sentence)
            found.append(bootstrap.interval(bootstrap.resample(squares.mean(keepdims=True), sums)))
        given = [one for one in found if not math.isnan(one.low)]
        assert len(given) / len(found) == pytest.approx(share, abs=0.1)
        # Three standard errors of 120 trials are 6 %, and blocks of a rule cover a little less than 95 %.
        assert sum(not one.low <= truth <= one.high for one in given) / len(found) <= 0.15


def test_a_long_episode_is_resampled_in_units():
    series = autoregressive(np.random.default_rng(2), 0.95, 9000)
    long, short = TimeUnits(9000), TimeUnits(2000)
    assert (short.unit, long.unit, long.units) == (1, 5, 1800)
    bootstrap, sums = over_time(series)
    assert bootstrap.block % 5 == 0
    assert bootstrap.blocks == pytest.approx(9000 / bootstrap.block)
    assert sums.shape == (1800, 2)
    values = series[None] + 3.0
    np.testing.assert_allclose(long.sums_of_present(values).sum(axis=0), [values.sum(), 9000.0], rtol=1e-12)
    within = long.sums_of_present(values, slice(12, 8000))
    np.testing.assert_allclose(within.sum(axis=0), [values[0, 12:8000].sum(), 7988.0], rtol=1e-12)
    assert within[:2, 1].tolist() == [0.0, 0.0]


def test_one_episode_has_labelled_intervals_of_means_over_time(monkeypatch):
    few = evaluate(ENV, ["imm", "fixed-low"], episodes=1, horizon=400)
    assert "has no intervals: it contains 12 blocks of 34 measurements" in few.attrs["notes"]
    assert {r.low for r in tidy_records(few) if r.metric in ("rmse", "cost", "anees")} == {None}
    assert {r.value for r in tidy_records(few) if r.metric == "best_share"} == {None}
    monkeypatch.setattr(time_blocks, "FEWEST_BLOCKS", 10)
    dataset = evaluate(ENV, ["imm", "fixed-low"], episodes=1, horizon=400)
    several = evaluate(ENV, ["imm", "fixed-low"], episodes=2, horizon=400)
    bootstrap = bootstrap_of(dataset)
    assert bootstrap.sentence in dataset.attrs["notes"]
    assert f"blocks of {bootstrap.block:,} measurements" in bootstrap.sentence
    assert "block bootstrap" not in several.attrs["notes"]
    records = {(r.policy, r.metric, r.component, r.window): r for r in tidy_records(dataset)}
    error = dataset["error"].sel(policy="fixed-low", component=list(groups_of(dataset)["position"])).values
    squares = (error**2).sum(axis=-1)
    rmse = records["fixed-low", "rmse", "position", "all"]
    assert rmse.value == pytest.approx(math.sqrt(squares.mean()), rel=1e-12)
    assert rmse.low < rmse.value < rmse.high
    for metric, component in (("cost", ""), ("anees", "state"), ("geometric_cost_difference", "")):
        found = records["fixed-low", metric, component, "all"]
        assert found.low < found.value < found.high
    both = [dataset["cost"].sel(policy=name).values.mean() for name in ("fixed-low", "imm")]
    difference = records["fixed-low", "relative_cost_difference", "", "all"]
    assert difference.value == pytest.approx(both[0] / both[1] - 1.0, rel=1e-12)
    for metric, component in (("peak_rmse", "position"), ("win_rate", ""), ("median_cost_ratio", "")):
        found = records["fixed-low", metric, component, "all"]
        assert found.value is not None
        assert (found.low, found.high) == (None, None)
