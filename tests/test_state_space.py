"""Environments made of a state-space model, against naive loops and known solutions."""

import functools
import importlib.util
import math
import re
import shlex
import shutil
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import scipy
from contract import assert_equals_its_vector
from models import load_module
from naive import kalman_update
from own_models import compare_lanes, forget, simulate

import filtergym
from filtergym.baselines import catalogue as baselines
from filtergym.baselines.problem import import_problem
from filtergym.compiler import namespace as traced_namespace
from filtergym.compiler.functions import CompiledFunction
from filtergym.compiler.program import Graph
from filtergym.compiler.vector_functions import VectorFunction
from filtergym.envs.engine.backend import make_model
from filtergym.envs.engine.catalogue import task_class
from filtergym.envs.linear.state_space import StateSpaceMeasurement
from filtergym.exports.c_source import export_c
from filtergym.exports.request import request_export

EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"
BLOCKS = re.findall(
    r"```(python|sh)\n(.*?)```", (EXAMPLES.parent / "state_space.md").read_text(encoding="utf-8"), re.S
)
F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
Q, R = np.array([[0.25, 0.5], [0.5, 1.0]]), np.array([[1.0]])
COMMON = {"f": F, "h": H, "Q": Q, "R": R, "mean": [0, 1], "covariance": np.eye(2)}


@pytest.fixture
def example(request, tmp_path_factory):
    """One of the modules of the page; forgotten afterwards."""
    name, id = request.param
    file = EXAMPLES / f"{name}.py"
    if name == "tracker":
        file = tmp_path_factory.mktemp("page") / "tracker.py"
        file.write_text(BLOCKS[0][1], encoding="utf-8")
    for _module in load_module(file):
        yield id


def lorenz(x, order=5, T=0.02):
    """KalmanNet's transition: the Taylor series of the matrix exponential, applied to the state."""
    A = [[-10.0, 10.0, 0.0], [28.0 - x[2], -1.0, 0.0], [x[1], 0.0, -8.0 / 3.0]]
    answer, term = list(x), list(x)
    for j in range(1, order + 1):
        term = [sum(A[i][k] * term[k] for k in range(3)) * (T / j) for i in range(3)]
        answer = [a + b for a, b in zip(answer, term, strict=True)]
    return answer


def begin(cls):
    model = make_model(cls)
    noise = model.task.noise
    return model.begin(np.zeros((noise.uniforms, 8)), np.zeros((noise.initial_normals, 8))).measurement


def naive_filter(mean, P, measurements, f, F_of, h, H_of, Q, R):
    """Extended Kalman filter of one episode with NumPy's inverse."""
    found = []
    for z in measurements:
        A = F_of(mean)
        mean, P = np.asarray(f(mean), float), A @ P @ A.T + Q
        mean, P = kalman_update(mean, P, z - np.asarray(h(mean), float), H_of(mean), R)
        found.append((mean, P))
    return found


def compare_with_naive(cls, steps, tolerance, f, F_of, h, H_of, Q, R, **keywords):
    start, kept = simulate(cls, steps, 8, **keywords)
    for lane in range(8):
        z = [np.where(m.available[:, lane] > 0.0, m.values[:, lane], np.nan) for _, m, _, _ in kept]
        mean, P = start.measurement.mean[:, lane], start.measurement.covariance[:, :, lane]
        naive = naive_filter(mean, P, z, f, F_of, h, H_of, Q, R)
        for (x, P), (_, _, mean, covariance) in zip(naive, kept, strict=True):
            np.testing.assert_allclose(mean[:, lane], x, rtol=tolerance, atol=tolerance)
            np.testing.assert_allclose(covariance[:, :, lane], P, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("backend", "availability"), [("numpy", 1.0), ("compiled", 0.7)])
