"""What several commands print of results, and the report that they make of them."""

from collections.abc import Sequence
from pathlib import Path

from ..evaluation.files import write_text
from ..evaluation.metrics import Record
from ..reports.headline import headline_table
from ..reports.ranking import verdict
from ..reports.results import Result, Settings
from ..reports.tables import results_tables
from .terminal import console

REPORT = "report.html"


def print_results(records: Sequence[Record]) -> None:
    """Print the comparison of one environment and scenario, in as many tables as the terminal is narrow."""
    for table in results_tables(records, console.width):
        console.print(table)


def print_verdict(results: Sequence[Result]) -> None:
    """Print what results come to: one screen."""
    console.print(headline_table(results), width=min(console.width, 80))
    console.print()
    for sentence in verdict(results):
        console.print(sentence.replace("`", ""), width=min(console.width, 80), highlight=False)


def make_report(results: Sequence[Result], settings: Settings, out: Path) -> None:
    """Make a report and say where it is, or what it needs.

    Raises:
        ValueError: if it cannot be written.
    """
    try:
        from ..reports.html_report import report_html
    except ImportError as error:
        console.print(
            f"no report: it needs more packages, pip install 'filtergym[report]' ({error})", soft_wrap=True
        )
        return
    write_text(out, report_html(results, settings))
    console.print(f"report: {out} ({out.stat().st_size / 1e6:.1f} MB), opens in a browser", soft_wrap=True)
