"""What every training run has, whatever the algorithm: its folder, its record, and its validation.

A run's folder holds ``run.json`` (command, versions, seeds, duration, validation), ``checkpoint/`` (the last
one, from which ``--resume`` goes on, with the ``run.json`` of its time), ``best/`` (the agent with the lowest
validation cost) and the log.
"""

import importlib.metadata
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy

from ..baselines.catalogue import baselines_of
from ..baselines.names import evaluate
from ..envs.catalogue import find_scenario, importable_name, nearest, task_class
from ..evaluation.bootstrap import Bootstrap
from ..evaluation.files import found_folder, settle_folder, whole_folder, writable_folder, write_text
from ..evaluation.stored import read_json, restored

FILES = {"ppo": "ppo", "recurrent-ppo": "ppo_lstm", "sac": "sac", "dqn": "dqn", "bptt": "bptt"}
"""Algorithms and the files of their hyperparameters, which have rl-zoo3's names."""
VALIDATION_EPISODES = 512


class Validated(TypedDict):
    """One validation of a run."""

    steps: int
    cost: float
    paper: NotRequired[str]
    """Name of the paper's algorithm, where there is one."""
    paper_cost: NotRequired[float]
    relative_cost_difference: NotRequired[list[float]]
    """Value and 95 % interval."""


@dataclass
class TrainingRun:
    """The content of ``run.json``."""

    environment: str
    control: str
    scenario: str
    algorithm: str
    seed: int
    envs: int
    steps: int
    """Environment steps asked for."""
    hyperparameters: dict[str, Any]
    backend: str = "auto"
    """What computes the steps of the environments: as asked for, and once they are made what does."""
    command: str = ""
    steps_done: int = 0
    seconds: float = 0.0
    """Time spent, over all sessions."""
    versions: dict[str, str] = field(default_factory=dict)
    validation: list[Validated] = field(default_factory=list)
    exported: dict[str, Any] | None = None
    """Cost of the exported agent on the first episodes of the validation split, to be checked anywhere."""

    @property
    def finished(self) -> bool:
        """Whether all steps asked for are done."""
        return self.steps_done >= self.steps

    @property
    def best(self) -> Validated | None:
        """The validation with the lowest cost."""
        return min(self.validation, key=lambda entry: entry["cost"], default=None)


def new_run(
    environment: str,
    algorithm: str,
    control: str | None = None,
    steps: int | None = None,
    envs: int | None = None,
    seed: int = 0,
    scenario: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    backend: str = "auto",
) -> TrainingRun:
    """Describe a run; what is not given comes from the algorithm's hyperparameters.

    Raises:
        ValueError: for an unknown name, or a scenario that is held out.
    """
    cls = task_class(environment)
    if algorithm not in FILES:
        raise nearest("algorithm", algorithm, FILES)
    if control is not None and control not in cls.controls:
        raise nearest("control", control, cls.controls)
    chosen = find_scenario(cls, scenario)
    if not chosen.training:
        allowed = [s.name for s in cls.scenarios.values() if s.training]
        raise ValueError(
            f"scenario {chosen.name!r} is held out: train on a training scenario ({', '.join(allowed)})"
        )
    values = {**stored_hyperparameters(cls.id, algorithm), **(overrides or {})}
    default_envs, default_steps = values.pop("n_envs"), values.pop("n_timesteps")
    envs, steps = envs or int(default_envs), steps or int(default_steps)
    if envs < 1 or steps < 1:
        raise ValueError(f"envs and steps must be at least 1, got {envs} and {steps}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    return TrainingRun(
        importable_name(cls),
        control or cls.controls[0],
        chosen.name,
        algorithm,
        seed,
        envs,
        steps,
        values,
        backend,
    )


def stored_hyperparameters(id: str, algorithm: str) -> dict[str, Any]:
    """Return the hyperparameters of an algorithm for an environment; default ones where it has none."""
    import yaml

    file: Any = files(__package__).joinpath("hyperparameters", f"{FILES[algorithm]}.yml")
    table = yaml.safe_load(file.read_text(encoding="utf-8"))
    return dict(table.get(id, table["default"]))


def learning_rate_schedule(rate: float | str) -> Callable[[float], float]:
    """Return the learning rate over the share of the run that is left, 1 to 0.

    Args:
        rate: a constant, or in rl-zoo3's form "lin_0.001": from there linearly to zero.

    Raises:
        ValueError: for another form.
    """
    from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule

    text = str(rate)
    try:
        start = float(text.removeprefix("lin_"))
    except ValueError as error:
        raise ValueError(f"learning_rate must be a number or lin_ and a number, got {rate!r}") from error
    return LinearSchedule(start, 0.0, 1.0) if text.startswith("lin_") else ConstantSchedule(start)