def test_a_linear_model_gives_the_kalman_filter(make, backend, availability):
    cls = make(h=np.eye(2), R=[[1.0, 0.3], [0.3, 2.0]])
    functions = [lambda x: F @ x, lambda _: F, lambda x: x, lambda _: np.eye(2)]
    given = {"backend": backend, "availability": availability}
    compare_with_naive(cls, 40, 1e-10, *functions, Q, np.array([[1.0, 0.3], [0.3, 2.0]]), **given)


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
def test_a_nonlinear_model_gives_the_extended_kalman_filter(make, backend):
    T = 0.1

    def f(x):
        return [x[0] + T * x[1], x[1] - T * 9.81 * np.sin(x[0]) - T * x[1]]

    cls = make(
        f=f, h=lambda x: [np.sin(x[0])], Q=np.diag([1e-5, 1e-2]), R=[[0.01]], covariance=0.01 * np.eye(2)
    )
    compare_with_naive(
        cls, 40, 1e-10, f, lambda x: np.array([[1.0, T], [-T * 9.81 * np.cos(x[0]), 1.0 - T]]),
        lambda x: [np.sin(x[0])], lambda x: np.array([[np.cos(x[0]), 0.0]]), np.diag([1e-5, 1e-2]), np.array([[0.01]]),
        backend=backend,
    )  # fmt: skip


def test_jacobians_are_those_of_the_formulas():
    x = np.random.default_rng(0).standard_normal((3, 5))
    order_two = VectorFunction(functools.partial(lorenz, order=1), 3)
    expected = np.array(  # x + T A(x) x
        [[0.8 + 0 * x[0], 0.2 + 0 * x[0], 0 * x[0]],
         [0.02 * (28.0 - x[2]), 0.98 + 0 * x[0], -0.02 * x[0]],
         [0.02 * x[1], 0.02 * x[0], 1.0 - 0.02 * 8.0 / 3.0 + 0 * x[0]]]
    )  # fmt: skip
    np.testing.assert_allclose(order_two.jacobian(x, np), expected, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(order_two.value(x, np), np.stack(lorenz(x, 1)), rtol=1e-13)
    polar = VectorFunction(lambda x: np.stack([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])]), 2)
    a, b = x[0], x[1]
    r = np.hypot(a, b)
    expected = np.array([[a / r, b / r], [-b / r**2, a / r**2]])
    np.testing.assert_allclose(polar.jacobian(x[:2], np), expected, rtol=1e-12, atol=1e-14)


def test_a_function_is_the_same_on_every_kind_of_array(torch):
    function = VectorFunction(
        lambda x: [np.where(x[0] > 0.0, np.exp(-x[1]), np.maximum(x[1], 0.5)), np.abs(x[0]) ** 1.5, 2.0], 2
    )
    x = np.random.default_rng(1).standard_normal((2, 16))
    value, jacobian = function.value(x, np), function.jacobian(x, np)
    np.testing.assert_allclose(value[0], np.where(x[0] > 0.0, np.exp(-x[1]), np.maximum(x[1], 0.5)))
    tensor = torch.asarray(x)
    np.testing.assert_allclose(function.value(tensor, torch).numpy(), value, rtol=1e-14)
    np.testing.assert_allclose(function.jacobian(tensor, torch).numpy(), jacobian, rtol=1e-14)
    compiled = CompiledFunction(
        lambda x: (function.value(x, traced_namespace), function.jacobian(x, traced_namespace)), Graph()
    )
    for answer, expected in zip(compiled(x), (value, jacobian), strict=True):
        np.testing.assert_allclose(answer, expected, rtol=1e-13)


def test_the_jacobian_of_a_matrix_is_known_beforehand():
    linear, shifted = VectorFunction(F, 2), VectorFunction(lambda x: [x[0] + 2.0 * x[1] - 3.0], 2)
    np.testing.assert_array_equal(linear.matrix, F)
    np.testing.assert_array_equal(shifted.matrix, [[1.0, 2.0]])
    np.testing.assert_array_equal(shifted.offset, [-3.0])
    assert VectorFunction(lambda x: [x[0] * x[1]], 2).matrix is None


