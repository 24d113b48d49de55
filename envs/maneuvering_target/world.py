"""The flight of ManeuveringTarget, and the radar that measures it; equations in ``filters/polar.py``."""

import itertools
import math
from typing import NamedTuple

from ...filters import coordinated_turn, polar
from ...filters.ordered_sums import ordered_sum
from ..draws import Draws
from ..observation import Array
from ..task import Initial, Task, World
from .parameters import ManeuveringTargetParameters


class Maneuvers(NamedTuple):
    """Manoeuvres of a flight: what each adds in every scan from its first to its last."""

    first: Array
    """Scan number, ``(manoeuvres, N)``."""
    last: Array
    """Scan number, included, ``(manoeuvres, N)``."""
    effect: Array
    """``(6, manoeuvres, N)``: the four of a turn and the two of thrust, as the properties below name them; one
    array, because the truth picks from all of them in every scan."""
    turn: Array = None
    """Angle turned in a scan, rad, ``(manoeuvres, N)``; None where no scan comes early: the effect is all then."""

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


class Legs(NamedTuple):
    """A flight of straight legs and exact turns, each with what it begins with."""

    time: Array
    """s since the start of the track, ``(legs + 1, N)``; the last one is straight and never ends."""
    turn: Array
    """Turn rate, rad/s, anticlockwise positive, ``(legs + 1, N)``."""
    position: Array
    """m, ``(legs + 1, 2, N)``."""
    velocity: Array
    """m/s, ``(legs + 1, 2, N)``."""


class Tracks(NamedTuple):
    """Which of several flights in a table is flown."""

    number: Array
    """``(N,)``, as a float; likewise the columns of its first and last state."""
    first: Array
    last: Array


class Scans(NamedTuple):
    """A radar that may miss the target and come early."""

    detection_probability: Array
    """``(N,)``."""
    jitter: Array
    """Share of the scan period by which scans come early at most, ``(N,)``."""
    early: Array
    """That of the current scan, ``(N,)``."""
    unseen: Array
    """s since the last scan that saw the target, zero if the current one does, ``(N,)``."""
    position: Array
    """When the current scan would have come on time, m, ``(2, N)``; likewise the velocity, m/s."""
    velocity: Array


class Truth(NamedTuple):
    """The aircraft."""

    scan: Array
    """Number of the current scan, ``(N,)``."""
    position: Array
    """At its time, m, ``(2, N)``."""
    velocity: Array
    """m/s, ``(2, N)``."""
    maneuvers: Maneuvers | Legs | Tracks | None
    """None where the flight is a table of one."""
    scans: Scans | None = None
    """None where every scan sees the target and none comes early."""


class Measurement(NamedTuple):
    """What the radar says in a scan."""

    scan: Array
    """Scans since the start of the track, ``(N,)``."""
    position: Array
    """x and y, m, ``(2, N)``; zero in a scan that missed the target, where an estimator gets NaN."""
    variance: Array
    """Variances of their errors, evaluated at the measured position, m^2, ``(2, N)``; ``range_sigma`` squared in a scan
    that missed the target. Reading: those at the true position would show it."""
    available: Array
    """1 if the scan saw the target, 0 if not, ``(N,)``."""
    interval: Array
    """s since the scan before, ``(N,)``."""
    elapsed: Array
    """s since the last scan that saw the target, or the start of the track, ``(N,)``: the interval, unless that before
    missed it."""


