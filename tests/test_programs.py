"""Programs as competitors: what they receive, what becomes of their mistakes, and that nothing is left of them."""

import contextlib
import json
import os
import py_compile
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from models import make_model
from test_wall import without

from filtergym.baselines.problem import problem_of
from filtergym.compiler.functions import leaves
from filtergym.envs.contract.filter import Initial
from filtergym.envs.contract.task import Component, named_arrays
from filtergym.evaluation.competitors import program_process
from filtergym.evaluation.competitors.program_process import (
    ENDED,
    LATE,
    WRONG,
    Limits,
    ProgramProcess,
    quickest_form,
)
from filtergym.evaluation.competitors.programs import (
    LIMITS,
    ArrayField,
    Program,
    ProgramEstimator,
    limit_programs,
    rows_of,
)
from filtergym.evaluation.running.rollout import measure_time, rollout, start_lanes
from filtergym.evaluation.storage.dataset import FAULTS
from filtergym.names import competitor, find_competitors

ID = "filtergym/ManeuveringTarget-v0"
EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"
CLIENTS = EXAMPLES / "programs"
LINUX = pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux limits memory and measures processor time"
)

# Holds what it received first; the word behind the file names what goes wrong at the third measurement.
HOLD = """
import json, os, sys, time

def tell(what):
    print(json.dumps(what), flush=True)

how = sys.argv[1]
hello = json.loads(sys.stdin.readline())
if how == "no hello":
    print("welcome", flush=True)
if how == "no licence":
    raise RuntimeError("no licence")
if how == "refuses":
    tell({"error": "it knows other sensors"})
tell({"filtergym": 1, "format": "json"})
own = json.loads(sys.stdin.readline())["initial"]
for k, line in enumerate(sys.stdin):
    if k == 2:
        if how == "crash":
            os.abort()
        if how == "exit":
            sys.exit("disk full")
        if how == "hang":
            time.sleep(100.0)
        if how == "memory":
            bytearray(10**10)
        if how == "shape":
            own["mean"][0] = [1.0]
        if how == "words":
            own["mean"][0][0] = "fast"
        if how == "prints":
            print("debugging")
        if how == "twice":
            print(json.dumps(own))
        if how == "errors":
            print("e" * 1_000_000, file=sys.stderr)
        if how == "one track":
            own["mean"][0][0] = None
        if how == "flood":
            while True:
                print("x" * 10_000, end="")
    tell(own)
    if k == 3 and how == "afterwards":
        time.sleep(0.1)
        tell(own)
"""


def task_of(components=2):
    """A task as far as a program receives it."""
    named = [Component(f"c{i}", "m") for i in range(components)]
    return SimpleNamespace(
        id="mine/Task-v0", components=named, groups={}, companions=(), parameters=None, closes_loop=False
    )


def given(N, components=2):
    """An initial estimate of N tracks, and a measurement."""
    mean = np.arange(float(components * N)).reshape(components, N)
    initial = Initial(mean, np.eye(components)[:, :, None] * np.ones(N))
    return initial, Initial(mean[0], mean)


@pytest.fixture
def hold(tmp_path):
    """Make the command of the program above, with what goes wrong."""
    (tmp_path / "hold.py").write_text(HOLD)
    return lambda how="": f'{sys.executable} {tmp_path / "hold.py"} "{how}"'


def run(command, steps=4, N=8, **limits):
    """Ask a program about some measurements; returns means ``(steps, 2, N)``, and the estimator."""
    estimator = Program(command, Limits(**limits))(task_of())
    estimator.last = steps
    initial, measurement = given(N)
    memory, means = estimator.start(initial, N), []
    for _ in range(steps):
        mean, covariance, memory = estimator.update(memory, measurement)
        assert covariance.shape == (2, 2, N)
        means.append(mean)
    return np.stack(means), estimator


# --- what steers the world

STEER = """
import json, sys
hello, what = json.loads(sys.stdin.readline()), sys.argv[1]
print(json.dumps({"filtergym": 1, "format": "json", "feedback": what != "none"}), flush=True)
own = json.loads(sys.stdin.readline())["initial"]
if what != "none":
    size = hello["numbers"]["feedback"]
    value = {"far": 1e6, "nothing": None}[what]
    own["feedback"] = [[value] * size for _ in range(hello["tracks"])]
for line in sys.stdin:
    print(json.dumps(own), flush=True)
"""


