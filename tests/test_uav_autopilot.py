import math
from typing import Any

import numpy
import pytest

from filtergym.envs.contract.model import Episode, Model
from filtergym.envs.contract.task import Scenario
from filtergym.envs.uav_autopilot.banks import MODES
from filtergym.envs.uav_autopilot.parameters import COORDINATES, UavAutopilotParameters
from filtergym.envs.uav_autopilot.task import UavAutopilot
from filtergym.filters import linear_systems

BOTH = pytest.mark.parametrize("plant", ["P", "U"])


def make(
    plant: str = "U", scenario: str = "random", control: str = "gain", xp: Any = numpy, **kw: Any
) -> Model:
    chosen: Scenario = UavAutopilot.scenarios[scenario]
    return Model(
        UavAutopilot(UavAutopilotParameters(**{**chosen.parameters, "plant": plant, **kw}), xp), control
    )


class Noise:
    """What the engine will hand to the task."""

    def __init__(self, model: Model, N: int, seed: int, steps: int) -> None:
        rng = numpy.random.default_rng(seed)
        self.uniforms = rng.random((model.task.noise.uniforms, N))
        self.initial = rng.standard_normal((model.task.noise.initial_normals, N))
        self.rows = rng.standard_normal((steps, model.task.noise.normals, N))


def begin(model: Model, noise: Noise) -> Episode:
    return model.measure(model.begin(noise.uniforms, noise.initial), noise.rows[0])


def actions(model: Model, seed: int, steps: int, N: int) -> numpy.ndarray:
    rng = numpy.random.default_rng(seed)
    if model.control == "gain":
        return rng.uniform(-1.2, 1.2, (steps, 1, N))
    return rng.integers(0, len(MODES), (steps, N))


# ---------------------------------------------------------------- design: the numbers of the reference tables


def theory(plant: str, feedback: str, **kw: Any) -> tuple[float, float, float]:
    d = make(plant, "paper-noise", **kw).task.design
    F, B, L, H, R = d.model.F, d.model.B, d.feedback, d.H, d.R
    Q, n = d.model.scaled_noise + d.model.other_noise, len(d.model.F)
    output = [c.name for c in COORDINATES[plant]].index({"P": "position", "U": "pitch"}[plant])
    if feedback == "true":
        X = linear_systems.stationary_covariance(F - B @ L, Q)
        u = (L @ X @ L.T)[0, 0]
    elif feedback == "filter":
        both = linear_systems.stationary_covariance(
            *linear_systems.estimate_feedback_loop(F, B, H, L, d.steady.gain, Q, R)
        )
        X, estimate = both[:n, :n], numpy.hstack([L, -L])
        u = (estimate @ both @ estimate.T)[0, 0]
    else:
        X = linear_systems.stationary_covariance(*linear_systems.measurement_feedback_loop(F, B, H, L, Q, R))
        raw = L @ H.T
        u = (raw @ (H @ X @ H.T + R) @ raw.T)[0, 0]
    return X[output, output], u, numpy.trace(d.weight @ X) + d.control_weight * u


TABLE = [
    ("P", "true", {}, 0.00442, 0.01279, 0.0216),
    ("P", "filter", {}, 0.26674, 0.06275, 0.3850),
    ("P", "raw", {}, 0.32622, 3.8538, 4.504),
    ("P", "filter", {"sensors": ("position",)}, 0.31021, 0.07145, 0.4461),
    ("U", "true", {}, 0.01349, 0.18205, 0.0788),
    ("U", "filter", {}, 0.05410, 0.24467, 0.1599),
    ("U", "raw", {}, 0.06275, 1.1424, 0.4447),
]


@pytest.mark.parametrize(("plant", "feedback", "kw", "output", "control", "cost"), TABLE)
def test_theory_of_the_reference_table(
    plant: str, feedback: str, kw: dict[str, Any], output: float, control: float, cost: float
) -> None:
    found = theory(plant, feedback, **kw)
    for value, expected in zip(found, (output, control, cost), strict=True):
        digits = len(f"{expected}".split(".")[1])
        # The table is printed; half a unit of its last digit, or 1e-4 relative where that is more.
        assert value == pytest.approx(expected, rel=1e-4, abs=0.55 * 10.0**-digits)


