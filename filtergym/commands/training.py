"""The steps of ``filtergym train``: open the runs, train them, and report the standing of their best agents."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ..agents import training_run
from ..agents.settings import THROUGH_THE_FILTER
from ..agents.training_run import RunOptions, TrainingRun, best_agent
from ..agents.training_session import Session
from ..baselines.problem import Problem
from ..evaluation.running.parallel import Workers
from ..reports.tables import standing
from .terminal import console, print_table, progress_bar

Trainer = Callable[[TrainingRun, Session], TrainingRun]
"""Function that trains a run."""


class Training(NamedTuple):
    """A training run with the settings of its session."""

    folder: Path
    """Folder of the run, as the user names it."""
    run: TrainingRun
    session: Session
    """Session in the same folder, with its absolute path."""


def trainer_of(algo: str) -> Trainer:
    """Return the function that trains with an algorithm: ``(run, session) -> run``."""
    try:
        import torch

        if algo in THROUGH_THE_FILTER:
            from ..agents.bptt import train_bptt as trainer
        else:
            from ..agents.sb3_training import train_sb3 as trainer
    except ImportError as error:
        raise ValueError(
            f"training needs more packages: pip install 'filtergym[agents]' ({error})"
        ) from error
    torch.set_num_threads(1)  # networks this small run slower on more
    return trainer


def open_run(problem: Problem, options: RunOptions, session: Session) -> Training:
    """Begin a training run in a folder, or continue the one there; return it with its session.

    Raises:
        ValueError: as of :func:`.training_run.new_run` and :func:`.training_run.open_run`.
    """
    same = not (options.keywords or options.overrides or options.config)
    asked = training_run.new_run(problem, options)
    return _training(training_run.open_run(session.folder, asked, session.resume, same), session)


def open_runs(
    problem: Problem, options: RunOptions, session: Session, seeds: Sequence[int]
) -> list[Training]:
    """Begin or continue a run for each seed, in folders that end with a dash and the seed; return them all.

    The folder of the session is the beginning of the runs' folders.

    Raises:
        ValueError: as of :func:`open_run`, and for a checkpoint that can execute code and is not trusted.
    """
    found = []
    for seed in seeds:
        folder = session.folder.with_name(f"{session.folder.name}-{seed}")
        begun = training_run.has_run(folder)
        asked = training_run.new_run(problem, replace(options, seed=seed))
        run = training_run.open_run(folder, asked, begun)
        if begun and not run.is_complete and options.algorithm not in THROUGH_THE_FILTER:
            training_run.check_trust(
                f"{folder} continues from a checkpoint that is loaded with pickle", session.trust
            )
        found.append(_training(run, replace(session, folder=folder, resume=begun)))
    return found


def _training(run: TrainingRun, session: Session) -> Training:
    # Another process may have another working directory.
    return Training(session.folder, run, replace(session, folder=session.folder.absolute()))


def train_runs(trainings: Sequence[Training], trainer: Trainer, workers: Workers) -> list[TrainingRun]:
    """Train the unfinished runs of one algorithm with its ``trainer``; return the final state of all runs."""
    waiting = []
    for training in trainings:
        if training.session.resume and training.run.is_complete:
            console.print(f"{training.folder} is finished: {training.run.steps_done:,} steps")
        else:
            waiting.append(training)
    if workers.alone:
        _train_one_by_one(waiting, trainer)
        return [training.run for training in trainings]
    trained = _train_side_by_side(waiting, workers)
    return [trained.get(training.folder, training.run) for training in trainings]


def _train_one_by_one(waiting: Sequence[Training], trainer: Trainer) -> None:
    for training in waiting:
        _train_here(training, trainer)
        if not training.run.is_complete:
            return


def _train_here(training: Training, trainer: Trainer) -> None:
    folder, run, session = training
    console.print(f"{folder}: seed {run.seed}")
    with progress_bar() as bar:
        line = bar.add_task(f"training {run.algorithm}", total=run.steps)
        shown = replace(
            session,
            progress=lambda done: bar.update(line, completed=done),
            report=lambda text: console.print(text, highlight=False, soft_wrap=True),
        )
        trainer(run, shown)
    _print_done(folder, run)


def _train_side_by_side(waiting: Sequence[Training], workers: Workers) -> dict[Path, TrainingRun]:
    """Train runs in parallel processes; return those that have begun by their folders, and print their reports."""
    found = {}
    sizes = [training.run.steps for training in waiting]
    with progress_bar() as bar:
        line = bar.add_task("training", total=sum(sizes))
        for i, lines in workers.run(_train, waiting, sizes, lambda done: bar.update(line, advance=done)):
            folder, _, session = waiting[i]
            if not training_run.has_run(folder):
                raise ValueError(
                    f"{folder} is not here: the machines of a cluster must share the folder of a run"
                )
            run = found[folder] = training_run.load_run(folder, session.trust)
            console.print(f"{folder}: seed {run.seed}")
            for text in lines:
                console.print(text, highlight=False, soft_wrap=True)
            _print_done(folder, run)
    return found


def _train(training: Training, tick: Any) -> list[str]:
    """Train a run in a separate process, and return the sentences that it reports."""
    lines: list[str] = []
    _, run, session = training
    trainer_of(run.algorithm)(run, replace(session, report=lines.append))
    return lines


def _print_done(folder: Path, run: TrainingRun) -> None:
    console.print(f"{run.steps_done:,} steps done; best agent in {folder / 'best'}, checkpoint beside it")


def print_standing(trainings: Sequence[Training], runs: Sequence[TrainingRun]) -> None:
    """Print how the best agents of runs that differ in their seed compare with untrained competitors."""
    agents = [best_agent(training.folder) for training in trainings]
    trust = trainings[0].session.trust
    if any(agent.suffix != ".safetensors" for agent in agents) and not trust:
        console.print("an agent that is not stored as plain arrays is compared with --trust only")
        return
    names = [str(training.folder) for training in trainings]
    found = standing.measure_standing(runs[0], dict(zip(names, agents, strict=True)), trust)
    print_table(
        standing.standing_table(found, {name: run.beat_paper for name, run in zip(names, runs, strict=True)})
    )
