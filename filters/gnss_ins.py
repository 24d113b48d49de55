r"""GNSS and inertial observations of a user with a receiver clock and INS attitude errors: motion and Jacobians.

State (ENU frame fixed to the Earth at the site), Moroz's lambda:

    [X (3), D', V (3), V', A (3), eps (3), V_eps (3)]

position m, clock bias m, velocity m/s, clock drift m/s, acceleration m/s^2, errors of the angles (heading,
pitch, roll) rad, their rates rad/s. One step of length T:

    user      a linear model of each axis on (x, v, a), one for each hypothesis on the motion
    clock     D' += T V' + w,  V' += w,   white frequency and random-walk frequency noise
    attitude  eps += T V_eps + w,  V_eps = exp(-T / tau) V_eps + w

Observations, S satellites at s_j with velocities w_j, ``u_j = (s_j - X) / |s_j - X|``:

    pseudorange        rho_j  = |s_j - X| + D'
    pseudorange rate   rho'_j = u_j^T (w_j - V) + V'
    accelerometers     f      = C(phi_INS - eps) (A + [0, 0, g]^T)          (body axes forward, right, down)
    attitude           y_eps  = eps

with C = R_1(roll) R_2(pitch) R_3(heading) N, N: ENU -> NED, and phi_INS, the angles that the INS outputs
(true angle plus error), a known input. Jacobians:

    drho/dX = -u^T,  drho'/dV = -u^T,  drho'/dX = -(w - V - u u^T (w - V))^T / |s - X|,
    df/dA = C,       df/deps = -[dC/dheading, dC/dpitch, dC/droll] (A + g)

Reading: the paper names these observations and gives no formulas. Angles alone do not show their own error,
so phi_INS enters through C, and y_eps is the difference between the INS and an independent attitude
reference: without it the heading error would not be observable at rest.

Reading: the motion models of the hypotheses are not given. Rest: X stays, V and A are reset to zero.
Constant velocity: ``X += T V``, A reset to zero, a velocity increment with input [T/2, 1]^T. Manoeuvre:
Singer's model (1970), ``a' = -alpha a + white noise``.

Shapes: states ``(17, ...)``, covariances ``(17, 17, ...)``; the trailing axes are the batch, or hypotheses
and batch.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy

from . import singer
from .array_namespace import Array, namespace, zeros_for
from .extended_kalman import JacobianRow

POSITION = slice(0, 3)
CLOCK_BIAS = 3
VELOCITY = slice(4, 7)
CLOCK_DRIFT = 7
ACCELERATION = slice(8, 11)
ATTITUDE_ERROR = slice(11, 14)
ATTITUDE_RATE = slice(14, 17)
SIZE = 17
"""Number of states."""


class AxisModel(NamedTuple):
    """Linear motion model of one axis of the user, on (x, v, a), over one step."""

    transition: Array
    """Transition matrix, ``(3, 3)``, upper triangular with one in the first place."""
    noise: Array
    """Covariance of the process noise, ``(3, 3)``."""


def rest_model(T: float, velocity_sigma: float, acceleration_sigma: float) -> AxisModel:
    """Return the axis model of a user at rest: position constant, velocity and acceleration zero (hypothesis
    1).

    Args:
        T: step, s.
        velocity_sigma: standard deviation of the regularising noise, m/s; that of the position is T times as large.
        acceleration_sigma: standard deviation of the regularising noise, m/s^2.
    """
    sigmas = numpy.array([velocity_sigma * T, velocity_sigma, acceleration_sigma])
    return AxisModel(numpy.diag([1.0, 0.0, 0.0]), numpy.diag(sigmas**2))


def constant_velocity_model(T: float, increment_sigma: float, acceleration_sigma: float) -> AxisModel:
    """Return the axis model of constant velocity with random increments and no acceleration (hypothesis 2).

    Args:
        T: step, s.
        increment_sigma: standard deviation of the velocity increment of one step, m/s; its input is ``[T/2, 1]^T``.
        acceleration_sigma: standard deviation of the regularising noise, m/s^2.
    """
    transition = numpy.array([[1.0, T, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    entry = increment_sigma * numpy.array([T / 2.0, 1.0, 0.0])
    return AxisModel(transition, numpy.outer(entry, entry) + numpy.diag([0.0, 0.0, acceleration_sigma**2]))


def singer_model(T: float, alpha: float, sigma: float) -> AxisModel:
    """Return the axis model of Singer's manoeuvre (hypothesis 3); arguments as in :mod:`.singer`."""
    return AxisModel(singer.transition(alpha, T), singer.process_noise(alpha, sigma, T))


