"""The five machines of docs/examples/own_logs: their logs fit their models, and a late camera is taken in in order."""

import importlib
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from own_models import forget

import filtergym
from filtergym import read_recording

FOLDER = Path(__file__).parent.parent / "docs" / "examples" / "own_logs"
SHORT = {
    "gps_odometry": {"seconds": 6},
    "level_gauge": {"days": 1},
    "pitch_roll": {"seconds": 3},
    "battery": {"seconds": 200},
    "late_vision": {"seconds": 2},
}


def log_of(name, folder):
    """Short log of a machine, its columns and its file."""
    log = importlib.import_module("make_logs").MACHINES[name](np.random.default_rng(7), **SHORT[name])
    file = folder / f"{name}.csv"
    table = np.column_stack(list(log.values()))
    text = "\n".join(
        [",".join(log), *(",".join("" if x != x else repr(x) for x in row) for row in table.tolist())]
    )
    file.write_text(text + "\n", encoding="utf-8")
    return log, file


@pytest.fixture
def machine(request, monkeypatch):
    """The module of one of them; its environment is forgotten afterwards."""
    monkeypatch.syspath_prepend(FOLDER)
    module = importlib.import_module(request.param)
    yield module
    sys.modules.pop(request.param)  # it registers where it is imported
    forget(environment(module))


def environment(module):
    return next(cls.id for cls in vars(module).values() if hasattr(cls, "definition"))


@pytest.mark.parametrize("machine", SHORT, indirect=True)
def test_the_log_of_a_machine_fits_its_model(machine, tmp_path):
    """Every column is read, and errors are within a factor of ten of what the filter states: no unit is mistaken."""
    log, file = log_of(machine.__name__, tmp_path)
    assert len((FOLDER / f"{machine.__name__}.py").read_text().splitlines()) <= 40
    recording = read_recording(file, environment(machine))
    assert not [note for note in recording.notes if "not read" in note]
    run = filtergym.evaluate(environment(machine), ["kalman"], recording, backend="numpy", tracks=True)
    nees = run["nees"].values.ravel()[len(log["time"]) // 2 : len(log["time"])]
    assert 0.01 < np.mean(nees) / run.sizes["component"] < 100.0


@pytest.mark.parametrize("machine", ["late_vision"], indirect=True)
def test_a_late_camera_is_as_one_in_time(machine, tmp_path):
    log, _ = log_of("late_vision", tmp_path)
    seen = np.isfinite(log["camera"])
    fixes = list(zip(log["time"][seen], log["time"][seen] + 0.15 - 1e-6, log["camera"][seen], strict=True))
    fixes = [fix for fix in fixes if fix[1] <= log["time"][-1]]
    estimates = machine.follow("extended", zip(log["time"], log["acceleration"], strict=True), fixes)
    ordered = filtergym.online("mine/LateVision-v0", "extended")
    ordered.start(mean=[0, 0, 0], covariance=machine.Rail.definition.covariance)
    for time, acceleration, camera in zip(log["time"], log["acceleration"], log["camera"], strict=True):
        taken = camera if time in [fix[0] for fix in fixes] else math.nan
        found = ordered.update(time, acceleration=acceleration, camera=taken)
    assert len(fixes) >= 8
    np.testing.assert_array_equal(estimates[-1], found.mean)
