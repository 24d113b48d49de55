"""Training runs of all algorithms: their options, their record and their folder.

A run's folder holds ``run.json`` (command, versions, seeds, duration, validation), ``checkpoint/`` (the last one, with
the ``run.json`` of its time, from which ``--resume`` continues), ``best/`` (the agent with the lowest validation cost)
and the log.
"""

import functools
import json
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from ..baselines.problem import Problem, problem_of
from ..envs.contract.companions import trained_banks
from ..envs.contract.model import Model
from ..envs.contract.parameters import check_integer
from ..envs.contract.task import Task
from ..envs.engine.backend import make_model
from ..envs.engine.catalogue import (
    catalogue,
    import_task,
    importable_name,
    nearest,
    parameter_names,
    task_class,
)
from ..envs.engine.reward import REWARDS
from ..envs.engine.scenario_choice import find_mixture, find_scenario
from ..envs.interface.requests import DTYPES
from ..evaluation.storage.code import library_versions
from ..evaluation.storage.files import (
    claim_folder,
    find_folder,
    settle_folder,
    writable_folder,
    write_text,
)
from ..evaluation.storage.stored import read_json, restore
from .gate import Gate
from .residual import policy_to_correct
from .settings import (
    ESTIMATORS,
    OPTIONS,
    RIVALS,
    THROUGH_THE_FILTER,
    check_hyperparameters,
    check_keywords,
    merge_settings,
    read_config,
)

FILES = {
    "ppo": "ppo",
    "recurrent-ppo": "ppo_lstm",
    "sac": "sac",
    "dqn": "dqn",
    "bptt": "bptt",
    "bptt-linear": "bptt_linear",
    "bptt-small": "bptt_small",
    "bptt-strongest": "bptt_strongest",
    "kalman-net": "kalman_net",
    "student": "student",
    "ma-ukf": "ma_ukf",
    "rl-ukf": "rl_ukf",
}
"""Algorithms and the files of their hyperparameters, which have rl-zoo3's names."""
LIBRARIES = ("filtergym", "numpy", "torch", "gymnasium", "stable_baselines3", "sb3_contrib")
"""Libraries that a run's result depends on; the run stores the versions of the installed ones."""


class ValidationEntry(TypedDict):
    """One validation of a training run: step, cost, and difference to the paper's algorithm."""

    steps: int
    cost: float
    paper: NotRequired[str]
    """Name of the paper's algorithm, where there is one."""
    paper_cost: NotRequired[float]
    relative_cost_difference: NotRequired[list[float]]
    """Relative cost difference to the paper's algorithm, and its 95 % interval."""


class FirstWin(TypedDict):
    """Steps and time until an agent was first better than the paper's algorithm."""

    steps: int
    seconds: float
    """Time from the creation of the environments to that validation, in s, including validations."""


