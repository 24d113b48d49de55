"""What README and the pages tell to type is right: commands are parsed, names are known, Python imports what there is.

Pages for each audience run from top to bottom in ``test_docs.py``, snippets of README in ``test_readme.py``; here whole
those of pages of the reference run, too.
"""

import ast
import importlib
import re
import shlex
from pathlib import Path

import pytest
from contract import assert_properties

from filtergym.__main__ import application
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import catalogue
from filtergym.names import find_competitor

ROOT = Path(__file__).parent.parent
PAGES = {
    str(file.relative_to(ROOT)): file.read_text(encoding="utf-8")
    for file in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if "reproductions" not in file.parts
}
BLOCK = re.compile(r"^( *)```(python|py|sh|console)\n(.*?)^\1```", re.M | re.S)
RUNNING = {
    "docs/contract.md": "",
    "docs/compiled.md": "",
    "docs/agents_harm.md": "",
    "docs/own_data.md": "",
    "docs/smoothing.md": "--policy imm-lag-1",
    "docs/evaluation.md": "--out results/paper",
}
"""Pages of which every Python block runs, and what the commands say that run, too."""


def blocks(text, *languages):
    for indent, language, block in BLOCK.findall(text):
        if language in languages:
            yield re.sub(f"^{indent}", "", block, flags=re.M)


def commands(text):
    for block in blocks(text, "sh", "console"):
        for line in block.replace("\\\n", " ").splitlines():
            for command in re.split(r"&&|\|", line.removeprefix("$ ")):
                words = shlex.split(command.replace("$seed", "0").replace("$algo", "bptt"), comments=True)
                if words:
                    yield words


def test_pages():
    assert_properties(
        list(PAGES), (has_commands_that_are_parsed, has_python_that_compiles_and_imports_what_there_is)
    )


def has_commands_that_are_parsed(page):
    """Every option exists and every value has its type; nothing is executed."""
    program = application()
    for name, *words in commands(PAGES[page]):
        if name == "filtergym":
            command = program.get_command(None, words[0])
            assert command is not None, words
            # Environments of somebody's own are in modules that the page makes.
            own = [re.sub(r"^\w+:\w+/", "filtergym/", word) for word in words[1:]]
            foreign = own != words[1:]
            own = [str(next(iter(catalogue()))) if foreign and w.startswith("filtergym/") else w for w in own]
            params = command.make_context(words[0], own).params
            if not foreign:
                known(page, params)
        elif name == "python" and words[0] != "-m":
            script = ROOT / words[0]
            if script.is_dir():  # python docs/make COMMAND
                assert f"def {words[1]}(" in (script / "commands.py").read_text(encoding="utf-8"), words
            elif script.exists():
                text = script.read_text(encoding="utf-8")
                options = [word.partition("=")[0] for word in words[1:] if word.startswith("--")]
                assert [option for option in options if f'"{option}"' not in text] == [], words
            else:
                assert not words[0].startswith(("docs/", "benchmarks/")), words


def known(page, params):
    """Ask that environments, scenarios and policies of a command exist, where names are no files or modules."""
    id = params.get("environment")
    if not isinstance(id, str) or id not in catalogue():
        assert not str(id).startswith("filtergym/"), id
        return
    policies = params.get("policy") or ()
    for policy in [policies] if isinstance(policies, str) else policies:
        plain = policy.removeprefix("gated:")
        if not re.search(r"[/:.]", plain):
            assert find_competitor(problem_of(id), plain).maker, (page, policy)
    scenario = params.get("scenario")
    if isinstance(scenario, str) and re.fullmatch(r"[a-z-]+", scenario):
        assert scenario in catalogue()[id].scenarios, (page, scenario)


def has_python_that_compiles_and_imports_what_there_is(page):
    for block in blocks(PAGES[page], "python", "py"):
        for node in ast.walk(ast.parse(block, page)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("filtergym"):
                module = importlib.import_module(node.module)
                assert [name.name for name in node.names if not hasattr(module, name.name)] == []


@pytest.mark.slow
@pytest.mark.parametrize("page", RUNNING)
def test_page_runs(page, tmp_path, command, capsys, monkeypatch):
    """With few episodes; what the page needs of the project lies where it does in a checkout."""
    text = re.sub(r"(episodes[= ])\d+", r"\g<1>12", PAGES[page])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    space = {"__name__": "block"}
    for language, block in ((language, block) for _, language, block in BLOCK.findall(text)):
        if language == "python" and "\n    ...\n" not in block:
            exec(compile(block, page, "exec"), space)
            assert "print(" not in block or capsys.readouterr().out.strip()
        elif language == "sh" and RUNNING[page] and RUNNING[page] in block:
            _, *words = shlex.split(block.replace("\\\n", ""))
            assert command(*words)[0] == 0
