"""Selection of the episodes in which a competitor has the highest cost, and a figure of them."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy
import xarray

from ..running.evaluate import Experiment, Plan, plan_of, run_piece
from ..running.metrics import mean_cost
from ..statistics.bootstrap import ratio
from ..statistics.cause_split import (
    COST,
    COUNT,
    EVERYTHING,
    VARIABLE,
    active_causes,
    cause_sums,
    reason_weight,
)
from .looks import COLOURS
from .print_layout import add_title, figure_with_pairs, in_print

MOST_WORST = 3
"""Maximal number of episodes in the figure."""
MOST_CAUSES = 2
LEAST_WEIGHT = 0.1
"""Maximal number of main causes of an episode, and the least weight of each."""


class WorstEpisode(NamedTuple):
    """An episode with a high cost of a competitor."""

    number: int
    """Number of the episode in the evaluation."""
    seed: str
    """Seed of the episode for ``env.reset`` and ``filtergym animate``."""
    cost: float
    """Mean cost over its measurements."""
    opponent_cost: float
    """Mean cost of the opponent; NaN without one."""
    causes: list[str]
    """Main causes, see :func:`main_causes`."""


def select_worst(costs: numpy.ndarray, most: int = MOST_WORST) -> list[int]:
    """Return the numbers of the episodes with the highest costs, the highest first, without NaN."""
    order = numpy.argsort(-costs, kind="stable")
    return [int(i) for i in order[:most] if not numpy.isnan(costs[i])]


def run_episodes(
    experiment: Experiment, competitors: Mapping[str, Any], numbers: list[int]
) -> xarray.Dataset:
    """Run some episodes of an experiment again, with the data for figures; return their dataset."""
    drawn = replace(experiment, tracks=False, drawn_episodes=len(numbers))
    plan = _with_episodes(plan_of(drawn, competitors), numbers)
    kept = plan.arrays(len(numbers), len(numbers))
    for name in competitors:
        piece = plan.piece(name, 0, len(numbers), True)
        kept.write(name, piece.part, run_piece(piece, lambda measurements: None))
    return plan.dataset(kept, plan.seeds)


def _with_episodes(plan: Plan, numbers: list[int]) -> Plan:
    flown, lengths = (None if each is None else each[numbers] for each in (plan.flight_numbers, plan.lengths))
    return plan._replace(seeds=[plan.seeds[i] for i in numbers], flight_numbers=flown, lengths=lengths)


def describe_worst(
    dataset: xarray.Dataset, numbers: list[int], name: str, opponent: str = ""
) -> list[WorstEpisode]:
    """Return costs, seed and main causes of some episodes of a competitor."""
    own = mean_cost(dataset, name)
    other = mean_cost(dataset, opponent) if opponent else numpy.full(len(numbers), numpy.nan)
    causes = main_causes(dataset.sel(policy=name))
    seeds = dataset["episode_seed"].values.tolist()
    return [
        WorstEpisode(number, str(seeds[i]), float(own[i]), float(other[i]), causes[i])
        for i, number in enumerate(numbers)
    ]


def main_causes(run: xarray.Dataset) -> list[list[str]]:
    """Return each episode's main causes of cost, the heaviest first (:func:`.cause_split.reason_weight`).

    Returns:
        At most ``MOST_CAUSES`` names for each, with at least ``LEAST_WEIGHT``.
    """
    if VARIABLE not in run:
        return [[] for _ in range(run.sizes["episode"])]
    names = [name for name, _ in active_causes(run)]
    sums = cause_sums(run, None)
    weights = reason_weight(_share_of_all(sums[..., COST]), _share_of_all(sums[..., COUNT]))
    weights[:, names.index(EVERYTHING)] = 0.0
    return [
        [names[k] for k in numpy.argsort(-own, kind="stable")[:MOST_CAUSES] if own[k] >= LEAST_WEIGHT]
        for own in weights
    ]


def _share_of_all(sums: numpy.ndarray) -> numpy.ndarray:
    """Return sums by cause over those of all measurements, ``(episodes, causes)``; zero where these are zero."""
    whole = numpy.broadcast_to(sums[:, :1], sums.shape)
    return numpy.nan_to_num(ratio(numpy.stack([sums, whole], axis=1)))


# --- in print


@in_print
def draw_worst(
    tracks: Sequence[xarray.Dataset], titles: Sequence[tuple[str, str]], name: str, *, columns: int = 2
) -> Any:
    """Return a figure of a competitor's episodes, a row each: true and estimated positions, and the error.

    Args:
        tracks: track of each episode, with ``truth``, optionally ``seen``, ``estimate`` and ``sigma`` over policy,
            component and time; the attribute ``plane`` is true if the first two components are the axes of a plane.
        titles: titles of each episode, above its first and second axes.
        name: name of their competitor, which is drawn first.
        columns: width of the figure in columns of a paper, 1 or 2.
    """
    from matplotlib.lines import Line2D

    figure, axes = figure_with_pairs(len(tracks), columns)
    others = list(dict.fromkeys(str(n) for track in tracks for n in track["policy"].values if n != name))
    colours = dict(zip([name, *others], COLOURS, strict=False))
    for pair, track, title in zip(axes, tracks, titles, strict=True):
        for axis, words in zip(pair, title, strict=True):
            lines = (textwrap.fill(line, {1: 20, 2: 48}[columns]) for line in words.split("\n"))
            axis.set_title("\n".join(lines), loc="left")
        _draw_positions(pair[0], track, colours, name)
        _draw_errors(pair[1], track, colours)
    handles = [
        Line2D([], [], color="0.75", linewidth=3.0, label="truth"),
        Line2D([], [], color="0.5", linestyle="", marker="+", markersize=3.0, label="measured"),
        *(Line2D([], [], color=colour, linewidth=1.0, label=one) for one, colour in colours.items()),
        Line2D([], [], color="0.3", linewidth=0.7, linestyle=":", label="two reported sigma"),
    ]
    add_title(figure, f"Worst episodes of {name}", [])
    figure.legend(handles=handles, loc="outside lower center", ncols=3 if columns == 1 else 5, frameon=False)
    return figure


def _draw_positions(axis: Any, track: xarray.Dataset, colours: Mapping[str, str], name: str) -> None:
    """Draw true, measured and estimated positions in the plane, or of the first component over time."""
    plane = bool(track.attrs["plane"])
    clock = track["elapsed" if "elapsed" in track.coords else "time"].values

    def line(values: xarray.DataArray) -> tuple[numpy.ndarray, numpy.ndarray]:
        first, second = (values.isel(component=i).values for i in (0, min(1, values.sizes["component"] - 1)))
        return (first, second) if plane else (clock, first)

    own = track.sel(policy=name)
    if "truth" in track:
        axis.plot(*line(own["truth"]), color="0.75", linewidth=3.0)
    if "seen" in track:
        axis.plot(
            *line(own["seen"]), color="0.5", linestyle="", marker="+", markersize=2.5, markeredgewidth=0.5
        )
    for one in reversed([str(n) for n in track["policy"].values]):
        axis.plot(*line(track["estimate"].sel(policy=one)), color=colours[one], linewidth=1.0)
    labels = [
        f"{component.replace('_', ' ')}, {unit}"
        for component, unit in zip(
            track["component"].values.tolist(), track["unit"].values.tolist(), strict=True
        )
    ]
    axis.set_xlabel(labels[0] if plane else _clock_label(track))
    axis.set_ylabel(labels[1] if plane else labels[0])
    if plane:
        axis.set_aspect("equal", adjustable="datalim")
    axis.grid(alpha=0.25, lw=0.4)


def _draw_errors(axis: Any, track: xarray.Dataset, colours: Mapping[str, str]) -> None:
    """Draw the size of the position error over time, and two reported standard deviations."""
    clock = track["elapsed" if "elapsed" in track.coords else "time"].values
    drawn = track.isel(component=slice(2 if track.attrs["plane"] else 1))
    for one in reversed([str(n) for n in track["policy"].values]):
        own = drawn.sel(policy=one)
        sigma = 2.0 * numpy.sqrt((own["sigma"].values ** 2).sum(axis=0))
        if "truth" in track:
            error = numpy.sqrt(((own["estimate"] - own["truth"]).values ** 2).sum(axis=0))
            axis.plot(clock, error, color=colours[one], linewidth=1.0)
        axis.plot(clock, sigma, color=colours[one], linewidth=0.7, linestyle=":")
    unit = str(track["unit"].values[0])
    axis.set_ylim(bottom=0.0)
    axis.set_ylabel(f"error, {unit}")
    axis.set_xlabel(_clock_label(track))
    axis.grid(alpha=0.25, lw=0.4)


def _clock_label(track: xarray.Dataset) -> str:
    return "time, s" if "elapsed" in track.coords else "measurement"
