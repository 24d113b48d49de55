"""Traced arrays (arrays of expressions) and the functions of the array API standard on them.

A :class:`Traced` replaces an array: shapes, indices and broadcasting are those of NumPy, which moves the numbers of the
expressions, and arithmetic makes new expressions in the :class:`~.program.Graph` that :func:`tracing` has opened. All
numbers in a program are float64, also those with an integer ``dtype``.
"""

import builtins
import functools
import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import ModuleType
from typing import Any

import numpy

from .program import COMPARISONS, Graph, without_collection

float64, float32, int64, int32 = (numpy.dtype(name) for name in ("float64", "float32", "int64", "int32"))
finfo = numpy.finfo
bool: numpy.dtype = numpy.dtype("bool")
pi, inf, nan, newaxis = numpy.pi, numpy.inf, numpy.nan, None
_OPEN: ContextVar[Graph] = ContextVar("graph")


class NotTraceable(TypeError):  # noqa: N818  (not an error in the function)
    """Error for a function that cannot be traced as a straight line of arithmetic."""


@contextmanager
def tracing(graph: Graph) -> Iterator[Graph]:
    """Context manager: arithmetic on traced arrays adds its expressions to this graph; other threads wait.

    Any exception inside becomes :class:`NotTraceable`, as functions may fail on symbols in any way.
    """
    with without_collection():
        token = _OPEN.set(graph)
        try:
            yield graph
        except NotTraceable:
            raise
        except Exception as error:
            if isinstance(error.__cause__, NotTraceable):  # NumPy's message is less specific than its cause
                raise error.__cause__ from error
            raise NotTraceable(f"{type(error).__name__}: {error}") from error
        finally:
            _OPEN.reset(token)


def _plain_value(array: Any, use: str) -> Any:
    """Return the plain number of an expression (:meth:`.Graph.settle`); None: it has none."""
    graph = _OPEN.get(None)
    return None if graph is None or array.nodes.size != 1 else graph.settle(array.nodes.item(), use)


def _decide(self: Any) -> builtins.bool:
    known = _plain_value(self, "branch")
    return _refuse(self) if known is None else builtins.bool(known)


def _refuse(self: Any, *_: Any) -> Any:
    raise NotTraceable(
        "a branch or a loop depends on the numbers of an array: choose with numpy.where, numpy.maximum or "
        "numpy.minimum, and use numpy.stack in place of numpy.array"
    )


def _number(self: Any) -> float:
    known = _plain_value(self, "number")
    return _refuse_number(self) if known is None else float(known)


def _refuse_number(self: Any) -> Any:
    raise NotTraceable(
        "a number that varies is converted to a float: use NumPy's functions in place of math's, and a list, or "
        "numpy.array of one without dtype, in place of an array whose entries are set"
    )


def _round(self: Any, digits: Any = None) -> Any:
    return builtins.round(_number(self), digits)


def _format(self: Any, form: str) -> str:
    known = _plain_value(self, "words")
    return str(self) if known is None else format(known, form)


def _refuse_entry(self: Any, *_: Any) -> Any:
    raise NotTraceable("an entry of the given array is set: return a list of the new numbers")


