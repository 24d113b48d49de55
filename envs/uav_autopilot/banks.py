"""Banks of UavAutopilot: Kalman filters by equations (10) to (12), with packed covariances."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import gaussian, packed_covariance
from ...filters.ordered_sums import ordered_sum
from ..contract.filter import Bank
from ..contract.observation import (
    LARGEST_LOG,
    SHARE,
    SIGNED_LOG,
    STORED_AS_LOG,
    Array,
    Block,
    Compression,
    Quantity,
    availability_block,
    average_block,
    clock_block,
    innovation_block,
    last_action_block,
)
from .parameters import UavAutopilotParameters
from .problem import AutopilotProblem
from .world import Measurement, Start

MODES = ("nominal", "wide-band", "raw-sensors", "over-smoothed")
FLOORED_LOG = Compression(
    "log of ", lambda value, xp: xp.log(xp.clip(value, 0.01, None)), numpy.exp, (math.log(0.01), LARGEST_LOG)
)
"""Compression by the logarithm, with a floor of a hundredth of the expected square, because squares may be zero."""


class KalmanState(NamedTuple):
    """State of the Kalman filter, with the estimate that the autopilot uses and innovation statistics."""

    mean: Array
    """Mean, predicted after ``predict`` and updated after ``act``, ``(n, N)``."""
    covariance: Array
    """Packed triangle of the covariance; after ``predict`` it is ``F P F^T``, without process noise."""
    estimate: Array
    """Estimate that the autopilot uses and the task reports, ``(n, N)``."""
    estimate_covariance: Array
    """Packed triangle of the covariance of ``estimate``."""
    scale: Array
    """Factor on the process noise in the last update, ``(N,)``."""
    action: Array
    """Last action as observed, ``(A, N)``."""
    innovation: Array
    """Innovation over its sigma; 0 in a dropout, ``(m, N)``."""
    nis: Array
    """Normalised innovation squared per available reading, ``(N,)``."""
    log_likelihood: Array
    """Log-density of the available readings under their prediction, ``(N,)``."""
    mean_innovation: Array
    """Short average of the innovation, ``(m, N)``."""
    mean_square: Array
    """Short average of the squared innovation, ``(m, N)``."""
    mean_nis: Array
    """Short average of the NIS, ``(N,)``."""


class AutopilotBank(Bank[AutopilotProblem, Measurement, Any]):
    """Base class of the banks in the control loop: observation blocks and innovation statistics."""

    parameters: UavAutopilotParameters
    action_block: Any
    no_action: tuple[float, ...]
    """Observed last action before the first one."""

    def __init__(self, task: AutopilotProblem, control: str) -> None:
        super().__init__(task, control)
        constant, n, m = task.constant, len(task.components), len(task.sensors)
        self.sensor_identity: Array = constant(numpy.eye(m)[:, :, None])
        self.sensor_sigmas: Array = constant(self.parameters.value("sensor_sigmas"))[:, None]
        self.trace_weights: Array = constant(1.0 / (n * numpy.diag(task.design.steady.posterior))[:, None])
        self.forget: float = 1.0 / self.parameters.averaging_measurements

    @property
    def blocks(self) -> Sequence[Block]:
        """Observation blocks of filter and autopilot, such as innovations, readings, command and control."""
        sensors, horizon = self.task.sensors, self.task.horizon
        unit = 1.0 / self.task.output_sigma
        return (
            innovation_block(sensors, text="the innovation over its sigma; 0 in a dropout"),
            average_block(
                "mean_innovation",
                lambda f, _: f.mean_innovation,
                "short average of the innovation over its sigma",
                sensors,
            ),
            Block(
                "log_mean_square",
                lambda f, _: f.mean_square,
                "the short average of its square",
                sensors,
                FLOORED_LOG,
            ),
            Block(
                "log_nis",
                lambda f, _: f.nis,
                "the normalised innovation squared per available reading",
                compression=FLOORED_LOG,
            ),
            Block("log_mean_nis", lambda f, _: f.mean_nis, "its short average", compression=FLOORED_LOG),
            Block(
                "command",
                lambda _, measurement: unit * measurement.command,
                "the command over the output sensor's sigma",
                compression=SIGNED_LOG,
            ),
            Block(
                "control",
                lambda _, measurement: unit * measurement.control,
                "the current control over the output sensor's sigma",
                compression=SIGNED_LOG,
            ),
            Block(
                "reading",
                lambda _, measurement: measurement.reading / self.sensor_sigmas,
                "the last valid reading over its sigma",
                sensors,
                SIGNED_LOG,
            ),
            Block(
                "log_trace",
                lambda f, _: self.log_trace(f),
                "the mean of the variances over those of the settled filter",
                compression=STORED_AS_LOG,
            ),
            availability_block(
                "1 where the sensor gave a reading, 0 in a dropout", parts=sensors, over_interval="mean"
            ),
            clock_block(self.xp, horizon),
            self.action_block,
        )

    @property
    def quantities(self) -> Sequence[Quantity]:
        """Readings and command in their units, computed from the observation."""
        sigmas, unit = self.parameters.value("sensor_sigmas"), self.task.output_sigma
        return (
            Quantity(
                "reading_in_units",
                ", ".join(self.task.components[i].unit for i in self.task.measured),
                "last valid reading of each sensor",
                lambda read: sigmas * read("reading"),
            ),
            Quantity(
                "command_in_units",
                self.task.components[self.task.output].unit,
                "command",
                lambda read: unit * read("command"),
            ),
        )

    def log_trace(self, state: Any) -> Array:
        """Return the log-trace of the predicted covariance, ``(N,)``; subclasses define it."""
        raise NotImplementedError

    def compare(self, state: Any, measurement: Measurement, readings: Array, S: Array) -> Any:
        """Return the state with innovations, NIS, log-likelihood and averages at a measurement filled in.

        ``readings`` are predicted, ``(m, N)``; S is the covariance of the innovations, ``(m, m, N)``.
        """
        xp, available, m = self.xp, measurement.available, len(self.task.sensors)
        residual = available * (measurement.reading - readings)
        # A sensor without a reading counts as one with unit variance that agrees with the prediction.
        S = S * (available[:, None] * available[None]) + self.sensor_identity * (1.0 - available[None])
        density, squared_distance = gaussian.log_density(residual, S)
        innovation = residual / xp.sqrt(xp.stack([S[i, i] for i in range(m)]))
        count = ordered_sum(available[i] for i in range(m))
        nis = xp.where(count > 0.0, squared_distance / xp.clip(count, 1.0, None), state.mean_nis)
        forget = self.forget
        return state._replace(
            innovation=innovation,
            nis=nis,
            log_likelihood=density + 0.5 * math.log(2.0 * math.pi) * (m - count),
            mean_innovation=state.mean_innovation + forget * available * (innovation - state.mean_innovation),
            mean_square=state.mean_square + forget * available * (innovation**2 - state.mean_square),
            mean_nis=state.mean_nis + forget * (nis - state.mean_nis),
        )

    def records(self, state: Any, measurement: Measurement) -> dict[str, Array]:
        """Return NIS, log-likelihood and a normalised innovation to record at a measurement, by name.

        NIS and log-likelihood are NaN in a dropout of all sensors. The innovation is that of the output, or if it is
        not measured of the first sensor.
        """
        task, xp = self.task, self.xp
        count = ordered_sum(measurement.available)
        shown = task.measured.index(task.output) if task.output in task.measured else 0
        return {
            "nis": xp.where(count > 0.0, state.nis * count, math.nan),
            "nis_degrees": count,
            "log_likelihood": xp.where(count > 0.0, state.log_likelihood, math.nan),
            "innovation": state.innovation[shown],
        }


class _KalmanBank(AutopilotBank):
    """Bank of one Kalman filter; subclasses define the effect of an action on its noises."""

    def __init__(self, task: AutopilotProblem, control: str) -> None:
        super().__init__(task, control)
        constant, n = task.constant, len(task.components)
        model, pack = task.design.model, packed_covariance.pack
        self.F, self.B = constant(model.F), constant(model.B)
        self.propagator: Array = constant(packed_covariance.propagator(model.F))
        scaled, other = (constant(pack(Q)[:, None]) for Q in (model.scaled_noise, model.other_noise))
        self.process_noise: Array = scaled + other
        self.R = constant(task.design.R[:, :, None])
        self.sensor_entries: list[int] = [
            packed_covariance.position(n, i, j) for i in task.measured for j in task.measured
        ]
        self.diagonal: list[int] = packed_covariance.diagonal(n)

    def scaled_noise(self, scale: Array, entries: list[int]) -> Array:
        return scale * self.process_noise[entries]

    def log_trace(self, state: KalmanState) -> Array:
        variances = state.covariance[self.diagonal] + self.scaled_noise(state.scale, self.diagonal)
        return self.xp.log(ordered_sum(self.trace_weights * variances))

    def start(self, initial: Start) -> KalmanState:
        xp = self.xp
        zeros = 0.0 * self.task.readings_of(initial.mean)
        one = zeros[0] + 1.0
        covariance = packed_covariance.pack(initial.covariance)
        return KalmanState(
            mean=initial.mean,
            covariance=covariance,
            estimate=initial.mean,
            estimate_covariance=covariance,
            scale=one,
            action=xp.stack([value * one for value in self.no_action]),
            innovation=zeros,
            nis=one,
            log_likelihood=zeros[0],
            mean_innovation=zeros,
            mean_square=zeros + 1.0,
            mean_nis=one,
        )

    def predict(self, state: KalmanState, measurement: Measurement) -> KalmanState:
        """Return the state predicted by equation (10), with innovations under the last action's noise."""
        m = len(self.task.sensors)
        mean = self.xp.matmul(self.F, state.mean) + self.B * measurement.control
        covariance = self.xp.matmul(self.propagator, state.covariance)
        predicted = covariance[self.sensor_entries] + self.scaled_noise(state.scale, self.sensor_entries)
        S = self.xp.reshape(predicted, (m, m, -1)) + self.R
        compared: KalmanState = self.compare(state, measurement, self.task.readings_of(mean), S)
        return compared._replace(mean=mean, covariance=covariance)

    def decode_action(self, action: Array) -> tuple[Array, Array]:
        """Return the observed action, ``(A, N)``, and its factor on the process noise, ``(N,)``; abstract."""
        raise NotImplementedError

    def sensor_variances(self, action: Array) -> Any:
        return self.task.sensor_variances

    def autopilot_estimate(
        self, update: packed_covariance.PackedUpdate, measurement: Measurement, action: Array
    ) -> tuple[Array, Array]:
        return update.mean, update.covariance

    def act(self, state: KalmanState, measurement: Measurement, action: Array) -> KalmanState:
        shown, scale = self.decode_action(action)
        update = packed_covariance.update_coordinates(
            state.mean,
            state.covariance + scale * self.process_noise,
            measurement.reading,
            self.task.measured,
            self.sensor_variances(shown),
            measurement.available,
        )
        estimate, covariance = self.autopilot_estimate(update, measurement, shown)
        return state._replace(
            mean=update.mean,
            covariance=update.covariance,
            estimate=estimate,
            estimate_covariance=covariance,
            scale=scale,
            action=shown,
        )

    def mean(self, state: KalmanState) -> Array:
        return state.estimate

    def covariance(self, state: KalmanState) -> Array:
        return packed_covariance.unpack(state.estimate_covariance, len(self.task.components))