def test_the_hypotheses_are_mixed_as_in_the_golden_example(make):
    """Two models that differ in Q; computed with 40 digits and with another library from the same numbers."""
    cls = make(Q=np.zeros((2, 2)), hypotheses=[{"Q": Q}], transition=[[0.9, 0.1], [0.2, 0.8]])
    bank = make_model(cls, "evidence", backend="numpy").filter
    one = np.ones(8)
    mean, P = np.array([[0.0, 0.5], [1.0, 1.5]]), np.stack([np.eye(2), 2.0 * np.eye(2)], axis=2)
    start = bank.start(begin(cls))
    state = start._replace(
        means=mean[:, :, None] * one,
        covariances=P[..., None] * one,
        probabilities=np.array([[0.6], [0.4]]) * one,
    )
    states = []
    for z in (1.5, 3.5, 6.5):
        measurement = StateSpaceMeasurement(z * one[None], one[None])
        state = bank.act(bank.predict(state, measurement), measurement, np.zeros((2, 8)))
        states.append(state)
    first, last = states[0], states[2]
    np.testing.assert_allclose(np.exp(first.log_likelihood[:, 0]), [0.2129119583, 0.175190966], rtol=1e-9)
    np.testing.assert_allclose(first.probabilities[:, 0], [0.664753530759, 0.335246469241], rtol=1e-11)
    np.testing.assert_allclose(first.mean[:, 0], [1.4494678454, 1.21624623534], rtol=1e-10)
    expected = [[0.743637116228, 0.395626782245], [0.395626782245, 1.07317641199]]
    np.testing.assert_allclose(first.covariance[..., 0], expected, rtol=1e-11)
    np.testing.assert_allclose(last.probabilities[0, 0], 0.670469141704, rtol=1e-11)
    np.testing.assert_allclose(last.mean[:, 0], [5.9803866254, 2.15776662366], rtol=1e-10)


def test_errors_fit_the_covariance(make):
    """The sum of normalised squared errors of M episodes is chi-square with 2 M degrees of freedom."""
    M = 4000
    _, kept = simulate(make(covariance=[[1.0, 0.5], [0.5, 2.0]]), 20, M)
    for truth, _, mean, P in (kept[0], kept[-1]):
        error = mean - truth.state
        nees = np.einsum("in,ijn,jn->n", error, np.moveaxis(np.linalg.inv(np.moveaxis(P, 2, 0)), 0, 2), error)
        low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 2 * M)
        assert low < nees.sum() < high


def test_what_was_not_received_changes_nothing(make):
    cls = make(h=np.eye(2), R=[[1.0, 0.3], [0.3, 2.0]])
    bank = make_model(cls, "noise", backend="numpy").filter
    start, one, zero = bank.start(begin(cls)), np.ones(8), np.zeros(8)
    nothing = StateSpaceMeasurement(np.zeros((2, 8)), np.zeros((2, 8)))
    kept = bank.act(bank.predict(start, nothing), nothing, np.zeros((2, 8)))
    np.testing.assert_allclose(kept.mean, F @ start.mean)
    np.testing.assert_allclose(kept.covariance[..., 0], F @ F.T + Q)
    assert np.isnan(bank.records(kept, nothing)["log_likelihood"]).all()
    first = StateSpaceMeasurement(np.stack([3.0 * one, zero]), np.stack([one, zero]))
    partly = bank.predict(start, first)
    variance = (F @ F.T + Q)[0, 0] + 1.0
    expected = -0.5 * (math.log(2.0 * math.pi * variance) + (3.0 - 1.0) ** 2 / variance)
    np.testing.assert_allclose(bank.records(partly, first)["log_likelihood"], expected)


@pytest.mark.parametrize("control", ["noise", "gain", "kalman-net"])
def test_zero_is_the_filter_as_written_and_other_actions_are_not(make, control):
    cls = make(h=np.eye(2), R=np.eye(2))
    model = make_model(cls, control, backend="numpy")
    _, zero = simulate(cls, 10, 8, control=control)
    _, plain = simulate(cls, 10, 8)
    np.testing.assert_allclose(zero[-1][2], plain[-1][2], rtol=1e-12)
    np.testing.assert_allclose(zero[-1][3], plain[-1][3], rtol=1e-12)
    start = model.begin(np.zeros((0, 8)), np.zeros((2, 8)))
    episode = model.measure(start, np.ones((4, 8)))
    for entry in range(model.action_space.shape[0]):
        action = np.zeros((model.action_space.shape[0], 8))
        action[entry] = 1.0
        after, plain = (model.act(episode, a).filter for a in (action, 0.0 * action))
        following = [
            model.measure(episode._replace(filter=f), np.ones((4, 8))).filter for f in (after, plain)
        ]
        assert not np.allclose(*[np.concatenate([f.mean, f.covariance.reshape(4, 8)]) for f in following])


