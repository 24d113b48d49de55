"""Conversion of a straight-line program to loops over the members of its array operations.

A trace consists of scalars, each with the number of the array operation that made it
(:attr:`.StraightLineProgram.origins`). Members of one operation are independent: they become one :class:`Statement`.
Statements with equal numbers of members share a loop, where a member may use results of the same turn; all other
values pass through a scratch array. Results have the same bits as those of the straight line.
"""

import heapq
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy

from .interpretation import first_steps
from .parts import FREE
from .program import StraightLineProgram, without_collection

LEAST = 3
"""Minimal number of members of a statement; members of smaller operations are separate statements."""
MOST = 100
"""Maximal number of statements of a loop."""
SHORTER = 1.5
"""Length of the code of a statement in a loop with its tables, in statements of a straight line."""
SCRATCH, CONSTANTS, TURN, COMPUTED = -1, -2, -3, -4
"""Codes in place of the number of an argument: the scratch array, the constants, the result of a statement in the same
turn of the same loop, and any computed value.
"""


class Operand(NamedTuple):
    """Array elements that the members of a statement read or write, one for each turn of the loop."""

    array: int
    """Number of an argument, or one of ``SCRATCH``, ``CONSTANTS``, ``TURN``."""
    places: tuple[int, ...]
    """For every member a row of the argument, or an index in the scratch array or in the constants; for ``TURN`` only
    the number of the statement."""
    logical: bool = False
    """Whether it is a boolean, stored as one or zero."""


class Statement(NamedTuple):
    """One operation for all members of a loop."""

    number: int
    operation: str
    """Operation of a step, or ``copy``."""
    operands: tuple[Operand, ...]
    logical: bool
    table: tuple[int, int]
    """For ``take``: the index of its table in the constants, and its length."""
    kept: tuple[Operand, ...]
    """Locations where its members are stored for later loops and results."""
    origin: int
    """Number of its array operation; a negative one for a copy."""


class Loop(NamedTuple):
    """Statements of one loop, and its number of turns."""

    turns: int
    body: list[Statement]


class Rolled(NamedTuple):
    """A program as loops, with their number before a pause and the length of the scratch array."""

    loops: list[Loop]
    before: int
    """Number of loops before the pause."""
    scratch: int
    """Length of the scratch array."""


class _Read(NamedTuple):
    source: int | None
    """Number of the argument, or ``CONSTANTS``; None: the scratch array, or the same turn."""
    turn: int | None
    """Number of the statement whose members it equals, one by one; None: there is none."""
    statements: set[int]
    """Numbers of the statements whose members it contains."""


class _Draft:
    def __init__(
        self,
        operation: str,
        members: numpy.ndarray,
        columns: Sequence[numpy.ndarray],
        late: bool,
        logical: bool,
    ) -> None:
        self.operation, self.members, self.columns = operation, members, columns
        self.late, self.logical = late, logical
        self.count = len(columns[0])
        self.table: tuple[int, int] = (0, 0)
        self.group = 0
        self.loop = -1
        self.results: list[Operand] = []
        self.reads: list[_Read] = []


