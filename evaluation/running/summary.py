"""Summaries of evaluations: the statistics of records and curves, small enough to send and to store.

A summary contains one competitor, whose episodes are run and reduced in chunks.
"""

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy
import xarray

from ...envs.engine.catalogue import short_name
from ..statistics.bootstrap import BLOCK, IntervalEstimate, block_of
from ..statistics.predictions import LikelihoodSums, likelihood_differences, likelihood_sums
from ..statistics.statistic import Reduction, Statistic, reduce_run
from ..statistics.time_blocks import BlockBootstrap
from ..storage.dataset import Losses, count_losses, losses_in
from ..storage.store import Store, Work
from .curves import CompetitorCurves, competitor_curves, curve_statistics, evenly_spaced, stack_curves
from .evaluate import Experiment, check_sendable, plan_of, run_competitors, run_piece
from .metrics import (
    PER_FLIGHT,
    Contender,
    Record,
    Reduced,
    bootstrap_of_episodes,
    bootstrap_of_reduced,
    cached_bootstrap,
    contender_of,
    mean_over_time,
    parts_by_flight,
    record_statistics,
    records_of,
    records_of_reduced,
    reduce_competitor,
)
from .own_metrics import OwnMetrics
from .parallel import Workers
from .rollout import Progress
from .stored_values import DRAWN_PREFIX
from .threads import one_thread
from .times import COORDINATES, with_times

TOGETHER = 4 * BLOCK
"""Number of episodes in a piece of work: its result is small compared with its computation."""
DRAWN_TIMES = 20_000
"""Maximal number of measurements of an episode in a picture."""
MOST_RECORDINGS = 40
"""Maximal number of episodes of a recording that are reported separately."""
BATCH = 600_000
"""Number of measurements in a batch of pieces of work with a common model: about a second. A longer batch would leave
processes idle at the end, and lose more in an interruption.
"""


class EvaluationRequest(NamedTuple):
    """Request to evaluate one competitor in an experiment, or in some of its episodes."""

    experiment: Experiment
    name: str
    maker: Any
    metrics: OwnMetrics | None = None
    """Metrics of the environment."""
    horizon: int = 1
    """Number of measurements of an episode, for the progress."""
    first: int = 0
    """Number of the first episode."""
    last: int | None = None
    """Number after the last episode; None: the end of the experiment."""
    curves: bool = True
    """Whether to compute curves for figures, too; they take as long as the records."""
    identity: str | None = None
    """Identity of the competitor, see :class:`..competitors.kinds.Competitor`; with None its summary is not stored."""

    @property
    def episodes(self) -> int:
        """Number of episodes of the whole experiment."""
        return self.experiment.episodes

    @property
    def end(self) -> int:
        """Number after the last requested episode."""
        return self.episodes if self.last is None else self.last

    @property
    def measurements(self) -> int:
        """Number of measurements in the requested episodes."""
        return (self.end - self.first) * self.horizon

    def work(self) -> Work | None:
        """Return name and identity of the request's summary in a store; None if it is not stored."""
        if self.identity is None:
            return None
        return Work(f"{file_stem(self.experiment)}.{self.name}", f"{self._replace(maker=None, metrics=None)}")

    def pieces(self) -> list["EvaluationRequest"]:
        """Divide a request into requests for fewer episodes each."""
        if self.episodes <= TOGETHER:
            return [self]
        begins = range(0, self.episodes, TOGETHER)
        return [self._replace(first=i, last=min(i + TOGETHER, self.episodes)) for i in begins]


def file_stem(experiment: Experiment) -> str:
    """Return the beginning of file names for an experiment: environment, scenario, episodes, split and seed."""
    environment, scenario = short_name(experiment.task.id), experiment.scenario or "default"
    return f"{environment}.{scenario}.{experiment.episodes}.{experiment.split}{experiment.seed}"


class Evaluation(NamedTuple):
    """Results of an evaluation: dataset, records, curves and costs."""

    dataset: xarray.Dataset
    """Values of every episode (:func:`.evaluate.run_experiment`); for summaries only coordinates, attributes and
    values of the first episodes, over policy, drawn_episode and time.
    """
    records: list[Record]
    curves: xarray.Dataset | None
    """Curves (:func:`.curves.curves_of`); None unless they were requested of every competitor."""
    costs: Mapping[str, numpy.ndarray]
    """Mean cost of every episode by name, ``(episodes,)``, of all competitors with a known cost."""
    flights: Sequence[Record] = ()
    """Records of every flight, where they are reported separately."""
    differences: Mapping[str, IntervalEstimate] = {}
    """For a recording, each competitor's mean log-likelihood of a measurement minus that of the best, by name."""

    @property
    def has_truth(self) -> bool:
        """Whether errors and costs are known."""
        return bool(self.dataset.attrs["truth"])

    @property
    def recorded(self) -> bool:
        """Whether the measurements are those of a recording."""
        return bool(self.dataset.attrs["recorded"])


