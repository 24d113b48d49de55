"""Intervals: against SciPy's bootstrap, and for what they promise."""

import numpy as np
import pytest
import xarray
from scipy import stats

from filtergym.evaluation.running.metrics import sums_of_present
from filtergym.evaluation.statistics.bootstrap import Bootstrap, ratio
from filtergym.evaluation.statistics.statistic import ALL, Statistic, reduce_run


@pytest.mark.parametrize("seed", range(3))
def test_interval_of_a_root_mean_square_equals_scipy(seed):
    data = np.random.default_rng(seed).gamma(2.0, size=150)
    ours = Bootstrap(len(data), resamples=8000).estimate(data, np.sqrt)
    theirs = stats.bootstrap(
        (data,),
        lambda x, axis: np.sqrt(x.mean(axis=axis)),
        method="percentile",
        n_resamples=8000,
        rng=seed,
    ).confidence_interval
    assert ours.value == pytest.approx(np.sqrt(data.mean()), rel=1e-12)
    # Two independent bootstraps of 8000: an end of the interval has a Monte Carlo error of about 2 % of its width.
    width = theirs.high - theirs.low
    assert ours.low == pytest.approx(theirs.low, abs=0.1 * width)
    assert ours.high == pytest.approx(theirs.high, abs=0.1 * width)


def test_statistics_of_one_bootstrap_are_paired():
    generator = np.random.default_rng(0)
    noise = generator.normal(size=400) * 10.0
    better, worse = noise, noise + 0.5
    bootstrap = Bootstrap(400)
    difference = bootstrap.interval(bootstrap.means(worse) - bootstrap.means(better))
    assert difference.low == pytest.approx(0.5)
    assert difference.high == pytest.approx(0.5)


def test_interval_has_its_stated_coverage():
    generator = np.random.default_rng(1)
    bootstrap = Bootstrap(100, resamples=400)
    hits = 0
    for _ in range(400):
        estimate = bootstrap.estimate(generator.exponential(size=100))
        hits += estimate.low <= 1.0 <= estimate.high
    # Percentile intervals of a skewed mean cover a little less than 95 %; 4 standard errors are 4.4 %.
    assert 0.88 < hits / 400 <= 0.99


def test_without_finite_resamples_there_is_no_interval():
    estimate = Bootstrap(10).estimate(np.full(10, np.nan))
    assert np.isnan(estimate.low)
    assert np.isnan(estimate.high)


def test_the_mean_of_what_is_present_pools_over_episodes():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(30, 20))
    values[rng.random(values.shape) < 0.4] = np.nan
    values[3] = np.nan
    bootstrap = Bootstrap(30)
    found = bootstrap.estimate(sums_of_present(values), ratio)
    assert found.value == pytest.approx(np.nanmean(values), rel=1e-12)
    assert found.low < found.value < found.high
    full = rng.normal(size=(30, 20))
    np.testing.assert_allclose(
        bootstrap.estimate(sums_of_present(full), ratio), bootstrap.estimate(full.mean(axis=1)), rtol=1e-10
    )
    assert np.isnan(bootstrap.estimate(sums_of_present(np.full((30, 5), np.nan)), ratio)).all()


