"""The loosely coupled navigation task against naive filters, exact moments and the reference table."""

import math

import numpy as np
import pytest
from models import make_model

from filtergym.baselines.loosely_coupled_navigation.policies import FixedGain
from filtergym.envs.contract.draws import Draws
from filtergym.envs.contract.model import Model
from filtergym.envs.loosely_coupled_navigation.parameters import LooselyCoupledNavigationParameters
from filtergym.envs.loosely_coupled_navigation.task import TASK
from filtergym.filters import linear_systems, loosely_coupled
from filtergym.papers.kalman_bucy_ins_gnss import kalman_bucy

MODEL = (*loosely_coupled.error_model(0.6, 0.4, 1.0, 0.04)[:2], [[1.0, 0, 0]], [[0.02]])
START = np.diag([0.0, 0.36, 0.16])


def make(scenario, control="gain", xp=np, **keywords) -> Model:
    values = {**TASK.scenarios[scenario].parameters, **keywords}
    return Model(TASK(TASK.Parameters(**values), xp), control)


def numbers(model, lanes, steps, seed):
    """What an episode draws: uniforms, initial normals, and a list of rows."""
    rng = np.random.default_rng(seed)
    rows = model.task.noise.normals + model.task.noise.row_uniforms
    return (
        rng.random((model.task.noise.uniforms, lanes)),
        rng.standard_normal((model.task.noise.initial_normals, lanes)),
        [rng.standard_normal((rows, lanes)) for _ in range(steps)],
    )


def states(model, drawn, policy):
    """Drive the task; yield the state after each measurement and the state after each action."""
    uniforms, normals, rows = drawn
    state = model.begin(uniforms, normals)
    for k, row in enumerate(rows):
        seen = model.measure(state, row)
        state = model.act(seen, policy(k, seen))
        yield seen, state


def constant(model, action, lanes):
    if model.control == "mode":
        return lambda k, seen: np.full(lanes, action)
    return lambda k, seen: np.full((model.action_space.shape[0], lanes), action)


def random_actions(model, lanes, steps, seed):
    rng = np.random.default_rng([seed, 1])
    if model.control == "mode":
        return rng.integers(0, 3, (steps, lanes))
    low = 0.0 if model.control == "weights" else -1.2
    return rng.uniform(low, 1.2, (steps, model.action_space.shape[0], lanes))


# --- The reference table ---------------------------------------------------------------------------------


def attenuated_mean_square(K, drift, coloured, correlation_time, white_intensity, receiver_intensity):
    """Settled mean square error of the continuous plain scheme with gain K, m^2, term by term."""
    constant = (drift / K) ** 2
    colour = coloured**2 / (K * (K + 1.0 / correlation_time))
    return constant + colour + (white_intensity + K * K * receiver_intensity) / (2.0 * K)


def test_best_constant_gain():
    model = (0.6, 0.4, 1.0, 0.04, 0.02)
    K = loosely_coupled.best_constant_gain(*model)
    assert pytest.approx(4.73, abs=5e-3) == K
    assert pytest.approx(0.447, abs=5e-4) == K * K * 0.02
    cost = attenuated_mean_square
    assert cost(K, *model) < min(cost(1.001 * K, *model), cost(0.999 * K, *model))
    with pytest.raises(ValueError, match="perfect INS"):
        loosely_coupled.best_constant_gain(0, 0, 1, 0, 0.02)


@pytest.mark.parametrize("K", [1.41, 4.24, 9.0])
def test_attenuation_follows_from_the_moments(K):
    A, BGBt, P0 = loosely_coupled.error_model(0.6, 0.4, 0.7, 0.04)
    A[0, 0], BGBt[0, 0] = -K, 0.04 + K * K * 0.02
    found = kalman_bucy.moments(A, np.zeros(3), BGBt, np.zeros(3), P0, [30.0]).covariance[0, 0, 0]
    assert attenuated_mean_square(K, 0.6, 0.4, 0.7, 0.04, 0.02) == pytest.approx(found, rel=1e-9)


# --- Filters against naive ones -----------------------------------------------------------------------------


