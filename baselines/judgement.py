"""What competitors did on the parts of a recording that chose among them and that judge them.

A recording is cut into blocks: what filters are fitted to, chosen on and judged on.
"""

import itertools
import math
from collections.abc import Callable, Container, Mapping, Sequence
from typing import NamedTuple

import numpy

from ..envs.data.recording import Recording
from ..evaluation.competitors.likelihood import Span
from ..evaluation.statistics.bootstrap import IntervalEstimate
from ..evaluation.statistics.predictions import UNKNOWN, Predictions, correlation, mean_of, relative_error
from .fitting import Fit

LEAST = 5
"""Measurements after the start of the track that anything can be fitted to."""
FEWEST = 40
"""Measurements of a recording from which on it is cut into blocks; of fewer everything is fitted to all of it."""
LARGEST_LOSS = 0.5
"""Nats per measurement by which a fit may be worse over the whole recording than in its windows, which begin anew:
what loses more has lost the track."""
AS_GOOD = 0.1
"""Nats per measurement that a cheaper filter may lose, at the end of the interval: innovations of the plane are then
5 % larger. That a difference may be chance is not enough: on a short log all differences may."""
BLOCK_MEASUREMENTS = 40
MOST_BLOCKS = 24
LONGEST_WARM_UP = 20


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


class JudgedFilter(NamedTuple):
    """One line of the table of an advice."""

    name: str
    fitted: bool
    """Whether its parameters were fitted to this recording."""
    parameters: int
    """How many were."""
    log_likelihood: float
    """Mean of the measurements that chose, less one nat in all for each fitted parameter, nats; NaN where it says
    none."""
    gain: IntervalEstimate
    """The same less that of the rival, paired."""
    difference: IntervalEstimate
    """Judged log-likelihood per measurement less that of the rival, nats."""
    prediction: float
    """Root mean square of the judged prediction errors; NaN where the log format has no prediction."""
    error: float
    """Root mean square of the judged errors of the main components; NaN without truth."""
    relative_error: IntervalEstimate
    """Judged error over that of the rival, less one; without truth of the prediction errors."""
    nis: float
    """Mean normalised innovation squared of judged measurements over its dimension."""
    correlation: IntervalEstimate
    """Of successive judged prediction errors; zero where they are white."""
    correlations: Mapping[str, IntervalEstimate]
    """Likewise of each number that is measured, by its name; empty where all are of one kind."""


