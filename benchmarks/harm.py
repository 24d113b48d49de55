"""What shipped agents may cost: the worst scenario of each, and the tracks that it loses and the paper keeps.

Example: python benchmarks/harm.py filtergym/UavAutopilot-v0 --episodes 2000 --policy bptt --policy gated:bptt

A track counts as lost where an episode costs ten times what it costs the paper's algorithm, and more than all but one
in a hundred of the paper's episodes in that scenario.
"""

import argparse

import numpy
from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import Problem, problem_of
from filtergym.evaluation.bootstrap import Bootstrap

import filtergym

LOST = 10.0
"""Cost over the paper's from which on a track is lost."""


def costs(id: str, names: list[str], scenario: str, episodes: int, split: str) -> numpy.ndarray:
    """Mean cost of every episode, ``(policies, episodes)``."""
    data = filtergym.evaluate(id, names, scenario, episodes, split=split)
    return data["cost"].mean("time").values


def rows(problem: Problem, agents: list[str], episodes: int, split: str) -> list[str]:
    """A row for each agent."""
    worst: dict[str, tuple[list[float], str]] = {}
    lost, flown = dict.fromkeys(agents, 0), 0
    scenarios = problem.task.scenarios
    for scenario in scenarios:
        paper, *others = costs(problem.id, [problem.paper, *agents], scenario, episodes, split)
        bootstrap = Bootstrap(episodes)
        beyond = numpy.quantile(paper, 0.99)
        for name, cost in zip(agents, others, strict=True):
            ratio = [
                float(x) for x in bootstrap.relative_difference(bootstrap.means(cost), bootstrap.means(paper))
            ]
            if name not in worst or ratio[0] > worst[name][0][0]:
                worst[name] = ratio, scenario
            lost[name] += int(((cost > LOST * paper) & (cost > beyond)).sum())
        flown += episodes
    return [
        f"| {problem.short_name.removesuffix('-v0')} | `{name}` | `{worst[name][1]}` | "
        + "{:+.1f} [{:+.1f}, {:+.1f}]".format(*(100.0 * x for x in worst[name][0]))
        + f" | {lost[name]} of {flown} |"
        for name in agents
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environment", nargs="+")
    parser.add_argument("--policy", action="append", help="default: all shipped agents")
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--split", default="test")
    asked = parser.parse_args()
    print(
        "| environment | agent | worst scenario | cost against the paper's there, % | tracks lost |\n"
        + "|---" * 5
        + "|"
    )
    for id in asked.environment:
        problem = problem_of(id)
        agents = asked.policy or pretrained_agents(problem.id)
        for line in rows(problem, agents, asked.episodes, asked.split):
            print(line, flush=True)
