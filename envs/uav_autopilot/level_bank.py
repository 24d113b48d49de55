"""A bank of Kalman filters over the levels of gusts and sensors of UavAutopilot.

Equations: ``filters/noise_levels.py``. A kind of aircraft is an actuator and a slow error of some sensors, which is a
coordinate of the state, a first-order Gauss-Markov process (A. E. Bryson and L. J. Henrikson, Journal of Spacecraft and
Rockets 5 (1968), 662-665, by augmentation). In each kind every hypothesis is a level of the gusts, with its
own probabilities of the sensors' levels. The first hypothesis of a kind assumes all noise as designed, and ends with a
small hazard. Kinds do not change.

The control ``hypotheses`` steers this estimator, ``level-bank``, by factors f of its settings. H hypotheses predict to
the measurement with weights p' and covariances P'. The factors apply to the update with the readings of m sensors at
this measurement only:

    p'(h) <- p'(h) f1^s(h) f2^designed(h)                                                   renormalised by Bayes' rule
    P'(h) <- P'(h) + (f3 - 1) Q(h),    R_k <- R_k f(3 + k)

s(h): log-distance of the hypothesis' level of the gusts above the designed one, scaled to one for the highest;
designed: 1 if all noise is as designed, otherwise 0. So f1 makes a rise of the gusts more probable and f2 noise as
designed, like other probabilities of a change. Q is the process noise of the hypothesis, so that the prediction uses
``f3 Q``; R_k are the variances of sensor k at all its levels. Without any reading nothing changes.
"""

import math
from typing import Any, NamedTuple

import numpy

from ...filters import imm, noise_levels, packed_covariance
from ...filters.noise_levels import LevelHypotheses
from ...filters.ordered_sums import ordered_sum, weighted_sum
from ..contract.controls import SteerableFilter
from ..contract.filter import FilterInput, Initial, Likelihood
from ..contract.observation import Array
from .plant import Plant, pitch_channel
from .problem import AutopilotProblem
from .world import Measurement, Start


class Kind(NamedTuple):
    """A kind of aircraft: actuator and slow sensor errors, which do not change in an episode."""

    share: float = 1.0
    """Prior probability."""
    lag: float = 1.0
    """Ratio of the actuator's time constant to that of the model; plant P has only kinds with 1."""
    error: float = 0.15
    """Standard deviation of the slow errors over the sensor's nominal one."""
    error_time: float = 1.0
    """Correlation time of the slow errors, s."""
    always: bool = False
    """Whether the slow errors also exist when all noise is as designed."""


class LevelPrior(NamedTuple):
    """Prior of the bank over noise levels: their ranges and changes, outliers, kinds of aircraft."""

    gusts: tuple[float, float] = (0.2, 5.0)
    """Limits of the disturbance's level, log-uniform."""
    gust_points: int = 7
    gust_change: float = 2.0 / 600.0
    """Probability that the level changes before a measurement."""
    sensors: tuple[float, float] = (0.5, 6.0)
    """Limits of the factor on a sensor's standard deviation."""
    sensor_points: int = 9
    sensor_change: float = 1.0 / 600.0
    outlier: float = 0.0
    """Probability that a reading is an outlier."""
    outlier_factor: float = 30.0
    """Standard deviation of an outlier over the nominal one; above all levels."""
    nominal: float = 1.0 / 6.0
    """Probability that all noise is as designed."""
    leave: float = 1e-4
    """Probability before a measurement that noise as designed ends."""
    kept: float = 0.5
    """Probability that a sensor's noise remains as designed when noise as designed ends."""
    slow: tuple[str, ...] = ("rate",)
    """Sensors with slow errors."""
    kinds: tuple[Kind, ...] = (Kind(),)


