"""Random numbers of parallel episodes, computed from the identities of the episodes.

When an episode starts, its lane's generator gives its *identity*, two whole numbers of 64 bits. Every random number of
the episode is a function of its identity, the measurement ``t`` and the number's place in the measurement
(:mod:`..compiler.counter_numbers`): at ``t = 0`` those of its start, from ``t = 1`` on those of measurement ``t``. So
policies of different controls that start from the same seed have the same noise.

Compiled code and NumPy make the same bits.
"""

import copy
import functools
from collections.abc import Sequence
from typing import Any

import numpy

from ...compiler.counter_code import bind_numbers
from ...compiler.counter_numbers import numbers
from ...compiler.functions import Call, address_of, empty_lanes, round_up_lanes
from ...compiler.native import AVAILABLE
from ..contract.observation import Array
from ..contract.task import Task
from ..contract.task_base import NoiseLayout

AHEAD = 1 << 13
"""Lanes times measurements that NumPy makes at once, since a call takes longer than the numbers of a few lanes."""
BLOCKS_OF_SEEDS = 64
"""Number of blocks of seeds whose identities a process stores."""


def draw_identity(generator: numpy.random.Generator) -> numpy.ndarray:
    """Draw the identity of a new episode: two random 64-bit integers, ``(2,)`` uint64."""
    # The generator's raw words: its methods take ten times longer for the same numbers.
    found: numpy.ndarray = generator.bit_generator.random_raw(2)
    return found


@functools.lru_cache(BLOCKS_OF_SEEDS)
def _identities_of_seeds(seeds: tuple[int, ...]) -> numpy.ndarray:
    found = numpy.empty((2, len(seeds)), dtype=numpy.uint64)
    for lane, seed in enumerate(seeds):
        found[:, lane] = draw_identity(numpy.random.default_rng(seed))
    found.flags.writeable = False
    return found


def identities_of_seeds(seeds: Sequence[int]) -> numpy.ndarray:
    """Return the identities ``(2, N)`` of the episodes that resets with N seeds start.

    Seeding a generator is slow, so the identities of the last blocks of seeds are cached.
    """
    return _identities_of_seeds(tuple(seeds))


