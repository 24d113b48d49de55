"""Results on disk: whole or not at all."""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def writable_folder(path: Path) -> Path:
    """Make a folder and check that it can be written to, before any long work begins.

    Raises:
        ValueError: if it cannot.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise ValueError(f"cannot write to folder {path}: {error.strerror or error}") from error
    return path


def write_text(path: Path, text: str) -> None:
    """Write a file under a temporary name and move it into place.

    Raises:
        ValueError: if the folder cannot be written to.
    """
    writable_folder(path.parent)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)


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


def insert_between_markers(path: Path, name: str, text: str) -> None:
    """Replace what stands between the two markers of a page."""
    before, after = split_at_markers(path, name)
    write_text(path, f"{before}\n\n{text}\n\n{after}")


def write_records(path: Path, records: Sequence[Any]) -> None:
    """Write tidy records as JSON, one record to a line."""
    lines = ",\n".join(json.dumps(record._asdict()) for record in records)
    write_text(path, f"[\n{lines}\n]\n")
