"""What can execute code when it is loaded is not loaded, without --trust."""

import json
import pickle
import shutil
import subprocess
import sys
import zipfile

import pytest

import filtergym
from filtergym.__main__ import main
from filtergym.agents.export import export_run
from filtergym.agents.learned_policy import PRETRAINED
from filtergym.names import competitor

ID = "filtergym/ManeuveringTarget-v0"
AGENT = PRETRAINED / "ManeuveringTarget-v0" / "ppo"


class Trap:
    """Writes a file when it is unpickled."""

    def __init__(self, file):
        self.file = str(file)

    def __reduce__(self):
        return open, (self.file, "w")


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A run's folder from a stranger, below the working directory; the name of the file that his code writes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    folder, sprung = tmp_path / "run", tmp_path / "sprung"
    for name in ("best", "checkpoint"):
        (folder / name).mkdir(parents=True)
        with zipfile.ZipFile(folder / name / "model.zip", "w") as file:
            file.writestr("data", json.dumps({"policy_class": {":serialized:": ""}}))
        (folder / name / "vecnormalize.pkl").write_bytes(pickle.dumps(Trap(sprung)))
    (folder / "checkpoint" / "rest.pkl").write_bytes(pickle.dumps(Trap(sprung)))
    record = json.loads(AGENT.with_suffix(".json").read_text(encoding="utf-8"))
    (folder / "run.json").write_text(json.dumps(record))
    return folder, sprung


def test_a_model_is_not_unpickled(stranger, command, make_page):
    pytest.importorskip("stable_baselines3")
    folder, sprung = stranger
    record = json.loads((folder / "run.json").read_text())
    train = (
        "train", ID, "--out", folder, "--algo", "ppo", "--resume", "--steps", 2 * record["steps"],
        "--envs", record["envs"], "--seed", record["seed"], "--control", record["control"],
    )  # fmt: skip
    model = folder / "best" / "model.zip"
    for words in (
        ("export", folder),
        ("evaluate", ID, "--policy", model, "--episodes", 1),
        ("seeds", folder, "--episodes", 2),
        ("animate", ID, "--policy", model),
        train,
    ):
        code, _, errors = (make_page if words[0] == "seeds" else command)(*words)
        assert (code, errors.count("\n")) == (2, 1), (words, errors)
        assert "pickle, which can execute code: if you made it or know who did, add --trust" in errors
    with pytest.raises(ValueError, match="trust=True"):
        filtergym.evaluate(ID, [str(model)], episodes=1)
    with pytest.raises(ValueError, match="trust=True"):
        export_run(folder, folder / "agent.safetensors")
    assert not sprung.exists()
    # With --trust it is: that is what the word is for.
    (folder / "checkpoint" / "model.zip").unlink()
    assert command(*train, "--trust")[0] == 2
    assert sprung.exists()


def test_plain_arrays_take_no_trust(stranger, command):
    folder, _ = stranger
    shutil.copyfile(AGENT.with_suffix(".safetensors"), folder / "best" / "agent.safetensors")
    assert command("export", folder)[0] == 0
    assert command("evaluate", ID, "--policy", folder / "agent.safetensors", "--episodes", 2)[0] == 0


def test_the_module_that_a_record_names_is_not_imported(stranger, command, make_page):
    folder, sprung = stranger
    (folder / "evil.py").write_text(f"open({str(sprung)!r}, 'w')")
    record = json.loads((folder / "run.json").read_text()) | {"environment": "run.evil:mine/Turns-v0"}
    (folder / "run.json").write_text(json.dumps(record))
    for run, word in ((command, "export"), (make_page, "seeds")):
        code, _, errors = run(word, folder)
        assert code == 2
        assert "imports module 'run.evil', which can execute code" in errors
    assert not sprung.exists()
    assert "unknown environment 'mine/Turns-v0'" in make_page("seeds", folder, "--trust")[2]
    assert sprung.exists()


def test_what_is_no_policy_is_not_called(refusal):
    before = list(sys.path)
    for name in ("os:system", "os:path", "sys:argv", "math:pi"):
        assert f"'{name}' is no competitor" in refusal("evaluate", ID, "--policy", name, "--episodes", 1)
        assert sys.path == before
    found = competitor(ID, "filtergym.baselines.maneuvering_target.references:KnownTurn")
    assert found.kind == "reference"


