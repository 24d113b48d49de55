"""Policies, ideal filter, bound, metrics and reproduction of RadarEsmTracking."""

import math

import numpy
import pytest
from models import make_model

import filtergym  # noqa: F401  # registers the environments
from filtergym import evaluate, tidy_records
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.radar_esm_tracking import policies as baselines
from filtergym.baselines.radar_esm_tracking.metrics import time_quantile
from filtergym.baselines.radar_esm_tracking.references import Ideal
from filtergym.evaluation.running.rollout import start_lanes
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.papers import radar_esm_class_fusion as reproduction
from filtergym.papers.quantities import Quantity
from filtergym.papers.radar_esm_class_fusion import claims, experiment

ID = "filtergym/RadarEsmTracking-v0"
WINDOWS = {"early": (1, 20), "middle": (20, 60), "late": (60, 120)}


# --- the paper's experiment at 20000 episodes


def root(mean_squares):
    """Root of the mean, and its standard error."""
    value = math.sqrt(mean_squares.mean())
    return value, mean_squares.std() / math.sqrt(len(mean_squares)) / (2.0 * value)


# --- exact errors


def test_non_adaptive_and_ideal_have_their_exact_errors():
    target = 1
    dataset = evaluate(
        ID, ["non-adaptive", "ideal", "known-class-bound"], "paper", 1500, true_class=f"S{target}"
    )
    p = make_model(ID, scenario="paper").task.parameters
    for name, channel in (("non-adaptive", 2), ("ideal", target)):
        exact = experiment.exact_mean_squares(p, target, channel)
        squares = dataset["error"].sel(policy=name).values ** 2
        for i in range(3):
            for first, last in WINDOWS.values():
                value, error = root(squares[:, first - 1 : last, i].mean(axis=1))
                assert abs(value - experiment.rms(exact[i], (first, last))) < 4.0 * error
    bound = dataset["mean_square"].sel(policy="known-class-bound").values[0].T
    assert bound == pytest.approx(experiment.exact_mean_squares(p, target, target), rel=1e-9)


# --- the ideal filter


def played(model, estimator, seeds, decisions):
    """The given start; then episodes after each measurement, and the estimator's mean and covariance."""
    begun, states = [], []
    lanes = start_lanes(model, seeds, begun.append)
    (start,) = begun
    memory = estimator.start(start.measurement, start.truth)
    for _ in range(decisions):
        ((episode, _),) = lanes.decide(numpy.zeros((len(seeds), model.task.classes)))
        mean, covariance, memory, _ = estimator.update(memory, episode.measurement, episode.truth)
        states.append((episode, mean, covariance))
    return start.measurement, states


def test_ideal_is_the_channel_of_the_true_class():
    model = make_model(
        ID, scenario="random", decision_interval=1, class_change=None, radar_coloured=(0.0, 0.0)
    )
    _, states = played(model, Ideal(model.task), range(24), 120)
    for episode, mean, covariance in states:
        lane, true = numpy.arange(24), episode.truth.target_class
        # The channel's gains were computed in advance; 120 scans of rounding.
        assert mean == pytest.approx(episode.filter.mean[:, true, lane], rel=1e-9, abs=1e-7)
        reported = numpy.moveaxis(episode.filter.covariance[:, :, true, lane], -1, 0)
        assert numpy.moveaxis(covariance, -1, 0) == pytest.approx(reported, rel=1e-9)


def test_ideal_starts_with_the_correlation_of_the_first_measurement():
    model = make_model(ID, scenario="correlated-errors", decision_interval=1)
    begun = []
    start_lanes(model, range(8), begun.append)
    track = Ideal(model.task).start(begun[0].measurement, begun[0].truth)
    a, b = model.task.parameters.range_sigma, model.task.parameters.range_rate_sigma
    variances, rho = model.task.design_models(model.task.parameters)[1], begun[0].truth.radar_correlation
    assert (rho < -0.1).all()
    for lane in range(8):
        expected = numpy.diag(numpy.diag(variances[..., int(begun[0].truth.target_class[lane])]))
        expected[:2, :2] = [[a * a, a * b * rho[lane]], [a * b * rho[lane], b * b]]
        numpy.testing.assert_allclose(track.covariance[..., lane], expected, rtol=1e-12)


