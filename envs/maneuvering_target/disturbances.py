"""Disturbances of the radar of ManeuveringTarget, except those of its scan times: one class each.

Errors are along x and y, or, where measurements are polar, of range and azimuth, in units of the white ones' standard
deviations. A measurement reports none of them.
"""

from typing import NamedTuple

from ..contract.draws import Draws
from ..contract.faults import Disturbance, DisturbanceInput, GaussMarkov, Glint, draw_undisturbed
from ..contract.observation import Array
from .clutter import Clutter
from .parameters import ManeuveringTargetParameters


class ColouredScanErrorsState(NamedTuple):
    """Coloured errors of the scans: standard deviation, correlation time, current errors."""

    deviation: Array
    """Stationary standard deviation, ``(N,)``."""
    correlation_time: Array
    """Correlation time, s, ``(N,)``."""
    level: Array
    """Errors in this scan, ``(2, N)``."""


class ColouredScanErrors(Disturbance):
    """Disturbance by errors that are correlated from scan to scan, added to the white ones."""

    name = "coloured"
    initial_normals = 2
    normals = 2

    @classmethod
    def is_enabled(cls, parameters: ManeuveringTargetParameters) -> bool:
        """Return whether the parameters allow coloured errors."""
        return parameters.coloured

    def begin(self, draws: Draws, normals: Array, zero: Array) -> ColouredScanErrorsState:
        """Draw the standard deviation, correlation time and stationary initial errors."""
        p = self.parameters
        deviation = draws.uniform("coloured_sigma", p.coloured_sigma)
        calm = draw_undisturbed(draws, p)
        if calm is not None:
            deviation = self.xp.where(calm, 0.0, deviation)
        return ColouredScanErrorsState(
            deviation, draws.uniform("coloured_time", p.coloured_time), deviation * normals
        )

    def advance(self, state: ColouredScanErrorsState, step: DisturbanceInput) -> ColouredScanErrorsState:
        """Return the state with the coloured errors of the next scan."""
        process = GaussMarkov.sampled(state.deviation, state.correlation_time, step.interval, self.xp)
        return state._replace(level=process.advance(state.level, step.normals))

    def change_errors(self, state: ColouredScanErrorsState, errors: Array) -> Array:
        """Return the sensor errors with the coloured ones added."""
        return errors + state.level

    def context(self, state: ColouredScanErrorsState) -> dict[str, Array]:
        """Return the standard deviation of the coloured errors, by name."""
        return {"coloured_sigma": state.deviation}


class Bias(Disturbance):
    """Disturbance by errors that are constant in an episode; they are its state, ``(2, N)``."""

    name = "bias"

    @classmethod
    def is_enabled(cls, parameters: ManeuveringTargetParameters) -> bool:
        """Return whether the parameters allow a bias."""
        return parameters.bias > 0.0

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Array:
        """Draw the constant sensor errors, ``(2, N)``."""
        return draws.uniform("bias", (-self.parameters.bias, self.parameters.bias), 2)

    def change_errors(self, state: Array, errors: Array) -> Array:
        """Return the sensor errors with the constant ones added."""
        return errors + state

    def context(self, state: Array) -> dict[str, Array]:
        """Return the constant errors, by name."""
        return {"bias": state}


DISTURBANCES: tuple[type[Disturbance], ...] = (Glint, ColouredScanErrors, Bias, Clutter)
"""Disturbances in the order in which they use random numbers and act. New ones are appended, so that episodes do not
change."""
