"""Imports run one way: a file knows only its own room and those before it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = (
    "compiler",
    "filters",
    "envs",
    "evaluation",
    "baselines",
    "agents",
    "filtergym",
    "papers",
    "docs/make",
)
"""The last two are not installed, so nothing in the package may import them."""
FILES = [path.relative_to(ROOT) for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]
PAPERS = {path.stem for path in (ROOT / "papers").iterdir()}
"""``filtergym.papers`` itself, which finds them, is part of the front room."""
PAGES = {path.stem for path in (ROOT / "docs" / "make").glob("*.py")}


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
            if first in PAGES:
                yield "docs/make"
            elif first == "filtergym":
                room = rest[0] if rest else ""
                yield room if room in ROOMS and (room != "papers" or PAPERS & {*rest[1:]}) else "filtergym"


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_knows_only_those_before_it(room: str) -> None:
    allowed = ROOMS[: ROOMS.index(room) + 1]
    wrong = {
        f"{file} imports {other}"
        for file in FILES
        if file.is_relative_to(room)
        for other in imported_rooms(file)
        if other not in allowed
    }
    assert not wrong


def test_the_check_sees_every_kind_of_import() -> None:
    assert set(imported_rooms(Path("baselines/problem.py"))) == {"envs", "evaluation", "baselines"}
    assert {"filters", "envs", "evaluation", "baselines"} <= set(
        imported_rooms(Path("baselines/maneuvering_target/policies.py"))
    )
    assert {"baselines", "filters", "papers"} <= set(
        imported_rooms(Path("papers/uav_autopilot_kalman/claims.py"))
    )
    assert {"agents", "baselines", "envs", "evaluation", "filtergym", "papers", "docs/make"} == {
        *imported_rooms(Path("docs/make/training_seeds.py")),
        *imported_rooms(Path("docs/make/commands.py")),
    }
    assert set(imported_rooms(Path("filtergym/commands/report.py"))) == {"evaluation", "filtergym"}
