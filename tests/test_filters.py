"""One noun: whatever competes is a filter in the loop, compiled or asked in Python, with the same numbers."""

import math

import numpy as np
import pytest
from models import make_model
from scipy.stats import multivariate_normal

import filtergym
from filtergym.baselines.catalogue import baselines_of
from filtergym.envs.contract.filter import Likelihood
from filtergym.evaluation.competitors.filters import close_loop, find_fault, is_lacking
from filtergym.evaluation.competitors.kinds import kind_of
from filtergym.evaluation.running.rollout import rollout, start_lanes
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.filters import packed_covariance

TARGET = "filtergym/ManeuveringTarget-v0"
SHORT = {"filtergym/TightlyCoupledNavigation-v0": {"horizon": 20}}


class Kalman:
    """A user's constant-velocity filter, from its equations alone; it returns the likelihood of each scan."""

    traceable = True

    def __init__(self, task):
        self.xp = task.xp

    def start(self, initial, N):
        return initial.mean, initial.covariance

    def update(self, memory, measurement):
        xp, (m, P), T = self.xp, memory, measurement.interval
        one, zero = 1.0 + 0.0 * T, 0.0 * T
        rows = [[one, zero, T, zero], [zero, one, zero, T], [zero, zero, one, zero], [zero, zero, zero, one]]
        F = xp.stack([xp.stack(row) for row in rows])
        g = xp.stack([0.5 * T * T, 0.5 * T * T, T, T])
        same = xp.asarray([[float((i - j) % 2 == 0) for j in range(4)] for i in range(4)])[:, :, None]
        m = xp.sum(F * m[None], axis=1)
        P = xp.sum(F[:, :, None] * P[None], axis=1)
        P = xp.sum(P[:, None] * F[None], axis=2) + 4.0 * same * g[:, None] * g[None]
        there = measurement.available > 0.0
        density = nis = zero
        for i in range(2):  # one coordinate after the other
            S = P[i, i] + measurement.variance[i]
            innovation = xp.where(there, measurement.position[i] - m[i], 0.0)
            K = xp.where(there, 1.0, 0.0) * P[:, i] / S
            nis = nis + innovation * innovation / S
            density = density - 0.5 * (innovation * innovation / S + xp.log(2.0 * math.pi * S))
            m, P = m + K * innovation, P - K[:, None] * P[i][None]
            P = 0.5 * (P + xp.moveaxis(P, 0, 1))
        likelihood = Likelihood(
            xp.where(there, density, math.nan), xp.where(there, nis, math.nan), 2.0 * measurement.available
        )
        return m, P, (m, P), likelihood


class InPython(Kalman):
    traceable = False


def test_shipped_filters_are_traced(env_id):
    """All; of TightlyCoupledNavigation, where they take 300 MB together, every third."""
    known, usual = baselines_of(env_id), SHORT.get(env_id, {"horizon": 40})
    groups = {"estimator": known.estimators, "reference": known.references, "bound": known.bounds}
    groups["smoother"] = known.smoothers
    for kind, group in groups.items():
        for name, maker in list(group.items())[:: 3 if env_id in SHORT else 1]:
            keywords = {**getattr(maker, "task_keywords", {}), **usual}
            fast = close_loop(make_model(env_id, **keywords, backend="compiled"), maker, kind, name, 8)
            assert kind_of(maker) == kind
            assert not fast.filter.in_python, name
            assert fast.backend == "compiled", name


def test_a_traceable_class_is_compiled_with_the_results_of_python():
    arguments = {"scenario": "missed-detections", "episodes": 12, "seed": 1}
    found = filtergym.evaluate(TARGET, {"traced": Kalman, "asked": InPython}, **arguments, horizon=50)
    for name in ("error", "cost", "nees", "nis", "nis_degrees", "log_likelihood", "lost"):
        one, other = (found[name].sel(policy=policy).values for policy in ("traced", "asked"))
        # Rounding that is forgotten within some scans; positions of 1e5 m are known to 1e-11 m.
        size = 1e5 if name == "error" else np.nanmax(abs(other)) + 1.0
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e4 * np.finfo(float).eps * size)
    assert np.isnan(found["log_likelihood"].values).any()
    model = make_model(TARGET, backend="compiled")
    assert not close_loop(model, Kalman, "estimator", "mine", 8).filter.in_python
    assert close_loop(model, InPython, "estimator", "mine", 8).filter.in_python
    # An object was made for arrays of NumPy, whatever its class declares.
    assert close_loop(model, Kalman(model.task), "estimator", "mine", 8).filter.in_python


