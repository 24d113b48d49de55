"""Parsers based on other libraries, run as a separate program under limits of memory and processor time.

:mod:`.foreign_files` starts this file with the interpreter's ``-I`` and a request in JSON: the parser, the
path, and the limits. The file to read is open as standard input. The result goes to standard output: the length of a
head in eight bytes, the head in JSON, then the bytes of the arrays that the head names. Nothing of the package is
imported here, so that a start costs a tenth of a second; a parser may use NumPy and its own library only.

A parser returns plain values: numbers, words, lists, arrays, and dictionaries whose keys are defined here; names from
a file are in lists of pairs. It raises ``ValueError`` with a sentence for the user.
"""

import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

MOST_COLUMNS = 1000
"""Most columns of a table."""
LONGEST_NAME = 200
"""Longest name of a column, characters."""
LONGEST_CELL = 1000
"""Longest cell, characters."""
MOST_NODES = 100_000
"""Most values of a configuration, after its aliases are resolved."""


def check_column_names(names: Sequence[str]) -> list[str]:
    """Return a table's column names in lower case; raise ValueError for too many, too long or equal names."""
    if len(names) > MOST_COLUMNS:
        raise ValueError(
            f"it has {len(names):,} columns, and a table has at most {MOST_COLUMNS:,}: leave some out"
        )
    longest = max(map(len, names), default=0)
    if longest > LONGEST_NAME:
        raise ValueError(
            f"it has a column name of {longest:,} characters, and a name has at most {LONGEST_NAME}: is the first "
            "line that of the names?"
        )
    lower = [name.lower() for name in names]
    twice = sorted(name for name, count in Counter(lower).items() if count > 1)
    if twice:
        raise ValueError(f"it has the column {', '.join(twice[:10])} more than once")
    return lower


def check_rows(count: int, most: int) -> None:
    """Raise ValueError if a table has more rows than the limit."""
    if count > most:
        raise ValueError(f"it has more than {most:,} rows: split it, or reduce the rate of its rows")


def check_cells(name: str, cells: Any) -> None:
    """Raise ValueError if a text in a column is longer than the limit of a cell."""
    longest = max((len(cell) for cell in cells if isinstance(cell, str | bytes)), default=0)
    if longest > LONGEST_CELL:
        raise ValueError(
            f"{name} has a cell of {longest:,} characters, and a cell has at most {LONGEST_CELL:,}: leave that column "
            "out"
        )


# --- NetCDF-4


def parse_netcdf4(
    file: BinaryIO, path: str, wanted: Mapping[str, Any] | None, bytes_limit: int, numbers_limit: int
) -> Any:
    """Return the attributes and variables of a NetCDF-4 file's root group, as lists of pairs.

    ``wanted`` has the lower-case ``names`` and the ``prefix`` of the variables whose values are read; None: all.
    Before any is read their bytes, and their number, are checked against the limits.
    """
    import h5netcdf
    import h5py

    with h5netcdf.File(file, "r", phony_dims="access", decode_vlen_strings=True) as data:
        _check_links(data._h5file, h5py)
        found: dict[str, Any] = {}
        chosen = {}
        if len(data.variables) > MOST_COLUMNS:
            raise ValueError(f"it has {len(data.variables):,} variables, and may have {MOST_COLUMNS:,}")
        for name, variable in data.variables.items():
            lower = name.lower()
            if (
                wanted is None
                or lower in wanted["names"]
                or (wanted["prefix"] and lower.startswith(wanted["prefix"]))
            ):
                chosen[name] = variable
        size = lambda variable: _count_of_shape(variable.shape)  # noqa: E731
        numbers = sum(map(size, chosen.values()))
        total = sum(size(variable) * max(_item_size(variable), 1) for variable in chosen.values())
        if numbers > numbers_limit:
            raise ValueError(
                f"it holds {numbers:,} numbers, more than the limit of {numbers_limit:,}: split it"
            )
        if total > bytes_limit:
            raise LimitError(f"its values take {total / 1e6:,.0f} MB")
        for name, variable in data.variables.items():
            values = None
            if name in chosen:
                values = variable[...]
                if getattr(values, "dtype", None) is not None and values.dtype.kind == "O":
                    cells = [cell.decode() if isinstance(cell, bytes) else cell for cell in values.ravel()]
                    if not all(isinstance(cell, str) for cell in cells):
                        raise ValueError(f"{name} must be numbers or words, got {variable.dtype}")
                    check_cells(name, cells)
                    values = {"words": cells, "shape": list(values.shape)}
            found[name] = [
                list(variable.dimensions),
                values,
                [*variable.attrs.items()] if name in chosen else [],
            ]
        return {"attrs": [*data.attrs.items()], "variables": [[name, *rest] for name, rest in found.items()]}


