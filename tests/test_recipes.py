"""The recipes of docs/recipes.md run, with tiny budgets; those whose library is not installed are skipped."""

import ast
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "recipes"
RECIPES = sorted(file.name for file in FOLDER.glob("with_*"))
# Ray alone is not RLlib, which takes dm-tree, too.
LIBRARIES = {"a_loop_of_ones_own": "torch", "rllib": "tree"}
"""What a recipe imports, where that is not its name."""
TINY = {"STEPS": 2_000, "UPDATES": 1, "RECORDED": 2, "EPISODES": 8}


def shortened(file: Path) -> str:
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".sh":
        for name, value in TINY.items():
            text = re.sub(rf"\b{name}=\d+", f"{name}={value}", text)
        return text
    tree, found = ast.parse(text), set()
    for node in tree.body:
        if isinstance(node, ast.Assign):
            [target] = node.targets
            pairs = [(target, node.value)]
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = list(zip(target.elts, node.value.elts, strict=True))
            for name, value in pairs:
                if isinstance(name, ast.Name) and name.id in TINY:
                    value.value = TINY[name.id]
                    found.add(name.id)
    assert "EPISODES" in found
    assert len(found) > 1
    return ast.unparse(tree)


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES)
def test_recipe_runs(recipe, tmp_path):
    name = Path(recipe).stem.removeprefix("with_")
    python = ROOT / "build" / "clients" / name / "bin" / "python"
    if not python.exists():
        python = Path(sys.executable)
        if importlib.util.find_spec(LIBRARIES.get(name, name)) is None:
            pytest.skip(f"not installed: python benchmarks/clients.py --install {name}")
    file = tmp_path / recipe
    file.write_text(shortened(FOLDER / recipe), encoding="utf-8")
    shell = file.suffix == ".sh"
    done = subprocess.run(
        ["sh" if shell else python, file],
        check=False,
        capture_output=True,
        text=True,
        timeout=240,
        cwd=ROOT if shell else tmp_path,
        env={
            **os.environ,
            "PATH": f"{python.parent}{os.pathsep}{os.environ['PATH']}",
            "OMP_NUM_THREADS": "1",
            # Ray's sockets want a short path.
            **({} if name == "rllib" else {"TMPDIR": str(tmp_path)}),
        },
    )
    assert done.returncode == 0, done.stderr[-3000:]
    costs = re.findall(r"cost against the paper's algorithm: ([-+][\d.]+)%", done.stdout)
    assert len(costs) == 1, done.stdout[-3000:]
    # Little training harms little.
    assert -60.0 < float(costs[0]) < 150.0


def test_page_names_every_recipe():
    page = (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")
    assert sorted(set(re.findall(r"\bwith_\w+\.(?:py|sh)\b", page))) == RECIPES
    for file in FOLDER.glob("*.txt"):
        assert f"--install {file.stem}" in page or f"`{file.stem}`" in page, file
