"""Tables of the parts beyond the core, as places ``module:name`` that are imported on first use.

No other file of the core names a companion. Where its module is missing, the core refuses its functions, and
everything else works.
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
"""Prefixes of competitors' names, each with a function of the name, the rest after the prefix, the problem and the
finder of other competitors, that returns a :class:`.evaluation.competitors.kinds.Competitor`.
"""
SOURCES: Sequence[str] = ("baselines.fitted_filters:ADVISED", "agents.named_policies:LEARNED")
"""Sources of competitors in files and folders, each a :class:`.evaluation.competitors.kinds.CompetitorFiles`."""
WATCHES: Sequence[str] = ("agents.envelope:watch_live",)
"""Functions of a model, of the maker of a competitor and of its kind, which return a monitor of its live run
(:class:`.evaluation.competitors.online_state.Watch`), or None.
"""
DEPARTURES: Sequence[str] = ("agents.envelope:departure",)
"""Functions of the class of a task, of the maker of an agent, of a scenario's data and of parameters, which return a
sentence on how the data depart from the agent's training, or None.
"""
MODEL_COMPANIONS: Sequence[str] = ("envs.logs.own_models:state_space_log_format",)
"""Functions of the definition of a user's model and of its defaults, each of which returns a companion of its task."""
READERS: Sequence[str] = ("envs.logs.reading:RECORDINGS", "envs.logs.reading:FLIGHTS")
"""Readers of data, each a :class:`.envs.data.scenario_data.Reader`, in the order in which they are tried."""


def load(place: str, package: str | None = PACKAGE) -> Any:
    """Return the object ``module:name`` of a package, imported if necessary.

    Raises:
        ValueError: if this installation lacks the module.
    """
    module, _, name = place.partition(":")
    path = f"{package}.{module}"
    try:
        return getattr(importlib.import_module(path), name)
    except ModuleNotFoundError as error:
        if error.name != path:
            raise
        raise ValueError(f"this installation of filtergym lacks {module}") from None


def load_present(places: Iterable[str], package: str | None = PACKAGE) -> Iterator[Any]:
    """Yield the imported objects at several places, without those whose module this installation lacks."""
    for place in places:
        module = f"{package}.{place.partition(':')[0]}"
        if module in sys.modules or _is_there(module):
            yield load(place, package)


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # nor the package that it would stand in
        return False