def test_design_of_plant_p() -> None:
    d = make("P").task.design
    numpy.testing.assert_allclose(d.feedback, [[0.80578, 1.50361]], atol=5e-6)
    numpy.testing.assert_allclose(d.steady.gain, [[0.12827, 0.03835], [0.03835, 0.02641]], atol=5e-6)
    numpy.testing.assert_allclose(numpy.sqrt(numpy.diag(d.steady.posterior)), [0.35815, 0.16252], atol=5e-6)
    control = numpy.linalg.eigvals(d.model.F - d.model.B @ d.feedback)
    numpy.testing.assert_allclose([control[0].real, abs(control[0].imag)], [0.7995, 0.1007], atol=5e-5)
    filter_pole = d.steady.poles[0]
    numpy.testing.assert_allclose([filter_pole.real, abs(filter_pole.imag)], [0.9179, 0.0690], atol=5e-5)
    one = make("P", sensors=("position",)).task.design.steady
    numpy.testing.assert_allclose(one.gain[:, 0], [0.14621, 0.04620], atol=5e-6)
    numpy.testing.assert_allclose(numpy.sqrt(numpy.diag(one.posterior)), [0.38238, 0.17435], atol=5e-6)


def test_design_of_plant_u() -> None:
    d = make("U").task.design
    numpy.testing.assert_allclose(d.feedback, [[0.88253, -0.34716, -1.63714, 0.51561, 0.83282]], atol=6e-6)
    assert d.feedforward == pytest.approx(-1.63714, abs=5e-6)
    poles = numpy.sort_complex(numpy.log(numpy.linalg.eigvals(d.model.F)) / 0.02)
    # The logarithm of the integrator's pole: rounding of one over T.
    numpy.testing.assert_allclose(poles, [-20, -1.909 - 5.070j, -1.909 + 5.070j, -0.7, 0], atol=6e-4)


@BOTH
def test_discrete_model_agrees_with_finite_differences_of_the_equations_of_motion(plant: str) -> None:
    if plant == "P":
        A, b, T = numpy.array([[0.0, 1.0], [0.0, 0.0]]), numpy.array([0.0, 1.0]), 0.25
    else:
        A = numpy.diag([-3.1194, -0.6984, 0.0, -20.0, -0.7])
        A[0, [1, 3, 4]] = 1.0, 0.3255, -3.1194
        A[1, [0, 3, 4]] = -27.168, -35.748, -27.168
        A[2, 1] = 1.0
        b, T = numpy.array([0.0, 0.0, 0.0, 20.0, 0.0]), 0.02
    model = make(plant).task.design.model
    x, u, steps = numpy.ones(len(A)), 2.0, 4000
    expected = model.F @ x + model.B[:, 0] * u
    for _ in range(steps):  # midpoint rule: error of order (T / 4000)^2
        middle = x + T / steps / 2 * (A @ x + b * u)
        x = x + T / steps * (A @ middle + b * u)
    # Coefficients in the table have five digits.
    numpy.testing.assert_allclose(x, expected, rtol=0, atol=1e-4)


# ---------------------------------------------------------------- the task against a plain loop


