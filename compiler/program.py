"""Graph of the expressions of one lane, and the straight-line program that computes some of them.

An expression is identified by its index in the :class:`Graph`. Equal expressions share one index (common
subexpressions), expressions of constants are computed at once (constant folding), and a program contains only what its
results need.
"""

import functools
import gc
import hashlib
import itertools
import os
import sys
import threading
import types
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy

COMPARISONS = ("less", "less_equal", "greater", "greater_equal", "equal", "not_equal")
LOGICAL = (*COMPARISONS, "logical_and", "logical_or", "logical_not")
COMMUTATIVE = frozenset(("add", "multiply", "equal", "not_equal", "logical_and", "logical_or"))
OPERATIONS: dict[str, Callable[..., Any]] = {
    **{
        name: getattr(numpy, name) for name in (*LOGICAL, "add", "subtract", "multiply", "divide", "negative")
    },
    **{name: getattr(numpy, name) for name in ("remainder", "maximum", "minimum", "sign", "absolute")},
    **{name: getattr(numpy, name) for name in ("floor", "ceil", "trunc", "rint", "sqrt")},
    "where": lambda truth, one, other: one if truth else other,
    "number": lambda truth: numpy.float64(truth),
}
"""NumPy function of each operation; ``number`` is 1 for true and 0 for false."""
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "exp": numpy.exp,
    "expm1": numpy.expm1,
    "exp2": numpy.exp2,
    "log": numpy.log,
    "log1p": numpy.log1p,
    "log2": numpy.log2,
    "log10": numpy.log10,
    "sin": numpy.sin,
    "cos": numpy.cos,
    "tan": numpy.tan,
    "asin": numpy.arcsin,
    "acos": numpy.arccos,
    "atan": numpy.arctan,
    "sinh": numpy.sinh,
    "cosh": numpy.cosh,
    "tanh": numpy.tanh,
    "asinh": numpy.arcsinh,
    "acosh": numpy.arccosh,
    "atanh": numpy.arctanh,
    "atan2": numpy.arctan2,
    "pow": numpy.power,
    "hypot": numpy.hypot,
}
"""NumPy function of each library function, by its name in C."""
LOCK = threading.RLock()
"""Lock held while a thread traces or compiles."""
if hasattr(os, "register_at_fork"):
    # A child has none of the other threads, and would wait forever for a lock of one of them.
    os.register_at_fork(before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=LOCK.release)
_COMPUTE = OPERATIONS | FUNCTIONS
_CONSTANTS: "weakref.WeakValueDictionary[tuple[bytes, ...], numpy.ndarray]" = weakref.WeakValueDictionary()
"""Cache of the constants of programs with tables, by scalars and digests; programs of many competitors share one log.
"""
_EXACT = frozenset(("add", "subtract", "multiply", "divide", "negative", "absolute", "sqrt"))
"""Operations whose NumPy results have the same bits for arrays as for numbers, on every processor."""
FEW = 16
"""Number of members of an array operation below which it is faster to add them one by one."""
BAND = 8
"""Number of rows of a matrix of constants that a loop sums in parallel."""
OTHERS = {"take": 1, "product": 2, "entry": 1}
"""Number of leading arguments of an expression that are no expressions, by operation."""
BEFORE = {"input": 2, "constant": 1, "take": 2, "product": 2, "entry": 1}
"""Number of leading arguments of a step that are no steps, by operation."""


def unband(table: numpy.ndarray, rows: int, columns: int) -> numpy.ndarray:
    """Return the matrix ``(rows, columns)`` of a product from its table, which is in the order of the loop."""
    return table.reshape(-1, columns, BAND).swapaxes(1, 2).reshape(-1, columns)[:rows]


@contextmanager
def without_collection() -> Iterator[None]:
    """Context manager: disable garbage collection and hold the compiler's lock.

    None of a hundred thousand new expressions is garbage, and repeated searches would take a third of the time.
    """
    with LOCK:  # otherwise a process forked meanwhile would never collect
        enabled = gc.isenabled()
        gc.disable()
        try:
            yield
        finally:
            if enabled:
                gc.enable()


