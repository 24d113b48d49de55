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


def compare_lanes(start, kept, follow):
    """Compare the last estimate of every lane with the one that ``follow(mean, covariance, lane)`` makes of the first.

    Rounding alone is between them.
    """
    first, (_, _, means, covariances) = start.measurement, kept[-1]
    for lane in range(means.shape[1]):
        mean, P = follow(first.mean[:, lane], first.covariance[:, :, lane], lane)
        np.testing.assert_allclose(means[:, lane], mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(covariances[:, :, lane], P, rtol=1e-12, atol=1e-12)


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
