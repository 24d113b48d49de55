"""Filters fitted to recordings: likelihood, maximum, intervals, choice, and the sentences about it."""

import dataclasses
import itertools
import json
import math
from functools import partial

import numpy as np
import pytest
from models import Asked

from filtergym import evaluate
from filtergym.baselines import advice as advice_module
from filtergym.baselines import fitting
from filtergym.baselines.advice import FittedLog, advise, split_recording
from filtergym.baselines.fitted_filters import families_of, own_family, read_artefact
from filtergym.baselines.fitting import fit, fit_profiles, with_noise_scale
from filtergym.baselines.judgement import AS_GOOD, Judgement
from filtergym.baselines.maneuvering_target.estimators import ConstantVelocity
from filtergym.baselines.maneuvering_target.log_families import log_families
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.companions import find_companion
from filtergym.envs.contract.log_format import LogFormat
from filtergym.envs.engine.catalogue import task_class
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.envs.logs.reading import read_recording
from filtergym.evaluation.competitors import likelihood as likelihood_module
from filtergym.evaluation.competitors.likelihood import Span, WindowLikelihood, cut_windows
from filtergym.evaluation.statistics.bootstrap import IntervalEstimate
from filtergym.reports.tables.advice import PRICES, advice_lines, parameter_lines, price_table

ID = "filtergym/ManeuveringTarget-v0"
PROBLEM = problem_of(ID)


def write_log(
    folder, count=240, acceleration=0.8, sigma=1.0, T=0.5, seed=0, missed=0.0, stated=None, odometry=False
):
    """Write a log of a target of white acceleration, constant in every interval; return its path."""
    rng = np.random.default_rng(seed)
    position, velocity = np.zeros((count, 2)), np.zeros((count, 2))
    velocity[0] = 3.0, -1.0
    for k in range(1, count):
        a = acceleration * rng.standard_normal(2)
        position[k] = position[k - 1] + T * velocity[k - 1] + 0.5 * T**2 * a
        velocity[k] = velocity[k - 1] + T * a
    plots = position + sigma * rng.standard_normal(position.shape)
    plots[3:][rng.random(count - 3) < missed] = math.nan
    stated = np.full_like(plots, sigma if stated is None else stated)
    columns = [T * np.arange(count), plots, stated, position, velocity]
    names = "time,x,y,sigma_x,sigma_y,truth_position_x,truth_position_y,truth_velocity_x,truth_velocity_y"
    if odometry:
        columns.append(T * velocity)
        names += ",odometry_x,odometry_y"
    path = folder / f"log{seed}.csv"
    np.savetxt(path, np.column_stack(columns), "%.6f", ",", header=names, comments="")
    return path


def read(path):
    return read_recording(path, ID, speeds=(0.001, 1000.0))


def likelihood_of(recording, name, spans=None, warm_up=10, noise=False):
    """Likelihood of a family, and its tunable."""
    task = make_task(task_class(ID), None, **recording.parameters)
    tunable = log_families(recording)[name]
    if noise:
        tunable = with_noise_scale(tunable, find_companion(task, LogFormat).scale_noise)
    spans = spans or [Span(0, 10, int(recording.rows[0]))]
    windows = cut_windows(recording, task, spans, warm_up)
    return WindowLikelihood(task, windows, tunable.start, tunable.apply, tunable.in_lanes), tunable


@pytest.mark.parametrize(
    ("environment", "columns"),
    [("LooselyCoupledNavigation", "ins,fix"), ("RadarEsmTracking", "range,range_rate")],
)
def test_candidates_of_every_family_side_by_side_are_those_that_run_alone(environment, columns, tmp_path):
    g, time = np.random.default_rng(0), np.arange(40.0)
    table = np.column_stack([time, *(500.0 - 5.0 * time + g.normal(0.0, 5.0, (2, 40)))])
    np.savetxt(tmp_path / "log.csv", table, "%.3f", ",", header=f"time,{columns}", comments="")
    problem = problem_of(f"filtergym/{environment}-v0")
    log = FittedLog(problem, read_recording(tmp_path / "log.csv", problem.id))
    for name, family in families_of(problem, log.recording).items():
        low, high = np.array([*family.limits.values()]).T
        values = np.stack([[*family.start.values()], low + 0.3 * (high - low)], axis=1)
        found = log.likelihood([Span(0, 5, 39)], family)
        alone = log.likelihood([Span(0, 5, 39)], dataclasses.replace(family, in_lanes=False))
        np.testing.assert_allclose(found(values), alone(values), rtol=1e-9, err_msg=name)
        if environment == "LooselyCoupledNavigation":
            assert found.in_lanes is (name != "augmented-mehra")  # which has a whole window


