"""The README's snippets run as they stand, and its files and folders exist."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parent.parent / "README.md"
SNIPPETS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)


@pytest.mark.parametrize("snippet", SNIPPETS, ids=["filter designer", "RL researcher", "engineer"])
def test_snippet_runs(snippet, capsys):
    if "stable_baselines3" in snippet:
        pytest.importorskip("stable_baselines3")
    exec(compile(snippet, "README.md", "exec"), {"__name__": "snippet"})
    if "print(" in snippet:
        assert capsys.readouterr().out.strip()


def test_links_exist():
    text = README.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (README.parent / target).exists(), target
