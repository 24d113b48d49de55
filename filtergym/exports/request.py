"""What is to be exported: a competitor, and the parameters that it gets."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from ..baselines.problem import Problem
from ..envs.contract.log_format import LogSetup
from ..names import file_endings, find_competitor


class ExportRequest(NamedTuple):
    """What is to be written: a competitor, and the parameters that it gets."""

    problem: Problem
    """Whose competitor it is."""
    name: str
    maker: Any
    """Of the competitor."""
    scenario: Any = None
    """Whose parameters it gets, and whose episodes it is compared on, of the test split; a recording, too."""
    keywords: Mapping[str, Any] = MappingProxyType({})
    """Parameters of the task."""
    log: LogSetup | None = None
    """How the log was read that it was advised for."""


def request_export(
    problem: Problem, name: str | Path, scenario: Any = None, *, trust: bool = False, **keywords: Any
) -> ExportRequest:
    """Find a competitor by its name.

    Args:
        problem: whose competitor it is.
        name: as of :func:`~filtergym.names.competitor`.
        scenario: of the request.
        trust: import what can execute code.
        **keywords: of the request.

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
    """Return the name of a competitor; of a file its own, without folder and ending, and without that of the
    environment.
    """
    text = str(name)
    for ending in file_endings():
        if text.endswith(ending):
            return Path(name).name.removesuffix(ending).removeprefix(f"{problem.short_name}.")
    return Path(name).name if Path(name).is_dir() else text
