"""Commands that evaluate, record, benchmark and animate competitors on the same noise."""

from pathlib import Path
from typing import Annotated

import typer

from ..baselines.problem import problem_of
from ..envs.data.recording import Recording
from ..envs.engine.catalogue import check_names
from ..evaluation.competitors.programs import limit_programs
from ..evaluation.figures.curve_figures import evaluation_figures
from ..evaluation.figures.print_layout import check_columns, check_formats, save
from ..evaluation.running.parallel import Workers
from ..evaluation.running.recording import record_experiment
from ..evaluation.running.rollout import Progress
from ..evaluation.running.summary import Evaluation
from ..evaluation.running.supervision import supervise
from ..evaluation.running.threads import one_thread
from ..evaluation.running.times import points_of_records
from ..evaluation.storage.blind import write_blind
from ..evaluation.storage.files import (
    hold_folder,
    whole_file,
    whole_files,
    writable_file,
    writable_folder,
    write_text,
)
from ..evaluation.storage.store import UNFINISHED, Store
from ..extensions import PREFIXES
from ..functions import requests_of
from ..names import find_competitor, is_module, isolate_names, learned_names
from ..offline import datasets_table, plan_datasets
from ..protocol import protocol_names
from ..reports.tables.benchmark import BenchmarkOptions, Callbacks, Cell, all_records, run_benchmark
from ..reports.tables.export import LATEX_WIDTH, latex_table, records_as_csv
from ..reports.tables.headline import headline_table
from ..reports.tables.reasons import default_explained
from ..reports.tables.results import RESULTS, Result, WorstTrack, settings_of
from ..reports.tables.terminal_tables import results_tables
from ..reports.tables.worst import find_worst
from .evaluation import (
    FileOptions,
    Outputs,
    assumed_parameters,
    check_explained,
    departure_lines,
    find_data,
    find_participants,
    has_predictions,
    own_names,
    run,
    write,
)
from .protocol import check_options, evaluate_protocol
from .result_output import REPORT, make_report, print_headline, print_outcome
from .terminal import (
    Backend,
    Cluster,
    Columns,
    Control,
    Environment,
    Episodes,
    Experiment,
    Formats,
    Jobs,
    Parameters,
    RenameOption,
    ScenarioName,
    SortOption,
    Split,
    Threads,
    Trust,
    TruthOffset,
    TruthOption,
    command_line,
    complete_environment,
    complete_from,
    complete_policy,
    console,
    import_environments,
    parse_settings,
    print_sentence,
    print_table,
    progress_bar,
)


