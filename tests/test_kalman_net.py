"""Learned estimators: the filters of kalman-net against matrices written out, their training, their files."""

import numpy as np
import pytest
import scipy.stats
from models import Asked, make_model

import filtergym
from filtergym.agents.learned_estimator import EstimatorMaker
from filtergym.agents.learned_policy import LearnedPolicy, load_policy, write_arrays
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.companions import trained_banks
from filtergym.envs.contract.draws import Draws
from filtergym.envs.contract.model import Episode
from filtergym.envs.engine.catalogue import catalogue
from filtergym.envs.maneuvering_target import kalman_net as radar
from filtergym.envs.radar_esm_tracking import kalman_net as fusion
from filtergym.envs.tightly_coupled_navigation import kalman_net as satellites
from filtergym.envs.uav_autopilot import kalman_net as aircraft
from filtergym.evaluation.competitors.kinds import kind_of
from filtergym.filters import coordinated_turn, gnss_ins, loosely_coupled, packed_covariance

RADAR, FUSION = "filtergym/ManeuveringTarget-v0", "filtergym/LooselyCoupledNavigation-v0"
AIRCRAFT, ESM = "filtergym/UavAutopilot-v0", "filtergym/RadarEsmTracking-v0"
NAME = "kalman-net"
SATELLITES = "filtergym/TightlyCoupledNavigation-v0"
SHORT = {SATELLITES: {"horizon": 60, "backend": "numpy"}}
"""Of what takes long to compile."""
TRAINED = [(id, name) for id, cls in catalogue().items() for name in trained_banks(cls)]


def network(model, answer=0.0):
    """A network that always answers the same, or with arrays of random weights."""
    fields, count = len(model.fields), model.action_space.shape[0]
    rng = np.random.default_rng(5)
    random = answer == "random"
    arrays = {
        "observation_mean": np.zeros(fields, np.float32),
        "observation_scale": np.ones(fields, np.float32),
        "gru_input_weight": rng.normal(0.0, 0.3, (12, fields)).astype(np.float32),
        "gru_input_bias": np.zeros(12, np.float32),
        "gru_memory_weight": rng.normal(0.0, 0.3, (12, 4)).astype(np.float32),
        "gru_memory_bias": np.zeros(12, np.float32),
        "weight_0": (rng.normal(0.0, 0.5, (count, 4)) * random).astype(np.float32),
        "bias_0": np.full(count, 0.0 if random else np.arctanh(answer), np.float32),
    }
    return LearnedPolicy(model, arrays, "tanh")


def episodes(id, count, steps, name="kalman-net", **keywords):
    """Initial, and the measurements of episodes of the training distribution."""
    model = make_model(id, name, **keywords)
    rng = np.random.default_rng(2)
    draws = Draws(rng.random((model.task.noise.uniforms, count)), np)
    truth, initial = model.task.world.begin(draws, rng.normal(size=(model.task.noise.initial_normals, count)))
    # A loop that is closed by the initial estimate, as no filter is here.
    found, feedback = [], model.task.feedback(initial.mean, initial.covariance, initial)
    for _ in range(steps):
        noise = (
            rng.normal(size=(model.task.noise.normals, count)),
            rng.random((model.task.noise.row_uniforms, count)),
        )
        truth, measurement = model.task.world.advance(truth, np.concatenate(noise), feedback)
        found.append(measurement)
    return model, initial, found


