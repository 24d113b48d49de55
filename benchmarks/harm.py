"""Costs of agents outside their training distribution: every scenario, and the stresses of ``stresses.py``.

Example: python benchmarks/harm.py filtergym/UavAutopilot-v0 --episodes 500 --policy bptt

Each agent runs alone and behind the gate (``gated:NAME``), and so does the fallback of that gate, on the test split. A
cell is a scenario or a stress. Harm is counted where the whole 95 % interval of the cost against the paper's algorithm,
geometric mean of the episodes' ratios, lies above +2 %. A track counts as lost where the cost of an episode is ten
times that of the paper, and above the 99 % quantile of the paper's episodes in that cell. ``--cells`` prints every
cell.
"""

import argparse
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy
from stresses import STRESSES

from filtergym.agents.gate import GatedMaker, is_gateable
from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import Problem, problem_of
from filtergym.evaluation.running.metrics import mean_cost
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.names import find_competitor
from filtergym.reports.tables.ranking import HARM

LOST = 10.0
"""Smallest ratio of the cost to the paper's of a lost track."""
CONSISTENT = (0.5, 2.0)
"""Limits of the ANEES of a consistent filter."""


class Cell(NamedTuple):
    """Result of a competitor in a scenario or under a stress: cost ratio, ANEES and lost tracks."""

    name: str
    """Name of the scenario or stress."""
    ratio: tuple[float, float, float]
    """Ratio of the cost to the paper's, and its 95 % interval."""
    anees: float
    lost: int
    """Number of lost tracks."""

    @property
    def harms(self) -> bool:
        """Whether the ratio is significantly above :data:`HARM`."""
        return self.ratio[1] > HARM

    @property
    def text(self) -> str:
        """Cost against the paper's with its interval, per cent, as text."""
        return "{:+.1f} [{:+.1f}, {:+.1f}]".format(*(100.0 * x for x in self.ratio))


def cells_of(problem: Problem) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for scenario in problem.task.scenarios:
        yield scenario, scenario, {}
    if problem.id in STRESSES:
        known = STRESSES[problem.id]
        for name, keywords in known.each.items():
            yield f"+{name}", known.scenario, {**known.usual, **keywords}


def evaluate_cell(
    problem: Problem,
    makers: dict[str, Any],
    episodes: int,
    split: str,
    cell: tuple[str, str, dict[str, Any]],
) -> dict[str, Cell]:
    """Evaluate competitors in a scenario or under a stress; return the result of each by name."""
    name, scenario, keywords = cell
    run = problem.evaluate(makers, scenario, episodes, split=split, **keywords)
    paper, bootstrap = mean_cost(run, problem.baselines.compared_paper), Bootstrap(run.sizes["episode"])
    beyond, found = numpy.quantile(paper, 0.99), {}
    for policy in makers:
        cost = mean_cost(run, policy)
        ratio = bootstrap.geometric_difference(cost, paper)
        lost = int(((cost > LOST * paper) & (cost > beyond)).sum())
        anees = float(run["nees"].sel(policy=policy).mean()) / run.sizes["component"]
        low, middle, high = float(ratio[1]), float(ratio[0]), float(ratio[2])
        found[policy] = Cell(name, (middle, low, high), anees, lost)
    return found


def competitors_of(problem: Problem, policies: list[str]) -> dict[str, Any]:
    fallback = problem.baselines.fallback or problem.paper
    first = dict.fromkeys([problem.baselines.compared_paper, fallback])
    makers = {name: problem.competitor(name) for name in first}
    for policy in policies:
        makers[policy] = found = find_competitor(problem, policy).maker
        if is_gateable(found) and not policy.startswith("gated:"):
            makers[f"gated:{policy}"] = GatedMaker(problem, policy, found)
    return makers


def summary(problem: Problem, policy: str, cells: list[Cell]) -> str:
    worst = max(cells, key=lambda cell: cell.ratio[0])
    anees = [cell.anees for cell in cells]
    outside = sum(not CONSISTENT[0] <= value <= CONSISTENT[1] for value in anees)
    return (
        f"| {problem.short_name.removesuffix('-v0')} | `{policy}` | {sum(c.harms for c in cells)} of {len(cells)} | "
        f"`{worst.name}` | {worst.text} | {min(anees):.2g} to {max(anees):.2g} | {outside} | "
        f"{sum(c.lost for c in cells)} |"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environment", nargs="+")
    parser.add_argument("--policy", action="append", help="default: all shipped agents")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--split", default="test")
    parser.add_argument("--cells", action="store_true", help="print every cell, too")
    args = parser.parse_args()
    table = [
        "| environment | competitor | cells harmed | worst cell | cost against the paper's there, % | ANEES | "
        "outside 0.5 to 2 | tracks lost |\n" + "|---" * 8 + "|"
    ]
    for id in args.environment:
        problem = problem_of(id)
        makers = competitors_of(problem, args.policy or pretrained_agents(problem.id))
        found: dict[str, list[Cell]] = {name: [] for name in makers}
        for cell in cells_of(problem):
            for name, own in evaluate_cell(problem, makers, args.episodes, args.split, cell).items():
                found[name].append(own)
                if args.cells:
                    print(
                        f"{problem.short_name} {own.name} {name} {own.text} ANEES {own.anees:.2f}", flush=True
                    )
        del found[problem.baselines.compared_paper]
        table += [summary(problem, name, cells) for name, cells in found.items()]
        print("\n".join(table), flush=True)
        table = []
