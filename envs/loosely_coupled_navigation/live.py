"""Positions by INS and receiver as they come, as measurements of LooselyCoupledNavigation."""

from collections.abc import Mapping
from typing import Any

import numpy

from ..contract.live_input import LiveInput, LiveReader, LiveValues, Memory
from .logs import COLUMNS, measure
from .world import Measurement


class PositionInput(LiveInput):
    """The position by the INS at every measurement, and a fix where there is one."""

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return the values in metres."""
        values = {name: COLUMNS[name].live_text for name in ("ins", "fix", "sigma")}
        return values, {"ins": "m, position by the INS at the start; default: the mean"}

    def start(self, time: Any, given: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Start where INS and track are."""
        initial, memory = super().start(time, {n: v for n, v in given.items() if n != "ins"})
        ins = self.read({"ins": initial.mean, **given}, "ins", (self.parameters.axes,))
        return initial, {**memory, "ins": ins}

    def measure(self, memory: Memory, time: Any, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Take increment and fix; a fix of some axes is none."""
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
