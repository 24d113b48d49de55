"""What ManeuveringTarget is compared with."""

from .policies import BASELINES

__all__ = ["BASELINES"]
