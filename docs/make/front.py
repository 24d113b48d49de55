"""The front of cost and time of every environment, drawn from the records of a benchmark in one picture."""

from collections.abc import Sequence
from typing import Any

from filtergym.agents.named_policies import pretrained_agents
from filtergym.evaluation.front_figure import Panel, draw_panel, legend_of, name_points
from filtergym.evaluation.print_layout import figure_with_pairs, in_print
from filtergym.evaluation.times import points_of_records
from records import BenchmarkRecords, short_name


def panels_of(found: Sequence[BenchmarkRecords]) -> list[Panel]:
    """Return what is drawn of each environment that the records have times of, in its training distribution."""
    panels = []
    for problem, records in found:
        own = [r for r in records if r.scenario == problem.task.default_scenario]
        if points := points_of_records(own):
            known, learned = problem.baselines, pretrained_agents(problem.id)
            panels.append(
                Panel(short_name(problem.id), points, known.score_paper, known.score_reference, learned)
            )
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
