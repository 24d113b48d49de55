"""Live measurements of a state-space model, see :mod:`..contract.live_input`."""

from collections.abc import Mapping
from typing import Any

import numpy

from ...compiler.vector_functions import VectorFunction
from ..contract.live_input import LiveInput, Memory
from .equations import StateSpaceDefinition, StateSpaceProblem, find_invalid_noise

UNEVEN = 0.01
"""Largest deviation of an interval from the sampling interval, as a share of it."""


class StateSpaceInput(LiveInput):
    """Converter of live values of sensors and inputs into measurements of a state-space model.

    A timed model accepts any interval, and zero where the state does not move in it. Any other model accepts only its
    sampling interval.
    """

    def __init__(self, task: StateSpaceProblem, initial: Any, measurement: Any, tracks: int) -> None:
        self.definition: StateSpaceDefinition = task.definition
        self.measured: tuple[str, ...] = tuple(task.definition.measured)
        self.inputs: tuple[str, ...] = tuple(task.definition.inputs)
        self.groups = [one for one in task.definition.channels if one.name not in (*self.measured, "values")]
        super().__init__(task, initial, measurement, tracks)
        own = task.definition
        self.fuses: bool = all(
            model.allows_zero_interval(own.mean, own.nominal_inputs) for model in own.filters
        )
        self._noise_varies = any(isinstance(model.R, VectorFunction) for model in own.filters)
        self._names = ["values", *(channel.name for channel in self.groups), *self.measured]

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return the names and descriptions of the values of a measurement, and of those at the start."""
        values, at_start = super().describe()
        found = {name: text for name, text in values.items() if name not in ("interval", "inputs")}
        sensors = {channel.name: f"shape ({channel.size},)" for channel in self.groups}
        names = {**sensors, **dict.fromkeys(self.measured, "a number")}
        inputs = dict.fromkeys(
            self.inputs, "an input that acted since the last measurement; the last value remains in force"
        )
        return {**names, **inputs, **found}, at_start

    def start(self, time: Any, initial_values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the initial estimate, and a memory in which the inputs are unknown (NaN)."""
        initial, memory = super().start(time, initial_values)
        return initial, {**memory, "inputs": self.broadcast(numpy.nan, (len(self.inputs),))}

    def measure(self, memory: Memory, time: Any, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the measurement from the values at one time, and the memory for the next one.

        Raises:
            ValueError: if the model cannot move by this interval.
        """
        interval, own = time - memory["time"], self.parameters.sampling_interval
        values = self._by_name(values)
        if self.inputs:
            memory = {**memory, "inputs": self._hold(memory["inputs"], values)}
            values["inputs"] = memory["inputs"]
        if self.measurement.interval is not None:
            return self._checked(super().measure(memory, time, {**values, "interval": interval}), interval)
        wrong = abs(interval - own) > UNEVEN * own
        if numpy.count_nonzero(wrong):
            raise ValueError(
                f"the model of {self.task.id} moves by {own:g} s from one measurement to the next, got "
                f"{float(numpy.extract(wrong, interval)[0]):g} s: call "
                "update once in every interval, without values where nothing was received, or write f(x, dt) and Q(dt)"
            )
        return self._checked(super().measure(memory, time, values), interval)

    def _checked(self, made: tuple[Any, Memory], interval: Any) -> tuple[Any, Memory]:
        if not self._noise_varies:
            return made
        measurement, N = made[0], self.tracks
        inputs = numpy.reshape(measurement.inputs if self.inputs else (), (len(self.inputs), N))
        there = numpy.reshape(measurement.available, (-1, N))
        found = find_invalid_noise(self.definition, there, numpy.atleast_1d(interval), inputs)
        if found is not None:
            values = ", ".join(f"{name}={inputs[j, found.place]:g}" for j, name in enumerate(self.inputs))
            raise ValueError(
                f"R of {found.sensor} must be positive definite, and with {values} it is {found.R}: leave the sensor "
                "out where its noise is not known"
            )
        return made

    def _by_name(self, values: Mapping[str, Any]) -> dict[str, Any]:
        named = [name for name in self._names if values.get(name) is not None]
        if named in ([], ["values"]):
            return dict(values)
        rows = numpy.array([self.read(values, name) for name in self.measured])
        for channel in self.groups:
            given, own = self.read(values, channel.name, (channel.size,)), rows[channel.places]
            if (numpy.isfinite(given) & numpy.isfinite(own)).any():
                raise ValueError(
                    f"{channel.name} contains {self.measured[channel.first]} already: give one of them"
                )
            rows[channel.places] = numpy.where(numpy.isfinite(given), given, own)
        if "values" in named:
            raise ValueError(f"values contains {named[1]} already: give one of them")
        return {**values, "values": rows}

    def _hold(self, before: numpy.ndarray, values: Mapping[str, Any]) -> numpy.ndarray:
        """Return the newest value of each input, ``(p, N)`` or ``(p,)``; without a new one the last."""
        given = numpy.array([self.read(values, name) for name in self.inputs])
        found = numpy.where(numpy.isfinite(given), given, before)
        if not numpy.isfinite(found).all():
            lacking = self.inputs[int((~numpy.isfinite(found)).reshape(len(found), -1).any(axis=1).argmax())]
            raise ValueError(
                f"{self.task.id} needs {lacking} at the first measurement; later the last value remains in force"
            )
        return found
