"""Rollout of compiled episodes whose states are stored, and reverse-mode differentiation through them.

Forward, every measurement writes the episodes after it into memory of their own. Backward, a step's pullback
(:mod:`..compiler.gradients`) computes the step again from them.
"""

import functools
from typing import Any, NamedTuple

import numpy

from ...compiler import namespace as traced
from ...compiler.functions import Specialised, address_of, empty_lanes, leaves, map_arrays
from ...compiler.gradients import pullback
from ..contract.model import Episode
from .programs import Programs
from .reward import REWARD_FUNCTIONS, teacher_reward


class TrainingObjective(NamedTuple):
    """Kind of reward whose gradient is computed, and the weight of a teacher's estimates in it."""

    kind: str
    """Kind of reward."""
    teacher_share: float = 0.0
    """Weight of a teacher's estimates against the truth in the reward, see :func:`.reward.teacher_reward`."""


def _unpack(like: Episode, state: Any) -> Episode:
    row = 0

    def leaf(array: numpy.ndarray) -> Any:
        nonlocal row
        shape = (*array.shape[:-1], 1)
        first, row = row, row + int(numpy.prod(shape))
        return traced.astype(traced.reshape(state[first:row], shape), array.dtype)

    unpacked: Episode = map_arrays(leaf, like)
    return unpacked


def _pack(episode: Episode) -> Any:
    arrays = [traced.astype(array, traced.float64) for array in leaves(episode)]
    return traced.concat([traced.reshape(array, (-1, 1)) for array in arrays])


def _forward(
    programs: Programs, reward: TrainingObjective, state: Any, action: Any, noise: Any, *teacher: Any
) -> Any:
    """Return the episodes at the next measurement as rows, their reward and observation."""
    model = programs.traced
    after = model.act(_unpack(programs.later.episode, state), action)
    episode, own = model.measure(after, noise), REWARD_FUNCTIONS[reward.kind](model, after)
    if teacher:
        taught = teacher_reward(reward.kind, model, after, *teacher)
        own = (1.0 - reward.teacher_share) * own + reward.teacher_share * taught
    return _pack(episode), own, model.observe(episode)


def _backward(
    programs: Programs, reward: TrainingObjective, state: Any, action: Any, noise: Any, *others: Any
) -> Any:
    """Return the gradients with respect to episodes and action from those of :func:`_forward`'s outputs.

    The latter are the last three arguments; those before them are the teacher's.
    """
    outputs = _forward(programs, reward, state, action, noise, *others[:-3])
    return tuple(pullback(programs.graph, outputs, others[-3:], (state, action)))


@functools.lru_cache(16)
def _compile(programs: Programs, reward: TrainingObjective) -> tuple[Specialised, Specialised]:
    rows = sum(int(numpy.prod(leaf.shape[:-1])) for leaf in leaves(programs.later.episode))
    state = numpy.zeros((rows, 8))
    action = numpy.zeros((*(programs.traced.action_space.shape or ()), 8))
    C = len(programs.traced.task.components)
    teacher = (numpy.zeros((C, 8)), numpy.zeros((C, C, 8))) if reward.teacher_share else ()
    given = (state, action, programs.row, *teacher)
    answer = (state, numpy.zeros(8), numpy.zeros((len(programs.traced.fields), 8)))
    made = []
    for function, parts in ((_forward, given), (_backward, (*given, *answer))):
        bound = functools.partial(function, programs, reward)
        made.append(Specialised(bound, programs.graph, parts, unchanged=0))
    return made[0], made[1]


class Rollout:
    """Episodes of a compiled model under continuous actions, with reverse-mode gradients of their rewards.

    Args:
        reward: objective of the gradient.
        measurements: number stored at once.

    Attributes:
        action: of every measurement, ``(measurements, A, width)``, to be written before :meth:`forward`.
        noise: of every measurement, ``(measurements, row width, width)``.
        teacher: of every measurement, means ``(measurements, C, width)`` and covariances ``(measurements, C C, width)``
            of a teacher; empty without one.
        reward: of the last action, ``(width,)``.
        shown: last observation, ``(fields, width)``.
        reward_adjoint: gradient with respect to the reward, ``(width,)``, to be written.
        shown_adjoint: gradient with respect to the observation, ``(fields, width)``, to be written.
        action_adjoint: gradient with respect to the action, ``(A, width)``.
    """

    def __init__(self, model: Any, reward: TrainingObjective, width: int, measurements: int) -> None:
        forward, backward = _compile(model.programs, reward)
        rows, actions, noise, *teacher = (leaf.rows for leaf in forward.inputs)
        self._states = [empty_lanes((rows,), width) for _ in range(measurements + 1)]
        self._next = empty_lanes((rows,), width)
        self.action: numpy.ndarray = numpy.zeros((measurements, actions, width))
        self.noise: numpy.ndarray = numpy.zeros((measurements, noise, width))
        self.teacher: list[numpy.ndarray] = [numpy.zeros((measurements, each, width)) for each in teacher]
        self.reward: numpy.ndarray = numpy.empty(width)
        self.shown: numpy.ndarray = empty_lanes((len(model.fields),), width)
        self.reward_adjoint: numpy.ndarray = numpy.zeros(width)
        self.shown_adjoint: numpy.ndarray = numpy.zeros((len(model.fields), width))
        self.action_adjoint: numpy.ndarray = numpy.zeros((actions, width))
        given = [self._states[0], self.action[0], self.noise[0], *(each[0] for each in self.teacher)]
        self._forward = forward.bound(given, [self._next, self.reward, self.shown])
        adjoint, other = empty_lanes((rows,), width), empty_lanes((rows,), width)
        # One reads the output of the other.
        self._backward = [
            backward.bound(
                [*given, after, self.reward_adjoint, self.shown_adjoint], [before, self.action_adjoint]
            )
            for after, before in ((adjoint, other), (other, adjoint))
        ]
        memories = zip(self._states[:-1], self.action, self.noise, *self.teacher, strict=True)
        self._places = numpy.array([[address_of(array) for array in memory] for memory in memories])
        self._adjoint = len(given)
        """Index, among the arrays of a call, of the gradient with respect to the episodes after it."""
        self._addresses = slice(1, 1 + 2 * len(given), 2)
        """Places of the addresses of inputs in the table of a :class:`~..compiler.functions.Call`."""
        self._width, self._flown = width, 0

    def load(self, episode: Episode) -> None:
        """Replace the running episodes, and delete the stored measurements."""
        values = [numpy.asarray(leaf).reshape(-1, self._width) for leaf in leaves(episode)]
        self._states[0][...] = numpy.concatenate(values)
        self._flown = 0

    def drop_stored(self) -> None:
        """Delete the stored measurements; the episodes continue."""
        self._states[0][...] = self._states[self._flown]
        self._flown = 0

    def forward(self) -> None:
        """Apply :attr:`action` in all episodes, step to the next measurement and store it."""
        here = self._flown
        self._forward.table[self._addresses] = self._places[here]
        self._forward(0, self._width)
        # The code writes a row here and a row there, which is slow outside the cache.
        self._states[here + 1][...] = self._next
        self._flown += 1

    def backward_from_here(self) -> None:
        """Set the gradient with respect to the current episodes to zero, before :meth:`backward`."""
        self._backward[0].arrays[self._adjoint][...] = 0.0

    def backward(self, measurement: int) -> None:
        """Propagate the gradient back through one stored measurement; call it for the last one first."""
        backward = self._backward[0]
        backward.table[self._addresses] = self._places[measurement]
        backward(0, self._width)
        self._backward.reverse()
