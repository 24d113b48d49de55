"""Test that references are limits: no competitor may have significantly lower cost, in any scenario.

``python benchmarks/limits.py [ENVIRONMENT ...]`` runs all ranked competitors, each under its own control, and the
reference over the same episodes, a block at a time, and prints for each scenario the competitor of least cost, and the
mean paired difference of its cost to the reference's, in standard errors over the episodes. It exits with status 1
where a competitor's is below -``SIGNIFICANT``.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy
import xarray

from filtergym.baselines.problem import Problem, problem_of
from filtergym.envs.engine.catalogue import bare_name, catalogue
from filtergym.evaluation.competitors.kinds import RandomPolicy
from filtergym.evaluation.running.metrics import mean_over_time
from filtergym.evaluation.running.summary import reduce_episodes
from filtergym.evaluation.statistics.statistic import ALL, Statistic
from filtergym.functions import requests_of
from filtergym.names import find_competitors, ranked_names
from filtergym.papers.grid import markdown_table
from filtergym.reports.tables.benchmark import affordable_episodes

SIGNIFICANT = 3.0
"""Standard errors; of a few hundred comparisons, one in a thousand lies beyond by chance."""


class Nearest(NamedTuple):
    """The competitor of least cost in a scenario, compared with the reference."""

    environment: str
    scenario: str
    reference: str
    episodes: int
    name: str
    """Name of the competitor of least cost."""
    relative: float
    """Ratio of its cost to the reference's, less one."""
    errors: float
    """Difference of its cost to the reference's, in standard errors."""
    below: list[str]
    """Names of the competitors of significantly lower cost than the reference."""

    @property
    def verdict(self) -> str:
        """Whether the reference is a limit in this scenario, or which competitors beat it, as text."""
        return f"beaten by {', '.join(self.below)}" if self.below else "a limit"


def names_without_random(problem: Problem) -> list[str]:
    policies = problem.baselines.policies
    return [name for name in ranked_names(problem) if policies.get(name) is not RandomPolicy]


def episode_costs(
    problem: Problem, scenario: str, names: Sequence[str], episodes: int, seed: int
) -> dict[str, numpy.ndarray]:
    def declare(run: xarray.Dataset) -> Iterator[Statistic]:
        yield Statistic(("cost",), mean_over_time(run, run["cost"].values), sample=ALL)

    experiment = problem.experiment(scenario, episodes, seed)
    requests = requests_of(problem, experiment, find_competitors(problem, names))
    return {
        one.name: reduce_episodes(one, declare, lambda done: None).reduction.results()["cost",]
        for one in requests
    }


def nearest(
    problem: Problem, scenario: str, episodes: int, seed: int = 1, names: Sequence[str] = ()
) -> Nearest:
    """Return the competitor of least cost in a scenario, compared with the reference."""
    reference = problem.baselines.score_reference
    costs = episode_costs(
        problem, scenario, [*(names or names_without_random(problem)), reference], episodes, seed
    )
    limit = costs.pop(reference)
    differences = {name: own - limit for name, own in costs.items()}
    errors = {
        # Where every episode equals the reference's, the standard error is zero.
        name: float(d.mean() / max(d.std(ddof=1) / numpy.sqrt(episodes), 1e-12 * limit.mean()))
        for name, d in differences.items()
    }
    name = min(costs, key=lambda each: costs[each].mean())
    below = [name for name, value in errors.items() if value < -SIGNIFICANT]
    relative = float(costs[name].mean() / limit.mean()) - 1.0
    return Nearest(problem.id, scenario, reference, episodes, name, relative, errors[name], below)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("environment", nargs="*", help="default: all")
    parser.add_argument(
        "--episodes", type=int, default=2000, help="of each competitor; fewer where a measurement takes long"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--policy", action="append", help="default: all ranked competitors")
    args = parser.parse_args()
    found = []
    for id in args.environment or catalogue():
        problem = problem_of(id)
        for scenario in problem.task.scenarios:
            episodes = affordable_episodes(problem, scenario, args.episodes)
            found.append(nearest(problem, scenario, episodes, args.seed, args.policy or ()))
            print(f"{id} {scenario}: {found[-1].verdict}", file=sys.stderr, flush=True)
    header = [
        "environment",
        "scenario",
        "episodes",
        "reference",
        "nearest",
        "its cost, %",
        "standard errors",
        "verdict",
    ]
    rows = [
        [
            bare_name(each.environment),
            each.scenario,
            str(each.episodes),
            f"`{each.reference}`",
            f"`{each.name}`",
            f"{100.0 * each.relative:+.1f}",
            f"{each.errors:+.1f}",
            each.verdict,
        ]
        for each in found
    ]
    print("\n".join(markdown_table(header, rows)))
    sys.exit(int(any(each.below for each in found)))


if __name__ == "__main__":
    main()
