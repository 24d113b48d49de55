"""A name that was read from a file imports nothing, whatever file it is and whichever way it comes in."""

import csv
import importlib
import json
import pickle
import shutil
import subprocess
import sys
import warnings
from contextlib import suppress

import gymnasium as gym
import msgspec
import numpy as np
import pytest
import xarray

import filtergym
from filtergym import evaluate, make_policy, read_recording, record, tidy_records
from filtergym.agents.learned_policy import PRETRAINED, read_arrays
from filtergym.agents.training_run import load_run
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.running.summary import Summary
from filtergym.evaluation.storage.store import Store, Work
from filtergym.names import competitor
from filtergym.reports.tables.results import read_results

ENV = "filtergym/ManeuveringTarget-v0"
AGENT = PRETRAINED / "ManeuveringTarget-v0" / "ppo"
TRAP = "import_trap"
NAME, CLASS = f"{TRAP}:mine/Trap-v0", f"{TRAP}:Trap"
SHORT = ("--episodes", "2", "--set", "horizon=8")


class Executed:
    """Imports the trap where it is unpickled."""

    def __reduce__(self):
        return importlib.import_module, (TRAP,)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Working directory with the trap in it, which is on the path, too."""
    (tmp_path / f"{TRAP}.py").write_text("class Trap:\n    pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop(TRAP, None)


def everywhere(value, kept=()):
    """Put the name of the trap in place of every string of a JSON value, but for those of some keys."""
    if isinstance(value, dict):
        return {
            NAME if key == ENV else key: item if key in kept else everywhere(item, kept)
            for key, item in value.items()
        }
    if isinstance(value, list):
        return [everywhere(item, kept) for item in value]
    return NAME if isinstance(value, str) else value


def write_table(path, columns):
    if path.suffix == ".csv":
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([list(columns), *zip(*columns.values(), strict=True)])
    elif path.suffix == ".json":
        path.write_text(json.dumps({name: list(values) for name, values in columns.items()}))
    else:
        pyarrow = pytest.importorskip("pyarrow")
        importlib.import_module("pyarrow.parquet").write_table(pyarrow.table(columns), path)


def flown_ways(folder, command):
    """Recordings and flights: NetCDF, CSV, JSON, Parquet."""
    own = record(ENV, episodes=2, horizon=8, backend="numpy")
    own.write(folder / "own.nc")
    with xarray.open_dataset(folder / "own.nc", engine="scipy") as data:
        data = data.load()
    names = data.assign_coords(recording=("episode", np.array([CLASS, NAME])))
    words = dict.fromkeys(("environment", "parameters", "source", "licence", "history"), NAME)
    parameters = json.dumps({"horizon": NAME, NAME: NAME})
    contents = {
        "environment": data.assign_attrs(environment=NAME),
        "every": names.assign_attrs(words),
        "parameters": names.assign_attrs(parameters=parameters, source=NAME, control=CLASS),
    }
    paths = []
    for name, content in contents.items():
        paths.append(folder / f"{name}.nc")
        content.to_netcdf(paths[-1], engine="scipy", format="NETCDF3_64BIT")
    plots = {"time": [5.0 * i for i in range(8)]} | {n: [1e3 * i for i in range(8)] for n in ("x", "y")}
    plots |= {
        "sigma_x": [100.0] * 8,
        "sigma_y": [100.0] * 8,
        "environment": [NAME] * 8,
        "recording": [NAME] * 8,
    }
    tracks = {name: plots[name] for name in ("time", "x", "y")}
    tracks |= dict.fromkeys(("flight", "callsign", "icao24", "environment"), [NAME] * 8)
    for table in (plots, tracks):
        for suffix in (".csv", ".json", ".parquet"):
            paths.append(folder / f"{len(table)}{suffix}")
            write_table(paths[-1], table)
    for path in paths:
        for words in (
            ("evaluate", "--recording", path, "--policy", "imm"),
            ("evaluate", ENV, "--recording", path, "--policy", "imm"),
            ("record", ENV, "--scenario", path, "--out", "again.nc", *SHORT),
            ("offline", ENV, "--scenario", path, "--split", "test", "--policy", "imm", *SHORT),
            ("train", ENV, "--scenario", path, "--algo", "bptt", "--steps", 8, "--envs", 2, "--out", "run"),
        ):
            yield f"{' '.join(map(str, words[:3]))} {path.name}", lambda words=words: command(*words)
        for call in (
            lambda path: read_recording(path),
            lambda path: filtergym.read_flights(path),
            lambda path: evaluate(ENV, ["imm"], path, episodes=2),
            lambda path: gym.make(ENV).reset(seed=0, options={"scenario": str(path)}),
            lambda path: make_policy(ENV, "imm", scenario=str(path)),
        ):
            yield f"{call.__code__.co_names} {path.name}", lambda path=path, call=call: call(path)
    track = {"time": [0.0, 50.0], "position": [[0.0, 0.0], [1e4, 0.0]], "name": NAME, "flight": NAME}
    yield "scenario from JSON", lambda: gym.make(ENV, scenario=json.loads(json.dumps(track)))
    yield "recording from JSON", lambda: gym.make(ENV, scenario={"measurements": {}, "environment": NAME})


def spec_ways(folder, command):
    """Specifications of environments, as data sets of Minari hold them."""
    text = gym.make(ENV, horizon=8).spec.to_json()
    task = text.replace(f'"task": "{ENV}"', f'"task": "{NAME}"')
    for changed in (task, text.replace(f'"{ENV}"', f'"{NAME}"')):
        assert changed != text
        spec = gym.envs.registration.EnvSpec.from_json(changed)
        yield "gym.make(spec)", lambda spec=spec: gym.make(spec)
        yield "gym.make_vec(spec)", lambda spec=spec: gym.make_vec(spec, num_envs=2)


def minari_ways(folder, command):
    minari = pytest.importorskip("minari")
    words = ("offline", ENV, "--policy", "imm", "--out", folder / "sets", *SHORT)
    assert command(*words)[0] == 0
    [file] = (folder / "sets").rglob("metadata.json")
    content = json.loads(file.read_text())
    name = content["dataset_id"]
    content |= {"algorithm_name": CLASS, "author": [CLASS], "description": NAME}
    for key in ("env_spec", "eval_env_spec"):
        if key in content:
            content[key] = content[key].replace(f'"task": "{ENV}"', f'"task": "{NAME}"')
    assert NAME in content["env_spec"]
    file.write_text(json.dumps(content))
    yield "minari.load_dataset", lambda: minari.load_dataset(name)[0]
    yield "recover_environment", lambda: minari.load_dataset(name).recover_environment()
    yield "recover_environment, eval", lambda: minari.load_dataset(name).recover_environment(eval_env=True)
    yield "offline again", lambda: command(*words)


def agent_ways(folder, command):
    """Files of agents (safetensors) and folders of training runs (JSON)."""
    from safetensors import safe_open
    from safetensors.numpy import save_file

    with safe_open(AGENT.with_suffix(".safetensors"), framework="numpy") as file:
        header, arrays = dict(file.metadata()), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    content = json.loads(header["run"])
    runs = [
        content | {"environment": NAME},
        content | {"residual_to": CLASS, "gated": True},
        content | {"environment": f"{TRAP}:{ENV}", "control": CLASS, "scenario": NAME, "command": NAME},
        everywhere(content),
    ]
    paths = []
    for i, run in enumerate(runs):
        for j, own in enumerate((header, header | {"environment": NAME}, everywhere(header))):
            paths.append(folder / f"agent-{i}{j}.safetensors")
            save_file(arrays, paths[-1], {**own, "run": json.dumps(run), "fields": header["fields"]})
        for whole in (True, False):
            best = folder / f"run-{i}{whole}" / "best"
            best.mkdir(parents=True)
            if whole:
                shutil.copyfile(paths[-3], best / "agent.safetensors")
            shutil.copytree(best, best.parent / "checkpoint")
            for place in (best.parent, best.parent / "checkpoint"):
                (place / "run.json").write_text(json.dumps(run))
            paths.append(best.parent)
    for path in paths:
        resumed = ("train", ENV, "--out", path, "--algo", "bptt", "--resume")
        for words in (
            ("evaluate", ENV, "--policy", path, *SHORT),
            ("evaluate", ENV, "--policy", f"gated:{path}", *SHORT),
            ("train", ENV, "--residual-to", path, "--algo", "ppo", "--steps", 8, "--envs", 2, "--out", "new"),
            *(() if path.suffix else (("export", path), ("seeds", path, *SHORT[:2]), resumed)),
        ):
            yield f"{' '.join(map(str, words[:3]))} {path.name}", lambda words=words: command(*words)
        yield f"competitor {path.name}", lambda path=path: competitor(ENV, path)
        yield f"evaluate() {path.name}", lambda path=path: evaluate(ENV, [path], episodes=2, horizon=8)
        read = read_arrays if path.suffix else load_run
        yield f"{read.__name__} {path.name}", lambda path=path, read=read: read(path)


def settings_ways(folder, command):
    """YAML of hyperparameters, JSON of tuned values."""
    rest = ("--algo", "ppo", "--steps", 8, "--envs", 2, "--out", "trained")
    for i, text in enumerate(
        (
            f"{NAME}:\n  n_steps: 8\n",
            f"{ENV}:\n  policy: '{CLASS}'\n  policy_kwargs: {{features_extractor_class: '{CLASS}'}}\n",
            f"{ENV}:\n  env_wrapper: '{CLASS}'\n  callback: '{CLASS}'\n  normalize: '{CLASS}'\n",
            f"env: {{control: '{CLASS}', scenario: '{NAME}', reward: '{NAME}'}}\n",
            f"env: {{scenario: '{NAME}'}}\nalgo: {{policy: '{CLASS}', learning_rate: '{CLASS}'}}\n",
            f"env: !!python/name:{TRAP}.Trap\n",
            f"algo: !!python/object/apply:{TRAP}.Trap []\n",
            f"learning_rate: !!python/module:{TRAP}\n",
        )
    ):
        path = folder / f"{i}.yml"
        path.write_text(text)
        yield f"train --config {i}", lambda path=path: command("train", ENV, "--config", path, *rest)
    (folder / "tuned").mkdir(exist_ok=True)
    for content in (
        {CLASS: {"values": {}}, "imm": {"values": {NAME: 1.0}, "command": NAME}},
        {"imm": everywhere({"values": {"gain": "x"}, "environment": "", "policy": "", "scenario": ""})},
    ):
        (folder / "tuned" / "ManeuveringTarget-v0.json").write_text(json.dumps(content))
        yield "evaluate, tuned", lambda: command("evaluate", ENV, "--policy", "imm-tuned", *SHORT)
        yield "stored_values", lambda: problem_of(ENV).tuned_values.values("imm")
    shutil.rmtree(folder / "tuned")


def results_ways(folder, command):
    """Results, evaluations and kept parts of them: JSON, NetCDF, and NumPy's."""
    assert command("evaluate", ENV, "--policy", "imm", *SHORT, "--out", "out")[0] == 0
    results = json.loads((folder / "out" / "results.json").read_text())
    for i, content in enumerate(
        (
            json.loads(json.dumps(results).replace(ENV, NAME)),
            json.loads(json.dumps(results).replace('"imm"', f'"{CLASS}"')),
            everywhere(results, kept=("format", "dims", "dtype")),
        )
    ):
        path = folder / f"results-{i}.json"
        path.write_text(json.dumps(content))
        for words in (("report", path, "--out", "report.html"), ("comparison", path)):
            yield f"{words[0]} {i}", lambda words=words: command(*words)
        yield f"read_results {i}", lambda path=path: read_results(path)
    with xarray.open_dataset(folder / "out" / "results.nc", engine="scipy") as data:
        data = data.load()
    others = dict.fromkeys(data.attrs, NAME), {"paper": CLASS, "reference": CLASS}
    for attrs in ({"environment": NAME}, *others):
        yield "tidy_records", lambda attrs=attrs: tidy_records(data.assign_attrs(attrs))
        data.assign_attrs(attrs).to_netcdf(folder / "evaluation.nc", engine="scipy", format="NETCDF3_64BIT")
        yield "an evaluation as scenario", lambda: gym.make(ENV, scenario=str(folder / "evaluation.nc"))
        yield "an evaluation as recording", lambda: read_recording(folder / "evaluation.nc")
    store, work = Store(folder / "kept"), Work("kept", NAME)
    store.write(work, 1.0)
    [kept] = (folder / "kept").iterdir()
    named = {"name": CLASS, "kind": CLASS, "control": NAME, "head": CLASS}
    packed = [msgspec.msgpack.encode(each) for each in (named, [CLASS] * 4)]
    for content in (pickle.dumps(Executed()), *packed):
        kept.write_bytes(content)
        yield "what a store keeps", lambda: store.read(work, Summary)
    name = "unfinished/ManeuveringTarget-v0.paper.2.test0.json"
    for content in (folder / "results-0.json", folder / "results-2.json"):
        (folder / "begun" / "unfinished").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(content, folder / "begun" / name)
        yield "results of a benchmark", lambda: read_results(folder / "begun" / name)


