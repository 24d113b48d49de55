"""What stands beyond the core, and how the core finds it: tables of places, ``module:name``, imported on first use.

A companion enters its line here and nothing else of the core names it. Where its module is missing, what it offers is
refused, and everything else works.
"""

import importlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

PACKAGE = __name__.partition(".")[0]

PREFIXES: Mapping[str, str] = {
    "exec:": "evaluation.competitors.programs:find_program",
    "isolated:": "evaluation.competitors.isolation:find_isolated",
    "file:": "evaluation.competitors.file_estimates:find_estimates",
    "gated:": "agents.gate:find_gated",
}
"""Before a competitor's name: a function of the name, of what follows the prefix, of the problem and of what finds
other competitors of it, that returns a :class:`.evaluation.competitors.kinds.Competitor`."""
SOURCES: Sequence[str] = ("baselines.fitted_filters:ADVISED", "agents.named_policies:LEARNED")
"""Each a :class:`.evaluation.competitors.kinds.CompetitorFiles`, of competitors in files and folders."""
WATCHES: Sequence[str] = ("agents.envelope:watch_live",)
"""Functions of a model, of the maker of a competitor and of its kind, which return what watches it where it runs live
(:class:`.evaluation.competitors.online_state.Watch`), or None."""
DEPARTURES: Sequence[str] = ("agents.envelope:departure",)
"""Functions of the class of a task, of the maker of an agent, of a scenario's data and of parameters, which return a
sentence on how these depart from what the agent was trained on, or None."""
MODEL_COMPANIONS: Sequence[str] = ("envs.logs.own_models:state_space_log_format",)
"""Functions of the definition of a model of one's own and of its defaults, each of which returns a companion of its
task."""
READERS: Sequence[str] = ("envs.logs.reading:RECORDINGS", "envs.logs.reading:FLIGHTS")
"""Each a :class:`.envs.data.scenario_data.Reader`, in the order in which they are tried."""


def load(place: str, package: str | None = PACKAGE) -> Any:
    """Import what stands at ``module:name`` of a package.

    Raises:
        ValueError: if this installation does not hold the module.
    """
    module, _, name = place.partition(":")
    path = f"{package}.{module}"
    try:
        return getattr(importlib.import_module(path), name)
    except ModuleNotFoundError as error:
        if error.name != path:
            raise
        raise ValueError(f"this installation of filtergym holds no {module}") from None


def load_present(places: Iterable[str], package: str | None = PACKAGE) -> Iterator[Any]:
    """Import what stands at several places of a package, without those whose module this installation does not hold."""
    for place in places:
        module = f"{package}.{place.partition(':')[0]}"
        if module in sys.modules or _is_there(module):
            yield load(place, package)


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # nor the package that it would stand in
        return False
