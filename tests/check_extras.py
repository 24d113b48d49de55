"""Each extra alone: with it its command runs, without it the command refuses in one sentence. See `make test-extras`.

    python tests/check_extras.py [--present] FOLDER [EXTRA ...]

An environment in FOLDER holds links to what this Python has of filtergym, of an extra, and of what these need, and
nothing else: what only some other extra would bring is found to be missing.
"""

import argparse
import functools
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
import venv
from importlib.metadata import distribution
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
ID = "filtergym/ManeuveringTarget-v0"
EVALUATE = f"filtergym evaluate {ID} --episodes 2 --set horizon=20"
TRAIN = f"filtergym train {ID} --steps 512 --envs 2 --set algo.n_steps=128 --no-compare --out run"


class Need(NamedTuple):
    """What shows that an extra is there."""

    command: str
    prepare: str = ""
    """Python, run with all extras."""
    beside: tuple[str, ...] = ()
    """Extras without which the command does nothing, either."""
    written: str = ""
    """File that is there only with the extra, where the command goes on without."""
    refusal: str = ""
    """What the sentence names, if not the extra."""


ESTIMATORS = f"""
import shutil
for name in ('filterpy_filters', 'stone_soup_kalman'):
    shutil.copy({str(ROOT / "docs" / "examples")!r} + f'/{{name}}.py', '.')"""
RESULTS = f"""
from made_results import results_of
from filtergym.reports.tables.results import settings_of, write_results
from pathlib import Path
results = [results_of({ID!r}, ['imm', 'adaptive'], None, 2, horizon=5)]
write_results(Path('results.json'), results, settings_of('filtergym benchmark'))"""
FLIGHT = """
import numpy, pyarrow, pyarrow.parquet, xarray
time = numpy.arange(0.0, 300.0, 2.0)
track = dict(time=time, x=2e4 + 100.0 * time, y=1e4 - 50.0 * time)
pyarrow.parquet.write_table(pyarrow.table(track), 'flight.parquet')
data = xarray.Dataset({name: ('time', track[name]) for name in ('x', 'y')}, {'time': time})
data.to_netcdf('flight.nc', engine='h5netcdf')"""
FLOWN = f"{EVALUATE} --policy imm --scenario"
RECORDED = f"filtergym evaluate {ID} --policy imm --speeds 0,100 --recording"
LOGS = """
from pathlib import Path
from test_onboard import flight
from test_receiver_logs import NEW, TIME, bag, nmea, places, ulog
flight(Path('log.bin'))
nmea(Path('log.nmea'))
rows = [(round(1e6 * t), *place, 2.0, 3) for t, place in zip(TIME, places().T)]
ulog(Path('log.ulg'), NEW, rows)
bag(Path('log.bag'))"""
INERTIAL = """
from filtergym.envs.loosely_coupled_navigation.inertial import inertial_recording
inertial_recording('imu.csv', 'fixes.csv', settling=15.0, window=10.0)"""
VIDEO = f"""
import gymnasium, filtergym
env = gymnasium.make({ID!r}, render_mode='rgb_array', horizon=5)
env = gymnasium.wrappers.RecordVideo(env, 'video')
env.reset(seed=0)
while not env.step(env.action_space.sample())[3]: pass
env.close()"""

NEEDS = {
    "agents": [Need(TRAIN)],
    "fast": [Need(f"{EVALUATE} --policy imm --backend compiled")],
    "tensorboard": [Need(TRAIN, beside=("agents",), written="run/log/*tfevents*")],
    "report": [Need("filtergym report results.json --out report.html", RESULTS)],
    "render": [Need(f"python -c {shlex.quote(VIDEO)}", refusal="moviepy is not installed")],
    "flights": [Need(f"{FLOWN} flight.parquet", FLIGHT), Need(f"{FLOWN} flight.nc", FLIGHT)],
    "logs": [Need(f"{RECORDED} log{suffix}", LOGS) for suffix in (".nmea", ".ulg", ".bin", ".bag")],
    "ins": [
        Need(
            f"python -c {shlex.quote(INERTIAL)}",
            "from test_inertial_logs import write_log; write_log()",
            refusal=r"filtergym\[ins\]",
        )
    ],
    "adapters": [
        Need(f"{EVALUATE} --policy {name}:Kalman", ESTIMATORS)
        for name in ("filterpy_filters", "stone_soup_kalman")
    ],
    "onnx": [Need(f"filtergym export {ID} bptt --to onnx --out agent.onnx")],
    "offline": [Need(f"filtergym offline {ID} --episodes 2 --out datasets")],
    "cluster": [Need(f"{EVALUATE} --policy imm --cluster {name}") for name in ("dask", "ray")],
}