def test_a_program_steers_the_tracking_loops_by_its_numbers(tmp_path):
    """What is no number is not taken, and the loops follow the estimate, as without."""
    (tmp_path / "steer.py").write_text(STEER)
    navigation = make_model("filtergym/TightlyCoupledNavigation-v0", scenario="kinematic", horizon=4)

    def received(what):
        program = Program(f"{sys.executable} {tmp_path / 'steer.py'} {what}")
        return np.stack([e.measurement.available[:8, 0] for e, _ in rollout(navigation, program, [3])])

    usual = received("none")
    assert usual.any()
    np.testing.assert_array_equal(received("nothing"), usual)
    far = received("far")
    np.testing.assert_array_equal(far[0], usual[0])  # the first measurement comes before its first answer
    assert not far[1:].any()


# --- mistakes


@pytest.mark.parametrize(
    ("how", "fault", "first", "words"),
    [
        ("crash", ENDED, 2, "it was ended by SIGABRT"),
        ("exit", ENDED, 2, "it has ended with exit status 1: disk full"),
        ("hang", LATE, 2, "it has not responded within 0.3 s"),
        ("shape", WRONG, 2, "its 'mean' is not 8 lists of 2 numbers"),
        ("words", WRONG, 2, "its 'mean' is not 8 lists of 2 numbers"),
        ("prints", WRONG, 2, "its response is no JSON object: 'debugging"),
        ("twice", WRONG, 3, "it has written more than one response"),
        ("afterwards", WRONG, 3, "it has written more than one response"),
        ("flood", WRONG, 2, "it has responded with a line of more than"),
        ("no hello", WRONG, 0, "its response is no JSON object: 'welcome"),
        ("no licence", ENDED, 0, "it has ended with exit status 1: RuntimeError: no licence"),
        pytest.param("memory", ENDED, 2, "exit status 1: MemoryError", marks=LINUX),
    ],
)
def test_a_mistake_loses_all_tracks_with_its_reason_from_there_on(
    how, fault, first, words, hold, monkeypatch
):
    if how == "hang":
        monkeypatch.setattr(program_process, "END_SECONDS", 0.1)
    with pytest.warns(UserWarning, match=f"measurement {first + 1}: .*; 8 episodes are lost") as noted:
        means, estimator = run(hold(how), seconds=0.3 if how == "hang" else 10.0, memory=1000.0)
    [warning] = [str(one.message) for one in noted if "program" in str(one.message)]
    assert words in warning
    assert estimator.fault == fault
    assert np.isfinite(means[:first]).all()
    assert np.isnan(means[first:]).all()
    assert estimator._process is None


@pytest.mark.parametrize("how", ["", "errors", "one track"])
def test_what_is_no_mistake_loses_nothing(how, hold):
    means, estimator = run(hold(how), N=5)
    assert estimator.fault == 0
    expected = np.stack([given(5)[0].mean] * 4)
    if how == "one track":
        expected[2:, 0, 0] = np.nan  # that track alone, of which the evaluation makes a lost episode
    np.testing.assert_array_equal(means, expected)


def test_a_program_may_take_no_part(hold):
    with pytest.raises(ValueError, match="takes no part: it knows other sensors"):
        run(hold("refuses"))


def test_what_is_no_program_is_refused_before_anything_runs():
    for name, words in (
        ("./no_such", "no program './no_such'"),
        ("'", "is no command"),
        ("", "no program ''"),
    ):
        with pytest.raises(ValueError, match=words):
            competitor(ID, f"exec:{name}")
    with pytest.raises(ValueError, match="a time limit must be above zero"), limit_programs(0.0, 0.0):
        pass
    with limit_programs(3.0, 70.0):
        assert Program("true").limits == LIMITS.get() == (3.0, 70.0)


@pytest.mark.skipif(sys.prefix == sys.base_prefix, reason="this Python runs in no virtual environment")
@pytest.mark.parametrize("name", ["exec:cat", "isolated:lone_module:Missing"])
def test_what_needs_groups_of_processes_is_refused_in_one_sentence_without(name, monkeypatch, tmp_path):
    monkeypatch.delattr("os.killpg", raising=False)  # as on Windows
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lone_module.py").write_text("class Missing: ...")
    with pytest.raises(
        ValueError, match=r"^exec: and --isolated .* needs Linux or macOS: on Windows use WSL$"
    ):
        find_competitors(problem_of("filtergym/ManeuveringTarget-v0"), [name])


def test_python_is_the_one_of_the_environment_whether_it_is_activated_or_not(tmp_path, monkeypatch):
    """It has the package, however that was installed."""
    other = tmp_path / "python"
    other.write_text("#!/bin/sh\nexit 3\n")
    other.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    text = "import json, sys, filtergym.adapters; input(); print(json.dumps({'error': sys.prefix}))"
    with pytest.raises(ValueError, match=f"takes no part: {re.escape(sys.prefix)}$"):
        run(f'python -c "{text}"')
    with pytest.warns(UserWarning, match="exit status 3"):
        run(str(other))


