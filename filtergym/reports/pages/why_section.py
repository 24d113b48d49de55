"""The part of a report on causes: cost and consistency by cause, and the worst episodes."""

from collections.abc import Mapping
from typing import Any

from ...evaluation.statistics.cause_split import EVERYTHING
from ..tables.reasons import Reason, reason_sentences, reasons_of
from ..tables.results import Result, WorstTrack, serialise_track
from ..tables.terminal_tables import with_interval


def why_section(result: Result) -> list[dict[str, Any]]:
    """Return the page's data on every competitor whose cost is split by cause, explained ones first."""
    names = dict.fromkeys([*result.explained, *(record.policy for record in result.records)])
    found = []
    for name in names:
        reasons = reasons_of(result.records, name)
        if not reasons:
            continue
        opponents = [reason.ratio.component for reason in reasons if reason.ratio is not None]
        against = f"cost over that of {opponents[0]}" if opponents else ""
        found.append(
            {
                "name": name,
                "open": name in result.explained,
                "sentences": reason_sentences(result.records, result.causes, name),
                "header": [
                    "measurements, %",
                    "cost, %",
                    "mean cost",
                    "ANEES",
                    *([against] if against else []),
                ],
                "rows": [_row(result, reason, bool(against)) for reason in reasons],
                "worst": [_worst_row(result, one) for one in result.worst if one.policy == name],
                "recorded": result.curves is not None and bool(result.curves.attrs.get("recorded")),
                "opponent": opponents[0] if opponents else "",
            }
        )
    return found


def _row(result: Result, reason: Reason, against: bool) -> tuple[str, str, list[str]]:
    numbers = [
        with_interval(reason.measurements, 100.0, negligible=0.005),
        with_interval(reason.share, 100.0, negligible=0.005),
        with_interval(reason.cost),
        with_interval(reason.anees),
        *([with_interval(reason.ratio)] if against else []),
    ]
    if reason.cause == EVERYTHING:
        return "everything", "", numbers
    return reason.cause, result.causes.get(reason.cause, ""), numbers


def _worst_row(result: Result, one: WorstTrack) -> list[str]:
    ratio = "-" if one.ratio is None else f"{one.ratio:.3g}"
    return [one.seed, f"{one.cost:.4g}", ratio, main_causes_in_words(one, result.causes)]


def main_causes_in_words(one: WorstTrack, phrases: Mapping[str, str]) -> str:
    """Return the main causes of an episode's cost as text; ``phrases`` states each cause in words."""
    return ", ".join(phrases.get(cause, cause) for cause in one.causes) or "under no cause in particular"


def worst_data(result: Result) -> list[dict[str, Any]]:
    """Return the worst episodes with a track, as data of the page's figure."""
    return [
        {
            "policy": one.policy,
            "opponent": one.opponent,
            "seed": one.seed,
            "cost": f"{one.cost:.4g}",
            "track": serialise_track(one.track),
        }
        for one in result.worst
        if one.track is not None
    ]
