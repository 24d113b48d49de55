r"""The Kalman filter inside the control loop of a small unmanned aircraft.

After Y. V. Gridnev, A. Y. Rusetski and S. A. Rak, "Stochastic simulation of the automatic control systems of
unmanned aircraft using optimal Kalman filter". Numbers in brackets are the paper's equations.

    truth       x(k+1) = F x(k) + B u(k) + s(k+1) C_s xi + C_o eta                   (8)
    sensors     z_i(k) = x_i(k) + f_i(k) sigma_i v_i                                 (9)
    prediction  x'(k+1) = F x(k|k) + B u(k),  P' = F P F^T + g Q                     (10), (12)
    update      with the Kalman gain of P', for the sensors that answered            (11), (12)
    autopilot   u(k) = N r(k) - L x(k|k)

``s`` is the level of the disturbance and ``f`` that of the sensor noise, both 1 in the filter's model; the
action sets ``g``. The command r shifts the equilibrium: output r, everything else zero, which both plants
hold without control because they integrate.

Reading: (6) and (10) print no command; it enters the prediction with the control, else a unit command ends
far from one. Reading: the noise printed in (10) has mean zero and is unknown, so it is dropped.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import ModuleType
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy

from ...filters import gaussian, linear_systems, packed_covariance
from ...filters.gusts import vertical_gust
from .. import parameters as check
from ..controls import signed_logarithm
from ..task import Array, Component, Field, NoiseLayout, PaperPolicy, Scenario, Task
from .scenarios import SCENARIOS

MODES = ("nominal", "wide-band", "raw-sensors")


class Coordinate(NamedTuple):
    """One coordinate of a plant's state."""

    name: str
    unit: str


COORDINATES: Mapping[str, tuple[Coordinate, ...]] = {
    "P": (Coordinate("position", "m"), Coordinate("rate", "m/s")),
    "U": (
        Coordinate("incidence", "deg"),
        Coordinate("rate", "deg/s"),
        Coordinate("pitch", "deg"),
        Coordinate("elevator", "deg"),
        Coordinate("gust", "deg"),
    ),
}
"""State of each plant; "rate" is the rate of the output in both. "incidence" is the angle of attack without
the gust, "gust" the angle the gust adds to it."""
OUTPUT = {"P": "position", "U": "pitch"}

FARTHEST = 1e4
"""Where a coordinate of a lost loop stops, in its own unit: far beyond what any stable loop reaches, and
small enough for squares to stay numbers."""

_PLANT_DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "P": {
        "sampling_interval": 0.25,
        "sensors": ("position", "rate"),
        "sensor_sigmas": (1.0, 1.0),
        "state_weights": (1.0, 1.0),
        "control_weight": 1.0,
        "initial_sigmas": (1.0, 1.0),
    },
    "U": {
        "sampling_interval": 0.02,
        "sensors": ("pitch", "rate", "elevator"),
        "sensor_sigmas": (0.5, 1.0, 0.5),
        "state_weights": (0.0, 0.02, 1.0, 0.0, 0.0),
        "control_weight": 0.3,
        "initial_sigmas": (1.0, 1.0, 1.0, 1.0, 1.146),
    },
}


