"""Picture of an episode under a filter of its own: true position, measurements, estimates and errors.

It draws any estimator, smoother or reference in any environment, since it reads only the estimate of the filter.
Like :mod:`.rendering` this module imports matplotlib.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from ..contract.model import Model
from .rendering import BLACK, BLUE, FIGURE_SIZE, ORANGE, PALE, History, Picture, Strip, error_strip

PANEL = (0.085, 0.09, 0.405, 0.76)
"""Left, bottom, width, height as shares of the figure."""
MOST_STRIPS = 4
"""Largest number of components whose errors are drawn."""
MARGIN = 0.06
"""Margin around the path, as a share of its extent."""
ELLIPSE_SIGMAS = 2.0
"""Half axes of the covariance ellipse, standard deviations."""


class EstimatePicture(Picture):
    """Picture of truth, readings and estimate, in a plane if there is one, and of errors with reported bands.

    Args:
        track: arrays of the whole episode, for constant limits, see :meth:`values`.
    """

    strips_left: float = 0.56
    strip_columns = 1
    steered = False

    def __init__(self, model: Model, track: Mapping[str, numpy.ndarray]) -> None:
        super().__init__(model)
        names = [component.name for component in self.task.components]
        planes = [parts for parts in self.task.groups.values() if len(parts) > 1]
        self.plane: bool = bool(planes)
        self.drawn: list[int] = [names.index(name) for name in (planes[0][:2] if planes else names[:1])]
        self.measured: bool = "seen" in track
        path = numpy.concatenate([track[name] for name in ("truth", "estimate") if name in track])
        self.limits: list[tuple[float, float]] = [_extent(path[:, i]) for i in self.drawn]

    def values(self, track: Mapping[str, numpy.ndarray], k: int) -> dict[str, float]:
        """Return the values of one measurement by series name, for the picture's history.

        Args:
            track: of the episode, as :meth:`.Model.picture_track` returns it of one measurement, ``(K, ...)``.
            k: number of the measurement, from 0 on.
        """
        mean, P = track["estimate"][k], track["covariance"][k]
        nothing = numpy.full(len(mean), numpy.nan)
        true, seen = (track[name][k] if name in track else nothing for name in ("truth", "seen"))
        sigma = numpy.sqrt(numpy.maximum(numpy.diagonal(P), 0.0))
        values: dict[str, float] = {}
        for i, component in enumerate(self.task.components):
            values |= {f"error.{component.name}": mean[i] - true[i], f"sigma.{component.name}": sigma[i]}
        for row, i in enumerate(self.drawn):
            values |= {f"true.{row}": true[i], f"seen.{row}": seen[i], f"believed.{row}": mean[i]}
            values |= {f"covariance.{row}{column}": P[i, j] for column, j in enumerate(self.drawn)}
        return values

    def strips(self) -> Sequence[Strip]:
        """Return the time series of the picture: errors of the first components."""
        return [
            error_strip(f"error of {component.name.replace('_', ' ')}, {component.unit}", component.name, 1.0)
            for component in self.task.components[:MOST_STRIPS]
        ]

    def shows_observation(self) -> bool:
        """Return False: the filter has no observation."""
        return False

    def open(self, figure: Figure) -> None:
        """Create the panel of the path with truth, readings and estimate, and its legend."""
        panel: Axes = figure.add_axes(PANEL)
        self.panel = panel
        panel.tick_params(labelsize=8)
        panel.grid(color=PALE, linewidth=0.6)
        panel.set_axisbelow(True)
        labels = [
            f"{self.task.components[i].name.replace('_', ' ')}, {self.task.components[i].unit}"
            for i in self.drawn
        ]
        panel.set_xlabel(labels[0] if self.plane else self.clock, fontsize=9)
        panel.set_ylabel(labels[-1], fontsize=9)
        self.true: Line2D = panel.plot([], [], color=BLACK, linewidth=1.6, label="truth", zorder=3)[0]
        self.seen: Line2D = panel.plot(
            [],
            [],
            color=ORANGE,
            linestyle="",
            marker="x",
            markersize=4,
            label="measured" if self.measured else "_",
            zorder=2,
        )[0]
        self.believed: Line2D = panel.plot([], [], color=BLUE, linewidth=1.3, label="estimate", zorder=4)[0]
        self.now: Line2D = panel.plot([], [], color=BLUE, linestyle="", marker="o", markersize=6, zorder=5)[0]
        self.ellipse: Ellipse = Ellipse((0.0, 0.0), 0.0, 0.0, fill=False, color=BLUE, linewidth=1.3, zorder=5)
        panel.add_patch(self.ellipse)
        panel.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 1.005),
            ncols=3,
            fontsize=8,
            frameon=False,
            borderaxespad=0.2,
        )

    def arrange(self) -> None:
        """Set the axis limits of the picture to the whole path."""
        if not self.plane:
            self.panel.set_xlim(0.5, self.task.horizon + 0.5)
            self.panel.set_ylim(*self.limits[0])
            return
        # One scale for both axes, in the shape of the panel.
        sides = FIGURE_SIZE[0] * PANEL[2], FIGURE_SIZE[1] * PANEL[3]
        scale = max((high - low) / side for (low, high), side in zip(self.limits, sides, strict=True))
        (west, east), (south, north) = (
            (0.5 * (low + high - scale * side), 0.5 * (low + high + scale * side))
            for (low, high), side in zip(self.limits, sides, strict=True)
        )
        self.panel.set_xlim(west, east)
        self.panel.set_ylim(south, north)

    def draw(self, history: History, state: Any) -> None:
        """Update path, covariance ellipse and readings to the current measurement."""
        empty = numpy.empty(0)
        for name, line in (("true", self.true), ("seen", self.seen), ("believed", self.believed)):
            x, y = self._places([history.get(f"{name}.{row}", empty) for row in range(len(self.drawn))])
            line.set_data(x, y)
        self.now.set_data(x[-1:], y[-1:])  # the last column is the estimate
        self.ellipse.set_visible(self.plane and len(x) > 0)
        if self.plane and len(x):
            P = numpy.array([[history[f"covariance.{i}{j}"][-1] for j in range(2)] for i in range(2)])
            variances, directions = numpy.linalg.eigh(P)
            small, large = ELLIPSE_SIGMAS * numpy.sqrt(numpy.maximum(variances, 0.0))
            self.ellipse.set_center((x[-1], y[-1]))
            self.ellipse.set_width(2.0 * large)
            self.ellipse.set_height(2.0 * small)
            self.ellipse.set_angle(float(numpy.degrees(numpy.arctan2(directions[1, 1], directions[0, 1]))))

    def _places(self, values: Sequence[numpy.ndarray]) -> tuple[numpy.ndarray, numpy.ndarray]:
        return (values[0], values[1]) if self.plane else (numpy.arange(1, len(values[0]) + 1), values[0])


def _extent(values: numpy.ndarray) -> tuple[float, float]:
    finite = values[numpy.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    margin = MARGIN * (high - low) or 1.0
    return low - margin, high + margin
