"""Algorithms of Stable-Baselines3 and sb3-contrib that train agents, and the action spaces that fit each."""

from typing import Any

import gymnasium
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "ppo": PPO, "recurrent-ppo": RecurrentPPO, "sac": SAC, "dqn": DQN, "rl-ukf": PPO,
}  # fmt: skip
"""Classes of the algorithms by their names."""
SPACES: dict[str, tuple[type[gymnasium.Space[Any]], ...]] = {
    "ppo": (gymnasium.spaces.Box, gymnasium.spaces.Discrete),
    "recurrent-ppo": (gymnasium.spaces.Box, gymnasium.spaces.Discrete),
    "sac": (gymnasium.spaces.Box,),
    "dqn": (gymnasium.spaces.Discrete,),
    "rl-ukf": (gymnasium.spaces.Box,),
}
"""Action spaces of each algorithm."""
