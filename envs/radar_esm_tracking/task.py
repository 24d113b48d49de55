"""RadarEsmTracking: one range channel, radar and ESM together, a target of unknown manoeuvrability.

Source: S. L. Ivanov and D. V. Seliverstov, on the joint processing of an airborne radar and an electronic
support measures (ESM) station with recognition of the target's class (in Russian). Equation numbers are
theirs; the mathematics stands in ``filters/class_fusion.py`` and ``filters/singer.py``.
"""

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal, NamedTuple

import numpy

from ...filters import class_fusion, imm, singer
from .. import parameters as check
from ..controls import bank_action_space, bank_probabilities, signed_logarithm
from ..task import Array, Component, Field, NoiseLayout, PaperPolicy, Task
from .scenarios import SCENARIOS

TIME_SHOWN = 60.0
"""Seconds of track that the clock in the observation shows as one."""
COUNT_SHOWN = 10.0
"""Decisions that a count in the observation shows as one."""
STANDARD_GRAVITY = 9.81
"""m/s^2."""


@dataclass(frozen=True)
class RadarEsmTrackingParameters:
    """Every constant of the task; each is a keyword of ``gym.make``."""

    sampling_interval: float = 0.5
    """Radar revisit time T, s (paper)."""
    horizon: int = 120
    """Scans acted on in one episode (ours: 60 s; the paper does not say)."""
    decision_interval: int = 1
    """Scans for which one action holds."""
    esm_period: int = 4
    """Scans from one ESM decision to the next, W (paper: 2 s)."""
    manoeuvrability: tuple[float, ...] = (0.025, 0.033, 0.1)
    """Inverse correlation time of the acceleration of each class S0, S1, ..., 1/s (paper)."""
    acceleration_sigma: tuple[float, ...] = tuple(
        singer.acceleration_sigma(g * STANDARD_GRAVITY, 0.05, 0.5) for g in (0.5, 2.0, 5.0)
    )
    """Standard deviation of the acceleration of each class, m/s^2 (ours: Singer's rule with P_max = 0.05,
    P_0 = 0.5 and at most 0.5, 2 and 5 g: transport, ordinary, agile. With one sigma for all, the printed
    ``manoeuvrability`` alone cannot tell the classes apart)."""
    process_noise: str = "singer"
    """"singer": the exact noise of the exponentially correlated acceleration. "acceleration": its variance
    on the acceleration only, the other reading of the paper's unstated covariance."""
    range_sigma: float = 3000.0
    """Radar error of the range, m (paper)."""
    range_rate_sigma: float = 20.0
    """Radar error of the radial velocity, m/s (paper)."""
    radar_bearing_sigma: float = 15.0
    """Radar error of the bearing, degrees (as the paper prints it; 1.5 is believable and matters only where
    there is a second emitter)."""
    esm_bearing_sigma: float = 3.0
    """ESM error of the bearing, degrees (paper)."""
    association_error: float = 0.1
    """Probability that the gate (6), (7) refuses two bearings of one target (paper)."""
    recognition: tuple[tuple[float, ...], ...] = tuple(
        tuple(0.9 if i == j else 0.1 / 3.0 for j in range(4)) for i in range(4)
    )
    """Probability of every ESM decision (column) for every emitter type (row): advanced fighter, fighter,
    airborne early warning, missile with active seeker (paper: 0.9 on the diagonal; ours: the rest shared
    equally)."""
    composition: tuple[tuple[float, ...], ...] = (
        (0.05, 0.05, 0.85, 0.05),
        (0.15, 0.70, 0.10, 0.05),
        (0.45, 0.15, 0.05, 0.35),
    )
    """Probability of every emitter type (column) in every class (row) (ours: the paper calls it known and
    does not give it)."""
    prior: tuple[float, ...] = (1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0)
    """Class probabilities before any data; a random true class is drawn from them (ours: uniform)."""
    class_transition: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Class transition probabilities q that the *bank* assumes, row = from, column = to (paper (2): a
    constant class). Anything but the identity makes the filters mix on the weights."""
    evidence_scale: float = 4.0
    """Nats that an evidence of one adds to a class's log-posterior (ours)."""
    averaging_scans: float = 10.0
    """Time constant of the exponential averages in the observation, scans (ours)."""
    range_scale: float = 3000.0
    """Error of the range that costs one, m (ours: the paper's radar error)."""
    range_rate_scale: float = 20.0
    """Error of the range rate that costs one, m/s (ours: the paper's radar error)."""
    acceleration_scale: float = 10.0
    """Error of the acceleration that costs one, m/s^2 (ours)."""
    initial_range: tuple[float, float] = (100e3, 100e3)
    """Limits of the range at the start, m (paper: 100 km)."""
    closing_speed: tuple[float, float] = (500.0, 500.0)
    """Limits of the closing speed at the start, m/s (paper: 500)."""
    true_class: str = "random"
    """"random": drawn from ``prior``; or the class of every target, "S0", "S1", ..."""
    emitter: str = "redrawn"
    """"redrawn": the type is drawn anew for every decision, as (8) assumes. "fixed": one type a target."""
    class_change: tuple[float, ...] = ()
    """Limits of the time at which the class changes once, s, later than the first scan; empty: never (ours)."""
    silence_start: float = 0.0
    """Probability, at each ESM look, that a radiating target falls silent (ours)."""
    silence_end: float = 1.0
    """Probability, at each ESM look, that a silent target radiates again (ours)."""
    second_emitter_probability: float = 0.0
    """Probability that the ESM hears a second emitter, of another class, instead of the target (ours)."""
    second_emitter_separation: tuple[float, float] = (2.0, 20.0)
    """Limits of its distance in bearing, degrees, to either side (ours)."""

    def __post_init__(self) -> None:
        check.number("sampling_interval", self.sampling_interval, above=0.0)
        check.integer("horizon", self.horizon, at_least=1)
        check.integer("decision_interval", self.decision_interval, at_least=1)
        check.integer("esm_period", self.esm_period, at_least=1)
        check.numbers("manoeuvrability", self.manoeuvrability, above=0.0)
        classes = len(self.manoeuvrability)
        if classes < 2:
            raise ValueError(f"manoeuvrability must name at least two classes, got {self.manoeuvrability!r}")
        check.numbers("acceleration_sigma", self.acceleration_sigma, classes, above=0.0)
        check.choice("process_noise", self.process_noise, ("singer", "acceleration"))
        for name in (
            "range_sigma",
            "range_rate_sigma",
            "radar_bearing_sigma",
            "esm_bearing_sigma",
            "evidence_scale",
            "range_scale",
            "range_rate_scale",
            "acceleration_scale",
        ):
            check.number(name, getattr(self, name), above=0.0)
        check.number("association_error", self.association_error, above=0.0, below=1.0)
        if not self.recognition:
            raise ValueError("recognition must have a row for each emitter type, got none")
        types = len(self.recognition)
        check.stochastic_matrix("recognition", self.recognition, types)
        check.stochastic_matrix("composition", self.composition, classes, types)
        check.stochastic_matrix("prior", (self.prior,), 1, classes)
        check.stochastic_matrix("class_transition", self.class_transition, classes)
        check.number("averaging_scans", self.averaging_scans, at_least=1.0)
        check.interval("initial_range", self.initial_range, above=0.0)
        check.interval("closing_speed", self.closing_speed)
        check.choice("true_class", self.true_class, ("random", *(f"S{s}" for s in range(classes))))
        check.choice("emitter", self.emitter, ("redrawn", "fixed"))
        if self.class_change:
            # The class at scan 0 must have governed one motion before it can change.
            check.interval("class_change", self.class_change, above=self.sampling_interval)
        for name in ("silence_start", "silence_end", "second_emitter_probability"):
            check.number(name, getattr(self, name), at_least=0.0, at_most=1.0)
        if self.silence_start + self.silence_end == 0.0:
            raise ValueError(
                "silence_start and silence_end must not both be 0: who radiates would be undefined"
            )
        check.interval("second_emitter_separation", self.second_emitter_separation, above=0.0, at_most=180.0)


