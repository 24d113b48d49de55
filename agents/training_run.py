"""What every training run has, whatever the algorithm: its folder, its record, and its validation.

A run's folder holds ``run.json`` (command, versions, seeds, duration, validation), ``checkpoint/`` (the last
one, from which ``--resume`` goes on, with the ``run.json`` of its time), ``best/`` (the agent with the lowest
validation cost) and the log.
"""

import copy
import functools
import importlib.metadata
import importlib.util
import json
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, NotRequired, TypedDict

import numpy

from ..baselines.problem import Problem, problem_of
from ..envs.contract.model import Episode, Model
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
from ..evaluation.competitors.kinds import kind_of
from ..evaluation.running.rollout import run_competitor
from ..evaluation.running.seeds import episode_seeds
from ..evaluation.statistics.bootstrap import Bootstrap
from ..evaluation.storage.files import (
    claim_folder,
    find_folder,
    settle_folder,
    whole_folder,
    writable_folder,
    write_text,
)
from ..evaluation.storage.stored import read_json, restore
from .gate import Gate
from .residual import policy_to_correct
from .settings import (
    ESTIMATORS,
    OPTIONS,
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
    "kalman-net": "kalman_net",
}
"""Algorithms and the files of their hyperparameters, which have rl-zoo3's names."""
VALIDATION_EPISODES = 512


class ValidationEntry(TypedDict):
    """One validation of a run."""

    steps: int
    cost: float
    paper: NotRequired[str]
    """Name of the paper's algorithm, where there is one."""
    paper_cost: NotRequired[float]
    relative_cost_difference: NotRequired[list[float]]
    """Value and 95 % interval."""


class Passed(TypedDict):
    """When an agent was first better than the paper's algorithm."""

    steps: int
    seconds: float
    """Time spent till then, from the making of the environments on, validations included."""


@dataclass
class TrainingRun:
    """The content of ``run.json``."""

    environment: str
    control: str
    scenario: str
    """A name, or a mixture in words, ``random:0.8,paper:0.2``."""
    algorithm: str
    seed: int
    envs: int
    steps: int
    """Environment steps asked for."""
    hyperparameters: dict[str, Any]
    """With keywords of the environment in ``env_kwargs``, as in rl-zoo3's form."""
    backend: str = "auto"
    """What computes the steps of the environments: as asked for, and once they are made what does."""
    command: str = ""
    steps_done: int = 0
    seconds: float = 0.0
    """Time spent, over all sessions."""
    versions: dict[str, str] = field(default_factory=dict)
    validation: list[ValidationEntry] = field(default_factory=list)
    exported: dict[str, Any] | None = None
    """Cost of the exported agent on the first episodes of the validation split, to be checked anywhere."""
    interface: int = 1
    """Of the environment when the run began, see :class:`~..envs.task.Task`."""
    residual_to: str = ""
    """Name of the policy that the agent corrects; none if empty."""
    gated: bool = False
    """Whether the agent acts only where something is wrong, see :mod:`.gate`."""
    beat_paper: Passed | None = None
    """The first validation whose cost is below that of the paper's algorithm with its whole interval."""

    @functools.cached_property
    def problem(self) -> Problem:
        """Of its environment."""
        return problem_of(self.environment)

    @property
    def task_keywords(self) -> dict[str, Any]:
        """Parameters of the task, without what concerns training only, such as the reward."""
        known = parameter_names(self.problem.task)
        return {n: value for n, value in self.hyperparameters.get("env_kwargs", {}).items() if n in known}

    def make_model(self, scenario: str | None = None) -> Model:
        """Make the model that is trained on, in one of its scenarios."""
        return make_model(self.problem.task, self.control, scenario, **self.task_keywords)

    @property
    def is_complete(self) -> bool:
        """Whether all steps asked for are done."""
        return self.steps_done >= self.steps

    @property
    def best(self) -> ValidationEntry | None:
        """The validation with the lowest cost."""
        return min(self.validation, key=lambda entry: entry["cost"], default=None)


