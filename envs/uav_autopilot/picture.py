"""Picture of UavAutopilot: command and output, estimate and its error, control, innovation, noise levels, action."""

import math
from collections.abc import Sequence
from typing import Any

from ..contract.model import Episode, Model
from ..drawing.rendering import Picture, Strip, error_strip
from .banks import MODES, AutopilotBank, KalmanState
from .hypotheses import HypothesesBank, HypothesesState
from .problem import AutopilotProblem

CONTROL = {"P": ("commanded acceleration", "m/s²"), "U": ("elevator command", "deg")}
GUSTS = ("designed", "weaker", "stronger")
"""Groups of hypotheses that share a line."""
LEAST = 1.5
"""Half of the smallest range of the output, in units of the output: a unit step and some noise."""


class UavAutopilotPicture(Picture):
    """Picture of UavAutopilot: time series of the loop, the filter, and the true noise levels."""

    strip_columns = 2

    task: AutopilotProblem

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.shown: int = (
            self.task.measured.index(self.task.output) if self.task.output in self.task.measured else 0
        )
        self.sensor: str = self.task.sensors[self.shown]
        assert isinstance(model.filter, AutopilotBank)
        self.actions: Any = model.filter.action_block.parts

    def records(self, state: Episode) -> dict[str, float]:
        """Return the values that the picture shows at a measurement, by name."""
        task, truth, estimator = self.task, state.truth, state.filter
        assert isinstance(estimator, KalmanState | HypothesesState)
        available = state.measurement.available[self.shown, 0] > 0.0
        values = {
            "command": truth.command[0],
            "output": truth.state[task.output, 0],
            "estimate": self.model.mean(state)[task.output, 0],
            "control": self.model.feedback(estimator, state.measurement)[0],
            # The line has a gap where there is no reading.
            "innovation": estimator.innovation[self.shown, 0] if available else math.nan,
            "mean_nis": estimator.mean_nis[0],
            "level": truth.level[0],
        }
        if self.model.control == "mode":
            values["mode"] = float(estimator.action[:, 0].argmax())
        elif isinstance(estimator, HypothesesState):
            values |= self.beliefs(estimator)
        elif self.model.control == "noise":
            for name, action in zip(self.actions, estimator.action[:, 0], strict=True):
                values[f"action.{name}"] = action
        else:
            values["log10_scale"] = math.log10(estimator.scale[0])
        return values | {f"sensor_level.{s}": truth.sensor_level[k, 0] for k, s in enumerate(task.sensors)}

    def beliefs(self, estimator: HypothesesState) -> dict[str, float]:
        """Return the probabilities of hypotheses on the gusts, summed for each drawn line, by name."""
        assert isinstance(self.model.filter, HypothesesBank)
        designed, *others = estimator.probabilities[:, 0]
        stronger = sum(
            p for p, level in zip(others, self.model.filter.gust_levels, strict=True) if level > 1.0
        )
        values = (designed, sum(others) - stronger, stronger)
        return {f"gusts.{name}": float(value) for name, value in zip(GUSTS, values, strict=True)}

    def strips(self) -> Sequence[Strip]:
        """Return the time series of the picture: of the loop in the left column, of the filter in the right one."""
        task = self.task
        output = task.components[task.output]
        name, unit = CONTROL[task.parameters.plant]
        disturbance = "gusts" if task.parameters.plant == "U" else "control"
        levels = {disturbance: "level", **{s: f"sensor_level.{s}" for s in task.sensors}}
        if self.model.control == "gain":
            reach = task.parameters.gain_decades
            steered = Strip(
                "action: log10 of the factor on the process noise",
                {"action": "log10_scale"},
                (-1.05 * reach, 1.05 * reach),
                guides=(0.0,),
            )
        elif self.model.control == "noise":
            actions = {name: f"action.{name}" for name in self.actions}
            steered = Strip("action: noises", actions, (-1.08, 1.08), guides=(0.0,), steps=True)
        elif self.model.control == "hypotheses":
            steered = Strip(
                "probabilities of the gusts", {name: f"gusts.{name}" for name in GUSTS}, (-0.04, 1.04)
            )
        else:
            legend = ", ".join(f"{i} {mode}" for i, mode in enumerate(MODES))
            steered = Strip(f"action: mode ({legend})", {"mode": "mode"}, (-0.2, 3.2), steps=True)
        return [
            Strip(
                f"{output.name}, {output.unit}",
                {"output": "output", "command": "command"},
                (-LEAST, LEAST),
                guides=(0.0,),
            ),
            Strip(f"{name}, {unit}", {"control": "control"}, (-2.0, 2.0), guides=(0.0,)),
            error_strip(f"error of the {output.name} estimate, {output.unit}", output.name, 0.5),
            Strip(
                f"innovation of {self.sensor} over its σ; gaps are dropouts",
                {"innovation": "innovation"},
                (-4.0, 4.0),
                guides=(-2.0, 0.0, 2.0),
            ),
            Strip("NIS per reading, short average", {"NIS": "mean_nis"}, (0.0, 2.0), guides=(1.0,)),
            Strip("hidden: noise over nominal", levels, (0.0, 2.2), guides=(1.0,), steps=True),
            steered,
        ]

    def shows_observation(self) -> bool:
        """Return True: the observation fills the picture's eighth panel."""
        return True


PICTURE = UavAutopilotPicture
