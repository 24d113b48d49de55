"""Constants of UavAutopilot, with their limits."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..contract.parameters import ParameterLimits, TaskParameters, check, check_length, parameter
from ..contract.task import Component

COORDINATES: Mapping[str, tuple[Component, ...]] = {
    "P": (Component("position", "m"), Component("rate", "m/s")),
    "U": (
        Component("incidence", "deg"),
        Component("rate", "deg/s"),
        Component("pitch", "deg"),
        Component("elevator", "deg"),
        Component("gust", "deg"),
    ),
}
"""State of each plant; "rate" is the rate of the output in both. "incidence" is the angle of attack without
the gust, "gust" the angle the gust adds to it."""
OUTPUT = {"P": "position", "U": "pitch"}
"""The coordinate of each plant that is commanded."""
NOMINAL_SIGMAS: Mapping[str, Mapping[str, float]] = {
    "P": {"position": 1.0, "rate": 1.0},
    "U": {"pitch": 0.5, "rate": 1.0, "elevator": 0.5},
}
"""Sensors of each plant with their default nominal standard deviations."""
_PLANT_DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "P": {
        "sampling_interval": 0.25,
        "state_weights": (1.0, 1.0),
        "control_weight": 1.0,
        "initial_sigmas": (1.0, 1.0),
    },
    "U": {
        "sampling_interval": 0.02,
        "state_weights": (0.0, 0.02, 1.0, 0.0, 0.0),
        "control_weight": 0.3,
        "initial_sigmas": (1.0, 1.0, 1.0, 1.0, 1.146),
    },
}

LARGEST_ERROR = 1e3
"""Largest error of a sensor in standard deviations: at a hundred times as many, hypotheses are so far apart that the
covariance of merged ones has no digits left."""


@dataclass(frozen=True)
class UavAutopilotParameters(TaskParameters):
    """Constants of the plant, the autopilot, the filter and the episode. None stands for the plant's value.

    Sources: "paper" is the paper; "Aerosonde" are textbook coefficients (Beard and McLain, Small Unmanned
    Aircraft, 2012, appendix E); the rest is ours, with the reason.
    """

    plant: str = parameter("U", choices=tuple(COORDINATES))
    """"P": the paper's double integrator. "U": the pitch channel of a small aircraft, ours, because the
    paper's model has neither actuator nor gusts."""
    sampling_interval: float | None = parameter(None, above=0.0, at_most=86400.0)
    """Sampling interval T, s. P: 0.25 (paper). U: 0.02, ours: fast against the actuator."""
    horizon: int = parameter(600, at_least=1)
    """Measurements in an episode. Ours: some thirty settling times of either loop."""

    sensors: tuple[str, ...] | None = None
    """Coordinates that are measured. P: both, the paper's case ``H = I``. U: rate gyro and potentiometer of the
    elevator, as in the paper, and pitch (ours) in place of its accelerometers: acceleration is no coordinate."""
    sensor_sigmas: tuple[float, ...] | None = parameter(None, above=0.0)
    """Nominal standard deviation of one reading of each sensor. P: 1 m, 1 m/s, ours: as large as the unit
    step. U: 0.5 deg, 1 deg/s, 0.5 deg, ours: cheap sensors."""
    initial_sigmas: tuple[float, ...] | None = parameter(None, above=0.0)
    """Standard deviations of the state at the start, known to the filter. P: 1, ours. U: 1 for the aircraft,
    ours, and the stationary deviation of light gusts."""

    state_weights: tuple[float, ...] | None = parameter(None, at_least=0.0)
    """Weights of the squared deviations of the state in the cost. Ours: P (1, 1); U pitch 1, rate 0.02."""
    control_weight: float | None = parameter(None, above=0.0)
    """Weight of the squared control. Ours: P 1; U 0.3, which keeps deflections to a few degrees."""
    feedback: tuple[float, ...] | None = None
    """Autopilot gain L; None: the discrete linear-quadratic regulator of these weights."""

    acceleration_sigma: float = parameter(0.2, above=0.0)
    """Plant P: standard deviation of the noise added to the control, m/s^2. Ours."""
    mass: float = parameter(13.5, above=0.0)
    """Mass, kg (Aerosonde, as the following)."""
    pitch_inertia: float = parameter(1.135, above=0.0)
    """Pitch inertia, kg m^2."""
    wing_area: float = parameter(0.55, above=0.0)
    """Wing area, m^2."""
    chord: float = parameter(0.18994, above=0.0)
    """Chord, m."""
    air_density: float = parameter(1.2682, above=0.0)
    """Air density, kg/m^3."""
    airspeed: float = parameter(35.0, above=0.0)
    """Airspeed V, m/s."""
    lift_incidence: float = 3.45
    """Lift coefficient per rad of incidence."""
    lift_elevator: float = -0.36
    """Lift coefficient per rad of elevator."""
    moment_incidence: float = -0.38
    """Pitching-moment coefficient per rad of incidence."""
    moment_rate: float = -3.6
    """Pitching-moment coefficient per reduced pitch rate ``q c / (2 V)``."""
    moment_elevator: float = -0.5
    """Pitching-moment coefficient per rad of elevator."""
    actuator_time_constant: float = parameter(0.05, above=0.0)
    """Time constant of the actuator in the model of filter and autopilot, s; ours, a usual servo."""
    actuator_lag: float = parameter(1.0, above=0.0)
    """True time constant of the actuator over that of the model."""
    gust_sigma: float = parameter(0.7, above=0.0)
    """Vertical gusts at level 1, m/s; light turbulence. Ours: 1.4 is moderate, 2.8 severe."""
    gust_length: float = parameter(50.0, above=0.0)
    """Scale of turbulence, m; low altitude."""
    moment_disturbance: float = parameter(4.0, above=0.0)
    """Intensity of the noise on the pitch acceleration, (deg/s^2)^2 s. Ours: gusts alone have a zero at the
    origin towards the pitch rate, so the filter would have no steady state."""
    actuator_disturbance: float = parameter(0.4, above=0.0)
    """Intensity of the noise on the elevator rate, (deg/s)^2 s. Ours: play of the linkage; without it the filter's
    variance of the elevator would go to zero, and its covariance would be singular."""

    step_size: float = 0.0
    """Step of the command, in units of the output."""
    step_time: int = parameter(1, at_least=1)
    """First measurement with the step."""
    command_amplitude: tuple[float, float] = parameter((0.0, 0.0), at_least=0.0, ascending=True)
    """Range of the size of random manoeuvres, in units of the output; zero: none."""
    command_period: int = parameter(150, at_least=1)
    """Measurements per random manoeuvre. Ours: five settling times."""
    doublet_width: int = parameter(25, at_least=1)
    """Measurements of each half of a doublet. Ours: about a settling time."""
    disturbance_levels: tuple[tuple[float, float], ...] = parameter(((1.0, 1.0),), above=0.0, ascending=True)
    """Range of the disturbance's level in each part of the episode, drawn log-uniformly. In plant U it
    multiplies the gusts, in plant P the noise on the control."""
    disturbance_times: tuple[tuple[int, int], ...] = parameter((), at_least=1, ascending=True)
    """Range of the first measurement of the second and further parts."""
    sensor_levels: tuple[tuple[float, float], ...] = parameter(((1.0, 1.0),), above=0.0, ascending=True)
    """Range of the factor on the standard deviation of each sensor, in each part of the episode."""
    sensor_times: tuple[tuple[int, int], ...] = parameter((), at_least=1, ascending=True)
    """Range of the first measurement of the second and further parts."""
    changing_sensors: tuple[str, ...] | None = None
    """Sensors that these factors apply to; None: all, drawn independently."""
    sensor_coloured: tuple[float, float] = parameter(
        (0.0, 0.0), at_least=0.0, at_most=LARGEST_ERROR, ascending=True
    )
    """Interval of the stationary standard deviation of the coloured error of each sensor (first-order Gauss-Markov),
    in addition to the white one, over its nominal standard deviation, drawn uniformly; unreported."""
    sensor_correlation_time: tuple[float, float] = parameter((0.2, 5.0), above=0.0, ascending=True)
    """Interval of the correlation time of this error, s, drawn log-uniformly. Ours: from ten samples to half an
    episode of plant U."""
    sensor_bias: tuple[float, float] = parameter(
        (0.0, 0.0), at_least=0.0, at_most=LARGEST_ERROR, ascending=True
    )
    """Interval of the size of a constant error of a sensor, over its nominal standard deviation, drawn uniformly, of
    either sign; unreported."""
    biased_sensors: tuple[str, ...] | None = None
    """Sensors that have such an error; None: all, drawn independently."""
    dropout_period: int = parameter(0, at_least=0)
    """Period of the dropouts of each sensor, measurements; zero: none."""
    dropout_length: tuple[int, int] = parameter((1, 15), at_least=1, ascending=True)
    """Range of the length of dropouts, measurements. Ours: up to half a settling time."""
    undisturbed: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability of an episode in which all levels and factors are one. Ours. Dropouts have the law of other
    episodes."""

    gain_decades: float = parameter(0.5, above=0.0, at_most=4.0)
    """Decades by which an action of one scales the process noise. Ours: the filter's poles stay inside the
    unit circle for every positive scale, so the value is the useful range. It is not larger, because an agent that
    explores over decades learns to avoid them. The limit of the ratio of largest to smallest scale is half the
    digits of a number."""
    process_decades: float = parameter(1.5, above=0.0, at_most=4.0)
    """Decades by which an action can scale the process noise under control ``noise``. Ours: slightly more than
    levels from 0.2 to 5 need."""
    sensor_decades: float = parameter(0.8, above=0.0, at_most=4.0)
    """Decades by which an action can scale the sigma of a sensor. Ours: the largest factor of ``random``."""
    noise_reach: float = parameter(0.2, above=0.0, at_most=1.0)
    """Share of these two that an action of one has under control ``noise``. Ours: a new policy explores with a standard
    deviation of about one. With the whole range this costs several times as much as the paper's filter, so that the
    policy mainly learns to reduce the effect of its own noise. A policy that explores less may use more."""
    wide_band_scale: float = parameter(100.0, above=0.0)
    """Scale of the process noise in mode "wide-band"."""
    over_smoothed_scale: float = parameter(0.01, above=0.0)
    """Scale of the process noise in mode "over-smoothed"."""
    averaging_measurements: float = parameter(20.0, at_least=1.0)
    """Time constant of the exponential averages in the observation, measurements. Ours: shorter than a
    settling time."""

    def check(self) -> None:
        """Raise ValueError for fields that contradict each other or the plant."""
        names = tuple(c.name for c in COORDINATES[self.plant])
        sensors = self.value("sensors")
        if not sensors or len(set(sensors)) != len(sensors):
            raise ValueError(f"sensors must name one or more coordinates, each once, got {sensors!r}")
        for sensor in sensors:
            check("each of sensors", sensor, str, ParameterLimits(choices=names))
        missing = [sensor for sensor in sensors if sensor not in NOMINAL_SIGMAS[self.plant]]
        if missing and self.sensor_sigmas is None:
            raise ValueError(
                f"sensor_sigmas must be given for sensors {sensors!r}: {missing!r} have no default"
            )
        check_length("sensor_sigmas", self.value("sensor_sigmas"), len(sensors))
        for name in ("initial_sigmas", "state_weights"):
            check_length(name, self.value(name), len(names))
        if self.feedback is not None:
            check_length("feedback", self.feedback, len(names))
        if self.plant == "P" and self.actuator_lag != 1.0:
            raise ValueError(
                f"actuator_lag must be 1 for plant 'P', which has no actuator, got {self.actuator_lag}"
            )
        if self.step_size and self.command_amplitude[1]:
            raise ValueError(
                "step_size and command_amplitude exclude each other, got "
                f"{self.step_size!r} and {self.command_amplitude!r}"
            )
        if self.command_period <= 2 * self.doublet_width:
            raise ValueError(
                f"command_period must be longer than a doublet, 2 x {self.doublet_width}, "
                f"got {self.command_period}"
            )
        self._check_parts("disturbance", self.disturbance_levels, self.disturbance_times)
        self._check_parts("sensor", self.sensor_levels, self.sensor_times)
        for name in ("changing_sensors", "biased_sensors"):
            for sensor in getattr(self, name) or ():
                check(f"each of {name}", sensor, str, ParameterLimits(choices=sensors))
        if 0 < self.dropout_period <= self.dropout_length[1]:
            raise ValueError(
                f"dropout_period must be longer than the longest dropout, {self.dropout_length[1]}, "
                f"got {self.dropout_period}"
            )

    def _check_parts(self, kind: str, levels: tuple[Any, ...], times: tuple[tuple[int, int], ...]) -> None:
        if len(levels) != len(times) + 1:
            raise ValueError(
                f"{kind}_levels must have one range more than {kind}_times, got {levels!r} and {times!r}"
            )
        for i in range(1, len(times)):
            check(
                f"{kind}_times[{i}]", times[i], tuple[int, int], ParameterLimits(at_least=times[i - 1][1] + 1)
            )

    def value(self, name: str) -> Any:
        """Return the value of a parameter by its name; the plant's default where it is None."""
        given = getattr(self, name)
        if given is not None:
            return given
        if name == "sensors":
            return tuple(NOMINAL_SIGMAS[self.plant])
        if name == "sensor_sigmas":
            return tuple(NOMINAL_SIGMAS[self.plant][sensor] for sensor in self.value("sensors"))
        return _PLANT_DEFAULTS[self.plant][name]
