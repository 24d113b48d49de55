"""Search for hyperparameters with Optuna, each trial a training run that is judged by its validations.

A trial trains one run for every seed, always the same seeds, and its value is the mean over them of the lowest
validation cost, which is that of the agents it would keep. Trials that fall behind the median of the others at the same
share of their steps are pruned. What is searched stands in ``search_spaces/``, one file for an algorithm, in sections
by environment id or ``default``:

* a list: one of these;
* ``{low: , high: }``: a number between; whole if both are, ``log: true`` for a logarithmic scale, ``prefix: lin_`` for
  a learning rate that falls to zero;
* any other mapping: settings inside one, such as ``policy_kwargs``.

The folder of a search holds ``journal.log`` (Optuna's storage), ``trial-N/seed-M`` (the runs as ``filtergym train``
leaves them, without checkpoints) and ``best.yml``, the best settings as ``filtergym train --config`` takes them.
"""

import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import optuna
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from ..baselines.problem import Problem
from ..envs.contract.parameters import check_integer
from ..evaluation.storage.code import code_digest
from ..evaluation.storage.files import writable_folder, write_text
from .settings import merge_settings, read_section
from .training_run import FILES, RunOptions, TrainingRun, ValidationEntry, load_run, new_run, open_run
from .training_session import Session

VALIDATIONS = 5
"""Of each run, after which a trial may be pruned."""
STARTUP_TRIALS = 8
"""Trials that are drawn at random, and not pruned, before the others are learned from."""
RANGE = {"low", "high", "log", "prefix"}


@dataclass(frozen=True)
class Search:
    """What is searched, all of which a search that is resumed must agree with."""

    problem: Problem
    options: RunOptions
    """Of every run; its hyperparameters stay as they are."""
    steps: int
    """Environment steps of each run."""
    seeds: tuple[int, ...]
    """Of the runs of each trial."""
    space: Mapping[str, Any]
    """Hyperparameters that are searched."""
    sampling: int
    """Seed of the sampler."""

    def run(self, seed: int, chosen: Mapping[str, Any]) -> TrainingRun:
        """Describe a run with chosen hyperparameters.

        Raises:
            ValueError: for what :func:`~.training_run.new_run` refuses.
        """
        overrides = merge_settings(self.options.overrides, chosen)
        return new_run(self.problem, replace(self.options, steps=self.steps, seed=seed, overrides=overrides))

    def as_json(self) -> dict[str, Any]:
        """Return all that it depends on, as a file holds it."""
        options = self.options
        values = {
            "environment": self.problem.name,
            "algorithm": options.algorithm,
            "control": options.control,
            "scenario": options.scenario,
            "steps": self.steps,
            "seeds": self.seeds,
            "keywords": dict(options.keywords),
            "overrides": dict(options.overrides),
            "space": dict(self.space),
            "sampling": self.sampling,
        }
        found: dict[str, Any] = json.loads(json.dumps(values))
        return found


def read_space(id: str, algorithm: str, path: Path | None = None) -> dict[str, Any]:
    """Return the hyperparameters that are searched, from a file of one's own or the one that is shipped.

    Raises:
        ValueError: if there is none for the algorithm, or the file cannot be read or is of another form.
    """
    shipped = files(__package__).joinpath("search_spaces", f"{FILES[algorithm]}.yml")
    if path is None and not shipped.is_file():
        raise ValueError(f"no search space of {algorithm} is shipped: write one and name it by --space")
    space = read_section(path or Path(str(shipped)), id)
    _check_space(space, "")
    return space


def _check_space(space: Any, path: str) -> None:
    """Raise ValueError if a space is not of the form that the module describes."""
    if isinstance(space, list) and space:
        return
    if not isinstance(space, dict) or not space:
        raise ValueError(
            f"search space of {path or 'hyperparameters'}: expected a list or a mapping, got {space!r}"
        )
    if "low" not in space and "high" not in space:
        for name, inner in space.items():
            _check_space(inner, f"{path}.{name}" if path else str(name))
        return
    ends = [space.get(name) for name in ("low", "high")]
    numbers = [end for end in ends if isinstance(end, int | float) and not isinstance(end, bool)]
    ascending = len(numbers) == 2 and numbers[0] < numbers[1] and (numbers[0] > 0 or not space.get("log"))
    if space.keys() - RANGE or not ascending:
        raise ValueError(
            f"search space of {path}: a range has low and high, low below high, and may have log and prefix; got "
            f"{space!r}"
        )


