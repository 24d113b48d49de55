"""Nothing can be recited: who knows the clock, the initial estimate and the training distribution, but no measurement,
costs more than the paper's algorithm, in every environment.
"""

import numpy as np
import pytest

from filtergym import evaluate
from filtergym.baselines.catalogue import baselines_of

TRAINING_EPISODES, EPISODES = 200, 64
ROUNDS = 1
"""Times that a truth is learned which depends on who steers: flown by the paper's algorithm, then by the reciter."""
SIGNIFICANT = 3.0
"""Standard errors over the episodes."""


class Held:
    """An estimator that stays with the initial estimate."""

    kind = "estimator"

    def start(self, initial, N):
        return initial.mean, initial.covariance

    def update(self, memory, measurement):
        return *memory, memory


class Recited:
    """An estimator that returns at each time the expected truth, linear in the initial estimate.

    Args:
        coefficients: ``(K, 1 + C, C)``, of one and of the initial estimate.
        variance: of what remains, ``(K, C)``.
    """

    kind = "estimator"

    def __init__(self, coefficients, variance):
        self.coefficients, self.variance = coefficients, variance

    def start(self, initial, N):
        return 0, np.concatenate([np.ones((1, N)), initial.mean])

    def update(self, memory, measurement):
        k, given = memory
        mean = self.coefficients[k].T @ given
        covariance = np.repeat(np.diag(self.variance[k])[..., None], given.shape[-1], axis=-1)
        return mean, covariance, (k + 1, given)


def learn(truth, initial):
    """Regress the truth at every time ``(episodes, K, C)`` on one and the initial estimate ``(episodes, C)``."""
    episodes, K, C = truth.shape
    # Units differ by orders of magnitude; a component that is always the same is not compared.
    centre, spread = initial.mean(axis=0), initial.std(axis=0)
    scale = np.where(spread > 1e-9 * (1.0 + np.abs(centre)), spread, np.inf)
    design = np.concatenate([np.ones((episodes, 1)), (initial - centre) / scale], axis=1)
    found = np.linalg.lstsq(design, truth.reshape(episodes, -1), rcond=None)[0]
    variance = (truth.reshape(episodes, -1) - design @ found).var(axis=0).reshape(K, C)
    found = np.moveaxis(found.reshape(1 + C, K, C), 1, 0)
    slopes = found[:, 1:] / scale[:, None]
    constant = found[:, :1] - (centre @ slopes)[:, None]
    return Recited(np.concatenate([constant, slopes], axis=1), variance + 1e-9 * (1.0 + variance.mean()))


def reciters(env_id, paper):
    """Reciters learned from training episodes; several where the truth is another for each competitor that steers."""
    flown = evaluate(
        env_id, {"held": Held, paper: paper}, "random", TRAINING_EPISODES, split="train", tracks=True
    )
    initial = flown["estimate"].sel(policy="held").values[:, 0]
    truths = flown["truth"].values
    found = [learn(truths[1], initial)]
    if not np.array_equal(*truths):  # a closed loop
        found.append(learn(truths[0], initial))
        for _ in range(ROUNDS):
            again = evaluate(
                env_id, {"recited": found[-1]}, "random", TRAINING_EPISODES, split="train", tracks=True
            )
            found.append(learn(again["truth"].values[0], initial))
    return {f"recited-{i}": each for i, each in enumerate(found)}


@pytest.mark.claims
def test_a_recited_truth_scores_below_zero(env_id):
    paper = baselines_of(env_id).score_paper
    recited = reciters(env_id, paper)
    costs = evaluate(env_id, {paper: paper, **recited}, "random", EPISODES)["cost"].mean("time")
    for name in recited:
        difference = (costs.sel(policy=name) - costs.sel(policy=paper)).values
        errors = difference.mean() / (difference.std(ddof=1) / np.sqrt(EPISODES))
        assert errors > SIGNIFICANT, (name, errors, costs.mean("episode").values)


def test_what_is_regular_is_recited():
    """The regression finds a motion that follows from the clock and the start: the test above can fail."""
    generator = np.random.default_rng(0)
    start = generator.normal([1e5, 0.0, 3.0], [100.0, 1.0, 0.0], (200, 3))
    times = np.arange(1, 6)[:, None]
    turn = np.array([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]])
    truth = (start @ turn)[:, None] + np.sin(times) * np.array([10.0, 1.0, 0.0])
    recited = learn(truth, start)
    memory = recited.start(type("Initial", (), {"mean": start.T}), 200)
    for k in range(5):
        mean, covariance, memory = recited.update(memory, None)
        # Sums of some 1e5 in least squares over 200 rows.
        np.testing.assert_allclose(mean.T, truth[:, k], rtol=1e-9, atol=1e-6)
        assert (np.diagonal(covariance) > 0.0).all()
