"""Searches for hyperparameters: what they draw, that a resumed one equals a whole one, and what they leave."""

import json
from dataclasses import replace

import pytest

pytest.importorskip("optuna")
pytest.importorskip("yaml")
pytest.importorskip("sb3_contrib")
import optuna
from filtergym.agents import training_run, validation
from filtergym.agents.search import (
    VALIDATIONS,
    Search,
    finished_trials,
    read_space,
    run_folder,
    search_hyperparameters,
    suggest_hyperparameters,
)
from filtergym.agents.training_run import RunOptions, load_run, new_run, save_run
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import catalogue

ID = "filtergym/ManeuveringTarget-v0"
SPACE = {"learning_rate": {"low": 1e-4, "high": 1e-2, "log": True, "prefix": "lin_"}, "hidden_size": [2, 4]}


def search(**changed):
    asked = {"steps": 1000, "seeds": (0, 1), "keywords": {}, "overrides": {}, "space": SPACE, "sampling": 3}
    asked |= changed
    of_run = {name: asked.pop(name) for name in ("keywords", "overrides")}
    return Search(problem_of(ID), RunOptions("bptt", "gain", **of_run), **asked)


def cost_of(run):
    rate = float(run.hyperparameters["learning_rate"].removeprefix("lin_"))
    return 1.0 + 100.0 * abs(rate - 0.003) + run.seed


def pretended(run, session):
    """Training whose validation cost depends on its hyperparameters and its seed only, lowest in the middle."""
    for steps in range(session.validate_every, run.steps + 1, session.validate_every):
        run.steps_done = steps
        if session.validated({"steps": steps, "cost": cost_of(run) + 0.1 * abs(steps - 600) / 1000}):
            break
    save_run(run, session.folder / "run.json")
    return run


def outcome(study):
    return [(trial.params, trial.value, trial.state.name) for trial in finished_trials(study)]


@pytest.mark.parametrize("how", ["crash", "wish"])
def test_a_resumed_search_equals_one_that_never_stopped(how, tmp_path):
    whole = search_hyperparameters(search(), tmp_path / "whole", 14, pretended)
    runs = []

    def interrupted(run, session):
        runs.append(run)
        if len(runs) == 6:  # the second seed of a trial
            if how == "crash":
                raise KeyboardInterrupt
            return run  # unfinished, as after Ctrl-C
        return pretended(run, session)

    folder = tmp_path / "parts"
    try:
        assert len(finished_trials(search_hyperparameters(search(), folder, 14, interrupted))) == 2
    except KeyboardInterrupt:
        assert how == "crash"
    assert len(outcome(search_hyperparameters(search(), folder, 14, pretended))) == 14
    again = search_hyperparameters(search(), folder, 14, pretended)
    assert outcome(again) == outcome(whole)
    assert (folder / "best.yml").read_text().split("\n", 1)[1] == (
        (tmp_path / "whole" / "best.yml").read_text().split("\n", 1)[1]
    )


def test_a_trial_is_worth_its_lowest_costs_and_the_best_is_written(tmp_path):
    study = search_hyperparameters(search(), tmp_path, 5, pretended)
    for trial in finished_trials(study):
        each = [load_run(run_folder(tmp_path, trial.number, seed)) for seed in (0, 1)]
        assert trial.value == pytest.approx(sum(map(cost_of, each)) / 2, rel=1e-12)
        assert each[0].hyperparameters["hidden_size"] == json.loads(trial.params["hidden_size"])
    best = load_run(run_folder(tmp_path, study.best_trial.number, 0))
    trained = new_run(problem_of(ID), RunOptions("bptt", config=tmp_path / "best.yml"))
    for name in ("control", "scenario", "envs", "steps", "hyperparameters"):
        assert getattr(trained, name) == getattr(best, name)


def test_trials_that_fall_behind_are_pruned(tmp_path):
    told = []

    def train(run, session):
        told.append([])

        def keep(entry):
            told[-1].append(entry["steps"])
            return session.validated(entry)

        return pretended(run, replace(session, validated=keep))

    study = search_hyperparameters(search(seeds=(0,)), tmp_path, 20, train)
    states = [trial.state.name for trial in finished_trials(study)]
    assert "PRUNED" not in states[:8]
    assert {"PRUNED", "COMPLETE"} == set(states[8:])
    for state, steps in zip(states, told, strict=True):
        assert (len(steps) < VALIDATIONS) == (state == "PRUNED")


