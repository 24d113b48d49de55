"""``filtergym evaluate --protocol``: run a frozen protocol, and print the row to quote."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.table import Table

from .. import __version__
from ..evaluation.running.parallel import Workers
from ..evaluation.running.times import time_text
from ..evaluation.storage.files import writable_file
from ..protocol import (
    EnvironmentResult,
    ProtocolResult,
    bib_entry,
    find_entries,
    measurements_of,
    read_protocol,
    run_protocol,
)
from ..reports.tables.export import write_records
from ..reports.tables.terminal_tables import consistency, plain_table, with_interval
from .terminal import console, print_table, progress_bar

OPTIONS = {
    *("protocol", "policy", "json", "trust", "isolated", "time_limit", "memory_limit"),
    *("backend", "threads", "jobs", "cluster"),
}
"""Parameters of ``evaluate`` that a protocol leaves open."""


def check_options(ctx: typer.Context) -> None:
    """Raise ValueError for an option of the command line that the protocol itself fixes."""
    for parameter in ctx.command.params:
        source = ctx.get_parameter_source(str(parameter.name))
        if parameter.name not in OPTIONS and source is not None and source.name == "COMMANDLINE":
            given = parameter.opts[0] if parameter.opts[0].startswith("-") else "the environment"
            raise ValueError(f"a protocol fixes the experiment: leave out {given}")


def evaluate_protocol(
    name: str,
    policies: Sequence[str],
    workers: Workers,
    json: Path | None = None,
    trust: bool = False,
    rename: Callable[[Any, Sequence[str]], list[str]] | None = None,
    **options: Any,
) -> None:
    """Run a protocol and print its table, the row to quote and a BibTeX entry.

    ``policies`` are words, and ``rename`` a function, of :func:`..protocol.find_entries`; ``json`` is a file
    for the records; options are those of :func:`..protocol.run_protocol`.
    """
    if json is not None:
        writable_file(json)
    protocol, digest = read_protocol(name)
    entries = find_entries(protocol, policies, trust, rename)
    with progress_bar() as bar:
        line = bar.add_task("evaluating", total=measurements_of(protocol, entries))
        found = run_protocol(
            protocol, digest, entries, workers, lambda done: bar.update(line, advance=done), **options
        )
    if json is not None:
        write_records(json, found.records)
    print_table(_table(found))
    console.print()
    console.print("\n".join(quoted_row(found)), soft_wrap=True)
    console.print()
    console.print(bib_entry(found, __version__), soft_wrap=True)


def quoted_row(result: ProtocolResult) -> list[str]:
    """Return a Markdown table with one row, line by line: the protocol's result to quote."""
    cells = {
        result.protocol.name: result.title,
        "cost against the papers, %": _percent(result.cost),
        "lost tracks, %": "-" if result.lost is None else f"{100.0 * result.lost:.2g}",
        "environments": f"{len(result.environments)} of {len(result.protocol.environments)}",
        "protocol SHA-256": result.digest[:12],
        "filtergym": __version__,
        "ns here": time_text(result.time),
    }
    return [f"| {' | '.join(words)} |" for words in (cells, ["---"] * len(cells), cells.values())]


def _percent(estimate: Any) -> str:
    return with_interval(estimate, 100.0, negligible=0.005)


def _table(found: ProtocolResult) -> Table:
    table = plain_table(
        f"{found.protocol.name}: {found.title} ({found.protocol.episodes} episodes each, {found.protocol.split} split, "
        f"seed {found.protocol.seed}; 95 % intervals)"
    )
    several = len({one.entry.name for one in found.environments}) > 1
    table.add_column("environment", no_wrap=True)
    if several:
        table.add_column("competitor", overflow="fold")
    for title in ("cost, %", "lost\n%", "ANEES", "worst held-out, %", "ns (paper's)"):
        table.add_column(title, justify="right")
    for one in found.environments:
        table.add_row(
            f"{one.entry.environment.short}\nvs {one.entry.environment.paper}",
            *([one.entry.name] if several else []),
            *_environment_cells(one),
        )
    table.caption = (
        "Cost is the geometric mean of the ratios of the episodes' costs to those of the paper's algorithm, which "
        "stands below the environment, less one. "
        "A track is lost where an episode's mean cost is beyond the bound of the environment. ANEES is 1 if errors are "
        "as large as the covariance states; ! marks a factor above two or below a half. Of the scenarios that "
        "are held out from training the worst is named. ns is the competitor's processor time of a measurement on one "
        "core of this machine."
    )
    if not found.is_complete:
        table.caption += "\nNot all environments were entered: there is no number over all."
    return table


def _environment_cells(one: EnvironmentResult) -> list[str]:
    worst = "-" if one.worst is None else f"{100.0 * one.worst[1]:+,.1f}\n{one.worst[0]}"
    return [
        _percent(one.cost),
        with_interval(one.lost, 100.0, digits=2, negligible=0.005).partition(" ")[0],
        consistency(one.anees),
        worst,
        f"{time_text(one.time)} ({time_text(one.paper_time)})",
    ]
