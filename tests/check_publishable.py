"""Run the field's own tools on what would be published, a line each; ends with 1 where one complains.

    python tests/check_publishable.py FOLDER

The tools are installed in an environment in FOLDER; two clones of the last commit, the second with other file dates and
another umask, are built there and their distributions compared. See `make publishable`.
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TOOLS = (
    "build", "cffconvert", "check-wheel-contents", "packaging", "pyroma", "reuse", "sp-repo-review[cli]", "twine",
    "validate-pyproject[all]", "zizmor",
)  # fmt: skip
LEAST_COMPLETE = 0.95
"""Share of all public names whose type is known."""
PUBLIC = ("filtergym", "filtergym.wrappers")
"""Modules of whose names every type is known."""
COLOURS = re.compile(r"\x1b\[[0-9;]*m")
LACKING = re.compile(r"author-email|project_urls")
"""Of what pyroma misses: no address of authors or repository exists before the first release."""


def run(command: Sequence[str | Path], folder: Path = ROOT, **environment: str) -> str:
    """Return what a command prints; an ``AssertionError`` with its end where it fails."""
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, cwd=folder, env={**os.environ, **environment}
    )
    assert done.returncode == 0, f"{(done.stdout + done.stderr).strip()[-1500:]}"
    return done.stdout + done.stderr


def build_twice(tools: Path, folder: Path) -> str:
    """Build two clones, and compare the sums of what came out."""
    sums = []
    for name, umask in (("first", 0o022), ("second", 0o077)):
        clone, output, before = folder / name, folder / f"{name}-distributions", os.umask(umask)
        for left in (clone, output):  # of the last run
            shutil.rmtree(left, ignore_errors=True)
        try:
            run(["git", "clone", "--quiet", ROOT, clone])
            if name == "second":
                for path in clone.rglob("*"):
                    if ".git" not in path.parts and path.is_file() and not path.is_symlink():
                        os.utime(path, (1.58e9, 1.58e9))
            run([tools / "python", "-m", "build", "--outdir", output, "."], clone)
        finally:
            os.umask(before)
        sums.append(
            {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(output.iterdir())}
        )
    assert sums[0] == sums[1], sums
    return ", ".join(f"{value[:12]} {name}" for name, value in sums[0].items())


def check_types(folder: Path) -> str:
    """Return the share of public names whose type is known, of the wheel beside this environment's libraries."""
    shutil.rmtree(folder / "typed", ignore_errors=True)  # pip leaves what is in a target
    venv.create(folder / "typed", with_pip=False, symlinks=True)
    site = next((folder / "typed" / "lib").glob("python*")) / "site-packages"
    wheel = next((folder / "first-distributions").glob("*.whl"))
    run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", site, wheel])
    libraries = [path for path in sys.path if path.endswith("site-packages")]
    (site / "beneath.pth").write_text("\n".join(libraries))
    path = f"{folder / 'typed' / 'bin'}{os.pathsep}{os.environ['PATH']}"
    command = [
        Path(sys.executable).parent / "pyright",
        "--verifytypes",
        "filtergym",
        "--ignoreexternal",
        "--outputjson",
    ]
    done = subprocess.run(
        command,
        check=False,
        capture_output=True,
        text=True,
        cwd=site.parent,
        env={**os.environ, "PATH": path},
    )
    found = json.loads(done.stdout)["typeCompleteness"]
    public = re.compile(rf"({'|'.join(map(re.escape, PUBLIC))})\.\w+")
    unknown = [s["name"] for s in found["symbols"] if not s["isTypeKnown"] and public.fullmatch(s["name"])]
    share = found["completenessScore"]
    assert share >= LEAST_COMPLETE, f"{share:.1%} of all names"
    assert not unknown, unknown
    return f"{share:.1%} of all names, all of {' and '.join(PUBLIC)}"


def compare_recipe() -> str:
    """The conda recipe asks for what pyproject.toml asks for, with the same bounds."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = {*project["dependencies"], *project["optional-dependencies"]["fast"]}
    lines = re.findall(
        r"^    - ([\w-]+) >=([\d.]+)", (ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"), re.M
    )
    given = {f"{name.removesuffix('-base')}>={bound}" for name, bound in lines if name != "python"}
    assert given == wanted, sorted(given ^ wanted)
    return f"{len(given)} requirements"


def rate(tools: Path) -> str:
    """Return pyroma's rating, and what it misses."""
    text = run([tools / "pyroma", "--min=8", "."])
    missed = [
        line for line in re.split(r"-{5,}", text.split("Found filtergym")[1])[1].splitlines() if line.strip()
    ]
    other = [line for line in missed if not LACKING.search(line)]
    assert not other, other
    return f"{re.findall(r'rating: (.*)', text)[0]}; no address of authors or repository yet"


def main() -> None:
    """Read the folder, install the tools, run all, and print a table."""
    folder = Path(sys.argv[1]).resolve()
    venv.create(folder / "tools", with_pip=True, clear=True)
    tools = folder / "tools" / "bin"
    run([tools / "python", "-m", "pip", "install", "--quiet", *TOOLS])
    checks: dict[str, Callable[[], str]] = {
        "two clones": lambda: build_twice(tools, folder),
        "twine": lambda: run(
            [tools / "twine", "check", "--strict", *(folder / "first-distributions").iterdir()]
        ),
        "check-wheel-contents": lambda: run([tools / "check-wheel-contents", folder / "first-distributions"]),
        "validate-pyproject": lambda: run([tools / "validate-pyproject", "pyproject.toml"]),
        "cffconvert": lambda: run([tools / "cffconvert", "--validate"]),
        "conda recipe": compare_recipe,
        "repo-review": lambda: f"{run([tools / 'repo-review', '.']).count('✅')} checks",
        "zizmor": lambda: run(
            [tools / "zizmor", "--offline", "--quiet", "--min-severity", "medium", ".github"]
        ),
        "pyroma": lambda: rate(tools),
        "reuse": lambda: run([tools / "reuse", "lint"]),
        "types": lambda: check_types(folder),
    }
    failed = 0
    for name, check in checks.items():
        try:
            words = [line for line in COLOURS.sub("", check()).splitlines() if line.strip()]
            print(f"{name:20} passed  {words[-1].strip() if words else ''}", flush=True)
        except AssertionError as error:
            failed += 1
            print(f"{name:20} FAILED  {error}", flush=True)
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
