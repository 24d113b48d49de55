"""Catalogue of the baselines of the environments.

Every folder beside this file contains the baselines of the environment whose folder has the same name, and exports them
as ``BASELINES``; a user's environment may register its own.
"""

import importlib
import importlib.util
from functools import cache
from types import ModuleType

from ..envs.contract.task import Task
from ..envs.engine.catalogue import folders, nearest, task_class
from ..evaluation.competitors.kinds import INFORMED_KINDS, RandomPolicy, kind_of
from .table import Baselines, PaperAction

USER_BASELINES: dict[str, Baselines] = {}
"""Baselines of users' environments: Gymnasium id -> table."""


@cache
def package_of(id: str) -> ModuleType | None:
    """Return the Python package with the shipped baselines of a Gymnasium id; None if there is none."""
    folder = folders().get(id)
    if folder is None or importlib.util.find_spec(f"{__package__}.{folder}") is None:
        return None
    return importlib.import_module(f"{__package__}.{folder}")


def baselines_of(id: str) -> Baselines:
    """Return the baselines of the environment of a Gymnasium id.

    By default these are the paper's algorithm that its task declares, and random actions.
    """
    package = package_of(id)
    if package is not None:
        return package.BASELINES
    return USER_BASELINES.get(id) or _declared_baselines(task_class(id))


@cache
def _declared_baselines(task: type[Task]) -> Baselines:
    """Return the default baselines of a task: the paper's algorithm that it declares, and random actions."""
    if not isinstance(task.paper_policy.action, tuple):
        return Baselines(task.id, {"random": RandomPolicy})
    paper = type("DeclaredPaper", (PaperAction,), {"control": task.paper_policy.control})
    return Baselines(task.id, {"paper": paper, "random": RandomPolicy}, score_paper="paper")


def add_baselines(task: type[Task], table: Baselines) -> None:
    """Register the baselines of a user's environment, after a check of their names.

    Raises:
        ValueError: if the table refers to an unknown name.
    """
    reference = {**table.references, **table.bounds}
    for field in ("score_paper", "stronger_paper"):
        if getattr(table, field) not in ("", *table.policies):
            raise nearest(f"policy as {field}", getattr(table, field), table.policies)
    if table.score_reference not in ("", *reference):
        raise nearest("reference as score_reference", table.score_reference, reference)
    if table.fallback not in ("", *table.policies, *table.estimators):
        raise nearest("policy or estimator as fallback", table.fallback, (*table.policies, *table.estimators))
    for name, maker in table.policies.items():
        control = getattr(maker, "control", None)
        if control is not None and control not in task.controls:
            raise nearest(f"control of policy {name!r}", control, task.controls)
    tables = {
        "policy": table.policies,
        "estimator": table.estimators,
        "smoother": table.smoothers,
        "reference": table.references,
        "bound": table.bounds,
    }
    for kind, makers in tables.items():
        for name, maker in makers.items():
            if kind_of(maker) != kind:
                raise ValueError(
                    f"{name!r} stands in the table as {kind}, but its kind is {kind_of(maker)!r}"
                )
            if kind in INFORMED_KINDS and not getattr(maker, "knows", ""):
                raise ValueError(
                    f"{kind} {name!r} does not state what it knows: set the class attribute knows"
                )
    USER_BASELINES[task.id] = table
