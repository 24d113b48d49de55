"""The namespace's functions against NumPy's of the same names: shapes, types, values, and what is refused."""

import math

import numpy as np
import pytest

from filtergym.compiler import cache, namespace
from filtergym.compiler.functions import CompiledFunction, Specialised
from filtergym.compiler.namespace import NotTraceable
from filtergym.compiler.program import Graph

pytest.importorskip("llvmlite")

WIDTH = 8
RNG = np.random.default_rng(3)
X, Y = RNG.normal(size=(3, WIDTH)), RNG.normal(size=(3, WIDTH))
"""Rows of numbers."""
M = RNG.normal(size=(3, 2, WIDTH))
"""Matrices."""
I = RNG.integers(-4, 5, size=(3, WIDTH))  # noqa: E741
"""Whole numbers."""
T = X > Y
"""Truth values."""
HALF, ABOVE_ONE = np.tanh(X), 1.0 + np.abs(X)
TABLE = RNG.normal(size=(2, 4))
"""Numbers that are known."""
PLACES = np.array([0, 1, 2, -1, -3, 2, 0, 1])
"""For each lane a place among three."""


@pytest.fixture(autouse=True)
def _nothing_is_kept(monkeypatch):
    monkeypatch.setenv(cache.SWITCH, "off")


def compiled(function, *arrays):
    return CompiledFunction(lambda *traced: function(namespace, *traced), Graph())(*arrays)


def check(function, *arrays, rtol=0.0):
    """Compare ``function(namespace, *arrays)``, compiled, with NumPy's."""
    with np.errstate(all="ignore"):
        expected = np.asarray(function(np, *arrays))
    result = compiled(function, *arrays)
    assert result.shape == expected.shape
    assert result.dtype == expected.dtype
    np.testing.assert_allclose(result, expected, rtol=rtol, atol=rtol)


def lanes_first(xp, x):
    """Turn lanes into a batch, as functions of matrices have it."""
    return xp.moveaxis(x, -1, 0)


def lanes_last(xp, x):
    return xp.moveaxis(x, 0, -1)


# --- arithmetic


@pytest.mark.parametrize(
    "function",
    [
        lambda xp, x, y, i, t: xp.add(x, y) - xp.subtract(y, 2) * xp.multiply(i, x) / xp.divide(3, y),
        lambda xp, x, y, i, t: xp.remainder(x, y) + x % 0.7 + 5 % x,
        lambda xp, x, y, i, t: xp.floor_divide(x, y) + x // 0.1 + 5 // x,
        lambda xp, x, y, i, t: i % 3 + i // 3 - 2 * i,
        lambda xp, x, y, i, t: i / 3,
        lambda xp, x, y, i, t: i * 0.5 - True,
        lambda xp, x, y, i, t: abs(-x) + xp.abs(xp.negative(i)) + xp.sign(x) * xp.sign(i),
        lambda xp, x, y, i, t: xp.floor(x) + xp.ceil(y) * xp.trunc(x) - xp.round(y * 3),
        lambda xp, x, y, i, t: xp.sqrt(xp.abs(x)) + xp.square(y) + x**2,
        lambda xp, x, y, i, t: xp.square(i),
        lambda xp, x, y, i, t: xp.maximum(x, y) - xp.minimum(i, x) + xp.maximum(0.1, x) * xp.minimum(y, 0),
        lambda xp, x, y, i, t: xp.minimum(i, 2),
        lambda xp, x, y, i, t: xp.clip(x, -0.5, 0.5) + xp.clip(y, None, 0.2) + xp.clip(x, min=y) + xp.clip(y),
        lambda xp, x, y, i, t: xp.less(x, y) | xp.greater(x, 0.5) & xp.less_equal(i, 2),
        lambda xp, x, y, i, t: xp.logical_or(xp.equal(i, 1), xp.logical_not(xp.not_equal(i, 2))),
        lambda xp, x, y, i, t: xp.logical_and(xp.greater_equal(x, y), t) | (~t & (x < 0.1)),
        lambda xp, x, y, i, t: (x > y) == t,
        lambda xp, x, y, i, t: (i == 1) | (i != 2) & (i >= 3) | (i <= -3) & (1 < x),  # noqa: SIM300  (NumPy's order)
        lambda xp, x, y, i, t: True & t | (False | t),
        lambda xp, x, y, i, t: xp.where(t, x, y) + xp.where(x > 0, i, 1) * xp.where(i, 1.0, y),
        lambda xp, x, y, i, t: xp.where(t, x > 0, y > 0),
        lambda xp, x, y, i, t: xp.where(t, x > 0, True),
        lambda xp, x, y, i, t: xp.where(t, t, 2),
        lambda xp, x, y, i, t: xp.where(t, 2, 1.5),
        lambda xp, x, y, i, t: t + 1,
        lambda xp, x, y, i, t: t * x,
        lambda xp, x, y, i, t: xp.isnan(xp.sqrt(x)) | xp.isfinite(y) & ~xp.isfinite(1 / (i - i[0])),
        lambda xp, x, y, i, t: xp.astype(x * 3, xp.int64) + xp.astype(t, xp.int32),
        lambda xp, x, y, i, t: xp.astype(i, xp.float64) / 7 + xp.astype(t, xp.float64),
        lambda xp, x, y, i, t: xp.astype(i, xp.bool) | xp.astype(t, xp.bool),
        lambda xp, x, y, i, t: xp.pi * x + xp.inf * (2 + i * i) + xp.astype(t, xp.float64)[xp.newaxis, 0],
        lambda xp, x, y, i, t: xp.where(t, xp.nan, x),
    ],
)
def test_arithmetic_is_numpys(function):
    check(function, X, Y, I, T)


