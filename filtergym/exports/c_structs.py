"""Structs of C for the input, state and output of a filter."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy

from ..compiler.c_text import Scalar, comment, identifier
from .traced_filter import Member


class Structure(NamedTuple):
    """A struct of C: its member arrays, the C expression of each number, and its column in a table."""

    name: str
    arrays: list[tuple[str, tuple[int, ...], str, list[int]]]
    """Name, shape and meaning of every array, and the rows of the argument in its order."""
    places: dict[int, str]
    """Row of the argument -> expression that follows the variable."""
    columns: dict[int, str]
    """Row of the argument -> name in a table."""

    @property
    def numbers(self) -> dict[int, int]:
        """Index of each program row's number in the struct seen as one array."""
        rows = [row for _, _, _, own in self.arrays for row in own]
        return {row: place for place, row in enumerate(rows)}


def structure(name: str, members: Sequence[Member]) -> Structure:
    """Return the C struct of some numbers: of an array in full one array member, else a member for each number."""
    groups: dict[tuple[str, tuple[int, ...]], list[int]] = {}
    for row, member in enumerate(members):
        groups.setdefault((member.name, member.shape), []).append(row)
    arrays: list[tuple[str, tuple[int, ...], str, list[int]]] = []
    places, columns = {}, {}
    taken: set[str] = set()
    for (words, shape), rows in groups.items():
        whole = len(rows) == int(numpy.prod(shape, dtype=int))
        own = identifier(words, taken) if whole else ""
        if whole:
            taken.add(own)
            arrays.append((own, shape, members[rows[0]].words, rows))
        for row in rows:
            index = [int(i) for i in numpy.unravel_index(members[row].place, shape)] if shape else []
            if not whole:
                own = identifier("_".join([words, *map(str, index)]), taken)
                taken.add(own)
                arrays.append((own, (), members[row].words, [row]))
            places[row] = own + ("".join(f"[{i}]" for i in index) if whole else "")
            columns[row] = "_".join([own, *map(str, index)]) if whole else own
    return Structure(name, arrays, places, columns)


def struct_text(struct: Structure, scalar: Scalar, title: str, extra: Sequence[str] = ()) -> str:
    """Return the text of a struct's definition in C; ``extra`` are lines of further members."""
    lines = [comment(title), "typedef struct {"]
    words = ""
    for name, shape, text, _ in struct.arrays:
        if text and text != words:
            lines.append(comment(text, indent="    "))
        words = text
        lines.append(f"    {scalar.name} {name}{''.join(f'[{size}]' for size in shape)};")
    lines += [f"    {line}" for line in extra]
    if not struct.arrays and not extra:
        lines.append("    char nothing; /* C has no empty struct */")
    return "\n".join([*lines, f"}} {struct.name};\n"])
