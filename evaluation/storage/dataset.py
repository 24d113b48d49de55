"""Coordinates and attributes of an evaluation's dataset, in a form that every file format can store.

NetCDF's attributes cannot be dictionaries, lists or booleans, and its classic format has neither unsigned nor
64-bit integers. So windows and groups are coordinates, and other values are text.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from .files import whole_file

if TYPE_CHECKING:
    import xarray

MOST_BYTES = 2**31 - 1
"""Maximal bytes of one variable in NetCDF's classic format, as SciPy writes it."""
MOST_WHOLE = 2**31 - 1
"""Largest whole number of an attribute in NetCDF's classic format."""

FAULTS = (
    "the mean is not finite",
    "the covariance is not finite",
    "the covariance is not positive definite",
    "the covariance is not symmetric",
    "the estimate is not finite after a missed measurement (missing measurements are NaN: predict without it)",
    "the program ended",
    "the program did not respond in time",
    "the program wrote no valid estimate",
    "the file contains no more estimates of the track",
)
"""Reasons why an episode of an estimator is lost. The variable ``lost`` contains their numbers from 1 on, and 0 before
a loss.
"""
NO_ROW = 1.0 + FAULTS.index("the file contains no more estimates of the track")
"""Number in the variable ``lost`` for the reason that a file has no more estimates of a track."""


class Losses(NamedTuple):
    """Number of lost episodes of an estimator, and place and reason of the first loss."""

    number: int
    """Number of lost episodes."""
    episode: int
    """Number of the first lost episode, from 0 on."""
    measurement: int
    """Measurement at which that episode was lost, from 1 on."""
    fault: int
    """Number of the reason among ``FAULTS``, from 1 on."""

    def sentence(self, name: str, episodes: int) -> str:
        """Return a sentence with the number of lost episodes, and place and reason of the first loss."""
        return (
            f"{name}: {self.number} of {episodes} episode{'s' if episodes > 1 else ''} lost: {FAULTS[self.fault - 1]} "
            f"in episode {self.episode} at measurement {self.measurement}; the last valid estimate "
            "is repeated from there on"
        )


def losses_in(run: "xarray.Dataset") -> numpy.ndarray:
    """Return each episode's loss, ``(episodes, 2)``: its measurement and the number of its reason; zeros
    without.
    """
    faults = numpy.nan_to_num(run["lost"].values) if "lost" in run else numpy.zeros((run.sizes["episode"], 1))
    first = (faults > 0.0).argmax(axis=1)
    fault = numpy.take_along_axis(faults, first[:, None], axis=1)[:, 0]
    return numpy.stack([numpy.where(fault > 0.0, first + 1.0, 0.0), fault], axis=1)


def count_losses(losses: numpy.ndarray) -> Losses | None:
    """Count the lost episodes in the array of :func:`losses_in`, with the first loss; None if none is lost."""
    lost = losses[:, 1] > 0.0
    if not lost.any():
        return None
    i = int(lost.argmax())
    return Losses(int(lost.sum()), i, int(losses[i, 0]), int(losses[i, 1]))


def write_dataset(path: Path, dataset: "xarray.Dataset") -> None:
    """Write an evaluation's dataset to a classic NetCDF file, if it is not too large."""
    if any(variable.nbytes > MOST_BYTES for variable in dataset.variables.values()):
        raise ValueError(
            f"a variable is larger than {MOST_BYTES:,} bytes, the limit of NetCDF's classic format"
        )
    with whole_file(path) as partial:
        dataset.to_netcdf(partial, engine="scipy", format="NETCDF3_64BIT")


def windows_of(dataset: "xarray.Dataset") -> dict[str, tuple[int, int]]:
    """Return each window's first and last measurement, both included, from 1 on, by its name."""
    ends = (dataset[name].values.tolist() for name in ("window", "window_first", "window_last"))
    return {name: (int(first), int(last)) for name, first, last in zip(*ends, strict=True)}


def slices_of(dataset: "xarray.Dataset") -> dict[str, slice]:
    """Return each window's slice of the time axis, by its name."""
    return {name: slice(first - 1, last) for name, (first, last) in windows_of(dataset).items()}


def with_windows(dataset: "xarray.Dataset", windows: Mapping[str, tuple[int, int]]) -> "xarray.Dataset":
    """Return a dataset with these windows in place of its own."""
    dataset = dataset.drop_vars(["window", "window_first", "window_last"], errors="ignore")
    return dataset.assign_coords(window_coords(windows))


def window_coords(windows: Mapping[str, tuple[int, int]]) -> dict[str, Any]:
    """Return the dataset coordinates that store windows: names, first and last measurements."""
    first, last = (numpy.array([ends[i] for ends in windows.values()], dtype=numpy.int64) for i in (0, 1))
    return {"window": list(windows), "window_first": ("window", first), "window_last": ("window", last)}


def groups_of(dataset: "xarray.Dataset") -> dict[str, tuple[str, ...]]:
    """Return the names of each group's components, such as those of ``position``, by the group's name."""
    found: dict[str, list[str]] = {}
    for name, group in zip(
        dataset["component"].values.tolist(), dataset["group"].values.tolist(), strict=True
    ):
        if group:
            found.setdefault(group, []).append(name)
    return {group: tuple(names) for group, names in found.items()}


def keywords_of(dataset: "xarray.Dataset") -> dict[str, Any]:
    """Read the task parameters of an evaluation from its attribute, by name; sequences are lists.

    Other objects are text, their ``repr``.
    """
    found: dict[str, Any] = json.loads(dataset.attrs["keywords"])
    return found


def keywords_as_text(keywords: Mapping[str, Any]) -> str:
    """Write parameters as a JSON object; values that JSON cannot store become their ``repr``."""
    return json.dumps(keywords, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, numpy.ndarray | numpy.generic):
        return value.tolist()
    return repr(value)


def whole_number(value: int) -> int | str:
    """Return an integer for a NetCDF attribute, as text if it is too large for the classic format."""
    return value if abs(value) <= MOST_WHOLE else str(value)


def seed_of(dataset: "xarray.Dataset") -> int:
    """Return the seed of the experiment."""
    return int(dataset.attrs["seed"])


def notes_of(dataset: "xarray.Dataset") -> list[str]:
    """Return notes on the scenario, and a sentence for each competitor with lost episodes."""
    notes = str(dataset.attrs["notes"]).splitlines()
    for name in dataset["policy"].values.tolist() if "lost" in dataset else ():
        if (losses := count_losses(losses_in(dataset.sel(policy=name)))) is not None:
            notes.append(losses.sentence(name, dataset.sizes["episode"]))
    return notes
