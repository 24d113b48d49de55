"""The package of the documentation that registers an attitude problem: mathematics, filters, world, recordings."""

import math
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import scipy.io
import scipy.signal
from contract import assert_equals_its_vector
from filtergym.baselines import catalogue as baselines
from filtergym.envs.engine import registration
from filtergym.envs.engine.backend import make_model
from records import markdown_tables, read_record
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import filtergym

FOLDER = Path(__file__).parent.parent / "docs" / "examples"
ID = "broad/Attitude-v0"
T = 0.0035


@pytest.fixture(scope="module")
def attitude():
    """The package, registered; forgotten afterwards."""
    sys.path.insert(0, str(FOLDER))
    import attitude
    import attitude.broad

    yield attitude
    sys.path.remove(str(FOLDER))
    for name in [name for name in sys.modules if name.partition(".")[0] == "attitude"]:
        del sys.modules[name]
    for table in (registration.USER_TASKS, baselines.USER_BASELINES, gymnasium.registry):
        table.pop(ID, None)


@pytest.fixture
def rng():
    return np.random.default_rng(20)


def quaternions_of(rotations):
    """(4, N), scalar first."""
    return rotations.as_quat(scalar_first=True).T


# --- quaternions


def test_quaternions_are_those_of_scipy(attitude, rng):
    q, one, other = attitude.quaternions, Rotation.random(50, rng=rng), Rotation.random(50, rng=rng)
    product = q.multiply(quaternions_of(one), quaternions_of(other))
    same = np.abs(np.sum(product * quaternions_of(one * other), axis=0))
    np.testing.assert_allclose(same, 1.0, rtol=0, atol=1e-14)
    cosines = q.direction_cosines(quaternions_of(one))
    np.testing.assert_allclose(cosines.T.reshape(-1, 3, 3), one.as_matrix(), rtol=0, atol=1e-14)
    vector = rng.standard_normal((3, 50))
    np.testing.assert_allclose(q.to_world(cosines, vector), one.apply(vector.T).T, rtol=0, atol=1e-14)
    np.testing.assert_allclose(q.to_sensor(cosines, q.to_world(cosines, vector)), vector, rtol=0, atol=1e-14)
    rotation = np.concatenate([rng.standard_normal((3, 49)), np.zeros((3, 1))], axis=1)
    turned = q.direction_cosines(q.exponential(rotation))
    np.testing.assert_allclose(
        turned.T.reshape(-1, 3, 3), Rotation.from_rotvec(rotation.T).as_matrix(), rtol=0, atol=1e-14
    )


def test_quaternion_of_any_direction_cosines(attitude, rng):
    q = attitude.quaternions
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3))
    every = Rotation.concatenate([Rotation.random(200, rng=rng), half_turns, Rotation.identity(1)])
    found = q.quaternion_of(every.as_matrix().reshape(-1, 9).T)
    same = np.abs(np.sum(found * quaternions_of(every), axis=0))
    np.testing.assert_allclose(same, 1.0, rtol=0, atol=1e-12)


def test_angles_of_an_error_are_those_of_the_rotation_between(attitude, rng):
    """Also beyond 180 degrees of the sum, where the rotation goes the other way round."""
    q = attitude.quaternions
    heading = np.array([0.0, 1e-6, 10.0, -170.0, 179.0, 0.0, 50.0])
    inclination = np.array([0.0, 0.0, 5.0, 20.0, 0.0, 90.0, 120.0])
    axis = rng.uniform(0.0, 2.0 * np.pi, len(heading))
    tilt = Rotation.from_rotvec(
        np.radians(inclination)[:, None] * np.stack([np.cos(axis), np.sin(axis), 0.0 * axis], axis=1)
    )
    between = Rotation.from_rotvec(np.radians(heading)[:, None] * np.array([0.0, 0.0, 1.0])) * tilt
    truth = Rotation.random(len(heading), rng=rng)
    error = ((between * truth).as_matrix() - truth.as_matrix()).reshape(-1, 9).T
    total, tilted, turned = q.error_angles(error)
    # An angle is the root of a difference of numbers of order one: 1e-8 rad, in degrees, near 0 and near 180.
    np.testing.assert_allclose(total, np.degrees(between.magnitude()), rtol=0, atol=1e-5)
    np.testing.assert_allclose(tilted, inclination, rtol=0, atol=1e-5)
    np.testing.assert_allclose(turned, np.abs(heading), rtol=0, atol=1e-4)
    np.testing.assert_array_equal(q.total_angle(error), total)


