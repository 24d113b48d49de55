"""Terminal output, and the arguments that several commands share."""

import ast
import io
import os
import re
import shlex
import sys
import textwrap
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .progress import progress_bar as progress_bar

if TYPE_CHECKING:
    from ..envs.contract.task import Task

# --- completion by a shell; imports wait until it is used


def complete_environment(incomplete: str) -> list[str]:
    """Return the environment ids that complete a word of the command line, with or without ``filtergym/``."""
    from ..envs.engine.catalogue import catalogue

    ids = list(catalogue())
    found = [id for id in ids if id.startswith(incomplete)]
    return found or [short for id in ids if (short := id.removeprefix("filtergym/")).startswith(incomplete)]


def import_environments(value: Any) -> Any:
    """Import the modules of environments given as ``module:id``; return the argument unchanged."""
    from ..envs.engine.catalogue import import_task

    for word in [value] if isinstance(value, str) else value or ():
        if ":" in word:
            import_task(word)
    return value


def _environments_of(ctx: typer.Context) -> list[str]:
    """Return the id of the environment named in a command line to complete, in a list; else all ids."""
    from ..envs.engine.catalogue import catalogue, task_class

    named = ctx.params.get("environment")
    # Before an option has its value, click cannot parse the arguments: then the words as shells pass them.
    words = os.environ.get("_TYPER_COMPLETE_ARGS") or os.environ.get("COMP_WORDS", "")
    for word in [named] if isinstance(named, str) else words.split():
        with suppress(ValueError):
            return [task_class(word).id]
    return list(catalogue())


def complete_scenario(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the names of scenarios of the named environment that complete a word of the command line."""
    from ..envs.engine.catalogue import catalogue

    names = dict.fromkeys(name for id in _environments_of(ctx) for name in catalogue()[id].scenarios)
    return [name for name in names if name.startswith(incomplete)]


def complete_training_scenario(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the names of training scenarios of the named environment that complete a word of the command line."""
    from ..envs.engine.catalogue import catalogue

    scenarios = [own for id in _environments_of(ctx) for own in catalogue()[id].scenarios.values()]
    names = dict.fromkeys(own.name for own in scenarios if own.training)
    return [name for name in names if name.startswith(incomplete)]


def complete_policy(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the names of competitors of the named environment that complete a word of the command line."""
    from ..baselines.problem import problem_of
    from ..names import shipped_names

    ids = _environments_of(ctx)
    names = dict.fromkeys(name for id in ids for name in shipped_names(problem_of(id)))
    return [name for name in names if name.startswith(incomplete)]


def complete_from(*words: str) -> Callable[[str], list[str]]:
    """Return a function that completes a word of the command line to one of a few words."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


Environment = Annotated[
    str,
    typer.Argument(
        help="Environment id; `filtergym list` shows them. module:id for one that a module registers.",
        autocompletion=complete_environment,
        callback=import_environments,
    ),
]
ScenarioName = Annotated[
    str | None,
    typer.Option(
        help="Scenario; or flights of your own: a file (CSV, NetCDF, Parquet), a folder, or a pattern in quotes; "
        "default: the training distribution.",
        autocompletion=complete_scenario,
    ),
]
TrainingScenario = Annotated[
    str | None,
    typer.Option(
        help="A training scenario; held-out ones are refused.", autocompletion=complete_training_scenario
    ),
]
Episodes = Annotated[int, typer.Option(help="Monte Carlo runs.")]
Experiment = Annotated[int, typer.Option(help="Number of the experiment.")]
Trust = Annotated[
    bool,
    typer.Option(
        "--trust",
        help="Load files and modules that can execute code; use it only if you trust their authors.",
    ),
]
Control = Annotated[str | None, typer.Option(help="Control of all policies.")]
TrainedControl = Annotated[
    str | None, typer.Option(help="Control of the agent; default: the environment's first.")
]
Parameters = Annotated[
    list[str] | None, typer.Option("--set", help="Parameter of the task, name=value; repeat for several.")
]
TruthOption = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        help="File (CSV, .pos) with the truth of a recording in tables, matched by time; a note reports the share "
        "of measurements with a truth.",
    ),
]
RenameOption = Annotated[
    str | None,
    typer.Option(
        "--rename",
        help="Meaning of renamed columns of a table: 't=time,pos=x'. One column may be several: "
        "'accuracy=sigma_x,accuracy=sigma_y'; 'speed=-' ignores one.",
    ),
]
SortOption = Annotated[bool, typer.Option("--sort", help="Sort the rows of a table by time.")]
TruthOffset = Annotated[float, typer.Option(help="Offset that is added to the times of --truth, s.")]
Speeds = Annotated[str, typer.Option(help="Of recordings: lowest and highest possible speed, m/s.")]
Backend = Annotated[
    str,
    typer.Option(
        help="Implementation of the steps: auto, compiled (with filtergym[fast]) or numpy.",
        autocompletion=complete_from("auto", "compiled", "numpy"),
    ),
]
Threads = Annotated[int, typer.Option(help="Threads that share the episodes of the compiled backend.")]
Jobs = Annotated[
    int,
    typer.Option(
        help="Processes that share the work; -1: as many as there are cores. The results are the same."
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Share the work over a cluster (with filtergym[cluster]): ray or dask for a new one on "
        "this machine; ray://HOST:PORT, ray://auto, tcp://HOST:PORT or tls://HOST:PORT for one that runs.",
        autocompletion=complete_from("ray", "dask"),
    ),
]
Formats = Annotated[
    list[str] | None,
    typer.Option(
        "--format",
        help="Format of figures: png, svg (text stays text) or pdf (fonts embedded); repeat for several.",
        autocompletion=complete_from("png", "svg", "pdf"),
    ),
]
Columns = Annotated[
    int, typer.Option(help="Width of figures, in columns of a paper: 1 (3.5 in) or 2 (7.16 in).")
]
Split = Annotated[
    str,
    typer.Option(
        help="test, validation or train.", autocompletion=complete_from("test", "validation", "train")
    ),
]


