"""The table of results: competitors of one scenario, lowest cost first, from the records of benchmarks."""

from collections.abc import Callable, Mapping, Sequence

from records import BenchmarkRecords, ResultRecord

from filtergym.envs.engine.catalogue import bare_name
from filtergym.evaluation.running.metrics import Record
from filtergym.evaluation.running.times import TIME_NOTE, TIME_TITLE, column_of_times
from filtergym.papers.grid import markdown_table
from filtergym.reports.tables.ranking import ranking_sentence
from filtergym.reports.tables.terminal_tables import (
    COST_NOTE,
    HEADLINE,
    INCONSISTENT,
    consistency,
    main_components,
    paper_cells,
    rank_competitors,
    score_text,
    with_interval,
)

COLUMNS = ("difference", "lost", "means", "ns", "control", "cost", "rmse", "anees", "score")
"""Columns of the table, in their order; a page may choose."""


def scenario_records(
    benchmark: BenchmarkRecords, scenario: str = "", policies: Sequence[str] = ()
) -> list[Record]:
    """Return a benchmark's records of one scenario; of all competitors but random actions by default.

    Default scenario: the training distribution.
    """
    scenario = scenario or benchmark.problem.task.default_scenario
    records = [
        record
        for record in benchmark.records
        if record.scenario == scenario
        and (record.policy in policies if policies else record.policy != "random")
    ]
    if not records:
        raise ValueError(
            f"no records of {benchmark.problem.id} in scenario {scenario!r}"
            + (f" of {', '.join(policies)}" if policies else "")
            + ": make them by filtergym benchmark --full"
        )
    return records


def results_grid(
    records: Sequence[Record], paper: str, columns: Sequence[str] = COLUMNS
) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the results in one environment and scenario, lowest cost first."""
    found = {(r.policy, r.metric, r.component, r.window): r for r in records}
    units = {r.component: r.unit for r in records if r.metric == "rmse"}
    times = column_of_times(records)

    def number(metric: str, component: str = "") -> Callable[[str], str]:
        return lambda name: with_interval(found.get((name, metric, component, "all")))

    titles: dict[str, dict[str, Callable[[str], str]]] = {
        "difference": {
            f"cost against `{paper}`, %": lambda name: with_interval(
                found.get((name, HEADLINE, "", "all")), 100.0, negligible=0.005
            )
        },
        "lost": {"lost tracks, %": lambda name: paper_cells(found, name)[0]},
        "means": {"means, %": lambda name: paper_cells(found, name)[1]},
        "ns": {TIME_TITLE: lambda name: times.get(name, "-")},
        "control": {"control": lambda name: controls[name]},
        "cost": {"mean cost": number("cost")},
        "rmse": {
            f"RMSE {c.replace('_', ' ')}, {units[c]}": number("rmse", c) for c in main_components(records)
        },
        "anees": {"ANEES": lambda name: consistency(found.get((name, "anees", "state", "all")))},
        "score": {"score": lambda name: score_text(found.get((name, "score", "", "all")))},
    }
    competitors = rank_competitors(records)
    controls = {name: control if kind == "policy" else f"({kind})" for name, kind, control in competitors}
    shown = [entry for column in columns for entry in titles[column].items()]
    rows = [[f"`{name}`", *(text(name) for _, text in shown)] for name, *_ in competitors]
    return ["policy", *(title for title, _ in shown)], rows


def results_markdown(benchmark: BenchmarkRecords, record: ResultRecord, scenario: str = "") -> str:
    """Return the table of results in Markdown, with sentences on the best competitor and on the columns."""
    records, paper = scenario_records(benchmark, scenario), benchmark.paper
    note = (
        f"{ranking_sentence(records, paper)} Lowest cost first. {COST_NOTE} ANEES is the mean NEES over the dimension; "
        f"{INCONSISTENT} marks a covariance that is off by more than a factor of two. {TIME_NOTE}\n\n{_where(records)} "
    )
    note += record.origin
    return "\n".join([*markdown_table(*results_grid(records, paper)), "", note])


def chosen_markdown(
    benchmarks: Mapping[str, tuple[BenchmarkRecords, ResultRecord]],
    scenario: str = "",
    policies: Sequence[str] = (),
    columns: Sequence[str] = (),
) -> str:
    """Return a Markdown table of results in several environments, or of some competitors or columns.

    Default columns: those whose titles are the same in every environment.

    Raises:
        ValueError: for an unknown column, one that several environments cannot share, and if there are no results.
    """
    columns = columns or ("difference", "lost", "means", "ns", "anees", "score")
    if wrong := [column for column in columns if column not in COLUMNS]:
        raise ValueError(f"no column {wrong[0]!r}: there are {', '.join(COLUMNS)}")
    if "rmse" in columns and len(benchmarks) > 1:
        raise ValueError(
            "the errors of several environments are of different quantities: leave out the column rmse"
        )
    header: list[str] = []
    rows, notes = [], []
    for name, (own, record) in benchmarks.items():
        records = scenario_records(own, scenario, policies)
        # With everybody's records, so that the front and the best are those of the whole table.
        titles, lines = results_grid(scenario_records(own, scenario), own.paper, columns)
        wanted = {f"`{record.policy}`" for record in records}
        header = [
            title if len(benchmarks) == 1 else title.replace(f"`{own.paper}`", "the paper's")
            for title in titles
        ]
        first = [name] if len(benchmarks) > 1 else []
        rows += [[*first, *line] for line in lines if line[0] in wanted]
        notes.append(
            f"{_where(records)} {record.origin}" if len(benchmarks) == 1 else f"{name} {records[0].episodes}"
        )
    table = markdown_table([*(["environment"] if len(benchmarks) > 1 else []), *header], rows)
    if len(benchmarks) > 1:
        notes = [
            f"Episodes: {', '.join(notes)}; with 95 % bootstrap intervals, from the records of the benchmark."
        ]
    return "\n".join([*table, "", *notes])


def _where(records: Sequence[Record]) -> str:
    first = records[0]
    return (
        f"{bare_name(first.environment)}, scenario `{first.scenario}`, {first.episodes} episodes of the "
        f"{first.split} split, 95 % bootstrap intervals."
    )
