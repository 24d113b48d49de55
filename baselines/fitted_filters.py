"""Files of advised filters: a fitted or shipped filter, and the options for reading its logs."""

import importlib.metadata
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy

from ..envs.contract.companions import find_companion
from ..envs.contract.log_format import LogFormat, LogSetup
from ..envs.contract.parameters import quote_shortened
from ..evaluation.competitors.kinds import Competitor, CompetitorFiles
from ..evaluation.storage.files import write_text
from ..evaluation.storage.stored import has_type, read_json
from .fitting import NOISE_SCALE, OUTLIER_SHARE, Fit, Interval, with_noise_scale, with_outliers
from .problem import Problem
from .table import Tunable, tunable
from .tuned_values import TunedPolicy, check_values, make_tuned_policy, round_value

SUFFIX = ".filter.json"
"""Suffix of the names of advised filters' files."""
MOST_MEASUREMENTS = 100_000
"""Largest number of measurements of a track that a file may state; an export simulates as many."""


def families_of(problem: Problem, recording: Any = None) -> dict[str, Tunable]:
    """Return the filter families of an environment that can be fitted to a recording, by name."""
    known = problem.baselines
    if known.log_families is not None:
        return dict(known.log_families(recording))
    return {name: tunable for name, tunable in known.tunable.items() if tunable.control is None}


def own_family(name: str, cls: Any) -> Tunable:
    """Return a user's estimator as a family whose parameters can be fitted.

    Args:
        name: name of the estimator in errors.
        cls: its class, with an attribute ``parameters``: by the name of each keyword lower limit, value in force and
            upper limit. A parameter named ``log10_...`` is the logarithm of the keyword. Where ``lane_parameters`` is
            true, values may be arrays ``(N,)``, and candidates run side by side.

    Raises:
        ValueError: if it has no parameters, or values that are no limits.
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


class Artefact(NamedTuple):
    """Content of an advised filter's file: name of the family, maker of the filter, and options for its log."""

    filter: str
    """Name of the family, or of the shipped filter."""
    fitted: TunedPolicy | None
    """Maker of the filter; None for a shipped one."""
    log: LogSetup | None
    """Options for reading its log; None in files without them."""


def log_setup(problem: Problem, recording: Any) -> LogSetup:
    """Return the options with which a recording was read, so that such a log can be read again."""
    parameters = recording.scenario(problem.task, {}).parameters
    left_out = "horizon", "decision_interval"
    deviations, source = dict(recording.deviations), recording.deviations_from
    if not deviations and "variance" in recording.measurements:
        there = recording.measurements["available"] > 0.0
        usual = numpy.sqrt(numpy.median(recording.measurements["variance"][there], axis=0))
        deviations = {f"sigma_{axis}": float(each) for axis, each in zip("xy", usual, strict=True)}
        source = "median of the recording"
    return LogSetup(
        float(f"{numpy.nanmedian(numpy.diff(recording.seconds, axis=1)):.9g}"),
        {name: value for name, value in parameters.items() if name not in left_out},
        dict(recording.columns),
        {name: round_value(value) for name, value in deviations.items()},
        source,
        dict(recording.origin),
        min(int(recording.rows.max()), MOST_MEASUREMENTS),
    )


def write_advised(
    path: Path,
    problem: Problem,
    name: str,
    recording: Any,
    fit: Fit | None,
    intervals: Mapping[str, Interval],
    command: str,
    **further: Any,
) -> None:
    """Write the file of an advised filter, fitted or shipped, with the options for reading its log.

    Args:
        path: path of the file, whose name ends in ``SUFFIX``.
        problem: problem of the filter.
        name: name of its family, or of the shipped filter.
        recording: recording on which it was fitted or judged.
        fit: result of the fit; None for a shipped filter.
        intervals: intervals of its parameters.
        command: command that wrote it.
        **further: further entries of the file, such as its held-out numbers.
    """
    log = log_setup(problem, recording)
    log_format = find_companion(problem.task, LogFormat)
    known = log_format.columns if log_format else {}
    seconds = recording.seconds
    table: dict[str, Any] = {
        "environment": problem.id,
        "filter": name,
        "fitted": fit is not None,
        "values": {} if fit is None else {key: round_value(value) for key, value in fit.values.items()},
        "intervals": {
            key: [round_value(each.low), round_value(each.high)] for key, each in intervals.items()
        },
        "measurements": None if fit is None else fit.measurements,
        "log": {
            **log._asdict(),
            "units": {key: known[key].text for key in log.columns if key in known},
            "noise_scale": 1.0 if fit is None else round_value(10.0 ** fit.values.get(NOISE_SCALE, 0.0)),
            "outlier_share": round_value(10.0 ** fit.values[OUTLIER_SHARE])
            if fit is not None and OUTLIER_SHARE in fit.values
            else None,
            "start": "from the first row"
            if log_format and log_format.regular_rows
            else "from the first two measurements: the second, and their difference over the time between them",
            "ranges": {
                "measurements": int(recording.rows.sum()),
                "seconds": round_value(float(numpy.nanmax(seconds))),
                "interval": [
                    round_value(float(edge(numpy.diff(seconds, axis=1))))
                    for edge in (numpy.nanmin, numpy.nanmax)
                ],
            },
        },
        **further,
        "version": importlib.metadata.version("filtergym"),
        "command": command,
    }
    write_text(path, json.dumps(table, indent=1) + "\n")


