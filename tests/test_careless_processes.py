"""Threads that share what cannot be shared get a sentence; none hangs."""

import threading

import gymnasium
import numpy as np
import pytest

import filtergym  # noqa: F401

RADAR = "filtergym/ManeuveringTarget-v0"


def test_another_thread_on_the_same_environments_is_refused(monkeypatch):
    envs = gymnasium.make_vec(RADAR, num_envs=2)
    envs.reset(seed=0)
    inside, leave, refused = threading.Event(), threading.Event(), []
    step = envs._step_lanes

    def slow(*arguments):
        inside.set()
        leave.wait(60)
        return step(*arguments)

    monkeypatch.setattr(envs, "_step_lanes", slow)
    action = envs.action_space.sample()
    first = threading.Thread(target=lambda: envs.step(action))
    first.start()
    assert inside.wait(60)
    for call in (lambda: envs.step(action), lambda: envs.reset(seed=1)):
        with pytest.raises(
            gymnasium.error.Error, match="another thread steps or resets these environments"
        ) as error:
            call()
        refused.append(error)
    leave.set()
    first.join()
    assert len(refused) == 2
    assert np.isfinite(envs.step(action)[0]).all()  # it goes on
    with pytest.raises(ValueError, match="unknown option"):
        envs.reset(options={"x": 1})
    envs.reset(seed=0)  # a refused reset has left it as it was


def test_a_finished_episode_must_be_reset():
    env = gymnasium.make(RADAR, horizon=3, disable_env_checker=True)
    env.reset(seed=0)
    done = False
    while not done:
        _, _, _, done, _ = env.step(env.action_space.sample())
    with pytest.raises(
        gymnasium.error.ResetNeeded, match="the episode has ended: call reset before the next step"
    ):
        env.step(env.action_space.sample())
    env.reset(seed=0)
    env.step(env.action_space.sample())
