"""Notebooks of the documentation: executed once, by ``python docs/make notebooks``, and shown with those outputs.

The pages are built in every check, and the notebooks take minutes: so their outputs are committed, and `make test-slow`
executes them again.
"""

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "notebooks"
KEPT = ("text/html", "text/plain", "image/png")
"""Media types of a cell's output that are committed."""
SECONDS = 600
"""Time limit of a cell, s."""


def notebook_files() -> list[Path]:
    """Return the paths of the documentation's notebooks."""
    return sorted(FOLDER.glob("*.ipynb"))


def execute(file: Path) -> Any:
    """Return a notebook with the output of its cells, run in an empty folder by this Python."""
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    notebook = nbformat.read(file, as_version=4)
    # Commands of this Python, without the warning that no debugger can look into frozen modules.
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PYDEVD_DISABLE_FILE_VALIDATION": "1"}
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook, timeout=SECONDS, resources={"metadata": {"path": folder}}, record_timing=False
        )
        try:
            client.execute(env=environment)
        except CellExecutionError as error:
            raise ValueError(f"{file} fails: {error}") from error
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            if "data" in output:
                output.data = {form: output.data[form] for form in KEPT if form in output.data}
                output.metadata = {}
    notebook.metadata = {"kernelspec": notebook.metadata.kernelspec, "language_info": {"name": "python"}}
    return notebook


def write_executed(file: Path) -> None:
    """Execute a notebook and write it with its outputs."""
    import nbformat

    nbformat.write(execute(file), file)
