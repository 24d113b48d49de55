"""What compiled code is kept for: the next process, and nothing that goes wrong on the way is anybody's trouble."""

import errno
import hashlib
import os
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest

from filtergym.compiler import cache, native
from filtergym.compiler.functions import CompiledFunction
from filtergym.compiler.program import Graph

pytest.importorskip("llvmlite")

NUMBERS = np.linspace(0.0, 7.0, 8)
TIME = 1_700_000_000
"""Seconds, long ago."""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Folder of the cache; not there yet."""
    monkeypatch.setenv(cache.SWITCH, str(tmp_path / "above" / "compiled"))
    return tmp_path / "above" / "compiled"


@pytest.fixture
def loaded(monkeypatch):
    """Load a small program as a new process would; returns how often it was compiled."""
    compiled = []
    monkeypatch.setattr(
        cache, "store", lambda name, code, store=cache.store: (compiled.append(name), store(name, code))
    )

    def load():
        monkeypatch.setattr(native, "_CODES", {})
        compiled.clear()
        result = CompiledFunction(lambda x: x * 2.5 + x, Graph())(NUMBERS)
        np.testing.assert_array_equal(result, NUMBERS * 2.5 + NUMBERS)
        return len(compiled)

    return load


def files(place):
    return sorted(path.name for path in place.iterdir())


def test_the_next_process_need_not_compile(place, loaded):
    assert loaded() == 1
    assert len(files(place)) == 1
    assert loaded() == 0
    assert len(files(place)) == 1
    if os.name == "posix":  # no other user may write what is going to be executed
        assert place.stat().st_mode & 0o777 == 0o700


def test_every_processor_has_code_of_its_own(place, loaded, monkeypatch):
    assert loaded() == 1
    for processor in ("generic", "generic,+sse3"):
        monkeypatch.setenv(native.PROCESSOR, processor)
        assert [loaded(), loaded()] == [1, 0]
    monkeypatch.setenv(native.PROCESSOR, "generic,avx2")
    with pytest.raises(ValueError, match=r"expected \+FEATURE or -FEATURE, got 'avx2'"):
        loaded()


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: b"",
        lambda whole: whole[:20],
        lambda whole: whole[:-1],
        lambda whole: whole + b"more",
        lambda whole: whole[:100] + bytes([whole[100] ^ 1]) + whole[101:],
        lambda whole: bytes([whole[0] ^ 1]) + whole[1:],
    ],
    ids=["empty", "beginning", "truncated", "longer", "changed", "other checksum"],
)
def test_a_damaged_entry_is_replaced(place, loaded, damage):
    loaded()
    entry = next(place.iterdir())
    whole = entry.read_bytes()
    entry.write_bytes(damage(whole))
    assert loaded() == 1
    assert hashlib.sha256(entry.read_bytes()[32:]).digest() == entry.read_bytes()[:32]
    assert loaded() == 0


def test_off_keeps_nothing(tmp_path, loaded, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(cache.SWITCH, "off")
    assert cache.folder() is None
    assert [loaded(), loaded()] == [1, 1]
    assert not files(tmp_path)


def test_the_default_folder_is_the_users(monkeypatch):
    platformdirs = pytest.importorskip("platformdirs")
    monkeypatch.delenv(cache.SWITCH, raising=False)
    assert cache.folder().is_relative_to(platformdirs.user_cache_path("filtergym"))


def test_a_folder_that_is_a_file_is_left_alone(place, loaded):
    place.parent.mkdir()
    place.write_text("mine")
    assert [loaded(), loaded()] == [1, 1]
    assert place.read_text() == "mine"


def refuse(*_, **__):
    raise PermissionError(errno.EACCES, "refused")


@pytest.mark.parametrize("call", ["pathlib.Path.mkdir", "tempfile.mkstemp", "os.replace"])
def test_a_folder_that_cannot_be_written_is_no_trouble(place, loaded, call, monkeypatch):
    monkeypatch.setattr(call, refuse)
    assert [loaded(), loaded()] == [1, 1]
    assert not place.exists() or not files(place)


def test_a_folder_that_cannot_be_read_is_no_trouble(place, loaded, monkeypatch):
    loaded()
    monkeypatch.setattr("os.open", refuse)
    assert loaded() == 1


SOMEBODY = 65534
"""Another user."""
posix = pytest.mark.skipif(os.name != "posix", reason="there are no owners")
as_root = pytest.mark.skipif(
    os.name != "posix" or os.getuid() != 0, reason="only root can act as another user"
)


def exchange(place, loaded):
    """Put the code of another program in place of the small program's, with the right checksum."""
    loaded()
    [entry] = place.iterdir()
    CompiledFunction(lambda x: x * 7.0, Graph())(NUMBERS)
    [other] = set(place.iterdir()) - {entry}
    return other.replace(entry)


