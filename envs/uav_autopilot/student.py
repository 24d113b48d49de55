"""The fully learned estimator of UavAutopilot: what :mod:`..contract.student` wants to know of it.

The motion is known, so that nothing is answered of it: equation (10) predicts. The components are the frame. The unit
of a coordinate with a sensor is the sensor's sigma, that of another the deviation of the settled filter, and the gain
of a network without training is that of the settled filter, the paper's.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy

from ..contract.observation import SHARE, SIGNED_LOG, Array, Block
from ..contract.student import StudentBank, View
from .parameters import UavAutopilotParameters
from .world import Measurement

if TYPE_CHECKING:
    from .task import UavAutopilot

GAIN_RANGE = 8.0
"""Largest factor of an entry of the gain, beside what is added to it."""
LEAST_REACH = 0.05
"""What every entry can be moved by at least, over units."""


class AutopilotStudentBank(StudentBank["UavAutopilot", Measurement]):
    """The coordinates of the aircraft, corrected by gains around those of the settled filter."""

    parameters: UavAutopilotParameters

    def __init__(self, task: "UavAutopilot", control: str) -> None:
        design, measured = task.design, list(task.measured)
        sigmas = numpy.sqrt(task.sensor_variances)
        units = numpy.sqrt(numpy.diag(design.steady.posterior))
        units[measured] = sigmas
        gain = design.steady.gain * sigmas / units[:, None]
        self.gain, self.gain_reach = gain, numpy.maximum(GAIN_RANGE * abs(gain), LEAST_REACH)  # type: ignore[misc]
        self.axes = task.sensors  # type: ignore[misc]  # of its plant
        super().__init__(task, control)
        self.F, self.B = task.constant(design.model.F), task.constant(design.model.B)
        self.units, self.sigmas = task.constant(units)[:, None], task.constant(sigmas)[:, None]

    def look(self, mean: Array, motion: Array, measurement: Measurement) -> View:
        """Predict by the control that was in force."""
        mean = self.xp.matmul(self.F, mean) + self.B * measurement.control
        residual = measurement.available * (measurement.reading - self.task.readings_of(mean))
        return View(mean, None, self.units + 0.0 * mean, residual / self.sigmas)

    @property
    def features(self) -> Sequence[Block]:
        """Which sensors answered, what was commanded and done, and the clock."""
        unit, horizon = 1.0 / self.task.output_sigma, self.task.horizon
        return (
            Block(
                "available",
                lambda _, measurement: measurement.available,
                "1 where the sensor answered, 0 in a dropout",
                self.axes,
                SHARE,
            ),
            Block(
                "command",
                lambda _, measurement: unit * measurement.command,
                "the command over the output sensor's sigma",
                shown=SIGNED_LOG,
            ),
            Block(
                "control",
                lambda _, measurement: unit * measurement.control,
                "the control in force over the output sensor's sigma",
                shown=SIGNED_LOG,
            ),
            Block(
                "time",
                lambda _, measurement: measurement.number / (measurement.number + 0.1 * horizon),
                "n / (n + a tenth of the horizon), n measurements since the start",
                shown=SHARE,
            ),
        )
