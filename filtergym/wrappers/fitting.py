"""Models of environments whose equations are not known, fitted to rollouts."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy

from .lanes import check_observations
from .models import EnvironmentModel


def fit_model(
    env: gymnasium.Env[Any, Any],
    *,
    steps: int = 5000,
    degree: int = 2,
    policy: Callable[[numpy.ndarray], Any] | None = None,
    interval: float = 1.0,
    names: Sequence[str] = (),
    angles: dict[str, str] | None = None,
    seed: int = 0,
) -> EnvironmentModel:
    """Fit the motion of an environment whose observation is its state.

    The change of every component in a step is a polynomial of state and action, fitted by least squares to rollouts;
    process noise is the covariance of the residuals on the last fifth of the rollouts, which the fit does not use.

    Args:
        env: whose observation is a vector and whose action is one of a box.
        steps: of the rollouts, all together.
        degree: of the polynomial, 1 or 2.
        policy: from observations to actions; default: random actions.
        interval: between two steps, s.
        names: of the components; default: ``x1``, ``x2`` and so on.
        angles: components that are angles, by their names; they turn without limit in the fit.
        seed: of the rollouts.

    Raises:
        ValueError: for an observation or an action that is no vector, or too few steps or episodes.
    """
    space = env.action_space
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"fit_model takes actions of a box (p,), and the action space is {space}")
    n, p = check_observations(env.observation_space, env.spec), space.shape[0]
    names = tuple(names) or tuple(f"x{i + 1}" for i in range(n))
    features = 1 + n + p + (n + p) * (n + p + 1) // 2 * (degree == 2)
    if degree not in (1, 2) or steps < 10 * features:
        raise ValueError(f"degree must be 1 or 2, steps at least {10 * features}, got {degree} and {steps}")
    before, after, action, starts = _roll_out(env, steps, policy, seed)
    if (count := len(starts)) <= n:
        raise ValueError(f"rollouts of {n} components need {n + 1} episodes, got {count}: take more steps")
    change = after - before
    for name, unit in (angles or {}).items():
        turn = {"rad": 2.0 * numpy.pi, "deg": 360.0}[unit]
        change[:, names.index(name)] -= turn * numpy.round(change[:, names.index(name)] / turn)
    joined = numpy.concatenate([before, action], axis=1)
    centre, scale = joined.mean(axis=0), joined.std(axis=0) + 1e-9
    pairs = [(i, j) for i in range(n + p) for j in range(i + 1)] if degree == 2 else []

    def terms(x: Any) -> list[Any]:
        y = [(x[i] - centre[i]) / scale[i] for i in range(n + p)]
        return [1.0, *y, *(y[i] * y[j] for i, j in pairs)]

    design = numpy.stack([numpy.broadcast_to(term, len(joined)) for term in terms(joined.T)], axis=1)
    cut = len(design) * 4 // 5
    weights = numpy.linalg.lstsq(design[:cut], change[:cut], rcond=None)[0]
    residual = change[cut:] - design[cut:] @ weights
    floor = 1e-6 * change.std(axis=0) ** 2 + 1e-12
    noise = (residual.T @ residual / len(residual) + numpy.diag(floor)) / interval

    def f(x: Any, dt: Any, u: Any) -> list[Any]:
        found = terms([*(x[i] for i in range(n)), *(u[j] for j in range(p))])
        share = dt / interval
        change = [sum(float(weights[k, i]) * one for k, one in enumerate(found)) for i in range(n)]
        return [x[i] + share * change[i] for i in range(n)]

    return EnvironmentModel(
        names=names, f=f, interval=interval, noise=noise, mean=starts.mean(axis=0),
        covariance=numpy.atleast_2d(numpy.cov(starts.T)) + 1e-6 * numpy.diag(before.std(axis=0) ** 2 + 1e-9),
        inputs=tuple(f"u{j + 1}" for j in range(p)), angles=angles or {},
    )  # fmt: skip


def _roll_out(env: Any, steps: int, policy: Any, seed: int) -> tuple[numpy.ndarray, ...]:
    """Return states before and after each step, actions, and states at the start of episodes."""
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    steps_made, starts = [], [observation]
    for _ in range(steps):
        action = env.action_space.sample() if policy is None else policy(observation)
        following, _, terminated, truncated, _ = env.step(action)
        steps_made.append((observation, following, action))
        observation = following
        if terminated or truncated:
            observation, _ = env.reset()
            starts.append(observation)
    return tuple(numpy.array(each, dtype=float) for each in (*zip(*steps_made, strict=True), starts))
