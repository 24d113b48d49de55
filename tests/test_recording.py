"""Recorded measurements: replay is the simulation bit for bit, files come back, tables are read or refused."""

import copy
import dataclasses
import json
import pickle
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas
import pytest
from models import make_model

from filtergym import evaluate, read_recording, record, tidy_records
from filtergym.baselines.problem import problem_of
from filtergym.commands.evaluation import causal_competitors
from filtergym.envs.contract.companions import find_companion
from filtergym.envs.contract.log_format import LogFormat
from filtergym.envs.data.recorded_world import measure_once
from filtergym.envs.engine.catalogue import task_class
from filtergym.envs.engine.episode_noise import uniforms_of_seeds
from filtergym.envs.engine.lanes import Lanes
from filtergym.envs.logs.recorded_tables import Columns
from filtergym.envs.maneuvering_target.logs import read_log
from filtergym.evaluation.running.metrics import chi_square_band
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.filters.gaussian import log_density
from filtergym.filters.imm import log_mixture_density

TARGET, LOOSE = "filtergym/ManeuveringTarget-v0", "filtergym/LooselyCoupledNavigation-v0"
ESM, TIGHT = "filtergym/RadarEsmTracking-v0", "filtergym/TightlyCoupledNavigation-v0"
UAV = "filtergym/UavAutopilot-v0"
OPEN = {
    TARGET: {"horizon": 24},
    LOOSE: {"horizon": 40, "axes": 2, "decision_interval": 1},
    ESM: {"horizon": 24, "decision_interval": 1},
    TIGHT: {"scenario": "rates-lost", "horizon": 12, "decision_interval": 3},
}
DOCS = Path(__file__).parent.parent / "docs"


@pytest.fixture(scope="module")
def recordings():
    """One short recording of every environment with an open loop."""
    return {env: record(env, episodes=3, backend="numpy", **keywords) for env, keywords in OPEN.items()}


def blind(recording):
    return dataclasses.replace(recording, truth=None)


# --- replay


@pytest.mark.parametrize(("env", "backend"), [*((env, "numpy") for env in OPEN), (TARGET, "compiled")])
def test_replay_is_the_simulation_bit_for_bit(env, backend, tmp_path):
    keywords = OPEN[env]
    control = make_model(env).task.controls[-1]
    made = record(env, episodes=3, backend=backend, **keywords)
    made.write(tmp_path / "recording.nc")
    read = read_recording(tmp_path / "recording.nc")
    original = gym.make_vec(env, num_envs=3, control=control, backend=backend, **keywords, reward="cost")
    replay = gym.make_vec(env, num_envs=3, control=control, backend=backend, scenario=read, reward="cost")
    seeds = {}
    for seed in range(100):
        uniforms = uniforms_of_seeds([seed], replay.unwrapped.task.noise)
        seeds[int(replay.unwrapped.task.flight_of(uniforms)[0])] = seed
    shown = [
        original.reset(seed=[int(s) for s in episode_seeds("test", 0, 3)])[0],
        replay.reset(seed=[seeds[i] for i in range(3)])[0],
    ]
    np.testing.assert_array_equal(*shown)
    original.action_space.seed(1)
    decisions = keywords["horizon"] // original.unwrapped.task.decision_interval
    for i in range(decisions):
        action = original.action_space.sample()
        (seen, paid, _, over, _), (seen2, paid2, _, over2, _) = original.step(action), replay.step(action)
        np.testing.assert_array_equal(seen, seen2)  # the last one too, on which no action follows
        np.testing.assert_array_equal(paid, paid2)
        np.testing.assert_array_equal(over, over2)
        assert over.all() == (i == decisions - 1)


@pytest.mark.parametrize("env", [LOOSE, ESM])
def test_nothing_of_a_recording_is_lost_to_the_decision_interval(env):
    """Without a named interval an agent acts at every measurement, in an episode of any length."""
    interval = make_model(env).task.decision_interval
    assert interval > 1
    made = record(env, episodes=1, backend="numpy", horizon=interval + 1, decision_interval=1)
    blank = dataclasses.replace(made, parameters={})
    task = make_model(env, scenario=blank).task
    assert (task.horizon, task.decision_interval) == (interval + 1, 1)
    named = make_model(env, scenario=blank, decision_interval=interval).task
    assert (named.horizon, named.decision_interval) == (interval, interval)


def test_torch_replays_too(recordings, torch):
    env = gym.make_vec(TARGET, num_envs=2, backend="torch", scenario=recordings[TARGET])
    other = gym.make_vec(TARGET, num_envs=2, backend="numpy", scenario=recordings[TARGET])
    shown, expected = env.reset(seed=3)[0], other.reset(seed=3)[0]
    np.testing.assert_allclose(shown.numpy(), expected, rtol=1e-12, atol=1e-12)
    action = np.zeros(env.action_space.shape)
    np.testing.assert_allclose(env.step(action)[1].numpy(), other.step(action)[1], rtol=1e-9, atol=1e-9)


