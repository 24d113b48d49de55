"""Compiled code of earlier processes, kept by content in the user's cache folder.

An entry is written beside its place and moved into it, begins with its own checksum, and is ignored when anything
about it is wrong. The folder keeps below a size: what was not used for longest goes first. Whatever the operating
system refuses, there is simply no entry.

An entry is executed. So it is used, as ssh uses a key, only if nobody else can have written it: folder and entry belong
to this user or to root, and neither group nor others may write to them. What is checked is what was opened, so that
nothing can be exchanged in between.
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
"""Bytes that the folder may hold."""
SLACK = 2**23
"""Bytes that a process may write before it looks again how many the folder holds, and the first time it writes."""
SUFFIX = ".code"
"""Of entries; nothing else in the folder is touched."""
SWITCH = "FILTERGYM_COMPILER_CACHE"
"""Environment variable: a folder to use in place of the default one, or ``off``."""


def folder() -> Path | None:
    """Where entries lie; None if nothing is to be kept."""
    chosen = os.environ.get(SWITCH, "")
    if chosen == "off":
        return None
    if chosen:
        return Path(chosen)
    import platformdirs  # beside llvmlite: only who compiles has it

    return platformdirs.user_cache_path("filtergym") / "compiled"


def key(*texts: str) -> str:
    """Return the name of what is made of some texts."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(f"{len(text)}:{text}".encode())
    return digest.hexdigest()


def load(name: str) -> bytes | None:
    """Return an entry, or None."""
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


def holds(name: str) -> bool:
    """Whether there is an entry, good or not."""
    place = folder()
    return place is not None and (place / f"{name}{SUFFIX}").exists()


def keep(name: str, code: bytes) -> None:
    """Write an entry, if that is possible."""
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


class _Untrusted(Exception):  # noqa: N818  (no error of a user's: why an entry is not used)
    """Somebody else can have written what would be executed."""


_REPORTED_FOLDERS: set[Path] = set()
"""Folders of which it was said why they are not used."""


def _explain(place: Path, reason: _Untrusted) -> None:
    """Say once why a folder, or an entry in it, is not used."""
    if place not in _REPORTED_FOLDERS:
        _REPORTED_FOLDERS.add(place)
        warnings.warn(
            f"compiled code in {place} is not used, and compiled anew: {reason}, so that somebody else can have "
            f"written what would be executed. Remove the folder, or set {SWITCH} to one that only you can write to, or "
            "to off",
            stacklevel=2,
        )


def _read(place: Path, name: str) -> bytes:
    """Read an entry that nobody else can have written; what was used is young again.

    Raises:
        _Untrusted: if somebody else can.
        OSError: if there is none.
    """
    with (
        _open_folder(place) as within,
        _open(place / name if within is None else name, 0, within) as handle,
    ):
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(f"{name} is no file")
        with contextlib.suppress(OSError):
            os.utime(handle if os.utime in os.supports_fd else place / name)
        with open(handle, "rb", closefd=False) as file:
            return file.read()


@contextlib.contextmanager
def _open_folder(place: Path) -> Iterator[int | None]:
    """Open the folder, so that entries are looked up in what was checked; None on systems without owners."""
    if not hasattr(os, "getuid"):  # Windows: folders below a user's own are his own
        yield None
        return
    if place.is_symlink():  # whoever made the link chooses the folder
        raise _Untrusted("the folder is a symbolic link")
    with _open(place, os.O_DIRECTORY, None) as handle:
        yield handle


@contextlib.contextmanager
def _open(path: str | Path, flags: int, within: int | None) -> Iterator[int]:
    """Open a file or a folder, no link, that nobody else can have written.

    Raises:
        _Untrusted: if somebody else can.
        OSError: if it cannot be opened.
    """
    # Not to wait for the other end of a pipe; Windows has none of these, but text files.
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
"""Bytes written into a folder since its size was looked at."""


def _bound(place: Path) -> None:
    """Remove the oldest entries until the folder is small enough."""
    entries = [(path, path.stat()) for path in place.glob(f"*{SUFFIX}")]
    total = sum(found.st_size for _, found in entries)
    for path, found in sorted(entries, key=lambda entry: entry[1].st_mtime):
        if total <= LIMIT:
            return
        total -= found.st_size
        path.unlink(missing_ok=True)
