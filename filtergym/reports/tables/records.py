"""Tidy records on disk: JSON, one record to a line."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...evaluation.running.metrics import Record
from ...evaluation.storage.files import write_text
from ...evaluation.storage.stored import read_json, restore
from .results import check_numbers, read_results


def write_records(path: Path, records: Sequence[Any]) -> None:
    """Write named tuples."""
    lines = ",\n".join(json.dumps(record._asdict()) for record in records)
    write_text(path, f"[\n{lines}\n]\n")


def read_records(paths: Sequence[Path]) -> list[Record]:
    """Read records of all files together, tidy ones or files of results.

    Raises:
        ValueError: if a file holds neither.
    """
    records: list[Record] = []
    for path in paths:
        values = read_json(path)
        if not isinstance(values, list):
            records += [record for result in read_results(path)[0] for record in result.records]
            continue
        own = [restore(Record, each) for each in values]
        for record in own:
            check_numbers(record)
        records += own
    return records
