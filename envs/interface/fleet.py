"""The fleet of an environment: its lanes (parallel episodes), of one task or of several tasks.

A task has one set of parameters. Where scenarios are mixed, or a reset names another scenario or other parameters,
every distinct set has a task and :class:`~.lanes.Lanes` of its own. A lane's next episode gets a free place in the
lanes of its task, which grow by eight places when none is free. Unused places are stepped, too.

A lane's generator gives first, in a mixture only, the uniform number that chooses the task, then the identity of the
episode, see :mod:`.episode_noise`. So sub-environment i of N equals the single environment with the same seed.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy

from ..contract.model import Model
from ..contract.observation import Array
from ..data.recording import Recording
from ..engine.lanes import Lanes
from ..engine.reward import REWARD_FUNCTIONS, reward_baseline
from .specification import json_value

ROOM = 8
"""Places by which lanes grow: a multiple of the width that arrays are padded to."""


class EpisodeDistribution(NamedTuple):
    """Distribution of the next episodes of a lane over the tasks of its scenarios."""

    scenario: Any
    """Choice of the user."""
    parameters: Mapping[str, Any]
    """Parameters beside those of the environment."""
    models: tuple[Model, ...]
    names: tuple[str, ...]
    """Names of the scenarios."""
    weights: tuple[float, ...]
    """Weights of the scenarios, which sum to one."""

    def is_of(self, scenario: Any, parameters: Mapping[str, Any]) -> bool:
        """Return whether the distribution was made from this scenario and these parameters."""
        if isinstance(scenario, Recording) or isinstance(self.scenario, Recording):  # too long for a message
            alike = scenario is self.scenario
        else:
            alike = repr(json_value(self.scenario)) == repr(json_value(scenario))
        return alike and repr(json_value(self.parameters)) == repr(json_value(parameters))

    def draw_task(self, generator: numpy.random.Generator) -> int:
        """Draw the index of the next episode's task by the weights; a single task needs no random number."""
        if len(self.models) == 1:
            return 0
        chosen = int(numpy.searchsorted(numpy.cumsum(self.weights), generator.random(), side="right"))
        return min(chosen, len(self.models) - 1)


def check_alike(model: Model, other: Model, name: str) -> None:
    """Raise ValueError if two tasks have different observation or action spaces; ``name`` is the other's scenario."""
    properties: dict[str, Callable[[Model], Any]] = {
        "the fields of the observation": lambda t: [(f.name, f.unit, f.over_interval) for f in t.fields],
        "the action space": lambda t: t.action_space,
        "decision_interval": lambda t: t.task.decision_interval,
        "the components of the estimate": lambda t: t.task.components,
    }
    for what, of in properties.items():
        if of(model) != of(other):
            raise ValueError(
                f"scenario {name!r} with these parameters would change {what} of this environment, which stays as it "
                "is made: make another environment"
            )


