"""What records, curves and a track need of an evaluation: little enough to send, to keep in a file, and to hold.

A summary is of one competitor. Its episodes are run where it is made, in chunks each of which is reduced before the
next begins, and what they come to is added in their order; so its bits depend on nothing but what was asked for.
"""

import functools
import io
import json
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy
import xarray

from .bootstrap import BLOCK, RESAMPLES, Bootstrap, Estimate, block_of
from .curves import CompetitorCurves, competitor_curves, curve_statistics, stack_curves
from .dataset import Losses
from .evaluate import DRAWN, Experiment, check_sendable, plan_of, run_piece
from .files import whole_file
from .metrics import Contender, Measure, Record, contender_of, record_statistics, records_of
from .own_metrics import OwnMetrics
from .parallel import Workers
from .rollout import Progress
from .statistics import Reduction, Statistic, reduce_run
from .threads import one_thread

TOGETHER = 4 * BLOCK
"""Episodes of a piece of work: enough that what comes back is little beside what was done for it."""


class Asked(NamedTuple):
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

    def pieces(self) -> list["Asked"]:
        """Return the pieces of work that this is: one, unless there are many episodes."""
        if self.episodes <= TOGETHER:
            return [self]
        begins = range(0, self.episodes, TOGETHER)
        return [self._replace(first=i, last=min(i + TOGETHER, self.episodes)) for i in begins]


class Summary(NamedTuple):
    """One competitor of an evaluation."""

    contender: Contender
    curves: CompetitorCurves
    head: xarray.Dataset
    """Its part of the evaluation, without what was kept of every episode."""
    episodes: int


class Kept(NamedTuple):
    """Where a summary waits for the rest."""

    path: Path
    made_by: str
    """What it depends on, in words; one that depends on something else is made again."""


class Part(NamedTuple):
    """Some episodes of one competitor."""

    reduction: Reduction
    head: xarray.Dataset

    def merge(self, later: "Part") -> "Part":
        """Add the episodes that come next."""
        return self._replace(reduction=self.reduction.merge(later.reduction))

    def summary(self, bootstrap: Bootstrap, metrics: OwnMetrics | None) -> Summary:
        """Return the summary of all episodes."""
        results = self.reduction.results()
        contender = contender_of(results, self.head, bootstrap, metrics)
        return Summary(contender, competitor_curves(results), self.head, bootstrap.episodes)


@functools.lru_cache(maxsize=1)
def _resampling(episodes: int) -> Bootstrap:
    """Return the resampling of so many episodes, which takes a while where they are many."""
    return Bootstrap(episodes, RESAMPLES)


def summarise(asked: Asked, tick: Progress) -> Summary | Part:
    """Run what is asked for and reduce it; of a piece of the episodes only, return what they contribute.

    Raises:
        ValueError: as :func:`reduce_episodes`.
    """

    def declare(run: xarray.Dataset) -> Iterator[Statistic]:
        yield from record_statistics(run, asked.episodes, asked.metrics)
        yield from curve_statistics(run, asked.episodes)

    part = reduce_episodes(asked, declare, tick)
    if asked.end - asked.first < asked.episodes:
        return part
    return part.summary(_resampling(asked.episodes), asked.metrics)


def reduce_episodes(
    asked: Asked, declare: Callable[[xarray.Dataset], Iterable[Statistic]], tick: Progress
) -> Part:
    """Run what is asked for and reduce it to statistics, a block of episodes at a time.

    Args:
        asked: one competitor over episodes.
        declare: from some of its episodes to their statistics.
        tick: told of measurements done.

    Raises:
        ValueError: for flights and recordings, whose episodes belong together; and as :func:`.evaluate.evaluate`.
    """
    plan = plan_of(asked.experiment, {asked.name: asked.maker})
    if plan.flown is not None:
        raise ValueError("flights and recordings have no summary: evaluate them")
    bootstrap = _resampling(asked.episodes)
    block = block_of(plan.tasks[asked.name].horizon)

    def parts() -> Iterator[Part]:
        for i in range(asked.first, asked.end, block):
            piece = plan.piece(asked.name, i, min(block, asked.end - i), True)
            run = plan.dataset({asked.name: run_piece(piece, tick)}, piece.seeds)
            run = run.isel(policy=0)
            yield Part(reduce_run(run, declare, bootstrap, i), _head(run))

    return functools.reduce(Part.merge, parts())


def _head(run: xarray.Dataset) -> xarray.Dataset:
    """Return an evaluation without what was kept of every episode; of the first, its seed."""
    others = [str(name) for name in run.data_vars if not str(name).startswith(DRAWN)]
    return run.drop_vars(others).isel(episode=0).drop_vars(["episode", "action_name"], errors="ignore")


