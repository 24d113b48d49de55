"""Formats of sensor readings: columns of a table, live values, and the rules of their conversion to measurements."""

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
"""Prefix of the names of columns of true values."""


class Column(NamedTuple):
    """A number that a sensor reports: a column of a table, and a live value."""

    text: str
    """Unit and meaning."""
    live: str = ""
    """Unit and meaning of the live value; empty where ``text`` applies."""

    @property
    def live_text(self) -> str:
        """Unit and meaning of the column, as the description of a live value."""
        return self.live or self.text


class Readings(Protocol):
    """Protocol of numbers by column name: n rows of a table, or the live values of n tracks."""

    def has(self, *names: str) -> bool:
        """Return whether there is a column under each of these names."""
        ...

    def __getitem__(self, name: str) -> numpy.ndarray:
        """Return the numbers in a column by its name, ``(n,)``; NaN where one is missing."""
        ...

    def place(self, number: int) -> str:
        """Return the place of a number in words, such as "row 12", for an error message."""
        ...


def optional_column(readings: Readings, name: str, count: int) -> numpy.ndarray:
    """Return the numbers in a column, ``(count,)``; all NaN if the column does not exist."""
    return readings[name] if readings.has(name) else numpy.full(count, numpy.nan)


def check_deviations(readings: Readings, name: str, values: Any) -> None:
    """Raise ValueError if a standard deviation in a column is not above zero; NaN is accepted."""
    wrong = numpy.asarray(values <= 0.0)
    if wrong.any():
        place = int(wrong.argmax())
        raise ValueError(
            f"{name} is a standard deviation, above zero, and {readings.place(place)} has {float(values[place]):g}"
        )


NO_DEVIATIONS = "no column states deviations"
"""First words of the source of assumed deviations."""
UNITS = {"azimuth_sigma": "degrees"}
"""Units of deviations that are not in metres."""


def is_assumed(words: str) -> bool:
    """Return whether this description of the source of deviations marks them as assumed, not read."""
    return words.startswith(NO_DEVIATIONS)


def deviation_words(deviations: Mapping[str, float]) -> str:
    """Return typical deviations as text, such as "sigma_x 13.8 m, sigma_y 13.8 m"."""
    return ", ".join(f"{name} {value:.3g} {UNITS.get(name, 'm')}" for name, value in deviations.items())


class TrackStart(NamedTuple):
    """Start of the tracks of E episodes, computed from their first measurements."""

    measurements: Mapping[str, numpy.ndarray]
    """Measurements after the start, ``(E, T, ...)``."""
    initial: Mapping[str, numpy.ndarray]
    """The initial estimate, ``(E, ...)``."""
    used: int
    """Number of measurements that the start used."""


class TrackLog(NamedTuple):
    """Result of reading a log: the T measurements of one track."""

    measurements: Mapping[str, numpy.ndarray]
    """Arrays of the measurements, ``(T, ...)``."""
    initial: Mapping[str, numpy.ndarray]
    """The initial estimate, ``(...)``."""
    rows: numpy.ndarray
    """Row of the table of each measurement, ``(T,)``; -1 where there is none."""
    parameters: Mapping[str, Any]
    """Parameters of the environment that follow from the table."""
    start: float
    """Time of the start of the track, s, as in the table."""
    time: numpy.ndarray
    """Time of each measurement as written in the table, ``(T,)``."""
    notes: tuple[str, ...] = ()
    """Changes made to the table, a line each."""
    typical: Mapping[str, float] = {}
    """Parameters set to typical sizes of the errors that the table states. They may differ from track to track; the
    user has not set them."""
    deviations: Mapping[str, float] = {}
    """Typical deviations of the measured values, by the names and in the units of the columns for them."""
    deviations_from: str = ""
    """Source of the deviations, in words."""


class PredictedCoordinate(NamedTuple):
    """Name and unit of a measured coordinate that is compared with its prediction."""

    name: str
    unit: str
    group: str
    """Group of coordinates whose errors are one length, such as a position."""


class PlainRows(NamedTuple):
    """Format of tables whose rows are measurements of ``values`` and ``available``, without a conversion."""

    received: tuple[str, ...]
    """Columns of the numbers of ``values``; an empty cell is a value that was not received."""
    inputs: tuple[str, ...]
    """Columns of the numbers of ``inputs``; an empty cell repeats the last number, or before it the first."""
    mean: numpy.ndarray
    """Initial estimate of every track, ``(C,)``, one interval before the first row."""
    covariance: numpy.ndarray
    """Covariance of the initial estimate, ``(C, C)``."""
    interval: float | None
    """Time between rows, s; None where it varies: the track then starts one median interval before the first row."""


