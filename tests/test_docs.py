"""Every environment has a page that names all there is: fields, keywords, scenarios, policies."""

import re
from pathlib import Path

import pytest
from filtergym.baselines.catalogue import baselines_of
from filtergym.envs.catalogue import catalogue, make_task, parameter_names

DOCS = Path(__file__).parent.parent / "docs"
HEADINGS = (
    "Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End", "Arguments",
    "Scenarios", "Room table", "References", "Version History",
)  # fmt: skip


def page(id: str) -> str:
    """Return the page that is about an environment: it says so below its title."""
    pages = [path.read_text(encoding="utf-8") for path in (DOCS / "environments").glob("*.md")]
    [own] = [text for text in pages if text.splitlines()[2].startswith(f"`{id}`")]
    return own


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
    words = set(re.findall(r"`([a-zA-Z0-9_]+)`", page(id)))
    for control in catalogue()[id].controls:
        for field in make_task(id, control).fields:
            # A page may leave out the numbers or letters that tell filters, satellites and axes apart.
            stem = field.name
            while stem and stem not in words:
                stem = stem.rpartition("_")[0]
            assert stem, f"{field.name} of control {control}"
