"""Pages whose tables are made by a command and stand between markers."""

import re
from pathlib import Path

from ..evaluation.files import write_text


def split_at_markers(path: Path, name: str) -> tuple[str, str]:
    """Return a page up to and with ``<!-- NAME: begin -->``, and from ``<!-- NAME: end -->`` on.

    Raises:
        ValueError: if the page does not exist or has no such markers.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    page = path.read_text(encoding="utf-8") if path.is_file() else ""
    before, found_begin, rest = page.partition(begin)
    _, found_end, after = rest.partition(end)
    if not found_begin or not found_end:
        raise ValueError(f"{path} needs the lines {begin} and {end}, between which the table is put")
    return before + begin, end + after


def markers_of(path: Path) -> list[str]:
    """Names of the markers that a page has; none if there is no such page."""
    page = path.read_text(encoding="utf-8") if path.is_file() else ""
    return re.findall(r"<!-- (.+?): begin -->", page)


def insert_between_markers(path: Path, name: str, text: str) -> None:
    """Replace what stands between the two markers of a page."""
    before, after = split_at_markers(path, name)
    write_text(path, f"{before}\n\n{text}\n\n{after}")