@pytest.mark.parametrize("control", ["gain", "mode"])
@BOTH
def test_task_equals_a_plain_kalman_filter_in_a_loop(plant: str, control: str) -> None:
    steps, N, seed = 60, 8, 2
    model = make(
        plant,
        "random",
        control,
        dropout_period=50,
        disturbance_times=((10, 20), (30, 40)),
        sensor_times=((10, 50),),
        undisturbed=0.0,
    )
    noise, a = Noise(model, N, seed, steps + 1), actions(model, seed, steps, N)
    d, p = model.task.design, model.task.parameters
    scales = {"wide-band": p.wide_band_scale, "over-smoothed": p.over_smoothed_scale}
    F, B, H, R, L = d.model.F, d.model.B[:, 0], d.H, d.R, d.feedback[0]
    Q = d.model.scaled_noise + d.model.other_noise
    state = begin(model, noise)
    lane = seed
    x, P, scale, raw = (
        numpy.zeros(len(F)),
        numpy.diag(numpy.square(model.task.parameters.value("initial_sigmas"))),
        1.0,
        None,
    )
    held, dropped, u = numpy.zeros(len(H)), 0, 0.0
    for k in range(steps):
        x, P = F @ x + B * u, F @ P @ F.T
        rows = state.measurement.available[:, lane] > 0
        dropped += int((~rows).sum())
        held[rows] = state.measurement.reading[rows, lane]
        shown = numpy.zeros(len(H))
        S = H @ (P + scale * Q) @ H.T + R
        shown[rows] = ((held - H @ x) / numpy.sqrt(numpy.diag(S)))[rows]
        # A covariance of five states, packed against full, over 60 steps.
        numpy.testing.assert_allclose(state.filter.innovation[:, lane], shown, rtol=0, atol=1e-9)
        if rows.any():
            nu = (held - H @ x)[rows]
            nis = nu @ numpy.linalg.solve(S[numpy.ix_(rows, rows)], nu) / rows.sum()
            assert state.filter.nis[lane] == pytest.approx(nis, rel=1e-9)
        choice = a[k][..., lane]
        if control == "gain":
            scale = 10.0 ** (p.gain_decades * numpy.clip(choice[0], -1, 1))
        else:
            scale = scales.get(MODES[choice], 1.0)
        P = P + scale * Q
        K = P @ H[rows].T @ numpy.linalg.inv(H[rows] @ P @ H[rows].T + R[numpy.ix_(rows, rows)])
        x = x + K @ (held - H @ x)[rows]
        rest = numpy.eye(len(F)) - K @ H[rows]
        P = rest @ P @ rest.T + K @ R[numpy.ix_(rows, rows)] @ K.T
        raw = control == "mode" and MODES[choice] == "raw-sensors"
        state = model.act(state, a[k])
        estimate = H.T @ held if raw else x
        numpy.testing.assert_allclose(state.filter.estimate[:, lane], estimate, rtol=0, atol=1e-9)
        if not raw:
            steered = control == "gain" and choice[0] != 0.0
            inflation = max(1.0, state.filter.mean_nis[lane]) if steered else 1.0
            numpy.testing.assert_allclose(
                model.covariance(state)[..., lane], inflation * P, rtol=1e-9, atol=1e-9
            )
        u = d.feedforward * state.measurement.command[lane] - L @ estimate
        truth = state.truth.state[:, lane].copy()
        truth[model.task.output] -= state.measurement.command[lane]
        cost = (truth @ d.weight @ truth + d.control_weight * u**2) / model.task.cost_unit
        assert model.cost(state)[lane] == pytest.approx(cost, rel=1e-9)
        numpy.testing.assert_allclose(
            model.error(state)[:, lane], estimate - state.truth.state[:, lane], rtol=0, atol=1e-9
        )
        state = model.measure(state, noise.rows[k + 1])
        assert state.measurement.control[lane] == pytest.approx(u, abs=1e-9)
    assert dropped > 0


