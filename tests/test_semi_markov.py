"""The semi-Markov Gaussian sum: its dwell times, its update with outliers, and all sequences of modes enumerated."""

import math

import numpy as np
import pytest
from models import (
    LANES,
    Asked,
    act,
    assert_no_action_is_the_estimator,
    make_model,
    watch_estimator,
    watch_hypotheses,
)
from scipy.stats import multivariate_normal

from filtergym.envs.maneuvering_target.semi_markov import (
    SLOWEST,
    VAGUE,
    SemiMarkov,
    training_prior,
)
from filtergym.filters import contaminated_normal, coordinated_turn, kalman, semi_markov

ID = "filtergym/ManeuveringTarget-v0"
T = 6.0


def test_hazards_give_the_durations_back():
    f = np.array([0.0, 0.2, 0.5, 0.1, 0.15, 0.05])
    hazard = semi_markov.hazards(list(f), 4)
    survives = np.cumprod([1.0, *(1.0 - np.array(hazard[:3]))])
    np.testing.assert_allclose(survives[:3] * hazard[:3], f[:3], rtol=1e-14)
    # From the fourth step on geometric, with the mean 1 / h of what is left.
    left = (1 * 0.1 + 2 * 0.15 + 3 * 0.05) / 0.3
    assert hazard[3] == pytest.approx(1.0 / left, rel=1e-14)


def random_gaussian(rng, n):
    root = rng.normal(size=(n, n))
    return rng.normal(size=n), root @ root.T + 0.1 * np.eye(n)


def moments(weights, means, covariances):
    x = sum(w * m for w, m in zip(weights, means, strict=True))
    spread = (w * (P + np.outer(m - x, m - x)) for w, m, P in zip(weights, means, covariances, strict=True))
    return x, sum(spread)


