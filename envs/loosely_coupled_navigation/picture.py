"""Picture of LooselyCoupledNavigation: what INS and GNSS say, the estimate, and strips of what the filter does.

Where there are several axes, the first one is drawn.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy
from matplotlib.figure import Figure

from ..contract.model import Episode, Model
from ..drawing.rendering import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    PALE,
    VERMILLION,
    History,
    Picture,
    Strip,
    error_strip,
    grown,
)
from .banks import NOISES, Augmented, Schemes, Steered
from .hypotheses import SteeredFaults
from .task import LooselyCoupledNavigation

TRACK = (0.06, 0.075, 0.43, 0.80)
"""Left, bottom, width, height of the panel as shares of the figure."""
MARGIN_SIGMAS = 3.5
"""Room above and below the reference, nominal standard deviations of a measurement."""


class LooselyCoupledNavigationPicture(Picture):
    """Position over time, normalised innovation, what is steered, error with its reported band."""

    strips_left = 0.555
    strip_columns = 1

    task: LooselyCoupledNavigation

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.disturbed: list[tuple[float, float]] = []
        self.limits = (-1.0, 1.0)

    # --- the history

    def records(self, state: Episode) -> dict[str, float]:
        """Positions in m, innovation, and the noises of the action, gain or weights."""
        measurement, filters = state.measurement, state.filter
        missing = measurement.available[0] < 0.5
        values = {
            "reference": state.truth.reference[0, 0],
            "ins": measurement.ins[0, 0],
            "measured": math.nan if missing else measurement.fix[0, 0],
            "estimated": self.model.mean(state)[0, 0],
        }
        normalised = filters.seen.normalised
        if isinstance(filters, Steered):
            values["innovation"] = math.nan if missing else normalised[0, 0]
            # A gain of zero has no logarithm: it is drawn at the smallest one that an action can set.
            smallest = self.task.parameters.smallest_gain
            values["log_gain"] = math.log10(max(float(filters.gain[0, 0]), smallest))
        elif isinstance(filters, Augmented):
            values["innovation"] = math.nan if missing else normalised[0, 0]
            for name, action in zip(NOISES, filters.action[:, 0], strict=True):
                values[f"noise.{name}"] = action
        elif isinstance(filters, SteeredFaults):
            values["innovation"] = math.nan if missing else normalised[0, 0]
            probabilities = filters.probabilities[:, 0]
            values["kind.modelled"], values["kind.pulled off"] = probabilities[0], probabilities[-2:].sum()
        else:
            assert isinstance(filters, Schemes)
            for i, weight in enumerate(filters.weights[:, 0]):
                values[f"innovation.{i}"] = math.nan if missing else normalised[i, 0, 0]
                values[f"weight.{i}"] = weight
        return {name: float(value) for name, value in values.items()}

    def begin(self, state: Episode) -> None:
        """Note the disturbances, and fly the reference ahead for limits that need not move."""
        world, truth, p = self.task.world, state.truth, self.task.parameters
        self.disturbed = []
        for window in (truth.outage, truth.jamming, truth.spoofing):
            first, beyond = float(window[0, 0]), float(window[1, 0])
            if first <= p.horizon:
                self.disturbed.append((first - 0.5, min(beyond, p.horizon + 1) - 0.5))
        still = numpy.zeros((world.normals + world.row_uniforms, truth.number.shape[-1]))
        path = []
        for _ in range(p.horizon + 1):
            path.append(float(truth.reference[0, 0]))
            truth, _measurement = world.advance(truth, still, None)
        room = MARGIN_SIGMAS * math.sqrt(p.receiver_variance)
        self.limits = min(path) - room, max(path) + room

    # --- strips

    def strips(self) -> Sequence[Strip]:
        """Innovation, what is steered, error."""
        suffix = "" if self.task.parameters.axes == 1 else ", x"
        component = self.task.components[0].name
        if self.model.control == "gain":
            low = math.log10(self.task.parameters.smallest_gain)
            innovations = {"innovation": "innovation"}
            steered = Strip(f"log10 of the gain{suffix}", {"gain": "log_gain"}, (low, 0.2), steps=True)
        elif self.model.control == "noise":
            innovations = {"innovation": "innovation"}
            noises = {name: f"noise.{name}" for name in NOISES}
            steered = Strip("action: noises", noises, (-1.08, 1.08), guides=(0.0,), steps=True)
        elif self.model.control == "hypotheses":
            innovations = {"innovation": "innovation"}
            kinds = {kind: f"kind.{kind}" for kind in ("modelled", "pulled off")}
            steered = Strip("probabilities", kinds, (-0.04, 1.04))
        else:
            names = self.task.modes
            innovations = {names[2]: "innovation.2"}
            weights = {name: f"weight.{i}" for i, name in enumerate(names)}
            steered = Strip("weights", weights, (-0.04, 1.04), steps=True)
        of = "" if "innovation" in innovations else f" of {self.task.modes[2]}"
        return [
            Strip(
                f"innovation{of} over predicted σ{suffix}", innovations, (-4.0, 4.0), guides=(-2.0, 0.0, 2.0)
            ),
            steered,
            error_strip(f"position error{suffix}, m", component, 1.0),
        ]

    def shows_observation(self) -> bool:
        """No: the strips say it in the filter's terms."""
        return False

    def shading(self) -> Sequence[tuple[float, float]]:
        """Measurements that fail, are jammed or spoofed."""
        return self.disturbed

    # --- the panel

    def open(self, figure: Figure) -> None:
        """Make the panel and its legend."""
        panel = self.panel = figure.add_axes(TRACK)
        panel.tick_params(labelsize=8)
        panel.grid(color=PALE, linewidth=0.6)
        panel.set_axisbelow(True)
        axis = "" if self.task.parameters.axes == 1 else " x"
        panel.set_title(f"position{axis}", loc="left", fontsize=9, pad=4)
        panel.set_xlabel(self.clock, fontsize=9, labelpad=1)
        panel.set_ylabel("position, m", fontsize=9, labelpad=1)
        dots: dict[str, Any] = {"linestyle": "", "marker": ".", "markersize": 3}
        (self.measured,) = panel.plot([], [], **dots, color=GREY, zorder=2, label="GNSS")
        (self.ins,) = panel.plot([], [], color=ORANGE, linewidth=1.4, zorder=3, label="INS alone")
        (self.reference,) = panel.plot([], [], color=BLACK, linewidth=1.6, zorder=4, label="reference")
        (self.estimated,) = panel.plot([], [], color=BLUE, linewidth=1.4, zorder=5, label="estimate")
        (self.arrived,) = panel.plot(
            [], [], linestyle="", marker="s", markersize=6, markerfacecolor="none", color=VERMILLION,
            zorder=6, label="next measurement, not yet used",
        )  # fmt: skip
        figure.legend(
            handles=[self.reference, self.ins, self.measured, self.estimated, self.arrived],
            loc="upper left", bbox_to_anchor=(TRACK[0], 0.955), ncols=5, fontsize=8, frameon=False,
            handlelength=1.6, columnspacing=1.0, handletextpad=0.4, borderpad=0.0,
        )  # fmt: skip

    def arrange(self) -> None:
        """Limits that hold the reference of this episode and the noise around it."""
        self.panel.set_xlim(0.5, self.task.horizon + 1.5)
        self.panel.set_ylim(*self.limits)

    def draw(self, history: History, state: Episode) -> None:
        """Move everything to where it is now."""
        for name in ("reference", "ins", "measured", "estimated"):
            values = history.get(name, numpy.empty(0))
            getattr(self, name).set_data(numpy.arange(1, len(values) + 1), values)
        measurement = state.measurement
        arrived = float(measurement.fix[0, 0]) if measurement.available[0] > 0.5 else math.nan
        self.arrived.set_data([float(measurement.number[0])], [arrived])
        drawn = [history[name] for name in ("ins", "estimated") if name in history]
        if drawn:
            both = numpy.concatenate(drawn)
            self.panel.set_ylim(*grown(self.limits, float(both.min()), float(both.max())))


PICTURE = LooselyCoupledNavigationPicture
