"""Training seeds: the spread against naive sums, what its interval promises, and the command from end to end."""

import json
import re
import shutil

import numpy as np
import pytest
import training_seeds
from records import read_record, round_number
from safetensors.numpy import load_file
from training_seeds import (
    Comparison,
    Study,
    compare,
    comparison_grids,
    describe_runs,
    episode_means,
    learning_curves,
    load_runs,
    seeds_markdown,
    spread,
)

from filtergym.agents.learned_policy import ENVELOPE, PRETRAINED, read_arrays
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.storage.store import Store
from filtergym.papers.grid import markdown_table

ENV = "filtergym/ManeuveringTarget-v0"


def two_way(rng, seeds=5, episodes=60, of_seeds=1.0, of_episodes=2.0, of_both=1.0):
    return (
        3.0
        + of_seeds * rng.normal(size=(seeds, 1))
        + of_episodes * rng.normal(size=(1, episodes))
        + of_both * rng.normal(size=(seeds, episodes))
    )


def test_spread_against_naive_sums():
    values = two_way(np.random.default_rng(0), seeds=4, episodes=7)
    found = spread(values)
    S, E = values.shape
    mean = sum(values[s, e] for s in range(S) for e in range(E)) / (S * E)
    row = [sum(values[s]) / E for s in range(S)]
    column = [sum(values[:, e]) / S for e in range(E)]
    rest = sum((values[s, e] - row[s] - column[e] + mean) ** 2 for s in range(S) for e in range(E))
    seeds = E * sum((r - mean) ** 2 for r in row) / (S - 1)
    rest /= (S - 1) * (E - 1)
    assert found.mean.value == pytest.approx(mean, rel=1e-12)
    assert found.between_seeds == pytest.approx(((seeds - rest) / E) ** 0.5, rel=1e-12)
    assert found.over_episodes == pytest.approx(
        (sum((c - mean) ** 2 for c in column) / (E - 1) / E) ** 0.5, rel=1e-12
    )


def test_interval_of_the_mean_covers_new_seeds_and_episodes():
    rng = np.random.default_rng(1)
    for spreads in ((1.0, 0.5, 1.0), (0.1, 3.0, 1.0), (0.0, 0.0, 1.0)):
        found = [spread(two_way(rng, 5, 60, *spreads)) for _ in range(500)]
        hits = sum(f.mean.low <= 3.0 <= f.mean.high for f in found)
        # 4 standard errors of a share of 500 are 4 %; where nothing but noise varies the interval is too wide.
        assert hits / 500 > 0.91
        assert hits / 500 < 0.99 or spreads[0] == 0.0
        squares = np.mean([f.between_seeds**2 for f in found])
        # Moment estimates are unbiased but for the cut at zero, which adds a little of the noise's variance.
        assert squares == pytest.approx(spreads[0] ** 2, rel=0.15, abs=0.02)


def test_one_seed_has_no_variance_between_seeds():
    found = spread(two_way(np.random.default_rng(2), seeds=1))
    assert np.isnan(found.between_seeds)
    assert found.mean.low < found.mean.value < found.mean.high


@pytest.fixture
def folders(tmp_path):
    """Runs of two training seeds; their agents are shipped ones."""
    made = []
    for seed, shipped in ((0, "ppo"), (1, "bptt")):
        folder = tmp_path / f"run-{seed}"
        (folder / "best").mkdir(parents=True)
        source = PRETRAINED / "ManeuveringTarget-v0" / shipped
        shutil.copyfile(source.with_suffix(".safetensors"), folder / "best" / "agent.safetensors")
        record = json.loads((PRETRAINED / "ManeuveringTarget-v0" / "bptt.json").read_text(encoding="utf-8"))
        command = record["command"].removesuffix(f" --seed {record['seed']}") + f" --seed {seed}"
        (folder / "run.json").write_text(json.dumps(record | {"seed": seed, "command": command}))
        made.append(folder)
    return made


def test_the_numbers_follow_from_the_episodes(folders):
    runs = load_runs(folders)
    study = Study(runs, ["adaptive"], 30, split="validation")
    means = episode_means(study, "random")
    found = {
        (c.policy, c.statistic, c.against, c.metric, c.component): c for c in compare(study, means, "random")
    }
    cost = {name: values.mean() for name, values in means.cost.items()}
    each = [cost[f"bptt seed {seed}"] for seed in (0, 1)]
    mean = found["bptt", "mean", "imm", "relative_cost_difference", ""]
    assert mean.value == pytest.approx(np.mean(each) / cost["imm"] - 1.0, rel=1e-12)
    assert mean.low < mean.value < mean.high
    median = found["bptt", "median", "adaptive", "relative_cost_difference", ""]
    assert median.value == pytest.approx(np.median(each) / cost["adaptive"] - 1.0, rel=1e-12)
    rmse = {name: np.sqrt(values.mean()) for name, values in means.squares["position"].items()}
    difference = found["bptt", "median", "imm", "rmse_difference", "position"]
    expected = np.median([rmse[f"bptt seed {seed}"] - rmse["imm"] for seed in (0, 1)])
    assert difference.value == pytest.approx(expected, rel=1e-12)
    assert (difference.unit, difference.episodes) == ("m", 30)


