"""Comparison of filters on two parts of a recording: one to choose among them, one to judge the chosen one."""

import itertools
import math
from collections.abc import Callable, Container, Mapping, Sequence
from typing import NamedTuple

import numpy

from ..envs.data.recording import Recording
from ..evaluation.competitors.likelihood import Span
from ..evaluation.statistics.bootstrap import IntervalEstimate
from ..evaluation.statistics.predictions import UNKNOWN
from .fitting import Fit
from .log_scores import LogScores, PairSums, Roles

LEAST = 5
"""Smallest number of measurements after the start of the track for a fit."""
FEWEST = 40
"""Smallest number of measurements of a recording that is cut into blocks; a shorter one is used as a whole for every
purpose.
"""
LARGEST_LOSS = 0.5
"""Nats per measurement by which a fit may be worse over the whole recording than in its windows, each of which starts
anew: a filter that loses more has lost the track.
"""
AS_GOOD = 0.1
"""Nats per measurement that a cheaper filter may lose, at the end of the interval: innovations of the plane are then
5 % larger. A difference within chance is not enough: on a short log all differences are.
"""
BLOCK_MEASUREMENTS = 40
MOST_BLOCKS = 24
LONGEST_WARM_UP = 20


class Share(NamedTuple):
    """Spans of a recording for the fit of filters, the choice among them, and the judgement of the chosen one."""

    fitted: list[Span]
    chosen: list[Span]
    judged: list[Span]
    warm_up: int
    apart: bool
    """Whether the three sets of measurements are disjoint."""


