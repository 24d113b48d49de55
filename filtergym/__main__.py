"""The command line: ``filtergym`` or ``python -m filtergym``."""

import sys
from collections.abc import Callable

import gymnasium
import typer
from rich.console import Console

from .commands import improve, measure, report
from .commands.terminal import close_output, open_output

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


def main() -> None:
    """Run the command line; a user's mistake ends in one sentence and exit code 2."""
    app = typer.Typer(
        help="Gymnasium environments for adaptive-filter benchmarking.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        result_callback=close_output,
    )
    for name, command in COMMANDS.items():
        app.command(name)(command)
    open_output()
    try:
        app()
    except (ValueError, OSError, gymnasium.error.Error) as error:
        Console(stderr=True, highlight=False).print(
            f"Error: {error}", style="red", markup=False, soft_wrap=True
        )
        sys.exit(2)


if __name__ == "__main__":
    main()
