"""What records, curves and a track need of an evaluation: little enough to send, to keep in a file, and to hold.

A summary is of one competitor. Its episodes are run where it is made, in chunks each of which is reduced before the
next begins, and what they come to is added in their order; so its bits depend on nothing but what was asked for.
"""

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy
import xarray

from ...envs.engine.catalogue import short_name
from ..statistics.bootstrap import BLOCK, RESAMPLES, Bootstrap, block_of
from ..statistics.statistic import Reduction, Statistic, reduce_run
from ..storage.store import Store, Work
from .curves import CompetitorCurves, competitor_curves, curve_statistics, curves_of, stack_curves
from .evaluate import Experiment, check_sendable, plan_of, run_experiment, run_piece
from .kept import DRAWN_PREFIX
from .metrics import Contender, Record, contender_of, mean_cost, record_statistics, records_of, tidy_records
from .own_metrics import OwnMetrics
from .parallel import Workers
from .rollout import Progress
from .threads import one_thread
from .times import COORDINATES, with_times

TOGETHER = 4 * BLOCK
"""Episodes of a piece of work: enough that what comes back is little beside what was done for it."""
BATCH = 600_000
"""Measurements that another process is given at once, where several pieces of work share a model: about a second. A
longer batch would leave the others idle at the end, and lose more where the work is interrupted."""


class EvaluationRequest(NamedTuple):
    """One competitor of an experiment."""

    experiment: Experiment
    name: str
    maker: Any
    metrics: OwnMetrics | None = None
    """The environment's own."""
    horizon: int = 1
    """Measurements of an episode, for the progress."""
    first: int = 0
    """Episode with which a piece of the work begins."""
    last: int | None = None
    """Episode before which it ends; None: the end."""
    curves: bool = True
    """Whether it is reduced to curves, too: who draws no figure needs none, and they take as long as the records."""
    identity: str | None = None
    """Of the competitor, see :class:`..competitors.kinds.Competitor`; with None its summary is not kept in a store."""

    @property
    def episodes(self) -> int:
        """How many the experiment has."""
        return self.experiment.episodes

    @property
    def end(self) -> int:
        """Episode before which it ends."""
        return self.episodes if self.last is None else self.last

    @property
    def measurements(self) -> int:
        """How many there are."""
        return (self.end - self.first) * self.horizon

    def work(self) -> Work | None:
        """Return the piece of work that the summary is, for a store; None where nothing is kept of it."""
        if self.identity is None:
            return None
        return Work(f"{stem_of(self.experiment)}.{self.name}", f"{self._replace(maker=None, metrics=None)}")

    def pieces(self) -> list["EvaluationRequest"]:
        """Return the pieces of work that this is: one, unless there are many episodes."""
        if self.episodes <= TOGETHER:
            return [self]
        begins = range(0, self.episodes, TOGETHER)
        return [self._replace(first=i, last=min(i + TOGETHER, self.episodes)) for i in begins]


def stem_of(experiment: Experiment) -> str:
    """Begin the name of a file about an experiment."""
    environment, scenario = short_name(experiment.task.id), experiment.scenario or "default"
    return f"{environment}.{scenario}.{experiment.episodes}.{experiment.split}{experiment.seed}"


class Evaluation(NamedTuple):
    """What an evaluation has found."""

    dataset: xarray.Dataset
    """All that was kept of every episode (:func:`.evaluate.run_experiment`); or, of summaries, its coordinates and
    attributes with what was kept of the first episodes, over policy, drawn_episode and time."""
    records: list[Record]
    curves: xarray.Dataset | None
    """See :func:`.curves.curves_of`; None where they were not requested of every competitor."""
    costs: Mapping[str, numpy.ndarray]
    """Mean cost of every episode by name, ``(episodes,)``, of all whose cost is known."""

    @property
    def has_truth(self) -> bool:
        """Whether errors and costs are known."""
        return bool(self.dataset.attrs["truth"])

    @property
    def recorded(self) -> bool:
        """Whether the measurements are those of a recording."""
        return bool(self.dataset.attrs["recorded"])


class Summary(NamedTuple):
    """One competitor of an evaluation."""

    contender: Contender
    curves: CompetitorCurves | None
    """None where none were asked for."""
    head: xarray.Dataset
    """Its part of the evaluation, without what was kept of every episode."""
    episodes: int


class Part(NamedTuple):
    """Some episodes of one competitor."""

    reduction: Reduction
    head: xarray.Dataset

    def merge(self, later: "Part") -> "Part":
        """Add the episodes that come next."""
        return self._replace(reduction=self.reduction.merge(later.reduction))

    def summary(self, asked: EvaluationRequest) -> Summary:
        """Return the summary of all episodes of what was asked for."""
        results, bootstrap = self.reduction.results(), _resampling(asked.episodes)
        contender = contender_of(results, self.head, bootstrap, asked.metrics)
        curves = competitor_curves(results) if asked.curves else None
        return Summary(contender, curves, self.head, asked.episodes)


