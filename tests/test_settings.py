"""Settings of training runs: which goes before which, what is refused, and that a run keeps and validates with them."""

import csv
import dataclasses
import importlib.util
import itertools
import shlex
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from filtergym import evaluate
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import task_class

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")
from test_agents_training import train

from filtergym.agents import training_run, validation
from filtergym.agents.adapter import to_sb3
from filtergym.agents.bptt import train_bptt
from filtergym.agents.export import export_run
from filtergym.agents.sb3_training import training_environment
from filtergym.agents.settings import ESTIMATORS, RIVALS, merge_settings, parse_settings, read_config
from filtergym.agents.training_run import RunOptions, load_run, new_run, open_run, read_hyperparameters
from filtergym.agents.training_session import Session

ID = "filtergym/ManeuveringTarget-v0"
SMALL = {
    "ppo": {"n_steps": 30, "batch_size": 60, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}},
    "bptt": {"hidden_size": 4, "truncation": 40},
}


@pytest.fixture(autouse=True)
def few_validation_episodes(monkeypatch):
    monkeypatch.setattr(validation, "VALIDATION_EPISODES", 8)


@pytest.fixture
def all_training_scenarios(monkeypatch):
    """As if every scenario were one to train on."""
    cls = task_class(ID)
    every = {name: dataclasses.replace(s, training=True) for name, s in cls.scenarios.items()}
    monkeypatch.setattr(cls, "scenarios", every)


def asked(options, **more):
    return new_run(problem_of(ID), replace(options, **more))


@pytest.mark.parametrize(
    ("word", "env", "algo"),
    [
        ("env.range_sigma=50", {"range_sigma": 50}, {}),
        ("env.reward=relative", {"reward": "relative"}, {}),
        ("env.polar_measurements=false", {"polar_measurements": False}, {}),
        ("env.gains=[0.2, 1e-1]", {"gains": [0.2, 0.1]}, {}),
        ("algo.learning_rate=3e-4", {}, {"learning_rate": 3e-4}),
        ("algo.policy_kwargs.net_arch=[32,32]", {}, {"policy_kwargs": {"net_arch": [32, 32]}}),
        ("algo.policy_kwargs={log_std_init: -1e0}", {}, {"policy_kwargs": {"log_std_init": -1.0}}),
    ],
)  # fmt: skip
def test_settings_are_yaml(word, env, algo):
    assert parse_settings([word]) == (env, algo)


def test_other_forms_are_refused():
    for word in ("range_sigma=50", "env.range_sigma", "env.=1", "agent.x=1", "env..x=1", "="):
        with pytest.raises(ValueError, match=r"--set needs env\.NAME=VALUE or algo\.NAME=VALUE"):
            parse_settings([word])
    with pytest.raises(ValueError, match="cannot read the value"):
        parse_settings(["env.gains=[0.2"])


def test_mappings_are_merged_key_by_key():
    assert merge_settings({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"c": 4}, "d": {"e": 5}}) == {
        "a": {"b": 1, "c": 4},
        "d": {"e": 5},
    }


ZOO = f"""
{ID}:
  n_envs: 4
  gamma: 0.9
  env_kwargs: {{range_sigma: 70.0}}
  policy_kwargs: {{net_arch: [16]}}
default:
  gamma: 0.5
"""
PLAIN = "env: {range_sigma: 70.0}\nalgo: {n_envs: 4, gamma: 0.9, policy_kwargs: {net_arch: [16]}}\n"


