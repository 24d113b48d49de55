"""ManeuveringTarget where scans miss the target and come early: naive recursions, closed forms, every backend."""

import math

import gymnasium as gym
import numpy as np
import pytest
from models import make_model
from naive import RANGE_SIGMA, T, episode_numbers, naive_bank, transition, variances

from filtergym.baselines.maneuvering_target.policies import AdaptiveGain, InteractingMultipleModel
from filtergym.baselines.maneuvering_target.references import KnownInputBound
from filtergym.envs.maneuvering_target.banks import AlphaBeta
from filtergym.filters import alpha_beta

ID = "filtergym/ManeuveringTarget-v0"
CONTROLS = ("evidence", "gains", "gain", "mode", "weights")
IRREGULAR = {"detection_probability": (0.5, 0.9), "scan_jitter": (0.3, 0.9), "undisturbed": 0.0}
REGULAR = {"detection_probability": (1.0, 1.0), "scan_jitter": (0.0, 0.0), "coloured_sigma": (0.0, 0.0)}
SEEN, MISSED = 0.0, 0.999
"""Uniform numbers of a scan that sees the target, and of one that does not."""


def paper_state(time):
    """True x, y, vx, vy of the paper's flight at any time: thrust in the scan periods that end with scans 50 to 55."""
    start, a = np.array([-10000.0, 5000.0, 100.0, 0.0]), -2.775
    flown = min(max(time - 49 * T, 0.0), 6 * T)
    after = max(time - 55 * T, 0.0)
    gained = a * (flown**2 / 2 + flown * after)
    return start + np.array([100.0 * time + gained, gained, a * flown, a * flown])


def paper_data(seed):
    """Start, and of every scan time, truth and measurement (None where it missed), from the documented numbers."""
    normals, (detection, jitter), rows, uniforms = episode_numbers(seed, 4, 2, 2, 2, 101)
    detection = IRREGULAR["detection_probability"][0] + 0.4 * detection
    jitter = IRREGULAR["scan_jitter"][0] + 0.6 * jitter
    begun = paper_state(0.0)
    sigma = np.sqrt(variances(*begun[:2]))
    start = begun + np.concatenate([sigma, math.sqrt(2) * sigma / T]) * normals
    scans = []
    for k in range(1, 102):
        time = T * (k - jitter * uniforms[k - 1, 1])
        truth = paper_state(time)
        z = truth[:2] + np.sqrt(variances(*truth[:2])) * rows[k - 1]
        scans.append((time, truth, z if uniforms[k - 1, 0] < detection else None))
    return start, scans


BANKS = [
    ((0.3, 0.7), ((0.95, 0.05), (0.3, 0.7)), (0.8, 0.2)),
    ((0.2, 0.5, 0.8), ((0.9, 0.08, 0.02), (0.1, 0.7, 0.2), (0.05, 0.35, 0.6)), (0.2, 0.3, 0.5)),
]
"""Gains, transition and probabilities at the start."""


def flown(control, act, seed, bank=BANKS[0], **keywords):
    """What every scan of the paper's flight shows and leads to: observation, measurement and info."""
    gains, chain, prior = bank
    env = gym.make(
        ID,
        control=control,
        scenario="paper",
        gains=gains,
        transition=chain,
        initial_probabilities=prior,
        detailed_info=True,
        **IRREGULAR,
        **keywords,
    )
    model, steps, truncated = env.unwrapped.model, [], False
    observation, _ = env.reset(seed=seed)
    while not truncated:
        measurement = env.unwrapped.fleet.only.state.measurement
        shown = observation
        observation, _, _, truncated, info = env.step(act(model, observation))
        steps.append((shown, measurement, info))
    return model, steps


