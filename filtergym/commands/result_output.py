"""Results that several commands print, and the report that they make."""

from collections.abc import Callable, Sequence
from pathlib import Path

from ..evaluation.storage.files import write_text
from ..reports.pages.outcome import outcome_sentences, protocol_sentences
from ..reports.tables.headline import headline_table
from ..reports.tables.ranking import remarks
from ..reports.tables.results import Result, Settings
from .terminal import console, print_sentence, print_table

REPORT = "report.html"


def print_outcome(results: Sequence[Result]) -> None:
    """Print a sentence on the best competitor of each environment, and one on the basis of the comparison."""
    for sentence in outcome_sentences(results):
        plain = sentence.replace("`", "")
        print_sentence(plain, bold=plain.index(":"))
    console.print()
    for sentence in protocol_sentences(results):
        print_sentence(sentence)


def print_headline(results: Sequence[Result]) -> None:
    """Print the best competitor of every origin as a table, and remarks on it."""
    print_table(headline_table(results))
    console.print()
    for sentence in remarks(results):
        print_sentence(sentence.replace("`", ""))


def report_maker() -> Callable[[Sequence[Result], Settings], str]:
    """Return the function :func:`.report_html`, which makes a page of results."""
    try:
        from ..reports.pages.html_report import report_html
    except ImportError as error:
        raise ValueError(f"reports need more packages: pip install 'filtergym[report]' ({error})") from error
    return report_html


def make_report(results: Sequence[Result], settings: Settings, out: Path) -> None:
    """Write a report and print its path; print the reason if packages for it are missing."""
    try:
        maker = report_maker()
    except ValueError as error:
        console.print(f"no report: {error}", soft_wrap=True)
        return
    write_text(out, maker(results, settings))
    console.print(f"report: {out} ({out.stat().st_size / 1e6:.1f} MB), opens in a browser", soft_wrap=True)
