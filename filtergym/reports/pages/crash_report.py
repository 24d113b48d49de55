"""Tables of a crash test, for the terminal and as a page."""

import io
from collections import Counter
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ...evaluation.stress.crash_test import (
    DEGRADED,
    DESCRIPTIONS,
    FAILED,
    NOT_CONTAINED,
    NOTHING,
    PASSED,
    Finding,
)

STYLES = {PASSED: "green", DEGRADED: "yellow", FAILED: "red", NOTHING: "dim"}
PAGE_WIDTH = 150
"""Width of the tables on a page, characters."""


def count_verdicts(findings: Sequence[Finding]) -> str:
    """Return the counts of the verdicts: ``14 passed, 6 degraded, 2 failed``."""
    counts = Counter(finding.verdict for finding in findings)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in (PASSED, DEGRADED, FAILED))


def crash_table(findings: Sequence[Finding], described: bool = False) -> Table:
    """Return the crash test's table of one competitor, a line for each alteration of the measurements."""
    left_out = [finding.alteration for finding in findings if finding.reason == NOT_CONTAINED]
    notes = f"Does not apply, as {NOT_CONTAINED}: {', '.join(left_out)}." if left_out else ""
    table = Table(
        title=f"{findings[0].competitor}: {count_verdicts(findings)}",
        caption=notes or None,
        box=None,
        pad_edge=False,
    )
    for name in ("alteration", *["what happens"] * described, "verdict", "how"):
        table.add_column(name)
    for finding in findings:
        if finding.reason != NOT_CONTAINED:
            what = [DESCRIPTIONS[finding.alteration]] * described
            verdict = Text(finding.verdict, STYLES[finding.verdict])
            table.add_row(finding.alteration, *what, verdict, Text(finding.reason))
    return table


def crash_page(title: str, tables: Sequence[Table], notes: Sequence[str]) -> str:
    """Return the tables of a crash test, under a title and with notes, as a self-contained HTML page."""
    console = Console(width=PAGE_WIDTH, record=True, file=io.StringIO(), force_terminal=True)
    console.print(title, style="bold", markup=False, highlight=False)
    for table in tables:
        console.print()
        console.print(table)
    for note in notes:
        console.print(note, markup=False, highlight=False)
    return console.export_html(inline_styles=True)