class RadarWorld(World[Task, Truth, Measurement]):
    """An aircraft and a surveillance radar at the origin."""

    parameters: ManeuveringTargetParameters
    initial_normals = 4
    normals = 2

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        p = self.parameters
        self.row_uniforms = (0 if p.regular else 2) + (1 if p.glint_probability else 0)
        """Of a scan that may miss the target or come early, what decides both; then what decides on glint."""
        self.bearing_sigma = math.radians(p.bearing_sigma)
        self.slots = {"maneuver": 1, "random": p.maneuver_count[1], "legs": 0, "track": 0}[p.flight]
        """Manoeuvres that a flight may have."""
        self.table: Array = None
        """Rows x, y, vx, vy of a flight that is a table, ``(4, horizon + 2)``."""
        if p.flight == "track":
            self.table = task.constant(p.track)
        self.track_ends = [0, *itertools.accumulate(scans + 2 for scans in p.track_scans)]
        """Columns of the table at which flights begin, and its width."""

    def begin(self, draws: Draws, normals: Array) -> tuple[Truth, Initial]:
        """Draw the flight; the track starts with errors of the measurement's size, equation (24)."""
        xp, p, constant = self.xp, self.parameters, self.task.constant
        ones = xp.ones_like(normals[0])
        maneuvers: Maneuvers | Legs | Tracks | None
        if p.flight == "random":
            position, velocity, maneuvers = self._random_flight(draws)
        elif p.flight == "legs":
            maneuvers = self._drawn_legs(draws, ones)
            position, velocity = maneuvers.position[0], maneuvers.velocity[0]
        elif self.table is not None and p.track_scans:
            number = draws.integer("flight", (0, len(p.track_scans) - 1))
            row = xp.astype(number, xp.int64)
            first, last = constant(self.track_ends[:-1])[row], constant(self.track_ends[1:])[row] - 1.0
            position, velocity = self._states(first)
            maneuvers = Tracks(number, first, last)
        elif self.table is not None:
            position = self.table[:2, 0, None] * ones
            velocity = self.table[2:, 0, None] * ones
            maneuvers = None
        else:
            position = constant(p.initial_position)[:, None] * ones
            velocity = constant(p.initial_velocity)[:, None] * ones
            once = ones[None]
            first, last = p.maneuver_steps
            effect = constant((0.0, 0.0, 0.0, 0.0, *p.acceleration))[:, None, None] * once
            maneuvers = Maneuvers(first * once, last * once, effect, None if p.regular else 0.0 * once)
        sigma = xp.sqrt(polar.cartesian_variances(position, p.range_sigma, self.bearing_sigma))
        start = position + sigma * normals[:2]
        start_velocity = velocity + (math.sqrt(2.0) / p.sampling_interval) * sigma * normals[2:]
        # The start is a measurement too: its variance is evaluated where it puts the target.
        variance = polar.cartesian_variances(start, p.range_sigma, self.bearing_sigma)
        diagonal = xp.concat([variance, (2.0 / p.sampling_interval**2) * variance])
        identity = xp.eye(4, dtype=diagonal.dtype, device=diagonal.device)[:, :, None]
        truth = Truth(0.0 * ones, position, velocity, maneuvers, self._drawn_scans(draws, position, velocity))
        return truth, Initial(xp.concat([start, start_velocity]), identity * diagonal)

    def _drawn_scans(self, draws: Draws, position: Array, velocity: Array) -> Scans | None:
        """Draw how reliable the scans of an episode are, of a track that begins with a measurement on time."""
        p, never = self.parameters, 0.0 * position[0]
        if p.regular:
            return None
        seen = draws.uniform("detection_probability", p.detection_probability)
        early = draws.uniform("scan_jitter", p.scan_jitter)
        if p.undisturbed:
            calm = draws.event("undisturbed", p.undisturbed)
            seen, early = self.xp.where(calm, 1.0, seen), self.xp.where(calm, 0.0, early)
        return Scans(
            seen,
            early,
            never,
            never,
            position,
            velocity,
        )

    def _random_flight(self, draws: Draws) -> tuple[Array, Array, Maneuvers]:
        """Draw a start and manoeuvres that do not overlap, each drawn as thrust or coordinated turn."""
        xp, p, T = self.xp, self.parameters, self.parameters.sampling_interval
        circle = (0.0, 2.0 * math.pi)
        start_range, azimuth = draws.uniform("start_range", p.start_range), draws.uniform("azimuth", circle)
        speed, course = draws.uniform("speed", p.speed), draws.uniform("course", circle)
        position = start_range * xp.stack([xp.cos(azimuth), xp.sin(azimuth)])
        velocity = speed * xp.stack([xp.cos(course), xp.sin(course)])
        flown = xp.arange(self.slots, device=self.task.device)[:, None] < draws.integer(
            "maneuver_count", p.maneuver_count
        )
        duration = xp.where(flown, draws.integer("duration", p.maneuver_duration, self.slots), 0.0)
        # Sorted starts within the time that the manoeuvres leave free, each moved on by those before it.
        order = xp.sort(xp.where(flown, draws.unit("order", self.slots), 2.0), axis=0)
        acceleration = draws.uniform("acceleration", p.maneuver_acceleration, self.slots)
        direction = draws.uniform("direction", circle, self.slots)
        coordinated = draws.event("coordinated", 0.5, self.slots)
        if not self.slots:
            empty = 0.0 * duration
            turn = None if p.regular else empty
            return position, velocity, Maneuvers(empty, empty, xp.stack([empty] * 6), turn)
        free = xp.clip(p.horizon - ordered_sum(duration), 1.0, None)
        before = 0.0 * free
        columns: list[tuple[Array, ...]] = []
        now = velocity
        for m in range(self.slots):
            first = xp.where(flown[m], 1.0 + before + xp.floor(order[m] * free), p.horizon + 10.0)
            before = before + duration[m]
            pace = xp.clip(xp.sqrt(now[0] ** 2 + now[1] ** 2), 30.0, None)
            side = xp.where(direction[m] < math.pi, 1.0, -1.0)
            theta = xp.where(coordinated[m], side * acceleration[m] * (T / pace), 0.0)
            turning = xp.abs(theta) > 1e-9
            divisor = xp.where(turning, theta, 1.0)
            thrust = xp.where(coordinated[m], 0.0, acceleration[m])
            vector = thrust * xp.stack([xp.cos(direction[m]), xp.sin(direction[m])])
            effect = [
                xp.cos(theta) - 1.0,
                xp.sin(theta),
                xp.where(turning, T * (xp.sin(theta) / divisor - 1.0), 0.0),
                xp.where(turning, T * (1.0 - xp.cos(theta)) / divisor, 0.0),
                vector[0],
                vector[1],
            ]
            columns.append((first, first + duration[m] - 1.0, xp.stack(effect), theta))
            total = theta * duration[m]
            cosine, sine = xp.cos(total), xp.sin(total)
            turned = xp.stack([cosine * now[0] - sine * now[1], sine * now[0] + cosine * now[1]])
            now = turned + (T * duration[m]) * vector
        maneuvers = Maneuvers(*(xp.stack(parts, axis=-2) for parts in zip(*columns, strict=True)))
        return position, velocity, maneuvers._replace(turn=None) if p.regular else maneuvers

    def _drawn_legs(self, draws: Draws, ones: Array) -> Legs:
        """Draw start, course, side and times of a flight around the stated ones."""
        xp, p = self.xp, self.parameters
        spread, course = p.start_spread, math.radians(p.course_spread)
        position = xp.stack(
            [
                start + draws.uniform(f"start_{axis}", (-spread, spread))
                for axis, start in zip("xy", p.initial_position, strict=True)
            ]
        )
        turned = draws.uniform("course", (-course, course))
        velocity = self._rotated(self.task.constant(p.initial_velocity)[:, None] * ones, turned)
        side = xp.where(draws.event("mirrored", p.mirrored), -1.0, 1.0)
        time = 0.0 * ones
        found: list[tuple[Array, ...]] = []
        for i, (duration, rate) in enumerate(p.legs):
            turn = (math.radians(rate) * side) * ones
            flown = duration * draws.uniform(f"leg_{i}", (1.0 - p.leg_spread, 1.0 + p.leg_spread))
            found.append((time, turn, position, velocity))
            position, velocity = self._after(flown, turn, position, velocity)
            time = time + flown
        found.append((time, 0.0 * ones, position, velocity))
        return Legs(*(xp.stack(parts) for parts in zip(*found, strict=True)))

    def _rotated(self, vector: Array, angle: Array) -> Array:
        """Turn ``(2, N)`` anticlockwise."""
        xp = self.xp
        cosine, sine = xp.cos(angle), xp.sin(angle)
        return xp.stack([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]])

    def _after(self, time: Array, turn: Array, position: Array, velocity: Array) -> tuple[Array, Array]:
        """Position and velocity after a time on a circle, or a straight line, at constant speed."""
        state = coordinated_turn.turned(self.xp.concat([position, velocity, turn[None]]), time)
        return state[:2], state[2:4]

    def on_legs(self, legs: Legs, scan: Array) -> tuple[Array, Array]:
        """Position and velocity at a scan, or between two: any number."""
        xp, now = self.xp, self.parameters.sampling_interval * scan
        time, turn, position, velocity = (part[0] for part in legs)
        for i in range(1, int(legs.time.shape[0])):
            there = now >= legs.time[i]
            time, turn = xp.where(there, legs.time[i], time), xp.where(there, legs.turn[i], turn)
            position = xp.where(there, legs.position[i], position)
            velocity = xp.where(there, legs.velocity[i], velocity)
        return self._after(now - time, turn, position, velocity)

    def _states(self, column: Array) -> tuple[Array, Array]:
        """Position and velocity in a column of the table, a float, ``(2, N)`` each."""
        row = self.xp.astype(column, self.xp.int64)
        return self.table[:2, row], self.table[2:, row]

    def _flown(self, truth: Truth, position: Array, velocity: Array, scan: Array) -> tuple[Array, Array]:
        """Position and velocity at the next scan, on time, from those at the one before."""
        xp, T, m = self.xp, self.parameters.sampling_interval, truth.maneuvers
        if isinstance(m, Legs):
            return self.on_legs(m, scan)
        if m is None:
            return self._states(xp.clip(scan, None, float(self.table.shape[1]) - 1.0))
        if isinstance(m, Tracks):
            return self._states(xp.minimum(m.first + scan, m.last))
        before, position = velocity, position + T * velocity
        if not self.slots:
            return position, velocity
        effect = self._picked(m, m.effect, scan)
        acceleration = effect[4:]
        position = position + (0.5 * T**2) * acceleration
        velocity = velocity + T * acceleration
        if self.parameters.flight == "random":
            across = xp.stack([-before[1], before[0]])
            position = position + (effect[2] * before + effect[3] * across)
            velocity = velocity + (effect[0] * before + effect[1] * across)
        return position, velocity

    def _picked(self, m: Maneuvers, values: Array, scan: Array) -> Array:
        """Values ``(..., manoeuvres, N)`` of the manoeuvre that is flown in the scan period that ends with a scan."""
        active = self.xp.astype((scan >= m.first) & (scan <= m.last), values.dtype)
        # Manoeuvres do not overlap, so at most one term of the sum differs from zero.
        values = active * values
        return ordered_sum(values[..., slot, :] for slot in range(self.slots))

    def _between(
        self, truth: Truth, scans: Scans, scan: Array, early: Array, on_time: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Position and velocity at a scan that comes early by a share of the scan period.

        Thrust is constant within a period, and so is the turn rate.
        """
        T, m = self.parameters.sampling_interval, truth.maneuvers
        if isinstance(m, Legs):
            return self.on_legs(m, scan - early)
        if not isinstance(m, Maneuvers):  # a table: its scans come on time
            return on_time
        time = T * (1.0 - early)
        if not self.slots:
            return scans.position + time * scans.velocity, scans.velocity
        turn, acceleration = self._picked(m, m.turn, scan) / T, self._picked(m, m.acceleration, scan)
        position, velocity = self._after(time, turn, scans.position, scans.velocity)
        return position + (0.5 * time * time) * acceleration, velocity + time * acceleration

    def advance(self, truth: Truth, noise: Array, feedback: None) -> tuple[Truth, Measurement]:
        """Fly one scan and measure."""
        xp, p, T = self.xp, self.parameters, self.parameters.sampling_interval
        scan, scans = truth.scan + 1.0, truth.scans
        always = xp.ones_like(scan)
        available, interval, elapsed = always, T * always, T * always
        if scans is None:
            position, velocity = self._flown(truth, truth.position, truth.velocity, scan)
        else:
            on_time = self._flown(truth, scans.position, scans.velocity, scan)
            early = scans.jitter * noise[3]
            position, velocity = self._between(truth, scans, scan, early, on_time)
            available = xp.astype(noise[2] < scans.detection_probability, scan.dtype)
            interval = T * (1.0 + (scans.early - early))
            elapsed = scans.unseen + interval
            scans = scans._replace(
                early=early, unseen=(1.0 - available) * elapsed, position=on_time[0], velocity=on_time[1]
            )
        errors = noise[:2]
        if p.glint_probability:
            errors = xp.where(noise[-1] < p.glint_probability, p.glint_factor * errors, errors)
        if p.polar_measurements:
            radius = xp.sqrt(position[0] ** 2 + position[1] ** 2) + p.range_sigma * errors[0]
            azimuth = xp.atan2(position[1], position[0]) + self.bearing_sigma * errors[1]
            measured = radius * xp.stack([xp.cos(azimuth), xp.sin(azimuth)])
        else:
            true_variance = polar.cartesian_variances(position, p.range_sigma, self.bearing_sigma)
            measured = position + xp.sqrt(true_variance) * errors
        variance = polar.cartesian_variances(measured, p.range_sigma, self.bearing_sigma)
        if scans is not None:
            seen = available > 0.0
            measured, variance = xp.where(seen, measured, 0.0), xp.where(seen, variance, p.range_sigma**2)
        return (
            Truth(scan, position, velocity, truth.maneuvers, scans),
            Measurement(scan, measured, variance, available, interval, elapsed),
        )

    def state(self, truth: Truth) -> Array:
        """Position and velocity, ``(4, N)``."""
        return self.xp.concat([truth.position, truth.velocity])

    def received(self, measurement: Measurement) -> Measurement:
        """Position NaN where the scan missed the target."""
        position = self.xp.where(measurement.available > 0.0, measurement.position, math.nan)
        return measurement._replace(position=position)

    def seen(self, measurement: Measurement) -> Array:
        """The measured position; nothing of the velocity."""
        position = self.received(measurement).position
        return self.xp.concat([position, position * math.nan])

    def stated_deviation(self, measurement: Measurement) -> Array:
        """Root of the position's variance."""
        sigma = self.xp.sqrt(measurement.variance)
        return self.xp.concat([sigma, sigma * math.nan])

    def error_cost(self, error: Array) -> Array:
        """Squared position error over the squared range sigma."""
        scaled = error[:2] * (1.0 / self.parameters.range_sigma)
        return scaled[0] * scaled[0] + scaled[1] * scaled[1]

    def context(self, truth: Truth) -> dict[str, Array]:
        """Manoeuvres: first and last scan, thrust (m/s^2) and turn in a scan (rad) of each, or where legs begin (s) and
        their turn rates (rad/s); whether one is flown now. Of flights that are a table the number; nothing of one.
        Where scans may miss the target or come early, the probability that they see it, and the share of the scan
        period by which they come early at most.
        """
        if truth.scans is None:
            return self._flight_context(truth, truth.scan)
        flight = self._flight_context(truth, truth.scan - truth.scans.early)
        reliability = truth.scans.detection_probability, truth.scans.jitter
        return {**flight, "detection_probability": reliability[0], "scan_jitter": reliability[1]}

    def _flight_context(self, truth: Truth, time: Array) -> dict[str, Array]:
        """What the context tells of the flight at a time, scans."""
        xp, m = self.xp, truth.maneuvers
        if isinstance(m, Legs):
            now = self.parameters.sampling_interval * time
            turn = m.turn[0]
            for i in range(1, int(m.time.shape[0])):
                turn = xp.where(now >= m.time[i], m.turn[i], turn)
            return {"leg_time": m.time, "leg_turn_rate": m.turn, "maneuvering": turn != 0.0}
        if isinstance(m, Tracks):
            return {"flight": m.number}
        if m is None or not self.slots:
            return {}
        # A manoeuvre that is not flown lies beyond the end.
        flown = m.first <= self.parameters.horizon + 1
        active = (truth.scan >= m.first) & (truth.scan <= m.last)
        return {
            "maneuver_first": xp.where(flown, m.first, -1.0),
            "maneuver_last": xp.where(flown, m.last, -1.0),
            "maneuver_acceleration": xp.where(flown, m.acceleration, 0.0),
            "maneuver_turn": xp.where(flown, xp.atan2(m.velocity_across, 1.0 + m.velocity_along), 0.0),
            "maneuvering": xp.any(active, axis=0),
        }
