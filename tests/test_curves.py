"""Curves of an evaluation, variable by variable against loops over its episodes."""

import dataclasses
import math
import re

import numpy as np
import pytest
import xarray
from models import make_model
from scipy.stats import chi2

from filtergym import evaluate, record
from filtergym.envs.contract.companions import LoopRecords
from filtergym.envs.engine.catalogue import task_class
from filtergym.evaluation.running.curves import curves_of
from filtergym.evaluation.running.named_axes import action_names
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.evaluation.storage.dataset import windows_of

TARGET = "filtergym/ManeuveringTarget-v0"
RADAR = "filtergym/RadarEsmTracking-v0"
PILOT = "filtergym/UavAutopilot-v0"
NAMES = ["imm", "adaptive", "kalman-imm", "known-turn", "known-input-bound"]
POSITION = ["position_x", "position_y"]


@pytest.fixture(scope="module")
def dataset() -> xarray.Dataset:
    return evaluate(TARGET, NAMES, "paper", 30, seed=2, horizon=60)


@pytest.fixture(scope="module")
def curves(dataset) -> xarray.Dataset:
    return curves_of(dataset)


@pytest.fixture(scope="module")
def flights() -> xarray.Dataset:
    """Two recorded flights, of which the second is shorter; one scan in five misses the target."""
    recording = record(TARGET, episodes=4, horizon=30, detection_probability=(0.8, 0.8))
    lengths = recording.lengths - np.array([0, 12, 0, 12])
    seconds = np.where(np.arange(recording.seconds.shape[1]) <= lengths[:, None], recording.seconds, np.nan)
    return evaluate(
        TARGET, ["imm", "adaptive"], dataclasses.replace(recording, lengths=lengths, seconds=seconds)
    )


def naive_rmse(error, weights=None):
    total = weight = 0.0
    for episode, (x, y) in enumerate(error):
        if not math.isnan(x):
            w = 1.0 if weights is None else weights[episode]
            total += w * (x * x + y * y)
            weight += w
    return math.sqrt(total / weight)


def test_root_mean_square_error_with_its_band(dataset, curves):
    weights = Bootstrap(30, 200).weights
    for name in NAMES[:4]:
        errors = dataset["error"].sel(policy=name, component=POSITION).values
        here = curves.sel(policy=name, quantity="position")
        for k in (0, 31, 59):
            assert here["rmse"].values[k] == pytest.approx(naive_rmse(errors[:, k]))
            resampled = [naive_rmse(errors[:, k], row) for row in weights[1:]]
            assert here["rmse_low"].values[k] == pytest.approx(np.percentile(resampled, 2.5))
            assert here["rmse_high"].values[k] == pytest.approx(np.percentile(resampled, 97.5))
    square = dataset["mean_square"].sel(policy="known-input-bound", component=POSITION).sum("component")
    np.testing.assert_allclose(
        curves["rmse"].sel(policy="known-input-bound", quantity="position"), np.sqrt(square.mean("episode"))
    )


def test_what_a_share_of_measurements_exceeds(dataset, curves):
    error = np.sqrt((dataset["error"].sel(policy="imm", component=POSITION) ** 2).sum("component")).values
    found = curves["error_exceeded"].sel(policy="imm", quantity="position")
    for size, share in zip(found.values, found["share"].values, strict=True):
        if share * error.size < 1.0 - 1e-9:
            assert math.isnan(size)
        else:
            assert (error >= size).sum() == round(share * error.size)
    assert np.isnan(found.values).sum() == sum(share * 1800 < 1.0 for share in found["share"].values)
    assert np.isnan(curves["error_exceeded"].sel(policy="known-input-bound")).all()
    assert (found["share"].values[0], found["share"].values[-1], len(found)) == (1e-4, 1.0, 121)


