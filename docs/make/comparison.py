"""The comparison page: from the records of a full benchmark to a table and a picture for each environment."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from pictures import draw_differences
from records import BenchmarkRecords, ResultRecord

from filtergym.agents.named_policies import pretrained_agents
from filtergym.envs.engine.catalogue import bare_name
from filtergym.evaluation.competitors.kinds import RANKED
from filtergym.evaluation.running.metrics import Record
from filtergym.evaluation.running.times import FRONT_MARK, PYTHON_MARK, TIME_TITLE, column_of_times
from filtergym.papers.grid import Grid, markdown_table
from filtergym.reports.tables.ranking import HARM, best_competitor, ranking, ranking_sentence
from filtergym.reports.tables.terminal_tables import (
    HEADLINE,
    INCONSISTENT,
    consistency,
    paper_cells,
    score_text,
    with_interval,
)

STRONGEST = 4
"""Number of classical competitors that the page shows."""


class Comparison(NamedTuple):
    """Tables and figure of one environment on the comparison page."""

    environment: str
    grids: list[Grid]
    figure: Any


def compared_policies(benchmark: BenchmarkRecords) -> list[str]:
    """Return the names of the competitors that the comparison page shows, in the order of its columns.

    Learned agents; the cheapest of all others in the training distribution; the paper's algorithm in all its readings;
    it and the best constant action, tuned; the reference whose score is 1. A narrow screen shows only the first
    columns.
    """
    problem, records = benchmark
    known, paper = problem.baselines, benchmark.paper
    of_default = [record for record in records if record.scenario == problem.task.default_scenario]
    agents = pretrained_agents(problem.id)
    ranked = [place.policy for place in ranking(of_default or records)]
    classical = [name for name in ranked if name != paper and name not in agents]
    readings = [paper, known.score_paper]
    tuned = [f"{name}-tuned" for name in (known.score_paper, known.best_constant)]
    present = {record.policy for record in records}
    strongest = classical[:STRONGEST]
    wanted = dict.fromkeys((*agents, *strongest, *readings, *tuned, known.score_reference))
    return [name for name in wanted if name in present]


def _by_name(records: Sequence[Record]) -> dict[tuple[str, ...], Record]:
    return {(r.policy, r.metric, r.component, r.window): r for r in records if r.window == "all"}


def _cells(name: str, records: Sequence[Record]) -> list[str]:
    """Return a competitor's cells: cost against the paper's, lost tracks, means, ANEES and time."""
    values = _by_name(records)
    return [
        with_interval(values.get((name, HEADLINE, "", "all")), 100.0, negligible=0.005),
        *paper_cells(values, name),
        consistency(values.get((name, "anees", "state", "all"))),
        column_of_times(records).get(name, "-"),
    ]


def summary(benchmarks: Sequence[BenchmarkRecords]) -> Grid:
    """Return a table of the best competitor of every origin in each environment, and the reference."""
    rows = []
    for problem, every in benchmarks:
        reference, learned = problem.baselines.score_reference, pretrained_agents(problem.id)
        records = [record for record in every if record.scenario == problem.task.default_scenario]
        values, kinds = _by_name(records), {record.policy: record.kind for record in records}
        places = [place.policy for place in ranking(records)]
        best: dict[str, str] = {}
        for name in places:
            origin = f"learned {kinds[name]}" if name in learned else "classical"
            best.setdefault(origin, name)
        if reference in kinds:
            best["reference"] = reference
        for origin, name in best.items():
            rows.append(
                [
                    bare_name(problem.id),
                    f"`{name}`",
                    origin if origin != "classical" or kinds[name] == "policy" else "classical estimator",
                    *_cells(name, records),
                    score_text(values.get((name, "score", "", "all"))),
                ]
            )
    header = [
        "environment",
        "name",
        "origin",
        "cost against the paper's, %",
        "lost tracks, %",
        "means, %",
        "ANEES",
    ]
    header.append(TIME_TITLE)
    return Grid("The best of every origin on the training distribution", [*header, "share of the room"], rows)


def harm(benchmarks: Sequence[BenchmarkRecords]) -> Grid:
    """Return a table of the scenario in which each learned agent is worst against the paper's algorithm."""
    rows = []
    for problem, records in benchmarks:
        for name in pretrained_agents(problem.id):
            own = [r for r in records if (r.policy, r.metric) == (name, HEADLINE) and r.value is not None]
            if not own:
                continue
            worst = max(own, key=lambda record: record.value or 0.0)
            beside = [record for record in records if record.scenario == worst.scenario]
            rows.append(
                [
                    bare_name(problem.id),
                    f"`{name}`",
                    f"`{worst.scenario}`",
                    *_cells(name, beside),
                    f"{sum((record.low or 0.0) > HARM for record in own)} of {len(own)}",
                ]
            )
    header = ["environment", "agent", "worst scenario", "cost against the paper's there, %", "lost tracks, %"]
    last = f"scenarios more than {100.0 * HARM:g} % above the paper"
    return Grid("Where learned agents do worst", [*header, "means, %", "ANEES", TIME_TITLE, last], rows)


