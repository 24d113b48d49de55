"""Which filter is best for a recording, by how much, and with which parameters.

The recording is cut into blocks. Every family of filters is fitted to half of them by maximum likelihood. One is
chosen by its likelihood on these and on a quarter more, less one nat for each fitted parameter (Akaike, IEEE Trans. AC
19, 1974), and fitted to all three quarters. The last quarter judges it against what is shipped, which is not fitted.
Intervals are of whole stretches of measurements, since neighbours are not independent.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy
import xarray

from ..envs.catalogue import make_task
from ..envs.recording import Recording
from ..envs.task import Task
from ..evaluation.bootstrap import Bootstrap, Estimate, ratio
from ..evaluation.likelihood import Span, WindowLikelihood, cut_windows
from .fitted_filters import families_of
from .fitting import Fit, Interval, fit, profile_intervals, with_noise_scale
from .problem import Problem
from .table import Tunable
from .tuned_values import tuned_policy

LEAST = 5
"""Measurements after the start of the track that anything can be fitted to."""
FEWEST = 40
"""Measurements of a recording from which on it is cut into blocks; of fewer everything is fitted to all of it."""
BLOCK_MEASUREMENTS = 40
MOST_BLOCKS = 24
LONGEST_WARM_UP = 20
STRETCHES = 30
"""Into which judged measurements are cut for intervals, at most; a stretch has at least ``SHORTEST_STRETCH``."""
SHORTEST_STRETCH = 8


class Share(NamedTuple):
    """Measurements of a recording that serve one purpose."""

    fitted: list[Span]
    chosen: list[Span]
    judged: list[Span]
    warm_up: int
    apart: bool
    """Whether the three are different measurements."""


def share_out(recording: Recording) -> Share:
    """Cut a recording into what filters are fitted to, chosen on and judged on: half of its blocks and two quarters.

    Raises:
        ValueError: if it has too few measurements for anything.
    """
    total = int(recording.rows.sum())
    if total < LEAST:
        raise ValueError(
            f"recording {recording.name!r} has {total} measurements after the start of its track: to fit anything takes "
            f"{LEAST}"
        )
    blocks = min(MOST_BLOCKS, max(8, total // BLOCK_MEASUREMENTS)) // 4 * 4
    warm_up = max(2, min(LONGEST_WARM_UP, total // 20))
    if total < FEWEST:
        whole = [Span(i, min(2, int(rows) - 1), int(rows)) for i, rows in enumerate(recording.rows)]
        return Share(whole, whole, whole, warm_up, False)
    ends = [total * i // blocks for i in range(blocks + 1)]
    found: list[list[Span]] = [[], [], [], []]
    first_of_episode = numpy.concatenate([[0], numpy.cumsum(recording.rows)])
    for block, (begin, end) in enumerate(itertools.pairwise(ends)):
        for episode, offset in enumerate(first_of_episode[:-1]):
            first, last = max(begin, offset), min(end, first_of_episode[episode + 1])
            if block == 0:
                first = max(first, offset + warm_up)  # the start of the track is no motion
            if last > first:
                found[block % 4].append(Span(episode, int(first - offset), int(last - offset)))
    return Share([*found[0], *found[2]], found[1], found[3], warm_up, True)


class Competitor(NamedTuple):
    """One line of the table of an advice."""

    name: str
    fitted: bool
    """Whether its parameters were fitted to this recording."""
    parameters: int
    """How many were."""
    log_likelihood: float
    """Mean of the measurements that chose, less one nat in all for each fitted parameter, nats; NaN where it says
    none."""
    difference: Estimate
    """Judged log-likelihood per measurement less that of the best shipped, nats."""
    prediction: float
    """Root mean square of the judged prediction errors; NaN where the log format has no prediction."""
    error: float
    """Root mean square of the judged errors of the main components; NaN without truth."""
    relative_error: Estimate
    """Judged error over that of the best shipped, less one; without truth of the prediction errors."""
    nis: float
    """Mean normalised innovation squared of judged measurements over its dimension."""
    correlation: Estimate
    """Of successive judged prediction errors; zero where they are white."""


class Advice(NamedTuple):
    """What :func:`advise` has found."""

    recording: Recording
    share: Share
    competitors: list[Competitor]
    """The advised one first, then by their log-likelihood."""
    fitted: Competitor
    """The one of the fitted ones that would be advised."""
    best_shipped: str
    """Of smallest judged error, or prediction error where there is no truth."""
    fits: dict[str, Fit]
    tunables: dict[str, Tunable]
    intervals: dict[str, Interval]
    """Of the parameters of ``fitted``."""

    @property
    def advised(self) -> Competitor:
        """Who is advised."""
        return self.competitors[0]


def advise(
    problem: Problem,
    recording: Recording,
    shipped: Mapping[str, Any],
    own: Mapping[str, Tunable] | None = None,
    noise: bool = True,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda what, share: None,
    **keywords: Any,
) -> Advice:
    """Fit every family of filters to a recording, choose one, and judge it against what is shipped.

    Args:
        problem: of the recording.
        recording: with truth or without.
        shipped: competitors that are not fitted, by name.
        own: further families, such as an estimator of a user's with limits of its parameters.
        noise: fit the scale of the measurement noise, too, where measurements state one.
        seed: of the starts of the fits.
        progress: told what is done, and which share of all.
        **keywords: parameters of the task.

    Raises:
        ValueError: if nothing can be fitted, or the recording is too short.
    """
    task, share = _task(problem, recording, keywords), share_out(recording)
    families = {**families_of(problem, recording), **(own or {})}
    windows = cut_windows(recording, task, share.fitted, share.warm_up)
    fits: dict[str, Fit] = {}
    tunables: dict[str, Tunable] = {}
    likelihoods: dict[str, WindowLikelihood] = {}
    for i, (name, family) in enumerate(families.items()):
        progress(f"fitting {name}", 0.6 * i / len(families))
        tunable = _with_noise(problem, family, noise)
        likelihood = WindowLikelihood(task, windows, tunable.start, tunable.apply, tunable.in_lanes)
        fits[name], tunables[name], likelihoods[name] = fit(likelihood, tunable, seed), tunable, likelihood
    makers = {
        **shipped,
        **{
            name: tuned_policy(f"fitted {name}", tunables[name], found.values) for name, found in fits.items()
        },
    }
    progress("replaying the recording", 0.6)
    with numpy.errstate(all="ignore"):  # what diverges is judged by its numbers
        dataset = problem.evaluate(makers, recording, tracks=True, **keywords)
    judged = _Judged(dataset, task, share)
    competitors, best = judged.competitors({name: len(found.values) for name, found in fits.items()})
    progress("computing intervals", 0.9)
    chosen = _likeliest([c for c in competitors if c.fitted])
    name, tunable = chosen.name, tunables[chosen.name]
    if share.apart:  # to all that does not judge
        windows = cut_windows(recording, task, [*share.fitted, *share.chosen], share.warm_up)
        begin = dataclasses.replace(tunable, start=fits[name].values)
        likelihoods[name] = WindowLikelihood(task, windows, begin.start, begin.apply, begin.in_lanes)
        fits[name] = fit(likelihoods[name], begin, seed, starts=1)
        makers = {name: tuned_policy(f"fitted {name}", tunable, fits[name].values), best: shipped[best]}
        dataset = problem.evaluate(makers, recording, tracks=True, **keywords)
        again, _ = _Judged(dataset, task, share).competitors({name: chosen.parameters})
        refitted = next(c for c in again if c.name == name)
        refitted = refitted._replace(log_likelihood=chosen.log_likelihood)
        competitors = [refitted if c.name == name else c for c in competitors]
        chosen = refitted
    intervals = profile_intervals(likelihoods[name], tunable, fits[name])
    progress("done", 1.0)
    advised = _likeliest(competitors)
    others = sorted(
        (c for c in competitors if c is not advised),
        key=lambda c: (math.isnan(c.log_likelihood), -c.log_likelihood),
    )
    return Advice(recording, share, [advised, *others], chosen, best, fits, tunables, intervals)


def fit_all(
    problem: Problem,
    recording: Recording,
    family: Tunable,
    noise: bool = True,
    seed: int = 0,
    **keywords: Any,
) -> tuple[Tunable, Fit, dict[str, Interval]]:
    """Fit one filter to all of a recording; nothing is left to judge it.

    Args:
        problem: of the recording.
        recording: with truth or without.
        family: what is fitted.
        noise: as of :func:`advise`.
        seed: of the starts of the fit.
        **keywords: parameters of the task.

    Returns:
        The family with the scale of the noise, what was found, and the intervals of the parameters.
    """
    task = _task(problem, recording, keywords)
    share = share_out(recording)
    spans = [Span(i, min(share.warm_up, int(rows) - 1), int(rows)) for i, rows in enumerate(recording.rows)]
    if share.apart:  # side by side it takes a fraction of the time
        spans = [*share.fitted, *share.chosen, *share.judged]
    tunable = _with_noise(problem, family, noise)
    windows = cut_windows(recording, task, spans, share.warm_up)
    likelihood = WindowLikelihood(task, windows, tunable.start, tunable.apply, tunable.in_lanes)
    found = fit(likelihood, tunable, seed)
    return tunable, found, profile_intervals(likelihood, tunable, found)


def _task(problem: Problem, recording: Recording, keywords: Mapping[str, Any]) -> Task:
    """Task with the parameters of a recording, without it."""
    parameters = recording.scenario(problem.task, keywords).parameters
    return make_task(problem.task, None, **{**parameters, **keywords, "horizon": 1})


def _with_noise(problem: Problem, family: Tunable, noise: bool) -> Tunable:
    """Fit the scale of the noise too, where that is wanted and can be."""
    log_format = problem.task.log_format
    if not noise or log_format is None or log_format.scale_noise is None:
        return family
    return with_noise_scale(family, log_format.scale_noise)


class _Judged:
    """What all competitors did on the measurements that chose and on those that judge.

    Args:
        dataset: of all, with tracks.
        task: of the recording.
        share: which measurements they are.
    """

    def __init__(self, dataset: xarray.Dataset, task: Task, share: Share) -> None:
        self.dataset, self.task = dataset, task
        choosing = [*share.fitted, *share.chosen] if share.apart else share.chosen
        self.chosen, self.judged = (self._mask(spans) for spans in (choosing, share.judged))
        self.names = [str(name) for name in dataset["policy"].values]
        self.has_truth = bool(dataset.attrs["truth"])
        self.stretches = {id(mask): _stretches(mask) for mask in (self.chosen, self.judged)}

    def _mask(self, spans: Sequence[Span]) -> numpy.ndarray:
        """Measurements, ``(episodes, time)``."""
        mask = numpy.zeros((self.dataset.sizes["episode"], self.dataset.sizes["time"]), dtype=bool)
        for span in spans:
            mask[span.episode, span.first : span.last] = True
        return mask

    def log_likelihood(self, name: str) -> numpy.ndarray:
        """Of every measurement, ``(episodes, time)``; NaN where it is not known."""
        if "log_likelihood" not in self.dataset:
            return numpy.full(self.judged.shape, math.nan)
        found: numpy.ndarray = self.dataset["log_likelihood"].sel(policy=name).values
        return found

    def squared_error(self, name: str) -> numpy.ndarray:
        """Squared error of the first group of components, ``(episodes, time)``."""
        groups = self.task.groups
        parts = list(next(iter(groups.values()))) if groups else [self.task.components[0].name]
        error = self.dataset["error"].sel(policy=name, component=parts)
        found: numpy.ndarray = (error**2).sum("component", skipna=False).values
        return found

    def prediction_error(self, name: str) -> numpy.ndarray | None:
        """Measured less predicted, ``(m, episodes, time)``; None where it cannot be told."""
        log_format = type(self.task).log_format
        if log_format is None or log_format.predict is None:
            return None
        estimate = numpy.moveaxis(self.dataset["estimate"].sel(policy=name).values, -1, 0)
        before = numpy.roll(estimate, 1, axis=2)
        before[:, :, 0] = math.nan
        predicted, measured = log_format.predict(before, _Measured(self.dataset, name))
        found: numpy.ndarray = measured - predicted
        return found

    def competitors(self, fitted: Mapping[str, int]) -> tuple[list[Competitor], str]:
        """Judge everybody; the second is the best of those that were not fitted."""
        squares, predictions, correlations = {}, {}, {}
        for name in self.names:
            errors = self.prediction_error(name)
            if errors is not None:
                predictions[name] = (errors**2).sum(axis=0)
                correlations[name] = self._correlation(errors)
            if self.has_truth:
                squares[name] = self.squared_error(name)
        judged_by = squares if self.has_truth else predictions
        shipped = [name for name in self.names if name not in fitted]
        worth = {
            name: _mean(judged_by[name], self.judged) if judged_by else -self._mean(name) for name in shipped
        }
        best = min(shipped, key=lambda name: (math.isnan(worth[name]), worth[name]))
        rows = []
        for name in self.names:
            relative = Estimate(math.nan, math.nan, math.nan)
            if judged_by:
                relative = self._ratio(judged_by[name], judged_by[best])
            rows.append(
                Competitor(
                    name,
                    name in fitted,
                    fitted.get(name, 0),
                    _mean(self.log_likelihood(name), self.chosen) - fitted.get(name, 0) / self.chosen.sum(),
                    self.difference(name, best, self.judged),
                    math.sqrt(_mean(predictions[name], self.judged)) if predictions else math.nan,
                    math.sqrt(_mean(squares[name], self.judged)) if squares else math.nan,
                    relative,
                    self._nis(name),
                    correlations.get(name, Estimate(math.nan, math.nan, math.nan)),
                )
            )
        return rows, best

    def _mean(self, name: str) -> float:
        return _mean(self.log_likelihood(name), self.judged)

    def _nis(self, name: str) -> float:
        """Mean over the dimension."""
        if "nis" not in self.dataset:
            return math.nan
        nis, degrees = (self.dataset[key].sel(policy=name).values for key in ("nis", "nis_degrees"))
        there = self.judged & (degrees > 0.0) & numpy.isfinite(nis)
        return float(nis[there].sum() / degrees[there].sum()) if there.any() else math.nan

    def difference(self, name: str, other: str, mask: numpy.ndarray) -> Estimate:
        """Mean difference of log-likelihoods, paired, with its interval over stretches of measurements."""
        values = self.log_likelihood(name) - self.log_likelihood(other)
        return self._interval(
            mask, numpy.stack([values, numpy.ones_like(values)], axis=-1), lambda sums: ratio(sums)
        )

    def _ratio(self, squares: numpy.ndarray, others: numpy.ndarray) -> Estimate:
        """Relative difference of root mean squares, paired."""
        values = numpy.stack([squares, others], axis=-1)
        return self._interval(self.judged, values, lambda sums: numpy.sqrt(ratio(sums)) - 1.0)

    def _correlation(self, errors: numpy.ndarray) -> Estimate:
        """Of successive prediction errors."""
        now, before = errors, numpy.roll(errors, 1, axis=2)
        before[:, :, 0] = math.nan
        values = numpy.stack([(now * before).sum(axis=0), 0.5 * (now**2 + before**2).sum(axis=0)], axis=-1)
        return self._interval(self.judged, values, lambda sums: ratio(sums))

    def _interval(
        self, mask: numpy.ndarray, values: numpy.ndarray, function: Callable[[numpy.ndarray], numpy.ndarray]
    ) -> Estimate:
        """Value and interval of a function of two means over the measurements of a mask.

        Args:
            mask: ``(episodes, time)``.
            values: ``(episodes, time, 2)``; what is NaN anywhere is left out.
            function: of means ``(n, 2)``.
        """
        there = mask & numpy.isfinite(values).all(axis=-1)
        if not there.any():
            return Estimate(math.nan, math.nan, math.nan)
        stretch = self.stretches[id(mask)]
        count = int(stretch.max()) + 1
        sums = numpy.stack(
            [numpy.bincount(stretch[there], values[there][:, i], minlength=count) for i in range(2)], axis=1
        )
        sums = sums[numpy.bincount(stretch[there], minlength=count) > 0]
        if len(sums) < 2:
            value = float(function(sums.sum(axis=0, keepdims=True))[0])
            return Estimate(value, math.nan, math.nan)
        bootstrap = Bootstrap(len(sums))
        return bootstrap.interval(function(bootstrap.means(sums)))


class _Measured:
    """Measurements of a dataset by attribute, ``(..., episodes, time)``."""

    def __init__(self, dataset: xarray.Dataset, name: str) -> None:
        self._dataset, self._name = dataset, name

    def __getattr__(self, name: str) -> numpy.ndarray:
        key = f"measurement_{name}"
        if name.startswith("_") or key not in self._dataset:
            raise AttributeError(name)
        values = self._dataset[key]
        if "policy" in values.dims:
            values = values.sel(policy=self._name)
        array: numpy.ndarray = values.values
        return numpy.moveaxis(array, -1, 0) if array.ndim > 2 else array


def _stretches(mask: numpy.ndarray) -> numpy.ndarray:
    """Number of the stretch that each measurement of a mask lies in, ``(episodes, time)``."""
    total = int(mask.sum())
    length = max(SHORTEST_STRETCH, -(-total // STRETCHES))
    number = numpy.zeros(mask.shape, dtype=int)
    number[mask] = numpy.arange(total) // length
    return number


def _mean(values: numpy.ndarray, mask: numpy.ndarray) -> float:
    there = mask & numpy.isfinite(values)
    return float(values[there].mean()) if there.any() else math.nan


def _likeliest(competitors: Sequence[Competitor]) -> Competitor:
    """The one of largest log-likelihood; where nobody says any, the one of smallest error."""
    known = [c for c in competitors if not math.isnan(c.log_likelihood)]
    if not known:
        return min(competitors, key=lambda c: (math.isnan(c.error), c.error))
    return max(known, key=lambda c: c.log_likelihood)
