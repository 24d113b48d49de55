"""Gymnasium environments for adaptive-filter benchmarking.

``import filtergym`` registers every environment: ``gymnasium.make("filtergym/ManeuveringTarget-v0")``.
Without an import of one's own: ``gymnasium.make("filtergym:filtergym/ManeuveringTarget-v0")``.
"""

from .envs.catalogue import register
from .envs.trajectory import Trajectory

__version__ = "0.1.0"
__all__ = ["Trajectory", "register"]

register()
