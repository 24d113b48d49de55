"""Commands that make the sources of this project's pages: ``python docs/make COMMAND``."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import training_seeds
import typer
from front import draw_fronts, panels_of
from notebooks import notebook_files, write_executed
from playground import FILTERS, compile_filter, has_compiler, module_file
from readme import insert_numbers, insert_outputs
from records import (
    BENCHMARK,
    FOLDER,
    SEEDS,
    ResultRecord,
    benchmark_data,
    markdown_tables,
    merge_competitors,
    read_benchmark,
    read_record,
    recorded_environments,
    strip_folders,
    today,
    write_record,
)

from filtergym.__main__ import main as run
from filtergym.__main__ import program_of
from filtergym.agents.export import export_run
from filtergym.baselines.problem import problem_of
from filtergym.commands.terminal import (
    Cluster,
    Columns,
    Episodes,
    Experiment,
    Jobs,
    Split,
    Trust,
    complete_policy,
    complete_scenario,
    console,
    progress_bar,
)
from filtergym.envs.engine.catalogue import bare_name
from filtergym.envs.engine.scenario_choice import find_scenario
from filtergym.evaluation.figures.print_layout import check_columns, check_formats, save
from filtergym.evaluation.running.metrics import Record
from filtergym.evaluation.running.parallel import Workers
from filtergym.evaluation.storage.files import writable_file, write_text
from filtergym.evaluation.storage.store import UNFINISHED, Store
from filtergym.reports.tables.export import write_records
from filtergym.reports.tables.results import read_results, settings_of

PROGRAM = "python docs/make"


Note = Annotated[str, typer.Option(help="Note on the use of the numbers.")]
Folder = Annotated[Path, typer.Option("--into", help="Folder of the records.")]


def record(
    results: Annotated[list[Path], typer.Argument(help="results.json of full benchmarks.")],
    note: Note = "",
    add: Annotated[
        list[str] | None,
        typer.Option(
            help="Competitor that is put into the record that there is, from evaluations over the same episodes; "
            "repeatable."
        ),
    ] = None,
    into: Folder = FOLDER,
) -> None:
    """Make a record of every environment of a full benchmark, with the results that pages show.

    With --add results.json are of ``filtergym evaluate --out``, with the scenario's best competitor among its policies.

    Example: python docs/make record results/results.json
    """
    for path in results:
        own, settings = read_results(path)
        found: dict[str, list[Record]] = {}
        for result in own:
            found.setdefault(result.environment, []).extend(result.records)
        for id, records in found.items():
            data = benchmark_data(problem_of(id), records)
            made = ResultRecord(strip_folders(settings.command), today(), settings.versions, note, data)
            name = f"{BENCHMARK}/{bare_name(id)}"
            if add:
                whole = read_record(name, into)
                made = whole._replace(note=note or whole.note, data=merge_competitors(whole.data, data, add))
            console.print(
                f"{write_record(name, made, into)}: {len(data['scenarios'])} scenarios", soft_wrap=True
            )


def table(
    text: Annotated[Path, typer.Argument(help="File with tables in Markdown, which a command has printed.")],
    name: Annotated[list[str], typer.Option(help="Of the record of each table, in their order; repeatable.")],
    command: Annotated[str, typer.Option(help="That printed them.")],
    note: Note = "",
    into: Folder = FOLDER,
) -> None:
    """Make a record of every table that a command has printed in Markdown.

    Example: python docs/make table build/plain.txt --name plain_ppo --command "python benchmarks/plain_ppo.py"
    """
    tables = markdown_tables(text.read_text(encoding="utf-8")) if text.is_file() else []
    if len(tables) != len(name):
        raise ValueError(
            f"{text} holds {len(tables)} tables, and there are {len(name)} names: give --name for each"
        )
    for own, data in zip(name, tables, strict=True):
        made = ResultRecord(command, today(), settings_of(command).versions, note, data)
        console.print(f"{write_record(own, made, into)}: {len(data['rows'])} rows", soft_wrap=True)


def readme(
    page: Annotated[Path, typer.Argument(help="Page whose numbers are replaced.")] = Path("README.md"),
    picture: Annotated[
        Path, typer.Option(help="PNG, SVG or PDF file for the fronts of cost and time.")
    ] = Path("docs/images/front.png"),
    columns: Columns = 2,
    printed: Annotated[
        bool, typer.Option("--printed", help="Run the page's commands, and insert their output.")
    ] = False,
) -> None:
    """Put the numbers into README, which is not rendered, and draw its picture, both from the records.

    Example: python docs/make readme --printed
    """
    check_columns(columns)
    check_formats([picture.suffix.removeprefix(".").lower()])
    text = insert_numbers(page)
    panels = panels_of([read_benchmark(name)[0] for name in recorded_environments()])
    if not panels:
        raise ValueError("the records hold no times: make them by filtergym benchmark")
    save(draw_fronts(panels, columns=columns), picture)
    write_text(page, text)
    if printed:
        write_text(page, insert_outputs(page))


def notebooks(
    file: Annotated[
        list[Path] | None, typer.Argument(help="Notebooks. Default: all of the documentation.")
    ] = None,
) -> None:
    """Execute notebooks and write them with the output of their cells; a minute or two each.

    Example: python docs/make notebooks
    """
    for one in file or notebook_files():
        write_executed(one)
        console.print(f"executed {one}", soft_wrap=True)


OF_RECORD = ("scenario", "policy", "episodes", "seed", "split")
"""Options of :func:`seeds` that an existing record determines."""


def seeds(
    context: typer.Context,
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
    into: Annotated[
        Path | None, typer.Option(help="Folder of the records, where that of the environment is written.")
    ] = None,
    add: Annotated[
        bool,
        typer.Option(
            help="Keep the other algorithms of the existing record, with its scenarios, opponents and episodes."
        ),
    ] = False,
    note: Note = "",
    curves: Annotated[Path | None, typer.Option(help="PNG, SVG or PDF file for the learning curves.")] = None,
    columns: Columns = 2,
    trust: Trust = False,
    jobs: Jobs = 1,
    cluster: Cluster = None,
) -> None:
    """Score training seeds: every run's best agent, the spread between seeds, the median against opponents.

    A run's best agent is plain arrays; where it is a model only, loading can execute code and needs --trust. With --out
    finished scores are stored beside it: after an interruption the same command continues.

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
    name, stored = f"{SEEDS}/{bare_name(problem.id)}", None
    if add:
        sources = {option: context.get_parameter_source(option) for option in OF_RECORD}
        given = [option for option, source in sources.items() if source and source.name == "COMMANDLINE"]
        if given or into is None:
            what = f"leave out --{given[0]}" if given else "name its folder by --into"
            raise ValueError(f"--add takes {', '.join(OF_RECORD)} from the record: {what}")
        stored = read_record(name, into)
        scenarios, opponents = list(stored.data["scenarios"]), training_seeds.opponents_of_record(stored.data)
        episodes, seed, split = (stored.data[key] for key in ("episodes", "seed", "split"))
    for file in (out, curves):
        if file is not None:
            writable_file(file)
    store = Store(None if out is None else out.with_name(UNFINISHED))
    if curves is not None:
        save(training_seeds.learning_curves(training_seeds.runs_data(found), columns), curves)
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
        data = training_seeds.seeds_data(study, records)
        if stored is not None:
            command, note = stored.command, note or stored.note
            data = training_seeds.merge_runs(stored.data, data)
        made = ResultRecord(command, today(), settings_of(command).versions, note, data)
        write_record(name, made, into)
    store.clear()
    for grid in grids:
        console.print(grid)


