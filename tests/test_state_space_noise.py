"""Noise by row, smoothing, and the C of a model of one's own, against naive loops and against evaluations."""

import csv
import shutil
import subprocess

import numpy as np
import pytest
from naive import kalman_update
from own_models import simulate

import filtergym
from filtergym import Input, Sensor, read_recording
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.filter import FilterInput
from filtergym.envs.engine.backend import make_model
from filtergym.envs.engine.registration import USER_TASKS
from filtergym.evaluation.running.times import Point, ProcessorTime, front
from filtergym.exports.c_source import FLAGS, export_c
from filtergym.exports.request import request_export

MEAN, COVARIANCE = [0.0, 10.0], [[100.0, 0.0], [0.0, 25.0]]
TIMED = {
    "f": lambda x, dt: [x[0] + dt * x[1], x[1]],
    "Q": lambda dt: [[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]],
}
INPUTS = {"accuracy": Input(mean=4.0, deviation=1.0, unit="m"), "hdop": Input(mean=1.0, deviation=0.2)}
NOISES = {
    "column": ([0.0, 1.0], lambda u: u[0] ** 2, lambda x, dt, u: u[0] ** 2),
    "state": (
        [0.0, 1.0],
        lambda x, u: 1.0 + (0.01 * u[1] * x[0]) ** 2,
        lambda x, dt, u: 1.0 + (0.01 * u[1] * x[0]) ** 2,
    ),
    "interval": ([0.0, 1.0], lambda dt, u: [[u[0] ** 2 / dt]], lambda x, dt, u: u[0] ** 2 / dt),
}
"""What R of the sensor is called with, and the same of state, interval and inputs."""
COMMON = {"mean": MEAN, "covariance": COVARIANCE, "inputs": INPUTS, "units": ["m", "m/s"], **TIMED}


def sensors(R):
    return {"gps": Sensor([[1, 0]], R=R), "odo": Sensor([[0, 1]], R=0.25)}


def drawn_rows(count, seed=0):
    """Rows of interval, gps, odo, accuracy and hdop; some sensors are silent, and each row has its own noise."""
    rng = np.random.default_rng(seed)
    rows, time = [], 0.0
    for _ in range(count):
        dt = float(f"{rng.uniform(0.2, 2.0):.3f}")
        time += dt
        gps, odo = rng.normal(10.0 * time, 4.0), rng.normal(10.0, 0.5)
        rows.append(
            (
                dt,
                gps if rng.random() < 0.8 else np.nan,
                odo if rng.random() < 0.8 else np.nan,
                *rng.uniform(1, 9, 2),
            )
        )
    return rows


def naive(rows, R):
    """Kalman filter in a loop with NumPy's inverse, R of each row: means and covariances after every row, and those
    predicted, with the transition.
    """
    x, P, kept = np.array(MEAN), np.array(COVARIANCE), []
    for dt, gps, odo, *u in rows:
        F = np.array([[1.0, dt], [0.0, 1.0]])
        before = x, P
        x, P = F @ x, F @ P @ F.T + np.array(TIMED["Q"](dt))
        predicted = x, P
        x, P = kalman_update(x, P, np.array([gps, odo]) - x, np.eye(2), np.diag([R(x, dt, u), 0.25]))
        kept.append((F, before, predicted, (x, P)))
    return kept


def naive_smoother(kept):
    """Rauch, Tung and Striebel in a loop with NumPy's inverse."""
    x, P = kept[-1][3]
    found = [(x, P)]
    for F, (m, own), (predicted, Pp), _ in reversed(kept[1:]):
        G = own @ F.T @ np.linalg.inv(Pp)
        x, P = m + G @ (x - predicted), own + G @ (P - Pp) @ G.T
        found.append((x, P))
    return found[::-1]


