"""Tidy records on disk: JSON, one record to a line."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..evaluation.files import write_text
from ..evaluation.metrics import Record


def write_records(path: Path, records: Sequence[Any]) -> None:
    """Write named tuples."""
    lines = ",\n".join(json.dumps(record._asdict()) for record in records)
    write_text(path, f"[\n{lines}\n]\n")


def read_records(path: Path) -> list[Record]:
    """Read an evaluation's records.

    Raises:
        ValueError: if the file does not hold them.
    """
    try:
        return [Record(**values) for values in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"cannot read the records of a benchmark in {path}: {error}") from error
