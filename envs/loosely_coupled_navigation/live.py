"""Live measurements of LooselyCoupledNavigation: positions by INS and receiver, one at a time."""

from collections.abc import Mapping
from typing import Any

import numpy

from ..contract.live_input import LiveInput, LiveReader, LiveValues, Memory
from .logs import COLUMNS, measure
from .world import Measurement


class PositionInput(LiveInput):
    """Converter of live INS positions, and of receiver fixes where there are any, into measurements."""

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return the names and descriptions of the values of a measurement, and of those at the start."""
        values = {name: COLUMNS[name].live_text for name in ("ins", "fix", "sigma")}
        return values, {"ins": "m, position by the INS at the start; default: the mean"}

    def start(self, time: Any, initial_values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the initial estimate, and a memory with the initial position of the INS."""
        initial, memory = super().start(time, {n: v for n, v in initial_values.items() if n != "ins"})
        ins = self.read({"ins": initial.mean, **initial_values}, "ins", (self.parameters.axes,))
        return initial, {**memory, "ins": ins}

    def measure(self, memory: Memory, time: Any, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the measurement of INS increment and fix, and the memory; an incomplete fix is ignored."""
        p = self.parameters
        values = {
            **values,
            **{name: numpy.atleast_1d(values[name]) for name in ("ins", "fix") if name in values},
        }
        ins, fix = self.read(values, "ins", (p.axes,)), self.read(values, "fix", (p.axes,))
        if not numpy.isfinite(ins).all():
            raise ValueError(f"{self.task.id} needs ins at every measurement, {p.axes} finite numbers (m)")
        sigma = LiveValues(self, values).deviations("sigma")
        number = memory["count"] + 1.0
        found = measure(number, ins, memory["ins"], fix, sigma, p)
        return Measurement(**found), {"time": time, "count": number, "ins": ins}


LIVE_READER = LiveReader(PositionInput)
