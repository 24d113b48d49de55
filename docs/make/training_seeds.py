"""Training seeds: every run of an algorithm against the papers' algorithms, on the same episodes.

One agent is weak evidence on its algorithm. Here the runs of several training seeds act in the same episodes, so that
the effects of training seed and episodes can be separated.
"""

import functools
import hashlib
import html
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy
import xarray
from pictures import draw_learning_curves
from records import ResultRecord, round_number
from scipy.special import stdtrit
from sentence_numbers import Number

from filtergym.agents.training_run import TrainingRun, best_agent, load_run
from filtergym.baselines.problem import Problem, problem_of
from filtergym.envs.engine.catalogue import bare_name
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.evaluation.competitors.kinds import kind_of
from filtergym.evaluation.running.evaluate import check_sendable
from filtergym.evaluation.running.metrics import components_and_groups, mean_over_time, score, squared_errors
from filtergym.evaluation.running.parallel import Workers, check_workers
from filtergym.evaluation.running.summary import EvaluationRequest, file_stem, reduce_episodes
from filtergym.evaluation.statistics.bootstrap import CONFIDENCE, Bootstrap, IntervalEstimate
from filtergym.evaluation.statistics.statistic import ALL, Statistic
from filtergym.evaluation.storage.code import files_digest
from filtergym.evaluation.storage.dataset import groups_of, windows_of
from filtergym.evaluation.storage.store import Store, Work
from filtergym.names import find_competitor
from filtergym.papers.grid import Grid, markdown_table
from filtergym.reports.tables.terminal_tables import select_components, with_interval


class Comparison(NamedTuple):
    """One number with interval: of a run, of an algorithm's runs together, or of an opponent."""

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
    """One training run among those of its algorithm: record, agent and folder."""

    algorithm: str
    """Name of the algorithm, with the control where its runs have several."""
    run: TrainingRun
    agent: Path
    """File of the best agent."""
    folder: Path

    @property
    def name(self) -> str:
        """Name of the run in tables, algorithm and seed."""
        return f"{self.algorithm} seed {self.run.seed}"


class Trained(NamedTuple):
    """Description of a training run on pages: name, algorithm, seed, steps and command."""

    name: str
    algorithm: str
    seed: int
    steps: int | None
    """Step at which its best agent was found; None: unknown."""
    command: str
    """Training command, without the seed."""


class EpisodeMeans(NamedTuple):
    """Mean cost and squared errors of every episode in one scenario, of each policy by name."""

    cost: dict[str, numpy.ndarray]
    """Mean cost of every episode, ``(episodes,)``, by policy."""
    squares: dict[str, dict[str, numpy.ndarray]]
    """Mean squared error of every episode, ``(episodes,)``, by component and policy."""
    units: dict[str, str]


class PolicyMeans(NamedTuple):
    """Mean cost and squared errors of every episode, of one policy."""

    cost: numpy.ndarray
    """Mean cost of every episode, ``(episodes,)``."""
    squares: dict[str, numpy.ndarray]
    """Mean squared error of every episode, ``(episodes,)``, by component."""
    units: dict[str, str]


class Spread(NamedTuple):
    """Mean over seeds and episodes, and its standard deviations between seeds and over episodes."""

    mean: IntervalEstimate
    between_seeds: float
    """Standard deviation between training seeds, without the part of the episodes' noise."""
    over_episodes: float
    """Standard error of the mean of just these runs, over episodes."""


def spread(values: numpy.ndarray) -> Spread:
    """Return the mean with interval, and its variation over training seeds and over episodes (random effects).

    The moment estimates are those of the analysis of variance. The interval of the mean covers new seeds and new
    episodes: Student's t with Satterthwaite's degrees of freedom; a bootstrap over five seeds would be too narrow.

    Args:
        values: a number for each seed and episode, ``(seeds, episodes)``.
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
        IntervalEstimate(float(mean), float(mean - half), float(mean + half)),
        float(numpy.sqrt(between / episodes)) if seeds > 1 else float("nan"),
        float(numpy.sqrt(of_episodes / (seeds * episodes))),
    )


def load_runs(folders: Sequence[Path], trust: bool = False) -> list[SeedRun]:
    """Return the training runs in some folders, all of one environment, sorted by algorithm and seed.

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
        member = SeedRun(label, run, best_agent(folder), folder)
        if member.name in found:
            raise ValueError(f"{folder} is a second run of {member.name}")
        found[member.name] = member
    return sorted(found.values(), key=lambda member: (member.algorithm, member.run.seed))


