"""Tuning of classical competitors on training episodes, so that nothing learned is compared with a straw man.

The search is SciPy's differential evolution over the limits that a policy declares, started from its untuned
values; every candidate meets the same episodes of the training split, so differences are not noise. The
best candidate is kept by its cost on the validation split only if it beats the untuned values there.
"""

import json
import math
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy

from ..envs.backend import task_on
from ..envs.catalogue import find_scenario, importable_name, make_task, nearest, short_name, task_class
from ..envs.task import Episode, Task
from ..evaluation.competitors import Kind
from ..evaluation.files import write_text
from ..evaluation.parallel import Workers, check_workers
from ..evaluation.rollout import Progress, rollout
from ..evaluation.seeds import episode_seeds
from ..evaluation.store import Store, Work
from ..evaluation.stored import fits, read_json
from .catalogue import baselines_of, package_of
from .table import Tunable

FOLDER = Path("tuned")
"""Where tuned values of one's own are kept, below the working directory."""
FEWEST = 16
"""Episodes that a process is given at once: of fewer the work is less than what sending it takes."""


@dataclass(frozen=True)
class Tuned:
    """Outcome of a search."""

    environment: str
    policy: str
    scenario: str
    values: dict[str, float]
    cost: float
    """Mean cost on the validation split."""
    untuned_cost: float
    environment_steps: int
    seed: int


def _cost(task: Task, episode: Episode) -> numpy.ndarray:
    return task.cost(episode)


class _Candidate(NamedTuple):
    """Values of a policy or an estimator over some episodes."""

    environment: str
    scenario: Any
    tunable: Tunable
    values: Mapping[str, float]
    seeds: Sequence[int]
    backend: str


def _costs(candidate: _Candidate, tick: Progress) -> numpy.ndarray:
    """Cost of every measurement of every episode, ``(time, episodes)``."""
    keywords, make = candidate.tunable.apply(candidate.values)
    task = task_on(
        candidate.backend, candidate.environment, candidate.tunable.control, candidate.scenario, **keywords
    )
    # Made already, so that no program is compiled for a candidate that is tried once.
    run = rollout(task, make(task), candidate.seeds, _cost)
    return numpy.stack([numpy.asarray(cost[: len(candidate.seeds)]) for cost, _ in run])


