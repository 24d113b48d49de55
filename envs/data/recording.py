"""Recorded measurements in place of a simulated world: readings of real sensors, replayed under any policy.

As a scenario a :class:`Recording` replaces the task's own world by a :class:`.RecordedWorld`: an episode replays one
recording, which its first uniform number draws.

The recording must have arrays of the same names and shapes as one simulated measurement. A task with a closed loop has
no recordings: none has the readings that another estimate would have caused.

Without truth there are no errors and no costs, and rewards are zero.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy

from ..contract.companions import find_companion
from ..contract.log_format import LogFormat
from ..contract.parameters import check, field_limits, freeze
from ..contract.task import Scenario, Task, named_arrays
from ..contract.world import World
from .recorded_world import RecordedArrays, RecordedWorld, measure_once
from .scenario_data import ScenarioData


@dataclass(frozen=True, eq=False)
class Recording(ScenarioData):
    """Recorded measurements of one environment in E episodes; the longest has T measurements.

    Args:
        environment: id of the environment.
        measurements: every array of the environment's ``Measurement`` by its name, ``(E, T, ...)``.
        initial: every array of the initial estimate given to every filter, ``(E, ...)``.
        seconds: times since the start of the track, s, ``(E, T)``; NaN beyond the end of an episode.
        lengths: measurements acted on in each episode, ``(E,)``; if there is one more, the last observation is of it,
            otherwise the last measurement again.
        truth: true values of the task's components in their units, ``(E, T, C)``; NaN for an unknown one, None
            where all are unknown.
        names: of the episodes; default: their numbers.
        parameters: of the environment, where they differ from the defaults; a horizon makes episodes shorter.
        name: name of the recording, for reports.
        source: source of the data, in words.
        licence: licence of the data, in words.
        notes: remarks on the reading, a line each.
        log_time: times of the measurements as in the log, numbers or words, ``(E, T)``; NaN or empty where
            the log has no row. None: the only times are ``seconds``.
        started: time from the first measurement of the log to the start of the track, s, ``(E,)``; default: zero.
        typical: parameters from the errors that the log states, where the user does not set them.
        columns: names in the log of the columns that were read, by their names here.
        deviations: typical deviations of the measured values, see :class:`.TrackLog`.
        deviations_from: source of the deviations.
        origin: latitude and longitude, degrees, and usual altitude, m, around which positions of the first episode were
            made metres; empty where they were metres.

    Raises:
        ValueError: for arrays with inconsistent shapes, or are not finite where they must be.
    """

    environment: str
    measurements: Mapping[str, numpy.ndarray]
    initial: Mapping[str, numpy.ndarray]
    seconds: numpy.ndarray
    lengths: numpy.ndarray
    truth: numpy.ndarray | None = None
    names: tuple[str, ...] = ()
    parameters: Mapping[str, Any] = field(default_factory=dict)
    name: str = "recording"
    source: str = ""
    licence: str = ""
    notes: tuple[str, ...] = ()
    log_time: numpy.ndarray | None = None
    started: Any = None
    typical: Mapping[str, float] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[str, float] = field(default_factory=dict)
    deviations_from: str = ""
    origin: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        episodes, _ = self.seconds.shape
        if not self.names:
            object.__setattr__(self, "names", tuple(str(i) for i in range(episodes)))
        if self.started is None:
            object.__setattr__(self, "started", numpy.zeros(episodes))
        arrays = {**self.measurements, "truth": self.truth, "log_time": self.log_time}
        for name, values in arrays.items():
            if values is not None and values.shape[:2] != self.seconds.shape:
                raise ValueError(
                    f"{name} must have shape {self.seconds.shape} as seconds has, and further axes, got {values.shape}"
                )
        for name, values in {"length": self.lengths, "started": self.started, **self.initial}.items():
            if numpy.shape(values)[:1] != (episodes,):
                raise ValueError(
                    f"{name} must be of {episodes} episodes, got the shape {numpy.shape(values)}"
                )
        if len(set(self.names)) != episodes:
            raise ValueError(
                f"the {episodes} episodes of a recording need as many different names, got {self.names!r:.80}"
            )
        rows = self.rows
        for episode, name in enumerate(self.names):
            self._check_episode(episode, int(rows[episode]), name)

    def _check_episode(self, episode: int, rows: int, name: str) -> None:
        if not 1 <= self.lengths[episode] <= rows:
            raise ValueError(
                f"recording {name!r}: length must be from 1 to its {rows} measurements, got {self.lengths[episode]}"
            )
        times = self.seconds[episode]
        if not numpy.isfinite(times[:rows]).all():
            raise ValueError(f"recording {name!r}: seconds are not finite at measurement {_first(times) + 1}")
        if rows > 1 and not (numpy.diff(times[:rows]) > 0.0).all():
            wrong = int(numpy.argmax(numpy.diff(times[:rows]) <= 0.0))
            raise ValueError(
                f"recording {name!r}: seconds must increase, and measurement {wrong + 2} has {times[wrong + 1]:g} s "
                f"after {times[wrong]:g} s"
            )
        if self.truth is not None and numpy.isinf(self.truth[episode, :rows]).any():
            raise ValueError(f"recording {name!r}: truth is infinite; write NaN for unknown values")
        for what, values in self.measurements.items():
            if not numpy.isfinite(values[episode, :rows]).all():
                raise ValueError(
                    f"recording {name!r}: {what} is not finite at measurement {_first(values[episode]) + 1}; write "
                    "zero for a missing value, where the environment has a flag for it"
                )
        for what, values in self.initial.items():
            if not numpy.isfinite(values[episode]).all():
                raise ValueError(f"recording {name!r}: initial_{what} is not finite")

    def __deepcopy__(self, memo: dict[int, Any]) -> "Recording":
        return self

    def __repr__(self) -> str:
        true = "with truth" if self.truth is not None else "without truth"
        return f"<Recording {self.name!r} of {self.environment}: {len(self.names)} episodes {true}>"

    @functools.cached_property
    def rows(self) -> numpy.ndarray:
        """Number of measurements of each episode, ``(E,)``."""
        there = numpy.isfinite(self.seconds)
        # From the last one backwards: a missing value before it is an error, and not the end.
        return self.seconds.shape[1] - numpy.argmax(there[:, ::-1], axis=1) * there.any(axis=1)

    @functools.cached_property
    def truth_known(self) -> numpy.ndarray:
        """For each component whether every episode has a true value of it, ``(C,)``; ``truth`` must not be None."""
        there = numpy.arange(self.seconds.shape[1]) < self.rows[:, None]
        truth: Any = self.truth
        known: numpy.ndarray = numpy.logical_and(numpy.isfinite(truth), there[..., None]).any(axis=1)
        return numpy.asarray(known.all(axis=0))

    @functools.cached_property
    def has_whole_truth(self) -> bool:
        """Whether every component of the truth is known at every measurement."""
        if self.truth is None:
            return False
        there = numpy.arange(self.seconds.shape[1]) < self.rows[:, None]
        return bool(numpy.isfinite(self.truth[there]).all())

    def has_interval(self, seconds: float) -> bool:
        """Return whether measurements come this many seconds apart, counted from the start of the track."""
        times = seconds * numpy.arange(1, self.seconds.shape[1] + 1)
        late = numpy.abs(self.seconds - times)
        # NaN beyond the end of a shorter episode. Times in a file are rounded.
        return bool(numpy.nanmax(late, initial=0.0) <= 1e-6 * seconds + 1e-9 * times[-1])

    # --- as a scenario

    def fields(self) -> dict[str, Any]:
        """Return the arrays and other constructor arguments of the recording, by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def lengths_within(self, horizon: int, decision_interval: int) -> tuple[int, ...]:
        """Return the number of measurements acted on in each episode: whole decisions within the horizon."""
        lengths = numpy.minimum(self.lengths, horizon)
        return tuple((lengths - lengths % decision_interval).tolist())

    def scenario(self, cls: type[Task], keywords: Mapping[str, Any]) -> Scenario:
        """Return a scenario of an environment in which every episode replays one recorded episode.

        Args:
            cls: the environment.
            keywords: parameters that override those of the recording.

        Raises:
            ValueError: for another environment, or parameters that do not fit the recording.
        """
        if self.environment != cls.id:
            raise ValueError(f"recording {self.name!r} is of {self.environment}, not of {cls.id}")
        defaults = {f.name: f.default for f in dataclasses.fields(cls.Parameters)}
        unknown = [name for name in self.parameters if name not in defaults]
        if unknown:
            raise ValueError(
                f"recording {self.name!r} sets {unknown[0]!r}, which is no parameter of {cls.id}"
            )
        named = {**self.parameters, **keywords}
        log_format = find_companion(cls, LogFormat)
        own = (log_format and log_format.decision_interval) or defaults["decision_interval"]
        interval = freeze(named.get("decision_interval", own))
        check("decision_interval", interval, *field_limits(cls.Parameters)["decision_interval"])
        longest, shortest = int(self.lengths.max()), int(self.lengths.min())
        if shortest < interval:
            raise ValueError(
                f"decision_interval must be at most {shortest}, the measurements of the shortest episode of recording "
                f"{self.name!r}, got {interval}"
            )
        held = {"horizon": longest - longest % interval, "decision_interval": interval}
        parameters = {**held, **self.typical, **self.parameters}
        made = cls.Parameters(**{**parameters, **keywords})
        if made.horizon > longest:
            raise ValueError(
                f"horizon must be at most {longest}, the measurements of recording {self.name!r}, got {made.horizon}"
            )
        self.check_fits(cls(made))
        return Scenario(
            self.name,
            "Recorded measurements.",
            parameters,
            flights=self.names,
            notes=self.notes,
            recording=self,
        )

    def check_fits(self, task: Task) -> None:
        """Raise ValueError if the recording lacks arrays of a task's measurement, or the task has a closed loop."""
        initial, measurement = measure_once(task, self.measurements)
        for kind, prefix, example, found, leading in (
            ("measures", "", measurement, self.measurements, 2),
            ("is given at the start", "initial_", initial, self.initial, 1),
        ):
            expected = {name: tuple(values.shape[:-1]) for name, values in named_arrays(example)}
            missing = [f"{prefix}{name}" for name in expected if name not in found]
            if missing:
                raise ValueError(
                    f"recording {self.name!r} lacks {', '.join(missing)}; {task.id} {kind} "
                    f"{', '.join(prefix + name for name in expected)}"
                )
            for name in found:
                if name not in expected:
                    raise ValueError(
                        f"recording {self.name!r} has {prefix}{name}, which is not among the arrays "
                        f"that {task.id} {kind}: {', '.join(prefix + name for name in expected)}"
                    )
                shape = found[name].shape[leading:]
                if shape != expected[name]:
                    raise ValueError(
                        f"recording {self.name!r}: {prefix}{name} has the shape {shape} and {task.id} with these "
                        f"parameters {kind} {expected[name]}"
                    )
        if self.truth is not None and task.World.error_cost is World.error_cost:
            raise ValueError(
                f"recording {self.name!r} has truth, and {task.id} defines no cost of an error: give its World "
                "the method error_cost, or omit the truth"
            )
        if self.truth is not None and self.truth.shape[2] != len(task.components):
            raise ValueError(
                f"recording {self.name!r}: truth has {self.truth.shape[2]} components and {task.id} has "
                f"{len(task.components)}: {', '.join(c.name for c in task.components)}"
            )
        if self.truth is not None and not self.has_whole_truth:
            self._check_cost_known(task)

    def _check_cost_known(self, task: Task) -> None:
        world, rows = task.World(task), self.rows
        for episode, name in enumerate(self.names):
            nothing = 0.0 * self.truth[episode, : rows[episode]].T  # type: ignore[index]
            if not numpy.isfinite(world.error_cost(nothing)).any():
                missing = []
                for i, component in enumerate(task.components):
                    alone = numpy.zeros((len(task.components), 1))
                    alone[i] = math.nan
                    if numpy.isnan(nothing[i]).all() and numpy.isnan(world.error_cost(alone)).any():
                        missing.append(component.name)
                raise ValueError(
                    f"recording {name!r}: its truth lacks {', '.join(missing) or 'whole rows'}, which the cost of "
                    f"{task.id} counts: add {', '.join(f'truth_{one}' for one in missing) or 'them'}"
                    f"{world.cost_remedy}, or omit the truth"
                )

    # --- as a file

    @property
    def dataset(self) -> Any:
        """The recording as an :class:`xarray.Dataset`, the content of its file."""
        return _dataset_of(self)

    def write(self, path: Any) -> None:
        """Write the recording to a NetCDF file, for ``read_recording`` or as the path of a scenario."""
        self.dataset.to_netcdf(path, engine="scipy", format="NETCDF3_64BIT")

    # --- as a world

    def world(self, task: Task) -> RecordedWorld:
        """Return the world that replays this recording, for a task."""
        return RecordedWorld(task, self.tables, self.name)

    @functools.cached_property
    def tables(self) -> RecordedArrays:
        """Arrays of all recorded episodes for replay, joined along the last axis, as floats."""
        there = numpy.arange(self.seconds.shape[1]) < self.rows[:, None]
        ends = numpy.cumsum(self.rows)

        def columns(values: numpy.ndarray) -> numpy.ndarray:
            return numpy.ascontiguousarray(numpy.moveaxis(values[there].astype(float), 0, -1))

        def starts(values: numpy.ndarray) -> numpy.ndarray:
            return numpy.ascontiguousarray(numpy.moveaxis(values.astype(float), 0, -1))

        return RecordedArrays(
            {name: columns(values) for name, values in self.measurements.items()},
            {name: starts(values) for name, values in self.initial.items()},
            None if self.truth is None else columns(self.truth),
            columns(self.seconds),
            (ends - self.rows).astype(float),
            (ends - 1).astype(float),
        )


