"""Try what would be published: run by `make distributions`, in a clean environment that has the wheel and no torch."""

import importlib.util
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import gymnasium
import numpy

import filtergym
from filtergym.agents.named_policies import pretrained_agents
from filtergym.baselines.problem import problem_of
from filtergym.envs.engine.catalogue import catalogue

MOST_BYTES = 3_000_000
"""Of the wheel."""
ROOMS = ("compiler", "filters", "envs", "evaluation", "baselines", "agents", "filtergym")


def check_wheel(wheel: Path, source: Path) -> None:
    """It holds every file of the rooms but the papers', and nothing else but what describes it."""
    files = [path for room in ROOMS for path in (source / room).rglob("*") if path.is_file()]
    left_out = {"__pycache__", "papers"}
    names = [
        path.relative_to(source).as_posix()
        for path in files
        if not left_out & {*path.parts[len(source.parts) :]}
    ]
    wanted = {name if name.startswith("filtergym/") else f"filtergym/{name}" for name in names}
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == wanted, sorted(held ^ wanted)
    assert wheel.stat().st_size < MOST_BYTES


def check_source_distribution(archive: Path, source: Path) -> None:
    """It holds every file of the repository but `.gitignore` and the links; outside a repository nothing is checked."""
    if not (source / ".git").exists():
        return
    listed = subprocess.run(
        ["git", "ls-files"], cwd=source, capture_output=True, text=True, check=True
    ).stdout
    with tarfile.open(archive) as opened:
        held = {name.partition("/")[2] for name in opened.getnames()}
    links = {f"filtergym/{room}" for room in ROOMS}
    assert not (missing := set(listed.split()) - held - links - {".gitignore"}), sorted(missing)


def check_installed() -> None:
    """Environments are made and stepped; shipped agents and tuned values are found and play, without torch."""
    assert importlib.util.find_spec("torch") is None
    assert any(map(pretrained_agents, catalogue()))
    for id in catalogue():
        env = gymnasium.make(id)
        env.reset(seed=0)
        assert numpy.isfinite(env.step(env.action_space.sample())[1]), id
        agents, tuned = pretrained_agents(id), problem_of(id).tuned_policies
        results = filtergym.evaluate(id, [*agents, *tuned], episodes=2)
        assert numpy.isfinite(results["error"]).all(), id


def check_command_line() -> None:
    """The installed command lists, evaluates a tuned policy and a shipped agent, knows its version, has no paper."""
    command = Path(sys.executable).parent / "filtergym"
    evaluate = "evaluate filtergym/ManeuveringTarget-v0 --policy imm-tuned --policy ppo --episodes 2"
    for arguments, expected in (
        ("--version", filtergym.__version__),
        ("list", "filtergym/ManeuveringTarget-v0"),
        ("list filtergym/ManeuveringTarget-v0", "bptt"),
        (evaluate, "imm-tuned"),
    ):
        ran = subprocess.run([command, *arguments.split()], capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr
        assert expected in ran.stdout
    ran = subprocess.run(
        [command, "reproduce", "imm-alpha-beta"], capture_output=True, text=True, check=False
    )
    assert (ran.returncode, ran.stderr.count("\n")) == (2, 1), ran.stderr
    assert "part of the repository, not of the package" in ran.stderr


if __name__ == "__main__":
    source = Path(__file__).resolve().parent.parent
    assert "site-packages" in filtergym.__file__
    archive, wheel = map(Path, sys.argv[1:])
    check_wheel(wheel, source)
    check_source_distribution(archive, source)
    check_installed()
    check_command_line()
    print(f"{wheel.name} and {archive.name} hold what they should, and the wheel runs.")
