"""How fast the environments step, beside what the machine could do and beside a peer.

    python benchmarks/throughput.py [--full] [--compile] [--environment ID] [--size N]

**What is timed.** The public ``step`` of the vector environment: action check, filters, reward, observation,
autoreset (NEXT_STEP; every 100 steps or at the end of the episode, whichever comes first; for long episodes
that is more resets than they really have). Every step is one measurement (``decision_interval`` 1). One thread.
A rate is the median over repeats of 101 steps. Where other jobs share the processor, the rate by the clock on
the wall drops below the rate by the time that the process was given; both are shown, and shares and ratios use
the latter for both sides. Actions are random and drawn beforehand, in float32 as the space has them.

**Floors**, as rates that no implementation of the same arithmetic on this machine and thread can be expected
to pass by much:

* *memory*: a step must read the old state, one row of noise and the action, and write what is new of the
  state, the observation and the reward, each once. These bytes, copied by ``numpy.copyto`` between two buffers
  that hold them, at the same N: small batches are copied within the cache.
* *arithmetic*: elementwise operations of act, cost, measure and observe, counted as torch dispatches them
  (additions, products, comparisons, selections: one each; square roots, exponentials, logarithms, angles: one
  function each; a matrix product: two per term), times the measured cost of one in NumPy on operands in the
  first-level cache: ``multiply`` for operations, ``exp`` for functions (the cheapest of them). Code that
  fuses operations in registers, such as ``torch.compile`` makes, can pass this floor; code that calls the
  array library for each operation cannot.

At N = 1 neither matters: the time is Python's, some microseconds for each of the array library's calls.

**Peer.** See ``peer_imm.py``; the ratio is that of the rates in the same run.
"""

import argparse
import itertools
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

import gymnasium
import numpy
import peer_imm
from filtergym.envs.catalogue import catalogue, make_task
from filtergym.envs.lanes import LANE_MULTIPLE
from filtergym.envs.reward import capped_cost
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import filtergym

try:
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode
except ImportError:
    torch = None  # type: ignore[assignment]
    TorchDispatchMode = object  # type: ignore[assignment, misc]

STEPS = 100
"""Steps between two autoresets, at most."""
QUICK, FULL = (1, 256, 4096), (1, 16, 256, 1024, 4096, 16384, 65536)

FUNCTIONS = {
    "sqrt",
    "exp",
    "log",
    "log1p",
    "expm1",
    "sin",
    "cos",
    "tan",
    "atan2",
    "atan",
    "asin",
    "acos",
    "tanh",
}
MOVES = {"cat", "stack", "clone", "copy_", "_to_copy", "zeros_like", "ones_like", "full_like", "new_zeros"}
MOVES |= {"eye", "arange", "zeros", "ones", "full", "empty", "scalar_tensor", "index", "_local_scalar_dense"}
PRODUCTS = {"mm", "bmm", "addmm", "baddbmm", "dot", "mv"}


class Work(NamedTuple):
    """What one environment step takes at least, per lane."""

    read: float
    """Bytes."""
    written: float
    """Bytes."""
    operations: float | None
    """Elementwise operations; None without torch."""
    functions: float | None


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


def _leaves(state: Any) -> Iterator[Any]:
    if isinstance(state, tuple):
        for part in state:
            yield from _leaves(part)
    elif state is not None:
        yield state


def work_of_step(id: str, control: str, lanes: int = 64) -> Work:
    """Count bytes and operations of one step of a task, per lane."""
    xp: Any = numpy
    if torch is not None:
        import array_api_compat.torch as xp
    task = make_task(id, control, xp=xp, decision_interval=1)
    generator = numpy.random.default_rng(0)
    noise, space = task.noise, task.action_space
    uniforms = task.constant(generator.random((noise.uniforms, lanes)))
    normals = task.constant(generator.standard_normal((noise.initial_normals, lanes)))
    row = task.constant(generator.random((noise.normals + noise.row_uniforms, lanes)))
    state = task.measure(task.begin(uniforms, normals), row)
    action = xp.asarray(numpy.zeros((*space.shape, lanes), dtype=space.dtype))
    counter = _Counter()
    if torch is None:
        after, cost, shown = _cycle(task, state, action, row)
    else:
        with torch.no_grad(), counter:
            after, cost, shown = _cycle(task, state, action, row)

    def size(arrays: Any) -> float:
        return sum(array.nbytes for array in arrays) / lanes

    old = {id_of(array): array for array in _leaves(state)}
    new = {id_of(array): array for array in _leaves(after)}
    counted = (None, None) if torch is None else (counter.operations / lanes, counter.functions / lanes)
    return Work(
        size([*old.values(), row, action]),
        size(array for key, array in new.items() if key not in old) + size([cost, shown]),
        *counted,
    )


def id_of(array: Any) -> Any:
    """Tell arrays apart by their memory: one that is handed on is not written again."""
    return array.data_ptr() if hasattr(array, "data_ptr") else array.__array_interface__["data"][0]


