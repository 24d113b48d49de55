"""Smoothers against the Gaussian conditional of the whole track, and against every sequence of modes."""

import itertools

import numpy as np
import pytest

from filtergym.compiler.functions import CompiledFunction
from filtergym.compiler.program import Graph
from filtergym.filters import gaussian, imm, kalman, scans, smoothing

H = np.array([[1.0, 0.0]])


def transitions(intervals, sigma):
    """White acceleration over irregular intervals: F and Q of every scan but the first, ``(2, 2, K - 1, 1)``."""
    each = [kalman.white_acceleration(T, sigma) for T in intervals]
    return tuple(np.moveaxis(np.array([pair[i] for pair in each]), 0, -1)[..., None] for i in (0, 1))


def forward(start, F, Q, z, available, R):
    """Kalman filter over a batch of tracks; the start of the track is scan 0 and has no measurement."""
    mean, covariance = start
    kept = [(mean, covariance)]
    for k in range(F.shape[2]):
        mean, covariance = kalman.predict(mean, covariance, F[:, :, k], Q[:, :, k])
        if available[k]:
            mean, covariance = kalman.update(mean, covariance, z[:, k], H, R)[:2]
        kept.append((mean, covariance))
    return smoothing.Gaussian(*(np.stack(parts, axis=-2) for parts in zip(*kept, strict=True)))


def motion_of(filtered, F, Q):
    """Prediction of all scans but the last."""
    mean = filtered.mean[:, :-1]
    return smoothing.Motion(
        F, Q, np.einsum("ijkn,jkn->ikn", np.broadcast_to(F, (2, 2, *mean.shape[1:])), mean)
    )


def joint(start_covariance, F, Q):
    """Covariance of the states of a whole track, ``(2 K, 2 K)``, dense, from F and Q ``(2, 2, K - 1)``."""
    blocks = [[start_covariance]]
    for k in range(F.shape[2]):
        A = F[:, :, k]
        row = [A @ block for block in blocks[k]]
        diagonal = A @ blocks[k][k] @ A.T + Q[:, :, k]
        for i, block in enumerate(row):
            blocks[i].append(block.T)
        blocks.append([*row, diagonal])
    return np.block(blocks)


def conditional(mean, covariance, seen, z, R):
    """Mean and covariance of a track given the positions at some scans, and the log-density of these."""
    M = np.zeros((len(seen), len(mean)))
    M[np.arange(len(seen)), 2 * np.array(seen, dtype=int)] = 1.0
    S = M @ covariance @ M.T + R * np.eye(len(seen))
    gain = np.linalg.solve(S, M @ covariance).T
    residual = z - M @ mean
    density = -0.5 * (residual @ np.linalg.solve(S, residual) + np.linalg.slogdet(2.0 * np.pi * S)[1])
    return mean + gain @ residual, covariance - gain @ M @ covariance, density


def batch_smoothed(start, F, Q, z, available, R, lag=None):
    """Naive oracle: every state given all measurements up to ``lag`` scans later, by one dense linear system."""
    mean0, covariance0 = start
    K = F.shape[2] + 1
    C = joint(covariance0, F, Q)
    mean = [mean0]
    for k in range(K - 1):
        mean.append(F[:, :, k] @ mean[-1])
    found = []
    for k in range(K):
        last = K - 1 if lag is None else min(k + lag, K - 1)
        seen = [i for i in range(1, last + 1) if available[i - 1]]
        m, P, _ = conditional(np.concatenate(mean), C, seen, z[[i - 1 for i in seen]], R)
        found.append((m[2 * k : 2 * k + 2], P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]))
    return tuple(np.stack(parts, axis=-1) for parts in zip(*found, strict=True))


INTERVALS = np.array([1.0, 0.3, 2.5, 1.0, 4.0, 0.01, 1.0, 1.0])
AVAILABLE = np.array([1, 1, 0, 1, 0, 0, 1, 1], dtype=bool)
START = np.array([3.0, -1.0]), np.array([[4.0, 0.5], [0.5, 1.0]])


