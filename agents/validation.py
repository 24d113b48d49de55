"""Validation of agents in training against the paper's algorithm, on the validation split."""

import copy
from collections.abc import Callable, Mapping
from typing import Any

import numpy

from ..baselines.problem import Problem
from ..envs.contract.model import Episode, Model
from ..envs.engine.backend import make_model
from ..envs.engine.scenario_choice import find_mixture
from ..evaluation.competitors.kinds import kind_of
from ..evaluation.running.rollout import run_competitor
from ..evaluation.running.seeds import episode_seeds
from ..evaluation.statistics.bootstrap import Bootstrap
from .settings import ESTIMATORS
from .training_run import TrainingRun, ValidationEntry

VALIDATION_EPISODES = 512


def _cost(model: Model, episode: Episode) -> dict[str, numpy.ndarray]:
    return {"cost": model.cost(episode)}


class TrainingEpisodes:
    """Episodes of the validation split in a run's environment and scenario, for the scores of competitors.

    All episodes are simulated in every scenario of a mixture, and the results are weighted as in the mixture: the same
    expectation with less variance than random scenarios.
    """

    def __init__(self, run: TrainingRun, episodes: int, backend: str = "auto") -> None:
        self.problem: Problem = run.problem
        self.keywords: dict[str, Any] = run.task_keywords
        self.backend = backend
        self.weights: dict[str, float] = find_mixture(run.problem.task, run.scenario) or {run.scenario: 1.0}
        self.seeds: list[int] = episode_seeds("validation", 0, episodes)
        self._models: dict[tuple[str | None, str, str], Model] = {}

    def _model(self, control: str | None, scenario: str, keywords: Mapping[str, Any]) -> Model:
        """Return the model of a control and scenario, cached since compilation takes time."""
        key = control, scenario, repr(keywords)
        if key not in self._models:
            cls, parameters = self.problem.task, {**keywords, **self.keywords}
            self._models[key] = make_model(cls, control, scenario, backend=self.backend, **parameters)
        return self._models[key]

    def means(
        self,
        competitor: Any,
        control: str | None = None,
        report: Callable[[Model, Episode], dict[str, numpy.ndarray]] = _cost,
        episodes: int | None = None,
    ) -> dict[str, numpy.ndarray]:
        """Return a competitor's mean of each reported metric over every episode, ``(episodes,)``, by name.

        Args:
            competitor: policy, estimator or reference, or a factory of one.
            control: control of a policy; default: its own.
            report: function of :func:`.run_competitor`, with one number for every episode.
            episodes: number of first episodes to simulate; None: all.
        """
        kind = kind_of(competitor)
        control = control or getattr(competitor, "control", None)
        total: dict[str, Any] = {}
        for scenario, weight in self.weights.items():
            model = self._model(control, scenario, getattr(competitor, "task_keywords", {}))
            series = run_competitor(model, competitor, kind, self.seeds[:episodes], report)
            for name, values in series.items():
                mean = numpy.ascontiguousarray(values).mean(axis=1)
                total[name] = total.get(name, 0.0) + weight * mean
        return total

    def costs(self, competitor: Any, control: str | None = None) -> numpy.ndarray:
        """Return a competitor's mean cost of every episode, ``(episodes,)``; arguments as of :meth:`means`."""
        return self.means(competitor, control)["cost"]


def validation_backend(run: TrainingRun) -> str:
    """Return the name of the backend of a run's validations: the run's own, or "auto" for torch."""
    return "auto" if run.backend == "torch" else run.backend


class Validation:
    """Scores of an agent and of the paper's algorithm, if any, on the same episodes of the validation split."""

    def __init__(self, run: TrainingRun) -> None:
        self.run = run
        problem = run.problem
        self.paper: str = problem.baselines.score_paper
        self.bootstrap: Bootstrap = Bootstrap(VALIDATION_EPISODES)
        self.episodes: TrainingEpisodes = TrainingEpisodes(run, VALIDATION_EPISODES, validation_backend(run))
        # Once, as neither the paper's algorithm nor the episodes change in a run.
        self.paper_cost = self._costs(problem.competitor(self.paper), None) if self.paper else None

    def _costs(self, policy: Any, control: str | None) -> numpy.ndarray:
        """Return a policy's mean cost over all episodes, then over each bootstrap resample, ``(1 + resamples,)``."""
        return self.bootstrap.means(self.episodes.costs(policy, control))

    def score(self, policy: Any) -> ValidationEntry:
        """Return the validation of a policy: its cost, and the paired difference to the paper's algorithm."""
        acts = self.run.algorithm not in ESTIMATORS
        # A copy, as the factory caches compiled code and the network has changed since the last validation.
        cost = self._costs(copy.copy(policy), self.run.control if acts else None)
        entry: ValidationEntry = {"steps": self.run.steps_done, "cost": float(cost[0])}
        if self.paper is None or self.paper_cost is None:
            return entry
        return {
            **entry,
            "paper": self.paper,
            "paper_cost": float(self.paper_cost[0]),
            "relative_cost_difference": list(self.bootstrap.relative_difference(cost, self.paper_cost)),
        }
