"""A full disk or a crash at any step of writing leaves every file and folder whole, old or new."""

import contextlib
import errno
import os
import pathlib
from dataclasses import replace

import pytest

from filtergym.agents import training_session
from filtergym.agents.training_run import RunOptions, best_agent, load_run, new_run, resume_run
from filtergym.agents.training_session import Bookkeeping, Session, Trainee
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.storage.files import (
    find_folder,
    settle_folder,
    whole_files,
    whole_folder,
    write_text,
)

STEPS = ("open", "replace", "rename", "mkdir", "unlink", "rmdir")
"""Calls of the operating system that change the disk."""


class CrashError(BaseException):
    """The end of the process: nothing after it is carried out."""


class Faults:
    """Refuses the call number ``at``: that one alone, every one that needs space from there on, or all."""

    def __init__(self, monkeypatch, at, kind):
        self.at, self.kind, self.calls = at, kind, 0
        for name in STEPS:
            monkeypatch.setattr(os, name, self.refusing(name, getattr(os, name)))
        # Two steps each: the file is made, then filled, by half where that is refused.
        for name in ("write_text", "write_bytes"):
            monkeypatch.setattr(pathlib.Path, name, self.half_writing(getattr(pathlib.Path, name)))

    def step(self, needs_space=True):
        self.calls += 1
        if self.calls == self.at or (self.calls > self.at > 0 and self.kind != "once"):
            if self.kind == "crash":
                raise CrashError
            if needs_space or self.calls == self.at:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def refusing(self, name, original):
        def call(*arguments, **keywords):
            self.step(name not in ("unlink", "rmdir"))
            return original(*arguments, **keywords)

        return call

    def half_writing(self, original):
        def write(path, content, **keywords):
            self.step()
            original(path, content[: len(content) // 2], **keywords)
            self.step()
            return original(path, content, **keywords)

        return write


def refusal(write, place):
    """The sentence that a disturbed operation ends with, if it does not succeed all the same."""
    try:
        write(place)
    except ValueError as error:
        return str(error)
    return ""


def every_fault(monkeypatch, kind, prepare, write, check):
    """Count the faults that an operation meets, each in a fresh place, and check what it leaves.

    Args:
        prepare: makes the place.
        write: what is disturbed there.
        check: what must hold there afterwards, whatever happened.
    """
    at = 0
    while True:
        place = prepare(at)
        with monkeypatch.context() as patch:
            faults = Faults(patch, at + 1, kind)
            with contextlib.suppress(CrashError):
                message = refusal(write, place)
                assert not message or ("cannot write" in message and "No space left on device" in message)
        check(place)
        if faults.calls <= at:
            return at
        at += 1


def put_folder(place, content):
    with whole_folder(place / "x") as partial:
        for name in ("a", "b"):
            (partial / name).write_text(content)


def put_files(place, content):
    with whole_files(place) as waiting:
        for name in ("a", "b"):
            write_text(waiting / name, content)


WRITERS = {
    "file": (lambda place, content: write_text(place / "x", content), lambda place: [place / "x"]),
    "files": (put_files, lambda place: [place / "a", place / "b"]),
    "folder": (put_folder, lambda place: [find_folder(place / "x") / name for name in ("a", "b")]),
}


@pytest.mark.parametrize("kind", ["once", "full", "crash"])
@pytest.mark.parametrize("before", ["", "old old old"])
@pytest.mark.parametrize("writer", WRITERS)
def test_old_or_new_is_whole_after_a_fault_at_any_step(writer, before, kind, monkeypatch, tmp_path):
    put, files = WRITERS[writer]

    def prepare(at):
        place = tmp_path / str(at)
        place.mkdir()
        if before:
            put(place, before)
        return place

    def check(place):
        texts = [path.read_text() if path.exists() else "" for path in files(place)]
        assert set(texts) <= {before, "new new new"}
        if writer == "folder":
            assert len(set(texts)) == 1
            settle_folder(place / "x")
            assert [path.read_text() if path.exists() else "" for path in files(place)] == texts
            assert {path.name for path in place.iterdir()} <= {"x"}
        put(place, "later")
        assert {path.read_text() for path in files(place)} == {"later"}

    met = every_fault(monkeypatch, kind, prepare, lambda place: put(place, "new new new"), check)
    assert met >= 6


class _Costs:
    """A validation whose costs fall."""

    paper = None

    def __init__(self, run):
        self.run = run

    def score(self, policy):
        return {"steps": self.run.steps_done, "cost": 1.0 / self.run.steps_done}


@pytest.mark.parametrize("kind", ["once", "full", "crash"])
@pytest.mark.parametrize("points", [1, 2])
def test_a_run_is_resumed_after_a_fault_at_any_step(points, kind, monkeypatch, tmp_path):
    pytest.importorskip("yaml")
    monkeypatch.setattr(training_session, "Validation", _Costs)

    wanted = new_run(problem_of("ManeuveringTarget"), RunOptions("bptt", steps=1000, envs=2))

    def asked():
        return replace(wanted, validation=[])

    def books_of(folder, run):
        def save(place):
            (place / "agent.safetensors").write_text(str(run.steps_done))

        return Bookkeeping(run, Session(folder, validate_every=100), Trainee(None, save, save), lambda: False)

    def prepare(at):
        folder = tmp_path / str(at)
        folder.mkdir()
        books = books_of(folder, asked())
        for point in range(1, points):
            books.safe_point(100 * point)
        return folder, books

    def check(place):
        folder, _ = place
        if not find_folder(folder / "checkpoint").exists():
            assert points == 1  # a first checkpoint that was not completed is none
            assert not (folder / "run.json").exists()
            return
        best = int(best_agent(folder).read_text())
        run = resume_run(folder, asked())
        assert run.steps_done in {100, 100 * points}
        assert int((folder / "checkpoint" / "agent.safetensors").read_text()) == run.steps_done
        assert [entry["steps"] for entry in run.validation] == list(range(100, run.steps_done + 1, 100))
        # The best agent is saved first: a resumed run will validate and save the same one again.
        assert best in (run.steps_done, 100 * points)
        assert load_run(folder).steps_done == run.steps_done
        books_of(folder, run).safe_point(100 * (points + 1))
        assert load_run(folder).steps_done == int(best_agent(folder).read_text()) == 100 * (points + 1)

    def write(place):
        _, books = place
        books.safe_point(100 * points)

    assert every_fault(monkeypatch, kind, prepare, write, check) > 20
