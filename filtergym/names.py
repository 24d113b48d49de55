"""Search for competitors by name: shipped ones, files, folders, and classes of a user."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from .baselines.problem import Problem, import_problem
from .envs.contract.parameters import quote_shortened
from .envs.engine.catalogue import import_user_module, nearest
from .evaluation.competitors.kinds import Competitor, CompetitorFiles, check_competitor
from .evaluation.running.supervision import report_running
from .extensions import PREFIXES, SOURCES, load, load_present

MODULE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
"""Pattern of a name ``module:Class`` of a user's competitor."""


def competitor(env: str, name: str | Path, *, trust: bool = False) -> Any:
    """Return the factory (class or function) of the policy, estimator, reference or bound of a name.

    Args:
        env: environment id.
        name: one of the environment's own, ``NAME-tuned``, a shipped agent, a file (``.safetensors``, or the
            ``.zip`` of a Stable-Baselines3 model), the folder of a training run, ``module:Class`` of a user's,
            ``isolated:module:Class`` of an estimator in a process of its own, ``exec:COMMAND`` of any program,
            ``gated:NAME`` of a policy: an estimator that returns the estimate of that policy's filter while it is
            trusted, else that of a classical filter, or ``file:PATH`` of another program's estimates. A path always
            means a file or folder, even if something else has its name.
        trust: whether to load a ``.zip``, which can execute code.

    Raises:
        ValueError: if there is no such name, it names no competitor, or it needs ``trust``.
    """
    return find_competitor(import_problem(env), name, trust).maker


def find_competitor(problem: Problem, name: str | Path, trust: bool = False) -> Competitor:
    """Return the competitor of a name for an environment; names and errors as of :func:`competitor`."""
    if isinstance(name, Path):
        found = _find_in_files(problem, str(name.absolute()), trust)
        if found is None:
            raise ValueError(
                f"cannot load policy {str(name)!r}: it is neither a .safetensors, a .zip, nor a folder"
            )
        return found._replace(name=str(name))
    for prefix, place in PREFIXES.items():
        if name.startswith(prefix):
            inner = name.removeprefix(prefix)
            return load(place)(name, inner, problem, lambda other: find_competitor(problem, other, trust))
    own = problem.find(name)
    if own is not None:
        return Competitor(name, own, identity=getattr(own, "content", name) if problem.is_shipped else None)
    found = _find_in_files(problem, name, trust)
    if found is not None:
        return found
    if name.endswith("-tuned"):
        problem.competitor(name)  # refuses it
    module, colon, attribute = name.partition(":")
    if not colon:
        for ending in file_endings():
            # Stable-Baselines3 saves "mine" as mine.zip. Unlike a Path, this takes a name that no file can have.
            if os.path.isfile(f"{name}{ending}"):
                raise ValueError(f"unknown policy {name!r}: write the whole file name, {name}{ending}")
        raise nearest("policy", name, shipped_names(problem))
    with report_running(name):
        holder = import_user_module(module, f"cannot load policy {name!r}")
    if not hasattr(holder, attribute):
        raise ValueError(f"cannot load policy {name!r}: {holder} has no {attribute!r}")
    return Competitor(name, check_competitor(name, getattr(holder, attribute)))


def _sources() -> Iterator[CompetitorFiles]:
    yield from load_present(SOURCES)


def _find_in_files(problem: Problem, name: str, trust: bool) -> Competitor | None:
    """Return the competitor in a file or folder of a name, or the shipped agent of that name; None: neither."""
    found = (source.find(name, problem, trust, partial(_find_shipped, problem)) for source in _sources())
    return next((one for one in found if one is not None), None)


def _find_shipped(problem: Problem, name: str, what: str) -> Competitor:
    known = shipped_names(problem)
    if name not in known:
        raise nearest(what, name, known)
    return find_competitor(problem, name)


def file_endings() -> list[str]:
    """Return the endings of files that contain competitors, such as ``.safetensors``."""
    return [ending for source in _sources() for ending in source.endings]


def learned_names(id: str) -> list[str]:
    """Return the names of the agents that are shipped for the environment of a Gymnasium id."""
    return [name for source in _sources() for name in source.names(id)]


def ranked_names(problem: Problem) -> list[str]:
    """Return the names of an environment's shipped policies and estimators, tuned ones, and agents."""
    known = problem.baselines
    return [*known.policies, *known.estimators, *problem.tuned_policies, *learned_names(problem.id)]


def shipped_names(problem: Problem) -> list[str]:
    """Return the names of all shipped competitors of an environment, references, bounds and agents included."""
    return [*problem.names, *learned_names(problem.id)]


def adopt(candidate: Any) -> Any:
    """Return a user's object as a competitor: wrapped if it is a model of a known library, else unchanged."""
    for source in _sources():
        candidate = source.adopt(candidate)
    return candidate


def find_competitors(
    problem: Problem,
    competitors: str | Path | Sequence[str | Path] | Mapping[str, Any],
    trust: bool = False,
) -> list[Competitor]:
    """Return the competitors of several names or objects; arguments and errors as of :func:`~filtergym.evaluate`."""
    if isinstance(competitors, str | Path):
        competitors = [competitors]
    if not isinstance(competitors, Mapping | Sequence):
        raise ValueError(
            "competitors are a name, a sequence of names, or a mapping from names to policies, got "
            f"{quote_shortened(competitors)}"
        )
    named = competitors if isinstance(competitors, Mapping) else {str(name): name for name in competitors}
    for name, entry in named.items():
        if type(entry) is str and entry == name:
            continue
        if name in shipped_names(problem):
            known = find_competitor(problem, name).maker
            if type(entry) is not type(known) or not bool(entry == known):
                raise ValueError(f"{name!r} is already a name of {problem.id}: choose another one")
    return [
        find_competitor(problem, entry, trust)._replace(name=name)
        if isinstance(entry, str | Path)
        else Competitor(name, adopt(entry))
        for name, entry in named.items()
    ]


def isolate_names(problem: Problem, names: Sequence[str]) -> list[str]:
    """Return competitors' names with ``isolated:`` before each ``module:Class``, to run it in a separate process.

    Raises:
        ValueError: for ``gated:module:Class``, which acts in this process.
    """
    for name in names:
        if name.startswith("gated:") and is_module(problem, name.removeprefix("gated:")):
            raise ValueError(
                f"{name!r} acts in this process, beside the truth: only an estimator can be isolated"
            )
    return [
        f"isolated:{name}" if is_module(problem, name) and not name.startswith((*PREFIXES,)) else name
        for name in names
    ]


def is_module(problem: Problem, name: str) -> bool:
    """Return whether a name has the form ``module:Class`` of a user's competitor."""
    return problem.find(name) is None and MODULE.fullmatch(name) is not None