@pytest.mark.parametrize(("metric", "degrees"), [("nees", 4), ("nis", 2)])
def test_consistency_with_its_band(dataset, curves, metric, degrees):
    values = dataset[metric].sel(policy="imm").values
    np.testing.assert_allclose(curves[f"a{metric}"].sel(policy="imm"), values.mean(axis=0) / degrees)
    for ending, probability in (("low", 0.025), ("high", 0.975)):
        expected = chi2.ppf(probability, 30 * degrees) / (30 * degrees)
        assert curves[f"a{metric}_{ending}"].dims == ("time",)
        np.testing.assert_allclose(curves[f"a{metric}_{ending}"], expected)
    assert np.isnan(curves["anees"].sel(policy="known-input-bound")).all()


def test_probabilities(dataset, curves):
    weights = Bootstrap(30, 200).weights
    values = dataset["mode_probability"].sel(policy="imm", mode="mode_2").values
    found = curves.sel(policy="imm", mode="mode_2")
    np.testing.assert_allclose(found["mode_probability"], values.mean(axis=0))
    low, high = np.percentile(
        [(row[:, None] * values).sum(axis=0) for row in weights[1:]], [2.5, 97.5], axis=0
    )
    np.testing.assert_allclose(found["mode_probability_low"], low)
    np.testing.assert_allclose(found["mode_probability_high"], high)
    assert np.isnan(curves["mode_probability"].sel(policy="adaptive")).all()
    assert "true_class_probability" not in curves
    radar = evaluate(RADAR, ["quasi-optimal"], episodes=12, horizon=16)
    found = curves_of(radar)
    assert found["true_class_probability"].dims == ("policy", "time")
    expected = radar["true_class_probability"].mean("episode")
    np.testing.assert_allclose(found["true_class_probability"], expected)
    assert (found["true_class_probability_low"] <= expected).all()


def test_actions_and_gains(dataset, curves):
    """``adaptive`` sets a gain, the paper's IMM the weights that become its probabilities; no other competitor acts."""
    assert curves["action_name"].values.tolist() == ["weights: mode_1", "weights: mode_2", "gain: gain"]
    weights = dataset["action"].sel(policy="imm").values[..., :2]
    # In single precision, as the action space has them.
    np.testing.assert_allclose(weights, dataset["mode_probability"].sel(policy="imm"), atol=1e-6)
    np.testing.assert_allclose(curves["action"].sel(policy="imm").values[:2], weights.mean(axis=0).T)
    assert np.isnan(curves["action"].sel(policy="imm").values[2]).all()
    model = make_model(TARGET, "gain", "paper", horizon=60)
    action = dataset["action"].sel(policy="adaptive", action_name="gain: gain").values
    # Another way to the same number: the gain that the bank has recorded.
    np.testing.assert_allclose(dataset["alpha"].sel(policy="adaptive"), model.filter.alpha(action[None]))
    found = curves.sel(policy="adaptive", action_name="gain: gain")
    for name, expected in (
        ("action", action.mean(axis=0)),
        ("action_low", np.percentile(action, 10, axis=0)),
        ("action_high", np.percentile(action, 90, axis=0)),
    ):
        np.testing.assert_allclose(found[name], expected)
    alpha = dataset["alpha"].sel(policy="adaptive").values
    gain = curves.sel(policy="adaptive", gain_name="alpha")
    np.testing.assert_allclose(gain["gain"], alpha.mean(axis=0))
    np.testing.assert_allclose(gain["gain_high"], np.percentile(alpha, 90, axis=0))
    assert np.isnan(curves["gain"].sel(policy="imm")).all()


def test_an_action_is_recorded_as_the_box_bounds_it():
    class Bold:
        control = "gain"

        def __init__(self, task):
            pass

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.full((len(observation), 1), 3.0), state

    found = evaluate(TARGET, {"bold": Bold}, "paper", 3, horizon=4)
    assert (found["action"].values == 1.0).all()
    assert found["action_name"].values.tolist() == ["gain"]
    assert "action" not in evaluate(PILOT, ["over-smoothed"], "paper-noise", 2, horizon=4)  # it names a mode
    assert "action" not in curves_of(evaluate(TARGET, ["known-turn"], "paper", 2, horizon=4))


