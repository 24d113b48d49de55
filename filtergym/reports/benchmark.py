"""The main job: every environment with its policies.

Quick: the telling policies in the paper's scenario and the training distribution. Full: everything there is to
compare, in all scenarios, tuned and learned policies among them.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..agents.named_policies import shipped_agents
from ..baselines.catalogue import baselines_of
from ..baselines.tuning import tuned_names
from ..envs.catalogue import catalogue, short_name, task_class
from ..evaluation.curves import curves_of
from ..evaluation.figures import evaluation_figures, save
from ..evaluation.files import writable_file, writable_folder
from ..evaluation.metrics import Record
from ..names import evaluate, tidy_records
from .records import read_records, write_records

MEASUREMENTS = 60_000
"""Measurements per policy and cell of the quick benchmark: 500 episodes of 100 scans, and some more."""
FULL_SECONDS = 5.0
"""Time per policy and cell that the full benchmark, of ten times as many measurements, does not go beyond."""


class Cell(NamedTuple):
    """One environment in one scenario."""

    environment: str
    scenario: str
    episodes: int
    policies: tuple[str, ...]

    @property
    def name(self) -> str:
        """Start of the names of the cell's files."""
        return f"{short_name(self.environment)}.{self.scenario}"

    @property
    def measurements(self) -> int:
        """Measurements of all policies together."""
        return self.episodes * _horizon(self.environment, self.scenario) * len(self.policies)


def _horizon(id: str, scenario: str) -> int:
    cls: Any = task_class(id)
    return cls.Parameters(**cls.scenarios[scenario].parameters).horizon


def benchmark_policies(id: str, full: bool) -> tuple[str, ...]:
    """Names that a cell compares.

    Full: paper, every other policy and estimator as it is, those that were tuned, shipped agents, references, bounds.
    """
    known = baselines_of(id)
    if not full:
        return known.benchmark or known.names
    tuned = tuned_names(id)
    everything = (known.score_paper, *known.policies, *known.estimators, *tuned, *shipped_agents(id))
    names = dict.fromkeys((*everything, *known.references, *known.bounds))
    return tuple(name for name in names if name)


def cells(full: bool, environments: Sequence[str] = (), split: str = "test") -> list[Cell]:
    """List the work: quick, the paper's and the default scenario; full, all of them and more episodes.

    Held-out scenarios are for final tables: on another split than "test" only training scenarios run.
    """
    wanted = []
    for id in environments or catalogue():
        cls = task_class(id)
        for name, scenario in cls.scenarios.items():
            if not (full or name.startswith("paper") or name == cls.default_scenario):
                continue
            if split != "test" and not scenario.training:
                continue
            horizon = _horizon(id, name)
            measurements = MEASUREMENTS
            if full:
                affordable = int(FULL_SECONDS / baselines_of(id).measurement_seconds)
                measurements = min(10 * MEASUREMENTS, affordable)
            episodes = max(20, min(5000 if full else 500, measurements // horizon))
            wanted.append(Cell(cls.id, name, episodes, benchmark_policies(id, full)))
    return wanted


def run_cell(
    cell: Cell,
    seed: int,
    split: str,
    folder: Path,
    progress: Callable[[int], None],
    backend: str = "auto",
    threads: int = 1,
) -> list[Record]:
    """Evaluate one cell, save its figures, and return its records."""
    known = baselines_of(cell.environment)
    dataset = evaluate(
        cell.environment,
        cell.policies,
        cell.scenario,
        cell.episodes,
        seed,
        split,
        progress=progress,
        backend=backend,
        threads=threads,
    )
    # Not all of the full benchmark's policies: nobody can tell twenty lines apart.
    clear = {*(known.benchmark or known.names), *shipped_agents(cell.environment)}
    shown = [name for name in cell.policies if name in clear]
    for name, figure in evaluation_figures(curves_of(dataset.sel(policy=shown))):
        save(figure, folder / f"{cell.name}.{name}.png")
    return tidy_records(dataset)


def run_benchmark(
    folder: Path,
    full: bool,
    seed: int,
    environments: Sequence[str] = (),
    split: str = "test",
    started: Callable[[Cell, int], Callable[[int], None]] = lambda cell, total: lambda done: None,
    finished: Callable[[list[Record]], None] = lambda records: None,
    backend: str = "auto",
    threads: int = 1,
) -> list[Record]:
    """Run every cell, resuming at the first missing one after an interruption.

    Args:
        folder: where ``benchmark.json`` and the figures go; cells wait in ``unfinished/`` until all are done.
        full: all scenarios and policies, and more episodes.
        seed: number of the experiment.
        environments: ids; default: all.
        split: "test", or another one for development.
        started: called with a cell and its number of measurements; returns what is told of progress.
        finished: called with the records of each cell.
        backend: what computes the steps, see :func:`~.envs.backend.task_on`.
        threads: how many share the episodes, of the compiled backend.

    Returns:
        All records.
    """
    wanted = cells(full, environments, split)
    unfinished = writable_folder(folder / "unfinished")
    waiting = [unfinished / f"{cell.name}.{cell.episodes}.{split}{seed}.json" for cell in wanted]
    writable_file(folder / "benchmark.json")
    records: list[Record] = []
    for cell, path in zip(wanted, waiting, strict=True):
        tick = started(cell, cell.measurements)
        done = read_records(path) if path.exists() else []
        if {record.policy for record in done} == set(cell.policies):
            tick(cell.measurements)
        else:
            done = run_cell(cell, seed, split, folder, tick, backend, threads)
            write_records(path, done)
        finished(done)
        records += done
    write_records(folder / "benchmark.json", records)
    # Only its own files: the folder may hold what somebody else put there, or a benchmark with another seed.
    for path in waiting:
        path.unlink(missing_ok=True)
    if not any(unfinished.iterdir()):
        unfinished.rmdir()
    return records
