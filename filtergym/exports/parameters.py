"""Parameters of an exported filter that its user sets: inputs in place of the parameters of a task and of a tuning.

A filter is traced with expressions in place of its parameters, so that all numbers that it derives of them become part
of the program that starts a track. A branch that depends on parameters is a condition under which the program holds; a
parameter that becomes a plain number, or that decides a branch and nothing else, stays a constant.
"""

import dataclasses
import functools
import inspect
import math
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy

from ..baselines.table import Tunable
from ..baselines.tuned_values import TunedPolicy
from ..compiler import namespace
from ..compiler.namespace import Traced
from ..compiler.program import COMPARISONS, FUNCTIONS, OPERATIONS, Graph
from ..envs.contract.parameters import LARGEST, ParameterLimits, field_limits
from ..envs.contract.task import Task, field_words

PARAMETER = 6
"""Number of the parameters among the arguments of the program ``start``."""
NUMBERS = {name: compute for name, compute in FUNCTIONS.items() if hasattr(math, name)}
"""Functions that :mod:`math` has, too."""
EXACT = frozenset(OPERATIONS) - {"remainder"} | {"constant", "input", "take"}
"""Operations whose results have the same bits everywhere."""
SUMMED = 1e-9
"""Tolerance of a sum of probabilities around one, as in ``envs/contract/parameters.py``."""


class Declared(NamedTuple):
    """A declared parameter of an export: a number or an array, with its values, limits and meaning."""

    name: str
    shape: tuple[int, ...]
    values: tuple[float, ...]
    """Default values, row by row."""
    low: float
    high: float
    """Limits of every number, both included."""
    words: str
    """Meaning, with its unit."""
    limits: ParameterLimits = ParameterLimits()
    size: float | None = None
    """Parameter of which this is the decimal logarithm, where the filter itself has that parameter."""


class Declaration(NamedTuple):
    """The parameters of an exported competitor that can be set: those of its tuning, and its task's own."""

    tuned: list[Declared]
    """Parameters of its tuning."""
    own: list[Declared]
    """Parameters of the task."""
    tunable: Tunable | None

    @property
    def all(self) -> list[Declared]:
        """All parameters that can be set, those of the tuning first."""
        return [*self.tuned, *self.own]


def declaration(task: Task, maker: Any, tunables: Mapping[str, Tunable], name: str) -> Declaration:
    """Return the parameters of an exported competitor that its user can set."""
    if isinstance(maker, TunedPolicy):
        tunable, values = maker.tunable, maker.values
    else:
        tunable = tunables.get(name)
        values = tunable.start if tunable is not None else {}
    tuned, taken = [], set()
    arguments = _arguments(maker.make if isinstance(maker, TunedPolicy) else maker)
    prior: Any = arguments.get("prior")
    described = field_words(type(prior)) if hasattr(prior, "_asdict") else {}
    if tunable is not None:
        for key, (low, high) in tunable.limits.items():
            value, size, base = float(values[key]), None, key.removeprefix("log10_")
            if not isinstance(maker, TunedPolicy):
                value, size = _untuned_value(arguments, key, value)
            unit = tunable.units.get(base, "")
            words = described.get(base, f"{base.replace('_', ' ')}{', ' if unit else ''}{unit}")
            words = f"Decimal logarithm: {words}" if base != key else words
            tuned.append(Declared(key, (), (value,), min(low, value), max(high, value), words, size=size))
        taken = {*tunable.apply(values)[0], *tunable.limits}
    return Declaration(tuned, [p for p in _task_parameters(task.parameters) if p.name not in taken], tunable)


def _arguments(maker: Any) -> dict[str, Any]:
    """Return the arguments of a competitor's factory, and the fields of its argument ``prior``, by name."""
    given: dict[str, Any] = {}
    while isinstance(maker, functools.partial):
        maker, given = maker.func, {**maker.keywords, **given}
    if callable(maker):
        given = {one.name: one.default for one in inspect.signature(maker).parameters.values()} | given
    prior: Any = given.get("prior")
    return {**(prior._asdict() if hasattr(prior, "_asdict") else {}), **given}