PAGE_WIDTH = 100
"""Width of output into a file, and of sentences in a wide terminal, characters."""


class Output(Console):
    """Console on standard output that falls silent after an error of writing, while the command continues."""

    refusal: OSError | None = None
    """Error that ended the output; None while it works, and where the reader of a pipe has closed it."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print objects as rich does, unless standard output has failed before."""
        try:
            super().print(*objects, **options)
        except OSError as error:
            self.refusal = error
            self._end()

    def on_broken_pipe(self) -> None:
        """Fall silent after the reader of a pipe has closed it; rich would exit."""
        self._end()

    def _end(self) -> None:
        self.quiet = True
        # Buffered text would fail again when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def output_width() -> int | None:
    """Return the width of the output, characters; None: rich finds it from the terminal or the variable COLUMNS."""
    columns = os.environ.get("COLUMNS", "")
    terminal = sys.stdout is not None and sys.stdout.isatty()
    return None if terminal or (columns.isdigit() and int(columns) > 0) else PAGE_WIDTH


# No markup: names and paths are printed as they are.
console: Output = Output(width=output_width(), markup=False, emoji=False)


def fill(sentence: str, width: int) -> str:
    """Return a sentence broken into lines of ``width`` characters, not inside intervals or before units."""
    kept = re.sub(r"\[[^\]]*\]| %| ns\b", lambda found: found[0].replace(" ", "\xa0"), sentence)
    return textwrap.fill(kept, width, break_on_hyphens=False).replace("\xa0", " ")


def print_sentence(sentence: str, width: int = PAGE_WIDTH, bold: int = 0) -> None:
    """Print a sentence in lines of at most ``width`` characters, the first ``bold`` ones in bold type."""
    text = Text(fill(sentence, min(console.width, width)))
    text.stylize("bold", 0, bold)
    console.print(text, soft_wrap=True)


