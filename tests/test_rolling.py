"""Loops that a straight line is rolled up into: the same operations on the same numbers, bit for bit."""

import ctypes
import functools
import re

import numpy as np
import pytest
from test_c_source import SPECIAL, compiled, random_program
from test_exports_c import replayed

from filtergym.compiler import cache, emission, namespace, native, rolling
from filtergym.compiler.block import block_of
from filtergym.compiler.c_loops import Arrays, Rows
from filtergym.compiler.c_source import helper_functions, write_program
from filtergym.compiler.c_text import Parameter, function_text
from filtergym.compiler.emission import emit
from filtergym.compiler.interpretation import interpret
from filtergym.compiler.library import portable_library
from filtergym.compiler.namespace import Traced
from filtergym.compiler.program import FUNCTIONS, OPERATIONS, Graph, ProgramResult, program
from filtergym.compiler.rolling import CONSTANTS, SCRATCH, TURN, roll
from filtergym.exports.traced_filter import ANSWER, DERIVED, INITIAL, MEASUREMENT, STATE

QUICK = [
    ("ManeuveringTarget", "imm"),
    ("ManeuveringTarget", "kalman-imm-turn"),
    ("UavAutopilot", "mehra"),
    ("UavAutopilot", "bptt-small"),
    ("LooselyCoupledNavigation", "time-varying"),
    ("RadarEsmTracking", "forgetting-joint-type"),
]


def place_in(length, index):
    """Place in a table: from its end where negative, the nearest one outside, the first one of what is no number."""
    index = np.where(index < 0.0, index + length, index)
    return np.where(index > 0.0, np.minimum(index, length - 1.0), 0.0).astype(int)


def run_loops(code, read, shown=0, between=None):
    """Run a rolled program turn by turn, by its text; returns the results in the program's order."""
    rolled = roll(code, shown)
    scratch, written = {}, {}

    def find(operand, k, turn):
        if operand.array == TURN:
            return turn[operand.places[0]]
        place = operand.places[k]
        if operand.array == SCRATCH:
            value = scratch[place]
        else:
            value = code.constants[place] if operand.array == CONSTANTS else read(operand.array, place)
        return np.asarray(value) != 0.0 if operand.logical else np.asarray(value, dtype=float)

    with np.errstate(all="ignore"):
        for number, loop in enumerate(rolled.loops):
            if number == rolled.before and between is not None:
                between([written[result[:2]] for result in code.results[:shown]])
            for k in range(loop.turns):
                turn = {}
                for statement in loop.body:
                    values = [find(operand, k, turn) for operand in statement.operands]
                    value = compute(code, statement, values)
                    turn[statement.number] = value
                    for to in statement.kept:
                        assert to.places[k] < rolled.scratch or to.array != SCRATCH
                        where = (
                            (scratch, to.places[k])
                            if to.array == SCRATCH
                            else (written, (to.array, to.places[k]))
                        )
                        where[0][where[1]] = np.array(value, dtype=float)
    assert len(written) == len({result[:2] for result in code.results})
    return [written[result[:2]] for result in code.results]


def compute(code, statement, values):
    if statement.operation == "copy":
        return values[0]
    if statement.operation == "take":
        start, length = statement.table
        return code.constants[start : start + length][place_in(length, values[0])]
    if statement.operation == "where":
        return np.where(*values)
    if statement.operation == "number":
        return values[0].astype(float)
    return {**OPERATIONS, **FUNCTIONS}[statement.operation](*values)


def assert_same_bits(found, expected):
    for one, other in zip(found, expected, strict=True):
        one, other = np.broadcast_arrays(np.asarray(one, dtype=float), np.asarray(other, dtype=float))
        # Whatever is no number is the same to everybody; of zeros the sign counts.
        np.testing.assert_array_equal(one, other)
        numbers = ~np.isnan(one)
        assert one[numbers].tobytes() == other[numbers].tobytes()


# --- arrays


def arrays_of(x):
    """Arrays as filters have them: products with constants zero and one, choices, tables, and truth values."""
    xp = namespace
    matrix = x[:16].reshape(4, 4)
    sparse = np.diag([1.0, 2.0, 0.0, -1.0]) + np.eye(4, k=2)
    product = xp.matmul(sparse, xp.matmul(matrix, sparse.T)) + np.eye(4)
    chosen = xp.where(product > x[3], matrix, 0.5)
    limits = np.array([0.1, -0.3, 0.0, np.inf])
    bounded = xp.minimum(xp.maximum(chosen, limits), x[:4])
    turned = xp.maximum(limits[:, None], bounded)
    of_table = xp.take(np.array([0.5, -1.5, 2.5]), xp.floor(x[4:12]))
    one_of = xp.take(xp.concat([x[:2], xp.asarray([7.0])]), xp.floor(x[5:11]))
    sorted_ones = xp.sort(xp.concat([of_table, x[12:16]]))
    truths = xp.logical_and(sorted_ones > 0.0, xp.logical_not(xp.isnan(sorted_ones)))
    counted = xp.sum(xp.where(truths, 1.0, 0.0))
    some_known = xp.maximum(x[3:9], xp.concat([x[:3], xp.zeros(3)]))
    outer = xp.sum(x[:8, None] * x[None, 8:], axis=0)
    numbers = xp.concat(
        [some_known, outer, turned.reshape(16), of_table, one_of, sorted_ones, xp.sqrt(xp.abs(x)), x[:3]]
    )
    return xp.concat([numbers, xp.stack([counted, xp.asarray(3.0)])]), truths