@BOTH
def test_truth_follows_from_the_control_and_noise_covariances_are_those_stated(plant: str) -> None:
    model = make(plant, "gust-front", disturbance_times=((2, 2),), command_amplitude=(0.0, 0.0))
    noise = Noise(model, 80_000, 1, 2)
    before = model.begin(noise.uniforms, noise.initial)
    d = model.task.design
    for level in (1.0, 4.0):
        after = model.measure(before, noise.rows[int(level > 1)])
        w = (
            after.truth.state
            - d.true_model.F @ before.truth.state
            - d.true_model.B * after.measurement.control
        )
        Q = level**2 * d.true_model.scaled_noise + d.true_model.other_noise
        sigma = numpy.sqrt(numpy.diag(Q))
        # Five standard errors of a sample covariance of 80 000.
        numpy.testing.assert_allclose(
            w @ w.T / 80_000 / numpy.outer(sigma, sigma), Q / numpy.outer(sigma, sigma), rtol=0, atol=0.025
        )
        v = (after.measurement.reading - d.H @ after.truth.state) / numpy.sqrt(numpy.diag(d.R))[:, None]
        numpy.testing.assert_allclose(v @ v.T / 80_000, numpy.eye(len(d.R)), rtol=0, atol=0.025)
        before = model.act(after, numpy.zeros((1, 80_000)))


# ---------------------------------------------------------------- Monte Carlo of the reference table


@pytest.mark.parametrize(
    ("plant", "overshoot", "rise", "settling"), [("P", 0.0045, 3.5, 4.0), ("U", 0.0, 0.46, 0.54)]
)
def test_step_of_the_command(plant: str, overshoot: float, rise: float, settling: float) -> None:
    model = make(plant, "paper-step", step_time=1, horizon=100)
    noise = Noise(model, 8, 0, 101)
    noise.rows[:] = 0.0
    noise.initial[:] = 0.0
    state, outputs = begin(model, noise), []
    for k in range(100):
        outputs.append(model.records(state)["output"][0])
        state = model.measure(model.act(state, numpy.zeros((1, 8))), noise.rows[k + 1])
    y, T = numpy.array(outputs), model.task.parameters.value("sampling_interval")
    assert max(y.max() - 1.0, 0.0) == pytest.approx(overshoot, abs=5e-5)
    assert numpy.argmax(y >= 0.9) * T == pytest.approx(rise)
    assert (numpy.flatnonzero(abs(y - 1.0) > 0.05)[-1] + 1) * T == pytest.approx(settling)
    assert y[-1] == pytest.approx(1.0, abs=1e-3)


# ---------------------------------------------------------------- the contract


@BOTH
def test_counted_cost_is_what_the_error_of_the_estimate_loses(plant: str) -> None:
    """With the command known, the control is off by L times the error; a command moves both alike."""
    model = make(plant)
    assert model.task.design.optimal is not None
    L, regret = model.task.design.optimal
    noise = Noise(model, 8, 3, 31)
    episode = begin(model, noise)
    for k in range(30):
        episode = model.act(model.measure(episode, noise.rows[k + 1]) if k else episode, numpy.zeros((1, 8)))
        lost = (L @ model.error(episode))[0]
        expected = regret[0, 0] / model.task.cost_unit * lost**2
        numpy.testing.assert_allclose(model.counted_cost(episode), expected, rtol=1e-9, atol=1e-12)


def values(model: Model) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Riccati's S by iteration, and the optimal feedback."""
    d = model.task.design
    F, B, S = d.true_model.F, d.true_model.B, d.weight
    for _ in range(5000):
        L = numpy.linalg.solve(d.control_weight + B.T @ S @ B, B.T @ S @ F)
        rest = F - B @ L
        S = d.weight + d.control_weight * L.T @ L + rest.T @ S @ rest
    return S, L


@BOTH
def test_counted_cost_is_what_bellmans_equation_leaves_of_the_cost(plant: str) -> None:
    """With value V = x'Sx: cost + V(next) - V(now) = counted cost + what the noise does, to rounding, at every step."""
    model = make(plant, "paper-noise")
    F, B, (S, _) = model.task.design.true_model.F, model.task.design.true_model.B, values(model)
    noise, a = Noise(model, 8, 3, 41), actions(model, 3, 40, 8)
    state = begin(model, noise)
    for k in range(40):
        state = model.act(state, a[k])
        x, whole, counted = state.truth.state, model.cost(state), model.counted_cost(state)
        state = model.measure(state, noise.rows[k + 1])
        predicted = F @ x + B * state.measurement.control
        w = state.truth.state - predicted
        before, after = ((y * (S @ y)).sum(axis=0) for y in (x, state.truth.state))
        by_noise = (w * (S @ (w + 2.0 * predicted))).sum(axis=0)
        bellman = whole + (after - before - by_noise) / model.task.cost_unit
        numpy.testing.assert_allclose(counted, bellman, rtol=1e-6, atol=1e-9)