@pytest.mark.parametrize("text", [ZOO, PLAIN])
def test_shipped_then_config_then_settings_then_options(text, tmp_path):
    config = tmp_path / "mine.yml"
    config.write_text(text)
    shipped = read_hyperparameters(ID, "ppo")
    run = new_run(problem_of(ID), RunOptions("ppo", config=config))
    assert run.envs == 4
    assert run.hyperparameters["gamma"] == 0.9
    assert run.hyperparameters["gae_lambda"] == shipped["gae_lambda"]
    assert run.hyperparameters["policy_kwargs"] == {**shipped["policy_kwargs"], "net_arch": [16]}
    assert {**run.hyperparameters["env_kwargs"], "control": run.control} == {
        **shipped["env_kwargs"],
        "range_sigma": 70.0,
    }
    overrides, keywords = (
        {"gamma": 0.8, "n_envs": 6},
        {"range_sigma": 60.0, "reward": "cost", "control": "mode"},
    )
    run = new_run(problem_of(ID), RunOptions("ppo", config=config, overrides=overrides, keywords=keywords))
    assert (run.envs, run.hyperparameters["gamma"], run.control) == (6, 0.8, "mode")
    assert run.hyperparameters["env_kwargs"] == {"range_sigma": 60.0, "reward": "cost"}
    run = new_run(
        problem_of(ID),
        RunOptions("ppo", "gain", envs=7, config=config, overrides=overrides, keywords=keywords),
    )
    assert (run.envs, run.control) == (7, "gain")


def test_a_config_may_have_a_default_section(tmp_path):
    config = tmp_path / "mine.yml"
    config.write_text(ZOO)
    assert read_config(config, "mine/Other-v0") == ({}, {"gamma": 0.5})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "needs sections by environment id or default"),
        ("- 1", "needs sections"),
        ("mine/Other-v0: {gamma: 0.5}", f"has no section {ID} and none called default"),
        (f"{ID}: 3", "settings of the algorithm map names to values"),
        ("env: [1]", "settings of the environment map names"),
        ("env: {", "cannot read settings"),
        (f"{ID}: {{gama: 0.5}}", "unknown setting 'algo.gama': did you mean 'algo.gamma'"),
    ],
)
def test_wrong_configs_are_refused(text, message, tmp_path):
    config = tmp_path / "mine.yml"
    config.write_text(text)
    with pytest.raises(ValueError, match=message):
        new_run(problem_of(ID), RunOptions("ppo", config=config))


def test_a_missing_config_is_refused(tmp_path):
    with pytest.raises(ValueError, match="cannot read settings"):
        new_run(problem_of(ID), RunOptions("ppo", config=tmp_path / "none.yml"))


@pytest.mark.parametrize(
    ("algorithm", "keywords", "overrides", "message"),
    [
        ("pop", {}, {}, "unknown algorithm 'pop': did you mean 'ppo'"),
        ("ppo", {"range_sgma": 1.0}, {}, "unknown setting 'env.range_sgma': did you mean 'env.range_sigma'"),
        ("ppo", {"range_sigma": -1.0}, {}, "range_sigma must be"),
        ("ppo", {"reward": "costs"}, {}, "unknown reward 'costs': did you mean 'cost'"),
        ("ppo", {"dtype": "float16"}, {}, "unknown dtype"),
        ("ppo", {"scenario": "paper"}, {}, r"held out: train on a training scenario \(random"),
        ("ppo", {"scenario": "random:0.8,paper:0.2"}, {}, "scenario 'paper' is held out"),
        ("ppo", {"control": "gian"}, {}, "unknown control"),
        ("ppo", {}, {"learning_rte": 1.0}, "'algo.learning_rte': did you mean 'algo.learning_rate'"),
        ("ppo", {}, {"policy_kwargs": {"net_arc": []}}, "unknown setting 'algo.policy_kwargs.net_arc'"),
        ("ppo", {}, {"policy_kwargs": "dict(net_arch=[8])"}, "policy_kwargs maps names to values"),
        ("ppo", {}, {"policy": "MlpPolcy"}, "unknown policy 'MlpPolcy': did you mean 'MlpPolicy'"),
        ("bptt", {}, {"gamma": 0.9}, "unknown setting 'algo.gamma'"),
        ("bptt", {"dtype": "float32"}, {}, "leave out env.dtype"),
    ],
)
def test_wrong_settings_are_refused(algorithm, keywords, overrides, message):
    with pytest.raises(ValueError, match=message):
        new_run(problem_of(ID), RunOptions(algorithm, keywords=keywords, overrides=overrides))