def covariances(benchmarks: Sequence[BenchmarkRecords]) -> Grid:
    """Return a table of the ranked competitors whose covariance does not fit their errors, without random actions."""
    rows = []
    for measured in benchmarks:
        records = [r for r in measured.records if r.scenario == measured.problem.task.default_scenario]
        values = _by_name(records)
        for place in ranking(records):
            both = [
                values.get((place.policy, metric, "state", "all")) for metric in ("anees", "median_anees")
            ]
            texts = [consistency(record) for record in both]
            if place.policy != "random" and any(INCONSISTENT in text for text in texts):
                rows.append([bare_name(measured.problem.id), f"`{place.policy}`", *texts])
    title = "Covariances that do not fit the errors on the training distribution"
    return Grid(title, ["environment", "name", "ANEES, mean", "ANEES, median episode"], rows)


def compare_environment(benchmark: BenchmarkRecords, width: int = 2) -> Comparison:
    """Return the tables and figure of one environment: cost against the paper's algorithm, and physical errors.

    Raises:
        ValueError: if the paper's algorithm, or its opponents, are not among the records.
    """
    problem, records = benchmark
    cls, known = problem.task, problem.baselines
    paper, columns = benchmark.paper, compared_policies(benchmark)
    if paper not in columns:
        raise ValueError(f"the records of {cls.id} lack the paper's algorithm {paper!r}")
    others = [name for name in columns if name != paper]
    found = {(r.scenario, r.policy, r.metric, r.component): r for r in records if r.window == "all"}
    sizes = {record.scenario: record.episodes for record in records}
    metric, component = known.physical
    units = [r.unit for r in records if (r.metric, r.component) == known.physical]
    if not others or not units:
        raise ValueError(
            f"the records of {cls.id} hold nothing to compare with {paper!r}, or no {metric} {component}: make them by "
            "filtergym benchmark --full"
        )
    by_window = {(s, p, m, c, "all"): r for (s, p, m, c), r in found.items()}
    bounds = [name for name in known.bounds if (next(iter(sizes)), name, *known.physical) in found]
    kinds, learned = {r.policy: r.kind for r in records}, pretrained_agents(cls.id)
    verdicts = {s: best_competitor([record for record in records if record.scenario == s]) for s in sizes}

    times = {s: column_of_times([record for record in records if record.scenario == s]) for s in sizes}

    def grid(title: str, names: Sequence[str], text: Callable[[str, str], str], judged: bool = False) -> Grid:
        """Return a table with a row for each scenario: the verdict if ``judged``, and ``text(scenario,
        name)`` by name.
        """
        heads = [f"`{name}`{_role(name, kinds[name], paper, learned)}" for name in names]
        return Grid(
            title,
            ["scenario", *(["verdict"] if judged else []), *heads],
            [
                [
                    f"`{scenario}`" + ("" if cls.scenarios[scenario].training else "<br>held out"),
                    *([verdicts[scenario]] if judged else []),
                    *(text(scenario, name) for name in names),
                ]
                for scenario in sizes
            ],
        )

    def tail(scenario: str, name: str) -> str:
        lost, means = paper_cells(by_window, name, (scenario,))
        return "-" if means == "-" else f"{lost}<br>{means}"

    quantity = f"{metric} {component}".replace("_", " ").replace("rmse", "RMSE").strip()
    grids = [
        grid(
            f"Cost against `{paper}`, %",
            others,
            lambda scenario, name: _two_lines(found.get((scenario, name, HEADLINE, "")), 100.0),
            judged=True,
        ),
        grid(
            f"{quantity}, {units[0]}",
            [*columns, *bounds],
            lambda scenario, name: _two_lines(found.get((scenario, name, metric, component)), 1.0),
        ),
        grid(
            f"The tail: share of lost tracks, %, and difference of the mean cost to that of `{paper}`, %",
            columns,
            tail,
        ),
        grid(
            "Consistency: mean NEES over the dimension; 1 is consistent, "
            f"{INCONSISTENT} off by more than a factor of two",
            columns,
            lambda scenario, name: consistency(found.get((scenario, name, "anees", "state"))),
        ),
        grid(
            f"Nanoseconds a measurement on one core, without the simulated world; {PYTHON_MARK}: in Python, not "
            "compiled; "
            f"{FRONT_MARK}: on the front, where no other competitor has a lower error cost in as much time",
            columns,
            lambda scenario, name: times[scenario].get(name, "-"),
        ),
    ]
    differences: dict[str, dict[str, tuple[float, ...]]] = {}
    for scenario in sizes:
        row = differences.setdefault(
            scenario + ("\n(training)" if cls.scenarios[scenario].training else ""), {}
        )
        for name in others:
            record = found.get((scenario, name, HEADLINE, ""))
            interval = () if record is None else (record.value, record.low, record.high)
            percent = tuple(100.0 * x for x in interval if x is not None)
            if len(percent) == 3:
                row[name] = percent
    unranked = [name for name in others if kinds[name] not in RANKED]
    figure = draw_differences(differences, others, learned, unranked, cls.id, paper, columns=width)
    return Comparison(cls.id, grids, figure)


