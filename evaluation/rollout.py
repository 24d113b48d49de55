"""Episodes from their seeds to their end, with a policy, a reference estimator or a bound in the loop."""

import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy

from ..compiler.functions import mapped, padded_width
from ..envs.compiled import Report
from ..envs.lanes import Lanes
from ..envs.observation import Array
from ..envs.task import Episode, Outside, Task, named_arrays
from .competitors import Kind
from .dataset import FAULTS
from .stepping import SteppingPolicy

Progress = Callable[[int], None]
"""Told the number of measurements just done."""


def started_lanes(task: Task, seeds: Sequence[int], begun: Callable[[Episode], None] | None = None) -> Lanes:
    """Return one episode for each seed, side by side, with its first measurement made.

    Args:
        task: the estimation problem.
        seeds: of the episodes.
        begun: told of the episodes at the start of the track.
    """
    lanes = Lanes(task, len(seeds), begun=begun)
    for lane, seed in enumerate(seeds):
        lanes.seed(lane, numpy.random.default_rng(seed))
    lanes.restart()
    return lanes


def run_policy(
    task: Task,
    policy: Any,
    seeds: Sequence[int],
    record: Callable[[Any], None],
    tick: Progress,
    report: Report = lambda task, episode: episode,
    acted: Callable[[Array], None] | None = None,
) -> None:
    """Run a policy over one episode for each seed.

    Args:
        task: the estimation problem, under the policy's control.
        policy: anything with Stable-Baselines3's ``predict``.
        seeds: of the episodes, all run side by side.
        record: called after every action with the report on it; lanes beyond ``len(seeds)`` are padding.
        report: function of the task and the state after the action; default: the state itself.
        tick: told of progress.
        acted: called after every ``record`` with the actions applied to the same measurement, batch first.
    """
    lanes = started_lanes(task, seeds)
    stepping = SteppingPolicy(task, policy)
    memory = stepping.begin(seeds)
    for _ in range(lanes.decisions_per_episode):
        action, memory = stepping.predict(lanes.observe(), memory)
        for found, _ in lanes.decide(action, report):
            record(found)
            if acted is not None:
                acted(action)
        tick(lanes.count * task.decision_interval)


def _run_outside(
    task: Task,
    start: Callable[[Episode], None],
    update: Callable[[Episode], tuple[Array, Array]],
    seeds: Sequence[int],
    record: Callable[[Any], None],
    tick: Progress,
) -> None:
    """Run episodes in which ``update`` estimates in place of a bank."""
    task = task.estimated_outside()

    def estimated(episode: Episode) -> Episode:
        mean, covariance = update(episode)
        feedback = task.feedback(mean, episode.measurement)
        return episode._replace(bank=Outside(mean, covariance, feedback))

    lanes = started_lanes(task, seeds, start)
    for _ in range(lanes.decisions_per_episode):
        lanes.step(estimated, lambda episode, _: record(episode))
        tick(lanes.count * task.decision_interval)


def run_reference(
    task: Task, reference: Any, seeds: Sequence[int], record: Callable[[Any], None], tick: Progress
) -> None:
    """Run a reference in place of actions; arguments as in :func:`run_policy`."""
    memory: Any = None

    def start(episode: Episode) -> None:
        nonlocal memory
        memory = reference.start(episode.measurement, episode.truth)

    def update(episode: Episode) -> tuple[Array, Array]:
        nonlocal memory
        mean, covariance, memory = reference.update(episode.measurement, episode.truth, memory)
        return mean, covariance

    _run_outside(task, start, update, seeds, record, tick)


