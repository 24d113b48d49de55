"""ManeuveringTarget: a radar track of an aircraft that turns, with alpha-beta filters of adjustable gain.

Source: P. A. Bakulev, M. I. Sychev and Nguyen Trong Luu, "Tracking a manoeuvring target with an IMM
algorithm over two alpha-beta filters" (in Russian). Equation numbers are theirs as far as they print them;
the mathematics stands in ``filters/alpha_beta.py``, ``filters/imm.py`` and ``filters/polar.py``.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium
import numpy

from ...filters import alpha_beta, imm, polar
from ...filters.gaussian import log_density
from .. import parameters as check
from ..controls import bank_action_space, bank_probabilities, signed_logarithm
from ..task import Array, Component, Field, NoiseLayout, PaperPolicy, Scenario, Task
from ..trajectory import Trajectory, flown_legs
from .scenarios import SCENARIOS

SCANS_SHOWN = 20
"""The clock in the observation saturates here: a filter has settled after about ten scans."""

FARTHEST_RANGE = 500e3
"""Metres; a user's trajectory beyond this is taken for a mistake of units."""


@dataclass(frozen=True)
class ManeuveringTargetParameters:
    """Every constant of the task; each is a keyword of ``gym.make``."""

    sampling_interval: float = 6.0
    """Scan period T, s (paper)."""
    horizon: int = 100
    """Scans acted on in one episode (paper: the axis of its figure 5)."""
    decision_interval: int = 1
    """Scans for which one action holds."""
    range_sigma: float = 100.0
    """Standard deviation of the range, m (paper)."""
    bearing_sigma: float = 0.25
    """Standard deviation of the azimuth, degrees (paper)."""
    polar_measurements: bool = False
    """False: independent errors along x and y with variances (22), (23) (paper). True: errors of range and
    azimuth, converted to x and y."""
    gains: tuple[float, ...] = (0.3, 0.7)
    """Position gains alpha of the bank's filters (paper)."""
    transition: tuple[tuple[float, ...], ...] = ((0.9, 0.1), (0.1, 0.9))
    """Mode transition probabilities, row = from, column = to (paper)."""
    initial_probabilities: tuple[float, ...] = (0.5, 0.5)
    """Mode probabilities at the start (paper)."""
    alpha_range: tuple[float, float] = (0.05, 0.95)
    """Position gain at action -1 and +1 of control ``gain`` (ours: stable, and wide enough for the best
    schedule that knows the manoeuvre, which uses 0.07 to 0.88)."""
    evidence_scale: float = 4.0
    """Nats that an evidence of one adds to a mode's log-posterior (ours)."""
    averaging_scans: float = 5.0
    """Time constant of the exponential averages in the observation, scans (ours)."""
    flight: str = "random"
    """"maneuver": one manoeuvre at stated scans (paper). "random": drawn for each episode. "legs": straight
    legs and exact turns. "track": a table of states."""
    initial_position: tuple[float, float] = (-10000.0, 5000.0)
    """x and y at the start, m, of flights "maneuver" and "legs" (paper)."""
    initial_velocity: tuple[float, float] = (100.0, 0.0)
    """m/s (paper)."""
    acceleration: tuple[float, float] = (-2.775, -2.775)
    """Acceleration during the manoeuvre of flight "maneuver", m/s^2 (paper)."""
    maneuver_steps: tuple[int, int] = (50, 55)
    """First and last scan that carry it. Reading: x(k) = F x(k-1) + B w(k) with w at k = 50 to 55, six
    steps, because five would not turn the velocity by 90 degrees."""
    legs: tuple[tuple[float, float], ...] = ()
    """Duration (s) and turn rate (deg/s) of each leg of flight "legs"."""
    track: tuple[tuple[float, ...], ...] = ()
    """Rows x, y, vx, vy, each with horizon + 2 values one scan apart, of flight "track"."""
    start_range: tuple[float, float] = (5e3, 60e3)
    """Limits of the range at the start of a random flight, m (ours)."""
    speed: tuple[float, float] = (60.0, 300.0)
    """Limits of the speed at its start, m/s (ours)."""
    maneuver_count: tuple[int, int] = (0, 3)
    """Limits of the number of its manoeuvres (ours)."""
    maneuver_duration: tuple[int, int] = (3, 12)
    """Limits of their duration, scans (ours)."""
    maneuver_acceleration: tuple[float, float] = (0.5, 6.0)
    """Limits of their acceleration, m/s^2 (ours)."""

    def __post_init__(self) -> None:
        check.number("sampling_interval", self.sampling_interval, above=0.0)
        check.integer("horizon", self.horizon, at_least=1)
        check.number("range_sigma", self.range_sigma, above=0.0)
        check.number("bearing_sigma", self.bearing_sigma, above=0.0, below=90.0)
        check.numbers("gains", self.gains, above=0.0, below=1.0)
        modes = len(self.gains)
        if modes < 2:
            raise ValueError(f"gains must name at least two filters, got {self.gains!r}")
        check.stochastic_matrix("transition", self.transition, modes)
        check.stochastic_matrix("initial_probabilities", (self.initial_probabilities,), 1, modes)
        check.interval("alpha_range", self.alpha_range, above=0.0, below=1.0)
        check.number("evidence_scale", self.evidence_scale, above=0.0)
        check.number("averaging_scans", self.averaging_scans, at_least=1.0)
        check.choice("flight", self.flight, ("maneuver", "random", "legs", "track"))
        check.numbers("initial_position", self.initial_position, 2)
        check.numbers("initial_velocity", self.initial_velocity, 2)
        check.numbers("acceleration", self.acceleration, 2)
        check.interval("maneuver_steps", self.maneuver_steps, at_least=1)
        check.interval("start_range", self.start_range, above=0.0)
        check.interval("speed", self.speed, above=0.0)
        check.interval("maneuver_count", self.maneuver_count, at_least=0)
        check.interval("maneuver_duration", self.maneuver_duration, at_least=1)
        check.interval("maneuver_acceleration", self.maneuver_acceleration, at_least=0.0)
        for i, leg in enumerate(self.legs):
            check.numbers(f"legs[{i}]", leg, 2)
            check.number(f"legs[{i}][0]", leg[0], above=0.0)
        if self.flight == "legs" and not self.legs:
            raise ValueError('flight "legs" needs at least one leg (duration in s, turn rate in deg/s)')
        if self.flight == "track":
            if len(self.track) != 4:
                raise ValueError(f"track must have the four rows x, y, vx, vy, got {len(self.track)} rows")
            for row, name in zip(self.track, ("x", "y", "vx", "vy"), strict=True):
                check.numbers(f"track {name}", row, self.horizon + 2)


