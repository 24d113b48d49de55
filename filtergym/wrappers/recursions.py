"""Recursions of parallel lanes in fixed arrays: one native call a step where their functions can be traced."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy

from ..compiler.functions import (
    UNCOUNTED,
    Specialised,
    copy_arrays,
    empty_lanes,
    leaves,
    map_arrays,
    round_up_lanes,
)
from ..compiler.library import Library
from ..compiler.namespace import NotTraceable
from ..compiler.native import AVAILABLE
from ..compiler.program import Graph
from ..compiler.sequence import CallSequence
from ..envs.engine.compiled import warn_not_compiled

Array = numpy.ndarray


class Recursion:
    """A recursion of N lanes (parallel episodes) in arrays ``(..., W)``, W the next multiple of eight.

    Args:
        arguments: of the class's constructor, with which a copy is made.
        lanes: N.

    Attributes:
        lanes: N.
        own: index of the lanes among W; a single one has no axis.
        given: array that is written before a step, ``(W, ...)``.
        outputs: arrays that the step function returned last; of the last one the transpose, ``(W, rows)``.
    """

    def __init__(self, arguments: Sequence[Any], lanes: int) -> None:
        self._arguments, self.lanes, self._width = arguments, lanes, round_up_lanes(lanes)
        self.own: Any = 0 if lanes == 1 else slice(lanes), ...
        self._begins, self._steps = numpy.zeros(self._width), numpy.ones(self._width)

    def bind(
        self,
        step: Callable[..., Any],
        traced: tuple[Callable[..., Any], Graph] | None,
        state: Any,
        given: Array,
        inputs: Sequence[Array] = (),
        before: Sequence[Callable[[int, int], None]] = (),
        library: Library | None = None,
    ) -> None:
        """Bind a step function to arrays.

        Args:
            step: function of ``(given, begins, steps, *inputs)`` and the state, arrays of any namespace, that returns
                the next state and a tuple of arrays. ``begins`` and ``steps`` are 1 where an episode begins and where
                it goes on, else 0.
            traced: the same function and its graph for the compiler; None: it runs with NumPy.
            state: first state, nested tuples.
            given: first argument, transposed.
            inputs: further arrays that are written before a step.
            before: calls of a range of lanes that precede every step.
            library: of the compiled functions; default: the fastest.
        """
        self._step, self._before, self._now, self._left = step, before, 0, 0
        self.given: Array = given
        self._inputs = (numpy.moveaxis(given, 0, -1), self._begins, self._steps, *inputs)
        first, count = leaves(state), iter(range(len(leaves(state))))
        self._template, self._kinds = map_arrays(lambda _: next(count), state), [one.dtype.kind for one in first]
        self._states = [[self._memory(one) for one in first] for _ in range(2)]
        for memory, array in zip(self._states[0], first, strict=True):
            memory[...] = array
        with numpy.errstate(all="ignore"):
            *outputs, last = step(self._inputs, state)[1]
        self.outputs: list[Array] = [*map(self._memory, outputs), numpy.zeros(last.shape[::-1])]
        self._runs: list[Callable[[], None]] = [self._run_step] * 2
        self._sequences: list[CallSequence] = []
        if traced is None or not AVAILABLE:
            return
        try:
            special = Specialised(*traced, (self._inputs, state), True, 0, True)
        except NotTraceable as error:
            warn_not_compiled(f"a step of {type(self).__name__}", error)
            return
        special.compile(library)
        for old, new in (self._states, self._states[::-1]):
            call: Any = special.bound([given, *self._inputs[1:], *old], [*new, *self.outputs])
            self._sequences.append(CallSequence([*before, call]))  # type: ignore[list-item]
        self._runs = [one.call(self._width) for one in self._sequences]

    def _memory(self, like: Array) -> Array:
        memory = empty_lanes(like.shape[:-1], self._width)
        memory[...] = 0.0
        return memory

    def _run_step(self) -> None:
        """Run a step with NumPy."""
        for call in self._before:
            call(0, self._width)
        with numpy.errstate(all="ignore"):
            state, (*outputs, last) = self._step(self._inputs, self.state)
        memories = *self._states[1 - self._now], *self.outputs
        for memory, array in zip(memories, (*leaves(state), *outputs, last.T), strict=True):
            memory[...] = array

    @property
    def state(self) -> Any:
        """Copy of the state."""
        return copy_arrays(self._template, self._states[self._now], self._kinds)

    def run(self, begins: Array | None = None, steps: Array | None = None) -> None:
        """Run a step of all lanes, or begin episodes of some, go on with some, and leave others as they are.

        Args:
            begins: whose episodes begin, booleans ``(N,)``.
            steps: which go on, booleans ``(N,)``.
        """
        if begins is not None:
            self._begins[: self.lanes], self._steps[: self.lanes] = begins, steps
            self._begins[self.lanes :] = begins.any()
        if self._left == 0:
            self._left = UNCOUNTED // self._width + 1
            for sequence in self._sequences:
                sequence.expect(UNCOUNTED // 2)
        self._left -= 1
        self._runs[self._now]()
        self._now = 1 - self._now
        if begins is not None:
            self._begins[:], self._steps[:] = 0.0, 1.0

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments and arrays; code is made anew."""
        return {"arguments": self._arguments, "arrays": self._arrays()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])  # type: ignore[misc]
        for own, array in zip(self._arrays(), state["arrays"], strict=True):
            own[...] = array

    def _arrays(self) -> list[Array]:
        return [*self._states[self._now], *self._inputs, *self.outputs]
