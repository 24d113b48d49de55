"""Export of every competitor's estimates as CSV, NetCDF or trajectories, for other programs."""

import re
from pathlib import Path

import numpy
import xarray

from ...envs.logs.flight_tables import clock_seconds
from .estimate_tables import AXES
from .files import whole_file, whole_files

SERIES = ("seconds", "nis", "nis_degrees", "log_likelihood")
"""Names of the variables that are written with the estimates, where the evaluation has them."""


def check_estimates(path: Path) -> None:
    """Raise ValueError if a path for estimates does not end in ``.csv``, ``.nc`` or ``.tum``."""
    if path.suffix not in (".csv", ".nc", ".tum"):
        raise ValueError(
            f"estimates are written as .csv or .nc, or as trajectories into a folder .tum, got {str(path)!r}"
        )


def estimates_of(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return the dataset of all competitors' estimates for export, from an evaluation with tracks.

    Its variables are ``estimate`` and ``sigma`` over policy, episode, time and component, ``seconds``, and
    where known ``nis``, ``nis_degrees``, ``log_likelihood`` and ``truth``.

    ``seconds`` count from the start of the track; for a recording from the first measurement of the log, and
    ``log_time`` is the time in the log, so that rows can be joined with those of the log.
    """
    variance = numpy.diagonal(dataset["covariance"].values, axis1=-2, axis2=-1)
    sigma = dataset["estimate"].copy(data=numpy.sqrt(numpy.maximum(variance, 0.0)))
    names = dataset["flight"].values if "flight" in dataset.coords else dataset["episode"].values.astype(str)
    if "seconds" in dataset and "started" in dataset.coords:
        # By the log's own clock, from its first measurement on: the first ones start the track.
        dataset = dataset.assign(seconds=dataset["seconds"] + dataset["started"])
    if "seconds" not in dataset and "measurement_interval" in dataset:
        dataset = dataset.assign(seconds=dataset["measurement_interval"].cumsum("time"))
    elif "seconds" not in dataset and "elapsed" in dataset.coords:
        shape = dataset["estimate"].isel(component=0, drop=True)
        dataset = dataset.assign(seconds=dataset["elapsed"].broadcast_like(shape).transpose(*shape.dims))
    kept = [name for name in (*SERIES, "estimate", "truth") if name in dataset]
    unused = ["episode_seed", "flight", "mode", "started", "truth_known"]
    found = dataset[kept].assign(sigma=sigma).drop_vars(unused, errors="ignore")
    found.attrs = {name: dataset.attrs[name] for name in ("environment", "scenario", "split", "seed")}
    return found.assign_coords(recording=("episode", names))


def write_estimates(path: Path, dataset: xarray.Dataset) -> None:
    """Write the estimates of every competitor to a file, one entry for each measurement of each episode.

    Args:
        path: path that ends in ``.csv`` or ``.nc``; or a folder that ends in ``.tum``, see :func:`write_trajectories`.
        dataset: evaluation with ``tracks=True``.
    """
    check_estimates(path)
    if path.suffix == ".tum":
        write_trajectories(path, dataset)
        return
    found = estimates_of(dataset)
    with whole_file(path) as partial:
        if path.suffix == ".nc":
            found.to_netcdf(partial, engine="scipy", format="NETCDF3_64BIT")
        else:
            _write_csv(partial, found)


def _write_csv(path: Path, found: xarray.Dataset) -> None:
    columns = {name: found[name] for name in ("log_time", *SERIES) if name in found.variables}
    for name in ("estimate", "sigma", "truth"):
        if name in found:
            for component in found["component"].values.tolist():
                columns[f"{name}_{component}"] = found[name].sel(component=component, drop=True)
    numbered = {"measurement": ("time", 1 + numpy.arange(found.sizes["time"]))}
    flat = xarray.Dataset(columns)
    if "log_time" in columns:
        flat = flat.reset_coords("log_time")
    flat = flat.drop_vars("time", errors="ignore").assign(numbered)
    table = flat.to_dataframe(dim_order=["policy", "episode", "time"]).reset_index()
    # After the end of a shorter episode there is no estimate.
    there = numpy.isfinite(table[next(name for name in columns if name.startswith("estimate_"))])
    table[there].to_csv(path, columns=["policy", "recording", "measurement", *columns], index=False)


def write_trajectories(folder: Path, dataset: xarray.Dataset) -> None:
    """Write estimated and true positions as trajectory files in the TUM RGB-D format.

    A file has the lines ``time x y z qx qy qz qw``, s and m; the orientation is the identity, and a z that is not
    estimated is zero. The time is that of the log, of dates since 1970; without a log it counts from the start of the
    track. There is a file for each competitor and episode, ``NAME.EPISODE.tum``, and one for the truth where it is
    known, ``truth.NAME.EPISODE.tum``: in a closed loop every competitor has a truth of its own.

    Args:
        folder: folder whose files of these names are replaced.
        dataset: evaluation with ``tracks=True``.

    Raises:
        ValueError: if no position is estimated, or the folder cannot be written.
    """
    components = dataset["component"].values.tolist()
    axes = [components.index(name) for name in AXES if name in components]
    found = estimates_of(dataset)
    if len(axes) < 2 or "seconds" not in found:
        raise ValueError(
            "a trajectory needs estimates of position_x and position_y, and the time of each in seconds"
        )
    with whole_files(folder) as waiting:
        for policy in found["policy"].values.tolist():
            for episode in found["episode"].values.tolist():
                own = found.sel(policy=policy, episode=episode)
                time = _log_seconds(own) if "log_time" in own.coords else own["seconds"].values
                name = f"{re.sub(r'[^A-Za-z0-9_.-]', '_', policy)}.{episode}.tum"
                for prefix, kind in (("", "estimate"), ("truth.", "truth")):
                    if kind in own:
                        _write_trajectory(waiting / f"{prefix}{name}", time, own[kind].values[:, axes])


def _log_seconds(own: xarray.Dataset) -> numpy.ndarray:
    """Return the times of an episode in its log, s, ``(T,)``; NaN beyond its end."""
    import pandas

    found = numpy.full(own.sizes["time"], numpy.nan)
    there = numpy.isfinite(own["seconds"].values)
    found[there] = clock_seconds(pandas.Series(own["log_time"].values[there]))[1]
    return found


def _write_trajectory(path: Path, seconds: numpy.ndarray, positions: numpy.ndarray) -> None:
    rows = numpy.zeros((len(positions), 8))
    rows[:, 0], rows[:, 1 : 1 + positions.shape[1]], rows[:, 7] = seconds, positions, 1.0
    # After the end of a shorter episode, or without truth, there is no position.
    numpy.savetxt(path, rows[numpy.isfinite(rows).all(axis=1)], fmt="%.9f")
