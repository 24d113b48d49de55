"""The report: one self-contained HTML page of results, which opens offline and executes nothing of the file."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from ...evaluation.competitors.kinds import NOT_CAUSAL, RANKED
from ...evaluation.running.metrics import Record
from ...evaluation.running.times import (
    TIME_TITLE,
    column_of_times,
    front,
    points_of_records,
    times_of_records,
)
from ..tables.headline import headline
from ..tables.ranking import origin, ranking_sentence, remarks
from ..tables.results import Result, Settings, serialise_datasets
from ..tables.terminal_tables import (
    HEADLINE,
    consistency_word,
    main_components,
    paper_cells,
    rank_competitors,
    score_text,
    with_interval,
)
from .front_picture import front_images
from .html_page import pack, render_page
from .outcome import outcome_sentences, own_sentences, protocol_sentences
from .why_section import why_section, worst_data

WORDS = ("competitor", "covariance", "origin", "control")
"""Columns without numbers."""


class Entry(NamedTuple):
    """A cell of a table on the page: its text, and the value by which it is sorted."""

    text: str
    sorted_by: float | str | None = None
    """Key for sorting; None: last in any order."""


def report_html(results: Sequence[Result], settings: Settings) -> str:
    """Return the HTML page of a report on results of any environments and scenarios."""
    if not results:
        raise ValueError("there are no results to report")
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(result.environment, []).append(result)
    environments = [
        {
            "id": id,
            "anchor": f"e{number}",
            "dots": pack(_scenario_costs(group)) if len(group) > 1 else None,
            "paper": group[0].paper,
            "cells": [_cell(result, f"e{number}s{i}", group) for i, result in enumerate(group)],
        }
        for number, (id, group) in enumerate(groups.items())
    ]
    return render_page(
        "report.html.jinja",
        "report.js",
        own=[line for result in results for line in own_sentences(result.records, result.own, result.paper)],
        outcome=outcome_sentences(results),
        protocol=protocol_sentences(results),
        fronts=front_images(results),
        remarks=remarks(results),
        headline=headline(results),
        environments=environments,
        settings=settings,
        words=WORDS,
        not_causal=NOT_CAUSAL,
        first=results[0].records[0],
    )


def _cell(result: Result, anchor: str, group: Sequence[Result]) -> dict[str, Any]:
    first = result.records[0]
    header, rows = _table(result)
    return {
        "anchor": anchor,
        "result": result,
        "episodes": first.episodes,
        "split": first.split,
        "seed": first.seed,
        "sentence": ranking_sentence(result.records, result.paper, result.learned),
        "header": header,
        "rows": rows,
        "score": _score_sentence(result, "score" in header),
        "smoothers": list(dict.fromkeys(r.policy for r in result.records if r.kind == "smoother")),
        "why": why_section(result),
        "figures": list(_figures(result)),
        "data": pack(
            {
                "lines": _lines(result, group),
                "paper": result.paper,
                "ranking": _differences(result),
                "front": _front(result),
                "worst": worst_data(result),
                **serialise_datasets(result),
            }
        ),
    }


def _table(result: Result) -> tuple[list[str], list[list[Entry]]]:
    """Return header and rows of a scenario's competitors, lowest cost first, unranked ones last."""
    records = result.records
    found = {(r.policy, r.metric, r.component, r.window): r for r in records}
    shown = main_components(records)
    units = {r.component: r.unit for r in records if r.metric == "rmse"}

    def number(name: str, metric: str, component: str, scale: float = 1.0) -> Entry:
        record = found.get((name, metric, component, "all"))
        text = with_interval(record, scale, negligible=0.005 if scale == 100.0 else 0.0)
        return Entry(text, None if record is None else record.value)

    against = f"cost against {result.paper or 'paper'}, %"
    header = ["competitor", against, "lost tracks, %", "means, %", "ANEES", "covariance"]
    scored = any(r.metric == "score" and r.value is not None for r in records)
    header += ["score"] * scored
    times, texts = times_of_records(records), column_of_times(records)
    header += [TIME_TITLE] * bool(times)
    header += [f"RMSE {c.replace('_', ' ')}, {units[c]}" for c in shown]
    predicted = {r.component: r.unit for r in records if r.metric == "prediction_error"}
    for group, unit in predicted.items():
        header += [f"error of predicted {group}, {unit}", f"correlation of successive ones, {group}"]
    header += ["origin", "control"]
    rows = []
    for name, kind, control in rank_competitors(records):
        lost, means = paper_cells(found, name)
        nees = found.get((name, "anees", "state", "all"))
        value = None if nees is None else nees.value
        score = found.get((name, "score", "", "all"))
        rows.append(
            [
                Entry(name, name),
                number(name, HEADLINE, "", 100.0),
                Entry(lost, _number(lost.partition(" ")[0])),
                Entry(means, _number(means)),
                Entry("-" if value is None else f"{value:.3g}", value),
                Entry(consistency_word(nees), consistency_word(nees)),
                *[
                    Entry(score_text(score).partition(" [")[0], None if score is None else score.value)
                    for _ in range(scored)
                ],
                *[
                    Entry(texts.get(name, "-"), times[name].nanoseconds if name in times else None)
                    for _ in range(bool(times))
                ],
                *(number(name, "rmse", component) for component in shown),
                *(
                    number(name, metric, group)
                    for group in predicted
                    for metric in ("prediction_error", "innovation_correlation")
                ),
                Entry(origin(result, name, kind), origin(result, name, kind)),
                Entry(control if kind == "policy" else "", control if kind == "policy" else ""),
            ]
        )
    return header, rows


