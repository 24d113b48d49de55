"""Recursions of parallel lanes in fixed arrays: one native call a step where their functions can be traced."""

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy

from ..compiler.functions import (
    UNCOUNTED,
    Call,
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

    A step computes state and outputs from the state before and inputs. There are two memories of the state, used
    alternately. Where the step function can be traced, a step and those of all followers are one native call.

    Args:
        arguments: of the class's constructor, with which a copy is made.
        lanes: N.
        leader: recursion behind which this one runs at every step, of as many lanes; None: it runs by itself.

    Attributes:
        lanes: N.
        own: index of the lanes among W; a single one has no axis.
        outputs: arrays that the step function returned last; of the last one the transpose, ``(W, rows)``.
    """

    def __init__(self, arguments: Sequence[Any], lanes: int, leader: "Recursion | None" = None) -> None:
        self._arguments, self.lanes, self._width = arguments, lanes, round_up_lanes(lanes)
        self._leader: Recursion = leader or self
        self.own: Any = 0 if lanes == 1 else slice(lanes), ...
        if leader is None:
            self._begins, self._steps = numpy.zeros(self._width), numpy.ones(self._width)
            self._now, self._left, self.followers = 0, 0, weakref.WeakSet[Recursion]()

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
            given: array that is written before a step, ``(W, ...)``; the step function takes it with W last.
            inputs: further arrays.
            before: calls of a range of lanes that precede every step.
            library: of the compiled functions; default: the fastest.
        """
        leader, first = self._leader, leaves(state)
        places = iter(range(len(first)))
        self._step, self._before = step, before
        self._template, self._kinds = (
            map_arrays(lambda _: next(places), state),
            [one.dtype.kind for one in first],
        )
        self._inputs = (numpy.moveaxis(given, 0, -1), leader._begins, leader._steps, *inputs)
        with numpy.errstate(all="ignore"):
            *outputs, last = step(self._inputs, state)[1]
        self._states = [[self._memory(one) for one in first] for _ in range(2)]
        self.outputs: list[Array] = [*map(self._memory, outputs), last.T.copy()]
        self._calls: list[Callable[[int, int], None]] = [
            lambda _first, _last, now=now: self._run_step(now) for now in range(2)
        ]
        if traced is not None and AVAILABLE:
            try:
                special = Specialised(*traced, (self._inputs, state), True, 0, True)
                special.compile(library)
                for now, (old, new) in enumerate((self._states, self._states[::-1])):
                    read, written = [given, *self._inputs[1:], *old], [*new, *self.outputs]
                    self._calls[now] = special.bound(read, written)
            except NotTraceable as error:
                warn_not_compiled(f"a step of {type(self).__name__}", error)
        if leader is not self:
            leader.followers.add(self)
        leader._join_calls()

    def _memory(self, like: Array) -> Array:
        memory = empty_lanes(like.shape[:-1], self._width)
        memory[...] = like
        return memory

    def _join_calls(self) -> None:
        self._sequences: list[CallSequence] = []
        self._runs: list[Callable[[], Any]] = []
        for now in range(2):
            calls: Any = [*self._before, self._calls[now], *(one._calls[now] for one in self.followers)]
            if all(isinstance(call, Call) for call in calls):
                self._sequences.append(CallSequence(calls))
                self._runs.append(self._sequences[-1].call(self._width))
            else:
                self._runs.append(lambda calls=calls: [call(0, self._width) for call in calls])
        self._left = 0

    def _run_step(self, now: int) -> None:
        """Run a step with NumPy."""
        with numpy.errstate(all="ignore"):
            state, (*outputs, last) = self._step(self._inputs, self.state)
        memories = *self._states[1 - now], *self.outputs
        for memory, array in zip(memories, (*leaves(state), *outputs, last.T), strict=True):
            memory[...] = array

    @property
    def state(self) -> Any:
        """Copy of the state."""
        return copy_arrays(self._template, self._states[self._leader._now], self._kinds)

    def run(self) -> None:
        """Run a step of all lanes."""
        if self._left == 0:
            self._left = UNCOUNTED // self._width + 1
            for sequence in self._sequences:
                sequence.expect(UNCOUNTED // 2)
        self._left -= 1
        self._runs[self._now]()
        self._now = 1 - self._now

    def begin(self, begins: Array, steps: Array) -> None:
        """Run a step in which episodes of some lanes begin, some go on, and others stay as they are.

        Args:
            begins: whose episodes begin, booleans ``(N,)``.
            steps: which go on, booleans ``(N,)``.
        """
        self._begins[: self.lanes], self._steps[: self.lanes] = begins, steps
        self._begins[self.lanes :] = begins.any()
        self.run()
        self._begins[:], self._steps[:] = 0.0, 1.0

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments and arrays; code is made anew."""
        return {"arguments": self._arguments, "arrays": self._arrays()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])  # type: ignore[misc]
        for own, array in zip(self._arrays(), state["arrays"], strict=True):
            own[...] = array

    def _arrays(self) -> list[Array]:
        return [*self._states[self._leader._now], *self._inputs, *self.outputs]
