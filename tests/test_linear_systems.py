import math

import numpy
import pytest
from scipy.linalg import solve_continuous_lyapunov

from filtergym.filters import gusts, linear_systems

SEEDS = range(2)


def random_stable(rng: numpy.random.Generator, n: int) -> numpy.ndarray:
    A = rng.standard_normal((n, n))
    return A - (numpy.linalg.eigvals(A).real.max() + 0.5) * numpy.eye(n)


def random_covariance(rng: numpy.random.Generator, n: int) -> numpy.ndarray:
    C = rng.standard_normal((n, n))
    return C @ C.T


@pytest.mark.parametrize("seed", SEEDS)
def test_van_loan_equals_the_integral(seed: int) -> None:
    from scipy.linalg import expm

    rng = numpy.random.default_rng(seed)
    A, W, T = random_stable(rng, 4), random_covariance(rng, 4), 0.3
    nodes, weights = numpy.polynomial.legendre.leggauss(30)
    points = [(w * T / 2, expm(A * (x + 1) * T / 2)) for x, w in zip(nodes, weights, strict=True)]
    F, Q = linear_systems.van_loan(A, W, T)
    # Quadrature of an entire function with 30 nodes: rounding only.
    numpy.testing.assert_allclose(F, expm(A * T), rtol=0, atol=1e-12)
    numpy.testing.assert_allclose(Q, sum(w * E @ W @ E.T for w, E in points), rtol=0, atol=1e-12)
    B = rng.standard_normal((4, 2))
    _, held = linear_systems.zero_order_hold(A, B, T)
    numpy.testing.assert_allclose(held, sum(w * E @ B for w, E in points), rtol=0, atol=1e-12)


def test_van_loan_gives_the_singer_covariance_for_short_intervals() -> None:
    def singer(T: float, tau: float) -> numpy.ndarray:
        A = numpy.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / tau]], dtype=float)
        return linear_systems.van_loan(A, numpy.diag([0, 0, 2 / tau]), T)[1][numpy.triu_indices(3)]

    expected = [0.0048635570, 0.0120918768, 0.0158558056, 0.0321119868, 0.0475713807, 0.0951625820]
    numpy.testing.assert_allclose(singer(1.0, 20.0), expected, rtol=1e-8)
    assert singer(0.01, 100.0)[0] == pytest.approx(0.01**5 / 20 * 2 / 100, rel=1e-3)


