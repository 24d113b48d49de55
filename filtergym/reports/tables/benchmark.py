"""The benchmark: every environment with its competitors.

Quick: the most informative competitors in the training distribution. Full: all competitors, in all scenarios.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ...baselines.problem import Problem, problem_of
from ...envs.engine.catalogue import catalogue
from ...envs.engine.scenario_choice import make_task
from ...evaluation.running.metrics import Record
from ...evaluation.running.parallel import Workers, check_workers
from ...evaluation.running.rollout import Progress
from ...evaluation.running.seeds import episode_seeds
from ...evaluation.running.summary import Evaluation, EvaluationRequest, Summary, combine_summaries, summaries
from ...evaluation.statistics.cause_split import CAUSE_METRICS, phrases_of
from ...evaluation.storage.dataset import groups_of, notes_of
from ...evaluation.storage.files import claim_folder, writable_file
from ...evaluation.storage.store import UNFINISHED, Store
from ...functions import requests_of
from ...names import find_competitors, learned_names, ranked_names
from .ranking import best_of_origins
from .results import (
    RESULTS,
    Result,
    WorstTrack,
    components_to_draw,
    select_competitors,
    settings_of,
    thin_curves,
    track_of,
    write_results,
)
from .terminal_tables import HEADLINE

MEASUREMENTS = 60_000
"""Measurements per policy and cell of the quick benchmark: 500 episodes of 100 scans, and some more."""
FULL_SECONDS = 5.0
"""Longest time per policy and cell of the full benchmark, of ten times as many measurements."""
FEWEST_EPISODES, FEWEST_EPISODES_FULL = 10, 20
"""Least number of episodes, since fewer make intervals too wide; with long episodes the quick benchmark
runs no more.
"""
MOST_EPISODES = 20_000
"""Largest number of episodes that are run to narrow an interval."""
LONG = 2000
"""Measurements of an episode beyond which the quick benchmark leaves out tuned competitors: few episodes side by side
cost as much as many.
"""


class Cell(NamedTuple):
    """A cell of a benchmark: one environment in one scenario, with competitors and number of episodes."""

    problem: Problem
    scenario: str
    episodes: int
    policies: tuple[str, ...]

    @property
    def environment(self) -> str:
        """Gymnasium id."""
        return self.problem.id

    @property
    def name(self) -> str:
        """Beginning of the cell's file names."""
        return f"{self.problem.short_name}.{self.scenario}"

    @property
    def measurements(self) -> int:
        """Number of measurements that all competitors of the cell process together."""
        return self.episodes * _horizon(self.problem.task, self.scenario) * len(self.policies)


def _horizon(cls: Any, scenario: str) -> int:
    return cls.Parameters(**cls.scenarios[scenario].parameters).horizon


def benchmark_policies(problem: Problem, full: bool, horizon: int = 0) -> tuple[str, ...]:
    """Return the names of the competitors of a benchmark in one environment, the paper's algorithm first.

    Quick: the most informative ones, tuned where tuning lowers the cost and episodes are not long, and shipped agents.
    Full: every policy and estimator, untuned and tuned, shipped agents, smoothers, references, bounds.
    """
    known = problem.baselines
    if full:
        everything = (*ranked_names(problem), *known.smoothers, *known.references, *known.bounds)
    else:
        tuned = problem.tuned_policies if horizon <= LONG else []
        won = [name for name in tuned if problem.tuned_values.is_improved(name.removesuffix("-tuned"))]
        telling = known.benchmark or known.names
        own = (f"{name}-tuned" if f"{name}-tuned" in won else name for name in telling)
        everything = (*own, *won, *learned_names(problem.id))
    return tuple(name for name in dict.fromkeys((known.score_paper, *everything)) if name)


def affordable_episodes(problem: Problem, scenario: str, most: int) -> int:
    """Return the number of episodes, at most ``most``, that a competitor runs in some ten seconds."""
    seconds = problem.baselines.measurement_seconds * _horizon(problem.task, scenario)
    return min(most, max(FEWEST_EPISODES_FULL, int(2.0 * FULL_SECONDS / seconds)))


def drop_smoothers_of_closed_loops(problem: Problem, names: Sequence[str], scenario: Any) -> tuple[str, ...]:
    """Return names of competitors, without smoothers if the scenario is a closed loop."""
    smoothers = {*names} & {*problem.baselines.smoothers}
    if not smoothers or not make_task(problem.task, scenario).closes_loop:
        return tuple(names)
    return tuple(name for name in names if name not in smoothers)


