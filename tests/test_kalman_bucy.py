"""The Kalman-Bucy design functions against each other, naive oracles and golden numbers."""

import math

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from filtergym.filters import linear_systems
from filtergym.papers.kalman_bucy_ins_gnss import kalman_bucy

SEEDS = range(2)
AUGMENTED = (
    np.array([[0.0, 1, 1], [0, 0, 0], [0, 0, -1]]),
    np.diag([0.04, 0, 0.32]),
    [[1.0, 0, 0]],
    [[0.02]],
)
START = np.diag([0.0, 0.36, 0.16])


def random_model(seed, n=3, m=2):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) - np.eye(n)
    B, C, H = rng.normal(size=(n, n)), rng.normal(size=(m, n)), rng.normal(size=(m, m)) + 2 * np.eye(m)
    R0 = rng.normal(size=(n, n))
    return A, B @ B.T, C, H @ H.T, R0 @ R0.T


@pytest.mark.parametrize(
    ("a", "w", "s", "R0"),
    [(-0.5, 1, 100, 0), (0, 1, 1, 0), (0.7, 2, 3, 5), (-1, 0, 2, 4), (0, 0, 3, 2), (0.4, 1, 0, 1)],
)
def test_the_riccati_equation_three_ways(a, w, s, R0):
    times = [0.0, 0.01, 0.3, 1.0, 4.0]
    closed = kalman_bucy.riccati_scalar(a, w, s, R0, times)
    # A measurement without information has an infinite intensity; 1e300 stands for it.
    Q = 1 / s if s else 1e300
    exponential = kalman_bucy.riccati_hamiltonian(a, w, 1, Q, R0, times)[:, 0, 0]
    ode = kalman_bucy.riccati_ode(a, w, 1, Q, R0, times)[:, 0, 0]
    np.testing.assert_allclose(exponential, closed, rtol=1e-11)  # rounding of a few exponentials
    np.testing.assert_allclose(ode, closed, rtol=1e-9)  # the integrator's tolerance, accumulated


def test_the_closed_form_is_the_usual_one():
    a, w, s, R0, t = -0.5, 1.0, 100.0, 0.3, np.linspace(0, 1, 11)
    gamma = math.sqrt(a * a + w * s)
    high, low = (a + gamma) / s, (a - gamma) / s
    rho = (R0 - high) / (R0 - low) * np.exp(-2 * gamma * t)
    np.testing.assert_allclose(
        kalman_bucy.riccati_scalar(a, w, s, R0, t), (high - low * rho) / (1 - rho), rtol=1e-13
    )


@pytest.mark.parametrize("model", [(*AUGMENTED, START), *(random_model(seed) for seed in SEEDS)])
def test_the_matrix_riccati_equation_two_ways(model):
    times = [0.1, 0.5, 2.0, 5.0]
    exponential = kalman_bucy.riccati_hamiltonian(*model, times)
    ode = kalman_bucy.riccati_ode(*model, times)
    # The integrator's tolerance of 1e-11 a step, accumulated.
    np.testing.assert_allclose(exponential, ode, rtol=1e-8, atol=1e-10)


def test_a_long_exponential_without_restart_is_lost(monkeypatch):
    model = random_model(0)
    restarted = kalman_bucy.riccati_hamiltonian(*model, [30.0])
    monkeypatch.setattr(kalman_bucy, "LONGEST_TIME", 100.0)
    once = kalman_bucy.riccati_hamiltonian(*model, [30.0])
    settled = steady(*model[:4]).posterior
    np.testing.assert_allclose(restarted[0], settled, rtol=1e-9, atol=1e-10)
    assert np.abs(once[0] - settled).max() > 1e-3


def steady(A, BGBt, C, Q):
    return linear_systems.steady_kalman_bucy(A, C, BGBt, Q)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_steady_state_solves_the_equation_and_is_stable(seed):
    A, BGBt, C, Q, _ = random_model(seed)
    settled = steady(A, BGBt, C, Q)
    R, K = settled.posterior, settled.gain
    residual = A @ R + R @ A.T - R @ C.T @ np.linalg.inv(Q) @ C @ R + BGBt
    np.testing.assert_allclose(residual, 0, atol=1e-9 * np.abs(BGBt).max())
    np.testing.assert_allclose(K, R @ C.T @ np.linalg.inv(Q), rtol=1e-9)
    assert settled.poles.real.max() < 0


def test_golden_numbers_of_the_first_order_example():
    np.testing.assert_allclose(kalman_bucy.riccati_scalar(0, 1, 1, 0, 1.0), math.tanh(1), rtol=1e-14)
    settled = steady(-0.5, 1, 1, 0.01)
    np.testing.assert_allclose([settled.posterior[0, 0], settled.gain[0, 0]], [0.095125, 9.5125], rtol=3e-6)