class Maneuvers(NamedTuple):
    """Manoeuvres of a flight: what each adds in every scan from its first to its last."""

    first: Array
    """Scan number, ``(manoeuvres, N)``."""
    last: Array
    """Scan number, included, ``(manoeuvres, N)``."""
    effect: Array
    """``(6, manoeuvres, N)``: the four of a turn and the two of thrust, as the properties below name them; one
    array, because the truth picks from all of them in every scan."""

    @property
    def velocity_along(self) -> Array:
        """Velocity added per velocity: cos(theta) - 1 of a turn by theta, ``(manoeuvres, N)``."""
        return self.effect[0]

    @property
    def velocity_across(self) -> Array:
        """Velocity added per velocity turned by +90 degrees: sin(theta)."""
        return self.effect[1]

    @property
    def position_along(self) -> Array:
        """Displacement added per velocity, s."""
        return self.effect[2]

    @property
    def position_across(self) -> Array:
        """Displacement added per turned velocity, s."""
        return self.effect[3]

    @property
    def acceleration(self) -> Array:
        """Acceleration of thrust, m/s^2, ``(2, manoeuvres, N)``."""
        return self.effect[4:]


class AlphaBeta(NamedTuple):
    """One alpha-beta filter with the covariance that belongs to the gains it used."""

    position: Array
    """m, ``(2, N)``; predicted after ``measure``, estimated after ``act``."""
    velocity: Array
    """m/s, ``(2, N)``."""
    covariance: alpha_beta.Covariance
    """Of each coordinate, ``(2, N)`` each; x and y are uncorrelated."""
    innovation: Array
    """m, ``(2, N)``."""
    innovation_variance: Array
    """m^2, ``(2, N)``."""
    average_innovation: Array
    """Exponential average of the normalised innovations, ``(2, N)``."""
    log_squared: Array
    """log(1 + normalised innovation squared), ``(N,)``."""
    average_log_squared: Array
    """Its exponential average, ``(N,)``."""
    alpha: Array
    """Gain used last, ``(N,)``."""


