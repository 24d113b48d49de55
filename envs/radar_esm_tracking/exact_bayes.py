r"""Bayes' rule over class, change of class, emitter types, silences and a second emitter of RadarEsmTracking.

A hypothesis is a class and its onset: the start, one of B onsets, or an older one. Each has its own Kalman
filter, updated with the class's model. The forward recursion of :mod:`~filtergym.filters.emitter_association` weights
the ESM decisions. With s the class, o the onset, j the type and e the unknowns of the second emitter and of the
target's silences,

    P(s, j, e)     = v(s) P(j | s) P(i(e) | s) T0(j, e)      for targets whose class has not changed            (1)
    P(s, o, j, e)  = w(s, o, j) T1(j, e)                     for targets whose class has changed               (2)

where T0 is the likelihood of all decisions, v and w contain that of the radar, and T1 sums to one over e. (1) is exact
on the grid of e: as long as no class changes, this is Bayes' rule. (2) assumes that, given the present type, the time
of the change is independent of the second emitter and the silences. Further approximations:

* Classes change at one scan of every ``spacing`` (the scans at which the ESM looks). An onset older than B of these is
  merged, by its moments, with all older ones of its class.
* At a change the filters of the previous classes are merged to one Gaussian with their mean and covariance.
* Rates of silence, and the share of looks at which the ESM receives the second emitter, lie on a few points each; its
  bearing on a few points on either side.
* The radar's coloured errors have one strength and one correlation time for all targets.
* Each filter weights outliers separately, if the prior has any.

The control ``hypotheses`` steers this estimator, ``exact-bayes``, by factors f at each scan. Before the radar update,

    P(s, h) <- P(s, h) f(s) f4^changed(h),    T(j, e) <- T(j, e) f5^disturbed(e)    normalised again by Bayes' rule
    Q <- f6 Q,    R <- f7 R

with one factor for each of the three classes; changed: the class has changed since the start; disturbed: there is a
second emitter; Q: process noise of the motion and of the coloured errors; R: white noise of the radar.
"""

import itertools
import math
from typing import Any, NamedTuple

import numpy

from ...filters import class_fusion, contaminated_normal, imm, kalman, packed_covariance
from ...filters import emitter_association as emitters
from ...filters.ordered_sums import ordered_sum
from ...filters.semi_markov import LEAST_PROBABILITY
from ...filters.small_matrices import mirror_lower
from ..contract.controls import SteerableFilter
from ..contract.filter import FilterInput, Likelihood
from ..contract.observation import Array
from .problem import RadarEsmProblem
from .world import Measurement, Start

SMALLEST_PROBABILITY = 1e-200
"""Smallest probability before the normalisation: otherwise an outlier of many sigma would set several hypotheses to
zero, and their ratios would be lost."""


class ClassPrior(NamedTuple):
    """Prior of the estimator :class:`ExactBayes`: classes, silences and second emitters; times in s."""

    change_rate: float = 0.0077
    """Expected number of changes of class per second."""
    change: tuple[float, float] = (5.0, 55.0)
    """Limits of the time at which the class may change, s."""
    again: bool = False
    """Whether the class may change more than once."""
    onsets: int = 2
    """B, the number of onsets with their own hypothesis."""
    redrawn: float = 0.0
    """Probability that the type is drawn anew for every decision."""
    second_emitter: tuple[float, ...] = (0.127, 0.473)
    """Shares of the looks at which a second emitter is received, all equally probable."""
    silence_start: tuple[float, ...] = (0.25,)
    """Probabilities at a look that the target falls silent, all equally probable."""
    silence_end: tuple[float, ...] = (0.525,)
    """Probabilities at a look that a silent target radiates again, all equally probable."""
    separation: tuple[float, float] = (2.0, 20.0)
    """Limits of the second emitter's distance in bearing, degrees, to either side."""
    sides: int = 3
    """Grid points of the separation on either side."""
    calm: float = 1.0 / 6.0
    """Probability of a target without change of class and second emitter."""
    outliers: float = 0.0
    """Probability of an outlier of the radar."""
    outlier_factor: float = 5.0
    """Standard deviation of an outlier over that of other errors."""
    coloured: float = 0.3
    """Standard deviation of the radar's coloured errors over that of the white ones; zero: not modelled."""
    correlation_time: float = 6.0
    """Correlation time of these errors, s."""


