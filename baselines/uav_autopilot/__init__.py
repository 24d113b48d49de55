"""Baselines of UavAutopilot."""

from .policies import BASELINES

__all__ = ["BASELINES"]
