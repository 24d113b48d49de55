"""Delete each part beyond the core, one at a time, and run what is left: ``make test-parts``.

usage: check_parts.py [PART ...]
"""

import ast
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from test_line import FILES, PARTS, ROOT, part_of

SMOKE = """
import gymnasium, numpy, filtergym
from filtergym.envs.engine.catalogue import catalogue
for id in list(catalogue()):
    env = gymnasium.make(id)
    env.reset(seed=0)
    env.step(env.action_space.sample())
model = dict(f=lambda x: [x[0] + x[1], x[1]], h=lambda x: [x[0]], Q=numpy.eye(2), R=numpy.eye(1), mean=[0, 0],
    covariance=numpy.eye(2))
own = filtergym.state_space("mine/Walk-v0", **model)
filtergym.evaluate(own.id, "kalman", episodes=8)
filtergym.tidy_records(filtergym.evaluate("filtergym/ManeuveringTarget-v0", ["imm", "imm-tuned"], episodes=8))
filtergym.online("filtergym/ManeuveringTarget-v0", "imm")
"""
TESTS = (
    "test_golden_trajectories", "test_observation", "test_parameters", "test_linear_systems", "test_bounds",
    "test_files", "test_store", "test_vector_contract", "test_compiled", "test_adapters",
    "test_evaluation", "test_bootstrap", "test_state_space", "test_draws", "test_kalman", "test_smoothers",
)  # fmt: skip
"""Of the core. Commands compose all parts: without one, those that import it are gone, and their tests."""
PROBLEMS = ("problems", "commands", "outside the package")
"""Not deleted: the five problems are what the tests run over, and commands compose all parts."""


def module_of(file: Path) -> str:
    parts = [part for part in file.with_suffix("").parts if part not in ("filtergym", "__init__")]
    return ".".join(["filtergym", *parts])


def imported_at_once(file: Path) -> set[str]:
    """Modules that a file imports when it is imported itself."""
    package = module_of(file).split(".")[: None if file.name == "__init__.py" else -1]
    found = set()
    for node in ast.parse((ROOT / file).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            name = ".".join([*base, *filter(None, [node.module])])
            found |= {name, *(f"{name}.{alias.name}" for alias in node.names)}
    return found


def broken_without(gone: set[str]) -> set[str]:
    """Modules that cannot be imported without some others, and those."""
    imports = {module_of(file): imported_at_once(file) for file in FILES}
    broken, before = set(gone), set()
    while broken != before:
        before = set(broken)
        broken |= {name for name, others in imports.items() if others & broken}
    return broken


def check(part: str) -> bool:
    """Delete a part in a copy; return whether the rest runs."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "clone"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(copy)], check=True)
        gone = [file for file in FILES if part_of(file) == part]
        for file in gone:
            (copy / file).unlink()
        for room in {copy / file.parts[0] for file in gone}:
            for empty in sorted((path for path in room.rglob("*") if path.is_dir()), reverse=True):
                if not any(inner.is_file() for inner in empty.rglob("*")):
                    shutil.rmtree(empty)
        broken = broken_without({module_of(file) for file in gone})
        tests = [Path("tests") / f"{name}.py" for name in TESTS]
        left = [str(test) for test in tests if not imported_at_once(test) & broken]
        smoke = subprocess.run(
            [sys.executable, "-c", SMOKE], cwd=copy, capture_output=True, text=True, check=False
        )
        words = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow and not claims", *left]
        done = subprocess.run(words, cwd=copy, capture_output=True, text=True, check=False)
    sound = smoke.returncode == done.returncode == 0
    print(
        f"without {part} ({len(gone)} files, {len(broken) - len(gone)} that need them): "
        f"{len(left)} of {len(tests)} test files, "
        f"{'as it should be' if sound else 'FAILED'}",
        flush=True,
    )
    if not sound:
        print(smoke.stderr[-1500:], done.stdout[-1500:], sep="\n")
    return sound


if __name__ == "__main__":
    parts = sys.argv[1:] or [part for part in PARTS if part not in PROBLEMS]
    failed = [part for part in parts if not check(part)]
    sys.exit(1 if failed else 0)