def test_shipped_hyperparameters_pass_the_check_of_settings():
    for algorithm in training_run.FILES:
        # A learned estimator steers a filter of its own, and no control; a rival the one of its file.
        control = {"dqn": "mode", **{name: name for name in ESTIMATORS}, **dict.fromkeys(RIVALS)}.get(
            algorithm, "gain"
        )
        new_run(problem_of(ID), RunOptions(algorithm, control, overrides={"learning_rate": 1e-4}))


def test_settings_reach_the_environment():
    keywords = {"range_sigma": 60.0, "reward": "log-likelihood", "dtype": "float32"}
    env = training_environment(new_run(problem_of(ID), RunOptions("ppo", envs=2, keywords=keywords))).env
    assert env.task.parameters.range_sigma == 60.0
    assert (env.reward_kind, env.options.dtype) == ("log-likelihood", "float32")


def test_training_leaves_the_record_of_its_hyperparameters_alone(tmp_path):
    """Stable-Baselines3's SAC writes into policy_kwargs."""
    small = {"learning_starts": 8, "buffer_size": 50, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    options = RunOptions("sac", "gain", 20, 2, overrides=small)

    train(open_run(tmp_path, asked(options), False), tmp_path)
    open_run(tmp_path, asked(options), True)
    assert load_run(tmp_path).hyperparameters == asked(options).hyperparameters


@pytest.mark.parametrize("algorithm", ["ppo", "bptt"])
def test_a_run_keeps_its_settings_and_validates_and_exports_with_them(algorithm, tmp_path):
    keywords = {"range_sigma": 60.0, "horizon": 40, "reward": "log-likelihood"}
    options = RunOptions(algorithm, "gain", 240, 4, overrides=SMALL[algorithm], keywords=keywords)

    train(open_run(tmp_path, asked(options), False), tmp_path)
    kept = load_run(tmp_path)
    assert kept.hyperparameters["env_kwargs"] == keywords
    assert parse_settings(words_of(kept.command))[0] == keywords
    dataset = evaluate(ID, ["imm"], episodes=8, split="validation", range_sigma=60.0, horizon=40)
    assert kept.validation[0]["paper_cost"] == pytest.approx(float(dataset["cost"].mean()), rel=1e-12)
    # The same again goes on, other settings are refused, and none are those of the run.
    open_run(tmp_path, asked(options, steps=480), True)
    with pytest.raises(ValueError, match=r"hyperparameters.env_kwargs.range_sigma 60.0, not 61.0"):
        open_run(tmp_path, asked(options, steps=480, keywords={**keywords, "range_sigma": 61.0}), True)
    run = open_run(tmp_path, asked(options, steps=480, keywords={}, overrides={}), True, same=True)
    assert run.hyperparameters == kept.hyperparameters
    assert train(run, tmp_path, resume=True).steps_done >= 480
    # What is exported is checked under the same parameters; an evaluation is of whatever it is asked for.
    out = tmp_path / "agent.safetensors"
    cost = export_run(tmp_path, out).exported["cost"]
    own, other = (
        float(evaluate(ID, [str(out)], episodes=32, split="validation", **parameters)["cost"].mean())
        for parameters in ({"range_sigma": 60.0, "horizon": 40}, {})
    )
    assert cost == pytest.approx(own, rel=1e-9)
    assert cost != pytest.approx(other)


def words_of(command):
    words = shlex.split(command)
    return [word for before, word in itertools.pairwise(words) if before == "--set"]


@pytest.mark.parametrize("algorithm", ["ppo", "bptt"])
def test_validations_are_curves_in_the_log(algorithm, tmp_path):
    run = new_run(problem_of(ID), RunOptions(algorithm, "gain", 800, 4, overrides=SMALL[algorithm]))
    train(run, tmp_path, validate_every=300)
    [file] = (tmp_path / "log").glob("*.csv")
    with file.open() as content:
        validated = [row for row in csv.DictReader(content) if row.get("validation/cost")]
    assert len(validated) == len(run.validation) > 1
    for row, entry in zip(validated, run.validation, strict=True):
        # The log rounds nothing but what float to text does.
        assert float(row["validation/cost"]) == pytest.approx(entry["cost"])
        assert float(row["validation/paper_cost"]) == pytest.approx(entry["paper_cost"])
        assert float(row["validation/cost_vs_paper"]) == pytest.approx(entry["relative_cost_difference"][0])
        assert int(row["time/total_timesteps"]) == entry["steps"]
    if importlib.util.find_spec("tensorboard") is not None:
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        events = EventAccumulator(str(tmp_path / "log"))
        events.Reload()
        shown = [(event.step, event.value) for event in events.Scalars("validation/cost")]
        expected = [(entry["steps"], entry["cost"]) for entry in run.validation]
        np.testing.assert_allclose(shown, expected, rtol=1e-6)


# --- mixtures


@pytest.mark.parametrize("algorithm", ["ppo", "bptt"])
@pytest.mark.usefixtures("all_training_scenarios")
def test_training_on_a_mixture(algorithm, tmp_path):
    mixture = {"random": 0.75, "cruise": 0.25}
    options = RunOptions(
        algorithm,
        "gain",
        envs=4,
        scenario="random:3,cruise:1",
        overrides=SMALL[algorithm],
        keywords={"horizon": 20},
    )

    run = train(open_run(tmp_path, asked(options, steps=160), False), tmp_path)
    assert load_run(tmp_path).scenario == "random:0.75,cruise:0.25"
    costs = [
        weight * evaluate(ID, ["imm"], name, episodes=8, split="validation", horizon=20)["cost"].mean().item()
        for name, weight in mixture.items()
    ]
    assert run.validation[0]["paper_cost"] == pytest.approx(sum(costs), rel=1e-12)
    resumed = open_run(tmp_path, asked(options, steps=240), True)
    assert train(resumed, tmp_path, resume=True).steps_done >= 240
    assert export_run(tmp_path, tmp_path / "agent.safetensors").scenario == run.scenario


@pytest.mark.usefixtures("all_training_scenarios")
def test_bptt_learns_mixtures_on_torch_only_and_of_one_length(tmp_path):
    run = new_run(
        problem_of(ID), RunOptions("bptt", "gain", 400, 4, scenario="random:1,paper:1", backend="compiled")
    )
    with pytest.raises(ValueError, match="on torch only"):
        train_bptt(run, Session(tmp_path))
    run = new_run(problem_of(ID), RunOptions("bptt", "gain", 400, 4, scenario="random:1,cruise:1"))
    with pytest.raises(ValueError, match="episodes of one length, not from random:"):
        train_bptt(run, Session(tmp_path))


def test_options_of_a_reset_reach_the_environments_of_an_adapter():
    env = to_sb3(gymnasium.make_vec(ID, num_envs=2, autoreset_mode="SameStep"))
    paper = to_sb3(gymnasium.make_vec(ID, num_envs=2, autoreset_mode="SameStep", scenario="paper"))
    for one in (env, paper):
        one.seed(3)
    env.set_options({"scenario": "paper"})
    np.testing.assert_array_equal(env.reset(), paper.reset())
    env.set_options([{"scenario": "paper"}, {}])
    with pytest.raises(ValueError, match="must be the same for all environments"):
        env.reset()


def test_settings_of_the_command_line(refusal, success, tmp_path):
    config = tmp_path / "mine.yml"
    config.write_text("env: {range_sigma: 70.0}\nalgo: {hidden_size: 4, truncation: 40, n_envs: 2}\n")
    words = ("train", ID, "--algo", "bptt", "--control", "gain", "--no-compare", "--out", tmp_path / "run")
    settings = ("--config", config, "--set", "algo.hidden_size=3", "--set", "env.horizon=50")
    success(*words, *settings, "--reward", "log-likelihood", "--steps", 100)
    run = load_run(tmp_path / "run")
    assert run.hyperparameters["hidden_size"] == 3
    assert run.hyperparameters["env_kwargs"] == {
        "range_sigma": 70.0,
        "horizon": 50,
        "reward": "log-likelihood",
    }
    success(*words, "--envs", 2, "--resume", "--steps", 100)
    assert "hyperparameters" in refusal(*words, "--envs", 2, "--resume", "--set", "env.horizon=60")
