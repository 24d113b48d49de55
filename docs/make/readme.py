"""README's numbers: since it is not rendered, numbers of the records are copied into it, and tested.

A number stands between comments that no reader sees, ``<!-- value: PATH -->-43.6 %<!-- end -->``, with ``number`` in
place of ``value`` where its interval is shown too. Paths are those of :mod:`sentence_numbers`. The output of the
command before ``<!-- printed: begin -->`` stands between that and ``<!-- printed: end -->``. A comment that begins a
line ends a paragraph, so a number stands behind a word.
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from sentence_numbers import number_text

NUMBER = re.compile(r"(<!-- (value|number): (\S+(?: \S+)*?) -->).*?(<!-- end -->)", re.S)


def insert_numbers(page: Path) -> str:
    """Return the text of a page with every number replaced by that of its record.

    Raises:
        ValueError: if there is no such page, it contains no number of a record, a number begins a line, or a path leads
            nowhere.
    """
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    if not NUMBER.search(text):
        raise ValueError(f"{page} holds no number of a record, such as <!-- value: PATH --><!-- end -->")
    for found in NUMBER.finditer(text):
        if text[: found.start()].endswith("\n"):
            raise ValueError(
                f"in {page} {found[1]} begins a line, which ends a paragraph: put a word before it"
            )
    return NUMBER.sub(lambda m: m[1] + number_text(m[3], interval=m[2] == "number") + m[4], text)


PRINTED = re.compile(
    r"(```sh\n(filtergym [^\n]+)\n```\n\n<!-- printed: begin -->\n)(.*?)(<!-- printed: end -->)", re.S
)
"""Pattern of a command of one line, and its output."""
MODULE = re.compile(r"In `(\w+\.py)`:\n\n```python\n(.*?)```", re.S)
"""Pattern of a file that the page contains for readers to write."""
WIDTH = 100


def insert_outputs(page: Path) -> str:
    """Return the text of a page with the output of its commands replaced, run in a folder with its files.

    Raises:
        ValueError: if it has no such command, or one fails.
    """
    text = page.read_text(encoding="utf-8")
    if not PRINTED.search(text):
        raise ValueError(f"{page} has no command before <!-- printed: begin -->")
    with tempfile.TemporaryDirectory() as folder:
        for name, source in MODULE.findall(text):
            (Path(folder) / name).write_text(source, encoding="utf-8")
        return PRINTED.sub(lambda m: f"{m[1]}\n```text\n{_output_of(m[2], folder)}```\n\n{m[4]}", text)


def _output_of(command: str, folder: str) -> str:
    words = [sys.executable, "-m", *shlex.split(command)]
    environment = {**os.environ, "COLUMNS": str(WIDTH)}
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ValueError(f"{command} failed: {done.stderr}")
    return "".join(f"{line.rstrip()}\n" for line in done.stdout.splitlines())
