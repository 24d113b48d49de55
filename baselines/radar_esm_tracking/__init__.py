"""Baselines of RadarEsmTracking."""

from .policies import BASELINES

__all__ = ["BASELINES"]
