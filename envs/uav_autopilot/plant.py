"""Plants of UavAutopilot and the design of the control loop: autopilot, nominal filter, theoretical cost."""

import functools
from typing import NamedTuple

import numpy

from ...filters import linear_systems
from ...filters.gusts import vertical_gust
from .parameters import COORDINATES, OUTPUT, UavAutopilotParameters


class Plant(NamedTuple):
    """Discrete plant of the control loop with its noise in two parts, as NumPy arrays."""

    F: numpy.ndarray
    """Transition matrix (7), ``(n, n)``."""
    B: numpy.ndarray
    """Input matrix, ``(n, 1)``."""
    scaled_noise: numpy.ndarray
    """Covariance of the part of the process noise that the disturbance's level multiplies, ``(n, n)``."""
    other_noise: numpy.ndarray
    """Covariance of the rest, ``(n, n)``."""


def constant_rate(parameters: UavAutopilotParameters) -> Plant:
    """Return the :class:`Plant` P, a double integrator: ``F = [[1, T], [0, 1]]`` (paper).

    Reading: the scan has "1 0,25 / F = 0 =1"; the "=" is a stray sign. ``B = [T^2/2, T]`` and noise that
    enters with the control are ours.
    """
    T = parameters.value("sampling_interval")
    B = numpy.array([[T**2 / 2], [T]])
    Q = parameters.acceleration_sigma**2 * B @ B.T
    return Plant(numpy.array([[1.0, T], [0.0, 1.0]]), B, Q, numpy.zeros((2, 2)))


def pitch_channel(parameters: UavAutopilotParameters, actuator_lag: float = 1.0) -> Plant:
    """Return the :class:`Plant` U: short period, pitch, actuator and gust of a small aircraft, degrees and deg/s.

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
    return Plant(F, B, scaled, other)


class Design(NamedTuple):
    """Design of the control loop: model and true plant, autopilot, filter, theoretical covariances and cost."""

    model: Plant
    """Plant of the filter and the autopilot."""
    true_model: Plant
    H: numpy.ndarray
    """Measurement matrix, ``(m, n)``."""
    R: numpy.ndarray
    """Nominal covariance of the sensors, ``(m, m)``."""
    feedback: numpy.ndarray
    """Feedback gain L, ``(1, n)``."""
    feedforward: float
    """Feedforward gain N."""
    weight: numpy.ndarray
    """Weight of the state in the cost, ``(n, n)``."""
    control_weight: float
    steady: linear_systems.SteadyFilter
    """Steady state of the nominal filter."""
    loop: linear_systems.ClosedLoop
    """Nominal loop without command."""
    optimal: linear_systems.Regulator | None
    """Optimal control of the true plant with known state; None if the weights determine none."""

    @property
    def state_covariance(self) -> numpy.ndarray:
        """Covariance of the state in the nominal loop without command, ``(n, n)``; requires SciPy."""
        n = len(self.weight)
        return linear_systems.stationary_covariance(*self.loop)[:n, :n]


MOST_RATIO = 1e15
"""Largest ratio of the predicted variance of a reading to that of its sensor: an updated covariance contains both, and
a number has sixteen digits. Of 183 draws of noises and scales, all indefinite ones were above 1e17."""

MOST_CONDITION = 1e14
"""Largest condition number of the correlations of a prediction: beyond it their determinant is rounding."""


def _check_digits(parameters: UavAutopilotParameters, ratios: numpy.ndarray) -> None:
    p = parameters
    scale = max(p.wide_band_scale, 10.0**p.gain_decades, 10.0 ** (p.process_decades + 2.0 * p.sensor_decades))
    worst = int(numpy.argmax(ratios))
    if scale * ratios[worst] > MOST_RATIO:
        raise ValueError(
            f"sensor_sigmas must be larger: with the process noise at the largest scale that an action can give, "
            f"{scale:.3g}, the {p.value('sensors')[worst]} is predicted with {scale * ratios[worst]:.1e} times the "
            f"variance of its sensor, more than the {MOST_RATIO:g} that the digits of a number allow"
        )


@functools.lru_cache(8)  # an evaluation makes the same task for every competitor, on numbers and on symbols
def design(parameters: UavAutopilotParameters) -> Design:
    """Return the :class:`Design` of the control loop for these parameters, from a cache.

    Raises:
        ValueError: if the plant diverges at once, L does not stabilise it, or the sensors do not determine the state.
    """
    if parameters.plant == "P":
        model = true_model = constant_rate(parameters)
    else:
        with numpy.errstate(over="ignore", invalid="ignore"):  # the error below names the cause
            model, true_model = pitch_channel(parameters), pitch_channel(parameters, parameters.actuator_lag)
    if not all(numpy.isfinite(part).all() for part in (*model, *true_model)):
        raise ValueError(
            f"the plant must move finitely in one sampling_interval, {parameters.value('sampling_interval')} s: "
            "its coefficients make it diverge beyond the range of numbers"
        )
    names = [c.name for c in COORDINATES[parameters.plant]]
    H = numpy.eye(len(names))[[names.index(sensor) for sensor in parameters.value("sensors")]]
    R = numpy.diag(numpy.square(parameters.value("sensor_sigmas")))
    weight = numpy.diag(parameters.value("state_weights"))
    control_weight = parameters.value("control_weight")
    if parameters.feedback is None:
        L = linear_systems.discrete_regulator(
            model.F, model.B, weight, numpy.array([[control_weight]])
        ).feedback
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
    _check_digits(parameters, numpy.diag(H @ steady.predicted @ H.T) / numpy.diag(R))
    first = model.F * numpy.square(parameters.value("initial_sigmas")) @ model.F.T + Q
    sigmas = numpy.sqrt(numpy.diag(first))
    condition = numpy.linalg.cond(first / sigmas[:, None] / sigmas)
    if not condition < MOST_CONDITION:
        raise ValueError(
            "the first prediction must leave every coordinate an uncertainty of its own: the condition number of its "
            f"correlations is {condition:.1e}, and must be below {MOST_CONDITION:g}: raise gust_sigma, "
            "moment_disturbance or actuator_disturbance, or let the plant decay more slowly"
        )
    loop = linear_systems.estimate_feedback_loop(model.F, model.B, H, L, steady.gain, Q, R)
    linear_systems.check_stable(loop.transition)
    output = numpy.eye(len(names))[names.index(OUTPUT[parameters.plant])]
    N = linear_systems.feedforward_gain(model.F, model.B, output, L)
    try:
        optimal = linear_systems.discrete_regulator(
            true_model.F, true_model.B, weight, numpy.array([[control_weight]])
        )
    except (
        ValueError
    ):  # the weights ignore states that do not decay, which a user's feedback may still stabilise
        optimal = None
    return Design(model, true_model, H, R, L, N, weight, control_weight, steady, loop, optimal)