def _role(name: str, kind: str, paper: str, learned: Sequence[str]) -> str:
    if name == paper:
        return " (paper)"
    if name in learned:
        return " (learned estimator)" if kind == "estimator" else " (learned)"
    return "" if kind == "policy" else f" ({kind})"


def _two_lines(record: Record | None, scale: float) -> str:
    """Return a record's value and interval as Markdown of two lines, for a narrow column."""
    # Percentages to a hundredth: smaller values are rounding.
    negligible = 0.005 if scale == 100.0 else 0.0
    shown = with_interval(record, scale, negligible=negligible)
    return "0" if shown == "0 [0, 0]" else shown.replace(" [", "<br>[")


def overview_markdown(benchmarks: Sequence[BenchmarkRecords], which: str) -> str:
    """Return the overview table called "best", "harm" or "covariances", over all environments, in Markdown."""
    tables = {"best": summary, "harm": harm, "covariances": covariances}
    if which not in tables:
        raise ValueError(f"no table {which!r}: there are {', '.join(tables)}")
    grid = tables[which](benchmarks)
    return "\n".join([f"**{grid.title}**", "", *markdown_table(grid.header, grid.rows)])


def comparison_markdown(comparison: Comparison, benchmark: BenchmarkRecords, record: ResultRecord) -> str:
    """Return the sentences and tables of one environment in Markdown, with the command of the records."""
    records, paper = benchmark.records, benchmark.paper
    first = records[0]
    episodes = sorted({record.episodes for record in records})
    count = str(episodes[0]) if len(episodes) == 1 else f"{episodes[0]} to {episodes[-1]}"
    scenarios = dict.fromkeys(record.scenario for record in records)
    lines: list[str] = [
        f"* {ranking_sentence([r for r in records if r.scenario == scenario], paper)}"
        for scenario in scenarios
    ]
    lines.append("")
    for grid in comparison.grids:
        lines += [f"**{grid.title}**", "", *markdown_table(grid.header, grid.rows), ""]
    lines.append(
        f"{first.split.capitalize()} split, {count} episodes a scenario, 95 % intervals over episodes. {record.origin}"
    )
    return "\n".join(lines)
