"""Metrics of ManeuveringTarget where there is clutter: GOSPA, lost tracks, false associations.

The generalised optimal sub-pattern assignment metric (A. S. Rahmathullah, A. F. García-Fernández and L. Svensson,
Generalized optimal sub-pattern assignment metric, 20th Int. Conf. on Information Fusion, 2017, definition 1) with
cutoff c, p = 2 and alpha = 2 counts c^2 / 2 for a target that is missed and as much for a false track. Of one target
and one track d apart it is min(d, c): either they are assigned to each other, or one is missed and the other false.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy

from ...evaluation.running.metrics import squared_errors
from ...evaluation.running.own_metrics import Measure, MetricInputs, OwnMetrics
from ...evaluation.statistics.bootstrap import Bootstrap
from ...evaluation.storage.dataset import groups_of, slices_of

if TYPE_CHECKING:
    import xarray

CUTOFF = 1000.0
"""c, m: the largest deviation of a turning target from a straight course in two scans."""
LASTING = 10
"""Scans in a row with an error beyond ``CUTOFF``, after which a track counts as lost."""


def gospa(distance: numpy.ndarray, cutoff: float = CUTOFF) -> numpy.ndarray:
    """Return the GOSPA metric of one target and one track, ``min(distance, cutoff)``, m; NaN stays NaN.

    Args:
        distance: distance between them, m.
        cutoff: c, m.
    """
    return numpy.minimum(distance, cutoff)


def scan_of_loss(distance: numpy.ndarray) -> numpy.ndarray:
    """Return the first of ``LASTING`` scans in a row with an error beyond ``CUTOFF``, ``(episodes,)``; -1
    without.

    Args:
        distance: distance between target and track, m, ``(episodes, time)``.
    """
    beyond = distance > CUTOFF
    if beyond.shape[1] < LASTING:
        return numpy.full(len(beyond), -1)
    windows = numpy.lib.stride_tricks.sliding_window_view(beyond, LASTING, axis=1)
    held = numpy.logical_and.reduce(windows, axis=2)
    return numpy.where(held.any(axis=1), held.argmax(axis=1), -1)


def gather(run: "xarray.Dataset") -> MetricInputs:
    """Return what the metrics in clutter need of each episode; empty without clutter and for a bound."""
    if "false_association" not in run or str(run["kind"].values) == "bound":
        return MetricInputs()
    distance = numpy.sqrt(squared_errors(run, "position", groups_of(run)))
    slices = slices_of(run).values()
    each = {
        "gospa": numpy.stack([numpy.nanmean(gospa(distance[:, times]), axis=1) for times in slices], axis=1),
        "lost_at": scan_of_loss(distance),
        "false": numpy.nanmean(run["false_association"].values, axis=1),
    }
    return MetricInputs(each)


def measures(gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset") -> list[Measure]:
    """Return the metrics in clutter with intervals: GOSPA, lost tracks and false associations.

    ``gospa``: mean over scans and episodes, m. ``track_loss_rate``: share of episodes with ``LASTING`` scans in a row
    whose error exceeds ``CUTOFF``; ``track_loss_scan``: median of the first of them, over the tracks lost.
    ``false_association_rate``: share of scans in which the plot that is nearest to its prediction, in the gate, is not
    the target's; also for filters that use all plots.
    """
    return list(_measures(gathered, bootstrap, evaluation)) if gathered.each else []


def _measures(
    gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset"
) -> Iterator[Measure]:
    each = gathered.each
    for i, window in enumerate(slices_of(evaluation)):
        yield Measure("gospa", "", window, bootstrap.estimate(each["gospa"][:, i]), "m")
    lost = each["lost_at"] >= 0
    yield Measure("track_loss_rate", "", "all", bootstrap.estimate(lost.astype(float)), "1")
    if lost.any():
        value = bootstrap.interval(bootstrap.quantiles(each["lost_at"] + 1.0, 0.5, lost))
        yield Measure("track_loss_scan", "", "all", value, "1")
    yield Measure("false_association_rate", "", "all", bootstrap.estimate(each["false"]), "1")


METRICS = OwnMetrics(gather, measures)