@pytest.mark.parametrize("bank", BANKS)
def test_policy_of_the_paper_equals_the_imm_as_plain_filter(bank):
    seed = 0
    start, scans = paper_data(seed)
    gains, chain, prior = bank
    expected = naive_bank(start, scans, chain, prior, [gains] * len(scans))

    def act(model, observation):
        return InteractingMultipleModel(model).predict(observation)[0]

    _, steps = flown("weights", act, seed, bank)
    assert 5 < sum(z is None for *_, z in scans) < 70
    before, measured = 0.0, 0.0
    for (time, truth, z), (mean, covariance, mu), (_, m, info) in zip(scans, expected, steps, strict=False):
        np.testing.assert_allclose(m.interval[0], time - before, rtol=1e-9)
        np.testing.assert_allclose(m.elapsed[0], time - measured, rtol=1e-9)
        before, measured = time, measured if z is None else time
        assert m.available[0] == (z is not None)
        np.testing.assert_allclose(m.position[:, 0], np.zeros(2) if z is None else z, rtol=1e-10)
        np.testing.assert_allclose(
            m.variance[:, 0], RANGE_SIGMA**2 if z is None else variances(*z), rtol=1e-10
        )
        np.testing.assert_allclose(info["truth"], truth, rtol=1e-11, atol=1e-8)
        # An IMM amplifies rounding, and the observation compresses likelihoods by a logarithm.
        np.testing.assert_allclose(info["estimate"], mean, rtol=0, atol=1e-6)
        np.testing.assert_allclose(info["covariance"], covariance, rtol=1e-8, atol=1e-6)
        np.testing.assert_allclose(info["mode_probability"], mu, rtol=0, atol=1e-9)
        assert info["nis_degrees"] == (0.0 if z is None else 2.0)


