"""Constants of LooselyCoupledNavigation with their limits, and derived constants."""

import functools
from dataclasses import dataclass

from ...filters import loosely_coupled as ins_gnss
from ...filters.array_namespace import Array
from ..contract.parameters import TaskParameters, check, field_limits, parameter

AXES = ("x", "y", "z")

MOST_RATIO = 1e15
"""Largest ratio of the variance gained between measurements to that of the receiver.

A covariance after the update contains both. With 1e16 none was indefinite, with 1e18 some."""


@dataclass(frozen=True)
class LooselyCoupledNavigationParameters(TaskParameters):
    """Constants of LooselyCoupledNavigation; "ours", with the reason, because the paper states no numbers."""

    axes: int = parameter(1, at_least=1, at_most=len(AXES))
    """Coordinates, 1 (paper) to 3, independent of each other."""
    horizon: int = parameter(500, at_least=1)
    """Measurements acted on; ours: 5 s, the time axis of Fig. 2."""
    duration: float | None = parameter(None, above=0.0)
    """Length of the episode, s; where given it sets the horizon to the nearest number of measurements."""
    decision_interval: int = parameter(10, at_least=1)
    """Measurements for which one action holds; ours: 0.1 s. The effect of the gain at a single measurement is lost in
    the
    noise: PPO found no improvement in 200,000 decisions of one measurement. A gain that varies with every measurement
    needs 1."""
    sampling_interval: float = parameter(0.01, above=0.0, at_most=1e3)
    """Time between measurements, s; ours: K times it stays below 0.05 for every tuning, so sampling costs little.
    From 1e5 on the filter of the augmented state overflows."""

    reference_amplitude: float = parameter(2.0, at_least=0.0)
    """Amplitude of the reference motion without manoeuvres, a sine, m; ours, as in Figs. 4 and 5."""
    reference_rate: float = parameter(0.8, at_least=0.0)
    """Angular rate of the reference motion without manoeuvres, rad/s; ours, as in Figs. 4 and 5."""
    manoeuvres: int = parameter(0, at_least=0, at_most=16)
    """Harmonics of the reference motion on each axis, drawn anew for every episode; 0 (paper) is the sine above, the
    same in every episode."""
    manoeuvre_rate: tuple[float, float] = parameter((0.4, 8.0), above=0.0, ascending=True)
    """Interval of their angular rates, rad/s, drawn log-uniformly; ours: from half of the paper's rate, whose period is
    longer than the episode, to ten times it, beyond the bandwidth of every sensible gain."""
    manoeuvre_acceleration: tuple[float, float] = parameter((2.0, 10.0), at_least=0.0, ascending=True)
    """Interval of the peak acceleration of each, m/s^2, drawn uniformly, so that no axis accelerates more than
    ``manoeuvres`` times the upper limit; ours: 4 g at most with four, an agile aircraft. With weaker motion a filter
    could gain information from a model of the acceleration, and the problem would be another one."""

    drift: float = parameter(0.6, at_least=0.0)
    """Modelled standard deviation of the constant rate error beta, m/s; ours: the INS error grows large."""
    coloured: float = parameter(0.4, at_least=0.0)
    """Modelled stationary standard deviation of the coloured rate error eta, m/s; ours, as beta."""
    correlation_time: float = parameter(1.0, above=0.0)
    """Correlation time of the coloured rate error, s; ours: between the sampling interval and the episode."""
    white_intensity: float = parameter(0.04, at_least=0.0)
    """Modelled intensity G of the white rate error, m^2/s; ours: a tenth of the reduced coloured one."""
    receiver_intensity: float = parameter(0.02, above=0.0)
    """Nominal intensity N of the receiver noise, m^2 s; ours: 1.4 m per sample, "strongly noisy"."""

    fixed_drift: float | None = None
    """Constant rate error of every axis, m/s, in place of a random one; 1.0 is the example of Fig. 4."""
    drift_factor: tuple[float, float] = parameter((1.0, 1.0), above=0.0, ascending=True)
    """True over modelled standard deviation of beta, drawn log-uniformly in this interval."""
    coloured_factor: tuple[float, float] = parameter((1.0, 1.0), above=0.0, ascending=True)
    """True over modelled intensity of the coloured error, drawn in the same way."""
    white_factor: tuple[float, float] = parameter((1.0, 1.0), above=0.0, ascending=True)
    """True over modelled intensity of the white error, drawn in the same way."""
    receiver_factor: tuple[float, float] = parameter((1.0, 1.0), above=0.0, ascending=True)
    """True over nominal intensity of the receiver noise, drawn in the same way, anew at every change."""

    noise_changes: tuple[int, int] = parameter((0, 0), at_least=0, at_most=2, ascending=True)
    """Fewest and most changes of the receiver noise in the episode, 0 to 2, equally likely."""
    change_start: tuple[float, float] = parameter((0.5, 4.5), at_least=0.0, ascending=True)
    """Interval of the times of change, s; ours: both sides of a change are seen."""
    unreported: float = parameter(0.5, at_least=0.0, at_most=1.0)
    """Probability that the receiver reports the former noise after a change."""

    outage_probability: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability that the receiver fails once in the episode."""
    outage_start: tuple[float, float] = parameter((2.0, 2.0), at_least=0.0, ascending=True)
    """Interval of the start of the outage, s."""
    outage_duration: tuple[float, float] = parameter((1.5, 1.5), at_least=0.0, ascending=True)
    """Interval of the outage's length, s."""

    jamming_probability: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability that the receiver noise rises once in the episode, unreported."""
    jamming_start: tuple[float, float] = parameter((2.0, 2.0), at_least=0.0, ascending=True)
    """Interval of the start of the jamming, s."""
    jamming_duration: tuple[float, float] = parameter((1.0, 1.0), at_least=0.0, ascending=True)
    """Interval of the jamming's length, s."""
    jamming_factor: tuple[float, float] = parameter((100.0, 100.0), above=0.0, ascending=True)
    """Intensity under jamming over intensity without, drawn log-uniformly in this interval; ours: ten times the
    noise."""

    spoofing_probability: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability that the fix is pulled off once in the episode."""
    spoofing_start: tuple[float, float] = parameter((2.0, 2.0), at_least=0.0, ascending=True)
    """Interval of the start of the spoofing, s."""
    spoofing_duration: tuple[float, float] = parameter((1.5, 1.5), at_least=0.0, ascending=True)
    """Interval of the spoofing's length, s; after it the fix is true again."""
    spoofing_rate: tuple[float, float] = parameter((2.0, 2.0), ascending=True)
    """Interval of the rate at which every axis is pulled off, m/s; ours: twice the noise of a sample at the end."""

    outlier_probability: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability that a measurement is an outlier, independent of the others and not reported."""
    outlier_factor: float = parameter(100.0, above=0.0)
    """Ratio of the noise intensity of an outlier to that of the others; ours: ten times the noise."""

    receiver_coloured: tuple[float, float] = parameter((0.0, 0.0), at_least=0.0, ascending=True)
    """Interval of the stationary standard deviation of the receiver's coloured error (first-order Gauss-Markov), beside
    the white one, on each axis, m, drawn uniformly; it is not reported."""
    receiver_correlation_time: tuple[float, float] = parameter((2.0, 2.0), above=0.0, ascending=True)
    """Interval of the correlation time of that error, s, drawn log-uniformly; ours: multipath of a moving antenna,
    which lasts for seconds."""

    undisturbed: float = parameter(0.0, at_least=0.0, at_most=1.0)
    """Probability of an episode in which the receiver reports its true noise, its errors are white, nothing jams or
    spoofs it, and the INS is as modelled. Outages and reported changes of the noise have the law of other episodes."""

    averaging_measurements: float = parameter(25.0, above=0.0)
    """Time constant of the observed averages of innovations, measurements; ours: 0.25 s, the time constant of the
    reduced
    tuning."""
    smallest_gain: float = parameter(1e-5, above=0.0, below=1.0)
    """Smallest gain above zero that an action can set; ours: K = 0.001 1/s."""

    receiver_scale: float = parameter(100.0, above=1.0, at_most=1e6)
    """Largest factor of the variance of a measurement under control ``noise``; ours: that of the jamming."""
    receiver_reduction: float = parameter(10**0.5, above=1.0, at_most=1e6)
    """Largest divisor of it; ours: the best receiver of ``random``. A measurement that is trusted far too much for a
    moment spoils the filter."""
    process_scale: float = parameter(10.0, above=1.0, at_most=1e6)
    """Largest factor and divisor of the coloured and the white rate error's intensities under control ``noise``;
    ours."""
    noise_reach: float = parameter(0.1, above=0.0, at_most=1.0)
    """Share of the logarithms of these three factors that an action of one applies. Ours: a new policy explores with a
    standard deviation of about one, which at the full range costs half as much again as action zero, so that it learns
    to survive its own noise. A policy that explores less may use more."""

    def __post_init__(self) -> None:
        """Compute the horizon from the duration, and check every field."""
        if self.duration is not None:
            for name in ("duration", "sampling_interval"):
                check(name, getattr(self, name), *field_limits(LooselyCoupledNavigationParameters)[name])
            if self.sampling_interval > self.duration:
                raise ValueError(
                    f"sampling_interval must be at most the duration of {self.duration} s, got "
                    f"{self.sampling_interval!r} s"
                )
            object.__setattr__(self, "horizon", round(self.duration / self.sampling_interval))
        super().__post_init__()

    def check(self) -> None:
        """Raise ValueError for fields that contradict each other."""
        if not (self.coloured or self.white_intensity):
            raise ValueError(
                "coloured and white_intensity must not both be 0: the plain scheme needs a noise"
            )
        T = self.sampling_interval
        growth = (self.white_intensity + 2.0 * self.coloured**2 * min(self.correlation_time, T)) * T
        # The true drift, too: hypotheses that it leaves behind are merged with their distances.
        true = self.drift * self.drift_factor[1] if self.fixed_drift is None else abs(self.fixed_drift)
        growth += (max(self.drift, true) * T) ** 2
        best = min(1.0, self.receiver_factor[0]) * self.receiver_variance
        if growth > MOST_RATIO * best:
            raise ValueError(
                "sampling_interval, drift, fixed_drift, drift_factor, coloured or white_intensity must be smaller, or "
                "receiver_intensity or receiver_factor larger: from one measurement to the next the error gains "
                f"{growth / best:.1e} times the variance of the receiver, and a number keeps digits of at most "
                f"{MOST_RATIO:g}"
            )

    @property
    def receiver_variance(self) -> float:
        """Nominal variance of the receiver's fix, ``N / sampling_interval``, m^2."""
        return self.receiver_intensity / self.sampling_interval

    @property
    def equivalent_intensities(self) -> tuple[float, float]:
        """White noise intensities Ge of the two tunings, m^2/s: without the coloured error, and with it made white."""
        return (
            self.white_intensity,
            self.white_intensity + 2.0 * self.coloured**2 * self.correlation_time,
        )

    @property
    def plain_growth(self) -> tuple[float, float]:
        """Variance that the position error gains between measurements, m^2, under each of the two tunings."""
        white, reduced = self.equivalent_intensities
        return white * self.sampling_interval, reduced * self.sampling_interval

    @property
    def steady_state_gains(self) -> tuple[float, float]:
        """Steady-state gains of the filter without rate errors, for each of the two tunings."""
        white, reduced = (ins_gnss.steady_state_gain(q, self.receiver_variance) for q in self.plain_growth)
        return white, reduced

    @functools.cached_property
    def sampling(self) -> ins_gnss.Sampling:
        """Exact discretisation of the INS error."""
        return ins_gnss.sampling(self.correlation_time, self.sampling_interval)

    @functools.cached_property
    def variance_growth(self) -> tuple[float, float]:
        """Variances that the coloured rate error (m^2/s^2) and the displacement (m^2) gain between measurements."""
        return (
            (self.coloured * self.sampling.coloured) ** 2,
            self.white_intensity * self.sampling_interval + self.coloured**2 * self.sampling.residual,
        )

    def prior_covariance(self, none: Array) -> ins_gnss.AugmentedCovariance:
        """Return the initial covariance of position and rate errors; ``none`` is zeros ``(N,)``."""
        drift, coloured = none + self.drift**2, none + self.coloured**2
        return ins_gnss.AugmentedCovariance(none, none, none, drift, none, coloured)