@pytest.mark.parametrize(
    ("env", "control", "expected"),
    [
        (TARGET, "weights", ("mode_1", "mode_2")),
        (TARGET, "gain", ("gain",)),
        ("filtergym/UavAutopilot-v0", "noise", ("process", "pitch", "rate", "elevator")),
        ("filtergym/LooselyCoupledNavigation-v0", "noise", ("receiver", "coloured", "white")),
    ],
)
def test_names_of_actions(env, control, expected):
    model = make_model(env, control)
    found = action_names(model)
    assert len(found) == len(set(found)) == model.action_space.shape[0]
    assert found == expected


def test_shorter_flights_are_left_out_where_they_are_over(flights):
    curves = curves_of(flights)
    assert flights.sizes["time"] == 30
    errors = flights["error"].sel(policy="imm", component=POSITION).values
    for k in (5, 29):
        found = curves["rmse"].sel(policy="imm", quantity="position").values[k]
        assert found == pytest.approx(naive_rmse(errors[:, k]))
    seen = flights["nis_degrees"].sel(policy="imm").values
    with np.errstate(invalid="ignore"):
        expected = np.nansum(flights["nis"].sel(policy="imm").values, axis=0) / np.nansum(seen, axis=0)
    np.testing.assert_allclose(curves["anis"].sel(policy="imm"), expected)
    action = flights["action"].sel(policy="adaptive", action_name="gain: gain").values
    np.testing.assert_allclose(
        curves["action"].sel(policy="adaptive", action_name="gain: gain"), np.nanmean(action, axis=0)
    )
    low = curves["action_low"].sel(policy="adaptive", action_name="gain: gain")
    np.testing.assert_allclose(low, np.nanpercentile(action, 10, axis=0))


def test_without_truth_there_are_no_errors():
    recording = dataclasses.replace(record(TARGET, "paper", 3), truth=None)
    curves = curves_of(evaluate(TARGET, ["imm", "kalman-imm"], recording))
    assert not {name for name in curves.variables if re.match("rmse|error|quantity|anees|mean_cost", name)}
    assert {"anis", "mode_probability", "action"} <= set(curves)


def test_the_description_of_the_curves(dataset, curves, tmp_path):
    assert windows_of(curves) == windows_of(dataset)
    assert curves["quantity"].values.tolist() == ["position", "velocity"]
    assert curves["unit"].values.tolist() == ["m", "m/s"]
    assert curves["kind"].values.tolist()[1:] == ["policy", "estimator", "reference", "bound"]
    np.testing.assert_array_equal(curves["elapsed"], dataset["elapsed"])
    same = ("environment", "scenario", "split", "seed", "paper", "reference", "cost", "truth", "recorded")
    best = {"best": "kalman-imm"}  # of those that are ranked
    assert curves.attrs == {"episodes": 30, **best, **{name: dataset.attrs[name] for name in same}}
    expected = dataset["cost"].mean(["episode", "time"])
    np.testing.assert_allclose(curves["mean_cost"].values[:4], expected.values[:4])
    assert "episode" not in curves.dims
    assert all(variable.dtype == np.float64 for variable in curves.data_vars.values())
    dataset.to_netcdf(tmp_path / "x.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "x.nc", engine="scipy") as read:
        xarray.testing.assert_identical(curves_of(read.load()), curves)
    curves.to_netcdf(tmp_path / "curves.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "curves.nc", engine="scipy") as read:
        xarray.testing.assert_identical(read.load(), curves)
    alone = curves_of(dataset.sel(policy=["imm"]))
    np.testing.assert_array_equal(alone["rmse"].values[0], curves["rmse"].values[0])


def test_names_that_an_evaluation_keeps_are_refused(monkeypatch):
    cls = task_class(TARGET)
    report = LoopRecords(lambda model, episode, kept: {"action": episode.truth[0]})
    monkeypatch.setattr(cls, "companions", (report, *cls.companions))
    with pytest.raises(ValueError, match="records a value named 'action'"):
        evaluate(TARGET, "imm", "paper", 2, horizon=3, backend="numpy")
