"""Every operation and every library function at ordinary, extreme and special numbers, for every processor's way."""

import functools
import platform

import numpy as np
import pytest
from contract import assert_properties

from filtergym.compiler import cache, native
from filtergym.compiler.functions import Specialised
from filtergym.compiler.library import BINARY, VARIANTS, fastest_library, portable_library
from filtergym.compiler.program import COMPARISONS, FUNCTIONS, OPERATIONS, Graph, ProgramResult, program

pytest.importorskip("llvmlite")

HERE = native.processor()
INTEL = platform.machine() in ("x86_64", "AMD64")
PROCESSORS = [HERE, ("x86-64", "")] if INTEL else [HERE]
"""This one, and the least of its kind: it has no instruction that rounds, and two numbers a register."""
LIBRARIES = [fastest_library(HERE[1]), portable_library()]
"""The fastest one, the slowest, and what processors with narrower vectors take."""
LIBRARIES += [fastest_library(f"+{name}") for name in VARIANTS if INTEL and f"+{name}" in HERE[1].split(",")]
LIBRARIES = list({library.name: library for library in LIBRARIES}.values())
UNITS = 4.0
"""Units in the last place that a function may be wrong by: what glibc promises of its vectors. Measured there: 3.2 of
tan, 3.1 of sin and cos, 2.8 of expm1, 2.6 of exp, less than 2.4 of the others; 2.0 of its scalar functions."""
ORDERS = np.array([5e-324, 1e-310, 0.5, 1.0, 1.5, 2.5, 3.0, 709.8, 745.2, 800.0, 2.0**52 + 1.0, 1e22, 1e300])
SPECIAL = np.concatenate([ORDERS, -ORDERS, [0.0, -0.0, np.inf, -np.inf, np.nan]])
PAIRS = np.repeat(SPECIAL, len(SPECIAL)), np.tile(SPECIAL, len(SPECIAL))


@pytest.fixture(autouse=True)
def _nothing_is_kept(monkeypatch):
    monkeypatch.setenv(cache.SWITCH, "off")
    with np.errstate(all="ignore"):
        yield


def computed(name, arrays, library=None, constant=None):
    """Apply one operation to arrays, or to an array and a constant whose place is given."""
    graph = Graph()
    nodes = [graph.input(place, 0) for place in range(len(arrays))]
    for place, array in enumerate(arrays):
        if place == constant:
            nodes[place] = graph.constant(array[0])
        elif array.dtype == bool:
            nodes[place] = graph.node("not_equal", nodes[place], graph.constant(0.0))
    count = len(arrays[0])
    padded = [np.concatenate([array.astype(float), np.zeros(-count % 8)]) for array in arrays]
    padded.append(np.empty_like(padded[0]))
    code = program(graph, [ProgramResult(len(arrays), 0, graph.node(name, *nodes))])
    table = np.array(
        [code.constants.ctypes.data] + [n for a in padded for n in (a.ctypes.data, 0)], dtype=np.int64
    )
    native.native(code, [False] * len(padded), library).expect(8)(table.ctypes.data, 0, len(padded[0]))
    return padded[-1][:count]


def same_bits(result, expected, sign_of_zero=True):
    np.testing.assert_array_equal(result, expected)
    known = ~np.isnan(result) & ((result != 0.0) | sign_of_zero)
    np.testing.assert_array_equal(np.signbit(result[known]), np.signbit(expected[known]))


# --- operations

TRUTHS = np.array([False, False, True, True]), np.array([False, True, False, True])
ARGUMENTS = {
    **dict.fromkeys((*COMPARISONS, "add", "subtract", "multiply", "divide", "maximum", "minimum"), PAIRS),
    **dict.fromkeys(("logical_and", "logical_or"), TRUTHS),
    **dict.fromkeys(("logical_not", "number"), TRUTHS[:1]),
    **dict.fromkeys(("negative", "sign", "absolute", "floor", "ceil", "trunc", "rint", "sqrt"), (SPECIAL,)),
    "where": (np.arange(len(PAIRS[0])) % 3 == 0, *PAIRS),
    "remainder": PAIRS,
}


@pytest.mark.parametrize("processor", PROCESSORS, ids=lambda processor: processor[0])
@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_have_numpys_bits(name, processor, monkeypatch):
    monkeypatch.setattr(native, "processor", lambda: processor)
    arguments = ARGUMENTS[name]
    if name == "remainder":  # beyond that, NumPy divides on where a quotient is no whole number any more
        chosen = np.isfinite(arguments[1]) & ~(np.abs(arguments[0] / arguments[1]) > 2.0**52)
        arguments = tuple(part[chosen] for part in arguments)
    expected = np.where(*arguments) if name == "where" else OPERATIONS[name](*arguments).astype(float)
    # Which of two zeros is the larger NumPy leaves to the processor.
    same_bits(
        computed(name, arguments), expected, sign_of_zero=name not in ("maximum", "minimum", "remainder")
    )


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize("name", [*COMPARISONS, "maximum", "minimum"])
def test_operations_with_a_constant_have_numpys_bits(name, place):
    for number in SPECIAL:
        arguments = [SPECIAL, SPECIAL]
        arguments[place] = np.full_like(SPECIAL, number)
        result = computed(name, arguments, constant=place)
        same_bits(result, OPERATIONS[name](*arguments).astype(float), sign_of_zero=False)


