"""Constants of TightlyCoupledNavigation with their limits, and the names of its hypotheses."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy

from ...filters import gnss_ins, satellites
from ..contract.parameters import TaskParameters, check_length, parameter, square_matrix

REST, LINE, SINGER = 0, 1, 2
HYPOTHESES = ("rest", "constant-velocity", "singer")
DEGREE = math.pi / 180.0
KNOWN_BY: dict[str, tuple[str, ...]] = {
    "pseudorange_sigma": ("initial_position_sigma", "initial_clock_sigma"),
    "rate_sigma": (
        "initial_velocity_sigma", "initial_drift_sigma", "rest_velocity_sigma", "increment_sigma",
    ),
    "accelerometer_sigma": ("initial_acceleration_sigma", "reset_acceleration_sigma", "singer_sigma"),
    "attitude_sigma": ("initial_attitude_sigma", "attitude_rate_sigma", "angle_walk"),
}  # fmt: skip
"""Names of the prior standard deviations of the quantities that each sensor measures."""
WALKS = {"pseudorange_sigma": "frequency_density", "rate_sigma": "frequency_walk_density"}
"""Names of the random-walk densities of the clock quantities that each sensor measures."""
LARGEST_RATIO = 1e6
"""Largest ratio of these deviations to that of the sensor: squared, it takes twelve of the sixteen digits."""


class SensorGroup(NamedTuple):
    """Group of sensors of one kind: places of their readings, standard deviation, aperture."""

    name: str
    readings: slice
    """Slice of the group in all readings."""
    sigma: float
    """Nominal standard deviation of each reading, m, m/s, m/s^2 or rad."""
    aperture: float | None = None
    """Deviation from the prediction beyond which tracking loops lose the signal, in the same unit."""


@dataclass(frozen=True)
class TightlyCoupledNavigationParameters(TaskParameters):
    """Constants of TightlyCoupledNavigation; "ours": the paper gives no value."""

    course: str = parameter("random", choices=("increment", "kinematic", "matched", "random"))
    """Motion of the user: "increment" (the paper), "kinematic", "matched" or "random"."""
    horizon: int = parameter(600, at_least=1)
    """Measurements in an episode. Paper: 3000; ours for training: 6 s."""
    decision_interval: int = parameter(10, at_least=1)
    """Measurements for which an action holds. Ours: ten decisions a second."""
    sampling_interval: float = parameter(0.01, above=0.0, at_most=86400.0)
    """Step T, s. Ours: the paper's smallest adaptation time must be one step at least."""

    latitude: float = parameter(53.9, at_least=-90.0, at_most=90.0)
    """Latitude of the site, degrees. Ours: Minsk."""
    longitude: float = parameter(27.5667, at_least=-180.0, at_most=180.0)
    """Longitude of the site, degrees. Ours."""
    height: float = 220.0
    """Height of the site, m. Ours."""
    satellites: tuple[int, ...] = (1, 11, 19, 20)
    """Slots of the nominal GLONASS. Paper: four; ours: the four of smallest GDOP. With fewer, the filter has no
    complete
    fix."""
    epoch: float = 0.0
    """Time of the constellation at the start, s. Ours."""
    elevation_mask: float = parameter(10.0, at_least=0.0)
    """Smallest elevation of a satellite in use, degrees. Ours."""
    gravity: float = parameter(9.81, above=0.0)
    """Acceleration of gravity, m/s^2."""

    pseudorange_sigma: float = parameter(3.0, above=0.0)
    """Standard deviation of pseudoranges, m. Ours."""
    rate_sigma: float = parameter(0.1, above=0.0)
    """Standard deviation of pseudorange rates, m/s. Ours."""
    accelerometer_sigma: float = parameter(0.05, above=0.0)
    """Standard deviation of accelerometers, m/s^2. Ours."""
    attitude_sigma: float = parameter(0.5, above=0.0)
    """Standard deviation of the independent attitude reference, degrees. Ours."""

    frequency_density: float = parameter(0.009, above=0.0)
    """White frequency noise of the receiver clock, m^2/s. Ours."""
    frequency_walk_density: float = parameter(0.036, above=0.0)
    """Random-walk frequency noise of the clock, m^2/s^3. Ours."""
    angle_walk: float = parameter(0.01, above=0.0, at_most=10.0)
    """Random walk of each attitude error, degrees per root second. Ours."""
    attitude_rate_sigma: float = parameter(0.02, above=0.0, at_most=100.0)
    """Stationary rate of each attitude error, degrees/s. Ours."""
    attitude_rate_time: float = parameter(100.0, above=0.0)
    """Correlation time of the attitude rates, s. Ours."""
    rest_velocity_sigma: float = parameter(0.01, above=0.0)
    """Regularising velocity noise of hypothesis 1, m/s; that of the position is T times as much. Ours."""
    reset_acceleration_sigma: float = parameter(0.05, above=0.0)
    """Regularising noise of the acceleration in hypotheses 1 and 2, m/s^2. Ours."""
    increment_sigma: float = parameter(0.02, above=0.0)
    """Velocity increment in one step of hypothesis 2, m/s. Ours; for the paper 0.3, the increment
    of leg 2."""
    singer_alpha: float = parameter(0.05, above=0.0)
    """Reciprocal correlation time of a manoeuvre, 1/s. Ours."""
    singer_sigma: float = parameter(18.0, above=0.0)
    """Standard deviation of a manoeuvre, m/s^2. Ours: Singer's rule with 30 m/s^2, P_max 0.1, P_0 0.32."""
    transition: tuple[tuple[float, ...], ...] = parameter(
        ((0.998, 0.001, 0.001), (0.001, 0.998, 0.001), (0.001, 0.001, 0.998)),
        at_least=0.0,
        at_most=1.0,
        stochastic=True,
    )
    """Transition matrix of the hypotheses, row = from, column = to. Ours: a mean sojourn time of 5 s."""
    initial_probabilities: tuple[float, ...] = parameter(
        (1 / 3, 1 / 3, 1 / 3), at_least=0.0, at_most=1.0, stochastic=True
    )
    """Initial probabilities of the hypotheses. Ours."""

    initial_position_sigma: float = parameter(10.0, above=0.0)
    """Standard deviation of the initial position, m per axis. Ours."""
    initial_clock_sigma: float = parameter(30.0, above=0.0)
    """Standard deviation of the initial clock offset, m. Ours."""
    initial_velocity_sigma: float = parameter(0.5, above=0.0)
    """Standard deviation of the initial velocity, m/s per axis. Ours."""
    initial_drift_sigma: float = parameter(1.0, above=0.0)
    """Standard deviation of the initial clock drift, m/s. Ours."""
    initial_acceleration_sigma: float = parameter(0.5, above=0.0)
    """Standard deviation of the initial acceleration, m/s^2 per axis. Ours."""
    initial_attitude_sigma: float = parameter(1.0, above=0.0, at_most=180.0)
    """Standard deviation of the initial attitude errors, degrees. Ours."""

    heading: tuple[float, float] = parameter((0.0, 360.0), ascending=True)
    """Limits of the heading of the level aircraft, degrees; legs of the fixed courses follow it. Ours."""
    leg_steps: tuple[int, int] = parameter((1000, 2000), at_least=1, ascending=True)
    """Last step of leg 1 and of leg 2 of the fixed courses. Paper."""
    leg_acceleration: float = parameter(30.0, at_least=0.0)
    """Acceleration of leg 2, and the jump at its end, m/s^2. Paper: 0.3 m/s per step, and 30 m/s^2."""
    matched_speed: float = parameter(300.0, at_least=0.0)
    """Initial speed of the matched course, m/s. Ours."""
    legs: int = parameter(4, at_least=1)
    """Number of legs of the random course. Ours."""
    leg_duration: tuple[float, float] = parameter((1.0, 3.0), at_least=0.0, ascending=True)
    """Limits of the duration of a random leg, s. Ours."""
    strength: tuple[float, float] = parameter((2.0, 40.0), at_least=0.0, at_most=1e4, ascending=True)
    """Limits of the initial acceleration of a random manoeuvre, m/s^2. Ours."""
    initial_speed: tuple[float, float] = parameter((0.0, 300.0), at_least=0.0, ascending=True)
    """Limits of the speed of a random course that does not start at rest, m/s. Ours."""
    rest_probability: float = parameter(0.5, at_least=0.0, at_most=1.0)
    """Probability that a random course starts at rest. Ours."""
    manoeuvre_throughout: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability that a random course is one manoeuvre from its start to its end, with the strength that its second
    leg would have. Ours."""
    true_increment_sigma: float = parameter(0.02, at_least=0.0, at_most=100.0)
    """True random velocity increment on legs of constant velocity of the random course, m/s per step. Ours:
    that of hypothesis 2, so that the known mode is the optimum."""

    rate_fault_probability: float = parameter(0.5, at_least=0.0, at_most=1.0)
    """Probability of a temporary fault in which one satellite's rate channel is noisy. Ours."""
    rate_fault_factor: tuple[float, float] = parameter((5.0, 5.0), above=0.0, ascending=True)
    """Limits of the factor on the standard deviation of a noisy rate. Ours."""
    rate_fault_duration: tuple[float, float] = parameter((1.0, 3.0), at_least=0.0, ascending=True)
    """Limits of the duration of a noisy rate, s. Ours."""
    stick_probability: float = parameter(0.5, at_least=0.0, at_most=1.0)
    """Probability that the accelerometers stick at their last reading temporarily. Ours."""
    stick_duration: tuple[float, float] = parameter((0.3, 1.0), at_least=0.0, ascending=True)
    """Limits of the duration of stuck accelerometers, s. Ours."""
    rates_outage_probability: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability of a temporary outage of all rates. Ours."""
    rates_outage_duration: tuple[float, float] = parameter((2.0, 2.0), at_least=0.0, ascending=True)
    """Limits of its duration, s. Ours."""
    satellites_outage_probability: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability of a temporary outage of two satellites. Ours."""
    satellites_outage_duration: tuple[float, float] = parameter((2.0, 2.0), at_least=0.0, ascending=True)
    """Limits of its duration, s. Ours."""
    ramp_probability: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability that one satellite's pseudorange drifts off from some time to the end, as with a failing clock.
    Ours."""
    ramp_start: tuple[float, float] = parameter((1.0, 3.0), at_least=0.0, ascending=True)
    """Limits of the start of the drift, s. Ours."""
    ramp_rate: float = 10.0
    """Rate of the drift, m/s; the rate channel does not contain it. Ours."""
    ramp_jump: tuple[float, float] = parameter((0.0, 0.0), ascending=True)
    """Limits of the error at the start of the drift, m. Ours."""
    pseudorange_coloured: tuple[float, float] = parameter((0.0, 0.0), at_least=0.0, ascending=True)
    """Limits of the stationary standard deviation of an unreported coloured error (first-order Gauss-Markov) of every
    pseudorange, independent of the others and added to the white one: diffuse multipath, atmosphere, ephemerides; m.
    Ours."""
    pseudorange_correlation_time: tuple[float, float] = parameter((10.0, 10.0), above=0.0, ascending=True)
    """Limits of the correlation time of the coloured error, s. Ours."""
    undisturbed: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability of an episode without noisy rates, stuck accelerometers and coloured errors. Ours. Disturbances that
    measurements indicate (hidden satellites, lost rates, reception between houses, apertures) have the law of other
    episodes."""
    urban: bool = False
    """Whether pseudoranges have the positive, heavy-tailed errors of reception between houses. Ours: medians
    and 95 % quantiles by C/N0 as in the public smartLoc data of Berlin."""
    urban_probability: float = parameter(1.0, at_least=0.0, at_most=1.0)
    """Share of the episodes that are between houses, where there are any. Ours."""
    urban_speed: float = parameter(1.0, at_least=0.0)
    """Factor on drawn speeds between houses. Ours."""
    urban_strength: float = parameter(1.0, at_least=0.0)
    """Factor on drawn accelerations between houses. Ours."""
    urban_hold: tuple[float, float] = parameter((0.5, 2.0), at_least=0.0, ascending=True)
    """Limits of the duration of such an error, s. Ours."""
    urban_cn0_walk: float = parameter(0.5, at_least=0.0)
    """Random walk of C/N0, dB per step, reflected at its limits. Ours."""
    cn0_limits: tuple[float, float] = parameter((22.0, 50.0), at_least=0.0, ascending=True)
    """Limits of C/N0, dB-Hz. Ours."""
    clear_cn0: float = parameter(47.0, above=0.0)
    """C/N0 under a clear sky, dB-Hz. Ours."""

    aperture: bool = False
    """Whether the tracking loops, steered by the combined prediction, lose signals too far from it."""
    aperture_probability: float = parameter(1.0, at_least=0.0, at_most=1.0)
    """Share of the episodes in which they do, if ``aperture`` is set. Ours."""
    rate_aperture: float = parameter(9.36, above=0.0)
    """Aperture of rates, m/s: wavelength of L1 over four times a coherent time of 5 ms. Ours."""
    range_aperture: float = parameter(293.0, above=0.0)
    """Aperture of pseudoranges, half a chip, m. Ours."""

    evidence_scale: float = parameter(10.0, above=0.0)
    """Nats that an evidence of one adds to the log-posterior. Ours."""
    noise_scale: float = parameter(300.0, above=1.0)
    """Largest factor on a sensor's standard deviation under control "gain". Ours: 300 practically excludes a sensor."""
    noise_reduction: float = parameter(3.0, above=1.0)
    """Largest divisor of it. Ours: a filter that trusts its sensors far too much is never right, and amplifies rounding
    differences between backends."""
    noise_reach: float = parameter(0.3, above=0.0, at_most=1.0)
    """Share of the logarithms of these two factors that an action of one applies under control "robust". Ours: a new
    policy explores with a standard deviation of about one, and at the full range it learns to survive its own noise,
    at the cost of most episodes. A policy that explores less may use more."""
    averaging_measurements: float = parameter(10.0, at_least=1.0)
    """Time constant n of the short averages in the observation, measurements: the newest has the weight 1/n.
    Ours."""
    position_unit: float = parameter(7.4, above=0.0)
    """Error of a single-epoch fix, m: the unit of the cost. Ours: 3 m times the dilution 2.47."""
    velocity_unit: float = parameter(0.25, above=0.0)
    """Error of a single-epoch velocity, m/s: the unit of the cost. Ours: 0.1 m/s times 2.47."""

    def check(self) -> None:
        """Raise ValueError for fields that contradict each other: transition matrix, satellites and sensors."""
        square_matrix("transition", self.transition, len(HYPOTHESES))
        check_length("initial_probabilities", self.initial_probabilities, len(HYPOTHESES))
        if not self.satellites or len(set(self.satellites)) != len(self.satellites):
            raise ValueError(f"satellites must be different slots, at least one, got {self.satellites!r}")
        if self.satellites_outage_probability > 0.0 and len(self.satellites) < 2:
            raise ValueError(
                f"satellites_outage_probability takes two satellites, got {self.satellites!r}: set it to 0"
            )
        self._check_digits()
        times = self.epoch + self.sampling_interval * numpy.array([0.0, self.horizon + 1.0])
        local, _ = satellites.local_orbits(self.satellites, times, *self.site)
        lowest = satellites.look_angles(local)[1].min(axis=1) / DEGREE
        for slot, elevation in zip(self.satellites, lowest, strict=True):
            if elevation < self.elevation_mask:
                raise ValueError(
                    f"satellite {slot} stands at {elevation:.1f} degrees, below elevation_mask "
                    f"{self.elevation_mask}: choose another"
                )
        if len(self.satellites) >= 4:
            first = local[:, :, 0]
            satellites.dilution_of_precision(first / numpy.sqrt((first**2).sum(axis=0)))

    def _check_digits(self) -> None:
        """Raise ValueError if a sensor is so much better than the prior that an update loses all digits."""
        for sensor, unknowns in KNOWN_BY.items():
            known = getattr(self, sensor)
            for name in unknowns:
                if (unknown := getattr(self, name)) > LARGEST_RATIO * known:
                    raise ValueError(
                        f"{name} must be at most {LARGEST_RATIO:g} times {sensor}, got {unknown!r} and {known!r}: "
                        "the covariance would have no digits left"
                    )
        for sensor, density in WALKS.items():
            known, walked = getattr(self, sensor), math.sqrt(getattr(self, density) * self.sampling_interval)
            if walked > LARGEST_RATIO * known:
                raise ValueError(
                    f"{density} must be smaller: in an interval the clock walks by {walked:.1e}, more than "
                    f"{LARGEST_RATIO:g} times {sensor}, {known!r}: the covariance would have no digits left"
                )
        tilt = self.gravity * min(math.radians(self.initial_attitude_sigma), 1.0)
        if tilt > LARGEST_RATIO * self.accelerometer_sigma:
            raise ValueError(
                f"gravity or initial_attitude_sigma must be smaller: an attitude off by that makes accelerometers read "
                f"{tilt:.1e} m/s^2, more than {LARGEST_RATIO:g} times accelerometer_sigma"
            )

    @property
    def site(self) -> tuple[float, float, float]:
        """Latitude and longitude, rad, and height, m, of the origin of east, north and up."""
        return self.latitude * DEGREE, self.longitude * DEGREE, self.height

    @property
    def sensors(self) -> tuple[SensorGroup, ...]:
        """All groups of sensors, in the order of the readings."""
        ranges, rates, forces, angles = gnss_ins.sensor_groups(len(self.satellites))
        return (
            SensorGroup("pseudoranges", ranges, self.pseudorange_sigma, self.range_aperture),
            SensorGroup("rates", rates, self.rate_sigma, self.rate_aperture),
            SensorGroup("accelerometers", forces, self.accelerometer_sigma),
            SensorGroup("attitude", angles, self.attitude_sigma * DEGREE),
        )
