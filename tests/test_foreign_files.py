"""Small files that ask for much: each is refused in one sentence, which names the limit."""

import gzip
import json
import os
import sqlite3
import struct
import warnings

import numpy as np
import pytest

from filtergym import read_flights, read_recording
from filtergym.agents.learned_policy import PRETRAINED, load_policy
from filtergym.agents.settings import read_config
from filtergym.baselines.fitted_filters import read_artefact
from filtergym.baselines.problem import problem_of
from filtergym.envs.contract.parameters import quote_shortened
from filtergym.envs.data import foreign_files
from filtergym.envs.data.foreign_files import (
    open_foreign,
    parse_apart,
    parse_json,
    read_yaml,
)
from filtergym.evaluation.storage.stored import read_json

TARGET = "filtergym/ManeuveringTarget-v0"
ROWS = [{"time": 2.0 * i, "x": 2e4 + 200.0 * i, "y": 1e4 - 100.0 * i} for i in range(60)]


def refused(path, match):
    with pytest.raises(ValueError, match=match) as error:
        read_recording(path, TARGET)
    assert len(str(error.value)) < 500
    assert "\n" not in str(error.value)


def write_csv(path, header, rows):
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


# --- what is opened


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with a name here")
def test_devices_pipes_and_folders_are_no_files(tmp_path):
    os.symlink("/dev/zero", tmp_path / "zero.json")
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "folder.json").mkdir()
    for name in ("zero", "pipe", "folder"):
        with pytest.raises(ValueError, match="it is no file but a folder, a device or a pipe"):
            read_json(tmp_path / f"{name}.json")
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "none.json")


def test_a_file_larger_than_its_reader_takes(tmp_path):
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(10**12)  # takes no room on the disk
    with pytest.raises(ValueError, match="it is larger than 512 MB: split it"):
        read_json(tmp_path / "a.json")
    with pytest.raises(ValueError, match="it is larger than 1 GB"), open_foreign(tmp_path / "a.json"):
        pass


# --- tables


def test_too_many_or_too_long_names_and_cells(tmp_path):
    many = ",".join(f"c{i}" for i in range(60_000))
    dates = ["2026-05-01T12" + ":00x" * 30_000 + ",1,2"] * 2
    for header, rows, sentence in (
        ("time,x,y," + many, ["0,1,2" + 60_000 * ","], "it has 60,003 columns"),
        ("time,x,y" + 300 * "y", ["0,1,2"], "a column name of 301 characters"),
        ("time,x,y" + 2_000_000 * " ", ["0,1,2"], "a line of more than 1,000,000"),
        ("time,x,y", [f"0,1,{2000 * '7'}"], "y has a cell of 2,000 characters"),
        ("time,x,y", dates, "time has a cell of 120,013 characters"),
    ):
        refused(write_csv(tmp_path / "a.csv", header, rows), sentence)
    path = tmp_path / "a.json"
    path.write_text(json.dumps([{**ROWS[0], **dict.fromkeys(many.split(","), 0)}]))
    refused(path, "it has 60,003 columns")
    path.write_text(json.dumps([{f"c{i}": 0} for i in range(2000)]))
    refused(path, "it has 1,001 columns")
    path.write_text(json.dumps([{**row, "x": "z" * 2_000_000} for row in ROWS[:2]]))
    refused(path, "x has a cell of 2,000,000 characters")
    path.write_text(json.dumps([{**row, "x": 10**400} for row in ROWS]))
    refused(path, "x has a whole number of 400 digits in row 0, which is no number")


