"""Records: results of commands, committed as small files, from which pages are rendered.

A record is JSON: the command that made it, the day, the versions of the libraries, a note, and the data. There are
three kinds of data: ``benchmark/ENVIRONMENT`` contains the shown results of ``filtergym benchmark --full``,
``seeds/ENVIRONMENT`` those of ``python docs/make seeds``, and every other record is a table of text.
"""

import datetime
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from filtergym.baselines.problem import Problem, problem_of
from filtergym.envs.engine.catalogue import bare_name, catalogue, nearest
from filtergym.evaluation.running.metrics import Record
from filtergym.evaluation.storage.files import write_text
from filtergym.evaluation.storage.stored import read_json
from filtergym.reports.tables.terminal_tables import main_components

FOLDER = Path(__file__).parent.parent / "records"
BENCHMARK, SEEDS = "benchmark", "seeds"
"""Folders of the records of an environment."""
METRICS = (
    *(
        "cost",
        "geometric_cost",
        "geometric_cost_difference",
        "lost_tracks",
        "best_share",
        "median_anees",
        "relative_cost_difference",
        "behind_best",
        "score",
        "nanoseconds",
    ),
    "lost_episodes",
)
"""Metrics of a benchmark that pages show, beside the ANEES of the whole state and the errors of the main components."""
DIGITS = 6
"""Stored significant digits; pages show three."""


class ResultRecord(NamedTuple):
    """Content of a record's file: its data, and how they were made."""

    command: str
    """Command that makes the data again."""
    made: str
    """Day, ISO 8601."""
    versions: dict[str, str]
    """Versions of Python and the libraries."""
    note: str
    """Note on the use of the data; empty: none."""
    data: dict[str, Any]

    @property
    def origin(self) -> str:
        """Sentences on the origin of the data, in Markdown, for the place below a table."""
        note = f" **{self.note}**" if self.note else ""
        return f"Made by `{self.command}` on {self.made}.{note}"


class BenchmarkRecords(NamedTuple):
    """Results of a benchmark in one environment: the problem and tidy records."""

    problem: Problem
    records: list[Record]

    @property
    def paper(self) -> str:
        """Name of the paper's algorithm, with which costs are compared."""
        return self.problem.paper_among(dict.fromkeys(record.policy for record in self.records))


def environment_id(name: str) -> str:
    """Return the Gymnasium id of an environment with a short name, such as ``ManeuveringTarget``."""
    known = {bare_name(id): id for id in catalogue()}
    if name not in known:
        raise nearest("environment", name, known)
    return known[name]


def record_file(name: str, folder: Path = FOLDER) -> Path:
    """Return the path of a record's file.

    Raises:
        ValueError: if there is no such name of a record, such as ``benchmark/ManeuveringTarget`` or ``plain_ppo``.
    """
    if not re.fullmatch(r"(\w+/)?\w+", name):
        raise ValueError(f"no name of a record: {name!r}; it has letters, digits, _ and at most one /")
    return folder / f"{name}.json"


def write_record(name: str, record: ResultRecord, folder: Path = FOLDER) -> Path:
    """Write a record as JSON, a line for each entry, and return the path of its file."""
    path = record_file(name, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, _lines(record._asdict()) + "\n")
    return path


def read_record(name: str, folder: Path = FOLDER) -> ResultRecord:
    """Return a record, read from its file."""
    path = record_file(name, folder)
    if not path.is_file():
        raise ValueError(f"no record {name!r}: {path} does not exist")
    values = read_json(path)
    if not isinstance(values, dict) or set(values) != set(ResultRecord._fields):
        raise ValueError(f"{path} is no record: it has not the entries {', '.join(ResultRecord._fields)}")
    return ResultRecord(**values)


def strip_folders(command: str) -> str:
    """Return a command without folders and number of processes, which do not affect its results."""
    return re.sub(r" --(out|jobs|threads|cluster)[ =]\S+", "", command)


