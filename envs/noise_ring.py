"""Random numbers of episodes side by side, each from a generator of its own.

**What an episode is.** When an episode starts, its lane's generator gives, in this order, the uniform numbers
of the scenario, the normal numbers of the track's start, and the rows of noise, one for each measurement.
Nothing of this depends on actions or on the control: policies of different controls that start from the
same seed face the same noise. An episode of more than ``LONGEST_BLOCK`` measurements gets its rows in
blocks from a child generator, seeded by integers drawn from the lane's.

**The ring.** All lanes share one clock. A lane that restarts writes its rows into the ring from the current slot on, so
that every step reads one contiguous slice, whatever the lanes' own times are.
"""

import copy
from collections.abc import Sequence
from typing import Any

import numpy

from ..compiler.functions import address_of, round_up_lanes
from .observation import Array
from .task import Task

LONGEST_BLOCK = 256
"""Measurements of noise that an episode draws at once."""
BLOCK = 64
"""Rows of a block where an episode is longer than that: 64 rows keep 4096 lanes in cache-friendly memory."""
PORTION = 64
"""Lanes whose noise is drawn before it is put into the ring: it is still in the cache then."""


class NoiseRing:
    """Noise of ``count`` lanes.

    Args:
        task: whose layout and namespace it has.
        count: number of lanes.
    """

    def __init__(self, task: Task, count: int) -> None:
        self.task, self._layout = task, task.noise
        self._width = round_up_lanes(count)
        self.generators: list[numpy.random.Generator] = []
        self._children: list[numpy.random.Generator | None] = [None] * count
        rows = task.horizon + 1
        self._row_width = task.noise.normals + task.noise.row_uniforms
        self._in_blocks = rows > LONGEST_BLOCK
        self._slots = BLOCK if self._in_blocks else rows
        self._ring: Array = None
        self._place = (0, 0)
        """Address of the ring, and bytes from one row to the next."""
        self._clock = 0
        self._started = numpy.zeros(count, dtype=numpy.int64)
        """When each lane's episode began."""

    def seed(self, lane: int, generator: numpy.random.Generator) -> None:
        """Give a lane the generator that its coming episodes are drawn from."""
        while len(self.generators) <= lane:
            self.generators.append(generator)
        self.generators[lane] = generator

    def draw_episodes(self, lanes: Sequence[int]) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Draw new episodes: return uniforms and initial normals, lanes last; the rows go into the ring."""
        layout = self._layout
        self._started[numpy.asarray(lanes)] = self._clock
        uniforms = numpy.empty((len(lanes), layout.uniforms))
        normals = numpy.empty((len(lanes), layout.initial_normals))
        generators = [self.generators[lane] for lane in lanes]
        if layout.uniforms:
            for generator, numbers in zip(generators, uniforms, strict=True):
                generator.random(out=numbers)
        before = normals
        if self._in_blocks:
            for generator, numbers in zip(generators, normals, strict=True):
                generator.standard_normal(out=numbers)
            generators = [numpy.random.default_rng(g.integers(0, 2**63, size=2)) for g in generators]
            for lane, child in zip(lanes, generators, strict=True):
                self._children[lane] = child
            before = normals[:, :0]
        self._draw_rows(lanes, generators, before)
        return uniforms.T, normals.T

    def _draw_rows(self, lanes: Sequence[int], generators: Sequence[Any], before: numpy.ndarray) -> None:
        """Draw ``_slots`` rows for each lane and write them into the ring from the current slot on.

        Args:
            lanes: ascending.
            generators: theirs.
            before: filled with normal numbers that are drawn before the rows, ``(lanes, any number)``.
        """
        task, layout = self.task, self._layout
        first = self._clock % self._slots
        ahead = self._slots - first
        on_host = task.xp is numpy
        if self._ring is None:
            shape = (self._slots, self._row_width)
            self._ring = task.xp.zeros((*shape, self._width), dtype=task.xp.float64, device=task.device)
            self._place = (0, 0)
        # In portions: what was drawn is turned into the ring while it is in the cache. A device gets all at once.
        portion = PORTION if on_host else len(lanes)
        ahead_of_rows = before.shape[1]
        drawn = numpy.empty((min(portion, len(lanes)), ahead_of_rows + self._slots * self._row_width))
        rows = drawn[:, ahead_of_rows:].reshape(len(drawn), self._slots, self._row_width)
        for start in range(0, len(lanes), portion):
            chosen = lanes[start : start + portion]
            for i, (generator, numbers) in enumerate(
                zip(generators[start : start + portion], drawn, strict=False)
            ):
                if layout.row_uniforms == 0:
                    generator.standard_normal(out=numbers)
                else:
                    generator.standard_normal(out=numbers[:ahead_of_rows])
                    rows[i, :, : layout.normals] = generator.standard_normal((self._slots, layout.normals))
                    rows[i, :, layout.normals :] = generator.random((self._slots, layout.row_uniforms))
            before[start : start + portion] = drawn[: len(chosen), :ahead_of_rows]
            turned: Any = numpy.moveaxis(rows[: len(chosen)], 0, -1)
            side_by_side = range(chosen[0], chosen[0] + len(chosen))
            where: Any = slice(side_by_side.start, side_by_side.stop)
            if list(chosen) != list(side_by_side):
                where = task.xp.asarray(chosen, device=task.device)
            if not on_host:
                turned = task.xp.asarray(numpy.ascontiguousarray(turned), device=task.device)
            self._ring[first:, :, where] = turned[:ahead]
            self._ring[:first, :, where] = turned[ahead:]

    def advance(self) -> None:
        """Go on to the next measurement."""
        self._clock += 1
        if self._in_blocks:
            due = numpy.flatnonzero((self._clock - self._started) % self._slots == 0).tolist()
            if due:
                self._draw_rows(due, [self._children[lane] for lane in due], numpy.empty((len(due), 0)))

    def take_rows(self, most: int) -> tuple[int, int, int]:
        """Go on over several measurements whose rows lie one after the other, of NumPy's arrays.

        Args:
            most: measurements.

        Returns:
            Address of the row of the first of them, bytes from one row to the next, and how many there are.
        """
        self.advance()
        slot = self._clock % self._slots
        count = min(most, self._slots - slot)
        if self._in_blocks:  # rows are drawn anew when a lane has come to the end of its own
            count = min(count, self._slots - int(((self._clock - self._started) % self._slots).max()))
        address = self.address
        self._clock += count - 1
        return address, self._place[1], count

    @property
    def row(self) -> Array:
        """Noise of this measurement, ``(row width, width)``; it is written over later."""
        return self._ring[self._clock % self._slots]

    @property
    def address(self) -> int:
        """Address of :attr:`row`, of NumPy's arrays."""
        start, stride = self._place
        if not start:
            start, stride = self._place = address_of(self._ring), self._ring.strides[0]
        return start + self._clock % self._slots * stride

    def grow(self, count: int, index: Array) -> None:
        """Make room for more lanes.

        Args:
            count: of all of them, a multiple of eight.
            index: for each the lane whose noise it has until it is drawn anew.
        """
        added = count - len(self._started)
        self._started = numpy.append(self._started, numpy.repeat(self._started[:1], added))
        # None that belongs to another lane: long episodes draw from theirs as they go.
        self.generators += [numpy.random.default_rng(0) for _ in range(added)]
        self._children += [child and numpy.random.default_rng(0) for child in self._children[:1] * added]
        if self._ring is not None:
            self._ring = self.task.xp.take(self._ring, index, axis=-1)
        self._width, self._place = count, (0, 0)

    def snapshot(self) -> dict[str, Any]:
        """Return all that the coming numbers depend on; :meth:`restore` goes back to it, as often as one likes."""
        return copy.deepcopy({name: value for name, value in self.__dict__.items() if name != "task"})

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot of the same task and as many lanes."""
        self.__dict__.update(copy.deepcopy(snapshot), _place=(0, 0))

    def __getstate__(self) -> dict[str, Any]:
        """All but the address: a copy lies elsewhere."""
        return {**self.__dict__, "_place": (0, 0)}
