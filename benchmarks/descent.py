"""Time of an update of ``bptt``, and comparison of the gradients of compiled episodes with those of torch.

    python benchmarks/descent.py [--environment ID]

**Timing.** Processor time of an update: the decisions of its window, forward and back, gradient
clipping and Adam, with the hyperparameters of the trainer in float32, and its share of a reset; no validation. Median
over ``--repeat`` episodes of two windows (ManeuveringTarget: one), torch and compiled in turn. One thread.

**Comparison.** Gradients of the mean cost of these windows with respect to all parameters of a policy in float64,
on the same episodes: the largest difference, relative to the largest gradient.
"""

import argparse
import os
import statistics
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

import torch
from rich.console import Console
from rich.table import Table

from filtergym.agents.bptt import NetworkPolicy, descend_episodes
from filtergym.agents.training_run import RunOptions, TrainingRun, new_run
from filtergym.agents.unrolled import Unrolled
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import catalogue
from filtergym.envs.interface.vector_environment import TaskVectorEnv

BACKENDS = ("torch", "compiled")
FEWER = 8
"""Number of episodes for the comparison of gradients."""


def make_episodes(run: TrainingRun, backend: str, envs: int, dtype: torch.dtype) -> tuple[Any, NetworkPolicy]:
    """Return a function that simulates an episode with a gradient step after each window, and the policy."""
    truncation = run.hyperparameters["truncation"]
    env = TaskVectorEnv(
        run.environment, envs, control=run.control, backend=backend, autoreset_mode="Disabled",
        max_episode_steps=2 * truncation,
    )  # fmt: skip
    observation = torch.as_tensor(env.reset(seed=0)[0])
    torch.manual_seed(0)
    space: Any = env.model.action_space
    policy = NetworkPolicy(len(env.model.fields), space, run.hyperparameters["hidden_size"]).to(dtype)
    policy.mean.copy_(observation.mean(0))
    policy.scale.copy_(observation.std(0).clamp_min(0.3))
    if backend == "compiled":
        return Unrolled(env, policy, truncation).descend_episodes, policy
    return lambda descend: descend_episodes(env, policy, truncation, descend), policy


def gradients(run: TrainingRun, backend: str) -> torch.Tensor:
    fly, policy = make_episodes(run, backend, FEWER, torch.float64)
    found = []

    def keep() -> None:
        found.append(torch.cat([part.grad.ravel() for part in policy.parameters() if part.grad is not None]))
        policy.zero_grad()

    fly(keep)
    return torch.stack(found)


def update_times(run: TrainingRun, repeat: int) -> list[float]:
    prepared = []
    for backend in BACKENDS:
        fly, policy = make_episodes(run, backend, run.envs, torch.float32)
        prepared.append((fly, policy, torch.optim.Adam(policy.parameters(), lr=1e-3)))
    times: list[list[float]] = [[], []]
    for _ in range(repeat + 1):
        for (fly, policy, optimiser), kept in zip(prepared, times, strict=True):
            windows = 0

            def descend(policy: Any = policy, optimiser: Any = optimiser) -> None:
                nonlocal windows
                torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
                optimiser.step()
                optimiser.zero_grad()
                windows += 1

            start = time.process_time()
            fly(descend)
            kept.append(1e3 * (time.process_time() - start) / windows)
    # The first episode also allocates memory.
    return [statistics.median(kept[1:]) for kept in times]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--environment", choices=sorted(catalogue()))
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    table = Table("environment", "control", "torch, ms", "compiled, ms", "faster", "gradients differ by")
    for id in [arguments.environment] if arguments.environment else sorted(catalogue()):
        run = new_run(problem_of(id), RunOptions("bptt"))
        theirs, ours = (gradients(run, backend) for backend in BACKENDS)
        slow, fast = update_times(run, arguments.repeat)
        difference = float((theirs - ours).abs().max() / theirs.abs().max())
        row = (f"{slow:.0f}", f"{fast:.1f}", f"{slow / fast:.1f} x", f"{difference:.0e}")
        table.add_row(id, run.control, *row)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
