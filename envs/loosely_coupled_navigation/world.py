"""World of LooselyCoupledNavigation: motion, INS and receiver; equations in ``filters/loosely_coupled.py``."""

import math
from typing import Any, ClassVar, NamedTuple

import numpy

from ...filters.ordered_sums import ordered_sum
from ..contract.draws import Draws
from ..contract.faults import Disturbances, draw_undisturbed
from ..contract.filter import Initial
from ..contract.observation import Array
from ..contract.task import Task
from ..contract.world import World
from .disturbances import DISTURBANCES, DRAWN_FIRST
from .parameters import LooselyCoupledNavigationParameters


class Truth(NamedTuple):
    """True motion, INS errors, and state of the receiver's disturbances; A axes."""

    number: Array
    """Number of measurements so far, ``(N,)``."""
    reference: Array
    """Position Xr, m, ``(A, N)``."""
    harmonics: Array
    """Harmonics whose sum is the motion, m, and the same a quarter of a period ahead, ``(2, M, A, N)``."""
    turn: Array
    """Sine and cosine of the phase that they gain between measurements, ``(2, M, A, N)``."""
    ins: Array
    """Position X by the INS alone, m, ``(A, N)``."""
    drift: Array
    """Constant rate error beta, m/s, ``(A, N)``."""
    coloured: Array
    """Coloured rate error eta, m/s, ``(A, N)``."""
    drift_deviation: Array
    """True standard deviation of beta, m/s, ``(N,)``."""
    coloured_step: Array
    """Standard deviation of the gain of eta between measurements, m/s, ``(N,)``."""
    white_step: Array
    """Standard deviation of the displacement that this gain does not explain, m, ``(N,)``."""
    deviation: Array
    """True standard deviation of this fix, m, ``(N,)``."""
    available: Array
    """One where the receiver has a fix, otherwise zero, ``(N,)``."""
    disturbances: dict[str, Any]
    """State of each disturbance by its name, see :mod:`.disturbances`."""


class Measurement(NamedTuple):
    """Readings of INS and receiver; A axes."""

    number: Array
    """Number of the measurement, from 1 on, ``(N,)``. Measurements are ``sampling_interval`` seconds apart, the
    first one that long after the start of the track."""
    ins: Array
    """Position X by the INS alone, m, ``(A, N)``; at the start of the track it is the reference."""
    increment: Array
    """Change of X since the previous measurement, m, ``(A, N)``."""
    fix: Array
    """Position Z by the receiver, m, ``(A, N)``; where there is none zero, and NaN for an estimator."""
    available: Array
    """One where the receiver has a fix, otherwise zero, ``(N,)``; the INS always has a position."""
    reported_deviation: Array
    """Standard deviation of each axis of the fix as the receiver reports it, m, ``(N,)``; it may be wrong. It is
    reported without a fix, too."""


