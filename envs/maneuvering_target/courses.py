"""Courses (flight paths) of the target of ManeuveringTarget: one class for each kind of flight.

``scan`` is the number of a scan, ``(N,)``; a motion is a position (m) and a velocity (m/s), ``(2, N)`` each.
"""

import itertools
import math
from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any, NamedTuple

from ...filters import coordinated_turn
from ...filters.array_namespace import namespace
from ...filters.ordered_sums import ordered_sum
from ..contract.draws import Draws, StepSignal
from ..contract.observation import Array
from ..contract.task import Task
from .parameters import ManeuveringTargetParameters

Motion = tuple[Array, Array]
CIRCLE = (0.0, 2.0 * math.pi)


class Course(ABC):
    """Base class of the target's courses (kinds of flight paths)."""

    parameters: ManeuveringTargetParameters

    def __init__(self, task: Task) -> None:
        self.parameters = task.parameters
        self.task = task
        self.xp: ModuleType = task.xp

    @abstractmethod
    def begin(self, draws: Draws, ones: Array) -> tuple[Any, Motion]:
        """Draw each episode's flight; return its constants, and the motion (position, velocity) at the start."""

    @abstractmethod
    def advance(self, flight: Any, scan: Array, motion: Motion) -> Motion:
        """Return the motion at a scan from that at the previous scan, both scans on time."""

    def motion_at_early_scan(
        self, flight: Any, scan: Array, early: Array, before: Motion, on_time: Motion
    ) -> Motion:
        """Return the motion at a scan that comes early; by default that of :meth:`advance` then.

        By default that of :meth:`advance`, for a course defined at any time.

        Args:
            flight: constants of :meth:`begin`.
            scan: its number.
            early: the share, ``(N,)``.
            before: motion at the time of the previous scan without delay.
            on_time: motion at the time of this scan without delay.
        """
        return self.advance(flight, scan - early, before)

    def propagate_deviation(
        self, flight: Any, scan: Array, early: tuple[Array, Array] | None, velocity: Array
    ) -> Motion:
        """Return the deviations of position and velocity at a scan caused by a velocity deviation at the previous scan.

        A coordinated turn rotates the deviation, thrust does not. By default, without known turn rates, it is not
        rotated. ``early`` are shares of the scan period by which the previous scan and this one come early, ``(N,)``
        each, or None; ``velocity`` is the deviation at the previous scan, m/s, ``(2, N)``.
        """
        before, now = early or (0.0, 0.0)
        return (self.parameters.sampling_interval * (1.0 + (before - now))) * velocity, velocity

    def context(self, flight: Any, scan: Array, time: Array) -> dict[str, Array]:
        """Return times and sizes of manoeuvres, and the current one, for the context, by name; by default none.

        ``time`` is that of the current scan, in scan periods since the start.
        """
        return {}


def motion_in_turn(time: Array, turn: Array, motion: Motion, task: Task) -> Motion:
    """Return the motion after a time (s) of a coordinated turn at constant speed; ``turn`` in rad/s, zero: straight."""
    state = coordinated_turn.propagate(task.xp.concat([*motion, turn[None]]), time)
    return state[:2], state[2:4]


# --- manoeuvres


class Maneuvers(NamedTuple):
    """Constants of a flight: the change of the motion in each scan period of its manoeuvres."""

    first: Array
    """Scan number, ``(manoeuvres, N)``."""
    last: Array
    """Number of the last scan, included, ``(manoeuvres, N)``."""
    effect: Array
    """Effect of a manoeuvre in a scan, ``(6, manoeuvres, N)``; one array, since the truth selects from all of it. Of a
    turn by theta: the change of velocity along itself, per velocity, cos(theta) - 1, and across, sin(theta), then
    that of the position in the same form, s; of thrust: the acceleration along x and y, m/s^2."""
    turn: Array = None
    """Turn angle in a scan, rad, ``(manoeuvres, N)``; None where no scan comes early and ``effect`` suffices."""

    @property
    def acceleration(self) -> Array:
        """Acceleration of the thrust in each manoeuvre along x and y, m/s^2, ``(2, manoeuvres, N)``."""
        return self.effect[4:]