def _cycle(task: Any, state: Any, action: Any, row: Any) -> tuple[Any, Any, Any]:
    posterior = task.act(state, action)
    cost = capped_cost(task, posterior)
    state = task.measure(posterior, row)
    return state, cost, task.observe(state)


class Duration(NamedTuple):
    """Time of one call, s."""

    wall: float
    processor: float
    """Time that the process was given."""


def duration(call: Callable[[], object], repeats: int, calls: int = 1) -> Duration:
    """Median time of one call."""
    wall, processor = [], []
    for _ in range(repeats):
        begin, begin_processor = time.perf_counter(), time.process_time()
        for _ in range(calls):
            call()
        wall.append((time.perf_counter() - begin) / calls)
        processor.append((time.process_time() - begin_processor) / calls)
    return Duration(statistics.median(wall), statistics.median(processor))


def memory_floor(work: Work, count: int) -> float:
    """Steps per second if only the bytes had to be moved."""
    width = -(-count // LANE_MULTIPLE) * LANE_MULTIPLE
    numbers = max(1, round((work.read + work.written) * width / 16))  # half is read, half is written
    source, target = numpy.ones(numbers), numpy.empty(numbers)
    calls = max(1, 2_000_000 // numbers)
    return count / duration(lambda: numpy.copyto(target, source), 7, calls).processor


def elementwise_costs() -> tuple[float, float]:
    """Seconds per number of ``multiply`` and of ``exp`` on operands in the first-level cache."""
    size = 1024
    a, b = numpy.linspace(-1.0, 1.0, size), numpy.empty(size)
    return (
        duration(lambda: numpy.multiply(a, a, out=b), 21, 1000).processor / size,
        duration(lambda: numpy.exp(a, out=b), 21, 200).processor / size,
    )


def vector_rates(id: str, control: str, count: int, repeats: int, **backend: Any) -> tuple[float, float]:
    """Environment steps through the public vector ``step`` per second, by the wall and by the processor."""
    steps = min(STEPS, make_task(id, control).horizon)
    env = gymnasium.make_vec(
        id, num_envs=count, control=control, max_episode_steps=steps, decision_interval=1, **backend
    )
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(8)]
    if backend:
        actions = [torch.as_tensor(action, device=backend["device"]) for action in actions]

    def episodes() -> None:
        for action in itertools.islice(itertools.cycle(actions), steps + 1):
            observation, reward, *_ = env.step(action)
        float(observation[0, 0] + reward[0])  # waits for a device that runs behind

    if count <= 4096:
        episodes()  # warm caches and clocks
    taken = duration(episodes, repeats if count <= 4096 else 3)
    env.close()
    return count * (steps + 1) / taken.wall, count * (steps + 1) / taken.processor


def single_step(id: str, control: str, repeats: int) -> Duration:
    """Time of ``step`` of the environment that ``gymnasium.make`` makes, wrappers included."""
    env = gymnasium.make(id, control=control, decision_interval=1)
    env.action_space.seed(0)
    action = env.action_space.sample()
    steps = min(STEPS, env.unwrapped.lanes.decisions_per_episode)  # type: ignore[attr-defined]
    taken = []
    for _ in range(repeats):
        env.reset(seed=0)
        taken.append(duration(lambda: env.step(action), 1, steps))
    env.close()
    return Duration(*(statistics.median(times) for times in zip(*taken, strict=True)))


def compiled_rates(id: str, control: str, count: int) -> tuple[float, float, float]:
    """Rates of the task alone on torch, eager and compiled, and the seconds that compiling takes."""
    import array_api_compat.torch as xp

    task = make_task(id, control, xp=xp)
    generator = numpy.random.default_rng(0)
    noise, space = task.noise, task.action_space
    row = task.constant(generator.random((noise.normals + noise.row_uniforms, count)))
    start = task.begin(
        task.constant(generator.random((noise.uniforms, count))),
        task.constant(generator.standard_normal((noise.initial_normals, count))),
    )
    state = task.measure(start, row)
    action = xp.asarray(numpy.zeros((*space.shape, count), dtype=space.dtype))
    compiled = torch.compile(_cycle, fullgraph=True)
    with torch.no_grad():
        begin = time.perf_counter()
        compiled(task, state, action, row)
        compiling = time.perf_counter() - begin
        rates = []
        for cycle in (_cycle, compiled):

            def roll(cycle: Any = cycle) -> None:
                current = state
                for _ in range(20):
                    current, _cost, _shown = cycle(task, current, action, row)

            roll()
            rates.append(20 * count / duration(roll, 7).processor)
    return rates[0], rates[1], compiling


def _millions(rate: float | None) -> str:
    return "-" if rate is None else f"{rate / 1e6:.3g}"


def report(ids: list[str], full: bool, with_compile: bool, sizes: Sequence[int]) -> None:
    """Measure everything and print the tables."""
    repeats = 7 if full else 3
    backends: list[tuple[str, dict[str, Any]]] = [("numpy", {})]
    if torch is not None:
        torch.set_num_threads(1)
        devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
        backends += [(f"torch {d}", {"backend": "torch", "device": d}) for d in devices]
    cells = [(id, control) for id in ids for control in catalogue()[id].controls]
    # Wide enough for the tables where the output is a file.
    console = Console(width=None if sys.stdout.isatty() else 150)

    single = Table(
        "environment", "control", "step, µs", "of processor time", title="Single environment, gymnasium.make"
    )
    vector = Table(title="Vector environment, gymnasium.make_vec: millions of steps per second, one thread")
    for name in (
        "environment",
        "control",
        "backend",
        "N",
        "rate",
        "by processor",
        "memory floor",
        "arithmetic floor",
        "share",
    ):
        vector.add_column(name, justify="left" if name in ("environment", "control", "backend") else "right")
    vector.add_column("× peer", justify="right")
    compiled = Table(
        "environment", "control", "eager", "compiled", "gain", "compiling, s",
        title="Task alone on torch cpu, N = 4096: millions of steps per second",
    )  # fmt: skip
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task(
            "measuring", total=len(cells) * (1 + len(sizes) * len(backends) + with_compile)
        )
        operation, function = elementwise_costs()
        peer_runs = (
            [peer_imm.imm_steps_per_second(500) for _ in range(repeats)] if peer_imm.PEER_OF in ids else []
        )
        for id, control in cells:
            short = id.removeprefix("filtergym/")
            taken = single_step(id, control, 5 * repeats)
            single.add_row(short, control, f"{1e6 * taken.wall:.0f}", f"{1e6 * taken.processor:.0f}")
            progress.advance(bar)
            work = work_of_step(id, control)
            arithmetic = None
            if work.operations is not None and work.functions is not None:
                arithmetic = 1.0 / (work.operations * operation + work.functions * function)
            for count, (name, backend) in itertools.product(sizes, backends):
                by_wall, rate = vector_rates(id, control, count, repeats, **backend)
                memory = memory_floor(work, count)
                # The arithmetic of a batch that is padded is done for the padding too.
                padded = (
                    None
                    if arithmetic is None
                    else arithmetic * count / (-(-count // LANE_MULTIPLE) * LANE_MULTIPLE)
                )
                share = rate / min(memory, padded or memory)
                ratio = "-"
                if id == peer_imm.PEER_OF and control != "gain":
                    ratio = f"{rate / statistics.median(peer_runs):.0f}"
                cuda = "cuda" in name
                floors = ("-", "-", "-") if cuda else (_millions(memory), _millions(padded), f"{share:.0%}")
                vector.add_row(
                    short, control, name, str(count), _millions(by_wall), _millions(rate), *floors, ratio
                )
                progress.advance(bar)
            if peer_runs and id == peer_imm.PEER_OF:
                peer_runs.append(peer_imm.imm_steps_per_second(500))  # the peer meets the same disturbances
            vector.add_section()
            if with_compile:
                eager, fast, compiling = compiled_rates(id, control, 4096)
                compiled.add_row(
                    short,
                    control,
                    _millions(eager),
                    _millions(fast),
                    f"{fast / eager:.1f}",
                    f"{compiling:.0f}",
                )
                progress.advance(bar)
    console.print(single)
    console.print(vector)
    console.print(f"NumPy: {1e9 * operation:.2f} ns per multiply, {1e9 * function:.2f} ns per exp, in cache.")
    if peer_runs:
        console.print(
            f"Peer, filterpy IMMEstimator in a loop: {statistics.median(peer_runs):.0f} steps per second."
        )
    if with_compile:
        console.print(compiled)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Throughput of the environments.")
    parser.add_argument("--full", action="store_true", help="N from 1 to 65536, more repeats (minutes)")
    parser.add_argument(
        "--compile", action="store_true", help="also torch.compile, a minute for each control"
    )
    parser.add_argument("--environment", action="append", metavar="ID", help="only this one; may be repeated")
    parser.add_argument("--size", action="append", type=int, metavar="N", help="only this N; may be repeated")
    arguments = parser.parse_args()
    ids = arguments.environment or list(catalogue())
    unknown = [id for id in ids if id not in catalogue()]
    if unknown:
        parser.error(f"unknown environment {unknown[0]!r}: choose from {', '.join(catalogue())}")
    if arguments.compile and torch is None:
        parser.error("--compile needs torch: pip install 'filtergym[agents]'")
    filtergym.register()
    if any(size < 1 for size in arguments.size or ()):
        parser.error("--size must be at least 1")
    report(ids, arguments.full, arguments.compile, arguments.size or (FULL if arguments.full else QUICK))


if __name__ == "__main__":
    main()
