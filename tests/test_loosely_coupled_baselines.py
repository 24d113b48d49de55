"""Policies, reference, bound and metrics of loosely coupled navigation, through the evaluation."""

import math

import numpy as np
import pytest
from models import make_model

import filtergym  # noqa: F401  # registers the environments
from filtergym import evaluate, tidy_records
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.loosely_coupled_navigation.estimators import AugmentedEstimator
from filtergym.baselines.loosely_coupled_navigation.metrics import (
    FALSE_ALARM,
    WINDOW,
    alarms,
    detection,
    recovery_times,
)
from filtergym.evaluation.running.rollout import rollout
from filtergym.filters import loosely_coupled
from filtergym.filters.linear_systems import van_loan
from filtergym.names import competitor
from filtergym.papers import kalman_bucy_ins_gnss as paper
from filtergym.papers.kalman_bucy_ins_gnss import experiment, kalman_bucy

ID = "filtergym/LooselyCoupledNavigation-v0"
KNOWN = baselines_of(ID)
MODEL = (*loosely_coupled.error_model(0.6, 0.4, 1.0, 0.04)[:2], [[1.0, 0, 0]], [[0.02]])
START = np.diag([0.0, 0.36, 0.16])
PRINTED = {
    "ins-only": 2.508,
    "gnss-only": 1.414,
    "time-varying-white": 0.5019,
    "time-varying": 0.2702,
    "augmented": 0.2253,
    "matched": 0.2253,
}
"""Root mean square errors from 2.5 to 5 s, m, of the reference table (its plain rows have the Riccati gain)."""


@pytest.fixture(scope="module")
def on_paper():
    names = [*KNOWN.policies, *KNOWN.references, *KNOWN.bounds]
    return evaluate(ID, names, "paper", episodes=800, seed=1)


@pytest.fixture(scope="module")
def some_on_paper():
    """Those that the tests of code use; all of them take two gigabytes."""
    return evaluate(ID, ["plain-white", "augmented", "matched", "matched-covariance"], "paper", 8, seed=1)


def steered(name, scenario, seeds, **keywords):
    """States after every action of a policy or reference, one list."""
    maker = competitor(ID, name)
    keywords = {**getattr(maker, "task_keywords", {}), **keywords}
    model = make_model(ID, getattr(maker, "control", None), scenario, **keywords)
    return model, [state for state, _ in rollout(model, maker, seeds)]


# --- errors


@pytest.mark.claims
def test_reference_table(on_paper):
    theory = experiment.exact_root_mean_squares()
    without = {name for name in KNOWN.policies if name.startswith("augmented-gain")}
    assert set(theory) == set(KNOWN.policies) - without - {"innovation-adaptive", "random"} | {"matched"}
    for name, expected in theory.items():
        if name in PRINTED:
            # Half a unit of the last digit that the table prints, and a little.
            assert expected == pytest.approx(PRINTED[name], abs=6e-4 if expected > 1 else 6e-5)
        squares = (on_paper["error"].sel(policy=name).values[:, 249:, 0] ** 2).mean(axis=1)
        assert abs(squares.mean() - expected**2) < 4 * squares.std() / math.sqrt(len(squares)), name


# --- against naive filters


