"""Motion of the user of TightlyCoupledNavigation: random legs for every episode, or the fixed legs of the paper.

Reading: a velocity that grows by 0.3 m/s in every 0.01 s already is an acceleration of 30 m/s^2, so no jump is left
for step 2000. The truth was probably a sequence of states with V incremented and A = 0: ``course="increment"``. In the
consistent alternative, ``course="kinematic"``, A = 30 m/s^2 in leg 2 and turns by 90 degrees.
"""

import math
from types import ModuleType
from typing import Any, NamedTuple

import numpy

from ..contract.draws import Draws, draw_between
from ..contract.observation import Array
from .parameters import DEGREE, LINE, REST, SINGER, TightlyCoupledNavigationParameters
from .problem import NavigationProblem


class Legs(NamedTuple):
    """Legs of a course: first steps, kinds and initial accelerations; L legs."""

    start: Array
    """Last step before each leg, ``(L, N)``."""
    kind: Array
    """Kind of each leg, REST, LINE or SINGER, ``(L, N)``."""
    acceleration: Array
    """Initial acceleration of each leg, ``(3, L, N)``, m/s^2."""


class Course:
    """Simulation of motion along legs of rest, straight flight and manoeuvre."""

    def __init__(self, task: NavigationProblem) -> None:
        self.task = task
        self.parameters: TightlyCoupledNavigationParameters = task.parameters
        self.xp: ModuleType = task.xp
        self.singer_root: Array = task.constant(numpy.linalg.cholesky(task.models[SINGER].noise))

    def begin(self, draws: Draws, zeros: Array) -> tuple[Legs, Array, Array]:
        """Draw the legs of each episode, the initial velocity and the heading.

        Returns:
            The legs, the velocity, ``(3, N)``, m/s, and the heading of the level aircraft, ``(N,)``, rad.
        """
        if self.parameters.course == "random":
            return self._random_legs(draws, zeros)
        return self._fixed_legs(draws, zeros)

    def _fixed_legs(self, draws: Draws, zeros: Array) -> tuple[Legs, Array, Array]:
        xp, p = self.xp, self.parameters
        # As many numbers as three random legs take: the faults of a fixed course do not depend on what it is.
        draws.unit("legs", 15)
        heading = zeros + DEGREE * draw_between(draws.uniform, "heading", p.heading)
        sine, cosine = xp.sin(heading), xp.cos(heading)
        along, right = xp.stack([sine, cosine, zeros]), xp.stack([cosine, -sine, zeros])
        if p.course == "matched":
            # One leg: the others begin after the end.
            starts: tuple[int, ...] = (0, p.horizon + 2, p.horizon + 2)
            kinds, directions, speed = (SINGER,) * 3, [along] * 3, p.matched_speed
        else:
            starts, kinds, speed = (0, *p.leg_steps), (REST, LINE, SINGER), 0.0
            directions = [0.0 * along, along, right]
        legs = Legs(
            xp.stack([zeros + start for start in starts]),
            xp.stack([zeros + kind for kind in kinds]),
            xp.stack(directions, axis=1) * p.leg_acceleration,
        )
        return legs, along * speed, heading

    def _random_legs(self, draws: Draws, zeros: Array) -> tuple[Legs, Array, Array]:
        xp, p = self.xp, self.parameters
        columns: list[tuple[Array, ...]] = []
        start: Array = None
        kind = velocity = start
        for leg in range(p.legs):
            chosen = draws.unit(f"kind_{leg}")
            seconds = draws.uniform(f"duration_{leg}", p.leg_duration)
            turn = draws.uniform(f"azimuth_{leg}", (0.0, 2.0 * math.pi))
            sine = draws.uniform(f"height_{leg}", (-1.0, 1.0))
            if leg == 0:
                start = 0.0 * chosen
                kind = xp.where(chosen < p.rest_probability, float(REST), float(LINE))
                speed, size = draws.uniform("speed", p.initial_speed), start
                level = xp.stack([xp.sin(turn), xp.cos(turn), start])
                velocity = xp.where(kind == REST, 0.0, speed) * level
            else:
                # A manoeuvre follows rest and straight flight; after it, straight flight or another one.
                straight = xp.where(chosen < 0.5, float(LINE), float(SINGER))
                kind = xp.where(kind == SINGER, straight, float(SINGER))
                size = xp.where(kind == SINGER, draws.uniform(f"strength_{leg}", p.strength), 0.0)
            cosine = xp.sqrt(xp.clip(1.0 - sine * sine, 0.0, None))
            direction = xp.stack([xp.sin(turn) * cosine, xp.cos(turn) * cosine, sine])
            columns.append((start, kind, size * direction))
            start = start + xp.clip(xp.round(seconds / p.sampling_interval), 1.0, None)
        legs = Legs(*(xp.stack(parts, axis=-2) for parts in zip(*columns, strict=True)))
        if p.manoeuvre_throughout and p.legs > 1:
            # The second leg is a manoeuvre: it begins at once and the others never.
            throughout = draws.event("manoeuvre_throughout", p.manoeuvre_throughout)
            later = [0.0 * start] + [0.0 * start + (p.horizon + 2.0)] * (p.legs - 1)
            second = xp.stack([legs.acceleration[:, 1]] * p.legs, axis=1)
            legs = Legs(
                xp.where(throughout, xp.stack(later), legs.start),
                xp.where(throughout, float(SINGER), legs.kind),
                xp.where(throughout, second, legs.acceleration),
            )
        heading = zeros + DEGREE * draw_between(draws.uniform, "heading", p.heading)
        return legs, velocity, heading

    def leg_at(self, legs: Legs, k: Array) -> tuple[Array, Array]:
        """Return the kind, ``(N,)``, and the initial acceleration, ``(3, N)``, of the leg that contains step k."""
        kind, push = legs.kind[0], legs.acceleration[:, 0]
        for i in range(1, legs.start.shape[0]):
            begun = k > legs.start[i]
            kind = self.xp.where(begun, legs.kind[i], kind)
            push = self.xp.where(begun, legs.acceleration[:, i], push)
        return kind, push

    def move(self, legs: Legs, k: Array, state: Array, moved: Array, w: Array) -> tuple[Any, Array, Array]:
        """Return position, velocity and acceleration after step k, the hypothesis followed, and whether it jumps.

        Args:
            legs: those of the episode.
            k: number of the step, ``(N,)``.
            state: state before it, ``(17, N)``.
            moved: the same as Singer's model extrapolates it.
            w: standard normal numbers, ``(3, 3, N)``.

        Returns:
            Position, velocity and acceleration, ``(3, N)`` each; the hypothesis, ``(N,)`` integers; and 1
            where the acceleration has jumped, ``(N,)``.
        """
        xp, p, T = self.xp, self.parameters, self.parameters.sampling_interval
        kind, push = self.leg_at(legs, k)
        q = self.singer_root
        singer = (
            moved[0:3] + q[0, 0] * w[0],
            moved[4:7] + (q[1, 0] * w[0] + q[1, 1] * w[1]),
            moved[8:11] + (q[2, 0] * w[0] + q[2, 1] * w[1] + q[2, 2] * w[2]),
        )
        x, v = state[0:3], state[4:7]
        spread = p.true_increment_sigma if p.course == "random" else 0.0
        increment = T * push + spread * w[1]
        felt = push if p.course == "kinematic" else 0.0 * push
        line = (x + T * v + (0.5 * T) * increment, v + increment, felt)
        still = (x, 0.0 * v, 0.0 * v)
        x, v, a = (
            xp.where(kind == REST, r, xp.where(kind == LINE, s, m))
            for r, s, m in zip(still, line, singer, strict=True)
        )
        jumped = k < 0.0
        for i in range(1, legs.start.shape[0]):
            here = (k == legs.start[i]) & (legs.kind[i] == SINGER)
            a = xp.where(here, legs.acceleration[:, i], a)
            jumped = jumped | here
        # From the jump on the user manoeuvres; so he does all along a line whose acceleration is felt.
        mode = xp.where(jumped, float(SINGER), kind)
        if p.course == "kinematic":
            mode = xp.where(kind == LINE, float(SINGER), mode)
        return (x, v, a), xp.astype(mode, xp.int64), xp.astype(jumped, w.dtype)