@pytest.mark.parametrize(
    "function",
    [
        lambda xp, x, a: a + x - x * a + a / x - (x - a) / 2.0,
        lambda xp, x, a: xp.where(a < x, a, x),
        lambda xp, x, a: (a >= x) | (a == x) | (a != x) & (a > x) & (a <= x),
        lambda xp, x, a: a**2 * xp.abs(x) // (3 + a) % x,
        lambda xp, x, a: np.float64(2.0) * x - np.int64(3) + (np.float64(0.2) < x) / 2,
        lambda xp, x, a: xp.maximum(a, x),
        lambda xp, x, a: np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]) @ x,
        lambda xp, x, a: (a > 0) & (x > 0),
    ],
)
def test_arrays_of_numpy_may_stand_on_either_side(function):
    a = np.array([[0.5], [-1.0], [2.0]])
    check(lambda xp, x: function(xp, x, a), X, rtol=1e-15)


@pytest.mark.parametrize(
    ("names", "array"),
    [
        ("exp expm1 exp2 sin cos tan atan sinh cosh tanh asinh", X),
        ("log log2 log10 log1p acosh", ABOVE_ONE),
        ("asin acos atanh", HALF),
    ],
)
def test_functions_of_libraries(names, array):
    for name in names.split():
        check(lambda xp, x, name=name: getattr(xp, name)(x), array, rtol=2e-15)
    check(lambda xp, i: xp.exp(i), I, rtol=2e-15)


def test_functions_of_libraries_with_two_arguments():
    check(lambda xp, x, y: xp.atan2(x, y) + xp.atan2(1, x), X, Y, rtol=1e-14)
    check(lambda xp, x, y: xp.hypot(x, y) + xp.hypot(x, 2), X, Y, rtol=1e-14)
    check(lambda xp, x, y: xp.pow(x, y) * x**0.3 + 2**y - 1.5**x, ABOVE_ONE, Y, rtol=1e-14)


# --- shapes


