"""What RadarEsmTracking is compared with, and the reproduction of its paper."""

from .policies import BASELINES

PAPER = "radar-esm-class-fusion"
"""Name of the paper on the command line; :mod:`.reproduction` repeats its experiments."""

__all__ = ["BASELINES", "PAPER"]
