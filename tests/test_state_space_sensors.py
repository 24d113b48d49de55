"""Sensors of a state-space model by name, against naive loops and known distributions."""

import re

import numpy as np
import pytest
from naive import kalman_update
from own_models import simulate

import filtergym
from filtergym import Sensor, read_recording
from filtergym.baselines.advice import FittedLog, fit_all
from filtergym.baselines.fitted_filters import families_of
from filtergym.baselines.problem import problem_of
from filtergym.baselines.state_space import Extended
from filtergym.baselines.table import Variant
from filtergym.envs.engine.backend import make_model
from filtergym.envs.engine.scenario_choice import make_task
from filtergym.envs.linear.state_space import StateSpaceMeasurement
from filtergym.evaluation.statistics.innovations import with_innovations
from filtergym.reports.tables.advice import parameter_lines

Q = np.diag([0.1, 0.2, 0.01])
GATE = 2.0
SENSORS = {
    "gps": Sensor(
        [[1, 0, 0], [0, 1, 0]], [[4.0, 1.0], [1.0, 9.0]], interval=1.0, gate=GATE, names=("x", "y")
    ),
    "odometry": Sensor(lambda x: [x[0] * x[1]], 0.5, interval=0.2, availability=0.8),
    "compass": Sensor([[0, 0, 1]], 0.25, wraps="rad"),
}
COMMON = {
    "f": lambda x, dt: [x[0] + dt * x[1], 0.9 * x[1], x[2] + 2.0 * dt],
    "Q": lambda dt: dt * Q,
    "sensors": SENSORS,
    "mean": [1.0, 2.0, 3.0],
    "covariance": np.diag([2.0, 1.0, 0.5]),
}
R = np.zeros((4, 4))
R[:2, :2], R[2, 2], R[3, 3] = [[4.0, 1.0], [1.0, 9.0]], 0.5, 0.25
FIXED = {"f": lambda x: [x[0] + 0.2 * x[1], 0.9 * x[1], x[2] + 0.4], "Q": 0.2 * Q}


def wrapped(angle):
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def naive(x, P, rows, R=R):
    """Extended Kalman filter of rows ``(dt, z)`` with NumPy's inverse, and how often the gate closed."""
    closed = 0
    for dt, z in rows:
        F = np.array([[1.0, dt, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]])
        x, P = np.array([x[0] + dt * x[1], 0.9 * x[1], x[2] + 2.0 * dt]), F @ P @ F.T + dt * Q
        H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [x[1], x[0], 0.0], [0.0, 0.0, 1.0]])
        nu = z - np.array([x[0], x[1], x[0] * x[1], x[2]])
        nu[3] = wrapped(nu[3])
        there = np.isfinite(z)
        gps = np.flatnonzero(there[:2])
        if len(gps):
            S = (H @ P @ H.T + R)[np.ix_(gps, gps)]
            if nu[gps] @ np.linalg.inv(S) @ nu[gps] > GATE**2:
                there[:2], closed = False, closed + 1
        x, P = kalman_update(x, P, np.where(there, nu, np.nan), H, R)
    return x, P, closed


