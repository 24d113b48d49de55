"""Episodes of several tasks side by side: a lane flies now one, then another.

A task has one set of parameters. Where scenarios are mixed, or a reset names another scenario or other parameters,
every distinct set has a task and :class:`~.lanes.Lanes` of its own. A lane's next episode gets a free place in the
lanes of the task that is drawn for it; lanes grow by eight places when none is free. A place that nobody has is stepped
all the same and never looked at: a step costs what as many environments of each task cost as ever flew it at once.

What a lane's generator gives is first, in a mixture only, the uniform number that chooses the task, then the episode as
in :mod:`.lanes`. So sub-environment i of N equals the single environment with the same seed, here too.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from .lanes import Lanes
from .observation import Array
from .recording import Recording
from .reward import paper_task
from .specification import plain
from .task import Task

ROOM = 8
"""Places by which lanes grow: a multiple of the width that arrays are padded to."""


class Course(NamedTuple):
    """What the coming episodes of a lane are drawn from."""

    scenario: Any
    """As it was asked for."""
    parameters: Mapping[str, Any]
    """Beside those that the environment was made with."""
    tasks: tuple[Task, ...]
    names: tuple[str, ...]
    """Of their scenarios."""
    weights: tuple[float, ...]
    """Which sum to one."""

    def is_of(self, scenario: Any, parameters: Mapping[str, Any]) -> bool:
        """Whether it was made of these."""
        if isinstance(scenario, Recording) or isinstance(self.scenario, Recording):  # too long to be told
            alike = scenario is self.scenario
        else:
            alike = repr(plain(self.scenario)) == repr(plain(scenario))
        return alike and repr(plain(self.parameters)) == repr(plain(parameters))

    def drawn(self, generator: numpy.random.Generator) -> int:
        """Number of the task of the next episode; one task takes no random number."""
        if len(self.tasks) == 1:
            return 0
        chosen = int(numpy.searchsorted(numpy.cumsum(self.weights), generator.random(), side="right"))
        return min(chosen, len(self.tasks) - 1)


def check_alike(task: Task, other: Task, name: str) -> None:
    """Raise ValueError if episodes of another task would not fit the spaces of a task.

    Args:
        task: whose spaces there are.
        other: that is to be flown too.
        name: of its scenario, in errors.
    """
    said: dict[str, Callable[[Task], Any]] = {
        "the fields of the observation": lambda t: [(f.name, f.unit, f.over_interval) for f in t.fields],
        "the action space": lambda t: t.action_space,
        "decision_interval": lambda t: t.decision_interval,
        "what is estimated": lambda t: t.components,
    }
    for what, of in said.items():
        if of(task) != of(other):
            raise ValueError(
                f"scenario {name!r} with these parameters would change {what} of this environment, which stays as it "
                "is made: make another environment"
            )


def lanes_of(task: Task, count: int, beside_paper: bool, longest: int | None) -> Lanes:
    """Make lanes of a task, with the paper's algorithm beside every episode where it is wanted."""
    return Lanes(task, count, paper_task(task) if beside_paper else None, longest=longest)


