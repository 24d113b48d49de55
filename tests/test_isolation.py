"""An estimator in a process of its own: it answers what it answers anywhere, and finds no truth."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from models import make_model

import filtergym
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.competitors import isolation
from filtergym.evaluation.competitors.isolated_estimator import landlock_version
from filtergym.evaluation.competitors.isolation import isolate_source
from filtergym.evaluation.competitors.program_process import ENDED
from filtergym.evaluation.running.rollout import rollout, start_lanes
from filtergym.names import competitor, isolate_names

ID = "filtergym/ManeuveringTarget-v0"
EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"
EPISODES, HORIZON = 16, 3

# Each looks for the truth in another way, and where it finds none answers as the honest one does.
CHEATS = '''
import gc
import sys

import numpy as np


class Honest:
    def start(self, initial, N):
        self.k = 0
        return initial.mean, initial.covariance

    def update(self, memory, m):
        self.k, self.m = self.k + 1, m
        mean, P = memory
        seen = m.available > 0
        position = mean[:2] + m.interval * mean[2:]
        r = np.where(seen, m.position - position, 0.0)
        mean = np.concatenate([position + 0.4 * r, mean[2:] + 0.1 * r / m.interval])
        known = self.known(mean.shape[1])
        return (mean if known is None else known), P, (mean, P)

    def known(self, N):
        return None


class Recreates(Honest):
    """Makes the episodes again, by public calls."""

    def start(self, initial, N):
        self.truth = None
        try:
            import filtergym

            again = filtergym.record("filtergym/ManeuveringTarget-v0", None, EPISODES, seed=SEED, horizon=HORIZON)
            self.who = ((initial.mean[None] - again.initial["mean"][:, :, None]) ** 2).sum(1).argmin(0)
            self.truth = again.truth
        except (ImportError, AttributeError):
            pass
        return super().start(initial, N)

    def known(self, N):
        return None if self.truth is None else self.truth[self.who, self.k - 1].T.copy()


def state(truth, N):
    if not hasattr(truth, "velocity") or np.shape(truth.position)[-1] < N:
        return None
    return np.concatenate([truth.position, truth.velocity])[:, :N].astype(float)


def truth_of(lanes):
    try:
        return lanes.state.truth
    except IndexError:  # of an earlier evaluation
        return None


class Frames(Honest):
    """Looks into the frames of its caller."""

    def known(self, N):
        frame = sys._getframe()
        while frame:
            for own in list(frame.f_locals.values()):
                found = state(getattr(own, "truth", None), N)
                if found is not None:
                    return found
            frame = frame.f_back
        return None


class TwoWords(Honest):
    """Takes the two words from what runs the episodes to the truth, of all objects that there are."""

    def known(self, N):
        everywhere = [truth_of(own) for own in gc.get_objects() if type(own).__name__ == "Lanes"]
        found = [own for own in (state(truth, N) for truth in everywhere) if own is not None]
        return min(found, key=lambda own: np.nansum(abs(own[:2] - self.m.position)), default=None)
'''


@pytest.fixture
def cheats(tmp_path, monkeypatch):
    """Write the module; returns the cost of each of its classes, in this process or in its own."""
    monkeypatch.syspath_prepend(tmp_path)

    head = f"SEED, EPISODES, HORIZON = 5, {EPISODES}, {HORIZON}\n"
    (tmp_path / "cheats.py").write_text(head + CHEATS)

    def costs(*names):
        found = filtergym.evaluate(ID, names, episodes=EPISODES, seed=5, horizon=HORIZON)
        return found["cost"].mean(["episode", "time"]).values

    yield costs
    sys.modules.pop("cheats", None)


def test_a_cheat_is_worth_everything_beside_the_truth_and_nothing_apart(cheats):
    ways = ["Recreates", "Frames", "TwoWords"]
    honest, *found = cheats("cheats:Honest", *(f"{p}cheats:{n}" for p in ("", "isolated:") for n in ways))
    assert honest > 1.0
    np.testing.assert_array_equal(found[:3], 0.0)
    np.testing.assert_allclose(found[3:], honest, rtol=1e-12)  # a sum in another order


BESIDE = """
import beside
import linked


class Beside:
    def start(self, initial, N):
        try:
            open(PACKAGE)
            return None
        except PermissionError:
            return initial

    def update(self, memory, measurement):
        return 0.0 * memory.mean + beside.STEP + linked.STEP, memory.covariance, memory
