"""Learned competitors and the strong filters of every size on one front of cost and time, paired, in Markdown.

    python benchmarks/front_pairs.py

All competitors run on the same episodes of the training distribution. Costs are relative to the quickest learned agent,
times are multiples of its time. The opponent of a learned competitor is the classical one of least cost in at most its
time, and the other way round; an asterisk marks the competitors on the front of all
(:func:`~filtergym.evaluation.running.times.front`). Differences are geometric means of the episodes' ratios, with 95 %
bootstrap intervals.
"""

import argparse
from collections.abc import Collection

import numpy
import xarray

import filtergym
from filtergym.agents.named_policies import pretrained_agents
from filtergym.evaluation.running.times import FRONT_MARK, Point, front, is_quicker, time_of, time_text
from filtergym.evaluation.statistics.bootstrap import Bootstrap, IntervalEstimate
from filtergym.papers.grid import markdown_table

CLASSICAL: dict[str, tuple[int, tuple[str, ...]]] = {
    "LooselyCoupledNavigation": (
        2500,
        ("plain-reduced", "augmented-sage-husa", "fault-bank-4", "fault-bank"),
    ),
    "ManeuveringTarget": (
        5000,
        (
            *("adaptive-rearm-tuned", "kalman-imm-tuned", "kalman-imm-turn-tuned"),
            *(f"semi-markov-{H}{tuned}" for H in (3, 5, 9) for tuned in ("", "-tuned")),
            *("semi-markov-15", "semi-markov", "semi-markov-wide"),
        ),
    ),
    "RadarEsmTracking": (
        2000,
        ("quasi-optimal", "leaky", "forgetting-joint-type-tuned", "exact-bayes-9", "exact-bayes"),
    ),
    "TightlyCoupledNavigation": (
        400,
        ("multi-hypothesis", "fixed-robust-tuned", "huber-stuck-check", "fault-hypotheses"),
    ),
    "UavAutopilot": (
        1000,
        ("sage-husa", "gust-imm-tuned", "level-bank-3", "level-bank-4", "level-bank"),
    ),
}
"""Number of episodes, and the classical competitors that are best in some time, by environment."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--environment", choices=CLASSICAL, action="append", help="default: all")
    rows = []
    for name in parser.parse_args().environment or CLASSICAL:
        episodes, classical = CLASSICAL[name]
        id = f"filtergym/{name}-v0"
        learned = pretrained_agents(id)
        results = filtergym.evaluate(id, [*learned, *classical], episodes=episodes, seed=0, timed=True)
        rows += rows_of(results, name, learned)
    header = [
        "environment", "competitor", "", "ns", "times", "less the quickest agent, %", "ANEES", "opponent",
        "less the opponent, %",
    ]  # fmt: skip
    print("\n".join(markdown_table(header, rows)))


def rows_of(results: xarray.Dataset, environment: str, learned: Collection[str]) -> list[list[str]]:
    names = [str(name) for name in results["policy"].values]
    cost = {name: results["cost"].sel(policy=name).values.mean(axis=1) for name in names}
    times = {name: time_of(results.sel(policy=name)) for name in names}
    nees = results["nees"].mean("time") / results.sizes["component"]
    bootstrap = Bootstrap(results.sizes["episode"])
    quickest = min(learned, key=lambda name: times[name].nanoseconds)
    against = {name: bootstrap.geometric_difference(cost[name], cost[quickest]) for name in names}
    points = [Point(name, "estimator", times[name], against[name].value) for name in names]
    on_front = front(points)
    rows = []
    for name in sorted(names, key=lambda name: times[name].nanoseconds):
        own = times[name].nanoseconds
        others = [
            other
            for other in names
            if (other in learned) != (name in learned) and not is_quicker(times[name], times[other])
        ]
        opponent = min(others, key=lambda other: against[other].value, default="")
        rows.append(
            [
                environment if not rows else "",
                f"`{name}`",
                "learned" if name in learned else "",
                f"{time_text(times[name])}{f' {FRONT_MARK}' if name in on_front else ''}",
                f"{own / times[quickest].nanoseconds:.1f}",
                percent(against[name]) if name != quickest else "0",
                f"{numpy.mean(nees.sel(policy=name).values):.2f}",
                f"`{opponent}`" if opponent else "",
                percent(bootstrap.geometric_difference(cost[name], cost[opponent])) if opponent else "",
            ]
        )
    return rows


def percent(found: IntervalEstimate) -> str:
    return f"{100.0 * found.value:+.1f} [{100.0 * found.low:+.1f}, {100.0 * found.high:+.1f}]"


if __name__ == "__main__":
    main()
