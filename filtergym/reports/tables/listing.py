"""An environment with its paper, controls, scenarios and competitors, in lines for the terminal."""

import textwrap
from collections.abc import Iterator, Mapping

from ...baselines.problem import Problem
from ...compiler.library import fastest_library
from ...compiler.native import processor
from ...envs.contract.companions import Paper, find_companion
from ...envs.contract.task import Task
from ...envs.engine.backend import make_model
from ...envs.engine.catalogue import USER_TASKS, parameter_names
from ...envs.engine.compiled import AVAILABLE
from ...names import learned_names

FEWEST_COLUMNS = 20
"""Least number of columns of a text beside its head."""


def _backend(cls: type[Task]) -> str:
    """Return a text on how an environment's steps run: compiled, with which functions, or in NumPy."""
    compiled = AVAILABLE
    if cls.id in USER_TASKS:  # those of this package can all be traced
        compiled = make_model(cls, backend="auto").backend == "compiled"
    return f"compiled (functions of {fastest_library(processor()[1]).name})" if compiled else "numpy"


def summary_of(cls: type[Task]) -> str:
    """Return the first line of the docstring of an environment's class."""
    return (cls.__doc__ or "").strip().partition("\n")[0]


def list_lines(tasks: Mapping[str, type[Task]], width: int | None) -> Iterator[str]:
    """Yield a line for each environment, its id and summary, continued below beyond ``width`` (None: no limit)."""
    longest = max(map(len, tasks), default=0)
    for id, cls in tasks.items():
        yield _hang(f"{id:<{longest}}", summary_of(cls), width)


def environment_lines(problem: Problem, width: int, everything: bool = False) -> Iterator[str]:
    """Yield the lines that describe an environment, at most ``width`` columns wide; the first is its id.

    With ``everything`` parameters are named and scenarios described in full, else counted and in one line.
    """
    cls, known, parameters = problem.task, problem.baselines, parameter_names(problem.task)
    yield problem.name
    yield _hang(" ", summary_of(cls), width)
    rows = {
        "paper": [paper.source] if (paper := find_companion(cls, Paper)) else [],
        "controls": [f"{c} (default)" if c == cls.controls[0] else c for c in cls.controls],
        "policies": list(known.policies),
        "estimators": list(known.estimators),
        "tuned": problem.tuned_policies,
        "learned": learned_names(cls.id),
        "smoothers": [f"{', '.join(known.smoothers)} (not causal: they use later measurements)"]
        if known.smoothers
        else [],
        "parameters": parameters if everything else [f"{len(parameters)}, named by --all"],
        "backend": [_backend(cls)],
    }
    for title, names in rows.items():
        if names:
            yield _hang(f"  {title + ':':<12}", ", ".join(names), width)
    for title, table in (("references", known.references), ("bounds", known.bounds)):
        if table:
            yield f"  {title}:"
        for name, maker in table.items():
            yield _hang(f"    {name:<22}", f"knows {maker.knows}", width)
    yield "  scenarios:"
    longest = max(map(len, cls.scenarios), default=0)
    for scenario in cls.scenarios.values():
        role = " (default)" if scenario.name == cls.default_scenario else ""
        role += " (training)" if scenario.training else ""
        head, room = f"    {scenario.name:<{longest}} ", width - len(role)
        words = scenario.description if everything else _shorten(head, scenario.description, room)
        yield _hang(head, f"{words}{role}", width)


def _shorten(head: str, text: str, width: int) -> str:
    """Return as many words of a text as fit in one line beside its head."""
    return textwrap.shorten(text, max(width - len(head) - 1, FEWEST_COLUMNS), placeholder=" ...")


def _hang(head: str, text: str, width: int | None) -> str:
    """Return a text beside its head, with a hanging indent."""
    if width is None:
        return f"{head} {text}"
    lines = textwrap.wrap(
        text,
        max(width - len(head) - 1, FEWEST_COLUMNS),
        break_on_hyphens=False,
        break_long_words=False,
    )
    return "\n".join(
        f"{head if i == 0 else ' ' * len(head)} {line}".rstrip() for i, line in enumerate(lines or [""])
    )
