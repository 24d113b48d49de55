"""A training run in progress: its callbacks, validations, checkpoints, and how it is stopped."""

import importlib.util
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ..envs.contract.parameters import check_integer
from ..evaluation.storage.files import claim_folder, whole_folder
from .training_run import TrainingRun, ValidationEntry, save_run
from .validation import Validation


def _curve(entry: ValidationEntry) -> dict[str, float]:
    """Return the numbers of a validation for the training log, by name."""
    curve = {"validation/cost": entry["cost"]}
    if "paper_cost" in entry and "relative_cost_difference" in entry:
        curve["validation/paper_cost"] = entry["paper_cost"]
        curve["validation/cost_vs_paper"] = entry["relative_cost_difference"][0]
    return curve


def make_logger(folder: Path, steps_done: int) -> Any:
    """Return a logger of Stable-Baselines3 that writes CSV and, where it is installed, TensorBoard.

    A resumed run writes its own files, named after ``steps_done``.
    """
    from stable_baselines3.common.logger import Logger, make_output_format

    formats = ["csv"] + (["tensorboard"] if importlib.util.find_spec("tensorboard") else [])
    suffix = f"_{steps_done}"
    return Logger(str(folder), [make_output_format(name, str(folder), suffix) for name in formats])


def curve_writer(logger: Any) -> Callable[[int, Mapping[str, float]], None]:
    """Return a function that writes numbers at once to a logger's files, without the values pending in the logger."""
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
    """Yield a function that returns whether Ctrl-C or SIGTERM came; a second signal acts at once."""
    wished = False
    if threading.current_thread() is not threading.main_thread():  # signals reach the main thread only
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


def _ignore(value: Any) -> None:
    """Ignore a value; the default callback."""


def _never_stop(entry: ValidationEntry) -> bool:
    return False


@dataclass(frozen=True)
class Session:
    """Settings of a session that trains a run, from its beginning or from a checkpoint.

    Raises:
        ValueError: for less than one environment step between validations.
    """

    folder: Path
    """Folder of the run, which exists."""
    resume: bool = False
    """Continue from the folder's checkpoint."""
    validate_every: int | None = None
    """Environment steps between two validations; None: a twentieth of the run."""
    trust: bool = False
    """Load the checkpoint even if it can execute code; needed to resume a model of Stable-Baselines3."""
    progress: Callable[[int], None] = _ignore
    """Function that is called with the number of environment steps done."""
    report: Callable[[str], None] = _ignore
    """Function that is called with a sentence on every validation."""
    on_validation: Callable[[ValidationEntry], bool] = _never_stop
    """Function that is called with every validation and returns whether to stop with a checkpoint."""

    def __post_init__(self) -> None:
        if self.validate_every is not None:
            check_integer("validate_every", self.validate_every, 1)

    def steps_between_validations(self, run: TrainingRun) -> int:
        """Return the environment steps between two validations of a run."""
        return max(1, run.steps // 20) if self.validate_every is None else self.validate_every


class Trainee(NamedTuple):
    """An agent in training: its policy, and functions that save a checkpoint and the agent."""

    policy: Any
    """Policy of the agent, for an evaluation."""
    save_checkpoint: Callable[[Path], None]
    """Function that writes a checkpoint into an empty folder."""
    save_agent: Callable[[Path], None]
    """Function that writes the agent alone into an empty folder."""


class Bookkeeping:
    """Validations, checkpoints and record of a run in training.

    ``stop`` returns whether a stop was requested; ``began`` is ``time.monotonic`` before the environments
    were made.
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
        self.began: float = time.monotonic() if began is None else began
        self.run = run
        self.stop = stop
        self.log = log
        self.folder: Path = session.folder
        self.interval: int = session.steps_between_validations(run)
        self.report: Callable[[str], None] = session.report
        self.on_validation: Callable[[ValidationEntry], bool] = session.on_validation
        self.policy, self.save_checkpoint, self.save_agent = trainee
        self.validation: Validation = Validation(run)
        self.due: int = run.steps_done + self.interval
        self.seconds_before: float = run.seconds

    def safe_point(self, steps_done: int, last: bool = False) -> bool:
        """Validate and write a checkpoint if it is time, between two updates; return whether to stop."""
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
        if "paper" in entry and "paper_cost" in entry and "relative_cost_difference" in entry:
            value, low, high = (f"{100 * x:+.1f} %" for x in entry["relative_cost_difference"])
            line += f", {entry['paper']} {entry['paper_cost']:.4g}, difference {value} ({low} to {high})"
        if passed:
            line += f"; better than {self.validation.paper} for the first time, after {run.seconds:.1f} s"
        self.report(line)
        return self.on_validation(entry) or stopping