def _untuned_value(arguments: Mapping[str, Any], name: str, start: float) -> tuple[float, float | None]:
    """Return a tunable parameter's untuned value; if that is a decimal logarithm, also its argument, else None."""
    is_log = name.startswith("log10_")
    size = arguments.get(name.removeprefix("log10_"))
    if isinstance(size, int | float) and not (is_log and size <= 0.0):
        return (math.log10(size), float(size)) if is_log else (float(size), None)
    return start, float(f"{10.0**start:.15g}") if is_log else None


def _task_parameters(parameters: Any) -> Iterator[Declared]:
    """Yield the numbers and arrays among a task's parameters that are floats, with limits and meaning."""
    words = {
        name: text for base in reversed(type(parameters).__mro__) for name, text in field_words(base).items()
    }
    cls: Any = type(parameters)
    for name, (hint, limits) in field_limits(cls).items():
        value = getattr(parameters, name)
        if value is None or float not in _kinds(hint):
            continue
        array = numpy.asarray(value, dtype=float)
        low, high = -LARGEST, LARGEST
        if limits.above is not None:
            low = max(math.nextafter(limits.above, math.inf), numpy.finfo(float).tiny)
        if limits.at_least is not None:
            low = limits.at_least
        if limits.below is not None:
            high = math.nextafter(limits.below, -math.inf)
        if limits.at_most is not None:
            high = limits.at_most
        if array.size:
            yield Declared(
                name, array.shape, tuple(array.ravel().tolist()), low, high, words.get(name, ""), limits
            )


def _kinds(hint: Any) -> set[Any]:
    inside = typing.get_args(hint)
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) in (tuple, typing.Union):
        return {kind for part in inside for kind in _kinds(part)}
    return {hint}


class ParameterGraph(Graph):
    """A graph of traced expressions in which parameters of the filter are inputs.

    Attributes:
        conditions: conditions of the branches, and their values.
        settled: rows of parameters that became plain numbers.
    """

    def __init__(self, free: Sequence[Declared]) -> None:
        super().__init__(callers=True)
        self.sizes = [one.size for one in free for _ in one.values]
        self.given = [value for one in free for value in one.values]
        self.limits = [(one.low, one.high) for one in free for _ in one.values]
        self.conditions: dict[int, bool] = {}
        self.settled: set[int] = set()
        self.usual: dict[int, Any] = {}
        """Values of expressions with the default parameters, where they are known."""
        self.ends: dict[int, tuple[float, float] | None] = {}

    def rows(self, nodes: Sequence[int]) -> set[int]:
        """Return the rows of parameters on which some nodes of the graph depend."""
        inputs = [self.arguments[node] for node in self.live(nodes) if self.operations[node] == "input"]
        return {row for argument, row in inputs if argument == PARAMETER}

    def value(self, node: int) -> Any:
        """Return a node's value with the default parameters; None if it depends on other inputs."""
        if node in self.usual:
            return self.usual[node]
        for part in self.live([node]):
            if part not in self.usual:
                self.usual[part] = self._value(part)
        return self.usual[node]

    def _value(self, node: int) -> Any:
        operation, arguments = self.operations[node], self.arguments[node]
        if self.values[node] is not None:
            return self.values[node]
        if operation == "input":
            return float(self.given[arguments[1]]) if arguments[0] == PARAMETER else None
        parts = [self.usual[part] for part in self.parts(node)]
        if any(part is None for part in parts):
            return None
        if operation == "take":
            table = self.tables[arguments[0]]
            return float(table[min(max(int(parts[0] + len(table) * (parts[0] < 0.0)), 0), len(table) - 1)])
        with numpy.errstate(all="ignore"):
            if operation == "pow":  # as Python computes it
                exponent = self.parts(node)[1]
                size = (
                    self.sizes[self.arguments[exponent][1]] if self.operations[exponent] == "input" else None
                )
                return _power(float(parts[0]), float(parts[1])) if size is None or parts[0] != 10.0 else size
            return ({**OPERATIONS, **FUNCTIONS}[operation])(*parts)

    def settle(self, node: int, use: str) -> Any:
        """Return the value of a node that Python code uses as a number; None if it needs other inputs.

        A branch becomes a condition of the program; parameters that are used as a plain number become constant.
        """
        found = self.value(node)
        if found is None:
            return None
        if use == "branch":
            if not self._is_limited(node, bool(found)):
                self.conditions[node] = bool(found)
        elif use == "number":
            self.settled |= self.rows([node])
        return found

    def is_exact(self, node: int) -> bool:
        """Return whether a node has the same bits on every machine: it uses exact operations alone."""
        return all(self.operations[part] in EXACT for part in self.live([node]))

    def _is_limited(self, node: int, holds: bool) -> bool:
        """Return whether a comparison has the value ``holds`` for all parameters within their limits."""
        name = self.operations[node]
        ends = [self._ends(part) for part in self.parts(node)]
        if name not in COMPARISONS or None in ends:
            return False
        one, other = typing.cast("list[tuple[float, float]]", ends)
        if name in ("equal", "not_equal"):
            return (one[1] < other[0] or other[1] < one[0]) and holds == (name == "not_equal")
        return all(bool(OPERATIONS[name](x, y)) == holds for x in one for y in other)

    def _ends(self, node: int) -> tuple[float, float] | None:
        """Return a node's smallest and largest value over the parameters' limits; None: unknown."""
        if node not in self.ends:
            self.ends[node] = self._ends_of_parts(node)
        return self.ends[node]

    def _ends_of_parts(self, node: int) -> tuple[float, float] | None:
        name, value = self.operations[node], self.values[node]
        if value is not None:
            return float(value), float(value)
        if name == "input":
            return self.limits[self.arguments[node][1]]
        if name not in ("add", "subtract", "multiply"):
            return None
        one, other = (self._ends(part) for part in self.parts(node))
        if one is None or other is None:
            return None
        found = [float(OPERATIONS[name](x, y)) for x in one for y in other]
        return min(found), max(found)