def test_counted_cost_is_the_cost_where_the_weights_leave_the_best_control_open() -> None:
    model = make("P", state_weights=(0.0, 1.0), feedback=(0.8, 1.5))
    assert model.task.design.optimal is None
    episode = model.act(begin(model, Noise(model, 8, 3, 1)), numpy.zeros((1, 8)))
    numpy.testing.assert_array_equal(model.counted_cost(episode), model.cost(episode))


# ---------------------------------------------------------------- what an episode of "random" is like


def test_random_episodes_hold_what_they_promise() -> None:
    model = make("U", undisturbed=0.0)
    N, p = 400, model.task.parameters
    noise = Noise(model, N, 0, 1)
    truth = model.begin(noise.uniforms, noise.initial).truth
    times, levels = truth.commands.times, truth.levels.values
    assert len(truth.commands.values) == len(times) + 1
    gust = p.value("initial_sigmas")[-1] * noise.initial[len(truth.state) - 1]
    numpy.testing.assert_allclose(truth.state[-1], levels[0] * gust, rtol=1e-12)
    assert (numpy.diff(times, axis=0) > 0).all()
    assert (times.max(axis=0) <= p.horizon).all()
    assert numpy.abs(levels).min() >= 0.2
    assert numpy.abs(levels).max() <= 5.0
    assert abs(numpy.log(levels).mean()) < 0.14  # log-uniform about one: four standard errors
    command = [truth.commands.at(numpy.full(N, k), numpy) for k in range(p.horizon)]
    changes = (numpy.diff(numpy.array(command), axis=0) != 0).sum(axis=0)
    assert changes.min() >= 4
    assert changes.max() <= 12
    assert set(numpy.unique(changes)) > {6, 8, 10}  # steps are one change, doublets three
    dropouts = truth.disturbances["dropouts"]
    length = dropouts.stops - dropouts.starts
    assert (length >= 1).all()
    assert (length <= 15).all()
    assert (dropouts.stops <= p.horizon + 1).all()


def test_one_of_six_has_no_hidden_disturbance() -> None:
    model, N = make("U"), 4000
    noise = Noise(model, N, 0, 1)
    truth = model.begin(noise.uniforms, noise.initial).truth
    calm = (truth.levels.values == 1.0).all(axis=0)
    assert abs(calm.mean() - 1 / 6) < 4 * math.sqrt(5 / 36 / N)
    sensor_levels, coloured, _, dropouts = truth.disturbances.values()
    assert (dropouts.stops > dropouts.starts).all()
    for values in (sensor_levels.levels.values - 1.0, coloured.process.kick, coloured.level):
        assert (values[..., calm] == 0.0).all()
        assert (values[..., ~calm] != 0.0).all()