def write(path, rows, names="time,gps,odo,accuracy,hdop", separator=","):
    time, lines = 100.0, [names]
    for dt, *cells in rows:
        time = round(time + dt, 3)
        lines.append(separator.join("" if cell != cell else repr(float(cell)) for cell in [time, *cells]))
    text = "\n".join(lines) + "\n"
    path.write_text(text if separator == "," else text.replace(".", ","), encoding="utf-8")
    return path


def of_table(rows):
    """The rows as a table gives them: the median interval stands before the first."""
    usual = float(f"{np.median([row[0] for row in rows[1:]]):.6g}")
    return [(usual, *rows[0][1:]), *rows[1:]]


@pytest.mark.parametrize("case", NOISES)
def test_noise_of_a_row_is_that_of_a_naive_loop(case, make, tmp_path):
    _, R, plain = NOISES[case]
    cls, rows = make(sensors=sensors(R)), drawn_rows(40)
    recording = read_recording(write(tmp_path / "log.csv", rows), cls.id)
    run = filtergym.evaluate(cls.id, ["kalman", "extended"], scenario=recording, tracks=True)
    expected = np.array([step[3][0] for step in naive(of_table(rows), plain)])
    for policy in ("kalman", "extended"):
        # Times are sums of the intervals; 4e-16 of 100 s is 4e-14 of an interval.
        np.testing.assert_allclose(
            run["estimate"].sel(policy=policy).values[0], expected, rtol=1e-11, atol=1e-11
        )
    filter = filtergym.online(cls.id, "extended")
    filter.start(mean=MEAN, covariance=COVARIANCE, time=0.0)
    time = 0.0
    for dt, gps, odo, accuracy, hdop in rows:
        time += dt
        estimate = filter.update(time, gps=gps, odo=odo, accuracy=accuracy, hdop=hdop)
    mean, covariance = naive(rows, plain)[-1][3]
    np.testing.assert_allclose(estimate.mean, mean, rtol=1e-11)
    np.testing.assert_allclose(estimate.covariance, covariance, rtol=1e-9, atol=1e-11)


def test_a_matrix_of_a_function_and_the_unscented_filter(make, tmp_path):
    def R(u):
        return [[u[0] ** 2, 0.1 * u[0]], [0.1 * u[0], 0.25 * u[1]]]

    cls, rows = make(h=lambda x: [x[0] + 0.0 * x[0] ** 2, x[1]], R=R, measured=["gps", "odo"]), drawn_rows(20)
    rows = [(dt, 1.0 if gps != gps else gps, 10.0 if odo != odo else odo, *u) for dt, gps, odo, *u in rows]
    x, P = np.array(MEAN), np.array(COVARIANCE)
    for dt, gps, odo, *u in of_table(rows):
        F = np.array([[1.0, dt], [0.0, 1.0]])
        x, P = F @ x, F @ P @ F.T + np.array(TIMED["Q"](dt))
        K = P @ np.linalg.inv(P + np.array(R(u)))
        x, P = x + K @ (np.array([gps, odo]) - x), P - K @ P
    recording = read_recording(write(tmp_path / "log.csv", rows), cls.id)
    run = filtergym.evaluate(cls.id, ["extended", "unscented"], scenario=recording, tracks=True)
    # Sigma points of a position beside squares of it lose some digits.
    np.testing.assert_allclose(run["estimate"].values[:, 0, -1], [x, x], rtol=1e-8)


def test_the_world_draws_with_the_noise_of_the_row(make):
    cls = make(sensors=sensors(lambda u: u[0] ** 2))
    _, kept = simulate(cls, 50, 400)
    ratios = np.array([(m.values[0] - t.state[0]) / np.abs(t.inputs[0]) for t, m, _, _ in kept])
    # 20,000 numbers of variance 1: five deviations of their mean square are 0.05.
    assert np.mean(ratios**2) == pytest.approx(1.0, abs=0.05)
    model = make_model(cls, None, backend="numpy")
    _, measurement = kept[-1][0], kept[-1][1]
    deviations = model.task.world.reading_deviations(measurement)
    np.testing.assert_array_equal(deviations[0], np.abs(measurement.inputs[0]))