class InsGnssWorld(World[Task, Truth, Measurement]):
    """World of harmonic motion, an inertial system (INS) with three rate errors, and a satellite receiver."""

    own_parameters: ClassVar[tuple[str, ...]] = ("duration",)
    parameters: LooselyCoupledNavigationParameters
    received_field = "fix"
    stated_field = "reported_deviation"

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        axes = self.parameters.axes
        self.disturbances: Disturbances = Disturbances.of(task, DISTURBANCES, DRAWN_FIRST)
        self.initial_normals: int = 2 * axes + self.disturbances.initial_normals
        self.normals: int = 3 * axes + self.disturbances.normals
        self.row_uniforms: int = self.disturbances.row_uniforms
        self.phase: Array = task.constant([math.pi / 2 * i for i in range(axes)])[:, None]
        self.no_covariance: Array = task.constant(numpy.zeros((axes, axes)))[:, :, None]

    def reading_deviations(self, measurement: Measurement) -> Array:
        """Return the reported standard deviation of the fix, m, ``(A, N)``."""
        return measurement.reported_deviation + 0.0 * measurement.fix

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Draw noise levels, disturbances and rate errors; return this truth, and its position as initial estimate."""
        xp, p = self.xp, self.parameters
        calm = draw_undisturbed(draws, p)

        def factor(name: str, limits: tuple[float, float]) -> Array:
            drawn = draws.log_uniform(name, limits)
            return drawn if calm is None else xp.where(calm, 1.0, drawn)

        drift_deviation = p.drift * factor("drift_factor", p.drift_factor)
        coloured_deviation = p.coloured * xp.sqrt(factor("coloured_factor", p.coloured_factor))
        white_intensity = p.white_intensity * factor("white_factor", p.white_factor)
        beta, eta = normals[: p.axes], normals[p.axes : 2 * p.axes]
        zeros = 0.0 * beta
        states = self.disturbances.begin(draws, normals[2 * p.axes :], zeros[0])
        harmonics, turn = self._motion(draws, zeros)
        reference = ordered_sum(harmonics[0])
        states = self.disturbances.switch_off(self.disturbances.draw_further(states, draws), calm)
        truth = Truth(
            number=zeros[0],
            reference=reference,
            harmonics=harmonics,
            turn=turn,
            ins=reference,
            drift=drift_deviation * beta if p.fixed_drift is None else zeros + p.fixed_drift,
            coloured=coloured_deviation * eta,
            drift_deviation=drift_deviation,
            coloured_step=p.sampling.coloured * coloured_deviation,
            white_step=xp.sqrt(
                white_intensity * p.sampling_interval + p.sampling.residual * coloured_deviation**2
            ),
            deviation=self.disturbances.change_deviations(states, zeros[0] + 1.0),
            available=zeros[0] + 1.0,
            disturbances=states,
        )
        return truth, Initial(reference, self.no_covariance + zeros[0])

    def _motion(self, draws: Draws, zeros: Array) -> tuple[Array, Array]:
        """Draw the harmonics of the motion: initial values, m, and rotation in a step, ``(2, M, A, N)`` each."""
        xp, p = self.xp, self.parameters
        count, many = max(p.manoeuvres, 1), zeros[None] + xp.zeros((max(p.manoeuvres, 1), 1, 1))
        if p.manoeuvres:
            drawn = [
                xp.reshape(draw(f"manoeuvre_{name}", limits, count * p.axes), many.shape)
                for draw, name, limits in (
                    (draws.log_uniform, "rate", p.manoeuvre_rate),
                    (draws.uniform, "acceleration", p.manoeuvre_acceleration),
                    (draws.uniform, "phase", (0.0, 2.0 * math.pi)),
                )
            ]
            rate, amplitude, phase = drawn[0], drawn[1] / (drawn[0] * drawn[0]), drawn[2]
        else:
            rate, amplitude, phase = many + p.reference_rate, many + p.reference_amplitude, many + self.phase
        angle = p.sampling_interval * rate
        return (
            xp.stack([amplitude * xp.sin(phase), amplitude * xp.cos(phase)]),
            xp.stack([xp.sin(angle), xp.cos(angle)]),
        )

    def advance(self, truth: Truth, noise: Array, feedback: None) -> tuple[Truth, Measurement]:
        """Return the truth after one sampling interval, and the readings of INS and receiver.

        The rows of ``noise`` are: coloured, white, the receiver's white, and those of the disturbances.
        """
        xp, p, s, n = self.xp, self.parameters, self.parameters.sampling, self.parameters.axes
        number = truth.number + 1.0
        kick = truth.coloured_step * noise[:n]
        slip = s.step * truth.drift + s.drive * truth.coloured + s.coupling * kick
        # Sines by the addition theorem: four products in place of a sine for each harmonic.
        (sine, cosine), (across, along) = truth.harmonics, truth.turn
        harmonics = xp.stack([along * sine + across * cosine, along * cosine - across * sine])
        reference = ordered_sum(harmonics[0])
        increment = (reference - truth.reference) + (slip + truth.white_step * noise[n : 2 * n])
        ins = truth.ins + increment

        further = noise[3 * n : self.normals], noise[self.normals :]
        steps = self.disturbances.split_noise(number, p.sampling_interval, *further, feedback)
        states = self.disturbances.advance(truth.disturbances, steps)
        deviation = self.disturbances.change_deviations(states, xp.ones_like(number))
        reading = reference + deviation * noise[2 * n : 3 * n]
        states, fix = self.disturbances.change_reading(states, reading)
        measurement = Measurement(number, ins, increment, fix, xp.ones_like(number), deviation)
        states, measurement = self.disturbances.change_measurement(states, measurement, steps)
        truth = truth._replace(
            number=number,
            reference=reference,
            harmonics=harmonics,
            ins=ins,
            coloured=s.decay * truth.coloured + kick,
            deviation=deviation,
            available=measurement.available,
            disturbances=states,
        )
        return truth, measurement

    def state(self, truth: Truth) -> Array:
        """Return the true position of the vehicle, m, ``(A, N)``."""
        return truth.reference

    def component_readings(self, measurement: Measurement) -> Array:
        """Return the fix of the receiver, m, ``(A, N)``; NaN where there is none."""
        return self.mask_missing(measurement).fix

    def component_deviations(self, measurement: Measurement) -> Array:
        """Return the reported standard deviation of the fix, m, ``(A, N)``."""
        return measurement.reported_deviation + 0.0 * measurement.fix

    def error_cost(self, error: Array) -> Array:
        """Return the squared position error, summed over axes, over the nominal variance of a fix, ``(N,)``."""
        return ordered_sum(error * error) / self.parameters.receiver_variance

    def records(self, truth: Truth) -> dict[str, Array]:
        """Return whether there is a fix, and its true and reported noise, to record at a measurement, by name."""
        return {
            "available": truth.available,
            "receiver_deviation": truth.deviation,
            **self.disturbances.records(truth.disturbances),
        }

    def context(self, truth: Truth) -> dict[str, Array]:
        """Return noise levels, disturbances and the receiver's current state, among other draws, by name.

        Times are numbers of measurements: the first in a window and the first one after it.
        """
        return {
            "drift_deviation": truth.drift_deviation,
            "coloured_step": truth.coloured_step,
            "white_step": truth.white_step,
            **self.disturbances.context(truth.disturbances),
            "drift": truth.drift,
            "receiver_deviation": truth.deviation,
            "available": truth.available,
        }
