"""The front of cost and time of every environment, from the records of a benchmark: a picture, and a table."""

from collections.abc import Sequence
from typing import Any, cast

from records import BenchmarkRecords

from filtergym.agents.named_policies import pretrained_agents
from filtergym.envs.engine.catalogue import bare_name
from filtergym.evaluation.competitors.kinds import RANKED
from filtergym.evaluation.figures.front_figure import FrontPanel, draw_panel, legend_of, name_points
from filtergym.evaluation.figures.print_layout import figure_with_pairs, in_print
from filtergym.evaluation.running.metrics import Record
from filtergym.evaluation.running.times import points_of_records, times_of_records
from filtergym.papers.grid import markdown_table
from filtergym.reports.tables.terminal_tables import HEADLINE

BUDGETS = (100, 300, 1000, 5000)
"""Time limits of a measurement, ns."""


def panels_of(benchmarks: Sequence[BenchmarkRecords]) -> list[FrontPanel]:
    """Return the picture's panel of each environment whose records contain times, in its training distribution."""
    panels = []
    for measured in benchmarks:
        problem, records = measured
        own = [r for r in records if r.scenario == problem.task.default_scenario]
        if points := points_of_records(own):
            known, learned = problem.baselines, pretrained_agents(problem.id)
            panels.append(
                FrontPanel(bare_name(problem.id), points, measured.paper, known.score_reference, learned)
            )
    return panels


@in_print
def draw_fronts(panels: Sequence[FrontPanel], *, columns: int = 2) -> Any:
    """Draw the cost-time fronts of several environments in one picture, with the legend in the empty place."""
    figure, axes = figure_with_pairs(len(panels) // 2 + 1, columns)
    cells = axes.ravel().tolist()
    for axis, panel in zip(cells, panels, strict=False):
        draw_panel(axis, panel)
    for axis in cells[len(panels) :]:
        axis.axis("off")
    cells[len(panels)].legend(handles=legend_of(panels), loc="center", frameon=False)
    name_points(figure, dict(zip(cells, panels, strict=False)))
    return figure


def budgets_markdown(benchmarks: Sequence[BenchmarkRecords]) -> str:
    """Return a Markdown table: the classical and the learned competitor of lowest cost within each processor time.

    Of the two, the one whose whole interval lies below that of the other is bold.
    """
    rows = []
    for problem, records in benchmarks:
        own = [r for r in records if r.scenario == problem.task.default_scenario]
        times, learned = times_of_records(own), pretrained_agents(problem.id)
        costs = [r for r in own if r.metric == HEADLINE and r.kind in RANKED and r.value is not None]
        best: list[list[Record | None]] = [[], []]
        for budget in BUDGETS:
            quick = [r for r in costs if r.policy in times and times[r.policy].nanoseconds <= budget]
            for kind, line in enumerate(best):
                mine = [r for r in quick if (r.policy in learned) == bool(kind)]
                line.append(min(mine, key=lambda r: cast(float, r.value), default=None))
        for kind, title in enumerate(("classical", "learned")):
            cells = [_cell(own, rival) for own, rival in zip(best[kind], best[1 - kind], strict=True)]
            rows.append([bare_name(problem.id) if not kind else "", title, *cells])
    return "\n".join(markdown_table(["", "", *(f"{budget:,} ns" for budget in BUDGETS)], rows))


def _cell(own: Record | None, rival: Record | None) -> str:
    if own is None or own.value is None:
        return "-"
    text = f"`{own.policy}` {100.0 * own.value:+.1f}"
    below = rival is None or (own.high is not None and rival.low is not None and own.high < rival.low)
    return f"**{text}**" if below else text
