"""Policies, reference, bound, metrics and reproduction of tightly coupled navigation."""

import math

import numpy
import pytest
import scipy.linalg
import scipy.stats
from models import make_model
from naive import dense

from filtergym import evaluate, tidy_records
from filtergym.baselines.problem import problem_of
from filtergym.baselines.tightly_coupled_navigation import estimators, metrics, policies, references
from filtergym.baselines.tuning import Search, tune
from filtergym.envs.contract.filter import Initial
from filtergym.envs.tightly_coupled_navigation.fault_hypotheses import VAGUE, FaultHypotheses
from filtergym.envs.tightly_coupled_navigation.parameters import LINE, REST, SINGER
from filtergym.envs.tightly_coupled_navigation.satellite_faults import SatelliteFaults
from filtergym.envs.tightly_coupled_navigation.world import Measurement
from filtergym.evaluation.running.rollout import rollout
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.filters import gnss_ins
from filtergym.papers import multi_hypothesis_ins_gnss as paper
from filtergym.papers.multi_hypothesis_ins_gnss import claims, experiment
from filtergym.papers.quantities import Quantity

ID = "filtergym/TightlyCoupledNavigation-v0"


# --- reference and bound


def test_known_mode_is_the_singer_filter_where_all_is_singer():
    names = ["known-mode", "singer"]
    matched = evaluate(ID, names, "matched", episodes=4, horizon=60, decision_interval=1)
    one, other = (matched["error"].sel(policy=name).values for name in ("known-mode", "singer"))
    # Both form the same numbers; the bank adds mixing with weights of zero, in another order.
    numpy.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-7)


def test_bound_is_the_dense_recursion():
    """Random legs and faults with dense matrices and the information form, one lane at a time."""
    keywords = {
        "leg_duration": (0.05, 0.1), "rate_fault_probability": 1.0, "rate_fault_duration": (0.1, 0.15),
        "stick_probability": 1.0, "stick_duration": (0.1, 0.15), "rates_outage_probability": 0.5,
        "rates_outage_duration": (0.05, 0.1), "satellites_outage_probability": 1.0,
        "satellites_outage_duration": (0.1, 0.1), "rest_probability": 0.5, "horizon": 40, "decision_interval": 1,
        "manoeuvre_throughout": 0.0, "undisturbed": 0.0, "urban": False, "aperture": False,
        "pseudorange_coloured": (0.5, 3.0), "pseudorange_correlation_time": (0.05, 1.0),
    }  # fmt: skip
    model = make_model(ID, **keywords)
    seen = []

    class Watched(references.KnownModeBound):
        def update(self, memory, measurement, truth):
            seen.append((measurement, truth))
            return super().update(memory, measurement, truth)

    run = rollout(model, Watched(model.task), episode_seeds("test", 3, 8))
    bounds = [episode.filter.own.mean for episode, _ in run]
    assert (numpy.stack([s.jumped for _, s in seen]).sum(axis=0) > 1).all()
    assert numpy.stack([s.disturbances["stuck"].now for _, s in seen]).any(axis=0).all()
    p, S = model.task.parameters, model.task.satellites
    identity = numpy.eye(17)[:, :, None, None]
    F = [
        gnss_ins.advance(
            identity, model.task.axis[:, :, i : i + 1], model.task.common.T, model.task.common.decay
        )[..., 0, 0]
        for i in range(3)
    ]
    user = [0, 1, 2, 4, 5, 6, 8, 9, 10]
    Q = [model.task.process_noise[:, :, i, 0].copy() for i in range(3)]
    Q[REST][numpy.ix_(user, user)] = 0.0
    for i in (8, 9, 10):
        Q[LINE][i, i] = 0.0  # the acceleration of straight flight is zero, not nearly
    for lane in range(8):
        colour = seen[0][1].disturbances["coloured"]
        coloured, decay = colour.deviation[lane], colour.process.decay[lane]
        P = numpy.diag([*model.task.world.initial_sigma[:, 0] ** 2, *[coloured**2] * S])
        mode = int(seen[0][1].mode[lane])
        for (measured, truth), mean_square in zip(seen, bounds, strict=True):
            jumped = truth.jumped[lane] > 0.0
            i = mode if jumped else int(truth.mode[lane])
            moving = scipy.linalg.block_diag(F[i], decay * numpy.eye(S))
            gained = scipy.linalg.block_diag(Q[i], coloured**2 * (1.0 - decay**2) * numpy.eye(S))
            P = moving @ P @ moving.T + gained
            if jumped:
                P[8:11] = P[:, 8:11] = 0.0
            position, velocity = model.task.satellites_at(truth.step)
            _, rows = gnss_ins.observe(truth.state, position, velocity, measured.ins_angles, p.gravity)
            H = numpy.hstack([dense(rows, truth.state)[..., lane], numpy.eye(len(rows), S)])
            R = numpy.array(model.task.sensor_variance) * truth.noise_factor[:, lane] ** 2
            there = measured.available[:, lane] > 0.0
            there[2 * S : 2 * S + 3] &= truth.disturbances["stuck"].now[lane] == 0.0
            H, R = H[there], numpy.diag(R[there])
            P = P - P @ H.T @ numpy.linalg.solve(H @ P @ H.T + R, H @ P)
            # Subtraction of the dense form: 100 m^2 and 1e-6 (rad/s)^2 stand in one matrix.
            numpy.testing.assert_allclose(mean_square[:, lane], numpy.diag(P)[:17], rtol=1e-6, atol=1e-12)
            mode = int(truth.mode[lane])