def test_a_learned_estimator_is_scored_beside_policies(folders):
    shipped = PRETRAINED / "ManeuveringTarget-v0" / "kalman-net"
    shutil.copyfile(shipped.with_suffix(".safetensors"), folders[0] / "best" / "agent.safetensors")
    shutil.copyfile(shipped.with_suffix(".json"), folders[0] / "run.json")
    runs = load_runs(folders)
    means = episode_means(Study(runs, ["kalman-net"], 4, split="validation"), "random")
    [member] = [member for member in runs if member.run.algorithm == "kalman-net"]
    assert (means.cost[member.name] == means.cost["kalman-net"]).all()


def test_what_was_scored_is_not_scored_again(folders, monkeypatch, tmp_path):
    scored, whole, stop = [], training_seeds.reduce_episodes, 99

    def reduce_episodes(asked, declare, tick):
        if len(scored) == stop:
            raise KeyboardInterrupt
        scored.append(asked.name)
        return whole(asked, declare, tick)

    monkeypatch.setattr(training_seeds, "reduce_episodes", reduce_episodes)
    study = Study(load_runs(folders), ["adaptive"], 4, split="validation")
    store = Store(tmp_path / "unfinished")
    expected = episode_means(study, "random")
    scored.clear()
    stop = 3
    with pytest.raises(KeyboardInterrupt):
        episode_means(study, "random", store=store)
    assert scored == ["agent", "agent", "imm"]
    stop = 99
    found = episode_means(study, "random", store=store)
    assert scored == ["agent", "agent", "imm", "adaptive"]
    assert found.units == expected.units
    np.testing.assert_equal(found.cost, expected.cost)
    np.testing.assert_equal(found.squares, expected.squares)
    # Another agent in the same folder, or other episodes, are something else.
    agent = PRETRAINED / "ManeuveringTarget-v0" / "ppo.safetensors"
    shutil.copyfile(agent, folders[1] / "best/agent.safetensors")
    episode_means(study, "random", store=store)
    assert scored[4:] == ["agent"]
    episode_means(study._replace(opponents=[], episodes=5), "random", store=store)
    assert scored[5:] == ["agent", "agent", "imm"]


