"""What every competitor has estimated, as a file that other programs read."""

from pathlib import Path

import numpy
import xarray

from .files import whole_file

SERIES = ("seconds", "nis", "nis_degrees", "log_likelihood")
"""Written beside the estimates, where they are known."""


def check_estimates(path: Path) -> None:
    """Raise ValueError for a file of another kind."""
    if path.suffix not in (".csv", ".nc"):
        raise ValueError(f"estimates are written as .csv or .nc, got {str(path)!r}")


def estimates_of(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return estimates of an evaluation with tracks: ``estimate`` and ``sigma`` over policy, recording, time and
    component, ``seconds``, and where they are known ``nis``, ``nis_degrees``, ``log_likelihood`` and ``truth``.

    Of a recording ``seconds`` count from the first measurement of the log, and ``log_time`` is the time as it stands
    there, so that rows can be joined with those of the log.
    """
    variance = numpy.diagonal(dataset["covariance"].values, axis1=-2, axis2=-1)
    sigma = dataset["estimate"].copy(data=numpy.sqrt(numpy.maximum(variance, 0.0)))
    names = dataset["flight"].values if "flight" in dataset.coords else dataset["episode"].values.astype(str)
    if "seconds" in dataset and "started" in dataset.coords:
        # Of the log's own clock, from its first measurement on: some of them make the start of the track.
        dataset = dataset.assign(seconds=dataset["seconds"] + dataset["started"])
    kept = [name for name in (*SERIES, "estimate", "truth") if name in dataset]
    unused = ["episode_seed", "flight", "mode", "started", "truth_known"]
    found = dataset[kept].assign(sigma=sigma).drop_vars(unused, errors="ignore")
    found.attrs = {name: dataset.attrs[name] for name in ("environment", "scenario", "split", "seed")}
    return found.assign_coords(recording=("episode", names))


def write_estimates(path: Path, dataset: xarray.Dataset) -> None:
    """Write what every competitor has estimated, a line or an entry for each measurement of each episode.

    Args:
        path: ending in ``.csv`` or ``.nc``.
        dataset: from an evaluation with ``tracks=True``.

    Raises:
        ValueError: if it cannot be written.
    """
    check_estimates(path)
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
    # Beyond the end of a shorter episode there is no estimate.
    there = numpy.isfinite(table[next(name for name in columns if name.startswith("estimate_"))])
    table[there].to_csv(path, columns=["policy", "recording", "measurement", *columns], index=False)
