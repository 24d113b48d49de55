"""Picture of ManeuveringTarget: the track, a close-up of the estimate, and time series of the filter."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from ...filters import imm
from ..contract.model import Episode, Model
from ..drawing.rendering import (
    BLACK,
    BLUE,
    FIGURE_SIZE,
    GREEN,
    ORANGE,
    PALE,
    VERMILLION,
    History,
    Picture,
    Strip,
    widen_limits,
)
from .banks import AlphaBeta, Filters
from .hypotheses import GROUPS, HypothesesState
from .kalman_net import FRAME
from .problem import TargetProblem
from .unscented_banks import UnscentedState

ELLIPSE_SIGMAS = 2.0
"""Half axes of the covariance ellipse, standard deviations."""
RECENT = 15
"""Number of scans whose errors the close-up shows."""
CLOSE_UP_SIGMAS = 4.0
"""Half width of the close-up at the start, in multiples of the largest measurement sigma of the flight."""
TRACK = (0.06, 0.475, 0.43, 0.425)
CLOSE_UP = (0.06, 0.075, 0.19, 0.19 * FIGURE_SIZE[0] / FIGURE_SIZE[1])
"""Left, bottom, width, height of the panels as shares of the figure; the close-up is square."""
KINDS = {
    "straight": ("straight", "ended"),
    "begun": ("begun",),
    **{kind: (kind, f"old_{kind}") for kind in ("thrust", "left", "right")},
}
"""Groups of hypotheses that are drawn as one."""


def ellipse_axes(covariance: numpy.ndarray) -> tuple[float, float, float]:
    """Return the axes of a covariance ellipse: two standard deviations, larger first, and the larger's direction.

    Args:
        covariance: ``(2, 2)``.

    Returns:
        Two lengths in the unit of the covariance's root, and degrees anticlockwise from the first axis.
    """
    variances, directions = numpy.linalg.eigh(covariance)
    small, large = numpy.sqrt(numpy.maximum(variances, 0.0))
    return float(large), float(small), math.degrees(math.atan2(directions[1, 1], directions[0, 1]))


class ManeuveringTargetPicture(Picture):
    """Picture of the track, a close-up, normalised innovation, gain or weights, and position error."""

    clock = "scan"
    strips_left: float = 0.545
    strip_columns = 1

    task: TargetProblem

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.flight: numpy.ndarray = numpy.empty((2, 0))
        self.maneuvers: list[tuple[float, float]] = []
        self.largest_sigma: float = 1.0

    # --- the history

    def records(self, state: Episode) -> dict[str, float]:
        """Return the values that the picture shows at a scan, by name; positions in km."""
        estimator = state.filter
        true, measured = state.truth.position[:, 0], state.measurement.position[:, 0]
        if not state.measurement.available[0]:
            measured = measured + numpy.nan
        error = self.model.error(state)[:2, 0]
        P = self.model.covariance(state)[:2, :2, 0]
        values = {
            "true_x": true[0] / 1e3,
            "true_y": true[1] / 1e3,
            "measured_x": measured[0] / 1e3,
            "measured_y": measured[1] / 1e3,
            "estimated_x": (true[0] + error[0]) / 1e3,
            "estimated_y": (true[1] + error[1]) / 1e3,
            "covariance_xx": P[0, 0] / 1e6,
            "covariance_xy": P[0, 1] / 1e6,
            "covariance_yy": P[1, 1] / 1e6,
            "position_error": math.hypot(*error),
            "position_sigma": math.sqrt(P[0, 0] + P[1, 1]),
        }
        if isinstance(estimator, AlphaBeta):
            innovation = estimator.innovation[:, 0]
            variance = estimator.innovation_variance[:, 0]
            values["alpha"] = estimator.alpha[0]
        elif isinstance(estimator, HypothesesState):
            innovation, variance = estimator.innovation[:, 0], numpy.ones(2)
            groups = dict(zip(GROUPS, estimator.probabilities[:, 0], strict=True))
            values |= {f"kind.{kind}": sum(groups[group] for group in those) for kind, those in KINDS.items()}
        elif isinstance(estimator, UnscentedState):
            innovation, variance = estimator.innovation[:, 0], numpy.ones(2)
            ratio = numpy.exp(2.0 * estimator.prior[:, 0])
            values |= {
                f"share.{axis}": share for axis, share in zip("xy", ratio / (1.0 + ratio), strict=True)
            }
        else:
            assert isinstance(estimator, Filters)
            predicted = numpy.exp(estimator.log_predicted)
            mean, S = imm.combine(estimator.innovation, estimator.innovation_covariance, predicted)
            innovation, variance = mean[:, 0], numpy.diagonal(S[:, :, 0])
            values |= {f"weight.{j}": weight for j, weight in enumerate(estimator.probabilities[:, 0])}
            values |= {f"alpha.{j}": alpha for j, alpha in enumerate(estimator.alpha[:, 0])}
        normalised = innovation / numpy.sqrt(variance)
        return {**values, "innovation_x": normalised[0], "innovation_y": normalised[1]}

    def begin(self, state: Episode) -> None:
        """Simulate the truth of the whole episode in advance, so that axis limits need not move."""
        world, truth, measurement = self.task.world, state.truth, state.measurement
        still = numpy.zeros((world.normals + world.row_uniforms, truth.position.shape[-1]))
        positions, velocities, sigmas = [], [], []
        for _ in range(self.task.horizon + 1):
            positions.append(truth.position[:, 0])
            velocities.append(truth.velocity[:, 0])
            sigmas.append(numpy.sqrt(measurement.variance[:, 0].max()))
            truth, measurement = world.advance(truth, still, None)
        self.flight = numpy.stack(positions, axis=1) / 1e3
        self.largest_sigma = max(sigmas) / 1e3
        change = numpy.diff(numpy.stack(velocities, axis=1), axis=1)
        scans = 2 + numpy.flatnonzero(numpy.hypot(*change) > 1e-6)
        runs = numpy.split(scans, 1 + numpy.flatnonzero(numpy.diff(scans) > 1)) if len(scans) else []
        self.maneuvers = [(run[0] - 0.5, run[-1] + 0.5) for run in runs]

    # --- strips

    def strips(self) -> Sequence[Strip]:
        """Return the time series of the picture: innovation, gain or weights, and error."""
        axes: Sequence[str] = "xy"
        if self.model.control == "gain":
            steered = Strip("position gain alpha", {"alpha": "alpha"}, (0.0, 1.0))
        elif self.model.control == "gains":
            each = {f"filter {j + 1}": f"alpha.{j}" for j in range(len(self.task.parameters.gains))}
            steered = Strip("position gain alpha", each, (0.0, 1.0))
        elif self.model.control == "hypotheses":
            axes = FRAME
            steered = Strip("probabilities", {kind: f"kind.{kind}" for kind in KINDS}, (-0.04, 1.04))
        elif self.model.control in ("sigma-points", "unscented"):
            shares = {axis: f"share.{axis}" for axis in "xy"}
            steered = Strip("position gain before the action", shares, (0.0, 1.0))
        else:
            gains = self.task.parameters.gains
            named = {f"filter {j + 1}, alpha {gain:g}": f"weight.{j}" for j, gain in enumerate(gains)}
            steered = Strip("weights", named, (-0.04, 1.04))
        return [
            Strip(
                "innovation over predicted σ",
                dict(zip(axes, ("innovation_x", "innovation_y"), strict=True)),
                (-4.0, 4.0),
                guides=(-2.0, 0.0, 2.0),
            ),
            steered,
            Strip(
                "position error, m",
                {"estimate": "position_error", "reported σ": "position_sigma"},
                (0.0, 500.0),
            ),
        ]

    def shows_observation(self) -> bool:
        """Return False: the picture shows the filter's quantities instead of the observation."""
        return False

    def shading(self) -> Sequence[tuple[float, float]]:
        """Return the first and last scan of each manoeuvre, which the picture shades."""
        return self.maneuvers

    # --- panels

    def open(self, figure: Figure) -> None:
        """Create the panels of track and close-up, and one legend for both."""
        track = self.track = figure.add_axes(TRACK)
        close_up = self.close_up = figure.add_axes(CLOSE_UP)
        for axes in (track, close_up):
            axes.set_aspect("equal", adjustable="box")
            axes.tick_params(labelsize=8)
            axes.grid(color=PALE, linewidth=0.6)
            axes.set_axisbelow(True)
        track.set_title("track", loc="left", fontsize=9, pad=4)
        track.set_xlabel("x, km", fontsize=9, labelpad=1)
        track.set_ylabel("y, km", fontsize=9, labelpad=1)
        close_up.set_title("close-up: errors at the last scan", loc="left", fontsize=9, pad=4)
        close_up.set_xlabel("x minus true x, km", fontsize=9, labelpad=1)
        close_up.set_ylabel("y minus true y, km", fontsize=9, labelpad=1)
        cross: dict[str, Any] = {"linestyle": "", "marker": "x", "color": ORANGE}
        dot: dict[str, Any] = {"linestyle": "", "marker": "o", "color": BLUE}
        self.true: Line2D = track.plot([], [], color=BLACK, linewidth=1.2, zorder=2)[0]
        self.measured: Line2D = track.plot([], [], **cross, markersize=4, markeredgewidth=0.9, zorder=3)[0]
        self.estimated: Line2D = track.plot(
            [], [], color=BLUE, marker="o", markersize=2.6, linewidth=1.0, zorder=4
        )[0]
        self.target: Line2D = track.plot(
            [], [], color=BLACK, marker="+", markersize=11, markeredgewidth=1.6, zorder=5
        )[0]
        self.arrived: Line2D = track.plot(
            [], [], linestyle="", marker="s", markersize=7, markerfacecolor="none", markeredgewidth=1.4,
            color=VERMILLION, zorder=6,
        )[0]  # fmt: skip
        self.radar: Line2D = track.plot(
            [0.0], [0.0], linestyle="", marker="^", markersize=8, color=GREEN, zorder=5
        )[0]
        self.ellipses: list[Ellipse] = [
            Ellipse((0.0, 0.0), 0.0, 0.0, fill=False, color=BLUE, linewidth=1.3) for _ in range(2)
        ]
        track.add_patch(self.ellipses[0])
        close_up.add_patch(self.ellipses[1])
        self.past_measured: Line2D = close_up.plot([], [], **cross, alpha=0.35, markersize=4, zorder=2)[0]
        self.past_estimated: Line2D = close_up.plot([], [], **dot, alpha=0.3, markersize=3, zorder=3)[0]
        (self.last_measured,) = close_up.plot([], [], **cross, markersize=8, markeredgewidth=1.8, zorder=4)
        self.last_estimated: Line2D = close_up.plot([], [], **dot, markersize=6, zorder=5)[0]
        close_up.plot([0.0], [0.0], color=BLACK, marker="+", markersize=11, markeredgewidth=1.6, zorder=6)
        ring = Line2D([], [], linestyle="", marker="o", markersize=10, markerfacecolor="none", color=BLUE)
        ground = Line2D([], [], linestyle="", marker="s", markersize=10, color=PALE)
        pale = Line2D([], [], linestyle="", marker="o", markersize=4, color=BLUE, alpha=0.3)
        figure.legend(
            [
                self.true, self.target, self.last_measured, self.arrived, self.estimated, ring, pale,
                self.radar, ground,
            ],
            [
                "true path", "target now", "measurement", "next measurement,\nnot yet used", "estimate",
                f"{ELLIPSE_SIGMAS:g}σ covariance", f"pale: {RECENT} scans before", "radar", "manoeuvre",
            ],
            loc="upper left",
            bbox_to_anchor=(CLOSE_UP[0] + CLOSE_UP[2] + 0.012, CLOSE_UP[1] + CLOSE_UP[3] + 0.012),
            fontsize=8, frameon=False, labelspacing=0.65,
        )  # fmt: skip

    def arrange(self) -> None:
        """Set the axis limits of the track to the whole flight of the episode, in the shape of the panel."""
        low, high = self.flight.min(axis=1), self.flight.max(axis=1)
        width, height = FIGURE_SIZE[0] * TRACK[2], FIGURE_SIZE[1] * TRACK[3]
        middle, half = 0.5 * (low + high), 0.5 * (high - low) + CLOSE_UP_SIGMAS * self.largest_sigma
        kilometres_per_inch = 2.0 * max(half[0] / width, half[1] / height) * 1.04
        half = 0.5 * kilometres_per_inch * numpy.array([width, height])
        self.track.set_xlim(middle[0] - half[0], middle[0] + half[0])
        self.track.set_ylim(middle[1] - half[1], middle[1] + half[1])
        self.reach: float = math.ceil(CLOSE_UP_SIGMAS * self.largest_sigma * 10.0) / 10.0
        self._set_reach(self.reach)

    def _set_reach(self, reach: float) -> None:
        # Both axes together, so that the close-up stays square.
        self.close_up.set_xlim(-reach, reach)
        self.close_up.set_ylim(-reach, reach)

    def draw(self, history: History, state: Episode) -> None:
        """Update track, close-up and their texts to the current scan."""
        seen = int(state.measurement.available[0])
        self.arrived.set_data(*(state.measurement.position[:, :seen] / 1e3))
        pairs = {name: _pair(history, name) for name in ("true", "measured", "estimated")}
        true, measured, estimated = pairs["true"], pairs["measured"], pairs["estimated"]
        self.true.set_data(*true)
        self.measured.set_data(*measured)
        self.estimated.set_data(*estimated)
        self.target.set_data(*true[:, -1:])
        recent = slice(-RECENT - 1, -1)
        self.past_measured.set_data(*(measured - true)[:, recent])
        self.past_estimated.set_data(*(estimated - true)[:, recent])
        self.last_measured.set_data(*(measured - true)[:, -1:])
        self.last_estimated.set_data(*(estimated - true)[:, -1:])
        for ellipse in self.ellipses:
            ellipse.set_visible(true.shape[1] > 0)
        if not true.shape[1]:
            return
        last = [history[f"covariance_{entry}"][-1] for entry in ("xx", "xy", "yy")]
        large, small, direction = ellipse_axes(numpy.array([[last[0], last[1]], [last[1], last[2]]]))
        error = (estimated - true)[:, -1]
        for ellipse, centre in zip(self.ellipses, (estimated[:, -1], error), strict=True):
            ellipse.set_center(tuple(centre))
            ellipse.set_width(2.0 * ELLIPSE_SIGMAS * large)
            ellipse.set_height(2.0 * ELLIPSE_SIGMAS * small)
            ellipse.set_angle(direction)
        self._set_reach(widen_limits((0.0, self.reach), 0.0, float(numpy.abs(estimated - true).max()))[1])


def _pair(history: Mapping[str, Any], name: str) -> numpy.ndarray:
    empty = numpy.empty(0)
    return numpy.stack([history.get(f"{name}_x", empty), history.get(f"{name}_y", empty)])


PICTURE = ManeuveringTargetPicture