@one_thread()
def evaluate_policies(
    ctx: typer.Context,
    environment: Annotated[
        str | None,
        typer.Argument(
            help="Environment id; `filtergym list` shows them. module:id for one that a module registers. A recording "
            "names its own.",
            autocompletion=complete_environment,
            callback=import_environments,
        ),
    ] = None,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="Policy, estimator, reference or bound; repeat for several. Also a file, the folder of a "
            "training run, module:Class, or exec:COMMAND of any program.",
            autocompletion=complete_policy,
        ),
    ] = None,
    protocol: Annotated[
        str | None,
        typer.Option(
            help="In place of an environment: a frozen protocol over several of them, filtergym-1, whose row can be "
            "quoted; --policy NAME, or ENVIRONMENT=NAME for one of them.",
            autocompletion=complete_from(*protocol_names()),
        ),
    ] = None,
    scenario: ScenarioName = None,
    control: Control = None,
    episodes: Episodes = 500,
    seed: Experiment = 0,
    split: Split = "test",
    settings: Parameters = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for records, a table, the whole result and figures.")
    ] = None,
    netcdf: Annotated[
        bool | None,
        typer.Option(
            "--netcdf/--no-netcdf",
            help="With --out, write results.nc of any size, or not at all; default: up to 200 MB.",
        ),
    ] = None,
    format: Formats = None,
    columns: Columns = 2,
    json: Annotated[Path | None, typer.Option(help="File for tidy records.")] = None,
    recording: Annotated[
        str | None,
        typer.Option(
            help="In place of a scenario: measurements of real sensors, NetCDF, tables (CSV) or logs of receivers "
            "(.pos, .nmea): a file, a folder, or a pattern in quotes."
        ),
    ] = None,
    truth: TruthOption = None,
    truth_offset: TruthOffset = 0.0,
    rename: RenameOption = None,
    sort: SortOption = False,
    estimates: Annotated[
        Path | None,
        typer.Option(
            help="File (CSV or NetCDF) for every estimate with its sigma, NIS and log-likelihood; or folder NAME.tum "
            "for trajectories that evo reads."
        ),
    ] = None,
    trust: Trust = False,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Stop at an estimate that is not finite or has no covariance; default: the episode is lost.",
        ),
    ] = False,
    isolated: Annotated[
        bool,
        typer.Option(
            "--isolated",
            help="Run every module:Class in a process of its own, which receives the measurements only.",
        ),
    ] = False,
    time_limit: Annotated[
        float,
        typer.Option(
            help="Limit for each estimate of programs, isolated estimators and, on Linux with --jobs 1, any "
            "module:Class, s."
        ),
    ] = 10.0,
    memory_limit: Annotated[
        float,
        typer.Option(help="Address space of programs and isolated estimators, MB, on Linux; 0: no limit."),
    ] = 4000.0,
    backend: Backend = "auto",
    threads: Threads = 1,
    jobs: Jobs = 1,
    cluster: Cluster = None,
    why: Annotated[
        list[str] | None,
        typer.Option(
            help="Competitor whose cost is explained; repeat for several; default: yours, the first --policy, else the "
            "paper's "
            "algorithm.",
            autocompletion=complete_policy,
        ),
    ] = None,
    site: Annotated[
        str | None,
        typer.Option(
            help="Of flights in latitude and longitude: those of the radar, degrees, such as 48.72,2.38."
        ),
    ] = None,
    longest_gap: Annotated[
        float, typer.Option(help="Of flights: longest gap at which a flight is not cut, s.")
    ] = 60.0,
    speeds: Annotated[
        str,
        typer.Option(help="Of flights and recordings: lowest and highest possible speed, m/s."),
    ] = "1,1000",
    smoothing: Annotated[
        float,
        typer.Option(
            help="Of flights: parabolas are fitted to what lies this far on either side, s; 0: none."
        ),
    ] = 0.0,
    fewest_scans: Annotated[
        int, typer.Option(help="Of flights: shorter pieces are dropped, in measurements.")
    ] = 10,
) -> None:
    """Run policies over the same noise and compare them.

    Example: filtergym evaluate filtergym/ManeuveringTarget-v0 --scenario paper --policy imm --policy adaptive
    """
    if isolated and trust:
        raise ValueError("--trust runs code in this process, and --isolated does not: leave one of them out")
    if protocol is not None:
        check_options(ctx)
        isolating = isolate_names if isolated else None
        with limit_programs(time_limit, memory_limit), Workers(jobs, cluster) as workers:
            evaluate_protocol(
                protocol, policy or [], workers, json, trust, isolating, backend=backend, threads=threads
            )
        return
    keywords = parse_settings(settings)
    outputs = Outputs(out, netcdf, format or ["png"], columns, json, estimates)
    options = FileOptions(
        site, longest_gap, speeds, smoothing, fewest_scans, truth, truth_offset, rename, sort
    )
    outputs.check()
    if out is not None:
        ctx.with_resource(hold_folder(out))
    read = {} if recording is None else assumed_parameters(environment, policy or [])
    problem, data = find_data(environment, scenario, recording, options, {**read, **keywords})
    if isolated:
        policy, why = isolate_names(problem, policy or []), isolate_names(problem, why or [])
    here = [name for name in policy or [] if is_module(problem, name) and not name.startswith((*PREFIXES,))]
    ended = supervise(here, time_limit)
    if ended and not (policy := [name for name in policy or [] if name not in ended]):
        raise ValueError("; ".join(ended.values()))
    with limit_programs(time_limit, memory_limit):
        competitors = find_participants(problem, data, policy, trust)
    names, learned = [one.name for one in competitors], [one for one in competitors if one.learned]
    check_explained(why := [name for name in why or [] if name not in ended], names)
    check_names(problem.task, keywords)
    experiment = problem.experiment(
        data,
        len(data.names) if isinstance(data, Recording) else episodes,
        seed,
        split,
        control,
        tracks=estimates is not None or has_predictions(problem, data, names),
        drawn_episodes=int(out is not None),
        backend=backend,
        threads=threads,
        strict=strict,
        timed=True,
        keywords=keywords,
    )
    store = Store(None if out is None else out / UNFINISHED)
    requests = requests_of(problem, experiment, competitors, curves=out is not None)
    with limit_programs(time_limit, memory_limit), outputs.reserve_space(competitors):
        with Workers(jobs, cluster) as workers:
            found, refusal, failures = run(requests, outputs, workers, store)
        own, paper = own_names(problem, policy or []), found.dataset.attrs["paper"]
        explained = why or default_explained(found.records, [*own, *(policy or [])], paper)
        worst: dict[str, list[WorstTrack]] = {name: [] for name in explained}
        if out is not None:
            worst = find_worst(experiment, found, competitors, explained)
    write(problem, found, refusal, outputs, [one.name for one in learned], worst, own)
    store.clear()
    for sentence in departure_lines(problem, data, learned, keywords):
        print_sentence(sentence)
    if failures := ended | failures:
        raise ValueError(f"{'; '.join(failures.values())}; the others are in the table")


