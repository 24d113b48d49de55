"""Commands that make this project's own pages: ``python docs/make COMMAND``."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import board as leaderboard
import comparison
import training_seeds
import typer
from command_line import MARKER as COMMANDS_MARKER
from command_line import command_line_markdown
from environment_page import environment_tables, put_tables
from filtergym.agents.export import export_run
from filtergym.baselines.problem import problem_of
from filtergym.envs.catalogue import catalogue
from filtergym.envs.scenario_choice import find_scenario
from filtergym.evaluation.files import whole_files, writable_file
from filtergym.evaluation.parallel import Workers
from filtergym.evaluation.print_layout import check_columns, check_formats, save
from filtergym.evaluation.store import UNFINISHED, Store
from front import draw_fronts, fronts_in_words, panels_of
from pages import check_markers, insert_between_markers, markers_of
from room import MARKER, room_markdown, room_records

from filtergym.__main__ import main as run
from filtergym.__main__ import program_of
from filtergym.commands.shown import print_results
from filtergym.commands.terminal import (
    Cluster,
    Columns,
    Environment,
    Episodes,
    Experiment,
    Formats,
    Jobs,
    Split,
    Trust,
    complete_policy,
    complete_scenario,
    console,
    progress_bar,
)
from filtergym.reports.records import read_records, write_records

PROGRAM = "python docs/make"


def comparison_page(
    records: Annotated[list[Path], typer.Argument(help="results.json of full benchmarks.")],
    into: Annotated[
        Path | None,
        typer.Option(help="Page that takes the tables; pictures go to the folder images/ beside it."),
    ] = None,
    format: Formats = None,
    columns: Columns = 2,
) -> None:
    """Compare papers, tuned policies, learned agents and references, from the records of a benchmark.

    Example: python docs/make comparison results/results.json --into docs/comparison.md
    """
    formats = check_formats(format or ["png"])
    check_columns(columns)
    found = comparison.read_benchmark(records)
    names = [own.problem.short_name for own in found]
    markers = [f"comparison {name}" for name in names]
    overview = "comparison of all"
    if into is not None:
        check_markers(into, markers)
    compared = [comparison.compare_environment(own, columns) for own in found]
    if into is not None:
        texts = {}
        with whole_files(into.parent / "images") as images:
            for own, tables, name, marker in zip(found, compared, names, markers, strict=True):
                for suffix in formats:
                    save(tables.figure, images / f"comparison_{name}.{suffix}")
                picture, first = f"images/comparison_{name}.{formats[0]}", own.records[0]
                command = f"filtergym benchmark --full --seed {first.seed} --split {first.split}"
                texts[marker] = comparison.comparison_markdown(tables, own, picture, command)
        on_page = set(markers_of(into))
        # Tables over all environments only from records of all that the page shows.
        if overview in on_page and on_page <= {overview, *texts}:
            texts[overview] = comparison.overview_markdown(found)
        insert_between_markers(into, texts)
    for each in compared:
        for grid in each.grids:
            console.print(grid)
    for grid in (comparison.summary(found), comparison.harm(found)):
        console.print(grid)


def room(
    environment: Environment,
    records: Annotated[list[Path], typer.Argument(help="results.json of full benchmarks.")],
    into: Annotated[Path | None, typer.Option(help="Page whose room table is replaced.")] = None,
) -> None:
    """Show how much is left to win: best constant action, paper, tuned policies, references, bounds.

    Example: python docs/make room filtergym/ManeuveringTarget-v0 results/results.json
    """
    problem = problem_of(environment)
    paper = problem.paper  # there is no room without it
    if into is not None:
        check_markers(into, [MARKER])
    found = room_records(comparison.read_benchmark(records), problem)
    if into is not None:
        first = found[0]
        command = f"filtergym benchmark --full --seed {first.seed} --split {first.split}"
        insert_between_markers(into, {MARKER: room_markdown(found, paper, command)})
    print_results(found, problem.knows)


def front(
    records: Annotated[list[Path], typer.Argument(help="results.json of full benchmarks.")],
    into: Annotated[Path, typer.Option(help="PNG, SVG or PDF file for the picture.")] = Path(
        "docs/images/front.png"
    ),
    columns: Columns = 2,
) -> None:
    """Draw cost against time, and the front of both, of all competitors in each training distribution.

    Example: python docs/make front results/results.json
    """
    check_columns(columns)
    check_formats([into.suffix.removeprefix(".").lower()])
    panels = panels_of([problem_of(id) for id in catalogue()], read_records(records))
    if not panels:
        raise ValueError("the records hold no times: make them by filtergym benchmark")
    save(draw_fronts(panels, columns=columns), into)
    for title, names in fronts_in_words(panels).items():
        console.print(f"{title}: {names}", highlight=False)


def page(
    environment: Environment,
    into: Annotated[Path | None, typer.Option(help="Page whose tables are replaced.")] = None,
) -> None:
    """Make the tables of an environment's page from its code: actions, fields, parameters, scenarios, policies.

    A field is named for its block, and where that has several rows for each of its parts.

    Example: python docs/make page filtergym/ManeuveringTarget-v0
    """
    problem = problem_of(environment)
    if into is not None:
        console.print(f"{into}: {', '.join(put_tables(problem, into))}")
        return
    for name, table in environment_tables(problem).items():
        console.print(f"{name}\n\n{table}\n", soft_wrap=True)


def seeds(
    runs: Annotated[list[Path], typer.Argument(help="Folders of training runs, of one environment.")],
    scenario: Annotated[
        list[str] | None,
        typer.Option(
            help="Scenario; repeatable. Default: the training distribution.", autocompletion=complete_scenario
        ),
    ] = None,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="Opponent; repeatable. Default: tunable policies, tuned ones and references.",
            autocompletion=complete_policy,
        ),
    ] = None,
    episodes: Episodes = 2000,
    seed: Experiment = 0,
    split: Split = "test",
    out: Annotated[Path | None, typer.Option(help="File for tidy records.")] = None,
    into: Annotated[Path | None, typer.Option(help="Page whose seeds table is replaced.")] = None,
    curves: Annotated[Path | None, typer.Option(help="PNG, SVG or PDF file for the learning curves.")] = None,
    columns: Columns = 2,
    trust: Trust = False,
    jobs: Jobs = 1,
    cluster: Cluster = None,
) -> None:
    """Score training seeds: every run's best agent, the spread between seeds, the median against opponents.

    A run's best agent is plain arrays; where it is a model only, loading can execute code and needs --trust. With --out
    what is scored is kept beside it until all is done: after an interruption the same command goes on.

    Example: python docs/make seeds runs/ppo-0 runs/ppo-1 runs/ppo-2 --split validation
    """
    check_columns(columns)
    if curves is not None:
        check_formats([curves.suffix.removeprefix(".").lower()])
    found = training_seeds.load_runs(runs, trust)
    problem = found[0].run.problem
    names: list[str | None] = [*scenario] if scenario else [None]
    scenarios = [find_scenario(problem.task, name).name for name in names]
    opponents = policy or training_seeds.default_opponents(problem)
    marker = f"seeds {problem.short_name}"
    for file in (out, curves):
        if file is not None:
            writable_file(file)
    store = Store(None if out is None else out.with_name(UNFINISHED))
    if into is not None:
        check_markers(into, [marker])
    if curves is not None:
        save(training_seeds.learning_curves(found, columns), curves)
    with Workers(jobs, cluster) as workers, progress_bar() as bar:
        line = bar.add_task("evaluating", total=None)
        study = training_seeds.Study(found, opponents, episodes, seed, split, trust)
        records, grids = training_seeds.compare_scenarios(
            study, scenarios, lambda done: bar.update(line, advance=done), store, workers
        )
    if out is not None:
        write_records(out, records)
    if into is not None:
        command = f"{PROGRAM} seeds RUN ... {' '.join(f'--scenario {name}' for name in scenarios)} "
        command += "".join(f"--policy {name} " for name in policy or ())
        command += f"--episodes {episodes} --split {split} --seed {seed}"
        insert_between_markers(into, {marker: training_seeds.grids_as_markdown(grids, found, command)})
    store.clear()
    for grid in grids:
        console.print(grid)


def _algorithm(seed: training_seeds.SeedRun) -> str:
    return seed.run.algorithm


def ship(
    runs: Annotated[list[Path], typer.Argument(help="Folders of training runs, of one environment.")],
    into: Annotated[Path, typer.Option(help="Folder of what is shipped.")] = Path("agents/pretrained"),
    trust: Trust = False,
) -> None:
    """Export of every algorithm the run with the lowest validation cost, over what was shipped of it.

    Example: python docs/make ship runs/ManeuveringTarget/*-?
    """
    found = training_seeds.load_runs(runs, trust)
    for algorithm, own in itertools.groupby(sorted(found, key=_algorithm), _algorithm):
        best = min(own, key=lambda seed: seed.run.best["cost"] if seed.run.best else math.inf)
        file = into / best.run.problem.short_name / f"{algorithm}.safetensors"
        file.parent.mkdir(parents=True, exist_ok=True)
        export_run(best.folder, file, trust)
        console.print(f"{file}: {best.name}, of the lowest validation cost")


def board(
    folder: Annotated[Path, typer.Argument(help="Folder of submissions and their verifications.")] = Path(
        "leaderboard"
    ),
    into: Annotated[Path, typer.Option(help="Page whose tables are replaced.")] = Path("docs/leaderboard.md"),
) -> None:
    """Make the page of the board from verified submissions.

    Example: python docs/make board leaderboard
    """
    entries = leaderboard.read_entries(folder)
    insert_between_markers(into, {leaderboard.MARKER: leaderboard.board_markdown(entries)})
    console.print(f"{into}: {len(entries)} submissions")


def command_line(
    into: Annotated[Path, typer.Argument(help="Page whose sections are replaced.")],
) -> None:
    """Make the sections of the page of the command line from the commands themselves.

    Example: python docs/make command-line docs/command_line.md
    """
    insert_between_markers(into, {COMMANDS_MARKER: command_line_markdown()})


COMMANDS: dict[str, Callable[..., None]] = {
    "page": page,
    "room": room,
    "front": front,
    "comparison": comparison_page,
    "seeds": seeds,
    "ship": ship,
    "board": board,
    "command-line": command_line,
}


def main() -> None:
    """Run one of them; mistakes end as those of ``filtergym`` do."""
    run(lambda: program_of({"Commands": COMMANDS}), PROGRAM)
