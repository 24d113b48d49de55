"""The crash test: what is done to measurements, the verdict on a filter, and that mistakes in a filter are noticed."""

import json

import numpy as np
import pytest
from own_models import forget

from filtergym import state_space
from filtergym.baselines.problem import Problem, problem_of
from filtergym.compiler.functions import map_arrays
from filtergym.evaluation.stress.alterations import ALTERATIONS, EVERY, SETTLED
from filtergym.evaluation.stress.crash_test import CrashTest

SHORT = [one for one in ALTERATIONS if one.length <= 260]
UNALTERED = ALTERATIONS[0]


# --- a target that is seen in range and azimuth, behind the radar's back, and a filter with a mistake


def _fly(x, dt):
    return [x[0] + dt * x[2], x[1] + dt * x[3], x[2], x[3]]


def _see(x):
    return [np.sqrt(x[0] ** 2 + x[1] ** 2), np.arctan2(x[1], x[0])]


def _noise(dt):
    q = [[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]
    return [[q[i // 2][j // 2] if i % 2 == j % 2 else 0.0 * dt for j in range(4)] for i in range(4)]


SIGMAS = np.array([5.0, 0.01])
START = np.diag([50.0, 50.0, 2.0, 2.0]) ** 2
MODEL = {
    "f": _fly,
    "h": _see,
    "Q": _noise,
    "R": np.diag(SIGMAS**2),
    "mean": [-2000.0, -20.0, 0.0, 1.0],
    "covariance": START,
    "horizon": 80,
    "jitter": 0.5,
    "availability": 0.8,
}


class Tracker:
    """An extended Kalman filter of the model, right but for one mistake."""

    def __init__(self, mistake=""):
        self.mistake = mistake

    def start(self, initial, N):
        P = np.moveaxis(initial.covariance, -1, 0)
        return initial.mean.T.copy(), 1e-6 * P if self.mistake == "start taken for exact" else P.copy()

    def update(self, memory, measurement):
        there = measurement.available[0] > 0.0
        x, P = memory
        moved = self.move(x, P, measurement.interval)
        if self.mistake == "no prediction without a measurement":
            moved = tuple(
                np.where(there.reshape(-1, *[1] * (m.ndim - 1)), m, b)
                for m, b in zip(moved, memory, strict=True)
            )
        taken = self.correct(*moved, np.where(there, measurement.values, 0.0).T)
        if self.mistake != "missed measurements taken in":
            taken = tuple(
                np.where(there.reshape(-1, *[1] * (t.ndim - 1)), t, m)
                for t, m in zip(taken, moved, strict=True)
            )
        return taken[0].T, np.moveaxis(taken[1], 0, -1), taken

    def move(self, x, P, dt):
        dt = np.ones_like(dt) if self.mistake == "interval ignored" else dt
        F = np.eye(4) + dt[:, None, None] * np.eye(4, k=2)
        Q = np.moveaxis(np.array(_noise(dt)), -1, 0)
        if self.mistake == "no process noise":
            Q = 0.0 * Q
        A = F.swapaxes(1, 2) if self.mistake == "F transposed" else F
        return (F @ x[..., None])[..., 0], A @ P @ A.swapaxes(1, 2) + Q

    def correct(self, x, P, z):
        R = np.diag(SIGMAS if self.mistake == "deviations taken for variances" else SIGMAS**2)
        expected = np.array(_see(x.T)).T
        H = self.jacobian(x)
        spread, cross = H @ P @ H.swapaxes(1, 2), P @ H.swapaxes(1, 2)
        S = spread + (0.0 if self.mistake == "R left out of S" else R)
        K = cross @ np.linalg.inv(S)
        innovation = self.wrap(z - expected)[..., None]
        x = x + (-1.0 if self.mistake == "sign of the gain" else 1.0) * (K @ innovation)[..., 0]
        if self.mistake == "covariance not updated":
            return x, P
        if self.mistake == "K R K^T forgotten":
            A = np.eye(4) - K @ H
            return x, A @ P @ A.swapaxes(1, 2)
        return x, P - K @ S @ K.swapaxes(1, 2)

    def wrap(self, difference):
        if self.mistake == "no angle wrap":
            return difference
        return np.stack([difference[:, 0], np.angle(np.exp(1j * difference[:, 1]))], axis=1)

    def jacobian(self, x):
        r = np.hypot(x[:, 0], x[:, 1])
        c, s, none = x[:, 0] / r, x[:, 1] / r, 0.0 * r
        sign = -1.0 if self.mistake == "sign in the Jacobian" else 1.0
        H = np.array([[c, s, none, none], [-s / r, sign * c / r, none, none]])
        return np.moveaxis(H, -1, 0)


MISTAKES = (
    "sign of the gain",
    "K R K^T forgotten",
    "F transposed",
    "no angle wrap",
    "no process noise",
    "interval ignored",
    "deviations taken for variances",
    "sign in the Jacobian",
    "R left out of S",
    "covariance not updated",
    "start taken for exact",
    "missed measurements taken in",
    "no prediction without a measurement",
)


@pytest.fixture(scope="module")
def radar():
    """The crash test of the model, nothing altered."""
    problem = Problem.of(state_space("tests/Radar-v0", **MODEL))
    yield CrashTest(problem.experiment(None, 32), 0, None, [UNALTERED._replace(length=80)])
    forget("tests/Radar-v0")


def unaltered(test, maker):
    """What is found of a filter on unaltered measurements."""
    return next(test.findings("mine", maker))


def test_a_filter_that_is_right_passes_and_one_with_a_mistake_does_not(radar):
    found = unaltered(radar, Tracker())
    assert (found.verdict, found.reason) == ("passed", "")
    passed = [mistake for mistake in MISTAKES if not unaltered(radar, Tracker(mistake)).reason]
    assert len(passed) <= len(MISTAKES) // 10, passed


# --- what is done


@pytest.fixture(
    scope="module", params=["filtergym/ManeuveringTarget-v0", "filtergym/LooselyCoupledNavigation-v0"]
)
def tested(request):
    """The short alterations of a shipped environment, one timed and one not."""
    return CrashTest(problem_of(request.param).experiment(None, 8), 0, None, SHORT)


def arrays(part):
    found = []
    map_arrays(found.append, part)
    return found


def test_nothing_is_altered_before_it_happens_and_truth_belongs_to_what_is_measured(tested):
    plain = tested.streams[UNALTERED.name]
    for name, stream in tested.streams.items():
        if stream is None:
            continue
        np.testing.assert_array_equal(stream.truth, plain.truth[stream.source], err_msg=name)
        early = min(stream.begin, SETTLED)
        if name != "restart":
            for one, other in zip(arrays(stream.measurements), arrays(plain.measurements), strict=True):
                # Intervals are differences of times, which round.
                np.testing.assert_allclose(one[:early], other[:early], 1e-12, 1e-12, err_msg=name)
        assert np.isfinite(stream.readings).all(), name
        deviations = stream.deviations
        assert deviations.shape == stream.readings.shape
        assert (deviations > 0.0).all()


def test_each_alteration_has_its_effect():
    test = CrashTest(problem_of("filtergym/ManeuveringTarget-v0").experiment("paper", 8), 0, None, SHORT)
    plain, streams = test.streams[UNALTERED.name], test.streams
    k = SETTLED
    interval = {name: stream.measurements.interval[:, 0] for name, stream in streams.items()}
    T = interval[UNALTERED.name][0]
    np.testing.assert_allclose(interval["gap-10"][[k - 1, k, k + 1]], [T, 11 * T, T])
    np.testing.assert_array_equal(streams["gap-10"].source[[k - 1, k]], [k - 1, k + 10])
    np.testing.assert_allclose(interval["zero-interval"][[k, k + 1]], [0.0, 2.0 * T], atol=1e-12)
    np.testing.assert_allclose(interval["tiny-interval"][k], 1e-6, rtol=1e-6)
    np.testing.assert_allclose(interval["clock-jump"][[k, k + 1]], [101.0 * T, T])
    np.testing.assert_allclose(interval["clock-drift"][k:], 1.01 * T)
    np.testing.assert_allclose(interval["out-of-order"][k : k + 3], [2.0 * T, -T, 2.0 * T])
    np.testing.assert_allclose(interval["duplicates"][k : k + EVERY + 2], [T, 0.0, *[T] * (EVERY - 1), T])
    assert 0.05 * T < np.ptp(interval["jitter"][k:]) < 1.2 * T + 1e-9
    # Where every scan sees the target the time since the last that did is the interval.
    for name, stream in streams.items():
        np.testing.assert_allclose(stream.measurements.elapsed, stream.measurements.interval, err_msg=name)
    off = (streams["outlier-50"].readings - plain.readings[: len(streams["outlier-50"])]) / plain.deviations[
        : len(streams["outlier-50"])
    ]
    np.testing.assert_allclose(np.abs(off[k]), 50.0)
    assert not off[k + 1 :].any()
    stated = (
        streams["noise-100"].measurements.variance[k:]
        / plain.measurements.variance[k : len(plain)][: 200 - k]
    )
    np.testing.assert_allclose(stated, 0.01)
    frozen = streams["frozen"].readings
    np.testing.assert_array_equal(
        frozen[k : k + 20], np.broadcast_to(frozen[k - 1], frozen[k : k + 20].shape)
    )
    assert not streams["nan"].measurements.available[k].any()
    ratio = streams["vague-start"].initial.covariance / np.where(
        plain.initial.covariance, plain.initial.covariance, 1
    )
    np.testing.assert_allclose(ratio[plain.initial.covariance != 0.0], 1e6)
    apart = streams["restart"].initial.mean - plain.truth[k - 1]
    assert (np.abs(apart) < 5.0 * np.sqrt(np.einsum("iin->in", plain.initial.covariance))).all()


# --- the verdict


class Careless(Tracker):
    """Right, but for what it does from a measurement on."""

    def __init__(self, then):
        super().__init__()
        self.then = then

    def start(self, initial, N):
        return 0, super().start(initial, N)

    def update(self, memory, measurement):
        mean, covariance, own = super().update(memory[1], measurement)
        if memory[0] == SETTLED:
            mean, covariance = self.then(mean, covariance)
        return mean, covariance, (memory[0] + 1, own)


def _stop(mean, covariance):
    raise RuntimeError("no such thing")


@pytest.mark.parametrize(
    ("then", "phrase"),
    [
        (lambda m, P: (np.nan * m, P), "is not finite after a missed measurement"),
        (lambda m, P: (m, -P), "the covariance is not positive definite"),
        (lambda m, P: (m, P + np.eye(4, k=1)[:, :, None]), "the covariance is not symmetric"),
        (_stop, "stops at measurement 61: estimator 'mine' failed at measurement"),
    ],
)
def test_what_is_no_estimate_fails(radar, then, phrase):
    found = unaltered(radar, Careless(then))
    assert found.verdict == "failed"
    assert phrase in found.reason


def test_what_keeps_something_to_itself_cannot_be_restored(radar):
    class Secretive(Tracker):
        def update(self, memory, measurement):
            self.mistake, self.count = "", getattr(self, "count", 0) + 1
            mean, covariance, own = super().update(memory, measurement)
            return mean + self.count, covariance, own

    assert radar._restore("mine", Tracker).verdict == "passed"
    found = radar._restore("mine", Secretive)
    assert (found.verdict, found.reason) == ("failed", "another estimate 1 measurement after it was restored")


def test_the_command_prints_a_line_each_and_writes_both_files(command, tmp_path, monkeypatch):
    monkeypatch.setattr(CrashTest.__init__, "__defaults__", (None, SHORT[:3]))
    written = tmp_path / "found.json", tmp_path / "found.html"
    words = ["stress", "filtergym/ManeuveringTarget-v0", "kalman-imm", "--episodes", "8", "--steps", "1200"]
    code, printed, _ = command(*words, "--json", written[0], "--html", written[1])
    found = json.loads(written[0].read_text())
    assert [one["alteration"] for one in found] == [*(one.name for one in SHORT[:3]), "restore", "long-run"]
    assert code == int(any(one["verdict"] == "failed" for one in found))
    # Where nothing is altered, the error itself is a ratio to the reference's.
    assert [one["reference_error"] is None for one in found[:3]] == [True, False, False]
    for one in found:
        assert f"{one['alteration']}" in printed
    page = written[1].read_text()
    assert "nothing is received for 10 scans" in page
    assert "<script" not in page
    assert "is a file of estimates" in command("stress", "filtergym/ManeuveringTarget-v0", "file:mine.csv")[2]
