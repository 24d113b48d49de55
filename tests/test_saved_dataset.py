"""An evaluation saved as NetCDF and read again: the same numbers, windows, groups, keywords and records."""

import dataclasses
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import xarray
from models import make_model

from filtergym import evaluate, record, tidy_records
from filtergym.baselines.catalogue import baselines_of
from filtergym.evaluation.running.seeds import episode_seeds
from filtergym.evaluation.storage.dataset import (
    groups_of,
    keywords_as_text,
    keywords_of,
    notes_of,
    seed_of,
    windows_of,
)

TARGET = "filtergym/ManeuveringTarget-v0"
CASES = {
    TARGET: {"scenario": "paper", "horizon": 20},
    "filtergym/UavAutopilot-v0": {"scenario": "paper-noise", "horizon": 20},
    "filtergym/RadarEsmTracking-v0": {"horizon": 8},
}
ENGINES = ["scipy", *(["h5netcdf"] if all(map(importlib.util.find_spec, ("h5netcdf", "h5py"))) else [])]
"""That write here: h5netcdf needs h5py to do so."""


def saved_and_read(dataset, path, engine="scipy"):
    dataset.to_netcdf(path, engine=engine)
    with xarray.open_dataset(path, engine=engine) as read:
        return read.load()


@pytest.mark.parametrize("env", CASES)
def test_what_is_saved_is_what_is_read(env, tmp_path):
    """Values, names and attributes; NetCDF's classic format only narrows whole numbers to 32 bits."""
    keywords, known = CASES[env], baselines_of(env)
    names = [*list(known.names)[:2], *list(known.references)[:1], *list(known.bounds)[:1]]
    dataset = evaluate(env, names, episodes=3, seed=4, **keywords)
    for engine in ENGINES:
        assert_is_read(saved_and_read(dataset, tmp_path / f"{engine}.nc", engine), dataset, keywords)


def assert_is_read(read, dataset, keywords):
    xarray.testing.assert_identical(read, dataset)
    assert (windows_of(read), groups_of(read)) == (windows_of(dataset), groups_of(dataset))
    own = {name: value for name, value in keywords.items() if name != "scenario"}
    assert keywords_of(read) == keywords_of(dataset) == own
    before, after = tidy_records(dataset), tidy_records(read)
    assert after == before
    # As text too: a NumPy number would equal a Python one, and JSON refuses it.
    assert json.dumps(after) == json.dumps(before)


def without_truth(recording):
    return dataclasses.replace(recording, truth=None)


@pytest.mark.parametrize("blind", [False, True])
def test_recordings_and_shorter_flights(blind, tmp_path):
    recording = record(TARGET, "paper", 2)
    lengths = recording.lengths.copy()
    lengths[1] -= 30
    seconds = np.where(np.arange(recording.seconds.shape[1]) <= lengths[:, None], recording.seconds, np.nan)
    recording = dataclasses.replace(
        recording, lengths=lengths, seconds=seconds, names=("früh", "spät"), notes=("one", "two, \u00b5")
    )
    recording = without_truth(recording) if blind else recording
    dataset = evaluate(TARGET, ["imm"], recording)
    read = saved_and_read(dataset, tmp_path / "x.nc")
    xarray.testing.assert_identical(read, dataset)
    assert read["flight"].values.tolist() == ["früh", "spät"]
    assert read["length"].values.tolist() == lengths.tolist()
    assert notes_of(read)[-2:] == ["one", "two, \u00b5"]
    assert (read.attrs["recorded"], read.attrs["truth"]) == (1, 0 if blind else 1)
    assert tidy_records(read) == tidy_records(dataset)
    # It comes from the simulation, where scans are regular.
    np.testing.assert_allclose(dataset["elapsed"], dataset["time"] * 6.0)


def test_tracks_and_a_seed_of_any_size(tmp_path):
    dataset = evaluate(TARGET, ["imm"], "paper", 2, seed=2**40 + 1, horizon=5)
    assert seed_of(saved_and_read(dataset, tmp_path / "x.nc")) == 2**40 + 1
    assert {r.seed for r in tidy_records(dataset)} == {2**40 + 1}
    replayed = evaluate(TARGET, ["zero"], "paper", 2, seed=0, horizon=5)
    seeds = [int(seed) for seed in saved_and_read(replayed, tmp_path / "y.nc")["episode_seed"].values]
    assert max(seeds) > 2**53  # which no double holds
    assert seeds == episode_seeds("test", 0, 2)


def test_seconds_where_measurements_come_regularly():
    model = make_model("filtergym/UavAutopilot-v0", None, "paper-noise")
    assert model.task.parameters.sampling_interval is None  # left to the plant
    dataset = evaluate(model.task.id, ["kalman"], "paper-noise", 2, horizon=8)
    np.testing.assert_allclose(dataset["elapsed"], model.task.interval * np.arange(1, 9))
    assert dataset["elapsed"].attrs["units"] == "s"
    assert evaluate(model.task.id, ["kalman"], "paper-noise", 2, horizon=8, sampling_interval=0.1).elapsed[
        0
    ] == pytest.approx(0.1)
    # Scans that miss the target leave gaps; the number of a plot then does not give its time.
    missing = {"horizon": 8, "detection_probability": (0.5, 0.9)}
    assert "elapsed" not in evaluate(TARGET, ["imm"], "paper", 2, **missing).coords
    recording = record(TARGET, episodes=2, **missing)
    assert "elapsed" not in evaluate(TARGET, ["imm"], recording).coords


def test_keywords_that_json_cannot_hold_are_refused():
    given = {"gain": np.float64(0.5), "gains": np.array([[1, 2]]), "pair": (1.0, 2.0), "odd": slice(3)}
    text = keywords_as_text(given)
    read = keywords_of(xarray.Dataset(attrs={"keywords": text}))
    assert read == {"gain": 0.5, "gains": [[1, 2]], "pair": [1.0, 2.0], "odd": "slice(None, 3, None)"}


# --- the page


@pytest.mark.slow
def test_examples_of_the_page(tmp_path, monkeypatch, capsys, success):
    """What is written by a command is read by xarray alone, and drawn."""
    page = (Path(__file__).parent.parent / "docs" / "evaluation.md").read_text(encoding="utf-8")
    read, drawn = (
        page.partition(f"## {title}\n")[2].partition("```python\n")[2].partition("```")[0]
        for title in ("Files", "Figures")
    )
    monkeypatch.chdir(tmp_path)
    words = ["evaluate", TARGET, "--scenario", "paper", "--policy", "imm", "--policy", "known-turn"]
    success(*words, "--episodes", 8, "--out", "results/paper")
    names = {}
    exec(read, names)
    dataset = evaluate(TARGET, ["imm", "known-turn"], "paper", 8)
    square = (dataset["error"].values[0, :, 49:55, :2] ** 2).sum(axis=-1).mean(axis=0)
    assert float(capsys.readouterr().out) == pytest.approx(np.sqrt(square.max()))
    assert names["cost"]["imm"] == pytest.approx(dataset["cost"].values[0].mean())
    # The command also measures time.
    assert [r for r in names["records"] if r.metric != "nanoseconds"] == tidy_records(dataset)
    exec(drawn, {"dataset": dataset})
    assert (tmp_path / "rmse_over_time.pdf").read_bytes().startswith(b"%PDF")
