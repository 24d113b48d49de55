"""Gymnasium environments for adaptive-filter benchmarking.

``import filtergym`` registers every environment: ``gymnasium.make("filtergym/ManeuveringTarget-v0")``.
Without an import of one's own: ``gymnasium.make("filtergym:filtergym/ManeuveringTarget-v0")``.
"""

from typing import Any

from .baselines.policy import LOADERS, PolicyLoader
from .envs.catalogue import register
from .envs.trajectory import Trajectory

__version__ = "0.1.0"
__all__ = ["Trajectory", "register"]

register()


def _learned_policy(id: str, name: str) -> Any:
    # Imported when asked for: baselines know nothing of agents.
    from .agents.named_policies import learned_policy

    return learned_policy(id, name)


def _shipped_agents(id: str) -> list[str]:
    from .agents.named_policies import shipped_agents

    return shipped_agents(id)


LOADERS.append(PolicyLoader(_learned_policy, _shipped_agents))