class Maneuvered(Course):
    """Base class of straight flights with manoeuvres that do not overlap."""

    turns: bool
    """Whether manoeuvres may be coordinated turns; otherwise all are thrust."""

    def advance(self, flight: Maneuvers, scan: Array, motion: Motion) -> Motion:
        """Return the motion at a scan: straight flight, plus the manoeuvre in this scan period if any."""
        T, (position, before) = self.parameters.sampling_interval, motion
        effect = self._pick(flight, flight.effect, scan)
        acceleration = effect[4:]
        position = (position + T * before) + (0.5 * T**2) * acceleration
        velocity = before + T * acceleration
        if self.turns:
            across = self.xp.stack([-before[1], before[0]])
            position = position + (effect[2] * before + effect[3] * across)
            velocity = velocity + (effect[0] * before + effect[1] * across)
        return position, velocity

    def motion_at_early_scan(
        self, flight: Maneuvers, scan: Array, early: Array, before: Motion, on_time: Motion
    ) -> Motion:
        """Return the motion at an early scan; thrust or turn rate is constant within the scan period."""
        T = self.parameters.sampling_interval
        time = T * (1.0 - early)
        turn, acceleration = (
            self._pick(flight, flight.turn, scan) / T,
            self._pick(flight, flight.acceleration, scan),
        )
        position, velocity = motion_in_turn(time, turn, before, self.task)
        return position + (0.5 * time * time) * acceleration, velocity + time * acceleration

    def propagate_deviation(
        self, flight: Maneuvers, scan: Array, early: tuple[Array, Array] | None, velocity: Array
    ) -> Motion:
        """Return the deviations at a scan that a velocity deviation causes, rotated at the turn rates until then."""
        if not self.turns:
            return super().propagate_deviation(flight, scan, early, velocity)
        nowhere = 0.0 * velocity
        if early is None:
            still = flight._replace(effect=self._without_thrust(flight.effect))
            return self.advance(still, scan, (nowhere, velocity))
        T, (before, now) = self.parameters.sampling_interval, early
        rates = [self._pick(flight, flight.turn, number) / T for number in (scan - 1.0, scan)]
        motion = motion_in_turn(T * before, rates[0], (nowhere, velocity), self.task)
        return motion_in_turn(T * (1.0 - now), rates[1], motion, self.task)

    def _without_thrust(self, effect: Array) -> Array:
        return self.xp.concat([effect[:4], 0.0 * effect[4:]])

    def _pick(self, flight: Maneuvers, values: Array, scan: Array) -> Array:
        active = self.xp.astype((scan >= flight.first) & (scan <= flight.last), values.dtype)
        # Manoeuvres do not overlap, so at most one term of the sum differs from zero.
        values = active * values
        return ordered_sum(values[..., slot, :] for slot in range(values.shape[-2]))

    def context(self, flight: Maneuvers, scan: Array, time: Array) -> dict[str, Array]:
        """Return first and last scan, thrust (m/s^2) and turn in a scan (rad) of each manoeuvre, by name.

        The context also states whether one is flown now.
        """
        xp = self.xp
        # A manoeuvre that is not flown lies beyond the end.
        flown = flight.first <= self.parameters.horizon + 1
        active = (scan >= flight.first) & (scan <= flight.last)
        turn = xp.atan2(flight.effect[1], 1.0 + flight.effect[0])
        return {
            "maneuver_first": xp.where(flown, flight.first, -1.0),
            "maneuver_last": xp.where(flown, flight.last, -1.0),
            "maneuver_acceleration": xp.where(flown, flight.acceleration, 0.0),
            "maneuver_turn": xp.where(flown, turn, 0.0),
            "maneuvering": xp.any(active, axis=0),
        }


class StatedManeuver(Maneuvered):
    """The paper's flight: straight, with one period of thrust at stated scans."""

    turns = False

    def begin(self, draws: Draws, ones: Array) -> tuple[Maneuvers, Motion]:
        """Return the constant manoeuvre of the flight, and the motion at its start, without a random number."""
        p, constant, once = self.parameters, self.task.constant, ones[None]
        first, last = p.maneuver_steps
        effect = constant((0.0, 0.0, 0.0, 0.0, *p.acceleration))[:, None, None] * once
        flight = Maneuvers(first * once, last * once, effect, None if p.regular else 0.0 * once)
        position, velocity = (constant(v)[:, None] * ones for v in (p.initial_position, p.initial_velocity))
        return flight, (position, velocity)


def _draw_start(draws: Draws, p: ManeuveringTargetParameters) -> Motion:
    xp = draws.xp
    start_range, azimuth = draws.uniform("start_range", p.start_range), draws.uniform("azimuth", CIRCLE)
    speed, course = draws.uniform("speed", p.speed), draws.uniform("course", CIRCLE)
    position = start_range * xp.stack([xp.cos(azimuth), xp.sin(azimuth)])
    return position, speed * xp.stack([xp.cos(course), xp.sin(course)])


