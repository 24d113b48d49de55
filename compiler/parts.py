"""Division of a long straight-line program into parts, since compile time grows faster than a function's length.

Values that cross a cut are stored in a scratch array; inputs and constants are read again in every part.
"""

import heapq

from .program import BAND, ProgramResult, StraightLineProgram

FREE = ("input", "constant", "entry")
"""Operations of steps that every part loads again instead of using the scratch array."""
Statement = int | ProgramResult
"""A statement of generated code: the index of a computed step, or a stored result."""


def cut_parts(program: StraightLineProgram, size: int, pause: int = 0) -> tuple[list[list[Statement]], int]:
    """Cut a program into parts of ``size`` statements; return them, and the number before the pause.

    There is at least one part. A new one begins at the step ``pause``.
    """
    results: dict[int, list[Statement]] = {}
    for result in program.results:
        results.setdefault(result.node, []).append(result)
    halves: tuple[list[Statement], list[Statement]] = ([], [])
    for index, step in enumerate(program.steps):
        half = halves[index >= pause]
        if step.operation not in FREE:
            half.append(index)
        half += results.get(index, ())
    first, second = ([half[i : i + size] for i in range(0, len(half), size)] for half in halves)
    return [*first, *second] or [[]], len(first)


def scratch_slots(program: StraightLineProgram, parts: list[list[Statement]]) -> dict[int, int]:
    """Return the scratch index of every step that is used in a later part; indices are reused."""
    steps = program.steps.all()
    part_of = {step: i for i, part in enumerate(parts) for step in part if isinstance(step, int)}
    last_user: dict[int, int] = {}
    for number, part in enumerate(parts):
        for statement in part:
            used = steps[statement].parts if isinstance(statement, int) else (statement.node,)
            for step in used:
                if part_of.get(step, number) < number:
                    last_user[step] = number
    free: list[int] = []
    busy: list[tuple[int, int]] = []
    found: dict[int, int] = {}
    for step in sorted(last_user):
        while busy and busy[0][0] < part_of[step]:
            free.append(heapq.heappop(busy)[1])
        found[step] = free.pop() if free else len(busy)
        heapq.heappush(busy, (last_user[step], found[step]))
    return found


def product_places(program: StraightLineProgram, first: int) -> tuple[dict[int, int], int]:
    """Return the scratch index of each product's results, from ``first`` on, and that of a vector after them."""
    places = {}
    for index, (operation, arguments, _) in enumerate(program.steps):
        if operation == "product":
            places[index] = first
            first += -(-arguments[1] // BAND) * BAND
    return places, first