def record_scenario(
    environment: Environment,
    out: Annotated[Path, typer.Option(help="NetCDF file for the recording; with --blind a folder.")],
    scenario: ScenarioName = None,
    episodes: Annotated[int, typer.Option(help="Episodes to record.")] = 10,
    seed: Experiment = 0,
    split: Split = "test",
    settings: Parameters = None,
    blind: Annotated[
        bool,
        typer.Option(
            "--blind",
            help="Without the truth, for programs outside Python: measurements.csv, start.csv and measurements.nc. "
            "filtergym evaluate --policy file:ESTIMATES evaluates their estimates.",
        ),
    ] = False,
    backend: Backend = "auto",
) -> None:
    """Record the measurements of simulated episodes, with the truth or, for competitors, without.

    Example: filtergym record filtergym/ManeuveringTarget-v0 --scenario paper --episodes 20 --out plots.nc
    """
    problem = problem_of(environment)
    keywords = parse_settings(settings, problem.task)
    if not blind and out.suffix != ".nc":
        raise ValueError(f"a recording is a NetCDF file, whose name ends in .nc, got {str(out)!r}")
    (writable_folder if blind else writable_file)(out)
    experiment = problem.experiment(scenario, episodes, seed, split, backend=backend, keywords=keywords)
    with progress_bar() as bar:
        line = bar.add_task("recording", total=episodes * experiment.make_task().horizon)
        recording = record_experiment(experiment, lambda done: bar.update(line, advance=done))
    if not blind:
        with whole_file(out) as waiting:
            recording.write(waiting)
        console.print(f"{len(recording.names)} episodes in {out}", soft_wrap=True)
        return
    write_blind(out, recording, experiment.make_task())
    chosen = [f"--scenario {scenario}"] * (scenario is not None) + [f"--set {one}" for one in settings or []]
    judged = f"--episodes {episodes} --seed {seed} --split {split} --policy file:ESTIMATES.csv"
    console.print(f"{episodes} episodes in {out}; to evaluate estimates of them:", soft_wrap=True)
    console.print(f"  filtergym evaluate {' '.join([environment, *chosen, judged])}", soft_wrap=True)


def write_offline(
    environment: Environment,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="Policy, one data set each; repeat for several; default: the paper's, the best tuned one, and random "
            "actions. Also a file, the folder of a training run, or module:Class.",
            autocompletion=complete_policy,
        ),
    ] = None,
    scenario: ScenarioName = None,
    control: Control = None,
    episodes: Annotated[int, typer.Option(help="Episodes in each data set.")] = 1000,
    seed: Experiment = 0,
    split: Annotated[
        str,
        typer.Option(
            help="train, validation or test; only test takes held-out scenarios and flights of your own.",
            autocompletion=complete_from("train", "validation", "test"),
        ),
    ] = "train",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Parameter of the task, reward or dtype, name=value; repeat for several."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of data sets; default: that of Minari.")] = None,
    namespace: Annotated[
        str | None,
        typer.Option(help="Beginning of the names; default: filtergym/maneuvering-target and the like."),
    ] = None,
    trust: Trust = False,
) -> None:
    """Write episodes of policies as Minari data sets, to learn from without an environment (with filtergym[offline]).

    Random actions are drawn in the environment of the policy named before them. Data sets of the same control and
    parameters can be combined.

    Example: filtergym offline filtergym/ManeuveringTarget-v0 --policy imm --policy random --episodes 500
    """
    problem, keywords = problem_of(environment), parse_settings(settings)
    experiment = problem.experiment(scenario, episodes, seed, split, control, keywords=keywords)
    plan = plan_datasets(problem, experiment, policy, trust)
    with progress_bar() as bar:
        line = bar.add_task("recording", total=plan.decisions)
        written = plan.write(out, namespace, lambda done: bar.update(line, advance=done))
    print_table(datasets_table(written))
    place = f", with MINARI_DATASETS_PATH={out}" if out is not None else ""
    console.print(f'load one by minari.load_dataset("{written[0].name}"){place}', soft_wrap=True)


