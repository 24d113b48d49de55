"""Whether covariances are believed: NEES and NIS, medians and wins, and the verdict on the best competitor."""

import numpy as np
import pytest
import xarray
from scipy.stats import chi2

from filtergym import evaluate, tidy_records
from filtergym.evaluation.running.metrics import chi_square_band, chi_square_quantile, score
from filtergym.evaluation.statistics.bootstrap import Bootstrap, IntervalEstimate, share_interval
from filtergym.reports.tables.ranking import best_competitor, ranking, ranking_sentence

ID = "filtergym/ManeuveringTarget-v0"
EPISODES = 100


@pytest.fixture(scope="module")
def dataset():
    names = ["imm", "bptt", "ppo", "kalman-imm", "known-turn", "known-input-bound"]
    return evaluate(ID, names, episodes=EPISODES, tracks=True)


@pytest.fixture(scope="module")
def found(dataset):
    return {(r.policy, r.metric): r for r in tidy_records(dataset) if r.window == "all"}


def test_quantiles_are_those_of_the_chi_square_distribution():
    degrees, runs = np.array([[1.0, 4.0], [0.0, 17.0]]), 50
    low, high = chi_square_band(degrees, runs)
    there = degrees > 0.0
    for quantile, p in ((low, 0.025), (high, 0.975)):
        expected = chi2.ppf(p, runs * degrees[there]) / runs
        np.testing.assert_allclose(quantile[there], expected, rtol=1e-10)  # an iteration in both
    assert chi_square_quantile(0.999, 4) == pytest.approx(chi2.ppf(0.999, 4), rel=1e-10)
    np.testing.assert_allclose(
        chi_square_quantile(0.9, degrees[:, 1]), chi2.ppf(0.9, degrees[:, 1]), rtol=1e-10
    )


def test_consistency_equals_its_definition(dataset, found):
    for name in ("imm", "kalman-imm"):
        run = dataset.sel(policy=name)
        error, P = run["error"].values, run["covariance"].values
        nees = np.einsum("mti,mti->mt", error, np.linalg.solve(P, error[..., None])[..., 0])
        assert found[name, "anees"].value == pytest.approx(nees.mean() / 4, rel=1e-9)
        low, high = chi2.ppf([0.025, 0.975], 4)
        inside = ((nees >= low) & (nees <= high)).mean()
        assert found[name, "nees_inside"].value == pytest.approx(inside, abs=1e-4)
    nis, degrees = (dataset[name].sel(policy="imm").values for name in ("nis", "nis_degrees"))
    missed = degrees == 0.0  # scans that did not see the target
    assert 0.1 < missed.mean() < 0.3
    np.testing.assert_array_equal(np.isnan(nis), missed)
    assert found["imm", "anis"].value == pytest.approx(np.nanmean(nis) / 2, rel=1e-9)
    nis = dataset["nis"].sel(policy="kalman-imm").values
    np.testing.assert_array_equal(np.isnan(nis), missed)
    assert found["kalman-imm", "anis"].value == pytest.approx(np.nanmean(nis) / 2, rel=1e-9)
    assert ("known-input-bound", "anees") not in found


def test_medians_are_those_of_the_resamples():
    values = np.random.default_rng(0).normal(size=31)
    bootstrap = Bootstrap(31, resamples=50)
    counts = np.rint(bootstrap.weights * 31).astype(int)
    expected = [np.median(np.repeat(values, count)) for count in counts]  # 31 is odd: a value of the sample
    np.testing.assert_array_equal(bootstrap.quantiles(values), expected)


