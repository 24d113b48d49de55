"""What the full comparison costs: every competitor, every algorithm with 20 training seeds, 100 000 episodes a cell.

``python benchmarks/plan.py --units units.json`` measures unit costs on one core, some seven minutes, and prints
the plan, of which docs/many_cores.md shows the core hours. What the file holds is not measured again: a run that was
interrupted goes on, and other numbers of episodes, seeds and cores take seconds.

Measured, in seconds of the processor, after what is compiled has been compiled: for every competitor of the full
benchmark, and an agent of every algorithm after a short training, ``summarise`` over some episodes of the training
distribution; what the process that began the work does with what comes back; a few updates of every algorithm, and a
validation; one candidate of every tuning.

Extrapolated: linearly in measurements, decisions and candidates, from the training distribution to every scenario. A
reduction takes, beside that, a part for each block of episodes, however many are in it.

Items of work are those of ``filtergym benchmark --full``; a training run, or the tuning of a policy, is one item, and
what it makes is evaluated after it. They are given out as list scheduling does (Graham: Bounds on multiprocessing
timing anomalies, SIAM J. Appl. Math. 17, 1969, 416-429): training and tuning first, the longest first, each to the
core that is free first. What comes back is taken, one after the other, by the process that began the work.
"""

import argparse
import functools
import heapq
import json
import os
import pickle
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

import numpy
from filtergym.agents.learned_policy import PRETRAINED
from filtergym.agents.named_policies import pretrained_agents
from filtergym.agents.settings import THROUGH_THE_FILTER
from filtergym.agents.training_run import FILES, RunOptions, new_run
from filtergym.agents.training_session import Bookkeeping, Session
from filtergym.baselines.catalogue import baselines_of, package_of
from filtergym.baselines.problem import problem_of
from filtergym.baselines.tuning import Candidate, episode_costs
from filtergym.envs.engine.catalogue import bare_name, catalogue, short_name
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.evaluation.running.curves import DISTRIBUTION_LIMIT
from filtergym.evaluation.running.own_metrics import MetricInputs, OwnMetrics
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.evaluation.running.summary import (
    EvaluationRequest,
    Part,
    _resampling,
    combine_summaries,
    summarise,
)
from filtergym.evaluation.statistics.bootstrap import RESAMPLES, Bootstrap, block_of
from filtergym.evaluation.storage.files import write_text
from filtergym.evaluation.storage.store import Store, Work
from rich.box import MARKDOWN
from rich.console import Console
from rich.progress import track
from rich.table import Table

from filtergym.names import evaluation_requests
from filtergym.reports.tables.benchmark import benchmark_policies, cells

EPISODES, SEEDS, CORES = 100_000, 20, (1, 64, 1000)
MEASUREMENTS = 100_000
"""Of a competitor, in which its unit cost is measured; no more than a block of episodes."""
WARM = 8
"""Episodes of the call before, which compiles."""
VALIDATIONS = 20
"""Of a training run."""
CANDIDATE = 256
"""Episodes that a candidate of a tuning meets, and an eighth of those that the best and the untuned one meet."""
GIB = 2.0**30
MOVES = ("as it is", "pieces joined by the workers", "and cells told by the workers")
"""What would be changed, one after the other."""

Units = dict[str, Any]
"""What was measured, as a file of JSON holds it."""


def spent(call: Callable[[], Any]) -> tuple[Any, float]:
    """What a function returns, and its seconds of the processor."""
    began = time.process_time()
    found = call()
    return found, time.process_time() - began


def algorithms(id: str) -> list[str]:
    """Algorithms that can train on an environment."""

    def fits(name: str) -> bool:
        try:
            new_run(problem_of(id), RunOptions(name))
        except ValueError:
            return False
        return True

    return [name for name in FILES if fits(name)]


# --- unit costs