class RandomManeuvers(Maneuvered):
    """Random flights: start, speed, direction, and manoeuvres that are thrust or coordinated turns."""

    turns = True

    def begin(self, draws: Draws, ones: Array) -> tuple[Maneuvers, Motion]:
        """Draw the manoeuvres of each flight, and the motion at its start."""
        xp, p, T = self.xp, self.parameters, self.parameters.sampling_interval
        slots = p.maneuver_count[1]
        position, velocity = _draw_start(draws, p)
        flown = xp.arange(slots, device=self.task.device)[:, None] < draws.integer(
            "maneuver_count", p.maneuver_count
        )
        duration = xp.where(flown, draws.integer("duration", p.maneuver_duration, slots), 0.0)
        # Sorted starts within the time that the manoeuvres leave free, each moved on by those before it.
        order = xp.sort(xp.where(flown, draws.unit("order", slots), 2.0), axis=0)
        acceleration = draws.uniform("acceleration", p.maneuver_acceleration, slots)
        direction = draws.uniform("direction", CIRCLE, slots)
        coordinated = draws.event("coordinated", 0.5, slots)
        free = xp.clip(p.horizon - ordered_sum(duration), 1.0, None)
        before = 0.0 * free
        columns: list[tuple[Array, ...]] = []
        now = velocity
        for m in range(slots):
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
        flight = Maneuvers(*(xp.stack(parts, axis=-2) for parts in zip(*columns, strict=True)))
        return flight._replace(turn=None) if p.regular else flight, (position, velocity)


class RandomStraight(Course):
    """Random straight flights: start, speed and direction, no manoeuvre."""

    def begin(self, draws: Draws, ones: Array) -> tuple[None, Motion]:
        """Draw the motion at the start; return None as constants of the flight, and the motion."""
        motion = _draw_start(draws, self.parameters)
        draws.unit("maneuver_count")
        return None, motion

    def advance(self, flight: None, scan: Array, motion: Motion) -> Motion:
        """Return the motion at the next scan in straight flight."""
        position, velocity = motion
        return position + self.parameters.sampling_interval * velocity, velocity

    def motion_at_early_scan(
        self, flight: None, scan: Array, early: Array, before: Motion, on_time: Motion
    ) -> Motion:
        """Return the motion in straight flight after a part of the scan period."""
        position, velocity = before
        return position + (self.parameters.sampling_interval * (1.0 - early)) * velocity, velocity


# --- legs


class Legs(NamedTuple):
    """Constants of a flight of straight legs and exact coordinated turns: the state at the start of each leg.

    The last leg is straight and never ends.
    """

    begins: Array
    """Start of each leg, ``(legs + 1, 6, N)``: time since the start of the track, s; turn rate, rad/s, anticlockwise
    positive; position, m; velocity, m/s. One array, since the truth selects from all of it in every scan."""

    @property
    def time(self) -> Array:
        """Start time of each leg since the start of the track, s, ``(legs + 1, N)``."""
        return self.begins[:, 0]

    @property
    def turn(self) -> Array:
        """Turn rate of each leg, rad/s, ``(legs + 1, N)``."""
        return self.begins[:, 1]


def _times(one: Array, other: Array) -> Array:
    """Return the product of complex numbers ``(2, N)``, whose rows are real and imaginary part."""
    return namespace(one).stack(
        [one[0] * other[0] - one[1] * other[1], one[0] * other[1] + one[1] * other[0]]
    )


