"""A long straight line cut into parts, because the time that compilers take grows faster than a function's length.

What crosses a cut lies in a scratch array; inputs and constants are read again in every part instead.
"""

import heapq

from .program import BAND, Program

FREE = ("input", "constant", "entry")
"""Steps that every part makes again instead of fetching them from a slot of the scratch array."""


def cut_parts(program: Program, size: int, pause: int = 0) -> tuple[list[list[int]], int]:
    """Steps of each part; those that are free stand only where they are results themselves.

    Args:
        program: to cut.
        size: steps of a part.
        pause: a step with which a part begins.

    Returns:
        Parts, at least one, and how many of them are before the pause.
    """
    results = {result.node for result in program.results}
    listed = [i for i, step in enumerate(program.steps) if step.operation not in FREE or i in results]
    first, second = (
        [half[i : i + size] for i in range(0, len(half), size)]
        for half in ([i for i in listed if i < pause], [i for i in listed if i >= pause])
    )
    return [*first, *second] or [[]], len(first)


def scratch_slots(program: Program, parts: list[list[int]]) -> dict[int, int]:
    """Place in the scratch array of every step that crosses a cut; places are used again.

    Args:
        program: that was cut.
        parts: of :func:`cut_parts`.
    """
    part_of = {step: i for i, part in enumerate(parts) for step in part}
    last_user: dict[int, int] = {}
    for index, part in part_of.items():
        used = program.steps[index]
        if used.operation in FREE:
            continue
        for argument in used.parts:
            if part_of.get(argument, part) < part and program.steps[argument].operation not in FREE:
                last_user[argument] = part
    free: list[int] = []
    busy: list[tuple[int, int]] = []
    found: dict[int, int] = {}
    for step in sorted(last_user):
        while busy and busy[0][0] < part_of[step]:
            free.append(heapq.heappop(busy)[1])
        found[step] = free.pop() if free else len(busy)
        heapq.heappush(busy, (last_user[step], found[step]))
    return found


def product_places(program: Program, first: int) -> tuple[dict[int, int], int]:
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
