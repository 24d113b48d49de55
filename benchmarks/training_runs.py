"""Training runs of one algorithm against other competitors, paired on the same episodes, in Markdown.

    python benchmarks/training_runs.py runs/*/bptt-strongest-? --against semi-markov --against level-bank

A difference of the cost is the geometric mean of the ratios over episodes and runs, with a 95 % bootstrap interval over
episodes, on the test split; beside it stand the lowest and the highest run. The table also has the ANEES, and the time
of a measurement over the opponent's.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy

import filtergym
from filtergym.agents.training_run import best_agent, load_run
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import bare_name
from filtergym.evaluation.running.metrics import mean_cost
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.names import shipped_names
from filtergym.papers.grid import markdown_table

EPISODES = {"UavAutopilot": 500, "LooselyCoupledNavigation": 500, "TightlyCoupledNavigation": 64}
"""Episodes of a scenario, where they take longer; otherwise :data:`MOST_EPISODES`."""
MOST_EPISODES = 1000
HEADER = ("environment", "scenario", "opponent", "less the opponent, %", "runs, %", "ANEES", "time")


def rows_of(id: str, agents: list[str], opponents: list[str], episodes: int) -> Iterator[list[str]]:
    problem = problem_of(id)
    known = [name for name in opponents if name in shipped_names(problem)]
    bootstrap = Bootstrap(episodes)
    for scenario in problem.task.scenarios:
        run = filtergym.evaluate(id, [*agents, *known], scenario=scenario, episodes=episodes, timed=True)
        logs = numpy.log([mean_cost(run, agent) for agent in agents])
        nees, time = (run[name].mean(set(run[name].dims) - {"policy"}) for name in ("nees", "nanoseconds"))
        anees = float(nees.sel(policy=agents).mean()) / run.sizes["component"]
        for name in known:
            cost = mean_cost(run, name)
            found = bootstrap.geometric_difference(numpy.exp(logs.mean(axis=0)), cost)
            each = numpy.exp((logs - numpy.log(cost)).mean(axis=1)) - 1.0
            ratio = float(time.sel(policy=agents).median() / time.sel(policy=name))
            yield [
                bare_name(id),
                scenario,
                f"`{name}`",
                "{:+.1f} [{:+.1f}, {:+.1f}]".format(*(100.0 * value for value in found)),
                f"{100.0 * each.min():+.1f} to {100.0 * each.max():+.1f}",
                f"{anees:.2f}",
                f"{ratio:.2f}",
            ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="folders of training runs")
    parser.add_argument("--against", action="append", required=True, help="opponent; repeatable")
    parser.add_argument("--episodes", type=int, help="of a scenario")
    options = parser.parse_args()
    agents: dict[str, list[str]] = {}
    for folder in options.runs:
        agents.setdefault(load_run(folder).environment, []).append(str(best_agent(folder)))
    rows = [
        row
        for id, own in agents.items()
        for row in rows_of(
            id, own, options.against, options.episodes or EPISODES.get(bare_name(id), MOST_EPISODES)
        )
    ]
    print("\n".join(markdown_table(HEADER, rows)))


if __name__ == "__main__":
    main()
