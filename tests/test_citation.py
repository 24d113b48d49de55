"""CITATION.cff names the paper of every environment as the environment itself does."""

from pathlib import Path

import pytest
from filtergym.envs.engine.catalogue import catalogue

yaml = pytest.importorskip("yaml")
CITATION = yaml.safe_load((Path(__file__).parent.parent / "CITATION.cff").read_text(encoding="utf-8"))


def full_name(author):
    return author.get("name") or f"{author['given-names']} {author['family-names']}"


def test_every_paper_is_named():
    cited = {
        paper["notes"]: f"{', '.join(map(full_name, paper['authors']))}, {paper['title']}"
        for paper in CITATION["references"]
    }
    assert cited.keys() == catalogue().keys()
    for id, text in cited.items():
        assert catalogue()[id].paper_source.startswith(text)
