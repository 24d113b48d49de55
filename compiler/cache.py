"""Compiled code of earlier processes, kept by content in the user's cache folder.

An entry is written beside its place and moved into it, begins with its own checksum, and is ignored when anything
about it is wrong. The folder keeps below a size: what was not used for longest goes first. Whatever the operating
system refuses, there is simply no entry.
"""

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path

LIMIT = 256 * 2**20
"""Bytes that the folder may hold."""
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
    """Name of what is made of some texts."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(f"{len(text)}:{text}".encode())
    return digest.hexdigest()


def kept(name: str) -> bytes | None:
    """Return an entry, or None."""
    place = folder()
    if place is None:
        return None
    path = place / f"{name}{SUFFIX}"
    try:
        whole = path.read_bytes()
    except OSError:
        return None
    with contextlib.suppress(OSError):  # in a folder of somebody else's
        os.utime(path)  # what was used is young again
    checksum, code = whole[:32], whole[32:]
    return code if hashlib.sha256(code).digest() == checksum else None


def keep(name: str, code: bytes) -> None:
    """Write an entry, if that is possible."""
    place = folder()
    if place is None:
        return
    with contextlib.suppress(OSError):
        # Nobody else may write what is going to be executed.
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle, partial = tempfile.mkstemp(dir=place, prefix=".partial-", suffix=SUFFIX)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(code).digest() + code)
            os.replace(partial, place / f"{name}{SUFFIX}")
        except OSError:
            os.unlink(partial)
            raise
        _bound(place)


def _bound(place: Path) -> None:
    """Remove the oldest entries until the folder is small enough."""
    entries = [(path, path.stat()) for path in place.glob(f"*{SUFFIX}")]
    total = sum(stat.st_size for _, stat in entries)
    for path, stat in sorted(entries, key=lambda entry: entry[1].st_mtime):
        if total <= LIMIT:
            return
        total -= stat.st_size
        path.unlink(missing_ok=True)
