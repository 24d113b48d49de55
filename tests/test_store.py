"""The store of unfinished work: what it is given is what it gives back, of the same content, name and type only."""

from typing import NamedTuple

import msgspec
import numpy as np
import pytest
import xarray

from filtergym.evaluation.storage import store as module
from filtergym.evaluation.storage.store import Store, Work


class Measured(NamedTuple):
    value: float
    name: str


class Outcome(NamedTuple):
    measured: list[Measured]
    costs: np.ndarray | None
    curves: dict[str, np.ndarray]
    head: xarray.Dataset
    number: int


def outcome(costs=None):
    dataset = xarray.Dataset(
        {"x": (("policy", "time"), np.array([[0.1, np.nan]]))},
        {"policy": ["imm"]},
        {"paper": "imm", "seed": 3},
    )
    measured = [
        Measured(0.1 + 0.2, "rmse"),
        Measured(float("nan"), "lost"),
        Measured(np.float64(np.inf), "x"),
    ]
    curves = {"rmse": np.arange(6.0).reshape(2, 3).T, "none": np.zeros((0, 2)), "mean": np.array(1.5)}
    return Outcome(measured, costs, curves, dataset, 7)


WORK = Work("ManeuveringTarget-v0.imm", "content")


@pytest.mark.parametrize("costs", [None, np.array([1, 2, 3], dtype=np.int32)])
def test_every_bit_comes_back(tmp_path, costs):
    given = outcome(costs)
    Store(tmp_path).write(WORK, given)
    found = Store(tmp_path).read(WORK, Outcome)
    assert type(found) is Outcome
    assert [type(each) for each in found.measured] == [Measured] * 3
    np.testing.assert_equal(found.measured, given.measured)
    np.testing.assert_equal(found.costs, costs)
    assert costs is None or found.costs.dtype == costs.dtype
    for name, values in given.curves.items():
        np.testing.assert_array_equal(found.curves[name], values, strict=True)
        found.curves[name][...] = 0.0  # one's own, as what was given
    xarray.testing.assert_identical(found.head, given.head)
    assert found.head.attrs == given.head.attrs
    assert (found.number, type(found.head.attrs["seed"])) == (7, int)


def test_another_content_name_or_code_is_another_piece(tmp_path, monkeypatch):
    store = Store(tmp_path)
    store.write(WORK, 1.0)
    assert store.read(WORK, float) == 1.0
    assert store.read(WORK._replace(content="other"), float) is None
    assert store.read(WORK._replace(name="other"), float) is None
    assert store.result(WORK, float, lambda: 2.0) == 1.0
    monkeypatch.setattr(module, "code_digest", lambda: "of an edited package")
    assert store.read(WORK, float) is None
    assert store.result(WORK, float, lambda: 2.0) == 2.0
    assert store.read(WORK, float) == 2.0


@pytest.mark.parametrize(
    "content", [b"", b"half", msgspec.msgpack.encode([1, 2]), msgspec.msgpack.encode("a" * 9)]
)
def test_what_is_no_result_is_made_again(tmp_path, content):
    store = Store(tmp_path)
    for kind, whole in ((float, 1.0), (np.ndarray, np.zeros(2)), (xarray.Dataset, outcome().head)):
        store.write(WORK, whole)
        [file] = tmp_path.iterdir()
        for foreign in (content, file.read_bytes()[:-9]):
            file.write_bytes(foreign)
            assert store.read(WORK, kind) is None
        file.unlink()


def test_objects_are_neither_written_nor_read(tmp_path):
    store = Store(tmp_path)
    with pytest.raises(NotImplementedError, match="a Store cannot be stored"):
        store.write(WORK, store)
    assert not list(tmp_path.iterdir())
    store.write(WORK, ("|O", (1,), b"\0" * 8))
    assert store.read(WORK, np.ndarray) is None


def test_nothing_is_stored_without_a_folder_or_for_unknown_competitors(tmp_path):
    for store, work in ((Store(), WORK), (Store(tmp_path / "new"), None)):
        assert store.result(work, float, lambda: 1.0) == 1.0
        assert store.read(work, float) is None
        store.clear()
    assert not (tmp_path / "new").exists()


def test_only_its_own_files_are_removed(tmp_path):
    folder = tmp_path / "unfinished"
    other = Work("of another command", "content")
    Store(folder).write(other, 1.0)
    [others] = folder.iterdir()
    (folder / f"{WORK.name}.txt").write_text("mine")
    store = Store(folder)
    store.write(WORK._replace(content="of other values"), 1.0)
    (own,) = set(folder.iterdir()) - {others, folder / f"{WORK.name}.txt"}
    own.with_name(f".{own.name}.partial").write_text("left by a crash")
    store = Store(folder)
    assert store.read(WORK, float) is None
    store.clear()
    assert set(folder.iterdir()) == {others, folder / f"{WORK.name}.txt"}
    (folder / f"{WORK.name}.txt").unlink()
    store = Store(folder)
    assert store.read(other, float) == 1.0
    store.clear()
    assert not folder.exists()


def test_a_name_is_no_path(tmp_path):
    for name in ("../escaped", "/escaped", "a/b", "..", "a\nb"):
        Store(tmp_path / "unfinished").write(Work(name, ""), 1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["unfinished"]
    assert all(path.is_file() for path in (tmp_path / "unfinished").iterdir())


def test_what_cannot_be_kept_is_a_warning(tmp_path):
    """The work goes on: space for its result may be there."""
    (tmp_path / "full").touch()
    store = Store()
    store.folder = tmp_path / "full"
    with pytest.warns(UserWarning, match="cannot write .*after an interruption it is computed again"):
        assert store.result(WORK, float, lambda: 1.0) == 1.0