def _algorithm(run: TrainingRun) -> str:
    """Return the name of a run's algorithm, with a mark of its gate and of the policy that it corrects."""
    around = f" on {run.residual_to}" if run.residual_to else ""
    return run.algorithm + around + (" gated" if run.gated else "")


def validation_curve(run: TrainingRun) -> tuple[list[int], list[float]] | None:
    """Return the steps and relative cost differences of a run's validations; None if any has no difference."""
    entries = run.validation
    relative = [entry.get("relative_cost_difference") for entry in entries]
    differences = [float(f"{difference[0]:.4g}") for difference in relative if difference]
    if not entries or len(differences) < len(entries):
        return None
    return [int(entry["steps"]) for entry in entries], differences


def learning_curves(data: Mapping[str, Any], columns: int = 2) -> Any:
    """Return a figure of the validation cost of every algorithm over training.

    Raises:
        ValueError: if a run has no validations.
    """
    curves: dict[str, list[tuple[list[float], list[float]]]] = {}
    for name, algorithm, *_ in data["runs"]:
        if name not in data["curves"]:
            raise ValueError(f"the record of {name} has no validations against {data['paper']!r} to draw")
        steps, differences = data["curves"][name]
        curves.setdefault(algorithm, []).append((steps, differences))
    title = f"{data['environment']}, median and range over training seeds"
    return draw_learning_curves(curves, title, data["paper"], columns=columns)


def default_opponents(problem: Problem) -> list[str]:
    """Return the default opponents of runs, by name: paper's algorithm, tunable and tuned policies, references."""
    known = problem.baselines
    untuned = [name for name in known.tunable if name != known.best_constant]
    names = [problem.paper, *known.compared, *untuned, *problem.tuned_policies, *known.references]
    return list(dict.fromkeys(names))


class Study(NamedTuple):
    """A comparison of runs with opponents, over the same episodes of each scenario."""

    runs: Sequence[SeedRun]
    opponents: Sequence[str]
    episodes: int
    seed: int = 0
    """Number of the experiment."""
    split: str = "test"
    trust: bool = False
    """Whether to load models that can execute code."""

    @property
    def problem(self) -> Problem:
        """Problem (task and baselines) of all runs."""
        return self.runs[0].run.problem


def episode_means(
    study: Study,
    scenario: str | None,
    progress: Callable[[int], None] = lambda done: None,
    store: Store | None = None,
    workers: Workers | None = None,
) -> EpisodeMeans:
    """Evaluate runs and opponents on the same episodes of a scenario, and return their means over each episode.

    Raises:
        ValueError: for unknown names, and for bounds, which have no cost.
    """
    store = store or Store()
    found: dict[str, PolicyMeans | None] = {}
    missing: list[tuple[str, EvaluationRequest, Work | None]] = []
    for name, (asked, work) in _requests_of(study, scenario).items():
        found[name] = store.read(work, PolicyMeans)
        if found[name] is None:
            missing.append((name, asked, work))
    workers = check_workers(workers)
    if not workers.alone:
        for _, asked, _ in missing:
            check_sendable(asked.experiment.task, {asked.name: asked.maker})
    requests = [request for _, request, _ in missing]
    for i, means in workers.run(
        _means_of, requests, [request.measurements for request in requests], progress
    ):
        name, _, work = missing[i]
        store.write(work, means)
        found[name] = means
    cost: dict[str, numpy.ndarray] = {}
    squares: dict[str, dict[str, numpy.ndarray]] = {}
    units: dict[str, str] = {}
    for name, every in found.items():
        assert every is not None
        cost[name], units = every.cost, every.units
        for component, values in every.squares.items():
            squares.setdefault(component, {})[name] = values
    return EpisodeMeans(cost, squares, units)


