"""Catalogue of the environments, and import of modules whose names a user gives.

Every folder in ``envs/`` that defines an ``ID`` is an environment; its ``task.py`` defines the class, ``TASK``, which
is imported on first use. No other file lists it. A user's own environments are added by
:mod:`.registration`; :mod:`.scenario_choice` makes a task from names and keywords.
"""

import dataclasses
import difflib
import functools
import importlib
import importlib.machinery
import pkgutil
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import gymnasium

from ..contract.failures import user_code_line
from ..contract.parameters import quote_shortened

if TYPE_CHECKING:
    from ..contract.task import Task

ENVS = __name__.rsplit(".", 2)[0]
"""The package whose folders are the environments and the layers that they build on."""
USER_TASKS: dict[str, "type[Task]"] = {}
"""Registered environments of users: Gymnasium id -> task class."""


class Catalogue(Mapping[str, "type[Task]"]):
    """Mapping of every environment's Gymnasium id to its task class, imported on access."""

    def __getitem__(self, id: str) -> "type[Task]":
        folder = folders().get(id)
        if folder is None:
            return USER_TASKS[id]
        task: type[Task] = importlib.import_module(f"{ENVS}.{folder}.task").TASK
        return task

    def __iter__(self) -> Iterator[str]:
        return iter((*folders(), *USER_TASKS))

    def __len__(self) -> int:
        return len(folders()) + len(USER_TASKS)

    def __contains__(self, id: object) -> bool:
        return id in folders() or id in USER_TASKS


def catalogue() -> Mapping[str, "type[Task]"]:
    """Return the :class:`Catalogue` of all environments: Gymnasium id to task class."""
    return Catalogue()


@functools.cache
def folders() -> dict[str, str]:
    """Return the folder name of every environment of this package by Gymnasium id, without importing tasks."""
    names = [m.name for m in pkgutil.iter_modules(importlib.import_module(ENVS).__path__) if m.ispkg]
    packages = {name: importlib.import_module(f"{ENVS}.{name}") for name in names}
    return {package.ID: name for name, package in packages.items() if hasattr(package, "ID")}


class UnknownKeyword(TypeError, ValueError):  # noqa: N818  (the name describes it)
    """Error for a keyword that an environment does not accept.

    It is a TypeError, as of any function, for clients that test whether an environment accepts one, and a ValueError as
    for every other wrong name.
    """


def nearest(kind: str, name: Any, valid: Iterable[str]) -> ValueError:
    """Return a ValueError for an unknown name, which suggests the most similar valid ones."""
    return ValueError(f"unknown {kind} {quote_shortened(name)}: {_meant(name, valid)}")


def _meant(name: Any, valid: Iterable[str], choices: Iterable[str] | None = None) -> str:
    valid = list(valid)
    close = difflib.get_close_matches(str(name), valid, n=3, cutoff=0.5)
    if close:
        return f"did you mean {' or '.join(map(repr, close))}?"
    return f"choose from {', '.join(valid if choices is None else choices)}" if valid else "there are none"


_SEARCH_FOLDERS: list[str] = []
"""Folders that are searched for modules that a user names, after ``sys.path``."""
FOUND_IN: list[str] = []
"""Search folders in which a module was found; other processes receive them, see :mod:`..evaluation.parallel`."""


@contextmanager
def modules_from(folder: str) -> Iterator[None]:
    """Context manager: :func:`import_user_module` searches this folder too."""
    _SEARCH_FOLDERS.append(folder)
    try:
        yield
    finally:
        _SEARCH_FOLDERS.remove(folder)
        FOUND_IN.clear()


@contextmanager
def on_path(folders: Iterable[str]) -> Iterator[None]:
    """Context manager: append folders to ``sys.path``, after the libraries."""
    further = [folder for folder in folders if folder not in sys.path]
    sys.path.extend(further)
    try:
        yield
    finally:
        sys.path[:] = [path for path in sys.path if path not in further]


def import_user_module(module: str, refusal: str) -> ModuleType:
    """Import and return a module whose name a user gave.

    No other function imports by name. It is called only for arguments of the command line or of a function that the
    user calls; names in files go through :func:`task_class`, which imports nothing.

    Args:
        module: its name, with dots.
        refusal: beginning of the error.

    Raises:
        ValueError: if that is no name of a module, or the import fails, for any reason.
    """
    try:
        if not all(part.isidentifier() for part in module.split(".")):
            raise ImportError("a module is named by words with dots between them")
        with on_path(_SEARCH_FOLDERS):
            found = importlib.import_module(module)
    except Exception as error:  # a module is a program: it can raise anything
        # A ValueError is complete.
        line = "" if isinstance(error, ValueError) else user_code_line(error)
        raise ValueError(f"{refusal}: {type(error).__name__}: {error}{line}") from error
    places = (*getattr(found, "__path__", ()), getattr(found, "__file__", None) or "")
    FOUND_IN.extend(
        folder
        for folder in _SEARCH_FOLDERS
        if folder not in FOUND_IN and any(Path(place).is_relative_to(folder) for place in places)
    )
    return found