def test_episodes_of_different_lengths_end_where_they_do(tmp_path):
    made = record(TARGET, episodes=3, backend="numpy", horizon=12)
    lengths = np.array([12, 7, 4])
    there = np.arange(13) < lengths[:, None]  # without the measurement after the last one
    cut = dataclasses.replace(made, lengths=lengths, seconds=np.where(there, made.seconds, np.nan))
    cut.write(tmp_path / "cut.nc")
    read = read_recording(tmp_path / "cut.nc", TARGET)
    assert read.rows.tolist() == lengths.tolist()
    model = make_model(TARGET, scenario=read)
    assert model.task.flights == (12, 7, 4)
    assert model.task.horizon == 12
    dataset = evaluate(TARGET, ["imm"], scenario=read, backend="numpy")
    assert dataset["length"].values.tolist() == lengths.tolist()
    assert make_model(TARGET, scenario=read, horizon=5).task.flights == (5, 5, 4)
    assert make_model(TARGET, scenario=read, decision_interval=3).task.flights == (12, 6, 3)
    env = gym.make(TARGET, scenario=read, context=True)
    _, info = env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[3] for _ in range(lengths[int(info["context"]["recording"])])]
    assert ends == [False] * (len(ends) - 1) + [True]


def test_flights_and_user_keywords_go_with_a_recording():
    time = np.arange(0.0, 300.0, 6.0)
    flights = [
        {
            "time": time[:n],
            "position": np.column_stack([1e4 + 150.0 * time[:n], 5e3 + 0.0 * time[:n]]),
            "name": name,
        }
        for n, name in ((40, "a"), (25, "b"))
    ]
    scenario = {"trajectories": flights, "fewest_scans": 2}
    made = record(TARGET, scenario, episodes=24, backend="numpy", range_sigma=50.0)
    assert made.parameters == {"range_sigma": 50.0}  # and no table of the flights
    assert sorted(set(made.lengths.tolist())) == [24, 39]
    assert make_model(TARGET, scenario=made).task.parameters.range_sigma == 50.0
    assert make_model(TARGET, scenario=made, range_sigma=70.0).task.parameters.range_sigma == 70.0
    timed = record(LOOSE, episodes=1, backend="numpy", duration=0.3)
    assert make_model(LOOSE, scenario=timed).task.horizon == 30
    assert "duration" not in timed.parameters


def test_a_recording_travels(recordings, tmp_path):
    recording = recordings[ESM]
    env = gym.make(ESM, scenario=recording)
    shown, _ = env.reset(seed=5)
    action = env.action_space.sample()
    following = env.step(action)[0]
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(again.reset(seed=5)[0], shown)
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        other.reset(seed=5)
        np.testing.assert_array_equal(other.step(action)[0], following)
    recording.write(tmp_path / "esm.nc")
    named = gym.make(ESM, scenario=str(tmp_path / "esm.nc"))
    np.testing.assert_array_equal(named.reset(seed=5)[0], shown)


# --- without truth


def test_without_truth_rewards_are_zero_and_nothing_is_judged(recordings):
    recording = blind(recordings[TARGET])
    env = gym.make(TARGET, scenario=recording, detailed_info=True, render_mode="rgb_array")
    env.reset(seed=0)
    _, paid, _, _, info = env.step(env.action_space.sample())
    assert paid == 0.0
    assert not {"error", "cost", "truth"} & info.keys()
    assert "estimate" in info
    assert env.render().shape[2] == 3
    vector = gym.make_vec(TARGET, num_envs=3, scenario=recording)
    vector.reset(seed=0)
    assert vector.step(vector.action_space.sample())[1].tolist() == [0.0] * 3
    for keywords in ({"reward": "cost"}, {"observation": "asymmetric"}):
        with pytest.raises(ValueError, match="has no truth, so the cost of an estimate is not known"):
            gym.make(TARGET, scenario=recording, **keywords)
    paying = gym.make(TARGET, horizon=24, reward="cost").unwrapped  # also of a scan that missed
    with pytest.raises(ValueError, match="and this environment gives rewards: make another environment"):
        paying.reset(options={"scenario": recording})
    paying.reset(options={"scenario": recordings[TARGET]}, seed=0)
    assert paying.step(paying.action_space.sample())[1] != 0.0