TRAINING = LevelPrior()
"""Prior of the scenario ``random``: levels of these limits, two changes of the gusts and one of the sensors in 600
measurements, one episode of six as designed. The slow error has the mean square of the coloured ones there and the
middle of their correlation times; only that of the rate sensor is distinguishable from the motion."""
VAGUE = LevelPrior(
    gusts=(0.1, 10.0),
    gust_points=7,
    sensors=(0.4, 12.0),
    outlier=0.002,
    kinds=(
        Kind(0.8),
        Kind(0.1, error=1.5, error_time=30.0, always=True),
        Kind(0.1, lag=1.7),
    ),
)
"""Prior for aircraft of which little is known (ours): twice the range of every level, outliers, a rate sensor
that has a bias, and an actuator that is slower than designed; one of ten each."""


def grid(limits: tuple[float, float], points: int) -> numpy.ndarray:
    """Return the midpoints of intervals that divide the logarithm of a range evenly, ``(points,)``."""
    low, high = limits
    return numpy.asarray(low * (high / low) ** ((numpy.arange(points) + 0.5) / points))


class Levels(NamedTuple):
    """State of the bank over noise levels: estimate, hypotheses, likelihood."""

    mean: Array
    """Mean of all hypotheses together, ``(n, N)``."""
    covariance: Array
    """Covariance of all hypotheses together, ``(n, n, N)``."""
    likelihood: Likelihood
    hypotheses: LevelHypotheses


def likelihood_of(measurement: Measurement, log_likelihood: Array, nis: Array, xp: Any) -> Likelihood:
    """Return the :class:`Likelihood` of the readings; NaN in a dropout of all sensors."""
    count = ordered_sum(measurement.available)
    there = count > 0.0
    return Likelihood(xp.where(there, log_likelihood, math.nan), xp.where(there, nis, math.nan), count)


