"""Reading of files from outside: opened, measured and parsed under limits of memory and processor time.

JSON is counted before it is parsed. Formats that need other libraries (NetCDF-4, Parquet, ULog, bags, SQLite, YAML)
are parsed in a process of their own (:mod:`.foreign_parsers`), which returns plain arrays.

A file that breaks a limit is refused in one sentence, with the way to raise it: ``FILTERGYM_READ_MEMORY`` in MB and
``FILTERGYM_READ_SECONDS`` in the environment.
"""

import contextlib
import importlib.util
import json
import math
import os
import stat
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, BinaryIO, NamedTuple

import numpy

from . import foreign_parsers

MEMORY, SECONDS = "FILTERGYM_READ_MEMORY", "FILTERGYM_READ_SECONDS"
"""Environment variables that raise the limits."""
MOST_BYTES = 1_000_000_000
"""Largest size of a file that is read row by row, bytes."""
MOST_NUMBERS = 50_000_000
"""Most numbers of a recording: 400 MB; replaying it needs twice as much again."""
BYTES_OF_VALUE = 100
"""Largest memory of a value of JSON, beside its text and its container, bytes."""
BYTES_OF_CONTAINER = 160
SECONDS_OF_MEGABYTE = 0.5
"""Processor time per megabyte of a file beyond the limit, s: a valid bag of a million messages is slow."""


class ReadingLimits(NamedTuple):
    """Limits of memory and processor time for reading one file."""

    memory: int
    """Memory, bytes."""
    seconds: float
    """Processor time, s; large files get more."""


def limits() -> ReadingLimits:
    """Return the limits of memory and processor time for reading files, from environment variables or the defaults."""
    found = []
    for name, otherwise in ((MEMORY, 512.0), (SECONDS, 5.0)):
        try:
            value = float(os.environ.get(name) or otherwise)
        except ValueError:
            value = math.nan
        if not 0.0 < value < 1e9:
            raise ValueError(f"{name} must be a positive number, got {os.environ[name]!r:.80}")
        found.append(value)
    return ReadingLimits(int(found[0] * 1e6), found[1])


def memory_limit_error(what: str) -> ValueError:
    """Return a ValueError for a file whose part ``what`` needs more memory than the limit."""
    most = limits().memory / 1e6
    return ValueError(
        f"{what}, and reading a file may take {most:,.0f} MB: split it, or set {MEMORY}={2 * most:.0f} (MB) if you "
        "trust where it comes from"
    )


@contextlib.contextmanager
def open_foreign(path: Path, most: int = MOST_BYTES) -> Iterator[BinaryIO]:
    """Context manager: open a file for binary reading, if it is a regular file and not too large.

    Args:
        path: its path.
        most: largest size, bytes.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is a device, a pipe or a folder, is larger, or cannot be opened.
    """
    try:
        # Without O_NONBLOCK, opening a pipe would wait for a writer.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise ValueError(getattr(error, "strerror", None) or str(error)) from error
    found = os.fstat(handle)
    if not stat.S_ISREG(found.st_mode):
        os.close(handle)
        raise ValueError("it is no file but a folder, a device or a pipe")
    with os.fdopen(handle, "rb") as file:
        if found.st_size > most:
            raise ValueError(f"it is larger than {_size(most)}: split it")
        yield file


def _size(count: int) -> str:
    return f"{count / 1e9:g} GB" if count >= 1e9 else f"{count / 1e6:g} MB"


def is_folder(path: Path) -> bool:
    """Return whether a path is an existing folder; False for a name that is not valid."""
    try:
        return path.is_dir()
    except (OSError, ValueError):  # an impossible name of a file
        return False


def read_content(path: Path, most: int | None = None) -> bytes:
    """Return the bytes of a file, if it is a regular file and not too large.

    ``most`` is the largest size in bytes, by default the limit of memory.
    """
    most = limits().memory if most is None else most
    with open_foreign(path, most) as file:
        content = file.read(most + 1)
    if len(content) > most:  # it grew, or the system does not report its size
        raise ValueError(f"it is larger than {_size(most)}: split it")
    return content


def parse_json(content: bytes) -> Any:
    """Return the value of a JSON text, after a check that it fits into the memory limit."""
    openings = content.count(b"{") + content.count(b"[")
    values = openings + content.count(b",") + content.count(b":")
    text = (3 if content.isascii() else 6) * len(content)
    most = text + BYTES_OF_VALUE * values + BYTES_OF_CONTAINER * openings
    if most > limits().memory:
        raise memory_limit_error(f"it holds {values:,} values, up to {most / 1e6:,.0f} MB")
    try:
        return json.loads(content)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_json(path: Path) -> Any:
    """Return the value in a JSON file, within the memory limit.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it cannot be read, or breaks a limit.
    """
    return parse_json(read_content(path))


