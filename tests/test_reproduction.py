"""What every reproduction of a paper shares: finding it, writing its page, saving it whole or not at all."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy
import pytest
from matplotlib.figure import Figure

from filtergym.papers.grid import Grid
from filtergym.papers.quantities import Quantity, mean, means, quantity
from filtergym.papers.reproduction import (
    Claim,
    Reproduction,
    episode_count,
    reproduction_command,
    verdict_of,
)
from filtergym.reproductions import paper_module, papers


def example() -> Reproduction:
    figure = Figure(figsize=(1, 1))
    figure.subplots().plot([0, 1])
    return Reproduction(
        "A paper",
        [Claim("C1", "It is small.", "|e| = 3.1 ± 0.2 m", "10 runs", "not reproduced")],
        [Grid("Errors", ("run", "m"), [("first", "3.0"), ("second", "3.2")])],
        {"figure_1": (figure, "The error."), "figure_2": (figure, "The same again.")},
        reproduction_command("filtergym.papers.a_paper", 3),
    )


def test_an_unknown_paper_is_named_with_what_was_meant() -> None:
    with pytest.raises(ValueError, match=r"unknown paper 'imm-alpha-gamma'.*'imm-alpha-beta'"):
        paper_module("imm-alpha-gamma")


def test_a_package_without_the_repository_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("filtergym.reproductions.PAPERS", "filtergym.no_papers")
    with pytest.raises(ValueError, match="are part of the repository, not of the package"):
        paper_module("imm-alpha-beta")


def test_every_paper_refuses_episodes_without_an_interval() -> None:
    assert (episode_count(None, 50), episode_count(2, 50)) == (50, 2)
    for name in papers():
        for episodes in (0, 1):
            with pytest.raises(ValueError, match=f"episodes must be at least .* got {episodes}"):
                paper_module(name).reproduce(lambda done=1: None, episodes)


def test_the_page_holds_claims_tables_and_figures() -> None:
    lines = example().markdown().splitlines()
    assert lines[0] == "# A paper"
    assert lines[2] == "Made by `filtergym reproduce a-paper --episodes 3 --out DIR`."
    # A bar inside a cell must not open another cell.
    assert "| **C1.** It is small. | \\|e\\| = 3.1 ± 0.2 m | 10 runs | **not reproduced** |" in lines
    table = lines[lines.index("## Errors") + 2 :][:4]
    assert table == ["| run | m |", "|---|---|", "| first | 3.0 |", "| second | 3.2 |"]
    assert "![The error.](figure_1.png)" in lines
    assert "![The same again.](figure_2.png)" in lines


@pytest.mark.parametrize("formats", [("png",), ("svg", "pdf")])
def test_saving_writes_the_page_and_every_figure_and_nothing_else(formats: Any, tmp_path: Path) -> None:
    example().save(tmp_path, formats)
    figures = [f"figure_{i}.{suffix}" for i in (1, 2) for suffix in sorted(formats)]
    assert sorted(p.name for p in tmp_path.iterdir()) == [*figures, "report.md"]
    assert f"![The error.](figure_1.{formats[0]})" in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_a_failure_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    class Unpaintable:
        def savefig(self, *_: object, **__: object) -> None:
            raise RuntimeError("no ink")

    (tmp_path / "report.md").write_text("the last one", encoding="utf-8")
    result = example()
    result = replace(result, figures={**result.figures, "figure_2": (Unpaintable(), "Nothing.")})
    with pytest.raises(RuntimeError, match="no ink"):
        result.save(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["report.md"]
    assert (tmp_path / "report.md").read_text(encoding="utf-8") == "the last one"


def test_a_measured_number_is_written_with_its_standard_error() -> None:
    number = Quantity(0.07512, 0.069, 0.081, 0.0031)
    assert f"{number}" == "0.0751 ± 0.0031"
    assert f"{number:.3f}" == "0.075 ± 0.003"
    assert f"{number:+.1%}" == "+7.5 ± 0.3 %"
    # Without error digits to go by, an exact number is written alone, and a certain one with four.
    assert f"{Quantity(45.9, 45.9, 45.9):.2f}" == "45.90"
    assert f"{Quantity(1.0, 1.0, 1.0, 0.0)}" == "1.0000 ± 0.0000"


def test_uncertainty_comes_from_the_runs_and_is_paired() -> None:
    values = 5.0 + numpy.random.default_rng(0).standard_normal(400)
    found = mean(values)
    assert found.value == pytest.approx(values.mean(), rel=1e-12)
    # 500 bootstrap samples give a standard error to 3 %; four of those.
    assert found.error == pytest.approx(values.std() / 20.0, rel=0.13)
    assert found.low == pytest.approx(found.value - 1.96 * found.error, abs=0.3 * found.error)
    assert found.high == pytest.approx(found.value + 1.96 * found.error, abs=0.3 * found.error)
    ratio = quantity(means(3.0 * values) / means(values))
    assert (ratio.value, ratio.error) == pytest.approx((3.0, 0.0), abs=1e-14)
    assert numpy.isnan(quantity(numpy.array([2.0])).error)


def test_a_claim_of_several_parts() -> None:
    assert verdict_of([True, True]) == "reproduced"
    assert verdict_of([True, False]) == "reproduced in part"
    assert verdict_of(iter([False, False])) == "not reproduced"
