"""The program that reads a log, in C: every form of a log against an evaluation, what it refuses, and no wrong access.

Two programs are made, of an advised filter and of a model of one's own, and read all logs under the sanitizers.
"""

import csv
import inspect
import io
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

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
from filtergym.envs.logs.flight_tables import DELIMITERS
from filtergym.exports.c_filter import file_stem
from filtergym.exports.c_log import READING
from filtergym.exports.c_log_programs import READER
from filtergym.exports.c_source import FLAGS, WORST, export_c
from filtergym.exports.request import request_export
from filtergym.names import find_competitor

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
TARGET, OWN = "filtergym/ManeuveringTarget-v0", "mine/Logged-v0"
LOOSE, ESM = "filtergym/LooselyCoupledNavigation-v0", "filtergym/RadarEsmTracking-v0"
SHIPPED = {LOOSE: "time-varying", ESM: "quasi-optimal"}
"""Advised filters that are not fitted."""
STRICT = ("-Wconversion", "-Wdouble-promotion", "-Wshadow", "-g")
COUNT = 40
START = pandas.Timestamp("2026-10-25T22:59:41Z")
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
    LOOSE: {"t": "time", "East": "fix_x", "north": "fix_y", "accuracy": "sigma", "drive": "recording"}
    | {"ins east": "ins_x", "ins north": "ins_y"},
    ESM: {"t": "time", "type": "decision", "apart": "bearing_difference", "accuracy": "range_rate"}
    | {"drive": "recording", "distance": "range"},
}


def log_of(id):
    """Cells of a log as numbers and words: times, two measured numbers, an accuracy, what is ignored, and perhaps more;
    a gap where there may be one.
    """
    g = np.random.default_rng(5)
    time = np.arange(COUNT, dtype=float).round(3)
    if id in (TARGET, LOOSE):
        east, north = (
            900.0 + 12.0 * time + g.normal(0.0, 4.0, COUNT),
            300.0 - 7.0 * time + g.normal(0.0, 4.0, COUNT),
        )
        names = "East", "north"
    elif id == ESM:
        east, north = (
            np.where(time % 4.0 == 0.0, g.integers(0, 3, COUNT), np.nan),
            g.normal(0.0, 200.0, COUNT),
        )
        north[np.isnan(east)] = np.nan
        names = "type", "apart"
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
    if id == LOOSE:
        drift = np.cumsum(g.normal(0.0, 0.1, (2, COUNT)), axis=1)
        return table.assign(
            **{"ins east": 900.0 + 12.0 * time + drift[0], "ins north": 300.0 - 7.0 * time + drift[1]}
        )
    if id == ESM:
        return table.assign(distance=(9000.0 - 4.0 * time + g.normal(0.0, 40.0, COUNT)).round(1))
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
    table.iloc[31, 1:3] = table.iloc[30, 1:3] + 0.01  # as fine as the numbers are
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
    "dates with points": lambda t: lines(times(t, lambda d: f"{d.day}.{d.month}.{d.year} {d:%H:%M:%S},25"), sep=";"),
    "times of day through midnight": lambda t: lines(times(t, lambda d: d.tz_convert("CET").strftime("%H:%M:%S.%f"))),
    "rows twice": lambda t: lines(duplicate(t)),
    "rows twice with other values": lambda t: lines(duplicate(t, accuracy=9.5)),
    "rows that supply each other": lambda t: lines(supplied(t)),
    "positions that repeat": lambda t: lines(repeats(t)),
    "two recordings": lambda t: lines(drives(t)),
    "two recordings, row by row": lambda t: lines(drives(t, mixed=True), sep=";", decimal=","),
}  # fmt: skip


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """All programs, under the sanitizers: folder and the name of the competitor, by the environment."""
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
        name = "extended" if id == OWN else "mine.filter.json"
        found[id] = place, advised(place, id, place / "first.csv", name, RENAMES[id], ("log", "main"))
    yield found
    forget(OWN)