def naive_log_likelihood(recording, acceleration, scale, first):
    """One Kalman filter of constant velocity with dense matrices, from the recording's initial estimate."""
    measured = {name: values[0] for name, values in recording.measurements.items()}
    m, P = recording.initial["mean"][0], scale**2 * recording.initial["covariance"][0]
    H, total = np.eye(2, 4), 0.0
    for k in range(int(recording.rows[0])):
        T = measured["interval"][k]
        F = np.eye(4) + T * np.eye(4, k=2)
        g = np.concatenate([0.5 * T**2 * np.eye(2), T * np.eye(2)])
        m, P = F @ m, F @ P @ F.T + acceleration**2 * g @ g.T
        if measured["available"][k] == 0.0:
            continue
        S = H @ P @ H.T + scale**2 * np.diag(measured["variance"][k])
        nu = measured["position"][k] - H @ m
        if k >= first:
            total -= 0.5 * (nu @ np.linalg.solve(S, nu) + math.log(np.linalg.det(2.0 * math.pi * S)))
        K = P @ H.T @ np.linalg.inv(S)
        m, P = m + K @ nu, (np.eye(4) - K @ H) @ P
    return total


def test_likelihood_is_that_of_a_kalman_filter(tmp_path):
    """Of all candidates at once, by dense matrices one after the other; rounding of 240 updates."""
    recording = read(write_log(tmp_path, missed=0.2))
    found, _ = likelihood_of(recording, "constant-velocity", noise=True)
    candidates = np.array([[-1.0, 0.0, 0.4, 1.0], [0.0, -0.3, 0.2, 0.0]])
    expected = [naive_log_likelihood(recording, 10.0**a, 10.0**s, 10) for a, s in candidates.T]
    np.testing.assert_allclose(found(candidates), expected, rtol=1e-11)
    seen = recording.measurements["available"][0, 10 : int(recording.rows[0])] > 0.0
    assert found.count == seen.sum()


@pytest.mark.parametrize("name", list(log_families()))
def test_candidates_side_by_side_are_those_alone(tmp_path, name, monkeypatch):
    """In lanes, compiled, one by one, and with NumPy; 60 updates of an iterated filter round by 1e-9 at most."""
    recording = read(write_log(tmp_path, count=70, missed=0.1, odometry=True))
    found, tunable = likelihood_of(recording, name)
    low, high = np.array(list(tunable.limits.values())).T
    share = np.random.default_rng(1).uniform(0.2, 0.8, (len(low), 5))
    candidates = low[:, None] + (high - low)[:, None] * share
    together = found(candidates)
    assert np.isfinite(together).all()
    np.testing.assert_allclose([found(candidates[:, [i]])[0] for i in range(5)], together, rtol=1e-9)
    monkeypatch.setattr(likelihood_module, "AVAILABLE", False)
    with_numpy, _ = likelihood_of(recording, name)
    np.testing.assert_allclose(with_numpy(candidates), together, rtol=1e-9)
    with_numpy.in_lanes = False
    np.testing.assert_allclose(with_numpy(candidates), together, rtol=1e-9)


def test_windows_count_every_measurement_once_and_forget_their_start(tmp_path):
    """Apart from the start of their tracks, which a long warm-up forgets."""
    recording = read(write_log(tmp_path, count=400, missed=0.1))
    rows = int(recording.rows[0])
    whole, _ = likelihood_of(recording, "constant-velocity", [Span(0, 60, rows)], 60)
    cuts = [60, 130, 131, 250, rows]
    spans = [Span(0, a, b) for a, b in itertools.pairwise(cuts)]
    values = np.array([[0.0]])
    for warm_up, within in ((60, 1e-6), (3, 5.0)):
        pieces, _ = likelihood_of(recording, "constant-velocity", spans, warm_up)
        assert pieces.count == whole.count
        assert abs(pieces(values)[0] - whole(values)[0]) < within


