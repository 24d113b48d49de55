"""Learned agents: training with Stable-Baselines3 or through the filter, policies as arrays, gates.

Names are imported on first use: a learned policy is evaluated without torch, and only training needs
Stable-Baselines3.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .adapter import to_sb3
    from .gate import Gated, GatedMaker
    from .learned_policy import LearnedPolicy
    from .residual import ResidualPolicy
    from .sb3_policy import Sb3Policy, load_sb3_policy

_HOMES = {
    "to_sb3": "adapter",
    "Gated": "gate",
    "GatedMaker": "gate",
    "LearnedPolicy": "learned_policy",
    "ResidualPolicy": "residual",
    "Sb3Policy": "sb3_policy",
    "load_sb3_policy": "sb3_policy",
}
__all__ = [
    "Gated",
    "GatedMaker",
    "LearnedPolicy",
    "ResidualPolicy",
    "Sb3Policy",
    "load_sb3_policy",
    "to_sb3",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
