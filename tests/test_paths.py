"""Every function that takes the name of a file takes a ``pathlib.Path``; one name need not be a list."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from filtergym import evaluate, make_policy, read_flights, read_recording, record
from filtergym.agents.learned_policy import pretrained_path
from filtergym.agents.named_policies import pretrained_agents

ENV = "filtergym/ManeuveringTarget-v0"


@pytest.fixture
def flights(tmp_path):
    rows = "\n".join(f"{t},{20000 + 100 * t},{5000 + t}" for t in range(0, 200, 4))
    (tmp_path / "flights").mkdir()
    (tmp_path / "flights" / "one.csv").write_text(f"time,x,y\n{rows}\n")
    return tmp_path / "flights"


def same(one, other):
    np.testing.assert_array_equal(one["error"].values, other["error"].values)


def test_one_name_alone():
    alone = evaluate(ENV, "imm", "paper", 3, horizon=8)
    assert alone["policy"].values.tolist() == ["imm"]
    same(alone, evaluate(ENV, ["imm"], "paper", 3, horizon=8))
    with pytest.raises(ValueError, match="unknown policy 'imn': did you mean 'imm'"):
        evaluate(ENV, "imn", "paper", 3)


def test_flights(flights):
    one = flights / "one.csv"
    expected = evaluate(ENV, "imm", str(one), 2)
    for source in (one, flights, [one], read_flights(one), read_flights(flights), read_flights([one])):
        same(evaluate(ENV, "imm", source, 2), expected)
    assert make_policy(ENV, "imm", scenario=one).keywords["scenario"] == one


def test_recordings(flights, tmp_path):
    recorded = record(ENV, flights / "one.csv", 2)
    recorded.write(tmp_path / "plots.nc")
    expected = evaluate(ENV, "imm", recorded)
    for source in (tmp_path / "plots.nc", read_recording(tmp_path / "plots.nc"), str(tmp_path / "plots.nc")):
        same(evaluate(ENV, "imm", source), expected)
    recorded.write(tmp_path / "more.nc")
    assert len(read_recording([tmp_path / "plots.nc", tmp_path / "more.nc"]).names) == 4
    assert len(read_recording(tmp_path, ENV).names) == 4


def test_agents(tmp_path, monkeypatch):
    agent = pretrained_agents(ENV)[0]
    shutil.copy(pretrained_path(ENV, agent), tmp_path / "mine.safetensors")
    expected = evaluate(ENV, agent, "paper", 2, horizon=8)
    path = tmp_path / "mine.safetensors"
    same(evaluate(ENV, path, "paper", 2, horizon=8), expected)
    found = evaluate(ENV, [path, "imm"], "paper", 2, horizon=8)
    assert found["policy"].values.tolist() == [str(path), "imm"]
    same(evaluate(ENV, {"mine": path}, "paper", 2, horizon=8), expected)
    assert make_policy(ENV, path).keywords == make_policy(ENV, agent).keywords
    # A path is one, even where something else has its name.
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        ValueError, match=r"cannot load policy 'imm': it is neither a \.safetensors, a \.zip, nor a folder"
    ):
        evaluate(ENV, {"mine": Path("imm")}, "paper", 2)
    with pytest.raises(ValueError, match=r"nothing\.safetensors"):
        evaluate(ENV, Path("nothing.safetensors"), "paper", 2)
    (tmp_path / "model.zip").write_bytes(b"PK")
    with pytest.raises(ValueError, match="trust"):
        evaluate(ENV, Path("model.zip"), "paper", 2)
