"""A user's own environment in the catalogue, beside those of this package."""

import dataclasses
import re
from typing import Any, ClassVar, get_origin

from .catalogue import ADDED, catalogue, register
from .task import Task

ID = re.compile(r"[\w-]+/[\w.-]+-v\d+")


def add_task(cls: type[Task]) -> None:
    """Put a task into the catalogue and register it with Gymnasium; the same one again changes nothing.

    Args:
        cls: class that keeps the contract of :class:`.task.Task`.

    Raises:
        ValueError: if it does not keep the contract, or another environment has its id.
    """
    _check_contract(cls)
    if ADDED.get(cls.id) is cls:
        return
    if cls.id in catalogue():
        raise ValueError(
            f"environment {cls.id!r} is there already, from {catalogue()[cls.id].__module__}: choose another id"
        )
    ADDED[cls.id] = cls
    register()


def _check_contract(cls: Any) -> None:
    """Raise ValueError, with what is missing, for what cannot be an environment."""
    if not (isinstance(cls, type) and issubclass(cls, Task)):
        raise ValueError(f"an environment is a subclass of filtergym.envs.task.Task, got {cls!r}")
    name = cls.__name__
    declared = [n for n, hint in Task.__annotations__.items() if get_origin(hint) is ClassVar]
    missing = [attribute for attribute in declared if not hasattr(cls, attribute)]
    if missing:
        raise ValueError(f"{name} lacks the class attributes {', '.join(missing)} of a task")
    if not ID.fullmatch(cls.id):
        raise ValueError(
            f"{name} needs an id with your name and a version, such as 'mine/{name}-v0', got {cls.id!r}"
        )
    if not cls.banks:
        raise ValueError(f"{name} needs at least one control, got none")
    if cls.default_scenario not in cls.scenarios:
        raise ValueError(
            f"{name} needs its default scenario {cls.default_scenario!r} among its scenarios, got "
            f"{', '.join(cls.scenarios) or 'none'}"
        )
    fields = (
        {f.name for f in dataclasses.fields(cls.Parameters)}
        if dataclasses.is_dataclass(cls.Parameters)
        else set()
    )
    if not {"horizon", "decision_interval"} <= fields:
        raise ValueError(f"{name}.Parameters needs to be a dataclass with horizon and decision_interval")
    for scenario in cls.scenarios.values():
        unknown = set(scenario.parameters) - fields
        if unknown:
            raise ValueError(
                f"scenario {scenario.name!r} of {name} sets unknown parameters {', '.join(sorted(unknown))}"
            )
    expected = [n for n in Task.__annotations__ if n not in declared]
    for control in cls.controls:
        try:
            task = cls(cls.Parameters(**cls.scenarios[cls.default_scenario].parameters), control)
        except Exception as error:  # whatever a constructor stumbles over
            raise ValueError(f"{name} cannot be made with control {control!r}: {error!r}") from error
        missing = [attribute for attribute in expected if not hasattr(task, attribute)]
        if missing:
            raise ValueError(
                f"{name} with control {control!r} lacks the attributes {', '.join(missing)} of a task"
            )
