"""Smoothers that compete: what they answer, how they are marked, and where they are refused."""

import dataclasses

import numpy as np
import pytest
from test_estimators import Start

from filtergym import evaluate, record, tidy_records
from filtergym.baselines.maneuvering_target.estimators import (
    KalmanInteractingMultipleModel,
    KalmanTurnInteractingMultipleModel,
)
from filtergym.baselines.maneuvering_target.smoothers import (
    ConstantVelocitySmoother,
    KalmanIMMSmoother,
    KalmanTurnIMMSmoother,
)
from filtergym.baselines.problem import problem_of
from filtergym.baselines.table import Variant
from filtergym.commands.evaluation import find_participants
from filtergym.evaluation.competitors.kinds import kind_of
from filtergym.evaluation.running.curves import curves_of
from filtergym.evaluation.running.summary import Evaluation
from filtergym.filters import kalman
from filtergym.reports.pages.html_report import report_html
from filtergym.reports.pages.outcome import outcome_sentences
from filtergym.reports.tables.benchmark import result_of
from filtergym.reports.tables.ranking import (
    best_of_origins,
    ranking,
    remarks,
)
from filtergym.reports.tables.results import Settings
from filtergym.reports.tables.terminal_tables import rank_competitors, results_tables

TARGET = "filtergym/ManeuveringTarget-v0"


@pytest.mark.parametrize(
    ("smoother", "estimator"),
    [
        (KalmanIMMSmoother, KalmanInteractingMultipleModel),
        (KalmanTurnIMMSmoother, KalmanTurnInteractingMultipleModel),
    ],
)
def test_a_smoother_without_lag_equals_its_filter(smoother, estimator):
    found = evaluate(
        TARGET, {"smoother": Variant(smoother, lag=0), "filter": estimator}, scenario="random", episodes=9
    )
    for name, size in (("error", 1e5), ("nees", 1.0)):
        one, other = (found[name].sel(policy=policy).values for policy in ("smoother", "filter"))
        # The combination of the modes is computed by other code than the compiled filter's.
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * size)


def test_the_whole_track_is_its_least_squares_solution():
    # Scans that missed and intervals that differ: what is reported against one dense linear system over the track.
    found = evaluate(
        TARGET,
        {"smoother": Variant(ConstantVelocitySmoother, acceleration=2.0)},
        scenario="random",
        episodes=6,
        tracks=True,
        horizon=40,
    ).sel(policy="smoother")
    initial = record(TARGET, scenario="random", episodes=6, horizon=40).initial
    missed = 0
    for n in range(6):
        run = found.isel(episode=n)
        intervals, there = run["measurement_interval"].values, run["measurement_available"].values > 0.0
        position, variance = run["measurement_position"].values, run["measurement_variance"].values
        missed += (~there).sum()
        K = len(intervals)
        # Unknown are the start in its standard deviations, and two accelerations of each interval in theirs: the
        # states are linear in them, and the prior is a unit matrix.
        states = np.zeros((K + 1, 4, 4 + 2 * K))
        states[0, :, :4] = np.linalg.cholesky(initial["covariance"][n])
        mean = [initial["mean"][n]]
        rows, targets = [np.eye(4 + 2 * K)], [np.zeros(4 + 2 * K)]
        for k, T in enumerate(intervals):
            F, _ = kalman.white_acceleration(T, 2.0, axes=2)
            states[k + 1] = F @ states[k]
            states[k + 1, :, 4 + 2 * k : 6 + 2 * k] = 2.0 * np.kron([[T**2 / 2], [T]], np.eye(2))
            mean.append(F @ mean[k])
            if there[k]:
                sigma = np.sqrt(variance[k])
                rows.append(states[k + 1, :2] / sigma[:, None])
                targets.append((position[k] - mean[k + 1][:2]) / sigma)
        A, b = np.concatenate(rows), np.concatenate(targets)
        unknown = np.linalg.lstsq(A, b, rcond=None)[0]
        covariance = states @ np.linalg.inv(A.T @ A) @ np.moveaxis(states, 1, 2)
        # Positions of 1e5 m and variances of 1e4 m^2, to rounding of 1e3 scans.
        np.testing.assert_allclose(run["estimate"].values, (mean + states @ unknown)[1:], rtol=0, atol=1e-8)
        np.testing.assert_allclose(run["covariance"].values, covariance[1:], rtol=0, atol=1e-8)
    assert missed > 5


