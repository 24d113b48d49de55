"""Parts of a reproduction of a paper.

A folder beside this file is a paper: ``experiment`` (runs and computations), ``claims`` (a table of statements, which
:func:`judge_claims` reads, and the quantities that they rest on; tables of results), ``figures``. Its ``__init__.py``
defines ``TITLE``, ``STEPS`` (units of work that it reports to the progress callback) and
``reproduce(progress, episodes=None, workers=None) -> Reproduction``, where ``episodes`` replaces the paper's own number
of Monte Carlo runs. Uncertainties: :mod:`.quantities`. Pictures: :mod:`.panels`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

from rich.table import Table

from ..evaluation.figures.print_layout import save
from ..evaluation.running.parallel import Workers, check_workers
from ..evaluation.storage.files import whole_files, write_text
from .grid import Grid, markdown_table

Verdict = Literal["reproduced", "reproduced in part", "not reproduced", "paper is silent"]
Progress = Callable[[int], None]
"""Function that is called with the number of units of work done."""
UNCERTAINTY = (
    '± is one standard error, by bootstrap over the runs; "certainly" means by a 95 % bootstrap interval.'
)


class Later(NamedTuple):
    """A postponed unit of work: a function, which must be a module's, and its arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    keywords: dict[str, Any]


def later(function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
    """Return a postponed call of a function, which :func:`compute_units` replaces by its result."""
    return Later(function, arguments, keywords)


def compute_units(results: Any, progress: Progress, workers: Workers | None = None) -> Any:
    """Return nested containers with each postponed call of :func:`later` replaced by its result.

    Containers are tuples, named ones too, lists and dictionaries; ``progress`` is called with the number of
    units done.
    """
    units: list[Later] = []
    _replace_units(results, units.append)
    done = check_workers(workers).results(_unit, units, [1] * len(units), progress)
    found = iter(done)
    return _replace_units(results, lambda unit: next(found))


def _unit(unit: Later, tick: Progress) -> Any:
    found = unit.function(*unit.arguments, **unit.keywords)
    tick(1)
    return found


def _replace_units(part: Any, instead: Callable[[Later], Any]) -> Any:
    """Return nested containers with ``instead(unit)`` in place of each postponed call, in order."""
    if isinstance(part, Later):
        return instead(part)
    if isinstance(part, dict):
        return {key: _replace_units(value, instead) for key, value in part.items()}
    if isinstance(part, list):
        return [_replace_units(value, instead) for value in part]
    if isinstance(part, tuple):
        values = [_replace_units(value, instead) for value in part]
        return type(part)(*values) if hasattr(part, "_fields") else tuple(values)
    return part


def verdict_if(holds: bool) -> Verdict:
    """Return "reproduced" if a claim of one part holds, else "not reproduced"."""
    return "reproduced" if holds else "not reproduced"


def verdict_of(holds: Iterable[bool]) -> Verdict:
    """Return the verdict on a claim with several parts: reproduced if all of them hold, in part if some do."""
    parts = list(holds)
    return "reproduced" if all(parts) else "reproduced in part" if any(parts) else "not reproduced"


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, or a question that it leaves open, with measurement, method and verdict."""

    key: str
    statement: str
    """Claim of the paper, in our words; or the question, where it is silent."""
    measured: str
    """Measured quantities in words, with their uncertainty."""
    method: str
    """Runs, windows, statistic."""
    verdict: Verdict = "paper is silent"


class Statement(NamedTuple):
    """A row of a paper's table of claims; in its texts ``{name:.2f}`` stands for a measured quantity."""

    key: str
    statement: str
    """Claim of the paper, in our words; or the question, where it is silent."""
    measured: str
    method: str
    verdict: Callable[[Any], Verdict] | Verdict = "paper is silent"
    """Verdict, or function of the measured quantities, its argument's attributes, that returns one."""


def judge_claims(table: Iterable[Statement], quantities: Mapping[str, Any]) -> list[Claim]:
    """Return the claims of a table, with the measured quantities in their texts, and verdicts."""
    found = SimpleNamespace(**quantities)
    return [
        Claim(
            row.key,
            row.statement,
            row.measured.format_map(quantities),
            row.method.format_map(quantities),
            row.verdict(found) if callable(row.verdict) else row.verdict,
        )
        for row in table
    ]


@dataclass(frozen=True)
class Reproduction:
    """Claims with verdicts, tables and figures of one paper."""

    title: str
    claims: Sequence[Claim]
    tables: Sequence[Grid] = ()
    figures: Mapping[str, tuple[Any, str]] = field(default_factory=dict)
    """File name without suffix -> Matplotlib figure and its caption, one sentence."""
    command: str = ""
    """Command of the reproduction."""

    def markdown(self, suffix: str = "png") -> str:
        """Return claims, tables and links to the figures' files as one page of Markdown."""
        lines = [f"# {self.title}", ""]
        if self.command:
            lines += [f"Made by `{self.command}`.", ""]
        lines += [UNCERTAINTY, "", "## Claims", ""]
        lines += markdown_table(
            ("claim", "measured", "method", "verdict"),
            [(f"**{c.key}.** {c.statement}", c.measured, c.method, f"**{c.verdict}**") for c in self.claims],
        )
        for table in self.tables:
            lines += ["", f"## {table.title}", "", *markdown_table(table.header, table.rows)]
        for name, (_, caption) in self.figures.items():
            lines += ["", f"![{caption}]({name}.{suffix})", "", caption]
        return "\n".join(lines) + "\n"

    def save(self, folder: Path, formats: Sequence[str] = ("png",)) -> None:
        """Write ``report.md`` and the figures into an existing folder, all of them or none.

        The report shows the figures of the first format.
        """
        with whole_files(folder) as waiting:
            for name, (figure, _) in self.figures.items():
                for suffix in formats:
                    save(figure, waiting / f"{name}.{suffix}")
            write_text(waiting / "report.md", self.markdown(formats[0]))

    def __rich__(self) -> Table:
        """Return a table of claims, measured quantities and verdicts for the terminal."""
        table = Table("claim", "measured", "verdict", title=self.title, show_lines=True)
        for claim in self.claims:
            table.add_row(f"{claim.key}. {claim.statement}", claim.measured, claim.verdict)
        return table


def episode_count(episodes: int | None, default: int, least: int = 2) -> int:
    """Return the number of Monte Carlo runs of a reproduction; ``default`` for None.

    Raises:
        ValueError: for fewer than ``least``; a single run has no interval.
    """
    count = default if episodes is None else episodes
    if count < least:
        raise ValueError(f"episodes must be at least {least} for intervals over them, got {count}")
    return count


def reproduction_command(module: str, episodes: int | None) -> str:
    """Return the command that reproduces the paper of a module; with ``--episodes`` unless ``episodes`` is None."""
    paper = module.rpartition(".")[2].replace("_", "-")
    runs = "" if episodes is None else f" --episodes {episodes}"
    return f"filtergym reproduce {paper}{runs} --out DIR"
