"""Every environment has a page that names all there is: fields, keywords, scenarios, policies."""

import re
from pathlib import Path

import pytest
from filtergym.baselines.catalogue import baselines_of
from filtergym.envs.catalogue import catalogue, make_task, parameter_names

from filtergym.reports.environment_page import environment_tables, put_tables

DOCS = Path(__file__).parent.parent / "docs"
HEADINGS = (
    "Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End", "Arguments",
    "Scenarios", "Room table", "References", "Version History",
)  # fmt: skip


def page_file(id: str) -> Path:
    """Return the page that is about an environment: it says so below its title."""
    pages = (DOCS / "environments").glob("*.md")
    [own] = [p for p in pages if p.read_text(encoding="utf-8").splitlines()[2].startswith(f"`{id}`")]
    return own


def page(id: str) -> str:
    """Text of that page."""
    return page_file(id).read_text(encoding="utf-8")


@pytest.mark.parametrize("id", catalogue())
def test_tables_of_the_page_are_those_of_the_code(id, tmp_path):
    """If not: ``filtergym page ID --into docs/environments/PAGE.md``."""
    copy = tmp_path / "page.md"
    copy.write_text(page(id), encoding="utf-8")
    assert put_tables(id, copy) == list(environment_tables(id))
    assert copy.read_text(encoding="utf-8") == page(id)


@pytest.mark.parametrize("id", catalogue())
def test_page_has_the_usual_headings_and_a_room_table(id):
    text = page(id)
    assert [h for h in HEADINGS if f"\n## {h}\n" not in text] == []
    table = text.partition("<!-- room table: begin -->")[2].partition("<!-- room table: end -->")[0]
    assert "filtergym room" in table


@pytest.mark.parametrize("id", catalogue())
def test_page_names_everything(id):
    text = page(id)
    cls = catalogue()[id]
    known = baselines_of(id)
    names = {*parameter_names(cls), *cls.controls, *cls.scenarios, *known.names}
    assert sorted(name for name in names if f"`{name}`" not in text and f'`"{name}"`' not in text) == []


@pytest.mark.parametrize("id", catalogue())
def test_page_names_every_field(id):
    words = set(re.findall(r"`([a-zA-Z0-9_-]+)`", page(id)))
    for control in catalogue()[id].controls:
        for field in make_task(id, control).fields:
            # A page may leave out the numbers or letters that tell filters, satellites and axes apart.
            stem = field.name
            while stem and stem not in words:
                stem = stem.rpartition("_")[0]
            assert stem, f"{field.name} of control {control}"
