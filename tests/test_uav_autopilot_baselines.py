"""Policies, references, bound and metrics of UavAutopilot against theory and the table of the spec."""

import math
from functools import cache
from typing import Any

import numpy
import pytest
import xarray
from models import Asked, make_model

from filtergym import evaluate, tidy_records
from filtergym.baselines.catalogue import baselines_of
from filtergym.baselines.measurement_noise import MeasurementNoise, VariationalBayesMeasurementNoise
from filtergym.baselines.uav_autopilot import policies as module
from filtergym.baselines.uav_autopilot.estimators import AdaptiveKalman, GustInteractingMultipleModel
from filtergym.baselines.uav_autopilot.metrics import METRICS, detect_raised_noise
from filtergym.baselines.uav_autopilot.references import Matched
from filtergym.baselines.uav_autopilot.theory import stationary
from filtergym.envs.uav_autopilot.banks import MODES
from filtergym.envs.uav_autopilot.level_bank import Kind, LevelBank
from filtergym.evaluation.running.rollout import rollout
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.evaluation.statistics.bootstrap import Bootstrap
from filtergym.evaluation.statistics.statistic import reduce_run
from filtergym.filters import linear_systems
from filtergym.papers import uav_autopilot_kalman as paper
from filtergym.papers.uav_autopilot_kalman import experiment, structure

ID = "filtergym/UavAutopilot-v0"
BOTH = pytest.mark.parametrize("plant", ["P", "U"])
SAME = ("kalman", "steady-kalman", "matched", "known-noise-bound")
"""Those that are one filter where the noise is nominal."""


@cache
def run(plant: str, scenario: str, episodes: int, names: tuple[str, ...]) -> xarray.Dataset:
    return evaluate(ID, names, scenario, episodes, plant=plant)


# ---------------------------------------------------------------- theory


def test_no_theory_where_the_loop_is_not_stationary_or_not_stable() -> None:
    def theory(name: str, scenario: str = "paper-noise", **keywords: Any) -> Any:
        control = "mode" if name == "raw-sensors" else "gain"
        return stationary(make_model(ID, control, scenario, **keywords).task, name)

    # Output and control variance and cost as printed, to a unit of the last digit; the cost has a unit of 0.25.
    for name, printed in (
        ("true-state", (0.01349, 0.18205, 0.0788)),
        ("kalman", (0.05410, 0.24467, 0.1599)),
        ("raw-sensors", (0.06275, 1.1424, 0.4447)),
    ):
        output, control, cost = theory(name)[:3]
        assert (output, control, 0.25 * cost) == pytest.approx(printed, abs=1e-4)
    assert theory("kalman", "random") is None
    assert theory("kalman", "actuator-lag") is None
    assert theory("kalman", "gyro-bias") is None
    assert theory("kalman", sensor_coloured=(0.1, 0.2)) is None
    assert theory("innovation-adaptive") is None
    # It follows the scales that the modes have, whatever an action of one does under gain.
    nominal = pytest.approx(theory("kalman"), rel=1e-12)
    assert (
        theory("wide-band", wide_band_scale=1.0)
        == nominal
        == theory("over-smoothed", over_smoothed_scale=1.0)
    )
    assert theory("wide-band") == pytest.approx(theory("wide-band", gain_decades=0.1), rel=1e-12)
    assert theory("raw-sensors", plant="P", sensors=("position",)) is None


def test_records_hold_the_theory_in_the_steady_window_alone() -> None:
    found = {
        (r.metric, r.window): r.value
        for r in tidy_records(run("U", "paper-noise", 2, ("kalman",)))
        if not r.component
    }
    expected = stationary(make_model(ID, "gain", "paper-noise", plant="U").task, "kalman")
    assert expected is not None
    assert {key: value for key, value in found.items() if key[0].endswith("_theory")} == {
        ("output_variance_theory", "steady"): expected.output_variance,
        ("control_variance_theory", "steady"): expected.control_variance,
        ("cost_theory", "steady"): expected.cost,
    }


# ---------------------------------------------------------------- references and the bound


