"""The command line: ``filtergym`` or ``python -m filtergym``."""

import sys
from collections.abc import Callable
from typing import Annotated

import gymnasium
import typer
from rich.console import Console

from . import __version__
from .commands import improve, measure, report

COMMANDS: dict[str, Callable[..., None]] = {
    "list": measure.list_environments,
    "evaluate": measure.evaluate_policies,
    "benchmark": measure.benchmark,
    "comparison": report.comparison_page,
    "tune": improve.tune_policy,
    "room": report.room,
    "page": report.page,
    "reproduce": report.reproduce,
    "animate": measure.animate,
    "train": improve.train,
    "export": improve.export,
    "seeds": report.seeds,
}


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"filtergym {__version__}")
        raise typer.Exit


def _general(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Gymnasium environments for adaptive-filter benchmarking."""


def main() -> None:
    """Run the command line; a user's mistake ends in one sentence and exit code 2."""
    app = typer.Typer(
        callback=_general,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
    )
    for name, command in COMMANDS.items():
        app.command(name)(command)
    try:
        app()
    except (ValueError, gymnasium.error.Error) as error:
        Console(stderr=True, highlight=False).print(
            f"Error: {error}", style="red", markup=False, soft_wrap=True
        )
        sys.exit(2)


if __name__ == "__main__":
    main()
