r"""Rao-Blackwellised particles as a check of RadarEsmTracking's exact-Bayes filter.

``python benchmarks/class_particles.py`` runs both on the targets of ``random``, without coloured errors. Every path of
the class (which class, when it changes, to which) has a Kalman filter of its own: nothing is merged and every scan is
an onset. A particle is a path, emitter types, second emitter and rates, all drawn from the distribution of the
scenario, not from a grid; whether the target radiates is filtered given the particle. All of it stays constant in an
episode, so that particles need no resampling: they are weighted by the likelihood of all looks, and by the radar's of
their path.
A. Doucet, N. de Freitas, K. Murphy and S. Russell, Rao-Blackwellised particle filtering for dynamic Bayesian networks,
UAI 2000.

It prints the cost of both, their paired difference with its standard error over episodes, and how far their means are
apart beside how far two runs with particles are: the Monte-Carlo error.
"""

import argparse
import itertools
import math
from typing import Any

import numpy
from filtergym.baselines.problem import problem_of
from filtergym.baselines.radar_esm_tracking.exact_bayes import TRAINING, ExactBayes
from filtergym.envs.engine.backend import make_model
from filtergym.evaluation.running.rollout import rollout
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.filters.class_fusion import bearing_difference

ID = "filtergym/RadarEsmTracking-v0"


class Kept(ExactBayes):
    """The exact-Bayes filter without coloured errors, whose measurements and answers are kept."""

    def __init__(self, task: Any) -> None:
        super().__init__(task, TRAINING, coloured=0.0)
        self.initial: Any = None
        self.steps: list[Any] = []

    def start(self, initial: Any) -> Any:
        """Start it."""
        self.initial = initial
        return super().start(initial)

    def update(self, state: Any, given: Any) -> Any:
        """Ask it."""
        found = super().update(state, given)
        self.steps.append((given.measurement, found.mean, found.covariance))
        return found


def class_paths(p: Any, scans: int) -> list[tuple[int, int, int]]:
    """First class, scan of the change and next class; a change beyond the last scan is none."""
    S, T = range(len(p.manoeuvrability)), p.sampling_interval
    first, last = math.ceil(p.class_change[0] / T) + 1, math.ceil(p.class_change[1] / T)
    changes = [(a, c, b) for c in range(first, last + 1) for a, b in itertools.product(S, S) if a != b]
    return [*((s, scans + 1, s) for s in S), *changes]


