"""Solutions of matrix equations with the numbers of the shipped environments, so that none of them starts with SciPy:
to import ``scipy.linalg`` takes a quarter of a second, longer than all else before a first step.

``stored_solutions.json`` holds them to the last bit, with what they are solutions of. Other numbers are solved anew.
"""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy

Solve = TypeVar("Solve", bound=Callable[..., Any])
FILE = Path(__file__).with_suffix(".json")


def stored(solve: Solve) -> Solve:
    """Decorate a function to read its result from the file of stored solutions, where present.

    Args:
        solve: of words, numbers and matrices; it returns a matrix or a tuple of them.
    """

    @functools.wraps(solve)
    def look_up(*arguments: Any) -> Any:
        found = _solutions().get(key_of(solve.__name__, *arguments))
        if found is None:
            return solve(*arguments)
        matrices = [numpy.array(rows) for rows in found]
        return tuple(matrices) if len(matrices) > 1 else matrices[0]

    return look_up  # type: ignore[return-value]


def key_of(name: str, *arguments: Any) -> str:
    """Return the text of a function and its arguments, every digit of them."""
    return json.dumps(
        [name, *(a if isinstance(a, str) else numpy.asarray(a, float).tolist() for a in arguments)]
    )


@functools.cache
def _solutions() -> dict[str, list[Any]]:
    if not FILE.exists():  # before any were written
        return {}
    entries = json.loads(FILE.read_text(encoding="utf-8"))
    return {json.dumps([entry["function"], *entry["arguments"]]): entry["solution"] for entry in entries}
