"""Native calls over many time steps in one call, without a return to Python in between.

A step is a list of calls, each a function and its table of addresses. Two memories alternate: one step writes what the
next one reads. So there are two lists, for even and odd steps. Some entries of the tables advance with every step.

A tile of lanes passes through all steps before the next tile begins, so that it stays in the processor's cache.
"""

import ctypes
import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy

from .block import LANES
from .functions import UNCOUNTED, Call, address_of, empty_lanes, run_over
from .native import Native, address_of_code, native_text

TILE = 64
"""Number of lanes of a tile: large enough that a call costs little compared with its arithmetic, small enough for the
cache. Programs of 300 to 80,000 operations all run within a tenth of the time of their fastest tile, from 32 to 512
lanes.
"""

TRIES = 12
"""Number of runs in which the times of one thread and of several are compared."""

TEXT = """
define void @program(ptr %given, i64 %first, i64 %last) {
entry:
  %codes.place = getelementptr i64, ptr %given, i64 0
  %codes = load ptr, ptr %codes.place
  %tables.place = getelementptr i64, ptr %given, i64 1
  %tables = load ptr, ptr %tables.place
  %calls.place = getelementptr i64, ptr %given, i64 2
  %calls = load i64, ptr %calls.place
  %entries.place = getelementptr i64, ptr %given, i64 3
  %entries = load ptr, ptr %entries.place
  %amounts.place = getelementptr i64, ptr %given, i64 4
  %amounts = load ptr, ptr %amounts.place
  %moving.place = getelementptr i64, ptr %given, i64 5
  %moving = load i64, ptr %moving.place
  %steps.place = getelementptr i64, ptr %given, i64 6
  %steps = load i64, ptr %steps.place
  %tile.place = getelementptr i64, ptr %given, i64 7
  %tile = load i64, ptr %tile.place
  %lasting.place = getelementptr i64, ptr %given, i64 8
  %lasting = load ptr, ptr %lasting.place
  %hops.place = getelementptr i64, ptr %given, i64 9
  %hops = load ptr, ptr %hops.place
  %lasts.place = getelementptr i64, ptr %given, i64 10
  %lasts = load i64, ptr %lasts.place
  br label %tile.head
tile.head:
  %start = phi i64 [%first, %entry], [%ahead, %tile.next]
  %tiles = phi i64 [0, %entry], [%tiles.after, %tile.next]
  %ahead = add i64 %start, %tile
  %whole = icmp slt i64 %ahead, %last
  %end = select i1 %whole, i64 %ahead, i64 %last
  %any = icmp slt i64 %start, %last
  br i1 %any, label %step.head, label %home.head
step.head:
  %step = phi i64 [0, %tile.head], [%step.after, %step.next]
  %more = icmp slt i64 %step, %steps
  br i1 %more, label %call.start, label %rewind.head
call.start:
  %odd = and i64 %step, 1
  %begin = mul i64 %odd, %calls
  %finish = add i64 %begin, %calls
  br label %call.head
call.head:
  %call = phi i64 [%begin, %call.start], [%call.after, %call.body]
  %left = icmp slt i64 %call, %finish
  br i1 %left, label %call.body, label %move.head
call.body:
  %code.place = getelementptr ptr, ptr %codes, i64 %call
  %code = load ptr, ptr %code.place
  %table.place = getelementptr ptr, ptr %tables, i64 %call
  %table = load ptr, ptr %table.place
  call void %code(ptr %table, i64 %start, i64 %end)
  %call.after = add i64 %call, 1
  br label %call.head
move.head:
  %move = phi i64 [0, %call.head], [%move.after, %move.body]
  %moves = icmp slt i64 %move, %moving
  br i1 %moves, label %move.body, label %step.next
move.body:
  %entry.place = getelementptr ptr, ptr %entries, i64 %move
  %entry.at = load ptr, ptr %entry.place
  %amount.place = getelementptr i64, ptr %amounts, i64 %move
  %amount = load i64, ptr %amount.place
  %value = load i64, ptr %entry.at
  %moved = add i64 %value, %amount
  store i64 %moved, ptr %entry.at
  %move.after = add i64 %move, 1
  br label %move.head
step.next:
  %step.after = add i64 %step, 1
  br label %step.head
rewind.head:
  %back = phi i64 [0, %step.head], [%back.after, %rewind.body]
  %backs = icmp slt i64 %back, %moving
  br i1 %backs, label %rewind.body, label %hop.start
rewind.body:
  %back.place = getelementptr ptr, ptr %entries, i64 %back
  %back.at = load ptr, ptr %back.place
  %far.place = getelementptr i64, ptr %amounts, i64 %back
  %far = load i64, ptr %far.place
  %way = mul i64 %far, %steps
  %here = load i64, ptr %back.at
  %origin = sub i64 %here, %way
  store i64 %origin, ptr %back.at
  %back.after = add i64 %back, 1
  br label %rewind.head
hop.start:
  %tiles.after = add i64 %tiles, 1
  br label %hop.head
hop.head:
  %same = phi i64 [0, %hop.start], [%same.after, %hop.body]
  %sames = icmp slt i64 %same, %lasts
  br i1 %sames, label %hop.body, label %tile.next
hop.body:
  %same.place = getelementptr ptr, ptr %lasting, i64 %same
  %same.at = load ptr, ptr %same.place
  %hop.place = getelementptr i64, ptr %hops, i64 %same
  %hop = load i64, ptr %hop.place
  %there = load i64, ptr %same.at
  %further = add i64 %there, %hop
  store i64 %further, ptr %same.at
  %same.after = add i64 %same, 1
  br label %hop.head
tile.next:
  br label %tile.head
home.head:
  %home = phi i64 [0, %tile.head], [%home.after, %home.body]
  %homes = icmp slt i64 %home, %lasts
  br i1 %homes, label %home.body, label %exit
home.body:
  %home.place = getelementptr ptr, ptr %lasting, i64 %home
  %home.at = load ptr, ptr %home.place
  %leap.place = getelementptr i64, ptr %hops, i64 %home
  %leap = load i64, ptr %leap.place
  %hopped = mul i64 %leap, %tiles
  %away = load i64, ptr %home.at
  %begun = sub i64 %away, %hopped
  store i64 %begun, ptr %home.at
  %home.after = add i64 %home, 1
  br label %home.head
exit:
  ret void
}
"""
"""LLVM text of the function that makes the calls; :class:`CallSequence` makes its argument."""


