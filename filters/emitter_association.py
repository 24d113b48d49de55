r"""Association of ESM decisions with a target or a second emitter, for a target that is silent at times.

At a look a station hears the second emitter with probability q, otherwise the target if it radiates, otherwise nothing.
It decides that the heard emitter is of type rho, with the probabilities pi(rho | type), and measures its bearing: the
difference d to the target's is zero in the mean for the target, and delta for the second emitter, with variance
sigma^2. A target that radiates falls silent before a look with probability f, a silent one radiates again with
probability g. The type j of the target, that of the second emitter, delta, q, f and g are constant.

With r = 1 where the target radiates and v a point of a grid over (type i of the second emitter, delta, q, f, g), the
likelihood of a look is

    heard:    l(j, r, v) = q pi(rho | i) N(d; delta, sigma^2) + (1 - q) r pi(rho | j) N(d; 0, sigma^2)         (1)
    nothing:  l(j, r, v) = (1 - q) (1 - r)                                                                      (2)

and the table T(j, r, v) of the likelihood of all looks, which starts with the prior of r and v, goes on by

    T(j, 1, v) <- (1 - f) T(j, 1, v) + g T(j, 0, v),   T(j, 0, v) <- f T(j, 1, v) + (1 - g) T(j, 0, v)          (3)
    T(j, r, v) <- l(j, r, v) T(j, r, v)                                                                         (4)

the forward recursion of a hidden Markov model (L. R. Rabiner, A tutorial on hidden Markov models, Proc. IEEE
77 (1989), 257-286, section III.A), exact on the grid. The mixture (1) is that of probabilistic data
association (Bar-Shalom, Li and Kirubarajan, 2001, section 1.5) for one candidate of two sources.

Where types are drawn anew for every decision, pi(rho | class) takes the place of pi(rho | type): a label j is anything
that is constant and has decision probabilities.

Shapes: J labels, V points, batch N last; tables ``(J, 2, V, N)``, silent before radiating.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy

from .array_namespace import Array, namespace
from .class_fusion import bearing_difference

LEAST_DECISION = 1e-9
"""Least probability of a decision, also for those that the confusion matrix excludes."""
FARTHEST = 300.0
"""Largest exponent of a bearing's density; larger differences have the same density."""


class Surroundings(NamedTuple):
    """Grid of V points over the unknown second emitter and the target's silences; its probabilities are
    ``(V, 1)``.
    """

    other_type: Array
    """Index i of the second emitter's type, an integer, ``(V,)``."""
    separation: Array
    """delta, bearing of the second emitter minus the target's, in the unit of sigma."""
    second_emitter: Array
    """q, probability that the second emitter is heard at a look."""
    silence_start: Array
    """f, probability that a radiating target becomes silent before a look."""
    silence_end: Array
    """g, probability that a silent target radiates again."""
    weight: Array
    """Prior probability of the point, given the type of the second emitter."""


def surroundings(
    types: int,
    separation: tuple[float, float],
    sides: int,
    rates: Sequence[tuple[float, float, float, float]],
) -> Surroundings:
    """Make the grid over type and bearing of the second emitter and rates of silence, of NumPy arrays.

    Args:
        types: number of types that a second emitter may have.
        separation: limits of the size of delta, in the unit of sigma.
        sides: number of points of delta on either side, in the middles of equal parts.
        rates: ``(q, f, g, probability)`` of each; where q is zero there is one separation only.
    """
    low, high = separation
    middles = low + (high - low) * (numpy.arange(sides) + 0.5) / sides
    rows = []
    for q, f, g, probability in rates:
        if not q:
            # Of the second emitter nothing will be heard: its type stays as probable as it was.
            rows += [(i, 0.0, q, f, g, probability) for i in range(types)]
            continue
        share = probability / (2 * sides)
        rows += [
            (i, side * middle, q, f, g, share)
            for i in range(types)
            for side in (-1.0, 1.0)
            for middle in middles
        ]
    columns = numpy.array(rows).T
    return Surroundings(columns[0].astype(int), *(column[:, None] for column in columns[1:]))


def start_table(grid: Surroundings, labels: int) -> Array:
    """Return the table of likelihoods before the first look, ``(J, 2, V, 1)``, with silence in its stationary
    state.

    Args:
        grid: grid of NumPy arrays.
        labels: number J of labels.
    """
    balance = grid.silence_end / (grid.silence_start + grid.silence_end)
    return numpy.stack([numpy.stack([grid.weight * (1.0 - balance), grid.weight * balance])] * labels)


def predict_silence(table: Array, grid: Surroundings, is_looking: Array) -> Array:
    """Return the table of likelihoods ``(J, 2, V, N)`` after silence may have started or ended, equation (3).

    Args:
        table: table of likelihoods, ``(J, 2, V, N)``.
        grid: grid of the table.
        is_looking: mask of episodes in which the station looks, ``(N,)`` booleans.
    """
    xp = namespace(table)
    off = xp.where(is_looking, grid.silence_start, 0.0) * table[:, 1]
    on = xp.where(is_looking, grid.silence_end, 0.0) * table[:, 0]
    change = on - off
    return xp.stack([table[:, 0] - change, table[:, 1] + change], axis=1)


class Look(NamedTuple):
    """Report of the ESM station at one scan."""

    looked: Array
    """Mask of episodes in which the station looks, ``(N,)`` booleans."""
    decision: Array
    """Decision rho, or K if nothing is heard, ``(N,)``."""
    difference: Array
    """Target's bearing minus the measured one, degrees, ``(N,)``; any number if nothing is heard."""


def look_likelihood(
    grid: Surroundings, confusion: Array, other_confusion: Array, look: Look, deviation: float
) -> Array:
    """Return the likelihood (1), (2) of a look for each label, silence and grid point, ``(J, 2, V, N)``.

    Relative to the density of a bearing at its mean; one without a look.

    Args:
        grid: grid of V points.
        confusion: pi(rho | label), ``(J, K)``, K decisions.
        other_confusion: pi(rho | type) of the second emitter, ``(I, K)``.
        look: report of the scan.
        deviation: sigma, standard deviation of a bearing, degrees.
    """
    looked, decision, difference = look
    xp, decisions = namespace(difference), confusion.shape[1]
    heard = decision < decisions
    apart = xp.where(heard, difference, 0.0)
    index = xp.where(heard, decision, 0)

    def density(offset: Array) -> Array:
        scaled = bearing_difference(offset, 0.0) / deviation
        return xp.exp(-xp.clip(0.5 * scaled * scaled, None, FARTHEST))

    # One number for each distinct point: grids hold few separations.
    target = xp.take(xp.clip(confusion, LEAST_DECISION, None), index, axis=1) * density(apart)
    kinds = xp.take(xp.clip(other_confusion, LEAST_DECISION, None), index, axis=1)
    other = grid.second_emitter * kinds[grid.other_type] * density(apart + grid.separation)
    unheard = 1.0 - grid.second_emitter
    none = 0.0 * apart
    silent = xp.where(looked, xp.where(heard, other, unheard), 1.0 + none)
    radiates = [
        xp.where(looked, xp.where(heard, other + unheard * target[j], none), 1.0 + none)
        for j in range(target.shape[0])
    ]
    return xp.stack([xp.stack([silent, radiating]) for radiating in radiates])