def test_noise_scales_q_and_r(make):
    cls, scaled = make(), make(Q=100.0 * Q, R=0.01 * R)
    model, other = (make_model(c, "noise", backend="numpy") for c in (cls, scaled))
    start = model.begin(np.zeros((0, 8)), np.zeros((2, 8)))
    episode = model.measure(start, np.ones((3, 8)))
    after = model.act(episode, np.stack([np.ones(8), -np.ones(8)]))
    expected = other.act(episode, np.zeros((2, 8)))
    np.testing.assert_allclose(model.covariance(after), other.covariance(expected), rtol=1e-12)
    np.testing.assert_allclose(model.mean(after), other.mean(expected), rtol=1e-12)


def test_a_filter_with_another_model_is_worse_than_the_true_one(make):
    cls = make(
        h=np.eye(2), R=np.eye(2), filter_model={"f": [[1.0, 0.9], [-0.1, 1.0]]}, process_noise=(0.1, 10.0)
    )
    dataset = filtergym.evaluate(cls.id, ["kalman", "known-model"], episodes=200)
    episodes = dataset.cost.mean("time")
    difference = (episodes.sel(policy="kalman") - episodes.sel(policy="known-model")).values
    assert difference.mean() > 4.0 * difference.std() / math.sqrt(200)
    anees = dataset.nees.sel(policy="known-model").mean().item() / 2.0
    assert 0.9 < anees < 1.1


def test_the_world_switches_by_the_chain(make):
    cls = make(
        hypotheses=[{"Q": 100.0 * Q}, {"f": np.eye(2)}],
        transition=[[0.8, 0.2, 0.0], [0.0, 0.5, 0.5], [0.1, 0.0, 0.9]],
    )
    _, kept = simulate(cls, 400, 64)
    path = np.stack([truth.hypothesis for truth, *_ in kept]).astype(int)
    counts = np.zeros((3, 3))
    np.add.at(counts, (path[:-1].ravel(), path[1:].ravel()), 1)
    rows = counts.sum(axis=1, keepdims=True)
    expected = np.array(cls.definition.transition)
    deviation = np.sqrt(expected * (1.0 - expected) / rows)
    assert (np.abs(counts / rows - expected) <= 5.0 * deviation).all()
    _, still = simulate(make(hypotheses=[{"Q": 100.0 * Q}], switching=False), 30, 8)
    assert not np.any([truth.hypothesis for truth, *_ in still])


@pytest.mark.parametrize(
    "example",
    [("tracker", "mine/Tracker-v0"), ("mixed_motion", "mine/Target-v0")],
    indirect=True,
    ids=lambda pair: pair[0],
)
class TestExamples:
    """What holds for every registered task holds for these."""

    def test_environments(self, example):
        cls = task_class(example)
        for control in (cls.controls[0], "kalman-net"):
            shape = gymnasium.make(example, control=control).action_space.shape
            assert_equals_its_vector(
                example, [0.1 * np.ones(shape, np.float32)] * 6, False, control=control, horizon=6
            )

    def test_compiled_and_numpy_give_the_same(self, example):
        names = [name for name in baselines.baselines_of(example).names if name != "random"]
        first, second = (
            filtergym.evaluate(example, names, episodes=16, horizon=30, backend=backend)
            for backend in ("compiled", "numpy")
        )
        np.testing.assert_allclose(first.error.values, second.error.values, rtol=1e-7, atol=1e-7)
        assert not first.lost.fillna(0.0).values.any()

    def test_policies_and_estimators_of_one_filter_agree(self, example):
        for names in (["kalman", "extended"], ["imm", "kalman-imm"]):
            if {*names} <= {*baselines.baselines_of(example).names}:
                first, second = filtergym.evaluate(example, names, episodes=16, horizon=30).error.values
                np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-9)

    @pytest.mark.skipif(shutil.which("cc") is None, reason="no compiler")
    def test_filters_are_exported(self, example, tmp_path):
        problem = import_problem(example)
        for name in {problem.paper, *problem.baselines.estimators} - {"extended"}:  # which others export
            figures = export_c(request_export(problem, name), tmp_path / name)
            assert figures.difference < 1e-6
            assert figures.test


