"""ManeuveringTarget: everything of one environment; ``TASK`` is what the catalogue finds."""

from .task import TASK

__all__ = ["TASK"]
