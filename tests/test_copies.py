"""Environments can be copied and pickled in the middle of an episode, and go on identically."""

import copy
import functools
import pickle

import gymnasium
import numpy as np
import pytest

make_three = functools.partial(gymnasium.make_vec, num_envs=3)
NEEDED = {"numpy": "numpy", "compiled": "llvmlite", "torch": "torch"}
WAYS = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


def continued(env, actions):
    """Everything that some steps return."""
    return [np.asarray(part) for action in actions for part in env.step(action)[:4]]


@pytest.mark.parametrize(
    ("make", "backend"),
    [(gymnasium.make, "numpy"), (gymnasium.make, "compiled"), *((make_three, backend) for backend in NEEDED)],
)
def test_copies_go_on_as_the_original(env_id, short, make, backend):
    pytest.importorskip(NEEDED[backend])
    env = make(env_id, backend=backend, **short)
    env.reset(seed=3)
    env.action_space.seed(0)
    # Vectors go on beyond the end of an episode of five decisions, single environments to it.
    first, then = (
        [env.action_space.sample() for _ in range(n)] for n in (3, 2 if make is gymnasium.make else 8)
    )
    continued(env, first)
    others = [way(env) for way in WAYS.values()]
    expected = continued(env, then)
    following = env.reset()[0]
    for other in others:
        for one, two in zip(expected, continued(other, then), strict=True):
            np.testing.assert_array_equal(one, two)
        # The next episode is the same, too.
        np.testing.assert_array_equal(following, other.reset()[0])
