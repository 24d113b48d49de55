"""Tables of results for the terminal."""

import functools
import io
import math
import textwrap
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import rich.box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from ...baselines.tuned_values import Tuned
from ...evaluation.competitors.kinds import NOT_CAUSAL, RANKED
from ...evaluation.running.times import OWN_MARK, OWN_NOTE, TIME_NOTE, TIME_TITLE, column_of_times

NARROW, WIDE = 24, 44
"""Widths of the column of names, columns; longer names are broken, after a hyphen if they have one."""
INCONSISTENT_WORDS = ("overconfident", "cautious")
"""Endings of the words on an inconsistent covariance."""
INCONSISTENT = "!"
"""Mark of a covariance that is off by more than a factor of two."""
OWN_ROW = ">"
"""Mark of the row of a user's own competitor."""


def with_interval(record: Any, scale: float = 1.0, digits: int = 3, negligible: float = 0.0) -> str:
    """Return a record's value and interval as text in significant digits: ``67.0 [66.6, 67.4]``.

    All three are multiplied by ``scale``; scaled values below ``negligible`` are shown as 0.
    """
    if record is None or record.value is None:
        return "-"

    def text(value: float, form: str = "#") -> str:
        value *= scale
        if abs(value) < negligible:
            return "0"
        return f"{value:,.0f}" if abs(value) >= 10.0**digits else f"{value:{form}.{digits}g}".rstrip(".")

    if record.low is None or record.low == record.high:
        return text(record.value, "")
    return f"{text(record.value)} [{text(record.low)}, {text(record.high)}]"


HEADLINE = "geometric_cost_difference"
"""Metric of the first column: geometric mean of the ratios of the episodes' costs to the paper's, less one."""


def paper_cells(records: Mapping[Any, Any], name: str, scenario: tuple[str, ...] = ()) -> list[str]:
    """Return two cells of a table: share of lost tracks, %, and difference of mean cost to the paper's, %."""
    lost, means = (
        records.get((*scenario, name, metric, "", "all"))
        for metric in ("lost_tracks", "relative_cost_difference")
    )
    shares = with_interval(lost, 100.0, digits=2, negligible=0.005)
    if means is None or means.value is None:
        return [shares, "-"]
    percent = 100.0 * means.value
    digits = 1 if abs(percent) < 1000.0 else 0
    return [shares, f"{percent:+,.{digits}f}"]


def consistency_word(record: Any) -> str:
    """Return "consistent" if the interval of an ANEES record contains one, else "overconfident" or "cautious".

    "Slightly" marks an inconsistency of less than a factor of two.
    """
    if record is None or record.value is None:
        return "unknown"
    if record.low is None or record.low == record.high:
        return "no interval"
    if record.low <= 1.0 <= record.high:
        return "consistent"
    word = "overconfident" if record.value > 1.0 else "cautious"
    return word if is_far_off(record.value) else f"slightly {word}"


def is_far_off(value: float) -> bool:
    """Return whether an ANEES (mean NEES over its dimension) is outside 0.5 to 2."""
    return not 0.5 <= value <= 2.0


def consistency(record: Any) -> str:
    """Return the ANEES of a record as text, marked where it is outside 0.5 to 2."""
    if record is None or record.value is None:
        return "-"
    return f"{record.value:.3g}" + (f" {INCONSISTENT}" if is_far_off(record.value) else "")


def score_text(record: Any) -> str:
    """Return a record of the score as text with its interval; "-" where it has no value."""
    return with_interval(record, negligible=1e-9)


def main_components(records: Sequence[Any]) -> list[str]:
    """Return the names of the components that tables show: groups such as "position", else the first three."""
    first = records[0]
    names = [
        r.component for r in records if r.policy == first.policy and r.metric == "rmse" and r.window == "all"
    ]
    return select_components(names)


def select_components(names: Sequence[str]) -> list[str]:
    """Return the names that are groups of components, such as "position"; without any, the first three."""
    # One namesake is no group: "range" is not made of "range_rate".
    return [g for g in names if sum(other.startswith(f"{g}_") for other in names) > 1] or list(names[:3])


