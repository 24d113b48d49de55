"""A level drive of which an ideal IMU on a rotating Earth and every position are known."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from filtergym.filters import geodesy

RATE = 40.0
"""Of the synthetic IMU, Hz."""
LATITUDE, LONGITUDE, HEIGHT = math.radians(40.0), math.radians(-105.0), 1600.0


def normal_gravity():
    """At the synthetic drive, m/s^2: Somigliana's formula and the free-air gradient."""
    sine = math.sin(LATITUDE) ** 2
    e2 = geodesy.ECCENTRICITY_SQUARED
    surface = 9.7803253359 * (1 + 0.00193185265241 * sine) / math.sqrt(1 - e2 * sine)
    return surface * (1 - 2 * HEIGHT / geodesy.SEMI_MAJOR_AXIS)


class CircularDrive:
    """A level drive: 10 s of standstill, 5 s of speeding up to the north, then a circle to the right."""

    standstill, run, speed, turn = 10.0, 5.0, 10.0, 0.2

    def __init__(self, seconds):
        self.time = np.arange(0.0, seconds, 1.0 / RATE)
        t = self.time
        self.forward = np.where((t > self.standstill) & (t <= self.standstill + self.run), 2.0, 0.0)
        v = 2.0 * np.clip(t - self.standstill, 0.0, self.run)
        self.yaw_rate = np.where(t > self.standstill + self.run, self.turn, 0.0)
        yaw = self.turn * np.clip(t - self.standstill - self.run, 0.0, None)
        self.yaw = yaw
        self.velocity = np.stack([v * np.cos(yaw), v * np.sin(yaw), 0.0 * v], axis=1)
        straight = np.clip(t - self.standstill, 0.0, self.run)
        radius = self.speed / self.turn
        self.north = straight**2 + radius * np.sin(yaw)
        self.east = radius * (1.0 - np.cos(yaw))
        self.right = v * self.yaw_rate

    def inertial(self):
        """Rates, rad/s, and specific forces, m/s^2, of an ideal IMU on a rotating Earth, forward, right, down."""
        north, east, _ = self.velocity.T
        radius = geodesy.SEMI_MAJOR_AXIS
        spin = geodesy.EARTH_RATE * np.array([math.cos(LATITUDE), 0.0, -math.sin(LATITUDE)])
        carried = np.stack([east / radius, -north / radius, -east * math.tan(LATITUDE) / radius], axis=1)
        level = Rotation.from_euler("z", self.yaw[:, None]).inv()
        rates = level.apply(spin + carried) + np.outer(self.yaw_rate, [0.0, 0.0, 1.0])
        body = np.stack([self.forward, self.right, np.full(len(self.time), -normal_gravity())], axis=1)
        return rates, body + level.apply(np.cross(2.0 * spin + carried, self.velocity))

    def position(self):
        """Latitude, longitude in degrees, height in m."""
        e2, sine = geodesy.ECCENTRICITY_SQUARED, math.sin(LATITUDE)
        across = geodesy.SEMI_MAJOR_AXIS / math.sqrt(1 - e2 * sine**2)
        along = across * (1 - e2) / (1 - e2 * sine**2)
        latitude = LATITUDE + self.north / (along + HEIGHT)
        longitude = LONGITUDE + self.east / ((across + HEIGHT) * np.cos(LATITUDE))
        return np.degrees(latitude), np.degrees(longitude), np.full(len(self.time), HEIGHT)
