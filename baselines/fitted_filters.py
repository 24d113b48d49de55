"""Files of fitted filters: what was fitted to a recording, to be evaluated on others."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..evaluation.files import write_text
from ..evaluation.stored import fits, read_json
from .fitting import NOISE_SCALE, Fit, Interval, with_noise_scale
from .problem import Problem
from .table import Tunable, tunable
from .tuned_values import TunedPolicy, check_values, make_tuned_policy, round_value

SUFFIX = ".filter.json"
"""Of the names of such files."""


def families_of(problem: Problem, recording: Any = None) -> dict[str, Tunable]:
    """Return the filters of a problem that can be fitted to a recording, by name.

    Args:
        problem: whose they are.
        recording: that sets the limits; None: any.
    """
    known = problem.baselines
    if known.log_families is not None:
        return dict(known.log_families(recording))
    # Whether their parameters may be arrays, nobody says.
    found = {name: tunable for name, tunable in known.tunable.items() if tunable.control is None}
    return {name: replace(tunable, in_lanes=False) for name, tunable in found.items()}


def own_family(name: str, cls: Any) -> Tunable:
    """Return what can be fitted in an estimator of a user's own.

    Args:
        name: of it, in errors.
        cls: its class, with an attribute ``parameters``: by the name of each keyword lower limit, value in force and
            upper limit. What is named ``log10_...`` is the logarithm of the keyword. Where ``lane_parameters`` is true,
            values may be arrays ``(N,)``, and candidates run side by side.

    Raises:
        ValueError: if it has none, or values that are no limits.
    """
    declared = getattr(cls, "parameters", None)
    if not (isinstance(cls, type) and isinstance(declared, Mapping) and declared):
        raise ValueError(
            f"{name!r} has nothing to fit: give its class an attribute parameters, such as "
            "{'acceleration': (0.01, 1.0, 10.0)}: lower limit, value in force, upper limit"
        )
    for key, limits in declared.items():
        if not (isinstance(limits, tuple) and len(limits) == 3 and limits[0] <= limits[1] <= limits[2]):
            raise ValueError(
                f"{name!r}: {key} needs lower limit, value in force and upper limit, in this order, got {limits!r}"
            )
    return replace(tunable(cls, **declared), in_lanes=bool(getattr(cls, "lane_parameters", False)))


def write_fitted(
    path: Path, problem: Problem, name: str, found: Fit, intervals: Mapping[str, Interval], command: str
) -> None:
    """Write a fitted filter.

    Args:
        path: of the file, whose name ends in ``SUFFIX``.
        problem: of the filter.
        name: of its family.
        found: of the fit.
        intervals: of its parameters.
        command: that made it.
    """
    table = {
        "environment": problem.id,
        "filter": name,
        "values": {key: round_value(value) for key, value in found.values.items()},
        "intervals": {
            key: [round_value(each.low), round_value(each.high)] for key, each in intervals.items()
        },
        "measurements": found.measurements,
        "command": command,
    }
    write_text(path, json.dumps(table, indent=1) + "\n")


def read_fitted(path: Path, problem: Problem) -> TunedPolicy:
    """Return what makes a fitted filter.

    Args:
        path: of a file of :func:`write_fitted`.
        problem: in which it is to run.

    Raises:
        ValueError: if the file cannot be read, or is of another environment or no filter of it.
    """
    try:
        table = read_json(path)
    except FileNotFoundError:
        raise ValueError(f"there is no file {path}") from None
    known = {"environment": str, "filter": str, "values": dict[str, float]}
    if not isinstance(table, dict) or not all(fits(table.get(key), kind) for key, kind in known.items()):
        raise ValueError(f"{path} is no fitted filter: filtergym advise writes one")
    if table["environment"] != problem.id:
        raise ValueError(f"{path} is fitted to {table['environment']}, not to {problem.id}")
    families = families_of(problem)
    if table["filter"] not in families:
        raise ValueError(f"{path}: {problem.id} has no filter {table['filter']!r} that can be fitted")
    family = families[table["filter"]]
    values = table["values"]
    if NOISE_SCALE in values:
        log_format = problem.task.log_format
        if log_format is None or log_format.scale_noise is None:
            raise ValueError(f"{path}: measurements of {problem.id} state no deviations that could be scaled")
        family = with_noise_scale(family, log_format.scale_noise)
    if values.keys() != family.limits.keys():
        raise ValueError(
            f"{path} must give {table['filter']!r} a number for each of {', '.join(family.limits)}, got "
            f"{', '.join(values):.200}"
        )
    try:
        values = check_values(values, family)
    except ValueError as error:
        raise ValueError(f"{path}: filter {table['filter']!r}: {error}") from error
    return make_tuned_policy(f"{problem.id} fitted {table['filter']}", family, values)