class Summary(NamedTuple):
    """Statistics and curves of one competitor of an evaluation."""

    contender: Contender
    curves: CompetitorCurves | None
    """Curves; None where they were not requested."""
    head: xarray.Dataset
    """The competitor's part of the evaluation, without the values of every episode."""
    episodes: int


class Part(NamedTuple):
    """Sums and samples over some episodes of one competitor, from which its summary follows."""

    reduction: Reduction
    head: xarray.Dataset

    def merge(self, later: "Part") -> "Part":
        """Return these sums and samples with those of the next episodes added."""
        return self._replace(reduction=self.reduction.merge(later.reduction))

    def summary(self, request: EvaluationRequest) -> Summary:
        """Compute the competitor's summary from the sums and samples of all its episodes."""
        results, bootstrap = self.reduction.results(), cached_bootstrap(request.episodes)
        contender = contender_of(results, self.head, bootstrap, request.metrics)
        curves = competitor_curves(results) if request.curves else None
        return Summary(contender, curves, self.head, request.episodes)


def summarise(request: EvaluationRequest, tick: Progress) -> Summary | Part:
    """Run a request; return its summary, or sums and samples if it contains only some of the episodes."""

    def declare(run: xarray.Dataset) -> Iterator[Statistic]:
        yield from record_statistics(run, request.episodes, request.metrics)
        if request.curves:
            yield from curve_statistics(run, request.episodes)

    part = reduce_episodes(request, declare, tick)
    if request.end - request.first < request.episodes:
        return part
    return part.summary(request)


def reduce_episodes(
    request: EvaluationRequest, declare: Callable[[xarray.Dataset], Iterable[Statistic]], tick: Progress
) -> Part:
    """Run a request block by block of episodes; return the sums and samples of declared statistics.

    Raises:
        ValueError: for flights and recordings, whose episodes belong together; and as :func:`.evaluate.run_experiment`.
    """
    plan = plan_of(request.experiment, {request.name: request.maker}, request.first, request.end)
    if plan.flight_numbers is not None:
        raise ValueError("flights and recordings have no summary: evaluate them")
    bootstrap = cached_bootstrap(request.episodes)
    block = block_of(plan.models[request.name].task.horizon)

    def part(first: int) -> Part:
        piece = plan.piece(request.name, first, min(block, request.end - first), True)
        count = len(piece.seeds)
        kept = plan.arrays(count, request.experiment.drawn_episodes - first)
        kept.write(request.name, slice(count), run_piece(piece, tick))
        run = plan.dataset(kept, piece.seeds).isel(policy=0)
        reduction = reduce_run(run, declare, bootstrap, first)
        others = [str(name) for name in run.data_vars if not str(name).startswith(DRAWN_PREFIX)]
        head = run.drop_vars(others).isel(episode=0).drop_vars(["episode", "action_name"], errors="ignore")
        return Part(reduction, head)

    parts = (part(first) for first in range(request.first, request.end, block))
    found = functools.reduce(Part.merge, parts)
    if request.experiment.timed and request.first == 0:
        return found._replace(head=with_times(found.head, [plan.time(request.name)]))
    return found