def start_seconds() -> dict[str, float]:
    """What every process does before its first piece of work."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = (
        "import filtergym.evaluation.running.summary, filtergym.agents.bptt, filtergym.agents.sb3_training"
    )
    subprocess.run([sys.executable, "-c", words], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    imports = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"imports": imports, "resampling": spent(lambda: Bootstrap(EPISODES, RESAMPLES))[1]}


def long_work(id: str, competitors: Any) -> list[EvaluationRequest]:
    """Return the work of the plan with competitors of an environment, of which the first episodes are measured."""
    problem = problem_of(id)
    return evaluation_requests(problem, problem.experiment(None, EPISODES, drawn_episodes=1), competitors)


def competitor_units(asked: EvaluationRequest, two_sizes: bool) -> Units:
    """Seconds of a competitor's episodes and of what becomes of them, for one measurement of one episode.

    Args:
        asked: over ``EPISODES`` episodes; the first of them are run.
        two_sizes: measure also what a block of episodes takes, however many are in it.
    """
    own, held = asked.metrics, [0]

    def gather(run: Any) -> MetricInputs:
        """Look at how much is held of the episodes."""
        held.append(run.nbytes)
        return own.gather(run) if own is not None else MetricInputs()

    watched = OwnMetrics(gather, lambda *_: [])

    def first(count: int) -> tuple[Any, float]:
        return spent(lambda: summarise(asked._replace(last=count, metrics=watched), lambda _: None))

    T = asked.horizon
    count = min(block_of(T), MEASUREMENTS // T)
    first(WARM)
    part, seconds = first(count)
    scale = count * T
    found: Units = {"episodes": count, "work": seconds / scale, "held": held[-1] / scale}
    if two_sizes:
        few = first(count // 4)[1]
        found["block"] = max(0.0, seconds - (seconds - few) / (count - count // 4) * count) / T
    # What the process that began it does: one piece, and four of them.
    packed = pickle.dumps(part)
    # Each with arrays of its own, as they come from other processes: shared ones would be packed once.
    copies, read = spent(lambda: [pickle.loads(packed) for _ in range(4)])
    four, adding = spent(lambda: functools.reduce(Part.merge, copies))
    further = (len(pickle.dumps(four)) - len(packed)) / 3
    # Distributions are told of so many measurements and no more; costs and the like are kept of all episodes.
    samples = part.reduction.samples
    distributed = sum(
        len(pickle.dumps(v))
        for (_, *name), v in samples.items()
        if {*name} & {"error_exceeded", "action", "gain"}
    )
    resampling = _resampling(EPISODES)
    one, all_four = (spent(lambda whole=whole: whole.summary(resampling, None))[1] for whole in (part, four))
    slope = max(0.0, (all_four - one) / (3 * scale))
    found |= {
        "distributed": distributed / scale,
        "bytes": max(0.0, further - distributed) / count,
        "piece_bytes": max(0.0, len(packed) - further) / T,
        "read": (read / 4 + adding / 3) / len(packed),
        "finish": slope,
        "finish_once": max(0.0, one - slope * scale) / T,
    }
    return found


def told_seconds(id: str, episodes: int) -> float:
    """What the process that began it does for one more competitor of a cell of so many episodes."""
    [asked] = long_work(id, baselines_of(id).score_paper)
    few = replace(asked.experiment, episodes=8 * WARM)
    whole: Any = summarise(asked._replace(experiment=few, metrics=None), lambda _: None)
    costs = numpy.resize(whole.contender.costs, episodes)
    one = whole._replace(contender=whole.contender._replace(costs=costs), episodes=episodes)
    other = one._replace(contender=one.contender._replace(name="other"))
    other = other._replace(head=other.head.assign_coords(policy="other"))
    _resampling(episodes)  # once for all cells
    seconds = spent(lambda: combine_summaries([one, other]))[1] / 2
    with tempfile.TemporaryDirectory() as folder:
        return seconds + spent(lambda: Store(Path(folder)).write(Work("one", ""), one))[1]


def training_units(id: str, algorithm: str, folder: Path) -> Units:
    """Seconds of a training run: once, for each decision, and for each validation with what is saved then."""
    import torch
    from filtergym.agents.bptt import train_bptt
    from filtergym.agents.sb3_training import train_sb3

    torch.set_num_threads(1)
    folder.mkdir(parents=True)
    run = new_run(problem_of(id), RunOptions(algorithm))
    steps, values = run.steps, run.hyperparameters
    task = make_task(run.problem.task)
    per_update = run.envs * int(values.get("n_steps", task.horizon // task.decision_interval))
    if "learning_starts" in values:  # learning has begun when the clock starts
        begin = int(values["learning_starts"]) + 20 * run.envs
        run.steps = begin + 120 * run.envs
        interval = run.steps // 2
    else:
        # bptt tells of a whole update; the others of every step, the last before the update.
        begin = per_update + (algorithm not in THROUGH_THE_FILTER)
        run.steps = (2 if per_update * 20 > steps else 3) * per_update
        interval = run.steps - per_update  # validated twice: the first time may compile
    saving: list[float] = []
    stamp: list[tuple[int, float, float]] = []
    safe_point = Bookkeeping.safe_point

    def timed(books: Bookkeeping, *words: Any, **named: Any) -> bool:
        known = len(books.run.validation)
        stop, seconds = spent(lambda: safe_point(books, *words, **named))
        if len(books.run.validation) > known:
            saving.append(seconds)
        return stop

    def progress(done: int) -> None:
        if not stamp and done >= begin:
            stamp.append((done, time.process_time(), sum(saving)))

    train = train_bptt if algorithm in THROUGH_THE_FILTER else train_sb3
    began = time.process_time()
    with mock.patch.object(Bookkeeping, "safe_point", timed):
        train(run, Session(folder, validate_every=interval, progress=progress))
    ended = time.process_time()
    [(done, at, saved)] = stamp
    decision = (ended - at - (sum(saving) - saved)) / (run.steps_done - done)
    once = max(0.0, at - began - saved - decision * done)
    return {"steps": steps, "decision": decision, "validation": saving[-1], "once": once}


def tuning_seconds(id: str, name: str, kept: dict[str, Any]) -> float:
    """Seconds of tuning a policy again with the decisions of the values that are shipped."""
    tunable = baselines_of(id).tunable[name]
    scenario = kept["scenario"]
    seeds = episode_seeds("train", 0, CANDIDATE)
    # Each candidate has other values, and so may have to be compiled.
    middle = {value: 0.5 * (low + high) for value, (low, high) in tunable.limits.items()}
    episode_costs(Candidate(problem_of(id), scenario, tunable, tunable.start, seeds))
    seconds = spent(lambda: episode_costs(Candidate(problem_of(id), scenario, tunable, middle, seeds)))[1]
    task = make_task(catalogue()[id], scenario)
    candidates = kept["environment_steps"] / (CANDIDATE * (task.horizon // task.decision_interval))
    return (candidates + 8.0) * seconds


def tuned_before(id: str) -> dict[str, Any]:
    """Records of the tunings that are shipped."""
    [path] = [Path(folder) / "tuned.json" for folder in package_of(id).__path__]
    return json.loads(path.read_text(encoding="utf-8"))


def to_measure(folder: Path) -> Iterator[tuple[tuple[str, ...], Callable[[], Any]]]:
    """Every unit cost: the keys under which it is kept, and what measures it; agents are trained in a folder."""
    yield ("start",), start_seconds
    for id in catalogue():
        trained = {name: folder / short_name(id) / name for name in algorithms(id)}
        for name, place in trained.items():
            yield ("training", id, name), functools.partial(training_units, id, name, place)
        for name in (*classical(id), *trained):
            yield (
                ("competitors", id, name),
                functools.partial(
                    _competitor, id, name, trained.get(name), name == baselines_of(id).score_paper
                ),
            )
        for name, kept in tuned_before(id).items():
            yield ("tuning", id, name), functools.partial(tuning_seconds, id, name, kept)
        yield ("told", id), functools.partial(told_seconds, id, EPISODES)
    id = next(iter(catalogue()))  # is it linear?
    yield ("told of a quarter", id), functools.partial(told_seconds, id, EPISODES // 4)


def measured(path: Path) -> Units:
    """Unit costs: what a file holds, and what it lacks, which is measured and written there."""
    units: Units = json.loads(path.read_text()) if path.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        missing = [(keys, call) for keys, call in to_measure(Path(folder)) if not _there(units, keys)]
        for keys, call in track(missing, "measuring", console=Console(stderr=True)):
            place = units
            for key in keys[:-1]:
                place = place.setdefault(key, {})
            place[keys[-1]] = call()
            write_text(path, json.dumps(units, indent=1) + "\n")
    return units


def _there(units: Units, keys: Sequence[str]) -> bool:
    for key in keys:
        if key not in units:
            return False
        units = units[key]
    return True


def _competitor(id: str, name: str, trained: Path | None, two_sizes: bool) -> Units:
    """Unit costs of a competitor, or of the agent of a short run, which is trained if it is not there."""
    if trained is None:
        return competitor_units(*long_work(id, name), two_sizes)
    if not trained.exists():
        training_units(id, name, trained)
    # A name of its own: the agent that is shipped has that of the algorithm.
    named = {f"trained {name}": trained}
    return competitor_units(*long_work(id, named), two_sizes)


def classical(id: str) -> list[str]:
    """Competitors of the full benchmark without the agents that are shipped."""
    return [name for name in benchmark_policies(problem_of(id), True) if name not in pretrained_agents(id)]


# --- the plan


class Item(NamedTuple):
    """A piece of work."""

    kind: str
    environment: str
    name: str
    seconds: float
    after: int = -1
    """Item that must have ended; -1: none."""
    parent: float = 0.0
    """Seconds of the process that began the work, when the item has come back."""
    sent: float = 0.0
    """Bytes that come back."""


def makespan(items: Sequence[Item], cores: int, start: float) -> float:
    """When the process that began the work has taken in the last item, in seconds.

    Args:
        items: an item stands behind that which it comes after.
        cores: processes that do items, beside the one that takes them in; one process does both.
        start: seconds from the beginning until a process can do its first item.
    """
    if cores == 1:
        return start + sum(item.seconds + item.parent for item in items)
    later: dict[int, list[int]] = defaultdict(list)
    for i, item in enumerate(items):
        later[item.after].append(i)

    def rank(i: int) -> tuple[bool, float, int]:
        return items[i].kind == "evaluation", -items[i].seconds, i

    ready = [rank(i) for i in later[-1]]
    heapq.heapify(ready)
    running: list[tuple[float, int]] = []
    now = taken = start
    while ready or running:
        while ready and len(running) < cores:
            *_, i = heapq.heappop(ready)
            heapq.heappush(running, (now + items[i].seconds, i))
        now = running[0][0]
        while running and running[0][0] == now:
            *_, i = heapq.heappop(running)
            taken = max(taken, now) + items[i].parent
            for j in later[i]:
                heapq.heappush(ready, rank(j))
    return taken


def distributed(episodes: int, T: int) -> int:
    """Episodes whose distribution is told."""
    return min(episodes, max(block_of(T), DISTRIBUTION_LIMIT // T))


def sent_bytes(u: Units, pieces: int, episodes: int, T: int) -> float:
    """What comes back of a competitor."""
    return (
        pieces * T * u["piece_bytes"]
        + episodes * u["bytes"]
        + distributed(episodes, T) * T * u["distributed"]
    )


def finish_seconds(u: Units, episodes: int, T: int) -> float:
    """Of turning what all episodes come to into measures and curves."""
    return T * (u["finish_once"] + u["finish"] * distributed(episodes, T))


def run_seconds(u: Units) -> float:
    """Of a training run."""
    return u["once"] + u["steps"] * u["decision"] + VALIDATIONS * u["validation"]


def planned(units: Units, episodes: int, seeds: int, moved: int) -> Iterator[Item]:
    """Every item of the comparison.

    Args:
        units: of :func:`measured`.
        episodes: of a cell.
        seeds: training runs of an algorithm.
        moved: how many of ``MOVES`` have been made.
    """
    made: dict[tuple[str, str, int], int] = {}
    count = 0
    for id, trained in units["training"].items():
        for name, u in trained.items():
            seconds = run_seconds(u)
            for seed in range(seeds):
                made[id, name, seed] = count
                count += 1
                yield Item("training", id, name, seconds)
    for id, tuned in units["tuning"].items():
        for name, seconds in tuned.items():
            made[id, f"{name}-tuned", 0] = count
            count += 1
            yield Item("tuning", id, name, seconds)
    for cell in cells(True):
        id = cell.environment
        T = cell.measurements // (cell.episodes * len(cell.policies))
        [one] = evaluation_requests(
            cell.problem, cell.problem.experiment(cell.scenario, episodes), cell.policies[:1]
        )
        pieces = [piece.measurements // T for piece in one.pieces()]
        block = units["competitors"][id][baselines_of(id).score_paper]["block"]
        told = units["told"][id] * episodes / EPISODES
        for name, u in units["competitors"][id].items():
            slope = max(0.0, u["work"] - block / u["episodes"])
            finish, sent = finish_seconds(u, episodes, T), 0.0
            # Of a competitor: putting its pieces together, and telling of it beside the others of its cell.
            joining, done = 0.0, finish
            if len(pieces) > 1:
                sent = sent_bytes(u, len(pieces), episodes, T)
                joining, done = u["read"] * sent + finish, 0.0
            parent = (joining + told, told, 0.0)[moved]
            done += joining + told - parent
            for seed in range(seeds if name in units["training"][id] else 1):
                for part in pieces:
                    seconds = T * (slope * part + block * -(-part // block_of(T))) + done / len(pieces)
                    shared = parent / len(pieces), sent / len(pieces)
                    yield Item("evaluation", id, name, seconds, made.get((id, name, seed), -1), *shared)


# --- what is shown


def titled(title: str, *heads: str) -> Table:
    """A table whose first column is words and the others numbers."""
    table = Table(title=title)
    for i, head in enumerate(heads):
        table.add_column(head, justify="right" if i else "left")
    return table


def number(value: float) -> str:
    """Three digits."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def spread(values: Sequence[float]) -> str:
    """Median and largest."""
    return f"{number(float(numpy.median(values)))} ({number(max(values))})"