@pytest.mark.parametrize(
    "function",
    [
        lambda xp, m: xp.reshape(m, (6, -1)),
        lambda xp, m: m.reshape(2, 3, -1) + m.reshape((2, 3, -1)),
        lambda xp, m: xp.moveaxis(m, 0, 1),
        lambda xp, m: xp.permute_dims(m, (1, 0, 2)),
        lambda xp, m: xp.broadcast_to(m[0], (4, *m.shape[1:])),
        lambda xp, m: xp.expand_dims(m, axis=1) + xp.expand_dims(m, axis=-4),
        lambda xp, m: xp.squeeze(m[:1], axis=0),
        lambda xp, m: xp.flip(m, axis=0) - xp.flip(m, axis=1),
        lambda xp, m: xp.roll(m, 1, axis=0),
        lambda xp, m: xp.tile(m, (2, 1, 1)),
        lambda xp, m: xp.repeat(m, 2, axis=1),
        lambda xp, m: xp.concat([m, m[1:] > 0, np.ones((1, 2, m.shape[-1]))]),
        lambda xp, m: xp.concat([m, 2 * m], axis=1),
        lambda xp, m: xp.stack([m, -m]) + xp.stack([m, m], axis=0),
        lambda xp, m: xp.stack([m[0, 0] > 0, m[0, 1] > 0]),
        lambda xp, m: xp.stack([m[0, 0] > 0, m[0, 1]]),
        lambda xp, m: xp.asarray([m[0, 0], m[1, 1]]) if xp is namespace else np.stack([m[0, 0], m[1, 1]]),
        lambda xp, m: m[..., None, :][2] + m[-1, :, None] + m[None, 0, ::-1][0],
        lambda xp, m: m[[0, 2, 1], 1] + m[np.array([True, False, True])][:1, 0],
        lambda xp, m: lanes_last(xp, lanes_first(xp, m).mT),
        lambda xp, m: m.T.T + m.copy(),
        lambda xp, m: sum(row for row in m) + len(m) + m.ndim + math.prod(m.shape[:2]),
        lambda xp, m: lanes_last(xp, xp.tril(lanes_first(xp, m[:2]))),
        lambda xp, m: lanes_last(xp, xp.triu(lanes_first(xp, m), k=1) + xp.tril(lanes_first(xp, m), k=-1)),
        lambda xp, m: lanes_last(xp, xp.tril(lanes_first(xp, m) > 0)),
    ],
)
def test_shapes_are_numpys(function):
    check(function, M)


@pytest.mark.parametrize(
    "function",
    [
        lambda xp, x: x + xp.zeros((3, 1)) + xp.ones((2, 1, 1)),
        lambda xp, x: x + xp.zeros((3, 1), dtype=xp.int64),
        lambda xp, x: x * xp.arange(3)[:, None] + xp.arange(1, 7, 2, dtype=xp.float64)[:, None],
        lambda xp, x: xp.eye(3) @ x + xp.eye(2, 3)[0][:, None],
        lambda xp, x: x + xp.full((3, 1), 2.5),
        lambda xp, x: xp.full((2, *x.shape), x[0]),
        lambda xp, x: xp.full_like(x, 2),
        lambda xp, x: xp.full_like(x, x[1]),
        lambda xp, x: xp.full_like(x > 0, True),
        lambda xp, x: xp.zeros_like(x) + xp.ones_like(x, dtype=xp.int64),
        lambda xp, x: xp.zeros_like(x > 0),
        lambda xp, x: x + xp.asarray([[1], [2], [3]]),
        lambda xp, x: xp.asarray(x, dtype=xp.int64),
    ],
)
def test_arrays_that_are_made_are_numpys(function):
    check(function, X)


@pytest.mark.parametrize(
    "function",
    [
        lambda xp, m: xp.sum(m, axis=0) + m.sum(axis=1)[:1],
        lambda xp, m: xp.sum(m, axis=(0, 1)) - xp.sum(m, axis=(-3, 1), keepdims=True),
        lambda xp, m: xp.sum(m, axis=1, keepdims=True) * m,
        lambda xp, m: xp.prod(m, axis=0),
        lambda xp, m: xp.max(m, axis=0) - xp.min(m, axis=1, keepdims=True),
        lambda xp, m: xp.any(m > 0.5, axis=0) | xp.all(m > -0.5, axis=(0, 1)),
        lambda xp, m: xp.all(m < 2.0, axis=1, keepdims=True),
        lambda xp, m: xp.sum(m > 0, axis=1),
        lambda xp, m: xp.sum(m[:1] > 0, axis=0),
        lambda xp, m: xp.sort(m, axis=0),
        lambda xp, m: xp.sort(lanes_first(xp, m))[:, 0, 1],
    ],
)
def test_reductions_are_numpys(function):
    check(function, M, rtol=1e-15)


@pytest.mark.parametrize(
    "function",
    [
        lambda xp, m, x: lanes_last(xp, lanes_first(xp, m).mT @ lanes_first(xp, m)),
        lambda xp, m, x: lanes_last(xp, xp.matmul(lanes_first(xp, m), TABLE)),
        lambda xp, m, x: lanes_last(xp, TABLE.T @ lanes_first(xp, m[:2])),
        lambda xp, m, x: lanes_last(xp, lanes_first(xp, m) @ np.array([1.0, -2.0])),
        lambda xp, m, x: lanes_last(xp, np.array([1.0, -2.0, 0.5]) @ lanes_first(xp, m)),
        lambda xp, m, x: np.array([1.0, -2.0, 0.5]) @ x,
        lambda xp, m, x: xp.asarray(TABLE[:, :3]) @ x,
        lambda xp, m, x: x * (xp.asarray(TABLE[0]) @ TABLE[1]),
    ],
)
def test_matrix_products_are_numpys(function):
    check(function, M, X, rtol=1e-14)


