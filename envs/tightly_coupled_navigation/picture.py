"""Picture of TightlyCoupledNavigation: course and motion, actions, innovations, errors."""

from collections.abc import Sequence
from typing import Any

import numpy
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ...filters import gnss_ins
from ..contract.model import Episode, Model
from ..drawing.rendering import BLACK, BLUE, CURVES, FIGURE_SIZE, PALE, History, Picture, Strip, widen_limits
from .parameters import HYPOTHESES, LINE, REST, SINGER
from .problem import NavigationProblem

COURSE = (0.065, 0.53, 0.43, 0.37)
MOTION = (0.125, 0.29, 0.37, 0.15)
SENSORS = (0.125, 0.075, 0.37, 0.13)
"""Left, bottom, width, height of the panels as shares of the figure."""
FAULTS = ("two satellites out", "rates lost", "noisy rate", "accelerometers stuck")
"""Rows of the panel of sensors."""
ACCELERATION_LIMIT = 10.0
"""Height of the panel of accelerations at the start, m/s^2."""
MOTION_ROW = -1.0
"""Row of the true hypothesis, below the faults."""
LEAST_REACH = 30.0
"""Smallest half width of the displayed course, m."""
ACTIONS: dict[str, tuple[str, ...]] = {
    "gain": ("action",),
    "robust": ("action", "readings"),
    "hypotheses": ("action: odds", "noises"),
}
"""Controls whose actions are drawn, and the titles of their time series; of four components the first one."""