@pytest.fixture(scope="module")
def on_random():
    return evaluate(ID, ["singer", "known-mode", "known-mode-bound"], episodes=16, horizon=400)


# --- the bank over faults


def test_the_bank_over_faults_leaves_a_satellite_that_jumps_to_its_own_error():
    keywords = {"ramp_start": (1.0, 1.0), "ramp_jump": (50.0, 50.0), "horizon": 200}
    model = make_model(ID, scenario="satellite-bias", **keywords)
    found = []

    class Watched(FaultHypotheses):
        def update(self, state, given):
            answer = super().update(state, given)
            found.append((answer[2].means[17:], answer[2].probabilities))
            return answer

    estimator = Watched(model.task, VAGUE)
    for _episode, _ in rollout(model, estimator, episode_seeds("test", 4, 8), kind="estimator"):
        truth = _episode.truth
    errors = (found[-1][0] * found[-1][1]).sum(axis=1)
    place = truth.disturbances["ramp"].satellites[0].astype(int)
    lanes = numpy.arange(8)
    before = (found[90][0] * found[90][1]).sum(axis=1)
    # What was there before, 2 m of the prior, is left in.
    assert errors[place, lanes] - before[place, lanes] == pytest.approx([50.0] * 8, abs=3.0)
    others = numpy.ones((4, 8), dtype=bool)
    others[place, lanes] = False
    assert abs(errors - before)[others].max() < 3.0


def test_the_bank_over_satellite_faults_believes_the_fault_that_is_there():
    """Before it begins, nothing; then that of the satellite. Its mean is that of the members it believes."""
    keywords = {"ramp_start": (0.4, 0.4), "ramp_jump": (30.0, 30.0), "horizon": 50}
    model = make_model(ID, scenario="satellite-bias", **keywords)
    found = []

    class Watched(SatelliteFaults):
        def update(self, state, given):
            answer = super().update(state, given)
            found.append(answer)
            return answer

    estimator = Watched(model.task)
    for episode, _ in rollout(model, estimator, episode_seeds("test", 4, 8), kind="estimator"):
        truth = episode.truth
    place, lanes = truth.disturbances["ramp"].satellites[0].astype(int), numpy.arange(8)
    assert found[38].weights[0].min() > 0.9
    last = found[-1]
    assert last.weights.sum(axis=0) == pytest.approx(1.0, rel=1e-12)
    assert last.weights[1 + place, lanes].min() > 0.9
    expected = sum(w * member.mean for w, member in zip(last.weights, last.members, strict=True))
    numpy.testing.assert_allclose(estimator.mean(last), expected, rtol=1e-12)
    apart = [member.mean - expected for member in last.members]
    spread = sum(
        w * (member.covariance + d[:, None] * d[None])
        for w, member, d in zip(last.weights, last.members, apart, strict=True)
    )
    # Positions of millions of metres differ by metres.
    numpy.testing.assert_allclose(estimator.covariance(last), spread, rtol=1e-6, atol=1e-6)