def noise_of(dt):
    return [[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]


def swing(x, dt):
    return [x[0] + dt * x[1], x[1] - dt * 9.81 * np.sin(x[0])]


MOVES = {
    "linear": (lambda x, dt: [x[0] + dt * x[1], x[1]], lambda x, dt: np.array([[1.0, dt], [0.0, 1.0]])),
    "nonlinear": (swing, lambda x, dt: np.array([[1.0, dt], [-dt * 9.81 * np.cos(x[0]), 1.0]])),
}


def naive_timed(f, F_of, mean, P, measurements):
    """Extended Kalman filter of one episode of measurements ``(dt, z)`` with NumPy's inverse; R = 1, z is x[0]."""
    for dt, z in measurements:
        A = F_of(mean, dt)
        mean, P = np.array(f(mean, dt), float), A @ P @ A.T + np.array(noise_of(dt))
        mean, P = kalman_update(mean, P, z - mean[:1], H, R)
    return mean, P


@pytest.mark.parametrize("name", MOVES)
@pytest.mark.parametrize("backend", ["numpy", "compiled"])
def test_a_timed_model_gives_the_filter_of_its_intervals(make, name, backend):
    f, F_of = MOVES[name]
    cls = make(f=f, Q=noise_of, covariance=0.1 * np.eye(2), sampling_interval=0.1)
    start, kept = simulate(cls, 30, 8, backend=backend, jitter=0.9)
    intervals = np.stack([m.interval for _, m, *_ in kept])
    assert intervals.min() < 0.03
    assert intervals.max() > 0.17
    np.testing.assert_allclose(intervals.mean(), 0.1, atol=0.02)

    def follow(mean, P, lane):
        return naive_timed(f, F_of, mean, P, [(m.interval[lane], m.values[0, lane]) for _, m, *_ in kept])

    compare_lanes(start, kept, follow)


@pytest.mark.parametrize("policy", ["kalman", "unscented"])
def test_a_timed_model_takes_measurements_of_any_time(make, policy):
    f, F_of = MOVES["linear"]
    filter = filtergym.online(make(f=f, Q=noise_of).id, policy)
    filter.start(mean=[0, 1], covariance=np.eye(2), time=5.0)
    times, z = [6.0, 56.0, 56.1, 56.1, 56.100002, 60.0], [1.2, 48.0, np.nan, 49.5, 50.0, 55.0]
    for time, value in zip(times, z, strict=True):
        found = filter.update(time, values=[value])
    steps = list(zip(np.diff([5.0, *times]), z, strict=True))
    mean, P = naive_timed(f, F_of, np.array([0.0, 1.0]), np.eye(2), steps)
    tolerance = 1e-6 if policy == "unscented" else 1e-12  # it starts with a little more covariance
    np.testing.assert_allclose(found.mean, mean, rtol=tolerance)
    np.testing.assert_allclose(found.covariance, P, rtol=tolerance)
    with pytest.raises(ValueError, match="time must increase"):
        filter.update(59.0, values=[1.0])
    with pytest.raises(ValueError, match=r"at least 1e-06 s apart"):
        filter.update(60.0 + 1e-7, values=[1.0])


def test_a_timed_model_that_moves_in_no_time_takes_one_measurement_at_a_time(make):
    filter = filtergym.online(make(f=lambda x, dt: [x[0] + dt * x[1] + 1.0, x[1]], Q=noise_of).id, "kalman")
    filter.start(mean=[0, 1], covariance=np.eye(2))
    filter.update(1.0, values=[1.0])
    with pytest.raises(ValueError, match="time must increase"):
        filter.update(1.0, values=[1.0])


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"f": MOVES["linear"][0]}, r"got f\(x, dt\) and Q as a matrix"),
        ({"Q": noise_of}, r"got f without dt and Q\(dt\)"),
        ({"f": MOVES["linear"][0], "Q": lambda dt: [[dt]]}, "Q must return 4 numbers, got 1"),
        ({"f": MOVES["linear"][0], "Q": lambda dt: [[-dt, 0.0], [0.0, dt]]}, "Q must be symmetric and without"),
        ({"f": MOVES["linear"][0], "Q": noise_of, "hypotheses": [{"f": F, "Q": Q}]}, "all models must take"),
        ({"jitter": 0.5}, "is not timed, so jitter must be 0"),
    ],
)  # fmt: skip
def test_what_is_no_timed_model_is_refused(make, wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        make(**wrong)


@pytest.mark.parametrize(
    ("block", "id", "lines"),
    [
        (3, "mine/Irregular-v0", 4),
        (4, "mine/Pendulum-v0", 0),
        (5, "mine/Cell-v0", 2),
        (6, "mine/Phone-v0", 2),
        (7, "mine/Wheel-v0", 1),
        (8, "mine/Boat-v0", 1),
    ],
)
def test_the_pages_models_run(capsys, block, id, lines):
    try:
        exec(compile(BLOCKS[block][1], "page", "exec"), {})
    finally:
        forget(id)
    assert len(capsys.readouterr().out.splitlines()) == lines


def test_another_interval_than_the_models_is_refused(make):
    filter = filtergym.online(make().id, "kalman")
    filter.start(mean=[0, 1], covariance=np.eye(2))
    filter.update(1.0, values=[10.0])
    before = filter.update(2.005, values=[20.0])  # the clock of a log is not exact
    for time in (3.5, 2.1):
        with pytest.raises(ValueError, match=rf"moves by 1 s from .* to the next, got {time - 2.005:g} s"):
            filter.update(time, values=[500.0])
    np.testing.assert_array_equal(filter.predict(3.0).mean, F @ before.mean)  # nothing was taken in
    assert filter.update(3.0, values=[30.0]).time == 3.0


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"f": np.eye(3)}, "f must be finite numbers of shape"),
        ({"f": lambda x: [x[0]]}, "f must return 2 numbers, got 1"),
        ({"f": lambda x: [x[0] if x[0] > 0.0 else x[1], x[1]]}, "f cannot be traced"),
        ({"f": lambda x: x[0]}, "f must return a vector"),
        ({"h": lambda x: np.array([x[0], x[1]], dtype=float)}, "h cannot be traced .*without dtype"),
        ({"Q": [[1.0, 0.0], [0.5, 1.0]]}, "Q must be symmetric"),
        ({"Q": -np.eye(2)}, "Q must be symmetric and without negative eigenvalues"),
        ({"R": [[0.0]]}, "R must be symmetric and positive definite"),
        ({"R": np.eye(2)}, r"R must be finite numbers of shape \(1, 1\)"),
        ({"names": ["one"]}, "names and units must be 2 each"),
        ({"weights": [0.0, 0.0]}, "weights must not be negative, nor all zero"),
        ({"filter_model": {"F": F}}, "filter_model can contain f, Q, h or R, got 'F'"),
        ({"hypotheses": [{"h": np.eye(2), "R": np.eye(2)}]}, "all models must measure as many numbers"),
        ({"hypotheses": [{"Q": Q}], "transition": [[0.9, 0.2], [0.5, 0.5]]}, "transition must hold probabilities"),
        ({"horizon": 0}, "horizon must be"),
        ({"orizon": 5}, "did you mean 'horizon'"),
        ({"Q": [[1.0], [0.5, 1.0]]}, "Q must be numbers, got"),
        ({"mean": ["x", 1]}, "mean must be numbers, got"),
        ({"names": 5}, "names must be a sequence of words, got 5"),
        ({"hypotheses": [5]}, "hypotheses must be a sequence of models"),
        ({"filter_model": 5}, "filter_model can contain f, Q, h or R, got 5"),
        ({"sampling_interval": "x"}, "sampling_interval must be a finite number"),
        ({"switching": np.eye(2)}, "switching must be True or False"),
    ],
)  # fmt: skip
def test_what_is_no_model_is_refused(make, wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        make(**wrong)


@pytest.mark.slow
def test_the_page_on_tables_runs(tmp_path, command, monkeypatch):
    """Its commands, on a simulated drive whose odometer speaks at every second measurement."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "car.py").write_text(BLOCKS[9][1], encoding="utf-8")
    try:
        made = filtergym.record(importlib.import_module("car").Car.id, episodes=1, horizon=150, jitter=0.9)
        gps, odometry = made.measurements["values"][0].T
        odometry = np.where(np.arange(len(gps)) % 2, np.nan, odometry)
        rows = np.column_stack([made.seconds[0], gps, odometry, made.truth[0]])
        for file, header in (
            ("drive.csv", "time,gps,odometry,truth_position,truth_velocity"),
            ("other.csv", "t,pos,v,truth_position,truth_velocity"),
        ):
            text = "\n".join([header, *(",".join(map(str, row)).replace("nan", "") for row in rows.tolist())])
            (tmp_path / file).write_text(text, encoding="utf-8")
        for line in BLOCKS[10][1].splitlines():
            code, shown, errors = command(*shlex.split(line)[1:])
            assert (code, bool(shown)) == (0, True), errors
    finally:
        sys.modules.pop("car", None)
        forget("mine/Car-v0")


@pytest.mark.slow
def test_the_page_runs(tmp_path, command, capsys, monkeypatch):
    """One block after the other in an empty folder, with a short search and training."""
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "tracker.py").write_text(BLOCKS[0][1], encoding="utf-8")
    try:
        for line in BLOCKS[1][1].splitlines():
            _, *words = shlex.split(re.sub(r"--steps \d+", "--steps 12800 --no-compare", line))
            code, shown, errors = command(*words)
            assert (code, bool(shown)) == (0, True), errors
        exec(compile(BLOCKS[2][1], "page", "exec"), {})
        assert "x1" in capsys.readouterr().out
    finally:
        sys.modules.pop("tracker", None)
        forget("mine/Tracker-v0")


# --- what is written with NumPy


TABLE_OF = ([-1.0, 0.0, 0.5], [2.0, 3.0, 1.0])
MATRIX = np.array([[1.0, 2.0, 0.0, -1.0], [0.5, 0.0, 3.0, 1.0], [0.0, 1.0, 1.0, 0.0], [2.0, 0.0, 0.0, 1.0]])
WRITTEN = {
    "degrees": lambda x: np.degrees(x),
    "radians": lambda x: [np.radians(x[0]), np.deg2rad(x[1]), np.rad2deg(x[2])],
    "array": lambda x: np.array([x[0] * x[1], np.sin(x[2]), 1.0]),
    "array of rows": lambda x: np.array([[np.cos(x[0]), 1.0], [0.0, x[1]]]) @ x[:2],
    "functions of an array": lambda x: np.sin(np.array([x[0], x[1]])) + np.hypot(np.array([x[2], x[3]]), 1.0),
    "dot": lambda x: [np.dot(x[:2], x[2:]), np.dot(x, MATRIX[0]), np.dot([x[0], x[1]], [1.0, 2.0])],
    "dot of a matrix": lambda x: np.dot(MATRIX, x) + MATRIX.dot(x) + x.dot(MATRIX),
    "norm": lambda x: [np.linalg.norm(x[:2]), np.linalg.norm([x[0], 3.0]), np.linalg.norm(np.array([x[1], 1.0]))],
    "norm of rows": lambda x: np.linalg.norm(np.reshape(x, (2, 2)), axis=0),
    "cross": lambda x: np.cross(x[:3], [1.0, 2.0, 3.0]) + np.cross([x[0], x[1], x[2]], x[1:]),
    "interp": lambda x: [np.interp(x[0], *TABLE_OF), np.interp(x[1], *TABLE_OF, left=5.0, right=x[3])],
    "outer": lambda x: np.outer(x[:2], x[2:]).ravel(),
    "einsum": lambda x: np.einsum("ij,j->i", MATRIX, x),
    "inner": lambda x: [np.inner(x, x), np.vdot(x, x), np.trace(np.reshape(x, (2, 2)))],
    "hstack": lambda x: np.hstack([x[:2], x[3]]) + np.vstack([x[:3], x[1:]])[0] + np.append(x[:2], 1.0),
    "cumsum": lambda x: np.cumsum(x) + np.diff(np.append(x, 0.0)),
    "select": lambda x: [np.select([x[0] > 0.5, x[0] > 0.0], [x[1], x[2]], x[3])],
    "cbrt": lambda x: np.cbrt(x) + np.fmod(x, 0.3) + np.reciprocal(2.0 + x * x) + np.fabs(x),
    "polyval": lambda x: [np.polyval([1.0, 2.0, 3.0], x[0])],
    "clip": lambda x: np.clip(x, -0.5, 0.5) * np.sign(x) + np.matmul(MATRIX, x),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITTEN)
def test_what_is_written_with_numpy_has_its_values_and_derivatives(name):
    """Also compiled; differences of 2e-6 have the derivative to 1e-7 of numbers up to 1e2."""
    written = WRITTEN[name]
    function = VectorFunction(written, 4)
    x = np.random.default_rng(3).uniform(0.1, 1.0, (4, 8)) * np.resize([1.0, -1.0, 1.0], (4, 8))
    value, jacobian = function.value(x, np), function.jacobian(x, np)
    each = lambda points: np.stack([np.asarray(written(point), dtype=float) for point in points.T], axis=-1)  # noqa: E731
    np.testing.assert_allclose(value, each(x), rtol=1e-14, atol=1e-14)
    steps = 1e-6 * np.eye(4)[..., None]
    slopes = np.stack([each(x + step) - each(x - step) for step in steps], axis=1) / 2e-6
    np.testing.assert_allclose(jacobian, slopes, rtol=1e-6, atol=1e-6)
    compiled = CompiledFunction(
        lambda x: (function.value(x, traced_namespace), function.jacobian(x, traced_namespace)), Graph()
    )
    for answer, expected in zip(compiled(x), (value, jacobian), strict=True):
        np.testing.assert_allclose(answer, expected, rtol=1e-13, atol=1e-15)


def test_a_function_beyond_its_range_is_named_with_the_state(make):
    """Where the model is made, and where a filter in use loses its track."""
    falls = {"f": lambda x: [x[0] - 0.3, 0.9 * x[1]], "Q": 0.01 * np.eye(2), "names": ["level", "rate"]}
    falls |= {"mean": [1.0, 0.0], "covariance": 0.01 * np.eye(2), "h": None, "R": None}
    sensors = {
        "gauge": filtergym.Sensor([[1, 0]], 0.1),
        "depth": filtergym.Sensor(lambda x: [np.log(x[0])], 0.04),
    }
    with pytest.warns(RuntimeWarning, match=r"h of the sensor 'depth' gives nan at level = -[\d.]+, rate = "):
        cls = make(**falls, sensors=sensors)
    for name in ("unscented", "kalman"):
        live = filtergym.online(cls.id, name)
        live.start(mean=falls["mean"], covariance=falls["covariance"])
        lost = [live.update(gauge=-0.2).lost for _ in range(4)]
        assert lost[0] == ""
        assert re.match(
            r"the estimate is not finite: h of the sensor 'depth' gives nan at level = -", lost[-1]
        )
    root = {**falls, "f": lambda x: [x[0] - 0.3, np.sqrt(x[1] - 1.0)], "h": [[1, 0]], "R": [[1.0]]}
    with (
        pytest.raises(ValueError, match=r"must be finite: f gives nan at level = 1, rate = 0: keep"),
        pytest.warns(RuntimeWarning, match="f gives nan"),
    ):
        make(**root)
