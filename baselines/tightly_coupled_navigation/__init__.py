"""Baselines of TightlyCoupledNavigation."""

from .policies import BASELINES

__all__ = ["BASELINES"]