@dataclass(frozen=True)
class RunOptions:
    """What somebody asks of a run; what is left out comes from the algorithm's hyperparameters."""

    algorithm: str
    """One of ``FILES``."""
    control: str | None = None
    """What the agent steers; None: that of the settings, or the environment's first."""
    steps: int | None = None
    """Environment steps in all."""
    envs: int | None = None
    """Environments side by side."""
    seed: int = 0
    """Of the episodes and the network."""
    scenario: Any = None
    """A training scenario, or a mixture of such."""
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """Hyperparameters that go before those of the files."""
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """Of the environment, parameters, ``reward`` or ``dtype``, likewise."""
    config: Path | None = None
    """File of settings, see :func:`.settings.read_config`; it goes before the file that is shipped."""
    backend: str = "auto"
    """What computes the steps."""
    residual_to: str = ""
    """Name of a policy of the environment's own to whose actions the agent's are added; the default control is then
    that policy's."""
    gated: bool = False
    """Let the agent act only where something is wrong, see :mod:`.gate`."""


def new_run(problem: Problem, options: RunOptions) -> TrainingRun:
    """Describe a run.

    Args:
        problem: that is trained on.
        options: what is asked of the run.

    Raises:
        ValueError: for an unknown name, a value out of its limits, a scenario that is held out, or an agent that cannot
            be around that policy or inside the gate.
    """
    cls, algorithm = problem.task, options.algorithm
    if algorithm not in FILES:
        raise nearest("algorithm", algorithm, FILES)
    values, own_keywords = _merge_settings(problem, options)
    of_environment = merge_settings(values.get("env_kwargs", {}), own_keywords)
    named = {name: of_environment.pop(name, None) for name in OPTIONS}
    control = options.control
    if options.residual_to and control is None and "control" not in own_keywords:
        # Before the file that is shipped, which knows nothing of that policy.
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
    default_envs, default_steps = (_without_point(values.pop(name)) for name in ("n_envs", "n_timesteps"))
    envs = check_integer("envs", default_envs if options.envs is None else options.envs, 1)
    steps = check_integer("steps", default_steps if options.steps is None else options.steps, 1)
    return TrainingRun(
        problem.name,
        control or controls[0],
        in_words(flown),
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
    """Return hyperparameters, and the keywords of the environment that do not come from the file that is shipped.

    Raises:
        ValueError: for one that there is not.
    """
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
    """Raise ValueError if the environment of a run cannot be made."""
    known = parameter_names(problem.task)
    parameters = {name: value for name, value in keywords.items() if name in known}
    models = [make_model(problem.task, control, name, **parameters) for name in scenarios]
    if options.residual_to or options.gated:
        _check_around(options, models)
    for name, words in (("reward", REWARDS), ("dtype", DTYPES)):
        if name in keywords and keywords[name] not in words:
            raise nearest(name, keywords[name], words)


def _without_point(value: Any) -> Any:
    """Return a whole number as one: files write 1e6."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _check_around(options: RunOptions, models: Sequence[Model]) -> None:
    """Raise ValueError if an agent cannot correct that policy, or act inside the gate."""
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
    """What an algorithm can steer: the controls of an environment, or the filter of a learned estimator.

    Raises:
        ValueError: if the environment has no such filter.
    """
    if algorithm not in ESTIMATORS:
        return cls.controls
    if algorithm not in cls.trained_banks:
        having = [other.id for other in catalogue().values() if algorithm in other.trained_banks]
        raise ValueError(
            f"{cls.id} has no filter for {algorithm!r} to steer: choose another algorithm, or {', '.join(having)}"
        )
    return (algorithm,)


def training_scenarios(cls: type[Task], scenario: Any) -> dict[str, float]:
    """Return the scenarios that a run flies, with their weights.

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


def in_words(weights: Mapping[str, float]) -> str:
    """Name a scenario, or a mixture, as an option and ``gymnasium.make`` take it."""
    if len(weights) == 1:
        return next(iter(weights))
    return ",".join(f"{name}:{weight!r}" for name, weight in weights.items())


def read_hyperparameters(id: str, algorithm: str) -> dict[str, Any]:
    """Return the hyperparameters of an algorithm for an environment; default ones where it has none.

    A file that is ``based_on`` another algorithm's says only what is different, everywhere and in an environment.
    """
    import yaml

    file: Any = files(__package__).joinpath("hyperparameters", f"{FILES[algorithm]}.yml")
    table = yaml.safe_load(file.read_text(encoding="utf-8"))
    if "based_on" not in table:
        return dict(table.get(id, table["default"]))
    based = merge_settings(read_hyperparameters(id, table["based_on"]), table["default"])
    return merge_settings(based, table.get(id, {}))


def schedule(name: str, value: float | str) -> Callable[[float], float]:
    """Return a hyperparameter over the share of the run that is left, 1 to 0.

    Args:
        name: of it, such as ``learning_rate``.
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


def package_versions() -> dict[str, str]:
    """Versions of what a run's result depends on."""
    versions = {}
    for name in ("filtergym", "numpy", "torch", "gymnasium", "stable_baselines3", "sb3_contrib"):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def check_trust(what: str, trust: bool) -> None:
    """Raise ValueError if something that can execute code is not trusted.

    Args:
        what: it is, and what happens to it.
        trust: whether the user says so.
    """
    if not trust:
        raise ValueError(
            f"{what}, which can execute code: if you made it or know who did, add --trust (in Python: trust=True)"
        )


def save_run(run: TrainingRun, path: Path) -> None:
    """Write a run's record, whole or not at all."""
    write_text(path, json.dumps(asdict(run), indent=1) + "\n")


def load_run(folder: Path, trust: bool = False) -> TrainingRun:
    """Read ``run.json``.

    Args:
        folder: of the run.
        trust: import the module that registers the environment, which executes it. An environment of filtergym, or one
            whose module is imported already, such as one that the command line names, takes no trust.

    Raises:
        ValueError: if there is none, it is not one, or its environment takes ``trust``.
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
        check_trust(f"{path} asks for an import of module {module!r}", trust)
        import_task(run.environment)
    return replace(run, environment=importable_name(task_class(run.environment)))


def best_agent(folder: Path) -> Path:
    """File of a run's agent with the lowest validation cost, as an evaluation takes it.

    Raises:
        ValueError: if the run has not been validated yet.
    """
    best = find_folder(folder / "best")
    for name in ("agent.safetensors", "model.zip"):
        if (best / name).is_file():
            return best / name
    raise ValueError(f"{folder} has no best agent yet: train it up to its first validation")


def resume_run(folder: Path, asked: TrainingRun, same: bool = False) -> TrainingRun:
    """Read the run of a folder to go on with it, up to the steps asked for; what a crash left is put in order.

    Args:
        folder: of the run.
        asked: what the user says that it is.
        same: with the run's own hyperparameters, of which the user says nothing.

    Raises:
        ValueError: if it is a run of something else.
    """
    checkpoint = folder / "checkpoint"
    for place in (checkpoint, folder / "best"):
        settle_folder(place)
    # A crash between the two leaves a checkpoint that is newer than the folder's record: its own one counts.
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
        has, wanted = getattr(run, name), getattr(run if same and name == "hyperparameters" else asked, name)
        while isinstance(has, dict) and isinstance(wanted, dict) and has != wanted:
            inside = next(n for n in {**has, **wanted} if has.get(n) != wanted.get(n))
            name, has, wanted = f"{name}.{inside}", has.get(inside), wanted.get(inside)
        if has != wanted:
            raise ValueError(f"{folder} holds a run with {name} {has!r}, not {wanted!r}")
    if not checkpoint.is_dir():
        raise ValueError(f"{folder} has no checkpoint to resume from")
    if not (folder / "run.json").exists() or load_run(folder) != run:
        save_run(run, folder / "run.json")
    run.steps = asked.steps
    if asked.backend != "auto":
        run.backend = asked.backend
    return run


def holds_run(folder: Path) -> bool:
    """Whether a training run was begun in a folder, up to its first checkpoint at least."""
    return (folder / "run.json").exists() or find_folder(folder / "checkpoint").exists()


def open_run(folder: Path, asked: TrainingRun, resume: bool, same: bool = False) -> TrainingRun:
    """Begin a run in a folder, or go on with the one that is there; its command and versions are noted.

    Args:
        folder: of the run.
        asked: what the user says that it is.
        resume: go on with it.
        same: as of :func:`resume_run`.

    Raises:
        ValueError: if the folder cannot be written to, holds a run already, or holds another one.
    """
    if not resume and holds_run(folder):
        raise ValueError(
            f"{folder} holds a training run: add --resume to go on with it, or choose another folder"
        )
    if resume and folder.is_dir():
        claim_folder(folder)  # before anything in it is put in order
    run = resume_run(folder, asked, same) if resume else asked
    writable_folder(folder)
    run.command = " ".join(
        [
            f"filtergym train {run.environment} --algo {run.algorithm} --control {run.control} "
            f"--scenario {run.scenario} --steps {run.steps} --envs {run.envs} --seed {run.seed}",
            *([f"--residual-to {run.residual_to}"] if run.residual_to else []),
            *(["--gated"] if run.gated else []),
            *_settings_in_words(run),
        ]
    )
    run.versions = package_versions()
    return run


def _settings_in_words(run: TrainingRun) -> Iterator[str]:
    """What differs from the hyperparameters that are shipped, as options."""

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


def _cost(model: Model, episode: Episode) -> dict[str, numpy.ndarray]:
    return {"cost": model.cost(episode)}


class TrainingEpisodes:
    """Episodes of the validation split under what a run trains on; who flies them is scored.

    Of a mixture, every scenario flies all episodes, and what is measured is weighted as they are: the same expectation
    with less variance than drawing.

    Args:
        run: gives environment, scenario, and parameters of the task.
        episodes: number of episodes.
        backend: what computes the steps.
    """

    def __init__(self, run: TrainingRun, episodes: int, backend: str = "auto") -> None:
        self.problem, self.keywords, self.backend = run.problem, run.task_keywords, backend
        self.weights = find_mixture(run.problem.task, run.scenario) or {run.scenario: 1.0}
        self.seeds = episode_seeds("validation", 0, episodes)
        self._models: dict[tuple[str | None, str, str], Model] = {}

    def _model(self, control: str | None, scenario: str, keywords: Mapping[str, Any]) -> Model:
        """Return a model that is made once: compiling it takes time."""
        key = control, scenario, repr(keywords)
        if key not in self._models:
            cls, parameters = self.problem.task, {**keywords, **self.keywords}
            self._models[key] = make_model(cls, control, scenario, backend=self.backend, **parameters)
        return self._models[key]

    def means(
        self,
        competitor: Any,
        control: str | None = None,
        report: Callable[[Model, Episode], dict[str, numpy.ndarray]] = _cost,
        episodes: int | None = None,
    ) -> dict[str, numpy.ndarray]:
        """Return what is reported, as means over every episode, ``(episodes,)``.

        Args:
            competitor: policy, estimator or reference, or what makes it.
            control: in which it acts; default: its own.
            report: as of :func:`.run_competitor`, with one number for every episode.
            episodes: fly the first of them only.
        """
        kind = kind_of(competitor)
        control = control or getattr(competitor, "control", None)
        total: dict[str, Any] = {}
        for scenario, weight in self.weights.items():
            model = self._model(control, scenario, getattr(competitor, "task_keywords", {}))
            series = run_competitor(model, competitor, kind, self.seeds[:episodes], report)
            for name, values in series.items():
                mean = numpy.ascontiguousarray(values).mean(axis=1)
                total[name] = total.get(name, 0.0) + weight * mean
        return total

    def costs(self, competitor: Any, control: str | None = None) -> numpy.ndarray:
        """Mean cost of every episode, ``(episodes,)``; arguments as of :meth:`means`."""
        return self.means(competitor, control)["cost"]


def validation_backend(run: TrainingRun) -> str:
    """What computes the steps of a run's validations: policies answer in NumPy arrays, not in torch's."""
    return "auto" if run.backend == "torch" else run.backend


class Validation:
    """Scores an agent, and the paper's algorithm if there is one, on the same episodes of the validation split.

    Args:
        run: what is trained.
    """

    def __init__(self, run: TrainingRun) -> None:
        self.run = run
        problem = run.problem
        self.paper = problem.baselines.score_paper
        self.bootstrap = Bootstrap(VALIDATION_EPISODES)
        self.episodes = TrainingEpisodes(run, VALIDATION_EPISODES, validation_backend(run))
        # Once: neither the paper's algorithm nor the episodes change in a run.
        self.paper_cost = self._costs(problem.competitor(self.paper), None) if self.paper else None

    def _costs(self, policy: Any, control: str | None) -> numpy.ndarray:
        """Mean cost over the episodes and over every resample of them."""
        return self.bootstrap.means(self.episodes.costs(policy, control))

    def score(self, policy: Any) -> ValidationEntry:
        """Return an entry of ``TrainingRun.validation``."""
        acts = self.run.algorithm not in ESTIMATORS
        # A maker of its own: what is compiled is kept by it, and the network has changed since the last validation.
        cost = self._costs(copy.copy(policy), self.run.control if acts else None)
        entry: ValidationEntry = {"steps": self.run.steps_done, "cost": float(cost[0])}
        if self.paper is None or self.paper_cost is None:
            return entry
        return {
            **entry,
            "paper": self.paper,
            "paper_cost": float(self.paper_cost[0]),
            "relative_cost_difference": list(self.bootstrap.relative_difference(cost, self.paper_cost)),
        }


def _curve(entry: ValidationEntry) -> dict[str, float]:
    """Numbers of a validation, as a log shows them over environment steps."""
    curve = {"validation/cost": entry["cost"]}
    if "paper_cost" in entry:
        curve["validation/paper_cost"] = entry["paper_cost"]
        curve["validation/cost_vs_paper"] = entry["relative_cost_difference"][0]
    return curve


def logger_in(folder: Path, steps_done: int) -> Any:
    """Return a logger of Stable-Baselines3 that writes CSV and, where it is installed, TensorBoard.

    Args:
        folder: for the files.
        steps_done: before; a resumed run writes files of its own.
    """
    from stable_baselines3.common.logger import Logger, make_output_format

    formats = ["csv"] + (["tensorboard"] if importlib.util.find_spec("tensorboard") else [])
    suffix = f"_{steps_done}"
    return Logger(str(folder), [make_output_format(name, str(folder), suffix) for name in formats])


def curves_beside(logger: Any) -> Callable[[int, Mapping[str, float]], None]:
    """Return what writes numbers at once where a logger writes, and leaves alone what that one has gathered."""
    from stable_baselines3.common.logger import Logger

    own = Logger(None, logger.output_formats)

    def write(steps: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            own.record(name, value)
        own.record("time/total_timesteps", steps, exclude="tensorboard")
        own.dump(steps)

    return write


@contextmanager
def interruption() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C or SIGTERM into a wish to stop at the next safe point; the second stops at once."""
    wished = False
    if threading.current_thread() is not threading.main_thread():  # of a worker, which no signal reaches
        yield lambda: False
        return

    def wish(*_: Any) -> None:
        nonlocal wished
        wished = True
        restore()

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, wish)
    try:
        yield lambda: wished
    finally:
        restore()


