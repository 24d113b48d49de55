"""How a task is made from names and keywords: what a user may give as scenario."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy

from ..contract.companions import FlightScenarios, find_companion
from ..contract.parameters import quote_shortened
from ..contract.task import Scenario, Task
from ..data.flight_tables import FLIGHT_SUFFIXES
from ..data.flights import TRAFFIC, Flights, files_of, flights_from, names_flights, read_flights
from ..data.plausibility import check_recording
from ..data.recorded_tables import TruthFile, read_columns
from ..data.recording import Recording, join_recordings, recording_from
from ..data.recording_files import is_recording, names_environment, read_netcdf
from ..data.trajectory import Trajectory, trajectory_of
from .catalogue import check_names, import_task, nearest, task_class

ScenarioChoice = str | Path | Trajectory | Flights | Recording | Sequence[Any] | Mapping[str, Any] | None
"""What names a scenario: a name, files of flights, trajectories or their fields, or None for the environment's own."""

MIXTURE = re.compile(r"[^:,]+:[^:,]+(,[^:,]+:[^:,]+)*")
"""A mixture in words: ``random:0.8,paper:0.2``."""


def _is_name(cls: type[Task], scenario: str) -> bool:
    return scenario in cls.scenarios or (scenario.startswith(TRAFFIC) and "traffic" not in cls.scenarios)


def find_mixture(cls: type[Task], scenario: Any) -> dict[str, float] | None:
    """Return the weights of a mixture of scenarios, which sum to one; None for a choice that is no mixture.

    Args:
        cls: the environment.
        scenario: a mixture maps names of scenarios to weights, ``{"random": 0.8, "paper": 0.2}``, or says so in words,
            ``"random:0.8,paper:0.2"``. A weight of zero leaves a scenario out.

    Raises:
        ValueError: for an unknown scenario, and for weights that are none.
    """
    if isinstance(scenario, Mapping):
        given = dict(scenario)
        if not given or not all(isinstance(weight, int | float | numpy.number) for weight in given.values()):
            return None
    elif isinstance(scenario, str) and MIXTURE.fullmatch(scenario) and not _is_name(cls, scenario):
        pairs = [part.split(":") for part in scenario.split(",")]
        if Path(pairs[-1][1]).suffix in FLIGHT_SUFFIXES:  # of a file on a drive with a letter
            return None
        given = {}
        for name, weight in pairs:
            if name.strip() in given:
                raise ValueError(f"a mixture names each scenario once, got {scenario!r}")
            try:
                given[name.strip()] = float(weight)
            except ValueError:
                raise ValueError(
                    f"a mixture in words is scenario:weight,scenario:weight, got {scenario!r}"
                ) from None
    else:
        return None
    for name in given:
        if name not in cls.scenarios:
            raise nearest("scenario", name, cls.scenarios)
    weights = {name: float(weight) for name, weight in given.items()}
    total = sum(weights.values())
    if (
        any(isinstance(w, bool) for w in given.values())
        or min(weights.values()) < 0.0
        or not 0.0 < total < math.inf
    ):
        raise ValueError(
            f"weights of a mixture are numbers of at least 0, and one is above, got {scenario!r}"
        )
    return {name: weight / total for name, weight in weights.items() if weight > 0.0}


def read_files(cls: type[Task], scenario: Any) -> Any:
    """Return flights or a recording in place of what names them, so that files are read once; anything else as it is.

    Args:
        cls: the environment.
        scenario: as :func:`find_scenario` takes it; a name of one of the environment's own is no file.

    Raises:
        ValueError: if the files hold neither.
    """
    if scenario is None or (isinstance(scenario, str) and scenario in cls.scenarios):
        return scenario
    if isinstance(scenario, Mapping):
        if find_mixture(cls, scenario) is not None:
            return scenario
        if "measurements" in scenario:
            return recording_from(scenario)
        return flights_from(scenario) if "trajectories" in scenario else trajectory_of(scenario)
    items = scenario if isinstance(scenario, list | tuple) else [scenario]
    if any(isinstance(item, str) and item in cls.scenarios for item in items):
        return scenario
    if isinstance(scenario, str | Path) and is_recording(scenario):
        return read_recording(scenario, cls.id)
    return read_flights(scenario) if names_flights(scenario) else scenario