def test_ideal_switches_its_model_at_the_change():
    """Against a Kalman filter written out for each lane, which keeps state and covariance at the change."""
    model = make_model(ID, scenario="class-change", decision_interval=1)
    models, start = model.task.design_models(model.task.parameters)
    H, R = models.H, models.R
    initial, states = played(model, Ideal(model.task), range(8), 120)
    first = model.task.parameters.class_change[0]
    for lane in range(8):
        changes = 0
        governed = int(states[0][0].truth.target_class[lane])
        mean, covariance = numpy.append(initial.first.radar[:, lane], 0.0), start[..., governed]
        for episode, estimate, reported in states:
            z = episode.measurement.radar[:, lane]
            Phi = models.Phi[..., governed]
            mean, P = Phi @ mean, Phi @ covariance @ Phi.T + models.Q[..., governed]
            K = P @ H.T @ numpy.linalg.inv(H @ P @ H.T + R)
            mean, covariance = mean + K @ (z - H @ mean), P - K @ H @ P
            assert estimate[:, lane] == pytest.approx(mean, rel=1e-8, abs=1e-6)
            assert reported[:, :, lane] == pytest.approx(covariance, rel=1e-6, abs=1e-6)
            now = int(episode.truth.target_class[lane])
            if now != governed:
                changes += 1
                assert 0.5 * episode.measurement.scan[lane] >= first
            governed = now
        assert changes == 1


def test_ideal_keeps_its_bound_where_the_class_changes():
    count = 400
    dataset = evaluate(ID, ["ideal", "known-class-bound"], "class-change", count)
    squares = dataset["error"].sel(policy="ideal").values ** 2
    bound = dataset["mean_square"].sel(policy="known-class-bound").values
    for i in range(3):
        difference = (squares[..., i] - bound[..., i]).mean(axis=1)
        assert abs(difference.mean()) < 4.0 * difference.std() / math.sqrt(count)


# --- policies


def decided(model, policy, seeds, decisions):
    """States after measurement and after the policy's action."""
    lanes = start_lanes(model, seeds)
    for _ in range(decisions):
        before = lanes.state
        action, _ = policy.predict(lanes.observe())
        ((after, _),) = lanes.decide(action)
        yield before, after


@pytest.mark.parametrize(
    ("cls", "arguments"),
    [
        (baselines.RadarOnly, {}), (baselines.EsmOnly, {}), (baselines.Ungated, {}), (baselines.JointType, {}),
        (baselines.JointType, {"refused": 0.7, "esm": 0.4}), (baselines.Leaky, {}),
        (baselines.Leaky, {"leak": 0.2, "esm": 0.3}),
    ],
)  # fmt: skip
def test_weights_against_bayes_written_out(cls, arguments):
    """Every lane's weights from the states, with products in place of sums of logarithms."""
    model = make_model(ID, "weights", "crowded", decision_interval=1)
    p = model.task.parameters
    recognition, composition = numpy.array(p.recognition), numpy.array(p.composition)
    pi = composition @ recognition
    policy = cls(model, **arguments)
    leak, esm = arguments.get("leak", 0.01), arguments.get("esm", 1.0)
    q = numpy.array([[1.0 - leak if i == j else leak / 2.0 for j in range(3)] for i in range(3)])
    radar, previous = numpy.ones((3, 16)), None
    for before, after in decided(model, policy, range(16), 60):
        likelihood = numpy.exp(before.filter.log_likelihood - before.filter.log_likelihood.max(axis=0))
        radar = radar * likelihood
        for n in range(16):
            used, refused = before.filter.used_counts[:, n], before.filter.refused_counts[:, n]
            if cls is baselines.RadarOnly:
                P = radar[:, n]
            elif cls is baselines.EsmOnly:
                P = numpy.prod(pi**used, axis=1)
            elif cls is baselines.Ungated:
                P = radar[:, n] * numpy.prod(pi ** (used + refused), axis=1)
            elif cls is baselines.JointType:
                counts = esm * (used + arguments.get("refused", 0.0) * refused)
                P = radar[:, n] * (composition @ numpy.prod(recognition**counts, axis=1))
            else:
                decision = int(before.measurement.decision[n])
                factor = pi[:, decision] ** esm if before.filter.used[n] else 1.0
                last = before.filter.probabilities[:, n] if previous is None else previous[:, n]
                P = ((last * likelihood[:, n]) @ q) * factor
            # The observation compresses the logarithms; the last digits are lost.
            assert after.filter.probabilities[:, n] == pytest.approx(P / P.sum(), rel=1e-9, abs=1e-13)
        previous = after.filter.probabilities


