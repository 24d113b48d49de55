"""Angles of a state: errors, costs, smoothing and files use the shortest difference, against naive loops."""

import warnings

import numpy as np
import pytest

import filtergym
from filtergym import Sensor
from filtergym.filters.angles import shorten, unwrap

UNITS = {"rad": 1.0, "deg": 180.0 / np.pi}


def wrap(angle, begin=-np.pi):
    return (angle - begin) % (2.0 * np.pi) + begin


def turning(unit="rad", h=None, f=None, **keywords):
    """A heading and its rate, with a compass and a gyroscope."""
    scale = UNITS[unit]
    return {
        "f": f or (lambda x, dt: [x[0] + dt * x[1], x[1]]),
        "Q": lambda dt: [[1e-5 * scale**2 * dt, 0.0], [0.0, 1e-3 * scale**2 * dt]],
        "sensors": {
            "compass": Sensor(h or [[1, 0]], R=0.01 * scale**2, wraps=unit),
            "gyro": Sensor([[0, 1]], R=4e-4 * scale**2),
        },
        "mean": [0.0, 0.2 * scale],
        "covariance": np.diag([0.05, 0.01]) * scale**2,
        "names": ["heading", "rate"],
        "units": [unit, f"{unit}/s"],
        "sampling_interval": 0.1,
        **keywords,
    }


def write(path, unit, truth, rows=400):
    """A log of a heading that makes several turns, with a true heading in some form; and the naive filter's errors."""
    scale, rng, dt = UNITS[unit], np.random.default_rng(3), 0.1
    time = dt * np.arange(rows)
    rate = 0.6 + 0.3 * np.sin(time / 5.0)
    heading = np.cumsum(rate * dt)
    compass, gyro = wrap(heading + rng.normal(0.0, 0.1, rows)), rate + rng.normal(0.0, 0.02, rows)
    table = np.column_stack([time, compass * scale, gyro * scale, truth(heading) * scale, rate * scale])
    np.savetxt(path, table, "%.17g", ",", header="time,compass,gyro,truth_heading,truth_rate", comments="")
    x, P, errors, nees = np.array([0.0, 0.2]), np.diag([0.05, 0.01]), [], []
    R = np.diag([0.01, 4e-4])
    for k in range(rows):
        step = dt if k else 0.1
        F = np.array([[1.0, step], [0.0, 1.0]])
        x, P = F @ x, F @ P @ F.T + np.diag([1e-5, 1e-3]) * step
        nu = np.array([wrap(compass[k] - x[0]), gyro[k] - x[1]])
        K = P @ np.linalg.inv(P + R)
        x, P = x + K @ nu, (np.eye(2) - K) @ P
        error = np.array([wrap(x[0] - heading[k]), x[1] - rate[k]])
        errors.append(error * scale)
        nees.append(error @ np.linalg.inv(P) @ error)
    return np.array(errors), np.array(nees)


FORMS = {
    "unwrapped": lambda heading: heading,
    "plus and minus half a turn": wrap,
    "from zero to a turn": lambda heading: wrap(heading, 0.0),
    "five turns off": lambda heading: heading - 10.0 * np.pi,
    "another turn in every row": lambda heading: heading + 2.0 * np.pi * (np.arange(len(heading)) % 7),
}


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("form", FORMS)
def test_a_truth_on_any_turn_scores_as_the_naive_filter(make, tmp_path, unit, form):
    cls = make(**turning(unit))
    expected, nees = write(tmp_path / "log.csv", unit, FORMS[form])
    recording = filtergym.read_recording(tmp_path / "log.csv", cls.id)
    found = filtergym.evaluate(cls.id, ["extended", "unscented"], scenario=recording)
    for policy in (0, 1):
        error = found["error"].values[policy, 0]
        # Sums of some turns in degrees round at 1e-13, and both filters in another order.
        np.testing.assert_allclose(error, expected[-len(error) :], rtol=1e-8, atol=1e-9 * UNITS[unit])
        np.testing.assert_allclose(found["nees"].values[policy, 0], nees[-len(error) :], rtol=1e-6)
        cost = 0.5 * (error**2).sum(axis=1)
        np.testing.assert_allclose(found["cost"].values[policy, 0], cost, rtol=1e-12)


REMAINDER = lambda x, dt: [(x[0] + dt * x[1] + np.pi) % (2.0 * np.pi) - np.pi, x[1]]  # noqa: E731
ARCTAN = lambda x, dt: [np.arctan2(np.sin(x[0] + dt * x[1]), np.cos(x[0] + dt * x[1])), x[1]]  # noqa: E731
CIRCLE = lambda x: [np.arctan2(np.sin(x[0]), np.cos(x[0]))]  # noqa: E731


@pytest.mark.parametrize("f", [REMAINDER, ARCTAN], ids=["remainder", "arctan2"])
@pytest.mark.parametrize("h", [None, CIRCLE], ids=["linear", "arctan2"])
def test_a_wrap_in_f_or_h_of_a_declared_angle_changes_nothing(make, f, h):
    """The same noise, so the same errors; from a heading of unknown turn, where sigma points lie beyond half a turn."""
    settings = {"episodes": 8, "horizon": 80}
    wide = {"covariance": np.diag([9.0, 0.04]), "angles": {"heading": "rad"}}
    plain = filtergym.evaluate(make(**turning(**wide)).id, "extended", **settings)["error"].values[0]
    both = make(**turning(f=f, h=h, **wide))
    for error in filtergym.evaluate(both.id, ["extended", "unscented"], **settings)["error"].values:
        # Wrapped and unwrapped sums round differently; the filters forget that.
        np.testing.assert_allclose(error, plain, atol=1e-9)