def link(path):
    path.rename(path.with_name("elsewhere"))
    path.symlink_to(path.with_name("elsewhere"))


@posix
@pytest.mark.parametrize(
    ("of_folder", "change", "reason"),
    [
        (True, lambda path: path.chmod(0o777), r"others may write to .* \(mode 777\)"),
        (True, lambda path: path.chmod(0o770), r"others may write to .* \(mode 770\)"),
        (False, lambda path: path.chmod(0o666), r"others may write to .* \(mode 666\)"),
        (True, link, "the folder is a symbolic link"),
        (False, link, None),
        (False, lambda path: (path.unlink(), os.mkfifo(path)), None),
        pytest.param(True, lambda path: os.chown(path, SOMEBODY, 0), "belongs to user 65534", marks=as_root),
        pytest.param(False, lambda path: os.chown(path, SOMEBODY, 0), "belongs to user 65534", marks=as_root),
    ],
)
def test_what_somebody_else_can_have_written_is_not_executed(place, loaded, of_folder, change, reason):
    entry = exchange(place, loaded)
    change(place if of_folder else entry)
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        assert [loaded(), loaded()] == [1, int(of_folder)]  # which checks what comes out
    messages = [str(warning.message) for warning in noted]
    assert len(messages) == (reason is not None)
    assert all(re.search(reason, text) and str(place) in text and cache.SWITCH in text for text in messages)


def test_an_entry_that_cannot_be_touched_is_used(place, loaded, monkeypatch):
    loaded()
    monkeypatch.setattr("os.utime", refuse)
    assert loaded() == 0


def test_a_full_disk_leaves_no_partial_file(place, loaded, monkeypatch):
    class Full:
        def __init__(self, handle, mode):
            os.close(handle)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def write(self, _):
            raise OSError(errno.ENOSPC, "no space left")

    with monkeypatch.context() as patch:
        patch.setattr("os.fdopen", Full)
        assert loaded() == 1
        assert not files(place)
    assert [loaded(), loaded()] == [1, 0]


def test_the_folder_stays_below_its_limit_and_what_was_used_stays(place, monkeypatch):
    monkeypatch.setattr(cache, "LIMIT", 1000)
    monkeypatch.setattr(cache, "SLACK", 0)  # look after every entry
    for age, name in enumerate(("c", "b", "a")):
        cache.store(name, b"." * 268)  # 300 with its checksum
        os.utime(place / f"{name}{cache.SUFFIX}", (TIME - age, TIME - age))
    assert cache.load("a") == b"." * 268  # the oldest, but used: now the youngest
    (place / "mine.txt").write_bytes(b"." * 5000)
    os.utime(place / "mine.txt", (0, 0))
    cache.store("d", b"." * 268)
    assert [name for name in "abcd" if cache.load(name) is not None] == ["a", "c", "d"]
    # What is not the cache's own does not count and does not go.
    assert (place / "mine.txt").exists()
    cache.store("e", b"." * 2000)
    assert files(place) == ["mine.txt"]


def test_names_tell_texts_apart():
    names = {
        cache.key(*texts)
        for texts in (("a", "b"), ("ab",), ("a", "b", ""), ("", "ab"), ("b", "a"), ("1:a", "b"))
    }
    assert len(names) == 6


SCRIPT = """
import numpy
from filtergym.compiler import cache, namespace
from filtergym.compiler.functions import CompiledFunction
from filtergym.compiler.program import Graph
compiled = []
store = cache.store
cache.store = lambda *entry: (compiled.append(entry), store(*entry))
result = CompiledFunction(lambda x: namespace.exp(x) * namespace.sin(x) / 3.0 + x, Graph())(numpy.arange(16.0))
print(len(compiled), result.tobytes().hex())
"""


def test_another_process_finds_the_same_entry(place):
    def run(seed):
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        words = [sys.executable, "-c", SCRIPT]
        return subprocess.run(
            words, env=environment, capture_output=True, text=True, check=True
        ).stdout.split()

    first, second = run("1"), run("2")
    assert first[0] == "1"
    assert second == ["0", first[1]]
    assert len(files(place)) == 1
