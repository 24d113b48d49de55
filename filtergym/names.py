"""Every name that a user gives, and what it stands for: the one place where names become objects."""

from collections.abc import Mapping, Sequence
from typing import Any

import xarray

from .agents.named_policies import learned_policy, shipped_agents
from .baselines import names as baselines
from .baselines.catalogue import baselines_of
from .envs.catalogue import imported, nearest, task_class
from .evaluation import metrics
from .evaluation.competitors import check_competitor
from .evaluation.metrics import Record
from .evaluation.rollout import Progress


def competitor(env: str, name: str, *, trust: bool = False) -> Any:
    """Return what makes a policy, estimator, reference or bound for a task.

    Args:
        env: environment id.
        name: one of the environment's own, ``NAME-tuned``, a shipped agent, a file (``.safetensors``, or the
            ``.zip`` of a Stable-Baselines3 model), or ``module:Class`` of a user's.
        trust: load a ``.zip``, which can execute code.

    Raises:
        ValueError: if there is no such name, what it names is no competitor, or it takes ``trust``.
    """
    id = task_class(env).id
    if name in baselines_of(id).names or name.endswith("-tuned"):
        return baselines.own_competitor(id, name)
    learned = learned_policy(id, name, trust)
    if learned is not None:
        return learned
    module, colon, attribute = name.partition(":")
    if not colon:
        raise nearest("policy", name, [*baselines.own_names(id), *shipped_agents(id)])
    holder = imported(module, f"cannot load policy {name!r}")
    if not hasattr(holder, attribute):
        raise ValueError(f"cannot load policy {name!r}: {holder} has no {attribute!r}")
    return check_competitor(name, getattr(holder, attribute))


def evaluate(
    env: str,
    competitors: Sequence[str] | Mapping[str, Any],
    scenario: Any = None,
    episodes: int = 500,
    seed: int = 0,
    split: str = "test",
    control: str | None = None,
    progress: Progress | None = None,
    *,
    trust: bool = False,
    **keywords: Any,
) -> xarray.Dataset:
    """Run policies, estimators, references and bounds over the same episodes.

    Args:
        env: environment id, such as ``"filtergym/ManeuveringTarget-v0"``.
        competitors: names, or a mapping from a name to a name, a class, or an object: with a method ``predict``
            (:class:`~filtergym.evaluation.competitors.Policy`), or with ``start`` and ``update``
            (:class:`~filtergym.evaluation.competitors.Estimator`); see :func:`competitor` for what a name can be.
        scenario: name of a scenario or a trajectory; default: the environment's training distribution.
        episodes: Monte Carlo runs M.
        seed: number of the experiment.
        split: "test" (default), "validation" or "train"; splits share no episode.
        control: demand this control; by default every policy runs in its own.
        progress: called with the number of measurements done, now and then.
        trust: load models' zips, which can execute code.
        **keywords: parameters of the task.

    Returns:
        Errors, costs and records over the dimensions policy, episode and time; see
        :func:`.evaluation.evaluate.evaluate`.

    Raises:
        ValueError: for unknown names, a name of one's own that is taken, a policy that does not fit the control, or
            an estimator that does not answer with mean and covariance.
    """
    named = competitors if isinstance(competitors, Mapping) else {name: name for name in competitors}
    id = task_class(env).id
    for name in {*baselines.own_names(id), *shipped_agents(id)} & named.keys():
        if named[name] not in (name, competitor(id, name)):
            raise ValueError(f"{name!r} is the name of what {id} has already: call your own something else")
    objects = {
        name: competitor(env, entry, trust=trust) if isinstance(entry, str) else entry
        for name, entry in named.items()
    }
    return baselines.evaluate(env, objects, scenario, episodes, seed, split, control, progress, **keywords)


def tidy_records(dataset: xarray.Dataset) -> list[Record]:
    """Every metric of every policy with its interval, the environment's own among them.

    See :func:`.evaluation.metrics.tidy_records`.
    """
    return metrics.tidy_records(dataset, baselines_of(dataset.attrs["environment"]).metrics)
