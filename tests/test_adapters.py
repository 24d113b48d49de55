"""Filters of other libraries as estimators: filterpy and Stone Soup against ours, and every example of the page."""

import importlib.util
import re
import runpy
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from models import make_model
from own_models import forget

import filtergym
from filtergym import adapters
from filtergym.adapters import SingleTrackEstimator
from filtergym.baselines.catalogue import baselines_of
from filtergym.envs.contract.filter import Initial
from filtergym.envs.maneuvering_target.constant_velocity import KalmanModel
from filtergym.evaluation.running.rollout import rollout
from filtergym.filters import kalman

ID = "filtergym/ManeuveringTarget-v0"
EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"
LIBRARIES = {"filterpy_filters": "filterpy", "autopilot_kalman": "filterpy", "stone_soup_kalman": "stonesoup"}
"""What the examples need; `mine` needs nothing."""


def example(name):
    if name in LIBRARIES:
        pytest.importorskip(LIBRARIES[name], reason=f"{LIBRARIES[name]} is in filtergym[adapters]")
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def estimates(maker, scenario="random", episodes=8, **keywords):
    """Mean, (time, 4, episodes), and covariance over its largest entry, (time, 4, 4, episodes)."""
    model = make_model(ID, scenario=scenario, **keywords)
    answers = [
        (e.filter.mean, e.filter.covariance) for e, _ in rollout(model, maker(model.task), range(episodes))
    ]
    means, covariances = map(np.stack, zip(*answers, strict=True))
    return means, covariances / abs(covariances).max(axis=(1, 2), keepdims=True)


def compare(one, other, growth=1.0, **keywords):
    """Assert equality up to rounding, of positions of some 10^4 m, and ``growth`` of it.

    Covariances are relative to their largest entry.
    """
    (mean, covariance), (expected, theirs) = estimates(one, **keywords), estimates(other, **keywords)
    np.testing.assert_allclose(mean[:, :2], expected[:, :2], rtol=0, atol=growth * 1e-10)  # m
    np.testing.assert_allclose(mean[:, 2:], expected[:, 2:], rtol=0, atol=growth * 1e-11)  # m/s
    np.testing.assert_allclose(covariance, theirs, rtol=0, atol=growth * 1e-14)


class OurKalman(KalmanModel):
    """filters/kalman.py over the model of the examples."""

    def model(self, interval):
        F, Q = self.motion(interval)
        return F, 2.0**2 * Q

    def update(self, state, given):
        predicted = kalman.predict(*state[:2], *self.model(given.measurement.interval))
        return self.track(given.measurement, self.update_estimate(predicted, given.measurement))