def test_smoothers_are_marked_and_never_ranked():
    names = ["imm", "kalman-imm", "imm-smoother", "known-turn"]
    dataset = evaluate(TARGET, names, scenario="paper", episodes=20, drawn_episodes=1)
    records = tidy_records(dataset)
    cost = {r.policy: r.value for r in records if (r.metric, r.window) == ("cost", "all")}
    assert min(cost, key=cost.get) == "imm-smoother"
    of_smoother = {r.metric for r in records if r.policy == "imm-smoother"}
    assert {"cost", "rmse", "anees", "relative_cost_difference"} < of_smoother
    assert not {"score", "behind_best", "log_likelihood", "anis"} & of_smoother
    assert {r.component or r.policy for r in records if r.metric == "behind_best"} <= {"kalman-imm", "imm"}
    assert [place.policy for place in ranking(records)] == ["kalman-imm", "imm"]
    tables = results_tables(records, problem_of(TARGET).knows, 200)
    assert "Not causal, with later measurements: imm-smoother." in tables[-1].caption
    assert [name for name, *_ in rank_competitors(records)] == [
        "kalman-imm",
        "imm",
        "imm-smoother",
        "known-turn",
    ]
    found = result_of(problem_of(TARGET), Evaluation(dataset, records, curves_of(dataset), {}), [])
    assert [origin for origin, _ in best_of_origins(found)] == ["estimator", "paper", "reference"]
    assert "imm-smoother" not in " ".join([*outcome_sentences([found]), *remarks([found])])
    page = report_html([found], Settings("filtergym benchmark", {}))
    assert "Not causal, with later measurements: <code>imm-smoother</code>." in page


def test_a_closed_loop_refuses_smoothers():
    with pytest.raises(ValueError, match=r"smoother 'mine' cannot run in .* a closed loop"):
        evaluate("filtergym/UavAutopilot-v0", {"mine": PythonSmoother}, episodes=1)


class PythonSmoother:
    """A smoother of one's own, on any arrays: it answers each time with the last filtered estimate."""

    kind = "smoother"

    def start(self, initial, N):
        self.N = N
        return initial.mean, initial.covariance

    def update(self, memory, measurement):
        m, P = memory
        there = measurement.available > 0.0
        m = np.where(there, np.concatenate([measurement.position, m[2:]]), m)
        return m, P, (m, P)

    def smooth(self, measurements, memories):
        assert len(memories) == len(measurements) + 1
        K = len(measurements)
        m, P = memories[-1]
        return np.repeat(m[:, None], K, axis=1), np.repeat(P[:, :, None], K, axis=2)


def test_a_smoother_of_ones_own_is_given_all_that_it_has_kept():
    found = evaluate(TARGET, {"mine": PythonSmoother}, scenario="random", episodes=5, tracks=True, horizon=30)
    run = found.sel(policy="mine")
    estimate = run["estimate"].values
    np.testing.assert_array_equal(estimate, np.repeat(estimate[:, -1:], 30, axis=1))
    seen = run["measurement_available"].values > 0.0
    for n in range(5):
        last = np.flatnonzero(seen[n])[-1]
        np.testing.assert_array_equal(estimate[n, 0, :2], run["measurement_position"].values[n, last])


def test_an_estimator_that_can_smooth_but_does_not_say_so_is_one():
    class Estimator(PythonSmoother):
        kind = "estimator"

    class Silent:
        start, update, smooth = PythonSmoother.start, PythonSmoother.update, PythonSmoother.smooth

    assert kind_of(Estimator) == kind_of(Silent) == "estimator"


def test_errors_of_a_smoother_of_ones_own_name_it():
    class Short(PythonSmoother):
        def smooth(self, measurements, memories):
            means, covariances = super().smooth(measurements, memories)
            return means[:, 1:], covariances

    class Raises(PythonSmoother):
        def smooth(self, measurements, memories):
            raise KeyError("nothing")

    class Without:
        kind = "smoother"
        start, update = PythonSmoother.start, PythonSmoother.update

    arguments = {"episodes": 2, "horizon": 10, "scenario": "random"}
    with pytest.raises(
        ValueError, match=r"smoother 'a': the means must have shape \(4, 10, 8\).*got \(4, 9, 8\)"
    ):
        evaluate(TARGET, {"a": Short}, **arguments)
    with pytest.raises(ValueError, match="smoother 'b' failed after 10 measurements"):
        evaluate(TARGET, {"b": Raises}, **arguments)
    with pytest.raises(ValueError, match="a smoother smooth too"):
        evaluate(TARGET, {"c": Without}, **arguments)