class LevelBank(SteerableFilter[AutopilotProblem, Measurement, Levels]):
    """Estimator ``level-bank``: Gaussian sum over levels of gusts and sensor noise that switch, merged like an IMM.

    Args:
        **changed: fields of the prior with other values.
    """

    def __init__(self, task: AutopilotProblem, prior: LevelPrior = TRAINING, **changed: Any) -> None:
        super().__init__(task)
        prior = prior._replace(**changed)
        self.prior = prior
        p, constant, n = task.parameters, task.constant, len(task.components)
        sensors, sigmas = list(task.sensors), p.value("sensor_sigmas")
        slow = [sensor for sensor in prior.slow if sensor in sensors]
        self.n: int = n
        self.size: int = n + len(slow)
        self.rows: list[tuple[int, int] | tuple[int]] = [
            (i, n + slow.index(s)) if s in slow else (i,) for s, i in zip(sensors, task.measured, strict=True)
        ]
        kinds = [kind for kind in prior.kinds if kind.lag == 1.0 or p.plant == "U"]
        error_sigmas = numpy.array([sigmas[sensors.index(sensor)] for sensor in slow])
        levels = numpy.array([1.0, *grid(prior.gusts, prior.gust_points)])
        models = [_KindModel(task, kind, error_sigmas, levels) for kind in kinds]
        self.groups: int = len(kinds)
        each = len(levels)
        self.F = [constant(m.F) for m in models for _ in levels]
        self.B = [constant(m.B) for m in models for _ in levels]
        self.propagator = [constant(packed_covariance.propagator(m.F)) for m in models for _ in levels]
        self.process, self.start_covariance = (
            constant(numpy.concatenate(parts, axis=1))[:, :, None]
            for parts in zip(*((m.process, m.initial) for m in models), strict=True)
        )
        many = (1.0 - prior.nominal) / prior.gust_points
        share = numpy.array([kind.share for kind in kinds]) / sum(kind.share for kind in kinds)
        within = numpy.array([prior.nominal, *[many] * prior.gust_points])
        self.probability: Array = constant(numpy.outer(share, within).ravel())[:, None]

        def by_hypothesis(designed: float, other: float) -> Array:
            return constant([designed] + [other] * (each - 1))[:, None]

        self.change: Array = by_hypothesis(prior.leave, prior.gust_change)
        self.arrive: Array = by_hypothesis(0.0, 1.0 / prior.gust_points)
        self.sensor_change: Array = by_hypothesis(0.0, prior.sensor_change)
        factors = grid(prior.sensors, prior.sensor_points)
        chances = numpy.full(len(factors), 1.0 / len(factors))
        nearest = numpy.arange(len(factors)) == numpy.abs(numpy.log(factors)).argmin()
        kept = (1.0 - prior.kept) * chances + prior.kept * nearest
        level_shares = numpy.concatenate(
            [kept[:, None], numpy.repeat(chances[:, None], each - 1, axis=1)], axis=1
        )
        squared = numpy.repeat(factors[:, None] ** 2, each, axis=1)
        squared[:, 0] = 1.0
        squared, level_shares = (numpy.tile(values, (1, self.groups)) for values in (squared, level_shares))
        self.levels: Array = constant(chances)[:, None, None]
        self.level_shares: Array = constant(level_shares)[:, :, None]
        self.variances: list[Array] = [constant(R * squared)[:, :, None] for R in task.sensor_variances]
        self.wide: list[float] = [R * prior.outlier_factor**2 for R in task.sensor_variances]
        settings = {"gusts": 1.1, "designed": 1.25, "process": 2.0}
        self.settings: dict[str, float] = {**settings, **dict.fromkeys(sensors, 1.5)}
        heights, designed = numpy.log(levels) / (math.log(levels[-1]) or 1.0), numpy.arange(each) == 0
        raised = numpy.tile([heights, designed.astype(float)], (1, self.groups))
        self.raised: Array = constant(raised)[:, :, None]
        """Exponents of the first two factors in each hypothesis' weight, ``(2, H, 1)``."""

    def start(self, initial: Initial | Start) -> Levels:
        """Return all hypotheses at the initial estimate, with their prior probabilities."""
        xp, none = self.xp, 0.0 * initial.mean[0]
        mean = xp.stack([*initial.mean, *[none] * (self.size - self.n)])
        hypotheses = LevelHypotheses(
            xp.stack([mean] * self.probability.shape[0], axis=1),
            self.start_covariance + none,
            self.probability + none,
            tuple(self.level_shares + none for _ in self.rows),
        )
        return Levels(initial.mean, initial.covariance, Likelihood.unknown(none), hypotheses)

    def predict(self, state: Levels, measurement: Measurement) -> Levels:
        """Return the hypotheses mixed for changes of noise levels, and predicted to a measurement."""
        h = self.switch(state.hypotheses)
        mean, covariance = self.propagate(h, measurement)
        return state._replace(hypotheses=h._replace(mean=mean, covariance=covariance))

    def has_effect(self, measurement: Measurement) -> Array:
        """Return 1 where any sensor has a reading, so that an action has an effect, else 0, ``(N,)``."""
        return self.xp.where(ordered_sum(measurement.available) > 0.0, 1.0, 0.0)

    def apply_factors(self, h: LevelHypotheses, logarithms: Array) -> LevelHypotheses:
        """Return the hypotheses with weights and process noise times factors, given as logarithms ``(3, N)``."""
        xp = self.xp
        return h._replace(
            probability=xp.exp(ordered_sum(self.raised * logarithms[:2, None])) * h.probability,
            covariance=h.covariance + (xp.exp(logarithms[2]) - 1.0) * self.process,
        )

    def update(self, state: Levels, inputs: FilterInput) -> Levels:
        """Return the hypotheses updated with one reading after the other, and their combined estimate."""
        xp, n, measurement, predicted = self.xp, self.n, inputs.measurement, state.hypotheses
        scaled = self.variances
        if inputs.action is not None:
            predicted = self.apply_factors(predicted, inputs.action[:3])
            factors = xp.exp(inputs.action[3:])
            scaled = [factors[k] * variances for k, variances in enumerate(self.variances)]
        mean, covariance = predicted.mean, predicted.covariance
        log_density, nis, sensors = 0.0, 0.0, []
        for k, rows in enumerate(self.rows):
            there = measurement.available[k]
            reading = xp.where(there > 0.0, measurement.reading[k], 0.0)
            step = noise_levels.update_sensor(
                mean,
                covariance,
                reading,
                rows,
                noise_levels.SensorNoise(scaled[k], predicted.sensors[k], self.prior.outlier, self.wide[k]),
                there,
            )
            mean, covariance = step.mean, step.covariance
            sensors.append(step.levels)
            log_density, nis = log_density + step.log_density, nis + step.nis
        log_weights = imm.log_probabilities(predicted.probability) + log_density
        probability = imm.softmax(log_weights)
        whole = noise_levels.merge(mean, covariance, probability)
        return Levels(
            whole.mean[:n],
            packed_covariance.unpack(whole.covariance, self.size)[:n, :n],
            likelihood_of(measurement, imm.log_sum(log_weights), weighted_sum(probability, nis), xp),
            LevelHypotheses(mean, covariance, probability, tuple(sensors)),
        )

    def switch(self, memory: LevelHypotheses) -> LevelHypotheses:
        """Return the hypotheses of every kind of aircraft mixed for changes of noise levels."""
        xp, each = self.xp, self.change.shape[0]
        parts = [
            noise_levels.switch(
                memory.take(slice(each * i, each * (i + 1))),
                self.change,
                self.arrive,
                self.sensor_change,
                self.levels,
            )
            for i in range(self.groups)
        ]
        if len(parts) == 1:
            return parts[0]
        return LevelHypotheses(
            xp.concat([part.mean for part in parts], axis=1),
            xp.concat([part.covariance for part in parts], axis=1),
            xp.concat([part.probability for part in parts]),
            tuple(xp.concat(list(q), axis=1) for q in zip(*(part.sensors for part in parts), strict=True)),
        )

    def propagate(self, h: LevelHypotheses, measurement: Measurement) -> tuple[Array, Array]:
        """Return the mean and covariance of every hypothesis predicted by equations (10) and (12)."""
        xp, u = self.xp, measurement.control
        mean = [
            xp.matmul(F, h.mean[:, j]) + B * u for j, (F, B) in enumerate(zip(self.F, self.B, strict=True))
        ]
        covariance = [xp.matmul(M, h.covariance[:, j]) for j, M in enumerate(self.propagator)]
        return xp.stack(mean, axis=1), xp.stack(covariance, axis=1) + self.process


