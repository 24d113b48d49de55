"""Functions of nested tuples of arrays, compiled for each structure of their arguments."""

import functools
import itertools
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy

from . import namespace
from .block import LANES
from .library import Library
from .native import Code, Native, native
from .program import Graph, ProgramResult, StraightLineProgram, program

DTYPES: dict[str, Any] = {"f": numpy.float64, "i": numpy.int64, "b": numpy.bool_}
UNCOUNTED = 65_536
"""Number of lanes between two checks for optimised code; a check at every call would take a tenth of a short step."""
FEWEST = 512
"""Minimal number of lanes of a thread."""


class Leaf(NamedTuple):
    """Shape and type of one array in nested tuples."""

    shape: tuple[int, ...]
    """Shape without the last axis, that of the lanes."""
    kind: str
    """Kind of the dtype: ``f``, ``i`` or ``b``."""

    @property
    def rows(self) -> int:
        """Number of entries of the array in each lane (parallel episode)."""
        return math.prod(self.shape)


def leaves(part: Any) -> list[Any]:
    """Return the arrays in nested tuples and dictionaries as a flat list; None contains no array."""
    if part is None:
        return []
    if isinstance(part, dict):
        part = tuple(part.values())
    if isinstance(part, tuple):
        return [leaf for item in part for leaf in leaves(item)]
    return [part]


def map_arrays(function: Callable[[Any], Any], part: Any) -> Any:
    """Apply a function to every array in nested tuples and dictionaries, and return the results so nested."""
    if part is None:
        return None
    if isinstance(part, dict):
        return {name: map_arrays(function, item) for name, item in part.items()}
    if isinstance(part, tuple):
        parts = [map_arrays(function, item) for item in part]
        return type(part)(*parts) if hasattr(part, "_fields") else tuple(parts)
    return function(part)


def _leaf(array: Any) -> Leaf:
    kind = array.dtype.kind
    if kind not in "fiub":
        raise namespace.NotTraceable(f"arrays of {array.dtype} cannot be traced")
    return Leaf(array.shape[:-1], "i" if kind == "u" else kind)


class Specialised:
    """A function traced for arguments of one structure, with its compiled program.

    Args:
        function: function of nested tuples of arrays.
        turned: whether the last array of the result has layout ``(N, rows)``, lane by lane.
        unchanged: outputs that may be replaced by an unchanged input: all of them (None), or those with a number below
            this one, by the input of the same number.

    Attributes:
        outputs: arrays of the result.
        same: for each output the number of the input that replaces it, or None.
        template: nested tuples of the result, with the numbers of ``outputs`` in place of arrays.

    Raises:
        NotTraceable: if the function is not a straight line of arithmetic.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        graph: Graph,
        parts: Sequence[Any],
        turned: bool = False,
        unchanged: int | None = None,
        given_turned: bool = False,
    ) -> None:
        self.inputs: list[Leaf] = [_leaf(array) for part in parts for array in leaves(part)]
        with namespace.tracing(graph):
            places = iter(range(len(self.inputs)))
            traced = [map_arrays(lambda _: _input(graph, next(places), self.inputs), part) for part in parts]
            answer = function(*traced)
            made = [namespace.asarray(array) for array in leaves(answer)]
        if any(array.shape[-1:] not in ((), (1,)) for array in made):  # larger than the memory of the code
            raise namespace.NotTraceable("an array of the result does not have the lanes as its last axis")
        count = iter(range(len(made)))
        self.template: Any = map_arrays(lambda _: next(count), answer)
        self.outputs: list[Leaf] = [_leaf(array) for array in made]
        given = {
            (_leaf(array), array.nodes.tobytes()): i
            for i, array in enumerate(array for part in traced for array in leaves(part))
            if array.nodes.size
        }
        same = [given.get((_leaf(array), array.nodes.tobytes())) for array in made]
        self.same: list[int | None] = [
            i if unchanged is None or (i == output and output < unchanged) else None
            for output, i in enumerate(same)
        ]
        wanted = [
            ProgramResult(len(self.inputs) + place, row, node)
            for place, array in enumerate(made)
            if self.same[place] is None
            for row, node in enumerate(array.nodes.ravel().tolist())
        ]
        self.program: StraightLineProgram = program(graph, wanted)
        self.lane_first: list[bool] = [False] * (len(self.inputs) + len(self.outputs))
        self.lane_first[-1] = turned
        self.lane_first[0] |= given_turned
        self.code: Code | None = None

    def compile(self, library: Library | None = None) -> Code:
        """Return the machine code of the traced function, compiled at the first call."""
        if self.code is None:
            self.code = native(self.program, self.lane_first, library)
        return self.code

    def bound(self, inputs: Sequence[numpy.ndarray], outputs: Sequence[numpy.ndarray]) -> "Call":
        """Return a call of the compiled function that is bound to these input and output arrays."""
        arrays = [*inputs, *outputs]
        table = [address_of(self.program.constants)]
        for array, lane_first in zip(arrays, self.lane_first, strict=True):
            table += [address_of(array), _lane_stride(array) if lane_first else _stride(array)]
        return Call(self.compile(), numpy.array(table, dtype=numpy.int64), arrays, self.program.constants)

    def call(self, arrays: Sequence[numpy.ndarray], width: int, threads: int) -> list[numpy.ndarray | None]:
        """Run the function on input arrays of ``width`` lanes; return its outputs, None for unchanged inputs."""
        table = [address_of(self.program.constants)]
        for array in arrays:
            table += [address_of(array), _stride(array)]
        rows = [leaf.rows if same is None else 0 for leaf, same in zip(self.outputs, self.same, strict=True)]
        memory = empty_lanes((sum(rows),), width)
        start, stride = address_of(memory), _stride(memory)
        outputs: list[numpy.ndarray | None] = []
        first = 0
        for leaf, same, count in zip(self.outputs, self.same, rows, strict=True):
            table += [start + memory.itemsize * first * stride, stride]
            part = memory[first : first + count]
            outputs.append(part.reshape(*leaf.shape, width) if same is None else None)
            first += count
        if self.lane_first[-1]:
            last = numpy.empty((width, rows[-1]))
            table[-2:] = [address_of(last), rows[-1]]
            outputs[-1] = last.T.reshape(*self.outputs[-1].shape, width)
        call = Call(
            self.compile(), numpy.array(table, dtype=numpy.int64), [memory, *arrays], self.program.constants
        )
        call.expect(width)
        run_over(call, width, threads)
        return outputs

    def example(self) -> Any:
        """Return zeros in the structure of the function's result, to trace another function with."""
        return map_arrays(
            lambda place: numpy.zeros(
                (*self.outputs[place].shape, LANES), dtype=DTYPES[self.outputs[place].kind]
            ),
            self.template,
        )


