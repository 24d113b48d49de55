"""Models of an environment, made by its id."""

from typing import Any

from filtergym.envs import backend
from filtergym.envs.catalogue import task_class
from filtergym.envs.model import Model


def make_model(id: str, control: str | None = None, scenario: Any = None, **keywords: Any) -> Model:
    """Make a model as :func:`filtergym.envs.backend.make_model` does."""
    return backend.make_model(task_class(id), control, scenario, **keywords)
