"""The worst episodes of competitors, run once more for the report."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray

from ...evaluation.competitors.kinds import Competitor
from ...evaluation.figures.worst_episodes import describe_worst, draw_worst, run_episodes, select_worst
from ...evaluation.running.evaluate import Experiment
from ...evaluation.running.metrics import Record
from ...evaluation.running.summary import Evaluation
from ...evaluation.storage.dataset import groups_of
from .reasons import reasons_of
from .results import WorstTrack, components_to_draw, track_of


def find_worst(
    experiment: Experiment,
    evaluation: Evaluation,
    competitors: Sequence[Competitor],
    explained: Sequence[str],
) -> dict[str, list[WorstTrack]]:
    """Run the worst episodes of the competitors in ``explained`` again, with their opponents; return the tracks."""
    found: dict[str, list[WorstTrack]] = {name: [] for name in explained}
    for name in found.keys() & evaluation.costs.keys():
        opponent = find_opponent(evaluation.records, name)
        numbers = select_worst(evaluation.costs[name])
        makers = {one.name: one.maker for one in competitors if one.name in (name, opponent)}
        dataset = run_episodes(experiment, makers, numbers)
        components, plane = components_to_draw(groups_of(dataset), dataset["component"].values.tolist())
        for i, worst in enumerate(describe_worst(dataset, numbers, name, opponent)):
            ratio = worst.cost / worst.opponent_cost if worst.opponent_cost > 0.0 else math.nan
            found[name].append(
                WorstTrack(
                    name,
                    opponent,
                    _label(dataset, i),
                    worst.cost,
                    ratio if math.isfinite(ratio) else None,
                    worst.causes,
                    track_of(dataset, components, plane, i),
                )
            )
    return found


def _label(dataset: xarray.Dataset, number: int) -> str:
    """Return the label of an episode: its seed, or its name in a recording."""
    name = "flight" if dataset.attrs["recorded"] else "episode_seed"
    return str(dataset[name].values[number])


def find_opponent(records: Sequence[Record], name: str) -> str:
    """Return the name of the opponent with whose cost a competitor's is compared by cause; empty: none."""
    ratios = [reason.ratio.component for reason in reasons_of(records, name) if reason.ratio is not None]
    return ratios[0] if ratios else ""


def worst_figures(
    worst: Mapping[str, Sequence[WorstTrack]], phrases: Mapping[str, str], columns: int
) -> Iterator[tuple[str, Any]]:
    """Draw the worst episodes of each competitor; yield the name of a file, and the figure."""
    for name, episodes in worst.items():
        own = [(one, one.track) for one in episodes if one.track is not None]
        titles = [_titles(one, phrases) for one, _ in own]
        if own:
            place = "worst_episodes" if len(worst) == 1 else f"worst_episodes_{_file_name(name)}"
            yield place, draw_worst([track for _, track in own], titles, name, columns=columns)


def _titles(one: WorstTrack, phrases: Mapping[str, str]) -> tuple[str, str]:
    against = "" if one.ratio is None else f",\n{one.ratio:.3g} times {one.opponent}"
    cause = phrases.get(one.causes[0], one.causes[0]) if one.causes else "under no cause in particular"
    return f"episode {one.seed}\nmostly {cause}", f"mean cost {one.cost:.3g}{against}"


def _file_name(name: str) -> str:
    return re.sub(r"[^\w.-]", "_", Path(name).name)
