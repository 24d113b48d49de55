"""Atomic writing of files and folders: they are written under another name, then renamed.

Errors of the operating system become one sentence with the path. Locks exclude two writers of the same file.
"""

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, where a folder cannot be locked, and a file that is open cannot be moved
    import msvcrt

    fcntl = None  # type: ignore[assignment]
UNIX = fcntl is not None

UNFINISHED = ".unfinished-"
"""Prefix of the name of the temporary folder in which files are written until all of them are complete."""
LOCK = ".lock"
"""Name of the lock file in a temporary folder; it is locked as long as its writer runs."""
YOUNG = 60.0
"""Age of a temporary folder, s, up to which its lock file may not exist yet."""


@contextmanager
def _explain_refusals(place: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ValueError(f"cannot write {place}: {error.strerror or error}") from error


def writable_folder(path: Path) -> Path:
    """Return a folder's path unchanged, or raise ValueError if files cannot be written there; it is not
    created.
    """
    with _explain_refusals(f"to folder {path}"):
        there = next(place for place in (path, *path.absolute().parents) if place.exists())
        with tempfile.TemporaryFile(dir=there):
            pass
    return path


@contextmanager
def _make_folder(path: Path) -> Iterator[None]:
    """Create a folder and its parents; remove those created if the context raises an error."""
    made = [place for place in (path, *path.parents) if not place.exists()]
    path.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for place in made:
            with suppress(OSError):  # it contains other files
                place.rmdir()
        raise


def _lock(handle: int) -> bool:
    """Lock an open file or folder until it is closed; return False if another process has locked it."""
    try:
        if fcntl is None:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined, unused-ignore]
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:  # a file system without locks
        return True
    return True


_CLAIMED: dict[str, int] = {}
"""Paths of the folders that this process has locked, and the handles of their locks."""


