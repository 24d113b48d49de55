"""The motion of LooselyCoupledNavigation, its INS, and the receiver; equations in ``filters/loosely_coupled.py``."""

import math
from typing import NamedTuple

import numpy

from ...filters.ordered_sums import ordered_sum
from ..contract.draws import Draws, draw_between
from ..contract.faults import GaussMarkov, Outliers
from ..contract.filter import Initial
from ..contract.observation import Array
from ..contract.schedules import Steps, within
from ..contract.task import Task
from ..contract.world import World
from .parameters import LooselyCoupledNavigationParameters

NEVER = 1e9
"""Number of the measurement at which happens what does not; finite, so that arithmetic on it stays finite."""


class Truth(NamedTuple):
    """The motion, the errors of the INS, and what befalls the receiver; A axes."""

    number: Array
    """Measurements so far, ``(N,)``."""
    reference: Array
    """Position Xr, m, ``(A, N)``."""
    harmonics: Array
    """Motions that it is the sum of, m, and the same a quarter of a period ahead, ``(2, M, A, N)``."""
    turn: Array
    """Sine and cosine of what their phases gain from one measurement to the next, ``(2, M, A, N)``."""
    ins: Array
    """Position X that the INS has come to, m, ``(A, N)``."""
    drift: Array
    """Constant rate error beta, m/s, ``(A, N)``."""
    coloured: Array
    """Coloured rate error eta, m/s, ``(A, N)``."""
    drift_deviation: Array
    """True standard deviation of beta, m/s, ``(N,)``."""
    coloured_step: Array
    """Standard deviation of what eta gains from one measurement to the next, m/s, ``(N,)``."""
    white_step: Array
    """Standard deviation of the displacement that this gain does not explain, m, ``(N,)``."""
    receiver_levels: Array
    """Standard deviation of the receiver noise before, between and after its changes, m, ``(3, N)``."""
    reported_levels: Array
    """What the receiver reports in its place, m, ``(3, N)``."""
    change: Array
    """First measurement after each change, ``(2, N)``."""
    outage: Array
    """First measurement of the outage and first one after it, ``(2, N)``."""
    jamming: Array
    """Likewise, ``(2, N)``."""
    spoofing: Array
    """Likewise, ``(2, N)``."""
    jamming_gain: Array
    """Standard deviation of the receiver noise under jamming over that without, ``(N,)``."""
    spoofing_rate: Array
    """Rate at which every axis is pulled off, m/s, ``(N,)``."""
    receiver_decay: Array
    """What is left of the receiver's coloured error from one measurement to the next, ``(N,)``."""
    receiver_kick: Array
    """Standard deviation of what it gains, m, ``(N,)``."""
    receiver_error: Array
    """That error, m, ``(A, N)``; zero where the task has none."""
    deviation: Array
    """True standard deviation of this measurement, m, ``(N,)``."""
    reported_deviation: Array
    """What the receiver says of it, m, ``(N,)``."""
    available: Array
    """One where the receiver has a measurement, otherwise zero, ``(N,)``."""


class Measurement(NamedTuple):
    """What INS and receiver say; A axes."""

    number: Array
    """Number of the measurement, from 1 on, ``(N,)``; it is taken ``sampling_interval`` seconds after the one
    before, the first one that long after the start of the track."""
    ins: Array
    """Position X by the INS alone, m, ``(A, N)``; at the start of the track it is the reference."""
    increment: Array
    """X minus X at the measurement before, m, ``(A, N)``."""
    fix: Array
    """Position Z by the receiver, m, zero where there is none, where an estimator gets NaN, ``(A, N)``."""
    available: Array
    """One where the receiver has a fix, otherwise zero, ``(N,)``; the INS always speaks."""
    reported_deviation: Array
    """Standard deviation of each axis of the fix as the receiver reports it, m, ``(N,)``; it may be wrong, and it
    goes on where there is no fix."""