def test_a_class_that_wrongly_claims_to_be_traceable_runs_in_python_with_a_warning():
    class Branches(InPython):
        traceable = True

        def update(self, memory, measurement):
            if float(measurement.available[0]) > 0.0:
                return super().update(memory, measurement)
            return *memory, memory

    with pytest.warns(UserWarning, match="'mine' of filtergym/ManeuveringTarget-v0 is not compiled"):
        found = filtergym.evaluate(TARGET, {"mine": Branches}, episodes=8, horizon=5, backend="compiled")
    assert np.isfinite(found["error"].values).all()


def test_log_likelihood_is_the_density_of_every_measurement_as_it_was_predicted():
    """Of a Kalman filter by SciPy's density of the prediction, measurement by measurement."""
    model = make_model(TARGET, scenario="missed-detections", horizon=30)
    maker = baselines_of(TARGET).estimators["unscented-turn"]
    run = [(e.measurement, e.filter) for e, _ in rollout(model, maker, episode_seeds("test", 5, 8))]
    seen = missed = 0
    for measurement, state in run:
        for lane in range(8):
            density = state.own.likelihood.log_likelihood[lane]
            if measurement.available[lane] == 0.0:
                assert math.isnan(density)
                assert state.own.likelihood.nis_degrees[lane] == 0.0
                missed += 1
                continue
            # P is the posterior of H P' H^T + R: invert the update of the position, which is linear.
            R = np.diag(measurement.variance[:, lane])
            P = state.covariance[:2, :2, lane]
            predicted = np.linalg.inv(np.linalg.inv(P) - np.linalg.inv(R))
            S = predicted + R
            # K = P' S^-1, and the posterior innovation is R S^-1 times the innovation.
            innovation = S @ np.linalg.solve(R, measurement.position[:, lane] - state.mean[:2, lane])
            expected = multivariate_normal.logpdf(innovation, cov=S)
            assert density == pytest.approx(expected, rel=1e-6, abs=1e-6)
            seen += 1
    assert missed > 0
    assert seen > 100


def test_log_likelihood_of_the_autopilots_filter_is_that_of_the_readings_that_arrived():
    id = "filtergym/UavAutopilot-v0"
    model = make_model(id, "gain", "random", horizon=200, dropout_period=60, dropout_length=(10, 30))
    lanes = start_lanes(model, episode_seeds("test", 2, 8))
    bank, R, counts = model.filter, np.diag(model.task.sensor_variances), set()
    for _ in range(lanes.decisions_per_episode):
        state, measurement = lanes.state.filter, lanes.state.measurement
        P = packed_covariance.unpack(
            state.covariance + state.scale * bank.process_noise, len(model.task.components)
        )
        found = bank.records(state, measurement)["log_likelihood"]
        for lane in range(8):
            there = np.flatnonzero(measurement.available[:, lane])
            counts.add(len(there))
            if not len(there):
                assert math.isnan(found[lane])
                continue
            rows = [model.task.measured[k] for k in there]
            S = P[np.ix_(rows, rows)][..., lane] + R[np.ix_(there, there)]
            innovation = measurement.reading[there, lane] - state.mean[rows, lane]
            # Sums and roots of a few numbers: 1e-12 of their size.
            assert found[lane] == pytest.approx(
                multivariate_normal.logpdf(innovation, cov=S), rel=1e-10, abs=1e-10
            )
        lanes.decide(np.zeros((8, 1)))
    assert len(counts) > 1


def test_a_user_may_return_the_log_likelihood_alone():
    class Constant(InPython):
        def update(self, memory, measurement):
            mean, covariance, memory, likelihood = super().update(memory, measurement)
            return mean, covariance, memory, likelihood.log_likelihood

    found = filtergym.evaluate(TARGET, {"all": InPython, "alone": Constant}, episodes=8, horizon=10)
    one, other = (found["log_likelihood"].sel(policy=name).values for name in ("all", "alone"))
    np.testing.assert_array_equal(one, other)
    assert np.isnan(found["nis"].sel(policy="alone").values).all()


