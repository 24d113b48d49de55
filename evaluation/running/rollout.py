"""Runs of whole episodes from their seeds, with any competitor in the loop."""

import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...compiler.functions import Specialised, map_arrays
from ...compiler.native import optimised_code
from ...envs.contract.model import Episode, Model
from ...envs.contract.observation import Array
from ...envs.engine.compiled import CompiledModel, can_step
from ...envs.engine.episode_noise import identities_of_seeds, uniforms_of_seeds
from ...envs.engine.lanes import Lanes, whole_episode
from ...envs.engine.programs import Report
from ...envs.interface.requests import check_action
from ..competitors.filters import TRUTH_FREE_KINDS, close_loop
from ..competitors.kinds import (
    Kind,
    check_competitor,
    compilation_key,
    is_made_for_episodes,
    is_program,
    kind_of,
    make_competitor,
)
from ..competitors.smoothers import SmoothedTrack, check_open_loop, report_smoothed, report_world, run_forward
from ..competitors.steered_filter import compile_policy, trace_policy
from ..competitors.stepping import SteppingPolicy
from .stored_values import DRAWN_PREFIX
from .times import ProcessorTime, net_time

AT_ONCE = 2**18
"""Measurements, over all episodes side by side, in one call of native code."""

Progress = Callable[[int], None]
"""Function that is called with the number of measurements just done."""


def start_lanes(
    model: Model,
    seeds: Sequence[int],
    on_start: Callable[[Episode], None] | None = None,
    report: Report | None = None,
) -> Lanes:
    """Return one episode for each seed, side by side, with its first measurement.

    Args:
        model: task with a bank.
        seeds: seeds of the episodes.
        on_start: called with the episodes at the start of the track.
        report: report function that will be applied to them; default: unknown.
    """
    lanes = Lanes(model, len(seeds), on_start=on_start, report=report)
    lanes.begin(identities_of_seeds(seeds))
    return lanes


def rollout(
    model: Model,
    competitor: Any,
    seeds: Sequence[int],
    report: Report = whole_episode,
    *,
    kind: Kind | None = None,
    name: str = "competitor",
) -> Iterator[tuple[Any, Array]]:
    """Run a competitor over one episode for each seed, measurement by measurement.

    Args:
        model: task with a bank; for a policy, that of its control.
        competitor: policy, estimator, smoother, reference or bound, or a class or function that makes it. A smoother
            runs over the episodes twice, the second time with its smoothed estimates.
        seeds: of the episodes, all run side by side.
        report: function of the model and the state after the update; default: the state itself.
        kind: kind of the competitor; default: its own.
        name: its name in errors.

    Yields:
        For every measurement the report, arrays ``(..., N)`` whose lanes beyond ``len(seeds)`` are padding, and the
        action applied to it, batch first.
    """
    kind = kind or kind_of(competitor)
    looped = model if kind == "policy" else _close_loop(model, competitor, kind, seeds, name)
    yield from _step(looped, competitor if kind == "policy" else None, seeds, report, name)


def _step(
    looped: Model, maker: Any, seeds: Sequence[int], report: Report, name: str
) -> Iterator[tuple[Any, Array]]:
    """Yield report and action at every measurement, of a policy's bank, or of a filter if ``maker`` is None."""
    lanes, action, policy, memory = start_lanes(looped, seeds, report=report), None, None, None
    if maker is None:
        action = numpy.zeros(len(seeds), dtype=numpy.int64)
    else:
        policy = SteppingPolicy(looped, check_competitor(name, make_competitor(maker, looped), "policy"))
        memory = policy.begin(seeds)
    for _ in range(lanes.decisions_per_episode):
        if policy is not None:
            action, memory = policy.predict(lanes.observe(), memory)
        for found, _ in lanes.decide(action, report):
            yield found, action


def _close_loop(model: Model, competitor: Any, kind: Kind, seeds: Sequence[int], name: str) -> Model:
    """Return a model whose filter is a competitor, or the smoothed estimates of a smoother in these episodes."""
    if kind == "smoother":
        check_open_loop(model, f"smoother {name!r}")
        competitor, kind = (
            SmoothedTrack(model.task, *_smoothed_estimates(model, competitor, seeds, name)),
            "estimator",
        )
    if is_made_for_episodes(competitor):
        competitor = competitor.of_episodes(model.task, seeds)
    return close_loop(model, competitor, kind, name, len(seeds), model.task.horizon)