assert NEEDS.keys() == EXTRAS.keys() - {"dev"}


def closure(extras: tuple[str, ...]) -> set[str]:
    """Names of the distributions that filtergym with some extras consists of, itself included.

    Raises:
        PackageNotFoundError: for one that this Python does not have.
    """
    waiting = [Requirement(f"filtergym[{','.join(extras)}]")]
    seen: set[tuple[str, frozenset[str]]] = set()
    while waiting:
        needed = waiting.pop()
        name = canonicalize_name(needed.name)
        if (name, frozenset(needed.extras)) in seen:
            continue
        seen.add((name, frozenset(needed.extras)))
        for requirement in map(Requirement, distribution(name).requires or ()):
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in {"", *needed.extras}):
                waiting.append(requirement)
    return {name for name, _ in seen}


@functools.cache
def environment(folder: Path, extras: tuple[str, ...]) -> Path:
    """Make an environment of links; returns its folder of programs."""
    shutil.rmtree(folder, ignore_errors=True)
    venv.create(folder, symlinks=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    for name in closure(extras):
        found = distribution(name)
        files = {path for path in found.files or () if path.parts[0] not in ("..", "__pycache__")}
        packaged = {path.parts[0] for path in files if path.name == "__init__.py" and len(path.parts) == 2}
        for path in files:
            # Distributions share a namespace package, such as google, which has no __init__.py.
            shared = len(path.parts) > 1 and path.parts[0] not in packaged and "." not in path.parts[0]
            link = packages.joinpath(*path.parts[: 1 + shared])
            if not os.path.lexists(link):
                link.parent.mkdir(exist_ok=True)
                link.symlink_to(Path(str(found.locate_file(link.relative_to(packages)))).resolve())
    program = folder / "bin" / "filtergym"
    # Guarded, as pip writes it: workers of a cluster import the main module again.
    guarded = "if __name__ == '__main__':\n    main()\n"
    program.write_text(f"#!{program.with_name('python')}\nfrom filtergym.__main__ import main\n\n{guarded}")
    program.chmod(0o755)
    return folder / "bin"


def run(programs: Path, need: Need, extra: str, present: bool) -> str:
    """Run the command of a need with these programs; returns what is wrong."""
    with tempfile.TemporaryDirectory() as folder:
        if need.prepare:
            subprocess.run([sys.executable, "-c", need.prepare], cwd=folder, check=True)
        program, *words = shlex.split(need.command)
        ended = subprocess.run(
            [programs / program, *words], cwd=folder, capture_output=True, text=True, check=False
        )
        written = not need.written or any(Path(folder).glob(need.written))
    message = ended.stderr.strip()
    if present:
        return "" if ended.returncode == 0 and written else f"exit {ended.returncode}: {message[-500:]}"
    if need.written:  # an addition, which the command does without
        return "" if ended.returncode == 0 and not written else f"exit {ended.returncode}: {message[-500:]}"
    sentence = need.refusal or rf"filtergym\[([a-z]+,)*{extra}\]"
    last = message.rpartition("\n")[2]
    if ended.returncode and re.search(sentence, last) and (need.refusal or last == message):
        return ""
    return f"does not refuse in one sentence with {sentence}: exit {ended.returncode}, {message[-500:]!r}"


def lowest() -> list[str]:
    """Constraints on the lowest versions that the core and the extras declare; torch, which brings CUDA, has none."""
    declared = [*PROJECT["dependencies"], *(text for extra in NEEDS for text in EXTRAS[extra])]
    versions = {needed.name: needed.specifier for needed in map(Requirement, declared)}
    return [f"{name}=={str(versions[name]).removeprefix('>=')}" for name in versions if name != "torch"]


def main() -> None:
    """Read the command line; exit code 1 if an extra fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="for the environments")
    parser.add_argument("extras", nargs="*", default=list(NEEDS), help="default: all of them")
    parser.add_argument("--present", action="store_true", help="do not ask for refusals")
    parser.add_argument("--lowest", action="store_true", help="print constraints, and nothing else")
    given = parser.parse_args()
    if given.lowest:
        print(*lowest(), sep="\n")
        return
    os.environ["PYTHONPATH"] = str(ROOT / "tests")
    failed = False
    for extra in given.extras:
        for present in (True,) if given.present else (True, False):
            for need in NEEDS[extra]:
                extras = (*need.beside, extra) if present else need.beside
                programs = environment(given.folder.resolve() / "-".join(extras or ("core",)), extras)
                wrong = run(programs, need, extra, present)
                failed = failed or bool(wrong)
                print(
                    f"{extra} {'present' if present else 'missing'}: {wrong or 'as it should be'}", flush=True
                )
    sys.exit(failed)


if __name__ == "__main__":
    main()
