"""Commands that submit a competitor with its results, and verify the submissions of others."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from .. import __version__
from ..baselines.problem import problem_of
from ..evaluation.running.parallel import Workers
from ..evaluation.storage.files import writable_file, write_text
from ..protocol import Entry, Protocol, measurements_of
from ..reports.tables.terminal_tables import HEADLINE, cost_title, plain_table
from ..submission import (
    FROZEN,
    OWN,
    TIME,
    TOLERANCE,
    TRIAL,
    Card,
    Figure,
    Source,
    make_submission,
    protocol_of,
    read_submission,
    verify,
    write_submission,
)
from .terminal import (
    Environment,
    Jobs,
    Trust,
    complete_from,
    complete_policy,
    console,
    print_table,
    progress_bar,
)


def submit(
    environment: Environment,
    name: Annotated[
        str,
        typer.Argument(
            help="A shipped agent or classical competitor, a .safetensors, the folder of a training run, or "
            "module:Class of an estimator in one file.",
            autocompletion=complete_policy,
        ),
    ],
    out: Annotated[Path, typer.Option(help="File of the submission, .json.")],
    protocol: Annotated[
        str,
        typer.Option(
            help="filtergym-1: its 2,000 episodes of the training distribution and 500 of every other scenario; trial: "
            "32 of the training distribution.",
            autocompletion=complete_from(FROZEN, TRIAL),
        ),
    ] = FROZEN,
    title: Annotated[str | None, typer.Option(help="Title of the competitor; default: the name.")] = None,
    author: Annotated[str, typer.Option(help="Who hands it in.")] = "-",
    jobs: Jobs = 1,
) -> None:
    """Run a protocol, and write competitor, card and results into one file.

    An agent is written as its arrays, which execute nothing; an estimator as the text of its module.

    Example: filtergym submit filtergym/ManeuveringTarget-v0 bptt --protocol trial --out bptt.json
    """
    problem = problem_of(environment)
    writable_file(out)
    episodes, _ = protocol_of(problem, protocol)
    total = measurements_of(episodes, [Entry(episodes.environments[0], OWN, None)])
    card = Card(title or Path(name).stem.rpartition(":")[2], author)
    with Workers(jobs) as workers, progress_bar() as bar:
        line = bar.add_task("evaluating", total=total)
        made = make_submission(
            problem, name, protocol, card, workers, lambda done: bar.update(line, advance=done)
        )
    digest = write_submission(out, made)
    print_table(_results_table(made.card.title, episodes, {"": made.results}))
    console.print(f"saved in {out}, SHA-256 {digest}", soft_wrap=True)


def verify_file(
    file: Annotated[Path, typer.Argument(help="A submission.")],
    source: Annotated[
        Path | None,
        typer.Option(help="Write the source code of the submission, to read it, and run nothing."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            help="Seed of the fresh episodes, to repeat a verification that printed it; default: 128 random bits."
        ),
    ] = None,
    same_seeds: Annotated[
        bool,
        typer.Option(
            "--same-seeds",
            help="Run only the protocol's own episodes, whose seeds are public: a competitor that carries their truth "
            "passes.",
        ),
    ] = False,
    trust: Trust = False,
    jobs: Jobs = 1,
) -> None:
    """Run a submission again on its own and on fresh episodes, and decide whether its numbers hold.

    On the same episodes costs repeat up to rounding on any processor; on fresh ones their intervals must agree. Times
    are not compared. A submission that contains source code needs --trust.

    Example: filtergym verify bptt.json
    """
    if source is not None:
        held = read_submission(file)[0].competitor
        if not isinstance(held, Source):
            raise ValueError(f"{file} contains no source code")
        write_text(source, held.text)
        console.print(f"source code in {source}, its class {held.name}", soft_wrap=True)
        return
    with Workers(jobs) as workers, progress_bar() as bar:
        line = bar.add_task("evaluating", total=None)
        found = verify(file, trust, workers, lambda done: bar.update(line, advance=done), seed, same_seeds)
    own = found.submission
    columns = {"submitted": own.results}
    if not found.deviation.holds:
        columns["here"] = found.again
    if found.fresh is not None:
        columns["fresh"] = found.fresh.figures
    episodes, _ = protocol_of(problem_of(own.environment), own.protocol)
    print_table(_results_table(f"{own.card.title}, by {own.card.author}", episodes, columns))
    console.print(f"SHA-256 {found.digest}", soft_wrap=True)
    versions = f"made by filtergym {own.filtergym}, verified by {__version__}"
    for one in found.suspicions:
        console.print(
            f"suspicious: in scenario {one.scenario!r} the cost is {-100.0 * one.difference:.3g} % below that of "
            f"{one.reference!r}, which knows {one.knows}",
            soft_wrap=True,
        )
    if found.fresh is not None:
        trusted = " --trust" if isinstance(own.competitor, Source) else ""
        console.print(
            f"to repeat it: filtergym verify {file} --seed {found.fresh.seed}{trusted}", soft_wrap=True
        )
    if not found.deviation.holds:
        raise ValueError(f"the numbers of {file} do not hold: {found.deviation.sentence} ({versions})")
    if found.fresh is not None and not found.fresh_deviation.holds:
        raise ValueError(
            f"the numbers of {file} do not hold on fresh episodes of seed {found.fresh.seed}: "
            f"{found.fresh_deviation.sentence} ({versions})"
        )
    fresh = (
        "the episodes are those of the file, so stored results would pass, too"
        if found.fresh is None
        else f"on fresh ones they differ by {found.fresh_deviation.size:.2g} of what chance explains"
    )
    console.print(
        f"the numbers hold: on the same episodes they differ by {found.deviation.size * TOLERANCE:.1e} at most, and "
        f"rounding explains {TOLERANCE:.0e}; {fresh}; {versions}",
        soft_wrap=True,
    )


def _results_table(title: str, protocol: Protocol, columns: dict[str, tuple[Figure, ...]]) -> Table:
    """Return a table of several runs: cost against the paper's algorithm and ANEES in every scenario."""
    [own] = protocol.environments
    held_out = f" and {protocol.held_out_episodes:,} of every other scenario" if own.held_out else ""
    table = plain_table(
        f"{title}: {own.short}, {protocol.name}, {protocol.episodes:,} episodes of {own.training}{held_out}"
    )
    table.caption = _time_line(columns)
    table.add_column("scenario")
    for name in columns:
        table.add_column(f"{name} {cost_title(own.paper)}".strip(), justify="right")
        table.add_column("ANEES", justify="right")
    rows = {name: {(f.scenario, f.metric): f for f in figures} for name, figures in columns.items()}
    for scenario in dict.fromkeys(f.scenario for figures in columns.values() for f in figures):
        cells = []
        for known in rows.values():
            cells.append(_percent(known.get((scenario, HEADLINE))))
            anees = known.get((scenario, "anees"))
            cells.append("-" if anees is None or anees.value is None else f"{anees.value:.3g}")
        table.add_row(scenario, *cells)
    return table


def _percent(figure: Figure | None) -> str:
    if figure is None or figure.value is None:
        return "-"
    interval = (
        ""
        if figure.low is None or figure.high is None
        else f" [{100 * figure.low:+.1f}, {100 * figure.high:+.1f}]"
    )
    return f"{100 * figure.value:+.1f}{interval}"


def _time_line(columns: dict[str, tuple[Figure, ...]]) -> str:
    """Return the processor time of a measurement in each run as one line of text."""
    times = {
        name: f.value for name, figures in columns.items() for f in figures if f.metric == TIME and f.value
    }
    return "nanoseconds a measurement: " + ", ".join(
        f"{time:,.0f} {name}".strip() for name, time in times.items()
    )
