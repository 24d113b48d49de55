"""Training runs of the fully learned estimator against other competitors, paired on the same episodes, in Markdown.

    python benchmarks/students.py runs/ManeuveringTarget/student-?

Differences of the cost are geometric means of the episodes' ratios, with 95 % bootstrap intervals, on the test split;
the table also has the ANEES, and the time of a measurement over that of ``bptt``.
"""

import argparse
from pathlib import Path

import filtergym
from filtergym.agents.training_run import best_agent, load_run
from filtergym.evaluation.running.metrics import mean_cost
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.papers.grid import markdown_table

OPPONENTS = ("bptt", "bptt-small", "kalman-net", "semi-markov-9", "semi-markov-15", "semi-markov")
"""Opponents of the students: agents, banks of less time, and the strongest filter."""
SCENARIOS = ("random", "atc", "cruise", "descent", "irregular-scans", "glint")
"""The training distribution, and held-out ones."""


def main() -> None:
    """Evaluate the training runs and their opponents, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="folders of training runs, of one environment")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--scenario", action="append", help=f"default: {', '.join(SCENARIOS)}")
    options = parser.parse_args()
    students = {f"seed {load_run(run).seed}": str(best_agent(run)) for run in options.runs}
    competitors, rows = {**students, **{each: each for each in OPPONENTS}}, []
    for scenario in options.scenario or SCENARIOS:
        run = filtergym.evaluate(
            load_run(options.runs[0]).environment,
            competitors,
            scenario=scenario,
            episodes=options.episodes,
            timed=True,
        )
        bootstrap, cost = Bootstrap(options.episodes), {each: mean_cost(run, each) for each in competitors}
        nees, time = (run[name].mean(set(run[name].dims) - {"policy"}) for name in ("nees", "nanoseconds"))
        for student in students:
            row = [scenario, student]
            for other in OPPONENTS:
                found = bootstrap.geometric_difference(cost[student], cost[other])
                row.append("{:+.1f} [{:+.1f}, {:+.1f}]".format(*(100.0 * value for value in found)))
            anees = float(nees.sel(policy=student)) / run.sizes["component"]
            ratio = float(time.sel(policy=student)) / float(time.sel(policy="bptt"))
            rows.append([*row, f"{anees:.2f}", f"{ratio:.2f}"])
    header = ["scenario", "student", *(f"less `{other}`, %" for other in OPPONENTS), "ANEES", "time"]
    print("\n".join(markdown_table(header, rows)))


if __name__ == "__main__":
    main()