def _dataset_of(recording: Recording) -> Any:
    import xarray

    there = numpy.arange(recording.seconds.shape[1]) < recording.rows[:, None]
    variables: dict[str, Any] = {
        "seconds": (("episode", "time"), recording.seconds, {"units": "s"}),
        "length": ("episode", numpy.asarray(recording.lengths)),
    }
    for name, values in recording.measurements.items():
        axes = [f"{name}_axis{i}" for i in range(values.ndim - 2)]
        nothing = numpy.nan if values.dtype.kind == "f" else values.dtype.type(0)
        shaped = there.reshape(*there.shape, *[1] * (values.ndim - 2))
        variables[name] = (("episode", "time", *axes), numpy.where(shaped, values, nothing))
    for name, values in recording.initial.items():
        axes = {"mean": ["component"], "covariance": ["component", "other_component"]}.get(
            name, [f"initial_{name}_axis{i}" for i in range(values.ndim - 1)]
        )
        variables[f"initial_{name}"] = (("episode", *axes), values)
    if recording.started is not None and recording.started.any():
        variables["started"] = ("episode", numpy.asarray(recording.started, dtype=float), {"units": "s"})
    if recording.truth is not None:
        variables["truth"] = (
            ("episode", "time", "component"),
            numpy.where(there[..., None], recording.truth, numpy.nan),
        )
    origin = {name: getattr(recording, name) for name in ("source", "licence") if getattr(recording, name)}
    coords: dict[str, Any] = {"recording": ("episode", numpy.array(recording.names, dtype=str))}
    if recording.log_time is not None:
        coords["log_time"] = (("episode", "time"), recording.log_time)
    return xarray.Dataset(
        variables,
        coords=coords,
        attrs={
            "environment": recording.environment,
            "parameters": json.dumps({**recording.typical, **recording.parameters}),
            **origin,
        },
    )


