"""Choice of the next target: baselines of docs/examples/budgeted_sensing.py on the same noise, references, and a bound.

    python benchmarks/budgeted_sensing.py > build/budgeted_sensing.txt
    python benchmarks/budgeted_sensing.py --agent runs/sensing-0 --agent runs/sensing-1

Two tables in Markdown. The first is of episodes. The second excludes the semi-Markov bank: it uses covariances alone,
of the Gauss-Markov course with the same moments, without random quantities. There no schedule costs less than the best
evenly spaced looks at each target by itself, at rates whose sum is one look a second (P. Whittle, Restless bandits, J.
Applied Probability 25A (1988), 287-298: the relaxed problem and its multiplier).
"""

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

import numpy

import filtergym
from filtergym.envs.engine.backend import make_model
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.papers.grid import markdown_table

sys.path.insert(0, str(Path(__file__).parent.parent / "docs" / "examples"))
sensing = importlib.import_module("budgeted_sensing")
EPISODES = {"random": 500, "alike": 500, "narrow": 2000}
"""Number of episodes. In the narrow beam few lost targets dominate the mean."""
RIVAL = "greedy"
GAPS, SETTLED, COUNTED = 40, 200, 200
"""Longest time between two looks at a target, s; seconds until covariances have settled, and those that count."""


def interval(values: Any, digits: int = 3) -> str:
    return f"{values.value:.{digits}f} [{values.low:.{digits}f}, {values.high:.{digits}f}]"


def episode_rows(scenario: str, competitors: dict[str, Any]) -> list[list[str]]:
    """Return table rows: cost of each policy relative to the rival's on the same noise, and lost targets."""
    dataset = filtergym.evaluate(
        sensing.BudgetedSensing.id, competitors, scenario=scenario, episodes=EPISODES[scenario]
    )
    cost = dict(zip(competitors, dataset.cost.mean("time").values, strict=True))
    lost = dict(zip(competitors, (numpy.abs(dataset.error.values) > 300.0).mean(axis=(2, 3)), strict=True))
    bootstrap, rows = Bootstrap(EPISODES[scenario]), []
    for name in competitors:
        logarithms = numpy.log(cost[name]) - numpy.log(cost[RIVAL])
        geometric = bootstrap.interval(numpy.exp(bootstrap.means(logarithms[:, None])[:, 0]))
        both = bootstrap.means(numpy.stack([cost[name], cost[RIVAL]], axis=1))
        ratio = bootstrap.interval(both[:, 0] / both[:, 1])
        share = bootstrap.interval(100.0 * bootstrap.means(lost[name][:, None])[:, 0])
        shown = "" if name == RIVAL else interval(geometric), "" if name == RIVAL else interval(ratio)
        rows.append([scenario, name, f"{numpy.median(cost[name]):.0f}", *shown, interval(share, 2)])
    return rows


def spaced_costs(R: numpy.ndarray, agility: numpy.ndarray) -> numpy.ndarray:
    """Return the steady-state mean squared error of a target measured every 1, 2, ... seconds, ``(GAPS, ...)``."""
    found = []
    for gap in range(1, GAPS + 1):
        P, total, seconds = _begun(R), 0.0, 0
        cycles = -(-SETTLED // gap)
        for cycle in range(cycles + 1):
            for second in range(gap):
                P = sensing.later(P, agility)
                P = sensing.updated(P, R) if second == 0 else P
                total, seconds = (total + P[0, 0], seconds + 1) if cycle == cycles else (total, seconds)
        found.append(total / seconds)
    return numpy.array(found)


def relaxed_bound(costs: numpy.ndarray) -> numpy.ndarray:
    """Return a lower bound ``(N,)`` on the mean cost of targets that share one measurement a second.

    ``costs`` of each target by the seconds between its looks: ``(GAPS, 4, N)``.
    """
    rates = 1.0 / numpy.arange(1.0, GAPS + 1.0)[:, None, None]
    prices = numpy.geomspace(1e-2, 1e6, 400)
    values = [(costs + price * rates).min(axis=0).sum(axis=0) - price for price in prices]
    return numpy.max(values, axis=0) / sensing.TARGETS


def scheduled_costs(policy: Any, R: numpy.ndarray, agility: numpy.ndarray) -> numpy.ndarray:
    """Return the mean cost of a policy when only covariances are simulated, ``(N,)``."""
    P, total, waited = _begun(R), 0.0, 0.0 * R
    for second in range(SETTLED + COUNTED):
        P, waited = sensing.later(P, agility), waited + 1.0
        index = policy.index(P, R, {"waited": waited, "agility": agility})
        looked = numpy.arange(sensing.TARGETS)[:, None] == index.argmax(axis=0)
        P, waited = sensing.updated(P, R, looked), numpy.where(looked, 0.0, waited)
        total = total + P[0, 0].mean(axis=0) * (second >= SETTLED)
    return total / COUNTED


def _begun(R: numpy.ndarray) -> numpy.ndarray:
    P = numpy.zeros((3, 3, *R.shape))
    P[0, 0], P[1, 1] = 50.0**2, 30.0**2
    return P


def schedule_rows(scenario: str, count: int = 500) -> list[list[str]]:
    """Return table rows: cost of each policy relative to the bound, when only covariances are simulated."""
    parameters = sensing.BudgetedSensing.scenarios[scenario].parameters
    model = make_model(sensing.BudgetedSensing, "beam", backend="numpy", **parameters)
    own, rng = model.task.parameters, numpy.random.default_rng(0)
    agility, sigma = (
        numpy.exp(rng.uniform(*numpy.log(limits), (sensing.TARGETS, count)))
        for limits in (own.agility, own.sigma)
    )
    bound = relaxed_bound(spaced_costs(sigma**2, agility))
    rows, bootstrap = [], Bootstrap(count)
    for name in ("round-robin", "greedy-information", "greedy", "index", "rollout"):
        over = numpy.log(scheduled_costs(sensing.POLICIES[name](model), sigma**2, agility) / bound)
        rows.append(
            [scenario, name, interval(bootstrap.interval(numpy.exp(bootstrap.means(over[:, None])[:, 0])))]
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--agent", type=Path, action="append", default=[], help="folder of a run, which is judged too"
    )
    options = parser.parse_args()
    rows = []
    for scenario in EPISODES:
        competitors = {name: name for name in (*sensing.POLICIES, *sensing.REFERENCES)}
        if scenario == "narrow":
            competitors |= {folder.name: folder.absolute() for folder in options.agent}
        rows += episode_rows(scenario, competitors)
    columns = (
        "scenario",
        "policy",
        "median cost, m^2",
        f"ratio to {RIVAL}, geometric",
        "of means",
        "lost, %",
    )
    print("\n".join(markdown_table(columns, rows)), end="\n\n")
    rows = [row for scenario in ("random", "alike") for row in schedule_rows(scenario)]
    print("\n".join(markdown_table(("scenario", "policy", "cost over the bound, geometric"), rows)))


if __name__ == "__main__":
    main()
