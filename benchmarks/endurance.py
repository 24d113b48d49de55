"""Endurance test under random actions: every step of every environment, control and scenario is checked.

    python benchmarks/endurance.py [--environment ID] [--steps N] [--size N] [--seed S]

**Checks.** Observations and rewards of the vector environment and the estimator's covariance after every
step (``decision_interval`` 1): is everything finite, and is the covariance, scaled to correlations, positive
semidefinite to 1e-9 (every tenth step)? Half of the actions lie on the edge of the action space, where an estimator is
steered hardest. ``--steps`` are shared evenly among the combinations of an environment. Steps that fail are counted,
their combinations are printed, and the command exits with status 1.
"""

import argparse
import os
import sys
import time
from collections import Counter
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

import gymnasium
import numpy
from rich.console import Console
from rich.progress import track
from rich.table import Table

from filtergym.envs.engine.catalogue import catalogue

CHECKED_EVERY = 10
"""Steps between two checks of the covariances' eigenvalues."""


def actions(space: gymnasium.Space, generator: numpy.random.Generator, size: int) -> numpy.ndarray:
    """Return ``size`` random actions, half of the continuous ones on the edge of the space."""
    if isinstance(space, gymnasium.spaces.Discrete):
        return generator.integers(space.n, size=size)
    assert isinstance(space, gymnasium.spaces.Box)
    shape = (size, *space.shape)
    edge = generator.choice([space.low, space.high], size=size)
    inside = generator.uniform(space.low, space.high, shape)
    on_edge = generator.random((size, 1)) < 0.5
    return numpy.where(on_edge, edge, inside).astype(space.dtype)


def count_indefinite(covariance: numpy.ndarray) -> int:
    """Return the number of covariances ``(n, n, N)`` that, scaled to correlations, have an eigenvalue below -1e-9."""
    P = numpy.moveaxis(covariance[:, :, numpy.isfinite(covariance).all((0, 1))], -1, 0)
    sigma = numpy.sqrt(numpy.maximum(numpy.einsum("nii->ni", P), 1e-300))
    correlations = P / sigma[:, :, None] / sigma[:, None, :]
    try:  # a quarter of the time of the eigenvalues
        numpy.linalg.cholesky(correlations + 1e-9 * numpy.eye(len(covariance)))
    except numpy.linalg.LinAlgError:
        return int((numpy.linalg.eigvalsh(correlations)[:, 0] < -1e-9).sum())
    return 0


def endure(
    id: str, control: str, scenario: str, steps: int, size: int, seed: int
) -> tuple[int, dict[str, int]]:
    """Step an environment under random actions; return the number of steps, and counts of failures by kind."""
    env: Any = gymnasium.make_vec(
        id, num_envs=size, control=control, scenario=scenario, decision_interval=1
    ).unwrapped
    generator = numpy.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    done, failed = 0, dict.fromkeys(("not finite", "lost covariances"), 0)
    while done < steps:
        observation, reward, *_ = env.step(actions(env.single_action_space, generator, size))
        done += size
        covariance = env.model.covariance(env.fleet.only.state)
        finite = numpy.isfinite(observation).all(-1) & numpy.isfinite(reward)
        finite &= numpy.isfinite(covariance).all((0, 1))
        failed["not finite"] += int((~finite).sum())
        if done // size % CHECKED_EVERY == 0:
            failed["lost covariances"] += count_indefinite(covariance)
    return done, failed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--environment", choices=sorted(catalogue()), help="default: all of them")
    parser.add_argument("--steps", type=int, default=1_000_000, help="of each environment")
    parser.add_argument("--size", type=int, default=1024, help="environments side by side")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    table = Table("environment", "combinations", "steps", "minutes", "not finite", "lost covariances")
    failures: list[str] = []
    for id, cls in catalogue().items():
        if given.environment not in (None, id):
            continue
        combinations = [(control, scenario) for control in cls.controls for scenario in cls.scenarios]
        share = given.steps / len(combinations)
        began, done, counts = time.monotonic(), 0, Counter[str]()
        for control, scenario in track(combinations, id, console=Console(stderr=True), transient=True):
            steps, failed = endure(id, control, scenario, share, given.size, given.seed)
            done += steps
            counts.update(failed)
            if any(failed.values()):
                failures.append(f"{id}, control {control}, scenario {scenario}, seed {given.seed}: {failed}")
        minutes = (time.monotonic() - began) / 60.0
        counted = [f"{counts[way]:,}" for way in ("not finite", "lost covariances")]
        table.add_row(id, str(len(combinations)), f"{done:,}", f"{minutes:.1f}", *counted)
    console = Console(width=110)
    console.print(table)
    for line in failures:
        console.print(line, style="red")
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