def test_matched_is_a_kalman_filter_of_all_that_befalls_an_episode() -> None:
    """Matrices written out, one episode: levels, dropouts, coloured and constant errors, a slow actuator."""
    keywords = {"sensor_bias": (0.5, 1.0), "actuator_lag": 1.5, "undisturbed": 0.0, "horizon": 60}
    keywords |= {"disturbance_times": ((10, 20), (30, 40)), "sensor_times": ((10, 50),), "dropout_period": 30}
    model: Any = make_model(ID, "gain", "random", command_period=60, **keywords)
    d, sigmas = model.task.design, numpy.array(model.task.parameters.value("sensor_sigmas"))
    n, m = len(d.model.F), len(sigmas)
    seen: list[tuple[Any, Any]] = []
    found: list[Any] = []

    class Watched(Matched):
        def update(self, memory: Any, measurement: Any, truth: Any) -> Any:
            result = super().update(memory, measurement, truth)
            seen.append((measurement, truth))
            found.append(result)
            return result

    for _ in rollout(model, Watched(model.task), episode_seeds("test", 0, 2)):
        pass
    lane, truth = 1, seen[0][1]
    psi, kick = (each[:, lane] for each in truth.disturbances["coloured"].process)
    initial = numpy.square(model.task.parameters.value("initial_sigmas"))
    initial[n - 1] *= truth.levels.values[0, lane] ** 2
    x, P = numpy.zeros(n + m), numpy.diag([*initial, *(kick**2 / (1.0 - psi**2))])
    F = numpy.pad(d.true_model.F, (0, m)) + numpy.diag([0.0] * n + [*psi])
    C = numpy.hstack([d.H, numpy.eye(m)])
    dropped = 0
    for (measurement, truth), (mean, covariance, _, likelihood) in zip(seen, found, strict=True):
        Q = truth.level[lane] ** 2 * d.true_model.scaled_noise + d.true_model.other_noise
        x = F @ x + numpy.append(d.true_model.B[:, 0], [0.0] * m) * measurement.control[lane]
        P = F @ P @ F.T + numpy.pad(Q, (0, m)) + numpy.diag([*[0.0] * n, *kick**2])
        there = measurement.available[:, lane] > 0.0
        dropped += int((~there).sum())
        H, R = C[there], numpy.diag((sigmas * truth.sensor_level[:, lane])[there] ** 2)
        S = H @ P @ H.T + R
        nu = (measurement.reading[:, lane] - truth.disturbances["bias"][:, lane])[there] - H @ x
        K = P @ H.T @ numpy.linalg.inv(S)
        x, P = x + K @ nu, (numpy.eye(n + m) - K @ H) @ P
        if there.any():
            assert likelihood.nis[lane] == pytest.approx(nu @ numpy.linalg.solve(S, nu), rel=1e-8)
        # Packed against full, sixty steps.
        numpy.testing.assert_allclose(mean[:, lane], x[:n], rtol=0, atol=1e-10)
        numpy.testing.assert_allclose(covariance[..., lane], P[:n, :n], rtol=0, atol=1e-10)
    assert dropped > 0
    assert (kick > 0.0).all()
    assert (truth.disturbances["bias"][:, lane] != 0.0).all()


@BOTH
def test_bound_is_the_covariance_of_the_nominal_filter_when_the_noise_is_nominal(plant: str) -> None:
    model = make_model(ID, "gain", "paper-noise", plant=plant)
    bound = run(plant, "paper-noise", 2, SAME)["mean_square"].sel(policy="known-noise-bound").values[0]
    d = model.task.design  # type: ignore[attr-defined]
    P = numpy.diag(numpy.square(model.task.parameters.value("initial_sigmas")))
    Q = d.model.scaled_noise + d.model.other_noise
    for k in range(300):
        P = d.model.F @ P @ d.model.F.T + Q
        K = P @ d.H.T @ numpy.linalg.inv(d.H @ P @ d.H.T + d.R)
        P = (numpy.eye(len(P)) - K @ d.H) @ P
        numpy.testing.assert_allclose(bound[k], numpy.diag(P), rtol=1e-9)


