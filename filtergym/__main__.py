"""The command line: ``filtergym`` or ``python -m filtergym``."""

import ast
import functools
import gc
import importlib
import inspect
import os
import signal
import sys
import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import typer
import typer.core
from rich.console import Console

from . import __version__
from .commands.terminal import close_output, open_output
from .compiler.cache import SWITCH
from .compiler.program import without_collection
from .envs.contract.failures import user_code_line
from .envs.engine.catalogue import modules_from

Commands = Mapping[str, Callable[..., None] | str]
"""Functions by the names of their commands, or ``module:function`` for an import on the first call."""
GROUPS: Mapping[str, Commands] = {
    "Use an environment": {
        "list": "listing:list_environments",
        "doctor": "doctor:examine",
        "animate": "measure:animate",
        "record": "measure:record_scenario",
    },
    "Compare": {
        "evaluate": "measure:evaluate_policies",
        "stress": "stress:stress",
        "benchmark": "measure:benchmark",
        "reproduce": "report:reproduce",
    },
    "Judge a log": {
        "advise": "advise:advise_on_log",
    },
    "Tune and train": {
        "tune": "improve:tune_policy",
        "train": "improve:train",
    },
    "Share": {
        "report": "report:make",
        "export": "export:export",
        "offline": "measure:write_offline",
        "submit": "submit:submit",
        "verify": "submit:verify_file",
    },
}
MARKUP: Any = "markdown"
"""Markup of the help; with rich's own, the extra in filtergym[fast] would be read as a style."""
REPORT = (
    "--debug shows the traceback: if it ends outside your own code, please report it with the traceback and the "
    "output of filtergym doctor"
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
        typer.Option("--no-cache", help="Neither read nor store compiled code in the user's cache folder."),
    ] = False,
) -> None:
    """Gymnasium environments for adaptive-filter benchmarking. With --debug, an error shows its traceback."""
    if no_cache:
        os.environ[SWITCH] = "off"


class Program(typer.core.TyperGroup):
    """Click group whose commands are imported when they are called, so that the help needs no library."""

    groups: Mapping[str, Commands]
    listing: bool = False
    """Whether the commands are only listed, each with its first sentence."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands, in the order of the help."""
        return [name for commands in self.groups.values() for name in commands]

    def get_command(self, ctx: Any, name: str) -> Any:
        """Return the click command called ``name``; None if there is none of that name."""
        for group, commands in self.groups.items():
            if name in commands:
                return (
                    _help_command(name, commands[name], group)
                    if self.listing
                    else _command(name, commands[name])
                )
        return None

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of the program, with the name and first sentence of each command."""
        self.listing = True
        super().format_help(ctx, formatter)
        self.listing = False

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Return the shell's completions of a command's name."""
        self.listing = True
        found = super().shell_complete(ctx, incomplete)
        self.listing = False
        return found


def import_command(command: Callable[..., None] | str) -> Callable[..., None]:
    """Return the function of a command, imported first if it is given as ``module:function``."""
    if not isinstance(command, str):
        return command
    module, _, name = command.partition(":")
    place = f"{__package__}.commands.{module}"
    if place not in sys.modules:
        with without_collection():  # a hundred thousand objects come, none of which is garbage
            importlib.import_module(place)
        gc.freeze()  # they live to the end: the collector need not visit them again
    function: Callable[..., None] = getattr(sys.modules[place], name)
    return function


def _command(name: str, command: Callable[..., None] | str) -> Any:
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=MARKUP)
    app.command(name)(import_command(command))
    return typer.main.get_command(app)


@functools.cache
def _docstrings(module: str) -> dict[str, str | None]:
    """Return the docstring of each function of a module in ``commands``, by name, without an import of the module."""
    text = (Path(__file__).parent / "commands" / f"{module}.py").read_text(encoding="utf-8")
    return {n.name: ast.get_docstring(n) for n in ast.parse(text).body if isinstance(n, ast.FunctionDef)}


def _help_command(name: str, command: Callable[..., None] | str, group: str) -> Any:
    """Return a click command that has only a help text, read from the source."""
    if isinstance(command, str):
        module, _, function = command.partition(":")
        words = _docstrings(module)[function]
    else:
        words = inspect.getdoc(command)
    return typer.core.TyperCommand(name, help=words, rich_help_panel=group, rich_markup_mode=MARKUP)


def program_of(groups: Mapping[str, Commands]) -> Any:
    """Return the click program of several commands, with grouped help; a call of it ends in SystemExit."""
    app = typer.Typer(
        cls=type("Program", (Program,), {"groups": groups}),
        callback=_general,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=MARKUP,
        result_callback=close_output,
    )
    return typer.main.get_command(app)


@functools.cache
def application() -> Any:
    """Return the click program ``filtergym`` with all its commands, cached."""
    return program_of(GROUPS)


def main(program: Callable[[], Any] = application, name: str = "filtergym") -> None:
    """Run the command line, or another program, with errors as one sentence on standard error.

    A user's mistake, or a refusal of the operating system, ends in one sentence and exit code 2; an unexpected error in
    one that requests a report, and exit code 1. With ``--debug`` both end in a traceback.
    """
    debug = "--debug" in sys.argv
    with suppress(ValueError):  # a thread may not
        signal.signal(signal.SIGTERM, _end)
    open_output()
    try:
        with warnings.catch_warnings(), nullcontext() if sys.flags.safe_path else modules_from(os.getcwd()):
            warnings.showwarning = _show_warning
            # One name for every way of starting it, since the shell completes that name.
            program()([word for word in sys.argv[1:] if word != "--debug"], prog_name=name)
    except Exception as error:
        if debug:
            raise
        text, code = f"Error: {error}", 2
        if isinstance(error, MemoryError):
            text = f"Error: not enough memory, run less at once: {error}"
        elif not isinstance(error, ValueError | OSError | ImportError | gymnasium.error.Error):
            text, code = (
                f"Error: unexpected {type(error).__name__}: {error}{user_code_line(error)}; {REPORT}",
                1,
            )
        _print_error(text, "red")
        sys.exit(code)


def _end(number: int, _: Any) -> None:
    """Exit with code 128 + ``number`` of the signal, as after an error, so that unfinished files are removed."""
    sys.exit(128 + number)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    _print_error(f"Warning: {message}", "yellow")


def _print_error(text: str, style: str) -> None:
    Console(stderr=True, highlight=False, emoji=False).print(
        text.replace("\n", " "), style=style, markup=False, soft_wrap=True
    )


if __name__ == "__main__":
    main()
