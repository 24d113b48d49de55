"""All available sets of real flights, raw and smoothed, as a test of competitors beyond simulated flights.

    pip install --no-deps traffic
    FILTERGYM_READ_MEMORY=1024 python benchmarks/flights.py --out docs/data/flights.csv

The sets are samples of ADS-B flights in the Python package ``traffic``, which is read, not imported. A sample of at
least ``FEWEST`` flights is a set of its own; the other samples of its folder are one set if they have as many together,
else part of "others". Each sample has its radar in the median of its positions, the radar's noise is simulated, and
scans are 6 s apart. Samples with positions more than ``COARSEST`` seconds apart, on the ground, or that demonstrate
errors are left out.
"""

import argparse
from pathlib import Path

import numpy
import pandas

from filtergym import tidy_records
from filtergym.baselines.problem import problem_of
from filtergym.envs.logs.flights import TRAFFIC, Flights, flight_of, read_flights, traffic_samples
from filtergym.names import find_competitors

ID = "filtergym/ManeuveringTarget-v0"
FEWEST, COARSEST, INTERVAL, SMOOTHING = 20, 10.0, 6.0, 10.0
MOST_SCANS = 90_000
"""Most scans of a set: of a larger one every second flight is used, or every third, ..."""
LEFT_OUT = ("noisy", "onground")
"""Folders of samples that are no flights in the air, or that contain deliberate errors."""
COMPETITORS = (
    "imm",
    "semi-markov",
    "semi-markov-vague",
    "semi-markov-vague-tuned",
    "kalman-imm-turn",
    "kalman-imm-turn-tuned",
    "kalman-imm-tuned",
    "imm-tuned",
    "adaptive-rearm-tuned",
    "bptt-strongest",
    "bptt-small",
    "kalman-net",
    "bptt",
    "ppo",
)
METRICS = {
    "relative_cost_difference": ("cost", 100.0),
    "median_cost_ratio": ("median", 100.0),
    "win_rate": ("wins", 100.0),
    "anees": ("anees", 1.0),
}
"""Metrics in the table, with their columns and units."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="table of all figures, CSV")
    parser.add_argument("--policy", action="append", help="default: the strongest of every kind")
    asked = parser.parse_args()
    problem = problem_of(ID)
    found = find_competitors(problem, asked.policy or COMPETITORS)
    competitors = {one.name: one.maker for one in found}
    rows = []
    for smoothing in (SMOOTHING, 0.0):
        for name, flights in flight_sets(smoothing).items():
            pieces, _ = flights.flyable(INTERVAL, numpy.inf)
            data = problem.evaluate(
                competitors, flights, episodes=len(pieces), seed=1, sampling_interval=INTERVAL
            )
            own = {
                "set": name,
                "smoothing": smoothing,
                "flights": len({flight_of(piece) for piece in pieces}),
                "pieces": len(pieces),
                "hours": round(sum(piece.time[-1] - piece.time[0] for piece in pieces) / 3600.0, 1),
            }
            rows += _rows(own, tidy_records(data))
            print(f"{name}, smoothed over {smoothing:g} s: {own['flights']} flights", flush=True)
    table = pandas.DataFrame(rows)
    if asked.out:
        table.to_csv(asked.out, index=False, lineterminator="\n", float_format="%.4g")
    print_tables(table)


def flight_sets(smoothing: float) -> dict[str, Flights]:
    """Return the sets of flights of the package ``traffic`` by name, the largest first."""
    own: dict[str, list] = {}
    rest: dict[str, list] = {}
    for name, file in traffic_samples().items():
        folder = file.parent.name
        if folder in LEFT_OUT:
            continue
        try:
            found = read_flights(TRAFFIC + name, smoothing=smoothing).trajectories
        except ValueError as error:
            print(f"left out: {error}", flush=True)
            continue
        if numpy.median(numpy.concatenate([numpy.diff(piece.time) for piece in found])) > COARSEST:
            continue
        if len({flight_of(piece) for piece in found}) < FEWEST:
            rest.setdefault(folder, []).extend(found)
        else:
            own[name] = found
    for folder, pieces in rest.items():
        enough = len({*map(flight_of, pieces)}) >= FEWEST
        own.setdefault(folder if enough else "others", []).extend(pieces)
    ordered = sorted(own, key=lambda name: -len(own[name]))
    return {name: Flights(tuple(_thin_pieces(own[name])), name) for name in ordered}


def _thin_pieces(pieces: list) -> list:
    """Return the pieces of a set of flights, or every second, third, ... if too long for one scenario."""
    scans = sum(piece.intervals(INTERVAL) for piece in pieces)
    return pieces[:: 1 + int(scans // MOST_SCANS)]


def _rows(own: dict, records: list) -> list[dict]:
    found: dict[str, dict] = {}
    for record in records:
        if record.metric in METRICS and record.window == "all" and record.component in ("", "state"):
            column, unit = METRICS[record.metric]
            row = found.setdefault(record.policy, {**own, "policy": record.policy})
            row[column] = unit * record.value
            if column == "cost":
                row["low"], row["high"] = unit * record.low, unit * record.high
    return list(found.values())


def print_tables(table: pandas.DataFrame) -> None:
    """Print a table for each smoothing: cost of every competitor against the paper's, interval and median, %."""
    for smoothing, part in table.groupby("smoothing", sort=False):
        print(f"\nSmoothed over {smoothing:g} s:\n" if smoothing else "\nAs recorded:\n")
        cells = zip(part.cost, part.low, part.high, part["median"], strict=True)
        text = part.assign(
            cell=[
                f"{cost:+.1f} [{low:.1f}, {high:.1f}], {median - 100:+.0f}"
                for cost, low, high, median in cells
            ],
            heading=part["set"] + ", " + part.flights.astype(str) + " flights",
        )
        wide = text.pivot(index="policy", columns="heading", values="cell")
        order = part.groupby("policy").cost.mean().sort_values().index
        wide = wide.loc[order, list(dict.fromkeys(text.heading))]
        print(" | ".join(["| competitor", *wide.columns]) + " |\n|---" + "|---:" * wide.shape[1] + "|")
        for name, cells in wide.iterrows():
            print(" | ".join([f"| `{name}`", *cells]) + " |")


if __name__ == "__main__":
    main()
