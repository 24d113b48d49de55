"""Notebooks of the documentation: short, executed, and the same again when they are run."""

import re
import time

import pytest
from notebooks import execute, notebook_files

nbformat = pytest.importorskip("nbformat")
FILES = {file.stem: file for file in notebook_files()}
MOST_LINES, MOST_SECONDS = 60, 120
"""Of code, and of processor time."""
COSTS = re.compile(r"[-+]?\d[\d,.]* \[[^\]\n]+\]")
"""Numbers with their intervals."""


def code_of(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def printed(notebook):
    outputs = [output for cell in code_of(notebook) for output in cell.outputs]
    return "\n".join(one.text if "text" in one else one.data.get("text/plain", "") for one in outputs)


def test_there_are_four():
    assert sorted(FILES) == ["compare_my_filter", "estimate_in_the_loop", "log_to_c", "train_an_agent"]


@pytest.mark.parametrize("name", FILES)
def test_a_notebook_is_short_installs_what_is_missing_and_holds_its_outputs(name):
    notebook = nbformat.read(FILES[name], as_version=4)
    nbformat.validate(notebook)
    cells = code_of(notebook)
    lines = [line for cell in cells for line in cell.source.splitlines() if line.strip()]
    assert len(lines) < MOST_LINES
    assert re.search(r'find_spec\("filtergym"\) is None.*\n +%pip install .*"filtergym\[', cells[0].source)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert len(outputs) >= 2
    assert all(one.output_type != "error" for one in outputs)
    assert "\x1b" not in printed(notebook)
    assert FILES[name].stat().st_size < 250_000
    folder = FILES[name].parent
    for cell in notebook.cells:
        for target in re.findall(r"\]\(([^)#]+)", cell.source if cell.cell_type == "markdown" else ""):
            assert (folder / target).exists(), target


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_a_notebook_runs_and_finds_what_it_shows(name):
    """Costs of shipped filters repeat; those of an agent trained here, and times, are of the machine."""
    before = time.monotonic()
    again, shown = execute(FILES[name]), nbformat.read(FILES[name], as_version=4)
    assert time.monotonic() - before < 10 * MOST_SECONDS  # as busy as the machine may be
    found, known = printed(again), printed(shown)
    if name == "train_an_agent":
        found, known = (
            "\n".join(line for line in text.splitlines() if line.startswith(("semi-markov", "imm-steady")))
            for text in (found, known)
        )
    assert COSTS.findall(found) == COSTS.findall(known)
    assert len(COSTS.findall(found)) > 3
