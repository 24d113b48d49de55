r"""Nominal Walker constellation seen from a site: orbits, azimuth and elevation, dilution of precision.

A satellite on a circular orbit of radius a, inclination i, with its ascending node at the right ascension W
and argument of latitude ``u(t) = u_0 + n t``, ``n = sqrt(mu / a^3)``, stands in the inertial frame at

    r = a (cos(u) P + sin(u) Q),   P = [cos W, sin W, 0],   Q = [-sin W cos i, cos W cos i, sin i]

The Earth-fixed frame turns below it at the rate w: position ``R_3(w t) r`` and velocity
``R_3(w t) v - w x (R_3(w t) r)``. Both are given in the east-north-up frame of a site fixed to the Earth.

The constellation is the nominal GLONASS (24/3/1): three planes of eight, nodes 120 degrees apart, 45 degrees
between neighbours of a plane, planes shifted by 15 degrees. Slots count from 1; slots 1 to 8 are plane 1,
and slot 1 stands at its node, on the Greenwich meridian, at t = 0.

With the unit vectors u_j from the user to the satellites and the design matrix of rows ``[-u_j^T, 1]``, the
covariance of a single-epoch fix is ``(G^T G)^-1`` in units of the pseudorange variance; the roots of its
diagonal are the dilutions of precision (Kaplan and Hegarty, Understanding GPS/GNSS, 2017, section 11.2.1).

Plain NumPy.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy

from .array_namespace import Array
from .geodesy import EARTH_RATE, GRAVITATIONAL_PARAMETER, earth_fixed, east_north_up

PERIOD = 40544.0
"""Orbital period of GLONASS, s."""
INCLINATION = numpy.deg2rad(64.8)
"""Inclination of every plane, rad."""
PLANES = 3
SLOTS_PER_PLANE = 8
PLANE_SHIFT = numpy.deg2rad(15.0)
"""Argument of latitude by which the satellites of a plane lead those of the plane before, rad."""


def orbit_radius() -> float:
    """Return the radius of the circular satellite orbits, ``(mu (P / 2 pi)^2)^(1/3)``, m."""
    return (GRAVITATIONAL_PARAMETER * (PERIOD / (2.0 * numpy.pi)) ** 2) ** (1.0 / 3.0)


def earth_fixed_orbits(slots: Sequence[int], time: Array) -> tuple[Array, Array]:
    """Return Earth-fixed positions, m, and velocities, m/s, of satellites, ``(3, S, K)`` each.

    Args:
        slots: S slot numbers from 1 to 24.
        time: time since t = 0, s, ``(K,)``.

    Raises:
        ValueError: if a slot is not in the constellation.
    """
    for slot in slots:
        if slot not in range(1, PLANES * SLOTS_PER_PLANE + 1):
            raise ValueError(f"satellite slots run from 1 to {PLANES * SLOTS_PER_PLANE}, got {slot!r}")
    a, rate = orbit_radius(), 2.0 * numpy.pi / PERIOD
    plane, place = numpy.divmod(numpy.asarray(slots) - 1, SLOTS_PER_PLANE)
    node = plane * (2.0 * numpy.pi / PLANES)
    start = place * (2.0 * numpy.pi / SLOTS_PER_PLANE) + plane * PLANE_SHIFT
    u = start[:, None] + rate * numpy.asarray(time, dtype=float)
    # Seen from the Earth the node runs backwards at the Earth's rate.
    w = node[:, None] - EARTH_RATE * numpy.asarray(time, dtype=float)
    sin_w, cos_w = numpy.sin(w), numpy.cos(w)
    sin_i, cos_i = numpy.sin(INCLINATION), numpy.cos(INCLINATION)
    towards = numpy.stack([cos_w, sin_w, 0.0 * w])
    ahead = numpy.stack([-sin_w * cos_i, cos_w * cos_i, sin_i + 0.0 * w])
    position = a * (numpy.cos(u) * towards + numpy.sin(u) * ahead)
    velocity = a * rate * (numpy.cos(u) * ahead - numpy.sin(u) * towards)
    carried = EARTH_RATE * numpy.stack([position[1], -position[0], 0.0 * w])
    return position, velocity + carried


def local_orbits(
    slots: Sequence[int], time: Array, latitude: float, longitude: float, height: float
) -> tuple[Array, Array]:
    """Return east-north-up positions, m, and velocities, m/s, of satellites at a site over time,
    ``(3, S, K)`` each.

    Args:
        slots: S slot numbers from 1 to 24.
        time: time since t = 0, s, ``(K,)``.
        latitude: latitude of the site, rad.
        longitude: longitude of the site, rad.
        height: height of the site, m.
    """
    position, velocity = earth_fixed_orbits(slots, time)
    rotation = east_north_up(latitude, longitude)
    site = earth_fixed(latitude, longitude, height)
    local = numpy.tensordot(rotation, position - site[:, None, None], 1)
    return local, numpy.tensordot(rotation, velocity, 1)


def look_angles(local: Array) -> tuple[Array, Array]:
    """Return azimuth (from north over east) and elevation, rad, of east-north-up positions ``(3, ...)``."""
    azimuth = numpy.arctan2(local[0], local[1]) % (2.0 * numpy.pi)
    return azimuth, numpy.arctan2(local[2], numpy.hypot(local[0], local[1]))


class DilutionOfPrecision(NamedTuple):
    """Standard deviations of a single-epoch fix per unit standard deviation of a pseudorange."""

    geometric: float
    position: float
    east: float
    north: float
    up: float
    time: float


def dilution_of_precision(unit_vectors: Array) -> DilutionOfPrecision:
    """Return the dilutions of precision of a position and clock fix from S satellites.

    Args:
        unit_vectors: unit vectors from the user to the satellites, east-north-up, ``(3, S)``.

    Raises:
        ValueError: for fewer than four satellites, or a geometry in which they do not determine the fix.
    """
    count = unit_vectors.shape[1]
    if count < 4:
        raise ValueError(f"a position and clock fix takes four satellites, got {count}")
    design = numpy.concatenate([-unit_vectors, numpy.ones((1, count))]).T
    if numpy.linalg.cond(design) > 1e6:
        raise ValueError("degenerate geometry: the satellites lie on one cone and determine no fix")
    variances = numpy.diag(numpy.linalg.inv(design.T @ design))
    east, north, up, time = (float(root) for root in numpy.sqrt(variances))
    return DilutionOfPrecision(
        float(numpy.sqrt(variances.sum())), float(numpy.sqrt(variances[:3].sum())), east, north, up, time
    )
