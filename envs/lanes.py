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

**Two ways to step.** :meth:`Lanes.step` shows every state on the way to whoever asks, in arrays that never change.
:meth:`Lanes.pay` only wants rewards and observations; a compiled task then moves its episodes in memory of its own
(:class:`~.compiled.Stepper`), and :attr:`Lanes.state` is a copy of it.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy

from ..compiler.functions import address_of, mapped, padded_width
from ..filters.ordered_sums import ordered_sum
from .compiled import MANY, Report, Stepper, can_step
from .observation import Array
from .reward import OWN_PAY
from .task import Episode, Task

LONGEST_BLOCK = 256
"""Measurements of noise that an episode draws at once."""
BLOCK = 64
"""Rows of a block where an episode is longer than that: 64 rows keep 4096 lanes in cache-friendly memory."""
DRAWN = 64
"""Lanes whose noise is drawn before it is put into the ring: it is still in the cache then."""


def _replace_lanes(old: Any, new: Any, lanes: Any) -> Any:
    """Return ``old`` with its last-axis entries ``lanes`` taken from ``new``, for nested tuples of arrays."""
    if old is None:
        return None
    if isinstance(old, tuple):
        parts = [_replace_lanes(a, b, lanes) for a, b in zip(old, new, strict=True)]
        return type(old)(*parts) if hasattr(old, "_fields") else tuple(parts)
    # A copy, because states are never changed in place: someone may still hold the old one.
    merged = old.astype(new.dtype) if isinstance(old, numpy.ndarray) else old.to(new.dtype, copy=True)
    merged[..., lanes] = new[..., : len(lanes)]
    return merged


def mean_of(rewards: Sequence[Array]) -> Array:
    """Mean over the measurements of one decision."""
    return ordered_sum(rewards) / len(rewards) if len(rewards) > 1 else rewards[0]


_REPLACED = ("state", "paper_state", "_interval_mean", "_clock")
"""Attributes of lanes that a step replaces."""
_REWRITTEN = ("generators", "decisions", "_lengths", "_ring", "_started", "_children")
"""Attributes that it changes in place."""