def read_artefact(path: Path, problem: Problem) -> Artefact:
    """Read the file of an advised filter.

    Raises:
        ValueError: if the file cannot be read, or is of another environment or no filter of it.
    """
    try:
        table = read_json(path)
    except FileNotFoundError:
        raise ValueError(f"there is no file {path}") from None
    known = {"environment": str, "filter": str, "values": dict[str, float]}
    if not isinstance(table, dict) or not all(has_type(table.get(key), kind) for key, kind in known.items()):
        raise ValueError(f"{path} is not the file of an advised filter: filtergym advise writes one")
    if table["environment"] != problem.id:
        raise ValueError(f"{path} is fitted to {quote_shortened(table['environment'])}, not to {problem.id}")
    fitted = table.get("fitted", True)
    if fitted not in (True, False):
        raise ValueError(f"{path}: fitted must be true or false, got {quote_shortened(fitted)}")
    made = _make_fitted(path, problem, table["filter"], table["values"]) if fitted else None
    return Artefact(table["filter"], made, _read_setup(path, problem, table.get("log")))


def _read_setup(path: Path, problem: Problem, log: Any) -> LogSetup | None:
    """Validate the log options in a file's entry; None without an entry."""
    if log is None:
        return None
    kinds = {
        "interval": float,
        "parameters": dict[str, Any],
        "columns": dict[str, str],
        "deviations": dict[str, float],
        "deviations_from": str,
        "origin": dict[str, float],
        "horizon": int,
    }
    if isinstance(log, dict):
        log = {"origin": {}, "horizon": 0, **log}  # files of older versions lack them
    log_format = find_companion(problem.task, LogFormat)
    names = {
        "time",
        "recording",
        "latitude",
        "longitude",
        "altitude",
        *(log_format.columns if log_format else ()),
    }
    if (
        not isinstance(log, dict)
        or not all(has_type(log.get(key), kind) for key, kind in kinds.items())
        or not 0.0 < log["interval"] < math.inf
        or not {*log["columns"], *log["deviations"]} <= names
        or not all(0.0 < value < math.inf for value in log["deviations"].values())
        or not 0 <= log["horizon"] <= MOST_MEASUREMENTS
        or not (not log["origin"] or _is_valid_origin(log["origin"]))
    ):
        raise ValueError(f"{path}: its entry on the log is invalid: write it again with filtergym advise")
    try:
        problem.task.Parameters(**log["parameters"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: parameters of its log: {error}") from error
    return LogSetup(**{key: log[key] for key in kinds})


def _is_valid_origin(origin: Mapping[str, float]) -> bool:
    largest = {"latitude": 90.0, "longitude": 360.0, "altitude": 1e6}
    return origin.keys() == largest.keys() and all(abs(origin[key]) <= most for key, most in largest.items())


def _make_fitted(path: Path, problem: Problem, name: str, values: Mapping[str, float]) -> TunedPolicy:
    families = families_of(problem)
    if name not in families:
        raise ValueError(f"{path}: {problem.id} has no filter {name!r} that can be fitted")
    family = families[name]
    for wrapped, wrap in ((OUTLIER_SHARE, with_outliers), (NOISE_SCALE, with_noise_scale)):
        if wrapped in values:
            log_format = find_companion(problem.task, LogFormat)
            if log_format is None or log_format.scale_noise is None:
                raise ValueError(
                    f"{path}: measurements of {problem.id} state no deviations that could be scaled"
                )
            family = wrap(family, log_format.scale_noise)
    if values.keys() != family.limits.keys():
        raise ValueError(
            f"{path} must give {name!r} a number for each of {', '.join(family.limits)}, got "
            f"{quote_shortened([*values])}"
        )
    try:
        values = check_values(values, family)
    except ValueError as error:
        raise ValueError(f"{path}: filter {name!r}: {error}") from error
    return make_tuned_policy(f"{problem.id} fitted {name}", family, values)


def _find_advised(
    name: str, problem: Problem, trust: bool, find_shipped: Callable[[str, str], Competitor]
) -> Competitor | None:
    """Return the filter in a file of ``filtergym advise`` as a competitor; None for another file."""
    if not name.endswith(SUFFIX):
        return None
    found = read_artefact(Path(name), problem)
    if found.fitted is not None:
        return Competitor(name, found.fitted, log=found.log)
    shipped = find_shipped(found.filter, f"shipped filter (named by {name})")
    return Competitor(name, shipped.maker, log=found.log)


ADVISED = CompetitorFiles(_find_advised, (SUFFIX,))
