"""What TightlyCoupledNavigation is compared with, and the reproduction of its paper."""

from .policies import BASELINES

PAPER = "multi-hypothesis-ins-gnss"
"""Name of the paper on the command line; :mod:`.reproduction` repeats its experiments."""

__all__ = ["BASELINES", "PAPER"]