# --- indices that depend on numbers


@pytest.mark.parametrize(
    "function",
    [
        lambda xp, i: xp.asarray(TABLE[:, :3])[1, i],
        lambda xp, i: xp.asarray(TABLE[:, :3])[:, i],
        lambda xp, i: xp.take(xp.asarray(TABLE[:, :3]), i, axis=1),
        lambda xp, i: xp.take(xp.asarray(TABLE[:, :3]), i, axis=-1),
        lambda xp, i: xp.asarray(TABLE.reshape(2, 1, 4))[..., i],
        lambda xp, i: xp.asarray(TABLE.reshape(2, 2, 2))[..., 1, i % 2],
        lambda xp, i: xp.asarray(TABLE.reshape(2, 2, 2))[..., i % 2, 1],
        lambda xp, i: xp.moveaxis(xp.asarray(TABLE.reshape(2, 2, 2))[:, i % 2], 1, -1),
        lambda xp, i: xp.moveaxis(xp.asarray(TABLE.reshape(2, 2, 2))[..., i % 2, :], 1, -1),
        lambda xp, i: xp.moveaxis(xp.take(xp.asarray(TABLE), i % 2, axis=0), 0, -1),
        lambda xp, i: xp.take(xp.asarray(TABLE[:, :3]), xp.stack([i, i % 2]), axis=1),
        lambda xp, i: xp.asarray(TABLE[0, :3] > 0)[i],
        lambda xp, i: xp.asarray(TABLE)[1, [0, 2, -1]][i],
    ],
)
def test_tables_are_read_where_numbers_say(function):
    check(function, PLACES)


@pytest.mark.parametrize("kind", [float, int, bool])
def test_varying_rows_are_chosen_where_numbers_say(kind):
    rows = (10.0 * X).astype(kind)
    chosen = compiled(lambda xp, rows, i: (xp.take(rows, i, axis=0), rows[i], rows[1:][i % 2]), rows, PLACES)
    lanes = np.arange(WIDTH)
    for result, expected in zip(
        chosen, (rows[PLACES, lanes], rows[PLACES, lanes], rows[1:][PLACES % 2, lanes]), strict=True
    ):
        assert result.dtype == expected.dtype
        np.testing.assert_array_equal(result, expected.reshape(1, WIDTH))


def test_an_index_outside_reads_the_nearest_end_and_nan_within():
    index = np.array([0.0, 2.0, 3.0, 1e300, -4.0, -np.inf, np.nan, np.inf])
    nearest = [0, 2, 2, 2, 0, 0, 0, 2]
    chosen = compiled(lambda xp, x, i: (xp.asarray(TABLE[0, :3])[i], xp.take(x, i, axis=0)), X, index)
    np.testing.assert_array_equal(chosen[0], TABLE[0][nearest])
    np.testing.assert_array_equal(chosen[1], X[nearest, np.arange(WIDTH)].reshape(1, WIDTH))