def recording_from(fields: Mapping[str, Any]) -> Recording:
    """Return a :class:`Recording` from a dictionary of its fields, as read from JSON.

    Raises:
        ValueError: if a field is missing or unknown.
    """
    arrays: dict[str, Any] = {
        "seconds": None,
        "lengths": None,
        "truth": None,
        "log_time": None,
        "started": None,
        "measurements": {},
        "initial": {},
    }
    known = {f.name for f in dataclasses.fields(Recording)}
    if not {"environment", "measurements", "initial", "seconds", "lengths"} <= set(fields) <= known:
        raise ValueError(
            f"a recording as a dictionary has {', '.join(sorted(known))}, got {', '.join(map(repr, fields))}"
        )
    for name in arrays:
        value = fields.get(name)
        if isinstance(value, Mapping):
            arrays[name] = {key: numpy.asarray(item) for key, item in value.items()}
        else:
            arrays[name] = None if value is None else numpy.asarray(value)
    arrays["seconds"] = arrays["seconds"].astype(float)
    others = {name: value for name, value in fields.items() if name not in arrays}
    for name in ("names", "notes"):
        others[name] = tuple(others.get(name, ()))
    return Recording(**arrays, **others)


def join_recordings(recordings: Sequence[Recording], name: str, notes: Sequence[str] = ()) -> Recording:
    """Join recordings with the parameters of the first into one recording; the others are omitted.

    ``notes`` are remarks on the reading, a line each; omissions are added.
    """
    first, lines = recordings[0], list(notes)
    kept: list[Recording] = []
    for one in recordings:
        differing = sorted(
            parameter
            for parameter in {*one.parameters, *first.parameters}
            if one.parameters.get(parameter) != first.parameters.get(parameter)
        )
        if differing:
            lines.append(
                f"{one.name}: left out: {differing[0]} is {one.parameters.get(differing[0], 'the default')}, and of "
                f"{first.name} {first.parameters.get(differing[0], 'the default')}"
            )
        else:
            kept.append(one)
            lines += [f"{one.name}: {note}" for note in one.notes]
    untrue = [one.name for one in kept if one.truth is None]
    if untrue and len(untrue) < len(kept):
        lines.append(f"{untrue[0]}: has no truth, so no competitor is judged")
    for key in sorted({key for one in kept for key in one.measurements}):
        lacking = [one.name for one in kept if key not in one.measurements]
        if lacking:
            lines.append(f"{lacking[0]}: has no {key}, which is left out of all")
    names = []
    for one in kept:
        alone = len(one.names) == 1
        names += [one.name] if alone else [f"{one.name}: {episode}" for episode in one.names]
    return stack_recordings(kept, names=tuple(names), name=name, source=name, notes=tuple(lines))


