"""How fast the environments step, beside what the machine could do and beside a peer.

    python benchmarks/throughput.py [--environment ID] [--size N] [--seconds S] [--json FILE]

**What is timed.** First what users get: the public ``step`` of ``gymnasium.make_vec(ID, num_envs=N)``, with nothing
but its defaults (a step is one action: ten measurements in TightlyCoupledNavigation). Then the kernel, with every
control and backend: the ``step`` of the environment that ``gymnasium.make`` makes (wrappers included) and of the vector
environments of ``gymnasium.make_vec``: action check, filters, reward ``cost``, observation. Every step of it is one
measurement (``decision_interval`` 1) of the environment's first scenario, the paper's, where no scan is missed. A step
carries its share of a reset: that of all environments, over the length of an episode. One thread. Actions are random
and drawn beforehand, in float32 as the space has them.

A row is the median over rounds of a reset and 128 steps (fewer where episodes are shorter), repeated until the row's
share of ``--seconds`` is spent. What is dear is found out by three steps: where a single round would take more than
six shares, the size is left out, and so are the larger ones. A size that is asked for by ``--size`` is measured
whatever it costs.

Where other jobs share the processor, the rate by the clock on the wall drops below the rate by the time that the
process was given; both are shown, and floors and ratios use the latter for both sides.

**Floor.** Of what calls an array library: the elementwise operations of one public step, counted as torch dispatches
them (additions, products, comparisons, selections: one each; square roots, exponentials, logarithms, angles: one
function each; a matrix product: two per term), times the measured cost of one in NumPy on operands in the
first-level cache: ``multiply`` for operations, ``exp`` for functions (the cheapest of them). Code that fuses
operations in registers can pass this floor; code that calls the array library for each operation cannot. Of compiled
steps: the operations and functions that are left in the programs of a step, times the cost of one in compiled
programs that do nothing but add and multiply in registers, or nothing but exponentials. Neither counts the noise,
resets, or what Python does around a step, which is all that matters at N = 1.

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
from filtergym.compiler import namespace
from filtergym.compiler.functions import Specialised
from filtergym.compiler.program import Graph
from filtergym.envs.backend import make_model
from filtergym.envs.catalogue import catalogue
from filtergym.envs.compiled import AVAILABLE
from filtergym.envs.reward import cost_reward

import filtergym

try:
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode
except ImportError:
    torch = None  # type: ignore[assignment]
    TorchDispatchMode = object  # type: ignore[assignment, misc]

STEPS = 128
"""Steps of a round, at most: whole blocks of noise of the long episodes."""
SIZES = (1, 256, 4096)
DEFAULT_SIZES = (1, 16, 256, 4096)
KERNEL: dict[str, Any] = {"decision_interval": 1, "reward": "cost"}
"""With the first scenario: neither missed scans nor the steps of the paper's filter beside those of the agent, which
the default scenario and reward of an environment may add.
"""
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


class Costs(NamedTuple):
    """Seconds per number."""

    operation: float
    function: float


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


def elementwise_costs() -> Costs:
    """Costs of ``multiply`` and of ``exp`` on operands in the first-level cache."""
    a, b = numpy.linspace(-1.0, 1.0, 1024), numpy.empty(1024)

    def cost(operation: numpy.ufunc, *operands: numpy.ndarray) -> float:
        def thousand() -> None:
            for _ in range(1000):
                operation(*operands, out=b)

        return statistics.median(seconds(thousand)[1] for _ in range(21)) / (1000 * len(b))

    return Costs(cost(numpy.multiply, a, a), cost(numpy.exp, a))


def compiled_costs() -> Costs:
    """Costs of an addition or product, and of an exponential, in compiled programs that do nothing else."""
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

        def thousand() -> None:
            for _ in range(1000):
                call(0, 8)

        def thousand_of_nothing() -> None:
            for _ in range(1000):
                call(0, 0)

        taken, empty = (
            statistics.median(seconds(many)[1] for _ in range(21)) for many in (thousand, thousand_of_nothing)
        )
        return (taken - empty) / (1000 * 8 * count)

    return Costs(cost(arithmetic, chains * links), cost(exponentials, chains * 4))


def compiled_floor(id: str, control: str, costs: Costs) -> float | None:
    """Steps per second if a step took only the arithmetic of its programs."""
    model: Any = make_model(catalogue()[id], control, backend="auto")
    if model.backend != "compiled":
        return None
    parts = model.programs.later
    halves = [parts.act, parts.advance, parts.predict, model.programs.report_program(cost_reward)]
    names = [step.operation for special in halves for step in special.program.steps]
    functions = sum(name in FUNCTIONS or name == "pow" for name in names)
    operations = sum(name not in ("input", "constant") for name in names) - functions
    return 1.0 / (operations * costs.operation + functions * costs.function)


def arithmetic_floor(id: str, control: str, costs: Costs) -> float | None:
    """Steps per second if a step took only its elementwise operations."""
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
    return lanes / (counter.operations * costs.operation + counter.functions * costs.function)


def seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Time of a call by the clock on the wall, and time that the process was given for it."""
    begin, begin_processor = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - begin, time.process_time() - begin_processor


