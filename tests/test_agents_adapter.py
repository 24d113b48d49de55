"""The adapter gives Stable-Baselines3 what DummyVecEnv gives over monitored single environments."""

import pickle

import gymnasium
import numpy as np
import pytest

from filtergym.envs.interface.environment import TaskEnv
from filtergym.envs.interface.vector_environment import TaskVectorEnv

pytest.importorskip("stable_baselines3")
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from filtergym.agents import to_sb3

ID = "filtergym/ManeuveringTarget-v0"


def native(count, staggered=False, control="gain", **keywords):
    env = gymnasium.make_vec(ID, num_envs=count, autoreset_mode="SameStep", control=control, **keywords)
    return to_sb3(env, staggered)


def dummy(count, control="gain", **keywords):
    return DummyVecEnv([lambda: Monitor(TaskEnv(ID, control=control, **keywords)) for _ in range(count)])


def compare(one, other, steps, draw):
    """Step both and compare everything; returns the number of episodes that ended."""
    ends = 0
    for _ in range(steps):
        action = draw()
        observation, reward, done, infos = one.step(action)
        other_observation, other_reward, other_done, other_infos = other.step(action)
        np.testing.assert_array_equal(observation, other_observation)
        np.testing.assert_array_equal(reward, other_reward)
        np.testing.assert_array_equal(done, other_done)
        assert reward.dtype == other_reward.dtype
        assert observation.dtype == other_observation.dtype
        for info, other_info in zip(infos, other_infos, strict=True):
            assert info.keys() == other_info.keys()
            assert info["TimeLimit.truncated"] == other_info["TimeLimit.truncated"]
            if "episode" in info:
                ends += 1
                np.testing.assert_array_equal(
                    info["terminal_observation"], other_info["terminal_observation"]
                )
                # Both round the return to six decimals; Python's sum may compensate rounding, NumPy's does not.
                assert info["episode"]["r"] == pytest.approx(
                    other_info["episode"]["r"], rel=1e-12, abs=1.1e-6
                )
                assert info["episode"]["l"] == other_info["episode"]["l"]
                assert 0.0 <= info["episode"]["t"] < 600.0
    return ends


@pytest.mark.parametrize("control", ["mode", "evidence"])
def test_equals_dummy_vec_env_over_hundreds_of_episodes(control):
    one, other = native(11, control=control, horizon=7), dummy(11, control=control, horizon=7)
    one.seed(5)
    other.seed(5)
    np.testing.assert_array_equal(one.reset(), other.reset())
    rng = np.random.default_rng(0)
    space = one.action_space

    def draw():
        if isinstance(space, gymnasium.spaces.Discrete):
            return rng.integers(0, space.n, 11)
        return rng.uniform(space.low, space.high, (11, *space.shape)).astype(space.dtype)

    assert compare(one, other, 35, draw) == 11 * 5
    # A reset in the middle of episodes, without seeds: both go on drawing from their generators.
    compare(one, other, 3, draw)
    for env in (one, other):
        env.set_options({"nothing": 1})
        with pytest.raises(ValueError, match="option"):
            env.reset()
        env.set_options({})
    np.testing.assert_array_equal(one.reset(), other.reset())
    assert compare(one, other, 14, draw) == 22


def test_staggered_episodes_are_shorter_once():
    env = native(6, staggered=True, horizon=12)
    env.seed(3)
    env.reset()
    lengths = [[] for _ in range(6)]
    most_at_once = 0
    for _ in range(36):
        _, _, done, infos = env.step(np.zeros((6, 1), np.float32))
        most_at_once = max(most_at_once, done.sum())
        for lane in np.flatnonzero(done):
            lengths[lane].append(infos[lane]["episode"]["l"])
    assert [each[0] for each in lengths] == [12, 10, 8, 6, 4, 2]
    assert {length for each in lengths for length in each[1:]} == {12}
    assert most_at_once == 1


@pytest.mark.parametrize("wrong", [[0, 0], [0, 0, 9], [0, 0, -1], [0.0, 1.0, 2.0]])
def test_shortened_by_is_checked(wrong):
    env = TaskVectorEnv(ID, 3, horizon=9)
    with pytest.raises(ValueError, match=r"'shortened_by'\] must hold 3 integers from 0 to 8"):
        env.reset(options={"shortened_by": np.array(wrong)})


def test_snapshot_continues_to_the_bit():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (40, 5, 1)).astype(np.float32)
    env = native(5, staggered=True, horizon=8)
    env.seed(2)
    env.reset()
    for action in actions[:13]:
        env.step(action)
    kept = pickle.dumps(env.snapshot())
    expected = [env.step(action) for action in actions[13:]]
    other = native(5, staggered=True, horizon=8)
    other.restore(pickle.loads(kept))
    for action, (observation, reward, done, infos) in zip(actions[13:], expected, strict=True):
        again = other.step(action)
        np.testing.assert_array_equal(again[0], observation)
        np.testing.assert_array_equal(again[1], reward)
        np.testing.assert_array_equal(again[2], done)
        assert [i.get("episode", {}).get("r") for i in again[3]] == [
            i.get("episode", {}).get("r") for i in infos
        ]
    with pytest.raises(ValueError, match="holds 5 environments, not 4"):
        native(4).restore(pickle.loads(kept))


def test_shared_attributes():
    env = native(3)
    assert env.get_attr("num_envs", indices=[0, 2]) == [3, 3]
    assert env.env_is_wrapped(Monitor) == [True] * 3
    with pytest.raises(NotImplementedError, match="make a new vector environment"):
        env.set_attr("horizon", 5)
    with pytest.raises(NotImplementedError, match="one native object"):
        env.env_method("render")


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({}, "autoreset_mode=\"SameStep\", got 'NextStep'"),
        ({"autoreset_mode": "SameStep", "backend": "torch"}, "backend='numpy', got 'torch'"),
        ({"autoreset_mode": "SameStep", "detailed_info": True}, "detailed_info"),
        ({"autoreset_mode": "SameStep", "context": True}, "context for each environment"),
    ],
)
def test_refused_with_the_reason(keywords, message):
    with pytest.raises(ValueError, match=message):
        to_sb3(TaskVectorEnv(ID, 2, **keywords))
    with pytest.raises(ValueError, match=r"made by gymnasium\.make_vec, got TaskEnv"):
        to_sb3(TaskEnv(ID))