def test_what_cannot_be_trained_with_is_no_reason_to_stop_but_at_the_beginning(tmp_path):
    calls = []

    def train(run, session):
        calls.append(run)
        if len(calls) in failing:
            raise ValueError("actions must be finite")
        return pretended(run, session)

    failing, lines = {3}, []
    study = search_hyperparameters(search(seeds=(0,)), tmp_path / "later", 4, train, report=lines.append)
    assert [trial.state.name for trial in finished_trials(study)] == [
        "COMPLETE",
        "COMPLETE",
        "PRUNED",
        "COMPLETE",
    ]
    assert "failed, actions must be finite" in lines[2]
    calls.clear()
    failing = {1}
    with pytest.raises(ValueError, match="actions must be finite"):
        search_hyperparameters(search(), tmp_path / "first", 4, train)


def test_another_search_is_refused(tmp_path, monkeypatch):
    search_hyperparameters(search(), tmp_path, 1, pretended)
    for name, value in (("steps", 2000), ("seeds", (0,)), ("space", {"hidden_size": [2]}), ("sampling", 4)):
        with pytest.raises(ValueError, match=f"holds a search with {name} .* choose another folder"):
            search_hyperparameters(search(**{name: value}), tmp_path, 1, pretended)
    monkeypatch.setattr("filtergym.agents.search.code_digest", lambda: "of an edited package")
    with pytest.raises(ValueError, match=r"holds a search with code .* choose another folder"):
        search_hyperparameters(search(), tmp_path, 1, pretended)


WITHOUT_SPACE = ("recurrent-ppo", "sac", "dqn")


@pytest.mark.parametrize("algorithm", WITHOUT_SPACE)
def test_an_algorithm_without_a_shipped_space_asks_for_one(algorithm):
    with pytest.raises(ValueError, match=f"no search space of {algorithm} is shipped: write one"):
        read_space(ID, algorithm)


@pytest.mark.parametrize("algorithm", [name for name in training_run.FILES if name not in WITHOUT_SPACE])
def test_shipped_spaces_are_of_settings_that_there_are(algorithm):
    trained = [id for id, cls in catalogue().items() if algorithm in cls.trained_banks]
    for id in trained or [*catalogue(), "some/Other-v0"]:
        space = read_space(id, algorithm)
        study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
        shown = catalogue().get(id, catalogue()[ID]).id
        for _ in range(4):
            chosen = suggest_hyperparameters(study.ask(), space)
            run = new_run(problem_of(shown), RunOptions(algorithm, overrides=chosen))
            rollout = run.envs * chosen.get("n_steps", 0)
            assert rollout % chosen.get("batch_size", 1) == 0
    if algorithm == "bptt":
        for id in catalogue():
            model = new_run(problem_of(id), RunOptions("bptt")).make_model()
            assert (
                max(read_space(id, "bptt")["truncation"])
                == model.task.horizon // model.task.decision_interval
            )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("default: {gamma: {low: 1, high: 0.5}}", "search space of gamma: a range has low and high"),
        ("default: {policy_kwargs: {log_std_init: {low: 1}}}", r"of policy_kwargs\.log_std_init: a range"),
        ("default: {gamma: {low: -1, high: 1, log: true}}", "a range has low and high"),
        ("default: {gamma: 0.5}", "search space of gamma: expected a list or a mapping, got 0.5"),
        ("default: {gamma: []}", "search space of gamma: expected"),
        ("other: {gamma: [1]}", "has no section filtergym/ManeuveringTarget-v0 and none called default"),
        ("[1]", "needs sections"),
    ],
)
def test_spaces_of_another_form(text, message, tmp_path):
    (tmp_path / "space.yml").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_space(ID, "ppo", tmp_path / "space.yml")


def test_the_command_leaves_settings_to_train_with(monkeypatch, capsys, tmp_path):
    from filtergym.__main__ import main

    monkeypatch.setattr(validation, "VALIDATION_EPISODES", 8)
    (tmp_path / "space.yml").write_text("default: {hidden_size: [2, 3], learning_rate: [lin_0.01]}")

    def run(*words):
        monkeypatch.setattr("sys.argv", ["filtergym", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, capsys.readouterr()

    words = (
        "search",
        ID,
        "--algo",
        "bptt",
        "--steps",
        800,
        "--set",
        "algo.n_envs=2",
        "--out",
        tmp_path / "found",
    )
    code, printed = run(*words, "--trials", 2, "--space", tmp_path / "space.yml")
    assert code == 0, printed.err
    assert printed.out.count("validation cost") == 2
    best = tmp_path / "found" / "best.yml"
    words = ("train", ID, "--algo", "bptt", "--config", best, "--out", tmp_path / "run", "--no-compare")
    assert run(*words)[0] == 0
    trained = load_run(tmp_path / "run")
    assert (trained.envs, trained.steps_done) == (2, 800)
    code, printed = run("search", ID, "--algo", "pop", "--out", tmp_path / "x")
    assert (code, printed.err.count("\n")) == (2, 1)
    assert "unknown algorithm 'pop'" in printed.err
    assert not (tmp_path / "x").exists()