def radar_paths(kept: Kept, paths: Any, lane: int) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Log-likelihoods ``(T, paths)`` and means ``(T, 3, paths)`` of all Kalman filters."""
    models, start = kept.task.design_models(kept.parameters)
    first, change, following = numpy.array(paths).T
    x = numpy.repeat(kept.initial.mean[:, lane, None], len(paths), axis=1)
    P = numpy.moveaxis(start[..., first], -1, 0)
    total, logs, means = numpy.zeros(len(paths)), [], []
    for k, (measurement, _, _) in enumerate(kept.steps, 1):
        governed = numpy.where(k - 1 >= change, following, first)
        F = numpy.moveaxis(models.Phi[..., governed], -1, 0)
        x = numpy.einsum("hij,jh->ih", F, x)
        P = F @ P @ numpy.swapaxes(F, 1, 2) + numpy.moveaxis(models.Q[..., governed], -1, 0)
        S = P[:, :2, :2] + models.R
        nu = measurement.radar[:, lane, None] - x[:2]
        K = numpy.swapaxes(numpy.linalg.solve(S, P[:, :2]), 1, 2)
        distance = numpy.einsum("ih,hij,jh->h", nu, numpy.linalg.inv(S), nu)
        total = total - 0.5 * (distance + numpy.log(numpy.linalg.det(S)))
        x = x + numpy.einsum("hij,jh->ih", K, nu)
        P = P - K @ P[:, :2]
        logs.append(total)
        means.append(x)
    return numpy.array(logs), numpy.array(means)


class Particles:
    """Draws of all but the radar."""

    def __init__(self, kept: Kept, paths: Any, count: int, rng: Any) -> None:
        p, self.task = kept.parameters, kept.task
        calm = rng.random(count) < p.undisturbed
        changes = ~calm & (rng.random(count) < p.class_change_probability)
        S, several = len(p.manoeuvrability), len(paths) - len(p.manoeuvrability)
        # All changes are equally probable, as first classes are and who has none of them.
        self.path = numpy.where(changes, S + rng.integers(0, several, count), rng.integers(0, S, count))
        first, self.change, following = numpy.array(paths)[self.path].T
        composition = numpy.array(p.composition).cumsum(axis=1)[:, :-1]

        def types_of(classes: numpy.ndarray) -> numpy.ndarray:
            return numpy.asarray((rng.random(count) >= composition[classes].T).sum(axis=0))

        self.types = types_of(first), types_of(following)
        self.other = types_of((first + rng.integers(1, S, count)) % S)
        side = numpy.where(rng.random(count) < 0.5, 1.0, -1.0)
        self.separation = side * rng.uniform(*p.second_emitter_separation, count)
        self.q = numpy.where(calm, 0.0, rng.uniform(*p.second_emitter_probability, count))
        self.f = numpy.where(calm, 0.0, rng.uniform(*p.silence_start, count))
        self.g = numpy.where(calm, 1.0, rng.uniform(*p.silence_end, count))
        self.radiates = self.g / (self.f + self.g)
        self.recognition = numpy.array(p.recognition)
        self.deviation = math.hypot(p.radar_bearing_sigma, p.esm_bearing_sigma)
        self.log_weight = numpy.zeros(count)

    def listen(self, scan: int, decision: int, apart: float) -> None:
        """Take in a look."""
        if scan:
            self.radiates = (1.0 - self.f) * self.radiates + self.g * (1.0 - self.radiates)
        q, r = self.q, self.radiates
        if decision == len(self.recognition):
            likelihood, self.radiates = (1.0 - q) * (1.0 - r), 0.0 * r
        else:
            now = numpy.where(scan >= self.change, self.types[1], self.types[0])
            offsets = bearing_difference(apart + self.separation, 0.0) / self.deviation
            other = q * self.recognition[self.other, decision] * numpy.exp(-0.5 * offsets**2)
            own = self.recognition[now, decision] * math.exp(-0.5 * (apart / self.deviation) ** 2)
            likelihood = other + (1.0 - q) * r * own
            self.radiates = r * (other + (1.0 - q) * own) / numpy.maximum(likelihood, 1e-300)
        self.log_weight += numpy.log(numpy.maximum(likelihood, 1e-300))


def particle_means(kept: Kept, paths: Any, lane: int, count: int, seed: int) -> numpy.ndarray:
    """Estimates of one episode, ``(T, 3)``."""
    particles = Particles(kept, paths, count, numpy.random.default_rng([seed, lane]))
    logs, states = radar_paths(kept, paths, lane)
    first = kept.initial.first
    particles.listen(0, int(first.decision[lane]), float(first.bearing_difference[lane]))
    means = []
    for k, (measurement, _, _) in enumerate(kept.steps, 1):
        if measurement.looked[lane]:
            particles.listen(k, int(measurement.decision[lane]), float(measurement.bearing_difference[lane]))
        log_weight = particles.log_weight + logs[k - 1][particles.path]
        weights = numpy.exp(log_weight - log_weight.max())
        of_path = numpy.bincount(particles.path, weights, len(paths))
        means.append(states[k - 1] @ (of_path / of_path.sum()))
    return numpy.array(means)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--episodes", type=int, default=48)
    parser.add_argument("--particles", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    model = make_model(problem_of(ID).task, None, "random", backend="numpy", radar_coloured=(0.0, 0.0))
    kept, truth = Kept(model.task), []

    def state(model: Any, episode: Any) -> numpy.ndarray:
        return numpy.asarray(model.task.world.state(episode.truth))

    for chunk, _ in rollout(model, kept, episode_seeds("validation", asked.seed, asked.episodes), state):
        truth.append(chunk[..., : asked.episodes])
    p, lanes = model.task.parameters, range(asked.episodes)
    paths = class_paths(p, len(kept.steps))
    gaussian = numpy.array([mean for _, mean, _ in kept.steps])[..., : asked.episodes]
    covariance = numpy.array([P for _, _, P in kept.steps])[..., : asked.episodes]
    runs = [
        numpy.stack([particle_means(kept, paths, lane, asked.particles, seed) for lane in lanes], axis=-1)
        for seed in (1, 2)
    ]
    scales = numpy.array([p.range_scale, p.range_rate_scale, p.acceleration_scale])[:, None]

    def costs(means: numpy.ndarray) -> numpy.ndarray:
        return (((means - numpy.array(truth)) / scales) ** 2).mean(axis=(0, 1))

    def apart(one: numpy.ndarray, other: numpy.ndarray) -> float:
        difference = numpy.moveaxis(one - other, 1, -1)[..., None]
        P = numpy.moveaxis(covariance, -1, 1)
        return float((numpy.swapaxes(difference, -1, -2) @ numpy.linalg.solve(P, difference)).mean())

    ours, theirs = costs(gaussian), costs(0.5 * (runs[0] + runs[1]))
    paired = ours - theirs
    error = paired.std(ddof=1) / math.sqrt(len(paired))
    print(f"{asked.episodes} episodes, 2 x {asked.particles} particles, {len(paths)} class paths")
    print(f"cost: exact-bayes {ours.mean():.5f}, particles {theirs.mean():.5f}")
    print(f"exact-bayes - particles: {paired.mean():+.5f}, standard error {error:.5f}")
    print("mean squared distance of the means, in units of the covariance (an error's is 3):")
    print(f"  exact-bayes to particles {apart(gaussian, numpy.mean(runs, axis=0)):.5f}")
    print(f"  two runs with particles {apart(*runs):.5f}")


if __name__ == "__main__":
    main()