def test_noise_that_cannot_be_is_refused(make, tmp_path):
    for keywords, sentence in (
        (
            {"sensors": sensors(lambda u: u[0] - 4.0)},
            r"R of the sensor 'gps' must be .*inputs up to 3 deviations",
        ),
        (
            {"sensors": sensors(lambda u: [[1.0, u[0]]])},
            r"R of the sensor 'gps' must return a matrix \(1, 1\)",
        ),
        (
            {"sensors": sensors(lambda x, dt, u, y: 1.0)},
            r"R of the sensor 'gps' may take the state, dt and u, each once",
        ),
        ({"sensors": sensors(lambda u: 1.0), "inputs": ()}, r"takes u, and there are no inputs"),
        (
            {"sensors": sensors(lambda dt: 1.0 + dt), "f": np.eye(2), "Q": np.eye(2), "inputs": ()},
            r"takes dt, and the model is not timed",
        ),
        ({"sensors": sensors(1.0)}, r"neither f, h nor R takes u"),
    ):
        with pytest.raises(ValueError, match=sentence):
            make(**keywords)
    cls = make(sensors=sensors(lambda u: u[0] ** 2))
    rows = [*drawn_rows(3), (1.0, 40.0, 10.0, 0.0, 1.0)]
    with pytest.raises(
        ValueError, match=r"R of gps must be positive definite, and in row 3, where accuracy is 0, hdop is 1"
    ):
        read_recording(write(tmp_path / "log.csv", rows), cls.id)
    silent = [*rows[:3], (1.0, np.nan, 10.0, 0.0, 1.0)]
    assert read_recording(write(tmp_path / "silent.csv", silent), cls.id).measurements["available"].shape == (
        1,
        4,
        2,
    )
    filter = filtergym.online(cls.id, "extended")
    filter.start(mean=MEAN, covariance=COVARIANCE)
    with pytest.raises(ValueError, match="R of gps must be positive definite, and with accuracy=0, hdop=1"):
        filter.update(1.0, gps=1.0, accuracy=0.0, hdop=1.0)


def test_a_column_of_noise_that_is_not_read_is_a_warning(make, tmp_path):
    cls = make(sensors=sensors(1.0), inputs=())
    rows = [row[:4] for row in drawn_rows(5)]
    loud = ("accuracy", "horizontalAccuracy", "gps_std", "HDOP", "pos_covariance")
    for name in (*loud, "mode", "acceleration", "standard"):
        notes = read_recording(write(tmp_path / "log.csv", rows, f"time,gps,odo,{name}"), cls.id).notes
        assert notes[0].startswith("WARNING: ") is (name in loud), name
        assert name.lower() in notes[0]


def test_one_column_is_two_deviations(tmp_path):
    target = "filtergym/ManeuveringTarget-v0"
    lines = [f"{4 * k},{20e3 - 150.0 * 4 * k},{5e3},{90 + k % 7}" for k in range(12)]
    (tmp_path / "one.csv").write_text("\n".join(["time,x,y,Accuracy", *lines]))
    twice = [f"{line},{line.rpartition(',')[2]}" for line in lines]
    (tmp_path / "two.csv").write_text("\n".join(["time,x,y,sigma_x,sigma_y", *twice]))
    one = read_recording(tmp_path / "one.csv", target, rename={"accuracy": ["sigma_x", "sigma_y"]})
    two = read_recording(tmp_path / "two.csv", target)
    for name, values in two.measurements.items():
        np.testing.assert_array_equal(one.measurements[name], values, err_msg=name)
    assert {one.columns["sigma_x"], one.columns["sigma_y"]} == {"accuracy"}
    with pytest.raises(ValueError, match="two columns would become sigma_x"):
        read_recording(tmp_path / "one.csv", target, rename={"accuracy": ["sigma_x", "sigma_x"]})