class Traced:
    """Array of symbolic expressions, which records the arithmetic on it.

    Attributes:
        nodes: indices of the expressions in the open graph.
        dtype: type of the array that is traced.
    """

    __slots__ = ("dtype", "nodes")
    device = None
    __bool__ = _decide
    __index__ = _refuse
    __float__ = _number
    __int__ = _refuse_number
    __complex__ = _refuse_number
    __format__ = _format
    __round__ = _round
    __setitem__ = _refuse_entry

    def __init__(self, nodes: Any, dtype: Any) -> None:
        self.nodes: numpy.ndarray = numpy.asarray(nodes)
        self.dtype: numpy.dtype = numpy.dtype(dtype)

    def __array__(self, dtype: Any = None, copy: Any = None) -> numpy.ndarray:
        from . import numpy_functions  # noqa: F401  (adds the methods that NumPy calls)

        objects = numpy.empty(self.shape, dtype=object)
        for place in numpy.ndindex(self.shape):
            objects[place] = Traced(self.nodes[place], self.dtype)
        return objects if dtype is None else objects.astype(dtype)

    def __array_ufunc__(self, function: Any, method: str, *arguments: Any, **keywords: Any) -> "Traced":
        from .numpy_functions import call_ufunc

        return call_ufunc(function, method, arguments, keywords)

    def __array_function__(self, function: Any, types: Any, arguments: Any, keywords: Any) -> "Traced":
        from .numpy_functions import call_function

        return call_function(function, arguments, keywords)

    def __array_namespace__(self, api_version: str | None = None) -> ModuleType:
        return importlib.import_module(__name__)

    shape: Any = property(lambda self: self.nodes.shape)
    ndim: Any = property(lambda self: self.nodes.ndim)
    size: Any = property(lambda self: self.nodes.size)
    real: Any = property(lambda self: self)
    T = property(lambda self: Traced(self.nodes.T, self.dtype))
    mT: Any = property(lambda self: Traced(self.nodes.swapaxes(-1, -2), self.dtype))  # noqa: N815  (the standard's name)

    def __len__(self) -> int:
        return len(self.nodes)

    def __iter__(self) -> Iterator["Traced"]:
        return (Traced(part, self.dtype) for part in self.nodes)

    def __getitem__(self, key: Any) -> "Traced":
        keys = key if isinstance(key, tuple) else (key,)
        if not builtins.any(isinstance(k, Traced) for k in keys):
            return Traced(self.nodes[key], self.dtype)
        place = next(i for i, k in enumerate(keys) if isinstance(k, Traced))
        others = tuple(slice(None) if i == place else k for i, k in enumerate(keys))
        whole = [i for i, k in enumerate(keys) if isinstance(k, Traced | int)]
        if not builtins.all(k is Ellipsis or isinstance(k, slice | int) for k in others) or (
            len(whole) != whole[-1] - whole[0] + 1  # NumPy puts the axis first then
        ):
            raise NotTraceable(
                "only one index may depend on numbers: put integers next to it, and use slices elsewhere"
            )
        axis = place - builtins.sum(isinstance(k, int) for k in others[:place])
        if Ellipsis in others[:place]:  # counted from the last axis then
            axis = place - len(keys) + builtins.sum(isinstance(k, int) for k in others[place:])
        return take(Traced(self.nodes[others], self.dtype), keys[place], axis=axis)

    def __pow__(self, exponent: Any) -> "Traced":
        return square(self) if isinstance(exponent, int | float) and exponent == 2 else pow(self, exponent)

    def __rpow__(self, base: Any) -> "Traced":
        return pow(base, self)

    def __neg__(self) -> "Traced":
        return negative(self)

    def __abs__(self) -> "Traced":
        return abs(self)

    def __invert__(self) -> "Traced":
        return logical_not(self)

    def __matmul__(self, other: Any) -> "Traced":
        return matmul(self, other)

    def __rmatmul__(self, other: Any) -> "Traced":
        return matmul(other, self)

    def sum(self, axis: int | None = None) -> "Traced":
        """Return the sum along an axis, or of all entries."""
        return sum(self, axis=axis)

    def min(self, axis: int | None = None) -> "Traced":
        """Return the smallest entry along an axis, or of all entries."""
        return min(self, axis=axis)

    def max(self, axis: int | None = None) -> "Traced":
        """Return the largest entry along an axis, or of all entries."""
        return max(self, axis=axis)

    def any(self, axis: int | None = None) -> "Traced":
        """Return whether any entry is true, along an axis or of all."""
        return any(self, axis=axis)

    def all(self, axis: int | None = None) -> "Traced":
        """Return whether all entries are true, along an axis or of all."""
        return all(self, axis=axis)

    def mean(self, axis: int | None = None) -> "Traced":
        """Return the mean along an axis, or of all entries."""
        from .numpy_functions import mean

        return mean(self, axis)

    def item(self) -> "Traced":
        """Return the only entry, as a traced array without axes."""
        return self.reshape(())

    def dot(self, other: Any) -> "Traced":
        """Return the matrix product with a vector or a matrix."""
        return matmul(self, other)

    def ravel(self) -> "Traced":
        """Return all entries as a vector."""
        return self.reshape(-1)

    def reshape(self, *shape: Any) -> "Traced":
        """Return the same entries with another shape."""
        return Traced(self.nodes.reshape(*shape), self.dtype)

    def conjugate(self) -> "Traced":
        """Return the array itself, since it is real."""
        return self

    def astype(self, dtype: Any) -> "Traced":
        """Return the entries converted to another type."""
        return astype(self, dtype)

    def copy(self) -> "Traced":
        """Return the array itself, since it is immutable."""
        return self


