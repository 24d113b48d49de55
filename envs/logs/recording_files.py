"""Files of recordings: NetCDF with the names of the environment's own measurements.

Dimensions ``episode``, ``time``, ``component``, ``other_component`` and further axes of a measurement. Variables:
every array of the environment's ``Measurement`` by its name, ``(episode, time, ...)``; ``seconds`` ``(episode, time)``,
NaN where an episode has no measurement; ``length`` ``(episode)``; optionally ``truth`` ``(episode, time, component)``;
and the initial estimate of every filter, ``initial_mean``, ``initial_covariance`` and so on. Attributes:
``environment``, ``parameters`` (JSON), ``source``, ``licence``.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy

from ..contract.companions import find_companion
from ..contract.log_format import LogFormat
from ..contract.task import Task
from ..data.foreign_files import MOST_NUMBERS
from ..data.recording import Recording
from .flight_tables import netcdf_attribute_names, open_netcdf

if TYPE_CHECKING:
    import xarray

OWN = ("seconds", "length", "truth", "started")
"""Names of the variables that are not measurements."""


def is_recording(path: Any) -> bool:
    """Return whether a path is a NetCDF file that names the environment of its measurements."""
    try:
        return names_environment(Path(path))
    except Exception:  # the reader of this kind of file reports the error
        return False


def names_environment(path: Path) -> bool:
    """Return whether a file is NetCDF and names an environment; any exception for an invalid file."""
    if path.suffix != ".nc":
        return False
    return "environment" in netcdf_attribute_names(path)


def read_dataset(data: "xarray.Dataset", name: str) -> dict[str, Any]:
    """Return the fields of a :class:`Recording` by name from a dataset; ``initial`` may be missing.

    Raises:
        ValueError: if the dataset is no recording.
    """
    total = sum(variable.size for variable in data.variables.values())
    if total > MOST_NUMBERS:
        raise ValueError(
            f"it holds {total:,} numbers, more than the {MOST_NUMBERS:,} that a recording may have: split it"
        )
    if "seconds" not in data:
        raise ValueError(
            f"it lacks the variable seconds; it has {', '.join(map(str, data.variables)) or 'none'}"
        )
    if "episode" not in data.dims:
        data = data.expand_dims("episode")
    if data["seconds"].dims != ("episode", "time"):
        raise ValueError(f"seconds must have the dimensions episode and time, got {data['seconds'].dims}")
    seconds = data["seconds"].values.astype(float)
    if not seconds.size or not numpy.isfinite(seconds).any():
        raise ValueError("it holds no measurements")
    fields: dict[str, Any] = {"measurements": {}, "initial": {}, "truth": None, "seconds": seconds}
    for key, variable in data.data_vars.items():
        variable_name = str(key)
        if variable.dtype.kind not in "fiub":
            raise ValueError(f"{variable_name} must be numbers, got {variable.dtype}")
        values = variable.values.astype(variable.dtype.newbyteorder("="))
        of_episode = variable_name.startswith("initial_") or variable_name == "started"
        leading = ("episode",) if of_episode else ("episode", "time")
        if variable_name == "length":
            continue
        if variable.dims[: len(leading)] != leading:
            raise ValueError(
                f"{variable_name} must have the dimensions {', '.join(leading)} first, got {variable.dims}"
            )
        if variable_name.startswith("initial_"):
            fields["initial"][variable_name.removeprefix("initial_")] = values
        elif variable_name in ("truth", "started"):
            fields[variable_name] = values.astype(float)
        elif variable_name not in OWN:
            fields["measurements"][variable_name] = values
    rows = seconds.shape[1] - numpy.argmax(numpy.isfinite(seconds[:, ::-1]), axis=1)
    lengths = data["length"].values if "length" in data else rows
    fields["lengths"] = _whole("length", lengths)
    if "recording" in data.coords:
        fields["names"] = tuple(map(str, data["recording"].values.ravel().tolist()))
    elif len(seconds) == 1:
        fields["names"] = (name,)
    if "log_time" in data.coords and data["log_time"].dims == ("episode", "time"):
        times = data["log_time"].values
        fields["log_time"] = times.astype(float) if times.dtype.kind in "fiu" else times.astype(str)
    return fields


def _whole(name: str, values: numpy.ndarray) -> numpy.ndarray:
    if not (numpy.isfinite(values) & (values == numpy.round(values))).all():
        raise ValueError(f"{name} must be whole numbers")
    return values.astype(numpy.int64)


def read_netcdf(path: Path, cls_of: Any, environment: str | None, keywords: Mapping[str, Any]) -> Recording:
    """Return the recording in a NetCDF file, after checks of environment and parameters.

    Args:
        path: that of the file.
        cls_of: function from an environment id to its task.
        environment: required id; None: the one in the file.
        keywords: parameters that override those of the file.

    Raises:
        ValueError: if the file cannot be read, or belongs to another environment.
    """
    with open_netcdf(path, decode_times=False) as data:
        attrs = data.attrs
        cls: type[Task] = cls_of(str(attrs.get("environment", environment)))
        if environment is not None and cls is not cls_of(environment):
            raise ValueError(f"it is of {cls.id}, not of {cls_of(environment).id}")
        try:
            parameters = json.loads(attrs.get("parameters", "{}"))
            if not isinstance(parameters, dict):
                raise TypeError
        except (ValueError, TypeError):
            raise ValueError("its attribute parameters must be a JSON object") from None
        fields = read_dataset(data, path.stem)
    if not fields["initial"]:
        _start(cls, fields, {**parameters, **keywords})
    return Recording(
        environment=cls.id,
        parameters={**parameters, **keywords},
        name=path.stem,
        source=str(attrs.get("source", "")),
        licence=str(attrs.get("licence", "")),
        **fields,
    )


def _start(cls: type[Task], fields: dict[str, Any], parameters: Mapping[str, Any]) -> None:
    log_format = find_companion(cls, LogFormat)
    if log_format is None:
        raise ValueError(
            f"it lacks initial_mean and initial_covariance, and {cls.id} does not start from measurements"
        )
    try:
        start = log_format.start(fields["measurements"], fields["seconds"], cls.Parameters(**parameters))
    except KeyError as error:
        raise ValueError(f"it lacks {error.args[0]}") from error
    if start.used:
        fields["started"] = fields["seconds"][:, start.used - 1] - fields["seconds"][:, 0]
        if "log_time" in fields:
            fields["log_time"] = fields["log_time"][:, start.used :]
        fields["seconds"] = fields["seconds"][:, start.used :] - fields["seconds"][:, start.used - 1, None]
        fields["lengths"] = fields["lengths"] - start.used
        if fields["truth"] is not None:
            fields["truth"] = fields["truth"][:, start.used :]
    fields["measurements"], fields["initial"] = dict(start.measurements), dict(start.initial)
