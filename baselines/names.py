"""Evaluation of an environment's own competitors by their names: a door for papers, pages and tests."""

from collections.abc import Mapping, Sequence
from typing import Any

import xarray

from .problem import problem_of


def evaluate(
    id: str, competitors: str | Sequence[str] | Mapping[str, Any], *arguments: Any, **keywords: Any
) -> xarray.Dataset:
    """Run competitors over the same episodes, the environment's own by their names.

    Args:
        id: environment id.
        competitors: a name, or names; or by name what :func:`.evaluate.run_experiment` takes, or a name.
        *arguments: of :meth:`.Problem.evaluate`.
        **keywords: likewise.

    Raises:
        ValueError: for an unknown name, and whatever that method refuses.
    """
    if isinstance(competitors, str):
        competitors = [competitors]
    named = competitors if isinstance(competitors, Mapping) else {name: name for name in competitors}
    problem = problem_of(id)
    objects = {
        name: problem.competitor(entry) if isinstance(entry, str) else entry for name, entry in named.items()
    }
    return problem.evaluate(objects, *arguments, **keywords)
