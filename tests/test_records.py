"""Numbers are data: what commands write is what pages render, and a sentence with a number names its record."""

import re
import subprocess
import sys
from pathlib import Path

import comparison
import front
import pytest
from comparison import compared_policies
from contract import assert_properties
from front import panels_of
from made_results import results_of
from readme import insert_numbers
from records import (
    FOLDER,
    BenchmarkRecords,
    ResultRecord,
    markdown_tables,
    read_benchmark,
    read_record,
    recorded_environments,
    table_cell,
    write_record,
)
from results_table import chosen_markdown, results_markdown
from sentence_numbers import number_text, record_of

from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import problem_of
from filtergym.evaluation.competitors.kinds import RANKED
from filtergym.evaluation.running.metrics import Record
from filtergym.reports.tables.ranking import best_competitor
from filtergym.reports.tables.results import settings_of, write_results

ENV = "filtergym/ManeuveringTarget-v0"
DOCS = Path(__file__).parent.parent / "docs"
PAGES = {
    str(path.relative_to(DOCS.parent)): path.read_text(encoding="utf-8")
    for path in (DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md")))
    if "reproductions" not in path.parts  # each is the record of one command, and names it
}
ROLE = re.compile(r"\{(number|value|record)\}`([^`]+)`")
MEASURED = re.compile(r"(?<![\w.])\d[\d,.]*\s?(?:%|ns\b|µs\b|\[[-+\d., ]+\])")
NAMED = re.compile(r"\{record\}`|docs/records/")
"""How a section names the source of its numbers; README, which is not rendered, by a link."""
MOST_BYTES = 400_000


def unnamed_numbers(text: str) -> list[str]:
    """Return the measured numbers of a page in sections that name no record.

    Measured is what is per cent, in ns or µs, or has an interval. What stands in code is none, and 95 % is the
    confidence of every interval.
    """
    text = re.sub(r"^( *)(```+).*?^\1\2$", "", text, flags=re.M | re.S)
    found = []
    for section in re.split(r"^#+ .*$", text, flags=re.M):
        if not NAMED.search(section):
            plain = re.sub(r"`[^`]*`", "", ROLE.sub("", section))
            found += [number for number in MEASURED.findall(plain) if number != "95 %"]
    return found


def test_pages():
    assert_properties(list(PAGES), (names_the_record_of_every_number, names_what_is_there))


def names_the_record_of_every_number(page):
    assert unnamed_numbers(PAGES[page]) == []


def names_what_is_there(page):
    for role, path in ROLE.findall(re.sub(r"``.*?``(?!`)", "", PAGES[page])):
        if role == "record":
            assert read_record(path).command
        else:
            assert number_text(path)


@pytest.mark.claims
@pytest.mark.parametrize("name", recorded_environments())
def test_the_strongest_classical_competitor_is_in_the_quick_benchmark(name):
    """Else its verdict would name another as the best."""
    found, _ = read_benchmark(name)
    training, learned = found.problem.task.default_scenario, pretrained_agents(found.problem.id)
    cost = {
        r.policy: r.value
        for r in found.records
        if (r.scenario, r.metric) == (training, "geometric_cost")
        and r.kind in RANKED
        and r.policy not in learned
    }
    best = min(cost, key=cost.get)
    assert best.removesuffix("-tuned") in found.problem.baselines.benchmark


def test_every_record_is_small_and_shown():
    everything = "\n".join(PAGES.values())
    for file in sorted(FOLDER.rglob("*.json")):
        name = file.relative_to(FOLDER).with_suffix("").as_posix()
        record = read_record(name)
        assert file.stat().st_size < MOST_BYTES, name
        assert record.command, name
        assert record.data, name
        shown = {"benchmark": f"{{comparison}} {file.stem}\n", "seeds": f"{{seeds}} {file.stem}\n"}
        assert shown.get(file.parent.name, f"{{record-table}} {name}\n") in everything, name


@pytest.mark.claims
@pytest.mark.parametrize("name", ["README.md", "papers/joss/paper.md"])
def test_readme_and_paper_show_the_records(name):
    """If not: ``python docs/make readme NAME``."""
    page = DOCS.parent / name
    assert insert_numbers(page) == page.read_text(encoding="utf-8")


def test_readme_gets_its_numbers(tmp_path, make_page, monkeypatch):
    import commands

    monkeypatch.chdir(tmp_path)
    # Places for the names in the picture of one environment take seconds to find.
    monkeypatch.setattr(commands, "recorded_environments", lambda: ["RadarEsmTracking"])
    page = tmp_path / "README.md"
    page.write_text("no numbers")
    code, _, errors = make_page("readme", page)
    assert (code, "holds no number of a record" in errors) == (2, True)
    page.write_text("It is\n<!-- value: ManeuveringTarget/random/bptt/difference --><!-- end -->")
    code, _, errors = make_page("readme", page)
    assert (code, "begins a line, which ends a paragraph" in errors) == (2, True)
    path = "ManeuveringTarget/random/imm-tuned/difference"
    page.write_text(f"a <!-- value: {path} -->old<!-- end --> b <!-- number: {path} --><!-- end -->\nc")
    code, _, errors = make_page("readme", page, "--picture", "front.svg")
    assert code == 0, errors
    shown = [number_text(path, interval) for interval in (False, True)]
    assert page.read_text() == (
        f"a <!-- value: {path} -->{shown[0]}<!-- end --> b <!-- number: {path} -->{shown[1]}<!-- end -->\nc"
    )
    assert "<svg" in (tmp_path / "front.svg").read_text()


SMALL = {"split": "validation", "horizon": 30}
NAMES = ["imm", "imm-tuned", "adaptive-rearm", "ppo", "known-turn", "known-input-bound"]


@pytest.fixture(scope="module")
def result():
    return results_of(ENV, NAMES, None, 10, **SMALL)


@pytest.fixture
def recorded(result, tmp_path, make_page, monkeypatch):
    """The folder of the record of one small benchmark."""
    monkeypatch.chdir(tmp_path)
    write_results(tmp_path / "results.json", [result], settings_of("filtergym benchmark"))
    code, _, errors = make_page("record", "results.json", "--into", "records", "--note", "A try.")
    assert code == 0, errors
    return tmp_path / "records"


def value(records, name, metric):
    return next(r for r in records if (r.policy, r.metric, r.window) == (name, metric, "all"))


def test_a_record_holds_what_was_measured(recorded, result):
    found, record = read_benchmark("ManeuveringTarget", recorded)
    assert (found.problem.id, record.command, record.note) == (ENV, "filtergym benchmark", "A try.")
    assert "numpy" in record.versions
    measured = {r[:8]: r for r in result.records}
    assert {r.policy for r in found.records} == {*NAMES}
    for own in found.records:
        known = measured[own[:8]]
        assert own[11:] == known[11:]
        for kept, before in zip(own[8:11], known[8:11], strict=True):
            # Six digits are kept: half a unit of the sixth.
            assert (kept is None) == (before is None)
            assert kept is None or kept == pytest.approx(before, rel=5e-6, abs=0)


def test_comparison_shows_what_the_records_say(recorded, result):
    records = result.records
    measured, record = read_benchmark("ManeuveringTarget", recorded)
    compared = comparison.compare_environment(measured)
    cost, error, tail, consistent, _ = compared.grids
    classical = sorted(
        ["imm-tuned", "adaptive-rearm"], key=lambda name: value(records, name, "geometric_cost").value
    )
    # What is looked for first comes first: on a narrow screen the rest is scrolled to.
    first = ["`ppo` (learned)", *(f"`{name}`" for name in classical)]
    assert cost.header == ["scenario", "verdict", *first, "`known-turn` (reference)"]
    assert (
        tail.header == consistent.header == ["scenario", *first, "`imm` (paper)", "`known-turn` (reference)"]
    )
    assert cost.rows[0][1] == best_competitor(records)
    assert tail.rows[0][4].endswith("<br>+0.0")
    assert consistent.rows[0][1].startswith(f"{value(records, 'ppo', 'anees').value:.3g}")
    assert error.header[:-1] == tail.header
    assert error.header[-1] == "`known-input-bound` (bound)"
    difference = 100.0 * value(records, "ppo", "geometric_cost_difference").value
    assert float(cost.rows[0][2].partition("<br>")[0]) == pytest.approx(difference, rel=5e-3)
    *best, reference = comparison.summary([measured]).rows
    assert {tuple(row[:3]) for row in best} == {
        ("ManeuveringTarget", "`ppo`", "learned policy"),
        ("ManeuveringTarget", f"`{classical[0]}`", "classical"),
    }
    assert reference[:3] == ["ManeuveringTarget", "`known-turn`", "reference"]
    [worst] = comparison.harm([measured]).rows
    assert worst[:3] == ["ManeuveringTarget", "`ppo`", "`random`"]
    assert worst[3] == cost.rows[0][2].replace("<br>", " ")
    text = comparison.comparison_markdown(compared, measured, record)
    assert "Made by `filtergym benchmark` on " in text
    assert "**A try.**" in text
    assert "| ManeuveringTarget | `ppo` | `random` |" in comparison.overview_markdown([measured], "harm")
    with pytest.raises(ValueError, match=r"no table 'worst': there are best, harm"):
        comparison.overview_markdown([measured], "worst")


def test_a_record_takes_competitors_measured_later(recorded, tmp_path, make_page):
    """Over the same episodes they are as if they had been there; a competitor with other results is refused."""
    later = results_of(ENV, ["imm", "imm-tuned", "ppo", "known-turn", "zero"], None, 10, **SMALL)
    write_results(tmp_path / "later.json", [later], settings_of("filtergym evaluate"))
    before, _ = read_benchmark("ManeuveringTarget", recorded)
    [best] = {r.component for r in before.records if r.metric == "behind_best"}
    assert best in {"imm", "imm-tuned", "ppo", "known-turn"}
    code, _, errors = make_page("record", "later.json", "--into", "records", "--add", "zero")
    assert code == 0, errors
    after, record = read_benchmark("ManeuveringTarget", recorded)
    assert (record.command, record.note) == ("filtergym benchmark", "A try.")
    assert {r.policy for r in after.records} == {*NAMES, "zero"}
    assert [r for r in after.records if r.policy != "zero"] == before.records
    assert value(after.records, "zero", "cost").value == pytest.approx(
        value(later.records, "zero", "cost").value, rel=5e-6, abs=0
    )
    other = results_of(ENV, ["imm", best, "known-turn", "zero"], None, 10, seed=1, **SMALL)
    write_results(tmp_path / "other.json", [other], settings_of("filtergym evaluate"))
    for words, message in (
        (("other.json", "--add", "zero"), "the record has seed 0, what is added 1"),
        (("later.json", "--add", "zero", "--add", "imm"), ""),
        (("later.json", "--add", "adaptive"), "adaptive took no part in random"),
    ):
        code, _, errors = make_page("record", *words, "--into", "records")
        assert (code, message in errors) == (2 if message else 0, True)
    data = {**read_record("benchmark/ManeuveringTarget", recorded).data}
    [scenario] = data["scenarios"]
    cost = data["scenarios"][scenario]["competitors"]["imm"]["metrics"]["cost"]
    cost[0] *= 1.001
    write_record("benchmark/ManeuveringTarget", record._replace(data=data), recorded)
    code, _, errors = make_page("record", "later.json", "--into", "records", "--add", "zero")
    assert (code, "imm costs something else in the record" in errors) == (2, True)


def test_results_table_of_everybody_and_of_some(recorded, result):
    found, record = read_benchmark("ManeuveringTarget", recorded)
    whole = results_markdown(found, record)
    assert [re.match(r"\| `(.*?)`", row)[1] for row in whole.splitlines()[2:8]] == [
        *sorted(NAMES[:4], key=lambda name: value(result.records, name, "geometric_cost").value),
        *NAMES[4:],
    ]
    some = chosen_markdown(
        {"ManeuveringTarget": (found, record)}, "", ["ppo", "imm"], ["difference", "anees"]
    )
    [data] = markdown_tables(some)
    assert data["columns"] == ["policy", "cost against `imm`, %", "ANEES"]
    assert {row[0] for row in data["rows"]} == {"`ppo`", "`imm`"}
    # A row is that of the whole table, whatever other rows are shown.
    [everything] = markdown_tables(whole)
    for row in data["rows"]:
        assert row[1] == table_cell(everything, row[0].strip("`"), "cost against")
    with pytest.raises(ValueError, match="no column 'price'"):
        chosen_markdown({"ManeuveringTarget": (found, record)}, columns=["price"])
    with pytest.raises(ValueError, match=r"no records of .* in scenario 'paper'"):
        results_markdown(found, record, "paper")


def test_numbers_of_sentences(tmp_path):
    metrics = {
        "geometric_cost_difference": [-0.43551, -0.45, -0.42099],
        "relative_cost_difference": [-0.4, -0.5, -0.3],
        "lost_tracks": [0.025, 0.02, 0.03],
        "behind_best semi-markov": [0.04, 0.03, 0.05],
        "rmse position": [203.4, 200.1, 206.0],
        "nanoseconds compiled": [78.4, None, None],
        "score": [None, None, None],
    }
    competitor = {"kind": "policy", "control": "gain", "metrics": metrics}
    scenarios = {"random": {"episodes": 9, "competitors": {"bptt": competitor}}}
    about = {"environment": ENV, "split": "test", "seed": 0, "units": {"rmse position": "m"}}
    data = {**about, "scenarios": scenarios}
    write_record("benchmark/ManeuveringTarget", ResultRecord("c", "2026-01-01", {}, "", data), tmp_path)
    for quantity, expected in {
        "difference": "-43.6 % [-45.0, -42.1]",
        "means": "-40.0 % [-50.0, -30.0]",
        "lost": "2.50 % [2.00, 3.00]",
        "behind": "4.00 % [3.00, 5.00]",
        "rmse position": "203 m [200, 206]",
        "ns": "78 ns",
        "score": "-",
    }.items():
        path = f"ManeuveringTarget/random/bptt/{quantity}"
        assert number_text(path, folder=tmp_path) == expected
        assert number_text(path, False, tmp_path) == expected.partition(" [")[0]
        assert record_of(path) == "benchmark/ManeuveringTarget"
    for wrong in (
        "random/bptt/price",
        "random/missing/cost",
        "nowhere/bptt/cost",
        "random",
        "random/bptt/rmse x",
    ):
        with pytest.raises(ValueError, match="leads nowhere"):
            number_text(f"ManeuveringTarget/{wrong}", folder=tmp_path)
    cost = ["bptt", "mean", "imm", "relative_cost_difference", "", -0.451, -0.477, -0.425]
    seeds = {"paper": "imm", "scenarios": {"random": [cost]}}
    write_record("seeds/ManeuveringTarget", ResultRecord("c", "2026-01-01", {}, "", seeds), tmp_path)
    path = "seeds/ManeuveringTarget/random/bptt"
    assert number_text(f"{path}/mean", folder=tmp_path) == "-45.1 % [-47.7, -42.5]"
    with pytest.raises(ValueError, match="leads nowhere"):
        number_text(path, folder=tmp_path)
    with pytest.raises(ValueError, match="no record 'plain'"):
        number_text("plain/a/b", folder=tmp_path)


PRINTED = """progress
| environment | policy | cost | cost of others |
|---|---|---:|---|
| One | `a` | -1.5 | 2 |
| | `b` | 3 | 4 |

| name | x/y |
|---|---|
| c | 5 |
"""


def test_tables_that_a_command_printed_become_records(tmp_path, make_page, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("printed.txt").write_text(PRINTED)
    arguments = ("table", "printed.txt", "--name", "first", "--command", "python it.py", "--into", "records")
    code, _, errors = make_page(*arguments)
    assert (code, "holds 2 tables, and there are 1 names" in errors.replace("\n", " ")) == (2, True)
    assert make_page(*arguments, "--name", "second")[0] == 0
    first, second = (read_record(name, tmp_path / "records") for name in ("first", "second"))
    assert first.command == "python it.py"
    assert table_cell(first.data, "One b", "cost") == "3"
    assert (
        table_cell(second.data, "c", "x/y") == number_text("second/c/x/y", folder=tmp_path / "records") == "5"
    )
    for row, column in (("One", "cost"), ("Two", "cost"), ("One a", "price"), ("One a", "co")):
        with pytest.raises(ValueError, match="one of each is needed"):
            table_cell(first.data, row, column)


def test_what_is_no_record(tmp_path):
    with pytest.raises(ValueError, match="no name of a record"):
        read_record("../secret")
    (tmp_path / "other.json").write_text("[]")
    with pytest.raises(ValueError, match="is no record"):
        read_record("other", tmp_path)
    with pytest.raises(ValueError, match="unknown environment 'Manoeuvre'"):
        read_benchmark("Manoeuvre", tmp_path)


def test_the_front_is_drawn_of_every_environment_that_is_recorded():
    names = recorded_environments()
    found = [read_benchmark(name)[0] for name in names]
    assert [panel.title for panel in panels_of(found)] == names
    for own in found:
        assert {own.problem.paper, own.problem.baselines.score_reference} <= {*compared_policies(own)}
        assert problem_of(own.problem.id).task.default_scenario in {r.scenario for r in own.records}


PAGE = """# A page

It costs {number}`ManeuveringTarget/random/bptt/difference`, {value}`plain_ppo/ManeuveringTarget/mean` elsewhere.
From {record}`benchmark/ManeuveringTarget`.

```{results-table} ManeuveringTarget
:policies: bptt, imm
:columns: anees
```

```{front-figure} ManeuveringTarget
```

```{record-table} plain_ppo
:columns: environment, mean
:bare:
```

```{environment-table} actions
:environment: ManeuveringTarget
```
"""
WRONG = """# Wrong

{number}`ManeuveringTarget/random/bptt/price`, {record}`nothing`

```{results-table} Nothing
```

```{environment-table} actions
```
"""


@pytest.mark.slow
def test_sphinx_renders_what_a_page_names(tmp_path):
    pytest.importorskip("myst_parser")
    place = f"import sys\nsys.path.insert(0, {str(DOCS / 'make')!r})\n"
    (tmp_path / "conf.py").write_text(place + "extensions = ['myst_parser', 'record_directives']\n")

    def built(text):
        (tmp_path / "index.md").write_text(text)
        command = [sys.executable, "-m", "sphinx", "-E", "-q", "-b", "html", tmp_path, tmp_path / "site"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return done.stderr, (tmp_path / "site" / "index.html").read_text(encoding="utf-8")

    warnings, page = built(PAGE)
    assert warnings == ""
    assert number_text("ManeuveringTarget/random/bptt/difference") in page
    for word in (
        "front_ManeuveringTarget.svg",
        "ManeuveringTarget.json",
        "<td><p>ManeuveringTarget</p></td>",
        number_text("plain_ppo/ManeuveringTarget/mean"),
    ):
        assert word in page
    assert len(list((tmp_path / "site" / "_images").iterdir())) == 1
    warnings, _ = built(WRONG)
    for line, words in (
        (3, "leads nowhere"),
        (3, "no record"),
        (5, "unknown environment"),
        (8, "option environment"),
    ):
        assert re.search(rf"index\.md:{line}: WARNING: .*{words}", warnings), (line, words, warnings)


def test_budgets_of_time_name_who_costs_least_in_each(monkeypatch):
    """Bold is whose whole interval lies below the other's; who takes longer than a budget is not in its column."""
    problem = problem_of(ENV)
    monkeypatch.setattr(front, "pretrained_agents", lambda id: {"quick agent", "agent"})
    shared = (ENV, "gain", problem.task.default_scenario)
    records = []
    for name, time, *cost in (
        ("imm", 90.0, -0.1, -0.12, -0.08),
        ("quick agent", 95.0, -0.2, -0.22, -0.18),
        ("slow", 800.0, -0.3, -0.35, -0.25),
        ("agent", 900.0, -0.31, -0.36, -0.26),
    ):
        for metric, part, values in (
            ("nanoseconds", "compiled", (time, None, None)),
            ("geometric_cost_difference", "", cost),
        ):
            records.append(Record(*shared, name, "policy", metric, part, "all", *values, "", 10, 0, "test"))
    lines = front.budgets_markdown([BenchmarkRecords(problem, records)]).splitlines()
    classical, learned = ([cell.strip() for cell in line.split("|")[3:-1]] for line in lines[2:])
    assert (classical[0], learned[0]) == ("`imm` -10.0", "**`quick agent` -20.0**")
    assert (classical[1], learned[1]) == (classical[0], learned[0])
    assert (classical[2], learned[2]) == ("`slow` -30.0", "`agent` -31.0")
