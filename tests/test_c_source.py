"""Programs as text of C: what a compiler makes of it is what LLVM and NumPy compute, and no text gets in."""

import ctypes
import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from filtergym.compiler import c_source
from filtergym.compiler.c_source import helper_functions, write_lanes, write_program
from filtergym.compiler.c_text import (
    DOUBLE,
    FLOAT,
    Parameter,
    comment,
    function_text,
    identifier,
    literal,
)
from filtergym.compiler.interpretation import interpret
from filtergym.compiler.library import BINARY
from filtergym.compiler.program import (
    COMPARISONS,
    FUNCTIONS,
    LOGICAL,
    OPERATIONS,
    Graph,
    ProgramResult,
    program,
)

STRICT = ("-std=c99", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-pedantic")
ORDERS = np.array([5e-324, 0.5, 1.0, 1.5, 2.5, 3.0, 2.0**52 + 1.0, 1e22, 1e300])
SPECIAL = np.concatenate([ORDERS, -ORDERS, [0.0, -0.0, np.inf, -np.inf, np.nan]])
EVIL = 'range */ #include "/etc/passwd" \n// \\ ??/ " \u202e /* m²'


def compiled(folder: Path, text: str) -> ctypes.CDLL:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here")
    source = folder / "text.c"
    source.write_text(text, encoding="ascii")
    subprocess.run(
        [compiler, *STRICT, "-shared", "-fPIC", "text.c", "-o", "text.so", "-lm"], cwd=folder, check=True
    )
    return ctypes.CDLL(str(folder / "text.so"))


def run_lanes(library, name, arrays):
    """Run a function of :func:`write_lanes` on arrays ``(rows, N)``; the last one is written."""
    addresses = (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))
    strides = (ctypes.c_longlong * len(arrays))(*(array.shape[-1] for array in arrays))
    getattr(library, name)(addresses, strides, ctypes.c_longlong(0), ctypes.c_longlong(arrays[-1].shape[-1]))
    return arrays[-1]


def single(name, arity, constant=None):
    """Program of one operation on rows of one argument, or with a constant in place of the first row."""
    graph = Graph()
    nodes = [graph.input(0, row) for row in range(arity)]
    if constant is not None:
        nodes[0] = graph.constant(constant)
    logical = name in ("logical_and", "logical_or", "logical_not", "number")
    for place in range(arity):
        if logical or (name == "where" and place == 0):
            nodes[place] = graph.node("not_equal", nodes[place], graph.constant(0.0))
    return program(graph, [ProgramResult(1, 0, graph.node(name, *nodes))])


