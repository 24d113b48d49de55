"""The snippets of README and of the package index's page run as they stand; what they point to exists."""

import re
import tomllib
from pathlib import Path

import pytest
from readme import insert_outputs
from records import read_record

import filtergym
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


def without_times(text):
    """What is the same on every machine: without the column of times, which follows ANEES, and however wide it is."""
    return re.sub(r"[ ─]+", " ", re.sub(r"( \d\.\d\d(?: !)?) +[\d,]+(?: py)?(?: \*)?", r"\1", text))


@pytest.mark.slow
def test_commands_print_what_the_readme_shows():
    """``python docs/make readme --printed`` puts it there again."""
    pytest.importorskip("llvmlite")  # what is compiled is not marked as asked in Python
    text = README.read_text(encoding="utf-8")
    assert without_times(insert_outputs(README)) == without_times(text)
    # The text names the episodes, as the table's title does.
    for words in (
        "500 episodes, test split, seed 0",
        "500 of the test split, seed 0",
        "5,000 unseen flights",
    ):
        assert words in text


def test_the_headline_names_the_episodes_of_its_record():
    scenario = read_record("benchmark/ManeuveringTarget").data["scenarios"]["random"]
    assert f"On {scenario['episodes']:,} unseen flights" in README.read_text(encoding="utf-8")


def test_what_a_page_shows_of_its_commands_is_what_they_print(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "In `exit.py`:\n\n```python\nraise SystemExit\n```\n\n```sh\nfiltergym --version\n```\n\n"
        "<!-- printed: begin -->\nold\n<!-- printed: end -->\n"
    )
    shown = insert_outputs(page)
    assert (
        f"<!-- printed: begin -->\n\n```text\nfiltergym {filtergym.__version__}\n```\n\n<!-- printed: end -->"
        in shown
    )
    assert "old" not in shown
    page.write_text(page.read_text().replace("--version", "--nothing"))
    with pytest.raises(ValueError, match="filtergym --nothing failed"):
        insert_outputs(page)


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
