"""Filter for real-time use, which takes measurements one by one and returns estimates.

The same measurements give the same bits as in an evaluation.
"""

import copy
import importlib.metadata
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy

from ...compiler.functions import leaves, map_arrays, round_up_lanes
from ...envs.contract.companions import LostTracks, find_companion
from ...envs.contract.live_input import LiveInput, LiveReader
from ...envs.contract.model import Episode, Model
from ...envs.contract.observation import DecisionMeans
from ...envs.contract.parameters import check_integer, quote_shortened, read_numbers
from ...envs.contract.task import Task
from ...envs.data.clock import SINCE_1970, time_unit
from ...envs.engine.compiled import can_step
from ...filters.array_namespace import select_nested
from ..storage.dataset import FAULTS
from .adapters import select_lanes
from .filters import close_loop, find_fault
from .kinds import check_competitor, kind_of, make_competitor
from .online_state import Estimate, History, OnlineState, Taken, Watch
from .steered_filter import compile_policy, trace_policy
from .stepping import CompiledUpdate, MeasurementMemory, ModelUpdate, SteppingPolicy

LEAST_INTERVAL = 1e-6
"""Share of the sampling interval; measurements that are closer in time count as simultaneous."""
MOST_MISSED = 1000
"""Maximal number of successive scans without a measurement; after more a new track must start."""
REPORTED = ("nis", "nis_degrees", "log_likelihood", "mode_probability", "lost")
"""Names of the statistics that a filter may report with its estimate."""


