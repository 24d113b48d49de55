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
    "test_files", "test_store", "test_vector_contract", "test_fleet", "test_compiled", "test_estimators",
    "test_evaluation", "test_bootstrap", "test_state_space", "test_draws", "test_kalman", "test_smoothers",
)  # fmt: skip
"""Of the core."""
PROBLEMS = ("problems", "commands", "outside the package")
"""Not deleted: the five problems are what the tests run over, and commands compose all parts."""


def imports_any(file: Path, modules: set[str]) -> bool:
    """Whether a test imports one of some modules of the package."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            if names & modules:
                return True
    return False


def module_of(file: Path) -> str:
    parts = [part for part in file.with_suffix("").parts if part not in ("filtergym", "__init__")]
    return ".".join(["filtergym", *parts])


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
        modules = {module_of(file) for file in gone}
        tests = [copy / "tests" / f"{name}.py" for name in TESTS]
        left = [str(test) for test in tests if not imports_any(test, modules)]
        smoke = subprocess.run(
            [sys.executable, "-c", SMOKE], cwd=copy, capture_output=True, text=True, check=False
        )
        words = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow and not claims", *left]
        done = subprocess.run(words, cwd=copy, capture_output=True, text=True, check=False)
    sound = smoke.returncode == done.returncode == 0
    print(
        f"without {part} ({len(gone)} files): {len(left)} of {len(tests)} test files, "
        f"{'as it should be' if sound else 'FAILED'}",
        flush=True,
    )
    if not sound:
        print(smoke.stderr[-1500:], done.stdout[-1500:], sep="\n")
    return sound


if __name__ == "__main__":
    parts = sys.argv[1:] or [part for part in PARTS if part not in PROBLEMS]
    sys.exit(0 if all([check(part) for part in parts]) else 1)
