"""Tables of text, for a page in Markdown and for the terminal."""

from collections.abc import Sequence
from dataclasses import dataclass

from rich.table import Table


@dataclass(frozen=True)
class Grid:
    """A table of results as text."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def __rich__(self) -> Table:
        """Return the table for the terminal: numbers right-justified, without the marks of Markdown."""
        table = Table(title=_plain(self.title), title_justify="left")
        for i, name in enumerate(self.header):
            words = any(row[i].startswith("`") for row in self.rows)
            table.add_column(_plain(name), justify="left" if words else "right")
        for row in self.rows:
            table.add_row(*map(_plain, row))
        return table


def _plain(cell: str) -> str:
    return cell.replace("`", "").replace("<br>", "\n")


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table; a bar within a cell is escaped."""
    return [
        "| " + " | ".join(header) + " |",
        "|" + "---|" * len(header),
        *("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows),
    ]
