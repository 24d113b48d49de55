"""Observations, actions and rewards in episodes of a policy, as Gymnasium returns them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ..competitors.stepping import SteppingPolicy
from .rollout import Progress


class Transitions(NamedTuple):
    """Observations, actions and rewards in one episode of T decisions."""

    seed: int
    """Seed of the episode, for ``env.reset(seed=...)``."""
    observations: numpy.ndarray
    """Observations, ``(T + 1, fields)``, the last one after the last action, in the type of the observation space."""
    actions: numpy.ndarray
    """Applied actions, ``(T, ...)``, in the action space and its type."""
    rewards: numpy.ndarray
    """Rewards, ``(T,)``."""
    truncations: numpy.ndarray
    """Truncation flags, ``(T,)``, true at the last decision only; no episode of these environments is terminated."""


def transitions_of(
    id: str,
    policy: SteppingPolicy,
    seeds: Sequence[int],
    tick: Progress = lambda decisions: None,
    **keywords: Any,
) -> list[Transitions]:
    """Run a policy in one episode for each seed; return its observations, actions and rewards.

    Actions are clipped to the action space and cast to its type, so that they may differ from those of an
    evaluation by rounding.

    Args:
        id: environment id.
        policy: policy made for the environment; its ``keywords`` make the environment.
        seeds: seeds of the episodes.
        tick: function called with the number of decisions done.
        **keywords: further keywords of ``gymnasium.make_vec``, such as ``reward`` or ``dtype``.

    Returns:
        Transitions of every episode, equal to those of ``gymnasium.make`` with the same keywords, bit for bit.
    """
    envs: Any = gymnasium.make_vec(id, num_envs=len(seeds), **policy.keywords, **keywords)
    observation, _ = envs.reset(seed=list(seeds))
    memory = policy.begin(seeds)
    kept: list[list[numpy.ndarray]] = [[observation], [], [], []]
    finished = numpy.zeros(len(seeds), dtype=bool)
    while not finished.all():  # flights differ in length: finished ones start again, and are cut below
        action, memory = policy.predict(observation, memory)
        action = clip_to_space(envs.single_action_space, action)
        observation, reward, _, truncated, _ = envs.step(action)
        for values, latest in zip(kept, (observation, action, reward, truncated), strict=True):
            values.append(latest)
        finished |= truncated
        tick(len(seeds))
    observations, actions, rewards, truncations = (numpy.stack(values, axis=1) for values in kept)
    found = []
    for i, seed in enumerate(seeds):
        T = int(numpy.argmax(truncations[i])) + 1
        parts = observations[i, : T + 1], actions[i, :T], rewards[i, :T], truncations[i, :T]
        found.append(Transitions(seed, *parts))
    return found


def clip_to_space(space: gymnasium.Space[Any], action: numpy.ndarray) -> numpy.ndarray:
    """Clip a batch of actions to the limits of the action space and cast it to its type."""
    if isinstance(space, gymnasium.spaces.Box):
        action = numpy.clip(action, space.low, space.high)
    return numpy.asarray(action).astype(space.dtype)