class Bank(NamedTuple):
    """M alpha-beta filters of fixed gains, mixed on their weights before every prediction."""

    mean: Array
    """x, y, vx, vy of each filter, ``(4, M, N)``."""
    covariance: Array
    """``(4, 4, M, N)``."""
    probabilities: Array
    """Weights in force, ``(M, N)``."""
    log_predicted: Array
    """Logarithm of the predicted mode probabilities (13), ``(M, N)``."""
    innovation: Array
    """m, ``(2, M, N)``."""
    innovation_covariance: Array
    """m^2, ``(2, 2, M, N)``."""
    log_likelihood: Array
    """Logarithm of (11), ``(M, N)``."""
    average_innovation: Array
    """``(2, M, N)``."""
    log_squared: Array
    """``(M, N)``."""
    average_log_squared: Array
    """``(M, N)``."""


class Outside(NamedTuple):
    """An estimate that a reference estimator has put in place of the filter's."""

    mean: Array
    """``(4, N)``."""
    covariance: Array
    """``(4, 4, N)``."""


class State(NamedTuple):
    """Truth, measurement and estimator of N episodes."""

    scan: Array
    """Number of the current scan, ``(N,)``."""
    position: Array
    """True position, m, ``(2, N)``."""
    velocity: Array
    """True velocity, m/s, ``(2, N)``."""
    maneuvers: Maneuvers | None
    """None where the flight is a table."""
    measurement: Array
    """m, ``(2, N)``."""
    variance: Array
    """Variance of the measurement evaluated at the measured position, m^2, ``(2, N)``."""
    estimator: AlphaBeta | Bank | Outside


