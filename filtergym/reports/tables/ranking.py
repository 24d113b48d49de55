"""Who is best in a scenario, of any control and kind, in words that follow from the records."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from ...evaluation.competitors.kinds import RANKED
from ...evaluation.running.metrics import NEGLIGIBLE, Record
from ...names import learned_names
from .results import Result
from .terminal_tables import HEADLINE, INCONSISTENT_WORDS, consistency_word, with_interval

HARM = 0.02
"""Relative difference to the paper's algorithm beyond which, with its whole interval, a competitor does harm."""


class Place(NamedTuple):
    """A ranked competitor with what is said of it."""

    name: str
    role: str
    """"learned", "estimator" or "policy"."""
    cost: float
    behind: Record | None
    """Relative difference of its cost to the best one's."""
    chosen: float
    """Share of resamples of the episodes that would call it the best; NaN where it is not known."""


def ranking(records: Sequence[Record], learned: Sequence[str] | None = None) -> list[Place]:
    """Competitors of one environment and scenario that are ranked, lowest geometric mean of the cost first.

    Those that are as good as equal to the lowest stand in the order of the records, which is the catalogue's: a filter
    comes before what is made of it.

    Args:
        records: of the scenario.
        learned: names of those that were learned; default: the environment's shipped agents.
    """
    learned = learned_names(records[0].environment) if learned is None else learned
    found = {(r.policy, r.metric): r for r in records if r.window == "all"}
    places = []
    for name, kind in dict.fromkeys((r.policy, r.kind) for r in records if r.kind in RANKED):
        record, share = found.get((name, "geometric_cost")), found.get((name, "best_share"))
        if record is not None and record.value is not None:
            role = "learned" if name in learned else kind
            chosen = math.nan if share is None or share.value is None else share.value
            places.append(Place(name, role, record.value, found.get((name, "behind_best")), chosen))
    equal = (1.0 + NEGLIGIBLE) * min((place.cost for place in places), default=0.0)
    return sorted(places, key=lambda place: max(place.cost, equal))


def rival_of(places: Sequence[Place]) -> Place | None:
    """Return the strongest competitor of another origin than the first, learned or classical; None where there is none.

    Args:
        places: of :func:`ranking`, one at least.
    """
    was_learned = places[0].role == "learned"
    return next((place for place in places if (place.role == "learned") != was_learned), None)


def who_is_best(records: Sequence[Record], learned: Sequence[str] | None = None) -> str:
    """Who is best of learned and classical competitors in a scenario, in two or three words.

    It rests on the paired ratio between the best one and the best of the other origin: where its interval holds one,
    nobody is called best.
    """
    places = ranking(records, learned)
    if not places:
        return "nothing is ranked"
    where = "learned" if places[0].role == "learned" else "classical"
    rival = rival_of(places)
    if rival is None:
        return f"{where} only"
    behind = rival.behind
    if behind is None or behind.low is None or behind.low <= 0.0:
        return "no significant difference"
    return f"{where} best"


def ranking_sentence(records: Sequence[Record], paper: str, learned: Sequence[str] | None = None) -> str:
    """Say who is best, by how much, and how the strongest of another origin stands to it.

    Args:
        records: of the scenario.
        paper: name of the paper's algorithm.
        learned: as of :func:`ranking`.
    """
    first = records[0]
    found = {(r.policy, r.metric): r for r in records if r.window == "all"}
    places = ranking(records, learned)
    if not places:
        return f"On `{first.scenario}` nothing is ranked."
    best, rival = places[0], rival_of(places)
    difference = found.get((best.name, HEADLINE))
    sentence = f"On `{first.scenario}` `{best.name}` ({best.role}) has the lowest error cost"
    if best.name != paper and difference is not None and (difference.high or 0.0) > -NEGLIGIBLE:
        sentence += f", but not significantly less than `{paper}`"
    elif best.name != paper and difference is not None and difference.value is not None:
        sentence += f": {with_interval(difference, 100.0)} % against `{paper}`"
        means, lost = (
            found.get((best.name, metric)) for metric in ("relative_cost_difference", "lost_tracks")
        )
        if means is not None and means.value is not None:
            sentence += f" ({100.0 * means.value:+.1f} % of the means)"
        if lost is not None and lost.value:
            sentence += f", {with_interval(lost, 100.0, digits=2)} % of its tracks are lost"
    if best.chosen < 1.0:
        sentence += f". Other episodes of the kind would name another one in {_share(1.0 - best.chosen)}"
    if rival is not None and rival.behind is not None:
        origin = "classical competitor" if best.role == "learned" else "learned agent"
        sentence += (
            f". The strongest {origin}, `{rival.name}`{'' if rival.role == 'learned' else f' ({rival.role})'}, costs "
            f"{with_interval(rival.behind, 100.0)} % more than it"
        )
        if rival.behind.low is not None and rival.behind.low <= 0.0:
            sentence += ", which is no significant difference"
    return sentence + "."


