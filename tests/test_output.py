"""What cannot be printed or written loses nothing else, and ends in one sentence."""

import io
import json
import os
import shutil
import subprocess
import sys

import commands
import pytest

from filtergym import evaluate
from filtergym.__main__ import main
from filtergym.agents.learned_policy import PRETRAINED
from filtergym.baselines.problem import problem_of
from filtergym.commands.terminal import console
from filtergym.reports.tables import benchmark

EVALUATE = ("evaluate", "ManeuveringTarget", "--scenario", "paper", "--policy", "imm", "--episodes", 4)


def closed_pipe():
    reading, writing = os.pipe()
    os.close(reading)
    return open(writing, "w", encoding="utf-8")


def full_disk():
    return open("/dev/full", "w", encoding="utf-8")


def ascii_only():
    return io.TextIOWrapper(io.BytesIO(), encoding="ascii")


class Drawn:
    """A figure that costs nothing."""

    def savefig(self, path, **_):
        path.write_bytes(b"drawn")


@pytest.fixture(scope="module")
def dataset():
    return evaluate("ManeuveringTarget", ["imm"], "paper", episodes=4)


@pytest.fixture
def run(command, monkeypatch, tmp_path, dataset):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("filtergym.evaluation.running.summary.run_competitors", lambda *_, **__: dataset)
    monkeypatch.setattr(
        "filtergym.commands.evaluation.evaluation_figures", lambda *_, **__: [("figure", Drawn())]
    )
    monkeypatch.setattr("filtergym.reports.pages.html_report.report_html", lambda *_, **__: "<html></html>")

    def ran(*words, output=None, program=main):
        if output is not None:
            monkeypatch.setattr("sys.stdout", output)
        code, _, errors = command(*words, program=program)
        return code, errors

    yield ran
    console.quiet, console.refusal = True, None
    console.print()  # nothing: what is left from a refused print goes
    console.quiet = False


@pytest.mark.parametrize(("output", "code"), [(closed_pipe, 0), (full_disk, 2), (lambda: None, 0)])
def test_results_are_written_whatever_becomes_of_standard_output(output, code, run, tmp_path, monkeypatch):
    if output is full_disk and not os.path.exists("/dev/full"):
        pytest.skip("this system has no full device")
    stream = output()
    if stream is None:
        monkeypatch.setattr("sys.stdout", None)
    ended, error = run(*EVALUATE, "--json", "a.json", "--out", "out", output=stream)
    assert ended == code
    expected = "Error: cannot write to standard output: No space left on device\n" if code else ""
    assert error == expected
    assert json.loads((tmp_path / "a.json").read_text()) == json.loads(
        (tmp_path / "out/records.json").read_text()
    )
    assert (tmp_path / "out" / "figure.png").read_bytes() == b"drawn"
    if stream is not None:
        stream.close()


def test_work_goes_on_after_a_print_that_failed(run, tmp_path, monkeypatch):
    cells = [
        benchmark.Cell(problem_of("ManeuveringTarget"), name, 4, ("imm",)) for name in ("paper", "random")
    ]
    monkeypatch.setattr(benchmark, "cells", lambda *_: cells)
    with closed_pipe() as output:
        code, errors = run("benchmark", "--out", "out", output=output)
    assert (code, errors.count("1 competitor over 4 episodes")) == (0, len(errors.splitlines()))
    kept = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [result["scenario"] for result in kept["results"]] == ["paper", "random"]
    assert "<html" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_what_has_no_character_is_escaped(run):
    output = ascii_only()
    run("list", "UavAutopilot", output=output)
    output.flush()
    text = output.buffer.getvalue().decode("ascii")
    assert "filtergym/UavAutopilot-v0" in text
    console.print("σ = 3°")
    output.flush()
    assert output.buffer.getvalue().decode("ascii").endswith("\\u03c3 = 3\\xb0\n")


