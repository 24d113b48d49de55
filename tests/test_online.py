"""A filter in a loop of one's own gives what an evaluation gives, whatever it is."""

import pickle
import runpy
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from own_models import forget

import filtergym
from filtergym.baselines.problem import import_problem
from filtergym.envs.contract.model import Episode
from filtergym.envs.contract.task import named_arrays
from filtergym.envs.engine.backend import make_model
from filtergym.envs.logs.reading import read_recording
from filtergym.evaluation.competitors.kinds import kind_of
from filtergym.evaluation.competitors.online_state import History
from filtergym.evaluation.running.evaluate import control_of
from filtergym.evaluation.running.rollout import run_competitor, start_lanes
from filtergym.names import find_competitor

RADAR, LOOSE = "filtergym/ManeuveringTarget-v0", "filtergym/LooselyCoupledNavigation-v0"
ESM, UAV = "filtergym/RadarEsmTracking-v0", "filtergym/UavAutopilot-v0"
TIGHT = "filtergym/TightlyCoupledNavigation-v0"
STATE, COVARIANCE = [1e4, 2e4, -200.0, 50.0], np.diag([1e4, 1e4, 400.0, 400.0])


def with_measurement(model, episode):
    return {"estimate": model.mean(episode), **dict(named_arrays(episode.measurement))}


@pytest.mark.parametrize(
    ("id", "name", "options"),
    [
        (RADAR, "imm", {}),
        (RADAR, "kalman-imm-turn-tuned", {}),
        (RADAR, "kalman-net", {}),
        (RADAR, "bptt", {"decision_interval": 3}),
        (LOOSE, "innovation-adaptive", {"decision_interval": 5}),
        (UAV, "sage-husa", {}),
        pytest.param(TIGHT, "nis-adaptive", {}, marks=pytest.mark.slow),
    ],
)
def test_the_same_measurements_give_the_same_bits(id, name, options, monkeypatch):
    problem, count, seeds = import_problem(id), 30, [3, 4, 5]
    maker = find_competitor(problem, name).maker
    keywords = {"horizon": count, **getattr(maker, "task_keywords", {}), **options}
    kind = kind_of(maker)
    control = control_of(maker, None, problem.task, name)
    model = make_model(problem.task, control, backend="auto", **keywords)
    flown = run_competitor(model, maker, kind, seeds, with_measurement)
    begun = []
    start_lanes(model, seeds, begun.append)
    filter = filtergym.online(id, name, tracks=3, regular=True, **keywords)

    def start(time, given):
        return map_leaves(lambda array: array[..., :3], begun[0].measurement), {"time": time, "k": 0}

    def measure(memory, time, values):
        arrays = iter(dict(named_arrays(filter.input.measurement)))
        k = memory["k"]
        measured = map_leaves(
            lambda _: np.moveaxis(flown[next(arrays)][:, k], 0, -1), filter.input.measurement
        )
        return measured, {"time": time, "k": k + 1}

    monkeypatch.setattr(filter.input, "start", start)
    monkeypatch.setattr(filter.input, "measure", measure)
    filter.start()
    for k in range(count):
        if k == 7:
            ahead = filter.predict(100.0)
            saved = pickle.loads(pickle.dumps(filter.save()))
            filter.update(101.0)
            filter.restore(saved)
        estimate = filter.update(float(k + 1))
        np.testing.assert_array_equal(estimate.mean.T, flown["estimate"][:, k], err_msg=f"measurement {k}")
        if k == 7:
            np.testing.assert_array_equal(ahead.mean, estimate.mean)


def map_leaves(function, part):
    if part is None:  # what only recordings hold
        return None
    return type(part)(*(map_leaves(function, p) for p in part)) if isinstance(part, tuple) else function(part)


ODOMETRY = "odometry_speed", "odometry_heading"
LOGS = {
    RADAR: (
        "time,x,y,sigma_x,sigma_y\n"
        "0,1000,2000,30,20\n4,1200,2050,30,20\n8,1410,2090,30,25\n12,,,,\n17,1800,2200,30,20\n20,2010,2260,20,20\n",
        ("x", "y", "sigma_x", "sigma_y"),
        2,
    ),
    f"{RADAR} polar": (
        "time,range,azimuth\n0,20000,30\n4,20300,30.5\n8,20600,31.1\n12,20900,31.5\n16.5,21250,32\n",
        ("range", "azimuth"),
        2,
    ),
    f"{RADAR} odometry": (
        "time,x,y,sigma_x,sigma_y,odometry_speed,odometry_heading\n"
        "0,1000,2000,30,20,20,80\n4,1200,2050,30,20,21,82\n8,1410,2090,30,25,20,85\n12,1600,2100,30,25,,\n"
        "16,1810,2110,30,25,20,84\n20,2010,2160,20,20,20,80\n24,2200,2150,20,20,19,82\n",
        ("x", "y", "sigma_x", "sigma_y", *ODOMETRY),
        2,
    ),
    ESM: (
        "time,range,range_rate,decision,radar_bearing,esm_bearing\n"
        "0,30000,-200,1,10,9.5\n2,29600,-201,,10,\n4,29210,-199,0,359.5,0.4\n6,28800,-198,2,3,3.2\n",
        ("range", "range_rate", "decision", "radar_bearing", "esm_bearing"),
        1,
    ),
    LOOSE: (
        "time,ins,fix,sigma\n0,1.5,1.0,1\n0.01,1.6,1.2,1\n0.02,1.7,,1\n0.03,1.9,1.1,2\n0.04,2.1,1.6,1\n",
        ("ins", "fix", "sigma"),
        1,
    ),
}


