"""Tightly coupled INS/GNSS navigation with several hypotheses on the motion.

The experiment and the bank are those of A. N. Moroz, "Adaptive multi-hypothesis algorithm of integrated
secondary processing in an inertial-satellite navigation system" (Minsk, in Russian); its steps are numbered
as there:

    1, 2  p(i) = sum_j pi_ji p(j),  p_ji = pi_ji p(j) / p(i)              filters.imm
    3     mixing of estimates and covariances                             filters.imm
    4     extrapolation under rest, constant velocity, Singer             filters.gnss_ins
    5, 6  residual and update of every filter                             filters.extended_kalman
    7     likelihoods and probabilities                                   filters.imm, in logarithms
    8     combination                                                     filters.imm

Reading: the paper gives the algorithm and almost no values. The step is 0.01 s, because its shortest
adaptation time of 0.01 s must be at least one step.

Reading: a velocity that grows by 0.3 m/s in every 0.01 s already is an acceleration of 30 m/s^2, so nothing
is left to jump at step 2000. The truth was probably a sequence of states with V incremented and A = 0:
``course="increment"``. Physically that is an accelerometer stuck at zero through leg 2. The consistent
alternative, where A = 30 m/s^2 in leg 2 and turns by 90 degrees, is ``course="kinematic"``.

Reading: step 3 of the scan lacks a hat and carries the index k|k-1; the spread is taken about the posterior
estimates, otherwise the matrix is not symmetric.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy

from ...filters import extended_kalman, gnss_ins, imm, satellites
from .. import parameters as check
from ..controls import bank_action_space, bank_probabilities, signed_logarithm
from ..task import Array, Component, Field, NoiseLayout, PaperPolicy, Scenario, Task
from .scenarios import SCENARIOS

REST, LINE, SINGER = 0, 1, 2
HYPOTHESES = ("rest", "constant-velocity", "singer")
GROUPS = ("pseudoranges", "rates", "accelerometers", "attitude")
COURSES = ("increment", "kinematic", "matched", "random")
DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class Parameters:
    """Constants of the task. "ours": the paper gives no value."""

    course: str = "random"
    """How the user moves: "increment" (the paper), "kinematic", "matched" or "random"."""
    horizon: int = 600
    """Measurements in an episode. Paper: 3000; ours for training: 6 s."""
    decision_interval: int = 10
    """Measurements for which an action holds. Ours: ten decisions a second."""
    T: float = 0.01
    """Step, s. Ours: the paper's smallest adaptation time must be one step at least."""

    latitude: float = 53.9
    """Of the site, degrees. Ours: Minsk."""
    longitude: float = 27.5667
    """Of the site, degrees. Ours."""
    height: float = 220.0
    """Of the site, m. Ours."""
    satellites: tuple[int, ...] = (1, 11, 19, 20)
    """Slots of the nominal GLONASS. Paper: four; ours: the four of smallest GDOP. With fewer, the filter
    coasts on what is left."""
    epoch: float = 0.0
    """Time of the constellation at the start, s. Ours."""
    elevation_mask: float = 10.0
    """Satellites below are refused, degrees. Ours."""
    gravity: float = 9.81
    """m/s^2."""

    pseudorange_sigma: float = 3.0
    """m. Ours."""
    rate_sigma: float = 0.1
    """m/s. Ours."""
    accelerometer_sigma: float = 0.05
    """m/s^2. Ours."""
    attitude_sigma: float = 0.5
    """Of the independent attitude reference, degrees. Ours."""

    frequency_density: float = 0.009
    """White frequency noise of the receiver clock, m^2/s. Ours."""
    frequency_walk_density: float = 0.036
    """Random-walk frequency noise of the clock, m^2/s^3. Ours."""
    angle_walk: float = 0.01
    """Random walk of each attitude error, degrees per root second. Ours."""
    attitude_rate_sigma: float = 0.02
    """Stationary rate of each attitude error, degrees/s. Ours."""
    attitude_rate_time: float = 100.0
    """Correlation time of the attitude rates, s. Ours."""
    rest_velocity_sigma: float = 0.01
    """Regularising noise of hypothesis 1, m/s; the position takes T times as much. Ours."""
    reset_acceleration_sigma: float = 0.05
    """Regularising noise of the acceleration in hypotheses 1 and 2, m/s^2. Ours."""
    increment_sigma: float = 0.02
    """Velocity increment in one step of hypothesis 2, m/s. Ours; for the paper 0.3, the increment
    of leg 2."""
    singer_alpha: float = 0.05
    """Reciprocal correlation time of a manoeuvre, 1/s. Ours."""
    singer_sigma: float = 18.0
    """Standard deviation of a manoeuvre, m/s^2. Ours: Singer's rule with 30 m/s^2, P_max 0.1, P_0 0.32."""
    transition: tuple[tuple[float, ...], ...] = (
        (0.998, 0.001, 0.001),
        (0.001, 0.998, 0.001),
        (0.001, 0.001, 0.998),
    )
    """Of the hypotheses, row = from, column = to. Ours: a mean stay of 5 s."""
    initial_probabilities: tuple[float, ...] = (1 / 3, 1 / 3, 1 / 3)
    """Of the hypotheses. Ours."""

    initial_position_sigma: float = 10.0
    """m. Ours."""
    initial_clock_sigma: float = 30.0
    """m. Ours."""
    initial_velocity_sigma: float = 0.5
    """m/s. Ours."""
    initial_drift_sigma: float = 1.0
    """m/s. Ours."""
    initial_acceleration_sigma: float = 0.5
    """m/s^2. Ours."""
    initial_attitude_sigma: float = 1.0
    """Degrees. Ours."""

    heading: float = 45.0
    """Of the level aircraft, degrees; legs of the fixed courses follow it. Ours."""
    leg_steps: tuple[int, int] = (1000, 2000)
    """Last step of leg 1 and of leg 2 of the fixed courses. Paper."""
    leg_acceleration: float = 30.0
    """Of leg 2, and the jump at its end, m/s^2. Paper: 0.3 m/s per step, and 30 m/s^2."""
    matched_speed: float = 300.0
    """Initial speed of the matched course, m/s. Ours."""
    legs: int = 4
    """Of the random course. Ours."""
    leg_duration: tuple[float, float] = (1.0, 3.0)
    """Limits of the duration of a random leg, s. Ours."""
    strength: tuple[float, float] = (2.0, 40.0)
    """Limits of the acceleration with which a random manoeuvre begins, m/s^2. Ours."""
    initial_speed: tuple[float, float] = (0.0, 300.0)
    """Limits of the speed of a random course that does not start at rest, m/s. Ours."""
    rest_probability: float = 0.5
    """That a random course starts at rest. Ours."""
    true_increment_sigma: float = 0.02
    """True random velocity increment on legs of constant velocity of the random course, m/s per step. Ours:
    that of hypothesis 2, so that the known mode is the optimum."""

    rate_fault_probability: float = 0.5
    """That one satellite's rate channel is noisy for a while. Ours."""
    rate_fault_factor: float = 5.0
    """How much noisier. Ours."""
    rate_fault_duration: tuple[float, float] = (1.0, 3.0)
    """s. Ours."""
    stick_probability: float = 0.5
    """That the accelerometers stick at their last reading for a while. Ours."""
    stick_duration: tuple[float, float] = (0.3, 1.0)
    """s. Ours."""
    rates_outage: float = 0.0
    """How long all rates are lost, s. Ours."""
    satellites_outage: float = 0.0
    """How long two satellites drop out, s. Ours."""
    urban: bool = False
    """Whether pseudoranges have the positive, heavy-tailed errors of reception between houses. Ours: medians
    and 95 % quantiles by C/N0 as in the public smartLoc data of Berlin."""
    urban_hold: tuple[float, float] = (0.5, 2.0)
    """Limits of the time for which such an error holds, s. Ours."""
    urban_cn0_walk: float = 0.5
    """Random walk of C/N0, dB per step, reflected at its limits. Ours."""
    cn0_limits: tuple[float, float] = (22.0, 50.0)
    """Limits of C/N0, dB-Hz. Ours."""
    clear_cn0: float = 47.0
    """C/N0 under a clear sky, dB-Hz. Ours."""

    aperture: bool = False
    """Whether the tracking loops, steered by the combined prediction, lose what they do not expect."""
    rate_aperture: float = 9.36
    """m/s: wavelength of L1 over four times a coherent time of 5 ms. Ours."""
    range_aperture: float = 293.0
    """Half a chip, m. Ours."""

    evidence_scale: float = 10.0
    """Nats that an evidence of one adds to the log-posterior. Ours."""
    noise_scale: float = 300.0
    """Largest factor of a sensor's standard deviation under control "gain". Ours: 300 switches a sensor off
    for practical purposes."""
    noise_reduction: float = 3.0
    """Largest divisor of it. Ours: a filter that trusts its sensors far too much is never right, and
    amplifies rounding from one backend to another."""
    average: float = 0.1
    """Weight of the newest value in the short averages. Ours: ten measurements."""
    position_unit: float = 7.4
    """Error of a single-epoch fix, m: the unit of the cost. Ours: 3 m times the dilution 2.47."""
    velocity_unit: float = 0.25
    """Error of a single-epoch velocity, m/s: the unit of the cost. Ours: 0.1 m/s times 2.47."""

    def __post_init__(self) -> None:
        """Refuse what cannot be simulated, with the reason."""
        for name in ("satellites", "transition", "initial_probabilities", "leg_steps"):
            object.__setattr__(self, name, check.frozen(getattr(self, name)))
        check.choice("course", self.course, COURSES)
        for name in ("horizon", "decision_interval", "legs"):
            check.integer(name, getattr(self, name), at_least=1)
        for name in _POSITIVE:
            check.number(name, getattr(self, name), above=0.0)
        for name in _NOT_NEGATIVE:
            check.number(name, getattr(self, name), at_least=0.0)
        for name in ("rest_probability", "rate_fault_probability", "stick_probability"):
            check.number(name, getattr(self, name), at_least=0.0, at_most=1.0)
        for name in _INTERVALS:
            object.__setattr__(self, name, check.frozen(getattr(self, name)))
            check.interval(name, getattr(self, name), at_least=0.0)
        check.number("latitude", self.latitude, at_least=-90.0, at_most=90.0)
        check.number("longitude", self.longitude, at_least=-180.0, at_most=180.0)
        for name in ("height", "heading", "epoch"):
            check.number(name, getattr(self, name))
        check.number("average", self.average, above=0.0, at_most=1.0)
        for name in ("noise_scale", "noise_reduction"):
            check.number(name, getattr(self, name), above=1.0)
        check.stochastic_matrix("transition", self.transition, len(HYPOTHESES))
        check.stochastic_matrix("initial_probabilities", (self.initial_probabilities,), 1, len(HYPOTHESES))
        if len(self.leg_steps) != 2 or not 0 < self.leg_steps[0] < self.leg_steps[1]:
            raise ValueError(f"leg_steps must be two ascending steps after 0, got {self.leg_steps!r}")
        self._check_geometry()

    def _check_geometry(self) -> None:
        if not self.satellites or len(set(self.satellites)) != len(self.satellites):
            raise ValueError(f"satellites must be different slots, at least one, got {self.satellites!r}")
        if self.satellites_outage > 0.0 and len(self.satellites) < 2:
            raise ValueError(f"satellites_outage takes two satellites, got {self.satellites!r}")
        times = self.epoch + self.T * numpy.array([0.0, self.horizon + 1.0])
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

    @property
    def site(self) -> tuple[float, float, float]:
        """Latitude and longitude, rad, and height, m."""
        return self.latitude * DEGREE, self.longitude * DEGREE, self.height