# --- refusals


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (lambda x: 1.0 if x[0] > 0 else 2.0, "a branch or a loop depends on the numbers"),
        (lambda x: x if (x > 0).all() else -x, "a branch or a loop depends"),
        (lambda x: float(x[0, 0]) + 1.0, "a number that varies is converted to a float"),
        (lambda x: math.sin(x[0, 0]), "NumPy's functions in place of math's"),
        (lambda x: np.array([x[0, 0]], dtype=float), "numpy.array of one without dtype"),
        (lambda x: np.zeros((3, 1)).__setitem__(0, x[0]), "in place of an array whose entries are set"),
        (lambda x: x.__setitem__(0, x[1]), "an entry of the given array is set: return a list"),
        (lambda x: np.maximum(np.array([x[0, 0]]), 0.0), "use numpy.stack in place of numpy.array"),
        (lambda x: [1, 2, 3][x[0, 0]], "a branch or a loop depends"),
        (lambda x: np.frexp(x)[0], "numpy.frexp cannot be traced"),
        (lambda x: np.linalg.inv(x), "numpy.linalg.inv cannot be traced: write out the formula"),
        (lambda x: np.sum(x, axis=0, where=x[0] > 0.0), "TypeError"),
        (lambda x: np.add(x, 1.0, where=[True]), "numpy.add with where cannot be traced"),
        (lambda x: np.add.accumulate(x), "numpy.add cannot be traced"),
        (lambda x: np.var(x), "numpy.var cannot be traced: write it with arithmetic"),
        (lambda x: np.linalg.norm(x, 1), "numpy.linalg.norm with ord cannot be traced"),
        (lambda x: np.interp(x, [0, 1], [0, 1], period=2), "numpy.interp with period cannot be traced"),
        (lambda x: namespace.zeros(x[0, 0]), "expected a sequence of integers"),
        (lambda x: x * 1j, "unsupported operand .*'complex'"),
        (lambda x: x * np.array([1j]), "arrays of complex128 cannot be traced"),
        (lambda x: namespace.astype(x, complex), "arrays of complex128 cannot be traced"),
        (lambda x: namespace.zeros((1, 1), dtype=complex), "arrays of complex128 cannot be traced"),
        (lambda x: namespace.asarray(["one"]), "arrays of <U3 cannot be traced"),
        (lambda x: namespace.astype(x, namespace.int64) & 1, "bitwise operations on whole numbers"),
        (lambda x: ~namespace.astype(x, namespace.int64), "bitwise operations on whole numbers"),
        (lambda x: x[x > 0], "the number of entries that a mask selects"),
        (lambda x: namespace.asarray(TABLE)[x[0], x[1]], "only one index may depend on numbers"),
        (lambda x: namespace.asarray(TABLE[None])[0, :, x[1]], "only one index may depend on numbers"),
        (lambda x: namespace.asarray(TABLE)[0][7], "out of bounds"),
        (lambda x: namespace.eye(2) @ x, r"matrices of \(2, 2\) and \(3, 1\) have no product"),
        (lambda x: x + np.ones((2, 1)), "shape mismatch"),
        (lambda x: namespace.fft(x), "has no attribute 'fft'"),
        (lambda x: x[:, 0], "does not have the lanes as its last axis"),
        (lambda x: namespace.asarray([1.0, 2.0]), "does not have the lanes as its last axis"),
    ],
)
def test_what_no_straight_line_can_do_is_refused(function, sentence):
    with pytest.raises(NotTraceable, match=sentence):
        Specialised(function, Graph(), [X])


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: np.where(x > y, np.sin(x), np.arctan2(x, y)),
        lambda x, y: np.logaddexp(x, y) + np.logaddexp(x, x),
        lambda x, y: np.logaddexp(np.where(x > 0.0, -np.inf, x), -np.inf),
        lambda x, y: np.logaddexp.reduce(x),
        lambda x, y: np.argmax(np.concatenate([x, x]), axis=0) + np.argmax(x[:1], axis=0),
        lambda x, y: np.split(np.concatenate([x, y]), 2, axis=0)[1],
        lambda x, y: np.stack([x.mean(axis=0), x.min(axis=0), x.max(axis=0), np.maximum.reduce(y)]),
        lambda x, y: np.where((x > 0.0).any(axis=0) & ~(y > 0.0).all(axis=0), np.prod(x, axis=0), 0.0),
        lambda x, y: np.nan_to_num(np.log(x)) + np.full_like(x, 2.0),
        lambda x, y: np.clip(np.copy(x, order="F"), -0.1, 0.1) * np.ones((3, 1)),
        lambda x, y: (np.eye(3) + 0.5) @ x,
        lambda x, y: (x > y).astype(float) + np.power(np.abs(x), 1.5),
    ],
)
def test_what_is_written_with_numpy_is_traced(function):
    with np.errstate(all="ignore"):
        expected = function(X, Y)
    result = CompiledFunction(function, Graph())(X, Y)
    assert result.dtype == expected.dtype
    # A product of matrices, a power and functions of a library may differ in their last bits.
    np.testing.assert_allclose(result, expected, rtol=1e-14, atol=1e-14)


def test_what_is_given_must_be_numbers():
    for array in (X + 1j, np.array(["one"] * 8), np.array([None] * 8)):
        with pytest.raises(NotTraceable, match="cannot be traced"):
            CompiledFunction(lambda x: x, Graph())(array)


# --- the namespace itself