@dataclass(frozen=True)
class UavAutopilotParameters:
    """Constants of the plant, the autopilot, the filter and the episode. None stands for the plant's value.

    Sources: "paper" is the paper; "Aerosonde" are textbook coefficients (Beard and McLain, Small Unmanned
    Aircraft, 2012, appendix E); the rest is ours, with the reason.
    """

    plant: str = "U"
    """"P": the paper's double integrator. "U": the pitch channel of a small aircraft, ours, because the
    paper's model has neither actuator nor gusts."""
    sampling_interval: float | None = None
    """T, s. P: 0.25 (paper). U: 0.02, ours: fast against the actuator."""
    horizon: int = 600
    """Measurements in an episode. Ours: some thirty settling times of either loop."""
    decision_interval: int = 1
    """Measurements for which one action holds."""

    sensors: tuple[str, ...] | None = None
    """Coordinates that are measured. P: both, the paper's case ``H = I``. U: pitch, rate gyro, and the
    potentiometer of the elevator, the kinds the paper lists."""
    sensor_sigmas: tuple[float, ...] | None = None
    """Nominal standard deviation of one reading of each sensor. P: 1 m, 1 m/s, ours: as large as the unit
    step. U: 0.5 deg, 1 deg/s, 0.5 deg, ours: cheap sensors."""
    initial_sigmas: tuple[float, ...] | None = None
    """Standard deviations of the state at the start, known to the filter. P: 1, ours. U: 1 for the aircraft,
    ours, and the stationary deviation of light gusts."""

    state_weights: tuple[float, ...] | None = None
    """Weights of the squared deviations of the state in the cost. Ours: P (1, 1); U pitch 1, rate 0.02."""
    control_weight: float | None = None
    """Weight of the squared control. Ours: P 1; U 0.3, which keeps deflections to a few degrees."""
    feedback: tuple[float, ...] | None = None
    """Autopilot gain L; None: the discrete linear-quadratic regulator of these weights."""

    acceleration_sigma: float = 0.2
    """Plant P: standard deviation of the noise added to the control, m/s^2. Ours."""
    mass: float = 13.5
    """kg, Aerosonde; so are the following."""
    pitch_inertia: float = 1.135
    """kg m^2."""
    wing_area: float = 0.55
    """m^2."""
    chord: float = 0.18994
    """m."""
    air_density: float = 1.2682
    """kg/m^3."""
    airspeed: float = 35.0
    """V, m/s."""
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
    actuator_time_constant: float = 0.05
    """s; ours, a usual servo. The filter and the autopilot believe it."""
    actuator_lag: float = 1.0
    """True time constant over the believed one."""
    gust_sigma: float = 0.7
    """Vertical gusts at level 1, m/s; light turbulence. Ours: 1.4 is moderate, 2.8 severe."""
    gust_length: float = 50.0
    """Scale of turbulence, m; low altitude."""
    moment_disturbance: float = 4.0
    """Intensity of the noise on the pitch acceleration, (deg/s^2)^2 s. Ours: gusts alone have a zero at the
    origin towards the pitch rate, so the filter would have no steady state."""
    actuator_disturbance: float = 0.4
    """Intensity of the noise on the elevator rate, (deg/s)^2 s. Ours: play of the linkage."""

    step_size: float = 0.0
    """Step of the command, in units of the output."""
    step_time: int = 1
    """Measurement from which the step is in force."""
    command_amplitude: tuple[float, float] = (0.0, 0.0)
    """Range of the size of random manoeuvres, in units of the output; zero: none."""
    command_period: int = 150
    """Measurements per random manoeuvre. Ours: five settling times."""
    doublet_width: int = 25
    """Measurements of each half of a doublet. Ours: about a settling time."""
    disturbance_levels: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    """Range of the disturbance's level in each part of the episode, drawn log-uniformly. In plant U it
    multiplies the gusts, in plant P the noise on the control."""
    disturbance_times: tuple[tuple[int, int], ...] = ()
    """Range of the first measurement of the second and further parts."""
    sensor_levels: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    """Range of the factor on the standard deviation of each sensor, in each part of the episode."""
    sensor_times: tuple[tuple[int, int], ...] = ()
    """Range of the first measurement of the second and further parts."""
    changing_sensors: tuple[str, ...] | None = None
    """Sensors that these factors apply to; None: all, drawn independently."""
    dropout_period: int = 0
    """Each sensor drops out once in every so many measurements; zero: never."""
    dropout_length: tuple[int, int] = (1, 15)
    """Range of their length in measurements. Ours: up to half a settling time."""

    gain_decades: float = 2.0
    """Decades by which an action of one scales the process noise. Ours: the filter's poles stay inside the
    circle for every positive scale, so the limit is what is useful."""
    wide_band_scale: float = 100.0
    """Scale of the process noise in mode "wide-band"."""
    average_window: int = 20
    """Measurements over which the shown averages forget. Ours: shorter than a settling time."""

    def __post_init__(self) -> None:
        """Check every constant that a user can set."""
        for item in fields(self):
            object.__setattr__(self, item.name, check.frozen(getattr(self, item.name)))
        check.choice("plant", self.plant, tuple(COORDINATES))
        names = tuple(c.name for c in COORDINATES[self.plant])
        for name in ("horizon", "decision_interval", "step_time", "command_period", "doublet_width"):
            check.integer(name, getattr(self, name), at_least=1)
        check.integer("average_window", self.average_window, at_least=1)
        check.integer("dropout_period", self.dropout_period, at_least=0)
        check.number("sampling_interval", self.value("sampling_interval"), above=0.0)
        sensors = self.value("sensors")
        if not sensors or not isinstance(sensors, tuple) or len(set(sensors)) != len(sensors):
            raise ValueError(f"sensors must name one or more coordinates, each once, got {sensors!r}")
        for name in sensors:
            check.choice("each of sensors", name, names)
        if "sensors" in self.given and "sensor_sigmas" not in self.given:
            nominal = dict(zip(*(self.defaults[key] for key in ("sensors", "sensor_sigmas")), strict=True))
            missing = [name for name in sensors if name not in nominal]
            if missing:
                raise ValueError(
                    f"sensor_sigmas must be given for sensors {sensors!r}: {missing!r} have no default"
                )
        check.numbers("sensor_sigmas", self.value("sensor_sigmas"), len(sensors), above=0.0)
        check.numbers("initial_sigmas", self.value("initial_sigmas"), len(names), above=0.0)
        check.numbers("state_weights", self.value("state_weights"), len(names), at_least=0.0)
        check.number("control_weight", self.value("control_weight"), above=0.0)
        if self.feedback is not None:
            check.numbers("feedback", self.feedback, len(names))
        for name in ("acceleration_sigma", "mass", "pitch_inertia", "wing_area", "chord", "air_density",
                     "airspeed", "actuator_time_constant", "actuator_lag", "gust_sigma", "gust_length",
                     "moment_disturbance", "gain_decades", "wide_band_scale"):  # fmt: skip
            check.number(name, getattr(self, name), above=0.0)
        check.number("actuator_disturbance", self.actuator_disturbance, at_least=0.0)
        for name in ("lift_incidence", "lift_elevator", "moment_incidence", "moment_rate", "moment_elevator"):
            check.number(name, getattr(self, name))
        if self.plant == "P" and self.actuator_lag != 1.0:
            raise ValueError(
                f"actuator_lag must be 1 for plant 'P', which has no actuator, got {self.actuator_lag}"
            )
        self._check_schedule(sensors)

    def _check_schedule(self, sensors: tuple[str, ...]) -> None:
        check.number("step_size", self.step_size)
        check.interval("command_amplitude", self.command_amplitude, at_least=0.0)
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
        for kind in ("disturbance", "sensor"):
            levels, times = getattr(self, f"{kind}_levels"), getattr(self, f"{kind}_times")
            if not isinstance(levels, tuple) or not isinstance(times, tuple) or len(levels) != len(times) + 1:
                raise ValueError(
                    f"{kind}_levels must have one range more than {kind}_times, got {levels!r} and {times!r}"
                )
            for i, level in enumerate(levels):
                check.interval(f"{kind}_levels[{i}]", level, above=0.0)
            earliest = 1
            for i, time in enumerate(times):
                check.interval(f"{kind}_times[{i}]", time, at_least=earliest)
                earliest = time[1] + 1
        for name in self.changing_sensors or ():
            check.choice("each of changing_sensors", name, sensors)
        check.interval("dropout_length", self.dropout_length, at_least=1)
        if 0 < self.dropout_period <= self.dropout_length[1]:
            raise ValueError(
                f"dropout_period must be longer than the longest dropout, {self.dropout_length[1]}, "
                f"got {self.dropout_period}"
            )

    @property
    def defaults(self) -> Mapping[str, Any]:
        """Values that None stands for."""
        return _PLANT_DEFAULTS[self.plant]

    @property
    def given(self) -> set[str]:
        """Names of those values that were stated and not left to the plant."""
        return {name for name in self.defaults if getattr(self, name) is not None}

    def value(self, name: str) -> Any:
        """Value of a constant that may have been left to the plant."""
        if name in self.given:
            return getattr(self, name)
        if name == "sensor_sigmas" and "sensors" in self.given:
            nominal = dict(zip(self.defaults["sensors"], self.defaults["sensor_sigmas"], strict=True))
            return tuple(nominal[sensor] for sensor in self.value("sensors"))
        return self.defaults[name]