def test_json_is_counted_before_it_is_parsed(tmp_path, monkeypatch):
    monkeypatch.setenv("FILTERGYM_READ_MEMORY", "20")
    with gzip.open(tmp_path / "bomb.json.gz", "wb") as file:
        file.write(b"[" + 20 * (b"{}," * 100_000) + b"{}]")
    with pytest.raises(ValueError, match=r"may take 20 MB: split it, or set FILTERGYM_READ_MEMORY=40 \(MB\)"):
        read_flights(tmp_path / "bomb.json.gz")
    with pytest.raises(ValueError, match="it holds 200,002 values, up to"):
        parse_json(b"[" + b"{}," * 100_000 + b"{}]")
    assert parse_json(json.dumps(ROWS).encode()) == ROWS
    with pytest.raises(ValueError, match="it is nested too deeply"):
        parse_json(b"[" * 70_000)


def test_limits_are_positive_numbers(monkeypatch):
    for value in ("x", "-1", "nan", "inf", "0"):
        monkeypatch.setenv("FILTERGYM_READ_MEMORY", value)
        with pytest.raises(ValueError, match=f"READ_MEMORY must be a positive number, got '{value}'"):
            foreign_files.limits()


def test_a_long_value_is_quoted_in_short():
    assert quote_shortened("ab") == "'ab'"
    assert len(quote_shortened("z" * 10**6)) == 83
    assert quote_shortened(10**400) == "a whole number of 400 digits"


# --- parsers of others, in a process of their own


def netcdf4(path, rows=60, dtype="f8", **more):
    h5netcdf = pytest.importorskip("h5netcdf", reason="not installed: pip install 'filtergym[flights]'")
    with h5netcdf.File(path, "w") as file:
        file.dimensions = {"time": rows}
        for name in ("time", "x", "y"):
            data = np.array([row[name] for row in ROWS]) if rows == len(ROWS) else None
            chunks = None if data is not None else (min(rows, 10**6),)
            file.create_variable(name, ("time",), dtype, data=data, chunks=chunks)
        for name, arguments in more.items():
            file._h5file.create_dataset(name, **arguments)
            file._h5file[name].dims[0].attach_scale(file._h5file["time"])
    return path


def test_netcdf_of_values_that_were_never_written(tmp_path):
    path = netcdf4(tmp_path / "huge.nc", 2 * 10**9)
    assert path.stat().st_size < 20_000
    refused(path, r"it holds 6,000,000,000 numbers, more than the limit of 50,000,000: split it")


def test_netcdf_of_long_words(tmp_path):
    words = {"shape": (60_000,), "dtype": "S9000", "chunks": (100,)}
    path = netcdf4(tmp_path / "words.nc", 60_000, icao24=words)
    with pytest.raises(
        ValueError, match=r"its values take 541 MB, and reading a file may take 512 MB: split it"
    ):
        read_flights(path)


def test_netcdf_takes_no_values_from_another_file(tmp_path):
    (tmp_path / "secret").write_bytes(np.arange(60.0).tobytes())
    outside = {"shape": (60,), "dtype": "f8", "external": [(str(tmp_path / "secret"), 0, 480)]}
    refused(netcdf4(tmp_path / "a.nc", other=outside), "other takes its values from another file")
    path = netcdf4(tmp_path / "b.nc")
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "a") as file:
        file["other"] = h5py.ExternalLink(str(tmp_path / "a.nc"), "/x")
    refused(path, "other is a link to another file")


def test_an_honest_netcdf_is_what_xarray_reads(tmp_path):
    xarray = pytest.importorskip("xarray")
    path = netcdf4(tmp_path / "a.nc")
    found = read_recording(path, TARGET)
    with xarray.open_dataset(path, engine="h5netcdf", decode_times=False) as data:
        data.load().to_netcdf(tmp_path / "classic.nc", engine="scipy")
    again = read_recording(tmp_path / "classic.nc", TARGET)
    for name, values in found.measurements.items():
        np.testing.assert_array_equal(values, again.measurements[name])