def test_matched_equals_a_naive_filter_that_knows_the_errors():
    keywords = {
        "axes": 2, "outage_probability": 1.0, "outage_start": (0.3, 0.5), "outage_duration": (0.2, 0.4),
        "spoofing_probability": 1.0, "spoofing_start": (1.0, 1.0), "spoofing_duration": (0.3, 0.3),
        "change_start": (0.1, 1.8), "horizon": 200, "receiver_coloured": (0.3, 0.9),
        "receiver_correlation_time": (0.2, 3.0), "undisturbed": 0.0, "outlier_probability": 0.1,
        "jamming_probability": 1.0, "jamming_start": (1.5, 1.5), "jamming_duration": (0.2, 0.4),
    }  # fmt: skip
    seeds = [5, 6, 7]
    model, states = steered("matched", "random", seeds, **keywords)
    s = model.task.parameters.sampling
    for lane in range(len(seeds)):
        first = states[0].truth
        sigma = first.coloured_step[lane] / s.coloured
        white = (first.white_step[lane] ** 2 - s.residual * sigma**2) / 0.01
        A, W, start = loosely_coupled.error_model(first.drift_deviation[lane], sigma, 1.0, white)
        errors = first.disturbances
        (decay, kick), rate = (
            [each[lane] for each in errors["coloured"].process],
            errors["spoofing"].strength[lane],
        )
        Phi, Qd, P = np.diag([0.0, 0.0, 0.0, decay]), np.diag([0.0, 0.0, 0.0, kick**2]), np.zeros((4, 4))
        Phi[:3, :3], Qd[:3, :3] = van_loan(A, W, 0.01)
        P[:3, :3], P[3, 3] = start, kick**2 / (1.0 - decay**2)
        H, error = np.array([1.0, 0.0, 0.0, -1.0]), np.zeros((4, 2))
        for k, state in enumerate(states, 1):
            error, P = Phi @ error, Phi @ P @ Phi.T + Qd
            measured = state.measurement
            if measured.available[lane] > 0:
                K = P @ H / (H @ P @ H + state.truth.deviation[lane] ** 2)
                fix = measured.fix[:, lane] - (0.01 * rate * (k - 99) if 100 <= k < 130 else 0.0)
                error = error + np.outer(K, measured.ins[:, lane] - fix - H @ error)
                P = P - np.outer(K, H @ P)
            # Equal formulas, different rounding over 200 steps.
            np.testing.assert_allclose(
                state.filter.mean[:, lane], measured.ins[:, lane] - error[0], atol=1e-10
            )
            np.testing.assert_allclose(
                state.filter.covariance[:, :, lane], P[0, 0] * np.eye(2), rtol=1e-8, atol=1e-14
            )


def test_matched_is_the_augmented_filter_on_paper(some_on_paper):
    error = some_on_paper["error"]
    np.testing.assert_allclose(error.sel(policy="matched"), error.sel(policy="augmented"), atol=1e-10)
    exact = kalman_bucy.sampled_covariance(*MODEL, START, 0.01, 5.0).updated[:, 0, 0]
    bound = some_on_paper["mean_square"].sel(policy="matched-covariance").values[0, :, 0]
    np.testing.assert_allclose(bound, exact, rtol=1e-9)


@pytest.mark.parametrize(("name", "mode"), [("time-varying-white", 0), ("time-varying", 1)])
def test_the_riccati_gain_as_policy_is_the_plain_filter_of_the_bank(name, mode):
    class Believe:
        control = "mode"

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.full(len(observation), mode), state

    dataset = evaluate(
        ID, {"policy": name, "filter": Believe()}, "random", episodes=10, axes=3, outage_probability=1.0
    )
    # The policy sees logarithms and answers with one; a gain keeps 15 digits on the way.
    np.testing.assert_allclose(
        dataset["error"].sel(policy="policy"), dataset["error"].sel(policy="filter"), atol=1e-11
    )


def test_innovation_adaptive_equals_a_naive_filter():
    seeds = [1, 2]
    _, states = steered("innovation-adaptive", "jamming", seeds, outage_probability=1.0, outage_start=(0.5, 0.5),
                        outage_duration=(0.3, 0.3), jamming_start=(2.0, 2.0), jamming_duration=(1.0, 1.0),
                        horizon=300, manoeuvres=0)  # fmt: skip
    rate = 1 - math.exp(-0.01 / 0.25)
    for lane in range(len(seeds)):
        x, v, squares = 0.0, 0.0, None
        for state in states:
            x, v = x + state.measurement.increment[0, lane], v + 0.0036
            squares = v + 2.0 if squares is None else squares
            if state.measurement.available[lane]:
                nu = state.measurement.fix[0, lane] - x
                squares += rate * (nu**2 - squares)
                gain = v / (v + max(squares - v, 0.1 * squares))
                x, v = x + gain * nu, v * (1 - gain)
            np.testing.assert_allclose(state.filter.position[0, lane], x, atol=1e-10)
    # Jammed measurements lose their weight without being announced.
    gains = np.stack([state.filter.gain[0, :2] for state in states])
    assert (gains[250:299] < 0.2 * gains[150:199].mean()).mean() > 0.8


