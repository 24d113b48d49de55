"""Live measurements of TightlyCoupledNavigation: readings of receiver and inertial system."""

from collections.abc import Mapping
from typing import Any

import numpy

from ..contract.live_input import LiveInput, LiveReader, Memory


class ReceiverInput(LiveInput):
    """Converter of live sensor readings, INS angles and satellite positions into measurements."""

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return the names and descriptions of the values of a measurement, and of those at the start."""
        values = {
            sensor.name: f"{self._count(sensor)} readings, NaN where there is none"
            for sensor in self._sensors
        }
        satellites = self.measurement.cn0.shape[0]
        values |= {
            "ins_angles": "heading, pitch and roll shown by the inertial system, rad",
            "cn0": f"carrier to noise density of each of {satellites} satellites, dB-Hz",
            "satellite_position": f"east, north, up of the site, m, (3, {satellites})",
            "satellite_velocity": f"velocities of the satellites, m/s, (3, {satellites})",
        }
        others = [name for name in self.initial._asdict() if name not in ("mean", "covariance")]
        return values, {name: f"shape {getattr(self.initial, name).shape[:-1]}" for name in others}

    @property
    def _sensors(self) -> Any:
        return self.task.sensors  # type: ignore[attr-defined]

    @staticmethod
    def _count(sensor: Any) -> int:
        return int(sensor.readings.stop - sensor.readings.start)

    def measure(self, memory: Memory, time: Any, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the measurement with the readings of all sensors in one array, and the memory."""
        names = {sensor.name for sensor in self._sensors}
        readings = [self.read(values, sensor.name, (self._count(sensor),)) for sensor in self._sensors]
        others = {name: value for name, value in values.items() if name not in names}
        return super().measure(memory, time, {**others, "readings": numpy.concatenate(readings)})


LIVE_READER = LiveReader(ReceiverInput)
