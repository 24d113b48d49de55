"""Likelihoods and errors of competitors on a log, summed over stretches of it.

All competitors process the log side by side, in chunks of measurements, and only sums over stretches are
stored.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy

from ..envs.contract.companions import find_companion
from ..envs.contract.log_format import LogFormat
from ..envs.contract.model import Episode, Model
from ..envs.engine.programs import Report
from ..evaluation.running.evaluate import LIKELIHOOD, Experiment, Plan, plan_of
from ..evaluation.running.rollout import run_stretches
from ..evaluation.running.threads import one_thread
from ..evaluation.statistics.bootstrap import IntervalEstimate, ratio
from ..evaluation.statistics.predictions import interval_of_sums, stretches_of
from ..filters.angles import unwrap

if TYPE_CHECKING:
    import xarray

ROWS = 1 << 13
"""Measurements of a chunk, over all episodes together."""


def report_scores(model: Model, episode: Episode) -> dict[str, Any]:
    """Return a filter's likelihoods and estimate after a measurement, arrays ``(..., N)`` by name."""
    records = model.records(episode)
    found = {name: records[name] for name in LIKELIHOOD if name in records}
    return {**found, "estimate": model.mean(episode)}


def report_picture(model: Model, episode: Episode) -> dict[str, Any]:
    """Return the quantities to draw after a measurement, arrays ``(..., N)`` by name."""
    found = {**model.records(episode), **model.track(episode)}
    shown = ("estimate", "truth", *LIKELIHOOD)
    return {name: found[name] for name in found if name in shown or name.startswith("measurement_")}


class PairSums:
    """Sums over stretches of a log, for each pair over the measurements where both are finite.

    Args:
        competitors: number of competitors, n.
        stretch: number of the stretch of each measurement, ``(E, T)``; -1 for an excluded one.

    Attributes:
        sums: sum of a competitor where both it and another are finite, for stretch, competitor and other, ``(S, n,
            n)``.
        counts: number of measurements at which both are finite, ``(S, n, n)``.
    """

    def __init__(self, competitors: int, stretch: numpy.ndarray) -> None:
        self._stretch = stretch
        shape = int(stretch.max()) + 1, competitors, competitors
        self.sums: numpy.ndarray = numpy.zeros(shape)
        self.counts: numpy.ndarray = numpy.zeros(shape)

    def add(self, values: numpy.ndarray, first: int) -> None:
        """Add values ``(n, E, rows)`` of all competitors to the sums, from measurement ``first`` on."""
        stretch = self._stretch[:, first : first + values.shape[2]]
        for number in numpy.unique(stretch[stretch >= 0]).tolist():
            some = values[:, stretch == number]
            finite = numpy.isfinite(some)
            there = finite.astype(float)
            self.sums[number] += numpy.where(finite, some, 0.0) @ there.T
            self.counts[number] += there @ there.T

    def total(self, i: int) -> tuple[float, int]:
        """Return the sum of competitor i's values over all stretches, and their number."""
        return float(self.sums[:, i, i].sum()), int(self.counts[:, i, i].sum())

    def mean(self, i: int) -> float:
        """Return the mean of competitor i's values; NaN where no value is finite."""
        total, count = self.total(i)
        return total / count if count else math.nan

    def difference(self, i: int, j: int) -> IntervalEstimate:
        """Return the paired mean of competitor i's values less j's, with its interval."""
        counts = self.counts[:, i, j]
        sums = numpy.stack([self.sums[:, i, j] - self.sums[:, j, i], counts], axis=1)
        return interval_of_sums(sums, counts, ratio)

    def relative_root(self, i: int, j: int) -> IntervalEstimate:
        """Return the paired ratio of the roots of two competitors' mean squares, less one, with its interval."""
        sums = numpy.stack([self.sums[:, i, j], self.sums[:, j, i]], axis=1)
        return interval_of_sums(sums, self.counts[:, i, j], lambda means: numpy.sqrt(ratio(means)) - 1.0)


