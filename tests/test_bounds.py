"""Posterior Cramér-Rao bounds against golden numbers and the information form."""

import numpy as np
import pytest

from filtergym.filters import bounds


def test_scalar_random_walk_golden():
    one = np.ones((1, 1, 1))
    P = 5.0 * one
    for _ in range(60):
        prior = bounds.predict_bound(P, one, one)
        P = bounds.posterior_cramer_rao_bound(prior, np.ones((1, 1)), np.ones((1, 1)))
    assert P[0, 0, 0] == pytest.approx(0.6180340, abs=5e-8)
    assert prior[0, 0, 0] == pytest.approx(1.6180340, abs=5e-8)


def test_constant_velocity_golden():
    # State x, y, vx, vy; Q of continuous white acceleration, q = 0.05; R = 5 I; P0 = 5 and 10.
    T, q = 1.0, 0.05
    F = np.kron([[1.0, T], [0.0, 1.0]], np.eye(2))[..., None]
    Q = q * np.kron([[T**3 / 3, T**2 / 2], [T**2 / 2, T]], np.eye(2))[..., None]
    H, R = np.eye(2, 4), 5.0 * np.eye(2)
    P = np.diag([5.0, 5.0, 10.0, 10.0])[..., None]
    position = [np.sqrt(P[0, 0, 0] + P[1, 1, 0])]
    for _ in range(20):
        P = bounds.posterior_cramer_rao_bound(bounds.predict_bound(P, F, Q), H, R)
        position.append(np.sqrt(P[0, 0, 0] + P[1, 1, 0]))
    np.testing.assert_allclose(position[:3], [3.16227766, 2.73899281, 2.70945734], rtol=0, atol=5e-9)
    assert position[20] == pytest.approx(1.89934607, abs=5e-9)


@pytest.mark.parametrize("seed", range(5))
def test_equals_the_information_form_with_singular_process_noise(seed):
    # Noise along one direction only: an inverse of Q does not exist, one of P does.
    rng = np.random.default_rng(seed)
    F, g, H = rng.normal(size=(3, 3)), rng.normal(size=(3, 1)), rng.normal(size=(2, 3))
    root = rng.normal(size=(2, 2))
    R, P = root @ root.T + np.eye(2), np.eye(3)
    mine = P[..., None]
    for _ in range(10):
        mine = bounds.posterior_cramer_rao_bound(
            bounds.predict_bound(mine, F[..., None], (g @ g.T)[..., None]), H, R
        )
        P = np.linalg.inv(np.linalg.inv(F @ P @ F.T + g @ g.T) + H.T @ np.linalg.inv(R) @ H)
        np.testing.assert_allclose(mine[..., 0], P, rtol=1e-7, atol=1e-9)


def test_bound_never_grows_with_a_measurement_and_each_lane_is_its_own():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 3, 3))
    P = np.moveaxis(root @ root.swapaxes(1, 2) + np.eye(3), 0, -1)
    H, R = rng.normal(size=(2, 3, 6)), np.repeat(np.eye(2)[..., None], 6, axis=2) * rng.uniform(1, 9, 6)
    after = bounds.posterior_cramer_rao_bound(P, H, R)
    for b in range(6):
        assert np.linalg.eigvalsh(P[..., b] - after[..., b]).min() > -1e-10
        information = np.linalg.inv(P[..., b]) + H[..., b].T @ np.linalg.inv(R[..., b]) @ H[..., b]
        np.testing.assert_allclose(after[..., b], np.linalg.inv(information), rtol=1e-9, atol=1e-11)
