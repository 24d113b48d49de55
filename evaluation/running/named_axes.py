"""Assembly of the values of all episodes to a dataset with named axes and units."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy

from ...envs.contract.causes import Causes
from ...envs.contract.model import Model
from ...envs.data.recording import Recording
from ..competitors.kinds import Kind
from ..statistics.cause_split import VARIABLE
from ..storage.dataset import window_coords
from .stored_values import DRAWN_PREFIX

if TYPE_CHECKING:
    import xarray


LAST_ACTIONS = ("last_action", "action", "last", "last_weight")
"""Names of the observation blocks that contain the last action."""


OF_COMPONENTS = "that of the component (coordinate unit)"
MEANINGS = {
    "error": (OF_COMPONENTS, "estimate minus truth, not normalised"),
    "estimate": (OF_COMPONENTS, "estimate, not normalised"),
    "truth": (OF_COMPONENTS, "truth, not normalised"),
    "mean_square": ("square of that of the component", "computed mean square error, not normalised"),
    "covariance": ("product of those of both components", "covariance as reported, not normalised"),
    "nees": ("1", "estimation error squared, normalised by the reported covariance, not by the dimension"),
    "nis": ("1", "innovation squared, normalised by its predicted covariance, not by the dimension"),
    "nis_degrees": ("1", "dimension of the innovation"),
    "log_likelihood": ("nat", "log-density of the measurement under its prediction, in its units"),
    "mode_probability": ("1", "probability of each hypothesis"),
    "action": ("1", "action as the filter got it, normalised to its space"),
    "compressed_cost": ("1", "minus the reward `cost`: normalised to the unit of the reward, and compressed"),
    "lost": ("1", "number of the reason why the episode is lost, 0 where it is not"),
    "causes": ("1", "bit field of the causes that hold, in the order of the coordinate cause"),
}
"""Unit and meaning of the dataset's variables; the environment's page lists the units of its own variables."""
MEASURED = ("that of the environment's table of measurements", "as the sensors report it, not normalised")


def _attributes(key: str, cost: str) -> dict[str, str]:
    """Return ``units`` and ``long_name`` of a dataset variable; empty if they are not known here."""
    name = key.removeprefix(DRAWN_PREFIX)
    if name == "cost":
        return {"units": "1", "long_name": f"{cost}, normalised as stated"}
    found = MEASURED if name.startswith("measurement_") else MEANINGS.get(name, ())
    return dict(zip(("units", "long_name"), found, strict=False))


def recording_coords(
    recording: Recording, episodes: numpy.ndarray, dataset: "xarray.Dataset"
) -> dict[str, Any]:
    """Return dataset coordinates that relate the evaluation of a recording to its log, such as ``log_time``."""
    length = dataset.sizes["time"]
    coords: dict[str, Any] = {"started": ("episode", recording.started[episodes], {"units": "s"})}
    if recording.log_time is not None:
        coords["log_time"] = (("episode", "time"), recording.log_time[episodes, :length])
    if recording.truth is not None and not recording.truth_known.all():
        coords["truth_known"] = ("component", recording.truth_known.astype(numpy.int32))
    return coords


def _further_dimensions(key: str, count: int) -> list[str]:
    """Return the names of a variable's dimensions after policy, episode and time, ``count + 1`` of them."""
    if count < 0:
        return []
    key = key.removeprefix(DRAWN_PREFIX)
    if key == "covariance":
        return ["component", "other_component"]
    if key in ("error", "mean_square", "truth", "estimate", "seen"):
        return ["component"]
    if key.startswith("measurement_"):
        return [f"{key}_axis{i}" for i in range(count + 1)]
    return ["mode" if "mode" in key else key]


def action_names(model: Model) -> tuple[str, ...]:
    """Return the names of a box action's entries: those of the observed last action, the hypotheses, or the
    control.
    """
    count = math.prod(model.action_space.shape or ())
    shown = [block.parts for block in model.filter.blocks if block.name in LAST_ACTIONS]
    for names in (*shown, model.task.modes):
        # The hypothesis's name is clearer than a number.
        if len(names) == count and not any(str(name).isdigit() for name in names):
            return tuple(str(name).replace("-", "_") for name in names)
    return tuple(f"{model.control}_{i + 1}" for i in range(count)) if count > 1 else (model.control,)