@pytest.mark.parametrize(("probability", "factor"), [(0.0, 5.0), (0.1, 5.0), (0.5, 2.0)])
def test_update_with_outliers_is_two_kalman_updates_merged(probability, factor):
    n = 6
    rng = np.random.default_rng(n)
    for _ in range(20):
        mean, covariance = random_gaussian(rng, n)
        z, variance = 2.0 * rng.normal(size=2), rng.uniform(0.1, 2.0, size=2)
        found = contaminated_normal.update_position(
            mean[:, None], covariance[..., None], z[:, None], variance[:, None], probability, factor
        )
        updates, weights = [], []
        for scale, prior in ((1.0, 1.0 - probability), (factor, probability)):
            R = scale**2 * np.diag(variance)
            updates.append(kalman.update(mean[:, None], covariance[..., None], z[:, None], np.eye(2, n), R))
            S = covariance[:2, :2] + R
            weights.append(prior * multivariate_normal.pdf(z, mean[:2], S))
        total = sum(weights)
        weights = [w / total for w in weights]
        x, P = moments(weights, [u.mean[:, 0] for u in updates], [u.covariance[..., 0] for u in updates])
        np.testing.assert_allclose(found.mean[:, 0], x, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(found.covariance[..., 0], P, rtol=1e-10, atol=1e-11)
        assert found.log_likelihood[0] == pytest.approx(math.log(total), rel=1e-11)
        nis = sum(w * u.squared_distance[0] for w, u in zip(weights, updates, strict=True))
        assert found.squared_distance[0] == pytest.approx(nis, rel=1e-10)


@pytest.mark.parametrize("sigmas", [1.0, 10.0, 20.0, 60.0])
def test_a_measurement_far_off_is_an_outlier_in_single_precision_too(sigmas):
    covariance, z, variance = 0.5 * np.eye(4)[..., None], np.array([[sigmas], [0.0]]), np.full((2, 1), 0.5)
    double, single = (
        contaminated_normal.update_position(
            *(array.astype(dtype) for array in (np.zeros((4, 1)), covariance, z, variance)), 0.05, 5.0
        )
        for dtype in (np.float64, np.float32)
    )
    for one, other in zip(single, double, strict=True):
        assert one.dtype == np.float32
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


# --- every sequence of modes, each with its own filter


def block_transition(dt, order):
    """Of position, velocity and, of order three, acceleration."""
    rows = [[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]]
    return np.kron(np.array(rows)[:order, :order], np.eye(2))


def padded(P, variances):
    full = np.zeros((len(P) + len(variances),) * 2)
    full[: len(P), : len(P)] = P
    full[len(P) :, len(P) :] = np.diag(variances)
    return full


def squared_pace(x):
    return max(x[2] ** 2 + x[3] ** 2, SLOWEST**2)


def begun(filter, kind, x, P):
    """State of a mode that begins, of position and velocity."""
    if kind == "thrust":
        return np.append(x, [0.0, 0.0]), padded(P, [filter.prior.thrust**2] * 2)
    pace = math.sqrt(squared_pace(x))
    return np.append(x, kind.acceleration / pace), padded(P, [(kind.spread / pace) ** 2])


def predicted(filter, kind, x, P, dt):
    step = np.array([dt**2 / 2, dt])
    Q = filter.prior.noise**2 * np.kron(np.outer(step, step), np.eye(2))
    change = filter.prior.change**2 * dt / T
    if kind == "rest":
        F = block_transition(dt, 2)
    elif kind == "thrust":
        F, Q = block_transition(dt, 3), padded(Q, [change] * 2)
    else:
        F, Q = coordinated_turn.jacobian(x, dt), padded(Q, [change / squared_pace(x)])
        return coordinated_turn.propagate(x, dt), F @ P @ F.T + Q
    return F @ x, F @ P @ F.T + Q


def enumerated(filter, initial, measurements, b):
    """Posterior moments and log-likelihoods of all sequences of kinds and durations, none merged."""
    hazard = filter.hazard[:, 0]
    turning = filter.prior.turning if filter.turns else 0.0
    kinds = {"thrust": (1.0 - turning) * filter.prior.begin}
    kinds |= {turn: turning * filter.prior.begin * turn.share for turn in filter.turns}
    found = [(0.0, "rest", 0, initial.mean[:, b], initial.covariance[..., b])]
    answers = []
    for m in measurements:
        branches = []
        for log_weight, kind, age, x, P in found:
            free = log_weight
            if kind != "rest":
                ends = hazard[min(age, len(hazard)) - 1]
                if ends < 1.0:
                    branches.append((log_weight + math.log(1.0 - ends), kind, age + 1, x, P))
                if ends == 0.0:
                    continue
                free, x, P = log_weight + math.log(ends), x[:4], P[:4, :4]
            branches.append((free + math.log(1.0 - filter.prior.begin), "rest", 0, x, P))
            for other, probability in kinds.items():
                branches.append((free + math.log(probability), other, 1, *begun(filter, other, x, P)))
        found = []
        for log_weight, kind, age, x, P in branches:
            x, P = predicted(filter, kind, x, P, m.interval[b])
            if m.available[b]:
                H, R = np.eye(2, len(x)), np.diag(m.variance[:, b])
                S = H @ P @ H.T + R
                log_weight += multivariate_normal.logpdf(m.position[:, b], x[:2], S)
                K = P @ H.T @ np.linalg.inv(S)
                x, P = x + K @ (m.position[:, b] - x[:2]), P - K @ S @ K.T
            found.append((log_weight, kind, age, x, P))
        logs = np.array([entry[0] for entry in found])
        total = logs.max() + math.log(np.exp(logs - logs.max()).sum())
        found = [(entry[0] - total, *entry[1:]) for entry in found]
        x, P = moments(
            [math.exp(e[0]) for e in found], [e[3][:4] for e in found], [e[4][:4, :4] for e in found]
        )
        answers.append((x, P, total))
    return answers


def answers_of(model, estimator, count):
    """Start, measurements and answers of the first scans."""
    start, measurements, answers = watch_estimator(model, estimator)
    estimates = [(mean, covariance, likelihood.log_likelihood) for mean, covariance, likelihood in answers]
    return start, measurements[:count], estimates[:count]


IRREGULAR = {"detection_probability": (0.6, 0.8), "scan_jitter": (0.8, 0.8)}


@pytest.fixture(scope="module")
def model():
    # Manoeuvres at once, so that a short horizon holds them.
    return make_model(ID, None, "random", horizon=12, maneuver_count=(1, 1), **IRREGULAR)


def prior(**changed):
    # Without outliers, which the enumeration leaves out, and with manoeuvres that are not rare.
    return {"begin": 0.2, "noise": 0.05, "change": 0.1, "outliers": 0.0, **changed}


@pytest.mark.parametrize(
    "size",
    [{}, {"turns": (), "straight_ages": 4}, {"turns": (3.25,), "straight_ages": 2}, {"hard_turns": 0.2}],
    ids=["whole", "no-turns", "one-turn", "hard-turns"],
)
def test_equals_the_enumeration_while_nothing_is_merged(model, size):
    # Until a manoeuvre may have ended there is one straight flight that others may begin from.
    filter = SemiMarkov(model.task, **prior(hazards=(0.0, 0.0, 0.0, 0.0, 0.3), **size))
    initial, measurements, answers = answers_of(model, filter, 4)
    for b in range(LANES):
        for (x, P, total), (mean, covariance, log_likelihood) in zip(
            enumerated(filter, initial, measurements, b), answers, strict=True
        ):
            # Positions of 60 km, in which the extended filter of the turn rounds.
            np.testing.assert_allclose(mean[:, b], x, rtol=1e-9, atol=1e-6)
            np.testing.assert_allclose(covariance[..., b], P, rtol=1e-7, atol=1e-5)
            if not np.isnan(log_likelihood[b]):
                assert log_likelihood[b] == pytest.approx(total, rel=1e-8, abs=1e-9)


@pytest.mark.parametrize("hypotheses", [3, 9, 32])
def test_stays_near_the_enumeration_where_it_merges(model, hypotheses):
    # Manoeuvres end and begin again: what is merged differs only in when.
    # The fewer ages, the sooner manoeuvres may end, and the more sequences there are.
    scans, size = (
        (5, {"hazards": (0.0, 0.3, 0.4)}) if hypotheses == 32 else (4, training_prior(hypotheses)._asdict())
    )
    filter = SemiMarkov(model.task, **{**size, **prior(begin=0.05)})
    initial, measurements, answers = answers_of(model, filter, scans)
    distances, differences = [], []
    for b in range(0, LANES, 3):  # seconds each
        for (x, P, total), (mean, _, log_likelihood) in zip(
            enumerated(filter, initial, measurements, b), answers, strict=True
        ):
            distances.append((mean[:, b] - x) @ np.linalg.solve(P, mean[:, b] - x))
            differences.append(0.0 if np.isnan(log_likelihood[b]) else log_likelihood[b] - total)
    assert max(distances) > 1e-12  # something was merged
    # What is added to the normalised squared error, of which the mean is four.
    assert np.mean(distances) < 0.02
    assert abs(np.mean(differences)) < 0.02


@pytest.mark.parametrize("hypotheses", [3, 5, 9, 15])
def test_few_hypotheses_are_as_many_as_asked_for(model, hypotheses):
    filter = SemiMarkov(model.task, training_prior(hypotheses))
    start, *_ = answers_of(model, filter, 1)
    assert sum(table.probability.shape[0] for table in filter.start(start).track) == hypotheses
    # Durations are those of training: 3 to 12 scans, all alike.
    assert filter.prior.hazards == pytest.approx((1.0 / 7.5,))


def test_survives_what_its_prior_rules_out():
    # Jumps of 3000 sigma leave no hypothesis a weight that a float64 can hold.
    seen = {"detection_probability": (1.0, 1.0), "scan_jitter": (0.0, 0.0)}
    model = make_model(ID, None, "random", horizon=6, **seen)
    for settings in ({}, {"hazards": (0.0, 1.0)}, VAGUE._asdict()):
        filter = SemiMarkov(model.task, **settings)
        initial, measurements, _ = answers_of(model, filter, 6)
        asked = Asked(filter)
        memory = asked.start(initial, LANES)
        for k, m in enumerate(measurements):
            moved = m._replace(position=m.position + (3e5 if k == 3 else 0.0))
            mean, covariance, memory, likelihood = asked.update(memory, moved)
            assert np.isfinite(mean).all()
            assert np.isfinite(likelihood.log_likelihood).all()
            assert (np.linalg.eigvalsh(np.moveaxis(covariance, -1, 0)) > 0.0).all()


@pytest.fixture(scope="module")
def steered():
    """The bank of control hypotheses, and for every scan its state as predicted, the measurement and the answer."""
    model = make_model(ID, "hypotheses", "random", horizon=30, **IRREGULAR)
    return model.filter, *watch_hypotheses(model, SemiMarkov(model.task), "position", np.zeros(6))


def test_zero_hypotheses_is_the_estimator_bit_for_bit(steered):
    assert_no_action_is_the_estimator(*steered, np.zeros(6))


def probabilities_after(bank, state, measurement, action):
    after = act(bank, state, measurement, action)
    return np.concatenate([table.probability for table in after.own.track])


@pytest.mark.parametrize(("index", "factor"), [(0, 3.0), (1, 9.0), (2, 1.5)])
def test_hypotheses_multiplies_odds(steered, index, factor):
    bank, scans, _ = steered
    ages, straight = bank.own.ages, bank.own.prior.straight_ages
    end = straight + ages * (1 + len(bank.own.turns))
    raised = [range(straight, end, ages), [0], range(straight + ages, end)][index]
    for state, measurement in scans[:6]:
        action = 0.7 * np.eye(6)[index]
        ratio = probabilities_after(bank, state, measurement, action)
        ratio = ratio / probabilities_after(bank, state, measurement, np.zeros(6))
        rest = np.delete(ratio, raised, axis=0)
        np.testing.assert_allclose(rest, np.broadcast_to(rest[:1], rest.shape), rtol=1e-9)
        there = measurement.available > 0.0
        expected = np.where(there, factor**0.7, 1.0) + np.zeros((len(raised), 1))
        np.testing.assert_allclose(ratio[raised] / rest[0], expected, rtol=1e-9)


def test_hypotheses_scales_what_is_weighed(steered):
    bank, scans, _ = steered
    for state, measurement in scans[::7]:
        after = act(bank, state, measurement, [0.0, 0.0, 0.0, 0.5, -0.4, 0.8])
        there = measurement.available > 0.0
        for i, exponent in enumerate((0.5, -0.4, -0.4)):
            before, found = state.own.track[i].unpack(), after.own.track[i].unpack()
            result = contaminated_normal.update_position(
                before.mean,
                1.25**exponent * before.covariance,
                measurement.position[:, None],
                1.25**0.8 * measurement.variance[:, None],
                bank.own.prior.outliers,
                bank.own.prior.outlier_factor,
            )
            np.testing.assert_allclose(found.mean, np.where(there, result.mean, before.mean), rtol=1e-12)
            expected = np.where(there, result.covariance, before.covariance)
            np.testing.assert_allclose(found.covariance, expected, rtol=1e-8, atol=1e-8)