class Model(NamedTuple):
    """Discrete plant with its noise in two parts, as NumPy arrays."""

    F: numpy.ndarray
    """Transition matrix (7), ``(n, n)``."""
    B: numpy.ndarray
    """``(n, 1)``."""
    scaled_noise: numpy.ndarray
    """Covariance of the part of the process noise that the disturbance's level multiplies, ``(n, n)``."""
    other_noise: numpy.ndarray
    """Covariance of the rest, ``(n, n)``."""


def constant_rate(parameters: UavAutopilotParameters) -> Model:
    """Plant P: ``F = [[1, T], [0, 1]]``, "with the first derivative of the useful signal" (paper).

    Reading: the scan has "1 0,25 / F = 0 =1"; the "=" is a stray sign. ``B = [T^2/2, T]`` and noise that
    enters with the control are ours.
    """
    T = parameters.value("sampling_interval")
    B = numpy.array([[T**2 / 2], [T]])
    Q = parameters.acceleration_sigma**2 * B @ B.T
    return Model(numpy.array([[1.0, T], [0.0, 1.0]]), B, Q, numpy.zeros((2, 2)))


def pitch_channel(parameters: UavAutopilotParameters, actuator_lag: float = 1.0) -> Model:
    """Plant U: short period, pitch, actuator and gust of a small aircraft, in degrees and deg/s.

    With the aerodynamic angle ``a = incidence + gust``:
    ``incidence' = rate - Z_a a - Z_d elevator``, ``rate' = M_a a + M_q rate + M_d elevator + w_q``,
    ``pitch' = rate``, ``elevator' = (u - elevator) / tau + w_d``, ``gust' = -(V / L) gust + w_g``.
    """
    p = parameters
    lift = p.air_density * p.airspeed * p.wing_area / (2.0 * p.mass)
    moment = p.air_density * p.airspeed**2 * p.wing_area * p.chord / (2.0 * p.pitch_inertia)
    Z_a, Z_d = lift * p.lift_incidence, lift * p.lift_elevator
    M_a, M_d = moment * p.moment_incidence, moment * p.moment_elevator
    M_q = moment * p.moment_rate * p.chord / (2.0 * p.airspeed)
    tau = p.actuator_time_constant * actuator_lag
    gust = vertical_gust(p.airspeed, p.gust_length, p.gust_sigma)
    A = numpy.array(
        [
            [-Z_a, 1.0, 0.0, -Z_d, -Z_a],
            [M_a, M_q, 0.0, M_d, M_a],
            [0.0, 1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, -1.0 / tau, 0.0],
            [0.0, 0.0, 0.0, 0.0, -gust.rate],
        ]
    )
    drive = numpy.array([[0.0], [0.0], [0.0], [1.0 / tau], [0.0]])
    T = p.value("sampling_interval")
    F, B = linear_systems.zero_order_hold(A, drive, T)
    _, scaled = linear_systems.van_loan(A, numpy.diag([0.0, 0.0, 0.0, 0.0, gust.intensity]), T)
    rest = numpy.diag([0.0, p.moment_disturbance, 0.0, p.actuator_disturbance, 0.0])
    _, other = linear_systems.van_loan(A, rest, T)
    return Model(F, B, scaled, other)


class Design(NamedTuple):
    """Everything that is computed once: believed and true plant, autopilot, filter, theory of the loop."""

    model: Model
    """What the filter and the autopilot believe."""
    true_model: Model
    H: numpy.ndarray
    """``(m, n)``."""
    R: numpy.ndarray
    """Nominal, ``(m, m)``."""
    feedback: numpy.ndarray
    """L, ``(1, n)``."""
    feedforward: float
    """N."""
    weight: numpy.ndarray
    """Of the state in the cost, ``(n, n)``."""
    control_weight: float
    steady: linear_systems.SteadyFilter
    """The nominal filter once settled."""
    state_covariance: numpy.ndarray
    """Of the state in the nominal loop without command, ``(n, n)``."""