class _Whiteness:
    """Sums for the correlation of successive prediction errors of a competitor.

    Args:
        stretch: number of the stretch of each measurement, ``(E, T)``; -1 for an excluded one.
        main: whether each measured number belongs to the first group, ``(m,)``.
    """

    def __init__(self, stretch: numpy.ndarray, main: numpy.ndarray) -> None:
        self._stretch, self._main = stretch, main
        m, episodes = len(main), len(stretch)
        self._last = self._received = numpy.full((m, episodes, 1), math.nan)
        # The first series is of the first group together, the others of one number each.
        self._sums = numpy.zeros((1 + m, int(stretch.max()) + 1, 2))
        self._counts = numpy.zeros(self._sums.shape[:2], dtype=int)

    def add(self, errors: numpy.ndarray, first: int) -> None:
        """Add the products of successive prediction errors ``(m, E, rows)`` from measurement ``first`` on."""
        before = numpy.concatenate([self._last, errors[..., :-1]], axis=2)
        whole = numpy.concatenate([self._received, errors], axis=2)
        places = numpy.where(numpy.isfinite(whole), numpy.arange(whole.shape[2]), 0)
        received = numpy.take_along_axis(whole, numpy.maximum.accumulate(places, axis=2), axis=2)
        self._last, self._received = errors[..., -1:].copy(), received[..., -1:].copy()
        together = [part[self._main].sum(axis=0) for part in _products(errors, before)]
        alone = numpy.stack(_products(errors, received[..., :-1]), axis=1)
        stretch = self._stretch[:, first : first + errors.shape[2]]
        for i, pair in enumerate((numpy.stack(together), *alone)):
            there = (stretch >= 0) & numpy.isfinite(pair).all(axis=0)
            count = self._counts.shape[1]
            self._counts[i] += numpy.bincount(stretch[there], minlength=count)
            for j in range(2):
                self._sums[i, :, j] += numpy.bincount(stretch[there], pair[j][there], count)

    def correlations(self) -> list[IntervalEstimate]:
        """Return the correlations of successive prediction errors: of the first group, then of each measured
        number.
        """
        pairs = zip(self._sums, self._counts, strict=True)
        return [interval_of_sums(sums, counts, ratio) for sums, counts in pairs]


def _products(errors: numpy.ndarray, before: numpy.ndarray) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return products of successive errors and their mean squares, whose sums' ratio is the correlation."""
    return errors * before, 0.5 * (errors**2 + before**2)


class Roles(NamedTuple):
    """Boolean masks ``(E, T)`` of the measurements for the choice among competitors, and for the judgement."""

    chosen: numpy.ndarray
    judged: numpy.ndarray


class LogScores:
    """Sums of competitors' likelihoods and errors over a log's measurements for choice and judgement.

    Args:
        plan: plan of their evaluation on the log.
        roles: roles of its measurements.

    Attributes:
        names: names of the competitors, in the order of the sums.
        log_likelihood: sums over the measurements of the choice, and over those of the judgement.
        predicted: sums of squared prediction errors over the same two sets, summed over the first group of measured
            numbers; None where no log format gives the prediction of an estimate.
        squared: sums of judged squared errors of the main components; None without truth.
    """

    def __init__(self, plan: Plan, roles: Roles) -> None:
        self._plan, task = plan, next(iter(plan.models.values())).task
        self._recording: Any = plan.scenario.recording
        self._task, n = task, len(plan.competitors)
        self.names: list[str] = list(plan.competitors)
        chosen, self._judged = (stretches_of(mask[:, : task.horizon]) for mask in roles)
        self.chosen_measurements: int = int((chosen >= 0).sum())
        lengths = [task.horizon] * len(chosen) if plan.lengths is None else plan.lengths
        self._there = numpy.arange(task.horizon) < numpy.asarray(lengths)[:, None]
        self.log_likelihood: tuple[PairSums, PairSums] = PairSums(n, chosen), PairSums(n, self._judged)
        self.squared: PairSums | None = PairSums(n, self._judged) if task.has_truth else None
        groups = task.groups
        main = list(next(iter(groups.values()))) if groups else [task.components[0].name]
        self._components = [i for i, each in enumerate(task.components) if each.name in main]
        self._nis = numpy.zeros((n, 2))
        self._format = find_companion(task, LogFormat)
        self.predicted: tuple[PairSums, PairSums] | None = None
        self._whiteness: list[_Whiteness] = []
        self._estimates: list[numpy.ndarray] = []
        """Last estimate of each competitor, ``(C, E, 1)``."""
        if self._format is not None and self._format.predict is not None:
            self.predicted = PairSums(n, chosen), PairSums(n, self._judged)
            nothing = numpy.full((len(task.components), len(chosen), 1), math.nan)
            self._estimates = [nothing] * n

    def add(self, first: int, reports: Sequence[Mapping[str, numpy.ndarray]]) -> None:
        """Add each competitor's reports ``(rows, ..., E)`` from measurement ``first`` on to the sums."""
        rows = len(reports[0]["estimate"])
        there = self._there[:, first : first + rows]
        found = [
            {name: numpy.where(there, numpy.moveaxis(each, 0, -1), math.nan) for name, each in report.items()}
            for report in reports
        ]
        unknown = numpy.full(there.shape, math.nan)
        likely, nis, degrees = (
            numpy.stack([each.get(name, unknown) for each in found]) for name in LIKELIHOOD
        )
        for sums in self.log_likelihood:
            sums.add(likely, first)
        known = (self._judged[:, first : first + rows] >= 0) & (degrees > 0.0) & numpy.isfinite(nis)
        for i, each in enumerate((nis, degrees)):
            self._nis[:, i] += numpy.where(known, each, 0.0).sum(axis=(1, 2))
        estimates = [each["estimate"] for each in found]
        if self.squared is not None:
            truth = self._log_values(self._recording.truth, first, rows)
            errors = [self._task.subtract(each, truth)[self._components] for each in estimates]
            self.squared.add(numpy.stack([(each**2).sum(axis=0) for each in errors]), first)
            estimates = [unwrap(each, truth, self._task.periods) for each in estimates]
        if self.predicted is not None:
            names = self._recording.measurements
            measured = {name: self._log_values(values, first, rows) for name, values in names.items()}
            squares = numpy.stack(
                [
                    self._predict(i, each, SimpleNamespace(**measured), first)
                    for i, each in enumerate(estimates)
                ]
            )
            for sums in self.predicted:
                sums.add(squares, first)

    def _predict(self, i: int, estimate: numpy.ndarray, measurement: Any, first: int) -> numpy.ndarray:
        """Return competitor i's squared prediction errors of the first group, after adding their products to the
        sums.
        """
        before = numpy.concatenate([self._estimates[i], estimate[..., :-1]], axis=2)
        self._estimates[i] = estimate[..., -1:].copy()
        assert self._format is not None
        assert self._format.predict is not None
        predicted, measured = self._format.predict(before, measurement, self._task.parameters)
        errors = measured - predicted
        groups = [each.group for each in self._format.predicted[: len(errors)]]
        main = numpy.array([group == groups[0] for group in groups])
        if len(self._whiteness) == i:
            self._whiteness.append(_Whiteness(self._judged, main))
        self._whiteness[i].add(errors, first)
        squares: numpy.ndarray = (errors[main] ** 2).sum(axis=0)
        return squares

    def _log_values(self, values: Any, first: int, rows: int) -> numpy.ndarray:
        """Return ``rows`` of a log's values from ``first`` on, ``(..., E, rows)``; NaN beyond an episode's end."""
        some = values[self._plan.flight_numbers, first : first + rows].astype(float)
        return numpy.where(
            self._there[:, first : first + rows],
            numpy.moveaxis(some, -1, 0) if some.ndim > 2 else some,
            math.nan,
        )

    def nis(self, i: int) -> float:
        """Return competitor i's judged mean NIS over its dimension; NaN: unknown."""
        squares, degrees = self._nis[i].tolist()
        return squares / degrees if degrees else math.nan

    def correlation(self, i: int) -> IntervalEstimate:
        """Return the correlation of competitor i's successive judged prediction errors, of the first group."""
        return self._whiteness[i].correlations()[0]

    def correlations(self, i: int) -> dict[str, IntervalEstimate]:
        """Return the correlation of competitor i's successive prediction errors of each measured number, by its
        name.
        """
        assert self._format is not None
        found = self._whiteness[i].correlations()[1:]
        quantities = self._format.predicted[: len(found)]
        several = len({each.group for each in quantities}) > 1
        return dict(zip((each.name for each in quantities), found, strict=True)) if several else {}


