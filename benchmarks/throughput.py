"""How fast the environments step, beside what the machine could do and beside a peer.

    python benchmarks/throughput.py [--environment ID] [--size N] [--seconds S] [--json FILE]

**What is timed.** The public ``step``, of the environment that ``gymnasium.make`` makes (wrappers included) and
of the vector environments of ``gymnasium.make_vec``: action check, filters, reward, observation, autoreset
(NEXT_STEP; every 100 steps or at the end of the episode, whichever comes first; for long episodes that is more
resets than they really have). Every step is one measurement (``decision_interval`` 1). One thread. Actions are
random and drawn beforehand, in float32 as the space has them.

A row is the median over rounds of 101 steps, repeated until the row's share of ``--seconds`` is spent. What is
dear is found out by three steps: where a single round would take more than six shares, the size is left out,
and so are the larger ones. A size that is asked for by ``--size`` is measured whatever it costs.

Where other jobs share the processor, the rate by the clock on the wall drops below the rate by the time that the
process was given; both are shown, and floors and ratios use the latter for both sides.

**Floor.** The elementwise operations of one public step, counted as torch dispatches them (additions, products,
comparisons, selections: one each; square roots, exponentials, logarithms, angles: one function each; a matrix
product: two per term), times the measured cost of one in NumPy on operands in the first-level cache:
``multiply`` for operations, ``exp`` for functions (the cheapest of them). Code that fuses operations in
registers can pass this floor; code that calls the array library for each operation cannot. At N = 1 it does
not matter: the time is Python's, some microseconds for each of the array library's calls.

**Peer.** See ``peer_imm.py``; the ratio is that of the rates in the same run.

**Two versions** are compared by running this file with the Python of each, at the same time if others use the
machine, and by dividing the rates in the two files that ``--json`` writes.
"""

import argparse
import itertools
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

import gymnasium
import numpy
import peer_imm
from filtergym.envs.catalogue import catalogue

import filtergym

try:
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode
except ImportError:
    torch = None  # type: ignore[assignment]
    TorchDispatchMode = object  # type: ignore[assignment, misc]

STEPS = 100
"""Steps between two autoresets, at most."""
SIZES = (1, 256, 4096)
DEAR = 6.0
"""Shares of the time that one round may take."""