def test_an_answer_of_two_or_five_is_refused():
    for extra in (-1, 2):

        class Odd(InPython):
            def update(self, memory, measurement, extra=extra):
                answer = super().update(memory, measurement)
                return answer[:2] if extra < 0 else (*answer, 1.0)

        with pytest.raises(ValueError, match=r"must return mean, covariance and memory, .* not tuple of"):
            filtergym.evaluate(TARGET, {"mine": Odd}, episodes=8, horizon=3)


def test_a_traced_filter_that_loses_an_episode_holds_its_last_valid_answer():
    """As in Python: from the fault on the answer stands, and the reason."""

    class Wrong(Kalman):
        def start(self, initial, N):
            return *super().start(initial, N), 0.0 * initial.mean[0]

        def update(self, memory, measurement):
            xp, step = self.xp, memory[2] + 1.0
            mean, covariance, kept, likelihood = super().update(memory[:2], measurement)
            negative = xp.where(step == 4.0, -1.0, 1.0)
            return mean, covariance * negative, (*kept, step), likelihood

    found = filtergym.evaluate(
        TARGET, {"right": Kalman, "wrong": Wrong}, episodes=8, horizon=8, backend="compiled", tracks=True
    )
    lost = found["lost"].sel(policy="wrong").values
    np.testing.assert_array_equal(lost, np.tile([0.0] * 3 + [3.0] * 5, (8, 1)))
    wrong, right = (found["estimate"].sel(policy=name).values for name in ("wrong", "right"))
    np.testing.assert_array_equal(wrong[:, :3], right[:, :3])
    assert (wrong[:, 3:] == right[:, 2:3]).all()
    with pytest.raises(
        ValueError, match="'wrong': the covariance is not positive definite in episode 0 at meas"
    ):
        filtergym.evaluate(TARGET, {"wrong": Wrong}, episodes=8, horizon=8, backend="compiled", strict=True)


def test_faults_are_those_of_eigenvalues():
    """Every fault, against a naive check of each matrix."""
    rng, N, C = np.random.default_rng(0), 400, 4
    A = rng.standard_normal((N, C, C))
    P = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(C)
    mean = rng.standard_normal((C, N))
    P[50:100] -= 3.0 * np.eye(C)
    P[100:150, 0, 1] += 1e-3
    P[150:200, 2, 3] = math.nan
    mean[1, 180:220] = math.inf
    missed = (np.arange(N) % 7 == 0).astype(float)
    found = find_fault(mean, np.moveaxis(P, 0, -1), np.zeros(N), missed, np)
    for i in range(N):
        expected = 0
        if np.isfinite(P[i]).all():
            if np.linalg.eigvalsh(P[i])[0] <= 0.0:
                expected = 3
            elif abs(P[i] - P[i].T).max() > 1e-6 * abs(P[i]).max():
                expected = 4
        else:
            expected = 2
        if not np.isfinite(mean[:, i]).all():
            expected = 1
        if missed[i] and expected in (1, 2):
            expected = 5
        assert found[i] == expected, i
    assert {1, 2, 3, 4, 5} <= set(found.tolist())
    np.testing.assert_array_equal(find_fault(mean, np.moveaxis(P, 0, -1), np.full(N, 4.0), missed, np), 4.0)


def test_something_is_lacking_where_a_number_of_a_measurement_is_nan():
    model = make_model(TARGET, scenario="missed-detections", horizon=30)
    for episode, _ in rollout(model, Kalman, range(8)):
        received = model.task.world.mask_missing(episode.measurement)
        np.testing.assert_array_equal(is_lacking(received, np), episode.measurement.available == 0.0)


def test_a_compiled_filter_is_kept_for_the_next_chunk_of_episodes():
    model = make_model(TARGET, backend="compiled")
    first, second = (close_loop(model, Kalman, "estimator", "mine", 8) for _ in range(2))
    assert first.programs is second.programs
