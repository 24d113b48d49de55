"""What RadarEsmTracking is compared with."""

from .policies import BASELINES

__all__ = ["BASELINES"]
