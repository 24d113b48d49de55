"""Innovations of recordings: measured less predicted, in sensor units, and whether they are white."""

import dataclasses
import itertools

import numpy as np
import pytest
import scipy

from filtergym import evaluate, record, tidy_records
from filtergym.baselines.log_scores import _Whiteness
from filtergym.evaluation.statistics.predictions import stretches_of

CASES = {
    "filtergym/ManeuveringTarget-v0": ("imm", "missed-detections", ["position"], ["m"]),
    "filtergym/LooselyCoupledNavigation-v0": ("plain-reduced", "outage", ["position"], ["m"]),
    "filtergym/RadarEsmTracking-v0": ("joint-type", "random", ["range", "range rate"], ["m", "m/s"]),
}


def naive_innovation(environment, recording, estimate, k):
    """Of measurement k > 0 of the first episode, from the estimate after the one before; None where nothing came."""
    measured = {name: values[0, k] for name, values in recording.measurements.items()}
    before = estimate[k - 1]
    if environment == "filtergym/RadarEsmTracking-v0":
        T = recording.seconds[0, k] - recording.seconds[0, k - 1]
        F = np.array([[1.0, T, T**2 / 2.0], [0.0, 1.0, T]])
        return measured["radar"] - F @ before
    if not measured["available"]:
        return None
    if environment == "filtergym/LooselyCoupledNavigation-v0":
        return measured["fix"] - (
            before + recording.measurements["ins"][0, k] - recording.measurements["ins"][0, k - 1]
        )
    return measured["position"] - (before[:2] + measured["interval"] * before[2:])


@pytest.fixture(scope="module", params=CASES)
def case(request):
    name, scenario, groups, units = CASES[request.param]
    recording = dataclasses.replace(record(request.param, scenario, 1, horizon=60), truth=None)
    return recording, name, groups, units, evaluate(request.param, [name], recording, tracks=True)


def test_they_are_those_of_a_loop(case):
    """To rounding: sums in another order, of numbers up to 1e5 m."""
    recording, name, _, _, dataset = case
    found = dataset["prediction_error"].sel(policy=name).values[0]
    estimate = dataset["estimate"].sel(policy=name).values[0]
    assert np.isnan(found[0]).all()
    for k in range(1, 60):
        expected = naive_innovation(dataset.attrs["environment"], recording, estimate, k)
        if expected is None:
            assert np.isnan(found[k]).all()
        else:
            np.testing.assert_allclose(found[k], expected, atol=1e-9)


def test_records_say_how_large_and_how_white_they_are(case):
    _, name, groups, units, dataset = case
    records = {(r.metric, r.component): r for r in tidy_records(dataset) if r.policy == name}
    every = dataset["prediction_error"].sel(policy=name).values[0]
    for group, unit in zip(groups, units, strict=True):
        mine = every[:, (dataset["measured_group"] == group).values]
        there = np.isfinite(mine).all(axis=1)
        error = records["prediction_error", group]
        assert error.value == pytest.approx(np.sqrt((mine[there] ** 2).sum(axis=1).mean()), rel=1e-12)
        assert error.low < error.value < error.high
        assert error.unit == unit
        pairs = [(a, b) for a, b in itertools.pairwise(mine) if np.isfinite(a + b).all()]
        products = sum(a @ b for a, b in pairs), sum(0.5 * (a @ a + b @ b) for a, b in pairs)
        assert records["innovation_correlation", group].value == pytest.approx(
            products[0] / products[1], rel=1e-9
        )


def test_without_tracks_or_for_a_smoother_there_are_no_innovations():
    recording = record("filtergym/ManeuveringTarget-v0", "paper", 1, horizon=20)
    assert "prediction_error" not in evaluate(recording.environment, ["imm"], recording)
    dataset = evaluate(recording.environment, ["imm", "kalman-smoother"], recording, tracks=True)
    competitors = {r.policy for r in tidy_records(dataset) if r.metric == "prediction_error"}
    assert competitors == {"imm"}
    assert "prediction_error" not in evaluate(
        recording.environment, ["imm"], "paper", episodes=2, tracks=True
    )


def test_whiteness_is_of_each_sensor_from_one_of_its_measurements_to_the_next():
    """White errors of one sensor at every third measurement beside those of another that repeat themselves by half."""
    rng = np.random.default_rng(4)
    errors = np.full((2, 1, 3000), np.nan)
    errors[0, 0, ::3] = rng.normal(0.0, 5.0, 1000)
    errors[1, 0] = scipy.signal.lfilter([1.0], [1.0, -0.5], rng.normal(0.0, 1.0, 3000))
    whiteness = _Whiteness(stretches_of(np.ones((1, 3000), dtype=bool)), np.array([True, False]))
    for first, last in ((0, 1000), (1000, 3000)):
        whiteness.add(errors[..., first:last], first)
    _, gps, odometry = whiteness.correlations()
    assert gps.low < 0.0 < gps.high
    assert odometry.low < 0.5 < odometry.high
    naive = errors[0, 0, ::3]
    expected = (naive[1:] * naive[:-1]).sum() / (0.5 * (naive[1:] ** 2 + naive[:-1] ** 2)).sum()
    np.testing.assert_allclose(gps.value, expected, rtol=1e-12)