def test_gradient_is_the_slope(tmp_path):
    recording = read(write_log(tmp_path))
    found, _ = likelihood_of(recording, "imm-two", noise=True)
    at = np.array([-0.5, 0.9, -1.5, -1.0, 0.1])
    value, gradient = found.gradient(at)
    assert value == pytest.approx(found(at[:, None])[0], rel=1e-12)
    for i, slope in enumerate(gradient):
        move = 1e-2 * np.eye(5)[i]
        # Of fourth order, whose error is 1e-8 of the fifth derivative.
        points = np.stack([at - 2 * move, at - move, at + move, at + 2 * move], axis=1)
        a, b, c, d = found(points)
        assert slope == pytest.approx((a - 8 * b + 8 * c - d) / 0.12, rel=1e-3, abs=1e-3)


def test_fit_finds_what_made_the_log_and_its_intervals_are_those_of_the_profile(tmp_path):
    """Against the profile computed anew, value by value, by another search."""
    from scipy.optimize import brentq, minimize_scalar

    recording = read(write_log(tmp_path, count=200, stated=0.5))
    spans = [Span(0, first, first + 30) for first in range(10, 190, 30)]
    found, tunable = likelihood_of(recording, "constant-velocity", spans, noise=True)
    best = fit(found, tunable)
    assert best.spread < 1e-3
    assert best.at_limit == ()
    best, profiles = fit_profiles(found, tunable, best)
    intervals = {name: each.interval for name, each in profiles.items()}
    for name, true in {"log10_acceleration": math.log10(0.8), "log10_noise_scale": math.log10(2.0)}.items():
        assert intervals[name].low < true < intervals[name].high  # of this seed; coverage is a command
    for i, name in enumerate(tunable.limits):

        def drop(value, i=i):
            def other(x):
                point = np.array([x, x])
                point[i] = value
                return -found(point[:, None])[0]

            return -minimize_scalar(other, bracket=(-0.5, 0.5)).fun - best.log_likelihood + fitting.DROP

        value = best.values[name]
        for end, far in ((intervals[name].low, -1.0), (intervals[name].high, 1.0)):
            exact = brentq(drop, value, value + far, xtol=1e-3)
            # Interpolated between distances of half a deviation, of which an end is two.
            assert end == pytest.approx(exact, abs=0.05 * abs(exact - value))


def test_what_the_log_does_not_determine_is_open(tmp_path):
    """A target that never turns leaves turns unidentified; a straight flight bounds only the acceleration."""
    recording = read(write_log(tmp_path, acceleration=0.0, count=160))
    found, tunable = likelihood_of(recording, "constant-velocity", noise=True)
    best = fit(found, tunable)
    best, profiles = fit_profiles(found, tunable, best)
    intervals = {name: each.interval for name, each in profiles.items()}
    assert intervals["log10_acceleration"].open_low
    assert not intervals["log10_acceleration"].open_high
    assert not intervals["log10_noise_scale"].open_low
    assert not intervals["log10_noise_scale"].open_high
    found, tunable = likelihood_of(read(write_log(tmp_path, count=100, seed=1)), "imm-turn")
    _, profiles = fit_profiles(found, tunable, fit(found, tunable))
    intervals = {name: each.interval for name, each in profiles.items()}
    assert any(interval.open_low and interval.open_high for interval in intervals.values())


def test_shares_are_apart_and_are_all(tmp_path):
    recording = read(write_log(tmp_path, count=962))
    share = split_recording(recording)
    assert len(share.judged) == 6  # one in four of the blocks of forty measurements
    taken = np.zeros(int(recording.rows[0]), dtype=int)
    for spans in (share.fitted, share.chosen, share.judged):
        for span in spans:
            taken[span.first : span.last] += 1
    assert (taken[share.warm_up :] == 1).all()
    judged = sum(span.last - span.first for span in share.judged)
    assert judged == pytest.approx(len(taken) / 4, abs=2)


@pytest.fixture(scope="module")
def advice(tmp_path_factory):
    """Of a log whose stated deviations are half of the true ones, so that what is shipped is wrong."""
    folder = tmp_path_factory.mktemp("logs")
    recording = read(write_log(folder, count=600, acceleration=2.0, sigma=2.0, stated=1.0, seed=3))
    shipped = {name: PROBLEM.competitor(name) for name in ("imm", "kalman-imm", "fixed-low")}
    return advise(FittedLog(PROBLEM, recording), shipped)


