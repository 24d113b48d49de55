"""Measurements of a state-space model as they come one by one, see :mod:`..contract.live_input`."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy

from ..contract.live_input import LiveInput, Memory

if TYPE_CHECKING:
    from .state_space import StateSpace

UNEVEN = 0.01
"""Share of the sampling interval by which a time may be off, as in tables of regular measurements."""


class StateSpaceInput(LiveInput):
    """Values of the sensors. A timed model takes any interval, also none where it then stands still; any other says the
    state one sampling interval later, and nothing else.
    """

    def __init__(self, task: "StateSpace", initial: Any, measurement: Any, tracks: int) -> None:
        super().__init__(task, initial, measurement, tracks)
        self.fuses = all(model.stands_still for model in task.definition.filters)

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return what the sensors say; the interval follows from the times."""
        values, at_start = super().describe()
        return {name: text for name, text in values.items() if name != "interval"}, at_start

    def measure(self, memory: Memory, time: numpy.ndarray, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Make the measurement; refuse an interval that the model does not know."""
        interval, own = time - memory["time"], self.parameters.sampling_interval
        if self.measurement.interval is not None:
            return super().measure(memory, time, {**values, "interval": interval})
        wrong = numpy.abs(interval - own) > UNEVEN * own
        if wrong.any():
            raise ValueError(
                f"the model of {self.task.id} moves by {own:g} s from one measurement to the next, got "
                f"{float(interval[wrong][0]):g} s: call update once in every interval, without values where nothing "
                "came, or write f(x, dt) and Q(dt)"
            )
        return super().measure(memory, time, values)
