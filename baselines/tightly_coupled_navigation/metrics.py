"""What is measured of TightlyCoupledNavigation beside the metrics of every environment."""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy

from ...envs.tightly_coupled_navigation.parameters import HYPOTHESES
from ...evaluation.bootstrap import Bootstrap, Estimate
from ...evaluation.dataset import groups_of
from ...evaluation.metrics import Measure, squared_errors
from ...evaluation.own_metrics import Arrays, MetricInputs, OwnMetrics

if TYPE_CHECKING:
    import xarray

UNITS = {"position": "m", "velocity": "m/s"}
LASTING = 10
"""Steps for which a hypothesis must stay believed, or a rate outside its aperture, to count."""


def _ratio(bootstrap: Bootstrap, values: numpy.ndarray, counts: numpy.ndarray) -> Estimate:
    """Ratio of means over episodes, with its interval."""
    with numpy.errstate(divide="ignore", invalid="ignore"):
        return bootstrap.interval(bootstrap.means(values) / bootstrap.means(counts))


def lasting(condition: numpy.ndarray, steps: int = LASTING) -> numpy.ndarray:
    """Where a condition begins to hold for some steps in a row; false where the end is too near.

    Args:
        condition: ``(episodes, time)`` booleans.
        steps: how many.
    """
    sums = numpy.cumsum(numpy.pad(condition, ((0, 0), (1, 0))), axis=1)
    held = numpy.zeros_like(condition)
    if condition.shape[1] >= steps:
        held[:, : condition.shape[1] - steps + 1] = sums[:, steps:] - sums[:, :-steps] == steps
    return held


class Switch(NamedTuple):
    """One change of the true hypothesis."""

    episode: int
    before: int
    after: int
    wait: float
    """Steps until the new hypothesis is believed, the first one counted; infinite where it never is."""


def switches(true_mode: numpy.ndarray, probability: numpy.ndarray) -> list[Switch]:
    """Every change of the true hypothesis and how long the bank took to follow it.

    A hypothesis is believed from the first step on which its probability exceeds one half and does so for
    ``LASTING`` steps (or until the next change, if that comes sooner).

    Args:
        true_mode: ``(episodes, time)`` integers.
        probability: ``(episodes, time, M)``.
    """
    found = []
    length = true_mode.shape[1]
    for episode, at in zip(*numpy.nonzero(numpy.diff(true_mode, axis=1)), strict=True):
        first = int(at) + 1
        before, after = int(true_mode[episode, at]), int(true_mode[episode, first])
        others = numpy.flatnonzero(true_mode[episode, first:] != after)
        last = first + int(others[0]) if len(others) else length
        believed = probability[episode, first:last, after] > 0.5
        held = lasting(believed[None], min(LASTING, last - first))[0]
        wait = float(held.argmax()) + 1.0 if held.any() else math.inf
        found.append(Switch(int(episode), before, after, wait))
    return found


def gather(run: "xarray.Dataset") -> MetricInputs:
    """Return what the metrics need of each episode; nothing of a bound."""
    if str(run["kind"].values) == "bound":
        return MetricInputs()
    true_mode = run["true_mode"].values.astype(int)
    there = [true_mode == i for i in range(len(HYPOTHESES))]
    squares = [
        [(square * of_mode).mean(axis=1) for of_mode in there]
        for square in (squared_errors(run, component, groups_of(run)) for component in UNITS)
    ]
    each = {
        "squares": numpy.moveaxis(numpy.array(squares), -1, 0),
        "share": numpy.stack([of_mode.mean(axis=1) for of_mode in there], axis=1),
        "cost": run["cost"].values.mean(axis=1),
    }
    if "mode_probability" not in run or numpy.isnan(run["mode_probability"].values).all():
        return MetricInputs(each)
    step = float(run["seconds"].values[0, 0])
    moved = true_mode != true_mode[:, :1]
    begin = numpy.where(moved.any(axis=1), moved.argmax(axis=1), 0)
    in_motion = numpy.arange(true_mode.shape[1]) >= begin[:, None]
    outside = lasting((run["rate_outside_aperture"].values > 0.0) & in_motion)
    each |= {
        "switches": _count_changes(switches(true_mode, run["mode_probability"].values), len(true_mode), step),
        "lost": numpy.asarray(outside.any(axis=1)),
        "lost_after": (outside.argmax(axis=1) - begin + 1.0) * step,
    }
    return MetricInputs(each)


def _count_changes(changes: Sequence[Switch], episodes: int, step: float) -> numpy.ndarray:
    """Number of changes, of those that were missed, and seconds waited for the others, from and to each hypothesis.

    Returns:
        ``(episodes, M, M, 3)``.
    """
    found = numpy.zeros((episodes, len(HYPOTHESES), len(HYPOTHESES), 3))
    for s in changes:
        seen = math.isfinite(s.wait)
        found[s.episode, s.before, s.after] += (1.0, not seen, s.wait * step if seen else 0.0)
    return found


def measures(gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset") -> list[Measure]:
    """Errors by true hypothesis, adaptation, loss of track and robust costs of one policy.

    ``rmse_by_hypothesis``; ``cost_median`` and ``cost_95_quantile`` over episodes of the episode's mean cost,
    whose mean a few lost tracks rule; ``adaptation_time`` (mean) from the first step that carries a new motion to the
    first on which its hypothesis has more than one half and keeps it for ten steps, and
    ``adaptation_censored``, the share of switches where that never comes; ``track_loss_rate`` and
    ``track_loss_time`` (median of the tracks lost) of ten steps in a row with a pseudorange rate further than
    the aperture from the combined prediction, from the first change of motion on. Those from ``adaptation_time``
    on need the records of a bank: references have none.
    """
    if not gathered.each:
        return []
    found = list(_errors(gathered.each, bootstrap))
    return [*found, *_of_bank(gathered.each, bootstrap)] if "switches" in gathered.each else found


def _errors(each: Arrays, bootstrap: Bootstrap) -> Iterator[Measure]:
    for k, (component, unit) in enumerate(UNITS.items()):
        for i, name in enumerate(HYPOTHESES):
            if each["share"][:, i].any():
                value = _ratio(bootstrap, each["squares"][:, k, i], each["share"][:, i])
                root = Estimate(*(math.sqrt(v) for v in value))
                yield Measure("rmse_by_hypothesis", f"{component} {name}", "all", root, unit)
    yield Measure("cost_median", "", "all", bootstrap.interval(bootstrap.quantiles(each["cost"])), "1")
    yield Measure(
        "cost_95_quantile", "", "all", bootstrap.interval(bootstrap.quantiles(each["cost"], 0.95)), "1"
    )


def _of_bank(each: Arrays, bootstrap: Bootstrap) -> Iterator[Measure]:
    for before, after in numpy.argwhere(each["switches"][..., 0].any(axis=0)):
        count, missed, total = numpy.moveaxis(each["switches"][:, before, after], -1, 0)
        name = f"{HYPOTHESES[before]} to {HYPOTHESES[after]}"
        if (missed < count).any():
            yield Measure("adaptation_time", name, "all", _ratio(bootstrap, total, count - missed), "s")
        yield Measure("adaptation_censored", name, "all", _ratio(bootstrap, missed, count), "1")
    lost = each["lost"]
    yield Measure("track_loss_rate", "", "all", bootstrap.estimate(lost.astype(float)), "1")
    if lost.any():
        value = bootstrap.interval(bootstrap.quantiles(each["lost_after"], 0.5, lost))
        yield Measure("track_loss_time", "", "all", value, "s")


METRICS = OwnMetrics(gather, measures)
