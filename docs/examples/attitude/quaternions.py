"""Unit quaternions and direction cosines, batch on the last axis.

A quaternion ``q = (w, x, y, z)``, ``(4, N)``, turns vectors from the sensor's frame into the world's:
``v_world = q v_sensor q*`` [1, eq. 5.4.3]. The world's axes are north (magnetic), west and up.

The *direction cosines* ``C``, ``(9, N)``, are the rows of its rotation matrix: north, west and up as unit vectors in
the sensor's frame. They have no sign to choose and no jump, so that an estimate minus a truth is an error. Three angles
follow from that difference ``E = C - C0`` alone. With ``s = |E|^2`` the angle of the whole rotation between the two is

    sin^2(total / 2) = s / 8                                                                  (1)

because ``|C - C0|^2 = 6 - 2 trace(C C0^T) = 4 (1 - cos(total))``. With ``u`` the part of it that belongs to up, two
unit vectors at the angle of inclination,

    sin^2(inclination / 2) = |u|^2 / 4                                                        (2)

and the rest, a rotation about the vertical, is the heading [2, section 3.2]:

    cos(total / 2) = cos(inclination / 2) cos(heading / 2)                                    (3)

[1] J. B. Kuipers, Quaternions and rotation sequences, Princeton University Press, 1999.
[2] D. Laidig, M. Caruso, A. Cereatti, T. Seel, BROAD - a benchmark for robust inertial orientation estimation, Data 6
    (7), 72, 2021, doi:10.3390/data6070072.
"""

import math
from collections.abc import Sequence

from filtergym.filters.array_namespace import Array, namespace
from filtergym.filters.ordered_sums import ordered_sum

TINY = 1e-30
"""Added under a square root: what is a unit vector or an angle stays so to the last bit, and zero has a gradient."""
DEGREES = 180.0 / math.pi


def multiply(p: Array, q: Array) -> Array:
    """Product of quaternions, ``(4, N)``."""
    xp = namespace(q)
    a, b, c, d = p[0], p[1], p[2], p[3]
    w, x, y, z = q[0], q[1], q[2], q[3]
    return xp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def square(vector: Array) -> Array:
    """Squared length of vectors, ``(N,)``."""
    return ordered_sum(vector * vector)


def length(vector: Array) -> Array:
    """Length of vectors, ``(N,)``, with a gradient at zero."""
    return namespace(vector).sqrt(square(vector) + TINY)


def normalise(vector: Array) -> Array:
    """Vector of length one in the same direction, ``(..., N)``; zero stays zero."""
    return vector / length(vector)


def cross(a: Array, b: Array) -> Array:
    """Vector product, ``(3, N)``."""
    return namespace(a).stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def exponential(rotation: Array) -> Array:
    """Quaternion of a rotation by a vector, ``(4, N)``.

    Args:
        rotation: axis times angle, rad, ``(3, N)``.
    """
    xp = namespace(rotation)
    half = 0.5 * length(rotation)
    scale = 0.5 * xp.sin(half) / half
    return xp.concat([xp.cos(half)[None], scale * rotation])


def direction_cosines(q: Array) -> Array:
    """Rows of the rotation matrix of unit quaternions, ``(9, N)``."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return namespace(q).stack(
        [
            1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
            2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
            2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
        ]
    )  # fmt: skip


def to_world(cosines: Array, vector: Array) -> Array:
    """Turn vectors of the sensor's frame, ``(3, N)``, into the world's."""
    return namespace(vector).stack([ordered_sum(cosines[i : i + 3] * vector) for i in (0, 3, 6)])


def to_sensor(cosines: Array, vector: Array) -> Array:
    """Turn vectors of the world's frame, ``(3, N)``, into the sensor's."""
    return cosines[:3] * vector[0] + cosines[3:6] * vector[1] + cosines[6:] * vector[2]


def align(accelerometer: Array, magnetometer: Array) -> Array:
    """Direction cosines in which the specific force is up and the field lies to the north, ``(9, N)``.

    Args:
        accelerometer: specific force in the sensor's frame, ``(3, N)``, any unit.
        magnetometer: magnetic field likewise, not parallel to it.

    Source: the TRIAD method, M. D. Shuster, S. D. Oh, Journal of Guidance and Control 4 (1981), 70-77.
    """
    up = normalise(accelerometer)
    west = normalise(cross(up, magnetometer))
    return namespace(up).concat([cross(west, up), west, up])


def quaternion_of(cosines: Array) -> Array:
    """Unit quaternion of direction cosines, ``(4, N)``.

    Four times the squares of its entries follow from the diagonal; the largest is a safe divisor.

    Source: S. W. Shepperd, Journal of Guidance and Control 1 (1978), 223-224.
    """
    xp = namespace(cosines)
    a, b, c, d, e, f, g, h, i = (cosines[k] for k in range(9))
    candidates = [
        (1.0 + a + e + i, h - f, c - g, d - b),
        (h - f, 1.0 + a - e - i, b + d, c + g),
        (c - g, b + d, 1.0 - a + e - i, f + h),
        (d - b, c + g, f + h, 1.0 - a - e + i),
    ]
    chosen, largest = xp.stack(candidates[0]), candidates[0][0]
    for k in (1, 2, 3):
        better = candidates[k][k] > largest
        chosen = xp.where(better, xp.stack(candidates[k]), chosen)
        largest = xp.where(better, candidates[k][k], largest)
    return normalise(chosen)


def error_angles(error: Array) -> tuple[Array, Array, Array]:
    """Total angle, inclination and heading between two attitudes, degrees, ``(N,)`` each; equations (1) to (3).

    Args:
        error: direction cosines of one minus those of the other, ``(9, N)``.
    """
    total = _half_angle_square(square(error) / 8.0)
    inclination = _half_angle_square(square(error[6:]) / 4.0)
    # By sines, sin^2(total) - sin^2(inclination) = cos^2(inclination) sin^2(heading): small angles keep their digits.
    heading = _half_angle_square((total - inclination) / (1.0 - inclination))
    return _angle(total), _angle(inclination), _angle(heading)


def total_angle(error: Array) -> Array:
    """Total angle alone, degrees, ``(N,)``; equation (1)."""
    return _angle(_half_angle_square(square(error) / 8.0))


def _half_angle_square(value: Array) -> Array:
    """Square of a sine, kept where the root and the arc have gradients: rounding may leave it outside."""
    return namespace(value).clip(value, TINY, 1.0 - 1e-12)


def _angle(half_angle_square: Array) -> Array:
    xp = namespace(half_angle_square)
    return 2.0 * DEGREES * xp.asin(xp.sqrt(half_angle_square))


def random_quaternion(uniforms: Sequence[Array]) -> Array:
    """Attitude that is uniform over all rotations, of three uniform numbers ``(N,)``, ``(4, N)``.

    Source: K. Shoemake, Uniform random rotations, Graphics Gems III, Academic Press, 1992, 124-132.
    """
    share, first, second = uniforms
    xp = namespace(share)
    one, other = xp.sqrt(1.0 - share), xp.sqrt(share)
    a, b = 2.0 * math.pi * first, 2.0 * math.pi * second
    return xp.stack([other * xp.cos(b), one * xp.sin(a), one * xp.cos(a), other * xp.sin(b)])
