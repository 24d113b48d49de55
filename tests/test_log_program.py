"""The program that reads a log, in C: every form of a log against an evaluation, what it refuses, and no wrong access.

Two programs are made, of an advised filter and of a model of one's own, and read all logs under the sanitizers.
"""

import csv
import inspect
import io
import re
import shutil
import subprocess

import numpy as np
import pandas
import pytest
from own_models import forget
from test_exports_c import SANITIZERS

import filtergym
from filtergym import Input, Sensor, read_recording
from filtergym.baselines.fitted_filters import write_advised
from filtergym.baselines.fitting import Fit
from filtergym.baselines.maneuvering_target.log_families import log_families
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.companions import find_companion
from filtergym.envs.contract.log_format import LogFormat
from filtergym.exports.c_source import FLAGS, WORST, export_c
from filtergym.exports.request import request_export

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
TARGET, OWN = "filtergym/ManeuveringTarget-v0", "mine/Logged-v0"
STRICT = ("-Wconversion", "-Wdouble-promotion", "-Wshadow", "-g")
COUNT = 40
START = pandas.Timestamp("2026-10-25T21:59:31Z")
"""So that midnight passes."""
RENAMES = {
    TARGET: {
        "t": "time",
        "East": "x",
        "north": "y",
        "accuracy": ["sigma_x", "sigma_y"],
        "drive": "recording",
    },
    OWN: {"t": "time", "east pos": "gps", "north": "odo", "drive": "recording"},
}


def log_of(id):
    """Cells of a log as numbers and words: times, two measured numbers with a gap, an accuracy, and what is ignored."""
    g = np.random.default_rng(5)
    time = np.arange(COUNT, dtype=float).round(3)
    if id == TARGET:
        east, north = (
            900.0 + 12.0 * time + g.normal(0.0, 4.0, COUNT),
            300.0 - 7.0 * time + g.normal(0.0, 4.0, COUNT),
        )
        names = "East", "north"
    else:
        east, north = 10.0 * time + g.normal(0.0, 2.0, COUNT), 10.0 + g.normal(0.0, 0.5, COUNT)
        names = "east pos", "north"
    columns = {
        "t": time,
        names[0]: east.round(2),
        names[1]: north.round(2),
        "accuracy": g.uniform(2.0, 6.0, COUNT).round(1),
    }
    table = pandas.DataFrame(columns).assign(drive="a", note="x")
    return table.drop(index=range(20, 24)).reset_index(drop=True)


def lines(table, **options):
    return table.to_csv(index=False, lineterminator="\n", **options)


def times(table, write):
    """The table with times that a function writes of dates."""
    dates = START + pandas.to_timedelta(table["t"], unit="s")
    return table.assign(t=[write(date) for date in dates])


def duplicate(table, **changes):
    """The table with three rows twice, the second of them changed."""
    again = table.iloc[[7, 12, 30]].assign(**changes)
    return pandas.concat([table, again]).sort_values("t", kind="stable")


def supplied(table):
    """The table with a row of which a second one has what the first lacks."""
    table = table.astype({"t": float})
    second = table.iloc[[9]].copy()
    second.iloc[0, 1:3] = np.nan
    table.iloc[9, 3] = np.nan
    return pandas.concat([table, second]).sort_values("t", kind="stable")


def holes(table):
    """The table with empty cells: of all that is measured, and of one input."""
    table = table.copy()
    table.iloc[15:17, 1:3] = np.nan
    return table


def repeats(table):
    """The table with positions that are those of the row before."""
    table = table.copy()
    table.iloc[16:19, 1:3] = table.iloc[15, 1:3].to_numpy()
    return table


def drives(table, mixed=False):
    """Two recordings in one table, one after the other or row by row; the name of one needs quotes."""
    both = pandas.concat([table, table.iloc[:15].assign(drive='b, "two"')])
    return both.sort_values("t", kind="stable") if mixed else both