def read_recording(
    path: Any,
    environment: str | None = None,
    *,
    speeds: tuple[float, float] = (1.0, 1000.0),
    truth: Any = None,
    truth_offset: float = 0.0,
    rename: Mapping[str, str | Sequence[str]] | None = None,
    **keywords: Any,
) -> Recording:
    """Read recorded measurements, and check whether they can be true (:mod:`.plausibility`).

    Args:
        path: of a NetCDF file, such as :meth:`.Recording.write` and ``filtergym record`` write; or of a table (CSV,
            NetCDF, Parquet, JSON) with the columns that the environment knows, :class:`.LogFormat`, or of a log of
            a receiver (:mod:`.receiver_logs`), ``.pos``, ``.nmea``, ``.ulg`` or ``.bag``, for ManeuveringTarget. A
            folder, a pattern such as ``"plots/*.csv"``, or a sequence of these: several files are one recording, and a
            broken one is left out and named in the notes.
        environment: id of the environment that it is for; default: what the file says.
        speeds: m/s; a recording whose median speed is outside is refused. The lowest holds in ManeuveringTarget only.
        truth: path of the truth in a file of its own, a table or a log of a receiver, matched by time; a note says how
            much of the recording has one. For tables.
        truth_offset: s, added to the times of that file.
        rename: what columns of a table are, where they have other names, such as ``{"t": "time", "pos": "x"}``; one
            column may be several, ``{"accuracy": ["sigma_x", "sigma_y"]}``.
        **keywords: parameters of the environment that win over those of the file.

    Returns:
        What can be given as scenario: every episode replays one recording.

    Raises:
        ValueError: if it cannot be read, or does not fit the environment.
    """
    several = list(path) if isinstance(path, list | tuple) else [path]
    if not several:
        raise ValueError("name at least one file of recordings, got none")
    cls = None if environment is None else import_task(environment)
    if cls is not None:
        check_names(cls, keywords)
    files = [file for one in several for file in files_of(one)]
    true = None if truth is None else TruthFile(Path(truth), truth_offset)
    found: list[Recording] = []
    left_out: list[str] = []
    for file in files:
        try:
            found.append(_read_recording(file, cls, speeds, keywords, true, rename))
            cls = cls or task_class(found[0].environment)
        except Exception as error:  # readers raise whatever a broken file makes them stumble over
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
) -> Recording:
    """Read one file."""
    if not file.exists():
        raise ValueError("there is no such file")
    if names_environment(file):
        if truth is not None:
            raise ValueError(
                "a recording in NetCDF holds its own truth: --truth is for tables and logs of receivers"
            )
        if rename:
            raise ValueError("a recording in NetCDF names its own variables: --rename is for tables")
        recording = read_netcdf(file, task_class, None if cls is None else cls.id, keywords)
    elif cls is None:
        raise ValueError(
            "it does not say of which environment it is: give its id, as the argument environment or before --recording"
        )
    else:
        recording = read_columns(file, cls, keywords, truth, rename)
    task = make_task(cls or task_class(recording.environment), recording)
    notes = check_recording(recording, task, speeds)
    return dataclasses.replace(recording, notes=(*recording.notes, *notes))


def find_scenario(
    cls: type[Task],
    scenario: ScenarioChoice | Scenario,
    keywords: Mapping[str, Any] | None = None,
) -> Scenario:
    """Return a scenario by name (default: the environment's own), or make one from a user's trajectory.

    Args:
        cls: the environment.
        scenario: a name; a trajectory (also as a dictionary of its fields, as it comes out of JSON); a set of
            flights as :func:`~.flights.read_flights` takes it, or returns it; a recording, or a NetCDF file of one; or
            what was found before.
        keywords: parameters given beside it; a trajectory is sampled at their ``sampling_interval``.

    Raises:
        ValueError: for an unknown scenario or parameter, or a file that holds no trajectory.
    """
    if isinstance(scenario, Scenario):
        return scenario
    check_names(cls, keywords or ())
    if scenario is None or (isinstance(scenario, str) and scenario in cls.scenarios):
        return cls.scenarios[scenario or cls.default_scenario]
    if find_mixture(cls, scenario) is not None:
        raise ValueError(
            "a mixture of scenarios is for gymnasium.make, gymnasium.make_vec and training only: name one scenario, "
            f"got {scenario!r}"
        )
    scenario = read_files(cls, scenario)
    if isinstance(scenario, (Trajectory, Flights)):
        of_flights = find_companion(cls, FlightScenarios)
        if of_flights is None:
            raise ValueError(f"{cls.id} does not take flights as scenario")
        found: Scenario = of_flights.make(scenario, keywords or {})
        return found
    if isinstance(scenario, Recording):
        return scenario.scenario(cls, keywords or {})
    if not isinstance(scenario, str):
        raise ValueError(
            f"a scenario is a name, a Trajectory or the path of a file with one, or a sequence of these, got "
            f"{quote_shortened(scenario)}: "
            f"choose from {', '.join(cls.scenarios)}; a mixture of scenarios is a dictionary of weights"
        )
    raise nearest("scenario", scenario, cls.scenarios)


def make_task(
    cls: type[Task],
    scenario: ScenarioChoice | Scenario = None,
    xp: ModuleType = numpy,
    device: Any = None,
    **keywords: Any,
) -> Task:
    """Make a task.

    Args:
        cls: of which.
        scenario: as :func:`find_scenario` takes it.
        xp: array namespace, NumPy or ``array_api_compat.torch``.
        device: where a torch task keeps its arrays.
        **keywords: parameters of the task. A keyword wins over the scenario, the scenario over the default.

    Raises:
        ValueError: for an unknown name or a parameter out of its limits.
    """
    chosen = find_scenario(cls, scenario, keywords)
    return cls(cls.Parameters(**{**chosen.parameters, **keywords}), xp, device, chosen.recording)
