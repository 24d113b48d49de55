"""How fast Stable-Baselines3 steps the environments: the adapter beside ``DummyVecEnv``.

    python benchmarks/adapter.py [--environment ID] [--envs N]

**What is timed.** ``step`` of the ``VecEnv`` with random float32 actions, over whole episodes and the resets
between them; then the steps per second of PPO's ``learn`` (policy, bootstrap of truncated environments,
updates of the network), once with episodes that all end together and once with staggered ones. One thread.
"""

import argparse
import os
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

import gymnasium
import numpy
import torch
from filtergym.agents import to_sb3
from filtergym.envs.interface.environment import TaskEnv
from rich.console import Console
from rich.table import Table
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv


def native(id: str, count: int, staggered: bool = False) -> VecEnv:
    return to_sb3(gymnasium.make_vec(id, num_envs=count, autoreset_mode="SameStep"), staggered)


def dummy(id: str, count: int) -> VecEnv:
    return DummyVecEnv([lambda: Monitor(TaskEnv(id)) for _ in range(count)])


def stepping_rate(env: VecEnv, steps: int) -> float:
    """Environment steps per second."""
    env.seed(0)
    env.reset()
    space: Any = env.action_space
    rng = numpy.random.default_rng(0)
    actions = rng.uniform(space.low, space.high, (16, env.num_envs, *space.shape)).astype(space.dtype)
    start = time.perf_counter()
    for step in range(steps):
        env.step(actions[step % 16])
    return steps * env.num_envs / (time.perf_counter() - start)


def learning_rate(env: VecEnv, steps: int) -> float:
    """Environment steps per second of PPO with rollouts of 100 steps."""
    model = PPO("MlpPolicy", env, n_steps=100, batch_size=100 * env.num_envs // 10, n_epochs=5, seed=0)
    start = time.perf_counter()
    model.learn(steps * env.num_envs)
    return steps * env.num_envs / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--environment", default="filtergym/ManeuveringTarget-v0")
    parser.add_argument("--envs", type=int, default=256)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    id, count = arguments.environment, arguments.envs
    table = Table("", "step: steps/s", "PPO: steps/s", title=f"{id}, {count} environments")
    horizon = native(id, 1).get_attr("last_decision")[0]
    made = {
        "DummyVecEnv": (dummy(id, count), horizon),
        "adapter": (native(id, count), 5 * horizon),
        "adapter, staggered": (native(id, count, staggered=True), 5 * horizon),
    }
    rates = {}
    for name, (env, steps) in made.items():
        rates[name] = stepping_rate(env, steps), learning_rate(env, max(200, horizon))
        table.add_row(name, *(f"{rate:,.0f}" for rate in rates[name]))
    for name in ("adapter", "adapter, staggered"):
        ratio = [f"{a / b:.1f} x" for a, b in zip(rates[name], rates["DummyVecEnv"], strict=True)]
        table.add_row(f"{name} / DummyVecEnv", *ratio)
    Console().print(table)


if __name__ == "__main__":
    main()