def test_without_truth_evaluation_reports_innovations(recordings):
    dataset = evaluate(TARGET, ["imm", "kalman-imm"], scenario=blind(recordings[TARGET]), backend="numpy")
    assert not {"error", "cost", "compressed_cost", "nees"} & set(dataset)
    found = {(r.policy, r.metric): r for r in tidy_records(dataset) if r.window == "all"}
    seen = recordings[TARGET].measurements["available"][:, : dataset.sizes["time"]] > 0.0
    assert not seen.all()
    for name in ("imm", "kalman-imm"):
        nis, likelihood = (dataset[of].sel(policy=name).values for of in ("nis", "log_likelihood"))
        for values in (nis, likelihood):
            np.testing.assert_array_equal(np.isfinite(values), seen)
        assert found[name, "anis"].value == pytest.approx(nis[seen].mean() / 2.0)
        assert found[name, "log_likelihood"].value == pytest.approx(likelihood[seen].mean())
        low, high = chi_square_band(np.array([2.0]))
        inside = (nis[seen] >= low) & (nis[seen] <= high)
        assert found[name, "nis_inside"].value == pytest.approx(inside.mean())
        total = 2.0 * seen.sum()
        low, high = chi_square_band(np.array([total]))
        band = found[name, "anis_band"]
        assert (band.low, band.high) == pytest.approx((low[0] / total, high[0] / total))


@pytest.mark.parametrize("control", ["evidence", "gain"])
def test_log_likelihood_is_the_density_of_what_was_predicted(control):
    model = make_model(TARGET, control, horizon=10)
    lanes = Lanes(model, 64)
    for lane in range(64):
        lanes.seed(lane, np.random.default_rng(lane))
    lanes.restart()
    for _ in range(3):
        lanes.decide(np.full((64, *model.action_space.shape), 0.3))
    action = np.full((*model.action_space.shape, 64), 0.3)
    bank, reported = lanes.state.filter, model.records(model.act(lanes.state, action))
    if control == "gain":
        S = np.stack([np.diag(v) for v in bank.innovation_variance.T], axis=-1)
        expected = log_density(bank.innovation, S)[0]
    else:
        each = np.exp(log_density(bank.innovation, bank.innovation_covariance)[0])
        expected = np.log((np.exp(bank.log_predicted) * each).sum(axis=0))
    missed = lanes.state.measurement.available == 0.0
    assert missed.any()
    assert not missed.all()
    expected[missed] = np.nan
    np.testing.assert_allclose(reported["log_likelihood"], expected, rtol=1e-9)


def test_mixture_density_of_what_underflows():
    weights = np.log(np.array([[0.25], [0.75]]))
    density = log_mixture_density(weights, np.array([[-5000.0], [-5001.0]]))
    np.testing.assert_allclose(density, -5000.0 + np.log(0.25 + 0.75 * np.exp(-1.0)))


def test_training_and_tuning_refuse_recordings(recordings):
    from filtergym.agents.training_run import training_scenarios
    from filtergym.baselines.problem import problem_of
    from filtergym.baselines.tuning import Search, tune

    with pytest.raises(ValueError, match="held out"):
        training_scenarios(task_class(TARGET), recordings[TARGET])
    with pytest.raises(ValueError, match="held out"):
        tune(problem_of(TARGET), "imm", Search(1000, recordings[TARGET]))


# --- closed loops


def test_a_closed_loop_is_refused_as_recording_with_the_reason():
    for env, scenario in ((UAV, None), (TIGHT, "paper")):
        with pytest.raises(ValueError, match="is a closed loop, in which the estimate changes the next"):
            record(env, scenario, episodes=1)


# --- tables


def table(path, **columns):
    names = list(columns)
    rows = zip(*(np.asarray(columns[name], dtype=object).tolist() for name in names), strict=True)
    cells = ["" if v is None or (isinstance(v, float) and v != v) else repr(v) if isinstance(v, float) else str(v)
             for row in rows for v in row]  # fmt: skip
    lines = [",".join(cells[i : i + len(names)]) for i in range(0, len(cells), len(names))]
    path.write_text("\n".join([",".join(names), *lines]) + "\n")
    return path


PLOTS = {
    "time": [0.0, 5.0, 10.0, 15.0, 20.0],
    "x": [1000.0, 2000.0, 3100.0, 3900.0, 5000.0],
    "y": [9000.0, 8900.0, 8800.0, 8500.0, 8400.0],
}


