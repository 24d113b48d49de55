"""Results of a benchmark or an evaluation in one file, from which a report can be made anywhere.

The file contains numbers and names: reading it executes nothing, and needs none of its environments.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from platform import python_version
from typing import Any, NamedTuple

import numpy
import xarray

from ...envs.engine.catalogue import bare_name
from ...evaluation.competitors.kinds import RANKED
from ...evaluation.running.curves import evenly_spaced
from ...evaluation.running.metrics import Record
from ...evaluation.storage.code import library_versions
from ...evaluation.storage.files import write_text
from ...evaluation.storage.stored import read_json, restore
from ...evaluation.storage.stored_dataset import dataset_as_json, dataset_from_json

RESULTS = "results.json"
"""Name of the file in a folder."""
FORMAT = 1
LIBRARIES = ("filtergym", "numpy", "scipy", "gymnasium", "xarray", "llvmlite")
"""Libraries whose versions a file contains."""
MOST_SHOWN = 10
"""Largest number of competitors whose curves and track a file contains; it contains the records of all."""
MOST_TIMES = 120
"""Largest number of times of a curve; of more, these are spread over the episode."""
TRACK_TIMES = 160
TRACK_DIGITS = {"truth": 7, "estimate": 7, "seen": 7}
DIGITS = 4
"""Significant digits: a curve is only looked at; a track also shows a few metres in a hundred kilometres."""
REQUIRED_DIMENSIONS: dict[str, tuple[str, ...]] = {
    "curves": ("policy", "time"),
    "track": ("policy", "time", "component", "unit", "estimate", "sigma"),
}
"""Dimensions that a report needs."""


class Settings(NamedTuple):
    """Command and versions with which results were made."""

    command: str
    """Command that makes them again."""
    versions: dict[str, str]
    """Versions of Python and the libraries."""


class WorstTrack(NamedTuple):
    """An episode of high cost to a competitor: its opponent, seed, costs, causes and track."""

    policy: str
    """Name of the competitor."""
    opponent: str
    """Name of the opponent in the comparison; empty: none."""
    seed: str
    """Seed of the episode, as text, since it has more digits than a number of JavaScript; of a recording the episode's
    name.
    """
    cost: float
    """Mean cost over the episode."""
    ratio: float | None
    """Ratio of the cost to the opponent's."""
    causes: list[str]
    """Main causes; empty: none."""
    track: xarray.Dataset | None
    """Track, see :func:`track_of`."""


class Result(NamedTuple):
    """Results of one environment in one scenario: records, curves, a track, and texts."""

    environment: str
    scenario: str
    description: str
    """Description of the scenario."""
    default: bool
    """Whether the scenario is the environment's training distribution."""
    training: bool
    """Whether agents may be trained in it."""
    paper: str
    """Name of the paper's algorithm; empty where there is none."""
    reference: str
    """Name of the reference whose score is 1; empty where there is none."""
    learned: list[str]
    """Names of the competitors that were learned."""
    knows: dict[str, str]
    """What each reference and bound knows of the truth, by its name."""
    notes: list[str]
    """Notes on omissions, in sentences."""
    records: list[Record]
    curves: xarray.Dataset | None
    """Curves of the shown competitors, see :func:`.evaluation.running.curves.curves_of`."""
    track: xarray.Dataset | None
    """Track of one episode, see :func:`track_of`."""
    causes: dict[str, str] = {}  # noqa: RUF012  (never written to)
    """Condition of each cause in words, by its name."""
    explained: list[str] = []  # noqa: RUF012
    """Names of the competitors whose cost is explained."""
    worst: list[WorstTrack] = []  # noqa: RUF012
    """Worst episodes of these."""
    own: list[str] = []  # noqa: RUF012
    """Names of the user's own competitors, with which a report begins."""

    @property
    def short(self) -> str:
        """Name of the environment without its namespace and version."""
        return bare_name(self.environment)


def settings_of(command: str) -> Settings:
    """Return the settings of a result: its command, and the versions of the installed libraries."""
    return Settings(command, {"Python": python_version(), **library_versions(LIBRARIES)})


