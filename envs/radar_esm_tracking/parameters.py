"""Constants of RadarEsmTracking, with their limits."""

from dataclasses import dataclass

from ...filters import singer
from ..contract.parameters import (
    ParameterLimits,
    TaskParameters,
    check,
    check_length,
    parameter,
    square_matrix,
)

STANDARD_GRAVITY = 9.81
"""Standard gravity, m/s^2."""


@dataclass(frozen=True)
class RadarEsmTrackingParameters(TaskParameters):
    """Constants of RadarEsmTracking; each is a keyword of ``gym.make``."""

    sampling_interval: float = parameter(0.5, above=0.0, at_most=86400.0)
    """Radar revisit time T, s (paper)."""
    horizon: int = parameter(120, at_least=1)
    """Scans with an action in one episode (ours: 60 s; the paper gives none)."""
    decision_interval: int = parameter(4, at_least=1)
    """Scans for which one action holds (ours: from one ESM decision to the next. The noise hides the effect of the
    weights of a single scan: PPO learned too little in 200,000 decisions of one scan)."""
    esm_period: int = parameter(4, at_least=1)
    """Scans from one ESM decision to the next, W (paper: 2 s)."""
    manoeuvrability: tuple[float, ...] = parameter((0.025, 0.033, 0.1), above=0.0)
    """Inverse correlation time of the acceleration of each class S0, S1, ..., 1/s (paper)."""
    acceleration_sigma: tuple[float, ...] = parameter(
        tuple(singer.acceleration_sigma(g * STANDARD_GRAVITY, 0.05, 0.5) for g in (0.5, 2.0, 5.0)), above=0.0
    )
    """Standard deviation of the acceleration of each class, m/s^2 (ours: Singer's rule with P_max = 0.05,
    P_0 = 0.5 and at most 0.5, 2 and 5 g: transport, ordinary, agile. With one sigma for all, the printed
    ``manoeuvrability`` alone cannot tell the classes apart)."""
    process_noise: str = parameter("singer", choices=("singer", "acceleration"))
    """"singer": the exact noise of the exponentially correlated acceleration. "acceleration": its variance
    on the acceleration only, the other reading of the paper's unstated covariance."""
    range_sigma: float = parameter(3000.0, above=0.0)
    """Radar error of the range, m (paper)."""
    range_rate_sigma: float = parameter(20.0, above=0.0)
    """Radar error of the radial velocity, m/s (paper)."""
    radar_bearing_sigma: float = parameter(15.0, above=0.0)
    """Radar error of the bearing, degrees (as printed in the paper; 1.5 is plausible and matters only with
    a second emitter)."""
    esm_bearing_sigma: float = parameter(3.0, above=0.0)
    """ESM error of the bearing, degrees (paper)."""
    association_error: float = parameter(0.1, above=0.0, below=1.0)
    """Probability that the gate (6), (7) refuses two bearings of one target (paper)."""
    recognition: tuple[tuple[float, ...], ...] = parameter(
        tuple(tuple(0.9 if i == j else 0.1 / 3.0 for j in range(4)) for i in range(4)),
        at_least=0.0, at_most=1.0, stochastic=True,
    )  # fmt: skip
    """Probability of every ESM decision (column) for every emitter type (row): advanced fighter, fighter,
    airborne early warning, missile with active seeker (paper: 0.9 on the diagonal; ours: the rest shared
    equally)."""
    composition: tuple[tuple[float, ...], ...] = parameter(
        ((0.05, 0.05, 0.85, 0.05), (0.15, 0.70, 0.10, 0.05), (0.45, 0.15, 0.05, 0.35)),
        at_least=0.0, at_most=1.0, stochastic=True,
    )  # fmt: skip
    """Probability of every emitter type (column) in every class (row) (ours: the paper assumes it known and
    does not give it)."""
    prior: tuple[float, ...] = parameter(
        (1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0), at_least=0.0, at_most=1.0, stochastic=True
    )
    """Class probabilities before any data; a random true class is drawn from them (ours: uniform)."""
    class_transition: tuple[tuple[float, ...], ...] = parameter(
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), at_least=0.0, at_most=1.0, stochastic=True
    )
    """Class transition probabilities q that the *bank* assumes, row = from, column = to (paper (2): a
    constant class). Anything but the identity makes the filters mix on the weights."""
    evidence_scale: float = parameter(1.5, above=0.0)
    """Nats that an evidence of one adds to a class's log-posterior (ours: a new policy explores with a standard
    deviation of about one. With more nats its gain on mistaken classes costs more in the median episode. A policy that
    explores less may use 12, enough to correct a posterior that is certain of a class which has changed)."""
    averaging_measurements: float = parameter(10.0, at_least=1.0)
    """Time constant of the exponential averages in the observation, scans (ours)."""
    range_scale: float = parameter(3000.0, above=0.0)
    """Error of the range that costs one, m (ours: the paper's radar error)."""
    range_rate_scale: float = parameter(20.0, above=0.0)
    """Error of the range rate that costs one, m/s (ours: the paper's radar error)."""
    acceleration_scale: float = parameter(10.0, above=0.0)
    """Error of the acceleration that costs one, m/s^2 (ours)."""
    initial_range: tuple[float, float] = parameter((100e3, 100e3), above=0.0, ascending=True)
    """Limits of the range at the start, m (paper: 100 km)."""
    closing_speed: tuple[float, float] = parameter((500.0, 500.0), ascending=True)
    """Limits of the closing speed at the start, m/s (paper: 500)."""
    true_class: str = "random"
    """"random": drawn from ``prior``; or the class of every target, "S0", "S1", ..."""
    emitter: str = parameter("redrawn", choices=("redrawn", "fixed"))
    """"redrawn": the type is drawn anew for every decision, as (8) assumes. "fixed": one type a target."""
    class_change: tuple[float, float] | None = parameter(None, ascending=True)
    """Limits of the time at which the class changes once, s, later than the first scan; None: never (ours)."""
    class_change_probability: float = parameter(1.0, at_least=0.0, at_most=1.0)
    """Probability that the class changes in an episode, if ``class_change`` is given (ours)."""
    silence_start: tuple[float, float] = parameter((0.0, 0.0), at_least=0.0, at_most=1.0, ascending=True)
    """Limits of the probability, at each ESM look, that a radiating target falls silent; drawn for each episode
    (ours)."""
    silence_end: tuple[float, float] = parameter((1.0, 1.0), at_least=0.0, at_most=1.0, ascending=True)
    """Limits of the probability, at each ESM look, that a silent target radiates again; drawn for each episode
    (ours)."""
    second_emitter_probability: tuple[float, float] = parameter(
        (0.0, 0.0), at_least=0.0, at_most=1.0, ascending=True
    )
    """Limits of the probability that the ESM receives a second emitter, of another class, instead of the target;
    drawn for each episode (ours)."""
    second_emitter_separation: tuple[float, float] = parameter(
        (2.0, 20.0), above=0.0, at_most=180.0, ascending=True
    )
    """Limits of the distance of the second emitter in bearing, degrees, to either side (ours)."""
    glint_probability: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability of glint in both radar errors of a scan, independent for each scan and unreported (ours)."""
    glint_factor: float = parameter(5.0, above=0.0)
    """Standard deviation of errors with glint over that of the others (ours)."""
    radar_coloured: tuple[float, float] = parameter((0.0, 0.0), at_least=0.0, ascending=True)
    """Limits of the stationary standard deviation of coloured errors (first-order Gauss-Markov) of range and range
    rate, in addition to the white ones and over their standard deviation; drawn for each episode, equal for both
    (ours)."""
    radar_correlation_time: tuple[float, float] = parameter((10.0, 10.0), above=0.0, ascending=True)
    """Limits of the correlation time of the coloured errors, s; drawn for each episode (ours)."""
    radar_correlation: tuple[float, float] = parameter((0.0, 0.0), above=-1.0, below=1.0, ascending=True)
    """Limits of the correlation of the white errors of range and range rate, as of a pulse with frequency modulation,
    whose range shifts with the Doppler frequency; drawn for each episode (ours)."""
    undisturbed: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability of an episode without second emitter, change of class, and coloured and correlated radar errors
    (ours). Silences have the law of other episodes."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes of target: S0, S1 and so on."""
        return tuple(f"S{s}" for s in range(len(self.manoeuvrability)))

    def check(self) -> None:
        """Raise ValueError for fields that contradict each other."""
        classes, types = len(self.manoeuvrability), len(self.recognition)
        if classes < 2:
            raise ValueError(f"manoeuvrability must name at least two classes, got {self.manoeuvrability!r}")
        check_length("acceleration_sigma", self.acceleration_sigma, classes)
        if not types:
            raise ValueError("recognition must have a row for each emitter type, got none")
        square_matrix("recognition", self.recognition, types)
        check_length("composition", self.composition, classes, "rows, one for each class")
        for s, row in enumerate(self.composition):
            check_length(f"composition[{s}]", row, types)
        check_length("prior", self.prior, classes)
        square_matrix("class_transition", self.class_transition, classes)
        check("true_class", self.true_class, str, ParameterLimits(choices=("random", *self.class_names)))
        # The class at scan 0 must have governed one motion before it can change.
        after_a_scan = ParameterLimits(above=self.sampling_interval)
        check("class_change", self.class_change, tuple[float, float] | None, after_a_scan)
        if self.silence_start[0] + self.silence_end[0] == 0.0:
            raise ValueError(
                "silence_start and silence_end must not both be 0: the share of silent targets would be undefined"
            )
