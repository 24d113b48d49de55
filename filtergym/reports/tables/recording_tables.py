"""Tables of the competitors' predictions of a recording's measurements, for the terminal."""

import functools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from rich.table import Table

from .terminal_tables import competitors_table, first_fitting, with_interval

LIKELIHOOD = (
    "log-likelihood: of a measurement under its prediction, mean, nats; the higher the better, if errors are white; "
    "less: paired difference from the best. Mean NIS: normalised innovation squared over its dimension; in the band if "
    "innovations are as large as predicted; - : not reported."
)
PREDICTIONS = (
    "Error of prediction: RMSE of a measurement's prediction from the estimate before it. Correlation: of successive "
    "innovations, 0 where they are white."
)


def recording_tables(
    records: Sequence[Any],
    differences: Mapping[str, Any],
    has_truth: bool,
    width: int,
    user_names: Collection[str] = (),
) -> list[Table]:
    """Return tables that compare competitors by their predictions of a recording's measurements.

    ``differences`` are those of the log-likelihood per measurement to the best's; columns that do not fit
    into ``width`` stand below; rows of ``user_names`` are marked.
    """
    found = {(r.policy, r.metric, r.component): r for r in records if r.window == "all"}

    def likelihood(name: str) -> float:
        record = found.get((name, "log_likelihood", "measurement"))
        return math.inf if record is None or record.value is None else -record.value

    entries = dict.fromkeys((r.policy, r.kind, r.control) for r in records if r.kind != "smoother")
    names = sorted(entries, key=lambda entry: likelihood(entry[0]))
    bands = {_band(record) for (_, metric, _), record in found.items() if metric == "anis_band"} - {"-"}
    parts = [
        _likelihood_columns(found, differences),
        _consistency_columns(found, len(bands) == 1),
        _prediction_columns(records, found),
    ]
    parts = [part for part in parts if part]
    tables = _beside(functools.partial(competitors_table, names, user_names=user_names), parts, width)
    first = records[0]
    episodes = f"{first.episodes} episode{'s' if first.episodes > 1 else ''}"
    tables[0].title = f"{first.environment}, recording {first.scenario} ({episodes}; 95 % intervals)"
    notes = (
        [LIKELIHOOD] if has_truth else ["There is no truth, so there are no errors and no costs.", LIKELIHOOD]
    )
    notes += [f"{PREDICTIONS} Intervals are over stretches of measurements."] if len(parts) > 2 else []
    notes += [f"95 % band of the mean NIS: {bands.pop()}."] if len(bands) == 1 else []
    if any(record.kind == "smoother" for record in records) and not has_truth:
        notes.append(
            "A smoother makes no predictions: --estimates writes its estimates, with their deviations."
        )
    tables[-1].caption = "\n".join(notes)
    return tables


Column = Callable[[str], str]


def _beside(draw: Callable[..., Table], parts: Sequence[Mapping[str, Column]], width: int) -> list[Table]:
    """Return tables of groups of columns: as many groups in one as fit into ``width``, the rest below."""
    for count in range(len(parts), 0, -1):
        columns = {title: column for part in parts[:count] for title, column in part.items()}
        looks = [draw(columns, control) for control in (True, False)]
        looks.append(draw(columns, False, compact=True))
        table = first_fitting(looks, width)
        if table is not None or count == 1:
            return [table or looks[-1], *_beside(draw, parts[count:], width)]
    return []


Found = Mapping[tuple[str, str, str], Any]
"""Records by competitor, metric and component."""


def _rounded(estimate: Any, digits: int) -> str:
    if estimate is None or estimate.value is None or math.isnan(estimate.value):
        return "-"
    low, high = estimate.low, estimate.high
    text = f"{estimate.value:+.{digits}f}"
    if low is None or math.isnan(low) or low == high:
        return text
    return f"{text} [{low:+.{digits}f}, {high:+.{digits}f}]"


def _likelihood_columns(found: Found, differences: Mapping[str, Any]) -> dict[str, Column]:
    return {
        "log-\nlikelihood": lambda name: with_interval(found.get((name, "log_likelihood", "measurement"))),
        "less": lambda name: _rounded(differences.get(name), 3),
    }


def _band(record: Any) -> str:
    return "-" if record is None or record.low is None else f"{record.low:.3g} to {record.high:.3g}"


def _consistency_columns(found: Found, has_one_band: bool) -> dict[str, Column]:
    columns: dict[str, Column] = {
        "mean NIS": lambda name: with_interval(found.get((name, "anis", "measurement"))),
    }
    if not has_one_band:
        columns["95 % band"] = lambda name: _band(found.get((name, "anis_band", "measurement")))
    columns["inside\n95 %, %"] = lambda name: with_interval(
        found.get((name, "nis_inside", "measurement")), 100.0
    )
    return columns


def _prediction_columns(records: Sequence[Any], found: Found) -> dict[str, Column]:
    groups = {r.component: r.unit for r in records if r.metric == "prediction_error"}

    def error(group: str, name: str) -> str:
        return with_interval(found.get((name, "prediction_error", group)))

    def correlation(group: str, name: str) -> str:
        return _rounded(found.get((name, "innovation_correlation", group)), 2)

    columns: dict[str, Column] = {}
    for group, unit in groups.items():
        columns[f"error of prediction,\n{group}, {unit}"] = functools.partial(error, group)
        title = "correlation" if len(groups) == 1 else f"correlation,\n{group}"
        columns[title] = functools.partial(correlation, group)
    return columns
