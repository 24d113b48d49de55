"""What ManeuveringTarget is compared with, and the reproduction of its paper."""

from .policies import BASELINES

PAPER = "imm-alpha-beta"
"""Name of the paper on the command line; :mod:`.reproduction` repeats its experiments."""

__all__ = ["BASELINES", "PAPER"]
