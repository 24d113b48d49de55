"""The papers' algorithms as policies, reference estimators and bounds, and Monte Carlo evaluation."""

from .evaluation import evaluate
from .metrics import tidy_records

__all__ = ["evaluate", "tidy_records"]
