"""Pages whose tables are made by a command and stand between markers."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from filtergym.evaluation.files import write_text


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def check_markers(path: Path, names: Iterable[str]) -> None:
    """Check that a page can take texts of these names.

    Raises:
        ValueError: if the page does not exist or lacks one of the markers.
    """
    insert_texts(path, dict.fromkeys(names, ""))


def markers_of(path: Path) -> list[str]:
    """Names of the markers that a page has; none if there is no such page."""
    return re.findall(r"<!-- (.+?): begin -->", _read(path))


def insert_texts(path: Path, texts: Mapping[str, str]) -> str:
    """Return a page with each text between ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``.

    Raises:
        ValueError: if the page does not exist or lacks one of the markers.
    """
    page = _read(path)
    for name, text in texts.items():
        begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
        before, found_begin, rest = page.partition(begin)
        _, found_end, after = rest.partition(end)
        if not found_begin or not found_end:
            raise ValueError(f"{path} needs the lines {begin} and {end}, between which the table is put")
        page = f"{before}{begin}\n\n{text}\n\n{end}{after}"
    return page


def insert_between_markers(path: Path, texts: Mapping[str, str]) -> None:
    """Put each text between its markers on a page, all of them at once."""
    write_text(path, insert_texts(path, texts))