@pytest.mark.parametrize("f", [REMAINDER, ARCTAN], ids=["remainder", "arctan2"])
def test_a_turn_of_what_is_not_declared_is_noticed(make, f):
    free = {"gyro": Sensor([[0, 1]], R=4e-4), "compass": Sensor(CIRCLE, R=0.01)}
    with warnings.catch_warnings(record=True) as noticed:
        warnings.simplefilter("always")
        make(**turning(f=f, sensors=free))
    text = " ".join(str(one.message) for one in noticed)
    assert "write angles={'heading': 'rad'}" in text
    assert (
        "the sensor 'compass' measures an angle that jumps by a turn: declare it by Sensor(..., wraps='rad')"
        in text
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(**turning(f=f))


def test_an_undeclared_truth_that_wraps_is_noted(make, tmp_path):
    sensors = {"sine": Sensor(lambda x: [np.sin(x[0])], R=0.01), "compass": Sensor([[2, 0]], R=0.01)}
    cls = make(**turning(sensors=sensors))
    write(tmp_path / "log.csv", "rad", wrap)
    text = (tmp_path / "log.csv").read_text().replace("gyro", "sine")
    (tmp_path / "log.csv").write_text(text)
    (note,) = (n for n in filtergym.read_recording(tmp_path / "log.csv", cls.id).notes if "turn" in n)
    assert "truth_heading jumps by a turn after row" in note
    assert "declare angles={'heading': 'rad'}" in note


@pytest.mark.parametrize(
    ("angles", "words"),
    [
        ({"course": "rad"}, "angles names 'course', and the components are heading, rate"),
        ({"heading": "turns"}, "the unit of the angle 'heading' must be 'rad' or 'deg', got 'turns'"),
        (["heading"], r"angles must be units by names, such as \{'heading': 'rad'\}"),
    ],
)
def test_what_is_no_angle_is_refused(make, angles, words):
    with pytest.raises(ValueError, match=words):
        make(**turning(angles=angles))


def test_an_interacting_model_mixes_headings_of_different_turns(make):
    """One hypothesis wraps, the other does not: their means are a turn apart, and the mixture is not between them."""
    both = {"hypotheses": [{"f": REMAINDER}], "transition": [[0.9, 0.1], [0.1, 0.9]], "switching": False}
    settings = {"episodes": 8, "horizon": 120}
    plain = filtergym.evaluate(make(**turning()).id, "extended", **settings)["error"].values[0]
    found = filtergym.evaluate(make(**turning(**both)).id, ["imm", "kalman-imm"], **settings)["error"].values
    for error in found:
        np.testing.assert_allclose(error, plain, atol=1e-9)


def test_estimates_of_a_file_may_be_on_any_turn(make, tmp_path):
    cls = make(**turning())
    write(tmp_path / "log.csv", "rad", wrap)
    recording = filtergym.read_recording(tmp_path / "log.csv", cls.id)
    found = filtergym.evaluate(cls.id, "extended", scenario=recording, tracks=True)
    time, mean = recording.seconds[0] + recording.started[0], found["estimate"].values[0, 0]
    rows = [f"{t},{x[0] + 6.0 * np.pi},{x[1]}" for t, x in zip(time, mean, strict=False)]
    (tmp_path / "mine.csv").write_text("\n".join(["seconds,heading,rate", *rows]) + "\n")
    other = filtergym.evaluate(cls.id, f"file:{tmp_path / 'mine.csv'}", scenario=recording)
    np.testing.assert_allclose(other["error"].values[0], found["error"].values[0], atol=1e-12)


def test_turns_are_taken_off_exactly():
    rng = np.random.default_rng(0)
    small, turns = rng.uniform(-0.49, 0.49, (2, 200)), rng.integers(-5, 6, 200)
    periods = {0: 1.0}
    np.testing.assert_array_equal(unwrap(small, 0.0 * small, periods), small)
    moved = small + np.stack([turns, 0 * turns])
    np.testing.assert_allclose(shorten(moved, periods), small, atol=1e-15)
    np.testing.assert_allclose(unwrap(moved, 3.0 + small, periods)[0], 3.0 + small[0], atol=2e-15)


def test_a_smooth_function_of_many_turns_takes_none_off(make):
    """Of a thousand steps of a fast sine one is a turn long by chance, for some starts."""
    wrapped = {"f": lambda x: [x[0], x[1], (x[2] + np.pi) % (2.0 * np.pi) - np.pi]}
    smooth = {"f": lambda x: [x[0] + x[1] * np.sin(x[2]), x[1], x[2]]}
    given = {"h": lambda x: [x[0]], "Q": np.eye(3), "R": np.eye(1), "covariance": np.eye(3)}
    for i in range(20):
        mean = [0.05 * i, 30.0 + 0.05 * i, 1.0]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            make(**smooth, **given, mean=mean)
        with pytest.warns(UserWarning, match="f takes whole turns off x3"):
            make(**wrapped, **given, mean=mean)