@functools.cache
def _driver() -> Native:
    driver: Native = native_text(TEXT, level=0)  # nearly all the time is spent in its calls
    return driver


class Moving(NamedTuple):
    """An entry of a call's table of addresses that advances with every step."""

    call: Call
    entry: int
    amount: int
    """Increment after every step: bytes of an address, or that of a counter."""


def moving_array(call: Call, place: int, arrays: numpy.ndarray) -> Moving:
    """Return a :class:`Moving` entry that sets an argument of a call to the next of several arrays at each step.

    Args:
        call: the call; its argument is set to the first array.
        place: number of the argument.
        arrays: arrays of all steps, ``(steps, ..., N)``.
    """
    call.replace(place, arrays[0])
    return Moving(call, 1 + 2 * place, arrays.strides[0])


class CallSequence:
    """Sequence of native calls over one or many time steps, run as one native call.

    Args:
        even: calls of an even step, in order.
        odd: calls of an odd step, of the same number; needed for more than one step.
        moving: entries of these calls' tables that advance with every step; after the last step they are restored.
        steps: number of steps; the first is even.
        passing: arrays ``(..., tile)`` of these calls: call, number of the array of the first tile, and distance in
            bytes to that of the next tile. Zero: all tiles share the array, and its content is lost when a tile ends.
        tile: number of lanes that pass through all steps together.
    """

    def __init__(
        self,
        even: Sequence[Call],
        odd: Sequence[Call] = (),
        moving: Sequence[Moving] = (),
        steps: int = 1,
        passing: Sequence[tuple[Call, int, int]] = (),
        tile: int = TILE,
    ) -> None:
        self._calls, self._form = [*even, *odd], (len(even), steps, tile)
        self._codes = numpy.zeros(len(self._calls), dtype=numpy.int64)
        self._natives: list[Native] = []
        self._count, self._asked = [0, 0], 0
        """Lanes since the last check for optimised code and number of checks, shared by sequences that count together;
        and the number of checks at the last run of this sequence.
        """
        self._tries, self._seconds = 0, [math.inf, math.inf]
        self._amounts = numpy.array([each.amount for each in moving], dtype=numpy.int64)
        self._tables = numpy.array([call.address for call in self._calls], dtype=numpy.int64)
        self._entries = numpy.array(
            [each.call.address + 8 * each.entry for each in moving], dtype=numpy.int64
        )
        self._passing = passing
        self._lasting = numpy.array([call.address + 8 + 16 * i for call, i, _ in passing], dtype=numpy.int64)
        # Calls count lanes from the first lane of all tiles.
        self._hops = numpy.array([apart - 8 * tile for *_, apart in passing], dtype=numpy.int64)
        self._given = self._driver_argument(self._tables, self._entries, self._lasting)
        self._run = functools.partial(_driver(), address_of(self._given))
        self._shares: dict[tuple[int, int], _Share] = {}

    def _driver_argument(
        self, tables: numpy.ndarray, entries: numpy.ndarray, lasting: numpy.ndarray
    ) -> numpy.ndarray:
        count, steps, tile = self._form
        addresses = address_of(self._codes), address_of(tables), count, address_of(entries)
        return numpy.array(
            [
                *(*addresses, address_of(self._amounts), len(self._amounts), steps, tile),
                *(address_of(lasting), address_of(self._hops), len(lasting)),
            ],
            dtype=numpy.int64,
        )

    def expect(self, lanes: int, in_sequence: bool = False) -> None:
        """Select the machine code of every call for a run over this many lanes (:meth:`.functions.Call.expect`)."""
        natives = [call.expect(lanes, in_sequence) for call in self._calls]
        if natives != self._natives:
            self._natives, self._tries, self._seconds = natives, 0, [math.inf, math.inf]
            self._codes[:] = list(map(address_of_code, natives))

    def run(self, width: int, threads: int = 1) -> None:
        """Run all steps over ``width`` lanes, with several threads if that was measured to be faster."""
        count = self._count
        count[0] += width * self._form[1]
        if count[0] > UNCOUNTED:
            self.expect(count[0] // 2)
            count[0], count[1] = 0, count[1] + 1
            self._asked = count[1]
        elif self._asked != count[1] or not self._natives:
            self.expect(0)
            self._asked = count[1]
        if threads == 1 or width < 2 * LANES:
            self._run(0, width)
            return
        # The first runs alternate between both ways; the shortest time of each is least disturbed.
        trial = self._tries < TRIES
        alone = self._tries % 2 == 0 if trial else self._seconds[0] < self._seconds[1]
        begin = time.perf_counter() if trial else 0.0
        if alone:
            self._run(0, width)
        else:
            own_tables = len(self._amounts) or self._passing
            grain = self._form[2] if self._passing else LANES
            run_over(self._run_share if own_tables else self._run, width, threads, grain, grain)
        if trial:
            self._seconds[not alone] = min(self._seconds[not alone], time.perf_counter() - begin)
            self._tries += 1

    def call(self, width: int) -> Callable[[], None]:
        """Return a call without arguments that runs all steps over all lanes, in half the time of :meth:`run`.

        The caller keeps the sequence, and calls :meth:`expect` before the first run and once in a while.
        """
        driver: Callable[..., None] = _driver()
        address, first, last = (
            ctypes.c_void_p(address_of(self._given)),
            ctypes.c_int64(0),
            ctypes.c_int64(width),
        )
        return functools.partial(driver, address, first, last)

    def count_with(self, other: "CallSequence") -> None:
        """Share the count of lanes with another sequence of the same code on other memory."""
        self._count = other._count

    def run_once(self, width: int, threads: int = 1) -> None:
        """Run all steps over ``width`` lanes once, with optimised code if the number of steps is worth it."""
        self.expect(self._form[1] * width // 2, in_sequence=True)
        self.run(width, threads)

    def _run_share(self, first: int, last: int) -> None:
        share = self._shares.get((first, last))
        if share is None:
            share = self._shares[first, last] = self._make_share()
        for own, call in zip(share.tables, self._calls, strict=True):
            own[:] = call.table
        for table, place, array, apart in share.passing:
            table[1 + 2 * place] = address_of(array) + first // self._form[2] * apart - 8 * first
        _driver()(share.address, first, last)

    def _make_share(self) -> "_Share":
        tables = [call.table.copy() for call in self._calls]
        addresses = numpy.array(list(map(address_of, tables)), dtype=numpy.int64)
        ends = self._tables + 8 * numpy.array([len(table) for table in tables])

        def moved(entries: numpy.ndarray) -> tuple[numpy.ndarray, list[int]]:
            owners = [int(numpy.flatnonzero((e >= self._tables) & (e < ends))[0]) for e in entries]
            return addresses[owners] + entries - self._tables[owners], owners

        (entries, _), (lasting, owners) = moved(self._entries), moved(self._lasting)
        arrays: dict[int, numpy.ndarray] = {}
        passing = []
        for owner, (call, place, apart) in zip(owners, self._passing, strict=True):
            own = known = call.arrays[place]
            if not apart:
                own = arrays.setdefault(id(known), empty_lanes(known.shape[:-1], known.shape[-1]))
            passing.append((tables[owner], place, own, apart))
        given = self._driver_argument(addresses, entries, lasting)
        return _Share(tables, addresses, entries, lasting, passing, given, address_of(given))


class _Share(NamedTuple):
    tables: list[numpy.ndarray]
    addresses: numpy.ndarray
    entries: numpy.ndarray
    lasting: numpy.ndarray
    passing: list[tuple[numpy.ndarray, int, numpy.ndarray, int]]
    """Table, number of the array, the array, and distance to that of the next tile in bytes."""
    given: numpy.ndarray
    address: int
