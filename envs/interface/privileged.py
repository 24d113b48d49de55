"""Privileged information for critics in training: the episode's context, and the error of the estimate.

A critic may observe more than the policy that it evaluates (asymmetric actor and critic; Pinto et al., 2018): it is
needed in training only. The environment separates the two and declares in its metadata that it is privileged.
"""

from typing import Any

from ..contract.draws import Draws
from ..contract.observation import Array
from ..contract.task import Task


def in_sigmas(error: Array, covariance: Array, count: int, xp: Any) -> Array:
    """Return errors ``(C, N)`` over their reported standard deviations, ``(count, C)``; zero where these are zero."""
    error = error[:, :count].T
    variance = xp.stack([covariance[i, i, :count] for i in range(error.shape[1])], axis=-1)
    known = variance > 0.0
    return xp.where(known, error / xp.sqrt(xp.where(known, variance, 1.0)), 0.0)


def context_shapes(task: Task) -> dict[str, tuple[int, ...]]:
    """Return the shape of each part of an episode's context by name, without the batch axis."""
    xp, noise = task.xp, task.noise

    def numbers(rows: int, value: float) -> Array:
        return value + xp.zeros((rows, 8), dtype=xp.float64, device=task.device)

    truth, _ = task.world.begin(Draws(numbers(noise.uniforms, 0.5), xp), numbers(noise.initial_normals, 0.0))
    return {name: tuple(values.shape[:-1]) for name, values in task.world.context(truth).items()}