@BOTH
def test_steady_filter_becomes_the_paper_filter(plant: str) -> None:
    dataset = run(plant, "paper-noise", 2, SAME)
    error = dataset["error"].sel(policy=["kalman", "steady-kalman"])
    gap = numpy.abs(error.diff("policy")).max(["policy", "episode", "component"]).values
    model = make_model(ID, "gain", "paper-noise", plant=plant)
    slowest = linear_systems.spectral_radius(numpy.diag(model.task.design.steady.poles))  # type: ignore[attr-defined]
    # Both forget their start with the filter's slowest pole.
    assert gap[599] < 10.0 * gap[99] * slowest**500 + 1e-9
    assert gap[0] > 0.1


# ---------------------------------------------------------------- policies


@BOTH
def test_constant_policies_name_what_they_stand_for(plant: str) -> None:
    policies = baselines_of(ID).policies
    model = make_model(ID, "gain", plant=plant)
    observation = numpy.zeros((3, len(model.fields)))
    numpy.testing.assert_array_equal(policies["kalman"](model).predict(observation)[0], numpy.zeros((3, 1)))
    model = make_model(ID, "mode", plant=plant)
    observation = numpy.zeros((3, len(model.fields)))
    for name in ("wide-band", "raw-sensors", "over-smoothed"):
        found, _ = policies[name](model).predict(observation)
        assert [MODES[i] for i in found] == [name] * 3


def test_adaptive_policy_by_hand() -> None:
    model = make_model(ID, "gain")
    policy = module.InnovationAdaptive(model, window=4.0, memory=0.25, offset=0.1, weights=(0.5, -0.25, 0.0))
    sensors = model.task.sensors  # type: ignore[attr-defined]
    names = [f.name for f in model.fields]
    rng = numpy.random.default_rng(0)
    nu, there, last = rng.standard_normal((3, 2, 3)), rng.integers(0, 2, (3, 2, 3)), [0.3, -0.7]
    memory: Any = None
    mean = numpy.ones((2, 3))
    for k in range(3):
        start = numpy.array([k == 0, k in (0, 2)])
        mean[start] = 1.0
        observation = numpy.zeros((2, len(names)))
        for j, s in enumerate(sensors):
            observation[:, names.index(f"innovation_{s}")] = numpy.sign(nu[k, :, j]) * numpy.log1p(
                abs(nu[k, :, j])
            )
            observation[:, names.index(f"available_{s}")] = there[k, :, j]
        observation[:, names.index("action")] = last
        action, memory = policy.predict(observation, memory, start)
        mean = mean + 0.25 * there[k] * (nu[k] ** 2 - mean)
        decades = 0.1 + 0.5 * numpy.log10(mean[:, 0]) - 0.25 * numpy.log10(mean[:, 1])
        wanted = numpy.clip(
            0.25 * numpy.array(last) + 0.75 * decades / model.task.parameters.value("gain_decades"), -1.0, 1.0
        )
        numpy.testing.assert_allclose(action[:, 0], wanted, rtol=1e-12)


# ---------------------------------------------------------------- metrics


def hand_made(output: numpy.ndarray, **more: Any) -> xarray.Dataset:
    """Dataset of one policy with a given output and nothing else in motion."""
    dataset = evaluate(ID, ["kalman"], "paper-step", len(output), **more).isel(policy=0).copy(deep=True)
    dataset["output"].values[:] = output
    return dataset


def own(dataset: xarray.Dataset) -> dict[tuple[str, str], float]:
    bootstrap = Bootstrap(dataset.sizes["episode"], 20)
    results = reduce_run(dataset, METRICS.statistics, bootstrap).results()
    found = METRICS.measures_of(results, bootstrap, dataset)
    return {(m.metric, m.window): m.estimate.value for m in found}