def test_a_gain_can_follow_the_augmented_filter():
    dataset = evaluate(ID, ["augmented-gain", "augmented"], "paper", episodes=20, axes=3)
    apart = (dataset["error"].sel(policy="augmented-gain") - dataset["error"].sel(policy="augmented")).values
    # Where the sign of the innovation never allows it the estimates differ for a few samples.
    assert np.median(np.abs(apart)) < 1e-3


# --- metrics


def test_recovery_times_of_made_up_runs():
    available = np.ones((6, 40))
    available[:5, 10:15] = 0.0
    error = np.full((6, 40), 0.1)
    error[1, 12:20] = 1.0  # small again five samples after the outage
    error[2, 12:] = 1.0  # never
    error[3, 12:18], error[3, 19:22] = 1.0, 1.0  # one small sample does not count
    available[4], error[4] = 1.0, 1.0
    available[4, 30:35] = 0.0  # too late to be judged
    found = recovery_times(error, available, 0.5, hold=3, longest=20)
    np.testing.assert_array_equal(found, [0, 5, 20, 7, np.nan, np.nan])


def test_recovery_is_reported_for_outages_only(some_on_paper):
    assert not {r.metric for r in tidy_records(some_on_paper)} & {
        "recovery_time",
        "not_recovered",
    }
    records = tidy_records(evaluate(ID, ["matched", "matched-covariance"], "outage", episodes=8))
    found = {(r.policy, r.metric): r.value for r in records if r.window == "all"}
    assert 0.0 < found["matched", "recovery_time"] <= 1.0
    assert ("matched-covariance", "recovery_time") not in found
    nis = {(r.policy, r.window): r.value for r in records if r.metric == "anis"}
    assert nis["matched", "during"] is None
    assert nis["matched", "after"] is not None


def test_alarms_follow_the_last_fixes_and_are_as_rare_as_stated():
    nis = np.full((2, 4 * WINDOW), 1.0)
    nis[0, 40:43] = 30.0
    nis[1, :60] = math.nan
    found = alarms(nis, 1)
    assert not found[0, :40].any()
    assert found[0, 42 : 40 + WINDOW].all()
    assert not found[0, 43 + WINDOW :].any()
    assert not found[1].any()
    for degrees in (1, 3):
        drawn = np.random.default_rng(0).chisquare(degrees, (4000, 4 * WINDOW))
        # Of windows apart from each other, so that the counts are binomial.
        share = alarms(drawn, degrees)[:, WINDOW - 1 :: WINDOW].mean()
        assert abs(share - FALSE_ALARM) < 4 * math.sqrt(FALSE_ALARM / 16000)


def test_detection_of_made_up_faults():
    alarm, fault, others = np.zeros((3, 4, 30), bool)
    fault[:3, 10:20] = True
    alarm[0, [3, 14, 15]] = True  # one false alarm, then four measurements late
    alarm[1, 25] = True  # too late
    others[2, 5] = True
    alarm[2, [4, 6, 10]] = True
    found = detection(alarm, fault, others)
    np.testing.assert_array_equal(found["delay"][:, 0], [4, np.nan, 0, np.nan])
    np.testing.assert_array_equal(found["missed"][:, 0], [0, 1, 0, np.nan])
    np.testing.assert_array_equal(np.nansum(found["false"], axis=1), [1, 0, 1, 0])
    np.testing.assert_array_equal((~np.isnan(found["false"])).sum(axis=1), [10, 10, 5, 30])


