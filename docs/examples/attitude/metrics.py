"""Errors as BROAD counts them: root mean squares of the total angle, its inclination and its heading."""

from typing import TYPE_CHECKING

import numpy
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.evaluation.storage.dataset import slices_of
from filtergym.evaluation.running.metrics import Measure
from filtergym.evaluation.running.own_metrics import MetricInputs, OwnMetrics

if TYPE_CHECKING:
    import xarray

PARTS = ("total", "inclination", "heading")


def gather(run: "xarray.Dataset") -> MetricInputs:
    """Return mean squares of the three angles of every episode, by window; nothing where the truth is not known."""
    if "total_angle" not in run or numpy.isnan(run["total_angle"].values).all():
        return MetricInputs()
    squares = {
        part: numpy.stack(
            [
                numpy.nanmean(run[f"{part}_angle"].values[:, times] ** 2, axis=1)
                for times in slices_of(run).values()
            ],
            axis=1,
        )
        for part in PARTS
    }
    return MetricInputs(squares)


def measures(gathered: MetricInputs, bootstrap: Bootstrap, evaluation: "xarray.Dataset") -> list[Measure]:
    """Measures of the attitude: ``angle_rmse``, root of the mean square of an angle over all episodes, deg."""
    return [
        Measure(
            "angle_rmse",
            part,
            window,
            bootstrap.interval(numpy.sqrt(bootstrap.means(gathered.each[part][:, i]))),
            "deg",
        )
        for part in gathered.each
        for i, window in enumerate(slices_of(evaluation))
    ]


METRICS = OwnMetrics(gather, measures)
