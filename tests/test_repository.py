"""What files of the repository say beside the code: the workflow of the usual host, and who is to be cited."""

import re
from pathlib import Path

import pytest

from filtergym.envs.contract.companions import Paper, find_companion
from filtergym.envs.engine.catalogue import catalogue

yaml = pytest.importorskip("yaml")
ROOT = Path(__file__).parents[1]


def test_every_paper_is_named():
    """In CITATION.cff, as the environment itself does."""
    cited = {}
    for paper in yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["references"]:
        authors = [
            one.get("name") or f"{one['given-names']} {one['family-names']}" for one in paper["authors"]
        ]
        cited[paper["notes"]] = f"{', '.join(authors)}, {paper['title']}"
    assert cited.keys() == catalogue().keys()
    for id, text in cited.items():
        assert find_companion(catalogue()[id], Paper).source.startswith(text)


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