class Judgement:
    """What all competitors did on the measurements that chose and on those that judge.

    Args:
        predictions: of all.
        share: which measurements they are.
        parameters: how many were fitted, by the name of who was fitted; all others are shipped.
        default: shipped filter that stands unless another is likelier beyond chance; empty: none.
        anchored: names of filters with a second sensor, of which an estimate alone does not say what they predict.
    """

    def __init__(
        self,
        predictions: Predictions,
        share: Share,
        parameters: Mapping[str, int],
        default: str,
        anchored: Container[str] = (),
    ) -> None:
        self.predictions, self.parameters, self.default = predictions, parameters, default
        choosing = [*share.fitted, *share.chosen] if share.apart else share.chosen
        self.chosen, self.judged = (self._mask(spans) for spans in (choosing, share.judged))
        self.shipped = [name for name in predictions.names if name not in parameters]
        alone = [name for name in predictions.names if name not in anchored]
        errors = {name: predictions.prediction_error(name) for name in alone}
        self._errors = {name: each for name, each in errors.items() if each is not None}
        self._predicted = {name: (each**2).sum(axis=0) for name, each in self._errors.items()}
        names = predictions.names if predictions.has_truth else []
        self._squares = {name: predictions.squared_error(name) for name in names}

    def _mask(self, spans: Sequence[Span]) -> numpy.ndarray:
        """Measurements, ``(episodes, time)``."""
        mask = numpy.zeros(self.predictions.shape, dtype=bool)
        for span in spans:
            mask[span.episode, span.first : span.last] = True
        return mask

    def _least(self, squares: Mapping[str, numpy.ndarray], mask: numpy.ndarray) -> str:
        """Shipped filter of smallest mean square; by log-likelihood where there are no squares."""
        found = self.predictions
        means = {
            name: mean_of(squares[name] if squares else -found.log_likelihood(name), mask)
            for name in self.shipped
        }
        return min(means, key=lambda name: (math.isnan(means[name]), means[name]))

    def rival(self, operations: Callable[[str], float]) -> str:
        """Shipped filter that one would take by the measurements that chose: the default where the likeliest does not
        beat it beyond chance, else the cheapest that is ``AS_GOOD`` as the likeliest.

        Args:
            operations: of an update of a competitor.
        """
        found, default = self.predictions, self.default
        means = {name: mean_of(found.log_likelihood(name), self.chosen) for name in self.shipped}
        known = [name for name, mean in means.items() if not math.isnan(mean)]
        if not known:
            return self._least(self._predicted, self.chosen)
        likeliest = max(known, key=means.__getitem__)
        gains = {name: found.difference(likeliest, name, self.chosen) for name in known}
        if default in known and not gains[default].low > 0.0:
            return default
        as_good = (name for name in known if gains[name].high < AS_GOOD or name == likeliest)
        return min(as_good, key=lambda name: (operations(name), -means[name]))

    def simplest(self, fitted: Sequence[JudgedFilter]) -> JudgedFilter:
        """Return the first of the fitted ones that the likeliest of them does not beat beyond chance: the simplest come
        first.
        """
        likeliest = likeliest_of(fitted)
        as_good = (c for c in fitted if self.difference(likeliest.name, c.name).low <= 0.0)
        return next(as_good, likeliest)

    def is_worth(self, fitted: JudgedFilter, rival: str, operations: Callable[[str], float]) -> bool:
        """Whether a fitted filter gains beyond chance over the rival, or is cheaper and ``AS_GOOD``."""
        low = fitted.gain.low
        return low > 0.0 or (low > -AS_GOOD and operations(fitted.name) < operations(rival))

    def best_shipped(self) -> str:
        """Shipped filter that is best on the measurements that judge."""
        return self._least(self._squares or self._predicted, self.judged)

    def relative_error(self, name: str, other: str) -> IntervalEstimate:
        """Judged error over that of another, less one; without truth of the prediction errors."""
        squares = self._squares or self._predicted
        known = name in squares and other in squares
        return relative_error(squares[name], squares[other], self.judged) if known else UNKNOWN

    def difference(self, name: str, other: str) -> IntervalEstimate:
        """Chosen log-likelihood of a filter less that of another, their fitted parameters paid for, nats."""
        found = self.predictions.difference(name, other, self.chosen)
        penalty = (self.parameters.get(name, 0) - self.parameters.get(other, 0)) / self.chosen.sum()
        return IntervalEstimate(*(value - penalty for value in found))

    def find_diverging(self, fits: Mapping[str, Fit]) -> tuple[str, ...]:
        """Return who loses the track in the whole recording; nobody where all do.

        Args:
            fits: what their likelihood is in windows.
        """
        found = self.predictions
        values = {name: found.log_likelihood(name)[self.chosen | self.judged] for name in fits}
        most = max(int(numpy.isfinite(each).sum()) for each in values.values())
        diverging = [
            name
            for name, each in values.items()
            if (there := numpy.isfinite(each)).sum() < 0.99 * most
            or each[there].mean() < fits[name].log_likelihood / fits[name].measurements - LARGEST_LOSS
        ]
        return tuple(diverging) if len(diverging) < len(fits) else ()

    def competitor(self, name: str, rival: str) -> JudgedFilter:
        """Judge somebody, paired with another."""
        found, judged = self.predictions, self.judged
        penalty = self.parameters.get(name, 0) / self.chosen.sum()
        gain = found.difference(name, rival, self.chosen)
        return JudgedFilter(
            name,
            name in self.parameters,
            self.parameters.get(name, 0),
            mean_of(found.log_likelihood(name), self.chosen) - penalty,
            IntervalEstimate(*(value - penalty for value in gain)),
            found.difference(name, rival, judged),
            math.sqrt(mean_of(self._predicted[name], judged)) if name in self._predicted else math.nan,
            math.sqrt(mean_of(self._squares[name], judged)) if self._squares else math.nan,
            self.relative_error(name, rival),
            found.nis(name, judged),
            correlation(self._errors[name], judged) if name in self._errors else UNKNOWN,
            found.correlations(name, judged) if name in self._errors else {},
        )


def likeliest_of(competitors: Sequence[JudgedFilter]) -> JudgedFilter:
    """The one of largest log-likelihood; where nobody says any, the one of smallest error."""
    known = [c for c in competitors if not math.isnan(c.log_likelihood)]
    if not known:
        return min(competitors, key=lambda c: (math.isnan(c.error), c.error))
    return max(known, key=lambda c: c.log_likelihood)