def test_of_an_ins_zero_answers_are_the_augmented_filter():
    competitors = {"augmented": "augmented", "net": EstimatorMaker(NAME, network)}
    dataset = filtergym.evaluate(FUSION, competitors, episodes=16, horizon=300)
    for name in ("error", "nees"):
        augmented, net = dataset[name].values
        np.testing.assert_allclose(net, augmented, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("plant", ["U", "P"])
def test_gains_for_an_aircraft_follow_the_description(plant):
    """The equations at the head of the module, one lane after the other, with matrices of NumPy."""
    model, initial, measurements = episodes(AIRCRAFT, 8, 60, plant=plant)
    design, p, task = model.task.design, model.task.parameters, model.task
    assert 0.0 < np.mean([m.available for m in measurements]) < 1.0
    F, B, H = design.model.F, design.model.B[:, 0], design.H
    parts = [Q for Q in (design.model.scaled_noise, design.model.other_noise) if Q.any()]
    L, m = len(parts), len(task.sensors)
    assert model.action_space.shape == (2 * (L + m),)
    rng, bank = np.random.default_rng(0), model.filter
    state = bank.start(initial)
    for measurement in measurements:
        before, state = state, bank.predict(state, measurement)
        action = rng.uniform(-1.2, 1.2, (2 * (L + m), 8))
        P_before, M_before = bank.covariance(before), packed_covariance.unpack(before.gain_covariance, len(F))
        state = bank.act(state, measurement, action)
        for i, a in enumerate(np.clip(action, -1.0, 1.0).T):
            x = F @ before.mean[:, i] + B * measurement.control[i]
            noises = [10.0 ** (p.process_decades * number) * Q for number, Q in zip(a, parts, strict=False)]
            R = np.diag(10.0 ** (2.0 * p.sensor_decades * a[L : L + m])) @ design.R
            P = F @ P_before[:, :, i] @ F.T + sum(noises)
            b, c = a[L + m : 2 * L + m], a[2 * L + m :]
            M = F @ M_before[:, :, i] @ F.T + sum(
                aircraft.AGILITY ** (2.0 * number) * Q for number, Q in zip(b, noises, strict=True)
            )
            rows = measurement.available[:, i] > 0.0
            h, W = H[rows], (np.diag(aircraft.CAUTION ** (2.0 * c)) @ R)[np.ix_(rows, rows)]
            K = M @ h.T @ np.linalg.inv(h @ M @ h.T + W)
            rest = np.eye(len(F)) - K @ h
            # Scalar steps against an inverse; condition numbers of S up to 1e4.
            mean = x + K @ (measurement.reading[rows, i] - h @ x)
            np.testing.assert_allclose(state.mean[:, i], mean, rtol=1e-9, atol=1e-9)
            joseph = rest @ P @ rest.T + K @ R[np.ix_(rows, rows)] @ K.T
            np.testing.assert_allclose(bank.covariance(state)[:, :, i], joseph, rtol=1e-9, atol=1e-9)
            of_gain = packed_covariance.unpack(state.gain_covariance[:, i], len(F))
            np.testing.assert_allclose(of_gain, rest @ M, rtol=1e-9, atol=1e-9)


def test_gains_for_radar_and_esm_follow_the_description():
    """The equations at the head of the module, one lane and class after the other, with matrices of NumPy."""
    model, initial, measurements = episodes(ESM, 6, 12)
    task, bank = model.task, model.filter
    models, _ = task.design_models(task.parameters)
    classes, count = task.classes, model.action_space.shape[0]
    assert count == classes + 2 * len(fusion.NOISES)
    rng, state, H = np.random.default_rng(0), bank.start(initial), models.H
    # Under no answer at the start.
    R_before = np.stack([models.R] * 6, axis=-1)
    q_before = np.ones(6)
    for measurement in measurements:
        before, predicted = state, bank.predict(state, measurement)
        action = rng.uniform(-1.2, 1.2, (count, 6))
        state = bank.act(predicted, measurement, action)
        P_before, M_before, P_after, M_after = (
            packed_covariance.unpack(part, 3)
            for part in (before.covariance, before.gain_covariance, state.covariance, state.gain_covariance)
        )
        esm = bank._esm_log_likelihood(predicted.used, measurement)
        for i, a in enumerate(np.clip(action, -1.0, 1.0).T):
            noise, gain = a[classes : classes + 3], a[classes + 3 :]
            R = np.diag(fusion.NOISE_RANGE ** (2.0 * noise[1:])) @ models.R
            W = np.diag(fusion.CAUTION ** (2.0 * gain[1:])) @ R
            posterior = np.log(before.posterior[:, i])
            for s in range(classes):
                Phi, Q = models.Phi[:, :, s], models.Q[:, :, s]
                x, carried = Phi @ before.mean[:, s, i], Phi @ P_before[:, :, s, i] @ Phi.T
                q = fusion.NOISE_RANGE ** (2.0 * noise[0])
                M = Phi @ M_before[:, :, s, i] @ Phi.T + fusion.CAUTION ** (2.0 * gain[0]) * q * Q
                K = M @ H.T @ np.linalg.inv(H @ M @ H.T + W)
                rest, P = np.eye(3) - K @ H, carried + q * Q
                # Metres and metres per second: relative to the largest entry, condition numbers up to 1e6.
                delta = measurement.radar[:, i] - H @ x
                np.testing.assert_allclose(state.mean[:, s, i], x + K @ delta, rtol=1e-9, atol=1e-6)
                for found, expected in (
                    (P_after[:, :, s, i], rest @ P @ rest.T + K @ R @ K.T),
                    (M_after[:, :, s, i], rest @ M),
                ):
                    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * abs(expected).max())
                theta = H @ (carried + q_before[i] * Q) @ H.T + R_before[:, :, i]
                posterior[s] += scipy.stats.multivariate_normal(cov=theta).logpdf(delta)
            weights = np.exp(posterior + esm[:, i] - max(posterior + esm[:, i]))
            np.testing.assert_allclose(state.posterior[:, i], weights / weights.sum(), rtol=1e-7, atol=1e-12)
            weights *= np.exp(fusion.EVIDENCE * a[:classes])
            np.testing.assert_allclose(
                state.probabilities[:, i], weights / weights.sum(), rtol=1e-7, atol=1e-12
            )
            R_before[:, :, i], q_before[i] = R, fusion.NOISE_RANGE ** (2.0 * noise[0])


