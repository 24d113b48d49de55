"""Speed of steps and evaluations, compared with peers in the same run.

    python benchmarks/throughput.py [SECTION ...] [--environment ID] [--size N] [--seconds S] [--large] [--json FILE]

Sections, all of them by default:

``environments``
    The public ``step`` of ``gymnasium.make_vec(ID, num_envs=N)`` and of ``gymnasium.make(ID)`` (N = 1, with Gymnasium's
    wrappers), with defaults and its share of a reset: millions of measurements a second. A step of
    TightlyCoupledNavigation is ten measurements. For comparison Gymnasium's own CartPole in its native vector form,
    which has four additions where these have a filter.
``steps``
    One step of 4096 episodes: the environment's own text compiled, by NumPy, by ``jax.jit`` where JAX is installed, and
    filterpy's filters in a loop; also the time of the step's arithmetic alone in compiled code (the floor).
``evaluations``
    ``filtergym.evaluate`` of ten competitors over 2000 episodes, with ``--large`` over 100,000.
``scaling``
    Time and peak memory of processes that evaluate one, two and four times as many episodes, competitors and
    measurements, and step as many environments.

One thread. A figure is the median over rounds of processor time, which other processes affect through caches: use
ratios. Two versions are compared by running this file with the Python of each at the same time, and by dividing the
figures in the files that ``--json`` writes.
"""

import argparse
import itertools
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

import gymnasium
import numpy
import pandas
import peer_imm

import filtergym
from filtergym.compiler import namespace
from filtergym.compiler.functions import Specialised
from filtergym.compiler.program import FUNCTIONS, Graph
from filtergym.envs.engine.backend import make_model
from filtergym.envs.engine.catalogue import catalogue
from filtergym.envs.engine.reward import cost_reward

SIZES = (1, 16, 256, 4096, 65536)
STEPS = 100
"""Largest number of steps of a round."""
PEER = "CartPole-v1"
EPISODES, MANY_EPISODES = 2000, 100_000
COMPETITORS = (
    "imm", "adaptive", "fixed-best", "kalman-imm", "kalman-imm-turn", "unscented-turn", "sage-husa",
    "variational-bayes", "known-turn", "bptt",
)  # fmt: skip
Record = dict[str, Any]


def processor_seconds(call: Callable[[], object]) -> float:
    begin = time.process_time()
    call()
    return time.process_time() - begin


def median_seconds(call: Callable[[], object], share: float, fewest: int = 3) -> float:
    """Return the median processor time of a call, s, over rounds that take ``share`` seconds together."""
    call()  # compiles; warms caches and clocks
    times: list[float] = []
    while len(times) < fewest or sum(times) < share:
        times.append(processor_seconds(call))
    return statistics.median(times)


# --- environments


def step_seconds(env: Any, share: float) -> float:
    """Return the median processor time of a step, s, with its share of a reset of all environments."""
    env.action_space.seed(0)
    actions = itertools.cycle([env.action_space.sample() for _ in range(8)])
    length = getattr(env.unwrapped, "last_decision", 500)
    count = min(STEPS, length)

    def steps() -> None:
        for _ in range(count):
            env.step(next(actions))

    env.reset(seed=0)
    resets = [processor_seconds(env.reset) for _ in range(3)]
    rounds = []
    while len(rounds) < 3 or sum(rounds) < share:
        rounds.append(processor_seconds(steps))
        if sum(rounds) > 3.0 * share:
            break
    env.close()
    return statistics.median(rounds) / count + statistics.median(resets) / length


def measure_environments(ids: list[str], sizes: list[int], share: float) -> Iterator[Record]:
    for id in [*ids, PEER]:
        interval = make_model(catalogue()[id]).task.decision_interval if id in catalogue() else 1
        row: Record = {"environment": id.removeprefix("filtergym/")}
        alone: Any = gymnasium.make(id, disable_env_checker=True)
        row["one step, µs"] = 1e6 * step_seconds(_ResettingEnv(alone), share)
        for size in sizes:
            if id == "filtergym/TightlyCoupledNavigation-v0" and size > 4096:
                continue  # gigabytes
            native = {} if id in catalogue() else {"vectorization_mode": "vector_entry_point"}
            seconds = step_seconds(gymnasium.make_vec(id, num_envs=size, **native), share)
            row[f"N = {size}"] = 1e-6 * size * interval / seconds
        yield row


