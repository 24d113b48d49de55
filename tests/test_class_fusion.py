"""Class fusion: the recursion against a naive one, the bank as its special case, the ESM's mathematics."""

import itertools
import math

import numpy
import pytest

from filtergym.envs.radar_esm_tracking.task import RadarEsmTracking, RadarEsmTrackingParameters
from filtergym.filters import class_fusion, imm
from filtergym.papers.radar_esm_class_fusion.experiment import (
    channel_error_covariance,
    information_per_decision,
)

PARAMETERS = RadarEsmTrackingParameters()
MODELS, START = RadarEsmTracking.design_models(PARAMETERS)
ASYMMETRIC = numpy.array([[0.9, 0.08, 0.02], [0.0, 0.7, 0.3], [0.25, 0.05, 0.7]])


def bank(rng, N):
    P = rng.dirichlet([1.0, 1.0, 1.0], N).T
    mean = rng.standard_normal((3, 3, N)) * numpy.array([1000.0, 20.0, 5.0])[:, None, None]
    root = rng.standard_normal((3, 3, 3, N)) * numpy.array([1000.0, 20.0, 5.0])[:, None, None, None]
    covariance = numpy.einsum("iksn,jksn->ijsn", root, root)
    z = numpy.stack([2000.0 * rng.standard_normal(N), 30.0 * rng.standard_normal(N)])
    return P, mean, covariance, z


def naive(P, mean, covariance, z, models, q, factor):
    """Equations (8) to (12) as printed, one lane, matrices and loops."""
    M = len(P)
    mu, Omega, Lambda = [], [], []
    for s in range(M):
        x = models.Phi[..., s] @ mean[:, s]
        R = models.Phi[..., s] @ covariance[..., s] @ models.Phi[..., s].T + models.Q[..., s]
        Theta = models.H @ R @ models.H.T + models.R
        Delta = z - models.H @ x
        K = R @ models.H.T @ numpy.linalg.inv(Theta)
        mu.append(x + K @ Delta)
        Omega.append(R - K @ models.H @ R)
        Lambda.append(
            numpy.linalg.det(Theta) ** -0.5 * math.exp(-0.5 * Delta @ numpy.linalg.inv(Theta) @ Delta)
        )
    posterior, X, C = numpy.zeros(M), [], []
    for s in range(M):
        w = numpy.array([P[r] * q[r, s] * Lambda[r] for r in range(M)])
        posterior[s] = factor[s] * w.sum()
        X.append(sum(w[r] * mu[r] for r in range(M)) / w.sum())
        C.append(sum(w[r] * (Omega[r] + numpy.outer(mu[r] - X[s], mu[r] - X[s])) for r in range(M)) / w.sum())
    posterior /= posterior.sum()
    out = sum(posterior[s] * X[s] for s in range(M))
    second = sum(posterior[s] * (C[s] + numpy.outer(X[s], X[s])) for s in range(M))
    return posterior, numpy.stack(X, -1), numpy.stack(C, -1), out, second - numpy.outer(out, out)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("q", [ASYMMETRIC, numpy.eye(3)], ids=["asymmetric", "identity"])
