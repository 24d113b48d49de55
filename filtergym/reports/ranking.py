"""Who is best in a scenario, of any control and kind, in words that follow from the records."""

from collections.abc import Sequence
from typing import NamedTuple

from ..agents.named_policies import shipped_agents
from ..baselines.catalogue import baselines_of
from ..evaluation.competitors import RANKED
from ..evaluation.metrics import Record
from .tables import with_interval

NEGLIGIBLE = 5e-5
"""Relative difference of costs that is rounding, or as good as none."""


class Place(NamedTuple):
    """A ranked competitor with what is said of it."""

    name: str
    role: str
    """"learned", "estimator" or "policy"."""
    cost: float
    behind: Record | None
    """Relative difference of its cost to the best one's."""


def ranking(records: Sequence[Record]) -> list[Place]:
    """Competitors of one environment and scenario that are ranked, lowest mean cost first."""
    learned = shipped_agents(records[0].environment)
    found = {(r.policy, r.metric): r for r in records if r.window == "all"}
    places = []
    for name, kind in dict.fromkeys((r.policy, r.kind) for r in records if r.kind in RANKED):
        record = found.get((name, "cost"))
        if record is not None and record.value is not None:
            role = "learned" if name in learned else kind
            places.append(Place(name, role, record.value, found.get((name, "behind_best"))))
    return sorted(places, key=lambda place: place.cost)


def verdict(records: Sequence[Record]) -> str:
    """Who is best of learned and classical competitors in a scenario, in two or three words.

    It rests on the paired difference between the best one and the best of the other origin: where its interval holds
    zero, nobody is called best.
    """
    best, *others = ranking(records)
    origin = "learned" if best.role == "learned" else "classical"
    rival = next((place for place in others if (place.role == "learned") != (origin == "learned")), None)
    if rival is None:
        return f"{origin} only"
    behind = rival.behind
    if behind is None or behind.low is None or behind.low <= 0.0:
        return "no significant difference"
    return f"{origin} best"


def ranking_sentence(records: Sequence[Record]) -> str:
    """Say who is best, by how much, and how the strongest of another origin stands to it."""
    first, paper = records[0], baselines_of(records[0].environment).score_paper
    found = {(r.policy, r.metric): r for r in records if r.window == "all"}
    best, *others = ranking(records)
    difference = found.get((best.name, "relative_cost_difference"))
    sentence = f"On `{first.scenario}` `{best.name}` ({best.role}) costs least"
    if best.name != paper and difference is not None and (difference.high or 0.0) > -NEGLIGIBLE:
        sentence += f", but not significantly less than `{paper}`"
    elif best.name != paper and difference is not None and difference.value is not None:
        median, wins = found[best.name, "median_cost_ratio"].value, found[best.name, "win_rate"].value
        sentence += f": {with_interval(difference, 100.0)} % against `{paper}`"
        if median is not None and wins is not None:
            sentence += (
                f", {100.0 * (median - 1.0):+.1f} % in the median, lower in {100.0 * wins:.0f} % of episodes"
            )
    was_learned = best.role == "learned"
    rival = next((place for place in others if (place.role == "learned") != was_learned), None)
    if rival is not None and rival.behind is not None:
        origin = "classical competitor" if was_learned else "learned agent"
        sentence += (
            f". The strongest {origin}, `{rival.name}`{'' if rival.role == 'learned' else f' ({rival.role})'}, costs "
            f"{with_interval(rival.behind, 100.0)} % more than it"
        )
        if rival.behind.low is not None and rival.behind.low <= 0.0:
            sentence += ", which is no significant difference"
    return sentence + "."