def installed_versions() -> dict[str, str]:
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
            whose module is imported already, takes no trust.

    Raises:
        ValueError: if there is none, it is not one, or its environment takes ``trust``.
    """
    path = folder / "run.json"
    try:
        values = read_json(path)
    except FileNotFoundError as error:
        raise ValueError(f"no training run in {folder}: it has no run.json") from error
    try:
        run = restored(TrainingRun, values)
    except ValueError as error:
        raise ValueError(f"{path} is not the record of a run: {error}") from error
    module, colon, _ = run.environment.partition(":")
    if colon and module not in sys.modules:
        check_trust(f"{path} asks for an import of module {module!r}", trust)
    return run


def best_agent(folder: Path) -> Path:
    """File of a run's agent with the lowest validation cost, as an evaluation takes it.

    Raises:
        ValueError: if the run has not been validated yet.
    """
    best = found_folder(folder / "best")
    for name in ("agent.safetensors", "model.zip"):
        if (best / name).is_file():
            return best / name
    raise ValueError(f"{folder} has no best agent yet: train it up to its first validation")


def resumed_run(folder: Path, asked: TrainingRun) -> TrainingRun:
    """Read the run of a folder to go on with it, up to the steps asked for; what a crash left is put in order.

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
    for name in ("environment", "control", "scenario", "algorithm", "seed", "envs", "hyperparameters"):
        if getattr(run, name) != getattr(asked, name):
            raise ValueError(
                f"{folder} holds a run with {name} {getattr(run, name)!r}, not {getattr(asked, name)!r}"
            )
    if not checkpoint.is_dir():
        raise ValueError(f"{folder} has no checkpoint to resume from")
    if not (folder / "run.json").exists() or load_run(folder) != run:
        save_run(run, folder / "run.json")
    run.steps = asked.steps
    if asked.backend != "auto":
        run.backend = asked.backend
    return run


def opened_run(folder: Path, asked: TrainingRun, resume: bool) -> TrainingRun:
    """Begin a run in a folder, or go on with the one that is there; its command and versions are noted.

    Raises:
        ValueError: if the folder cannot be written to, holds a run already, or holds another one.
    """
    if not resume and ((folder / "run.json").exists() or found_folder(folder / "checkpoint").exists()):
        raise ValueError(
            f"{folder} holds a training run: add --resume to go on with it, or choose another folder"
        )
    run = resumed_run(folder, asked) if resume else asked
    writable_folder(folder)
    run.command = (
        f"filtergym train {run.environment} --algo {run.algorithm} --control {run.control} "
        f"--scenario {run.scenario} --steps {run.steps} --envs {run.envs} --seed {run.seed}"
    )
    run.versions = installed_versions()
    return run


class Validation:
    """Scores an agent, and the paper's algorithm if there is one, on the same episodes of the validation split.

    Args:
        run: what is trained.
    """

    def __init__(self, run: TrainingRun) -> None:
        self.run = run
        self.paper = baselines_of(run.environment).score_paper
        self.bootstrap = Bootstrap(VALIDATION_EPISODES)
        # Once: neither the paper's algorithm nor the episodes change in a run.
        self.paper_cost = self._costs(self.paper, self.paper, None) if self.paper else None

    def _costs(self, name: str, policy: Any, control: str | None) -> numpy.ndarray:
        """Mean cost over the episodes and over every resample of them."""
        run = self.run
        dataset = evaluate(
            run.environment,
            {name: policy},
            run.scenario,
            VALIDATION_EPISODES,
            split="validation",
            control=control,
            backend="auto" if run.backend == "torch" else run.backend,
        )
        return self.bootstrap.means(dataset["cost"].sel(policy=name).values.mean(axis=1))

    def score(self, policy: Any) -> Validated:
        """Return an entry of ``TrainingRun.validation``."""
        cost = self._costs("agent", policy, self.run.control)
        entry: Validated = {"steps": self.run.steps_done, "cost": float(cost[0])}
        if self.paper is None or self.paper_cost is None:
            return entry
        return {
            **entry,
            "paper": self.paper,
            "paper_cost": float(self.paper_cost[0]),
            "relative_cost_difference": list(self.bootstrap.interval(cost / self.paper_cost - 1.0)),
        }


@contextmanager
def interruption() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C or SIGTERM into a wish to stop at the next safe point; the second stops at once."""
    wished = False

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


class Bookkeeping:
    """Decides when a run is validated and checkpointed, and does what that takes.

    Args:
        run: the record, kept up to date.
        folder: of the run.
        interval: environment steps between two validations, each followed by a checkpoint.
        save_checkpoint: writes one into an empty folder.
        save_agent: writes the agent alone into an empty folder.
        policy: the agent as a policy for an evaluation.
        stop: whether somebody wishes to stop.
    """

    def __init__(
        self,
        run: TrainingRun,
        folder: Path,
        interval: int,
        save_checkpoint: Callable[[Path], None],
        save_agent: Callable[[Path], None],
        policy: Any,
        stop: Callable[[], bool],
        report: Callable[[str], None],
    ) -> None:
        self.run, self.folder, self.interval, self.policy, self.stop = run, folder, interval, policy, stop
        self.save_checkpoint, self.save_agent, self.report = save_checkpoint, save_agent, report
        self.validation = Validation(run)
        self.due = run.steps_done + interval
        self.began, self.seconds_before = time.monotonic(), run.seconds

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
        run.seconds = self.seconds_before + time.monotonic() - self.began
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
        self.report(line)
        return stopping
