"""Filters of Madgwick and of Mahony: one step each, batch on the last axis.

``q`` is the quaternion from the sensor's frame to the world's (north, west, up), ``w`` the angular rate, ``a`` and
``m`` specific force and field over their lengths, ``T`` the sampling interval.

**Madgwick** [1] moves the quaternion by the gyroscope and against the normalised gradient of what the two vectors miss:

    h = q m q*,  b = (sqrt(h1^2 + h2^2), 0, h3)                                        (45), (46)
    f = (q* up q - a, s q* b q - m),  g = J^T f                                        (25), (26), (29) to (31), (34)
    q <- q + T (q w / 2 - beta g / |g|), normalised                                    (11), (13), (42), (43)

Equation numbers are those of the report [1], where ``s`` is one. In its author's sample code (MadgwickAHRS, 2011), with
which the published results of BROAD were made, the reference field is half as long, ``s = 1 / 2``: the vectors never
agree then, the rest of ``f`` points along ``q`` and shortens the normalised step, and the magnetometer counts half.

**Mahony** [2] turns by the gyroscope plus what the vectors miss, and integrates that into an estimate of the bias:

    e = k_a a x (q* up q) + k_m m x (q* b q)                                           (1)
    bias <- bias - k_I T (a x (q* up q) + m x (q* b q))
    q <- q exp(T (w - bias + e))                                                       (2)

the explicit complementary filter of [2] in discrete time, with the weights of the two vectors as gains. Reading: the
reference field ``b`` is that of (46), as in the sample code that was published with [1].

[1] S. O. H. Madgwick, An efficient orientation filter for inertial and inertial/magnetic sensor arrays, report,
    University of Bristol, 2010; S. O. H. Madgwick, A. J. L. Harrison, R. Vaidyanathan, IEEE ICORR, 2011.
[2] R. Mahony, T. Hamel, J.-M. Pflimlin, Nonlinear complementary filters on the special orthogonal group, IEEE
    Transactions on Automatic Control 53 (2008), 1203-1218.
"""

from typing import Any

from filtergym.filters.array_namespace import Array, namespace

from .quaternions import (
    cross,
    direction_cosines,
    exponential,
    length,
    multiply,
    normalise,
    to_sensor,
    to_world,
)

MADGWICK_BETA = 0.1
"""1/s: default of the author's sample code."""
MAHONY_GAIN = 0.5
"""1/s: proportional gain by default in the same sample code, whose integral gain is zero."""


def reference_field(cosines: Array, magnetometer: Array) -> Array:
    """Field in the world's frame, its horizontal part turned to the north, ``(3, N)``; equations (45), (46) of [1].

    Args:
        cosines: direction cosines of the estimate, ``(9, N)``.
        magnetometer: field in the sensor's frame, ``(3, N)``.
    """
    h = to_world(cosines, magnetometer)
    return namespace(h).stack([length(h[:2]), 0.0 * h[0], h[2]])


def madgwick_step(
    q: Array,
    rate: Array,
    accelerometer: Array,
    magnetometer: Array,
    beta: Any,
    interval: float,
    field_scale: float = 1.0,
) -> Array:
    """Quaternion after one step of Madgwick's filter, ``(4, N)``.

    Args:
        q: before, ``(4, N)``.
        rate: of the gyroscope, rad/s, ``(3, N)``.
        accelerometer: specific force, ``(3, N)``, any unit.
        magnetometer: likewise.
        beta: speed of the quaternion against the gradient, 1/s, ``(N,)`` or a number.
        interval: T, s.
        field_scale: ``s``.
    """
    xp = namespace(q)
    a, m = normalise(accelerometer), normalise(magnetometer)
    w, x, y, z = q[0], q[1], q[2], q[3]
    b = reference_field(direction_cosines(q), m)
    f1 = 2.0 * (x * z - w * y) - a[0]
    f2 = 2.0 * (w * x + y * z) - a[1]
    f3 = 1.0 - 2.0 * (x * x + y * y) - a[2]
    # (25), (26): the gradient of what the accelerometer misses.
    gravity = xp.stack(
        [
            -2.0 * y * f1 + 2.0 * x * f2,
            2.0 * z * f1 + 2.0 * w * f2 - 4.0 * x * f3,
            -2.0 * w * f1 + 2.0 * z * f2 - 4.0 * y * f3,
            2.0 * x * f1 + 2.0 * y * f2,
        ]
    )
    bx, bz = 2.0 * field_scale * b[0], 2.0 * field_scale * b[2]
    f4 = bx * (0.5 - y * y - z * z) + bz * (x * z - w * y) - m[0]
    f5 = bx * (x * y - w * z) + bz * (w * x + y * z) - m[1]
    f6 = bx * (w * y + x * z) + bz * (0.5 - x * x - y * y) - m[2]
    # (29), (30): of the magnetometer.
    field = xp.stack(
        [
            -bz * y * f4 + (bz * x - bx * z) * f5 + bx * y * f6,
            bz * z * f4 + (bx * y + bz * w) * f5 + (bx * z - 2.0 * bz * x) * f6,
            (-2.0 * bx * y - bz * w) * f4 + (bx * x + bz * z) * f5 + (bx * w - 2.0 * bz * y) * f6,
            (bz * x - 2.0 * bx * z) * f4 + (bz * y - bx * w) * f5 + bx * x * f6,
        ]
    )
    gradient = normalise(gravity + field)
    turning = 0.5 * multiply(q, xp.concat([0.0 * rate[:1], rate]))
    return normalise(q + interval * (turning - beta * gradient))


def mahony_step(
    q: Array,
    bias: Array,
    rate: Array,
    accelerometer: Array,
    magnetometer: Array,
    gains: Any,
    interval: float,
) -> tuple[Array, Array]:
    """Quaternion and bias of the gyroscope after one step of Mahony's filter; equations (1), (2).

    Args:
        q: before, ``(4, N)``.
        bias: as estimated before, rad/s, ``(3, N)``.
        rate: of the gyroscope, rad/s, ``(3, N)``.
        accelerometer: specific force, ``(3, N)``, any unit.
        magnetometer: likewise.
        gains: ``k_a`` and ``k_m``, 1/s, and ``k_I``, 1/s^2; numbers or ``(N,)`` each.
        interval: T, s.
    """
    a, m = normalise(accelerometer), normalise(magnetometer)
    cosines = direction_cosines(q)
    from_gravity = cross(a, cosines[6:])
    from_field = cross(m, to_sensor(cosines, reference_field(cosines, m)))
    bias = bias - gains[2] * interval * (from_gravity + from_field)
    turning = rate - bias + gains[0] * from_gravity + gains[1] * from_field
    return normalise(multiply(q, exponential(interval * turning))), bias