def test_an_output_that_has_a_folders_name_is_refused_before_the_work(run, tmp_path, monkeypatch):
    def unexpected(*_, **__):
        raise AssertionError("the work began")

    monkeypatch.setattr("filtergym.commands.evaluation.run_requests", unexpected)
    monkeypatch.setattr("filtergym.reports.tables.benchmark.summaries", unexpected)
    monkeypatch.setattr("filtergym.commands.improve.tune", unexpected)
    shipped, best = PRETRAINED / "ManeuveringTarget-v0" / "bptt", tmp_path / "run" / "best"
    for name in ("folder.png", "out/results.json", "values/ManeuveringTarget-v0.json"):
        (tmp_path / name).mkdir(parents=True)
    best.mkdir(parents=True)
    shutil.copyfile(shipped.with_suffix(".safetensors"), best / "agent.safetensors")
    shutil.copyfile(shipped.with_suffix(".json"), best.parent / "run.json")
    for words in (
        (*EVALUATE, "--json", "folder.png"),
        (*EVALUATE, "--json", "."),
        (*EVALUATE, "--json", "/dev/null"),
        ("benchmark", "--out", "out"),
        ("seeds", "run", "--curves", "folder.png"),
        ("seeds", "run", "--out", "folder.png"),
        ("tune", "ManeuveringTarget", "--policy", "imm", "--out", "values"),
    ):
        code, error = run(*words, program=commands.main if words[0] == "seeds" else main)
        assert (code, error.count("\n")) == (2, 1), words
        assert "a folder or device has that name" in error, words
    assert run(*EVALUATE, "--json", "n" * 300 + ".json")[1].endswith("File name too long\n")
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and "run" not in path.parts]


def test_a_full_disk_is_one_sentence_and_leaves_the_results_before(run, tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "records.json").write_text("[]")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def no_space(figure, path):
        path.write_bytes(b"half")
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("filtergym.commands.evaluation.save", no_space)
    code, error = run(*EVALUATE, "--seed", 1, "--out", "out")
    assert (code, error) == (2, "Error: cannot write to folder out: No space left on device\n")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


STOPS_WHILE_IT_WRITES = """
import sys, time
from filtergym.commands import evaluation
def stop(figure, path):
    path.write_bytes(b"half")
    print("here", file=sys.__stdout__, flush=True)
    time.sleep(60.0)
evaluation.save = stop
sys.stdout = sys.stderr  # of the tables
"""


def test_a_second_run_into_a_folder_is_refused_while_the_first_writes(run, tmp_path):
    """What the first, which is killed then, has left is not taken for a result."""
    program = STOPS_WHILE_IT_WRITES
    words = [*map(str, EVALUATE), "--backend", "numpy", "--set", "horizon=5", "--out", "out"]
    program += f"from filtergym.__main__ import main\nsys.argv = {['filtergym', *words]}\nmain()\n"
    first = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert first.stdout.readline() == "here\n"
        refused = "Error: another process writes to out: wait until it ends, or choose another folder\n"
        assert run(*EVALUATE, "--out", "out") == (2, refused)
        assert not [path for path in (tmp_path / "out").iterdir() if not path.name.startswith(".unfinished-")]
    finally:
        first.kill()
        first.wait()
        first.stdout.close()
    assert run(*EVALUATE, "--out", "out")[0] == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert "results.json" in names
    assert (tmp_path / "out" / "figure.png").read_bytes() == b"drawn"
    assert not [name for name in names if name.startswith(".")]


@pytest.mark.skipif(
    sys.platform != "linux", reason="limits of files and folders that take nothing are Linux's here"
)
def test_a_file_that_may_not_grow_and_a_home_that_takes_nothing(tmp_path):
    """The limit ends it in one sentence and leaves no half of anything; caches are done without."""
    program = "import resource, runpy, sys\n"
    program += "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)),) * 2)\n"
    program += "runpy.run_module('filtergym', run_name='__main__')\n"
    words = [*map(str, EVALUATE), "--set", "horizon=5", "--json", "records.json"]
    for most, code, backend in ((2_000, 2, "numpy"), (1 << 30, 0, "auto")):
        done = subprocess.run(
            [sys.executable, "-c", program, str(most), *words, "--backend", backend], check=False, cwd=tmp_path,
            capture_output=True, text=True, env={**os.environ, "HOME": "/proc", "XDG_CACHE_HOME": "/proc"},
        )  # fmt: skip
        assert done.returncode == code, done.stderr
        if code:
            assert done.stderr == "Error: cannot write file records.json: File too large\n"
            assert not [*tmp_path.iterdir()]
    assert json.loads((tmp_path / "records.json").read_text())
