"""Measurements of a state-space model as they come one by one, see :mod:`..contract.live_input`."""

from collections.abc import Mapping
from typing import Any

import numpy

from ..contract.live_input import LiveInput, Memory

UNEVEN = 0.01
"""Share of the sampling interval by which a time may be off, as in tables of regular measurements."""


class StateSpaceInput(LiveInput):
    """Values of the sensors; the function f says the state one sampling interval later, and no other."""

    def measure(self, memory: Memory, time: numpy.ndarray, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Make the measurement; refuse an interval that the model does not know."""
        interval, own = time - memory["time"], self.parameters.sampling_interval
        wrong = numpy.abs(interval - own) > UNEVEN * own
        if wrong.any():
            raise ValueError(
                f"the model of {self.task.id} moves by {own:g} s from one measurement to the next, got "
                f"{float(interval[wrong][0]):g} s: call update once in every interval, without values where nothing "
                "came, or make the model with another sampling_interval"
            )
        return super().measure(memory, time, values)