def test_without_faults_the_bank_over_satellite_faults_is_its_first_member():
    model = make_model(ID, scenario="random", horizon=10)
    both = [SatelliteFaults(model.task, begins=0.0), FaultHypotheses(model.task)]
    ends = []
    for estimator in both:
        *_, (episode, _) = rollout(model, estimator, episode_seeds("test", 4, 4), kind="estimator")
        ends.append(episode.filter.own)
    numpy.testing.assert_array_equal(ends[0].mean, ends[1].mean)


def test_levels_of_a_rate_find_the_noisy_one():
    keywords = {
        "rate_fault_probability": 1.0, "rate_fault_factor": (8.0, 8.0), "rate_fault_duration": (1.0, 1.0),
        "stick_probability": 0.0, "horizon": 150, "undisturbed": 0.0, "urban": False, "aperture": False,
        "rates_outage_probability": 0.0, "satellites_outage_probability": 0.0,
    }  # fmt: skip
    model = make_model(ID, **keywords)
    levels, noisy = [], []

    class Watched(FaultHypotheses):
        def update(self, state, given):
            answer = super().update(state, given)
            levels.append(answer[2].levels[0])
            return answer

    for episode, _ in rollout(model, Watched(model.task), episode_seeds("test", 9, 8), kind="estimator"):
        noisy.append(episode.truth.noise_factor[4:8] > 1.0)
    quiet, noisy = numpy.array(levels), numpy.array(noisy[: len(levels)])
    assert noisy.any()
    lasting = noisy[20:] & noisy[:-20]
    assert quiet[20:][lasting].mean() < 0.1
    assert quiet[~noisy].mean() > 0.9


# --- policies


def test_sticky_changes_the_chain_of_the_bank():
    assert make_model(ID, **policies.Sticky.task_keywords).task.parameters.transition == policies.chain(
        0.9999
    )
    assert policies.chain(0.998) == pytest.approx(
        numpy.array(make_model(ID).task.parameters.transition), abs=1e-15
    )


def observed(model, **values):
    """Two quiet observations with some fields replaced."""
    observation = numpy.zeros((2, len(model.fields)))
    for name, value in values.items():
        columns = [i for i, f in enumerate(model.fields) if f.name.startswith(name)]
        assert columns, name
        observation[0, columns] = value
    return observation


def test_nis_adaptive_divides_the_excess():
    model = make_model(ID, "gain")
    policy = policies.NisAdaptive(model, threshold=2.0, rates=0.5, accelerometers=3.0, base=0.1)
    shown = math.log1p(2.0 * 9.0) / (1.0 + math.log1p(2.0 * 9.0) / 8.0)
    action, _ = policy.predict(observed(model, average_nis_rates=shown))
    excess = math.log(9.0) / (2 * math.log(300.0))
    assert action[0] == pytest.approx([0.0, 0.5 * excess, 0.1 + 3.0 * excess, 0.0], rel=1e-12)
    assert action[1] == pytest.approx([0.0, 0.0, 0.1, 0.0], abs=0.0)
    policy = policies.NisAdaptive(model, threshold=2.0, own=0.5)
    action, _ = policy.predict(observed(model, average_nis_accelerometers=shown))
    assert action[0] == pytest.approx([0.0, 0.0, 0.5 * excess, 0.0], rel=1e-12)


