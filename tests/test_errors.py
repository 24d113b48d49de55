"""Bad input gets one clear error that names the value and what was expected."""

import gymnasium as gym
import numpy as np
import pytest
from models import make_model

import filtergym
from filtergym import evaluate
from filtergym.envs.engine.catalogue import task_class
from filtergym.envs.interface.environment import TaskEnv
from filtergym.envs.interface.vector_environment import TaskVectorEnv
from filtergym.names import competitor

ID = "filtergym/ManeuveringTarget-v0"


@pytest.mark.parametrize("make", [TaskEnv, TaskVectorEnv, make_model])
def test_names_are_completed(make):
    for keywords, message in (
        ({"control": "wieghts"}, "unknown control 'wieghts': did you mean 'weights'"),
        ({"scenario": "papper"}, "unknown scenario 'papper': did you mean 'paper'"),
        ({"range_sigmas": 50.0}, "argument 'range_sigmas', .*: did you mean 'range_sigma'"),
    ):
        with pytest.raises(ValueError, match=message):
            make(ID, **keywords)
    with pytest.raises(ValueError, match=rf"unknown environment .*Manoeuvring.*did you mean '{ID}"):
        make("filtergym/ManoeuvringTarget-v0")
    if make is not make_model:
        with pytest.raises(ValueError, match="unknown reward 'costs': did you mean 'cost'"):
            make(ID, reward="costs")


def test_short_names_of_environments():
    assert task_class("ManeuveringTarget") is task_class("ManeuveringTarget-v0") is task_class(ID)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"transition": ((0.9, 0.2), (0.1, 0.9))}, r"transition\[0\] must sum to 1, got \(0.9, 0.2\) with sum 1.1"),
        ({"transition": ((1.1, -0.1), (0.1, 0.9))}, r"transition\[0\]\[0\] must be .* at most 1"),
        ({"transition": ((0.9, 0.1),)}, "transition must have 2 rows"),
        ({"transition": ((0.9, 0.1, 0.0), (0.1, 0.9, 0.0))}, r"transition\[0\] must be 2 numbers"),
        ({"gains": (0.0, 0.7)}, r"gains\[0\] must be .*above 0.*got 0.0"),
        ({"gains": (0.3,)}, "at least two filters"),
        ({"gains": "0.3"}, "gains must be a sequence of numbers"),
        ({"gains": (0.2, 0.5, 0.8)}, "transition must have 3 rows"),
        ({"initial_probabilities": (0.5, 0.6)}, "initial_probabilities.*sum to 1"),
        ({"alpha_range": (0.9, 0.1)}, "alpha_range must be in ascending order"),
        ({"sampling_interval": float("inf")}, "sampling_interval must be a finite number"),
        ({"bearing_sigma": 90.0}, "bearing_sigma must be .*below 90"),
        ({"horizon": True}, "horizon must be an integer of at least 1"),
        ({"horizon": 10**400}, "horizon must be an integer of at least 1, got a whole number of 400 digits"),
        ({"decision_interval": 7}, "horizon must be a multiple of decision_interval, got 100 and 7"),
        ({"flight": "loop"}, "flight must be one of 'maneuver', 'random'"),
        ({"flight": "legs"}, "needs at least one leg"),
        ({"flight": "track", "scan_jitter": (0.0, 0.0), "track": ((0.0,),)}, "four rows"),
        ({"flight": "track"}, "has no states between its scans, got scan_jitter"),
        ({"speed": (60.0, 300.0, 400.0)}, "speed must be 2 numbers"),
    ],
)  # fmt: skip
def test_parameter_values(keywords, message):
    with pytest.raises(ValueError, match=message):
        gym.make(ID, **keywords)


BAD_ACTIONS = {
    "gain": [[np.nan], [np.inf], [[0.0]], 0.0, [0.0, 0.0], ["up"], None, []],
    "weights": [[0.5], [np.nan, 0.5], [[0.5, 0.5]], 1],
    "mode": [2, -1, 0.0, 0.5, [0], np.nan, "0"],
}


@pytest.mark.parametrize("control", BAD_ACTIONS)
def test_bad_actions_say_what_arrived_and_change_nothing(control):
    env, reference = (gym.make(ID, control=control, disable_env_checker=True).unwrapped for _ in range(2))
    env.reset(seed=0), reference.reset(seed=0)
    for action in BAD_ACTIONS[control]:
        with pytest.raises(ValueError, match=r"expected (finite|integer) actions .*shape .*got"):
            env.step(action)
    good = np.int64(1) if control == "mode" else np.full(env.action_space.shape, 0.5)
    np.testing.assert_array_equal(env.step(good)[0], reference.step(good)[0])