def claim_folder(folder: Path) -> None:
    """Lock a folder until this process ends; raise ValueError if another process writes there."""
    name = os.path.realpath(folder)
    if name in _CLAIMED:
        return
    with _explain_refusals(f"to folder {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
        own = (name, os.O_RDONLY) if UNIX else (os.path.join(name, LOCK), os.O_RDWR | os.O_CREAT)
        handle = os.open(*own)
    if not _lock(handle):
        os.close(handle)
        raise ValueError(f"another process writes to {folder}: wait until it ends, or choose another folder")
    _CLAIMED[name] = handle


@contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Lock a folder inside the context; remove folders made for it if they are empty afterwards."""
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    claim_folder(folder)
    name = os.path.realpath(folder)
    try:
        yield
    finally:
        os.close(_CLAIMED.pop(name))
        if not UNIX:
            Path(name, LOCK).unlink(missing_ok=True)
        for place in made:
            with suppress(OSError):  # it is not empty
                place.rmdir()


def _sweep_unfinished(folder: Path) -> None:
    """Remove temporary folders whose writing processes have ended."""
    for place in folder.glob(f"{UNFINISHED}*"):
        with suppress(OSError):
            if not (place / LOCK).exists():
                if time.time() - place.stat().st_mtime > YOUNG:
                    shutil.rmtree(place)
            else:
                handle = os.open(place / LOCK, os.O_RDWR)
                try:
                    dead = _lock(handle)
                    if dead and UNIX:  # before the lock ends, so that no other process takes it
                        shutil.rmtree(place)
                finally:
                    os.close(handle)
                if dead:
                    shutil.rmtree(place, ignore_errors=True)


def writable_file(path: Path) -> Path:
    """Return a path unchanged, or raise ValueError if no file can be written there; its folder is not
    created.
    """
    with _explain_refusals(f"file {path}"):
        if path.exists() and not path.is_file():
            raise ValueError(f"cannot write file {path}: a folder or device has that name")
        writable_folder(path.parent)
        with suppress(FileNotFoundError):  # the name, too, which can be too long
            _partial(path).stat()
    return path


def _partial(path: Path) -> Path:
    # Next to the target of a link: the link stays.
    place = Path(os.path.realpath(path))
    return place.with_name(f".{place.name}.partial")


@contextmanager
def whole_file(path: Path, patience: float = 0.0) -> Iterator[Path]:
    """Yield the path of a temporary file, which replaces the file at ``path`` if the context ends without
    error.

    A lock excludes other writers.

    Args:
        path: path of the file.
        patience: time to wait for another process that writes it, s.

    Raises:
        ValueError: if it cannot be written.
    """
    partial = _partial(writable_file(path))
    with _explain_refusals(f"file {path}"), _make_folder(path.parent), _hold_alone(partial, patience):
        try:
            yield partial
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
        # From here on a file of this name belongs to the next writer.
        partial.replace(os.path.realpath(path))


@contextmanager
def _hold_alone(partial: Path, patience: float) -> Iterator[None]:
    held = partial if UNIX else partial.with_name(partial.name + LOCK)
    handle = _open_locked(held, partial.name[1:-8], time.monotonic() + patience)
    try:
        partial.touch()
        yield
    finally:
        os.close(handle)
        if held != partial:
            with suppress(OSError):  # the next writer has it open
                held.unlink()


def _open_locked(partial: Path, name: str, until: float) -> int:
    """Open and lock a file, with attempts until a time of the monotonic clock, s; return its handle."""
    while True:
        handle = os.open(partial, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if _lock(handle):
                # Meanwhile the other process may have moved it into its place.
                with suppress(FileNotFoundError):
                    if os.path.samestat(os.fstat(handle), os.stat(partial)):
                        return handle
            elif time.monotonic() >= until:
                raise ValueError(f"another process writes {name} now: wait until it ends, or write elsewhere")
            else:
                time.sleep(0.02)
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


@contextmanager
def _hold(path: Path) -> Iterator[Path]:
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        _lock(handle)
        yield path
    finally:
        os.close(handle)


@contextmanager
def whole_files(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder, whose files are moved into ``folder`` if the context ends without error."""
    writable_folder(folder)
    with (
        _explain_refusals(f"to folder {folder}"),
        _make_folder(folder),
        tempfile.TemporaryDirectory(dir=folder, prefix=UNFINISHED, ignore_cleanup_errors=True) as waiting,
        _hold(Path(waiting) / LOCK) as lock,
    ):
        _sweep_unfinished(folder)
        yield Path(waiting)
        complete = [path for path in Path(waiting).rglob("*") if path.is_file() and path != lock]
        places = [folder / path.relative_to(waiting) for path in complete]
        for place in places:
            writable_file(place)
        for path, place in zip(complete, places, strict=True):
            place.parent.mkdir(parents=True, exist_ok=True)
            path.replace(place)


def _beside(folder: Path) -> tuple[Path, Path]:
    return folder.with_name(folder.name + ".partial"), folder.with_name(folder.name + ".old")


def find_folder(folder: Path) -> Path:
    """Return the path with a folder's contents: itself, or a neighbour if :func:`whole_folder` was
    interrupted.
    """
    partial, old = _beside(folder)
    if folder.exists() or not old.exists():
        return folder
    return partial if partial.exists() else old


def settle_folder(folder: Path) -> None:
    """Finish replacing a folder if a crash interrupted it, and remove the leftover copies."""
    found = find_folder(folder)
    if found != folder:
        with _explain_refusals(f"folder {folder}"):
            found.rename(folder)
    for leftover in _beside(folder):
        shutil.rmtree(leftover, ignore_errors=True)


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """Yield the path of a temporary folder, which replaces ``folder`` if the context ends without error."""
    settle_folder(folder)
    partial, old = _beside(folder)
    with _explain_refusals(f"folder {folder}"), _make_folder(folder.parent):
        try:
            partial.mkdir()
            yield partial
            if folder.exists():
                folder.rename(old)
            partial.rename(folder)
        finally:
            if find_folder(folder) == folder:
                for leftover in (partial, old):
                    shutil.rmtree(leftover, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write a text to a file, in UTF-8, atomically."""
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")