class Call:
    """Native call of compiled code on fixed arrays, for any range of lanes.

    Args:
        table: addresses and strides; entry ``1 + 2 i`` is the address of array i.
        constants: constants whose address is entry 0 of the table.

    Attributes:
        native: the current machine code, see :meth:`expect`; None before the first run.
    """

    def __init__(
        self, code: Code, table: numpy.ndarray, arrays: list[numpy.ndarray], constants: numpy.ndarray
    ) -> None:
        self._constants = constants
        self.table = table
        self.arrays = arrays
        self._code, self._uncounted = code, 0
        self.native: Native | None = None
        self.address: int = address_of(table)

    def expect(self, lanes: int, in_sequence: bool = False) -> Native:
        """Return the machine code for a run over this many lanes, see :meth:`.native.Code.expect`."""
        self.native = self._code.expect(lanes, in_sequence)
        return self.native

    def replace(self, place: int, array: numpy.ndarray) -> None:
        """Bind another array of the same shape as array number ``place`` of the call."""
        self.arrays[place] = array
        self.table[1 + 2 * place : 3 + 2 * place] = address_of(array), _stride(array)

    def copy(self) -> "Call":
        """Return a copy of the call, on the same arrays, whose arrays can be replaced independently."""
        return Call(self._code, self.table.copy(), list(self.arrays), self._constants)

    def __call__(self, first: int, last: int) -> None:
        """Run the code over the lanes from ``first`` up to, but not including, ``last``."""
        self._uncounted += last - first
        native = self.native
        if native is None or self._uncounted > UNCOUNTED:
            native = self.expect(self._uncounted)
            self._uncounted = 0
        native(self.address, first, last)