def summaries(
    requests: Sequence[EvaluationRequest],
    workers: Workers,
    progress: Progress | None = None,
    store: Store | None = None,
) -> Iterator[tuple[int, Summary]]:
    """Evaluate requests for competitors, or read stored summaries; yield number and summary of each when
    available.

    Args:
        requests: the requests, started in this order.
        workers: processes that do the work.
        progress: called with the number of measurements done.
        store: stores each summary, so that a second call reads it.

    Raises:
        ValueError: if a competitor cannot be sent to another process, or a file not be written; and as
            :func:`.evaluate.run_experiment`.
    """
    store = store or Store()
    work = [one.work() for one in requests]
    missing = []
    for i, one in enumerate(requests):
        found = store.read(work[i], Summary)
        if found is None:
            missing.append(i)
            continue
        if progress is not None:
            progress(one.measurements)
        yield i, found
    if not workers.alone:
        for i in missing:
            check_sendable(requests[i].experiment.task, {requests[i].name: requests[i].maker})
    pieces = [(i, piece) for i in missing for piece in requests[i].pieces()]
    batches = [[piece] for piece in pieces] if workers.alone else _batches(pieces)
    items = [[piece for _, piece in batch] for batch in batches]
    waiting: dict[int, dict[int, tuple[Part, int]]] = {}
    added: dict[int, Part] = {}
    done = [0] * len(requests)
    sizes = [sum(piece.measurements for piece in batch) for batch in items]
    run = workers.run(lambda batch, tick: [summarise(one, tick) for one in batch], items, sizes, progress)
    for (i, piece), found in (
        (which, one) for k, ones in run for which, one in zip(batches[k], ones, strict=True)
    ):
        if isinstance(found, Summary):
            store.write(work[i], found)
            yield i, found
            continue
        # In the order of the episodes, not of arrival: sums in another order round differently.
        waiting.setdefault(i, {})[piece.first] = found, piece.last or 0
        while done[i] in waiting[i]:
            later, done[i] = waiting[i].pop(done[i])
            added[i] = added[i].merge(later) if i in added else later
        if done[i] == requests[i].episodes:
            with one_thread():
                whole = added.pop(i).summary(requests[i])
            store.write(work[i], whole)
            yield i, whole


def _batches(pieces: Sequence[tuple[int, EvaluationRequest]]) -> list[list[tuple[int, EvaluationRequest]]]:
    """Group requests that share a model into batches of at most ``BATCH`` measurements; a process traces it
    once.
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
def combine_summaries(parts: Sequence[Summary]) -> Evaluation:
    """Combine the summaries of all competitors into one evaluation."""
    evaluation = _heads_together(
        [one.head for one in parts], [one.contender.losses for one in parts], parts[0].episodes
    )
    costs = {one.contender.name: one.contender.costs for one in parts if one.contender.costs is not None}
    records = records_of([one.contender for one in parts], evaluation, cached_bootstrap(parts[0].episodes))
    each = [one.curves for one in parts if one.curves is not None]
    if len(each) < len(parts):
        return Evaluation(evaluation, records, None, costs)
    each = _actions_by_control(each, [one.contender.control for one in parts])
    curves = stack_curves(each, evaluation, parts[0].episodes)
    return Evaluation(evaluation, records, curves, costs)


def _actions_by_control(
    curves: Sequence[CompetitorCurves], controls: Sequence[str]
) -> list[CompetitorCurves]:
    """Add the control to the names of actions, if competitors use several controls."""
    if len({control for control, own in zip(controls, curves, strict=True) if own.actions}) < 2:
        return list(curves)
    return [
        own._replace(actions=[f"{control}: {part}" for part in own.actions])
        for control, own in zip(controls, curves, strict=True)
    ]


class SeparateResults(NamedTuple):
    """Reduced results of one competitor over flights, a recording or one episode, which are resampled
    together.
    """

    reduced: Reduced
    flights: list[Reduced]
    likelihood: LikelihoodSums | None
    costs: numpy.ndarray | None
    """Mean cost of every episode; None where none is known."""
    losses: Losses | None
    curves: CompetitorCurves | None
    head: xarray.Dataset
    """The competitor's part of the evaluation at no more than ``DRAWN_TIMES`` measurements, without the values of
    every episode.
    """


def reduce_alone(run: xarray.Dataset, request: EvaluationRequest) -> SeparateResults:
    """Reduce one competitor's evaluation over flights, a recording or one episode to sums, costs and curves."""
    episodes, times = run.sizes["episode"], run.sizes["time"]
    flights, recorded = parts_by_flight(run) if "flight" in run.coords else iter(()), run.attrs["recorded"]
    if not run.attrs["truth"] or (recorded and episodes > MOST_RECORDINGS):
        flights = iter(())
    costs = mean_over_time(run, run["cost"].values) if "cost" in run else None
    if costs is not None and numpy.isnan(costs).all():  # bounds have no cost
        costs = None
    chosen, curves = evenly_spaced(times, DRAWN_TIMES), None
    if request.curves:
        declare = functools.partial(curve_statistics, episodes=episodes)
        results = reduce_run(run, declare, bootstrap_of_episodes(run)).results()
        curves = competitor_curves(results).at_measurements(chosen, times)
    others = [name for name in run.data_vars if not str(name).startswith(DRAWN_PREFIX)]
    return SeparateResults(
        reduce_competitor(run, request.metrics).without_variables(),
        [reduce_competitor(part, request.metrics).without_variables() for part in flights],
        likelihood_sums(run) if recorded else None,
        costs,
        count_losses(losses_in(run)),
        curves,
        run.drop_vars(others).isel(time=chosen),
    )


