"""A folder for a model hub: its card can be read, its arrays are the agent's, and it is evaluated as it stands."""

import json

import pytest
from filtergym.agents.learned_policy import pretrained_path

from filtergym import evaluate

ENV = "filtergym/UavAutopilot-v0"


def test_a_shipped_agent_becomes_a_folder(command, tmp_path):
    yaml = pytest.importorskip("yaml")
    folder = tmp_path / "hub"
    code, _, errors = command("export", ENV, "bptt-linear", "--to", "hub", "--out", folder)
    assert code == 0, errors
    assert {path.name for path in folder.iterdir()} == {"README.md", "config.json", "model.safetensors"}
    assert (folder / "model.safetensors").read_bytes() == pretrained_path(ENV, "bptt-linear").read_bytes()
    assert json.loads((folder / "config.json").read_text())["environment"] == ENV
    _, head, body = (folder / "README.md").read_text(encoding="utf-8").split("---\n", 2)
    metadata = yaml.safe_load(head)
    [result] = metadata["model-index"][0]["results"]
    cost = (
        evaluate(ENV, [folder / "model.safetensors", "kalman"], None, 200)["cost"]
        .mean(["episode", "time"])
        .values
    )
    assert result["metrics"][0]["value"] == pytest.approx(100.0 * (cost[0] / cost[1] - 1.0), abs=0.005)
    assert ENV in body


def test_what_is_no_agent_is_refused(command, tmp_path):
    (tmp_path / "agent.safetensors").write_bytes(b"nothing")
    other = pretrained_path("filtergym/ManeuveringTarget-v0", "bptt-linear")
    for name in ("kalman", tmp_path / "agent.safetensors", other):
        code, _, errors = command("export", ENV, name, "--to", "hub", "--out", tmp_path / "hub")
        assert (code, errors.count("\n")) == (2, 1), errors
        assert not (tmp_path / "hub").exists()