def stack_recordings(recordings: Sequence[Recording], **fields: Any) -> Recording:
    """Join recordings into one that has all their episodes, padded to the same length.

    The truth is known where all have one. ``fields`` are those of the result that differ from the first recording's.
    """
    first, longest = recordings[0], max(one.seconds.shape[1] for one in recordings)

    def padded(values: numpy.ndarray) -> numpy.ndarray:
        fill: Any = numpy.nan if values.dtype.kind == "f" else "" if values.dtype.kind == "U" else 0
        widths = [(0, 0), (0, longest - values.shape[1]), *[(0, 0)] * (values.ndim - 2)]
        return numpy.pad(values, widths, constant_values=fill)

    # Arrays of some recordings only, such as a second sensor, are omitted.
    names = [key for key in first.measurements if all(key in one.measurements for one in recordings)]
    truths = [padded(one.truth) for one in recordings if one.truth is not None]
    times = [padded(one.log_time) for one in recordings if one.log_time is not None]
    return dataclasses.replace(
        first,
        measurements={
            key: numpy.concatenate([padded(one.measurements[key]) for one in recordings]) for key in names
        },
        initial={key: numpy.concatenate([one.initial[key] for one in recordings]) for key in first.initial},
        seconds=numpy.concatenate([padded(one.seconds) for one in recordings]),
        lengths=numpy.concatenate([one.lengths for one in recordings]),
        truth=numpy.concatenate(truths) if len(truths) == len(recordings) else None,
        log_time=numpy.concatenate(times) if len(times) == len(recordings) else None,
        started=numpy.concatenate([one.started for one in recordings]),
        typical={
            key: float(numpy.median([one.typical.get(key, value) for one in recordings]))
            for key, value in first.typical.items()
        },
        **{"names": tuple(name for one in recordings for name in one.names), **fields},
    )


def _first(values: numpy.ndarray) -> int:
    return int(numpy.argmin(numpy.isfinite(values).reshape(len(values), -1).all(axis=1)))


def changed_parameters(parameters: Any) -> dict[str, Any]:
    """Return the parameters of a task that differ from their defaults, by name, without the horizon."""
    found = {}
    for each in dataclasses.fields(parameters):
        value = getattr(parameters, each.name)
        if each.name != "horizon" and value != each.default:
            found[each.name] = value
    return found