def _smoothed_estimates(
    model: Model, competitor: Any, seeds: Sequence[int], name: str
) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return means ``(C, K, N)`` and covariances ``(C, C, K, N)`` of a smoother.

    Episodes of one length are smoothed together, from their last measurement on; after it that estimate is repeated.
    """
    task = model.task
    lengths = task.lengths(uniforms_of_seeds(seeds, task.noise))
    K, C, N = task.horizon, len(task.components), len(seeds)
    means, covariances = numpy.empty((C, K, N)), numpy.empty((C, C, K, N))
    for length in numpy.unique(lengths).tolist():
        lanes = numpy.flatnonzero(lengths == length)
        own = [seeds[lane] for lane in lanes.tolist()]
        looped = close_loop(model, competitor, "smoother", name, len(own))
        found = run_forward(looped, start_lanes(looped, own), length, name)
        for kept, answered in zip((means, covariances), found, strict=True):
            kept[..., :length, lanes] = answered[..., : len(own)]
            kept[..., length:, lanes] = answered[..., -1:, : len(own)]
    return means, covariances


class EpisodeReports(NamedTuple):
    """Reports on complete episodes."""

    found: dict[str, numpy.ndarray]
    """Arrays ``(episodes, time, ...)`` by name; not always one row after the other in memory."""
    action: numpy.ndarray | None
    """Action of a policy at each measurement, ``(episodes, time, ...)``; None for other competitors."""


def run_episodes(
    model: Model,
    competitor: Any,
    kind: Kind,
    seeds: Sequence[int],
    report: Report,
    name: str = "competitor",
    tick: Progress | None = None,
    more: tuple[Report, int] | None = None,
) -> EpisodeReports:
    """Run a competitor over one episode for each seed, and return the reports on every measurement.

    Where world, filter, policy and report are all compiled, all episodes are one call of native code; otherwise they
    are stepped. The numbers are the same.

    Args:
        model: task with a bank; for a policy, that of its control.
        competitor: policy, estimator, smoother, reference or bound, or a class or function that makes it.
        kind: kind of the competitor.
        seeds: seeds of the episodes, all run side by side.
        report: function of the model and the state that returns arrays ``(..., N)`` by name.
        name: name of the competitor in errors.
        tick: called with the number of measurements done.
        more: a larger report and the number of first episodes that it is for: for all it would take much memory. Names
            that begin with :data:`.stored_values.DRAWN_PREFIX` exist for these episodes only.
    """
    count, compiled_policy, tick = len(seeds), None, tick or (lambda measurements: None)
    is_policy = kind == "policy"
    looped = model if is_policy else _close_loop(model, competitor, kind, seeds, name)
    if is_policy:
        compiled_policy = _compiled_policy_of(model, competitor, name)
    if kind == "smoother" and isinstance(track := looped.filter.own.own, SmoothedTrack):
        forward = close_loop(model, competitor, kind, name, count)
        if can_step(forward, report_world):
            lanes = start_lanes(forward, seeds)
            length = lanes.decisions_per_episode * model.task.decision_interval
            reported, drawn = more or (report, 0)
            return _join_stretches(
                report_smoothed(looped, lanes, track, reported, length), count, tick, drawn
            )
    compiled = can_step(looped, report) and (more is None or can_step(looped, more[0]))
    if compiled and (compiled_policy is not None or not is_policy):
        if more is None:
            return _run_compiled(looped, compiled_policy, seeds, report, tick)
        parts = [_run_compiled(looped, compiled_policy, seeds[: more[1]], more[0], tick)]
        if more[1] < count:
            parts.append(_run_compiled(looped, compiled_policy, seeds[more[1] :], report, tick))
        return _one_after_another(parts)
    report, drawn = more or (report, 0)
    steps = _step(looped, competitor if is_policy else None, seeds, report, name)
    return _step_episodes(steps, count, is_policy, tick, drawn)


def run_stretches(
    model: Model, competitor: Any, kind: Kind, seeds: Sequence[int], report: Report, rows: int, name: str
) -> Iterator[dict[str, numpy.ndarray]]:
    """Run a competitor as :func:`run_episodes` does, in memory that does not grow with the episodes' length.

    Args:
        model: task with a bank; for a policy, that of its control.
        competitor: policy, estimator, smoother, reference or bound, or a class or function that makes it.
        kind: kind of the competitor.
        seeds: seeds of the episodes, all run side by side.
        report: function of the model and the state that returns arrays ``(..., N)`` by name.
        rows: number of measurements in one report, in whole decisions.
        name: name of the competitor in errors.

    Yields:
        Reports on successive stretches of measurements, arrays ``(rows, ..., episodes)`` by name.
    """
    interval, is_policy, policy = model.task.decision_interval, kind == "policy", None
    looped = model if is_policy else _close_loop(model, competitor, kind, seeds, name)
    if is_policy:
        policy = _compiled_policy_of(model, competitor, name)
    length = model.task.horizon // interval * interval
    rows = max(rows // interval, 1) * interval
    if can_step(looped, report) and (policy is not None or not is_policy):
        lanes = start_lanes(looped, seeds, report=report)
        for first in range(0, length, rows):
            yield _without_padding(lanes.run(report, policy, min(rows, length - first))[0], len(seeds))
        return
    steps = _step(looped, competitor if is_policy else None, seeds, report, name)
    while some := [found for found, _ in itertools.islice(steps, rows)]:
        together = {key: numpy.stack([each[key] for each in some]) for key in some[0]}
        yield _without_padding(together, len(seeds))


def _without_padding(report: Mapping[str, numpy.ndarray], count: int) -> dict[str, numpy.ndarray]:
    """Return the first lanes of a report as copies: views would hold the memory of the padding."""
    return {name: values[..., :count].copy() for name, values in report.items()}


def _run_compiled(
    looped: Model, compiled_policy: Specialised | None, seeds: Sequence[int], report: Report, tick: Progress
) -> EpisodeReports:
    """Run compiled episodes in native code, ``AT_ONCE`` measurements in each call; return their reports."""
    lanes, count = start_lanes(looped, seeds, report=report), len(seeds)
    interval = looped.task.decision_interval
    decisions, most = lanes.decisions_per_episode, max(1, AT_ONCE // (lanes.width * interval))

    def run(decisions: int, whole: bool) -> EpisodeReports:
        """Return the reports on a number of decisions; on whole episodes as views."""
        reports, actions = lanes.run(report, compiled_policy, decisions * interval)
        tick(count * decisions * interval)
        found = {name: _episodes_first(values, count) for name, values in reports.items()}
        steered = None if actions is None else _checked_actions(looped, actions, count)
        return (
            EpisodeReports(found, steered)
            if whole
            else map_arrays(numpy.ascontiguousarray, EpisodeReports(found, steered))
        )

    parts = [run(min(most, decisions - i), decisions <= most) for i in range(0, decisions, most)]
    return _one_after_another(parts, axis=1)


def _one_after_another(parts: Sequence[EpisodeReports], axis: int = 0) -> EpisodeReports:
    """Concatenate parts along an axis, and empty them on the way; reports on some episodes only are not padded."""
    if len(parts) == 1:
        return parts[0]
    found = {
        name: numpy.concatenate([part.found.pop(name) for part in parts if name in part.found], axis)
        for name in list(parts[0].found)
    }
    actions = [part.action for part in parts if part.action is not None]
    return EpisodeReports(found, numpy.concatenate(actions, axis) if actions else None)


def _join_stretches(
    stretches: Iterator[dict[str, numpy.ndarray]], count: int, tick: Progress, drawn: int
) -> EpisodeReports:
    """Concatenate reports on stretches of measurements, arrays ``(scans, ..., N)`` by name."""
    series: dict[str, list[numpy.ndarray]] = {}
    for found in stretches:
        for name, values in found.items():
            kept = drawn if name.startswith(DRAWN_PREFIX) else count
            series.setdefault(name, []).append(values[..., :kept].copy())
        tick(count * len(next(iter(found.values()))))
    return EpisodeReports(
        {name: _episodes_first(numpy.concatenate(values), count) for name, values in series.items()}, None
    )


def _step_episodes(
    steps: Iterator[tuple[Any, Array]], count: int, is_policy: bool, tick: Progress, drawn: int
) -> EpisodeReports:
    """Run episodes step by step and return the reports."""
    series: dict[str, list[numpy.ndarray]] = {}
    actions = []
    for found, action in steps:
        for name, values in found.items():
            kept = drawn if name.startswith(DRAWN_PREFIX) else count
            if kept < values.shape[-1]:
                values = values[..., :kept].copy()  # a view would keep the numbers of all
            series.setdefault(name, []).append(values)
        actions.append(numpy.asarray(action))
        tick(count)
    together = {name: _episodes_first(numpy.stack(values), count) for name, values in series.items()}
    return EpisodeReports(together, numpy.stack(actions, axis=1) if is_policy else None)


def _compiled_policy_of(model: Model, competitor: Any, name: str) -> Specialised | None:
    """Return the policy in native code; None for a policy that runs in Python."""

    def trace() -> Specialised | None:
        policy = check_competitor(name, make_competitor(competitor, model), "policy")
        found: Specialised | None = compile_policy(model, policy, trace_policy)
        return found

    if not isinstance(model, CompiledModel):
        return None
    try:
        return model.programs.keep((run_episodes, compilation_key(competitor)), trace)
    except TypeError:  # the maker has no hash
        return trace()


def _episodes_first(values: numpy.ndarray, count: int) -> numpy.ndarray:
    """Return a view ``(episodes, time, ...)`` of arrays ``(time, ..., N)``, without the padding."""
    return numpy.moveaxis(values[..., :count], -1, 0)


def _checked_actions(model: Model, actions: numpy.ndarray, count: int) -> numpy.ndarray:
    """Return actions, episodes first; raise ValueError if one is outside the action space (but for a box's limits)."""
    space, kept = model.action_space, _episodes_first(actions, count)
    if isinstance(space, gymnasium.spaces.Discrete):
        kept = kept.astype(numpy.int64)
        wrong = (kept < 0) | (kept >= space.n)
    else:
        wrong = ~numpy.isfinite(kept)
    for k in numpy.flatnonzero(wrong.any(axis=(0, *range(2, wrong.ndim))))[:1]:
        check_action(space, kept[:, k], count)
    return kept


TIMED_EPISODES, TIMED_MEASUREMENTS = 512, 256
"""Episodes side by side, and measurements of each, in a measurement of time: enough for two digits."""
COMPILED_EPISODES = 64
"""Episodes side by side of native code: the states of large filters stay in the core's own cache."""
RUN_SECONDS = 0.01
"""Approximate duration of a run, s, where the episodes are long enough."""
TIMED_SECONDS, FEWEST_RUNS, MOST_RUNS = 0.02, 3, 20
"""Duration, s, and numbers of repeated runs, of which the quickest counts."""
TIMED_ROUNDS, MOST_ROUNDS = 3, 10
"""Numbers of measurements of a competitor and of the world in turn: more while their times differ much."""


def measure_time(
    model: Model, competitor: Any, kind: Kind, seeds: Sequence[int], name: str = "competitor"
) -> ProcessorTime | None:
    """Measure the processor time that a competitor takes for a measurement.

    Many episodes run side by side, after tracing and compilation. For native code the quickest of several runs counts,
    for Python code the median decision. The time of the simulated world (:func:`measure_world`) is
    subtracted (:func:`.times.net_time`). A program's time is that of its own process.

    Args:
        model: task with a bank; for a policy, that of its control.
        competitor: as in :func:`rollout`.
        kind: kind of the competitor.
        seeds: seeds of episodes, which are repeated up to that number.
        name: name of the competitor in errors.

    Returns:
        None for smoothers, bounds and competitors made for given episodes, and where a program's time is not known.
    """
    if kind in ("smoother", "bound") or is_made_for_episodes(competitor):
        return None
    run = _timed_run(model, competitor, kind, seeds, name)
    spent = run()
    if spent is None or spent.own:
        return spent
    together, alone = [spent.nanoseconds], [measure_world(model, kind, seeds)]
    found = net_time(together, alone, spent.compiled)
    # In turn, since the speed of a processor that others use changes.
    while spent.compiled and (
        len(alone) < TIMED_ROUNDS or (len(alone) < MOST_ROUNDS and not found.is_certain)
    ):
        together.append((run() or spent).nanoseconds)
        alone.append(measure_world(model, kind, seeds))
        found = net_time(together, alone, True)
    return found


class IdleEstimator:
    """Estimator or reference that repeats the initial estimate: a run takes the time of the simulated world."""

    traceable = True
    disturbances = None

    def start(self, initial: Any, _: Any) -> tuple[Array, Array]:
        """Return the initial mean and covariance."""
        return initial.mean, initial.covariance

    def update(self, memory: tuple[Array, Array], *_: Any) -> tuple[Array, Array, tuple[Array, Array]]:
        """Return the initial mean and covariance again."""
        return *memory, memory


def measure_world(model: Model, kind: Kind, seeds: Sequence[int]) -> float:
    """Return the processor time of the simulated world for a measurement, ns: motion and sensors.

    For estimators it includes the check of every estimate; estimates of policies and references are not checked.
    """
    idle_kind: Kind = "estimator" if kind in TRUTH_FREE_KINDS else "reference"

    def prepare() -> Callable[[], ProcessorTime | None]:
        return _timed_run(model, IdleEstimator, idle_kind, seeds, "idle")

    key = measure_world, idle_kind
    run = model.programs.keep(key, prepare) if isinstance(model, CompiledModel) else prepare()
    spent = run()
    return spent.nanoseconds if spent is not None else 0.0


def _timed_run(
    model: Model, competitor: Any, kind: Kind, seeds: Sequence[int], name: str
) -> Callable[[], ProcessorTime | None]:
    """Return a function that measures the time of world and competitor together, or of a program's process."""
    seeds = list(itertools.islice(itertools.cycle(seeds), TIMED_EPISODES))
    task, is_policy = model.task, kind == "policy"
    clock = time.process_time
    if own := is_program(competitor):
        competitor = competitor(task)
        clock = competitor.processor_seconds
    decisions = max(1, min(TIMED_MEASUREMENTS, task.horizon) // task.decision_interval)
    looped = model if is_policy else _close_loop(model, competitor, kind, seeds, name)
    compiled_policy = _compiled_policy_of(model, competitor, name) if is_policy else None
    if can_step(looped, _report_estimate) and (compiled_policy is not None or not is_policy):
        timed = _compiled_decision(looped, compiled_policy, seeds[:COMPILED_EPISODES], decisions)
        return lambda: ProcessorTime(1e9 * timed() / (COMPILED_EPISODES * task.decision_interval), True)
    steps = _step(looped, competitor if is_policy else None, seeds, _report_estimate, name)

    def run_in_python() -> ProcessorTime | None:
        with warnings.catch_warnings():
            if own:
                warnings.simplefilter("ignore")  # the evaluation has already warned of a program's faults
            spent = _time_steps(steps, decisions, task.decision_interval, clock)
        if math.isnan(spent):
            return None
        return ProcessorTime(1e9 * spent / (len(seeds) * task.decision_interval), False, own)

    return run_in_python


def _report_estimate(model: Model, episode: Episode) -> dict[str, Any]:
    return {"estimate": model.mean(episode)}


def _compiled_decision(
    looped: Model, compiled_policy: Specialised | None, seeds: Sequence[int], decisions: int
) -> Callable[[], float]:
    """Return a function that measures the seconds of a decision of all episodes: the quickest run of optimised code."""
    identities = identities_of_seeds(seeds)
    lanes = start_lanes(looped, seeds, report=_report_estimate)
    interval = looped.task.decision_interval

    def run(count: int) -> float:
        lanes.begin(identities)
        began = time.process_time()
        lanes.run(_report_estimate, compiled_policy, count * interval)
        return time.process_time() - began

    with optimised_code():
        run(1)  # compiles
    # And a first decision. Where a clock with coarse ticks has not advanced, it took one tick at most.
    setting_up = max(min(run(1) for _ in range(FEWEST_RUNS)), time.get_clock_info("process_time").resolution)
    # No step branches, so every decision takes the same time: a slow one need not be repeated to the end.
    count = min(decisions, 1 + math.ceil(RUN_SECONDS / setting_up))
    if count == 1:
        return lambda: setting_up

    def measure() -> float:
        first: list[float] = []
        spent: list[float] = []
        while len(spent) < FEWEST_RUNS or (sum(spent) < TIMED_SECONDS and len(spent) < MOST_RUNS):
            first.append(run(1))  # in turn: an error of the first decision must not enter every measurement
            spent.append(run(count))
        return (min(spent) - min(first)) / (count - 1)

    return measure


def _time_steps(
    steps: Iterator[Any], decisions: int, interval: int, clock: Callable[[], float] = time.process_time
) -> float:
    """Return the seconds of the median decision, by a clock."""
    spent: list[float] = []
    for _ in range(decisions):
        began = clock()
        for _ in range(interval):
            next(steps)
        spent.append(clock() - began)
        if sum(spent[1:]) > 2.0 * TIMED_SECONDS:
            break
    return float(numpy.median(spent[1:] or spent))  # the first starts the episodes and compiles


def run_competitor(
    model: Model, competitor: Any, kind: Kind, seeds: Sequence[int], report: Report
) -> dict[str, numpy.ndarray]:
    """Run a competitor by :func:`run_episodes`, and return the reports, ``(episodes, time, ...)``."""
    return run_episodes(model, competitor, kind, seeds, report).found