@functools.lru_cache(maxsize=1)
def _resampling(episodes: int) -> Bootstrap:
    """Return the resampling of so many episodes, which takes a while where they are many."""
    return Bootstrap(episodes, RESAMPLES)


def summarise(asked: EvaluationRequest, tick: Progress) -> Summary | Part:
    """Run what is asked for and reduce it; of a piece of the episodes only, return what they contribute.

    Raises:
        ValueError: as :func:`reduce_episodes`.
    """

    def declare(run: xarray.Dataset) -> Iterator[Statistic]:
        yield from record_statistics(run, asked.episodes, asked.metrics)
        if asked.curves:
            yield from curve_statistics(run, asked.episodes)

    part = reduce_episodes(asked, declare, tick)
    if asked.end - asked.first < asked.episodes:
        return part
    return part.summary(asked)


def reduce_episodes(
    asked: EvaluationRequest, declare: Callable[[xarray.Dataset], Iterable[Statistic]], tick: Progress
) -> Part:
    """Run what is asked for and reduce it to statistics, a block of episodes at a time.

    Args:
        asked: one competitor over episodes.
        declare: from some of its episodes to their statistics.
        tick: told of measurements done.

    Raises:
        ValueError: for flights and recordings, whose episodes belong together; and as :func:`.evaluate.run_experiment`.
    """
    plan = plan_of(asked.experiment, {asked.name: asked.maker}, asked.first, asked.end)
    if plan.flown is not None:
        raise ValueError("flights and recordings have no summary: evaluate them")
    bootstrap = _resampling(asked.episodes)
    block = block_of(plan.models[asked.name].task.horizon)

    def part(first: int) -> Part:
        """Run a block of episodes and reduce it; nothing of what was measured in it outlives the call."""
        piece = plan.piece(asked.name, first, min(block, asked.end - first), True)
        count = len(piece.seeds)
        kept = plan.arrays(count, asked.experiment.drawn_episodes - first)
        kept.write(asked.name, slice(count), run_piece(piece, tick))
        run = plan.dataset(kept, piece.seeds).isel(policy=0)
        reduction = reduce_run(run, declare, bootstrap, first)
        others = [str(name) for name in run.data_vars if not str(name).startswith(DRAWN_PREFIX)]
        head = run.drop_vars(others).isel(episode=0).drop_vars(["episode", "action_name"], errors="ignore")
        return Part(reduction, head)

    parts = (part(first) for first in range(asked.first, asked.end, block))
    found = functools.reduce(Part.merge, parts)
    if asked.experiment.timed and asked.first == 0:
        return found._replace(head=with_times(found.head, [plan.time(asked.name)]))
    return found


def summaries(
    asked: Sequence[EvaluationRequest],
    workers: Workers,
    progress: Progress | None = None,
    store: Store | None = None,
) -> Iterator[tuple[int, Summary]]:
    """Summarise competitors, of any environments.

    Args:
        asked: whom, over what; they are begun in this order.
        workers: who does it.
        progress: told of measurements done.
        store: keeps the summary of each, from which a second call takes it. Default: nothing is kept.

    Yields:
        Number of a competitor among them and its summary, as they are finished.

    Raises:
        ValueError: if a competitor cannot be sent to another process, or a file not be written; and as
            :func:`.evaluate.run_experiment`.
    """
    store = store or Store()
    work = [one.work() for one in asked]
    missing = []
    for i, one in enumerate(asked):
        found = store.read(work[i], Summary)
        if found is None:
            missing.append(i)
            continue
        if progress is not None:
            progress(one.measurements)
        yield i, found
    if not workers.alone:
        for i in missing:
            check_sendable(asked[i].experiment.task, {asked[i].name: asked[i].maker})
    pieces = [(i, piece) for i in missing for piece in asked[i].pieces()]
    batches = [[piece] for piece in pieces] if workers.alone else _batches(pieces)
    items = [[piece for _, piece in batch] for batch in batches]
    waiting: dict[int, dict[int, tuple[Part, int]]] = {}
    added: dict[int, Part] = {}
    done = [0] * len(asked)
    sizes = [sum(piece.measurements for piece in batch) for batch in items]
    run = workers.run(lambda batch, tick: [summarise(one, tick) for one in batch], items, sizes, progress)
    for (i, piece), found in (
        (which, one) for k, ones in run for which, one in zip(batches[k], ones, strict=True)
    ):
        if isinstance(found, Summary):
            store.write(work[i], found)
            yield i, found
            continue
        # In the order of the episodes, whichever come first: sums of the same numbers in another order differ.
        waiting.setdefault(i, {})[piece.first] = found, piece.last or 0
        while done[i] in waiting[i]:
            later, done[i] = waiting[i].pop(done[i])
            added[i] = added[i].merge(later) if i in added else later
        if done[i] == asked[i].episodes:
            with one_thread():
                whole = added.pop(i).summary(asked[i])
            store.write(work[i], whole)
            yield i, whole


