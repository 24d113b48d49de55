"""Files that are whole or not there: written beside their place, then moved into it."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def writable_folder(path: Path) -> Path:
    """Make a folder and check that it can be written to, before any long work begins.

    Raises:
        ValueError: if it cannot.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise ValueError(f"cannot write to folder {path}: {error.strerror or error}") from error
    return path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a new file that takes the place of an old one only when it is complete.

    Raises:
        ValueError: if the folder cannot be written to.
    """
    partial = writable_folder(path.parent) / f".{path.name}.partial"
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """Give a new folder that takes the place of an old one only when it is complete."""
    partial, old = folder.with_name(folder.name + ".partial"), folder.with_name(folder.name + ".old")
    for leftover in (partial, old):
        shutil.rmtree(leftover, ignore_errors=True)
    partial.mkdir(parents=True)
    yield partial
    if folder.exists():
        folder.rename(old)
    partial.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file.

    Raises:
        ValueError: if the folder cannot be written to.
    """
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")