def _share(share: float) -> str:
    """Per cent of the resamples, of which there are a thousand."""
    return f"{100.0 * share:.1f} % of cases" if share >= 0.001 else "less than 0.1 % of cases"


def origin(result: Result, name: str, kind: str) -> str:
    """Return where a competitor comes from.

    "paper", its algorithm; "classical", another policy that steers the environment's filters; "estimator", filters of
    its own; "learned", policy or estimator; "smoother", which uses later measurements; "reference", who knows the
    truth; or "bound".
    """
    if name == result.paper:
        return "paper"
    if name in result.learned:
        return "learned"
    return "classical" if kind == "policy" else kind


def best_of_origins(result: Result) -> list[tuple[str, str]]:
    """Return origin and name of the best of every origin: the ranked by their cost, then the reference."""
    kinds = {record.policy: record.kind for record in result.records}
    best: dict[str, str] = {}
    for place in ranking(result.records, result.learned):
        best.setdefault(origin(result, place.name, kinds[place.name]), place.name)
    if result.reference:
        best["reference"] = result.reference
    return list(best.items())


def remarks(results: Sequence[Result]) -> list[str]:
    """Say which learned agents do harm, and whether the winners' covariances are honest.

    Args:
        results: of one or several environments.
    """
    sentences = []
    usual = [result for result in results if result.default] or list(results)
    judged = [result for result in usual if ranking(result.records, result.learned)]
    harmful = [harm for result in results for harm in _harms(result)]
    agents = {(result.environment, name) for result in results for name in result.learned}
    if agents:
        cells = sum(len(result.learned) for result in results)
        sentences.append(
            f"{len(harmful) or 'None'} of {cells} results of learned agents {'is' if len(harmful) == 1 else 'are'} "
            f"significantly worse than the paper's algorithm by more than {100.0 * HARM:g} %"
            + (f"; the worst is {max(harmful)[1]}." if harmful else ".")
        )
    off = [
        f"`{name}` in {result.short} ({with_interval(nees)})"
        for result in judged
        for name in [ranking(result.records, result.learned)[0].name]
        if (nees := _nees(result, name)) is not None and consistency_word(nees).endswith(INCONSISTENT_WORDS)
    ]
    if judged:
        sentences.append(
            "The covariance of every winner is as large as its errors."
            if not off
            else f"Of the winners, {len(off)} of {len(judged)} {'states' if len(off) == 1 else 'state'} a covariance "
            f"that does not fit the errors (mean NEES over its dimension, which should be one): {', '.join(off)}."
        )
    return sentences


def _nees(result: Result, name: str) -> Record | None:
    for record in result.records:
        if (record.policy, record.metric, record.component, record.window) == (name, "anees", "state", "all"):
            return record
    return None


def _harms(result: Result) -> list[tuple[float, str]]:
    """Learned agents that cost significantly more than the paper's algorithm: how much, and in words."""
    return [
        (r.value or 0.0, f"`{r.policy}` in {result.short} `{r.scenario}`, {with_interval(r, 100.0)} %")
        for r in result.records
        if r.policy in result.learned and (r.metric, r.window) == (HEADLINE, "all") and (r.low or 0.0) > HARM
    ]