def test_the_augmented_scheme_has_no_steady_state_unless_its_constant_walks():
    with pytest.raises(ValueError, match=r"no noise reaches .* eigenvalues 0.*let the gain vary with time"):
        steady(*AUGMENTED)
    with pytest.raises(ValueError, match=r"cannot detect the state: the modes with eigenvalues 0\.5"):
        steady(np.diag([0.5, -1]), np.eye(2), [[0, 1]], [[1]])
    walking = AUGMENTED[1] + np.diag([0, 1e-4, 0])
    assert steady(AUGMENTED[0], walking, *AUGMENTED[2:]).gain[1, 0] > 0
    # The variance of the constant falls like 1/t: t R is nearly the same at 100 and at 200 s.
    late = kalman_bucy.riccati_hamiltonian(*AUGMENTED, START, [100.0, 200.0])[:, 1, 1]
    assert 1.9 < late[0] / late[1] < 2.1


@pytest.mark.parametrize("seed", SEEDS)
def test_moments_by_small_steps_and_their_rest(seed):
    A, BGBt, _, _, Theta = random_model(seed)
    A = A - 3 * np.eye(3)
    U, m = np.array([1.0, -2, 0.5]), np.array([3.0, 0, 1])
    found = kalman_bucy.moments(A, U, BGBt, m, Theta, [0.0, 0.5, 30.0])
    np.testing.assert_array_equal(found.covariance[0], Theta)
    for _ in range(5000):  # trapezoidal rule on (6): second order in the step of 1e-4 s
        middle, slope = m + 0.5e-4 * (A @ m + U), Theta + 0.5e-4 * (A @ Theta + Theta @ A.T + BGBt)
        m, Theta = m + 1e-4 * (A @ middle + U), Theta + 1e-4 * (A @ slope + slope @ A.T + BGBt)
    np.testing.assert_allclose(found.mean[1], m, atol=1e-6)
    np.testing.assert_allclose(found.covariance[1], Theta, atol=1e-5)
    rest = solve_continuous_lyapunov(A, -BGBt)
    np.testing.assert_allclose(found.covariance[2], rest, atol=1e-10)
    # The sum over l as the paper prints it.
    printed = [
        [sum(A[i, k] * rest[k, j] + A[j, k] * rest[i, k] for k in range(3)) for j in range(3)]
        for i in range(3)
    ]
    np.testing.assert_allclose(printed, -BGBt, atol=1e-10)


def test_the_sampled_filter_agrees_at_first_order():
    errors = []
    for step in (0.01, 0.005, 0.0025):
        sampled = kalman_bucy.sampled_covariance(-0.5, 1, 1, 0.01, 0.0, step, 1.0)
        R = kalman_bucy.riccati_scalar(-0.5, 1, 100, 0, 1.0)[0]
        K = 100 * R
        predicted, updated = sampled.predicted[-1, 0, 0], sampled.updated[-1, 0, 0]
        errors.append(
            [
                predicted / R - 1,
                updated / R - 1,
                predicted / R - 1 - K * step / 2,
                updated / R - 1 + K * step / 2,
                math.sqrt(predicted * updated) / R - 1,
            ]
        )
    order = np.log2(np.abs(np.divide(errors[:-1], errors[1:])))
    # Halving the step halves the first two and quarters what is left after the stated correction.
    np.testing.assert_allclose(order[:, :2], 1, atol=0.05)
    np.testing.assert_allclose(order[:, 2:], 2, atol=0.1)


def test_a_fixed_gain_has_its_own_covariance():
    optimal = kalman_bucy.sampled_covariance(*AUGMENTED, START, 0.01, 2.0)
    repeated = kalman_bucy.sampled_covariance(*AUGMENTED, START, 0.01, 0.01, gain=optimal.gain[0])
    np.testing.assert_allclose(repeated.updated[0], optimal.updated[0], rtol=1e-12, atol=1e-15)
    worse = kalman_bucy.sampled_covariance(*AUGMENTED, START, 0.01, 2.0, gain=[[0.0415], [0], [0]])
    assert worse.updated[-1, 0, 0] > optimal.updated[-1, 0, 0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: linear_systems.van_loan([[0]], [[-1]], 0.1),
            "intensity must be symmetric positive semidefinite",
        ),
        (lambda: linear_systems.van_loan([[0]], [[1]], 0), "T must be a positive"),
        (lambda: linear_systems.van_loan([[0]], np.eye(2), 0.1), "intensity must be a finite 1 x 1"),
        (lambda: kalman_bucy.riccati_scalar(0, -1, 1, 0, 1), "w must not be negative"),
        (lambda: kalman_bucy.riccati_ode(0, 1, 1, 0, 0, 1), "Q must be symmetric positive definite"),
        (lambda: kalman_bucy.riccati_hamiltonian(0, 1, 1, 1, 0, [2, 1]), "ascending order"),
        (
            lambda: kalman_bucy.sampled_covariance(0, 1, 1, 1, 0, 2.0, 1.0),
            "step must be at most the duration",
        ),
    ],
)
def test_bad_input_is_refused_with_the_reason(call, message):
    with pytest.raises(ValueError, match=message):
        call()
