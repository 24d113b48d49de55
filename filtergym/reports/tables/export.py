"""Results for other programs: records as JSON and CSV, and the terminal's tables for LaTeX."""

import csv
import json
import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Column, Row, Table
from rich.text import Text

from ...evaluation.running.metrics import Record
from ...evaluation.storage.files import whole_file, write_text

PREAMBLE = "% In the preamble: \\usepackage{booktabs,graphicx}"
FITTING = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"
"""LaTeX command that shrinks a wider table to the width of the line."""
SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "±": r"$\pm$",
    "×": r"$\times$",
    "·": r"$\cdot$",
    "°": r"$^{\circ}$",
    "²": r"$^2$",
    "³": r"$^3$",
    "\N{MICRO SIGN}": r"$\mu$",
    "\N{MINUS SIGN}": r"$-$",
    "\N{EN DASH}": "--",
    "≤": r"$\le$",
    "≥": r"$\ge$",
    "≈": r"$\approx$",
    "∞": r"$\infty$",
    "√": r"$\surd$",
}
GREEK = {
    letter: name.rpartition(" ")[2].lower()
    for letter in map(chr, range(0x3B1, 0x3CA))
    if (name := unicodedata.name(letter, "")) and "FINAL" not in name
} | {"λ": "lambda"}  # which Unicode spells otherwise
"""Small Greek letters with their LaTeX commands; omicron has none."""
MINUS = re.compile(r"(?<![\w.)\]])-(?=\.?\d)")
"""Pattern of a hyphen before a number."""


LATEX_WIDTH = 160
"""Width of the terminal whose tables are written for LaTeX, characters: all columns side by side."""


def write_records(path: Path, records: Sequence[Any]) -> None:
    """Write named tuples as JSON, one record to a line."""
    lines = ",\n".join(json.dumps(record._asdict()) for record in records)
    write_text(path, f"[\n{lines}\n]\n")


def records_as_csv(path: Path, records: Sequence[Any]) -> None:
    """Write named tuples of one kind as CSV, a line each, all fields; empty where one is None."""
    fields = records[0]._fields if records else Record._fields
    with whole_file(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(fields)
        writer.writerows(records)


def latex_text(text: str) -> str:
    """Return text escaped for LaTeX; a hyphen before a number becomes a minus sign."""
    marked = MINUS.sub("\N{MINUS SIGN}", text)
    return "".join(map(_latex_character, marked))


def _latex_character(character: str) -> str:
    if character in SPECIAL:
        return SPECIAL[character]
    if character.isascii():
        return character
    if character in GREEK:
        return "o" if character == "ο" else f"$\\{GREEK[character]}$"
    if "LATIN" in unicodedata.name(character, ""):
        return character
    # A character without a letter in LaTeX would stop it.
    return f"[U+{ord(character):04X}]"


def latex_table(table: Table) -> str:
    """Return a table of the terminal for LaTeX with booktabs: the same cells, its title as caption, its notes below.

    It spans both columns of a paper if it has more than four columns, and shrinks to the available width.
    """
    environment = "table*" if len(table.columns) > 4 else "table"
    letters = "".join("r" if column.justify == "right" else "l" for column in table.columns)
    lines = [PREAMBLE, f"\\begin{{{environment}}}", "\\centering", "\\footnotesize"]
    if table.title:
        lines.append(f"\\caption{{{latex_text(_plain(table.title))}}}")
    lines += ["\\setlength{\\tabcolsep}{4pt}", FITTING, f"\\begin{{tabular}}{{{letters}}}", "\\toprule"]
    if table.show_header:
        lines += [_row([_cell(column.header, column) for column in table.columns]), "\\midrule"]
    cells = [[_cell(cell, column) for cell in column.cells] for column in table.columns]
    rows: Sequence[Row] = table.rows
    for i, (row, own) in enumerate(zip(rows, zip(*cells, strict=True), strict=True)):
        lines.append(_row(own))
        if row.end_section and i < len(rows) - 1:
            lines.append("\\midrule")
    lines += ["\\bottomrule", "\\end{tabular}}"]
    notes = (
        [_after_break(latex_text(line)) for line in _plain(table.caption).splitlines()]
        if table.caption
        else []
    )
    if notes:
        lines += ["", "\\medskip", "\\begin{minipage}{\\linewidth}", "\\footnotesize"]
        lines += ["\\\\\n".join(notes), "\\end{minipage}"]
    return "\n".join([*lines, f"\\end{{{environment}}}"]) + "\n"


def _plain(cell: Any) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)


def _cell(cell: Any, column: Column) -> str:
    parts = [latex_text(part) for part in _plain(cell).split("\n")]
    if len(parts) == 1:
        return parts[0]
    side = "r" if column.justify == "right" else "l"
    return f"\\shortstack[{side}]{{" + "\\\\".join(map(_after_break, parts)) + "}"


def _row(cells: Sequence[str]) -> str:
    return _after_break(" & ".join(cells)) + r" \\"


def _after_break(line: str) -> str:
    """Return a line with ``{}`` before a leading bracket or asterisk, which LaTeX adds to the line break."""
    return ("{}" if line.startswith(("[", "*")) else "") + line
