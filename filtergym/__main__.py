"""The command line: ``filtergym`` or ``python -m filtergym``."""

import ast
import sys
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .baselines.catalogue import baselines_of
from .baselines.reproduction import paper_module, papers, save_reproduction
from .baselines.tuning import FOLDER, save_tuned, tune
from .envs.catalogue import catalogue, find_scenario, importable_name, nearest, short_name, task_class
from .evaluation.figures import evaluation_figures, save
from .evaluation.files import writable_folder
from .evaluation.metrics import Record
from .names import competitor, evaluate, tidy_records
from .reports import comparison, training_seeds
from .reports.benchmark import Cell, run_benchmark
from .reports.environment_page import environment_tables, put_tables
from .reports.listing import environment_lines
from .reports.pages import insert_between_markers, split_at_markers
from .reports.records import write_records
from .reports.room import MARKER, measure_room, room_markdown
from .reports.tables import claims_table, grid_table, results_table, tuned_table

app = typer.Typer(
    help="Gymnasium environments for adaptive-filter benchmarking.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
# Wide enough for the results table where the output is a file; a terminal keeps its own width.
console = Console(width=None if sys.stdout.isatty() else 150)


def progress_bar() -> Progress:
    """Return a progress bar on standard error, so that tables can be piped; none where nobody looks."""
    errors = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=errors,
        transient=True,
        disable=not errors.is_terminal,
    )


def parsed_settings(settings: list[str]) -> dict[str, Any]:
    """Turn ``name=value`` into keywords; a value is a Python literal, or else a word."""
    keywords: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals or not name.strip().isidentifier() or not text.strip():
            raise ValueError(f"--set needs name=value, such as --set horizon=50, got {setting!r}")
        try:
            keywords[name.strip()] = ast.literal_eval(text.strip())
        except (ValueError, SyntaxError) as error:
            if not text.strip().replace("-", "_").isidentifier():
                raise ValueError(f"--set {name}: cannot read the value {text!r}") from error
            keywords[name.strip()] = text.strip()
    return keywords


@app.command("list")
def list_environments(
    environment: Annotated[
        list[str] | None,
        typer.Argument(help="Environment ids, default all; module:id for one that a module registers."),
    ] = None,
) -> None:
    """List environments with their papers, controls, scenarios, policies, references and bounds.

    Example: filtergym list filtergym/ManeuveringTarget-v0
    """
    for id in environment or catalogue():
        first, *lines = environment_lines(id)
        console.print(f"[bold]{first}[/bold]")
        for line in lines:
            console.print(line, highlight=False, soft_wrap=True, markup=False)


@app.command("evaluate")
def evaluate_policies(
    environment: Annotated[str, typer.Argument(help="Environment id; `filtergym list` shows them.")],
    policy: Annotated[
        list[str] | None,
        typer.Option(help="Policy, reference or bound; repeat for several. Also module:Class."),
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="Scenario; default: the training distribution.")
    ] = None,
    control: Annotated[str | None, typer.Option(help="Demand this control.")] = None,
    episodes: Annotated[int, typer.Option(help="Monte Carlo runs.")] = 500,
    seed: Annotated[int, typer.Option(help="Number of the experiment.")] = 0,
    split: Annotated[str, typer.Option(help="test, validation or train.")] = "test",
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Parameter of the task, name=value; repeat for several.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for figures and records.")] = None,
    json: Annotated[Path | None, typer.Option(help="File for tidy records.")] = None,
) -> None:
    """Run policies over the same noise and compare them.

    Example: filtergym evaluate filtergym/ManeuveringTarget-v0 --scenario paper --policy imm --policy adaptive
    """
    cls = task_class(environment)
    known = baselines_of(cls.id)
    if out is not None:
        writable_folder(out)
    if json is not None:
        writable_folder(json.parent)
    names = policy or list(known.benchmark or known.names)
    keywords = parsed_settings(settings or [])
    with progress_bar() as bar:
        line = bar.add_task("evaluating", total=None)
        dataset = evaluate(
            cls.id,
            names,
            scenario,
            episodes,
            seed,
            split,
            control,
            progress=lambda done: bar.update(line, advance=done),
            **keywords,
        )
    records = tidy_records(dataset)
    console.print(results_table(records))
    if json is not None:
        write_records(json, records)
    if out is not None:
        write_records(out / "records.json", records)
        for name, figure in evaluation_figures(dataset):
            save(figure, out / f"{name}.png")
        console.print(f"figures and records in {out}")


