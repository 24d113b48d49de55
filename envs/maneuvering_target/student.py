"""The fully learned estimator of ManeuveringTarget: its frame, units and motion for :mod:`.student_bank`.

The frame is that of the predicted velocity, along it and across it to the left, for positions and for velocities. The
unit of a position is the measurement's sigma in the frame; that of a velocity is this sigma over the scan period. The
network outputs the acceleration until the next scan, along and across.
"""

from collections.abc import Sequence
from typing import ClassVar

from ...filters.small_matrices import apply, product, transpose
from ..contract.observation import Array, Block
from .kalman_net import (
    FRAME,
    advance,
    clock_blocks,
    frame_of,
    sensor_blocks,
    sensor_covariance,
)
from .parameters import ManeuveringTargetParameters
from .student_bank import StudentBank, StudentState, View
from .world import Measurement

ACCELERATION_REACH = 32.0
"""Acceleration for an output of one at a velocity gain of one, m/s^2: 8 at the gain of an untrained network."""


class RadarStudentBank(StudentBank[object, Measurement]):
    """Bank of the learned estimator ``student``: an aircraft's estimate, corrected in its velocity's frame."""

    parameters: ManeuveringTargetParameters
    # An alpha-beta filter without training: a half, and a quarter of the innovation over the scan period.
    gain: ClassVar[Sequence[tuple[int, float]]] = ((0, 0.5), (1, 0.5), (0, 0.25), (1, 0.25))
    axes: ClassVar[Sequence[str]] = FRAME
    motions: ClassVar[Sequence[int]] = (2, 3)

    def rotate(self, mean: Array) -> Array:
        """Return the rotation of positions and velocities into the frame of the velocity, ``(4, 4, N)``."""
        turn = frame_of(mean[2:])
        none = 0.0 * turn
        sides = [[turn, none], [none, turn]]
        return self.xp.concat([self.xp.concat(row, axis=1) for row in sides])

    def predict_view(self, mean: Array, motion: Array, measurement: Measurement) -> View:
        """Return the estimate predicted with the last output acceleration, with frame, units and innovation."""
        xp = self.xp
        mean, _ = advance(mean, ACCELERATION_REACH * motion, measurement.interval)
        frame = self.rotate(mean)
        turn = frame[:2, :2]
        R = self.turned_covariance(turn, measurement)
        sigma = xp.sqrt(xp.stack([R[0, 0], R[1, 1]]))
        innovation = measurement.available * (measurement.position - mean[:2])
        unit = xp.concat([sigma, sigma * (1.0 / self.parameters.sampling_interval)])
        return View(mean, frame, unit, apply(turn, innovation) / sigma)

    @property
    def features(self) -> Sequence[Block]:
        """Observation blocks of the sensor's covariance in the frame, the speed, and the time."""

        def covariance(track: StudentState, measurement: Measurement) -> Array:
            return self.turned_covariance(track.view.frame[:2, :2], measurement)

        def variances(track: StudentState, measurement: Measurement) -> Array:
            R = covariance(track, measurement)
            return self.xp.stack([R[0, 0], R[1, 1]])

        def coupling(track: StudentState, measurement: Measurement) -> Array:
            R = covariance(track, measurement)
            return R[0, 1] / self.xp.sqrt(R[0, 0] * R[1, 1])

        return (*sensor_blocks(self, variances, coupling), *clock_blocks(self))

    def turned_covariance(self, turn: Array, measurement: Measurement) -> Array:
        """Return a measurement's covariance in the frame of the velocity, m^2, ``(2, 2, N)``."""
        return product(product(turn, sensor_covariance(measurement, self.xp)), transpose(turn))
