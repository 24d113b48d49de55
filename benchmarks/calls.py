"""Times of one call, and time and memory for many rows, in comparison with peers and a former version.

    python benchmarks/calls.py [SECTION ...] [--against PYTHON] [--rounds N] [--rows N,N,...] [--json FILE]

Sections, without ``logs`` by default, which takes minutes:

``single``
    ``step`` and ``reset`` of ``gymnasium.make(ID)`` with Gymnasium's wrappers, and of Gymnasium's CartPole and
    Pendulum.
``vectors``
    ``step`` of ``gymnasium.make_vec`` a lane, with one and two threads (wall seconds, for threads share the
    processor), and of ManeuveringTarget with 65,536 lanes and with 1,024.
``live``
    ``update`` of ``filtergym.online``, and of filterpy's Kalman filter and interacting multiple model.
``start``
    Processor seconds of a process that makes, resets and steps, and those of CartPole.
``logs``
    Processor seconds and peak memory of ``advise``, of ``evaluate`` with truth and of the smoother, over logs of
    ``--rows`` rows, and of ``evaluate`` of ten competitors over as many episodes.

``--against`` names the Python of another checkout: both versions are measured in turn, each with its own peers in one
process. A figure is the median over rounds, of processor time unless the row is marked "wall".
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

ENVIRONMENTS = {
    "M": "ManeuveringTarget", "U": "UavAutopilot", "R": "RadarEsmTracking",
    "L": "LooselyCoupledNavigation", "T": "TightlyCoupledNavigation",
}  # fmt: skip
SECTIONS = ("single", "vectors", "live", "start", "logs")
COMPETITORS = (
    "imm", "adaptive", "fixed-best", "kalman-imm", "kalman-imm-turn", "unscented-turn", "sage-husa",
    "variational-bayes", "known-turn", "semi-markov",
)  # fmt: skip
Figures = Iterator[tuple[str, float]]
"""Names of rows with their values; a name ends in its unit."""


def seconds_of(
    call: Callable[[], object], count: int, clock: Callable[[], float] = time.process_time
) -> float:
    begin = clock()
    for _ in range(count):
        call()
    return (clock() - begin) / count


def measure_single() -> Figures:
    import gymnasium

    import filtergym

    filtergym.register()
    ids = {"CartPole": "CartPole-v1", "Pendulum": "Pendulum-v1"}
    ids |= {letter: f"filtergym/{name}-v0" for letter, name in ENVIRONMENTS.items()}
    for letter, id in ids.items():
        env = gymnasium.make(id)
        env.reset(seed=0)
        env.action_space.seed(0)
        actions = [env.action_space.sample() for _ in range(16)]
        steps, resets = [], []
        for _ in range(12 if letter == "T" else 60):
            resets.append(seconds_of(env.reset, 1))
            for k in range(200):
                begin = time.process_time()
                _, _, terminated, truncated, _ = env.step(actions[k % 16])
                steps.append(time.process_time() - begin)
                if terminated or truncated:
                    break
        yield f"step, {letter}, µs", 1e6 * statistics.median(steps)
        yield f"reset, {letter}, µs", 1e6 * statistics.median(resets)


def measure_vectors() -> Figures:
    import gymnasium

    import filtergym

    filtergym.register()

    def lane(letter: str, lanes: int, threads: int, clock: Callable[[], float]) -> float:
        env = gymnasium.make_vec(f"filtergym/{ENVIRONMENTS[letter]}-v0", num_envs=lanes, threads=threads)
        env.reset(seed=0)
        env.action_space.seed(0)
        action = env.action_space.sample()
        env.step(action)
        count = max(3, min(30, 40_000 // lanes))
        found = 1e9 * min(seconds_of(lambda: env.step(action), count, clock) for _ in range(3)) / lanes
        env.close()
        return found

    for letter in ENVIRONMENTS:
        for lanes in (64, 1024) if letter != "T" else (64, 256):
            for threads in (1, 2):
                found = lane(letter, lanes, threads, time.perf_counter)
                yield f"vector, {letter}, {lanes:,} lanes, {threads} threads, wall ns a lane", found
    yield "vector, M, 1,024 lanes, ns a lane", lane("M", 1024, 1, time.process_time)
    yield "vector, M, 65,536 lanes, ns a lane", lane("M", 65_536, 1, time.process_time)


def measure_live() -> Figures:
    import numpy
    from filterpy.kalman import IMMEstimator, KalmanFilter

    import filtergym

    def peer(states: int, acceleration: float = 1.0) -> Any:
        one, axes = KalmanFilter(dim_x=states, dim_z=states // 2), states // 2
        one.F = numpy.eye(states) + numpy.eye(states, k=axes)
        one.H, one.R = numpy.eye(axes, states), 25.0 * numpy.eye(axes)
        noise_gain = numpy.vstack([0.5 * numpy.eye(axes), numpy.eye(axes)])
        one.Q = acceleration**2 * noise_gain @ noise_gain.T
        return one

    def updates(filter: Any, measurement: Any) -> Callable[[], None]:
        def update() -> None:
            filter.predict()
            filter.update(measurement)

        return update

    filtergym.state_space(
        "mine/Tracker-v0", f=[[1, 1.0], [0, 1]], h=[[1, 0]], Q=[[0.25, 0.5], [0.5, 1.0]], R=[[25.0]],
        mean=[0, 10], covariance=[[100, 0], [0, 25]],
    )  # fmt: skip
    two = filtergym.online("mine/Tracker-v0", "kalman")
    two.start(mean=[0, 10], covariance=[[100, 0], [0, 25]])
    modes = IMMEstimator(
        [peer(4, 0.1), peer(4, 3.0)], numpy.array([0.5, 0.5]), numpy.array([[0.9, 0.1], [0.1, 0.9]])
    )
    calls: dict[str, Callable[[], object]] = {
        "filterpy, Kalman, 2 states": updates(peer(2), 11.2),
        "filterpy, IMM of two, 4 states": updates(modes, numpy.array([2e4, 3e4])),
        "two states, kalman": lambda: two.update(values=[11.2]),
    }
    for name in ("imm", "kalman-imm", "semi-markov", "bptt-small"):
        tracker = filtergym.online("filtergym/ManeuveringTarget-v0", name)
        tracker.start([2e4, 3e4, 0.0, 0.0], numpy.diag([1e4, 1e4, 600.0, 600.0]))
        calls[f"M, {name}"] = lambda tracker=tracker: tracker.update(x=2e4, y=3e4)  # type: ignore[misc]
    for name, call in calls.items():
        seconds_of(call, 50)
        yield f"update, {name}, µs", 1e6 * statistics.median(seconds_of(call, 200) for _ in range(5))


def child_cost(code: str, folder: str) -> tuple[float, float]:
    """Run code in a process of this Python in a folder; return its processor seconds and peak memory, MB."""
    # Not getrusage of children: its peak is the largest of all so far.
    program = (
        code + "\nimport re, time, pathlib\n"
        "peak = re.search(r'VmHWM:\\s*(\\d+)', pathlib.Path('/proc/self/status').read_text()).group(1)\n"
        "print('COST', time.process_time(), int(peak) / 1024)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], check=False, capture_output=True, text=True, cwd=folder
    )
    if done.returncode:
        raise RuntimeError(f"the process ended with {done.returncode}: {done.stderr[-800:]}")
    seconds, peak = done.stdout.rsplit("COST", 1)[1].split()
    return float(seconds), float(peak)


def measure_start() -> Figures:
    code = "import gymnasium\n{more}env = gymnasium.make({id!r}); env.reset(); env.step(env.action_space.sample())"
    ids = {"CartPole": "CartPole-v1"} | {k: f"filtergym/{v}-v0" for k, v in ENVIRONMENTS.items()}
    for letter, id in ids.items():
        program = code.format(id=id, more="" if letter == "CartPole" else "import filtergym\n")
        child_cost(program, ".")  # fills the cache
        yield f"make, reset and step from nothing, {letter}, s", child_cost(program, ".")[0]


LOG = """
import numpy
rng, rows = numpy.random.default_rng(0), {rows}
seconds = 4.0 * numpy.arange(rows)
turns = [2.0 * numpy.pi * seconds[:, None] / numpy.array(periods) for periods in ((900.0, 790.0), (173.0, 211.0))]
truth = 2e4 * numpy.sin(turns[0]) + 2e3 * numpy.sin(turns[1])
velocity = 2e4 * numpy.cos(turns[0]) * 2.0 * numpy.pi / numpy.array((900.0, 790.0))
velocity += 2e3 * numpy.cos(turns[1]) * 2.0 * numpy.pi / numpy.array((173.0, 211.0))
table = numpy.column_stack([seconds, truth + rng.normal(0.0, 100.0, truth.shape), truth, velocity])
names = "time,x,y,truth_position_x,truth_position_y,truth_velocity_x,truth_velocity_y"
numpy.savetxt("truth.csv", table, "%.3f", ",", header=names, comments="")
numpy.savetxt("plain.csv", table[:, :3], "%.3f", ",", header="time,x,y", comments="")
"""
COMMAND = """
import sys
from filtergym.__main__ import main
sys.argv = ["filtergym", *{words!r}]
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
"""
TRACK = "filtergym/ManeuveringTarget-v0"


def measure_logs(rows: Sequence[int]) -> Figures:
    policies = [word for name in COMPETITORS for word in ("--policy", name)]
    log = ["evaluate", TRACK, "--recording", "truth.csv", "--speeds", "0.0001,100000", "--policy"]
    for count in rows:
        with tempfile.TemporaryDirectory() as folder:
            child_cost(LOG.format(rows=count), folder)
            cases = {
                "advise": COMMAND.format(words=["advise", "plain.csv", "--speeds", "0.0001,100000"]),
                "evaluate imm, with truth": COMMAND.format(words=[*log, "imm"]),
                "smoother, with truth": COMMAND.format(words=[*log, "kalman-smoother"]),
                "evaluate, ten competitors, 20 measurements": COMMAND.format(
                    words=["evaluate", TRACK, "--episodes", str(count), "--set", "horizon=20", *policies]
                ),
            }
            for name, code in cases.items():
                unit = "episodes" if "ten" in name else "rows"
                try:
                    seconds, peak = child_cost(code, folder)
                except RuntimeError as error:
                    print(f"{name}, {count:,}: {error}", file=sys.stderr)
                    seconds = peak = float("nan")
                yield f"{name}, {count:,} {unit}, s", seconds
                yield f"{name}, {count:,} {unit}, peak MB", peak


def measure(section: str, rows: Sequence[int]) -> Figures:
    if section == "logs":
        return measure_logs(rows)
    return {
        "single": measure_single,
        "vectors": measure_vectors,
        "live": measure_live,
        "start": measure_start,
    }[section]()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("section", nargs="*", choices=[*SECTIONS, []], help="sections to measure")
    parser.add_argument(
        "--against", metavar="PYTHON", help="of another checkout, measured in turn with this one"
    )
    parser.add_argument("--rounds", type=int, default=5, help="of each version (default 5)")
    parser.add_argument("--rows", default="10000,100000", help="of the logs (default 10000,100000)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the medians to this file")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    rows = [int(count) for count in chosen.rows.split(",")]
    sections = chosen.section or [name for name in SECTIONS if name != "logs"]
    if chosen.worker:
        for section in sections:
            print(json.dumps(dict(measure(section, rows))))
        return
    versions = {"now": sys.executable} | ({"before": chosen.against} if chosen.against else {})
    table: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for section in sections:
        for turn in range(1 if section == "logs" else chosen.rounds):
            for version, python in versions.items():
                print(f"{section}, round {turn + 1}, {version} ...", file=sys.stderr, flush=True)
                command = [python, __file__, section, "--worker", "--rows", chosen.rows]
                done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
                for name, value in json.loads(done.stdout).items():
                    table[name][version].append(value)
    medians = {name: {v: statistics.median(found) for v, found in by.items()} for name, by in table.items()}
    print(f"\n| | {' | '.join(reversed(versions))} |{' ratio |' if chosen.against else ''}")
    print(f"|---|{'---|' * (len(versions) + bool(chosen.against))}")
    for name, by in medians.items():
        cells = [f"{by[version]:,.4g}" for version in reversed(versions)]
        cells += [f"{by['before'] / by['now']:.2f}"] if chosen.against else []
        print(f"| {name} | {' | '.join(cells)} |")
    if chosen.json:
        chosen.json.write_text(json.dumps(medians, indent=1) + "\n")


if __name__ == "__main__":
    main()