def asarray(values: Any, dtype: Any = None, device: Any = None, copy: Any = None) -> Traced:
    """Return values as a traced array: a traced one itself, numbers and NumPy arrays as constants."""
    if isinstance(values, Traced):
        return values if dtype is None else astype(values, dtype)
    if isinstance(values, list | tuple) and builtins.any(isinstance(value, Traced) for value in values):
        return stack([asarray(value, dtype) for value in values])
    array = numpy.asarray(values)
    if array.dtype == object and builtins.all(
        isinstance(entry, Traced | int | float | numpy.generic) for entry in array.flat
    ):
        entries = [asarray(entry, dtype) for entry in array.flat]
        return reshape(stack(entries), array.shape) if entries else zeros(array.shape)
    array = array if dtype is None else array.astype(dtype)
    if array.dtype.kind not in "fiub":
        raise NotTraceable(f"arrays of {array.dtype} cannot be traced")
    graph = _OPEN.get()
    if array.dtype == bool:
        nodes = [graph.constant(value) for value in array.ravel()]
    else:
        nodes = graph.constants(array.astype(float64).ravel())
    return Traced(numpy.array(nodes, dtype=numpy.int64).reshape(array.shape), array.dtype)


def _elementwise(name: str, arrays: Sequence[Traced], dtype: Any) -> Traced:
    graph = _OPEN.get()
    graph.begin_group()
    nodes = [array.nodes for array in arrays]
    shape = nodes[0].shape
    if builtins.any(each.shape != shape for each in nodes):
        nodes = list(numpy.broadcast_arrays(*nodes))
        shape = nodes[0].shape
    return Traced(graph.nodes(name, [each.ravel() for each in nodes]).reshape(shape), dtype)


def _numbers(array: Traced) -> Traced:
    return _elementwise("number", [array], int64) if array.dtype == bool else array


def _join(arrays: Sequence[Any]) -> tuple[list[Traced], numpy.dtype]:
    """Return arrays as traced arrays, all of numbers or all of booleans, and their common NumPy type."""
    if builtins.all(isinstance(array, Traced) and array.dtype == float64 for array in arrays):
        return list(arrays), float64
    found = [asarray(array) for array in arrays]
    # For Python's own numbers NumPy uses only their kind.
    kinds = [
        a if isinstance(a, int | float) else traced.dtype for a, traced in zip(arrays, found, strict=True)
    ]
    dtype = numpy.result_type(*kinds)
    return found if dtype == bool else [_numbers(array) for array in found], dtype


def _binary(name: str, result: Any = None) -> Callable[..., Any]:
    def operation(one: Any, other: Any, /) -> Any:
        if not isinstance(other, Traced | numpy.ndarray | numpy.generic | int | float | list):
            return NotImplemented
        arrays, dtype = _join([one, other])
        if dtype == bool:
            arrays, dtype = [_numbers(array) for array in arrays], int64
        return _elementwise(name, arrays, result or dtype)

    return operation


def _unary(name: str, result: Any = float64) -> Callable[[Any], Traced]:
    def function(x: Any, /) -> Traced:
        array = _numbers(asarray(x))
        return _elementwise(name, [array], result or array.dtype)

    return function


def _logical(name: str) -> Callable[..., Any]:
    def operation(*arrays: Any) -> Any:
        traced = [asarray(array) for array in arrays]
        if builtins.any(array.dtype != bool for array in traced):
            raise NotTraceable("bitwise operations on whole numbers cannot be traced")
        return _elementwise(name, traced, bool)

    return operation