def test_step_metrics_by_hand() -> None:
    time = numpy.arange(1, 601)
    output = numpy.where(time < 210, 0.0, numpy.where(time < 220, 1.2, 1.0))
    found = own(hand_made(numpy.stack([output + 0.03, output - 0.03])))
    assert found["overshoot", "transient"] == pytest.approx(0.2)
    assert found["rise_time", "transient"] == pytest.approx(0.2)
    assert found["settling_time", "transient"] == pytest.approx(0.4)
    assert found["mean_output", "steady"] == pytest.approx(1.0)
    assert found["output_variance", "steady"] == pytest.approx(2 * 0.03**2)
    assert found["tracking_rmse", "steady"] == pytest.approx(0.03)


def test_times_never_reached_are_cut_off_not_nan() -> None:
    found = own(hand_made(numpy.zeros((2, 600))))
    assert found["rise_time", "transient"] == found["settling_time", "transient"] == pytest.approx(100 * 0.02)


def test_whiteness_by_hand() -> None:
    dataset = hand_made(numpy.zeros((50, 600)))
    noise = numpy.random.default_rng(0).standard_normal((50, 601))
    dataset["innovation"].values[:] = noise[:, 1:] + 0.5 * noise[:, :-1]  # moving average: 0.5 / 1.25
    found = own(dataset)
    assert found["innovation_autocorrelation", "all"] == pytest.approx(0.4, abs=4.0 / math.sqrt(50 * 600))


def test_alarms_by_hand() -> None:
    times = 40
    nis, degrees = numpy.full((5, times), 3.0), numpy.full((5, times), 3.0)
    raised = numpy.zeros((5, times), bool)
    raised[:3, 20:], raised[3] = True, True
    nis[0, 25:] = nis[1, 5:8] = nis[3, 5:] = 30.0
    nis[:, 30] = math.nan
    # Each large one adds 30 / 3 - 3/2 log 3 = 8.35: the limit log(40 / 0.02) = 7.6 is reached at once.
    found = detect_raised_noise(nis, degrees, raised)
    numpy.testing.assert_array_equal(
        found,
        [
            [0, 1, 0, 1, 5, 1],  # noise is raised at 20, the alarm comes at 25
            [1, 1, 1, 1, 0, 0],  # an alarm too early, and none when it matters
            [0, 1, 1, 1, 0, 0],
            [0, 0, 0, 0, 0, 0],  # raised from the start: does not count
            [0, 1, 0, 0, 0, 0],
        ],
    )


def test_lost_loops_are_counted_and_every_number_stays_finite() -> None:
    dataset = evaluate(
        ID, ["kalman", "raw-sensors"], "paper-noise", 10, plant="P", sensors=("position",), horizon=1500
    )
    assert numpy.isfinite(dataset["cost"].values).all()
    assert numpy.abs(dataset["output"].values).max() == 1e4
    found = {(r.policy, r.metric, r.window): r for r in tidy_records(dataset)}
    assert found["raw-sensors", "lost_tracks", "all"].value == pytest.approx(1.0)
    assert found["kalman", "lost_tracks", "all"].value == 0.0
    skipped = ("score", "peak_rmse")
    assert all(r.value is not None for r in found.values() if r.metric not in skipped)


# ---------------------------------------------------------------- the reproduction


@pytest.mark.slow
def test_reproduction_with_few_runs_reports_its_progress() -> None:
    done: list[float] = []
    result = paper.reproduce(done.append, 20)
    assert sum(done) == paper.STEPS
    assert all(caption for _, caption in result.figures.values())
    verdicts = {c.key: c.verdict for c in result.claims}
    assert verdicts["2"] == "reproduced"


@BOTH
def test_theory_spectra_integrate_to_the_variances(plant: str) -> None:
    model = make_model(ID, "gain", "paper-noise", plant=plant)
    T = model.task.parameters.value("sampling_interval")
    # A mean over equally spaced frequencies of a periodic function converges faster than any power.
    frequency = numpy.arange(4096) / 4096 / T
    spectra = experiment.theory_spectra(model.task, frequency)  # type: ignore[arg-type]
    d = model.task.design  # type: ignore[attr-defined]
    theory = stationary(model.task, "kalman")  # type: ignore[arg-type]
    assert theory is not None
    drive = 0.2**2 if plant == "P" else 0.0
    i = model.task.output  # type: ignore[attr-defined]
    shown = model.task.measured.index(i)  # type: ignore[attr-defined]
    sums = {name: float(values.mean() / T) for name, values in spectra.items()}
    assert sums["plant_input"] == pytest.approx(theory.control_variance + drive, rel=1e-9)
    assert sums["observation"] == pytest.approx(theory.output_variance + d.R[shown, shown], rel=1e-9)
    # The error of an optimal estimate is orthogonal to it.
    assert sums["estimate"] == pytest.approx(theory.output_variance - d.steady.posterior[i, i], rel=1e-9)