@app.command("benchmark")
def benchmark(
    full: Annotated[
        bool, typer.Option("--full", help="Every scenario and policy, and ten times the episodes.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for records and figures.")] = Path("results"),
    seed: Annotated[int, typer.Option(help="Number of the experiment.")] = 0,
    environment: Annotated[list[str] | None, typer.Option(help="Only this environment; repeatable.")] = None,
    split: Annotated[
        str, typer.Option(help="test; or validation, for development: training scenarios only.")
    ] = "test",
) -> None:
    """Run every environment with its policies; quick by default, resumes after an interruption.

    Example: filtergym benchmark --full --environment filtergym/ManeuveringTarget-v0 --split validation
    """
    with progress_bar() as bar:

        def started(cell: Cell, total: int) -> Any:
            line = bar.add_task(f"{short_name(cell.environment)} {cell.scenario}", total=total)
            return lambda done: bar.update(line, advance=done)

        def finished(records: list[Record]) -> None:
            console.print(results_table(records))

        run_benchmark(out, full, seed, environment or (), split, started, finished)
    console.print(f"records in {out / 'benchmark.json'}, figures beside it")


@app.command("comparison")
def comparison_page(
    records: Annotated[Path, typer.Argument(help="benchmark.json of a full benchmark.")],
    into: Annotated[
        Path | None,
        typer.Option(help="Page that takes the tables; pictures go to the folder images/ beside it."),
    ] = None,
) -> None:
    """Compare papers, tuned policies, learned agents and references, from the records of a benchmark.

    Example: filtergym comparison results/benchmark.json --into docs/comparison.md
    """
    found = comparison.read_benchmark(records)
    markers = {id: f"comparison {short_name(id)}" for id in found}
    if into is not None:
        for marker in markers.values():
            split_at_markers(into, marker)
    for id, own in found.items():
        compared = comparison.compare_environment(own)
        for grid in compared.grids:
            console.print(grid_table(grid))
        if into is not None:
            picture = f"images/comparison_{short_name(id)}.png"
            save(compared.figure, writable_folder(into.parent / "images") / Path(picture).name)
            command = f"filtergym benchmark --full --seed {own[0].seed} --split {own[0].split}"
            text = comparison.comparison_markdown(compared, own, picture, command)
            insert_between_markers(into, markers[id], text)


@app.command("tune")
def tune_policy(
    environment: Annotated[str, typer.Argument(help="Environment id.")],
    policy: Annotated[str, typer.Option(help="Policy to tune.")],
    budget: Annotated[int, typer.Option(help="Environment steps to spend.")] = 4_000_000,
    scenario: Annotated[
        str | None, typer.Option(help="A training scenario; held-out ones are refused.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the training episodes and the search.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the tuned values.")] = FOLDER,
) -> None:
    """Search a policy's parameters on training episodes; afterwards --policy NAME-tuned uses them.

    Example: filtergym tune filtergym/ManeuveringTarget-v0 --policy imm --budget 4000000
    """
    cls = task_class(environment)
    tunable = baselines_of(cls.id).tunable
    if policy not in tunable:
        raise nearest("tunable policy", policy, tunable)
    writable_folder(out)
    with progress_bar() as bar:
        line = bar.add_task(f"tuning {policy}", total=budget)
        outcome = tune(
            cls.id,
            policy,
            tunable[policy],
            budget,
            scenario,
            seed,
            progress=lambda steps: bar.update(line, advance=steps),
        )
    console.print(tuned_table(outcome, tunable[policy].start))
    command = f"filtergym tune {importable_name(cls)} --policy {policy} --budget {budget} --seed {seed}"
    path = save_tuned(outcome, command, out)
    console.print(f"saved in {path}; use it as --policy {policy}-tuned")


@app.command("room")
def room(
    environment: Annotated[str, typer.Argument(help="Environment id.")],
    episodes: Annotated[int, typer.Option(help="Monte Carlo runs.")] = 5000,
    seed: Annotated[int, typer.Option(help="Number of the experiment.")] = 0,
    into: Annotated[Path | None, typer.Option(help="Page whose room table is replaced.")] = None,
) -> None:
    """Show how much is left to win: best constant action, paper, tuned policies, references, bounds.

    Example: filtergym room filtergym/ManeuveringTarget-v0
    """
    cls = task_class(environment)
    if into is not None:
        split_at_markers(into, MARKER)  # a page that cannot take the table is refused before the work
    with progress_bar() as bar:
        line = bar.add_task("evaluating", total=None)
        records = measure_room(cls.id, episodes, seed, lambda done: bar.update(line, advance=done))
    console.print(results_table(records))
    if into is not None:
        command = f"filtergym room {importable_name(cls)} --episodes {episodes} --seed {seed} --into {into}"
        insert_between_markers(into, MARKER, room_markdown(records, command))