def cells(full: bool, environments: Sequence[str] = (), split: str = "test") -> list[Cell]:
    """Return the cells of a benchmark, environments times scenarios; quick: default scenarios alone.

    On another split than "test" only training scenarios run.
    """
    wanted = []
    for id in environments or catalogue():
        problem = problem_of(id)
        cls = problem.task
        for name, scenario in cls.scenarios.items():
            if not full and name != cls.default_scenario:
                continue
            if split != "test" and not scenario.training:
                continue
            horizon = _horizon(cls, name)
            measurements, fewest = MEASUREMENTS, FEWEST_EPISODES
            if full:
                affordable = int(FULL_SECONDS / problem.baselines.measurement_seconds)
                measurements, fewest = min(10 * MEASUREMENTS, affordable), FEWEST_EPISODES_FULL
            episodes = max(fewest, min(5000 if full else 500, measurements // horizon))
            names = drop_smoothers_of_closed_loops(problem, benchmark_policies(problem, full, horizon), name)
            wanted.append(Cell(problem, name, episodes, names))
    return wanted


def result_of(
    problem: Problem,
    evaluation: Evaluation,
    learned: Sequence[str],
    worst: Mapping[str, Sequence[WorstTrack]] | None = None,
    user_names: Sequence[str] = (),
) -> Result:
    """Return an evaluation as a :class:`Result`, the content of a file of results.

    The evaluation has curves, and the variables of ``drawn_episodes``. By default the cost of the paper's
    algorithm is explained, without worst episodes.
    """
    dataset, records, curves = evaluation.dataset, evaluation.records, evaluation.curves
    assert curves is not None
    cls, scenario, knows = problem.task, dataset.attrs["scenario"], problem.knows
    paper, reference = dataset.attrs["paper"], dataset.attrs["reference"]
    names = dataset["policy"].values.tolist()
    worst = worst or {name: [] for name in [paper] if name in names}
    shown = list(dict.fromkeys([*select_competitors(records, paper, reference, learned, user_names), *worst]))
    components, plane = components_to_draw(groups_of(dataset), dataset["component"].values.tolist())
    named = cls.scenarios.get(scenario)
    return Result(
        problem.id,
        scenario,
        named.description if named else "",
        scenario == cls.default_scenario,
        bool(named and named.training),
        paper if paper in names else "",
        reference if reference in names else "",
        [name for name in names if name in learned],
        {name: knows[name] for name in names if name in knows},
        notes_of(dataset),
        [r for r in records if r.policy in shown or not r.metric.startswith(CAUSE_METRICS)],
        thin_curves(curves.sel(policy=shown)),
        track_of(dataset.sel(policy=shown), components, plane),
        phrases_of(dataset),
        list(worst),
        [one for episodes in worst.values() for one in episodes],
        list(user_names),
    )


class BenchmarkOptions(NamedTuple):
    """Options of a benchmark: scenarios, competitors, episodes and execution."""

    full: bool = False
    """All scenarios and policies, and more episodes."""
    seed: int = 0
    """Number of the experiment."""
    environments: Sequence[str] = ()
    """Gymnasium ids; empty: all environments."""
    split: str = "test"
    """Split of the episodes; another one than test is for development."""
    backend: str = "auto"
    """Implementation of the steps, see :func:`~.envs.backend.task_on`."""
    threads: int = 1
    """Threads of the compiled backend that share the episodes."""
    command: str = "filtergym benchmark"
    """Command of the benchmark, stored in the results."""
    half_width: float = 0.0
    """Largest distance of the headline's interval ends, percentage points, which more episodes of the training
    distribution attain; zero: as many episodes as in other scenarios.
    """
    timed: bool = True
    """Whether to measure the processor time of every competitor, which differs from run to run."""

    def requests(self, cell: Cell) -> list[EvaluationRequest]:
        """Return the evaluation requests of a cell, one for each competitor."""
        experiment = cell.problem.experiment(
            cell.scenario,
            cell.episodes,
            self.seed,
            self.split,
            drawn_episodes=1,
            backend=self.backend,
            threads=self.threads,
            timed=self.timed,
        )
        return requests_of(cell.problem, experiment, find_competitors(cell.problem, cell.policies))


class Callbacks(NamedTuple):
    """Functions that are called while a benchmark runs."""

    started: Callable[[int], Progress] = lambda total: lambda done: None
    """Called with the number of measurements; returns the function that receives the progress."""
    finished: Callable[[Result], None] = lambda result: None
    """Called with the result of each cell, in their order."""
    drawn: Callable[[Cell, Evaluation], None] = lambda cell, evaluation: None
    """Called with each cell and its evaluation."""


class _Results:
    """Results of a benchmark's cells, each made when the last competitor of the cell has finished."""

    def __init__(self, wanted: Sequence[Cell], callbacks: Callbacks) -> None:
        self.wanted, self.callbacks = wanted, callbacks
        self._summaries: list[dict[str, Summary]] = [{} for _ in wanted]
        self._results: list[Result | None] = [None] * len(wanted)
        self._reported = 0

    def add(self, i: int, name: str, summary: Summary) -> None:
        """Add a competitor's summary to cell ``i``; pass results of finished cells to the callbacks, in order."""
        cell, found = self.wanted[i], self._summaries[i]
        found[name] = summary
        if len(found) == len(cell.policies):
            evaluation = combine_summaries([found.pop(name) for name in cell.policies])
            self.callbacks.drawn(cell, evaluation)
            self._results[i] = result_of(cell.problem, evaluation, learned_names(cell.environment))
        while self._reported < len(self._results) and (due := self._results[self._reported]) is not None:
            self.callbacks.finished(due)
            self._reported += 1

    def all(self) -> list[Result]:
        return [result for result in self._results if result is not None]


def run_benchmark(
    folder: Path,
    options: BenchmarkOptions,
    callbacks: Callbacks | None = None,
    workers: Workers | None = None,
) -> list[Result]:
    """Run a benchmark, write ``results.json``, and return the results; resume after an interruption.

    Finished competitors are in ``unfinished/`` of the folder until all are done.
    """
    episode_seeds(options.split, options.seed, 1)  # refuses a split that is none before anything is written
    wanted = cells(options.full, options.environments, options.split)
    settings = settings_of(options.command)
    store = Store(folder / UNFINISHED)
    writable_file(folder / RESULTS)
    callbacks = callbacks or Callbacks()
    workers = check_workers(workers)
    claim_folder(folder)  # nothing is refused from here on
    if options.half_width > 0.0:
        wanted = [
            _enlarge(cell, options, workers, store, callbacks.started)
            if cell.scenario == cell.problem.task.default_scenario
            else cell
            for cell in wanted
        ]
    results = _run_cells(wanted, options, callbacks, workers, store)
    write_results(folder / RESULTS, results, settings)
    store.clear()
    return results


def _run_cells(
    wanted: Sequence[Cell], options: BenchmarkOptions, callbacks: Callbacks, workers: Workers, store: Store
) -> list[Result]:
    tick = callbacks.started(sum(cell.measurements for cell in wanted))
    # The requests, and the cell of each.
    asked = [(one, i) for i, cell in enumerate(wanted) for one in options.requests(cell)]
    if not workers.alone:  # the slow ones first, so that no process waits for them at the end
        asked.sort(
            key=lambda one: -one[0].measurements * wanted[one[1]].problem.baselines.measurement_seconds
        )
    results = _Results(wanted, callbacks)
    for k, summary in summaries([one for one, _ in asked], workers, tick, store):
        one, i = asked[k]
        results.add(i, one.name, summary)
    return results.all()


def _enlarge(
    cell: Cell, options: BenchmarkOptions, workers: Workers, store: Store, started: Callable[[int], Progress]
) -> Cell:
    """Return a cell with as many episodes as the headline's intervals need, ``MOST_EPISODES`` at most.

    An interval's width falls with the root of the number of episodes; stopping at a width keeps its coverage (Y. S.
    Chow and H. Robbins, On the asymptotic theory of fixed-width sequential confidence intervals, Annals of
    Mathematical Statistics 36, 1965).
    """
    cell = cell._replace(episodes=max(cell.episodes, cell.problem.baselines.headline_episodes))
    while cell.episodes < MOST_EPISODES:
        [result] = _run_cells([cell], options, Callbacks(started), workers, store)
        found = 100.0 * headline_half_width(result)
        if found <= options.half_width:
            break
        needed = math.ceil(1.1 * cell.episodes * (found / options.half_width) ** 2)
        cell = cell._replace(episodes=min(needed, MOST_EPISODES))
    return cell


def headline_half_width(result: Result) -> float:
    """Return half the widest interval among the best of every origin, as a share of the paper's cost."""
    shown = {name for _, name in best_of_origins(result)}
    return max(
        (
            0.5 * (r.high - r.low)
            for r in result.records
            if (r.metric, r.window) == (HEADLINE, "all") and r.policy in shown
            if r.high is not None and r.low is not None
        ),
        default=0.0,
    )


def all_records(results: Sequence[Result]) -> list[Record]:
    """Return the records of all results in one list."""
    return [record for result in results for record in result.records]
