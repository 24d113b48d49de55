"""State-space models that several test files make and run."""

import gymnasium
import numpy as np

import filtergym
from filtergym.baselines import catalogue as baselines
from filtergym.envs.engine import registration
from filtergym.envs.engine.backend import make_model


def make_models(common):
    """Yield a function that makes an environment of some keywords; forget all that it has made."""
    made = []

    def state_space(**keywords):
        id = f"mine/Model{len(made)}-v0"
        made.append(id)
        return filtergym.state_space(id, **{**common, **keywords})

    yield state_space
    for id in made:
        forget(id)


def forget(id):
    for table in (registration.USER_TASKS, baselines.USER_BASELINES, gymnasium.registry):
        table.pop(id, None)


def simulate(cls, steps, episodes, seed=0, backend="numpy", control=None, **keywords):
    """Truths and measurements of some episodes and the final state of the bank's filter at every one."""
    model = make_model(cls, control, backend=backend, **keywords)
    rng = np.random.default_rng(seed)
    noise = model.task.noise
    episode = model.begin(
        rng.random((noise.uniforms, episodes)), rng.standard_normal((noise.initial_normals, episodes))
    )
    start, kept = episode, []
    action = np.zeros((*model.action_space.shape, episodes))
    for _ in range(steps):
        row = [rng.standard_normal((noise.normals, episodes)), rng.random((noise.row_uniforms, episodes))]
        episode = model.act(model.measure(episode, np.concatenate(row)), action)
        kept.append((episode.truth, episode.measurement, model.mean(episode), model.covariance(episode)))
    return start, kept
