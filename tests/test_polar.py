"""Cartesian variances of a polar measurement."""

import math

import numpy as np
import pytest

from filtergym.filters import polar

SIGMAS = 100.0, math.radians(0.25)


@pytest.mark.parametrize("seed", range(3))
def test_variances_equal_the_trigonometric_form(seed):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-5e4, 5e4, size=(2, 50))
    variances = polar.cartesian_variances(position, *SIGMAS)
    for (x, y), (vx, vy) in zip(position.T, variances.T, strict=True):
        r, b = math.hypot(x, y), math.atan2(y, x)
        expected_x = (math.cos(b) * SIGMAS[0]) ** 2 + (r * math.sin(b) * SIGMAS[1]) ** 2
        expected_y = (math.sin(b) * SIGMAS[0]) ** 2 + (r * math.cos(b) * SIGMAS[1]) ** 2
        assert vx == pytest.approx(expected_x, rel=1e-11)
        assert vy == pytest.approx(expected_y, rel=1e-11)


@pytest.mark.parametrize(("x", "y", "sigma_x"), [(-10000, 5000, 92), (200, 5000, 22), (19400, 5000, 99)])
def test_sigmas_along_the_paper_flight(x, y, sigma_x):
    # Reading R5 of the restored paper: k = 0, 17 (the beam passes x = 0) and 49.
    variance = polar.cartesian_variances(np.array([[float(x)], [float(y)]]), *SIGMAS)
    assert math.sqrt(variance[0, 0]) == pytest.approx(sigma_x, abs=0.5)


def test_radar_itself_has_finite_positive_variances():
    position = np.array([[0.0, 0.5, 1e-200], [0.0, 0.0, 0.0]])
    variances = polar.cartesian_variances(position, *SIGMAS)
    assert np.isfinite(variances).all()
    assert (variances >= 0).all()