@dataclass
class TrainingRun:
    """Record of a training run: its settings, versions, progress and validations; the content of ``run.json``."""

    environment: str
    control: str
    scenario: str
    """Name of the scenario, or a mixture in words, ``random:0.8,paper:0.2``."""
    algorithm: str
    seed: int
    envs: int
    steps: int
    """Requested environment steps."""
    hyperparameters: dict[str, Any]
    """Hyperparameters, with keywords of the environment in ``env_kwargs``, as in rl-zoo3's form."""
    backend: str = "auto"
    """Backend of the environments: the requested one, and the actual one once they exist."""
    command: str = ""
    steps_done: int = 0
    seconds: float = 0.0
    """Time spent in all sessions, in s."""
    versions: dict[str, str] = field(default_factory=dict)
    validation: list[ValidationEntry] = field(default_factory=list)
    exported: dict[str, Any] | None = None
    """Cost of the exported agent on the first episodes of the validation split, which any machine can reproduce."""
    interface: int = 1
    """Interface number of the environment when the run began, see :class:`~..envs.task.Task`."""
    residual_to: str = ""
    """Name of the policy that the agent corrects; empty: none."""
    gated: bool = False
    """Whether the agent acts behind a gate, see :mod:`.gate`."""
    beat_paper: FirstWin | None = None
    """The first validation whose relative cost difference to the paper's algorithm has an interval below zero."""

    @functools.cached_property
    def problem(self) -> Problem:
        """Problem (task and baselines) of the run's environment."""
        return problem_of(self.environment)

    @property
    def task_keywords(self) -> dict[str, Any]:
        """Task parameters of the run, without keywords of the training alone, such as the reward."""
        known = parameter_names(self.problem.task)
        return {n: value for n, value in self.hyperparameters.get("env_kwargs", {}).items() if n in known}

    def make_model(self, scenario: str | None = None) -> Model:
        """Return the model of the training in one of its scenarios; None: the environment's default one."""
        return make_model(self.problem.task, self.control, scenario, **self.task_keywords)

    @property
    def is_complete(self) -> bool:
        """Whether all requested environment steps are done."""
        return self.steps_done >= self.steps

    @property
    def best(self) -> ValidationEntry | None:
        """Validation with the lowest cost so far; None before the first one."""
        return min(self.validation, key=lambda entry: entry["cost"], default=None)


@dataclass(frozen=True)
class RunOptions:
    """A user's options of a training run; options that are None come from the algorithm's hyperparameters."""

    algorithm: str
    """Name of the algorithm, one of ``FILES``."""
    control: str | None = None
    """Control of the agent; None: that of the settings, or the environment's first."""
    steps: int | None = None
    """Total environment steps."""
    envs: int | None = None
    """Number of parallel environments."""
    seed: int = 0
    """Seed of the episodes and the network."""
    scenario: Any = None
    """A training scenario, or a mixture of such."""
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """Hyperparameters that override those of the files."""
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of the environment (parameters, ``reward`` or ``dtype``) that override those of the files."""
    config: Path | None = None
    """File of settings, see :func:`.settings.read_config`; it overrides the shipped file."""
    backend: str = "auto"
    """Backend of the environments."""
    residual_to: str = ""
    """Name of one of the environment's own policies, to whose actions the agent's are added; the default control is
    then that policy's.
    """
    gated: bool = False
    """Whether the agent acts behind a gate, see :mod:`.gate`."""


def new_run(problem: Problem, options: RunOptions) -> TrainingRun:
    """Return the record of a new training run, from a user's options and the hyperparameters in files.

    Raises:
        ValueError: for an unknown name, a value out of its limits, a scenario that is held out, or an agent that cannot
            correct that policy or act behind a gate.
    """
    cls, algorithm = problem.task, options.algorithm
    if algorithm not in FILES:
        raise nearest("algorithm", algorithm, FILES)
    values, own_keywords = _merge_settings(problem, options)
    of_environment = merge_settings(values.get("env_kwargs", {}), own_keywords)
    named = {name: of_environment.pop(name, None) for name in OPTIONS}
    control = options.control
    if options.residual_to and control is None and "control" not in own_keywords:
        # Overrides the shipped file, which is independent of that policy.
        control = getattr(problem.competitor(options.residual_to), "control", None)
    control = named["control"] if control is None else control
    controls = controls_of(cls, algorithm)
    if control is not None and control not in controls:
        raise nearest("control", control, controls)
    backend = options.backend
    if backend == "auto" and named["backend"] is not None:
        backend = named["backend"]
    flown = training_scenarios(cls, named["scenario"] if options.scenario is None else options.scenario)
    _check_environment(problem, options, control, flown, of_environment)
    if of_environment or "env_kwargs" in values:
        values["env_kwargs"] = of_environment
    default_envs, default_steps = (_as_integer(values.pop(name)) for name in ("n_envs", "n_timesteps"))
    envs = check_integer("envs", default_envs if options.envs is None else options.envs, 1)
    steps = check_integer("steps", default_steps if options.steps is None else options.steps, 1)
    return TrainingRun(
        problem.name,
        control or controls[0],
        scenario_text(flown),
        algorithm,
        check_integer("seed", options.seed, 0),
        envs,
        steps,
        values,
        backend,
        interface=cls.interface,
        residual_to=options.residual_to,
        gated=options.gated,
    )


def _merge_settings(problem: Problem, options: RunOptions) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a run's hyperparameters and the user's keywords of the environment, merged from all sources."""
    shipped = read_hyperparameters(problem.id, options.algorithm)
    keywords, values = ({}, {}) if options.config is None else read_config(options.config, problem.id)
    keywords, values = merge_settings(keywords, options.keywords), merge_settings(values, options.overrides)
    check_keywords(problem.task, options.algorithm, keywords)
    every = merge_settings(shipped, values)
    if values:
        check_hyperparameters(options.algorithm, every, shipped)
    return every, keywords