FUNCTIONS = {"sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "atan2", "atan", "asin", "acos"}
FUNCTIONS |= {"tanh"}
MOVES = {"cat", "stack", "clone", "copy_", "_to_copy", "zeros_like", "ones_like", "full_like", "new_zeros"}
MOVES |= {"eye", "arange", "zeros", "ones", "full", "empty", "scalar_tensor", "index", "_local_scalar_dense"}
PRODUCTS = {"mm", "bmm", "addmm", "baddbmm", "dot", "mv"}


class Backend(NamedTuple):
    """What an environment is made with."""

    name: str
    keywords: dict[str, Any]


class Row(NamedTuple):
    """One measured cell."""

    environment: str
    control: str
    backend: str
    size: int
    """Number of sub-environments."""
    rounds: int
    step_seconds: float
    """One call of ``step``, by the clock on the wall."""
    rate: float
    """Environment steps per second by the clock on the wall."""
    processor_rate: float
    """The same by the time that the process was given."""
    floor: float | None
    """Environment steps per second."""
    times_peer: float | None


class _Counter(TorchDispatchMode):
    """Counts elementwise operations, functions and terms of matrix products as torch carries them out."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = self.functions = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        first = result[0] if isinstance(result, tuple | list) else result
        if func.is_view or name in MOVES or not isinstance(first, torch.Tensor):
            return result
        if name in PRODUCTS:
            factor = next(a for a in args if isinstance(a, torch.Tensor) and a.ndim > 1)
            self.operations += 2 * first.numel() * factor.shape[-1]
        elif name in FUNCTIONS:
            self.functions += first.numel()
        else:
            self.operations += first.numel()
        return result


def elementwise_costs() -> tuple[float, float]:
    """Seconds per number of ``multiply`` and of ``exp`` on operands in the first-level cache."""
    a, b = numpy.linspace(-1.0, 1.0, 1024), numpy.empty(1024)

    def cost(operation: numpy.ufunc, *operands: numpy.ndarray) -> float:
        def thousand() -> None:
            for _ in range(1000):
                operation(*operands, out=b)

        return statistics.median(seconds(thousand)[1] for _ in range(21)) / (1000 * len(b))

    return cost(numpy.multiply, a, a), cost(numpy.exp, a)


def arithmetic_floor(id: str, control: str, operation: float, function: float) -> float | None:
    """Steps per second if a step took only its elementwise operations, at the given costs in seconds."""
    if torch is None:
        return None
    lanes, counter = 64, _Counter()
    env = gymnasium.make_vec(id, num_envs=lanes, control=control, decision_interval=1, backend="torch")
    env.action_space.seed(0)
    action = torch.as_tensor(env.action_space.sample())
    with torch.no_grad():
        env.reset(seed=0)
        env.step(action)
        with counter:
            env.step(action)
    env.close()
    return lanes / (counter.operations * operation + counter.functions * function)


def seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Time of a call by the clock on the wall, and time that the process was given for it."""
    begin, begin_processor = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - begin, time.process_time() - begin_processor


def single_round(id: str, control: str) -> tuple[Callable[[], object], Callable[[int], object], int]:
    """Episodes of ``gymnasium.make``: a function that starts one, one that takes steps, the steps of a round."""
    env = gymnasium.make(id, control=control, decision_interval=1)
    env.action_space.seed(0)
    action = env.action_space.sample()

    def steps(count: int) -> None:
        for _ in range(count):
            if env.step(action)[3]:
                env.reset()

    return lambda: env.reset(seed=0), steps, STEPS


def vector_round(
    id: str, control: str, size: int, backend: dict[str, Any]
) -> tuple[Callable[[], object], Callable[[int], object], int]:
    """Return the same of ``gymnasium.make_vec``."""
    env = gymnasium.make_vec(
        id, num_envs=size, control=control, max_episode_steps=STEPS, decision_interval=1, **backend
    )
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(8)]
    if backend:
        actions = [torch.as_tensor(action, device=backend["device"]) for action in actions]

    def steps(count: int) -> None:
        for action in itertools.islice(itertools.cycle(actions), count):
            observation, reward, *_ = env.step(action)
        float(observation[0, 0] + reward[0])  # waits for a device that runs behind

    return lambda: env.reset(seed=0), steps, STEPS + 1


def measure(
    start: Callable[[], object], steps: Callable[[int], object], count: int, share: float, dearest: float
) -> tuple[list[tuple[float, float]], float]:
    """Times of rounds of ``count`` steps, and what a round was expected to take, all in seconds.

    Args:
        start: begins the episodes.
        steps: takes a number of steps.
        count: steps of a round.
        share: time for all rounds; there is at least one.
        dearest: expected time of a round from which on none is made.
    """
    resetting = seconds(start)[0]
    steps(2)  # warm caches and clocks
    expected = resetting + count * seconds(lambda: steps(1))[0]
    rounds: list[tuple[float, float]] = []
    begin = time.perf_counter()
    while expected <= dearest and (not rounds or time.perf_counter() - begin < share):
        rounds.append(seconds(lambda: steps(count)))
    return rounds, expected


def _millions(rate: float | None) -> str:
    return "-" if rate is None else f"{rate / 1e6:.3g}"


def _line(*columns: str) -> None:
    widths = (28, 9, 10, 6, 9, 9, 13, 8, 7, 7)
    aligned = (
        f"{text:<{width}}" if i < 3 else f"{text:>{width}}"
        for i, (text, width) in enumerate(zip(columns, widths, strict=True))
    )
    print(" ".join(aligned), flush=True)


def _show(row: Row) -> None:
    _line(
        row.environment.removeprefix("filtergym/"),
        row.control,
        row.backend,
        str(row.size),
        f"{1e6 * row.step_seconds:.0f}",
        _millions(row.rate),
        _millions(row.processor_rate),
        _millions(row.floor),
        "-" if row.floor is None else f"{row.processor_rate / row.floor:.0%}",
        "-" if row.times_peer is None else f"{row.times_peer:.0f}",
    )


