"""Cache of compiled machine code in the user's cache folder, by content.

An entry is written to a temporary file and moved into place, begins with its own checksum, and is ignored if it is
invalid. The least recently used entries are removed first where the folder is too large. If the operating system
refuses an access, the entry counts as missing.

An entry is executed. So, like a key of ssh, it must be safe from other users: folder and entry belong to this
user or to root, and neither group nor others may write to them. The checks use the opened file itself, so
that it cannot be exchanged in between.
"""

import contextlib
import hashlib
import os
import stat
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

LIMIT = 256 * 2**20
"""Maximal size of the folder in bytes."""
SLACK = 2**23
"""Number of bytes that a process writes between two checks of the folder's size; the first check is at its first
write.
"""
SUFFIX = ".code"
"""Suffix of entries; other files in the folder are ignored."""
SWITCH = "FILTERGYM_COMPILER_CACHE"
"""Environment variable with a folder to use in place of the default one, or ``off``."""


def folder() -> Path | None:
    """Return the path of the cache folder of compiled code; None if the cache is off."""
    chosen = os.environ.get(SWITCH, "")
    if chosen == "off":
        return None
    if chosen:
        return Path(chosen)
    import platformdirs  # installed with llvmlite only

    return platformdirs.user_cache_path("filtergym") / "compiled"


def key(*texts: str) -> str:
    """Return the name of a cache entry: the SHA-256 digest of some texts."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(f"{len(text)}:{text}".encode())
    return digest.hexdigest()


def load(name: str) -> bytes | None:
    """Return the machine code in a cache entry; None if the entry is missing or invalid."""
    place = folder()
    if place is None:
        return None
    try:
        whole = _read(place, f"{name}{SUFFIX}")
    except _Untrusted as error:
        _explain(place, error)
        return None
    except OSError:
        return None
    checksum, code = whole[:32], whole[32:]
    return code if hashlib.sha256(code).digest() == checksum else None


def contains(name: str) -> bool:
    """Return whether the file of a cache entry exists, valid or not."""
    place = folder()
    return place is not None and (place / f"{name}{SUFFIX}").exists()


def store(name: str, code: bytes) -> None:
    """Write machine code as a cache entry; errors of the operating system are ignored."""
    place = folder()
    if place is None:
        return
    with contextlib.suppress(OSError):
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            with _open_folder(place):
                pass
        except _Untrusted as error:
            _explain(place, error)
            return
        handle, partial = tempfile.mkstemp(dir=place, prefix=".partial-", suffix=SUFFIX)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(code).digest() + code)
            os.replace(partial, place / f"{name}{SUFFIX}")
        except OSError:
            os.unlink(partial)
            raise
        _UNCHECKED[place] = _UNCHECKED.get(place, LIMIT) + len(code)
        if _UNCHECKED[place] > SLACK:
            _bound(place)
            _UNCHECKED[place] = 0


class _Untrusted(Exception):  # noqa: N818  (the reason why an entry is not used, not a user's error)
    """Error for a file or folder that another user can have written."""


_REPORTED_FOLDERS: set[Path] = set()
"""Folders for which a warning was issued that they are not used."""


def _explain(place: Path, reason: _Untrusted) -> None:
    if place not in _REPORTED_FOLDERS:
        _REPORTED_FOLDERS.add(place)
        warnings.warn(
            f"compiled code in {place} is not used, and compiled anew: {reason}, so that another user can have "
            f"written it. Remove the folder, or set {SWITCH} to one that only you can write to, or to off",
            stacklevel=2,
        )


def _read(place: Path, name: str) -> bytes:
    """Return the content of a cache entry, and mark it as used now."""
    with (
        _open_folder(place) as within,
        _open(place / name if within is None else name, 0, within) as handle,
    ):
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(f"{name} is not a file")
        with contextlib.suppress(OSError):
            os.utime(handle if os.utime in os.supports_fd else place / name)
        with open(handle, "rb", closefd=False) as file:
            return file.read()


@contextlib.contextmanager
def _open_folder(place: Path) -> Iterator[int | None]:
    """Yield a handle of the checked cache folder, through which its entries are opened; None on Windows."""
    if not hasattr(os, "getuid"):  # Windows: a user's own folders are not writable for others
        yield None
        return
    if place.is_symlink():  # the owner of the link chooses the folder
        raise _Untrusted("the folder is a symbolic link")
    with _open(place, os.O_DIRECTORY, None) as handle:
        yield handle


@contextlib.contextmanager
def _open(path: str | Path, flags: int, within: int | None) -> Iterator[int]:
    # O_NONBLOCK: do not wait for the other end of a pipe; Windows has only O_BINARY.
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"):
        flags |= getattr(os, name, 0)
    handle = os.open(path, os.O_RDONLY | flags, dir_fd=within)
    try:
        found = os.fstat(handle)
        if hasattr(os, "getuid"):
            if found.st_uid not in (os.getuid(), 0):
                raise _Untrusted(f"{path} belongs to user {found.st_uid}")
            if found.st_mode & 0o022:
                raise _Untrusted(f"others may write to {path} (mode {found.st_mode & 0o777:o})")
        yield handle
    finally:
        os.close(handle)


_UNCHECKED: dict[Path, int] = {}
"""Bytes written into a folder since the last check of its size."""


def _bound(place: Path) -> None:
    entries = [(path, path.stat()) for path in place.glob(f"*{SUFFIX}")]
    total = sum(found.st_size for _, found in entries)
    for path, found in sorted(entries, key=lambda entry: entry[1].st_mtime):
        if total <= LIMIT:
            return
        total -= found.st_size
        path.unlink(missing_ok=True)
