"""Imports run one way, a file knows only its own room and those before it; and slow libraries wait until needed."""

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from filtergym.baselines.catalogue import baselines_of
from filtergym.envs.engine.catalogue import folders

ROOT = Path(__file__).parent.parent
ROOMS = (
    "compiler",
    "filters",
    "envs",
    "evaluation",
    "baselines",
    "agents",
    "filtergym",
    "filtergym/papers",
    "docs/make",
)
"""The last two are not installed, so nothing in the package may import them."""
INNER_ROOMS = {
    "envs": ("contract", "data", "drawing", "engine", "interface", "linear", "logs", *folders().values()),
    "evaluation": ("storage", "statistics", "competitors", "running", "stress", "figures"),
    "filtergym/reports": ("tables", "pages"),
}
"""Rooms inside a room, in the same order; the environments come last and know nothing of each other."""
FILES = sorted({path.relative_to(ROOT) for room in ROOMS for path in (ROOT / room).rglob("*.py")})
PAGES = {path.stem for path in (ROOT / "docs" / "make").glob("*.py")}


@functools.cache
def imports_of(file: Path) -> list[tuple[list[str], bool]]:
    """Everything that a file imports, part by part, and whether only type checkers import it."""
    package = ["filtergym", *(part for part in file.parent.parts if part != "filtergym")]
    found: list[tuple[list[str], bool]] = []
    waiting: list[tuple[ast.AST, bool]] = [(ast.parse((ROOT / file).read_text(encoding="utf-8")), False)]
    while waiting:
        node, for_types = waiting.pop()
        for_types = for_types or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            module = [*base, *(node.module or "").split(".")] if node.module else base
            found += [([*module, alias.name], for_types) for alias in node.names]
        elif isinstance(node, ast.Import):
            found += [(alias.name.split("."), for_types) for alias in node.names]
        elif isinstance(node, ast.stmt | ast.Module | ast.ExceptHandler):
            waiting += [(inside, for_types) for inside in ast.iter_child_nodes(node)]
    return found


def room_of(file: Path) -> str:
    return max((room for room in ROOMS if file.is_relative_to(room)), key=len)


def imported_rooms(file: Path) -> Iterator[str]:
    """Names of the rooms that a file imports anything from; the package itself is the front room."""
    for (first, *rest), _ in imports_of(file):
        if first in PAGES:
            yield "docs/make"
        elif first == "filtergym" and rest[:1] != [
            "extensions"
        ]:  # a table of names, which every room may read
            room = "filtergym/papers" if rest[:1] == ["papers"] else "".join(rest[:1])
            yield room if room in ROOMS else "filtergym"


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_knows_only_those_before_it(room: str) -> None:
    allowed = ROOMS[: ROOMS.index(room) + 1]
    wrong = {
        f"{file} imports {other}"
        for file in FILES
        if room_of(file) == room
        for other in imported_rooms(file)
        if other not in allowed
    }
    assert not wrong


@pytest.mark.parametrize("room", INNER_ROOMS)
def test_an_inner_room_knows_only_those_before_it(room: str) -> None:
    inner, environments = INNER_ROOMS[room], folders().values()
    package = ["filtergym", *(part for part in room.split("/") if part != "filtergym")]
    wrong = {
        f"{file} imports {'.'.join(module)}"
        for name in inner
        for file in FILES
        if file.is_relative_to(f"{room}/{name}")
        for module, for_types in imports_of(file)
        if not for_types and module[: len(package)] == package and len(module) > len(package)
        if (other := module[len(package)]) != name
        and (other in environments or inner.index(other) > inner.index(name))
    }
    assert not wrong


def test_every_inner_room_is_small_and_described() -> None:
    for room, inner in INNER_ROOMS.items():
        assert {path.name for path in (ROOT / room).glob("*.py")} == {"__init__.py"}
        for name in inner:
            files = {path.name for path in (ROOT / room / name).glob("*.py")}
            assert len(files) <= 16 or name in folders().values(), (
                f"{room}/{name}: more than one looks through"
            )
            words = (ROOT / room / name / "__init__.py").read_text(encoding="utf-8")
            assert ast.get_docstring(ast.parse(words))


