"""Records as CSV, tables for LaTeX, and what an evaluation writes into its folder."""

import csv
import itertools
import re

import pytest
import xarray
from rich.table import Table
from rich.text import Text

from filtergym import evaluate, record, tidy_records
from filtergym.commands import evaluation
from filtergym.evaluation.running.metrics import flight_records
from filtergym.evaluation.running.times import COORDINATES
from filtergym.papers.grid import Grid
from filtergym.reports.tables.export import latex_table, latex_text, records_as_csv
from filtergym.reports.tables.recording_tables import recording_tables
from filtergym.reports.tables.terminal_tables import flights_table, results_tables

ENV = "filtergym/ManeuveringTarget-v0"
NASTY = '50 % of $a_b$ & {c} ~ ^ # \\ < > | " ± 3 m², σ ≤ ∞, λ, 日, Müller'


@pytest.fixture(scope="module")
def dataset():
    return evaluate(ENV, ["imm", "adaptive", "known-turn", "known-input-bound"], "paper", 6, horizon=20)


@pytest.fixture(scope="module")
def tables(dataset):
    records = tidy_records(dataset)
    flights = evaluate(ENV, ["imm", "adaptive"], record(ENV, "paper", 3, horizon=15))
    nasty = Table(title=NASTY, caption=f"{NASTY}\n[second] line")
    nasty.add_column(NASTY)
    nasty.add_column("two\nlines [m]", justify="right")
    nasty.add_row("[1, 2]", "-5.3 [-7, -1e-3]\n[4]")
    nasty.add_row(Text("*", style="bold"), NASTY, end_section=True)
    nasty.add_row("", "")
    return {
        "results": results_tables(records, {}, 150)[0],
        "recorded": recording_tables(tidy_records(flights), {}, False, 150)[0],
        "flights": flights_table(flights, flight_records(flights), tidy_records(flights)),
        "grid": Grid("title", ["`a`", "b"], [["`x`", "1<br>[2, 3]"], ["`y`", "-"]]).__rich__(),
        "nasty": nasty,
    }


def test_records_as_csv_hold_every_field(dataset, tmp_path):
    records = tidy_records(dataset)
    records_as_csv(tmp_path / "a.csv", records)
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(records[0]._fields)
    assert len(rows) == len(records)
    for row, expected in zip(rows, records, strict=True):
        for name, value in expected._asdict().items():
            if value is None:
                assert row[name] == ""
            else:
                assert type(value)(row[name]) == value  # to the last digit
    records_as_csv(tmp_path / "none.csv", [])
    assert (tmp_path / "none.csv").read_text().startswith("environment,control,scenario,policy,kind,metric")


def cells_of(table):
    """What the terminal shows, row by row."""
    columns = [[getattr(cell, "plain", cell) for cell in column.cells] for column in table.columns]
    return [list(row) for row in zip(*columns, strict=True)]


def without_commands(text):
    """What a reader sees of a line of LaTeX; only for texts without characters that LaTeX spells."""
    return re.sub(r"\\([%&_#${}])", r"\1", text.replace("$-$", "-").replace("{}", ""))


@pytest.mark.parametrize("name", ["results", "recorded", "flights", "grid", "nasty"])
def test_tables_are_well_formed(tables, name):
    table = tables[name]
    text = latex_table(table)
    begun = re.findall(r"\\begin\{([\w*]+)\}", text)
    ended = re.findall(r"\\end\{([\w*]+)\}", text)
    assert sorted(begun) == sorted(ended)
    assert begun[:2] == ["table*" if len(table.columns) > 4 else "table", "tabular"]
    bare = re.sub(r"\\.", "", text)
    assert bare.count("{") == bare.count("}")
    assert bare.count("$") % 2 == 0
    body = text.partition("\\toprule")[2].partition("\\bottomrule")[0]
    rows = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert len(rows) == 1 + len(table.rows)
    assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {len(table.columns) - 1}
    assert not re.search(r"(?<!\\)[%#]", body)
    letters = re.search(r"\\begin\{tabular\}\{(\w+)\}", text).group(1)
    assert letters == "".join("r" if column.justify == "right" else "l" for column in table.columns)
    assert text.count("\\caption{") == 1


@pytest.mark.parametrize("name", ["results", "recorded", "flights"])
def test_cells_are_those_of_the_terminal(tables, name):
    table = tables[name]
    body = latex_table(table).partition("\\toprule")[2].partition("\\bottomrule")[0]
    rows = [line.removesuffix(r" \\") for line in body.splitlines() if line.endswith(r"\\")][1:]
    found = [[without_commands(cell) for cell in re.split(r"(?<!\\) & ", row)] for row in rows]
    assert found == cells_of(table)


def test_what_latex_takes_for_commands_is_escaped():
    assert latex_text("a_b & 50 %") == r"a\_b \& 50 \%"
    assert latex_text("-5.3 [-7, -.1] 1e-3 plain-white a-1") == "$-$5.3 [$-$7, $-$.1] 1e-3 plain-white a-1"
    assert latex_text("σ λ ± 日 é") == r"$\sigma$ $\lambda$ $\pm$ [U+65E5] é"


def test_an_evaluation_writes_everything_or_nothing(tmp_path, monkeypatch, success, refusal):
    out = tmp_path / "out"
    words = f"evaluate {ENV} --scenario paper --policy imm --policy adaptive --episodes 4".split()
    options = ("--format", "svg", "--columns", 1)
    # All figures are drawn by a test of the command line.
    drawn = evaluation.evaluation_figures
    monkeypatch.setattr(evaluation, "evaluation_figures", lambda *a, **k: itertools.islice(drawn(*a, **k), 1))
    success(*words, "--set", "horizon=20", "--out", out, *options)
    expected = {"records.json", "records.csv", "table.tex", "results.nc", "results.json", "report.html"}
    expected |= {"rmse_over_time.svg", "worst_episodes.svg"}
    assert {path.name for path in out.iterdir()} == expected
    assert re.search(r'width="252(\.0)?pt"', (out / "rmse_over_time.svg").read_text())
    assert "imm & weights" in (out / "table.tex").read_text()
    dataset = evaluate(ENV, ["imm", "adaptive"], "paper", 4, horizon=20)
    with xarray.open_dataset(out / "results.nc", engine="scipy") as read:
        # The command also measures time.
        xarray.testing.assert_identical(read.load().drop_vars(list(COORDINATES)), dataset)
    assert (out / "results.nc").read_bytes()[:4] == b"CDF\x02"  # the classic format, which R and MATLAB open

    def spoilt(*_, **__):
        raise ValueError("no ink")

    monkeypatch.setattr("filtergym.commands.evaluation.save", spoilt)
    refusal(*words, "--out", tmp_path / "none")
    for wrong, named in (("--format", "gif"), "got 'gif'"), (("--columns", 3), "columns"):
        assert named in refusal(*words, "--out", tmp_path / "none", *wrong)
    assert not (tmp_path / "none").exists()


def test_results_that_do_not_fit_are_left_out_and_reported(tmp_path, without_figures, monkeypatch, success):
    monkeypatch.setattr("filtergym.commands.evaluation.MOST_BYTES", 1000)
    words = ("evaluate", ENV, "--scenario", "paper", "--policy", "imm", "--episodes", 4, "--out", tmp_path)
    assert "results.nc is left out" in success(*words)
    assert not (tmp_path / "results.nc").exists()
    assert (tmp_path / "records.csv").exists()