def tracks(seed, batch=3):
    """Measured positions ``(K - 1, batch)``; whatever they are, the smoother is linear in them."""
    return np.random.default_rng(seed).normal(scale=5.0, size=(len(INTERVALS), batch))


def batched(start, batch):
    return tuple(np.repeat(part[..., None], batch, axis=-1) for part in start)


@pytest.mark.parametrize("sigma", [0.0, 0.7])
@pytest.mark.parametrize("lag", [None, 1, 3, 100])
@pytest.mark.parametrize("available", [AVAILABLE, np.zeros(8, dtype=bool)])
def test_smoothing_is_the_conditional_of_the_whole_track(sigma, lag, available):
    # Without process noise the posterior is singular in the joint; the oracle inverts only what is measured.
    F, Q = transitions(INTERVALS, sigma)
    z, R = tracks(1), 0.8
    filtered = forward(batched(START, 3), F, Q, z[None], available, np.array([[R]]))
    smoothed = smoothing.smooth(filtered, motion_of(filtered, F, Q), lag)
    for n in range(3):
        mean, covariance = batch_smoothed(START, F[..., 0], Q[..., 0], z[:, n], available, R, lag)
        # Rounding of covariances up to 300, that of a track predicted over ten seconds.
        np.testing.assert_allclose(smoothed.mean[..., n], mean, rtol=0, atol=2e-11)
        np.testing.assert_allclose(smoothed.covariance[..., n], covariance, rtol=0, atol=2e-11)


