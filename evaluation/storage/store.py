"""Store of results on disk, so that after an interruption the same command computes only the missing ones.

Each result is one file, whose name ends with a digest of request and code; after a change of either it is
computed again.

A file is MessagePack of a declared type. Reading it executes and imports nothing, and returns that type or None.
"""

import hashlib
import io
import re
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy
import xarray

from .code import code_digest
from .files import whole_file, writable_folder

UNFINISHED = "unfinished"
"""Folder of a store, beside the results of a command."""
SUFFIX = ".msgpack"
DIGITS = 32
"""Number of hexadecimal digits of the digest in the name of a file: 128 bits."""

Result = TypeVar("Result")


class Work(NamedTuple):
    """Name and identity of a unit of work whose result is stored."""

    name: str
    """First part of the name of its file. Files with the same name are removed together."""
    content: str
    """Text that contains all that its result depends on, apart from the code of the package."""


class Store:
    """Store of results in a folder, one file each; with a folder of None nothing is stored."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder: Path | None = None if folder is None else writable_folder(folder)
        self._names: set[str] = set()

    def _path(self, work: Work | None) -> Path | None:
        if self.folder is None or work is None:
            return None
        name = re.sub(r"[^\w.-]", "_", work.name)  # no path to another folder
        self._names.add(name)
        digest = hashlib.sha256(f"{code_digest()} {work.name} {work.content}".encode()).hexdigest()
        return self.folder / f"{name}.{digest[:DIGITS]}{SUFFIX}"

    def read(self, work: Work | None, kind: type[Result]) -> Result | None:
        """Read the stored result of a unit of work; None if it is not stored."""
        path = self._path(work)
        if path is None or not path.is_file():
            return None
        try:
            return msgspec.msgpack.decode(path.read_bytes(), type=kind, dec_hook=_decode)
        except (msgspec.MsgspecError, OSError, ValueError, TypeError, LookupError):
            return None  # of another program, or damaged: it is computed again

    def write(self, work: Work | None, result: Any) -> None:
        """Store the result of a unit of work: numbers, strings, arrays or datasets in typed containers.

        Warn if it cannot be written.
        """
        path = self._path(work)
        if path is not None:
            content = msgspec.msgpack.encode(result, enc_hook=_encode)
            try:
                with whole_file(path) as partial:
                    partial.write_bytes(content)
            except ValueError as error:
                warnings.warn(f"{error}: after an interruption it is computed again", stacklevel=2)

    def result(self, work: Work | None, kind: type[Result], make: Callable[[], Result]) -> Result:
        """Return the stored result of a unit of work, or compute it with ``make`` and store it."""
        found = self.read(work, kind)
        if found is None:
            found = make()
            self.write(work, found)
        return found

    def clear(self) -> None:
        """Remove the files of all work that this store has read or written, and the folder if it is then
        empty.
        """
        if self.folder is None or not self.folder.is_dir():
            return
        own = rf"\.?(.+)\.[0-9a-f]{{{DIGITS}}}{re.escape(SUFFIX)}(\.partial)?"  # a crash leaves partial ones
        for path in self.folder.iterdir():
            found = re.fullmatch(own, path.name)
            if found and found[1] in self._names:
                path.unlink(missing_ok=True)
        with suppress(OSError):  # something else is in it
            self.folder.rmdir()


def _encode(value: Any) -> Any:
    """Convert a NumPy or xarray value for MessagePack."""
    if isinstance(value, numpy.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, numpy.generic):
        return value.item()
    if isinstance(value, xarray.Dataset):
        return bytes(value.to_netcdf(engine="scipy", format="NETCDF3_64BIT"))
    raise NotImplementedError(f"a {type(value).__name__} cannot be stored")


def _decode(kind: type, value: Any) -> Any:
    if kind is numpy.ndarray:
        dtype, shape, content = value
        return numpy.frombuffer(content, dtype).reshape(shape).copy()
    with xarray.open_dataset(io.BytesIO(value), engine="scipy") as read:
        dataset = read.load()
    for name, attribute in dataset.attrs.items():
        if isinstance(attribute, numpy.generic):
            dataset.attrs[name] = attribute.item()
    return dataset
