"""Competitors on a log, stretch by stretch: the numbers of the whole, in a memory that does not grow with the log."""

import itertools
import tracemalloc

import numpy as np
import pytest
from models import Asked
from test_advice import ID, PROBLEM, likelihood_of, read, write_log

from filtergym import read_recording
from filtergym.baselines import advice as advice_module
from filtergym.baselines import log_scores
from filtergym.baselines.advice import FittedLog
from filtergym.baselines.judgement import roles_of, split_recording
from filtergym.baselines.log_scores import report_picture, score_log
from filtergym.baselines.maneuvering_target.estimators import ConstantVelocity
from filtergym.baselines.maneuvering_target.log_families import log_families
from filtergym.evaluation.competitors import likelihood as likelihood_module
from filtergym.evaluation.statistics.bootstrap import ratio
from filtergym.evaluation.statistics.predictions import correlation, stretch_interval
from filtergym.names import find_competitor


class InPython(Asked):
    kind = "estimator"

    def __init__(self, task):
        super().__init__(ConstantVelocity(task, 0.8))


NAMES = ("imm", "adaptive-rearm", "bptt", "kalman-imm")
"""Policies with a memory, in native code, and an estimator."""


def competitors(names=NAMES):
    return {name: find_competitor(PROBLEM, name).maker for name in names} | {"in python": InPython}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Two tracks of different lengths, with missing measurements."""
    folder = tmp_path_factory.mktemp("logs")
    return read_recording(
        [write_log(folder, count=300, missed=0.1), write_log(folder, count=170, seed=1)],
        ID,
        speeds=(0.001, 1000.0),
    )


@pytest.mark.parametrize("rows", [1 << 13, 34])
def test_scores_are_those_of_the_whole_evaluation(recording, rows, monkeypatch):
    """Of every pair, whatever is run at once; sums round otherwise than means by 1e-12."""
    monkeypatch.setattr(log_scores, "ROWS", rows)
    share, makers = split_recording(recording), competitors()
    roles, names = roles_of(share, recording.seconds.shape), list(makers)
    shares = []
    scores = score_log(PROBLEM.experiment(recording), makers, roles, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    whole = PROBLEM.evaluate(makers, recording, tracks=True)
    chosen, judged = (mask[:, : whole.sizes["time"]] for mask in roles)
    likely = {name: whole["log_likelihood"].sel(policy=name).values for name in names}
    groups = whole["measured_group"].values
    errors = whole["prediction_error"][..., groups == groups[0]]
    main = list(next(iter(FittedLog(PROBLEM, recording).task.groups.values())))
    squares = (whole["error"].sel(component=main) ** 2).sum("component", skipna=False)
    predicted = (errors**2).sum("measured", skipna=False)
    for i, name in enumerate(names):
        there = chosen & np.isfinite(likely[name])
        np.testing.assert_allclose(scores.log_likelihood[0].mean(i), likely[name][there].mean(), rtol=1e-12)
        nis, degrees = (whole[key].sel(policy=name).values for key in ("nis", "nis_degrees"))
        there = judged & (degrees > 0.0) & np.isfinite(nis)
        np.testing.assert_allclose(scores.nis(i), nis[there].sum() / degrees[there].sum(), rtol=1e-12)
        white = correlation(np.moveaxis(errors.sel(policy=name).values, -1, 0), judged)
        np.testing.assert_allclose(scores.correlation(i), white, rtol=1e-9)
    for (i, one), (j, other) in itertools.permutations(enumerate(names), 2):
        less = likely[one] - likely[other]
        for sums, mask in zip(scores.log_likelihood, (chosen, judged), strict=True):
            expected = stretch_interval(mask, np.stack([less, np.ones_like(less)], axis=-1), ratio)
            np.testing.assert_allclose(sums.difference(i, j), expected, rtol=1e-9, atol=1e-12)
        for sums, values in ((scores.squared, squares), (scores.predicted[1], predicted)):
            pair = np.stack([values.sel(policy=name).values for name in (one, other)], axis=-1)
            expected = stretch_interval(judged, pair, lambda means: np.sqrt(ratio(means)) - 1.0)
            np.testing.assert_allclose(sums.relative_root(i, j), expected, rtol=1e-9, atol=1e-12)


def test_runs_in_stretches_report_the_bits_of_the_whole(recording, monkeypatch):
    """Policies go on from their memory, filters from their state."""
    makers = competitors()
    whole = PROBLEM.evaluate(makers, recording, tracks=True)
    monkeypatch.setattr(log_scores, "ROWS", 34)
    pieces = log_scores.replay_log(PROBLEM.experiment(recording), makers)
    for name in pieces.data_vars:
        np.testing.assert_array_equal(pieces[name].values, whole[name].values, err_msg=name)
    assert "estimate" in pieces
    assert report_picture.__doc__


@pytest.mark.parametrize("compiled", [True, False])
def test_a_likelihood_in_stretches_is_that_of_the_whole(tmp_path, compiled, monkeypatch):
    """Apart from the order of a sum of 88 terms."""
    monkeypatch.setattr(likelihood_module, "AVAILABLE", likelihood_module.AVAILABLE and compiled)
    recording = read(write_log(tmp_path, count=100, missed=0.2))
    found, tunable = likelihood_of(recording, "imm-two", noise=True)
    low, high = np.array(list(tunable.limits.values())).T
    values = low[:, None] + (high - low)[:, None] * np.random.default_rng(0).uniform(0.2, 0.8, (len(low), 5))
    whole = found(values)
    monkeypatch.setattr(likelihood_module, "STRETCH_NUMBERS", 8 * 33)
    pieces, _ = likelihood_of(recording, "imm-two", noise=True)
    np.testing.assert_allclose(pieces(values), whole, rtol=1e-13)
    assert pieces.count == found.count


def peak(call):
    """Bytes that a call holds at once, at most, beyond what is held before."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_rows_times_competitors(tmp_path, monkeypatch):
    """Four times the rows take what the log itself takes more: some columns of eight bytes."""
    monkeypatch.setattr(log_scores, "ROWS", 256)
    monkeypatch.setattr(likelihood_module, "STRETCH_NUMBERS", 1 << 13)
    scored, likely, rows = [], [], (1000, 4000)
    makers = {name: PROBLEM.competitor(name) for name in ("imm", "kalman-imm", "kalman-pda", "sage-husa")}
    for count in rows:
        recording = read(write_log(tmp_path, count=count))
        roles = roles_of(split_recording(recording), recording.seconds.shape)
        experiment = PROBLEM.experiment(recording)
        score_log(experiment, makers, roles)  # what is compiled once
        scored.append(peak(lambda e=experiment, r=roles: score_log(e, makers, r)))
        found, tunable = likelihood_of(recording, "constant-velocity")
        values = np.repeat([list(tunable.start.values())], 60, axis=0).T
        found(values)
        likely.append(peak(lambda f=found, v=values: f(v)))
    more = rows[1] - rows[0]
    assert scored[1] - scored[0] < 40 * more
    assert likely[1] - likely[0] < 8 * more


