"""What UavAutopilot is compared with."""

from .policies import BASELINES

__all__ = ["BASELINES"]