@pytest.mark.slow
def test_a_name_that_was_read_from_a_file_imports_nothing(folder, command, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "sets"))
    tried, executed = 0, []
    for ways in (flown_ways, minari_ways, agent_ways, settings_ways, results_ways, spec_ways):
        for name, way in ways(folder, command):
            with suppress(Exception), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                way()
            tried += 1
            if sys.modules.pop(TRAP, None) is not None:
                executed.append(name)
    assert not executed
    assert tried > 150
    # Who names it himself imports it: the trap works.
    assert "is no competitor" in command("evaluate", ENV, "--policy", CLASS)[2]
    assert sys.modules.pop(TRAP)
    assert "unknown environment 'mine/Trap-v0'" in command("evaluate", NAME, "--policy", "imm")[2]
    assert sys.modules.pop(TRAP)
    sentence = f"unknown environment 'mine/Trap-v0': import '{TRAP}' yourself"
    assert sentence in command("evaluate", "--recording", "environment.nc", "--policy", "imm")[2]


def test_the_module_imports_nothing_of_the_working_directory_with_a_safe_path(tmp_path):
    """Neither libraries that the package imports before the first line of its ``__main__``."""
    for name in ("numpy", "gymnasium", "typing", "ast", "typer", "rich"):
        (tmp_path / f"{name}.py").write_text(f"open('executed-{name}', 'w')\n")
    words = [sys.executable, "-P", "-m", "filtergym", "--version"]
    shown = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert shown.stdout == f"filtergym {filtergym.__version__}\n"
    assert not list(tmp_path.glob("executed-*"))
