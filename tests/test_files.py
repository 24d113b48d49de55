"""Files and folders are whole or as they were."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from filtergym.evaluation.storage.files import (
    claim_folder,
    whole_file,
    whole_files,
    whole_folder,
    writable_folder,
    write_text,
)


def test_a_file_takes_its_place_when_it_is_complete(tmp_path):
    path = tmp_path / "new" / "table.json"
    write_text(path, "first")
    with whole_file(path) as partial:
        partial.write_text("second", encoding="utf-8")
        assert path.read_text(encoding="utf-8") == "first"
    assert path.read_text(encoding="utf-8") == "second"
    assert list(path.parent.iterdir()) == [path]


def test_a_failure_leaves_the_file_before(tmp_path):
    path = tmp_path / "table.json"
    write_text(path, "first")

    def write_half():
        with whole_file(path) as partial:
            partial.write_text("half", encoding="utf-8")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert path.read_text(encoding="utf-8") == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_leaves_the_folder_before(tmp_path):
    folder = tmp_path / "checkpoint"
    for text in ("first", "second"):
        with whole_folder(folder) as partial:
            write_text(partial / "model", text)

    def write_half():
        with whole_folder(folder) as partial:
            write_text(partial / "model", "half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert (folder / "model").read_text(encoding="utf-8") == "second"


def test_a_folder_that_cannot_be_written_to_gets_one_sentence():
    with pytest.raises(ValueError, match="cannot write to folder /proc/nowhere"):
        writable_folder(Path("/proc/nowhere"))


# --- other processes


@pytest.fixture
def writer(tmp_path):
    """A process that writes a line and waits; ended after the test."""
    begun = []

    def begin(program):
        process = subprocess.Popen(
            [sys.executable, "-c", AS_HERE + program, str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        begun.append(process)
        assert process.stdout.readline() == "here\n"
        return process

    yield begin
    for process in begun:
        process.kill()
        process.wait()
        process.stdout.close()


FILES = """
import sys, time, pathlib
from filtergym.evaluation.storage.files import whole_files
with whole_files(pathlib.Path(sys.argv[1])) as waiting:
    (waiting / "half").write_text("half")
    print("here", flush=True)
    time.sleep(60)
"""
AS_HERE = "import without_unix\n" if "without_unix" in sys.modules else ""
"""Before the program of another process: `make test-without-unix`."""
ONE_FILE = """
import sys, time, pathlib
from filtergym.evaluation.storage.files import whole_file
with whole_file(pathlib.Path(sys.argv[1]) / "table") as partial:
    partial.write_text("half")
    print("here", flush=True)
    time.sleep(60)
"""
CLAIM = """
import sys, time, pathlib
from filtergym.evaluation.storage.files import claim_folder
claim_folder(pathlib.Path(sys.argv[1]))
print("here", flush=True)
time.sleep(60)
"""


def test_what_a_dead_writer_left_is_swept_and_a_living_one_is_left_alone(tmp_path, writer):
    first, second = writer(FILES), writer(FILES)
    assert len(list(tmp_path.glob(".unfinished-*"))) == 2
    first.kill()
    first.wait()
    with whole_files(tmp_path) as waiting:
        (waiting / "table").write_text("whole")
        assert len(list(tmp_path.glob(".unfinished-*"))) == 2  # of the second one and this
    assert {path.name for path in tmp_path.iterdir() if not path.name.startswith(".")} == {"table"}
    second.kill()
    second.wait()
    old = tmp_path / ".unfinished-of-a-version-before"
    old.mkdir()
    os.utime(old, (time.time() - 1e4, time.time() - 1e4))
    with whole_files(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["table"]


def test_two_writers_of_a_file_or_a_folder_do_not_mix(tmp_path, writer):
    process = writer(ONE_FILE)
    with pytest.raises(
        ValueError, match="another process writes table now: wait until it ends, or write elsewhere"
    ):
        write_text(tmp_path / "table", "mine")
    process.kill()
    process.wait()
    write_text(tmp_path / "table", "mine")
    assert [path.name for path in tmp_path.iterdir()] == ["table"]
    process = writer(CLAIM)
    with pytest.raises(
        ValueError, match=r"another process writes to .*: wait until it ends, or choose another folder"
    ):
        claim_folder(tmp_path)
    process.kill()
    process.wait()
    claim_folder(tmp_path)
    claim_folder(tmp_path)  # its own already


def test_a_terminated_command_removes_what_is_unfinished(tmp_path, writer):
    program = FILES.replace(
        "import sys, time, pathlib", "import sys, time, pathlib\nfrom filtergym.__main__ import main"
    )
    program = program.replace("with whole_files", "def work(*_, **__):\n  with whole_files").replace(
        "\n    ", "\n      "
    )
    process = writer(program + "\nmain(lambda: work)\n")
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == []
