"""Command that says what there is."""

from typing import Annotated

import typer

from ..baselines.problem import problem_of
from ..envs.engine.catalogue import catalogue
from ..reports.listing import environment_lines
from .terminal import complete_environment, console, import_environments


def list_environments(
    environment: Annotated[
        list[str] | None,
        typer.Argument(
            help="Environment ids, default all; module:id for one that a module registers.",
            autocompletion=complete_environment,
            callback=import_environments,
        ),
    ] = None,
) -> None:
    """List environments with their papers, controls, scenarios, policies, references and bounds.

    Example: filtergym list filtergym/ManeuveringTarget-v0
    """
    for id in environment or catalogue():
        first, *lines = environment_lines(problem_of(id))
        console.print(first, style="bold")
        for line in lines:
            console.print(line, highlight=False, soft_wrap=True)
