"""What a reproduction of a paper consists of, and how it is found and saved.

Every environment's folder beside this file names its ``PAPER`` and holds a module ``reproduction``, which
defines ``TITLE``, ``STEPS`` (units of work that it reports to the progress callback) and
``reproduce(progress, episodes=None) -> Reproduction``.
"""

import importlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from ..envs.catalogue import nearest
from ..evaluation.figures import save
from ..evaluation.files import write_text
from .catalogue import packages

Verdict = Literal["reproduced", "reproduced in part", "not reproduced", "paper is silent"]


@dataclass(frozen=True)
class Claim:
    """One claim of the paper, or one thing it does not mention."""

    key: str
    statement: str
    """What the paper says, in our words; or the question, where it is silent."""
    measured: str
    """The figures, with their uncertainty."""
    method: str
    """Runs, windows, statistic."""
    verdict: Verdict


@dataclass(frozen=True)
class Grid:
    """A table of results as text."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Reproduction:
    """Claims with verdicts, tables and figures of one paper."""

    title: str
    claims: Sequence[Claim]
    tables: Sequence[Grid] = ()
    figures: dict[str, Any] = field(default_factory=dict)
    """File name without suffix -> Matplotlib figure."""
    captions: dict[str, str] = field(default_factory=dict)
    """One sentence for each figure."""


def papers() -> dict[str, str]:
    """Return the package of every paper that can be reproduced, by its name on the command line."""
    return {package.PAPER: package.__name__ for package in packages()}


def paper_module(name: str) -> ModuleType:
    """Import the reproduction of a paper.

    Raises:
        ValueError: if there is none of that name.
    """
    known = papers()
    if name not in known:
        raise nearest("paper", name, known)
    return importlib.import_module(f"{known[name]}.reproduction")


def episode_count(episodes: int | None, default: int) -> int:
    """Return the number of Monte Carlo runs of a reproduction.

    Raises:
        ValueError: for fewer than two, which have no interval.
    """
    count = default if episodes is None else episodes
    if count < 2:
        raise ValueError(f"episodes must be at least 2 for intervals over them, got {count}")
    return count


def as_markdown(result: Reproduction) -> str:
    """Claims, tables and figures as one page."""
    lines = [f"# {result.title}", "", "## Claims", ""]
    lines += markdown_table(
        ("claim", "what was measured", "how", "verdict"),
        [(f"**{c.key}.** {c.statement}", c.measured, c.method, f"**{c.verdict}**") for c in result.claims],
    )
    for table in result.tables:
        lines += ["", f"## {table.title}", "", *markdown_table(table.header, table.rows)]
    for name in result.figures:
        caption = result.captions.get(name, name.replace("_", " "))
        lines += ["", f"![{caption}]({name}.png)", "", caption]
    return "\n".join(lines) + "\n"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table; a bar within a cell is escaped."""
    return [
        "| " + " | ".join(header) + " |",
        "|" + "---|" * len(header),
        *("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows),
    ]


def save_reproduction(result: Reproduction, folder: Path) -> None:
    """Write ``report.md`` and the figures into an existing folder, all of them or none."""
    with tempfile.TemporaryDirectory(dir=folder, prefix=".unfinished-") as waiting:
        for name, figure in result.figures.items():
            save(figure, Path(waiting) / f"{name}.png")
        write_text(Path(waiting) / "report.md", as_markdown(result))
        for path in Path(waiting).iterdir():
            path.replace(folder / path.name)
