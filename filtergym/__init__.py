"""Gymnasium environments for adaptive-filter benchmarking.

``import filtergym`` registers every environment: ``gymnasium.make("filtergym/ManeuveringTarget-v0")``.
Without an import of one's own: ``gymnasium.make("filtergym:filtergym/ManeuveringTarget-v0")``.
"""

import importlib
from typing import TYPE_CHECKING, Any

from .envs.engine.catalogue import register

if TYPE_CHECKING:
    from .baselines.table import Baselines
    from .envs.contract.filter import Likelihood
    from .envs.contract.task import Task
    from .envs.data.recording import Recording
    from .envs.data.trajectory import Trajectory
    from .envs.linear.inputs import Input
    from .envs.linear.sensors import Sensor
    from .envs.logs.flights import Flights, read_flights
    from .envs.logs.reading import read_recording
    from .evaluation.competitors.kinds import FunctionPolicy
    from .functions import evaluate, make_policy, record, tidy_records
    from .live import online
    from .own_models import state_space

__version__ = "0.1.0"
__all__ = [
    "Flights",
    "FunctionPolicy",
    "Input",
    "Likelihood",
    "Recording",
    "Sensor",
    "Trajectory",
    "evaluate",
    "make_policy",
    "online",
    "read_flights",
    "read_recording",
    "record",
    "register",
    "register_task",
    "state_space",
    "tidy_records",
]
MODULES = {
    "Flights": "envs.logs.flights",
    "FunctionPolicy": "evaluation.competitors.kinds",
    "Input": "envs.linear.inputs",
    "Likelihood": "envs.contract.filter",
    "Recording": "envs.data.recording",
    "Sensor": "envs.linear.sensors",
    "Trajectory": "envs.data.trajectory",
    "evaluate": "functions",
    "make_policy": "functions",
    "online": "live",
    "read_flights": "envs.logs.flights",
    "read_recording": "envs.logs.reading",
    "record": "functions",
    "state_space": "own_models",
    "tidy_records": "functions",
}
"""Module of each name of this package, imported when the name is first used."""

register()


def register_task(task: "type[Task]", baselines: "Baselines | None" = None) -> None:
    """Register an environment of your own, to be listed, made, evaluated, rendered and trained on as the others.

    Call it where your module or package is imported, not inside a function. Then any process finds the environment by
    ``module:id``, as in ``gymnasium.make("my_package:mine/Pendulum-v0")`` and on the command line, and a spawned
    process imports the module by itself.

    Args:
        task: class that fulfils the contract of :class:`filtergym.envs.contract.task.Task`.
        baselines: its filters, policies and references; without them random actions are its only policy, and
            there is no score.

    Raises:
        ValueError: if the task does not fulfil the contract, computes arrays of other shapes than it declares, its id
            is taken, or the table does not fit it.
    """
    from .baselines.catalogue import add_baselines
    from .envs.engine.registration import add_task

    add_task(task)
    if baselines is not None:
        if baselines.environment != task.id:
            raise ValueError(f"the baselines are of {baselines.environment!r}, not of {task.id!r}")
        add_baselines(task, baselines)


def __getattr__(name: str) -> Any:
    # On first use: an evaluation brings xarray, which registering the environments does not need.
    if name not in MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{MODULES[name]}", __name__), name)
