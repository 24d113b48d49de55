"""Baselines of LooselyCoupledNavigation."""

from .policies import BASELINES

__all__ = ["BASELINES"]