def run_estimator(
    task: Task,
    estimator: Any,
    seeds: Sequence[int],
    record: Callable[[Any], None],
    tick: Progress,
    name: str = "estimator",
    first_episode: int = 0,
    strict: bool = False,
    lost: Callable[[Array], None] = lambda faults: None,
) -> None:
    """Run an estimator in place of actions, and check what it says.

    An episode in which an answer is not finite, or no covariance, is lost from that measurement on: the last valid
    answer, or else what was told of the start, is held to the end. Any estimator could give that answer itself, so that
    nobody gains by losing an episode.

    Args:
        task: the estimation problem.
        estimator: keeps the protocol :class:`~.competitors.Estimator`.
        seeds: as in :func:`run_policy`, likewise ``record`` and ``tick``.
        record: likewise.
        tick: likewise.
        name: of the estimator, in errors.
        first_episode: number of the first episode, in errors.
        strict: raise where an episode would be lost.
        lost: called before every ``record`` with the number of the reason why each episode is lost, ``(N,)``; see
            :data:`.dataset.FAULTS`.

    Raises:
        ValueError: if the estimator raises, or returns what is no mean and covariance in shape.
    """
    width = padded_width(len(seeds))
    filled = numpy.minimum(numpy.arange(width), len(seeds) - 1)  # the last episode is repeated
    memory: Any = None
    step = 0
    missed = numpy.zeros(width, dtype=bool)
    held: tuple[numpy.ndarray, ...] = ()
    faults = numpy.zeros(width)

    def start(episode: Episode) -> None:
        nonlocal memory, held
        initial = chosen_lanes(episode.measurement, filled)
        held = initial.mean.copy(), initial.covariance.copy()
        with told(f"estimator {name!r} failed at the start of the track"):
            memory = estimator.start(initial, width)

    def update(episode: Episode) -> tuple[Array, Array]:
        nonlocal memory, step, held
        step += 1
        measurement = chosen_lanes(task.world.received(episode.measurement), filled)
        missed[:] |= _lacking(measurement)
        with told(f"estimator {name!r} failed at measurement {step}"):
            answer = estimator.update(measurement, memory)
            try:
                mean, covariance, memory = answer
            except (TypeError, ValueError):
                raise TypeError(
                    "update must return mean, covariance and memory, not " + type(answer).__name__
                ) from None
        mean, covariance = _checked_estimate(task, name, step, mean, covariance, width)
        found = _faults(mean, covariance, faults > 0.0, missed)
        if strict and found[: len(seeds)].any():
            i = int(numpy.argmax(found > 0.0))
            raise ValueError(
                f"estimator {name!r}: {FAULTS[int(found[i]) - 1]} in episode {first_episode + i} at measurement {step}"
            )
        faults[:] += found
        lost(faults.copy())
        # Copies: the estimator may go on in its own arrays. In their layout, by which matrix products round.
        estimate = numpy.copy(mean, order="K"), numpy.copy(covariance, order="K")
        for array, last in zip(estimate, held, strict=True):
            array[..., faults > 0.0] = last[..., faults > 0.0]
        held = estimate
        return held[0], held[1]

    _run_outside(task, start, update, seeds, record, tick)


def chosen_lanes(part: Any, lanes: numpy.ndarray | int) -> Any:
    """Return nested tuples of arrays with some entries of their last axis, each an array of its own; or with one
    entry, without that axis.
    """
    return mapped(lambda values: values[..., lanes], part)


@contextmanager
def told(what: str) -> Iterator[None]:
    """Turn whatever somebody else's code raises into one sentence with the line that raised it."""
    try:
        yield
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        # The last line outside installed libraries: one of their own says less.
        own = [f for f in frames[1:] if "site-packages" not in f.filename] or frames
        line = f"{Path(own[-1].filename).name}, line {own[-1].lineno}"
        raise ValueError(f"{what}: {type(error).__name__}: {error} ({line})") from error


