"""Base class of the task TightlyCoupledNavigation, used by its world, filters and picture."""

import numpy

from ...filters import gnss_ins, satellites
from ...filters.gnss_ins import AxisModel, CommonModel
from ..contract.observation import Array
from ..contract.task import Task
from .parameters import DEGREE, SensorGroup, TightlyCoupledNavigationParameters


class NavigationProblem(Task):
    """Base class of the task: sensors, satellite orbits, and models of motion and errors."""

    parameters: TightlyCoupledNavigationParameters

    def set_up(self) -> None:
        """List the sensors, tabulate the satellites and discretise the models."""
        p, constant = self.parameters, self.constant
        T = p.sampling_interval
        self.closes_loop: bool = bool(p.aperture)
        self.satellites: int = len(p.satellites)
        self.sensors: tuple[SensorGroup, ...] = p.sensors
        each = [s for s in self.sensors for _ in range(s.readings.start, s.readings.stop)]
        self.sensor_sigma: Array = constant([s.sigma for s in each])[:, None]
        self.sensor_variance: list[float] = [s.sigma**2 for s in each]
        apertures = [s.aperture for s in each if s.aperture is not None]
        self.apertures: Array = constant(apertures)[:, None]
        self.tracked: slice = slice(0, len(apertures))
        """Slice of the readings of tracking loops: pseudoranges and rates."""

        times = p.epoch + T * numpy.arange(p.horizon + 2)
        local, velocity = satellites.local_orbits(p.satellites, times, *p.site)
        self._satellite_position = constant(local)
        self._satellite_velocity = constant(velocity)

        self.common: CommonModel = gnss_ins.common_model(
            T,
            p.frequency_density,
            p.frequency_walk_density,
            p.angle_walk * DEGREE,
            p.attitude_rate_sigma * DEGREE,
            p.attitude_rate_time,
        )
        self.models: tuple[AxisModel, AxisModel, AxisModel] = (
            gnss_ins.rest_model(T, p.rest_velocity_sigma, p.reset_acceleration_sigma),
            gnss_ins.constant_velocity_model(T, p.increment_sigma, p.reset_acceleration_sigma),
            gnss_ins.singer_model(T, p.singer_alpha, p.singer_sigma),
        )
        self.axis: Array = constant(numpy.stack([m.transition for m in self.models], axis=-1)[..., None])
        noises = [gnss_ins.process_noise(m, self.common) for m in self.models]
        self.process_noise: Array = constant(numpy.stack(noises, axis=-1)[..., None])
        self.transition: Array = constant(p.transition)

    def _row(self, number: Array) -> Array:
        return self.xp.clip(number, None, self.horizon + 1)

    def satellites_at(self, number: Array) -> tuple[Array, Array]:
        """Return positions, m, and velocities, m/s, of the satellites at a measurement, ``(3, S, N)`` each."""
        row = self._row(number)
        return (
            self.xp.take(self._satellite_position, row, axis=2),
            self.xp.take(self._satellite_velocity, row, axis=2),
        )