def measured(ids: list[str], sizes: list[int] | None, total: float) -> Iterator[Row]:
    """Measure every environment and control; rows come as they are measured."""
    backends = [Backend("numpy", {})]
    if torch is not None:
        torch.set_num_threads(1)
        devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
        backends += [Backend(f"torch {d}", {"backend": "torch", "device": d}) for d in devices]
    cells = [(id, control) for id in ids for control in catalogue()[id].controls]
    share = total / (len(cells) * (1 + len(backends) * len(sizes or SIZES)))
    dearest = DEAR * share if sizes is None else float("inf")
    operation, function = elementwise_costs()
    peer_runs: list[float] = []
    for id, control in cells:
        floor = arithmetic_floor(id, control, operation, function)
        has_peer = id == peer_imm.PEER_OF and control != "gain"
        if has_peer:  # before every control, so that the peer meets the same disturbances
            peer_runs += [peer_imm.imm_steps_per_second(500) for _ in range(3)]

        def row(
            backend: str,
            size: int,
            count: int,
            rounds: list[tuple[float, float]],
            id: str = id,
            control: str = control,
            floor: float | None = floor,
            peer: float | None = statistics.median(peer_runs) if has_peer else None,
        ) -> Row:
            wall, processor = (statistics.median(times) / count for times in zip(*rounds, strict=True))
            if "cuda" in backend:  # the time of the processor is not that of the device
                processor, floor = wall, None
            rate = size / processor
            times_peer = rate / peer if peer else None
            return Row(id, control, backend, size, len(rounds), wall, size / wall, rate, floor, times_peer)

        *single, count = single_round(id, control)
        rounds, _ = measure(*single, count, share, float("inf"))
        yield row("make", 1, count, rounds)
        for backend in backends:
            for size in sorted(sizes or SIZES):
                *vector, count = vector_round(id, control, size, backend.keywords)
                rounds, expected = measure(*vector, count, share, dearest)
                if not rounds:
                    short = id.removeprefix("filtergym/")
                    print(
                        f"{short} {control} {backend.name}: N = {size} is left out, {STEPS} steps take "
                        f"{expected:.0f} s; ask for it with --size",
                        flush=True,
                    )
                    break
                yield row(backend.name, size, count, rounds)
    print(f"NumPy: {1e9 * operation:.2f} ns per multiply, {1e9 * function:.2f} ns per exp, in cache.")
    if peer_runs:
        rate = statistics.median(peer_runs)
        print(f"Peer, filterpy IMMEstimator in a loop: {rate:.0f} steps per second of processor time.")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Throughput of the environments.")
    parser.add_argument("--environment", action="append", metavar="ID", help="only this one; may be repeated")
    parser.add_argument("--size", action="append", type=int, metavar="N", help="only this N; may be repeated")
    parser.add_argument(
        "--seconds", type=float, default=70.0, help="time for all rounds together (default 70)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows to this file")
    arguments = parser.parse_args()
    ids = arguments.environment or list(catalogue())
    unknown = [id for id in ids if id not in catalogue()]
    if unknown:
        parser.error(f"unknown environment {unknown[0]!r}: choose from {', '.join(catalogue())}")
    if any(size < 1 for size in arguments.size or ()):
        parser.error("--size must be at least 1")
    if not arguments.seconds > 0.0:
        parser.error("--seconds must be positive")
    filtergym.register()
    begin, rows = time.perf_counter(), []
    print("One thread; rates in millions of environment steps per second.")
    _line(
        "environment",
        "control",
        "backend",
        "N",
        "step, µs",
        "rate",
        "by processor",
        "floor",
        "share",
        "× peer",
    )
    for row in measured(ids, arguments.size, arguments.seconds):
        _show(row)
        rows.append(row)
    print(f"Measured in {time.perf_counter() - begin:.0f} s.")
    if arguments.json:
        versions = {"python": platform.python_version(), "numpy": numpy.__version__}
        versions |= {} if torch is None else {"torch": torch.__version__}
        found = {"versions": versions, "rows": [row._asdict() for row in rows]}
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