FORMATS = {
    "commas": lines,
    "semicolons and decimal commas": lambda t: lines(t, sep=";", decimal=","),
    "tabs and decimal commas": lambda t: lines(t, sep="\t", decimal=","),
    "semicolons and points": lambda t: lines(t, sep=";"),
    "a mark of UTF-8 and lines of Windows": lambda t: "\ufeff" + lines(t).replace("\n", "\r\n"),
    "lines of old machines": lambda t: lines(t).replace("\n", "\r"),
    "no end of the last line": lambda t: lines(t).rstrip("\n"),
    "empty lines": lambda t: lines(t).replace("\n", "\n\n"),
    "quoted cells": lambda t: lines(t, quoting=csv.QUOTE_ALL),
    "quoted words with all that needs it": lambda t: lines(t.assign(note='two\nlines, "quoted"; and more')),
    "quoted decimal commas": lambda t: lines(t, sep=";", decimal=",", quoting=csv.QUOTE_ALL),
    "names in capitals between spaces": lambda t: lines(t.rename(columns=lambda name: f" {name.upper()} ")),
    "another order of columns": lambda t: lines(t[t.columns[::-1]]),
    "spaces around numbers": lambda t: lines(t.assign(t=[f" {x} " for x in t["t"]])),
    "words for no number": lambda t: lines(holes(t), na_rep="NaN"),
    "empty cells": lambda t: lines(holes(t)),
    "seconds since 1970": lambda t: lines(times(t, lambda d: f"{d.timestamp():.3f}")),
    "milliseconds since 1970": lambda t: lines(times(t, lambda d: d.value // 1_000_000)),
    "nanoseconds since 1970": lambda t: lines(times(t, lambda d: d.value)),
    "dates in UTC": lambda t: lines(times(t, lambda d: d.strftime("%Y-%m-%dT%H:%M:%S.%fZ")), sep=";", decimal=","),
    "dates with an offset": lambda t: lines(times(t, lambda d: d.tz_convert("Asia/Kolkata").isoformat(" "))),
    "dates without an offset": lambda t: lines(times(t, lambda d: d.strftime("%Y-%m-%d %H:%M:%S"))),
    "compact dates": lambda t: lines(times(t, lambda d: d.strftime("%Y%m%dT%H%M%SZ"))),
    "dates with slashes": lambda t: lines(times(t, lambda d: f"{d.year}/{d.month}/{d.day} {d:%H:%M:%S.%f}")),
    "dates with points": lambda t: lines(times(t, lambda d: f"{d.day}.{d.month}.{d.year} {d:%H:%M:%S},250"), sep=";", decimal=","),
    "times of day through midnight": lambda t: lines(times(t, lambda d: (d + pandas.Timedelta(hours=2)).strftime("%H:%M:%S.%f"))),
    "rows twice": lambda t: lines(duplicate(t)),
    "rows twice with other values": lambda t: lines(duplicate(t, accuracy=9.5)),
    "rows that supply each other": lambda t: lines(supplied(t)),
    "positions that repeat": lambda t: lines(repeats(t)),
    "two recordings": lambda t: lines(drives(t)),
    "two recordings, row by row": lambda t: lines(drives(t, mixed=True), sep=";", decimal=","),
}  # fmt: skip


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """Both programs, under the sanitizers: folder and the name of the competitor, by the environment."""
    filtergym.state_space(
        OWN,
        f=lambda x, dt: [x[0] + dt * x[1], x[1]],
        Q=lambda dt: [[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]],
        sensors={"gps": Sensor([[1, 0]], R=lambda u: u[0] ** 2), "odo": Sensor([[0, 1]], R=0.25)},
        inputs={"accuracy": Input(mean=4.0, deviation=1.0, unit="m")},
        mean=[0.0, 10.0],
        covariance=[[100.0, 0.0], [0.0, 25.0]],
        units=["m", "m/s"],
    )
    found = {}
    for id in RENAMES:
        place = tmp_path_factory.mktemp("program")
        (place / "first.csv").write_text(lines(log_of(id)), encoding="utf-8")
        recording = read_recording(place / "first.csv", id, rename=RENAMES[id])
        name = "extended"
        if id == TARGET:
            name = str(place / "mine.filter.json")
            family = log_families(recording)["constant-velocity"]
            values = {**family.start, "log10_noise_scale": 0.1}
            write_advised(
                place / name,
                problem_of(id),
                "constant-velocity",
                recording,
                Fit(values, 0.0, 1, 0.0, ()),
                {},
                "test",
            )
        request = request_export(problem_of(id), name, None if id == TARGET else recording)
        export_c(request, place / "c")
        stem = "mine" if id == TARGET else "extended"
        for program in ("log", "main"):
            words = ["cc", *FLAGS, *STRICT, *SANITIZERS, f"{program}.c", f"{stem}.c", "-lm", "-o", program]
            subprocess.run(words, cwd=place / "c", check=True)
        found[id] = place, name
    yield found
    forget(OWN)


def run(program, text, *words):
    """Run a program on a text."""
    return subprocess.run([program, *words], input=text.encode(), capture_output=True, check=False)


@pytest.mark.parametrize("id", RENAMES)
@pytest.mark.parametrize("form", FORMATS)
def test_c_reads_every_form_of_a_log_as_an_evaluation_does(form, id, programs, tmp_path):
    place, name = programs[id]
    path = tmp_path / "some.csv"
    path.write_text(FORMATS[form](log_of(id)), encoding="utf-8", newline="")
    recording = read_recording(path, id, rename=RENAMES[id])
    done = subprocess.run([place / "c" / "log", path], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == b""
    found = pandas.read_csv(io.BytesIO(done.stdout), dtype={"time": str})
    dataset = filtergym.evaluate(id, [name], recording, tracks=True).isel(policy=0)
    left_out = found["status"].isin(["joined", "repeated"])
    assert left_out.sum() == {
        "rows twice": 3,
        "rows twice with other values": 3,
        "rows that supply each other": 1,
    }.get(form, 0)
    for episode, of in enumerate(recording.names):
        own = found[~left_out & (found["recording"] == of)]
        seen = recording.log_time[episode]
        seen = seen != "" if seen.dtype.kind == "U" else np.isfinite(seen)
        assert len(own) == seen.sum()
        written = recording.log_time[episode][seen]
        np.testing.assert_array_equal(own["time"].astype(written.dtype), written)
        own = own.reset_index(drop=True)
        values = {kind: own.filter(like=f"{kind}_").to_numpy() for kind in ("estimate", "sigma")}
        estimate, covariance = (
            dataset[kind].values[episode][: len(seen)][seen] for kind in ("estimate", "covariance")
        )
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        # Measured 2e-12, of a test.c the limit is 1e-3.
        assert np.abs((values["estimate"] - estimate) / sigma).max() < 1e-6 * WORST["double"]
        np.testing.assert_allclose(values["sigma"], sigma, rtol=1e-9)
