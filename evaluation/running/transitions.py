"""What an agent meets in episodes of a policy: observations, actions and rewards, as Gymnasium gives them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ..competitors.stepping import SteppingPolicy
from .rollout import Progress


class Transitions(NamedTuple):
    """One episode of T decisions, of an environment and its seed."""

    seed: int
    """``env.reset(seed=...)`` begins the same episode."""
    observations: numpy.ndarray
    """``(T + 1, fields)``, the last one after the last action, in the type of the observation space."""
    actions: numpy.ndarray
    """``(T, ...)``, as they were applied: in the action space, and in its type."""
    rewards: numpy.ndarray
    """``(T,)``."""
    truncations: numpy.ndarray
    """``(T,)``, true at the last decision only; no episode of these environments is terminated."""


def transitions_of(
    id: str,
    policy: SteppingPolicy,
    seeds: Sequence[int],
    tick: Progress = lambda decisions: None,
    **keywords: Any,
) -> list[Transitions]:
    """Step a policy through one episode for each seed, side by side in the native vector environment.

    Actions are brought into the action space and its type before they are applied, since that is what an agent that
    learns from them can do: they may differ from those of an evaluation by rounding.

    Args:
        id: environment id.
        policy: made for it; its ``keywords`` make the environment.
        seeds: of the episodes.
        tick: called with the number of decisions done.
        **keywords: further ones of ``gymnasium.make_vec``, such as ``reward`` or ``dtype``.

    Returns:
        Of every episode what ``gymnasium.make`` with the same keywords gives, bit for bit.
    """
    envs: Any = gymnasium.make_vec(id, num_envs=len(seeds), **policy.keywords, **keywords)
    observation, _ = envs.reset(seed=list(seeds))
    memory = policy.begin(seeds)
    kept: list[list[numpy.ndarray]] = [[observation], [], [], []]
    finished = numpy.zeros(len(seeds), dtype=bool)
    while (
        not finished.all()
    ):  # flights differ in length: those that are finished begin anew, and are cut below
        action, memory = policy.predict(observation, memory)
        action = member(envs.single_action_space, action)
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


def member(space: gymnasium.Space[Any], action: numpy.ndarray) -> numpy.ndarray:
    """Return actions of a policy, batch first, as the action space holds them: within its limits, in its type."""
    if isinstance(space, gymnasium.spaces.Box):
        action = numpy.clip(action, space.low, space.high)
    return numpy.asarray(action).astype(space.dtype)
