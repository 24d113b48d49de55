"""Disturbances of the radar of ManeuveringTarget, without those of its scan times: a class for each.

Errors are along x and y, or, where measurements are polar, of range and azimuth, in units of the white ones' standard
deviations. None of it is reported.
"""

from typing import NamedTuple

from ..contract.draws import Draws
from ..contract.faults import Disturbance, DisturbanceInput, GaussMarkov, Glint, undisturbed
from ..contract.observation import Array
from .clutter import Clutter
from .parameters import ManeuveringTargetParameters


class ColouredScanErrorsState(NamedTuple):
    """State of :class:`ColouredScanErrors`."""

    deviation: Array
    """``(N,)``."""
    correlation_time: Array
    """s, ``(N,)``."""
    level: Array
    """In this scan, ``(2, N)``."""


class ColouredScanErrors(Disturbance):
    """Errors that last from scan to scan, beside the white ones."""

    name = "coloured"
    initial_normals = 2
    normals = 2

    @classmethod
    def is_in(cls, parameters: ManeuveringTargetParameters) -> bool:
        """Return whether there may be coloured errors."""
        return parameters.coloured

    def begin(self, draws: Draws, normals: Array, zero: Array) -> ColouredScanErrorsState:
        """Draw how large they are and how long they last; they are stationary from the start."""
        p = self.parameters
        deviation = draws.uniform("coloured_sigma", p.coloured_sigma)
        calm = undisturbed(draws, p)
        if calm is not None:
            deviation = self.xp.where(calm, 0.0, deviation)
        return ColouredScanErrorsState(
            deviation, draws.uniform("coloured_time", p.coloured_time), deviation * normals
        )

    def advance(self, state: ColouredScanErrorsState, step: DisturbanceInput) -> ColouredScanErrorsState:
        """Advance the errors by a scan."""
        process = GaussMarkov.sampled(state.deviation, state.correlation_time, step.interval, self.xp)
        return state._replace(level=process.advance(state.level, step.normals))

    def change_errors(self, state: ColouredScanErrorsState, errors: Array) -> Array:
        """Add them."""
        return errors + state.level

    def context(self, state: ColouredScanErrorsState) -> dict[str, Array]:
        """Their standard deviation."""
        return {"coloured_sigma": state.deviation}


class Bias(Disturbance):
    """Errors that are the same in all scans of an episode; its state, ``(2, N)``."""

    name = "bias"

    @classmethod
    def is_in(cls, parameters: ManeuveringTargetParameters) -> bool:
        """Return whether there is a bias."""
        return parameters.bias > 0.0

    def begin(self, draws: Draws, normals: Array, zero: Array) -> Array:
        """Draw them."""
        return draws.uniform("bias", (-self.parameters.bias, self.parameters.bias), 2)

    def change_errors(self, state: Array, errors: Array) -> Array:
        """Add them."""
        return errors + state

    def context(self, state: Array) -> dict[str, Array]:
        """All of it."""
        return {"bias": state}


DISTURBANCES: tuple[type[Disturbance], ...] = (Glint, ColouredScanErrors, Bias, Clutter)
"""In the order in which they take random numbers and act; a further one comes last, so that episodes stay."""
