r"""Gaussian sums for semi-Markov switching: hypotheses by kind and age of a mode.

A Markov chain forgets how long its mode has lasted, so that dwell times are geometric. In a semi-Markov chain they
have any distribution f(d), d = 1, 2, ... steps, and a mode of age d ends with its **hazard**

    h(d) = f(d) / sum_{i >= d} f(i)                                                                            (1)

before the next step. Kind and age together are Markov again. The unknown part of a mode (an acceleration, a turn rate)
is constant while it lasts, so each hypothesis has a filter of its own, conditional on when its mode began; the filters
are not mixed. With p the probabilities after the last measurement, before the next

    p'(kind, d + 1) = (1 - h(d)) p(kind, d)                                                                    (2)
    e = sum_kinds sum_d h(d) p(kind, d)                                 modes that end                         (3)
    p'(kind, 1) = b(kind) (e + sum_d p(rest, d))                        modes that begin                       (4)
    p'(rest, 1) = (1 - b) e,  p'(rest, d + 1) = (1 - b) p(rest, d),  b = sum_kinds b(kind)                     (5)

where "rest" is what the target does between modes. The exact Gaussian sum grows without end; here all
hypotheses of one kind and age are one Gaussian with their mean and covariance, and the last age of a table
stands for all beyond it.

L. Campo, P. Mookerjee and Y. Bar-Shalom, State estimation for systems with sojourn-time-dependent Markov model
switching, IEEE Trans. Automatic Control 36 (1991), 238-243, with the merging of H. A. P. Blom and Y. Bar-Shalom, The
interacting multiple model algorithm, ibid. 33 (1988), 780-783.

Shapes: means ``(n, H, N)``, covariances ``(n, n, H, N)``, probabilities ``(H, N)``, H hypotheses by age.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from . import imm, packed_covariance
from .array_namespace import Array, namespace
from .ordered_sums import ordered_sum

LEAST_PROBABILITY = 1e-30
"""Least probability of a hypothesis, so that it can return and no weight is zero by zero."""


class AgedHypotheses(NamedTuple):
    """Estimates and probabilities of H hypotheses of one kind of mode, by the mode's age."""

    mean: Array
    """Means, ``(n, H, N)``."""
    covariance: Array
    """Covariances, ``(n, n, H, N)``."""
    probability: Array
    """Probabilities, ``(H, N)``."""

    def take(self, ages: slice, state: int | None = None) -> "AgedHypotheses":
        """Return the hypotheses of some ages, with the first ``state`` components of their states."""
        return AgedHypotheses(
            self.mean[:state, ages], self.covariance[:state, :state, ages], self.probability[ages]
        )

    def pack(self) -> "AgedHypotheses":
        """Return the hypotheses with packed covariances, ``(n (n + 1) / 2, H, N)``."""
        return self._replace(covariance=packed_covariance.pack(self.covariance))

    def unpack(self) -> "AgedHypotheses":
        """Return the hypotheses with full covariance matrices in place of packed ones."""
        return self._replace(covariance=packed_covariance.unpack(self.covariance, self.mean.shape[0]))


def hazards(durations: Sequence[float], ages: int) -> list[float]:
    """Return the hazards (1) of dwell times: the probability that a mode ends after each age.

    The last age stands for all beyond it: dwell times are geometric from there, with the same mean.

    Args:
        durations: relative probabilities f(1), f(2), ... of dwell times, more than ``ages``.
        ages: number of ages in the table.
    """
    exact = [durations[d] / sum(durations[d:]) for d in range(ages - 1)]
    rest = durations[ages - 1 :]
    return [*exact, sum(rest) / sum((d + 1) * f for d, f in enumerate(rest))]


def join(tables: Sequence[AgedHypotheses]) -> AgedHypotheses:
    """Concatenate tables of hypotheses whose states have the same size."""
    xp = namespace(tables[0].mean)
    return AgedHypotheses(
        xp.concat([table.mean for table in tables], axis=1),
        xp.concat([table.covariance for table in tables], axis=2),
        xp.concat([table.probability for table in tables]),
    )


def merge(hypotheses: AgedHypotheses) -> AgedHypotheses:
    """Merge hypotheses into one with their total probability, mean and covariance."""
    total = ordered_sum(hypotheses.probability)
    mean, covariance = imm.combine(hypotheses.mean, hypotheses.covariance, hypotheses.probability / total)
    return AgedHypotheses(mean[:, None], covariance[:, :, None], total[None])


def grow_older(table: AgedHypotheses, new: AgedHypotheses) -> AgedHypotheses:
    """Return the table a step later: ages increase by one, ``new`` is the first, and the last two are merged.

    Args:
        table: table before.
        new: new hypothesis of the first age.
    """
    if table.probability.shape[0] == 1:
        return merge(join([new, table]))
    return join([new, table.take(slice(None, -2)), merge(table.take(slice(-2, None)))])


class Mode(NamedTuple):
    """Hypotheses of one kind of mode, and the probabilities with which it begins and ends."""

    table: AgedHypotheses
    hazard: Array
    """Probability (1) of an end after each age, ``(H, 1)``."""
    begin: float
    """Probability (4) that a mode begins before a step."""
    augment: Callable[[Array, Array], tuple[Array, Array]]
    """Function from mean ``(4, N)`` and covariance of the state at rest to those of a mode that begins."""


def switch(rest: AgedHypotheses, modes: Sequence[Mode]) -> tuple[AgedHypotheses, list[AgedHypotheses]]:
    """Move hypotheses between rest and modes before a step, in which modes may begin and end, (2) to (5).

    Args:
        rest: hypotheses of the motion between modes.
        modes: kinds of modes; the first components of their states are those at rest.

    Returns:
        The tables of rest and of the modes, before the time update.
    """
    n = rest.mean.shape[0]
    rest, modes = _keep_possible(rest), [mode._replace(table=_keep_possible(mode.table)) for mode in modes]
    begin = sum(mode.begin for mode in modes)
    everything = slice(None)
    ended = merge(
        join(
            [
                mode.table._replace(probability=mode.hazard * mode.table.probability).take(everything, n)
                for mode in modes
            ]
        )
    )
    ready = merge(join([ended, rest]))
    tables = []
    for mode in modes:
        mean, covariance = mode.augment(ready.mean[:, 0], ready.covariance[:, :, 0])
        begun = AgedHypotheses(mean[:, None], covariance[:, :, None], mode.begin * ready.probability)
        lasting = mode.table._replace(probability=(1.0 - mode.hazard) * mode.table.probability)
        tables.append(grow_older(lasting, begun))
    older = grow_older(rest, ended)
    older = older._replace(probability=(1.0 - begin) * older.probability)
    return _keep_possible(older), [_keep_possible(table) for table in tables]


def _keep_possible(table: AgedHypotheses) -> AgedHypotheses:
    """Limit the probabilities of hypotheses from below to ``LEAST_PROBABILITY``."""
    probability = namespace(table.mean).clip(table.probability, LEAST_PROBABILITY, None)
    return table._replace(probability=probability)