def _count_of_shape(shape: Sequence[int]) -> int:
    count = 1
    for length in shape:
        count *= int(length)
    return count


def _item_size(variable: Any) -> int:
    return int(getattr(variable.dtype, "itemsize", 16))


def _check_links(group: Any, h5py: Any) -> None:
    for name in group:
        link = group.get(name, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            raise ValueError(f"{name} is a link to another file: copy the values into this one")
        item = group.get(name)
        if isinstance(item, h5py.Dataset) and (item.external or item.is_virtual):
            raise ValueError(f"{name} takes its values from another file: copy them into this one")


def parse_netcdf4_names(file: BinaryIO, path: str) -> Any:
    """Return the names of the attributes of a NetCDF-4 file's root group."""
    import h5py

    with h5py.File(file, "r") as data:
        return {"names": [*data.attrs]}


# --- Parquet


def parse_parquet(
    file: BinaryIO, path: str, wanted: Mapping[str, Any], rows_limit: int, bytes_limit: int
) -> Any:
    """Return the names of all columns in a Parquet file, and the wanted columns as numbers, dates or text indices.

    ``wanted`` has the lower-case ``names`` and the ``prefix`` of the columns that are read. ``bytes_limit`` is of
    these columns unpacked, as the file states.
    """
    import pyarrow
    from pyarrow import parquet

    with parquet.ParquetFile(file) as data:
        schema, metadata = data.schema_arrow, data.metadata
        names = list(schema.names)
        check_rows(metadata.num_rows, rows_limit)
        chosen = [
            name
            for name, lower in zip(names, check_column_names(names), strict=True)
            if lower in wanted["names"] or (wanted["prefix"] and lower.startswith(wanted["prefix"]))
        ]
        total = sum(
            group.column(i).total_uncompressed_size
            for group in (metadata.row_group(g) for g in range(metadata.num_row_groups))
            for i in range(group.num_columns)
            if group.column(i).path_in_schema in chosen
        )
        if total > bytes_limit:
            raise LimitError(f"its columns unpacked take {total / 1e6:,.0f} MB")
    # Repeated words are read as numbers, so that a long word is not copied a million times.
    types = pyarrow.types
    words = [
        n
        for n in chosen
        if types.is_string(schema.field(n).type) or types.is_large_string(schema.field(n).type)
    ]
    file.seek(0)
    with parquet.ParquetFile(file, read_dictionary=words) as data:
        table = data.read(columns=chosen, use_threads=False)
    return {"names": names, "columns": [[n, _arrow_column(n, table.column(n), pyarrow)] for n in chosen]}


def _arrow_column(name: str, column: Any, pyarrow: Any) -> Any:
    """Return an Arrow column as plain arrays; missing numbers are NaN, missing words have the number -1."""
    import numpy

    types, kind = pyarrow.types, column.type
    if types.is_dictionary(kind) and not types.is_string(kind.value_type):
        column, kind = column.cast(kind.value_type), kind.value_type
    if types.is_timestamp(kind):
        return {"dates": column.to_numpy().astype(f"datetime64[{kind.unit}]"), "zone": kind.tz}
    if types.is_duration(kind):
        return {"numbers": column.to_numpy().astype(f"timedelta64[{kind.unit}]")}
    if types.is_boolean(kind) or types.is_decimal(kind):
        column = column.cast(pyarrow.float64()) if column.null_count or types.is_decimal(kind) else column
        return {"numbers": column.to_numpy()}
    if types.is_integer(kind) or types.is_floating(kind):
        return {"numbers": column.to_numpy()}
    if types.is_null(kind):
        return {"numbers": numpy.full(len(column), numpy.nan)}
    if types.is_string(kind) or types.is_large_string(kind) or types.is_date(kind) or types.is_time(kind):
        column = column.dictionary_encode()
    elif not types.is_dictionary(kind):
        raise ValueError(f"{name} must be numbers, dates or words, got {kind}")
    numbers: dict[str, int] = {}
    codes = []
    for chunk in column.iterchunks():
        words = [str(word) for word in chunk.dictionary.to_pylist()]
        check_cells(name, words)
        own = numpy.array(
            [numbers.setdefault(word, len(numbers)) for word in words] or [-1], dtype=numpy.int32
        )
        indices = chunk.indices.fill_null(-1).to_numpy(zero_copy_only=False).astype(numpy.int64)
        codes.append(numpy.where(indices < 0, -1, own[numpy.maximum(indices, 0)]).astype(numpy.int32))
    return {"codes": numpy.concatenate(codes or [numpy.empty(0, numpy.int32)]), "words": [*numbers]}


# --- logs of receivers

ULOG_TOPICS = ("vehicle_gps_position", "sensor_gps")
"""Topics with positions of a receiver; the first in a log is read."""
ULOG_FIELDS = (
    "timestamp", "latitude_deg", "lat", "longitude_deg", "lon", "altitude_ellipsoid_m", "alt_ellipsoid", "fix_type",
    "eph",
)  # fmt: skip


ONBOARD_TOPICS = ("vehicle_local_position", "estimator_local_position")
"""Topics with positions of the vehicle's own filter; the first in a log is read."""
ONBOARD_FIELDS = ("timestamp", "timestamp_sample", "x", "y", "ref_lat", "ref_lon", "xy_valid")


def parse_ulog(file: BinaryIO, path: str, rows_limit: int, onboard: bool = False) -> Any:
    """Return a receiver's positions in a PX4 log (ULog): topic, names of its fields, and known fields as arrays.

    With ``onboard`` those of the vehicle's own filter, empty if there are none.
    """
    import pyulog

    topics, known = (ONBOARD_TOPICS, ONBOARD_FIELDS) if onboard else (ULOG_TOPICS, ULOG_FIELDS)
    log = pyulog.ULog(file, list(topics))
    present = {(topic.name, topic.multi_id): topic.data for topic in log.data_list}
    chosen = min(present, key=lambda key: (topics.index(key[0]), key[1]), default=None)
    if chosen is None:
        if onboard:
            return {}
        raise ValueError(f"it holds neither {' nor '.join(topics)}")
    data = present[chosen]
    check_rows(len(data["timestamp"]), rows_limit)
    fields = {name: data[name] for name in known if name in data}
    if onboard:
        whole = {"x", "y", "ref_lat", "ref_lon"} <= {*fields}
        return {"topic": chosen[0], "fields": fields} if whole else {}
    return {"topic": chosen[0], "names": [*data][:MOST_COLUMNS], "fields": fields}


FIXES = {"GPS": ("TimeUS", "Lat", "Lng", "Alt", "Status"), "GPA": ("TimeUS", "HAcc")}
"""Messages of ArduPilot with positions of a receiver, and their fields."""
ESTIMATES = dict.fromkeys(("XKF1", "NKF1"), ("TimeUS", "PN", "PE"))
"""Messages of the vehicle's own filter, EKF3 and EKF2; the first in a log is read."""
ORIGINS = {"ORGN": ("TimeUS", "Type", "Lat", "Lng")}


def parse_dataflash(file: BinaryIO, path: str, rows_limit: int, onboard: bool = False) -> Any:
    """Return the first receiver's fixes in an ArduPilot log, as columns, and their stated errors.

    With ``onboard`` the estimates of the first core of the vehicle's own filter, and their origins; empty if there are
    none.
    """
    import numpy
    from pymavlink import DFReader

    known = {**ESTIMATES, **ORIGINS} if onboard else FIXES
    log = DFReader.DFReader_binary(path)
    found: dict[str, list[list[float]]] = {name: [] for name in known}
    while (message := log.recv_match(type=[*known])) is not None:
        if getattr(message, "I", 0) or getattr(message, "C", 0):  # another receiver, another core
            continue
        name = message.get_type()
        found[name].append([float(getattr(message, field)) for field in known[name]])
        check_rows(len(found[name]), rows_limit)
    columns = {name: numpy.array(rows).reshape(-1, len(known[name])).T for name, rows in found.items()}
    if not onboard:
        if not columns["GPS"].size:
            raise ValueError("it holds no GPS")
        return columns
    topic = next((name for name in ESTIMATES if columns[name].size), None)
    return {} if topic is None else {"topic": topic, "estimates": columns[topic], "origins": columns["ORGN"]}


NAVSAT = "sensor_msgs/msg/NavSatFix"
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (ODOMETRY, "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseStamped")
"""Messages with positions, the first that a bag without :data:`NAVSAT` has."""


class _Bag(NamedTuple):
    reader: Any
    parse: Callable[[bytes, str], Any]
    digests: Callable[[str], str] | None
    """Digests of the library's definitions of types; None where a bag contains none."""

    def busiest(self, kind: str) -> str:
        counts: Counter[str] = Counter()
        for connection in self.reader.connections:
            if connection.msgtype == kind:
                counts[connection.topic] += connection.msgcount
        return next(iter(counts.most_common(1)), ("", 0))[0]

    def rows(self, topic: str, kind: str, values: Callable[[Any], tuple[float, ...]], most: int) -> Any:
        import numpy

        chosen = [c for c in self.reader.connections if c.topic == topic and c.msgtype == kind]
        check_rows(sum(connection.msgcount for connection in chosen), most)
        if self.digests is not None and any(c.digest != self.digests(kind) for c in chosen):
            raise ValueError(f"its {kind} is another than that of ROS 1")
        found = []
        for _, _, raw in self.reader.messages(chosen):
            found.append(values(self.parse(raw, kind)))
            check_rows(len(found), most)
        if not found:
            raise ValueError(f"its topic {topic} has no messages")
        return numpy.array(found, dtype=float).T


def _open_bag(path: str) -> _Bag:
    """Return an open ROS bag with the library's message types; those in a bag would be compiled to code."""
    from rosbags.typesys import Stores, get_typestore

    reader: Any
    if path.endswith(".bag"):
        from rosbags.rosbag1 import Reader as FirstReader

        types = get_typestore(Stores.ROS1_NOETIC)
        reader = FirstReader(Path(path))
        reader.open()
        return _Bag(reader, types.deserialize_ros1, lambda kind: types.generate_msgdef(kind)[1])
    from rosbags.rosbag2 import Reader as SecondReader

    types = get_typestore(Stores.ROS2_HUMBLE)
    # The file alone: metadata.yaml of its folder could name files elsewhere.
    reader = SecondReader(Path(path))
    reader.open()
    return _Bag(reader, types.deserialize_cdr, None)


def parse_bag(file: BinaryIO, path: str, rows_limit: int) -> Any:
    """Return the topic with the most positions in a ROS bag, its kind and its numbers ``(values, n)``.

    The same follows for a topic of odometry beside positions of a receiver.
    """
    bag = _open_bag(path)
    topic, source = bag.busiest(NAVSAT), bag.busiest(ODOMETRY)
    if topic:
        found = {"kind": NAVSAT, "topic": topic, "values": bag.rows(topic, NAVSAT, _fix_values, rows_limit)}
        if source:
            found |= {"source": source, "odometry": bag.rows(source, ODOMETRY, _pose_values, rows_limit)}
        return found
    for kind in POSES:
        topic = bag.busiest(kind)
        if topic:
            return {"kind": kind, "topic": topic, "values": bag.rows(topic, kind, _pose_values, rows_limit)}
    present = sorted({connection.msgtype for connection in bag.reader.connections})[:20]
    raise ValueError(f"it holds no {NAVSAT} and no positions; it holds {', '.join(present) or 'nothing'}")


def _seconds(header: Any) -> float:
    return float(header.stamp.sec + 1e-9 * header.stamp.nanosec)


def _fix_values(fix: Any) -> tuple[float, ...]:
    """Return time, status, latitude, longitude, altitude, variances east and north, and covariance type of a fix."""
    variances = fix.position_covariance.reshape(3, 3).diagonal()
    place = fix.latitude, fix.longitude, fix.altitude
    known = fix.position_covariance_type
    return _seconds(fix.header), fix.status.status, *place, *variances[:2].tolist(), known


def _pose_values(message: Any) -> tuple[float, ...]:
    """Return the time, x, y and their variances of a pose; a variance is zero if the message has none."""
    pose, variances = message.pose, (0.0, 0.0)
    if hasattr(pose, "covariance"):
        diagonal = pose.covariance.reshape(6, 6).diagonal()
        pose, variances = pose.pose, (float(diagonal[0]), float(diagonal[1]))
    return _seconds(message.header), pose.position.x, pose.position.y, *variances


# --- configurations


def parse_yaml(file: BinaryIO, path: str) -> Any:
    """Return the value in a YAML file as words, numbers, lists and mappings, aliases resolved."""
    import yaml

    try:
        found = yaml.load(file.read().decode("utf-8-sig"), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as error:
        raise ValueError(str(error).splitlines()[0] if str(error) else type(error).__name__) from error
    nodes = [0]

    def plain(value: Any) -> Any:
        nodes[0] += 1
        if nodes[0] > MOST_NODES:
            raise ValueError(f"it holds more than {MOST_NODES:,} values, aliases resolved: write fewer")
        if isinstance(value, list):
            return [plain(item) for item in value]
        if isinstance(value, dict):
            if not all(isinstance(name, str | int | float) for name in value):
                raise ValueError(f"settings map names to values, got {list(value)[:1]!r:.80}")
            return {"pairs": [[name, plain(item)] for name, item in value.items()]}
        if value is None or isinstance(value, bool | int | float | str):
            return value
        raise ValueError(f"values are words, numbers, lists and mappings, got {value!r:.80}")

    return {"yaml": plain(found)}


PARSERS: Mapping[str, Callable[..., Any]] = {
    "netcdf4": parse_netcdf4,
    "netcdf4_names": parse_netcdf4_names,
    "parquet": parse_parquet,
    "ulog": parse_ulog,
    "dataflash": parse_dataflash,
    "bag": parse_bag,
    "yaml": parse_yaml,
}
LIBRARIES: Mapping[str, tuple[str, ...]] = {
    "netcdf4": ("h5netcdf", "h5py"),
    "netcdf4_names": ("h5netcdf", "h5py"),
    "parquet": ("pyarrow.parquet",),
    "ulog": ("pyulog",),
    "dataflash": ("pymavlink.DFReader",),
    "bag": ("rosbags.rosbag1", "rosbags.rosbag2"),
    "yaml": ("yaml",),
}
"""Libraries that each parser imports."""


class LimitError(Exception):
    """Error for a file that needs more than the memory limit."""


# --- the program


class _WithoutPandas:
    """Import hook that hides pandas, whose import by Arrow takes 0.2 s and is not needed."""

    def find_spec(self, name: str, *_: Any) -> None:
        if name == "pandas":
            raise ImportError(name)


def _limit(memory: int, seconds: int) -> None:
    """Limit this process's further memory (bytes) and processor time (s), and forbid it to write files."""
    try:
        import resource
    except ImportError:  # Windows; the parent has reported it
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    if sys.platform == "linux":
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _plain(value: Any, arrays: list[Any]) -> Any:
    """Return a value in JSON's types; its arrays are appended to ``arrays`` in native byte order."""
    if isinstance(value, dict):
        return {name: _plain(item, arrays) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, arrays) for item in value]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if hasattr(value, "dtype"):
        import numpy

        array = numpy.asarray(value)
        if array.dtype.kind not in "biufMmSU":
            if array.dtype.kind == "O" and all(isinstance(item, str) for item in array.ravel()):
                return [str(item) for item in array.ravel()]
            raise ValueError(f"its values must be numbers or words, got {array.dtype}")
        array = numpy.ascontiguousarray(array.astype(array.dtype.newbyteorder("="), copy=False)).reshape(
            array.shape
        )
        arrays.append(array)
        return {"array": len(arrays) - 1, "dtype": array.dtype.str, "shape": list(array.shape)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ValueError(f"it contains a value that is neither a number nor a word: {type(value).__name__}")


def _answer(handle: int, head: Any, arrays: Sequence[Any] = ()) -> None:
    text = json.dumps(head).encode()
    with os.fdopen(handle, "wb") as out:
        out.write(len(text).to_bytes(8, "little"))
        out.write(text)
        for array in arrays:
            out.write(array.reshape(-1).view("u1").data if array.size else b"")


def main() -> None:
    """Parse the file that the request in the program's first argument names; write the result to standard output."""
    request = json.loads(sys.argv[1])
    # Libraries print warnings, so the result has a channel of its own.
    answers = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    sys.path[:] = request["modules"]
    sys.dont_write_bytecode = True
    sys.meta_path.insert(0, _WithoutPandas())
    try:
        for name in LIBRARIES[request["parser"]]:
            __import__(name)
    except ImportError as error:
        return _answer(answers, {"missing": str(error)})
    _limit(request["memory"], request["seconds"])
    try:
        arrays: list[Any] = []
        found = PARSERS[request["parser"]](
            os.fdopen(0, "rb", closefd=False), request["path"], **request["options"]
        )
        head = {"found": _plain(found, arrays)}
    except LimitError as error:
        head, arrays = {"memory": str(error)}, []
    except MemoryError:
        head, arrays = {"memory": "its parser needs more memory"}, []
    except Exception as error:  # libraries raise any error for a broken file
        text = " ".join(str(error).split())[:300] or type(error).__name__
        short = "alloc" in text.lower() or "memory" in text.lower()
        head, arrays = {"error": text, "own": type(error) is ValueError}, []
        if short:
            head = {"memory": "its parser needs more memory"}
    try:
        _answer(answers, head, arrays)
    except MemoryError:
        os._exit(3)
    # Closing what a broken file has opened could hang.
    os._exit(0)


if __name__ == "__main__":
    main()
