"""Every environment has a page that names all there is: fields, keywords, scenarios, policies.

And the pages for each audience run, the command line's page is that of the code, and every page is in the navigation.
"""

import functools
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import command_line
import gymnasium
import pytest
from contract import assert_properties
from environment_page import TABLES, environment_table
from models import make_model
from records import FOLDER, read_record

from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import bare_name, catalogue, parameter_names

DOCS = Path(__file__).parent.parent / "docs"
AUDIENCES = ("index.md", "filter_designer.md", "rl_researcher.md", "log_file.md")
MOST_WORDS = 18_300  # 18,000, and the page on estimation in the loop
"""Of prose by hand in ``docs/``: the limit."""
HEADINGS = (
    "Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End", "Arguments",
    "Scenarios", "What to expect", "References", "Version History", "Not reproduced",
)  # fmt: skip


def page_file(id: str) -> Path:
    """Return the page about an environment, by the line below its title."""
    pages = (DOCS / "environments").glob("*.md")
    [own] = [p for p in pages if p.read_text(encoding="utf-8").splitlines()[2].startswith(f"`{id}`")]
    return own


def page(id: str) -> str:
    """Text of that page, with the tables that are rendered of the code."""
    tables = [environment_table(problem_of(id), name) for name in (*TABLES, "policies")]
    return "\n".join([page_file(id).read_text(encoding="utf-8"), *tables])


def test_pages_of_environments():
    assert_properties(
        list(catalogue()), (has_the_usual_headings_and_tables, names_everything, names_every_field)
    )


def has_the_usual_headings_and_tables(id):
    text = page_file(id).read_text(encoding="utf-8")
    name = bare_name(id)
    assert [h for h in HEADINGS if f"\n## {h}\n" not in text] == []
    assert text.rpartition("\n## ")[2].startswith(HEADINGS[-1])
    assert f"```{{results-table}} {name}\n" in text
    for table in (*TABLES, "policies"):
        assert f"```{{environment-table}} {table}\n:environment: {name}\n```" in text


def names_everything(id):
    text = page(id)
    cls = catalogue()[id]
    known = baselines_of(id)
    names = {*parameter_names(cls), *cls.controls, *cls.scenarios, *known.names}
    assert sorted(name for name in names if f"`{name}`" not in text and f'`"{name}"`' not in text) == []


def names_every_field(id):
    words = set(re.findall(r"`([a-zA-Z0-9_-]+)`", page(id)))
    for control in catalogue()[id].controls:
        for field in make_model(id, control).fields:
            # A page may leave out the numbers or letters that tell filters, satellites and axes apart.
            stem = field.name
            while stem and stem not in words:
                stem = stem.rpartition("_")[0]
            assert stem, f"{field.name} of control {control}"


@pytest.mark.slow
@pytest.mark.parametrize("name", AUDIENCES)
def test_page_for_an_audience_runs(name, tmp_path, command, capsys, monkeypatch):
    """One block after the other in an empty folder; a block that names its file becomes it.

    With a short training and few episodes: numbers on the page are not tested.
    """
    text = re.sub(r"(episodes[= ])\d+", r"\g<1>12", (DOCS / name).read_text(encoding="utf-8"))
    blocks = re.findall(r"```(python|sh)\n(.*?)```", text, re.S)
    assert {language for language, _ in blocks} == {"python", "sh"}
    if "filtergym train" in text:
        pytest.importorskip("torch")
    if "--report" in text:
        pytest.importorskip("jinja2")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for language, block in blocks:
        file = re.match(r"# (\w+\.py)\n", block)
        if file:
            Path(file[1]).write_text(block, encoding="utf-8")
        elif language == "python":
            exec(compile(block, name, "exec"), {"__name__": "block"})
            assert "print(" not in block or capsys.readouterr().out.strip()
        else:
            for line in block.replace("\\\n", "").splitlines():
                _, *words = shlex.split(re.sub(r"--steps \d+", "--steps 12800 --no-compare", line))
                code, shown, errors = command(*words)
                assert (code, bool(shown)) == (0, True), errors


