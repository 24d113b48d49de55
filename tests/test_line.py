"""The line through the house: the core knows no problem and no companion, and is small; no files import in a circle."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from test_imports import FILES, ROOT, imports_of

from filtergym.envs.engine.catalogue import folders

PROBLEM = f"({'|'.join(folders().values())})"
OF_PROBLEMS = (
    "alpha_beta", "bounds", "class_fusion", "contaminated_normal", "coordinated_turn", "data_association",
    "dead_reckoning", "emitter_association", "extended_kalman", "gnss_ins", "gusts", "linear_systems",
    "loosely_coupled", "noise_adaptation", "noise_levels", "packed_covariance", "polar", "predicted_covariance",
    "range_errors", "receiver_faults", "satellites", "semi_markov", "singer", "stored_solutions",
)  # fmt: skip
"""Mathematics of problems and their papers alone, beside what all use."""
PARTS = {
    "logs and advice": (
        rf"envs/logs/|envs/{PROBLEM}/(logs|live|flights|inertial)\.py"
        r"|baselines/(advice|fitt\w+|judgement|log_scores|onboard|tuning)\.py|filtergym/commands/(advise|improve)\.py"
        r"|filtergym/reports/(tables/(advice|recording_tables)|pages/advice_report)\.py"
        r"|evaluation/(competitors/(likelihood|file_estimates)|storage/(blind|estimate_tables|estimates))\.py"
    ),
    "problems": rf"(envs|baselines)/{PROBLEM}/|baselines/measurement_noise\.py|filters/({'|'.join(OF_PROBLEMS)})\.py",
    "learning": r"agents/|filtergym/commands/training\.py|filtergym/reports/tables/standing\.py",
    "crash test": r"evaluation/stress/|filtergym/commands/stress\.py|filtergym/reports/pages/crash_report\.py",
    "programs of others": r"evaluation/competitors/(programs|program_process|isolation|isolated_estimator)\.py",
    "export": r"filtergym/exports/",
    "wrappers": r"filtergym/wrappers/",
    "data sets": r"filtergym/offline\.py",
    "publication": r"filtergym/(submission|protocol)\.py|filtergym/commands/(submit|protocol)\.py",
    "papers": r"filtergym/(papers/|reproductions\.py)",
    "commands": r"filtergym/commands/(?!(__init__|progress|shown|terminal)\.py)",
    "outside the package": r"docs/",
}
"""Files of each part by their paths; the first that matches counts, and what none matches is the core."""
KNOWN = {
    "core": set(),
    "problems": {"core"},
    "learning": {"core"},
    "crash test": {"core"},
    "programs of others": {"core"},
}
"""Parts that a part may import, of those that know few."""
MOST_LINES = 35_300
"""Of the core; it was 36,700 before docstrings of private helpers went."""
CIRCLES: set[frozenset[str]] = {
    frozenset({"compiler/namespace.py", "compiler/numpy_functions.py"}),
}
"""Files that import one another, also where an import is late or for types alone: the methods by which NumPy calls a
traced array are written with the functions of the namespace that returns such arrays."""
TYPES_ALONE = Path("filtergym/__init__.py")
"""Names the functions of the package for type checkers, and imports them when they are first used."""


def part_of(file: Path) -> str:
    return next((name for name, pattern in PARTS.items() if re.match(pattern, file.as_posix())), "core")


MODULES = {
    tuple(part for part in file.with_suffix("").parts if part not in ("filtergym", "__init__")): file
    for file in FILES
}


def imported_files(file: Path) -> Iterator[Path]:
    for (first, *rest), _ in imports_of(file):
        if first == "filtergym":
            found = MODULES.get(tuple(rest)) or MODULES.get(tuple(rest[:-1]))
            if found is not None:
                yield found


@pytest.mark.parametrize("part", KNOWN)
def test_a_part_knows_few_others(part: str) -> None:
    wrong = {
        f"{file} imports {other} of {part_of(other)}"
        for file in FILES
        if part_of(file) == part and file != TYPES_ALONE
        for other in imported_files(file)
        if part_of(other) not in {part, *KNOWN[part]}
    }
    assert not wrong


def test_the_check_sees_what_crosses_the_line() -> None:
    front = {part_of(file) for file in imported_files(TYPES_ALONE)}
    assert "logs and advice" in front
    assert {part_of(file) for file in FILES} == {"core", *PARTS}


def test_the_core_is_small() -> None:
    lines = sum(
        (ROOT / file).read_text(encoding="utf-8").count("\n") for file in FILES if part_of(file) == "core"
    )
    assert lines <= MOST_LINES


def circles(arrows: Mapping[str, set[str]]) -> set[frozenset[str]]:
    """Groups of several nodes of which each reaches each (strongly connected components, by Kosaraju's algorithm)."""
    back: dict[str, set[str]] = {node: set() for node in arrows}
    for node, targets in arrows.items():
        for target in targets:
            back[target].add(node)

    def visit(start: str, graph: Mapping[str, set[str]], seen: set[str]) -> list[str]:
        """Nodes that can be reached and were not seen before, each after those that follow from it."""
        seen.add(start)
        path, order = [(start, iter(graph[start]))], []
        while path:
            targets = path[-1][1]
            following = next((target for target in targets if target not in seen), None)
            if following is None:
                order.append(path.pop()[0])
            else:
                seen.add(following)
                path.append((following, iter(graph[following])))
        return order

    seen: set[str] = set()
    order = [node for start in arrows if start not in seen for node in visit(start, arrows, seen)]
    seen = set()
    groups = [frozenset(visit(start, back, seen)) for start in reversed(order) if start not in seen]
    return {group for group in groups if len(group) > 1}


def test_files_import_one_way() -> None:
    inner = [file for file in FILES if file.name != "__init__.py"]
    arrows = {
        str(file): {str(other) for other in imported_files(file) if other in inner and other != file}
        for file in inner
    }
    assert circles(arrows) == CIRCLES


def test_the_check_sees_circles() -> None:
    arrows = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": {"f"}, "f": {"d"}, "g": {"a"}}
    assert circles(arrows) == {frozenset("abc"), frozenset("def")}