def test_the_filter_of_the_log_is_advised_and_is_better(advice):
    assert advice.advised.fitted
    assert advice.advised.name == "constant-velocity"
    assert advice.advised.relative_error.value < 0.0
    assert advice.advised.difference.low > 0.0
    assert abs(advice.advised.nis - 1.0) < 0.2
    assert abs(advice.advised.correlation.value) < 4.0 / math.sqrt(150.0)  # of as many judged measurements
    values, intervals = advice.fits["constant-velocity"].values, advice.intervals
    assert 10.0 ** values["log10_noise_scale"] == pytest.approx(2.0, rel=0.1)
    assert intervals["log10_acceleration"].low < math.log10(2.0) < intervals["log10_acceleration"].high


def test_errors_and_likelihoods_are_those_of_an_evaluation(advice):
    """Judged measurements alone, of the filter with the values that are handed on."""
    name = "kalman-imm"
    run = evaluate(ID, [name], advice.recording).sel(policy=name)
    mask = np.zeros(run.sizes["time"], dtype=bool)
    for span in advice.share.judged:
        mask[span.first : span.last] = True
    errors = run["error"].sel(component=["position_x", "position_y"]).values[0, mask]
    row = next(c for c in advice.competitors if c.name == name)
    assert row.error == pytest.approx(math.sqrt((errors**2).sum(axis=1).mean()), rel=1e-12)


def test_it_ends_in_sentences(advice):
    lines = list(advice_lines(advice, ["fixed-low"]))
    text = "\n".join(lines)
    assert lines[0].startswith("Take constant-velocity, with the parameters below: ")
    assert f"than {advice.rival}, the shipped filter chosen on the same" in lines[0]
    assert "times as large as stated, if they are white" in text
    assert "The learned agents were never trained on such data: fixed-low" in text


@pytest.mark.slow
def test_the_command_writes_a_filter_that_evaluates(tmp_path, command, success, monkeypatch):
    log = write_log(tmp_path, count=300, acceleration=2.0, sigma=2.0, stated=0.7, seed=4)
    path = tmp_path / "mine.filter.json"
    out = success("advise", log, "--out", path)
    assert "Take " in out
    table = json.loads(path.read_text())
    assert table["environment"] == ID
    found = evaluate(ID, [str(path)], read(log))
    assert float(np.nanmean(found["nis"].values / found["nis_degrees"].values)) == pytest.approx(
        1.0, abs=0.25
    )
    out = success("evaluate", ID, "--recording", log, "--policy", path, "--policy", "imm")
    assert "imm" in out
    assert command("advise", log, "--out", tmp_path / "mine.json")[0] == 2


def test_files_that_are_no_fitted_filter_are_refused(tmp_path):
    table = {"environment": ID, "filter": "constant-velocity", "values": {"log10_acceleration": 0.0}}
    path = tmp_path / "some.filter.json"
    path.write_text(json.dumps(table))
    read_artefact(path, PROBLEM)
    for change, message in (
        ({"environment": "a\nb"}, r"is fitted to 'a\\nb', not to"),
        ({"filter": "missing"}, "has no filter 'missing' that can be fitted"),
        (
            {"values": {"log10_jerk": 1.0}},
            "must give 'constant-velocity' a number for each of log10_acceleration",
        ),
        ({"values": [1.0]}, "is not the file of an advised filter"),
    ):
        path.write_text(json.dumps(table | change))
        with pytest.raises(ValueError, match=message):
            read_artefact(path, PROBLEM)
    # A policy steers a control, which no log has.
    uav = problem_of("filtergym/UavAutopilot-v0")
    path.write_text(json.dumps(table | {"environment": uav.id, "filter": "innovation-adaptive"}))
    with pytest.raises(ValueError, match="has no filter 'innovation-adaptive' that can be fitted"):
        read_artefact(path, uav)


@pytest.fixture
def one_family(monkeypatch):
    """Of all families only one, which is quick to fit."""

    def families(problem, recording):
        return {"constant-velocity": log_families(recording)["constant-velocity"]}

    monkeypatch.setattr(advice_module, "families_of", families)


def test_a_short_log_is_called_short(one_family, tmp_path):
    with pytest.raises(
        ValueError, match=r"has 3 measurements after the start of its track: .* needs at least 5"
    ):
        advise(FittedLog(PROBLEM, read(write_log(tmp_path, count=5))), {})
    recording = read(write_log(tmp_path, count=12))
    found = advise(FittedLog(PROBLEM, recording), {"imm": PROBLEM.competitor("imm")})
    text = "\n".join(advice_lines(found, []))
    assert "measurements are few" in text
    assert "where its error is underestimated" in text


