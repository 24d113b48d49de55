"""A long straight line cut into parts, because the time that compilers take grows faster than a function's length.

What crosses a cut lies in a scratch array; inputs and constants are read again in every part instead.
"""

import heapq

from .program import BAND, ProgramResult, StraightLineProgram

FREE = ("input", "constant", "entry")
"""Steps that every part makes again instead of fetching them from a slot of the scratch array."""
Statement = int | ProgramResult
"""What takes a compiler time: a step that is computed, or a result that is written."""


def cut_parts(program: StraightLineProgram, size: int, pause: int = 0) -> tuple[list[list[Statement]], int]:
    """Return the statements of each part: every step but those that are free, and every result right after its step.

    Args:
        program: to cut.
        size: statements of a part.
        pause: a step with which a part begins.

    Returns:
        Parts, at least one, and how many of them are before the pause.
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
    """Place in the scratch array of every step that crosses a cut; places are used again.

    Args:
        program: that was cut.
        parts: of :func:`cut_parts`.
    """
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
    """Place in the scratch array of what comes out of every product, and behind all of them that of a vector.

    Args:
        program: that was cut.
        first: place behind the slots.
    """
    places = {}
    for index, (operation, arguments, _) in enumerate(program.steps):
        if operation == "product":
            places[index] = first
            first += -(-arguments[1] // BAND) * BAND
    return places, first
