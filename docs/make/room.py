"""The room table: who is best on an environment's training distribution, and how much there is to win."""

from collections.abc import Sequence

from comparison import BenchmarkRecords
from filtergym.baselines.problem import Problem
from filtergym.evaluation.metrics import Record
from filtergym.evaluation.times import TIME_NOTE, TIME_TITLE, column_of_times
from filtergym.papers.grid import markdown_table

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


def room_records(found: Sequence[BenchmarkRecords], problem: Problem) -> list[Record]:
    """Return what a benchmark has measured in the training distribution of an environment, of all but random actions.

    Args:
        found: what :func:`.comparison.read_benchmark` has read.
        problem: the environment.

    Raises:
        ValueError: if there is nothing.
    """
    records = [
        record
        for own in found
        for record in own.records
        if (own.problem.id, record.scenario) == (problem.id, problem.task.default_scenario)
        and record.policy != "random"
    ]
    if not records:
        raise ValueError(
            f"no records of {problem.id} in its training distribution: make them by filtergym benchmark --full"
        )
    return records


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