def select_competitors(
    records: Sequence[Record],
    paper: str,
    reference: str,
    learned: Sequence[str],
    user_names: Sequence[str] = (),
) -> list[str]:
    """Return the competitors whose curves a file of results contains, by name, at most ``MOST_SHOWN``.

    The paper's algorithm, the reference, the user's own, the learned, the cheapest of each kind, a bound; then by cost.
    """
    cost = {r.policy: r.value for r in records if (r.metric, r.window) == ("geometric_cost", "all")}
    kinds = {r.policy: r.kind for r in records}

    def place(name: str) -> float:
        value = cost.get(name)
        return math.inf if value is None else value

    by_cost = sorted((name for name in kinds if kinds[name] in RANKED), key=place)
    classical = [name for name in by_cost if name not in learned and name != paper]
    first = [name for kind in RANKED for name in [n for n in classical if kinds[n] == kind][:2]]
    bounds = [name for name in kinds if kinds[name] == "bound"]
    wanted = [
        paper,
        reference,
        *user_names,
        *first,
        *(n for n in by_cost if n in learned),
        *bounds[:1],
        *by_cost,
    ]
    return list(dict.fromkeys(name for name in wanted if name in kinds))[:MOST_SHOWN]


def thin_curves(curves: xarray.Dataset) -> xarray.Dataset:
    """Return curves at ``MOST_TIMES`` times at most, and error distributions at every other share."""
    fewer = curves.isel(time=evenly_spaced(curves.sizes["time"], MOST_TIMES))
    return fewer.isel(share=slice(None, None, 2)) if "share" in fewer.dims else fewer


def track_of(
    dataset: xarray.Dataset, components: Sequence[str], plane: bool, number: int = 0
) -> xarray.Dataset | None:
    """Return the truth, measurements and estimates of one episode of an evaluation; None: not stored.

    Returns:
        ``truth``, ``seen`` (measurements), ``estimate`` and its reported standard deviation ``sigma``, each (policy,
        component, time) where known, since in a closed loop every competitor has a truth of its own; of a plane also
        the ``correlation`` (policy, time) of both components.
    """
    if "drawn_estimate" not in dataset:
        return None
    # A bound estimates nothing.
    present = [
        name
        for name in dataset["policy"].values.tolist()
        if not numpy.isnan(dataset["drawn_estimate"].sel(policy=name).values[number]).all()
    ]
    kept = [name for name in dataset if str(name).startswith("drawn_")]
    episode = dataset[kept].sel(policy=present).isel(drawn_episode=number)
    which = [dataset["component"].values.tolist().index(name) for name in components]
    episode = episode.isel(component=which, other_component=which)
    there = numpy.flatnonzero(numpy.isfinite(episode["drawn_estimate"].values).any(axis=(0, 2)))
    episode = episode.isel(time=evenly_spaced(int(there[-1]) + 1, TRACK_TIMES))
    names = {str(name): str(name).removeprefix("drawn_") for name in kept}
    found = episode.rename(names).transpose(
        "policy", "component", "other_component", "time", missing_dims="ignore"
    )
    covariance = found["covariance"].values
    variance = numpy.maximum(numpy.diagonal(covariance, axis1=1, axis2=2), 0.0)
    sigma = numpy.moveaxis(numpy.sqrt(variance), -1, 1)
    found = found.drop_vars("covariance").assign(sigma=(("policy", "component", "time"), sigma))
    if plane:
        product = sigma[:, 0] * sigma[:, 1]
        nothing = numpy.where(numpy.isnan(product), numpy.nan, 0.0)
        correlation = numpy.divide(covariance[:, 0, 1], product, out=nothing, where=product > 0.0)
        found = found.assign(correlation=(("policy", "time"), correlation.round(3)))
    further = set(map(str, found.coords)) - {
        "policy",
        "kind",
        "control",
        "time",
        "elapsed",
        "component",
        "unit",
    }
    found = found.drop_vars(list(further))
    found.attrs = {"plane": int(plane), "seed": str(dataset["episode_seed"].values.ravel()[number])}
    return found


def components_to_draw(
    groups: Mapping[str, Sequence[str]], components: Sequence[str]
) -> tuple[list[str], bool]:
    """Return the names of the components to draw of a track, and whether the first two span a plane."""
    for parts in groups.values():
        if len(parts) > 1:
            return list(parts[:2]), True
    return list(components[:3]), False


def write_results(path: Path, results: Iterable[Result], settings: Settings) -> None:
    """Write results to a file, completely or not at all."""
    parts = [json.dumps(_as_json(result), allow_nan=False) for result in results]
    head = json.dumps({"format": FORMAT, "settings": settings._asdict()})
    write_text(path, f'{head[:-1]}, "results": [\n' + ",\n".join(parts) + "\n]}\n")