def test_the_check_sees_every_kind_of_import() -> None:
    assert set(imported_rooms(Path("baselines/problem.py"))) == {"envs", "evaluation", "baselines"}
    assert {"filters", "envs", "evaluation", "baselines"} <= set(
        imported_rooms(Path("baselines/maneuvering_target/policies.py"))
    )
    assert {"baselines", "filters", "filtergym/papers"} <= set(
        imported_rooms(Path("filtergym/papers/uav_autopilot_kalman/claims.py"))
    )
    assert {"agents", "baselines", "envs", "evaluation", "filtergym", "filtergym/papers", "docs/make"} == {
        *imported_rooms(Path("docs/make/training_seeds.py")),
        *imported_rooms(Path("docs/make/commands.py")),
    }
    assert set(imported_rooms(Path("filtergym/commands/report.py"))) == {"evaluation", "filtergym"}


def test_every_module_of_mathematics_is_imported_by_a_test() -> None:
    modules = {path.stem for path in (ROOT / "filters").glob("*.py")} - {"__init__"}
    package = "filtergym.filters"
    imported = re.compile(rf"^from {package}(?:\.(\w+))? import (\(.*?\)|.*?$)", re.M | re.S)
    tested = set()
    for file in (ROOT / "tests").glob("test_*.py"):
        for module, names in imported.findall(file.read_text(encoding="utf-8")):
            tested |= {module} if module else {*re.findall(r"\w+", names)}
    assert modules - tested == set(), "each needs a test with a naive oracle"


LIBRARIES = {
    *("xarray", "pandas", "scipy", "matplotlib", "PIL", "torch", "stable_baselines3", "plotly", "joblib"),
    *("llvmlite", "safetensors", "msgspec", "typer", "rich"),
}
"""What takes its time to import."""
TASKS = {f"filtergym.envs.{folder}.task": id for id, folder in folders().items()}


def imported_by(program: str, *arguments: str) -> set[str]:
    """Libraries and tasks that a program has imported at its end, in a process of its own."""
    watch = (
        "import atexit, sys\n"
        f"slow = {sorted(LIBRARIES | TASKS.keys())!r}\n"
        "atexit.register(lambda: print('', *[name for name in slow if name in sys.modules], file=sys.stderr))\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", watch + program, *arguments], capture_output=True, text=True, check=True
    )
    return {*ended.stderr.splitlines()[-1].split()}


COMMAND = "from filtergym.__main__ import main; main()"


def test_the_package_alone_brings_gymnasium_and_no_environment() -> None:
    assert imported_by("import filtergym") == set()


def test_the_command_line_alone_brings_what_it_prints_with() -> None:
    assert imported_by(COMMAND, "--help") == {"typer", "rich"}


def test_listing_brings_no_library_that_computes_or_draws() -> None:
    brought = imported_by(COMMAND, "list")
    assert brought >= TASKS.keys()
    assert brought - TASKS.keys() <= {"typer", "rich", "llvmlite"}


def test_completion_brings_no_library_that_learns_or_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    words = f"filtergym evaluate {next(iter(TASKS.values()))} --policy p"
    for name, value in (("_FILTERGYM_COMPLETE", "complete_bash"), ("COMP_CWORD", "4"), ("COMP_WORDS", words)):
        monkeypatch.setenv(name, value)
    assert not imported_by(COMMAND) & {"torch", "stable_baselines3", "matplotlib", "plotly"}


def test_an_evaluation_imports_one_environment_and_draws_nothing_unused() -> None:
    task, id = next(iter(TASKS.items()))
    brought = imported_by(COMMAND, "evaluate", id, "--policy", "random", "--episodes", "8")
    assert brought & TASKS.keys() == {task}
    assert not brought & {"matplotlib", "PIL", "torch", "stable_baselines3", "plotly", "joblib"}


def test_an_environment_brings_itself_alone() -> None:
    """One after the other in one process: each adds its own task, and no library."""
    steps = "import sys, filtergym, gymnasium\n"
    for task, id in TASKS.items():
        steps += (
            f"assert {task!r} not in sys.modules\nenv = gymnasium.make({id!r})\nenv.reset(seed=0)\n"
            f"env.step(env.action_space.sample())\nassert {task!r} in sys.modules\n"
        )
    brought = imported_by(steps)
    assert brought - {"llvmlite"} == TASKS.keys()


def test_the_folders_of_baselines_are_those_of_environments() -> None:
    for id in TASKS.values():
        assert baselines_of(id).environment == id