@pytest.mark.parametrize("seed", SEEDS)
def test_van_loan_keeps_its_digits_over_long_intervals(seed: int) -> None:
    rng = numpy.random.default_rng(seed)
    A, W = random_stable(rng, 4), random_covariance(rng, 4)
    # Without halving the growing block of one exponential over this interval leaves no digit.
    F, Q = linear_systems.van_loan(A, W, 200.0)
    X = solve_continuous_lyapunov(A, -W)
    numpy.testing.assert_allclose(F, 0.0, atol=1e-30)
    numpy.testing.assert_allclose(Q, X, rtol=0, atol=1e-10 * numpy.abs(X).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_steady_filter_is_where_the_recursion_settles(seed: int) -> None:
    rng = numpy.random.default_rng(seed)
    F, H = (
        linear_systems.zero_order_hold(random_stable(rng, 4), numpy.zeros((4, 1)), 0.5)[0],
        rng.standard_normal((2, 4)),
    )
    Q, R = random_covariance(rng, 4), random_covariance(rng, 2) + numpy.eye(2)
    P = numpy.eye(4)
    for _ in range(500):
        predicted = F @ P @ F.T + Q
        K = predicted @ H.T @ numpy.linalg.inv(H @ predicted @ H.T + R)
        P = (numpy.eye(4) - K @ H) @ predicted
    steady = linear_systems.steady_kalman(F, H, Q, R)
    # Relative to covariances of order 10 solved by two different routes.
    numpy.testing.assert_allclose(steady.posterior, P, rtol=0, atol=1e-10)
    numpy.testing.assert_allclose(steady.gain, K, rtol=0, atol=1e-10)


def test_kalman_bucy_golden_numbers() -> None:
    A, H, W = numpy.array([[0.0, 1.0], [0.0, 0.0]]), numpy.array([[1.0, 0.0]]), numpy.diag([0.0, 1.0])
    one = numpy.eye(1)
    steady = linear_systems.steady_kalman_bucy(A, H, W, one)
    root = math.sqrt(2.0)
    numpy.testing.assert_allclose(steady.gain[:, 0], [root, 1.0], rtol=1e-13)
    for q, r in ((3.0, 0.2), (0.1, 7.0)):
        P = linear_systems.steady_kalman_bucy(A, H, q * W, r * one).posterior
        cross = math.sqrt(q * r)
        expected = [[root * q**0.25 * r**0.75, cross], [cross, root * q**0.75 * r**0.25]]
        numpy.testing.assert_allclose(P, expected, rtol=1e-12)


def test_regulator_golden_numbers() -> None:
    A, B = numpy.array([[0.0, 1.0], [0.0, 0.0]]), numpy.array([[0.0], [1.0]])
    F, held = linear_systems.zero_order_hold(A, B, 0.25)
    L = linear_systems.discrete_regulator(F, held, numpy.eye(2), numpy.eye(1)).feedback
    numpy.testing.assert_allclose(L, [[0.80578, 1.50361]], atol=5e-6)  # five printed digits
    assert linear_systems.feedforward_gain(F, held, numpy.array([1.0, 0.0]), L) == pytest.approx(
        0.80578, abs=5e-6
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_regulator_is_the_limit_of_backward_dynamic_programming(seed: int) -> None:
    rng = numpy.random.default_rng(seed)
    F, B = rng.standard_normal((3, 3)) * 0.6, rng.standard_normal((3, 1))
    W, R = random_covariance(rng, 3), numpy.eye(1)
    S = numpy.zeros((3, 3))
    for _ in range(2000):
        L = numpy.linalg.solve(R + B.T @ S @ B, B.T @ S @ F)
        S = W + F.T @ S @ (F - B @ L)
    numpy.testing.assert_allclose(
        linear_systems.discrete_regulator(F, B, W, R).feedback, L, rtol=1e-8, atol=1e-10
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_regret_of_controls_is_what_they_cost_more(seed: int) -> None:
    """Whatever the controls: the cost of a run is x0^T S x0 - xN^T S xN and the regrets of its controls."""
    rng = numpy.random.default_rng(seed)
    F, B = rng.standard_normal((3, 3)) * 0.6, rng.standard_normal((3, 2))
    W, R = random_covariance(rng, 3), random_covariance(rng, 2)
    L, regret = linear_systems.discrete_regulator(F, B, W, R)
    S = numpy.zeros((3, 3))
    for _ in range(2000):
        S = W + F.T @ S @ F - F.T @ S @ B @ numpy.linalg.solve(R + B.T @ S @ B, B.T @ S @ F)
    x, paid, lost = rng.standard_normal(3), 0.0, 0.0
    first = x @ S @ x
    for _ in range(20):
        u = rng.standard_normal(2)
        paid += x @ W @ x + u @ R @ u
        lost += (u + L @ x) @ regret @ (u + L @ x)
        x = F @ x + B @ u
    assert paid == pytest.approx(first - x @ S @ x + lost, rel=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_stationary_covariances_solve_their_equations(seed: int) -> None:
    rng = numpy.random.default_rng(seed)
    A, W = random_stable(rng, 4), random_covariance(rng, 4)
    X = solve_continuous_lyapunov(A, -W)
    F, Q = linear_systems.van_loan(A, W, 0.4)
    # The sampled process has the same stationary covariance.
    numpy.testing.assert_allclose(linear_systems.stationary_covariance(F, Q), X, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_noise_factor_of_semidefinite_covariances(seed: int) -> None:
    thin = numpy.random.default_rng(seed).standard_normal((5, 2))
    C = linear_systems.noise_factor(thin @ thin.T)
    numpy.testing.assert_allclose(C @ C.T, thin @ thin.T, rtol=0, atol=1e-12)
    assert numpy.any(C != 0.0, axis=0).sum() == 2
    with pytest.raises(ValueError, match="semidefinite"):
        linear_systems.noise_factor(thin @ thin.T - 0.1 * numpy.eye(5))


@pytest.mark.parametrize("seed", SEEDS)
def test_separation_holds_for_any_gain_and_the_lyapunov_equation_agrees_with_simulation(seed: int) -> None:
    rng = numpy.random.default_rng(seed)
    F, B, H = rng.standard_normal((3, 3)) * 0.5, rng.standard_normal((3, 1)), rng.standard_normal((2, 3))
    Q, R = random_covariance(rng, 3), numpy.eye(2)
    L = linear_systems.discrete_regulator(F, B, numpy.eye(3), numpy.eye(1)).feedback
    K = linear_systems.steady_kalman(F, H, 4.0 * Q, R).gain  # not the gain for Q
    assert linear_systems.separation_defect(F, B, H, L, K) < 1e-10
    loop = linear_systems.estimate_feedback_loop(F, B, H, L, K, Q, R)
    x = rng.standard_normal((3, 20_000))
    estimate = numpy.zeros_like(x)
    for _ in range(60):
        u = -L @ estimate
        x = F @ x + B @ u + linear_systems.noise_factor(Q) @ rng.standard_normal(x.shape)
        predicted = F @ estimate + B @ u
        estimate = predicted + K @ (H @ x + rng.standard_normal((2, x.shape[1])) - H @ predicted)
    X = linear_systems.stationary_covariance(*loop)
    both = numpy.vstack([x, x - estimate])
    sigma = numpy.sqrt(numpy.diag(X))
    scale = numpy.outer(sigma, sigma)
    # Five standard errors of a sample covariance of 20 000.
    sampled = both @ both.T / 20_000
    numpy.testing.assert_allclose(sampled / scale, X / scale, rtol=0, atol=5 * math.sqrt(2 / 20_000))


def test_what_has_no_stabilising_solution_is_refused_with_the_reason() -> None:
    F, B = numpy.array([[1.0, 0.25], [0.0, 1.0]]), numpy.array([[0.03125], [0.25]])
    position, rate = numpy.array([[1.0, 0.0]]), numpy.array([[0.0, 1.0]])
    Q, one = B @ B.T, numpy.eye(1)
    linear_systems.steady_kalman(F, position, Q, one)
    with pytest.raises(ValueError, match=r"eigenvalues 1.*add a sensor"):
        linear_systems.steady_kalman(F, rate, Q, one)
    with pytest.raises(ValueError, match="no noise reaches"):
        linear_systems.steady_kalman(F, position, numpy.zeros((2, 2)), one)
    with pytest.raises(ValueError, match="measurement noise must be positive"):
        linear_systems.steady_kalman(F, position, Q, 0.0 * one)
    with pytest.raises(ValueError, match="control cannot stabilise"):
        linear_systems.discrete_regulator(F, 0.0 * B, numpy.eye(2), one)
    with pytest.raises(ValueError, match="weights ignore"):
        linear_systems.discrete_regulator(F, B, numpy.diag([0.0, 1.0]), one)
    with pytest.raises(ValueError, match="spectral radius 1"):
        linear_systems.stationary_covariance(F, Q)


def test_an_unstable_mode_without_noise_is_no_obstacle() -> None:
    steady = linear_systems.steady_kalman(numpy.diag([1.2]), numpy.eye(1), numpy.zeros((1, 1)), numpy.eye(1))
    assert abs(steady.poles[0]) == pytest.approx(1 / 1.2)


def test_gust_filter_has_the_stated_variance() -> None:
    gust = gusts.vertical_gust(35.0, 50.0, 0.7)
    assert gust.rate == pytest.approx(0.7)
    assert gust.sigma == pytest.approx(1.146, abs=5e-4)
    # The Lyapunov equation of one state.
    assert gust.intensity / (2.0 * gust.rate) == pytest.approx(gust.sigma**2, rel=1e-13)
    with pytest.raises(ValueError, match="positive airspeed"):
        gusts.vertical_gust(0.0, 50.0, 0.7)


def test_modes_are_listed_as_one_writes_them():
    assert linear_systems._list([0.5 + 0.0j, 0.25 - 2.0j]) == "0.5, 0.25-2j"
