"""Reader of files of measurements that a user gives in place of a scenario."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..contract.task import Task
from ..data.recording import Recording, join_recordings, recording_from
from ..data.scenario_data import Reader, ScenarioData
from ..data.trajectory import trajectory_of
from ..engine.catalogue import check_names, import_task, task_class
from ..engine.scenario_choice import make_task
from .flight_tables import FLIGHT_SUFFIXES
from .flights import TRAFFIC, files_of, flights_from, names_flights, read_flights
from .plausibility import check_recording
from .recorded_tables import TruthFile, read_columns
from .recording_files import is_recording, names_environment, read_netcdf


def read_recording(
    path: Any,
    environment: str | None = None,
    *,
    speeds: tuple[float, float] = (1.0, 1000.0),
    truth: Any = None,
    truth_offset: float = 0.0,
    rename: Mapping[str, str | Sequence[str]] | None = None,
    sort: bool = False,
    **keywords: Any,
) -> Recording:
    """Read recorded measurements from files, and check their plausibility (:mod:`.plausibility`).

    Args:
        path: a NetCDF file, such as :meth:`.Recording.write` and ``filtergym record`` write; a table (CSV,
            NetCDF, Parquet, JSON) with the columns of the environment, :class:`.LogFormat`; or a log of
            a receiver (:mod:`.receiver_logs`), ``.pos``, ``.nmea``, ``.ulg`` or ``.bag``, for ManeuveringTarget. A
            folder, a pattern such as ``"plots/*.csv"``, or a sequence of these: several files make one recording, and
            the notes name a broken file, which is skipped.
        environment: id of the environment; default: the one in the file.
        speeds: limits of the median speed, m/s, outside which a recording is an error. The lowest holds in
            ManeuveringTarget only.
        truth: path of a separate file of the truth, a table or a log of a receiver, matched by time; a note gives the
            number of rows with a truth. For tables.
        truth_offset: offset added to the times of that file, s.
        rename: names for columns of a table that have others, such as ``{"t": "time", "pos": "x"}``; one
            column may have several, ``{"accuracy": ["sigma_x", "sigma_y"]}``, and ``{"speed": "-"}`` ignores one.
        sort: sort the rows of tables by time; a note gives the number of rows that were out of order.
        **keywords: parameters of the environment that override those of the file.

    Returns:
        A recording for the argument ``scenario``: every episode replays one track.

    Raises:
        ValueError: if the file cannot be read, or does not fit the environment.
    """
    several = list(path) if isinstance(path, list | tuple) else [path]
    if not several:
        raise ValueError("name at least one file of recordings, got none")
    cls = None if environment is None else import_task(environment)
    if cls is not None:
        check_names(cls, keywords)
    files = [file for one in several for file in files_of(one)]
    true = None if truth is None else TruthFile(Path(truth), truth_offset, sort)
    found: list[Recording] = []
    left_out: list[str] = []
    for file in files:
        try:
            found.append(_read_recording(file, cls, speeds, keywords, true, rename, sort))
            cls = cls or task_class(found[0].environment)
        except Exception as error:  # readers raise any error for a broken file
            reason = " ".join(str(error).split()) or type(error).__name__
            if len(files) == 1:
                raise ValueError(f"recording {file}: {reason}") from error
            left_out.append(f"{file.name}: left out: {reason}")
    if not found:
        further = f"; and {len(left_out) - 3} more" if len(left_out) > 3 else ""
        raise ValueError(f"nothing of {str(path)!r} can be replayed: {'; '.join(left_out[:3])}{further}")
    if len(files) == 1:
        return found[0]
    name = str(path) if not isinstance(path, list | tuple) else f"{len(files)} files"
    return join_recordings(found, name, left_out)


def _read_recording(
    file: Path,
    cls: type[Task] | None,
    speeds: tuple[float, float],
    keywords: Mapping[str, Any],
    truth: TruthFile | None,
    rename: Mapping[str, str | Sequence[str]] | None,
    sort: bool,
) -> Recording:
    if not file.exists():
        raise ValueError("there is no such file")
    if names_environment(file):
        if truth is not None:
            raise ValueError(
                "a recording in NetCDF holds its own truth: --truth is for tables and logs of receivers"
            )
        if rename or sort:
            option, why = ("--rename", "names its own variables") if rename else ("--sort", "is in order")
            raise ValueError(f"a recording in NetCDF {why}: {option} is for tables")
        recording = read_netcdf(file, task_class, None if cls is None else cls.id, keywords)
    elif cls is None:
        raise ValueError(
            "it does not name its environment: give its id, as the argument environment or before --recording"
        )
    else:
        recording = read_columns(file, cls, keywords, truth, rename, sort)
    task = make_task(cls or task_class(recording.environment), recording)
    notes = check_recording(recording, task, speeds)
    return dataclasses.replace(recording, notes=(*recording.notes, *notes))


def _holds_recording(scenario: Any) -> bool:
    if isinstance(scenario, Mapping):
        return "measurements" in scenario
    return isinstance(scenario, str | Path) and is_recording(scenario)


def _read_recording_of(scenario: Any, cls: type[Task]) -> ScenarioData:
    return recording_from(scenario) if isinstance(scenario, Mapping) else read_recording(scenario, cls.id)


def _read_flights_of(scenario: Any, cls: type[Task]) -> ScenarioData:
    if not isinstance(scenario, Mapping):
        return read_flights(scenario)
    return flights_from(scenario) if "trajectories" in scenario else trajectory_of(scenario)


RECORDINGS = Reader(_holds_recording, _read_recording_of)
FLIGHTS = Reader(
    lambda scenario: isinstance(scenario, Mapping) or names_flights(scenario),
    _read_flights_of,
    TRAFFIC,
    FLIGHT_SUFFIXES,
)