class OurContinuousKalman(OurKalman):
    """The same for acceleration that is white in continuous time, of 24 m^2/s^3."""

    def model(self, interval):
        powers = [[interval**3 / 3, interval**2 / 2], [interval**2 / 2, interval]]
        Q = [[24.0 * powers[i // 2][j // 2] * (i % 2 == j % 2) for j in range(4)] for i in range(4)]
        return self.motion(interval)[0], np.array(Q)


WITH_BOTH = {"scenario": "irregular-scans", "detection_probability": (0.7, 0.7)}
"""Scans that miss the target, and come early."""


def test_imm_of_filterpy_is_ours_at_every_step():
    """An IMM amplifies rounding: 7e-10 m were the most in 32 flights of each scenario."""
    ours = baselines_of(ID).estimators["kalman-imm"]
    compare(example("filterpy_filters").Imm, ours, growth=20.0, **WITH_BOTH)


def test_kalman_filters_are_ours():
    filters = example("filterpy_filters")
    compare(filters.Kalman, OurKalman, **WITH_BOTH)

    class Extended(filters.Kalman):
        """Of a linear measurement."""

        def begin(self, initial):
            ekf = filters.constant_velocity(filters.ExtendedKalmanFilter(4, 2), 6.0, 2.0)
            ekf.x, ekf.P = initial.mean, initial.covariance
            return ekf

        def step(self, track, measurement):
            z, R = self.reading(measurement)
            self.predict(track, measurement.interval)
            if z is not None:
                track.update(z, lambda x: np.eye(2, 4), lambda x: x[:2], R)

    compare(Extended, OurKalman, **WITH_BOTH)

    class Unscented(filters.Kalman):
        """Of a linear motion and measurement, and a state in another order."""

        state = ("velocity_x", "position_x", "velocity_y", "position_y")

        def begin(self, initial):
            points = filters.MerweScaledSigmaPoints(4, 1.0, 2.0, -1.0)

            def moved(x, T):
                return np.kron(np.eye(2), [[1.0, 0.0], [T, 1.0]]) @ x

            ukf = filters.UnscentedKalmanFilter(4, 2, 6.0, lambda x: x[[1, 3]], moved, points)
            ukf.x, ukf.P = initial.mean, initial.covariance
            return ukf

        def predict(self, track, interval):
            G = np.array([interval, interval**2 / 2])
            track.Q = np.kron(np.eye(2), 4.0 * np.outer(G, G))
            track.predict(dt=interval)

    compare(Unscented, OurKalman, growth=20.0, **WITH_BOTH)  # sums over sigma points cancel


def test_kalman_filter_of_stone_soup_is_ours():
    stone_soup = example("stone_soup_kalman")
    on_time = {"scenario": "missed-detections", "scan_jitter": (0.0, 0.0)}
    compare(stone_soup.Kalman, OurContinuousKalman, **on_time, episodes=4)
    # Its clock counts microseconds, in which a target flies 0.3 mm.
    mean, expected = (
        estimates(one, "irregular-scans", 2)[0] for one in (stone_soup.Kalman, OurContinuousKalman)
    )
    np.testing.assert_allclose(mean, expected, rtol=0, atol=1e-3)


def test_plain_kalman_filter_of_the_page_is_ours():
    compare(lambda task: example("mine").Mine(), OurKalman, **WITH_BOTH)


def test_extended_and_unscented_filters_of_the_page_follow():
    filters = example("filterpy_filters")
    makers = {name: getattr(filters, name) for name in ("Extended", "Unscented", "Kalman")}
    result = filtergym.evaluate(ID, makers, episodes=4, horizon=30, polar_measurements=True)
    cost = result.cost.mean(["episode", "time"]).values
    # At these ranges the first is nearly the Kalman filter.
    assert abs(cost[0] / cost[2] - 1.0) < 0.2
    assert cost[1] < 2.0 * cost[2]


@pytest.mark.parametrize("plant", ["U", "P"])
def test_filterpy_closes_the_loop_like_the_papers_filter(plant):
    competitors = {"mine": example("autopilot_kalman").Kalman, "kalman": "kalman"}
    result = filtergym.evaluate("UavAutopilot", competitors, episodes=3, horizon=150, plant=plant)
    for name in ("error", "cost", "control_signal", "nees"):
        mine, paper = result[name].values
        np.testing.assert_allclose(mine, paper, rtol=1e-11, atol=1e-12, err_msg=name)


class Permuted(SingleTrackEstimator):
    """Keeps the start, in an order of its own and with an unused number."""

    state = ("turn_rate", "velocity_y", "position_x", "position_y", "velocity_x")

    def begin(self, initial):
        self.began = initial
        covariance = initial.covariance.copy()
        covariance[0, 0] = 1.0
        return [initial.mean, covariance]

    def step(self, track, measurement):
        track[0] = track[0] + 1.0  # in place, so that nothing is returned

    def estimate(self, track):
        return track


def test_states_are_mapped_both_ways():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    initial = Initial(rng.normal(size=(4, 3)), np.repeat((root @ root.T)[:, :, None], 3, axis=-1))
    estimator = Permuted(make_model(ID).task)
    memory = estimator.start(initial, 3)
    np.testing.assert_array_equal(estimator.began.mean, [0.0, *initial.mean[[3, 0, 1, 2], 2]])
    np.testing.assert_array_equal(estimator.began.covariance[0], 0.0)
    assert estimator.began.covariance[1, 4] == initial.covariance[3, 2, 2]

    class Measured(NamedTuple):
        position: np.ndarray

    mean, covariance, memory = estimator.update(memory, Measured(np.zeros((2, 3))))
    np.testing.assert_array_equal(mean, initial.mean + 1.0)
    np.testing.assert_array_equal(covariance, initial.covariance)


def test_a_state_that_does_not_fit_is_a_sentence():
    class Lacking(Permuted):
        state = ("position_x", "velocity_x", "position_y")

    with pytest.raises(ValueError, match=r"the state of Lacking, .* lacks velocity_y of filtergym/Man"):
        filtergym.evaluate(ID, {"mine": Lacking}, episodes=1, horizon=2)

    class Wide(Permuted):
        def estimate(self, track):
            return np.zeros(6), np.eye(6)

    with pytest.raises(
        ValueError, match=r"Wide has 6 numbers and a covariance .* `state` names 5: turn_rate"
    ):
        filtergym.evaluate(ID, {"mine": Wide}, episodes=1, horizon=2)

    class Elsewhere(Permuted):
        state = ()

        def begin(self, initial):
            return [initial.mean, initial.covariance + np.eye(len(initial.mean))]

        def step(self, track, measurement):
            self.reading(measurement)

    with pytest.raises(
        ValueError, match=r"RadarEsmTracking-v0 measures scan, radar, .*: Elsewhere must define a"
    ):
        filtergym.evaluate("RadarEsmTracking", {"mine": Elsewhere}, episodes=1, horizon=4)


def test_without_a_measurement_filterpy_only_predicts():
    filters = example("filterpy_filters")

    class Deaf(filters.Kalman):
        def reading(self, measurement):
            return None, np.eye(2)

    class Predicting(OurKalman):
        def update(self, state, given):
            mean, covariance = kalman.predict(
                state.mean, state.covariance, *self.model(given.measurement.interval)
            )
            return state._replace(mean=mean, covariance=covariance)

    compare(Deaf, Predicting, horizon=5)


def test_a_filter_for_one_interval_refuses_another():
    filters = example("filterpy_filters")

    class Rigid(filters.Kalman):
        predict = adapters.FilterpyEstimator.predict

    compare(Rigid, OurKalman, scenario="missed-detections", horizon=5)
    with pytest.raises(
        ValueError, match=r"Rigid predicts over 6 s, and a measurement comes after .* s: it must"
    ):
        filtergym.evaluate(ID, {"mine": Rigid}, "irregular-scans", episodes=1, horizon=5)


@pytest.mark.parametrize(
    ("library", "adapter"), [("stonesoup", "StoneSoupEstimator"), ("filterpy", "FilterpyEstimator")]
)
def test_a_library_that_is_not_installed_is_a_sentence(library, adapter, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, library, None)  # as if it were not there
    with pytest.raises(
        ImportError, match=rf"{adapter} needs {library}: pip install .*'filtergym\[adapters\]'"
    ):
        getattr(adapters, adapter)
    (tmp_path / "wants_library.py").write_text(f"from filtergym.adapters import {adapter}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "wants_library", raising=False)
    with pytest.raises(
        ValueError, match=f"cannot load policy 'wants_library:Mine': ImportError: {adapter} needs"
    ):
        filtergym.evaluate(ID, ["wants_library:Mine"], episodes=1)


def test_calls_of_filterpy_and_ours_agree(tmp_path, monkeypatch, capsys):
    pytest.importorskip("filterpy", reason="filterpy is in filtergym[adapters]")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / "from_filterpy.py"))
    for name in ("Tracker", "Beacon", "Switching"):
        forget(f"mine/{name}-v0")
    differences = dict(re.findall(r"^(.*?) +differ by (\S+)$", capsys.readouterr().out, re.MULTILINE))
    assert len(differences) == 11
    # FilterPy's unscented filter does not draw its points anew after the prediction.
    assert 1e-4 < float(differences.pop("unscented")) < 1e-2
    # Twenty steps of states of some 200 m: rounding of one, 3e-14, grows a little.
    assert max(map(float, differences.values())) < 1e-12
