"""Tidy records on disk: JSON, one record to a line."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..envs.catalogue import catalogue, nearest
from ..evaluation.files import write_text
from ..evaluation.metrics import Record


def write_records(path: Path, records: Sequence[Any]) -> None:
    """Write named tuples."""
    lines = ",\n".join(json.dumps(record._asdict()) for record in records)
    write_text(path, f"[\n{lines}\n]\n")


def check_known(record: Record) -> None:
    """Raise ValueError if a record is of an environment or a scenario that is not here."""
    cls = catalogue().get(record.environment)
    if cls is None:
        raise nearest("environment", record.environment, catalogue())
    if record.scenario not in cls.scenarios:
        raise nearest("scenario", record.scenario, cls.scenarios)