TRAINING = ClassPrior()
"""Prior of the scenario ``random``: a change between 5 and 55 s in a third of the disturbed episodes; the second
emitter's share is uniform from 0 to 0.6, with the two points of Gauss and Legendre; rates of silence at their means.
Four points of the share, four of the rates, eight onsets and a fourth point of the bearing change the cost by less than
0.03 %."""
FEW = TRAINING._replace(onsets=1, second_emitter=(0.3,), sides=1)
"""Prior with little computing time: one onset, the mean share of the second emitter and one distance on either side."""
VAGUE = ClassPrior(
    change_rate=0.004,
    change=(0.0, math.inf),
    again=True,
    redrawn=0.2,
    second_emitter=(0.0, 0.127, 0.473),
    silence_end=(0.4,),
    calm=0.3,
    outliers=0.02,
    coloured=0.2,
)
"""Prior for targets of which little is known (ours): the class may change at any time and repeatedly, types may be
drawn anew, and radar measurements may be outliers."""


class ClassTracks(NamedTuple):
    """Hypotheses of S classes with M = B + 2 onsets each (unchanged, B onsets, older), and J emitter types."""

    mean: Array
    """Means, ``(3, S, M, N)``."""
    covariance: Array
    """Packed covariances, ``(6, S, M, N)``."""
    weights: Array
    """Probabilities of the hypotheses, ``(S, M, N)``."""
    unchanged: Array
    """v of equation (1), ``(S, N)``."""
    changed: Array
    """w of equation (2), ``(S, M - 1, J, N)``."""
    first: Array
    """T0 of equation (1), ``(J, 2, V, N)``."""
    later: Array
    """T1 of equation (2), ``(J, 2, V, N)``."""


class ClassState(NamedTuple):
    """State of the estimator ``exact-bayes``: estimate, hypotheses of class and onset, likelihood."""

    mean: Array
    """Mean of all hypotheses together, ``(3, N)``."""
    covariance: Array
    """Covariance of all hypotheses together, ``(3, 3, N)``."""
    tracks: ClassTracks
    likelihood: Likelihood