def print_table(table: Table, width: int = PAGE_WIDTH) -> None:
    """Print a table at its full width, its title above it, and its notes below."""
    title, notes = table.title, table.caption
    table.title = table.caption = None
    if title:
        console.print(
            fill(str(title), min(console.width, width)), style="bold", highlight=False, soft_wrap=True
        )
    console.print(table)
    console.print()
    for note in str(notes or "").splitlines():
        print_sentence(note, width)
    table.title, table.caption = title, notes


def open_output() -> None:
    """Make standard output escape the characters that its encoding lacks."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def close_output(*_: Any, **__: Any) -> None:
    """Raise ValueError if standard output has failed; called at the end of a command."""
    if console.refusal is not None:
        raise ValueError(
            f"cannot write to standard output: {console.refusal.strerror or console.refusal}"
        ) from console.refusal


def check_no_recording_options(truth: Any, rename: str | None, sort: bool) -> None:
    """Raise ValueError for an option of recordings in a command that reads none."""
    for option, given in (("--truth", truth), ("--rename", rename), ("--sort", sort or None)):
        if given is not None:
            raise ValueError(f"{option} is for a recording: --recording FILE {option} ...")


def parse_renames(text: str | None) -> dict[str, list[str]]:
    """Parse an option such as ``t=time,pos=x``; return the package's columns by each name in the file."""
    pairs = [part.split("=") for part in text.split(",")] if text else []
    if not all(len(pair) == 2 and all(map(str.strip, pair)) for pair in pairs):
        raise ValueError(
            f"--rename takes NAME=MEANING,NAME=MEANING, such as 't=time,pos=x', or NAME=- to ignore a column, "
            f"got {text!r}"
        )
    names: dict[str, list[str]] = {}
    for old, new in pairs:
        names.setdefault(old.strip(), []).append(new.strip())
    return names


def parse_pair(option: str, text: str) -> tuple[float, float]:
    """Parse two numbers such as ``48.72,2.38`` into a pair; ``option`` names it in errors."""
    try:
        first, second = map(float, text.split(","))
    except ValueError:
        raise ValueError(f"{option} needs two numbers with a comma between them, got {text!r}") from None
    return first, second


def parse_whole_numbers(option: str, text: str) -> list[int]:
    """Parse whole numbers such as ``0-2,7`` into 0, 1, 2 and 7, each once."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        try:
            numbers = range(int(first), int(last if dash else first) + 1)
        except ValueError:
            numbers = range(0)
        if not numbers:
            raise ValueError(f"{option} needs whole numbers such as 0-4 or 0,3,5-7, got {text!r}")
        found += [number for number in numbers if number not in found]
    return found


def command_line() -> str:
    """Return the running command as a shell would take it."""
    return shlex.join(["filtergym", *sys.argv[1:]])


def parse_settings(settings: list[str] | None, task: type["Task"] | None = None) -> dict[str, Any]:
    """Parse ``name=value`` into keywords; a value is a Python literal, or else a word.

    Args:
        settings: words of the command line; None: none.
        task: task whose parameters are allowed; None: any name.
    """
    keywords: dict[str, Any] = {}
    for setting in settings or []:
        name, equals, text = setting.partition("=")
        if not equals or not name.strip().isidentifier() or not text.strip():
            raise ValueError(f"--set needs name=value, such as --set horizon=50, got {setting!r}")
        try:
            keywords[name.strip()] = ast.literal_eval(text.strip())
        except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
            if not text.strip().replace("-", "_").isidentifier():
                raise ValueError(f"--set {name}: cannot read the value {text!r}") from error
            keywords[name.strip()] = text.strip()
    if task is not None:
        from ..envs.engine.catalogue import check_names

        check_names(task, keywords)
    return keywords
