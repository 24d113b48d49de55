"""Continuous models over an interval, against SciPy's exponential, quadrature and naive loops."""

import numpy as np
import pytest
import scipy
from naive import kalman_update
from own_models import compare_lanes, simulate

from filtergym import Input
from filtergym.filters import discretisation

CASES = {
    "integrators": ([[0, 1, 0], [0, 0, 1], [0, 0, 0]], 0.0),
    "oscillator": ([[0, 1], [-4, -0.5]], 12.0),
    "singer": ([[0, 1, 0], [0, 0, 1], [0, 0, -0.1]], 13.0),
}
"""Matrices, and how many doublings up to 10,000 s need at least."""


@pytest.mark.parametrize("dt", [0.0, 1e-6, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("name", CASES)
def test_transition_and_noise_are_those_of_the_exponential(name, dt):
    """Van Loan's block exponential loses digits as exp(|A| dt) grows; below that both are exact to rounding."""
    A, D = np.array(CASES[name][0], float), np.diag([0.1, 0.0, 2.0][-len(CASES[name][0]) :])
    n = len(A)
    series = discretisation.choose_series(A, 1e4)
    E, Q = discretisation.discretise(A, D, dt, series)
    block = scipy.linalg.expm(dt * np.block([[-A, D], [np.zeros((n, n)), A.T]]))
    F = block[n:, n:].T
    np.testing.assert_allclose(np.eye(n) + E, F, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(Q, F @ block[:n, n:], rtol=1e-11, atol=1e-12 * max(dt, 1e-6))
    assert series.doublings >= CASES[name][1]
    assert (series.doublings == 0) == (name == "integrators")


def test_a_decayed_state_has_the_stationary_covariance():
    """After 10,000 s, at the end of what the series is chosen for: the solution of Lyapunov's equation."""
    A, D = np.array(CASES["oscillator"][0], float), np.diag([0.1, 2.0])
    E, Q = discretisation.discretise(A, D, 1e4, discretisation.choose_series(A, 1e4))
    np.testing.assert_allclose(E, -np.eye(2), atol=1e-12)
    np.testing.assert_allclose(Q, scipy.linalg.solve_continuous_lyapunov(A, -D), rtol=1e-11)


def pendulum(x, u):
    return np.array([x[1], -9.81 * np.sin(x[0]) - 0.5 * x[1] + u[0]])


def slope_matrix(x):
    return np.array([[0.0, 1.0], [-9.81 * np.cos(x[0]), -0.5]])


def test_runge_kutta_is_of_order_four():
    """Against SciPy's integrator at 1e-13: four times the steps have a 256th of the error."""
    drift = lambda x: pendulum(x, [0.3])  # noqa: E731
    exact = scipy.integrate.solve_ivp(
        lambda _, x: drift(x), (0, 0.4), [1, 0.5], "DOP853", rtol=1e-13, atol=1e-13
    )
    errors = [
        np.abs(discretisation.runge_kutta(drift, np.array([1.0, 0.5]), 0.4, steps) - exact.y[:, -1]).max()
        for steps in (4, 16)
    ]
    assert 128.0 < errors[0] / errors[1] < 512.0


def test_held_noise_is_the_integral_to_its_order():
    """The series ends with s^3, so of an interval of 0.01 s the error is below (3 s)^5 of the integral."""
    A, D = slope_matrix([0.7, 0.0]), np.diag([0.0, 0.1])
    _, Q = discretisation.discretise(A, D, 0.01, discretisation.choose_series(A, 1.0))
    found = discretisation.constant_matrix_noise(A, D, 0.01)
    np.testing.assert_allclose(found, Q, rtol=1e-6)
    stiff = discretisation.constant_matrix_noise(A * 300.0, D, 0.1)
    assert np.linalg.eigvalsh(stiff).min() >= -1e-12 * np.abs(stiff).max()


COMMON = {
    "drift": lambda x, u: [x[1], -9.81 * np.sin(x[0]) - 0.5 * x[1] + u[0]],
    "diffusion": [[0, 0], [0, 0.1]],
    "h": [[1, 0]],
    "R": [[0.01]],
    "mean": [1.0, 0.0],
    "covariance": 0.1 * np.eye(2),
    "sampling_interval": 0.1,
    "inputs": {"torque": Input(0.0, 1.0, 5.0, noise=0.3)},
    "integration_steps": 2,
}


def naive_step(x, dt, u):
    """Two steps of the classical method, with the derivatives by x and u by complex steps of 1e-30, which are exact."""

    def move(x, u):
        for _ in range(2):
            h = dt / 2.0
            k1 = pendulum(x, u)
            k2 = pendulum(x + 0.5 * h * k1, u)
            k3 = pendulum(x + 0.5 * h * k2, u)
            k4 = pendulum(x + h * k3, u)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return x

    tiny = 1e-30
    F = np.stack([move(x + tiny * 1j * unit, u).imag / tiny for unit in np.eye(2)], axis=1)
    G = move(x.astype(complex), [u[0] + tiny * 1j]).imag[:, None] / tiny
    return move(x, u), F, G


def naive_noise(x, dt):
    """Three points of Gauss-Legendre with exp(A s) to the third power."""
    A, D, total = slope_matrix(x), np.diag([0.0, 0.1]), 0.0
    for point, weight in zip([-np.sqrt(0.6), 0.0, np.sqrt(0.6)], [5 / 9, 8 / 9, 5 / 9], strict=True):
        s = dt * (1.0 + point) / 2.0
        F = np.eye(2) + A * s + A @ A * s**2 / 2.0 + A @ A @ A * s**3 / 6.0
        total = total + dt / 2.0 * weight * F @ D @ F.T
    return total


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
def test_the_filter_is_that_of_the_discretised_model(make, backend):
    start, kept = simulate(make(), 10, 8, backend=backend, jitter=0.9)

    def follow(x, P, lane):
        for _, m, *_ in kept:
            x, F, G = naive_step(x, m.interval[lane], m.inputs[:, lane])
            P = F @ P @ F.T + 0.3**2 * G @ G.T + naive_noise(x, m.interval[lane])
            x, P = kalman_update(x, P, m.values[:, lane] - x[:1], np.eye(1, 2), np.array([[0.01]]))
        return x, P

    compare_lanes(start, kept, follow)


def test_a_linear_drift_moves_by_the_exponential(make):
    """With input and constant force; of a measurement with a deviation of 1e8 nothing is learned."""
    drift = lambda x, u: [x[1], -4.0 * x[0] - 0.5 * x[1] + 2.0 * u[0] + 0.3]  # noqa: E731
    start, ((_, m, mean, *_),) = simulate(make(drift=drift, R=[[1e16]]), 1, 8, jitter=0.9)
    held = np.array([[0.0, 1.0, 0.0, 0.0], [-4.0, -0.5, 2.0, 0.3], [0.0] * 4, [0.0] * 4])
    for lane in range(8):
        before = [*start.measurement.mean[:, lane], m.inputs[0, lane], 1.0]
        expected = scipy.linalg.expm(held * m.interval[lane]) @ before
        np.testing.assert_allclose(mean[:, lane], expected[:2], atol=1e-7)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"f": np.eye(2)}, "give the motion by f and Q, or by drift and diffusion, got f, drift, diffusion"),
        ({"drift": None, "diffusion": None}, "got neither"),
        ({"drift": lambda x: [x[0]]}, "neither drift, h nor R takes u: write"),
        ({"drift": lambda x, u: [x[0] * u[0]]}, "drift must return 2 numbers, got 1"),
        ({"drift": lambda x, dt, u: [x[0], u[0]]}, "drift takes the state, and u where there are inputs"),
        ({"diffusion": -np.eye(2)}, "diffusion must be symmetric"),
        ({"integration_steps": 0}, "integration_steps must be"),
        ({"filter_model": {"Q": np.eye(2)}}, "filter_model can contain drift, diffusion, h or R, got 'Q'"),
    ],
)  # fmt: skip
def test_what_is_no_continuous_model_is_refused(make, wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        make(**wrong)