def _batches(pieces: Sequence[tuple[int, EvaluationRequest]]) -> list[list[tuple[int, EvaluationRequest]]]:
    """Group pieces of work that share a model, which every process that runs one of them would trace for itself.

    A batch stands where its first piece stood, and holds at most ``BATCH`` measurements, or one piece.
    """
    batches: list[list[tuple[int, EvaluationRequest]]] = []
    last: dict[Any, tuple[list[tuple[int, EvaluationRequest]], int]] = {}
    for i, piece in pieces:
        shared = id(piece.experiment), getattr(piece.maker, "control", None)
        batch, size = last.get(shared, ([], 0))
        if not batch or size + piece.measurements > BATCH:
            batch, size = [], 0
            batches.append(batch)
        batch.append((i, piece))
        last[shared] = batch, size + piece.measurements
    return batches


@one_thread()
def combine_summaries(found: Sequence[Summary]) -> Evaluation:
    """Return the evaluation of which these are the summaries of all competitors."""
    evaluation = _heads_together(found)
    costs = {one.contender.name: one.contender.costs for one in found if one.contender.costs is not None}
    records = records_of([one.contender for one in found], evaluation, _resampling(found[0].episodes))
    each = [one.curves for one in found if one.curves is not None]
    if len(each) < len(found):
        return Evaluation(evaluation, records, None, costs)
    controls = [one.contender.control for one in found]
    if len({control for control, own in zip(controls, each, strict=True) if own.actions}) > 1:
        each = [
            own._replace(actions=[f"{control}: {part}" for part in own.actions])
            for control, own in zip(controls, each, strict=True)
        ]
    curves = stack_curves(each, evaluation, found[0].episodes)
    return Evaluation(evaluation, records, curves, costs)


def run_requests(
    asked: Sequence[EvaluationRequest],
    workers: Workers,
    progress: Progress | None = None,
    store: Store | None = None,
    whole: bool = False,
) -> Evaluation:
    """Evaluate the competitors of one experiment.

    Args:
        asked: one request for each.
        workers: share the work.
        progress: called with the number of measurements done.
        store: as of :func:`summaries`.
        whole: keep every number of every episode; flights and recordings have no summary.

    Raises:
        ValueError: as :func:`summaries` and :func:`.evaluate.run_experiment`.
    """
    first = asked[0]
    if not whole and first.episodes > 1:
        found = dict(summaries(asked, workers, progress, store))
        return combine_summaries([found[i] for i in range(len(found))])
    dataset = run_experiment(first.experiment, {one.name: one.maker for one in asked}, progress, workers)
    costs = {}
    for name in dataset["policy"].values.tolist() if "cost" in dataset else ():
        own = mean_cost(dataset, name)
        if not numpy.isnan(own).all():  # of bounds there is none
            costs[name] = own
    curves = curves_of(dataset) if first.curves else None
    return Evaluation(dataset, tidy_records(dataset, first.metrics), curves, costs)


def _heads_together(found: Sequence[Summary]) -> xarray.Dataset:
    heads = [one.head for one in found]
    notes = [heads[0].attrs["notes"]] if heads[0].attrs["notes"] else []
    for one in found:
        if (losses := one.contender.losses) is not None:
            notes.append(losses.sentence(one.contender.name, one.episodes))
    coords: dict[str, Any] = {}
    for head in heads:
        coords |= {str(n): c.variable for n, c in head.coords.items() if n not in coords}
    for name in ("policy", "kind", "control"):
        coords[name] = ("policy", [str(head[name].values) for head in heads])
    for name in COORDINATES:
        if name in coords:
            coords[name] = ("policy", [head[name].values.item() for head in heads], heads[0][name].attrs)
    variables: dict[str, Any] = {}
    for name in sorted({str(name) for head in heads for name in head.data_vars}):
        example = next(head[name] for head in heads if name in head)
        stacked = numpy.full((len(heads), *example.shape), numpy.nan)
        for i, head in enumerate(heads):
            if name in head:
                stacked[i] = head[name].values
        variables[name] = (("policy", *example.dims), stacked)
    # A file has an order of its own.
    return xarray.Dataset(
        variables, dict(sorted(coords.items())), {**heads[0].attrs, "notes": "\n".join(notes)}
    )
