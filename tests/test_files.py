"""Files and folders are whole or as they were."""

from pathlib import Path

import pytest
from filtergym.evaluation.files import whole_file, whole_folder, writable_folder, write_text


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
