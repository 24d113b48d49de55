"""What is done of long work waits in files, so that the same command goes on after whatever ended it."""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

from ..agents.learned_policy import pretrained_path
from ..agents.named_policies import shipped_agents
from ..baselines.problem import Problem, problem_of
from ..envs.catalogue import short_name
from ..evaluation.code import code_digest
from ..evaluation.summary import Asked, Kept

UNFINISHED = "unfinished"
"""Folder, in that of the results, of what waits."""


def stem_of(id: str, scenario: str | None, episodes: int, split: str, seed: int) -> str:
    """Begin the name of a file about some episodes."""
    return f"{short_name(id)}.{scenario or 'default'}.{episodes}.{split}{seed}"


def remove(folder: Path, paths: Iterable[Path]) -> None:
    """Remove what waited, and the folder if nothing else is in it, such as what another command left."""
    for path in paths:
        path.unlink(missing_ok=True)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def kept_in(folder: Path, asked: Asked) -> Kept | None:
    """Return where a summary waits, and all that it depends on.

    Args:
        folder: of what waits.
        asked: a competitor over episodes.

    Returns:
        None where :func:`made_by` says that nothing is kept.
    """
    experiment = asked.experiment
    maker = made_by(problem_of(experiment.environment), asked.name)
    if maker is None:
        return None
    plain = asked._replace(maker=None, metrics=None)
    stem = stem_of(
        experiment.environment, experiment.scenario, experiment.episodes, experiment.split, experiment.seed
    )
    return Kept(folder / f"{stem}.{asked.name}.npz", f"{maker} {tuple(plain)}")


def made_by(problem: Problem, name: str) -> str | None:
    """Return a digest of the code and the values that a competitor's numbers depend on.

    Args:
        problem: whose it is.
        name: of the competitor.

    Returns:
        None for environments, files, modules and objects of one's own: nobody can say whether they are what they were.
    """
    stands_for = _meaning(problem, name)
    if stands_for is None or problem.name != problem.id:
        return None
    return hashlib.sha256(f"{code_digest()} {stands_for}".encode()).hexdigest()


def _meaning(problem: Problem, name: str) -> str | None:
    """Say what a name stands for, in words that change with it."""
    if name in problem.tuned:
        return json.dumps(problem.tuned_values.values(name.removesuffix("-tuned"))[0])
    if name in shipped_agents(problem.id):
        return hashlib.sha256(pretrained_path(problem.id, name).read_bytes()).hexdigest()
    return name if name in problem.baselines.names else None
