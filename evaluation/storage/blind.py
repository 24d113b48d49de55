"""Export of a recording without its truth, as CSV and NetCDF files for programs that compute estimates from it."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy

from ...envs.contract.task import Task, named_arrays
from ...envs.data.recorded_world import fill_arrays, measure_once
from ...envs.data.recording import Recording
from .files import whole_files

MEASUREMENTS, START, NETCDF = "measurements.csv", "start.csv", "measurements.nc"


def write_blind(folder: Path, recording: Recording, task: Task) -> None:
    """Write the measurements and initial estimates of a recording to CSV and NetCDF files, without its truth.

    ``measurements.csv`` has a row for each measurement: ``track``, ``measurement`` from 1 on, ``seconds``
    since the start of the track, and the numbers of every field, ``position_1``, ``position_2`` ...; empty
    where missing. ``start.csv`` has a row for each track: ``mean_X`` and ``covariance_X_Y`` of the
    components, and the other values given to every filter. ``measurements.nc`` contains both. No file
    contains the seed.

    Args:
        folder: folder for the files.
        recording: recording of episodes numbered from 0 on.
        task: task of the simulation, on NumPy arrays.

    Raises:
        ValueError: if they cannot be written, or the episodes fly flights, since an evaluation selects other ones.
    """
    import pandas

    if list(recording.names) != [str(i) for i in range(len(recording.names))]:
        raise ValueError("episodes that fly flights have no numbers: record a scenario without flights")
    episodes, times = recording.seconds.shape
    acted_on = numpy.arange(times) < recording.lengths[:, None]
    track, number = numpy.nonzero(acted_on)
    rows = {"track": track, "measurement": 1 + number, "seconds": recording.seconds[acted_on]}
    measurement = fill_arrays(
        measure_once(task, recording.measurements)[1],
        lambda name: numpy.moveaxis(recording.measurements[name][acted_on].astype(float), 0, -1),
        numpy,
    )
    for name, values in named_arrays(task.world.mask_missing(measurement)):
        rows |= dict(_numbered(name, values))
    start = {"track": numpy.arange(episodes)}
    names = [component.name for component in task.components]
    for name, values in recording.initial.items():
        if name == "mean":
            start |= {f"mean_{a}": values[:, i] for i, a in enumerate(names)}
        elif name == "covariance":
            pairs = ((i, j) for i in range(len(names)) for j in range(i + 1))
            start |= {f"covariance_{names[i]}_{names[j]}": values[:, i, j] for i, j in pairs}
        else:
            start |= dict(_numbered(name, numpy.moveaxis(values, 0, -1)))
    with whole_files(folder) as waiting:
        pandas.DataFrame(rows).to_csv(waiting / MEASUREMENTS, index=False)
        pandas.DataFrame(start).to_csv(waiting / START, index=False)
        # The source of a simulated recording contains its seed, from which the truth can be simulated.
        source = f"filtergym record {recording.environment} --blind, {recording.name}"
        dataclasses.replace(recording, truth=None, source=source).write(waiting / NETCDF)


def _numbered(name: str, values: numpy.ndarray) -> Iterator[tuple[str, numpy.ndarray]]:
    """Yield name and values of each entry of a field ``(..., rows)``; several entries are numbered from 1 on."""
    for place in numpy.ndindex(values.shape[:-1]):
        yield "_".join([name, *(str(i + 1) for i in place)]), values[place] * 1