def split_recording(recording: Recording) -> Share:
    """Cut a recording into spans for fit (half), choice (a quarter) and judgement (a quarter) of filters."""
    total = int(recording.rows.sum())
    if total < LEAST:
        raise ValueError(
            f"recording {recording.name!r} has {total} measurements after the start of its track: a fit needs at "
            f"least {LEAST}"
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
                first = max(first, offset + warm_up)  # the start of the track contains no motion
            if last > first:
                found[block % 4].append(Span(episode, int(first - offset), int(last - offset)))
    return Share([*found[0], *found[2]], found[1], found[3], warm_up, True)


class JudgedFilter(NamedTuple):
    """Results of one filter on the measurements for choice and judgement, compared with a rival."""

    name: str
    fitted: bool
    """Whether its parameters were fitted to this recording."""
    parameters: int
    """Number of fitted parameters."""
    log_likelihood: float
    """Mean over the measurements of the choice, less one nat in all for each fitted parameter, nats; NaN where the
    filter reports none.
    """
    gain: IntervalEstimate
    """Mean log-likelihood of the filter less that of the rival, paired, nats."""
    difference: IntervalEstimate
    """Judged log-likelihood per measurement less that of the rival, nats."""
    prediction: float
    """Root mean square of the judged prediction errors; NaN where the log format has no prediction."""
    error: float
    """Root mean square of the judged errors of the main components; NaN without truth."""
    relative_error: IntervalEstimate
    """Judged error over that of the rival, less one; without truth the prediction error is used."""
    nis: float
    """Mean normalised innovation squared of judged measurements over its dimension."""
    correlation: IntervalEstimate
    """Correlation of successive judged prediction errors; zero where they are white."""
    correlations: Mapping[str, IntervalEstimate]
    """Correlation of successive prediction errors of each measured number, by its name; empty where all are of one
    kind.
    """


def roles_of(share: Share, shape: tuple[int, int]) -> Roles:
    """Return masks ``(episodes, time)`` of the measurements for the choice and for the judgement."""
    choosing = [*share.fitted, *share.chosen] if share.apart else share.chosen
    masks = []
    for spans in (choosing, share.judged):
        mask = numpy.zeros(shape, dtype=bool)
        for span in spans:
            mask[span.episode, span.first : span.last] = True
        masks.append(mask)
    return Roles(*masks)


class Judgement:
    """Comparison of all filters on a recording's measurements for the choice and for the judgement.

    Args:
        scores: sums of all competitors.
        share: spans of these measurements.
        parameters: number of fitted parameters, by the name of each fitted filter; all others are shipped.
        default: shipped filter that is the rival unless another is likelier beyond chance; empty: none.
        anchored: names of filters with a second sensor, whose estimate alone does not determine their prediction.
    """

    def __init__(
        self,
        scores: LogScores,
        share: Share,
        parameters: Mapping[str, int],
        default: str,
        anchored: Container[str] = (),
    ) -> None:
        self._share = share
        self.scores = scores
        self.parameters = parameters
        self.default = default
        self.shipped: list[str] = [name for name in scores.names if name not in parameters]
        self._numbers = {name: i for i, name in enumerate(scores.names)}
        self._predicting = [n for n in scores.names if scores.predicted is not None and n not in anchored]
        self._chosen, self._judged = scores.log_likelihood

    def _least_error(self, squares: PairSums | None, log_likelihood: PairSums) -> str:
        """Return the shipped filter of smallest mean square, or without squares that of highest likelihood."""
        numbers = self._numbers
        means = {
            name: -log_likelihood.mean(numbers[name]) if squares is None else squares.mean(numbers[name])
            for name in self.shipped
        }
        return min(means, key=lambda name: (math.isnan(means[name]), means[name]))

    def rival(self, operations: Callable[[str], float]) -> str:
        """Return the name of the shipped filter with which the fitted ones are compared.

        The default, unless the likeliest beats it beyond chance; then the cheapest that is ``AS_GOOD``.

        Args:
            operations: function from a competitor's name to the operations of its update.
        """
        chosen, default, numbers = self._chosen, self.default, self._numbers
        means = {name: chosen.mean(numbers[name]) for name in self.shipped}
        known = [name for name, mean in means.items() if not math.isnan(mean)]
        if not known:
            predicted = self.scores.predicted
            return self._least_error(None if predicted is None else predicted[0], chosen)
        likeliest = max(known, key=means.__getitem__)
        gains = {name: chosen.difference(numbers[likeliest], numbers[name]) for name in known}
        if default in known and not gains[default].low > 0.0:
            return default
        as_good = (name for name in known if gains[name].high < AS_GOOD or name == likeliest)
        return min(as_good, key=lambda name: (operations(name), -means[name]))

    def simplest(self, fitted: Sequence[JudgedFilter]) -> JudgedFilter:
        """Return the first, simplest fitted filter that the likeliest does not beat beyond chance."""
        likeliest = likeliest_of(fitted)
        as_good = (c for c in fitted if self.difference(likeliest.name, c.name).low <= 0.0)
        return next(as_good, likeliest)

    def is_worthwhile(self, fitted: JudgedFilter, rival: str, operations: Callable[[str], float]) -> bool:
        """Return whether a fitted filter gains beyond chance over the rival, or is cheaper and ``AS_GOOD``."""
        low = fitted.gain.low
        return low > 0.0 or (low > -AS_GOOD and operations(fitted.name) < operations(rival))

    def _judged_squares(self) -> PairSums | None:
        """Return the sums of judged squared errors, without truth those of prediction errors; None without
        either.
        """
        predicted = self.scores.predicted
        return self.scores.squared or (None if predicted is None else predicted[1])

    def best_shipped(self) -> str:
        """Return the name of the shipped filter of smallest judged error."""
        return self._least_error(self._judged_squares(), self._judged)

    def relative_error(self, name: str, other: str) -> IntervalEstimate:
        """Return the ratio of two filters' judged RMS errors, less one; without truth of their prediction
        errors.
        """
        squares, known = self._judged_squares(), self._numbers if self.scores.squared else self._predicting
        if squares is None or name not in known or other not in known:
            return UNKNOWN
        return squares.relative_root(self._numbers[name], self._numbers[other])

    def difference(self, name: str, other: str) -> IntervalEstimate:
        """Return the difference of two filters' mean log-likelihoods, less one nat in all per parameter."""
        found = self._chosen.difference(self._numbers[name], self._numbers[other])
        penalty = self._penalty(name) - self._penalty(other)
        return IntervalEstimate(*(value - penalty for value in found))

    def _penalty(self, name: str) -> float:
        """Return a filter's number of fitted parameters over the number of measurements of the choice, nats."""
        return self.parameters.get(name, 0) / self.scores.chosen_measurements

    def find_diverging(self, fits: Mapping[str, Fit]) -> tuple[str, ...]:
        """Return the fitted filters that lose the track when run over the whole recording; none where all do."""
        parts = self.scores.log_likelihood if self._share.apart else [self._chosen]
        totals = {name: [part.total(self._numbers[name]) for part in parts] for name in fits}
        sums = {name: sum(total for total, _ in each) for name, each in totals.items()}
        counts = {name: sum(count for _, count in each) for name, each in totals.items()}
        most = max(counts.values())
        diverging = [
            name
            for name, found in fits.items()
            if counts[name] < 0.99 * most
            or sums[name] / counts[name] < found.log_likelihood / found.measurements - LARGEST_LOSS
        ]
        return tuple(diverging) if len(diverging) < len(fits) else ()

    def competitor(self, name: str, rival: str) -> JudgedFilter:
        """Return a filter's results in choice and judgement, paired with a rival's."""
        scores, i, other = self.scores, self._numbers[name], self._numbers[rival]
        penalty, predicts = self._penalty(name), name in self._predicting
        gain = self._chosen.difference(i, other)
        return JudgedFilter(
            name,
            name in self.parameters,
            self.parameters.get(name, 0),
            self._chosen.mean(i) - penalty,
            IntervalEstimate(*(value - penalty for value in gain)),
            self._judged.difference(i, other),
            math.sqrt(scores.predicted[1].mean(i)) if predicts and scores.predicted else math.nan,
            math.sqrt(scores.squared.mean(i)) if scores.squared else math.nan,
            self.relative_error(name, rival),
            scores.nis(i),
            scores.correlation(i) if predicts else UNKNOWN,
            scores.correlations(i) if predicts else {},
        )


def likeliest_of(competitors: Sequence[JudgedFilter]) -> JudgedFilter:
    """Return the filter of largest log-likelihood; where none reports one, that of smallest error."""
    known = [c for c in competitors if not math.isnan(c.log_likelihood)]
    if not known:
        return min(competitors, key=lambda c: (math.isnan(c.error), c.error))
    return max(known, key=lambda c: c.log_likelihood)