"""


@pytest.mark.skipif(landlock_version() < 1, reason="this system has no Landlock")
def test_a_library_in_the_same_folder_as_the_package_is_found(tmp_path, monkeypatch):
    """As in an installation from a wheel; some installers write links."""
    folder, elsewhere = tmp_path / "site-packages", tmp_path / "elsewhere"
    package = folder / "filtergym"
    package.mkdir(parents=True)
    elsewhere.mkdir()
    (package / "__init__.py").touch()
    (folder / "beside.py").write_text("STEP = 1.0\n")
    (elsewhere / "linked.py").write_text("STEP = 2.0\n")
    (folder / "linked.py").symlink_to(elsewhere / "linked.py")
    monkeypatch.syspath_prepend(folder)
    known = isolation.package_folders()
    monkeypatch.setattr(isolation, "package_folders", lambda: [*known, package])
    apart = isolate_source(f"PACKAGE = {str(package / '__init__.py')!r}\n{BESIDE}", "Beside", "beside")
    model = make_model(ID, horizon=2)
    for episode, _ in rollout(model, apart, [0]):
        np.testing.assert_array_equal(episode.filter.mean[:, :1], 3.0)


def test_links_to_the_files_of_the_package_open_no_way_to_them(tmp_path, monkeypatch):
    """An editable installation may hold links to a clone, in which the estimator may lie."""
    clone, links = tmp_path / "clone", tmp_path / "links"
    (clone / "filtergym").mkdir(parents=True)
    links.mkdir()
    (clone / "filtergym" / "__init__.py").touch()
    (clone / "mine.py").touch()
    (links / "__init__.py").symlink_to(clone / "filtergym" / "__init__.py")
    monkeypatch.setattr(isolation, "package_folders", lambda: [links])
    request = json.loads(isolate_source("", "Mine", "mine", clone / "mine.py").preface)
    assert str(clone / "mine.py") in request["readable"]
    assert not [path for path in request["readable"] if (clone / "filtergym").is_relative_to(path)]
    assert not [path for path in request["readable"] if Path(path).is_relative_to(clone / "filtergym")]


@pytest.mark.parametrize("own", ["mine:Mine", "filterpy_filters:Imm", "stone_soup_kalman:Kalman"])
def test_what_is_isolated_answers_what_it_answers_anywhere(own, monkeypatch):
    """Filters of other libraries, too, whose adapters are in the package."""
    lanes = 11
    monkeypatch.syspath_prepend(EXAMPLES)
    module = own.partition(":")[0]
    monkeypatch.delitem(sys.modules, module, raising=False)  # that of another test
    model = make_model(ID, scenario="glint", horizon=20)
    means = [
        np.stack(
            [e.filter.mean[:, :lanes].copy() for e, _ in rollout(model, competitor(ID, name), range(lanes))]
        )
        for name in (f"isolated:{own}", own)
    ]
    sys.modules.pop(module, None)
    np.testing.assert_allclose(
        means[0], means[1], rtol=1e-12
    )  # arrays may lie otherwise, and products round so


ECHO = """
class Echo:
    def __init__(self, task):
        self.task = task

    def start(self, initial, N):
        assert initial.mean.shape == (len(self.task.components), N), initial.mean.shape
        return initial

    def update(self, memory, measurement):
        assert not FIELDS or measurement._fields == tuple(FIELDS), measurement._fields
        for name, (shape, kind) in (FIELDS or {}).items():
            value = getattr(measurement, name)
            assert value is None if shape is None else value.shape == shape and value.dtype.kind == kind, name
        assert self.task.parameters.horizon == 2
        return memory.mean, memory.covariance + self.task.xp.eye(len(memory.mean))[:, :, None], memory
"""


def test_it_is_given_what_an_estimator_is_given(env_id):
    """Fields, shapes and types, in every environment."""
    model = make_model(env_id, horizon=2, decision_interval=1)
    measured = start_lanes(model, [0]).state.measurement
    fields = {
        name: (None, "") if value is None else (value.shape, value.dtype.kind)
        for name, value in measured._asdict().items()
    }
    apart = isolate_source(f"FIELDS = {fields!r}\n{ECHO}", "Echo", "echo")
    for episode, _ in rollout(model, apart, [0]):
        assert not episode.filter.fault.any()
    (last,) = episode.filter.mean[:, :1].T
    assert np.isfinite(last).all()


def test_names_are_isolated_where_they_are_modules():
    problem = problem_of(ID)
    names = ["imm", "mine:Mine", "exec:run", "isolated:a:B", "runs/ppo", "gated:bptt"]
    names += ["file:estimates.csv", "file:estimates"]
    found = isolate_names(problem, names)
    assert found == ["imm", "isolated:mine:Mine", *names[2:]]
    with pytest.raises(ValueError, match="acts in this process"):
        isolate_names(problem, ["gated:mine:Policy"])
    for name, words in (("isolated:imm", "takes module:Class"), ("isolated:no_such:X", "no file no_such.py")):
        with pytest.raises(ValueError, match=words):
            competitor(ID, name)


def test_nothing_of_a_module_runs_here(tmp_path, monkeypatch, command, refusal, success):
    """Nor where it is wrong: the sentence comes from the other process."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spring.py").write_text("import sys\nsys.exit('no')\n")
    words = ("evaluate", ID, "--isolated", "--episodes", 1, "--set", "horizon=5", "--policy", "spring:Spring")
    shown = success(*words)
    assert "1 of 1 episode lost: the program ended in episode 0 at measurement 1" in " ".join(shown.split())
    (tmp_path / "spring.py").write_text("raise OSError('no')\n")
    assert "'isolated:spring:Spring' takes no part: OSError: no" in refusal(*words)
    assert "spring" not in sys.modules
    assert "leave one of them out" in command(*words, "--trust")[2]


