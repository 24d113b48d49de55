"""The outcome of a benchmark: one sentence for each environment, for readers new to this package."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

from ...evaluation.competitors.kinds import RANKED
from ...evaluation.running.metrics import Record
from ...evaluation.running.times import METRIC, is_quicker, times_of_records
from ..tables.ranking import find_record, ranking, rival_of
from ..tables.results import Result
from ..tables.terminal_tables import HEADLINE, consistency_word

HALF = (0.45, 0.55)
"""Range of the cost ratio that sentences call "half"."""


def outcome_sentences(results: Sequence[Result]) -> list[str]:
    """Return a sentence for each environment on its best competitor against the paper's algorithm.

    Learned and classical competitors are compared, too; two are level where the interval of their paired difference
    contains zero. Only results of training distributions are used, if there are any.
    """
    usual = [result for result in results if result.default] or list(results)
    return [sentence_of(result) for result in usual if ranking(result.records)]


def own_sentences(records: Sequence[Record], user_names: Sequence[str], paper: str) -> list[str]:
    """Return a sentence for each of the user's competitors: cost against the paper's algorithm and the best, ANEES."""
    return [
        _own_sentence(records, name, paper)
        for name in user_names
        if find_record(records, name, "geometric_cost")
    ]


def _own_sentence(records: Sequence[Record], name: str, paper: str) -> str:
    against = find_record(records, name, HEADLINE)
    behind = find_record(records, name, "behind_best")
    compared = [] if against is None or against.value is None else [(against, paper)]
    if behind is not None and behind.component not in (name, paper):
        compared.append((behind, behind.component))
    clauses = [_comparison(record, f"`{other}`", not i) for i, (record, other) in enumerate(compared)]
    places = ranking(records)
    if places and places[0].policy == name and len(places) > 1:
        clauses.append(f"the lowest of all {len(places)}")
    if not clauses:
        cost = find_record(records, name, "cost")
        clauses = [f"error cost {cost.value:.3g}, compared with none" if cost and cost.value else "no cost"]
    nees = find_record(records, name, "anees", "state")
    covariance = "states no covariance"
    if nees is not None and nees.value is not None:
        word = consistency_word(nees)
        covariance = f"{'' if word == 'no interval' else f'{word}, '}ANEES {float(f'{nees.value:.3g}'):,.10g}"
    return f"`{name}`: {', '.join(clauses)}; {covariance}."


def _comparison(difference: Record, other: str, first: bool) -> str:
    """Return a clause on a paired cost difference: ``level with NAME``, or ``3.1 % less than NAME``."""
    value = difference.value or 0.0
    if _low(difference) <= 0.0 <= _high(difference):
        return f"level with {other}"
    if value >= 1.0:
        return f"{float(f'{1.0 + value:.2g}'):,.10g} times {'the error cost' if first else 'that'} of {other}"
    what = " error cost" if first else ""
    return f"{100.0 * abs(value):.1f} % {'more' if value > 0.0 else 'less'}{what} than {other}"


def protocol_sentences(results: Sequence[Result]) -> list[str]:
    """Return sentences on episodes, split, seed and statistics of the comparison; empty without records."""
    records = [result.records[0] for result in results if result.default or not _any_default(results)]
    if not records:
        return []
    episodes = sorted({record.episodes for record in records})
    first = records[0]
    each = " to ".join(f"{number:,}" for number in dict.fromkeys((episodes[0], episodes[-1])))
    return [
        f"Every competitor met the same {each} episodes of an environment ({first.split} split, seed {first.seed}). "
        "Ranges hold 95 %; competitors are level where that of their ratio contains one. Error cost is the mean "
        "squared error of the estimate, in a control loop the loop's quadratic cost; its ratios are geometric means "
        "over the episodes, which no single one dominates; times are of one processor core."
    ]


def _any_default(results: Sequence[Result]) -> bool:
    return any(result.default for result in results)


def sentence_of(result: Result) -> str:
    """Return the outcome sentence on one environment and scenario with at least one ranked competitor."""
    places = ranking(result.records)
    first = _best_clause(result, places[0])
    rival = rival_of(places, result.learned)
    if rival is None:
        if result.learned:
            return f"{_subject(result)}: {first}."
        return f"{_subject(result)}: {first}; no learned competitor takes part."
    origin = "learned" if rival.policy in result.learned else "classical"
    clause = f"the best {origin} one, `{rival.policy}`, "
    behind = find_record(result.records, rival.policy, "behind_best")
    if behind is None or behind.value is None:
        clause += "costs more"
    elif behind.low is None or behind.high is None or behind.low <= 0.0:
        clause += "is level with it"
    elif behind.value >= 1.0:
        times, low, high = (f"{1.0 + share:.2g}" for share in (behind.value, behind.low, behind.high))
        clause += f"costs {times} times as much ({low} to {high} times)"
    else:
        clause += f"is {_percent(behind.value)} % behind it ({_range(behind.low, behind.high)})"
    lead = find_lead(result.records, result.learned, origin)
    if lead is None and find_lead(_without_spread(result.records), result.learned, origin) is not None:
        clause += "; the times of this run are too uncertain to be compared"
    if lead is not None:
        place = f"where a measurement may take {_times(lead)}"
        if lead.name == rival.policy:
            clause += f", and leads {place}"
        else:
            clause += f"; {place}, the {origin} `{lead.name}` leads"
    return f"{_subject(result)}: {first}; {clause}."


def _subject(result: Result) -> str:
    return result.short if result.default else f"{result.short}, scenario `{result.scenario}`"


def _best_clause(result: Result, best: Record) -> str:
    """Return a clause on the competitor of the lowest error cost, and on its difference to the paper's algorithm."""
    if best.policy == result.paper:
        return f"the paper's `{best.policy}` has the lowest error cost"
    what = "learned" if best.policy in result.learned else "classical"
    name = f"the {what} {'filter' if best.kind == 'estimator' else 'policy'} `{best.policy}`"
    found = find_record(result.records, best.policy, HEADLINE)
    if found is None or found.value is None or not result.paper:
        return f"{name} has the lowest error cost"
    paper = f"the paper's `{result.paper}`"
    low, high = (found.value if end is None else end for end in (found.low, found.high))
    if high >= 0.0:
        return f"{name} is level with {paper}"
    less = _range(-high, -low)
    if HALF[0] <= 1.0 + found.value <= HALF[1]:
        return f"{name} has half the error cost of {paper} ({less} less)"
    return f"{name} has {_percent(-found.value)} % less error cost than {paper} ({less})"


