"""Measurements of compiled episodes that are flown, kept, and then differentiated in reverse.

Forward every measurement writes the episodes after it into memory of their own. Backward the code of a step's
pullback (:mod:`..compiler.gradients`) computes the step again from them and turns the gradient with respect to what
comes out of it into that with respect to what went in.
"""

import functools
from typing import Any

import numpy

from ...compiler import namespace as traced
from ...compiler.functions import Specialised, address_of, empty_lanes, leaves, map_arrays
from ...compiler.gradients import pullback
from ..contract.model import Episode
from .programs import Programs, step_episodes

ADDRESS_SLOTS = slice(1, 7, 2)
"""Where the table of a :class:`~..compiler.functions.Call` holds the addresses of episodes, action and noise."""


def _unpack(like: Episode, state: Any) -> Episode:
    """Episode whose numbers are the rows of an array, ``(rows, N)``."""
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


def _forward(programs: Programs, kind: str, state: Any, action: Any, noise: Any) -> Any:
    """Episodes at the next measurement, reward, and observation."""
    episode = _unpack(programs.later.episode, state)
    episode, reward, shown = step_episodes(kind, programs.traced, episode, action, noise)
    return _pack(episode), reward, shown


def _backward(programs: Programs, kind: str, state: Any, action: Any, noise: Any, *adjoints: Any) -> Any:
    """Gradients with respect to episodes and action, from those with respect to what :func:`_forward` returns."""
    outputs = _forward(programs, kind, state, action, noise)
    return tuple(pullback(programs.graph, outputs, adjoints, (state, action)))


@functools.lru_cache(16)
def _compile(programs: Programs, kind: str) -> tuple[Specialised, Specialised]:
    rows = sum(int(numpy.prod(leaf.shape[:-1])) for leaf in leaves(programs.later.episode))
    state = numpy.zeros((rows, 8))
    action = numpy.zeros((*(programs.traced.action_space.shape or ()), 8))
    given = (state, action, programs.row)
    answer = (state, numpy.zeros(8), numpy.zeros((len(programs.traced.fields), 8)))
    made = []
    for function, parts in ((_forward, given), (_backward, (*given, *answer))):
        bound = functools.partial(function, programs, kind)
        made.append(Specialised(bound, programs.graph, parts, unchanged=0))
    return made[0], made[1]


class Rollout:
    """Episodes of a compiled model under continuous actions, with the gradient of their rewards.

    Args:
        model: compiled.
        kind: of reward.
        width: lanes, a multiple of eight.
        measurements: that are kept at once.

    Attributes:
        action: of every measurement, ``(measurements, A, width)``, to be written before it is flown.
        noise: likewise, ``(measurements, row width, width)``.
        reward: of the last action, ``(width,)``.
        shown: last observation, ``(fields, width)``.
        reward_adjoint: gradient with respect to the reward, ``(width,)``, to be written.
        shown_adjoint: gradient with respect to the observation, ``(fields, width)``, to be written.
        action_adjoint: gradient with respect to the action, ``(A, width)``.
    """

    def __init__(self, model: Any, kind: str, width: int, measurements: int) -> None:
        forward, backward = _compile(model.programs, kind)
        rows, actions, noise = (leaf.rows for leaf in forward.inputs)
        self._states = [empty_lanes((rows,), width) for _ in range(measurements + 1)]
        self._next = empty_lanes((rows,), width)
        self.action = numpy.zeros((measurements, actions, width))
        self.noise = numpy.zeros((measurements, noise, width))
        self.reward, self.shown = numpy.empty(width), empty_lanes((len(model.fields),), width)
        self.reward_adjoint = numpy.zeros(width)
        self.shown_adjoint = numpy.zeros((len(model.fields), width))
        self.action_adjoint = numpy.zeros((actions, width))
        given = [self._states[0], self.action[0], self.noise[0]]
        self._forward = forward.bound(given, [self._next, self.reward, self.shown])
        adjoint, other = empty_lanes((rows,), width), empty_lanes((rows,), width)
        # One reads what the other has written.
        self._backward = [
            backward.bound(
                [*given, after, self.reward_adjoint, self.shown_adjoint], [before, self.action_adjoint]
            )
            for after, before in ((adjoint, other), (other, adjoint))
        ]
        memories = zip(self._states[:-1], self.action, self.noise, strict=True)
        self._places = numpy.array([[address_of(array) for array in memory] for memory in memories])
        self._width, self._flown = width, 0

    def load(self, episode: Episode) -> None:
        """Begin with other episodes."""
        values = [numpy.asarray(leaf).reshape(-1, self._width) for leaf in leaves(episode)]
        self._states[0][...] = numpy.concatenate(values)
        self._flown = 0

    def go_on(self) -> None:
        """Begin where the episodes are; what was flown is forgotten."""
        self._states[0][...] = self._states[self._flown]
        self._flown = 0

    def forward(self) -> None:
        """Fly one measurement."""
        here = self._flown
        self._forward.table[ADDRESS_SLOTS] = self._places[here]
        self._forward(0, self._width)
        # The code writes a row here and a row there, which is slow outside the cache.
        self._states[here + 1][...] = self._next
        self._flown += 1

    def backward_from_here(self) -> None:
        """Let the gradient with respect to the episodes as they are now be zero."""
        self._backward[0].arrays[3][...] = 0.0

    def backward(self, measurement: int) -> None:
        """Go back over a measurement, the last one first."""
        backward = self._backward[0]
        backward.table[ADDRESS_SLOTS] = self._places[measurement]
        backward(0, self._width)
        self._backward.reverse()