def test_what_is_not_finite_loses_the_episode():
    class Broken(KalmanIMMSmoother):
        def smooth(self, measurements, memories):
            means, covariances = super().smooth(measurements, memories)
            means[0, 3, 1] = np.nan
            return means, covariances

    both = {"broken": Broken, "whole": KalmanIMMSmoother}
    # What is lost at a missed measurement has another number.
    found = evaluate(TARGET, both, episodes=3, horizon=20, detection_probability=(1.0, 1.0))
    lost = found["lost"].sel(policy="broken").values
    assert (lost[1, :3] == 0.0).all()
    assert (lost[1, 3:] == 1.0).all()
    assert (lost[[0, 2]] == 0.0).all()
    errors = found["error"].values
    np.testing.assert_array_equal(errors[0, [0, 2]], errors[1, [0, 2]])


def test_reports_on_a_smoothed_track_are_those_of_single_steps():
    """Compiled steps report on many measurements together, NumPy's on one after the other: also of lost episodes."""

    class Broken(KalmanIMMSmoother):
        def smooth(self, measurements, memories):
            means, covariances = (np.array(part) for part in super().smooth(measurements, memories))
            means[0, 0, 0], means[1, 12, 1], covariances[2, 2, 7, 2] = np.nan, np.inf, -1.0
            return means, covariances

    given = {"episodes": 5, "horizon": 20, "tracks": True, "drawn_episodes": 2}
    both = {"broken": Broken, "whole": ConstantVelocitySmoother}
    found, expected = (evaluate(TARGET, both, backend=name, **given) for name in ("compiled", "numpy"))
    assert (found["lost"].sel(policy="broken").values[:3, -1] > 0.0).all()
    assert set(found) == set(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(found[name].values, values, rtol=1e-9, atol=1e-7, err_msg=name)


def test_episodes_of_a_recording_are_smoothed_each_to_its_end_without_truth():
    name = "imm-turn-smoother"
    made = dataclasses.replace(record(TARGET, scenario="random", episodes=3, horizon=24), truth=None)
    lengths = np.array([24, 7, 4])
    there = np.arange(made.seconds.shape[1]) < lengths[:, None]
    cut = dataclasses.replace(made, lengths=lengths, seconds=np.where(there, made.seconds, np.nan))
    together = evaluate(TARGET, [name], scenario=cut, tracks=True)
    assert not {"error", "cost", "nees", "log_likelihood"} & set(together)
    for n, length in enumerate(lengths):
        part = {field: values[n : n + 1, :length] for field, values in made.measurements.items()}
        alone = dataclasses.replace(
            made,
            measurements=part,
            initial={field: values[n : n + 1] for field, values in made.initial.items()},
            seconds=made.seconds[n : n + 1, :length],
            lengths=lengths[n : n + 1],
            names=("alone",),
            started=made.started[n : n + 1],
        )
        single = evaluate(TARGET, [name], scenario=alone, tracks=True)
        for field in ("estimate", "covariance"):
            found, expected = together[field].values[0, n], single[field].values[0, 0]
            assert np.isfinite(expected).all()
            np.testing.assert_array_equal(found[:length], expected)
            assert np.isnan(found[length:]).all()


def test_recordings_are_shown_to_smoothers_but_not_to_references():
    made = record(TARGET, scenario="random", episodes=2, horizon=8)
    names = [one.name for one in find_participants(problem_of(TARGET), made, None, False)]
    assert "imm-smoother" in names
    assert not {"known-turn", "known-input-bound"} & set(names)


class HoldsToTheEnd(Start):
    """The initial estimate, returned when all is measured."""

    kind = "smoother"

    def smooth(self, measurements, memories):
        means, covariances = zip(*memories[1:], strict=True)
        return np.stack(means, axis=1), np.stack(covariances, axis=2)


def test_another_open_loop_takes_a_smoother():
    env, keywords = "filtergym/LooselyCoupledNavigation-v0", {"horizon": 40, "axes": 2}
    makers = {"smoother": HoldsToTheEnd, "estimator": Start}
    found = evaluate(env, makers, episodes=9, backend="numpy", **keywords)
    for name in ("error", "cost", "nees", "lost"):
        one, other = (found[name].sel(policy=policy).values for policy in ("smoother", "estimator"))
        np.testing.assert_array_equal(one, other)
