"""The bank over faults of LooselyCoupledNavigation: against all hypotheses one by one, compiled, and in the field."""

import itertools
import math

import numpy as np
import pytest
from models import act, assert_no_action_is_the_estimator, make_model, watch_hypotheses

import filtergym  # noqa: F401  # registers the environments
from filtergym.envs.contract.filter import FilterInput, Initial
from filtergym.envs.loosely_coupled_navigation.fault_bank import FaultBank
from filtergym.envs.loosely_coupled_navigation.fault_prior import FEW, TRAINING
from filtergym.envs.loosely_coupled_navigation.world import Measurement
from filtergym.filters.linear_systems import van_loan
from filtergym.filters.loosely_coupled import error_model

ID = "filtergym/LooselyCoupledNavigation-v0"
INTERVAL = 0.1


def measurements(seed, steps=7, axes=1):
    """A few measurements of noise, a ramp and a missing fix, one lane."""
    rng = np.random.default_rng(seed)
    ins = np.cumsum(rng.normal(0.0, 0.3, (steps, axes, 1)), axis=0)
    for k in range(steps):
        available = np.array([0.0 if k == 4 else 1.0])
        fix = ins[k] + rng.normal(0.0, 1.5, (axes, 1)) + 0.5 * max(k - 2, 0)
        before = ins[k - 1] if k else np.zeros((axes, 1))
        yield Measurement(
            np.array([k + 1.0]), ins[k], ins[k] - before, available * fix, available, np.array([1.2])
        )


def enumerated(bank, task, seen):
    """Log-likelihood and estimate by every sequence of INS level, onset, end and receiver level, none merged.

    A pull begins at a multiple of the spacing; being there with its age, it ends with the hazard of its duration.
    """
    p, prior, T, steps = task.parameters, bank.prior, INTERVAL, len(seen)
    levels, L = np.array(prior.levels), len(prior.levels)
    stay = math.exp(-prior.level_rate * T)
    change = stay * np.eye(L) + (1.0 - stay) / L
    share = prior.onset_rate * bank.spacing * T
    begins = share / (1.0 + share)
    # Histories of the pull: onset and end, numbers of measurements, None for never.
    births = [None, *range(bank.spacing, steps + 1, bank.spacing)]
    histories = []
    for onset in births:
        ends = [None] if onset is None else [None, *range(onset + 1, steps + 1)]
        histories += [(onset, end) for end in ends]
    total, parts = [], []
    drift, coloured, _, growth, wandering, decay = (np.ravel(noise) for noise in bank.noises)
    white = growth - p.sampling.residual * coloured**2
    for j, (onset, end) in itertools.product(range(len(drift)), histories):
        A, W, P0 = error_model(drift[j], coloured[j], p.correlation_time, white[j] / T)
        F, Q = np.diag([0.0, 0.0, 0.0, decay[j], 1.0]), np.zeros((5, 5))
        Q[3, 3] = wandering[j] ** 2 * (1.0 - decay[j] ** 2)
        F[:3, :3], Q[:3, :3] = van_loan(A, W, T)
        weight = math.log(float(np.ravel(bank.noise_weights)[j]))
        if j == 0 and onset is not None:
            continue  # what is as modelled is never pulled off
        for k in range(1, steps + 1):
            pulled = onset is not None and onset <= k and (end is None or k < end)
            if onset is None or k < onset:
                weight += math.log(1.0 - begins) if j and k % bank.spacing == 0 else 0.0
            elif k == onset:
                weight += math.log(begins)
            elif end is None or k <= end:
                age = T * (k - onset + 0.5 * (bank.spacing + 1))
                hazard = min(T / max(prior.longest - age, T), 1.0) if age > prior.shortest else 0.0
                weight += math.log(1.0 - hazard) if pulled else math.log(hazard) if hazard else -math.inf
            elif k % bank.spacing == 0:
                weight += math.log(1.0 - begins)  # and a second pull is left out
        if weight == -math.inf:
            continue
        first = (1.0 - prior.distrust) * np.isclose(levels, 1.0) + prior.distrust / L
        for sequence in itertools.product(range(L), repeat=steps):
            log, x, P = weight, np.zeros(5), np.zeros((5, 5))
            P[:3, :3], P[3, 3] = P0, wandering[j] ** 2
            for k, measurement in enumerate(seen, 1):
                log += math.log(first[sequence[0]] if k == 1 else change[sequence[k - 2], sequence[k - 1]])
                if k == onset:
                    P[4, 4] = prior.rate**2
                x, P = F @ x, F @ P @ F.T + Q
                pulled = onset is not None and onset <= k and (end is None or k < end)
                h = T * (k - onset + 0.5 * (bank.spacing + 1)) if pulled else 0.0
                if measurement.available[0]:
                    H = np.array([1.0, 0.0, 0.0, -1.0, -h])
                    S = H @ P @ H + levels[sequence[k - 1]] * measurement.reported_deviation[0] ** 2
                    nu = measurement.ins[0, 0] - measurement.fix[0, 0] - H @ x
                    log += -0.5 * (nu**2 / S + math.log(2.0 * math.pi * S))
                    x, P = x + P @ H * nu / S, P - np.outer(P @ H, P @ H) / S
            total.append(log)
            parts.append((x[0], P[0, 0]))
    total = np.array(total)
    weights = np.exp(total - total.max())
    likelihood = total.max() + math.log(weights.sum())
    weights /= weights.sum()
    means, variances = np.array(parts).T
    mean = weights @ means
    return likelihood, seen[-1].ins[0, 0] - mean, weights @ (variances + (means - mean) ** 2)