def test_typical_episodes(dataset, found):
    cost = dataset["cost"].mean("time")
    ratio = (cost.sel(policy="bptt") / cost.sel(policy="imm")).values
    assert found["bptt", "win_rate"].value == pytest.approx((ratio < 1.0).mean())
    # Of an even number the lower of the two in the middle.
    assert found["bptt", "median_cost_ratio"].value == np.sort(ratio)[EPISODES // 2 - 1]
    assert found["imm", "win_rate"].value == pytest.approx(0.5, rel=1e-12)
    assert found["imm", "median_cost_ratio"].value == 1.0


def test_the_headline_is_a_geometric_mean_and_lost_tracks_are_counted(dataset, found):
    """Of each episode's ratio of costs, with the interval of a bootstrap of its logarithm."""
    cost = dataset["cost"].mean("time").transpose("episode", "policy").to_pandas()
    logs = np.log(cost["bptt"] / cost["imm"]).to_numpy()
    counts = np.rint(Bootstrap(EPISODES).weights * EPISODES)
    expected = np.percentile(np.exp(counts[1:] @ logs / EPISODES) - 1.0, [2.5, 97.5])
    record = found["bptt", "geometric_cost_difference"]
    assert record.value == pytest.approx(np.exp(logs.mean()) - 1.0, rel=1e-12)
    np.testing.assert_allclose([record.low, record.high], expected, rtol=1e-12)
    assert found["imm", "geometric_cost_difference"][8:11] == (0.0, 0.0, 0.0)
    assert found["imm", "geometric_cost"].value == pytest.approx(
        np.exp(np.log(cost["imm"]).mean()), rel=1e-12
    )
    assert found["imm", "lost_tracks"].value == (cost["imm"] > 100.0).mean()
    # Of a thousand resamples each names one.
    shares = {name: r.value for (name, metric), r in found.items() if metric == "best_share"}
    assert sum(shares.values()) == pytest.approx(1.0, rel=1e-12)
    assert max(shares, key=shares.__getitem__) == found["ppo", "behind_best"].component


def test_the_interval_of_a_share_is_where_its_score_test_accepts():
    """Wilson's: the ends solve ``(share - p)^2 = z^2 p (1 - p) / n``; none of n still leaves something."""
    z = 1.959963984540054
    for count, number in ((0, 50), (3, 50), (50, 50)):
        share, low, high = share_interval(count / number, number)
        assert 0.0 <= low <= share <= high <= 1.0
        for end in (low, high):
            spread = z * z * end * (1.0 - end) / number
            assert (share - end) ** 2 == pytest.approx(spread, abs=1e-15)


def test_no_room_unless_the_reference_is_better():
    rng, bootstrap = np.random.default_rng(0), Bootstrap(200)
    paper = rng.gamma(2.0, 1.0, 200)
    for shift, room in ((-0.5, True), (0.5, False), (0.0, False)):
        noise = rng.normal(size=200)
        reference = paper + shift + 0.1 * (noise - noise.mean())
        means = [bootstrap.means(values) for values in (0.9 * paper, paper, reference)]
        found = score(*means, bootstrap)
        assert isinstance(found, IntervalEstimate)
        assert np.isfinite(found.value) == room


def test_who_is_best(dataset, found):
    records = tidy_records(dataset)
    places = ranking(records)
    cost = np.exp(np.log(dataset["cost"].mean("time")).mean("episode"))
    cost = cost.drop_sel(policy=["known-turn", "known-input-bound"])
    names = cost["policy"].values[np.argsort(cost.values)].tolist()
    assert [p.policy for p in places] == names
    assert names[0] == "bptt"
    behind = found["ppo", "behind_best"]
    assert behind.component == "bptt"
    expected = float(cost.sel(policy="ppo") / cost.sel(policy="bptt")) - 1.0
    assert behind.value == pytest.approx(expected, rel=1e-12)
    sentence = ranking_sentence(records, "imm")
    assert sentence.startswith("On `random` `bptt` (learned) has the lowest error cost: -")
    classical = next(name for name in names if name not in ("bptt", "ppo"))
    assert f"The strongest classical competitor, `{classical}` (" in sentence
    assert ("known-turn", "behind_best") not in found


def test_verdict_follows_from_the_paired_difference_to_the_best(dataset):
    records = tidy_records(dataset)
    learned = ("bptt", "ppo")

    def verdict(names, low=None):
        """Verdict on these competitors, the lower end of every difference to the best one set to ``low``."""
        kept = [record for record in records if record.policy in names]
        if low is not None:
            kept = [r._replace(low=low) if r.metric == "behind_best" else r for r in kept]
        return best_competitor(kept)

    competitors = [place.policy for place in ranking(records)]
    classical = [name for name in competitors if name not in learned]
    assert verdict(competitors, low=0.01) == "learned best"
    assert verdict(competitors, low=0.0) == verdict(competitors, low=-0.01) == "no significant difference"
    assert verdict(learned) == "learned only"
    assert verdict(classical) == "classical only"
    # References know what the others do not, and judge nothing.
    assert verdict([*competitors, "known-turn"], low=0.01) == "learned best"
    swapped = [
        r._replace(value=1e-9) if (r.policy, r.metric) == (classical[0], "geometric_cost") else r
        for r in records
    ]
    beaten = [r._replace(low=0.01) if (r.policy, r.metric) == ("bptt", "behind_best") else r for r in swapped]
    assert best_competitor(beaten) == "classical best"


@pytest.mark.parametrize(("factor", "expected"), [(1.0 - 1e-6, "bptt"), (1.0 - 1e-3, "copy")])
def test_of_equals_the_first_is_called_the_best(dataset, factor, expected):
    """A filter and what is made of it may differ by rounding alone: then the simpler one is named."""
    copy = dataset.sel(policy=["bptt"]).assign_coords(policy=["copy"])
    copy["cost"] = factor * copy["cost"]
    records = tidy_records(xarray.concat([dataset, copy], "policy", data_vars="minimal"))
    assert {r.component for r in records if r.metric == "behind_best"} == {expected}
    shares = {r.policy: r.value for r in records if r.metric == "best_share"}
    assert (shares[expected], sum(shares.values())) == (1.0, pytest.approx(1.0))
    assert ranking(records)[0].policy == expected


def test_tracks_hold_what_a_track_is_drawn_from(dataset):
    run = dataset.sel(policy=["imm", "kalman-imm", "known-turn"])
    assert run["covariance"].dims == ("policy", "episode", "time", "component", "other_component")
    np.testing.assert_allclose(
        (run["estimate"] - run["truth"]).values, run["error"].values, rtol=0, atol=1e-9
    )
    for name in ("measurement_position", "measurement_variance"):
        values = run[name].values  # the same for all competitors: none steers the radar
        assert values.shape == (3, EPISODES, 100, 2)
        np.testing.assert_array_equal(values[1:], values[:1].repeat(2, axis=0))
    assert "estimate" not in evaluate(ID, ["imm"], episodes=2)
