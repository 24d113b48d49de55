"""Functions of a vector with exact Jacobians, for arrays of any namespace.

A user's function in NumPy is traced once, on a vector of symbols, and its Jacobian is derived by reverse mode, one row
for each entry of the result (:mod:`.gradients`). Both are straight lines of arithmetic on one lane, which any array
namespace can compute.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy

from . import namespace
from .gradients import pullback
from .namespace import NotTraceable, Traced
from .program import Graph, ProgramResult, StraightLineProgram, program

_OPERATORS: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "negative": operator.neg,
}
"""Operations that accept Python numbers as well as arrays."""
_NAMES = {"absolute": "abs", "rint": "round"}
"""Names in the array API standard of operations that have another name here."""


class VectorFunction:
    """A function of a vector, traced, with its Jacobian by reverse-mode differentiation.

    Args:
        function: function from an array ``(n + g,)`` to a sequence or an array of m numbers; or a matrix ``(m, n)``.
        size: number n of inputs with a derivative; 0 for a function without a derivative.
        given: number g of further arguments after these n numbers, without a derivative; default: 0.

    Attributes:
        size: number m of outputs.
        inputs: number n of inputs with a derivative.
        given: number g of further inputs.
        matrix: the Jacobian if it is constant and g is 0, ``(m, n)``; else None.
        offset: value at zero if the Jacobian is constant and g is 0, ``(m,)``; else None.

    Raises:
        NotTraceable: if the function is not a straight line of arithmetic.
        ValueError: if the result is not a vector.
    """

    def __init__(self, function: Callable[[Any], Any] | numpy.ndarray, size: int, given: int = 0) -> None:
        graph = Graph()
        self.inputs = size
        self.given = given
        with namespace.tracing(graph):
            rows = [graph.input(0, row) for row in range(size + given)]
            x = Traced(numpy.array(rows, dtype=numpy.int64), namespace.float64)
            answer = namespace.asarray(function(x) if callable(function) else function @ x)
            shape = answer.shape
            gradients = [
                pullback(graph, [answer[i]], [namespace.asarray(1.0)], [x])[0]
                for i in range(len(answer) if size and len(shape) == 1 else 0)
            ]
        if len(shape) != 1:
            raise ValueError(
                f"must return a vector, such as a list of numbers, got an array of shape {shape}"
            )
        self.size: int = shape[0]
        nodes = [node for gradient in gradients for node in gradient.nodes[:size].tolist()]
        self._value = _program(graph, answer.nodes.tolist())
        self._jacobian = _program(graph, nodes)
        known = [graph.values[node] for node in nodes]
        self.matrix: numpy.ndarray | None = None
        self.offset: numpy.ndarray | None = None
        if None not in known and not given:
            self.matrix = numpy.array(known, dtype=float).reshape(self.size, size)
            self.offset = self.value(numpy.zeros((size, 1)), numpy)[:, 0]

    @functools.cached_property
    def linear(self) -> numpy.ndarray:
        """Mask ``(m, n)`` of the entries of the Jacobian that are constant, judged at random states."""
        rng, count = numpy.random.default_rng(0), 8
        x = rng.normal(size=(self.inputs, 4 * count)) * numpy.repeat(10.0 ** numpy.arange(4), count)
        given = numpy.repeat(rng.uniform(0.1, 1.0, (self.given, 1)), 4 * count, axis=1)
        with numpy.errstate(all="ignore"):
            J = self.jacobian(numpy.concatenate([x, given]), numpy)
            found: numpy.ndarray = numpy.ptp(J, axis=2) <= 1e-9 * numpy.abs(J).max(axis=2)
        return found

    @property
    def reads(self) -> tuple[frozenset[int], ...]:
        """For each output the indices of the inputs on which it depends."""
        found: list[frozenset[int]] = []
        for name, arguments, _ in self._value.steps:
            if name == "input":
                found.append(frozenset([arguments[1]]))
            else:
                before = () if name == "constant" else arguments
                found.append(frozenset().union(*(found[place] for place in before)))
        return tuple(found[result.node] for result in self._value.results)

    def value(self, x: Any, xp: Any) -> Any:
        """Return the function's values ``(m, N)`` at vectors ``(n + g, N)``."""
        return xp.stack(_compute(self._value, x, xp))

    def jacobian(self, x: Any, xp: Any) -> Any:
        """Return the Jacobians ``(m, n, N)`` with respect to the first n inputs at vectors ``(n + g, N)``."""
        entries, n = _compute(self._jacobian, x, xp), self.inputs
        return xp.stack([xp.stack(entries[i * n : (i + 1) * n]) for i in range(self.size)])


def _program(graph: Graph, nodes: Sequence[int]) -> StraightLineProgram:
    return program(graph, [ProgramResult(1, row, node) for row, node in enumerate(nodes)])


def _compute(program: StraightLineProgram, x: Any, xp: Any) -> list[Any]:
    """Return the results of a program on lanes ``(n, N)``, as a list of arrays ``(N,)``."""
    values: list[Any] = []

    def array(place: int) -> Any:
        value = values[place]
        return value if hasattr(value, "shape") else xp.full_like(x[0], value)

    for name, arguments, logical in program.steps:
        if name == "input":
            value: Any = x[arguments[1]]
        elif name == "constant":
            value = float(program.constants[arguments[0]])
            value = xp.full_like(x[0], value) != 0.0 if logical else value
        elif name in _OPERATORS:
            value = _OPERATORS[name](*(values[place] for place in arguments))
        elif name == "number":
            value = xp.astype(values[arguments[0]], xp.float64)
        elif hasattr(xp, _NAMES.get(name, name)):
            value = getattr(xp, _NAMES.get(name, name))(*(array(place) for place in arguments))
        else:
            raise NotTraceable(f"{name} has no counterpart in {xp.__name__}")
        values.append(value)
    return [array(result.node) for result in program.results]