def test_of_satellites_zero_answers_are_the_third_hypothesis_of_the_paper():
    """Without apertures: the bank's tracking loops expect what all three hypotheses predict."""
    competitors = {"singer": "singer", "net": EstimatorMaker(NAME, network)}
    dataset = filtergym.evaluate(SATELLITES, competitors, episodes=4, aperture=False, **SHORT[SATELLITES])
    singer, net = dataset["error"].values
    np.testing.assert_allclose(net, singer, rtol=0.0, atol=1e-9)
    singer, net = dataset["nees"].values
    np.testing.assert_allclose(net, singer, rtol=1e-9)


def test_of_satellites_the_noise_of_the_motion_holds_until_the_next_measurement():
    """F P F^T and the noise of Singer's model with another deviation of the acceleration, lane after lane."""
    model, initial, measurements = episodes(SATELLITES, 8, 6)
    bank, task, p = model.filter, model.task, model.task.parameters
    names, rng = bank.actions, np.random.default_rng(0)
    state = bank.start(initial)
    for measurement in measurements:
        before, state = state, bank.predict(state, measurement)
        for i in range(8):
            a = before.action[names.index("manoeuvre"), i]
            motion = gnss_ins.singer_model(
                p.sampling_interval, p.singer_alpha, p.singer_sigma * satellites.MANOEUVRE_RANGE**a
            )
            F = gnss_ins.advance(np.eye(17), motion.transition, task.common.T, task.common.decay)
            P = F @ packed_covariance.unpack(before.covariances[:, 0, i], 17) @ F.T
            P += gnss_ins.process_noise(motion, task.common)
            sigma = np.sqrt(np.diag(P))
            found = packed_covariance.unpack(state.covariances[:, 0, i], 17)
            np.testing.assert_allclose(found / np.outer(sigma, sigma), P / np.outer(sigma, sigma), atol=1e-12)
            np.testing.assert_allclose(state.means[:, 0, i], F @ before.means[:, 0, i], rtol=1e-12, atol=1e-9)
        state = bank.act(state, measurement, rng.uniform(-1.2, 1.2, (len(names), 8)))
        assert (state.probabilities == 1.0).all()


def test_gains_for_a_radar_follow_the_description():
    """The equations at the head of the module, one lane after the other, with matrices of NumPy."""
    model, initial, measurements = episodes(RADAR, 16, 3)
    rng, bank, correction = np.random.default_rng(0), model.filter, np.zeros((16, 2))
    state = bank.start(initial)
    for measurement in measurements:
        before, state = state, bank.predict(state, measurement)
        shown = model.observe(Episode(None, measurement, state)).T
        # Over what 1 m/s^2 makes of the velocity in the six seconds of a scan period.
        np.testing.assert_allclose(model.reader("correction")(shown), correction / 6.0, rtol=1e-7, atol=1e-6)
        correction = np.zeros((16, 2))
        action = rng.uniform(-1.2, 1.2, (radar.ANSWERS, 16))
        predicted, state = state, bank.act(state, measurement, action)
        for i, a in enumerate(np.clip(action, -1.0, 1.0).T):
            T, speed = measurement.interval[i], np.hypot(*before.mean[2:, i])
            along, across = before.acceleration[:, i] / np.hypot(speed, radar.LEAST_SPEED)
            turning = np.append(before.mean[:, i], across)
            moved = coordinated_turn.propagate(turning, T)
            x = np.append(
                before.mean[:2, i] + (1.0 + 0.5 * T * along) * (moved[:2] - before.mean[:2, i]),
                (1.0 + T * along) * moved[2:4],
            )
            np.testing.assert_allclose(predicted.mean[:, i], x, rtol=1e-12)
            F = coordinated_turn.jacobian(turning, T)[:4, :4]
            c, s = x[2:] / np.hypot(*x[2:])
            U = np.array([[c, -s], [s, c]])
            G = np.concatenate([T**2 / 2 * U, T * U])
            sigma = radar.NOMINAL_ACCELERATION * radar.NOISE_RANGE ** a[:2]
            P = F @ before.covariance[:, :, i] @ F.T + G @ np.diag(sigma**2) @ G.T
            R = radar.NOISE_RANGE ** a[2] * np.diag(measurement.variance[:, i])
            W = U @ np.diag(radar.CAUTION ** a[3:5]) @ U.T
            agile = radar.AGILITY ** a[5:7] * sigma
            M = F @ before.covariance[:, :, i] @ F.T + G @ np.diag(agile**2) @ G.T
            H = np.eye(2, 4)
            K = measurement.available[i] * M @ H.T @ np.linalg.inv(H @ M @ H.T + W @ R @ W.T)
            rest = np.eye(4) - K @ H
            mean = x + K @ (measurement.position[:, i] - x[:2])
            # The frame's direction is that of a speed 1e-3 m/s larger.
            np.testing.assert_allclose(state.mean[:, i], mean, rtol=1e-7, atol=1e-5)
            correction[i] = U.T @ (mean - x)[2:]
            joseph = rest @ P @ rest.T + K @ R @ K.T
            np.testing.assert_allclose(state.covariance[:, :, i], joseph, rtol=1e-6, atol=1e-4)
            np.testing.assert_allclose(state.acceleration[:, i], radar.LARGEST_ACCELERATION * a[7:])