def _power(base: float, exponent: float) -> float:
    try:
        found = base**exponent
    except (OverflowError, ZeroDivisionError):
        return float(numpy.power(base, exponent))
    return found if isinstance(found, float) else math.nan


@contextmanager
def traced_functions(graph: ParameterGraph) -> Iterator[None]:
    """Let functions of :mod:`math` accept traced numbers, and return expressions, in a ``with`` block.

    Other arguments, and other threads, get numbers as before.
    """
    original = {name: getattr(math, name) for name in NUMBERS} | {
        "sqrt": math.sqrt,
        "isfinite": math.isfinite,
    }

    def traced(name: str, compute: Callable[..., Any]) -> Callable[..., Any]:
        def function(*arguments: Any) -> Any:
            if not any(isinstance(argument, Traced) for argument in arguments):
                return compute(*arguments)
            if name == "isfinite":  # what is given is checked
                return compute(graph.value(arguments[0].nodes.item()))
            if name == "log" and len(arguments) == 2:
                return function(arguments[0]) / function(arguments[1])
            made = getattr(namespace, name)(*arguments)
            if made.nodes.size == 1:
                values = [
                    graph.value(int(namespace.asarray(argument).nodes.ravel()[0])) for argument in arguments
                ]
                if None not in values:
                    graph.usual.setdefault(int(made.nodes.ravel()[0]), compute(*values))
            return made

        return function

    for name, compute in original.items():
        setattr(math, name, traced(name, compute))
    try:
        yield
    finally:
        for name, compute in original.items():
            setattr(math, name, compute)


def expressions(parameter: Declared, first: int, graph: Graph) -> Any:
    """Return a parameter as nested tuples of traced inputs of a graph, from row ``first`` on."""
    nodes = [graph.input(PARAMETER, first + i) for i in range(len(parameter.values))]

    def nested(part: numpy.ndarray) -> Any:
        if part.ndim == 0:
            return Traced(part, numpy.float64)
        return tuple(nested(inner) for inner in part)

    return nested(numpy.array(nodes, dtype=numpy.int64).reshape(parameter.shape))


def with_parameters(parameters: Any, values: Mapping[str, Any]) -> Any:
    """Return a copy of a task's parameters with some values replaced, unchecked, without cached results."""
    changed = object.__new__(type(parameters))
    for field in dataclasses.fields(parameters):
        object.__setattr__(changed, field.name, values.get(field.name, getattr(parameters, field.name)))
    return changed
