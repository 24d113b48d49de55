"""Evaluation: what the dataset holds, common random numbers, records, score, tuning."""

import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import xarray

import filtergym
from filtergym import evaluate, tidy_records
from filtergym.baselines import tuning
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.problem import problem_of
from filtergym.baselines.tuned_values import save_tuned
from filtergym.baselines.tuning import Candidate, Search, episode_costs, geometric_cost, tune
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.evaluation.storage.dataset import windows_of

ENV = "filtergym/ManeuveringTarget-v0"
assert filtergym


@pytest.fixture(scope="module")
def dataset() -> xarray.Dataset:
    names = ["imm", "zero", "adaptive", "known-turn", "known-input-bound"]
    return evaluate(ENV, names, scenario="paper", episodes=40, seed=3)


def test_dataset_has_named_axes_and_units(dataset):
    assert dataset["error"].dims == ("policy", "episode", "time", "component")
    assert dataset["mode_probability"].dims == ("policy", "episode", "time", "mode")
    assert dataset.sizes["time"] == 100
    assert dict(zip(dataset.component.values, dataset.unit.values, strict=True))["velocity_x"] == "m/s"
    assert windows_of(dataset)["turn"] == (50, 55)


def test_splits_and_seeds_share_no_episode():
    seen = [
        set(episode_seeds(split, seed, 500)) for split in ("train", "validation", "test") for seed in range(3)
    ]
    assert len(set.union(*seen)) == sum(map(len, seen))
    assert episode_seeds("test", 0, 3, first=2) == episode_seeds("test", 0, 5)[2:]
    with pytest.raises(ValueError, match="'test'"):
        episode_seeds("tets", 0, 1)


def test_records_follow_from_the_dataset(dataset):
    records = {(r.policy, r.metric, r.component, r.window): r for r in tidy_records(dataset)}
    error = dataset["error"].sel(policy="imm").values
    turn = records["imm", "rmse", "position", "turn"]
    assert turn.value == pytest.approx(np.sqrt((error[:, 49:55, :2] ** 2).sum(-1).mean()), rel=1e-12)
    assert turn.low < turn.value < turn.high
    assert turn.unit == "m"
    peak = np.sqrt((error[..., 0] ** 2).mean(axis=0)).max()
    assert records["imm", "peak_rmse", "position_x", "all"].value == pytest.approx(peak, rel=1e-12)
    returned = -dataset["compressed_cost"].sel(policy="imm").values.sum(axis=1).mean()
    assert records["imm", "return", "", "all"].value == pytest.approx(returned, rel=1e-12)
    assert records["known-input-bound", "rmse", "position", "all"].kind == "bound"
    assert ("known-input-bound", "score", "", "all") not in records


def test_window_all_is_the_whole_episode_however_long():
    windows = windows_of(evaluate(ENV, ["imm"], scenario="paper", episodes=2, horizon=120))
    assert (windows["all"], windows["post"]) == ((1, 120), (70, 100))
    windows = windows_of(evaluate(ENV, ["imm"], scenario="paper", episodes=2, horizon=60))
    assert (windows["all"], windows["recovery"]) == ((1, 60), (56, 60))


def test_score_is_zero_for_the_paper_and_one_for_the_reference(dataset):
    records = {r.policy: r for r in tidy_records(dataset) if r.metric == "score"}
    assert records["imm"].value == 0.0
    assert records["known-turn"].value == pytest.approx(1.0)
    cost = np.log(dataset["cost"].mean("time")).mean("episode")
    adaptive, paper, bound = (float(cost.sel(policy=p)) for p in ("adaptive", "imm", "known-turn"))
    assert records["adaptive"].value == pytest.approx((paper - adaptive) / (paper - bound), rel=1e-9)