def test_covariance_of_the_augmented_filter_under_any_gain_is_josephs():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    P, R, K = root @ root.T, 0.7, rng.normal(size=3)
    packed = loosely_coupled.AugmentedCovariance(P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2])
    found = loosely_coupled.update_augmented_by(packed, R, loosely_coupled.AugmentedFilterGain(*K))
    rest = np.eye(3) - np.outer(K, [1.0, 0.0, 0.0])
    joseph = rest @ P @ rest.T + R * np.outer(K, K)
    np.testing.assert_allclose(found, joseph[np.triu_indices(3)], rtol=1e-12)


@pytest.mark.parametrize(("id", "name"), TRAINED)
@pytest.mark.parametrize("answer", [0.999, "random"])
def test_whatever_the_network_answers_the_filter_reports_a_covariance(id, name, answer):
    """An evaluation refuses what is not finite, symmetric and positive definite."""
    maker = EstimatorMaker(name, lambda model: network(model, answer))
    cost = filtergym.evaluate(id, {"net": maker}, episodes=8, **SHORT.get(id, {}))["cost"]
    # The gains of a student are its network's, and nothing keeps those without training from losing the track.
    assert float(cost.max()) < 1e6 or name == "student"
    assert np.isfinite(cost).all()


@pytest.mark.parametrize(("id", "name"), TRAINED)
def test_the_estimator_is_the_policy_in_its_bank(id, name):
    """What is trained in the environment is what is evaluated outside of it."""
    model, initial, measurements = episodes(id, 8, 40, name)
    estimator, policy = (
        Asked(EstimatorMaker(name, lambda model: network(model, "random"))(model.task)),
        network(model, "random"),
    )
    memory, state, hidden = estimator.start(initial, 8), model.filter.start(initial), None
    for measurement in measurements:
        mean, covariance, memory, likelihood = estimator.update(memory, measurement)
        episode = Episode(None, measurement, model.filter.predict(state, measurement))
        action, hidden = policy.predict(model.observe(episode).T, hidden)
        state = model.act(episode, action.T.astype(float)).filter
        np.testing.assert_array_equal(mean, model.filter.mean(state))
        np.testing.assert_array_equal(covariance, model.filter.covariance(state))
        records = model.filter.records(state, measurement)
        for name, values in likelihood._asdict().items():
            assert (values is None) == (name not in records)
            if values is not None:
                np.testing.assert_array_equal(values, records[name])


def test_a_file_is_an_estimator_of_its_environment(tmp_path, success):
    from filtergym.agents.training_run import RunOptions, new_run

    pytest.importorskip("stable_baselines3")
    path = tmp_path / "net.safetensors"
    arrays = network(make_model(RADAR, NAME), 0.3).arrays
    write_arrays(path, arrays, new_run(problem_of(RADAR), RunOptions(NAME)), "tanh")
    assert kind_of(load_policy(problem_of(RADAR).task, path)) == "estimator"
    out = success("evaluate", RADAR, "--policy", path, "--policy", "imm", "--episodes", 2)
    assert [line for line in out.splitlines() if line.startswith(str(path)[:4])]
    with pytest.raises(ValueError, match=f"was trained on '{RADAR}', not on {FUSION}"):
        filtergym.evaluate(FUSION, [str(path)], episodes=1)
    with pytest.raises(ValueError, match="does not act: of kind estimator"):
        filtergym.make_policy(RADAR, str(path))


def test_training_of_an_environment_without_one(refusal, tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    monkeypatch.setattr(catalogue()[ESM], "companions", ())
    assert (
        f"{ESM} has no filter for algorithm '{NAME}': choose another algorithm, or {FUSION}, {RADAR}"
        in refusal("train", ESM, "--algo", NAME, "--out", tmp_path / "run")
    )
    assert "unknown control 'gain'" in refusal(
        "train", RADAR, "--algo", NAME, "--control", "gain", "--out", tmp_path / "run"
    )
