"""Episodes from their seeds to their end, with a policy, a reference estimator or a bound in the loop."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy

from ..envs.environment import checked_action
from ..envs.lanes import Lanes
from ..envs.task import Array, Task

Progress = Callable[[int], None]
"""Told the number of measurements just done."""


def started_lanes(task: Task, seeds: Sequence[int]) -> Lanes:
    """Return one episode for each seed, side by side, with its first measurement made."""
    lanes = Lanes(task, len(seeds))
    for lane, seed in enumerate(seeds):
        lanes.seed(lane, numpy.random.default_rng(seed))
    lanes.restart()
    return lanes


def run_policy(
    task: Task, policy: Any, seeds: Sequence[int], record: Callable[[Any], None], tick: Progress
) -> None:
    """Run a policy over one episode for each seed.

    Args:
        task: the estimation problem, under the policy's control.
        policy: anything with Stable-Baselines3's ``predict``.
        seeds: of the episodes, all run side by side.
        record: called with every state after the action; lanes beyond ``len(seeds)`` are padding.
        tick: told of progress.
    """
    lanes = started_lanes(task, seeds)
    memory: Any = None
    start = numpy.ones(lanes.count, dtype=bool)
    for _ in range(lanes.decisions_per_episode):
        answer, memory = policy.predict(lanes.observe(), memory, start, deterministic=True)
        action = lanes.widened(checked_action(task.action_space, answer, lanes.count))

        def update(state: Any, action: Array = action) -> Any:
            return task.act(state, action)

        lanes.step(update, lambda state, _: record(state))
        start = numpy.zeros(lanes.count, dtype=bool)
        tick(lanes.count * task.decision_interval)


def run_reference(
    task: Task, reference: Any, seeds: Sequence[int], record: Callable[[Any], None], tick: Progress
) -> None:
    """Run a reference estimator in place of actions; arguments as in :func:`run_policy`."""
    lanes = started_lanes(task, seeds)
    memory = reference.start(lanes.state)

    def update(state: Any) -> Any:
        nonlocal memory
        state, memory = reference.update(state, memory)
        return state

    for _ in range(lanes.decisions_per_episode):
        lanes.step(update, lambda state, _: record(state))
        tick(lanes.count * task.decision_interval)


def run_bound(
    task: Task, bound: Any, seeds: Sequence[int], record: Callable[[Array], None], tick: Progress
) -> None:
    """Compute a bound along the episodes; ``record`` gets its mean squares, ``(C, N)``."""
    lanes = started_lanes(task, seeds)
    memory = bound.start(lanes.state)
    neutral = lanes.widened(numpy.zeros((lanes.count, *(task.action_space.shape or ()))))

    def update(state: Any) -> Any:
        nonlocal memory
        mean_square, memory = bound.update(state, memory)
        record(mean_square)
        return task.act(state, neutral)

    for _ in range(lanes.decisions_per_episode):
        lanes.step(update)
        tick(lanes.count * task.decision_interval)