def today() -> str:
    """Return today's date, UTC, as ISO 8601 text."""
    return datetime.datetime.now(tz=datetime.UTC).date().isoformat()


def round_number(value: float | None) -> float | None:
    """Return a number rounded to ``DIGITS`` significant digits; None stays None."""
    return None if value is None else float(f"{value:.{DIGITS}g}")


def _lines(value: Any, depth: int = 5, indent: str = "") -> str:
    """Return a value as JSON text, a line for each entry that is flat or nested deeply."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if depth == 0 or not any(isinstance(each, (dict, list)) for each in inside):
        return json.dumps(value, ensure_ascii=False)
    inner = indent + " "
    if isinstance(value, list):
        return "[\n" + ",\n".join(inner + _lines(each, depth - 1, inner) for each in value) + f"\n{indent}]"
    entries = (f"{inner}{json.dumps(key)}: {_lines(each, depth - 1, inner)}" for key, each in value.items())
    return "{\n" + ",\n".join(entries) + f"\n{indent}}}"


# --- benchmark


def benchmark_data(problem: Problem, records: Sequence[Record]) -> dict[str, Any]:
    """Return a record's data from a benchmark of one environment: results by scenario and competitor.

    Raises:
        ValueError: if scenarios are unknown, or the records are of several experiments.
    """
    experiments = {(r.split, r.seed) for r in records}
    if len(experiments) != 1:
        raise ValueError(f"the records of {problem.id} are of several experiments: {sorted(experiments)}")
    [(split, seed)] = experiments
    components = {*main_components(records)}
    kept = [r for r in records if r.window == "all" and _is_shown(r, components, problem)]
    scenarios: dict[str, dict[str, Any]] = {}
    units = {}
    for r in kept:
        if r.scenario not in problem.task.scenarios:
            raise nearest("scenario", r.scenario, problem.task.scenarios)
        scenario = scenarios.setdefault(r.scenario, {"episodes": r.episodes, "competitors": {}})
        if scenario["episodes"] != r.episodes:
            raise ValueError(
                f"{r.policy} met {r.episodes} episodes of {r.scenario}, others {scenario['episodes']}"
            )
        own = scenario["competitors"].setdefault(
            r.policy, {"kind": r.kind, "control": r.control, "metrics": {}}
        )
        key = f"{r.metric} {r.component}".strip()
        own["metrics"][key] = [round_number(x) for x in (r.value, r.low, r.high)]
        if r.unit != "1":
            units[key] = r.unit
    return {"environment": problem.id, "split": split, "seed": seed, "units": units, "scenarios": scenarios}


def merge_competitors(
    data: Mapping[str, Any], added: Mapping[str, Any], names: Collection[str]
) -> dict[str, Any]:
    """Return a benchmark's data with the rows of competitors that were measured later, over the same episodes.

    Args:
        data: data of the whole benchmark.
        added: data of the same environment with some competitors, among them the best of each scenario.
        names: names of the added or replaced competitors; the others serve the comparison.

    Raises:
        ValueError: if the episodes differ, the cost of a competitor that is not named differs, or one that is
            named costs less than the best: then the whole scenario has to be measured again.
    """
    for key in ("environment", "split", "seed"):
        if data[key] != added[key]:
            raise ValueError(f"the record has {key} {data[key]}, what is added {added[key]}")
    scenarios = dict(data["scenarios"])
    for name, own in added["scenarios"].items():
        known = scenarios.get(name)
        if absent := sorted({*names} - own["competitors"].keys()):
            raise ValueError(f"{', '.join(absent)} took no part in {name}")
        if known is None or known["episodes"] != own["episodes"]:
            raise ValueError(f"the record has other episodes of {name}")
        for competitor in own["competitors"].keys() - {*names}:
            before = known["competitors"].get(competitor)
            if before is None or not _same_cost(before, own["competitors"][competitor]):
                raise ValueError(f"{competitor} costs something else in the record of {name}")
        if _best(known) != _best(own):
            raise ValueError(
                f"{_best(own)} costs less than {_best(known)} in {name}: measure that scenario again"
            )
        fresh = {competitor: own["competitors"][competitor] for competitor in names}
        scenarios[name] = {**known, "competitors": {**known["competitors"], **fresh}}
    return {**data, "units": {**data["units"], **added["units"]}, "scenarios": scenarios}


def _same_cost(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    return math.isclose(one["metrics"]["cost"][0], other["metrics"]["cost"][0], rel_tol=1e-5)


def _best(scenario: Mapping[str, Any]) -> str:
    """Return the name of the competitor of lowest cost, with which the others are compared."""
    [name] = {
        key.partition(" ")[2]
        for each in scenario["competitors"].values()
        for key in each["metrics"]
        if key.startswith("behind_best ")
    }
    return name


def _is_shown(record: Record, components: set[str], problem: Problem) -> bool:
    measured = (record.metric, record.component)
    if record.metric == "rmse":
        return record.component in components or measured == problem.baselines.physical
    return record.metric in METRICS or measured in (("anees", "state"), problem.baselines.physical)


def benchmark_records(data: Mapping[str, Any]) -> BenchmarkRecords:
    """Return the tidy records of one environment in a benchmark's data."""
    found = []
    for scenario, each in data["scenarios"].items():
        for name, own in each["competitors"].items():
            for key, (value, low, high) in own["metrics"].items():
                metric, _, component = key.partition(" ")
                found.append(
                    Record(
                        *(
                            data["environment"],
                            own["control"],
                            scenario,
                            name,
                            own["kind"],
                            metric,
                            component,
                            "all",
                        ),
                        *(value, low, high, data["units"].get(key, "1"), each["episodes"]),
                        *(data["seed"], data["split"]),
                    )
                )
    return BenchmarkRecords(problem_of(data["environment"]), found)