@BOTH
def test_the_control_reaches_what_one_control_at_a_time_reaches(plant: str) -> None:
    """Naive oracle: where each of n controls in a row leads, by the equation of motion."""
    F, B, H, *_ = experiment.matrices(make_model(ID, "gain", "paper-noise", plant=plant).task)  # type: ignore[arg-type]
    n = len(F)
    reached = []
    for k in range(n):
        x = numpy.zeros(n)
        for i in range(n):
            x = F @ x + B[:, 0] * (i == k)
        reached.append(x)
    C = structure.controllability_matrix(F, B)
    numpy.testing.assert_allclose(C[:, ::-1], numpy.transpose(reached), rtol=0, atol=1e-12)
    assert numpy.linalg.matrix_rank(structure.controllability_matrix(F.T, H.T)) == n
    modes = structure.unreached_modes(F, B)
    if plant == "P":
        assert numpy.linalg.det(C) == pytest.approx(-(0.25**3), rel=1e-12)
        assert len(modes) == 0
    else:
        # The gust alone: V = 35 m/s over its scale of 50 m, in 0.02 s.
        assert modes == pytest.approx([math.exp(-35.0 / 50.0 * 0.02)], rel=1e-9)


@BOTH
def test_width_and_approximations_are_those_of_a_long_run(plant: str) -> None:
    """Naive oracle: the loop run as it is written, its periodogram and its differences."""
    task: Any = make_model(ID, "gain", "paper-noise", plant=plant).task
    F, B, H, L, K, Q, R = experiment.matrices(task)
    random, runs, length = numpy.random.default_rng(0), 400, 1024
    root, sensor = linear_systems.noise_factor(Q), numpy.linalg.cholesky(R)
    x = estimate = numpy.zeros((len(F), runs))
    states = []
    for _ in range(200 + length):
        u = -L @ estimate
        x = F @ x + B @ u + root @ random.standard_normal(x.shape)
        predicted = F @ estimate + B @ u
        reading = H @ x + sensor @ random.standard_normal((len(R), runs))
        estimate = predicted + K @ (reading - H @ predicted)
        states.append(x)
    path = numpy.array(states[200:])
    T = task.parameters.value("sampling_interval")
    y, rate = path[:, task.output], path[:, 1]
    frequency, power = experiment.spectrum(y.T * numpy.hanning(length), T)
    share = numpy.cumsum(power) / power.sum()
    width = structure.spectral_width(task)
    # Frequencies are T^-1 / 1024 apart, a fiftieth and a hundredth of the width, and the window spreads over two.
    assert width == pytest.approx(float(frequency[numpy.argmax(share >= 0.99)]), rel=0.05)
    step = y[1:] - y[:-1]
    acceleration = (rate[1:] - rate[:-1]) / T
    errors = step, step - T * rate[:-1], step - T * rate[:-1] - T**2 / 2 * acceleration
    measured = [numpy.sqrt((error**2).mean() / (y**2).mean()) for error in errors]
    # Of 400 runs of some twenty independent values each.
    assert structure.approximation_errors(task) == pytest.approx(measured, rel=0.02, abs=1e-12)


# ---------------------------------------------------------------- noise estimated in the loop


@BOTH
def test_with_noise_as_stated_an_adaptive_filter_is_the_papers(plant):
    makers: dict[str, Any] = {
        "kalman": "kalman",
        "own": AdaptiveKalman,
    }
    makers["own"].kind = "estimator"
    error = evaluate(ID, makers, "random", 8, plant=plant)["error"]
    # One sensor after the other, as in the bank; the loop carries rounding on, and is stable.
    numpy.testing.assert_allclose(error.sel(policy="own"), error.sel(policy="kalman"), rtol=0, atol=1e-10)