def test_alignment(attitude, rng):
    q, truth = attitude.quaternions, Rotation.random(30, rng=rng)
    force = truth.inv().apply([0.0, 0.0, 9.81]).T
    field = truth.inv().apply([20.0, 0.0, -40.0]).T
    found = q.align(force, field)
    np.testing.assert_allclose(found.T.reshape(-1, 3, 3), truth.as_matrix(), rtol=0, atol=1e-13)


# --- motion


def test_motion_is_the_oscillator_of_its_equation(attitude, rng):
    motion, frequency = attitude.motion, np.array([0.1, 1.0, 4.0])
    step = motion.oscillator(frequency, T)
    for i, f in enumerate(frequency):
        w0, z = 2.0 * np.pi * f, motion.DAMPING
        F = expm(np.array([[0.0, w0], [-w0, -2.0 * z * w0]]) * T)
        np.testing.assert_allclose([[part[i] for part in step.F]], [F.ravel()], rtol=0, atol=1e-14)
        L = np.array([[step.L[0][i], 0.0], [step.L[1][i], step.L[2][i]]])
        # The variance of the position is of the order (w0 T)^3, of a difference of ones.
        np.testing.assert_allclose(L @ L.T, np.eye(2) - F @ F.T, rtol=0, atol=1e-13)
    y = rng.standard_normal((2, 3, 40_000))
    steps = motion.oscillator(np.full(40_000, 1.0), 0.05)
    for _ in range(5):
        y = motion.move(steps, y, rng.standard_normal(y.shape))
    # Five standard errors of a variance of 120,000 numbers.
    np.testing.assert_allclose(y.var(axis=(1, 2)), 1.0, rtol=0, atol=5 * np.sqrt(2.0 / 120_000))


# --- filters


def sensor_data(rng, steps):
    """Rates, forces and fields of a sensor that turns, ``(steps, 3)``, and its attitudes."""
    rate = np.cumsum(0.05 * rng.standard_normal((steps, 3)), axis=0)
    attitude = [Rotation.random(rng=rng)]
    for w in rate[:-1]:
        attitude.append(attitude[-1] * Rotation.from_rotvec(T * w))
    attitude = Rotation.concatenate(attitude)
    force = attitude.inv().apply([0.0, 0.0, 9.81]) + 0.3 * rng.standard_normal((steps, 3))
    field = attitude.inv().apply([20.0, 0.0, -40.0]) + rng.standard_normal((steps, 3))
    return rate, force, field, attitude


def rotation_of(q):
    return Rotation.from_quat(q, scalar_first=True)


def reference_field(q, m):
    h = rotation_of(q).apply(m)
    return np.array([np.hypot(h[0], h[1]), 0.0, h[2]])