def test_the_bank_equals_naive_filters():
    lanes, steps, seed = 3, 200, 0
    model = make("random", "weights", axes=2, noise_changes=(2, 2), outage_probability=1.0)
    drawn, actions = numbers(model, lanes, steps, seed), random_actions(model, lanes, steps, seed)
    run = list(states(model, drawn, lambda k, seen: actions[k]))
    Phi, Qd = linear_systems.van_loan(*MODEL[:2], 0.01)
    for lane in range(lanes):
        for axis in range(2):
            first = run[0][0].measurement
            x = np.full(2, first.ins[axis, lane] - first.increment[axis, lane])
            v, error, P = np.zeros(2), np.zeros(3), START
            for k, (seen, state) in enumerate(run):
                measured, bank = seen.measurement, state.filter
                R = measured.reported_deviation[lane] ** 2
                x, v = x + measured.increment[axis, lane], v + np.array([0.04, 0.36]) * 0.01
                error, P = Phi @ error, Phi @ P @ Phi.T + Qd
                if measured.available[lane]:
                    g, z = v / (v + R), measured.fix[axis, lane]
                    x, v = x + g * (z - x), v * (1 - g)
                    K = P[:, 0] / (P[0, 0] + R)
                    error = error + K * (measured.ins[axis, lane] - z - error[0])
                    P = P - np.outer(K, P[0])
                expected = [*x, measured.ins[axis, lane] - error[0]]
                weights = np.clip(actions[k, :, lane], 0, 1)
                weights = weights / weights.sum()
                # Rounding over 300 steps of different but equal formulas.
                np.testing.assert_allclose(bank.position[:, axis, lane], expected, atol=1e-11)
                rates = [bank.drift[axis, lane], bank.coloured[axis, lane]]
                np.testing.assert_allclose(rates, error[1:], atol=1e-11)
                variances = np.array([*v, P[0, 0]])
                found = [*bank.plain_variance[:, 0, lane], bank.covariance.position[lane]]
                np.testing.assert_allclose(found, variances, rtol=1e-10)
                mean = weights @ expected
                np.testing.assert_allclose(model.mean(state)[axis, lane], mean, atol=1e-11)
                np.testing.assert_allclose(
                    model.covariance(state)[axis, axis, lane],
                    weights @ (variances + (expected - mean) ** 2),
                    rtol=1e-8,
                )


def test_the_steered_filter_equals_a_naive_one_and_ends_are_exact():
    lanes, steps = 5, 200
    model = make("random", outage_probability=1.0)
    actions = random_actions(model, lanes, steps, 1)
    Phi, Qd = linear_systems.van_loan(*MODEL[:2], 0.01)
    settled = loosely_coupled.steady_state_gain(0.0036, 2.0)
    x, v, P = 0.0, 0.0, np.tile(START, (lanes, 1, 1))
    for k, (seen, state) in enumerate(
        states(model, numbers(model, lanes, steps, 1), lambda k, seen: actions[k])
    ):
        a = np.clip(actions[k, 0], -1, 1)
        measured = seen.measurement
        gain = measured.available * np.where(
            a == -1, 0.0, np.where(a > 0, settled ** (1 - a), settled ** (1 + a) * 1e-5**-a)
        )
        x = measured.ins[0] - measured.increment[0] if k == 0 else x
        before = x + measured.increment[0]
        x = np.where(measured.available > 0, (1 - gain) * before + gain * measured.fix[0], before)
        v = (1 - gain) ** 2 * (v + 0.0036) + gain**2 * measured.reported_deviation**2
        np.testing.assert_allclose(model.mean(state)[0], x, atol=1e-12)
        rest = np.tile(np.eye(3), (lanes, 1, 1))
        rest[:, 0, 0] = 1 - gain
        P = rest @ (Phi @ P @ Phi.T + Qd) @ rest
        P[:, 0, 0] += gain**2 * measured.reported_deviation**2
        # What the innovations are scaled by, and what is reported: rounding over 200 steps.
        np.testing.assert_allclose(state.filter.variance.assumed[0], v, rtol=1e-12)
        np.testing.assert_allclose(model.covariance(state)[0, 0], P[:, 0, 0], rtol=1e-10)
    drawn = numbers(model, lanes, steps, 2)
    for _, state in states(model, drawn, constant(model, -1.0, lanes)):
        np.testing.assert_array_equal(model.mean(state), state.measurement.ins)
    for _, state in states(make("paper"), drawn, constant(model, 1.0, lanes)):
        np.testing.assert_array_equal(state.filter.gain, 1.0)
        np.testing.assert_allclose(model.mean(state), state.measurement.fix, atol=1e-15)


