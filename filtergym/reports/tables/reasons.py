"""Causes of a competitor's cost, as sentences and as a table."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy

from ...evaluation.competitors.kinds import RANKED
from ...evaluation.running.metrics import Record
from ...evaluation.statistics.cause_split import CAUSE_METRICS, EVERYTHING, reason_weight
from .terminal_tables import rank_competitors, with_interval

MOST_REASONS = 3
"""Largest number of sentences about one competitor."""
LEAST_EXCESS = 0.05
"""Share of the cost beyond the share of the measurements from which a cause is a reason."""


class Reason(NamedTuple):
    """A competitor's cost under one cause: shares of measurements and cost, ANEES, ratio to an opponent."""

    cause: str
    measurements: Record
    """Share of the measurements under the cause."""
    share: Record
    """Share of the cost under the cause."""
    cost: Record
    """Mean cost of a measurement under the cause."""
    anees: Record | None
    ratio: Record | None
    """Ratio of this cost to that of the opponent, whom the component names."""

    @property
    def excess(self) -> float:
        """Share of the cost beyond the share of the measurements."""
        return (self.share.value or 0.0) - (self.measurements.value or 0.0)

    @property
    def weight(self) -> float:
        """Weight by which causes are ordered, see :func:`.evaluation.statistics.cause_split.reason_weight`."""
        shares = (numpy.array(record.value or 0.0) for record in (self.share, self.measurements))
        return float(reason_weight(*shares))


def reasons_of(records: Sequence[Record], name: str) -> list[Reason]:
    """Return the cost of a competitor under each cause, the whole cost first; empty where costs are not split."""
    found: dict[str, dict[str, Record]] = {}
    for r in records:
        if r.policy == name and r.metric.startswith(CAUSE_METRICS) and r.value is not None:
            found.setdefault(r.window, {})[r.metric.removeprefix(CAUSE_METRICS)] = r
    needed = {"measurement_share", "cost_share", "cost"}
    return [
        Reason(
            cause,
            own["measurement_share"],
            own["cost_share"],
            own["cost"],
            own.get("anees"),
            own.get("cost_ratio"),
        )
        for cause, own in found.items()
        if needed <= own.keys()
    ]


def largest_reasons(reasons: Sequence[Reason]) -> list[Reason]:
    """Return the causes of largest weight whose share of the cost clearly exceeds that of the measurements."""
    causes = [reason for reason in reasons if reason.cause != EVERYTHING and reason.excess >= LEAST_EXCESS]
    return sorted(causes, key=lambda reason: -reason.weight)[:MOST_REASONS]


def reason_sentences(records: Sequence[Record], phrases: Mapping[str, str], name: str) -> list[str]:
    """Return short sentences on where most of a competitor's cost falls; ``phrases`` states when causes hold."""
    reasons = reasons_of(records, name)
    if not reasons:
        return []
    sentences = []
    for reason in largest_reasons(reasons):
        first = (
            f"{name}: {_percent(reason.share)} of its cost falls {phrases.get(reason.cause, reason.cause)}"
        )
        sentence = f"{first}, {_percent(reason.measurements)} of the measurements"
        if reason.ratio is not None:
            sentence += f"; there it costs {_times(reason.ratio)}"
        sentences.append(f"{sentence}.")
    return sentences or [f"{name}: no cause holds much more of its cost than of the measurements."]


def _percent(record: Record) -> str:
    return f"{100.0 * (record.value or 0.0):.0f} %"


def _times(record: Record) -> str:
    """Return the ratio to the opponent's cost as text: ``2.3 times imm [1.9, 2.8]``."""
    value, _, interval = with_interval(record, digits=2).partition(" ")
    return f"{value} times {record.component}" + (f" {interval}" if interval else "")


def default_explained(records: Sequence[Record], names: Sequence[str], paper: str) -> list[str]:
    """Return the name of the competitor whose cost is explained by default, in a list of at most one.

    The first ranked one of ``names``, those of the command line; else the paper's algorithm, else the cheapest.
    """
    ranked = [name for name, kind, _ in rank_competitors(records) if kind in RANKED]
    wanted = [name for name in [*names, paper, *ranked] if name in ranked]
    return wanted[:1]