def _score_sentence(result: Result, scored: bool) -> str:
    if scored:
        return f"The score is 0 for `{result.paper}` and 1 for `{result.reference}`."
    if result.reference:
        return f"There is no score: `{result.reference}` is not significantly better than `{result.paper or 'none'}`."
    return "There is no score: no reference takes part."


def _number(text: str) -> float | None:
    try:
        return float(text.replace(",", ""))
    except ValueError:
        return None


def _differences(result: Result) -> list[list[Any]]:
    """Return name, origin, and cost against the paper's algorithm with interval, %, of each competitor."""
    found: dict[str, Record] = {
        r.policy: r for r in result.records if (r.metric, r.window) == (HEADLINE, "all")
    }
    rows = []
    for name, kind, _ in rank_competitors(result.records):
        record = found.get(name)
        if record is None or record.value is None or (kind not in RANKED and name != result.reference):
            continue
        low, high = (record.value if end is None else end for end in (record.low, record.high))
        rows.append([name, origin(result, name, kind), *(100.0 * x for x in (record.value, low, high))])
    return rows


def _front(result: Result) -> list[list[Any]]:
    """Return the rows of the picture of cost against time: name, origin, ns, cost in %, compiled, on the front."""
    points = points_of_records(result.records)
    on_front = front(points)
    return [
        [
            p.name,
            origin(result, p.name, p.kind),
            p.time.nanoseconds,
            p.cost,
            p.time.compiled,
            p.name in on_front,
        ]
        for p in points
        if p.kind in RANKED or p.name == result.reference
    ]


def _scenario_costs(group: Sequence[Result]) -> dict[str, Any]:
    """Return the data of the picture of cost in all scenarios of an environment."""
    shown = next((result for result in group if result.default), group[0])
    return {
        "paper": group[0].paper,
        "lines": [line for line in _lines(shown, group) if line["origin"] not in ("bound", "smoother")],
        "scenarios": [
            [result.scenario, "training" if result.training else "held out", _differences(result)]
            for result in group
        ],
    }


def _lines(result: Result, group: Sequence[Result]) -> list[dict[str, Any]]:
    """Return name, origin and colour number of each drawn competitor, the same in all scenarios."""
    names: dict[str, str] = {}
    for one in [*(other for other in group if other.default), *group]:
        kinds = {record.policy: record.kind for record in one.records}
        present = [] if one.curves is None else [str(name) for name in one.curves["policy"].values.tolist()]
        for name in present:
            names.setdefault(name, origin(one, name, kinds.get(name, "policy")))
    # Learned ones first: there are fewer colours than names.
    coloured = sorted(
        (
            name
            for name, where in names.items()
            if where not in ("yours", "paper", "reference", "bound", "smoother")
        ),
        key=lambda name: names[name] != "learned",
    )
    own = names if result.curves is None else map(str, result.curves["policy"].values.tolist())
    return [
        {
            "name": name,
            "origin": names[name],
            "colour": coloured.index(name) if name in coloured else None,
        }
        for name in own
    ]


