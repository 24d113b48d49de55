"""How trained agents stand beside the paper's algorithm, the strongest classical competitor and the reference.

On the validation split, by which agents are chosen; tables of the test split are made by ``filtergym evaluate``
and ``filtergym benchmark``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy
from rich.table import Table

from ...agents import validation
from ...agents.named_policies import find_learned_policy
from ...agents.training_run import Passed, TrainingRun
from ...agents.validation import TrainingEpisodes, validation_backend
from ...envs.contract.model import Episode, Model
from ...evaluation.competitors.kinds import RandomPolicy
from ...evaluation.statistics.bootstrap import Bootstrap, IntervalEstimate
from ...filters.gaussian import log_density
from .terminal_tables import INCONSISTENT, consistency, plain_table, with_interval

SCREENING_SECONDS = 1.5
"""Time for asking every classical competitor, on a few episodes, whether it may be the strongest."""
FEWEST_SCREENED = 16
FINALISTS = 3
"""Of those, how many meet all episodes."""


def _cost_and_nees(model: Model, episode: Episode) -> dict[str, numpy.ndarray]:
    nees = log_density(model.error(episode), model.covariance(episode))[1]
    return {"cost": model.cost(episode), "anees": nees / len(model.task.components)}


class Standing(NamedTuple):
    """One line of the table."""

    name: str
    role: str
    means: Mapping[str, numpy.ndarray]
    """``cost`` and ``anees`` of every episode, ``(episodes,)``."""
    beat_paper: Passed | None = None
    """When an agent was first better than the paper's algorithm."""


class Opponents:
    """Who an agent is measured against, flown once on the episodes of a run's validations.

    Args:
        run: whose environment, scenario and parameters they meet.
    """

    def __init__(self, run: TrainingRun) -> None:
        self.problem = run.problem
        known = self.problem.baselines
        self.paper = known.score_paper
        self.episodes = TrainingEpisodes(run, validation.VALIDATION_EPISODES, validation_backend(run))
        self.found: list[Standing] = []
        if self.paper:
            self._fly(self.paper, "paper")
        strongest = self._strongest(run)
        if strongest:
            self._fly(strongest, "strongest classical")
        if known.score_reference in known.references:
            self._fly(known.score_reference, "reference")

    def _fly(self, name: str, role: str) -> None:
        self.found.append(Standing(name, role, self.measure(self.problem.competitor(name))))

    def measure(self, competitor: Any) -> dict[str, numpy.ndarray]:
        """Return cost and normalised estimation error of every episode, ``(episodes,)``."""
        return self.episodes.means(competitor, report=_cost_and_nees)

    def _strongest(self, run: TrainingRun) -> str | None:
        """Name of the competitor with the lowest cost, of any kind, tuned or not; None where there is none."""
        known = self.problem.baselines
        makers = {
            name: self.problem.competitor(name)
            for name in (*known.policies, *known.estimators, *self.problem.tuned_policies)
        }
        names = [n for n, maker in makers.items() if n != self.paper and maker is not RandomPolicy]
        if not names:
            return None
        horizon = run.make_model().task.horizon
        each = len(names) * len(self.episodes.weights) * horizon * known.measurement_seconds
        few = max(FEWEST_SCREENED, int(SCREENING_SECONDS / each))
        screened = {n: self.episodes.means(makers[n], episodes=few)["cost"].mean() for n in names}
        finalists = sorted(names, key=screened.__getitem__)[:FINALISTS]
        if few >= len(self.episodes.seeds):
            return finalists[0]
        return min(finalists, key=lambda name: self.episodes.costs(makers[name]).mean())


def agent_standing(
    run: TrainingRun, agent: Path, name: str, opponents: Opponents, trust: bool = False
) -> Standing:
    """Measure the best agent of a run.

    Args:
        run: its record.
        agent: file of the agent.
        name: of the agent.
        opponents: whose episodes it meets.
        trust: load a model, which can execute code.

    Raises:
        ValueError: if the agent cannot be read, or takes ``trust``.
    """
    competitor = find_learned_policy(run.problem.task, str(agent), trust)
    return Standing(name, "agent", opponents.measure(competitor), run.beat_paper)


def standing_table(agents: list[Standing], opponents: Opponents, scenario: str) -> Table:
    """Compare agents with their opponents: cost, its difference to the paper's algorithm, consistency."""
    lines = [*agents, *opponents.found]
    episodes = len(lines[0].means["cost"])
    bootstrap = Bootstrap(episodes)
    table = plain_table(
        f"{opponents.problem.id}, scenario {scenario} ({episodes} episodes of the validation split; 95 % intervals)"
    )
    table.add_column("name", no_wrap=True)
    table.add_column("")
    for title in ("cost", "cost vs paper, %", "means,\n%", "ANEES", "beat paper\nafter steps"):
        table.add_column(title, justify="right", no_wrap=True)
    paper = next((line.means["cost"] for line in lines if line.role == "paper"), None)
    for line in lines:
        own = line.means["cost"]
        row = [line.name, line.role.replace(" ", "\n"), f"{own.mean():.4g}"]
        if paper is None or line.role == "paper":
            row += ["-", "-"]
        else:
            difference = bootstrap.geometric_difference(own, paper)
            row += [
                with_interval(difference, 100.0, negligible=0.005),
                f"{100.0 * (own.mean() / paper.mean() - 1.0):+.1f}",
            ]
        row.append(consistency(IntervalEstimate(float(line.means["anees"].mean()), 0.0, 0.0)))
        passed = line.beat_paper
        row.append("-" if passed is None else f"{passed['steps']:,}\n({passed['seconds']:.1f} s)")
        table.add_row(*row)
    table.caption = (
        "cost vs paper is the geometric mean of the ratios of the episodes' costs, means the ratio of the mean costs. "
        f"ANEES is 1 if errors are as large as the covariance says; {INCONSISTENT} marks one that is off by more than "
        "a factor of two. Agents were chosen on these episodes."
    )
    return table