def test_smoothing_is_that_of_a_naive_loop(make, tmp_path):
    _, R, plain = NOISES["state"]
    cls, rows = make(sensors=sensors(R)), drawn_rows(40, seed=3)
    recording = read_recording(write(tmp_path / "log.csv", rows), cls.id)
    run = filtergym.evaluate(cls.id, ["kalman-smoother"], scenario=recording, tracks=True)
    expected = naive_smoother(naive(of_table(rows), plain))
    np.testing.assert_allclose(run["estimate"].values[0, 0], [x for x, _ in expected], rtol=1e-10, atol=1e-10)


def test_smoothing_knows_the_noise_of_inputs_and_late_measurements(make):
    cls = make(
        f=lambda x, dt, u: [x[0] + dt * x[1], x[1] + dt * u[0]],
        Q=lambda dt: [[0.01 * dt, 0.0], [0.0, 0.01 * dt]],
        inputs={"thrust": Input(deviation=1.0, noise=0.3)},
        sensors=sensors(9.0),
    )
    start, kept = simulate(cls, 30, 3, late=0.4, lateness=2)
    task = make_model(cls, None, backend="numpy", late=0.4, lateness=2).task
    smoother = problem_of(cls.id).baselines.smoothers["kalman-smoother"](task)
    measurements, states = [m for _, m, _, _ in kept], [smoother.start(start.measurement)]
    for measurement in measurements:
        states.append(smoother.update(states[-1], FilterInput(measurement)))
    means, covariances = smoother.smooth(measurements, states)
    for lane in range(3):
        x, P, steps = np.array(MEAN), np.array(COVARIANCE), []
        for k, m in enumerate(measurements):
            z, there = m.values[:, lane].copy(), m.available[:, lane] > 0.0
            if k + 2 < len(measurements):
                late = measurements[k + 2].late_available[:, lane] > 0.0
                z, there = np.where(late, measurements[k + 2].late[:, lane], z), there | late
            dt, u = m.interval[lane], m.inputs[0, lane]
            F, G = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[0.0], [dt]])
            before = x, P
            x = np.array([x[0] + dt * x[1], x[1] + dt * u])
            P = F @ P @ F.T + 0.3**2 * G @ G.T + 0.01 * dt * np.eye(2)
            predicted = x, P
            nu = np.where(there, z - x, np.nan)
            x, P = kalman_update(x, P, nu, np.eye(2), np.diag([9.0, 0.25]))
            steps.append((F, before, predicted, (x, P)))
        for k, (x, P) in enumerate(naive_smoother(steps)):
            np.testing.assert_allclose(means[:, k, lane], x, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(covariances[:, :, k, lane], P, rtol=1e-8, atol=1e-9)


C_MODELS = {
    "timed": ({"sensors": sensors(NOISES["state"][1])}, "time,gps,odo,accuracy,hdop", ","),
    "wide": ({"sensors": {"gps pos": Sensor([[1, 0]], R=lambda u: u[0] ** 2), "ödo": Sensor([[0, 1]], R=1.0)}},
             "time;gps pos;ödo;accuracy;hdop", ";"),
    "fixed": ({"f": [[1, 1], [0, 1]], "Q": np.eye(2), "sensors": sensors(lambda u: u[0] ** 2)},
              "time,gps,odo,accuracy,hdop", ","),
}  # fmt: skip


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("case", C_MODELS)
def test_exported_programs_read_the_log_of_the_model(case, make, tmp_path):
    keywords, names, separator = C_MODELS[case]
    cls, rows = make(**keywords), drawn_rows(30, seed=2)
    # Inputs begin late and hold on; of a model without time rows are whole intervals apart, with gaps.
    rows = [
        (
            (1.0 + (k % 5 == 0) if case == "fixed" else dt),
            *z,
            a if k % 3 == 1 else np.nan,
            b if k % 4 == 2 else np.nan,
        )
        for k, (dt, *z, a, b) in enumerate(rows)
    ]
    path = write(tmp_path / "log.csv", rows, names, separator)
    lines = path.read_text(encoding="utf-8").splitlines()
    if case == "timed":  # a row of each sensor at one time, and one with another value
        cells = lines[6].split(",")
        lines[6:7] = [",".join([*cells[:2], "", *cells[3:]]), ",".join([cells[0], "", cells[2], "", ""])]
        cells = lines[9].split(",")
        lines.insert(10, ",".join([cells[0], "1.0", *cells[2:]]))
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    recording = read_recording(path, cls.id)
    run = filtergym.evaluate(cls.id, ["extended"], scenario=recording, tracks=True)
    request = request_export(problem_of(cls.id), "extended", recording)
    export_c(request, tmp_path / "c")
    for program in ("log", "main"):
        flags = [*FLAGS, f"{program}.c", "extended.c", "-lm", "-o", program]
        subprocess.run(["cc", *flags], cwd=tmp_path / "c", check=True)
    done = subprocess.run([tmp_path / "c" / "log", path], capture_output=True, text=True, check=True)
    found = list(csv.DictReader(done.stdout.splitlines()))
    columns = [name for name in found[0] if name.startswith("estimate_")]
    of_rows = np.isfinite(recording.log_time[0])
    copies = [row["status"] for row in found if row["status"] in ("joined", "repeated")]
    assert copies == (["joined", "joined"] if case == "timed" else [])
    found = [row for row in found if row["status"] not in copies]
    assert of_rows.sum() == len(found) == 30
    expected = run["estimate"].values[0, 0, : len(of_rows)][of_rows]
    values = np.array([[float(row[name]) for name in columns] for row in found])
    np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-12)
    assert {row["status"] for row in found} == {"taken", "missed"}
    table = (tmp_path / "c" / "measurements.csv").read_text().splitlines()
    timed = ["interval"] * (case != "fixed")
    assert len(table[0].split(",")) == len(["recording", *timed, "gps", "odo", "accuracy", "hdop"])
    done = subprocess.run(
        [tmp_path / "c" / "main", tmp_path / "c" / "measurements.csv"], capture_output=True, check=True
    )
    last = done.stdout.decode().splitlines()[-1].split(",")
    count = int(run["seconds"].notnull().sum()) if "seconds" in run else len(of_rows)
    assert int(last[1]) == min(count, 200)
    np.testing.assert_allclose(
        [float(cell) for cell in last[5:7]], run["estimate"].values[0, 0, int(last[1]) - 1], rtol=1e-12
    )
    header = (tmp_path / "c" / "extended.h").read_text()
    assert "None" not in header
    assert ("its interval is negative" in header) is (case != "fixed")
    (tmp_path / "bad.csv").write_text(
        path.read_text(encoding="utf-8").replace(separator, "|"), encoding="utf-8"
    )
    bad = subprocess.run(
        [tmp_path / "c" / "log", tmp_path / "bad.csv"], capture_output=True, text=True, check=False
    )
    assert bad.returncode == 2
    assert bad.stderr.startswith("it lacks the column")


def test_without_the_papers_algorithm_costs_are_shown_as_they_are(make, command):
    cls = make(sensors=sensors(1.0), inputs=())
    assert cls.id in USER_TASKS
    arguments = ["evaluate", cls.id, "--episodes", "8", "--set", "horizon=20", "--policy"]
    _, shown, _ = command(*arguments, "extended")
    assert "add --policy kalman" in shown
    [row] = [line.split() for line in shown.splitlines() if line.startswith("extended")][:1]
    run = filtergym.evaluate(cls.id, ["extended"], episodes=8, horizon=20)
    assert float(row[2]) == pytest.approx(float(run["cost"].mean()), rel=0.01)


def test_a_time_below_zero_ends_no_table():
    # A short recording: the time of the world alone, which is subtracted, may have been measured longer.
    points = [
        Point("a", "policy", ProcessorTime(-3.0, True), 1.0),
        Point("b", "policy", ProcessorTime(-1.0, True), 1.0),
    ]
    assert front(points) == ["a"]
