r"""WGS-84 ellipsoid: Earth-fixed coordinates of a site, and its local east-north-up frame.

    r = [(n + h) cos(B) cos(L), (n + h) cos(B) sin(L), (n (1 - e^2) + h) sin(B)]^T,
    n = a / sqrt(1 - e^2 sin^2(B)),   e^2 = f (2 - f)

with latitude B, longitude L and ellipsoidal height h; a and f are the defining constants of WGS-84
(NIMA TR8350.2, 2000). A vector d of the Earth-fixed frame has east, north and up components
``E d`` with the rotation E of :func:`east_north_up`.

Plain NumPy, angles in radians.
"""

from typing import NamedTuple

import numpy

from .array_namespace import Array

SEMI_MAJOR_AXIS = 6378137.0
"""Semi-major axis of WGS-84, m."""
FLATTENING = 1.0 / 298.257223563
"""Flattening of WGS-84."""
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
"""Square of the first eccentricity, WGS-84."""
EARTH_RATE = 7.2921150e-5
"""Rotation of the Earth, rad/s."""
GRAVITATIONAL_PARAMETER = 3.986004418e14
"""Geocentric gravitational constant, m^3/s^2."""


def earth_fixed(latitude: Array, longitude: Array, height: Array) -> Array:
    """Return the Earth-fixed Cartesian coordinates of geodetic ones, m, ``(3,)`` or ``(3, n)``.

    Args:
        latitude: geodetic latitude, rad; a number or ``(n,)``, as the others.
        longitude: longitude, rad, positive to the east.
        height: height above the ellipsoid, m.
    """
    sine = numpy.sin(latitude)
    n = SEMI_MAJOR_AXIS / numpy.sqrt(1.0 - ECCENTRICITY_SQUARED * sine**2)
    across = (n + height) * numpy.cos(latitude)
    return numpy.array(
        [
            across * numpy.cos(longitude),
            across * numpy.sin(longitude),
            (n * (1.0 - ECCENTRICITY_SQUARED) + height) * sine,
        ]
    )


def east_north_up(latitude: float, longitude: float) -> Array:
    """Return the rotation matrix from the Earth-fixed to the east-north-up frame of a site, ``(3, 3)``.

    Args:
        latitude: geodetic latitude, rad.
        longitude: longitude, rad.
    """
    sin_b, cos_b = numpy.sin(latitude), numpy.cos(latitude)
    sin_l, cos_l = numpy.sin(longitude), numpy.cos(longitude)
    return numpy.array(
        [
            [-sin_l, cos_l, 0.0],
            [-sin_b * cos_l, -sin_b * sin_l, cos_b],
            [cos_b * cos_l, cos_b * sin_l, sin_b],
        ]
    )


def east_north(latitude: Array, longitude: Array, height: Array, site: tuple[float, float]) -> Array:
    """Return the coordinates east and north of a site in its tangent plane, ``(2, n)``, m.

    The site is on the ellipsoid.

    Args:
        latitude: geodetic latitude, rad, ``(n,)``.
        longitude: longitude, rad, ``(n,)``.
        height: height above the ellipsoid, m, ``(n,)``.
        site: latitude and longitude of the site, rad.
    """
    away = earth_fixed(latitude, longitude, height) - earth_fixed(*site, 0.0)[:, None]
    return (east_north_up(*site) @ away)[:2]


class PlaneOrigin(NamedTuple):
    """Point at which the local tangent plane of a log touches the ellipsoid."""

    latitude: float
    """Geodetic latitude, degrees; the longitude is in degrees, too."""
    longitude: float
    altitude: float = 0.0
    """Height above the ellipsoid, m, for positions without a height; the plane itself is at zero."""

    def east_north(self, latitude: Array, longitude: Array, altitude: Array) -> Array:
        """Return the coordinates of positions east and north of the origin, ``(2, n)``, m.

        Args:
            latitude: geodetic latitude, degrees, ``(n,)``.
            longitude: longitude, degrees, ``(n,)``, positive to the east.
            altitude: height above the ellipsoid, m, ``(n,)``; NaN where it is not known.
        """
        height = numpy.where(numpy.isfinite(altitude), altitude, self.altitude)
        site = float(numpy.radians(self.latitude)), float(numpy.radians(self.longitude))
        return east_north(numpy.radians(latitude), numpy.radians(longitude), height, site)


def geodetic(position: Array) -> Array:
    """Return latitude, rad, longitude, rad, and height, m, of Earth-fixed coordinates, ``(3, n)``.

    The inverse of :func:`earth_fixed`, within a hundredth of a micrometre near the ground: Bowring's formula, The
    accuracy of geodetic latitude and height equations, Survey Review 28, 1985.

    Args:
        position: Earth-fixed coordinates, m, ``(3, n)``, not near the Earth's centre.
    """
    x, y, z = position
    axis = numpy.hypot(x, y)
    minor = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
    second = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED)
    distance = numpy.hypot(axis, z)
    # Of the reduced latitude the tangent.
    reduced = numpy.arctan2(minor * z * (1.0 + second * minor / distance), SEMI_MAJOR_AXIS * axis)
    latitude = numpy.arctan2(
        z + second * minor * numpy.sin(reduced) ** 3,
        axis - ECCENTRICITY_SQUARED * SEMI_MAJOR_AXIS * numpy.cos(reduced) ** 3,
    )
    sine, cosine = numpy.sin(latitude), numpy.cos(latitude)
    height = axis * cosine + z * sine - SEMI_MAJOR_AXIS * numpy.sqrt(1.0 - ECCENTRICITY_SQUARED * sine**2)
    return numpy.array([latitude, numpy.arctan2(y, x), height])