@app.command("page")
def page(
    environment: Annotated[str, typer.Argument(help="Environment id.")],
    into: Annotated[Path | None, typer.Option(help="Page whose tables are replaced.")] = None,
) -> None:
    """Make the tables of an environment's page from its code: actions, fields, parameters, scenarios, policies.

    Example: filtergym page filtergym/ManeuveringTarget-v0
    """
    if into is not None:
        console.print(f"{into}: {', '.join(put_tables(environment, into))}", markup=False)
        return
    for name, table in environment_tables(environment).items():
        console.print(f"{name}\n\n{table}\n", markup=False, soft_wrap=True)


@app.command("reproduce")
def reproduce(
    paper: Annotated[str, typer.Argument(help=f"One of: {', '.join(papers())}.")],
    out: Annotated[Path | None, typer.Option(help="Folder for report and figures.")] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Monte Carlo runs instead of the module's own.")
    ] = None,
) -> None:
    """Run a paper's experiments again and give a verdict on each of its claims.

    Example: filtergym reproduce imm-alpha-beta --out results/imm-alpha-beta
    """
    module = paper_module(paper)
    if out is not None:
        writable_folder(out)
    with progress_bar() as bar:
        line = bar.add_task(f"reproducing {paper}", total=module.STEPS)
        result = module.reproduce(lambda done=1: bar.update(line, advance=done), episodes)
    console.print(claims_table(result))
    if out is not None:
        save_reproduction(result, out)
        console.print(f"report and figures in {out}")


@app.command("animate")
def animate(
    environment: Annotated[str, typer.Argument(help="Environment id.")],
    policy: Annotated[list[str], typer.Option(help="Policy; repeat for several.")],
    out: Annotated[Path, typer.Option(help="Folder for the GIFs.")] = Path("results"),
    scenario: Annotated[
        str | None, typer.Option(help="Scenario; default: the training distribution.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the episode.")] = 0,
    every: Annotated[int, typer.Option(help="Actions from one frame to the next.")] = 2,
) -> None:
    """Draw an episode under each policy as an animated GIF.

    Example: filtergym animate filtergym/ManeuveringTarget-v0 --scenario paper --policy imm --out results
    """
    try:
        from .evaluation.animation import episode_frames, write_animation
    except ImportError as error:
        raise ValueError(
            f"animations need more packages: pip install 'filtergym[render]' ({error})"
        ) from error
    cls = task_class(environment)
    writable_folder(out)
    for name in policy:
        path = out / f"{cls.id.rpartition('/')[2]}-{name.rpartition(':')[2]}.gif"
        write_animation(episode_frames(cls.id, name, competitor(cls.id, name), scenario, seed, every), path)
        console.print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


