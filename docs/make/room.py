"""The room table: who is best on an environment's training distribution, and how much there is to win."""

from collections.abc import Callable

from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import Problem
from filtergym.evaluation.metrics import Record, tidy_records
from filtergym.evaluation.times import TIME_NOTE, TIME_TITLE, column_of_times
from filtergym.papers.grid import markdown_table

from filtergym.names import competitors_of
from filtergym.reports.ranking import ranking_sentence
from filtergym.reports.tables import (
    INCONSISTENT,
    against_paper,
    consistency,
    main_components,
    rank_competitors,
    score_text,
    with_interval,
)

MARKER = "room table"
"""What the markers of a page are called, between which the table stands."""


def room_policies(problem: Problem) -> list[str]:
    """Names in the room table: everything that has a name, but random actions."""
    return [name for name in (*problem.names, *pretrained_agents(problem.id)) if name != "random"]


def measure_room(problem: Problem, episodes: int, seed: int, progress: Callable[[int], None]) -> list[Record]:
    """Evaluate everything that the room table shows, on the test split of the default scenario."""
    makers = competitors_of(problem, room_policies(problem))
    dataset = problem.evaluate(makers, None, episodes, seed, progress=progress, timed=True)
    return tidy_records(dataset, problem.baselines.metrics)


def room_markdown(records: list[Record], paper: str, command: str) -> str:
    """Return the room table as Markdown, with the paper's algorithm and the command that makes the table."""
    first = records[0]
    found = {(r.policy, r.metric, r.component, r.window): r for r in records}
    shown = main_components(records)
    units = {r.component: r.unit for r in records if r.metric == "rmse"}
    header = [
        "policy",
        f"cost against `{paper}`, %",  # what a narrow screen shows without scrolling
        "median, %",
        "wins, %",
        TIME_TITLE,
        "control",
        "mean cost",
        *(f"RMSE {c.replace('_', ' ')}, {units[c]}" for c in shown),
        "ANEES",
        "score",
    ]
    rows, times = [], column_of_times(records)
    for name, kind, control in rank_competitors(records):
        rows.append(
            [
                f"`{name}`",
                with_interval(
                    found.get((name, "relative_cost_difference", "", "all")), 100.0, negligible=0.005
                ),
                *against_paper(found, name),
                times.get(name, "-"),
                control if kind == "policy" else f"({kind})",
                with_interval(found.get((name, "cost", "", "all"))),
                *(with_interval(found.get((name, "rmse", c, "all"))) for c in shown),
                consistency(found.get((name, "anees", "state", "all"))),
                score_text(found.get((name, "score", "", "all"))),
            ]
        )
    note = (
        f"{ranking_sentence(records, paper)} Lowest cost first; median and wins are of the cost of each episode. "
        f"ANEES is the mean NEES over the dimension; {INCONSISTENT} marks a covariance that is off by more than a "
        f"factor of two. {TIME_NOTE}\n\n"
        f"Scenario `{first.scenario}`, {first.episodes} episodes of the {first.split} split, "
        f"95 % bootstrap intervals. Made by `{command}`."
    )
    return "\n".join([*markdown_table(header, rows), "", note])