def read_benchmark(name: str, folder: Path = FOLDER) -> tuple[BenchmarkRecords, ResultRecord]:
    """Return the tidy records and the record of an environment's benchmark, by the environment's short name."""
    environment_id(name)
    record = read_record(f"{BENCHMARK}/{name}", folder)
    return benchmark_records(record.data), record


def recorded_environments(kind: str = BENCHMARK, folder: Path = FOLDER) -> list[str]:
    """Return the short names of all environments that have a record of a kind, in the catalogue's order."""
    names = map(bare_name, catalogue())
    return [name for name in names if record_file(f"{kind}/{name}", folder).is_file()]


# --- tables of text


def markdown_tables(text: str) -> list[dict[str, Any]]:
    """Return columns and rows of every Markdown table in a text."""
    blocks: list[list[list[str]]] = []
    before = ""
    for line in text.splitlines():
        if line.startswith("|"):
            if not before.startswith("|"):
                blocks.append([])
            blocks[-1].append([cell.strip() for cell in line.strip().strip("|").split("|")])
        before = line
    return [{"columns": block[0], "rows": block[2:]} for block in blocks if len(block) > 2]


def table_cell(data: Mapping[str, Any], row: str, column: str) -> str:
    """Return the text of a cell of a record's table.

    Args:
        data: data of the record.
        row: first cell of the row without marks of code, or first and second cell with a space between; an empty first
            cell equals that of the row above.
        column: title of the column, or a beginning of it that no other column has.

    Raises:
        ValueError: if there is no such cell, or several.
    """
    columns = [i for i, title in enumerate(data["columns"]) if title == column]
    columns = columns or [i for i, title in enumerate(data["columns"]) if title.startswith(column)]
    rows, first = [], ""
    for cells in data["rows"]:
        head, second, *_ = (*(cell.replace("`", "") for cell in cells), "")
        first = head or first
        if row in (first, f"{first} {second}"):
            rows.append(cells)
    if len(columns) != 1 or len(rows) != 1:
        raise ValueError(
            f"{len(rows)} rows {row!r} and {len(columns)} columns {column!r}: one of each is needed"
        )
    return str(rows[0][columns[0]])
