"""Gradients of traced expressions, by reverse-mode differentiation.

Where a derivative is not unique it is that of torch: half for each of two equal numbers in a maximum, all for a number
exactly on a constant limit, none for an index of a table.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

from . import namespace as xp
from .namespace import Traced
from .program import LOGICAL, Graph

FLAT = frozenset((*LOGICAL, "sign", "floor", "ceil", "trunc", "rint", "number", "take", "input", "constant"))
"""Operations with a gradient of zero."""


def _of_the_larger(a: Any, one: Any, other: Any) -> tuple[Any, Any]:
    chosen = xp.where(one == other, 0.5 * a, xp.where(one > other, a, 0.0))
    return chosen, a - chosen


def _of_the_limited(a: Any, y: Any, one: Any, other: Any) -> tuple[Any, Any]:
    return xp.where(y == one, a, 0.0), xp.where(y == other, a, 0.0)


def _of_power(a: Any, y: Any, base: Any, exponent: Any) -> tuple[Any, Any]:
    slope = xp.where(exponent == 0.0, 0.0, exponent * base ** (exponent - 1.0))
    return a * slope, xp.where((base == 0.0) & (exponent >= 0.0), 0.0, a * y * xp.log(base))


RULES: dict[str, Callable[..., tuple[Any, ...]]] = {
    "add": lambda a, y, one, other: (a, a),
    "subtract": lambda a, y, one, other: (a, -a),
    "multiply": lambda a, y, one, other: (a * other, a * one),
    "divide": lambda a, y, one, other: (a / other, -(a * y / other)),
    "remainder": lambda a, y, one, other: (a, -(a * xp.floor(one / other))),
    "maximum": lambda a, y, one, other: _of_the_larger(a, one, other),
    "minimum": lambda a, y, one, other: _of_the_larger(a, other, one),
    "where": lambda a, y, truth, one, other: (None, xp.where(truth, a, 0.0), xp.where(truth, 0.0, a)),
    "atan2": lambda a, y, one, other: (
        a * other / (one * one + other * other),
        -(a * one / (one * one + other * other)),
    ),
    "pow": _of_power,
    "hypot": lambda a, y, one, other: (a * one / y, a * other / y),
    "negative": lambda a, y, x: (-a,),
    "absolute": lambda a, y, x: (a * xp.sign(x),),
    "sqrt": lambda a, y, x: (a / (2.0 * y),),
    "exp": lambda a, y, x: (a * y,),
    "expm1": lambda a, y, x: (a * (y + 1.0),),
    "exp2": lambda a, y, x: (a * y * math.log(2.0),),
    "log": lambda a, y, x: (a / x,),
    "log1p": lambda a, y, x: (a / (1.0 + x),),
    "log2": lambda a, y, x: (a / (x * math.log(2.0)),),
    "log10": lambda a, y, x: (a / (x * math.log(10.0)),),
    "sin": lambda a, y, x: (a * xp.cos(x),),
    "cos": lambda a, y, x: (-(a * xp.sin(x)),),
    "tan": lambda a, y, x: (a * (1.0 + y * y),),
    "asin": lambda a, y, x: (a / xp.sqrt(1.0 - x * x),),
    "acos": lambda a, y, x: (-(a / xp.sqrt(1.0 - x * x)),),
    "atan": lambda a, y, x: (a / (1.0 + x * x),),
    "sinh": lambda a, y, x: (a * xp.cosh(x),),
    "cosh": lambda a, y, x: (a * xp.sinh(x),),
    "tanh": lambda a, y, x: (a * (1.0 - y * y),),
    "asinh": lambda a, y, x: (a / xp.sqrt(1.0 + x * x),),
    "acosh": lambda a, y, x: (a / xp.sqrt(x * x - 1.0),),
    "atanh": lambda a, y, x: (a / (1.0 - x * x),),
}
"""Functions from the adjoint ``a`` of ``y``, ``y`` and its arguments to the adjoints of the arguments; None: no
gradient.
"""


def pullback(
    graph: Graph, outputs: Sequence[Traced], adjoints: Sequence[Traced], inputs: Sequence[Traced]
) -> list[Traced]:
    """Return the gradient of ``sum(adjoint * output)`` with respect to each of some arrays, by reverse mode.

    The graph must be open (:func:`.namespace.tracing`).

    Args:
        graph: that of the arrays.
        outputs: arrays that are functions of the inputs.
        adjoints: weights of the outputs, an array of the same shape for each.
        inputs: arrays of any shapes.
    """
    flowing: dict[int, Any] = {}
    roots: list[int] = []

    def flow(node: int, adjoint: Any) -> None:
        if graph.values[node] is None:
            flowing[node] = flowing[node] + adjoint if node in flowing else adjoint

    for output, adjoint in zip(outputs, adjoints, strict=True):
        for node, back in zip(output.nodes.ravel().tolist(), adjoint.nodes.ravel().tolist(), strict=True):
            roots.append(node)
            flow(node, Traced(back, xp.float64))
    for node in reversed(graph.live(roots)):
        name = graph.operations[node]
        if node not in flowing or name in FLAT:
            continue
        arguments = graph.arguments[node]
        if name == "entry":
            row, product = arguments
            for part, weight in zip(graph.parts(product), graph.matrix(product)[row].tolist(), strict=True):
                flow(part, flowing[node] * weight)
            continue
        y, *parts = (Traced(part, bool if graph.logical[part] else float) for part in (node, *arguments))
        known = [graph.values[argument] is not None for argument in arguments]
        rule = _of_the_limited if name in ("maximum", "minimum") and any(known) else RULES[name]
        for argument, back in zip(arguments, rule(flowing[node], y, *parts), strict=True):
            if back is not None:
                flow(argument, back)
    nothing = xp.asarray(0.0)
    return [
        xp.reshape(
            xp.stack([flowing.get(node, nothing) for node in array.nodes.ravel().tolist()]), array.shape
        )
        if array.size
        else array
        for array in inputs
    ]
