"""Environments can be copied and pickled in the middle of an episode, and go on identically."""

import copy
import functools
import pickle

import gymnasium
import numpy as np
import pytest
from contract import BACKENDS, continued
from models import KINDS

make_three = functools.partial(gymnasium.make_vec, num_envs=3)
WAYS = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


@pytest.mark.parametrize("env_id", KINDS)
def test_copies_go_on_as_the_original(env_id, short):
    """One pass over an environment: single and many, each backend that is here, each way to copy."""
    for backend in BACKENDS:
        makers = (make_three,) if backend == "torch" else (gymnasium.make, make_three)
        for make in makers:
            assert_copies_go_on(make(env_id, backend=backend, **short), single=make is gymnasium.make)


def assert_copies_go_on(env, single):
    """Copies from the middle of an episode return what the original does, in the next episode, too."""
    env.reset(seed=3)
    env.action_space.seed(0)
    # Vectors go on beyond the end of an episode of five decisions, single environments to it.
    first, then = ([env.action_space.sample() for _ in range(n)] for n in (3, 2 if single else 8))
    continued(env, first)
    others = {way: copied(env) for way, copied in WAYS.items()}
    expected = continued(env, then)
    following = env.reset()[0]
    kind = "single" if single else "vector"
    for way, other in others.items():
        told = f"{way} of a {kind} of {env.unwrapped.task.id} on {env.unwrapped.backend}"
        for one, two in zip(expected, continued(other, then), strict=True):
            np.testing.assert_array_equal(one, two, err_msg=f"{told}: its steps")
        np.testing.assert_array_equal(following, other.reset()[0], err_msg=f"{told}: its next episode")