class Truth(NamedTuple):
    """What no agent sees."""

    motion: Array
    """Range (m), range rate (m/s), range acceleration (m/s^2), ``(3, N)``."""
    target_class: Array
    """Index of the class now, ``(N,)``."""
    emitter_type: Array
    """Index of the type now, ``(N,)``; of no effect where types are redrawn."""
    change_scan: Array
    """Scan from which the next class governs, ``(N,)``."""
    next_class: Array
    """``(N,)``."""
    next_type: Array
    """``(N,)``."""
    radiating: Array
    """Whether the target is heard at ESM looks, ``(N,)`` of booleans."""
    other_class: Array
    """Class of the second emitter, ``(N,)``."""
    other_type: Array
    """``(N,)``."""
    separation: Array
    """Its bearing minus the target's, degrees, ``(N,)``."""


class Intercept(NamedTuple):
    """What the ESM says at one scan."""

    decision: Array
    """Index of the type, or the number of types where there is none, ``(N,)``."""
    bearing_difference: Array
    """Radar bearing minus ESM bearing, degrees, 0 where there is no decision, ``(N,)``."""
    used: Array
    """Whether the gate (6) lets the decision be used, ``(N,)`` of booleans."""


class Bank(NamedTuple):
    """M Kalman filters, one for each class."""

    mean: Array
    """After the radar update (and mixing), ``(3, M, N)``."""
    covariance: Array
    """``(3, 3, M, N)``."""
    log_predicted: Array
    """Log-probability of the classes given the radar, before the ESM, up to a constant, ``(M, N)``."""
    innovation: Array
    """Whitened, ``(2, M, N)``."""
    log_likelihood: Array
    """Of this scan's radar measurement, ``(M, N)``."""
    average_innovation: Array
    """Exponential average, ``(2, M, N)``."""
    average_log_squared: Array
    """Exponential average of log(1 + normalised innovation squared), ``(M, N)``."""
    accumulated: Array
    """Sum of the log-likelihoods since the start, ``(M, N)``."""
    probabilities: Array
    """Weights in force, ``(M, N)``."""