def test_plots_start_from_the_first_two(tmp_path):
    sigmas = {"sigma_x": [50.0, 60.0, 70.0, 80.0, 90.0], "sigma_y": [40.0] * 5}
    read = read_recording(table(tmp_path / "plots.csv", **PLOTS, **sigmas), TARGET)
    assert read.parameters == {"sampling_interval": 5.0}
    assert read.truth is None
    assert read.lengths.tolist() == [3]
    assert read.seconds.tolist() == [[5.0, 10.0, 15.0]]
    assert read.measurements["position"][0].tolist() == [[3100.0, 8800.0], [3900.0, 8500.0], [5000.0, 8400.0]]
    assert read.measurements["variance"][0, :, 0].tolist() == [4900.0, 6400.0, 8100.0]
    np.testing.assert_allclose(read.initial["mean"][0], [2000.0, 8900.0, 200.0, -20.0])
    # By what is subtracted: x1, and (x1 - x0) / T.
    J = np.array([[0.0, 1.0], [-0.2, 0.2]])
    expected = J @ np.diag([2500.0, 3600.0]) @ J.T
    np.testing.assert_allclose(read.initial["covariance"][0][np.ix_([0, 2], [0, 2])], expected)


def test_range_and_azimuth_are_east_and_north(tmp_path):
    polar = {
        "time": PLOTS["time"],
        "range": np.hypot(PLOTS["x"], PLOTS["y"]).tolist(),
        "azimuth": np.degrees(np.arctan2(PLOTS["x"], PLOTS["y"])).tolist(),
    }
    one = read_recording(table(tmp_path / "polar.csv", **polar), TARGET)
    other = read_recording(table(tmp_path / "plots.csv", **PLOTS), TARGET)
    np.testing.assert_allclose(one.measurements["position"], other.measurements["position"], rtol=1e-12)
    x, y = one.measurements["position"][0].T
    # The environment's radar: 100 m along the beam, 0.25 degrees across.
    away, across = 100.0 / np.hypot(x, y), np.radians(0.25)
    of_radar = np.stack([(away * x) ** 2 + (across * y) ** 2, (away * y) ** 2 + (across * x) ** 2], axis=-1)
    np.testing.assert_allclose(one.measurements["variance"][0], of_radar, rtol=1e-12)
    # The columns do not state that a radar has measured x and y: they have the deviation with which they scatter.
    assert np.unique(other.measurements["variance"]).tolist() == [other.typical["range_sigma"] ** 2]
    sigmas = {"range_sigma": [30.0] * 5, "azimuth_sigma": [0.5] * 5}
    named = read_recording(table(tmp_path / "own.csv", **polar, **sigmas), TARGET)
    as_parameters = read_recording(tmp_path / "polar.csv", TARGET, range_sigma=30.0, bearing_sigma=0.5)
    np.testing.assert_allclose(named.measurements["variance"], as_parameters.measurements["variance"])


def test_several_tracks_with_truth_in_one_table(tmp_path):
    rows = {name: values * 2 for name, values in PLOTS.items()} | {"recording": ["a"] * 5 + ["b"] * 5}
    rows |= {"truth_position_x": (1000.0 + 1000.0 * np.arange(5)).tolist() * 2}
    rows |= {"truth_position_y": (9000.0 - 150.0 * np.arange(5)).tolist() * 2}
    read = read_recording(table(tmp_path / "two.csv", **rows), TARGET)
    assert read.names == ("a", "b")
    assert read.truth[:, :, 0].tolist() == [[3000.0, 4000.0, 5000.0]] * 2


def test_positions_of_ins_and_receiver(tmp_path):
    ins = {"ins_x": [0.0, 1.0, 3.0, 6.0], "ins_y": [5.0, 5.0, 4.0, 4.0]}
    fix = {"fix_x": [0.5, 1.5, None, 5.0], "fix_y": [5.0, 5.5, 4.0, 4.5]}
    path = table(
        tmp_path / "log.csv", time=[10.0, 10.1, 10.2, 10.3], **ins, **fix, sigma=[1.0, 2.0, 3.0, 4.0]
    )
    read = read_recording(path, LOOSE)
    assert read.parameters["axes"] == 2
    assert read.parameters["sampling_interval"] == pytest.approx(0.1)
    measured = read.measurements
    assert measured["increment"][0].tolist() == [[1.0, 0.0], [2.0, -1.0], [3.0, 0.0]]
    assert measured["available"][0].tolist() == [1.0, 0.0, 1.0]
    assert measured["fix"][0].tolist() == [[1.5, 5.5], [0.0, 0.0], [5.0, 4.5]]
    assert measured["reported_deviation"][0].tolist() == [2.0, 3.0, 4.0]
    assert read.initial["mean"][0].tolist() == [0.0, 5.0]


