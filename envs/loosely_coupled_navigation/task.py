r"""Loosely coupled navigation: an INS that drifts, corrected by a GNSS receiver through one gain.

After Benkafo and Lobaty, "Features of application of Kalman-Bucy filters in orientation and navigation
complexes". The reference ``Xr`` is ``amplitude sin(rate t)``; the INS integrates it with the rate errors of
:mod:`filtergym.filters.loosely_coupled`, the receiver measures it with white noise. On every axis

    X += dXr + step beta + drive eta + dd,   eta = decay eta + de,   Z = Xr + sigma n
    Xh' = Xh + dX,   nu = Z - Xh',   Xh = Xh' + gain nu                                         (3)

Reading: the paper prints no numbers; those marked "ours" make its Figs. 2, 4 and 5 look as described.
"""

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import imm
from ...filters import loosely_coupled as ins_gnss
from .. import parameters as check
from ..controls import bank_action_space, bank_probabilities, signed_logarithm
from ..task import Array, Component, Field, NoiseLayout, PaperPolicy, Task
from .scenarios import SCENARIOS

NEVER = 1e9
"""Clock of what does not happen; finite, so that arithmetic on it stays finite."""

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class LooselyCoupledNavigationParameters:
    """Constants of the episode; "ours" because the paper states no numbers, with the reason after it."""

    axes: int = 1
    """Coordinates, 1 (paper) to 3, independent of each other."""
    horizon: int = 500
    """Measurements acted on; ours: 5 s, the time axis of Fig. 2."""
    duration: float | None = None
    """Length of the episode, s; where given it sets the horizon to the nearest number of steps."""
    decision_interval: int = 1
    """Measurements for which one action holds; ours: the time-varying gain is exact only with 1."""
    step: float = 0.01
    """Sampling interval, s; ours: K step stays below 0.05 for every tuning, so sampling costs little."""

    reference_amplitude: float = 2.0
    """Of the reference motion, m; ours, as in Figs. 4 and 5."""
    reference_rate: float = 0.8
    """Angular rate of the reference motion, rad/s; ours, as in Figs. 4 and 5."""

    drift: float = 0.6
    """Modelled standard deviation of the constant rate error beta, m/s; ours: the INS leaves the picture."""
    coloured: float = 0.4
    """Modelled stationary standard deviation of the coloured rate error eta, m/s; ours, as beta."""
    correlation_time: float = 1.0
    """Of the coloured rate error, s; ours: between the step and the episode."""
    white_intensity: float = 0.04
    """Modelled intensity G of the white rate error, m^2/s; ours: a tenth of the reduced coloured one."""
    receiver_intensity: float = 0.02
    """Nominal intensity N of the receiver noise, m^2 s; ours: 1.4 m per sample, "strongly noisy"."""

    fixed_drift: float | None = None
    """Constant rate error of every axis, m/s, in place of a random one; 1.0 is the example of Fig. 4."""
    drift_factor: tuple[float, float] = (1.0, 1.0)
    """True over modelled standard deviation of beta, drawn log-uniformly in this interval."""
    coloured_factor: tuple[float, float] = (1.0, 1.0)
    """True over modelled intensity of the coloured error, likewise."""
    white_factor: tuple[float, float] = (1.0, 1.0)
    """True over modelled intensity of the white error, likewise."""
    receiver_factor: tuple[float, float] = (1.0, 1.0)
    """True over nominal intensity of the receiver noise, likewise; every change draws anew."""

    noise_changes: tuple[int, int] = (0, 0)
    """Fewest and most changes of the receiver noise in the episode, 0 to 2, equally likely."""
    change_start: tuple[float, float] = (0.5, 4.5)
    """Interval of the times of change, s; ours: both sides of a change are seen."""
    unreported: float = 0.5
    """Probability that the receiver goes on reporting the former noise after a change."""

    outage_probability: float = 0.0
    """That the measurement fails once in the episode."""
    outage_start: tuple[float, float] = (2.0, 2.0)
    """Interval of the start of the outage, s."""
    outage_duration: tuple[float, float] = (1.5, 1.5)
    """Interval of its length, s."""

    jamming_probability: float = 0.0
    """That the receiver noise rises once in the episode, unreported."""
    jamming_start: tuple[float, float] = (2.0, 2.0)
    """Interval of the start of the jamming, s."""
    jamming_duration: tuple[float, float] = (1.0, 1.0)
    """Interval of its length, s."""
    jamming_factor: float = 100.0
    """Intensity under jamming over intensity without; ours: ten times the noise."""

    spoofing_probability: float = 0.0
    """That the measurement is pulled off once in the episode."""
    spoofing_start: tuple[float, float] = (2.0, 2.0)
    """Interval of the start of the spoofing, s."""
    spoofing_duration: tuple[float, float] = (1.5, 1.5)
    """Interval of its length, s; after it the measurement is true again."""
    spoofing_rate: float = 2.0
    """Rate at which every axis is pulled off, m/s; ours: twice the noise of a sample at the end."""

    averaging_time: float = 0.25
    """Of the averages of innovations shown, s; ours: the time constant of the reduced tuning."""
    smallest_gain: float = 1e-5
    """Lowest gain but zero that an action can set; ours: K = 0.001 1/s."""

    def __post_init__(self) -> None:
        """Refuse impossible values with the reason."""
        for item in fields(self):
            object.__setattr__(self, item.name, check.frozen(getattr(self, item.name)))
        check.integer("axes", self.axes, at_least=1)
        if self.axes > len(AXES):
            raise ValueError(f"axes must be 1, 2 or 3, got {self.axes!r}")
        check.number("step", self.step, above=0.0)
        if self.duration is not None:
            check.number("duration", self.duration, above=0.0)
            if self.step > self.duration:
                raise ValueError(
                    f"step must be at most the duration of {self.duration} s, got {self.step!r} s"
                )
            object.__setattr__(self, "horizon", round(self.duration / self.step))
        check.integer("horizon", self.horizon, at_least=1)
        check.integer("decision_interval", self.decision_interval, at_least=1)
        for name in ("reference_amplitude", "reference_rate", "drift", "coloured", "white_intensity"):
            check.number(name, getattr(self, name), at_least=0.0)
        for name in ("correlation_time", "receiver_intensity", "averaging_time"):
            check.number(name, getattr(self, name), above=0.0)
        if not (self.coloured or self.white_intensity):
            raise ValueError(
                "coloured and white_intensity must not both be 0: the plain scheme needs a noise"
            )
        if self.fixed_drift is not None:
            check.number("fixed_drift", self.fixed_drift)
        for name in ("drift_factor", "coloured_factor", "white_factor", "receiver_factor"):
            check.interval(name, getattr(self, name), above=0.0)
        check.interval("noise_changes", self.noise_changes, at_least=0, at_most=2)
        for i, count in enumerate(self.noise_changes):
            check.integer(f"noise_changes[{i}]", count, at_least=0)
        check.interval("change_start", self.change_start, at_least=0.0)
        check.number("unreported", self.unreported, at_least=0.0, at_most=1.0)
        for name in ("outage", "jamming", "spoofing"):
            check.number(
                f"{name}_probability", getattr(self, f"{name}_probability"), at_least=0.0, at_most=1.0
            )
            check.interval(f"{name}_start", getattr(self, f"{name}_start"), at_least=0.0)
            check.interval(f"{name}_duration", getattr(self, f"{name}_duration"), at_least=0.0)
        check.number("jamming_factor", self.jamming_factor, above=0.0)
        check.number("spoofing_rate", self.spoofing_rate)
        check.number("smallest_gain", self.smallest_gain, above=0.0, below=1.0)

    @property
    def receiver_variance(self) -> float:
        """Nominal variance of a measurement, ``N / step``, m^2."""
        return self.receiver_intensity / self.step

    @property
    def equivalent_intensities(self) -> tuple[float, float]:
        """Ge of the two tunings, m^2/s: the white part, and with the coloured part reduced to white noise."""
        return (
            self.white_intensity,
            self.white_intensity + 2.0 * self.coloured**2 * self.correlation_time,
        )


