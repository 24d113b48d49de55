"""A training run while it goes on: what it is told and tells, when it is validated and saved, and how it is stopped."""

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
    """Return the numbers of a validation, as a log shows them over environment steps."""
    curve = {"validation/cost": entry["cost"]}
    if "paper_cost" in entry and "relative_cost_difference" in entry:
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
        self.began: float = time.monotonic() if began is None else began
        self.run = run
        self.stop = stop
        self.log = log
        self.folder: Path = session.folder
        self.interval: int = session.steps_between_validations(run)
        self.report: Callable[[str], None] = session.report
        self.validated: Callable[[ValidationEntry], bool] = session.validated
        self.policy, self.save_checkpoint, self.save_agent = trainee
        self.validation: Validation = Validation(run)
        self.due: int = run.steps_done + self.interval
        self.seconds_before: float = run.seconds

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
        if "paper" in entry and "paper_cost" in entry and "relative_cost_difference" in entry:
            value, low, high = (f"{100 * x:+.1f} %" for x in entry["relative_cost_difference"])
            line += f", {entry['paper']} {entry['paper_cost']:.4g}, difference {value} ({low} to {high})"
        if passed:
            line += f"; better than {self.validation.paper} for the first time, after {run.seconds:.1f} s"
        self.report(line)
        return self.validated(entry) or stopping
