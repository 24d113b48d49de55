"""The snippets of README and of the package index's page run as they stand; what they point to exists."""

import re
import tomllib
from pathlib import Path

import pytest
from filtergym.envs.engine.catalogue import catalogue

README = Path(__file__).parent.parent / "README.md"
INDEX_PAGE = README.parent / "docs" / "package_index.md"
SNIPPETS = [
    snippet
    for page in (README, INDEX_PAGE)
    for snippet in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
]


@pytest.mark.slow
@pytest.mark.parametrize("snippet", SNIPPETS, ids=["filter designer", "live", "RL researcher", "index"])
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


def test_page_of_the_package_index_has_no_relative_link():
    """There the page stands alone, without the files beside it."""
    project = tomllib.loads((README.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert README.parent / project["readme"] == INDEX_PAGE
    links = re.findall(r"\]\(([^)]+)\)", INDEX_PAGE.read_text(encoding="utf-8"))
    assert [link for link in (*links, *project.get("urls", {}).values()) if "://" not in link] == []


def test_index_page_names_every_environment():
    text = INDEX_PAGE.read_text(encoding="utf-8")
    assert [id for id in catalogue() if f"`{id}`" not in text] == []