def summaries(
    asked: Sequence[Asked],
    workers: Workers,
    progress: Progress | None = None,
    kept: Sequence[Kept | None] = (),
) -> Iterator[tuple[int, Summary]]:
    """Summarise competitors, of any environments.

    Args:
        asked: whom, over what; they are begun in this order.
        workers: who does it.
        progress: told of measurements done.
        kept: where the summary of each waits, from which a second call takes it; None: it is not kept.

    Yields:
        Number of a competitor among them and its summary, as they are finished.

    Raises:
        ValueError: if a competitor cannot be sent to another process, or a file not be written; and as
            :func:`.evaluate.evaluate`.
    """
    places = list(kept) or [None] * len(asked)
    missing = []
    for i, (one, place) in enumerate(zip(asked, places, strict=True)):
        found = None if place is None else read_summary(*place)
        if found is None:
            missing.append(i)
            continue
        if progress is not None:
            progress(one.measurements)
        yield i, found
    for i, found in _summarised(asked, missing, workers, progress):
        if (place := places[i]) is not None:
            write_summary(place.path, found, place.made_by)
        yield i, found


def _summarised(
    asked: Sequence[Asked], missing: Sequence[int], workers: Workers, progress: Progress | None
) -> Iterator[tuple[int, Summary]]:
    if not workers.alone:
        for i in missing:
            check_sendable(asked[i].experiment.environment, {asked[i].name: asked[i].maker})
    pieces = [(i, piece) for i in missing for piece in asked[i].pieces()]
    work = [piece for _, piece in pieces]
    waiting: dict[int, dict[int, tuple[Part, int]]] = {}
    added: dict[int, Part] = {}
    done = [0] * len(asked)
    for k, found in workers.run(summarise, work, [piece.measurements for piece in work], progress):
        i, piece = pieces[k]
        if isinstance(found, Summary):
            yield i, found
            continue
        # In the order of the episodes, whichever come first: sums of the same numbers in another order differ.
        waiting.setdefault(i, {})[piece.first] = found, piece.last or 0
        while done[i] in waiting[i]:
            later, done[i] = waiting[i].pop(done[i])
            added[i] = added[i].merge(later) if i in added else later
        if done[i] == asked[i].episodes:
            with one_thread():
                whole = added.pop(i).summary(_resampling(asked[i].episodes), asked[i].metrics)
            yield i, whole


@one_thread()
def combine_summaries(found: Sequence[Summary]) -> tuple[list[Record], xarray.Dataset, xarray.Dataset]:
    """Return what the summaries of all competitors of an evaluation come to.

    Returns:
        Records, as :func:`.metrics.tidy_records` makes them; curves, as :func:`.curves.curves_of`; and the evaluation,
        of whose variables there is what was kept of the first episodes, over policy, drawn_episode and time.
    """
    evaluation = _heads_together(found)
    records = records_of([one.contender for one in found], evaluation, _resampling(found[0].episodes))
    each = [one.curves for one in found]
    if len({one.contender.control for one in found if one.curves.actions}) > 1:
        each = [
            one.curves._replace(actions=[f"{one.contender.control}: {part}" for part in one.curves.actions])
            for one in found
        ]
    curves = stack_curves(each, evaluation, found[0].episodes)
    return records, curves, evaluation


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


def write_summary(path: Path, summary: Summary, made_by: str) -> None:
    """Keep a summary in a file, from which nothing is executed when it is read.

    Args:
        path: of the file, whole or as it was.
        summary: of a competitor.
        made_by: what else it depends on, such as versions, in words.

    Raises:
        ValueError: if it cannot be written.
    """
    own = summary.contender
    words = {
        "made_by": made_by,
        "name": own.name,
        "kind": own.kind,
        "control": own.control,
        "measures": own.measures,
        "further": own.further,
        "actions": summary.curves.actions,
        "gains": summary.curves.gains,
        "losses": own.losses,
        "episodes": summary.episodes,
    }
    arrays: dict[str, Any] = {f"curve {name}": values for name, values in summary.curves.curves.items()}
    if own.costs is not None:
        arrays["costs"] = own.costs
    head = numpy.frombuffer(
        bytes(summary.head.to_netcdf(engine="scipy", format="NETCDF3_64BIT")), numpy.uint8
    )
    with whole_file(path) as partial, partial.open("wb") as file:
        numpy.savez(file, words=json.dumps(words), head=head, **arrays)


def read_summary(path: Path, made_by: str) -> Summary | None:
    """Return what :func:`write_summary` has kept; None where there is nothing, or nothing that was made by the same."""
    if not path.exists():
        return None
    try:
        with numpy.load(path, allow_pickle=False) as kept:
            words = json.loads(str(kept["words"]))
            if words["made_by"] != made_by:
                return None
            with xarray.open_dataset(io.BytesIO(kept["head"].tobytes()), engine="scipy") as read:
                head = read.load()
            curves = {n.removeprefix("curve "): kept[n] for n in kept.files if n.startswith("curve ")}
            costs = kept["costs"] if "costs" in kept.files else None
            measures, further = (
                [Measure(m[0], m[1], m[2], Estimate(*m[3]), m[4]) for m in words[word]]
                for word in ("measures", "further")
            )
            losses = Losses(*words["losses"]) if words["losses"] else None
            name, kind, control = (words[word] for word in ("name", "kind", "control"))
            contender = Contender(name, kind, control, measures, further, costs, losses)
            own = CompetitorCurves(curves, words["actions"], words["gains"])
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return None  # what a crash has left half: it is made again
    head.attrs = {name: _plain(value) for name, value in head.attrs.items()}
    return Summary(contender, own, head, words["episodes"])


def _plain(value: Any) -> Any:
    """Return an attribute as it was before a file held it."""
    return value.item() if isinstance(value, numpy.generic) else value
