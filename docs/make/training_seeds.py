"""Training seeds: every run of an algorithm against the papers' algorithms, on the same episodes.

One agent says little about its algorithm. Here the runs of several training seeds meet the same episodes, so
that what comes from the training seed and what comes from the episodes can be told apart.
"""

import hashlib
import html
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy
from filtergym.agents.training_run import TrainingRun, best_agent, load_run
from filtergym.baselines.problem import Problem
from filtergym.envs.catalogue import make_task
from filtergym.evaluation.bootstrap import CONFIDENCE, Bootstrap, Estimate
from filtergym.evaluation.competitors import kind_of
from filtergym.evaluation.dataset import groups_of, windows_of
from filtergym.evaluation.evaluate import check_sendable, run_experiment
from filtergym.evaluation.files import whole_file
from filtergym.evaluation.metrics import reported_components, score, squared_errors
from filtergym.evaluation.parallel import Workers, check_workers
from filtergym.evaluation.summary import Asked
from filtergym.papers.grid import Grid, markdown_table
from pictures import draw_learning_curves
from scipy.special import stdtrit

from filtergym.names import find_competitor
from filtergym.reports.tables import shown_components, with_interval
from filtergym.reports.waiting import made_by


class Comparison(NamedTuple):
    """One number of a run, of an algorithm's runs together, or of an opponent."""

    environment: str
    scenario: str
    split: str
    seed: int
    """Number of the experiment, from which the episodes come."""
    episodes: int
    policy: str
    """Run ("ppo seed 0"), algorithm ("ppo"), or an opponent's name."""
    statistic: str
    """"run", "opponent", or over an algorithm's runs "median", "mean", "between seeds", "over episodes"."""
    against: str
    metric: str
    component: str
    value: float | None
    low: float | None
    high: float | None
    unit: str


class SeedRun(NamedTuple):
    """One training run among those of its algorithm."""

    algorithm: str
    """With its control, where runs of one algorithm have several."""
    run: TrainingRun
    agent: Path
    """File of the best agent."""

    @property
    def name(self) -> str:
        """Name among the policies, which no opponent has."""
        return f"{self.algorithm} seed {self.run.seed}"


class EpisodeMeans(NamedTuple):
    """Means over every episode of one scenario, from which all statistics follow."""

    cost: dict[str, numpy.ndarray]
    """Policy -> ``(episodes,)``."""
    squares: dict[str, dict[str, numpy.ndarray]]
    """Component -> policy -> squared error, ``(episodes,)``."""
    units: dict[str, str]


class Spread(NamedTuple):
    """Mean over seeds and episodes, and what it varies with."""

    mean: Estimate
    between_seeds: float
    """Standard deviation between training seeds, without what the episodes' noise adds to it."""
    over_episodes: float
    """Standard error of the mean of just these runs, over episodes."""


def spread(values: numpy.ndarray) -> Spread:
    """Tell the variance of training seeds and of episodes apart (two-way random effects, one value a cell).

    The moment estimates are those of the analysis of variance. The interval of the mean covers new seeds
    and new episodes: Student's t with Satterthwaite's degrees of freedom. With five seeds a bootstrap over
    them would promise too much.

    Args:
        values: ``(seeds, episodes)``.
    """
    seeds, episodes = values.shape
    by_seed, by_episode, mean = values.mean(axis=1), values.mean(axis=0), values.mean()
    of_episodes = seeds * by_episode.var(ddof=1)
    of_seeds = of_rest = between = 0.0
    if seeds > 1:
        rest = values - by_seed[:, None] - by_episode + mean
        of_rest = (rest**2).sum() / ((seeds - 1) * (episodes - 1))
        of_seeds = episodes * by_seed.var(ddof=1)
        between = max(0.0, of_seeds - of_rest)
    total = of_episodes + between
    uncertainty = of_episodes**2 / (episodes - 1)
    if seeds > 1:
        uncertainty += of_seeds**2 / (seeds - 1) + of_rest**2 / ((seeds - 1) * (episodes - 1))
    quantile = stdtrit(total**2 / uncertainty, 0.5 + 0.5 * CONFIDENCE) if uncertainty > 0.0 else 0.0
    half = quantile * numpy.sqrt(total / (seeds * episodes))
    return Spread(
        Estimate(float(mean), float(mean - half), float(mean + half)),
        float(numpy.sqrt(between / episodes)) if seeds > 1 else float("nan"),
        float(numpy.sqrt(of_episodes / (seeds * episodes))),
    )


