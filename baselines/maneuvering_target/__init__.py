"""Baselines of ManeuveringTarget."""

from .policies import BASELINES

__all__ = ["BASELINES"]