def test_nis_adaptive_listens_to_the_hypothesis_that_is_content():
    model = make_model(ID, "gain")
    policy = policies.NisAdaptive(model, threshold=2.0, base=0.1)
    quiet = observed(model, average_nis_rates=5.0, average_nis_rates_rest=0.0)
    assert policy.predict(quiet)[0][0] == pytest.approx([0.0, 0.0, 0.1, 0.0], abs=0.0)


# --- estimators


OPEN_LOOP = {"aperture": False}
"""Tracking loops expect what the bank's hypotheses predict together, or what follows from an estimator's estimate.
Where they have an aperture, they may lose other signals."""


def test_huber_without_thresholds_is_the_paper():
    class Plain(estimators.Huber):
        def __init__(self, task):
            super().__init__(task, {})

    # Estimators compute with NumPy: so must the paper's policy, to have the same bits.
    both = {"paper": "multi-hypothesis", "plain": Plain}
    dataset = evaluate(ID, both, episodes=8, horizon=100, backend="numpy", **OPEN_LOOP)
    for name in ("error", "nees"):
        assert (dataset[name][0] == dataset[name][1]).all()


def constant(values, name="robust"):
    class Constant(policies.ConstantPolicy):
        control = name
        action = values

    return Constant


@pytest.mark.claims
def test_robust_is_between_the_paper_and_hubers_update():
    """Zero is the paper; full strength is Huber's update of ranges and rates; noise is that of the control gain, 0.3
    times as far.
    """

    class RangesAndRates(estimators.Huber):
        def __init__(self, task):
            super().__init__(task, {"pseudoranges": 1.345, "rates": 1.345})

    others = {
        "paper": "multi-hypothesis",
        "zero": constant((0.0,) * 7),
        "negative": constant((0.0,) * 4 + (-1.0,) * 3),
        "robust": constant((0.0,) * 5 + (1.0, 1.0)),
        "ranges and rates": RangesAndRates,
        "noisy": constant((0.2, -0.3, 0.5, 0.1, 0.0, 0.0, 0.0)),
        "gain": constant((0.06, -0.09, 0.15, 0.03), "gain"),
    }
    error = evaluate(ID, others, episodes=8, horizon=100, backend="numpy", **OPEN_LOOP)["error"]
    # Exact but where a threshold of 1e9 deviations, or the covariance of what is steered, comes in.
    for one, other in (
        ("paper", "zero"),
        ("zero", "negative"),
        ("robust", "ranges and rates"),
        ("noisy", "gain"),
    ):
        numpy.testing.assert_allclose(error.sel(policy=one), error.sel(policy=other), rtol=0.0, atol=1e-9)
    assert abs(error.sel(policy="robust") - error.sel(policy="paper")).max() > 1e-3


def test_accelerometers_are_noisier_while_they_repeat_themselves():
    model = make_model(ID, "robust", scenario="accelerometer-failure")
    state = model.filter.start(Initial(numpy.zeros((17, 2)), numpy.stack([numpy.eye(17)] * 2, axis=2)))
    state = state._replace(repeated=numpy.array([0.0, 1.0]))
    action = numpy.array([[0.1, 0.0, 0.2, 0.0, 0.5, 1.0, 0.5]] * 2).T
    variance = numpy.stack(model.filter._variance(action, state))
    nominal = numpy.array(model.task.sensor_variance)[:, None]
    exponent = numpy.zeros((14, 2))
    exponent[:4] = 0.3 * 0.1
    exponent[8:11] = [0.3 * 0.2, 0.3 * 0.2 + 0.5]
    numpy.testing.assert_allclose(variance, nominal * 300.0 ** (2.0 * exponent), rtol=1e-12)
    assert [float(k[0]) for k in model.filter._thresholds(action)] == [1.345] * 4 + [2.69] * 4 + [
        math.inf
    ] * 6