def load_runs(folders: Sequence[Path], trust: bool = False) -> list[SeedRun]:
    """Read training runs of one environment, sorted by algorithm and seed.

    Args:
        folders: of the runs.
        trust: import the modules that their records name; see :func:`.load_run`.

    Raises:
        ValueError: if they are of different environments, or runs of one algorithm differ in more than the
            seed.
    """
    runs = {folder: load_run(folder, trust) for folder in folders}
    first = next(iter(runs.values()))
    seen: dict[str, TrainingRun] = {}
    found: dict[str, SeedRun] = {}
    for folder, run in runs.items():
        if run.environment != first.environment:
            raise ValueError(
                f"runs of one environment are compared: {folder} is of {run.environment}, "
                f"others are of {first.environment}"
            )
        controls = {other.control for other in runs.values() if _algorithm(other) == _algorithm(run)}
        label = _algorithm(run) if len(controls) == 1 else f"{_algorithm(run)} {run.control}"
        other = seen.setdefault(label, run)
        for field in ("scenario", "envs", "hyperparameters"):
            if getattr(run, field) != getattr(other, field):
                raise ValueError(
                    f"runs of {label} may differ in the seed only: {folder} has {field} "
                    f"{getattr(run, field)!r}, others {getattr(other, field)!r}"
                )
        member = SeedRun(label, run, best_agent(folder))
        if member.name in found:
            raise ValueError(f"{folder} is a second run of {member.name}")
        found[member.name] = member
    return sorted(found.values(), key=lambda member: (member.algorithm, member.run.seed))


def _algorithm(run: TrainingRun) -> str:
    """Name of a run's algorithm, with what is around the agent."""
    around = f" on {run.residual_to}" if run.residual_to else ""
    return run.algorithm + around + (" gated" if run.gated else "")


def learning_curves(runs: Sequence[SeedRun], columns: int = 2) -> Any:
    """Picture of every run's validations, 1 or 2 columns of a paper wide; a dot marks its best agent."""
    first = runs[0].run
    paper = first.problem.paper
    for member in runs:
        entries = member.run.validation
        if not entries or not all(entry.get("relative_cost_difference") for entry in entries):
            raise ValueError(f"the record of {member.name} has no validations against {paper!r} to draw")
    curves: dict[str, list[tuple[list[float], list[float]]]] = {}
    for member in runs:
        steps = [float(entry["steps"]) for entry in member.run.validation]
        values = [entry["relative_cost_difference"][0] for entry in member.run.validation]
        curves.setdefault(member.algorithm, []).append((steps, values))
    title = f"{first.environment}, scenario {first.scenario}; dots: best agents"
    return draw_learning_curves(curves, title, paper, columns=columns)


def default_opponents(problem: Problem) -> list[str]:
    """Names that runs are compared with: paper, strong policies, untuned and tuned, references."""
    known = problem.baselines
    untuned = [name for name in known.tunable if name != known.best_constant]
    names = [problem.paper, *known.compared, *untuned, *problem.tuned, *known.references]
    return list(dict.fromkeys(names))


