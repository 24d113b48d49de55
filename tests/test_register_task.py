"""An environment of a user's own package is a citizen: nothing here is in the catalogue by itself."""

import json
import pickle
import sys
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import pytest
from own_models import forget

import filtergym
from filtergym.baselines import catalogue as baselines
from filtergym.baselines.problem import import_problem
from filtergym.baselines.table import Baselines
from filtergym.envs.contract.observation import Block, Quantity
from filtergym.envs.contract.task import Task
from filtergym.envs.engine import registration
from filtergym.envs.engine.catalogue import catalogue, task_class
from filtergym.envs.maneuvering_target.task import ManeuveringTarget
from filtergym.evaluation.competitors.kinds import ConstantPolicy
from filtergym.evaluation.running.parallel import Workers
from filtergym.reports.pages.outcome import outcome_sentences
from filtergym.reports.tables.results import read_results

MODULE = '''
import filtergym
from filtergym.envs.contract.companions import Paper, PictureMaker
from filtergym.envs.maneuvering_target.task import ManeuveringTarget
from filtergym.evaluation.competitors.kinds import ConstantPolicy


class Turns(ManeuveringTarget):
    """An aircraft that turns, once more."""

    id = "mine/Turns-v0"
    companions = (Paper("unknown"), PictureMaker(lambda model: None), *ManeuveringTarget.companions)


class Middle(ConstantPolicy):
    control = "gain"
    action = (0.0,)


filtergym.register_task(Turns)
'''
ID = "turns_package:mine/Turns-v0"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Folder of a module that registers an environment on import; forgotten after the test."""
    (tmp_path / "turns_package.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("turns_package", None)
    forget("mine/Turns-v0")


@pytest.fixture
def turns():
    class Turns(ManeuveringTarget):
        id = "mine/Turns-v0"

    yield Turns
    forget(Turns.id)


def test_gymnasium_makes_and_renders_it(package):
    env = gymnasium.make(ID, control="gain", render_mode="rgb_array", horizon=5)
    own = gymnasium.make("filtergym/ManeuveringTarget-v0", control="gain", horizon=5)
    observation, _ = env.reset(seed=3)
    np.testing.assert_array_equal(observation, own.reset(seed=3)[0])
    assert env.render().shape == (608, 960, 3)
    assert "mine/Turns-v0" in catalogue()
    assert "mine/Turns-v0" not in filtergym.envs.engine.catalogue.folders()


def test_a_spawned_process_finds_it(package):
    vector = gymnasium.make_vec(
        ID, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"}, horizon=5
    )
    try:
        observation, _ = vector.reset(seed=3)
    finally:
        vector.close()
    np.testing.assert_array_equal(observation[0], gymnasium.make(ID, horizon=5).reset(seed=3)[0])


def test_an_experiment_goes_to_another_process_by_the_name_of_its_task(package):
    experiment = import_problem(ID).experiment("paper", 3, seed=2, keywords={"horizon": 20})
    assert pickle.loads(pickle.dumps(experiment)) == experiment
    packed = pickle.dumps(experiment)
    sys.modules.pop("turns_package")
    forget("mine/Turns-v0")
    found = pickle.loads(packed)
    assert found.task is not experiment.task  # its module was imported anew
    assert found.task is task_class("mine/Turns-v0")
    assert replace(found, task=experiment.task) == experiment


def test_an_environment_of_the_program_that_runs_is_not_sent(turns):
    turns.__module__ = "__main__"
    filtergym.register_task(turns)
    with (
        Workers(2) as two,
        pytest.raises(ValueError, match=r"^mine/Turns-v0 is registered by the running program"),
    ):
        filtergym.evaluate(turns.id, ["random"], episodes=2, workers=two)


def test_evaluation_without_baselines(package):
    dataset = filtergym.evaluate(
        ID, {"mine": "turns_package:Middle", "random": "random"}, episodes=3, horizon=20
    )
    records = filtergym.tidy_records(dataset)
    assert {r.policy for r in records} == {"mine", "random"}
    assert {r.environment for r in records} == {"mine/Turns-v0"}
    assert not {"score", "cost_difference"} & {r.metric for r in records}
    with pytest.raises(ValueError, match="unknown policy 'imm': choose from paper, random"):
        filtergym.evaluate(ID, ["imm"])
    # The action that the class declares is the paper's algorithm of the environment that it equals.
    own = filtergym.evaluate(ID, ["paper"], episodes=3, horizon=20)["cost"]
    equal = filtergym.evaluate("filtergym/ManeuveringTarget-v0", ["zero"], "random", 3, horizon=20)["cost"]
    np.testing.assert_array_equal(own, equal)


def test_evaluation_with_baselines(turns):
    """With the tables of the environment that it equals, it comes out as that does."""
    original = "filtergym/ManeuveringTarget-v0"
    filtergym.register_task(turns)
    filtergym.register_task(turns, replace(baselines.baselines_of(original), environment=turns.id))
    names = ["imm", "adaptive", "known-turn", "known-input-bound"]
    own, others = (
        {
            (r.policy, r.kind, r.metric, r.component, r.window): r.value
            for r in filtergym.tidy_records(filtergym.evaluate(id, names, episodes=8, horizon=40))
        }
        for id in (turns.id, original)
    )
    assert own == others
    assert ("adaptive", "policy", "score", "", "all") in own


def test_the_command_line_lists_and_evaluates_it(package, success, monkeypatch):
    monkeypatch.chdir(package)
    listed = success("list", ID)
    assert listed.startswith(ID)
    assert "unknown" in listed
    success("benchmark", "--environment", ID, "--out", "results")
    assert list(outcome_sentences(read_results(package / "results")[0]))


def test_training_with_default_hyperparameters(package, success, monkeypatch):
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(package)
    steps = ("--steps", "1000", "--envs", "4", "--validate-every", "100000")
    success("train", ID, "--algo", "ppo", *steps, "--out", "run")
    record = json.loads((package / "run" / "run.json").read_text())
    assert record["environment"] == ID
    assert record["validation"][-1]["paper"] == "paper"
    success("export", "run", "--trust")
    success("evaluate", ID, "--policy", "run/agent.safetensors", "--episodes", "3")


def test_what_ships_keeps_the_contract():
    for cls in catalogue().values():
        registration._check_contract(cls)


@dataclass(frozen=True)
class NoHorizon:
    decision_interval: int = 1


def broken(**attributes):
    return type("Broken", (ManeuveringTarget,), {"id": "mine/Broken-v0", **attributes})


GAIN = ManeuveringTarget.banks["gain"]


def rows(state, measurement):
    return GAIN.mean(None, state)


class Stumbling(ManeuveringTarget):
    id = "mine/Stumbling-v0"

    def __init__(self, *arguments, **keywords):
        raise KeyError("sigma")


def with_bank(**members):
    """A task whose bank of control ``gain`` has other members."""
    bank = type("Gain", (GAIN,), members)
    return broken(banks={**ManeuveringTarget.banks, "gain": bank})


def with_world(**members):
    return broken(World=type("World", (ManeuveringTarget.World,), members))


def further(value, **options):
    """Blocks of the control ``gain``, and one more."""
    return property(lambda self: (*GAIN.blocks.fget(self), Block("more", value, "one more", **options)))


def fail(*_):
    raise KeyError("gamma")


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        (with_bank(blocks=further(rows)), "block 'more' has 4 rows for 1 field: name in its parts"),
        (with_bank(blocks=further(lambda *_: 1.0)), r"block 'more' must be numbers of shape .*, got float"),
        (with_bank(blocks=further(lambda s, _: np.nan * rows(s, _)[0])), "block 'more' must be finite"),
        (with_bank(blocks=further(fail)), r"fails in block 'more': KeyError: 'gamma' \(test_register_task"),
        (
            with_bank(quantities=(Quantity("q", "m", "", lambda _: np.ones(3)),)),
            r"quantity 'q' .* got \(3,\)",
        ),
        (with_bank(mean=lambda self, s: rows(s, None).T), r"mean of the comp.* shape \(4, 24\).* \(24, 4\)"),
        (with_bank(covariance=lambda self, s: rows(s, None)), r"covariance of .* shape \(4, 4, 24\)"),
        (with_bank(action_space=gymnasium.spaces.Box(-np.inf, np.inf, (1,))), "Box .* with finite limits"),
        (with_bank(act=fail), r"'gain' fails in act: KeyError: 'gamma' \(test_register_task.py, line"),
        (with_bank(records=lambda *_: {"nis": np.ones((1, 24))}), "record 'nis' must be numbers of shape"),
        (with_world(cost=lambda self, truth, mean: mean[:1]), r"cost must be .* \(24,\).* got .* \(1, 24\)"),
        (with_world(state=lambda self, truth: np.ones((3, 24))), "fails in error|error of the components"),
        (with_world(context=lambda self, truth: {"level": np.ones(3)}), "context 'level' must be numbers"),
        (with_world(advance=fail), "fails in measure: KeyError"),
        (broken(id="filtergym/UavAutopilot-v0"), "'filtergym/UavAutopilot-v0' is there already"),
        (int, "subclass of filtergym.envs.contract.task.Task"),
        (type("Empty", (Task,), {}), "Empty lacks the class attributes id"),
        (broken(id="Turns"), "such as 'mine/Broken-v0', got 'Turns'"),
        (broken(banks={}), "needs at least one control"),
        (broken(scenarios={}), "needs its default scenario 'random' among its scenarios, got none"),
        (broken(Parameters=NoHorizon), "with horizon and decision_interval"),
        (Stumbling, "cannot be made with control 'evidence': KeyError"),
    ],
)
def test_an_ill_formed_task_gets_one_sentence(task, expected):
    before = set(catalogue())
    with pytest.raises(ValueError, match=expected) as caught:
        filtergym.register_task(task)
    assert "\n" not in str(caught.value)
    assert set(catalogue()) == before


def test_baselines_must_fit_the_task(turns):
    class Elsewhere(ConstantPolicy):
        control = "throttle"
        action = (0.0,)

    class NoKind:
        knows = "nothing"

    class Silent:
        kind = "bound"

    for table, expected in (
        (Baselines("mine/Other-v0", {}), "are of 'mine/Other-v0', not of 'mine/Turns-v0'"),
        (Baselines(turns.id, {}, score_paper="imm"), "unknown policy as score_paper 'imm'"),
        (Baselines(turns.id, {"far": Elsewhere}), "unknown control of policy 'far' 'throttle'"),
        (Baselines(turns.id, {}, {"none": NoKind}), "stands in the table as reference"),
        (Baselines(turns.id, {}, bounds={"none": Silent}), "does not state what it knows"),
    ):
        with pytest.raises(ValueError, match=expected):
            filtergym.register_task(turns, table)
