"""Gymnasium environments for adaptive-filter benchmarking.

``import filtergym`` registers every environment: ``gymnasium.make("filtergym/ManeuveringTarget-v0")``.
Without an import of one's own: ``gymnasium.make("filtergym:filtergym/ManeuveringTarget-v0")``.
"""

from typing import TYPE_CHECKING, Any

from .baselines.catalogue import add_baselines
from .baselines.table import Baselines
from .envs.catalogue import read_recording, register
from .envs.flights import Flights, read_flights
from .envs.recording import Recording
from .envs.registration import add_task
from .envs.task import Task
from .envs.trajectory import Trajectory
from .evaluation.competitors import FunctionPolicy, Likelihood

if TYPE_CHECKING:
    from .live import online
    from .names import evaluate, make_policy, record, tidy_records

__version__ = "0.1.0"
__all__ = [
    "Flights",
    "FunctionPolicy",
    "Likelihood",
    "Recording",
    "Trajectory",
    "evaluate",
    "make_policy",
    "online",
    "read_flights",
    "read_recording",
    "record",
    "register",
    "register_task",
    "tidy_records",
]

register()


def register_task(task: type[Task], baselines: Baselines | None = None) -> None:
    """Make an environment of your own a citizen: it lists, makes, evaluates, renders and trains like the others.

    Call it where your module or package is imported, not inside a function. Then any process finds the
    environment by ``module:id``, as in ``gymnasium.make("my_package:mine/Pendulum-v0")`` and on the command
    line, and a spawned process, such as a worker of an asynchronous vector environment, imports the module
    by itself.

    Args:
        task: class that keeps the contract of :class:`filtergym.envs.task.Task`.
        baselines: what it is compared with; without them random actions are its only policy, and there is no
            score.

    Raises:
        ValueError: if the task does not keep the contract, computes arrays of other shapes than it declares, its id is
            taken, or the table does not fit it.
    """
    add_task(task)
    if baselines is not None:
        if baselines.environment != task.id:
            raise ValueError(f"the baselines are of {baselines.environment!r}, not of {task.id!r}")
        add_baselines(task, baselines)


def __getattr__(name: str) -> Any:
    # On first use: an evaluation brings xarray, and making environments needs none of it.
    if name == "online":
        from . import live

        return live.online
    if name not in ("evaluate", "make_policy", "record", "tidy_records"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import names

    return getattr(names, name)
