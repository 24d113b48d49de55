"""Picture of RadarEsmTracking: acceleration, ESM decisions, class probabilities and errors."""

from collections.abc import Sequence
from typing import Any

import numpy
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..contract.model import Episode, Model
from ..drawing.rendering import (
    BLACK,
    BLUE,
    CURVES,
    GREY,
    ORANGE,
    PALE,
    VERMILLION,
    History,
    Picture,
    Strip,
    error_strip,
    widen_limits,
)
from .problem import RadarEsmProblem

ACCELERATION = (0.105, 0.555, 0.395, 0.345)
DECISIONS = (0.105, 0.075, 0.395, 0.38)
"""Left, bottom, width, height of the panels as shares of the figure."""
LARGEST_SIGMAS = 2.0
"""Height of the acceleration panel at the start, in the true class's standard deviations."""
LEAST_HEIGHT = 15.0
"""Smallest height of the acceleration panel, m/s^2; less would cut off the noise of the agile class's filter."""
TYPE_NAMES = ("advanced\nfighter", "fighter", "early\nwarning", "missile")
"""Names of the paper's four emitter types."""
CLASS_ROW = -1.0
"""Row of the true class below the types."""


class RadarEsmTrackingPicture(Picture):
    """Picture of acceleration (truth, filters, estimate), ESM decisions, class probabilities and errors."""

    clock = "scan"
    strips_left: float = 0.56
    strip_columns = 1

    task: RadarEsmProblem

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.change: float | None = None
        self.height: float = LEAST_HEIGHT

    # --- the history

    def records(self, state: Episode) -> dict[str, float]:
        """Return the values that the picture shows at a scan by name, such as accelerations and weights."""
        filters, truth, decision = state.filter, state.truth, state.measurement.decision[0]
        decided, used = decision < self.task.types, filters.used[0]
        nothing = float("nan")
        return {
            "true": truth.motion[2, 0],
            "estimate": self.model.mean(state)[2, 0],
            **{f"filter.{s}": filters.mean[2, s, 0] for s in range(self.task.classes)},
            **{f"weight.{s}": filters.probabilities[s, 0] for s in range(self.task.classes)},
            "true_class": truth.target_class[0],
            "true_type": truth.emitter_type[0],
            "used": decision if used else nothing,
            "refused": decision if decided and not used else nothing,
        }

    def begin(self, state: Episode) -> None:
        """Store the time of the episode's class change, and the scale of its accelerations."""
        truth, p = state.truth, self.task.parameters
        change = int(truth.change_scan[0])
        classes = [int(truth.target_class[0])]
        self.change = None
        if change <= self.task.horizon:
            self.change = change - 0.5
            classes.append(int(truth.next_class[0]))
        largest = max(p.acceleration_sigma[s] for s in classes)
        self.height = max(LEAST_HEIGHT, LARGEST_SIGMAS * largest)

    # --- strips

    def strips(self) -> Sequence[Strip]:
        """Return the time series of the picture: the weights and the three errors."""
        weights = {mode: f"weight.{s}" for s, mode in enumerate(self.task.modes)}
        limits = {"range": 2000.0, "range_rate": 30.0, "acceleration": 20.0}
        return [
            Strip("weights of the classes", weights, (-0.04, 1.04)),
            *(
                error_strip(
                    f"error of {component.name.replace('_', ' ')}, {component.unit}",
                    component.name,
                    limits[component.name],
                )
                for component in self.task.components
            ),
        ]

    def shows_observation(self) -> bool:
        """Return False: the picture shows the filters' quantities instead of the observation."""
        return False

    def shading(self) -> Sequence[tuple[float, float]]:
        """Return the scans after the change of class, which the picture shades."""
        return [] if self.change is None else [(self.change, self.task.horizon + 0.5)]

    # --- panels

    def open(self, figure: Figure) -> None:
        """Create the panels of acceleration and of ESM decisions."""
        top = self.acceleration = figure.add_axes(ACCELERATION)
        bottom = self.decisions = figure.add_axes(DECISIONS)
        legend: dict[str, Any] = {
            "loc": "lower right", "fontsize": 8, "frameon": False, "borderpad": 0.0, "borderaxespad": 0.2,
            "handlelength": 1.6, "columnspacing": 1.0, "handletextpad": 0.4, "bbox_to_anchor": (1.0, 1.005),
        }  # fmt: skip
        for axes in (top, bottom):
            axes.set_xlim(0.5, self.task.horizon + 0.5)
            axes.tick_params(labelsize=8)
            axes.grid(color=PALE, linewidth=0.6)
            axes.set_axisbelow(True)
        top.set_title("acceleration, m/s²", loc="left", fontsize=9, pad=4)
        top.tick_params(labelbottom=False)
        self.filters: list[Line2D] = [
            top.plot(
                [],
                [],
                color=color,
                linestyle=style,
                linewidth=0.9,
                alpha=0.75,
                label=mode,
                zorder=2,
            )[0]
            for mode, (color, style) in zip(self.task.modes, CURVES, strict=False)
        ]
        self.estimate: Line2D = top.plot([], [], color=ORANGE, linewidth=2.2, label="reported", zorder=3)[0]
        self.true: Line2D = top.plot([], [], color=BLACK, linewidth=1.4, label="true", zorder=4)[0]
        top.legend(ncols=6, **legend)

        types = self.task.types
        names = TYPE_NAMES if types == len(TYPE_NAMES) else [f"type {j}" for j in range(types)]
        bottom.set_title("ESM decisions", loc="left", fontsize=9, pad=4)
        bottom.set_yticks([CLASS_ROW, *range(types)], ["true class", *names], fontsize=8)
        bottom.set_ylim(CLASS_ROW - 0.5, types - 0.5)
        bottom.set_xlabel(self.clock, fontsize=9)
        bottom.axhline(CLASS_ROW + 0.5, color=GREY, linewidth=0.8)
        self.true_type: Line2D = bottom.plot(
            [], [], color=GREY, linewidth=5.0, alpha=0.5, drawstyle="steps-mid", label="true type", zorder=2
        )[0]
        if self.task.parameters.emitter == "redrawn":
            self.true_type.set_label("_type drawn anew for each decision")
        self.used: Line2D = bottom.plot(
            [], [], linestyle="", marker="o", markersize=5, color=BLUE, label="used", zorder=3
        )[0]
        self.refused: Line2D = bottom.plot(
            [], [], linestyle="", marker="x", markersize=6, markeredgewidth=1.6, color=VERMILLION,
            label="refused by the gate", zorder=3,
        )[0]  # fmt: skip
        # The colours are those of the weights, whose legend is next to this panel.
        self.classes: list[Line2D] = [
            bottom.plot([], [], linestyle="", marker="s", markersize=4, color=color, zorder=3)[0]
            for _, (color, _) in zip(self.task.modes, CURVES, strict=False)
        ]
        bottom.legend(ncols=3, **legend)

    def arrange(self) -> None:
        """Set the limits of the acceleration axis for the classes of this episode."""
        self.acceleration.set_ylim(-self.height, self.height)

    def draw(self, history: History, state: Episode) -> None:
        """Update accelerations and ESM decisions to the current scan."""
        empty = numpy.empty(0)
        times = numpy.arange(1, len(history.get("true", empty)) + 1)

        def put(line: Any, values: numpy.ndarray) -> None:
            line.set_data(times, values)

        for s, line in enumerate(self.filters):
            put(line, history.get(f"filter.{s}", empty))
        for name, line in (("estimate", self.estimate), ("true", self.true)):
            put(line, history.get(name, empty))
        put(self.used, history.get("used", empty))
        put(self.refused, history.get("refused", empty))
        if self.task.parameters.emitter == "fixed":
            put(self.true_type, history.get("true_type", empty))
        true_class = history.get("true_class", empty)
        for s, line in enumerate(self.classes):
            put(line, numpy.where(true_class == s, CLASS_ROW, numpy.nan))
        shown = numpy.concatenate([history.get("true", empty), history.get("estimate", empty), [0.0]])
        reach = widen_limits((-self.height, self.height), float(shown.min()), float(shown.max()))
        self.acceleration.set_ylim(*reach)


PICTURE = RadarEsmTrackingPicture
