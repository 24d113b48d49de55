"""Attitude of a hand-held sensor from gyroscope, accelerometer and magnetometer."""

from collections.abc import Mapping
from typing import Any, ClassVar

from filtergym.envs.contract.causes import Cause
from filtergym.envs.contract.observation import Array
from filtergym.envs.contract.task import Component, PaperPolicy, Scenario, Task

from . import quaternions
from .banks import MadgwickBank, MahonyBank, VQFBank
from .parameters import AttitudeParameters
from .world import RADIAN, AttitudeWorld

AXES = ("north", "west", "up")


def _context_cause(name: str, phrase: str, key: str, limit: float) -> Cause:
    return Cause(name, phrase, lambda m: m.context[key] > limit if m.knows(key) else None)


class Attitude(Task):
    """Attitude of a hand-held sensor from gyroscope, accelerometer and magnetometer.

    Rotations of any speed, breaks, accelerations, iron in the room, now and then a magnet on the sensor, and gyroscopes
    with a bias: nobody says when. What is estimated are the directions of north, west and up in the sensor's frame. The
    action sets the gains of a published filter.
    """

    id = "broad/Attitude-v0"
    paper_source = (
        "D. Laidig, M. Caruso, A. Cereatti, T. Seel, BROAD - a benchmark for robust inertial orientation estimation, "
        "Data 6 (7), 72, 2021"
    )
    Parameters = AttitudeParameters
    World = AttitudeWorld
    banks: ClassVar[Mapping[str, Any]] = {
        "gain": MadgwickBank,
        "gains": MahonyBank,
        "time_constants": VQFBank,
    }
    actions: ClassVar[Mapping[str, str]] = {
        "gain": "decades of beta over the reach `gain_decades`; 0 is Madgwick's filter with its published default",
        "gains": "decades of the gains of accelerometer and magnetometer, and integral gain over `integral_gain`; 0 is "
        "Mahony's filter with the published default",
        "time_constants": "decades of the time constants of accelerometer and magnetometer; 0 is VQF",
    }
    reach: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "gain": ("gain_decades",),
        "gains": ("gain_decades", "integral_gain"),
        "time_constants": ("gain_decades",),
    }
    scenarios: ClassVar[Mapping[str, Scenario]] = {
        "random": Scenario("random", "Motions, fields and sensors of all kinds.", training=True),
        "fast": Scenario(
            "fast", "Held out: fast rotations without breaks.",
            {"rate_levels": (300.0, 600.0), "break_probability": 0.0},
        ),
        "shaken": Scenario(
            "shaken", "Held out: accelerations far above gravity.", {"acceleration_levels": (20.0, 40.0)}
        ),
        "magnet": Scenario(
            "magnet", "Held out: a magnet on the sensor, and much iron in the room.",
            {"magnet_probability": 1.0, "magnet_levels": (20.0, 40.0), "field_levels": (10.0, 40.0)},
        ),
        "biased": Scenario("biased", "Held out: gyroscopes with a large bias.", {"gyroscope_bias": 1.0}),
    }  # fmt: skip
    components = tuple(Component(f"{axis}_{along}", "1") for axis in AXES for along in "xyz")
    groups: Mapping[str, tuple[str, ...]] = {
        axis: tuple(f"{axis}_{along}" for along in "xyz") for axis in AXES
    }
    cost_description = "square of the total angle between estimate and truth, deg^2"
    reward_unit = 40.0  # between the mean, which a few magnets rule, and the median
    paper_policy = PaperPolicy("gain", (0.0,))
    start_measurements = 1000
    causes = (
        _context_cause("iron", "where iron disturbs the field", "disturbance", 5.0),
        _context_cause("acceleration", "where the sensor is accelerated", "acceleration", 2.0),
        _context_cause("rotation", "in fast rotations", "rate", 180.0),
    )

    def set_up(self) -> None:
        """Compute the stated covariance: a small rotation of the variance v about each axis moves each direction cosine
        by a variance of 2 v / 3 on average, since ``|C - C0|^2`` is twice the square of the angle.
        """
        variance = 2.0 / 3.0 * (RADIAN * self.parameters.stated_sigma) ** 2
        rows = [[variance if i == j else 0.0 for j in range(9)] for i in range(9)]
        self._covariance = self.constant(rows)[:, :, None]

    def stated_covariance(self, like: Array) -> Array:
        """Covariance that every filter states, ``(9, 9, N)``.

        Args:
            like: any array ``(N,)``.
        """
        return self._covariance + 0.0 * like

    def records(self, model: Any, episode: Any, kept: dict[str, Array]) -> dict[str, Array]:
        """Total angle, inclination and heading of the error, deg."""
        if not self.has_truth:
            return {}
        names = ("total_angle", "inclination_angle", "heading_angle")
        return dict(zip(names, quaternions.error_angles(model.error(episode)), strict=True))
