"""The command that lists environments."""

from typing import Annotated

import typer

from ..baselines.problem import problem_of
from ..envs.engine.catalogue import catalogue
from ..reports.tables.listing import environment_lines, list_lines
from .terminal import complete_environment, console, import_environments, print_sentence


def list_environments(
    environment: Annotated[
        list[str] | None,
        typer.Argument(
            help="Environment ids, to describe each; module:id for one that a module registers.",
            autocompletion=complete_environment,
            callback=import_environments,
        ),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Name the parameters, and describe scenarios in full.")
    ] = False,
) -> None:
    """List environments, a line each; or of one its paper, controls, competitors and scenarios.

    Example: filtergym list filtergym/ManeuveringTarget-v0
    """
    if not environment:
        # Where the output is a file, a line is one line.
        for line in list_lines(catalogue(), console.width if console.is_terminal else None):
            console.print(line, highlight=False, soft_wrap=True)
        console.print()
        print_sentence(
            "filtergym list ID names the competitors and scenarios of an environment; with --all its parameters, too."
        )
        return
    for id in environment:
        first, *lines = environment_lines(problem_of(id), console.width, everything)
        console.print(first, style="bold")
        for line in lines:
            console.print(line, highlight=False, soft_wrap=True)