def suggest_hyperparameters(
    trial: optuna.Trial, space: Mapping[str, Any], inside: str = ""
) -> dict[str, Any]:
    """Return hyperparameters of a trial, drawn from a space."""
    found: dict[str, Any] = {}
    for name, choice in space.items():
        path = f"{inside}{name}"
        if isinstance(choice, list):
            # As text: what is chosen from may be lists, which a storage does not hold.
            found[name] = json.loads(trial.suggest_categorical(path, [json.dumps(value) for value in choice]))
        elif "low" not in choice:
            found[name] = suggest_hyperparameters(trial, choice, f"{path}.")
        else:
            low, high, log = choice["low"], choice["high"], bool(choice.get("log"))
            if isinstance(low, int) and isinstance(high, int):
                value: float = trial.suggest_int(path, low, high, log=log)
            else:
                value = float(f"{trial.suggest_float(path, low, high, log=log):.4g}")
            found[name] = f"{choice['prefix']}{value!r}" if "prefix" in choice else value
    return found


def open_study(search: Search, folder: Path) -> optuna.Study:
    """Begin a search in a folder, or go on with the one that is there.

    Raises:
        ValueError: if the folder holds a search for something else.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    writable_folder(folder).mkdir(parents=True, exist_ok=True)
    storage = optuna.storages.JournalStorage(JournalFileBackend(str(folder / "journal.log")))
    pruner = optuna.pruners.MedianPruner(n_startup_trials=STARTUP_TRIALS)
    study = optuna.create_study(study_name="filtergym", storage=storage, pruner=pruner, load_if_exists=True)
    asked = {**search.as_json(), "code": code_digest()}
    has = study.user_attrs.get("search", asked)
    for name, wanted in asked.items():
        if has.get(name) != wanted:
            raise ValueError(
                f"{folder} holds a search with {name} {has.get(name)!r}, not {wanted!r}: choose another folder"
            )
    study.set_user_attr("search", asked)
    return study


def finished_trials(study: optuna.Study) -> list[Any]:
    """Trials that came to an end, pruned ones and failed ones among them; not what was interrupted."""
    return [trial for trial in study.get_trials(deepcopy=False) if trial.user_attrs.get("ended")]


def search_hyperparameters(
    search: Search,
    folder: Path,
    trials: int,
    train: Callable[[TrainingRun, Session], TrainingRun],
    progress: Callable[[int], None] = lambda trials: None,
    report: Callable[[str], None] = lambda line: None,
) -> optuna.Study:
    """Try hyperparameters until there are as many trials, or somebody presses Ctrl-C or sends SIGTERM.

    A trial depends on the search and on the trials before it only: a search that was interrupted and resumed equals one
    that never was. What is lost is the trial under way.

    Args:
        search: what is searched.
        folder: of the search.
        trials: in all, those before an interruption included.
        train: :func:`~.sb3_training.train_sb3` or :func:`~.bptt.train_bptt`.
        progress: told the number of trials done.
        report: told of every trial in words.

    Raises:
        ValueError: for no trials, a folder that holds another search, or settings that cannot be trained with.
    """
    check_integer("trials", trials, 1)
    study = open_study(search, folder)
    for left in study.get_trials(deepcopy=False):
        if not left.state.is_finished():  # by a crash
            study.tell(left.number, state=TrialState.FAIL)
    while (done := len(finished_trials(study))) < trials:
        progress(done)
        study.sampler = optuna.samplers.TPESampler(
            n_startup_trials=STARTUP_TRIALS, seed=1_000_003 * search.sampling + done
        )
        trial = study.ask()
        chosen = suggest_hyperparameters(trial, search.space)
        try:
            costs = _costs(search, folder, trial, chosen, train)
        except optuna.TrialPruned as reason:
            ended, words = TrialState.PRUNED, str(reason)
        except ValueError as error:
            if not any(other.state == TrialState.COMPLETE for other in finished_trials(study)):
                study.tell(trial, state=TrialState.FAIL)
                raise  # nothing has worked yet: rather the settings are to blame than what was drawn
            ended, words = TrialState.PRUNED, f"failed, {error}"
        else:
            if len(costs) < len(search.seeds):  # somebody wished to stop
                study.tell(trial, state=TrialState.FAIL)
                break
            ended, words = TrialState.COMPLETE, f"validation cost {_mean(costs):.4g}"
        trial.set_user_attr("ended", True)
        study.tell(trial, _mean(costs) if ended == TrialState.COMPLETE else None, ended)
        report(f"trial {trial.number}: {words}; {json.dumps(chosen)}")
        write_best(search, folder, study)
    progress(len(finished_trials(study)))
    return study


def _mean(costs: Sequence[float]) -> float:
    return sum(costs) / len(costs)


def _costs(
    search: Search,
    folder: Path,
    trial: optuna.Trial,
    chosen: Mapping[str, Any],
    train: Callable[[TrainingRun, Session], TrainingRun],
) -> list[float]:
    """Train the runs of a trial; return the lowest validation cost of each, of fewer if somebody wished to stop.

    Raises:
        optuna.TrialPruned: if the trial falls behind the others.
        ValueError: if it cannot be trained with what was chosen.
    """
    costs: list[float] = []
    for seed in search.seeds:
        place = run_folder(folder, trial.number, seed)
        shutil.rmtree(place, ignore_errors=True)
        run = open_run(place, search.run(seed, chosen), resume=False)
        lowest, last_share = math.inf, -1
        behind = False

        def report_validation(entry: ValidationEntry) -> bool:
            nonlocal lowest, last_share, behind
            lowest = min(lowest, entry["cost"])
            # Rollouts differ in length, so trials are compared at the same share of their steps.
            share = min(VALIDATIONS, entry["steps"] * VALIDATIONS // search.steps)
            if share > last_share:
                last_share = share
                trial.report(_mean([*costs, lowest]), len(costs) * (VALIDATIONS + 1) + share)
                behind = entry["steps"] < search.steps and trial.should_prune()
            return behind

        train(
            run,
            Session(place, validate_every=max(1, search.steps // VALIDATIONS), validated=report_validation),
        )
        # Nobody resumes it, and replay buffers are large.
        shutil.rmtree(place / "checkpoint", ignore_errors=True)
        if behind:
            raise optuna.TrialPruned(f"pruned after {run.steps_done:,} steps of seed {seed}")
        if not run.is_complete:
            break
        costs.append(lowest)
    return costs


def run_folder(folder: Path, trial: int, seed: int) -> Path:
    """Folder of a trial's run."""
    return folder / f"trial-{trial}" / f"seed-{seed}"


def write_best(search: Search, folder: Path, study: optuna.Study) -> None:
    """Write the best trial's settings as ``filtergym train --config`` takes them; nothing where all were pruned."""
    import yaml

    if not any(trial.state == TrialState.COMPLETE for trial in finished_trials(study)):
        return
    best = study.best_trial
    run = load_run(run_folder(folder, best.number, search.seeds[0]))
    values = dict(run.hyperparameters)
    of_environment = {"control": run.control, "scenario": run.scenario, **values.pop("env_kwargs", {})}
    section = {"n_envs": run.envs, "n_timesteps": run.steps, **values, "env_kwargs": of_environment}
    seeds = ", ".join(map(str, search.seeds))
    text = (
        f"# Hyperparameters of {search.options.algorithm}: trial {best.number}, the best of "
        f"{len(finished_trials(study))}.\n"
        f"# Lowest validation cost, mean over the training seeds {seeds}: {best.value:.6g}\n"
    )
    own = {search.problem.id: section}
    write_text(folder / "best.yml", text + yaml.safe_dump(own, sort_keys=False))