def test_page_of_the_command_line_holds_the_help(command):
    assert "```{command-line}\n" in (DOCS / "command_line.md").read_text(encoding="utf-8")
    sections = re.split(r"^## ", command_line.command_line_markdown(), flags=re.M)[1:]
    options = {
        name: set(re.findall(r"--[a-z-]+", table)) for name, _, table in (s.partition("\n") for s in sections)
    }
    assert list(options) == list(command_line.command_functions())
    for name, known in options.items():
        _, shown, _ = command(name, "--help")
        assert set(re.findall(r"(?<![\w-])--[a-z-]+(?= |$)", shown)) - {"--help"} <= known


def test_the_page_of_the_contract_names_the_scenarios_that_are_there():
    text = (DOCS / "contract.md").read_text(encoding="utf-8")
    for id, cls in catalogue().items():
        papers = {name for name in cls.scenarios if name.partition("-")[0] == "paper"}
        assert papers == ({"paper-noise", "paper-step"} if "UavAutopilot" in id else {"paper"})
        assert all(f"`{name}`" in text for name in papers)
        assert [name for name, scenario in cls.scenarios.items() if scenario.training] == ["random"]


@pytest.mark.parametrize("row", range(3))
def test_gymnasium_refuses_what_the_page_of_recipes_lists(row):
    table = (DOCS / "recipes.md").read_text(encoding="utf-8").partition("Gymnasium refuses:")[2]
    call, message = re.findall(r'^\| `([^|]+)`: "([^|]+)" \|', table, re.M)[row]
    names = {
        "ID": "filtergym/ManeuveringTarget-v0",
        "make_vec": functools.partial(gymnasium.make_vec, num_envs=2),
        "NormalizeObservation": gymnasium.wrappers.vector.NormalizeObservation,
    }
    with pytest.raises((ValueError, gymnasium.error.Error), match=re.escape(message)):
        eval(call.replace("...", "None"), names)


def words_by_hand(text: str) -> int:
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)
    return sum(len(line.split()) for line in prose.splitlines() if not line.lstrip().startswith(("|", "#")))


def test_pages_are_short():
    pages = [file for file in DOCS.rglob("*.md") if "reproductions" not in file.parts]
    assert sum(words_by_hand(file.read_text(encoding="utf-8")) for file in pages) <= MOST_WORDS


@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
def test_one_command_makes_all_that_is_shipped_and_published():
    made = ["make", "-n", "-B", "-f", "docs/make/numbers.mk"]
    done = subprocess.run(made, cwd=DOCS.parent, capture_output=True, text=True, check=True).stdout
    for file in (DOCS.parent / "agents" / "pretrained").glob("*/*.safetensors"):
        assert f"--algo {file.stem} " in done, file
        assert f"runs/{file.parent.name.removesuffix('-v0')}/{file.stem}-? " in done, file
    for tuned in (DOCS.parent / "baselines").glob("*/tuned.json"):
        assert f"baselines/{tuned.parent.name}/tuned.json" in done, tuned
    for file in (one for folder in ("", "harm", "stress") for one in (FOLDER / folder).glob("*.json")):
        name = file.relative_to(FOLDER).with_suffix("").as_posix()
        # Made from files, or with libraries, of others that are not here.
        foreign = ("drive.py", "public_problems.py", "optimised_kalman.py", "clients.py", "nclt/")
        made_of = read_record(name).command
        # A command writes its own record, or a table becomes one by its name.
        assert f"--name {name} " in done or made_of in done or any(word in made_of for word in foreign), file
    for id in catalogue():
        assert f"runs/{bare_name(id)}/*-? --scenario random" in done
    assert (
        done.count("docs/make seeds runs/") == done.count("--into docs/records --trust") == len(catalogue())
    )
    assert "python docs/make record results/full/results.json" in done
    for report in (DOCS / "reproductions").glob("*/report.md"):
        assert f"filtergym reproduce {report.parent.name} " in done, report