def _requests_of(study: Study, scenario: str | None) -> dict[str, tuple[EvaluationRequest, Work | None]]:
    """Return for each run and opponent, by name, the evaluation request, and the key of its stored means."""
    problem = study.problem
    entered = {m.name: find_competitor(problem, str(m.agent), study.trust) for m in study.runs}
    for name in dict.fromkeys([problem.paper, *study.opponents]):
        entered[name] = find_competitor(problem, name, study.trust)
        if kind_of(entered[name].maker) == "bound":
            raise ValueError(f"{name!r} is a bound, which has no cost: name policies and references")
    members = {member.name: member for member in study.runs}
    horizon = make_task(problem.task, scenario).horizon
    found: dict[str, tuple[EvaluationRequest, Work | None]] = {}
    for name, one in entered.items():
        member, maker = members.get(name), one.maker
        # A learned estimator has a filter of its own, and steers nothing.
        control = member.run.control if member and kind_of(maker) == "policy" else None
        experiment = problem.experiment(scenario, study.episodes, study.seed, study.split, control)
        identity = problem.paper if member and problem.is_shipped else one.identity
        work = None
        if identity is not None:
            agent = hashlib.sha256(member.agent.read_bytes()).hexdigest() if member else ""
            content = json.dumps([identity, agent, name, repr(experiment), _own_digest()])
            work = Work(f"{file_stem(experiment)}.seeds", content)
        # An agent's name may be that of a competitor.
        found[name] = EvaluationRequest(experiment, "agent" if member else name, maker, horizon=horizon), work
    return found


@functools.cache
def _own_digest() -> str:
    """Return a SHA-256 digest of the code in this folder, a part of the keys of stored means."""
    return files_digest([Path(__file__).parent])


def _means_of(asked: EvaluationRequest, tick: Callable[[int], None]) -> PolicyMeans:
    part = reduce_episodes(asked, _mean_statistics, tick)
    results, units = part.reduction.results(), components_and_groups(part.head)
    cost = results.pop(("cost",))
    return PolicyMeans(cost, {component: values for (component, *_), values in results.items()}, units)


def _mean_statistics(run: xarray.Dataset) -> Iterator[Statistic]:
    """Yield the statistics of an evaluation: mean cost and mean squared errors of every episode."""
    yield Statistic(("cost",), mean_over_time(run, run["cost"].values), sample=ALL)
    first, last = windows_of(run)["all"]
    for component in select_components(list(components_and_groups(run))):
        squares = squared_errors(run, component, groups_of(run))[:, first - 1 : last]
        yield Statistic((component, "mean_square"), squares.mean(axis=1), sample=ALL)


def compare(study: Study, means: EpisodeMeans, scenario: str) -> list[Comparison]:
    """Return every number of the tables of one scenario, with interval, from the episodes' means.

    Intervals are 95 % bootstraps over episodes, in which the median is taken anew in every resample; that of the mean
    is over training seeds as well (:func:`spread`).
    """
    runs, problem = study.runs, study.problem
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
        """Append a comparison whose estimate is given, or computed from a statistic and its bootstrap resamples."""
        estimate = values if isinstance(values, IntervalEstimate) else bootstrap.interval(values)
        value, low, high = (float(x) if numpy.isfinite(x) else None for x in estimate)
        where = (problem.id, scenario, study.split, study.seed, episodes)
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
        add(
            name,
            statistic,
            paper,
            "relative_cost_difference",
            bootstrap.relative_difference(cost[name], cost[paper]),
        )
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
            add(
                algorithm,
                statistic,
                paper,
                "relative_cost_difference",
                IntervalEstimate(value, nothing, nothing),
            )
    return found