def _checked_estimate(
    task: Task, name: str, step: int, mean: Any, covariance: Any, width: int
) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return an estimate as float64, or raise ValueError if it has another shape."""
    count = len(task.components)
    found = []
    for word, values, shape in (
        ("mean", mean, (count, width)),
        ("covariance", covariance, (count, count, width)),
    ):
        try:
            given = numpy.asanyarray(values)
            # What float64 has no room for would vanish in it: masks, imaginary parts, words.
            if isinstance(given, numpy.ma.MaskedArray) or given.dtype.kind not in "fiub":
                masked = "a masked array of " * isinstance(given, numpy.ma.MaskedArray)
                raise TypeError(f"expected an array of real numbers, got {masked}{given.dtype}")
            array = numpy.asarray(given, dtype=numpy.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"estimator {name!r}: the {word} at measurement {step} is no array: {error}"
            ) from None
        if array.shape != shape:
            components = ", ".join(c.name for c in task.components)
            raise ValueError(
                f"estimator {name!r}: the {word} at measurement {step} must have shape {shape}, {count} components "
                f"({components}) of {width} episodes, got {array.shape}"
            )
        found.append(array)
    return found[0], found[1]


def _faults(
    mean: numpy.ndarray, covariance: numpy.ndarray, lost: numpy.ndarray, missed: numpy.ndarray
) -> numpy.ndarray:
    """Return what is wrong with an estimate, of the episodes that are not lost yet.

    Args:
        mean: ``(C, N)``.
        covariance: ``(C, C, N)``.
        lost: whether the episode was lost before, ``(N,)``.
        missed: whether not everything was received so far, ``(N,)``.

    Returns:
        Numbers of ``FAULTS`` from 1 on, zero where nothing is, ``(N,)``.
    """
    finite = numpy.isfinite(mean).all(axis=0), numpy.isfinite(covariance).all(axis=(0, 1))
    usable = finite[1] & ~lost
    P = numpy.where(usable[:, None, None], numpy.moveaxis(covariance, -1, 0), numpy.eye(len(mean)))
    definite = numpy.ones(len(P), dtype=bool)
    try:
        numpy.linalg.cholesky(P)
    except numpy.linalg.LinAlgError:
        definite = numpy.array([numpy.linalg.eigvalsh(p)[0] > 0.0 for p in P])
    asymmetry = numpy.abs(P - P.transpose(0, 2, 1)).max(axis=(1, 2))
    symmetric = asymmetry <= 1e-6 * numpy.abs(P).max(axis=(1, 2))
    wrong = [~(fine | lost) for fine in (*finite, definite, symmetric)]
    overlooked = missed & (wrong[0] | wrong[1])
    return numpy.select([overlooked, *wrong], [float(len(FAULTS)), *numpy.arange(1.0, len(FAULTS))], 0.0)


def _lacking(measurement: Any) -> numpy.ndarray:
    """Return which episodes have NaN in a measurement, ``(N,)``."""
    parts = [
        numpy.isnan(numpy.asarray(values)).reshape(-1, values.shape[-1]).any(axis=0)
        for _, values in named_arrays(measurement)
    ]
    return numpy.asarray(numpy.any(parts, axis=0))


def run_bound(
    task: Task, bound: Any, seeds: Sequence[int], record: Callable[[Array], None], tick: Progress
) -> None:
    """Compute a bound along the episodes; ``record`` gets its mean squares, ``(C, N)``."""
    memory: Any = None

    def begun(episode: Episode) -> None:
        nonlocal memory
        memory = bound.start(episode.measurement, episode.truth)

    lanes = started_lanes(task, seeds, begun)
    neutral = lanes.widened(numpy.zeros((lanes.count, *(task.action_space.shape or ()))))

    def update(episode: Episode) -> Episode:
        nonlocal memory
        mean_square, memory = bound.update(episode.measurement, episode.truth, memory)
        record(mean_square)
        return task.act(episode, neutral)

    for _ in range(lanes.decisions_per_episode):
        lanes.step(update)
        tick(lanes.count * task.decision_interval)


def run_competitor(
    task: Task,
    competitor: Any,
    kind: Kind,
    seeds: Sequence[int],
    report: Report,
    tick: Progress = lambda measurements: None,
    name: str = "competitor",
    first_episode: int = 0,
    actions: bool = False,
    only: Mapping[str, int] | None = None,
    strict: bool = False,
) -> dict[str, numpy.ndarray]:
    """Run whatever competes over one episode for each seed, and return what is reported of every measurement.

    Args:
        task: the estimation problem.
        competitor: made for the task.
        kind: what it is.
        seeds: as in :func:`run_policy`, likewise ``tick``.
        report: function of the task and the state after the action, which returns arrays ``(..., N)`` by name; not
            asked about bounds.
        tick: likewise.
        name: of the competitor, in errors.
        first_episode: number of the first episode, in errors.
        actions: of a policy whose action is a box, report too what was applied: ``action``, ``(episodes, time, A)``,
            within the limits of the box, as every bank takes it.
        only: beginning of names -> of how many of the first episodes these are kept.
        strict: raise where an estimator would lose an episode.

    Returns:
        Arrays ``(episodes, time, ...)`` by name; of a bound its ``mean_square``; of an estimator also ``lost``, see
        :func:`run_estimator`.
    """
    series: dict[str, list[numpy.ndarray]] = {}

    fewer = {} if only is None else only
    counts: dict[str, int] = {}

    def keep(name: str, values: numpy.ndarray) -> None:
        if name not in series:
            most = [count for beginning, count in fewer.items() if name.startswith(beginning)]
            counts[name], series[name] = min(len(seeds), *most) if most else len(seeds), []
        kept = values[..., : counts[name]]
        # A view of a few episodes would keep the numbers of all.
        series[name].append(numpy.moveaxis(kept.copy() if counts[name] < len(seeds) else kept, -1, 0))

    def keep_all(found: dict[str, numpy.ndarray]) -> None:
        for name in {"action", "lost"} & found.keys() if actions else ():
            raise ValueError(
                f"{task.id} records something under the name {name!r}, under which an evaluation keeps which actions "
                "were applied or episodes lost: call it something else"
            )
        for name, values in found.items():
            keep(name, values)

    def record(episode: Episode) -> None:
        keep_all(task.run(report, episode))

    space: Any = task.action_space

    def keep_action(action: Array) -> None:
        bounded = numpy.clip(numpy.asarray(action, dtype=numpy.float64), space.low, space.high)
        keep("action", bounded.reshape(len(seeds), -1).T)

    if kind == "policy":
        acted = keep_action if actions and isinstance(space, gymnasium.spaces.Box) else None
        run_policy(task, competitor, seeds, keep_all, tick, report, acted)
    elif kind == "estimator":
        run_estimator(
            task,
            competitor,
            seeds,
            record,
            tick,
            name,
            first_episode,
            strict,
            lambda faults: keep("lost", faults),
        )
    elif kind == "reference":
        run_reference(task, competitor, seeds, record, tick)
    else:
        run_bound(task, competitor, seeds, lambda mean_square: keep("mean_square", mean_square), tick)
    return {name: numpy.stack(values, axis=1) for name, values in series.items()}