@pytest.mark.parametrize("clusters", [None, list("aabbbcddd")])
def test_statistics_of_an_episode_are_reduced_together_block_by_block(monkeypatch, clusters):
    """Against loops over the resamples; one product a block serves all means, and its weights are made once."""
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.BLOCK", 4)  # episodes
    rng = np.random.default_rng(0)
    bootstrap = Bootstrap(9, 20, clusters=clusters)
    values = {"number": rng.normal(size=9), "curve": rng.normal(size=(9, 3, 2)), "late": rng.normal(size=9)}
    if clusters is not None:
        values["curve"][2:5, 1] = np.nan
    run = xarray.Dataset(
        {name: (("episode", "time", "axis")[: array.ndim], array) for name, array in values.items()},
        coords={"time": range(3)},
    )
    products = []
    monkeypatch.setattr(
        Bootstrap, "sums", lambda self, *args, own=Bootstrap.sums: products.append(args) or own(self, *args)
    )

    def declare(block):
        yield Statistic(("root",), block["curve"].values, np.abs)
        yield Statistic(("number",), block["number"].values)
        if block["late"].values[0] != values["late"][0]:  # the first block has none
            yield Statistic(("late",), block["late"].values, optional=True)
            yield Statistic(("unknown",), block["late"].values)
            yield Statistic(("unknown sample",), block["late"].values, sample=ALL)
        yield Statistic(("sample",), block["number"].values, sample=6)
        yield Statistic(("few",), block["curve"].values, resamples=5)

    found = reduce_run(run, declare, bootstrap).results()
    assert [(len(args[0]), args[1]) for args in products] == [(2, 0), (1, 0), (4, 4), (1, 4), (4, 8), (1, 8)]
    assert set(found) == {("root",), ("number",), ("late",), ("sample",), ("few",)}
    np.testing.assert_array_equal(found["sample",], values["number"][:6])
    np.testing.assert_array_equal(found["few",], bootstrap.means(values["curve"])[:6])
    weights = bootstrap.weights
    means = [np.nanmean(values["curve"], axis=0)]
    for row in weights[1:]:
        there = ~np.isnan(values["curve"]) * row[:, None, None]
        with np.errstate(invalid="ignore"):
            means.append(np.nansum(values["curve"] * row[:, None, None], axis=0) / there.sum(axis=0))
    np.testing.assert_allclose(found["root",], np.abs(means), rtol=1e-12)
    np.testing.assert_allclose(found["number",], weights @ values["number"], rtol=1e-12)
    present = weights[:, 4:].sum(axis=1) if clusters is not None else 1.0
    np.testing.assert_allclose(found["late",], weights[:, 4:] @ values["late"][4:] / present, rtol=1e-12)


def test_weights_of_a_block_are_made_once():
    bootstrap = Bootstrap(9, 20)
    some = slice(2, 6)
    assert bootstrap.weights_of(some) is bootstrap.weights_of(slice(2, 6))
    np.testing.assert_array_equal(bootstrap.weights_of(some), bootstrap.weights[:, some])
    np.testing.assert_array_equal(bootstrap.weights_of(slice(0, 2)), bootstrap.weights[:, :2])


@pytest.mark.parametrize("clusters", [None, list("aabbbcddd") * 20])
@pytest.mark.parametrize("separate", [2**15, 23])
def test_quantiles_are_the_first_value_with_enough_weight(monkeypatch, clusters, separate):
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.SEPARATE", separate)
    rng = np.random.default_rng(0)
    bootstrap = Bootstrap(180, 20, clusters=clusters)
    for values in (rng.normal(size=180), rng.integers(0, 4, 180).astype(float)):
        chosen = rng.random(180) < 0.6
        order = np.argsort(values)
        expected = [
            values[order][(np.cumsum(row) >= 0.3 * row.sum() * (1.0 - 1e-9)).argmax()]
            for row in (bootstrap.weights * chosen)[:, order]
        ]
        np.testing.assert_array_equal(bootstrap.quantiles(values, 0.3, chosen), expected)
    assert np.isnan(bootstrap.quantiles(values, 0.3, np.zeros(180, dtype=bool))).all()


def test_many_episodes_are_resampled_in_groups_of_successive_ones(monkeypatch):
    """Intervals are as wide, from a thirtieth of the counts, and a block of episodes may end within a group."""
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.BLOCK", 64)
    values = np.random.default_rng(0).exponential(size=(3000, 2))
    plain = Bootstrap(3000)
    monkeypatch.setattr("filtergym.evaluation.statistics.bootstrap.SEPARATE", 100)
    grouped = Bootstrap(3000)
    assert (grouped.weights[:, :30] == grouped.weights[:, :1]).all()
    assert not (grouped.weights[:, 30] == grouped.weights[:, 0]).all()
    np.testing.assert_allclose(grouped.means(values), grouped.weights @ values, rtol=1e-12)
    for column in values.T:
        theirs, ours = plain.estimate(column), grouped.estimate(column)
        assert ours.value == pytest.approx(theirs.value, rel=1e-12)
        # Of a hundred groups the width itself varies by 7 %.
        assert ours.high - ours.low == pytest.approx(theirs.high - theirs.low, rel=0.25)