@pytest.mark.parametrize(("kind", "backend"), [({}, "numpy"), ({}, "compiled"), (FIXED, "numpy")])
def test_the_filter_takes_each_sensor_as_it_is(make, kind, backend):
    """Rates, misses, gate and turns of 8 episodes; the heading passes half a turn in each."""
    jitter = {} if kind else {"jitter": 0.5}
    start, kept = simulate(make(**kind), 15, 8, backend=backend, **jitter)
    closed, turned = 0, 0
    for lane in range(8):
        rows = [
            (
                0.2 if m.interval is None else m.interval[lane],
                np.where(m.available[:, lane] > 0.0, m.values[:, lane], np.nan),
            )
            for _, m, *_ in kept
        ]
        mean, P = start.measurement.mean[:, lane], start.measurement.covariance[:, :, lane]
        mean, P, beyond = naive(mean, P, rows)
        closed, turned = closed + beyond, turned + (mean[2] > np.pi)
        np.testing.assert_allclose(kept[-1][2][:, lane], mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(kept[-1][3][:, :, lane], P, rtol=1e-12, atol=1e-12)
    assert closed > 0
    assert turned == 8
    assert max(np.abs(m.values[3]).max() for _, m, *_ in kept) <= np.pi


def test_sensors_speak_when_they_are_due(make):
    _, kept = simulate(make(), 50, 400)
    there = np.stack([m.available for _, m, *_ in kept]) > 0.0
    assert [np.flatnonzero(there[:, place, 0]).tolist() for place in (0, 1)] == [list(range(4, 50, 5))] * 2
    assert there[:, 3].all()
    share = there[:, 2].mean()  # of 20,000, each received with 0.8
    assert abs(share - 0.8) < 4.0 * np.sqrt(0.16 / 20000)
    assert (np.stack([m.values for _, m, *_ in kept])[~there] == 0.0).all()
    _, kept = simulate(make(), 50, 8, jitter=0.9)
    time = np.cumsum([m.interval[0] for _, m, *_ in kept])
    due = [int(np.argmax(time >= k - 1e-6)) for k in range(1, int(time[-1]) + 1)]
    assert np.flatnonzero([m.available[0, 0] for _, m, *_ in kept]).tolist() == due


def test_gaps_and_a_biased_sensor_are_what_they_say(make):
    _, kept = simulate(make(), 100, 256, gaps=0.05, gap_length=4.0)
    silent = np.stack([truth.sensors.silent for truth, *_ in kept])
    begins = np.diff(silent, axis=0) > 0.0
    rate = begins.sum() / (silent[:-1] == 0.0).sum()
    np.testing.assert_allclose(rate, 0.05, atol=4.0 * np.sqrt(0.05 * 0.95 / (silent[:-1] == 0.0).sum()))
    np.testing.assert_allclose(silent.sum() / begins.sum(), 4.0, rtol=0.05)
    compass = np.stack([m.available[3] for _, m, *_ in kept])
    np.testing.assert_array_equal(compass, 1.0 - silent[:, 2])
    _, kept = simulate(make(), 2, 64, bias=3.0)
    bias = kept[0][0].sensors.bias / np.sqrt(np.diag(R))[:, None]
    # One sensor, gps with both its numbers.
    np.testing.assert_allclose(np.abs(bias[[0, 2, 3]]).sum(axis=0), 3.0)
    np.testing.assert_array_equal(bias[0], bias[1])
    assert {tuple(np.sign(one)) for one in bias[[0, 2, 3]].T} == {
        tuple(sign * unit) for sign in (1.0, -1.0) for unit in np.eye(3)
    }


def test_filters_agree(make):
    """With gaps, jitter and a biased sensor; the unscented filter where its model is linear."""
    linear = {**SENSORS, "odometry": Sensor([[0, 1, 0]], 0.5, interval=0.2)}
    cls = make(sensors=linear, hypotheses=[{"sensors": {"odometry": Sensor([[0, 1, 0]], 0.5)}}])
    names = ["kalman", "extended", "imm", "kalman-imm", "known-model"]
    assert {"rough", "noisy", "gaps", "biased", "jitter"} < {*cls.scenarios}
    rough = {"gaps": 0.1, "bias": 3.0, "jitter": 0.5}
    first, *others = filtergym.evaluate(cls.id, names, episodes=8, horizon=20, **rough).error.values
    for other in others:
        np.testing.assert_allclose(other, first, rtol=1e-9, atol=1e-9)
    curved = {**linear, "compass": Sensor(lambda x: [x[2] + 1e-12 * x[2] ** 2], 0.25, wraps="rad")}
    two = filtergym.evaluate(make(sensors=curved).id, ["extended", "unscented"], episodes=8, horizon=20)
    np.testing.assert_allclose(*two.error.values, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(*two.nis.values, rtol=1e-5, atol=1e-6)


def test_a_sensor_has_a_factor_on_its_noise(make):
    task = make_model(make(), backend="numpy").task
    factors = np.array([1.0, 4.0, 9.0])
    filter = Extended(task, 1.0, 2.0, gps_noise=0.25, compass_noise=factors)
    scaled = filter.sensor_noise(np.zeros((3, 1)), None)
    np.testing.assert_allclose(scaled[:2, :2, 1], 0.5 * R[:2, :2], rtol=1e-15)
    np.testing.assert_allclose(scaled[2, 2], 1.0, rtol=1e-15)
    np.testing.assert_allclose(scaled[3, 3], 0.5 * factors, rtol=1e-15)


def test_a_closed_gate_uses_no_measurement_and_reports_it(make):
    model = make_model(make(), "noise", backend="numpy")
    one, zero = np.ones(8), np.zeros((2, 8))
    start, _ = simulate(make(), 1, 8)
    bank = model.filter
    state = bank.start(start.measurement)
    far = StateSpaceMeasurement(
        np.stack([900.0 * one, one, 0.0 * one, 0.0 * one]), np.stack([one, one, *zero]), one
    )
    predicted = bank.predict(state, far)
    after = bank.act(predicted, far, zero)
    nothing = StateSpaceMeasurement(np.zeros((4, 8)), np.zeros((4, 8)), one)
    expected = bank.act(bank.predict(state, nothing), nothing, zero)
    np.testing.assert_allclose(after.mean, expected.mean, rtol=1e-15)
    np.testing.assert_allclose(after.covariance, expected.covariance, rtol=1e-15)
    assert (bank.records(predicted, far)["nis"] > 1e4).all()


ROWS = [(1.0, [3.1, 2.0, np.nan, 3.0]), (0.25, [np.nan, np.nan, 5.0, -2.75]), (1.0, [4.5, 1.0, 3.0, np.nan])]


def test_a_loop_of_ones_own_names_the_sensors(make):
    """Also late: what came between is taken in where it belongs."""
    id = make().id
    filter, late = filtergym.online(id, "extended"), filtergym.online(id, "extended", lag=4)
    for each in (filter, late):
        each.start(mean=COMMON["mean"], covariance=COMMON["covariance"])
    filter.update(1.0, gps=[3.1, 2.0], compass=3.0)
    filter.update(1.25, odometry=5.0, compass=-2.75)
    found = filter.update(2.25, gps_x=4.5, gps_y=1.0, odometry=3.0)
    late.update(1.0, compass=3.0)
    late.update(2.25, odometry=3.0)
    late.update(1.25, odometry=5.0, compass=-2.75)
    late.update(2.25, gps=[4.5, 1.0])
    again = late.update(1.0, gps=[3.1, 2.0])
    mean, P, closed = naive(
        np.array(COMMON["mean"]), COMMON["covariance"], [(dt, np.array(z)) for dt, z in ROWS]
    )
    assert not closed
    np.testing.assert_allclose(found.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(found.covariance, P, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(again.mean, found.mean)
    with pytest.raises(ValueError, match="gps contains gps_x already"):
        filter.update(3.0, gps=[1.0, 2.0], gps_x=1.0)
    with pytest.raises(ValueError, match=r"gps must have shape \(2,\)"):
        filter.update(3.0, gps=[1.0, 2.0, 3.0])


def test_two_sensors_of_one_time_are_taken_in_in_order(make):
    """Of a linear model that is the same as both together, but for rounding."""
    sensors = {"gps": Sensor(np.eye(3)[:2], np.eye(2)), "odometry": Sensor([[0, 1, 1]], 0.5)}
    id = make(sensors=sensors, f=lambda x, dt: [x[0] + dt * x[1], x[1], x[2]]).id
    both, one = filtergym.online(id, "kalman"), filtergym.online(id, "kalman")
    for each in (both, one):
        each.start(mean=COMMON["mean"], covariance=COMMON["covariance"])
    expected = both.update(1.0, gps=[3.0, 2.0], odometry=5.5)
    one.update(1.0, gps=[3.0, 2.0])
    found = one.update(1.0, odometry=5.5)
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-12, atol=1e-13)


def test_a_table_has_columns_named_after_the_sensors(make, tmp_path):
    cls = make()
    text = "time,gps_x,gps_y,odometry,compass\n1,3.1,2.0,,3.0\n1.25,,,5.0,-2.75\n2.25,4.5,1.0,3.0,\n"
    (tmp_path / "log.csv").write_text(text)
    recording = read_recording(tmp_path / "log.csv", cls.id, sampling_interval=1.0)
    run = filtergym.evaluate(cls.id, ["extended"], scenario=recording, tracks=True)
    rows = [(dt, np.array(z)) for dt, z in ROWS]
    mean, _, _ = naive(np.array(COMMON["mean"]), COMMON["covariance"], rows)
    last = run.isel(policy=0, episode=0, time=-1)
    np.testing.assert_allclose(last["estimate"].values.ravel(), mean, rtol=1e-12)
    found = with_innovations(run, make_task(cls, recording))["prediction_error"]
    before, _, _ = naive(np.array(COMMON["mean"]), COMMON["covariance"], rows[:1])
    np.testing.assert_allclose(found.values[0, 0, 1, 3], wrapped(-2.75 - before[2] - 0.5), rtol=1e-10)
    assert found.measured.values.tolist() == ["gps_x", "gps_y", "odometry", "compass"]
    assert found.measured_unit.values.tolist() == ["1", "1", "1", "rad"]


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"h": np.eye(3)}, "leave out h, R and measured"),
        ({"sensors": None}, "give the measurement by h and R, or by sensors"),
        ({"sensors": {}}, "sensors must name at least one"),
        ({"sensors": {"gps": np.eye(3)}}, "sensors must be a mapping from names to Sensor"),
        ({"sensors": {"gps": Sensor(np.eye(2), 1.0)}}, "h of the sensor 'gps' must be finite numbers of shape"),
        ({"sensors": {"gps": Sensor(np.eye(3), 1.0)}}, "R of the sensor 'gps' must be finite numbers of shape"),
        ({"sensors": {"gps": Sensor([[1, 0, 0]], 1.0, names=("x", "y"))}}, "the sensor 'gps' must be 1 each"),
        ({"sensors": {"process": Sensor([[1, 0, 0]], 1.0)}}, "cannot be called process or measurement"),
        ({"sampling_interval": 0.5}, "'odometry' is due every 0.2 s, and measurements are 0.5 s apart"),
        ({"filter_model": {"R": np.eye(4)}}, "filter_model can contain f, Q or sensors, got 'R'"),
        ({"filter_model": {"sensors": {"sonar": Sensor([[1, 0, 0]], 1.0)}}}, "got 'sonar'"),
    ],
)  # fmt: skip
def test_what_are_no_sensors_is_refused(make, wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        make(**wrong)


def test_what_is_no_sensor_is_refused():
    for wrong in ({"interval": 0.0}, {"availability": 0.0}, {"gate": -1.0}, {"wraps": "turns"}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} of a sensor must be"):
            Sensor([[1.0]], 1.0, **wrong)


def test_a_noise_that_the_log_does_not_tell_is_not_identifiable(make, tmp_path):
    """A compass that never speaks; the factors of the others are those of the simulation, 0.25 and 4."""
    linear = {
        "gps": Sensor([[1, 0, 0]], 4.0, interval=1.0),
        "odometry": Sensor([[0, 1, 0]], 0.5),
        "compass": Sensor([[0, 0, 1]], 0.25),
    }
    problem = problem_of(make(sensors=linear, sampling_interval=0.5).id)
    made = filtergym.record(
        problem.id, episodes=1, horizon=300, process_noise=(0.25, 0.25), measurement_noise=(4.0, 4.0)
    )
    values = np.where(made.measurements["available"][0] > 0.0, made.measurements["values"][0], np.nan)
    values[:, 2] = np.nan
    table = np.column_stack([made.seconds[0], values])
    np.savetxt(tmp_path / "log.csv", table, "%.9g", ",", header="time,gps,odometry,compass", comments="")
    log = read_recording(tmp_path / "log.csv", problem.id)
    family = families_of(problem, log)["extended"]
    tunable, fitted, intervals = fit_all(FittedLog(problem, log), family)
    text = "\n".join(parameter_lines(tunable, fitted, intervals))
    assert re.search(r"compass noise .*not identifiable, the likelihood is flat", text)
    for name, factor in (("process_noise", 0.25), ("gps_noise", 4.0), ("odometry_noise", 4.0)):
        interval = intervals[f"log10_{name}"]
        assert interval.low - 0.1 < np.log10(factor) < interval.high + 0.1


WANDERS = {"speed": np.diag([0.0, 0.04]), "drift": np.diag([0.25, 0.0])}
TURNS = np.array([[0.0, 1.0], [-0.1, -0.2]])
TWO = {
    "f": None, "Q": None, "drift": TURNS, "diffusion": WANDERS, "sensors": {"gps": Sensor([[1, 0]], 1.0)},
    "mean": [0, 0], "covariance": np.eye(2), "names": ["x", "v"], "units": (), "weights": None,
    "sampling_interval": 0.5,
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "name"), [("drift", "extended"), ("drift", "unscented"), ("timed", "kalman-imm"), ("fixed", "extended")]
)  # fmt: skip
def test_a_source_of_noise_has_a_factor_of_its_own(make, kind, name):
    """The filter with factors is the one of the model whose noises are so much larger."""
    factors, curved = {"speed": 4.0, "drift": 0.25}, lambda x: [x[0] + 0.01 * x[1] ** 2]
    given = {
        "drift": {"drift": lambda x: [x[1], -0.1 * np.sin(x[0])], "diffusion": WANDERS},
        "timed": {
            "f": lambda x, dt: [x[0] + dt * x[1], x[1]],
            "Q": {source: lambda dt, D=D: dt * D for source, D in WANDERS.items()},
        },
        "fixed": {"f": [[1, 0.5], [0, 1]], "Q": WANDERS},
    }[kind]
    noise = "diffusion" if kind == "drift" else "Q"
    scale = lambda one, k: (lambda dt: k * one(dt)) if callable(one) else k * one  # noqa: E731
    scaled = {**given, noise: {each: scale(own, factors[each]) for each, own in given[noise].items()}}
    found = []
    nothing = {"drift": None, "diffusion": None, "sensors": {"gps": Sensor(curved, 1.0)}}
    for model, further in ((given, {f"{each}_noise": k for each, k in factors.items()}), (scaled, {})):
        cls = make(**{**TWO, **nothing, **given}, filter_model={noise: model[noise]}, hypotheses=[{}])
        known = problem_of(cls.id).baselines
        limits = {"log10_speed_noise", "log10_drift_noise", "log10_measurement_noise"}
        assert {*known.tunable[name].limits} == limits
        competitor = Variant(known.estimators[name], **further)
        dataset = filtergym.evaluate(cls.id, {"one": competitor}, episodes=4, horizon=20)
        found.append(dataset.error.values)
    # Sigma points start with 1e-9 of the Q of the model more, which the two do not share.
    np.testing.assert_allclose(*found, rtol=1e-6 if name == "unscented" else 1e-9, atol=1e-12)