@pytest.mark.parametrize("case", LOGS)
def test_rows_that_come_one_by_one_make_the_measurements_of_their_log(case, tmp_path):
    id = case.split(" ")[0]
    text, names, begun = LOGS[case]
    path = tmp_path / "log.csv"
    path.write_text(text)
    recording = read_recording(path, id)
    rows = np.genfromtxt(path, delimiter=",", names=True)
    has_odometry = "odometry" in case
    filter = filtergym.online(
        id, import_problem(id).paper, second_sensor=has_odometry, **recording.parameters
    )
    first = {name: rows[name][0] for name in names}
    mean, covariance = (recording.initial[name][0] for name in ("mean", "covariance"))
    also = {name: rows[name][1] for name in ODOMETRY} if has_odometry else first if id == ESM else {}
    filter.start(mean, covariance, rows["time"][begun - 1], **also)
    for k, row in enumerate(rows[begun:]):
        measurement, _ = filter.input.measure(
            filter._running().input, float(row["time"]), {name: row[name] for name in names}
        )
        for name, array in named_arrays(filter._received_of(measurement, np.array([0]))):
            expected = recording.measurements[name][0, k]
            assert array[..., 0].dtype == expected.dtype or expected.dtype.kind in "fi"
            np.testing.assert_array_equal(array[..., 0], expected, err_msg=name)
        filter.update(row["time"], **{name: row[name] for name in names})


def test_a_radar_track_in_plain_words():
    filter = filtergym.online(RADAR, "kalman-imm-turn", sampling_interval=4.0)
    filter.start(STATE, COVARIANCE, time=100.0)
    first = filter.update(104.0, x=9.2e3, y=20.2e3)
    assert first.names[0] == "position_x"
    assert first.units[2] == "m/s"
    assert first.time == 104.0
    assert first["position_x"] == first.mean[0] == pytest.approx(9.2e3, abs=100.0)
    np.testing.assert_allclose(first.sigma**2, np.diag(first.covariance))
    assert first.nis > 0.0
    assert first.nis_degrees == 2.0
    assert np.isfinite(first.log_likelihood)
    assert str(first).startswith("position_x 9")
    assert " m/s" in str(first)
    missed = filter.update()
    assert missed.time == 108.0
    assert np.isnan(missed.nis)
    assert missed.sigma[0] > first.sigma[0]
    late = filter.update(
        115.5, range=float(np.hypot(6.8e3, 20.8e3)), azimuth=np.degrees(np.arctan2(6.8, 20.8))
    )
    assert late["position_x"] == pytest.approx(6.8e3, abs=300.0)
    assert "update takes x (m, east of the radar)" in repr(filter)


def test_tracks_start_anew_alone():
    def feed(filter, count, first=0):
        return [
            filter.update(
                4.0 * (k + 1),
                x=np.array([1e4, 3e4]) - 800.0 * k,
                y=np.array([2e4, np.nan if k == 2 else 1e4]) + 210.0 * k,
            )
            for k in range(first, count)
        ][-1]

    for name in ("bptt", "kalman-imm-turn"):
        both = filtergym.online(RADAR, name, tracks=2)
        start = np.array([STATE, [3e4, 1e4, -200.0, 50.0]]).T
        both.start(start, np.repeat(COVARIANCE[:, :, None], 2, axis=2))
        feed(both, 5)
        both.start(start, np.repeat(COVARIANCE[:, :, None], 2, axis=2), time=20.0, tracks=[1])
        last = feed(both, 9, 5)
        kept = filtergym.online(RADAR, name, tracks=2)
        kept.start(start, np.repeat(COVARIANCE[:, :, None], 2, axis=2))
        np.testing.assert_array_equal(feed(kept, 9).mean[:, 0], last.mean[:, 0])
        anew = filtergym.online(RADAR, name, tracks=2)
        anew.start(start, np.repeat(COVARIANCE[:, :, None], 2, axis=2), time=20.0)
        np.testing.assert_array_equal(feed(anew, 9, 5).mean[:, 1], last.mean[:, 1])