@pytest.mark.parametrize("arguments", [{}, {"change": 0.1, "refused": 0.7, "esm": 0.4}])
def test_forgetting_is_bayes_over_class_and_type_written_out(arguments):
    model = make_model(ID, "weights", "crowded", decision_interval=1)
    p = model.task.parameters
    recognition, composition = numpy.array(p.recognition), numpy.array(p.composition)
    policy = baselines.ForgettingJointType(model, **arguments)
    change, refused, esm = (
        arguments.get(n, d) for n, d in (("change", 0.002), ("refused", 0.0), ("esm", 1.0))
    )
    joint = numpy.repeat((composition / 3.0)[:, :, None], 8, axis=2)
    last, state = numpy.zeros((4, 8)), None
    lanes = start_lanes(model, range(8))
    for step in range(60):
        bank = lanes.state.filter
        action, state = policy.predict(lanes.observe(), state, numpy.full(8, step == 0))
        counts = esm * (bank.used_counts + refused * bank.refused_counts)
        for n in range(8):
            likelihood = numpy.exp(bank.log_likelihood[:, n] - bank.log_likelihood[:, n].max())
            P = joint[:, :, n] * likelihood[:, None]
            moved = numpy.zeros((3, 4))
            for s, r in numpy.ndindex(3, 3):
                moved[r] += P[s] * (1.0 - change) if s == r else P[s].sum() * change / 2.0 * composition[r]
            P = moved * numpy.prod(recognition ** (counts - last)[:, n], axis=1)
            joint[:, :, n] = P / P.sum()
            # The observation compresses the logarithms; the last digits are lost.
            assert action[n] == pytest.approx(joint[:, :, n].sum(axis=1), rel=1e-8, abs=1e-12)
        last = counts
        lanes.decide(action)


def test_policies_fit_other_numbers_of_classes_and_types():
    two = {
        "manoeuvrability": (0.03, 0.1), "acceleration_sigma": (3.0, 20.0), "prior": (0.3, 0.7),
        "recognition": ((0.9, 0.1), (0.0, 1.0)), "composition": ((0.8, 0.2), (0.1, 0.9)),
        "class_transition": ((1.0, 0.0), (0.0, 1.0)),
    }  # fmt: skip
    dataset = evaluate(ID, list(baselines_of(ID).names), "random", 4, horizon=20, **two)
    assert numpy.isfinite(dataset["cost"].values[:-1]).all()


# --- metrics


@pytest.fixture(scope="module")
def records():
    dataset = evaluate(ID, ["quasi-optimal", "ideal", "known-class-bound"], "class-change", 300, seed=4)
    found = {(r.policy, r.metric, r.component, r.window): r for r in tidy_records(dataset)}
    return dataset.sel(policy="quasi-optimal"), found


def test_metrics_follow_from_the_dataset(records):
    run, found = records
    true, P = run["true_class"].values.astype(int), run["true_class_probability"].values
    assert (run["mode_probability"].values[..., 0][true == 0] == P[true == 0]).all()

    def value(metric, component, window):
        return found["quasi-optimal", metric, component, window].value

    squares = run["error"].values ** 2
    late = numpy.zeros(true.shape, dtype=bool)
    late[:, 59:120] = True
    for s in range(3):
        expected = math.sqrt(squares[..., 1][late & (true == s)].mean())
        assert value("rmse_by_class", f"range_rate S{s}", "late") == pytest.approx(expected, rel=1e-9)
        expected = P[true[:, 19] == s, 19].mean()
        assert value("mean_true_class_probability", f"S{s}", "10 s") == pytest.approx(expected, rel=1e-9)
    assert value("mean_true_class_probability", "", "60 s") == pytest.approx(P[:, 119].mean(), rel=1e-9)
    ratio = squares[:, :20, 2].mean() / run["variance_acceleration"].values[:, :20].mean()
    assert value("calibration_ratio", "acceleration", "early") == pytest.approx(ratio, rel=1e-9)
    probability = run["mode_probability"].values
    excess = (probability.max(-1) - (probability.argmax(-1) == true)).mean()
    assert value("confidence_excess", "", "all") == pytest.approx(excess, rel=1e-9)
    wrong = [
        max(row[s] for s in range(3) if s != t) >= 0.9
        for row, t in zip(probability[:, -1], true[:, -1], strict=True)
    ]
    assert value("sure_and_wrong", "", "60 s") == pytest.approx(numpy.mean(wrong), rel=1e-9)

    first, after_change = [], []
    for lane in range(len(true)):
        change = next(k for k in range(120) if true[lane, k] != true[lane, 0])
        first.append(next((0.5 * (k + 1) for k in range(change) if P[lane, k] >= 0.9), math.inf))
        after_change.append(
            next((0.5 * (k - change) for k in range(change, 120) if P[lane, k] >= 0.9), math.inf)
        )
    best, detected, false = probability.argmax(-1), [], 0
    for lane in range(len(true)):
        change = next(k for k in range(120) if true[lane, k] != true[lane, 0])
        right = best[lane] == true[lane]
        detected.append(next((0.5 * (k - change) for k in range(change, 120) if right[k:].all()), math.inf))
        false += sum(right[k - 1] and not right[k] and k != change for k in range(1, 120))
    assert value("false_class_changes", "", "all") == pytest.approx(false / len(true), rel=1e-9)
    assert value("right_class", "", "late") == pytest.approx((best == true)[:, 59:].mean(), rel=1e-9)
    score = numpy.log(numpy.maximum(P, 1e-6)).mean()
    assert value("class_log_score", "", "all") == pytest.approx(score, rel=1e-9)
    for name, times in (
        ("time_to_recognise", first),
        ("time_to_recognise_change", after_change),
        ("time_to_detect_change", detected),
    ):
        for suffix, rank in (("median", 149), ("90_quantile", 269)):
            quantile = sorted(times)[rank]
            # None where the quantile lies among the runs that never got there.
            expected = quantile if math.isfinite(quantile) else None
            assert value(f"{name}_{suffix}", "", "all") == expected
        assert value(f"{name}_censored", "", "all") == pytest.approx(numpy.isinf(times).mean(), rel=1e-9)