def rank_competitors(records: Sequence[Any]) -> list[tuple[str, str, str]]:
    """Return name, kind and control of every competitor: first the ranked ones by their cost, then the others."""
    cost = {r.policy: r.value for r in records if (r.metric, r.window) == ("geometric_cost", "all")}
    found = dict.fromkeys((r.policy, r.kind, r.control) for r in records)

    def place(entry: tuple[str, str, str]) -> tuple[int, float]:
        value = cost.get(entry[0])
        section = 0 if entry[1] in RANKED else 1 if entry[1] == "smoother" else 2
        return section, math.inf if value is None else value

    return sorted(found, key=place)


def cost_title(paper: str) -> str:
    """Return the title of the column of costs against the paper's algorithm; a long name has a line of its own."""
    return f"cost vs{' ' if len(paper) < 10 else chr(10)}{paper or 'paper'}, %"


def results_tables(
    records: Sequence[Any],
    knows: Mapping[str, str],
    width: int,
    paper: str = "",
    user_names: Collection[str] = (),
) -> list[Table]:
    """Return tables of all competitors, lowest cost first: cost against the paper's, consistency, score, errors.

    Errors that do not fit into ``width`` stand below in tables of their own; rows of ``user_names`` are
    marked.
    """
    first = records[0]
    found = {(r.policy, r.metric, r.component, r.window): r for r in records}
    names = rank_competitors(records)
    draw = functools.partial(competitors_table, names, user_names=user_names)
    costs, notes = _cost_columns(records, found, paper)
    exact, rounded = (_error_columns(records, found, intervals) for intervals in (True, False))
    fitting = [
        ([draw({**costs, **exact}, True)], []),
        ([draw({**costs, **exact}, False)], []),
        *(([draw({**costs, **rounded}, False, compact)], [RMSE_NOTE]) for compact in (False, True)),
    ]
    tables, more = next(
        ((tables, more) for tables, more in fitting if first_fitting(tables, width)),
        (_tables_below_each_other(draw, costs, exact, width), []),
    )
    tables[0].title = (
        f"{first.environment}, scenario {first.scenario} "
        f"({first.episodes} episodes, {first.split} split, seed {first.seed}; 95 % intervals)"
    )
    notes += more
    notes += [f"{OWN_ROW} marks your own."] if any(name in user_names for name, *_ in names) else []
    smoothers = [name for name, kind, _ in names if kind == "smoother"]
    notes += [f"{NOT_CAUSAL}: {', '.join(smoothers)}."] if smoothers else []
    notes += [f"{name} knows {knows[name]}." for name, *_ in names if name in knows]
    tables[-1].caption = "\n".join(notes)
    return tables


Columns = Mapping[str, Callable[[str], str]]
"""Cells of each competitor, by the title of the column."""
COST_NOTE = (
    "cost is the geometric mean of the ratios of the episodes' costs, which no single episode dominates; means "
    "that of the mean costs, which few lost tracks may dominate. A track is lost where an episode's mean cost is "
    "beyond the bound of the environment."
)
MEAN_COST_NOTE = "cost is the mean cost of a measurement."
RMSE_NOTE = "A wider terminal shows the intervals of the RMSE, too."