def find_user_module(module: str, refusal: str) -> Path:
    """Return the path of the file of a module whose name a user gave, without importing it.

    Raises:
        ValueError: if there is no such file.
    """
    with on_path(_SEARCH_FOLDERS):
        found = importlib.machinery.PathFinder.find_spec(module) if module.isidentifier() else None
    if found is None or not found.has_location or not str(found.origin).endswith(".py"):
        raise ValueError(f"{refusal}: there is no file {module}.py where Python looks for modules")
    return Path(str(found.origin))


def import_task(id: str) -> "type[Task]":
    """Return the task class of an environment's id; for ``module:id`` import that module first, which registers it.

    Raises:
        ValueError: if there is none, or its module cannot be imported.
    """
    if not isinstance(id, str) or ":" not in id:
        return task_class(id)
    module, _, own = id.partition(":")
    import_user_module(module, f"cannot import {module!r}, which registers environment {own!r}")
    try:
        return task_class(own)
    except ValueError as error:
        raise ValueError(
            f"{error}; {module!r} was imported, and does not register it with filtergym.register_task"
        ) from error


def task_class(id: str) -> "type[Task]":
    """Return the task class of a registered environment's id, without imports; ``filtergym/`` may be omitted.

    Raises:
        ValueError: if there is none; of ``module:id``, if the module has not been imported.
    """
    if not isinstance(id, str):
        raise ValueError(
            f"an environment is named by its id, such as 'filtergym/ManeuveringTarget-v0', got {quote_shortened(id)}"
        )
    module, colon, own = id.rpartition(":")
    known = Catalogue()
    for candidate in (own, f"filtergym/{own}", f"filtergym/{own}-v0"):
        if candidate in known:
            return known[candidate]
    if colon and module not in sys.modules:
        raise ValueError(
            f"unknown environment {own!r}: import {module!r} yourself, or name the environment on the command line, as "
            f"{id!r}; a name that was read from a file imports nothing"
        )
    raise nearest("environment", own, known)


class ImportableName(str):
    """Id of an environment with the module that registers it, ``module:id``, which imports it on unpickling.

    Written to a file and read again it is an ordinary string, which imports nothing.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return _import_name, (str(self),)

    def __deepcopy__(self, memo: Any) -> "ImportableName":
        return self


def _import_name(name: str) -> ImportableName:
    return ImportableName(importable_name(import_task(name)))


def importable_name(cls: "type[Task]") -> str:
    """Return an environment's id for another process; for a user's environment ``module:id``."""
    return ImportableName(f"{cls.__module__}:{cls.id}") if cls.id in USER_TASKS else cls.id


def short_name(id: str) -> str:
    """Return a Gymnasium id without ``filtergym/``, usable as a file name."""
    return id.removeprefix("filtergym/").replace("/", "-")


def bare_name(id: str) -> str:
    """Return a Gymnasium id without namespace and version ``-v0``, for tables and pages."""
    return id.rpartition("/")[2].removesuffix("-v0")


def parameter_names(cls: "type[Task]") -> list[str]:
    """Return the names of an environment's parameters, which are keywords of ``gym.make``."""
    return [f.name for f in dataclasses.fields(cls.Parameters)]


def check_names(cls: "type[Task]", keywords: Iterable[str], others: Iterable[str] = ()) -> None:
    """Raise :class:`UnknownKeyword` if a keyword is not the name of a parameter of an environment.

    ``others`` are further valid names, to suggest.
    """
    known = parameter_names(cls)
    for name in keywords:
        if name not in known:
            hint = _meant(name, [*others, *known], choices=known)
            raise UnknownKeyword(f"unexpected keyword argument {name!r}, no parameter of {cls.id}: {hint}")


def register() -> None:
    """Register every environment with Gymnasium; a second call changes nothing."""
    for id in catalogue():
        if id not in gymnasium.registry:
            gymnasium.register(
                id,
                entry_point="filtergym.envs.interface.environment:TaskEnv",
                vector_entry_point="filtergym.envs.interface.vector_environment:TaskVectorEnv",
                # A spawned process receives only this, and must find the environment by it.
                kwargs={"task": importable_name(USER_TASKS[id]) if id in USER_TASKS else id},
            )
