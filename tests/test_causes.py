"""Cost split by cause, the worst episodes, and cost over time less that of another, against naive loops."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import filtergym
from filtergym.baselines.problem import problem_of
from filtergym.commands.terminal import fill
from filtergym.envs.contract.causes import MISSED, OUTLIER, Cause, Causes, Moment, bins, cause_number
from filtergym.envs.engine.catalogue import task_class
from filtergym.evaluation.figures.worst_episodes import (
    describe_worst,
    main_causes,
    run_episodes,
    select_worst,
)
from filtergym.evaluation.running.curves import BAND_RESAMPLES, cost_in_stretches, curves_of, stretches_of
from filtergym.evaluation.running.summary import Evaluation
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.evaluation.statistics.cause_split import (
    active_causes,
    opponent_of,
    phrases_of,
    reason_weight,
)
from filtergym.names import find_competitors
from filtergym.reports.tables.reasons import (
    default_explained,
    largest_reasons,
    reason_sentences,
    reasons_of,
)
from filtergym.reports.tables.worst import find_worst, worst_figures

ENV = "filtergym/ManeuveringTarget-v0"
NAMES = ["imm", "kalman-imm-turn", "known-turn", "known-input-bound"]
EPISODES = 14


@pytest.fixture(scope="module")
def dataset():
    return filtergym.evaluate(ENV, NAMES, None, EPISODES, seed=3)


@pytest.fixture(scope="module")
def records(dataset):
    return filtergym.tidy_records(dataset)


def value(records, policy, metric, window):
    [found] = [r for r in records if (r.policy, r.metric, r.window) == (policy, metric, window)]
    return found


def test_causes_follow_from_the_context_of_the_episode(dataset):
    """The causes in the episodes by the info of the environment, measurement by measurement."""
    env = gymnasium.make(ENV, context=True, detailed_info=True)
    held = dict(active_causes(dataset.sel(policy="imm")))
    for episode in range(4):
        env.reset(seed=int(dataset["episode_seed"].values[episode]))
        for k in range(dataset.sizes["time"]):
            state = (
                env.unwrapped.fleet.only.state
            )  # before the action: of the measurement that it is taken on
            turns = env.unwrapped.model.context(state)["maneuvering"][0] > 0.0
            position = state.truth.position[:, 0]
            assert held["manoeuvre"][episode, k] == turns
            assert held["missed"][episode, k] == (state.measurement.available[0] < 0.5)
            assert held["range from 120 km on"][episode, k] == (np.hypot(*position) >= 120e3)
            assert held["start"][episode, k] == (k < 10)
            env.step(np.zeros(2))


@pytest.mark.parametrize("policy", ["imm", "kalman-imm-turn"])
def test_shares_costs_and_consistency_by_a_loop_over_episodes(policy, dataset, records):
    run = dataset.sel(policy=policy)
    weights = Bootstrap(EPISODES).weights
    for name, held in active_causes(run):
        count, cost, nees = np.zeros(EPISODES), np.zeros(EPISODES), np.zeros(EPISODES)
        for i in range(EPISODES):
            for k in range(dataset.sizes["time"]):
                if held[i, k]:
                    count[i] += 1.0
                    cost[i] += float(run["cost"].values[i, k])
                    nees[i] += float(run["nees"].values[i, k]) / 4.0
        if not count.any():
            assert not any(r.window == name and r.metric == "cause_cost" for r in records)
            continue
        whole = run["cost"].values.sum(axis=1)
        shares = weights @ cost / (weights @ whole)
        expected = {
            "cause_measurement_share": count.sum() / held.size,
            "cause_cost_share": cost.sum() / whole.sum(),
            "cause_cost": cost.sum() / count.sum(),
            "cause_anees": nees.sum() / count.sum(),
        }
        for metric, number in expected.items():
            # Sums of a thousand numbers, in another order.
            assert value(records, policy, metric, name).value == pytest.approx(number, rel=1e-12)
        share = value(records, policy, "cause_cost_share", name)
        np.testing.assert_allclose(
            [share.low, share.high], np.percentile(shares[1:], [2.5, 97.5]), rtol=1e-9, atol=1e-12
        )


def test_the_opponent_is_met_on_the_same_episodes(dataset, records):
    found = value(records, "imm", "cause_cost_ratio", "manoeuvre")
    assert found.component == "kalman-imm-turn"
    weights = Bootstrap(EPISODES).weights
    sums = []
    for policy in ("imm", "kalman-imm-turn"):
        run = dataset.sel(policy=policy)
        held = dict(active_causes(run))["manoeuvre"]
        sums.append(weights @ np.where(held, run["cost"].values, 0.0).sum(axis=1))
    ratios = sums[0] / sums[1]  # their counts are the same
    assert found.value == pytest.approx(ratios[0], rel=1e-12)
    # Ends of the same percentiles of the same resamples: where some have no manoeuvre there is no interval.
    assert [found.low, found.high] == pytest.approx(np.percentile(ratios[1:], [2.5, 97.5]), rel=1e-9)


def test_opponents():
    costs = {"a": 2.0, "b": 1.0, "c": 3.0, "reference": 0.1}
    assert opponent_of("a", costs, ["a", "b", "c"]) == "b"
    assert opponent_of("b", costs, ["a", "b", "c"]) == "a"
    assert opponent_of("reference", costs, ["a", "b", "c"]) == "b"
    assert opponent_of("a", {"a": 2.0, "reference": 0.1}, ["a"]) == "reference"
    assert opponent_of("a", {"a": 2.0}, ["a"]) == ""


def test_every_environment_describes_its_causes(env_id):
    dataset = filtergym.evaluate(env_id, [problem_of(env_id).baselines.score_paper], None, 6)
    phrases = phrases_of(dataset)
    assert len(phrases) > 5
    held = dict(active_causes(dataset.isel(policy=0)))
    assert set(held) == {"all", *phrases}
    assert sum(flags.any() for flags in held.values()) > 4
    # They complete "most of its cost falls".
    for phrase in phrases.values():
        assert phrase.split()[0] in ("in", "on", "at", "where", "while", "under", "beside")


def test_a_recording_has_the_causes_that_can_be_known(tmp_path):
    recording = filtergym.record(ENV, "missed-detections", 4, seed=2)
    simulated = filtergym.evaluate(ENV, ["imm"], "missed-detections", 4, seed=2)
    replayed = filtergym.evaluate(ENV, ["imm"], recording)
    own, other = (dict(active_causes(d.isel(policy=0))) for d in (simulated, replayed))
    for name in ("missed", "outlier", "range of 30 to 60 km", "start"):
        assert own[name].sum() == other[name].sum()
    assert own["manoeuvre"].any()
    for name in ("manoeuvre", "straight", "recovery"):
        assert not other[name].any()
    windows = {r.window for r in filtergym.tidy_records(replayed) if r.metric == "cause_cost"}
    assert {"all", "missed", "start"} <= windows
    assert not {"manoeuvre", "straight"} & windows


def test_causes_of_a_moment():
    measurement = SimpleNamespace(available=np.array([[1.0, 0.0, 1.0], [1.0, 1.0, 1.0]]))
    moment = Moment(
        np,
        {"level": np.array([0.0, 1.0, 0.0])},
        np.array([[0.0, 0.0, np.nan]]),
        measurement,
        np.array([[4.1, 3.9, 0.0]]),
        np.array([[1.0, 1.0, 1.0]]),
    )
    causes = (MISSED, OUTLIER, Cause("unknown", "nowhere", lambda moment: None))
    np.testing.assert_array_equal(cause_number(causes, moment), [2.0, 1.0, 0.0])
    low, middle, high = bins("x", "m", "at", (1.0, 2.0), lambda moment: np.array([0.9, 1.0, 2.0]))
    assert [cause.name for cause in (low, middle, high)] == ["x below 1 m", "x of 1 to 2 m", "x from 2 m on"]
    np.testing.assert_array_equal(cause_number((low, middle, high), moment), [1.0, 2.0, 4.0])
    assert middle.phrase == "at of 1 to 2 m"


def test_reasons_in_sentences(records):
    def made(metric, window, number, low=None, high=None, component=""):
        like = records[0]._replace(policy="mine", metric=metric, window=window, component=component)
        return like._replace(value=number, low=low, high=high)

    reasons = [
        made("cause_measurement_share", "turn", 0.12),
        made("cause_cost_share", "turn", 0.61),
        made("cause_cost", "turn", 5.0),
        made("cause_cost_ratio", "turn", 2.31, 1.9, 2.84, "theirs"),
        made("cause_measurement_share", "straight", 0.88),
        made("cause_cost_share", "straight", 0.39),
        made("cause_cost", "straight", 0.4),
    ]
    [sentence] = reason_sentences(reasons, {"turn": "in turns"}, "mine")
    assert sentence == (
        "mine: 61 % of its cost falls in turns, 12 % of the measurements; there it costs 2.3 times theirs [1.9, 2.8]."
    )
    assert reason_sentences(reasons[4:], {}, "mine") == [
        "mine: no cause holds much more of its cost than of the measurements."
    ]
    assert reason_sentences(reasons, {}, "missing") == []
    for width in (40, 60, 80):
        lines = fill(sentence, width).splitlines()
        assert max(map(len, lines)) <= width
        assert " ".join(lines) == sentence
        assert not any(line.startswith(("%", "2.8]")) for line in lines)


def test_the_largest_reasons_hold_much_cost_in_few_measurements(records):
    largest = largest_reasons(reasons_of(records, "imm"))
    assert 1 <= len(largest) <= 3
    assert [reason.weight for reason in largest] == sorted((r.weight for r in largest), reverse=True)
    assert all(reason.excess >= 0.05 for reason in largest)
    assert reason_weight(np.array(0.5), np.array(0.1)) == pytest.approx(0.5 * np.log(5.0))
    assert reason_weight(np.array(0.0), np.array(0.1)) == 0.0
    assert default_explained(records, ["known-turn", "kalman-imm-turn"], "imm") == ["kalman-imm-turn"]
    assert default_explained(records, [], "imm") == ["imm"]


def test_the_worst_episodes_are_those_that_cost_most_and_are_flown_again_bit_for_bit(dataset, records):
    problem = problem_of(ENV)
    experiment = problem.experiment(None, EPISODES, 3)
    costs = dataset["cost"].sel(policy="imm").values.mean(axis=1)
    numbers = select_worst(costs)
    assert numbers == sorted(range(EPISODES), key=lambda i: -costs[i])[:3]
    assert select_worst(np.array([1.0, np.nan, 3.0])) == [2, 0]
    makers = {name: problem.competitor(name) for name in ("imm", "kalman-imm-turn")}
    again = run_episodes(experiment, makers, numbers)
    for name in makers:
        np.testing.assert_array_equal(
            again["cost"].sel(policy=name).values, dataset["cost"].sel(policy=name).values[numbers]
        )
    worst = describe_worst(again, numbers, "imm", "kalman-imm-turn")
    assert [one.seed for one in worst] == dataset["episode_seed"].values[numbers].tolist()
    evaluation = Evaluation(dataset, records, None, {"imm": costs})
    [found] = find_worst(
        experiment, evaluation, find_competitors(problem, ["imm", "kalman-imm-turn"]), ["imm"]
    ).values()
    assert [one.seed for one in found] == [one.seed for one in worst]
    assert found[0].ratio == pytest.approx(worst[0].cost / worst[0].opponent_cost)
    assert found[0].track.attrs["seed"] == worst[0].seed
    [(name, figure)] = worst_figures({"imm": found}, phrases_of(dataset), 1)
    assert name == "worst_episodes"
    track = found[0].track.sel(policy="imm")
    truth, seen, *estimates = (line.get_xydata().T for line in figure.axes[0].get_lines())
    np.testing.assert_array_equal(truth, track["truth"].values[:2])
    np.testing.assert_array_equal(seen, track["seen"].values[:2])
    labels = [axis.get_label_text() for axis in (figure.axes[0].xaxis, figure.axes[0].yaxis)]
    assert labels == ["position x, m", "position y, m"]
    # The competitor whose episodes they are is drawn last, on top of the others.
    np.testing.assert_array_equal(estimates[-1], track["estimate"].values[:2])


def test_main_causes_of_an_episode_by_a_loop(dataset):
    run = dataset.sel(policy="imm").isel(episode=slice(5))
    held = dict(active_causes(run))
    for i, causes in enumerate(main_causes(run)):
        cost = run["cost"].values[i]
        weights = {}
        for name, flags in held.items():
            share, measured = cost[flags[i]].sum() / cost.sum(), flags[i].mean()
            if name != "all" and share > 0.0:
                weights[name] = share * np.log(share / measured)
        expected = [name for name in sorted(weights, key=lambda n: -weights[n])[:2] if weights[name] >= 0.1]
        assert causes == expected


def test_cost_less_that_of_another_over_time_by_a_loop(dataset):
    curves = curves_of(dataset)
    weights = Bootstrap(EPISODES, BAND_RESAMPLES).weights
    mine, theirs = (dataset["cost"].sel(policy=name).values for name in ("imm", "kalman-imm-turn"))
    assert curves.attrs["best"] == "kalman-imm-turn"
    for k in (0, 17, 99):
        each = weights @ (mine[:, k] - theirs[:, k])
        found = [
            curves[f"cost_minus_best{ending}"].sel(policy="imm").values[k] for ending in ("", "_low", "_high")
        ]
        expected = [each[0], *np.percentile(each[1:], [2.5, 97.5])]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert not curves["cost_minus_paper"].sel(policy="imm").values.any()
    assert np.isnan(curves["cost_minus_paper"].sel(policy="known-input-bound").values).all()


@pytest.mark.parametrize("times", [1, 101, 2999])
def test_stretches_cover_an_episode(times):
    stretches = stretches_of(times)
    assert len(stretches) <= 100
    covered = [k for stretch in stretches for k in range(times)[stretch]]
    assert covered == list(range(times))
    cost = np.random.default_rng(0).random((2, times))
    cost[1, times // 2 :] = np.nan
    found = cost_in_stretches(cost)
    for j, stretch in enumerate(stretches):
        for i in range(2):
            there = [x for x in cost[i, stretch] if not np.isnan(x)]
            assert found[i, j] == pytest.approx(np.mean(there)) if there else np.isnan(found[i, j])


def test_causes_of_ones_own_are_checked():
    class Twice(task_class(ENV)):
        id = "mine/Twice-v0"
        companions = (Causes((MISSED, MISSED)),)

    with pytest.raises(ValueError, match=r"causes of different names, .* got the name 'missed'"):
        filtergym.register_task(Twice)

    class Wrong(task_class(ENV)):
        id = "mine/Wrong-v0"
        companions = (Causes((Cause("shape", "in shape", lambda moment: moment.state > 0.0),)),)

    with pytest.raises(ValueError, match="cause 'shape' must be numbers of shape"):
        filtergym.register_task(Wrong)