def test_ranges_and_decisions(tmp_path):
    path = table(
        tmp_path / "esm.csv",
        time=[0.0, 0.5, 1.0, 1.5],
        range=[9e4, 8.99e4, 8.98e4, 8.97e4],
        range_rate=[-200.0, -190.0, -210.0, -205.0],
        decision=[1, None, None, 2],
        radar_bearing=[359.0, None, None, 10.0],
        esm_bearing=[2.0, None, None, 11.5],
    )
    read = read_recording(path, ESM)
    measured = read.measurements
    assert measured["decision"][0].tolist() == [4, 4, 2]
    assert measured["looked"][0].tolist() == [False, False, True]
    assert measured["bearing_difference"][0].tolist() == [0.0, 0.0, -1.5]
    assert read.initial["first_decision"][0] == 1
    assert read.initial["first_bearing_difference"][0] == -3.0
    # Every filter receives what the simulation gives.
    initial, _ = measure_once(make_model(ESM).task)
    np.testing.assert_allclose(read.initial["covariance"][0], initial.covariance[..., 0])


def test_netcdf_without_a_start_starts_from_the_first_measurements(recordings, tmp_path):
    # Without a plot in one of its first two scans a track could not be started.
    seen = record(TARGET, "irregular-scans", episodes=3, backend="numpy", **OPEN[TARGET])
    recordings = {**recordings, TARGET: seen}
    for env, used in ((TARGET, 2), (LOOSE, 0), (ESM, 1)):
        data = recordings[env].dataset
        data = data.drop_vars([name for name in data.variables if str(name).startswith("initial_")])
        data.to_netcdf(tmp_path / "raw.nc", engine="scipy")
        read = read_recording(tmp_path / "raw.nc")
        assert read.lengths.tolist() == [n - used for n in recordings[env].lengths]
        counted = "number" if env == LOOSE else "scan"
        assert read.measurements[counted][:, 0].tolist() == [1] * 3
        if env == TARGET:
            measured = recordings[env].measurements
            assert (measured["interval"][:, 1] != 6.0).any()  # scans that come early
            velocity = (measured["position"][:, 1] - measured["position"][:, 0]) / measured["interval"][
                :, [1]
            ]
            np.testing.assert_allclose(
                read.initial["mean"], np.hstack([measured["position"][:, 1], velocity])
            )
            np.testing.assert_array_equal(read.truth, recordings[env].truth[:, 2:])
            np.testing.assert_allclose(read.seconds[:, 0], measured["interval"][:, 2])
        if env == LOOSE:
            np.testing.assert_allclose(read.initial["mean"], recordings[env].initial["mean"], atol=1e-12)
    data = recordings[TIGHT].dataset.drop_vars(["initial_mean", "initial_covariance"])
    data.to_netcdf(tmp_path / "raw.nc", engine="scipy")
    with pytest.raises(ValueError, match="lacks initial_mean and initial_covariance"):
        read_recording(tmp_path / "raw.nc")


def test_scans_without_a_plot_are_missing_measurements(tmp_path):
    fields = ["scan", "position", "variance", "available", "interval", "elapsed"]
    time = np.array([0.0, 5.0, 10.2, 15.0, 30.0, 35.0])  # none at 15 s, no rows at 20 and 25 s
    x = np.array([1e3, 2e3, 3e3, np.nan, 6e3, 7e3])
    given = {"range_sigma": 100.0}
    found = read_log(Columns("track", pandas.DataFrame({"time": time, "x": x, "y": x + 1.0}), given))
    measured = found.measurements
    assert set(measured) == set(fields)
    assert found.rows.tolist() == [2, 3, -1, -1, 4, 5]
    assert measured["available"].tolist() == [1.0, 0.0, 0.0, 0.0, 1.0, 1.0]
    np.testing.assert_allclose(measured["interval"], [5.2, 4.8, 5.0, 5.0, 5.0, 5.0])
    np.testing.assert_allclose(measured["elapsed"], [5.2, 4.8, 9.8, 14.8, 19.8, 5.0])
    assert measured["position"][1].tolist() == [0.0, 0.0]
    assert measured["variance"][2].tolist() == [1e4, 1e4]  # range_sigma squared
    assert measured["position"][4].tolist() == [6e3, 6001.0]
    full, x_full = np.insert(time, 4, [20.0, 25.0]), np.insert(x, 4, [np.nan, np.nan])
    again = read_log(
        Columns("track", pandas.DataFrame({"time": full, "x": x_full, "y": x_full + 1.0}), given)
    )
    for name, values in measured.items():
        np.testing.assert_array_equal(values, again.measurements[name])


