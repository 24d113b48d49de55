"""Tidy records on disk: JSON, one record to a line."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..envs.catalogue import catalogue, nearest
from ..evaluation.files import write_text
from ..evaluation.metrics import Record
from ..evaluation.stored import read_json, restored


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
        values = read_json(path)
        if not isinstance(values, list):
            raise ValueError("it is not a list")
        records = [restored(Record, fields) for fields in values]
        for record in records:
            _check_record(record)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot read the records of a benchmark in {path}: {error}") from error
    return records


def _check_record(record: Record) -> None:
    """Raise ValueError if a record is not one that an evaluation writes."""
    cls = catalogue().get(record.environment)
    if cls is None:
        raise nearest("environment", record.environment, catalogue())
    if record.scenario not in cls.scenarios:
        raise nearest("scenario", record.scenario, cls.scenarios)
    numbers = (record.value, record.low, record.high)
    finite = all(number is None or math.isfinite(number) for number in numbers)
    if not finite or (record.low is None) != (record.high is None):
        raise ValueError(f"value and interval must be finite or null, got {numbers}")