class LooselyCoupledNavigationState(NamedTuple):
    """Everything of N episodes; M filters (1 under gain, otherwise 3), A axes.

    ``position`` and ``variance`` are predictions after ``measure`` and updated after ``act``. ``rest`` and
    ``rate`` belong to the augmented filter and have no rows under gain.
    """

    clock: Array
    """Measurements so far, ``(N,)``."""
    # The truth, and what only clairvoyants are told
    reference: Array
    """Xr, ``(A, N)``, m."""
    drift: Array
    """beta, ``(A, N)``, m/s."""
    coloured: Array
    """eta, ``(A, N)``, m/s."""
    drift_deviation: Array
    """True standard deviation of beta, ``(N,)``, m/s."""
    coloured_step: Array
    """Standard deviation of what eta gains in a step, ``(N,)``, m/s."""
    white_step: Array
    """Standard deviation of the displacement in a step that this gain does not explain, ``(N,)``, m."""
    receiver_levels: Array
    """Standard deviation of the receiver noise before, between and after its changes, ``(3, N)``, m."""
    reported_levels: Array
    """What the receiver reports in its place, ``(3, N)``, m."""
    change: Array
    """First measurement after each change, ``(2, N)``."""
    outage: Array
    """First measurement of the outage and first one after it, ``(2, N)``."""
    jamming: Array
    """Likewise, ``(2, N)``."""
    spoofing: Array
    """Likewise, ``(2, N)``."""
    deviation: Array
    """True standard deviation of this measurement, ``(N,)``, m."""
    # What the instruments say
    ins: Array
    """X, ``(A, N)``, m."""
    increment: Array
    """X minus X one step before, ``(A, N)``, m."""
    measurement: Array
    """Z, zero where there is none, ``(A, N)``, m."""
    available: Array
    """One where there is a measurement, otherwise zero, ``(N,)``."""
    reported: Array
    """Reported standard deviation of the measurement, ``(N,)``, m."""
    # The filters
    position: Array
    """Xh of each filter, ``(M, A, N)``, m."""
    variance: Array
    """Its variance, ``(1, A, N)`` under gain, otherwise ``(3, 1, N)``, m^2."""
    rate: Array
    """Estimates of beta and eta, ``(2, A, N)``, m/s."""
    rest: Array
    """Covariance of (delta, beta, eta) after its first entry, ``(5, N)``."""
    innovation: Array
    """nu, zero where there is no measurement, ``(M, A, N)``, m."""
    normalised: Array
    """nu over its standard deviation, ``(M, A, N)``."""
    average: Array
    """Exponential average of the normalised innovation, ``(M, A, N)``."""
    average_square: Array
    """Of its square, ``(M, A, N)``."""
    average_product: Array
    """Of its product with the one before, ``(M, A, N)``."""
    # The answer
    estimate: Array
    """Reported position, ``(A, N)``, m."""
    estimate_covariance: Array
    """Reported covariance, ``(A, A, N)``, m^2."""
    action: Array
    """Last action: ``(A, N)`` under gain, otherwise the weights in force, ``(3, N)``."""
    gain: Array
    """Gain of the steered filter in force, zero without a measurement, ``(A, N)``; no rows in a bank."""