ARITY = {
    **dict.fromkeys((*OPERATIONS, *FUNCTIONS), 1),
    **dict.fromkeys((*LOGICAL, *BINARY, "add", "subtract", "multiply", "divide", "remainder"), 2),
    **dict.fromkeys(("maximum", "minimum"), 2),
    "logical_not": 1,
    "where": 3,
}


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Every operation and function alone, in one file."""
    programs = {f"do_{name}": single(name, count) for name, count in ARITY.items()}
    for name in (*COMPARISONS, "maximum", "minimum"):
        programs |= {f"do_{name}_{i}": single(name, 2, value) for i, value in enumerate(SPECIAL)}
    text = [write_lanes(each, name, [False, False]) for name, each in programs.items()]
    # The functions that several programs call stand before each of them: once is enough here.
    helpers = helper_functions(list(programs.values()))
    whole = "\n".join(["#include <math.h>", helpers, *(_without_helpers(part) for part in text)])
    return compiled(tmp_path_factory.mktemp("operations"), whole)


def _without_helpers(text):
    found = text.index("void do_")
    return text[found:]


PAIRS = np.array(np.meshgrid(SPECIAL, SPECIAL)).reshape(2, -1)


def same_numbers(result, expected):
    """Which of two zeros is the larger, and the sign of a remainder of zero, is left open."""
    np.testing.assert_array_equal(result, expected)


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_are_numpys(name, library):
    count = ARITY[name]
    given = np.concatenate([PAIRS[:1] > 0.0, PAIRS]).astype(float) if count == 3 else PAIRS[:count].copy()
    if name == "remainder":  # beyond that, NumPy divides on where a quotient is no whole number any more
        with np.errstate(all="ignore"):
            given = np.ascontiguousarray(given[:, np.isfinite(given[1])])
    result = run_lanes(library, f"do_{name}", [given, np.empty((1, given.shape[1]))])[0]
    logical = name in ("logical_and", "logical_or", "logical_not", "number")
    arguments = [row != 0.0 if logical or (count == 3 and i == 0) else row for i, row in enumerate(given)]
    with np.errstate(all="ignore"):
        expected = np.where(*arguments) if name == "where" else OPERATIONS[name](*arguments).astype(float)
    same_numbers(result, expected)


@pytest.mark.parametrize("name", [*COMPARISONS, "maximum", "minimum"])
def test_operations_with_a_constant_are_numpys(name, library):
    for i, number in enumerate(SPECIAL):
        given = np.stack([SPECIAL, SPECIAL])
        result = run_lanes(library, f"do_{name}_{i}", [given, np.empty((1, len(SPECIAL)))])[0]
        with np.errstate(all="ignore"):
            same_numbers(result, OPERATIONS[name](number, SPECIAL).astype(float))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_are_those_of_the_standard_library(name, library):
    rng = np.random.default_rng(0)
    given = rng.uniform(0.1, 0.9, (2, 1000)) + (1.0 if name == "acosh" else 0.0)
    result = run_lanes(library, f"do_{name}", [given, np.empty((1, 1000))])[0]
    np.testing.assert_array_max_ulp(result, FUNCTIONS[name](*given[: ARITY[name]]), 8)


EXACT = [name for name in OPERATIONS if name != "remainder"]


def random_program(seed, steps):
    """Program of random operations that are rounded once, or not at all, and a table."""
    rng = np.random.default_rng(seed)
    graph = Graph()
    numbers = [graph.input(0, row) for row in range(4)] + [graph.constant(x) for x in rng.normal(size=3)]
    truths = [graph.node("less", numbers[0], numbers[1])]
    table = rng.normal(size=7)
    while len(graph.operations) < steps:
        name = str(rng.choice([*EXACT, "take"]))
        recent = numbers[-12:]

        def number(recent=recent):
            return int(rng.choice(recent))

        truth = int(rng.choice(truths[-6:]))
        if name == "take":
            varying = [node for node in numbers if graph.values[node] is None]
            numbers.append(graph.take(table, graph.node("floor", int(rng.choice(varying[-12:])))))
        elif name in ("logical_and", "logical_or"):
            truths.append(graph.node(name, truth, int(rng.choice(truths[-6:]))))
        elif name in ("logical_not", "number"):
            (truths if name == "logical_not" else numbers).append(graph.node(name, truth))
        elif name == "where":
            numbers.append(graph.node(name, truth, number(), number()))
        elif name in COMPARISONS:
            truths.append(graph.node(name, number(), number()))
        else:
            numbers.append(graph.node(name, *(number() for _ in range(ARITY[name]))))
    wanted = [*rng.choice(numbers[7:], 12), *truths[-3:], numbers[0], numbers[5]]
    return program(graph, [ProgramResult(1, row, int(node)) for row, node in enumerate(wanted)])


SEEDS = range(12)


@pytest.fixture(scope="module")
def random_programs(tmp_path_factory):
    """Random programs in one file, some of several parts."""
    programs = [random_program(seed, 120 if seed % 4 else 700) for seed in SEEDS]
    helpers = helper_functions(programs)
    text = []
    for seed, each in enumerate(programs):
        own = write_lanes(each, f"program_{seed}", [False, False])
        text.append(own.replace("#include <math.h>", "").replace(helper_functions([each]), ""))
    whole = "\n".join(["#include <math.h>", helpers, *text])
    return programs, compiled(tmp_path_factory.mktemp("random"), whole)


@pytest.mark.parametrize("seed", SEEDS)
def test_random_programs_have_the_bits_of_compiled_code(seed, random_programs):
    native = pytest.importorskip("llvmlite") and importlib.import_module("filtergym.compiler.native")
    programs, library = random_programs
    code = programs[seed]
    given = np.random.default_rng(seed).normal(scale=3.0, size=(4, 32))
    given[:, 24:] = np.random.default_rng(seed).choice(SPECIAL, (4, 8))
    expected = np.empty((len(code.results), 32))
    table = np.array(
        [code.constants.ctypes.data] + [n for a in (given, expected) for n in (a.ctypes.data, a.shape[1])]
    )
    native.native(code, [False, False]).expect(32)(table.ctypes.data, 0, 32)
    result = run_lanes(library, f"program_{seed}", [given, np.empty_like(expected)])
    np.testing.assert_array_equal(result, expected)


def test_long_programs_are_written_in_parts():
    code = random_program(0, 700)
    count = sum(step.operation not in ("input", "constant") for step in code.steps)
    assert count > c_source.PART
    count += len(code.results)
    text = write_lanes(code, "line", [False, False])
    assert len(re.findall(r"static void line_part_\d+\(", text)) == -(-count // c_source.PART)


# --- numbers


@pytest.mark.parametrize("value", [0.1, -1.0 / 3.0, 5e-324, 1.7976931348623157e308, -0.0, 1e22, 3.0])
def test_a_literal_is_read_again_to_the_last_bit(value):
    read = float(literal(value).strip("()"))
    assert np.float64(read).tobytes() == np.float64(value).tobytes()


def test_what_float_lacks_is_replaced_and_reported():
    assert [literal(x, FLOAT) for x in (1e-300, -1e300, 1e-40, 0.1, np.inf, -np.inf, np.nan)] == [
        "FLT_MIN", "(-FLT_MAX)", "FLT_MIN", "0.1f", "((float)INFINITY)", "(-(float)INFINITY)", "(float)NAN",
    ]  # fmt: skip
    graph = Graph()
    node = graph.node("maximum", graph.input(0, 0), graph.constant(1e-300))
    code = program(graph, [ProgramResult(1, 0, node)])
    written = [
        write_program(code, "f", [], lambda *_: "x", lambda *_: "y", scalar) for scalar in (DOUBLE, FLOAT)
    ]
    assert [source.replaced for source in written] == [(), (1e-300,)]
    assert "FLT_MIN" in written[1].body[0]


# --- words


@pytest.mark.parametrize(
    "words", [EVIL, "int", "1st", "", "é*/", "x" * 100, "v12", "w", "a__b", "_Bool", "NAN"]
)
def test_any_words_make_an_identifier(words):
    name = identifier(words)
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*_?", name)
    assert len(name) < 63
    assert name not in ("int", "NAN", "w", "v12")
    assert identifier(words, {name}) != name


def test_no_words_leave_a_comment(tmp_path):
    name = identifier(EVIL)
    text = comment(EVIL, "second " * 40, "ends in a star *", "/")
    assert text.count("*/") == 1
    assert text.count("/*") == 1
    assert "\\" not in text
    assert "??" not in text
    function = function_text("int", name, [Parameter("int", identifier("for"))], ["return 7;"])
    library = compiled(tmp_path, f"int {name}(int for_);\n{text}\n{function}")
    assert getattr(library, name)(0) == 7


# --- CUDA


@pytest.mark.parametrize("seed", SEEDS[:4])
def test_a_kernel_of_cuda_has_the_bits_of_the_straight_line(seed):
    cupy = pytest.importorskip("cupy")
    if not cupy.cuda.is_available():
        pytest.skip("no GPU here")
    code, N = random_program(seed, 120 if seed % 4 else 700), 300  # the last block is not full
    given = np.random.default_rng(seed).choice(SPECIAL, (4, N))
    given[:, : N // 2] = np.random.default_rng(seed).normal(scale=3.0, size=(4, N // 2))
    arrays = [cupy.asarray(given), cupy.full((len(code.results), N), cupy.nan)]
    table = cupy.asarray([array.data.ptr for array in arrays], dtype=cupy.uint64)
    strides = cupy.full(2, N, dtype=cupy.int64)
    # A product and a sum that are rounded together have other bits.
    text = write_lanes(code, "kernel", [False, False], cuda=True)
    kernel = cupy.RawModule(code=text, options=("--fmad=false",)).get_function("kernel")
    kernel((3,), (128,), (table, strides, np.int64(N)))
    with np.errstate(all="ignore"):
        expected = interpret(code, lambda _, row: given[row])
    for result, row in zip(cupy.asnumpy(arrays[1]), expected, strict=True):
        np.testing.assert_array_equal(result, np.broadcast_to(row, (N,)))
