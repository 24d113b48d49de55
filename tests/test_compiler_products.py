"""Products with large matrices of constants, which compiled code computes in loops."""

import numpy as np
import pytest

from filtergym.compiler import namespace
from filtergym.compiler.c_source import write_lanes
from filtergym.compiler.functions import CompiledFunction, Specialised
from filtergym.compiler.gradients import pullback
from filtergym.compiler.interpretation import interpret
from filtergym.compiler.namespace import LARGE, Traced, tracing
from filtergym.compiler.program import BAND, Graph, ProgramResult, program

pytest.importorskip("llvmlite")

LANES = 24
SHAPES = [(64, 64), (3, 100), (BAND, LARGE // BAND), (17, 31), (257, 1), (1, 257)]
"""Rows and columns: whole bands of rows and not, one row, one column, the smallest matrix that is a loop."""


def matrix(rows, columns, seed=0):
    return np.random.default_rng(seed).normal(size=(rows, columns))


def vector(columns):
    return np.random.default_rng(9).normal(size=(columns, LANES))


def operations(special):
    return [step.operation for step in special.program.steps]


def bound(A, x):
    """Rounding of sums of so many terms, which NumPy's library adds in another order."""
    return A.shape[1] * np.finfo(float).eps * (np.abs(A) @ np.abs(x))


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_a_loop_is_numpys_product(shape):
    A, x = matrix(*shape), vector(shape[1])
    special = Specialised(lambda x: A @ x, Graph(loops=True), [x])
    assert operations(special).count("product") == 1
    assert not {"multiply", "add"} & set(operations(special))
    result = CompiledFunction(lambda x: A @ x, Graph(loops=True))(x)
    assert (np.abs(result - A @ x) <= bound(A, x)).all()


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_a_loop_has_the_bits_of_the_straight_line(shape):
    A, x = matrix(*shape), vector(shape[1])
    looped, straight = (CompiledFunction(lambda x: A @ x, Graph(loops=loops))(x) for loops in (True, False))
    np.testing.assert_array_equal(looped, straight)


@pytest.mark.parametrize(
    "function",
    [
        lambda A, x: x @ A.T,
        lambda A, x: np.matmul(x, A.T),
        lambda A, x: (A @ x.T).T,
        lambda A, x: np.stack([A @ row for row in x]),
        lambda A, x: (x[0] @ A.T)[None],
    ],
)
def test_every_way_to_write_it_is_a_loop(function):
    A = matrix(40, 30)

    def rows(x):  # (N,) lanes last to one row each
        return function(A, x.T).T

    special = Specialised(rows, Graph(loops=True), [vector(30)])
    assert "product" in operations(special)
    result = CompiledFunction(rows, Graph(loops=True))(vector(30))
    assert (np.abs(result - A @ vector(30)) <= bound(A, vector(30))).all()


def test_small_matrices_and_those_of_zeros_stay_straight_lines():
    few, sparse = matrix(BAND, LARGE // BAND - 1), np.kron(np.eye(16), np.ones((8, 8)))
    for A in (few, sparse):
        special = Specialised(lambda x, A=A: A @ x, Graph(loops=True), [vector(A.shape[1])])
        assert "product" not in operations(special)
    special = Specialised(lambda x: matrix(64, 64) @ x, Graph(), [vector(64)])
    assert "product" not in operations(special)


def test_several_loops_in_a_program_of_many_parts():
    first, second, third = matrix(70, 20), matrix(70, 70, 1), matrix(5, 70, 2)

    def network(xp, x):
        inside = xp.tanh(first @ x + 0.1)
        beside = xp.tanh(second @ inside)
        return third @ (inside * beside) + third @ inside, first @ x

    special = Specialised(lambda x: network(namespace, x), Graph(loops=True), [vector(20)])
    assert operations(special).count("product") == 4
    assert len([o for o in operations(special) if o not in ("input", "constant", "entry")]) > 200
    result = CompiledFunction(lambda x: network(namespace, x), Graph(loops=True))(vector(20))
    for found, expected in zip(result, network(np, vector(20)), strict=True):
        # Functions of the vector library are exact to four units in the last place.
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_what_is_no_number_stays_in_its_lane():
    x = vector(40)
    x[3, 7] = np.nan
    result = CompiledFunction(lambda x: matrix(40, 40) @ x, Graph(loops=True))(x)
    assert (np.isnan(result).all(axis=0) == (np.arange(LANES) == 7)).all()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_program_is_interpreted_with_its_loops(dtype):
    A, x = matrix(20, 30), vector(30)
    special = Specialised(lambda x: A @ x, Graph(loops=True), [x])
    result = np.stack(interpret(special.program, lambda _, row: x[row], dtype))
    assert result.dtype == dtype
    assert (np.abs(result - A @ x) <= bound(A, x) * (np.finfo(dtype).eps / np.finfo(float).eps)).all()


def test_a_gradient_goes_through_a_loop():
    A, x = matrix(20, 30), vector(30)
    graph = Graph(loops=True)
    with tracing(graph):
        inputs = Traced([[graph.input(0, row)] for row in range(30)], float)
        outputs = namespace.tanh(A @ inputs)
        (found,) = pullback(graph, [outputs], [namespace.ones((20, 1))], [inputs])
    wanted = [ProgramResult(1, row, node) for row, node in enumerate(found.nodes.ravel().tolist())]
    result = np.stack(interpret(program(graph, wanted), lambda _, row: x[row]))
    expected = A.T @ (1.0 - np.tanh(A @ x) ** 2)
    np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12)


def test_c_has_no_form_of_a_loop():
    special = Specialised(lambda x: matrix(20, 30) @ x, Graph(loops=True), [vector(30)])
    with pytest.raises(ValueError, match="cannot be written in C"):
        write_lanes(special.program, "f", special.lane_first)