def test_what_is_fitted_is_taken_only_for_a_gain_beyond_chance(one_family, tmp_path):
    """The rival is the paper's algorithm, or likelier beyond chance; so is what is advised to the rival."""
    recording = read(write_log(tmp_path, count=240, acceleration=0.8, sigma=1.0, seed=5))
    shipped = {"imm": PROBLEM.competitor("imm"), "same": PROBLEM.competitor("imm")}
    found = advise(FittedLog(PROBLEM, recording), shipped)
    assert found.rival == "imm"
    assert found.fitted.gain.low > 0.0
    assert found.advised is found.fitted
    # What made the log is shipped, too: nothing that is fitted to it can be better beyond chance.
    true = partial(ConstantVelocity, acceleration=0.8)
    true.kind = "estimator"
    found = advise(FittedLog(PROBLEM, recording), {**shipped, "true": true})
    assert found.rival == found.advised.name == "true"
    lines = list(advice_lines(found, []))
    assert lines[0].startswith("Take true, as it is shipped: no fitted filter predicts better beyond chance")
    assert any(line.startswith(f"Of the fitted filters {found.fitted.name} comes closest") for line in lines)
    for high, sure in ((-0.1, True), (0.1, False)):
        fitted = found.fitted._replace(relative_error=IntervalEstimate(-0.2, -0.3, high))
        first = next(iter(advice_lines(found._replace(fitted=fitted), [])))
        assert ("That is beyond chance: a longer log may turn the choice." in first) == sure


class Sluggish(ConstantVelocity):
    """Constant velocity with less acceleration than there is."""

    parameters = {"acceleration": (0.15, 0.2, 0.25)}  # noqa: RUF012
    lane_parameters = True


def test_a_cheaper_family_that_predicts_worse_beyond_chance_is_not_chosen(monkeypatch, tmp_path):
    def families(problem, recording):
        name = "constant-velocity"
        return {"sluggish": own_family("sluggish", Sluggish), name: log_families(recording)[name]}

    monkeypatch.setattr(advice_module, "families_of", families)
    log = FittedLog(PROBLEM, read(write_log(tmp_path, count=240)))
    found = advise(log, {"imm": PROBLEM.competitor("imm")})
    assert found.diverging == ()
    assert found.fitted.name == "constant-velocity"


def test_of_two_that_are_as_good_the_cheaper_is_advised(one_family, tmp_path):
    """Where both are as good, the operations of an update decide, and the gain of the likelier one is printed."""
    recording = read(write_log(tmp_path, count=240, acceleration=0.8, sigma=1.0, seed=5))
    true = partial(ConstantVelocity, acceleration=0.8)
    true.kind = "estimator"
    operations = {"true": 500, "constant-velocity": 400}
    asked = []

    def price_of(name, maker):
        asked.append(name)
        return dict.fromkeys(PRICES.values(), operations[name]) if name in operations else None

    shipped = {"imm": PROBLEM.competitor("imm"), "true": true}
    found = advise(FittedLog(PROBLEM, recording), shipped, price_of=price_of)
    assert found.rival == "true"
    assert -AS_GOOD < found.fitted.gain.low < 0.0
    assert found.advised.name == "constant-velocity"
    assert "imm" not in asked  # it is no candidate: nothing is traced for it
    lines = list(advice_lines(found, []))
    assert lines[0].startswith(
        "Take constant-velocity, with the parameters below, as good as true and cheaper: "
    )
    likelier = found._replace(likeliest=("true", IntervalEstimate(0.25, -0.125, 0.5)))
    assert (
        "true is likelier where filters were chosen: it would bring +0.250 [-0.125, +0.500] nats per measurement and "
        "takes 500 operations an update for 400." in list(advice_lines(likelier, []))
    )
    table = price_table(found, [])
    shown = {"constant-velocity": "400", "true": "500"}
    assert list(table.columns[1].cells) == [shown.get(each, "-") for each in table.columns[0].cells]