def values_of(filter, k):
    """What the sensors of a filter say at measurement k, of one track."""
    rng = np.random.default_rng(k)
    if filter.task.id == RADAR:
        return {} if k == 3 else {"x": 1e4 - 800.0 * k + 100.0 * rng.normal(), "y": 2e4 + 200.0 * k}
    if filter.task.id == LOOSE:
        return {"ins": [0.1 * k], "sigma": 1.0 + k, **({"fix": [0.1 * k + rng.normal()]} if k % 2 else {})}
    if filter.task.id == ESM:
        heard = {"decision": k % 3, "bearing_difference": rng.normal()} if k % 2 else {}
        return {"range": 3e4 - 400.0 * k + 30.0 * rng.normal(), "range_rate": -200.0, **heard}
    measured = filter.input.measurement
    if filter.task.id == UAV:
        reading = np.where(k == 4, np.nan, 0.01 * rng.normal(size=measured.reading.shape[0]))
        return {"reading": reading, "command": 0.01, "control": 0.02 * rng.normal()}
    if filter.task.id == TIGHT:
        of_sensors = {sensor.name: measured.readings[sensor.readings, 0] for sensor in filter.task.sensors}
        others = set(filter.input.values) - set(of_sensors)
        return {**of_sensors, **{name: getattr(measured, name)[..., 0] for name in others}}
    return {} if k == 3 else {"values": [10.0 * k + rng.normal()]}


@pytest.fixture
def own_model():
    yield filtergym.state_space(
        "tests/Live-v0", f=[[1, 1.0], [0, 1]], h=[[1, 0]], Q=[[0.25, 0.5], [0.5, 1.0]], R=[[25.0]],
        mean=[0, 10], covariance=[[100, 0], [0, 25]],
    )  # fmt: skip
    forget("tests/Live-v0")


OF_ALL_KINDS = [
    (RADAR, "imm"), (RADAR, "kalman-imm"), (RADAR, "bptt"), (RADAR, "kalman-net"), (LOOSE, "plain-reduced"),
    (ESM, "quasi-optimal"), (UAV, "kalman"), (TIGHT, "multi-hypothesis"), ("tests/Live-v0", "kalman"),
    ("tests/Live-v0", "extended"),
]  # fmt: skip
"""Policies, estimators, agents, in all problems and in a model of one's own."""


def begin(filter):
    initial = filter.input.initial
    given = {name: array[..., 0] for name, array in initial._asdict().items() if name != "first"}
    if filter.task.id == RADAR:
        given = {"mean": STATE, "covariance": COVARIANCE}
    if filter.task.id == ESM:
        given = {"range": 3e4, "range_rate": -200.0}
    filter.start(**given)
    return filter.input.start(0.0, given)[0]


@pytest.mark.parametrize(("id", "name"), OF_ALL_KINDS)
def test_one_native_call_is_the_functions_of_the_model_one_after_another(own_model, id, name):
    filter = filtergym.online(id, name)
    model = filter.model.on_numpy()
    memory, asked = None, kind_of(find_competitor(import_problem(id), name).maker) == "policy"
    state = model.start_filter(map_leaves(lambda array: np.repeat(array, 8, axis=-1), begin(filter)))
    own = filtergym.make_policy(id, name) if asked else None
    for k in range(8):
        values = values_of(filter, k)
        time = filter._time_of(None)
        measured = filter._received_of(
            filter.input.measure(filter._running().input, time, values)[0], [0] * 8
        )
        estimate = filter.update(**values)
        state = model.predict_filter(state, measured)
        action = np.zeros((8, *(model.action_space.shape or ())))
        if asked and k % model.task.decision_interval == 0:
            shown = model.observe(Episode((), measured, state)).T
            action, memory = own.policy.predict(shown, memory, np.full(8, k == 0))
        state = model.update_filter(state, measured, np.asarray(action).T)
        mean, covariance = model.filter.mean(state)[..., 0], model.filter.covariance(state)[..., 0]
        # Functions of libm and the order in products of matrices differ in compiled code.
        np.testing.assert_allclose(estimate.mean, mean, 1e-9, 1e-9 * np.abs(mean).max())
        np.testing.assert_allclose(estimate.covariance, covariance, 1e-9, 1e-9 * np.abs(covariance).max())


