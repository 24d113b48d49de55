"""Coverage of nominal 95 % intervals, for each statistic of a comparison and several numbers of episodes.

    python benchmarks/interval_coverage.py

The mean costs of many episodes of each competitor are the population: their statistics are the truth. Episodes are
drawn from it with replacement, repeatedly, and intervals are computed from each sample as in an evaluation. Printed in
Markdown: the share of intervals that contain the truth, and the share of the misses that lie below it (a half for
symmetric misses).
"""

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import numpy
import xarray

from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.companions import lost_cost
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.evaluation.running.metrics import mean_over_time
from filtergym.evaluation.running.summary import EvaluationRequest, reduce_episodes
from filtergym.evaluation.statistics.bootstrap import Bootstrap, IntervalEstimate, share_interval
from filtergym.evaluation.statistics.statistic import ALL, Statistic
from filtergym.names import find_competitor

NUMBERS = (100, 200, 1000, 5000)
"""Numbers of episodes of an evaluation."""
CASES = (
    ("ManeuveringTarget", "random", ("semi-markov", "bptt-strongest")),
    ("ManeuveringTarget", "clutter", ("semi-markov-pda",)),
    ("LooselyCoupledNavigation", "random", ("fault-bank", "kalman-net")),
    ("TightlyCoupledNavigation", "random", ("fault-hypotheses", "bptt-small")),
)
"""Environment, scenario and competitors, each compared with the paper's algorithm."""
STATISTICS = ("geometric mean of ratios", "lost tracks", "ratio of means")


class Pool(NamedTuple):
    """Population of episodes: costs of the paper's algorithm and of a competitor, and the cost of a lost track."""

    paper: numpy.ndarray
    """Mean cost of the paper's algorithm in every episode, ``(episodes,)``."""
    own: numpy.ndarray
    """Mean cost of the competitor in every episode, ``(episodes,)``."""
    bound: float
    """Cost beyond which a track is lost."""


def episode_costs(environment: str, scenario: str, name: str, episodes: int) -> numpy.ndarray:
    problem = problem_of(f"filtergym/{environment}-v0")
    split = "validation" if problem.task.scenarios[scenario].training else "test"
    experiment = problem.experiment(scenario, episodes, 1, split)
    request = EvaluationRequest(experiment, name, find_competitor(problem, name).maker)

    def declare(run: xarray.Dataset) -> Iterator[Statistic]:
        yield Statistic(("cost",), mean_over_time(run, run["cost"].values), sample=ALL)

    found: numpy.ndarray = reduce_episodes(request, declare, lambda done: None).reduction.results()["cost",]
    return found


def truths(pool: Pool) -> list[float]:
    ratio = pool.own / pool.paper
    return [
        float(numpy.expm1(numpy.log(ratio).mean())),
        float((pool.own > pool.bound).mean()),
        float(pool.own.mean() / pool.paper.mean() - 1.0),
    ]


def intervals(pool: Pool, bootstrap: Bootstrap) -> list[IntervalEstimate]:
    own, paper = bootstrap.means(numpy.stack([pool.own, pool.paper], axis=1)).T
    return [
        bootstrap.geometric_difference(pool.own, pool.paper),
        share_interval(float((pool.own > pool.bound).mean()), len(pool.own)),
        bootstrap.relative_difference(own, paper),
    ]


def coverage(pool: Pool, number: int, repetitions: int) -> list[str]:
    """Return for each statistic the share of intervals that hold the truth, and of misses below it, as text."""
    generator, bootstrap = numpy.random.default_rng(number), Bootstrap(number)
    true = numpy.array(truths(pool))
    below, above = numpy.zeros(len(true)), numpy.zeros(len(true))
    for _ in range(repetitions):
        drawn = generator.integers(0, len(pool.paper), number)
        part = pool._replace(paper=pool.paper[drawn], own=pool.own[drawn])
        found = numpy.array(intervals(part, bootstrap))
        below += found[:, 2] < true
        above += found[:, 1] > true
    missed = below + above
    return [
        f"{1.0 - m / repetitions:.3f}" + (f" ({b / m:.1f})" if m else "")
        for m, b in zip(missed, below, strict=True)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="Coverage of intervals, by resampling many episodes.")
    parser.add_argument("--episodes", type=int, default=5000)
    parser.add_argument("--repetitions", type=int, default=500)
    options = parser.parse_args()
    print("| environment | competitor | statistic | of all | " + " | ".join(f"{n:,}" for n in NUMBERS) + " |")
    print("|---" * (4 + len(NUMBERS)) + "|")
    for environment, scenario, names in CASES:
        problem = problem_of(f"filtergym/{environment}-v0")
        paper = episode_costs(environment, scenario, problem.paper, options.episodes)
        bound = lost_cost(make_task(problem.task, scenario)) or numpy.inf
        for name in names:
            pool = Pool(paper, episode_costs(environment, scenario, name, options.episodes), bound)
            cells = [coverage(pool, number, options.repetitions) for number in NUMBERS]
            for i, (statistic, true) in enumerate(zip(STATISTICS, truths(pool), strict=True)):
                row = [f"{environment} `{scenario}`", f"`{name}`", statistic, f"{100.0 * true:.1f} %"]
                print(f"| {' | '.join([*row, *(column[i] for column in cells)])} |", flush=True)


if __name__ == "__main__":
    main()
