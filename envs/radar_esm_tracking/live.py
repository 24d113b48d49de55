"""Live measurements of radar and ESM for RadarEsmTracking, with the columns of :mod:`.logs`."""

from collections.abc import Mapping
from typing import Any

import numpy

from ...compiler.functions import map_arrays
from ..contract.live_input import LiveInput, LiveReader, LiveValues, Memory
from .logs import COLUMNS, read_decisions, start_track
from .world import Measurement, Start


class ScanInput(LiveInput):
    """Converter of live range and range rate, and of ESM decisions, into measurements.

    The first scan starts the track: :meth:`start` takes it in place of mean and covariance.
    """

    counter = "scan"

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return the names and descriptions of the values of a measurement, and of those at the start."""
        texts = {name: column.live_text for name, column in COLUMNS.items()}
        return texts, texts

    def start(self, time: Any, initial_values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the initial estimate from the first scan, or from given mean and covariance, and the memory."""
        first = self._scan(
            numpy.zeros(self.tracks), {n: v for n, v in initial_values.items() if n in COLUMNS}
        )
        measured = {name: numpy.moveaxis(array, -1, 0)[:, None] for name, array in first._asdict().items()}
        twice = {name: numpy.repeat(array, 2, axis=1) for name, array in measured.items()}
        found = start_track(twice, numpy.reshape(time, (-1, 1)), self.parameters).initial
        initial = {name: numpy.moveaxis(found[name], 0, -1) for name in ("mean", "covariance")}
        for name, array in initial.items():
            if initial_values.get(name) is not None:
                initial[name] = self.read(initial_values, name, array.shape[:-1]).reshape(array.shape)
        return Start(**initial, first=first), {"time": time, "count": self.broadcast(0.0)}

    def measure(self, memory: Memory, time: Any, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Return the measurement of a scan, and the memory for the next one."""
        scan = memory["count"] + 1.0
        found = self._scan(numpy.atleast_1d(scan), values)
        return found if self.lanes else map_arrays(_first, found), {"time": time, "count": scan}

    def _scan(self, scan: numpy.ndarray, values: Mapping[str, Any]) -> Measurement:
        radar = self.read_all(values, ("range", "range_rate"), "at every scan").reshape(2, -1)
        found = read_decisions(LiveValues(self, values), scan, self.parameters)
        return Measurement(scan=scan.astype(numpy.int64), radar=radar, **found)


def _first(array: numpy.ndarray) -> Any:
    return array[..., 0]


LIVE_READER = LiveReader(ScanInput)