@pytest.mark.parametrize(("id", "name"), OF_ALL_KINDS)
def test_estimates_are_the_callers_own_and_one_track_is_as_one_of_many(own_model, id, name):
    one, many = filtergym.online(id, name), filtergym.online(id, name, tracks=3)
    begin(one)
    repeat = lambda array: np.repeat(np.asarray(array)[..., None], 3, axis=-1)  # noqa: E731
    many.restore(one.save()._replace(owner=many._owner, **{
        "input": {n: repeat(v) for n, v in one.save().input.items()}, "fresh": np.ones(3, dtype=bool),
    }))  # fmt: skip
    found, kept = [], []
    for k in range(6):
        values = values_of(one, k)
        found.append(one.update(**values))
        kept.append((found[-1].mean.copy(), found[-1].covariance.copy()))
        others = many.update(**{name: repeat(value) for name, value in values.items()})
        np.testing.assert_array_equal(others.mean, repeat(found[-1].mean))
        np.testing.assert_array_equal(others.covariance, repeat(found[-1].covariance))
        assert found[-1].lost == ""
    for estimate, (mean, covariance) in zip(found, kept, strict=True):
        np.testing.assert_array_equal(estimate.mean, mean)
        np.testing.assert_array_equal(estimate.covariance, covariance)
    found[-1].mean[:], found[-1].covariance[:] = 0.0, 0.0
    again = filtergym.online(id, name)
    again.restore(one.save())
    values = values_of(one, 6)
    np.testing.assert_array_equal(one.update(**values).mean, again.update(**values).mean)


class Last:
    """The last plot; it counts in the object, so that it runs in Python."""

    kind = "estimator"

    def start(self, initial, N):
        return {"mean": initial.mean.copy(), "plots": 0}

    def update(self, memory, measurement):
        memory["plots"] += 1
        seen = ~np.isnan(measurement.position)
        memory["mean"][:2] = np.where(seen, measurement.position, memory["mean"][:2])
        covariance = np.repeat(np.diag([1e4, 1e4, 1e2, 1e2])[:, :, None], measurement.scan.shape[0], axis=2)
        return memory["mean"] + memory["plots"] * np.array([0, 0, 1.0, 0])[:, None], covariance, memory


def test_a_users_own_runs_is_saved_and_restored():
    filter = filtergym.online(RADAR, Last)
    filter.start(STATE, COVARIANCE)
    assert filter.update(5.0, x=1.0, y=2.0).mean.tolist() == [1.0, 2.0, -199.0, 50.0]
    saved = filter.save()
    assert filter.predict(10.0).mean.tolist() == [1.0, 2.0, -198.0, 50.0]
    assert filter.update(10.0, x=3.0, y=4.0).mean.tolist() == [3.0, 4.0, -198.0, 50.0]
    filter.restore(saved)
    assert filter.update(10.0).mean.tolist() == [1.0, 2.0, -198.0, 50.0]
    with pytest.raises(ValueError, match="cannot restart single tracks"):
        filter.start(STATE, COVARIANCE, tracks=[0])


def test_an_agent_reports_measurements_unlike_its_training():
    filter = filtergym.online(RADAR, "bptt", sampling_interval=5.0)
    filter.start(STATE, COVARIANCE)
    rng = np.random.default_rng(1)
    for k in range(40):
        x, y = 1e4 - 1000.0 * (k + 1) + 100.0 * rng.normal(), 2e4 + 250.0 * (k + 1) + 100.0 * rng.normal()
        sentence = filter.update(x=x, y=y).departure
    assert sentence == ""
    for _ in range(40):
        sentence = filter.update(x=x, y=y, sigma_x=0.5, sigma_y=0.5).departure
    assert "lie outside the range of its training" in sentence
    filter.start(STATE, COVARIANCE)
    assert filter.update(x=9e3, y=2e4).departure == ""


def test_the_example_of_the_page_prints_its_comments(capsys):
    docs = Path(__file__).parent.parent / "docs"
    runpy.run_path(str(docs / "examples" / "live_track.py"))
    assert capsys.readouterr().out in (docs / "live.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda f: f.start(STATE), "needs covariance at the start, finite, got mean="),
        (lambda f: f.start(STATE[:3], COVARIANCE), r"mean must have shape \(4,\), got \(3,\)"),
        (lambda f: f.start(STATE, COVARIANCE[0, 0]), r"covariance must have shape \(4, 4\), got \(\)"),
        (lambda f: f.start(STATE, COVARIANCE, position=3), "unknown value 'position'"),
        (lambda f: f.start(STATE, COVARIANCE, time=np.nan), "time must be finite seconds"),
        (lambda f: f.update(1.0, X=1.0), r"unknown value 'X': .* takes x \(m, east"),
        (lambda f: f.update(-1.0, x=1.0, y=2.0), "time must increase: the last measurement was at 0.0 s"),
        (lambda f: f.update(x="east", y=2.0), "x must be numbers, got 'east'"),
        (lambda f: f.update(x=[1.0, 2.0], y=2.0), r"x must have shape \(\), got \(2,\)"),
    ],
)
def test_wrong_values_are_refused(call, sentence):
    filter = filtergym.online(RADAR, "imm")
    with pytest.raises(ValueError, match="has not been started: call start first"):
        filter.update(x=1.0, y=2.0)
    filter.start(STATE, COVARIANCE)
    with pytest.raises(ValueError, match=sentence):
        call(filter)