def naive_madgwick(q, w, a, m, beta, scale):
    """By the definition: the gradient of half the squared misses, by central differences of the report's function."""
    a, m = a / np.linalg.norm(a), m / np.linalg.norm(m)
    b = reference_field(q, m)

    def rotate(q, d):  # (8), (24) of the report: a polynomial, also where q is not of length one
        q0, q1, q2, q3 = q
        matrix = 2.0 * np.array(
            [
                [0.5 - q2**2 - q3**2, q1 * q2 + q0 * q3, q1 * q3 - q0 * q2],
                [q1 * q2 - q0 * q3, 0.5 - q1**2 - q3**2, q0 * q1 + q2 * q3],
                [q0 * q2 + q1 * q3, q2 * q3 - q0 * q1, 0.5 - q1**2 - q2**2],
            ]
        )
        return matrix @ d

    def half_square(q):
        gravity, field = rotate(q, np.array([0.0, 0.0, 1.0])) - a, scale * rotate(q, b) - m
        return 0.5 * (gravity @ gravity + field @ field)

    step = 1e-6
    gradient = np.array(
        [(half_square(q + step * e) - half_square(q - step * e)) / (2.0 * step) for e in np.eye(4)]
    )
    turning = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
    q = q + T * (turning - beta * gradient / np.linalg.norm(gradient))
    return q / np.linalg.norm(q)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_madgwick_is_its_definition(attitude, rng, scale):
    rate, force, field, _ = sensor_data(rng, 200)
    q = naive = quaternions_of(Rotation.random(1, rng=rng))[:, 0]
    for w, a, m in zip(rate, force, field, strict=True):
        naive = naive_madgwick(naive, w, a, m, 0.3, scale)
        columns = (part[:, None] for part in (q, w, a, m))
        q = attitude.gradient_filters.madgwick_step(*columns, 0.3, T, scale)[:, 0]
    # Differences are good to 1e-10 of a gradient of order one, and each step takes 1e-3 of it.
    np.testing.assert_allclose(q, naive, rtol=0, atol=1e-9)


def test_mahony_is_its_definition(attitude, rng):
    rate, force, field, _ = sensor_data(rng, 200)
    q, bias = quaternions_of(Rotation.random(1, rng=rng)), np.zeros((3, 1))
    naive, naive_bias = rotation_of(q[:, 0]), np.zeros(3)
    for w, a, m in zip(rate, force, field, strict=True):
        a, m = a / np.linalg.norm(a), m / np.linalg.norm(m)
        b = reference_field(naive.as_quat(scalar_first=True), m)
        down, north = np.cross(a, naive.inv().apply([0.0, 0.0, 1.0])), np.cross(m, naive.inv().apply(b))
        naive_bias = naive_bias - 0.2 * T * (down + north)
        naive = naive * Rotation.from_rotvec(T * (w - naive_bias + 1.5 * down + 0.7 * north))
        q, bias = attitude.gradient_filters.mahony_step(
            q, bias, *(part[:, None] for part in (w, a, m)), (1.5, 0.7, 0.2), T
        )
    assert (naive.inv() * rotation_of(q[:, 0])).magnitude() < 1e-12
    np.testing.assert_allclose(bias[:, 0], naive_bias, rtol=0, atol=1e-13)


def test_low_pass_filter_is_butterworths(attitude, rng):
    vqf, tau = attitude.vqf, 0.5
    b, a = scipy.signal.butter(2, math.sqrt(2.0) / (2.0 * math.pi * tau), fs=1.0 / T)
    values = rng.standard_normal((600, 2))
    expected = scipy.signal.lfilter(b, a, values, axis=0)
    state = vqf.settled_low_pass(np.zeros((1, 2)))
    for value, smoothed in zip(values, expected, strict=True):
        found, state = vqf.low_pass(state, value[None], tau, T)
        np.testing.assert_allclose(found[0], smoothed, rtol=0, atol=1e-13)
    # In the beginning a mean, and then from its steady state on.
    state = vqf.start_low_pass(np.zeros((1, 2)))
    early = math.ceil(tau / T) - 1  # the last value before which less than tau has gone by
    for k, value in enumerate(values[: early + 1]):
        found, state = vqf.low_pass(state, value[None], tau, T)
        np.testing.assert_allclose(found[0], values[: k + 1].mean(axis=0), rtol=0, atol=1e-13)
    zi = scipy.signal.lfilter_zi(b, a)[:, None] * values[: early + 1].mean(axis=0)
    expected, _ = scipy.signal.lfilter(b, a, values[early + 1 :], axis=0, zi=zi)
    for value, smoothed in zip(values[early + 1 :], expected, strict=True):
        found, state = vqf.low_pass(state, value[None], tau, T)
        np.testing.assert_allclose(found[0], smoothed, rtol=0, atol=1e-12)


