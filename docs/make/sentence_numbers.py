"""Numbers in sentences: each is named by a path into a record, and rendered from it.

``ManeuveringTarget/random/bptt/difference`` is of a benchmark: environment, scenario, competitor, quantity.
``seeds/ManeuveringTarget/random/bptt/mean`` is of training seeds: the cost against the paper's algorithm of an
algorithm ("mean", "median", "between seeds", "over episodes"), or of one run or opponent. Every other path is record,
row and column of a table of text, see :func:`.records.table_cell`.
"""

from pathlib import Path
from typing import Any, NamedTuple

from records import BENCHMARK, FOLDER, SEEDS, read_record, table_cell

from filtergym.envs.engine.catalogue import bare_name, catalogue
from filtergym.evaluation.running.times import ProcessorTime, time_text
from filtergym.reports.tables.terminal_tables import with_interval


class Number(NamedTuple):
    """A number of a record, with its interval and unit."""

    value: float | None
    low: float | None
    high: float | None


QUANTITIES = {
    "difference": ("geometric_cost_difference", 100.0, "%"),
    "means": ("relative_cost_difference", 100.0, "%"),
    "lost": ("lost_tracks", 100.0, "%"),
    "behind": ("behind_best", 100.0, "%"),
    "cost": ("cost", 1.0, ""),
    "anees": ("anees state", 1.0, ""),
    "score": ("score", 1.0, ""),
}
"""Key in the record, scale and unit of each quantity, by its word in a path."""


def record_of(path: str) -> str:
    """Return the name of the record that contains the number of a path."""
    first, _, rest = path.partition("/")
    if first == SEEDS:
        return f"{SEEDS}/{rest.partition('/')[0]}"
    return f"{BENCHMARK}/{first}" if first in map(bare_name, catalogue()) else first


def number_text(path: str, interval: bool = True, folder: Path = FOLDER) -> str:
    """Return the number of a path as text for a sentence: ``-43.6 % [-45.0, -42.1]``.

    Raises:
        ValueError: if the path leads nowhere.
    """
    name = record_of(path)
    data = read_record(name, folder).data
    if name.startswith(f"{SEEDS}/"):
        return _with_unit(_of_seeds(data, path), 100.0, "%", interval)
    if name.startswith(f"{BENCHMARK}/"):
        return _of_benchmark(data, path, interval)
    row, _, column = path.removeprefix(f"{name}/").partition("/")
    return table_cell(data, row, column)


def _of_benchmark(data: Any, path: str, interval: bool) -> str:
    _, scenario, competitor, quantity = [*path.split("/", 3), *("",) * 4][:4]
    try:
        metrics = data["scenarios"][scenario]["competitors"][competitor]["metrics"]
        if quantity == "ns":
            [(value, compiled)] = [
                (m[0], k.endswith("compiled")) for k, m in metrics.items() if k.startswith("nanos")
            ]
            return f"{time_text(ProcessorTime(value, True))} ns" + ("" if compiled else ", in Python")
        key, scale, unit = QUANTITIES.get(quantity, (quantity, 1.0, data["units"].get(quantity, "")))
        # The difference to the best one names it.
        [found] = [values for own, values in metrics.items() if own == key or own.startswith(f"{key} ")]
        return _with_unit(Number(*found), scale, unit, interval)
    except (KeyError, ValueError):
        raise ValueError(
            f"{path!r} leads nowhere: a path is ENVIRONMENT/SCENARIO/COMPETITOR/QUANTITY, with a quantity of "
            f"{', '.join(QUANTITIES)}, ns, rmse COMPONENT"
        ) from None


def _of_seeds(data: Any, path: str) -> Number:
    _, _, scenario, name, statistic = [*path.split("/", 4), *("",) * 5][:5]
    against = data["paper"]
    wanted = (statistic,) if statistic else ("run", "opponent")
    for own, kind, other, metric, component, *values in data["scenarios"].get(scenario, ()):
        if (own, other, metric, component) == (
            name,
            against,
            "relative_cost_difference",
            "",
        ) and kind in wanted:
            return Number(*values)
    raise ValueError(
        f"{path!r} leads nowhere: a path is seeds/ENVIRONMENT/SCENARIO/NAME or .../ALGORITHM/STATISTIC"
    )


def _with_unit(number: Number, scale: float, unit: str, interval: bool) -> str:
    value, space, rest = with_interval(number, scale).partition(" ")
    return value + (f" {unit}" if unit else "") + (space + rest if interval else "")