def test_updates_are_plain_where_a_manoeuvre_may_begin_unfelt():
    model = make_model(ID)
    available = numpy.ones((14, 4))
    available[8:11, 1] = 0.0
    available[9, 2:] = 0.0
    measurement = Measurement(*[None] * 2, available, *[None] * 4)
    check = estimators.HuberStuckCheck(model.task, rates=2.0, manoeuvre=3.0).bank
    average = numpy.full((4, 3, 4), 9.0)
    average[1, 2, 3] = 2.9
    state = check.start(Initial(numpy.ones((17, 4)), numpy.ones((17, 17, 4))))._replace(average_nis=average)
    usual = estimators.EFFICIENT
    thresholds = numpy.stack(check.thresholds(state, measurement))
    for lane, plain in enumerate([False, True, True, False]):
        expected = [math.inf] * 14 if plain else [usual] * 4 + [2.0] * 4 + [math.inf] * 6
        assert thresholds[:, lane].tolist() == expected
    assert (numpy.stack(estimators.Huber(model.task).bank.thresholds(state, measurement)) == usual).all()


def test_stuck_accelerometers_are_left_out_from_the_first_repeated_reading_on():
    model = make_model(
        ID,
        rate_fault_probability=0.0,
        stick_probability=1.0,
        horizon=200,
        satellites_outage_probability=1.0,
        satellites_outage_duration=(0.5, 0.5),
    )
    estimator = estimators.HuberStuckCheck(model.task)
    seen = []
    predict = estimator.bank.predict

    def watched(state, measurement):
        seen.append(measurement.available)
        return predict(state, measurement)

    estimator.bank.predict = watched
    episodes = [episode for episode, _ in rollout(model, estimator, episode_seeds("test", 5, 8))]
    stuck = numpy.stack([episode.truth.disturbances["stuck"].now for episode in episodes])
    there = numpy.stack([episode.measurement.available for episode in episodes])
    assert stuck.any()
    assert (there == 0.0).any()
    there[:, 8:11] *= 1.0 - stuck[:, None]
    assert (numpy.stack(seen) == there).all()


def test_tuning_counts_decisions():
    # 32 candidates on 256 episodes of 60 decisions, each 10 measurements.
    with pytest.raises(ValueError, match="give 491520 steps"):
        tune(problem_of(ID), "fixed-robust", Search(491_519))


# --- metrics


def test_lasting_and_switches_are_what_a_loop_finds():
    rng = numpy.random.default_rng(0)
    condition = rng.random((5, 60)) < 0.7
    for steps in (1, 3, 10):
        naive = [
            [row[k : k + steps].all() and k + steps <= len(row) for k in range(len(row))] for row in condition
        ]
        assert (metrics.find_lasting(condition, steps) == naive).all()
    mode = numpy.array([[0] * 20 + [2] * 30 + [1] * 5, [1] * 55])
    probability = numpy.zeros((2, 55, 3))
    probability[0, 23:26, 2] = 0.9  # too short
    probability[0, 30:50, 2] = 0.9
    probability[0, 52:, 1] = 0.6  # until the end, five steps after the switch
    found = metrics.switches(mode, probability)
    assert [(s.episode, s.before, s.after) for s in found] == [(0, 0, 2), (0, 2, 1)]
    assert found[0].wait == 11.0
    assert found[1].wait == math.inf  # five steps are asked for, three are there


def test_quantiles_are_those_of_the_episodes():
    values = numpy.random.default_rng(1).random(101)
    bootstrap = Bootstrap(101)
    assert bootstrap.quantiles(values)[0] == numpy.median(values)
    chosen = values > 0.5
    found = bootstrap.interval(bootstrap.quantiles(values, 0.5, chosen))
    assert found.value == numpy.sort(values[chosen])[math.ceil(0.5 * chosen.sum()) - 1]
    assert found.low < found.value < found.high
    assert numpy.isnan(bootstrap.quantiles(values, 0.5, values > 2.0)).all()