def test_what_cannot_run_ahead_is_refused():
    for name in ("kalman-smoother", "known-turn"):
        with pytest.raises(ValueError, match=r"is of kind (smoother|reference) and cannot run online"):
            filtergym.online(RADAR, name)


def test_a_misspelt_name_of_an_array_is_refused(monkeypatch):
    monkeypatch.setattr(import_problem(UAV).task, "companions", ())
    filter = filtergym.online(UAV, "kalman")
    states = len(filter.names)
    filter.start(np.zeros(states), np.eye(states), command=0.0)
    with pytest.raises(ValueError, match=r"unknown value 'readings': .* takes reading \(shape \(3,\)\)"):
        filter.update(readings=np.zeros(3), command=0.0, control=0.0)


def test_missing_needs_of_an_environment_are_named():
    filter = filtergym.online(LOOSE, "plain-reduced")
    filter.start([0.0], [[0.0]])
    filter.update(ins=0.1, fix=0.2)
    with pytest.raises(ValueError, match="needs ins at every measurement"):
        filter.update(fix=0.2)
    with pytest.raises(ValueError, match="sigma is a standard deviation, above zero, and track 0 has -1"):
        filter.update(ins=0.1, fix=0.2, sigma=-1.0)
    esm = filtergym.online(ESM, "quasi-optimal")
    with pytest.raises(ValueError, match="needs range, range_rate at every scan"):
        esm.start(range=3e4)
    esm.start(range=3e4, range_rate=-200.0)
    with pytest.raises(ValueError, match="emitter type from 0 to"):
        esm.update(range=3e4, range_rate=-200.0, decision=7)
    with pytest.raises(ValueError, match="a decision needs radar_bearing"):
        esm.update(range=3e4, range_rate=-200.0, decision=1)
    assert esm.update(range=3e4, range_rate=-200.0, decision=1, bearing_difference=0.4).time > 0.0
    uav = filtergym.online(UAV, "kalman")
    sensors, states = uav.input.measurement.reading.shape[0], len(uav.names)
    uav.start(np.zeros(states), np.eye(states))
    held = uav.update(reading=np.full(sensors, np.nan), command=1.0, control=0.0)
    assert np.isfinite(held.mean).all()
    with pytest.raises(ValueError, match="needs command at every measurement"):
        uav.update(reading=np.zeros(sensors), control=0.0)


# --- late measurements


def plots(count, seed=0):
    """Times and values of plots of a target that drives past, some of them missed."""
    rng = np.random.default_rng(seed)
    time = 4.0 * np.arange(1, count + 1) + rng.uniform(-1.0, 1.0, count)
    x, y = 1e4 - 200.0 * time + rng.normal(0, 100, count), 2e4 + 50.0 * time + rng.normal(0, 100, count)
    return [
        (t, {} if k % 7 == 5 else {"x": a, "y": b})
        for k, (t, a, b) in enumerate(zip(time, x, y, strict=True))
    ]


def out_of_order(rows, lag, seed=0):
    """The same rows, each after at most ``lag`` of those that are newer."""
    delayed = np.arange(len(rows)) + np.random.default_rng(seed).uniform(0.0, lag, len(rows))
    return [rows[i] for i in np.argsort(delayed, kind="stable")]


@pytest.mark.parametrize(
    ("name", "lag"),
    [("imm", 4), ("semi-markov-vague", timedelta(seconds=24.0)), ("bptt", 4), ("kalman-net", 4), (Last, 4)],
)
def test_late_measurements_are_taken_in_as_if_they_had_come_in_time(name, lag):
    """The filter is saved between two measurements and goes on elsewhere; its buffer goes along."""
    rows = plots(30)
    late = out_of_order(rows, 4)
    assert [t for t, _ in late] != sorted(t for t, _ in late)
    ordered = filtergym.online(RADAR, name, sampling_interval=4.0)
    ordered.start(STATE, COVARIANCE)
    for time, values in rows:
        expected = ordered.update(time, **values)
    filter, other = (filtergym.online(RADAR, name, sampling_interval=4.0, lag=lag) for _ in range(2))
    filter.start(STATE, COVARIANCE)
    newest = 0.0
    for k, (time, values) in enumerate(late):
        newest = max(newest, time)
        assert filter.update(time, **values).time == newest
        if k == 12:
            saved, filter = pickle.loads(pickle.dumps(filter.save())), other
            filter.restore(saved)
    found = filter.update(newest + 4.0)
    expected = ordered.update(newest + 4.0)
    np.testing.assert_array_equal(found.mean, expected.mean)
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    assert filter.too_late == 0


