"""Tidy records on disk: JSON, one record to a line."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...evaluation.storage.files import write_text


def write_records(path: Path, records: Sequence[Any]) -> None:
    """Write named tuples."""
    lines = ",\n".join(json.dumps(record._asdict()) for record in records)
    write_text(path, f"[\n{lines}\n]\n")