@pytest.mark.parametrize("isolated", [(), ("--isolated",)])
def test_a_competitor_that_fails_costs_its_own_row(isolated, tmp_path, monkeypatch, command):
    """Of one that raises, or cannot be made, or ends itself; what the others have done is written."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    words = "def start(self, initial, N): raise SystemExit(3)\n    def update(self, memory, m): pass\n"
    unmade = "def __init__(self): raise OSError('full')\n    "
    (tmp_path / "wretched.py").write_text(f"class Ends:\n    {words}\nclass Unmade:\n    {unmade}{words}")
    mine = ("--policy", "wretched:Ends", "--policy", "wretched:Unmade", "--policy", "imm")
    options = ("--episodes", 2, "--set", "horizon=5", "--json", "records.json", *isolated)
    code, shown, errors = command("evaluate", ID, *mine, *options)
    sys.modules.pop("wretched", None)
    prefix = "isolated:" if isolated else ""
    assert {own["policy"] for own in json.loads((tmp_path / "records.json").read_text())} >= {"imm"}
    assert "imm" in shown
    assert code == 2
    assert f"'{prefix}wretched:Unmade'" in errors
    assert "OSError: full" in errors
    assert errors.rstrip().endswith("the others are in the table")
    assert isolated or "SystemExit: 3" in errors  # a process that ends is a row of lost episodes


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a class that ends its process ends the run")
def test_a_class_that_ends_its_process_or_hangs_costs_its_own_row(tmp_path):
    """Of a class in the process that simulates the world, too; what the others have done is written."""
    bad = {
        "Exits": "os._exit(3)",
        "Kills": "os.kill(os.getpid(), 9)",
        "Hangs": "time.sleep(60.0 * (memory == 1))",
    }
    text = """class {}:
    def start(self, initial, N): self.initial = initial.mean, initial.covariance; return 0
    def update(self, memory, measurement): {}; return *self.initial, memory + 1
"""
    classes = [text.format(name, act) for name, act in bad.items()]
    (tmp_path / "wretched.py").write_text("import os, time\n" + "".join(classes))
    (tmp_path / "unborn.py").write_text("import os\nos._exit(0)\n")
    mine = [word for name in bad for word in ("--policy", f"wretched:{name}")]
    options = (
        "--policy unborn:Class --policy imm --episodes 2 --set horizon=5 --time-limit 1 --json records.json"
    )
    words = [sys.executable, "-m", "filtergym", "evaluate", ID, *mine, *options.split()]
    done = subprocess.run(words, check=False, cwd=tmp_path, capture_output=True, text=True)
    assert {own["policy"] for own in json.loads((tmp_path / "records.json").read_text())} == {"imm"}
    assert done.returncode == 2
    for name, ending in (
        ("wretched:Exits", "it has ended the process with exit status 3"),
        ("wretched:Kills", "it has ended the process by SIGKILL"),
        ("wretched:Hangs", "it has not responded within 1 s, see --time-limit"),
        ("unborn:Class", "it has ended the process with exit status 0"),
    ):
        assert f"{name!r} takes no part: {ending}" in done.stderr
    assert done.stderr.rstrip().endswith("the others are in the table")


def test_a_wrong_shape_is_no_answer():
    """Also one that has as many numbers."""
    text = ECHO.replace("memory.mean, memory.cov", "memory.mean.T, memory.cov")
    model = make_model(ID, horizon=2)
    apart = isolate_source(f"FIELDS = None\n{text}", "Echo", "echo")
    with pytest.warns(UserWarning, match=r"ValueError: the mean must have shape \(4, 8\), got \(8, 4\)"):
        faults = [episode.filter.fault[0] for episode, _ in rollout(model, apart, [0])]
    assert faults == [ENDED, ENDED]