@pytest.mark.parametrize(("lag", "kept"), [(3, 3), (timedelta(seconds=9.0), 3)])
def test_what_is_older_than_the_buffer_is_counted_and_refused(lag, kept):
    filter = filtergym.online(RADAR, "imm", sampling_interval=4.0, lag=lag)
    filter.start(STATE, COVARIANCE)
    sizes = []
    for k in range(1, 30):
        filter.update(4.0 * k, x=1e4 - 800.0 * k, y=2e4)
        sizes.append(len(pickle.dumps(filter.save())))
    assert len(filter.save().history.taken) == kept
    assert max(sizes[kept:]) - min(sizes[kept:]) < 200
    before = filter.predict().mean
    for count in (1, 2):
        message = rf"of 50.0 s comes too late: .* until 104.0 s are final; {count} were"
        with pytest.raises(ValueError, match=message):
            filter.update(50.0, x=0.0, y=0.0)
        assert filter.too_late == filter.save().too_late == count
    np.testing.assert_array_equal(filter.predict().mean, before)
    with pytest.raises(ValueError, match="time must increase"):
        filter.predict(110.0)
    filter.start(STATE, COVARIANCE)
    assert filter.too_late == 0
    with pytest.raises(ValueError, match=r"until 0.0 s are final"):
        filter.update(0.0, x=0.0, y=0.0)


def test_a_late_measurement_that_cannot_be_leaves_the_filter_as_it_was():
    filter = filtergym.online(RADAR, "kalman-imm-turn", sampling_interval=4.0, lag=5)
    filter.start(STATE, COVARIANCE)
    for k in range(1, 5):
        filter.update(4.0 * k, x=1e4 - 800.0 * k, y=2e4)
    saved, before = filter.save(), filter.predict().mean
    for values, sentence in (
        ({"x": "east", "y": 0.0}, "x must be numbers"),
        ({"z": 1.0}, "unknown value 'z'"),
    ):
        with pytest.raises(ValueError, match=sentence):
            filter.update(9.0, **values)
    with pytest.raises(ValueError, match="apart"):
        filter.update(12.0 - 1e-9, x=0.0, y=0.0)
    np.testing.assert_array_equal(filter.predict().mean, before)
    assert len(filter.save().history.taken) == len(saved.history.taken) == 4
    filter.update(10.0, x=8e3, y=2e4)
    assert not np.array_equal(filter.predict(20.0).mean, before)
    filter.restore(saved)
    np.testing.assert_array_equal(filter.predict().mean, before)


def test_what_comes_late_for_a_time_supplies_what_was_missing_then():
    ordered, filter = (
        filtergym.online(LOOSE, "plain-reduced"),
        filtergym.online(LOOSE, "plain-reduced", lag=5),
    )
    for each in (ordered, filter):
        each.start([0.0], [[0.0]])
    fixes = [None, 0.25, None, 0.45]
    for k, fix in enumerate(fixes, 1):
        expected = ordered.update(0.1 * k, ins=0.1 * k, fix=fix)
        filter.update(0.1 * k, ins=0.1 * k)
    filter.update(0.1 * 4, fix=0.45)
    found = filter.update(0.1 * 2, fix=0.25)
    np.testing.assert_array_equal(found.mean, expected.mean)
    with pytest.raises(ValueError, match="time must increase"):
        filter.update(0.1 * 2, fix=0.3)  # it has another fix of that time


def test_fixes_of_one_time_are_fused_also_when_they_come_late():
    ordered, filter = (
        filtergym.online(RADAR, "kalman-imm-turn", sampling_interval=4.0, lag=n) for n in (0, 5)
    )
    rows = [(4.0, 9.2e3), (8.0, 8.3e3), (8.0, 8.5e3), (12.0, 7.6e3)]
    last = []
    for each, order in ((ordered, rows), (filter, [rows[i] for i in (0, 1, 3, 2)])):
        each.start(STATE, COVARIANCE)
        last.append([each.update(time, x=x, y=2e4) for time, x in order][-1])
    np.testing.assert_array_equal(last[0].mean, last[1].mean)


def test_late_measurements_of_several_tracks():
    filter = filtergym.online(RADAR, "imm", tracks=2, sampling_interval=4.0, lag=5)
    filter.start(np.array([STATE, STATE]).T, np.stack([COVARIANCE, COVARIANCE], axis=2))
    for time in (4.0, 8.0, 16.0):
        filter.update(time, x=[1e4, 1e4], y=[2e4, 2e4])
    with pytest.raises(ValueError, match=r"late for all of them alike, got \[12.0, 20.0\]"):
        filter.update([12.0, 20.0], x=[1e4, 1e4], y=[2e4, 2e4])
    filter.update([12.0, 12.5], x=[1e4, 1e4], y=[2e4, 2e4])
    filter.start(
        np.array([STATE, STATE]).T, np.stack([COVARIANCE, COVARIANCE], axis=2), time=16.0, tracks=[1]
    )
    with pytest.raises(ValueError, match="too late"):
        filter.update(13.0, x=[1e4, 1e4], y=[2e4, 2e4])