def test_scaled_noises_are_those_of_a_textbook_filter():
    """Van Loan's matrices of the scaled intensities in a plain filter of (delta, beta, eta)."""
    lanes, steps, seed = 2, 100, 0
    model = make("random", "noise", axes=2, noise_changes=(2, 2), outage_probability=1.0, noise_reach=1.0)
    drawn, actions = numbers(model, lanes, steps, seed), random_actions(model, lanes, steps, seed)
    run = list(states(model, drawn, lambda k, seen: actions[k]))
    clipped = np.clip(actions, -1, 1)
    receiver = np.where(clipped[:, 0] > 0, 100.0 ** clipped[:, 0], 10.0 ** (0.5 * clipped[:, 0]))
    coloured, white = 10.0 ** clipped[:, 1], 10.0 ** clipped[:, 2]
    for lane in range(lanes):
        error, P, before = np.zeros((3, 2)), START, MODEL[:2]
        for k, (seen, state) in enumerate(run):
            measured, R = seen.measurement, seen.measurement.reported_deviation[lane] ** 2
            scaled = loosely_coupled.error_model(
                0.6, 0.4 * math.sqrt(coloured[k, lane]), 1.0, 0.04 * white[k, lane]
            )[:2]
            Phi, Qd = linear_systems.van_loan(*before, 0.01)
            shown = Phi @ P @ Phi.T + Qd
            innovation = measured.available[lane] * (
                measured.fix[:, lane] - measured.ins[:, lane] + (Phi @ error)[0]
            )
            np.testing.assert_allclose(seen.filter.innovations.innovation[:, lane], innovation, atol=1e-11)
            np.testing.assert_allclose(seen.filter.deviation[lane] ** 2, shown[0, 0], rtol=1e-9)
            if measured.available[lane]:
                np.testing.assert_allclose(
                    seen.filter.innovations.normalised[:, lane],
                    innovation / math.sqrt(shown[0, 0] + R),
                    atol=1e-11,
                )
            Phi, Qd = linear_systems.van_loan(*scaled, 0.01)
            error, P, before = Phi @ error, Phi @ P @ Phi.T + Qd, scaled
            if measured.available[lane]:
                R = R * receiver[k, lane]
                K = P[:, 0] / (P[0, 0] + R)
                error = error - np.outer(K, innovation)
                rest = np.eye(3) - np.outer(K, [1, 0, 0])
                P = rest @ P @ rest.T + R * np.outer(K, K)
            bank = state.filter
            # Rounding over 200 steps of different but equal formulas.
            np.testing.assert_allclose(
                model.mean(state)[:, lane], measured.ins[:, lane] - error[0], atol=1e-11
            )
            np.testing.assert_allclose([bank.drift[:, lane], bank.coloured[:, lane]], error[1:], atol=1e-11)
            np.testing.assert_allclose(model.covariance(state)[..., lane], P[0, 0] * np.eye(2), rtol=1e-9)


def test_actions_and_gains_are_inverse():
    model = make("paper")
    bank = model.filter
    for gain in (0.0, 2e-5, 0.0032, 0.0415, 0.5, 1.0):
        assert float(bank.gain(bank.action_for_gain(gain))) == pytest.approx(gain, rel=1e-12)
    assert bank.gain(np.array(1.0)) == 1.0
    # The least action above -1 sets about the smallest gain.
    assert bank.gain(np.array(-1 + 1e-12)) == pytest.approx(1e-5)
    with pytest.raises(ValueError, match=r"gain must lie in \[0, 1\]"):
        FixedGain(model, 1.5)
    settled = loosely_coupled.steady_state_gain(0.0036, 2.0)
    assert bank.gain(np.array(TASK.paper_policy.action[0])) == pytest.approx(settled, rel=1e-12)
    # Where the paper's gain lies at the edge of the range, zero keeps room on both sides.
    for keywords in ({"smallest_gain": 0.5}, {"receiver_intensity": 1e-9}):
        edge = make("paper", **keywords).filter
        gains = edge.gain(np.linspace(-0.999, 1.0, 50))
        assert (np.diff(gains) > 0).all()
        np.testing.assert_allclose(edge.gain(edge.action_for_gain(gains)), gains, rtol=1e-10)
        middle = math.log(edge.gain(np.array(0.0))) / math.log(edge.parameters.smallest_gain)
        assert 0.1 - 1e-12 < middle < 0.9 + 1e-12