def _algorithm(seed: training_seeds.SeedRun) -> str:
    return seed.run.algorithm


def ship(
    runs: Annotated[list[Path], typer.Argument(help="Folders of training runs, of one environment.")],
    into: Annotated[Path, typer.Option(help="Folder of the shipped agents.")] = Path("agents/pretrained"),
    trust: Trust = False,
) -> None:
    """Export the run of lowest validation cost of every algorithm, in place of the shipped one.

    Example: python docs/make ship runs/ManeuveringTarget/*-?
    """
    found = training_seeds.load_runs(runs, trust)
    for algorithm, own in itertools.groupby(sorted(found, key=_algorithm), _algorithm):
        best = min(own, key=lambda seed: seed.run.best["cost"] if seed.run.best else math.inf)
        file = into / best.run.problem.short_name / f"{algorithm}.safetensors"
        file.parent.mkdir(parents=True, exist_ok=True)
        export_run(best.folder, file, trust)
        console.print(f"{file}: {best.name}, of the lowest validation cost")


def playground() -> None:
    """Compile the filters of the first page to WebAssembly, which needs zig's C compiler: pip install ziglang.

    Example: python docs/make playground
    """
    if not has_compiler():
        raise ValueError("zig's C compiler is not installed: pip install ziglang")
    for name in FILTERS:
        module = compile_filter(name)
        module_file(name).write_bytes(module)
        console.print(f"{module_file(name)}: {len(module):,} bytes", soft_wrap=True)


COMMANDS: dict[str, Callable[..., None]] = {
    "record": record,
    "table": table,
    "seeds": seeds,
    "ship": ship,
    "readme": readme,
    "playground": playground,
    "notebooks": notebooks,
}


def main() -> None:
    """Run the command line of ``docs/make``; errors end as those of ``filtergym`` do."""
    run(lambda: program_of({"Commands": COMMANDS}), PROGRAM)
