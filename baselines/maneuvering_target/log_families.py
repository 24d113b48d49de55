"""Filters whose parameters are fitted to a log of positions, and the limits of these.

Limits follow from the log: an acceleration of ``r / T^2`` moves a target by the deviation r of a measurement
within an interval T.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy

from ...envs.contract.filter import EstimateState, FilterInput, Initial
from ...envs.data.recording import Recording
from ...envs.maneuvering_target.constant_velocity import KalmanModel
from ...envs.maneuvering_target.task import ManeuveringTarget
from ...envs.maneuvering_target.unscented_turn import UnscentedTurn
from ...filters import kalman
from ..table import Tunable, tunable, without_logarithms
from .adaptive_estimators import SageHusaProcessNoise, VariationalBayes
from .anchored import DeadReckoning, regress_odometry
from .estimators import (
    ConstantVelocity,
    KalmanInteractingMultipleModel,
    KalmanTurnInteractingMultipleModel,
)


class ConstantAcceleration(KalmanModel):
    """One Kalman filter of constant acceleration.

    Args:
        jerk: standard deviation of the change of the acceleration in a second, constant from scan to scan,
            m/s^3.
        acceleration: standard deviation of the acceleration at the start, m/s^2.
    """

    def __init__(self, task: ManeuveringTarget, jerk: float = 0.3, acceleration: float = 1.0) -> None:
        super().__init__(task)
        self.variance: float = jerk**2
        self.start_variance: float = acceleration**2
        self.H = task.constant([[float(i == j) for j in range(6)] for i in range(2)])

    def start(self, initial: Initial) -> EstimateState:
        """Return the state at the initial estimate, with an acceleration of mean zero."""
        xp = self.xp
        zero = 0.0 * initial.mean
        right = xp.concat([initial.covariance, zero[:, None][:, :, :] + 0.0 * zero[None, :2]], axis=1)
        variance = self.start_variance + 0.0 * zero[0]
        none = 0.0 * variance
        rows = [[*([none] * 4), *(variance if i == j else none for j in range(2))] for i in range(2)]
        below = xp.stack([xp.stack(row) for row in rows])
        augmented = xp.concat([initial.mean, zero[:2]], axis=0), xp.concat([right, below], axis=0)
        return super().start(Initial(*augmented))

    def update(self, state: EstimateState, inputs: FilterInput) -> EstimateState:
        """Predict to a scan and update with its measurement; return the state."""
        xp, T = self.xp, inputs.measurement.interval
        none, one = 0.0 * T, 1.0 + 0.0 * T
        half = 0.5 * T**2
        kinematic = [[one, T, half], [none, one, T], [none, none, one]]
        gain = [T**3 / 6.0, half, T]
        # States are position x, y, velocity x, y, acceleration x, y.
        F = xp.stack(
            [
                xp.stack([kinematic[i // 2][j // 2] if i % 2 == j % 2 else none for j in range(6)])
                for i in range(6)
            ]
        )
        Q = xp.stack(
            [
                xp.stack([gain[i // 2] * gain[j // 2] if i % 2 == j % 2 else none for j in range(6)])
                for i in range(6)
            ]
        )
        predicted = kalman.predict(state.mean, state.covariance, F, self.variance * Q)
        return self.track(inputs.measurement, self.update_estimate(predicted, inputs.measurement))


def _imm(values: Mapping[str, Any]) -> tuple[dict[str, Any], Any]:
    v = without_logarithms(values)
    quiet = v["acceleration_quiet"]
    accelerations = quiet, quiet * v["ratio"]
    stay = 1.0 - v["leave_quiet"], 1.0 - v["leave_noisy"]
    return {}, lambda task: KalmanInteractingMultipleModel(task, accelerations, stay)


def _imm_turn(values: Mapping[str, Any]) -> tuple[dict[str, Any], Any]:
    v = without_logarithms(values)
    quiet = v["acceleration_quiet"]
    accelerations = quiet, quiet * v["ratio"], quiet
    leave = v["leave_quiet"], v["leave_noisy"], v["leave_noisy"]
    stay = [1.0 - each for each in leave]
    return {}, lambda task: KalmanTurnInteractingMultipleModel(
        task, accelerations, v["turn_rate"], 0.15 * v["turn_rate"], stay
    )


UNITS = {
    **dict.fromkeys(("acceleration", "acceleration_quiet", "least"), "m/s^2"),
    "jerk": "m/s^3",
    **dict.fromkeys(("turn_rate", "turn_rate_start", "turn_rate_change"), "degrees/s"),
    "error_deviation": "m",
    "correlation_time": "s",
    "drift": "m/m^0.5",
    "heading_offset": "degrees",
    "ratio": "times as much in manoeuvres",
    "leave_quiet": "chance a measurement that a manoeuvre begins",
    "leave_noisy": "chance a measurement that a manoeuvre ends",
    "noise_scale": "times the stated deviations",
}
"""Units of the parameters of all families; for pure numbers a description."""

DECADES = 12.0
"""Decades between limits that follow a recording and those of 1 s and 1 m: for a millisecond and a kilometre."""
BEYOND = {
    **dict.fromkeys(
        (
            "log10_acceleration", "log10_jerk", "log10_acceleration_quiet", "log10_turn_rate", "log10_least",
            "log10_turn_rate_change", "log10_turn_rate_start", "log10_error_deviation",
        ),
        DECADES,
    ),
    "log10_correlation_time": 1.0, "scale": 100.0, "heading_offset": 360.0,
}  # fmt: skip
"""Tolerance of values beyond limits that follow a recording, see :attr:`.Tunable.beyond`."""


def log_families(recording: Recording | None = None) -> dict[str, Tunable]:
    """Return the filter families that can be fitted to a log of positions, by name, the simplest first.

    Args:
        recording: recording of ManeuveringTarget, whose intervals and deviations set the limits; None: 1 s and 1 m.
    """
    T = r = 1.0
    if recording is not None:
        there = recording.measurements["available"] > 0.0
        T = float(numpy.nanmedian(numpy.diff(recording.seconds, axis=1)))
        r = float(numpy.sqrt(numpy.median(recording.measurements["variance"][there])))
    usual = math.log10(r / T**2)
    acceleration = usual - 3.5, usual - 1.5, usual + 1.5
    jerk = usual - math.log10(T) - 4.5, usual - math.log10(T) - 2.0, usual - math.log10(T) + 1.5
    # Degrees a second: from a rate that is undetectable over a hundred scans to a quarter turn within one.
    turn = math.log10(0.05 / T), math.log10(2.0 / T), math.log10(90.0 / T)
    leave = {"log10_leave_quiet": (-2.7, -1.5, -0.3), "log10_leave_noisy": (-2.3, -1.0, -0.3)}
    ratio = math.log10(2.0), math.log10(8.0), 3.5
    families = {
        "constant-velocity": tunable(ConstantVelocity, log10_acceleration=acceleration),
        "constant-acceleration": tunable(
            ConstantAcceleration, log10_jerk=jerk, log10_acceleration=acceleration
        ),
        "imm-two": tunable(
            KalmanInteractingMultipleModel,
            _imm,
            log10_acceleration_quiet=acceleration,
            log10_ratio=ratio,
            **leave,
        ),
        "imm-turn": tunable(
            KalmanTurnInteractingMultipleModel,
            _imm_turn,
            log10_acceleration_quiet=acceleration,
            log10_ratio=ratio,
            log10_turn_rate=turn,
            **leave,
        ),
        "unscented-turn": tunable(
            UnscentedTurn,
            log10_acceleration=acceleration,
            log10_turn_rate_change=(turn[0] - 1.0, turn[1] - 1.0, turn[2] - 1.0),
            log10_turn_rate_start=turn,
        ),
        "sage-husa": tunable(
            SageHusaProcessNoise,
            log10_acceleration=acceleration,
            forgetting=(0.3, 0.9, 0.995),
            log10_least=acceleration,
        ),
        "variational-bayes": tunable(
            VariationalBayes,
            log10_acceleration=acceleration,
            forgetting=(0.5, 0.95, 1.0),
            log10_shape=(-0.3, 0.7, 3.0),
        ),
    }
    if recording is None or "odometry_displacement" in recording.measurements:
        families["dead-reckoning"] = _anchored_family(recording, T, r)
    return {
        name: dataclasses.replace(family, units=UNITS, beyond=BEYOND) for name, family in families.items()
    }


def _anchored_family(recording: Recording | None, T: float, r: float) -> Tunable:
    """Return the family of filters with odometry and slow errors of the positions, with limits for a
    recording.

    Limits are narrow where a log contains little information. An error that lasts for more than five minutes
    cannot be distinguished from another position. A drift fitted too small harms more than one too large.
    """
    scale, heading = (1.0, 0.0) if recording is None else regress_odometry(recording)
    shortest = min(2.0 * T, 10.0)
    family = tunable(
        DeadReckoning,
        log10_error_deviation=(math.log10(r) - 1.5, math.log10(2.0 * r), math.log10(r) + 2.0),
        log10_correlation_time=(math.log10(shortest), math.log10(60.0), math.log10(300.0)),
        log10_drift=(-0.5, -0.25, 0.0),
        scale=(0.8 * scale, scale, 1.25 * scale),
        heading_offset=(heading - 30.0, heading, heading + 30.0),
    )
    return dataclasses.replace(family, anchored=True)