def test_a_folder_is_one_recording_and_broken_files_are_named(tmp_path):
    table(tmp_path / "a.csv", **PLOTS)
    table(tmp_path / "b.csv", **{name: values[:4] for name, values in PLOTS.items()})
    table(tmp_path / "c.csv", **changed(time=[0.0, 5.0, 4.0, 15.0, 20.0]))
    table(tmp_path / "d.csv", **changed(time=[0.0, 6.0, 12.0, 18.0, 24.0]))
    for source in (tmp_path, str(tmp_path / "*.csv"), [tmp_path / f"{name}.csv" for name in "abcd"]):
        read = read_recording(source, TARGET)
        assert read.names == ("a", "b")
        assert read.lengths.tolist() == [3, 2]
        assumed = (
            "no column states deviations of x and y, assumed as positions scatter about their neighbours: "
        )
        assert read.notes == (
            "c.csv: left out: time decreases from 5 in row 1 to 4 in row 2: --sort (sort=True of read_recording) sorts "
            "the rows by time",
            f"a: {assumed}sigma_x 121 m, sigma_y 121 m",
            f"b: {assumed}sigma_x 90.8 m, sigma_y 90.8 m",
            "d: left out: sampling_interval is 6.0, and of a 5.0",
        )
    with pytest.raises(ValueError, match=r"nothing of .* can be replayed: c\.csv: left out: time decreases"):
        read_recording([tmp_path / "c.csv"] * 2, TARGET)


def test_files_with_and_without_truth_are_not_judged(recordings, tmp_path):
    recordings[TARGET].write(tmp_path / "known.nc")
    blind(recordings[TARGET]).write(tmp_path / "untold.nc")
    read = read_recording(tmp_path)
    assert read.names[2:4] == ("known: 2", "untold: 0")
    assert read.truth is None
    assert read.notes == ("untold: has no truth, so no competitor is judged",)


def changed(**columns):
    """Plots with other columns; None leaves one out."""
    return {name: values for name, values in {**PLOTS, **columns}.items() if values is not None}


LOG = {"time": [0.0, 1.0, 2.0, 3.0], "ins": [0.0, 1.0, 2.0, 3.0], "fix": [0.0, 1.0, 2.0, 3.0]}
ECHO = {"time": [0.0, 1.0, 2.0], "range": [9e4, 9e4, 9e4], "range_rate": [0.0, 1.0, 2.0]}
ONE, POLAR = [1.0] * 5, {"time": PLOTS["time"], "range": [9e3] * 5, "azimuth": [1.0] * 5}
BEARINGS = {"decision": [0, 1, None], "radar_bearing": [1.0, 2.0, 3.0], "esm_bearing": [1.0, None, 3.0]}
WRONG = [
    (TARGET, changed(sigma_x=[1.0, 1.0, 0.0, 1.0, 1.0], sigma_y=ONE), "row 2 has 0"),
    (TARGET, changed(sigma_x=ONE, sigma_y=[1.0, -2.0, 1.0, 1.0, 1.0]), "row 1 has -2"),
    (TARGET, changed(sigma_x=ONE), "lacks the column sigma_y"),
    (TARGET, changed(y=[1.0, 2.0, None, 4.0, 5.0]), "row 2 has one coordinate of two"),
    (TARGET, {"time": PLOTS["time"], "sigma_x": ONE, "sigma_y": ONE}, "needs x and y"),
    (TARGET, changed(x=["a", 1.0, 2.0, 3.0, 4.0]), "x has 'a' in row 0, which is no number"),
    (TARGET, changed(time=[0.0, 5.0, 4.0, 15.0, 20.0]), "time decreases from 5 in row 1 to 4 in row 2"),
    (TARGET, changed(time=[0.0, 5.0, 5.0, 15.0, 20.0]), "is the same in rows 1 and 2: 1 of 5 rows"),
    (TARGET, changed(time=None), "reads time and x, y"),
    (TARGET, {name: values[:2] for name, values in PLOTS.items()}, "it has 2 plots"),
    (TARGET, {name: values[:1] for name, values in PLOTS.items()}, "1 row, and a recording needs several"),
    (TARGET, POLAR | {"azimuth": [400.0] * 5}, "azimuth reaches 400, and degrees"),
    (TARGET, POLAR | {"range": [9e3, -1.0, 1.0, 1.0, 1.0]}, "range is a distance, and row 1 has -1 m"),
    (TARGET, changed(truth_position_x=ONE), "the column truth_position_y is missing"),
    (TARGET, changed(truth_height=ONE), "truth_height is no truth of filtergym/ManeuveringTarget-v0"),
    (
        TARGET,
        changed(truth_velocity_x=ONE, truth_velocity_y=ONE),
        "its truth lacks position_x, position_y, which the cost of",
    ),
    (LOOSE, {**LOG, "time": [0.0, 1.0, 2.0, 4.0]}, "times are 2 s apart after row 2 and 1 s elsewhere"),
    (LOOSE, {**LOG, "fix": [None] * 4}, "no row has a fix"),
    (LOOSE, {**LOG, "ins": [0.0, None, 2.0, 3.0]}, "ins has no value in row 1"),
    (LOOSE, {"time": LOG["time"], "fix": LOG["fix"]}, "lacks the column ins"),
    (ESM, {**ECHO, "decision": [0, 7, None]}, "from 0 to 3, and row 1 has 7"),
    (ESM, {**ECHO, "decision": [0, None, None]}, "a decision needs radar_bearing and esm_bearing"),
    (ESM, ECHO | BEARINGS, "row 1 has a decision and lacks a bearing"),
    (TIGHT, LOG, "reads recordings from NetCDF only"),
    (UAV, LOG, "is a closed loop, in which the estimate changes the next"),
    (TARGET, changed(x=[1e6] * 5), "a plot lies 1,000 km from the radar"),
    (ESM, PLOTS, "reads time and range, range_rate"),
]