class Episodes(NamedTuple):
    """What is timed."""

    start: Callable[[], object]
    steps: Callable[[int], object]
    """Takes a number of steps."""
    length: int
    """Steps of an episode, the one that resets included."""


def paper_scenario(id: str) -> str:
    """Return the name of the first scenario of an environment."""
    return next(iter(catalogue()[id].scenarios))


def single(id: str, control: str, backend: dict[str, Any]) -> Episodes:
    """Episodes of ``gymnasium.make``."""
    env: Any = gymnasium.make(id, control=control, scenario=paper_scenario(id), **KERNEL, **backend)
    env.action_space.seed(0)
    action = env.action_space.sample()

    def steps(count: int) -> None:
        for _ in range(count):
            env.step(action)

    env.reset(seed=0)
    return Episodes(env.reset, steps, env.unwrapped.fleet.decisions_per_episode)


def vector(id: str, control: str, size: int, backend: dict[str, Any]) -> Episodes:
    """Return the same of ``gymnasium.make_vec``; without a control, with nothing but its defaults."""
    keywords = {"control": control, "scenario": paper_scenario(id), **KERNEL, **backend} if control else {}
    env: Any = gymnasium.make_vec(id, num_envs=size, **keywords)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(8)]
    if backend.get("backend") == "torch":
        actions = [torch.as_tensor(action, device=backend["device"]) for action in actions]

    def steps(count: int) -> None:
        for action in itertools.islice(itertools.cycle(actions), count):
            observation, reward, *_ = env.step(action)
        float(observation[0, 0] + reward[0])  # waits for a device that runs behind

    env.reset(seed=0)  # later resets go on with the same generators, as an autoreset does
    return Episodes(env.reset, steps, env.unwrapped.last_decision + 1)


def measure(episodes: Episodes, share: float, dearest: float) -> tuple[list[tuple[float, float]], float]:
    """Times of a step in several rounds, and what a round was expected to take, all in seconds.

    Args:
        episodes: to time.
        share: time for all rounds; there is at least one.
        dearest: expected time of a round from which on none is made.
    """
    count = min(STEPS, episodes.length - 1)
    episodes.start()
    episodes.steps(2)  # compile; warm caches and clocks
    expected = seconds(episodes.start)[0] + count * seconds(lambda: episodes.steps(1))[0]
    rounds: list[tuple[float, float]] = []
    begin = time.perf_counter()
    while expected <= dearest and (not rounds or time.perf_counter() - begin < share):
        reset, steps = seconds(episodes.start), seconds(lambda: episodes.steps(count))
        times = [s / count + r / episodes.length for r, s in zip(reset, steps, strict=True)]
        rounds.append((times[0], times[1]))
    return rounds, expected