class _Roller:
    def __init__(self, program: StraightLineProgram, results: int) -> None:
        self.program, self.steps = program, program.steps
        self.pause = first_steps(program, results)
        self.drafts: list[_Draft] = []
        self.group, self.order = program.origins.T
        self.logical = self.steps.logical
        # Source of a free step's number, and its place there; parts of other steps, -1 where there are fewer.
        self.source, self.place = numpy.full((2, len(self.steps)), COMPUTED)
        self.parts = numpy.full((len(self.steps), 3), -1)
        self._read_steps()
        # Statement of a step, and its index among the members.
        self.statement, self.member = numpy.full((2, len(self.steps)), -1)
        self._compute(list(self._group_steps()))
        early = program.results[:results]
        for late, some in ((False, early), (True, program.results[results:])):
            rows: dict[int, dict[int, int]] = {}
            for result in some:
                rows.setdefault(result.argument, {})[result.row] = result.node
            for argument, nodes in rows.items():
                self._write(argument, nodes, late)
        self._copy_mixed_operands()
        reads = self._find_sources()
        for draft in self.drafts:
            draft.reads = [next(reads) for _ in draft.columns]

    def _read_steps(self) -> None:
        steps = self.steps
        self.tables = numpy.zeros(len(steps), dtype=numpy.int64)
        for kind, name in enumerate(steps.names):
            there = numpy.flatnonzero(steps.kinds == kind)
            first = steps.begins[there]
            if name == "constant":
                self.source[there], self.place[there] = CONSTANTS, steps.arguments[first]
            elif name == "input":
                self.source[there], self.place[there] = steps.arguments[first], steps.arguments[first + 1]
            elif name == "take":
                self.tables[there], self.parts[there, 0] = steps.arguments[first], steps.arguments[first + 2]
            else:
                for i in range(int((steps.begins[there + 1] - first).max(initial=0))):
                    self.parts[there, i] = steps.arguments[first + i]

    def _add(self, draft: _Draft) -> None:
        if len(draft.members):
            self.statement[draft.members] = len(self.drafts)
            self.member[draft.members] = numpy.arange(draft.count)
        self.drafts.append(draft)

    # --- statements

    def _group_steps(self) -> Iterator[numpy.ndarray]:
        parts = self.parts
        computed = numpy.flatnonzero(self.source == COMPUTED)
        if not len(computed):
            return
        extreme = self.steps.which("maximum", "minimum")[computed]
        own = parts[computed]
        known = (self.source[own] == CONSTANTS) & extreme[:, None] & (own >= 0)
        flags = numpy.column_stack([known, self.logical[own] & (own >= 0), self.logical[computed]])
        form = flags @ (1 << numpy.arange(flags.shape[1]))
        keys = numpy.stack(
            [
                self.steps.kinds[computed],
                self.tables[computed],
                form,
                self._levels()[computed],
                self.group[computed],
                computed >= self.pause,
            ]
        )
        order = numpy.lexsort([self.order[computed], *keys])
        sorted_keys = keys[:, order]
        cuts = numpy.flatnonzero((sorted_keys[:, 1:] != sorted_keys[:, :-1]).any(axis=0)) + 1
        steps = computed[order]
        for start, end in pairwise([0, *cuts.tolist(), len(steps)]):
            if end - start < LEAST:
                yield from (steps[place : place + 1] for place in range(start, end))
            else:
                yield steps[start:end]

    def _levels(self) -> numpy.ndarray:
        inside = (self.parts >= 0) & (self.group[self.parts] == self.group[:, None])
        inside &= self.source[self.parts] == COMPUTED
        levels = numpy.zeros(len(self.steps), dtype=numpy.int64)
        for index in numpy.flatnonzero(inside.any(axis=1)).tolist():
            levels[index] = levels[self.parts[index][inside[index]]].max() + 1
        return levels

    def _compute(self, groups: Sequence[numpy.ndarray]) -> None:
        heads = numpy.array([members[0] for members in groups], dtype=numpy.int64)
        kinds, logical, number = (
            column[heads].tolist() for column in (self.steps.kinds, self.logical, self.group)
        )
        operands = (self.parts[heads] >= 0).sum(axis=1).tolist()
        for i, members in enumerate(groups):
            name = self.steps.names[int(kinds[i])]
            columns = [self.parts[members, k] for k in range(operands[i])]
            draft = _Draft(name, members, columns, bool(heads[i] >= self.pause), logical[i])
            if name == "take":
                start, length, _ = self.steps[int(heads[i])].arguments
                draft.table = start, length
            draft.group = number[i]
            self._add(draft)

    def _write(self, argument: int, nodes: dict[int, int], late: bool) -> None:
        by_draft: dict[int, list[tuple[int, int]]] = {}
        rest = []
        for row, step in sorted(nodes.items()):
            if self.statement[step] >= 0:
                by_draft.setdefault(int(self.statement[step]), []).append((int(self.member[step]), row))
            else:
                rest.append(row)
        for number, pairs in by_draft.items():
            if [k for k, _ in sorted(pairs)] == list(range(self.drafts[number].count)):
                self._copy_out(argument, [row for _, row in sorted(pairs)], nodes, late)
            else:
                rest += [row for _, row in pairs]
        rest.sort()
        for rows in [rest] if len(rest) >= LEAST else [[row] for row in rest]:
            self._copy_out(argument, rows, nodes, late)

    def _copy_out(self, argument: int, rows: list[int], nodes: dict[int, int], late: bool) -> None:
        column = numpy.array([nodes[row] for row in rows])
        draft = _Draft("copy", column[:0], [column], late, bool(self.logical[column].all()))
        draft.results.append(Operand(argument, tuple(rows), draft.logical))
        self._add(draft)

    def _sources(self, columns: Sequence[numpy.ndarray]) -> list[int | None]:
        steps, starts, lengths = _join_columns(columns)
        sources = self.source[steps]
        own = sources[starts]
        alike = numpy.logical_and.reduceat(sources == numpy.repeat(own, lengths), starts)
        return [
            source if same and source != COMPUTED else None
            for source, same in zip(own.tolist(), alike.tolist(), strict=True)
        ]

    def _copy_mixed_operands(self) -> None:
        for late in (False, True):
            columns = [column for draft in self.drafts if draft.late == late for column in draft.columns]
            pairs = zip(columns, self._sources(columns), strict=True)
            mixed = [column[self.statement[column] < 0] for column, source in pairs if source is None]
            free = numpy.unique(numpy.concatenate(mixed)) if mixed else numpy.zeros(0, dtype=numpy.int64)
            for source in numpy.unique(self.source[free]):
                inputs = free[self.source[free] == source]
                members = inputs[numpy.argsort(self.place[inputs], kind="stable")]
                draft = _Draft("copy", members, [members], late, False)
                draft.group = -1 - len(self.drafts)
                self._add(draft)

    # --- order

    def _find_sources(self) -> Iterator[_Read]:
        columns = [column for draft in self.drafts for column in draft.columns]
        counts = numpy.array([draft.count for draft in self.drafts])
        steps, starts, lengths = _join_columns(columns)
        first = numpy.repeat(steps[starts], lengths)
        members = numpy.arange(len(steps)) - numpy.repeat(starts, lengths)
        numbers = self.statement[steps]
        of_one = numpy.logical_and.reduceat(numbers == self.statement[first], starts)
        in_order = numpy.logical_and.reduceat(self.member[steps] == members, starts)
        of_all = of_one & in_order & (counts[numbers[starts]] == lengths)
        of_one, of_all, number = of_one.tolist(), of_all.tolist(), numbers[starts].tolist()
        for i, source in enumerate(self._sources(columns)):
            if source is not None:
                yield _Read(source, None, set())
            else:
                statements = {number[i]} if of_one[i] else set(self.statement[columns[i]].tolist())
                yield _Read(None, number[i] if of_all[i] else None, statements)

    def _needs(self, draft: _Draft) -> dict[int, bool]:
        needs: dict[int, bool] = {}
        for _, turn, statements in draft.reads:
            for number in statements:
                needs[number] = needs.get(number, True) and number == turn
        return needs

    def schedule(self) -> list[list[int]]:
        """Return the statements of each loop, all with the same number of turns, as early as operands allow."""
        drafts = self.drafts
        waits = [0] * len(drafts)
        users: list[list[tuple[int, bool]]] = [[] for _ in drafts]
        for number, draft in enumerate(drafts):
            for other, turn in self._needs(draft).items():
                waits[number] += 1
                users[other].append((number, turn))
        loops: list[list[int]] = []
        ready: dict[tuple[bool, int], list[int]] = {}

        def release(number: int) -> None:
            waits[number] -= 1
            if waits[number] <= 0:
                draft = drafts[number]
                heapq.heappush(ready.setdefault((draft.late, draft.count), []), number)

        for number in [number for number, count in enumerate(waits) if count == 0]:
            release(number)
        while any(ready.values()):
            late = min(key[0] for key, waiting in ready.items() if waiting)
            _, kind = min((waiting[0], key) for key, waiting in ready.items() if waiting and key[0] == late)
            body: list[int] = []
            after: list[int] = []
            while ready[kind] and len(body) < MOST:
                number = heapq.heappop(ready[kind])
                drafts[number].loop = len(loops)
                body.append(number)
                for user, turn in users[number]:
                    if turn:
                        release(user)
                    else:
                        after.append(user)
            for user in after:
                release(user)
            loops.append(body)
        return loops

    # --- places

    def finish(self) -> Rolled:
        """Return the loops, with the array elements of all values that pass between them."""
        loops = self.schedule()
        drafts = self.drafts
        turns: dict[tuple[int, int], int] = {}
        last: dict[int, int] = {}
        kept: set[int] = set()
        for number, draft in enumerate(drafts):
            for i, (_, turn, statements) in enumerate(draft.reads):
                if turn is not None and drafts[turn].loop == draft.loop:
                    turns[number, i] = turn
                    continue
                for other in statements:
                    kept.add(other)
                    group = drafts[other].group
                    last[group] = max(last.get(group, 0), draft.loop)
        at, scratch = self._slots(kept, last)
        computed = numpy.flatnonzero(self.statement >= 0)
        first = numpy.array([at.get(number, 0) for number in range(len(drafts))], dtype=numpy.int64)
        own_places = numpy.zeros(len(self.steps), dtype=numpy.int64)
        own_places[computed] = first[self.statement[computed]] + self.member[computed]

        def operand(number: int, i: int, column: numpy.ndarray) -> Operand:
            copied = drafts[number].operation == "copy"
            logical = drafts[number].logical if copied else bool(self.logical[column[0]])
            if (number, i) in turns:
                return Operand(TURN, (turns[number, i],), logical)
            source = drafts[number].reads[i].source
            places = own_places if source is None else self.place
            return Operand(SCRATCH if source is None else source, tuple(places[column].tolist()), logical)

        def statement(number: int) -> Statement:
            draft = drafts[number]
            own = tuple(operand(number, i, column) for i, column in enumerate(draft.columns))
            to = list(draft.results)
            if number in kept:
                to.append(Operand(SCRATCH, tuple(range(at[number], at[number] + draft.count)), draft.logical))
            return Statement(number, draft.operation, own, draft.logical, draft.table, tuple(to), draft.group)

        made = [Loop(drafts[body[0]].count, [statement(number) for number in body]) for body in loops]
        before = sum(not drafts[body[0]].late for body in loops)
        return Rolled(made, before, scratch)

    def _slots(self, kept: Iterable[int], last: dict[int, int]) -> tuple[dict[int, int], int]:
        """Return the first scratch index of every stored statement, and the length of the scratch array.

        Results of one array operation are adjacent, stored as long as any is needed.
        """
        inside: dict[int, int] = {}
        sizes: dict[int, int] = {}
        first: dict[int, int] = {}
        for number in sorted(kept):
            draft = self.drafts[number]
            inside[number] = sizes.get(draft.group, 0)
            sizes[draft.group] = inside[number] + draft.count
            first[draft.group] = min(first.get(draft.group, draft.loop), draft.loop)
        busy: list[tuple[int, int, int]] = []
        base: dict[int, int] = {}
        for group in sorted(sizes, key=lambda group: (first[group], group)):
            busy = sorted(entry for entry in busy if entry[2] >= first[group])
            place = 0
            for start, end, _ in busy:
                if start - place >= sizes[group]:
                    break
                place = max(place, end)
            base[group] = place
            busy.append((place, place + sizes[group], last[group]))
        top = max((base[group] + sizes[group] for group in sizes), default=0)
        return {number: base[self.drafts[number].group] + k for number, k in inside.items()}, top