def test_parquet_of_long_words_and_of_every_type(tmp_path):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = {name: [row[name] for row in ROWS] for name in ROWS[0]}
    words = pyarrow.DictionaryArray.from_arrays(pyarrow.array([0] * 60, pyarrow.int32()), ["x" * 20_000])
    parquet.write_table(
        pyarrow.table({**columns, "icao24": words}), tmp_path / "a.parquet", store_schema=False
    )
    with pytest.raises(ValueError, match="icao24 has a cell of 20,000 characters"):
        read_flights(tmp_path / "a.parquet")
    whole = read_recording(
        write_csv(tmp_path / "a.csv", "time,x,y", [",".join(map(str, r.values())) for r in ROWS]), TARGET
    )
    for kind in (pyarrow.decimal128(12, 3), pyarrow.int64(), pyarrow.string()):
        cast = {name: pyarrow.array(v).cast(kind) for name, v in columns.items()}
        parquet.write_table(pyarrow.table(cast), tmp_path / "b.parquet")
        found = read_recording(tmp_path / "b.parquet", TARGET)
        np.testing.assert_array_equal(found.measurements["position"], whole.measurements["position"])
    dates = pyarrow.array([int(1e9 * t) for t in columns["time"]]).cast(
        pyarrow.timestamp("ns", tz="Europe/Paris")
    )
    parquet.write_table(pyarrow.table({**columns, "time": dates}), tmp_path / "c.parquet")
    np.testing.assert_array_equal(read_recording(tmp_path / "c.parquet", TARGET).seconds, whole.seconds)


def ulog(path, formats):
    message = lambda kind, body: struct.pack("<HB", len(body), ord(kind)) + body  # noqa: E731
    content = (
        bytes([0x55, 0x4C, 0x6F, 0x67, 0x01, 0x12, 0x35, 1]) + struct.pack("<Q", 0) + message("B", bytes(40))
    )
    content += b"".join(message("F", text.encode()) for text in formats)
    content += message("A", struct.pack("<BH", 0, 0) + b"vehicle_gps_position")
    path.write_bytes(content + 3 * message("D", struct.pack("<H", 0) + bytes(100)))
    return path


def test_a_log_of_nested_types_takes_no_longer_than_it_may(tmp_path, monkeypatch):
    pytest.importorskip("pyulog", reason="not installed: pip install 'filtergym[logs]'")
    monkeypatch.setenv("FILTERGYM_READ_SECONDS", "1")
    nested = ["a0:uint8_t x;", *(f"a{i}:a{i - 1} l;a{i - 1} r;" for i in range(1, 40))]
    path = ulog(tmp_path / "a.ulg", [*nested, "vehicle_gps_position:uint64_t timestamp;a39 x;"])
    refused(path, r"(took more than 1 s: it is damaged, or set FILTERGYM_READ_SECONDS=4|may take 512 MB)")


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="memory is limited on Linux only")
def test_a_bag_whose_messages_are_made_when_read(tmp_path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="not installed: pip install 'filtergym[logs]'")
    typesys = pytest.importorskip("rosbags.typesys")
    with rosbag2.Writer(tmp_path / "bag", version=8) as writer:
        types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        writer.add_connection("/fix", "sensor_msgs/msg/NavSatFix", typestore=types)
    path = next((tmp_path / "bag").glob("*.db3"))
    with sqlite3.connect(path) as data:
        data.execute("drop table messages")
        data.execute(
            "create table messages(id integer primary key, topic_id integer, timestamp integer,"
            " data blob generated always as (zeroblob(999999900)) virtual)"
        )
        data.execute("insert into messages(topic_id, timestamp) values (1, 1), (1, 2), (1, 3)")
    data.close()
    refused(path, "its parser needs more memory, and reading a file may take 512 MB: split it, or set FILT")


