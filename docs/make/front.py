"""The front of cost and time of every environment: measured, kept as records, and drawn in one picture."""

from collections.abc import Mapping, Sequence
from typing import Any

from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import Problem
from filtergym.evaluation.front_figure import Panel, draw_panel, legend_of, name_points
from filtergym.evaluation.metrics import Record
from filtergym.evaluation.parallel import Workers
from filtergym.evaluation.print_layout import figure_with_pairs, in_print
from filtergym.evaluation.rollout import Progress
from filtergym.evaluation.store import Store
from filtergym.evaluation.summary import EvaluationRequest, Summary, combine_summaries, summaries
from filtergym.evaluation.times import METRIC, front, points_of_records

from filtergym.names import evaluation_requests
from filtergym.reports.benchmark import affordable_episodes, ranked_names
from filtergym.reports.work import work_of

METRICS = ("relative_cost_difference", METRIC)
"""Of the records that are kept."""


def front_requests(problem: Problem, episodes: int, seed: int) -> list[EvaluationRequest]:
    """Return what is measured of an environment's training distribution: all that is ranked, and the reference."""
    count = affordable_episodes(problem, problem.task.default_scenario, episodes)
    experiment = problem.experiment(None, count, seed, timed=True)
    names = [*ranked_names(problem), problem.baselines.score_reference]
    return evaluation_requests(problem, experiment, [name for name in names if name])


def measure_fronts(
    problems: Sequence[Problem],
    episodes: int,
    seed: int,
    workers: Workers,
    store: Store,
    start: Any,
) -> list[Record]:
    """Measure cost and time of every competitor of some environments, going on after an interruption.

    Args:
        problems: the environments.
        episodes: at most, of each competitor.
        seed: number of the experiment.
        workers: who does the work.
        store: keeps what is done.
        start: told the number of measurements; returns what is told of those done.

    Returns:
        Tidy records of :data:`METRICS`.
    """
    asked = [
        (i, one) for i, problem in enumerate(problems) for one in front_requests(problem, episodes, seed)
    ]
    tick: Progress = start(sum(one.measurements for _, one in asked))
    work = [work_of(problems[i], one) for i, one in asked]
    found: list[dict[str, Summary]] = [{} for _ in problems]
    for k, summary in summaries([one for _, one in asked], workers, tick, store, work):
        i, one = asked[k]
        found[i][one.name] = summary
    records: list[Record] = []
    for i, own in enumerate(found):
        names = [one.name for j, one in asked if j == i]
        records += [r for r in combine_summaries([own[name] for name in names])[0] if r.metric in METRICS]
    return records


def panels_of(problems: Sequence[Problem], records: Sequence[Record]) -> list[Panel]:
    """Return what is drawn of each environment that the records have times of, in its training distribution."""
    panels = []
    for problem in problems:
        own = [
            r for r in records if (r.environment, r.scenario) == (problem.id, problem.task.default_scenario)
        ]
        if points := points_of_records(own):
            known, learned = problem.baselines, pretrained_agents(problem.id)
            title = problem.short_name.removesuffix("-v0")
            panels.append(Panel(title, points, known.score_paper, known.score_reference, learned))
    return panels


@in_print
def draw_fronts(panels: Sequence[Panel], *, columns: int = 2) -> Any:
    """Draw the fronts of several environments in one picture, and its legend in the place that is left.

    Args:
        panels: at least one.
        columns: of a paper, as wide as which it is.
    """
    figure, axes = figure_with_pairs(len(panels) // 2 + 1, columns)
    cells = axes.ravel().tolist()
    for axis, panel in zip(cells, panels, strict=False):
        draw_panel(axis, panel)
    for axis in cells[len(panels) :]:
        axis.axis("off")
    cells[len(panels)].legend(handles=legend_of(panels), loc="center", frameon=False)
    name_points(figure, dict(zip(cells, panels, strict=False)))
    return figure


def fronts_in_words(panels: Sequence[Panel]) -> Mapping[str, str]:
    """Names on each front, the quickest first."""
    return {panel.title: ", ".join(front(panel.points)) for panel in panels}
