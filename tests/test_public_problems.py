"""The problems of benchmarks/public_problems.py: their equations, the reading of stored sets."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import scipy
from models import load_module

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def problems():
    """The module with its environments."""
    yield from load_module(ROOT / "benchmarks" / "public_problems.py", "benchmarks_public_problems")


def test_records_hold_the_tables_of_their_figures(problems):
    tables = {
        problems.PROBLEMS: problems.problem_table,
        "public_optimised": problems.problem_table,
        problems.DRIVES: problems.drive_table,
    }
    for name, table in tables.items():
        data = json.loads((problems.RECORDS / f"{name}.json").read_text(encoding="utf-8"))["data"]
        assert table(data.pop("figures")) == data


def test_equations_of_the_attractor(problems):
    """Against SciPy's integration, and the matrix series as KalmanNet writes it."""
    x = np.array([3.0, -4.0, 20.0])

    def slope(_, y):
        return [10.0 * (y[1] - y[0]), y[0] * (28.0 - y[2]) - y[1], y[0] * y[1] - 8.0 / 3.0 * y[2]]

    solved = scipy.integrate.solve_ivp(slope, (0.0, 0.02), x, rtol=1e-11, atol=1e-11).y[:, -1]
    # Of fourth order: half the step is a 16th of the error.
    coarse, fine = (np.abs(np.array(problems.flow(x, steps)) - solved).max() for steps in (2, 4))
    assert coarse / 24.0 < fine < coarse / 10.0
    A = np.array([[-10.0, 10.0, 0.0], [28.0, -1.0, -x[0]], [0.0, x[0], -8.0 / 3.0]])
    frozen = np.array([[-10.0, 10.0, 0.0], [28.0 - x[2], -1.0, 0.0], [x[1], 0.0, -8.0 / 3.0]])
    np.testing.assert_allclose(A @ x, frozen @ x)  # both give the derivative; KalmanNet's is the second
    for order in (2, 5):
        series = sum(np.linalg.matrix_power(0.02 * frozen, j) / math.factorial(j) for j in range(order + 1))
        np.testing.assert_allclose(problems.taylor(x, order), series @ x, rtol=1e-13)


def test_a_stored_linear_set_is_judged_as_a_naive_filter_judges_it(problems, tmp_path, capsys):
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    target = np.zeros((6, 2, 20))
    x = np.zeros((6, 2))
    for k in range(20):
        x = x @ problems.F.T + 0.1 * rng.standard_normal((6, 2))
        target[:, :, k] = x
    z = (target + rng.standard_normal(target.shape)).astype(np.float32)
    file = tmp_path / "Simulations" / "Linear_canonical" / "data" / "2x2_rq020_T100.pt"
    file.parent.mkdir(parents=True)
    nothing = torch.zeros(1)
    torch.save(
        [nothing] * 4 + [torch.tensor(z), torch.tensor(target.astype(np.float32))] + [nothing] * 3, file
    )
    squares = []
    for i in range(6):
        mean, P = np.zeros(2), np.zeros((2, 2))
        for k in range(20):
            mean, P = problems.F @ mean, problems.F @ P @ problems.F.T + 0.01 * np.eye(2)
            K = P @ np.linalg.inv(P + np.eye(2))
            mean, P = mean + K @ (z[i, :, k] - mean), P - K @ P
            squares.append((mean - target[i, :, k].astype(np.float32)) ** 2)
    recording = problems.stored_linear(tmp_path, problems.Linear.id)
    [row] = problems.judge("linear", problems.Linear.id, {"extended": "extended"}, recording, timed=False)
    assert row.mse_db == pytest.approx(10.0 * math.log10(np.mean(squares)), abs=1e-4)  # rounded
    assert row.low_db < row.mse_db < row.high_db


def test_a_filter_with_noises_of_its_own_uses_both(problems):
    """As factors on the model's covariances say; alike would also hold if both were left out."""
    own = {
        "own": problems.with_noises(9.0 * problems.LINEAR["Q"], 2.0 * problems.LINEAR["R"]),
        "factors": problems.Variant(problems.Extended, process_noise=9.0, measurement_noise=2.0),
        "written": "extended",
    }
    cost = problems.filtergym.evaluate(problems.Linear.id, own, episodes=5).cost
    np.testing.assert_allclose(cost.sel(policy="own"), cost.sel(policy="factors"), rtol=1e-12)
    assert np.abs(cost.sel(policy="own") / cost.sel(policy="written") - 1.0).max() > 0.1