def episode_means(
    runs: Sequence[SeedRun],
    opponents: Sequence[str],
    scenario: str | None,
    episodes: int,
    seed: int,
    split: str,
    progress: Callable[[int], None] = lambda done: None,
    trust: bool = False,
    waiting: Path | None = None,
    workers: Workers | None = None,
) -> EpisodeMeans:
    """Evaluate runs and opponents on the same episodes, each by itself to save memory.

    With ``trust``, models that can execute code are loaded. In the folder ``waiting`` the means of each are kept as
    soon as they are there, and those that are kept there are taken from it. ``workers`` share them.

    Raises:
        ValueError: for unknown names, and for bounds, which have no cost.
    """
    problem = runs[0].run.problem
    policies: dict[str, tuple[Any, str | None]] = {}
    for member in runs:
        maker = find_competitor(problem, str(member.agent), trust)
        # A learned estimator has a filter of its own, and steers nothing.
        policies[member.name] = maker, member.run.control if kind_of(maker) == "policy" else None
    for name in dict.fromkeys([problem.paper, *opponents]):
        policies[name] = find_competitor(problem, name, trust), None
        if kind_of(policies[name][0]) == "bound":
            raise ValueError(f"{name!r} is a bound, which has no cost: name policies and references")
    agents = {member.name: member.agent for member in runs}
    found: dict[str, Means | None] = {}
    missing: list[tuple[str, Path | None]] = []
    work: list[Asked] = []
    horizon = make_task(problem.id, None, scenario).horizon
    for name, (maker, control) in policies.items():
        code = made_by(problem, problem.paper if name in agents else name)
        key = json.dumps([code, problem.name, scenario, episodes, seed, split, name])
        kept = None if waiting is None or code is None else _kept_file(waiting, key, agents.get(name))
        found[name] = None if kept is None else _read_means(kept)
        if found[name] is None:
            missing.append((name, kept))
            # An agent's name may be that of a competitor.
            known_as = "agent" if name in agents else name
            experiment = problem.experiment(scenario, episodes, seed, split, control)
            work.append(Asked(experiment, known_as, maker, horizon=horizon))
    workers = check_workers(workers)
    if not workers.alone:
        for asked in work:
            check_sendable(asked.experiment.environment, {asked.name: asked.maker})
    for i, measured in workers.run(_means_of, work, [asked.measurements for asked in work], progress):
        name, kept = missing[i]
        if kept is not None:
            _write_means(kept, *measured)
        found[name] = measured
    cost: dict[str, numpy.ndarray] = {}
    squares: dict[str, dict[str, numpy.ndarray]] = {}
    units: dict[str, str] = {}
    for name, every in found.items():
        assert every is not None
        cost[name], errors, units = every
        for component, values in errors.items():
            squares.setdefault(component, {})[name] = values
    return EpisodeMeans(cost, squares, units)


Means = tuple[numpy.ndarray, dict[str, numpy.ndarray], dict[str, str]]
"""Cost and squared errors of every episode, and units of the components."""


def _means_of(asked: Asked, tick: Callable[[int], None]) -> Means:
    dataset = run_experiment(asked.experiment, {asked.name: asked.maker}, tick)
    data = dataset.isel(policy=0)
    first, last = windows_of(dataset)["all"]
    known = reported_components(dataset)
    errors = {}
    for component in shown_components(list(known)):
        values = squared_errors(data, component, groups_of(dataset))[:, first - 1 : last]
        errors[component] = values.mean(axis=1)
    return data["cost"].values.mean(axis=1), errors, known


def _kept_file(waiting: Path, key: str, agent: Path | None) -> Path:
    """File of one competitor's means; another one if the agent is trained on, or anything else is asked for."""
    digest = hashlib.sha256(key.encode() + (b"" if agent is None else agent.read_bytes()))
    return waiting / f"{digest.hexdigest()[:32]}.npz"


def _write_means(
    path: Path, cost: numpy.ndarray, squares: dict[str, numpy.ndarray], units: dict[str, str]
) -> None:
    arrays: dict[str, Any] = {f"squares_{name}": values for name, values in squares.items()}
    with whole_file(path) as partial, partial.open("wb") as file:
        numpy.savez(file, cost=cost, units=json.dumps(units), **arrays)


def _read_means(path: Path) -> Means | None:
    """Return cost, squares by component, and units; None if they are not there yet."""
    if not path.exists():
        return None
    with numpy.load(path, allow_pickle=False) as kept:
        squares = {name.removeprefix("squares_"): kept[name] for name in kept if name.startswith("squares_")}
        return kept["cost"], squares, json.loads(str(kept["units"]))


