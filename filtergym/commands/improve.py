"""Commands that search for better filters: tuned parameters and trained agents."""

from pathlib import Path
from typing import Annotated

import typer

from ..agents.settings import parse_settings
from ..agents.training_run import RunOptions
from ..agents.training_session import Session
from ..baselines.problem import problem_of
from ..baselines.tuned_values import FOLDER, read_table, save_tuned, table_path
from ..baselines.tuning import Search, tune
from ..envs.engine.catalogue import nearest
from ..envs.logs.reading import read_recording
from ..evaluation.running.parallel import Workers
from ..evaluation.storage.files import writable_file
from ..evaluation.storage.store import UNFINISHED, Store
from ..reports.tables.terminal_tables import tuning_table
from .advise import fit_to_recording
from .terminal import (
    Backend,
    Cluster,
    Environment,
    Jobs,
    RenameOption,
    SortOption,
    Speeds,
    TrainedControl,
    TrainingScenario,
    Trust,
    TruthOffset,
    TruthOption,
    check_no_recording_options,
    complete_policy,
    console,
    parse_pair,
    parse_renames,
    parse_whole_numbers,
    print_table,
    progress_bar,
)
from .training import open_run, open_runs, print_standing, train_runs, trainer_of


def tune_policy(
    environment: Environment,
    policy: Annotated[str, typer.Option(help="Policy to tune.", autocompletion=complete_policy)],
    budget: Annotated[int, typer.Option(help="Environment steps to spend.")] = 4_000_000,
    scenario: TrainingScenario = None,
    seed: Annotated[int, typer.Option(help="Seed of the training episodes and the search.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the tuned values.")] = FOLDER,
    backend: Backend = "auto",
    jobs: Jobs = 1,
    cluster: Cluster = None,
    recording: Annotated[
        str | None,
        typer.Option(help="Measurements of real sensors, NetCDF or tables (CSV): fit an estimator to them."),
    ] = None,
    truth: TruthOption = None,
    truth_offset: TruthOffset = 0.0,
    rename: RenameOption = None,
    sort: SortOption = False,
    speeds: Speeds = "0.01,1000",
) -> None:
    """Search a policy's parameters on training episodes; afterwards --policy NAME-tuned uses them.

    With a recording an estimator's parameters are fitted to it by maximum likelihood, with their intervals: one of the
    filters that filtergym advise names, or module:Class. The file is written into the folder of --out.

    Example: filtergym tune filtergym/ManeuveringTarget-v0 --policy imm --budget 4000000
    """
    problem = problem_of(environment)
    if recording is not None:
        found = read_recording(
            recording,
            problem.id,
            speeds=parse_pair("--speeds", speeds),
            truth=truth,
            truth_offset=truth_offset,
            rename=parse_renames(rename),
            sort=sort,
        )
        fit_to_recording(problem, policy, found, out, seed)
        return
    check_no_recording_options(truth, rename, sort)
    tunable = problem.baselines.tunable
    if policy not in tunable:
        raise nearest("tunable policy", policy, tunable)
    table = writable_file(table_path(problem.id, out))
    read_table(table)  # a file that cannot take the values is refused before the work
    with Workers(jobs, cluster) as workers, progress_bar() as bar:
        line = bar.add_task(f"tuning {policy}", total=budget)
        outcome = tune(
            problem,
            policy,
            Search(budget, scenario, seed, backend=backend),
            lambda steps: bar.update(line, advance=steps),
            workers,
            Store(table.with_name(UNFINISHED)),
        )
    command = f"filtergym tune {problem.name} --policy {policy} --budget {budget} --seed {seed}"
    path = save_tuned(outcome, command, out)
    print_table(tuning_table(outcome, tunable[policy].start))
    console.print(f"saved in {path}; use it as --policy {policy}-tuned")