def _as_json(result: Result) -> dict[str, Any]:
    return {
        **result._asdict(),
        "records": [record._asdict() for record in result.records],
        "worst": [{**one._asdict(), "track": serialise_track(one.track)} for one in result.worst],
        **serialise_datasets(result),
    }


def serialise_track(track: xarray.Dataset | None) -> dict[str, Any] | None:
    """Return a track as a dictionary of JSON's types."""
    return None if track is None else dataset_as_json(track, TRACK_DIGITS, DIGITS)


def serialise_datasets(result: Result) -> dict[str, Any]:
    """Return a result's curves and track as dictionaries of JSON's types."""
    return {
        "curves": None if result.curves is None else dataset_as_json(result.curves, {}, DIGITS),
        "track": serialise_track(result.track),
    }


def read_results(path: Path) -> tuple[list[Result], Settings]:
    """Return the results in a file of :func:`write_results`, or in ``results.json`` of a folder; and settings."""
    path = path / RESULTS if path.is_dir() else path
    try:
        values = read_json(path)
        if not isinstance(values, dict) or values.get("format") != FORMAT:
            raise ValueError("it is no file of results, or one of another version of filtergym")
        settings = restore(Settings, values.get("settings"))
        if not isinstance(values.get("results"), list):
            raise ValueError("it holds no list of results")
        return [_restore(fields) for fields in values["results"]], settings
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot read the results in {path}: {error}") from error


def read_all_results(paths: Sequence[Path]) -> tuple[list[Result], Settings]:
    """Return the results of several files in one list, and their settings."""
    read = [read_results(path) for path in paths]
    results = [result for found, _ in read for result in found]
    names = [(result.environment, result.scenario) for result in results]
    if len(set(names)) < len(names):
        raise ValueError(f"{' '.join(map(str, paths))} hold the same environment and scenario more than once")
    commands = dict.fromkeys(settings.command for _, settings in read)
    return results, Settings("\n".join(commands), read[0][1].versions)


def _restore(fields: Any) -> Result:
    if not isinstance(fields, dict) or not isinstance(fields.get("records"), list):
        raise ValueError("a result needs its fields, and a list of records among them")
    records = [restore(Record, record) for record in fields["records"]]
    for record in records:
        check_numbers(record)
    datasets = {
        name: None if fields.get(name) is None else dataset_from_json(fields[name])
        for name in ("curves", "track")
    }
    worst = [_restore_worst(entry) for entry in fields.get("worst", [])]
    result = restore(Result, {**fields, "records": records, "worst": worst, **datasets})
    if not records:
        raise ValueError("a result holds no records")
    for part, found in datasets.items():
        _check_dataset(part, found)
    if result.curves is not None and "rmse" in result.curves and not result.curves.sizes.get("quantity"):
        raise ValueError("the curves of a result contain no errors")
    if any((r.environment, r.scenario) != (result.environment, result.scenario) for r in records):
        raise ValueError("a result holds records of another environment or scenario")
    return result


def _restore_worst(fields: Any) -> WorstTrack:
    if not isinstance(fields, dict):
        raise ValueError("a worst episode needs its fields")
    track = None if fields.get("track") is None else dataset_from_json(fields["track"])
    _check_dataset("track", track)
    found = restore(WorstTrack, {**fields, "track": track})
    if not all(math.isfinite(number) for number in (found.cost, found.ratio or 0.0)):
        raise ValueError(f"the cost of a worst episode must be finite, got {found.cost} and {found.ratio}")
    return found


def _check_dataset(part: str, found: xarray.Dataset | None) -> None:
    """Raise ValueError if curves or a track lack dimensions that a report needs."""
    wanted = REQUIRED_DIMENSIONS[part] if found is not None else ()
    missing = [name for name in wanted if found is None or name not in found.variables]
    if missing:
        raise ValueError(f"the {part} of a result lack {', '.join(missing)}")


def check_numbers(record: Record) -> None:
    """Raise ValueError unless the numbers of a record are finite or None, and both ends of its interval alike."""
    numbers = (record.value, record.low, record.high)
    finite = all(number is None or math.isfinite(number) for number in numbers)
    if not finite or (record.low is None) != (record.high is None):
        raise ValueError(f"value and interval must be finite or null, got {numbers}")