def test_metrics_of_the_ideal_filter_and_of_a_bound(records):
    """The ideal filter has errors and a covariance, but no class probabilities; a bound has neither."""
    _, found = records
    ratio = found["ideal", "calibration_ratio", "acceleration", "all"]
    assert ratio.low < 1.0 < ratio.high
    nees = found["ideal", "anees", "state", "all"]
    assert nees.low < 1.0 < nees.high
    of_classes = {"rmse_by_class", "calibration_ratio"}
    assert {key[1] for key in found if key[0] == "ideal"} >= of_classes
    beliefs = {"mean_true_class_probability", "sure_and_wrong", "confidence_excess"}
    assert not [key for key in found if key[0] == "ideal" and key[1] in beliefs]
    assert not [key for key in found if key[0] == "known-class-bound" and key[1] in of_classes | beliefs]


def test_time_quantile_is_the_order_statistic_and_knows_the_censored():
    rng = numpy.random.default_rng(0)
    first = rng.integers(0, 13, 101)  # 12 is "never"
    chosen = rng.random(101) < 0.7
    seconds = 0.5 * numpy.arange(1, 13)
    times = numpy.sort(numpy.append(seconds, math.inf)[first[chosen]])
    for share in (0.1, 0.5, 0.9):
        estimate = time_quantile(Bootstrap(101), first, chosen, seconds, share)
        assert estimate.value == times[math.ceil(share * len(times)) - 1]
    assert time_quantile(Bootstrap(101), first, chosen, seconds, 0.999).value == math.inf


# --- the reproduction


@pytest.mark.slow
def test_reproduction_has_a_verdict_for_every_claim_and_four_figures():
    done = []
    result = reproduction.reproduce(done.append, 400)
    assert sum(done) == pytest.approx(reproduction.STEPS)
    verdicts = {claim.key: claim.verdict for claim in result.claims}
    assert [verdicts[key] for key in ("D1, one type for each target", "D3", "D4")] == [
        "not reproduced",
        "reproduced",
        "reproduced in part",
    ]
    assert {f"figure_{i}" for i in range(1, 5)} <= {name[:8] for name in result.figures}
    assert all(caption for _, caption in result.figures.values())
    for table in result.tables:
        assert {len(row) for row in table.rows} == {len(table.header)}


def test_recognition_verdict():
    def measured(value, error):
        return Quantity(value, value - 2 * error, value + 2 * error, error)

    good, bad = measured(0.999, 0.001), measured(0.9, 0.001)
    assert claims.recognition_verdict([good, good, good]) == "reproduced"
    assert claims.recognition_verdict([good, bad, good]) == "reproduced in part"
    assert claims.recognition_verdict([bad, bad, bad]) == "not reproduced"
    # Not certain enough.
    assert claims.recognition_verdict([measured(0.991, 0.001)] * 3) == "not reproduced"


# --- the picture


def test_picture_shows_accelerations_decisions_and_the_change():
    from filtergym.envs.interface.environment import TaskEnv

    world = TaskEnv(ID, "weights", "class-change", render_mode="rgb_array", decision_interval=1)
    world.reset(seed=2)
    for _ in range(100):
        world.step(numpy.ones(3))
    drawn = world.picture
    frame = world.render()
    history = {name: numpy.array(values) for name, values in drawn.history.items()}
    panels = drawn.picture
    numpy.testing.assert_array_equal(panels.true.get_ydata(), history["true"])
    numpy.testing.assert_allclose(
        panels.estimate.get_ydata() - history["true"], history["error.acceleration"]
    )
    used, refused = (numpy.isfinite(history[name]) for name in ("used", "refused"))
    assert not (used & refused).any()
    assert (numpy.flatnonzero(used | refused) % 4 == 3).all()
    assert (used | refused).any()
    change = int(numpy.flatnonzero(numpy.diff(history["true_class"]))[0]) + 2
    assert panels.shading() == [(change - 0.5, 120.5)]
    world.reset(seed=3)
    assert (world.render() != frame).any()
    world.close()
