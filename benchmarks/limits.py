"""Whether a reference is a limit: no competitor may cost significantly less, in any scenario.

``python benchmarks/limits.py ENVIRONMENT`` runs the ranked competitors and the reference of an environment over the
same episodes and prints, for each scenario, who comes nearest: the mean paired difference of the cost to the
reference's, in standard errors over the episodes. It ends with status 1 where one is below -``SIGNIFICANT``.
"""

import argparse
import sys

import numpy
from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import problem_of

from filtergym.names import competitors_of

SIGNIFICANT = 3.0
"""Standard errors; of a few hundred comparisons, one in a thousand lies beyond by chance."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("environment")
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--policy", action="append", help="default: everything that is ranked")
    asked = parser.parse_args()
    problem = problem_of(asked.environment)
    known = problem.baselines
    everything = [*known.policies, *known.estimators, *problem.tuned_policies, *pretrained_agents(problem.id)]
    names, reference = asked.policy or everything, known.score_reference
    beaten = False
    for scenario in problem.task.scenarios:
        data = problem.evaluate(
            competitors_of(problem, [*names, reference]),
            scenario,
            episodes=asked.episodes,
            seed=asked.seed,
        )
        cost = data["cost"].mean("time")
        difference = cost.sel(policy=names) - cost.sel(policy=reference)
        t = difference.mean("episode") / (difference.std("episode", ddof=1) / numpy.sqrt(asked.episodes))
        nearest = t.argmin("policy")
        name, ratio = names[int(nearest)], cost.mean("episode")
        relative = float(ratio.sel(policy=name) / ratio.sel(policy=reference)) - 1.0
        below = [name for name, value in zip(names, t.values, strict=True) if value < -SIGNIFICANT]
        beaten = beaten or bool(below)
        verdict = f"beaten by {', '.join(below)}" if below else "a limit"
        print(
            f"{scenario:20s} {reference}: {verdict}; nearest {name}, {100 * relative:+.1f} % of its cost, "
            f"{float(t[nearest]):+.1f} standard errors",
            flush=True,
        )
    sys.exit(int(beaten))


if __name__ == "__main__":
    main()
