"""What stands beyond the core, and how the core finds it: tables of places, ``module:name``, imported on first use.

A companion enters its line here and nothing else of the core names it. Where its module is missing, what it offers is
refused, and everything else works.
"""

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

PREFIXES: Mapping[str, str] = {
    "exec:": "evaluation.competitors.programs:find_program",
    "isolated:": "evaluation.competitors.isolation:find_isolated",
    "file:": "evaluation.competitors.file_estimates:find_estimates",
    "gated:": "agents.gate:find_gated",
}
"""Before a competitor's name: a function of the name, of what follows the prefix, of the problem and of what finds
other competitors of it, that returns a :class:`.evaluation.competitors.kinds.Competitor`."""
SOURCES: Sequence[str] = ("baselines.fitted_filters:ADVISED", "agents.named_policies:LEARNED")
"""Each a :class:`.evaluation.competitors.kinds.Source`, of competitors in files and folders."""


def load(place: str) -> Any:
    """Import what stands at ``module:name`` of this package.

    Raises:
        ValueError: if this installation does not hold the module.
    """
    module, _, name = place.partition(":")
    path = f"{__package__}.{module}"
    try:
        return getattr(importlib.import_module(path), name)
    except ModuleNotFoundError as error:
        if error.name != path:
            raise
        raise ValueError(f"this installation of filtergym holds no {module}") from None