class StackedArrays:
    """Arrays of the values of all competitors and episodes, filled in place piece by piece.

    Args:
        models: model of every competitor.
        acting: names of the competitors whose action is a box.
        episodes: number of episodes of each.
        plotted: number of first episodes with data for pictures.

    Attributes:
        actions: names of the actions of each acting competitor, with its control where they use several.
        action_names: all names of actions.
    """

    def __init__(
        self, models: Mapping[str, Model], acting: Sequence[str], episodes: int, plotted: int
    ) -> None:
        several = len({models[name].control for name in acting}) > 1
        self.actions: dict[str, list[str]] = {
            name: [
                f"{models[name].control}: {part}" if several else part for part in action_names(models[name])
            ]
            for name in acting
        }
        self.action_names = list(dict.fromkeys(part for own in self.actions.values() for part in own))
        self._arrays: dict[str, numpy.ndarray] = {}
        self._places = {name: i for i, name in enumerate(models)}
        self._episodes, self._drawn = episodes, min(plotted, episodes)
        self._written: list[tuple[int, slice, set[str]]] = []

    def write(self, name: str, part: slice, new_values: dict[str, numpy.ndarray]) -> None:
        """Write a competitor's values in some episodes, ``(episodes, time, ...)`` by name, and remove them from
        the mapping.
        """
        place = self._places[name]
        self._written.append((place, part, set(new_values)))
        while new_values:
            key, values = new_values.popitem()
            shape = values.shape[1:]
            if key == "action":
                shape = (*shape[:-1], len(self.action_names))
            if key not in self._arrays:
                count = self._drawn if key.startswith(DRAWN_PREFIX) else self._episodes
                self._arrays[key] = numpy.empty((len(self._places), count, *shape))
            rows = self._arrays[key][place, part]
            if shape == values.shape[1:]:
                rows[...] = values
            else:
                rows[...] = numpy.nan
                rows[..., [self.action_names.index(each) for each in self.actions[name]]] = values

    def finish(self) -> dict[str, numpy.ndarray]:
        """Return the arrays ``(policy, episode, time, ...)`` by name; NaN where nothing was written."""
        for key, array in self._arrays.items():
            for place, part, kept in self._written:
                if key not in kept:
                    array[place, part] = numpy.nan
        return dict(sorted(self._arrays.items()))


def with_named_axes(
    arrays: StackedArrays,
    kinds: Mapping[str, Kind],
    models: Mapping[str, Model],
    windows: Mapping[str, tuple[int, int]],
    seeds: Sequence[int],
) -> "xarray.Dataset":
    """Make the dataset of all competitors' values, with coordinates and units."""
    import xarray

    model = next(iter(models.values()))
    components = [c.name for c in model.task.components]
    times = numpy.arange(1, model.task.horizon + 1)
    variables: dict[str, Any] = {}
    for key, values in arrays.finish().items():
        dims = ["policy", "drawn_episode" if key.startswith(DRAWN_PREFIX) else "episode", "time"]
        dims += ["action_name"] if key == "action" else _further_dimensions(key, values.ndim - 4)
        variables[key] = (dims, values, _attributes(key, model.task.reward.cost))
    coords: dict[str, Any] = {
        "policy": list(models),
        "kind": ("policy", [kinds[name] for name in models]),
        "control": ("policy", [each.control for each in models.values()]),
        "episode": numpy.arange(len(seeds)),
        "episode_seed": ("episode", [str(seed) for seed in seeds]),
        "time": times,
        "component": components,
        "unit": ("component", [c.unit for c in model.task.components]),
        "group": ("component", [one.group for one in model.task.components]),
    }
    if model.task.interval is not None:
        about = {"units": "s", "long_name": "since the start of the track"}
        coords["elapsed"] = ("time", float(model.task.interval) * times, about)
    within = {
        name: (first, min(last, model.task.horizon))
        for name, (first, last) in {**windows, "all": (1, model.task.horizon)}.items()
        if first <= model.task.horizon
    }
    coords |= window_coords(within)
    if "mode_probability" in variables:
        coords["mode"] = list(model.task.modes)
    if VARIABLE in variables:
        causes = Causes.of(model.task).causes
        coords["cause"] = [cause.name for cause in causes]
        coords["cause_phrase"] = ("cause", [cause.phrase for cause in causes])
        coords["start_measurements"] = Causes.of(model.task).start
    if "action" in variables:
        coords["action_name"] = arrays.action_names
    return xarray.Dataset(variables, coords)