def test_tuning_improves_on_fresh_episodes_and_is_repeatable():
    tunable = baselines_of(ENV).tunable["fixed-best"]
    budget = 20 * 32 * 100
    first = tune(problem_of(ENV), "fixed-best", Search(budget, seed=1, episodes=32, confirming=128))
    again = tune(problem_of(ENV), "fixed-best", Search(budget, seed=1, episodes=32, confirming=128))
    assert first == again
    assert first.environment_steps <= budget
    assert first.cost < first.untuned_cost
    seeds = episode_seeds("validation", 1, 128)
    candidate = Candidate(problem_of(ENV), "random", tunable, tunable.start, seeds)
    assert geometric_cost(episode_costs(candidate)) == pytest.approx(first.untuned_cost, rel=1e-12)


def test_a_search_weighs_the_density_of_the_truth_where_it_is_declared():
    id, name = "filtergym/LooselyCoupledNavigation-v0", "augmented-sage-husa"
    tunable = replace(baselines_of(id).tunable[name], likelihood=True)
    seeds = episode_seeds("validation", 0, 8)
    found = episode_costs(Candidate(problem_of(id), "random", tunable, tunable.start, seeds))
    data = evaluate(id, [name], episodes=8, split="validation").isel(policy=0)
    # One component: the variance is the squared error over the normalised one.
    squared, nees = data["error"].isel(component=0) ** 2, data["nees"]
    density = -0.5 * (np.log(2.0 * np.pi * squared / nees) + nees)
    expected = data["cost"].mean("time") * np.exp(-density.mean("time"))
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_a_winner_that_fresh_episodes_do_not_confirm_is_not_kept(monkeypatch):
    """On the training episodes the largest value is the best, on fresh ones the start is."""
    tunable = baselines_of(ENV).tunable["fixed-best"]
    train = episode_seeds("train", 0, 8)
    (name,) = tunable.start

    def flattered(candidate, workers):
        value = candidate.values[name]
        cost = np.exp(-value) if candidate.seeds == train else 1.0 + abs(value - tunable.start[name])
        return np.full(len(candidate.seeds), cost)

    monkeypatch.setattr(tuning, "episode_costs", flattered)
    outcome = tune(problem_of(ENV), "fixed-best", Search(20 * 8 * 100, episodes=8))
    assert outcome.values == pytest.approx(tunable.start, rel=1e-5)
    assert outcome.cost == outcome.untuned_cost == 1.0


def test_tuning_refuses_held_out_scenarios_and_small_budgets():
    with pytest.raises(ValueError, match="held out"):
        tune(problem_of(ENV), "imm", Search(10**6, scenario="atc"))
    with pytest.raises(ValueError, match="at least"):
        tune(problem_of(ENV), "imm", Search(1000))


def test_shipped_values_are_used_unless_there_are_ones_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    values, place = problem_of(ENV).tuned_values.values("imm")
    assert "tuned" in place
    dataset = evaluate(ENV, ["imm", "imm-tuned"], episodes=4)
    assert not np.allclose(*dataset["cost"].values)
    (tmp_path / "tuned").mkdir()
    own = {"imm": {"values": dict(values, low=0.3, high=0.7, stay_low=0.9, stay_high=0.9)}}
    (tmp_path / "tuned" / "ManeuveringTarget-v0.json").write_text(json.dumps(own))
    dataset = evaluate(ENV, ["imm", "imm-tuned"], episodes=4)
    # Not closer: 1 - 0.9 is not the 0.1 of the untuned transition matrix.
    np.testing.assert_allclose(*dataset["cost"].values, rtol=1e-9)
    with pytest.raises(ValueError, match="filtergym tune"):
        problem_of(ENV).tuned_values.values("zero")


def test_searches_that_end_together_lose_no_values(tmp_path):
    outcome = tune(problem_of(ENV), "fixed-best", Search(20 * 8 * 100, episodes=8))
    names = [f"policy-{i}" for i in range(16)]
    save = lambda name: save_tuned(replace(outcome, policy=name), "a command", tmp_path)  # noqa: E731
    with ThreadPoolExecutor(8) as threads:
        (path,) = set(threads.map(save, names))
    table = json.loads(path.read_text())
    assert set(table) == {*names}
    assert math.isfinite(table["policy-7"]["validation_cost"])