class Figure(NamedTuple):
    """Title and texts of a figure of a scenario; the page's script draws it."""

    kind: str
    """Kind, by which the page's script draws it."""
    title: str
    text: str
    """Description below the figure."""
    alternative: str
    """Text for readers who do not see the figure."""


def _figures(result: Result) -> Iterator[Figure]:
    """Yield title and text of each figure of a scenario for which the results contain data."""
    found = {(r.policy, r.metric, r.component): r for r in result.records if r.window == "all"}
    order = [name for name, kind, _ in rank_competitors(result.records) if kind in RANKED]

    def in_words(metric: str, component: str) -> str:
        parts = []
        for name in order[:6]:
            record = found.get((name, metric, component))
            if record is not None and record.value is not None:
                parts.append(f"{name} {record.value:.3g}{'' if record.unit == '1' else ' ' + record.unit}")
        return ", ".join(parts)

    if _differences(result):
        yield Figure(
            "ranking",
            f"Cost against {result.paper or 'the paper'}",
            "Geometric mean of the ratios of the episodes' costs, less one, with its paired 95 % interval; "
            "left of zero is better.",
            "The table above contains these numbers.",
        )
    if points := points_of_records(result.records):
        yield Figure(
            "front",
            "Cost and time",
            "Cost against the competitor's processor time of a measurement. No other competitor has a lower error cost "
            "in as much time as those on the front, the line; open: in Python, not compiled.",
            f"On the front, the quickest first: {', '.join(front(points))}.",
        )
    curves = set() if result.curves is None else {str(name) for name in result.curves}
    if result.curves is not None and "rmse" in curves:
        component = str(result.curves["quantity"].values[0])
        yield Figure(
            "rmse",
            "Error over time",
            "Root mean square over episodes, with 95 % bands. A click on a name shows it alone, a second one all "
            "again.",
            f"RMSE of {component} over the whole run: {in_words('rmse', component)}.",
        )
        yield Figure(
            "exceeded",
            "Distribution of errors",
            "Share of measurements whose error is larger.",
            f"Largest RMSE at any time: {in_words('peak_rmse', component)}.",
        )
    if {"cost_minus_paper", "cost_minus_best"} & curves:
        yield Figure(
            "difference",
            "Mine minus theirs over time",
            "Mean cost less that of another on the same episodes, with paired 95 % bands; below zero is better.",
            "The difference over the whole run stands in the table above.",
        )
    if {"anees", "anis"} & curves:
        yield Figure(
            "consistency",
            "Consistency",
            "Mean of the normalised squared error (NEES) or innovation (NIS) over its dimension. One is consistent; "
            "the band holds 95 % of a consistent estimator's (chi-square).",
            f"Mean NEES over its dimension: {in_words('anees', 'state')}.",
        )
    if BEHAVIOUR_CURVES & curves:
        yield Figure(
            "steering",
            "Gains, weights and actions over time",
            "Mean over episodes; bands hold 95 % of the mean of a probability, and eight of ten episodes of an action "
            "or a gain.",
            "The page of the environment describes the action of each competitor.",
        )
    if result.track is not None:
        yield Figure(
            "track",
            "A track to look at",
            f"The first episode (seed {result.track.attrs.get('seed', '?')}), not selected: truth, "
            "measurements, estimates, and their covariances at two standard deviations. Move the slider.",
            "An animation of one episode; its numbers are in the table above, over all episodes.",
        )
    if any(one.track is not None for one in result.worst):
        yield Figure(
            "worst",
            "The worst episodes",
            "Those that cost a competitor most, beside its opponent: truth, measurements, estimates, "
            "and their covariances at two standard deviations. The slider begins where the error is largest.",
            "An animation of single episodes; the tables of the causes contain their seeds and costs.",
        )


BEHAVIOUR_CURVES = {"mode_probability", "true_class_probability", "action", "gain"}
"""Curves of the competitors' actions."""