class LegCourse(Course):
    """Flights of stated legs, with start, direction, side and durations drawn around the stated ones."""

    def begin(self, draws: Draws, ones: Array) -> tuple[Legs, Motion]:
        """Draw start, direction, side and durations of each flight; return its legs and the initial motion."""
        xp, p = self.xp, self.parameters
        spread, course = p.start_spread, math.radians(p.course_spread)
        position = xp.stack(
            [
                start + draws.uniform(f"start_{axis}", (-spread, spread))
                for axis, start in zip("xy", p.initial_position, strict=True)
            ]
        )
        turned = draws.uniform("course", (-course, course))
        cosine, sine = xp.cos(turned), xp.sin(turned)
        x, y = self.task.constant(p.initial_velocity)[:, None] * ones
        velocity = xp.stack([cosine * x - sine * y, sine * x + cosine * y])
        start = position, velocity
        side = xp.where(draws.event("mirrored", p.mirrored), -1.0, 1.0)
        time = 0.0 * ones
        begins: list[Array] = []
        for i, (duration, rate) in enumerate(p.legs):
            turn = (math.radians(rate) * side) * ones
            flown = duration * draws.uniform(f"leg_{i}", (1.0 - p.leg_spread, 1.0 + p.leg_spread))
            begins.append(xp.concat([xp.stack([time, turn]), position, velocity]))
            position, velocity = motion_in_turn(flown, turn, (position, velocity), self.task)
            time = time + flown
        begins.append(xp.concat([xp.stack([time, 0.0 * ones]), position, velocity]))
        return Legs(xp.stack(begins)), start

    def advance(self, flight: Legs, scan: Array, motion: Motion) -> Motion:
        """Return the motion at a scan, also a fractional one, computed from the legs alone."""
        now = self.parameters.sampling_interval * scan
        leg = StepSignal(flight.begins, flight.time[1:]).at(now, self.xp)
        return motion_in_turn(now - leg[0], leg[1], (leg[2:4], leg[4:]), self.task)

    def propagate_deviation(
        self, flight: Legs, scan: Array, early: tuple[Array, Array] | None, velocity: Array
    ) -> Motion:
        """Return the deviations at a scan that a velocity deviation causes, rotated and scaled as the velocity is."""
        before, now = early or (0.0, 0.0)
        (position, flown), (there, afterwards) = (
            self.advance(flight, time, (velocity, velocity)) for time in (scan - 1.0 - before, scan - now)
        )
        square = ordered_sum(flown * flown)
        square = self.xp.where(square > 0.0, square, 1.0)
        deviation = _times(self.xp.stack([flown[0], -flown[1]]) / square, velocity)
        return _times(there - position, deviation), _times(afterwards, deviation)

    def context(self, flight: Legs, scan: Array, time: Array) -> dict[str, Array]:
        """Return the starts of legs (s), turn rates (rad/s), and whether the target turns now, by name."""
        now = self.parameters.sampling_interval * time
        turn = StepSignal(flight.turn, flight.time[1:]).at(now, self.xp)
        return {"leg_time": flight.time, "leg_turn_rate": flight.turn, "maneuvering": turn != 0.0}


# --- tables


class Table(Course):
    """A flight given as a table of positions and velocities at every scan."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.table: Array = task.constant(self.parameters.track)
        """Rows x, y, vx, vy, ``(4, horizon + 2)``; several flights are concatenated."""

    def begin(self, draws: Draws, ones: Array) -> tuple[Any, Motion]:
        """Return the constants of the flight, and the motion at its start, without a random number."""
        return None, (self.table[:2, 0, None] * ones, self.table[2:, 0, None] * ones)

    def advance(self, flight: Any, scan: Array, motion: Motion) -> Motion:
        """Return the motion at a scan from the table; beyond its end the last state."""
        return self._states(self.xp.clip(scan, None, float(self.table.shape[1]) - 1.0))

    def motion_at_early_scan(
        self, flight: Any, scan: Array, early: Array, before: Motion, on_time: Motion
    ) -> Motion:
        """Return the motion of the scan on time, since a table has no states between scans."""
        return on_time

    def _states(self, column: Array) -> Motion:
        row = self.xp.astype(column, self.xp.int64)
        return self.table[:2, row], self.table[2:, row]


class Tracks(NamedTuple):
    """Constants of a flight: which one of a table it is."""

    number: Array
    """Index of the flight, ``(N,)``, a float, as are the columns of its first and last state."""
    first: Array
    last: Array


class TableOfSeveral(Table):
    """Several flights given as one table of states, of which every episode flies one."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.ends: list[int] = [0, *itertools.accumulate(scans + 2 for scans in self.parameters.track_scans)]
        """Columns of the table at which flights begin, and its width."""

    def begin(self, draws: Draws, ones: Array) -> tuple[Tracks, Motion]:
        """Draw one of the table's flights for each episode; return the choice, and the motion at its start."""
        constant = self.task.constant
        number = draws.integer("flight", (0, len(self.ends) - 2))
        row = self.xp.astype(number, self.xp.int64)
        first, last = constant(self.ends[:-1])[row], constant(self.ends[1:])[row] - 1.0
        return Tracks(number, first, last), self._states(first)

    def advance(self, flight: Tracks, scan: Array, motion: Motion) -> Motion:
        """Return the motion at a scan from the table; beyond the flight's end its last state."""
        return self._states(self.xp.minimum(flight.first + scan, flight.last))

    def context(self, flight: Tracks, scan: Array, time: Array) -> dict[str, Array]:
        """Return the index of the flight, by name."""
        return {"flight": flight.number}


def course_of(task: Task) -> Course:
    """Return the course (flight path) that the task's parameters select."""
    p: ManeuveringTargetParameters = task.parameters
    random = RandomManeuvers if p.maneuver_count[1] else RandomStraight
    table = TableOfSeveral if p.track_scans else Table
    kinds = {"maneuver": StatedManeuver, "random": random, "legs": LegCourse, "track": table}
    return kinds[p.flight](task)
