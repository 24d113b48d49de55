"""A Rao-Blackwellised particle filter of LooselyCoupledNavigation beside ``fault-bank``: what the bank's merging loses.

    python benchmarks/particle_bank.py [--episodes 40] [--particles 2000] [--seed 0]

**What it is.** Every particle draws what the scenario ``random`` draws for an episode, levels of the INS, changes of
the receiver's noise, its coloured error's level and correlation time, jamming, and onset and end of the spoofing, from
the same distributions; the rate of the pull and the errors of INS and receiver it leaves to a Kalman filter (Doucet, de
Freitas, Murphy and Russell, "Rao-Blackwellised particle filtering for dynamic Bayesian networks", UAI 2000). What is
drawn never changes in an episode, so this is importance sampling: nothing is resampled, no particle is an
approximation, and the posterior mean is exact but for the number of particles (and for what a change of the report says
by itself, which neither filter weighs). How many of them carry the weight (the effective number) stands beside the
costs: where it is small, the filter is worse than exact Bayes.

**What is compared.** Mean cost of the episodes, and the paired difference with its standard error.
"""

import argparse
import math
from typing import Any

import numpy
from filtergym.baselines.loosely_coupled_navigation.references import Matched
from filtergym.envs.contract.draws import Draws
from filtergym.envs.contract.schedules import Steps, within
from filtergym.envs.engine.backend import make_model
from filtergym.envs.loosely_coupled_navigation.fault_bank import FaultBank
from filtergym.envs.loosely_coupled_navigation.task import TASK
from filtergym.envs.loosely_coupled_navigation.world import Truth
from filtergym.evaluation.running.rollout import rollout
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.filters import receiver_faults
from filtergym.filters.loosely_coupled import AugmentedCovariance


class Particles:
    """The filter, an estimator of one axis.

    Args:
        task: with the scenario whose draws it draws.
        particles: for each episode.
        seed: of the draws.
    """

    kind = "estimator"

    def __init__(self, task: Any, particles: int, seed: int) -> None:
        self.task, self.count, self.seed = task, particles, seed
        self.effective: list[numpy.ndarray] = []

    def _drawn(self, N: int) -> Truth:
        """Draws of as many episodes as there are particles, ``(..., particles N)``."""
        world, rng, width = self.task.world, numpy.random.default_rng(self.seed), self.count * N
        normals = rng.standard_normal((world.initial_normals, width))
        return world.begin(Draws(rng.random((self.task.noise.uniforms, width)), numpy), normals)[0]

    def start(self, initial: Any, N: int) -> Any:
        """Draw the particles."""
        truth, s = self._drawn(N), self.task.parameters.sampling
        zero = 0.0 * truth.number
        coloured = truth.coloured_step / s.coloured
        ins = AugmentedCovariance(zero, zero, zero, truth.drift_deviation**2, zero, coloured**2)
        low, high = self.task.parameters.spoofing_rate
        variance = zero + (high - low) ** 2 / 12.0
        wandering = truth.receiver_kick**2 / (1.0 - truth.receiver_decay**2)
        P = receiver_faults.FaultCovariance(ins, numpy.zeros((3, 1, len(zero))), wandering[None, None])
        return numpy.zeros((5, len(zero))), receiver_faults.add_fault(P, variance), zero, truth

    def update(self, measurement: Any, memory: Any) -> Any:
        """Predict and update every particle, weigh it, and mix."""
        (delta, drift, eta, error, rate), P, log_weights, truth = memory
        s, N = self.task.parameters.sampling, len(measurement.number)
        number, available, ins, fix = (
            numpy.tile(values, self.count)
            for values in (measurement.number, measurement.available, measurement.ins[0], measurement.fix[0])
        )
        delta = delta + s.step * drift + s.drive * eta
        eta = s.decay * eta
        error = truth.receiver_decay * error
        decay = numpy.stack([truth.receiver_decay, numpy.ones(len(number))])
        gained = numpy.stack([truth.receiver_kick**2, numpy.zeros(len(number))])
        P = receiver_faults.predict_fault(P, s, truth.coloured_step**2, truth.white_step**2, decay, gained)
        deviation, reported = (
            Steps(level, truth.change).at(number, numpy)
            for level in (truth.receiver_levels, truth.reported_levels)
        )
        deviation = numpy.where(within(number, truth.jamming), truth.jamming_gain * deviation, deviation)
        h = numpy.where(within(number, truth.spoofing), s.step * (number - truth.spoofing[0] + 1.0), 0.0)
        along = receiver_faults.measured_direction(P, numpy.stack([numpy.ones(len(h)), h]))
        # Reading: levels are taken over what is reported; that a report changes, or does not, weighs no particle.
        deviation = deviation * numpy.tile(measurement.reported_deviation, self.count) / reported
        S = along.variance + deviation**2
        nu = numpy.where(available > 0, ins - numpy.nan_to_num(fix) - (delta - error - h * rate), 0.0)
        log_weights = log_weights - 0.5 * available * (nu**2 / S + numpy.log(2.0 * math.pi * S))
        step = available * nu / S
        mean = numpy.stack(
            [
                value + part * step
                for value, part in zip(
                    (delta, drift, eta, error, rate), (*along[:3], *along.faults), strict=True
                )
            ]
        )
        P = receiver_faults.update_fault(P, along, available / S)
        each = log_weights.reshape(self.count, N)
        weights = numpy.exp(each - each.max(axis=0))
        weights /= weights.sum(axis=0)
        self.effective.append(1.0 / (weights**2).sum(axis=0))
        errors = mean[0].reshape(self.count, N)
        centre = (weights * errors).sum(axis=0)
        spread = (weights * (P.ins.position.reshape(self.count, N) + (errors - centre) ** 2)).sum(axis=0)
        return measurement.ins - centre, spread[None, None], (mean, P, log_weights, truth)


def costs(model: Any, competitor: Any, seeds: Any) -> numpy.ndarray:
    """Mean cost of each episode."""
    steps = rollout(model, competitor, seeds, lambda model, episode: model.cost(episode))
    return numpy.mean([numpy.array(cost[: len(seeds)]) for cost, _ in steps], axis=0)


def main() -> None:
    """Compare them and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    model = make_model(TASK, "gain", "random", backend="numpy")
    seeds = episode_seeds("test", chosen.seed, chosen.episodes)
    particles = Particles(model.task, chosen.particles, chosen.seed)
    found = {
        "particles": costs(model, particles, seeds),
        "fault-bank": costs(model, FaultBank(model.task), seeds),
        "matched": costs(model, Matched, seeds),
    }
    for name, cost in found.items():
        difference = cost - found["particles"]
        error = difference.std() / math.sqrt(len(seeds))
        print(
            f"{name:12s} cost {cost.mean():.5f}, less that of the particles {difference.mean():+.5f} +- {error:.5f}"
        )
    effective = numpy.array(particles.effective)[-1]
    print(
        f"effective number of particles at the end: median {numpy.median(effective):.1f} of {chosen.particles}"
    )


if __name__ == "__main__":
    main()