class ManeuveringTarget(Task[State]):
    """Radar tracking of an aircraft that manoeuvres, with fixed-gain filters (Bakulev, Sychev, Nguyen).

    ## Description

    A surveillance radar scans every 6 s and measures the position of one aircraft with errors of 100 m in
    range and 0.25 degrees in azimuth. The aircraft flies straight, sometimes turns or changes speed, and
    flies straight again. A small filter gain is quiet on the straight legs and lags far behind in a
    manoeuvre; a large gain follows and is noisy. The agent sees the innovations of the filter and sets its
    gain, or the weights of two filters of different gain that mix on those weights as in the interacting
    multiple model (IMM). The paper's algorithm is the IMM; zero ``evidence`` is exactly it.

    ## Action Space

    | control | space | meaning |
    |---|---|---|
    | `gain` (default) | `Box(-1, 1, (1,))` | position gain alpha of one filter, linear over `alpha_range`; 0 is alpha = 0.5; beta = alpha^2 / (2 - alpha) |
    | `mode` | `Discrete(2)` | the filter of the bank that is believed; the bank collapses to one filter that switches |
    | `weights` | `Box(0, 1, (2,))` | weights of the bank, normalised; all zero is uniform |
    | `evidence` | `Box(-1, 1, (2,))` | times `evidence_scale` nats, added to the log-posterior of each mode; 0 is the IMM |

    Values outside the box are taken at its edge.

    ## Observation Space

    A flat `Box` of float64; `env.unwrapped.observation_fields` lists name, unit and scale of every component.
    `gain`: innovations over their predicted sigma, log(1 + normalised innovation squared), exponential
    averages of both, the share 1 - R/S of the innovation variance that is the filter's own, the last alpha,
    the measurement sigma, scans since the start. Bank: the same for each filter, log-likelihoods relative to
    the largest, log predicted mode probabilities, last weights. Large values are compressed by
    sign(x) log(1 + |x|).

    ## Rewards

    Minus the squared position error over `range_sigma` squared, linear in the error beyond 60 sigma.

    ## Starting State

    The track starts at the true state plus errors of the measurement's size: sigma in position and
    sqrt(2) sigma / T in velocity, the same for all filters (24).

    ## Episode End

    Truncation after `horizon` scans; there is no termination.

    ## Arguments

    Every field of `ManeuveringTargetParameters` is a keyword of `gym.make`, beside `control`, `scenario`,
    `reward` and `render_mode`.

    ## Version History

    * v0: first release
    """

    id = "filtergym/ManeuveringTarget-v0"
    paper_source = (
        "P. A. Bakulev, M. I. Sychev, Nguyen Trong Luu, Tracking a manoeuvring target with an IMM algorithm "
        "over two alpha-beta filters (in Russian)"
    )
    controls = ("gain", "mode", "weights", "evidence")
    Parameters = ManeuveringTargetParameters
    scenarios = SCENARIOS
    components = (
        Component("position_x", "m"),
        Component("position_y", "m"),
        Component("velocity_x", "m/s"),
        Component("velocity_y", "m/s"),
    )
    groups = {"position": ("position_x", "position_y"), "velocity": ("velocity_x", "velocity_y")}
    cost_description = "squared position error over the squared range sigma"
    huber_bound = 60.0
    paper_policy = PaperPolicy("evidence", (0.0, 0.0))

    parameters: ManeuveringTargetParameters

    def picture(self) -> Any:
        """Return what draws an episode; imported here, because it brings matplotlib."""
        from .picture import PICTURE

        return PICTURE(self)

    def __init__(
        self,
        parameters: ManeuveringTargetParameters,
        control: str,
        xp: ModuleType = numpy,
        device: Any = None,
    ) -> None:
        super().__init__(parameters, control, xp, device)
        p = parameters
        self.T = p.sampling_interval
        self.bearing_sigma = math.radians(p.bearing_sigma)
        self.forgetting = math.exp(-1.0 / p.averaging_scans)
        self.bank_alpha = self.constant(p.gains)[:, None]
        self.bank_beta = alpha_beta.benedict_bordner_beta(self.bank_alpha)
        self.transition = self.constant(p.transition)
        self.modes = tuple(f"mode_{j + 1}" for j in range(len(p.gains)))
        self.paper_policy = PaperPolicy("evidence", (0.0,) * len(p.gains))
        self.slots = {"maneuver": 1, "random": p.maneuver_count[1], "legs": 0, "track": 0}[p.flight]
        uniforms = 5 + 5 * self.slots if p.flight == "random" else 0
        self.noise = NoiseLayout(uniforms=uniforms, initial_normals=4, normals=2)
        self.table: Array = None
        if p.flight == "legs":
            self.table = self.constant(
                flown_legs(p.initial_position, p.initial_velocity, p.legs, self.T, p.horizon + 2)
            )
        elif p.flight == "track":
            self.table = self.constant(p.track)
        if control == "gain":
            self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), numpy.float32)
            self.fields = self._gain_fields()
        else:
            self.action_space = bank_action_space(control, len(p.gains))
            self.fields = self._bank_fields()

    @classmethod
    def scenario_from_trajectory(cls, trajectory: Trajectory, keywords: Mapping[str, Any]) -> Scenario:
        """Fly a user's trajectory, sampled once a scan and straight on beyond its end."""
        interval = keywords.get("sampling_interval", ManeuveringTargetParameters.sampling_interval)
        check.number("sampling_interval", interval, above=0.0)
        farthest = float(numpy.hypot(*trajectory.position.T).max())
        if farthest > FARTHEST_RANGE:
            raise ValueError(
                f"trajectory {trajectory.name!r} goes {farthest / 1e3:,.0f} km from the radar at the origin; "
                f"its range ends at {FARTHEST_RANGE / 1e3:,.0f} km (positions are metres)"
            )
        scans = int(trajectory.duration / interval + 1e-9)
        if scans < 2:
            raise ValueError(
                f"trajectory {trajectory.name!r} lasts {trajectory.duration:g} s, which is less than two scans "
                f"of {interval:g} s: give a smaller sampling_interval"
            )
        horizon = keywords.get("horizon", scans)
        track = trajectory.resampled(interval, horizon + 2)
        return Scenario(
            trajectory.name,
            "A flight given by its positions.",
            {"flight": "track", "horizon": horizon, "track": tuple(map(tuple, track.tolist()))},
        )

    # --- what the agent is shown

    def _gain_fields(self) -> tuple[Field, ...]:
        average = f"exponential average over {self.parameters.averaging_scans:g} scans"
        return (
            *(Field(f"innovation_{a}", "1", "over its predicted sigma, signed log") for a in "xy"),
            Field("log_squared_innovation", "1", "log(1 + normalised innovation squared)"),
            *(Field(f"average_innovation_{a}", "1", f"{average}, signed log") for a in "xy"),
            Field("average_log_squared_innovation", "1", average),
            *(Field(f"prior_share_{a}", "1", "1 - R/S: the filter's share of the innovation") for a in "xy"),
            Field("last_alpha", "1", "position gain used last"),
            *(
                Field(f"log_measurement_sigma_{a}", "1", "log of the measurement's sigma over range_sigma")
                for a in "xy"
            ),
            Field("scan", "1", f"scans since the start over {SCANS_SHOWN}, saturating at 1"),
        )

    def _bank_fields(self) -> tuple[Field, ...]:
        average = f"exponential average over {self.parameters.averaging_scans:g} scans"

        def each(name: str, description: str) -> list[Field]:
            return [Field(f"{name}_{j + 1}", "1", description) for j in range(len(self.modes))]

        return (
            *each("innovation_x", "of the filter over its predicted sigma, signed log"),
            *each("innovation_y", "of the filter over its predicted sigma, signed log"),
            *each("log_squared_innovation", "log(1 + normalised innovation squared)"),
            *each("average_innovation_x", f"{average}, signed log"),
            *each("average_innovation_y", f"{average}, signed log"),
            *each("average_log_squared_innovation", average),
            *each("log_likelihood", "minus the largest one, nats, signed log"),
            *each("log_predicted", "log of the predicted mode probability, signed log"),
            *each("last_weight", "weight in force before this scan"),
            *(
                Field(f"log_measurement_sigma_{a}", "1", "log of the measurement's sigma over range_sigma")
                for a in "xy"
            ),
            Field("scan", "1", f"scans since the start over {SCANS_SHOWN}, saturating at 1"),
        )

    def observe(self, state: State) -> Array:
        """Show innovations, their averages, and the clock; see ``fields``."""
        xp, estimator = self.xp, state.estimator
        log_sigma = 0.5 * xp.log(state.variance / self.parameters.range_sigma**2)
        clock = xp.clip(state.scan * (1.0 / SCANS_SHOWN), None, 1.0)[None]
        if isinstance(estimator, AlphaBeta):
            sigma = xp.sqrt(estimator.innovation_variance)
            innovations = xp.concat([estimator.innovation / sigma, estimator.average_innovation])
            innovations = signed_logarithm(innovations, xp)
            return xp.concat(
                [
                    innovations[:2],
                    estimator.log_squared[None],
                    innovations[2:],
                    estimator.average_log_squared[None],
                    1.0 - state.variance / estimator.innovation_variance,
                    estimator.alpha[None],
                    log_sigma,
                    clock,
                ]
            )
        assert isinstance(estimator, Bank)
        sigma = xp.stack([xp.sqrt(estimator.innovation_covariance[i, i]) for i in range(2)])
        relative = estimator.log_likelihood - xp.max(estimator.log_likelihood, axis=0)
        normalised, average = estimator.innovation / sigma, estimator.average_innovation
        compressed = signed_logarithm(
            xp.concat(
                [normalised[0], normalised[1], average[0], average[1], relative, estimator.log_predicted]
            ),
            xp,
        )
        m = len(self.modes)
        return xp.concat(
            [
                compressed[: 2 * m],
                estimator.log_squared,
                compressed[2 * m : 4 * m],
                estimator.average_log_squared,
                compressed[4 * m :],
                estimator.probabilities,
                log_sigma,
                clock,
            ]
        )

    # --- the flight

    def begin(self, uniforms: Array, normals: Array) -> State:
        """Draw the flight and start all filters from one erroneous state, equation (24)."""
        xp, p = self.xp, self.parameters
        ones = xp.ones_like(normals[0])
        if p.flight == "random":
            position, velocity, maneuvers = self._random_flight(uniforms)
        elif self.table is not None:
            position = self.table[:2, 0, None] * ones
            velocity = self.table[2:, 0, None] * ones
            maneuvers = None
        else:
            position = self.constant(p.initial_position)[:, None] * ones
            velocity = self.constant(p.initial_velocity)[:, None] * ones
            once = ones[None]
            first, last = p.maneuver_steps
            effect = self.constant((0.0, 0.0, 0.0, 0.0, *p.acceleration))[:, None, None] * once
            maneuvers = Maneuvers(first * once, last * once, effect)
        sigma = xp.sqrt(polar.cartesian_variances(position, p.range_sigma, self.bearing_sigma))
        start = position + sigma * normals[:2]
        start_velocity = velocity + (math.sqrt(2.0) / self.T) * sigma * normals[2:]
        # The start is a measurement too: its variance is evaluated where it puts the target.
        variance = polar.cartesian_variances(start, p.range_sigma, self.bearing_sigma)
        return State(
            scan=0.0 * ones,
            position=position,
            velocity=velocity,
            maneuvers=maneuvers,
            measurement=start,
            variance=variance,
            estimator=self._started(start, start_velocity, variance, ones),
        )

    def _started(self, position: Array, velocity: Array, variance: Array, ones: Array) -> AlphaBeta | Bank:
        xp = self.xp
        velocity_variance = (2.0 / self.T**2) * variance
        zero = 0.0 * variance
        if self.control == "gain":
            covariance = alpha_beta.Covariance(variance, zero, velocity_variance)
            alpha = sum(self.parameters.alpha_range) / 2.0 * ones
            return AlphaBeta(position, velocity, covariance, zero, variance, zero, zero[0], zero[0], alpha)
        m = len(self.modes)
        mean = xp.concat([position, velocity])
        diagonal = xp.concat([variance, velocity_variance])
        identity = xp.eye(4, dtype=diagonal.dtype, device=diagonal.device)[:, :, None]
        covariance = identity * diagonal
        probabilities = self.constant(self.parameters.initial_probabilities)[:, None] * ones
        zeros = xp.stack([zero] * m, axis=1)
        return Bank(
            mean=xp.stack([mean] * m, axis=1),
            covariance=xp.stack([covariance] * m, axis=2),
            probabilities=probabilities,
            log_predicted=imm.log_probabilities(probabilities),
            innovation=zeros,
            innovation_covariance=xp.stack([covariance[:2, :2]] * m, axis=2),
            log_likelihood=zeros[0],
            average_innovation=zeros,
            log_squared=zeros[0],
            average_log_squared=zeros[0],
        )

    def _random_flight(self, uniforms: Array) -> tuple[Array, Array, Maneuvers]:
        """Draw a start and manoeuvres that do not overlap, each drawn as thrust or coordinated turn."""
        xp, p, T = self.xp, self.parameters, self.T

        def between(limits: tuple[float, float], u: Array) -> Array:
            return limits[0] + (limits[1] - limits[0]) * u

        def drawn_integer(limits: tuple[int, int], u: Array) -> Array:
            return limits[0] + xp.floor((limits[1] - limits[0] + 1) * u)

        azimuth, course = 2.0 * math.pi * uniforms[1], 2.0 * math.pi * uniforms[3]
        position = between(p.start_range, uniforms[0]) * xp.stack([xp.cos(azimuth), xp.sin(azimuth)])
        velocity = between(p.speed, uniforms[2]) * xp.stack([xp.cos(course), xp.sin(course)])
        count = drawn_integer(p.maneuver_count, uniforms[4])
        draws = xp.reshape(uniforms[5:], (5, self.slots, uniforms.shape[-1]))
        slot = xp.arange(self.slots, device=self.device)[:, None]
        flown = slot < count
        duration = xp.where(flown, drawn_integer(p.maneuver_duration, draws[0]), 0.0)
        # Sorted starts within the time that the manoeuvres leave free, each moved on by those before it.
        order = xp.sort(xp.where(flown, draws[1], 2.0), axis=0)
        busy = 0.0 * count
        for m in range(self.slots):
            busy = busy + duration[m]
        acceleration = between(p.maneuver_acceleration, draws[2])
        direction = 2.0 * math.pi * draws[3]
        coordinated = draws[4] < 0.5
        before = 0.0 * count
        columns: list[tuple[Array, ...]] = []
        now = velocity
        for m in range(self.slots):
            free = xp.clip(p.horizon - busy, 1.0, None)
            first = 1.0 + before + xp.floor(order[m] * free)
            before = before + duration[m]
            first = xp.where(flown[m], first, p.horizon + 10.0)
            speed = xp.clip(xp.sqrt(now[0] ** 2 + now[1] ** 2), 30.0, None)
            side = xp.where(direction[m] < math.pi, 1.0, -1.0)
            theta = xp.where(coordinated[m], side * acceleration[m] * (T / speed), 0.0)
            turning = xp.abs(theta) > 1e-9
            divisor = xp.where(turning, theta, 1.0)
            thrust = xp.where(coordinated[m], 0.0, acceleration[m])
            vector = thrust * xp.stack([xp.cos(direction[m]), xp.sin(direction[m])])
            columns.append(
                (
                    first,
                    first + duration[m] - 1.0,
                    xp.stack(
                        [
                            xp.cos(theta) - 1.0,
                            xp.sin(theta),
                            xp.where(turning, T * (xp.sin(theta) / divisor - 1.0), 0.0),
                            xp.where(turning, T * (1.0 - xp.cos(theta)) / divisor, 0.0),
                            vector[0],
                            vector[1],
                        ]
                    ),
                )
            )
            total = theta * duration[m]
            cosine, sine = xp.cos(total), xp.sin(total)
            turned = xp.stack([cosine * now[0] - sine * now[1], sine * now[0] + cosine * now[1]])
            now = turned + (T * duration[m]) * vector
        if not columns:
            empty = xp.reshape(uniforms[:0], (0, uniforms.shape[-1]))
            return position, velocity, Maneuvers(empty, empty, xp.stack([empty] * 6))
        first, last, effect = (xp.stack(parts, axis=-2) for parts in zip(*columns, strict=True))
        return position, velocity, Maneuvers(first, last, effect)

    def _fly(self, state: State, scan: Array) -> tuple[Array, Array]:
        """True position and velocity at the next scan."""
        xp, T = self.xp, self.T
        if state.maneuvers is None:
            last = int(self.table.shape[1]) - 1
            row = xp.clip(xp.astype(scan, xp.int64), None, last)
            return self.table[:2, row], self.table[2:, row]
        m = state.maneuvers
        position, velocity = state.position + T * state.velocity, state.velocity
        if not self.slots:
            return position, velocity
        active = xp.astype((scan >= m.first) & (scan <= m.last), state.position.dtype)
        # Manoeuvres do not overlap, so at most one term of the sum differs from zero.
        effects = active * m.effect
        effect = effects[:, 0]
        for slot in range(1, self.slots):
            effect = effect + effects[:, slot]
        acceleration = effect[4:]
        position = position + (0.5 * T**2) * acceleration
        velocity = velocity + T * acceleration
        if self.parameters.flight == "random":
            across = xp.stack([-state.velocity[1], state.velocity[0]])
            position = position + (effect[2] * state.velocity + effect[3] * across)
            velocity = velocity + (effect[0] * state.velocity + effect[1] * across)
        return position, velocity

    def measure(self, state: State, noise: Array) -> State:
        """Fly one scan, measure, and let the filters predict."""
        xp, p = self.xp, self.parameters
        scan = state.scan + 1.0
        position, velocity = self._fly(state, scan)
        if p.polar_measurements:
            radius = xp.sqrt(position[0] ** 2 + position[1] ** 2) + p.range_sigma * noise[0]
            azimuth = xp.atan2(position[1], position[0]) + self.bearing_sigma * noise[1]
            measurement = radius * xp.stack([xp.cos(azimuth), xp.sin(azimuth)])
        else:
            true_variance = polar.cartesian_variances(position, p.range_sigma, self.bearing_sigma)
            measurement = position + xp.sqrt(true_variance) * noise
        # The filters get the variances at the measured position: those at the true one would show it.
        variance = polar.cartesian_variances(measurement, p.range_sigma, self.bearing_sigma)
        if isinstance(state.estimator, AlphaBeta):
            estimator: Any = self._predict_filter(state.estimator, measurement, variance)
        elif isinstance(state.estimator, Bank):
            estimator = self._predict_bank(state.estimator, measurement, variance)
        else:
            estimator = state.estimator
        return State(scan, position, velocity, state.maneuvers, measurement, variance, estimator)

    # --- control "gain": one filter

    def _predict_filter(self, f: AlphaBeta, measurement: Array, variance: Array) -> AlphaBeta:
        xp = self.xp
        predicted = alpha_beta.predict(f.position, f.velocity, self.T)
        covariance = alpha_beta.predict_covariance(f.covariance, self.T)
        innovation = measurement - predicted
        S = covariance.position + variance
        normalised = innovation / xp.sqrt(S)
        squares = normalised * normalised
        log_squared = xp.log1p(squares[0] + squares[1])
        keep, take = self.forgetting, 1.0 - self.forgetting
        return AlphaBeta(
            predicted,
            f.velocity,
            covariance,
            innovation,
            S,
            keep * f.average_innovation + take * normalised,
            log_squared,
            keep * f.average_log_squared + take * log_squared,
            f.alpha,
        )

    def _alpha(self, action: Array) -> Array:
        low, high = self.parameters.alpha_range
        return 0.5 * (low + high) + (0.5 * (high - low)) * self.xp.clip(action[0], -1.0, 1.0)

    def action_for_alpha(self, alpha: Any) -> Any:
        """Action of control ``gain`` that sets a position gain; the gain must lie within ``alpha_range``."""
        low, high = self.parameters.alpha_range
        return (alpha - 0.5 * (low + high)) / (0.5 * (high - low))

    def _update_filter(self, f: AlphaBeta, variance: Array, alpha: Array) -> AlphaBeta:
        beta = alpha_beta.benedict_bordner_beta(alpha)
        position, velocity = alpha_beta.update(f.position, f.velocity, f.innovation, alpha, beta, self.T)
        covariance = alpha_beta.update_covariance(f.covariance, variance, alpha, beta, self.T)
        return f._replace(position=position, velocity=velocity, covariance=covariance, alpha=alpha)

    # --- controls "mode", "weights", "evidence": the bank

    def _predict_bank(self, bank: Bank, measurement: Array, variance: Array) -> Bank:
        xp = self.xp
        prediction = imm.predict_mode_probabilities(self.transition, bank.probabilities)
        mean, covariance = imm.mix(bank.mean, bank.covariance, prediction.mixing)
        mean = xp.concat([alpha_beta.predict(mean[:2], mean[2:], self.T), mean[2:]])
        covariance = alpha_beta.predict_joint_covariance(covariance, self.T)
        innovation = measurement[:, None] - mean[:2]
        identity = xp.eye(2, dtype=mean.dtype, device=mean.device)[:, :, None, None]
        S = covariance[:2, :2] + identity * variance[:, None]
        log_likelihood, squared = log_density(innovation, S)
        normalised = innovation / xp.sqrt(xp.stack([S[0, 0], S[1, 1]]))
        log_squared = xp.log1p(squared)
        keep, take = self.forgetting, 1.0 - self.forgetting
        return Bank(
            mean,
            covariance,
            bank.probabilities,
            imm.log_probabilities(prediction.probabilities),
            innovation,
            S,
            log_likelihood,
            keep * bank.average_innovation + take * normalised,
            log_squared,
            keep * bank.average_log_squared + take * log_squared,
        )

    def _update_bank(self, bank: Bank, variance: Array, probabilities: Array) -> Bank:
        xp = self.xp
        alpha, beta = self.bank_alpha, self.bank_beta
        position, velocity = alpha_beta.update(
            bank.mean[:2], bank.mean[2:], bank.innovation, alpha, beta, self.T
        )
        covariance = alpha_beta.update_joint_covariance(
            bank.covariance, variance[:, None], alpha, beta, self.T
        )
        return bank._replace(
            mean=xp.concat([position, velocity]), covariance=covariance, probabilities=probabilities
        )

    def act(self, state: State, action: Array) -> State:
        """Update with the gain of the action, or update the bank and put its weights in force."""
        estimator = state.estimator
        if isinstance(estimator, AlphaBeta):
            return state._replace(
                estimator=self._update_filter(estimator, state.variance, self._alpha(action))
            )
        assert isinstance(estimator, Bank)
        probabilities = bank_probabilities(
            self.control,
            action,
            estimator.log_predicted,
            estimator.log_likelihood,
            self.parameters.evidence_scale,
            self.xp,
        )
        return state._replace(estimator=self._update_bank(estimator, state.variance, probabilities))

    # --- how good the estimate is

    def _estimate(self, estimator: AlphaBeta | Bank | Outside) -> tuple[Array, Array]:
        """Reported position and velocity, ``(2, N)`` each."""
        if isinstance(estimator, AlphaBeta):
            return estimator.position, estimator.velocity
        if isinstance(estimator, Outside):
            return estimator.mean[:2], estimator.mean[2:]
        mean = estimator.probabilities[0] * estimator.mean[:, 0]
        for j in range(1, len(self.modes)):
            mean = mean + estimator.probabilities[j] * estimator.mean[:, j]
        return mean[:2], mean[2:]

    def cost(self, state: State) -> Array:
        """Squared position error over the squared range sigma."""
        position, _ = self._estimate(state.estimator)
        scaled = (position - state.position) * (1.0 / self.parameters.range_sigma)
        return scaled[0] * scaled[0] + scaled[1] * scaled[1]

    def error(self, state: State) -> Array:
        """Estimate minus truth: x, y (m) and their rates (m/s)."""
        position, velocity = self._estimate(state.estimator)
        return self.xp.concat([position - state.position, velocity - state.velocity])

    def covariance(self, state: State) -> Array:
        """Covariance that belongs to the gains used; of the bank, equation (16)."""
        xp, estimator = self.xp, state.estimator
        if isinstance(estimator, Outside):
            return estimator.covariance
        if isinstance(estimator, Bank):
            return imm.combine(estimator.mean, estimator.covariance, estimator.probabilities)[1]
        P = estimator.covariance
        zero = 0.0 * P.cross[0]
        entries = ((P.position, P.cross), (P.cross, P.velocity))
        return xp.stack(
            [
                xp.stack([entries[i // 2][j // 2][i % 2] if i % 2 == j % 2 else zero for j in range(4)])
                for i in range(4)
            ]
        )

    def records(self, state: State) -> dict[str, Array]:
        """Normalised innovation squared, the gain, and the weights of a bank."""
        xp, estimator = self.xp, state.estimator
        if isinstance(estimator, AlphaBeta):
            return {"nis": xp.expm1(estimator.log_squared), "alpha": estimator.alpha}
        if isinstance(estimator, Bank):
            predicted = xp.exp(estimator.log_predicted)
            innovation, S = imm.combine(estimator.innovation, estimator.innovation_covariance, predicted)
            return {"nis": log_density(innovation, S)[1], "mode_probability": estimator.probabilities}
        return {}


TASK = ManeuveringTarget
