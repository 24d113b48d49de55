"""Recursions of parallel lanes in fixed arrays: one native call a step where their functions can be traced."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy

from ..compiler.functions import (
    CompiledFunction,
    copy_arrays,
    empty_lanes,
    leaves,
    map_arrays,
    round_up_lanes,
)
from ..compiler.library import Library
from ..compiler.namespace import NotTraceable
from ..compiler.native import AVAILABLE
from ..compiler.sequence import CallSequence
from ..envs.engine.compiled import warn_not_compiled

Array = numpy.ndarray


class Recursion:
    """A recursion of N lanes (parallel episodes) in arrays ``(..., W)``, W the next multiple of eight.

    Attributes:
        lanes: N.
        width: W.
        begins: 1 where an episode begins in the next step, else 0, ``(W,)``.
        steps: 1 where an episode goes on in the next step, else 0, ``(W,)``.
        own: index of the lanes among W: one has no axis.
        outputs: arrays that the step function returned last, of the last of them the transpose.
    """

    def __init__(self, arguments: Sequence[Any], lanes: int) -> None:
        self._arguments = arguments
        self.lanes, self.width = lanes, round_up_lanes(lanes)
        self.own: Any = 0 if lanes == 1 else slice(lanes)
        self.begins: Array = numpy.zeros(self.width)
        self.steps: Array = numpy.ones(self.width)

    def bind(
        self,
        step: Callable[..., Any],
        traced: CompiledFunction | None,
        state: Any,
        inputs: Sequence[Array],
        before: Sequence[Callable[[int, int], None]] = (),
        library: Library | None = None,
    ) -> None:
        """Bind a step function to arrays.

        Args:
            step: function of the state and ``(begins, steps, *inputs)``, nested tuples of arrays of any namespace; it
                returns the next state and a tuple of arrays.
            traced: the same function for the compiler; None: it runs with NumPy.
            state: first state.
            inputs: arrays that are written before a step.
            before: calls of a range of lanes that precede every step.
            library: of the compiled functions; default: the fastest.
        """
        self._step, self._inputs, self._before = step, (self.begins, self.steps, *inputs), before
        count, self._now = iter(range(len(leaves(state)))), 0
        self._template, self._kinds = (
            map_arrays(lambda _: next(count), state),
            [one.dtype.kind for one in leaves(state)],
        )
        with numpy.errstate(all="ignore"):
            *outputs, last = step(state, self._inputs)[1]
        self.outputs: list[Array] = [*map(self._memory, outputs), numpy.zeros(last.shape[::-1])]
        self._states = [[self._memory(one) for one in leaves(state)] for _ in range(2)]
        for memory, array in zip(self._states[0], leaves(state), strict=True):
            memory[...] = array
        self._runs: list[Callable[[int], None]] = []
        if traced is not None and AVAILABLE:
            try:
                special = traced.specialise(state, self._inputs)
            except NotTraceable as error:
                warn_not_compiled(f"a step of {type(self).__name__}", error)
                return
            special.compile(library)
            for old, new in (self._states, self._states[::-1]):
                call: Any = special.bound([*old, *self._inputs], [*new, *self.outputs])
                self._runs.append(CallSequence([*before, call]).run)  # type: ignore[list-item]

    def rows(self, array: Array) -> Array:
        """Return where the values of all lanes are written to an array ``(..., W)``; those of one fill all."""
        return numpy.moveaxis(array, -1, 0)[: None if self.lanes == 1 else self.lanes]

    def _memory(self, like: Array) -> Array:
        return empty_lanes(like.shape[:-1], self.width)

    def __getstate__(self) -> dict[str, Any]:
        """Return arguments and arrays; code is made anew."""
        return {"arguments": self._arguments, "arrays": self._arrays()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])  # type: ignore[misc]
        for own, array in zip(self._arrays(), state["arrays"], strict=True):
            own[...] = array

    def _arrays(self) -> list[Array]:
        return [*self._states[self._now], *self._inputs, *self.outputs]

    @property
    def state(self) -> Any:
        """Copy of the state."""
        return copy_arrays(self._template, self._states[self._now], self._kinds)

    def run(self, begins: Array | None = None, steps: Array | None = None) -> None:
        """Run a step; ``begins`` and ``steps`` ``(N,)`` are booleans of the lanes that do, None: none and all."""
        if begins is not None:
            self.begins[: self.lanes], self.steps[: self.lanes] = begins, steps
            self.begins[self.lanes :] = begins.any()
        if self._runs:
            self._runs[self._now](self.width)
            self._now = 1 - self._now
        else:
            for call in self._before:
                call(0, self.width)
            with numpy.errstate(all="ignore"):
                state, (*outputs, last) = self._step(self.state, self._inputs)
            found = *leaves(state), *outputs, last.T
            for memory, array in zip((*self._states[0], *self.outputs), found, strict=True):
                memory[...] = array
        if begins is not None:
            self.begins[:], self.steps[:] = 0.0, 1.0
