"""Seeds of episodes, in three splits (train, validation, test) without common seeds."""

import numpy

from ...envs.contract.parameters import check_integer
from ...envs.engine.catalogue import nearest

SPLITS = {"train": 0, "validation": 1, "test": 2}


def episode_seeds(split: str, seed: int, episodes: int, first: int = 0) -> list[int]:
    """Return the seeds of an experiment's episodes; ``env.reset(seed=...)`` replays each.

    Args:
        split: "train", "validation" or "test".
        seed: seed of the experiment; different seeds have no episode in common.
        episodes: number of episodes.
        first: number of episodes to skip.

    Raises:
        ValueError: for an unknown split, a seed below zero, or fewer episodes than one.
    """
    if not isinstance(split, str) or split not in SPLITS:
        raise nearest("split", split, SPLITS)
    episodes = check_integer("episodes", episodes, 1)
    seed = check_integer("seed", seed, 0)
    sequence = numpy.random.SeedSequence([SPLITS[split], seed])
    words = sequence.generate_state(first + episodes, numpy.uint64)
    return [int(word) for word in words[first:]]