@pytest.mark.parametrize("bank", BANKS)
def test_steered_gains_equal_the_imm_as_plain_filter(bank):
    """Where the scan missed the target neither the action nor the likelihood counts."""
    gains, chain, prior = bank
    rng, used = np.random.default_rng(5), []

    def act(model, observation):
        action = rng.uniform(-1.2, 1.2, len(gains))
        odds = np.array(gains) / (1.0 - np.array(gains)) * np.exp(1.5 * np.clip(action, -1.0, 1.0))
        used.append(odds / (1.0 + odds))
        return action

    start, scans = paper_data(3)
    model, steps = flown("gains", act, 3, bank, gain_logits=1.5)
    expected = naive_bank(start, scans[:100], chain, prior, used)
    for (mean, covariance, mu), (_, _, info) in zip(expected, steps, strict=True):
        np.testing.assert_allclose(info["estimate"], mean, rtol=0, atol=1e-7)
        np.testing.assert_allclose(info["covariance"], covariance, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(info["mode_probability"], mu, rtol=0, atol=1e-10)
    last = [field.name for field in model.fields].index("last_alpha_1")
    for (*_, z), alpha, (shown, *_) in zip(scans, used, steps[1:], strict=False):
        if z is not None:
            np.testing.assert_allclose(shown[last : last + len(gains)], alpha, rtol=1e-12)


def test_one_filter_equals_the_recursion_with_the_gain_over_the_elapsed_time():
    rng, used = np.random.default_rng(6), []

    def act(model, observation):
        action = rng.uniform(-1.0, 1.0, 1)
        used.append(0.5 + 0.45 * action[0])
        return action

    start, scans = paper_data(4)
    _, steps = flown("gain", act, 4, unmodelled_acceleration=0.0)
    # A bank of two equal filters is one filter.
    expected = naive_bank(start, scans[:100], *BANKS[0][1:], [(alpha, alpha) for alpha in used])
    for (_, _, z), (mean, _, _), (_, _, info) in zip(scans, expected, steps, strict=False):
        np.testing.assert_allclose(info["estimate"], mean, rtol=0, atol=1e-8)
        assert info["nis_degrees"] == (0.0 if z is None else 2.0)
    alphas = [info["alpha"] for *_, info in steps]
    held = [a == b for a, b, (_, _, z) in zip(alphas[1:], alphas, scans[1:], strict=False) if z is None]
    assert held
    assert all(held)


def rolled(control, detections, jitter=0.0, count=8, normals=0.0, scenario="random", seed=0, **keywords):
    """Episodes after each scan, before and after random actions; ``detections``: which of them see the target."""
    scans = {
        "detection_probability": (0.5, 0.5),
        "scan_jitter": (jitter, jitter),
        "undisturbed": 0.0,
        "coloured_sigma": (0.0, 0.0),
    }
    model = make_model(ID, control, scenario, **scans, **keywords)
    rng = np.random.default_rng(seed)
    noise = model.task.noise
    episode = model.begin(
        rng.random((noise.uniforms, count)), normals * rng.standard_normal((noise.initial_normals, count))
    )
    steps = [(None, episode)]
    for seen in detections:
        row = np.concatenate(
            [
                normals * rng.standard_normal((2, count)),
                np.where(seen, SEEN, MISSED) * np.ones((1, count)),
                rng.random((1, count)),
            ]
        )
        before = model.measure(steps[-1][1], row)
        space = model.action_space
        shape = (*space.shape, count)
        action = (
            rng.integers(space.n, size=shape) if control == "mode" else rng.uniform(*_limits(space), shape)
        )
        steps.append((before, model.act(before, action)))
    return model, steps


def _limits(space):
    return float(space.low.min()), float(space.high.max())


@pytest.mark.parametrize("control", CONTROLS)
def test_a_target_that_is_never_seen_is_predicted(control):
    model, steps = rolled(control, [False] * 30, 0.9, normals=1.0)
    start = steps[0][1].measurement
    time, chance = np.zeros(8), np.array([0.5, 0.5])
    x0, P0 = start.mean, start.covariance
    for before, after in steps[1:]:
        time = time + before.measurement.interval
        chance = chance @ np.array(model.task.parameters.transition)
        np.testing.assert_allclose(before.measurement.elapsed, time, rtol=1e-12)
        expected = np.concatenate([x0[:2] + time * x0[2:], x0[2:]])
        np.testing.assert_allclose(model.mean(after), expected, rtol=1e-12, atol=1e-9)
        grown = np.stack([transition(t) @ P0[..., i] @ transition(t).T for i, t in enumerate(time)], axis=-1)
        state = after.filter
        if isinstance(state, AlphaBeta):
            for axis in range(2):
                np.testing.assert_allclose(state.covariance.position[axis], grown[axis, axis], rtol=1e-12)
                np.testing.assert_allclose(state.covariance.cross[axis], grown[axis, axis + 2], rtol=1e-12)
                np.testing.assert_allclose(
                    state.covariance.velocity[axis], grown[axis + 2, axis + 2], rtol=1e-12
                )
            np.testing.assert_array_equal(state.average_excess, 0.0)
        else:
            np.testing.assert_allclose(model.covariance(after), grown, rtol=1e-12, atol=1e-6)
            np.testing.assert_allclose(state.probabilities, chance[:, None] + np.zeros(8), rtol=1e-12)
        np.testing.assert_array_equal(state.average_innovation, 0.0)
        np.testing.assert_array_equal(state.average_log_squared, 0.0)
        np.testing.assert_array_equal(state.innovation, 0.0)
        assert np.isfinite(model.observe(before)).all()


@pytest.mark.parametrize("control", CONTROLS)
def test_averages_and_gains_hold_where_the_target_is_missed(control):
    model, steps = rolled(control, [True] * 5 + [False] * 4 + [True], normals=1.0)
    seen, missed = steps[5][1].filter, steps[9][1].filter
    for name in ("average_innovation", "average_log_squared", "alpha"):
        np.testing.assert_array_equal(getattr(missed, name), getattr(seen, name))
    assert (steps[10][1].filter.average_innovation != seen.average_innovation).all()
    read = {name: model.reader(name) for name in ("available", "elapsed")}
    shown = [model.observe(before).T for before, _ in steps[1:]]
    assert [read["available"](o)[0, 0] for o in shown] == [1.0] * 5 + [0.0] * 4 + [1.0]
    elapsed = [read["elapsed"](o)[0, 0] for o in shown]
    np.testing.assert_allclose(elapsed, [1.0] * 5 + [1.0, 2.0, 3.0, 4.0, 5.0], rtol=1e-14)


@pytest.mark.parametrize("control", CONTROLS)
def test_values_of_a_missed_target_do_not_count(control):
    """Not even NaN, which a recording might hold."""
    model, steps = rolled(control, [True] * 3, normals=1.0)
    episode, before = steps[-1][1], steps[-1][0]
    missed = before.measurement._replace(available=np.zeros(8))
    answers = []
    for position in (0.0, 1e9, math.nan):
        measurement = missed._replace(position=position + np.zeros((2, 8)))
        bank = model.filter.predict(episode.filter, measurement)
        space = model.action_space
        action = np.ones(8, dtype=int) if control == "mode" else np.full((*space.shape, 8), 0.3)
        after = model.filter.act(bank, measurement, action)
        answers.append((model.filter.mean(after), model.filter.covariance(after)))
    for mean, covariance in answers:
        np.testing.assert_array_equal(mean, answers[0][0])
        np.testing.assert_array_equal(covariance, answers[0][1])
        assert np.isfinite(covariance).all()


@pytest.mark.parametrize("control", CONTROLS)
def test_a_bank_that_could_miss_the_target_is_the_same_where_it_does_not(control):
    """Bit for bit: so a recording of regular scans is replayed by either."""
    regular, other = (make_model(ID, control, **{**REGULAR, **scans}) for scans in ({}, IRREGULAR))
    rng = np.random.default_rng(2)
    noise = regular.task.noise
    assert noise.row_uniforms == 0
    assert (other.task.noise.uniforms, other.task.noise.row_uniforms) == (noise.uniforms + 2, 2)
    episode = regular.begin(rng.random((noise.uniforms, 8)), rng.standard_normal((noise.initial_normals, 8)))
    bank = other.filter.start(episode.measurement)
    for _ in range(20):
        episode = regular.measure(episode, rng.standard_normal((2, 8)))
        bank = other.filter.predict(bank, episode.measurement)
        np.testing.assert_array_equal(
            other._blocks.observe(bank, episode.measurement), regular.observe(episode)
        )
        space = regular.action_space
        action = rng.integers(2, size=8) if control == "mode" else rng.random((*space.shape, 8))
        episode = regular.act(episode, action)
        bank = other.filter.act(bank, episode.measurement, action)
        np.testing.assert_array_equal(other.filter.mean(bank), regular.mean(episode))
        np.testing.assert_array_equal(other.filter.covariance(bank), regular.covariance(episode))


def test_turns_and_thrust_are_exact_at_the_time_of_a_scan():
    """One manoeuvre from the start to the end: a circle, or a parabola."""
    model, steps = rolled(
        "gain", [True] * 60, 0.9, count=64, maneuver_count=(1, 1), maneuver_duration=(100, 100), horizon=100
    )
    start = steps[0][1].truth
    context = model.context(steps[1][0])
    turn = context["maneuver_turn"][0] / T
    turning = turn != 0.0
    assert 10 < turning.sum() < 54
    across = np.stack([-start.velocity[1], start.velocity[0]])
    centre = start.position + across / np.where(turning, turn, 1.0)
    time = np.zeros(64)
    for before, _ in steps[1:]:
        time, truth = time + before.measurement.interval, before.truth
        arm, first = truth.position - centre, start.position - centre
        c, s = np.cos(turn * time), np.sin(turn * time)
        on_circle = np.stack([c * first[0] - s * first[1], s * first[0] + c * first[1]])
        np.testing.assert_allclose(arm[:, turning], on_circle[:, turning], rtol=0, atol=1e-7)
        radius = np.hypot(*first)[turning]
        np.testing.assert_allclose(np.hypot(*arm)[turning], radius, rtol=1e-9)
        rotated = np.stack(
            [
                c * start.velocity[0] - s * start.velocity[1],
                s * start.velocity[0] + c * start.velocity[1],
            ]
        )
        np.testing.assert_allclose(truth.velocity[:, turning], rotated[:, turning], rtol=0, atol=1e-9)
        acceleration = context["maneuver_acceleration"][:, 0]
        parabola = start.position + time * start.velocity + 0.5 * time**2 * acceleration
        np.testing.assert_allclose(truth.position[:, ~turning], parabola[:, ~turning], rtol=1e-9)
        straight = start.velocity + time * acceleration
        np.testing.assert_allclose(truth.velocity[:, ~turning], straight[:, ~turning], rtol=1e-9)
        np.testing.assert_array_equal(before.measurement.position, truth.position)


def test_legs_are_flown_by_time():
    legs = {"legs": ((20.0, 0.0), (90.0, 2.0), (40.0, -1.0))}
    keywords = {"flight": "legs", "initial_velocity": (150.0, 0.0), "initial_position": (8e3, 1e3)}
    model, steps = rolled("gain", [True] * 40, 0.9, scenario="paper", **legs, **keywords)
    time = np.zeros(8)
    for before, _ in steps[1:]:
        time = time + before.measurement.interval
        angle = np.radians(2.0) * np.clip(time - 20.0, 0.0, 90.0) - np.radians(1.0) * np.clip(
            time - 110.0, 0.0, 40.0
        )
        np.testing.assert_allclose(
            before.truth.velocity, 150.0 * np.stack([np.cos(angle), np.sin(angle)]), rtol=0, atol=1e-9
        )
        turning = (time >= 20.0) & (time < 150.0)
        np.testing.assert_array_equal(model.context(before)["maneuvering"] > 0.0, turning)


def test_scans_see_the_target_as_often_and_come_as_early_as_they_should():
    scans = {"detection_probability": (0.2, 0.9), "scan_jitter": (0.1, 0.8), "undisturbed": 0.0}
    model = make_model(ID, None, "random", coloured_sigma=(0.0, 0.0), **scans)
    rng = np.random.default_rng(1)
    count, scans = 400, 90
    episode = model.begin(rng.random((model.task.noise.uniforms, count)), rng.standard_normal((4, count)))
    seen, times = [], [np.zeros(count)]
    for _ in range(scans):
        row = np.concatenate([rng.standard_normal((2, count)), rng.random((2, count))])
        episode = model.measure(episode, row)
        seen.append(episode.measurement.available)
        times.append(times[-1] + episode.measurement.interval)
    context = model.context(episode)
    probability, jitter = context["detection_probability"], context["scan_jitter"]
    for values, (low, high) in ((probability, (0.2, 0.9)), (jitter, (0.1, 0.8))):
        assert low <= values.min() < low + 0.01
        assert high - 0.01 < values.max() <= high
    error = (np.mean(seen, axis=0) - probability) / np.sqrt(probability * (1 - probability) / scans)
    assert abs(error.mean()) < 4 / math.sqrt(count)
    assert abs(error.std() - 1.0) < 0.15
    early = np.arange(scans + 1)[:, None] - np.stack(times) / T
    assert (early[1:] >= -1e-9).all()
    assert (early <= jitter + 1e-9).all()
    np.testing.assert_allclose(early[1:].mean(axis=0) / jitter, 0.5, atol=5 / math.sqrt(12 * scans))


def test_left_of_an_acceleration_that_goes_on():
    """The error of a filter without noise whose target accelerates from one measurement to after the next."""
    alpha, beta, grown, since, a = 0.4, 0.1, 7.0, 11.0, 3.0
    d = a * grown**2 / 2
    position, velocity = (1 - alpha) * d, a * grown - beta / grown * d
    position, velocity = position + since * velocity + a * since**2 / 2, velocity + a * since
    nothing = alpha_beta.Covariance(*np.zeros(3))
    left = alpha_beta.add_acceleration_error(nothing, d**2, alpha, beta, grown, since)
    np.testing.assert_allclose(left, [position**2, position * velocity, velocity**2], rtol=1e-13)


@pytest.mark.parametrize("control", ["gains", "gain"])
def test_gradients_are_finite_and_zero_where_the_target_was_missed(control):
    torch = pytest.importorskip("torch")
    env = gym.make_vec(
        ID, num_envs=8, backend="torch", control=control, horizon=25, reward="cost", **IRREGULAR
    )
    observation, _ = env.reset(seed=0)
    seen = env.unwrapped.model.columns(["available"])[0]
    actions, available, total = [], [], 0.0
    for _ in range(24):
        action = torch.full(env.action_space.shape, 0.2, dtype=torch.float64, requires_grad=True)
        actions.append(action)
        available.append(observation[:, seen].detach() > 0.0)
        observation, reward, *_ = env.step(action)
        total = total + reward.sum()
    total.backward()
    for action, there in zip(actions, available, strict=True):
        assert torch.isfinite(action.grad).all()
        assert (action.grad[~there] == 0.0).all()
        assert (action.grad[there] != 0.0).any()
    assert not torch.stack(available).all()


def test_the_ramp_waits_for_a_measurement():
    """Its gains are those of the scans that see the target; the others are no step of it."""
    env = gym.make(ID, control="gain", scenario="paper", detailed_info=True, **IRREGULAR)
    policy = AdaptiveGain(env.unwrapped.model, false_alarm_probability=1e-300)
    observation, _ = env.reset(seed=1)
    state, used, truncated = None, [], False
    while not truncated:
        seen = env.unwrapped.fleet.only.state.measurement.available[0]
        action, state = policy.predict(observation, state)
        observation, _, _, truncated, info = env.step(action)
        if seen:
            used.append(info["alpha"])
    np.testing.assert_allclose(used[:8], np.linspace(0.7, 0.3, 8), rtol=1e-12)
    np.testing.assert_allclose(used[8:], 0.3, rtol=1e-12)


def test_bound_gains_nothing_where_the_target_is_missed():
    model, steps = rolled("gain", [True, False, False, True, True, False] * 5, 0.8, normals=1.0)
    bound = KnownInputBound(model.task)
    memory = bound.start(steps[0][1].measurement, steps[0][1].truth)
    expected = np.moveaxis(memory, -1, 0)
    for before, _ in steps[1:]:
        m, truth = before.measurement, before.truth
        diagonal, memory = bound.update(memory, m, truth)
        for i in range(8):
            F = transition(m.interval[i])
            P = F @ expected[i] @ F.T
            if m.available[i]:
                information = np.zeros((4, 4))
                information[:2, :2] = np.diag(1.0 / variances(*truth.position[:, i]))
                P = np.linalg.inv(np.linalg.inv(P) + information)
            expected = np.array([*expected[:i], P, *expected[i + 1 :]])
            np.testing.assert_allclose(diagonal[:, i], np.diag(P), rtol=1e-9)


TRACK = {"flight": "track", "horizon": 2, "track": ((0.0, 1.0, 2.0, 3.0),) * 4}


@pytest.mark.parametrize(
    ("keywords", "sentence"),
    [
        ({"detection_probability": (0.0, 1.0)}, r"detection_probability\[0\] must be .* above 0"),
        ({"detection_probability": (0.5, 1.1)}, r"detection_probability\[1\] must be .*at most 1"),
        ({"detection_probability": (0.9, 0.5)}, "detection_probability must"),
        ({"scan_jitter": (-0.1, 0.5)}, r"scan_jitter\[0\] must be .* at least 0"),
        ({"scan_jitter": (0.0, 1.0)}, r"scan_jitter\[1\] must be .*below 1"),
        (
            {"scan_jitter": (0.0, 0.5), **TRACK},
            "a flight that is a table has no states between its scans, got",
        ),
    ],
)
def test_wrong_values_are_a_sentence(keywords, sentence):
    with pytest.raises(ValueError, match=sentence):
        make_model(ID, **keywords)


def test_a_table_may_be_missed():
    time = np.arange(12) * T
    states = (1e4 + 100.0 * time, 5e3 + 0.0 * time, 100.0 + 0.0 * time, 0.0 * time)
    table = {"flight": "track", "horizon": 10, "track": tuple(map(tuple, states))}
    _, steps = rolled("gain", [True, False, True], scenario="paper", **table)
    for k, (before, _) in enumerate(steps[1:], start=1):
        np.testing.assert_allclose(before.truth.position[:, 0], [1e4 + 600.0 * k, 5e3], rtol=1e-14)


def test_pictures_leave_out_what_was_missed():
    env = gym.make(
        ID,
        scenario="paper",  # one whose flights all miss scans
        render_mode="rgb_array",
        detection_probability=(0.3, 0.3),
        scan_jitter=(0.5, 0.5),
        horizon=12,
    )
    env.reset(seed=0)
    picture = env.unwrapped.model.picture()
    missed = []
    for _ in range(12):
        state = env.unwrapped.fleet.only.state
        values = picture.records(state)
        missed.append(not state.measurement.available[0])
        assert np.isnan(values["measured_x"]) == np.isnan(values["measured_y"]) == missed[-1]
        env.step(np.zeros(2))
    assert 0 < sum(missed) < 12
    assert env.render().shape[-1] == 3