def compare(
    runs: Sequence[SeedRun], means: EpisodeMeans, scenario: str, seed: int, split: str
) -> list[Comparison]:
    """Every number of the tables, from the episodes' means.

    Intervals are 95 % bootstraps over episodes, in which the median is taken anew in every resample; only
    the mean's interval is over training seeds as well (:func:`spread`).
    """
    problem = runs[0].run.problem
    paper, reference = problem.paper, problem.baselines.score_reference
    episodes = len(means.cost[paper])
    bootstrap = Bootstrap(episodes)
    cost = {name: bootstrap.means(values) for name, values in means.cost.items()}
    rmse = {
        component: {name: numpy.sqrt(bootstrap.means(values)) for name, values in table.items()}
        for component, table in means.squares.items()
    }
    found: list[Comparison] = []

    def add(
        policy: str,
        statistic: str,
        against: str,
        metric: str,
        values: Any,
        component: str = "",
    ) -> None:
        """Keep an estimate, or the interval of a statistic and its resamples."""
        estimate = values if isinstance(values, Estimate) else bootstrap.interval(values)
        value, low, high = (float(x) if numpy.isfinite(x) else None for x in estimate)
        where = (problem.id, scenario, split, seed, episodes)
        what = (policy, statistic, against, metric, component)
        found.append(Comparison(*where, *what, value, low, high, means.units.get(component, "1")))

    groups = {
        algorithm: [member.name for member in runs if member.algorithm == algorithm]
        for algorithm in dict.fromkeys(member.algorithm for member in runs)
    }
    trained = [member.name for member in runs]
    opponents = [name for name in cost if name not in trained]
    for name in cost:
        statistic = "run" if name in trained else "opponent"
        add(name, statistic, paper, "relative_cost_difference", cost[name] / cost[paper] - 1.0)
        if reference in cost:
            add(
                name,
                statistic,
                reference,
                "score",
                score(cost[name], cost[paper], cost[reference], bootstrap),
            )
        for component, table in rmse.items():
            add(name, statistic, "", "rmse", table[name], component)
    for algorithm, members in groups.items():
        for name in opponents:
            median = numpy.median([cost[m] / cost[name] - 1.0 for m in members], axis=0)
            add(algorithm, "median", name, "relative_cost_difference", median)
            for component, table in rmse.items():
                median = numpy.median([table[m] - table[name] for m in members], axis=0)
                add(algorithm, "median", name, "rmse_difference", median, component)
        # Linear in the episodes, so that the noise of the paper's mean cost counts too; the mean of every
        # run is its relative cost difference exactly.
        each, of_paper = numpy.stack([means.cost[m] for m in members]), means.cost[paper]
        ratio = each.mean() / of_paper.mean()
        layout = spread((each - ratio * of_paper) / of_paper.mean() + ratio - 1.0)
        add(algorithm, "mean", paper, "relative_cost_difference", layout.mean)
        for statistic, value in (
            ("between seeds", layout.between_seeds),
            ("over episodes", layout.over_episodes),
        ):
            nothing = float("nan")
            add(algorithm, statistic, paper, "relative_cost_difference", Estimate(value, nothing, nothing))
    return found


