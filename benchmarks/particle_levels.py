"""A Rao-Blackwellised particle filter of UavAutopilot beside ``level-bank``: what the bank's merging loses.

    python benchmarks/particle_levels.py [--episodes 16] [--particles 2000] [--seed 0]

**What it is.** Every particle draws what the scenario ``random`` draws for an episode: levels of the gusts and of the
sensors with the times of their changes, deviation and correlation time of the sensors' coloured errors, and whether
nothing of these happens. The state and the coloured errors it leaves to the Kalman filter that is told these, the
reference ``matched`` (Doucet, de Freitas, Murphy and Russell, "Rao-Blackwellised particle filtering for dynamic
Bayesian networks", UAI 2000). What is drawn never changes in an episode. Where the effective number of particles falls
below half, particles are resampled, and those that are copies get levels that have not begun yet, and their times, from
another draw of the prior: the future is independent of the measurements so far.

**What is compared.** Mean cost of the episodes, each competitor flying its own loop on the same noise, and the paired
difference with its standard error. A particle filter with finitely many particles is worse than exact Bayes; the median
effective number stands beside the costs.
"""

import argparse
import math
from typing import Any

import numpy
from filtergym.baselines.uav_autopilot.references import Matched
from filtergym.envs.contract.draws import Draws
from filtergym.envs.contract.schedules import Steps
from filtergym.envs.engine.backend import make_model
from filtergym.envs.uav_autopilot.level_bank import VAGUE, LevelBank
from filtergym.envs.uav_autopilot.task import TASK
from filtergym.evaluation.running.rollout import rollout
from filtergym.evaluation.running.seeds import episode_seeds


class Particles:
    """The filter, an estimator.

    Args:
        task: with the scenario whose draws it draws.
        particles: for each episode.
        seed: of the draws and of resampling.
    """

    kind = "estimator"

    def __init__(self, task: Any, particles: int, seed: int) -> None:
        self.task, self.count = task, particles
        self.rng = numpy.random.default_rng(seed)
        self.filter = Matched(task)
        self.effective: list[numpy.ndarray] = []

    def _draw(self, N: int) -> Any:
        """Draw truths from the prior, ``(..., particles N)``."""
        world, width = self.task.world, self.count * N
        normals = self.rng.standard_normal((world.initial_normals, width))
        return world.begin(Draws(self.rng.random((self.task.noise.uniforms, width)), numpy), normals)[0]

    def start(self, initial: Any, N: int) -> Any:
        """Draw the particles."""
        truth = self._draw(N)
        tiled = initial._replace(
            **{name: numpy.tile(value, self.count) for name, value in initial._asdict().items()}
        )
        return self.filter.start(tiled, truth), truth, numpy.zeros((self.count, N))

    def update(self, measurement: Any, memory: Any) -> Any:
        """Predict, update and weigh every particle, mix, and resample."""
        before, truth, log_weights = memory
        N = len(measurement.number)
        tiled = type(measurement)(*(numpy.tile(numpy.nan_to_num(value), self.count) for value in measurement))
        truth = truth._replace(
            number=tiled.number,
            level=truth.levels.at(tiled.number, numpy),
            sensor_level=truth.sensor_levels.at(tiled.number, numpy),
        )
        mean, covariance, after, likelihood = self.filter.update(tiled, truth, before)
        log_weights = log_weights + numpy.nan_to_num(likelihood.log_likelihood).reshape(self.count, N)
        weights = numpy.exp(log_weights - log_weights.max(axis=0))
        weights /= weights.sum(axis=0)
        n = len(mean)
        means, spreads = mean.reshape(n, self.count, N), covariance.reshape(n, n, self.count, N)
        centre = (weights * means).sum(axis=1)
        offsets = means - centre[:, None]
        spread = (weights * spreads).sum(axis=2) + numpy.einsum("pk,ipk,jpk->ijk", weights, offsets, offsets)
        effective = 1.0 / (weights**2).sum(axis=0)
        self.effective.append(effective)
        memory = after, truth, log_weights
        if (effective < 0.5 * self.count).any():
            memory = self._resample(memory, weights, effective < 0.5 * self.count)
        return centre, spread, memory

    def _resample(self, memory: Any, weights: numpy.ndarray, poor: numpy.ndarray) -> Any:
        """Systematic resampling of some episodes; copies draw their future anew."""
        after, truth, log_weights = memory
        count, N = weights.shape
        chosen = numpy.tile(numpy.arange(count)[:, None], (1, N))
        for lane in numpy.flatnonzero(poor):
            marks = (self.rng.random() + numpy.arange(count)) / count
            chosen[:, lane] = numpy.minimum(
                numpy.searchsorted(numpy.cumsum(weights[:, lane]), marks), count - 1
            )
        copied = numpy.zeros((count, N), bool)
        copied[1:] = chosen[1:] == chosen[:-1]
        index = (chosen * N + numpy.arange(N)).ravel()
        log_weights = numpy.where(poor, 0.0, log_weights)
        after = type(after)(*(value[..., index] for value in after))
        truth = _choose(truth, index)
        return after, self._future(truth, (copied & poor).ravel(), N), log_weights

    def _future(self, truth: Any, copied: numpy.ndarray, N: int) -> Any:
        """Replace what has not begun, where a fresh draw of the prior agrees that it has not begun either."""
        fresh = self._draw(N)

        def renew(old: Steps, new: Steps, kept: numpy.ndarray) -> Steps:
            values, times = old.values.copy(), old.times.copy()
            for i in range(len(times)):
                open_ = copied & kept & (times[i] > truth.number) & (new.times[i] > truth.number)
                times[i] = numpy.where(open_, new.times[i], times[i])
                values[i + 1] = numpy.where(open_, new.values[i + 1], values[i + 1])
            return Steps(values, times)

        disturbed = (truth.coloured_kick > 0.0).any(axis=0) & (fresh.coloured_kick > 0.0).any(axis=0)
        return truth._replace(
            levels=renew(truth.levels, fresh.levels, disturbed),
            sensor_levels=renew(truth.sensor_levels, fresh.sensor_levels, disturbed),
        )


def _choose(part: Any, index: numpy.ndarray) -> Any:
    """Particles of nested tuples of arrays."""
    if isinstance(part, tuple):
        return type(part)(*(_choose(item, index) for item in part))
    return part[..., index]


def costs(model: Any, competitor: Any, seeds: Any) -> numpy.ndarray:
    """Mean cost of each episode."""
    steps = rollout(model, competitor, seeds, lambda model, episode: model.cost(episode))
    return numpy.asarray(numpy.mean([numpy.array(cost[: len(seeds)]) for cost, _ in steps], axis=0))


def main() -> None:
    """Compare them and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    model = make_model(TASK, "gain", "random", backend="numpy")
    seeds = episode_seeds("test", chosen.seed, chosen.episodes)
    particles = Particles(model.task, chosen.particles, chosen.seed)
    found = {
        "particles": costs(model, particles, seeds),
        "level-bank": costs(model, LevelBank(model.task), seeds),
        "level-bank-vague": costs(model, LevelBank(model.task, VAGUE), seeds),
        "matched": costs(model, Matched(model.task), seeds),
    }
    for name, cost in found.items():
        difference = cost - found["particles"]
        error = difference.std(ddof=1) / math.sqrt(len(seeds))
        print(
            f"{name:18s} cost {cost.mean():.4f}, less that of the particles {difference.mean():+.4f} +- {error:.4f}"
        )
    print(
        f"effective number of particles: median {numpy.median(particles.effective):.0f} of {chosen.particles}"
    )


if __name__ == "__main__":
    main()
