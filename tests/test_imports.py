"""Imports run one way: a file knows only its own room and those before it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = ("compiler", "filters", "envs", "evaluation", "baselines", "agents", "filtergym")
FILES = [path.relative_to(ROOT) for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]


def imported_rooms(file: Path) -> Iterator[str]:
    """Names of the rooms that a file imports anything from; the package itself is the front room."""
    package = ["filtergym", *(part for part in file.parent.parts if part != "filtergym")]
    for node in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            module = [*base, *(node.module or "").split(".")] if node.module else base
            names = [[*module, alias.name] for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
        else:
            continue
        for first, *rest in names:
            if first == "filtergym":
                yield rest[0] if rest and rest[0] in ROOMS else "filtergym"


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_knows_only_those_before_it(room: str) -> None:
    allowed = ROOMS[: ROOMS.index(room) + 1]
    wrong = {
        f"{file} imports {other}"
        for file in FILES
        if file.parts[0] == room
        for other in imported_rooms(file)
        if other not in allowed
    }
    assert not wrong


def test_the_check_sees_every_kind_of_import() -> None:
    assert set(imported_rooms(Path("baselines/names.py"))) == {"envs", "evaluation", "baselines"}
    assert {"filters", "envs", "evaluation", "baselines"} <= set(
        imported_rooms(Path("baselines/maneuvering_target/policies.py"))
    )
    assert {"agents", "baselines", "envs", "evaluation", "filtergym"} <= set(
        imported_rooms(Path("filtergym/reports/training_seeds.py"))
    )
