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


def write_records(path: Path, records: Sequence[Any]) -> None:
    """Write tidy records as JSON, one record to a line."""
    lines = ",\n".join(json.dumps(record._asdict()) for record in records)
    write_text(path, f"[\n{lines}\n]\n")