def comparison_grids(
    problem: Problem, runs: Sequence[Trained], comparisons: Sequence[Comparison]
) -> list[Grid]:
    """Return the tables of one scenario: all runs and opponents, spread of each algorithm, and medians."""
    first = comparisons[0]
    paper, references = problem.paper, problem.baselines.references
    found = {(c.policy, c.statistic, c.against, c.metric, c.component): c for c in comparisons}
    units = {c.component: c.unit for c in comparisons if c.metric == "rmse"}
    errors = [f"RMSE {name.replace('_', ' ')}, {unit}" for name, unit in units.items()]
    scored = {c.against for c in comparisons if c.metric == "score"}
    policies = {c.policy: c.statistic for c in comparisons if c.metric == "rmse"}
    opponents = [name for name, statistic in policies.items() if statistic == "opponent"]
    algorithms = dict.fromkeys(member.algorithm for member in runs)
    steps = {member.name: f"{member.steps:,}" for member in runs if member.steps is not None}

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
    study: Study,
    scenarios: Sequence[str],
    progress: Callable[[int], None] = lambda done: None,
    store: Store | None = None,
    workers: Workers | None = None,
) -> tuple[list[Comparison], list[Grid]]:
    """Evaluate runs and opponents in several scenarios; return all numbers, and their tables.

    Arguments as of :func:`episode_means`.
    """
    records: list[Comparison] = []
    grids: list[Grid] = []
    runs = describe_runs(study.runs)
    for scenario in scenarios:
        means = episode_means(study, scenario, progress, store, workers)
        comparisons = compare(study, means, scenario)
        records += comparisons
        grids += comparison_grids(study.problem, runs, comparisons)
    return records, grids


def describe_runs(runs: Sequence[SeedRun]) -> list[Trained]:
    """Return the descriptions of training runs on pages."""
    return [
        Trained(
            member.name,
            member.algorithm,
            member.run.seed,
            member.run.best["steps"] if member.run.best else None,
            member.run.command.removesuffix(f" --seed {member.run.seed}"),
        )
        for member in runs
    ]


def runs_data(runs: Sequence[SeedRun]) -> dict[str, Any]:
    """Return a record's data on the runs alone: their descriptions, and their validation curves."""
    curves = {member.name: validation_curve(member.run) for member in runs}
    return {
        "environment": runs[0].run.problem.id,
        "paper": runs[0].run.problem.paper,
        "runs": [list(each) for each in describe_runs(runs)],
        "curves": {name: list(curve) for name, curve in curves.items() if curve is not None},
    }