def _floor_divide(one: Any, other: Any) -> Traced:
    # The quotient itself may be rounded up to the next whole number.
    quotient = divide(subtract(one, remainder(one, other)), other)
    return Traced(round(quotient).nodes, _join([one, other])[1])


add, subtract, multiply, remainder = (_binary(n) for n in ("add", "subtract", "multiply", "remainder"))
divide, maximum, minimum = _binary("divide", float64), _binary("maximum"), _binary("minimum")
less, less_equal, greater, greater_equal, equal, not_equal = (_binary(name, bool) for name in COMPARISONS)
logical_and, logical_or, logical_not = (_logical(f"logical_{name}") for name in ("and", "or", "not"))
floor_divide = _floor_divide
negative, abs, sign = (_unary(name, result=None) for name in ("negative", "absolute", "sign"))
floor, ceil, trunc, round = (_unary(n, result=None) for n in ("floor", "ceil", "trunc", "rint"))
sqrt, exp, expm1, exp2, log, log1p, log2, log10, sin, cos, tan = (
    _unary(n) for n in ["sqrt", "exp", "expm1", "exp2", "log", "log1p", "log2", "log10", "sin", "cos", "tan"]
)
asin, acos, atan, sinh, cosh, tanh, asinh, acosh, atanh = (
    _unary(n) for n in ["asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"]
)
atan2, pow, hypot = (_binary(name, float64) for name in ("atan2", "pow", "hypot"))