class ExactBayes(SteerableFilter[RadarEsmProblem, Measurement, ClassState]):
    """Estimator ``exact-bayes``: Bayes' rule over classes of target, their changes, and emitters.

    Args:
        changed: fields of the prior with other values.
    """

    def __init__(self, task: RadarEsmProblem, prior: ClassPrior = TRAINING, **changed: Any) -> None:
        super().__init__(task)
        prior = prior._replace(**changed)
        self.prior = prior
        p = task.parameters
        self.classes: int = task.classes
        self.settings = dict.fromkeys(p.class_names, 1.15) | {
            "changed": 1.3, "second_emitter": 2.0, "process": 2.0, "radar": 1.35
        }  # fmt: skip
        self.spacing: int = p.esm_period
        models, start = task.design_models(p)
        decay = math.exp(-p.sampling_interval / prior.correlation_time)
        if prior.coloured:
            models, start = class_fusion.add_coloured_errors(models, start, prior.coloured**2, decay)
        self.states: int = start.shape[0]
        self.F, self.Q, self.start_covariance = (
            task.constant(matrix)[..., None, None] for matrix in (models.Phi, models.Q, start)
        )
        self.variance: Array = task.constant([p.range_sigma**2, p.range_rate_sigma**2])[:, None, None, None]
        self.deviation: float = math.hypot(p.radar_bearing_sigma, p.esm_bearing_sigma)
        recognition, composition = numpy.array(p.recognition), numpy.array(p.composition)
        redrawn = class_fusion.decision_probabilities(recognition, composition)
        # Labels of the target: its type, or the class if types are drawn anew.
        labels = numpy.concatenate(
            [(1.0 - prior.redrawn) * composition, prior.redrawn * numpy.eye(self.classes)], axis=1
        )
        used = numpy.asarray(labels.sum(axis=0) > 0.0, dtype=bool)
        self.labels: numpy.ndarray = labels[:, used]
        self.confusion: Array = task.constant(numpy.concatenate([recognition, redrawn])[used])
        self.other_confusion: Array = task.constant(recognition)
        others = (1.0 - numpy.eye(self.classes)) / (self.classes - 1)
        self.others: numpy.ndarray = others @ composition
        """Probability of a second emitter's type by class of the target, ``(S, I)``."""
        self.prior_of_class: Array = task.constant(p.prior)[:, None]
        q, f, g = prior.second_emitter, prior.silence_start, prior.silence_end
        share = (1.0 - prior.calm) / (len(q) * len(f) * len(g))
        rates = [(*point, share) for point in itertools.product(q, f, g)]
        silences = list(itertools.product(f, g)) if prior.calm else []
        rates += [(0.0, *point, prior.calm / len(silences)) for point in silences]
        grid = emitters.surroundings(task.types, prior.separation, prior.sides, rates)
        self.start_table: Array = task.constant(emitters.start_table(grid, int(used.sum())))
        disturbed = numpy.ones_like(grid.weight, dtype=bool)
        disturbed[len(disturbed) - len(silences) * task.types :] = False
        self.disturbed: Array = task.constant(disturbed.astype(float))
        self.by_type = [numpy.flatnonzero(grid.other_type == i).tolist() for i in range(task.types)]
        self.disturbed_by_type = [[v for v in points if disturbed[v, 0]] for points in self.by_type]
        self.grid = emitters.Surroundings(grid.other_type, *(task.constant(part) for part in grid[1:]))

    def start(self, initial: Start) -> ClassState:
        """Return the state started on the first radar measurement, with classes weighted by the first ESM look."""
        unknown = Likelihood.unknown(initial.mean[0])
        return ClassState(initial.mean, initial.covariance, self.start_tracks(initial), unknown)

    def start_tracks(self, initial: Start) -> ClassTracks:
        """Return the hypotheses of class and onset at the start, with T0 of the first ESM look."""
        xp, p, M = self.xp, self.prior, self.prior.onsets + 2
        none = 0.0 * initial.mean[0]
        state = xp.concat([initial.mean, xp.zeros((self.states - 3, 1)) + none])
        mean = state[:, None, None] + xp.zeros((1, self.classes, M, 1))
        covariance = self.start_covariance + xp.zeros((1, 1, 1, M, 1)) + none
        table = self.start_table + none
        nothing = xp.zeros((self.classes, p.onsets + 1, table.shape[0], 1)) + LEAST_PROBABILITY + none
        return self.normalise(
            mean,
            packed_covariance.pack(covariance),
            self.prior_of_class + none,
            nothing,
            table * self.look_likelihood(initial.first),
            table,
        )

    def look_likelihood(self, measurement: Measurement) -> Array:
        """Return the likelihood of this scan's ESM look for types and emitter hypotheses, ``(J, 2, V, N)``."""
        look = emitters.Look(measurement.looked, measurement.decision, measurement.bearing_difference)
        return emitters.look_likelihood(self.grid, self.confusion, self.other_confusion, look, self.deviation)

    def class_likelihoods(self, table: Array, points: list[list[int]]) -> Array:
        """Return sums over j and e of P(j | s) P(i | s) T0(j, e), ``(S, N)``, over given grid points of each type."""
        both = table[:, 0] + table[:, 1]
        sums = [ordered_sum(both[:, v] for v in some) for some in points if some]
        types = [i for i, some in enumerate(points) if some]
        return self.xp.stack(
            [
                ordered_sum(
                    self.labels[s, j]
                    * ordered_sum(self.others[s, i] * part[j] for i, part in zip(types, sums, strict=True))
                    for j in range(table.shape[0])
                )
                for s in range(self.classes)
            ]
        )  # fmt: skip

    def normalise(
        self, mean: Array, covariance: Array, unchanged: Array, changed: Array, first: Array, later: Array
    ) -> ClassTracks:
        """Return the hypotheses with class probabilities weighted by T0, and T0, T1 and these normalised to one."""
        xp = self.xp
        total = ordered_sum(ordered_sum(ordered_sum(first)))
        first, unchanged = first / total, unchanged * total
        sums = [ordered_sum(ordered_sum(part)) for part in later]
        later = xp.stack([part / total for part, total in zip(later, sums, strict=True)])
        weights = xp.concat(
            [
                (unchanged * self.class_likelihoods(first, self.by_type))[:, None],
                ordered_sum(changed[:, :, j] for j in range(changed.shape[2])),
            ],
            axis=1,
        )
        total = ordered_sum(ordered_sum(weights))
        return ClassTracks(
            mean,
            covariance,
            weights / total,
            xp.clip(unchanged / total, LEAST_PROBABILITY, None),
            xp.clip(changed / total, LEAST_PROBABILITY, None),
            first,
            later,
        )

    def apply_factors(self, memory: ClassTracks, logarithms: Array) -> ClassTracks:
        """Return the hypotheses with probabilities of classes, changes and second emitter times ``exp(logarithms)``."""
        xp, S = self.xp, self.classes
        classes, changed = xp.exp(logarithms[:S]), xp.exp(logarithms[S])
        second_emitter = xp.exp(self.disturbed * logarithms[S + 1])
        return memory._replace(
            weights=xp.concat(
                [
                    classes[:, None] * memory.weights[:, :1],
                    classes[:, None] * changed * memory.weights[:, 1:],
                ],
                axis=1,
            ),
            unchanged=classes * memory.unchanged,
            changed=classes[:, None, None] * changed * memory.changed,
            first=second_emitter * memory.first,
            later=second_emitter * memory.later,
        )

    def predict_motion(self, memory: ClassTracks, process: Array = 1.0) -> tuple[Array, Array]:
        """Return the means and covariances of all hypotheses predicted to the next scan.

        Returns:
            Means ``(n, S, M, N)`` and covariances ``(n, n, S, M, N)``.
        """
        P = packed_covariance.unpack(memory.covariance, self.states)
        return kalman.predict(memory.mean, P, self.F, process * self.Q)

    def update(self, state: ClassState, inputs: FilterInput) -> ClassState:
        """Return the state updated with a scan: motion and radar, change of class, then ESM.

        Its likelihood is that of the radar measurement.
        """
        xp, prior, memory, measurement = self.xp, self.prior, state.tracks, inputs.measurement
        process, variance = 1.0, self.variance
        if inputs.action is not None:
            memory = self.apply_factors(memory, inputs.action)
            process, factor = xp.exp(inputs.action[-2:])
            variance = factor * variance
        mean, P = self.predict_motion(memory, process)
        radar = contaminated_normal.update_position(
            mean,
            P,
            measurement.radar[:, None, None],
            variance,
            prior.outliers,
            prior.outlier_factor,
        )
        flat = xp.reshape(radar.log_likelihood, (-1, radar.log_likelihood.shape[-1]))
        top = xp.max(flat, axis=0)
        factor = xp.exp(radar.log_likelihood - top)
        weights = factor * memory.weights
        seen = ordered_sum(ordered_sum(weights))
        nis = ordered_sum(ordered_sum(weights * radar.squared_distance)) / seen
        likelihood = Likelihood(top + xp.log(seen), nis, 2.0 + 0.0 * nis)

        moved = memory._replace(
            mean=radar.mean,
            covariance=packed_covariance.pack(radar.covariance),
            weights=weights / seen,
            unchanged=xp.clip(memory.unchanged * factor[:, 0] / seen, SMALLEST_PROBABILITY, None),
            changed=xp.clip(memory.changed * (factor[:, 1:] / seen)[:, :, None], SMALLEST_PROBABILITY, None),
        )
        moved = self.change_class(moved, measurement.scan)
        looked = measurement.looked
        first, later = (
            emitters.predict_silence(table, self.grid, looked) for table in (moved.first, moved.later)
        )
        look = self.look_likelihood(measurement)
        first, later = first * look, later * look
        marginal = xp.stack([ordered_sum(ordered_sum(part)) for part in later])
        memory = self.normalise(
            moved.mean, moved.covariance, moved.unchanged, moved.changed * marginal, first, later
        )
        n, size = self.states, self.classes * (prior.onsets + 2)
        P = packed_covariance.unpack(memory.covariance, n)
        estimate, covariance = imm.combine(
            xp.reshape(memory.mean, (n, size, -1)),
            xp.reshape(P, (n, n, size, -1)),
            xp.reshape(memory.weights, (size, -1)),
        )
        if self.prior.coloured:
            estimate, covariance = class_fusion.remove_coloured_errors(estimate, covariance)
        return ClassState(estimate, mirror_lower(covariance), memory, likelihood)

    def change_class(self, m: ClassTracks, scan: Array) -> ClassTracks:
        """Return the hypotheses after a possible change of class, at one scan of every ``spacing``."""
        xp, prior, B, others = self.xp, self.prior, self.prior.onsets, self.classes - 1
        p, S, n = self.parameters, range(self.classes), self.states
        seconds = p.sampling_interval * scan
        may = (scan % self.spacing == 0) & (seconds >= prior.change[0]) & (seconds <= prior.change[1])
        hazard = xp.where(may, 1.0 - math.exp(-prior.change_rate * self.spacing * p.sampling_interval), 0.0)
        again = hazard if prior.again else 0.0 * hazard

        # The share that leaves each class, and its filter.
        leaving = hazard * m.unchanged * self.class_likelihoods(m.first, self.disturbed_by_type)
        states, P = m.mean[:, :, 0], packed_covariance.unpack(m.covariance, self.states)
        spreads = P[:, :, :, 0]
        if prior.again:
            parts = xp.concat(
                [leaving[:, None], xp.stack([hazard * m.weights[:, 1 + b] for b in range(B + 1)], axis=1)],
                axis=1,
            )
            leaving = ordered_sum(parts[:, b] for b in range(B + 2))
            shares = parts / xp.clip(leaving, LEAST_PROBABILITY, None)[:, None]
            states, spreads = imm.combine(
                xp.moveaxis(m.mean, 2, 1), xp.moveaxis(P, 3, 2), xp.moveaxis(shares, 1, 0)
            )
        born, means, covariances = [], [], []
        for s in S:
            before = [r for r in S if r != s]
            parts = xp.stack([leaving[r] / others for r in before])
            total = ordered_sum(parts)
            share = (parts + LEAST_PROBABILITY) / (total + others * LEAST_PROBABILITY)
            mean, covariance = imm.combine(
                xp.stack([states[:, r] for r in before], axis=1),
                xp.stack([spreads[:, :, r] for r in before], axis=2),
                share,
            )
            born.append(total)
            means.append(mean)
            covariances.append(covariance)
        begun = xp.stack(born)
        labels = xp.stack([xp.stack([number * b for number in self.labels[s]]) for s, b in enumerate(born)])
        state = xp.concat(
            [
                xp.stack(means, axis=1),
                packed_covariance.pack(xp.stack(covariances, axis=2)),
            ]
        )

        # The oldest onset joins the older ones, and the new one takes its place.
        everything = xp.concat([m.mean, m.covariance])
        number = scan // self.spacing
        chosen = [may & (number % B == b) for b in range(B)]
        oldest = ordered_sum(xp.where(chosen[b], everything[:, :, 1 + b], 0.0) for b in range(B))
        ending = ordered_sum(xp.where(chosen[b], m.changed[:, b], 0.0) for b in range(B))
        older = m.changed[:, B]
        parts = xp.stack([ordered_sum(x[:, j] for j in range(x.shape[1])) for x in (older, ending)])
        kept = everything[:, :, B + 1]
        mean, covariance = imm.combine(
            xp.stack([kept[:n], oldest[:n]], axis=1),
            xp.stack([packed_covariance.unpack(x[n:], n) for x in (kept, oldest)], axis=2),
            parts / ordered_sum(parts),
        )
        merged = xp.concat([mean, packed_covariance.pack(covariance)])
        slots = [xp.where(chosen[b], state, everything[:, :, 1 + b]) for b in range(B)]
        everything = xp.stack([everything[:, :, 0], *slots, merged], axis=2)
        stay = 1.0 - again
        kept_weights = [xp.where(chosen[b], labels, stay * m.changed[:, b]) for b in range(B)]
        changed = xp.stack([*kept_weights, stay * (older + ending)], axis=1)

        first, later = self.change_tables(m, hazard, again, begun)
        return ClassTracks(everything[:n], everything[n:], m.weights, m.unchanged, changed, first, later)

    def change_tables(self, m: ClassTracks, hazard: Array, again: Array, born: Array) -> tuple[Array, Array]:
        """Return T0 without, and T1 with, the probability of targets whose class changes now."""
        xp, J, grid = self.xp, m.first.shape[0], self.grid
        classes, types = range(self.classes), self.others.shape[1]
        joint = [
            xp.stack(
                [
                    ordered_sum(self.labels[s, j] * self.others[s, i] * m.unchanged[s] for s in classes)
                    for i in range(types)
                ]
            )[grid.other_type]
            for j in range(J)
        ]
        leaving = hazard * self.disturbed
        came = ordered_sum(joint[j] * leaving * m.first[j] for j in range(J))
        weights = [
            ordered_sum(ordered_sum(m.changed[:, b, j]) for b in range(m.changed.shape[1])) for j in range(J)
        ]
        if self.prior.again:
            came = came + again * ordered_sum(weights[j] * m.later[j] for j in range(J))
        came = came / xp.clip(ordered_sum(ordered_sum(came)), LEAST_PROBABILITY, None)
        later = []
        for j in range(J):
            begun = ordered_sum(self.labels[s, j] * born[s] for s in classes)
            stay = (1.0 - again) * weights[j]
            later.append((stay * m.later[j] + begun * came) / (stay + begun))
        return (1.0 - leaving) * m.first, xp.stack(later)