class MixedLanes:
    """``count`` lanes, each with a :class:`Course` of its own; used like :class:`~.lanes.Lanes`.

    Args:
        count: number of lanes.
        course: of all of them, until :meth:`send` names others.
        beside_paper: whether the paper's algorithm runs beside every episode.
        longest: decisions after which an episode ends at the latest; default: its task's horizon.
    """

    def __init__(self, count: int, course: Course, beside_paper: bool, longest: int | None = None) -> None:
        self.count = count
        self.generators: list[numpy.random.Generator] = []
        self._courses = [course] * count
        self._beside_paper, self._longest = beside_paper, longest
        self._parts: list[Lanes] = []
        self._part = numpy.full(count, -1)
        """Which of ``_parts`` each lane flies in; -1 before its first episode."""
        self._place = numpy.arange(count)
        """Where in it."""
        self._names = [""] * count
        self._arrange()

    def adopt(self, lanes: Lanes) -> None:
        """Go on with the episodes of lanes of one task, the first course's."""
        self.generators = list(lanes.generators)
        if lanes.begun:
            lanes.grow(lanes.width)
            self._parts, self._part[:] = [lanes], 0
            self._names = [course.names[0] for course in self._courses]
            self._arrange()

    # --- who flies where

    def course_of(self, lane: int) -> Course:
        """Return what the coming episodes of a lane are drawn from."""
        return self._courses[lane]

    def send(self, lane: int, course: Course) -> None:
        """Draw the coming episodes of a lane from a course, from its next restart on."""
        self._courses[lane] = course

    def task_of(self, lane: int) -> Task:
        """Return the task of a lane's episode."""
        return self._parts[self._part[lane]].task

    def scenario_of(self, lane: int) -> str:
        """Name of the scenario of a lane's episode."""
        return self._names[lane]

    @property
    def decisions_per_episode(self) -> int:
        """Decisions of the longest episode that there may be."""
        tasks = {id(task): task for course in self._courses for task in course.tasks}.values()
        most = max(task.horizon // task.decision_interval for task in tasks)
        return most if self._longest is None else min(most, self._longest)

    def _made(self, task: Task, count: int) -> Lanes:
        return lanes_of(task, count, self._beside_paper, self._longest)

    def _part_of(self, task: Task) -> Lanes:
        """Lanes of a task, made when they are first asked for."""
        for part in self._parts:
            if part.task is task or part.task.parameters == task.parameters:
                return part
        part = self._made(task, ROOM)
        for place in range(ROOM):
            part.seed(place, numpy.random.default_rng(0))
        part.restart()
        self._parts.append(part)
        return part

    def _arrange(self) -> None:
        """Forget lanes that nobody needs, and note where everybody is."""
        needed = [task.parameters for course in self._courses for task in course.tasks]
        kept = [
            i
            for i, part in enumerate(self._parts)
            if (self._part == i).any() or part.task.parameters in needed
        ]
        renumbered = {-1: -1, **{old: new for new, old in enumerate(kept)}}
        self._part = numpy.array([renumbered[int(part)] for part in self._part])
        self._parts = [self._parts[i] for i in kept]
        self._flying = [i for i in range(len(self._parts)) if (self._part == i).any()]
        # Arrays of all places of those that fly are put side by side: there each lane finds its own.
        self._where, self._sources, first = self._place.copy(), [], 0
        for i in self._flying:
            own = numpy.flatnonzero(self._part == i)
            self._where[own] += first
            # A place that nobody has takes the action of whoever comes first.
            source = numpy.full(self._parts[i].count, own[0])
            source[self._place[own]] = own
            self._sources.append(source)
            first += self._parts[i].count

    def seed(self, lane: int, generator: numpy.random.Generator) -> None:
        """Give a lane the generator that its coming episodes are drawn from."""
        while len(self.generators) <= lane:
            self.generators.append(generator)
        self.generators[lane] = generator

    def restart(self, lanes: Sequence[int] | None = None) -> None:
        """Start new episodes in some lanes (default: all), each of a task that is drawn for it."""
        chosen = list(range(self.count) if lanes is None else lanes)
        self._part[chosen] = -1
        fresh: dict[int, list[int]] = {}
        for lane in chosen:
            course = self._courses[lane]
            which = course.drawn(self.generators[lane])
            part = self._part_of(course.tasks[which])
            number = next(i for i, other in enumerate(self._parts) if other is part)
            fresh.setdefault(number, []).append(lane)
            self._names[lane] = course.names[which]
        for number, arrived in fresh.items():
            part = self._parts[number]
            taken = set(self._place[self._part == number].tolist())
            missing = len(taken) + len(arrived) - part.count
            if missing > 0:
                part.grow(part.count + -(-missing // ROOM) * ROOM)
            free = [place for place in range(part.count) if place not in taken][: len(arrived)]
            for lane, place in zip(arrived, free, strict=True):
                self._part[lane], self._place[lane] = number, place
                part.seed(place, self.generators[lane])
            part.restart(free)
        self._arrange()

    # --- what lanes do

    def parts(self, *values: Array) -> list[tuple[Any, ...]]:
        """Lanes of every task that is flown, each with what is meant for it of arrays ``(count, ...)``."""
        return [
            (self._parts[i], *(v[source] for v in values))
            for i, source in zip(self._flying, self._sources, strict=True)
        ]

    def joined(self, values: Sequence[Array]) -> Array:
        """Put together what :meth:`parts` have returned, ``(places, ...)`` each: ``(count, ...)``."""
        if isinstance(values[0], numpy.ndarray):
            return numpy.concatenate(values)[self._where]
        return self._parts[0].task.xp.concat(list(values))[self._where]

    def observe(self) -> Array:
        """Observation of every lane, batch first."""
        return self.joined([part.observe() for (part,) in self.parts()])

    @property
    def decisions(self) -> numpy.ndarray:
        """Actions taken in each lane's current episode, ``(count,)``."""
        return numpy.asarray(self.joined([part.decisions for (part,) in self.parts()]))

    @property
    def finished(self) -> numpy.ndarray:
        """Lanes whose episode is over, ``(count,)`` booleans; episodes of different tasks may differ in length."""
        return numpy.asarray(self.joined([part.finished for (part,) in self.parts()]))

    def shorten(self, lanes: Sequence[int], decisions: numpy.ndarray) -> None:
        """Let the episodes that have just begun in some lanes end so many decisions early, but take one at least."""
        for lane, by in zip(lanes, decisions, strict=True):
            self._parts[self._part[lane]].shorten([int(self._place[lane])], by)

    @property
    def begun(self) -> bool:
        """Whether every lane has an episode."""
        return bool((self._part >= 0).all())

    @property
    def state(self) -> Any:
        """The episode of a single lane, padded.

        Raises:
            ValueError: if there are more.
        """
        if self.count > 1:
            raise ValueError("episodes of several tasks have no common state: use parts()")
        return self._parts[self._part[0]].state

    def detach(self) -> None:
        """Cut the gradient (torch only)."""
        for (part,) in self.parts():
            part.detach()

    def snapshot(self) -> dict[str, Any]:
        """Return all that the coming steps depend on; :meth:`restore` goes back to it, as often as one likes."""
        kept = {name: copy.deepcopy(getattr(self, name)) for name in _KEPT}
        return {"count": self.count, **kept, "parts": [(p.task, p.count, p.snapshot()) for p in self._parts]}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot of lanes of the same tasks.

        Raises:
            ValueError: if their number differs, or the snapshot is one of lanes of a single task.
        """
        if snapshot["count"] != self.count or "parts" not in snapshot:
            raise ValueError(
                f"the snapshot holds {snapshot['count']} environments, not {self.count} that mix tasks"
                if "parts" in snapshot
                else "the snapshot is one of environments that do not mix tasks"
            )
        for name in _KEPT:
            setattr(self, name, copy.deepcopy(snapshot[name]))
        self._parts = []
        for task, count, kept in snapshot["parts"]:
            self._parts.append(self._made(task, count))
            self._parts[-1].restore(kept)
        for lane in numpy.flatnonzero(self._part >= 0):
            self._parts[self._part[lane]].seed(int(self._place[lane]), self.generators[lane])
        self._arrange()


_KEPT = ("generators", "_courses", "_part", "_place", "_names")
"""Attributes of mixed lanes that change."""
