"""Programs against NumPy: whatever is traced, folded, cut into parts and compiled has the bits of the same function."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from filtergym.compiler import cache, emission, functions, namespace, native
from filtergym.compiler.block import block_for, block_of
from filtergym.compiler.emission import emit
from filtergym.compiler.functions import CompiledFunction, Specialised
from filtergym.compiler.library import VARIANTS, portable_library
from filtergym.compiler.native import OPTIMISED, Setting, quick_setting
from filtergym.compiler.parts import cut_parts
from filtergym.compiler.program import COMPARISONS, Graph

pytest.importorskip("llvmlite")

WIDTHS = (8, 24, 136)
SETTINGS = [Setting(8, 3, 1), Setting(4, 7, 0), Setting(8, 100, 0), Setting(4, 100, 1)]
ONE = ("sqrt", "abs", "sign", "negative", "floor", "ceil", "trunc", "round")
TWO = ("add", "multiply", "divide")
COMPARED = ("less", "less_equal", "greater", "greater_equal", "equal", "not_equal")
LOGICAL = ("logical_and", "logical_or", "logical_not")
CHOICES = ("where", "where of truths", "number of truth")
WITHOUT_CONSTANTS = (*ONE, *TWO, *COMPARED, *LOGICAL, *CHOICES, "add the negative")
WITH_CONSTANTS = (*ONE, *TWO, *COMPARED, *LOGICAL, *CHOICES, "subtract", "maximum", "minimum")
CONSTANTS = (0.0, 1.0, -1.0, -0.0, 0.3, True, False)


@pytest.fixture(autouse=True)
def _nothing_is_kept(monkeypatch):
    monkeypatch.setenv(cache.SWITCH, "off")


def recipes(names):
    """Random straight lines: names of operations, each with the places of its operands, counted backwards."""
    operand = st.integers(0, 30)
    return st.lists(st.tuples(st.sampled_from(names), operand, operand, operand), min_size=15, max_size=40)


def followed(recipe, xp, floats, whole, truth, constants=()):
    """Numbers and truth values that a recipe makes of rows of floats, of whole numbers and of truth values."""
    numbers, truths = [*floats, xp.astype(whole, xp.float64)], [truth]
    for value in constants:
        (truths if isinstance(value, bool) else numbers).append(xp.asarray(value))
    for name, *places in recipe:
        a, b, _ = (numbers[-1 - place % len(numbers)] for place in places)
        p, q, r = (truths[-1 - place % len(truths)] for place in places)
        if name in ONE:
            numbers.append(getattr(xp, name)(a))
        elif name == "add the negative":  # a difference of the same thing would be folded to zero
            numbers.append(a + -b)
        elif name == "where":
            numbers.append(xp.where(r, a, b))
        elif name == "where of truths":
            truths.append(xp.where(p, q, r))
        elif name == "number of truth":
            numbers.append(xp.astype(p, xp.float64))
        elif name == "logical_not":
            truths.append(~p)
        elif name in LOGICAL:
            truths.append(getattr(xp, name)(p, q))
        else:
            (truths if name in COMPARED else numbers).append(getattr(xp, name)(a, b))
    return numbers, truths


def leaves(special):
    """Rows of floats, of whole numbers and of truth values, as wide as the widest."""
    rng = np.random.default_rng(5)
    floats = np.where(
        rng.random((3, WIDTHS[-1])) < 0.5,
        rng.normal(size=(3, WIDTHS[-1])),
        rng.integers(-3, 4, (3, WIDTHS[-1])),
    )
    if special:
        values = [np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, -1e-310, 1e300]
        floats = np.where(rng.random(floats.shape) < 0.3, rng.choice(values, floats.shape), floats)
    return floats, rng.integers(-3, 4, WIDTHS[-1]), rng.random(WIDTHS[-1]) < 0.5


def computed(recipe, arrays, setting, constants=()):
    """Yield what compiled code makes of a recipe: width, numbers and truth values, for all widths and threads."""

    def function(*arrays):
        numbers, truths = followed(recipe, namespace, *arrays, constants)
        return tuple(numbers), tuple(truths)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "quick_setting", lambda *_: setting)
        patch.setattr(native, "_CODES", {})  # made in another setting
        patch.setattr(functions, "FEWEST", 8)
        compiled = CompiledFunction(function, Graph())
        for width in WIDTHS:
            for threads in (1, 2):
                yield width, *compiled(*(array[..., :width] for array in arrays), threads=threads)


@pytest.mark.parametrize("setting", SETTINGS[:2])
@settings(max_examples=20)
@given(recipe=recipes(WITHOUT_CONSTANTS))
def test_random_programs_have_numpys_bits_also_of_what_is_not_finite(setting, recipe):
    arrays = leaves(special=True)
    with np.errstate(all="ignore"):
        numbers, truths = followed(recipe, np, *arrays)
    for width, made, decided in computed(recipe, arrays, setting):
        for expected, result in zip(numbers, made, strict=True):
            np.testing.assert_array_equal(result, expected[:width])
            known = ~np.isnan(result)
            np.testing.assert_array_equal(np.signbit(result)[known], np.signbit(expected[:width])[known])
        for expected, result in zip(truths, decided, strict=True):
            assert result.dtype == bool
            np.testing.assert_array_equal(result, expected[:width])


@pytest.mark.parametrize("setting", SETTINGS[:2])
@settings(max_examples=20)
@given(recipe=recipes(WITH_CONSTANTS))
def test_random_programs_with_constants_are_numpys_where_all_is_finite(setting, recipe):
    arrays = leaves(special=False)
    with np.errstate(all="ignore"):
        numbers, truths = followed(recipe, np, *arrays, CONSTANTS)
    numbers, truths = ([np.broadcast_to(row, WIDTHS[-1]) for row in rows] for rows in (numbers, truths))
    finite = np.isfinite(numbers).all(axis=0)
    for width, made, decided in computed(recipe, arrays, setting, CONSTANTS):
        for expected, result in zip([*numbers, *truths], [*made, *decided], strict=True):
            # Zeros may differ in their signs, which nothing but infinities would show.
            np.testing.assert_array_equal(result[finite[:width]], expected[:width][finite[:width]])


# --- what becomes of a function


def traced(function, *shapes):
    """Program of a function of float arrays with these shapes, beside their lanes."""
    return Specialised(function, Graph(), [np.zeros((*shape, 8)) for shape in shapes]).program


def operations(function, *shapes):
    return [step.operation for step in traced(function, *shapes).steps if step.operation != "input"]


def test_what_no_result_needs_is_not_computed():
    def function(x):
        namespace.exp(x) + namespace.sin(x)
        return x * x

    assert operations(function, ()) == ["multiply"]


def test_constants_are_computed_while_tracing():
    def function(x):
        steps = namespace.asarray([1.0, 2.0])
        return x * namespace.sum(namespace.exp(steps) @ namespace.eye(2) * 3.0 - 1.0)

    program = traced(function, ())
    assert [step.operation for step in program.steps] == ["input", "constant", "multiply"]
    np.testing.assert_allclose(program.constants, [np.sum(np.exp([1.0, 2.0]) * 3.0 - 1.0)], rtol=1e-15)


def test_the_same_thing_is_computed_once_in_either_order():
    assert operations(lambda x, y: (x + y) * (y + x) / (x + y), (), ()) == ["add", "multiply", "divide"]


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda x, truth: x * 1.0, []),
        (lambda x, truth: 1 * x, []),
        (lambda x, truth: x + 0.0, []),
        (lambda x, truth: 0 + x, []),
        (lambda x, truth: x - 0.0, []),
        (lambda x, truth: x / 1.0, []),
        (lambda x, truth: namespace.negative(-x), []),
        (lambda x, truth: x * -1.0, ["negative"]),
        (lambda x, truth: 0.0 - x, ["negative"]),
        (lambda x, truth: x * 0.0, ["constant"]),
        (lambda x, truth: 0 * namespace.exp(x), ["constant"]),
        (lambda x, truth: 0.0 / x, ["constant"]),
        (lambda x, truth: x - x, ["constant"]),
        (lambda x, truth: namespace.where(True, x, namespace.exp(x)), []),
        (lambda x, truth: namespace.where(False, namespace.exp(x), x), []),
        (lambda x, truth: namespace.where(truth, x, x), []),
        (lambda x, truth: namespace.maximum(x, np.nan), ["constant"]),
        (lambda x, truth: truth & True, []),
        (lambda x, truth: truth | True, ["constant"]),
        (lambda x, truth: truth & False, ["constant"]),
        (lambda x, truth: False | truth, []),
        (lambda x, truth: truth & truth, []),
    ],
)
def test_less_work_for_the_same_finite_numbers(function, expected):
    arrays = np.linspace(-2.0, 3.0, 8), np.arange(8) % 3 == 0
    special = Specialised(function, Graph(), arrays)
    assert [step.operation for step in special.program.steps if step.operation != "input"] == expected
    result = CompiledFunction(function, Graph())(*arrays)
    with np.errstate(divide="ignore"), pytest.MonkeyPatch.context() as patch:
        for name in ("where", "exp", "maximum", "negative"):
            patch.setattr(namespace, name, getattr(np, name))
        np.testing.assert_array_equal(result, function(*arrays))


ARITHMETIC = (*COMPARISONS, "add", "subtract", "multiply", "divide", "maximum", "minimum", "where")
UNARY = ("negative", "absolute", "sqrt", "exp")


def expressions(name, count=400):
    """A graph, and columns of arguments of an operation: known numbers and truth values, and those that vary."""
    graph, rng = Graph(), np.random.default_rng(0)
    known = [graph.constant(value) for value in (0.0, -0.0, 1.0, -1.0, 2.5, np.inf, np.nan)]
    numbers = [*known, *(graph.input(0, row) for row in range(5))]
    numbers += [graph.node("negative", number) for number in numbers[-2:]]
    truths = [graph.constant(True), graph.constant(False)]
    truths += [graph.node("less", number, known[4]) for number in numbers[-5:]]
    kinds = {"where": (truths, numbers, numbers), "number": (truths,)}
    kinds |= dict.fromkeys(("logical_and", "logical_or"), (truths, truths))
    kinds |= dict.fromkeys(UNARY, (numbers,))
    return graph, [rng.choice(kind, count) for kind in kinds.get(name, (numbers, numbers))]


def written(graph, node):
    """An expression with all that it is made of; a constant by its bits."""
    if graph.operations[node] == "constant":
        return np.float64(graph.values[node]).tobytes(), graph.logical[node]
    if graph.operations[node] == "input":
        return graph.arguments[node]
    return (
        graph.operations[node],
        graph.logical[node],
        *(written(graph, part) for part in graph.arguments[node]),
    )


@pytest.mark.parametrize("name", [*ARITHMETIC, *UNARY, "logical_and", "logical_or", "number"])
def test_members_of_a_large_array_are_made_as_one_by_one(name):
    """Also where several are the same, known, simpler than they look, or the same in the other order."""
    (one, columns), (all_at_once, _) = expressions(name), expressions(name)
    expected = [one.node(name, *row) for row in zip(*(column.tolist() for column in columns), strict=True)]
    found = all_at_once.nodes(name, columns)
    assert [written(all_at_once, node) for node in found] == [written(one, node) for node in expected]
    assert sorted(all_at_once.operations) == sorted(one.operations)


def test_a_product_with_zeros_of_a_matrix_vanishes():
    transition = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.9]])
    assert sorted(operations(lambda x: namespace.asarray(transition) @ x, (3,))) == [
        "add",
        "constant",
        "constant",
        "multiply",
        "multiply",
    ]
    special = CompiledFunction(lambda x: namespace.asarray(transition) @ x, Graph())
    x = np.random.default_rng(0).normal(size=(3, 8))
    np.testing.assert_allclose(special(x), transition @ x, rtol=1e-15)
    x[2, 5] = np.nan  # what no zero lets through
    assert np.isnan(special(x)).sum() == 1


def test_functions_that_differ_only_in_numbers_have_the_same_text():
    def text(gain, table):
        def function(x):
            index = namespace.astype(x > gain, namespace.int64)
            return gain * x + namespace.asarray(table)[index]

        special = Specialised(function, Graph(), [np.zeros(8)])
        return emit(
            special.program, special.lane_first, portable_library(), block_of(8), 10
        ), special.program.constants

    (one, values), (other, others) = text(0.3, [1.5, 2.5]), text(0.7, [3.5, np.nan])
    assert one == other
    assert not np.array_equal(values, others)
    assert one != text(1.0, [1.5, 2.5])[0]  # a product with one is less work


def test_places_of_what_crosses_cuts_are_used_again():
    def function(x):
        for _ in range(100):
            x = namespace.sqrt(x * x + 1.0) / 3.0
        return x

    special = Specialised(function, Graph(), [np.zeros(8)])
    text = emit(special.program, special.lane_first, portable_library(), block_of(8), 10)
    assert "@part39" in text
    assert "%scratch = alloca <8 x double>, i64 2," in text


# --- settings


def all_functions(x):
    """Functions of the library, a table, a remainder, a product of matrices, and rows that are written lane by lane."""
    index = namespace.astype(namespace.floor(x[0] * 3.0), namespace.int64)
    table = np.random.default_rng(1).normal(size=12)
    matrix = np.random.default_rng(2).normal(size=(24, 16))
    waves = namespace.stack([namespace.sin(x[1] * k) for k in range(16)])
    far = namespace.hypot(namespace.exp(x[0]), namespace.log(namespace.abs(x[1]) + 1.0))
    return namespace.take(table, index), matrix @ waves, namespace.remainder(far, x[2]), waves


@pytest.mark.parametrize("setting", SETTINGS)
def test_code_has_the_same_bits_in_every_setting(monkeypatch, setting):
    x = np.random.default_rng(4).normal(scale=2.0, size=(3, 24))

    def run(setting):
        monkeypatch.setattr(native, "quick_setting", lambda *_: setting)
        monkeypatch.setattr(native, "_CODES", {})
        special = Specialised(all_functions, Graph(loops=True), [x], turned=True)
        assert "product" in [step.operation for step in special.program.steps]
        special.compile(portable_library())
        return [answer.tobytes() for answer in special.call([x], 24, 1)]

    assert run(setting) == run(OPTIMISED)


@pytest.mark.parametrize("features", ["", *(f"+{name}" for name in VARIANTS), "+avx2,+avx512f"])
def test_no_function_of_the_library_takes_more_lanes_than_a_block_has(features):
    listed = features.split(",")
    lanes = [count for name, (_, count) in VARIANTS.items() if f"+{name}" in listed]
    assert max(lanes, default=1) <= block_for(features).lanes
    assert OPTIMISED.lanes % block_for(features).lanes == 0
    assert quick_setting(features, False).lanes == block_for(features).lanes
    assert quick_setting(features, True).lanes == OPTIMISED.lanes


def chain(length):
    def function(x):
        for _ in range(length):
            x = x * 1.25 + 0.5
        return x

    return function


def named(setting):
    return setting.lanes, setting.part, setting.loops


def settings_used(monkeypatch, function, runs):
    """Settings in which the code of a function was made while it ran."""
    used = []
    monkeypatch.setattr(native, "_CODES", {})
    monkeypatch.setattr(
        native, "emit", lambda *given, emit=emit: (used.append((given[3].lanes, *given[4:])), emit(*given))[1]
    )
    compiled, x = CompiledFunction(function, Graph()), np.ones((1, 8))
    expected = compiled(x)
    for _ in range(runs):
        np.testing.assert_array_equal(compiled(x), expected)
    return used


def test_what_runs_long_is_compiled_again_with_optimisation(monkeypatch):
    monkeypatch.setattr(native, "HOT", 40)
    features = native.processor()[1]
    first, better = named(quick_setting(features, False)), named(OPTIMISED)
    assert settings_used(monkeypatch, chain(5), runs=3) == [first]
    assert settings_used(monkeypatch, chain(6), runs=12) == [first, better]


def test_code_is_made_when_it_runs_and_what_is_timed_is_optimised_at_once():
    made = []
    code = native.Code(lambda: made.append("quick"), lambda: made.append("better"), hot=100)
    assert not made
    with native.optimised_code():
        code.expect(8)
        assert made == ["quick"]  # the start of an episode is not timed
        code.expect(8, in_sequence=True)
        assert made == ["quick", "better"]
    other = native.Code(lambda: made.append("one"), lambda: made.append("other"), hot=100)
    other.expect(8, in_sequence=True)
    assert made == ["quick", "better", "one"]


def test_what_is_compiled_quickly_as_loops_becomes_a_straight_line(monkeypatch):
    monkeypatch.setattr(native, "HOT", 40 * native.IN_LOOPS)
    monkeypatch.setattr(native, "LONG", 30)
    monkeypatch.setattr(native, "LONGEST", 50)
    monkeypatch.setattr(emission, "LONG", 20)
    loops, straight = (
        quick_setting(native.processor()[1], False)._replace(loops=how) for how in (True, False)
    )
    for length, expected in ((11, [loops, OPTIMISED]), (20, [loops, straight]), (30, [loops])):
        assert settings_used(monkeypatch, chain(length), runs=12) == [named(each) for each in expected]
    monkeypatch.setattr(emission, "LONG", 100)  # and what is a straight line already stays one
    assert settings_used(monkeypatch, chain(21), runs=12) == [named(loops)]


def test_parts_are_cut_by_results_as_well_as_by_steps():
    def function(x):
        return x + 1.0, namespace.zeros((250, 1)) + 0.0, namespace.broadcast_to(x * 2.0, (30, *x.shape))

    special = Specialised(function, Graph(), [np.zeros(8)])
    parts, _ = cut_parts(special.program, 20)
    statements = [statement for part in parts for statement in part]
    assert max(map(len, parts)) == 20
    assert sorted(s for s in statements if not isinstance(s, int)) == sorted(special.program.results)
    computed = [i for i, step in enumerate(special.program.steps) if step.operation in ("add", "multiply")]
    assert [s for s in statements if isinstance(s, int)] == computed
    for found, expected in zip(
        CompiledFunction(function, Graph())(np.arange(8.0)),
        (np.arange(8.0) + 1.0, 0.0, np.arange(8.0) * 2.0),
        strict=True,
    ):
        np.testing.assert_array_equal(found, np.broadcast_to(expected, found.shape))