class CommonModel(NamedTuple):
    """Model of clock and attitude errors over one step, the same under every hypothesis."""

    T: float
    """Step, s."""
    decay: float
    """Factor of the attitude rates over one step."""
    clock_noise: Array
    """Covariance of the noise of (D', V'), ``(2, 2)``: m^2, m^2/s, m^2/s^2."""
    attitude_variance: float
    """Variance of the random walk of each angle in one step, rad^2."""
    attitude_rate_variance: float
    """Variance of the driving noise of each rate in one step, (rad/s)^2."""


def common_model(
    T: float,
    frequency_density: float,
    frequency_walk_density: float,
    angle_walk: float,
    rate_sigma: float,
    rate_time: float,
) -> CommonModel:
    """Return the discrete model of clock and attitude errors over one step.

    The clock is the usual two-state model (Brown and Hwang, Introduction to Random Signals and Applied Kalman
    Filtering, 2012, section 9.3): ``q_DD = S_f T + S_g T^3 / 3``, ``q_DV = S_g T^2 / 2``, ``q_VV = S_g T``.

    Args:
        T: step, s.
        frequency_density: S_f, white frequency noise, m^2/s.
        frequency_walk_density: S_g, random-walk frequency noise, m^2/s^3.
        angle_walk: random walk of each angle, rad/sqrt(s).
        rate_sigma: stationary standard deviation of each rate, rad/s.
        rate_time: correlation time of the rates, s.
    """
    cross = frequency_walk_density * T**2 / 2.0
    clock = numpy.array(
        [
            [frequency_density * T + frequency_walk_density * T**3 / 3.0, cross],
            [cross, frequency_walk_density * T],
        ]
    )
    return CommonModel(
        T,
        numpy.exp(-T / rate_time).item(),
        clock,
        angle_walk**2 * T,
        (-(rate_sigma**2) * numpy.expm1(-2.0 * T / rate_time)).item(),
    )


def process_noise(axis: AxisModel, common: CommonModel) -> Array:
    """Assemble the covariance of the process noise of one motion hypothesis, ``(17, 17)``."""
    Q = zeros_for((SIZE, SIZE), axis.noise, *common)
    x, v, a = (list(range(SIZE))[part] for part in (POSITION, VELOCITY, ACCELERATION))
    for i in range(3):
        places = [x[i], v[i], a[i]]
        Q[numpy.ix_(places, places)] = axis.noise
    clock = [CLOCK_BIAS, CLOCK_DRIFT]
    Q[numpy.ix_(clock, clock)] = common.clock_noise
    numpy.fill_diagonal(Q[ATTITUDE_ERROR, ATTITUDE_ERROR], common.attitude_variance)
    numpy.fill_diagonal(Q[ATTITUDE_RATE, ATTITUDE_RATE], common.attitude_rate_variance)
    return Q