def test_recursion_is_the_printed_one(seed, q):
    rng = numpy.random.default_rng(seed)
    P, mean, covariance, z = bank(rng, 8)
    factor = rng.uniform(0.05, 0.9, (3, 8))
    step = class_fusion.advance(P, mean, covariance, z, MODELS, q)
    posterior = imm.mode_posterior(step.log_predicted, numpy.log(factor))
    out, out_covariance = imm.combine(step.mean, step.covariance, posterior)
    scale = numpy.array([1000.0, 20.0, 5.0])
    for n in range(8):
        p, X, C, x, R = naive(P[:, n], mean[..., n], covariance[..., n], z[:, n], MODELS, q, factor[:, n])
        # A few hundred operations on numbers of one scale; Omega and (12) of the oracle subtract.
        assert posterior[:, n] == pytest.approx(p, rel=1e-10, abs=1e-15)
        assert step.mean[..., n] / scale[:, None] == pytest.approx(X / scale[:, None], abs=1e-11)
        assert out[:, n] / scale == pytest.approx(x / scale, abs=1e-11)
        both = numpy.outer(scale, scale)
        assert step.covariance[..., n] / both[..., None] == pytest.approx(C / both[..., None], abs=1e-9)
        assert out_covariance[..., n] / both == pytest.approx(R / both, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_identity_is_a_bank_of_kalman_filters(seed):
    rng = numpy.random.default_rng(seed)
    N, scans = 8, 60
    channels = class_fusion.design_channels(MODELS, START, scans)
    assert {part.shape[-1] for part in channels} == {scans + 1}
    mean = numpy.zeros((3, 3, N)) + numpy.array([1e3, -5.0, 0.0])[:, None, None]
    general, general_covariance = mean, START[..., None] + numpy.zeros(N)
    P = Q = numpy.full((3, N), 1 / 3)
    for k in range(1, scans + 1):
        z = numpy.stack([1e3 + 3000 * rng.standard_normal(N), 20 * rng.standard_normal(N)])
        step = class_fusion.advance(Q, general, general_covariance, z, MODELS, numpy.eye(3))
        general, general_covariance, Q = step.mean, step.covariance, numpy.exp(step.log_predicted)
        scan = class_fusion.Channels(*(part[..., numpy.full(N, k)] for part in channels))
        update = class_fusion.update_channels(mean, z, MODELS, scan)
        mean = update.mean
        P = imm.mode_posterior(imm.log_probabilities(P), update.log_likelihood)
        # The issue of both ways of computing one thing: relative 1e-12 (ranges of kilometres).
        assert general == pytest.approx(mean, rel=1e-12, abs=1e-9)
        assert general_covariance == pytest.approx(scan.covariance, rel=1e-11)
        assert pytest.approx(P, abs=1e-12) == Q
        assert step.log_likelihood == pytest.approx(update.log_likelihood, rel=1e-12)
        assert step.innovation == pytest.approx(update.innovation, rel=1e-11, abs=1e-11)


def test_whitened_innovations_square_to_the_nis():
    P, mean, covariance, z = bank(numpy.random.default_rng(2), 8)
    step = class_fusion.advance(P, mean, covariance, z, MODELS, numpy.eye(3))
    Phi = MODELS.Phi[..., 1]
    predicted = Phi @ covariance[..., 1, 4] @ Phi.T + MODELS.Q[..., 1]
    Theta = MODELS.H @ predicted @ MODELS.H.T + MODELS.R
    Delta = z[:, 4] - MODELS.H @ Phi @ mean[:, 1, 4]
    w = step.innovation[:, 1, 4]
    assert w @ w == pytest.approx(Delta @ numpy.linalg.solve(Theta, Delta), rel=1e-12)
    assert w[0] == pytest.approx(Delta[0] / math.sqrt(Theta[0, 0]), rel=1e-12)


# --- exact errors


def joint_start(target):
    """Covariance of truth and error when the first measurement starts the track."""
    joint = numpy.zeros((6, 6))
    variance = PARAMETERS.acceleration_sigma[target] ** 2
    joint[2, 2] = joint[5, 5] = variance
    joint[2, 5] = joint[5, 2] = -variance
    joint[3, 3], joint[4, 4] = PARAMETERS.range_sigma**2, PARAMETERS.range_rate_sigma**2
    return joint


def exact_deviations(target, channel):
    channels = class_fusion.design_channels(MODELS, START, 120)
    errors = channel_error_covariance(MODELS, channels, target, channel, joint_start(target))
    return numpy.sqrt(numpy.stack([errors[i, i] for i in range(3)]))


def test_exact_errors_in_the_windows():
    windows = {(1, 20): 0, (20, 60): 1, (60, 120): 2}
    table = {
        (0, 2, 1): (12.27, 11.74, 11.74),
        (0, 0, 1): (8.71, 7.02, 6.85),
        (0, 2, 2): (7.10, 5.86, 5.86),
        (0, 0, 2): (2.01, 1.32, 1.29),
        (1, 2, 1): (12.39, 11.85, 11.85),
        (1, 1, 1): (11.04, 9.84, 9.84),
        (1, 2, 2): (7.84, 6.39, 6.39),
        (1, 1, 2): (5.77, 4.12, 4.12),
        (2, 2, 1): (13.55, 13.13, 13.13),
        (2, 2, 2): (13.21, 11.74, 11.74),
    }
    for (target, channel, component), row in table.items():
        deviations = exact_deviations(target, channel)[component]
        for (first, last), i in windows.items():
            rms = math.sqrt((deviations[first : last + 1] ** 2).mean())
            assert rms == pytest.approx(row[i], abs=0.0055)


def test_a_matched_filter_reports_its_error():
    channels = class_fusion.design_channels(MODELS, START, 40)
    for s in range(3):
        exact = channel_error_covariance(MODELS, channels, s, s, joint_start(s))
        assert exact == pytest.approx(channels.covariance[:, :, s], rel=1e-9)


# --- ESM


def test_information_per_decision():
    probabilities = class_fusion.decision_probabilities(
        numpy.array(PARAMETERS.recognition), numpy.array(PARAMETERS.composition)
    )
    assert probabilities == pytest.approx(1 / 30 + 26 / 30 * numpy.array(PARAMETERS.composition), rel=1e-12)
    information = information_per_decision(probabilities)
    pairs = [information[0, 1], information[0, 2], information[1, 2], information[2, 1]]
    assert pairs == pytest.approx([1.21, 1.47, 0.66, 0.64], abs=0.0055)


@pytest.mark.parametrize("measured", [1, 2])
def test_taking_coloured_errors_away_is_a_linear_map(measured):
    """Of the first components the coloured error is subtracted, which is the last components of the state."""
    rng = numpy.random.default_rng(5)
    size = 3 + measured
    root = rng.normal(size=(size, size, 4))
    mean, covariance = rng.normal(size=(size, 4)), numpy.einsum("ikb,jkb->ijb", root, root)
    A = numpy.eye(3, size)
    A[range(measured), range(3, size)] = -1.0
    states, both = class_fusion.remove_coloured_errors(mean, covariance, measured)
    for b in range(4):
        numpy.testing.assert_allclose(states[:, b], A @ mean[:, b], rtol=1e-12)
        numpy.testing.assert_allclose(both[..., b], A @ covariance[..., b] @ A.T, rtol=1e-10, atol=1e-12)


def test_decisions_follow_the_rows_of_an_asymmetric_confusion():
    rng = numpy.random.default_rng(2)
    confusion, composition = rng.dirichlet([1.0] * 4, 4), rng.dirichlet([1.0] * 4, 3)
    found = class_fusion.decision_probabilities(confusion, composition)
    for s, decision in numpy.ndindex(3, 4):
        expected = sum(composition[s, j] * confusion[j, decision] for j in range(4))
        assert found[s, decision] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_fixed_type_posterior_sums_over_the_types(seed):
    rng = numpy.random.default_rng(seed)
    confusion, composition = rng.dirichlet([1.0] * 4, 4), rng.dirichlet([1.0] * 4, 3)
    decisions = rng.integers(0, 4, (6, 8))
    counts = numpy.stack([(decisions == j).sum(axis=0) for j in range(4)]).astype(float)
    result = class_fusion.constant_class_log_likelihood(counts, numpy.log(confusion), numpy.log(composition))
    for n, s in itertools.product(range(8), range(3)):
        likelihood = sum(composition[s, j] * math.prod(confusion[j, decisions[:, n]]) for j in range(4))
        assert result[s, n] == pytest.approx(math.log(likelihood), rel=1e-12)


@pytest.mark.parametrize("change", [0.0, 0.03, 1.0])
def test_change_of_class_and_type_is_the_chain_written_out(change):
    rng = numpy.random.default_rng(4)
    joint = rng.dirichlet(numpy.ones(12), size=6).T.reshape(3, 4, 6)
    composition = rng.dirichlet(numpy.ones(4), size=3)
    shifted = numpy.log(joint) + 500.0  # known up to a constant
    after = numpy.exp(class_fusion.change_class_and_type(shifted, numpy.log(composition), change))
    for n in range(6):
        expected = numpy.zeros((3, 4))
        for s, j, r, i in numpy.ndindex(3, 4, 3, 4):
            q = 1.0 - change if s == r else change / 2.0
            type_kept = float(i == j) if s == r else composition[r, i]
            expected[r, i] += joint[s, j, n] * q * type_kept
        # Rounding of logarithms near 500.
        assert after[..., n] / after[..., n].sum() == pytest.approx(expected, rel=1e-12, abs=1e-13)


def test_gate_and_wrapped_bearings():
    assert class_fusion.bearing_gate(15.0, 3.0, 0.1) == pytest.approx(25.2, abs=0.05)
    assert class_fusion.bearing_gate(1.5, 3.0, 0.1) == pytest.approx(5.52, abs=0.005)
    differences = class_fusion.bearing_difference(
        numpy.array([359.0, 1.0, 10.0]), numpy.array([1.0, 359.0, 4.0])
    )
    assert differences.tolist() == [-2.0, 2.0, 6.0]
    for bad in (0.0, 1.0, -0.1, 1.5):
        with pytest.raises(ValueError, match="error_probability"):
            class_fusion.bearing_gate(1.0, 1.0, bad)
