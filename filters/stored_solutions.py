"""Stored solutions of matrix equations for the shipped environments, so that they start without SciPy.

Importing ``scipy.linalg`` takes a quarter of a second.

``stored_solutions.json`` contains them to the last bit, with the equations' arguments. For other arguments the
equations are solved.
"""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy

Solve = TypeVar("Solve", bound=Callable[..., Any])
FILE = Path(__file__).with_suffix(".json")


def use_stored_solution(solve: Solve) -> Solve:
    """Decorate a function that solves a matrix equation: it returns the stored solution where there is one.

    Args:
        solve: function of strings, numbers and matrices that returns a matrix or a tuple of matrices.
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
    """Return the key of a stored solution: function name and arguments, to all digits, as text."""
    return json.dumps(
        [name, *(a if isinstance(a, str) else numpy.asarray(a, float).tolist() for a in arguments)]
    )


@functools.cache
def _solutions() -> dict[str, list[Any]]:
    if not FILE.exists():  # before any were written
        return {}
    entries = json.loads(FILE.read_text(encoding="utf-8"))
    return {json.dumps([entry["function"], *entry["arguments"]]): entry["solution"] for entry in entries}
