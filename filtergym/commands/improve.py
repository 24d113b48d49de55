"""Commands that search for something better: tuned values and trained agents."""

import functools
from pathlib import Path
from typing import Annotated, Any

import typer

from ..agents.export import export_run
from ..baselines.catalogue import baselines_of
from ..baselines.tuning import FOLDER, read_table, save_tuned, table_path, tune
from ..envs.catalogue import importable_name, nearest, task_class
from ..evaluation.files import writable_file
from ..reports.tables import tuned_table
from .terminal import Backend, Environment, TrainingScenario, Trust, console, progress_bar


def tune_policy(
    environment: Environment,
    policy: Annotated[str, typer.Option(help="Policy to tune.")],
    budget: Annotated[int, typer.Option(help="Environment steps to spend.")] = 4_000_000,
    scenario: TrainingScenario = None,
    seed: Annotated[int, typer.Option(help="Of the training episodes and the search.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for the tuned values.")] = FOLDER,
    backend: Backend = "auto",
) -> None:
    """Search a policy's parameters on training episodes; afterwards --policy NAME-tuned uses them.

    Example: filtergym tune filtergym/ManeuveringTarget-v0 --policy imm --budget 4000000
    """
    cls = task_class(environment)
    tunable = baselines_of(cls.id).tunable
    if policy not in tunable:
        raise nearest("tunable policy", policy, tunable)
    table = writable_file(table_path(cls.id, out))
    read_table(table)  # a file that cannot take the values is refused before the work
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
            backend=backend,
        )
    command = f"filtergym tune {importable_name(cls)} --policy {policy} --budget {budget} --seed {seed}"
    path = save_tuned(outcome, command, out)
    console.print(tuned_table(outcome, tunable[policy].start))
    console.print(f"saved in {path}; use it as --policy {policy}-tuned")


def train(
    environment: Environment,
    out: Annotated[Path, typer.Option(help="Folder of the run: record, checkpoint, best agent, log.")],
    algo: Annotated[str, typer.Option(help="ppo, recurrent-ppo, sac, dqn, bptt or kalman-net.")] = "ppo",
    control: Annotated[
        str | None, typer.Option(help="What the agent steers; default: the environment's first.")
    ] = None,
    scenario: TrainingScenario = None,
    steps: Annotated[int | None, typer.Option(help="Environment steps in all.")] = None,
    envs: Annotated[int | None, typer.Option(help="Environments side by side.")] = None,
    seed: Annotated[int, typer.Option(help="Of the training episodes and the network.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
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
        str | None, typer.Option(help="cost, log-likelihood, cost-and-likelihood or relative.")
    ] = None,
) -> None:
    """Train an agent; Ctrl-C or SIGTERM stops it with a checkpoint that --resume goes on from.

    A checkpoint of Stable-Baselines3 can execute code when it is loaded: to resume one also takes --trust. One of bptt
    or kalman-net cannot.

    Settings go before those of --config, and these before the shipped hyperparameters. --resume goes on with the
    settings of the run, and refuses others.

    Example: filtergym train filtergym/ManeuveringTarget-v0 --algo ppo --steps 1000000 --out runs/ppo

    Example: filtergym train filtergym/ManeuveringTarget-v0 --set env.range_sigma=50 --set algo.learning_rate=3e-4 \
    --out runs/precise
    """
    try:
        import torch

        from ..agents import training_run
        from ..agents.settings import THROUGH_THE_FILTER, parsed_settings

        trainer: Any
        if algo in THROUGH_THE_FILTER:
            from ..agents.bptt import train_bptt as trainer
        else:
            from ..agents.sb3_training import train_sb3

            trainer = functools.partial(train_sb3, trust=trust)
    except ImportError as error:
        raise ValueError(
            f"training needs more packages: pip install 'filtergym[agents]' ({error})"
        ) from error
    torch.set_num_threads(1)  # networks this small run slower on more
    keywords, hyperparameters = parsed_settings(set_ or [])
    if reward is not None:
        keywords["reward"] = reward
    run = training_run.new_run(
        environment, algo, control, steps, envs, seed, scenario, hyperparameters, backend, keywords, config
    )
    run = training_run.opened_run(out, run, resume, same=not (keywords or hyperparameters or config))
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


def export(
    folder: Annotated[Path, typer.Argument(help="Folder of a training run.")],
    out: Annotated[Path | None, typer.Option(help="File; default: agent.safetensors in the folder.")] = None,
    trust: Trust = False,
) -> None:
    """Write a run's best agent as plain arrays, which evaluate without torch and cannot execute anything.

    Nothing is executed either: training has left the arrays beside the model. A folder with the model only takes
    --trust.

    Example: filtergym export runs/ppo, then filtergym evaluate ENV --policy runs/ppo/agent.safetensors
    """
    path = out or folder / "agent.safetensors"
    run = export_run(folder, path, trust)
    console.print(f"{run.algorithm} for {run.environment}, control {run.control}: {path}")