class Fleet:
    """``count`` lanes (parallel episodes) of one task or of several, as their distributions draw them.

    Args:
        distribution: of the episodes of all lanes, until :meth:`set_distribution` sets another.
        kind: kind of reward, which may need a baseline beside every episode.
        longest: most decisions of an episode; default: its task's horizon.
    """

    def __init__(
        self, count: int, distribution: EpisodeDistribution, kind: str, longest: int | None = None
    ) -> None:
        self.count = count
        self.generators: list[numpy.random.Generator] = []
        self._distributions = [distribution] * count
        self._kind, self._longest = kind, longest
        self._part = numpy.full(count, -1)
        """Index in ``_parts`` of each lane's task; -1 before its first episode."""
        self._place = numpy.arange(count)
        """Index of each lane in its part."""
        self._names = [distribution.names[0]] * count
        self._parts: list[Lanes] = []
        self.whole: Lanes | None = None
        """Lanes of the only task, each in its own place; None for several tasks."""
        self._sent = False
        """Whether lanes have new distributions, from which their current episodes were not drawn."""
        if len(distribution.models) == 1:
            self._parts, self._part[:] = [self._make_lanes(distribution.models[0], count)], 0
        self._arrange()

    # --- places of the lanes

    @property
    def only(self) -> Lanes:
        """The :class:`.Lanes` of the only task; ValueError if there are several tasks."""
        if self.whole is not None:
            return self.whole
        if self.count > 1:
            raise ValueError("episodes of several tasks have no common state: use parts()")
        return self._parts[self._part[0]]

    @property
    def mixes_scenarios(self) -> bool:
        """Whether the next episodes may be of several tasks."""
        return len({id(model) for distribution in self._distributions for model in distribution.models}) > 1

    def distributions(self) -> list[EpisodeDistribution]:
        """Return the distinct distributions of the lanes as a list."""
        return list({id(distribution): distribution for distribution in self._distributions}.values())

    def distribution_of(self, lane: int) -> EpisodeDistribution:
        """Return the :class:`EpisodeDistribution` of a lane's next episodes."""
        return self._distributions[lane]

    def set_distribution(self, lane: int, distribution: EpisodeDistribution) -> None:
        """Set the distribution from which a lane's episodes are drawn after its next restart."""
        self._sent = self._sent or distribution is not self._distributions[lane]
        self._distributions[lane] = distribution

    def model_of(self, lane: int) -> Model:
        """Return the model of the task of a lane's current episode."""
        return self._parts[self._part[lane]].model

    def identity_of(self, lane: int) -> numpy.ndarray:
        """Return the identity of a lane's current episode, ``(2, 1)``, see :mod:`.episode_noise`."""
        place = self._place[lane]
        return self._parts[self._part[lane]].noise.identities[:, place : place + 1].copy()

    def scenario_of(self, lane: int) -> str:
        """Return the name of the scenario of a lane's current episode."""
        return self._names[lane]

    @property
    def decisions_per_episode(self) -> int:
        """Number of decisions of the longest possible episode."""
        models = {
            id(model): model for distribution in self.distributions() for model in distribution.models
        }.values()
        most = max(model.task.horizon // model.task.decision_interval for model in models)
        return most if self._longest is None else min(most, self._longest)

    def _make_lanes(self, model: Model, count: int) -> Lanes:
        beside, report = reward_baseline(self._kind, model), REWARD_FUNCTIONS[self._kind]
        return Lanes(model, count, beside, longest=self._longest, report=report)

    def _part_of(self, model: Model) -> Lanes:
        for part in self._parts:
            if part.model is model or part.model.task.parameters == model.task.parameters:
                return part
        part = self._make_lanes(model, ROOM)
        for place in range(ROOM):
            part.seed(place, numpy.random.default_rng(0))
        part.restart()
        self._parts.append(part)
        return part

    def _arrange(self) -> None:
        needed = [
            model.task.parameters for distribution in self._distributions for model in distribution.models
        ]
        kept = [
            i
            for i, part in enumerate(self._parts)
            if (self._part == i).any() or part.model.task.parameters in needed
        ]
        renumbered = {-1: -1, **{old: new for new, old in enumerate(kept)}}
        self._part = numpy.array([renumbered[int(part)] for part in self._part])
        self._parts = [self._parts[i] for i in kept]
        self._flying = [i for i in range(len(self._parts)) if (self._part == i).any()]
        # The arrays of all used places are side by side; each lane has an index into them.
        self._where, self._sources, first = self._place.copy(), [], 0
        for i in self._flying:
            own = numpy.flatnonzero(self._part == i)
            self._where[own] += first
            # An unused place has the action of the first environment.
            source = numpy.full(self._parts[i].count, own[0])
            source[self._place[own]] = own
            self._sources.append(source)
            first += self._parts[i].count
        own_places = self._flying == [0] and numpy.array_equal(self._place, numpy.arange(self.count))
        alone = len(self._parts) == 1 and self._parts[0].count == self.count and not self.mixes_scenarios
        self.whole = self._parts[0] if own_places and alone else None

    def seed(self, lane: int, generator: numpy.random.Generator) -> None:
        """Set the random generator that draws a lane's next episodes."""
        while len(self.generators) <= lane:
            self.generators.append(generator)
        self.generators[lane] = generator
        if self.whole is not None:
            self.whole.seed(lane, generator)

    def restart(self, lanes: Sequence[int] | None = None) -> None:
        """Draw and start new episodes in some lanes (default: all), each of a task from its distribution."""
        if self.whole is not None and not self._sent:
            self.whole.restart(lanes)
            return
        if self.whole is not None:
            self._split_tasks(self.whole)
        self._sent = False
        chosen = list(range(self.count) if lanes is None else lanes)
        self._part[chosen] = -1
        fresh: dict[int, list[int]] = {}
        for lane in chosen:
            distribution = self._distributions[lane]
            which = distribution.draw_task(self.generators[lane])
            part = self._part_of(distribution.models[which])
            number = next(i for i, other in enumerate(self._parts) if other is part)
            fresh.setdefault(number, []).append(lane)
            self._names[lane] = distribution.names[which]
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

    def _split_tasks(self, whole: Lanes) -> None:
        """Switch from the lanes of a single task to those of several tasks; running episodes continue."""
        self.whole = None
        if whole.has_episodes:
            whole.grow(whole.width)
        else:
            self._parts, self._part[:] = [], -1

    # --- steps of the lanes

    def parts(self, *values: Array) -> list[tuple[Any, ...]]:
        """Return the :class:`.Lanes` of every task in use, each with its entries of arrays ``(count, ...)``."""
        return [
            (self._parts[i], *(v[source] for v in values))
            for i, source in zip(self._flying, self._sources, strict=True)
        ]

    def gather(self, values: Sequence[Array]) -> Array:
        """Return one array ``(count, ...)`` from results for each of the :meth:`parts`, ``(places, ...)``."""
        if isinstance(values[0], numpy.ndarray):
            return (
                numpy.array(values[0]) if self.whole is not None else numpy.concatenate(values)[self._where]
            )
        if self.whole is not None:
            return self.whole.model.task.xp.asarray(values[0], copy=True)
        return self._parts[0].model.task.xp.concat(list(values))[self._where]

    def step_reward(self, action: Array, kind: str) -> Array:
        """Apply one action in each lane; return the mean rewards over its measurements, ``(count,)``."""
        if self.whole is not None:
            return self.whole.step_reward(action, kind)
        return self.gather([part.step_reward(own, kind) for part, own in self.parts(action)])

    def observe(self) -> Array:
        """Return the observations of all lanes, batch first."""
        if self.whole is not None:
            return self.whole.observe()
        return self.gather([part.observe() for (part,) in self.parts()])

    @property
    def decisions(self) -> numpy.ndarray:
        """Number of decisions so far in each lane's episode, ``(count,)``."""
        return numpy.asarray(self.gather([part.decisions for (part,) in self.parts()]))

    @property
    def done(self) -> numpy.ndarray:
        """Whether the episode of each lane is over, booleans ``(count,)``."""
        if self.whole is not None:
            return self.whole.done
        return numpy.asarray(self.gather([part.done for (part,) in self.parts()]))

    def shorten(self, lanes: Sequence[int], decisions: numpy.ndarray) -> None:
        """Shorten the episodes that just began in some lanes by some decisions each, to one at least."""
        for lane, by in zip(lanes, decisions, strict=True):
            self._parts[self._part[lane]].shorten([int(self._place[lane])], by)

    @property
    def has_episodes(self) -> bool:
        """Whether every lane has an episode."""
        return self.whole.has_episodes if self.whole is not None else bool((self._part >= 0).all())

    def detach(self) -> None:
        """Detach the running episodes from the autograd graph (torch only)."""
        for (part,) in self.parts():
            part.detach()

    def snapshot(self) -> dict[str, Any]:
        """Return a copy of the complete state of all episodes, random numbers included."""
        kept = {name: copy.deepcopy(getattr(self, name)) for name in _STATE_ATTRIBUTES}
        return {"count": self.count, **kept, "parts": [(p.model, p.count, p.snapshot()) for p in self._parts]}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Restore the state of a :meth:`snapshot`; ValueError if its number of lanes differs."""
        if snapshot["count"] != self.count:
            raise ValueError(f"the snapshot holds {snapshot['count']} environments, not {self.count}")
        for name in _STATE_ATTRIBUTES:
            setattr(self, name, copy.deepcopy(snapshot[name]))
        there = {(part.model, part.count): part for part in self._parts}
        self._parts = [
            there.get((model, count)) or self._make_lanes(model, count)
            for model, count, _ in snapshot["parts"]
        ]
        for part, (_, _, kept) in zip(self._parts, snapshot["parts"], strict=True):
            part.restore(kept)
        for lane in numpy.flatnonzero(self._part >= 0):
            self._parts[self._part[lane]].seed(int(self._place[lane]), self.generators[lane])
        self._arrange()


_STATE_ATTRIBUTES = ("generators", "_distributions", "_part", "_place", "_names", "_sent")
"""Attributes of a fleet that change."""
