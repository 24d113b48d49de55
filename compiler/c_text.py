"""C99 text of names, numbers, comments, expressions and functions.

All names and sentences from outside pass through :func:`identifier` and :func:`comment`.
"""

import math
import re
import textwrap
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy

WIDTH = 100
"""Maximal number of characters in a line of a comment."""
_INFIX = {
    "add": "+",
    "subtract": "-",
    "multiply": "*",
    "divide": "/",
    "logical_and": "&&",
    "logical_or": "||",
}
_INFIX |= {
    "less": "<",
    "less_equal": "<=",
    "greater": ">",
    "greater_equal": ">=",
    "equal": "==",
    "not_equal": "!=",
}
_RESERVED = frozenset(
    re.findall(
        r"\w+",
        "auto break case char const continue default do double else enum extern float for goto if inline int long "
        "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
        "asm typeof bool true false class new delete this private public template namespace operator main "
        "NAN INFINITY FLT_MAX FLT_MIN DBL_MAX sign_of remainder_of place_of",
    )
)
"""Names reserved by C, by related languages, or by the generated text."""


@dataclass(frozen=True)
class Scalar:
    """Floating-point type of C, double or float: name, suffix and limits."""

    name: str
    suffix: str
    """Suffix of functions and literals of this type."""
    dtype: type
    largest: str
    """Macro of ``float.h`` for the largest number."""
    smallest: str


DOUBLE = Scalar("double", "", numpy.float64, "DBL_MAX", "DBL_MIN")
FLOAT = Scalar("float", "f", numpy.float32, "FLT_MAX", "FLT_MIN")


class Parameter(NamedTuple):
    """Type and name of a parameter of a C function."""

    type: str
    """C text before the name."""
    name: str


def identifier(text: str, used_names: Collection[str] = ()) -> str:
    """Return a valid C identifier made from a text, different from reserved names and those in use."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")[:60] or "x"
    if not name[0].isalpha():
        name = f"n{name}"
    # Temporaries are called v and r with a number, the scratch array w.
    if name in _RESERVED or re.fullmatch(r"[vrw]\d*", name):
        name += "_"
    unique, number = name, 2
    while unique in used_names:
        unique, number = f"{name}_{number}", number + 1
    return unique


def plain_words(text: str) -> str:
    """Return a text as one line of printable ASCII without the delimiters of C comments."""
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "replace").decode()
    line = " ".join("".join(c if c.isprintable() else " " for c in ascii_text).split()).replace("\\", "|")
    # No end, no begin, and no trigraph.
    return re.sub(r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)", " ", line)


def comment(*paragraphs: str, indent: str = "") -> str:
    """Return a C comment with one paragraph for each text, every line indented; leading blanks are preserved."""
    lines: list[str] = []
    for text in paragraphs:
        before = " " * (len(text) - len(text.lstrip(" ")))
        wide = WIDTH - len(indent)
        lines += textwrap.wrap(
            plain_words(text), wide, initial_indent=before, subsequent_indent=before, break_on_hyphens=False
        ) or [""]
    return f"{indent}/* " + "\n".join(f"{indent}   {line}".rstrip() for line in lines).lstrip() + " */"


def literal(value: float, scalar: Scalar = DOUBLE) -> str:
    """Return a number as a C literal with the same bits; for ``float`` the nearest number.

    A number beyond the range of ``float`` becomes its largest or smallest normal number.
    """
    if value != value:
        return f"({scalar.name})NAN"  # in C they are float
    if math.isinf(value):
        return f"({'-' * (value < 0.0)}({scalar.name})INFINITY)"
    if is_beyond(value, scalar):
        text = scalar.largest if abs(value) > 1.0 else scalar.smallest
    else:
        text = f"{scalar.dtype(abs(value))!s}{scalar.suffix}"
    return text if math.copysign(1.0, value) > 0.0 else f"(-{text})"


def is_beyond(value: float, scalar: Scalar) -> bool:
    """Return whether a finite number is out of the range of normal numbers of ``float``; False for ``double``."""
    limits = numpy.finfo(scalar.dtype)
    size = abs(value)
    return scalar.dtype is not numpy.float64 and (
        bool(size > float(limits.max)) or 0.0 < size < float(limits.tiny)
    )


def array_text(
    name: str, values: numpy.ndarray, scalar: Scalar = DOUBLE, qualifier: str = "static const"
) -> str:
    """Return the C definition of a constant array, with a line for each row of a matrix."""

    def braces(part: numpy.ndarray) -> str:
        if part.ndim == 1:
            inside = textwrap.fill(", ".join(literal(float(v), scalar) for v in part), WIDTH)
        else:
            inside = ",\n".join(braces(row) for row in part)
        return "{\n" + inside + "\n}"

    shape = "".join(f"[{size}]" for size in values.shape)
    return f"{qualifier} {scalar.name} {name}{shape} = {braces(values)};\n"


def expression(
    operation: str,
    values: Sequence[str],
    known: Sequence[bool],
    scalar: Scalar,
    table: tuple[str, int] | None = None,
) -> str:
    """Return the C expression of one arithmetic operation on the C expressions of its arguments.

    ``known`` states whether each argument is a constant; ``table`` are name and length of the table of ``take``.
    """
    if table is not None:
        return f"{table[0]}[place_of({values[0]}, {table[1]})]"
    if operation == "copy":
        return values[0]
    if operation in _INFIX:
        return f"{values[0]} {_INFIX[operation]} {values[1]}"
    if operation == "logical_not":
        return f"!{values[0]}"
    if operation == "negative":
        return f"-{values[0]}"
    if operation == "where":
        return f"{values[0]} ? {values[1]} : {values[2]}"
    if operation == "number":
        return f"{values[0]} ? {literal(1.0, scalar)} : {literal(0.0, scalar)}"
    if operation in ("maximum", "minimum"):
        return _extreme(values, known, ">" if operation == "maximum" else "<")
    name = {"absolute": "fabs", "sign": "sign_of", "remainder": "remainder_of"}.get(operation, operation)
    suffix = "" if name.endswith("_of") else scalar.suffix
    return f"{name}{suffix}({', '.join(values)})"


def _extreme(values: Sequence[str], known: Sequence[bool], sign: str) -> str:
    """Return the C expression of the maximum or minimum of two numbers, NaN if either is NaN."""
    one, other = values if known[0] or not known[1] else values[::-1]
    # A constant is never NaN, see Graph.
    unordered = "" if any(known) else f" || {one} != {one}"
    return f"{one} {sign} {other}{unordered} ? {one} : {other}"


def function_text(returns: str, name: str, parameters: Sequence[Parameter], body: Sequence[str]) -> str:
    """Return the C definition of a function; parameters that its body does not use are cast to void."""
    listed = ", ".join(_declare(parameter) for parameter in parameters)
    words = set(re.findall(r"\w+", "\n".join(body)))
    unused = [f"(void){parameter.name};" for parameter in parameters if parameter.name not in words]
    inside = "\n".join(f"    {line}" for line in [*unused, *body])
    return f"{returns} {name}({listed or 'void'}) {{\n{inside}\n}}\n"


def _declare(parameter: Parameter) -> str:
    blank = "" if parameter.type.endswith("*") else " "
    return f"{parameter.type}{blank}{parameter.name}"