def _without_spread(records: Sequence[Record]) -> list[Record]:
    """Return records whose times have no interval."""
    return [r._replace(low=None, high=None) if r.metric == METRIC else r for r in records]


class Lead(NamedTuple):
    """A range of times per measurement in which the cheapest of one origin costs less than the other's."""

    name: str
    """Name of the leader where the most time is allowed."""
    first: float
    """Shortest of these times, ns."""
    last: float
    """Longest of these times, ns: that of the competitor that ends the lead."""


def find_lead(records: Sequence[Record], learned: Sequence[str], origin: str) -> Lead | None:
    """Return the range of times in which an origin leads, though the other one has the lowest cost.

    A competitor leads where the interval of its cost against the paper's algorithm lies below that of the cheapest of
    the other origin that may take no more time (:func:`.times.is_quicker`): a stricter test than that of their paired
    difference, which records contain only against the best.

    The longest such range; None where ``origin`` ("learned" or "classical") leads nowhere, or times are
    unknown.
    """
    times = times_of_records(records)
    costs = {
        r.policy: r
        for r in records
        if (r.metric, r.window) == (HEADLINE, "all") and r.kind in RANKED and r.value is not None
    }
    known = [place.policy for place in ranking(records) if place.policy in times and place.policy in costs]
    allowed = {times[name].nanoseconds: times[name] for name in known}
    lead: Lead | None = None
    for first, last in itertools.pairwise([*sorted(allowed), math.inf]):
        # Names are in the order of their cost.
        mine, other = (
            next(
                (
                    name
                    for name in known
                    if ((name in learned) == (origin == "learned")) is own
                    and (
                        times[name].nanoseconds <= first
                        if own
                        else not is_quicker(allowed[first], times[name])
                    )
                ),
                None,
            )
            for own in (True, False)
        )
        if mine is None or other is None or not _high(costs[mine]) < _low(costs[other]):
            continue
        begins = lead.first if lead is not None and lead.last == first else first
        lead = Lead(mine, begins, last)
    return lead


def _low(record: Record) -> float:
    return record.value or 0.0 if record.low is None else record.low


def _high(record: Record) -> float:
    return record.value or 0.0 if record.high is None else record.high


def _percent(share: float) -> str:
    """Return a share as a percentage in two digits, or in three near 100."""
    percent = 100.0 * share
    digits = 1 if abs(percent) < 9.95 or 99.0 <= percent < 100.0 else 0
    return f"{percent:,.{digits}f}"


def _range(low: float, high: float) -> str:
    return f"{_percent(low)} to {_percent(high)} %"


def _times(lead: Lead) -> str:
    first, last = (_nanoseconds(end) for end in (lead.first, lead.last))
    return f"at least {first} ns" if math.isinf(lead.last) else f"{first} to {last} ns"


def _nanoseconds(time: float) -> str:
    return "" if math.isinf(time) else f"{float(f'{time:.2g}'):,.0f}"
