"""Tuning of classical competitors on training episodes.

The search is SciPy's differential evolution over the limits that a policy declares, started from its untuned
values; every candidate runs on the same episodes of the training split, so differences are not noise. Costs are
geometric means over the episodes, so that a lost track does not dominate. With :attr:`.Tunable.likelihood`, the cost of
an episode is divided by the density of the truth: with mean cost c and mean log-density l of n components

    log c - l / n                                                                                                  (1)

is smallest, averaged over episodes, for an accurate estimate with a consistent covariance. The best candidate replaces
the untuned values only if it beats them significantly on episodes of the validation split.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy

from ..envs.contract.model import Episode, Model
from ..envs.contract.task import Scenario
from ..envs.engine.backend import make_model
from ..envs.engine.catalogue import nearest, short_name
from ..envs.engine.reward import log_likelihood_reward
from ..envs.engine.scenario_choice import find_scenario, make_task
from ..evaluation.competitors.kinds import kind_of
from ..evaluation.running.parallel import Workers, check_workers
from ..evaluation.running.rollout import Progress, run_competitor
from ..evaluation.running.seeds import episode_seeds
from ..evaluation.statistics.bootstrap import Bootstrap
from ..evaluation.storage.store import Store, Work
from .problem import Problem
from .table import Tunable
from .tuned_values import Tuned, round_value

FEWEST = 16
"""Smallest number of episodes of a chunk for another process: fewer cost less than their transfer."""


def _report_cost(model: Model, episode: Episode) -> dict[str, numpy.ndarray]:
    return {"cost": model.cost(episode)}


def _report_cost_and_likelihood(model: Model, episode: Episode) -> dict[str, numpy.ndarray]:
    return {**_report_cost(model, episode), "density": log_likelihood_reward(model, episode)}


class Candidate(NamedTuple):
    """A policy or an estimator with candidate values, and the episodes that it runs."""

    problem: Problem
    scenario: Any
    tunable: Tunable
    values: Mapping[str, float]
    seeds: Sequence[int]
    backend: str = "auto"


def _run_candidate(candidate: Candidate, tick: Progress) -> numpy.ndarray:
    """Return the cost of every episode for the search, ``(episodes,)``: its mean cost, or (1) with
    likelihood.
    """
    keywords, make = candidate.tunable.apply(candidate.values)
    cls, control = candidate.problem.task, candidate.tunable.control
    model = make_model(cls, control, candidate.scenario, backend=candidate.backend, **keywords)
    # An instance, not a maker: no filter is compiled for a candidate that runs once.
    competitor = make(model if control else model.task)
    report = _report_cost_and_likelihood if candidate.tunable.likelihood else _report_cost
    found = run_competitor(model, competitor, kind_of(competitor), candidate.seeds, report)
    means = {name: numpy.ascontiguousarray(values.T).mean(axis=0) for name, values in found.items()}
    density = means.get("density", 0.0)
    weighed: numpy.ndarray = means["cost"] * numpy.exp(-density / len(model.task.components))
    return weighed


def episode_costs(candidate: Candidate, workers: Workers | None = None) -> numpy.ndarray:
    """Return the cost of a candidate in each of its episodes, ``(episodes,)``, computed by the workers."""
    workers, seeds = check_workers(workers), candidate.seeds
    share = max(FEWEST, -(-len(seeds) // workers.width))
    pieces = [candidate._replace(seeds=seeds[i : i + share]) for i in range(0, len(seeds), share)]
    found: numpy.ndarray = numpy.concatenate(workers.results(_run_candidate, pieces))
    return found


def geometric_cost(costs: numpy.ndarray) -> float:
    """Return the geometric mean of episodes' costs."""
    return float(numpy.exp(numpy.log(costs).mean()))


def is_better(costs: numpy.ndarray, others: numpy.ndarray) -> bool:
    """Return whether costs are significantly lower than others, by the geometric mean of their ratios by
    episode.
    """
    return Bootstrap(len(costs)).estimate(numpy.log(costs / others)).high < 0.0


@dataclass(frozen=True)
class Search:
    """Options of a search for the values of a policy."""

    budget: int
    """Environment steps (decisions, as in training) to spend on candidates."""
    scenario: str | None = None
    """A training scenario; None: the environment's own."""
    seed: int = 0
    """Seed of the training episodes and of the search."""
    episodes: int = 256
    """Number of training episodes of every candidate."""
    confirming: int = 2048
    """Number of validation episodes on which the best candidate has to beat the untuned values."""
    backend: str = "auto"
    """Backend of the steps, see :func:`.engine.backend.make_model`."""