@BOTH
def test_slow_errors_of_sensors_are_as_stated(plant: str) -> None:
    """Coloured errors have their stated deviation and correlation; a bias is constant, of the named sensor."""
    keywords: dict[str, Any] = {
        "sensor_coloured": (0.8, 0.8),
        "sensor_correlation_time": (1.0, 1.0),
        "sensor_bias": (1.0, 2.0),
        "biased_sensors": ("rate",),
    }
    model, N = make(plant, "paper-noise", **keywords), 20_000
    noise = Noise(model, N, 0, 1)
    before = model.begin(noise.uniforms, noise.initial)
    p, rate = model.task.parameters, list(model.task.sensors).index("rate")
    sigmas = numpy.array(p.value("sensor_sigmas"))[:, None]
    bias = before.truth.disturbances["bias"] / sigmas
    assert (numpy.delete(bias, rate, axis=0) == 0.0).all()
    assert abs(bias[rate]).min() >= 1.0
    assert abs(bias[rate]).max() <= 2.0
    assert abs((bias[rate] > 0.0).mean() - 0.5) < 2.0 / math.sqrt(N)
    after = model.measure(before, noise.rows[0])
    error = after.measurement.reading - model.task.design.H @ after.truth.state
    white = sigmas * noise.rows[0][model.task.world.drives :][: len(sigmas)]
    # The sum of four numbers against three of them: rounding.
    found = after.truth.disturbances
    slow = found["coloured"].level + found["bias"]
    numpy.testing.assert_allclose(error - white, slow, rtol=0, atol=1e-12)
    one, two = (each.truth.disturbances["coloured"].level / sigmas for each in (before, after))
    decay = math.exp(-p.value("sampling_interval"))
    # Four standard errors of a sample variance of as many episodes.
    for product, expected in ((one * one, 1.0), (two * two, 1.0), (one * two, decay)):
        found = product.mean(axis=1) / 0.8**2
        numpy.testing.assert_allclose(found, expected, rtol=0, atol=4.0 * math.sqrt(2.0 / N))
    numpy.testing.assert_array_equal(after.truth.disturbances["bias"], before.truth.disturbances["bias"])


def test_degradation_touches_the_rate_sensor_alone_and_lag_the_true_plant_alone() -> None:
    for plant in "PU":
        model = make(plant, "sensor-degradation")
        noise = Noise(model, 8, 0, 1)
        state = model.begin(noise.uniforms, noise.initial)
        after = state.truth.disturbances["noisy_sensors"].levels.values[1, :, 0]
        assert dict(zip(model.task.sensors, after, strict=True))["rate"] == pytest.approx(5.0)
        assert sorted(after)[:-1] == [1.0] * (len(after) - 1)
    lag = make("U", "actuator-lag").task.design
    assert lag.true_model.F[3, 3] == pytest.approx(math.exp(-0.02 / 0.1))
    assert lag.model.F[3, 3] == pytest.approx(math.exp(-0.02 / 0.05))


@pytest.mark.parametrize(
    ("kw", "message"),
    [
        ({"plant": "X"}, "plant must be one of"),
        ({"feedback": (0.0, 0.0, 0.0, 0.0, 0.0)}, "feedback must stabilise the plant.*spectral radius"),
        ({"feedback": (1.0, 2.0)}, "feedback must be 5 numbers"),
        ({"sensor_sigmas": (0.5, 0.0, 0.5)}, r"sensor_sigmas\[1\].*above 0.0.*got 0.0"),
        ({"gust_sigma": -1.0}, "gust_sigma must be a finite number above 0.0, got -1.0"),
        ({"moment_disturbance": 0.0}, "moment_disturbance"),
        ({"sensors": ("rate", "elevator")}, "sensors cannot detect.*add a sensor"),
        ({"sensors": ("speed",)}, "each of sensors must be one of"),
        ({"sensors": ("incidence",)}, "sensor_sigmas must be given"),
        ({"plant": "P", "actuator_lag": 2.0}, "has no actuator"),
        ({"step_size": 1.0, "command_amplitude": (0.5, 1.0)}, "exclude each other"),
        ({"disturbance_times": ((100, 200),)}, "one range more"),
        ({"disturbance_levels": ((1, 1), (0, 1)), "disturbance_times": ((5, 9),)}, "above 0.0"),
        ({"dropout_period": 15}, "longer than the longest dropout, 15, got 15"),
        ({"command_period": 40}, "longer than a doublet"),
        ({"horizon": 0}, "horizon must be an integer of at least 1"),
    ],
)
def test_bad_input_is_refused_with_the_reason(kw: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        UavAutopilot(UavAutopilotParameters(**kw))