def test_a_process_cannot_go_back(hold):
    _, estimator = run(hold())
    with pytest.raises(ValueError, match="cannot go back"):
        estimator.update(2, given(8)[1])


def test_a_lost_program_is_a_row_of_the_table(hold):
    """As an evaluation sees it: the last valid answer is held, and the reason is that of every episode."""
    model = make_model(ID, horizon=4)
    with pytest.warns(UserWarning, match="measurement 3: it was ended by SIGABRT; 2 episodes"):
        found = [
            (e.filter.mean[:, :2].copy(), e.filter.fault[:2])
            for e, _ in rollout(model, Program(hold("crash")), [0, 1])
        ]
    means, faults = map(np.stack, zip(*found, strict=True))
    assert faults.tolist() == [[0.0, 0.0], [0.0, 0.0], [ENDED, ENDED], [ENDED, ENDED]]
    assert FAULTS[ENDED - 1] == "the program ended"
    assert np.isfinite(means).all()
    np.testing.assert_array_equal(means[2], means[1])


# --- pipes and processes


def test_neither_side_waits_for_the_other_with_a_full_pipe(tmp_path):
    """An answer is begun when its question is, and both are larger than any pipe."""
    N = 200_000
    (tmp_path / "eager.py").write_text(
        "import sys\n"
        "hello = sys.stdin.buffer.readline()\n"
        'print(\'{"filtergym": 1, "format": "float64"}\', flush=True)\n'
        f"sys.stdin.buffer.read(8 * {N} * 6)\n"
        f"half, out = bytes(8 * {N} * 3), sys.stdout.buffer\n"
        "for _ in range(2):\n"
        "    sys.stdin.buffer.read(8)\n"
        "    out.write(half); out.flush()\n"
        f"    sys.stdin.buffer.read(8 * {N} * 3 - 8)\n"
        "    out.write(half); out.flush()\n"
    )
    means, estimator = run(f"{sys.executable} {tmp_path / 'eager.py'}", steps=2, N=N)
    assert estimator.fault == 0
    assert not means.any()


def running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("apart", [True, False])
def test_nothing_is_left_of_a_process_that_hangs(apart, monkeypatch, tmp_path):
    """Nor of what it has begun, even in sessions of its own, nor where Ctrl-C ends the wait for its answer."""
    monkeypatch.setattr(program_process, "END_SECONDS", 0.5)
    if not apart:
        monkeypatch.setattr(program_process, "LAUNCHER", without(tmp_path, "enter_namespaces"))
    os.mkfifo(tmp_path / "alive")
    alive = os.open(tmp_path / "alive", os.O_RDONLY | os.O_NONBLOCK)
    words = f"read question; exec 3> {tmp_path}/alive; sleep 99 & setsid sh -c 'sleep 99 & sleep 99' & echo; sleep 99"
    process = ProgramProcess(["sh", "-c", words], Limits())
    process.exchange(b"?\n", None, 100)
    own = process._process.pid
    alarm = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.1)
    try:
        with pytest.raises(KeyboardInterrupt):
            process.exchange(b"", 1)
    finally:
        signal.signal(signal.SIGALRM, alarm)
    assert running(own)
    with pytest.raises(BlockingIOError):
        os.read(alive, 1)
    del process
    assert not running(own)
    until, left = time.monotonic() + 5.0, True
    while left and time.monotonic() < until:
        with contextlib.suppress(BlockingIOError):
            left = os.read(alive, 1) != b""
        time.sleep(0.01)
    os.close(alive)
    assert not left


def test_a_process_ends_with_its_rollout(hold):
    model, program = make_model(ID, horizon=3), Program(hold())
    made = []

    def make(task):
        made.append(program(task))
        return made[0]

    for _ in rollout(model, make, [0], kind="estimator"):
        own = made[0]._process._process.pid
    assert running(own)
    made.clear()
    assert not running(own)


@LINUX
def test_its_time_is_that_of_its_process(hold):
    model = make_model(ID, horizon=4)
    found = measure_time(model, Program(hold()), "estimator", [0, 1])
    assert found.own
    assert not found.compiled
    assert found.nanoseconds > 0.0


# --- what it receives