@app.command("train")
def train(
    environment: Annotated[str, typer.Argument(help="Environment id.")],
    out: Annotated[Path, typer.Option(help="Folder of the run: record, checkpoint, best agent, log.")],
    algo: Annotated[str, typer.Option(help="ppo, recurrent-ppo, sac, dqn or bptt.")] = "ppo",
    control: Annotated[
        str | None, typer.Option(help="What the agent steers; default: the environment's first.")
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="A training scenario; held-out ones are refused.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Environment steps in all.")] = None,
    envs: Annotated[int | None, typer.Option(help="Environments side by side.")] = None,
    seed: Annotated[int, typer.Option(help="Of the training episodes and the network.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
    validate_every: Annotated[
        int | None, typer.Option(help="Environment steps between validations; default: a twentieth.")
    ] = None,
) -> None:
    """Train an agent; Ctrl-C stops it with a checkpoint that --resume goes on from.

    A checkpoint is loaded with pickle, which can execute code: resume only what you trust.

    Example: filtergym train filtergym/ManeuveringTarget-v0 --algo ppo --steps 1000000 --out runs/ppo
    """
    try:
        import torch

        from .agents import training_run

        trainer: Any
        if algo == "bptt":
            from .agents.bptt import train_bptt as trainer
        else:
            from .agents.sb3_training import train_sb3 as trainer
    except ImportError as error:
        raise ValueError(
            f"training needs more packages: pip install 'filtergym[agents]' ({error})"
        ) from error
    torch.set_num_threads(1)  # networks this small run slower on more
    run = training_run.new_run(environment, algo, control, steps, envs, seed, scenario)
    run = training_run.opened_run(out, run, resume)
    with progress_bar() as bar:
        line = bar.add_task(f"training {algo}", total=run.steps)
        trainer(
            run,
            out,
            resume,
            validate_every,
            progress=lambda done: bar.update(line, completed=done),
            report=lambda text: console.print(text, highlight=False),
        )
    console.print(f"{run.steps_done:,} steps done; best agent in {out / 'best'}, checkpoint beside it")


@app.command("export")
def export(
    folder: Annotated[Path, typer.Argument(help="Folder of a training run.")],
    out: Annotated[Path | None, typer.Option(help="File; default: agent.safetensors in the folder.")] = None,
) -> None:
    """Write a run's best agent as plain arrays, which evaluate without torch and cannot execute anything.

    Example: filtergym export runs/ppo, then filtergym evaluate ENV --policy runs/ppo/agent.safetensors
    """
    try:
        from .agents.export import export_run
    except ImportError as error:
        raise ValueError(f"export needs more packages: pip install 'filtergym[agents]' ({error})") from error
    path = out or folder / "agent.safetensors"
    run = export_run(folder, path)
    console.print(f"{run.algorithm} for {run.environment}, control {run.control}: {path}")


@app.command("seeds")
def seeds(
    runs: Annotated[list[Path], typer.Argument(help="Folders of training runs, of one environment.")],
    scenario: Annotated[
        list[str] | None, typer.Option(help="Scenario; repeatable. Default: the training distribution.")
    ] = None,
    policy: Annotated[
        list[str] | None,
        typer.Option(help="Opponent; repeatable. Default: tunable policies, tuned ones and references."),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Monte Carlo runs.")] = 2000,
    seed: Annotated[int, typer.Option(help="Number of the experiment.")] = 0,
    split: Annotated[str, typer.Option(help="test, validation or train.")] = "test",
    out: Annotated[Path | None, typer.Option(help="File for tidy records.")] = None,
    into: Annotated[Path | None, typer.Option(help="Page whose seeds table is replaced.")] = None,
    curves: Annotated[Path | None, typer.Option(help="PNG file for the learning curves.")] = None,
) -> None:
    """Score training seeds: every run's best agent, the spread between seeds, the median against opponents.

    Loads models, which can execute code: score only runs that you trust.

    Example: filtergym seeds runs/ppo-0 runs/ppo-1 runs/ppo-2 --split validation
    """
    found = training_seeds.load_runs(runs)
    cls = task_class(found[0].run.environment)
    scenarios = [find_scenario(cls, name).name for name in scenario or [cls.default_scenario]]
    opponents = policy or training_seeds.default_opponents(cls.id)
    marker = f"seeds {short_name(cls.id)}"
    for file in (out, curves):
        if file is not None:
            writable_folder(file.parent)
    if into is not None:
        split_at_markers(into, marker)
    if curves is not None:
        save(training_seeds.learning_curves(found), curves)
    with progress_bar() as bar:
        line = bar.add_task("evaluating", total=None)
        records, grids = training_seeds.compare_scenarios(
            found, opponents, scenarios, episodes, seed, split, lambda done: bar.update(line, advance=done)
        )
    for grid in grids:
        console.print(grid_table(grid))
    if out is not None:
        write_records(out, records)
    if into is not None:
        command = f"filtergym seeds RUN ... {' '.join(f'--scenario {name}' for name in scenarios)} "
        command += "".join(f"--policy {name} " for name in policy or ())
        command += f"--episodes {episodes} --split {split} --seed {seed}"
        insert_between_markers(into, marker, training_seeds.grids_as_markdown(grids, found, command))


def main() -> None:
    """Run the command line; a user's mistake ends in one sentence and exit code 2."""
    try:
        app()
    except (ValueError, gymnasium.error.Error) as error:
        Console(stderr=True, highlight=False).print(
            f"Error: {error}", style="red", markup=False, soft_wrap=True
        )
        sys.exit(2)


if __name__ == "__main__":
    main()