def test_metrics_follow_from_the_dataset(on_random):
    records = {(r.policy, r.metric, r.component): r for r in tidy_records(on_random) if r.window == "all"}
    run = on_random.sel(policy="singer")
    mode, squares = run["true_mode"].values, (run["error"].values[:, :, 4:7] ** 2).sum(axis=2)
    value = records["singer", "rmse_by_hypothesis", "velocity singer"].value
    assert value == pytest.approx(math.sqrt(squares[mode == SINGER].mean()), rel=1e-12)
    cost = numpy.sort(run["cost"].values.mean(axis=1))
    assert records["singer", "cost_median", ""].value == cost[7]
    # A filter that believes one hypothesis for ever follows every change to it at once, and no other.
    assert records["singer", "adaptation_time", "rest to singer"].value == pytest.approx(0.01, rel=1e-12)
    assert records["singer", "adaptation_censored", "singer to constant-velocity"].value == 1.0
    assert ("singer", "adaptation_time", "singer to constant-velocity") not in records
    # A reference returns what it estimates, not what it expects.
    assert not {m for p, m, _ in records if p == "known-mode"} & {"track_loss_rate", "adaptation_time"}
    assert not [r for r in records if r[0] == "known-mode-bound" and r[1] == "cost_median"]


# --- reproduction


def test_filters_side_by_side_are_the_filters_alone():
    runs = experiment.simulate("paper", {"adaptive": 4, "Singer": 3}, horizon=40, leg_steps=(10, 25))
    known = experiment.simulate("paper", {"known mode": 3}, horizon=40, leg_steps=(10, 25))["known mode"]
    dataset = evaluate(
        ID, ["multi-hypothesis", "singer", "known-mode"], "paper", episodes=4, horizon=40, leg_steps=(10, 25)
    )
    pairs = ((runs["adaptive"], "multi-hypothesis"), (runs["Singer"], "singer"), (known, "known-mode"))
    for run, name in pairs:
        error = dataset["error"].sel(policy=name).values[: len(run.nis)]
        for c, part in enumerate(experiment.PARTS):
            expected = (error[:, :, part] ** 2).sum(axis=2)
            # The weights pass through the observation's logarithms; the bank amplifies their rounding.
            numpy.testing.assert_allclose(run.squares[:, :, c], expected, rtol=1e-5, atol=1e-9)
        if name != "known-mode":
            nis = dataset["nis"].sel(policy=name).values / dataset["nis_degrees"].sel(policy=name).values
            numpy.testing.assert_allclose(run.nis, nis[: len(run.nis)], rtol=1e-5)
    # 3 runs of 40 steps with 14 degrees: standard error 0.035; at rest a little below one.
    assert 0.75 < known.nis.mean() < 1.14


def fake_run(episodes, steps, motion, lost):
    rng = numpy.random.default_rng(episodes)
    mode = numpy.zeros((episodes, steps), dtype=int)
    mode[:, motion - 1 :] = LINE
    mode[:, 2 * motion - 2 :] = SINGER
    probability = 0.98 * (mode[:, :, None] == numpy.arange(3)) + 0.01
    outside = numpy.zeros((episodes, steps), dtype=bool)
    if lost:
        outside[:, motion + 60 :] = True
    return experiment.Run(
        rng.random((episodes, steps, 6)) + 0.1, rng.random((episodes, steps)), probability, mode, outside,
        rng.random((episodes, steps)),
    )  # fmt: skip


@pytest.mark.slow
def test_reproduction_makes_claims_tables_and_figures(monkeypatch, tmp_path):
    def simulate(scenario, filters, **keywords):
        motion = keywords.get("leg_steps", (1000,))[0] + 1
        steps = keywords.get("horizon", 3000)
        return {
            name: fake_run(count, steps, motion, name == "Singer" and scenario == "paper")
            for name, count in filters.items()
        }

    monkeypatch.setattr(experiment, "simulate", simulate)
    done = []
    result = paper.reproduce(done.append, 5)
    assert sum(done) == paper.STEPS
    verdicts = {c.key: c.verdict for c in result.claims}
    assert verdicts["C3"] == "reproduced in part"  # lost in increment, not in kinematic
    assert verdicts["C5"] == "reproduced"
    for table in result.tables:
        assert {len(row) for row in table.rows} == {len(table.header)}
    result.save(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"report.md", *(f"{name}.png" for name in result.figures)}


