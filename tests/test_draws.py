"""Uniform numbers by name and distribution, against their definitions."""

import math

import numpy as np
import pytest

from filtergym.envs.contract.draws import Draws

RUNS = 20000


@pytest.fixture
def uniforms():
    return np.random.default_rng(0).random((8, RUNS))


def asked(draws):
    """One of everything."""
    draws.unit("unit")
    draws.uniform("uniform", (2.0, 6.0))
    draws.log_uniform("log_uniform", (0.1, 10.0), 2)
    draws.integer("integer", (3, 5))
    draws.event("event", 0.25)
    draws.category("category", [0.2, 0.7])
    draws.unit("none", 0)
    return draws


def test_every_distribution(uniforms):
    draws = asked(Draws(uniforms, np))
    u, drawn = uniforms, draws.drawn
    assert draws.used == 7
    np.testing.assert_array_equal(drawn["unit"], u[0])
    np.testing.assert_array_equal(drawn["uniform"], 2.0 + 4.0 * u[1])
    np.testing.assert_allclose(drawn["log_uniform"], 10.0 ** (2.0 * u[2:4] - 1.0), rtol=1e-14)
    counts = np.bincount(drawn["integer"].astype(int), minlength=6)
    assert counts[:3].sum() == 0
    assert (abs(counts[3:] / RUNS - 1 / 3) < 4 * math.sqrt(2 / 9 / RUNS)).all()
    np.testing.assert_array_equal(drawn["event"], u[5] < 0.25)
    np.testing.assert_array_equal(drawn["category"], np.searchsorted([0.2, 0.7], u[6], side="right"))
    assert drawn["none"].shape == (0, RUNS)


def test_counting_asks_for_as_much():
    draws = asked(Draws.counting(np.full((1, 8), 0.5), np))
    assert draws.used == 7
    assert draws.drawn["log_uniform"].shape == (2, 8)
    assert draws.drawn["none"].shape == (0, 8)
    assert (draws.drawn["uniform"] == 4.0).all()


def test_a_name_is_drawn_once(uniforms):
    draws = Draws(uniforms, np)
    draws.unit("level")
    with pytest.raises(ValueError, match="'level' is drawn twice"):
        draws.unit("level")