class TightlyCoupledNavigationPicture(Picture):
    """Picture of course, acceleration, sensor faults, weights or noise factors, innovations, errors."""

    strips_left: float = 0.56
    strip_columns = 1

    task: NavigationProblem

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.motions: list[list[tuple[float, float]]] = [[] for _ in HYPOTHESES]
        self.faults: list[list[tuple[float, float]]] = [[] for _ in FAULTS]

    # --- the history

    def records(self, state: Episode) -> dict[str, float]:
        """Return the values that the picture shows at a step by name, such as positions (m) and errors."""
        task, bank, S, lane = self.task, state.filter, self.task.satellites, 0
        error = self.model.error(state)[:, lane]
        P = numpy.diagonal(self.model.covariance(state)[:, :, lane])
        truth, estimate = state.truth.state[:, lane], self.model.mean(state)[:, lane]
        innovation = bank.range_innovation[:, lane] / task.sensor_sigma[task.tracked, 0]
        innovation = numpy.where(state.measurement.available[task.tracked, lane] > 0.0, innovation, 0.0)
        if state.measurement.number[lane] <= 1:
            # The receiver clock is not known yet: hundreds of sigma that would hide all that follow.
            innovation = numpy.full_like(innovation, numpy.nan)
        values = {
            "true_east": truth[0],
            "true_north": truth[1],
            "estimated_east": estimate[0],
            "estimated_north": estimate[1],
            "true_acceleration": float(numpy.linalg.norm(truth[gnss_ins.ACCELERATION])),
            "estimated_acceleration": float(numpy.linalg.norm(estimate[gnss_ins.ACCELERATION])),
            "position_error": float(numpy.linalg.norm(error[gnss_ins.POSITION])),
            "position_sigma": float(numpy.sqrt(P[gnss_ins.POSITION].sum())),
            "velocity_error": float(numpy.linalg.norm(error[gnss_ins.VELOCITY])),
            "velocity_sigma": float(numpy.sqrt(P[gnss_ins.VELOCITY].sum())),
            "range_innovation": float(numpy.abs(innovation[:S]).max()),
            "rate_innovation": float(numpy.abs(innovation[S:]).max()),
        }
        values |= {f"weight.{i}": bank.probabilities[i, lane] for i in range(len(HYPOTHESES))}
        if self.model.control in ACTIONS:
            values |= {f"gain.{i}": action[lane] for i, action in enumerate(bank.action)}
        return {name: float(value) for name, value in values.items()}

    def begin(self, state: Episode) -> None:
        """Simulate the truth in advance, to find the intervals of manoeuvres and sensor faults."""
        task, truth = self.task, state.truth
        still = numpy.zeros((task.noise.normals + task.noise.row_uniforms, truth.step.shape[-1]))
        modes = []
        flags: list[list[bool]] = [[] for _ in FAULTS]
        for _ in range(task.horizon):
            modes.append(int(truth.mode[0]))
            hidden, no_rates, stuck = (
                truth.disturbances[name].now[0] > 0.0 for name in ("hidden", "no_rates", "stuck")
            )
            happening = hidden, no_rates, (truth.noise_factor[:, 0] > 1.0).any(), stuck
            for flag, now in zip(flags, happening, strict=True):
                flag.append(bool(now))
            # Only the truth and the sensors: the filters would take a hundred times as long.
            truth, _ = task.world.advance(truth, still, None)
        self.motions = [_runs([mode == i for mode in modes]) for i in (REST, LINE, SINGER)]
        self.faults = [_runs(flag) for flag in flags]

    # --- strips

    def strips(self) -> Sequence[Strip]:
        """Return the time series of the picture: actions, innovations and errors."""
        hypotheses = (name.replace("-", " ").replace("singer", "Singer") for name in HYPOTHESES)
        weights = {name: f"weight.{i}" for i, name in enumerate(hypotheses)}
        steered = [Strip("weights of the hypotheses", weights, (-0.04, 1.04), steps=True)]
        if self.model.control in ACTIONS:
            own_bank: Any = self.model.filter
            names = [name.removeprefix("accelerometers_").replace("_", " ") for name in own_bank.actions]
            groups = len(self.task.sensors)
            parts = range(groups), range(groups, len(names))
            for title, part in zip(ACTIONS[self.model.control], parts, strict=False):
                own = {names[i]: f"gain.{i}" for i in part}
                steered.append(Strip(title, own, (-1.05, 1.05), guides=(0.0,), steps=True))
        return [
            *steered,
            Strip(
                "largest innovation over sensor σ",
                {"of a pseudorange": "range_innovation", "of a rate": "rate_innovation"},
                (0.0, 10.0),
            ),
            Strip(
                "position error, m", {"error": "position_error", "reported σ": "position_sigma"}, (0.0, 2.0)
            ),
            Strip(
                "velocity error, m/s", {"error": "velocity_error", "reported σ": "velocity_sigma"}, (0.0, 0.5)
            ),
        ]

    def shows_observation(self) -> bool:
        """Return False: the picture shows the filters' quantities instead of the observation."""
        return False

    def shading(self) -> Sequence[tuple[float, float]]:
        """Return the intervals of manoeuvres, which the picture shades."""
        return self.motions[SINGER]

    # --- panels

    def open(self, figure: Figure) -> None:
        """Create the panels of course, acceleration and sensor faults."""
        course = self.course = figure.add_axes(COURSE)
        motion = self.motion = figure.add_axes(MOTION)
        sensors = self.sensors = figure.add_axes(SENSORS)
        for axes in (course, motion, sensors):
            axes.tick_params(labelsize=8)
            axes.grid(color=PALE, linewidth=0.6)
            axes.set_axisbelow(True)
        legend: dict[str, Any] = {
            "loc": "lower right", "fontsize": 8, "frameon": False, "borderpad": 0.0, "borderaxespad": 0.2,
            "handlelength": 1.8, "columnspacing": 1.0, "handletextpad": 0.4, "bbox_to_anchor": (1.0, 1.005),
        }  # fmt: skip
        course.set_title("course from above", loc="left", fontsize=9, pad=4)
        course.set_xlabel("east, m", fontsize=9, labelpad=1)
        course.set_ylabel("north, m", fontsize=9, labelpad=1)
        self.true: Line2D = course.plot([], [], color=BLACK, linewidth=1.4, label="true", zorder=2)[0]
        self.estimated: Line2D = course.plot(
            [], [], color=BLUE, linewidth=1.2, linestyle="--", label="estimate", zorder=3
        )[0]
        self.user: Line2D = course.plot(
            [], [], color=BLACK, marker="+", markersize=11, markeredgewidth=1.6, linestyle="", zorder=5
        )[0]
        (self.believed,) = course.plot([], [], color=BLUE, marker="o", markersize=5, linestyle="", zorder=4)
        course.legend(ncols=2, **legend)

        motion.set_title("size of the acceleration, m/s²", loc="left", fontsize=9, pad=4)
        motion.set_xlim(0.5, self.task.horizon + 0.5)
        self.felt: Line2D = motion.plot([], [], color=BLACK, linewidth=1.4, label="true", zorder=2)[0]
        self.thought: Line2D = motion.plot(
            [], [], color=BLUE, linewidth=1.2, linestyle="--", label="estimate", zorder=3
        )[0]
        motion.legend(ncols=2, **legend)

        sensors.set_title(
            "sensor faults; true motion in the colours of the weights", loc="left", fontsize=9, pad=4
        )
        sensors.set_xlim(0.5, self.task.horizon + 0.5)
        sensors.set_ylim(-1.6, len(FAULTS) - 0.4)
        sensors.set_yticks([MOTION_ROW, *range(len(FAULTS))], ["true motion", *FAULTS], fontsize=7)
        sensors.set_xlabel(self.clock, fontsize=9, labelpad=1)
        self.fault_lines: list[Line2D] = [
            sensors.plot([], [], color=BLACK, linewidth=5.0, solid_capstyle="butt")[0] for _ in FAULTS
        ]
        # In the colours of their weights.
        self.modes: list[Line2D] = [
            sensors.plot([], [], color=color, linewidth=5.0, solid_capstyle="butt")[0]
            for _, (color, _) in zip(HYPOTHESES, CURVES, strict=False)
        ]
        self.now: Line2D = sensors.plot([], [], color=BLACK, linewidth=0.8)[0]

    def arrange(self) -> None:
        """Set the axis limits of the picture at the start; they grow with the flight."""
        self._show_course(numpy.empty((2, 0)))
        self.motion.set_ylim(0.0, ACCELERATION_LIMIT)

    def _show_course(self, places: numpy.ndarray) -> None:
        sides = []
        for values in places:
            low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
            sides.append(widen_limits((-LEAST_REACH, 0.0), 1.05 * low, 0.0)[0])
            sides.append(widen_limits((0.0, LEAST_REACH), 0.0, 1.05 * high)[1])
        west, east, south, north = sides
        metres_per_inch = max(
            (east - west) / (FIGURE_SIZE[0] * COURSE[2]), (north - south) / (FIGURE_SIZE[1] * COURSE[3])
        )
        half = 0.5 * metres_per_inch * FIGURE_SIZE[0] * COURSE[2]
        self.course.set_xlim(0.5 * (west + east) - half, 0.5 * (west + east) + half)
        half = 0.5 * metres_per_inch * FIGURE_SIZE[1] * COURSE[3]
        self.course.set_ylim(0.5 * (south + north) - half, 0.5 * (south + north) + half)

    def draw(self, history: History, state: Episode) -> None:
        """Update course, accelerations and sensor faults to the current step."""
        nothing = numpy.empty(0)
        pairs = {}
        for name in ("true", "estimated"):
            pairs[name] = [history.get(f"{name}_{axis}", nothing) for axis in ("east", "north")]
        self._show_course(numpy.concatenate([numpy.stack(pair) for pair in pairs.values()], axis=1))
        self.true.set_data(*pairs["true"])
        self.estimated.set_data(*pairs["estimated"])
        self.user.set_data(*(values[-1:] for values in pairs["true"]))
        self.believed.set_data(*(values[-1:] for values in pairs["estimated"]))
        felt, thought = (history.get(f"{name}_acceleration", nothing) for name in ("true", "estimated"))
        steps = numpy.arange(1, len(felt) + 1)
        self.felt.set_data(steps, felt)
        self.thought.set_data(steps, thought)
        if len(felt):
            self.motion.set_ylim(
                *widen_limits((0.0, ACCELERATION_LIMIT), 0.0, float(max(felt.max(), thought.max())))
            )
        for row, (line, runs) in enumerate(zip(self.fault_lines, self.faults, strict=True)):
            line.set_data(*_segments(runs, row))
        for line, runs in zip(self.modes, self.motions, strict=True):
            line.set_data(*_segments(runs, MOTION_ROW))
        self.now.set_data([len(felt) + 0.5] * 2, list(self.sensors.get_ylim()))


def _runs(flags: Sequence[bool]) -> list[tuple[float, float]]:
    """Return the intervals of steps, counted from 1, in which a flag is true, half a step longer on either side."""
    steps = 1 + numpy.flatnonzero(flags)
    if not len(steps):
        return []
    pieces = numpy.split(steps, 1 + numpy.flatnonzero(numpy.diff(steps) > 1))
    return [(float(piece[0]) - 0.5, float(piece[-1]) + 0.5) for piece in pieces]


def _segments(runs: Sequence[tuple[float, float]], row: float) -> tuple[list[float], list[float]]:
    x = [value for first, last in runs for value in (first, last, numpy.nan)]
    return x, [row] * len(x)


PICTURE = TightlyCoupledNavigationPicture