@functools.cache
def array_program():
    graph = Graph()
    with namespace.tracing(graph):
        given = Traced(np.array([graph.input(0, row) for row in range(16)]), np.float64)
        numbers, truths = arrays_of(given)
        nodes = [*numbers.nodes.tolist(), *truths.nodes.tolist()]
        shuffled = np.random.default_rng(0).permutation(len(nodes)).tolist()
        return program(
            graph, [ProgramResult(1, row, node) for row, node in zip(shuffled, nodes, strict=True)]
        )


def inputs(N=40):
    rng = np.random.default_rng(1)
    given = rng.normal(scale=2.0, size=(16, N))
    given[:, N // 2 :] = rng.choice(SPECIAL, (16, N - N // 2))
    return given


def test_loops_of_array_operations_have_the_bits_of_the_straight_line():
    code, given = array_program(), inputs()
    rolled = roll(code)
    assert sum(len(loop.body) for loop in rolled.loops) < len(code.steps) / 2
    assert_same_bits(run_loops(code, lambda _, row: given[row]), interpret(code, lambda _, row: given[row]))


@pytest.mark.parametrize("seed", range(4))
def test_a_program_without_array_operations_is_rolled_up_too(seed):
    code, given = random_program(seed, 300), inputs()
    assert_same_bits(run_loops(code, lambda _, row: given[row]), interpret(code, lambda _, row: given[row]))


def test_first_results_are_known_before_another_input_is_read():
    """As what a network is shown before it answers; inputs that stand beside others are copied when they are there."""
    graph = Graph()
    with namespace.tracing(graph):
        x, answer = (Traced([graph.input(place, row) for row in range(8)], np.float64) for place in (0, 2))
        shown = namespace.concat([x[:4], 2.0 * x[:4]]) + x
        mixed = namespace.concat([answer[:4], x[4:]]) * namespace.concat([x[:4], answer[4:]]) + shown
        last = namespace.concat([mixed, answer, x[:3]])
    wanted = [ProgramResult(3, row, node) for row, node in enumerate(shown.nodes.tolist())]
    code = program(
        graph, [*wanted, *(ProgramResult(1, row, node) for row, node in enumerate(last.nodes.tolist()))]
    )
    given, outputs = inputs(), []

    def read(argument, row):
        assert argument == 0 or outputs
        return given[argument + row]

    expected = interpret(code, lambda argument, row: given[argument + row])
    assert_same_bits(run_loops(code, read, 8, outputs.append), expected)
    assert_same_bits(outputs[0], expected[:8])


def test_loops_in_c_have_the_bits_of_the_straight_line(tmp_path):
    code, given = array_program(), np.ascontiguousarray(inputs().T)
    rows = len(code.results)
    parameters = [Parameter("const double *", "a"), Parameter("double *", "b")]
    arrays = Arrays({0: Rows("a", range(16))}, {1: Rows("b", range(rows))})
    text = ["#include <math.h>", helper_functions([code])]
    for name, places in (("straight", None), ("rolled", arrays)):
        source = write_program(
            code, name, parameters, lambda _, row: f"a[{row}]", lambda _, row: f"b[{row}]", arrays=places
        )
        assert ("for (" in "".join([source.functions, *source.body])) == (name == "rolled")
        assert ("++j" in "".join([source.functions, *source.body])) == (name == "rolled")
        text += [source.functions, function_text("void", name, parameters, source.body)]
    library = compiled(tmp_path, "\n".join(text))
    found = {}
    for name in ("straight", "rolled"):
        found[name] = np.full((len(given), rows), np.inf)
        for lane in range(len(given)):
            addresses = (given[lane].ctypes.data, found[name][lane].ctypes.data)
            getattr(library, name)(*map(ctypes.c_void_p, addresses))
    assert_same_bits(found["rolled"], found["straight"])


def test_a_loop_in_c_names_the_function_of_its_operations():
    graph = Graph(callers=True)
    with namespace.tracing(graph):
        given = Traced(np.array([graph.input(0, row) for row in range(16)]), np.float64)
        nodes = np.concatenate([array.nodes.ravel() for array in arrays_of(given)]).tolist()
    code = program(graph, [ProgramResult(1, row, node) for row, node in enumerate(nodes)])
    arrays = Arrays({0: Rows("a", range(16))}, {1: Rows("b", range(len(nodes)))})
    texts = []
    for each in (code, code._replace(callers={})):
        source = write_program(
            each, "f", [], lambda _, row: f"a[{row}]", lambda _, row: f"b[{row}]", arrays=arrays
        )
        texts.append("\n".join([source.functions, *source.body]))
    assert "/* test_rolling.arrays_of" in texts[0]
    assert re.sub(r"/\*.*?\*/\s*", "", texts[0], flags=re.DOTALL) == texts[1]


def test_a_short_program_stays_a_straight_line():
    graph = Graph()
    code = program(graph, [ProgramResult(1, 0, graph.node("add", graph.input(0, 0), graph.input(0, 1)))])
    arrays = Arrays({0: Rows("a", range(2))}, {1: Rows("b", range(1))})
    source = write_program(code, "f", [], lambda _, row: f"a[{row}]", lambda _, row: "b[0]", arrays=arrays)
    assert source.body == ["const double v2 = a[0] + a[1];", "b[0] = v2;"]


# --- code of this processor


def addresses(code, lane_first, lanes):
    """Arrays of a program, of random numbers what it reads, and the table with which code runs on them."""
    rows = [1] * len(lane_first)
    for operation, arguments, _ in code.steps:
        if operation == "input":
            rows[arguments[0]] = max(rows[arguments[0]], arguments[1] + 1)
    for argument, row, _ in code.results:
        rows[argument] = max(rows[argument], row + 1)
    rng = np.random.default_rng(0)
    numbers = [rng.normal(scale=2.0, size=(count, lanes)) for count in rows]
    arrays = [
        np.ascontiguousarray(each.T if turned else each)
        for each, turned in zip(numbers, lane_first, strict=True)
    ]
    table = [code.constants.ctypes.data]
    for array in arrays:
        table += [array.ctypes.data, array.shape[1]]
    return arrays, np.array(table, dtype=np.int64)


def assert_loops_are_the_straight_line(code, lane_first, lanes=16):
    """In LLVM, of both widths of a block; the results lie in the last arrays."""
    found = []
    for width, loops in ((8, False), (8, True), (4, True)):
        text = emit(code, lane_first, portable_library(), block_of(width), 150, loops)
        assert ("%turn" in text) <= loops
        run = native._load("", lambda text=text: text, native.NATIVE, 0)
        arrays, table = addresses(code, lane_first, lanes)
        run(table.ctypes.data, 0, lanes)
        found.append(arrays)
    for other in found[1:]:
        assert_same_bits(other, found[0])


@pytest.fixture
def _everything_in_loops(monkeypatch):
    pytest.importorskip("llvmlite")
    monkeypatch.setenv(cache.SWITCH, "off")
    monkeypatch.setattr(emission, "LONG", 0)
    monkeypatch.setattr(rolling, "SHORTER", 0.0)
    for function in portable_library().functions.values():
        native.llvm().add_symbol(function.symbol, function.address)


@pytest.mark.usefixtures("_everything_in_loops")
@pytest.mark.parametrize("lane_first", [[False, False], [False, True], [True, False]])
def test_loops_of_llvm_have_the_bits_of_the_straight_line(lane_first):
    assert_loops_are_the_straight_line(array_program(), lane_first)
    assert_loops_are_the_straight_line(random_program(1, 300), [False, *lane_first])


# --- filters


@pytest.mark.parametrize(("environment", "name"), QUICK)
def test_a_filter_in_loops_has_the_bits_of_its_straight_line(environment, name):
    """Start and three measurements."""
    traced, given = replayed(environment, name, episodes=2, measurements=3)
    own = list(traced.free.usual)
    derived = own[: traced.free.kept]
    kept = dict(enumerate(derived, len(traced.state) - len(derived)))
    start = {INITIAL: given.initial, DERIVED: own, STATE: kept}
    state = interpret(traced.start, lambda argument, row: start[argument][row])
    assert_same_bits(run_loops(traced.start, lambda argument, row: start[argument][row]), state)
    state = [*state, *derived]
    answers = np.random.default_rng(0).uniform(0.2, 0.8, (64, 2))
    for measured in given.measurements:
        structures = {STATE: state, MEASUREMENT: measured, ANSWER: answers}
        outputs: list = []

        def read(argument, row, structures=structures, outputs=outputs):
            assert argument != ANSWER or outputs or not traced.shown  # what is shown comes before any answer
            return structures[argument][row]

        found = run_loops(traced.update, read, traced.shown, outputs.append)
        expected = interpret(traced.update, lambda argument, row, own=structures: own[argument][row])
        assert_same_bits(found, expected)
        if traced.shown:
            assert_same_bits(outputs[0], expected[: traced.shown])
        end = traced.shown + len(traced.state) - len(derived)
        state = [*expected[traced.shown : end], *derived]