def run(program, text, *words):
    """Run a program on a text."""
    # To ask for more memory than there is is refused, as without the sanitizers.
    env = os.environ | {"ASAN_OPTIONS": "allocator_may_return_null=1"}
    return subprocess.run([program, *words], input=text.encode(), capture_output=True, env=env, check=False)


def advised(place, id, log, name, rename, programs=("log",)):
    """Export the filter of a log, and compile its programs under the sanitizers."""
    recording, moved = read_recording(log, id, rename=rename), False
    if id in SHIPPED:
        write_advised(place / name, problem_of(id), SHIPPED[id], recording, None, {}, "test")
        name = str(place / name)
    elif id == TARGET:
        moved = "odometry_displacement" in recording.measurements
        family = "dead-reckoning" if moved else "constant-velocity"
        scale = {} if moved else {"log10_noise_scale": 0.1}
        fit = Fit({**log_families(recording)[family].start, **scale}, 0.0, 1, 0.0, ())
        write_advised(place / name, problem_of(id), family, recording, fit, {}, "test")
        name = str(place / name)
    request = request_export(problem_of(id), name, recording if id == OWN or moved else None)
    export_c(request, place / "c")
    stem = file_stem(request.name)
    for program in programs:
        words = ["cc", *FLAGS, *STRICT, *SANITIZERS, f"{program}.c", f"{stem}.c", "-lm", "-o", program]
        subprocess.run(words, cwd=place / "c", check=True)
    return name


def check_rows(id, name, recording, done, copies=0):
    """Compare what the program wrote with an evaluation; returns the rows."""
    assert done.returncode == 0, done.stderr
    found = pandas.read_csv(io.BytesIO(done.stdout), dtype={"time": str})
    dataset = filtergym.evaluate(id, [name], recording, tracks=True).isel(policy=0)
    left_out = found["status"].isin(["joined", "repeated"])
    assert left_out.sum() == copies
    for episode, of in enumerate(recording.names):
        own = found[~left_out & (found.get("recording", of) == of)].reset_index(drop=True)
        seen = recording.log_time[episode]
        seen = seen != "" if seen.dtype.kind == "U" else np.isfinite(seen)
        written = recording.log_time[episode][seen]
        np.testing.assert_array_equal(own["time"].astype(written.dtype), written)
        values = {kind: own.filter(like=f"{kind}_").to_numpy() for kind in ("estimate", "sigma")}
        estimate, covariance = (
            dataset[kind].values[episode][: len(seen)][seen] for kind in ("estimate", "covariance")
        )
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        # Measured 2e-12; the limit of test.c is 1e-3.
        assert np.abs((values["estimate"] - estimate) / sigma).max() < 1e-6 * WORST["double"]
        np.testing.assert_allclose(values["sigma"], sigma, rtol=1e-9)
        available = recording.measurements.get("available", np.ones((len(recording.names), len(seen), 1)))
        available = available[episode][: len(seen)][seen].reshape(len(own), -1)
        np.testing.assert_array_equal(own["status"] == "taken", (available > 0.0).any(axis=1))
    return found


COPIES = {"rows twice": 3, "rows twice with other values": 3, "rows that supply each other": 1}


@pytest.mark.parametrize("id", RENAMES)
@pytest.mark.parametrize("form", FORMATS)
def test_c_reads_every_form_of_a_log_as_an_evaluation_does(form, id, programs, tmp_path):
    place, name = programs[id]
    path = tmp_path / "some.csv"
    path.write_text(FORMATS[form](log_of(id)), encoding="utf-8", newline="")
    recording = read_recording(path, id, rename=RENAMES[id])
    done = subprocess.run([place / "c" / "log", path], capture_output=True, check=False)
    assert done.stderr == b""
    found = check_rows(id, name, recording, done, COPIES.get(form, 0))
    missed = dict.fromkeys(("empty cells", "words for no number"), 2 * (id != ESM))
    missed["positions that repeat"] = 3 * (id == TARGET)
    assert (found["status"] == "missed").sum() == missed.get(form, 0)