class PlotRows(NamedTuple):
    """Format of tables whose rows are radar plots of a track, which starts from the first two."""

    farthest: float
    """Largest distance from the origin, m."""
    most_missed: int
    """Largest number of scans missing between two rows."""
    finer: float
    """Ratio of deviation to resolution of positions from which on noise does not repeat a position by chance."""
    deviation: float
    """Deviation of a scan without a plot, where columns state those of plots, m."""


@dataclass(frozen=True)
class LogFormat:
    """Format of the logs (tables of real measurements) that an environment reads."""

    columns: Mapping[str, Column]
    """The columns beside ``time``, by their names."""
    read: Callable[[Any], TrackLog]
    """Function that makes the measurements of one track from its columns (:class:`~.recorded_tables.Columns`); raises
    :class:`ValueError` for missing or impossible values."""
    start: Callable[[Mapping[str, numpy.ndarray], numpy.ndarray, Any], TrackStart]
    """Function that makes the start of the tracks from measurements ``(E, T, ...)`` by name, their times ``(E, T)``, s,
    and the parameters, where a file gives no initial estimate; raises :class:`ValueError` if that is impossible."""
    targets_move: bool = False
    """Whether targets never stand still, such as aircraft: a recording that hardly moves then has another unit."""
    scale_noise: Callable[[Any, Any], Any] | None = None
    """Function that multiplies the deviations stated in a ``Measurement`` by a factor, a number or ``(N,)``; None
    where none are stated."""
    predict: Callable[[Any, Any, Any], tuple[Any, Any]] | None = None
    """Function that returns the predicted and the measured coordinates, ``(m, N)`` each, NaN where nothing was
    received. Its arguments are the mean ``(C, N)`` after the previous measurement, the ``Measurement`` and the
    parameters."""
    predicted: tuple[PredictedCoordinate, ...] = ()
    """Predicted coordinates, at least m, the main ones first."""
    plane: tuple[str, ...] = ()
    """Two columns of metres, east and north, and two of their true values, which latitude and longitude may
    replace; empty where they may not."""
    plain_rows: PlainRows | None = None
    """Format of rows that are measurements without a conversion; None where they need one."""
    plot_rows: PlotRows | None = None
    """Format of rows that are plots of a track; None where they are not."""
    regular_rows: Callable[[Any], Mapping[str, float]] | None = None
    """Numbers that the reading of rows at one rate needs, by the parameters; None where the rate of rows varies."""
    noise_hint: str = ""
    """Remedy for a column of noise that is not read, a clause for the note on it; empty where there is none."""
    decision_interval: int | None = None
    """Measurements of a decision in a recording that states no number; None: the default. With one, no measurement is
    dropped."""
    longest_interval: float = float("inf")
    """Longest time between measurements, s: a longer one in a table is taken for another unit."""


class LogSetup(NamedTuple):
    """Parameters and assumptions with which a log was read, so that a filter runs on the same input later."""

    interval: float
    """Median time between measurements, s: the filter was evaluated with a missed scan wherever more time passes."""
    parameters: dict[str, Any]
    """Parameters of the task."""
    columns: dict[str, str]
    """Names in the log, by the names of the columns here; empty where the log was no table."""
    deviations: dict[str, float]
    """Deviations of measurements that state none, by the names and in the units of the columns."""
    deviations_from: str
    """Source of the deviations."""
    origin: dict[str, float]
    """Latitude and longitude, degrees, and usual altitude, m, around which positions were made metres; empty where they
    were metres."""
    horizon: int = 0
    """Measurements of the longest track; zero: not known."""

    def scenario(self, task: Any) -> Scenario:
        """Return a :class:`Scenario` with the parameters of the log, in place of a simulated one."""
        log_format: Any = find_companion(task, LogFormat)
        known = ("horizon", self.horizon), ("decision_interval", log_format.decision_interval)
        return Scenario("log", "", {**{name: value for name, value in known if value}, **self.parameters})

    @property
    def plane(self) -> PlaneOrigin | None:
        """Origin of the plane of metres east and north; None where the log had positions in metres."""
        return PlaneOrigin(**self.origin) if self.origin else None

    @property
    def assumed(self) -> dict[str, float]:
        """Parameter ``range_sigma`` with the deviation assumed for a log that stated none; else empty."""
        isotropic = self.deviations.get("sigma_x") if is_assumed(self.deviations_from) else None
        return {} if isotropic is None else {"range_sigma": isotropic}