def signed_log(x):
    return math.copysign(math.log1p(abs(x)), x)


def test_averages_are_those_of_the_definition():
    model = make("outage")
    weight = 1 - math.exp(-0.01 / 0.25)
    mean, square, product, last = 0.0, 1.0, 0.0, 0.0
    for seen, _ in states(model, numbers(model, 1, 400, 4), constant(model, 0.4, 1)):
        measured, bank = seen.measurement, seen.filter
        if measured.available[0]:
            n = bank.innovations.innovation[0, 0] / math.sqrt(
                bank.variance.assumed[0, 0] + measured.reported_deviation[0] ** 2
            )
            mean += weight * (n - mean)
            square += weight * (n * n - square)
            product += weight * (n * last - product)
            last = n
        shown = model.observe(seen)[:, 0]
        expected = [signed_log(mean), math.log1p(square), signed_log(product)]
        np.testing.assert_allclose(shown[2:5], expected, rtol=1e-10, atol=1e-13)
        assert shown[0] == pytest.approx(signed_log(last) if measured.available[0] else 0.0, rel=1e-12)


# --- Scenarios ---------------------------------------------------------------------------------------------


def test_disturbances_stand_where_they_are_drawn():
    lanes = 400
    limits = {
        "outage": ("outage_start", "outage_duration"),
        "jamming": ("jamming_start", "jamming_duration"),
        "spoof-ramp": ("spoofing_start", "spoofing_duration"),
    }
    for name, (start, duration) in limits.items():
        model = make(name)
        uniforms, normals, rows = numbers(model, lanes, 500, 6)
        rows = [0.0 * row for row in rows]
        drawn = {"outage": "outage", "jamming": "jamming", "spoof-ramp": "spoofing"}[name]
        for k, (seen, _) in enumerate(
            states(model, (uniforms, normals, rows), constant(model, 0.0, lanes)), 1
        ):
            first, end = seen.truth.disturbances[drawn].window
            inside = (k >= first) & (k < end)
            measured = seen.measurement
            np.testing.assert_array_equal(measured.available, np.where(inside & (name == "outage"), 0.0, 1.0))
            jammed = np.where(inside & (name == "jamming"), 10.0, 1.0)
            np.testing.assert_allclose(seen.truth.deviation, math.sqrt(2) * jammed, rtol=1e-14)
            stated = model.task.world.reading_deviations(measured)[0]
            np.testing.assert_allclose([measured.reported_deviation, stated], math.sqrt(2), rtol=1e-14)
            pull = np.where(inside & (name == "spoof-ramp"), 0.02 * (k - first + 1), 0.0)
            fix = np.where(inside & (name == "outage"), 0.0, seen.truth.reference[0] + pull)
            # Sums of three numbers of up to 100 m.
            np.testing.assert_allclose(measured.fix[0], fix, atol=1e-12)
        # One row of a hundredth of a second is the rounding of start and end.
        p, windows = model.task.parameters, TASK.scenarios[name].windows
        for seconds, (low, high) in ((first, getattr(p, start)), (end - first, getattr(p, duration))):
            assert low - 0.011 <= 0.01 * seconds.min()
            assert 0.01 * seconds.max() <= high + 0.011
            assert 0.01 * np.ptp(seconds) > 0.9 * (high - low)
        if "during" in windows:
            assert (first <= windows["during"][0]).all()
            assert (end > windows["during"][1]).all()
            assert (end <= windows["after"][0]).all()


