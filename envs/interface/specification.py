"""Specification of an environment that was made, for Gymnasium: its :class:`~gymnasium.envs.registration.EnvSpec`."""

import dataclasses
import enum
import os
from typing import Any

import numpy
from gymnasium.envs.registration import EnvSpec

from ..data.scenario_data import ScenarioData


def with_episode_length(spec: EnvSpec, decisions: int) -> EnvSpec:
    """Return a copy of a Gymnasium spec with the length of an episode, and keywords that JSON can store.

    Gymnasium registers one length for an id; here it follows from scenario and parameters. The environment truncates
    by itself, without a ``TimeLimit`` wrapper.
    """
    kwargs = {name: json_value(value) for name, value in spec.kwargs.items()}
    return dataclasses.replace(spec, max_episode_steps=decisions, kwargs=kwargs)


def json_value(value: Any) -> Any:
    """Return a keyword's value in a form that JSON can store and that makes the same environment."""
    if isinstance(value, ScenarioData):
        return {name: json_value(item) for name, item in value.fields().items()}
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, numpy.ndarray | numpy.generic):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, dict):
        return {name: json_value(item) for name, item in value.items()}
    return type(value)(map(json_value, value)) if type(value) in (list, tuple) else value
