"""Which filter is best for a recording, by how much, and with which parameters.

The recording is cut into blocks. Every family of filters is fitted to half of them by maximum likelihood. One is
chosen by its likelihood on these and on a quarter more, less one nat for each fitted parameter (Akaike, IEEE Trans. AC
19, 1974), and fitted to all three quarters. The last quarter judges it against what is shipped, which is not fitted.
Intervals are of whole stretches of measurements, since neighbours are not independent.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Container, Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ..envs.catalogue import make_task
from ..envs.recording import Recording
from ..envs.task import Task
from ..evaluation.bootstrap import Estimate
from ..evaluation.likelihood import Span, WindowLikelihood, cut_windows
from ..evaluation.predictions import UNKNOWN, Predictions, correlation, mean_of, relative_error
from .fitted_filters import families_of
from .fitting import Fit, Interval, fit, profile_intervals, searched_intervals, with_noise_scale
from .problem import Problem
from .table import Tunable
from .tuned_values import make_tuned_policy

LEAST = 5
"""Measurements after the start of the track that anything can be fitted to."""
FEWEST = 40
"""Measurements of a recording from which on it is cut into blocks; of fewer everything is fitted to all of it."""
BLOCK_MEASUREMENTS = 40
MOST_BLOCKS = 24
LONGEST_WARM_UP = 20
APART = 10.0
"""s between the measurements to which anchored filters are fitted: within less, fixes are what the receiver's own
filter makes of them, and one-step predictions say much of that and little of errors that last."""
MEMORY = 8
"""Part of a recording by which the windows of anchored filters begin earlier: an eighth."""


class Share(NamedTuple):
    """Measurements of a recording that serve one purpose."""

    fitted: list[Span]
    chosen: list[Span]
    judged: list[Span]
    warm_up: int
    apart: bool
    """Whether the three are different measurements."""


def share_out(recording: Recording) -> Share:
    """Cut a recording into what filters are fitted to, chosen on and judged on: a half and two quarters of it.

    Raises:
        ValueError: if it has too few measurements for anything.
    """
    total = int(recording.rows.sum())
    if total < LEAST:
        raise ValueError(
            f"recording {recording.name!r} has {total} measurements after the start of its track: to fit anything "
            f"takes {LEAST}"
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


class Anchor(NamedTuple):
    """How a filter with a second sensor predicts measurements some time apart, and the best without one."""

    name: str
    other: str
    gain: float
    """Mean log-likelihood less the other's on the measurements of the choice that are ``APART``, nats; both are fitted
    to such measurements."""


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
    anchor: Anchor | None = None
    """None where the recording has no second sensor."""

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
    if int(recording.rows.sum()) * _interval(recording) < FEWEST * APART:  # too few that are apart
        families = {name: family for name, family in families.items() if not family.anchored}
    fits: dict[str, Fit] = {}
    tunables: dict[str, Tunable] = {}
    likelihoods: dict[str, WindowLikelihood] = {}
    for i, (name, family) in enumerate(families.items()):
        progress(f"fitting {name}", 0.6 * i / len(families))
        tunable = _with_noise(problem, family, noise)
        likelihood = _likelihood(recording, task, share.fitted, share.warm_up, tunable)
        fits[name], tunables[name], likelihoods[name] = fit(likelihood, tunable, seed), tunable, likelihood
    makers = {
        **shipped,
        **{
            name: make_tuned_policy(f"fitted {name}", tunables[name], found.values)
            for name, found in fits.items()
        },
    }

    def judge(makers: Mapping[str, Any]) -> tuple[list[Competitor], str]:
        with numpy.errstate(all="ignore"):  # what diverges is judged by its numbers
            dataset = problem.evaluate(makers, recording, tracks=True, **keywords)
        counts = {name: len(fits[name].values) for name in makers if name in fits}
        anchored = {name for name, tunable in tunables.items() if tunable.anchored}
        return _Judgement(Predictions(dataset, task), share, anchored).competitors(counts)

    progress("replaying the recording", 0.6)
    competitors, best = judge(makers)
    progress("computing intervals", 0.9)
    alone = [c for c in competitors if c.name not in tunables or not tunables[c.name].anchored]
    chosen = _likeliest([c for c in alone if c.fitted])
    anchor = None
    for name in [c.name for c in competitors if c not in alone]:
        anchor = _compare_anchored(recording, task, share, name, chosen.name, tunables, fits[name], seed)
        if anchor.gain > 0.0:
            chosen = next(c for c in competitors if c.name == name)
    name, tunable = chosen.name, tunables[chosen.name]
    if share.apart:  # to all that does not judge
        begin = dataclasses.replace(tunable, start=fits[name].values)
        spans = [*share.fitted, *share.chosen]
        likelihoods[name] = _likelihood(recording, task, spans, share.warm_up, begin)
        fits[name] = fit(likelihoods[name], begin, seed, starts=1)
        makers = {name: make_tuned_policy(f"fitted {name}", tunable, fits[name].values), best: shipped[best]}
        refitted = next(c for c in judge(makers)[0] if c.name == name)
        before, chosen = chosen, refitted._replace(log_likelihood=chosen.log_likelihood)
        competitors = [chosen if c is before else c for c in competitors]
        alone = [chosen if c is before else c for c in alone]
    intervals = _intervals(likelihoods[name], tunable, fits[name])
    progress("done", 1.0)
    advised = chosen if tunable.anchored else _likeliest(alone)
    others = sorted(
        (c for c in competitors if c is not advised),
        key=lambda c: (math.isnan(c.log_likelihood), -c.log_likelihood),
    )
    return Advice(recording, share, [advised, *others], chosen, best, fits, tunables, intervals, anchor)


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
    likelihood = _likelihood(recording, task, spans, share.warm_up, tunable)
    found = fit(likelihood, tunable, seed)
    return tunable, found, _intervals(likelihood, tunable, found)


def _task(problem: Problem, recording: Recording, keywords: Mapping[str, Any]) -> Task:
    """Task with the parameters of a recording, without it."""
    parameters = recording.scenario(problem.task, keywords).parameters
    return make_task(problem.task, None, **{**parameters, **keywords, "horizon": 1})


def _with_noise(problem: Problem, family: Tunable, noise: bool) -> Tunable:
    """Fit the scale of the noise too, where that is wanted and can be: measurements apart say little of it."""
    log_format = problem.task.log_format
    if not noise or family.anchored or log_format is None or log_format.scale_noise is None:
        return family
    return with_noise_scale(family, log_format.scale_noise)


def _likelihood(
    recording: Recording,
    task: Task,
    spans: Sequence[Span],
    warm_up: int,
    tunable: Tunable,
    thinned: bool = False,
) -> WindowLikelihood:
    """Likelihood of a tunable's parameters on spans of a recording; of an anchored one, or where that is asked for, of
    measurements that are ``APART``.
    """
    every = 1
    if tunable.anchored or thinned:
        warm_up = max(warm_up, int(recording.rows.sum()) // MEMORY)
        every = max(1, round(APART / _interval(recording)))
    windows = cut_windows(recording, task, spans, warm_up, every)
    return WindowLikelihood(task, windows, tunable.start, tunable.apply, tunable.in_lanes)


def _intervals(likelihood: WindowLikelihood, tunable: Tunable, found: Fit) -> dict[str, Interval]:
    """Intervals of the parameters, of an anchored filter by searches, since size and duration of its error are tied."""
    find = searched_intervals if tunable.anchored else profile_intervals
    return find(likelihood, tunable, found)


def _compare_anchored(
    recording: Recording,
    task: Task,
    share: Share,
    name: str,
    other: str,
    tunables: Mapping[str, Tunable],
    fitted: Fit,
    seed: int,
) -> Anchor:
    """Compare an anchored filter with the best other one on measurements that are ``APART``, both fitted to such.

    That is the likelihood that both have in common: of the same measurements, given the same earlier ones. From one
    measurement to the next the other follows errors that last, and so predicts them well.
    """

    def apart(spans: Sequence[Span], tunable: Tunable) -> WindowLikelihood:
        return _likelihood(recording, task, spans, share.warm_up, tunable, thinned=True)

    rival = fit(apart(share.fitted, tunables[other]), tunables[other], seed)
    means = []
    for tunable, found in ((tunables[name], fitted), (tunables[other], rival)):
        chosen = apart(share.chosen, dataclasses.replace(tunable, start=found.values))
        values = numpy.array([[value] for value in found.values.values()])
        means.append(float(chosen(values)[0]) / chosen.count)
    return Anchor(name, other, means[0] - means[1])


def _interval(recording: Recording) -> float:
    """Median time between measurements, s."""
    return float(numpy.nanmedian(numpy.diff(recording.seconds, axis=1)))


class _Judgement:
    """What all competitors did on the measurements that chose and on those that judge.

    Args:
        predictions: of all.
        share: which measurements they are.
        anchored: names of filters with a second sensor, of which an estimate alone does not say what they predict.
    """

    def __init__(self, predictions: Predictions, share: Share, anchored: Container[str] = ()) -> None:
        self.predictions, self.anchored = predictions, anchored
        choosing = [*share.fitted, *share.chosen] if share.apart else share.chosen
        self.chosen, self.judged = (self._mask(spans) for spans in (choosing, share.judged))

    def _mask(self, spans: Sequence[Span]) -> numpy.ndarray:
        """Measurements, ``(episodes, time)``."""
        mask = numpy.zeros(self.predictions.shape, dtype=bool)
        for span in spans:
            mask[span.episode, span.first : span.last] = True
        return mask

    def competitors(self, fitted: Mapping[str, int]) -> tuple[list[Competitor], str]:
        """Judge everybody; the second is the best of those that were not fitted.

        Args:
            fitted: how many parameters of whom.
        """
        found, judged = self.predictions, self.judged
        errors = {
            name: None if name in self.anchored else found.prediction_error(name) for name in found.names
        }
        predicted = {name: (each**2).sum(axis=0) for name, each in errors.items() if each is not None}
        squares = {name: found.squared_error(name) for name in found.names} if found.has_truth else {}
        judged_by = squares or predicted
        shipped = {
            name: -mean_of(found.log_likelihood(name), judged) for name in found.names if name not in fitted
        }
        if judged_by:
            shipped = {name: mean_of(judged_by[name], judged) for name in shipped}
        best = min(shipped, key=lambda name: (math.isnan(shipped[name]), shipped[name]))
        rows = []
        for name in found.names:
            each, penalty = errors[name], fitted.get(name, 0) / self.chosen.sum()
            rows.append(
                Competitor(
                    name,
                    name in fitted,
                    fitted.get(name, 0),
                    mean_of(found.log_likelihood(name), self.chosen) - penalty,
                    found.difference(name, best, judged),
                    math.sqrt(mean_of(predicted[name], judged)) if name in predicted else math.nan,
                    math.sqrt(mean_of(squares[name], judged)) if squares else math.nan,
                    relative_error(judged_by[name], judged_by[best], judged)
                    if name in judged_by
                    else UNKNOWN,
                    found.nis(name, judged),
                    UNKNOWN if each is None else correlation(each, judged),
                )
            )
        return rows, best


def _likeliest(competitors: Sequence[Competitor]) -> Competitor:
    """The one of largest log-likelihood; where nobody says any, the one of smallest error."""
    known = [c for c in competitors if not math.isnan(c.log_likelihood)]
    if not known:
        return min(competitors, key=lambda c: (math.isnan(c.error), c.error))
    return max(known, key=lambda c: c.log_likelihood)