def test_bias_update_is_the_kalman_filter_of_all_axes_at_once(attitude, rng):
    """At rest the measurement is the smoothed rate; three scalar updates are one of three."""
    vqf = attitude.vqf
    A = rng.standard_normal((3, 3))
    P = (0.2 * vqf.DEGREE) ** 2 * (A @ A.T + np.eye(3)) / 10.0
    bias = vqf.DEGREE * np.array([0.3, -0.2, 0.1])
    q = np.array([[1.0], [0.0], [0.0], [0.0]])
    state = vqf.start_vqf(q).bias
    state = state._replace(
        bias=bias[:, None], covariance=P[:, :, None], rest=np.array([vqf.REST_TIME]),
        rate=vqf.settled_low_pass(np.zeros((3, 1))), force=vqf.settled_low_pass(np.array([[0.0], [0.0], [9.81]])),
    )  # fmt: skip
    up, identity = np.array([[0.0], [0.0], [1.0]]), np.eye(3).reshape(9, 1)
    found = vqf._bias_step(state, np.zeros((3, 1)), 9.81 * up, up, identity, T, 3.0)
    growth = (0.1 * vqf.DEGREE) ** 2 * T / vqf.BIAS_FORGETTING_TIME
    R = np.eye(3) * (vqf.BIAS_SIGMA_REST**4 / growth + vqf.BIAS_SIGMA_REST**2)
    predicted = P + growth * np.diag((np.diag(P) < vqf.BIAS_SIGMA**2).astype(float))
    K = predicted @ np.linalg.inv(predicted + R)
    np.testing.assert_allclose(found.bias[:, 0], bias - K @ bias, rtol=1e-12)
    np.testing.assert_allclose(found.covariance[..., 0], predicted - K @ predicted, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize(("bias", "rejection"), [(False, False), (True, False), (True, True)])
def test_vqf_of_its_authors(attitude, rng, bias, rejection):
    """Where the package vqf is installed: the same attitude to rounding, with rest, motion and a disturbed field."""
    peer = pytest.importorskip("vqf")
    rate, force, field, _ = sensor_data(rng, 2500)
    still = sensor_data(rng, 1)
    rest = [still[i] + 0.001 * rng.standard_normal((1000, 3)) for i in range(3)]
    rest[0] = rest[0] - still[0] + 0.004
    rate, force, field = (np.concatenate([a, b]) for a, b in zip(rest, (rate, force, field), strict=True))
    field[2000:3000] += [30.0, 0.0, 0.0]
    options = {"restBiasEstEnabled": bias, "motionBiasEstEnabled": bias, "magDistRejectionEnabled": rejection}
    expected = peer.VQF(T, **options).updateBatch(rate, force, field)["quat9D"]
    state = attitude.vqf.start_vqf(np.array([[1.0], [0.0], [0.0], [0.0]]), bias, rejection)
    worst = 0.0
    for w, a, m, q in zip(rate, force, field, expected, strict=True):
        state = attitude.vqf.vqf_step(state, w[:, None], a[:, None], m[:, None], T)
        own = rotation_of(attitude.vqf.vqf_attitude(state)[:, 0])
        east_north_up = Rotation.from_euler("z", 90.0, degrees=True) * own
        worst = max(worst, (rotation_of(q).inv() * east_north_up).magnitude())
    assert worst < 1e-9


def test_filters_converge_from_a_wrong_start_at_rest(attitude, rng):
    filters, vqf, q = attitude.gradient_filters, attitude.vqf, attitude.quaternions
    truth = Rotation.random(8, rng=rng)
    force, field = truth.inv().apply([0.0, 0.0, 9.81]).T, truth.inv().apply([20.0, 0.0, -40.0]).T
    wrong = quaternions_of(Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (8, 3))) * truth)
    one, two, bias, state = (
        wrong,
        wrong,
        np.zeros((3, 8)),
        vqf.start_vqf(wrong, rejection=False, settled=True),
    )
    zero, interval = np.zeros((3, 8)), 0.02
    for _ in range(2_100):
        one = filters.madgwick_step(one, zero, force, field, 0.1, interval)
        two, bias = filters.mahony_step(two, bias, zero, force, field, (2.0, 2.0, 0.0), interval)
        state = vqf.vqf_step(state, zero, force, field, interval)
    true = truth.as_matrix().reshape(-1, 9).T
    for found in (one, two, vqf.vqf_attitude(state)):
        # A normalised gradient does not get nearer than its step, 2 beta T = 0.2 deg. The others decay exponentially,
        # VQF's heading by exp(-42 s / 9 s) of at most 50 deg.
        assert q.total_angle(q.direction_cosines(found) - true).max() < 0.5