def _millions(rate: float | None) -> str:
    return "-" if rate is None else f"{rate / 1e6:.3g}"


def _line(*columns: str) -> None:
    widths = (28, 9, 13, 6, 9, 9, 13, 8, 7, 7)
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


def defaults(ids: list[str], sizes: list[int] | None, total: float) -> Iterator[Row]:
    """Measure ``gymnasium.make_vec`` with nothing but its defaults; the fastest of three alternated medians counts.

    A cell of which one round takes longer than its share is measured once.
    """
    cells = [(id, size) for id in ids for size in sorted(sizes or DEFAULT_SIZES)]
    share = total / (3 * len(cells))
    taken: dict[tuple[str, int], list[tuple[float, float]]] = {cell: [] for cell in cells}
    dear = set()
    for id, size in 3 * cells:
        if (id, size) not in dear:
            rounds, expected = measure(vector(id, "", size, {}), share, float("inf"))
            wall, processor = (statistics.median(times) for times in zip(*rounds, strict=True))
            taken[id, size].append((wall, processor))
            dear |= {(id, size)} if expected > share else set()
    for (id, size), times in taken.items():
        wall, processor = (min(kind) for kind in zip(*times, strict=True))
        yield Row(id, "", "defaults", size, len(times), wall, size / wall, size / processor, None, None)


def markdown_of_defaults(rows: list[Row]) -> Iterator[str]:
    """Table of a page: what users get."""
    mine = [row for row in rows if not row.control]
    sizes = sorted({row.size for row in mine})
    yield f"| environment | {' | '.join(f'N = {size}' for size in sizes)} |"
    yield "|" + "---|" * (len(sizes) + 1)
    for id in dict.fromkeys(row.environment for row in mine):
        rates = (f"{row.processor_rate / 1e6:.3g}" for row in mine if row.environment == id)
        yield f"| {id.removeprefix('filtergym/')} | {' | '.join(rates)} |"


def measured(ids: list[str], sizes: list[int] | None, total: float) -> Iterator[Row]:
    """Measure every environment and control; rows come as they are measured."""
    backends = [Backend("numpy", {"backend": "numpy"})]
    if AVAILABLE:
        backends.insert(0, Backend("compiled", {"backend": "compiled"}))
    on_arrays = len(backends)
    if torch is not None:
        torch.set_num_threads(1)
        devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
        backends += [Backend(f"torch {d}", {"backend": "torch", "device": d}) for d in devices]
    cells = [(id, control) for id in ids for control in catalogue()[id].controls]
    share = total / (len(cells) * (on_arrays + len(backends) * len(sizes or SIZES)))
    dearest = DEAR * share if sizes is None else float("inf")
    costs = elementwise_costs()
    native = compiled_costs() if AVAILABLE else costs
    peer_runs: list[float] = []
    for id, control in cells:
        floors = {"compiled": compiled_floor(id, control, native)}
        array_floor = arithmetic_floor(id, control, costs)
        has_peer = id == peer_imm.PEER_OF and control != "gain"
        if has_peer:  # before every control, so that the peer meets the same disturbances
            peer_runs += [peer_imm.imm_steps_per_second(500) for _ in range(3)]

        def row(
            backend: str,
            size: int,
            rounds: list[tuple[float, float]],
            id: str = id,
            control: str = control,
            floors: dict[str, float | None] = floors,
            array_floor: float | None = array_floor,
            peer: float | None = statistics.median(peer_runs) if has_peer else None,
        ) -> Row:
            wall, processor = (statistics.median(times) for times in zip(*rounds, strict=True))
            floor = floors.get(backend.removeprefix("make "), array_floor)
            if "cuda" in backend:  # the time of the processor is not that of the device
                processor, floor = wall, None
            rate = size / processor
            times_peer = rate / peer if peer else None
            return Row(id, control, backend, size, len(rounds), wall, size / wall, rate, floor, times_peer)

        for backend in backends[:on_arrays]:
            rounds, _ = measure(single(id, control, backend.keywords), share, float("inf"))
            yield row(f"make {backend.name}", 1, rounds)
        for backend in backends:
            for size in sorted(sizes or SIZES):
                rounds, expected = measure(vector(id, control, size, backend.keywords), share, dearest)
                if not rounds:
                    short = id.removeprefix("filtergym/")
                    print(
                        f"{short} {control} {backend.name}: N = {size} is left out, a round takes "
                        f"{expected:.0f} s; ask for it with --size",
                        flush=True,
                    )
                    break
                yield row(backend.name, size, rounds)
    for name, found in (("NumPy", costs), ("compiled", native)):
        print(
            f"{name}: {1e9 * found.operation:.3g} ns per operation, {1e9 * found.function:.3g} ns per exp, in cache."
        )
    if peer_runs:
        rate = statistics.median(peer_runs)
        print(f"Peer, filterpy IMMEstimator in a loop: {rate:.0f} steps per second of processor time.")


