"""Standing of trained agents beside the paper's algorithm, the strongest classical competitor and the reference.

It is measured on the validation split, by which agents are chosen; ``filtergym evaluate`` and ``filtergym benchmark``
make tables of the test split.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy
import xarray
from rich.table import Table

from ...agents import validation
from ...agents.named_policies import find_learned_policy
from ...agents.training_run import FirstWin, TrainingRun
from ...agents.validation import TrainingEpisodes, validation_backend
from ...envs.contract.model import Episode, Model
from ...evaluation.competitors.kinds import RandomPolicy
from ...evaluation.statistics.bootstrap import Bootstrap, IntervalEstimate
from ...filters.gaussian import log_density
from .terminal_tables import INCONSISTENT, consistency, cost_title, plain_table, with_interval

SCREENING_SECONDS = 1.5
"""Time for running every classical competitor on a few episodes, to find candidates for the strongest."""
FEWEST_SCREENED = 16
FINALISTS = 3
"""Number of candidates that run on all episodes."""


def _cost_and_nees(model: Model, episode: Episode) -> dict[str, numpy.ndarray]:
    nees = log_density(model.error(episode), model.covariance(episode))[1]
    return {"cost": model.cost(episode), "anees": nees / len(model.task.components)}


def measure_standing(run: TrainingRun, agents: Mapping[str, Path], trust: bool = False) -> xarray.Dataset:
    """Measure agents, and the competitors they are compared with, on the episodes of a run's validations.

    Returns:
        ``cost`` and ``anees`` of every episode, ``(policy, episode)``; ``role`` is "agent", "paper", "strongest
        classical" or "reference".

    Raises:
        ValueError: if an agent cannot be read, or needs ``trust``.
    """
    problem, known = run.problem, run.problem.baselines
    episodes = TrainingEpisodes(run, validation.VALIDATION_EPISODES, validation_backend(run))
    reference = known.score_reference if known.score_reference in known.references else None
    opponents = {
        "paper": known.score_paper,
        "strongest classical": _strongest(run, episodes),
        "reference": reference,
    }
    roles = dict.fromkeys(agents, "agent") | {name: role for role, name in opponents.items() if name}
    means = [
        episodes.means(
            find_learned_policy(problem.task, str(agents[name]), trust)
            if name in agents
            else problem.competitor(name),
            report=_cost_and_nees,
        )
        for name in roles
    ]
    variables = {
        metric: (("policy", "episode"), numpy.stack([own[metric] for own in means]))
        for metric in ("cost", "anees")
    }
    coords = {"policy": list(roles), "role": ("policy", list(roles.values()))}
    return xarray.Dataset(variables, coords, {"environment": problem.id, "scenario": run.scenario})


def _strongest(run: TrainingRun, episodes: TrainingEpisodes) -> str | None:
    """Return the cheapest classical competitor but the paper's algorithm, tuned or not, by name; None without any."""
    problem, known = run.problem, run.problem.baselines
    makers = {
        name: problem.competitor(name)
        for name in (*known.policies, *known.estimators, *problem.tuned_policies)
    }
    names = [n for n, maker in makers.items() if n != known.score_paper and maker is not RandomPolicy]
    if not names:
        return None
    horizon = run.make_model().task.horizon
    each = len(names) * len(episodes.weights) * horizon * known.measurement_seconds
    few = max(FEWEST_SCREENED, int(SCREENING_SECONDS / each))
    screened = {n: episodes.means(makers[n], episodes=few)["cost"].mean() for n in names}
    finalists = sorted(names, key=screened.__getitem__)[:FINALISTS]
    if few >= len(episodes.seeds):
        return finalists[0]
    return min(finalists, key=lambda name: episodes.costs(makers[name]).mean())


def standing_table(standing: xarray.Dataset, passed: Mapping[str, FirstWin | None]) -> Table:
    """Return a table of agents and their opponents: cost, difference to the paper's algorithm, consistency.

    ``passed`` has the step at which each agent was first better than the paper's algorithm.
    """
    bootstrap = Bootstrap(standing.sizes["episode"])
    table = plain_table(
        f"{standing.environment}, scenario {standing.scenario} ({standing.sizes['episode']} episodes of the validation "
        "split; 95 % intervals)"
    )
    papers = standing["policy"].values[standing["role"].values == "paper"].tolist()
    table.add_column("name", no_wrap=True)
    table.add_column("")
    for title in (
        "cost",
        cost_title("".join(papers)),
        "means,\n%",
        "ANEES",
        f"beat {''.join(papers) or 'paper'}\nafter steps",
    ):
        table.add_column(title, justify="right", no_wrap=True)
    paper = standing["cost"].sel(policy=papers[0]).values if papers else None
    for name, role in zip(standing["policy"].values.tolist(), standing["role"].values.tolist(), strict=True):
        own = standing["cost"].sel(policy=name).values
        row = [name, role.replace(" ", "\n"), f"{own.mean():.4g}"]
        if paper is None or role == "paper":
            row += ["-", "-"]
        else:
            difference = bootstrap.geometric_difference(own, paper)
            row += [
                with_interval(difference, 100.0, negligible=0.005),
                f"{100.0 * (own.mean() / paper.mean() - 1.0):+.1f}",
            ]
        row.append(consistency(IntervalEstimate(float(standing["anees"].sel(policy=name).mean()), 0.0, 0.0)))
        first = passed.get(name)
        row.append("-" if first is None else f"{first['steps']:,}\n({first['seconds']:.1f} s)")
        table.add_row(*row)
    table.caption = (
        "cost vs is the geometric mean of the ratios of the episodes' costs, means the ratio of the mean costs. "
        f"ANEES is 1 if errors are as large as the covariance states; {INCONSISTENT} marks one off by more than "
        "a factor of two. Agents were chosen on these episodes."
    )
    return table
