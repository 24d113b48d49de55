"""Radar and ESM as they speak, as measurements of RadarEsmTracking; columns as of :mod:`.logs`."""

from collections.abc import Mapping
from typing import Any

import numpy

from ...filters.class_fusion import bearing_difference
from ..contract.live_input import LiveInput, Memory
from .logs import COLUMNS, start_track
from .world import Measurement, Start


class ScanInput(LiveInput):
    """Range and range rate at every scan, and a decision of the ESM where it heard something.

    The first scan starts the track: it is what :meth:`start` is given, in place of mean and covariance.
    """

    counter = "scan"

    def describe(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return columns of a log, also for the start."""
        return COLUMNS, COLUMNS

    def start(self, time: numpy.ndarray, given: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Start the track on its first scan; mean and covariance follow from it unless they are given."""
        first = self._scan(numpy.zeros(self.tracks), {n: v for n, v in given.items() if n in COLUMNS})
        measured = {name: numpy.moveaxis(array, -1, 0)[:, None] for name, array in first._asdict().items()}
        twice = {name: numpy.repeat(array, 2, axis=1) for name, array in measured.items()}
        found = start_track(twice, time[:, None], self.parameters).initial
        initial = {name: numpy.moveaxis(found[name], 0, -1) for name in ("mean", "covariance")}
        for name, array in initial.items():
            if given.get(name) is not None:
                initial[name] = self.read(given, name, array.shape[:-1])
        return Start(**initial, first=first), {"time": time, "count": numpy.zeros(self.tracks)}

    def measure(self, memory: Memory, time: numpy.ndarray, values: Mapping[str, Any]) -> tuple[Any, Memory]:
        """Take a scan."""
        scan = memory["count"] + 1.0
        return self._scan(scan, values), {"time": time, "count": scan}

    def _scan(self, scan: numpy.ndarray, values: Mapping[str, Any]) -> Measurement:
        types = self.task.types  # type: ignore[attr-defined]
        radar = self.read_all(values, ("range", "range_rate"), "at every scan")
        decision = self.read(values, "decision")
        decided = numpy.isfinite(decision)
        if not numpy.isin(decision[decided], numpy.arange(types)).all():
            raise ValueError(
                f"decision is the number of an emitter type from 0 to {types - 1}, got {decision}"
            )
        difference = self.read(values, "bearing_difference")
        bearings = self.read(values, "radar_bearing"), self.read(values, "esm_bearing")
        apart = numpy.where(numpy.isfinite(difference), difference, bearings[0] - bearings[1])
        if not numpy.isfinite(apart[decided]).all():
            raise ValueError(
                "a decision needs radar_bearing and esm_bearing (degrees), or bearing_difference"
            )
        looked = self.read(values, "looked")
        listens = scan % self.parameters.esm_period == 0
        return Measurement(
            scan.astype(numpy.int64),
            radar,
            numpy.where(numpy.isfinite(looked), looked > 0.5, listens) | decided,
            numpy.where(decided, decision, types).astype(numpy.int64),
            numpy.where(decided, bearing_difference(numpy.where(decided, apart, 0.0), 0.0), 0.0),
        )