class State(NamedTuple):
    """Truth, measurements and estimator of N episodes."""

    scan: Array
    """Number of the current scan, integer, ``(N,)``; 0 starts the track."""
    truth: Truth
    measurement: Array
    """Range (m) and range rate (m/s), ``(2, N)``."""
    intercept: Intercept
    used_counts: Array
    """Decisions for each type so far that could be used, ``(J, N)``."""
    refused_counts: Array
    """Decisions for each type so far that the gate refused, ``(J, N)``."""
    bank: Bank
    estimate: Array
    """Reported range, range rate, acceleration (11), ``(3, N)``."""
    estimate_covariance: Array
    """Reported covariance (12), ``(3, 3, N)``."""


class RadarEsmTracking(Task[State]):
    """Radar and ESM fused, the target's class recognised (Ivanov, Seliverstov).

    ## Description

    A fighter's radar measures range and range rate of one air target every 0.5 s, with errors of 3000 m and
    20 m/s. The target may be anything from an early-warning aircraft (class S0) to an agile fighter or a
    missile (S2), and the manoeuvre model of the right class is what makes the filter good: on an S0 target
    the filter for S2 is 4.5 times worse in acceleration. A bank runs one Kalman filter with Singer's
    manoeuvre model for each class. Every 2 s the electronic support measures (ESM) station, which listens to
    the target's own emissions, decides for an emitter type; types are distributed differently in the
    classes. A gate on the difference of the radar's and the ESM's bearings decides whether the two mean one
    target and the decision may be used.

    The agent sees the innovations of the filters and the ESM decisions, and weighs the classes. Zero
    ``evidence`` is the paper's algorithm. In order (8)-(10): every filter predicts and updates with the radar
    measurement under the class at the previous scan; the weights in force times the radar likelihoods go
    through the class transition, and the filters mix on them; the agent is shown the result; the ESM
    decision is the last factor, and the action gives P(s(k)) given everything to k. What the action sets
    thus meets the next transition and mixing at the next scan.

    With a constant class (``class_transition`` the identity, the default) nothing mixes: the action decides
    only which combination of the filters is reported now, and which weights Bayes' rule starts from at the
    next scan. The filters never feel it, and for the weights that an agent states outright the problem is
    myopic: a discount of 0 suffices.

    `paper` redraws the emitter type for every decision, which is the assumption behind (8) and makes it
    exactly Bayesian for the radar and the decisions that pass the gate. A real target has one type: in
    `fixed-type` and all other scenarios the same rule counts one fact again and again and grows sure of a
    wrong class.

    Everything is linear, so range and speed of the target have no influence on any error.

    ## Action Space

    | control | space | meaning |
    |---|---|---|
    | `evidence` (default) | `Box(-1, 1, (3,))` | times `evidence_scale` nats, added to log P; 0: the paper |
    | `mode` | `Discrete(3)` | the class that is believed |
    | `weights` | `Box(0, 1, (3,))` | class probabilities, normalised; all zero is uniform |

    Values outside the box are taken at its edge.

    ## Observation Space

    A flat `Box` of float64; `env.unwrapped.observation_fields` lists name, unit and scale of every component.
    For each class: the whitened innovations of range and range rate (the second is what the first does not
    explain; their squares add to the normalised innovation squared), log(1 + that square),
    exponential averages of these, the radar log-likelihood of this scan and its sum since the start, both
    relative to the largest. Of the ESM: the decision (one-hot, or "none"; "refused by the gate" is shown
    beside the decision it refuses), counts of used and of refused decisions, the bearing difference
    over the gate. The last weights and the time. Large values are compressed by sign(x) log(1 + |x|).
    Only differences between measurements and predictions enter: range and speed themselves do not.

    ## Rewards

    Minus the mean of three squared errors: range over `range_scale`, range rate over `range_rate_scale`,
    acceleration over `acceleration_scale`. Linear in the error beyond 10.

    ## Starting State

    The first radar measurement (scan 0) starts all filters: its range and range rate, no acceleration, with
    variances `range_sigma`^2, `range_rate_sigma`^2, `acceleration_sigma`^2 of the class. The true
    acceleration is drawn with the latter variance. The ESM decides at scan 0 too: that decision multiplies
    the prior, and the first observation, of scan 1, holds it in the counts and in the last weights.

    ## Episode End

    Truncation after `horizon` scans; there is no termination. The range is a coordinate of a linear model: a
    near and fast target may pass through zero.

    ## Arguments

    Every field of `RadarEsmTrackingParameters` is a keyword of `gym.make`, beside `control`, `scenario`,
    `reward` and `render_mode`.

    ## Version History

    * v0: first release
    """

    id = "filtergym/RadarEsmTracking-v0"
    paper_source = (
        "S. L. Ivanov, D. V. Seliverstov, Joint processing of radar and electronic support measures with "
        "recognition of the target's class (in Russian)"
    )
    controls = ("evidence", "mode", "weights")
    Parameters = RadarEsmTrackingParameters
    scenarios = SCENARIOS
    components = (
        Component("range", "m"),
        Component("range_rate", "m/s"),
        Component("acceleration", "m/s^2"),
    )
    modes: tuple[str, ...] = ("S0", "S1", "S2")
    cost_description = (
        "mean of the squared errors of range, range rate and acceleration over range_scale, range_rate_scale "
        "and acceleration_scale"
    )
    huber_bound = 10.0
    paper_policy = PaperPolicy("evidence", (0.0, 0.0, 0.0))

    parameters: RadarEsmTrackingParameters

    def picture(self) -> Any:
        """Return what draws an episode; imported here, because it brings matplotlib."""
        from .picture import PICTURE

        return PICTURE(self)

    def __init__(
        self, parameters: RadarEsmTrackingParameters, control: str, xp: ModuleType = numpy, device: Any = None
    ) -> None:
        super().__init__(parameters, control, xp, device)
        p = parameters
        self.classes, self.types = len(p.manoeuvrability), len(p.recognition)
        self.modes = tuple(f"S{s}" for s in range(self.classes))
        self.paper_policy = PaperPolicy("evidence", (0.0,) * self.classes)
        self.noise = NoiseLayout(uniforms=15, initial_normals=5, normals=7, row_uniforms=4)
        self.action_space = bank_action_space(control, self.classes)
        self.fields = self._fields()
        self.forgetting = math.exp(-1.0 / p.averaging_scans)
        self.gate = class_fusion.bearing_gate(p.radar_bearing_sigma, p.esm_bearing_sigma, p.association_error)
        identity = numpy.eye(self.classes)
        self.mixes = not numpy.array_equal(numpy.asarray(p.class_transition), identity)
        self.class_transition = self.constant(p.class_transition)
        self._design()
        # Columns of tables that lanes look up by class or type.
        self.class_thresholds = self._thresholds([p.prior])[:, 0]
        self.type_thresholds = self.constant(self._thresholds(p.composition))
        self.decision_thresholds = self.constant(self._thresholds(p.recognition))
        esm = class_fusion.decision_probabilities(numpy.array(p.recognition), numpy.array(p.composition))
        silence = numpy.ones((self.classes, 1))
        self.log_esm = imm.log_probabilities(self.constant(numpy.concatenate([esm, silence], axis=1)))
        self.log_prior = imm.log_probabilities(self.constant(p.prior))[:, None]

    @staticmethod
    def design_models(p: RadarEsmTrackingParameters) -> tuple[class_fusion.Models, numpy.ndarray]:
        """Models of the classes and the covariances that the track starts with, ``(3, 3, M)``."""
        T = p.sampling_interval
        Q = []
        for alpha, sigma in zip(p.manoeuvrability, p.acceleration_sigma, strict=True):
            noise = singer.process_noise(alpha, sigma, T)
            if p.process_noise == "acceleration":
                noise = numpy.diag([0.0, 0.0, noise[2, 2]])
            Q.append(noise)
        models = class_fusion.Models(
            Phi=numpy.stack([singer.transition(alpha, T) for alpha in p.manoeuvrability], axis=-1),
            Q=numpy.stack(Q, axis=-1),
            H=numpy.eye(2, 3),
            R=numpy.diag([p.range_sigma**2, p.range_rate_sigma**2]),
        )
        starts = [numpy.diag([p.range_sigma, p.range_rate_sigma, s]) ** 2 for s in p.acceleration_sigma]
        return models, numpy.stack(starts, axis=-1)

    def _design(self) -> None:
        """Constants of the models; with a constant class also gains and covariances of every scan."""
        models, start = self.design_models(self.parameters)
        self.models = class_fusion.Models(*(self.constant(matrix) for matrix in models))
        self.start_covariance = self.constant(start)
        # Q = L L^T; diagonal where the noise is on the acceleration only, which Cholesky cannot factor.
        singular = self.parameters.process_noise == "acceleration"
        roots = [
            numpy.sqrt(Q) if singular else numpy.linalg.cholesky(Q) for Q in numpy.moveaxis(models.Q, -1, 0)
        ]
        root = numpy.stack(roots, axis=-1)
        response = models.Phi[:, 2]
        lower = [root[i, j] for i in range(3) for j in range(i + 1)]
        self.motion_table = self.constant(numpy.stack([*response, *lower]))
        self.acceleration_sigma = self.constant(self.parameters.acceleration_sigma)
        # One scan beyond the horizon is measured; lanes that wait for their reset stay at the last column.
        self.last_scan = self.horizon + 1
        if not self.mixes:
            channels = class_fusion.design_channels(models, start, self.last_scan)
            self.channels = class_fusion.Channels(*(self.constant(table) for table in channels))

    @staticmethod
    def _thresholds(rows: Any) -> numpy.ndarray:
        """Cumulative probabilities that a uniform number is compared with, ``(columns - 1, rows)``."""
        return numpy.cumsum(numpy.array(rows), axis=1)[:, :-1].T

    # --- what the agent is shown

    def _fields(self) -> tuple[Field, ...]:
        p = self.parameters
        average = f"exponential average over {p.averaging_scans:g} scans"

        def each(name: str, description: str) -> list[Field]:
            return [Field(f"{name}_{mode}", "1", description) for mode in self.modes]

        def each_type(name: str, description: str, over: Literal["last", "mean"] = "last") -> list[Field]:
            return [Field(f"{name}_{j}", "1", description, over) for j in range(self.types)]

        count = f"decisions for this emitter type so far over {COUNT_SHOWN:g}"
        return (
            *each("innovation_range", "whitened innovation of the range, signed log"),
            *each("innovation_range_rate", "of the range rate, without what the range explains, signed log"),
            *each("average_innovation_range", f"{average}, signed log"),
            *each("average_innovation_range_rate", f"{average}, signed log"),
            *each("log_likelihood", "of this scan's radar measurement minus the largest, nats, signed log"),
            *each("accumulated_log_likelihood", "sum since the start minus the largest, nats, signed log"),
            *each("log_squared_innovation", "log(1 + normalised innovation squared)"),
            *each("average_log_squared_innovation", average),
            *each_type("decision", "1 where the ESM decides for this emitter type", "mean"),
            Field("decision_none", "1", "1 where the ESM decides nothing at this scan", "mean"),
            Field("decision_refused", "1", "1 where the bearing gate refuses the decision", "mean"),
            *each_type("used_count", f"used {count}"),
            *each_type("refused_count", f"refused {count}"),
            Field("bearing_difference", "1", "radar minus ESM bearing over the gate", "mean"),
            *each("last_weight", "weight in force before this scan"),
            Field("time", "1", f"time since the start of the track over {TIME_SHOWN:g} s"),
        )

    def observe(self, state: State) -> Array:
        """Show innovations, likelihoods, ESM decisions and the clock; see ``fields``."""
        xp, bank, intercept = self.xp, state.bank, state.intercept
        compressed = signed_logarithm(
            xp.concat(
                [
                    bank.innovation[0],
                    bank.innovation[1],
                    bank.average_innovation[0],
                    bank.average_innovation[1],
                    bank.log_likelihood - xp.max(bank.log_likelihood, axis=0),
                    bank.accumulated - xp.max(bank.accumulated, axis=0),
                ]
            ),
            xp,
        )
        refused = (intercept.decision < self.types) & ~intercept.used
        return xp.concat(
            [
                compressed,
                self._log_squared(bank.innovation),
                bank.average_log_squared,
                self._one_hot(intercept.decision, self.types + 1),
                xp.astype(refused, xp.float64)[None],
                state.used_counts * (1.0 / COUNT_SHOWN),
                state.refused_counts * (1.0 / COUNT_SHOWN),
                (intercept.bearing_difference * (1.0 / self.gate))[None],
                bank.probabilities,
                xp.astype(state.scan, xp.float64)[None] * (self.parameters.sampling_interval / TIME_SHOWN),
            ]
        )

    def _log_squared(self, innovation: Array) -> Array:
        return self.xp.log1p(innovation[0] * innovation[0] + innovation[1] * innovation[1])

    def _one_hot(self, index: Array, count: int) -> Array:
        xp = self.xp
        return xp.astype(xp.arange(count, device=index.device)[:, None] == index, xp.float64)

    # --- the target and its emissions

    def _drawn(self, thresholds: Array, uniform: Array) -> Array:
        """Index drawn by the inverse of a cumulative distribution, ``(N,)`` of integers.

        Args:
            thresholds: ``(count - 1, N)``, or a column of numbers.
            uniform: ``(N,)``.
        """
        xp = self.xp
        index = xp.zeros_like(uniform, dtype=xp.int64)
        for threshold in thresholds:
            index = index + xp.astype(uniform >= threshold, xp.int64)
        return index

    def _drawn_type(self, target_class: Array, uniform: Array) -> Array:
        return self._drawn(self.xp.take(self.type_thresholds, target_class, axis=1), uniform)

    def _another_class(self, target_class: Array, uniform: Array) -> Array:
        """A class other than the given one, all equally probable."""
        xp = self.xp
        step = 1 + xp.astype(xp.floor((self.classes - 1) * uniform), xp.int64)
        return (target_class + step) % self.classes

    def _truth(self, uniforms: Array, acceleration: Array) -> Truth:
        """Draw the target and its surroundings from 12 uniform numbers and a normal one."""
        xp, p = self.xp, self.parameters

        def between(limits: tuple[float, ...], u: Array) -> Array:
            return limits[0] + (limits[1] - limits[0]) * u

        if p.true_class == "random":
            target_class = self._drawn(self.class_thresholds.tolist(), uniforms[2])
        else:
            target_class = xp.zeros_like(uniforms[2], dtype=xp.int64) + self.modes.index(p.true_class)
        next_class = self._another_class(target_class, uniforms[4])
        other_class = self._another_class(target_class, uniforms[7])
        if p.class_change:
            change = xp.ceil(between(p.class_change, uniforms[6]) / p.sampling_interval)
        else:
            change = 0.0 * uniforms[6] + (self.last_scan + 1)
        sigma = xp.take(self.acceleration_sigma, target_class, axis=0)
        side = xp.where(uniforms[10] < 0.5, -1.0, 1.0)
        return Truth(
            motion=xp.stack(
                [
                    between(p.initial_range, uniforms[0]),
                    -between(p.closing_speed, uniforms[1]),
                    sigma * acceleration,
                ]
            ),
            target_class=target_class,
            emitter_type=self._drawn_type(target_class, uniforms[3]),
            change_scan=xp.astype(change, xp.int64),
            next_class=next_class,
            next_type=self._drawn_type(next_class, uniforms[5]),
            radiating=uniforms[11] * (p.silence_start + p.silence_end) < p.silence_end,
            other_class=other_class,
            other_type=self._drawn_type(other_class, uniforms[8]),
            separation=side * between(p.second_emitter_separation, uniforms[9]),
        )

    def _moved(self, truth: Truth, scan: Array, due: Array, normals: Array, uniform: Array) -> Truth:
        """Fly one scan under the class at the previous one, then let the class change and fall silent."""
        xp, p = self.xp, self.parameters
        f = xp.take(self.motion_table, truth.target_class, axis=1)
        x, w = truth.motion, normals
        motion = xp.stack(
            [
                x[0] + p.sampling_interval * x[1] + f[0] * x[2] + f[3] * w[0],
                x[1] + f[1] * x[2] + f[4] * w[0] + f[5] * w[1],
                f[2] * x[2] + f[6] * w[0] + f[7] * w[1] + f[8] * w[2],
            ]
        )
        truth = truth._replace(motion=motion)
        if p.class_change:
            changed = scan >= truth.change_scan
            truth = truth._replace(
                target_class=xp.where(changed, truth.next_class, truth.target_class),
                emitter_type=xp.where(changed, truth.next_type, truth.emitter_type),
            )
        if p.silence_start > 0.0:
            on = xp.where(truth.radiating, uniform >= p.silence_start, uniform < p.silence_end)
            truth = truth._replace(radiating=xp.where(due, on, truth.radiating))
        return truth

    def _intercepted(self, truth: Truth, due: Array, normals: Array, uniforms: Array) -> Intercept:
        """ESM decision and bearing, and the gate (6).

        Args:
            truth: at this scan.
            due: whether the ESM looks at this scan, ``(N,)``.
            normals: errors of the radar's and the ESM's bearing, ``(2, N)``.
            uniforms: for the type, the decision and the source, ``(3, N)``.
        """
        xp, p = self.xp, self.parameters
        heard_class, heard_type = truth.target_class, truth.emitter_type
        heard = truth.radiating
        radar_bearing = p.radar_bearing_sigma * normals[0]
        esm_bearing = p.esm_bearing_sigma * normals[1]
        if p.second_emitter_probability > 0.0:
            other = uniforms[2] < p.second_emitter_probability
            heard_class = xp.where(other, truth.other_class, heard_class)
            heard_type = xp.where(other, truth.other_type, heard_type)
            heard = other | heard
            esm_bearing = esm_bearing + xp.where(other, truth.separation, 0.0)
        if p.emitter == "redrawn":
            heard_type = self._drawn_type(heard_class, uniforms[0])
        heard = heard & due
        decision = self._drawn(xp.take(self.decision_thresholds, heard_type, axis=1), uniforms[1])
        difference = class_fusion.bearing_difference(radar_bearing, esm_bearing)
        return Intercept(
            decision=xp.where(heard, decision, self.types),
            bearing_difference=xp.where(heard, difference, 0.0),
            used=heard & (xp.abs(difference) <= self.gate),
        )

    def _radar(self, truth: Truth, normals: Array) -> Array:
        p = self.parameters
        return self.xp.stack(
            [truth.motion[0] + p.range_sigma * normals[0], truth.motion[1] + p.range_rate_sigma * normals[1]]
        )

    # --- the clock

    def begin(self, uniforms: Array, normals: Array) -> State:
        """Draw the target, start the filters on the first radar measurement, hear the first decision."""
        xp = self.xp
        scan = xp.zeros_like(uniforms[0], dtype=xp.int64)
        truth = self._truth(uniforms[:12], normals[0])
        measurement = self._radar(truth, normals[1:3])
        intercept = self._intercepted(truth, scan == 0, normals[3:5], uniforms[12:15])
        return self._started(scan, truth, measurement, intercept)

    def _started(self, scan: Array, truth: Truth, measurement: Array, intercept: Intercept) -> State:
        xp = self.xp
        zero = 0.0 * measurement[0]
        start = xp.stack([measurement[0], measurement[1], zero])
        mean = xp.stack([start] * self.classes, axis=1)
        covariance = self.start_covariance[..., None] + zero
        zeros = 0.0 * mean[:2]
        log_predicted = self.log_prior + zeros[0]
        probabilities = imm.mode_posterior(log_predicted, self._esm_log_likelihood(intercept))
        bank = Bank(
            mean=mean,
            covariance=covariance,
            log_predicted=log_predicted,
            innovation=zeros,
            log_likelihood=zeros[0],
            average_innovation=zeros,
            average_log_squared=zeros[0],
            accumulated=zeros[0],
            probabilities=probabilities,
        )
        no_counts = xp.stack([zero] * self.types)
        used_counts, refused_counts = self._counted(no_counts, no_counts, intercept)
        estimate, estimate_covariance = imm.combine(mean, covariance, probabilities)
        return State(
            scan,
            truth,
            measurement,
            intercept,
            used_counts,
            refused_counts,
            bank,
            estimate,
            estimate_covariance,
        )

    def measure(self, state: State, noise: Array) -> State:
        """Fly one scan, measure, hear the ESM, and let the filters take in the radar measurement.

        A row of noise: 3 normal numbers for the motion, 2 for the radar, 2 for the bearings; uniform ones for
        the type, the decision, the source, and falling silent.
        """
        scan = state.scan + 1
        due = scan % self.parameters.esm_period == 0
        truth = self._moved(state.truth, scan, due, noise[:3], noise[10])
        measurement = self._radar(truth, noise[3:5])
        intercept = self._intercepted(truth, due, noise[5:7], noise[7:10])
        return self._filtered(state, scan, truth, measurement, intercept)

    def _filtered(
        self, state: State, scan: Array, truth: Truth, measurement: Array, intercept: Intercept
    ) -> State:
        """Radar update of the bank; nothing of ``truth`` enters, it only becomes part of the state."""
        bank = state.bank
        if self.mixes:
            result = class_fusion.advance(
                bank.probabilities,
                bank.mean,
                bank.covariance,
                measurement,
                self.models,
                self.class_transition,
            )
            mean, covariance, log_predicted, innovation, log_likelihood = result
        else:
            take, channels = self.xp.take, self.channels
            column = self.xp.clip(scan, 0, self.last_scan)
            update = class_fusion.update_channels(
                bank.mean,
                measurement,
                self.models.Phi,
                self.models.H,
                take(channels.gain, column, axis=-1),
                take(channels.whitening, column, axis=-1),
                take(channels.log_normaliser, column, axis=-1),
            )
            mean, innovation, log_likelihood = update
            covariance = take(channels.covariance, column, axis=-1)
            log_predicted = imm.log_probabilities(bank.probabilities) + log_likelihood
        keep, take_new = self.forgetting, 1.0 - self.forgetting
        used_counts, refused_counts = self._counted(state.used_counts, state.refused_counts, intercept)
        return State(
            scan,
            truth,
            measurement,
            intercept,
            used_counts,
            refused_counts,
            Bank(
                mean=mean,
                covariance=covariance,
                log_predicted=log_predicted,
                innovation=innovation,
                log_likelihood=log_likelihood,
                average_innovation=keep * bank.average_innovation + take_new * innovation,
                average_log_squared=(
                    keep * bank.average_log_squared + take_new * self._log_squared(innovation)
                ),
                accumulated=bank.accumulated + log_likelihood,
                probabilities=bank.probabilities,
            ),
            state.estimate,
            state.estimate_covariance,
        )

    def _counted(self, used: Array, refused: Array, intercept: Intercept) -> tuple[Array, Array]:
        """Counts of used and of refused decisions with this scan's."""
        one_hot = self._one_hot(intercept.decision, self.types)
        accepted = self.xp.astype(intercept.used, one_hot.dtype) * one_hot
        return used + accepted, refused + (one_hot - accepted)

    def _esm_log_likelihood(self, intercept: Intercept) -> Array:
        """Logarithm of pi(rho | s) of a decision that may be used, otherwise 0, ``(M, N)``."""
        usable = self.xp.where(intercept.used, intercept.decision, self.types)
        return self.xp.take(self.log_esm, usable, axis=1)

    def act(self, state: State, action: Array) -> State:
        """Put the weights of the action in force and report the combination (11), (12)."""
        bank = state.bank
        probabilities = bank_probabilities(
            self.control,
            action,
            bank.log_predicted,
            self._esm_log_likelihood(state.intercept),
            self.parameters.evidence_scale,
            self.xp,
        )
        estimate, covariance = imm.combine(bank.mean, bank.covariance, probabilities)
        return state._replace(
            bank=bank._replace(probabilities=probabilities),
            estimate=estimate,
            estimate_covariance=covariance,
        )

    # --- how good the estimate is

    def cost(self, state: State) -> Array:
        """Mean of the three squared errors over their scales."""
        p, error = self.parameters, self.error(state)
        a = error[0] * (1.0 / p.range_scale)
        b = error[1] * (1.0 / p.range_rate_scale)
        c = error[2] * (1.0 / p.acceleration_scale)
        return (a * a + b * b + c * c) * (1.0 / 3.0)

    def error(self, state: State) -> Array:
        """Estimate minus truth: range (m), range rate (m/s), acceleration (m/s^2)."""
        return state.estimate - state.truth.motion

    def covariance(self, state: State) -> Array:
        """Covariance (12), with the spread of the filters."""
        return state.estimate_covariance

    def records(self, state: State) -> dict[str, Array]:
        """Class probabilities, true class and type, reported variances, time and NIS.

        The NIS of the bank is the mean over the classes by their probability given the radar; where these are
        calibrated its expectation is 2, that of the true class's filter.
        """
        xp, bank = self.xp, state.bank
        radar_probabilities = imm.normalised_exponential(bank.log_predicted)
        squared = bank.innovation[0] * bank.innovation[0] + bank.innovation[1] * bank.innovation[1]
        nis, true_probability = 0.0 * squared[0], 0.0 * squared[0]
        is_true = self._one_hot(state.truth.target_class, self.classes)
        for s in range(self.classes):
            nis = nis + radar_probabilities[s] * squared[s]
            true_probability = true_probability + is_true[s] * bank.probabilities[s]
        return {
            "mode_probability": bank.probabilities,
            "nis": nis,
            "true_class": xp.astype(state.truth.target_class, xp.float64),
            "true_type": xp.astype(state.truth.emitter_type, xp.float64),
            "true_class_probability": true_probability,
            **{
                f"variance_{component.name}": state.estimate_covariance[i, i]
                for i, component in enumerate(self.components)
            },
            "seconds": xp.astype(state.scan, xp.float64) * self.parameters.sampling_interval,
        }


TASK = RadarEsmTracking