class _KindModel:
    """Plant of a kind of aircraft with its slow sensor errors, for every level of the gusts.

    Args:
        sigmas: nominal standard deviations of the sensors with slow errors.
        levels: levels of the gusts; the first is noise as designed.
    """

    def __init__(
        self, task: AutopilotProblem, kind: Kind, sigmas: numpy.ndarray, levels: numpy.ndarray
    ) -> None:
        p, n, errors = task.parameters, len(task.components), len(sigmas)
        plant: Plant = task.design.model if kind.lag == 1.0 else pitch_channel(p, kind.lag)
        decay = math.exp(-p.value("sampling_interval") / kind.error_time)
        self.F = numpy.pad(plant.F, (0, errors)) + numpy.diag([0.0] * n + [decay] * errors)
        self.B = numpy.concatenate([plant.B, numpy.zeros((errors, 1))])
        scaled, other = (numpy.pad(Q, (0, errors)) for Q in (plant.scaled_noise, plant.other_noise))
        process, initial = [], []
        for i, level in enumerate(levels):
            variances = numpy.where(i > 0 or kind.always, (kind.error * sigmas) ** 2, 0.0)
            start = numpy.diag([*numpy.square(p.value("initial_sigmas")), *variances])
            if p.plant == "U":
                start[n - 1, n - 1] *= level**2
            gained = numpy.diag([*[0.0] * n, *((1.0 - decay**2) * variances)])
            process.append(packed_covariance.pack(level**2 * scaled + other + gained))
            initial.append(packed_covariance.pack(start))
        self.process, self.initial = numpy.stack(process, axis=1), numpy.stack(initial, axis=1)
