"""Models of an environment, made by its id."""

from typing import Any

from filtergym.envs import backend
from filtergym.envs.catalogue import task_class
from filtergym.envs.model import Model

DECISIONS = 5
"""Length of the short episodes, in decisions."""


def make_model(id: str, control: str | None = None, scenario: Any = None, **keywords: Any) -> Model:
    """Make a model as :func:`filtergym.envs.backend.make_model` does."""
    return backend.make_model(task_class(id), control, scenario, **keywords)


def short_episodes(id: str) -> dict[str, Any]:
    """Keywords that make episodes of an environment five decisions long, of two measurements at most."""
    interval = min(task_class(id).Parameters().decision_interval, 2)
    return {"horizon": DECISIONS * interval, "decision_interval": interval}