def of_bank(bank, seen):
    """The same of the bank."""
    state = bank.start(Initial(np.zeros((1, 1)), np.zeros((1, 1, 1))))
    total = 0.0
    for measurement in seen:
        state = bank.step(state, FilterInput(measurement))
        total += np.nan_to_num(state.likelihood.log_likelihood[0])
    return total, state.mean[0, 0], state.covariance[0, 0, 0]


def small(**changed):
    """A bank of few hypotheses and its task."""
    task = make_model(ID, "gain", "random", sampling_interval=INTERVAL, horizon=7, decision_interval=1).task
    prior = {
        "points": 2,
        "onsets": 3,
        "shortest": 5.0,
        "longest": 0.9,
        "onset": (0.0, 9.0),
        "onset_rate": 0.5,
    }
    return FaultBank(task, TRAINING, **{**prior, "levels": (1.0,), **changed}), task


@pytest.mark.parametrize("seed", range(2))
def test_without_merging_the_bank_is_the_enumeration_of_all_hypotheses(seed):
    """No pull ends, and the receiver has one level."""
    bank, task = small()
    seen = list(measurements(seed))
    np.testing.assert_allclose(of_bank(bank, seen), enumerated(bank, task, seen), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("seed", range(2))
def test_merging_costs_little(seed):
    """With ends and two levels the bank merges, which no bound limits; what it loses here is small."""
    bank, task = small(
        shortest=0.0, levels=(1.0, 6.0), points=1, onsets=4, longest=1.2, level_rate=1.0, onset_rate=0.2
    )
    seen = list(measurements(seed, 5))
    found, exact = of_bank(bank, seen), enumerated(bank, task, seen)
    assert found[0] == pytest.approx(exact[0], abs=0.15)
    assert found[1] == pytest.approx(exact[1], abs=0.2 * math.sqrt(exact[2]))
    assert found[2] == pytest.approx(exact[2], rel=0.25)


@pytest.mark.parametrize("seed", range(2))
def test_four_filters_are_the_enumeration_while_nothing_is_merged(seed):
    four = {name: getattr(FEW, name) for name in ("points", "onsets")}
    bank, task = small(**four)
    seen = list(measurements(seed, 3))
    assert of_bank(bank, seen) == pytest.approx(enumerated(bank, task, seen), rel=1e-10, abs=1e-10)
    memory = bank.start(Initial(np.zeros((1, 1)), np.zeros((1, 1, 1)))).memory
    assert memory.free.weights[..., 0].size + memory.pulled.weights[..., 0].size == 4


def test_the_first_fix_gives_the_exact_mixture():
    bank, task = small(levels=(1.0, 6.0), distrust=0.4)
    (first, *_) = measurements(3)
    state = bank.start(Initial(np.zeros((1, 1)), np.zeros((1, 1, 1))))
    found = bank.step(state, FilterInput(first)).likelihood
    p, nu = task.parameters, first.ins[0, 0] - first.fix[0, 0]
    density = 0.0
    mixed = np.array([0.8, 0.2])  # a new report outweighs what was known before
    for weight, *noises in zip(*(np.ravel(x) for x in (bank.noise_weights, *bank.noises)), strict=True):
        drift, coloured, _, white, wandering, _ = noises
        s = p.sampling
        V = (
            (s.step * drift) ** 2
            + (s.drive * coloured) ** 2
            + (s.coupling * s.coloured * coloured) ** 2
            + white
            + wandering**2
        )
        for q, level in zip(mixed, (1.0, 6.0), strict=True):
            S = V + level * 1.44
            density += weight * q * math.exp(-0.5 * nu**2 / S) / math.sqrt(2.0 * math.pi * S)
    assert found.log_likelihood[0] == pytest.approx(math.log(density), rel=1e-12)


# --- control hypotheses


@pytest.fixture(scope="module")
def steered():
    """The bank of control hypotheses, for every fix its state as predicted and the measurement, and the estimator's
    answers.
    """
    outage = {"outage_probability": 1.0, "outage_start": (0.4, 0.4), "outage_duration": (0.1, 0.3)}
    model = make_model(ID, "hypotheses", "random", axes=2, horizon=120, **outage)
    bank = model.filter
    scans, answers = watch_hypotheses(model, FaultBank(model.task), "fix", np.zeros(6))
    assert 0.0 < np.mean([measurement.available for _, measurement in scans]) < 1.0
    assert sum(state.own.memory.pulled.weights.max() > 0.01 for state, _ in scans) > 10
    return bank, scans, answers


def weights_after(bank, state, measurement, action):
    memory = act(bank, state, measurement, action).own.memory
    return bank.own.join_groups([memory.free.weights, memory.pulled.weights], 0)


def test_zero_hypotheses_is_the_estimator_bit_for_bit(steered):
    assert_no_action_is_the_estimator(*steered, np.zeros(6))


@pytest.mark.parametrize(("index", "factor"), [(0, 1.05), (1, 1.05)])
def test_hypotheses_multiplies_odds(steered, index, factor):
    bank, scans, _ = steered
    points = bank.own.prior.points
    for state, measurement in scans[::7]:
        before = weights_after(bank, state, measurement, np.zeros(6))
        after = weights_after(bank, state, measurement, 0.7 * np.eye(6)[index])
        raised = np.zeros(len(before), dtype=bool)
        raised[[slice(points + 1, None), slice(1)][index]] = True
        # Odds of sums, whatever the hypotheses weigh.
        odds = [p[raised].sum(axis=0) / p[~raised].sum(axis=0) for p in (before, after)]
        there = measurement.available > 0.0
        np.testing.assert_allclose(odds[1], np.where(there, factor**0.7, 1.0) * odds[0], rtol=1e-9)


def test_hypotheses_scales_noises(steered):
    """As if the hypotheses had been predicted with other noises, and the fix weighed with other levels."""
    bank, scans, _ = steered
    inner, action = bank.own, np.array([0.0, 0.0, 0.6, -0.5, 0.8, -0.9])
    level, receiver, inertial, wandering = np.array([1.5, 1.25, 2.0, 2.0]) ** action[2:]
    noises = inner.noises._replace(
        coloured_growth=inertial * inner.noises.coloured_growth,
        white_growth=inertial * inner.noises.white_growth,
        wandering=math.sqrt(wandering) * inner.noises.wandering,
    )
    # Measurements at which every lane has a fix and which are not the first.
    chosen = [k for k in range(1, len(scans)) if (scans[k][1].available > 0.0).all()]
    assert len(chosen) > 20
    for k in chosen[::4]:
        state, measurement = scans[k]
        before = act(bank, *scans[k - 1], np.zeros(6)).own.memory
        free, pulled = inner.switch_spoofing(before.free, before.pulled, measurement.number)
        free = inner.predict_part(free, noises)
        pulled = inner.predict_part(pulled, type(noises)(*(each[1:] for each in noises)))
        variances = np.array(inner.prior.levels)[:, None]
        levels = state.own.memory.levels * level ** (np.log(variances) / math.log(variances[-1, 0]))
        predicted = state.own.memory._replace(
            free=free,
            pulled=pulled,
            levels=levels / levels.sum(axis=0),
            reported=receiver * state.own.memory.reported,
        )
        expected = inner.posterior_state(predicted, measurement, inner.weigh(predicted, measurement))
        found = act(bank, state, measurement, action).own
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(found.memory.levels, expected.memory.levels, rtol=1e-8, atol=1e-12)


def test_groups_of_hypotheses_are_probabilities(steered):
    bank, scans, _ = steered
    for state, _ in scans[::10]:
        for groups in (state.predicted, state.probabilities):
            assert (groups >= 0.0).all()
            np.testing.assert_allclose(groups[: len(bank.noise_names)].sum(axis=0), 1.0, rtol=1e-12)
        pulled = state.own.memory.pulled.weights.sum(axis=(0, 1))
        np.testing.assert_allclose(state.predicted[-2:].sum(axis=0), pulled, rtol=1e-12)