def _check_environment(
    problem: Problem,
    options: RunOptions,
    control: str | None,
    scenarios: Mapping[str, float],
    keywords: Mapping[str, Any],
) -> None:
    """Raise ValueError if the environment of a run cannot be made with its keywords in all scenarios."""
    known = parameter_names(problem.task)
    parameters = {name: value for name, value in keywords.items() if name in known}
    models = [make_model(problem.task, control, name, **parameters) for name in scenarios]
    if options.residual_to or options.gated:
        _check_residual_and_gate(options, models)
    for name, words in (("reward", REWARDS), ("dtype", DTYPES)):
        if name in keywords and keywords[name] not in words:
            raise nearest(name, keywords[name], words)


def _as_integer(value: Any) -> Any:
    """Return a float without fraction as an integer, since files contain 1e6; other values unchanged."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _check_residual_and_gate(options: RunOptions, models: Sequence[Model]) -> None:
    """Raise ValueError if the agent of a run cannot correct its policy, or act behind its gate."""
    algorithm, residual_to = options.algorithm, options.residual_to
    if len(models) > 1:
        raise ValueError(
            "a policy to correct and a gate are made for the parameters of one scenario: train on one, not on a mixture"
        )
    if algorithm in ESTIMATORS:
        raise ValueError(
            f"algorithm {algorithm!r} trains an estimator, which corrects no policy and has no gate"
        )
    if residual_to and algorithm in THROUGH_THE_FILTER:
        raise ValueError(
            f"algorithm {algorithm!r} has no gradient of the policy that would be corrected: "
            "choose ppo, recurrent-ppo or sac"
        )
    corrected = policy_to_correct(models[0], residual_to) if residual_to else None
    if options.gated:
        Gate(models[0], corrected)


def controls_of(cls: type[Task], algorithm: str) -> tuple[str, ...]:
    """Return the names of the controls that an algorithm can train, or the bank of a learned estimator.

    Raises:
        ValueError: if the environment has no filter for the algorithm.
    """
    if algorithm not in ESTIMATORS and algorithm not in RIVALS:
        return cls.controls
    own = read_hyperparameters(cls.id, algorithm)["env_kwargs"]["control"] if algorithm in RIVALS else None
    if own in cls.controls:
        return (own,)
    if algorithm not in trained_banks(cls):
        having = [c.id for c in catalogue().values() if algorithm in trained_banks(c) or own in c.controls]
        raise ValueError(
            f"{cls.id} has no filter for algorithm {algorithm!r}: choose another algorithm, or {', '.join(having)}"
        )
    return (algorithm,)


def training_scenarios(cls: type[Task], scenario: Any) -> dict[str, float]:
    """Return the weight of each scenario of a run, by name.

    Raises:
        ValueError: for an unknown scenario, or one that is held out, alone or in a mixture.
    """
    mixture = find_mixture(cls, scenario)
    weights = {find_scenario(cls, scenario).name: 1.0} if mixture is None else mixture
    for name in weights:
        if name not in cls.scenarios or not cls.scenarios[name].training:
            allowed = [s.name for s in cls.scenarios.values() if s.training]
            raise ValueError(
                f"scenario {name!r} is held out: train on a training scenario ({', '.join(allowed)})"
            )
    return weights


def scenario_text(weights: Mapping[str, float]) -> str:
    """Return weights of scenarios as text, such as ``random:0.8,paper:0.2``; of one scenario its name alone."""
    if len(weights) == 1:
        return next(iter(weights))
    return ",".join(f"{name}:{weight!r}" for name, weight in weights.items())


def read_hyperparameters(id: str, algorithm: str) -> dict[str, Any]:
    """Return the shipped hyperparameters of an algorithm for an environment, by name; else the default ones.

    A file that is ``based_on`` another algorithm's contains only the differences, by default and for an environment.
    """
    import yaml

    file: Any = files(__name__.rpartition(".")[0]).joinpath("hyperparameters", f"{FILES[algorithm]}.yml")
    table = yaml.safe_load(file.read_text(encoding="utf-8"))
    if "based_on" not in table:
        return dict(table.get(id, table["default"]))
    based = merge_settings(read_hyperparameters(id, table["based_on"]), table["default"])
    return merge_settings(based, table.get(id, {}))


def schedule(name: str, value: float | str) -> Callable[[float], float]:
    """Return a hyperparameter's value as a function of the remaining share of the run, from 1 to 0.

    Args:
        name: its name, such as ``learning_rate``.
        value: a constant, or in rl-zoo3's form "lin_0.001": from there linearly to zero.

    Raises:
        ValueError: for another form.
    """
    from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule

    text = str(value)
    try:
        start = float(text.removeprefix("lin_"))
    except ValueError as error:
        raise ValueError(f"{name} must be a number or lin_ and a number, got {value!r}") from error
    return LinearSchedule(start, 0.0, 1.0) if text.startswith("lin_") else ConstantSchedule(start)


def check_trust(what: str, trust: bool) -> None:
    """Raise ValueError if a file or module that can execute code is not trusted."""
    if not trust:
        raise ValueError(
            f"{what}, which can execute code: if you made it or know who did, add --trust (in Python: trust=True)"
        )


def save_run(run: TrainingRun, path: Path) -> None:
    """Write a training run's record to a file, whole or not at all."""
    write_text(path, json.dumps(asdict(run), indent=1) + "\n")