def test_random_draws_as_described_and_reports_half_of_the_changes():
    model, lanes = make("random", undisturbed=0.0), 20000
    state = model.begin(*numbers(model, lanes, 0, 8)[:2]).truth
    low, high = 10**-0.5, 10**0.5
    found = state.disturbances
    receiver, jamming, spoofing = found["noise_changes"], found["jamming"], found["spoofing"]
    intensities = receiver.true**2 / 2.0
    for lowest, drawn in ((0.05, state.drift_deviation / 0.6), *((low, values) for values in intensities)):
        assert lowest <= drawn.min() * (1 + 1e-12)
        assert drawn.max() <= high * (1 + 1e-12)
        middle, width = 0.5 * math.log(lowest * high), math.log(high / lowest)
        assert abs(np.log(drawn).mean() - middle) < 4 * width / math.sqrt(12 * lanes)
    changes = (receiver.change < 1e6).sum(axis=0)
    for count in range(3):
        assert abs((changes == count).mean() - 1 / 3) < 4 * math.sqrt(2 / 9 / lanes)
    assert (receiver.change[0] <= receiver.change[1]).all()
    silent = receiver.reported[1] == receiver.reported[0]
    assert abs(silent.mean() - 0.5) < 2 / math.sqrt(lanes)
    for each, share in ((found["outage"], 0.4), (jamming, 0.25), (spoofing, 0.25)):
        assert abs((each.window[0] < 1e6).mean() - share) < 2 / math.sqrt(lanes)
    gain, rate = 2.0 * np.log(jamming.strength), spoofing.strength
    assert math.log(3.0) <= gain.min() < math.log(3.1)
    assert math.log(290.0) < gain.max() <= math.log(300.0)
    assert -3.0 <= rate.min() < -2.9
    assert 2.9 < rate.max() < 3.0


def test_one_of_six_has_no_hidden_disturbance():
    model, lanes = make("random"), 20000
    state = model.begin(*numbers(model, lanes, 0, 8)[:2]).truth
    calm = state.drift_deviation == 0.6
    assert abs(calm.mean() - 1 / 6) < 4 * math.sqrt(5 / 36 / lanes)
    modelled = make("paper").begin(*numbers(make("paper"), 8, 0, 8)[:2]).truth
    for name in ("coloured_step", "white_step"):
        assert getattr(state, name)[calm] == pytest.approx(getattr(modelled, name)[0], rel=1e-12)
    found = state.disturbances
    levels = found["noise_changes"]
    assert (levels.true[:, calm] == levels.reported[:, calm]).all()
    assert (levels.true[:, ~calm] != levels.reported[:, ~calm]).any()
    for name in ("jamming", "spoofing"):
        assert (found[name].window[:, calm] == 1e9).all()
    four = 4 * math.sqrt(0.24 / calm.sum())
    assert abs((found["outage"].window[0, calm] < 1e9).mean() - 0.4) < four


def test_outliers_are_as_many_and_as_large_as_stated():
    model, lanes = make("outliers", horizon=50), 4000
    uniforms, normals, rows = numbers(model, lanes, 50, 8)
    state = model.begin(uniforms, normals)
    seen, rng = [], np.random.default_rng(0)
    for row in rows:
        row[3] = rng.random(lanes)
        state = model.measure(state, row)
        seen.append(state.truth.deviation)
        error = state.measurement.fix - state.truth.reference
        # The error is what is left of a position of 2 m.
        assert error[0] == pytest.approx(state.truth.deviation * row[2], abs=1e-14)
    far = np.array(seen) > 2.0
    assert abs(far.mean() - 0.05) < 4 * math.sqrt(0.05 * 0.95 / far.size)
    assert np.array(seen)[far] == pytest.approx(10.0 * math.sqrt(2.0), rel=1e-12)
    assert np.array(seen)[~far] == pytest.approx(math.sqrt(2.0), rel=1e-12)