def design(parameters: UavAutopilotParameters) -> Design:
    """Design the loop.

    Raises:
        ValueError: if L does not stabilise the plant, or the sensors do not determine the state.
    """
    if parameters.plant == "P":
        model = true_model = constant_rate(parameters)
    else:
        model, true_model = pitch_channel(parameters), pitch_channel(parameters, parameters.actuator_lag)
    names = [c.name for c in COORDINATES[parameters.plant]]
    H = numpy.eye(len(names))[[names.index(sensor) for sensor in parameters.value("sensors")]]
    R = numpy.diag(numpy.square(parameters.value("sensor_sigmas")))
    weight = numpy.diag(parameters.value("state_weights"))
    control_weight = parameters.value("control_weight")
    if parameters.feedback is None:
        L = linear_systems.discrete_regulator(model.F, model.B, weight, numpy.array([[control_weight]]))
    else:
        L = numpy.array([parameters.feedback])
    for plant, word in ((model, "the plant"), (true_model, "the plant with the true actuator")):
        radius = linear_systems.spectral_radius(plant.F - plant.B @ L)
        if radius >= 1.0:
            raise ValueError(
                f"feedback must stabilise {word}: with L = {L[0].round(6).tolist()} the spectral radius of "
                f"F - B L is {radius:.6g}, and must be below 1"
            )
    Q = model.scaled_noise + model.other_noise
    steady = linear_systems.steady_kalman(model.F, H, Q, R)
    loop = linear_systems.estimate_feedback_loop(model.F, model.B, H, L, steady.gain, Q, R)
    n = len(names)
    X = linear_systems.stationary_covariance(*loop)[:n, :n]
    output = numpy.eye(n)[names.index(OUTPUT[parameters.plant])]
    N = linear_systems.feedforward_gain(model.F, model.B, output, L)
    return Design(model, true_model, H, R, L, N, weight, control_weight, steady, X)


class State(NamedTuple):
    """N loops at one measurement; arrays with the batch last."""

    clock: Array
    """Measurements so far, ``(N,)``."""
    truth: Array
    """``(n, N)``."""
    mean: Array
    """The filter's state: after ``measure`` predicted, after ``act`` updated, ``(n, N)``."""
    filter_covariance: Array
    """Packed triangle; after ``measure`` it is ``F P F^T``, without process noise."""
    estimate: Array
    """What the autopilot uses and the task reports, ``(n, N)``."""
    estimate_covariance: Array
    """Packed triangle of its covariance."""
    scale: Array
    """Factor on the process noise in the last update, ``(N,)``."""
    action: Array
    """Last action as shown, ``(A, N)``."""
    measurement: Array
    """Last valid reading of each sensor, ``(m, N)``."""
    available: Array
    """1 where a sensor answered, 0 in a dropout, ``(m, N)``."""
    innovation: Array
    """Over sigma; 0 in a dropout, ``(m, N)``."""
    nis: Array
    """Normalised innovation squared per available reading, ``(N,)``."""
    mean_innovation: Array
    """Short average of the innovation, ``(m, N)``."""
    mean_square: Array
    """Short average of its square, ``(m, N)``."""
    mean_nis: Array
    """Short average of the NIS, ``(N,)``."""
    command: Array
    """r at this measurement, ``(N,)``."""
    control: Array
    """u in force since the measurement before, ``(N,)``."""
    level: Array
    """Of the disturbance in the interval before this measurement, ``(N,)``."""
    sensor_level: Array
    """Of the sensors' noise at this measurement, ``(m, N)``."""
    command_times: Array
    """``(J, N)``, ascending."""
    commands: Array
    """Command from each of those times on, ``(J, N)``."""
    disturbance_times: Array
    levels: Array
    sensor_times: Array
    sensor_levels: Array
    dropout_starts: Array
    """First measurement without a reading, ``(D, m, N)``."""
    dropout_stops: Array
    """First measurement with a reading again, ``(D, m, N)``."""