def geodetic(table):
    """Latitude, longitude and altitude with gaps, a receiver without a fix, and repeats; the second drive elsewhere."""
    g = np.random.default_rng(6)
    east, north = table["East"], table["north"]
    found = table[["t", "drive"]].assign(
        lat=(47.3 + north / 111.2e3).round(7), lon=(8.5 + east / 75.5e3).round(7)
    )
    found["alt"] = (400.0 + g.normal(0.0, 2.0, len(table))).round(1)
    found.loc[g.random(len(table)) < 0.2, "alt"] = np.nan
    found.loc[[3, 18], ["lat", "lon"]] = 0.0
    found.loc[22:23, ["lat", "lon"]] = found.loc[21, ["lat", "lon"]].to_numpy()
    found.loc[25, "lon"] = np.nan
    found.loc[31, ["lat", "lon"]] = found.loc[30, ["lat", "lon"]] + 1e-7  # as fine as the numbers are
    return pandas.concat([found, found.assign(drive="second", lat=found["lat"] + 0.2 * (found["lat"] > 0.0))])


def polar(table):
    """Range and azimuth of the positions, without deviations."""
    east, north = table["East"], table["north"]
    return table[["t"]].assign(range=np.hypot(east, north), azimuth=np.degrees(np.arctan2(east, north)))


def odometry(table, polar=False):
    """The positions with the displacements of a second sensor, or its speed and heading, which is silent at times."""
    found = table[["t", "East", "north", "accuracy"]].copy()
    if polar:
        found["odometry_speed"], found["odometry_heading"] = 14.0 + 0.1 * table["t"], 120.0 - 0.2 * table["t"]
    else:
        found["odometry_x"], found["odometry_y"] = 12.0 + 0.0 * table["t"], -7.0 + 0.01 * table["t"]
    found.iloc[[10, 11, 25], 4] = np.nan
    return found


PLACES = {
    "latitude": (geodetic, {"t": "time", "alt": "altitude", "drive": "recording"}),
    "range": (polar, {"t": "time"}),
    "odometry": (odometry, {name: RENAMES[TARGET][name] for name in ("t", "East", "north", "accuracy")}),
    "odometry by speed": (
        lambda table: odometry(table, polar=True),
        {name: RENAMES[TARGET][name] for name in ("t", "East", "north", "accuracy")},
    ),
}


@pytest.mark.parametrize("kind", PLACES)
def test_c_reads_every_kind_of_position(kind, tmp_path):
    make, rename = PLACES[kind]
    table, path = make(log_of(TARGET)), tmp_path / "some.csv"
    path.write_text(lines(times(table, lambda d: d.isoformat()), sep=";", decimal=","), encoding="utf-8")
    name = advised(tmp_path, TARGET, path, "mine.filter.json", rename)
    setup = find_competitor(problem_of(TARGET), name).log
    recording = read_recording(path, TARGET, rename=rename, **setup.assumed)
    done = subprocess.run([tmp_path / "c" / "log", path], capture_output=True, check=False)
    found = check_rows(TARGET, name, recording, done)
    assert (found["status"] == "missed").sum() == (10 if kind == "latitude" else 0)
    assert done.stderr.count(b"x is east and y north of latitude 4") == (2 if kind == "latitude" else 0)


def put(row, column, cell, **options):
    """A log of plots with a cell of another text."""
    table = log_of(TARGET).astype(object)
    table.loc[row, column] = cell
    return lines(table, **options)


def put_times(write):
    """A log of plots with times that a function writes of dates."""
    return lines(times(log_of(TARGET), write))


