"""The engine's noise, beside its code: every measurement takes the next row of its episode, also across blocks."""

import numpy as np
from filtergym.envs.lanes import Lanes
from filtergym.envs.noise_ring import BLOCK, LONGEST_BLOCK
from models import make_model

ID = "filtergym/ManeuveringTarget-v0"


def naive_rows(seed, noise, rows):
    """Rows of noise of one long episode, as the module describes them."""
    generator = np.random.default_rng(seed)
    generator.random(noise.uniforms)
    generator.standard_normal(noise.initial_normals)
    child = np.random.default_rng(generator.integers(0, 2**63, size=2))
    return child.standard_normal((rows, noise.normals))


def test_long_episodes_take_one_row_after_another(monkeypatch):
    horizon = LONGEST_BLOCK + 10
    scans = {"detection_probability": (1.0, 1.0), "scan_jitter": (0.0, 0.0)}
    model = make_model(ID, "gain", horizon=horizon, **scans)
    assert model.task.noise.row_uniforms == 0
    taken = []
    measure = model.measure
    monkeypatch.setattr(
        model, "measure", lambda state, row: (taken.append(row.copy()), measure(state, row))[1]
    )
    lanes = Lanes(model, 2)
    for lane in range(2):
        lanes.seed(lane, np.random.default_rng(10 + lane))
    lanes.restart()
    for _ in range(3 * BLOCK):
        lanes.decide(np.zeros((2, 1)))
    for lane in range(2):
        expected = naive_rows(10 + lane, model.task.noise, 3 * BLOCK + 1)
        np.testing.assert_array_equal(np.array(taken)[:, :, lane], expected)
