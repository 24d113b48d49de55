"""What is done of long work waits in files, so that the same command goes on after whatever ended it."""

import functools
import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

from ..agents.learned_policy import pretrained_path
from ..agents.named_policies import shipped_agents
from ..baselines.catalogue import baselines_of
from ..baselines.tuning import stored_values, tuned_names
from ..envs.catalogue import short_name, task_class
from ..evaluation.summary import Asked, Kept
from .results import settings_of

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
        None for files, modules and objects of one's own: nobody can say whether they are what they were.
    """
    id = task_class(asked.environment).id
    stands_for = _meaning(id, asked.name)
    if stands_for is None:
        return None
    plain = asked._replace(maker=None, metrics=None)
    made_by = f"{_versions()} {tuple(plain)} {stands_for}"
    stem = stem_of(id, asked.scenario, asked.episodes, asked.split, asked.seed)
    return Kept(folder / f"{stem}.{asked.name}.npz", made_by)


@functools.cache
def _versions() -> dict[str, str]:
    return settings_of("").versions


def _meaning(id: str, name: str) -> str | None:
    """Say what a name stands for, in words that change with it."""
    if name in tuned_names(id):
        return json.dumps(stored_values(id, name.removesuffix("-tuned"))[0])
    if name in shipped_agents(id):
        return hashlib.sha256(pretrained_path(id, name).read_bytes()).hexdigest()
    return name if name in baselines_of(id).names else None