def advance(state: Array, axis: Array, T: float, decay: float) -> Array:
    """Multiply a vector or matrix by the transition matrix, ``F x`` or ``F P``, without the products with
    zeros.

    Args:
        state: x or P, ``(17, ...)``.
        axis: transition matrix of (x, v, a), ``(3, 3, ...)`` with trailing axes that broadcast, such as
            ``(3, 3, M, 1)`` for M hypotheses; upper triangular with one in the first place.
        T: step, s.
        decay: factor of the attitude rates.
    """
    velocity, acceleration = state[VELOCITY], state[ACCELERATION]
    return namespace(state).concat(
        [
            state[POSITION] + axis[0, 1] * velocity + axis[0, 2] * acceleration,
            state[CLOCK_BIAS : CLOCK_BIAS + 1] + T * state[CLOCK_DRIFT : CLOCK_DRIFT + 1],
            axis[1, 1] * velocity + axis[1, 2] * acceleration,
            state[CLOCK_DRIFT : CLOCK_DRIFT + 1],
            axis[2, 2] * acceleration,
            state[ATTITUDE_ERROR] + T * state[ATTITUDE_RATE],
            decay * state[ATTITUDE_RATE],
        ],
        axis=0,
    )


def predict(
    mean: Array, covariance: Array, axis: Array, T: float, decay: float, Q: Array
) -> tuple[Array, Array]:
    """Return the predicted means ``F x`` and covariances ``F P F^T + Q`` of M hypotheses (step 4).

    Args:
        mean: means, ``(17, M, N)``.
        covariance: covariances, ``(17, 17, M, N)``.
        axis: transition matrices of (x, v, a), ``(3, 3, M, 1)``, see :func:`advance`.
        T: step, s.
        decay: factor of the attitude rates.
        Q: covariance of the process noise, ``(17, 17, M, 1)``.
    """
    xp = namespace(mean)
    moved = advance(covariance, axis, T, decay)
    both = advance(xp.moveaxis(moved, 0, 1), axis, T, decay)
    return advance(mean, axis, T, decay), both + Q


class Geometry(NamedTuple):
    """Distances, directions and velocities of S satellites relative to a user."""

    distance: Array
    """Distance ``|s - X|``, ``(S, ...)``, m."""
    unit: Array
    """Unit vector from the user to the satellite, ``(3, S, ...)``."""
    relative_velocity: Array
    """Relative velocity w - V, ``(3, S, ...)``, m/s."""
    range_rate: Array
    """Range rate u^T (w - V), ``(S, ...)``, m/s."""


def geometry(state: Array, satellite_position: Array, satellite_velocity: Array) -> Geometry:
    """Return distances, directions and range rates of S satellites relative to a user.

    Args:
        state: state of the user, ``(17, ...)``.
        satellite_position: positions, ``(3, S, ...)``, m; trailing axes broadcast against those of ``state``.
        satellite_velocity: velocities, ``(3, S, ...)``, m/s.
    """
    d = satellite_position - state[POSITION][:, None]
    distance = namespace(state).sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    unit = d / distance
    w = satellite_velocity - state[VELOCITY][:, None]
    return Geometry(distance, unit, w, unit[0] * w[0] + unit[1] * w[1] + unit[2] * w[2])


def ranges(state: Array, satellites: Geometry) -> tuple[Array, Array]:
    """Return the predicted pseudoranges, m, and pseudorange rates, m/s, of S satellites, ``(S, ...)`` each."""
    return satellites.distance + state[CLOCK_BIAS], satellites.range_rate + state[CLOCK_DRIFT]


def range_jacobian(satellites: Geometry) -> list[JacobianRow]:
    """Return the Jacobian rows of S pseudoranges, then of S pseudorange rates."""
    x, v = range(0, 3), range(4, 7)
    across = (satellites.relative_velocity - satellites.unit * satellites.range_rate) / satellites.distance
    count = satellites.distance.shape[0]
    ranges_rows = [
        JacobianRow((*x, CLOCK_BIAS), (*(-satellites.unit[i, j] for i in range(3)), 1.0))
        for j in range(count)
    ]
    rate_rows = [
        JacobianRow(
            (*x, *v, CLOCK_DRIFT),
            (*(-across[i, j] for i in range(3)), *(-satellites.unit[i, j] for i in range(3)), 1.0),
        )
        for j in range(count)
    ]
    return ranges_rows + rate_rows


