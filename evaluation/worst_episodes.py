"""The episodes that cost a competitor most, run once more to be looked at: an episode is fixed by its seed."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy
import xarray

from .bootstrap import ratio
from .cause_split import COST, COUNT, EVERYTHING, VARIABLE, cause_sums, held_causes
from .evaluate import Experiment, Plan, plan_of, run_piece
from .metrics import mean_cost

MOST_WORST = 3
"""Episodes that are looked at."""


class WorstEpisode(NamedTuple):
    """An episode that costs a competitor much."""

    number: int
    """Among those of the evaluation."""
    seed: str
    """With which ``env.reset`` and ``filtergym animate`` show it."""
    cost: float
    """Mean over its measurements."""
    opponent_cost: float
    """That of whom the competitor is compared with; NaN where there is nobody."""
    cause: str
    """Under which most of the cost falls beyond its share of the measurements; empty where none holds more."""


def select_worst(costs: numpy.ndarray, most: int = MOST_WORST) -> list[int]:
    """Return the numbers of the dearest episodes, the worst first.

    Args:
        costs: mean cost of every episode; one that is NaN is left out.
        most: how many at most.
    """
    order = numpy.argsort(-costs, kind="stable")
    return [int(i) for i in order[:most] if not numpy.isnan(costs[i])]


def run_episodes(experiment: Experiment, competitors: Mapping[str, Any], numbers: list[int]) -> xarray.Dataset:
    """Run some episodes of an experiment once more, and keep what a picture of each shows.

    Args:
        experiment: of which they are.
        competitors: by name, as of :func:`.evaluate.run_experiment`.
        numbers: of the episodes.

    Returns:
        An evaluation of these episodes, in their order, as of :func:`.evaluate.run_experiment`.
    """
    drawn = replace(experiment, tracks=False, drawn_episodes=len(numbers))
    plan = _with_episodes(plan_of(drawn, competitors), numbers)
    kept = {name: run_piece(plan.piece(name, 0, len(numbers), True), _unheard) for name in competitors}
    return plan.dataset(kept, plan.seeds)


def _unheard(measurements: int) -> None:
    """Tell nobody of the progress: these are few."""


def _with_episodes(plan: Plan, numbers: list[int]) -> Plan:
    flown, lengths = (None if each is None else each[numbers] for each in (plan.flown, plan.lengths))
    return plan._replace(seeds=[plan.seeds[i] for i in numbers], flown=flown, lengths=lengths)


def describe_worst(
    dataset: xarray.Dataset, numbers: list[int], name: str, opponent: str = ""
) -> list[WorstEpisode]:
    """Say of each of some episodes what it costs, whom, and by what cause.

    Args:
        dataset: of :func:`run_episodes`.
        numbers: of its episodes.
        name: of the competitor.
        opponent: with whom it is compared; empty: nobody.
    """
    own = mean_cost(dataset, name)
    other = mean_cost(dataset, opponent) if opponent else numpy.full(len(numbers), numpy.nan)
    causes = main_causes(dataset.sel(policy=name))
    seeds = dataset["episode_seed"].values.tolist()
    return [
        WorstEpisode(number, str(seeds[i]), float(own[i]), float(other[i]), causes[i])
        for i, number in enumerate(numbers)
    ]


def main_causes(run: xarray.Dataset) -> list[str]:
    """Return of each episode the cause that holds most of the cost beyond its share of the measurements.

    Args:
        run: one competitor's part of an evaluation.
    """
    if VARIABLE not in run:
        return [""] * run.sizes["episode"]
    names = [name for name, _ in held_causes(run)]
    sums = cause_sums(run, None)
    excess = _share_of_all(sums[..., COST]) - _share_of_all(sums[..., COUNT])
    excess[:, names.index(EVERYTHING)] = 0.0
    largest = excess.argmax(axis=1).tolist()
    return [names[k] if excess[i, k] > 0.0 else "" for i, k in enumerate(largest)]


def _share_of_all(sums: numpy.ndarray) -> numpy.ndarray:
    """Share that each cause has of the whole, ``(episodes, causes)``; zero where the whole is zero."""
    whole = numpy.broadcast_to(sums[:, :1], sums.shape)
    return numpy.nan_to_num(ratio(numpy.stack([sums, whole], axis=1)))