def test_alarms_under_jamming_are_not_false():
    """Of a jamming that raises alarms before any of its errors is so large that it counts as an outlier."""
    records = tidy_records(evaluate(ID, ["augmented"], "jamming", episodes=8, jamming_factor=(3.0, 3.0)))
    assert next(r.value for r in records if r.metric == "false_alarms") == 0.0


def test_records_name_the_position():
    records = tidy_records(evaluate(ID, ["plain-reduced"], "paper", episodes=16, axes=2))
    rmse = {r.component for r in records if r.metric == "rmse"}
    assert rmse == {"position", "position_x", "position_y"}
    assert next(r.value for r in records if r.metric == "anis") == pytest.approx(1.0, abs=0.05)
    assert {r.window for r in records if r.metric == "mean_error"} == {"all", "late"}


# --- engine


# --- reproduction


@pytest.mark.slow
def test_reproduction_runs_and_judges():
    done = []
    result = paper.reproduce(lambda n=1: done.append(n), 60)
    assert sum(done) == paper.STEPS
    verdicts = {claim.key: claim.verdict for claim in result.claims}
    assert [verdicts[key] for key in "134"] == ["reproduced", "reproduced in part", "reproduced"]
    assert all(verdicts[key] == "paper is silent" for key in "5678")
    assert set(result.figures) == {"figure_2", "figure_4", "figure_5", "drift"}
    assert all(caption for _, caption in result.figures.values())


def test_example_a_against_its_theory():
    example = experiment.first_order(3000)
    for name, expected in example.theory.items():
        values = example.squares[name]
        assert abs(values.mean() - expected) < 4 * values.std() / math.sqrt(len(values)), name
    agreement = experiment.riccati_agreement()
    assert agreement.hamiltonian < 1e-12
    assert agreement.ode < 1e-8
    assert agreement.matrix < 1e-9
    assert agreement.order == pytest.approx(1.0, abs=0.05)
    assert "no stabilising solution" in agreement.refusal


# --- estimated receiver noise

RULES = ("mehra", "sage-husa", "variational-bayes")


def test_the_estimator_with_noise_as_reported_is_the_augmented_filter_of_the_bank():
    dataset = evaluate(ID, {"augmented": "augmented", "own": AugmentedEstimator}, "random", 8, axes=2)
    for name in ("error", "nees"):
        own, bank = (dataset[name].sel(policy=p).values for p in ("own", "augmented"))
        # Sums of increments in another order: the last digits of 5 s.
        np.testing.assert_allclose(own, bank, rtol=1e-9, atol=1e-12)


def test_a_policy_with_estimated_noise_reports_what_its_filter_does_where_the_gain_can():
    """After the first samples, in which the receiver's noise is large against what is to be corrected."""
    names = [f"augmented{way}-{rule}" for rule in ("mehra", "sage-husa") for way in ("", "-gain")]
    error = evaluate(ID, names, "jamming", 4)["error"]
    for estimator, policy in zip(names[::2], names[1::2], strict=True):
        apart = (error.sel(policy=estimator) - error.sel(policy=policy)).values
        assert np.median(np.abs(apart)) < 1e-9


def test_a_new_report_is_believed():
    """A receiver that reports a smaller deviation is used so at once."""
    model = make_model(ID, "gain", "paper")
    for rule in RULES:
        found = competitor(ID, f"augmented-{rule}")(model.task).filter
        none = np.zeros((1, 8))
        memory = found.start(none)
        for variance in (2.0, 0.2):
            for _ in range(60):
                correction, memory = found.update(
                    found.predict(memory)[1], none, none[0] + variance, none[0] + 1
                )
            _, memory = found.predict(memory)
            P = memory.covariance.position
            correction, _ = found.update(memory, none + 0.1, none[0] + 0.5 * variance, none[0] + 1)
            gain = correction[0] / 0.1
            expected = P / (P + 0.5 * variance)
            assert np.all(np.abs(gain / expected - 1.0) < 0.2), rule