def _join_columns(columns: Sequence[numpy.ndarray]) -> tuple[numpy.ndarray, numpy.ndarray, numpy.ndarray]:
    lengths = numpy.array([len(column) for column in columns], dtype=numpy.int64)
    steps = numpy.concatenate([*columns, numpy.zeros(0, dtype=numpy.int64)])
    return steps, numpy.cumsum(lengths) - lengths, lengths


@without_collection()
def roll(program: StraightLineProgram, results: int = 0) -> Rolled:
    """Convert a straight-line program to loops over the elements of its array operations.

    The program has origins, and no products that are loops. The first ``results`` results are written before any input
    is read that they do not need.
    """
    return _Roller(program, results).finish()


def roll_where_shorter(program: StraightLineProgram, results: int = 0) -> Rolled | None:
    """Convert a program to loops if that makes less code; return None if a straight line is shorter."""
    if "product" in program.steps.operations:
        return None
    operations = numpy.count_nonzero(~program.steps.which(*FREE))
    rolled = roll(program, results)
    statements = sum(len(loop.body) for loop in rolled.loops)
    return rolled if SHORTER * statements < operations + len(program.results) else None


def common_difference(places: Sequence[int]) -> int | None:
    """Return the difference between successive integers if it is constant, else None."""
    count, first = len(places), places[0]
    step = places[1] - first if count > 1 else 0
    regular = range(first, first + step * count, step) if step else (first,) * count
    return step if tuple(places) == tuple(regular) else None