def near(value):
    return Quantity(value, value - 0.01, value + 0.01)


def test_verdicts_follow_the_data():
    assert claims.matched_verdict([near(1.03)], [near(1.0)]) == "reproduced"
    assert claims.matched_verdict([near(1.03)], [near(1.6)]) == "reproduced in part"
    assert claims.matched_verdict([near(1.2)], [near(1.0)]) == "not reproduced"
    exact = Quantity(1.0, 1.0, 1.0)
    assert claims.weight_verdict([0.0, 0.06, 0.3], [exact, near(1.03), near(1.3)]) == "reproduced"
    assert claims.weight_verdict([0.0, 0.3, 0.06], [exact, near(1.03), near(1.3)]) == "reproduced in part"
    assert claims.weight_verdict([0.0, 0.06], [near(1.05), near(1.06)]) == "reproduced in part"
    assert claims.weight_verdict([0.0, 0.06], [exact, near(1.0)]) == "not reproduced"
    lost, late, kept = (experiment.Loss(1.0, t, t, t) for t in (0.7, 1.4, 0.7))
    kept = kept._replace(rate=0.0)
    assert claims.loss_verdict(lost, lost) == "reproduced"
    assert claims.loss_verdict(lost, kept) == "reproduced in part"
    assert claims.loss_verdict(late, kept) == "not reproduced"
    quick, middle, slow = (experiment.Wait(t, 0.01, t, 0) for t in (0.02, 0.4, 0.49))
    assert claims.adaptation_verdict([quick, middle], slow) == "reproduced"
    assert claims.adaptation_verdict([quick], slow) == "reproduced in part"
    assert claims.adaptation_verdict([quick], quick) == "not reproduced"
    assert claims.stability_verdict([kept]) == "reproduced"
    assert claims.stability_verdict([kept, lost]) == "not reproduced"


def test_the_innovation_test_sums_the_last_steps():
    nis = numpy.full((2, 60), 4.0)
    nis[1, 30:] = 40.0
    alarm = metrics.innovation_alarm(nis, numpy.full((2, 60), 4.0))
    assert not alarm[0].any()
    for k in range(60):
        window = nis[1, max(0, k - metrics.TESTED + 1) : k + 1]
        limit = scipy.stats.chi2.ppf(1.0 - metrics.RISK, 4.0 * len(window))
        assert alarm[1, k] == (window.sum() > limit)


def test_lost_tracks_are_reported_with_their_median_time():
    """Of lost episodes alone; and no time where none was lost."""
    lost = numpy.array([True, False, True, True, False])
    each = {
        "switches": numpy.zeros((5, 3, 3, 3)),
        "lost": lost,
        "lost_after": numpy.array([0.3, 9.0, 0.5, 0.1, 9.0]),
    }
    found = {m.metric: m for m in metrics._of_bank(each, Bootstrap(5, 20))}
    assert found["track_loss_rate"].estimate.value == pytest.approx(0.6)
    assert (found["track_loss_time"].estimate.value, found["track_loss_time"].unit) == (0.3, "s")
    assert [m.metric for m in metrics._of_bank({**each, "lost": lost & ~lost}, Bootstrap(5, 20))] == [
        "track_loss_rate"
    ]


def test_detection_counts_the_first_fault():
    alarm = numpy.zeros((3, 50), dtype=bool)
    fails = numpy.zeros((3, 50), dtype=bool)
    fails[:2, 20:30] = True
    alarm[0, [5, 24, 40]] = True  # a false one, the fault, a trace of it
    alarm[1, 35] = True
    alarm[2, [1, 2]] = True
    found = metrics._detection(alarm, fails, 0.01)
    assert found["found"].tolist() == [True, False, False]
    assert found["found_after"] == pytest.approx([0.05, 0.0, 0.0])
    assert found["false_alarms"].tolist() == [1, 0, 2]
    assert found["faultless"].tolist() == [20, 20, 50]