def _cost_columns(
    records: Sequence[Any], found: Mapping[Any, Any], paper: str
) -> tuple[dict[str, Any], list[str]]:
    """Return the columns on cost, consistency and time by title, and the notes that explain them."""
    columns: dict[str, Callable[[str], str]] = {
        cost_title(paper): lambda name: with_interval(
            found.get((name, HEADLINE, "", "all")), 100.0, negligible=0.005
        ),
        "cost": lambda name: with_interval(found.get((name, "cost", "", "all"))),
        "lost\ntracks, %": lambda name: paper_cells(found, name)[0],
        "means,\n%": lambda name: paper_cells(found, name)[1],
        "ANEES": lambda name: consistency(found.get((name, "anees", "state", "all"))),
    }
    compared = any(r.metric == HEADLINE and r.value is not None for r in records)
    for title in ["cost"] if compared else [cost_title(paper), "means,\n%"]:
        del columns[title]
    notes = [
        f"{COST_NOTE if compared else MEAN_COST_NOTE} ANEES is 1 if errors are as large as the covariance states; "
        f"{INCONSISTENT} marks one that is off "
        "by more than a factor of two.",
    ]
    if not any(r.metric == "lost_tracks" for r in records):
        del columns["lost\ntracks, %"]
    if any(r.metric == "score" and r.value is not None for r in records):
        columns["score"] = lambda name: score_text(found.get((name, "score", "", "all"))).partition(" [")[0]
        notes.append(
            f"score is 0 for {paper or 'the paper'} and 1 for the reference that it is measured against."
        )
    if times := column_of_times(records):
        columns[TIME_TITLE] = lambda name: times.get(name, "-")
        notes.append(TIME_NOTE)
        if any(time.endswith(OWN_MARK) for time in times.values()):
            notes.append(OWN_NOTE)
    lost = {r.policy: round(r.value * r.episodes) for r in records if r.metric == "lost_episodes" and r.value}
    if lost:
        columns["failed"] = lambda name: f"{lost.get(name, 0)}"
        notes.append(
            "failed counts episodes with an estimate that was not finite, or had no covariance; the last valid one is "
            "repeated."
        )
    return columns, notes


def _error_columns(records: Sequence[Any], found: Mapping[Any, Any], intervals: bool) -> dict[str, Any]:
    units = {r.component: r.unit for r in records if r.metric == "rmse"}

    def rmse(component: str, name: str) -> str:
        text = with_interval(found.get((name, "rmse", component, "all")))
        return text if intervals else text.partition(" [")[0]

    return {
        f"RMSE\n{component.replace('_', ' ')},{' ' if intervals else chr(10)}{units[component]}": functools.partial(
            rmse, component
        )
        for component in main_components(records)
    }


def _tables_below_each_other(
    draw: Callable[..., Table], costs: Columns, errors: Columns, width: int
) -> list[Table]:
    """Return a table of costs, and below it the errors, side by side if they fit, else a table each."""
    costs, errors = dict(costs), dict(errors)
    table = first_fitting([draw(costs, False, compact) for compact in (False, True)], width)
    if table is None:
        if TIME_TITLE in costs:
            errors = {TIME_TITLE: costs.pop(TIME_TITLE), **errors}
        table = draw(costs, False, compact=True)
    below = first_fitting([draw(errors, False, compact) for compact in (False, True)], width)
    each = [draw({title: error}, False, True) for title, error in errors.items()]
    return [table, *(each if below is None else [below])]


def first_fitting(tables: Iterable[Table], width: int) -> Table | None:
    """Return the first of some tables that fits into ``width`` columns; None if none does."""
    return next((table for table in tables if _widest(table) <= width), None)


def plain_table(title: str | None = None) -> Table:
    """Return an empty table in the style of all tables: one line below the head, two spaces between columns."""
    return Table(
        title=title,
        title_justify="left",
        caption_justify="left",
        box=rich.box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 0, 0, 1),
    )


def competitors_table(
    names: Sequence[tuple[str, str, str]],
    columns: Columns,
    control: bool,
    compact: bool = False,
    user_names: Collection[str] = (),
) -> Table:
    """Return a table with a row for each competitor, unranked ones in sections of their own, the user's marked."""
    table = plain_table()
    table.add_column("policy", overflow="fold")
    if control:
        table.add_column("control")
    for title in columns:
        table.add_column(title, justify="right", overflow="fold", no_wrap=compact)
    section = "ranked"
    for name, kind, steered in names:
        if kind not in RANKED and kind != section:
            table.add_section()
            section = kind
        control_column = steered if kind == "policy" else f"({kind})"
        marked = f"{OWN_ROW}\xa0{name}" if name in user_names else name  # no line holds the mark alone
        table.add_row(
            "\n".join(textwrap.wrap(marked, NARROW if compact else WIDE)).replace("\xa0", " "),
            *([control_column] if control else []),
            *(column(name) for column in columns.values()),
            style="bold" if name in user_names else None,
        )
    return table