def test_a_hello_names_every_number(env_id):
    model = make_model(env_id)
    started = []
    measured = start_lanes(model, [0], lambda e: started.append(e.measurement)).state.measurement
    estimator = ProgramEstimator(model.task, Program("true"))
    estimator.tracks = 1
    estimator.start(started[0], 8)
    estimator.end()
    hello = json.loads(json.dumps(estimator.hello(measured), allow_nan=False))
    assert (hello["tracks"], hello["environment"]) == (1, env_id)
    assert [(c["name"], c["unit"], c["period"]) for c in hello["components"]] == [
        component[:3] for component in model.task.components
    ]
    for name, part in (("initial", started[0]), ("measurement", measured)):
        present = [own for own in hello[name] if own["shape"] is not None]
        assert [own["name"].replace(".", "_") for own in present] == [n for n, _ in named_arrays(part)]
        assert [tuple(own["shape"]) for own in present] == [a.shape[:-1] for _, a in named_arrays(part)]
        assert hello["numbers"][name] == sum(a[..., 0].size for a in leaves(part))
        assert rows_of(part, 1).shape == (1, hello["numbers"][name])
    # Every field of a measurement has a description; its unit is among the words.
    assert all(own["about"] for own in hello["measurement"])
    C = len(model.task.components)
    assert hello["numbers"]["answer"] == C + C * C


def test_a_line_has_whole_numbers_and_null_for_what_was_not_received():
    estimator = ProgramEstimator(task_of(), Program("true"))
    estimator._format = "json"
    kinds = [
        ArrayField("scan", (), "int64", ""),
        ArrayField("seen", (2,), "bool", ""),
        ArrayField("none", None, "", ""),
        ArrayField("z", (), "float64", ""),
    ]
    rows = np.array([[3.0, 1.0, 0.0, np.nan], [4.0, 0.0, 0.0, 1.5]])
    line = json.loads(estimator._message("measurement", kinds, rows))
    assert line == {
        "measurement": {"scan": [3, 4], "seen": [[True, False], [False, False]], "z": [None, 1.5]}
    }
    assert estimator._message("measurement", kinds, rows).count(b"4.0") == 0


# --- clients


def estimates(maker, scenario="glint", episodes=3, horizon=12):
    """Mean and covariance, ``(time, ..., episodes)``; in ``glint`` scans miss the target."""
    model = make_model(ID, scenario=scenario, horizon=horizon)
    found = [
        (e.filter.mean[..., :episodes].copy(), e.filter.covariance[..., :episodes].copy())
        for e, _ in rollout(model, maker, range(episodes))
    ]
    return tuple(map(np.stack, zip(*found, strict=True)))


def agree(one, other):
    """Assert equality of filters that compute the same in another order.

    Positions of 1e5 m are known to 1e-11 of them, ten additions and products of them; so are covariances of 1e6 m^2.
    """
    for own, expected in zip(estimates(one), estimates(other), strict=True):
        np.testing.assert_allclose(own, expected, rtol=1e-11, atol=1e-6)


@pytest.fixture
def examples(monkeypatch):
    """Estimators of the examples, by ``module:Class``."""
    monkeypatch.syspath_prepend(EXAMPLES)
    yield lambda name: competitor(ID, name)
    for name in ("mine", "filterpy_filters"):
        sys.modules.pop(name, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("client", "library", "same"),
    [
        ("filterpy_imm.py", "filterpy", "filterpy_filters:Imm"),
        ("stone_soup_kalman.py", "stonesoup", "stone_soup_kalman:Kalman"),
    ],
)
def test_scripts_of_libraries_are_their_adapters(client, library, same, examples):
    pytest.importorskip(library)
    agree(Program(f"{sys.executable} {CLIENTS / client}"), examples(same))


@pytest.mark.slow
def test_the_filter_in_cpp_is_the_one_in_numpy(tmp_path, examples):
    eigen = next(
        (p for p in os.environ.get("EIGEN", "/usr/include/eigen3").split(":") if Path(p).is_dir()), None
    )
    compiler = shutil.which("c++")
    if eigen is None or compiler is None:
        pytest.skip("no Eigen or no compiler here; EIGEN names its folder")
    words = [
        compiler,
        "-std=c++17",
        "-O1",
        "-Wall",
        "-Wextra",
        "-Werror",
        f"-I{eigen}",
        CLIENTS / "kalman.cpp",
    ]
    subprocess.run([*words, "-o", tmp_path / "kalman"], check=True)
    agree(Program(str(tmp_path / "kalman")), examples("mine:Mine"))


def test_a_compiled_launcher_of_another_text_is_not_run(tmp_path):
    source = tmp_path / "launcher.py"
    source.write_text("x = 1\n")
    assert quickest_form(str(source)) == str(source)
    compiled = py_compile.compile(str(source))
    assert quickest_form(str(source)) == compiled
    source.write_text("x = 12\n")
    assert quickest_form(str(source)) == str(source)