class InsGnssWorld(World[Task, Truth, Measurement]):
    """A motion of harmonics, an inertial system with three rate errors, and a satellite receiver."""

    own_parameters = ("duration",)
    parameters: LooselyCoupledNavigationParameters
    received_field, stated_field = "fix", "reported_deviation"

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        axes = self.parameters.axes
        p = self.parameters
        self.receiver_is_coloured = p.receiver_coloured[1] > 0.0
        kinds = 3 if self.receiver_is_coloured else 2
        self.initial_normals, self.normals = kinds * axes, (kinds + 1) * axes
        self.outliers = Outliers(p.outlier_probability, math.sqrt(p.outlier_factor))
        self.row_uniforms = self.outliers.row_uniforms
        self.phase = task.constant([math.pi / 2 * i for i in range(axes)])[:, None]
        self.no_covariance = task.constant(numpy.zeros((axes, axes)))[:, :, None]

    def reading_deviations(self, measurement: Measurement) -> Array:
        """What the receiver reports."""
        return measurement.reported_deviation + 0.0 * measurement.fix

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Draw noise levels, disturbances and rate errors; at the start INS and reference agree."""
        xp, p = self.xp, self.parameters
        calm = draws.event("undisturbed", p.undisturbed) if p.undisturbed else None

        def unless_calm(drawn: Array, otherwise: float) -> Array:
            return drawn if calm is None else xp.where(calm, otherwise, drawn)

        def factor(name: str, limits: tuple[float, float]) -> Array:
            return unless_calm(draws.log_uniform(name, limits), 1.0)

        drift_deviation = p.drift * factor("drift_factor", p.drift_factor)
        coloured_deviation = p.coloured * xp.sqrt(factor("coloured_factor", p.coloured_factor))
        white_intensity = p.white_intensity * factor("white_factor", p.white_factor)
        factors = [factor("receiver_factor", p.receiver_factor)]
        changes = unless_calm(draws.integer("noise_changes", p.noise_changes), 0.0)
        first, second = self._number_at(draws.uniform("change_start", p.change_start, 2))
        factors += list(draws.log_uniform("changed_receiver_factor", p.receiver_factor, 2))
        unreported = draws.event("unreported", p.unreported, 2)
        windows = {
            name: unless_calm(self._window(name, draws), NEVER) for name in ("outage", "jamming", "spoofing")
        }

        both = changes == 2
        earlier = xp.where(changes == 0, NEVER, xp.where(both, xp.minimum(first, second), first))
        later = xp.where(both, xp.maximum(first, second), NEVER)
        levels = [xp.sqrt(p.receiver_variance * factor) for factor in factors]
        reported = levels[:1]
        for level, silent in zip(levels[1:], unreported, strict=True):
            reported.append(xp.where(silent, reported[-1], level))

        beta, eta = normals[: p.axes], normals[p.axes : 2 * p.axes]
        zeros = 0.0 * beta
        harmonics, turn = self._motion(draws, zeros)
        reference = ordered_sum(harmonics[0])
        wandering = draw_between(draws.uniform, "receiver_coloured", p.receiver_coloured)
        coloured = zeros[0] + unless_calm(zeros[0] + wandering, 0.0)
        lasting = zeros[0] + draw_between(
            draws.log_uniform, "receiver_correlation_time", p.receiver_correlation_time
        )
        receiver = GaussMarkov.sampled(coloured, lasting, p.sampling_interval, xp)
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
            receiver_levels=xp.stack(levels),
            reported_levels=xp.stack(reported),
            change=xp.stack([earlier, later]),
            **windows,
            jamming_gain=xp.sqrt(
                zeros[0] + draw_between(draws.log_uniform, "jamming_factor", p.jamming_factor)
            ),
            spoofing_rate=zeros[0] + draw_between(draws.uniform, "spoofing_rate", p.spoofing_rate),
            receiver_decay=receiver.decay,
            receiver_kick=receiver.kick,
            receiver_error=coloured * normals[2 * p.axes :] if self.receiver_is_coloured else zeros,
            deviation=levels[0],
            reported_deviation=reported[0],
            available=zeros[0] + 1.0,
        )
        return truth, Initial(reference, self.no_covariance + zeros[0])

    def _motion(self, draws: Draws, zeros: Array) -> tuple[Array, Array]:
        """Harmonics at the start, m, and how they turn; each ``(2, M, A, N)``."""
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

    def _number_at(self, time: Array) -> Array:
        """Number of the measurement nearest to a time in s."""
        return self.xp.round(time / self.parameters.sampling_interval)

    def _window(self, name: str, draws: Draws) -> Array:
        """First measurement of a disturbance and first one after it, ``(2, N)``."""
        xp, p = self.xp, self.parameters
        happens = draws.event(name, getattr(p, f"{name}_probability"))
        first = self._number_at(draws.uniform(f"{name}_start", getattr(p, f"{name}_start")))
        beyond = first + self._number_at(draws.uniform(f"{name}_duration", getattr(p, f"{name}_duration")))
        return xp.stack([xp.where(happens, first, NEVER), xp.where(happens, beyond, NEVER)])

    def advance(self, truth: Truth, noise: Array, feedback: None) -> tuple[Truth, Measurement]:
        """Move on by one sampling interval and read INS and receiver; noise: coloured, white, receiver's white and
        coloured, outliers.
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

        deviation, reported = truth.receiver_levels[0], truth.reported_levels[0]
        available = truth.available
        if p.noise_changes[1]:
            levels = truth.receiver_levels, truth.reported_levels
            deviation, reported = (Steps(level, truth.change).at(number, xp) for level in levels)
        if p.jamming_probability:
            deviation = xp.where(within(number, truth.jamming), truth.jamming_gain * deviation, deviation)
        deviation = self.outliers.amplify(deviation, noise[self.normals :], xp)
        fix = reference + deviation * noise[2 * n : 3 * n]
        error = truth.receiver_error
        if self.receiver_is_coloured:
            process = GaussMarkov(truth.receiver_decay, truth.receiver_kick)
            error = process.advance(error, noise[3 * n : 4 * n])
            fix = fix + error
        if p.spoofing_probability:
            pull = (truth.spoofing_rate * p.sampling_interval) * (number - truth.spoofing[0] + 1.0)
            fix = fix + xp.where(within(number, truth.spoofing), pull, 0.0)
        if p.outage_probability:
            available = xp.where(within(number, truth.outage), 0.0, xp.ones_like(number))
            fix = available * fix
        truth = truth._replace(
            number=number,
            reference=reference,
            harmonics=harmonics,
            ins=ins,
            coloured=s.decay * truth.coloured + kick,
            receiver_error=error,
            deviation=deviation,
            reported_deviation=reported,
            available=available,
        )
        return truth, Measurement(number, ins, increment, fix, available, reported)

    def state(self, truth: Truth) -> Array:
        """Position, ``(A, N)``."""
        return truth.reference

    def component_readings(self, measurement: Measurement) -> Array:
        """The receiver's position."""
        return self.mask_missing(measurement).fix

    def component_deviations(self, measurement: Measurement) -> Array:
        """As the receiver reports it."""
        return measurement.reported_deviation + 0.0 * measurement.fix

    def error_cost(self, error: Array) -> Array:
        """Squared error of position, summed over the axes, over the nominal variance of a measurement."""
        return ordered_sum(error * error) / self.parameters.receiver_variance

    def records(self, truth: Truth) -> dict[str, Array]:
        """Whether there is a measurement, its noise, and what is reported of that."""
        return {
            "available": truth.available,
            "receiver_deviation": truth.deviation,
            "reported_deviation": truth.reported_deviation,
        }

    def context(self, truth: Truth) -> dict[str, Array]:
        """Noise levels of INS and receiver, their changes and disturbances as numbers of measurements (the first in a
        window and the first one after it), and what the receiver is like now.
        """
        xp = self.xp
        windows = {
            name: xp.where(numbers < NEVER, numbers, -1.0)
            for name, numbers in (
                ("change", truth.change),
                ("outage", truth.outage),
                ("jamming", truth.jamming),
                ("spoofing", truth.spoofing),
            )
        }
        return {
            "drift_deviation": truth.drift_deviation,
            "coloured_step": truth.coloured_step,
            "white_step": truth.white_step,
            "receiver_levels": truth.receiver_levels,
            "reported_levels": truth.reported_levels,
            **windows,
            "jamming_gain": truth.jamming_gain,
            "spoofing_rate": truth.spoofing_rate,
            "receiver_decay": truth.receiver_decay,
            "receiver_kick": truth.receiver_kick,
            "drift": truth.drift,
            "receiver_deviation": truth.deviation,
            "available": truth.available,
        }