def test_the_best_in_hindsight_is_named_beside(advice):
    """It has the least judged error of the shipped ones; a rival may be another, and then both are named."""
    shipped = {c.name: c.error for c in advice.competitors if not c.fitted}
    assert advice.best_shipped == min(shipped, key=shipped.get)
    errors = advice.advised.error, shipped[advice.best_shipped]
    assert advice.hindsight.value == pytest.approx(errors[0] / errors[1] - 1.0, rel=1e-9)
    other = advice._replace(rival="fixed-low")
    sentence = f"In hindsight {advice.best_shipped} is the best of the 3 shipped ones"
    assert any(line.startswith(sentence) for line in advice_lines(other, []))


def test_a_misleading_likelihood_is_reported(advice):
    """As where errors last longer than a measurement: what predicts best errs more."""
    worse = advice.fitted._replace(relative_error=IntervalEstimate(0.07, 0.02, 0.12))
    kept = next(c for c in advice.competitors if c.name == advice.rival)
    line = next(advice_lines(advice._replace(fitted=worse, competitors=[kept, worse]), []))
    assert line.startswith(
        f"Take {advice.rival}, as it is shipped: {worse.name}, fitted, predicts more likely and has "
    )
    assert "7.0 % more error [2.0, 12.0] than it" in line
    assert line.endswith("The likelihood misleads here.")


def test_where_the_likelihood_misleads_the_rival_is_advised(one_family, tmp_path, monkeypatch):
    """Beyond chance; a difference that may be chance changes nothing."""
    recording = read(write_log(tmp_path, count=240, acceleration=0.8, sigma=1.0, seed=5))
    for low, kept in ((0.02, True), (-0.02, False)):
        errors = IntervalEstimate(0.07, low, 0.12)
        monkeypatch.setattr(Judgement, "relative_error", lambda self, name, other, errors=errors: errors)
        found = advise(FittedLog(PROBLEM, recording), {"imm": PROBLEM.competitor("imm")})
        assert found.fitted.gain.low > 0.0
        assert (found.advised.name == "imm") == kept


def test_a_filter_that_loses_the_track_is_left_out_and_named(one_family, tmp_path):
    """A fit to windows that begin anew never sees that its filter diverges later."""

    class Forgetful:
        """Loses the track at the hundredth update."""

        kind, parameters, lane_parameters = "estimator", {"acceleration": (0.5, 0.8, 1.0)}, True

        def __init__(self, task, acceleration=0.8):
            self.own = Asked(ConstantVelocity(task, acceleration))

        def start(self, initial, N):
            return self.own.start(initial, N), np.zeros(N)

        def update(self, memory, measurement):
            state, age = memory
            state = state._replace(mean=state.mean + 1e3 * (age == 100.0))
            mean, covariance, state, likelihood = self.own.update(state, measurement)
            return mean, covariance, (state, age + 1.0), likelihood

    recording = read(write_log(tmp_path, count=240))
    own = {"forgetful": own_family("forgetful", Forgetful)}
    found = advise(FittedLog(PROBLEM, recording), {"imm": PROBLEM.competitor("imm")}, own)
    assert found.diverging == ("forgetful",)
    assert "forgetful" not in {c.name for c in found.competitors}
    sentence = "Left out: forgetful, fitted, loses the track in the whole recording: it diverges."
    assert sentence in list(advice_lines(found, []))


def test_starts_that_disagree_and_parameters_at_a_limit_are_reported(advice):
    name = advice.fitted.name
    assert not any("several maxima" in line for line in advice_lines(advice, []))
    two_hills = advice.fits[name]._replace(spread=12.34)
    lines = list(advice_lines(advice._replace(fits={**advice.fits, name: two_hills}), []))
    sentence = f"The likelihood of {name} has several maxima: the worst of its 3 starts ended 12.3 nats below"
    assert sentence in "\n".join(lines)
    tunable, at_limit = advice.tunables[name], ("log10_acceleration",)
    low, high = tunable.limits["log10_acceleration"]
    for value, ends, side, bound in (
        (low, (low, low + 0.5), "lower", f"at most {10.0 ** (low + 0.5):.3g} m/s^2"),
        (high, (high - 0.5, high), "upper", f"at least {10.0 ** (high - 0.5):.3g} m/s^2"),
    ):
        values = {**advice.fits[name].values, "log10_acceleration": value}
        interval = fitting.Interval(*ends, value == low, value == high)
        found = two_hills._replace(values=values, at_limit=at_limit)
        line = next(parameter_lines(tunable, found, {"log10_acceleration": interval}))
        assert f"at the {side} limit of the search, the log supports {bound}" in line
