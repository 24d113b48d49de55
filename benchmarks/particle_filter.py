r"""A Rao-Blackwellised particle filter as a check of ManeuveringTarget's semi-Markov Gaussian sum.

``python benchmarks/particle_filter.py`` runs both on the flights of ``random`` with scans on time. A particle is a
sequence of modes (straight, thrust, turn; when each began and ended) that is drawn, with a Kalman filter of position
and velocity given it; nothing is merged, manoeuvres last uniformly from 3 to 12 scans, and accelerations are drawn from
their own uniform prior: each particle's thrust or turn rate has a narrow Gaussian of deviation ``KERNEL`` about its
draw, which its filter then estimates. Manoeuvres are proposed ``PROPOSED`` times a scan and weighted back. A. Doucet,
N. de Freitas, K. Murphy and S. Russell, Rao-Blackwellised particle filtering for dynamic Bayesian networks, UAI 2000.

It prints the cost of both, their paired difference with its standard error over episodes, and how far their means are
apart beside how far two runs of the particle filter are: the Monte-Carlo error.
"""

import argparse
from typing import Any

import numpy
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.filter import Input
from filtergym.envs.engine.backend import make_model
from filtergym.evaluation.running.rollout import rollout
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.filters import coordinated_turn
from filtergym.filters.small_matrices import product, transpose

ID = "filtergym/ManeuveringTarget-v0"
BEGIN, TURNING, DURATIONS = 0.0157, 0.5, (3, 12)
ACCELERATIONS, SLOWEST = (0.5, 6.0), 30.0
KERNEL, PROPOSED = 0.3, 0.1
STRAIGHT, THRUST, TURN = 0, 1, 2


class ParticleFilter:
    """Particles of one episode: state (position, velocity, thrust or turn rate and zero), batch last.

    Args:
        initial: mean ``(4,)`` and covariance ``(4, 4)``.
        count: of particles.
        rng: random numbers.
    """

    def __init__(self, mean: numpy.ndarray, covariance: numpy.ndarray, count: int, rng: Any) -> None:
        self.rng, self.count = rng, count
        self.x = numpy.zeros((6, count))
        self.P = numpy.zeros((6, 6, count))
        self.x[:4], self.P[:4, :4] = mean[:, None], covariance[..., None]
        self.kind, self.left = numpy.full(count, STRAIGHT), numpy.zeros(count)
        self.log_weight = numpy.zeros(count)

    def switch(self) -> None:
        """Let manoeuvres end whose time is over, and propose others."""
        rng, N = self.rng, self.count
        over = (self.kind != STRAIGHT) & (self.left == 0)
        self.kind[over] = STRAIGHT
        begin = (self.kind == STRAIGHT) & (rng.random(N) < PROPOSED)
        rest = (self.kind == STRAIGHT) & ~begin
        self.log_weight[begin] += numpy.log(BEGIN / PROPOSED)
        self.log_weight[rest] += numpy.log((1.0 - BEGIN) / (1.0 - PROPOSED))
        turning = begin & (rng.random(N) < TURNING)
        thrusting = begin & ~turning
        self.kind[turning], self.kind[thrusting] = TURN, THRUST
        self.left[begin] = rng.integers(DURATIONS[0], DURATIONS[1] + 1, N)[begin]
        anew = over | begin
        self.x[4:, anew] = 0.0
        self.P[4:, :, anew] = self.P[:, 4:, anew] = 0.0
        size, direction = rng.uniform(*ACCELERATIONS, N), rng.uniform(0.0, 2.0 * numpy.pi, N)
        pace = numpy.maximum(numpy.hypot(self.x[2], self.x[3]), SLOWEST)
        vector = size * numpy.stack([numpy.cos(direction), numpy.sin(direction)])
        self.x[4:, thrusting] = vector[:, thrusting]
        for i in (4, 5):
            self.P[i, i, thrusting] = KERNEL**2
        self.x[4, turning] = (numpy.where(direction < numpy.pi, 1.0, -1.0) * size / pace)[turning]
        self.P[4, 4, turning] = ((KERNEL / pace) ** 2)[turning]
        self.left[self.kind != STRAIGHT] -= 1

    def predict(self, T: float) -> None:
        """Fly on in every particle's mode."""
        F = numpy.zeros((6, 6, self.count))
        for i in range(6):
            F[i, i] = 1.0
        for i in (0, 1):
            F[i, i + 2] = T
            F[i, i + 4], F[i + 2, i + 4] = (numpy.where(self.kind == THRUST, v, 0.0) for v in (T**2 / 2, T))
        moved = numpy.einsum("ijn,jn->in", F, self.x)
        turning = self.kind == TURN
        F[:5, :5, turning] = coordinated_turn.jacobian(self.x[:5, turning], T)
        moved[:5, turning] = coordinated_turn.propagate(self.x[:5, turning], T)
        self.x, self.P = moved, product(product(F, self.P), transpose(F))

    def update(self, z: numpy.ndarray, variance: numpy.ndarray) -> None:
        """Take in a measured position."""
        for i in range(2):  # independent errors: one after the other
            S = self.P[i, i] + variance[i]
            innovation, gain = z[i] - self.x[i], self.P[:, i] / S
            self.log_weight -= 0.5 * (innovation**2 / S + numpy.log(S))
            self.x = self.x + gain * innovation
            self.P = self.P - gain[:, None] * self.P[i][None]
        self.log_weight -= self.log_weight.max()

    @property
    def weights(self) -> numpy.ndarray:
        """Of the particles, summing to one."""
        weights = numpy.exp(self.log_weight)
        return weights / weights.sum()

    def moments(self) -> tuple[numpy.ndarray, numpy.ndarray]:
        """Mean and covariance of position and velocity."""
        weights = self.weights
        mean = self.x[:4] @ weights
        difference = self.x[:4] - mean[:, None]
        spread = (weights * difference) @ difference.T
        return mean, self.P[:4, :4] @ weights + spread

    def resample(self) -> None:
        """Draw systematically where fewer than half of the particles count."""
        weights = self.weights
        if 1.0 / (weights**2).sum() > 0.5 * self.count:
            return
        places = (numpy.arange(self.count) + self.rng.random()) / self.count
        chosen = numpy.minimum(numpy.searchsorted(numpy.cumsum(weights), places), self.count - 1)
        self.x, self.P = self.x[:, chosen], self.P[:, :, chosen]
        self.kind, self.left = self.kind[chosen], self.left[chosen]
        self.log_weight = numpy.zeros(self.count)