def load_run(folder: Path, trust: bool = False) -> TrainingRun:
    """Return the record of a run, read from ``run.json`` of its folder.

    Args:
        folder: folder of the run.
        trust: import the module that registers the environment, which executes it. An environment of filtergym, or one
            whose module is already imported, such as one that the command line names, needs no trust.

    Raises:
        ValueError: if the file is missing, is not a run's record, or its environment needs ``trust``.
    """
    path = folder / "run.json"
    try:
        values = read_json(path)
    except FileNotFoundError as error:
        raise ValueError(f"no training run in {folder}: it has no run.json") from error
    try:
        run = restore(TrainingRun, values)
    except ValueError as error:
        raise ValueError(f"{path} is not the record of a run: {error}") from error
    module, colon, _ = run.environment.partition(":")
    if not colon:
        return run
    if module not in sys.modules:
        check_trust(f"{path} imports module {module!r}", trust)
        import_task(run.environment)
    return replace(run, environment=importable_name(task_class(run.environment)))


def best_agent(folder: Path) -> Path:
    """Return the file of a run's agent with the lowest validation cost, in the form that an evaluation reads.

    Raises:
        ValueError: if the run has not been validated yet.
    """
    best = find_folder(folder / "best")
    for name in ("agent.safetensors", "model.zip"):
        if (best / name).is_file():
            return best / name
    raise ValueError(f"{folder} has no best agent yet: train it up to its first validation")


