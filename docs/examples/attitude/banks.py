"""Filters that an action steers: Madgwick's, Mahony's, and VQF."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy
from filtergym.envs.contract.filter import Bank
from filtergym.envs.contract.observation import ACTION, Array, Block

from . import gradient_filters, indicators, quaternions, vqf
from .parameters import AttitudeParameters
from .world import Measurement, Start


class Filter(NamedTuple):
    """N filters."""

    attitude: Array
    """Estimate, ``(4, N)``."""
    bias: Array
    """Of the gyroscope, rad/s, ``(3, N)``."""
    inner: Any
    """What the filter keeps beside them; None where that is nothing."""
    indicators: indicators.Indicators
    action: Array
    """Last action, ``(A, N)``."""


class AttitudeBank(Bank[Any, Measurement, Filter]):
    """What all controls share: a subclass says what the filter is and what an action does to it."""

    parameters: AttitudeParameters
    steered: tuple[str, ...]
    """What the action scales, a name for each number."""

    @property
    def action_space(self) -> gymnasium.Space:
        """Decades of what is steered over the reach."""
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self.steered),), numpy.float32)

    @property
    def blocks(self) -> Sequence[Block]:
        """Residuals of both vectors, their averages, and the last action."""
        parts = self.steered if len(self.steered) > 1 else ()
        return (
            *indicators.indicator_blocks(self.parameters.sampling_interval),
            Block("last_action", lambda f, _: f.action, "action applied before", parts, ACTION),
        )

    def start_inner(self, attitude: Array) -> Any:
        """What the filter keeps beside attitude and bias."""
        return None

    def start(self, initial: Start) -> Filter:
        """Start where everyone starts, without a bias."""
        zero = 0.0 * initial.quaternion[0]
        return Filter(
            initial.quaternion,
            0.0 * initial.quaternion[:3],
            self.start_inner(initial.quaternion),
            indicators.start_indicators(zero),
            self.xp.stack([zero] * len(self.steered)),
        )

    def predict(self, state: Filter, measurement: Measurement) -> Filter:
        """Turn by the gyroscope and see what the two vectors miss."""
        T = self.parameters.sampling_interval
        turned = quaternions.multiply(
            state.attitude, quaternions.exponential(T * (measurement.rate - state.bias))
        )
        cosines = quaternions.direction_cosines(turned)
        return state._replace(indicators=indicators.observe(state.indicators, cosines, measurement, T))

    def correct(self, state: Filter, measurement: Measurement, factors: Array, action: Array) -> Filter:
        """Attitude and bias after the measurement.

        Args:
            state: after :meth:`predict`.
            measurement: the same.
            factors: ``10 ** (gain_decades a)``, ``(A, N)``.
            action: a, within its limits, ``(A, N)``.
        """
        raise NotImplementedError

    def act(self, state: Filter, measurement: Measurement, action: Array) -> Filter:
        """Take the measurement in with the gains that the action asks for."""
        xp = self.xp
        action = xp.clip(xp.astype(action, xp.float64), -1.0, 1.0)
        factors = xp.exp(indicators.log_ten(self.parameters.gain_decades) * action)
        return self.correct(state, measurement, factors, action)._replace(action=action)

    def mean(self, state: Filter) -> Array:
        """Direction cosines, ``(9, N)``."""
        return quaternions.direction_cosines(state.attitude)

    def covariance(self, state: Filter) -> Array:
        """Stated covariance, always the same, ``(9, 9, N)``."""
        return self.task.stated_covariance(state.attitude[0])


class MadgwickBank(AttitudeBank):
    """Control ``gain``: the action scales beta."""

    steered = ("beta",)

    def correct(self, state: Filter, measurement: Measurement, factors: Array, action: Array) -> Filter:
        """One step of Madgwick's filter."""
        attitude = gradient_filters.madgwick_step(
            state.attitude,
            *measurement,
            gradient_filters.MADGWICK_BETA * factors[0],
            self.parameters.sampling_interval,
        )
        return state._replace(attitude=attitude)

    def records(self, state: Filter, measurement: Measurement) -> dict[str, Array]:
        """Beta, 1/s."""
        decades = indicators.log_ten(self.parameters.gain_decades)
        return {"beta": gradient_filters.MADGWICK_BETA * self.xp.exp(decades * state.action[0])}


class MahonyBank(AttitudeBank):
    """Control ``gains``: the action scales the gains of both vectors, and sets that of the integral."""

    steered = ("accelerometer", "magnetometer", "integral")

    def correct(self, state: Filter, measurement: Measurement, factors: Array, action: Array) -> Filter:
        """One step of Mahony's filter."""
        gain = gradient_filters.MAHONY_GAIN
        integral = self.parameters.integral_gain * self.xp.clip(action[2], 0.0, None)
        attitude, bias = gradient_filters.mahony_step(
            state.attitude,
            state.bias,
            *measurement,
            (gain * factors[0], gain * factors[1], integral),
            self.parameters.sampling_interval,
        )
        return state._replace(attitude=attitude, bias=bias)


class VQFBank(AttitudeBank):
    """Control ``time_constants``: the action scales those of accelerometer and magnetometer in VQF."""

    steered = ("accelerometer", "magnetometer")

    def start_inner(self, attitude: Array) -> vqf.VQF:
        """VQF with bias estimation and rejection of disturbed fields."""
        return vqf.start_vqf(attitude, settled=True)

    def correct(self, state: Filter, measurement: Measurement, factors: Array, action: Array) -> Filter:
        """One step of VQF."""
        inner = vqf.vqf_step(
            state.inner,
            *measurement,
            self.parameters.sampling_interval,
            vqf.ACCELEROMETER_TIME * factors[0],
            vqf.MAGNETOMETER_TIME * factors[1],
        )
        bias = state.bias if inner.bias is None else inner.bias.bias
        return state._replace(attitude=vqf.vqf_attitude(inner), bias=bias, inner=inner)
