"""What TightlyCoupledNavigation is compared with."""

from .policies import BASELINES

__all__ = ["BASELINES"]
