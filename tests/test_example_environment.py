"""The complete small example in the documentation: a user's own environment in one file."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from contract import assert_equals_its_vector
from environment_page import environment_table
from models import load_module, make_model

import filtergym
from filtergym.baselines.problem import problem_of

FOLDER = Path(__file__).parent.parent / "docs" / "examples"
ID = "mine/InvertedPendulum-v0"


@pytest.fixture(scope="module", autouse=True)
def example():
    yield from load_module(FOLDER / "inverted_pendulum.py")


def test_environment():
    env = assert_equals_its_vector(
        ID, [np.full(1, 0.1 * k) for k in range(8)], render_mode="rgb_array", horizon=8
    )
    assert env.render().ndim == 3


def test_closed_loop_flies_a_truth_of_its_own_on_the_same_noise():
    dataset = filtergym.evaluate(
        ID, ["kalman", "matching", "random", "known-gusts"], episodes=60, horizon=150
    )
    cost = dataset["cost"].mean(["episode", "time"]).to_series()
    assert cost["known-gusts"] < cost["matching"] < cost["kalman"]
    # Nominal noise and its covariance are right where the gusts are as believed.
    believed = filtergym.evaluate(ID, ["kalman"], episodes=200, horizon=50, gust_levels=(1.0, 1.0))
    nees = believed["nees"].values[0, :, 20:]
    assert abs(nees.mean() - 2.0) < 4 * nees.mean(axis=1).std() / np.sqrt(200)


def test_torch():
    torch = pytest.importorskip("torch")
    one = gymnasium.make_vec(ID, num_envs=2, horizon=8)
    other = gymnasium.make_vec(ID, num_envs=2, horizon=8, backend="torch")
    shown, _ = one.reset(seed=1)
    np.testing.assert_allclose(other.reset(seed=1)[0], shown, rtol=1e-13, atol=1e-13)
    action = np.full((2, 1), 0.3)
    for _ in range(8):
        shown, paid, *_ = one.step(action)
        tensor, reward, *_ = other.step(torch.tensor(action))
        # Sines and logarithms differ in the last bit, and the loop feeds that back.
        np.testing.assert_allclose(tensor, shown, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(reward, paid, rtol=1e-11, atol=1e-11)


def test_tables_of_its_page():
    problem = problem_of(ID)
    assert "| `nis` | 1 | log(1 + x) of normalised innovation squared |" in environment_table(
        problem, "fields"
    )
    assert "Limits of its true factor" in environment_table(problem, "parameters")
    assert "Knows the factor on the gusts at every moment." in environment_table(problem, "policies")
    assert make_model(ID).task.noise.uniforms == 3