BAD = {
    "a word": (lambda: put(3, "East", "abc"), "East has 'abc' in row 3 (line 5), which is no number"),
    "a blank": (lambda: put(3, "East", " "), "East has ' ' in row 3 (line 5), which is no number"),
    "hexadecimal": (lambda: put(3, "East", "0x1F"), "East has '0x1F' in row 3"),
    "two commas": (lambda: put(3, "East", "1,234,5", sep=";"), "East has '1,234,5' in row 3"),
    "commas and points": (lambda: put(3, "East", "1,5", sep=";"), "decimal commas and points"),
    "infinite": (lambda: put(4, "north", "inf"), "north has 'inf' in row 4"),
    "beyond all numbers": (lambda: put(4, "north", "1e400"), "north has '1e400' in row 4"),
    "too large": (lambda: put(4, "north", "1e16"), "north has '1e16' in row 4 (line 6), which is too large"),
    "control characters": (lambda: put(4, "north", "\x1b[2J"), "north has '?[2J' in row 4"),
    "a long cell": (lambda: put(4, "north", 2000 * "1"), "north has '1111"),
    "half a position": (lambda: put(4, "north", ""), "one coordinate of two alone in row 4 (line 6)"),
    "no deviation": (lambda: put(5, "accuracy", ""), "standard deviation accuracy in row 5"),
    "a deviation of zero": (lambda: put(5, "accuracy", 0), "standard deviation accuracy in row 5"),
    "far away": (lambda: put(5, "north", 6e5), "too far away"),
    "no time": (lambda: put(6, "t", ""), "t has no value in row 6 (line 8)"),
    "no first time": (lambda: put(0, "t", ""), "t has no value in row 0 (line 2)"),
    "a time in words": (lambda: put(6, "t", "noon"), "t has 'noon' in row 6 (line 8), which is no number"),
    "time decreases": (lambda: put(6, "t", 1.5), "t decreases in row 6 (line 8)"),
    "a gap": (lambda: put(35, "t", 5000), "too many intervals"),
    "no such day": (lambda: put_times(lambda d: f"2026-02-30T{d:%H:%M:%S}"), "neither seconds nor a date"),
    "month first": (lambda: put_times(lambda d: f"{d:%m/%d/%Y %H:%M:%S}"), "neither seconds nor a date"),
    "no offset in a row": (lambda: put_times(lambda d: d.isoformat()[: 25 - 6 * (d.second == 44)]), "with an offset"),
    "no time of day": (lambda: put_times(lambda d: "noon" if d.second == 44 else f"{d:%H:%M:%S}"), "no time of day"),
    "whole seconds": (lambda: lines(log_of(TARGET).assign(t=np.arange(36) // 4)), "fractions of a second"),
    "a short row": (lambda: lines(log_of(TARGET)) + "1,2\n", "not as many cells as names of columns in row 36"),
    "no such column": (lambda: lines(log_of(TARGET)).replace("north", "n"), "it lacks the column north"),
    "a column twice": (lambda: lines(log_of(TARGET)).replace("note", "NORTH"), "more than once the column north"),
    "no text": (lambda: put(4, "north", "1\0"), "it is no text"),
    "nothing": (lambda: "", "it lacks the column t"),
    "no rows": (lambda: "t,East,north,accuracy,drive\n", "it has no two rows"),
    "one row": (lambda: "t,East,north,accuracy,drive\n1,2,3,4,a\n", "it has no two rows"),
    "one row of a recording": (lambda: lines(log_of(TARGET)) + "99,1,2,3,b,x\n", "a recording has no two rows"),
    "two plots": (lambda: "t,East,north,accuracy\n1,2,3,4\n2,3,4,4\n3,,,4\n", "no three of them"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_c_refuses_in_a_sentence_what_the_reader_refuses(case, programs, tmp_path):
    make, sentence = BAD[case]
    (tmp_path / "bad.csv").write_text(make(), encoding="utf-8", newline="")
    done = subprocess.run(
        [programs[TARGET][0] / "c" / "log", tmp_path / "bad.csv"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    # Columns are named as in the log, in lower case.
    assert sentence.lower() in done.stderr.lower()
    assert done.stderr.count("\n") == 1
    with pytest.raises(ValueError, match="recording"):
        read_recording(tmp_path / "bad.csv", TARGET, rename=RENAMES[TARGET])


def put_in(id, row, **cells):
    """A log with some cells of another text."""
    table = log_of(id).astype(object)
    for column, cell in cells.items():
        table.loc[row, column.replace("_", " ")] = cell
    return lines(table)


BAD_ROWS = {
    "no position by the INS": (LOOSE, lambda: put_in(LOOSE, 5, ins_east=""), "ins east has no value in row 5 (line 7)"),
    "no deviation": (LOOSE, lambda: put_in(LOOSE, 0, accuracy=""), "accuracy has no value in row 0"),
    "a deviation of zero": (LOOSE, lambda: put_in(LOOSE, 7, accuracy=0), "standard deviation accuracy in row 7"),
    "no fix": (LOOSE, lambda: lines(log_of(LOOSE).assign(north="")), "no row has on every axis a north"),
    "a missing row": (LOOSE, lambda: lines(log_of(LOOSE).drop(index=9)), "one interval apart, by their time"),
    "no range": (ESM, lambda: put_in(ESM, 5, distance=""), "distance has no value in row 5"),
    "a missing scan": (ESM, lambda: lines(log_of(ESM).drop(index=9)), "one interval apart, by their time: it is not"),
    "no whole number": (ESM, lambda: put_in(ESM, 8, type=1.5), "number of an emitter type"),
    "no such type": (ESM, lambda: put_in(ESM, 8, type=4), "number of an emitter type"),
    "no bearing": (ESM, lambda: put_in(ESM, 8, apart=""), "no bearings are beside the decision in row 8"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_ROWS)
def test_c_refuses_rows_at_one_rate_that_the_reader_refuses(case, programs, tmp_path):
    id, make, sentence = BAD_ROWS[case]
    done = run(programs[id][0] / "c" / "log", make())
    assert done.returncode == 2
    assert sentence in done.stderr.decode()
    assert done.stderr.count(b"\n") == 1
    (tmp_path / "bad.csv").write_text(make(), encoding="utf-8")
    with pytest.raises(ValueError, match="recording"):
        read_recording(tmp_path / "bad.csv", id, rename=RENAMES[id])


def test_a_track_that_is_longer_than_the_tables_of_a_filter_is_refused(programs):
    table = log_of(ESM)
    longer = pandas.concat([table, table.iloc[-1:].assign(t=float(COUNT))])
    done = run(programs[ESM][0] / "c" / "log", lines(longer))
    assert done.returncode == 2
    assert b"advise on this log" in done.stderr


def test_an_advised_filter_has_the_parameters_of_its_log_and_none_of_a_scenario(programs):
    problem = problem_of(ESM)
    request = request_export(problem, programs[ESM][1])
    expected = read_recording(programs[ESM][0] / "first.csv", ESM, rename=RENAMES[ESM]).scenario(
        problem.task, {}
    )
    assert request.scenario.parameters == expected.parameters
    assert request_export(problem, programs[ESM][1], "paper").scenario == "paper"
    running = filtergym.online(ESM, programs[ESM][1])
    assert running.model.task.parameters.association_error == problem.task.Parameters().association_error


def test_a_log_that_cannot_be_opened_or_written_is_refused(programs, tmp_path):
    program = programs[TARGET][0] / "c" / "log"
    for path in (tmp_path / "none.csv", tmp_path):
        assert subprocess.run([program, path], capture_output=True, check=False).returncode == 2
    if Path("/dev/full").exists():
        with Path("/dev/full").open("wb") as full:
            done = subprocess.run(
                [program], input=lines(log_of(TARGET)), stdout=full, stderr=-1, text=True, check=False
            )
        assert done.returncode == 2
        assert "cannot write" in done.stderr


def test_a_rejected_row_of_a_log_has_no_estimate_and_leaves_the_state(programs):
    program = programs[OWN][0] / "c" / "log"
    table = log_of(OWN)
    first = run(program, lines(table.iloc[:20]))
    late = run(program, lines(pandas.concat([table.iloc[:20], table.iloc[[20]].assign(t=1e200)])))
    assert late.returncode == 1
    assert b"1 measurements were rejected or refused" in late.stderr
    assert b"the first was in row 20 (line 22)" in late.stderr
    *same, last = late.stdout.decode().splitlines()
    assert [line.split(",")[2] for line in same] == [
        line.split(",")[2] for line in first.stdout.decode().splitlines()
    ]
    assert last == "a,9.9999999999999997e+199,rejected,,,,"


NUMBERS = ("nan", "inf", "-inf", "1e308", "-1e308", "0", "1", "-5", "1e-320", "")


@pytest.mark.parametrize("id", RENAMES)
def test_a_table_of_wild_numbers_never_prints_what_is_no_estimate(id, programs):
    folder = programs[id][0] / "c"
    header, first, second, *_ = (folder / "measurements.csv").read_text().splitlines()
    cells = second.split(",")
    filled = [i for i, cell in enumerate(cells) if cell]
    rows = [[n if i == at else cell for i, cell in enumerate(cells)] for at in filled[1:] for n in NUMBERS]
    g = np.random.default_rng(0)
    rows += [
        [str(g.choice(NUMBERS)) if i in filled[1:] else cell for i, cell in enumerate(cells)]
        for _ in range(300)
    ]
    text = "\n".join([header, *(line for row in rows for line in (first, ",".join(row), second))])
    done = run(folder / "main", text)
    assert done.returncode == 1
    assert b"measurements were rejected or refused, the first in line" in done.stderr
    found = pandas.read_csv(io.BytesIO(done.stdout))
    assert len(found) == 3 * len(rows)
    estimates = found.filter(like="estimate_").to_numpy()
    refused = np.isnan(estimates).all(axis=1)
    assert np.isfinite(estimates[~refused]).all()
    assert 0 < refused.sum() < 2 * len(rows)
    bad = run(folder / "main", f"{header}\n{first}\n{second.replace(cells[-1], 'one')}\n")
    assert bad.returncode == 2
    assert b"line 3: cell" in bad.stderr


def test_early_ends_of_the_protocol_leave_nothing_behind(programs):
    program = programs[TARGET][0] / "c" / "main"
    rows = (program.parent / "rows.h").read_text()
    initial, measurement = (rows.count(f"{part}->") for part in ("initial", "measurement"))
    numbers = {"initial": initial, "measurement": measurement, "answer": 20}
    hello = lambda tracks: json.dumps({"filtergym": 1, "tracks": tracks, "numbers": numbers}) + "\n"  # noqa: E731
    for text, status in (
        (hello(3), 0),
        (hello(3) + 100 * "\0", 0),
        (hello(3) + 3 * (initial + 2 * measurement) * "\0\0\0\0\0\0\0\0", 0),
        (hello(10**15), 2),
        (hello(0), 2),
        ("{", 2),
    ):
        done = run(program, text)
        assert done.returncode == status, done.stderr
        assert b"ERROR" not in done.stderr


def test_where_no_log_is_read_the_export_notes_it(programs, success, tmp_path):
    table = json.loads(Path(programs[TARGET][1]).read_text())
    for columns, has_note in (
        (table["log"]["columns"], False),
        ({}, True),
    ):  # of a receiver's file there are no columns
        (tmp_path / "own.filter.json").write_text(
            json.dumps(table | {"log": table["log"] | {"columns": columns}})
        )
        folder = tmp_path / str(has_note)
        output = success(
            "export", TARGET, str(tmp_path / "own.filter.json"), "--to", "c", "--out", str(folder)
        )
        assert ("no log.c" in output) is has_note
        assert (folder / "log.c").exists() is not has_note


def test_every_way_of_reading_a_log_is_decided_for_c():
    """A new option of the reader, or a new kind of table, is decided here and in filtergym/exports/c_log.py."""
    decided = {
        "path": "the file; one, CSV",
        "environment": "at export",
        "speeds": "judges a recording, changes none",
        "truth": "not read",
        "truth_offset": "not read",
        "rename": "columns of LogSetup and of a Recording",
        "sort": "refused: a row whose time decreases ends the program",
        "keywords": "parameters of LogSetup and of the request",
    }
    assert set(inspect.signature(read_recording).parameters) == decided.keys()
    kinds = {name for name in LogFormat.__dataclass_fields__ if name.endswith("_rows")}
    assert kinds == {"plain_rows", "plot_rows", "regular_rows"}
    assert find_companion(problem_of(TARGET).task, LogFormat).plot_rows is not None
    assert DELIMITERS == ",;\t"
    # Every number of the reader's is one of the program's.
    for name in READING:
        assert re.search(rf"\b{name}\b", READER), name
