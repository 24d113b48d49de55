"""The command line: ``filtergym`` or ``python -m filtergym``."""

import sys

if __name__ == "__main__" and not sys.flags.safe_path:
    del sys.path[0]  # the working directory, where Python would look for every library that is still to come

import functools
import os
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from typing import Annotated, Any

import gymnasium
import typer
from rich.console import Console

from . import __version__
from .commands import improve, measure, report
from .commands.terminal import close_output, open_output
from .compiler.cache import SWITCH
from .envs.catalogue import modules_from

COMMANDS: dict[str, Callable[..., None]] = {
    "list": measure.list_environments,
    "evaluate": measure.evaluate_policies,
    "record": measure.record_scenario,
    "offline": measure.write_offline,
    "benchmark": measure.benchmark,
    "report": report.make,
    "comparison": report.comparison_page,
    "tune": improve.tune_policy,
    "room": report.room,
    "page": report.page,
    "reproduce": report.reproduce,
    "animate": measure.animate,
    "train": improve.train,
    "search": improve.search,
    "export": improve.export,
    "seeds": report.seeds,
}
REPORT = (
    "--debug shows where it happened: if that is not in code of your own, please report it with what it shows"
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"filtergym {__version__}")
        raise typer.Exit


def _general(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
    no_cache: Annotated[
        bool,
        typer.Option("--no-cache", help="Neither read nor keep compiled code in the user's cache folder."),
    ] = False,
) -> None:
    """Gymnasium environments for adaptive-filter benchmarking. With --debug, an error shows its traceback."""
    if no_cache:
        os.environ[SWITCH] = "off"


@functools.cache
def application() -> Any:
    """Return the commands as one program: called with its arguments, it ends in SystemExit."""
    app = typer.Typer(
        callback=_general,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # the extra in filtergym[fast] would be taken for a style
        result_callback=close_output,
    )
    for name, command in COMMANDS.items():
        app.command(name)(command)
    return typer.main.get_command(app)


def main() -> None:
    """Run the command line.

    A user's mistake, or what the operating system refuses, ends in one sentence and exit code 2; what nobody expected
    in one that asks for a report, and exit code 1. With ``--debug`` both end in a traceback.
    """
    debug = "--debug" in sys.argv
    open_output()
    try:
        with warnings.catch_warnings(), nullcontext() if sys.flags.safe_path else modules_from(os.getcwd()):
            warnings.showwarning = _show_warning
            # Under one name, however it was started: the shell asks for completions of that.
            application()([word for word in sys.argv[1:] if word != "--debug"], prog_name="filtergym")
    except Exception as error:
        if debug:
            raise
        text, code = f"Error: {error}", 2
        if isinstance(error, MemoryError):
            text = f"Error: not enough memory, ask for less at once: {error}"
        elif not isinstance(error, ValueError | OSError | ImportError | gymnasium.error.Error):
            text, code = f"Error: unexpected {type(error).__name__}: {error}; {REPORT}", 1
        _print_error(text, "red")
        sys.exit(code)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    _print_error(f"Warning: {message}", "yellow")


def _print_error(text: str, style: str) -> None:
    """Print one line to standard error."""
    Console(stderr=True, highlight=False, emoji=False).print(
        text.replace("\n", " "), style=style, markup=False, soft_wrap=True
    )


if __name__ == "__main__":
    main()
