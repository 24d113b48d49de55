"""The engine: episodes of a task side by side, each fixed by its own generator.

A *lane* is one episode after another, fed by one generator. Both Gymnasium faces and the evaluation drive
this class; it owns generators and noise and knows nothing of spaces or autoreset.

**What an episode is.** When an episode starts, its lane's generator gives, in this order, the uniform numbers
of the scenario, the normal numbers of the track's start, and the rows of noise, one for each measurement.
Nothing of this depends on actions or on the control: policies of different controls that start from the
same seed face the same noise. An episode of more than ``LONGEST_BLOCK`` measurements gets its rows in
blocks from a child generator, seeded by integers drawn from the lane's.

**Bit equality.** The batch is padded to a multiple of eight lanes, also for one episode: BLAS chooses its
kernels by the width, and widths that are multiples of eight agree. So lane i of N equals the single
environment with the same seed bit for bit.

**The noise ring.** All lanes share one clock. A lane that restarts writes its rows into the ring from the
current slot on, so that every step reads one contiguous slice, whatever the lanes' own times are.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy

from .observation import Array
from .task import Episode, Task

LANE_MULTIPLE = 8
LONGEST_BLOCK = 256
"""Measurements of noise that an episode draws at once."""
BLOCK = 64
"""Rows of a block where an episode is longer than that: 64 rows keep 4096 lanes in cache-friendly memory."""


def padded_width(count: int) -> int:
    """Lanes that so many episodes take: the next multiple of ``LANE_MULTIPLE``."""
    return -(-count // LANE_MULTIPLE) * LANE_MULTIPLE


def _replace_lanes(old: Any, new: Any, lanes: Any) -> Any:
    """Return ``old`` with its last-axis entries ``lanes`` taken from ``new``, for nested tuples of arrays."""
    if old is None:
        return None
    if isinstance(old, tuple):
        parts = [_replace_lanes(a, b, lanes) for a, b in zip(old, new, strict=True)]
        return type(old)(*parts) if hasattr(old, "_fields") else tuple(parts)
    # A copy, because states are never changed in place: someone may still hold the old one. In the type of
    # the new one: float32 actions leave float32 in a state, and a fresh lane must not be rounded to it.
    merged = old.astype(new.dtype) if isinstance(old, numpy.ndarray) else old.to(new.dtype, copy=True)
    merged[..., lanes] = new[..., : len(lanes)]
    return merged


def mapped(function: Callable[[Array], Array], part: Any) -> Any:
    """Return nested tuples of arrays with a function applied to every array."""
    if part is None:
        return None
    if isinstance(part, tuple):
        parts = [mapped(function, item) for item in part]
        return type(part)(*parts) if hasattr(part, "_fields") else tuple(parts)
    return function(part)


_REPLACED = ("state", "paper_state", "_interval_mean", "_clock")
"""Attributes of lanes that a step replaces."""
_REWRITTEN = ("generators", "decisions", "_ring", "_started", "_children")
"""Attributes that it changes in place."""


class Lanes:
    """``count`` episodes of a task side by side.

    Args:
        task: the estimation problem; its namespace decides where arrays live.
        count: number of lanes.
        paper: the same task under the control of the paper's algorithm, run beside it on the same noise.
        begun: told of new episodes at the start of the track, before their first measurement.

    Attributes:
        state: the episodes after the last measurement, lanes padded to a multiple of eight.
        paper_state: the same of ``paper``.
        decisions: actions taken in each lane's current episode, ``(count,)``.
    """

    def __init__(
        self,
        task: Task,
        count: int,
        paper: Task | None = None,
        begun: Callable[[Episode], None] | None = None,
    ) -> None:
        self.task = task
        self.count = count
        self.width = padded_width(count)
        self.paper = paper
        self._begun = begun
        self.paper_state: Any = None
        if paper is not None:
            self._paper_action = self._constant_action(paper)
        self.state: Any = None
        self.generators: list[numpy.random.Generator] = []
        self.decisions = numpy.zeros(count, dtype=numpy.int64)
        self.decisions_per_episode = task.horizon // task.decision_interval
        rows = task.horizon + 1
        self._row_width = task.noise.normals + task.noise.row_uniforms
        self._in_blocks = rows > LONGEST_BLOCK
        self._slots = BLOCK if self._in_blocks else rows
        self._ring: Array = None
        self._clock = 0
        self._started = numpy.zeros(count, dtype=numpy.int64)
        self._children: list[numpy.random.Generator | None] = [None] * count
        self._mean_fields = [i for i, f in enumerate(task.fields) if f.over_interval == "mean"]
        self._interval_mean: Array = None

    def _constant_action(self, paper: Task) -> Array:
        action = paper.constant(paper.paper_policy.action)[:, None]
        return action + paper.xp.zeros((1, self.width), dtype=paper.xp.float64, device=paper.device)

    # --- noise

    def _rows(self, lanes: Sequence[int], generators: Sequence[Any]) -> numpy.ndarray:
        """Draw ``_slots`` rows for each lane: ``(slots, row width, lanes)``."""
        noise = self.task.noise
        drawn = numpy.empty((len(lanes), self._slots, self._row_width))
        if noise.row_uniforms == 0:
            flat = drawn.reshape(len(lanes), -1)
            for i, generator in enumerate(generators):
                generator.standard_normal(out=flat[i])
        else:
            for i, generator in enumerate(generators):
                drawn[i, :, : noise.normals] = generator.standard_normal((self._slots, noise.normals))
                drawn[i, :, noise.normals :] = generator.random((self._slots, noise.row_uniforms))
        return numpy.moveaxis(drawn, 0, -1)

    def _draw_episode(self, lanes: Sequence[int]) -> tuple[numpy.ndarray, numpy.ndarray, numpy.ndarray]:
        """Uniforms, initial normals and first rows of new episodes, lanes last."""
        noise = self.task.noise
        uniforms = numpy.empty((len(lanes), noise.uniforms))
        normals = numpy.empty((len(lanes), noise.initial_normals))
        generators = [self.generators[lane] for lane in lanes]
        for i, generator in enumerate(generators):
            if noise.uniforms:
                generator.random(out=uniforms[i])
            if noise.initial_normals:
                generator.standard_normal(out=normals[i])
        if self._in_blocks:
            generators = [numpy.random.default_rng(g.integers(0, 2**63, size=2)) for g in generators]
            for lane, child in zip(lanes, generators, strict=True):
                self._children[lane] = child
        return uniforms.T, normals.T, self._rows(lanes, generators)

    def _store(self, rows: numpy.ndarray, lanes: Sequence[int]) -> None:
        """Write rows into the ring from the current slot on."""
        task = self.task
        first = self._clock % self._slots
        ahead = self._slots - first
        rows = task.xp.asarray(numpy.ascontiguousarray(rows), device=task.device)
        if self._ring is None:
            self._ring = task.xp.zeros(
                (self._slots, self._row_width, self.width), dtype=task.xp.float64, device=task.device
            )
        if len(lanes) == self.count:
            self._ring[first:, :, : self.count] = rows[:ahead]
            self._ring[:first, :, : self.count] = rows[ahead:]
        else:
            lanes = task.xp.asarray(lanes, device=task.device)
            self._ring[first:, :, lanes] = rows[:ahead]
            self._ring[:first, :, lanes] = rows[ahead:]

    def _padded(self, values: numpy.ndarray, fill: float) -> Array:
        """Widen ``(rows, lanes)`` to a multiple of eight lanes."""
        width = padded_width(values.shape[1])
        padded = numpy.full((values.shape[0], width), fill)
        padded[:, : values.shape[1]] = values
        return self.task.xp.asarray(padded, device=self.task.device)

    # --- episodes

    def seed(self, lane: int, generator: numpy.random.Generator) -> None:
        """Give a lane the generator that its coming episodes are drawn from."""
        while len(self.generators) <= lane:
            self.generators.append(generator)
        self.generators[lane] = generator

    def restart(self, lanes: Sequence[int] | None = None) -> None:
        """Start new episodes in some lanes (default: all) and let their first measurement arrive."""
        everyone = lanes is None or len(lanes) == self.count
        chosen: Sequence[int] = range(self.count) if lanes is None or everyone else lanes
        uniforms, normals, rows = self._draw_episode(chosen)
        self._store(rows, chosen)
        # The padding lanes fly an average episode without noise.
        scenario, start = self._padded(uniforms, 0.5), self._padded(normals, 0.0)
        first_row = self._padded(rows[0], 0.0)
        episode = self.task.begin(scenario, start)
        if self._begun is not None:
            self._begun(episode)
        state = self.task.measure(episode, first_row)
        paper_state = self.paper and self.paper.measure(self.paper.begin(scenario, start), first_row)
        if everyone:
            self.state, self.paper_state = state, paper_state
            self._interval_mean = None
        else:
            lane_index = self.task.xp.asarray(list(chosen), device=self.task.device)
            self.state = _replace_lanes(self.state, state, lane_index)
            if self.paper is not None:
                self.paper_state = _replace_lanes(self.paper_state, paper_state, lane_index)
            if self._interval_mean is not None:
                first_seen = self.task.observe(state)
                self._interval_mean = _replace_lanes(self._interval_mean, first_seen, lane_index)
        index = numpy.asarray(chosen)
        self._started[index] = self._clock
        self.decisions[index] = 0

    def step(self, update: Callable[[Any], Any], record: Callable[[Any, Any], None] | None = None) -> None:
        """Apply one decision to as many measurements as it holds for.

        Args:
            update: turns the state after a measurement into the state after the action (step 4 of the
                clock): ``task.act`` with the action, or a reference estimator.
            record: called with every state after the action, before the next measurement, and with the
                paper's state at that moment (None without ``paper``).
        """
        task = self.task
        shown = None
        for _ in range(task.decision_interval):
            posterior = update(self.state)
            paper_posterior = self.paper and self.paper.act(self.paper_state, self._paper_action)
            if record is not None:
                record(posterior, paper_posterior)
            self._advance(posterior, paper_posterior)
            if self._mean_fields and task.decision_interval > 1:
                seen = task.observe(self.state)
                shown = seen if shown is None else shown + seen
        if shown is not None:
            self._interval_mean = shown / task.decision_interval
        self.decisions += 1

    def _advance(self, posterior: Any, paper_posterior: Any) -> None:
        self._clock += 1
        if self._in_blocks:
            due = numpy.flatnonzero((self._clock - self._started) % self._slots == 0).tolist()
            if due:
                self._store(self._rows(due, [self._children[lane] for lane in due]), due)
        row = self._ring[self._clock % self._slots]
        if not isinstance(row, numpy.ndarray):
            # Autograd may keep it until the backward pass, when the ring has long been written over.
            row = row.clone()
        self.state = self.task.measure(posterior, row)
        if self.paper is not None:
            self.paper_state = self.paper.measure(paper_posterior, row)

    # --- for whoever steps them in an unusual way

    def detach(self) -> None:
        """Cut the gradient: what follows no longer remembers how it came about (torch only)."""
        self.state, self.paper_state, self._interval_mean = (
            mapped(lambda tensor: tensor.detach(), part)
            for part in (self.state, self.paper_state, self._interval_mean)
        )

    def snapshot(self) -> dict[str, Any]:
        """Return all that the coming steps depend on; :meth:`restore` goes back to it, as often as one likes."""
        kept = copy.deepcopy({name: getattr(self, name) for name in _REWRITTEN})
        return {"count": self.count, **kept, **{name: getattr(self, name) for name in _REPLACED}}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot of lanes of the same task.

        Raises:
            ValueError: if their number differs.
        """
        if snapshot["count"] != self.count:
            raise ValueError(f"the snapshot holds {snapshot['count']} environments, not {self.count}")
        for name in _REWRITTEN:
            setattr(self, name, copy.deepcopy(snapshot[name]))
        for name in _REPLACED:
            setattr(self, name, snapshot[name])

    @property
    def finished(self) -> numpy.ndarray:
        """Lanes whose episode is over, ``(count,)`` booleans."""
        return self.decisions >= self.decisions_per_episode

    def observe(self) -> Array:
        """Observation of every lane, batch first: ``(count, len(task.fields))``."""
        task = self.task
        shown = task.observe(self.state)
        if self._interval_mean is not None:
            fresh = task.constant([[1.0 if i in self._mean_fields else 0.0] for i in range(len(task.fields))])
            shown = task.xp.where(fresh > 0.0, self._interval_mean, shown)
        shown = shown[:, : self.count].T
        # Contiguous, and nobody else's memory: the caller may keep it.
        return shown.copy() if isinstance(shown, numpy.ndarray) else shown.contiguous()

    def widened(self, action: Array) -> Array:
        """Turn a batch-first action into the task's form: batch last, padded."""
        xp = self.task.xp
        turned = action.T if action.ndim == 2 else action
        if self.width == self.count:
            return turned
        padding = xp.zeros(
            (*turned.shape[:-1], self.width - self.count), dtype=turned.dtype, device=self.task.device
        )
        return xp.concat([turned, padding], axis=-1)