# --- the problem


def test_environment(attitude):
    assert_equals_its_vector(ID, [np.full(1, 0.3 * k) for k in range(3)], horizon=120)


@pytest.mark.parametrize("control", ["gain", "gains", "time_constants"])
def test_compiled_steps_are_those_of_numpy(attitude, control):
    pytest.importorskip("llvmlite")
    one = gymnasium.make_vec(ID, num_envs=8, horizon=400, control=control, backend="numpy")
    other = gymnasium.make_vec(ID, num_envs=8, horizon=400, control=control, backend="compiled")
    shown, _ = one.reset(seed=1)
    # Sines and roots differ in the last bit; the filters forget it.
    np.testing.assert_allclose(other.reset(seed=1)[0], shown, rtol=1e-9, atol=1e-9)
    for k in range(10):
        action = np.full(one.action_space.shape, 0.1 * (k - 5))
        shown, reward, *_ = one.step(action)
        compiled, paid, *_ = other.step(action)
        np.testing.assert_allclose(compiled, shown, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(paid, reward, rtol=1e-7, atol=1e-9)


def test_zero_action_is_the_published_filter(attitude):
    """The bank of every control, fed with measurements alone, is the filter's own loop."""
    for control in ("gain", "gains", "time_constants"):
        model = make_model(attitude.Attitude, control, horizon=40)
        rng = np.random.default_rng(3)
        noise = model.task.noise
        episode = model.begin(
            rng.random((noise.uniforms, 8)), rng.standard_normal((noise.initial_normals, 8))
        )
        q, bias = episode.measurement.quaternion, np.zeros((3, 8))
        state = attitude.vqf.start_vqf(q, settled=True)
        for _ in range(20):
            episode = model.measure(episode, rng.standard_normal((noise.normals, 8)))
            m = episode.measurement
            episode = model.act(episode, np.zeros((*model.action_space.shape, 8)))
            if control == "gain":
                q = attitude.gradient_filters.madgwick_step(q, *m, 0.1, T)
            elif control == "gains":
                q, bias = attitude.gradient_filters.mahony_step(q, bias, *m, (0.5, 0.5, 0.0), T)
            else:
                state = attitude.vqf.vqf_step(state, *m, T)
                q = attitude.vqf.vqf_attitude(state)
        np.testing.assert_allclose(
            model.mean(episode), attitude.quaternions.direction_cosines(q), rtol=0, atol=1e-12
        )


def test_world_measures_what_is(attitude):
    """Without errors of the sensors the rates turn one true attitude into the next, and gravity and field are found."""
    quiet = dict.fromkeys(
        ("gyroscope_bias", "gyroscope_scale", "accelerometer_bias", "magnet_probability"), 0.0
    )
    faint = dict.fromkeys(("gyroscope_sigma", "accelerometer_sigma", "magnetometer_sigma"), 1e-9)
    model = make_model(
        attitude.Attitude, horizon=40, first_rests=(0.0, 0.0), break_probability=0.0, **quiet, **faint
    )
    rng, noise, world = np.random.default_rng(5), model.task.noise, model.task.world
    episode = model.begin(rng.random((noise.uniforms, 8)), rng.standard_normal((noise.initial_normals, 8)))
    moved = 0.0
    for _ in range(300):
        before = Rotation.from_quat(episode.truth.attitude.T, scalar_first=True)
        episode = model.measure(episode, rng.standard_normal((noise.normals, 8)))
        truth, m = episode.truth, episode.measurement
        after = Rotation.from_quat(truth.attitude.T, scalar_first=True)
        turned = before * Rotation.from_rotvec(T * m.rate.T)
        assert (turned.inv() * after).magnitude().max() < 1e-9
        force = after.apply(m.force.T).T - world.acceleration(truth)
        np.testing.assert_allclose(force, np.tile([[0.0], [0.0], [9.81]], 8), rtol=0, atol=1e-7)
        np.testing.assert_allclose(
            after.apply(m.field.T).T - world.disturbance(truth), truth.earth, rtol=0, atol=1e-7
        )
        moved += np.linalg.norm(m.rate, axis=0)
    assert (moved > 0.0).all()


def test_costs_are_in_order(attitude):
    dataset = filtergym.evaluate(
        ID, ["madgwick", "mahony", "vqf", "vqf-basic", "undisturbed"], episodes=32, horizon=2000
    )
    cost = dataset["cost"].mean("time")
    reference, others = cost.sel(policy="undisturbed"), cost.drop_sel(policy="undisturbed")
    assert float((reference - others.min("policy")).mean()) < 0.0
    np.testing.assert_allclose(dataset["total_angle"] ** 2, dataset["cost"], rtol=1e-9)
    assert (dataset["inclination_angle"] <= dataset["total_angle"] + 1e-6).all()


# --- recordings


def write_trial(path, samples=300, lost=slice(120, 130)):
    """A trial as BROAD stores one, of a sensor that turns about the vertical; half of it is movement."""
    turning = np.linspace(0.0, 1.0, samples)
    truth = Rotation.from_rotvec(np.outer(turning, [0.0, 0.0, 1.0])) * Rotation.from_rotvec(
        [0.3, 0.0, 0.0]
    )  # east, north, up
    true = truth.as_quat(scalar_first=True)
    true[lost] = np.nan
    movement = (np.arange(samples) >= samples // 2 - 50).astype(np.uint8)
    rate = np.concatenate([[np.zeros(3)], (truth[:-1].inv() * truth[1:]).as_rotvec() / T])
    scipy.io.savemat(
        path,
        {
            "imu_gyr": rate, "imu_acc": truth.inv().apply([0.0, 0.0, 9.81]),
            "imu_mag": truth.inv().apply([0.0, 20.0, -40.0]), "opt_quat": true,
            "movement": movement[:, None], "sampling_rate": np.array([[1.0 / T]]),
        },
    )  # fmt: skip
    return truth, movement


def test_trials_of_broad(attitude, tmp_path):
    names = ("01_slow_A", "02_slow_B")
    write_trial(tmp_path / "01_slow_A.mat")
    write_trial(tmp_path / "02_slow_B.mat", samples=350)
    recording = attitude.broad.read_trials([tmp_path / f"{name}.mat" for name in names])
    found = filtergym.evaluate(ID, ["madgwick", "vqf"], scenario=recording)
    angle = found["total_angle"].values
    judged = np.isfinite(angle[0])
    # The last decision of forty measurements must be whole: 280 and 320.
    assert judged[0].sum() == 280 - 100 - 10
    assert judged[1].sum() == 320 - 125 - 5
    # North is where the field points, so a perfect start stays near the truth.
    assert np.nanmax(angle) < 1.0
    scipy.io.savemat(tmp_path / "03_other.mat", {"imu_gyr": np.zeros((3, 3))})
    with pytest.raises(ValueError, match="lacks imu_acc"):
        attitude.broad.read_trial(tmp_path / "03_other.mat")


@pytest.mark.parametrize("results", ["broad", "simulated"])
def test_records_are_what_was_measured(results):
    """The records that the page renders are the tables of the files of results."""
    root = FOLDER.parent.parent
    done = subprocess.run(
        [sys.executable, "benchmarks/attitude.py", "--render", f"docs/data/attitude_{results}.csv"],
        capture_output=True, text=True, cwd=root, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    [table] = markdown_tables(done.stdout)
    assert table == read_record(f"attitude_{results}").data


def test_command_line_finds_the_package_in_the_working_directory():
    arguments = ["evaluate", f"attitude:{ID}", "--policy", "madgwick", "--policy", "undisturbed"]
    done = subprocess.run(
        [sys.executable, "-m", "filtergym", *arguments, "--episodes", "8", "--set", "horizon=400"],
        capture_output=True, text=True, cwd=FOLDER, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "undisturbed" in done.stdout
