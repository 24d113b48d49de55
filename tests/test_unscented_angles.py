"""The unscented filter beside sensors of angles, at every spread, against particles and the truths that were drawn."""

import numpy as np
import pytest

import filtergym
from filtergym import Sensor

NOISE = 0.2
COMMON = {"mean": [0.5, 0.0], "covariance": np.eye(2)}
VARIANCES = [1e-4, 1e-2, 1.0, 10.0, 100.0]


def model(make, n, sensors, mean):
    """A state that rests."""
    rest = lambda x: [x[i] for i in range(n)]  # noqa: E731
    return make(f=rest, Q=1e-9 * np.eye(n), sensors=sensors, mean=mean, covariance=np.eye(n))


def update(cls, name, means, covariances, **values):
    """Estimates after one measurement of many tracks."""
    live = filtergym.online(cls.id, name, tracks=means.shape[-1])
    live.start(mean=means, covariance=covariances)
    return live.update(**values)


def wrapped(angle, turn=2.0 * np.pi):
    return (angle + 0.5 * turn) % turn - 0.5 * turn


COMPASSES = {
    "matrix": lambda n: np.eye(n)[:1],
    "function": lambda n: lambda x: [x[0] - 0.25 * x[1] ** 2],
    "wrapped": lambda n: lambda x: [np.arctan2(np.sin(x[0]), np.cos(x[0]))],
}


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("n", [2, 9])
@pytest.mark.parametrize("kind", COMPASSES)
def test_a_heading_that_is_measured_is_known_at_any_spread(make, kind, n, unit):
    """Beside 20,000 particles on the circle, within four deviations of their own error."""
    size = 1.0 if unit == "rad" else np.degrees(1.0)
    one = COMPASSES[kind](n)
    h = one
    if unit == "deg" and callable(one):
        h = lambda x: [np.degrees(y) for y in one([np.radians(x[i]) for i in range(n)])]  # noqa: E731
    sensors = {
        "yaw": Sensor(h, (size * NOISE) ** 2, wraps=unit),
        "other": Sensor(lambda x: [np.sin(x[1])], 0.04),
    }
    mean = np.array([0.5, *[0.0] * (n - 1)])
    variances = np.array([*VARIANCES, 1e4])
    covariances = np.stack([np.diag([P, *[1e-3] * (n - 1)]) for P in variances], axis=-1)
    count, z = len(variances), 0.5 + np.minimum(np.sqrt(variances + NOISE**2), 1.0)
    found = update(
        model(make, n, sensors, size * mean),
        "unscented",
        np.tile(size * mean[:, None], count),
        size**2 * covariances,
        yaw=size * z,
    )
    rng = np.random.default_rng(n)
    for k, P in enumerate(variances):
        particles = 0.5 + np.sqrt(P) * rng.standard_normal(20_000)
        other = np.sqrt(1e-3) * rng.standard_normal(20_000) if kind == "function" else 0.0
        weights = np.exp(-0.5 * (wrapped(z[k] - particles + 0.25 * other**2) / NOISE) ** 2)
        weights /= weights.sum()
        around = np.angle(weights @ np.exp(1j * particles))
        apart = wrapped(particles - around)
        deviation = np.sqrt(weights @ apart**2)
        error = 4.0 * deviation * np.sqrt((weights**2).sum())
        assert abs(wrapped(found.mean[0, k] / size - around)) < error, P
        assert abs(found.sigma[0, k] / size - deviation) < error, P


DIRECTIONS = {
    "bearing": lambda x: [np.arctan2(x[1], x[0])],
    "far bearing": lambda x: [np.arctan2(x[1] - 3.0, x[0] + 2.0)],
    "relative bearing": lambda x: [np.arctan2(2.0 - x[1], 5.0 - x[0]) - x[2]],
    "lever arm": lambda x: [
        np.arctan2(2.0 - 0.1 * x[1] - np.sin(x[2]), 5.0 - 0.1 * x[0] - np.cos(x[2])) - x[2]
    ],
}


@pytest.mark.parametrize("n", [3, 9])
@pytest.mark.parametrize("kind", DIRECTIONS)
def test_a_direction_is_taken_in_without_too_much_confidence(make, kind, n):
    """No Gaussian is the posterior of a position after one bearing at a wide spread. What must hold for 400 drawn
    truths: every covariance is definite, and the mean of NEES per state is at most 2, where the extended filter has up
    to 1e3. At a small spread it is 1, within four deviations of its own error.
    """
    sensors = {
        "bearing": Sensor(DIRECTIONS[kind], NOISE**2, wraps="rad"),
        "other": Sensor(np.eye(n)[:1], 1.0),
    }
    mean, each = np.array([1.0, *[0.0] * (n - 1)]), 400
    P = np.repeat(VARIANCES, each)
    rng = np.random.default_rng(n)
    truth = mean[:, None] + np.sqrt(P) * rng.standard_normal((n, len(P)))
    z = wrapped(np.stack(DIRECTIONS[kind](truth))[0] + NOISE * rng.standard_normal(len(P)))
    found = update(
        model(make, n, sensors, mean),
        "unscented",
        np.tile(mean[:, None], len(P)),
        P * np.eye(n)[..., None],
        bearing=z,
    )
    error, covariance = (found.mean - truth).T, np.moveaxis(found.covariance, -1, 0)
    if kind in ("relative bearing", "lever arm"):
        error[:, 2] = wrapped(error[:, 2])
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()
    nees = (
        np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error).reshape(-1, each).mean(axis=1) / n
    )
    assert (nees < 2.0).all()
    assert abs(nees[0] - 1.0) < 4.0 * np.sqrt(2.0 / (n * each))
