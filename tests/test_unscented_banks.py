"""Controls sigma-points and unscented of ManeuveringTarget: zero is the estimator, and what each factor does to it."""

import numpy as np
import pytest
from models import LANES, act, assert_no_action_is_the_estimator, make_model, watch_hypotheses

from filtergym.agents.training_run import controls_of
from filtergym.baselines.problem import problem_of
from filtergym.envs.interface.vector_environment import TaskVectorEnv
from filtergym.envs.maneuvering_target.unscented_banks import PLAIN_FILTER
from filtergym.envs.maneuvering_target.unscented_turn import UnscentedTurn
from filtergym.filters import coordinated_turn

ID = "filtergym/ManeuveringTarget-v0"
CONTROLS = {"sigma-points": 21, "unscented": 4}
IRREGULAR = {"detection_probability": (0.7, 0.9), "scan_jitter": (0.1, 0.3)}
n = 5


@pytest.fixture(scope="module", params=CONTROLS)
def steered(request):
    """The bank, and for every scan its state as predicted, the measurement and the estimator's answer."""
    model = make_model(ID, request.param, "random", horizon=30, **IRREGULAR)
    estimator = UnscentedTurn(model.task, **PLAIN_FILTER)
    none = np.zeros(CONTROLS[request.param])
    return request.param, model.filter, *watch_hypotheses(model, estimator, "position", none)


def test_zero_is_the_estimator_bit_for_bit(steered):
    control, *watched = steered
    assert_no_action_is_the_estimator(*watched, np.zeros(CONTROLS[control]))


def points_and_weights(mean, covariance, alpha=1.0):
    """Sigma points with beta 2 and kappa 0, one after another."""
    root, scale = np.linalg.cholesky(covariance), alpha * n**0.5
    points = [mean]
    points += [mean + scale * root[:, i] for i in range(n)] + [mean - scale * root[:, i] for i in range(n)]
    others = [1.0 / (2.0 * alpha**2 * n)] * (2 * n)
    first = 1.0 - 1.0 / alpha**2
    return points, [first, *others], [first + 1.0 - alpha**2 + 2.0, *others]


def weighed(points, for_mean, for_covariance):
    mean, covariance = np.zeros(n), np.zeros((n, n))
    for point, w in zip(points, for_mean, strict=True):
        mean = mean + w * point
    for point, w in zip(points, for_covariance, strict=True):
        covariance = covariance + w * np.outer(point - mean, point - mean)
    return mean, covariance


def naive(control, action, mean, covariance, measurement):
    """The step of one lane, over sigma points one after another."""
    p, T = PLAIN_FILTER, measurement["interval"]
    f, R = np.zeros(len(action)), np.diag(measurement["variance"])
    if measurement["available"]:
        f = np.clip(action, -1.0, 1.0)
    acceleration, change = p["acceleration"], np.radians(p["turn_rate_change"]) / 6.0
    if control == "unscented":
        points, for_mean, for_covariance = points_and_weights(mean, covariance, 2.0 ** (0.5 * f[0]))
        acceleration, change, R = (
            acceleration * 30.0 ** (f[1] / 2),
            change * 30.0 ** (f[2] / 2),
            R * 10.0 ** f[3],
        )
    else:
        points, for_mean, for_covariance = points_and_weights(mean, covariance)
        raised = [0.1 * 5.0**a for a in f[: 2 * n]]
        for_mean = [0.0, *(w / sum(raised) for w in raised)]
        for_covariance = [w * 5.0**a for w, a in zip(for_covariance, f[2 * n :], strict=True)]
    moved = [coordinated_turn.propagate(point, T) for point in points]
    mean, covariance = weighed(moved, for_mean, for_covariance)
    covariance = covariance + np.array(coordinated_turn.process_noise(T, acceleration, change))
    if not measurement["available"]:
        return mean, covariance
    H = np.eye(2, n)
    S = H @ covariance @ H.T + R
    K = covariance @ H.T @ np.linalg.inv(S)
    rest = np.eye(n) - K @ H
    return mean + K @ (measurement["position"] - mean[:2]), rest @ covariance @ rest.T + K @ R @ K.T


def test_every_action_is_a_loop_over_sigma_points(steered):
    control, bank, scans, _ = steered
    rng = np.random.default_rng(1)
    for state, measurement in scans[::5]:
        action = rng.uniform(-1.3, 1.3, CONTROLS[control])
        found = act(bank, state, measurement, action).own
        for i in range(LANES):
            lane = {
                name: np.asarray(value)[..., i]
                for name, value in measurement._asdict().items()
                if value is not None
            }
            mean, covariance = naive(
                control, action, state.own.mean[:, i], state.own.covariance[..., i], lane
            )
            sigma = np.sqrt(np.diagonal(covariance))
            # In deviations, which differ by a million.
            np.testing.assert_allclose(found.mean[:, i] / sigma, mean / sigma, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(
                found.covariance[..., i] / np.outer(sigma, sigma),
                covariance / np.outer(sigma, sigma),
                atol=1e-12,
            )


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("scenario", ["random", "glint"])
def test_actions_at_the_edge_keep_the_filter_finite(control, scenario):
    env = TaskVectorEnv(
        ID, 32, control=control, scenario=scenario, backend="numpy", reward="cost", max_episode_steps=60
    )
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    action = rng.choice([-1.0, 1.0], size=(32, CONTROLS[control])).astype(np.float32)
    action[:8], action[8:16] = 1.0, -1.0
    for _ in range(60):
        observation, reward, *_ = env.step(action)
        assert np.isfinite(observation).all()
        assert np.isfinite(reward).all()


@pytest.mark.parametrize(("algorithm", "control"), [("ma-ukf", "sigma-points"), ("rl-ukf", "unscented")])
def test_each_rival_trains_one_control(algorithm, control):
    assert controls_of(problem_of(ID).task, algorithm) == (control,)
    with pytest.raises(ValueError, match="no filter for algorithm"):
        controls_of(problem_of("filtergym/UavAutopilot-v0").task, algorithm)