_POSITIVE = (
    *("T", "gravity", "pseudorange_sigma", "rate_sigma", "accelerometer_sigma", "attitude_sigma"),
    *("frequency_density", "frequency_walk_density", "angle_walk", "attitude_rate_sigma"),
    *("attitude_rate_time", "rest_velocity_sigma", "reset_acceleration_sigma", "increment_sigma"),
    *("singer_alpha", "singer_sigma", "initial_position_sigma", "initial_clock_sigma"),
    *("initial_velocity_sigma", "initial_drift_sigma", "initial_acceleration_sigma"),
    *("initial_attitude_sigma", "rate_fault_factor", "rate_aperture", "range_aperture"),
    *("evidence_scale", "position_unit", "velocity_unit", "clear_cn0"),
)
_NOT_NEGATIVE = (
    *("leg_acceleration", "matched_speed", "true_increment_sigma", "rates_outage", "satellites_outage"),
    *("urban_cn0_walk", "elevation_mask"),
)
_INTERVALS = (
    *("leg_duration", "strength", "initial_speed", "rate_fault_duration", "stick_duration", "urban_hold"),
    "cn0_limits",
)


class State(NamedTuple):
    """One moment of N episodes; M = 3 hypotheses, S satellites, m = 2 S + 6 observations, L legs."""

    clock: Array
    """Measurements so far, ``(N,)`` integers."""
    # What fixes the episode.
    leg_start: Array
    """Last step before each leg, ``(L, N)``."""
    leg_kind: Array
    """REST, LINE or SINGER, ``(L, N)``."""
    leg_acceleration: Array
    """With which each leg begins, ``(3, L, N)``, m/s^2."""
    rate_fault: Array
    """First and last step, ``(2, N)``, and the satellite concerned (third row)."""
    stick: Array
    """First and last step with stuck accelerometers, ``(2, N)``."""
    outage: Array
    """First and last step without rates, first and last step without two satellites, those two; ``(6, N)``"""
    # Truth.
    truth: Array
    """``(17, N)``, in the order of filters.gnss_ins."""
    mode: Array
    """True hypothesis, ``(N,)`` integers."""
    jump: Array
    """One where the acceleration has just taken the value with which the next leg begins, ``(N,)``."""
    # Sensors.
    measurement: Array
    """``(m, N)``."""
    ins_angles: Array
    """Heading, pitch, roll shown by the INS, ``(3, N)``, rad."""
    available: Array
    """One where an observation reached the filter, ``(m, N)``."""
    noise_factor: Array
    """True standard deviation over the nominal one, ``(m, N)``."""
    stuck: Array
    """One where the accelerometers hold an old reading, ``(N,)``."""
    cn0: Array
    """``(S, N)``, dB-Hz."""
    multipath: Array
    """Held error of each pseudorange, ``(S, N)``, m."""
    hold: Array
    """Steps for which it still holds, ``(S, N)``."""
    # Bank.
    predicted_mean: Array
    """``(17, M, N)``."""
    predicted_covariance: Array
    """``(17, 17, M, N)``."""
    bank_mean: Array
    """After the update, ``(17, M, N)``."""
    bank_covariance: Array
    """``(17, 17, M, N)``."""
    log_predicted: Array
    """Logarithm of the predicted probabilities, ``(M, N)``."""
    log_likelihood: Array
    """``(M, N)``."""
    nis: Array
    """Normalised innovation squared by sensor group, ``(4, M, N)``."""
    average_nis: Array
    """Short average of the same per observation, ``(4, M, N)``."""
    range_innovation: Array
    """Of the combined prediction: S pseudoranges, m, S rates, m/s; ``(2 S, N)``."""
    # Output.
    probabilities: Array
    """Weights of the hypotheses in force, ``(M, N)``."""
    estimate: Array
    """``(17, N)``."""
    covariance: Array
    """``(17, 17, N)``."""
    last_action: Array
    """``(A, N)``."""