def test_one_step_of_the_ins_error_has_the_covariance_of_van_loan():
    model = make("paper")
    # One lane for each source: beta, eta, the two noises; the step is linear in them.
    normals = np.array([[1.0, 0, 0, 0, 0], [0, 1, 0, 0, 0]])
    noise = np.array([[0.0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 0]])
    truth, _ = model.task.world.begin(Draws(np.full((20, 5), 0.5), np), normals)
    after, _ = model.task.world.advance(truth, noise, None)
    error = np.stack([(after.ins - after.reference)[0], after.drift[0], after.coloured[0]])
    Phi, Qd = linear_systems.van_loan(*MODEL[:2], 0.01)
    # The last lane has no source and stays free of error.
    np.testing.assert_array_equal(error[:, 4], 0.0)
    np.testing.assert_allclose(error[:, :2], Phi @ np.sqrt(START)[:, [1, 2]], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(error[:, 2:4] @ error[:, 2:4].T, Qd, rtol=1e-9, atol=1e-16)


# --- Contract ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("control", ["gain", "hypotheses"])
def test_what_is_shown_and_paid_does_not_depend_on_the_motion(control):
    """Otherwise an agent learns the motion by heart and reads the errors of the INS off its increments."""
    drawn, actions = numbers(make("random"), 4, 100, 5), random_actions(make("random", control), 4, 100, 5)
    model = make("random", control)
    at_rest, moving = (
        states(make("random", control, manoeuvre_acceleration=(a, a)), drawn, lambda k, s: actions[k])
        for a in (0.0, 100.0)
    )
    for (seen, acted), (same, same_acted) in zip(at_rest, moving, strict=True):
        # Hundreds of metres in double precision, 100 steps, over a noise of centimetres.
        np.testing.assert_allclose(model.observe(same), model.observe(seen), rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(model.cost(same_acted), model.cost(acted), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"white_intensity": -0.1}, "white_intensity must be a finite number at least 0"),
        ({"receiver_intensity": 0.0}, "receiver_intensity must be a finite number above 0"),
        (
            {"sampling_interval": 2.0, "duration": 1.0},
            r"at most the duration of 1\.0 s, got 2\.0",
        ),
        ({"sampling_interval": -0.01}, "sampling_interval must be a finite number above 0"),
        ({"axes": 4}, "axes must be an integer of at least 1 and at most 3"),
        ({"horizon": 0}, "horizon must be an integer"),
        ({"coloured": 0.0, "white_intensity": 0.0}, "must not both be 0"),
        ({"receiver_factor": (2.0, 1.0)}, "ascending order"),
        ({"noise_changes": (1, 3)}, "at most 2"),
        ({"unreported": 1.5}, "unreported must be"),
        ({"outage_duration": 1.5}, "outage_duration must be 2 numbers"),
        ({"fixed_drift": math.nan}, "fixed_drift must be a finite number"),
    ],
)
def test_bad_parameters_are_refused_with_the_reason(keywords, message):
    with pytest.raises(ValueError, match=message):
        LooselyCoupledNavigationParameters(**keywords)


def test_parameters_from_json_and_duration():
    assert LooselyCoupledNavigationParameters(drift_factor=[0.5, 2.0]).drift_factor == (0.5, 2.0)
    assert LooselyCoupledNavigationParameters(duration=2.0, sampling_interval=0.02).horizon == 100
    with pytest.raises(ValueError, match="control 'evidence'"):
        make_model(TASK.id, "evidence")