def train(
    environment: Environment,
    out: Annotated[Path, typer.Option(help="Folder of the run: record, checkpoint, best agent, log.")],
    algo: Annotated[
        str,
        typer.Option(
            help="ppo, recurrent-ppo, sac, dqn, bptt, bptt-small, bptt-linear, bptt-strongest, kalman-net, student, "
            "ma-ukf or rl-ukf."
        ),
    ] = "ppo",
    control: TrainedControl = None,
    scenario: TrainingScenario = None,
    steps: Annotated[int | None, typer.Option(help="Environment steps in all.")] = None,
    envs: Annotated[int | None, typer.Option(help="Environments side by side.")] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the training episodes and the network; default: 0.")
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            help="Train one run each, such as 0-4, in folders called --out, a dash and the seed; finished ones are "
            "skipped, unfinished ones resumed."
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the checkpoint in --out.")] = False,
    validate_every: Annotated[
        int | None, typer.Option(help="Environment steps between validations; default: a twentieth.")
    ] = None,
    trust: Trust = False,
    backend: Backend = "auto",
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="env.NAME=VALUE, keyword of the environment, or algo.NAME=VALUE, hyperparameter; may be repeated.",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML file of settings, in rl-zoo3's form or with keys env and algo.")
    ] = None,
    reward: Annotated[
        str | None, typer.Option(help="cost, log-likelihood, cost-and-likelihood, relative or log-relative.")
    ] = None,
    residual_to: Annotated[
        str, typer.Option(metavar="POLICY", help="Policy of the environment that the agent corrects.")
    ] = "",
    gated: Annotated[bool, typer.Option("--gated", help="The agent acts only after an alarm.")] = False,
    jobs: Jobs = 1,
    cluster: Cluster = None,
    compare: Annotated[
        bool,
        typer.Option(
            help="Report at the end how the best agent compares with paper, classical and reference."
        ),
    ] = True,
) -> None:
    """Train an agent; Ctrl-C or SIGTERM stops it with a checkpoint from which --resume continues.

    A checkpoint of Stable-Baselines3 can execute code when it is loaded: resuming one, with --resume or --seeds, also
    needs --trust. One of bptt, kalman-net or student cannot.

    --set overrides --config, and --config the shipped hyperparameters. --resume continues with the settings of the run,
    and refuses others.

    Example: filtergym train filtergym/ManeuveringTarget-v0 --algo ppo --steps 1000000 --out runs/ppo

    Example: filtergym train filtergym/ManeuveringTarget-v0 --set env.range_sigma=50 --set algo.learning_rate=3e-4 \
    --out runs/precise

    Example: filtergym train filtergym/ManeuveringTarget-v0 --algo bptt --seeds 0-4 --out runs/bptt
    """
    trainer = trainer_of(algo)
    if seeds is not None and (seed is not None or resume):
        raise ValueError(
            "--seeds names every seed, and continues runs by itself: leave out --seed and --resume"
        )
    if seeds is None and not (jobs == 1 and cluster is None):
        raise ValueError(
            "a single run is trained in one process: --jobs and --cluster share the runs of --seeds"
        )
    keywords, hyperparameters = parse_settings(set_ or [])
    if reward is not None:
        keywords["reward"] = reward
    problem = problem_of(environment)
    options = RunOptions(
        algo,
        control,
        steps,
        envs,
        seed or 0,
        scenario,
        hyperparameters,
        keywords,
        config,
        backend,
        residual_to,
        gated,
    )
    session = Session(out, resume, validate_every, trust)
    # Every run is opened before any is trained, so that a wrong word costs nothing.
    if seeds is None:
        opened = [open_run(problem, options, session)]
    else:
        opened = open_runs(problem, options, session, parse_whole_numbers("--seeds", seeds))
    with Workers(jobs, cluster) as workers:
        runs = train_runs(opened, trainer, workers)
    if compare and all(run.is_complete for run in runs):  # unless somebody wished to stop
        print_standing(opened, runs)
