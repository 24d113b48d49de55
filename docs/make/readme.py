"""README's table of results: README is shown as it stands, so what it has of the records is copied, and tested."""

from pathlib import Path

from comparison import compared_policies
from records import read_benchmark
from results_table import chosen_markdown

ENVIRONMENT = "ManeuveringTarget"
"""That README shows."""
BEGIN, END = "<!-- results table: begin -->", "<!-- results table: end -->"
"""Lines of README between which the table stands."""


def results_table() -> str:
    """Return the table that README shows, in Markdown."""
    found, record = read_benchmark(ENVIRONMENT)
    names = compared_policies(found.problem, found.records)
    return chosen_markdown({ENVIRONMENT: (found, record)}, policies=names)


def with_results_table(page: Path) -> str:
    """Return the text of a page with the table between its markers.

    Raises:
        ValueError: if there is no such page, or it lacks the markers.
    """
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{page} needs the lines {BEGIN} and {END}, between which the table is put")
    return f"{before}{BEGIN}\n\n{results_table()}\n\n{END}{after}"