def test_a_component_that_is_known_exactly_stays_known():
    # The predicted covariance is singular: its factor has a zero column, and no number is divided by zero.
    F, Q = transitions(INTERVALS, 0.0)
    start = START[0], np.diag([4.0, 0.0])
    z, R = tracks(2), 0.8
    filtered = forward(batched(start, 3), F, Q, z[None], AVAILABLE, np.array([[R]]))
    smoothed = smoothing.smooth(filtered, motion_of(filtered, F, Q))
    for n in range(3):
        mean, covariance = batch_smoothed(start, F[..., 0], Q[..., 0], z[:, n], AVAILABLE, R)
        np.testing.assert_allclose(smoothed.mean[..., n], mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(smoothed.covariance[..., n], covariance, rtol=0, atol=1e-13)


def test_lag_zero_is_the_filter_to_the_last_bit():
    F, Q = transitions(INTERVALS, 0.7)
    filtered = forward(batched(START, 3), F, Q, tracks(3)[None], AVAILABLE, np.array([[0.8]]))
    smoothed = smoothing.smooth(filtered, motion_of(filtered, F, Q), 0)
    for own, other in zip(smoothed, filtered, strict=True):
        np.testing.assert_array_equal(own, other)

    with pytest.raises(ValueError, match="at least 0, got -1"):
        smoothing.smooth(filtered, motion_of(filtered, F, Q), -1)


def test_a_long_track_is_smoothed_alike_in_native_code_and_in_python(monkeypatch):
    # In native code many scans are one call, here 24 lanes times scans; alone or beside others, and with a lag.
    count = 70
    F, Q = transitions(np.random.default_rng(4).uniform(0.1, 3.0, count), 0.7)
    z, available = np.random.default_rng(5).normal(scale=5.0, size=(count, 3)), np.arange(count) % 4 != 0
    filtered = forward(batched(START, 3), F, Q, z[None], available, np.array([[0.8]]))
    single = smoothing.Gaussian(*(part[..., 1:2] for part in filtered))
    motion = motion_of(filtered, F, Q)
    alone = motion._replace(predicted=motion.predicted[..., 1:2])
    monkeypatch.setattr(scans, "TOGETHER", 24)
    for lag in (None, 1, 5, count - 1, count):
        found = smoothing.smooth(filtered, motion, lag)
        one = smoothing.smooth(
            single, lambda some, own=alone: scans.take_scans(repeated(own, count), some), lag
        )
        with monkeypatch.context() as patch:
            patch.setattr(scans, "LEAST", count + 1)
            expected = smoothing.smooth(filtered, motion, lag)
        for own, other, first in zip(found, one, expected, strict=True):
            np.testing.assert_array_equal(own, first)
            np.testing.assert_array_equal(other, first[..., 1:2])


def repeated(motion, count):
    return scans.repeat(motion, (count, 1))


def test_scans_are_a_sequence_made_of_arrays():
    track = scans.Scans(smoothing.Gaussian(np.arange(12.0).reshape(3, 2, 2), np.ones((3, 2, 2, 2))))
    assert len(track) == 3
    assert [one.mean[0, 0] for one in track] == [0.0, 4.0, 8.0]
    np.testing.assert_array_equal(track[-1].mean, [[8.0, 9.0], [10.0, 11.0]])
    assert [one.mean[1, 1] for one in track[1:]] == [7.0, 11.0]
    stacked, expected = scans.stack_scans(track), scans.stack_scans(list(track))
    for own, other in zip(stacked, expected, strict=True):
        np.testing.assert_array_equal(own, other)
    with pytest.raises(IndexError):
        track[3]


# --- several models

TRANSITION = np.array([[0.9, 0.1], [0.2, 0.8]])
PROBABILITIES = np.array([0.5, 0.5])


def run_imm(start, motions, transition, probabilities, z, available, R):
    """IMM over a batch of tracks: filtered bank with a time axis, and what arrives at all scans but the first.

    Args:
        start: mean and covariance, with the batch.
        motions: F and Q of each model, ``(2, 2, K - 1, 1)``.
        transition: of the modes.
        probabilities: at the start.
        z: ``(K - 1, N)``.
        available: ``(K - 1,)``.
        R: variance.
    """
    M = len(motions)
    bank = smoothing.GaussianMixture(
        np.stack([start[0]] * M, axis=1),
        np.stack([start[1]] * M, axis=2),
        np.repeat(probabilities[:, None], z.shape[1], axis=1),
    )
    kept, predicted_means = [bank], []
    for k in range(len(z)):
        prediction = imm.predict_mode_probabilities(transition, bank.probabilities)
        mixed = imm.mix(*bank[:2], prediction.mixing)
        predicted = [
            kalman.predict(mixed[0][:, j], mixed[1][:, :, j], F[:, :, k], Q[:, :, k])
            for j, (F, Q) in enumerate(motions)
        ]
        predicted_means.append(np.stack([mean for mean, _ in predicted], axis=1))
        results, posterior = predicted, prediction.probabilities
        if available[k]:
            results = [kalman.update(*each, z[None, k], H, np.array([[R]])) for each in predicted]
            log_likelihood = np.stack([r.log_likelihood for r in results])
            posterior = imm.mode_posterior(imm.log_probabilities(posterior), log_likelihood)
        bank = smoothing.GaussianMixture(
            np.stack([r[0] for r in results], axis=1), np.stack([r[1] for r in results], axis=2), posterior
        )
        kept.append(bank)
    filtered = smoothing.GaussianMixture(*(np.stack(parts, axis=-2) for parts in zip(*kept, strict=True)))
    F, Q = (np.stack([motion[i] for motion in motions], axis=2) for i in (0, 1))
    motion = smoothing.Motion(F, Q, np.stack(predicted_means, axis=-2))
    precision = available[None, None, :, None] / R
    position = np.where(available[:, None], z, 0.0)[None]
    return filtered, smoothing.Arrival(motion, H[:, :, None, None], precision, position)


def enumerated(start, motions, transition, probabilities, z, available, R):
    """Naive oracle: the mixture over every sequence of modes, each smoothed by one dense linear system."""
    K = len(z) + 1
    seen = [k for k in range(1, K) if available[k - 1]]
    weights, means, covariances, sequences = [], [], [], []
    for sequence in itertools.product(range(len(motions)), repeat=K):
        F, Q = (
            np.stack([motions[sequence[k]][i][:, :, k - 1, 0] for k in range(1, K)], axis=-1) for i in (0, 1)
        )
        mean = [start[0]]
        for k in range(K - 1):
            mean.append(F[:, :, k] @ mean[-1])
        m, P, density = conditional(
            np.concatenate(mean), joint(start[1], F, Q), seen, z[[k - 1 for k in seen]], R
        )
        steps = itertools.pairwise(sequence)
        weights.append(
            np.log(probabilities[sequence[0]]) + sum(np.log(transition[i, j]) for i, j in steps) + density
        )
        means.append(m)
        covariances.append(P)
        sequences.append(sequence)
    weights = np.exp(np.array(weights) - max(weights))
    weights /= weights.sum()
    mean = np.einsum("s,si->i", weights, means)
    spread = np.array(means) - mean
    covariance = np.einsum("s,sij->ij", weights, covariances) + np.einsum(
        "s,si,sj->ij", weights, spread, spread
    )
    modes = np.array(sequences)[:, :, None] == np.arange(len(motions))
    return mean, covariance, np.einsum("s,skj->jk", weights, modes)


def simulated(seed, sigmas, transition, probabilities, intervals, R, batch):
    """Tracks of a target that changes its mode: states ``(2, K, batch)`` and measured positions ``(K - 1, batch)``."""
    rng = np.random.default_rng(seed)
    states, measured = np.empty((2, len(intervals) + 1, batch)), np.empty((len(intervals), batch))
    for n in range(batch):
        x = rng.multivariate_normal(*START)
        mode = rng.choice(len(sigmas), p=probabilities)
        states[:, 0, n] = x
        for k, T in enumerate(intervals):
            mode = rng.choice(len(sigmas), p=transition[mode])
            x = np.array([x[0] + T * x[1], x[1]]) + sigmas[mode] * rng.normal() * np.array([T**2 / 2, T])
            states[:, k + 1, n] = x
        measured[:, n] = states[0, 1:, n] + np.sqrt(R) * rng.normal(size=len(intervals))
    return states, measured


@pytest.mark.parametrize("lag", [None, 2])
def test_a_long_track_of_an_imm_is_smoothed_alike_in_native_code_and_in_python(monkeypatch, lag):
    intervals = np.random.default_rng(10).uniform(0.3, 2.0, 65)
    motions = [transitions(intervals, sigma) for sigma in (0.1, 2.0)]
    _, z = simulated(11, (0.1, 2.0), TRANSITION, PROBABILITIES, intervals, 1.0, 2)
    filtered, arrival = run_imm(
        batched(START, 2), motions, TRANSITION, PROBABILITIES, z, np.arange(65) % 5 != 2, 1.0
    )
    found = smoothing.smooth_imm(filtered, arrival, TRANSITION, lag)
    monkeypatch.setattr(scans, "LEAST", 66)
    expected = smoothing.smooth_imm(filtered, arrival, TRANSITION, lag)
    # Other code for exponentials, and eigenvectors by rotations in place of LAPACK's.
    for own, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
def test_rotations_find_the_eigenvectors(n):
    # Also of equal eigenvalues, of which any basis is one, and of matrices that are diagonal, or zero.
    rng = np.random.default_rng(n)
    values = np.sort(rng.uniform(0.0, 1.2, (n, 6)), axis=0)
    values[:, 1], values[:, 2], values[: n // 2, 3] = 1.0, 0.0, 1e-9
    Q = np.linalg.qr(rng.normal(size=(6, n, n)))[0]
    Q[4] = np.eye(n)
    A = np.einsum("kij,jk,klj->ilk", Q, values, Q)
    graph = Graph()
    rotated = CompiledFunction(lambda A: smoothing.eigenvectors(A), graph)
    found, vectors = rotated(A)
    np.testing.assert_allclose(np.sort(found, axis=0), values, rtol=0, atol=4e-16 * n)
    np.testing.assert_allclose(
        np.einsum("ijk,jk,ljk->ilk", vectors, found, vectors), A, rtol=0, atol=1e-15 * n
    )
    identity = np.broadcast_to(np.eye(n)[..., None], A.shape)
    np.testing.assert_allclose(np.einsum("jik,jlk->ilk", vectors, vectors), identity, rtol=0, atol=1e-15 * n)


@pytest.mark.parametrize("lag", [None, 0, 1, 3])
@pytest.mark.parametrize("copies", [1, 3])
def test_an_imm_of_equal_models_smooths_like_one(lag, copies):
    F, Q = transitions(INTERVALS, 0.7)
    z = tracks(4)
    one = forward(batched(START, 3), F, Q, z[None], AVAILABLE, np.array([[0.8]]))
    expected = smoothing.smooth(one, motion_of(one, F, Q), lag)
    transition = np.full((copies, copies), 1.0 / copies)
    filtered, arrival = run_imm(
        batched(START, 3), [(F, Q)] * copies, transition, transition[0], z, AVAILABLE, 0.8
    )
    bank = smoothing.smooth_imm(filtered, arrival, transition, lag)
    mean, covariance = imm.combine(*bank)
    # The likelihood of what is later is taken from the ratio of two covariances, and loses digits where they are close.
    np.testing.assert_allclose(mean, expected.mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(covariance, expected.covariance, rtol=0, atol=1e-10)
    np.testing.assert_allclose(bank.probabilities, filtered.probabilities, rtol=0, atol=1e-12)


def test_one_later_scan_makes_the_exact_mixture():
    # From the filter's own mixture nothing is merged before the first scan, so that with two scans no approximation
    # is left but rounding.
    intervals, available = np.array([1.5]), np.ones(1, dtype=bool)
    motions = [transitions(intervals, sigma) for sigma in (0.0, 2.0)]
    _, z = simulated(5, (0.0, 2.0), TRANSITION, PROBABILITIES, intervals, 1.0, 4)
    filtered, arrival = run_imm(batched(START, 4), motions, TRANSITION, PROBABILITIES, z, available, 1.0)
    bank = smoothing.smooth_imm(filtered, arrival, TRANSITION)
    mean, covariance = imm.combine(*bank)
    for n in range(4):
        m, P, modes = enumerated(START, motions, TRANSITION, PROBABILITIES, z[:, n], available, 1.0)
        for k in range(2):
            part = slice(2 * k, 2 * k + 2)
            np.testing.assert_allclose(mean[:, k, n], m[part], rtol=0, atol=1e-13)
            np.testing.assert_allclose(covariance[:, :, k, n], P[part, part], rtol=0, atol=1e-13)
            np.testing.assert_allclose(bank.probabilities[:, k, n], modes[:, k], rtol=0, atol=1e-13)


def test_imm_smoother_is_close_to_every_sequence_of_modes():
    # The merged likelihood and the IMM's mixing are approximations; the figures say how close. A smoother that wrote
    # the filter's estimates again would be off by 1.0 in the mean, and 0.15 in the probabilities.
    intervals, sigmas, batch = np.array([1.0, 0.7, 1.0, 1.5, 1.0, 0.5]), (0.1, 2.0), 24
    available = np.array([1, 1, 0, 1, 0, 1], dtype=bool)
    motions = [transitions(intervals, sigma) for sigma in sigmas]
    _, z = simulated(6, sigmas, TRANSITION, PROBABILITIES, intervals, 1.0, batch)
    filtered, arrival = run_imm(batched(START, batch), motions, TRANSITION, PROBABILITIES, z, available, 1.0)
    smoothed = smoothing.smooth_imm(filtered, arrival, TRANSITION)
    distances = {"smoothed": [], "filtered": []}
    ratios, modes = [], {"smoothed": [], "filtered": []}
    for n in range(batch):
        m, P, exact = enumerated(START, motions, TRANSITION, PROBABILITIES, z[:, n], available, 1.0)
        variances = np.diag(P).reshape(-1, 2).T
        for name, bank in (("smoothed", smoothed), ("filtered", filtered)):
            mean, covariance = imm.combine(*bank)
            distances[name].append((mean[..., n] - m.reshape(-1, 2).T) ** 2 / variances)
            modes[name].append(np.abs(bank.probabilities[..., n] - exact).mean())
            if name == "smoothed":
                ratios.append(np.einsum("iik->ik", covariance[..., n]) / variances)
    off = {name: np.sqrt(np.mean(values)) for name, values in distances.items()}
    wrong = {name: np.mean(values) for name, values in modes.items()}
    assert off["smoothed"] < 0.15 < 0.8 < off["filtered"]
    assert wrong["smoothed"] < 0.05 < 0.12 < wrong["filtered"]
    assert 0.95 < np.mean(ratios) < 1.1


def test_imm_smoother_is_calibrated_over_a_long_track():
    # A mode without noise is where recursions of the Rauch-Tung-Striebel kind get worse than the filter. Two
    # approximations, the IMM's and the merged likelihood, leave the mean NEES within 5 % of that of an exact smoother.
    intervals, sigmas, batch = np.ones(40), (0.0, 2.0), 250
    motions = [transitions(intervals, sigma) for sigma in sigmas]
    states, z = simulated(8, sigmas, TRANSITION, PROBABILITIES, intervals, 1.0, batch)
    filtered, arrival = run_imm(
        batched(START, batch), motions, TRANSITION, PROBABILITIES, z, np.arange(40) % 7 != 3, 1.0
    )
    errors = {}
    for lag in (0, 1, 3, None):
        mean, covariance = imm.combine(*smoothing.smooth_imm(filtered, arrival, TRANSITION, lag))
        nees = gaussian.log_density(mean - states, covariance)[1]
        errors[lag] = np.sqrt(np.mean((mean - states) ** 2, axis=(1, 2)))
        assert 0.95 < nees.mean() / 2 < 1.05
    assert (errors[1] < 0.75 * errors[0]).all()
    assert (errors[3] < errors[1]).all()
    assert (errors[None] < errors[3]).all()


def test_a_lost_episode_leaves_the_others_alone():
    intervals, available = np.ones(8), np.ones(8, dtype=bool)
    motions = [transitions(intervals, sigma) for sigma in (0.0, 2.0)]
    filtered, arrival = run_imm(
        batched(START, 3), motions, TRANSITION, PROBABILITIES, tracks(9), available, 1.0
    )
    expected = smoothing.smooth_imm(filtered, arrival, TRANSITION)
    filtered.mean[:, :, 4, 1] = filtered.covariance[:, :, :, 4, 1] = np.nan
    found = smoothing.smooth_imm(filtered, arrival, TRANSITION)
    for own, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(own[..., [0, 2]], other[..., [0, 2]])
        assert np.isnan(own[..., :4, 1]).any()


def test_an_unreachable_mode_changes_nothing():
    # An absorbing first mode from which all tracks start: the second has probability zero, and no estimate is NaN.
    intervals, available = np.ones(8), np.ones(8, dtype=bool)
    motions = [transitions(intervals, sigma) for sigma in (0.7, 2.0)]
    transition, start = np.array([[1.0, 0.0], [0.2, 0.8]]), np.array([1.0, 0.0])
    filtered, arrival = run_imm(batched(START, 3), motions, transition, start, tracks(9), available, 1.0)
    bank = smoothing.smooth_imm(filtered, arrival, transition)
    one = forward(batched(START, 3), *motions[0], tracks(9)[None], available, np.array([[1.0]]))
    expected = smoothing.smooth(one, motion_of(one, *motions[0]))
    # The floor under logarithms of probabilities, 1e-300, times a likelihood ratio.
    np.testing.assert_allclose(bank.probabilities[1], 0.0, rtol=0, atol=1e-200)
    np.testing.assert_allclose(imm.combine(*bank)[0], expected.mean, rtol=0, atol=1e-11)


def test_torch_smooths_alike():
    torch = pytest.importorskip("torch")
    intervals, available = np.ones(8), np.ones(8, dtype=bool)
    motions = [transitions(intervals, sigma) for sigma in (0.0, 2.0)]
    filtered, arrival = run_imm(
        batched(START, 3), motions, TRANSITION, PROBABILITIES, tracks(9), available, 1.0
    )

    def tensors(part):
        if isinstance(part, tuple):
            return type(part)(*map(tensors, part))
        return torch.tensor(part, dtype=torch.float64)

    for lag in (None, 2):
        expected = smoothing.smooth_imm(filtered, arrival, TRANSITION, lag)
        found = smoothing.smooth_imm(tensors(filtered), tensors(arrival), torch.tensor(TRANSITION), lag)
        for own, other in zip(found, expected, strict=True):
            # Another LAPACK finds other eigenvectors, up to rounding.
            np.testing.assert_allclose(own.numpy(), other, rtol=0, atol=1e-10)