def start_numbers(identities: numpy.ndarray, layout: NoiseLayout) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Return the uniform and normal numbers at the start of the episodes with these identities.

    Their shapes are ``(layout.uniforms, N)`` and ``(layout.initial_normals, N)``.
    """
    t = numpy.zeros(identities.shape[1], dtype=numpy.int64)
    found = numbers(identities, t, layout.initial_normals, layout.uniforms)
    return found[layout.initial_normals :], found[: layout.initial_normals]


def uniforms_of_seeds(seeds: Sequence[int], layout: NoiseLayout) -> numpy.ndarray:
    """Return the uniform numbers ``(layout.uniforms, N)`` that draw the scenarios of the episodes of N seeds."""
    return start_numbers(identities_of_seeds(seeds), layout)[0]


class EpisodeNoise:
    """Random numbers of the running episodes in ``count`` lanes (parallel episodes).

    Args:
        count: number of lanes; they are padded to a multiple of eight by episodes of identity zero.

    Attributes:
        identities: of the lanes' episodes, ``(2, width)`` uint64.
        measurement: last measurement whose numbers were made in each lane, ``(width,)`` int64; -1 before the start.
        generators: generator of the identities of the coming episodes of each lane.
    """

    def __init__(self, task: Task, count: int) -> None:
        self._layout = task.noise
        self.task = task
        self._rows = task.noise.normals + task.noise.row_uniforms
        self.generators: list[numpy.random.Generator] = []
        self._set_width(round_up_lanes(count))

    def _set_width(self, width: int) -> None:
        self.width = width
        self.identities: numpy.ndarray = numpy.zeros((2, width), dtype=numpy.uint64)
        self.measurement: numpy.ndarray = numpy.full(width, -1, dtype=numpy.int64)
        self._forget()

    def _forget(self) -> None:
        self._next: Call | None = None
        self._due = False
        """Whether the numbers of the current measurement are still to be made."""
        self._row: Array = None
        self._ahead: numpy.ndarray | None = None
        """Rows of the coming measurements, ``(measurements, rows, width)``, where NumPy makes them."""
        self._slot = 0

    # --- which episodes

    def seed(self, lane: int, generator: numpy.random.Generator) -> None:
        """Set the random generator that draws the identities of a lane's next episodes."""
        while len(self.generators) <= lane:
            self.generators.append(generator)
        self.generators[lane] = generator

    def draw_identities(self, lanes: Sequence[int]) -> numpy.ndarray:
        """Draw the identities ``(2, lanes)`` of new episodes in some lanes."""
        generators = self.generators
        return numpy.concatenate([draw_identity(generators[lane]) for lane in lanes]).reshape(-1, 2).T

    def set_identities(self, identities: numpy.ndarray) -> None:
        """Set new episodes with these identities, ``(2, lanes)``, into the first lanes; the others are padding."""
        self.identities[:, : identities.shape[1]] = identities
        self.identities[:, identities.shape[1] :] = 0
        self.measurement[:] = -1
        self._ahead, self._row, self._due = None, None, False

    def start_call(self, memory: numpy.ndarray) -> Call:
        """Return the native call that writes the random numbers of the episodes' start, after :meth:`set_identities`.

        They are written to ``memory``, ``(initial_normals + uniforms, width)``.
        """
        return bind_numbers(self.identities, self.measurement, memory, self._layout.initial_normals)

    def start(self) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Return the uniform and normal numbers of the episodes' start, and advance to the first measurement.

        Returns:
            Arrays ``(uniforms, width)`` and ``(initial_normals, width)``, in new memory.
        """
        self._due = True
        if not AVAILABLE:
            self.measurement[:] = 0
            return start_numbers(self.identities, self._layout)
        normals = self._layout.initial_normals
        memory = empty_lanes((normals + self._layout.uniforms,), self.width)
        self.start_call(memory)(0, self.width)
        return memory[normals:], memory[:normals]

    def replace_episodes(self, other: "EpisodeNoise", lanes: numpy.ndarray) -> None:
        """Replace the episodes in some lanes by the first episodes of another :class:`EpisodeNoise`."""
        self.identities[:, lanes] = other.identities[:, : len(lanes)]
        self.measurement[lanes] = other.measurement[: len(lanes)]
        if self._ahead is not None:
            self._ahead[self._slot :, :, lanes] = self._numbers_ahead(lanes, len(self._ahead) - self._slot)

    # --- their numbers

    def advance(self) -> None:
        """Advance all lanes to the next measurement, so that :attr:`row` gives its random numbers."""
        if self._due:
            _ = self.row
        self._due, self._row = True, None

    @property
    def row(self) -> Array:
        """Random numbers of the current measurement, ``(row width, width)``, in memory that does not change."""
        if self._row is None:
            task, row = self.task, self._copied_from_code() if AVAILABLE else self._next_of_block()
            self._row = row if task.xp is numpy else task.xp.asarray(row, device=task.device)
        return self._row

    def next_measurement_call(self) -> Call:
        """Return the native call that advances to the next measurement and writes its numbers at :attr:`address`.

        It is for native code over several measurements, which runs it at least once.
        """
        if self._due:
            _ = self.row
        self._row = None
        return self._next or self._next_call()

    @property
    def address(self) -> int:
        """Address of the memory into which :meth:`next_measurement_call` writes."""
        return address_of(self._next_call().arrays[2])

    def _copied_from_code(self) -> numpy.ndarray:
        call = self._next_call()
        if self._due:
            call(0, self.width)
            self._due = False
        return call.arrays[2].copy()

    def _next_call(self) -> Call:
        if self._next is None:
            memory = empty_lanes((self._rows,), self.width)
            self._next = bind_numbers(self.identities, self.measurement, memory, self._layout.normals)
        return self._next

    def _next_of_block(self) -> numpy.ndarray:
        if self._ahead is None or self._slot == len(self._ahead):
            lanes = numpy.arange(self.width)
            self._ahead, self._slot = self._numbers_ahead(lanes, max(AHEAD // self.width, 1)), 0
        self._slot += 1
        self.measurement += 1
        self._due = False
        return self._ahead[self._slot - 1]

    def _numbers_ahead(self, lanes: numpy.ndarray, measurements: int) -> numpy.ndarray:
        """Return the random numbers of the next measurements, ``(measurements, rows, lanes)``."""
        t = self.measurement[lanes] + numpy.arange(1, measurements + 1)[:, None]
        return numbers(self.identities[:, lanes], t, self._layout.normals, self._layout.row_uniforms)

    # --- copies and growth

    def grow(self, count: int, index: numpy.ndarray) -> None:
        """Enlarge the memory of random numbers to ``count`` lanes.

        That is a multiple of eight; ``index`` is for each lane the one whose numbers it uses until it begins an
        episode.
        """
        identities, measurement = self.identities[:, index], self.measurement[index]
        self._set_width(count)
        self.identities[...], self.measurement[...] = identities, measurement

    def snapshot(self) -> dict[str, Any]:
        """Return a copy of the state that determines all further random numbers."""
        return copy.deepcopy({name: getattr(self, name) for name in _STATE_ATTRIBUTES})

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Restore the state of a :meth:`snapshot` of the same task with the same number of lanes."""
        self.__dict__.update(copy.deepcopy(snapshot))
        self._forget()

    def __getstate__(self) -> dict[str, Any]:
        return {"task": self.task, "_layout": self._layout, "_rows": self._rows, **self.snapshot()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()


_STATE_ATTRIBUTES = ("width", "identities", "measurement", "generators")
"""Attributes that determine the numbers."""
