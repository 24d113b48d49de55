"""The fully learned estimator against those that it may replace, paired on the same episodes, in Markdown.

    python benchmarks/students.py

Every scenario of the test split; differences of the cost are geometric means of the episodes' ratios, with 95 % bootstrap
intervals, and beside them each one's ANEES. With ``--runs`` the runs of several training seeds in place of the agent that
is shipped: ``--runs runs/ManeuveringTarget/student-0 runs/ManeuveringTarget/student-1``.
"""

import argparse
from pathlib import Path

from filtergym.agents.training_run import best_agent
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.running.metrics import mean_cost
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.papers.grid import markdown_table

import filtergym

OPPONENTS = {
    "ManeuveringTarget": ("bptt", "bptt-small", "kalman-net", "semi-markov"),
}
"""Whom the student is compared with, by environment: agents, and its own teacher or the strongest filter."""


def main() -> None:
    """Evaluate, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--environment", choices=OPPONENTS, action="append")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--scenario", action="append", help="default: all")
    parser.add_argument("--runs", nargs="+", type=Path, help="folders of training runs")
    options = parser.parse_args()
    rows = []
    for name in options.environment or OPPONENTS:
        id, opponents = f"filtergym/{name}-v0", OPPONENTS[name]
        students = {run.name: str(best_agent(run)) for run in options.runs or ()} or {"student": "student"}
        competitors = {**students, **{each: each for each in opponents}}
        for scenario in options.scenario or problem_of(id).task.scenarios:
            run = filtergym.evaluate(id, competitors, scenario=scenario, episodes=options.episodes, seed=0)
            bootstrap, cost = Bootstrap(options.episodes), {each: mean_cost(run, each) for each in competitors}
            nees = {each: float(run["nees"].sel(policy=each).mean()) for each in competitors}
            anees = {each: value / run.sizes["component"] for each, value in nees.items()}
            for student in students:
                row = [name, scenario, f"`{student}`"]
                for other in opponents:
                    found = bootstrap.geometric_difference(cost[student], cost[other])
                    row.append("{:+.1f} [{:+.1f}, {:+.1f}]".format(*(100.0 * value for value in found)))
                rows.append([*row, *(f"{anees[each]:.2f}" for each in (student, *opponents))])
    header = ["environment", "scenario", "student", *(f"less `{other}`, %" for other in opponents)]
    print("\n".join(markdown_table([*header, "ANEES", *(f"of `{other}`" for other in opponents)], rows)))


if __name__ == "__main__":
    main()
