"""Compiled functions as they are called: structures, arrays of every kind, lanes, threads and processes."""

import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import pytest

from filtergym.compiler import cache, functions, namespace, native
from filtergym.compiler.functions import CompiledFunction, Specialised
from filtergym.compiler.program import Graph
from filtergym.compiler.sequence import CallSequence, moving_array

pytest.importorskip("llvmlite")


class Track(NamedTuple):
    position: Any
    flags: Any


class Bank(NamedTuple):
    track: Track
    nothing: None
    more: dict[str, Any]


@pytest.fixture(autouse=True)
def _nothing_is_kept(monkeypatch):
    monkeypatch.setenv(cache.SWITCH, "off")


def numbers(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def ordinary(x):
    """A function of ``(3, N)`` numbers, of the library too."""
    return namespace.exp(-x) * namespace.sin(x[::-1]) + namespace.sum(x * x, axis=0) / 3.0


@pytest.fixture
def compiled():
    return CompiledFunction(ordinary, Graph())


# --- structures


def moved(bank, step):
    """A new position; everything else is handed on as it is."""
    track = bank.track._replace(position=bank.track.position + step)
    return (
        bank._replace(track=track),
        {"speed": step / 2.0, "flag": ~bank.track.flags, "bank": bank.more},
        None,
    )


def test_structures_come_back_as_they_went_in():
    position, flags, count = numbers(2, 8), np.arange(8) % 2 == 0, np.arange(8)
    bank = Bank(Track(position, flags), None, {"count": count, "none": None, "pair": (position, flags)})
    after, reports, nothing = CompiledFunction(moved, Graph())(bank, np.full(8, 0.25))
    assert type(after) is Bank
    assert type(after.track) is Track
    assert after.nothing is None
    assert nothing is None
    assert list(reports) == ["speed", "flag", "bank"]
    assert list(after.more) == ["count", "none", "pair"]
    np.testing.assert_array_equal(after.track.position, position + 0.25)
    np.testing.assert_array_equal(reports["speed"], np.full(8, 0.125))
    np.testing.assert_array_equal(reports["flag"], ~flags)
    assert reports["flag"].dtype == bool
    # What passes through is the given array.
    assert after.track.flags is flags
    assert after.more["count"] is count
    assert reports["bank"]["count"] is count


def test_a_part_of_an_array_or_another_kind_of_it_is_a_new_one():
    x, i = numbers(3, 8), np.arange(8)

    def function(x, i):
        return x[:2], x[::-1], namespace.astype(i, namespace.float64), x * 1.0

    first, turned, as_floats, same = CompiledFunction(function, Graph())(x, i)
    np.testing.assert_array_equal(first, x[:2])
    np.testing.assert_array_equal(turned, x[::-1])
    assert as_floats.dtype == np.float64
    assert same is x


def test_arrays_of_every_shape():
    for shape in ((11,), (0, 11), (1, 11), (2, 0, 3, 11), (2, 1, 3, 2, 11), (3, 0)):
        x = numbers(*shape)
        result = CompiledFunction(lambda x: x * 2.0 + 1.0, Graph())(x)
        np.testing.assert_array_equal(result, x * 2.0 + 1.0, strict=True)


def test_answers_can_have_another_dtype_and_no_operations():
    x = 10.0 * numbers(8)

    def function(x):
        return (
            namespace.astype(x, namespace.int64),
            x > 0,
            namespace.ones((2, 1)),
            namespace.zeros(1, dtype=bool),
        )

    whole, positive, ones, no = CompiledFunction(function, Graph())(x)
    np.testing.assert_array_equal(whole, x.astype(np.int64), strict=True)
    np.testing.assert_array_equal(positive, x > 0, strict=True)
    np.testing.assert_array_equal(ones, np.ones((2, 8)), strict=True)
    np.testing.assert_array_equal(no, np.zeros(8, dtype=bool), strict=True)


def test_every_structure_is_traced_once():
    calls = []
    function = CompiledFunction(lambda x, y: (calls.append(1), x if y is None else x + y)[1], Graph())
    x, y = numbers(2, 8), numbers(8, seed=1)
    for _ in range(2):
        assert function(x, None) is x
        np.testing.assert_array_equal(function(x, y), x + y)
        np.testing.assert_array_equal(function(x[0], y), x[0] + y)
        np.testing.assert_array_equal(function(x[0], y > 0), x[0] + (y > 0))
    assert len(calls) == 4


# --- arrays


def test_inputs_are_never_written_to(compiled):
    x = numbers(3, 24)
    x.flags.writeable = False
    kept = x.copy()
    result = compiled(x)
    np.testing.assert_array_equal(x, kept)
    assert not np.shares_memory(result, x)


@pytest.mark.parametrize(
    "other",
    [
        np.asfortranarray,
        lambda x: np.repeat(x, 2, axis=1)[:, ::2],
        lambda x: x[::-1].copy()[::-1],
        lambda x: x[:, ::-1].copy()[:, ::-1],
        lambda x: np.concatenate([x, x], axis=1)[:, 24:],
        lambda x: np.concatenate([np.zeros((3, 1)), x], axis=1)[:, 1:],
        lambda x: x.T.copy().T,
        lambda x: x.astype(x.dtype.newbyteorder()),
        lambda x: np.rec.fromarrays([np.zeros(3, "i1"), x], dtype=[("a", "i1"), ("x", "f8", (24,))])["x"],
        lambda x: np.frombuffer(b"." + x.tobytes(), offset=1).reshape(x.shape),
    ],
)
def test_memory_of_every_order_reads_the_same(compiled, other):
    x = numbers(3, 24)
    np.testing.assert_array_equal(other(x), x)
    np.testing.assert_array_equal(compiled(other(x)), compiled(x))


def test_every_row_may_be_the_same_memory(compiled):
    row = np.broadcast_to(numbers(24), (3, 24))
    np.testing.assert_array_equal(compiled(row), compiled(row.copy()))
    cube = np.broadcast_to(numbers(4, 24)[:, None], (2, 4, 3, 24))
    double = CompiledFunction(lambda x: x * 2.0, Graph())
    np.testing.assert_array_equal(double(cube), cube * 2.0)


@pytest.mark.parametrize("dtype", ["f4", "f2", "i8", "i2", "u1", "?"])
def test_numbers_of_every_kind_are_read_as_what_they_are(dtype):
    x = (np.arange(24.0) % 7 - (0 if dtype in ("u1", "?") else 3)).reshape(2, 12).astype(dtype)
    result = CompiledFunction(lambda x: namespace.astype(x, namespace.float64) / 4.0, Graph())(x)
    np.testing.assert_array_equal(result, x.astype(np.float64) / 4.0)


def test_one_lane_stands_for_all_but_other_widths_are_refused():
    add = CompiledFunction(lambda x, y: x + y, Graph())
    x, y = numbers(2, 11), numbers(2, 1)
    np.testing.assert_array_equal(add(x, y), x + y)
    with pytest.raises(ValueError, match=r"arrays must have one width, got \[3, 11\]"):
        add(x, x[:, :3])


# --- lanes and threads


@pytest.fixture
def _threads_from_few_lanes(monkeypatch):
    monkeypatch.setattr(functions, "FEWEST", 8)


@pytest.mark.usefixtures("_threads_from_few_lanes")
def test_every_width_and_number_of_threads_has_the_same_bits(compiled):
    x = numbers(3, 1100)
    whole = compiled(x)
    for width in (1, 2, 7, 8, 9, 15, 16, 17, 63, 512, 520, 1024, 1031):
        for threads in (1, 2, 3, 7):
            np.testing.assert_array_equal(compiled(x[:, :width], threads=threads), whole[:, :width])
    for lane in (0, 5, 1099):
        np.testing.assert_array_equal(compiled(x[:, lane : lane + 1])[:, 0], whole[:, lane])


def test_threads_share_all_lanes_in_whole_blocks():
    for width in (8, 520, 1024, 1032, 4096, 5008):
        for threads in (1, 2, 3, 5):
            ranges = []
            functions.run_over(
                lambda first, last, ranges=ranges: ranges.append((first, last)), width, threads
            )
            ranges.sort()
            assert [first for first, _ in ranges] == [0, *(last for _, last in ranges[:-1])]
            assert ranges[-1][1] == width
            assert all(first % 8 == 0 for first, _ in ranges)
            assert len(ranges) == max(1, min(threads, width // functions.FEWEST))


def test_an_error_of_a_thread_is_raised():
    def call(first, last):
        raise FloatingPointError(first)

    with pytest.raises(FloatingPointError):
        functions.run_over(call, 4096, 2)


def test_rows_begin_on_cache_lines():
    for shape, width in (((3,), 8), ((2, 5), 512), ((), 1024)):
        memory = functions.empty_lanes(shape, width)
        assert memory.shape == (*shape, width)
        assert memory.ctypes.data % 64 == 0
        assert all(stride % 64 == 0 for stride in memory.strides[:-1])


def test_one_thread_at_a_time_traces_into_a_graph():
    graph, start, inside, most = Graph(), threading.Barrier(3), [], []

    def function(x):
        inside.append(x)
        time.sleep(0.01)  # here the others would come in
        most.append(len(inside))
        inside.pop()
        return x + 1.0

    def work(rows):
        start.wait()
        return CompiledFunction(function, graph)(np.zeros((rows, 8)))

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(work, range(3)))
    assert most == [1, 1, 1]


# --- processes


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.usefixtures("_threads_from_few_lanes")
def test_a_forked_process_goes_on_and_compiles_what_is_new(compiled):
    x = numbers(3, 64)
    expected = compiled(x, threads=2), CompiledFunction(lambda x: ordinary(x) / 7.0, Graph())(x)
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(60)  # what hangs ends, and fails
        try:
            new = CompiledFunction(lambda x: ordinary(x) / 7.0, Graph())
            native._CODES.clear()
            os.write(write, compiled(x, threads=2).tobytes() + new(x, threads=2).tobytes())
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as answer:
        assert answer.read() == b"".join(array.tobytes() for array in expected)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("work", ["tracing", "compilation"])
def test_a_fork_waits_for_a_thread_that_traces_or_compiles(monkeypatch, work):
    """No thread in the child would release what the thread holds."""
    x, graph, begun = numbers(3, 8), Graph(), threading.Event()

    def pause():
        begun.set()
        time.sleep(0.2)  # meanwhile the main thread forks

    def function(x):
        if work == "tracing" and not begun.is_set():
            pause()
        return ordinary(x) / 11.0

    def loaded(*given, own=native._load):
        if work == "compilation" and not begun.is_set():
            pause()
        return own(*given)

    monkeypatch.setattr(native, "_load", loaded)
    monkeypatch.setattr(native, "_CODES", {})  # where it may be of an earlier test
    thread = threading.Thread(target=CompiledFunction(function, graph), args=(x,))
    thread.start()
    begun.wait()
    child = os.fork()
    if child == 0:
        signal.alarm(10)  # what hangs ends, and fails
        try:
            CompiledFunction(function, graph)(x)
            os._exit(0)
        finally:
            os._exit(1)
    thread.join()
    assert os.waitpid(child, 0)[1] == 0


# --- what is bound to memory


def test_a_bound_function_reads_and_writes_rebound_memory():
    special = Specialised(lambda x: x + 1.0, Graph(), [numbers(2, 8)])
    first, second, result = numbers(2, 8), numbers(2, 8, seed=1), np.empty((2, 8))
    call = special.bound([first], [result])
    call(0, 8)
    np.testing.assert_array_equal(result, first + 1.0)
    first += 1.0
    call(0, 8)
    np.testing.assert_array_equal(result, first + 1.0)
    call.replace(0, second)
    call(0, 8)
    np.testing.assert_array_equal(result, second + 1.0)
    assert special.example().shape == (2, 8)


@pytest.mark.parametrize("threads", [1, 3])
def test_a_sequence_runs_its_calls_over_all_steps(threads):
    """x <- x + y[k], reported at every step; what one step writes the next one reads, from the other memory."""
    steps, width = 5, 3 * 512
    x, y = numbers(width), np.stack([numbers(width, seed=k) for k in range(steps)])
    add = CompiledFunction(lambda x, y: (x + y,), Graph()).specialise(x, y[0])
    tell = CompiledFunction(lambda x: (2.0 * x,), Graph()).specialise(x)
    memory, reports = [x.copy(), np.empty(width)], np.empty((steps, width))
    turns, moving = [], []
    for now, then in (memory, memory[::-1]):
        calls = [add.bound([now, y[0]], [then]), tell.bound([then], [reports[0]])]
        moving += [moving_array(calls[0], 1, y), moving_array(calls[1], 1, reports)]
        turns.append(calls)
    tables = [call.table.copy() for calls in turns for call in calls]
    CallSequence(*turns, moving, steps, tile=40).run(width, threads)
    expected = [x]
    for row in y:
        expected.append(expected[-1] + row)
    np.testing.assert_array_equal(reports, 2.0 * np.array(expected[1:]))
    np.testing.assert_array_equal(memory[steps % 2], expected[-1])
    for call, table in zip((call for calls in turns for call in calls), tables, strict=True):
        np.testing.assert_array_equal(call.table, table)


def test_an_argument_can_be_read_lane_by_lane():
    x = numbers(24, 3)
    special = Specialised(lambda x, y: (x[0] - x[2] + y,), Graph(), [x.T, x[:, 1]], given_turned=True)
    answer = np.empty(24)
    special.bound([x, x[:, 1].copy()], [answer])(0, 24)
    np.testing.assert_array_equal(answer, x[:, 0] - x[:, 2] + x[:, 1])