@one_thread()
def benchmark(
    full: Annotated[
        bool, typer.Option("--full", help="Every scenario and policy, and ten times the episodes.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for results, report and figures.")] = Path("results"),
    seed: Experiment = 0,
    half_width: Annotated[
        float,
        typer.Option(
            help="Run more episodes of the training distributions, at most 20,000, until no interval of the headline "
            "reaches further than this to either side, percentage points; 0: no more."
        ),
    ] = 0.0,
    environment: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this environment; repeatable.",
            autocompletion=complete_environment,
            callback=import_environments,
        ),
    ] = None,
    split: Annotated[
        str, typer.Option(help="test; or validation, for development: training scenarios only.")
    ] = "test",
    policy: Annotated[list[str] | None, typer.Option(hidden=True)] = None,
    format: Formats = None,
    columns: Columns = 2,
    backend: Backend = "auto",
    threads: Threads = 1,
    jobs: Jobs = 1,
    cluster: Cluster = None,
) -> None:
    """Run every environment with its competitors; quick by default, resumes after an interruption.

    Figures are in the report; --format writes them as files, too.

    Example: filtergym benchmark --full --environment filtergym/ManeuveringTarget-v0 --split validation
    """
    if policy:
        raise ValueError(
            f"benchmark runs shipped competitors only, and --policy {policy[0]} names another: filtergym evaluate "
            f"--protocol filtergym-1 --policy {policy[0]} runs it in every environment, and filtergym evaluate "
            f"ENVIRONMENT --policy {policy[0]} in one"
        )
    formats = check_formats(format or [])
    check_columns(columns)
    options = BenchmarkOptions(
        full, seed, environment or (), split, backend, threads, command_line(), half_width
    )
    with Workers(jobs, cluster) as workers, progress_bar() as bar:

        def add_line(total: int) -> Progress:
            line = bar.add_task("benchmark", total=total)
            return lambda done: bar.update(line, advance=done)

        def tell_result(result: Result) -> None:
            first = result.records[0]
            count = len({record.policy for record in result.records})
            bar.write_line(
                f"{result.short}, {result.scenario}: {count} competitor{'s' * (count > 1)} over "
                f"{first.episodes:,} episodes"
            )

        def save_figures(cell: Cell, evaluation: Evaluation) -> None:
            if evaluation.curves is None or not formats:
                return
            learned, points = learned_names(cell.environment), points_of_records(evaluation.records)
            for name, figure in evaluation_figures(
                evaluation.curves, columns, learned=learned, points=points
            ):
                for suffix in formats:
                    save(figure, out / f"{cell.name}.{name}.{suffix}")

        results = run_benchmark(out, options, Callbacks(add_line, tell_result, save_figures), workers)
    tables = [headline_table(results)]
    tables += [table for r in results for table in results_tables(r.records, r.knows, LATEX_WIDTH, r.paper)]
    with whole_files(out) as waiting:
        records_as_csv(waiting / "records.csv", all_records(results))
        write_text(waiting / "tables.tex", "\n".join(map(latex_table, tables)))
    print_outcome(results)
    console.print()
    make_report(results, settings_of(options.command), out / REPORT)
    console.print(f"results in {out}: {RESULTS}, records.csv, tables.tex", soft_wrap=True)
    print_sentence("environments and their competitors: filtergym list, docs/environments.md")
    console.print()
    print_headline(results)


def animate(
    environment: Environment,
    policy: Annotated[
        list[str],
        typer.Option(
            help="Policy, estimator, smoother or reference; repeat for several. Also a file, the folder of a training "
            "run, or module:Class.",
            autocompletion=complete_policy,
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the GIFs.")] = Path("results"),
    scenario: ScenarioName = None,
    seed: Annotated[int, typer.Option(help="Seed of the episode.")] = 0,
    every: Annotated[int, typer.Option(help="Actions from one frame to the next.")] = 2,
    trust: Trust = False,
) -> None:
    """Draw an episode under each policy, estimator, smoother or reference as an animated GIF.

    Example: filtergym animate filtergym/ManeuveringTarget-v0 --scenario paper --policy imm --out results
    """
    from ..evaluation.figures.animation import episode_frames, write_animation

    problem = problem_of(environment)
    writable_folder(out)
    for name in policy:
        path = writable_file(
            out / f"{problem.id.rpartition('/')[2]}-{Path(name.rpartition(':')[2]).name}.gif"
        )
        maker = find_competitor(problem, name, trust).maker
        write_animation(episode_frames(problem.task, name, maker, scenario, seed, every), path)
        console.print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")
