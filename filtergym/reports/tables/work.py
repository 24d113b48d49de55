"""What makes a competitor's numbers, for the store of unfinished work."""

import hashlib
import json

from ...agents.learned_policy import pretrained_path
from ...agents.named_policies import pretrained_agents
from ...baselines.problem import Problem
from ...envs.engine.catalogue import short_name
from ...evaluation.running.evaluate import Experiment
from ...evaluation.running.summary import EvaluationRequest
from ...evaluation.storage.store import Work


def work_of(problem: Problem, asked: EvaluationRequest) -> Work | None:
    """Return the piece of work that the summary of a competitor is; None where nothing is kept of it.

    Args:
        problem: whose competitor it is.
        asked: of an experiment on the problem.
    """
    meaning = meaning_of(problem, asked.name)
    if meaning is None:
        return None
    plain = asked._replace(maker=None, metrics=None)
    return Work(f"{stem_of(asked.experiment)}.{asked.name}", f"{meaning} {tuple(plain)}")


def stem_of(experiment: Experiment) -> str:
    """Begin the name of a file about an experiment."""
    environment, scenario = short_name(experiment.task.id), experiment.scenario or "default"
    return f"{environment}.{scenario}.{experiment.episodes}.{experiment.split}{experiment.seed}"


def meaning_of(problem: Problem, name: str) -> str | None:
    """Say what a competitor's name stands for, in words that change with it: its values, or a digest of its file.

    Args:
        problem: whose it is.
        name: of the competitor.

    Returns:
        None for environments, files, modules and objects of one's own: nobody can say whether they are what they were.
    """
    if problem.name != problem.id:
        return None
    if name in problem.tuned_policies:
        return json.dumps(problem.tuned_values.values(name.removesuffix("-tuned"))[0])
    if name in pretrained_agents(problem.id):
        return hashlib.sha256(pretrained_path(problem.id, name).read_bytes()).hexdigest()
    return name if name in problem.baselines.names else None
