"""Recursions of parallel lanes in fixed arrays: one native call a step where their functions can be traced."""

import functools
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy

from ..compiler import functions
from ..compiler.functions import UNCOUNTED, Call, Specialised, leaves
from ..compiler.library import Library
from ..compiler.namespace import NotTraceable
from ..compiler.native import AVAILABLE
from ..compiler.sequence import CallSequence
from ..envs.engine.compiled import warn_not_compiled

Array = numpy.ndarray


class Recursion:
    """A recursion of N lanes (parallel episodes) in arrays ``(..., W)``, W the next multiple of eight.

    A step computes state and outputs from inputs and the state before; two memories of the state alternate. Where its
    function can be traced, a step and those of all followers are one native call.

    Args:
        arguments: of the class's constructor, with which a copy is made.
        leader: recursion of as many lanes, behind which this one runs at every step; None: it runs by itself.

    Attributes:
        lanes: N.
        own: index of the lanes among W; a single one has no axis.
        followers: recursions that run behind this one.
        outputs: arrays that the step function returned last; of the last one the transpose, ``(W, rows)``.
    """

    library: Library | None = None
    """Of the compiled functions; None: the fastest."""

    def __init__(self, arguments: Sequence[Any], lanes: int, leader: "Recursion | None" = None) -> None:
        self._arguments, self.lanes, self._width = arguments, lanes, functions.round_up_lanes(lanes)
        self.own: Any = 0 if lanes == 1 else slice(lanes), ...
        self._leader: Recursion = leader or self
        self._phases: Array = numpy.zeros(self._width) if leader is None else leader._phases
        self._now, self._left, self.followers = 0, 0, weakref.WeakSet[Any]()
        self._before: list[Any] = []
        """Calls of a range of lanes that precede every step."""

    def bind(self, step: Callable[..., Any], traced: Any, state: Any, given: Array, *inputs: Array) -> None:
        """Set the step function, and allocate and bind the arrays of its state and outputs.

        Args:
            step: function of ``(given, phases, *inputs)`` and the state, arrays of any namespace, that returns the next
                state and a tuple of arrays. A phase is 1 where an episode begins, 0 where it goes on, and -1 where
                state and outputs stay.
            traced: the same function and its graph for the compiler; None: it runs with NumPy.
            state: first state, nested tuples of arrays ``(..., 1)``.
            given: array that is written before a step, ``(W, ...)``; the step function takes it with W last.
            *inputs: further arrays.
        """
        first, leader = leaves(state), self._leader
        self._step, places, self._kinds = step, iter(range(len(first))), [one.dtype.kind for one in first]
        self._template = functions.map_arrays(lambda _: next(places), state)
        self._inputs = (numpy.moveaxis(given, 0, -1), self._phases, *inputs)
        memories = [numpy.repeat(one.astype(float), self._width, axis=-1) for one in first]
        self._states = memories, [one.copy() for one in memories]
        with numpy.errstate(all="ignore"):
            *outputs, last = step(self._inputs, self.state)[1]
        self.outputs: list[Array] = [numpy.array(one, order="C") for one in (*outputs, last.T)]
        self._calls: list[Any] = [functools.partial(self._run_step, now) for now in range(2)]
        if traced is not None and AVAILABLE:
            function, graph = traced
            try:
                special = Specialised(function, graph, (self._inputs, state), True, 0, True)
                special.compile(self.library)
                for now, (old, new) in enumerate((self._states, self._states[::-1])):
                    arrays = [given, *self._inputs[1:], *old], [*new, *self.outputs]
                    self._calls[now] = special.bound(*arrays)
            except NotTraceable as error:
                warn_not_compiled(f"a step of {type(self).__name__}", error)
        if leader is not self:
            leader.followers.add(self)
        leader._join_calls()

    def _join_calls(self) -> None:
        chain = [self, *self.followers]
        calls = [[*self._before, *(one._calls[now] for one in chain)] for now in range(2)]
        if all(isinstance(call, Call) for call in calls[0]):
            self._sequences = [CallSequence(each) for each in calls]
            self._runs: list[Any] = [one.call(self._width) for one in self._sequences]
        else:
            self._sequences = []
            self._runs = [lambda each=each: [call(0, self._width) for call in each] for each in calls]
        self._left = 0

    def _run_step(self, now: int, *lanes: int) -> None:
        """Run a step with NumPy."""
        with numpy.errstate(all="ignore"):
            state, (*outputs, last) = self._step(self._inputs, self.state)
        memories = *self._states[1 - now], *self.outputs
        for memory, array in zip(memories, (*leaves(state), *outputs, last.T), strict=True):
            memory[...] = array

    @property
    def state(self) -> Any:
        """Copy of the state, ``(..., W)``."""
        return functions.copy_arrays(self._template, self._states[self._leader._now], self._kinds)

    def run(self) -> None:
        """Run a step of all lanes, and that of all followers."""
        if self._left == 0:
            self._left = UNCOUNTED // self._width + 1
            for sequence in self._sequences:
                sequence.expect(UNCOUNTED // 2)
        self._left -= 1
        self._runs[self._now]()
        self._now = 1 - self._now

    def begin(self, begins: Array, steps: Array) -> None:
        """Run a step in which episodes of some lanes begin and others go on, both booleans ``(N,)``."""
        self._phases[:] = begins.any()
        self._phases[: self.lanes] = numpy.where(begins, 1.0, steps - 1.0)
        self.run()
        self._phases[:] = 0.0

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments and arrays; code is made anew."""
        return {"arguments": self._arguments, "arrays": self._arrays()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])  # type: ignore[misc]
        for own, array in zip(self._arrays(), state["arrays"], strict=True):
            own[...] = array

    def _arrays(self) -> list[Array]:
        return [*self._states[self._leader._now], *self._inputs, *self.outputs]