# --- The batched filter functions --------------------------------------------------------------------------


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("seed", range(2))
def test_the_augmented_covariance_against_matrices(request, library, seed):
    xp = np if library == "numpy" else request.getfixturevalue(library)
    rng = np.random.default_rng(seed)
    s = loosely_coupled.sampling(0.7, 0.05)
    Phi, Qd = linear_systems.van_loan(*loosely_coupled.error_model(0, 1.3, 0.7, 0.2)[:2], 0.05)
    root = rng.normal(size=(3, 3))
    P = root @ root.T
    entries = [P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2]]
    packed = loosely_coupled.AugmentedCovariance(
        *(xp.full((2,), float(x), dtype=xp.float64) for x in entries)
    )
    coloured, white = (1.3 * s.coloured) ** 2, 0.2 * 0.05 + 1.3**2 * s.residual
    predicted = loosely_coupled.predict_augmented(packed, s, coloured, white)
    R, available = xp.full((2,), 0.8, dtype=xp.float64), xp.asarray([1.0, 0.0], dtype=xp.float64)
    gain, updated = loosely_coupled.update_augmented(predicted, R, available)
    naive = Phi @ P @ Phi.T + Qd
    K = naive[:, 0] / (naive[0, 0] + 0.8)
    rest = np.eye(3) - np.outer(K, [1, 0, 0])
    joseph = rest @ naive @ rest.T + 0.8 * np.outer(K, K)
    upper = np.triu_indices(3)
    np.testing.assert_allclose([float(x[0]) for x in predicted], naive[upper], rtol=1e-11)
    np.testing.assert_allclose([float(x[0]) for x in updated], joseph[upper], rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose([float(x[1]) for x in updated], naive[upper], rtol=1e-11)
    np.testing.assert_allclose([float(x[0]) for x in gain], K, rtol=1e-11)
    np.testing.assert_array_equal([float(x[1]) for x in gain], 0.0)


def test_settled_gain_is_the_limit_of_the_recursion():
    P = 0.0
    for _ in range(2000):
        P = P + 0.0036
        gain = P / (P + 2.0)
        P = loosely_coupled.update_variance(P, 2.0, gain)
    assert loosely_coupled.steady_state_gain(0.0036, 2.0) == pytest.approx(gain, rel=1e-12)
    # At first order in the step it is K step with K = sqrt(Ge / N).
    fine = [loosely_coupled.steady_state_gain(0.36 * h, 0.02 / h) / h for h in (1e-3, 1e-4)]
    np.testing.assert_allclose(fine, math.sqrt(18), rtol=3e-3)


# --- motion and the receiver's coloured error


def test_the_motion_is_a_sum_of_sines_drawn_for_every_episode():
    lanes, steps = 40, 500
    model = make("random", axes=2)
    p = model.task.parameters
    drawn = numbers(model, lanes, steps, 21)
    first = model.begin(*drawn[:2]).truth
    sine, cosine = first.harmonics
    rate = np.arctan2(*first.turn) / p.sampling_interval
    amplitude, phase = np.hypot(sine, cosine), np.arctan2(sine, cosine)
    low, high = p.manoeuvre_rate
    assert low <= rate.min() < 1.1 * low
    assert 0.9 * high < rate.max() <= high
    acceleration = amplitude * rate**2
    assert acceleration.min() * (1 + 1e-12) >= 2.0
    assert acceleration.max() <= 10.0 * (1 + 1e-12)
    assert len(np.unique(np.round(first.reference, 9))) == first.reference.size
    path = [seen.truth.reference for seen, _ in states(model, drawn, constant(model, 0.0, lanes))]
    for k in (1, 100, steps):
        expected = (amplitude * np.sin(rate * k * p.sampling_interval + phase)).sum(axis=0)
        # Rounding of 500 rotations of up to 100 m.
        np.testing.assert_allclose(path[k - 1], expected, atol=1e-9)
    second = np.diff(np.stack(path), n=2, axis=0) / p.sampling_interval**2
    assert np.abs(second).max() <= p.manoeuvres * p.manoeuvre_acceleration[1]


def test_the_motion_of_the_paper_is_the_sine_that_it_prints():
    model = make("paper", axes=2)
    drawn = numbers(model, 3, 500, 22)
    for k, (seen, _) in enumerate(states(model, drawn, constant(model, 0.0, 3)), 1):
        angle = 0.8 * 0.01 * k + np.array([[0.0], [math.pi / 2]])
        np.testing.assert_allclose(seen.truth.reference, 2.0 * np.sin(angle) + np.zeros((2, 3)), atol=1e-12)


def test_the_coloured_error_of_the_receiver_is_first_order_and_stationary():
    lanes, steps = 4000, 60
    keywords = {"receiver_coloured": (0.7, 0.7), "receiver_correlation_time": (0.2, 0.2)}
    model = make("coloured-receiver", **keywords)
    errors = np.stack(
        [
            seen.truth.disturbances["coloured"].level[0]
            for seen, _ in states(model, numbers(model, lanes, steps, 23), constant(model, 0.0, lanes))
        ]
    )
    variance = (errors**2).mean(axis=1)
    # Four standard errors of a variance of 4000 numbers.
    assert np.abs(variance / 0.49 - 1.0).max() < 4.5 * math.sqrt(2 / lanes)
    for lag in (1, 10, 40):
        correlation = (errors[lag:] * errors[:-lag]).mean() / 0.49
        assert correlation == pytest.approx(math.exp(-lag * 0.01 / 0.2), abs=4.5 / math.sqrt(lanes))