def shipped_seconds(id: str, algorithm: str) -> str:
    """What the training of the agent that is shipped took, on the machine where it was made."""
    path = PRETRAINED / short_name(id) / f"{algorithm}.json"
    run = json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
    return "" if run is None else number(run["seconds"]) + " (gated)" * bool(run.get("gated"))


def unit_tables(units: Units, episodes: int, seeds: int) -> Iterator[Table]:
    """What was measured, and what follows for memory."""
    table = titled(
        f"Evaluation, median (dearest) of the competitors: µs of a core for a measurement; s for {episodes:,} episodes",
        "environment", "competitors", "classical, µs", "learned, µs", "joining, s", "telling, s",
    )  # fmt: skip
    memory = titled(
        f"Memory of a process in the longest scenario, GiB; and what comes back of {episodes:,} episodes",
        "environment", "measurements", "a block of episodes", f"{episodes:,} at once", "comes back of a competitor",
    )  # fmt: skip
    training = titled(
        "Training runs", "environment", "algorithm", "decisions", "µs a decision", "a validation, s", "a run, s",
        "a shipped run took, s", f"{seeds} seeds, h",
    )  # fmt: skip
    for id, found in units["competitors"].items():
        learned = units["training"][id]
        T = max(c.measurements // (c.episodes * len(c.policies)) for c in cells(True, [id]))
        work = {name: 1e6 * u["work"] for name, u in found.items()}
        pieces = len(EvaluationRequest(problem_of(id).experiment(episodes=episodes), "", None).pieces())
        sent = {name: sent_bytes(u, pieces, episodes, T) for name, u in found.items()}
        joining = [u["read"] * sent[name] + finish_seconds(u, episodes, T) for name, u in found.items()]
        table.add_row(
            bare_name(id),
            f"{len(found) - len(learned)} + {seeds} x {len(learned)}",
            spread([value for name, value in work.items() if name not in learned]),
            spread([work[name] for name in learned]),
            spread(joining),
            number(units["told"][id] * episodes / EPISODES),
        )
        held = max(u["held"] for u in found.values()) * T / GIB
        sizes = spread([size / GIB for size in sent.values()])
        memory.add_row(bare_name(id), str(T), *(number(held * e) for e in (block_of(T), episodes)), sizes)
        for name, u in learned.items():
            seconds = run_seconds(u)
            training.add_row(
                bare_name(id),
                name,
                f"{u['steps']:,}",
                number(1e6 * u["decision"]),
                number(u["validation"]),
                number(seconds),
                shipped_seconds(id, name),
                number(seeds * seconds / 3600),
            )
    yield from (table, memory, training)


def plan_tables(units: Units, episodes: int, seeds: int, cores: Sequence[int]) -> Iterator[Table]:
    """Core hours, and how long it takes."""
    hours = titled("Core hours", "environment", "tuning", "training", "evaluation", "joining and telling")
    items = list(planned(units, episodes, seeds, 0))
    for id in [*catalogue(), ""]:
        own = [item for item in items if id in ("", item.environment)]
        kinds = [sum(i.seconds for i in own if i.kind == k) for k in ("tuning", "training", "evaluation")]
        hours.add_row(
            bare_name(id) or "all", *(number(s / 3600) for s in (*kinds, sum(item.parent for item in own)))
        )
    yield hours
    table = titled(
        f"{episodes:,} episodes a cell, {seeds} seeds",
        "", "cores", "hours", "times one core", "work over cores, h", "longest chain, h", "first process, h", "most is",
    )  # fmt: skip
    start = sum(units["start"].values())
    for moved, name in enumerate(MOVES):
        items = list(planned(units, episodes, seeds, moved))
        work = sum(item.seconds for item in items)
        chain = max(i.seconds + (items[i.after].seconds if i.after >= 0 else 0.0) for i in items)
        parent = sum(item.parent for item in items)
        one = makespan(items, 1, start)
        for n in cores:
            taken = makespan(items, n, start)
            bounds = {
                "work": work / n,
                "one chain": start + chain,
                "the first process": parent,
                "start": start,
            }
            table.add_row(
                name,
                f"{n:,}",
                number(taken / 3600),
                number(one / taken),
                number(work / n / 3600),
                number(chain / 3600),
                number(parent / 3600),
                "work" if n == 1 else max(bounds, key=lambda bound: bounds[bound]),
            )
            name = ""
    yield table


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--units", type=Path, default=Path("units.json"), help="file of what was measured")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="of a cell")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="training runs of an algorithm")
    parser.add_argument("--cores", type=int, nargs="+", default=CORES)
    parser.add_argument("--markdown", action="store_true", help="print the tables for a page")
    asked = parser.parse_args()
    if min(asked.episodes, asked.seeds, *asked.cores) < 1:
        parser.error("--episodes, --seeds and --cores must be at least 1")
    warnings.simplefilter("ignore")  # of means over few episodes
    units = measured(asked.units)
    console = Console(width=160)
    start = units["start"]
    for table in (
        *unit_tables(units, asked.episodes, asked.seeds),
        *plan_tables(units, asked.episodes, asked.seeds, asked.cores),
    ):
        if asked.markdown:
            title, table.title, table.box = table.title, None, MARKDOWN
            with console.capture() as shown:
                console.print(table)
            lines = [line.rstrip() for line in shown.get().splitlines()]
            print(f"**{title}**", "", *(line for line in lines if line), "", sep="\n")
        else:
            console.print(table)
    items = list(planned(units, asked.episodes, asked.seeds, 0))
    dear = max(items, key=lambda item: item.seconds)
    long = max((item for item in items if item.kind == "training"), key=lambda item: item.seconds)
    print(
        f"{len(items):,} items of work. The longest, as it is: {dear.kind} of {dear.name} in "
        f"{bare_name(dear.environment)}, {dear.seconds / 3600:.2f} h; of training {long.name} in "
        f"{bare_name(long.environment)}, {long.seconds:.0f} s."
    )
    print(
        f"A process begins with {start['imports']:.1f} s of imports and {start['resampling']:.1f} s of resampling "
        f"{EPISODES:,} episodes, {(1 + RESAMPLES) * asked.episodes / GIB:.2g} GiB in each."
    )
    for id, quarter in units["told of a quarter"].items():
        print(
            f"Telling of a competitor of {bare_name(id)} takes {units['told'][id] / quarter:.2f} times what it takes "
            "of a quarter of the episodes."
        )


if __name__ == "__main__":
    main()
