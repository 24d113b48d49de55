"""Clutter of ManeuveringTarget: false plots around a track, and the association of one plot with the target.

False plots are a Poisson field over the whole plane, new in every scan. A tracker processes a window around the
predicted position, so the plots of a scan are those in the window of the filter in the loop: uniformly distributed,
independent of the target, and of unknown origin. That closes a loop: the radar needs the filter's estimate. The same
random numbers make false plots at the same places of every filter's window.

Filters that use one plot receive the nearest to their estimate, predicted at constant velocity.
"""

import math
from typing import Any, NamedTuple

from ...filters import data_association, polar
from ..contract.draws import Draws
from ..contract.faults import Disturbance, DisturbanceInput
from ..contract.observation import Array
from .parameters import PLOT_SLOTS, ManeuveringTargetParameters


class ReportedTrack(NamedTuple):
    """Feedback of a filter in clutter: the estimate around which the radar returns plots."""

    mean: Array
    """Position and velocity after the previous scan, ``(4, N)``."""
    covariance: Array
    """Covariance of the mean, ``(4, 4, N)``."""


class Echo(NamedTuple):
    """Plot that originates from the target; competitors do not receive it as such."""

    position: Array
    """Position, m, ``(2, N)``."""
    available: Array
    """1 if the scan saw the target, ``(N,)``."""


class ClutterState(NamedTuple):
    """State of the clutter: density of false plots, the target's own plot, whether a false one was taken for it."""

    density: Array
    """False plots per square metre, ``(N,)``."""
    unseen: Array
    """Time since the last scan with a plot in the gate, s, zero if that is the current one, ``(N,)``."""
    echo: Echo
    false_association: Array
    """1 if the plot in the gate is not the target's, ``(N,)``."""


class Clutter(Disturbance):
    """Disturbance by clutter: false plots, uniformly distributed in a window around the track.

    The uniform numbers of a scan draw the number of plots, which of them is the target's, and the position of each.
    """

    name = "clutter"
    row_uniforms = 2 * PLOT_SLOTS + 2

    @classmethod
    def is_enabled(cls, parameters: ManeuveringTargetParameters) -> bool:
        """Return whether the parameters give a density of false plots above zero."""
        return parameters.cluttered

    def begin(self, draws: Draws, normals: Array, zero: Array) -> ClutterState:
        """Draw the density of false plots, per square metre, for the disturbance's state."""
        density = 1e-6 * draws.uniform("clutter_density", self.parameters.clutter_density)
        return ClutterState(
            density, 0.0 * density, Echo(self.xp.stack([zero, zero]), 0.0 * density), 0.0 * density
        )

    def count(self, uniform: Array, density: Array) -> Array:
        """Draw the Poisson-distributed number of false plots in the window, ``(N,)``, below the number of slots.

        It is computed by the inverse of the cumulative distribution.
        """
        mean = density * self.parameters.window_area
        term = self.xp.exp(-mean)
        cumulative, count = term, 0.0 * mean
        for i in range(1, PLOT_SLOTS):
            count = count + self.xp.astype(uniform >= cumulative, count.dtype)
            term = term * mean / float(i)
            cumulative = cumulative + term
        return count

    def change_measurement(
        self, state: ClutterState, measurement: Any, step: DisturbanceInput
    ) -> tuple[ClutterState, Any]:
        """Return the state, and the measurement with false plots and with the plot taken for the target's."""
        xp, p, uniforms = self.xp, self.parameters, step.uniforms
        track, interval, echo = (
            step.feedback,
            measurement.interval,
            Echo(measurement.position, measurement.available),
        )
        elapsed = state.unseen + interval
        centre, covariance = self.predict(track, interval, elapsed)
        offset = xp.abs(echo.position - centre)
        inside = (offset[0] < p.clutter_window) & (offset[1] < p.clutter_window)
        seen = xp.where(inside, echo.available, 0.0)
        total = self.count(uniforms[0], state.density) + seen
        place = xp.where(seen > 0.0, xp.floor(uniforms[1] * total), -1.0)
        rows = uniforms[2:]
        places = xp.stack([rows[:PLOT_SLOTS], rows[PLOT_SLOTS:]])
        false = centre[:, None] + p.clutter_window * (2.0 * places - 1.0)
        slots = range(PLOT_SLOTS)
        positions = xp.stack([xp.where(place == float(i), echo.position, false[:, i]) for i in slots], axis=1)
        there = xp.stack([xp.astype(float(i) < total, total.dtype) for i in slots])
        positions = xp.where(there > 0.0, positions, 0.0)
        variances = polar.cartesian_variances(positions, p.range_sigma, math.radians(p.bearing_sigma))
        variances = xp.where(there > 0.0, variances, p.range_sigma**2)
        distances = data_association.squared_distances(centre, covariance, positions, variances)
        picked, found = data_association.nearest_neighbour(distances, there, p.gate)
        position, variance, own = 0.0 * centre, 0.0 * centre, 0.0 * total
        for i in slots:
            position = position + picked[i] * positions[:, i]
            variance = variance + picked[i] * variances[:, i]
            own = own + xp.where(place == float(i), picked[i], 0.0)
        variance = xp.where(found, variance, p.range_sigma**2)
        available = xp.astype(found, total.dtype)
        state = ClutterState(state.density, (1.0 - available) * elapsed, echo, available - own)
        return state, measurement._replace(
            position=position,
            variance=variance,
            available=available,
            elapsed=elapsed,
            plots=data_association.Plots(positions, variances, there),
        )

    def predict(self, track: ReportedTrack, interval: Array, elapsed: Array) -> tuple[Array, Array]:
        """Return the track's position predicted to the scan, ``(2, N)``, and its covariance, ``(2, 2, N)``.

        The prediction is at constant velocity with an acceleration of ``gate_acceleration`` since the last plot.
        """
        P, T = track.covariance, interval
        centre = track.mean[:2] + T * track.mean[2:]
        carried = P[:2, :2] + T * (P[:2, 2:] + P[2:, :2]) + T**2 * P[2:, 2:]
        left = (0.5 * elapsed**2 * self.parameters.gate_acceleration) ** 2
        identity = self.xp.eye(2, dtype=P.dtype, device=P.device)[:, :, None]
        return centre, carried + left * identity

    def context(self, state: ClutterState) -> dict[str, Array]:
        """Return the density of false plots per square kilometre, by name."""
        return {"clutter_density": 1e6 * state.density}

    def records(self, state: ClutterState) -> dict[str, Array]:
        """Return whether the plot taken for the target's is false, to record at a scan, by name."""
        return {"false_association": state.false_association}