class LooselyCoupledNavigation(Task[LooselyCoupledNavigationState]):
    """An inertial system drifts away, a noisy satellite receiver holds it back, one gain decides how much.

    ### Description

    The inertial navigation system (INS) gives smooth increments of position whose rate error is a random
    constant, a coloured and a white noise; its error grows without limit. The satellite receiver (GNSS)
    measures the position with strong white noise and no memory. The Kalman-Bucy filter of the paper lets the
    increments drive the estimate and pulls it to the measurement by a gain. A high gain follows the receiver
    noise, a low one follows the drift, and which is better depends on noise levels that no one announces.

    With ``control="gain"`` the action acts on the estimate itself and so on all later ones. With ``mode`` and
    ``weights`` a bank of three filters runs beside the agent without mixing: the plain scheme tuned to the
    white noise, the plain scheme with the coloured noise reduced to white, both with the gain (4) of the
    Riccati equation, and the augmented filter that also estimates the rate errors. The action then chooses
    only what is reported *now*: the problem is myopic, a discount factor of zero suffices.

    Axes are independent: one gain for each, one set of weights for all.

    ### Action Space

    ========  ==================  =======================================================================
    control   space               meaning
    ========  ==================  =======================================================================
    gain      Box(-1, 1, (axes))  gain of this sample, ``1e-5^((1 - a) / 2)``: 1e-5 to 1 on a logarithmic
                                  scale; exactly 0 (INS only) at -1, exactly 1 (GNSS only) at +1. In
                                  continuous time ``K = gain / step``. Zero is ``gain = 0.0032``,
                                  ``K = 0.32 1/s``; the reduced tuning is about 0.45 (``K = 4.2 1/s``).
    mode      Discrete(3)         the filter that is believed: plain-white, plain-reduced, augmented
    weights   Box(0, 1, (3))      weights of the three estimates, normalised; all zero = uniform
    ========  ==================  =======================================================================

    Without a measurement the gain is zero, whatever the action.

    ### Observation Space

    A flat ``Box``; for each filter (one under gain, three otherwise) and axis, in this order: innovation over
    its standard deviation; signed logarithm of the innovation over the receiver's *reported* noise; short
    averages of the normalised innovation, of its square (as ``log(1 + x)``) and of its product with the one
    before. Then the logarithm of the reported over the nominal noise (the report may be wrong), whether there
    is a measurement, the last action (under mode and weights: the weights in force), and the time t as
    ``t / (t + tau)``. A filter without a measurement has the innovation zero, and its averages stand still.

    The increments of the INS are not shown: the reference motion is always the same, so whoever knows it by
    heart could read the rate errors off them. All that is shown depends on the errors alone.

    ### Rewards

    Minus the squared error of position, summed over the axes, in units of the nominal variance of a
    measurement (``N / step``); linear beyond 30 standard deviations.

    ### Starting State

    INS, estimate and reference agree at time zero. The rate errors, the noise levels and the times of
    disturbances are drawn as the scenario says.

    ### Episode End

    Truncation after ``horizon`` measurements (500 = 5 s). There is no termination.

    ### Arguments

    ``scenario``: "random" (default; noise levels over a decade, changes of the receiver noise, outages),
    "paper", "outage", "jamming", "spoof-ramp", "quiet". ``control``: "gain", "mode", "weights". Every field
    of :class:`LooselyCoupledNavigationParameters` is a keyword.

    ### Version History

    v0: initial version.
    """

    id = "filtergym/LooselyCoupledNavigation-v0"
    paper_source = (
        "A. S. Benkafo, A. A. Lobaty, Features of application of Kalman-Bucy filters in orientation and "
        "navigation complexes (in Russian)"
    )
    controls = ("gain", "mode", "weights")
    Parameters = LooselyCoupledNavigationParameters
    scenarios = SCENARIOS
    modes = ("plain-white", "plain-reduced", "augmented")
    cost_description = "squared error of position over the nominal variance of a measurement"
    huber_bound = 30.0
    paper_policy = PaperPolicy("gain", (0.447,))

    def picture(self) -> Any:
        """Return what draws an episode; imported here, because it brings matplotlib."""
        from .picture import PICTURE

        return PICTURE(self)

    def __init__(
        self,
        parameters: LooselyCoupledNavigationParameters,
        control: str = "gain",
        xp: Any = numpy,
        device: Any = None,
    ) -> None:
        """Fix the constants of the filters and the layout of noise, observation and action."""
        check.choice("control", control, self.controls)
        super().__init__(parameters, control, xp, device)
        p = self.parameters
        names = AXES[: p.axes]
        components = ("position",) if p.axes == 1 else tuple(f"position_{name}" for name in names)
        self.components = tuple(Component(name, "m") for name in components)
        self.groups = {} if p.axes == 1 else {"position": components}
        self.noise = NoiseLayout(uniforms=20, initial_normals=2 * p.axes, normals=3 * p.axes)

        self.sampling = ins_gnss.sampling(p.correlation_time, p.step)
        self.growth = tuple(intensity * p.step for intensity in p.equivalent_intensities)
        self.settled_gains = tuple(ins_gnss.settled_gain(q, p.receiver_variance) for q in self.growth)
        self.paper_policy = PaperPolicy("gain", (self.action_of_gain(self.settled_gains[1]),) * p.axes)
        # What the modelled coloured rate error and the displacement gain in a step, m^2/s^2 and m^2.
        self.modelled_growth = (
            (p.coloured * self.sampling.coloured) ** 2,
            p.white_intensity * p.step + p.coloured**2 * self.sampling.residual,
        )
        self._plain_growth = self.constant(self.growth)[:, None, None]
        self._eye = self.constant(numpy.eye(p.axes))[:, :, None]
        self._phase = self.constant([math.pi / 2 * i for i in range(p.axes)])[:, None]
        self._forgetting = -math.expm1(-p.step / p.averaging_time)
        self._count = 1 if control == "gain" else len(self.modes)
        if control == "gain":
            self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (p.axes,), numpy.float32)
        else:
            self.action_space = bank_action_space(control, self._count)
        self.fields = self._fields(names)

    def _fields(self, axes: tuple[str, ...]) -> tuple[Field, ...]:
        """List the observation in the order of :meth:`observe`."""
        filters = ("",) if self.control == "gain" else tuple(f"_{m.replace('-', '_')}" for m in self.modes)
        suffixes = ("",) if len(axes) == 1 else tuple(f"_{axis}" for axis in axes)
        each = (
            ("innovation_over_sigma", "innovation over its predicted standard deviation", "mean"),
            ("innovation_over_reported", "signed log of the innovation over the reported noise", "mean"),
            ("average_innovation", "short average of innovation_over_sigma", "last"),
            ("average_square", "log(1 + short average of its square)", "last"),
            ("average_product", "short average of its product with the one before", "last"),
        )
        found = [
            Field(f"{name}{of}{axis}", "1", text, over)  # type: ignore[arg-type]
            for name, text, over in each
            for of in filters
            for axis in suffixes
        ]
        found.append(Field("reported_noise", "1", "log of the reported over the nominal standard deviation"))
        found.append(Field("available", "1", "1 with a measurement, 0 without", "mean"))
        if self.control == "gain":
            found += [Field(f"last_action{axis}", "1", "action applied before") for axis in suffixes]
        else:
            found += [Field(f"last_weight{of}", "1", "weight put in force before") for of in filters]
        found.append(Field("time", "1", "t / (t + tau), t since the start, tau the correlation time"))
        return tuple(found)

    def action_of_gain(self, gain: float) -> float:
        """Action that sets a gain: -1 for zero, otherwise the inverse of :meth:`gain_of_action`.

        Raises:
            ValueError: a gain outside [0, 1].
        """
        if not 0.0 <= gain <= 1.0:
            raise ValueError(f"gain must lie in [0, 1], got {gain!r}")
        if gain <= self.parameters.smallest_gain:
            return -1.0
        return 1.0 - 2.0 * math.log(gain) / math.log(self.parameters.smallest_gain)

    def gain_of_action(self, action: Array) -> Array:
        """Gain that an action sets, logarithmic between the smallest one and 1, zero at the lower end."""
        gain = self.xp.exp((0.5 * math.log(self.parameters.smallest_gain)) * (1.0 - action))
        return self.xp.where(action <= -1.0, 0.0, gain)

    def actions_of_gains(self, gains: Any) -> Any:
        """Return the same of a NumPy array of gains in [0, 1]; small ones are taken as zero."""
        smallest = self.parameters.smallest_gain
        logarithm = numpy.log(numpy.maximum(gains, smallest)) / math.log(smallest)
        return numpy.where(gains <= smallest, -1.0, 1.0 - 2.0 * logarithm)

    def diagonal(self, variance: Array) -> Array:
        """Covariance ``(axes, axes, N)`` of independent axes with variances ``(axes, N)``."""
        return self._eye * variance

    def begin(self, uniforms: Array, normals: Array) -> LooselyCoupledNavigationState:
        """Draw the episode: noise levels, changes, disturbances, rate errors.

        Uniform numbers, in this order: factors of drift, coloured, white and receiver noise; number of
        changes, their two times, two levels, two reports; outage, jamming and spoofing, each with presence,
        start and length. Normal numbers: beta of each axis, eta of each axis.
        """
        p, xp = self.parameters, self.xp
        lanes = uniforms.shape[-1]
        drift, coloured, white, receiver, count = (uniforms[i] for i in range(5))
        first, second = (self._clock_of(_uniform(uniforms[i], p.change_start)) for i in (5, 6))
        drift_deviation = p.drift * _log_uniform(drift, p.drift_factor, xp)
        coloured_deviation = p.coloured * xp.sqrt(_log_uniform(coloured, p.coloured_factor, xp))
        white_intensity = p.white_intensity * _log_uniform(white, p.white_factor, xp)

        few, many = p.noise_changes
        changes = xp.floor(count * (many - few + 1)) + few
        both = changes == 2
        earlier = xp.where(changes == 0, NEVER, xp.where(both, xp.minimum(first, second), first))
        later = xp.where(both, xp.maximum(first, second), NEVER)
        levels = [
            xp.sqrt(p.receiver_variance * _log_uniform(u, p.receiver_factor, xp))
            for u in (receiver, uniforms[7], uniforms[8])
        ]
        reported = levels[:1]
        for level, silent in ((levels[1], uniforms[9]), (levels[2], uniforms[10])):
            reported.append(xp.where(silent < p.unreported, reported[-1], level))

        zeros = xp.zeros((p.axes, lanes), dtype=xp.float64, device=self.device)
        ones = xp.ones((lanes,), dtype=xp.float64, device=self.device)
        beta = drift_deviation * normals[: p.axes] if p.fixed_drift is None else zeros + p.fixed_drift
        reference = zeros + p.reference_amplitude * xp.sin(self._phase)
        each = xp.zeros((self._count, p.axes, lanes), dtype=xp.float64, device=self.device)
        bank = self.control != "gain"
        start = (p.drift**2, 0.0, p.coloured**2)
        return LooselyCoupledNavigationState(
            clock=0.0 * ones,
            reference=reference,
            drift=beta,
            coloured=coloured_deviation * normals[p.axes :],
            drift_deviation=drift_deviation,
            coloured_step=self.sampling.coloured * coloured_deviation,
            white_step=xp.sqrt(white_intensity * p.step + self.sampling.residual * coloured_deviation**2),
            receiver_levels=xp.stack(levels),
            reported_levels=xp.stack(reported),
            change=xp.stack([earlier, later]),
            outage=self._window("outage", uniforms[11:14]),
            jamming=self._window("jamming", uniforms[14:17]),
            spoofing=self._window("spoofing", uniforms[17:20]),
            deviation=levels[0],
            ins=reference,
            increment=zeros,
            measurement=reference,
            available=ones,
            reported=reported[0],
            position=each + reference,
            variance=each[:, :1] if bank else each,
            rate=xp.stack([zeros, zeros])[: 2 if bank else 0],
            rest=xp.stack([x * ones for x in (0.0, 0.0, *start)]) if bank else uniforms[:0],
            innovation=each,
            normalised=each,
            average=each,
            average_square=each + 1.0,
            average_product=each,
            estimate=reference,
            estimate_covariance=self.diagonal(zeros),
            action=each[:, 0] if bank else zeros,
            gain=zeros[:0] if bank else zeros,
        )

    def _clock_of(self, time: Array) -> Array:
        """Return the measurement nearest to a time."""
        return self.xp.round(time / self.parameters.step)

    def _window(self, name: str, uniforms: Array) -> Array:
        """First measurement of a disturbance and first one after it, ``(2, N)``."""
        p, xp = self.parameters, self.xp
        presence, start, length = (uniforms[i] for i in range(3))
        first = self._clock_of(_uniform(start, getattr(p, f"{name}_start")))
        beyond = first + self._clock_of(_uniform(length, getattr(p, f"{name}_duration")))
        happens = presence < getattr(p, f"{name}_probability")
        return xp.stack([xp.where(happens, first, NEVER), xp.where(happens, beyond, NEVER)])

    def measure(self, state: LooselyCoupledNavigationState, noise: Array) -> LooselyCoupledNavigationState:
        """Move the truth, read the instruments, predict all filters; noise: coloured, white, receiver."""
        return self.predict(self.sense(state, noise))

    def sense(self, state: LooselyCoupledNavigationState, noise: Array) -> LooselyCoupledNavigationState:
        """Move the truth by one step and read INS and receiver; the only place where the truth is used."""
        p, xp, s, n = self.parameters, self.xp, self.sampling, self.parameters.axes
        clock = state.clock + 1.0
        kick = state.coloured_step * noise[:n]
        slip = s.step * state.drift + s.drive * state.coloured + s.coupling * kick
        reference = p.reference_amplitude * xp.sin((p.reference_rate * p.step) * clock + self._phase)
        increment = (reference - state.reference) + (slip + state.white_step * noise[n : 2 * n])

        deviation, reported = state.receiver_levels[0], state.reported_levels[0]
        available = state.available
        if p.noise_changes[1]:
            changed, again = clock >= state.change[0], clock >= state.change[1]
            deviation, reported = (
                xp.where(again, levels[2], xp.where(changed, levels[1], levels[0]))
                for levels in (state.receiver_levels, state.reported_levels)
            )
        if p.jamming_probability:
            louder = math.sqrt(p.jamming_factor) * deviation
            deviation = xp.where(within(clock, state.jamming), louder, deviation)
        measurement = reference + deviation * noise[2 * n : 3 * n]
        if p.spoofing_probability:
            pull = (p.spoofing_rate * p.step) * (clock - state.spoofing[0] + 1.0)
            measurement = measurement + xp.where(within(clock, state.spoofing), pull, 0.0)
        if p.outage_probability:
            available = xp.where(within(clock, state.outage), 0.0, xp.ones_like(clock))
            measurement = available * measurement
        return state._replace(
            clock=clock,
            reference=reference,
            coloured=s.decay * state.coloured + kick,
            deviation=deviation,
            ins=state.ins + increment,
            increment=increment,
            measurement=measurement,
            available=available,
            reported=reported,
        )

    def predict(self, state: LooselyCoupledNavigationState) -> LooselyCoupledNavigationState:
        """Predict every filter by the INS increment and compare it with the measurement."""
        p, xp, s = self.parameters, self.xp, self.sampling
        position = state.position + state.increment
        rate, rest = state.rate, state.rest
        if self.control == "gain":
            variance = state.variance + self.growth[1]
        else:
            corrected = position[2] - (s.step * rate[0] + s.drive * rate[1])
            position = xp.concat([position[:2], corrected[None]])
            rate = xp.stack([rate[0], s.decay * rate[1]])
            P = ins_gnss.predict_augmented(
                ins_gnss.AugmentedCovariance(state.variance[2, 0], *(rest[i] for i in range(5))),
                s,
                *self.modelled_growth,
            )
            variance = xp.concat([state.variance[:2] + self._plain_growth, P.position[None, None]])
            rest = xp.stack(P[1:])

        innovation = state.measurement - position
        if p.outage_probability:
            innovation = state.available * innovation
        normalised = innovation / xp.sqrt(variance + state.reported * state.reported)
        rate_of_average = self._forgetting * state.available
        product = normalised * state.normalised
        previous = normalised
        if p.outage_probability:
            previous = xp.where(state.available > 0.0, normalised, state.normalised)
        return state._replace(
            position=position,
            variance=variance,
            rate=rate,
            rest=rest,
            innovation=innovation,
            normalised=previous,
            average=state.average + rate_of_average * (normalised - state.average),
            average_square=state.average_square
            + rate_of_average * (normalised * normalised - state.average_square),
            average_product=state.average_product + rate_of_average * (product - state.average_product),
        )

    def observe(self, state: LooselyCoupledNavigationState) -> Array:
        """Show innovations, their averages, the instruments, the last action and the time."""
        p, xp = self.parameters, self.xp
        rows = (self._count * p.axes, state.clock.shape[-1])
        time = p.step * state.clock
        blocks = [
            state.available * state.normalised,
            signed_logarithm(state.innovation / state.reported, xp),
            state.average,
            xp.log(1.0 + state.average_square),
            state.average_product,
        ]
        return xp.concat(
            [
                *(xp.reshape(block, rows) for block in blocks),
                xp.log(state.reported / math.sqrt(p.receiver_variance))[None],
                state.available[None],
                state.action,
                (time / (time + p.correlation_time))[None],
            ]
        )

    def act(self, state: LooselyCoupledNavigationState, action: Array) -> LooselyCoupledNavigationState:
        """Update the filters and report what the action chooses."""
        if self.control == "gain":
            return self._act_by_gain(state, self.xp.clip(action, -1.0, 1.0))
        return self._act_by_weights(state, action)

    def _act_by_gain(
        self, state: LooselyCoupledNavigationState, action: Array
    ) -> LooselyCoupledNavigationState:
        """Update the steered filter by the gain of the action."""
        gain = state.available * self.gain_of_action(action)
        estimate = state.position[0] + gain * state.innovation[0]
        variance = ins_gnss.update_variance(state.variance[0], state.reported * state.reported, gain)
        return state._replace(
            position=estimate[None],
            variance=variance[None],
            estimate=estimate,
            estimate_covariance=self.diagonal(variance),
            action=action,
            gain=gain,
        )

    def _act_by_weights(
        self, state: LooselyCoupledNavigationState, action: Array
    ) -> LooselyCoupledNavigationState:
        """Update the bank, each filter by its own Kalman gain, and combine it by the weights."""
        xp = self.xp
        R = state.reported * state.reported
        plain = state.variance[:2]
        plain_gain = state.available * plain / (plain + R)
        P = ins_gnss.AugmentedCovariance(state.variance[2, 0], *(state.rest[i] for i in range(5)))
        gain, P = ins_gnss.update_augmented(P, R, state.available)
        innovation = state.innovation
        position = xp.concat(
            [
                state.position[:2] + plain_gain * innovation[:2],
                (state.position[2] + gain.position * innovation[2])[None],
            ]
        )
        # The innovation of the position is minus that of the INS error delta.
        rate = xp.stack(
            [state.rate[0] - gain.drift * innovation[2], state.rate[1] - gain.coloured * innovation[2]]
        )
        variance = xp.concat(
            [ins_gnss.update_variance(plain, R, plain_gain), xp.reshape(P.position, (1, 1, -1))]
        )
        # Neither control asks for likelihoods, only for the shape of the bank.
        bank = xp.zeros_like(innovation[:, 0])
        weights = bank_probabilities(self.control, action, bank, bank, 0.0, xp)
        estimate, covariance = imm.combine(
            xp.moveaxis(position, 0, 1), self._eye[..., None] * variance[:, 0], weights
        )
        return state._replace(
            position=position,
            variance=variance,
            rate=rate,
            rest=xp.stack(P[1:]),
            estimate=estimate,
            estimate_covariance=covariance,
            action=weights,
        )

    def cost(self, state: LooselyCoupledNavigationState) -> Array:
        """Squared error of position, summed over the axes, over the nominal variance of a measurement."""
        error = state.estimate - state.reference
        total = error[0] * error[0]
        for i in range(1, error.shape[0]):
            total = total + error[i] * error[i]
        return total / self.parameters.receiver_variance

    def error(self, state: LooselyCoupledNavigationState) -> Array:
        """Estimate minus reference, ``(axes, N)``, m."""
        return state.estimate - state.reference

    def covariance(self, state: LooselyCoupledNavigationState) -> Array:
        """Reported covariance, ``(axes, axes, N)``, m^2; under gain blind to a constant drift."""
        return state.estimate_covariance

    def records(self, state: LooselyCoupledNavigationState) -> dict[str, Array]:
        """NIS (NaN without a measurement), gain and K, or the weights; noise levels.

        In a bank the NIS is the mean over its filters by the weights in force: that of the filter believed.
        """
        p, xp = self.parameters, self.xp
        squares = state.normalised * state.normalised
        nis = squares[:, 0]
        for i in range(1, p.axes):
            nis = nis + squares[:, i]
        if self.control == "gain":
            found = {}
            for i, axis in enumerate(("",) if p.axes == 1 else AXES[: p.axes]):
                suffix = axis and f"_{axis}"
                found[f"gain{suffix}"] = state.gain[i]
                found[f"gain_rate{suffix}"] = state.gain[i] / p.step
            nis = nis[0]
        else:
            found = {"mode_probability": state.action}
            nis = state.action[0] * nis[0] + state.action[1] * nis[1] + state.action[2] * nis[2]
        found["nis"] = xp.where(state.available > 0.0, nis, math.nan)
        found["available"] = state.available
        found["receiver_deviation"] = state.deviation
        found["reported_deviation"] = state.reported
        return found


def _uniform(u: Array, interval: tuple[float, float]) -> Array:
    """Stretch uniform numbers to an interval."""
    return interval[0] + (interval[1] - interval[0]) * u


def _log_uniform(u: Array, interval: tuple[float, float], xp: Any) -> Array:
    """Stretch uniform numbers to an interval whose logarithm is uniform."""
    return interval[0] * xp.exp(math.log(interval[1] / interval[0]) * u)


def within(clock: Array, window: Array) -> Array:
    """Whether the clock stands in a window, ``(N,)``."""
    return (clock >= window[0]) & (clock < window[1])


TASK = LooselyCoupledNavigation