def read_yaml(path: Path) -> Any:
    """Return the value in a YAML file: words, numbers, lists and mappings.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it cannot be read, or breaks a limit.
    """

    def plain(value: Any) -> Any:
        if isinstance(value, list):
            return [plain(item) for item in value]
        return {name: plain(item) for name, item in value["pairs"]} if isinstance(value, dict) else value

    return plain(parse_apart("yaml", path, "pip install 'filtergym[agents]'", most=1_000_000)["yaml"])


_WARNED: list[bool] = []


def _warn_without_limit() -> None:
    if sys.platform != "linux" and not _WARNED:
        _WARNED.append(True)
        warnings.warn(
            f"{sys.platform} cannot limit the memory of a process: read files only from where you trust",
            stacklevel=4,
        )


def _has(library: str) -> bool:
    try:
        return importlib.util.find_spec(library) is not None
    except (ImportError, ValueError):
        return False


def parse_apart(parser: str, path: Path, extra: str, most: int = MOST_BYTES, **options: Any) -> Any:
    """Return the plain values in a file, parsed in a subprocess with limits of memory and processor time.

    Args:
        parser: name of one of :data:`.foreign_parsers.PARSERS`.
        path: its path.
        extra: extra of this package to install where the library is missing.
        most: largest size of the file, bytes.
        **options: arguments of the parser, plain values.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it cannot be parsed, or breaks a limit.
    """
    if not all(map(_has, foreign_parsers.LIBRARIES[parser])):
        raise ValueError(f"it needs one more package: {extra}")
    memory, seconds = limits()
    _warn_without_limit()
    with open_foreign(path, most) as file:
        seconds += SECONDS_OF_MEGABYTE * os.fstat(file.fileno()).st_size / 1e6
        request = {
            "parser": parser,
            "path": os.path.abspath(path),
            "memory": memory,
            "seconds": math.ceil(seconds),
            "modules": [place for place in sys.path if place],
            "options": options,
        }
        one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        # A file of HDF5 must not load a plugin that it names; Arrow allocates from the system, without a pool.
        own = {"HDF5_PLUGIN_PRELOAD": "::", "ARROW_DEFAULT_MEMORY_POOL": "system"}
        process = subprocess.Popen(
            [sys.executable, "-I", foreign_parsers.__file__, json.dumps(request)],
            stdin=file,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **one_thread, **own},
        )
    late = threading.Timer(3.0 * seconds, process.kill)
    late.start()
    try:
        assert process.stdout is not None
        with process.stdout:
            head, arrays = _receive(process.stdout, memory)
        code = process.wait()
    finally:
        late.cancel()
        process.kill()
        process.wait()
    if head is None:
        raise _explain_end(code, seconds)
    if "memory" in head:
        raise memory_limit_error(head["memory"])
    if "missing" in head:
        raise ValueError(f"it needs one more package: {extra}")
    if "error" in head:
        raise ValueError(head["error"] if head["own"] else f"it cannot be parsed: {head['error']}")
    return _with_arrays(head["found"], arrays)


def _explain_end(code: int, seconds: float) -> ValueError:
    if code == 3:
        return memory_limit_error("its parser needs more memory")
    if -code in (9, 24):  # SIGKILL, SIGXCPU
        return ValueError(
            f"reading it took more than {seconds:.0f} s: it is damaged, or set {SECONDS}={4 * seconds:.0f} (s) if you "
            "trust where it comes from"
        )
    return ValueError("its parser broke down over it: it is damaged")


def _receive(answer: IO[bytes], memory: int) -> tuple[Any, list[numpy.ndarray]]:
    size = answer.read(8)
    if len(size) < 8 or int.from_bytes(size, "little") > memory:
        return None, []
    text = answer.read(int.from_bytes(size, "little"))
    if len(text) < int.from_bytes(size, "little"):
        return None, []
    head = parse_json(text)
    arrays: list[numpy.ndarray] = []
    left = memory
    for dtype, shape in _array_forms(head.get("found")):
        kind = numpy.dtype(dtype)
        count = math.prod(shape) * kind.itemsize
        left -= count
        if kind.kind not in "biufMmSU" or left < 0:
            return {"memory": "its values take more memory"}, []
        raw = numpy.empty(count, dtype=numpy.uint8)
        if answer.readinto(raw.data) < count:  # type: ignore[attr-defined]
            return None, []
        arrays.append(raw.view(kind).reshape(shape) if count else numpy.empty(shape, dtype=kind))
    return head, arrays


def _array_forms(value: Any) -> Iterator[tuple[str, list[int]]]:
    if isinstance(value, dict):
        if "array" in value:
            yield value["dtype"], value["shape"]
        else:
            for item in value.values():
                yield from _array_forms(item)
    elif isinstance(value, list):
        for item in value:
            yield from _array_forms(item)


def _with_arrays(value: Any, arrays: list[numpy.ndarray]) -> Any:
    if isinstance(value, dict):
        if "array" in value:
            return arrays[value["array"]]
        return {name: _with_arrays(item, arrays) for name, item in value.items()}
    if isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        return [_with_arrays(item, arrays) for item in value]
    return value
