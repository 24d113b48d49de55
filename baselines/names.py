"""Names of an environment's own competitors, and evaluation by them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import xarray

from ..envs.catalogue import importable_name, nearest, task_class
from ..evaluation import evaluate as evaluation
from .catalogue import baselines_of
from .tuning import tuned_names, tuned_policy


def own_names(id: str) -> list[str]:
    """Names of an environment's policies, references and bounds, and of policies that were tuned."""
    return [*baselines_of(id).names, *tuned_names(id)]


def own_competitor(id: str, name: str) -> Any:
    """Return what makes one of an environment's own policies or estimators, tuned or not, references or bounds for a
    task.

    Raises:
        ValueError: if there is no such name.
    """
    known = baselines_of(id)
    for table in (known.policies, known.estimators, known.references, known.bounds):
        if name in table:
            return table[name]
    if name.endswith("-tuned"):
        return tuned_policy(id, name.removesuffix("-tuned"))
    raise nearest("policy", name, own_names(id))


def experiment_on(id: str, *arguments: Any, **fields: Any) -> evaluation.Experiment:
    """Return an experiment on an environment, with the paper's algorithm and the reference of its baselines.

    Args:
        id: environment id.
        *arguments: what follows in :class:`.evaluation.evaluate.Experiment`.
        **fields: likewise.

    Raises:
        ValueError: for an unknown environment.
    """
    cls = task_class(id)
    known = baselines_of(cls.id)
    experiment = evaluation.Experiment(importable_name(cls), *arguments, **fields)
    return replace(experiment, paper=known.score_paper, reference=known.score_reference)


def evaluate(
    id: str, competitors: str | Sequence[str] | Mapping[str, Any], *arguments: Any, **keywords: Any
) -> xarray.Dataset:
    """Run competitors over the same episodes, the environment's own by their names.

    Args:
        id: environment id.
        competitors: a name, or names; or by name what :func:`.evaluation.evaluate.evaluate` takes, or a name.
        *arguments: of that function.
        **keywords: likewise.

    Raises:
        ValueError: for an unknown name, and whatever that function refuses.
    """
    if isinstance(competitors, str):
        competitors = [competitors]
    named = competitors if isinstance(competitors, Mapping) else {name: name for name in competitors}
    objects = {
        name: own_competitor(id, entry) if isinstance(entry, str) else entry for name, entry in named.items()
    }
    known = baselines_of(id)
    return evaluation.evaluate(
        id, objects, *arguments, paper=known.score_paper, reference=known.score_reference, **keywords
    )