def _tell_nobody(news: Any) -> None:
    """Do nothing."""


def _go_on(entry: ValidationEntry) -> bool:
    """Do not stop, whatever a validation says."""
    return False


@dataclass(frozen=True)
class Session:
    """How a run is trained, from its beginning or from where it stopped.

    Raises:
        ValueError: for less than one environment step between validations.
    """

    folder: Path
    """Of the run; exists."""
    resume: bool = False
    """Go on from the folder's checkpoint."""
    validate_every: int | None = None
    """Environment steps between two validations; None: a twentieth of the run."""
    trust: bool = False
    """Load the checkpoint even if it can execute code; resuming a model of Stable-Baselines3 takes it."""
    progress: Callable[[int], None] = _tell_nobody
    """Told of all environment steps done so far."""
    report: Callable[[str], None] = _tell_nobody
    """Told of every validation in words."""
    validated: Callable[[ValidationEntry], bool] = _go_on
    """Told of every validation; returns whether to stop, with a checkpoint."""

    def __post_init__(self) -> None:
        if self.validate_every is not None:
            check_integer("validate_every", self.validate_every, 1)

    def steps_between_validations(self, run: TrainingRun) -> int:
        """Return the environment steps between two validations of a run."""
        return max(1, run.steps // 20) if self.validate_every is None else self.validate_every


class Trainee(NamedTuple):
    """An agent while it is trained."""

    policy: Any
    """For an evaluation."""
    save_checkpoint: Callable[[Path], None]
    """Writes all that training goes on from into an empty folder."""
    save_agent: Callable[[Path], None]
    """Writes the agent alone into an empty folder."""


class Bookkeeping:
    """Decides when a run is validated and checkpointed, and does what that takes.

    Args:
        run: the record, kept up to date.
        session: how it is trained; every validation is followed by a checkpoint.
        trainee: the agent.
        stop: whether somebody wishes to stop.
        log: writes numbers by name at so many environment steps.
        began: when the run began to make its environments, of ``time.monotonic``.
    """

    def __init__(
        self,
        run: TrainingRun,
        session: Session,
        trainee: Trainee,
        stop: Callable[[], bool],
        log: Callable[[int, Mapping[str, float]], None] = lambda steps, values: None,
        began: float | None = None,
    ) -> None:
        claim_folder(session.folder)
        self.began = time.monotonic() if began is None else began
        self.run, self.stop, self.log = run, stop, log
        self.folder, self.interval = session.folder, session.steps_between_validations(run)
        self.report, self.validated = session.report, session.validated
        self.policy, self.save_checkpoint, self.save_agent = trainee
        self.validation = Validation(run)
        self.due = run.steps_done + self.interval
        self.seconds_before = run.seconds

    def safe_point(self, steps_done: int, last: bool = False) -> bool:
        """Between two updates: validate and save if it is time; returns whether to stop."""
        stopping = self.stop()
        if not (stopping or last or steps_done >= self.due):
            return False
        self.due = steps_done + self.interval
        run = self.run
        run.steps_done = steps_done
        entry = self.validation.score(self.policy)
        is_best = run.best is None or entry["cost"] < run.best["cost"]
        run.validation.append(entry)
        self.log(steps_done, _curve(entry))
        run.seconds = self.seconds_before + time.monotonic() - self.began
        passed = run.beat_paper is None and entry.get("relative_cost_difference", [0.0, 0.0, 0.0])[2] < 0.0
        if passed:
            run.beat_paper = {"steps": steps_done, "seconds": round(run.seconds, 3)}
        if is_best:
            with whole_folder(self.folder / "best") as best:
                self.save_agent(best)
        with whole_folder(self.folder / "checkpoint") as checkpoint:
            self.save_checkpoint(checkpoint)
            save_run(run, checkpoint / "run.json")
        save_run(run, self.folder / "run.json")
        line = f"{steps_done:,} steps: validation cost {entry['cost']:.4g}"
        if self.validation.paper:
            value, low, high = (f"{100 * x:+.1f} %" for x in entry["relative_cost_difference"])
            line += f", {entry['paper']} {entry['paper_cost']:.4g}, difference {value} ({low} to {high})"
        if passed:
            line += f"; better than {entry['paper']} for the first time, after {run.seconds:.1f} s"
        self.report(line)
        return self.validated(entry) or stopping
