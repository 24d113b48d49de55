"""Ranking of competitors of any control and kind in a scenario, with sentences that follow from the records."""

from collections.abc import Sequence

from ...evaluation.competitors.kinds import RANKED
from ...evaluation.running.metrics import NEGLIGIBLE, Record
from ...names import learned_names
from .results import Result
from .terminal_tables import HEADLINE, INCONSISTENT_WORDS, consistency_word, with_interval

HARM = 0.02
"""Relative difference to the paper's algorithm beyond which, with its whole interval, a competitor does harm."""


def find_record(
    records: Sequence[Record], name: str, metric: str, component: str | None = None
) -> Record | None:
    """Return a competitor's record of a metric over all times, of a component (None: any); None: no record."""
    wanted = name, metric, "all"
    found = (r for r in records if (r.policy, r.metric, r.window) == wanted)
    return next((record for record in found if component in (None, record.component)), None)


def ranking(records: Sequence[Record]) -> list[Record]:
    """Return the records of the geometric mean cost of the ranked competitors of one scenario, lowest first.

    Competitors that are practically equal to the lowest stand in the order of the records, which is the catalogue's: a
    filter comes before its variants.
    """
    costs = [
        (record.value, record)
        for record in records
        if (record.metric, record.window) == ("geometric_cost", "all") and record.kind in RANKED
        if record.value is not None
    ]
    equal = (1.0 + NEGLIGIBLE) * min((cost for cost, _ in costs), default=0.0)
    return [record for _, record in sorted(costs, key=lambda pair: max(pair[0], equal))]


def rival_of(places: Sequence[Record], learned: Sequence[str]) -> Record | None:
    """Return the best of the origin (learned or classical) that the first of a ranking has not; None: none."""
    was_learned = places[0].policy in learned
    return next((place for place in places if (place.policy in learned) != was_learned), None)


def best_competitor(records: Sequence[Record], learned: Sequence[str] | None = None) -> str:
    """Return which origin is best in a scenario, in two or three words, such as "learned best".

    It rests on the paired ratio between the best one and the best of the other origin: where its interval contains one,
    no competitor is called best.
    """
    places = ranking(records)
    if not places:
        return "nothing is ranked"
    learned = learned_names(records[0].environment) if learned is None else learned
    where = "learned" if places[0].policy in learned else "classical"
    rival = rival_of(places, learned)
    if rival is None:
        return f"{where} only"
    behind = find_record(records, rival.policy, "behind_best")
    if behind is None or behind.low is None or behind.low <= 0.0:
        return "no significant difference"
    return f"{where} best"


def ranking_sentence(records: Sequence[Record], paper: str, learned: Sequence[str] | None = None) -> str:
    """Return a sentence on the competitor of lowest cost, its lead, and the best one of the other origin."""
    places = ranking(records)
    if not places:
        return f"On `{records[0].scenario}` nothing is ranked."
    learned = learned_names(records[0].environment) if learned is None else learned
    best, rival = places[0], rival_of(places, learned)
    was_learned = best.policy in learned
    difference = find_record(records, best.policy, HEADLINE)
    role = "learned" if was_learned else best.kind
    sentence = f"On `{best.scenario}` `{best.policy}` ({role}) has the lowest error cost"
    if best.policy != paper and difference is not None and (difference.high or 0.0) > -NEGLIGIBLE:
        sentence += f", but not significantly less than `{paper}`"
    elif best.policy != paper and difference is not None and difference.value is not None:
        sentence += f": {with_interval(difference, 100.0)} % against `{paper}`"
        means, lost = (
            find_record(records, best.policy, metric)
            for metric in ("relative_cost_difference", "lost_tracks")
        )
        if means is not None and means.value is not None:
            sentence += f" ({100.0 * means.value:+.1f} % of the means)"
        if lost is not None and lost.value:
            sentence += f", {with_interval(lost, 100.0, digits=2)} % of its tracks are lost"
    chosen = find_record(records, best.policy, "best_share")
    if chosen is not None and chosen.value is not None and chosen.value < 1.0:
        sentence += f". Other episodes of the kind would name another one in {_share(1.0 - chosen.value)}"
    behind = None if rival is None else find_record(records, rival.policy, "behind_best")
    if rival is not None and behind is not None:
        named = (
            f"classical competitor, `{rival.policy}` ({rival.kind}),"
            if was_learned
            else (f"learned agent, `{rival.policy}`,")
        )
        sentence += f". The strongest {named} costs {with_interval(behind, 100.0)} % more than it"
        if behind.low is not None and behind.low <= 0.0:
            sentence += ", which is no significant difference"
    return sentence + "."


def _share(share: float) -> str:
    return f"{100.0 * share:.1f} % of cases" if share >= 0.001 else "less than 0.1 % of cases"


def origin(result: Result, name: str, kind: str) -> str:
    """Return the origin of a competitor.

    "yours"; "paper", its algorithm; "classical", another policy that steers the environment's filters; "estimator",
    filters of its own; "learned", policy or estimator; "smoother", which uses later measurements; "reference", which
    knows something of the truth; or "bound".
    """
    if name in result.own:
        return "yours"
    if name == result.paper:
        return "paper"
    if name in result.learned:
        return "learned"
    return "classical" if kind == "policy" else kind


def best_of_origins(result: Result) -> list[tuple[str, str]]:
    """Return origin and name of the best competitor of every origin, by cost, then the reference."""
    best: dict[str, str] = {}
    for place in ranking(result.records):
        best.setdefault(origin(result, place.policy, place.kind), place.policy)
    if result.reference:
        best["reference"] = result.reference
    return list(best.items())


def remarks(results: Sequence[Result]) -> list[str]:
    """Return remarks on learned agents that do harm, and on the consistency of the best competitors."""
    sentences = []
    usual = [result for result in results if result.default] or list(results)
    winners = [(result, ranking(result.records)[:1]) for result in usual]
    judged = [(result, place.policy) for result, first in winners for place in first]
    harmful = [harm for result in results for harm in _harms(result)]
    agents = {(result.environment, name) for result in results for name in result.learned}
    if agents:
        cells = sum(len(result.learned) for result in results)
        several = f"{len(harmful) or 'None'} of {cells} results of learned agents "
        one = "" if harmful else " not"
        several += "is" if len(harmful) == 1 else "are"
        sentences.append(
            f"{several if cells > 1 else f'The learned agent is{one}'} "
            f"significantly worse than the paper's algorithm by more than {100.0 * HARM:g} %"
            + (f"; the worst is {max(harmful)[1]}." if harmful else ".")
        )
    off = [
        f"`{name}` in {result.short} ({with_interval(nees)})"
        for result, name in judged
        if (nees := find_record(result.records, name, "anees", "state")) is not None
        if consistency_word(nees).endswith(INCONSISTENT_WORDS)
    ]
    if judged:
        several = f"Of the winners, {len(off)} of {len(judged)} {'states' if len(off) == 1 else 'state'}"
        sentences.append(
            "The covariance of every winner is as large as its errors."
            if not off
            else f"{'The winner states' if len(judged) == 1 else several} a covariance "
            f"that does not fit the errors (mean NEES over its dimension, which should be one): {', '.join(off)}."
        )
    return sentences


def _harms(result: Result) -> list[tuple[float, str]]:
    """Return excess cost and text of each agent that costs significantly more than the paper's algorithm."""
    return [
        (r.value or 0.0, f"`{r.policy}` in {result.short} `{r.scenario}`, {with_interval(r, 100.0)} %")
        for r in result.records
        if r.policy in result.learned and (r.metric, r.window) == (HEADLINE, "all") and (r.low or 0.0) > HARM
    ]
