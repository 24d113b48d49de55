"""Episodes from their seeds to their end, with a policy, a reference estimator or a bound in the loop."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy

from ..envs.environment import checked_action
from ..envs.lanes import Lanes
from ..envs.observation import Array
from ..envs.task import Episode, Outside, Task
from .competitors import Policy

Progress = Callable[[int], None]
"""Told the number of measurements just done."""
MODEL_ROWS = 128
"""Observations that a model of Stable-Baselines3 is asked about at once, always as many."""


def started_lanes(task: Task, seeds: Sequence[int], begun: Callable[[Episode], None] | None = None) -> Lanes:
    """Return one episode for each seed, side by side, with its first measurement made.

    Args:
        task: the estimation problem.
        seeds: of the episodes.
        begun: told of the episodes at the start of the track.
    """
    lanes = Lanes(task, len(seeds), begun=begun)
    for lane, seed in enumerate(seeds):
        lanes.seed(lane, numpy.random.default_rng(seed))
    lanes.restart()
    return lanes


def _episodes_of_calls(policy: Any, lanes: Lanes) -> list[numpy.ndarray]:
    """Episodes that each call of ``predict`` is shown, the last one repeated to fill up.

    Matrix products round by their shape, and an episode must not depend on how many others there are: the rows
    are as many as the engine's lanes, and for a model of Stable-Baselines3 always the same.
    """
    rows = MODEL_ROWS if hasattr(policy, "observation_space") else lanes.width
    firsts = range(0, lanes.count, rows)
    return [numpy.minimum(numpy.arange(first, first + rows), lanes.count - 1) for first in firsts]


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
    calls = _episodes_of_calls(policy, lanes)
    memories = [
        policy.begin([seeds[i] for i in call]) if isinstance(policy, Policy) else None for call in calls
    ]
    first = True
    for _ in range(lanes.decisions_per_episode):
        shown = lanes.observe()
        answers = []
        for c, call in enumerate(calls):
            start = numpy.full(len(call), first)
            answer, memories[c] = policy.predict(shown[call], memories[c], start, deterministic=True)
            answers.append(checked_action(task.action_space, answer, len(call)))
        action = lanes.widened(numpy.concatenate(answers)[: lanes.count])

        def update(state: Any, action: Array = action) -> Any:
            return task.act(state, action)

        lanes.step(update, lambda state, _: record(state))
        first = False
        tick(lanes.count * task.decision_interval)


def run_reference(
    task: Task, reference: Any, seeds: Sequence[int], record: Callable[[Any], None], tick: Progress
) -> None:
    """Run a reference in place of actions; arguments as in :func:`run_policy`."""
    task = task.estimated_outside()
    memory: Any = None

    def begun(episode: Episode) -> None:
        nonlocal memory
        memory = reference.start(episode.measurement, episode.truth)

    def update(episode: Episode) -> Episode:
        nonlocal memory
        mean, covariance, memory = reference.update(episode.measurement, episode.truth, memory)
        feedback = task.feedback(mean, episode.measurement)
        return episode._replace(bank=Outside(mean, covariance, feedback))

    lanes = started_lanes(task, seeds, begun)
    for _ in range(lanes.decisions_per_episode):
        lanes.step(update, lambda episode, _: record(episode))
        tick(lanes.count * task.decision_interval)


def run_bound(
    task: Task, bound: Any, seeds: Sequence[int], record: Callable[[Array], None], tick: Progress
) -> None:
    """Compute a bound along the episodes; ``record`` gets its mean squares, ``(C, N)``."""
    memory: Any = None

    def begun(episode: Episode) -> None:
        nonlocal memory
        memory = bound.start(episode.measurement, episode.truth)

    lanes = started_lanes(task, seeds, begun)
    neutral = lanes.widened(numpy.zeros((lanes.count, *(task.action_space.shape or ()))))

    def update(episode: Episode) -> Episode:
        nonlocal memory
        mean_square, memory = bound.update(episode.measurement, episode.truth, memory)
        record(mean_square)
        return task.act(episode, neutral)

    for _ in range(lanes.decisions_per_episode):
        lanes.step(update)
        tick(lanes.count * task.decision_interval)
