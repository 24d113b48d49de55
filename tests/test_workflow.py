"""What the workflow of the usual host runs is there."""

import re
from pathlib import Path

import pytest

yaml = pytest.importorskip("yaml")
ROOT = Path(__file__).parents[1]


def test_every_command_of_the_workflow_exists():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "checks.yml").read_text())
    made = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M)
    commands = [step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step]
    for command in commands:
        for target in re.findall(r"\bmake (?:--\S+ )*([\w-]+)", command):
            assert target in made, command
        assert command.startswith(("make ", "python -m ")) or (ROOT / command).is_file()
    assert ".ci/run" in commands
    lowest = re.search(r'requires-python = ">=(3\.\d+)"', (ROOT / "pyproject.toml").read_text()).group(1)
    assert workflow["jobs"]["core"]["strategy"]["matrix"]["python"][0] == lowest