def _reflect(operation: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, other: operation(other, self) if not isinstance(other, Traced) else NotImplemented


_METHODS: dict[str, Callable[..., Any]]
_METHODS = {"add": add, "sub": subtract, "mul": multiply, "truediv": divide, "floordiv": floor_divide}
_METHODS |= {"mod": remainder, "and": logical_and, "or": logical_or}
for _name, _operation in _METHODS.items():
    setattr(Traced, f"__{_name}__", _operation)
    setattr(Traced, f"__r{_name}__", _reflect(_operation))
_METHODS = {"lt": less, "le": less_equal, "gt": greater, "ge": greater_equal, "eq": equal, "ne": not_equal}
for _name, _operation in _METHODS.items():
    setattr(Traced, f"__{_name}__", _operation)
Traced.__hash__ = None  # type: ignore[assignment]


def square(x: Any) -> Traced:
    """Return the square of each entry."""
    return multiply(x, x)


def isnan(x: Any) -> Traced:
    """Return a boolean array: whether each entry is NaN."""
    return not_equal(x, x)


def isfinite(x: Any) -> Traced:
    """Return a boolean array: whether each entry is finite."""
    return less_equal(abs(x), float(numpy.finfo(float64).max))


def where(condition: Any, one: Any, other: Any) -> Traced:
    """Return entries of ``one`` where a condition is true, else of ``other``."""
    arrays, dtype = _join([one, other])
    return _elementwise("where", [astype(condition, bool), *arrays], dtype)


def clip(x: Any, min: Any = None, max: Any = None) -> Traced:
    """Return the entries limited to an interval."""
    if min is not None:
        x = maximum(x, min)
    return asarray(x) if max is None else minimum(x, max)


def astype(x: Any, dtype: Any, copy: Any = True, device: Any = None) -> Traced:
    """Return the entries converted to another type; conversion to integers truncates."""
    x, dtype = asarray(x), numpy.dtype(dtype)
    if dtype.kind not in "fiub":
        raise NotTraceable(f"arrays of {dtype} cannot be traced")
    if dtype == bool:
        return x if x.dtype == bool else not_equal(x, 0.0)
    if x.dtype == bool:
        return Traced(_numbers(x).nodes, dtype)
    if dtype.kind in "iu" and x.dtype.kind == "f":
        return Traced(trunc(x).nodes, dtype)
    return Traced(x.nodes, dtype)


def _mover(move: Callable[..., Any]) -> Callable[..., Traced]:
    @functools.wraps(move)
    def function(x: Any, *arguments: Any, **keywords: Any) -> Traced:
        x = asarray(x)
        return Traced(move(x.nodes, *arguments, **keywords), x.dtype)

    return function


def _gatherer(gather: Callable[..., Any]) -> Callable[..., Traced]:
    @functools.wraps(gather)
    def function(arrays: Any, *, axis: int | None = 0) -> Traced:
        found, dtype = _join(list(arrays))
        return Traced(gather([array.nodes for array in found], axis=axis), dtype)

    return function


reshape, moveaxis, permute_dims = _mover(numpy.reshape), _mover(numpy.moveaxis), _mover(numpy.permute_dims)
broadcast_to, expand_dims, squeeze = (
    _mover(numpy.broadcast_to),
    _mover(numpy.expand_dims),
    _mover(numpy.squeeze),
)
flip, roll, tile, repeat = (_mover(move) for move in (numpy.flip, numpy.roll, numpy.tile, numpy.repeat))
concat, stack = _gatherer(numpy.concat), _gatherer(numpy.stack)


def _maker(make: Callable[..., Any]) -> Callable[..., Traced]:
    @functools.wraps(make)
    def function(*arguments: Any, dtype: Any = None, device: Any = None) -> Traced:
        return asarray(make(*arguments, dtype=dtype))

    return function


zeros, ones, eye, arange = (_maker(make) for make in (numpy.zeros, numpy.ones, numpy.eye, numpy.arange))


def full(shape: Any, value: Any, *, dtype: Any = None, device: Any = None) -> Traced:
    """Return a traced array filled with one value, which may itself be traced."""
    return broadcast_to(asarray(value, dtype), shape)


def full_like(x: Any, value: Any, *, dtype: Any = None, device: Any = None) -> Traced:
    """Return a traced array filled with one value, in the shape of another array."""
    x = asarray(x)
    return full(x.shape, value, dtype=dtype or x.dtype)


zeros_like, ones_like = functools.partial(full_like, value=0), functools.partial(full_like, value=1)


def tril(x: Any, /, *, k: int = 0) -> Traced:
    """Return the lower triangle of matrices, with zeros above it."""
    x = asarray(x)
    return where(numpy.tril(numpy.ones(x.shape[-2:], dtype=bool), k), x, zeros_like(x))


def triu(x: Any, /, *, k: int = 0) -> Traced:
    """Return the upper triangle of matrices, with zeros below it."""
    x = asarray(x)
    return where(numpy.triu(numpy.ones(x.shape[-2:], dtype=bool), k), x, zeros_like(x))


def take(x: Any, indices: Any, *, axis: int = 0) -> Traced:
    """Return the entries at some indices along an axis; the indices may be traced.

    Traced indices read a table of constants, or select among expressions one by one. A large table of constants should
    be a NumPy array, whose numbers do not become expressions.
    """
    indices = asarray(indices)
    if indices.dtype == bool:
        raise NotTraceable("the number of entries that a mask selects depends on numbers: use where")
    graph, places = _OPEN.get(), indices.nodes.ravel().tolist()
    rows: Any
    taken: Any
    if isinstance(x, numpy.ndarray) and x.dtype == float:
        rows = numpy.moveaxis(x, axis, -1)
        graph.begin_group()
        taken = [[graph.take(row, place) for place in places] for row in rows.reshape(-1, rows.shape[-1])]
    else:
        x = asarray(x)
        rows = numpy.moveaxis(x.nodes, axis, -1)
        taken = _choose(graph, rows.reshape(-1, rows.shape[-1]), places, x.dtype)
    shaped = numpy.array(taken, dtype=numpy.int64).reshape(*rows.shape[:-1], *indices.shape)
    for i in range(indices.ndim):
        shaped = numpy.moveaxis(shaped, rows.ndim - 1 + i, axis % x.ndim + i)
    return Traced(shaped, x.dtype)


def _choose(graph: Graph, rows: numpy.ndarray, places: list[int], dtype: Any) -> numpy.ndarray:
    chosen = numpy.empty((len(rows), len(places)), dtype=numpy.int64)
    open_rows, open_places = [], []
    graph.begin_group()
    for r, row in enumerate(rows.tolist()):
        values = [graph.values[node] for node in row]
        table = None
        if None not in values and not builtins.any(graph.logical[node] for node in row):
            table = numpy.array(values, dtype=float)
        for p, index in enumerate(places):
            known = graph.values[index]
            if known is not None:
                chosen[r, p] = row[int(known)]
            elif table is not None:
                chosen[r, p] = graph.take(table, index)
            else:
                open_rows.append(r)
                open_places.append(p)
    if open_rows:
        choices = Traced(rows[open_rows].T, dtype)
        requested = Traced(numpy.array(places)[open_places], float64)
        # As for a table: a negative index counts from the end, one outside is clipped to the range.
        requested = where(less(requested, 0.0), add(requested, float(rows.shape[-1])), requested)
        found = choices[0]
        for place, choice in enumerate(list(choices)[1:], 1):
            found = where(greater_equal(requested, float(place)), choice, found)
        chosen[open_rows, open_places] = found.nodes
    return chosen


def _reduction(operation: Callable[..., Any], of_numbers: Any = False) -> Callable[..., Traced]:
    def function(x: Any, /, *, axis: int | tuple[int, ...] | None = None, keepdims: Any = False) -> Traced:
        x = _numbers(asarray(x)) if of_numbers else asarray(x)
        axes = tuple(range(x.ndim)) if axis is None else axis if isinstance(axis, tuple) else (axis,)
        moved = numpy.moveaxis(x.nodes, axes, range(len(axes)))
        parts = moved.reshape(-1, *moved.shape[len(axes) :])
        reduced = functools.reduce(operation, (Traced(part, x.dtype) for part in parts))
        return expand_dims(reduced, tuple(a % x.ndim for a in axes)) if keepdims else reduced

    return function


sum, prod, max, min = (_reduction(o, of_numbers=True) for o in (add, multiply, maximum, minimum))
any, all = _reduction(logical_or), _reduction(logical_and)


def sort(x: Any, /, *, axis: int = -1) -> Traced:
    """Return the entries sorted along an axis, by a sorting network of minima and maxima."""
    rows = list(moveaxis(x, axis, 0))
    for end in range(len(rows) - 1, 0, -1):
        for i in range(end):
            rows[i], rows[i + 1] = minimum(rows[i], rows[i + 1]), maximum(rows[i], rows[i + 1])
    return moveaxis(stack(rows), 0, axis)


LARGE = 256
"""Minimal number of nonzero constants of a matrix for a product as a loop; for fewer it is a straight line."""


def _is_loop(matrix: Any) -> builtins.bool:
    """Return whether the product with a matrix becomes a loop: many constants, few of them zero."""
    if not isinstance(matrix, numpy.ndarray) or matrix.ndim != 2 or not _OPEN.get().loops:
        return False
    count = int(numpy.count_nonzero(matrix))
    return count >= LARGE and 2 * count > matrix.size


def matmul(a: Any, b: Any, /) -> Traced:
    """Return the matrix product, its terms added in order, without those of a constant zero.

    Where the graph allows loops, the product with a large matrix of constants is a loop.
    """
    if _is_loop(b):  # x^T B = (B^T x)^T
        return matmul(b.T, asarray(a).mT).mT if asarray(a).ndim > 1 else matmul(b.T, a)
    if _is_loop(a):
        b = _numbers(asarray(b))
        columns = b.nodes.reshape(len(b), -1) if len(b) == a.shape[1] and b.ndim < 3 else None
        if columns is not None:
            product = _OPEN.get().product
            made = [product(numpy.asarray(a, dtype=float), column) for column in columns.T.tolist()]
            return Traced(numpy.array(made).T.reshape(len(a), *b.shape[1:]), numpy.result_type(a, b.dtype))
    a, b = asarray(a), asarray(b)
    left, right = (a[None] if a.ndim == 1 else a), (b[:, None] if b.ndim == 1 else b)
    if left.shape[-1] != right.shape[-2]:
        raise ValueError(f"matrices of {a.shape} and {b.shape} have no product")
    product = functools.reduce(
        add, (left[..., :, k, None] * right[..., k, None, :] for k in range(left.shape[-1]))
    )
    product = product[..., 0, :] if a.ndim == 1 else product
    return product[..., 0] if b.ndim == 1 else product