class GainBank(_KalmanBank):
    """Bank of the control ``gain``: the action scales the process noise."""

    action_space: gymnasium.Space[Any] = gymnasium.spaces.Box(-1.0, 1.0, (1,), numpy.float32)
    action_block: Any = last_action_block(name="action")
    no_action: tuple[float, ...] = (0.0,)

    def decode_action(self, action: Array) -> tuple[Array, Array]:
        """Return the action and the factor ``10 ** (gain_decades a)`` on the process noise."""
        xp = self.xp
        shown = xp.clip(xp.astype(action, xp.float64), -1.0, 1.0)
        return shown, xp.exp(shown[0] * (self.parameters.gain_decades * math.log(10.0)))

    def covariance(self, state: KalmanState) -> Array:
        """Return the filter's covariance, ``(n, n, N)``, under an action inflated by the average NIS if above one.

        Under the action zero it is the paper's covariance; only the innovations show whether another action fits the
        noise.
        """
        factor = self.xp.where(state.action[0] == 0.0, 1.0, self.xp.clip(state.mean_nis, 1.0, None))
        return super().covariance(state) * factor


class NoiseBank(_KalmanBank):
    """Bank of the control ``noise``: the action scales the process noise and the noise of every sensor."""

    def __init__(self, task: AutopilotProblem, control: str) -> None:
        super().__init__(task, control)
        self.no_action: tuple[float, ...] = (0.0,) * (1 + len(task.sensors))
        self.nominal_variances: Array = task.constant(task.sensor_variances)[:, None]

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Gymnasium box of one number for the process noise, then one for each sensor."""
        return gymnasium.spaces.Box(-1.0, 1.0, (1 + len(self.task.sensors),), numpy.float32)

    @property
    def action_block(self) -> Block:
        """Observation block of the last action."""
        return last_action_block(("process", *self.task.sensors), name="action")

    def decode_action(self, action: Array) -> tuple[Array, Array]:
        """Return the action and the factor ``10 ** (noise_reach process_decades a)`` on the process noise."""
        xp, p = self.xp, self.parameters
        shown = xp.clip(xp.astype(action, xp.float64), -1.0, 1.0)
        return shown, xp.exp(shown[0] * (p.noise_reach * p.process_decades * math.log(10.0)))

    def sensor_variances(self, action: Array) -> Array:
        """Return the nominal variances times ``10 ** (2 noise_reach sensor_decades a)``, ``(m, N)``."""
        p = self.parameters
        scale = self.xp.exp(action[1:] * (2.0 * p.noise_reach * p.sensor_decades * math.log(10.0)))
        return self.nominal_variances * scale


class ModeBank(_KalmanBank):
    """Bank of the control ``mode``: nominal, wide-band or over-smoothed filter, or raw sensor readings.

    Under raw readings the filter continues to run.
    """

    action_space: gymnasium.Space[Any] = gymnasium.spaces.Discrete(len(MODES))
    action_block: Any = Block("action", lambda f, _: f.action, "1 if this was the last action", MODES, SHARE)
    no_action: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)

    def __init__(self, task: AutopilotProblem, control: str) -> None:
        super().__init__(task, control)
        # The covariance of raw readings is that of their nominal noise; a coordinate without a sensor, estimated
        # as zero, has the stationary variance of the nominal loop.
        d = task.design
        unmeasured = numpy.where(d.H.any(axis=0), 0.0, numpy.diag(d.state_covariance))
        raw = d.H.T @ d.R @ d.H + numpy.diag(unmeasured)
        self.raw_covariance: Array = task.constant(packed_covariance.pack(raw)[:, None])

    def decode_action(self, action: Array) -> tuple[Array, Array]:
        """Return the selected mode, one-hot, and its factor on the process noise."""
        xp, p = self.xp, self.parameters
        shown = xp.stack([xp.astype(action == i, xp.float64) for i in range(len(MODES))])
        wide, smooth = (p.wide_band_scale - 1.0) * shown[1], (p.over_smoothed_scale - 1.0) * shown[3]
        return shown, 1.0 + (wide + smooth)

    def autopilot_estimate(
        self, update: packed_covariance.PackedUpdate, measurement: Measurement, action: Array
    ) -> tuple[Array, Array]:
        """Return the filter's estimate; in mode "raw-sensors" the readings, and zero for other coordinates."""
        xp, reading, measured = self.xp, measurement.reading, self.task.measured
        zero = xp.zeros_like(reading[0])
        rows = [
            reading[measured.index(i)] if i in measured else zero for i in range(len(self.task.components))
        ]
        raw = action[2] > 0.0
        return (
            xp.where(raw, xp.stack(rows), update.mean),
            xp.where(raw, self.raw_covariance, update.covariance),
        )