class _Generations:
    """Candidates of a search, evaluated within the budget, and the best of them so far."""

    def __init__(
        self, tunable: Tunable, allowed: int, measure: Callable[[Mapping[str, float]], float]
    ) -> None:
        self.tunable, self.allowed, self.measure = tunable, allowed, measure
        self.spent = 0
        self.best: tuple[float, dict[str, float]] = (math.inf, dict(tunable.start))

    def cost(self, vector: numpy.ndarray) -> float:
        """Return the cost of a vector of candidate values, and remember the best; infinite when the budget is
        spent.
        """
        if self.spent >= self.allowed:
            return math.inf
        values = dict(zip(self.tunable.limits, map(float, vector), strict=True))
        cost = self.measure(values)
        self.spent += 1
        self.best = min(self.best, (cost, values), key=lambda pair: pair[0])
        return cost

    def run(self, population: int, generator: numpy.random.Generator) -> dict[str, float]:
        """Run differential evolution from a population until the budget is spent; return the best values."""
        from scipy.optimize import differential_evolution

        limits = list(self.tunable.limits.values())
        low, high = numpy.array(limits).T
        members = low + (high - low) * generator.random((population, len(limits)))
        members[0] = [self.tunable.start[name] for name in self.tunable.limits]
        differential_evolution(
            self.cost,
            limits,
            init=members,
            maxiter=self.allowed // population + 1,
            rng=generator,
            polish=False,
            tol=0.0,
            callback=lambda *_: self.spent >= self.allowed,
        )
        return self.best[1]


def _training_scenario(problem: Problem, name: str | None) -> Scenario:
    """Return the scenario of this name, the default one for None; raise ValueError for a held-out one."""
    chosen = find_scenario(problem.task, name)
    if not chosen.training:
        allowed = [s.name for s in problem.task.scenarios.values() if s.training]
        raise ValueError(
            f"scenario {chosen.name!r} is held out: tune on a training scenario ({', '.join(allowed)})"
        )
    return chosen


def tune(
    problem: Problem,
    policy: str,
    search: Search,
    progress: Callable[[int], None] = lambda steps: None,
    workers: Workers | None = None,
    store: Store | None = None,
) -> Tuned:
    """Search the values of a policy or estimator on training episodes; return the best ones.

    Args:
        problem: problem of the policy.
        policy: name of a tunable policy or estimator.
        search: options of the search.
        progress: function called with the number of environment steps done.
        workers: processes for the episodes of a candidate; candidates run one after another.
        store: storage of candidates' costs, with which a second call continues an interrupted search; not
            used for a user's environment.

    Raises:
        ValueError: for a policy that cannot be tuned, a held-out scenario, a budget too small for one generation, or a
            file that cannot be written.
    """
    if policy not in problem.baselines.tunable:
        raise nearest("tunable policy", policy, problem.baselines.tunable)
    tunable = problem.baselines.tunable[policy]
    chosen = _training_scenario(problem, search.scenario)
    task = make_task(problem.task, chosen.name)
    steps = search.episodes * (task.horizon // task.decision_interval)
    evaluations = search.budget // steps
    population = 4 * len(tunable.limits) + 4
    if evaluations < 2 * population:
        raise ValueError(
            f"a budget of {search.budget} steps is {evaluations} candidates of {search.episodes} episodes; "
            f"the search needs at least {2 * population}: give {2 * population * steps} steps"
        )
    store = store or Store()
    content = _search_content(problem, search, tunable, chosen)

    def candidate(values: Mapping[str, float], seeds: Sequence[int]) -> Candidate:
        return Candidate(problem, chosen.name, tunable, values, seeds, search.backend)

    train = episode_seeds("train", search.seed, search.episodes)

    def measure(values: Mapping[str, float]) -> float:
        name = f"{short_name(problem.id)}.{policy}"
        work = Work(name, json.dumps([*content, values])) if problem.shipped else None
        cost = store.result(
            work, float, lambda: geometric_cost(episode_costs(candidate(values, train), workers))
        )
        progress(steps)
        return cost

    generations = _Generations(tunable, evaluations, measure)
    values = generations.run(population, numpy.random.default_rng(search.seed))
    # The cost of the best of many candidates is optimistic on the training episodes: evaluate it on fresh ones.
    fresh = episode_seeds("validation", search.seed, search.confirming)
    before = episode_costs(candidate(tunable.start, fresh), workers)
    after = episode_costs(candidate(values, fresh), workers)
    if not is_better(after, before):
        after, values = before, dict(tunable.start)
    cost, untuned = geometric_cost(after), geometric_cost(before)
    kept = {name: round_value(value) for name, value in values.items()}
    store.clear()
    return Tuned(problem.id, policy, chosen.name, kept, cost, untuned, generations.spent * steps, search.seed)


def _search_content(problem: Problem, search: Search, tunable: Tunable, scenario: Scenario) -> list[Any]:
    """Return all that determines a candidate's cost beside values and code, as the key of stored costs."""
    limited = {name: list(limit) for name, limit in tunable.limits.items()}
    how = [search.seed, search.episodes, search.backend, tunable.likelihood]
    return [problem.id, scenario.name, limited, dict(tunable.start), *how]
