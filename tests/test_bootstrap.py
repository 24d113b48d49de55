"""Intervals: against SciPy's bootstrap, and for what they promise."""

import numpy as np
import pytest
from filtergym.evaluation.bootstrap import Bootstrap
from filtergym.evaluation.metrics import mean_of_present
from scipy import stats


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


def test_interval_covers_as_often_as_it_says():
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
    found = mean_of_present(values, bootstrap)
    assert found.value == pytest.approx(np.nanmean(values), rel=1e-12)
    assert found.low < found.value < found.high
    full = rng.normal(size=(30, 20))
    np.testing.assert_allclose(
        mean_of_present(full, bootstrap), bootstrap.estimate(full.mean(axis=1)), rtol=1e-10
    )
    assert np.isnan(mean_of_present(np.full((30, 5), np.nan), bootstrap)).all()