def mean_cost(
    id: str,
    scenario: Any,
    tunable: Tunable,
    values: Mapping[str, float],
    seeds: Sequence[int],
    backend: str = "auto",
    workers: Workers | None = None,
) -> float:
    """Mean uncapped cost of a candidate over some episodes, which the workers share."""
    workers = check_workers(workers)
    share = max(FEWEST, -(-len(seeds) // workers.width))
    name = importable_name(task_class(id))
    pieces = [
        _Candidate(name, scenario, tunable, values, seeds[i : i + share], backend)
        for i in range(0, len(seeds), share)
    ]
    costs = numpy.concatenate(workers.results(_costs, pieces), axis=1)
    total = 0.0
    for cost in costs:  # added up as if one process had run all episodes side by side
        total += float(cost.sum())
    return total / costs.size


def tune(
    id: str,
    policy: str,
    tunable: Tunable,
    budget: int,
    scenario: str | None = None,
    seed: int = 0,
    episodes: int = 256,
    progress: Callable[[int], None] = lambda steps: None,
    backend: str = "auto",
    workers: Workers | None = None,
    store: Store | None = None,
) -> Tuned:
    """Search a policy's values.

    Args:
        id: environment id.
        policy: name of the policy, for the record.
        tunable: its limits and what values mean.
        budget: environment steps (decisions, as in training) to spend on candidates.
        scenario: a training scenario; default: the environment's own.
        seed: of the training episodes and of the search.
        episodes: training episodes that every candidate meets.
        progress: told of environment steps done.
        backend: what computes the steps, see :func:`~.envs.backend.task_on`.
        workers: who shares the episodes of a candidate; candidates follow each other, since the search learns from
            each. Default: this process.
        store: keeps the costs of candidates until the search has ended, from which a second call goes on: begun again,
            a search asks for the same candidates. Nothing is kept of an environment of one's own, whose code may have
            changed meanwhile. Default: nothing is kept.

    Raises:
        ValueError: for a held-out scenario, a budget too small for one generation, or a file that cannot be written.
    """
    from scipy.optimize import differential_evolution

    cls = task_class(id)
    chosen = find_scenario(cls, scenario)
    if not chosen.training:
        allowed = [s.name for s in cls.scenarios.values() if s.training]
        raise ValueError(
            f"scenario {chosen.name!r} is held out: tune on a training scenario ({', '.join(allowed)})"
        )
    task = make_task(cls.id, tunable.control, chosen.name)
    steps = episodes * (task.horizon // task.decision_interval)
    names, limits = list(tunable.limits), list(tunable.limits.values())
    evaluations = budget // steps
    population = 4 * len(names) + 4
    if evaluations < 2 * population:
        raise ValueError(
            f"a budget of {budget} steps is {evaluations} candidates of {episodes} episodes; "
            f"the search needs at least {2 * population}: give {2 * population * steps} steps"
        )
    train = episode_seeds("train", seed, episodes)
    best: tuple[float, dict[str, float]] = (math.inf, dict(tunable.start))
    spent = 0
    limited = {name: list(limit) for name, limit in tunable.limits.items()}
    store = store or Store()
    search = [chosen.name, limited, dict(tunable.start), seed, episodes, backend]

    def work_of(values: Mapping[str, float]) -> Work | None:
        """Return the piece of work that the cost of a candidate is."""
        if package_of(cls.id) is None:
            return None
        return Work(f"{short_name(cls.id)}.{policy}", json.dumps([*search, values]))

    def objective(vector: numpy.ndarray) -> float:
        nonlocal best, spent
        if spent >= evaluations:
            return math.inf
        values = dict(zip(names, map(float, vector), strict=True))
        cost = store.result(
            work_of(values),
            float,
            lambda: mean_cost(cls.id, chosen.name, tunable, values, train, backend, workers),
        )
        spent += 1
        progress(steps)
        best = min(best, (cost, values), key=lambda pair: pair[0])
        return cost

    generator = numpy.random.default_rng(seed)
    low, high = numpy.array(limits).T
    members = low + (high - low) * generator.random((population, len(names)))
    members[0] = [tunable.start[name] for name in names]
    differential_evolution(
        objective,
        limits,
        init=members,
        maxiter=evaluations // population + 1,
        rng=generator,
        polish=False,
        tol=0.0,
        callback=lambda *_: spent >= evaluations,
    )
    # A winner among many candidates on the training episodes is flattered by them: ask fresh episodes.
    fresh = episode_seeds("validation", seed, 4 * episodes)
    untuned = mean_cost(cls.id, chosen.name, tunable, tunable.start, fresh, backend, workers)
    cost, values = mean_cost(cls.id, chosen.name, tunable, best[1], fresh, backend, workers), best[1]
    if untuned <= cost:
        cost, values = untuned, dict(tunable.start)
    kept = {name: rounded(value) for name, value in values.items()}
    store.clear()
    return Tuned(cls.id, policy, chosen.name, kept, cost, untuned, spent * steps, seed)


def stored_values(id: str, policy: str) -> tuple[dict[str, float], str]:
    """Return tuned values and where they stand: one's own in ``tuned/``, or those that are shipped.

    Raises:
        ValueError: if the policy was never tuned, or the file that should say so is broken.
    """
    for place, table in _tables(id):
        if policy in table:
            return _checked_values(table[policy].get("values"), policy, id, place), str(place)
    raise ValueError(f"no tuned values of policy {policy!r}: run filtergym tune {id} --policy {policy}")


def read_table(place: Any) -> dict[str, dict[str, Any]]:
    """Return what a file says of tuned policies; nothing if there is none.

    Raises:
        ValueError: if it is not such a file.
    """
    try:
        table = read_json(place)
    except FileNotFoundError:
        return {}
    if not fits(table, dict[str, dict[str, Any]]):
        raise ValueError(f"{place} is not a table of tuned policies: correct or remove it")
    return table


def _checked_values(values: Any, policy: str, id: str, place: Any) -> dict[str, float]:
    """Raise ValueError if values are not those of a policy, within the limits of the search."""
    limits = baselines_of(id).tunable[policy].limits
    if not fits(values, dict[str, float]) or values.keys() != limits.keys():
        raise ValueError(
            f"{place} must give policy {policy!r} a number for each of {', '.join(limits)}, got "
            f"{reprlib.repr(values)}: tune it again, or remove the file"
        )
    for name, (low, high) in limits.items():
        # Values are stored rounded, so that one at a limit can lie just beyond it.
        if not min(low, rounded(low)) <= values[name] <= max(high, rounded(high)):
            raise ValueError(
                f"{place}: {name} of policy {policy!r} must be from {low:g} to {high:g}, got {values[name]!r}"
            )
    return values


def rounded(value: float) -> float:
    """Six digits, as tuned values are stored."""
    return float(f"{value:.6g}")


def tuned_names(id: str) -> list[str]:
    """Return ``NAME-tuned`` of every tunable policy that has stored values."""
    tables = [table for _, table in _tables(id)]
    return [
        f"{policy}-tuned" for policy in baselines_of(id).tunable if any(policy in table for table in tables)
    ]


def best_tuned_policy(id: str, control: str | None = None) -> str | None:
    """Return ``NAME-tuned`` of the policy that cost least on the validation split; None if none was tuned.

    Args:
        id: environment id.
        control: only policies of this control; estimators have none and are left out anyway.
    """
    entries: dict[str, dict[str, Any]] = {}
    for _, table in reversed(list(_tables(id))):  # one's own go before those that are shipped
        entries |= table
    found = {
        f"{policy}-tuned": entries[policy].get("validation_cost", math.inf)
        for policy, tunable in baselines_of(id).tunable.items()
        if policy in entries and tunable.control is not None and control in (None, tunable.control)
    }
    return min(found, key=lambda name: found[name], default=None)


def _tables(id: str) -> Iterator[tuple[Any, dict[str, dict[str, Any]]]]:
    """Files of tuned values and what they say, one's own first."""
    for place in _places(id):
        yield place, read_table(place)


def _places(id: str) -> list[Any]:
    """Files of tuned values, one's own first."""
    package = package_of(id)
    return [table_path(id), *([] if package is None else [files(package) / "tuned.json"])]


class TunedPolicy(NamedTuple):
    """A policy or estimator with tuned values, some of which belong to the task."""

    task_keywords: dict[str, Any]
    control: str | None
    make: Callable[[Task], Any]

    @property
    def kind(self) -> Kind:
        """What it makes."""
        return "policy" if self.control else "estimator"

    def __call__(self, task: Task) -> Any:
        """Make the policy or estimator for a task."""
        return self.make(task)


def tuned_policy(id: str, policy: str) -> TunedPolicy:
    """Return what makes a policy with its stored values for a task.

    Raises:
        ValueError: if it cannot be tuned, or never was.
    """
    tunables = baselines_of(id).tunable
    if policy not in tunables:
        raise nearest("tunable policy", policy, tunables)
    tunable = tunables[policy]
    keywords, make = tunable.apply(stored_values(id, policy)[0])
    return TunedPolicy(keywords, tunable.control, make)


def save_tuned(outcome: Tuned, command: str, folder: Path = FOLDER) -> Path:
    """Put tuned values into the environment's file in a folder, which is returned.

    Args:
        outcome: of a search.
        command: that made it.
        folder: of such files.
    """
    path = table_path(outcome.environment, folder)
    existing = path.read_text(encoding="utf-8") if path.exists() else None
    write_text(path, merged_table(existing, outcome, command))
    return path


def merged_table(existing: str | None, outcome: Tuned, command: str) -> str:
    """JSON text of a table of tuned values with one policy's replaced."""
    table: dict[str, Any] = json.loads(existing) if existing else {}
    table[outcome.policy] = {
        "values": outcome.values,
        "scenario": outcome.scenario,
        "validation_cost": outcome.cost,
        "untuned_validation_cost": outcome.untuned_cost,
        "environment_steps": outcome.environment_steps,
        "seed": outcome.seed,
        "command": command,
    }
    return json.dumps(table, indent=1, sort_keys=True) + "\n"


def table_path(id: str, folder: Path = FOLDER) -> Path:
    """File of an environment's tuned values in a folder."""
    return folder / f"{short_name(id)}.json"
