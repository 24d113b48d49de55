"""Readings of sensors as rows of a table and as live values, and the reading of a table."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy

from ...filters.geodesy import PlaneOrigin
from .companions import find_companion
from .task import Scenario

TIME = ("time", "timestamp", "seconds")
"""Names of the column of times."""
RECORDING = "recording"
"""Name of the column that names the recording of each row."""
TRUTH = "truth_"
"""Begins the names of columns of true values."""


class Column(NamedTuple):
    """A number that a sensor reports: a column of a table, and a value that comes live."""

    text: str
    """Its unit, and what it is."""
    live: str = ""
    """The same of a value that comes live; empty where ``text`` serves."""

    @property
    def live_text(self) -> str:
        """Description of the live value."""
        return self.live or self.text


class Readings(Protocol):
    """Numbers by the names of their columns: n rows of a table, or what came for n tracks."""

    def has(self, *names: str) -> bool:
        """Return whether all of these are given."""
        ...

    def __getitem__(self, name: str) -> numpy.ndarray:
        """Return the numbers of a column, ``(n,)``; NaN where one did not come."""
        ...

    def place(self, number: int) -> str:
        """Return the place of a number, such as "row 12"."""
        ...


def optional(readings: Readings, name: str, count: int) -> numpy.ndarray:
    """Return the numbers of a column that may lack, ``(n,)``; then NaN.

    Args:
        readings: given.
        name: of the column.
        count: n.
    """
    return readings[name] if readings.has(name) else numpy.full(count, numpy.nan)


def check_deviations(readings: Readings, name: str, values: Any) -> None:
    """Raise ValueError if a standard deviation is not above zero.

    Args:
        readings: that they are of.
        name: of the column.
        values: ``(n,)``; NaN where none is stated.
    """
    wrong = numpy.asarray(values <= 0.0)
    if wrong.any():
        place = int(wrong.argmax())
        raise ValueError(
            f"{name} is a standard deviation, above zero, and {readings.place(place)} has {float(values[place]):g}"
        )


NO_DEVIATIONS = "no column states deviations"
"""First words of the source of assumed deviations."""
UNITS = {"azimuth_sigma": "degrees"}
"""Of deviations that are no metres."""


def is_assumed(words: str) -> bool:
    """Return whether words say of deviations that no column states them."""
    return words.startswith(NO_DEVIATIONS)


def deviation_words(deviations: Mapping[str, float]) -> str:
    """Return the typical deviations in words, such as "sigma_x 13.8 m, sigma_y 13.8 m"."""
    return ", ".join(f"{name} {value:.3g} {UNITS.get(name, 'm')}" for name, value in deviations.items())


class TrackStart(NamedTuple):
    """The start of the tracks of E episodes, made of their first measurements."""

    measurements: Mapping[str, numpy.ndarray]
    """Those after the start, ``(E, T, ...)``."""
    initial: Mapping[str, numpy.ndarray]
    """The initial estimate, ``(E, ...)``."""
    used: int
    """Measurements that the start took."""


class TrackLog(NamedTuple):
    """The measurements of one track, made of the columns of a table; T measurements."""

    measurements: Mapping[str, numpy.ndarray]
    """``(T, ...)``."""
    initial: Mapping[str, numpy.ndarray]
    """The initial estimate, ``(...)``."""
    rows: numpy.ndarray
    """Row of the table that each measurement is of, ``(T,)``; -1 where it is of none."""
    parameters: Mapping[str, Any]
    """Parameters of the environment that follow from the table."""
    start: float
    """Time of the start of the track, s, as in the table."""
    time: numpy.ndarray
    """Recording of each measurement, ``(T,)``."""
    notes: tuple[str, ...] = ()
    """What was done to the table, a line each."""
    typical: Mapping[str, float] = {}
    """Parameters that are a typical size of what the table states of its errors, and may differ from track to track;
    the user has not set them."""
    deviations: Mapping[str, float] = {}
    """Typical deviations of what was measured, in the names and units of the columns that state them, or would."""
    deviations_from: str = ""
    """Source of the deviations, in words."""


class Predicted(NamedTuple):
    """A coordinate of a measurement that an estimate predicts."""

    name: str
    unit: str
    group: str
    """Of coordinates whose errors are one length, such as a position."""


class PlainRows(NamedTuple):
    """Rows of a table that are measurements without a conversion: the ``Measurement`` has
    ``values`` and ``available``, and perhaps ``interval`` and ``inputs``.
    """

    received: tuple[str, ...]
    """Columns of the numbers of ``values``; an empty cell was not received."""
    held: tuple[str, ...]
    """Columns of the numbers of ``inputs``; where a cell is empty the last one holds on, and before all the first."""
    mean: numpy.ndarray
    """Initial estimate of every track, ``(C,)``, one interval before the first row."""
    covariance: numpy.ndarray
    """``(C, C)``."""
    interval: float | None
    """Time between rows, s; None where they may come at any time: the median then lies before the first."""


class PlotRows(NamedTuple):
    """Rows of a table that are plots of a track, which starts from the first two of them."""

    farthest: float
    """m from the origin."""
    most_missed: int
    """Scans that may be missing between two rows."""
    finer: float
    """Times that a deviation exceeds the resolution of positions where noise does not repeat one by chance."""
    deviation: float
    """m, of a scan without a plot where columns state those of plots."""


@dataclass(frozen=True)
class LogFormat:
    """The tables of real measurements that an environment reads."""

    columns: Mapping[str, Column]
    """The columns beside ``time``, by their names."""
    read: Callable[[Any], TrackLog]
    """Makes the measurements of one track of its columns (:class:`~.recorded_tables.Columns`); raises
    :class:`ValueError` for what lacks or cannot be."""
    start: Callable[[Mapping[str, numpy.ndarray], numpy.ndarray, Any], TrackStart]
    """Makes the start of the tracks of measurements ``(E, T, ...)`` by name, of their times ``(E, T)``, s, and of the
    parameters, where a file gives no initial estimate; raises :class:`ValueError` if that cannot be."""
    targets_move: bool = False
    """Whether what is observed never stands still, as aircraft: a recording that hardly moves is of another unit."""
    scale_noise: Callable[[Any, Any], Any] | None = None
    """Multiplies the deviations stated in a ``Measurement`` by a factor, a number or ``(N,)``; None where none are."""
    predict: Callable[[Any, Any, Any], tuple[Any, Any]] | None = None
    """What an estimate before a measurement predicts of it, and what was measured, ``(m, N)`` each, NaN where nothing
    was received: from the mean ``(C, N)`` after the measurement before, the ``Measurement`` and the parameters."""
    predicted: tuple[Predicted, ...] = ()
    """What is predicted, at least m, the main ones first."""
    plane: tuple[str, ...] = ()
    """Two columns of metres, east and north, and two of them that are true, which latitude and longitude may stand for;
    empty where they may not."""
    plain_rows: PlainRows | None = None
    """How the rows are measurements as they stand; None where more is done to them."""
    plot_rows: PlotRows | None = None
    """How the rows are plots of a track; None where they are not."""
    regular_rows: Callable[[Any], Mapping[str, float]] | None = None
    """Numbers that the reading of rows at one rate needs, by the parameters; None where rows come otherwise."""
    noise_hint: str = ""
    """How a column that states noise is read, a clause for the note on one that is not; empty where there is no way."""
    decision_interval: int | None = None
    """Measurements for which an action holds in a recording that names no number; None: as by default. With one no
    measurement is lost."""
    longest_interval: float = float("inf")
    """Between measurements, s: what is longer in a table is taken for another unit."""


class LogSetup(NamedTuple):
    """Reading of the log for which a filter is advised, so that the filter can be run on the same input."""

    interval: float
    """Median time between measurements, s: the filter was judged with a missed scan wherever more time passes."""
    parameters: dict[str, Any]
    """Of the task."""
    columns: dict[str, str]
    """Names in the log, by what the columns are called here; empty where the log was no table."""
    deviations: dict[str, float]
    """Of measurements that state none, in the names and units of the columns."""
    deviations_from: str
    """Source of the deviations."""
    origin: dict[str, float]
    """Latitude and longitude, degrees, and usual altitude, m, around which positions were made metres; empty where they
    were metres."""
    horizon: int = 0
    """Measurements of the longest track; zero: not known."""

    def scenario(self, task: Any) -> Scenario:
        """Return the parameters of a task on logs that are read in the same way, in place of those of a simulated
        scenario.
        """
        log_format: Any = find_companion(task, LogFormat)
        known = ("horizon", self.horizon), ("decision_interval", log_format.decision_interval)
        return Scenario("log", "", {**{name: value for name, value in known if value}, **self.parameters})

    @property
    def plane(self) -> PlaneOrigin | None:
        """Origin of the plane."""
        return PlaneOrigin(**self.origin) if self.origin else None

    @property
    def assumed(self) -> dict[str, float]:
        """Parameters under which a log without deviations is read as the fitted one was; empty where it stated any."""
        isotropic = self.deviations.get("sigma_x") if is_assumed(self.deviations_from) else None
        return {} if isotropic is None else {"range_sigma": isotropic}