class OnlineFilter:
    """Filter for real-time use, updated with measurements as they arrive, also late ones.

    Args:
        model: model with the bank of the competitor's control; its world takes measurements from outside.
        competitor: policy or estimator, or its maker.
        tracks: number of parallel tracks.
        watch: comparison of a network's inputs with those of its training; None without a network.
        lag: number of measurements, or time, by which a measurement may be late; see :meth:`update`.

    Raises:
        ValueError: for a competitor that needs the truth or later measurements.
    """

    def __init__(
        self,
        model: Model,
        competitor: Any,
        name: str,
        tracks: int = 1,
        watch: Watch | None = None,
        lag: int | timedelta = 0,
    ) -> None:
        kind = kind_of(competitor)
        if kind not in ("policy", "estimator"):
            raise ValueError(
                f"{name!r} is of kind {kind} and cannot run online: choose a policy or an estimator"
            )
        tracks = check_integer("tracks", tracks, 1)
        self._lag = _check_lag(lag)
        self.name = name
        self.tracks = tracks
        self.watch = watch
        self.task: Task = model.task
        world: Any = self.task.world
        reader = LiveReader.of(self.task)
        self.input: LiveInput = reader.input(self.task, world.initial, world.measurement, tracks)
        self._is_policy, interval = kind == "policy", self.task.decision_interval
        self._interval, self._means = interval, DecisionMeans(model.fields, interval)
        self.model: Model = model if self._is_policy else close_loop(model, competitor, kind, name, tracks)
        observe, traced = None if watch is None else watch.observe, None
        is_compiled = can_step(self.model, report_estimate)
        self._policy: SteppingPolicy | None = None
        """Policy that runs in Python."""
        if self._is_policy:
            policy = check_competitor(name, make_competitor(competitor, model), kind)
            if is_compiled and not (
                watch and self._means.columns
            ):  # native code does not write means over a decision
                traced = compile_policy(model, policy, trace_policy)
            self._policy = None if traced else SteppingPolicy(model, policy)
        self.names: tuple[str, ...] = tuple(component.name for component in self.task.components)
        self.units: tuple[str, ...] = tuple(component.unit for component in self.task.components)
        blank = Estimate(None, self.names, self.units, numpy.empty(0), numpy.empty(0))
        self._same_of_estimates = dict(vars(blank))
        self._pad = numpy.minimum(numpy.arange(round_up_lanes(tracks)), tracks - 1)
        self._is_in_python = self._policy is not None or not is_compiled
        self._no_action = numpy.zeros((len(self._pad), *(self.model.action_space.shape or ())))
        own: Any = self.model
        self._update: CompiledUpdate | ModelUpdate = (
            CompiledUpdate(own, report_estimate, tracks, traced, self._is_in_python, observe)
            if is_compiled
            else ModelUpdate(own, report_estimate, tracks, world.measurement, observe)
        )
        usual = getattr(self.task.parameters, "sampling_interval", None) or self.task.interval
        self._usual = None if usual is None else float(usual)
        """Usual interval of measurements, s; None: they have none."""
        self._least = 0.0 if usual is None else max(LEAST_INTERVAL, self.model.filter.least_interval) * usual
        self._scan_interval = getattr(self.task.recording, "scan_interval", None)
        of_tracks = f"{tracks} track{'s' * (tracks > 1)}"
        version = f"filtergym {importlib.metadata.version('filtergym')}"
        self._owner = (self.task.id, f"interface {self.task.interface}", name, of_tracks, version)
        self._state: OnlineState | None = None
        self._valid: Estimate | None = None
        """Last estimate without a lost track."""

    def __repr__(self) -> str:
        takes = ", ".join(f"{name} ({text})" for name, text in self.input.values.items())
        return f"<OnlineFilter {self.name!r} of {self.task.id}; update takes {takes}>"

    def __reduce__(self) -> Any:
        """Raise TypeError, since compiled code of this process cannot be copied or pickled."""
        raise TypeError(
            "a running filter cannot be copied or pickled: make another with filtergym.online, and restore the state "
            "that save of this one returns"
        )

    # --- public methods

    def start(
        self, mean: Any = None, covariance: Any = None, time: Any = 0.0, *, tracks: Any = None, **values: Any
    ) -> None:
        """Start the track, or all parallel tracks, with an initial estimate.

        Args:
            mean: initial estimate, ``(C,)``, or of several tracks ``(C, N)``.
            covariance: covariance of its error, ``(C, C)`` or ``(C, C, N)``.
            time: time of the initial estimate, s, a number or ``(N,)``; a number too large for seconds since 1970 is
                milli-, micro- or nanoseconds since then, as in a log.
            tracks: numbers of the tracks to restart while the others continue; default: all. Measurements from before
                the restart cannot arrive late any more, for any track.
            **values: other initial values that the environment requires, see ``input.start_values``.

        Raises:
            ValueError: for values that are missing, unknown, or of another shape.
        """
        self.input.check_names(values, self.input.start_values)
        given = {**values, **{n: v for n, v in (("mean", mean), ("covariance", covariance)) if v is not None}}
        initial, memory = self.input.start(self._times(time), given)
        self._check_covariance(initial)
        if tracks is not None:
            self._check_restart()
        begun = self._begin(initial, memory)
        self._set_state(begun if tracks is None else self._merge(begun, tracks))

    def _begin(self, initial: Any, memory: Any) -> OnlineState:
        own = self._policy
        policy = self._update.blank_policy if own is None else own.begin(range(self.tracks))
        state = self.model.start_filter(self._padded(initial))
        return OnlineState(state, memory, policy, numpy.ones(self.tracks, dtype=bool))

    def start_from(self, first: dict[str, Any], second: dict[str, Any]) -> None:
        """Start the track with an estimate from its first two measurements.

        Args:
            first: ``time`` and values of the sensors of the first measurement, as in :meth:`update`.
            second: those of the second measurement.

        Raises:
            ValueError: for values that are missing or unknown, or where two measurements cannot start a track.
        """
        for measured in (first, second):
            self.input.check_names(measured, {**self.input.values, "time": "s"})
            if measured.get("time") is None:
                raise ValueError("each of the two measurements needs its time")
        times = [numpy.atleast_1d(self._times(measured["time"])) for measured in (first, second)]
        if any((time != time[0]).any() for time in times):
            raise ValueError("several tracks start from two measurements of one time each")
        first, second = (
            {**measured, "time": float(time[0])}
            for measured, time in zip((first, second), times, strict=True)
        )
        self.start(**self.input.start_from(first, second), time=second["time"])

    def update(self, time: Any = None, **values: Any) -> Estimate:
        """Update the filter with a measurement and return the estimate.

        A measurement of the same time as the last is fused with it, where the sensors allow it. With a ``lag``, a
        measurement may be older than the last: the filter goes back to its time, and processes the later measurements
        again. At the time of another measurement it adds the missing values of that one, or else is fused with it.

        Args:
            time: time in s, a number or ``(N,)``; default: one sampling interval after the last.
            **values: values of the sensors, by the names of ``input.values``; a missing value is None, NaN or left out.
                Numbers, or arrays of one track; for several tracks with N last.

        Returns:
            The estimate at that time; of a late measurement at the time of the last one.

        Raises:
            ValueError: for values that are missing, unknown or of another shape, or a time that does not increase, or
                is older than ``lag`` allows; the filter is then unchanged, except for :attr:`too_late`.
        """
        at = self._time_of(time)
        self.input.check_names(values, self.input.values)
        if self._lag and _any(at <= self._running().input["time"]):
            return self._take_late(at, values)
        return self._take(at, values)

    @property
    def too_late(self) -> int:
        """Number of measurements since the start that were older than ``lag`` and therefore rejected."""
        return self._running().too_late

    def _take(self, at: Any, values: Mapping[str, Any]) -> Estimate:
        """Update with a measurement not older than the last one; return the estimate."""
        before = self._running()
        last = before.input["time"]
        if _any((at >= SINCE_1970) & (last < SINCE_1970)):
            raise ValueError(
                f"time {quote_shortened(_plain(at))} s counts from 1970, but the last one, {_plain(last)} s, does not: "
                "start the track with start(time=...) of the same clock"
            )
        together = self.input.fuses and before.measurements > 0 and not _any(at != last)
        if _any(at <= last) and not together:
            raise ValueError(
                f"time must increase: the last measurement was at {_plain(last)} s, got {quote_shortened(_plain(at))}"
            )
        if not together and self._usual is not None and _any(at - last < self._least):
            self._refuse_interval(at)
        scans = () if together or self._scan_interval is None else self._missed_scans(last, at)
        kept = self._snapshot() if self._lag or together or scans else None
        try:
            for scan in scans:
                self._step(scan, {})
            found = self._step(at, values)
            if together and not (numpy.isfinite(found.mean).all() and numpy.isfinite(found.covariance).all()):
                raise ValueError(
                    f"{self.name!r} cannot take two measurements of one time, {_plain(at)} s: give the second a later "
                    "one"
                )
        except BaseException:
            if kept is not None:
                self._resume(kept)
            raise
        if self._lag and kept is not None:
            self._remember(Taken(at, copy.deepcopy(values), kept._replace(history=History())))
        return found

    def _take_late(self, at: Any, values: Mapping[str, Any]) -> Estimate:
        """Go back to a late measurement's time, process it and the later ones again; return the last
        estimate.
        """
        state = self._running()
        taken = state.history.taken
        oldest = taken[0].before.input["time"] if taken else state.input["time"]
        if _any(at <= oldest):
            self._state = state._replace(too_late=state.too_late + 1)
            raise ValueError(
                f"the measurement of {_plain(at)} s comes too late: measurements until {_plain(oldest)} s are final; "
                f"{state.too_late + 1:,} were rejected so far, and a longer lag accepts more"
            )
        place = sum(not _any(one.time > at) for one in taken)
        before, after = taken[:place], taken[place:]
        if any(_any(one.time <= at) for one in after):
            raise ValueError(
                f"a measurement of several tracks is late for all of them alike, got {quote_shortened(at.tolist())}"
            )
        again = [(at, values), *((one.time, one.values) for one in after)]
        if before and not _any(before[-1].time != at):
            both = _supply(before[-1].values, values)
            if both is not None:
                again[0] = at, both
                before, after = before[:-1], (before[-1], *after)
        kept = self._snapshot()
        try:
            if after:
                self._resume(after[0].before._replace(history=History(before), too_late=state.too_late))
            return [self._take(time, values) for time, values in again][-1]
        except BaseException:
            self._resume(kept)
            raise

    def _remember(self, one: Taken) -> None:
        """Store a processed measurement, and drop those older than ``lag``."""
        state = self._running()
        taken = (*state.history.taken, one)
        if isinstance(self._lag, timedelta):
            first = one.time - self._lag.total_seconds()
            taken = tuple(old for old in taken if _any(old.time >= first))
        else:
            taken = taken[-self._lag :]
        self._state = state._replace(history=History(taken))

    def _missed_scans(self, last: Any, at: Any) -> list[Any]:
        """Return the times of missed scans between the last measurement and this one, for sensors with scans."""
        interval = self._scan_interval
        scans = int(max(numpy.rint((at - last) / interval).max(), 1))
        if scans > MOST_MISSED:
            raise ValueError(
                f"{_plain(at - last)} s lie between two measurements, {scans - 1:,} scans of {interval:g} s: start the "
                "track anew"
            )
        return [last + (at - last) * number / scans for number in range(1, scans)]

    def _step(self, at: Any, values: Mapping[str, Any]) -> Estimate:
        measurement, memory = self.input.measure(self._running().input, at, values)
        found = self._estimate(at, self._advance(measurement, memory))
        if any(found.lost):
            return replace(found, lost=self._explain(found, measurement))
        self._valid = found
        return found

    def _explain(self, found: Estimate, measurement: Any) -> Any:
        """Return why each track is lost, with the task's explanation from the last valid estimates."""
        near = self._valid if self._is_policy else found
        if near is None:
            return found.lost
        n = len(near.mean)
        mean, covariance = near.mean.reshape(n, -1), near.covariance.reshape(n, n, -1)
        words: list[str] = numpy.atleast_1d(found.lost).tolist()
        lost = find_companion(self.task, LostTracks)
        if lost is None or lost.explain is None:
            return found.lost
        for i, fault in enumerate(words):
            track = numpy.array([i])
            given = self._received_of(measurement, track)
            reason = fault and lost.explain(self.task, mean[..., track], covariance[..., track], given)
            words[i] = f"the estimate is not finite: {reason}" if reason else fault
        return self._each(words)

    def _received_of(self, measurement: Any, track: numpy.ndarray) -> Any:
        """Return the measurement of one track, in arrays ``(..., 1)`` of the task's types."""
        memory = MeasurementMemory(self.input.measurement, self.tracks)
        memory.put(measurement)
        return select_lanes(memory.copy(), track)

    def _advance(self, measurement: Any, memory: Any) -> dict[str, Any]:
        """Update with the task's measurement, choosing an action if due; return mean, covariance and statistics
        by name.
        """
        before: Any = self._running()
        update = self._update
        # Equal to _replace, which takes longer than the filter: other input, one more measurement.
        after = OnlineState._make((None, memory, *before[2:4], before.measurements + 1, *before[5:]))
        update.receive(measurement)
        if self._policy is not None:
            after = self._decide(after, update.observation)
        elif self.watch is not None and before.measurements % self._interval == 0:
            after = self._compare_inputs(after, update.observed[: self.tracks])
        if self._is_in_python:
            update.act(self._no_action if self._policy is None else after.action[self._pad])
        self._state = after
        return update.report()

    def _compare_inputs(self, state: OnlineState, observation: numpy.ndarray) -> OnlineState:
        """Compare a network's inputs ``(N, fields)`` with those of its training."""
        if self.watch is not None and state.fresh is not None:
            self.watch.look(observation, state.fresh)
        return state._replace(fresh=numpy.zeros(self.tracks, dtype=bool))

    def predict(self, time: Any = None, **values: Any) -> Estimate:
        """Return the predicted estimate at a time without a measurement; the filter does not change.

        Args:
            time: time in s, a number or ``(N,)``; default: one sampling interval after the last.
            **values: values of inertial sensors, where the environment requires them.

        Raises:
            ValueError: for values or a time that :meth:`update` rejects.
        """
        at = self._time_of(time)
        self.input.check_names(values, self.input.values)
        kept = self._snapshot()
        try:
            return self._take(at, values)
        finally:
            self._resume(kept)

    def save(self) -> OnlineState:
        """Return a copy of the filter's complete state, from which this or another process can continue."""
        return copy.deepcopy(self._snapshot()._replace(owner=self._owner))

    def _snapshot(self) -> OnlineState:
        state, update = self._running(), self._update
        state = state._replace(filter=update.state, watch=None if self.watch is None else self.watch.memory)
        if not self._is_in_python:
            return state._replace(policy=update.policy_state)
        own = getattr(self.model.filter, "own", None) if self.model.filter.in_python else None
        return copy.deepcopy(state._replace(python=None if own is None else (own.memory, own.step_number)))

    def restore(self, state: OnlineState) -> None:
        """Set the filter to a state that :meth:`save` has returned.

        Raises:
            ValueError: for any other object, or an invalid state; the filter is then unchanged.
        """
        if not isinstance(state, OnlineState):
            raise ValueError(f"restore takes a state that save has returned, got {quote_shortened(state)}")
        if not isinstance(state.owner, tuple) or state.owner != self._owner:
            owner = ", ".join(map(str, state.owner)) if isinstance(state.owner, tuple) else "no filter"
            raise ValueError(
                f"this state is of {quote_shortened(owner or 'no filter')}, and the filter is {', '.join(self._owner)}"
            )
        state = state if self._lag else state._replace(history=History())
        kept = None if self._state is None else self._snapshot()
        try:
            self._check_state(state)
            self._resume(state)
        except Exception as error:  # a changed part can raise any error
            self._state = None
            if kept is not None:
                self._resume(kept)
            reason = f"{type(error).__name__}: {error}"
            raise ValueError(
                f"{self.name!r} cannot continue from this state, which is not one that save has returned: "
                f"{quote_shortened(reason)}"
            ) from None

    def _check_state(self, state: OnlineState) -> None:
        """Check a state by an update with an example measurement; any error may be raised."""
        taken = state.history.taken
        first_track = lambda array: array[..., [0] * self.tracks]  # noqa: E731
        begun = self._begin(map_arrays(first_track, self.input.initial), {})
        for one in (state, *(own.before for own in taken)):
            if not self.model.filter.in_python and _shapes(one.filter) != _shapes(begun.filter):
                raise ValueError("filter must be arrays of the shapes that this filter has")
            if self._policy is None and _shapes(one.policy) != _shapes(begun.policy):
                raise ValueError("policy must be arrays of the shapes that this policy has")
            self._resume(one)
            check_integer("measurements", one.measurements, 0)
            check_integer("too_late", one.too_late, 0)
            if numpy.asarray(one.fresh).shape != (self.tracks,):
                raise ValueError(f"fresh must mark which of {self.tracks} tracks have just begun")
            self._check_input(one.input)
            if not self.model.filter.in_python:
                track = first_track if self.tracks > 1 else lambda array: array[..., 0]
                example = map_arrays(track, self.input.measurement)
                self._estimate(numpy.zeros(self.tracks), self._advance(example, one.input))
        for own in taken:
            self._times(own.time)
            self.input.check_names(own.values, self.input.values)

    def _check_input(self, memory: Any) -> None:
        self._times(memory["time"])
        for name, values in memory.items():
            if self.tracks > 1 and numpy.ndim(values) and numpy.shape(values)[-1] != self.tracks:
                raise ValueError(f"{name} of the measurements before must be of {self.tracks} tracks")
        with suppress(ValueError):  # some environments reject a measurement without values
            self.input.measure(memory, memory["time"] + self._default_interval(), {})

    def _resume(self, state: OnlineState) -> None:
        """Set the filter to a copy of a state."""
        state = copy.deepcopy(state) if self._is_in_python else state
        if self.model.filter.in_python:
            self.model.filter.own.memory, self.model.filter.own.step_number = state.python
        if self.watch is not None:
            self.watch.memory = state.watch
        self._set_state(state)

    def _set_state(self, state: OnlineState) -> None:
        self._update.resume(state.filter, state.policy)
        self._state = state._replace(filter=None, policy=state.policy if self._policy else None)

    # --- one measurement

    def _decide(self, state: OnlineState, inputs: numpy.ndarray) -> OnlineState:
        """Let the policy choose an action if a decision is due; return the state."""
        assert self._policy is not None
        number, observation = state.measurements - 1, inputs.T
        if number:
            state = state._replace(total=self._means.add(state.total, observation))
        if number and number % self._interval == 0:
            observation = self._means.show(observation, state.total, numpy)
            state = state._replace(total=0.0)
        if number % self._interval == 0:
            inputs = numpy.ascontiguousarray(observation[:, : self.tracks].T)
            action, memory = self._policy.predict(inputs, state.policy, state.fresh)
            state = self._compare_inputs(state._replace(policy=memory, action=action), inputs)
        return state

    def _estimate(self, time: Any, found: dict[str, Any]) -> Estimate:
        lost, count = found.pop("lost"), self.tracks
        words = [FAULTS[int(i) - 1] if i else "" for i in (lost if count > 1 else (lost,))]
        departure = self._each([""] * count if self.watch is None else self.watch.describe())
        further = {"time": _plain(time), "lost": self._each(words), "departure": departure}
        estimate = object.__new__(Estimate)  # whose __init__ takes twice as long as the filter
        estimate.__dict__.update(self._same_of_estimates, **found, **further)
        return estimate

    def _each(self, words: list[str]) -> Any:
        return words[0] if self.tracks == 1 else words

    # --- checks of the arguments

    def _running(self) -> OnlineState:
        if self._state is None:
            raise ValueError("the track has not been started: call start first")
        return self._state

    def _times(self, time: Any) -> Any:
        """Return a user's time as finite seconds, an array ``(N,)``, or for one track a float."""
        found = read_numbers("time", time)
        if found.shape not in ((), (self.tracks,)) or not numpy.isfinite(found).all():
            raise ValueError(
                f"time must be finite seconds, a number or ({self.tracks},) numbers, got {quote_shortened(time)}"
            )
        found = found / time_unit(found.flat[0])
        return found.item() if self.tracks == 1 else numpy.broadcast_to(found, (self.tracks,)).copy()

    def _default_interval(self) -> float:
        if self._usual is None:
            raise ValueError(f"{self.task.id} has no sampling interval: give update the time")
        return self._usual

    def _time_of(self, time: Any) -> Any:
        """Return the time of a measurement, s, by default one sampling interval after the last."""
        if time is None:
            return self._running().input["time"] + self._default_interval()
        if self.tracks == 1 and isinstance(time, float | int) and 0.0 <= time < SINCE_1970:
            return float(time)
        return self._times(time)

    def _refuse_interval(self, at: Any) -> None:
        """Raise ValueError with the least permitted interval between measurements."""
        last, share = self._running().input["time"], self.model.filter.least_interval
        why = f": the gains of {self.name!r} are made for {self._usual:g} s and make speeds of noise below"
        raise ValueError(
            f"measurements of {self.task.id} are at least {self._least:.2g} s apart, got {quote_shortened(_plain(at))} "
            f"s after {_plain(last)} s{why if share > LEAST_INTERVAL else ''}"
        )

    def _check_covariance(self, initial: Any) -> None:
        covariance = getattr(initial, "covariance", None)
        if covariance is None:
            return
        # Components that the environment knows exactly at the start may have variance zero: the others must be
        # definite.
        known = numpy.einsum("iin->in", self.input.initial.covariance)[:, :1] == 0.0
        exact = known & (numpy.einsum("iin->in", covariance) == 0.0) & (covariance == 0.0).all(axis=1)
        fault = _fault_of(initial.mean, covariance + numpy.eye(len(exact))[:, :, None] * exact)
        if fault.any():
            track = int((fault > 0.0).argmax())
            which = f" of track {track}" if self.tracks > 1 else ""
            raise ValueError(
                f"the initial covariance{which} must be symmetric and positive definite, got "
                f"{quote_shortened(covariance[..., track].tolist())}"
            )

    def _padded(self, part: Any) -> Any:
        """Return arrays with the last track repeated up to a multiple of eight lanes, which fixes rounding."""
        return map_arrays(lambda array: numpy.ascontiguousarray(array[..., self._pad]), part)

    def _check_restart(self) -> None:
        self._running()
        if self._interval > 1 or self.model.filter.in_python:
            raise ValueError(
                f"{self.name!r} cannot restart single tracks "
                f"({'decisions hold for several measurements' if self._interval > 1 else 'it runs in Python'}): run "
                "each with its own filter"
            )

    def _merge(self, new: OnlineState, tracks: Any) -> OnlineState:
        """Return the present state with the chosen tracks replaced by those of ``new``."""
        chosen = numpy.zeros(self.tracks, dtype=bool)
        try:
            numbers = numpy.asarray(tracks)
        except ValueError:  # rows of several lengths
            numbers = numpy.array(None)
        if numbers.dtype.kind not in "iub" or (numbers.dtype.kind == "b") != (
            numbers.shape == (self.tracks,)
        ):
            numbers = numpy.array([-1 - self.tracks])
        try:
            chosen[numbers] = True
        except IndexError:
            raise ValueError(
                f"tracks are numbers from 0 to {self.tracks - 1}, got {quote_shortened(tracks)}"
            ) from None
        old, padded = self._snapshot(), chosen[self._pad]
        policy = old.policy if self._policy else select_nested(padded, new.policy, old.policy)
        one_track = new.input if chosen[0] else old.input
        return old._replace(
            filter=select_nested(padded, new.filter, old.filter),
            input=one_track if self.tracks == 1 else select_nested(chosen, new.input, old.input),
            policy=policy,
            fresh=chosen | old.fresh,
            history=History(),
        )