@pytest.mark.parametrize("lag", [-1, 2.5, True, "2 s", timedelta(seconds=-1.0)])
def test_a_lag_is_a_number_of_measurements_or_a_time(lag):
    with pytest.raises(ValueError, match="lag must"):
        filtergym.online(RADAR, "imm", lag=lag)


@pytest.mark.parametrize("name", ["imm", "bptt"])
def test_fixes_too_near_in_time_are_no_speed(name):
    """Noise in a fix makes at most ten times the speed that it makes after a sampling interval."""
    filter = filtergym.online(RADAR, name, sampling_interval=4.0)
    filter.start(STATE, COVARIANCE)
    before = filter.update(4.0, x=9.2e3, y=2.02e4)
    for later in (1e-6, 0.1, 0.399):
        with pytest.raises(ValueError, match=r"at least 0.4 s apart, got .* gains of .* are made for 4 s"):
            filter.update(4.0 + later, x=9.2e3, y=2.02e4)

    def moved(interval):
        noise = np.array([150.0, -150.0])
        x, y = before.mean[:2] + interval * before.mean[2:] + noise
        return np.hypot(*(filter.predict(4.0 + interval, x=x, y=y).mean - before.mean)[2:])

    assert moved(0.4) < 10.5 * moved(4.0)


# --- careless callers


def test_an_initial_covariance_is_one():
    message = "the initial covariance must be symmetric and positive definite, got"
    upper = COVARIANCE + np.triu(np.full((4, 4), 50.0), 1)
    for covariance in (-COVARIANCE, 0.0 * COVARIANCE, upper, np.ones((4, 4))):
        with pytest.raises(ValueError, match=message):
            filtergym.online(RADAR, "kalman-imm-turn").start(STATE, covariance)
    many = filtergym.online(RADAR, "imm", tracks=2)
    both = np.stack([COVARIANCE, -COVARIANCE], axis=2)
    with pytest.raises(ValueError, match="the initial covariance of track 1 must be symmetric"):
        many.start(np.array([STATE, STATE]).T, both)
    known = filtergym.online(LOOSE, "plain-reduced")
    known.start([0.0], [[0.0]])  # which is how an episode begins there
    with pytest.raises(ValueError, match=message):
        known.start([0.0], [[-1.0]])


def test_a_state_goes_back_to_the_filter_that_it_is_of():
    filter = filtergym.online(RADAR, "imm")
    filter.start(STATE, COVARIANCE)
    other = filtergym.online(RADAR, "kalman-imm-turn")
    for wrong in (5, None, "x", ()):
        with pytest.raises(ValueError, match="restore takes a state that save has returned, got"):
            filter.restore(wrong)
    with pytest.raises(
        ValueError, match=r"this state is of .*, imm, 1 track, .* and the filter is .*kalman-imm-turn"
    ):
        other.restore(filter.save())
    with pytest.raises(ValueError, match="2 tracks"):
        filtergym.online(RADAR, "imm", tracks=2).restore(filter.save())
    with pytest.raises(TypeError, match="a running filter cannot be copied or pickled: make another"):
        pickle.dumps(filter)
    filter.restore(pickle.loads(pickle.dumps(filter.save())))


def test_a_number_is_no_vector_of_equal_ones_and_one_of_each_track_no_vector():
    filter, axes = filtergym.online(LOOSE, "plain-reduced", tracks=2, axes=3), 3
    filter.start(np.zeros(axes), np.eye(axes))
    for wrong in (5.0, [1.0, 2.0], np.zeros((axes, 3))):
        with pytest.raises(ValueError, match=r"ins must have shape \(3,\), or \(..., 2\) for 2 tracks, got"):
            filter.update(ins=wrong)
    filter.update(ins=np.zeros(axes))
    filter.update(ins=np.zeros((axes, 2)))


FORGED = {
    "filter": [None, 5, (), np.zeros(3)],
    "input": [None, 5, {}, {"time": np.zeros(1)}, {"time": np.full(1, np.nan), "count": np.zeros(1)}],
    "fresh": [None, "x", np.ones(7, dtype=bool)],
    "measurements": [None, -1, "x", 1.5],
    "too_late": [None, "x"],
    "history": [None, (), 5],
}


