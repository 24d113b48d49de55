"""The main job: every environment, its policies, the paper's scenario and the training distribution."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .baselines.evaluation import baselines_of, evaluate
from .baselines.figures import evaluation_figures, save
from .baselines.metrics import Record, tidy_records
from .envs.catalogue import catalogue, task_class
from .results import writable_folder, write_records

MEASUREMENTS = 60_000
"""Measurements per policy and cell of the quick benchmark: 500 episodes of 100 scans, and some more."""


class Cell(NamedTuple):
    """One environment in one scenario."""

    environment: str
    scenario: str
    episodes: int

    @property
    def name(self) -> str:
        """File name without suffix."""
        short = self.environment.removeprefix("filtergym/")
        return f"{short}.{self.scenario}.{self.episodes}"


def cells(full: bool, environments: Sequence[str] = ()) -> list[Cell]:
    """List the work: quick, the paper's and the default scenario; full, all of them and ten times as long."""
    wanted = []
    for id in environments or catalogue():
        cls = task_class(id)
        names = (
            list(cls.scenarios)
            if full
            else [s for s in cls.scenarios if s.startswith("paper") or s == cls.default_scenario]
        )
        for name in names:
            horizon = cls.Parameters(**cls.scenarios[name].parameters).horizon
            episodes = max(20, min(500, MEASUREMENTS // horizon)) * (10 if full else 1)
            wanted.append(Cell(cls.id, name, episodes))
    return wanted


def run_cell(cell: Cell, seed: int, folder: Path, progress: Callable[[int], None]) -> list[Record]:
    """Evaluate one cell, save its figures, and return its records."""
    known = baselines_of(cell.environment)
    dataset = evaluate(
        cell.environment,
        known.benchmark or known.names,
        cell.scenario,
        cell.episodes,
        seed,
        progress=progress,
    )
    for name, figure in evaluation_figures(dataset):
        save(figure, folder / f"{cell.name.rsplit('.', 1)[0]}.{name}.png")
    return tidy_records(dataset)


def run_benchmark(
    folder: Path,
    full: bool,
    seed: int,
    environments: Sequence[str] = (),
    started: Callable[[Cell, int], Callable[[int], None]] = lambda cell, total: lambda done: None,
    finished: Callable[[list[Record]], None] = lambda records: None,
) -> list[Record]:
    """Run every cell, resuming at the first missing one after an interruption.

    Args:
        folder: where ``benchmark.json`` and the figures go; cells wait in ``unfinished/`` until all are done.
        full: all scenarios and ten times as many episodes.
        seed: number of the experiment.
        environments: ids; default: all.
        started: called with a cell and its number of measurements; returns what is told of progress.
        finished: called with the records of each cell.

    Returns:
        All records.
    """
    wanted = cells(full, environments)
    unfinished = writable_folder(folder / "unfinished")
    records: list[Record] = []
    for cell in wanted:
        path = unfinished / f"{cell.name}.seed{seed}.json"
        names = baselines_of(cell.environment)
        horizon_total = _measurements(cell) * len(names.benchmark or names.names)
        tick = started(cell, horizon_total)
        if path.exists():
            done = [Record(**values) for values in json.loads(path.read_text(encoding="utf-8"))]
            tick(horizon_total)
        else:
            done = run_cell(cell, seed, folder, tick)
            write_records(path, done)
        finished(done)
        records += done
    write_records(folder / "benchmark.json", records)
    for path in unfinished.iterdir():
        path.unlink()
    unfinished.rmdir()
    return records


def _measurements(cell: Cell) -> int:
    cls: Any = task_class(cell.environment)
    return cls.Parameters(**cls.scenarios[cell.scenario].parameters).horizon * cell.episodes
