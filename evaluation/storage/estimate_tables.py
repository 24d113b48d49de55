"""Estimates of another program, read from CSV, NetCDF or a trajectory file (TUM RGB-D).

A row is an estimate: its track, its time in seconds, the mean of each component, and optionally its covariance. The
columns are those that ``filtergym evaluate --estimates`` and the programs of ``filtergym export`` write:

    track (or recording, episode)      name of the track; left out where there is one track
    seconds (or time, t), log_time     time of the log, or s since the start of the track; see below
    estimate_X (or mean_X, X)          mean of the component X, in its unit
    sigma_X                            its standard deviation; or
    covariance_X_Y                     of two components, in either order; zero where a pair is left out
    log_likelihood, nis, nis_degrees   statistics of the predicted measurement

Times are read as in a log: seconds, a smaller unit since 1970, dates, or times of day.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy

from ...envs.contract.parameters import quote_shortened
from ...envs.data.foreign_files import MOST_NUMBERS, read_content
from ...envs.logs.flight_tables import clock_seconds, list_names, numbers, open_netcdf, read_table

SUFFIXES = (".csv", ".nc", ".parquet", ".tum")
TRACK = ("track", "recording", "episode")
SECONDS = ("seconds", "time", "t")
LOG_TIME = "log_time"
LIKELIHOOD = ("log_likelihood", "nis", "nis_degrees")
AXES = ("position_x", "position_y", "position_z")
"""Names of the components of a position; a trajectory has the first two or all three."""


class EstimateTable(NamedTuple):
    """Estimates of C components for all tracks of a file, in R rows."""

    track: numpy.ndarray
    """Name of the track of each row, ``(R,)``; empty strings where the file names none."""
    time: numpy.ndarray
    """Time by ``clock``, s, ``(R,)``."""
    clock: str
    """Clock of the times: ``dates`` in s since 1970, ``times of day`` since midnight, ``seconds``, or ``log``: seconds
    of the log."""
    mean: numpy.ndarray
    """Means, ``(C, R)``; NaN for a component that the file does not contain."""
    known: tuple[bool, ...]
    """Whether the file contains each component, ``(C,)``."""
    deviations: tuple[bool, ...]
    """Whether the file contains a variance of each component, ``(C,)``."""
    covariance: numpy.ndarray
    """Covariances, ``(C, C, R)``; NaN for components without a variance."""
    likelihood: Mapping[str, numpy.ndarray]
    """Columns of the file among :data:`LIKELIHOOD`, ``(R,)`` each."""


def read_estimates(path: Path, components: Sequence[str]) -> EstimateTable:
    """Read the estimates of one competitor from a file, or from a folder of trajectories.

    Args:
        path: path of the file; a folder contains ``NAME.TRACK.tum``, a file for each track.
        components: names of the estimated components.

    Raises:
        ValueError: if it cannot be read, has no estimates, or those of several competitors.
    """
    try:
        if path.suffix not in SUFFIXES:
            raise ValueError(f"estimates are in files that end in {', '.join(SUFFIXES)}")
        if not path.exists():
            raise ValueError("there is no such file")
        if path.suffix == ".tum":
            return _trajectories(path, components)
        columns = _netcdf_columns(path) if path.suffix == ".nc" else _table_columns(path, components)
        return _of_columns(columns, components)
    except ValueError as error:
        raise ValueError(f"cannot read the estimates {str(path)!r}: {error}") from error


def _table_columns(path: Path, components: Sequence[str]) -> dict[str, Any]:
    """Read a CSV or Parquet table; return its columns by name, numbers, or text for tracks and times."""
    pairs = [f"covariance_{a}_{b}" for a in components for b in components]
    forms = [form + name for name in components for form in ("estimate_", "mean_", "sigma_", "")]
    columns, names, _ = read_table(path, {*TRACK, *SECONDS, LOG_TIME, "policy", *LIKELIHOOD, *forms, *pairs})
    if not len(columns):
        raise ValueError(f"it contains no rows of known columns; it has {list_names(names) or 'none'}")
    words = (*TRACK, *SECONDS, LOG_TIME, "policy")
    return {
        str(name): values if name in words else numbers(str(name), values).to_numpy()
        for name, values in columns.items()
    }


def _netcdf_columns(path: Path) -> dict[str, Any]:
    """Read a NetCDF file of estimates as a flat table; return its columns by name.

    The variables are over episode, time and component, and optionally over one policy.
    """
    import pandas

    with open_netcdf(path, decode_times=False) as data:
        if sum(variable.size for variable in data.variables.values()) > MOST_NUMBERS:
            raise ValueError(f"it contains more than {MOST_NUMBERS:,} numbers: split it")
        if data.sizes.get("policy", 1) > 1:
            raise _several(data["policy"].values.tolist())
        data = data.isel(policy=0) if "policy" in data.dims else data
        data = data if "episode" in data.dims else data.expand_dims("episode")
        if not {"seconds", "component"} <= {*data.variables} or "time" not in data.dims:
            raise ValueError("it needs seconds over episode and time, and the coordinate component")
        rows = (data.sizes["episode"], data.sizes["time"])
        names = [str(name) for name in data["component"].values]

        def flat(values: Any) -> numpy.ndarray:
            return numpy.asarray(numpy.broadcast_to(values, rows).reshape(-1), dtype=float)

        def of(variable: str, *further: str) -> numpy.ndarray:
            return data[variable].transpose("episode", "time", *further).values

        found: dict[str, Any] = {"seconds": flat(data["seconds"].transpose(..., "time").values)}
        tracks = data["recording"].values if "recording" in data.variables else numpy.arange(rows[0])
        found["track"] = pandas.Series(numpy.repeat(tracks.astype(str), rows[1]))
        for variable in ({"estimate", "mean"} & {*data.variables}) | ({"sigma"} & {*data.variables}):
            form = "sigma_" if variable == "sigma" else "estimate_"
            found |= {
                form + name: flat(values)
                for name, values in zip(names, numpy.moveaxis(of(variable, "component"), -1, 0), strict=True)
            }
        if "covariance" in data:
            whole = of("covariance", "component", "other_component")
            found |= {
                f"covariance_{a}_{b}": flat(whole[..., i, j])
                for i, a in enumerate(names)
                for j, b in enumerate(names)
            }
        found |= {name: flat(of(name)) for name in LIKELIHOOD if name in data}
    # After the end of a shorter episode there is neither time nor estimate.
    there = numpy.isfinite(found["seconds"])
    return {name: values[there] for name, values in found.items()}


def _several(names: Sequence[str]) -> ValueError:
    return ValueError(f"it contains estimates of several competitors, {list_names(names)}: keep those of one")


def _of_columns(columns: Mapping[str, Any], components: Sequence[str]) -> EstimateTable:
    import pandas

    if "policy" in columns and len(names := sorted({*map(str, columns["policy"])})) > 1:
        raise _several(names)
    found = {}
    for name in components:
        form = next((form for form in ("estimate_", "mean_", "") if form + name in columns), None)
        if form is not None:
            found[name] = columns[form + name]
    if not found:
        raise ValueError(f"it contains no estimate of {', '.join(components)}: name the columns estimate_X")
    time_name = next((name for name in (LOG_TIME, *SECONDS) if name in columns), None)
    if time_name is None:
        raise ValueError("it needs a column seconds, the time since the start of the track")
    clock, time = clock_seconds(pandas.Series(columns[time_name]))
    track = next((columns[name] for name in TRACK if name in columns), None)
    rows = len(time)
    mean = numpy.full((len(components), rows), numpy.nan)
    for i, name in enumerate(components):
        mean[i] = found.get(name, numpy.nan)
    return EstimateTable(
        numpy.full(rows, "") if track is None else numpy.array([*map(_track_name, track)], dtype=str),
        time,
        "log" if time_name == LOG_TIME and clock == "seconds" else clock,
        mean,
        tuple(name in found for name in components),
        *_covariance(columns, components, rows),
        {name: columns[name] for name in LIKELIHOOD if name in columns},
    )


def _track_name(value: Any) -> str:
    """Return the name of a track as text, "3" for 3.0."""
    text = str(value).strip()
    return text.removesuffix(".0") if text.removesuffix(".0").isdigit() else text


def _covariance(
    columns: Mapping[str, Any], components: Sequence[str], rows: int
) -> tuple[tuple[bool, ...], numpy.ndarray]:
    """Return which components have a variance, and covariances ``(C, C, R)``, from the columns of a table.

    NaN for components without a variance, zero for pairs without a covariance.
    """
    count = len(components)
    found = numpy.full((count, count, rows), numpy.nan)
    for i, a in enumerate(components):
        for j, b in enumerate(components):
            pair = next((c for c in (f"covariance_{a}_{b}", f"covariance_{b}_{a}") if c in columns), None)
            if pair is not None:
                found[i, j] = columns[pair]
        if f"sigma_{a}" in columns and numpy.isnan(found[i, i]).all():
            found[i, i] = columns[f"sigma_{a}"] ** 2
    stated = tuple(not numpy.isnan(found[i, i]).all() for i in range(count))
    both = numpy.logical_and.outer(stated, stated)[:, :, None]
    absent = both & numpy.isnan(found).all(axis=2, keepdims=True)
    return stated, numpy.where(absent, 0.0, found)


def _trajectories(path: Path, components: Sequence[str]) -> EstimateTable:
    """Read the positions of one TUM file, or of a folder with one for each track, as a table of estimates."""
    import pandas

    axes = [components.index(name) for name in AXES if name in components]
    if len(axes) < 2:
        raise ValueError("a trajectory is of the components position_x and position_y, and there are none")
    files = [path] if path.is_file() else sorted(path.glob("*.tum"))
    files = [file for file in files if not file.name.startswith("truth.")]
    owners = {file.name.removesuffix(".tum").rpartition(".")[0] for file in files}
    if path.is_dir() and len(owners) > 1:
        raise _several(sorted(owners))
    if not files:
        raise ValueError("it holds no trajectories")
    tracks, rows = [], []
    for file in files:
        own = _trajectory(file)
        name = "" if path.is_file() else file.name.removesuffix(".tum").rpartition(".")[2]
        tracks += [name] * len(own)
        rows.append(own)
    table = numpy.concatenate(rows)
    mean = numpy.full((len(components), len(table)), numpy.nan)
    mean[axes] = table[:, 1 : 1 + len(axes)].T
    known = tuple(i in axes for i in range(len(components)))
    silent, none = (False,) * len(components), numpy.full((*2 * [len(components)], len(table)), numpy.nan)
    clock, time = clock_seconds(pandas.Series(table[:, 0]))
    return EstimateTable(numpy.array(tracks, dtype=str), time, clock, mean, known, silent, none, {})


def _trajectory(file: Path) -> numpy.ndarray:
    """Read time and position of every line of a TUM file, ``(rows, 4)``, s and m."""
    found = []
    for number, line in enumerate(read_content(file).decode("utf-8").splitlines()):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != 8 or not numpy.isfinite(values[:4]).all():
            raise ValueError(f"line {number + 1} of {file.name} is no pose: {quote_shortened(line)}")
        found.append(values[:4])
    if not found:
        raise ValueError(f"{file.name} contains no poses")
    return numpy.array(found)