@pytest.mark.parametrize(("env", "columns", "sentence"), WRONG, ids=[sentence for *_, sentence in WRONG])
def test_wrong_tables_are_one_sentence(env, columns, sentence, tmp_path):
    with pytest.raises(ValueError, match=r"recording .*wrong\.csv: ") as refusal:
        read_recording(table(tmp_path / "wrong.csv", **columns), env)
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("empty.csv", b"", "it is empty: a recording needs a line of columns"),
        ("binary.csv", b"\xff\xfe\x00\x01" * 9, "it is no text in UTF-8"),
        ("empty.nc", b"", "it is empty"),
        ("binary.nc", b"\x00\x01" * 99, "it is no NetCDF"),
        ("words.txt", b"time,x,y\n", "a recording ends in .csv, .nc"),
    ],
)
def test_files_that_are_no_recordings(name, content, sentence, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=f"recording .*{name}: ") as refusal:
        read_recording(tmp_path / name, TARGET)
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_table_does_not_say_of_which_environment_it_is(tmp_path):
    with pytest.raises(ValueError, match="does not name its environment"):
        read_recording(table(tmp_path / "plots.csv", **PLOTS))
    with pytest.raises(ValueError, match="there is no such file"):
        read_recording(tmp_path / "nothing.nc")


def test_too_many_rows_are_refused_early():
    with pytest.raises(ValueError, match="more than the 50,000,000 numbers that a recording may contain"):
        record(TARGET, episodes=10, horizon=10_000_000)


# --- NetCDF


NOT_FINITE = "position is not finite at measurement 3; write zero for a missing value"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda d: d.assign_attrs(environment=LOOSE), "it is of filtergym/LooselyCoupledNavigation-v0, not of"),
        (lambda d: d.assign_attrs(parameters="{"), "must be a JSON object"),
        (lambda d: d.assign_attrs(parameters='{"rang_sigma": 1}'), "sets 'rang_sigma', which is no parameter"),
        (lambda d: d.drop_vars("variance"), "lacks variance; filtergym/ManeuveringTarget-v0 measures scan"),
        (lambda d: d.drop_vars("initial_mean"), "lacks initial_mean"),
        (lambda d: d.assign(variance=d["variance"].astype(str)), "variance must be numbers, got "),
        (lambda d: d.assign(height=d["scan"]), "has height, which is not among the arrays that"),
        (lambda d: d.isel(position_axis0=[0]), "position has the shape (1,)"),
        (lambda d: d.drop_vars("seconds"), "lacks the variable seconds"),
        (lambda d: d.assign(seconds=-6.0 * d["scan"]), "seconds must increase, and measurement 2 has -12 s"),
        (lambda d: d.assign(seconds=0.0 * d["seconds"] + np.nan), "it holds no measurements"),
        (lambda d: d.assign(position=d["position"].where(d["scan"] != 3.0)), NOT_FINITE),
        (lambda d: d.assign(length=d["length"] + 5), "length must be from 1 to its 25 measurements, got 29"),
        (lambda d: d.assign(truth=d["truth"][..., :2].rename(component="two")), "truth has 2"),
    ],
)  # fmt: skip
def test_wrong_netcdf_is_one_sentence(change, sentence, recordings, tmp_path):
    change(recordings[TARGET].dataset).to_netcdf(tmp_path / "wrong.nc", engine="scipy")
    with pytest.raises(ValueError, match=r"wrong") as refusal:
        read_recording(tmp_path / "wrong.nc", TARGET)
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_recordings_of_another_environment_are_refused(recordings):
    with pytest.raises(
        ValueError, match="is of filtergym/ManeuveringTarget-v0, not of filtergym/RadarEsmTracking-v0"
    ):
        gym.make(ESM, scenario=recordings[TARGET])
    with pytest.raises(
        ValueError, match=r"ins has the shape \(2,\) and .* with these parameters measures \(1,\)"
    ):
        gym.make(LOOSE, scenario=recordings[LOOSE], axes=1)