def test_a_remainder_and_a_whole_quotient_are_rounded_as_numpys():
    rng = np.random.default_rng(0)
    divisor = np.concatenate([rng.normal(size=2000), np.full(1000, 0.1), np.full(1000, -2.0 * np.pi)])
    number = rng.normal(size=4000) * 10.0 ** rng.integers(-9, 9, 4000)
    multiples = rng.integers(-20, 20, 4000) * divisor  # where the quotient is easily rounded up
    for dividend in (number, multiples, np.nextafter(multiples, -np.inf)):
        np.testing.assert_array_equal(computed("remainder", [dividend, divisor]), dividend % divisor)


# --- functions of libraries


def within(low, high):
    return np.random.default_rng(1).uniform(low, high, 1000)


def magnitudes(low, high):
    """Powers of ten of either sign."""
    return 10.0 ** within(low, high) * np.where(np.arange(1000) % 2, -1.0, 1.0)


NEAR, TINY = within(-1.0, 1.0), magnitudes(-323.0, -1.0)
POSITIVE, ANGLES = (
    np.abs(magnitudes(-323.0, 308.0)),
    (within(-10.0, 10.0), within(-1e5, 1e5), magnitudes(5.0, 300.0)),
)
ORDINARY = {
    "exp": (within(-745.0, 709.7), NEAR, TINY),
    "expm1": (within(-40.0, 709.7), NEAR, TINY),
    "exp2": (within(-1074.0, 1023.9), NEAR, TINY),
    **{name: (POSITIVE, within(0.5, 2.0), 1.0 + 1e-8 * NEAR) for name in ("log", "log2", "log10")},
    "log1p": (POSITIVE, within(-0.999, 2.0), TINY),
    **dict.fromkeys(("sin", "cos", "tan"), (*ANGLES, TINY)),
    **dict.fromkeys(("asin", "acos", "atanh"), (NEAR, TINY)),
    **{name: (within(-10.0, 10.0), TINY, magnitudes(0.0, 308.0)) for name in ("atan", "asinh", "tanh")},
    **{name: (within(-710.0, 710.0), NEAR, TINY) for name in ("sinh", "cosh")},
    "acosh": (within(1.0, 10.0), np.abs(magnitudes(0.0, 308.0))),
}
MIXED, TURNED = magnitudes(-300.0, 307.0), magnitudes(-300.0, 307.0)[::-1]
ORDINARY_PAIRS = {
    "atan2": ((within(-10.0, 10.0), NEAR[::-1]), (TINY, TINY[::-1]), (MIXED, TURNED)),
    "hypot": ((within(-10.0, 10.0), NEAR[::-1]), (TINY, TINY[::-1]), (MIXED, TURNED)),
    "pow": (
        (within(0.1, 10.0), within(-300.0, 300.0)[::-1]),
        (np.abs(MIXED), NEAR[::-1]),
        (1.0 + 1e-5 * NEAR, 1e6 * NEAR[::-1]),
        (within(-10.0, 0.0), np.round(within(-30.0, 30.0)[::-1])),
    ),
}


def units_off(result, exact):
    """Largest error in units in the last place, of what is finite."""
    rounded = exact.astype(float)
    finite = np.isfinite(rounded)
    assert finite.mean() > 0.9
    np.testing.assert_array_equal(result[~finite], rounded[~finite])
    return np.max((np.abs(result - exact) / np.spacing(np.abs(rounded)))[finite])


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 60, reason="needs longer numbers to compare with")
@pytest.mark.parametrize("library", LIBRARIES, ids=lambda library: library.name)
def test_functions_are_exact_to_a_few_units_in_the_last_place(library):
    assert_properties(
        list(FUNCTIONS), (functools.partial(is_exact_to_a_few_units_in_the_last_place, library),)
    )


def is_exact_to_a_few_units_in_the_last_place(library, name):
    for arguments in ORDINARY_PAIRS[name] if name in BINARY else [(numbers,) for numbers in ORDINARY[name]]:
        exact = FUNCTIONS[name](*(part.astype(np.longdouble) for part in arguments))
        assert units_off(computed(name, arguments, library), exact) <= UNITS


@pytest.mark.parametrize("library", LIBRARIES, ids=lambda library: library.name)
def test_functions_are_numpys_at_special_numbers(library):
    assert_properties(list(FUNCTIONS), (functools.partial(is_numpys_at_special_numbers, library),))


def is_numpys_at_special_numbers(library, name):
    arguments = PAIRS if name in BINARY else (SPECIAL,)
    result, expected = computed(name, arguments, library), FUNCTIONS[name](*arguments)
    # NaN, infinities and zeros of either sign are where NumPy has them; the last bits of the others may differ.
    exact = ~np.isfinite(expected) | (expected == 0.0)
    same_bits(result[exact], expected[exact])
    np.testing.assert_array_max_ulp(result[~exact], expected[~exact], 2.0 * UNITS)


# --- what is written

EIGHT = np.arange(8.0)


@pytest.mark.parametrize("rows", [(), (1,), (3,)], ids=str)
def test_the_last_array_can_be_written_lane_by_lane(rows):
    numbers = np.random.default_rng(0).normal(size=(*rows, 24))
    special = Specialised(lambda x: (x + 1.0, x * 2.0), Graph(), [numbers], turned=True)
    first, last = np.empty((*rows, 24)), np.empty((24, *rows))
    special.bound([numbers], [first, last])(0, 24)
    np.testing.assert_array_equal(first, numbers + 1.0)
    np.testing.assert_array_equal(last, numbers.T * 2.0)


def test_only_the_lanes_asked_for_are_written():
    special = Specialised(lambda x: x + 1.0, Graph(), [EIGHT])
    numbers, result = np.arange(32.0), np.zeros(32)
    special.bound([numbers], [result])(8, 24)
    np.testing.assert_array_equal(result[8:24], numbers[8:24] + 1.0)
    assert not result[:8].any()
    assert not result[24:].any()