class Lanes:
    """``count`` episodes of a task side by side.

    Args:
        task: the estimation problem; its namespace decides where arrays live.
        count: number of lanes.
        paper: the same task under the control of the paper's algorithm, run beside it on the same noise.
        begun: told of new episodes at the start of the track, before their first measurement.
        longest: decisions after which an episode ends at the latest; default: the task's horizon.

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
        longest: int | None = None,
    ) -> None:
        self.task = task
        self.count = count
        self.width = padded_width(count)
        self.paper = paper
        self._begun = begun
        if paper is not None:
            self._paper_action = self._constant_action(paper)
        self._episodes: list[Any] = [None, None]
        """The task's episodes and the paper's; None where they are in a stepper's memory."""
        self._steppers: dict[Report, list[Stepper]] = {}
        self._moving: list[Stepper] = []
        """Those whose memory holds the episodes."""
        self._shown: Any = None
        """What they show, ``(width, fields)``."""
        self._shown_to = False
        """Whether somebody else has that array."""
        self.generators: list[numpy.random.Generator] = []
        self.decisions = numpy.zeros(count, dtype=numpy.int64)
        horizon = task.horizon // task.decision_interval
        self.decisions_per_episode = horizon if longest is None else min(horizon, longest)
        self._lengths = numpy.full(count, self.decisions_per_episode)
        """Decisions of each lane's episode."""
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

    def _draw_rows(self, lanes: Sequence[int], generators: Sequence[Any], before: numpy.ndarray) -> None:
        """Draw ``_slots`` rows for each lane and write them into the ring from the current slot on.

        Args:
            lanes: ascending.
            generators: theirs.
            before: filled with normal numbers that are drawn before the rows, ``(lanes, any number)``.
        """
        task, noise = self.task, self.task.noise
        first = self._clock % self._slots
        ahead = self._slots - first
        on_host = task.xp is numpy
        if self._ring is None:
            shape = (self._slots, self._row_width)
            self._ring = task.xp.zeros((*shape, self.width), dtype=task.xp.float64, device=task.device)
        # In portions: what was drawn is turned into the ring while it is in the cache. A device gets all at once.
        portion = DRAWN if on_host else len(lanes)
        ahead_of_rows = before.shape[1]
        drawn = numpy.empty((min(portion, len(lanes)), ahead_of_rows + self._slots * self._row_width))
        rows = drawn[:, ahead_of_rows:].reshape(len(drawn), self._slots, self._row_width)
        for start in range(0, len(lanes), portion):
            chosen = lanes[start : start + portion]
            for i, (generator, numbers) in enumerate(
                zip(generators[start : start + portion], drawn, strict=False)
            ):
                if noise.row_uniforms == 0:
                    generator.standard_normal(out=numbers)
                else:
                    generator.standard_normal(out=numbers[:ahead_of_rows])
                    rows[i, :, : noise.normals] = generator.standard_normal((self._slots, noise.normals))
                    rows[i, :, noise.normals :] = generator.random((self._slots, noise.row_uniforms))
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

    def _draw_episode(self, lanes: Sequence[int]) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Draw new episodes: return uniforms and initial normals, lanes last; the rows go into the ring."""
        noise = self.task.noise
        uniforms = numpy.empty((len(lanes), noise.uniforms))
        normals = numpy.empty((len(lanes), noise.initial_normals))
        generators = [self.generators[lane] for lane in lanes]
        if noise.uniforms:
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
        task, xp = self.task, self.task.xp
        everyone = lanes is None or len(lanes) == self.count
        chosen: Sequence[int] = range(self.count) if lanes is None or everyone else list(lanes)
        uniforms, normals = self._draw_episode(chosen)
        index = numpy.asarray(chosen)
        self._started[index] = self._clock
        self.decisions[index] = 0
        if task.flights:
            lengths = task.lengths(uniforms) // task.decision_interval
            self._lengths[index] = numpy.minimum(lengths, self.decisions_per_episode)
        # The padding lanes fly an average episode without noise.
        scenario, start = self._padded(uniforms, 0.5), self._padded(normals, 0.0)
        if everyone and self._moving and self._begun is None:
            if self._shown_to:
                self._show(numpy.empty_like(self._shown))
            for stepper in self._moving:
                stepper.begin(scenario, start, self._row_address())
            return
        row = self._ring[self._clock % self._slots]
        first_row = row[:, index if xp is numpy else xp.asarray(chosen, device=task.device)]
        width = padded_width(len(chosen))
        if width != len(chosen):
            padding = xp.zeros((row.shape[0], width - len(chosen)), dtype=row.dtype, device=task.device)
            first_row = xp.concat([first_row, padding], axis=1)
        episode = task.begin(scenario, start)
        if self._begun is not None:
            self._begun(episode)
        fresh: list[Any] = [task.measure(episode, first_row)]
        if self.paper is not None:
            fresh.append(self.paper.measure(self.paper.begin(scenario, start), first_row))
        if everyone:
            self._episodes[: len(fresh)] = fresh
            self._moving, self._interval_mean, self._shown = [], None, None
        elif self._moving:
            if self._shown_to:
                self._show(self._shown.copy())
            for stepper, new in zip(self._moving, fresh, strict=True):
                stepper.replace(new, index)
            self._shown[index] = task.observe(fresh[0])[:, : len(index)].T
        else:
            lane_index = xp.asarray(chosen, device=task.device)
            for i, new in enumerate(fresh):
                self._episodes[i] = _replace_lanes(self._episodes[i], new, lane_index)
            if self._interval_mean is not None:
                self._interval_mean = _replace_lanes(self._interval_mean, task.observe(fresh[0]), lane_index)

    def step(self, update: Callable[[Any], Any], record: Callable[[Any, Any], None] | None = None) -> None:
        """Apply one decision to as many measurements as it holds for.

        Args:
            update: turns the state after a measurement into the state after the action (step 4 of the
                clock): ``task.act`` with the action, or a reference estimator.
            record: called with every state after the action, before the next measurement, and with the
                paper's state at that moment (None without ``paper``).
        """
        task = self.task
        self._settle()
        shown = None
        for _ in range(task.decision_interval):
            posterior = update(self.state)
            paper_posterior: Any = self.paper and self.paper.act(self.paper_state, self._paper_action)
            if record is not None:
                record(posterior, paper_posterior)
            row = self.next_row()
            if not isinstance(row, numpy.ndarray):
                # Autograd may keep it until the backward pass, when the ring has long been written over.
                row = row.clone()
            self.state = task.measure(posterior, row)
            if self.paper is not None:
                self.paper_state = self.paper.measure(paper_posterior, row)
            if self._mean_fields and task.decision_interval > 1:
                seen = task.observe(self.state)
                shown = seen if shown is None else shown + seen
        if shown is not None:
            self._interval_mean = shown / task.decision_interval
        self.decisions += 1

    def next_row(self) -> Array:
        """Noise of the next measurement, ``(row width, width)``."""
        self._clock += 1
        if self._in_blocks:
            due = numpy.flatnonzero((self._clock - self._started) % self._slots == 0).tolist()
            if due:
                self._draw_rows(due, [self._children[lane] for lane in due], numpy.empty((len(due), 0)))
        return self._ring[self._clock % self._slots]

    def _row_address(self) -> int:
        return self._ring_start + self._clock % self._slots * self._ring_stride

    def pay(self, action: Array, kind: str) -> Array:
        """Apply one decision and return what is paid for it, the mean over its measurements, ``(count,)``.

        Args:
            action: batch first, as the action space has it.
            kind: one of :data:`~.reward.REWARDS`.
        """
        answers = self.decide(action, OWN_PAY[kind])
        return mean_of([own if paper is None else own - paper for own, paper in answers])[: self.count]

    def decide(self, action: Array, report: Report) -> list[tuple[Any, Any]]:
        """Apply one decision and report on it.

        Args:
            action: batch first, as the action space has it.
            report: function of a task and its episodes after the action; not made anew for each call.

        Returns:
            The reports on every measurement that the decision held for, arrays ``(..., width)``: of the task, and of
            ``paper`` (None without).
        """
        answers: list[tuple[Any, Any]] = []
        if self._moving is not self._steppers.get(report) and not self._move(report):
            widened = self.widened(action)

            def record(state: Any, paper_state: Any) -> None:
                own = self.task.run(report, state)
                answers.append((own, self.paper and self.paper.run(report, paper_state)))

            self.step(lambda state: self.task.act(state, widened), record)
            return answers
        own, *paper = self._moving
        own.action[..., : self.count] = action.T if action.ndim == 2 else action
        if self._shown_to:
            self._show(numpy.empty_like(self._shown))
        interval = self.task.decision_interval
        mean = self._mean_fields if interval > 1 else []
        total: Any = 0.0
        for _ in range(interval):
            self.next_row()
            row = self._row_address()
            for stepper in self._moving:
                stepper.step(row)
            answers.append((own.report(), paper[0].report() if paper else None))
            if mean:
                total = total + self._shown[:, mean]
        if mean:
            self._shown[:, mean] = total / interval
        self.decisions += 1
        return answers

    def _move(self, report: Report) -> bool:
        """Put the episodes into the memory of the steppers that make a report; False where there can be none."""
        if report not in self._steppers:
            tasks = [self.task] if self.paper is None else [self.task, self.paper]
            if not all(can_step(task, report) for task in tasks):
                return False
            self._steppers[report] = [Stepper(task, report, self.width) for task in tasks]
            for stepper in self._steppers[report][1:]:
                stepper.action[...] = self._paper_action
        steppers, shown = self._steppers[report], self._observed()
        self._settle()
        for stepper, episode in zip(steppers, self._episodes, strict=False):
            stepper.load(episode)
        self._moving, self._episodes = steppers, [None, None]
        self._shown, self._shown_to = steppers[0].shown, False
        self._shown[...] = shown.T
        self._ring_start, self._ring_stride = address_of(self._ring), self._ring.strides[0]
        return True

    def _show(self, memory: numpy.ndarray) -> None:
        """Let observations be written into other memory from now on."""
        self._shown, self._shown_to = memory, False
        self._moving[0].show_in(memory)

    def _settle(self) -> None:
        """Take the episodes out of a stepper's memory; what is shown is then observed from them."""
        if self._moving:
            shown = self._shown.T.copy()
            self._episodes[: len(self._moving)] = [stepper.episode() for stepper in self._moving]
            self._moving, self._shown = [], None
            interval = self._mean_fields and self.task.decision_interval > 1
            self._interval_mean = shown if interval else None

    @property
    def begun(self) -> bool:
        """Whether there are episodes."""
        return bool(self._moving) or self._episodes[0] is not None

    def _state_of(self, which: int) -> Any:
        return self._moving[which].episode() if which < len(self._moving) else self._episodes[which]

    @property
    def state(self) -> Any:
        """The episodes after the last measurement, lanes padded to a multiple of eight."""
        return self._state_of(0)

    @state.setter
    def state(self, state: Any) -> None:
        self._settle()
        self._episodes[0] = state

    @property
    def paper_state(self) -> Any:
        """The same of ``paper``."""
        return self._state_of(1)

    @paper_state.setter
    def paper_state(self, state: Any) -> None:
        self._settle()
        self._episodes[1] = state

    def __getstate__(self) -> dict[str, Any]:
        """All but what is bound to memory: a copy makes its own."""
        self._settle()
        return {**self.__dict__, "_steppers": {}}

    def grow(self, count: int) -> None:
        """Make room for more lanes; the new ones fly some episode until they are restarted.

        Args:
            count: a multiple of eight.
        """
        self._settle()
        beyond = numpy.zeros(count - self.width, dtype=numpy.int64)
        index = self.task.xp.asarray(numpy.append(numpy.arange(self.width), beyond), device=self.task.device)
        states, self._interval_mean, self._ring = mapped(
            lambda values: self.task.xp.take(values, index, axis=-1),
            (tuple(self._episodes), self._interval_mean, self._ring),
        )
        self._episodes = list(states)
        added = count - self.count
        self.decisions = numpy.append(self.decisions, numpy.zeros(added, dtype=numpy.int64))
        self._lengths = numpy.append(self._lengths, numpy.full(added, self.decisions_per_episode))
        self._started = numpy.append(self._started, numpy.repeat(self._started[:1], added))
        # None that belongs to another lane: long episodes draw from theirs as they go.
        self.generators += [numpy.random.default_rng(0) for _ in range(added)]
        self._children += [child and numpy.random.default_rng(0) for child in self._children[:1] * added]
        self.count = self.width = count
        self._steppers = {}
        if self.paper is not None:
            self._paper_action = self._constant_action(self.paper)

    # --- for whoever steps them in an unusual way

    def detach(self) -> None:
        """Cut the gradient: what follows no longer remembers how it came about (torch only)."""
        self.state, self.paper_state, self._interval_mean = (
            mapped(lambda tensor: tensor.detach(), part)
            for part in (self.state, self.paper_state, self._interval_mean)
        )

    def snapshot(self) -> dict[str, Any]:
        """Return all that the coming steps depend on; :meth:`restore` goes back to it, as often as one likes."""
        self._settle()
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

    def shorten(self, lanes: Sequence[int], decisions: numpy.ndarray) -> None:
        """Let the episodes that have just begun in some lanes end so many decisions early, but take one at least."""
        self.decisions[list(lanes)] = numpy.minimum(decisions, self._lengths[list(lanes)] - 1)

    @property
    def finished(self) -> numpy.ndarray:
        """Lanes whose episode is over, ``(count,)`` booleans."""
        return self.decisions >= self._lengths

    def observe(self) -> Array:
        """Observation of every lane, batch first: ``(count, len(task.fields))``; the caller may keep it."""
        if self._moving:
            if self.count < MANY:
                return self._shown[: self.count].copy()
            self._shown_to = True
            return self._shown[: self.count]
        shown = self._observed()[:, : self.count].T
        # Contiguous, and nobody else's memory.
        return shown.copy() if isinstance(shown, numpy.ndarray) else shown.contiguous()

    def _observed(self) -> Array:
        """What is shown, ``(fields, width)``."""
        if self._moving:
            return self._shown.T
        task = self.task
        shown = task.observe(self.state)
        if self._interval_mean is not None:
            fresh = task.constant([[1.0 if i in self._mean_fields else 0.0] for i in range(len(task.fields))])
            shown = task.xp.where(fresh > 0.0, self._interval_mean, shown)
        return shown

    def widened(self, action: Array) -> Array:
        """Turn a batch-first action into the task's form: batch last, padded."""
        xp = self.task.xp
        turned = action.T if action.ndim == 2 else action
        if not isinstance(self.task.action_space, gymnasium.spaces.Discrete):
            turned = xp.astype(turned, xp.float64, copy=False)
        if self.width == self.count:
            return turned
        padding = xp.zeros(
            (*turned.shape[:-1], self.width - self.count), dtype=turned.dtype, device=self.task.device
        )
        return xp.concat([turned, padding], axis=-1)