@pytest.mark.parametrize("name", ["kalman-imm-turn", "bptt"])
def test_a_forged_state_is_refused_in_a_sentence_and_the_filter_goes_on(name):
    filter, other = (filtergym.online(RADAR, name, lag=3) for _ in range(2))
    for each in (filter, other):
        each.start(STATE, COVARIANCE)
        each.update(10.0, x=20310.0, y=30640.0)
    saved = filter.save()
    taken = saved.history.taken[0]
    histories = [History((one,)) for one in (None, 5, taken._replace(before=None), taken._replace(time="x"))]
    parts = {**FORGED, "history": [*FORGED["history"], *histories]}
    if name == "bptt":
        parts |= {"policy": [5, "x"]}
    for part, values in parts.items():
        for value in values:
            with pytest.raises(
                ValueError, match="cannot continue from this state, which is not one that save"
            ):
                filter.restore(saved._replace(**{part: value}))
    one, two = (each.update(20.0, x=20200.0, y=30700.0) for each in (filter, other))
    np.testing.assert_array_equal(one.mean, two.mean)
    np.testing.assert_array_equal(one.covariance, two.covariance)


def test_wrong_arguments_get_one_sentence():
    filter = filtergym.online(RADAR, "imm")
    filter.start(STATE, COVARIANCE)
    for value in (10**400, "x", object(), 1j, np.inf, -np.inf, [], {}, [[1.0, 2.0]]):
        with pytest.raises(ValueError, match=r"x must (be|have)") as error:
            filter.update(4.0, x=value, y=1e4)
        assert len(str(error.value)) < 200
        with pytest.raises(ValueError, match=r"time must be (numbers|finite seconds)"):
            filter.update(value, x=1e4, y=1e4)
        with pytest.raises(ValueError, match=r"mean must (be|have)"):
            filter.start(value, COVARIANCE)
        with pytest.raises(ValueError, match=r"tracks are numbers from 0 to 0|cannot start"):
            filter.start(STATE, COVARIANCE, tracks=value if value is not np.inf else "x")
        with pytest.raises(ValueError, match=r"time must be|each of the two|values are given"):
            filter.start_from({"time": value, "x": 1e4, "y": 2e4}, value)
    with pytest.raises(ValueError, match="each of the two measurements needs its time"):
        filter.start_from({"time": 0.0, "x": 1e4, "y": 2e4}, {"x": 1e4, "y": 2e4})
    for what in ("regular", "control", "backend", "tracks"):
        with pytest.raises(ValueError, match=f"{what}"):
            filtergym.online(RADAR, "imm", **{what: np.eye(2)})
    filter.update(4.0, x=1e4, y=2e4)
    with pytest.raises(ValueError, match=r"measurements of .*ManeuveringTarget-v0 are at least .* s apart"):
        filter.update(4.0 + 1e-9, x=1e4, y=2e4)


def test_policies_and_agents_say_where_they_are_lost():
    filter = filtergym.online(RADAR, "imm", tracks=2)
    filter.start(np.array([STATE, STATE]).T, np.stack([COVARIANCE, COVARIANCE], axis=2))
    estimate = filter.update(4.0, x=[1e4, 1e4], y=[2e4, 2e4])
    assert estimate.lost == estimate.departure == ["", ""]
    saved = filter.save()
    signs = np.where(np.arange(saved.filter.covariance.shape[-1]) == 1, -1e3, 1.0)
    filter.restore(saved._replace(filter=saved.filter._replace(covariance=signs * saved.filter.covariance)))
    broken = filter.update(8.0, x=[1e4, 1e4], y=[2e4, 2e4])
    assert broken.lost == ["", "the covariance is not positive definite"]


def test_times_since_1970_are_of_the_unit_that_they_must_have():
    """As in a recording; a nanosecond more or less is beyond the digits of seconds since 1970."""
    start, mean, covariance = 1_403_715_273_262_142_976, [21e3, 30.5e3, -180.0, 40.0], 1600.0 * np.eye(4)

    def run(times):
        filter = filtergym.online("filtergym/ManeuveringTarget-v0", "kalman-imm-turn")
        filter.start(mean, covariance, time=times[0])
        return [filter.update(time, x=21e3 - 720 * k, y=30.5e3) for k, time in enumerate(times[1:], 1)]

    nanoseconds = [start + 4_000_000_000 * k for k in range(4)]
    expected = run([4.0 * k for k in range(4)])
    for unit in (1, 10**3, 10**6, 10**9):
        found = run([ns // unit if unit < 10**9 else ns / 1e9 for ns in nanoseconds])
        for one, other in zip(found, expected, strict=True):
            # Milliseconds cut up to 0.9 ms of 4 s off, and the target flies 180 m/s.
            np.testing.assert_allclose(one.mean, other.mean, atol=0.5 if unit == 10**6 else 1e-3)
    filter = filtergym.online("filtergym/ManeuveringTarget-v0", "kalman-imm-turn")
    filter.start(mean, covariance)
    with pytest.raises(
        ValueError, match=r"counts from 1970, but the last one, 0\.0 s, does not: start the track"
    ):
        filter.update(start, x=21e3, y=30.5e3)