def test_a_name_with_a_colon_can_be_a_path(tmp_path, monkeypatch, refusal, success):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a:b").mkdir()
    for name in ("a:b/agent.safetensors", "C:\\agent.safetensors"):
        shutil.copyfile(AGENT.with_suffix(".safetensors"), tmp_path / name)
        output = success("evaluate", ID, "--policy", name, "--episodes", 2)
        assert name in output
    for name, expected in (
        ("D:\\agent.safetensors", "no learned policy at D:\\agent.safetensors"),
        (".x:C", "cannot load policy '.x:C': ImportError: a module is named by words"),
        ("D:\\agent", "cannot load policy 'D:\\\\agent'"),
    ):
        assert expected in refusal("evaluate", ID, "--policy", name, "--episodes", 1)


def test_a_path_is_not_read_as_markup(stranger, command, success):
    folder, name = stranger[0], "[bold]:warning:/[/red]/a.safetensors"
    shutil.copyfile(AGENT.with_suffix(".safetensors"), folder / "best" / "agent.safetensors")
    output = success("export", folder, "--out", name)
    assert name in output
    output = success("evaluate", ID, "--policy", name, "--episodes", 2)
    assert name in output
    assert name[:-1] in command("evaluate", ID, "--policy", name[:-1])[2]


def test_a_module_in_the_working_directory_is_found(tmp_path, monkeypatch, refusal, success):
    """As an installed command starts: without the working directory on the path."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place not in ("", str(tmp_path))])
    for name in ("middle_policy", "middle_environment"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "middle_policy.py").write_text(
        "from filtergym.evaluation.competitors.kinds import ConstantPolicy\n"
        "class Middle(ConstantPolicy):\n    control, action = 'gain', (0.0,)\n"
    )
    (tmp_path / "middle_environment.py").write_text("1 / 0")
    output = success("evaluate", ID, "--policy", "middle_policy:Middle", "--episodes", 2)
    assert "middle_policy:Middle" in output
    # An environment's module is looked for in the same places, and its errors are a sentence, too.
    assert "registers environment 'mine/Middle-v0': ZeroDivisionError" in refusal(
        "list", "middle_environment:mine/Middle-v0"
    )


LIBRARIES = (
    "dask",
    "distributed",
    "lz4",
    "psutil",
    "plotly",
    "jinja2",
    "yaml",
    "pyarrow",
    "numbagg",
    "tensorboard",
)
"""That the commands, what they use, or their processes would import; some are not installed."""


@pytest.mark.slow
def test_a_file_of_ones_own_is_no_library(tmp_path):
    """Not even where the library is missing; what is named is found, in every process, and what it imports, too."""
    for name in LIBRARIES:
        (tmp_path / f"{name}.py").write_text(f"open('sprung', 'a').write('{name} ')\nraise ImportError")
    (tmp_path / "sibling.py").write_text("ACTION = (0.0,)")
    (tmp_path / "middle.py").write_text(
        "from filtergym.evaluation.competitors.kinds import ConstantPolicy\n"
        "from sibling import ACTION\n"
        "class Middle(ConstantPolicy):\n    control, action = 'gain', ACTION\n"
    )
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "filtergym").write_text("from filtergym.__main__ import main\nmain()\n")
    short = ("--episodes", "2", "--set", "horizon=8", "--jobs", "2", "--backend", "numpy", "--out", "out")
    for start, *words in (
        ("bin/filtergym", "evaluate", ID, "--policy", "middle:Middle", "--policy", "imm", *short),
        ("-P", "-m", "filtergym", "report", "out"),
    ):
        done = subprocess.run(
            [sys.executable, start, *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert not (tmp_path / "sprung").exists(), (words, (tmp_path / "sprung").read_text())
    assert "middle:Middle" in (tmp_path / "out" / "records.csv").read_text()


def test_an_unexpected_error_is_a_sentence(monkeypatch, command):
    def broken(*_, **__):
        raise KeyError("lost")

    monkeypatch.setattr("filtergym.evaluation.running.summary.summaries", broken)
    code, _, errors = command("evaluate", ID, "--policy", "imm")
    assert (code, errors.count("\n")) == (1, 1)
    assert "Error: unexpected KeyError: 'lost' (test_trust.py, line " in errors
    assert "please report it" in errors
    monkeypatch.setattr("sys.argv", ["filtergym", "evaluate", ID, "--policy", "imm", "--debug"])
    with pytest.raises(KeyError, match="lost"):
        main()
