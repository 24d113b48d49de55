"""Peer of the compiled steps: the text of an environment's own step on ``jax.numpy``, under ``jax.jit``.

It computes the same as a compiled step (world, filter, reward, observation), in float64, from given noise.
JAX is no dependency of the project: ``pip install jax``.
"""

import os
from collections.abc import Callable
from typing import Any

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import numpy

from filtergym.compiler.functions import map_arrays
from filtergym.envs.contract.model import Episode, Model
from filtergym.envs.contract.observation import Array
from filtergym.envs.engine.catalogue import import_task
from filtergym.envs.engine.lanes import Lanes
from filtergym.envs.engine.reward import REWARD_FUNCTIONS
from filtergym.envs.engine.scenario_choice import make_task


def jitted_step(id: str, control: str, size: int, **keywords: Any) -> Callable[[], None]:
    """Return a function that runs one step of ``size`` episodes under ``jax.jit``, compiled beforehand.

    Raises:
        ImportError: without JAX.
    """
    import jax
    import jax.numpy

    jax.config.update("jax_enable_x64", True)
    # Traced arrays have a device, on which constants can be placed; on the processor it is None.
    jax.core.Tracer.device = None
    cls = import_task(id)
    lanes = Lanes(Model(make_task(cls, **keywords), control), size)
    for lane, generator in enumerate(numpy.random.default_rng(0).spawn(size)):
        lanes.seed(lane, generator)
    lanes.restart()
    model = Model(make_task(cls, xp=jax.numpy, **keywords), control)
    shape = model.action_space.shape
    given = map_arrays(
        lambda values: jax.numpy.asarray(numpy.asarray(values)[..., :size]),
        (lanes.state, numpy.full((*(shape or ()), size), 0.1 if shape else 0), lanes.next_row()),
    )
    step = jax.jit(lambda episode, action, noise: step_episodes(model, episode, action, noise))

    def once() -> None:
        jax.block_until_ready(step(*given))

    once()
    return once


def step_episodes(
    model: Model, episode: Episode, action: Array, noise: Array
) -> tuple[Episode, Array, Array]:
    """Return episodes at the next measurement, the reward of the action, and the observation."""
    after = model.act(episode, action)
    following = model.measure(after, noise)
    return following, REWARD_FUNCTIONS["cost"](model, after), model.observe(following)
