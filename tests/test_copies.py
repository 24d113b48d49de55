"""Environments can be copied and pickled in the middle of an episode, and go on identically."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest

NEEDED = {"numpy": "numpy", "compiled": "llvmlite", "torch": "torch"}
WAYS = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


def continued(env, actions):
    """Everything that some steps return."""
    return [np.asarray(part) for action in actions for part in env.step(action)[:4]]


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
@pytest.mark.parametrize("way", WAYS)
def test_single_environments(env_id, short, way, backend):
    pytest.importorskip(NEEDED[backend])
    env = gymnasium.make(env_id, backend=backend, **short)
    env.reset(seed=3)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(8)]
    continued(env, actions[:3])
    other = WAYS[way](env)
    expected = continued(env, actions[3:])
    for one, two in zip(expected, continued(other, actions[3:]), strict=True):
        np.testing.assert_array_equal(one, two)
    # The next episode is the same, too.
    np.testing.assert_array_equal(env.reset()[0], other.reset()[0])


@pytest.mark.parametrize("backend", NEEDED)
@pytest.mark.parametrize("way", WAYS)
def test_vector_environments(env_id, short, way, backend):
    pytest.importorskip(NEEDED[backend])
    env = gymnasium.make_vec(env_id, num_envs=3, backend=backend, **short)
    env.reset(seed=3)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(30)]
    continued(env, actions[:3])
    other = WAYS[way](env)
    for one, two in zip(continued(env, actions[3:]), continued(other, actions[3:]), strict=True):
        np.testing.assert_array_equal(one, two)