class Graph:
    """Graph of the expressions of one lane, each stored once.

    ``input`` (argument, row) reads an input of the program; ``constant`` has a value; ``take`` (table, index) reads a
    table of constants; ``product`` (table, rows, *vector) multiplies a matrix of constants with a vector, and ``entry``
    (row, product) is a number of the result; every other expression is an entry of ``OPERATIONS`` or ``FUNCTIONS``.

    Attributes:
        operations: name of every expression's operation.
        arguments: arguments of every expression: indices of expressions; for an input argument and row; first the table
            for ``take``.
        values: value of every constant, None for other expressions.
        groups: number of the array operation that created each expression; expressions of one are independent.
        tables: tables of ``take`` and ``product``, ``(length,)`` each.
        loops: whether products with large matrices of constants are loops.
        callers: functions that called each array operation, by its number; None: not recorded.
    """

    def __init__(self, loops: bool = False, callers: bool = False) -> None:
        self.loops = loops
        self.callers: dict[int, str] | None = {} if callers else None
        self.operations: list[str] = []
        self.arguments: list[tuple[int, ...]] = []
        self.values: list[float | bool | None] = []
        self.logical: list[bool] = []
        self.groups: list[int] = []
        self.group: int = 0
        self.tables: list[numpy.ndarray] = []
        self.digests: list[bytes] = []
        """Digests of the tables."""
        self._found: dict[Any, int] = {}
        self._numbers, self._known = numpy.empty(0), numpy.empty(0, dtype=bool)
        self._counted = 0

    def _intern(self, key: Any, name: str, arguments: tuple[int, ...], value: Any, logical: bool) -> int:
        found = self._found.get(key)
        if found is None:
            found = self._found[key] = len(self.operations)
            self.operations.append(name)
            self.arguments.append(arguments)
            self.values.append(value)
            self.logical.append(logical)
            self.groups.append(self.group)
        return found

    def settle(self, node: int, use: str) -> Any:
        """Return the plain number of an expression; None, unless a subclass knows one.

        ``use`` is ``branch`` for a condition, ``number`` for a conversion to float, ``words`` for formatting.
        """
        return None

    def begin_group(self) -> None:
        """Begin a new array operation: later expressions are its elements."""
        self.group += 1
        if self.callers is not None:
            self.callers[self.group] = _callers()

    def input(self, argument: int, row: int) -> int:
        """Return the index of the expression that reads a row of an argument."""
        return self._intern(("input", argument, row), "input", (argument, row), None, False)

    def constant(self, value: Any) -> int:
        """Return the index of the expression of a constant number or boolean."""
        if isinstance(value, bool | numpy.bool_):
            return self._intern(("constant", bool(value)), "constant", (), bool(value), True)
        return self.constants(numpy.array([value], dtype=numpy.float64))[0]

    def constants(self, values: numpy.ndarray) -> list[int]:
        """Return the indices of the expressions of constant numbers ``(n,)``, as a list."""
        found, made = self._found, []
        # By bits, as -0.0 differs from 0.0, and NaN equals itself.
        for bits, value in zip(values.view(numpy.int64).tolist(), values.tolist(), strict=True):
            node = found.get(bits)
            if node is None:
                node = self._intern(bits, "constant", (), value, False)
            made.append(node)
        return made

    def take(self, table: numpy.ndarray, index: int) -> int:
        """Return the index of the expression of a table's entry; negative indices count from the end."""
        known = self.values[index]
        if known is not None:
            return self.constant(table[int(known)])
        if table.view(numpy.int64).min() == table.view(numpy.int64).max():  # all entries are equal
            return self.constant(table[0])
        place = self._table(table)
        return self._intern(("take", place, index), "take", (place, index), None, False)

    def product(self, matrix: numpy.ndarray, vector: Sequence[int]) -> list[int]:
        """Return the indices of the expressions of a matrix-vector product, summed in the order of columns.

        The table contains the matrix in the order of the loop: bands of ``BAND`` rows, the last one padded with zeros,
        and in each band the columns one after the other.
        """
        rows, columns = matrix.shape
        bands = -(-rows // BAND)
        padded = numpy.zeros((bands * BAND, columns))
        padded[:rows] = matrix
        table = padded.reshape(bands, BAND, columns).swapaxes(1, 2).ravel()
        arguments = (self._table(table), rows, *vector)
        whole = self._intern(("product", *arguments), "product", arguments, None, False)
        return [
            self._intern(("entry", row, whole), "entry", (row, whole), None, False) for row in range(rows)
        ]

    def matrix(self, product: int) -> numpy.ndarray:
        """Return the matrix of a product expression, ``(rows, columns)``."""
        table, rows, *vector = self.arguments[product]
        return unband(self.tables[table], rows, len(vector))

    def _table(self, table: numpy.ndarray) -> int:
        # A digest, because tables may have the length of a long recording.
        key = ("table", hashlib.blake2b(numpy.ascontiguousarray(table).data, digest_size=32).digest())
        if key not in self._found:
            self._found[key] = len(self.tables)
            self.tables.append(table)
            self.digests.append(key[1])
        return int(self._found[key])

    def node(self, name: str, *arguments: int) -> int:
        """Return the index of the expression of an operation on others, simplified if possible."""
        known = self.values
        values = [known[argument] for argument in arguments]
        if None not in values:
            with numpy.errstate(all="ignore"):
                return self.constant(_COMPUTE[name](*values))
        simpler = self._simpler(name, arguments, values)
        if simpler is not None:
            return simpler
        # Found in either order, and stored in the order of the array operation, so that its members have one form.
        key = (name, *(sorted(arguments) if name in COMMUTATIVE else arguments))
        logical = name in LOGICAL or (name == "where" and self.logical[arguments[1]])
        return self._intern(key, name, arguments, None, logical)

    def nodes(self, name: str, columns: Sequence[numpy.ndarray]) -> numpy.ndarray:
        """Return the indices of an array operation's expressions, ``(n,)``: :meth:`node` for many at once.

        ``columns`` are the expressions of each argument, ``(n,)``.
        """
        if len(columns[0]) < FEW:
            rows = zip(*(column.tolist() for column in columns), strict=True)
            return numpy.array([self.node(name, *row) for row in rows], dtype=numpy.int64)
        self._count()
        known = [self._known[column] for column in columns]
        numbers = [numpy.where(self._known[column], self._numbers[column], numpy.nan) for column in columns]
        made = numpy.full(len(columns[0]), -1)
        folded = numpy.logical_and.reduce(known)
        if name in _EXACT and folded.any():
            with numpy.errstate(all="ignore"):
                values = _COMPUTE[name](*(self._numbers[column[folded]] for column in columns))
            made[folded] = self.constants(values)
        if name in ("add", "multiply"):
            for number, other in ((numbers[0], 1), (numbers[1], 0)):
                same = (number == (0.0 if name == "add" else 1.0)) & ~known[other]
                made[same] = columns[other][same]
                if name == "multiply" and (nothing := (number == 0.0) & ~known[other]).any():
                    made[nothing] = self.constant(0.0)
        simpler = self._may_be_simpler(name, columns, known, numbers)
        plain = (made < 0) & ~folded & numpy.logical_not(simpler)
        made[plain] = self._intern_all(name, [column[plain] for column in columns])
        for k in numpy.flatnonzero(made < 0).tolist():
            made[k] = self.node(name, *(int(column[k]) for column in columns))
        return made

    def _may_be_simpler(
        self,
        name: str,
        columns: Sequence[numpy.ndarray],
        known: Sequence[numpy.ndarray],
        numbers: Sequence[Any],
    ) -> Any:
        """Return a mask of the elements that :meth:`_simpler` may simplify beyond :meth:`nodes`."""
        if name in ("maximum", "minimum"):
            return numpy.logical_or.reduce(
                [there & (number != number) for there, number in zip(known, numbers, strict=True)]
            )
        if name == "multiply":
            return (numbers[0] == -1.0) | (numbers[1] == -1.0)
        if name in ("subtract", "divide"):
            special = [(number == 0.0) | (number == 1.0) for number in numbers]
            return numpy.logical_or.reduce([*special, columns[0] == columns[1]])
        if name == "where":
            return known[0] | (columns[1] == columns[2])
        return name in ("negative", "logical_and", "logical_or")

    def _count(self) -> None:
        first, count = self._counted, len(self.values)
        if count > len(self._numbers):
            for each in ("_numbers", "_known"):
                longer = numpy.empty(2 * count, dtype=getattr(self, each).dtype)
                longer[:first] = getattr(self, each)[:first]
                setattr(self, each, longer)
        new = self.values[first:]
        self._numbers[first:count] = [0.0 if value is None else value for value in new]
        self._known[first:count] = [value is not None for value in new]
        self._counted = count

    def _intern_all(self, name: str, columns: Sequence[numpy.ndarray]) -> numpy.ndarray:
        ordered = (numpy.minimum(*columns), numpy.maximum(*columns)) if name in COMMUTATIVE else columns
        keys = list(zip(itertools.repeat(name), *(column.tolist() for column in ordered), strict=False))
        count = len(self.operations)
        # Numbered as if all were new; otherwise the new ones are numbered again.
        made = numpy.array(list(map(self._found.setdefault, keys, itertools.count(count))))
        fresh = numpy.flatnonzero(made == count + numpy.arange(len(keys)))
        if len(fresh) < len(keys):
            self._found.update({keys[place]: count + i for i, place in enumerate(fresh.tolist())})
            new = made >= count
            made[new] = count + numpy.searchsorted(fresh, made[new] - count)
            columns = [column[fresh] for column in columns]
        arguments = list(zip(*(column.tolist() for column in columns), strict=True))
        self.operations += [name] * len(fresh)
        self.arguments += arguments
        self.values += [None] * len(fresh)
        if name == "where":
            self.logical += [self.logical[one] for _, one, _ in arguments]
        else:
            self.logical += [name in LOGICAL] * len(fresh)
        self.groups += [self.group] * len(fresh)
        return made

    def _simpler(self, name: str, arguments: tuple[int, ...], values: list[Any]) -> int | None:
        """Return an expression that is equal for finite numbers and simpler; None if there is none."""
        if name in ("logical_and", "logical_or"):
            for known, other in ((0, 1), (1, 0)):
                if values[known] is not None:
                    # true and x = x, false or x = x; else the result is the known one
                    return arguments[other if values[known] == (name == "logical_and") else known]
            return arguments[0] if arguments[0] == arguments[1] else None
        if name == "where":
            if values[0] is not None:
                return arguments[1 if values[0] else 2]
            return arguments[1] if arguments[1] == arguments[2] else None
        if name in ("maximum", "minimum"):
            # The code takes the second one where a comparison is false, so a constant must not be NaN.
            return next((a for a, v in zip(arguments, values, strict=True) if v is not None and v != v), None)
        if name == "negative":
            inner = arguments[0]
            return self.arguments[inner][0] if self.operations[inner] == "negative" else None
        if name not in ("add", "subtract", "multiply", "divide"):
            return None
        (a, b), (x, y) = arguments, values
        if name == "multiply":
            if x == 0.0 or y == 0.0:
                return self.constant(0.0)
            if x == -1.0 or y == -1.0:
                return self.node("negative", b if x == -1.0 else a)
            return b if x == 1.0 else a if y == 1.0 else None
        if name == "add":
            return b if x == 0.0 else a if y == 0.0 else None
        if name == "subtract":
            if a == b:
                return self.constant(0.0)
            return a if y == 0.0 else self.node("negative", b) if x == 0.0 else None
        if x == 0.0:
            return self.constant(0.0)
        return a if y == 1.0 else None

    def live(self, wanted: Iterable[int]) -> list[int]:
        """Return the expressions that the wanted ones need, in topological order, each as late as possible."""
        seen = bytearray(len(self.operations))
        order: list[int] = []
        operations, arguments, finish = self.operations, self.arguments, order.append
        for root in wanted:
            waiting = [root]
            pop, wait, wait_all = waiting.pop, waiting.append, waiting.extend
            while waiting:
                node = pop()
                if node < 0:  # its parts are done
                    finish(~node)
                elif not seen[node]:
                    seen[node] = True
                    name = operations[node]
                    if name == "input" or name == "constant":
                        finish(node)
                        continue
                    wait(~node)
                    wait_all(self.parts(node)[::-1] if name in OTHERS else arguments[node][::-1])
        return order

    def parts(self, node: int) -> tuple[int, ...]:
        """Return the expressions that are direct arguments of an expression."""
        name = self.operations[node]
        return () if name == "input" else self.arguments[node][OTHERS.get(name, 0) :]


def _callers() -> str:
    found: dict[str, str] = {}
    frame: types.FrameType | None = sys._getframe(2)
    while frame is not None and len(found) < 2:
        stem, name = _stem_outside(frame.f_code.co_filename), frame.f_code.co_name
        if stem is not None and not name.startswith("<"):
            found.setdefault(stem, name)
        frame = frame.f_back
    return " of ".join(f"{file}.{name}" for file, name in found.items())


@functools.cache
def _stem_outside(path: str) -> str | None:
    return None if Path(path).parent == Path(__file__).parent else Path(path).stem


class ProgramResult(NamedTuple):
    """Destination of a computed value: a row of an argument."""

    argument: int
    row: int
    node: int


class ProgramStep(NamedTuple):
    """One operation of a program."""

    operation: str
    arguments: tuple[int, ...]
    """Indices of earlier steps. For ``input``: argument and row; for ``constant``: its index in ``constants``; for
    ``take``: the index of its table in ``constants``, its length and a step; for ``product``: the index of its table,
    its number of rows and the steps of the vector; for ``entry``: a row and the step of the product.
    """

    @property
    def parts(self) -> tuple[int, ...]:
        """Indices of the steps that are its arguments."""
        return self.arguments[BEFORE.get(self.operation, 0) :]

    logical: bool


class ProgramSteps(Sequence[ProgramStep]):
    """Steps of a program as arrays; a :class:`ProgramStep` is made on access.

    Args:
        kinds: index in ``names`` of each step's operation, ``(n,)``.
        begins: offset of each step's arguments in ``arguments``, ``(n + 1,)``.
        arguments: arguments of all :class:`ProgramStep`, one after the other.
        logical: whether each step is a boolean, ``(n,)``.
    """

    def __init__(
        self,
        names: Sequence[str],
        kinds: numpy.ndarray,
        begins: numpy.ndarray,
        arguments: numpy.ndarray,
        logical: numpy.ndarray,
    ) -> None:
        self.names = names
        self.kinds = kinds
        self.begins = begins
        self.arguments = arguments
        self.logical = logical
        self._made: list[ProgramStep] | None = None

    @functools.cached_property
    def operations(self) -> frozenset[str]:
        """Names of the operations that occur."""
        return frozenset([self.names[int(kind)] for kind in numpy.unique(self.kinds)])

    def which(self, *operations: str) -> numpy.ndarray:
        """Return a mask ``(n,)`` of the steps with one of these operations."""
        return numpy.isin(self.kinds, [kind for kind, name in enumerate(self.names) if name in operations])

    def named(self, operation: str) -> list[ProgramStep]:
        """Return a list of the steps with one operation."""
        return [self[index] for index in numpy.flatnonzero(self.which(operation)).tolist()]

    def __len__(self) -> int:
        return len(self.kinds)

    @overload
    def __getitem__(self, place: int) -> ProgramStep: ...

    @overload
    def __getitem__(self, place: slice) -> "ProgramSteps": ...

    def __getitem__(self, place: int | slice) -> "ProgramStep | ProgramSteps":
        if not isinstance(place, slice):
            if self._made is not None:
                return self._made[place]
            given = self.arguments[self.begins[place] : self.begins[place + 1]].tolist()
            return ProgramStep(self.names[int(self.kinds[place])], tuple(given), bool(self.logical[place]))
        begins = self.begins[place.start or 0 : len(self.begins[:-1][: place.stop]) + 1]
        given = self.arguments[begins[0] : begins[-1]]
        return ProgramSteps(self.names, self.kinds[place], begins - begins[0], given, self.logical[place])

    def __iter__(self) -> Iterator[ProgramStep]:
        return iter(self.all())

    def all(self) -> list[ProgramStep]:
        """Return a list of all steps, cached after the first call."""
        if self._made is None:
            numbers, names = self.arguments.tolist(), self.names
            given = [tuple(numbers[begin:end]) for begin, end in itertools.pairwise(self.begins.tolist())]
            parts = zip(
                [names[kind] for kind in self.kinds.tolist()], given, self.logical.tolist(), strict=True
            )
            # ProgramStep itself takes twice as long.
            self._made = list(map(tuple.__new__, itertools.repeat(ProgramStep), parts))
        return self._made


class StraightLineProgram(NamedTuple):
    """Straight-line program that computes some expressions of a graph.

    Constants are separate from the steps, so that programs that differ only in numbers have the same code.
    """

    steps: ProgramSteps
    constants: numpy.ndarray
    """Constants of the steps, then the tables one after the other, ``(n,)``."""
    results: list[ProgramResult]
    """Destinations of the results; ``node`` is the index of a step."""
    origins: numpy.ndarray
    """For each step the number of the array operation that created it, and a number that increases from member to
    member, ``(n, 2)``.
    """
    callers: Mapping[int, str] = types.MappingProxyType({})
    """Functions that called each array operation, if the graph recorded them."""


@without_collection()
def program(graph: Graph, wanted: Sequence[ProgramResult]) -> StraightLineProgram:
    """Return the straight-line program that computes some expressions of a graph and stores the results."""
    order = graph.live(result.node for result in wanted)
    operations = list(map(graph.operations.__getitem__, order))
    given = list(map(graph.arguments.__getitem__, order))
    names = sorted(set(operations))
    number = {name: kind for kind, name in enumerate(names)}
    kinds = _integers(map(number.__getitem__, operations), len(order))
    scalars, takes, products = (
        numpy.flatnonzero(kinds == number[name]).tolist() if name in number else []
        for name in ("constant", "take", "product")
    )
    for i, step in enumerate(scalars):
        given[step] = (i,)
    tables = sorted({given[step][0] for step in [*takes, *products]})
    sizes = {table: len(graph.tables[table]) for table in tables}
    starts = dict(zip(tables, itertools.accumulate(sizes.values(), initial=len(scalars)), strict=False))
    for step in takes:
        table, index = given[step]
        given[step] = (starts[table], sizes[table], index)
    for step in products:
        given[step] = (starts[given[step][0]], *given[step][1:])

    lengths = _integers(map(len, given), len(order))
    begins = numpy.concatenate([[0], numpy.cumsum(lengths)])
    arguments = _integers(itertools.chain.from_iterable(given), int(begins[-1]))
    before = numpy.array([BEFORE.get(name, 0) for name in names], dtype=numpy.int64)
    of_steps = numpy.arange(len(arguments)) >= numpy.repeat(begins[:-1] + before[kinds], lengths)
    place = numpy.empty(len(graph.operations), dtype=numpy.int64)
    place[order] = numpy.arange(len(order))
    arguments[of_steps] = place[arguments[of_steps]]

    values: list[Any] = [graph.values[order[step]] for step in scalars]
    first = numpy.array(values, dtype=float)
    content = first.tobytes(), *(graph.digests[table] for table in tables)
    constants = _CONSTANTS.get(content) if tables else first
    if constants is None:
        constants = numpy.concatenate([first, *(graph.tables[table] for table in tables)])
        _CONSTANTS[content] = constants
    results = [ProgramResult(r.argument, r.row, int(place[r.node])) for r in wanted]
    logical = numpy.array(list(map(graph.logical.__getitem__, order)), dtype=bool)
    steps = ProgramSteps(names, kinds, begins, arguments, logical)
    groups = _integers(map(graph.groups.__getitem__, order), len(order))
    origins = numpy.column_stack([groups, _integers(order, len(order))])
    return StraightLineProgram(steps, constants, results, origins, graph.callers or {})


def _integers(numbers: Iterable[int], count: int) -> numpy.ndarray:
    return numpy.fromiter(numbers, dtype=numpy.int64, count=count)
