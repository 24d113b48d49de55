"""What every competitor has estimated, as a file that other programs read."""

import csv
from pathlib import Path
from typing import Any

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
    """
    variance = numpy.diagonal(dataset["covariance"].values, axis1=-2, axis2=-1)
    sigma = dataset["estimate"].copy(data=numpy.sqrt(numpy.maximum(variance, 0.0)))
    names = dataset["flight"].values if "flight" in dataset.coords else dataset["episode"].values.astype(str)
    kept = [name for name in (*SERIES, "estimate", "truth") if name in dataset]
    found = dataset[kept].assign(sigma=sigma).drop_vars(["episode_seed", "flight", "mode"], errors="ignore")
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
    components = found["component"].values.tolist()
    series = [name for name in SERIES if name in found]
    vectors = [name for name in ("estimate", "sigma", "truth") if name in found]
    header = ["policy", "recording", "measurement", *series]
    header += [f"{vector}_{component}" for vector in vectors for component in components]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for policy in found["policy"].values.tolist():
            run = found.sel(policy=policy)
            for episode, recording in enumerate(found["recording"].values.tolist()):
                one = run.isel(episode=episode)
                columns: list[Any] = [one[name].values[:, None] for name in series]
                rows = numpy.concatenate([*columns, *(one[name].values for name in vectors)], axis=1)
                # Beyond the end of a shorter episode there is none.
                there = numpy.isfinite(one["estimate"].values[:, 0])
                for row in numpy.flatnonzero(there).tolist():
                    cells = ["" if value != value else repr(value) for value in rows[row].tolist()]
                    writer.writerow([policy, recording, row + 1, *cells])
