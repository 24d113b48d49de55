"""What a gate is worth: an agent alone and behind the gate, against the fallback, in every scenario.

Example: python benchmarks/gate.py filtergym/LooselyCoupledNavigation-v0 runs/fusion --episodes 300
"""

import argparse

import numpy
from filtergym.agents.gate import Gated, PaperAction, PolicyMaker
from filtergym.envs.catalogue import task_class
from filtergym.evaluation.bootstrap import Bootstrap

import filtergym
from filtergym.names import competitor


def row(id: str, agent: str, scenario: str, episodes: int) -> str:
    """One row of the table: cost against the fallback, share of decisions with an open gate, and ANEES."""
    inner, opened = competitor(id, agent), []

    class Watched(Gated):
        def act(self, observation, state, start):
            action, state = super().act(observation, state, start)
            opened.append(state[1].since < self.gate.window)
            return action, state

    makers = {
        "fallback": PolicyMaker(inner, lambda task, _: PaperAction(task)),
        "alone": inner,
        "gated": PolicyMaker(inner, Watched),
    }
    data = filtergym.evaluate(id, makers, scenario, episodes, split="validation", seed=1)
    bootstrap = Bootstrap(episodes)
    fallback, *others = (bootstrap.means(cost) for cost in data["cost"].mean("time").values)
    cells = [
        "{:+.1f} [{:+.1f}, {:+.1f}]".format(
            *(100.0 * x for x in bootstrap.relative_difference(cost, fallback))
        )
        for cost in others
    ]
    anees = data["nees"].mean(["episode", "time"]).values / data.sizes["component"]
    share = 100.0 * numpy.mean([decision[:episodes].mean() for decision in opened])
    return f"| `{scenario}` | {' | '.join(cells)} | {share:.0f} | {', '.join(f'{x:.2g}' for x in anees)} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environment")
    parser.add_argument("agent", help="name, file or run")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--scenario", action="append", help="default: all")
    asked = parser.parse_args()
    print(
        "| scenario | alone | behind the gate | open, % | ANEES of fallback, alone, gated |\n|---|---|---|---|---|"
    )
    for scenario in asked.scenario or task_class(asked.environment).scenarios:
        print(row(asked.environment, asked.agent, scenario, asked.episodes), flush=True)