def run_over(
    call: Callable[[int, int], None], width: int, threads: int, fewest: int = FEWEST, grain: int = LANES
) -> None:
    """Call a function of a range of lanes on all lanes, divided between threads.

    ``call`` is a function of the first lane and the end of a range. A thread, of which this is one, has ``fewest``
    lanes at least; ``grain`` adjacent lanes are not divided. The results do not depend on the number of threads.
    """
    threads = min(threads, width // fewest)
    if threads <= 1:
        call(0, width)
        return
    cuts = [width * i // threads // grain * grain for i in range(threads)] + [width]
    pool = _pool(threads - 1, os.getpid())
    others = [pool.submit(call, *cut) for cut in itertools.pairwise(cuts[1:])]
    call(0, cuts[1])
    for other in others:
        other.result()


@functools.cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="lanes")


def round_up_lanes(count: int) -> int:
    """Return a number of lanes rounded up to a multiple of ``LANES``."""
    return -(-count // LANES) * LANES


def empty_lanes(shape: tuple[int, ...], width: int) -> numpy.ndarray:
    """Return an uninitialised float64 array ``(*shape, width)`` whose rows begin on cache lines."""
    # An odd number of cache lines, as rows a power of two apart would share few sets of the cache.
    stride = width + (LANES if width // LANES % 2 == 0 else 0)
    memory = numpy.empty(math.prod(shape) * stride + LANES)
    start = -address_of(memory) // memory.itemsize % LANES
    return memory[start : start + math.prod(shape) * stride].reshape(*shape, stride)[..., :width]


def memory_of(arrays: Sequence[Leaf], width: int) -> list[numpy.ndarray]:
    """Return uninitialised arrays of ``width`` lanes for the inputs or outputs of a program, as a list."""
    return [empty_lanes(leaf.shape, width) for leaf in arrays]


def copy_arrays(template: Any, memory: Sequence[numpy.ndarray], kinds: Sequence[str]) -> Any:
    """Return the template with each index replaced by a copy of that array, in its own type."""

    def copied(i: int) -> numpy.ndarray:
        return memory[i].astype(DTYPES[kinds[i]], order="C")

    return map_arrays(copied, template)


def _input(graph: Graph, argument: int, inputs: Sequence[Leaf]) -> Any:
    leaf = inputs[argument]
    nodes = numpy.array([graph.input(argument, row) for row in range(leaf.rows)], dtype=numpy.int64)
    array = namespace.Traced(nodes.reshape(*leaf.shape, 1), namespace.float64)
    if leaf.kind == "b":
        return namespace.not_equal(array, 0.0)
    return array if leaf.kind == "f" else namespace.Traced(array.nodes, namespace.int64)


class CompiledFunction:
    """A function of arrays, traced and compiled for every structure of its arguments.

    Args:
        function: function of nested tuples of arrays ``(..., N)``, which returns such tuples.
        unchanged: outputs that may be replaced by an unchanged input, see :class:`Specialised`.

    Raises:
        NotTraceable: at a call, if the function is not a straight line of arithmetic.
    """

    def __init__(
        self, function: Callable[..., Any], graph: Graph, turned: bool = False, unchanged: int | None = None
    ) -> None:
        self.function = function
        self.graph = graph
        self.turned = turned
        self.unchanged = unchanged
        self._specialised: dict[Any, Specialised] = {}

    def specialise(self, *parts: Any) -> Specialised:
        """Return the :class:`Specialised` function for arguments of this structure, from a cache."""
        key = tuple(_structure(part) for part in parts)
        if key not in self._specialised:
            self._specialised[key] = Specialised(
                self.function, self.graph, parts, self.turned, self.unchanged
            )
        return self._specialised[key]

    def __call__(self, *parts: Any, threads: int = 1) -> Any:
        """Return the function's result for nested tuples of arrays ``(..., N)``, computed by native code."""
        given = [array for part in parts for array in leaves(part)]
        special = self.specialise(*parts)
        count = max(array.shape[-1] for array in given)
        if any(array.shape[-1] not in (1, count) for array in given):
            raise ValueError(
                f"arrays must have one width, got {sorted({array.shape[-1] for array in given})}"
            )
        width = round_up_lanes(count)
        outputs = special.call([_ready(array, width) for array in given], width, threads)
        answer: list[Any] = []
        for output, same, leaf in zip(outputs, special.same, special.outputs, strict=True):
            if output is None or same is not None:
                answer.append(given[same or 0])
                continue
            cut = output if width == count else output[..., :count]
            answer.append(cut if leaf.kind == "f" else cut.astype(DTYPES[leaf.kind]))
        return map_arrays(lambda place: answer[place], special.template)


def _structure(part: Any) -> Any:
    """Return a hashable key of an argument's structure; arguments with equal keys share one program."""
    if isinstance(part, tuple):
        return type(part), *(_structure(item) for item in part)
    if isinstance(part, dict):
        return tuple((name, _structure(item)) for name, item in part.items())
    return part if part is None else _leaf(part)


def _ready(array: Any, width: int) -> numpy.ndarray:
    """Return an array as the code needs it: float64, contiguous rows, a multiple of eight lanes."""
    if array.__class__ is not numpy.ndarray or array.dtype != numpy.float64:
        array = numpy.asarray(array, dtype=numpy.float64)
    if array.shape[-1] != width:
        padding = numpy.broadcast_to(array[..., -1:], (*array.shape[:-1], width - array.shape[-1]))
        array = numpy.concatenate([array, padding], axis=-1)
    if array.flags.c_contiguous:
        return array
    strides, shape, size = array.strides, array.shape, array.itemsize
    even = all(strides[i] == strides[i + 1] * shape[i + 1] for i in range(array.ndim - 2))
    rows = strides[-2] if array.ndim > 1 else 0
    fits = strides[-1] == size and even and rows >= 0 and rows % size == 0
    return array if fits else numpy.ascontiguousarray(array)


def address_of(array: numpy.ndarray) -> int:
    """Return the memory address of an array's data."""
    return int(array.__array_interface__["data"][0])


def _stride(array: numpy.ndarray) -> int:
    # An axis of one row may have any stride.
    apart = [stride for length, stride in zip(array.shape[:-1], array.strides, strict=False) if length > 1]
    return apart[-1] // array.itemsize if apart else 0


def _lane_stride(array: numpy.ndarray) -> int:
    return array.strides[0] // array.itemsize