def test_a_long_log_is_fitted_to_stretches_first_and_the_finalists_to_all(tmp_path, monkeypatch):
    """The likeliest ends where a fit to all ends; who is far behind keeps the values of the stretches."""
    recording = read(write_log(tmp_path, count=700, seed=3))
    names = ("constant-velocity", "constant-acceleration")

    def families(problem, recording):
        return {name: log_families(recording)[name] for name in names}

    monkeypatch.setattr(advice_module, "families_of", families)
    fitted = {}
    for coarse in (4096, 100):
        monkeypatch.setattr(advice_module, "COARSE", coarse)
        log = FittedLog(PROBLEM, recording)
        assert (log.stretches is None) == (coarse == 4096)
        fitted[coarse] = advice_module._fit_families(log, {}, lambda what, share: None)
    whole, first = (fitted[coarse].found for coarse in (4096, 100))
    for name in names:
        assert first[name].measurements == whole[name].measurements
        likelihood = fitted[100].likelihoods[name]
        values = np.array([[value] for value in first[name].values.values()])
        assert likelihood(values)[0] == pytest.approx(first[name].log_likelihood, rel=1e-12)
    name = "constant-velocity"
    assert first[name].log_likelihood == pytest.approx(whole[name].log_likelihood, abs=1e-3)