def _shapes(part: Any) -> list[tuple[int, ...]]:
    return [numpy.shape(array) for array in leaves(part)]


def report_estimate(model: Model, episode: Episode) -> dict[str, Any]:
    """Return mean, covariance and statistics of the measurement by name, from a model's filter."""
    records = model.filter.records(episode.filter, episode.measurement)
    mean, covariance = model.filter.mean(episode.filter), model.filter.covariance(episode.filter)
    known = {name: records[name] for name in REPORTED if name in records}
    if "lost" not in known:  # the filter inside a policy is not checked elsewhere
        nothing = 0.0 * model.task.xp.ones_like(mean[0])
        known["lost"] = find_fault(mean, covariance, nothing, nothing, model.task.xp)
    return {"mean": mean, "covariance": covariance, **known}


def _fault_of(mean: numpy.ndarray, covariance: numpy.ndarray) -> numpy.ndarray:
    nothing = numpy.zeros(mean.shape[-1])
    return numpy.asarray(find_fault(mean, covariance, nothing, nothing, numpy))


def _any(condition: Any) -> bool:
    return condition if condition.__class__ is bool else bool(numpy.count_nonzero(condition))


def _plain(values: Any) -> Any:
    """Return an array of equal values as a float, others unchanged."""
    return values if values.__class__ is float or (values != values[0]).any() else float(values[0])


def _check_lag(lag: Any) -> int | timedelta:
    if not isinstance(lag, timedelta):
        return check_integer("lag", lag, 0)
    if lag < timedelta(0):
        raise ValueError(f"lag must not be negative, got {lag}")
    return lag


def _supply(given: Mapping[str, Any], late: Mapping[str, Any]) -> dict[str, Any] | None:
    """Merge two measurements of the same time; None if the second adds nothing, or they differ."""
    both, new = dict(given), False
    for name, value in late.items():
        first, second = _numbers(given.get(name)), _numbers(value)
        there, also = numpy.isfinite(first), numpy.isfinite(second)
        if not there.any():
            both[name] = value
            new |= bool(also.any())
        elif also.any():
            if first.shape != second.shape or (first != second)[there & also].any():
                return None
            both[name] = numpy.where(there, first, second)
            new |= bool((also & ~there).any())
    return both if new else None


def _numbers(value: Any) -> numpy.ndarray:
    """Return a sensor's value as an array; NaN if it is no number."""
    try:
        return read_numbers("it", numpy.nan if value is None else value)
    except ValueError:
        return numpy.array(numpy.nan)