class UavAutopilot(Task[State]):
    r"""Steer the Kalman filter that feeds the autopilot of a small unmanned aircraft.

    ## Description

    A plant is held on its command by ``u = N r - L x(k|k)``. The autopilot does not see the state x: it gets
    the estimate of a Kalman filter that hears noisy sensors, and this loop is closed. The action changes the
    filter, the estimate moves the controls, the controls move the aircraft. Noise is fixed by the seed; the
    truth follows from the actions.

    ``plant="U"`` (default) is the pitch channel of a small aircraft with an actuator and gusts, 50
    measurements a second, state incidence, rate, pitch, elevator, gust; pitch is commanded. ``plant="P"`` is
    the paper's double integrator, 4 measurements a second. The autopilot is a linear-quadratic regulator.

    The filter believes nominal noise. In the scenario ``random`` the gusts and the sensors' noise differ from
    it and change during the episode, sensors drop out for a moment, and steps and doublets are commanded. A
    filter that trusts its model too much follows gusts late; one that trusts its sensors too much passes
    their noise on to the elevator.

    ## Action Space

    * ``control="gain"`` (default), ``Box(-1, 1, (1,))``: the process noise Q of the filter is scaled by
      ``10 ** (2 a)`` in the update by the measurement that was just shown. Zero is the paper's filter.
    * ``control="mode"``, ``Discrete(3)``: 0 nominal; 1 wide-band, Q times 100; 2 raw sensors: the same L on
      the readings (held during dropouts), zero for coordinates without a sensor; the filter runs on behind.

    ## Observation Space

    For each sensor the innovation over its sigma, its short average, the logarithm of the short average of
    its square, the reading, and whether it answered; the log NIS per reading and that of its short average;
    the command, the control in force, the log trace of the covariance, the time, the last action.
    Innovations, command, control and readings are compressed by ``sign(x) log(1 + |x|)`` in units of one
    sigma of a sensor. Sigmas are those of the filter before it is acted on: its last covariance, predicted
    with the Q of the last action.

    ## Rewards

    Minus the quadratic cost of the loop at this measurement,
    ``((x - x_r)^T W (x - x_r) + R u^2) / sigma^2``. ``x_r`` is the equilibrium of the command (output r, all
    else zero), u the control that follows from the estimate, sigma the nominal standard deviation of the
    output's sensor (U: 0.5 deg; P: 1 m). Beyond the Huber bound it grows linearly. An action shows at once in
    the control and later in the tracking error: the problem is not myopic.

    ## Starting State

    The state is drawn with ``initial_sigmas`` about zero and the filter starts at zero with that covariance.

    ## Episode End

    Truncation after ``horizon`` measurements acted on (600: 12 s for U, 150 s for P). No termination: a loop
    that an unstable choice (such as raw readings of too few sensors) drives away stops at 10 000 units of
    each coordinate and goes on being charged.

    ## Arguments

    ``plant``, ``control``, ``scenario`` (``random``, ``paper-noise``, ``paper-step``; held out:
    ``gust-front``, ``sensor-degradation``, ``actuator-lag``), and every field of
    :class:`UavAutopilotParameters`. Refused, with the reason: an L that does not stabilise the plant, noise
    that is not positive, sensors that do not determine the state.

    ## Version History

    * v0: first version.
    """

    id = "filtergym/UavAutopilot-v0"
    paper_source = (
        "Y. V. Gridnev, A. Y. Rusetski, S. A. Rak, Stochastic simulation of the automatic control systems of "
        "unmanned aircraft using optimal Kalman filter"
    )
    controls = ("gain", "mode")
    Parameters = UavAutopilotParameters
    scenarios: ClassVar[Mapping[str, Scenario]] = SCENARIOS
    components = tuple(Component(*c) for c in COORDINATES["U"])
    cost_description = (
        "quadratic cost of the loop, weighted tracking error and control squared, in units of the nominal "
        "variance of the output's sensor"
    )
    huber_bound = 30.0
    paper_policy = PaperPolicy("gain", (0.0,))

    def picture(self) -> Any:
        """Return what draws an episode; imported here, because it brings matplotlib."""
        from .picture import PICTURE

        return PICTURE(self)

    def __init__(
        self, parameters: UavAutopilotParameters, control: str, xp: ModuleType = numpy, device: Any = None
    ) -> None:
        """Design the loop and lay out noise, observation and action."""
        super().__init__(parameters, control, xp, device)
        p = parameters
        self.design = design(p)
        self.components = tuple(Component(*c) for c in COORDINATES[p.plant])
        names = tuple(c.name for c in COORDINATES[p.plant])
        self.sensors: tuple[str, ...] = p.value("sensors")
        self.measured = tuple(names.index(sensor) for sensor in self.sensors)
        """Coordinate that each sensor reads."""
        self.output = names.index(OUTPUT[p.plant])
        """Coordinate that the command is for."""
        self._n, self._m = n, m = len(names), len(self.sensors)
        sigmas = numpy.array(p.value("sensor_sigmas"))
        output_sigma = self._sigma_of_output()
        self.cost_unit = output_sigma**2
        """What a cost of one is in units of the weighted squares, for comparison with theory."""

        truth, model = self.design.true_model, self.design.model
        scaled, other = (
            factor[:, numpy.any(factor != 0.0, axis=0)]
            for factor in map(linear_systems.noise_factor, (truth.scaled_noise, truth.other_noise))
        )
        self._split = scaled.shape[1]
        self._drive_count = scaled.shape[1] + other.shape[1]
        self._true_F, self._true_B = self.constant(truth.F), self.constant(truth.B)
        self._noise_factor = self.constant(numpy.hstack([scaled, other]))
        self._F, self._B = self.constant(model.F), self.constant(model.B)
        self._L = self.constant(self.design.feedback)
        self._propagator = self.constant(packed_covariance.propagator(model.F))
        pack = packed_covariance.pack
        self._scaled_noise = self.constant(pack(model.scaled_noise)[:, None])
        self._other_noise = self.constant(pack(model.other_noise)[:, None])
        self._process_noise = self._scaled_noise + self._other_noise
        self._sensor_sigmas = self.constant(sigmas[:, None])
        self.sensor_variances = tuple(float(s) for s in sigmas**2)
        """Nominal, of each sensor."""
        self._sensor_entries = [
            packed_covariance.position(n, i, j) for i in self.measured for j in self.measured
        ]
        self._R = self.constant(self.design.R[:, :, None])
        self._sensor_identity = self.constant(numpy.eye(m)[:, :, None])
        self._initial_sigmas = self.constant(numpy.array(p.value("initial_sigmas"))[:, None])
        self._initial_covariance = self.constant(
            pack(numpy.diag(numpy.square(p.value("initial_sigmas"))))[:, None]
        )
        self._diagonal = packed_covariance.diagonal(n)
        self._trace_weights = self.constant(1.0 / (n * numpy.diag(self.design.steady.posterior))[:, None])
        H = self.design.H
        unmeasured = numpy.where(H.any(axis=0), 0.0, numpy.diag(self.design.state_covariance))
        raw = H.T @ self.design.R @ H + numpy.diag(unmeasured)
        self._raw_covariance = self.constant(pack(raw)[:, None])
        self._state_weights = [float(w) for w in numpy.diag(self.design.weight)]
        self._changing = self.constant(
            [[float(p.changing_sensors is None or s in p.changing_sensors)] for s in self.sensors]
        )
        self._signal_unit = 1.0 / output_sigma

        self._manoeuvres = -(-p.horizon // p.command_period) if p.command_amplitude[1] else 0
        self._dropouts = -(-p.horizon // p.dropout_period) if p.dropout_period else 0
        self.noise = NoiseLayout(
            uniforms=3 * self._manoeuvres
            + len(p.disturbance_levels)
            + len(p.disturbance_times)
            + m * len(p.sensor_levels)
            + len(p.sensor_times)
            + 2 * self._dropouts * m,
            initial_normals=n,
            normals=self._drive_count + m,
        )
        self.action_space = (
            gymnasium.spaces.Box(-1.0, 1.0, (1,), numpy.float32)
            if control == "gain"
            else gymnasium.spaces.Discrete(len(MODES))
        )
        self.fields = self._fields()

    def _sigma_of_output(self) -> float:
        """Nominal sigma of the output's sensor; of its default where the output is not measured."""
        p = self.parameters
        output = OUTPUT[p.plant]
        if output in self.sensors:
            return float(p.value("sensor_sigmas")[self.sensors.index(output)])
        return float(p.defaults["sensor_sigmas"][p.defaults["sensors"].index(output)])

    def _fields(self) -> tuple[Field, ...]:
        units = dict(COORDINATES[self.parameters.plant])
        log = "sign(x) log(1 + |x|) of "
        found = []
        for s in self.sensors:
            found.append(Field(f"innovation_{s}", "1", log + "the innovation over its sigma; 0 in a dropout"))
        for s in self.sensors:
            found.append(Field(f"mean_innovation_{s}", "1", "short average of the innovation over its sigma"))
        for s in self.sensors:
            found.append(Field(f"log_mean_square_{s}", "1", "log of the short average of its square"))
        found.append(Field("log_nis", "1", "log of the normalised innovation squared per available reading"))
        found.append(Field("log_mean_nis", "1", "log of its short average"))
        found.append(Field("command", "1", log + "the command over the output sensor's sigma"))
        found.append(Field("control", "1", log + "the control in force over the output sensor's sigma"))
        for s in self.sensors:
            what = f"the last valid reading ({units[s]}) over its sigma"
            found.append(Field(f"reading_{s}", "1", log + what))
        found.append(
            Field("log_trace", "1", "log of the mean of the variances over those of the settled filter")
        )
        for s in self.sensors:
            found.append(Field(f"available_{s}", "1", "1 where the sensor answered, 0 in a dropout", "mean"))
        found.append(Field("time", "1", "measurements so far over the horizon"))
        if self.control == "gain":
            found.append(Field("action", "1", "last action"))
        else:
            found += [Field(f"action_{mode}", "1", "1 if this was the last action") for mode in MODES]
        return tuple(found)

    def begin(self, uniforms: Array, normals: Array) -> State:
        """Draw what the episode will be like, and the state at its start."""
        xp, p, m = self.xp, self.parameters, self._m
        N = uniforms.shape[-1]
        zeros = xp.zeros((m, N), dtype=xp.float64, device=self.device)
        zero = zeros[0]
        drawn = _Uniforms(uniforms)
        command_times, commands = self._commands(drawn, zero)
        levels = [self._level(drawn.take(1)[0], bounds) for bounds in p.disturbance_levels]
        disturbance_times = [self._time(drawn.take(1)[0], bounds) for bounds in p.disturbance_times]
        sensor_levels = [
            1.0 + self._changing * (self._level(drawn.take(m), bounds) - 1.0) for bounds in p.sensor_levels
        ]
        sensor_times = [self._time(drawn.take(1)[0], bounds) for bounds in p.sensor_times]
        starts, stops = [], []
        for i in range(self._dropouts):
            length = self._time(drawn.take(m), p.dropout_length)
            room = p.dropout_period
            start = i * room + 1.0 + xp.floor(drawn.take(m) * (room - length))
            starts.append(start)
            stops.append(start + length)
        truth = self._initial_sigmas * normals
        if p.plant == "U":
            truth = xp.concat([truth[:-1], truth[-1:] * levels[0]], axis=0)
        covariance = xp.broadcast_to(self._initial_covariance, (self._initial_covariance.shape[0], N))
        ones = zeros + 1.0
        estimate = xp.zeros_like(truth)
        return State(
            clock=zero,
            truth=truth,
            mean=estimate,
            filter_covariance=covariance,
            estimate=estimate,
            estimate_covariance=covariance,
            scale=ones[0],
            action=self._no_action(zero),
            measurement=zeros,
            available=ones,
            innovation=zeros,
            nis=ones[0],
            mean_innovation=zeros,
            mean_square=ones,
            mean_nis=ones[0],
            command=zero,
            control=zero,
            level=levels[0],
            sensor_level=sensor_levels[0],
            command_times=command_times,
            commands=commands,
            disturbance_times=self._stack(disturbance_times, zero),
            levels=self._stack(levels, zero),
            sensor_times=self._stack(sensor_times, zero),
            sensor_levels=self._stack(sensor_levels, zeros),
            dropout_starts=self._stack(starts, zeros),
            dropout_stops=self._stack(stops, zeros),
        )

    def _stack(self, items: list[Array], like: Array) -> Array:
        return self.xp.stack(items, axis=0) if items else like[None][:0]

    def _no_action(self, zero: Array) -> Array:
        if self.control == "gain":
            return zero[None]
        return self.xp.stack([zero + 1.0, zero, zero], axis=0)

    def _level(self, uniform: Array, bounds: tuple[float, float]) -> Array:
        """Log-uniform between bounds."""
        return bounds[0] * self.xp.exp(uniform * math.log(bounds[1] / bounds[0]))

    def _time(self, uniform: Array, bounds: tuple[int, int]) -> Array:
        """Whole number from the first to the last of bounds."""
        return bounds[0] + self.xp.floor(uniform * (bounds[1] - bounds[0] + 1))

    def _commands(self, drawn: "_Uniforms", zero: Array) -> tuple[Array, Array]:
        """Piecewise constant command: times at which it changes and what it changes to.

        In each period of random manoeuvres, at a random time, either a step to a new level or a doublet
        about the present one, as likely.
        """
        xp, p = self.xp, self.parameters
        if p.step_size:
            return (zero + p.step_time)[None], (zero + p.step_size)[None]
        low, high = p.command_amplitude
        times, commands, present = [], [], zero
        for i in range(self._manoeuvres):
            kind, when, size = drawn.take(3)
            signed = 2.0 * size - 1.0
            amplitude = xp.where(signed < 0.0, -1.0, 1.0) * (low + (high - low) * xp.abs(signed))
            doublet = kind < 0.5
            start = i * p.command_period + 1.0 + xp.floor(when * (p.command_period - 2 * p.doublet_width))
            times += [start, start + p.doublet_width, start + 2.0 * p.doublet_width]
            after = xp.where(doublet, present, amplitude)
            commands += [
                xp.where(doublet, present + amplitude, amplitude),
                xp.where(doublet, present - amplitude, amplitude),
                after,
            ]
            present = after
        return self._stack(times, zero), self._stack(commands, zero)

    def _in_force(self, clock: Array, first: Array, times: Array, values: Array) -> Array:
        """Value of a piecewise constant signal: ``first``, then ``values[i]`` from ``times[i]`` on."""
        for i in range(times.shape[0]):
            first = self.xp.where(clock >= times[i], values[i], first)
        return first

    def autopilot(self, state: State) -> Array:
        """Control that follows from estimate and command, ``u = N r - L x(k|k)``, ``(N,)``."""
        feedback = self.xp.matmul(self._L, state.estimate)[0]
        return self.design.feedforward * state.command - feedback

    def measure(self, state: State, noise: Array) -> State:
        """The control acts for one interval; the filter predicts; the sensors that work answer."""
        xp = self.xp
        clock = state.clock + 1.0
        control = self.autopilot(state)
        level = self._in_force(clock, state.levels[0], state.disturbance_times, state.levels[1:])
        sensor_level = self._in_force(
            clock, state.sensor_levels[0], state.sensor_times, state.sensor_levels[1:]
        )
        drive, readout = noise[: self._drive_count], noise[self._drive_count :]
        drive = xp.concat([drive[: self._split] * level, drive[self._split :]], axis=0)
        disturbance = xp.matmul(self._noise_factor, drive)
        truth = xp.matmul(self._true_F, state.truth) + self._true_B * control + disturbance
        truth = xp.clip(truth, -FARTHEST, FARTHEST)
        reading = self._readings_of(truth) + self._sensor_sigmas * sensor_level * readout
        available = xp.ones_like(reading)
        for i in range(state.dropout_starts.shape[0]):
            out = (clock >= state.dropout_starts[i]) & (clock < state.dropout_stops[i])
            available = xp.where(out, 0.0, available)
        mean = xp.matmul(self._F, state.mean) + self._B * control
        covariance = xp.matmul(self._propagator, state.filter_covariance)

        residual = available * (reading - self._readings_of(mean))
        predicted = covariance[self._sensor_entries] + state.scale * self._process_noise[self._sensor_entries]
        S = xp.reshape(predicted, (self._m, self._m, -1)) + self._R
        # A sensor without a reading counts as one with unit variance that agrees with the prediction.
        S = S * (available[:, None] * available[None]) + self._sensor_identity * (1.0 - available[None])
        _, squared_distance = gaussian.log_density(residual, S)
        innovation = residual / xp.sqrt(xp.stack([S[i, i] for i in range(self._m)], axis=0))
        count = available[0]
        for i in range(1, self._m):
            count = count + available[i]
        nis = xp.where(count > 0.0, squared_distance / xp.clip(count, 1.0, None), state.mean_nis)
        forget = 1.0 / self.parameters.average_window
        return state._replace(
            clock=clock,
            truth=truth,
            mean=mean,
            filter_covariance=covariance,
            measurement=xp.where(available > 0.0, reading, state.measurement),
            available=available,
            innovation=innovation,
            nis=nis,
            mean_innovation=state.mean_innovation + forget * available * (innovation - state.mean_innovation),
            mean_square=state.mean_square + forget * available * (innovation**2 - state.mean_square),
            mean_nis=state.mean_nis + forget * (nis - state.mean_nis),
            command=self._in_force(clock, xp.zeros_like(control), state.command_times, state.commands),
            control=control,
            level=level,
            sensor_level=sensor_level,
        )

    def _readings_of(self, x: Array) -> Array:
        """Measured coordinates of ``(n, N)``, ``(m, N)``."""
        return self.xp.stack([x[i] for i in self.measured], axis=0)

    def observe(self, state: State) -> Array:
        """What the filter and the autopilot know, scaled."""
        xp = self.xp
        log_trace = self._log_trace(state)
        return xp.concat(
            [
                signed_logarithm(state.innovation, xp),
                state.mean_innovation,
                xp.log(xp.clip(state.mean_square, 1e-6, None)),
                xp.log(xp.clip(state.nis, 1e-6, None))[None],
                xp.log(xp.clip(state.mean_nis, 1e-6, None))[None],
                signed_logarithm(self._signal_unit * state.command, xp)[None],
                signed_logarithm(self._signal_unit * state.control, xp)[None],
                signed_logarithm(state.measurement / self._sensor_sigmas, xp),
                log_trace[None],
                state.available,
                state.clock[None] / self.horizon,
                state.action,
            ],
            axis=0,
        )

    def _log_trace(self, state: State) -> Array:
        """Log of the predicted covariance's trace, with the process noise of the last action."""
        diagonal = state.filter_covariance[self._diagonal] + state.scale * self._process_noise[self._diagonal]
        weighted = self._trace_weights * diagonal
        total = weighted[0]
        for i in range(1, self._n):
            total = total + weighted[i]
        return self.xp.log(total)

    def act(self, state: State, action: Array) -> State:
        """Update the filter by this measurement, with the process noise that the action asks for."""
        xp = self.xp
        if self.control == "gain":
            shown = xp.clip(xp.astype(action, xp.float64), -1.0, 1.0)
            scale = xp.exp(shown[0] * (self.parameters.gain_decades * math.log(10.0)))
        else:
            shown = xp.stack([xp.astype(action == i, xp.float64) for i in range(len(MODES))], axis=0)
            scale = 1.0 + (self.parameters.wide_band_scale - 1.0) * shown[1]
        update = packed_covariance.update_coordinates(
            state.mean,
            state.filter_covariance + scale * self._process_noise,
            state.measurement,
            self.measured,
            self.sensor_variances,
            state.available,
        )
        estimate, covariance = update.mean, update.covariance
        if self.control == "mode":
            raw = shown[2] > 0.0
            estimate = xp.where(raw, self._raw_estimate(state.measurement), estimate)
            covariance = xp.where(raw, self._raw_covariance, covariance)
        return state._replace(
            mean=update.mean,
            filter_covariance=update.covariance,
            estimate=estimate,
            estimate_covariance=covariance,
            scale=scale,
            action=shown,
        )

    def _raw_estimate(self, measurement: Array) -> Array:
        """Readings in place of the measured coordinates, zero for the others."""
        zero = self.xp.zeros_like(measurement[0])
        rows = [measurement[self.measured.index(i)] if i in self.measured else zero for i in range(self._n)]
        return self.xp.stack(rows, axis=0)

    def cost(self, state: State) -> Array:
        """Weighted squares of deviation from the command's equilibrium and of the control, ``(N,)``."""
        u = self.autopilot(state)
        total = self.design.control_weight * u * u
        for i, weight in enumerate(self._state_weights):
            if weight:
                deviation = state.truth[i] - state.command if i == self.output else state.truth[i]
                total = total + weight * deviation * deviation
        return total * (1.0 / self.cost_unit)

    def error(self, state: State) -> Array:
        """Estimate minus truth, ``(n, N)``."""
        return state.estimate - state.truth

    def covariance(self, state: State) -> Array:
        """Covariance reported for the estimate, ``(n, n, N)``.

        Of raw readings it is that of their nominal noise; a coordinate without a sensor, taken as zero, has
        the stationary variance of the nominal loop.
        """
        return packed_covariance.unpack(state.estimate_covariance, self._n)

    def process_noise(self, level: Array) -> Array:
        """Covariance of the process noise at a level of the disturbance, packed, ``(n (n + 1) / 2, N)``."""
        return level * level * self._scaled_noise + self._other_noise

    def records(self, state: State) -> dict[str, Array]:
        """Signals of the loop: output, command, control signal that follows, NIS per available reading, and the
        innovation over its sigma of the output's sensor (of the first where the output is not measured).
        """
        shown = self.measured.index(self.output) if self.output in self.measured else 0
        return {
            "output": state.truth[self.output],
            "command": state.command,
            "control_signal": self.autopilot(state),
            "nis": state.nis,
            "innovation": state.innovation[shown],
        }


class _Uniforms:
    """Rows of uniform numbers, handed out in order."""

    def __init__(self, rows: Array) -> None:
        self._rows = rows
        self._used = 0

    def take(self, count: int) -> Array:
        """Return the next ``count`` rows."""
        self._used += count
        return self._rows[self._used - count : self._used]


TASK = UavAutopilot