def _widest(table: Table) -> int:
    return Measurement.get(_MEASURING, _MEASURING.options, table).maximum


_MEASURING = Console(width=10_000, file=io.StringIO(), markup=False, emoji=False)


HEAD = 10
"""Columns of a title over a column of short numbers."""
SHOWN_OF_FLIGHTS = 8
"""Number of competitors in a table of flights that fit side by side."""


def flights_table(
    dataset: Any, records: Sequence[Any], over_all: Sequence[Any], width: int = 10_000
) -> Table:
    """Return a table with a row for each flight: RMSE of the paper's algorithm, and others' cost against it.

    As many of the best competitors are shown as fit into ``width``.
    """
    tables = [_flights(dataset, records, over_all, shown) for shown in range(SHOWN_OF_FLIGHTS, 0, -1)]
    return first_fitting(tables, width) or tables[0]


def _flights(dataset: Any, records: Sequence[Any], over_all: Sequence[Any], most: int) -> Table:
    found = {(r.scenario, r.policy, r.metric, r.component): r for r in records}
    names = [name for name, kind, _ in rank_competitors(over_all) if kind in RANKED]
    shown, paper = main_components(over_all), dataset.attrs["paper"]
    base = paper if paper in names else [*names, *dataset["policy"].values.tolist()][0]
    every = [name for name in names if name != paper]
    others = every[:most]
    units = {r.component: r.unit for r in over_all if r.metric == "rmse"}
    flights, lengths = dataset["flight"].values, dataset["length"].values
    several = len(set(flights.tolist())) > 1
    what = "recording" if dataset.attrs["recorded"] else "flight"
    table = plain_table(f"{len(set(flights.tolist()))} {what}{'s' * several}")
    table.add_column(what, no_wrap=True)
    table.add_column("episodes", justify="right")
    table.add_column("measurements", justify="right")
    for component in shown:
        title = f"RMSE {component.replace('_', ' ')} of {base}, {units[component]}"
        table.add_column("\n".join(textwrap.wrap(title, HEAD)), justify="right")
    metric = HEADLINE if base == paper else "cost"
    for name in others:
        title = f"{name}, %" if base == paper else f"cost of {name}"
        table.add_column("\n".join(textwrap.wrap(title, HEAD)), justify="right")
    for scenario in dict.fromkeys(r.scenario for r in records):
        flight = scenario.removeprefix(f"{dataset.attrs['scenario']}: ")
        mine = flights == flight
        row = [flight, f"{mine.sum()}", f"{lengths[mine].sum():,}"]
        for name, number, component in [
            *((base, "rmse", c) for c in shown),
            *((o, metric, "") for o in others),
        ]:
            record = found.get((scenario, name, number, component))
            if record is None or record.value is None:
                row.append("-")
            elif number == HEADLINE:
                row.append(f"{100.0 * record.value:+.1f}")
            else:
                row.append(f"{record.value:.3g}")
        table.add_row(*row)
    notes = [f"%: cost against {base}."] if base == paper and others else []
    if len(others) < len(every):
        notes.append(f"The best {len(others)} of {len(every)} are shown; all stand in the records.")
    notes.append(
        f"Intervals of the table over all {what}s resample whole {what}s; of fewer than ten they are too narrow."
        if several
        else f"Intervals below are over {'time' if len(flights) == 1 else 'the episodes'} of this one {what}."
    )
    table.caption = " ".join(notes)
    table.caption_justify = "left"
    return table


def tuning_table(outcome: Tuned, start: Mapping[str, float]) -> Table:
    """Return a table of the tuned values beside the values from which the search started."""
    table = plain_table(f"{outcome.policy} on {outcome.scenario}")
    table.add_column("value")
    for title in ("untuned", "tuned"):
        table.add_column(title, justify="right")
    for name, value in outcome.values.items():
        table.add_row(name, f"{start[name]:g}", f"{value:g}")
    table.add_row("validation cost", f"{outcome.untuned_cost:.4g}", f"{outcome.cost:.4g}")
    return table