def test_a_log_identifies_the_noise_of_each_source(make, tmp_path):
    """Of 300 measurements: within the printed intervals of 95 %."""
    larger = {"speed": 4.0 * WANDERS["speed"], "drift": 0.25 * WANDERS["drift"]}
    sensors = {"gps": Sensor([[1, 0]], 0.01), "log": Sensor([[0, 1]], 0.01)}
    world = make(**{**TWO, "diffusion": larger, "sensors": sensors})
    made = filtergym.record(world.id, episodes=1, horizon=300)
    table = np.column_stack([made.seconds[0], made.measurements["values"][0]])
    np.savetxt(tmp_path / "log.csv", table, "%.9g", ",", header="time,gps,log", comments="")
    problem = problem_of(make(**{**TWO, "sensors": sensors}).id)
    log = read_recording(tmp_path / "log.csv", problem.id)
    _, _, intervals = fit_all(FittedLog(problem, log), families_of(problem, log)["extended"])
    for name, factor in (("speed_noise", 4.0), ("drift_noise", 0.25)):
        interval = intervals[f"log10_{name}"]
        assert interval.high - interval.low < 1.0
        assert interval.low - 0.05 < np.log10(factor) < interval.high + 0.05


def test_what_are_no_sources_is_refused(make):
    for wrong, sentence in (
        ({"diffusion": {}}, "diffusion by its sources names at least one"),
        ({"diffusion": {"gps": np.eye(2)}}, "the source of noise 'gps' must have another name"),
        ({"hypotheses": [{"diffusion": np.eye(2)}]}, "all models must name the same sources of noise"),
        ({"diffusion": {"wind": -np.eye(2)}}, "diffusion must be symmetric"),
    ):
        with pytest.raises(ValueError, match=sentence):
            make(**{**TWO, **wrong})
    task = make_model(make(), backend="numpy").task
    with pytest.raises(ValueError, match="noises are of gps, odometry, compass, got 'wind'"):
        Extended(task, wind_noise=2.0)
