"""The estimators of ManeuveringTarget against filterpy and naive loops over one episode's matrices."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from models import begin, make_model, next_row, watch_estimator
from naive import transition
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from filtergym import evaluate, tidy_records
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.maneuvering_target.adaptive_estimators import SageHusaProcessNoise, VariationalBayes
from filtergym.baselines.maneuvering_target.estimators import (
    KalmanInteractingMultipleModel,
    KalmanTurnInteractingMultipleModel,
)
from filtergym.baselines.maneuvering_target.log_families import ConstantAcceleration
from filtergym.baselines.problem import problem_of
from filtergym.baselines.table import Variant
from filtergym.baselines.tuning import Candidate, episode_costs
from filtergym.envs.maneuvering_target.semi_markov import TRAINING
from filtergym.envs.maneuvering_target.unscented_turn import UnscentedTurn
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.filters import coordinated_turn

ID = "filtergym/ManeuveringTarget-v0"
T, LANES = 6.0, 8
H, H5 = np.eye(2, 4), np.eye(2, 5)


def unit_noise(dt):
    """Covariance of what an acceleration of 1 m/s^2 does in dt seconds."""
    return np.kron(np.outer([dt**2 / 2, dt], [dt**2 / 2, dt]), np.eye(2))


@pytest.fixture(scope="module")
def model():
    """Scans that miss the target and come early."""
    irregular = {"detection_probability": (0.6, 0.8), "scan_jitter": (0.8, 0.8)}
    return make_model(ID, None, "random", horizon=50, **irregular)


def estimates(model, estimator):
    start, measurements, answers = watch_estimator(model, estimator)
    mean, covariance, _ = zip(*answers, strict=True)
    return start, measurements, np.array(mean), np.array(covariance)


def compare(model, estimator, naive, rtol=1e-9):
    """Every mean and covariance of two episodes with those of a naive recursion."""
    initial, measurements, means, covariances = estimates(model, estimator)
    for b in range(2):
        track = naive(initial.mean[:, b], initial.covariance[..., b])
        next(track)
        for k, m in enumerate(measurements):
            z = m.position[:, b] if m.available[b] else None
            x, P = track.send((z, np.diag(m.variance[:, b]), m.interval[b]))
            # Some 20 km, and rounding that filters of long memory keep.
            np.testing.assert_allclose(means[k, :, b], x, rtol=rtol, atol=1e4 * rtol)
            np.testing.assert_allclose(covariances[k, ..., b], P, rtol=10 * rtol, atol=1e4 * rtol)


def kalman_update(x, P, z, R, matrix=H):
    if z is None:
        return x, P, 0.0
    S = matrix @ P @ matrix.T + R
    K = P @ matrix.T @ np.linalg.inv(S)
    likelihood = multivariate_normal.logpdf(z, matrix @ x, S)
    return x + K @ (z - matrix @ x), P - K @ S @ K.T, likelihood


def padded(x, P, variance):
    """With a turn rate of mean zero, independent of the rest."""
    P5 = np.zeros((5, 5))
    P5[:4, :4], P5[4, 4] = P, variance
    return np.append(x, 0.0), P5


def naive_imm_turn(accelerations, start_rate, change, stay):
    """Equations of the IMM paper, mixed in five states."""
    variance = math.radians(start_rate) ** 2
    chain = [[stay[i] if i == j else (1 - stay[i]) / 2 for j in range(3)] for i in range(3)]

    def track(x, P):
        bank = [padded(x, P, variance)] * 3
        mu = np.array([1 / (1 - s) for s in stay])
        mu = mu / mu.sum()
        z, R, dt = yield
        while True:
            predicted = mu @ chain
            updated, log_weights = [], []
            for j in range(3):
                w = [chain[i][j] * mu[i] / predicted[j] for i in range(3)]
                x = sum(w[i] * bank[i][0] for i in range(3))
                P = sum(w[i] * (bank[i][1] + np.outer(bank[i][0] - x, bank[i][0] - x)) for i in range(3))
                if j < 2:
                    F = transition(dt)
                    x, P = F @ x[:4], F @ P[:4, :4] @ F.T + accelerations[j] ** 2 * unit_noise(dt)
                    x, P, likelihood = kalman_update(x, P, z, R)
                    x, P = padded(x, P, variance)
                else:
                    A = coordinated_turn.jacobian(x, dt)
                    Q = coordinated_turn.process_noise(dt, accelerations[2], math.radians(change) / T)
                    x, P = coordinated_turn.propagate(x, dt), A @ P @ A.T + Q
                    x, P, likelihood = kalman_update(x, P, z, R, H5)
                updated.append((x, P))
                log_weights.append(math.log(predicted[j]) + likelihood)
            bank = updated
            mu = np.exp(np.array(log_weights) - max(log_weights))
            mu = mu / mu.sum()
            x = sum(mu[j] * bank[j][0] for j in range(3))
            P = sum(mu[j] * (bank[j][1] + np.outer(bank[j][0] - x, bank[j][0] - x)) for j in range(3))
            z, R, dt = yield x[:4], P[:4, :4]

    return track


def test_imm_with_a_turn_equals_naive_loops(model):
    values = ((0.1, 4.0, 0.5), 1.5, 0.4, (0.97, 0.8, 0.9))
    compare(
        model, KalmanTurnInteractingMultipleModel(model.task, *values), naive_imm_turn(*values), rtol=1e-8
    )


@pytest.mark.parametrize("stay", [(0.9, 0.9), (0.98, 0.6, 0.8)])
def test_modes_start_as_the_chain_leaves_them(model, stay):
    accelerations = (0.1,) * len(stay)
    estimator = KalmanInteractingMultipleModel(model.task, accelerations, stay)
    np.testing.assert_allclose(estimator.transition.sum(axis=1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(estimator.probabilities.sum(), 1.0, rtol=1e-15)
    np.testing.assert_allclose(
        estimator.probabilities @ estimator.transition, estimator.probabilities, rtol=1e-14
    )


def test_unscented_filter_equals_filterpys(model):
    filterpy = pytest.importorskip("filterpy.kalman")
    acceleration, change, start_rate = 0.5, 0.4, 1.5

    def track(x, P):
        points = filterpy.MerweScaledSigmaPoints(5, alpha=1.0, beta=2.0, kappa=0.0)
        peer = filterpy.UnscentedKalmanFilter(
            5, 2, T, hx=lambda s: s[:2], fx=coordinated_turn.propagate, points=points
        )
        peer.x, peer.P = padded(x, P, math.radians(start_rate) ** 2)
        z, R, dt = yield
        while True:
            peer.Q = np.array(coordinated_turn.process_noise(dt, acceleration, math.radians(change) / T))
            peer.predict(dt=dt)
            # Drawn anew, so that they hold the process noise: then its update is Kalman's.
            peer.sigmas_f = points.sigma_points(peer.x, peer.P)
            if z is not None:
                peer.update(z, R=R)
            z, R, dt = yield peer.x[:4], peer.P[:4, :4]

    compare(model, UnscentedTurn(model.task, acceleration, change, start_rate), track)


def test_sage_husa_equals_the_papers_recursion(model):
    acceleration, forgetting, least = 0.8, 0.9, 0.2

    def track(x, P):
        level, k = acceleration**2, 0
        z, R, dt = yield
        while True:
            F, unit = transition(dt), unit_noise(dt)
            carried = F @ P @ F.T
            before = F @ x
            x, P, _ = kalman_update(before, carried + level * unit, z, R)
            if z is None:
                z, R, dt = yield x, P
                continue
            k += 1
            d = (1 - forgetting) / (1 - forgetting ** (k + 1))
            sample = np.diag(np.outer(x - before, x - before) + P - carried) / np.diag(unit)
            level = max((1 - d) * level + d * sample.mean(), least**2)
            z, R, dt = yield x, P

    compare(model, SageHusaProcessNoise(model.task, acceleration, forgetting, least), track)


def test_variational_bayes_equals_the_papers_recursion(model):
    acceleration, rho, shape = 2.0, 0.9, 4.0

    def track(x, P):
        alpha, beta = np.full(2, shape), np.full(2, shape)
        z, R, dt = yield
        while True:
            F = transition(dt)
            before, P = F @ x, F @ P @ F.T + acceleration**2 * unit_noise(dt)
            if z is None:
                x = before
                z, R, dt = yield x, P
                continue
            alpha = rho * alpha + 0.5
            faded = beta = rho * beta
            for _ in range(VariationalBayes.iterations):
                x, after, _ = kalman_update(before, P, z, np.diag(beta / alpha) @ R)
                beta = faded + 0.5 * ((z - x[:2]) ** 2 + np.diag(after)[:2]) / np.diag(R)
            P = after
            z, R, dt = yield x, P

    compare(model, VariationalBayes(model.task, acceleration, rho, shape), track)


def test_constant_acceleration_equals_naive_loops(model):
    jerk, acceleration = 0.2, 1.5

    def track(x, P):
        x, P = np.append(x, [0.0, 0.0]), block_diag(P, acceleration**2 * np.eye(2))
        z, R, dt = yield
        while True:
            F = np.kron([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]], np.eye(2))
            g = np.kron([[dt**3 / 6], [dt**2 / 2], [dt]], np.eye(2))
            x, P, _ = kalman_update(F @ x, F @ P @ F.T + jerk**2 * g @ g.T, z, R, np.eye(2, 6))
            z, R, dt = yield x[:4], P[:4, :4]

    compare(model, ConstantAcceleration(model.task, jerk, acceleration), track)


@pytest.mark.slow
def test_untuned_values_are_those_in_force():
    known = baselines_of(ID)
    seeds = episode_seeds("train", 0, 8)
    # All but the wide one, whose values are those of its prior.
    tuned = [name for name in known.estimators if name in known.tunable]
    for name in tuned:
        maker, tunable = known.estimators[name], known.tunable[name]
        untuned = tunable.apply(tunable.start)[1]
        same = replace(tunable, apply=lambda values, maker=maker: ({}, maker))
        # Logarithms of the values, there and back; an IMM amplifies that.
        expected = episode_costs(Candidate(problem_of(ID), "random", same, {}, seeds))
        found = episode_costs(Candidate(problem_of(ID), "random", tunable, tunable.start, seeds))
        assert found == pytest.approx(expected, rel=1e-9), name
        made = maker.func if isinstance(maker, Variant) else maker
        assert isinstance(untuned(make_model(ID, None, "random").task), made)


def test_the_tunable_semi_markov_filter_begins_with_its_prior(model):
    tunable = baselines_of(ID).tunable["semi-markov"]
    found = tunable.apply(tunable.start)[1](model.task).prior
    assert np.hstack(found) == pytest.approx(np.hstack(TRAINING), rel=1e-12)


# --- the reference


@pytest.mark.parametrize("is_polar", [False, True])
@pytest.mark.parametrize(("scenario", "errors"), [("biased", {}), ("random", {"coloured_sigma": (0.8, 1.2)})])
def test_the_reference_knows_lasting_errors_as_they_are_measured(scenario, errors, is_polar):
    """Along x and y, or of range and azimuth: its errors are then as large as it states."""
    keywords = {"polar_measurements": is_polar, **errors}
    records = tidy_records(evaluate(ID, ["imm", "known-turn"], scenario, episodes=200, **keywords))
    [anees] = [
        record.value
        for record in records
        if (record.policy, record.metric, record.component, record.window)
        == ("known-turn", "anees", "state", "all")
    ]
    assert anees == pytest.approx(1.0, abs=0.1)  # 20,000 scans; with the wrong axes it was 16


@pytest.mark.parametrize(
    ("scenario", "keywords"),
    [
        ("random", {"detection_probability": (0.6, 0.8), "scan_jitter": (0.8, 0.8)}),
        ("atc", {"scan_jitter": (0.8, 0.8)}),
        ("paper", {"scan_jitter": (0.5, 0.5)}),
    ],
)
def test_a_deviation_is_carried_as_the_turns_carry_it(scenario, keywords):
    model = make_model(ID, "evidence", scenario, maneuver_count=(3, 3), **keywords)
    world, rng = model.task.world, np.random.default_rng(0)
    episode = begin(model, rng, LANES)
    velocity, turned = rng.normal(size=(2, LANES)), 0
    for k in range(1, 61):
        before = episode.truth
        episode = model.act(model.measure(episode, next_row(model, rng, LANES)), np.zeros((2, LANES)))
        truth = episode.truth
        early = None if truth.scans is None else (before.scans.early, truth.scans.early)
        carried = world.course.propagate_deviation(truth.flight, truth.scan, early, velocity)
        for b in range(LANES):
            earlier, now = (0.0, 0.0) if early is None else (early[0][b], early[1][b])
            way, end = naive_carry(
                model.task.parameters, truth.flight, k - 1 - earlier, k - now, b, velocity[:, b]
            )
            # Relative to a way of some metres, and to the target's way of a kilometre, whose ratio legs take.
            np.testing.assert_allclose(carried[0][:, b], way, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(carried[1][:, b], end, rtol=1e-9, atol=1e-10)
            turned += abs(end - velocity[:, b]).max() > 1e-3
    assert (turned > 20) == (scenario != "paper")


def naive_carry(p, flight, start, end, b, velocity):
    """Where a velocity leads between two times (scan periods) that turns with the target, piece by piece."""
    breaks = {start, end, *(float(k) for k in range(math.ceil(start), math.ceil(end)) if k > start)}
    if p.flight == "legs":
        breaks |= {t for t in flight.time[:, b] / p.sampling_interval if start < t < end}
    breaks, way, now = sorted(breaks), 0.0, complex(*velocity)
    for first, last in itertools.pairwise(breaks):
        rate, duration = naive_rate(p, flight, 0.5 * (first + last), b), (last - first) * p.sampling_interval
        turned = now * np.exp(1j * rate * duration)
        way, now = way + ((turned - now) / (1j * rate) if rate else now * duration), turned
    return [way.real, way.imag], [now.real, now.imag]


def naive_rate(p, flight, time, b):
    """Turn rate of a target at a time (scan periods), rad/s."""
    if p.flight == "legs":
        return flight.turn[np.flatnonzero(flight.time[:, b] <= p.sampling_interval * time)[-1], b]
    scan = math.ceil(time)
    (flown,) = np.nonzero((flight.first[:, b] <= scan) & (scan <= flight.last[:, b]))
    cosine, sine = flight.effect[:2, flown[0], b] if len(flown) else (0.0, 0.0)
    return math.atan2(sine, 1.0 + cosine) / p.sampling_interval