class TightlyCoupledNavigation(Task[State]):
    """Steer a bank of extended Kalman filters over pseudoranges, their rates, and inertial sensors.

    ## Description

    An aircraft stands, flies straight, or manoeuvres with up to 40 m/s^2. Every 0.01 s a receiver gives the
    pseudoranges and pseudorange rates of four GLONASS satellites, a strapdown INS its accelerometers and
    the difference of its angles from an attitude reference. Three extended Kalman filters of 17 states
    (position, velocity, acceleration, receiver clock, attitude errors) run side by side, one for each
    hypothesis on the motion: rest, constant velocity, Singer manoeuvre. They are mixed before every step by
    the weights in force and combined into the estimate after it. Sensors fail for a while in the default
    scenario: a rate channel becomes five times noisier, the accelerometers stick.

    The paper is Moroz, adaptive multi-hypothesis measurer of an inertial-satellite navigation system. In its
    own experiment (scenario `paper`) the velocity grows in leg 2 while the accelerometers show nothing: that
    is an accelerometer stuck at zero. Scenario `kinematic` is the physically consistent alternative.

    ## Action Space

    * `gain` (default): `Box(-1, 1, (4,))`, what the standard deviation of the noise is taken to be, over the
      nominal one, for each sensor group (pseudoranges, rates, accelerometers, attitude): 300 to the power of
      a positive action, 3 to that of a negative one; under the paper's probabilities, for faults that no
      weight can cure. Zero is the paper's algorithm.
    * `evidence`: `Box(-1, 1, (3,))`, 10 nats each added to the log-posterior of the hypotheses; zero is the
      paper's algorithm.
    * `mode`: `Discrete(3)`, the one hypothesis believed. The bank mixes on its weights, so this collapses it
      to one filter that switches its model.
    * `weights`: `Box(0, 1, (3,))`, normalised; all zero is uniform.

    The weights are used for the combination and as the prior of the next mixing.

    ## Observation Space

    A flat `Box`; see `observation_fields` for each component, unit and scale. For every hypothesis the
    normalised innovation squared by sensor group (now, and as a short average; given the groups before it in
    the order of the action `gain`), the log-likelihood relative to the largest, the predicted
    log-probability; the accelerometers; the innovations of pseudoranges and rates at the combined prediction;
    elevation, C/N0 and availability of every satellite; the time; the last action.

    ## Rewards

    Minus the squared error of position (unit 7.4 m) plus that of velocity (unit 0.25 m/s): the errors of a
    fix from one epoch alone. Beyond a root of 100 it grows linearly.

    ## Starting State

    Position, velocity and acceleration are known up to 10 m, 0.5 m/s and 0.5 m/s^2 per axis, the clock up to
    30 m and 1 m/s, attitude errors up to 1 degree; every hypothesis starts alike with probability 1/3.

    ## Episode End

    Truncation after `horizon` measurements; no termination.

    ## Arguments

    Every field of `Parameters` is a keyword, among them `satellites` (slots; fewer than four: the filter
    coasts on what is left), `increment_sigma` of hypothesis 2, sensor sigmas, faults, and `aperture`: the
    tracking loops, steered by the combined prediction, lose a rate that is 9.36 m/s or a range that is 293 m
    away from it.

    ## Version History

    * v0: first version.
    """

    id = "filtergym/TightlyCoupledNavigation-v0"
    paper_source = (
        "A. N. Moroz, Adaptive multi-hypothesis algorithm of integrated secondary processing in an "
        "inertial-satellite navigation system, Military Academy of the Republic of Belarus (in Russian)"
    )
    controls = ("gain", "evidence", "mode", "weights")
    Parameters: ClassVar[type] = Parameters
    scenarios: ClassVar[Mapping[str, Scenario]] = SCENARIOS
    components = (
        *(Component(f"position_{axis}", "m") for axis in ("east", "north", "up")),
        Component("clock_bias", "m"),
        *(Component(f"velocity_{axis}", "m/s") for axis in ("east", "north", "up")),
        Component("clock_drift", "m/s"),
        *(Component(f"acceleration_{axis}", "m/s^2") for axis in ("east", "north", "up")),
        *(Component(f"{angle}_error", "rad") for angle in ("heading", "pitch", "roll")),
        *(Component(f"{angle}_rate_error", "rad/s") for angle in ("heading", "pitch", "roll")),
    )
    groups = {
        "position": ("position_east", "position_north", "position_up"),
        "velocity": ("velocity_east", "velocity_north", "velocity_up"),
        "acceleration": ("acceleration_east", "acceleration_north", "acceleration_up"),
        "attitude": ("heading_error", "pitch_error", "roll_error"),
    }
    modes = HYPOTHESES
    cost_description = (
        "squared position error over (7.4 m)^2 plus squared velocity error over (0.25 m/s)^2, the errors of "
        "a single-epoch fix"
    )
    huber_bound = 100.0
    paper_policy = PaperPolicy("evidence", (0.0, 0.0, 0.0))

    def picture(self) -> Any:
        """Return what draws an episode; imported here, because it brings matplotlib."""
        from .picture import PICTURE

        return PICTURE(self)

    def __init__(self, parameters: Any, control: str, xp: ModuleType = numpy, device: Any = None) -> None:
        """Tabulate the satellites and discretise the models."""
        super().__init__(parameters, control, xp, device)
        p = parameters
        S = self.satellites = len(p.satellites)
        M = len(HYPOTHESES)
        self.sensor_groups = gnss_ins.sensor_groups(S)
        self.observations = 2 * S + 6

        times = p.epoch + p.T * numpy.arange(p.horizon + 2)
        local, velocity = satellites.local_orbits(p.satellites, times, *p.site)
        self.satellite_position = self.constant(local)
        self.satellite_velocity = self.constant(velocity)
        self.elevation = self.constant(satellites.look_angles(local)[1])

        self.common = gnss_ins.common_model(
            p.T,
            p.frequency_density,
            p.frequency_walk_density,
            p.angle_walk * DEGREE,
            p.attitude_rate_sigma * DEGREE,
            p.attitude_rate_time,
        )
        models = (
            gnss_ins.rest_model(p.T, p.rest_velocity_sigma, p.reset_acceleration_sigma),
            gnss_ins.constant_velocity_model(p.T, p.increment_sigma, p.reset_acceleration_sigma),
            gnss_ins.singer_model(p.T, p.singer_alpha, p.singer_sigma),
        )
        self.axis = self.constant(numpy.stack([m.transition for m in models], axis=-1)[..., None])
        self.singer_axis = self.constant(models[SINGER].transition)
        noises = [gnss_ins.process_noise(m, self.common) for m in models]
        self.process_noise = self.constant(numpy.stack(noises, axis=-1)[..., None])
        self.transition = self.constant(p.transition)
        self.singer_root = self.constant(numpy.linalg.cholesky(models[SINGER].noise))
        self.clock_root = self.constant(numpy.linalg.cholesky(self.common.clock_noise))

        sigmas = [p.pseudorange_sigma] * S + [p.rate_sigma] * S + [p.accelerometer_sigma] * 3
        sigmas += [p.attitude_sigma * DEGREE] * 3
        self.sensor_sigma = self.constant(sigmas)[:, None]
        self.sensor_variance = [sigma**2 for sigma in sigmas]
        self.initial_sigma = self.constant(
            [p.initial_position_sigma] * 3
            + [p.initial_clock_sigma]
            + [p.initial_velocity_sigma] * 3
            + [p.initial_drift_sigma]
            + [p.initial_acceleration_sigma] * 3
            + [p.initial_attitude_sigma * DEGREE] * 3
            + [p.attitude_rate_sigma * DEGREE] * 3
        )[:, None]
        self.true_angles = self.constant([p.heading * DEGREE, 0.0, 0.0])[:, None]

        self.legs = p.legs if p.course == "random" else 3
        self.noise = NoiseLayout(
            uniforms=5 * self.legs + 4 + 3 + 4 + S,
            initial_normals=gnss_ins.SIZE,
            normals=9 + 8 + self.observations + (2 * S if p.urban else 0),
            row_uniforms=S if p.urban else 0,
        )
        if control == "gain":
            self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(GROUPS),), numpy.float32)
        else:
            self.action_space = bank_action_space(control, M)
        self.actions = len(GROUPS) if control == "gain" else M
        self.fields = self._fields()

    def _fields(self) -> tuple[Field, ...]:
        slots = self.parameters.satellites
        fields = [
            Field(f"nis_{group}_{h}", "1", f"log(1 + NIS / count) of {group} under {h}", "mean")
            for group in GROUPS
            for h in HYPOTHESES
        ]
        fields += [
            Field(
                f"average_nis_{group}_{h}", "1", f"log(1 + short average of NIS / count) of {group} under {h}"
            )
            for group in GROUPS
            for h in HYPOTHESES
        ]
        fields += [
            Field(f"log_likelihood_{h}", "1", f"signed log(1 + nats) of {h} relative to the largest")
            for h in HYPOTHESES
        ]
        fields += [
            Field(f"log_predicted_{h}", "1", f"signed log(1 + nats) of the predicted probability of {h}")
            for h in HYPOTHESES
        ]
        fields += [
            Field(f"accelerometer_{axis}", "9.81 m/s^2", f"specific force, {axis}")
            for axis in ("forward", "right", "down")
        ]
        for what in ("pseudorange", "rate"):
            fields += [
                Field(
                    f"{what}_innovation_{slot}",
                    "1",
                    f"signed log(1 + |innovation| / sigma) of the {what} at the combined prediction",
                )
                for slot in slots
            ]
        fields += [Field(f"elevation_{slot}", "pi/2 rad", "elevation") for slot in slots]
        fields += [Field(f"cn0_{slot}", "10 dB-Hz", "C/N0 less 45 dB-Hz") for slot in slots]
        for what in ("pseudorange", "rate"):
            fields += [
                Field(f"{what}_available_{slot}", "1", f"one where the {what} reached the filter", "mean")
                for slot in slots
            ]
        fields += [Field("time", "horizon", "measurements so far over the horizon")]
        names = GROUPS if self.control == "gain" else HYPOTHESES
        fields += [Field(f"last_{name}", "1", "last action") for name in names]
        return tuple(fields)

    # ------------------------------------------------------------ episode

    def begin(self, uniforms: Array, normals: Array) -> State:
        """Draw the legs and the faults, and start every filter around the truth."""
        xp, p = self.xp, self.parameters
        N, M, S, m = normals.shape[-1], len(HYPOTHESES), self.satellites, self.observations
        zeros = xp.zeros_like(normals[0])
        ones = zeros + 1.0
        legs, fault = uniforms[: 5 * self.legs], uniforms[5 * self.legs :]
        start, kind, acceleration, velocity = (
            self._random_legs(legs) if p.course == "random" else self._fixed_legs(zeros)
        )
        duration = p.horizon * p.T

        def window(position: Array, length: Array) -> list[Array]:
            first = 1.0 + xp.floor(position * xp.clip(duration - length, 0.0, None) / p.T)
            return [first, first + xp.round(length / p.T) - 1.0]

        def scaled(uniform: Array, limits: tuple[float, float]) -> Array:
            return limits[0] + (limits[1] - limits[0]) * uniform

        never = zeros - 1.0
        noisy, stuck = fault[0] < p.rate_fault_probability, fault[4] < p.stick_probability
        noisy_window = window(fault[1], scaled(fault[2], p.rate_fault_duration))
        stuck_window = window(fault[5], scaled(fault[6], p.stick_duration))
        rates_window = window(fault[7], zeros + p.rates_outage)
        out_window = window(fault[8], zeros + p.satellites_outage)
        first_out = xp.floor(fault[9] * S)
        second_out = (first_out + 1.0 + xp.floor(fault[10] * max(S - 1, 1))) % S

        spread = self.initial_sigma * normals
        known = xp.concat([ones[None]] * 3 + [zeros[None]] + [ones[None]] * 3 + [zeros[None]], axis=0)
        known = xp.concat([known, xp.stack([ones] * 3 + [zeros] * 6)], axis=0)
        moving = xp.stack(
            [zeros] * 4
            + [velocity[i] for i in range(3)]
            + [zeros]
            + [acceleration[i, 0] for i in range(3)]
            + [zeros] * 6
        )
        # User states start exact and are known with errors; clock and attitude errors are drawn and unknown.
        truth = moving + (1.0 - known) * spread
        estimate = moving + known * spread
        identity = xp.eye(gnss_ins.SIZE, dtype=normals.dtype, device=self.device)
        covariance = (identity * self.initial_sigma**2)[:, :, None] + zeros
        bank_mean = estimate[:, None] + xp.zeros((1, M, N), dtype=normals.dtype, device=self.device)
        bank_covariance = covariance[:, :, None] + xp.zeros(
            (1, 1, M, N), dtype=normals.dtype, device=self.device
        )
        probabilities = self.constant(p.initial_probabilities)[:, None] + zeros
        blank = xp.zeros((m, N), dtype=normals.dtype, device=self.device)
        groups = xp.zeros((len(GROUPS), M, N), dtype=normals.dtype, device=self.device)
        low, high = p.cn0_limits
        cn0 = scaled(fault[11 : 11 + S], (low, high)) if p.urban else p.clear_cn0 + blank[:S]
        return State(
            clock=xp.zeros((N,), dtype=xp.int64, device=self.device),
            leg_start=start,
            leg_kind=kind,
            leg_acceleration=acceleration,
            rate_fault=xp.stack([*(xp.where(noisy, w, never) for w in noisy_window), xp.floor(fault[3] * S)]),
            stick=xp.stack([xp.where(stuck, w, never) for w in stuck_window]),
            outage=xp.stack([*rates_window, *out_window, first_out, second_out]),
            truth=truth,
            mode=xp.astype(kind[0], xp.int64),
            jump=zeros,
            measurement=blank,
            ins_angles=self.true_angles + truth[gnss_ins.ATTITUDE_ERROR],
            available=blank,
            noise_factor=blank + 1.0,
            stuck=zeros,
            cn0=cn0,
            multipath=blank[:S],
            hold=blank[:S],
            predicted_mean=bank_mean,
            predicted_covariance=bank_covariance,
            bank_mean=bank_mean,
            bank_covariance=bank_covariance,
            log_predicted=imm.log_probabilities(probabilities),
            log_likelihood=xp.zeros_like(probabilities),
            nis=groups,
            average_nis=groups + 1.0,
            range_innovation=blank[: 2 * S],
            probabilities=probabilities,
            estimate=estimate,
            covariance=covariance,
            last_action=xp.zeros((self.actions, N), dtype=normals.dtype, device=self.device),
        )

    def _fixed_legs(self, zeros: Array) -> tuple[Array, Array, Array, Array]:
        xp, p = self.xp, self.parameters
        heading = p.heading * DEGREE
        along, right = (
            (math.sin(heading), math.cos(heading), 0.0),
            (math.cos(heading), -math.sin(heading), 0.0),
        )
        still = (0.0, 0.0, 0.0)
        kinds = (SINGER,) * 3 if p.course == "matched" else (REST, LINE, SINGER)
        directions = (along, along, along) if p.course == "matched" else (still, along, right)
        # The matched course is one leg: the others begin after the end.
        starts = (0, p.horizon + 2, p.horizon + 2) if p.course == "matched" else (0, *p.leg_steps)
        acceleration = self.constant(directions).T[:, :, None] * p.leg_acceleration + zeros
        speed = p.matched_speed if p.course == "matched" else 0.0
        velocity = self.constant(along)[:, None] * speed + zeros
        return (
            xp.stack([zeros + start for start in starts]),
            xp.stack([zeros + kind for kind in kinds]),
            acceleration,
            velocity,
        )

    def _random_legs(self, uniforms: Array) -> tuple[Array, Array, Array, Array]:
        xp, p = self.xp, self.parameters
        starts, kinds, accelerations = [], [], []
        start = xp.zeros_like(uniforms[0])
        kind = xp.where(uniforms[0] < p.rest_probability, float(REST), float(LINE))
        velocity = None
        for leg in range(self.legs):
            length, azimuth, height, strength = (uniforms[5 * leg + i] for i in range(1, 5))
            if leg:
                # A manoeuvre follows rest and straight flight; after it, straight flight or another one.
                straight = xp.where(uniforms[5 * leg] < 0.5, float(LINE), float(SINGER))
                kind = xp.where(kind == SINGER, straight, float(SINGER))
            turn, sine = 2.0 * math.pi * azimuth, 2.0 * height - 1.0
            cosine = xp.sqrt(xp.clip(1.0 - sine * sine, 0.0, None))
            direction = xp.stack([xp.sin(turn) * cosine, xp.cos(turn) * cosine, sine])
            size = p.strength[0] + (p.strength[1] - p.strength[0]) * strength
            starts.append(start)
            kinds.append(kind)
            accelerations.append(xp.where(kind == SINGER, size, 0.0) * direction)
            if leg == 0:
                speed = p.initial_speed[0] + (p.initial_speed[1] - p.initial_speed[0]) * strength
                level = xp.stack([xp.sin(turn), xp.cos(turn), 0.0 * turn])
                velocity = xp.where(kind == REST, 0.0, speed) * level
            seconds = p.leg_duration[0] + (p.leg_duration[1] - p.leg_duration[0]) * length
            start = start + xp.clip(xp.round(seconds / p.T), 1.0, None)
        return xp.stack(starts), xp.stack(kinds), xp.stack(accelerations, axis=1), velocity

    # ------------------------------------------------------------ measurement

    def measure(self, state: State, noise: Array) -> State:
        """Move the truth, predict the bank, sense, and form residuals and likelihoods."""
        xp, p, S = self.xp, self.parameters, self.satellites
        clock = state.clock + 1
        truth, mode, jump = self.move(state, xp.astype(clock, noise.dtype), noise[:17])
        state = state._replace(clock=clock, truth=truth, mode=mode, jump=jump)
        state = self.sense(state, noise[17:])

        chain = imm.predict_mode_probabilities(self.transition, state.probabilities)
        mixed = imm.mix(state.bank_mean, state.bank_covariance, chain.mixing)
        mean, covariance = gnss_ins.predict(
            *mixed, self.axis, self.common.T, self.common.decay, self.process_noise
        )
        steering = chain.probabilities[0] * mean[:, 0]
        for i in range(1, len(HYPOTHESES)):
            steering = steering + chain.probabilities[i] * mean[:, i]
        expected = gnss_ins.ranges(steering, gnss_ins.geometry(steering, *self.satellites_now(state)))
        innovation = state.measurement[: 2 * S] - xp.concat(expected, axis=0)
        state = state._replace(
            predicted_mean=mean,
            predicted_covariance=covariance,
            log_predicted=imm.log_probabilities(chain.probabilities),
            range_innovation=innovation,
        )
        if p.aperture:
            limits = self.constant([p.range_aperture] * S + [p.rate_aperture] * S)[:, None]
            kept = xp.astype(xp.abs(innovation) <= limits, noise.dtype)
            available = xp.concat([state.available[: 2 * S] * kept, state.available[2 * S :]], axis=0)
            state = state._replace(available=available)
        update = self._update(state, self.sensor_variance)
        nis = xp.stack([self.total(update.squared_residuals[g]) for g in self.sensor_groups])
        present = [
            xp.clip(self.total([state.available[j] for j in range(g.start, g.stop)]), 1.0, None)
            for g in self.sensor_groups
        ]
        nis_per_observation = nis / xp.stack(present)[:, None]
        return state._replace(
            bank_mean=update.mean,
            bank_covariance=update.covariance,
            log_likelihood=update.log_likelihood,
            nis=nis,
            average_nis=state.average_nis + p.average * (nis_per_observation - state.average_nis),
        )

    @staticmethod
    def total(terms: Any) -> Array:
        """Sum of a sequence of arrays, term by term: its rounding does not depend on their width."""
        total = terms[0]
        for term in terms[1:]:
            total = total + term
        return total

    def satellites_now(self, state: State) -> tuple[Array, Array]:
        """Positions and velocities of the satellites at the present measurement, ``(3, S, N)`` each."""
        now = self._now(state)
        return (
            self.xp.take(self.satellite_position, now, axis=2),
            self.xp.take(self.satellite_velocity, now, axis=2),
        )

    def _now(self, state: State) -> Array:
        """Where the present measurement stands in the tables; an episode that is over stays at the end."""
        return self.xp.clip(state.clock, None, self.horizon + 1)

    def _update(self, state: State, variance: Any) -> extended_kalman.Correction:
        """Steps 5 and 6 for every hypothesis."""
        position, velocity = self.satellites_now(state)
        expected, rows = gnss_ins.observe(
            state.predicted_mean,
            position[:, :, None],
            velocity[:, :, None],
            state.ins_angles[:, None],
            self.parameters.gravity,
        )
        return extended_kalman.update_one_by_one(
            state.predicted_mean,
            state.predicted_covariance,
            state.measurement[:, None] - expected,
            rows,
            variance,
            state.available,
        )

    def move(self, state: State, k: Array, normals: Array) -> tuple[Array, Array, Array]:
        """Truth at step k, the hypothesis it follows, and whether its acceleration has jumped."""
        xp, p, T = self.xp, self.parameters, self.parameters.T
        kind, push = state.leg_kind[0], state.leg_acceleration[:, 0]
        for i in range(1, self.legs):
            begun = k > state.leg_start[i]
            kind = xp.where(begun, state.leg_kind[i], kind)
            push = xp.where(begun, state.leg_acceleration[:, i], push)

        moved = gnss_ins.advance(state.truth, self.singer_axis, self.common.T, self.common.decay)
        w = xp.reshape(normals[:9], (3, 3, *normals.shape[1:]))
        q = self.singer_root
        singer = (
            moved[0:3] + q[0, 0] * w[0],
            moved[4:7] + (q[1, 0] * w[0] + q[1, 1] * w[1]),
            moved[8:11] + (q[2, 0] * w[0] + q[2, 1] * w[1] + q[2, 2] * w[2]),
        )
        x, v = state.truth[0:3], state.truth[4:7]
        spread = p.true_increment_sigma if p.course == "random" else 0.0
        increment = T * push + spread * w[1]
        felt = push if p.course == "kinematic" else 0.0 * push
        line = (x + T * v + (0.5 * T) * increment, v + increment, felt)
        still = (x, 0.0 * v, 0.0 * v)
        x, v, a = (
            xp.where(kind == REST, r, xp.where(kind == LINE, s, m))
            for r, s, m in zip(still, line, singer, strict=True)
        )
        jumped = k < 0.0
        for i in range(1, self.legs):
            here = (k == state.leg_start[i]) & (state.leg_kind[i] == SINGER)
            a = xp.where(here, state.leg_acceleration[:, i], a)
            jumped = jumped | here
        # From the jump on the user manoeuvres; so he does all along a line whose acceleration is felt.
        mode = xp.where(jumped, float(SINGER), kind)
        if p.course == "kinematic":
            mode = xp.where(kind == LINE, float(SINGER), mode)

        c = self.clock_root
        bias = moved[3] + c[0, 0] * normals[9]
        drift = moved[7] + (c[1, 0] * normals[9] + c[1, 1] * normals[10])
        attitude = moved[11:14] + math.sqrt(self.common.attitude_variance) * normals[11:14]
        rate = moved[14:17] + math.sqrt(self.common.attitude_rate_variance) * normals[14:17]
        truth = xp.concat([x, bias[None], v, drift[None], a, attitude, rate], axis=0)
        return truth, xp.astype(mode, xp.int64), xp.astype(jumped, normals.dtype)

    def sense(self, state: State, noise: Array) -> State:
        """Measurement of the truth with noise, faults, outages and multipath."""
        xp, p, S, m = self.xp, self.parameters, self.satellites, self.observations
        k = xp.astype(state.clock, noise.dtype)
        ins_angles = self.true_angles + state.truth[gnss_ins.ATTITUDE_ERROR]
        exact, _ = gnss_ins.observe(state.truth, *self.satellites_now(state), ins_angles, p.gravity)

        slots = self.constant([float(i) for i in range(S)])[:, None]
        fault = state.rate_fault
        noisy = (k >= fault[0]) & (k <= fault[1]) & (slots == fault[2])
        ones = xp.ones_like(noise[:S])
        factor = xp.concat(
            [ones, xp.where(noisy, p.rate_fault_factor, ones), xp.ones_like(noise[:6])], axis=0
        )
        measured = exact + self.sensor_sigma * factor * noise[:m]

        out = state.outage
        no_rates = (k >= out[0]) & (k <= out[1])
        two_out = (k >= out[2]) & (k <= out[3]) & ((slots == out[4]) | (slots == out[5]))
        seen = xp.where(two_out, 0.0, ones)
        available = xp.concat([seen, xp.where(no_rates, 0.0, seen), xp.ones_like(noise[:6])], axis=0)

        if p.urban:
            state = self._multipath(state, noise[m : m + S], noise[m + S : m + 2 * S], noise[m + 2 * S :])
        # A stick at the first measurement has no last reading to hold.
        stuck = (k >= state.stick[0]) & (k <= state.stick[1]) & (k > 1.0)
        g = self.sensor_groups[2]
        measured = xp.concat(
            [
                measured[:S] + state.multipath,
                measured[S : g.start],
                xp.where(stuck, state.measurement[g], measured[g]),
                measured[g.stop :],
            ],
            axis=0,
        )
        return state._replace(
            measurement=measured,
            ins_angles=ins_angles,
            available=available,
            noise_factor=factor,
            stuck=xp.astype(stuck, noise.dtype),
        )

    def _multipath(self, state: State, walk: Array, normal: Array, uniform: Array) -> State:
        """C/N0 walks between its limits; where an error has run out, a new one is drawn by the C/N0 now.

        Below 30, 38 and 44 dB-Hz the error is lognormal with median 50, 25, 7 m and 95 % quantile 152, 79,
        49 m; above, it is the positive part of a normal error with 95 % quantile 19 m.
        """
        xp, p = self.xp, self.parameters
        low, high = p.cn0_limits
        cn0 = state.cn0 + p.urban_cn0_walk * walk
        cn0 = xp.clip(xp.where(cn0 < low, 2.0 * low - cn0, cn0), low, None)
        cn0 = xp.clip(xp.where(cn0 > high, 2.0 * high - cn0, cn0), low, high)
        z95 = 1.6448536269514722
        error = xp.clip((19.0 / z95) * normal, 0.0, None)
        for limit, median, upper in ((44.0, 7.0, 49.0), (38.0, 25.0, 79.0), (30.0, 50.0, 152.0)):
            drawn = median * xp.exp((math.log(upper / median) / z95) * normal)
            error = xp.where(cn0 < limit, drawn, error)
        ended = state.hold <= 0.0
        shortest, longest = p.urban_hold
        steps = xp.round((shortest + (longest - shortest) * uniform) / p.T)
        return state._replace(
            cn0=cn0,
            multipath=xp.where(ended, error, state.multipath),
            hold=xp.where(ended, steps, state.hold) - 1.0,
        )

    # ------------------------------------------------------------ agent's turn

    def observe(self, state: State) -> Array:
        """What the agent is shown; see the class description."""
        xp, p, S = self.xp, self.parameters, self.satellites
        available = state.available
        counts = xp.stack(
            [
                xp.clip(self.total([available[j] for j in range(g.start, g.stop)]), 1.0, None)
                for g in self.sensor_groups
            ]
        )[:, None]
        N = state.clock.shape[0]
        nis = xp.reshape(xp.log1p(state.nis / counts), (-1, N))
        average = xp.reshape(xp.log1p(state.average_nis), (-1, N))
        relative = state.log_likelihood - xp.max(state.log_likelihood, axis=0)
        time = xp.astype(state.clock, nis.dtype)[None] / p.horizon
        return xp.concat(
            [
                nis,
                average,
                signed_logarithm(relative, xp),
                signed_logarithm(state.log_predicted, xp),
                state.measurement[self.sensor_groups[2]] / p.gravity,
                # What has not arrived is not shown.
                signed_logarithm(
                    available[: 2 * S] * state.range_innovation / self.sensor_sigma[: 2 * S], xp
                ),
                xp.take(self.elevation, self._now(state), axis=1) / (0.5 * math.pi),
                0.1 * (state.cn0 - 45.0),
                available[: 2 * S],
                time,
                state.last_action,
            ],
            axis=0,
        )

    def act(self, state: State, action: Array) -> State:
        """Weigh the hypotheses by the action (steps 7 and 8), or update with the noise it asks for."""
        xp, p = self.xp, self.parameters
        if self.control == "gain":
            action = xp.clip(action, -1.0, 1.0)
            exponent = xp.astype(action, state.truth.dtype)
            up, down = 2.0 * math.log(p.noise_scale), 2.0 * math.log(p.noise_reduction)
            factor = xp.exp(xp.where(exponent > 0.0, up * exponent, down * exponent))
            variance = [
                self.sensor_variance[j] * factor[i]
                for i, g in enumerate(self.sensor_groups)
                for j in range(g.start, g.stop)
            ]
            update = self._update(state, variance)
            state = state._replace(
                bank_mean=update.mean,
                bank_covariance=update.covariance,
                log_likelihood=update.log_likelihood,
            )
            probabilities = imm.mode_posterior(state.log_predicted, state.log_likelihood)
            last = xp.astype(action, state.truth.dtype)
        else:
            probabilities = bank_probabilities(
                self.control, action, state.log_predicted, state.log_likelihood, p.evidence_scale, xp
            )
            probabilities = xp.astype(probabilities, state.truth.dtype)
            if self.control == "mode":
                last = probabilities
            else:
                low = 0.0 if self.control == "weights" else -1.0
                last = xp.astype(xp.clip(action, low, 1.0), state.truth.dtype)
        estimate, covariance = imm.combine(state.bank_mean, state.bank_covariance, probabilities)
        return state._replace(
            probabilities=probabilities, estimate=estimate, covariance=covariance, last_action=last
        )

    # ------------------------------------------------------------ judgement

    def cost(self, state: State) -> Array:
        """Squared position and velocity errors over those of a single-epoch fix, ``(N,)``."""
        p, e = self.parameters, state.estimate - state.truth
        x, v = e[gnss_ins.POSITION], e[gnss_ins.VELOCITY]
        return (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]) / p.position_unit**2 + (
            v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        ) / p.velocity_unit**2

    def error(self, state: State) -> Array:
        """Estimate minus truth, ``(17, N)``."""
        return state.estimate - state.truth

    def covariance(self, state: State) -> Array:
        """Covariance of the combination, ``(17, 17, N)``."""
        return state.covariance

    def records(self, state: State) -> dict[str, Array]:
        """Probabilities, NIS of the combination and its degrees, time, true hypothesis, rates off the aperture."""
        xp, p, S = self.xp, self.parameters, self.satellites
        nis = self.total([state.nis[i] for i in range(len(GROUPS))])
        beyond = xp.abs(state.range_innovation[S:]) > p.rate_aperture
        outside = beyond[0]
        for j in range(1, S):
            outside = outside | beyond[j]
        return {
            "mode_probability": state.probabilities,
            "nis": self.total([state.probabilities[i] * nis[i] for i in range(len(HYPOTHESES))]),
            "nis_degrees": self.total([state.available[j] for j in range(self.observations)]),
            "seconds": p.T * xp.astype(state.clock, state.truth.dtype),
            "true_mode": state.mode,
            "rate_outside_aperture": xp.astype(outside, state.truth.dtype),
        }


TASK = TightlyCoupledNavigation