def body_axes(angles: Array) -> tuple[tuple[Array, Array, Array], ...]:
    """Return the rotation from east-north-up to body axes (forward, right, down), as three rows of three arrays.

    Args:
        angles: heading, pitch, roll, ``(3, ...)``, rad.
    """
    xp = namespace(angles)
    sine, cosine = xp.sin(angles), xp.cos(angles)
    sh, sp, sr = sine[0], sine[1], sine[2]
    ch, cp, cr = cosine[0], cosine[1], cosine[2]
    return (
        (cp * sh, cp * ch, sp),
        (sr * sp * sh + cr * ch, sr * sp * ch - cr * sh, -sr * cp),
        (cr * sp * sh - sr * ch, cr * sp * ch + sr * sh, -cr * cp),
    )


def specific_force(state: Array, ins_angles: Array, gravity: float) -> tuple[Array, list[JacobianRow]]:
    """Return the predicted accelerometer readings, ``(3, ...)``, m/s^2, and their Jacobian rows.

    Derivatives by angles are combinations of the readings, for example ``df/droll = [0, f_down, -f_right]``.

    Args:
        state: state of the user, ``(17, ...)``.
        ins_angles: heading, pitch and roll that the INS outputs, ``(3, ...)``, rad; trailing axes broadcast.
        gravity: acceleration of gravity, m/s^2.
    """
    xp = namespace(state)
    angles = ins_angles - state[ATTITUDE_ERROR]
    C = body_axes(angles)
    a = state[ACCELERATION]
    up = a[2] + gravity
    f = [row[0] * a[0] + row[1] * a[1] + row[2] * up for row in C]
    sr, cr = xp.sin(angles[2]), xp.cos(angles[2])
    # dC/dheading takes (east, north, up) to C (-north, east, 0).
    by_heading = [row[1] * a[0] - row[0] * a[1] for row in C]
    by_pitch = [-(sr * f[1] + cr * f[2]), sr * f[0], cr * f[0]]
    by_roll: list[Array | float] = [0.0, f[2], -f[1]]
    columns = (*range(8, 11), *range(11, 14))
    rows = [JacobianRow(columns, (*C[i], -by_heading[i], -by_pitch[i], -by_roll[i])) for i in range(3)]
    return xp.stack(f), rows


def attitude_jacobian() -> list[JacobianRow]:
    """Return the Jacobian rows of the three attitude errors, each of which is observed directly."""
    return [JacobianRow((column,), (1.0,)) for column in range(11, 14)]


def observe(
    state: Array, satellite_position: Array, satellite_velocity: Array, ins_angles: Array, gravity: float
) -> tuple[Array, list[JacobianRow]]:
    """Return the predicted observations ``(2 S + 6, ...)`` of a state, and their Jacobian rows.

    In this order: S pseudoranges, S pseudorange rates, three accelerometers, three attitude errors.

    Args:
        state: state of the user, ``(17, ...)``.
        satellite_position: positions, ``(3, S, ...)``, m; trailing axes broadcast against those of ``state``.
        satellite_velocity: velocities, ``(3, S, ...)``, m/s.
        ins_angles: heading, pitch and roll that the INS outputs, ``(3, ...)``, rad.
        gravity: acceleration of gravity, m/s^2.
    """
    seen = geometry(state, satellite_position, satellite_velocity)
    pseudoranges, rates = ranges(state, seen)
    force, force_rows = specific_force(state, ins_angles, gravity)
    observation = namespace(state).concat([pseudoranges, rates, force, state[ATTITUDE_ERROR]], axis=0)
    return observation, [*range_jacobian(seen), *force_rows, *attitude_jacobian()]


def sensor_groups(satellites: int) -> Sequence[slice]:
    """Return the slices of the sensors' kinds in the result of :func:`observe`."""
    return (
        slice(0, satellites),
        slice(satellites, 2 * satellites),
        slice(2 * satellites, 2 * satellites + 3),
        slice(2 * satellites + 3, 2 * satellites + 6),
    )
