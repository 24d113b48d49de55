"""Gymnasium environments for adaptive-filter benchmarking.

``import filtergym`` registers every environment: ``gymnasium.make("filtergym/ManeuveringTarget-v0")``.
Without an import of one's own: ``gymnasium.make("filtergym:filtergym/ManeuveringTarget-v0")``.
"""

import sys

if (
    sys.argv[:1] == ["-m"]  # while Python looks for the module that it was told to run: before its first line
    and (sys.orig_argv[-len(sys.argv)] == "filtergym" or sys.orig_argv[-len(sys.argv)].endswith("mfiltergym"))
    and not sys.flags.safe_path
):
    # The working directory, in which Python would look for every library that is still to come.
    del sys.path[0]

import importlib
import os
import time
from typing import TYPE_CHECKING, Any

_PATIENCE = 10.0
"""s that a fork waits for imports of other threads."""


def _is_importing() -> bool:
    """Whether the thread that asks is importing itself."""
    frame: Any = sys._getframe()
    while frame is not None:
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            return True
        frame = frame.f_back
    return False


def _half_imported() -> list[str]:
    """Names of modules whose import has begun and not ended."""
    modules = list(sys.modules.items())
    return [n for n, m in modules if getattr(getattr(m, "__spec__", None), "_initializing", False)]


def _await_imports() -> None:
    """Let a fork wait until other threads have imported what they are importing: in the child they are not there, and
    whoever imports the same would wait for them without end.
    """
    until = time.monotonic() + _PATIENCE
    while not _is_importing() and _half_imported() and time.monotonic() < until:
        time.sleep(0.002)


def _forget_half_imported() -> None:
    """Forget in a forked process what is half imported even so, and the locks of the import system, which a thread that
    is not here holds for ever. Such a module is imported anew, or refused by a library that cannot be.
    """
    if not _is_importing():
        getattr(importlib._bootstrap, "_module_locks", {}).clear()
        for name in _half_imported():
            del sys.modules[name]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_await_imports, after_in_child=_forget_half_imported)

from .envs.engine.catalogue import register  # noqa: E402  (its import may be forked, too)

if TYPE_CHECKING:
    from .baselines.table import Baselines
    from .envs.contract.filter import Likelihood
    from .envs.contract.task import Task
    from .envs.data.flights import Flights, read_flights
    from .envs.data.recording import Recording
    from .envs.data.trajectory import Trajectory
    from .envs.engine.scenario_choice import read_recording
    from .envs.linear.inputs import Input
    from .envs.linear.sensors import Sensor
    from .evaluation.competitors.kinds import FunctionPolicy
    from .live import online
    from .names import evaluate, make_policy, record, tidy_records
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
    "envs.contract.filter": ("Likelihood",),
    "envs.data.flights": ("Flights", "read_flights"),
    "envs.data.recording": ("Recording",),
    "envs.engine.scenario_choice": ("read_recording",),
    "envs.data.trajectory": ("Trajectory",),
    "envs.linear.inputs": ("Input",),
    "envs.linear.sensors": ("Sensor",),
    "evaluation.competitors.kinds": ("FunctionPolicy",),
    "live": ("online",),
    "names": ("evaluate", "make_policy", "record", "tidy_records"),
    "own_models": ("state_space",),
}
"""Where names of this package come from, when they are first used."""

register()


def register_task(task: "type[Task]", baselines: "Baselines | None" = None) -> None:
    """Make an environment of your own a citizen: it lists, makes, evaluates, renders and trains like the others.

    Call it where your module or package is imported, not inside a function. Then any process finds the
    environment by ``module:id``, as in ``gymnasium.make("my_package:mine/Pendulum-v0")`` and on the command
    line, and a spawned process, such as a worker of an asynchronous vector environment, imports the module
    by itself.

    Args:
        task: class that keeps the contract of :class:`filtergym.envs.contract.task.Task`.
        baselines: what it is compared with; without them random actions are its only policy, and there is no
            score.

    Raises:
        ValueError: if the task does not keep the contract, computes arrays of other shapes than it declares, its id is
            taken, or the table does not fit it.
    """
    from .baselines.catalogue import add_baselines
    from .envs.engine.registration import add_task

    add_task(task)
    if baselines is not None:
        if baselines.environment != task.id:
            raise ValueError(f"the baselines are of {baselines.environment!r}, not of {task.id!r}")
        add_baselines(task, baselines)


def __getattr__(name: str) -> Any:
    # On first use: an evaluation brings xarray, and who registers the environments needs none of it.
    for module, names in MODULES.items():
        if name in names:
            return getattr(importlib.import_module(f".{module}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
