"""Live measurements of sensors and autopilot for UavAutopilot."""

from collections.abc import Mapping
from typing import Any

import numpy

from ..contract.live_input import LiveInput, LiveReader, Memory


class SensorInput(LiveInput):
    """Converter of live sensor readings, command and control into measurements."""

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return the names and descriptions of the values of a measurement, and of those at the start."""
        sensors = ", ".join(self.task.sensors)  # type: ignore[attr-defined]
        values = {
            "reading": f"of each sensor ({sensors}) in the unit of its coordinate; NaN in a dropout",
            "command": "in the unit of the output",
            "control": "control since the previous measurement: the value that was fed back",
        }
        return values, {"command": "at the start, in the unit of the output"}

    def start(self, time: Any, initial_values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the initial estimate with the given command (default: zero), and the memory."""
        initial, memory = super().start(time, {"command": 0.0, **initial_values})
        return initial, {**memory, "reading": self.broadcast(0.0, self.measurement.reading.shape[:-1])}

    def measure(self, memory: Memory, time: Any, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the measurement of the received readings, and the memory for the next one."""
        measurement, after = super().measure(memory, time, values)
        return measurement, {**after, "reading": measurement.reading}

    def replace_missing(self, memory: Memory, received: Any, there: Any) -> Any:
        """Return the readings, in a dropout the last one again."""
        return numpy.where(there, received, memory["reading"])


LIVE_READER = LiveReader(SensorInput)