def test_a_single_mistake_in_arrays_is_named(recordings):
    made = recordings[TARGET]
    with pytest.raises(ValueError, match="position must have shape"):
        dataclasses.replace(made, measurements={**made.measurements, "position": np.zeros((3, 4, 2))})
    with pytest.raises(ValueError, match="as many different names"):
        dataclasses.replace(made, names=("a", "a", "b"))
    with pytest.raises(ValueError, match="horizon must be at most 24"):
        make_model(TARGET, scenario=made, horizon=30)


def test_truth_needs_a_cost_of_the_error(recordings, monkeypatch):
    from filtergym.envs.contract.world import World
    from filtergym.envs.maneuvering_target.world import RadarWorld

    monkeypatch.setattr(RadarWorld, "error_cost", World.error_cost)
    with pytest.raises(ValueError, match="defines no cost of an error"):
        make_model(TARGET, scenario=recordings[TARGET])
    make_model(TARGET, scenario=blind(recordings[TARGET]))


# --- the page

PAGE = DOCS / "own_data.md"


@pytest.mark.parametrize("heading", ["# ", "## Recordings of real sensors"])
def test_the_examples_of_the_page_print_their_comments(heading, capsys):
    section = PAGE.read_text(encoding="utf-8").partition(heading)[2]
    code = section.partition("```python\n")[2].partition("```")[0]
    exec(code, {})
    assert capsys.readouterr().out.splitlines() == re.findall(r"# (.*)", code)


def test_every_column_is_on_the_page():
    text = PAGE.read_text(encoding="utf-8")
    axes = ("ins_y", "ins_z", "fix_y", "fix_z")
    for env in (TARGET, LOOSE, ESM):
        columns = [name for name in find_companion(task_class(env), LogFormat).columns if name not in axes]
        assert [name for name in columns if f"`{name}`" not in text] == []


# --- the command line


def test_record_and_evaluate_on_the_command_line(success, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out = success("record", TARGET, "--episodes", 2, "--set", "horizon=12", "--out", "plots.nc")
    assert out.strip() == "2 episodes in plots.nc"
    words = ("--policy", "imm", "--estimates", "estimates.csv", "--json", "records.json")
    assert "2 recordings" in success("evaluate", "--recording", "plots.nc", *words)
    assert len((tmp_path / "estimates.csv").read_text().splitlines()) == 25
    # A table has no truth; the file of the first names its environment as a scenario, too.
    out = success("evaluate", TARGET, "--recording", table(tmp_path / "plots.csv", **PLOTS), *words)
    assert "log-likelihood: of a measurement under its prediction" in out
    metrics = {record["metric"] for record in json.loads((tmp_path / "records.json").read_text())}
    assert {"log_likelihood", "anis", "anis_band", "prediction_error", "innovation_correlation"} <= metrics
    assert not {"rmse", "cost", "anees"} & metrics
    assert "2 recordings" in success("evaluate", "--scenario", "plots.nc", "--policy", "imm")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["evaluate"], "name an environment, or a recording, which names its own"),
        (["evaluate", TARGET, "--recording", "plots.csv", "--scenario", "paper"], "takes the place of --scenario"),
        (["evaluate", TARGET, "--recording", "plots.csv", "--policy", "known-turn"], "'known-turn' needs truth that"),
        (["evaluate", TARGET, "--recording", "plots.csv", "--site", "1,2"], "--site is for flights from files"),
        (["evaluate", TARGET, "--scenario", "paper", "--site", "1,2"], "--site is for flights from files, and 'paper'"),
        (["record", TARGET, "--out", "plots.csv"], "a recording is a NetCDF file, whose name ends in .nc"),
    ],
)  # fmt: skip
def test_mistakes_on_the_command_line_are_one_sentence(words, sentence, refusal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table(tmp_path / "plots.csv", **PLOTS)
    found = refusal(*words)
    assert sentence in found
    assert found.startswith("Error: ")


def test_agents_of_other_fields_are_left_out_unless_named():
    """Of a recording on two axes, which shows other fields than one axis, on which the agents were trained."""
    id = "filtergym/LooselyCoupledNavigation-v0"
    problem = problem_of(id)
    for axes, has_agents in ((1, True), (2, False)):
        found = causal_competitors(problem, record(id, None, 1, horizon=10, axes=axes))
        names = [one.name for one in found]
        assert ("bptt" in names) == has_agents
        assert "augmented" in names