def test_bad_vector_actions():
    env = gym.make_vec(ID, num_envs=2, control="gain")
    env.reset(seed=0)
    for shape in ((2,), (3, 1), (2, 2), (1, 2)):
        with pytest.raises(ValueError, match=r"shape \(2, 1\), got float64 of shape"):
            env.step(np.zeros(shape))
    for wrong in ([[0.5], [np.nan]], [[np.inf], [-np.inf]]):  # which cancel
        with pytest.raises(ValueError, match="finite"):
            env.step(np.array(wrong))
    env = gym.make_vec(ID, num_envs=3, control="mode")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="from 0 to 1"):
        env.step(np.array([0, 1, 2]))


def test_large_finite_actions_are_taken_at_the_edge():
    env, edge = (gym.make_vec(ID, num_envs=2, control="gain") for _ in range(2))
    env.reset(seed=0), edge.reset(seed=0)
    large = np.full((2, 1), 3e38, dtype=np.float32)
    np.testing.assert_array_equal(env.step(large)[0], edge.step(np.ones((2, 1), dtype=np.float32))[0])


def test_steps_before_a_reset():
    with pytest.raises(gym.error.ResetNeeded):
        TaskEnv(ID).step([0.0])


def test_competitors_that_cannot_be(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.zip").touch()
    for names, message in (
        (["adaptve"], "unknown policy 'adaptve': did you mean 'adaptive'"),
        (["mine"], r"unknown policy 'mine': write the whole file name, mine\.zip"),
        ([], "at least one policy"),
        (3, "competitors are a name, a sequence of names, or a mapping"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluate(ID, names, episodes=1)
    for policy, control in (("imm", "gain"), ("adaptive", "weights"), ("zero", "mode")):
        with pytest.raises(ValueError, match=f"policy '{policy}' is made for control .*, not '{control}'"):
            evaluate(ID, [policy], episodes=1, control=control)
    for name in ("nowhere:Policy", "math:Policy"):
        with pytest.raises(ValueError, match=f"cannot load policy '{name}'"):
            competitor(ID, name)


def test_a_bad_action_of_a_users_policy():
    class Wrong:
        control = "gain"

        def __init__(self, task):
            pass

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.full((len(observation), 1), np.nan), state

    with pytest.raises(ValueError, match="finite"):
        evaluate(ID, {"wrong": Wrong}, episodes=2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "papper"}, "did you mean 'paper'"),
        ({"episodes": 0}, "episodes must be an integer of at least 1"),
        ({"seed": -1}, "seed must be an integer of at least 0"),
        ({"split": "tset"}, "did you mean 'test'"),
        ({"control": "wieghts"}, "did you mean 'weights'"),
        ({"gains": (0.3, 1.5)}, "gains"),
        ({"gain": (0.3, 0.5)}, "did you mean 'gains'"),
        ({"episodes": True}, "episodes must be an integer of at least 1, got True"),
        ({"split": ["test"]}, "unknown split"),
        ({"drawn_episodes": -1}, "drawn_episodes must be an integer of at least 0, got -1"),
        ({"workers": 2}, r"workers must be .*Workers\(2\), got 2"),
        ({"sampling_interval": 1e300}, "sampling_interval must be .* at most 86400.0, got 1e"),
    ],
)
def test_evaluation_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        evaluate(ID, ["random"], **{"episodes": 1, **arguments})


class Answering:
    def __init__(self, answer):
        self.answer = answer

    def start(self, initial, N):
        return initial

    def update(self, memory, measurement):
        return self.answer(memory.mean), memory.covariance, memory


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda mean: mean + 0j, "no array: expected an array of real numbers, got complex128"),
        (lambda mean: np.ma.masked_array(mean, mean > 0.0), "real numbers, got a masked array of float64"),
        (lambda mean: mean.astype(str), "expected an array of real numbers, got <U"),
        (lambda mean: None, "expected an array of real numbers, got object"),
    ],
)
def test_means_that_are_no_numbers(answer, message):
    with pytest.raises(ValueError, match=message):
        evaluate(ID, {"own": Answering(answer)}, episodes=1)


def test_a_recording_that_is_no_path():
    for path in (None, 3, [None], {}):
        with pytest.raises(ValueError, match="files are named by a path or a pattern"):
            filtergym.read_recording(path)


@pytest.mark.parametrize(
    "odd",
    [
        {"progress": [1.0]},
        {"control": np.eye(2)},
        {"scenario": np.eye(2)},
        {"competitors": np.eye(2)},
        {"competitors": "é" * 500},
        {"competitors": {"imm": np.eye(2)}},
        {"backend": np.eye(2)},
        {"range_sigma": 10**400},
        {"range_sigma": 1e308},
        {"env": np.eye(2)},
    ],
    ids=lambda odd: " ".join(f"{name} {type(value).__name__}" for name, value in odd.items()),
)
def test_odd_arguments_of_an_evaluation_get_one_sentence(odd):
    given = {"env": ID, "competitors": "imm", "episodes": 1, "horizon": 4, **odd}
    with pytest.raises(ValueError, match=r".{20}") as error:
        evaluate(**given)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1000
    assert "ambiguous" not in str(error.value)  # NumPy's
