"""What was kept of episodes as a dataset, whose axes have names and units."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy

from ...envs.contract.causes import Causes
from ...envs.contract.model import Model
from ...envs.data.recording import Recording
from ..statistics.cause_split import VARIABLE
from ..storage.dataset import keywords_as_text, whole_number, window_coords
from .kept import DRAWN_PREFIX

if TYPE_CHECKING:
    import xarray

    from .evaluate import Plan

LAST_ACTIONS = ("last_action", "action", "last", "last_weight")
"""Names of blocks of an observation that show the action before."""


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
    "log_likelihood": ("nat", "log-density of the measurement as it was predicted, in its units"),
    "mode_probability": ("1", "probability of each hypothesis"),
    "action": ("1", "action as the filter got it, normalised to its space"),
    "compressed_cost": ("1", "minus the reward `cost`: normalised to the unit of the reward, and compressed"),
    "lost": ("1", "number of the reason why the episode is lost, 0 where it is not"),
    "causes": ("1", "bit field of the causes that hold, in the order of the coordinate cause"),
}
"""Unit and meaning of variables; what an environment reports beside them is in the unit that its page says."""
MEASURED = ("that of the environment's table of measurements", "as the sensors report it, not normalised")


def _attributes(key: str, cost: str) -> dict[str, str]:
    """Unit of a variable, and whether it is normalised; nothing where only the environment knows."""
    name = key.removeprefix(DRAWN_PREFIX)
    if name == "cost":
        return {"units": "1", "long_name": f"{cost}, normalised as it says"}
    found = MEASURED if name.startswith("measurement_") else MEANINGS.get(name, ())
    return dict(zip(("units", "long_name"), found, strict=False))


def recording_coords(
    recording: Recording, episodes: numpy.ndarray, dataset: "xarray.Dataset"
) -> dict[str, Any]:
    """What the evaluation of a recording says of its log.

    Args:
        recording: that is replayed.
        episodes: number of its episode that each episode of the evaluation replays, ``(M,)``.
        dataset: the evaluation.

    Returns:
        Coordinates: ``started``, seconds from the first measurement of the log to the start of the track; ``log_time``
        of every measurement, where the log has times of its own; ``truth_known`` of every component, where the truth
        of some is not known.
    """
    length = dataset.sizes["time"]
    coords: dict[str, Any] = {"started": ("episode", recording.started[episodes], {"units": "s"})}
    if recording.log_time is not None:
        coords["log_time"] = (("episode", "time"), recording.log_time[episodes, :length])
    if recording.truth is not None and not recording.truth_known.all():
        coords["truth_known"] = ("component", recording.truth_known.astype(numpy.int32))
    return coords


def _further_dimensions(key: str, count: int) -> list[str]:
    """Names of a variable's dimensions beside policy, episode and time; ``count`` of them follow the first."""
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


def action_names(model: Model, count: int) -> tuple[str, ...]:
    """Names of the components of a box of actions.

    As the observation names those of the last action, where it shows them; else the hypotheses, where there is a number
    for each; else the control, with numbers from 1 on where there are several.
    """
    shown = [block.parts for block in model.filter.blocks if block.name in LAST_ACTIONS]
    for names in (*shown, model.task.modes):
        # A number alone says less than the hypothesis's name.
        if len(names) == count and not any(str(name).isdigit() for name in names):
            return tuple(str(name).replace("-", "_") for name in names)
    return tuple(f"{model.control}_{i + 1}" for i in range(count)) if count > 1 else (model.control,)


def _actions_named(
    per_policy: Mapping[str, Mapping[str, numpy.ndarray]],
    controls: Mapping[str, str],
    models: Mapping[str, Model],
) -> dict[str, tuple[str, ...]]:
    """Names of the actions of every policy that has any; of their control too, where they steer by several."""
    acting = [name for name, series in per_policy.items() if "action" in series]
    several = len({controls[name] for name in acting}) > 1
    found = {name: action_names(models[name], per_policy[name]["action"].shape[-1]) for name in acting}
    if several:
        return {name: tuple(f"{controls[name]}: {part}" for part in parts) for name, parts in found.items()}
    return found


def _actions_aligned(
    per_policy: Mapping[str, Mapping[str, numpy.ndarray]], actions: Mapping[str, tuple[str, ...]]
) -> numpy.ndarray:
    """Actions side by side, ``(policy, episode, time, name)``; NaN where a policy does not steer by that."""
    every = list(dict.fromkeys(sum(actions.values(), ())))
    episodes, length = per_policy[next(iter(actions))]["action"].shape[:2]
    aligned = numpy.full((len(per_policy), episodes, length, len(every)), numpy.nan)
    for i, (name, series) in enumerate(per_policy.items()):
        if name in actions:
            aligned[i][..., [every.index(part) for part in actions[name]]] = series["action"]
    return aligned


def with_named_axes(
    per_policy: dict[str, dict[str, numpy.ndarray]], plan: "Plan", seeds: Sequence[int]
) -> "xarray.Dataset":
    """Return what was kept of competitors as a dataset, and empty it on the way.

    Args:
        per_policy: of every competitor, what was kept by its name, ``(episodes, time, ...)``.
        plan: of the evaluation.
        seeds: of the episodes.
    """
    import xarray

    kinds, controls, models, scenario = plan.kinds, plan.controls, plan.models, plan.scenario
    model = next(iter(models.values()))
    names = list(per_policy)
    components = [c.name for c in model.task.components]
    times = numpy.arange(1, model.task.horizon + 1)
    variables: dict[str, Any] = {}
    actions = _actions_named(per_policy, controls, models)
    for key in sorted({key for series in per_policy.values() for key in series}):
        if key == "action":
            dims = ["policy", "episode", "time", "action_name"]
            variables[key] = (dims, _actions_aligned(per_policy, actions), _attributes(key, ""))
            continue
        example = next(series[key] for series in per_policy.values() if key in series)
        stacked = numpy.empty((len(names), *example.shape))
        for i, name in enumerate(names):
            stacked[i] = per_policy[name].pop(key, numpy.nan)  # so that little is held twice
        dims = ["policy", "drawn_episode" if key.startswith(DRAWN_PREFIX) else "episode", "time"]
        dims += _further_dimensions(key, example.ndim - 3)
        variables[key] = (dims, stacked, _attributes(key, model.task.reward.cost))
    coords: dict[str, Any] = {
        "policy": names,
        "kind": ("policy", [kinds[n] for n in names]),
        "control": ("policy", [controls[n] for n in names]),
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
    windows = {
        name: (first, min(last, model.task.horizon))
        for name, (first, last) in {**scenario.windows, "all": (1, model.task.horizon)}.items()
        if first <= model.task.horizon
    }
    coords |= window_coords(windows)
    if "mode_probability" in variables:
        coords["mode"] = list(model.task.modes)
    if VARIABLE in variables:
        causes = Causes.of(model.task).causes
        coords["cause"] = [cause.name for cause in causes]
        coords["cause_phrase"] = ("cause", [cause.phrase for cause in causes])
        coords["start_measurements"] = Causes.of(model.task).start
    if actions:
        coords["action_name"] = list(dict.fromkeys(sum(actions.values(), ())))
    return xarray.Dataset(
        variables,
        coords,
        attrs={
            "environment": model.task.id,
            "scenario": scenario.name,
            "keywords": keywords_as_text(plan.experiment.keywords),
            "split": plan.experiment.split,
            "seed": whole_number(plan.experiment.seed),
            "cost": model.task.reward.cost,
        },
    )