def markdown(rows: list[Row]) -> Iterator[str]:
    """Table of a page: a line for each environment, control and backend."""
    sizes = sorted({row.size for row in rows})
    head = ["environment", "control", "backend", "one step of `gymnasium.make`, µs"]
    head += [*(f"N = {size}" for size in sizes), "share of the floor", "times the peer"]
    yield f"| {' | '.join(head)} |"
    yield "|" + "---|" * len(head)
    kinds = dict.fromkeys((r.environment, r.control, r.backend.removeprefix("make ")) for r in rows)
    for environment, control, backend in kinds:
        mine = [r for r in rows if (r.environment, r.control) == (environment, control)]
        alone = [f"{1e6 * r.step_seconds:.0f}" for r in mine if r.backend == f"make {backend}"]
        vectors = {r.size: r for r in mine if r.backend == backend}
        largest = vectors[max(vectors)]
        share = "" if largest.floor is None else f"{largest.processor_rate / largest.floor:.0%}"
        peer = "" if largest.times_peer is None else f"{largest.times_peer:.0f}"
        rates = [f"{vectors[size].processor_rate / 1e6:.3g}" if size in vectors else "" for size in sizes]
        name = environment.removeprefix("filtergym/")
        yield f"| {' | '.join([name, control, backend, *(alone or ['']), *rates, share, peer])} |"


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Throughput of the environments.")
    parser.add_argument("--environment", action="append", metavar="ID", help="only this one; may be repeated")
    parser.add_argument("--size", action="append", type=int, metavar="N", help="only this N; may be repeated")
    parser.add_argument(
        "--seconds", type=float, default=120.0, help="time for all rounds together (default 120)"
    )
    parser.add_argument("--defaults", action="store_true", help="only what users get, not the kernel")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows to this file")
    parser.add_argument("--markdown", action="store_true", help="end with a table of rates for a page")
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
    share = arguments.seconds / (1 if arguments.defaults else 4)
    found = defaults(ids, arguments.size, share)
    kernel = iter(()) if arguments.defaults else measured(ids, arguments.size, arguments.seconds - share)
    for row in itertools.chain(found, kernel):
        _show(row)
        rows.append(row)
    print(f"Measured in {time.perf_counter() - begin:.0f} s.")
    if arguments.markdown:
        print(*markdown_of_defaults(rows), "", sep="\n")
        if not arguments.defaults:
            print(*markdown([row for row in rows if row.control]), sep="\n")
    if arguments.json:
        versions = {"python": platform.python_version(), "numpy": numpy.__version__}
        versions |= {} if torch is None else {"torch": torch.__version__}
        document = {"versions": versions, "rows": [row._asdict() for row in rows]}
        arguments.json.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