def seeds_data(study: Study, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """Return a record's data on training seeds: the runs, and every number by scenario."""
    scenarios: dict[str, list[list[Any]]] = {}
    for c in comparisons:
        numbers = [round_number(x) for x in (c.value, c.low, c.high)]
        scenarios.setdefault(c.scenario, []).append(
            [c.policy, c.statistic, c.against, c.metric, c.component, *numbers]
        )
    return {
        "split": study.split,
        "seed": study.seed,
        "episodes": study.episodes,
        "units": {c.component: c.unit for c in comparisons if c.unit != "1"},
        **runs_data(study.runs),
        "scenarios": scenarios,
    }


def opponents_of_record(data: Mapping[str, Any]) -> list[str]:
    """Return the opponents in a record's data, for further runs that are compared with the same ones.

    Raises:
        ValueError: if one is no longer a competitor of the environment.
    """
    problem = problem_of(data["environment"])
    names = [row[0] for rows in data["scenarios"].values() for row in rows if row[1] == "opponent"]
    if gone := [name for name in names if problem.find(name) is None]:
        raise ValueError(
            f"the record has the opponent {gone[0]!r}, which {problem.id} no longer has: make it anew from all runs, "
            f"by python docs/make seeds runs/{bare_name(problem.id)}/*-? --scenario {next(iter(data['scenarios']))} "
            f"--episodes {data['episodes']} --into docs/records"
        )
    return list(dict.fromkeys(names))


def merge_runs(data: Mapping[str, Any], added: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record's data with algorithms added or replaced that were scored later over the same episodes, against
    the same opponents; of the added errors those of the record's components.

    Raises:
        ValueError: if the environment differs.
    """
    if data["environment"] != added["environment"]:
        raise ValueError(f"the record is of {data['environment']}, the runs are of {added['environment']}")
    fresh = {algorithm for _, algorithm, *_ in added["runs"]}
    kept = [run for run in data["runs"] if run[1] not in fresh]
    gone = {run[0] for run in data["runs"]} - {run[0] for run in kept}
    scenarios = {}
    for name, rows in data["scenarios"].items():
        new = [row for row in added["scenarios"][name] if row[4] in ("", *data["units"])]
        measured = {row[0] for row in new} | fresh | gone
        scenarios[name] = [row for row in rows if row[0] not in measured] + new
    curves = {name: curve for name, curve in data.get("curves", {}).items() if name not in gone}
    return {
        **data,
        "runs": sorted([*kept, *added["runs"]], key=lambda run: (run[1], run[2])),
        "curves": {**curves, **added["curves"]},
        "scenarios": scenarios,
    }


def seeds_markdown(record: ResultRecord) -> str:
    """Return the tables of training seeds in Markdown, with the commands of the tables and the runs."""
    data = record.data
    problem, runs = problem_of(data["environment"]), [Trained(*each) for each in data["runs"]]
    grids: list[Grid] = []
    for scenario, numbers in data["scenarios"].items():
        where = (problem.id, scenario, data["split"], data["seed"], data["episodes"])
        own = [Comparison._make([*where, *each, data["units"].get(each[4], "1")]) for each in numbers]
        grids += comparison_grids(problem, runs, own)
    return grids_as_markdown(grids, runs, record.origin)


def seeds_overview(records: Sequence[ResultRecord]) -> str:
    """Return a Markdown table: cost of every algorithm against the paper's, mean over training seeds, by environment.

    Beside them stands the opponent of lowest cost that is no reference. Agents are not distinguished by a gate or by a
    policy that they correct.
    """
    means: dict[str, dict[str, str]] = {}
    for record in records:
        data = record.data
        problem = problem_of(data["environment"])
        [(_, numbers), *_] = data["scenarios"].items()
        cost = [each for each in numbers if each[2:4] == [data["paper"], "relative_cost_difference"]]
        own = {name.split()[0]: _percent(values) for name, kind, _, _, _, *values in cost if kind == "mean"}
        opponents = {name: values for name, kind, _, _, _, *values in cost if kind == "opponent"}
        classical = {
            name: values for name, values in opponents.items() if name not in problem.baselines.references
        }
        best = min(classical, key=lambda name: classical[name][0])
        own["strongest classical"] = f"`{best}` {_percent(classical[best])}"
        own["reference"] = "; ".join(_percent(v) for name, v in opponents.items() if name not in classical)
        means[bare_name(problem.id)] = own
    algorithms = sorted(
        {name for own in means.values() for name in own} - {"strongest classical", "reference"}
    )
    columns = [*algorithms, "strongest classical", "reference"]
    heads = [f"`{name}`" if name in algorithms else name for name in columns]
    rows = [[name, *(own.get(column, "-") or "-" for column in columns)] for name, own in means.items()]
    return "\n".join(markdown_table(["environment", *heads], rows))


def _percent(values: Sequence[float | None]) -> str:
    return with_interval(Number(*values), 100.0)


def grids_as_markdown(grids: Sequence[Grid], runs: Sequence[Trained], origin: str) -> str:
    """Return tables in Markdown, all but the first folded, with the commands of the tables and the runs."""
    lines: list[str] = []
    for i, grid in enumerate(grids):
        table = markdown_table(grid.header, grid.rows)
        if i == 0:
            lines += [f"**{grid.title}**", "", *table, ""]
        else:
            # Between blank lines Markdown is read inside HTML; the summary is HTML only.
            title = re.sub("`(.+?)`", r"<code>\1</code>", html.escape(grid.title, quote=False))
            lines += ["<details>", f"<summary>{title}</summary>", "", *table, "", "</details>", ""]
    lines += [f"95 % intervals. {origin} The runs are of", ""]
    trained: dict[str, list[str]] = {}
    for member in runs:
        trained.setdefault(member.command, []).append(str(member.seed))
    lines += [f"* `{training} --seed {'|'.join(seeds)}`" for training, seeds in trained.items()]
    return "\n".join(lines)