class Watched:
    """An estimator whose measurements and answers are kept."""

    def __init__(self, estimator: Any) -> None:
        self.estimator = estimator
        self.initial: Any = None
        self.measurements: list[Any] = []
        self.answers: list[tuple[numpy.ndarray, numpy.ndarray]] = []

    def start(self, initial: Any, N: int) -> Any:
        """Start it."""
        self.initial = initial
        return self.estimator.start(initial)

    def update(self, measurement: Any, memory: Any) -> Any:
        """Ask it."""
        memory = self.estimator.step(memory, Input(measurement))
        mean, covariance = self.estimator.mean(memory), self.estimator.covariance(memory)
        self.measurements.append(measurement)
        self.answers.append((mean, covariance))
        return mean, covariance, memory


def particle_means(watched: Watched, episode: int, count: int, seed: int) -> numpy.ndarray:
    """Estimates of one episode, ``(T, 4)``."""
    initial, means = watched.initial, []
    rng = numpy.random.default_rng([seed, episode])
    found = ParticleFilter(initial.mean[:, episode], initial.covariance[..., episode], count, rng)
    for m in watched.measurements:
        found.switch()
        found.predict(m.interval[episode])
        if m.available[episode]:
            found.update(m.position[:, episode], m.variance[:, episode])
        means.append(found.moments()[0])
        found.resample()
    return numpy.array(means)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--particles", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    problem = problem_of(ID)
    model = make_model(
        problem.task,
        None,
        "random",
        backend="numpy",
        detection_probability=(0.8, 1.0),
        scan_jitter=(0.0, 0.0),
    )
    watched = Watched(problem.competitor("semi-markov")(model.task))
    seeds, states = episode_seeds("validation", asked.seed, asked.episodes), []

    def state(model: Any, episode: Any) -> numpy.ndarray:
        return model.task.world.state(episode.truth)

    for chunk, _ in rollout(model, watched, seeds, state):
        states.append(chunk[..., : asked.episodes])
    truth = numpy.array(states)
    gaussian = numpy.array([mean for mean, _ in watched.answers])[..., : asked.episodes]
    covariance = numpy.array([P for _, P in watched.answers])[..., : asked.episodes]
    runs = [
        numpy.stack(
            [particle_means(watched, b, asked.particles, seed) for b in range(asked.episodes)], axis=-1
        )
        for seed in (1, 2)
    ]
    particles = 0.5 * (runs[0] + runs[1])

    def costs(means: numpy.ndarray) -> numpy.ndarray:
        error = (means - truth)[:, :2] / model.task.parameters.range_sigma
        return (error**2).sum(axis=1).mean(axis=0)

    def apart(one: numpy.ndarray, other: numpy.ndarray) -> float:
        difference = numpy.moveaxis(one - other, 1, -1)[..., None]
        P = numpy.moveaxis(covariance, -1, 1)
        return float((numpy.swapaxes(difference, -1, -2) @ numpy.linalg.solve(P, difference)).mean())

    ours, theirs = costs(gaussian), costs(particles)
    paired = ours - theirs
    error = paired.std(ddof=1) / numpy.sqrt(len(paired))
    print(f"{asked.episodes} episodes, 2 x {asked.particles} particles")
    print(f"cost: semi-markov {ours.mean():.3f}, particles {theirs.mean():.3f}")
    print(f"semi-markov - particles: {paired.mean():+.3f}, standard error {error:.3f}")
    print("mean squared distance of the means, in units of the covariance (an error's is 4):")
    print(f"  semi-markov to particles {apart(gaussian, particles):.3f}")
    print(f"  two runs of the particle filter {apart(*runs):.3f}")


if __name__ == "__main__":
    main()