def resume_run(folder: Path, requested: TrainingRun, same: bool = False) -> TrainingRun:
    """Return the run of a folder, to be continued to the requested steps; repair folders that a crash left.

    Args:
        folder: folder of the run.
        requested: the run that the user describes.
        same: keep the run's own hyperparameters, as the user gives none.

    Raises:
        ValueError: if the folder contains a different run.
    """
    checkpoint = folder / "checkpoint"
    for place in (checkpoint, folder / "best"):
        settle_folder(place)
    # A crash between the two writes leaves a checkpoint that is newer than the folder's record: its own record counts.
    own = (checkpoint / "run.json").exists()
    try:
        run = load_run(checkpoint if own else folder)
    except ValueError as error:
        if own:
            raise ValueError(f"cannot read the checkpoint in {checkpoint}: {error}") from error
        raise
    compared = (
        "environment",
        "interface",
        "control",
        "scenario",
        "algorithm",
        "seed",
        "envs",
        "hyperparameters",
        "residual_to",
        "gated",
    )
    for name in compared:
        has, wanted = (
            getattr(run, name),
            getattr(run if same and name == "hyperparameters" else requested, name),
        )
        while isinstance(has, dict) and isinstance(wanted, dict) and has != wanted:
            inside = next(n for n in {**has, **wanted} if has.get(n) != wanted.get(n))
            name, has, wanted = f"{name}.{inside}", has.get(inside), wanted.get(inside)
        if has != wanted:
            raise ValueError(f"{folder} contains a run with {name} {has!r}, not {wanted!r}")
    if not checkpoint.is_dir():
        raise ValueError(f"{folder} has no checkpoint to resume from")
    if not (folder / "run.json").exists() or load_run(folder) != run:
        save_run(run, folder / "run.json")
    run.steps = requested.steps
    if requested.backend != "auto":
        run.backend = requested.backend
    return run


def has_run(folder: Path) -> bool:
    """Return whether a folder contains a training run with at least one checkpoint."""
    return (folder / "run.json").exists() or find_folder(folder / "checkpoint").exists()


def open_run(folder: Path, requested: TrainingRun, resume: bool, same: bool = False) -> TrainingRun:
    """Begin a run in a folder or continue the one there, and return its record with command and versions.

    Arguments are those of :func:`resume_run`; ``resume`` continues the run of the folder.

    Raises:
        ValueError: if the folder cannot be written to, or contains a run that is not to be resumed or a different one.
    """
    if not resume and has_run(folder):
        raise ValueError(
            f"{folder} contains a training run: add --resume to continue it, or choose another folder"
        )
    if resume and folder.is_dir():
        claim_folder(folder)  # before anything in it is repaired
    run = resume_run(folder, requested, same) if resume else requested
    writable_folder(folder)
    run.command = " ".join(
        [
            f"filtergym train {run.environment} --algo {run.algorithm} --control {run.control} "
            f"--scenario {run.scenario} --steps {run.steps} --envs {run.envs} --seed {run.seed}",
            *([f"--residual-to {run.residual_to}"] if run.residual_to else []),
            *(["--gated"] if run.gated else []),
            *_settings_as_options(run),
        ]
    )
    run.versions = library_versions(LIBRARIES)
    return run


def _settings_as_options(run: TrainingRun) -> Iterator[str]:
    def differing(path: str, own: Any, shipped: Any) -> Iterator[str]:
        if isinstance(own, dict):
            for name, value in own.items():
                yield from differing(
                    f"{path}.{name}", value, shipped.get(name) if isinstance(shipped, dict) else None
                )
        elif own != shipped:
            yield "--set " + shlex.quote(f"{path}={json.dumps(own)}")

    shipped = read_hyperparameters(run.problem.id, run.algorithm)
    values = dict(run.hyperparameters)
    yield from differing("env", values.pop("env_kwargs", {}), shipped.pop("env_kwargs", {}))
    yield from differing("algo", values, shipped)
