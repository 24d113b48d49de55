"""Construction of a task from names and keywords, and choice of its scenario."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy

from ..contract.parameters import quote_shortened
from ..contract.task import Scenario, Task
from ..data.scenario_data import ScenarioData, readers
from .catalogue import check_names, nearest

ScenarioChoice = str | Path | ScenarioData | Sequence[Any] | Mapping[str, Any] | None
"""Choice of a scenario: a name, files of flights, trajectories or their fields, or None for the environment's own."""

MIXTURE = re.compile(r"[^:,]+:[^:,]+(,[^:,]+:[^:,]+)*")
"""A mixture in words: ``random:0.8,paper:0.2``."""


def _is_name(cls: type[Task], scenario: str) -> bool:
    if scenario in cls.scenarios:
        return True
    prefixes = [one.prefix for one in readers() if one.prefix and scenario.startswith(one.prefix)]
    return any(prefix.removesuffix(":") not in cls.scenarios for prefix in prefixes)


def find_mixture(cls: type[Task], scenario: Any) -> dict[str, float] | None:
    """Return the weights by scenario name, summing to one, of a mixture of scenarios; None if it is no mixture.

    Args:
        cls: the environment.
        scenario: a mixture maps names of scenarios to weights, ``{"random": 0.8, "paper": 0.2}``, or is written in
            words, ``"random:0.8,paper:0.2"``. A weight of zero leaves a scenario out.

    Raises:
        ValueError: for an unknown scenario, and for invalid weights.
    """
    if isinstance(scenario, Mapping):
        given = dict(scenario)
        if not given or not all(isinstance(weight, int | float | numpy.number) for weight in given.values()):
            return None
    elif isinstance(scenario, str) and MIXTURE.fullmatch(scenario) and not _is_name(cls, scenario):
        pairs = [part.split(":") for part in scenario.split(",")]
        endings = [ending for one in readers() for ending in one.endings]
        if Path(pairs[-1][1]).suffix in endings:  # of a file on a drive with a letter
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
    """Return the flights or the recording in a path's files; return any other choice of a scenario unchanged.

    Args:
        cls: the environment.
        scenario: as :func:`find_scenario` takes it; the name of one of the environment's own scenarios is no file.

    Raises:
        ValueError: if the files contain neither.
    """
    if scenario is None or (isinstance(scenario, str) and scenario in cls.scenarios):
        return scenario
    if isinstance(scenario, Mapping) and find_mixture(cls, scenario) is not None:
        return scenario
    items = scenario if isinstance(scenario, list | tuple) else [scenario]
    if any(isinstance(item, str) and item in cls.scenarios for item in items):
        return scenario
    for reader in readers():
        if reader.takes(scenario):
            return reader.read(scenario, cls)
    return scenario


def find_scenario(
    cls: type[Task],
    scenario: ScenarioChoice | Scenario,
    keywords: Mapping[str, Any] | None = None,
) -> Scenario:
    """Return the :class:`Scenario` that a user chooses by a name, flights or a recording.

    Args:
        cls: the environment.
        scenario: a name; a trajectory (also as a dictionary of its fields, as it comes out of JSON); a set of
            flights as :func:`~.flights.read_flights` takes it, or returns it; a recording, or a NetCDF file of one; or
            a scenario.
        keywords: parameters given beside it; a trajectory is sampled at their ``sampling_interval``.

    Raises:
        ValueError: for an unknown scenario or parameter, or a file without a trajectory.
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
    if isinstance(scenario, ScenarioData):
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
    """Return a task with a scenario and parameters, its arrays in a namespace.

    Args:
        cls: the class of tasks.
        scenario: as :func:`find_scenario` takes it.
        xp: array namespace, NumPy or ``array_api_compat.torch``.
        device: device of the arrays of a torch task.
        **keywords: parameters of the task. A keyword wins over the scenario, the scenario over the default.

    Raises:
        ValueError: for an unknown name or a parameter out of its limits.
    """
    chosen = find_scenario(cls, scenario, keywords)
    return cls(cls.Parameters(**{**chosen.parameters, **keywords}), xp, device, chosen.recording)
