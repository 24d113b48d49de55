"""The request of an export: a competitor with its parameters."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from ..baselines.problem import Problem
from ..envs.contract.log_format import LogSetup
from ..names import file_endings, find_competitor


class ExportRequest(NamedTuple):
    """A competitor to export: problem, name, factory, scenario, parameters and log."""

    problem: Problem
    """Problem of the competitor."""
    name: str
    maker: Any
    """Maker of the competitor."""
    scenario: Any = None
    """Scenario or recording that gives the parameters, and the episodes of the comparison, of the test split."""
    keywords: Mapping[str, Any] = MappingProxyType({})
    """Parameters of the task."""
    log: LogSetup | None = None
    """Reading of the log that the filter was advised for."""


def request_export(
    problem: Problem, name: str | Path, scenario: Any = None, *, trust: bool = False, **keywords: Any
) -> ExportRequest:
    """Return the request to export a competitor, found by its name or file.

    Args:
        problem: problem of the competitor.
        name: name or path, see :func:`~filtergym.names.competitor`.
        scenario: scenario of the request; default: that of the log for which ``advise`` found the competitor.
        trust: whether to load files that can execute code.
        **keywords: parameters of the task.

    Raises:
        ValueError: for an unknown name.
    """
    found = find_competitor(problem, name, trust)
    log = found.log
    read: dict[str, Any] = {}
    if log is not None and scenario is None:
        read, scenario = log.parameters, log.scenario(problem.task)
    return ExportRequest(
        problem,
        _own_name(problem, name),
        found.maker,
        scenario,
        {**read, **keywords},
        log,
    )


def _own_name(problem: Problem, name: str | Path) -> str:
    """Return the name under which a competitor is exported; of a file its stem without the environment's name."""
    text = str(name)
    for ending in file_endings():
        if text.endswith(ending):
            return Path(name).name.removesuffix(ending).removeprefix(f"{problem.short_name}.")
    return Path(name).name if Path(name).is_dir() else text