class _ResettingEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        answer = self.env.step(action)
        if answer[2] or answer[3]:
            self.env.reset()
        return answer


# --- steps


def compiled_costs() -> tuple[float, float]:
    """Return the seconds of an arithmetic operation, and of an exponential, in compiled code."""
    chains, links, x = 16, 64, numpy.linspace(-1.0, 1.0, 16 * 8).reshape(16, 8)

    def arithmetic(x: Any) -> Any:
        for i in range(links):
            x = x * x if i % 2 else x + x
        return x

    def exponentials(x: Any) -> Any:
        return namespace.stack([namespace.exp(x[i] + 0.01 * j) for i in range(chains) for j in range(4)])

    def cost(function: Callable[[Any], Any], count: int) -> float:
        special = Specialised(function, Graph(), [x])
        call = special.bound([x], [numpy.empty((special.outputs[0].rows, 8))])

        def thousand(width: int) -> Callable[[], None]:
            def run() -> None:
                for _ in range(1000):
                    call(0, width)

            return run

        taken = median_seconds(thousand(8), 0.1) - median_seconds(thousand(0), 0.1)
        return taken / (1000 * 8 * count)

    return cost(arithmetic, chains * links), cost(exponentials, chains * 4)


def floor_seconds(model: Any) -> float:
    """Return the seconds of the arithmetic alone in a compiled step of one episode."""
    parts = model.programs.later
    programs = [parts.update, parts.advance, parts.predict, model.programs.report_program(cost_reward)]
    names = [step.operation for special in programs for step in special.program.steps]
    functions = sum(name in FUNCTIONS for name in names)
    operation, function = compiled_costs()
    return (
        sum(name not in ("input", "constant") for name in names) - functions
    ) * operation + functions * function


def measure_steps(ids: list[str], share: float, size: int = 4096) -> Iterator[Record]:
    try:
        import jax  # noqa: F401
        import peer_jax
    except ImportError:
        peer_jax = None  # type: ignore[assignment]
        print("without JAX: pip install jax")
    for id in ids:
        for control in catalogue()[id].controls:
            row: Record = {"environment": id.removeprefix("filtergym/"), "control": control}
            keywords: Record = {"control": control, "reward": "cost", "decision_interval": 1}
            few = 256 if id == "filtergym/TightlyCoupledNavigation-v0" else size
            for backend in ("compiled", "numpy"):
                env = gymnasium.make_vec(id, num_envs=few, backend=backend, **keywords)
                row[f"{backend}, ns"] = 1e9 * step_seconds(env, share) / few
            if peer_jax is not None and few == size:
                try:
                    step = peer_jax.jitted_step(id, control, few, decision_interval=1)
                    row["jax.jit, ns"] = 1e9 * median_seconds(step, share) / few
                except (TypeError, NotImplementedError):  # jax.numpy lacks it
                    pass
            if id == peer_imm.PEER_OF and control != "gain":
                row["filterpy, ns"] = 1e9 / peer_imm.imm_steps_per_second(500)
            row["floor, ns"] = 1e9 * floor_seconds(make_model(catalogue()[id], control, backend="compiled"))
            yield row


# --- evaluations


def measure_evaluations(id: str, episodes: int, share: float) -> Iterator[Record]:
    horizon = make_model(catalogue()[id]).task.horizon
    few = min(episodes, EPISODES)
    for name in COMPETITORS:
        seconds = median_seconds(lambda name=name: filtergym.evaluate(id, name, episodes=few), share)  # type: ignore[misc]
        yield {
            "competitor": name,
            "episodes": few,
            "seconds": seconds,
            "ns a measurement": 1e9 * seconds / few / horizon,
        }
    seconds = processor_seconds(lambda: filtergym.evaluate(id, COMPETITORS, episodes=episodes))
    per = 1e9 * seconds / (len(COMPETITORS) * episodes * horizon)
    yield {"competitor": "all ten", "episodes": episodes, "seconds": seconds, "ns a measurement": per}


# --- scaling

_EVALUATE = "filtergym.evaluate({id!r}, {names!r}, episodes={episodes}, horizon={horizon})"
_STEP = (
    "env = gymnasium.make_vec({id!r}, num_envs={size}); env.reset(seed=0); a = env.action_space.sample()\n"
    "for _ in range(200): env.step(a)"
)