def _run_alone(request: EvaluationRequest, tick: Progress) -> SeparateResults:
    found = run_competitors(request.experiment, {request.name: request.maker}, tick)
    return reduce_alone(found.isel(policy=0), request)


@one_thread()
def _combine_alone(
    found: Mapping[str, SeparateResults],
    curves: Sequence[CompetitorCurves],
    evaluation: xarray.Dataset,
    metrics: OwnMetrics | None,
) -> Evaluation:
    """Combine the reduced results of all competitors over flights, a recording or one episode into one
    evaluation.
    """
    reduced = [one.reduced for one in found.values()]
    bootstrap = bootstrap_of_reduced(reduced, evaluation)
    if isinstance(bootstrap, BlockBootstrap):
        notes = filter(None, [evaluation.attrs["notes"], bootstrap.sentence])
        evaluation = evaluation.assign_attrs(notes="\n".join(notes))
    flights = [
        record
        for own in zip(*(one.flights for one in found.values()), strict=True)
        for record in records_of_reduced(own, own[0].run, metrics)
        if record.metric in PER_FLIGHT
    ]
    shown = evaluation.drop_vars(list(evaluation.data_vars))
    shown = shown.isel(time=evenly_spaced(shown.sizes["time"], DRAWN_TIMES))
    return Evaluation(
        evaluation,
        records_of_reduced(reduced, evaluation, metrics),
        stack_curves(curves, shown, evaluation.sizes["episode"]) if curves else None,
        {name: one.costs for name, one in found.items() if one.costs is not None},
        flights,
        likelihood_differences({n: one.likelihood for n, one in found.items() if one.likelihood is not None}),
    )


def run_requests(
    requests: Sequence[EvaluationRequest],
    workers: Workers,
    progress: Progress | None = None,
    store: Store | None = None,
    whole: bool = False,
) -> Evaluation:
    """Evaluate the competitors of one experiment; return records, curves and costs.

    Args:
        requests: one request for each competitor.
        workers: processes for the work.
        progress: called with the number of measurements done.
        store: stores each summary, so that a second call reads it.
        whole: whether to store every number of every episode.
    """
    first, names = requests[0], [one.name for one in requests]
    if whole:
        makers = {one.name: one.maker for one in requests}
        evaluation = run_competitors(first.experiment, makers, progress, workers)
        remains = [reduce_alone(evaluation.sel(policy=one.name), one) for one in requests]
        curves = [one.curves for one in remains if one.curves is not None]
    elif first.episodes > 1 and not first.experiment.make_task().flights:
        found = dict(summaries(requests, workers, progress, store))
        return combine_summaries([found[i] for i in range(len(found))])
    else:  # one competitor after the other, without storing arrays as long as the episodes
        if not workers.alone:
            check_sendable(first.experiment.task, {one.name: one.maker for one in requests})
        done = dict(workers.run(_run_alone, requests, [one.measurements for one in requests], progress))
        remains = [done[i] for i in range(len(requests))]
        curves = [one.curves for one in remains if one.curves is not None]
        if curves:
            curves = _actions_by_control(curves, [str(one.head["control"].values) for one in remains])
        evaluation = _heads_together(
            [one.head for one in remains], [one.losses for one in remains], remains[0].head.sizes["episode"]
        )
    return _combine_alone(dict(zip(names, remains, strict=True)), curves, evaluation, first.metrics)


def _heads_together(
    heads: Sequence[xarray.Dataset], losses: Sequence[Losses | None], episodes: int
) -> xarray.Dataset:
    notes = [heads[0].attrs["notes"]] if heads[0].attrs["notes"] else []
    for head, lost in zip(heads, losses, strict=True):
        if lost is not None:
            notes.append(lost.sentence(str(head["policy"].values), episodes))
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
    # A file may have another order.
    return xarray.Dataset(
        variables, dict(sorted(coords.items())), {**heads[0].attrs, "notes": "\n".join(notes)}
    )