def comparison_grids(runs: Sequence[SeedRun], comparisons: Sequence[Comparison]) -> list[Grid]:
    """Tables of one scenario: every run and opponent; the spread of each algorithm; medians and opponents."""
    first = comparisons[0]
    problem = runs[0].run.problem
    paper, references = problem.paper, problem.baselines.references
    found = {(c.policy, c.statistic, c.against, c.metric, c.component): c for c in comparisons}
    units = {c.component: c.unit for c in comparisons if c.metric == "rmse"}
    errors = [f"RMSE {name.replace('_', ' ')}, {unit}" for name, unit in units.items()]
    scored = {c.against for c in comparisons if c.metric == "score"}
    policies = {c.policy: c.statistic for c in comparisons if c.metric == "rmse"}
    opponents = [name for name, statistic in policies.items() if statistic == "opponent"]
    algorithms = dict.fromkeys(member.algorithm for member in runs)
    steps = {member.name: f"{member.run.best['steps']:,}" for member in runs if member.run.best}

    def cost(policy: str, statistic: str, against: str = paper) -> str:
        return with_interval(found[policy, statistic, against, "relative_cost_difference", ""], 100.0)

    each = Grid(
        f"Scenario `{first.scenario}`, {first.episodes} episodes of the {first.split} split",
        ["agent", "at step", f"cost against `{paper}`, %", *errors, *(["score"] if scored else [])],
        [
            [
                f"`{name}`" + (" (reference)" if name in references else ""),
                steps.get(name, ""),
                cost(name, statistic),
                *(with_interval(found[name, statistic, "", "rmse", component]) for component in units),
                *(with_interval(found[name, statistic, reference, "score", ""]) for reference in scored),
            ]
            for name, statistic in policies.items()
        ],
    )
    columns = ("median", "mean", "between seeds", "over episodes")
    variation = Grid(
        f"Cost against `{paper}`, %, over the training seeds, scenario `{first.scenario}`",
        ["algorithm", "runs", "median", "mean", "sd between seeds", "se over episodes"],
        [
            [
                f"`{algorithm}`",
                str(sum(member.algorithm == algorithm for member in runs)),
                *(cost(algorithm, statistic) for statistic in columns),
            ]
            for algorithm in algorithms
        ],
    )
    medians = Grid(
        f"Median run minus opponent, scenario `{first.scenario}`",
        ["algorithm", "opponent", "cost, %", *errors],
        [
            [
                f"`{algorithm}`",
                f"`{name}`",
                cost(algorithm, "median", name),
                *(with_interval(found[algorithm, "median", name, "rmse_difference", c]) for c in units),
            ]
            for algorithm in algorithms
            for name in opponents
        ],
    )
    return [each, variation, medians]


def compare_scenarios(
    runs: Sequence[SeedRun],
    opponents: Sequence[str],
    scenarios: Sequence[str],
    episodes: int,
    seed: int,
    split: str,
    progress: Callable[[int], None] = lambda done: None,
    trust: bool = False,
    waiting: Path | None = None,
    workers: Workers | None = None,
) -> tuple[list[Comparison], list[Grid]]:
    """Evaluate runs and opponents in every scenario; return all numbers, and the tables of them.

    Arguments as of :func:`episode_means`.
    """
    records: list[Comparison] = []
    grids: list[Grid] = []
    for scenario in scenarios:
        means = episode_means(
            runs, opponents, scenario, episodes, seed, split, progress, trust, waiting, workers
        )
        comparisons = compare(runs, means, scenario, seed, split)
        records += comparisons
        grids += comparison_grids(runs, comparisons)
    return records, grids


def grids_as_markdown(grids: Sequence[Grid], runs: Sequence[SeedRun], command: str) -> str:
    """Tables, the first shown and the others folded, and the commands that made them and the runs."""
    lines: list[str] = []
    for i, grid in enumerate(grids):
        table = markdown_table(grid.header, grid.rows)
        if i == 0:
            lines += [f"**{grid.title}**", "", *table, ""]
        else:
            # Between blank lines Markdown is read inside HTML; the summary is HTML only.
            title = re.sub("`(.+?)`", r"<code>\1</code>", html.escape(grid.title, quote=False))
            lines += ["<details>", f"<summary>{title}</summary>", "", *table, "", "</details>", ""]
    lines += [f"95 % intervals. Made by `{command}` from the runs of", ""]
    trained: dict[str, list[str]] = {}
    for member in runs:
        training = member.run.command.removesuffix(f" --seed {member.run.seed}")
        trained.setdefault(training, []).append(str(member.run.seed))
    lines += [f"* `{training} --seed {'|'.join(seeds)}`" for training, seeds in trained.items()]
    return "\n".join(lines)