@BOTH
def test_noise_is_estimated_from_the_innovation(plant):
    """Of the first sensor, by the matrices of the plant; in a dropout nothing."""
    model = make_model(ID, plant=plant, backend="numpy", horizon=40)
    kept = []

    class Watched(MeasurementNoise):
        def update(self, memory, innovation, P, stated, available):
            kept.append((innovation, available))
            return super().update(memory, innovation, P, stated, available)

    class Flown(Asked):
        def update(self, memory, measurement):
            predicted = design.F @ memory.mean + model.task.constant(design.B) * measurement.control
            first = len(kept)
            answer = super().update(memory, measurement)
            innovation, available = kept[first]
            seen = available > 0.0
            expected = measurement.reading[0] - predicted[model.task.measured[0]]
            numpy.testing.assert_allclose(innovation[seen], expected[seen], rtol=1e-9, atol=1e-12)
            return answer

    design = model.task.design.model
    for _ in rollout(model, Flown(AdaptiveKalman(model.task, Watched)), range(8)):
        pass
    assert len(kept) >= 40


@BOTH
def test_an_imm_over_equal_gusts_is_one_filter(plant):
    def equal(task: Any) -> GustInteractingMultipleModel:
        return GustInteractingMultipleModel(task, memory=50.0, low=1.0, high=1.0)

    def one(task: Any) -> AdaptiveKalman:
        return AdaptiveKalman(task, VariationalBayesMeasurementNoise, memory=50.0)

    equal.kind = one.kind = "estimator"  # type: ignore[attr-defined]
    error = evaluate(ID, {"imm": equal, "one": one}, "random", 8, plant=plant)["error"]
    numpy.testing.assert_allclose(error.sel(policy="imm"), error.sel(policy="one"), rtol=0, atol=1e-10)


# ---------------------------------------------------------------- the bank over levels


def bank(**changed: Any) -> Any:
    def make(task: Any) -> LevelBank:
        return LevelBank(task, **changed)

    make.kind = "estimator"  # type: ignore[attr-defined]
    return make


@BOTH
def test_a_bank_over_one_level_is_a_kalman_filter(plant: str) -> None:
    one = {"gusts": (1.0, 1.0), "gust_points": 1, "sensors": (1.0, 1.0), "sensor_points": 1, "slow": ()}
    error = evaluate(ID, {"kalman": "kalman", "bank": bank(**one)}, "random", 8, plant=plant)["error"]
    # The same filter twice, merged with itself: the loop carries rounding on, and is stable.
    numpy.testing.assert_allclose(error.sel(policy="bank"), error.sel(policy="kalman"), rtol=0, atol=1e-9)
    if plant == "U":
        slower = bank(**one, kinds=(Kind(lag=2.0),))
        error = evaluate(ID, {"matched": "matched", "bank": slower}, "actuator-lag", 8)["error"]
        numpy.testing.assert_allclose(
            error.sel(policy="bank"), error.sel(policy="matched"), rtol=0, atol=1e-9
        )


def test_a_slow_error_in_the_bank_equals_that_of_the_matched_filter() -> None:
    """Coloured errors of one deviation and correlation time, all else nominal: both filters are one."""
    keywords: dict[str, Any] = {"sensor_coloured": (0.5, 0.5), "sensor_correlation_time": (2.0, 2.0)}
    changed = {"gusts": (1.0, 1.0), "gust_points": 1, "sensors": (1.0, 1.0), "sensor_points": 1}
    kind = Kind(error=0.5, error_time=2.0, always=True)
    makers = {
        "matched": "matched",
        "bank": bank(**changed, slow=("pitch", "rate", "elevator"), kinds=(kind,)),
    }
    error = evaluate(ID, makers, "paper-noise", 8, **keywords)["error"]
    numpy.testing.assert_allclose(error.sel(policy="bank"), error.sel(policy="matched"), rtol=0, atol=1e-9)