def run_apart(code: str) -> tuple[float, float]:
    """Run code twice in a separate process; return processor seconds and peak memory, MB, of the second run."""
    # Not getrusage: its peak of a process includes the memory of the parent at the start.
    program = (
        "import re, pathlib, time, gymnasium, numpy, filtergym\ndef run():\n    "
        + code.replace("\n", "\n    ")
        + "\nrun()\nbegin = time.process_time()\nrun()\n"
        "peak = re.search('VmHWM:.*?(\\d+)', pathlib.Path('/proc/self/status').read_text()).group(1)\n"
        "print(time.process_time() - begin, peak)"
    )
    answer = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    return float(answer[0]), float(answer[1]) / 1024


def measure_scaling(id: str) -> Iterator[Record]:
    names = [name for name in COMPETITORS if name != "bptt"][:8]
    usual: Record = {"id": id, "names": names[:2], "episodes": 2000, "horizon": 100}
    kinds: dict[str, Callable[[int], str]] = {
        "episodes": lambda k: _EVALUATE.format(**{**usual, "episodes": 2000 * k}),
        "competitors": lambda k: _EVALUATE.format(**{**usual, "names": names[: 2 * k]}),
        "measurements": lambda k: _EVALUATE.format(**{**usual, "horizon": 100 * k}),
        "environments": lambda k: _STEP.format(id=id, size=4096 * k),
    }
    for what, code in kinds.items():
        found = {k: run_apart(code(k)) for k in (1, 2, 4)}
        row: Record = {"more": what, **{f"seconds x {k}": seconds for k, (seconds, _) in found.items()}}
        row |= {f"MB x {k}": memory for k, (_, memory) in found.items()}
        yield {**row, "time 4 : 2": found[4][0] / found[2][0], "memory 4 : 2": found[4][1] / found[2][1]}


def show(title: str, rows: Iterator[Record], records: dict[str, list[Record]]) -> None:
    records[title] = []
    for row in rows:
        records[title].append(row)
        print(f"  {title}: {next(iter(row.values()))} ...", file=sys.stderr, flush=True)
    table = pandas.DataFrame(records[title])
    texts = [[_cell(value) for value in line] for line in table.to_numpy(dtype=object).tolist()]
    print(f"\n{title}\n\n| {' | '.join(table.columns)} |\n|{'---|' * len(table.columns)}")
    print("\n".join(f"| {' | '.join(line)} |" for line in texts), flush=True)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if numpy.isnan(value) else f"{value:.3g}" if value < 1e5 else f"{value:,.0f}"
    return str(value)


def main() -> None:
    sections = ("environments", "steps", "evaluations", "scaling")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("section", nargs="*", choices=[*sections, []], help="sections to time (default: all)")
    parser.add_argument("--environment", action="append", metavar="ID", help="only this one; may be repeated")
    parser.add_argument("--size", action="append", type=int, metavar="N", help="only this N; may be repeated")
    parser.add_argument("--seconds", type=float, default=0.5, help="for the rounds of a figure (default 0.5)")
    parser.add_argument("--large", action="store_true", help=f"evaluate {MANY_EPISODES:,} episodes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows to this file")
    chosen = parser.parse_args()
    ids = chosen.environment or list(catalogue())
    if unknown := [id for id in ids if id not in catalogue()]:
        parser.error(f"unknown environment {unknown[0]!r}: choose from {', '.join(catalogue())}")
    if any(size < 1 for size in chosen.size or ()) or not chosen.seconds > 0.0:
        parser.error("--size and --seconds must be positive")
    filtergym.register()
    kept: dict[str, list[Record]] = {}
    wanted = chosen.section or sections
    if "environments" in wanted:
        show("environments", measure_environments(ids, chosen.size or list(SIZES), chosen.seconds), kept)
    if "steps" in wanted:
        show("steps", measure_steps(ids, chosen.seconds), kept)
    if "evaluations" in wanted:
        episodes = MANY_EPISODES if chosen.large else EPISODES
        show("evaluations", measure_evaluations(peer_imm.PEER_OF, episodes, chosen.seconds), kept)
    if "scaling" in wanted:
        show("scaling", measure_scaling(peer_imm.PEER_OF), kept)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\nNumPy {numpy.__version__}, Gymnasium {gymnasium.__version__}; peak memory {memory:.0f} MB")
    if chosen.json:
        chosen.json.write_text(json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