def test_yaml_is_counted_with_its_aliases(tmp_path):
    pytest.importorskip("yaml", reason="not installed: pip install 'filtergym[agents]'")
    path = tmp_path / "a.yml"
    lines = ["a: &a [x,x,x,x,x,x,x,x,x,x]"]
    lines += [f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 10)}]" for i in range(9)]
    path.write_text("\n".join([*lines, "env: {scenario: *j}"]))
    with pytest.raises(ValueError, match="it holds more than 100,000 values, aliases resolved: write fewer"):
        read_config(path, TARGET)
    path.write_text("a: &a [*a]\n")
    with pytest.raises(ValueError, match="cannot read settings from"):
        read_config(path, TARGET)
    path.write_text("base: &base {n: 3, rate: 0.001}\nother:\n  <<: *base\n  rate: [1, yes, null, 'x']\n")
    assert read_yaml(path) == {
        "base": {"n": 3, "rate": 0.001},
        "other": {"n": 3, "rate": [1, True, None, "x"]},
    }


def test_where_memory_has_no_limit_one_warning_states_it(tmp_path, monkeypatch):
    pytest.importorskip("yaml")
    (tmp_path / "a.yml").write_text("a: 1\n")
    monkeypatch.setattr(foreign_files.sys, "platform", "elsewhere")
    monkeypatch.setattr(foreign_files, "_WARNED", [])
    with pytest.warns(UserWarning, match="elsewhere cannot limit the memory of a process"):
        assert read_yaml(tmp_path / "a.yml") == {"a": 1}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_yaml(tmp_path / "a.yml") == {"a": 1}


def test_a_parser_starts_without_the_package(tmp_path, monkeypatch):
    """A library that looks for the package where it is imported finds none, and raises another error."""
    absent = "assert not any(name.startswith('filtergym') for name in sys.modules)"
    (tmp_path / "pyulog.py").write_text(f"import sys\n{absent}\nraise ImportError")
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "a.ulg").write_bytes(b"x")
    with pytest.raises(ValueError, match="it needs one more package: this"):
        parse_apart("ulog", tmp_path / "a.ulg", "this", rows_limit=1)


# --- values that are read are checked like values that are typed


def test_values_of_fitted_filters_keep_their_limits(tmp_path):
    path, problem = tmp_path / "a.filter.json", problem_of(TARGET)
    message = r"log10_acceleration must be from -15\.5 to 13\.5|not the file of an advised filter"
    for value in (float("nan"), float("inf"), 100, -300, 10**400, "1", None, True):
        values = {"log10_acceleration": value}
        path.write_text(json.dumps({"environment": TARGET, "filter": "constant-velocity", "values": values}))
        with pytest.raises(ValueError, match=message):
            read_artefact(path, problem)


@pytest.mark.parametrize(
    ("name", "value"),
    [("hyperparameters", "x"), ("hyperparameters", {"env_kwargs": 3}), ("gated", "yes"), ("residual_to", 7)],
)
def test_the_header_of_an_agent_has_its_declared_types(name, value, tmp_path):
    content = (PRETRAINED / "ManeuveringTarget-v0" / "bptt-small.safetensors").read_bytes()
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    run = json.loads(header["__metadata__"]["run"])
    header["__metadata__"]["run"] = json.dumps({**run, name: value})
    text = json.dumps(header).encode()
    path = tmp_path / "a.safetensors"
    path.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + size :])
    with pytest.raises(ValueError, match=r"is not a learned policy of filtergym: .* of its run must"):
        load_policy(problem_of(TARGET).task, path)


def test_limits_can_be_raised(tmp_path, monkeypatch):
    """What a limit refuses is read where its variable allows it."""
    path = write_csv(tmp_path / "a.csv", "time,x,y", [",".join(map(str, r.values())) for r in ROWS])
    (tmp_path / "a.json").write_text(json.dumps(ROWS))
    monkeypatch.setenv("FILTERGYM_READ_MEMORY", "0.01")
    refused(tmp_path / "a.json", "up to 0 MB, and reading a file may take 0 MB")
    monkeypatch.setenv("FILTERGYM_READ_MEMORY", "1")
    json_read, csv_read = read_recording(tmp_path / "a.json", TARGET), read_recording(path, TARGET)
    np.testing.assert_array_equal(json_read.seconds, csv_read.seconds)