@pytest.mark.slow
def test_command_makes_the_record_and_the_record_the_tables(folders, tmp_path, make_page, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ("--episodes", 20, "--split", "validation", "--out", "seeds.json", "--curves", "curves.png")
    code, shown, errors = make_page("seeds", *folders, *arguments, "--into", "records")
    assert code == 0, errors
    assert "bptt seed 1" in shown
    record = read_record("seeds/ManeuveringTarget", tmp_path / "records")
    assert "--split validation" in record.command
    text = seeds_markdown(record)
    for word in ("`bptt seed 0`", "`adaptive-rearm-tuned`", "--split validation", "--seed 0|1"):
        assert word in text
    # The tables are of the digits that the record keeps.
    records = [
        Comparison(**{name: round_number(v) if isinstance(v, float) else v for name, v in each.items()})
        for each in json.loads((tmp_path / "seeds.json").read_text())
    ]
    for grid in comparison_grids(
        problem_of(records[0].environment), describe_runs(load_runs(folders)), records
    ):
        assert "\n".join(markdown_table(grid.header, grid.rows)) in text
    # The first table is shown, the others wait for a click; inside HTML, Markdown needs blank lines around it.
    shown, *folded = text.split("<details>\n")
    assert shown.count("\n|---") == shown.count("**Scenario `random`, 20 episodes") == 1
    assert len(folded) == text.count("\n\n</details>\n\n") == 2
    for part in folded:
        assert re.match(r"<summary>[^`]*<code>random</code></summary>\n\n\| ", part)
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    # The record has the validations of every run, from which the site draws the same picture.
    validation = json.loads((folders[0] / "run.json").read_text())["validation"]
    steps, differences = record.data["curves"]["bptt seed 0"]
    assert steps == [entry["steps"] for entry in validation]
    # Four digits are kept.
    expected = [entry["relative_cost_difference"][0] for entry in validation]
    assert differences == pytest.approx(expected, rel=5e-4)
    [axis] = learning_curves(record.data).axes
    assert len(axis.get_legend_handles_labels()[0]) == len(axis.collections) == 1
    del record.data["curves"]["bptt seed 1"]
    with pytest.raises(ValueError, match="record of bptt seed 1 has no validations against 'imm' to draw"):
        learning_curves(record.data)
    assert not (tmp_path / "unfinished").exists()
    assert {each.statistic for each in records} >= {"run", "opponent", "median", "mean", "between seeds"}


def test_the_best_of_an_algorithm_is_shipped(folders, tmp_path, make_page):
    # Both runs hold the validations of one record: the second's are made better.
    record = json.loads((folders[1] / "run.json").read_text())
    record["validation"] = [entry | {"cost": 0.9 * entry["cost"]} for entry in record["validation"]]
    (folders[1] / "run.json").write_text(json.dumps(record))
    code, _, wrong = make_page("ship", *folders, "--into", tmp_path / "shipped")
    assert code == 0, wrong
    [file] = (tmp_path / "shipped" / "ManeuveringTarget-v0").glob("*.safetensors")
    best = folders[1] / "best" / "agent.safetensors"
    assert read_arrays(file)[1] == read_arrays(best)[1]
    exported, trained = load_file(file), load_file(best)
    assert set(trained) == set(exported)
    for name, array in trained.items():
        # The envelope is measured again, and rounded outwards.
        steps = 1 if name in ENVELOPE else 0
        np.testing.assert_array_max_ulp(exported[name], array, steps)
    shipped = json.loads(file.with_suffix(".json").read_text())
    assert (shipped["seed"], shipped["exported"]["episodes"]) == (1, 32)


def test_what_cannot_be_compared(folders, tmp_path, make_page, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def fails(expected, *arguments):
        code, _, errors = make_page("seeds", *arguments)
        assert (code, errors.count("\n")) == (2, 1), errors
        assert expected in errors

    fails("is a bound, which has no cost", folders[0], "--policy", "known-input-bound")
    fails("written as png, svg or pdf, got 'gif'", "nowhere", "--curves", "curves.gif")
    record = json.loads((folders[1] / "run.json").read_text())
    for changes, message in (
        ({"envs": 3}, r"may differ in the seed only: .* has envs 3"),
        ({"seed": 0}, "is a second run of bptt seed 0"),
        ({"environment": "filtergym/UavAutopilot-v0"}, "runs of one environment are compared"),
    ):
        (folders[1] / "run.json").write_text(json.dumps(record | changes))
        with pytest.raises(ValueError, match=message):
            load_runs(folders)
    shutil.rmtree(folders[0] / "best")
    with pytest.raises(ValueError, match="has no best agent yet"):
        load_runs(folders[:1])


def test_a_record_takes_further_algorithms(folders, tmp_path, make_page, monkeypatch):
    """Of its episodes, against its opponents; those it has already are replaced, with their curves."""
    monkeypatch.chdir(tmp_path)
    renamed = tmp_path / "other"
    shutil.copytree(folders[0], renamed)
    text = json.loads((renamed / "run.json").read_text())
    text["algorithm"] = "bptt-small"
    (renamed / "run.json").write_text(json.dumps(text))
    options = ("--split", "validation", "--policy", "imm", "--scenario", "random", "--episodes", 4)
    arguments = ("--into", "records", "--add")
    assert make_page("seeds", *folders, *options, *arguments[:2])[0] == 0
    before = read_record("seeds/ManeuveringTarget", tmp_path / "records").data
    code, _, errors = make_page("seeds", renamed, *arguments)
    assert code == 0, errors
    after = read_record("seeds/ManeuveringTarget", tmp_path / "records").data
    assert [run[0] for run in after["runs"]] == ["bptt seed 0", "bptt seed 1", "bptt-small seed 0"]
    assert {*after["curves"]} == {run[0] for run in after["runs"]}
    kept = [row for row in after["scenarios"]["random"] if not row[0].startswith(("bptt-small", "imm"))]
    assert kept == [row for row in before["scenarios"]["random"] if row[0] != "imm"]
    assert make_page("seeds", folders[1], *arguments)[0] == 0
    replaced = read_record("seeds/ManeuveringTarget", tmp_path / "records").data
    assert [run[0] for run in replaced["runs"]] == ["bptt seed 1", "bptt-small seed 0"]
    assert (replaced["episodes"], replaced["split"]) == (4, "validation")

    def fails(expected, *arguments):
        code, _, errors = make_page("seeds", renamed, *arguments)
        assert (code, errors.count("\n"), expected in errors) == (2, 1, True), errors

    fails("from the record: leave out --episodes", *arguments, "--episodes", 5)
    fails("from the record: name its folder by --into", "--add")
    file = tmp_path / "records" / "seeds" / "ManeuveringTarget.json"
    file.write_text(file.read_text().replace('"imm"', '"gone"'))
    fails("make it anew from all runs, by python docs/make seeds runs/ManeuveringTarget/*-?", *arguments)