def _start_runs(plan: Plan, report: Report) -> list[Iterator[dict[str, numpy.ndarray]]]:
    """Return an iterator for each competitor, which runs it over a log and yields reports by chunks."""
    rows, models = max(ROWS // len(plan.seeds), 1), plan.models
    return [
        run_stretches(models[name], maker, plan.kinds[name], plan.seeds, report, rows, name)
        for name, maker in plan.competitors.items()
    ]


@one_thread()
def score_log(
    experiment: Experiment,
    competitors: Mapping[str, Any],
    roles: Roles,
    tick: Callable[[float], None] = lambda share: None,
) -> LogScores:
    """Run competitors over a log; return the sums of their likelihoods and errors."""
    with numpy.errstate(all="ignore"):  # a diverging filter is judged by its numbers
        plan = plan_of(experiment, competitors)
        scores, runs = LogScores(plan, roles), _start_runs(plan, report_scores)
        done, horizon = 0, plan.models[scores.names[0]].task.horizon
        while done < horizon:
            reports: list[dict[str, numpy.ndarray]] = []
            for run in runs:
                reports.append(next(run))
                rows = len(reports[0]["estimate"])
                tick((done + rows * len(reports) / len(runs)) / horizon)
            scores.add(done, reports)
            done += rows
    return scores


@one_thread()
def replay_log(experiment: Experiment, competitors: Mapping[str, Any]) -> "xarray.Dataset":
    """Run competitors over a log; return estimates and likelihoods at every measurement as a dataset."""
    plan = plan_of(experiment, competitors)
    task = plan.models[next(iter(competitors))].task
    kept = plan.arrays(len(plan.seeds), len(plan.seeds))
    for name, run in zip(plan.competitors, _start_runs(plan, report_picture), strict=True):
        arrays: dict[str, numpy.ndarray] = {}
        done = 0
        for report in run:
            for key, each in report.items():
                if key not in arrays:
                    arrays[key] = numpy.full((len(plan.seeds), task.horizon, *each.shape[1:-1]), math.nan)
                arrays[key][:, done : done + len(each)] = numpy.moveaxis(each, -1, 0)
            done += len(each)
        kept.write(name, slice(None), arrays)
    return plan.dataset(kept, plan.seeds)
